"""Noise of a quadrotor's IMU, learned on five flights through the EKF's likelihood, and tried on the fifteen others.

    PFBENCH_DATA=... python -m pfbench.experiments.learn_quad_noise [draws [warm-up]]

The receiver's errors are known (they are added to the record); what is unknown is what the IMU's errors amount to under the
vibration of the rotors: root densities of gyro and accelerometer and the walks of their biases. Three sets of numbers are
compared on flights from which nothing was learned: the data sheet's, those of the scene's yaml, which were set by hand, and the
posterior's medians. Learning takes steps of 1 s, whose evidence is that of 0.2 s to 0.03 in 985; trying takes 0.2 s. What is
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
from matplotlib.figure import Figure
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
from pfbench.job import ResumableResults, instantiate
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

LEARNED_ON, TRIED_ON = (1, 2, 3, 4, 5), tuple(range(6, 21))
# of the maker's chip in this class (MTi-1): 0.007 deg/s/sqrt(Hz), 120 ug/sqrt(Hz); of bias walks it says nothing
SHEET = {
    "gyro_density": math.radians(0.007),
    "accelerometer_density": 120e-6 * 9.81,
}
PRIOR = {  # two orders of magnitude either way
    "gyro_density": LogNormal(math.log(3e-3), 2.0),
    "accelerometer_density": LogNormal(math.log(3e-2), 2.0),
    "gyro_bias_walk": LogNormal(math.log(1e-4), 1.5),
    "accelerometer_bias_walk": LogNormal(math.log(1e-3), 1.5),
}
CALLED = {  # and the unit
    "gyro_density": ("gyro density", "rad/s/√Hz"),
    "accelerometer_density": ("accelerometer density", "m/s²/√Hz"),
    "gyro_bias_walk": ("gyro bias walk", "rad/s/√s"),
    "accelerometer_bias_walk": ("accelerometer bias walk", "m/s²/√s"),
}
CHAINS = 10
LEAPS = 3  # after each step of the walk
AGAIN = 3  # times that each flight is flown with new errors of receiver and start


def scene(flights: tuple[int, ...], step: float) -> RecordedFlights:
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


def learned(draws: int, warmup: int, step: float) -> ParameterPosterior:
    """The posterior, by Metropolis-Hastings on the likelihood of an EKF."""
    flights = scene(LEARNED_ON, step)
    record = flights.draw(NominalNoise(), torch.arange(len(LEARNED_ON)), 1).record
    unknown = ParameterisedModel(
        lambda **values: StrapdownTotal(replace(flights.tuning, **values)), PRIOR
    )
    with tqdm(
        total=warmup + draws, desc="posterior", unit="iteration", mininterval=10.0, leave=False
    ) as bar:
        return pmmh(
            unknown, GaussianFilter(TaylorLinearisation()), record, draws, warmup, chains=CHAINS, seed=2,
            settings=PmmhSettings(leaps=LEAPS, tick=bar.update),
        )  # fmt: skip


def tried(believed: StrapdownTuning) -> dict[str, list[float]]:
    """Per flight: rms errors, log evidence for each fix and share of positions in their 90 % intervals, by filter."""
    flights, runs = scene(TRIED_ON, 0.2), torch.arange(AGAIN * len(TRIED_ON))
    world, model = flights.draw(NominalNoise(), runs, 11), StrapdownTotal(believed)
    methods = {
        "ekf": GaussianFilter(TaylorLinearisation()),
        "ckf": GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
    }
    fixes = (~torch.isnan(world.record.y[..., 0])).sum(1)
    found = {}
    for name, method in methods.items():
        with torch.no_grad():
            estimate = run_filter(method, model, world.record, PhiloxStream(5, runs))
        error = model.error(estimate.mean, model.assemble(world.truth))
        inside = (error[..., 6:9].abs() < 1.645 * estimate.variance[..., 6:9].sqrt()).double()
        known = ~torch.isnan(error[..., 6])
        parts = {
            "position": _rms(error[..., 6:9], known), "tilt": _rms(error[..., :2], known), "yaw": _rms(error[..., 2:3], known),
            "evidence": estimate.log_evidence / fixes, "inside": (inside.mean(-1) * known).sum(1) / known.sum(1),
        }  # fmt: skip
        # runs of one flight are no independent cases: a flight counts once
        found |= {
            f"{name} {part}": value.view(AGAIN, -1).mean(0).tolist()
            for part, value in parts.items()
        }
    return found


def _rms(error: torch.Tensor, known: torch.Tensor) -> torch.Tensor:
    return torch.sqrt((error.square().sum(-1).nan_to_num() * known).sum(1) / known.sum(1))


def compared(a: np.ndarray, b: np.ndarray) -> dict[str, float]:
    """Medians over flights of a and b, the interval of the median of their difference, and Wilcoxon's p."""
    d = a - b
    interval = bootstrap(
        (d,), np.median, rng=np.random.default_rng(0), n_resamples=4000, method="percentile"
    ).confidence_interval
    return {
        "a": float(np.median(a)), "b": float(np.median(b)), "difference": float(np.median(d)),
        "low": float(interval.low), "high": float(interval.high), "p": wilcoxon_signed_rank(d).p,
    }  # fmt: skip


