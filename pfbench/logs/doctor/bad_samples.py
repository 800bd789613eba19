"""Samples of the IMU that cannot be measurements: absurd values, single spikes, and values that do not change."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pfbench.files.table_file import Array
from pfbench.logs.doctor.finding import TELL, WARN, Finding, Picture, thin_curve
from pfbench.logs.doctor.raw_log import RawLog
from pfbench.logs.doctor.thresholds import SPIKE_DEVIATIONS, limit_of

_COLUMNS = ("fx", "fy", "fz", "wx", "wy", "wz")
_POSITION = ("pn", "pe", "pd")
_BLOCK, _FEWEST = 50, 50  # differences of a local level, and at least
_LARGEST = (320.0, 70.0)  # m/s^2 and rad/s: absurd, ten times what platforms reach
_AWAY, _OF_USUAL = (
    0.2,
    10.0,
)  # of the range, from the median to a saturated value; times the value that 99 % do not reach


class BadSamples(NamedTuple):
    """Wrong samples of a column.

    Attributes:
        absurd: Rows that no sensor can measure.
        spikes: Rows that jump there and back.
        ratio: Largest jump there and back, in local levels.
    """

    absurd: NDArray[np.intp]
    spikes: NDArray[np.intp]
    ratio: float


def find_bad_samples(values: Array, is_force: bool) -> BadSamples:
    """Find the wrong samples of a column.

    Args:
        values: Samples, [n].
        is_force: Whether the column is a specific force.

    Returns:
        Rows of the wrong samples.
    """
    finite = np.isfinite(values)
    usual = float(np.percentile(np.abs(values[finite]), 99.0)) if finite.any() else 0.0
    limit = max(_LARGEST[0] if is_force else _LARGEST[1], _OF_USUAL * usual)  # also in other units
    is_absurd = ~finite | (np.abs(np.where(finite, values, 0.0)) > limit)
    absurd = np.flatnonzero(is_absurd)
    if len(absurd) > 0.5 * len(values):  # another unit
        return BadSamples(np.flatnonzero(~finite), np.array([], np.intp), 0.0)
    rows = np.arange(len(values))
    mended = np.interp(rows, rows[~is_absurd], values[~is_absurd])
    spikes, ratio = _find_spikes(mended)
    return BadSamples(absurd, spikes, ratio)


def _find_spikes(values: Array) -> tuple[NDArray[np.intp], float]:
    """Find single samples that jump there and back, by two statistics: the local level and the second differences."""
    step = np.diff(values)
    size, n = np.abs(step), len(step)
    if n < _FEWEST:
        return np.array([], np.intp), 0.0
    blocks = -(-n // _BLOCK)
    padded = np.full(blocks * _BLOCK, np.nan)
    padded[:n] = size
    level = np.nanmedian(padded.reshape(blocks, _BLOCK), 1)
    level = np.maximum.reduce([np.r_[level[:1], level[:-1]], level, np.r_[level[1:], level[-1:]]])
    floor = 0.25 * np.median(size) + 1e-4 * np.percentile(size, 90) + 1e-12
    level = np.repeat(level, _BLOCK)[:n] + floor
    is_back = step[1:] * step[:-1] < 0.0
    ratio = np.where(is_back, np.minimum(size[1:], size[:-1]) / level[1:], 0.0)
    second = np.abs(np.diff(step))
    deviation = 1.4826 * np.median(second) + 1e-12
    is_spike = (ratio > limit_of("spikes")) & (second > SPIKE_DEVIATIONS * deviation)
    return np.flatnonzero(is_spike) + 1, float(ratio.max())


def mend_samples(time: Array, samples: Array) -> tuple[Array, NDArray[np.bool_], list[BadSamples]]:
    """Replace rows with a wrong sample by a line between their neighbours.

    Args:
        time: Times, s, [n].
        samples: Force and rate, [n, 6].

    Returns:
        Samples, mask of the rows, [n], and the wrong samples of each column.
    """
    bad = [find_bad_samples(column, k < 3) for k, column in enumerate(samples.T)]
    is_bad = np.zeros(len(time), bool)
    is_bad[np.concatenate([rows for column in bad for rows in (column.absurd, column.spikes)])] = (
        True
    )
    if is_bad.any() and not is_bad.all():
        keep = ~is_bad
        samples = np.stack([np.interp(time, time[keep], column[keep]) for column in samples.T], -1)
    return samples, is_bad, bad


def list_stretches(mask: NDArray[np.bool_]) -> NDArray[np.intp]:
    """Return the first row of each stretch of a mask [n], and the row after its last, [q, 2]."""
    return np.flatnonzero(np.diff(np.r_[False, mask, False].astype(int))).reshape(-1, 2)


def find_stuck(samples: Array) -> tuple[int, int]:
    """Return the first and the last row of the longest stretch of equal samples. Shapes: samples [n, k]."""
    stretches = list_stretches((np.diff(samples, axis=0) == 0.0).all(1))
    first, last = max(stretches.tolist(), key=lambda rows: rows[1] - rows[0], default=(0, 0))
    return first, last


def check_samples(log: RawLog, facts: dict[str, Any]) -> tuple[RawLog, list[Finding]]:
    """Check the samples, and replace the wrong ones by a line between their neighbours.

    Returns the log, and findings.
    """
    imu, findings = log.imu, list(_check_stuck(log, facts))
    recorded = np.hstack([imu.force, imu.rate])
    samples, _, bad = mend_samples(imu.time, recorded)
    for column, values, wrong in zip(_COLUMNS, recorded.T, bad, strict=True):
        findings += _describe_bad(log, column, values, wrong)
    facts["spike of force"], facts["spike of rate"] = (max(b.ratio for b in columns) for columns in (bad[:3], bad[3:]))  # fmt: skip
    return log._replace(imu=imu._replace(force=samples[:, :3], rate=samples[:, 3:])), findings


def check_repeated_columns(log: RawLog) -> Iterator[Finding]:
    """Check that no table has one column under two names."""
    imu, reference = log.imu, log.reference
    for table, names, values in (
        (0, _COLUMNS, np.hstack([imu.force, imu.rate])), (1, _POSITION, log.fixes.position), (2, _POSITION, reference.position),
        (2, ("vn", "ve", "vd"), reference.velocity), (2, ("roll", "pitch", "yaw"), reference.angles),
    ):  # fmt: skip
        for (a, first), (b, second) in combinations(zip(names, np.abs(values.T), strict=True), 2):
            if len(first) > _FEWEST and (first == second).all() and np.ptp(first) > 0.0:
                yield Finding(
                    "repeated column", WARN, float(len(first)), limit_of("repeated column"), "rows",
                    f"{log.names[table]}: {a} and {b} are equal in all rows: one column stands in the place of another",
                    "Write the right column: no correction gives it back",
                    picture=Picture("row", f"{a}, {b}", (thin_curve(a, np.arange(len(first)), first),)),
                )  # fmt: skip


def _check_stuck(log: RawLog, facts: dict[str, Any]) -> Iterator[Finding]:
    """Check for samples that do not change."""
    imu, samples = log.imu, np.hstack([log.imu.force, log.imu.rate])
    first, last = find_stuck(samples)
    duration = float(imu.time[last] - imu.time[first])
    facts["stuck"] = duration
    yield from _check_dead(log, samples, duration)
    yield from _check_saturated(log, samples)
    if duration > limit_of("stuck samples"):
        around = slice(max(0, 2 * first - last), 2 * last - first)
        yield Finding(
            "stuck samples", WARN, duration, limit_of("stuck samples"), "s",
            f"{log.names[0]}: all samples are equal for {duration:.2f} s, from {log.row(0, first)} "
            f"(t = {imu.time[first]:.3f}) on",
            "Leave these rows out with the part before or after them, or set scenario.corrections.drop=[stuck] "
            "and scenario.corrections.gaps=longest",
            {"corrections": {"drop": ["stuck"], "gaps": "longest"}},
            picture=Picture("t [s]", "fx [m/s^2]", (thin_curve("fx", imu.time[around], imu.force[around, 0]),),
                            (float(imu.time[first]), float(imu.time[last]))),
        )  # fmt: skip


def _check_dead(log: RawLog, samples: Array, stuck: float) -> Iterator[Finding]:
    """Check for a column that does not change while the others do."""
    time, rows = log.imu.time, [find_stuck(column[:, None]) for column in samples.T]
    # a value that is held at the end of the range is cut off, not dead
    durations = [
        0.0
        if c[first] in (c.min(), c.max()) and c[first] != 0.0 and c.min() < c.max()
        else float(time[last] - time[first])
        for c, (first, last) in zip(samples.T, rows, strict=True)
    ]
    k = int(np.argmax(durations))
    # three constant columns are a motion without errors of sensors
    if durations[k] > max(limit_of("dead axis"), 2.0 * stuck, sorted(durations)[3]):
        start = float(time[rows[k][0]])
        yield Finding(
            "dead axis", WARN, durations[k], limit_of("dead axis"), "s",
            f"{log.names[0]}: column {_COLUMNS[k]} is {samples[rows[k][0], k]:g} for {durations[k]:.1f} s from t = {start:.3f} on, "
            "while other columns change",
            "Record again, or leave this part out: no correction gives back an axis",
            explanations=("a broken axis", "a column of another message", "a saturated axis"),
            picture=Picture("t [s]", _COLUMNS[k], (thin_curve(_COLUMNS[k], time, samples[:, k]),), (start,)),
        )  # fmt: skip


def _check_saturated(log: RawLog, samples: Array) -> Iterator[Finding]:
    """Check for a column that stops at its largest or smallest value, far from the usual one."""
    for column, values in zip(_COLUMNS, samples.T, strict=True):
        levels, counts = np.unique(values[np.isfinite(values)], return_counts=True)
        if len(levels) < _FEWEST:
            continue
        # rounded values repeat, too, and those nearer to the usual one more often
        excess = np.where(
            (np.abs(levels[[0, -1]] - np.median(values)) > _AWAY * (levels[-1] - levels[0]))
            & (levels[[0, -1]] != 0.0),  # a broken axis: no range ends there
            counts[[0, -1]] / counts[[1, -2]], 0.0,
        )  # fmt: skip
        end = -int(excess.argmax())
        if excess.max() > limit_of("saturated axis"):
            start = float(log.imu.time[int(np.argmax(values == levels[end]))])
            yield Finding(
                "saturated axis", WARN, float(counts[end]), limit_of("saturated axis"), "samples",
                f"{log.names[0]}: column {column} stops at {levels[end]:.6g} in {counts[end]} samples, the first at "
                f"t = {start:.3f}",
                "Record again with a larger range of the sensor: no correction gives back what is cut off",
                picture=Picture("t [s]", column, (thin_curve(column, log.imu.time, values),), (start,)),
            )  # fmt: skip


def _describe_bad(log: RawLog, column: str, values: Array, bad: BadSamples) -> Iterator[Finding]:
    """Describe the wrong samples of a column."""
    sizes = {"absurd samples": float(len(bad.absurd)), "spikes": bad.ratio}
    for check, rows in (("absurd samples", bad.absurd), ("spikes", bad.spikes)):
        if not len(rows):
            continue
        i = int(rows[0])
        near = slice(max(0, i - _BLOCK), i + _BLOCK)
        size = f", the largest {bad.ratio:.0f} times the local level" if check == "spikes" else ""
        yield Finding(
            check, TELL, sizes[check], limit_of(check), "times the level" if size else "rows",
            f"{log.names[0]}: column {column} has {len(rows)} {check if size else 'absurd samples'}{size}, the first "
            f"{values[i]:g} in {log.row(0, i)} (t = {log.imu.time[i]:.3f})",
            "Correct these rows, or set scenario.corrections.drop=[spikes], which replaces them by a line between "
            "their neighbours",
            {"corrections": {"drop": ["spikes"]}},
            picture=Picture("t [s]", column, (thin_curve(column, log.imu.time[near], values[near]),),
                            (float(log.imu.time[i]),)),
        )  # fmt: skip
