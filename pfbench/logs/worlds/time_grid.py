"""Resampling of a log to filter steps.

Steps end on fixes and divide the time between fixes evenly. Measurements keep their times and
values. The reference is interpolated to the steps, but not across gaps. IMU samples are split at
the steps.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pfbench.core import chart
from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record, fix_channels
from pfbench.logs.worlds.log_tables import Array, ImuLog, NavigationLog, ReferenceLog
from pfbench.model.strapdown import FIX_CHANNELS, StrapdownTotal
from pfbench.model.strapdown_tuning import StrapdownTuning
from pfbench.nav.strapdown import PreintegratedImu, preintegrate
from pfbench.noise.base import NoiseRegime, check_unit_process, draw_added_errors
from pfbench.scenario.base import check_duration

TIME_TOLERANCE = 1e-3  # s


class ResampledLog(NamedTuple):
    """Log on T filter steps, with positions relative to the recorded start.

    Attributes:
        start_s: Time of the start, s.
        time: End of each step, s, [T].
        fix_steps: Mask of steps that end on a fix, [T].
        fixes: Recorded position, m, and velocity, m/s, at the end of each step, [T, 6]. NaN without
            a fix.
        start: Recorded attitude, velocity and position at the start, [10].
        truth: Attitude, velocity and position at the end of each step, [T, 10]. NaN in a gap of the
            reference.
        force: Mean specific force of the S pieces of each step, m/s^2, [T, S, 3].
        rate: Mean angular rate of the pieces, rad/s, [T, S, 3].
        spans: Durations of the pieces, s, [T, S]. Unused pieces have duration 0.
        gravity: Gravity, m/s^2.
        notes: Corrections and assumptions, for the report.
        start_sd: Standard deviations of `start` in the chart, rad, m/s, m, [9]. None if `start` is of a reference.
    """

    start_s: float
    time: Array
    fix_steps: NDArray[np.bool_]
    fixes: Array
    start: Array
    truth: Array
    force: Array
    rate: Array
    spans: Array
    gravity: float
    notes: tuple[str, ...]
    start_sd: Array | None = None

    @property
    def since_start(self) -> Array:
        """Time from the start to the end of each step, s, [T]."""
        return self.time - self.start_s

    @property
    def recorded_fixes(self) -> dict[str, Tensor]:
        """Recorded velocity, m/s, and position, m, at the end of each step, [T, 3]. NaN without a fix."""
        position, velocity = torch.from_numpy(self.fixes).split(3, -1)
        return {"velocity": velocity, "position": position}

    def sensed(self) -> dict[str, Array]:
        """Compute the mean force, m/s^2, and rate, rad/s, of each step, [T, 3].

        Values are NaN in a gap of the IMU.
        """
        share = self.spans / np.where(self.spans.sum(1) > 0, self.spans.sum(1), np.nan)[:, None]
        return {
            "force": (self.force * share[..., None]).sum(1),
            "rate": (self.rate * share[..., None]).sum(1),
        }


def resample_log(
    log: NavigationLog,
    interval: float,
    step: float,
    velocity: bool = False,
    start: float | None = None,
    end: float | None = None,
) -> ResampledLog:
    """Resample a log to filter steps.

    Returns the log on filter steps.
    """
    low = max(log.imu.time[0], log.reference.time[0], -np.inf if start is None else start)
    high = min(log.imu.time[-1], log.reference.time[-1], np.inf if end is None else end)
    selection = select_fixes(log.fixes.time, interval, low, high)
    require(
        len(selection) >= 2,
        "IMU, reference, start and end",
        "have at least 2 fixes in their common time",
        f"{len(selection)} fixes between t = {low:.3f} and {high:.3f}",
        "Use a longer log, an earlier start or a later end.",
    )
    require(
        not velocity or np.isfinite(log.fixes.velocity).any(),
        "scenario.receiver.velocity_sd",
        "be null for fixes without vn, ve, vd",
        "a number",
        "Set it to null or add these columns.",
    )
    grid, fix_mask = divide_interval(log.fixes.time[selection], step)
    fixes = np.full((len(grid), 6), np.nan)
    fixes[fix_mask] = np.hstack([log.fixes.position, log.fixes.velocity])[selection]
    truth = interpolate(log.reference, grid)
    require(
        np.isfinite(truth[0, 4:]).all(),  # a reference can lack the attitude
        "scenario.start_s",
        "not be in a gap of the reference",
        f"t = {grid[0]:.3f}",
        "Select another start.",
    )
    origin = truth[0, 7:].copy()
    fixes[:, :3] -= origin
    truth[:, 7:] -= origin
    usable, total = int(np.isfinite(fixes[fix_mask, 0][1:]).sum()), int(fix_mask.sum()) - 1
    times = log.fixes.time[np.isfinite(log.fixes.position[:, 0])]
    when = f" (t = {times[0]:.3f} to {times[-1]:.3f})" if times.size else ""
    require(
        usable,
        f"the fixes from t = {grid[0]:.3f} to {grid[-1]:.3f}",
        "include a usable one",
        f"none of {total}: column fix excludes them, or they were dropped",
        f"Set scenario.start_s and scenario.end_s to a time with usable fixes{when}.",
    )
    notes = log.notes + (
        (f"{usable} of {total} selected fixes used, the others are missing",)
        if usable < total
        else ()
    )
    pieces = split_samples(log.imu, grid)
    return ResampledLog(
        float(grid[0]),
        grid[1:],
        fix_mask[1:],
        fixes[1:],
        truth[0],
        truth[1:],
        *pieces,
        log.gravity,
        notes,
    )


def select_fixes(time: Array, interval: float, low: float, high: float) -> NDArray[np.intp]:
    """Select fixes at intervals.

    The tolerance is half the median time between recorded fixes.

    Returns indices of the selected fixes. Shapes: time [n].
    """
    tolerance = 0.5 * float(np.median(np.diff(time)))
    selection: list[int] = []
    for i in np.flatnonzero((time >= low) & (time <= high)):
        if not selection or time[i] - time[selection[-1]] >= max(interval - tolerance, 0.0):
            selection.append(int(i))
    return np.array(selection, dtype=np.intp)


def divide_interval(fixes: Array, step: float) -> tuple[Array, NDArray[np.bool_]]:
    """Divide the time between fixes evenly.

    Returns times from the first to the last fix, s, [T + 1], and a mask of the fixes, [T + 1].
    Shapes: fixes [n].
    """
    pieces = np.maximum(1, np.ceil(np.diff(fixes) / step - 1e-6).astype(int))
    ends = np.concatenate([[0], np.cumsum(pieces)])
    fix_mask = np.zeros(ends[-1] + 1, dtype=bool)
    fix_mask[ends] = True
    return np.interp(np.arange(len(fix_mask)), ends, fixes), fix_mask


def interpolate(motion: ReferenceLog, time: Array) -> Array:
    """Interpolate a reference.

    Velocity and position are linear between samples. The attitude follows the shortest rotation.

    Returns attitude, velocity and position, [T, 10]. NaN in a gap of about two sample intervals or
    more. Shapes: time [T].
    """
    longest = 1.9 * float(np.median(np.diff(motion.time)))
    after = np.clip(np.searchsorted(motion.time, time - TIME_TOLERANCE), 1, len(motion.time) - 1)
    before = after - 1
    gap = motion.time[after] - motion.time[before]
    fraction = ((time - motion.time[before]) / gap)[:, None]
    flat = np.hstack([motion.velocity, motion.position])
    linear = (1.0 - fraction) * flat[before] + fraction * flat[after]
    q = torch.from_numpy(motion.attitude)
    inverse = q[before] * q.new_tensor([1.0, -1.0, -1.0, -1.0])
    rotation = chart.rotation_vector_from_quaternion(
        chart.quaternion_multiply(inverse, q[after])
    ) * torch.from_numpy(fraction)
    rotated = chart.quaternion_multiply(
        q[before], chart.quaternion_from_rotation_vector(rotation)
    ).numpy()
    on_sample = np.minimum(fraction, 1.0 - fraction)[:, 0] * gap <= TIME_TOLERANCE
    valid_mask = (gap <= longest) | on_sample
    valid_mask &= (time >= motion.time[0] - TIME_TOLERANCE) & (
        time <= motion.time[-1] + TIME_TOLERANCE
    )
    return np.where(valid_mask[:, None], np.hstack([rotated, linear]), np.nan)


def split_samples(imu: ImuLog, grid: Array) -> tuple[Array, Array, Array]:
    """Split linearly interpolated IMU samples at grid points.

    Returns mean force, m/s^2, and rate, rad/s, of the pieces, [T, S, 3], and their durations, s,
    [T, S].
    """
    step, durations, mean = list_pieces(imu, grid)
    piece_index = np.arange(len(step)) - np.searchsorted(step, step)
    shape = (len(grid) - 1, int(piece_index.max()) + 1)
    spans, pieces = np.zeros(shape), np.zeros((*shape, 6))
    spans[step, piece_index], pieces[step, piece_index] = durations, mean
    return pieces[..., :3], pieces[..., 3:], spans


def list_pieces(imu: ImuLog, grid: Array) -> tuple[NDArray[np.intp], Array, Array]:
    """List the pieces between samples and grid points.

    Returns step of each piece, [P], duration, s, [P], mean force, m/s^2, and rate, rad/s, [P, 6].
    """
    inside = imu.time[(imu.time > grid[0]) & (imu.time < grid[-1])]
    nodes = np.union1d(inside, grid)
    values = np.stack(
        [np.interp(nodes, imu.time, column) for column in (*imu.force.T, *imu.rate.T)], axis=-1
    )
    step = np.searchsorted(grid, nodes[:-1], side="right") - 1
    return step, np.diff(nodes), 0.5 * (values[1:] + values[:-1])


# --------------------------------------------------------------------------------------------------
# Assembly of episodes from resampled logs: measurements with added errors, starts, IMU inputs.


@dataclass(frozen=True)
class FixReceiver:
    """Conversion of recorded fixes to measurements.

    Attributes:
        fix_interval_s: Time between used fixes, s. A record with fewer fixes uses all of them.
        position_sd: Standard deviations of added position errors, East, North, Up, m, [3]. With
            zeros a noise regime can only remove fixes.
        velocity_sd: Standard deviations of added velocity errors, m/s, [3]. None if velocity is not
            measured.

    Raises:
        ValueError: If the interval is not positive, or the standard deviations are not three
            numbers of at least 0.
    """

    fix_interval_s: float = 1.0
    position_sd: Sequence[float] = (1.5, 1.5, 3.0)
    velocity_sd: Sequence[float] | None = None

    def __post_init__(self) -> None:
        check_duration("scenario.receiver.fix_interval_s", self.fix_interval_s)
        for name, sd in (("position_sd", self.position_sd), ("velocity_sd", self.velocity_sd)):
            require(
                sd is None or (len(sd) == 3 and min(sd) >= 0.0),
                f"scenario.receiver.{name}",
                "be 3 numbers of at least 0",
                sd,
                "Set East, North and Up, with 0 for no added errors.",
            )

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the measured components, [3] or [6]."""
        return FIX_CHANNELS[: len(self.sd)]

    @property
    def channels(self) -> MeasurementChannels:
        """Channels of position, and of velocity if measured, from one source."""
        return fix_channels(self.sd)

    @property
    def sd(self) -> Tensor:
        """Standard deviations of the added errors, m and m/s, [3 or 6]."""
        return torch.tensor([*self.position_sd, *(self.velocity_sd or ())], dtype=torch.float64)


