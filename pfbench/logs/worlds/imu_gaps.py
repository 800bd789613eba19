"""Gaps of the IMU: short ones are bridged with the noise of the samples before, long ones are refused or cut."""

from __future__ import annotations

import numpy as np

from pfbench.logs.worlds.log_tables import Array, ImuLog, LogTable

LONGEST_BRIDGE = 0.2  # s; motion in a longer gap is lost
GAP_SAMPLES = 3.0  # intervals beyond are gaps
CUT = ("refuse", "longest")
_MEAN = 5  # samples at each end whose means the bridge joins


def bridge_gaps(imu: ImuLog) -> tuple[ImuLog, tuple[float, float, int]]:
    """Fill short gaps with samples on a line between both ends, with the noise of the samples before the gap.

    Args:
        imu: Samples with increasing times.

    Returns:
        Samples without short gaps, and start, s, and length, s, of the longest gap and the number of gaps.
    """
    step = np.diff(imu.time)
    typical = float(np.median(step))
    # longer ones stay, which the diagnosis refuses
    gaps = np.flatnonzero((step > GAP_SAMPLES * typical) & (step <= longest_bridge(imu.time)))
    if not gaps.size:
        return imu, (0.0, 0.0, 0)
    times, values = [imu.time], [np.hstack([imu.force, imu.rate])]
    for i in gaps.tolist():
        count = round(float(step[i]) / typical) - 1
        share = np.arange(1, count + 1) / (count + 1)
        times.append(imu.time[i] + share * step[i])
        values.append(_bridge(values[0], i, share))
    time = np.concatenate(times)
    order = np.argsort(time, kind="stable")
    samples = np.vstack(values)[order]
    longest = int(gaps[step[gaps].argmax()])
    facts = float(imu.time[longest]), float(step[longest]), len(gaps)
    return ImuLog(time[order], samples[:, :3], samples[:, 3:]), facts


def _bridge(samples: Array, i: int, share: Array) -> Array:
    """Return samples after row i at shares of the gap [c], [c, k]: a line of means plus noise of the samples before."""
    before, after = samples[max(0, i - _MEAN + 1) : i + 1], samples[i + 1 : i + 1 + _MEAN]
    line = before.mean(0) + share[:, None] * (after.mean(0) - before.mean(0))
    past = samples[max(0, i - 3 * len(share) - 2 * _MEAN) : i + 1]
    kernel = np.ones(_MEAN) / _MEAN
    if len(past) < 3 * _MEAN:
        return line
    smooth = np.stack([np.convolve(column, kernel, "valid") for column in past.T], -1)
    half = _MEAN // 2
    noise = (past[half : half + len(smooth)] - smooth) / np.sqrt(1.0 - 1.0 / _MEAN)
    return np.asarray(line + noise[np.arange(len(share)) % len(noise)])


def find_longest(time: Array) -> tuple[int, int, int]:
    """Find the part between gaps that are too long to bridge that covers the longest time. Shapes: time [n].

    Returns its first and last row, and the number of parts.
    """
    is_gap = np.diff(time) > longest_bridge(time)
    borders = np.concatenate([[0], np.flatnonzero(is_gap) + 1, [len(time)]])
    first, last = borders[:-1], borders[1:] - 1
    i = int(np.argmax(time[last] - time[first]))
    return int(first[i]), int(last[i]), len(first)


def longest_bridge(time: Array) -> float:
    """Return the longest interval that is bridged, s."""
    return max(LONGEST_BRIDGE, GAP_SAMPLES * float(np.median(np.diff(time))))


def cut_longest(table: LogTable, time: Array) -> tuple[LogTable, tuple[str, ...]]:
    """Keep the rows between two gaps that cover the longest time.

    Args:
        table: IMU table.
        time: Its times, s, [n].

    Returns:
        The rows, and a note.
    """
    a, b, count = find_longest(time)
    if count == 1:
        return table, ()
    note = (
        f"{table.name}: the longest of {count} parts between gaps of more than {longest_bridge(time):.3g} s is used, "
        f"t = {time[a]:.3f} to {time[b]:.3f}, as scenario.corrections.gaps states"
    )
    return table._replace(rows=table.rows.iloc[a : b + 1].reset_index(drop=True)), (note,)
