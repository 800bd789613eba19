"""What a user waits for: whole processes, from their start to their end. Writes campaigns.json and campaigns.md.

    make bench      (or: python benchmarks/campaigns.py --numba .venv-bench/bin/python --jax .venv-peers/bin/python --rounds 3)

Each contestant is a fresh process on one thread in each round: it imports, compiles or finds on disk what was compiled, filters
the data by one seed or by six, and ends. Compared is the CPU time of the process and of those that it started and waited for. A
pass that is not recorded fills the caches on disk first: those of torch, numba and the C++ compiler are where they always are,
JAX's is a folder that lasts as long as this benchmark. `--only W1` times some studies again and takes the others from
campaigns.json; `--only none` writes the page anew.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import problems
import workload
from compare import (
    COUNT,
    DEFAULT,
    DEFAULT32,
    FLOAT32,
    FLOAT64,
    NUMBA,
    disagreements,
    fastest,
    peer,
    ratio,
    starting,
)
from race import (
    HERE,
    QUALITIES,
    THREADS,
    Contestant,
    Result,
    cpu_name,
    load_results,
    store_results,
)

PARTICLES = Contestant("particles float32", "numba", ("peer.py", "float32"))
RUN_BY_RUN = Contestant("JAX, run by run", "jax", ("peer_jax.py", "loop", "count", "float32"))


class Goal(NamedTuple):
    """Whose time counts, against the fastest of which libraries, and how many times as fast it must and should be, if at all."""

    label: str
    library: str
    must: float | None = None
    aim: float | None = None


class Study(NamedTuple):
    """What a process does: name, description, model, sizes, number of seeds, who takes part, and the goals."""

    name: str
    said: str
    kind: str
    steps: int
    particles: int
    seeds: int
    contestants: tuple[Contestant, ...]
    goals: tuple[Goal, ...]


LARGE = (DEFAULT, FLOAT64, DEFAULT32, FLOAT32, PARTICLES, COUNT, RUN_BY_RUN)
ONE_JOB = (DEFAULT, FLOAT64, DEFAULT32, FLOAT32, NUMBA, COUNT, RUN_BY_RUN)
GOALS = (
    Goal(DEFAULT.label, "particles", 2.0, 3.0), Goal(DEFAULT.label, "JAX", 3.0, 4.0),
)  # fmt: skip
FASTEST = (Goal(DEFAULT.label, "", 1.5, 2.0),)
STUDIES = (
    Study("six campaigns of W4", "15-state INS error model", "ins", 200, 500, 6, LARGE, GOALS),
    Study("W1, one job", "growth model", "growth", 100, 10_000, 1, ONE_JOB, FASTEST),
    Study("W2, one job", "stochastic volatility", "volatility", 1000, 10_000, 1, ONE_JOB, FASTEST),
    Study(
        "W3, one job", "constant velocity, bearing and range", "radar", 100, 10_000, 1,
        ONE_JOB, FASTEST,
    ),
)  # fmt: skip


def make(study: Study, scale: float) -> Mapping[str, Any]:
    """The data of a study; `scale` shortens it for a trial."""
    runs, steps = max(4, round(100 * scale)), max(10, round(study.steps * scale))
    if study.kind == "ins":
        return {
            **workload.make(runs, steps, study.particles)._asdict(),
            "kind": np.array("ins"),
        }
    return problems.make(study.kind, steps, study.particles, runs=runs)._asdict()


def one(
    command: list[str], env: Mapping[str, str], seeds: int
) -> tuple[float, float, list[dict[str, Any]]] | None:
    """A process from its start to its end: CPU and wall milliseconds, and what it answered; None where it failed.

    Args:
        command: a worker and its workload.
        env: its environment.
        seeds: how many seeds it filters; the first is that by which a worker becomes warm.
    """
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        command,
        input="".join(f"go {seed}\n" for seed in range(1, seeds)),
        env=env,
        stdout=subprocess.PIPE,
        text=True,
    )
    after, wall = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter() - begun
    if done.returncode:
        return None
    cpu = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return 1e3 * cpu, 1e3 * wall, [json.loads(line) for line in done.stdout.splitlines()]


def race(
    study: Study, work: Mapping[str, Any], places: Mapping[str, str], rounds: int
) -> dict[Contestant, Result | None]:
    """One result for each contestant that has a place; None for one that failed, of which standard error has the reason.

    Qualities are of all seeds, [seeds, R]. A seed gives the same numbers in each round.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "work.npz"
        np.savez(path, **work)
        kept = {
            "JAX_COMPILATION_CACHE_DIR": f"{folder}/jax",
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        env = os.environ | dict.fromkeys(THREADS, "1") | kept
        ready = (who for who in study.contestants if who.place in places)
        there = {
            who: [places[who.place], str(HERE / who.words[0]), *who.words[1:], str(path)]
            for who in ready
        }
        found: dict[Contestant, list[Any]] = {who: [] for who in there}
        for turn in range(rounds + 1):
            for who, command in there.items():
                if None in found[who]:
                    continue
                found[who].append(one(command, env, study.seeds))
                took = f"{found[who][-1][0] / 1e3:.2f} s" if found[who][-1] else "failed"
                print(
                    f"{study.name}, round {turn} of {rounds}, {who.label}: {took}", file=sys.stderr
                )
    return {who: None if None in passes else _result(passes) for who, passes in found.items()}


def _result(passes: list[tuple[float, float, list[dict[str, Any]]]]) -> Result:
    (_, first, answers), *rounds = passes  # the first pass filled the caches
    cpu, wall = (np.array([taken[clock] for taken in rounds]) for clock in (0, 1))
    qualities = {
        name: np.array([answer[name] for answer in answers], dtype=float) for name in QUALITIES
    }
    return Result(cpu, wall, qualities, answers[0]["versions"], first)


def opponent(goal: Goal, found: Mapping[Contestant, Result]) -> Contestant | None:
    """The fastest one of the libraries of a goal."""
    return fastest(found, starting(goal.library) if goal.library else peer)


def verdicts(study: Study, found: Mapping[Contestant, Result]) -> tuple[list[str], list[str]]:
    """Rows of the table of goals, and the goals that are missed."""
    rows, missed = [], []
    for goal in study.goals:
        ours = next((who for who in found if who.label == goal.label), None)
        theirs = opponent(goal, found)
        if ours is None or theirs is None:
            continue
        low, middle, high = ratio(found[theirs], found[ours])
        must, aim = (
            f"{wanted:g}, {'met' if middle >= wanted else 'missed'}" if wanted else "-"
            for wanted in (goal.must, goal.aim)
        )
        rows.append(
            f"| {study.name} | {ours.label} | {theirs.label} | {middle:.2f} ({low:.2f}-{high:.2f}) | {must} | {aim} |"
        )
        if goal.must and middle < goal.must:
            missed.append(
                f"{study.name}, {ours.label}: {middle:.2f} times {theirs.label}, must {goal.must:g}"
            )
    return rows, missed


def least_time(folder: Path, fastest_s: float, must: float) -> str:
    """State what a job of W1 would take if each run took the time of the fused C loop.

    Args:
        folder: Folder of latency.json and compare.json.
        fastest_s: CPU time of the fastest library, s.
        must: How many times as fast the job must be.
    """
    starts = json.loads((folder / "latency.json").read_text())["first_step"]
    loop = load_results(folder / "compare.json", "W1, N = 1e4").get("fused C")
    if loop is None:
        return ""
    start, runs = float(np.median([cpu for cpu, _ in starts])), 0.1 * float(np.median(loop.cpu))
    return (
        f"W1 as one job: the start of `pfbench run` ({start:.2f} s, latency.md) and 100 runs of the fused C loop in float32 "
        f"({runs:.2f} s, compare.md) take {start + runs:.2f} s together; the must is {fastest_s / must:.2f} s."
    )


def section(study: Study, found: Mapping[Contestant, Result], bad: list[str]) -> list[str]:
    """What each contestant of a study took."""
    best = fastest(found, peer)
    runs = next(iter(found.values())).qualities["evidence"].shape[1]
    seeds = "one seed" if study.seeds == 1 else f"{study.seeds} seeds"
    lines = [
        "", f"## {study.name}", "",
        f"{study.said[0].upper()}{study.said[1:]}: {runs} runs, {study.steps} steps, {study.particles} particles, {seeds}.", "",
        f"| | CPU s, median (quartiles) | wall s | times as fast as {best.label if best else '-'} (quartiles) | log evidence |",
        "|---" * 5 + "|",
    ]  # fmt: skip
    for who, result in found.items():
        low, middle, high = np.quantile(result.cpu, [0.25, 0.5, 0.75]) / 1e3
        quick = "{1:.2f} ({0:.2f}-{2:.2f})".format(*ratio(found[best], result)) if best else "-"
        evidence = result.qualities["evidence"].mean(0)
        lines.append(
            f"| {who.label} | {middle:.3g} ({low:.3g}-{high:.3g}) | {np.median(result.wall) / 1e3:.3g} | {quick} "
            f"| {evidence.mean():.2f} ± {evidence.std(ddof=1) / len(evidence) ** 0.5:.2f} |"
        )
    untimed = [who.label for who in study.contestants if who not in found]
    return [
        *lines,
        *(["", f"Not timed: {', '.join(untimed)}."] if untimed else []),
        "",
        "**Not the same work:** " + "; ".join(bad) + "." if bad else "All contestants agree.",
    ]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--numba",
        default="",
        help="Python that has the library particles; without, it takes no part",
    )
    parser.add_argument("--jax", default="", help="Python that has jax; likewise")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument(
        "--scale", type=float, default=1.0, help="below 1: fewer runs and steps, to try it out"
    )
    parser.add_argument("--only", default="", help="studies whose names begin so")
    parser.add_argument(
        "--without", default="", help="parts of labels of contestants that are not timed, by commas"
    )
    parser.add_argument("--out", type=Path, default=HERE, help="folder for campaigns.md")
    chosen = parser.parse_args()
    places = {
        name: path
        for name, path in (("own", sys.executable), ("numba", chosen.numba), ("jax", chosen.jax))
        if path
    }
    store = chosen.out / "campaigns.json"
    out = [words for words in chosen.without.split(",") if words]
    for study in (study for study in STUDIES if study.name.startswith(chosen.only)):
        taking = (who for who in study.contestants if not any(w in who.label for w in out))
        study = study._replace(contestants=tuple(taking))
        told = race(study, make(study, chosen.scale), places, chosen.rounds)
        store_results(store, study.name, {who.label: result for who, result in told.items()})
    found: dict[Study, dict[Contestant, Result]] = {}
    rows, missed, lines, wrong, versions = [], [], [], [], {}
    least = ""
    for study in STUDIES:
        if not (stored := load_results(store, study.name)):
            continue
        results = {who: result for who in study.contestants if (result := stored.get(who.label))}
        failed = [f"{label}: it did not run" for label, result in stored.items() if result is None]
        bad = disagreements(results, exact=False) + failed
        found[study] = results
        new, late = verdicts(study, results)
        rows, missed = rows + new, missed + late
        if study.name.startswith("W1") and (best := fastest(results, peer)):
            seconds = float(np.median(results[best].cpu)) / 1e3
            least = least_time(HERE, seconds, study.goals[-1].must or 1.0)
        wrong += [f"{study.name}, {text}" for text in bad]
        lines += section(study, results, bad)
        for result in results.values():
            versions |= {name: value for name, value in result.versions.items() if name != "numpy"}
    rounds = sorted({len(result.cpu) for results in found.values() for result in results.values()})
    page = [
        "# Whole processes", "",
        f"Missed: {'; '.join(missed)}." if missed else "No goal is missed.", "",
        "| study | pfbench | against | times as fast (quartiles) | must | aim |",
        "|---" * 6 + "|", *rows, "",
        "SIR. Each contestant is a fresh process on one thread that imports, compiles or finds on disk what was compiled, filters "
        f"and ends; {' or '.join(map(str, rounds))} interleaved rounds after a pass that filled the caches; CPU time of the process. "
        "Ratios are taken round by round, against the fastest form of a library. Other processes may share the machine: times compare "
        "within a study. The default settings of pfbench are float64 and kernels. "
        "`particles float32` and JAX compute in float32, `particles` in float64. The log evidence of W4 is minus the exact one. "
        "Written by `benchmarks/campaigns.py` from campaigns.json.", "", least, *lines, "",
        ", ".join([f"{cpu_name()}; Python {platform.python_version()}", *map(" ".join, versions.items())]) + ".", "",
    ]  # fmt: skip
    (chosen.out / "campaigns.md").write_text("\n".join(page))
    print("\n".join(page))
    sys.exit("; ".join(wrong) if wrong else 0)


if __name__ == "__main__":
    main()
