"""Learned proposals beside other proposals in two worlds where a network should pay, at equal particle number and at equal time.

    python experiments/analyses/learned_worlds.py [runs]

In the growth model the noise of a step has two modes, and few particles stand for a likelihood that is dear. A towed array hears the side
of an emitter from its axis but not on which side, so that the start has two modes until the ship turns. The networks are trained by
inference compilation, or by the evidence lower bound with three resamplers: plain, soft, and with the score-function gradient. Errors are
those of a filter's mean to a reference of many particles, and of its evidence. Finished parts are kept in results/learned_worlds.json. The
script prints the table of the page on learned proposals, and its results are in the file beside the script.
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
from typing import Any, NamedTuple

import numpy as np
import torch
from pfbench.experiments.study_parts import ResumableResults, crossed_mean_interval
from torch import Tensor
from torch.distributions import Distribution

from pfbench.core import PhiloxStream, Record
from pfbench.files import markdown_head, markdown_row
from pfbench.filter import (
    DiagonalNormalHead,
    EssResampler,
    EvidenceLowerBound,
    Filter,
    GaussianFilter,
    GuidedNoiseProposal,
    InferenceCompilation,
    LearnedProposal,
    NormalMixtureHead,
    ParticleFilter,
    SigmaPointLinearisation,
    SoftResampler,
    StopGradientResampler,
    Systematic,
    TaylorLinearisation,
    TwistedParticleFilter,
    UnscentedPoints,
    run_filter,
)
from pfbench.learn import Training, draw_training_data, train
from pfbench.model import (
    StateSpaceModel,
    UnivariateGrowth,
    independent_normal,
    normal_batch,
)
from pfbench.noise import NominalNoise
from pfbench.results import holm, wilcoxon_signed_rank
from pfbench.scenario import ModelSimulation

EQUAL = 50  # particles at equal number
COUNTS = {"SIR": (20, 50, 100, 200, 500, 1000, 2000, 5000), "EKF": (20, 50, 100, 200, 500), "UKF": (20, 50, 100, 200, 500), "look-ahead": (50,)}  # fmt: skip
FEW = (20, 50, 100)  # of learned proposals
LEARNED = ("normal, compilation", "mixture, compilation", "mixture, bound", "mixture, bound, soft", "mixture, bound, score")  # fmt: skip
REFERENCE, REPEATS, PART = 50_000, 2, 8
PRICES = (0.0, 10.0, 100.0)  # of a value of the likelihood, microseconds


class ArrayInputs(NamedTuple):
    """Position of the ship [1, T, 2], km; its heading [1, T], rad; whether a step is the first one [1, T]."""

    ship: Tensor
    heading: Tensor
    is_first: Tensor


class TowedArray(StateSpaceModel):
    """An emitter that drifts by 0.15 km in a minute, heard at an angle from the axis of an array with an error of 0.03 rad.

    The first step draws the start: a range of about 5 km and any bearing.
    """

    names, units, groups, noise_dim = ("x", "y"), ("km", "km"), {"position": (0, 1)}, 2
    input_type = ArrayInputs
    scale: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("scale", torch.full((2,), 1e-3).double())

    def prepare(self, record: Record) -> Record:
        t = torch.arange(1, record.y.shape[1] + 1, dtype=torch.float64)
        heading = torch.where(t > 8.0, math.pi / 3.0, 0.0)  # the ship turns after 8 minutes
        ship = 0.2 * torch.stack([heading.cos(), heading.sin()], -1).cumsum(0)
        return record._replace(u=ArrayInputs(ship[None], heading[None], (t == 1.0).double()[None]))

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.scale)

    def propagate(self, x: Tensor, u: ArrayInputs, w: Tensor) -> Tensor:
        away, bearing = 5.0 * torch.exp(0.4 * w[..., :1]), 1.8 * w[..., 1:]
        start = torch.cat([away * bearing.cos(), away * bearing.sin()], -1)
        return torch.where(u.is_first[:, None, None] > 0.5, start, x + 0.15 * w)

    def observation(self, x: Tensor, u: ArrayInputs) -> Distribution:
        east, north = (x - u.ship.unsqueeze(1)).unbind(-1)
        angle = torch.atan2(north, east) - u.heading.unsqueeze(1)
        folded = torch.atan2(angle.sin().abs(), angle.cos()).unsqueeze(-1)
        return independent_normal(folded, torch.full_like(folded, 0.03))


class World(NamedTuple):
    """A model with the number of steps of its records; components of a mixture, and epochs of inference compilation."""

    model: StateSpaceModel
    steps: int
    components: int
    epochs: int

    def draw(self, runs: int, seed: int) -> Any:
        """Draw records with their states, as training data."""
        scenario = ModelSimulation(self.model, self.steps)
        return draw_training_data(scenario, [NominalNoise()], self.model, runs, seed, None)


def make_worlds() -> dict[str, World]:
    """Return the two worlds by name."""
    return {
        "growth": World(UnivariateGrowth(), 50, 3, 30),
        "towed array": World(TowedArray(), 20, 4, 100),
    }


def list_trainings(world: World) -> dict[str, tuple[Training, Any]]:
    """Return the trainings by name, each with its network."""
    mixture = partial(NormalMixtureHead, components=world.components)
    plan = Training(
        InferenceCompilation(), EssResampler(Systematic(), 0.5), 32, None, world.epochs, 16, 5e-3
    )
    bound: Any = partial(Training, EvidenceLowerBound(), particles=16, gradient_steps=5, epochs=12, batch_size=16, learning_rate=3e-3)  # fmt: skip
    return {
        "normal, compilation": (plan, DiagonalNormalHead),
        "mixture, compilation": (plan, mixture),
        "mixture, bound": (bound(resampler=EssResampler(Systematic(), 1.0)), mixture),
        "mixture, bound, soft": (bound(resampler=SoftResampler(0.7)), mixture),
        "mixture, bound, score": (bound(resampler=StopGradientResampler()), mixture),
    }


def list_filters() -> dict[str, Callable[[int], Filter]]:
    """Return filters without a network by name."""
    guides = {"EKF": TaylorLinearisation(), "UKF": SigmaPointLinearisation(UnscentedPoints())}
    guided = {
        name: lambda n, rule=rule: ParticleFilter(
            n, proposal=GuidedNoiseProposal(GaussianFilter(rule))
        )
        for name, rule in guides.items()
    }
    return {"SIR": ParticleFilter, **guided, "look-ahead": TwistedParticleFilter}


def compute_reference(world: World, record: Record) -> dict[str, Any]:
    """Means of the states and log evidence by two bootstrap filters of many particles, joined, and their disagreement."""
    halves = []
    for seed in (11, 12):
        parts = []
        for first in range(0, len(record.y), PART):
            some = record.select_runs(slice(first, first + PART))
            numbers = torch.arange(first, first + len(some.y))
            parts.append(run_filter(ParticleFilter(REFERENCE), world.model, some, PhiloxStream(seed, numbers)))  # fmt: skip
        halves.append((torch.cat([p.mean for p in parts]), torch.cat([p.log_evidence for p in parts])))  # fmt: skip
    (a, log_a), (b, log_b) = halves
    own = (a - b).square().sum(-1).mean() / 4.0  # of the joined mean
    log_z = torch.logaddexp(log_a, log_b) - math.log(2.0)
    return {"mean": ((a + b) / 2.0).tolist(), "log_evidence": log_z.tolist(), "own": float(own), "sd": float((log_a - log_b).std() / 2.0)}  # fmt: skip


def count_values(method: Filter, world: World, record: Record) -> float:
    """Count the states at which a filter computes a measurement, for each run and step. A derivative counts as one of them."""
    counts: list[int] = []
    kind: Any = type(world.model)

    class Counted(kind):  # type: ignore[misc]
        def observation(self, x: Tensor, u: Any) -> Any:
            counts.append(x.shape[:-1].numel())
            return super().observation(x, u)

    # steps alone, since `run_filter` also computes measurements to judge the health of a run
    model, one, draws = Counted(), record.select_runs(slice(0, 1)), PhiloxStream(1, torch.arange(1))
    if isinstance(method, TwistedParticleFilter):
        belief = method.init_from_record(model, one, draws.at_step(0))
    else:
        belief = method.init(model, 1, draws.at_step(0))
    for t in range(world.steps):
        belief, _ = method.step(model, belief, one.at_step(t), draws.at_step(t + 1))
    return sum(counts) / world.steps


@torch.no_grad()
def evaluate(
    world: World, record: Record, reference: Mapping[str, Any], method: Filter
) -> dict[str, Any]:
    """Errors: square of the mean's difference to the reference by run, median of that of the log evidence; time and values."""
    runs, mean = torch.arange(len(record.y)), torch.tensor(reference["mean"]).double()
    log_z = torch.tensor(reference["log_evidence"]).double()
    run_filter(method, world.model, record.select_runs(slice(0, 2)), PhiloxStream(1, runs[:2]))
    squares, logs, spent = [], [], []
    for seed in range(1, REPEATS + 1):
        start = time.process_time()
        found = run_filter(method, world.model, record, PhiloxStream(seed, runs))
        spent.append(time.process_time() - start)
        difference = (found.mean - mean).square().sum(-1).mean(1)
        squares.append(difference.nan_to_num(nan=math.inf))
        logs.append(found.log_evidence - log_z)
    return {
        "squares": [float(f"{v:.5g}") for v in torch.stack(squares).mean(0)],
        "log_error": float(np.median(torch.cat(logs).abs())),
        "microseconds": 1e6 * min(spent) / (len(runs) * world.steps),
        "values": count_values(method, world, record),
    }


