"""IMU noise of a quadrotor, estimated on five flights by the likelihood of the EKF and tested on the fifteen others.

    PFBENCH_DATA=... python -m pfbench.experiments.learn_quad_noise [draws [warm-up]]

The errors of the position fixes are known, because they are added to the record. The unknown parameters describe the errors of
the IMU under the vibration of the rotors: root densities of gyro and accelerometer, and the walks of their biases. Three sets of
values are compared on other flights: the data sheet, the values of the scenario, which were set by hand, and the posterior
medians. Estimation takes steps of 1 s, tests take steps of 0.2 s. The command resumes from the parts in its folder and writes
`report.md` and its figures.
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
from matplotlib.figure import Figure
from pfbench.experiments.study_parts import ResumableResults
from pyro.distributions import LogNormal, Normal
from scipy.stats import bootstrap
from tqdm import tqdm

from pfbench.core import PhiloxStream
from pfbench.files import markdown_bullets, markdown_head, markdown_paragraph, markdown_row
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    run_filter,
)
from pfbench.job import instantiate, register_experiments
from pfbench.model import StrapdownTotal, StrapdownTuning
from pfbench.noise import NominalNoise
from pfbench.ppl import (
    WELL_MIXED,
    ParameterisedModel,
    ParameterPosterior,
    PmmhSettings,
    plot_posterior,
    pmmh,
)
from pfbench.report import COLUMN, RC, add_legend, line_styles, render_palette_png
from pfbench.results import holm, wilcoxon_signed_rank
from pfbench.scenario import RecordedFlights

ESTIMATION, TEST = (1, 2, 3, 4, 5), tuple(range(6, 21))
# data sheet of a chip of the same family (MTi-1): 0.007 deg/s/sqrt(Hz), 120 ug/sqrt(Hz), without bias walks
SHEET = {
    "gyro_density": math.radians(0.007),
    "accelerometer_density": 120e-6 * 9.81,
}
PRIOR = {
    "gyro_density": LogNormal(math.log(3e-3), 2.0),
    "accelerometer_density": LogNormal(math.log(3e-2), 2.0),
    "gyro_bias_walk": LogNormal(math.log(1e-4), 1.5),
    "accelerometer_bias_walk": LogNormal(math.log(1e-3), 1.5),
}
LABELS = {  # and units
    "gyro_density": ("gyro density", "rad/s/√Hz"),
    "accelerometer_density": ("accelerometer density", "m/s²/√Hz"),
    "gyro_bias_walk": ("gyro bias walk", "rad/s/√s"),
    "accelerometer_bias_walk": ("accelerometer bias walk", "m/s²/√s"),
}
CHAINS = 10
LEAPS = 3  # after each random-walk step of a chain
REPEATS = 3  # of each flight, with other errors of fixes and start


def make_scenario(flights: tuple[int, ...], step: float) -> RecordedFlights:
    register_experiments()
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose(
            "config",
            [
                "scenario=recorded_quad_flights",
                f"scenario.filter_step_s={step}",
                f"scenario.flights={list(flights)}",
            ],
        )
    scenario: RecordedFlights = instantiate(cfg.scenario)
    return scenario


def estimate(draws: int, warmup: int, step: float) -> ParameterPosterior:
    """Posterior by Metropolis-Hastings with the likelihood of an EKF."""
    flights = make_scenario(ESTIMATION, step)
    record = flights.draw(NominalNoise(), torch.arange(len(ESTIMATION)), 1).record
    parameterised = ParameterisedModel(
        lambda **values: StrapdownTotal(replace(flights.tuning, **values)), PRIOR
    )
    with tqdm(
        total=warmup + draws, desc="posterior", unit="iteration", mininterval=10.0, leave=False
    ) as bar:
        return pmmh(
            parameterised, GaussianFilter(TaylorLinearisation()), record, draws, warmup, chains=CHAINS, seed=2,
            settings=PmmhSettings(leaps=LEAPS, tick=lambda *_: bar.update()),
        )  # fmt: skip


def evaluate(tuning: StrapdownTuning) -> dict[str, list[float]]:
    """RMSE, log evidence per fix and share of positions in their 90 % intervals by filter, one value per flight."""
    flights, runs = make_scenario(TEST, 0.2), torch.arange(REPEATS * len(TEST))
    episode, model = flights.draw(NominalNoise(), runs, 11), StrapdownTotal(tuning)
    methods = {
        "ekf": GaussianFilter(TaylorLinearisation()),
        "ckf": GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
    }
    fixes = (~torch.isnan(episode.record.y[..., 0])).sum(1)
    results: dict[str, list[float]] = {}
    for name, method in methods.items():
        with torch.no_grad():
            estimate = run_filter(method, model, episode.record, PhiloxStream(5, runs))
        error = model.error(estimate.mean, model.assemble(episode.truth))
        inside = (error[..., 6:9].abs() < 1.645 * estimate.variance[..., 6:9].sqrt()).double()
        valid_mask = ~torch.isnan(error[..., 6])
        measures = {
            "position": compute_rms(error[..., 6:9], valid_mask),
            "tilt": compute_rms(error[..., :2], valid_mask),
            "yaw": compute_rms(error[..., 2:3], valid_mask),
            "evidence": estimate.log_evidence / fixes,
            "inside": (inside.mean(-1) * valid_mask).sum(1) / valid_mask.sum(1),
        }
        # runs of one flight are not independent, so a flight counts once
        results |= {
            f"{name} {measure}": value.view(REPEATS, -1).mean(0).tolist()
            for measure, value in measures.items()
        }
    return results


def compute_rms(error: torch.Tensor, valid_mask: torch.Tensor) -> torch.Tensor:
    return torch.sqrt((error.square().sum(-1).nan_to_num() * valid_mask).sum(1) / valid_mask.sum(1))


def compare(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Medians over flights of a and b, the interval of the median of their difference, and Wilcoxon's p."""
    d = a - b
    interval = bootstrap(
        (d,), np.median, rng=np.random.default_rng(0), n_resamples=4000, method="percentile"
    ).confidence_interval
    return {
        "a": float(np.median(a)), "b": float(np.median(b)), "difference": float(np.median(d)),
        "low": float(interval.low), "high": float(interval.high), "p": wilcoxon_signed_rank(d)[1],
    }  # fmt: skip


