"""W1 to W5: pfbench, its peers and a fused C loop side by side in one run. Writes compare.json and compare.md.

    make bench      (or: python benchmarks/compare.py --numba .venv-bench/bin/python --jax .venv-peers/bin/python --rounds 9)

One thread each, one process at a time, interleaved rounds (see race.py), warm. All contestants of a workload filter the same
data, deliver mean, variance and effective sample size at every step and the log evidence where they have one, and are checked
to have computed the same thing. `--only W1` times some workloads again and takes the others from compare.json; `--only none`
writes the page anew. `--scale 0.1 --out FOLDER` is for trying it out.
"""

from __future__ import annotations

import argparse
import platform
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import problems
import workload
from race import HERE, Contestant, Result, cpu_name, load_results, race, store_results

TOLERANCE = 4.5  # standard errors, in some hundred comparisons
EXACT = (
    0.05  # of the log evidence, where filters draw nothing: two round differently, or add a jitter
)

DEFAULT = Contestant("pfbench, default settings", "own", ("house.py", "float64", "auto"))
DEFAULT32 = Contestant("pfbench float32, default engine", "own", ("house.py", "float32", "auto"))
FLOAT32 = Contestant("pfbench float32, compiled", "own", ("house.py", "float32", "compiled"))
LOOPS = Contestant("pfbench float32, kernels", "own", ("house.py", "float32", "kernels"))
EAGER = Contestant("pfbench float32, eager", "own", ("house.py", "float32", "eager"))
FLOAT64 = Contestant("pfbench float64, compiled", "own", ("house.py", "float64", "compiled"))
LIMIT = Contestant("fused C", "own", ("fused.py",))
JAX = Contestant("JAX, jitted scan", "jax", ("peer_jax.py", "vmap", "search", "float32"))
COUNT = Contestant("JAX, counting", "jax", ("peer_jax.py", "vmap", "count", "float32"))
COUNT64 = Contestant("JAX float64, counting", "jax", ("peer_jax.py", "vmap", "count", "float64"))
CUTHBERT = Contestant("cuthbert", "jax", ("peer_cuthbert.py",))
PYRO = Contestant("Pyro SMCFilter", "own", ("peer_pyro.py",))
FILTERPY = Contestant("FilterPy", "jax", ("peer_filterpy.py", "sir"))
STONESOUP = Contestant("Stone Soup", "jax", ("peer_stonesoup.py", "sir"))
NUMBA = Contestant("particles", "numba", ("peer_particles.py",))
LARGE = (DEFAULT, FLOAT64, LOOPS, FLOAT32, EAGER, LIMIT, JAX, COUNT, COUNT64, NUMBA, CUTHBERT)
SMALL = (*LARGE, PYRO, FILTERPY, STONESOUP)
BATCH = (
    DEFAULT, FLOAT64, DEFAULT32, FLOAT32, EAGER, LIMIT, JAX, COUNT, COUNT64,
    Contestant("JAX, run by run", "jax", ("peer_jax.py", "loop", "count", "float32")),
    Contestant("particles float32", "numba", ("peer.py", "float32")),
    Contestant("particles float64", "numba", ("peer.py", "float64")), CUTHBERT,
    Contestant("naive torch float32", "own", ("naive.py", "float32")),
)  # fmt: skip
FEW = tuple(who for who in BATCH if who not in (EAGER, JAX, CUTHBERT, BATCH[-1]))  # the fast ones
GAUSSIAN = (
    DEFAULT._replace(words=("house.py", "float64", "auto", "ckf")),
    DEFAULT32._replace(words=("house.py", "float32", "auto", "ckf")),
    Contestant("pfbench float32, eager", "own", ("house.py", "float32", "eager", "ckf")),
    Contestant("dynamax", "jax", ("peer_dynamax.py",)),
    Contestant("FilterPy", "jax", ("peer_filterpy.py", "ckf")),
    Contestant("Stone Soup", "jax", ("peer_stonesoup.py", "ckf")),
)
LIBRARIES = ("JAX", "particles", "cuthbert", "Pyro SMCFilter", "FilterPy", "dynamax", "Stone Soup")


