"""How many worlds does a learned proposal need? Its performance against the number of worlds that it was trained on.

    python -m pfbench.experiments.learn_data_efficiency [world ...]

Trained for the bound with few particles (`train=aesmc`), which looks at nothing but its worlds: as many updates, as large
batches, whatever their number; where there are few, they come again, with new draws of the filter. There is one round and no
choice among epochs, which would need worlds of its own. Inference compilation stands beside it with the inputs of one world: it
imagines new worlds from the model as it goes. All are judged on worlds that none has seen, the same ones, beside the proposals
made by hand, with as many particles; on a navigation world these stand once more with so many that they take the learned one's
time.

What is done is kept in the folder, and the same command goes on from there.
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
from scipy.stats import t as student

from pfbench.core import PhiloxStream
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
from pfbench.job import instantiate
from pfbench.learn import Training, draw_training_data, train
from pfbench.model import StateSpaceModel, StochasticVolatility
from pfbench.noise import NominalNoise
from pfbench.report import COLUMN, RC, add_legend, line_styles, render_palette_png
from pfbench.results import holm, wilcoxon_signed_rank
from pfbench.scenario import ModelSimulation, Scenario

MEASURES = {
    "ess": "ESS / N",
    "evidence": "log evidence of a step\nabove own noise's",
    "error": "rms error over\nown noise's",
}
OWN, IMAGINED = "own noise", "inference compilation"


@dataclass(frozen=True)
class World:
    """A scene to learn in.

    Args:
        make: the model and the scenario.
        group: whose error is told.
        steps: of each record, learning and judging.
        rate: of the training.
        counts: numbers of worlds that are learned from; a training shows as many as the last, fewer again and again.
        seeds: trainings of each, with other worlds, first weights and draws.
        tested: worlds judged on.
        particles: of the filters that are judged.
        few: of those that learn.
        segment: steps through which a gradient passes before an update is made.
        dearer: proposals made by hand that are judged once more, with so many particles as take the learned one's time.
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


def navigation(scene: str) -> tuple[StateSpaceModel, Scenario]:
    """A scene of the configuration with the model that filters are given there."""
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        cfg = compose("config", [f"scenario={scene}"])
    return instantiate(cfg.model), instantiate(cfg.scenario)


def volatility() -> tuple[StateSpaceModel, Scenario]:
    """What is seen tells of the state by its spread alone, of which no linearisation knows."""
    model = StochasticVolatility(mu=-1.0, rho=0.9, sigma=2.0)
    return model, ModelSimulation(model, steps=40)


BY_HAND: dict[str, Callable[[], Proposal]] = {
    OWN: BootstrapProposal,
    "guided by an EKF": lambda: GuidedNoiseProposal(
        GaussianFilter(TaylorLinearisation()), shared_by_particles=True
    ),
    "guided by a CKF": lambda: GuidedNoiseProposal(
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())), shared_by_particles=True
    ),
}
COUNTS = (1, 3, 10, 30, 100, 300)
WORLDS = {
    "volatility": World(volatility, "state", 40, 0.004, COUNTS, (1, 2, 3, 4), 200),
    # rate and segment were chosen on other worlds: a gradient through five steps of a cloud that has lost the azimuth is no help
    "azimuth": World(
        partial(navigation, "azimuth"), "position", 60, 3e-4, COUNTS, (1, 2, 3), 200,
        particles=400, few=100, segment=1, dearer={OWN: 2000, "guided by a CKF": 1000},
    ),
}  # fmt: skip
NETWORK = partial(DiagonalNormalHead, hidden=(32, 32))


def taught(world: World, count: int, seed: int, objective: Objective, path: Path) -> Proposal:
    """What so many worlds have taught."""
    model, scenario = world.make()
    own = draw_training_data(scenario, [NominalNoise()], model, count, 1000 * seed, world.steps)
    again = torch.arange(world.counts[-1]) % count
    plan = Training(
        objective, EssResampler(Systematic(), 0.5), world.few, gradient_steps=world.segment, epochs=1, batch_size=15,
        learning_rate=world.rate, seed=seed,
    )  # fmt: skip
    path.unlink(missing_ok=True)
    pupil = ParticleFilter(
        world.particles, proposal=LearnedProposal(NETWORK, checkpoint=None, seed=seed)
    )
    train(
        plan, pupil, model, own.select_runs(again), own.select_runs(again[:15]), path
    )  # of one epoch there is nothing to choose
    return LearnedProposal(NETWORK, checkpoint=str(path))