Scores = Mapping[str, Mapping[str, np.ndarray]]  # by set of values, and by filter and measure


def format_plain(x: float, digits: int = 2) -> str:
    """A number with these significant digits and without a power of ten."""
    return np.format_float_positional(float(f"{x:.{digits}g}") if abs(x) > 1e-12 else 0.0, trim="-")


def estimate_timed(draws: int, warmup: int, step: float) -> dict[str, Any]:
    start = time.process_time()
    posterior = estimate(draws, warmup, step)
    return {"posterior": posterior.to_dict(), "seconds": time.process_time() - start}


def posterior_table(posterior: ParameterPosterior, by_hand: StrapdownTuning) -> list[str]:
    names = (
        "parameter",
        "unit",
        "prior, median and 5 to 95 %",
        "posterior, median and 5 to 95 %",
        "width in decades, prior and posterior",
    )
    lines, table = (
        markdown_head(*names, "r-hat", "effective sample size", "by hand", "data sheet"),
        posterior.table(),
    )
    at = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
    for name, (label, unit) in LABELS.items():
        sides = [
            [float(PRIOR[name].icdf(q)) for q in at],
            posterior.pooled_draws(name).quantile(at).tolist(),
        ]
        spans = [
            f"{format_plain(middle)} ({format_plain(low)} to {format_plain(high)})"
            for low, middle, high in sides
        ]
        decades = " and ".join(f"{math.log10(high / low):.1f}" for low, _, high in sides)
        mixing = (f"{table.r_hat[name]:.3f}", f"{table.ess[name]:.0f}")
        sheet = format_plain(SHEET[name]) if name in SHEET else ""
        lines.append(
            markdown_row(
                label, unit, *spans, decades, *mixing, format_plain(getattr(by_hand, name)), sheet
            )
        )
    return lines


def describe_chains(
    posterior: ParameterPosterior, seconds: float, request: Mapping[str, Any]
) -> str:
    """Number, length, cost and convergence of the chains."""
    table, shares = posterior.table(), posterior.accepted
    assert shares is not None
    verdict = (
        "have converged"
        if posterior.has_converged
        else "have not converged, so their intervals are not reliable"
    )
    return (
        f"{CHAINS} chains start from the prior, with {request['draws']} draws after a warm-up of {request['warmup']}, in {seconds / 60.0:.0f} "
        f"minutes of a core. The chains {verdict}: the largest r-hat of split chains is {table.r_hat.max():.3f} (limit "
        f"{WELL_MIXED}), and the smallest effective sample size is {table.ess.min():.0f}. {float(shares.min()):.0%} to "
        f"{float(shares.max()):.0%} of the proposals of a chain are accepted."
    )