class Case(NamedTuple):
    """A workload: name, what it is, sizes, who takes part."""

    name: str
    said: str
    kind: str
    runs: int
    steps: int
    particles: int
    contestants: tuple[Contestant, ...]
    zeros: str = "model"  # of the coefficients of W4, see workload.make


class Goal(NamedTuple):
    """A workload, whose time counts (None: the fastest of pfbench), and how many times as fast as the fastest peer it must and should be.

    Zero: it is stated without a goal.
    """

    workload: str
    label: str | None
    must: float = 0.0
    aim: float = 0.0


CASES = (
    Case("W1, N = 1e3", "growth model", "growth", 1, 100, 1000, SMALL),
    Case("W1, N = 1e4", "growth model", "growth", 1, 100, 10_000, SMALL),
    Case("W1, N = 1e5", "growth model", "growth", 1, 100, 100_000, LARGE),
    Case("W2, N = 1e4", "stochastic volatility", "volatility", 1, 1000, 10_000, LARGE),
    Case("W3, N = 1e4", "constant velocity, bearing and range", "radar", 1, 100, 10_000, SMALL),
    Case("W4, N = 500", "15-state INS error model", "ins", 100, 200, 500, BATCH),
    Case(
        "W4 dense, N = 500", "15-state model, no coefficient 0", "ins", 100, 200, 500, FEW, "none"
    ),
    Case(
        "W4 sparse, N = 500",
        "15-state model, 8 of 10 coefficients 0",
        "ins",
        100,
        200,
        500,
        FEW,
        "small",
    ),
    Case("W5", "cubature filter on W4's model", "ins", 100, 200, 500, GAUSSIAN),
)
GOALS = (
    *(Goal(case.name, DEFAULT.label) for case in CASES if case.name != "W5"),
    Goal("W5", DEFAULT.label, 1.2, 2.0),
    Goal("W1, N = 1e3", FLOAT64.label, 0.8, 1.2), Goal("W1, N = 1e4", FLOAT64.label, 1.2, 1.5),
    Goal("W1, N = 1e5", FLOAT64.label, 1.5, 2.0), Goal("W2, N = 1e4", FLOAT64.label, 1.3, 1.6),
    Goal("W3, N = 1e4", FLOAT64.label, 1.5, 2.0), Goal("W4, N = 500", FLOAT64.label, 2.0, 2.6),
    Goal("W1, N = 1e3", None, 1.0, 1.4), Goal("W1, N = 1e4", None, 1.8, 2.2),
    Goal("W1, N = 1e5", None, 3.0, 4.0), Goal("W2, N = 1e4", None, 2.0, 2.5),
    Goal("W3, N = 1e4", None, 2.8, 3.5), Goal("W4, N = 500", None, 4.3, 5.0),
    Goal("W4 dense, N = 500", None, 4.3, 5.0), Goal("W4 sparse, N = 500", None, 4.3, 5.0),
)  # fmt: skip


def work(case: Case, scale: float) -> Mapping[str, Any]:
    """The workload's arrays; `scale` shortens it for a trial."""
    steps = max(10, round(case.steps * scale))
    if case.kind == "ins":
        return {
            **workload.make(
                max(4, round(case.runs * scale)), steps, case.particles, zeros=case.zeros
            )._asdict(),
            "kind": np.array("ins"),
        }
    return problems.make(case.kind, steps, case.particles)._asdict()


def disagreements(found: Mapping[Contestant, Result], exact: bool) -> list[str]:
    """Contestants that did not compute the same: against the mean of all others, in standard errors over rounds and runs."""
    said = []
    for name, what in (("evidence", "log evidence"), ("normalised", "mean square error")):
        values = {
            who: result.qualities[name]
            for who, result in found.items()
            if not np.isnan(result.qualities[name]).any()
        }
        for who, own in values.items() if len(values) > 1 else ():
            others = np.concatenate([other for key, other in values.items() if key is not who])
            off = own.mean(0) - others.mean(0)  # of each run
            if exact:
                most = float(np.abs(off).max())
                if not most <= (EXACT if name == "evidence" else 1e-2 * others.mean()):
                    said.append(f"{who.label}: {what} differs from the others' by up to {most:.2g}")
                continue
            if len(off) > 1:
                error = off.std(ddof=1) / np.sqrt(len(off))
            else:
                error = np.sqrt(own.var(ddof=1) / len(own) + others.var(ddof=1) / len(others))
            if not abs(off.mean()) < TOLERANCE * error:
                said.append(
                    f"{who.label}: {what} differs from the others' by {off.mean():.3g} +- {error:.2g}"
                )
    return said


