"""The law of pseudoranges in a Berlin canyon, learned on one stretch of the drive and scored on the other, both ways round.

    PFBENCH_DATA=... python -m pfbench.experiments.learn_canyon_noise [draws [warm-up]]

Learned is the mixture of `LosNlosRangeError`: share of lines of sight at 40 dB-Hz, its slope, the error's sd, the detour's mean. It is
learned at the reference's positions, so that the state is the receiver's clock alone, which a particle filter carries along:
with the position unknown too, estimates of the log likelihood scatter by a hundred between draws of 2000 particles, and no
chain moves. One epoch in two seconds is taken for the posterior, since a reflection lasts. Beside it stands the law of highest
likelihood, with the clock as straight lines between knots (`pfbench.scenario.recorded.urban_error_fit`); with 0 draws it stands alone. Scored
are the log evidence of a range on the other stretch, and the error of a particle filter that has no reference there. What is
done is kept in the folder, and the same command goes on from there; at its end it writes `report.md` and its figures.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Mapping
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
from pyro.distributions import Independent, LogNormal, Normal, TransformedDistribution
from torch import Tensor, nn
from torch.distributions.transforms import SigmoidTransform
from tqdm import tqdm

from pfbench.core import PhiloxStream, Record
from pfbench.files import markdown_bullets, markdown_head, markdown_paragraph, markdown_row
from pfbench.filter import ParticleFilter, run_filter
from pfbench.job import ResumableResults, instantiate
from pfbench.model import (
    LosNlosRangeError,
    NormalExponentialMixture,
    PseudorangeError,
    StateSpaceModel,
    UrbanGnss,
    UrbanInputs,
    range_change,
)
from pfbench.model import NormalRangeError as NormalRanges
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
from pfbench.report import COLUMN, RC, add_legend, compute_jitter, line_styles, render_palette_png
from pfbench.results import holm, wilcoxon_signed_rank
from pfbench.scenario import (
    UrbanDrive,
    estimate_mixture,
    estimate_normal,
    find_dataset,
    range_residuals,
    read_drive,
)
from pfbench.scenario import select_stretch as cut

STRETCHES = {"first": (0.0, 100.0), "second": (100.0, 283.0)}  # s
PRIOR = {
    "odds": Normal(0.0, 2.0),  # logit of the share
    "sd": LogNormal(math.log(4.0), 0.7),  # m
    "tail": LogNormal(math.log(30.0), 0.7),  # m
    "slope": Normal(0.0, 0.5),  # per dB-Hz
}
SHOWN = {"share": TransformedDistribution(PRIOR["odds"], [SigmoidTransform()])} | {
    k: PRIOR[k] for k in ("sd", "tail", "slope")
}
CALLED = {"share": "share at 40 dB-Hz", "sd": "sd, m", "tail": "tail, m", "slope": "slope, 1/dB-Hz"}
STILL = 1e-6  # of what the reference knows
CHAINS = 8
PARTICLES = 1000  # estimates of the log likelihood scatter by 0.7 to 1.0 with so many, by 2.1 to 5.3 with 300
LEAPS = 3  # after each step of the walk
WIDE = {
    "odds": 0.6,
    "sd": 0.3,
    "tail": 0.3,
    "slope": 0.3,
}  # sd of where chains start (of logarithms): 3 to 8 of the posterior's


class Learned(nn.Module):
    """`LosNlosRangeError` with its numbers in buffers, so that every chain has its own."""

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
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose("config", ["scenario=recorded_berlin", *places])
    scenario: UrbanDrive = instantiate(cfg.scenario)
    return scenario


def at_reference(scenario: UrbanDrive) -> tuple[Record, Any]:
    """The epochs with ranges, less what the way of the reference makes of them: a receiver that stands, and what is believed."""
    world = scenario.draw(NominalNoise(), torch.arange(1), 1)
    way = torch.cat([world.truth["position"], world.truth["height"]], -1)[0]
    u: UrbanInputs = world.record.u
    y = world.record.y[0] - range_change(way.unsqueeze(1), u.line[0], u.reach[0])[:, 0]
    seen = ~torch.isnan(y).all(-1)
    span = torch.diff(world.time[seen], prepend=world.time[seen][:1] - 1.0)
    parts = u._replace(duration=span[None], speed=0.0 * span[None], yaw_rate=0.0 * span[None])
    kept = (a if a.shape[1] == len(span) else a[:, seen] for a in parts)
    known = replace(
        scenario.tuning, distance_density=STILL, heading_density=STILL, height_density=STILL, scale_density=STILL,
        yaw_bias_density=STILL, initial_position_sd=[STILL] * 3, initial_heading_sd_deg=STILL, initial_scale_sd=STILL,
        initial_yaw_bias_sd=STILL, initial_clock_sd=5.0,
    )  # fmt: skip
    return Record(
        y[seen].unsqueeze(0), UrbanInputs(*kept), torch.zeros(1, 9, dtype=torch.float64)
    ), known


def learn(stretch: str, best: LosNlosRangeError, draws: int, warmup: int) -> ParameterPosterior:
    """The posterior of the law on a stretch. Chains start around the law of highest likelihood there, as wide as `WIDE`."""
    record, known = at_reference(drive(stretch, 2.0))
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
        return UrbanGnss(known, Learned(**values))

    with tqdm(
        total=warmup + draws,
        desc=f"{stretch} stretch",
        unit="iteration",
        mininterval=10.0,
        leave=False,
    ) as bar:
        return pmmh(
            ParameterisedModel(make, PRIOR), ParticleFilter(PARTICLES), record, draws, warmup, chains=CHAINS, seed=4,
            settings=PmmhSettings(start=start, leaps=LEAPS, tick=bar.update),
        )  # fmt: skip


def evidence(law: PseudorangeError, stretch: str) -> tuple[float, float]:
    """log evidence for each range of a stretch, at the reference: mean and sd of 4 filters with 1500 particles."""
    record, known = at_reference(drive(stretch))
    again = repeat_runs(record, 4)
    with torch.no_grad():
        estimate = run_filter(
            ParticleFilter(1500), UrbanGnss(known, law), again, PhiloxStream(6, torch.arange(4))
        )
    each = estimate.log_evidence / (~torch.isnan(record.y)).sum()
    return float(each.mean()), float(each.std())


def most_likely(stretch: str) -> tuple[PseudorangeError, PseudorangeError]:
    """The normal law and the mixture of highest likelihood at the reference, all epochs of a stretch."""
    scenario = drive(stretch)
    data = range_residuals(
        cut(read_drive(find_dataset(scenario.root, scenario.folder)), *STRETCHES[stretch])
    )
    return estimate_normal(data)[0], estimate_mixture(data)[0]


def positions(
    law: PseudorangeError, stretch: str, runs: int = 8, particles: int = 1500
) -> list[float]:
    """Horizontal rms errors of a particle filter without reference, m [runs]; runs differ in start and draws."""
    scenario, numbers = drive(stretch), torch.arange(runs)
    world = scenario.draw(NominalNoise(), numbers, 3)
    with torch.no_grad():
        filtered = run_filter(
            ParticleFilter(particles),
            UrbanGnss(scenario.tuning, law),
            world.record,
            PhiloxStream(8, numbers),
        )
    error = filtered.mean[..., :2] - world.truth["position"]
    rms: list[float] = error.square().sum(-1).mean(1).sqrt().tolist()
    return rms


def law_of(posterior: ParameterPosterior) -> LosNlosRangeError:
    mean = {name: float(posterior.pooled_draws(name).mean()) for name in PRIOR}
    return LosNlosRangeError(
        1.0 / (1.0 + math.exp(-mean["odds"])), mean["sd"], mean["tail"], mean["slope"]
    )


def shown(posterior: ParameterPosterior) -> ParameterPosterior:
    """With the share in place of its logit."""
    drawn = {name: posterior.draws["odds" if name == "share" else name] for name in SHOWN}
    return replace(posterior, draws=drawn | {"share": torch.sigmoid(drawn["share"])})


def told(stretch: str, best: LosNlosRangeError, draws: int, warmup: int) -> dict[str, Any]:
    began = time.process_time()
    posterior = learn(stretch, best, draws, warmup)
    return {"posterior": posterior.to_dict(), "seconds": time.process_time() - began}


Laws = Mapping[
    str, Mapping[str, PseudorangeError]
]  # by the stretch that they were learned on, and by name
Scores = Mapping[
    str, Mapping[tuple[str, str, str], list[float]]
]  # by measure, and by law, stretch learned on and scored on


def scored(pieces: ResumableResults, laws: Laws) -> Scores:
    """Mean and sd of the log evidence of a range; of laws learned on the other stretch the errors of the runs, too."""
    found: dict[str, dict[tuple[str, str, str], list[float]]] = {"evidence": {}, "position": {}}
    jobs = [
        (name, law, source, stretch)
        for source in laws
        for name, law in laws[source].items()
        for stretch in STRETCHES
    ]
    for name, law, source, stretch in tqdm(jobs, desc="scores", unit="law", leave=False):
        label, key = f"{law}, on the {stretch}", (name, source, stretch)
        found["evidence"][key] = pieces(f"evidence: {label}", partial(evidence, law, stretch))
        if source != stretch:
            found["position"][key] = pieces(f"position: {label}", partial(positions, law, stretch))
    return found


def learned_table(laws: Laws, posteriors: Mapping[str, ParameterPosterior]) -> list[str]:
    names = (
        "stretch",
        "number",
        "prior, median and 5 to 95 %",
        "posterior, median and 90 %",
        "r-hat",
        "effective size",
    )
    lines = markdown_head(*names, "highest likelihood")
    for stretch, posterior in posteriors.items():
        table = shown(posterior).table()
        for name, law in SHOWN.items():
            low, middle, high = (float(law.icdf(torch.tensor(q))) for q in (0.05, 0.5, 0.95))
            t, best = table.loc[name], getattr(laws[stretch]["mixture"], name)
            mine = f"{t['median']:.3g} ({t['low']:.3g} to {t['high']:.3g})"
            met = (f"{t['r_hat']:.3f}", f"{t['ess']:.0f}")
            lines.append(
                markdown_row(
                    stretch,
                    CALLED[name],
                    f"{middle:.2g} ({low:.2g} to {high:.2g})",
                    mine,
                    *met,
                    f"{best:.3g}",
                )
            )
    return lines


def of_chains(
    posteriors: Mapping[str, ParameterPosterior], done: Mapping[str, Any], asked: Mapping[str, Any]
) -> str:
    """What is to be thought of the chains."""
    tables = [shown(posterior).table() for posterior in posteriors.values()]
    worst, least = max(t["r_hat"].max() for t in tables), min(t["ess"].min() for t in tables)
    shares = torch.cat(
        [posterior.accepted for posterior in posteriors.values() if posterior.accepted is not None]
    )
    minutes = sum(done[f"posterior, {stretch}"]["seconds"] for stretch in posteriors) / 60.0
    verdict = (
        "have met" if worst < WELL_MIXED else "have not met, so that widths are not to be relied on"
    )
    return (
        f"{asked['chains']} chains for each stretch, {asked['draws']} draws each after {asked['warmup']}, with filters of "
        f"{asked['particles']} particles; {minutes:.0f} minutes of a core in all. They {verdict}: the largest r-hat is "
        f"{worst:.3f} (of chains split in halves; {WELL_MIXED} is the bound), the least effective size {least:.0f}; "
        f"{float(shares.min()):.0%} to {float(shares.max()):.0%} of a chain's proposals are accepted."
    )


def stretches_apart(posteriors: Mapping[str, ParameterPosterior]) -> str:
    """How far the two posteriors lie apart, number by number, where each is about normal."""
    a, b = posteriors.values()
    parts = []
    for name, law in PRIOR.items():
        u, v = (
            p.pooled_draws(name) if isinstance(law, Normal) else p.pooled_draws(name).log()
            for p in (a, b)
        )
        z = float((u.mean() - v.mean()) / torch.sqrt(u.var() + v.var()))
        label = {"odds": "logit of the share", "sd": "log sd", "tail": "log tail"}.get(name, name)
        parts.append(f"{label} {z:+.1f}")
    return (
        "First stretch less second, in standard deviations of the difference (beyond 2 once in twenty if one law held on both): "
        f"{', '.join(parts)}."
    )


def evidence_table(laws: Laws, scores: Scores) -> list[str]:
    pairs = [(source, to) for to in STRETCHES for source in sorted(STRETCHES, key=to.__eq__)]
    lines = markdown_head(
        "law",
        *(
            f"on the {to}, learned on " + ("itself" if source == to else f"the {source}")
            for source, to in pairs
        ),
    )
    for name in laws["first"]:
        lines.append(
            markdown_row(
                name, *(f"{scores['evidence'][name, source, to][0]:.4f}" for source, to in pairs)
            )
        )
    return lines


def carried_over(scores: Scores) -> str:
    """What is left of a mixture's advantage where it was not learned."""
    parts, table = [], scores["evidence"]
    for name in dict.fromkeys(name for name, *_ in table if name != "normal"):
        pairs = [(a, b) for b in STRETCHES for a in STRETCHES if a != b]
        sides = [
            (table[name, a, b][0], table["normal", a, b][0], table[name, b, b][0]) for a, b in pairs
        ]
        ahead = " and ".join(f"{mean - usual:.3f}" for mean, usual, _ in sides)
        lost = " and ".join(f"{own - mean:.3f}" for mean, _, own in sides)
        parts.append(
            f"the {name} is ahead of the normal law by {ahead}, and behind the same learned there by {lost}"
        )
    return f"Learned on the other stretch, on the first and on the second: {'; '.join(parts)}."


