"""KalmanNet, learned proposals and Gaussian filters on the same training runs.

    python -m pfbench.experiments.learn_gain [test runs [trainings]]

Each network is trained on few and on many runs of the world in which it is tested, with the same number of updates. The factors
of a scaled EKF are chosen on the same training runs. All filters are tested on the same other runs. The command resumes from the
parts in its folder and writes `report.md`.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import torch
from hydra import compose, initialize_config_module
from matplotlib.figure import Figure
from pfbench.experiments.study_parts import ResumableResults, crossed_mean_interval

from pfbench.core import PhiloxStream
from pfbench.files import markdown_bullets, markdown_head, markdown_paragraph, markdown_row
from pfbench.filter import (
    DiagonalNormalHead,
    EssResampler,
    EvidenceLowerBound,
    GaussianFilter,
    LearnedGain,
    LearnedGainFilter,
    LearnedProposal,
    NormalMixtureHead,
    ParticleFilter,
    ScaledNoise,
    SkipMlp,
    StateErrorLoss,
    Systematic,
    TaylorLinearisation,
    run_filter,
)
from pfbench.job import instantiate, register_experiments
from pfbench.learn import Training, draw_training_data, train
from pfbench.model import StateSpaceModel
from pfbench.report import COLUMN, RC, line_styles, render_palette_png
from pfbench.results import holm, wilcoxon_signed_rank

WORLDS = ("linear_walk, nominal", "linear_walk, outliers")
OTHER_WORLDS = ("growth, nominal", "stochastic_volatility, nominal")  # of learned proposals only
COUNTS = (4, 64)  # training runs
SHOWN = 320  # runs that each training shows, in batches of 16
PARTICLES = 100
BY_HAND = ("ekf", "ukf", "gate", "student", "ekf_scaled_tuned", "sir")
DEARER = (400, 1600)  # particles of SIR at about equal time
SCALED, REFERENCE = "ekf_scaled, same runs", "ekf"
FACTORS = [(r, q) for r in (1.0, 2.0, 4.0, 8.0, 16.0) for q in (0.25, 1.0, 4.0)]  # of R and Q
LEVEL = 0.05


def gain(normalisation: str, checkpoint: str | None, seed: int = 0) -> LearnedGainFilter:
    head = partial(SkipMlp, hidden=(32,))
    return LearnedGainFilter(LearnedGain(head, 32, normalisation, checkpoint, seed))


def proposal(head: Any, checkpoint: str | None, seed: int = 0) -> ParticleFilter:
    return ParticleFilter(
        PARTICLES, proposal=LearnedProposal(head, checkpoint=checkpoint, seed=seed)
    )


ERROR = Training(StateErrorLoss(), epochs=1, gradient_steps=20, batch_size=16, learning_rate=0.02)
BOUND = Training(
    EvidenceLowerBound(), EssResampler(Systematic(), 1.0), 8, epochs=1, gradient_steps=5, batch_size=16, learning_rate=0.004
)  # fmt: skip
LEARNED: dict[str, tuple[Training, Callable[..., Any]]] = {
    "kalman_net": (ERROR, partial(gain, "length")),
    "kalman_net, asinh": (ERROR, partial(gain, "asinh")),
    "neural_sir": (BOUND, partial(proposal, partial(DiagonalNormalHead, hidden=(32, 32)))),
    "neural_mixture": (BOUND, partial(proposal, partial(NormalMixtureHead, hidden=(32, 32)))),
}
NETWORKS = ("kalman_net", "kalman_net, asinh", "neural_sir")  # in the first worlds
PROPOSALS = ("neural_sir", "neural_mixture")  # in the other worlds, with most training runs


def build(world: str, method: str = "sir", particles: int = PARTICLES) -> Any:
    """The configuration of a filter in a world."""
    scenario, noise = world.split(", ")
    words = [f"scenario={scenario}", f"noise={noise}", f"filter={method}", f"particles={particles}"]
    words += ["tuned=flight_500s_with_ins_gnss_inflated"]  # another world, as the page says
    register_experiments()
    with initialize_config_module("pfbench.conf", version_base="1.3"):
        return compose("config", words)


def draw(world: str, runs: int, seed: int) -> tuple[StateSpaceModel, Any]:
    """The model of the filters, and runs with their true states."""
    cfg = build(world)
    model = instantiate(cfg.model)
    regimes = [instantiate(cfg.noise)]
    return model, draw_training_data(instantiate(cfg.scenario), regimes, model, runs, seed, None)


def evaluate(world: str, method: Any, runs: int, seed: int = 1) -> dict[str, list[float]]:
    """RMSE of the first component by run, infinite if the run is lost, and processor time per step [s]."""
    model, data = draw(world, runs, seed)
    start = time.process_time()
    with torch.no_grad():
        found = run_filter(method, model, data.record, PhiloxStream(seed, torch.arange(runs)))
    spent = (time.process_time() - start) / data.record.y.shape[1]
    error = model.error(found.mean, data.states)[..., 0].square().mean(1).sqrt()
    error = torch.where(found.lost, torch.inf, error)
    return {"error": [float(f"{x:.5g}") for x in error], "seconds": [spent]}


def train_network(world: str, name: str, count: int, seed: int, path: Path) -> Any:
    """A filter with a network trained on this number of runs."""
    plan, make = LEARNED[name]
    model, data = draw(world, count, 1000 * seed)
    again = torch.arange(SHOWN) % count
    path.unlink(missing_ok=True)
    shown, unused = data.select_runs(again), data.select_runs(again[:2])  # one epoch: no choice
    train(plan, make(None, seed=seed), model, shown, unused, path)
    return make(str(path))


def choose_factors(world: str, count: int, seed: int) -> GaussianFilter:
    """The EKF with the factors on R and Q that have the smallest median RMSE in the training runs."""
    filters = [
        GaussianFilter(TaylorLinearisation(), noise_adaptations=[ScaledNoise(r, q)])
        for r, q in FACTORS
    ]
    errors = [np.median(evaluate(world, f, count, 1000 * seed)["error"]) for f in filters]
    return filters[int(np.argmin(errors))]


def compute_training(
    world: str, name: str, count: int, seed: int, runs: int, path: Path
) -> dict[str, list[float]]:
    start = time.process_time()
    if name == SCALED:
        method: Any = choose_factors(world, count, seed)
    else:
        method = train_network(world, name, count, seed, path)
    spent = time.process_time() - start
    return evaluate(world, method, runs) | {"training": [spent]}


def collect(world: str, done: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Scores of each training in a world, by filter and number of training runs."""
    found: dict[str, list[Any]] = {}
    for key, scores in done.items():
        place, name, *rest = key.split("; ")
        if place == world:
            label = f"{name}, {rest[0]} runs" if rest else name
            found.setdefault(label, []).append(scores)
    return found


