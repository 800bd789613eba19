"""Faults drawn by a stored seed from a grammar: unit, axes, frame, clock, jump, ramp, drop-out, duplication, saturation, column.

`PYTHONPATH=.:tests python tests/drawn_faults.py [LOG ...]` prints what the inspection says of each fault, and the error of
an EKF with the printed settings over that of the clean log.
"""

import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from log_faults import (  # fmt: skip
    ANGLES,
    FORCE,
    LISTED,
    POSITION,
    RATE,
    SHARED,
    VELOCITY,
    Tables,
    added,
    both,
    changed,
    late,
    law,
    mixed,
    mounted,
    scaled,
    shared_tables,
    turned,
)
from synthetic_log import write

from pfbench.core.random_stream import PhiloxStream
from pfbench.filter.loop import run_filter
from pfbench.job import JobPlan, build_plan, compose
from pfbench.logs.doctor.axis_orders import BODY_ORDERS, LEVEL_ORDERS, name_axes
from pfbench.scenario import LogCorrections, inspect_log

SEED, COUNT = 57, 40
LONGEST = 60.0  # s of a cut
SPOILT = 1.2  # times the error of the clean log
Rng = np.random.Generator
Plant = Callable[[Tables], None]


class Drawn(NamedTuple):
    """A fault: its name, the checks that are right, and the rows that it takes, which nothing gives back."""

    name: str
    plant: Plant
    right: frozenset[str]
    lost: Plant = both()


def fault(name: str, plant: Plant, right: str, lost: Plant = both()) -> Drawn:  # noqa: B008
    return Drawn(name, plant, frozenset(right.split(", ")), lost)


# columns by table, names of them, and the checks that are right: of a unit, of other columns, and of a change over time
GROUPS = {
    "force": ("imu", FORCE, "unit of force, force scale", "axes, dead axis, accelerometer bias, unit of force", "accelerometer bias drift"),
    "rate": ("imu", RATE, "unit of rate", "axes, mounting, common motion", "gyro bias drift"),
    "fixes": ("gnss", POSITION, "fix scale", "fix axes, fix shift", "slow errors, fix shift, fix turn, fix scale"),
    "velocity": ("reference", VELOCITY, "reference velocity", "reference velocity", "slow errors, fix shift, reference velocity"),
    "attitude": ("reference", ANGLES, "unit of attitude", "axes, mounting, common motion, unit of attitude", "attitude jump, heading, mounting, gyro bias, gyro bias drift"),
}  # fmt: skip
UNITS = {
    "force": {"g": 1 / 9.80665, "mg": 1e3 / 9.80665, "ft/s^2": 3.28084},
    "rate": {"deg/s": 57.29578, "mrad/s": 1e3, "deg/h": 206264.8},
    "fixes": {"ft": 3.28084, "km": 1e-3, "yd": 1.093613},
    "velocity": {"km/h": 3.6, "kn": 1.943844, "cm/s": 100.0, "ft/s": 3.28084},
    "attitude": {"deg": 57.29578, "0.1 deg": 572.9578, "0.01 deg": 5729.578, "gon": 63.66198},
}
CHANGES = {"force": (1.5, 3.0), "rate": (0.05, 0.14), "fixes": (8.0, 40.0), "attitude": (0.25, 1.0)}


def pick(rng: Rng, options: object) -> str:
    return str(rng.choice(list(options)))  # type: ignore[call-overload]


def draw_unit(rng: Rng) -> Drawn:
    what = pick(rng, UNITS)
    unit, (table, columns, right, *_) = pick(rng, UNITS[what]), GROUPS[what]
    columns = ["yaw"] if what == "attitude" and rng.uniform() < 0.5 else columns
    return fault(f"unit: {', '.join(columns)} in {unit}", scaled(table, columns, UNITS[what][unit]), right)  # fmt: skip


def draw_axes(rng: Rng) -> Drawn:
    what = pick(rng, ("imu", "rate", "force", "fixes", "reference"))
    groups = {"imu": (RATE, FORCE), "reference": (POSITION, VELOCITY)}.get(what) or (GROUPS[what][1],)  # fmt: skip
    is_level = what in ("fixes", "reference")
    orders = LEVEL_ORDERS if is_level else BODY_ORDERS
    axes = name_axes(orders[rng.integers(1, len(orders))], is_level)
    table = {"fixes": "gnss", "reference": "reference"}.get(what, "imu")
    places = [f"{'-' * (a[0] == '-')}{{{('ned' if is_level else 'xyz').index(a[-1])}}}" for a in axes]  # fmt: skip
    plants = [mixed(table, g, [place.format(*g) for place in places]) for g in groups]
    right = "fix axes" if what == "fixes" else "axes, mounting"
    return fault(f"axes: {what} [{','.join(axes)}]", both(*plants), right)