def fastest(
    found: Mapping[Contestant, Result], wanted: Callable[[Contestant], bool]
) -> Contestant | None:
    """Of those that are wanted, the one with the smallest median."""
    return min(
        filter(wanted, found), key=lambda who: float(np.median(found[who].cpu)), default=None
    )


def named(label: str) -> Callable[[Contestant], bool]:
    """The one with this label."""
    return lambda who: who.label == label


def starting(label: str) -> Callable[[Contestant], bool]:
    """Those whose labels begin so."""
    return lambda who: who.label.startswith(label)


def ratio(slow: Result, fast: Result) -> tuple[float, float, float]:
    """Quartiles of one's time over the other's, round by round."""
    low, middle, high = np.quantile(slow.cpu / fast.cpu, [0.25, 0.5, 0.75])
    return float(low), float(middle), float(high)


def peer(who: Contestant) -> bool:
    return who.label.startswith(LIBRARIES)


def own(who: Contestant) -> bool:
    return who.label.startswith("pfbench")


def section(
    case: Case, found: Mapping[Contestant, Result], bad: list[str], scale: float
) -> list[str]:
    """The table of one workload."""
    best, limit = fastest(found, peer), found.get(LIMIT)
    runs, steps = (
        next(iter(found.values())).qualities["evidence"].shape[1],
        max(10, round(case.steps * scale)),
    )
    size = f"{case.said}; R = {runs}, T = {steps}"
    lines = [
        "", f"## {case.name}", "", f"{size[0].upper()}{size[1:]}.", "",
        f"| | CPU ms, median (quartiles) | times as fast as {best.label if best else '-'} (quartiles) | times fused C's time "
        "| log evidence | mean square error | s until warm |",
        "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    for who, result in found.items():
        low, middle, high = np.quantile(result.cpu, [0.25, 0.5, 0.75])
        quick = "{1:.2f} ({0:.2f}-{2:.2f})".format(*ratio(found[best], result)) if best else "-"
        behind = f"{ratio(result, limit)[1]:.1f}" if limit else "-"
        evidence, error = (result.qualities[name].mean(1) for name in ("evidence", "normalised"))
        told = (
            "-"
            if np.isnan(evidence).any()
            else f"{evidence.mean():.2f} ± {evidence.std(ddof=1) / len(evidence) ** 0.5:.2f}"
        )
        lines.append(
            f"| {who.label} | {middle:.3g} ({low:.3g}-{high:.3g}) | {quick} | {behind} | {told} | {error.mean():.4g} "
            f"| {result.start / 1e3:.1f} |"
        )
    lines += [
        "",
        "**Not the same work:** " + "; ".join(bad) + "." if bad else "All contestants agree.",
    ]
    return lines


def summary(found: Mapping[Case, Mapping[Contestant, Result]]) -> list[str]:
    """The goals, missed ones first, and what became of them."""
    by_name = {case.name: results for case, results in found.items()}
    rows, missed = [], []
    for goal in GOALS:
        results = by_name.get(goal.workload, {})
        ours, theirs = (
            fastest(results, named(goal.label) if goal.label else own),
            fastest(results, peer),
        )
        if ours is None or theirs is None:
            continue
        low, middle, high = ratio(results[theirs], results[ours])
        if middle < goal.must:
            # what a program for this one model reaches on the same machine
            fused = ratio(results[theirs], results[LIMIT])[1] if LIMIT in results else 0.0
            bound = f" (fused C: {fused:.2f})" if fused else ""
            missed.append(
                f"{goal.workload}, {ours.label}: {middle:.2f} times {theirs.label}, must {goal.must:g}{bound}"
            )
        limit = results.get(LIMIT)
        behind = f"{ratio(results[ours], limit)[1]:.1f}" if limit else "-"
        rows.append(
            f"| {goal.workload} | {ours.label} | {theirs.label} | {middle:.2f} ({low:.2f}-{high:.2f}) | {_goal(middle, goal.must)} "
            f"| {_goal(middle, goal.aim)} | {behind} |"
        )
    return [
        f"Missed: {'; '.join(missed)}." if missed else "No goal is missed.",
        "",
        "| workload | pfbench | fastest peer | times as fast (quartiles) | must | aim | times fused C's time |",
        "|---|---|---|---|---|---|---|",
        *rows,
    ]


def _goal(value: float, wanted: float) -> str:
    return f"{wanted:g}, {'met' if value >= wanted else 'missed'}" if wanted else "-"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "--numba",
        default="",
        help="Python that has the library particles; without, it takes no part",
    )
    parser.add_argument(
        "--jax",
        default="",
        help="Python that has jax, cuthbert, dynamax, filterpy and stonesoup; likewise",
    )
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument(
        "--scale", type=float, default=1.0, help="below 1: shorter and smaller, to try it out"
    )
    parser.add_argument("--only", default="", help="workloads whose names begin so")
    parser.add_argument(
        "--without", default="", help="contestants that take no part, by parts of their labels"
    )
    parser.add_argument("--out", type=Path, default=HERE, help="folder for compare.md")
    chosen = parser.parse_args()
    places = {
        name: path
        for name, path in (("own", sys.executable), ("numba", chosen.numba), ("jax", chosen.jax))
        if path
    }
    absent = tuple(word for word in chosen.without.split(",") if word)
    path = chosen.out / "compare.json"
    for case in (case for case in CASES if case.name.startswith(chosen.only)):
        there = [
            who
            for who in case.contestants
            if who.place in places and not any(word in who.label for word in absent)
        ]
        results = race(work(case, chosen.scale), there, places, chosen.rounds)
        store_results(
            path, case.name, {who.label: result for who, result in zip(there, results, strict=True)}
        )
    found: dict[Case, dict[Contestant, Result]] = {}
    lines, wrong, versions, rounds = [], [], {}, set()
    for case in CASES:
        stored = load_results(path, case.name)
        if not stored:
            continue
        found[case] = {who: result for who in case.contestants if (result := stored.get(who.label))}
        failed = [f"{label}: it did not run" for label, result in stored.items() if result is None]
        bad = disagreements(found[case], exact=case.name == "W5") + failed
        wrong += [f"{case.name}, {text}" for text in bad]
        lines += section(case, found[case], bad, chosen.scale)
        absentees = [who.label for who in case.contestants if who.label not in stored]
        lines += ["", f"Not timed: {', '.join(absentees)}."] if absentees else []
        for result in found[case].values():
            versions |= {name: value for name, value in result.versions.items() if name != "numpy"}
            rounds.add(len(result.cpu))
    late = [case.name for case in CASES if case not in found]
    missing = [f"Not timed in this edition: {'; '.join(late)}."] if late else []
    page = [
        "# pfbench and its peers", "",
        *summary(found), "", *missing, "",
        f"`{DEFAULT.label}`: float64 and `engine=auto`, which took kernels when this was measured, before there was a tape. `{FLOAT64.label}`: "
        "the same job with `engine=compiled`. C++ called its steps, as it no longer does. Its s until warm contain the compilation. "
        "Below 5 s they are of an edition that stored compiled steps on disk, as pfbench no longer does.", "",
        f"One thread each, one process at a time, {' or '.join(map(str, sorted(rounds)))} interleaved rounds after a warm-up; "
        "CPU time of the process; systematic resampling at every step. Every contestant delivers mean, variance and effective "
        "sample size at every step and, where it has one, the log evidence (of W4 and W5: minus the exact one). Ratios are taken "
        "round by round. Workloads "
        "are timed one by one (`--only`), so pfbench's edition may differ between them. Written by `benchmarks/compare.py` from "
        "compare.json.", *lines, "",
        ", ".join([f"{cpu_name()}; Python {platform.python_version()}", *map(" ".join, versions.items())]) + ".",
        "",
    ]  # fmt: skip
    (chosen.out / "compare.md").write_text("\n".join(page))
    print("\n".join(page))
    sys.exit("; ".join(wrong) if wrong else 0)


if __name__ == "__main__":
    main()
