"""Checks of the times of each table alone: order, repeats, gaps, jitter and rate."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from pfbench.files.table_file import Array
from pfbench.logs.doctor.finding import REFUSE, TELL, WARN, Finding, Picture, thin_curve
from pfbench.logs.doctor.raw_log import RawLog, take_rows
from pfbench.logs.doctor.thresholds import limit_of
from pfbench.logs.worlds.imu_gaps import LONGEST_BRIDGE

KEYS = ("imu", "gnss", "reference")  # tables in settings
_MOST_REPEATS, _SPREAD = (
    0.2,
    99.0,
)  # share of rows that repeat a time, and percent of the intervals within the jitter


def check_clocks(log: RawLog, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check the times of all tables as recorded."""
    times = (log.imu.time, log.fixes.time, log.reference.time)
    for number, time in enumerate(times):
        yield from _check_order(log, number, time) if len(time) else ()
        increasing = np.unique(time)
        if len(increasing) < 2:
            continue
        facts[f"{KEYS[number]} rate"] = float(1.0 / np.median(np.diff(increasing)))
        if KEYS[number] == "imu":
            yield from _check_imu(log.names[0], increasing, facts)
        if KEYS[number] == "gnss":
            yield from _check_holes(log.names[1], increasing)


def sort_tables(log: RawLog) -> RawLog:
    """Sort each table by time, and keep the first row of each time."""
    imu, fixes, reference = (
        np.unique(table.time, return_index=True)[1] for table in (log.imu, log.fixes, log.reference)
    )
    return log._replace(
        imu=take_rows(log.imu, imu),
        fixes=take_rows(log.fixes, fixes),
        reference=take_rows(log.reference, reference),
    )


def _check_order(log: RawLog, number: int, time: Array) -> Iterator[Finding]:
    """Check that the times of a table increase without repeats."""
    key, name = KEYS[number], log.names[number]
    step = np.diff(time)
    back, count = np.flatnonzero(step < 0.0), len(time) - len(np.unique(time))
    settings = {"corrections": {"times": {key: "sort"}}}
    picture = Picture("row", "t [s]", (thin_curve(name, np.arange(len(time)), time),))  # fmt: skip
    allowed = limit_of("repeated times") if key == "imu" else 0
    is_copy = back.size > 0 and bool(np.isin(time[back + 1], time[: back[0] + 1]).all())
    if back.size and not is_copy:
        i = int(back[0]) + 1
        yield Finding(
            "time order", REFUSE, float(back.size), limit_of("time order"), "rows",
            f"{name}: t goes back in {log.row(number, i)}, from {time[i - 1]:.3f} to "
            f"{time[i]:.3f}, and in {back.size} rows in all",
            f"Sort the rows by t, or set +scenario.corrections.times.{key}=sort",
            settings, picture=picture,
        )  # fmt: skip
    if count > allowed or is_copy:
        i = int(np.flatnonzero(step <= 0.0)[0]) + 1
        is_rounded = count > _MOST_REPEATS * len(time)  # one row of each time is not the log
        yield Finding(
            "repeated times", REFUSE, float(count), allowed, "rows",
            f"{name}: {count} rows repeat the time of another row, the first is "
            f"{log.row(number, i)} (t = {time[i]:.3f})",
            "The times have lost digits: write t with more of them" if is_rounded
            else f"Keep one row for each time, or set +scenario.corrections.times.{key}=sort",
            {} if is_rounded else settings, picture=picture,
        )  # fmt: skip


def _check_imu(name: str, time: Array, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check gaps, jitter and rate of the IMU."""
    step = np.diff(time)
    typical = float(np.median(step))
    i, longest = int(step.argmax()), max(limit_of("imu gap"), 3.0 * typical)
    jitter = float(np.percentile(np.abs(step - typical), _SPREAD)) / typical
    facts.update({"imu longest step": float(step[i]), "imu jitter": jitter})
    picture = Picture("t [s]", "interval [s]", (thin_curve(name, time[1:], step),))
    if step[i] > longest + 1e-9:
        is_bridged = step[i] <= max(LONGEST_BRIDGE, 3.0 * typical)
        remedy = (
            "The reader bridges it with noise of the log"
            if is_bridged
            else "Keep the longest part without a gap, or set scenario.corrections.gaps=longest"
        )
        yield Finding(
            "imu gap", TELL if is_bridged else REFUSE, float(step[i]), longest, "s",
            f"{name}: no sample for {step[i]:.3f} s after t = {time[i]:.3f}, with samples every "
            f"{typical:.4f} s", remedy,
            {} if is_bridged else {"corrections": {"gaps": "longest"}},
            ("a hole of the recording", "a jump of the clock"), picture._replace(marks=(float(time[i]),)),
        )  # fmt: skip
    if jitter > limit_of("imu jitter"):
        yield Finding(
            "imu jitter", WARN, jitter, limit_of("imu jitter"), "samples",
            f"{name}: 1 % of the intervals differ by more than {jitter:.1f} samples from the usual one",
            "Use the time of the sensor in place of that of the recorder, or set "
            "+scenario.corrections.times.imu=even",
            {"corrections": {"times": {"imu": "even"}}}, picture=picture,
        )  # fmt: skip
    if 1.0 / typical < limit_of("imu rate"):
        yield Finding(
            "imu rate", WARN, 1.0 / typical, limit_of("imu rate"), "Hz",
            f"{name}: {1.0 / typical:.1f} samples per second are too few for dead reckoning",
            "Record with 50 Hz or more: motion between samples is lost", picture=picture,
        )  # fmt: skip


def _check_holes(name: str, time: Array) -> Iterator[Finding]:
    """Check for long times without a fix."""
    step = np.diff(time)
    i, longest = int(step.argmax()), max(limit_of("fix hole"), 5.0 * float(np.median(step)))
    if step[i] > longest:
        yield Finding(
            "fix hole", TELL, float(step[i]), longest, "s",
            f"{name}: no fix for {step[i]:.1f} s after t = {time[i]:.1f}",
            "The filters predict without a fix there",
            picture=Picture("t [s]", "interval [s]", (thin_curve(name, time[1:], step),),
                            (float(time[i]),)),
        )  # fmt: skip
