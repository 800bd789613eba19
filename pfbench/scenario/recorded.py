"""Recorded drives and flights: real sensors and real motion, fixes degraded on purpose, errors scored against a reference.

The motion is the same in every run; what differs between runs is the receiver's errors and the initial errors. Filter steps
fall on the fixes and divide the time between them evenly, so no measurement is ever moved or interpolated; the reference is
interpolated to the steps, never across a hole in it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pfbench.draws import MonteCarlo
from pfbench.model.strapdown_total import Believed, Increments, StrapdownTotal, preintegrate
from pfbench.nav import attitude
from pfbench.noise.regimes import Regime
from pfbench.record import Episode, Record
from pfbench.scenario.logs import Array, Files, Imu, Log, Motion, read_log

_SAME_TIME = 1e-3  # s


@dataclass(frozen=True)
class Receiver:
    """How recorded fixes become measurements.

    Args:
        interval: seconds between the fixes that are handed out; the first one this much (or, on a coarser record, more) later.
        position_sd: standard deviations of the errors that a regime adds to them, East, North, Up in m; zeros leave the fixes
            as recorded (a regime can then only silence them).
        velocity_sd: the same for the recorded velocities in m/s; None where velocity is not measured.
    """

    interval: float = 1.0
    position_sd: Sequence[float] = (1.5, 1.5, 3.0)
    velocity_sd: Sequence[float] | None = None

    def __post_init__(self) -> None:
        _positive("receiver.interval", self.interval)
        for name, sd in (("position_sd", self.position_sd), ("velocity_sd", self.velocity_sd)):
            if sd is not None and (len(sd) != 3 or min(sd) < 0.0):
                raise ValueError(f"receiver.{name}={list(sd)}: give three standard deviations, East, North, Up (0 adds nothing)")

    @property
    def sd(self) -> Tensor:
        """[3 or 6]."""
        return torch.tensor([*self.position_sd, *(self.velocity_sd or ())], dtype=torch.float64)


@dataclass(frozen=True)
class RecordedDrive:
    """One recorded log; run numbers differ in the receiver's errors and the initial errors.

    Args:
        root: the folder of all data sets (configuration key data.root).
        folder: the log's folder in it.
        believed: what filters are told; the initial errors of the runs are drawn from it too, so that it is true of them.
        receiver: which fixes are handed out, and the size of the errors added to them.
        step: longest filter interval in s.
        start, end: seconds of the log; None for all that IMU, fixes and reference have in common.
        files: names of the tables.
        origin: lat_deg, lon_deg, h_m of the local frame, where the files do not say it.

    Raises:
        ValueError: a step or interval that is not positive; on drawing, a missing root or folder, or a faulty log.
    """

    root: str | None
    folder: str
    believed: Believed
    receiver: Receiver = field(default_factory=Receiver)
    step: float = 0.25
    start: float | None = None
    end: float | None = None
    files: Files = field(default_factory=Files)
    origin: Sequence[float] | None = None

    def __post_init__(self) -> None:
        _positive("scenario.step", self.step)

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """The log with these runs' errors; times are those of the log."""
        log = read_log(locate(self.root, self.folder), self.files, origin=self.origin)
        leg = cut(log, self.receiver, self.step, self.believed.bias.numpy(), self.start, self.end)
        return assemble([leg], leg.time, torch.zeros_like(runs), self.believed, self.receiver, noise, MonteCarlo(seed, runs))


@dataclass(frozen=True)
class RecordedFlights:
    """Several flights of one data set as one batch: run r is flight r, and from there on the same flights with new errors.

    Short flights are filled up to the longest: nothing is seen, nothing moves, and there is no truth. Arguments as for
    `RecordedDrive`, and

    Args:
        paths: the flights, by the numbers in the column `path`.
        imu: the sensor, by its number in the column `imu`; its nominal biases belong to `believed`.
    """

    root: str | None
    folder: str
    believed: Believed
    receiver: Receiver = field(default_factory=lambda: Receiver(position_sd=(1.0, 1.0, 1.0)))
    step: float = 0.2
    paths: Sequence[int] = tuple(range(1, 21))
    imu: int = 1
    files: Files = field(default_factory=lambda: Files(gnss="reference"))
    origin: Sequence[float] | None = None

    def __post_init__(self) -> None:
        _positive("scenario.step", self.step)
        if not self.paths:
            raise ValueError("scenario.paths=[]: give at least one flight")

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """The flights with these runs' errors; time is from the start of each flight."""
        folder, bias = locate(self.root, self.folder), self.believed.bias.numpy()
        used = torch.unique(runs % len(self.paths)).tolist()  # reads no flight that no run asks for
        logs = [read_log(folder, self.files, self.paths[i], self.imu, self.origin) for i in used]
        legs = [cut(log, self.receiver, self.step, bias) for log in logs]
        longest = max(legs, key=lambda leg: len(leg.time))
        for i, leg in zip(used, legs, strict=True):
            shift = leg.since_start - longest.since_start[: len(leg.time)]
            if np.abs(shift).max() > _SAME_TIME or not np.array_equal(leg.fixed, longest.fixed[: len(leg.time)]):
                raise ValueError(f"{folder}: flight {self.paths[i]} has its fixes at other times than the longest one; run it as a RecordedDrive")
        which = torch.searchsorted(torch.tensor(used), runs % len(self.paths))
        return assemble(legs, longest.since_start, which, self.believed, self.receiver, noise, MonteCarlo(seed, runs))


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


