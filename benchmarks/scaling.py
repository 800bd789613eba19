"""What a job costs against N, D, R and T, and three promises of whole jobs. Writes scaling.md.

    python benchmarks/scaling.py [--rounds 5] [--scale 1.0]

Costs are CPU milliseconds of the project's time loop, SIR on linear models of D states that are random walks; slopes are those
of lines through the upper half of each axis on log-log paper. The promises: 100 batched runs cost less than 15 times one where
one run does not fill the core; what a report needs of each step costs under 10 %; two workers do at least 1.8 times what one
does.
"""

from __future__ import annotations

import argparse
import os
import platform
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import torch
from race import cpu_name

from pfbench.core import Episode, PhiloxStream
from pfbench.filter import ParticleFilter, run_filter
from pfbench.filter.loop import Watch, choose_run_batch
from pfbench.job import ScoreRecorder, memory as process_memory
from pfbench.kernels import dispatch
from pfbench.model import LinearGaussian
from pfbench.noise import NominalNoise
from pfbench.scenario import ModelSimulation

HERE = Path(__file__).parent
USUAL = {"N": 1000, "D": 6, "R": 10, "T": 20}
AXES = {
    "N": (30, 100, 300, 1000, 3000, 10_000, 30_000),
    "D": (1, 2, 4, 8, 16, 32),
    "R": (1, 3, 10, 30, 100, 300),
    "T": (10, 30, 100, 300),
}
SAID = {"N": "particles", "D": "states", "R": "runs", "T": "steps"}
SWEEP = (
    "scenario=linear_walk",
    "filter=sir",
    "seed=1,2,3,4,5,6",
    "report.allow_mixed_versions=true",  # no report is made of these cells
    "particles=1000",
    "pcrb=false",
    "engine=eager",
)


def world(d: int, runs: int, steps: int) -> tuple[LinearGaussian, Episode]:
    """Random walks, each of them seen."""
    eye = torch.eye(d, dtype=torch.float64)
    model = LinearGaussian(eye, 0.5 * eye, eye, torch.ones(d), torch.zeros(d), torch.ones(d))
    return model, ModelSimulation(model, steps).draw(NominalNoise(), torch.arange(runs), 1)


def cost(
    model: LinearGaussian, episode: Episode, particles: int, seed: int, watch: Watch | None = None
) -> float:
    """CPU milliseconds of one filter over the record."""
    runs = len(episode.record.y)
    block = choose_run_batch(runs, particles, model.chart.size)
    begun = time.process_time()
    run_filter(
        ParticleFilter(particles),
        model,
        episode.record,
        PhiloxStream(seed, torch.arange(runs)),
        watch,
        run_batch=block,
    )
    return 1e3 * (time.process_time() - begun)


def against(rounds: int, scale: float) -> dict[str, list[tuple[int, float]]]:
    """Medians along each axis, the other three as usual."""
    found: dict[str, list[tuple[int, float]]] = {}
    for axis, values in AXES.items():
        kept = [value for value in values if value <= max(values) * scale or value <= values[2]]
        sizes = [{**USUAL, axis: value} for value in kept]
        worlds = [world(size["D"], size["R"], size["T"]) for size in sizes]
        times: list[list[float]] = [[] for _ in sizes]
        for turn in range(rounds + 1):
            for size, (model, episode), spent in zip(sizes, worlds, times, strict=True):
                taken = cost(model, episode, size["N"], turn)
                if turn:
                    spent.append(taken)
            print(f"{axis}: round {turn} of {rounds}", file=sys.stderr)
        found[axis] = list(zip(kept, map(statistics.median, times), strict=True))
    return found