def draw_frame(rng: Rng) -> Drawn:
    what, angle = pick(rng, ("sensor", "fixes", "reference", "yaw", "datum")), rng.choice([-1, 1]) * rng.uniform(8.0, 40.0)  # fmt: skip
    angles, yaw = rng.uniform(-35.0, 35.0, 3).round(1), added("reference", "yaw", np.radians(angle))
    plants = {
        "sensor": (mounted(*angles), "mounting, axes"),
        "fixes": (turned("gnss", angle, POSITION), "fix turn"),
        "reference": (both(turned("reference", angle, POSITION, VELOCITY), yaw), "fix turn"),
        "yaw": (yaw, "heading, mounting, axes"),
        "datum": (added("gnss", "pn", 4.0 * angle), "fix shift"),
    }
    return fault(f"frame: {what} {angles.tolist() if what == 'sensor' else round(angle)}", *plants[what])  # fmt: skip


def draw_clock(rng: Rng) -> Drawn:
    what = pick(rng, ("imu", "gnss", "reference", "drift", "rounded"))
    size = float(rng.choice([-1, 1]) * np.exp(rng.uniform(np.log(0.1), np.log(10.0))))
    if what == "drift":
        plant = changed("imu", lambda rows, s: rows.assign(t=rows.t + 0.02 * size * s))
        return fault(f"clock: imu {0.02 * size:+.3f} s at the end", plant, "imu clock drift, imu clock, imu jitter")  # fmt: skip
    if what == "rounded":
        return fault("clock: imu to 0.1 s", changed("imu", lambda rows, s: rows.assign(t=rows.t.round(1))), "repeated times, imu jitter")  # fmt: skip
    return fault(f"clock: {what} {size:+.2f} s", late(what, size), "gnss clock, imu clock, overlap")


def draw_change(rng: Rng, is_ramp: bool = False) -> Drawn:
    what, at, sign = pick(rng, CHANGES), rng.uniform(0.3, 0.7), rng.choice([-1, 1])
    (table, columns, *_, right), size = GROUPS[what], sign * rng.uniform(*CHANGES[what])
    column = "yaw" if what == "attitude" else pick(rng, columns[: 2 if what == "fixes" else 3])
    name = f"ramp: {column} {size:+.2f}" if is_ramp else f"jump: {column} {size:+.2f} at {at:.2f}"
    return fault(name, law(table, column, lambda s: size * (s if is_ramp else s > at)), right)


def draw_dropout(rng: Rng) -> Drawn:
    what, at, width = pick(rng, ("imu", "gnss", "zeros")), rng.uniform(0.3, 0.6), rng.uniform(0.02, 0.06)  # fmt: skip
    if what == "zeros":
        column = pick(rng, FORCE + RATE)
        plant = changed("imu", lambda rows, s: rows.assign(**{column: rows[column] * (s < at)}))
        return fault(f"drop-out: {column} of 0 from {at:.2f} on", plant, "dead axis")
    width *= 4.0 if what == "gnss" else 1.0
    plant = changed(what, lambda rows, s: rows[(s < at) | (s > at + width)])
    return fault(f"drop-out: {width:.0%} of {what}", plant, "fix hole, imu gap", plant)


