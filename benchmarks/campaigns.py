"""What a user waits for: whole processes, from nothing to six campaigns of W4. Writes campaigns.md and campaigns.png.

    make bench      (or: python benchmarks/campaigns.py --numba .venv-bench/bin/python --jax .venv-peers/bin/python --rounds 5)

Each contestant is a fresh process on one thread in each round: it imports, compiles or finds on disk what was compiled, filters
W4's data by six seeds, and ends. Compared is the CPU time of the process and of those that it started and waited for. A pass that
is not recorded fills the caches on disk first: those of torch, numba and the C++ compiler are where they always are, JAX's is a
folder that lasts as long as this benchmark. A worker (worker.py) filters once before it listens, to be warm: that is the first
campaign, and five more are asked for.
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
import workload
from compare import COLOURS, EAGER, FLOAT32, JAX, LOOPS, disagreements, fastest, own, ratio
from matplotlib.figure import Figure
from race import HERE, QUALITIES, THREADS, Contestant, Result, cpu_name

CAMPAIGNS = 6
PARTICLES = Contestant("particles float32", "numba", ("peer.py", "float32"))
CONTESTANTS = (
    FLOAT32,
    LOOPS,
    EAGER,
    PARTICLES,
    JAX,
    Contestant("JAX, run by run", "jax", ("peer_jax.py", "loop", "count", "float32")),
)


class Goal(NamedTuple):
    """A library, and how many times as fast a process of pfbench must be, and should be."""

    library: str
    must: float
    aim: float


GOALS = (Goal("particles", 1.5, 2.5), Goal("JAX", 2.5, 4.0))


def one(
    command: list[str], env: Mapping[str, str], turn: int
) -> tuple[float, float, list[dict[str, Any]]] | None:
    """A process from its start to its end: CPU and wall milliseconds, and what it answered; None where it failed.

    Args:
        command: a worker and its workload.
        env: its environment.
        turn: number of the round, which decides the seeds.
    """
    seeds = range(turn * CAMPAIGNS + 1, (turn + 1) * CAMPAIGNS)
    before, begun = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    done = subprocess.run(
        command,
        input="".join(f"go {seed}\n" for seed in seeds),
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
    work: Mapping[str, Any], places: Mapping[str, str], rounds: int
) -> dict[Contestant, Result | None]:
    """One result for each contestant that has a place; None for one that failed, of which standard error has the reason.

    Qualities are of the five campaigns of each round that answer, [5 rounds, R].
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "work.npz"
        np.savez(path, **work)
        kept = {
            "JAX_COMPILATION_CACHE_DIR": f"{folder}/jax",
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0",
        }
        env = os.environ | dict.fromkeys(THREADS, "1") | kept
        ready = (who for who in CONTESTANTS if who.place in places)
        there = {
            who: [places[who.place], str(HERE / who.words[0]), *who.words[1:], str(path)]
            for who in ready
        }
        found: dict[Contestant, list[Any]] = {who: [] for who in there}
        for turn in range(rounds + 1):
            for who, command in there.items():
                if None in found[who]:
                    continue
                found[who].append(one(command, env, turn))
                took = f"{found[who][-1][0] / 1e3:.2f} s" if found[who][-1] else "failed"
                print(f"round {turn} of {rounds}, {who.label}: {took}", file=sys.stderr)
    return {who: None if None in passes else _result(passes) for who, passes in found.items()}


def _result(passes: list[tuple[float, float, list[dict[str, Any]]]]) -> Result:
    (_, first, greeting), *rounds = passes  # the first pass filled the caches
    answers = [answer for _, _, told in rounds for answer in told[1:]]
    cpu, wall = (np.array([taken[clock] for taken in rounds]) for clock in (0, 1))
    qualities = {
        name: np.array([answer[name] for answer in answers], dtype=float) for name in QUALITIES
    }
    return Result(cpu, wall, qualities, greeting[0]["versions"], first)