def judged(world: World, proposal: Proposal, particles: int) -> dict[str, list[float]]:
    """Of each world that nothing was learned from: mean ESS / N, log evidence of a step, rms error; and s of the processor."""
    model, scenario = world.make()
    runs = torch.arange(world.tested)
    test = draw_training_data(scenario, [NominalNoise()], model, world.tested, 1, world.steps)
    began = time.process_time()
    with torch.no_grad():
        found = run_filter(
            ParticleFilter(particles, proposal=proposal), model, test.record, PhiloxStream(1, runs)
        )
    spent = time.process_time() - began
    error = model.error(found.mean, test.states)[..., list(model.groups[world.group])]
    values = {
        "ess": found.trace["ess"].mean(1) / particles, "evidence": found.log_evidence / world.steps,
        "error": error.square().sum(-1).mean(1).sqrt(),
    }  # fmt: skip
    return {name: [float(f"{x:.5g}") for x in value] for name, value in values.items()} | {
        "seconds": [spent]
    }


def study(name: str, folder: Path) -> dict[str, Any]:
    """All of a world, from where an earlier call stopped: {"by hand": {proposal: scores}, objective: {count: {seed: scores}}}."""
    world, path = WORLDS[name], folder / f"{name}.json"
    told: dict[str, Any] = json.loads(path.read_text()) if path.exists() else {}
    kinds = [
        *(("bound", EvidenceLowerBound(), count) for count in world.counts),
        (IMAGINED, InferenceCompilation(), 1),
    ]
    jobs = [(*kind, seed) for seed in world.seeds for kind in kinds]
    by_hand = [("by hand", kind, world.particles) for kind in BY_HAND]
    for part, kind, particles in (
        *by_hand,
        *(("dearer", kind, n) for kind, n in world.dearer.items()),
    ):
        if kind not in told.setdefault(part, {}):
            told[part][kind] = judged(world, BY_HAND[kind](), particles) | {
                "particles": [particles]
            }
            path.write_text(json.dumps(told))
    for kind, objective, count, seed in jobs:
        done = told.setdefault(kind, {}).setdefault(str(count), {})
        if str(seed) in done:
            continue
        began = time.process_time()
        proposal = taught(
            world, count, seed, objective, folder / f"{name}_{kind}_{count}_{seed}.pt"
        )
        spent = time.process_time() - began
        done[str(seed)] = judged(world, proposal, world.particles) | {"training": [spent]}
        ess, evidence, error = (np.mean(done[str(seed)][key]) for key in MEASURES)
        print(
            name,
            kind,
            count,
            seed,
            f"ESS/N {ess:.3f}, {evidence:.4f}, {error:.4g}; {spent:.0f} s",
            flush=True,
        )
        path.write_text(json.dumps(told))
    return told


def against(scores: Mapping[str, Any], own: Mapping[str, Any], measure: str) -> np.ndarray:
    """Of each world: the ESS itself, the evidence above that of the model's own noise, the logarithm of the errors' ratio."""
    a, b = (np.array(part[measure]) for part in (scores, own))
    if measure == "ess":
        return a
    return a - b if measure == "evidence" else np.log(a / b)


def interval(each: np.ndarray) -> tuple[float, float]:
    """Mean of [trainings, worlds] and half of its 95 % interval, over worlds and over trainings [Satterthwaite 1946]."""
    parts = [
        (each.mean(axis).var(ddof=1), n)
        for axis, n in ((0, each.shape[1]), (1, each.shape[0]))
        if n > 1
    ]
    variance = sum(part / n for part, n in parts)
    freedom = variance**2 / sum((part / n) ** 2 / (n - 1) for part, n in parts) if variance else 1.0
    return float(each.mean()), float(student.ppf(0.975, freedom) * math.sqrt(variance))


def rows(told: Mapping[str, Any]) -> dict[str, list[Any]]:
    """{name: scores of each training}, those made by hand first, with their own number of particles last among these."""
    found = {name: [scores] for name, scores in told["by hand"].items()}
    found |= {
        f"{name}, {scores['particles'][0]} particles": [scores]
        for name, scores in told.get("dearer", {}).items()
    }
    for kind in (IMAGINED, "bound"):
        found |= {
            f"{kind}, {n} world{'s' * (n != '1')}": [*each.values()]
            for n, each in told[kind].items()
        }
    return found


def table(told: Mapping[str, Any], world: World) -> list[str]:
    """Lines of a table in Markdown; p of Wilcoxon's paired test over worlds against the best by hand in ESS."""
    own, hand = told["by hand"][OWN], told["by hand"]
    best = max(hand, key=lambda name: np.mean(hand[name]["ess"]))
    lines = [
        f"| | ESS / N | p, {best} | log evidence of a step above own noise's | rms error over own noise's | ms a step | "
        "ESS per ms | training, s |"
    ]
    lines.append("|" + " --- |" * 8)
    for name, parts in rows(told).items():
        cells = []
        for measure in MEASURES:
            each = np.stack([against(scores, own, measure) for scores in parts])
            mean, half = interval(each)
            ratio = (
                f"{math.exp(mean):.3f} ({math.exp(mean - half):.3f} to {math.exp(mean + half):.3f})"
            )
            cells.append(ratio if measure == "error" else f"{mean:.4f} ± {half:.4f}")
        ess = np.stack([np.array(scores["ess"]) for scores in parts]).mean(0)
        d = ess - np.array(hand[best]["ess"])
        spent = [scores["training"][0] for scores in parts if "training" in scores]
        p = (
            f"{wilcoxon_signed_rank(d).p:.1g}, {'above' if d.mean() > 0.0 else 'below'}"
            if spent
            else ""
        )
        ms = (
            1000.0 * float(np.mean([scores["seconds"] for scores in parts])) / world.steps
        )  # of all runs together
        per_ms = float(ess.mean()) * parts[0].get("particles", [world.particles])[0] / ms
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