def draw_duplication(rng: Rng) -> Drawn:
    what, at, n = pick(rng, ("imu", "gnss", "held")), rng.uniform(0.3, 0.6), int(rng.integers(4, 9))  # fmt: skip
    if what == "held":
        plant = changed("gnss", lambda rows, s: rows.assign(**rows[POSITION].iloc[np.arange(len(s)) // n * n].reset_index(drop=True)))  # fmt: skip
        return fault(f"duplication: each fix {n} times", plant, "frozen fixes", changed("gnss", lambda rows, s: rows[::n]))  # fmt: skip
    plant = changed(what, lambda rows, s: pd.concat([rows[s < at], rows[s >= at - n * np.diff(s).mean()]]))  # fmt: skip
    return fault(f"duplication: {n} rows of {what}", plant, "repeated times, time order")


def draw_saturation(rng: Rng) -> Drawn:
    columns, share = (FORCE, RATE)[int(rng.integers(2))], rng.uniform(0.3, 0.6)

    def clip(rows: pd.DataFrame, s: np.ndarray) -> pd.DataFrame:
        reach = share * float((rows[columns] - rows[columns].median()).abs().quantile(0.99).max())
        return rows.assign(**rows[columns].clip(rows[columns].median() - reach, rows[columns].median() + reach, axis=1))  # fmt: skip

    return fault(f"saturation: {columns[0][0]} at {share:.0%}", changed("imu", clip), "saturated axis")  # fmt: skip


def draw_column(rng: Rng) -> Drawn:
    what, (i, j) = pick(rng, GROUPS), rng.permutation(3)[:2]
    table, columns, _, right, _ = GROUPS[what]
    order = [columns[j] if k == i else column for k, column in enumerate(columns)]
    return fault(
        f"column: {columns[j]} under {columns[i]}",
        mixed(table, columns, order),
        f"repeated column, {right}",
    )


KINDS = (
    draw_unit, draw_axes, draw_frame, draw_clock, draw_change,
    partial(draw_change, is_ramp=True), draw_dropout, draw_duplication, draw_saturation, draw_column,
)  # fmt: skip


def draw_faults(seed: int = SEED, count: int = COUNT) -> list[Drawn]:
    """Draw faults, each kind in turn."""
    rng = np.random.default_rng(seed)
    return [KINDS[i % len(KINDS)](rng) for i in range(count)]


def draw_pairs(seed: int = SEED, count: int = COUNT) -> Iterator[Drawn]:
    """Draw pairs of faults."""
    faults, order = draw_faults(seed, count), np.random.default_rng(seed).permutation(count)
    for i in range(count):
        a, b = faults[order[i]], faults[order[(i + 1) % count]]
        yield Drawn(f"{a.name} + {b.name}", both(a.plant, b.plant), a.right | b.right, both(a.lost, b.lost))  # fmt: skip


# What the inspection says, and what the printed settings do to a filter.


def cut(name: str) -> Tables:
    """The middle of a shared log."""
    log = shared_tables(name)
    first, last = log["imu"]["t"].iloc[[0, -1]]
    start = max(first, 0.5 * (first + last - LONGEST))
    return {
        key: t[t["t"].between(start, start + LONGEST)].reset_index(drop=True)
        for key, t in log.items()
    }


@cache
def plan_of(folder: Path) -> JobPlan:
    words = [f"data.root={folder.parent}", f"scenario.folder={folder.name}"]
    return build_plan(compose(["scenario=user_log", "filter=ekf", *words]))


def errors_of(folder: Path, settings: Mapping[str, Any]) -> pd.Series:
    """Mean square of the position error of an EKF behind the first ten seconds, m^2, by time."""
    plan = plan_of(folder)
    keys = {**settings, "corrections": LogCorrections(**settings.get("corrections", {}))}
    episode = replace(plan, scenario=replace(plan.scenario, **keys)).draw_episode(torch.arange(4))
    with torch.no_grad():
        draws = PhiloxStream(1, torch.arange(4))
        result = run_filter(plan.method, plan.model, episode.record, draws)
    error = result.mean[..., 7:10] - episode.truth["position"]
    after = episode.time > episode.time[0] + 10.0
    return pd.Series(error[:, after].square().sum(-1).nanmean(0).numpy(), episode.time[after].numpy())  # fmt: skip


def ratio_of(folder: Path, settings: Mapping[str, Any], tables: Tables, drawn: Drawn) -> float:
    """Ratio of the errors with settings to those of the clean log, which lacks the rows that the fault takes, too."""
    best = {key: table.copy() for key, table in tables.items()}
    drawn.lost(best)
    gaps = {"corrections": {"gaps": "longest"}} if len(best["imu"]) < len(tables["imu"]) else {}
    clean = errors_of(write(folder.parent / "clean", best), gaps)
    try:
        errors = errors_of(folder, settings)
    except ValueError:
        return np.inf
    first, last = (f(errors.index[k], clean.index[k]) for k, f in ((0, max), (-1, min)))
    return float(np.sqrt(errors.loc[first:last].mean() / clean.loc[first:last].mean()))


class Outcome(NamedTuple):
    """What is said of a fault, checks, settings, and the ratio of errors of an EKF with the settings.

    Misleading is a printed remedy that spoils the filter, or a wrong cause alone. Silent is nothing, where the filter is
    spoilt. Unexplained is the sentence that nothing that was tried explains the log.
    """

    word: str
    checks: tuple[str, ...]
    settings: Mapping[str, Any]
    ratio: float = np.nan


def judge(drawn: Drawn, log: str, tables: Tables, folder: Path) -> Outcome:
    """Inspect a log with a fault."""
    spoilt = {key: table.copy() for key, table in tables.items()}
    drawn.plant(spoilt)
    write(folder, spoilt)
    found = inspect_log(folder)
    own = LISTED.get(log, set()) - drawn.right
    checks = tuple(f.check for f in found.findings if f.check not in own)
    settings, is_named = dict(found.settings), bool((drawn.right | {"reading"}) & set(checks))
    if is_named and not settings:
        return Outcome("right", checks, settings)
    if any("Nothing that was tried" in finding.remedy for finding in found.findings):
        return Outcome("unexplained", checks, settings)
    ratio = ratio_of(folder, settings, tables, drawn)
    if ratio <= SPOILT:
        return Outcome("right" if is_named else "mended" if settings else "harmless", checks, settings, ratio)  # fmt: skip
    return Outcome("misleading" if settings or checks else "silent", checks, settings, ratio)


def main(logs: list[str]) -> None:
    table: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as place:
        for log in logs:
            tables = cut(log)
            pairs = [d for k, d in enumerate(draw_pairs()) if list(SHARED)[k % len(SHARED)] == log]
            for kind, faults in (("single", draw_faults()), ("pair", pairs)):
                for drawn in faults:
                    out = judge(drawn, log, tables, Path(place) / "spoilt")
                    table[kind, out.word] += 1
                    print(kind, log, out.word, f"{out.ratio:.2f}", drawn.name, "->", out.checks, out.settings, sep=" | ", flush=True)  # fmt: skip
    print(pd.Series(table).unstack(fill_value=0))


if __name__ == "__main__":
    main(sys.argv[1:] or list(SHARED))