def table(found: Mapping[Contestant, Result], bad: list[str]) -> list[str]:
    """The goals and what became of them, and what each contestant took."""
    ours = fastest(found, own)
    of = {goal: [who for who in found if who.label.startswith(goal.library)] for goal in GOALS}
    peers = {goal: fastest(found, there.__contains__) for goal, there in of.items()}
    lines = [
        "| against | pfbench's best | times as fast (quartiles) | must | aim |",
        "|---|---|---|---|---|",
    ]
    for goal, theirs in peers.items():
        if ours is not None and theirs is not None:
            low, middle, high = ratio(found[theirs], found[ours])
            must, aim = (
                f"{wanted:g}, {'met' if middle >= wanted else 'missed'}"
                for wanted in (goal.must, goal.aim)
            )
            lines.append(
                f"| {theirs.label} | {ours.label} | {middle:.2f} ({low:.2f}-{high:.2f}) | {must} | {aim} |"
            )
    heads = [
        f"times as fast as {theirs.label if theirs else goal.library} (quartiles)"
        for goal, theirs in peers.items()
    ]
    lines += [
        "",
        f"| | CPU s, median (quartiles) | wall s | {' | '.join(heads)} | log evidence minus exact |",
        "|---" * 6 + "|",
    ]
    for who, result in found.items():
        low, middle, high = np.quantile(result.cpu, [0.25, 0.5, 0.75]) / 1e3
        quick = [
            "{1:.2f} ({0:.2f}-{2:.2f})".format(*ratio(found[peer], result)) if peer else "-"
            for peer in peers.values()
        ]
        evidence = result.qualities["evidence"].mean(1)
        lines.append(
            f"| {who.label} | {middle:.3g} ({low:.3g}-{high:.3g}) | {np.median(result.wall) / 1e3:.3g} | {' | '.join(quick)} "
            f"| {evidence.mean():.2f} ± {evidence.std(ddof=1) / len(evidence) ** 0.5:.2f} |"
        )
    return [
        *lines,
        "",
        "**Not the same work:** " + "; ".join(bad) + "." if bad else "All contestants agree.",
    ]


def draw(found: Mapping[Contestant, Result], path: Path) -> None:
    """Median CPU time of each contestant's process, quartiles as bars."""
    figure = Figure(figsize=(6.5, 0.8 + 0.25 * len(found)), layout="constrained")
    axis = figure.subplots()
    for place, (who, result) in enumerate(found.items()):
        low, middle, high = np.quantile(result.cpu, [0.25, 0.5, 0.75]) / 1e3
        colour = COLOURS["pfbench"] if own(who) else "#777777"
        axis.plot([low, high], [place, place], color=colour, lw=1.5)
        axis.plot(middle, place, "o", color=colour, ms=5)
        axis.annotate(
            f"{middle:.3g}",
            (high, place),
            (6, 0),
            textcoords="offset points",
            va="center",
            fontsize=8,
        )
    axis.set(xlim=(0, None), ylim=(len(found) - 0.4, -0.6))
    axis.set_yticks(range(len(found)), [who.label for who in found], fontsize=8)
    axis.margins(x=0.12)
    axis.set_xlabel("CPU time in s of a whole process, one thread (median, quartiles)", fontsize=8)
    axis.set_title(
        "six campaigns of W4, with imports, and what was compiled on disk", fontsize=9, loc="left"
    )
    axis.tick_params(axis="x", labelsize=8)
    axis.spines[["top", "right"]].set_visible(False)
    figure.savefig(path, dpi=150, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--numba",
        default="",
        help="Python that has the library particles; without, it takes no part",
    )
    parser.add_argument("--jax", default="", help="Python that has jax; likewise")
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument(
        "--scale", type=float, default=1.0, help="below 1: fewer runs and steps, to try it out"
    )
    parser.add_argument(
        "--out", type=Path, default=HERE, help="folder for campaigns.md and campaigns.png"
    )
    chosen = parser.parse_args()
    places = {
        name: path
        for name, path in (("own", sys.executable), ("numba", chosen.numba), ("jax", chosen.jax))
        if path
    }
    runs, steps = max(4, round(100 * chosen.scale)), max(10, round(200 * chosen.scale))
    work = {**workload.make(runs, steps, 500)._asdict(), "kind": np.array("ins")}
    told = race(work, places, chosen.rounds)
    found = {who: result for who, result in told.items() if result is not None}
    bad = disagreements(found, exact=False) + [
        f"{who.label}: it did not run" for who, result in told.items() if result is None
    ]
    versions = {
        name: value
        for result in found.values()
        for name, value in result.versions.items()
        if name != "numpy"
    }
    page = [
        "# Whole processes: six campaigns of W4", "",
        f"SIR on the 15-state INS error model, {runs} Monte Carlo runs, {steps} steps, 500 particles, six times by six seeds. "
        "Each contestant is a fresh process on one thread that imports, compiles or finds on disk what was compiled, filters and "
        f"ends; {chosen.rounds} interleaved rounds after a pass that filled the caches; CPU time of the process. Ratios are "
        "taken round by round. Written by `make bench`.", "",
        *table(found, bad), "",
        ", ".join([f"{cpu_name()}; Python {platform.python_version()}", *map(" ".join, versions.items())]) + ".", "",
    ]  # fmt: skip
    (chosen.out / "campaigns.md").write_text("\n".join(page))
    draw(found, chosen.out / "campaigns.png")
    print("\n".join(page))
    sys.exit("; ".join(bad) if bad else 0)


if __name__ == "__main__":
    main()