def train_network(world: World, plan: Training, head: Any, path: Path) -> float:
    """Train a network on 128 records into a file; return the processor time."""
    data, validation = (world.draw(runs, seed) for runs, seed in ((128, 1001), (64, 1002)))
    method = ParticleFilter(EQUAL, proposal=LearnedProposal(head, checkpoint=None))
    start = time.process_time()
    path.unlink(missing_ok=True)
    train(plan, method, world.model, data, validation, path)
    return time.process_time() - start


def compare(done: Mapping[str, Any], a: str, b: str) -> tuple[float, float, float]:
    """Return the geometric mean ratio of errors of two parts, half of its log's 95 % interval, and Wilcoxon's p over runs."""
    logs = [0.5 * np.log(np.array(done[key]["squares"])) for key in (a, b)]
    mean, half = crossed_mean_interval((logs[0] - logs[1])[None])
    return mean, half, wilcoxon_signed_rank(logs[0] - logs[1])[1]


def list_rows(done: Mapping[str, Any], price: float | None) -> list[dict[str, Any]]:
    """List each learned proposal against the best filter without a network: at its number of particles, or in its time.

    Args:
        done: Finished parts.
        price: Time of a value of the likelihood, microseconds; None for the same number of particles.

    Returns:
        Rows with Holm's correction over them. The best rival has the smallest error in the same runs, which favours it.
    """
    rows = []
    for world, label in product(make_worlds(), LEARNED):
        own = f"{world}; {label}; {EQUAL}"
        limit = done[own]["microseconds"] + (price or 0.0) * done[own]["values"]
        rivals = [
            key
            for key, part in done.items()
            if key.startswith(f"{world}; ") and key.split("; ")[1] in COUNTS
            and np.isfinite(part["squares"]).all()
            and (key.endswith(f"; {EQUAL}") if price is None else part["microseconds"] + price * part["values"] <= limit)
        ]  # fmt: skip
        best = max(rivals, key=lambda key: compare(done, own, key)[0])
        row = dict(zip(("mean", "half", "p"), compare(done, own, best), strict=True))
        rows.append({"world": world, "label": label, "rival": best, **row})
    for row, p in zip(rows, holm([row["p"] for row in rows]), strict=True):
        is_clear = p < 0.05 and abs(row["mean"]) > row["half"]
        row["word"] = ("smaller" if row["mean"] < 0.0 else "larger") if is_clear else "inconclusive"
    return rows


