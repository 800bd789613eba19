"""What a person waits for: the start of a run, a check of all configurations, a report. Writes latency.json and latency.md.

    python benchmarks/latency.py [--rounds 5]

Everything is done as a user does it, by the command line, in processes of their own on one thread. The report is of real
results: 7 filters on a linear walk under eight noise regimes, 100 runs each.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from race import HERE, THREADS, cpu_name

STORE = HERE / "latency.json"
FILTERS = ("ekf", "ukf", "ckf", "sir", "apf", "rpf", "gpf")
NOISES = (
    "nominal",
    "paper_bursts",
    "outliers",
    "student",
    "laplace",
    "mixture",
    "bias_step",
    "gauss_markov",
)
# The command in a process that states the CPU time at which its filter draws the initial distribution. It imports no more
# than the command itself does, and nothing earlier.
FIRST_STEP = """
import functools, sys, time
from pfbench.cli import main, run
run_task = run.run_task
@functools.wraps(run_task)
def run_and_say(*args):
    from pfbench.filter import loop
    start = loop._start
    def say(*more):
        print("cpu", time.process_time(), file=sys.stderr, flush=True)
        return start(*more)
    loop._start = say
    return run_task(*args)
run.run_task = run_and_say
main(sys.argv[1:])
"""


class Goal(NamedTuple):
    """What is waited for, and the CPU time in seconds that it may take."""

    name: str
    said: str
    must: float


GOALS = (
    Goal("first_step", "`pfbench run` of a small cell, before its first step", 1.5),
    Goal("check", "`pfbench check` of all configurations", 10.0),
    Goal("report", "a report of 7 filters, 8 conditions, 100 runs", 10.0),
)


def command(*words: str, folder: Path) -> tuple[float, float, str]:
    """Run a command on one thread: CPU and wall seconds, and what it wrote to standard error."""
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        [sys.executable, *words],
        check=True,
        cwd=folder,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | dict.fromkeys(THREADS, "1"),
    )
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - begun
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, wall, done.stderr


def first_step(folder: Path, number: int) -> tuple[float, float]:
    """CPU seconds of a small cell before its first step, and wall seconds of the whole command."""
    words = ("run", "scenario=growth", "filter=sir", "runs=2", "particles=100", f"study=n{number}")
    _, wall, told = command("-c", FIRST_STEP, *words, folder=folder)
    return float(told.split("cpu ")[1].split()[0]), wall


def measure(rounds: int) -> dict[str, list[tuple[float, float]]]:
    """CPU and wall seconds of each round, by what was waited for."""
    run = ("-m", "pfbench")
    found: dict[str, list[tuple[float, float]]] = {goal.name: [] for goal in GOALS}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch)
        sweep = f"filter={','.join(FILTERS)}", f"noise={','.join(NOISES)}"
        size = "scenario=linear_walk", "runs=100", "particles=100"
        command(*run, "run", "-m", "study=pages", *size, *sweep, folder=folder)
        for number in range(rounds):
            found["first_step"].append(first_step(folder, number))
            found["check"].append(command(*run, "check", folder=folder)[:2])
            found["report"].append(command(*run, "report", "study=pages", folder=folder)[:2])
            print(
                f"round {number + 1} of {rounds}: {[times[-1] for times in found.values()]}",
                file=sys.stderr,
            )
    return found


def page(found: Mapping[str, Sequence[Sequence[float]]]) -> list[str]:
    """The page: missed goals first, then a row for each."""
    rows, missed = [], []
    for goal in GOALS:
        cpu, wall = np.array(found[goal.name]).T
        low, middle, high = np.quantile(cpu, [0.25, 0.5, 0.75])
        if middle > goal.must:
            missed.append(f"{goal.said}: {middle:.1f} s, must {goal.must:g} s")
        rows.append(
            f"| {goal.said} | {middle:.2f} ({low:.2f}-{high:.2f}) | {np.median(wall):.2f} | {goal.must:g}, "
            f"{'missed' if middle > goal.must else 'met'} |"
        )
    return [
        "# What a person waits for", "",
        f"Missed: {'; '.join(missed)}." if missed else "No goal is missed.", "",
        "| | CPU s, median (quartiles) | wall s | must (CPU s) |", "|---|---|---|---|", *rows, "",
        f"{len(found['check'])} rounds on {cpu_name()}, one thread. The CPU time of the first row ends at the first step, its "
        "wall time with the command. Written by `benchmarks/latency.py` from latency.json.", "",
    ]  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--page", action="store_true", help="write the page anew, measure nothing")
    given = parser.parse_args()
    if not given.page:
        STORE.write_text(json.dumps(measure(given.rounds)) + "\n")
    lines = page(json.loads(STORE.read_text()))
    (HERE / "latency.md").write_text("\n".join(lines), encoding="utf-8")
    print("\n".join(lines))


if __name__ == "__main__":
    main()