def locate(root: str | None, folder: str) -> Path:
    """The folder of a data set.

    Raises:
        ValueError: data.root is not set, or there is no such folder in it.
    """
    remedy = f"set the environment variable PFBENCH_DATA, or data.root=..., to the folder that holds {folder}/"
    if root is None:
        raise ValueError(f"data.root is not set, and recorded data are not part of the package: {remedy}")
    path = Path(root) / folder
    if not path.is_dir():
        raise ValueError(f"data.root={root}: no folder {path}; {remedy}")
    return path


def cut(
    log: Log, receiver: Receiver, step: float, bias: Array, start: float | None = None, end: float | None = None
) -> Leg:
    """A log on filter steps.

    Raises:
        ValueError: fewer than two fixes in the time that IMU and reference have in common, or velocities asked for that are
            not recorded.
    """
    low = max(log.imu.time[0], log.reference.time[0], -np.inf if start is None else start)
    high = min(log.imu.time[-1], log.reference.time[-1], np.inf if end is None else end)
    chosen = thin(log.fixes.time, receiver.interval, low, high)
    if len(chosen) < 2:
        raise ValueError(
            f"{len(chosen)} fixes between t = {low:.3f} and {high:.3f}, where IMU, reference, start and end overlap; "
            "give a longer log, an earlier start or a later end"
        )
    if receiver.velocity_sd is not None and np.isnan(log.fixes.velocity).all():
        raise ValueError("receiver.velocity_sd is set, but the fixes have no vn, ve, vd: add these columns, or set it to null")
    at_fix = log.fixes.time[chosen]
    pieces = np.maximum(1, np.ceil(np.diff(at_fix) / step - 1e-6).astype(int))
    parts = [a + (b - a) * np.arange(1, n + 1) / n for a, b, n in zip(at_fix[:-1], at_fix[1:], pieces, strict=True)]
    time = np.concatenate(parts)
    ends = np.cumsum(pieces) - 1
    time[ends] = at_fix[1:]
    fixes = np.full((len(time), 6), np.nan)
    fixes[ends] = np.hstack([log.fixes.position, log.fixes.velocity])[chosen[1:]]
    truth = interpolate(log.reference, np.concatenate([at_fix[:1], time]))
    if np.isnan(truth[0]).any():
        raise ValueError(f"the reference has a hole at t = {at_fix[0]:.3f}, where the runs would start: choose another start")
    first = truth[0].copy()
    fixes[:, :3] -= first[7:]
    truth[:, 7:] -= first[7:]
    force, rate, spans = split(log.imu, np.concatenate([at_fix[:1], time]))
    fixed = np.zeros(len(time), dtype=bool)
    fixed[ends] = True
    silent = int(np.isnan(fixes[ends, 0]).sum())
    notes = log.notes + ((f"{silent} of {len(ends)} fixes not used (fix is not 1)",) if silent else ())
    return Leg(float(at_fix[0]), time, fixed, fixes, truth[0], truth[1:], force, rate, spans, log.gravity, notes)


def thin(time: Array, interval: float, low: float, high: float) -> NDArray[np.intp]:
    """Indices of fixes in [low, high], each `interval` after the one before, to half the fixes' own spacing."""
    slack = 0.5 * float(np.median(np.diff(time)))
    chosen: list[int] = []
    for i in np.flatnonzero((time >= low) & (time <= high)):
        if not chosen or time[i] - time[chosen[-1]] >= max(interval - slack, 0.0):
            chosen.append(int(i))
    return np.array(chosen, dtype=np.intp)