def slope(points: list[tuple[int, float]]) -> float:
    """Of the upper half, log-log: 1 where cost is proportional to size."""
    upper = np.log(np.array(points[len(points) // 2 :], dtype=float))
    return float(np.polyfit(upper[:, 0], upper[:, 1], 1)[0])


def batched(rounds: int) -> list[float]:
    """100 runs together, times one run alone; 200 particles of 6 states do not fill the core."""
    (model, one), (_, many) = world(6, 1, 50), world(6, 100, 50)
    pairs = [
        (cost(model, many, 200, turn), cost(model, one, 200, turn)) for turn in range(rounds + 1)
    ]
    return [whole / single for whole, single in pairs[1:]]


def watched(rounds: int, instants: int, steps: int) -> list[float]:
    """What errors, normalised errors and scored instants add to a filter, a share: 100 runs, 500 particles, 15 states."""
    model, episode = world(15, 100, steps)
    truth = model.assemble(episode.truth)
    pairs = []
    for turn in range(rounds + 1):
        judge = ScoreRecorder(model, truth, instants)
        pairs.append((cost(model, episode, 500, turn, judge), cost(model, episode, 500, turn)))
    return [with_it / without - 1.0 for with_it, without in pairs[1:]]


def sped_up(rounds: int, scale: float) -> list[float]:
    """Wall time of one worker over that of two, the same sweep, both by joblib, start-up included."""
    steps, alone = max(20, round(2000 * scale)), os.environ | {"OMP_NUM_THREADS": "1"}
    found = []
    for turn in range(rounds):
        walls = {}
        for workers in (1, 2) if turn % 2 else (2, 1):
            with tempfile.TemporaryDirectory() as home:
                env = alone | {
                    "PFBENCH_RESULTS": f"{home}/results",
                    "PFBENCH_EPISODES": f"{home}/worlds",
                }
                cells = ["runs=100", f"scenario.steps={steps}"]
                words = [
                    "run",
                    "-m",
                    *SWEEP,
                    *cells,
                    "hydra/launcher=cores",
                    f"hydra.launcher.n_jobs={workers}",
                ]
                begun = time.perf_counter()
                subprocess.run(
                    [sys.executable, "-m", "pfbench", *words],
                    env=env,
                    check=True,
                    capture_output=True,
                )
                walls[workers] = time.perf_counter() - begun
            print(f"{workers} workers: {walls[workers]:.1f} s", file=sys.stderr)
        found.append(walls[1] / walls[2])
    return found


def promise(what: str, values: list[float], wanted: str, kept: bool) -> str:
    low, middle, high = np.quantile(values, [0.25, 0.5, 0.75])
    return f"| {what} | {middle:.3g} ({low:.3g} to {high:.3g}) | {wanted} | {'kept' if kept else '**missed**'} |"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--scale", type=float, default=1.0, help="below 1: smaller, to try it out")
    parser.add_argument("--out", type=Path, default=HERE, help="folder for scaling.md")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    process_memory.keep_freed_memory()
    with dispatch.use_kernels(), torch.no_grad():
        found = against(chosen.rounds, chosen.scale)
        together, steps = batched(chosen.rounds), max(20, round(300 * chosen.scale))
        judged, scored = watched(chosen.rounds, 0, steps), watched(chosen.rounds, 10, steps)
    workers = sped_up(chosen.rounds, chosen.scale)
    middle = statistics.median
    usual = ", ".join(f"{SAID[name]} {name} = {size}" for name, size in USUAL.items())
    lines = [
        "# What a job costs against its size", "",
        f"SIR, double precision, inner loops compiled, one core, medians of {chosen.rounds} interleaved rounds in milliseconds "
        f"of CPU time; all but one size as usual: {usual}. The exponent is that of the upper half. Written by "
        "`python benchmarks/scaling.py`.", "",
        "| | sizes and times | exponent |", "|---|---|---|",
        *(f"| {SAID[axis]} {axis} | " + ", ".join(f"{size}: {taken:.3g}" for size, taken in points) + f" | {slope(points):.2f} |"
          for axis, points in found.items()), "",
        "| | measured (quartiles) | wanted | |", "|---|---|---|---|",
        promise("100 batched runs, times one run (200 particles, 6 states)", together, "below 15", middle(together) < 15),
        promise(f"errors at every step, share of the filter (100 x 500, 15 states, T = {steps})", judged, "below 0.1",
                middle(judged) < 0.1),
        promise("the same and ten scored instants", scored, "below 0.1", middle(scored) < 0.1),
        promise("two workers, times one (six cells by joblib, wall time)", workers, "at least 1.8", middle(workers) >= 1.8), "",
        f"{cpu_name()}, {os.cpu_count()} cores; Python {platform.python_version()}, torch {torch.__version__}.", "",
    ]  # fmt: skip
    (chosen.out / "scaling.md").write_text("\n".join(lines))
    print("\n".join(lines))


if __name__ == "__main__":
    main()
