"""Times SIR on workload W4: pfbench against the library `particles` and against naive torch. Writes w4.md and w4.png.

    make bench          (or: python benchmarks/w4.py --peer .venv-bench/bin/python --rounds 9)

Each contestant is a process of its own on one thread, started once and warmed up; then rounds go from one to the next, and
only one works at a time. Compared are CPU milliseconds of the process, round by round, so that a slow minute of the machine
falls on all of them.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import workload
from matplotlib.figure import Figure

HERE = Path(__file__).parent
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
QUALITIES = {"evidence": "log evidence", "normalised": "error in exact standard deviations", "position": "position error"}
TOLERANCE = 4.5  # standard errors; about thirty comparisons, some of them heavy-tailed


class Contestant(NamedTuple):
    """A label, the family that gives a bar its colour, and the command after the interpreter."""

    label: str
    family: str
    words: tuple[str, ...]


CONTESTANTS = (
    Contestant("pfbench float32, eager", "pfbench", ("house.py", "float32", "eager")),
    Contestant("pfbench float32, compiled", "pfbench", ("house.py", "float32", "compiled")),
    Contestant("pfbench float64, eager", "pfbench", ("house.py", "float64", "eager")),
    Contestant("pfbench float64, compiled", "pfbench", ("house.py", "float64", "compiled")),
    Contestant("naive torch float32", "naive torch", ("naive.py", "float32")),
    Contestant("naive torch float64", "naive torch", ("naive.py", "float64")),
    Contestant("particles float32", "particles", ("peer.py", "float32")),
    Contestant("particles float64", "particles", ("peer.py", "float64")),
)
COLOURS = {"pfbench": "#0072B2", "naive torch": "#E69F00", "particles": "#999999"}  # Okabe and Ito 2008, and grey


class Result(NamedTuple):
    """Of one contestant: milliseconds of each round [rounds], qualities {name: [rounds, R]}, versions of what it ran on."""

    cpu: np.ndarray
    wall: np.ndarray
    qualities: dict[str, np.ndarray]
    versions: dict[str, str]


def race(work: workload.Workload, peer: str, rounds: int) -> list[Result]:
    """Starts the contestants one after the other, then sends them round by round.

    Raises:
        RuntimeError: a contestant's process ended early; what it said is on standard error.
    """
    alone = os.environ | dict.fromkeys(THREADS, "1")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "w4.npz"
        np.savez(path, **work._asdict())
        processes, versions = [], []
        try:
            for contestant in CONTESTANTS:
                interpreter = peer if contestant.family == "particles" else sys.executable
                command = [interpreter, str(HERE / contestant.words[0]), *contestant.words[1:], str(path)]
                processes.append(subprocess.Popen(command, env=alone, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True))
                versions.append(_answer(processes[-1], contestant)["versions"])
            answers: list[list[dict[str, Any]]] = [[] for _ in CONTESTANTS]
            for turn in range(rounds * len(CONTESTANTS)):
                i = turn % len(CONTESTANTS)
                print(f"go {turn + 1}", file=processes[i].stdin, flush=True)  # a seed of its own for each round
                answers[i].append(_answer(processes[i], CONTESTANTS[i]))
                print(f"{CONTESTANTS[i].label}: {1e3 * answers[i][-1]['cpu']:.0f} ms", file=sys.stderr)
        finally:
            for process in processes:
                process.communicate()  # closes its input, at which it ends
    return [_result(found, version) for found, version in zip(answers, versions, strict=True)]


def _answer(process: subprocess.Popen[str], contestant: Contestant) -> dict[str, Any]:
    line = process.stdout.readline() if process.stdout else ""
    if not line:
        raise RuntimeError(f"{contestant.label}: its process ended early, see above")
    return json.loads(line)


def _result(answers: list[dict[str, Any]], versions: dict[str, str]) -> Result:
    cpu, wall = (np.array([1e3 * answer[clock] for answer in answers]) for clock in ("cpu", "wall"))
    return Result(cpu, wall, {name: np.array([answer[name] for answer in answers]) for name in QUALITIES}, versions)


def disagreements(results: list[Result]) -> list[str]:
    """Contestants that did not compute the same: paired by run, against the mean of all, in standard errors.

    A bootstrap filter's log evidence is low by half its variance, and so is everyone's: filters are compared with each other.
    """
    found = []
    for name, what in QUALITIES.items():
        per_run = np.stack([result.qualities[name].mean(0) for result in results])  # [contestants, R]
        off = per_run - per_run.mean(0)
        error = off.std(1, ddof=1) / np.sqrt(off.shape[1])
        for contestant, mean, sd in zip(CONTESTANTS, off.mean(1), error, strict=True):
            if not abs(mean) < TOLERANCE * sd:
                found.append(f"{contestant.label}: {what} differs from the others' by {mean:.3g} +- {sd:.2g}")
    return found


def reference(results: list[Result]) -> Result:
    """The faster form of `particles`."""
    peers = [result for contestant, result in zip(CONTESTANTS, results, strict=True) if contestant.family == "particles"]
    return min(peers, key=lambda result: float(np.median(result.cpu)))


def table(results: list[Result], work: workload.Workload, bad: list[str]) -> str:
    """The page."""
    (runs, steps, _), rounds = work.y.shape, len(results[0].cpu)
    base = reference(results)
    versions = {name: value for result in results for name, value in result.versions.items() if name != "numpy"}
    numpies = " and ".join(sorted({result.versions["numpy"] for result in results if "numpy" in result.versions}))
    lines = [
        "# SIR on workload W4",
        "",
        f"15-state INS error model, position and velocity measured, {runs} Monte Carlo runs, {steps} steps, "
        f"{work.particles} particles, systematic resampling at every step. One thread each, one process at a time, "
        f"{rounds} interleaved rounds after a warm-up; CPU time of the process. Every contestant delivers mean, variance and "
        "effective sample size at every step and the log evidence; "
        "`particles` has no axis of runs and loops over them. Written by `make bench`.",
        "",
        "| | CPU ms, median (quartiles) | wall ms | times as fast as particles (quartiles) | log evidence minus exact "
        "| error, exact sd = 1 | position error, m |",
        "|---|---|---|---|---|---|---|",
    ]
    for contestant, result in zip(CONTESTANTS, results, strict=True):
        low, middle, high = np.quantile(result.cpu, [0.25, 0.5, 0.75])
        slow, ratio, fast = np.quantile(base.cpu / result.cpu, [0.25, 0.5, 0.75])
        evidence, root, position = (result.qualities[name].mean(0) for name in QUALITIES)
        lines.append(
            f"| {contestant.label} | {middle:.0f} ({low:.0f}-{high:.0f}) | {np.median(result.wall):.0f} "
            f"| {ratio:.2f} ({slow:.2f}-{fast:.2f}) "
            f"| {_told(evidence)} | {np.sqrt(root.mean()):.3f} | {np.sqrt(position.mean()):.2f} |"
        )
    exact = np.sqrt(((work.mean - work.truth)[..., 6:9] ** 2).sum(-1).mean())
    lines += [
        "",
        f"The exact Kalman filter's position error is {exact:.2f} m. Log evidences are low by half their variance, by theory; "
        "filters are compared with each other. "
        + ("All contestants agree, run by run, " if not bad else "**Not the same work:** " + "; ".join(bad) + "; limit ")
        + f"within {TOLERANCE} standard errors in evidence and both errors.",
        "",
        f"{cpu_name()}; Python {platform.python_version()}, "
        + ", ".join(f"{name} {value}" for name, value in versions.items())
        + f", numpy {numpies}.",
        "",
    ]
    return "\n".join(lines)


def _told(values: np.ndarray) -> str:
    return f"{values.mean():.2f} ± {values.std(ddof=1) / np.sqrt(len(values)):.2f}"


def cpu_name() -> str:
    """Model of the processor, never the name of the machine."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def draw(results: list[Result], work: workload.Workload, path: Path) -> None:
    """Bars of median CPU time with quartiles, each with its ratio to `particles`."""
    figure = Figure(figsize=(6.5, 3.2), layout="constrained")
    axis = figure.subplots()
    base = reference(results)
    for place, (contestant, result) in enumerate(zip(CONTESTANTS, results, strict=True)):
        low, middle, high = np.quantile(result.cpu, [0.25, 0.5, 0.75]) / 1e3
        axis.barh(place, middle, color=COLOURS[contestant.family], xerr=[[middle - low], [high - middle]], capsize=2)
        axis.annotate(
            f"{np.median(base.cpu / result.cpu):.2f}", (high, place), (4, 0), textcoords="offset points", va="center", fontsize=8
        )
    axis.set_yticks(range(len(CONTESTANTS)), [contestant.label for contestant in CONTESTANTS], fontsize=8)
    axis.invert_yaxis()
    axis.margins(x=0.12)
    axis.set_xlabel("CPU time in s, one thread (median, quartiles)", fontsize=8)
    runs, steps, _ = work.y.shape
    size = f"{runs} runs x {steps} steps x {work.particles} particles"
    figure.suptitle(f"SIR, {size}\nbeside the bars: times as fast as the library particles", fontsize=9)
    axis.tick_params(axis="x", labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--peer", required=True, help="Python that has the library particles")
    parser.add_argument("--out", type=Path, default=HERE, help="folder for w4.md and w4.png")
    for name, default in (("runs", 100), ("steps", 200), ("particles", 500), ("rounds", 9)):
        parser.add_argument(f"--{name}", type=int, default=default)
    chosen = parser.parse_args()
    work = workload.make(chosen.runs, chosen.steps, chosen.particles)
    results = race(work, chosen.peer, chosen.rounds)
    bad = disagreements(results)
    page = table(results, work, bad)
    (chosen.out / "w4.md").write_text(page)
    draw(results, work, chosen.out / "w4.png")
    print(page)
    sys.exit("; ".join(bad) if bad else 0)


if __name__ == "__main__":
    main()
