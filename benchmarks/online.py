"""Latency of a filter that runs online: one run, one call of `step` for each measurement. Writes online.json and online.md.

    python benchmarks/online.py [--steps 2000]

Each filter has a process of its own on one thread. A step begins when the measurement is there and ends with the estimate. Memory is the
growth of the process from before `init` to the largest value afterwards.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from race import HERE, THREADS, cpu_name

STORE = HERE / "online.json"
WORDS = (
    "scenario=flight_500s",
    "model=ins_gnss_inflated",
    "tuned=nominal",
    "episode_cache_dir=null",
)
FILTERS = (
    ("ekf", 0),
    ("ukf", 0),
    ("ekf_bank", 0),
    ("sir", 500),
    ("sir", 5000),
    ("rpf", 500),
    ("mcmc_rpf", 500),
)
QUANTILES = (0.5, 0.99)


def resident() -> float:
    """Resident memory of this process, MiB."""
    pages = int(Path("/proc/self/statm").read_text().split()[1])
    return pages * resource.getpagesize() / 2**20


def measure(name: str, particles: int, steps: int) -> dict[str, float]:
    """Milliseconds of a step by wall clock and of processor time (median, 99 %), of the start, and MiB of one run."""
    import torch

    from pfbench import job
    from pfbench.core import PhiloxStream
    from pfbench.noise import NominalNoise

    torch.set_num_threads(1)
    words = [*WORDS, f"filter={name}", *([f"particles={particles}"] if particles else [])]
    values = job.compose(words).values
    model, method, scenario = (
        job.instantiate(values[key]) for key in ("model", "filter", "scenario")
    )
    record = model.prepare(scenario.draw(NominalNoise(), torch.arange(1), seed=1).record)
    stream, length, times = (
        PhiloxStream(1, torch.arange(1)),
        record.y.shape[1],
        list[tuple[float, float]](),
    )
    before = resident()
    with torch.no_grad():
        for t in range(steps):  # a short record is filtered several times
            if t % length == 0:
                begun = time.perf_counter()
                belief = method.init(model, 1, stream.at_step(0), record.start, record.spread)
                start = time.perf_counter() - begun
            at, now = model.at_step(t % length), record.at_step(t % length)
            begun, spent = time.perf_counter(), time.thread_time()
            belief, info = method.step(at, belief, now, stream.at_step(t % length + 1))
            info.mean.numpy()
            times.append((time.perf_counter() - begun, time.thread_time() - spent))
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    (wall, cpu), (wall_tail, cpu_tail) = 1e3 * np.quantile(times[20:], QUANTILES, axis=0)
    mib = max(peak - before, 0.0)
    times_ms = {"wall": wall, "wall_tail": wall_tail, "cpu": cpu, "cpu_tail": cpu_tail}
    return {**times_ms, "start": 1e3 * start, "mib": mib}


def measure_apart(name: str, particles: int, steps: int) -> dict[str, Any]:
    """Measure a filter in a process of its own."""
    words = [sys.executable, __file__, "--child", name, str(particles), "--steps", str(steps)]
    environment = os.environ | dict.fromkeys(THREADS, "1")
    done = subprocess.run(words, check=True, stdout=subprocess.PIPE, text=True, env=environment)
    return {"filter": name, "particles": particles, **json.loads(done.stdout.splitlines()[-1])}


def page(stored: Mapping[str, Any]) -> str:
    """The page of the stored rows."""
    rows = [
        f"| `{row['filter']}` | {row['particles'] or ''} | {row['wall']:.2f} | {row['wall_tail']:.2f} | {row['cpu']:.2f} "
        f"| {row['cpu_tail']:.2f} | {row['start']:.1f} | {row['mib']:.1f} |"
        for row in stored["rows"]
    ]
    return "\n".join([
        "# Latency of one run", "",
        f"18-state INS/GNSS with fixes, one run, one call of `step` for each measurement, {stored['steps']} steps after 20 to warm up, double "
        f"precision, one thread of {stored['cpu']}. Load of the machine before the start: {stored['load']:.1f} processes for "
        f"{stored['cores']} cores. Written by `benchmarks/online.py` from online.json.", "",
        "| filter | particles | ms per step, median | 99 % | processor ms, median | 99 % | ms of `init` | MiB of one run |",
        "|---|---|---|---|---|---|---|---|", *rows, "",
        "On a busy machine the 99 % by the wall clock is that of waiting for the processor; processor time leaves that out. Memory is the growth of "
        "the process from before `init` to its peak, with the libraries that the first step loads.", "",
    ])  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--steps", type=int, default=2000)
    parser.add_argument("--child", nargs=2, help=argparse.SUPPRESS)
    parser.add_argument("--page", action="store_true", help="write the page again, measure nothing")
    given = parser.parse_args()
    if given.child:
        print(json.dumps(measure(given.child[0], int(given.child[1]), given.steps)))
        return
    if not given.page:
        facts = {
            "cpu": cpu_name(),
            "load": os.getloadavg()[0],
            "cores": os.cpu_count(),
            "steps": given.steps,
        }
        rows = [measure_apart(*choice, given.steps) for choice in FILTERS]
        STORE.write_text(json.dumps({**facts, "rows": rows}) + "\n")
    text = page(json.loads(STORE.read_text()))
    (HERE / "online.md").write_text(text, encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