MEASURES = {
    "position": "position RMSE, m", "tilt": "roll and pitch RMSE, rad", "yaw": "yaw RMSE, rad", "evidence": "log evidence per fix",
    "inside": "share of true values in 90 % intervals",
}  # fmt: skip


OTHERS = {"hand": "the values set by hand", "sheet": "the data sheet"}


def verdicts(scores: Scores, method: str) -> dict[tuple[str, str], dict[str, float]]:
    """The estimated values against the others by measure, with Holm's correction over all."""
    pairs = [(measure, rival) for measure in MEASURES for rival in OTHERS]
    results = [
        compare(scores["estimated"][f"{method.lower()} {a}"], scores[b][f"{method.lower()} {a}"])
        for a, b in pairs
    ]
    corrected = holm([result["p"] for result in results])
    return {
        pair: result | {"holm": float(p)}
        for pair, result, p in zip(pairs, results, corrected, strict=True)
    }


def scores_table(results: Mapping[tuple[str, str], Mapping[str, float]], method: str) -> list[str]:
    names = (
        method,
        "estimated",
        "by hand",
        "estimated minus by hand",
        "p, Holm",
        "data sheet",
        "estimated minus data sheet",
        "p, Holm",
    )
    lines = markdown_head(*names)
    for measure, label in MEASURES.items():
        cells = []
        for rival in OTHERS:
            v = results[measure, rival]
            span = f"{format_plain(v['difference'])} ({format_plain(v['low'])} to {format_plain(v['high'])})"
            cells += [f"{v['b']:#.4g}", span, f"{v['p']:.1g}, {v['holm']:.1g}"]
        lines.append(markdown_row(label, f"{results[measure, 'hand']['a']:#.4g}", *cells))
    return lines


def describe_decisions(results: Mapping[tuple[str, str], Mapping[str, float]], method: str) -> str:
    """Significant differences of one filter."""
    parts = []
    for rival, label in OTHERS.items():
        names = [
            MEASURES[measure].split(",")[0]
            for measure in MEASURES
            if results[measure, rival]["holm"] < 0.05
        ]
        least = min(results[measure, rival]["holm"] for measure in MEASURES)
        parts.append(
            f"Against {label}, significant differences: {', '.join(names) or 'none'} (smallest corrected p {least:.1g})."
        )
    return f"{method}. {' '.join(parts)}"


CAVEATS = (
    "Choices of this project: the priors, the flights of the estimation, the repeats of each flight, and the number of leaps of "
    "`pmmh` after each step. The prior medians of the densities lie between data sheet and values set by hand. Those of the bias "
    "walks are the values set by hand.",
    "The errors of the fixes are simulated, and their size is known to the filter. The study does not cover unknown sizes.",
    "The data sheet is that of the MTi-1, a chip of the same family. That of the unit was not available. It states no bias "
    "walks, so the values set by hand are used.",
    "Filters run with the posterior medians. They do not average over the posterior. The likelihood is that of an EKF.",
    "The twenty flights are of one vehicle with one unit in one area. The p-values are of fifteen flights.",
)


def read_scores(done: Mapping[str, Any]) -> Scores:
    """Scores by set of values, from the stored parts."""
    return {
        name.removeprefix("scores: "): {
            measure: np.array(values) for measure, values in scores.items()
        }
        for name, scores in done.items()
        if name.startswith("scores: ")
    }


