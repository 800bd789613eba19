"""A log laid out on filter steps: steps end on fixes and divide the time between them evenly.

No measurement is ever moved or interpolated; the reference is interpolated to the steps, never across a hole in it; the IMU
is cut into pieces at its own samples and at the steps.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from pfbench.nav import attitude
from pfbench.scenario.logs import Imu, Log, Motion
from pfbench.scenario.tables import Array

SAME_TIME = 1e-3  # s


class Leg(NamedTuple):
    """One log on filter steps; positions from the recorded start.

    Attributes:
        begin: time of the start, s.
        time: end of each step [T] s.
        fixed: steps that end on a fix [T].
        fixes: recorded position and velocity at the end of each step [T, 6], NaN where there is none.
        start: recorded attitude, velocity and position at the start [10].
        truth: the same at the end of each step [T, 10], NaN in a hole of the reference.
        force, rate: mean specific force and angular rate of the S pieces of each step [T, S, 3].
        spans: their durations [T, S] s; 0 fills up.
        gravity: m/s^2.
        notes: for the report.
    """

    begin: float
    time: Array
    fixed: NDArray[np.bool_]
    fixes: Array
    start: Array
    truth: Array
    force: Array
    rate: Array
    spans: Array
    gravity: float
    notes: tuple[str, ...]

    @property
    def since_start(self) -> Array:
        return self.time - self.begin

    def sensed(self) -> dict[str, Array]:
        """Measured specific force and angular rate, mean over each step [T, 3]; NaN where the IMU has a hole."""
        share = self.spans / np.where(self.spans.sum(1) > 0, self.spans.sum(1), np.nan)[:, None]
        return {"force": (self.force * share[..., None]).sum(1), "rate": (self.rate * share[..., None]).sum(1)}


def cut(
    log: Log, interval: float, step: float, velocity: bool = False, start: float | None = None, end: float | None = None
) -> Leg:
    """A log on filter steps.

    Args:
        log: the log.
        interval: seconds between the fixes that are kept.
        step: longest step in s.
        velocity: velocities are wanted too.
        start, end: seconds of the log; None for all that IMU, fixes and reference have in common.

    Raises:
        ValueError: fewer than two fixes in the time that IMU and reference have in common, or velocities asked for that are
            not recorded.
    """
    low = max(log.imu.time[0], log.reference.time[0], -np.inf if start is None else start)
    high = min(log.imu.time[-1], log.reference.time[-1], np.inf if end is None else end)
    chosen = thin(log.fixes.time, interval, low, high)
    if len(chosen) < 2:
        raise ValueError(
            f"{len(chosen)} fixes between t = {low:.3f} and {high:.3f}, where IMU, reference, start and end overlap; "
            "give a longer log, an earlier start or a later end"
        )
    if velocity and np.isnan(log.fixes.velocity).all():
        raise ValueError("receiver.velocity_sd is set, but the fixes have no vn, ve, vd: add these columns, or set it to null")
    grid, fixed = divide(log.fixes.time[chosen], step)
    fixes = np.full((len(grid), 6), np.nan)
    fixes[fixed] = np.hstack([log.fixes.position, log.fixes.velocity])[chosen]
    truth = interpolate(log.reference, grid)
    if np.isnan(truth[0]).any():
        raise ValueError(f"the reference has a hole at t = {grid[0]:.3f}, where the runs would start: choose another start")
    place = truth[0, 7:].copy()
    fixes[:, :3] -= place
    truth[:, 7:] -= place
    silent, given = int(np.isnan(fixes[fixed, 0][1:]).sum()), int(fixed.sum()) - 1
    notes = log.notes + ((f"{silent} of {given} fixes not used (fix is not 1)",) if silent else ())
    pieces = split(log.imu, grid)
    return Leg(float(grid[0]), grid[1:], fixed[1:], fixes[1:], truth[0], truth[1:], *pieces, log.gravity, notes)


def thin(time: Array, interval: float, low: float, high: float) -> NDArray[np.intp]:
    """Indices of fixes in [low, high], each `interval` after the one before, to half the fixes' own spacing."""
    slack = 0.5 * float(np.median(np.diff(time)))
    chosen: list[int] = []
    for i in np.flatnonzero((time >= low) & (time <= high)):
        if not chosen or time[i] - time[chosen[-1]] >= max(interval - slack, 0.0):
            chosen.append(int(i))
    return np.array(chosen, dtype=np.intp)


def divide(fixes: Array, step: float) -> tuple[Array, NDArray[np.bool_]]:
    """Times from the first fix to the last [T + 1], at most `step` apart and evenly between fixes, and which are fixes."""
    pieces = np.maximum(1, np.ceil(np.diff(fixes) / step - 1e-6).astype(int))
    ends = np.concatenate([[0], np.cumsum(pieces)])
    fixed = np.zeros(ends[-1] + 1, dtype=bool)
    fixed[ends] = True
    return np.interp(np.arange(len(fixed)), ends, fixes), fixed


def interpolate(motion: Motion, time: Array) -> Array:
    """Attitude, velocity, position of a reference at other times [T, 10]; NaN across a hole (two sample intervals and more).

    Velocity and position on a straight line, attitude along the shortest turn.
    """
    longest = 1.9 * float(np.median(np.diff(motion.time)))
    after = np.clip(np.searchsorted(motion.time, time - SAME_TIME), 1, len(motion.time) - 1)
    before = after - 1
    gap = motion.time[after] - motion.time[before]
    part = ((time - motion.time[before]) / gap)[:, None]
    flat = np.hstack([motion.velocity, motion.position])
    straight = (1.0 - part) * flat[before] + part * flat[after]
    q = torch.from_numpy(motion.attitude)
    inverse = q[before] * q.new_tensor([1.0, -1.0, -1.0, -1.0])
    turn = attitude.rotation_vector_from_quaternion(attitude.quaternion_multiply(inverse, q[after])) * torch.from_numpy(part)
    turned = attitude.quaternion_multiply(q[before], attitude.quaternion_from_rotation_vector(turn)).numpy()
    on_sample = np.minimum(part, 1.0 - part)[:, 0] * gap <= SAME_TIME
    known = (gap <= longest) | on_sample
    known &= (time >= motion.time[0] - SAME_TIME) & (time <= motion.time[-1] + SAME_TIME)
    return np.where(known[:, None], np.hstack([turned, straight]), np.nan)


def split(imu: Imu, grid: Array) -> tuple[Array, Array, Array]:
    """Mean force and rate [T, S, 3] and durations [T, S] between samples and grid points, samples joined by straight lines."""
    inside = imu.time[(imu.time > grid[0]) & (imu.time < grid[-1])]
    nodes = np.union1d(inside, grid)
    values = np.stack([np.interp(nodes, imu.time, column) for column in (*imu.force.T, *imu.rate.T)], axis=-1)
    mean = 0.5 * (values[1:] + values[:-1])
    step = np.searchsorted(grid, nodes[:-1], side="right") - 1
    place = np.arange(len(step)) - np.searchsorted(step, step)
    shape = (len(grid) - 1, int(place.max()) + 1)
    spans, pieces = np.zeros(shape), np.zeros((*shape, 6))
    spans[step, place], pieces[step, place] = np.diff(nodes), mean
    return pieces[..., :3], pieces[..., 3:], spans