def interpolate(motion: Motion, time: Array) -> Array:
    """Attitude, velocity, position of a reference at other times [T, 10]; NaN across a hole (two sample intervals and more).

    Velocity and position on a straight line, attitude along the shortest turn.
    """
    longest = 1.9 * float(np.median(np.diff(motion.time)))
    after = np.clip(np.searchsorted(motion.time, time - _SAME_TIME), 1, len(motion.time) - 1)
    before = after - 1
    gap = motion.time[after] - motion.time[before]
    part = ((time - motion.time[before]) / gap)[:, None]
    flat = np.hstack([motion.velocity, motion.position])
    straight = (1.0 - part) * flat[before] + part * flat[after]
    q = torch.from_numpy(motion.attitude)
    inverse = q[before] * q.new_tensor([1.0, -1.0, -1.0, -1.0])
    turn = attitude.rotation_vector_from_quaternion(attitude.quaternion_multiply(inverse, q[after])) * torch.from_numpy(part)
    turned = attitude.quaternion_multiply(q[before], attitude.quaternion_from_rotation_vector(turn)).numpy()
    on_sample = np.minimum(part, 1.0 - part)[:, 0] * gap <= _SAME_TIME
    known = (gap <= longest) | on_sample
    known &= (time >= motion.time[0] - _SAME_TIME) & (time <= motion.time[-1] + _SAME_TIME)
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


def assemble(
    legs: Sequence[Leg], time: Array, which: Tensor, believed: Believed, receiver: Receiver, noise: Regime, draws: MonteCarlo
) -> Episode:
    """The worlds of runs that follow legs `which` [R], on the steps `time` [T] of the longest."""
    t, longest = torch.from_numpy(time), max(legs, key=lambda leg: len(leg.time))
    fixed = torch.from_numpy(longest.fixed)
    truth = _padded([leg.truth for leg in legs], np.nan)[which]
    sd = receiver.sd
    y = _padded([leg.fixes for leg in legs], np.nan)[which][..., : len(sd)]
    # errors are drawn for fixes, not for steps: the worlds stay the same when the step changes
    y[:, fixed] += noise.errors(draws.at(0), sd, t[fixed])
    record = Record(y, _increments(legs, which, believed), _start(legs, which, believed, draws))
    groups = {"attitude": truth[..., :4], "velocity": truth[..., 4:7], "position": truth[..., 7:]}
    notes = tuple(dict.fromkeys(note for leg in legs for note in leg.notes))
    return Episode(record, t, groups, truth[..., 7:], notes)


def _start(legs: Sequence[Leg], which: Tensor, believed: Believed, draws: MonteCarlo) -> Tensor:
    """Starts [R, 16] about which the true state, nominal biases included, has the believed initial law."""
    recorded = torch.from_numpy(np.stack([leg.start for leg in legs]))[which]
    nominal = torch.cat([recorded, believed.bias.expand(len(which), -1)], -1)
    error = believed.initial_sd * draws.at(0).normal("world.start", 1, len(believed.initial_sd))[:, 0]
    return StrapdownTotal(believed).chart.add(nominal, -error)


def _increments(legs: Sequence[Leg], which: Tensor, believed: Believed) -> Increments:
    pieces = max(leg.spans.shape[1] for leg in legs)
    widened = [[np.pad(a, [(0, 0), (0, pieces - a.shape[1])] + [(0, 0)] * (a.ndim - 2)) for a in (leg.force, leg.rate, leg.spans)] for leg in legs]
    force, rate, spans = (_padded(list(arrays), 0.0) for arrays in zip(*widened, strict=True))
    bias = believed.bias.expand(*spans.shape[:2], 6)
    gravity = torch.tensor([leg.gravity for leg in legs], dtype=torch.float64)[:, None].expand(spans.shape[:2])
    u = (*preintegrate(force, rate, spans, bias), bias, gravity, spans.sum(-1))
    if len(legs) == 1:
        return Increments(*u)  # leading axis 1: shared by all runs
    return Increments(*(leaf[which] for leaf in u))


def _padded(arrays: Sequence[Array], fill: float) -> Tensor:
    """Arrays [T_k, ...] one beside the other, filled up to the longest [K, T, ...]."""
    length = max(len(a) for a in arrays)
    pad = [np.pad(a, [(0, length - len(a))] + [(0, 0)] * (a.ndim - 1), constant_values=fill) for a in arrays]
    return torch.from_numpy(np.stack(pad))


def _positive(name: str, value: float) -> None:
    if not value > 0.0:
        raise ValueError(f"{name}={value}: give a positive number of seconds")