Scores = Mapping[str, Mapping[str, np.ndarray]]  # by set of numbers, and by filter and measure


def plain(x: float, digits: int = 2) -> str:
    """So many digits, and no power of ten; what rounding leaves of nothing is nothing."""
    return np.format_float_positional(float(f"{x:.{digits}g}") if abs(x) > 1e-12 else 0.0, trim="-")


def told(draws: int, warmup: int, step: float) -> dict[str, Any]:
    began = time.process_time()
    posterior = learned(draws, warmup, step)
    return {"posterior": posterior.to_dict(), "seconds": time.process_time() - began}


def learned_table(posterior: ParameterPosterior, by_hand: StrapdownTuning) -> list[str]:
    names = (
        "number",
        "unit",
        "prior, median and 5 to 95 %",
        "posterior, median and 5 to 95 %",
        "decades, prior and posterior",
    )
    lines, table = (
        markdown_head(*names, "r-hat", "effective size", "by hand", "maker's"),
        posterior.table(),
    )
    at = torch.tensor([0.05, 0.5, 0.95], dtype=torch.float64)
    for name, (called, unit) in CALLED.items():
        sides = [
            [float(PRIOR[name].icdf(q)) for q in at],
            posterior.pooled_draws(name).quantile(at).tolist(),
        ]
        spans = [f"{plain(middle)} ({plain(low)} to {plain(high)})" for low, middle, high in sides]
        decades = " and ".join(f"{math.log10(high / low):.1f}" for low, _, high in sides)
        met = (f"{table.r_hat[name]:.3f}", f"{table.ess[name]:.0f}")
        sheet = plain(SHEET[name]) if name in SHEET else ""
        lines.append(
            markdown_row(called, unit, *spans, decades, *met, plain(getattr(by_hand, name)), sheet)
        )
    return lines


def of_chains(posterior: ParameterPosterior, seconds: float, asked: Mapping[str, Any]) -> str:
    """What is to be thought of the chains."""
    table, shares = posterior.table(), posterior.accepted
    assert shares is not None
    verdict = (
        "have met"
        if posterior.has_converged
        else "have not met, so that widths are not to be relied on"
    )
    return (
        f"{CHAINS} chains from the prior, {asked['draws']} draws each after {asked['warmup']}; {seconds / 60.0:.0f} minutes of a "
        f"core. They {verdict}: the largest r-hat is {table.r_hat.max():.3f} (of chains split in halves; {WELL_MIXED} is the "
        f"bound), the least effective size {table.ess.min():.0f}; {float(shares.min()):.0%} to {float(shares.max()):.0%} of a "
        "chain's proposals are accepted."
    )


MEASURES = {
    "position": "position rms, m", "tilt": "roll and pitch rms, rad", "yaw": "yaw rms, rad", "evidence": "log evidence of a fix",
    "inside": "share in 90 % intervals",
}  # fmt: skip