def format_rival(row: Mapping[str, Any]) -> str:
    """Format the best filter without a network, the ratio of the errors, and the word."""
    _, label, n = row["rival"].split("; ")
    low, middle, high = (math.exp(row["mean"] + k * row["half"]) for k in (-1.0, 0.0, 1.0))
    return f"{label} {n}: {middle:.2f} ({low:.2f} to {high:.2f}), {row['word']}"


def write_table(done: Mapping[str, Any]) -> str:
    """Return the tables of the page, and what they say."""
    lines = markdown_head("world", "filter", "error", "log evidence off by", "microseconds", "values", "training [s]")  # fmt: skip
    for world, label in product(make_worlds(), (*COUNTS, *LEARNED)):
        part = done[f"{world}; {label}; {EQUAL}"]
        error, spent = (
            np.median(np.sqrt(part["squares"])),
            done.get(f"{world}; {label}; training"),
        )
        cells = (f"{error:.3g}", f"{part['log_error']:.3g}", f"{part['microseconds']:.0f}", f"{part['values']:.0f}")  # fmt: skip
        lines.append(markdown_row(world, label, *cells, "" if spent is None else f"{spent:.0f}"))
    prices = [None, *PRICES]
    columns = [list_rows(done, price) for price in prices]
    heads = [f"equal time, {price:g} us" for price in PRICES]
    lines += ["", *markdown_head("world", "network", f"{EQUAL} particles each", *heads)]
    for rows in zip(*columns, strict=True):
        lines.append(markdown_row(rows[0]["world"], rows[0]["label"], *map(format_rival, rows)))
    words = []
    for head, rows in zip((f"With {EQUAL} particles each", *heads), columns, strict=True):
        counts = [sum(row["word"] == word for row in rows) for word in ("smaller", "larger")]
        words.append(f"{head[0].upper()}{head[1:]}: the error of {counts[0]} of {len(rows)} networks is smaller than that of the best other filter, and of {counts[1]} larger.")  # fmt: skip
    return "\n".join([*lines, "", *words])