def encode_names(names: Sequence[str]) -> Tensor:
    """Encode names, such as G12, as character codes padded with spaces, [S, longest]."""
    longest = max(map(len, names), default=0)
    return torch.tensor(
        [[ord(letter) for letter in name.ljust(longest)] for name in names], dtype=torch.float64
    )


def assemble(
    legs: Sequence[ResampledLog],
    time: Array,
    log_index: Tensor,
    tuning: StrapdownTuning,
    receiver: FixReceiver,
    noise: NoiseRegime,
    draws: PhiloxStream,
) -> Episode:
    """Build the episode of runs over resampled logs.

    Returns Episode with R runs. Shapes: time [T], log_index [R].
    """
    t, longest = torch.from_numpy(time), max(legs, key=lambda leg: len(leg.time))
    fix_mask = torch.from_numpy(longest.fix_steps)
    truth = _pad([leg.truth for leg in legs], np.nan)[log_index]
    sd = receiver.sd
    y = _pad([leg.fixes for leg in legs], np.nan)[log_index][..., : len(sd)]
    # errors are drawn per fix, so that they do not depend on the filter step
    check_unit_process(noise, t)
    y[:, fix_mask] += draw_added_errors(noise, draws.at_step(0), receiver.channels, t[fix_mask])
    start, spread = _draw_start(legs, log_index, tuning, draws)
    record = Record(y, _preintegrate_logs(legs, log_index, tuning), start, spread)
    groups = {"attitude": truth[..., :4], "velocity": truth[..., 4:7], "position": truth[..., 7:]}
    notes = tuple(dict.fromkeys(note for leg in legs for note in leg.notes))
    first = legs[int(log_index[0])] if len(log_index) else longest
    datasheet = {
        name: _pad([values, np.empty((len(t), 3))], np.nan)[0]
        for name, values in first.sensed().items()
    }
    return Episode(record, t, groups, truth[..., 7:], notes, datasheet)