OTHERS = {"hand": "the values set by hand", "sheet": "the maker's"}


def verdicts(scores: Scores, method: str) -> dict[tuple[str, str], dict[str, float]]:
    """The learned numbers against the others by measure, with Holm's correction over the whole."""
    pairs = [(part, other) for part in MEASURES for other in OTHERS]
    found = [
        compared(scores["learned"][f"{method.lower()} {a}"], scores[b][f"{method.lower()} {a}"])
        for a, b in pairs
    ]
    corrected = holm([each["p"] for each in found])
    return {
        pair: each | {"holm": float(p)}
        for pair, each, p in zip(pairs, found, corrected, strict=True)
    }


def scores_table(found: Mapping[tuple[str, str], Mapping[str, float]], method: str) -> list[str]:
    names = (
        method,
        "learned",
        "by hand",
        "learned less by hand",
        "p, Holm",
        "maker's",
        "learned less maker's",
        "p, Holm",
    )
    lines = markdown_head(*names)
    for part, label in MEASURES.items():
        cells = []
        for other in OTHERS:
            v = found[part, other]
            span = f"{plain(v['difference'])} ({plain(v['low'])} to {plain(v['high'])})"
            cells += [f"{v['b']:#.4g}", span, f"{v['p']:.1g}, {v['holm']:.1g}"]
        lines.append(markdown_row(label, f"{found[part, 'hand']['a']:#.4g}", *cells))
    return lines


def said(found: Mapping[tuple[str, str], Mapping[str, float]], method: str) -> str:
    """Which of the differences are shown."""
    parts = []
    for other, called in OTHERS.items():
        shown = [
            MEASURES[part].split(",")[0] for part in MEASURES if found[part, other]["holm"] < 0.05
        ]
        what = f"differences are shown in {', '.join(shown)}" if shown else "no difference is shown"
        least = min(found[part, other]["holm"] for part in MEASURES)
        parts.append(f"against {called} {what} (least corrected p {least:.1g})")
    return f"{method}: {'; '.join(parts)}."


CAVEATS = (
    "Ours: the priors, with medians of densities between the maker's and those set by hand, and of walks equal to the latter; "
    "which flights are learned on; three flights through of each, averaged before anything is tested; three leaps after each "
    "step of the chains' walk (`leaps` of `pmmh`).",
    "The receiver's errors are drawn and their size is known to the filter. Nothing here says what is learned where it is not.",
    "The maker's numbers are those of the MTi-1, a chip of the same family: the data sheet of the unit flown was not at hand. "
    "Its walks of biases are those set by hand.",
    "Filters run with the posterior's medians, not with the average over its draws. The likelihood is an EKF's.",
    "Twenty flights of one vehicle with one unit at one place; p are of fifteen flights.",
)


def report(
    posterior: ParameterPosterior, scores: Scores, seconds: float, asked: Mapping[str, Any]
) -> list[str]:
    first, last = TRIED_ON[0], TRIED_ON[-1]
    lines = ["# Noise of a quadrotor's IMU, learned on five flights and tried on fifteen", ""]
    lines += markdown_paragraph(
        f"`python -m pfbench.experiments.learn_quad_noise {asked['draws']} {asked['warmup']}` writes this page. Twenty flights "
        "of `recorded_quad_flights` carry a consumer IMU (Xsens DOT) beside rotors that shake it, and fixes once a second with 1 m of "
        f"added error per axis. What the IMU's errors amount to is inferred from flights {LEARNED_ON[0]} to {LEARNED_ON[-1]}, "
        f"through the EKF's likelihood, in steps of {asked['step']:g} s; filters then run with the posterior's medians on "
        f"flights {first} to {last} in steps of 0.2 s, against the values set by hand, which the scene's yaml holds, and the "
        "maker's."
    )
    lines += ["## What was learned", "", *learned_table(posterior, scene(TRIED_ON, 0.2).tuning), ""]
    lines += markdown_paragraph(of_chains(posterior, seconds, asked))
    lines += markdown_paragraph(
        "Decades are the width of the interval from 5 to 95 %, as powers of ten: where the posterior's is hardly less than the "
        "prior's, the flights said little. Fixes of 1 m bound noise from above; below the median it is the prior that speaks."
    )
    lines += [
        "![Chains and densities](posterior.png)",
        "",
        "## What it is worth on the other flights",
        "",
    ]
    lines += markdown_paragraph(
        f"Medians over the {len(TRIED_ON)} flights, each flown {AGAIN} times with new errors of receiver and start and averaged; "
        "differences are medians over flights with their 95 % interval (bootstrap); p of Wilcoxon's test, then with Holm's "
        "correction over the ten of a table."
    )
    for method in ("EKF", "CKF"):
        found = verdicts(scores, method)
        lines += [*scores_table(found, method), "", *markdown_paragraph(said(found, method))]
    lines += ["![Differences, flight by flight](flights.png)", ""]
    lines += markdown_paragraph("Left, below 0 the learned numbers are better; right, above 0.")
    return [*lines, "## What is chosen, and what is not shown", "", *markdown_bullets(*CAVEATS)]


