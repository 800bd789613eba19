"""Contestants as processes of their own, on one thread each, started once and warmed up; then rounds go from one to the next.

Only one works at a time. Compared are CPU milliseconds of the process, round by round, so that a slow minute of the machine
falls on all of them.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

HERE = Path(__file__).parent
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
QUALITIES = ("evidence", "normalised", "position")


class Contestant(NamedTuple):
    """A label, the environment whose Python it wants (own, numba, jax), and the words after the interpreter."""

    label: str
    place: str
    words: tuple[str, ...]

    @property
    def family(self) -> str:
        """The library: what stands before the comma, without the precision."""
        return self.label.split(",")[0].removesuffix(" float32").removesuffix(" float64")


class Result(NamedTuple):
    """Of one contestant: milliseconds of each round [rounds], qualities {name: [rounds, R]}, versions of what it ran on.

    `start` is what the process took until it was warm, in milliseconds of wall time: imports, compilation, a first round.
    """

    cpu: np.ndarray
    wall: np.ndarray
    qualities: dict[str, np.ndarray]
    versions: dict[str, str]
    start: float


def race(
    work: Mapping[str, Any],
    contestants: Sequence[Contestant],
    places: Mapping[str, str],
    rounds: int,
) -> list[Result | None]:
    """One result for each contestant; None for one whose process ended early, of which standard error has the reason.

    Args:
        work: arrays of the workload.
        contestants: who takes part.
        places: the Python of each environment.
        rounds: how often each one works.
    """
    alone = os.environ | dict.fromkeys(THREADS, "1")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "work.npz"
        np.savez(path, **work)
        processes: list[subprocess.Popen[str]] = []
        first: list[dict[str, Any] | None] = []
        starts: list[float] = []
        try:
            for contestant in contestants:
                command = [
                    places.get(contestant.place, sys.executable),
                    str(HERE / contestant.words[0]),
                    *contestant.words[1:],
                ]
                pipe, begun = subprocess.PIPE, time.perf_counter()
                processes.append(
                    subprocess.Popen(
                        [*command, str(path)], env=alone, stdin=pipe, stdout=pipe, text=True
                    )
                )
                first.append(_answer(processes[-1]))
                starts.append(1e3 * (time.perf_counter() - begun))
                print(
                    f"{contestant.label}: {'ready' if first[-1] else 'ended early'}",
                    file=sys.stderr,
                )
            answers: list[list[dict[str, Any]]] = [[] for _ in contestants]
            for turn in range(rounds):
                for i, contestant in enumerate(contestants):
                    if first[i] is None:
                        continue
                    print(
                        f"go {turn + 1}", file=processes[i].stdin, flush=True
                    )  # a seed of its own for each round
                    answer = _answer(processes[i])
                    if answer is None:
                        first[i] = None
                        continue
                    answers[i].append(answer)
                    print(
                        f"round {turn + 1} of {rounds}, {contestant.label}: {1e3 * answer['cpu']:.1f} ms",
                        file=sys.stderr,
                    )
        finally:
            for process in processes:
                process.communicate()  # closes its input, at which it ends
    rows = zip(answers, first, starts, strict=True)
    return [
        _result(found, greeting["versions"], start) if greeting else None
        for found, greeting, start in rows
    ]


def store_results(path: Path, workload: str, results: Mapping[str, Result | None]) -> None:
    """Put the results of a workload in a file of JSON, beside those of other workloads.

    Args:
        path: the file, made where there is none.
        workload: name of the workload; earlier results of it are replaced.
        results: of each contestant by label; None where it did not run.
    """
    everything = json.loads(path.read_text()) if path.exists() else {}
    everything[workload] = {
        label: result
        and {
            "cpu": _rounded(result.cpu),
            "wall": _rounded(result.wall),
            "qualities": {name: _rounded(rows) for name, rows in result.qualities.items()},
            "versions": result.versions,
            "start": round(result.start),
        }
        for label, result in results.items()
    }
    lines = [f"{json.dumps(name)}: {json.dumps(told)}" for name, told in everything.items()]
    path.write_text("{\n" + ",\n".join(lines) + "\n}\n")


def load_results(path: Path, workload: str) -> dict[str, Result | None]:
    """Return the stored results of a workload by label; empty where none are stored."""
    told = json.loads(path.read_text()).get(workload, {}) if path.exists() else {}
    return {
        label: one
        and Result(
            np.array(one["cpu"]),
            np.array(one["wall"]),
            {name: np.array(rows) for name, rows in one["qualities"].items()},
            one["versions"],
            one["start"],
        )
        for label, one in told.items()
    }


def _rounded(values: np.ndarray) -> Any:
    """Six significant digits: lists of numbers, NaN as JSON's NaN."""
    return np.vectorize(lambda value: float(f"{value:.6g}"), otypes=[float])(values).tolist()


def _answer(process: subprocess.Popen[str]) -> dict[str, Any] | None:
    line = process.stdout.readline() if process.stdout else ""
    return json.loads(line) if line else None


def _result(answers: list[dict[str, Any]], versions: dict[str, str], start: float) -> Result:
    cpu, wall = (np.array([1e3 * answer[clock] for answer in answers]) for clock in ("cpu", "wall"))
    qualities = {
        name: np.array([answer[name] for answer in answers], dtype=float) for name in QUALITIES
    }
    return Result(cpu, wall, qualities, versions, start)


def cpu_name() -> str:
    """Model of the processor, never the name of the machine."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()
