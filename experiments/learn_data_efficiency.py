"""Performance of a learned proposal by number of training runs.

    python -m pfbench.experiments.learn_data_efficiency [case ...]

A proposal is trained for the evidence lower bound with few particles (`train=aesmc`), with the same number and size of updates
for any number of training runs. Few runs are repeated with new random numbers of the filter. There is one epoch, so no choice
among epochs, which would need validation runs. Inference compilation takes the inputs of one run and simulates its episodes from
the model. All proposals are tested on the same other runs. On a navigation scenario the proposals without a network are also
tested with so many particles that they take about the time of the learned ones.

The command resumes from the parts in its folder and writes `report.md`.
"""

from __future__ import annotations

import json
import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from hydra import compose, initialize_config_module
from matplotlib.figure import Figure
from pfbench.experiments.study_parts import crossed_mean_interval

from pfbench.core import PhiloxStream
from pfbench.files import markdown_bullets, markdown_paragraph
from pfbench.filter import (
    BootstrapProposal,
    CubaturePoints,
    DiagonalNormalHead,
    EssResampler,
    EvidenceLowerBound,
    GaussianFilter,
    GuidedNoiseProposal,
    InferenceCompilation,
    LearnedProposal,
    Objective,
    ParticleFilter,
    Proposal,
    SigmaPointLinearisation,
    Systematic,
    TaylorLinearisation,
    run_filter,
)
from pfbench.job import instantiate, register_experiments
from pfbench.learn import Training, draw_training_data, train
from pfbench.model import StateSpaceModel, StochasticVolatility
from pfbench.noise import NominalNoise
from pfbench.report import COLUMN, RC, add_legend, line_styles, render_palette_png
from pfbench.results import holm, wilcoxon_signed_rank
from pfbench.scenario import ModelSimulation, Scenario

MEASURES = {
    "ess": "ESS / N",
    "evidence": "log evidence per step\nminus bootstrap",
    "error": "RMSE relative to\nbootstrap",
}
BOOTSTRAP, COMPILATION, BOUND = "bootstrap", "inference compilation", "lower bound"


@dataclass(frozen=True)
class Case:
    """A scenario and the settings of training and test.

    Args:
        make: Makes the model and the scenario.
        group: Group of the scored error.
        steps: Steps of each record.
        rate: Learning rate.
        counts: Numbers of training runs. A training shows as many as the last; fewer are repeated.
        seeds: Trainings of each number, with other runs, initial weights and random numbers.
        tested: Number of test runs.
        particles: Particles in the tests.
        few: Particles in the trainings.
        segment: Steps through which a gradient passes before an update.
        dearer: Particles of the additional tests at about equal time, by proposal without a network.
    """

    make: Callable[[], tuple[StateSpaceModel, Scenario]]
    group: str
    steps: int
    rate: float
    counts: tuple[int, ...]
    seeds: tuple[int, ...]
    tested: int
    particles: int = 100
    few: int = 8
    segment: int = 5
    dearer: Mapping[str, int] = field(default_factory=dict)


def navigation(name: str) -> tuple[StateSpaceModel, Scenario]:
    """A scenario of the configuration with the model of its filters."""
    register_experiments()
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose("config", [f"scenario={name}"])
    return instantiate(cfg.model), instantiate(cfg.scenario)


def volatility() -> tuple[StateSpaceModel, Scenario]:
    """The state changes the spread of the measurement only, which no linearisation represents."""
    model = StochasticVolatility(mu=-1.0, rho=0.9, sigma=2.0)
    return model, ModelSimulation(model, steps=40)


BY_HAND: dict[str, Callable[[], Proposal]] = {
    BOOTSTRAP: BootstrapProposal,
    "guided by an EKF": lambda: GuidedNoiseProposal(
        GaussianFilter(TaylorLinearisation()), shared_by_particles=True
    ),
    "guided by a CKF": lambda: GuidedNoiseProposal(
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())), shared_by_particles=True
    ),
}
COUNTS = (1, 3, 10, 30, 100, 300)
CASES = {
    "volatility": Case(volatility, "state", 40, 0.004, COUNTS, (1, 2, 3, 4), 200),
    # rate and segment were chosen on other runs; a gradient through five steps was worse
    "azimuth": Case(
        partial(navigation, "azimuth"), "position", 60, 3e-4, COUNTS, (1, 2, 3), 200,
        particles=400, few=100, segment=1, dearer={BOOTSTRAP: 2000, "guided by a CKF": 1000},
    ),
}  # fmt: skip
NETWORK = partial(DiagonalNormalHead, hidden=(32, 32))