def write_page(request: Mapping[str, Any], done: Mapping[str, Any]) -> str:
    """The page of the study from its stored results."""
    posterior = ParameterPosterior.from_dict(done["posterior"]["posterior"])
    seconds, scores = done["posterior"]["seconds"], read_scores(done)
    first, last = TEST[0], TEST[-1]
    lines = ["# IMU noise of a quadrotor, estimated on five flights and tested on fifteen", ""]
    lines += markdown_paragraph(
        f"`python -m pfbench.experiments.learn_quad_noise {request['draws']} {request['warmup']}` writes this page. The twenty "
        "flights of `recorded_quad_flights` have a consumer IMU (Xsens DOT) near the rotors, and one fix per second with an "
        f"added error of 1 m per axis. The errors of the IMU are estimated from flights {ESTIMATION[0]} to {ESTIMATION[-1]}, by "
        f"the likelihood of the EKF, in steps of {request['step']:g} s. Filters then run with the posterior medians on flights "
        f"{first} to {last} in steps of 0.2 s. Two other sets of values are those of the scenario, which were set by hand, and "
        "those of a data sheet."
    )
    tuning = make_scenario(TEST, 0.2).tuning
    lines += ["## Posterior", "", *posterior_table(posterior, tuning), ""]
    lines += markdown_paragraph(
        "Intervals are from 5 to 95 %. A posterior that is hardly narrower than its prior shows that the flights contain little "
        "information on the parameter."
    )
    lines += markdown_paragraph(describe_chains(posterior, seconds, request))
    lines += ["![Chains and densities](posterior.png)", "", "## Test on the other flights", ""]
    lines += markdown_paragraph(
        f"Medians over the {len(TEST)} flights. Each flight is repeated {REPEATS} times with other errors of the fixes and of "
        "the start, and averaged. Differences are medians over flights with their 95 % bootstrap interval. The p-values are of "
        "Wilcoxon's test, without and with Holm's correction over the ten tests of a table."
    )
    for method in ("EKF", "CKF"):
        results = verdicts(scores, method)
        lines += [*scores_table(results, method), ""]
        lines += markdown_paragraph(describe_decisions(results, method))
    lines += ["![Differences by flight](flights.png)", ""]
    lines += markdown_paragraph(
        "Left: below 0 the estimated values are better. Right: above 0 they are better."
    )
    return "\n".join([*lines, "## Choices and limits", "", *markdown_bullets(*CAVEATS)])


def plot_decades(posterior: ParameterPosterior) -> Figure:
    """Traces and densities of the decimal logarithms."""
    decades = replace(posterior, draws={name: a.log10() for name, a in posterior.draws.items()})
    prior = {
        name: Normal(d.loc / math.log(10.0), d.scale / math.log(10.0)) for name, d in PRIOR.items()
    }
    names = {name: f"{label},\nlog₁₀ {unit}" for name, (label, unit) in LABELS.items()}
    return plot_posterior({"posterior": decades}, prior, names=names)


def plot_differences(scores: Scores) -> Figure:
    """Differences of the EKF's position error and evidence, flight by flight."""
    labels = {"estimated minus by hand": "hand", "estimated minus data sheet": "sheet"}
    style = line_styles(list(labels))
    figure = Figure(figsize=(2 * COLUMN, 2.2), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, (measure, label_y) in zip(
        axes, {"position": "position RMSE", "evidence": "log evidence per fix"}.items(), strict=True
    ):
        differences = {
            label: scores["estimated"][f"ekf {measure}"] - scores[rival][f"ekf {measure}"]
            for label, rival in labels.items()
        }
        order = np.argsort(differences["estimated minus by hand"])
        for label, d in differences.items():
            look = style[label]
            axis.plot(
                range(1, len(d) + 1),
                d[order],
                look.marker,
                color=look.colour,
                markersize=4,
                label=label,
            )
        axis.axhline(0.0, color="0.4", linewidth=0.8)
        axis.set_xlabel("flights, ordered by the circles")
        axis.set_ylabel(f"difference of\n{label_y}" + (", m" if measure == "position" else ""))
    add_legend(figure, axes[0])
    return figure


def main(folder: Path, draws: int = 400, warmup: int = 200, step: float = 1.0) -> None:
    torch.set_num_threads(1)
    request = {"draws": draws, "warmup": warmup, "step": step, "chains": CHAINS, "leaps": LEAPS}
    results = ResumableResults(folder / "learn_quad_noise.json", request)
    stored = results("posterior", partial(estimate_timed, draws, warmup, step))
    posterior = ParameterPosterior.from_dict(stored["posterior"])
    by_hand = make_scenario(TEST, 0.2).tuning
    print(posterior.table().to_string(), flush=True)
    medians = {name: float(posterior.pooled_draws(name).median()) for name in PRIOR}
    tunings = {
        "sheet": replace(by_hand, **SHEET),
        "hand": by_hand,
        "estimated": replace(by_hand, **medians),
    }
    bar = tqdm(tunings.items(), desc="flights", unit="set", leave=False)
    for name, tuning in bar:
        results(f"scores: {name}", partial(evaluate, tuning))
    done = results.state["done"]
    (folder / "report.md").write_text(write_page(request, done))
    with matplotlib.rc_context(RC):
        (folder / "posterior.png").write_bytes(render_palette_png(plot_decades(posterior)))
        differences = plot_differences(read_scores(done))
        (folder / "flights.png").write_bytes(render_palette_png(differences))


if __name__ == "__main__":
    main(
        Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_quad_noise",
        *map(int, sys.argv[1:]),
    )