def in_decades(posterior: ParameterPosterior) -> Figure:
    """Traces and densities of the numbers' powers of ten."""
    drawn = replace(posterior, draws={name: a.log10() for name, a in posterior.draws.items()})
    prior = {
        name: Normal(law.loc / math.log(10.0), law.scale / math.log(10.0))
        for name, law in PRIOR.items()
    }
    names = {name: f"{called},\nlog₁₀ {unit}" for name, (called, unit) in CALLED.items()}
    return plot_posterior({"posterior": drawn}, prior, names=names)


def flown(scores: Scores) -> Figure:
    """Differences of the EKF's position error and evidence, flight by flight."""
    labels = {"learned less by hand": "hand", "learned less maker's": "sheet"}
    style = line_styles(list(labels))
    figure = Figure(figsize=(2 * COLUMN, 2.2), layout="constrained")
    axes = figure.subplots(1, 2)
    for axis, (part, what) in zip(
        axes, {"position": "position rms", "evidence": "log evidence of a fix"}.items(), strict=True
    ):
        differences = {
            label: scores["learned"][f"ekf {part}"] - scores[other][f"ekf {part}"]
            for label, other in labels.items()
        }
        order = np.argsort(differences["learned less by hand"])
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
        axis.set_xlabel("flights, in the order of the circles")
        axis.set_ylabel(f"difference of\n{what}" + (", m" if part == "position" else ""))
    add_legend(figure, axes[0])
    return figure


def main(folder: Path, draws: int = 400, warmup: int = 200, step: float = 1.0) -> None:
    torch.set_num_threads(1)
    asked = {"draws": draws, "warmup": warmup, "step": step, "chains": CHAINS, "leaps": LEAPS}
    pieces = ResumableResults(folder / "learn_quad_noise.json", asked)
    kept = pieces("posterior", partial(told, draws, warmup, step))
    posterior, by_hand = (
        ParameterPosterior.from_dict(kept["posterior"]),
        scene(TRIED_ON, 0.2).tuning,
    )
    print(posterior.table().to_string(), flush=True)
    middle = {name: float(posterior.pooled_draws(name).median()) for name in PRIOR}
    sets = {
        "sheet": replace(by_hand, **SHEET),
        "hand": by_hand,
        "learned": replace(by_hand, **middle),
    }
    bar = tqdm(sets.items(), desc="flights", unit="set", leave=False)
    found = {name: pieces(f"scores: {name}", partial(tried, believed)) for name, believed in bar}
    scores = {
        name: {part: np.array(values) for part, values in each.items()}
        for name, each in found.items()
    }
    text = "\n".join(report(posterior, scores, kept["seconds"], asked))
    print(text)
    (folder / "report.md").write_text(text)
    with matplotlib.rc_context(RC):
        (folder / "posterior.png").write_bytes(render_palette_png(in_decades(posterior)))
        (folder / "flights.png").write_bytes(render_palette_png(flown(scores)))


if __name__ == "__main__":
    main(
        Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_quad_noise",
        *map(int, sys.argv[1:]),
    )