def run_world(results: ResumableResults, name: str, world: World, runs: int) -> None:
    """Compute the parts of a world that are missing."""
    folder = results.path.parent
    record = world.draw(runs, 1).record
    with torch.no_grad():
        reference = results(f"{name}; reference", partial(compute_reference, world, record))
    score = partial(evaluate, world, record, reference)
    for label, make in list_filters().items():
        for n in COUNTS[label]:
            results(f"{name}; {label}; {n}", partial(score, make(n)))
    for label, (plan, head) in list_trainings(world).items():
        path = folder / f"{name}_{label}.pt".replace(", ", "_").replace(" ", "_")
        results(f"{name}; {label}; training", partial(train_network, world, plan, head, path))
        proposal = LearnedProposal(head, checkpoint=str(path))
        for n in FEW:
            results(f"{name}; {label}; {n}", partial(score, ParticleFilter(n, proposal=proposal)))
        print(name, label, flush=True)


def main(runs: int) -> None:
    torch.set_num_threads(1)
    folder = Path(os.environ.get("PFBENCH_RESULTS", "results"))
    results = ResumableResults(folder / "learned_worlds.json", {"runs": runs})
    for name, world in make_worlds().items():
        run_world(results, name, world, runs)
    print(write_table(results.state["done"]))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 64)