def verdicts(told: Mapping[str, Any]) -> list[str]:
    """Lines of a table in Markdown: inference compilation and the bound of most worlds against each proposal made by hand, and
    against the bound of fewest worlds.

    Ratios of errors are geometric means with 95 % intervals over worlds and trainings; p are of Wilcoxon's paired test over
    worlds, of the means over trainings, with Holm's correction over this table.
    """
    found, cells, raw = rows(told), [], []
    compiled, *bounds = (name for name, parts in found.items() if "training" in parts[0])
    others = [name for name in found if name not in (compiled, *bounds[1:])]
    for name, other in ((name, other) for name in (compiled, bounds[-1]) for other in others):
        pairs = [
            *zip(found[name], cycle(found[other]))
        ]  # trainings of one seed have their first worlds in common
        each = {
            key: np.stack([against(*pair, key) for pair in pairs]) for key in ("evidence", "error")
        }
        mean, half = interval(each["error"])
        ratio = f"{math.exp(mean):.3f} ({math.exp(mean - half):.3f} to {math.exp(mean + half):.3f})"
        raw += [wilcoxon_signed_rank(values.mean(0)).p for values in each.values()]
        cells.append([name, other, ratio, f"{np.median(each['evidence'].mean(0)):.3f}"])
    adjusted = holm(raw)
    lines = [
        "| learned | other | rms error, ratio | p | log evidence of a step, median difference | p |",
        "|" + " --- |" * 6,
    ]
    for (name, other, ratio, gain), evidence, error in zip(
        cells, adjusted[::2], adjusted[1::2], strict=True
    ):
        lines.append(f"| {name} | {other} | {ratio} | {error:.1g} | {gain} | {evidence:.1g} |")
    return lines


def picture(studies: Mapping[str, Mapping[str, Any]]) -> Figure:
    """A column for each world, a row for each measure: bars are 95 % intervals, dots single trainings."""
    style = line_styles(["bound", IMAGINED, *BY_HAND])
    figure = Figure(figsize=(2 * COLUMN, 0.2 + 1.45 * len(MEASURES)), layout="constrained")
    axes = figure.subplots(len(MEASURES), len(studies), squeeze=False, sharex="col")
    for column, (name, told) in zip(axes.T, studies.items(), strict=True):
        own, counts = told["by hand"][OWN], [int(n) for n in told["bound"]]
        for axis, (measure, label) in zip(column, MEASURES.items(), strict=True):
            each = [
                np.stack([against(s, own, measure) for s in part.values()])
                for part in told["bound"].values()
            ]
            scale = np.exp if measure == "error" else np.asarray
            means, halves = np.array([interval(values) for values in each]).T
            colour = style["bound"].colour
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
                **style["bound"].line("trained for the bound"),
            )
            for n, values in zip(counts, each, strict=True):
                axis.plot([n] * len(values), scale(values.mean(1)), ".", color=colour, markersize=2)
            level = np.stack(
                [against(s, own, measure) for s in told[IMAGINED]["1"].values()]
            ).mean()
            axis.axhline(scale(level), **style[IMAGINED].line(f"{IMAGINED}, 1 world"))
            for kind, scores in told["by hand"].items():
                axis.axhline(scale(against(scores, own, measure).mean()), **style[kind].line(kind))
            axis.set_xscale("log")
            if axis in axes[:, 0]:
                axis.set_ylabel(label)
        column[0].set_title(name)
        column[-1].set_xticks(counts, [str(n) for n in counts], minor=False)
        column[-1].minorticks_off()
        column[-1].set_xlabel("worlds trained on")
    add_legend(figure, axes[0, 0], columns=3)
    return figure


def main(folder: Path, *names: str) -> None:
    torch.set_num_threads(1)
    folder.mkdir(parents=True, exist_ok=True)
    studies = {name: study(name, folder) for name in names or WORLDS}
    text = "\n".join(
        line
        for name, told in studies.items()
        for line in (f"\n{name}\n", *table(told, WORLDS[name]), "", *verdicts(told))
    )
    (folder / "tables.md").write_text(text + "\n")
    print(text)
    with matplotlib.rc_context(RC):
        (folder / "data_efficiency.png").write_bytes(render_palette_png(picture(studies)))


if __name__ == "__main__":
    main(
        Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_data_efficiency", *sys.argv[1:]
    )