def compare(parts: list[Any], others: list[Any]) -> tuple[float, float, float]:
    """Mean log ratio of errors, half of its 95 % interval, and Wilcoxon's p over test runs."""
    each = np.stack([
        np.log(np.array(a["error"]) / np.array(others[i % len(others)]["error"]))
        for i, a in enumerate(parts)
    ])  # fmt: skip
    return *crossed_mean_interval(each), wilcoxon_signed_rank(each.mean(0))[1]


def decide(mean: float, half: float, p: float) -> str:
    """Decision on a log ratio: the interval, over runs and trainings, excludes 0, and so does the test."""
    if p >= LEVEL or abs(mean) <= half:
        return "inconclusive"
    return "smaller" if mean < 0.0 else "larger"


def list_ratios(done: Mapping[str, Any]) -> dict[tuple[str, str], list[Any]]:
    """Ratio to the EKF of each other filter in each world: mean, half interval, Holm's p, scores."""
    rows: dict[tuple[str, str], list[Any]] = {}
    for world in WORLDS:
        found = collect(world, done)
        for name in [name for name in found if name != REFERENCE]:
            rows[world, name] = [*compare(found[name], found[REFERENCE]), found[name]]
    adjusted = holm([row[2] for row in rows.values()])
    return {
        key: [*row[:2], p, row[3]] for (key, row), p in zip(rows.items(), adjusted, strict=True)
    }


def format_ratio(mean: float, half: float) -> str:
    return f"{math.exp(mean):.3f} ({math.exp(mean - half):.3f} to {math.exp(mean + half):.3f})"