def train_proposal(case: Case, count: int, seed: int, objective: Objective, path: Path) -> Proposal:
    """A proposal trained on this number of runs."""
    model, scenario = case.make()
    own = draw_training_data(scenario, [NominalNoise()], model, count, 1000 * seed, case.steps)
    again = torch.arange(case.counts[-1]) % count
    plan = Training(
        objective, EssResampler(Systematic(), 0.5), case.few, gradient_steps=case.segment, epochs=1, batch_size=15,
        learning_rate=case.rate, seed=seed,
    )  # fmt: skip
    path.unlink(missing_ok=True)
    learner = ParticleFilter(
        case.particles, proposal=LearnedProposal(NETWORK, checkpoint=None, seed=seed)
    )
    train(
        plan, learner, model, own.select_runs(again), own.select_runs(again[:15]), path
    )  # the validation runs are unused with one epoch
    return LearnedProposal(NETWORK, checkpoint=str(path))


def evaluate(case: Case, proposal: Proposal, particles: int) -> dict[str, list[float]]:
    """Mean ESS / N, log evidence per step and RMSE by test run, and the processor time [s]."""
    model, scenario = case.make()
    runs = torch.arange(case.tested)
    test = draw_training_data(scenario, [NominalNoise()], model, case.tested, 1, case.steps)
    start = time.process_time()
    with torch.no_grad():
        found = run_filter(
            ParticleFilter(particles, proposal=proposal), model, test.record, PhiloxStream(1, runs)
        )
    spent = time.process_time() - start
    error = model.error(found.mean, test.states)[..., list(model.groups[case.group])]
    values = {
        "ess": found.trace["ess"].mean(1) / particles, "evidence": found.log_evidence / case.steps,
        "error": error.square().sum(-1).mean(1).sqrt(),
    }  # fmt: skip
    return {name: [float(f"{x:.5g}") for x in value] for name, value in values.items()} | {
        "seconds": [spent]
    }


def study(name: str, folder: Path) -> dict[str, Any]:
    """Results of a case, resumed: {"by hand": {proposal: scores}, objective: {count: {seed: scores}}}."""
    case, path = CASES[name], folder / f"{name}.json"
    results: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    kinds = [
        *((BOUND, EvidenceLowerBound(), count) for count in case.counts),
        (COMPILATION, InferenceCompilation(), 1),
    ]
    jobs = [(*kind, seed) for seed in case.seeds for kind in kinds]
    by_hand = [("by hand", kind, case.particles) for kind in BY_HAND]
    for part, kind, particles in (
        *by_hand,
        *(("dearer", kind, n) for kind, n in case.dearer.items()),
    ):
        if kind not in results.setdefault(part, {}):
            results[part][kind] = evaluate(case, BY_HAND[kind](), particles) | {
                "particles": [particles]
            }
            path.write_text(json.dumps(results))
    for kind, objective, count, seed in jobs:
        done = results.setdefault(kind, {}).setdefault(str(count), {})
        if str(seed) in done:
            continue
        start = time.process_time()
        proposal = train_proposal(
            case, count, seed, objective, folder / f"{name}_{kind}_{count}_{seed}.pt"
        )
        spent = time.process_time() - start
        done[str(seed)] = evaluate(case, proposal, case.particles) | {"training": [spent]}
        ess, evidence, error = (np.mean(done[str(seed)][key]) for key in MEASURES)
        print(
            name,
            kind,
            count,
            seed,
            f"ESS/N {ess:.3f}, {evidence:.4f}, {error:.4g}; {spent:.0f} s",
            flush=True,
        )
        path.write_text(json.dumps(results))
    return results


def against(scores: Mapping[str, Any], own: Mapping[str, Any], measure: str) -> np.ndarray:
    """By run: ESS, difference in log evidence to bootstrap, or logarithm of the ratio of errors."""
    a, b = (np.array(part[measure]) for part in (scores, own))
    if measure == "ess":
        return a
    return a - b if measure == "evidence" else np.log(a / b)