def position_table(scores: Scores) -> list[str]:
    """Laws learned on the other stretch against the normal one, p of Wilcoxon's test with Holm's correction."""
    names = (
        "scored on",
        "law, learned on the other",
        "rms, m",
        "normal law's rms, m",
        "less by, m",
        "in",
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
    raw = [wilcoxon_signed_rank(b - a).p for (_, a), b in zip(mixtures, usual, strict=True)]
    lines = markdown_head(*names)
    for ((name, _, stretch), a), b, p, corrected in zip(
        mixtures, usual, raw, holm(raw), strict=True
    ):
        own, normal = (f"{np.median(x):.1f} ({x.min():.1f} to {x.max():.1f})" for x in (a, b))
        cells = (
            f"{np.median(b - a):.1f}",
            f"{(a < b).sum()} of {len(a)} runs",
            f"{p:.2g}",
            f"{corrected:.2g}",
        )
        lines.append(markdown_row(stretch, name, own, normal, *cells))
    return lines


def report(
    laws: Laws,
    posteriors: Mapping[str, ParameterPosterior],
    scores: Scores,
    done: Mapping[str, Any],
    asked: Mapping[str, Any],
) -> list[str]:
    spread = max(sd for _, sd in scores["evidence"].values())
    stretches = " and ".join(
        f"the {name} one ({a:.0f} to {b:.0f} s)" for name, (a, b) in STRETCHES.items()
    )
    factors = " and ".join(
        f"{law.factor:.2f} ({s})"
        for s in laws
        if isinstance(law := laws[s]["normal"], NormalRanges)
    )
    lines = [
        "# The law of ranges in a Berlin canyon, learned on one stretch and scored on the other",
        "",
    ]
    lines += markdown_paragraph(
        f"`python -m pfbench.experiments.learn_canyon_noise {asked['draws']} {asked['warmup']}` writes this page. How a "
        "pseudorange errs, as a mixture of signals seen directly and signals delayed by a detour (`SightOrTail`), is learned "
        "where the reference says that the receiver was, on one stretch of a recorded drive, and scored on the other: "
        f"{stretches}."
    )
    if posteriors:
        lines += ["## What was learned", "", *learned_table(laws, posteriors), ""]
        lines += [
            *markdown_paragraph(of_chains(posteriors, done, asked)),
            *markdown_paragraph(stretches_apart(posteriors)),
        ]
        lines += [
            "![Chains and densities](posterior.png)",
            "",
            "A colour for each stretch, a thin line for each chain.",
            "",
        ]
    lines += ["## What it is worth on the other stretch", ""]
    lines += markdown_paragraph(
        "Log evidence of a range at the reference, all epochs: mean over four filters of 1500 particles, which scatter by an sd "
        f"of {spread:.4f} at most. The normal law has the sd that the receiver states times {factors}, again the factor of "
        "highest likelihood."
    )
    lines += [*evidence_table(laws, scores), "", *markdown_paragraph(carried_over(scores))]
    lines += markdown_paragraph(
        "Horizontal rms error of a particle filter that has no reference, with 1500 particles, in 8 runs that differ in start "
        "and draws: median and range over runs, median of the differences, p of Wilcoxon's test and with Holm's correction over "
        "this table. Eight runs cannot give a p below 0.008."
    )
    lines += [*position_table(scores), "", "![Scores](scores.png)", ""]
    lines += markdown_paragraph("Below, a mark for each run, all learned on the other stretch.")
    return [*lines, "## What is chosen, and what is not shown", "", *markdown_bullets(*CAVEATS)]


CAVEATS = (
    "Ours: the priors; one epoch in two seconds for the posterior (a reflection lasts, and the model takes epochs as "
    "independent), all epochs for the law of highest likelihood and for the scores; where the drive is cut in two; that chains "
    "start around the law of highest likelihood, three to eight times as wide as the posterior, and leap three times in four "
    "(`leaps` of `pmmh`).",
    "The chains sample the posterior of the model at the reference. The model is not the street: ranges of one satellite err "
    "alike for seconds, so that the posterior is narrower than what the stretch really tells.",
    "Scored is the law at the posterior's mean, not the average over its draws.",
    "One drive, one receiver, two stretches one after the other: runs differ in start and draws, not in streets, and their p say "
    "nothing of another street or city.",
    "Learning without a reference is not shown: it cannot be done with a plain particle filter "
    "([why](../../docs/parameter_inference.md#study-the-canyon-of-berlin)).",
)


def compared(scores: Scores) -> Figure:
    """Evidence and errors, a column for each stretch scored on."""
    names = list(dict.fromkeys(name for name, *_ in scores["evidence"]))
    style = line_styles(names)
    figure = Figure(figsize=(2 * COLUMN, 3.8), layout="constrained")
    axes = figure.subplots(2, len(STRETCHES), squeeze=False, sharex=True, sharey="row")
    for (top, bottom), stretch in zip(axes.T, STRETCHES, strict=True):
        for x, (name, look) in enumerate(style.items()):
            for source in sorted(STRETCHES, key=stretch.__eq__):
                own, mean = source == stretch, scores["evidence"][name, source, stretch][0]
                face = "none" if own else look.colour
                top.plot(
                    x + 0.14 * (2 * own - 1),
                    mean,
                    look.marker,
                    color=look.colour,
                    markerfacecolor=face,
                )
                if not own:
                    rms = scores["position"][name, source, stretch]
                    bottom.plot(
                        x + compute_jitter(len(rms)),
                        rms,
                        look.marker,
                        color=look.colour,
                        markersize=3,
                    )
        top.set_title(f"scored on the {stretch} stretch")
        bottom.set_xticks(range(len(names)), [name.replace(", ", ",\n") for name in names])
        bottom.set_xlim(-0.5, len(names) - 0.5)
        bottom.set_yscale("log")
    for face, label in (("0.4", "learned on the other stretch"), ("none", "learned on the same")):
        axes[0, 0].plot([], [], "o", color="0.4", markerfacecolor=face, label=label)
    axes[0, 0].set_ylabel("log evidence of a range")
    axes[1, 0].set_ylabel("horizontal rms error, m")
    axes[1, 0].yaxis.set_major_locator(ticker.LogLocator(subs=(1.0, 2.0, 5.0)))
    axes[1, 0].yaxis.set_major_formatter(ticker.FormatStrFormatter("%g"))
    axes[1, 0].yaxis.set_minor_formatter(ticker.NullFormatter())
    add_legend(figure, axes[0, 0])
    return figure


def main(folder: Path, draws: int = 400, warmup: int = 100) -> None:
    torch.set_num_threads(1)
    asked = {
        "draws": draws,
        "warmup": warmup,
        "chains": CHAINS,
        "particles": PARTICLES,
        "leaps": LEAPS,
        "wide": WIDE,
    }
    pieces = ResumableResults(folder / "learn_canyon_noise.json", asked)
    posteriors: dict[str, ParameterPosterior] = {}
    laws: dict[str, dict[str, PseudorangeError]] = {}
    for stretch in STRETCHES:
        normal, mixture = most_likely(stretch)
        laws[stretch] = {"normal": normal, "mixture": mixture}
        print(stretch, normal, mixture, flush=True)
        if draws:
            kept = pieces(f"posterior, {stretch}", partial(told, stretch, mixture, draws, warmup))
            posteriors[stretch] = ParameterPosterior.from_dict(kept["posterior"])
            print(
                stretch,
                posteriors[stretch].table().to_string(),
                posteriors[stretch].accepted,
                sep="\n",
                flush=True,
            )
            laws[stretch]["mixture, posterior's mean"] = law_of(posteriors[stretch])
    scores = scored(pieces, laws)
    text = "\n".join(report(laws, posteriors, scores, pieces.state["done"], asked))
    print(text)
    (folder / "report.md").write_text(text)
    drawn = {f"{stretch} stretch": shown(posterior) for stretch, posterior in posteriors.items()}
    with matplotlib.rc_context(RC):
        (folder / "scores.png").write_bytes(render_palette_png(compared(scores)))
        if drawn:
            (folder / "posterior.png").write_bytes(
                render_palette_png(plot_posterior(drawn, SHOWN, names=CALLED))
            )


if __name__ == "__main__":
    main(
        Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_canyon_noise",
        *map(int, sys.argv[1:]),
    )
