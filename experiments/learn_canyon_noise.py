"""Pseudorange errors in a Berlin canyon: a distribution estimated on one stretch of the drive and scored on the other.

    PFBENCH_DATA=... python -m pfbench.experiments.learn_canyon_noise [draws [warm-up]]

The mixture `LosNlosRangeError` has four parameters: share of direct signals at 40 dB-Hz, its slope, standard deviation, mean
delay. They are estimated at the positions of the reference, where the clock of the receiver is the only unknown state. With an
unknown position the log likelihood of 2000 particles has a standard deviation of about 100, and no chain moves. The posterior
takes one epoch of two seconds, because reflections last. The maximum likelihood estimate models the clock by straight lines
between knots (`pfbench.experiments.urban_error_fit`); with 0 draws it is the only estimate. The scores are the log
evidence per range on the other stretch, and the error of a particle filter without reference. The command resumes from the
parts in its folder and writes `report.md` and its figures.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from hydra import compose, initialize_config_module
from matplotlib import ticker
from matplotlib.figure import Figure
from pfbench.experiments.study_parts import ResumableResults
from pfbench.experiments.urban_error_fit import (
    estimate_mixture,
    estimate_normal,
    range_residuals,
)
from pyro.distributions import Independent, LogNormal, Normal, TransformedDistribution
from torch import Tensor, nn
from torch.distributions.transforms import SigmoidTransform
from tqdm import tqdm

from pfbench.core import PhiloxStream, Record
from pfbench.files import markdown_bullets, markdown_head, markdown_paragraph, markdown_row
from pfbench.filter import ParticleFilter, run_filter
from pfbench.job import instantiate, register_experiments
from pfbench.model import (
    LosNlosRangeError,
    NormalExponentialMixture,
    NormalRangeError,
    PseudorangeError,
    StateSpaceModel,
    UrbanGnss,
    UrbanInputs,
    range_change,
)
from pfbench.noise import NominalNoise
from pfbench.ppl import (
    WELL_MIXED,
    ParameterisedModel,
    ParameterPosterior,
    PmmhSettings,
    plot_posterior,
    pmmh,
    repeat_runs,
)
from pfbench.report import COLUMN, RC, add_legend, line_styles, render_palette_png
from pfbench.results import holm, wilcoxon_signed_rank
from pfbench.scenario import (
    UrbanDrive,
    find_dataset,
    read_drive,
    select_stretch,
)

STRETCHES = {"first": (0.0, 100.0), "second": (100.0, 283.0)}  # s
PRIOR = {
    "odds": Normal(0.0, 2.0),  # logit of the share
    "sd": LogNormal(math.log(4.0), 0.7),  # m
    "tail": LogNormal(math.log(30.0), 0.7),  # m
    "slope": Normal(0.0, 0.5),  # per dB-Hz
}
PRIOR_OF_TABLE = {"share": TransformedDistribution(PRIOR["odds"], [SigmoidTransform()])} | {
    k: PRIOR[k] for k in ("sd", "tail", "slope")
}
LABELS = {"share": "share at 40 dB-Hz", "sd": "sd, m", "tail": "tail, m", "slope": "slope, 1/dB-Hz"}
STILL = 1e-6  # of states that the reference determines
CHAINS = 8
PARTICLES = 1000  # sd of the log likelihood 0.7 to 1.0; 2.1 to 5.3 with 300 particles
LEAPS = 3  # after each random-walk step of a chain
WIDE = {
    "odds": 0.6,
    "sd": 0.3,
    "tail": 0.3,
    "slope": 0.3,
}  # sd of the starts of the chains, of logarithms: 3 to 8 posterior sd


class BatchedRangeError(nn.Module):
    """`LosNlosRangeError` with its parameters in buffers, one value per chain."""

    odds: Tensor
    sd: Tensor
    tail: Tensor
    slope: Tensor

    def __init__(self, odds: Any, sd: Any, tail: Any, slope: Any) -> None:
        super().__init__()
        for name, value in (("odds", odds), ("sd", sd), ("tail", tail), ("slope", slope)):
            self.register_buffer(name, torch.as_tensor(value, dtype=torch.float64))

    def forward(self, mean: Tensor, u: UrbanInputs) -> Independent:
        odds = self.odds + self.slope * (u.cn0 - LosNlosRangeError.cn0_reference)
        return Independent(NormalExponentialMixture(mean, odds.unsqueeze(1), self.sd, self.tail), 1)


def drive(stretch: str, interval: float = 1.0) -> UrbanDrive:
    start, end = STRETCHES[stretch]
    places = [
        f"scenario.start_s={start}",
        f"scenario.end_s={end}",
        f"scenario.receiver.fix_interval_s={interval}",
    ]
    register_experiments()
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose("config", ["scenario=recorded_berlin", *places])
    scenario: UrbanDrive = instantiate(cfg.scenario)
    return scenario


def at_reference(scenario: UrbanDrive) -> tuple[Record, Any]:
    """Record of the epochs with ranges, minus the changes by the motion of the reference, and the tuning for it."""
    world = scenario.draw(NominalNoise(), torch.arange(1), 1)
    way = torch.cat([world.truth["position"], world.truth["height"]], -1)[0]
    u: UrbanInputs = world.record.u
    y = world.record.y[0] - range_change(way.unsqueeze(1), u.line[0], u.reach[0])[:, 0]
    mask = ~torch.isnan(y).all(-1)
    span = torch.diff(world.time[mask], prepend=world.time[mask][:1] - 1.0)
    parts = u._replace(duration=span[None], speed=0.0 * span[None], yaw_rate=0.0 * span[None])
    selected = (a if a.shape[1] == len(span) else a[:, mask] for a in parts)
    tuning = replace(
        scenario.tuning, distance_density=STILL, heading_density=STILL, height_density=STILL, scale_density=STILL,
        yaw_bias_density=STILL, initial_position_sd=[STILL] * 3, initial_heading_sd_deg=STILL, initial_scale_sd=STILL,
        initial_yaw_bias_sd=STILL, initial_clock_sd=5.0,
    )  # fmt: skip
    return Record(
        y[mask].unsqueeze(0), UrbanInputs(*selected), torch.zeros(1, 9, dtype=torch.float64)
    ), tuning


def estimate(stretch: str, best: LosNlosRangeError, draws: int, warmup: int) -> ParameterPosterior:
    """Posterior on a stretch. Chains start around the maximum likelihood estimate with the sd of `WIDE`."""
    record, tuning = at_reference(drive(stretch, 2.0))
    middle = {
        "odds": math.log(best.share / (1.0 - best.share)),
        "sd": math.log(best.sd),
        "tail": math.log(best.tail),
    }
    start = {
        "odds": Normal(middle["odds"], WIDE["odds"]), "sd": LogNormal(middle["sd"], WIDE["sd"]),
        "tail": LogNormal(middle["tail"], WIDE["tail"]), "slope": Normal(best.slope, WIDE["slope"]),
    }  # fmt: skip

    def make(**values: Tensor) -> StateSpaceModel:
        return UrbanGnss(tuning, BatchedRangeError(**values))

    with tqdm(
        total=warmup + draws,
        desc=f"{stretch} stretch",
        unit="iteration",
        mininterval=10.0,
        leave=False,
    ) as bar:
        return pmmh(
            ParameterisedModel(make, PRIOR), ParticleFilter(PARTICLES), record, draws, warmup, chains=CHAINS, seed=4,
            settings=PmmhSettings(start=start, leaps=LEAPS, tick=lambda *_: bar.update()),
        )  # fmt: skip


def evidence(distribution: PseudorangeError, stretch: str) -> tuple[float, float]:
    """Log evidence per range of a stretch, at the reference: mean and sd of 4 filters with 1500 particles."""
    record, tuning = at_reference(drive(stretch))
    again = repeat_runs(record, 4)
    with torch.no_grad():
        estimate = run_filter(
            ParticleFilter(1500),
            UrbanGnss(tuning, distribution),
            again,
            PhiloxStream(6, torch.arange(4)),
        )
    per_range = estimate.log_evidence / (~torch.isnan(record.y)).sum()
    return float(per_range.mean()), float(per_range.std())


def estimate_maximum_likelihood(stretch: str) -> dict[str, Any]:
    """Parameters of the normal distribution and the mixture of maximum likelihood, all epochs of a stretch."""
    scenario = drive(stretch)
    data = range_residuals(
        select_stretch(
            read_drive(find_dataset(scenario.root, scenario.folder)), *STRETCHES[stretch]
        )
    )
    mixture = estimate_mixture(data)[0]
    return {
        "normal": estimate_normal(data)[0].factor,
        "mixture": [mixture.share, mixture.sd, mixture.tail, mixture.slope],
    }


def positions(
    distribution: PseudorangeError, stretch: str, runs: int = 8, particles: int = 1500
) -> list[float]:
    """Horizontal RMSE of a particle filter without reference [m], one per run; runs differ in start and random numbers."""
    scenario, numbers = drive(stretch), torch.arange(runs)
    world = scenario.draw(NominalNoise(), numbers, 3)
    with torch.no_grad():
        filtered = run_filter(
            ParticleFilter(particles),
            UrbanGnss(scenario.tuning, distribution),
            world.record,
            PhiloxStream(8, numbers),
        )
    error = filtered.mean[..., :2] - world.truth["position"]
    rms: list[float] = error.square().sum(-1).mean(1).sqrt().tolist()
    return rms


def take_posterior_mean(posterior: ParameterPosterior) -> LosNlosRangeError:
    mean = {name: float(posterior.pooled_draws(name).mean()) for name in PRIOR}
    return LosNlosRangeError(
        1.0 / (1.0 + math.exp(-mean["odds"])), mean["sd"], mean["tail"], mean["slope"]
    )


def with_share(posterior: ParameterPosterior) -> ParameterPosterior:
    """Posterior with the share in place of its logit."""
    draws = {name: posterior.draws["odds" if name == "share" else name] for name in PRIOR_OF_TABLE}
    return replace(posterior, draws=draws | {"share": torch.sigmoid(draws["share"])})


def estimate_timed(
    stretch: str, best: LosNlosRangeError, draws: int, warmup: int
) -> dict[str, Any]:
    start_time = time.process_time()
    posterior = estimate(stretch, best, draws, warmup)
    return {"posterior": posterior.to_dict(), "seconds": time.process_time() - start_time}


Distributions = Mapping[
    str, Mapping[str, PseudorangeError]
]  # by stretch of the estimation, and by name
Scores = Mapping[
    str, Mapping[tuple[str, str, str], list[float]]
]  # by measure, and by distribution, stretch of the estimation and of the score


def compute_scores(
    results: Callable[[str, Callable[[], Any]], Any], distributions: Distributions
) -> Scores:
    """Mean and sd of the log evidence per range; errors of the runs for estimates of the other stretch."""
    scores: dict[str, dict[tuple[str, str, str], list[float]]] = {"evidence": {}, "position": {}}
    jobs = [
        (name, distribution, source, stretch)
        for source in distributions
        for name, distribution in distributions[source].items()
        for stretch in STRETCHES
    ]
    for name, distribution, source, stretch in tqdm(
        jobs, desc="scores", unit="distribution", leave=False
    ):
        label, key = f"{distribution}, on the {stretch}", (name, source, stretch)
        scores["evidence"][key] = results(
            f"evidence: {label}", partial(evidence, distribution, stretch)
        )
        if source != stretch:
            scores["position"][key] = results(
                f"position: {label}", partial(positions, distribution, stretch)
            )
    return scores


def posterior_table(
    distributions: Distributions, posteriors: Mapping[str, ParameterPosterior]
) -> list[str]:
    names = (
        "stretch",
        "parameter",
        "prior, median and 5 to 95 %",
        "posterior, median and 5 to 95 %",
        "r-hat",
        "effective sample size",
    )
    lines = markdown_head(*names, "maximum likelihood")
    for stretch, posterior in posteriors.items():
        table = with_share(posterior).table()
        for name, distribution in PRIOR_OF_TABLE.items():
            low, middle, high = (
                float(distribution.icdf(torch.tensor(q))) for q in (0.05, 0.5, 0.95)
            )
            t, best = table.loc[name], getattr(distributions[stretch]["mixture"], name)
            posterior_text = f"{t['median']:.3g} ({t['low']:.3g} to {t['high']:.3g})"
            mixing = (f"{t['r_hat']:.3f}", f"{t['ess']:.0f}")
            lines.append(
                markdown_row(
                    stretch,
                    LABELS[name],
                    f"{middle:.2g} ({low:.2g} to {high:.2g})",
                    posterior_text,
                    *mixing,
                    f"{best:.3g}",
                )
            )
    return lines


def describe_chains(
    posteriors: Mapping[str, ParameterPosterior],
    done: Mapping[str, Any],
    request: Mapping[str, Any],
) -> str:
    """Number, length, cost and convergence of the chains."""
    tables = [with_share(posterior).table() for posterior in posteriors.values()]
    worst, least = max(t["r_hat"].max() for t in tables), min(t["ess"].min() for t in tables)
    shares = torch.cat(
        [posterior.accepted for posterior in posteriors.values() if posterior.accepted is not None]
    )
    minutes = sum(done[f"posterior, {stretch}"]["seconds"] for stretch in posteriors) / 60.0
    verdict = (
        "have converged"
        if worst < WELL_MIXED
        else "have not converged, so their intervals are not reliable"
    )
    return (
        f"{request['chains']} chains for each stretch, {request['draws']} draws after a warm-up of {request['warmup']}, with filters of "
        f"{request['particles']} particles, in {minutes:.0f} minutes of a core. The chains {verdict}: the largest r-hat of split "
        f"chains is {worst:.3f} (limit {WELL_MIXED}), and the smallest effective sample size is {least:.0f}. "
        f"{float(shares.min()):.0%} to {float(shares.max()):.0%} of the proposals of a chain are accepted."
    )


def describe_differences(posteriors: Mapping[str, ParameterPosterior]) -> str:
    """Differences of the two posteriors by parameter, on scales where each is about normal."""
    a, b = posteriors.values()
    parts = []
    for name, distribution in PRIOR.items():
        u, v = (
            p.pooled_draws(name) if isinstance(distribution, Normal) else p.pooled_draws(name).log()
            for p in (a, b)
        )
        z = float((u.mean() - v.mean()) / torch.sqrt(u.var() + v.var()))
        label = {"odds": "logit of the share", "sd": "log sd", "tail": "log tail"}.get(name, name)
        parts.append(f"{label} {z:+.1f}")
    return (
        f"First stretch minus second, in standard deviations of the difference: {', '.join(parts)}. With the same distribution on "
        "both stretches, about one parameter in twenty exceeds 2."
    )


def evidence_table(distributions: Distributions, scores: Scores) -> list[str]:
    pairs = [(source, to) for to in STRETCHES for source in sorted(STRETCHES, key=to.__eq__)]
    lines = markdown_head(
        "distribution",
        *(
            f"on the {to}, estimated on the " + ("same" if source == to else source)
            for source, to in pairs
        ),
    )
    for name in distributions["first"]:
        lines.append(
            markdown_row(
                name, *(f"{scores['evidence'][name, source, to][0]:.4f}" for source, to in pairs)
            )
        )
    return lines


def describe_scores(scores: Scores) -> str:
    """Log evidence of the mixtures on the other stretch, relative to the normal distribution and to an estimate of that stretch."""
    parts, table = [], scores["evidence"]
    for name in dict.fromkeys(name for name, *_ in table if name != "normal"):
        pairs = [(a, b) for b in STRETCHES for a in STRETCHES if a != b]
        sides = [
            (table[name, a, b][0], table["normal", a, b][0], table[name, b, b][0]) for a, b in pairs
        ]
        ahead = " and ".join(f"{mean - usual:.3f}" for mean, usual, _ in sides)
        below = " and ".join(f"{same - mean:.3f}" for mean, _, same in sides)
        parts.append(
            f"The {name} is above the normal distribution by {ahead}, and below the same estimated there by {below}."
        )
    return (
        f"Estimated on the other stretch, scored on the first and on the second. {' '.join(parts)}"
    )


def position_table(scores: Scores) -> list[str]:
    """Mixtures of the other stretch against the normal distribution, Wilcoxon's test with Holm's correction."""
    names = (
        "scored on",
        "distribution, estimated on the other",
        "RMSE, m",
        "RMSE of the normal distribution, m",
        "median difference, m",
        "smaller in",
        "p",
        "p, Holm",
    )
    mixtures = [
        (key, np.array(rms)) for key, rms in scores["position"].items() if key[0] != "normal"
    ]
    usual = [
        np.array(scores["position"]["normal", source, stretch])
        for (_, source, stretch), _ in mixtures
    ]
    raw = [wilcoxon_signed_rank(b - a)[1] for (_, a), b in zip(mixtures, usual, strict=True)]
    lines = markdown_head(*names)
    for ((name, _, stretch), a), b, p, corrected in zip(
        mixtures, usual, raw, holm(raw), strict=True
    ):
        mixture_text, normal_text = (
            f"{np.median(x):.1f} ({x.min():.1f} to {x.max():.1f})" for x in (a, b)
        )
        cells = (
            f"{np.median(a - b):.1f}",
            f"{(a < b).sum()} of {len(a)} runs",
            f"{p:.2g}",
            f"{corrected:.2g}",
        )
        lines.append(markdown_row(stretch, name, mixture_text, normal_text, *cells))
    return lines


def read_parts(
    results: Callable[[str, Callable[[], Any]], Any], draws: int, warmup: int
) -> tuple[dict[str, dict[str, PseudorangeError]], dict[str, ParameterPosterior], Scores]:
    """Distributions, posteriors and scores; `results` computes the parts that are not stored."""
    posteriors: dict[str, ParameterPosterior] = {}
    distributions: dict[str, dict[str, PseudorangeError]] = {}
    for stretch in STRETCHES:
        parameters = results(
            f"maximum likelihood, {stretch}", partial(estimate_maximum_likelihood, stretch)
        )
        mixture = LosNlosRangeError(*parameters["mixture"])
        distributions[stretch] = {
            "normal": NormalRangeError(parameters["normal"]),
            "mixture": mixture,
        }
        if draws:
            work = partial(estimate_timed, stretch, mixture, draws, warmup)
            stored = results(f"posterior, {stretch}", work)["posterior"]
            posteriors[stretch] = ParameterPosterior.from_dict(stored)
            mean = take_posterior_mean(posteriors[stretch])
            distributions[stretch]["mixture, posterior mean"] = mean
    return distributions, posteriors, compute_scores(results, distributions)


def write_page(request: Mapping[str, Any], done: Mapping[str, Any]) -> str:
    """The page of the study from its stored results."""
    parts = read_parts(lambda name, _: done[name], request["draws"], request["warmup"])
    return "\n".join(report(*parts, done, request))


def report(
    distributions: Distributions,
    posteriors: Mapping[str, ParameterPosterior],
    scores: Scores,
    done: Mapping[str, Any],
    request: Mapping[str, Any],
) -> list[str]:
    spread = max(sd for _, sd in scores["evidence"].values())
    stretches = " and ".join(
        f"the {name} ({a:.0f} to {b:.0f} s)" for name, (a, b) in STRETCHES.items()
    )
    factors = " and ".join(
        f"{distribution.factor:.2f} ({s})"
        for s in distributions
        if isinstance(distribution := distributions[s]["normal"], NormalRangeError)
    )
    lines = [
        "# Pseudorange errors in a Berlin canyon, estimated on one stretch and scored on the other",
        "",
    ]
    lines += markdown_paragraph(
        f"`python -m pfbench.experiments.learn_canyon_noise {request['draws']} {request['warmup']}` writes this page. The scenario is "
        "`recorded_berlin`. Pseudorange errors are modelled as a mixture of direct and delayed signals (`LosNlosRangeError`). Its "
        f"parameters are estimated at the reference of one stretch and scored on the other. The stretches are {stretches}."
    )
    if posteriors:
        lines += ["## Posterior", "", *posterior_table(distributions, posteriors), ""]
        lines += [
            *markdown_paragraph(describe_chains(posteriors, done, request)),
            *markdown_paragraph(describe_differences(posteriors)),
        ]
        lines += [
            "![Chains and densities](posterior.png)",
            "",
            "*A colour for each stretch, a thin line for each chain.*",
            "",
        ]
    lines += ["## Scores on the other stretch", ""]
    lines += markdown_paragraph(
        "Log evidence per range at the reference, all epochs, mean of four filters of 1500 particles. The standard deviation of the "
        f"four is at most {spread:.4f}. The standard deviation of the normal distribution is that stated by the receiver times "
        f"{factors}, the maximum likelihood estimates."
    )
    lines += [
        *evidence_table(distributions, scores),
        "",
        *markdown_paragraph(describe_scores(scores)),
    ]
    lines += markdown_paragraph(
        "Horizontal RMSE of a particle filter without reference, with 1500 particles, in 8 runs that differ in start and random "
        "numbers. Values are median and range over runs, and the median of the differences to the normal distribution. The "
        "p-values are of Wilcoxon's test, without and with Holm's correction over this table. The smallest one of eight runs is "
        "0.008."
    )
    lines += [*position_table(scores), "", "![Scores](scores.png)", ""]
    lines += markdown_paragraph("Bottom: one mark per run, all estimated on the other stretch.")
    return [*lines, "## Choices and limits", "", *markdown_bullets(*CAVEATS)]


CAVEATS = (
    "Choices of this project: the priors, one epoch of two seconds for the posterior, and the boundary of the stretches. Chains "
    "start around the maximum likelihood estimate, three to eight posterior standard deviations wide. Three of four steps are "
    "leaps (`leaps` of `pmmh`).",
    "Errors of one satellite are alike for seconds. The model takes epochs as independent, so the posterior is narrower than the "
    "data support.",
    "The scores are of the distribution at the posterior mean. They do not average over the posterior.",
    "The data are one drive with one receiver on two consecutive stretches. Runs differ in start and random numbers only. Their "
    "p-values say nothing about another street or city.",
    "Estimation without a reference is not possible with a plain particle filter "
    "([reason](../../docs/parameter_inference.md#study-the-canyon-of-berlin)).",
)


def plot_scores(scores: Scores) -> Figure:
    """Evidence and errors, a column for each stretch scored on."""
    names = list(dict.fromkeys(name for name, *_ in scores["evidence"]))
    style = line_styles(names)
    figure = Figure(figsize=(2 * COLUMN, 3.8), layout="constrained")
    axes = figure.subplots(2, len(STRETCHES), squeeze=False, sharex=True, sharey="row")
    for (top, bottom), stretch in zip(axes.T, STRETCHES, strict=True):
        for x, (name, look) in enumerate(style.items()):
            for source in sorted(STRETCHES, key=stretch.__eq__):
                is_same, mean = source == stretch, scores["evidence"][name, source, stretch][0]
                face = "none" if is_same else look.colour
                top.plot(
                    x + 0.14 * (2 * is_same - 1),
                    mean,
                    look.marker,
                    color=look.colour,
                    markerfacecolor=face,
                )
                if not is_same:
                    rms = scores["position"][name, source, stretch]
                    bottom.plot(
                        x + 0.4 * ((np.arange(len(rms)) * 0.6180339887) % 1 - 0.5),
                        rms,
                        look.marker,
                        color=look.colour,
                        markersize=3,
                    )
        top.set_title(f"scored on the {stretch} stretch")
        bottom.set_xticks(range(len(names)), [name.replace(", ", ",\n") for name in names])
        bottom.set_xlim(-0.5, len(names) - 0.5)
        bottom.set_yscale("log")
    for face, label in (
        ("0.4", "estimated on the other stretch"),
        ("none", "estimated on the same"),
    ):
        axes[0, 0].plot([], [], "o", color="0.4", markerfacecolor=face, label=label)
    axes[0, 0].set_ylabel("log evidence per range")
    axes[1, 0].set_ylabel("horizontal RMSE, m")
    axes[1, 0].yaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axes[1, 0].yaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
    axes[1, 0].yaxis.set_minor_formatter(ticker.NullFormatter())
    add_legend(figure, axes[0, 0])
    return figure


def main(folder: Path, draws: int = 400, warmup: int = 100) -> None:
    torch.set_num_threads(1)
    request = {
        "draws": draws,
        "warmup": warmup,
        "chains": CHAINS,
        "particles": PARTICLES,
        "leaps": LEAPS,
        "wide": WIDE,
    }
    results = ResumableResults(folder / "learn_canyon_noise.json", request)
    _, posteriors, scores = read_parts(results, draws, warmup)
    (folder / "report.md").write_text(write_page(request, results.state["done"]))
    chains = {
        f"{stretch} stretch": with_share(posterior) for stretch, posterior in posteriors.items()
    }
    with matplotlib.rc_context(RC):
        (folder / "scores.png").write_bytes(render_palette_png(plot_scores(scores)))
        if chains:
            (folder / "posterior.png").write_bytes(
                render_palette_png(plot_posterior(chains, PRIOR_OF_TABLE, names=LABELS))
            )


if __name__ == "__main__":
    main(
        Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_canyon_noise",
        *map(int, sys.argv[1:]),
    )
