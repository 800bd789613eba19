"""SIR by engine: processor time of a pass with 50 % resampling, interleaved in one process, and of the first pass of a fresh process.

    python benchmarks/engines.py

It writes engines.md. `first` is one pass of a process of its own after the imports: recording, loading and, with `compiled`, the
compiler. Nothing is kept from one process to the next but torch's own cache, which is empty.
"""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import torch

from pfbench import job
from pfbench.core import PhiloxStream
from pfbench.filter import EssResampler, ParticleFilter, Systematic, run_filter
from pfbench.filter.loop import choose_run_batch
from pfbench.job.filter_pass import wrap_steps
from pfbench.kernels import dispatch

PAGE = Path(__file__).with_suffix(".md")
ENGINES = ("kernels", "tape", "compiled")
CASES = {  # scenario, runs, particles, steps
    "INS": ("flight_500s", 100, 500, 40),
    "growth, small": ("growth", 1, 1_000, 100),
    "growth": ("growth", 10, 10_000, 100),
    "volatility": ("stochastic_volatility", 1, 10_000, 200),
    "Lorenz": ("lorenz63", 1, 1_000, 200),
    "passive location": ("passive_1", 10, 5_000, 50),
    "terrain": ("terrain", 1, 1_000, 300),
}
ROUNDS = 7


def prepare(case: str, engine: str) -> Callable[[], bool]:
    """Build a pass. It returns whether the engine took the steps."""
    scenario, runs, particles, steps = CASES[case]
    words = [f"scenario={scenario}", f"runs={runs}", f"particles={particles}", "filter=sir"]
    words += ["model=ins_gnss_inflated"] if case == "INS" else []
    plan = job.build_plan(job.resolve_config(job.compose(words)))
    episode, numbers = plan.draw_episode(plan.runs), plan.runs
    model, record = plan.make_filter_model(episode), episode.record
    record = record.select_steps(slice(0, steps))
    method = ParticleFilter(particles, EssResampler(Systematic(), 0.5))
    wrapped = wrap_steps(engine, method) or method
    batch = choose_run_batch(runs, particles, model.chart.size)

    def run() -> bool:
        draws = PhiloxStream(1, numbers)
        with dispatch.use_kernels(), torch.no_grad():
            run_filter(wrapped, model, record, draws, run_batch=batch)
        return wrapped is method or wrapped.is_active

    return run


def time_pass(run: Callable[[], bool]) -> float:
    start = time.process_time()
    run()
    return 1e3 * (time.process_time() - start)


def time_first(case: str, engine: str) -> float:
    """Time the first pass of a fresh process, ms."""
    with tempfile.TemporaryDirectory() as folder:
        environment = {**os.environ, "TORCHINDUCTOR_CACHE_DIR": folder}
        words = [sys.executable, __file__, case, engine]
        done = subprocess.run(words, env=environment, capture_output=True, text=True, check=True)
    return float(done.stdout.split()[-1])


def write_page() -> None:
    rows = []
    for case, (scenario, *size) in CASES.items():
        passes = {engine: prepare(case, engine) for engine in ENGINES}
        taken = {engine: run() for engine, run in passes.items()}
        times: dict[str, list[float]] = {engine: [] for engine in ENGINES}
        for _ in range(ROUNDS):
            for engine, run in passes.items():
                times[engine].append(time_pass(run))
        middle = {engine: statistics.median(values) for engine, values in times.items()}
        first = [f"{time_first(case, engine):.0f}" for engine in ENGINES]
        warm = [f"{middle[e]:.1f}" if taken[e] else "no tape" for e in ENGINES]
        ratio = f"{middle['kernels'] / middle['tape']:.1f}" if taken["tape"] else "-"
        cells = [f"`{scenario}`", " x ".join(map(str, size)), *warm, ratio, *first]
        rows.append(f"| {' | '.join(cells)} |")
        print(rows[-1], flush=True)
    intro = __doc__.split("\n")[0] if __doc__ else ""
    head = "| scenario | R x N x T | kernels | tape | compiled | kernels / tape | first: kernels | first: tape | first: compiled |"
    lines = ["# Engines of SIR", "", f"{intro} Medians of {ROUNDS} rounds in ms.", ""]  # fmt: skip
    lines += [head, "|" + "---|" * 9, *rows, "", "Written by `python benchmarks/engines.py`.", ""]
    PAGE.write_text("\n".join(lines))


if __name__ == "__main__":
    torch.set_num_threads(1)
    if len(sys.argv) > 1:
        print(time_pass(prepare(*sys.argv[1:])))
    else:
        write_page()