def table(done: Mapping[str, Any]) -> list[str]:
    """Table of the ratios, with time per step and of the training."""
    lines = markdown_head(
        "world",
        "filter",
        "RMSE relative to `ekf`",
        "p, Holm",
        "ms per step, all runs",
        "training, s",
    )
    for (world, name), (mean, half, p, parts) in list_ratios(done).items():
        ms = 1000.0 * np.mean([scores["seconds"] for scores in parts])
        spent = [scores["training"][0] for scores in parts if "training" in scores]
        cells = (f"{p:.2g}", f"{ms:.2f}", f"{np.mean(spent):.0f}" if spent else "")
        lines.append(markdown_row(world, name, format_ratio(mean, half), *cells))
    return lines


def describe_pairs(done: Mapping[str, Any]) -> list[str]:
    """KalmanNet of most runs against three rivals, by world."""
    last = f"{COUNTS[-1]} runs"
    rivals = (f"{SCALED}, {last}", f"neural_sir, {last}", "gate")
    rows = []
    for world, name in product(WORLDS, ("kalman_net", "kalman_net, asinh")):
        found = collect(world, done)
        for other in rivals:
            rows.append((world, name, other, *compare(found[f"{name}, {last}"], found[other])))
    texts = []
    for (world, name, other, mean, half, _), p in zip(
        rows, holm([row[-1] for row in rows]), strict=True
    ):
        word = decide(mean, half, p)
        ratio = format_ratio(mean, half)
        texts.append(
            f"{world}, `{name}` against `{other}`: {word}, ratio {ratio}, corrected p {p:.2g}."
        )
    return texts


