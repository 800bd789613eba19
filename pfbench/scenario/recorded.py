"""Recorded drives and flights: real sensors and real motion, fixes degraded on purpose, errors scored against a reference.

A drive's motion is the same in every run; what differs between runs is the receiver's errors and the initial errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pfbench.draws import MonteCarlo
from pfbench.model.strapdown_total import Believed, Increments, StrapdownTotal, preintegrate
from pfbench.noise.regimes import Regime, untouched_process
from pfbench.record import Channels, Episode, Record, fixes
from pfbench.scenario.legs import SAME_TIME, Leg, cut
from pfbench.scenario.logs import Files, read_log
from pfbench.scenario.tables import Array
from pfbench.scenario.withholding import Withholding


@dataclass(frozen=True)
class Receiver:
    """How recorded fixes become measurements.

    Args:
        interval: seconds between the fixes that are handed out; a record with fewer fixes hands out all of them.
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
    def channels(self) -> Channels:
        """Of position, and of velocity where it is measured; one receiver gives both."""
        return fixes(self.sd)

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
        withholding: which fixes are kept from the filters and serve as the truth, where the reference is no better than they
            are; None hands out all of them, and the reference is the truth.

    Raises:
        ValueError: a step or interval that is not positive; on drawing, a missing root or folder, a faulty log, or no fix
            withheld where some should be.
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
    withholding: Withholding | None = None

    def __post_init__(self) -> None:
        _positive("scenario.step", self.step)

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """The log with these runs' errors; times are those of the log."""
        return self.over(self.read(), noise, runs, seed)

    def read(self) -> Leg:
        """The log on its steps."""
        log = read_log(locate(self.root, self.folder), self.files, origin=self.origin)
        return cut(log, self.receiver.interval, self.step, self.receiver.velocity_sd is not None, self.start, self.end)

    def over(self, leg: Leg, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """The worlds of these runs over the log as read."""
        one, draws = torch.zeros_like(runs), MonteCarlo(seed, runs)
        world = assemble([leg], leg.time, one, self.believed, self.receiver, noise, draws)
        return world if self.withholding is None else self.withholding.score(world, leg, runs, self.files.reference)


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
        folder, velocity = locate(self.root, self.folder), self.receiver.velocity_sd is not None
        used = torch.unique(runs % len(self.paths)).tolist()  # reads no flight that no run asks for
        logs = [read_log(folder, self.files, self.paths[i], self.imu, self.origin) for i in used]
        legs = [cut(log, self.receiver.interval, self.step, velocity) for log in logs]
        longest = max(legs, key=lambda leg: len(leg.time))
        for i, leg in zip(used, legs, strict=True):
            n = len(leg.time)
            same = np.allclose(leg.since_start, longest.since_start[:n], rtol=0.0, atol=SAME_TIME)
            if not same or not np.array_equal(leg.fixed, longest.fixed[:n]):
                raise ValueError(
                    f"{folder}: flight {self.paths[i]} has its fixes at other times than the longest one; "
                    "leave it out of scenario.paths"
                )
        which = torch.searchsorted(torch.tensor(used), runs % len(self.paths))
        return assemble(legs, longest.since_start, which, self.believed, self.receiver, noise, MonteCarlo(seed, runs))


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


def spelled(names: Sequence[str]) -> Tensor:
    """Names, such as G12, for the sheet of an Episode: codes of their letters, filled up with spaces [S, longest]."""
    longest = max(map(len, names), default=0)
    return torch.tensor([[ord(letter) for letter in name.ljust(longest)] for name in names], dtype=torch.float64)


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
    untouched_process(noise, t)
    y[:, fixed] += noise.errors(draws.at(0), receiver.channels, t[fixed])
    record = Record(y, _increments(legs, which, believed), _start(legs, which, believed, draws))
    groups = {"attitude": truth[..., :4], "velocity": truth[..., 4:7], "position": truth[..., 7:]}
    notes = tuple(dict.fromkeys(note for leg in legs for note in leg.notes))
    first = legs[int(which[0])] if len(which) else longest
    sheet = {name: _padded([part, np.empty((len(t), 3))], np.nan)[0] for name, part in first.sensed().items()}
    return Episode(record, t, groups, truth[..., 7:], notes, sheet)


def _start(legs: Sequence[Leg], which: Tensor, believed: Believed, draws: MonteCarlo) -> Tensor:
    """Starts [R, 16] about which the true state, nominal biases included, has the believed initial law."""
    recorded = torch.from_numpy(np.stack([leg.start for leg in legs]))[which]
    nominal = torch.cat([recorded, believed.bias.expand(len(which), -1)], -1)
    error = believed.initial_sd * draws.at(0).normal("world.start", 1, len(believed.initial_sd))[:, 0]
    return StrapdownTotal(believed).chart.add(nominal, -error)


def _increments(legs: Sequence[Leg], which: Tensor, believed: Believed) -> Increments:
    force, rate, spans = (_padded(part, 0.0) for part in zip(*((leg.force, leg.rate, leg.spans) for leg in legs), strict=True))
    bias = believed.bias.expand(*spans.shape[:2], 6)
    gravity = torch.tensor([leg.gravity for leg in legs], dtype=torch.float64)[:, None].expand(spans.shape[:2])
    u = (*preintegrate(force, rate, spans, bias), bias, gravity, spans.sum(-1))
    if len(legs) == 1:
        return Increments(*u)  # leading axis 1: shared by all runs
    return Increments(*(leaf[which] for leaf in u))


def _padded(arrays: Sequence[Array], fill: float) -> Tensor:
    """Arrays one beside the other, each axis filled up to the longest [K, ...]."""
    out = np.full((len(arrays), *np.max([a.shape for a in arrays], axis=0)), fill)
    for part, a in zip(out, arrays, strict=True):
        part[tuple(slice(n) for n in a.shape)] = a
    return torch.from_numpy(out)


def _positive(name: str, value: float) -> None:
    if not value > 0.0:
        raise ValueError(f"{name}={value}: give a positive number of seconds")