def _draw_start(
    legs: Sequence[ResampledLog], log_index: Tensor, tuning: StrapdownTuning, draws: PhiloxStream
) -> tuple[Tensor, Tensor | None]:
    """Draw starts [R, 16], about which the true state has the assumed distribution.

    A start with its own standard deviations is an estimate: it stays, and their root [R, 15, 15] follows.
    """
    recorded = torch.from_numpy(np.stack([leg.start for leg in legs]))[log_index]
    nominal = torch.cat([recorded, tuning.bias.expand(len(log_index), -1)], -1)
    stated = legs[0].start_sd
    if stated is not None:
        sd = torch.cat([torch.from_numpy(stated), tuning.initial_sd[len(stated) :]])
        return nominal, torch.diag(sd).expand(len(log_index), -1, -1)
    error = (
        tuning.initial_sd * draws.at_step(0).normal("world.start", 1, len(tuning.initial_sd))[:, 0]
    )
    return StrapdownTotal(tuning).chart.add(nominal, -error), None


def _preintegrate_logs(
    legs: Sequence[ResampledLog], log_index: Tensor, tuning: StrapdownTuning
) -> PreintegratedImu:
    """Preintegrate the IMU samples of each run's log."""
    force, rate, spans = (
        _pad(samples, 0.0)
        for samples in zip(*((leg.force, leg.rate, leg.spans) for leg in legs), strict=True)
    )
    bias = tuning.bias.expand(*spans.shape[:2], 6)
    gravity = torch.tensor([leg.gravity for leg in legs], dtype=torch.float64)[:, None].expand(
        spans.shape[:2]
    )
    u = (*preintegrate(force, rate, spans, bias), bias, gravity, spans.sum(-1))
    if len(legs) == 1:
        return PreintegratedImu(*u)  # leading axis 1: shared by all runs
    return PreintegratedImu(*(leaf[log_index] for leaf in u))


def _pad(values: Sequence[Array], fill: float) -> Tensor:
    """Stack K arrays, with each axis padded to the longest, [K, ...]."""
    out = np.full((len(values), *np.max([a.shape for a in values], axis=0)), fill)
    for row, a in zip(out, values, strict=True):
        row[tuple(slice(n) for n in a.shape)] = a
    return torch.from_numpy(out)