def rows(results: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Scores of each training by name: first without a network, then at about equal time, then learned."""
    found = {name: [scores] for name, scores in results["by hand"].items()}
    found |= {
        f"{name}, {scores['particles'][0]} particles": [scores]
        for name, scores in results.get("dearer", {}).items()
    }
    for kind in (COMPILATION, BOUND):
        found |= {
            f"{kind}, {n} run{'s' * (n != '1')}": [*each.values()]
            for n, each in results[kind].items()
        }
    return found


def table(results: Mapping[str, Any], case: Case) -> list[str]:
    """Table of scores; Wilcoxon's paired test over runs against the best ESS without a network."""
    own, hand = results["by hand"][BOOTSTRAP], results["by hand"]
    best = max(hand, key=lambda name: np.mean(hand[name]["ess"]))
    lines = [
        f"| proposal | ESS / N | p, {best} | log evidence per step minus bootstrap | RMSE relative to bootstrap | ms per step | "
        "ESS per ms | training, s |"
    ]
    lines.append("|" + " --- |" * 8)
    for name, parts in rows(results).items():
        cells = []
        for measure in MEASURES:
            each = np.stack([against(scores, own, measure) for scores in parts])
            mean, half = crossed_mean_interval(each)
            ratio = (
                f"{math.exp(mean):.3f} ({math.exp(mean - half):.3f} to {math.exp(mean + half):.3f})"
            )
            cells.append(ratio if measure == "error" else f"{mean:.4f} ± {half:.4f}")
        ess = np.stack([np.array(scores["ess"]) for scores in parts]).mean(0)
        d = ess - np.array(hand[best]["ess"])
        spent = [scores["training"][0] for scores in parts if "training" in scores]
        p = (
            f"{wilcoxon_signed_rank(d)[1]:.1g}, {'above' if d.mean() > 0.0 else 'below'}"
            if spent
            else ""
        )
        ms = (
            1000.0 * float(np.mean([scores["seconds"] for scores in parts])) / case.steps
        )  # of all runs together
        per_ms = float(ess.mean()) * parts[0].get("particles", [case.particles])[0] / ms
        cells = [
            cells[0],
            p,
            *cells[1:],
            f"{ms:.1f}",
            f"{per_ms:.1f}",
            f"{np.mean(spent):.0f}" if spent else "",
        ]
        lines.append(f"| {name} | " + " | ".join(cells) + " |")
    return lines


def verdicts(results: Mapping[str, Any]) -> list[str]:
    """Table of comparisons: inference compilation and the lower bound of most runs against the others.

    The others are the proposals without a network and the lower bound of fewest runs. Ratios of errors are geometric means
    with 95 % intervals over runs and trainings. Wilcoxon's paired tests over runs, of means over trainings, have Holm's
    correction over this table.
    """
    found, cells, raw = rows(results), [], []
    compiled, *bounds = (name for name, parts in found.items() if "training" in parts[0])
    others = [name for name in found if name not in (compiled, *bounds[1:])]
    for name, other in ((name, other) for name in (compiled, bounds[-1]) for other in others):
        pairs = [
            *zip(found[name], cycle(found[other]))
        ]  # trainings of one seed have their first runs in common
        each = {
            key: np.stack([against(*pair, key) for pair in pairs]) for key in ("evidence", "error")
        }
        mean, half = crossed_mean_interval(each["error"])
        ratio = f"{math.exp(mean):.3f} ({math.exp(mean - half):.3f} to {math.exp(mean + half):.3f})"
        raw += [wilcoxon_signed_rank(values.mean(0))[1] for values in each.values()]
        cells.append([name, other, ratio, f"{np.median(each['evidence'].mean(0)):.3f}"])
    adjusted = holm(raw)
    lines = [
        "| learned | other | RMSE, ratio | p | log evidence per step, median difference | p |",
        "|" + " --- |" * 6,
    ]
    for (name, other, ratio, gain), evidence, error in zip(
        cells, adjusted[::2], adjusted[1::2], strict=True
    ):
        lines.append(f"| {name} | {other} | {ratio} | {error:.1g} | {gain} | {evidence:.1g} |")
    return lines


def plot_studies(studies: Mapping[str, Mapping[str, Any]]) -> Figure:
    """A column per case, a row per measure: bands are 95 % intervals, dots are single trainings."""
    style = line_styles([BOUND, COMPILATION, *BY_HAND])
    figure = Figure(figsize=(2 * COLUMN, 0.2 + 1.45 * len(MEASURES)), layout="constrained")
    axes = figure.subplots(len(MEASURES), len(studies), squeeze=False, sharex="col")
    for column, (name, results) in zip(axes.T, studies.items(), strict=True):
        own, counts = results["by hand"][BOOTSTRAP], [int(n) for n in results[BOUND]]
        for axis, (measure, label) in zip(column, MEASURES.items(), strict=True):
            each = [
                np.stack([against(s, own, measure) for s in part.values()])
                for part in results[BOUND].values()
            ]
            scale = np.exp if measure == "error" else np.asarray
            means, halves = np.array([crossed_mean_interval(values) for values in each]).T
            colour = style[BOUND].colour
            axis.fill_between(
                counts,
                scale(means - halves),
                scale(means + halves),
                color=colour,
                alpha=0.2,
                linewidth=0.0,
            )
            axis.plot(
                counts,
                scale(means),
                marker="o",
                markersize=3,
                **style[BOUND].line("trained for the lower bound"),
            )
            for n, values in zip(counts, each, strict=True):
                axis.plot([n] * len(values), scale(values.mean(1)), ".", color=colour, markersize=2)
            level = np.stack(
                [against(s, own, measure) for s in results[COMPILATION]["1"].values()]
            ).mean()
            axis.axhline(scale(level), **style[COMPILATION].line(f"{COMPILATION}, 1 run"))
            for kind, scores in results["by hand"].items():
                axis.axhline(scale(against(scores, own, measure).mean()), **style[kind].line(kind))
            axis.set_xscale("log")
            if axis in axes[:, 0]:
                axis.set_ylabel(label)
        column[0].set_title(name)
        column[-1].set_xticks(counts, [str(n) for n in counts], minor=False)
        column[-1].minorticks_off()
        column[-1].set_xlabel("training runs")
    add_legend(figure, axes[0, 0], columns=3)
    return figure


def describe_comparisons(lines: list[str]) -> list[str]:
    """One line per learned proposal from the table of comparisons, by the ratios of errors."""
    cells = [line.strip("| ").split(" | ") for line in lines[2:]]
    texts = []
    for name in dict.fromkeys(row[0] for row in cells):
        words = ("RMSE smaller than with", "RMSE larger than with", "Inconclusive against")
        groups: dict[str, list[str]] = {word: [] for word in words}
        for _, other, ratio, p, *_ in (row for row in cells if row[0] == name):
            sign = words[0] if float(ratio.split()[0]) < 1.0 else words[1]
            groups[sign if float(p) < 0.05 else words[2]].append(other)
        parts = [f"{word} {'; '.join(others)}." for word, others in groups.items() if others]
        texts.append(f"{name[:1].upper()}{name[1:]}. {' '.join(parts)}")
    return texts


def write_page(studies: Mapping[str, Mapping[str, Any]]) -> str:
    """The page of the study from its stored results."""
    lines = ["# Performance of a learned proposal by number of training runs", ""]
    for name, results in studies.items():
        lines += write_section(name, table(results, CASES[name]), verdicts(results))
    return "\n".join(lines)


def write_section(name: str, scores: list[str], comparisons: list[str]) -> list[str]:
    """The part of the page about one case."""
    case = CASES[name]
    lines = [f"## Scenario `{name}`", ""]
    lines += markdown_paragraph(
        f"`python -m pfbench.experiments.learn_data_efficiency {name}` writes this page. Records have {case.steps} steps. A "
        f"proposal is trained for the evidence lower bound with {case.few} particles. Each training shows {case.counts[-1]} runs "
        f"in batches of 15 for any number of different runs. Each number has {len(case.seeds)} trainings with other "
        "runs, initial weights and random numbers. Inference compilation has as many updates. It simulates its episodes "
        f"from the model with the inputs of one run. All proposals are tested with {case.particles} particles on {case.tested} "
        "other runs. Learning rate and gradient steps were chosen on further runs."
    )
    lines += markdown_paragraph(
        "Means and 95 % intervals are over runs and trainings. The RMSE is that of the position group or of the state, as a "
        "geometric mean of ratios. The p-values are of Wilcoxon's paired test over runs. Times are processor times of all runs "
        "together on a machine with other work."
    )
    lines += [*scores, "", "![Performance by number of training runs](data_efficiency.png)", ""]
    lines += markdown_paragraph(
        f"Comparisons, with Holm's correction over the {2 * len(comparisons[2:])} tests of the table. The difference in log "
        "evidence is the median over runs, because its mean depends on a few runs in which bootstrap loses track."
    )
    lines += [*comparisons, "", *markdown_bullets(*describe_comparisons(comparisons))]
    return lines


def main(folder: Path, *names: str) -> None:
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    studies = {name: study(name, folder) for name in names or CASES}
    (folder / "report.md").write_text(write_page(studies))
    with matplotlib.rc_context(RC):
        (folder / "data_efficiency.png").write_bytes(render_palette_png(plot_studies(studies)))


if __name__ == "__main__":
    main(
        Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_data_efficiency", *sys.argv[1:]
    )