def list_equal_time(done: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Each learned proposal against the best filter without a network that takes at most its time.

    The best has the smallest geometric mean RMSE in the test runs. Holm's correction is over the list.
    """
    rows = []
    for world in (*WORLDS, *OTHER_WORLDS):
        found = collect(world, done)
        for name in [f"{head}, {COUNTS[-1]} runs" for head in PROPOSALS]:
            if name not in found:
                continue
            parts = found[name]
            time_limit = np.mean([scores["seconds"] for scores in parts])
            rivals = {
                other: compare(parts, scores)
                for other, scores in found.items()
                if not other.startswith(tuple(LEARNED))
                and np.mean([s["seconds"] for s in scores]) <= time_limit
            }
            rival = max(rivals, key=lambda other: rivals[other][0])
            row = dict(zip(("mean", "half", "p"), rivals[rival], strict=True))
            rows.append(
                {"world": world, "learned": name, "rival": rival, "rivals": len(rivals), **row}
            )
    for row, p in zip(rows, holm([row["p"] for row in rows]), strict=True):
        row["p"] = p
        row["word"] = decide(row["mean"], row["half"], p)
    return rows


def table_equal_time(done: Mapping[str, Any]) -> list[str]:
    """Table of the comparisons at equal time."""
    lines = markdown_head(
        "world",
        "learned",
        "filters in at most its time",
        "best of them",
        "RMSE, ratio",
        "p, Holm",
        "RMSE of the learned one",
    )
    for row in list_equal_time(done):
        ratio = format_ratio(row["mean"], row["half"])
        names = (row["world"], row["learned"], str(row["rivals"]), row["rival"])
        lines.append(markdown_row(*names, ratio, f"{row['p']:.2g}", row["word"]))
    return lines


def plot_ratios(done: Mapping[str, Any]) -> Figure:
    """A panel for each world: ratio to the EKF with its 95 % interval."""
    ratios = list_ratios(done)
    names = list(dict.fromkeys(name for _, name in ratios))
    style = line_styles(names)
    figure = Figure(figsize=(2 * COLUMN, 3.2), layout="constrained")
    axes = figure.subplots(1, len(WORLDS), sharey=True)
    for axis, world in zip(axes, WORLDS, strict=True):
        for row, name in enumerate(names):
            mean, half = ratios[world, name][:2]
            low, middle, high = (math.exp(mean + k * half) for k in (-1.0, 0.0, 1.0))
            axis.plot([low, high], [row, row], color=style[name].colour, lw=1.2)
            axis.plot([middle], [row], "o", ms=3.5, color=style[name].colour)
        axis.axvline(1.0, color="0.6", lw=0.8, zorder=0)
        axis.set_title(world, fontsize=8)
        axis.set_xlabel("RMSE relative to EKF")
    axes[0].set_yticks(range(len(names)), names)
    axes[0].invert_yaxis()
    return figure


def write_page(request: Mapping[str, Any], done: Mapping[str, Any]) -> str:
    """The page of the study from its stored results."""
    runs, trainings = request["runs"], request["trainings"]
    lines = ["# KalmanNet and learned proposals at equal data", ""]
    lines += markdown_paragraph(
        f"`python -m pfbench.experiments.learn_gain {runs} {trainings}` writes this page. KalmanNet and `neural_sir` are trained on "
        f"{COUNTS[0]} or {COUNTS[1]} runs of the world in which they are tested. Each training shows {SHOWN} runs in batches of 16. "
        "KalmanNet minimises the squared error of the state, with gradients through 20 steps. `neural_sir` maximises the evidence "
        f"lower bound with 8 particles, and has {PARTICLES} in the tests. `{SCALED}` is the EKF with those factors on R and Q that "
        "have the smallest median RMSE in the same training runs. `ekf_scaled_tuned` was tuned on other worlds. `asinh` marks "
        f"KalmanNet with the sizes of its inputs. Each number of training runs has {trainings} trainings with other runs and "
        "initial weights."
    )
    lines += markdown_paragraph(
        f"All filters are tested on {runs} other runs. The RMSE is that of the position. The ratio is a geometric "
        "mean over runs and trainings with its 95 % interval. The p-values are of Wilcoxon's paired test over runs, with Holm's "
        "correction over the table. Times are processor times of all runs together on a machine with other work. The filters know "
        "the nominal noise only."
    )
    lines += [*table(done), "", "![RMSE relative to the EKF](ratios.png)", ""]
    lines += ["## KalmanNet against its rivals on the same training runs", ""]
    lines += markdown_paragraph(
        f"{COUNTS[1]} training runs, RMSE of KalmanNet against the other, with Holm's correction over these lines. `gate` needs no "
        f"training runs. A decision needs a p-value below {LEVEL:g} and an interval without 1:"
    )
    lines += markdown_bullets(*describe_pairs(done))
    lines += ["## Learned proposals at equal time", ""]
    lines += markdown_paragraph(
        f"Learned proposals of {COUNTS[-1]} training runs with {PARTICLES} particles, against the filters without a network that take "
        f"at most their time, SIR with {' and '.join(map(str, DEARER))} particles included. The best of them has the smallest RMSE in "
        "the test runs, which favours it."
    )
    lines += [*table_equal_time(done), ""]
    return "\n".join(lines)


def main(folder: Path, runs: int = 100, trainings: int = 3) -> None:
    torch.set_num_threads(1)
    request = {"runs": runs, "trainings": trainings}
    results = ResumableResults(folder / "learn_gain.json", request)

    def run_trainings(world: str, name: str, count: int) -> None:
        for seed in range(1, trainings + 1):
            key, path = f"{world}; {name}; {count}; {seed}", folder / "network.pt"
            results(key, partial(compute_training, world, name, count, seed, runs, path))
            print(key, flush=True)

    for world in WORLDS:
        for name in BY_HAND:
            method = instantiate(build(world, name).filter)
            results(f"{world}; {name}", partial(evaluate, world, method, runs))
        for name, count in product((SCALED, *NETWORKS), COUNTS):
            run_trainings(world, name, count)
    for world in (*WORLDS, *OTHER_WORLDS):
        if world in OTHER_WORLDS:
            for name in ("sir", "ckf_pf"):
                method = instantiate(build(world, name).filter)
                results(f"{world}; {name}", partial(evaluate, world, method, runs))
            for name in PROPOSALS:
                run_trainings(world, name, COUNTS[-1])
        for particles in DEARER:
            method = instantiate(build(world, "sir", particles).filter)
            results(f"{world}; sir, {particles} particles", partial(evaluate, world, method, runs))
    done = results.state["done"]
    (folder / "report.md").write_text(write_page(request, done))
    with matplotlib.rc_context(RC):
        (folder / "ratios.png").write_bytes(render_palette_png(plot_ratios(done)))


if __name__ == "__main__":
    folder = Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_gain"
    main(folder, *map(int, sys.argv[1:]))
