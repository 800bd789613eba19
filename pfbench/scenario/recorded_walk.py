"""A recorded walk with raw pseudoranges and Doppler beside the IMU: tightly coupled, errors scored against a reference.

The receiver's measurements are used as recorded, corrected for what the log knows of satellite clocks, troposphere and
ionosphere. What differs between runs is the initial errors, and the errors that a regime adds to each satellite's ranges.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from pfbench.draws import MonteCarlo
from pfbench.model.strapdown_tight import BelievedTight, Sighted
from pfbench.model.strapdown_total import Increments
from pfbench.nav import earth
from pfbench.noise.regimes import Nominal, Regime, untouched_process
from pfbench.record import Channels, Episode, Record
from pfbench.scenario.legs import Leg, cut, interpolate
from pfbench.scenario.logs import Files, read_log
from pfbench.scenario.recorded import Receiver, assemble, locate, spelled
from pfbench.scenario.tables import Array, Table, numbers, read_table

_SAME_EPOCH = 0.02  # s: a receiver stamps by its own clock, which it keeps within some milliseconds
_MEASURED = ("t", "svid", "pr", "prr", "sd_pr", "sd_prr", "sclk", "sclkd", "tropo", "iono", "az", "el")
_COLUMNS = (*_MEASURED, "sx", "sy", "sz", "svx", "svy", "svz")


@dataclass(frozen=True)
class RawReceiver:
    """How recorded pseudoranges and range rates become measurements.

    Args:
        interval: seconds between the epochs that are handed out.
        range_sd, rate_sd: standard deviations of the errors that a regime adds to them, m and m/s; zeros leave them as recorded
            (a regime can then only silence satellites).
        mask_deg: smallest elevation.

    Raises:
        ValueError: an interval that is not positive, a negative standard deviation, a mask outside [-90, 90].
    """

    interval: float = 1.0
    range_sd: float = 0.0
    rate_sd: float = 0.0
    mask_deg: float = 10.0

    def __post_init__(self) -> None:
        if not self.interval > 0.0:
            raise ValueError(f"receiver.interval={self.interval}: give a positive number of seconds")
        for name, sd in (("range_sd", self.range_sd), ("rate_sd", self.rate_sd)):
            if not sd >= 0.0:
                raise ValueError(f"receiver.{name}={sd}: give a standard deviation (0 adds nothing)")
        if not -90.0 <= self.mask_deg <= 90.0:
            raise ValueError(f"receiver.mask_deg={self.mask_deg}: give an elevation between -90 and 90 degrees")

    def channels(self, satellites: int) -> Channels:
        """Of the ranges of so many satellites, then of their rates."""
        sd = torch.tensor([self.range_sd] * satellites + [self.rate_sd] * satellites, dtype=torch.float64)
        kind = ("range",) * satellites + ("rate",) * satellites
        return Channels(sd, kind, tuple(range(satellites)) * 2)


class Sky(NamedTuple):
    """Raw measurements of S satellites at K times, NaN where not seen; East, North, Up from the log's origin.

    Attributes:
        names: of the satellites, G10 or E07.
        range: pseudorange, corrected for satellite clock, troposphere and ionosphere [K, S] m.
        rate: corrected for the drift of the satellite's clock [K, S] m/s.
        range_sd, rate_sd: as the receiver states them.
        place, velocity: of the satellites, in the Earth-fixed axes of reception [K, S, 3] m, m/s.
        azimuth, elevation: [K, S] rad.
    """

    names: tuple[str, ...]
    range: Array
    rate: Array
    range_sd: Array
    rate_sd: Array
    place: Array
    velocity: Array
    azimuth: Array
    elevation: Array


@dataclass(frozen=True)
class RecordedWalk:
    """One recorded log with raw measurements; run numbers differ in their initial errors and in what a regime adds.

    The clocks' nominal course, constant drift from the first epoch on, is that of the recorded ranges and rates at the
    reference, and is taken off; about it the initial errors of the clocks are drawn.

    Args:
        root: the folder of all data sets (configuration key data.root).
        folder: the log's folder in it; beside IMU and reference it holds a table `pseudorange` with, for each epoch and
            satellite, t, sys (G or E), svid, pr, prr, sd_pr, sd_prr, sx..sz, svx..svz, sclk, sclkd, tropo, iono, az, el (SI;
            az and el in degrees).
        believed: what filters are told; the initial errors of the runs are drawn from it too.
        receiver: which measurements are handed out, and the size of the errors added to them.
        step: longest filter interval in s.
        start, end: seconds of the log; null for all of it.
        files: names of the tables; steps end at the times of `gnss`.
        origin: lat_deg, lon_deg, h_m of the local frame, where the files do not say it.

    Raises:
        ValueError: a step that is not positive; on drawing, a missing root or folder, a faulty log, no satellite of GPS at the
            start, or a regime that swells the noise of recorded sensors.
    """

    root: str | None
    folder: str
    believed: BelievedTight
    receiver: RawReceiver = field(default_factory=RawReceiver)
    step: float = 0.25
    start: float | None = None
    end: float | None = None
    files: Files = field(default_factory=lambda: Files(gnss="reference"))
    origin: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if not self.step > 0.0:
            raise ValueError(f"scenario.step={self.step}: give a positive number of seconds")

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """The walk with these runs' errors; times are those of the log."""
        leg, sky = self._read()
        draws, fixed = MonteCarlo(seed, runs), torch.from_numpy(leg.fixed)
        loose = assemble([leg], leg.time, torch.zeros_like(runs), self.believed.motion, Receiver(), Nominal(), draws)
        time = np.concatenate([[leg.begin], leg.time])
        measured, notes = reduced(sky, time, leg.start[4:7])
        y = torch.where(fixed[:, None], torch.from_numpy(measured[1:]), torch.nan).repeat(len(runs), 1, 1)
        untouched_process(noise, loose.time)
        # errors are drawn for epochs, not for steps: the worlds stay the same when the step changes
        y[:, fixed] += noise.errors(draws.at(0), self.receiver.channels(len(sky.names)), loose.time[fixed])
        record = Record(y, sighted(loose.record.u, sky), self._start(loose.record.start, draws))
        azimuth, elevation = (torch.from_numpy(a[1:]) for a in (sky.azimuth, sky.elevation))
        seen = {"azimuth": azimuth, "elevation": elevation, "satellites": spelled(sky.names)}
        return Episode(record, loose.time, loose.truth, loose.track, (*loose.notes, *notes), loose.sheet | seen)

    def _start(self, motion: Tensor | None, draws: MonteCarlo) -> Tensor:
        """Starts [R, 19] about which motion and clocks have the believed initial law; the clocks' true course is nominal."""
        clock = self.believed.clock_sd * draws.at(0).normal("world.clock", 1, 3)[:, 0]
        return torch.cat([clock.new_zeros(len(clock), 0) if motion is None else motion, -clock], -1)

    def _read(self) -> tuple[Leg, Sky]:
        """The log on its steps, and the sky at the start and at the ends of the steps, as seen from the start."""
        folder = locate(self.root, self.folder)
        log = read_log(folder, self.files, origin=self.origin)
        leg = cut(log, self.receiver.interval, self.step, start=self.start, end=self.end)
        sky = read_sky(folder, np.concatenate([[leg.begin], leg.time]), self.receiver.mask_deg, self.origin)
        start = interpolate(log.reference, np.array([leg.begin]))[0, 7:]
        return leg, sky._replace(place=sky.place - start)


def read_sky(folder: Path, time: Array, mask_deg: float, origin: Sequence[float] | None = None) -> Sky:
    """Raw measurements at K times s; an epoch belongs to the time that it is next to, if that is near enough.

    Raises:
        ValueError: a column that is missing, two rows for one satellite and epoch, an unknown origin, or no epoch at any time.
    """
    table = read_table(folder, "pseudorange", {})
    value = dict(zip(_COLUMNS, numbers(table, _COLUMNS).T, strict=True))
    after = np.searchsorted(time, value["t"]).clip(1, len(time) - 1)
    row = np.where(value["t"] - time[after - 1] < time[after] - value["t"], after - 1, after)
    wanted = (np.abs(time[row] - value["t"]) <= _SAME_EPOCH) & (value["el"] >= mask_deg)
    if not wanted.any():
        raise ValueError(
            f"{table.name}: nothing above {mask_deg} degrees within {_SAME_EPOCH} s of the end of a step; give t by one clock"
        )
    systems = table.rows["sys"] if "sys" in table.rows else ["G"] * len(row)
    each = np.array([f"{system}{int(number):02d}" for system, number in zip(systems, value["svid"], strict=True)])
    names, slot = np.unique(each[wanted], return_inverse=True)
    place = (row[wanted], slot)
    if len(set(zip(*place, strict=True))) < len(slot):
        raise ValueError(f"{table.name}: two rows for one satellite and epoch; keep one")

    def laid(column: Array) -> Array:
        out = np.full((len(time), len(names), *column.shape[1:]), np.nan)
        out[place] = column[wanted]
        return out

    centre, axes = _local(table, origin)
    at, velocity = (np.stack([value[prefix + axis] for axis in "xyz"], -1) for prefix in ("s", "sv"))
    corrected = value["pr"] + value["sclk"] - value["tropo"] - value["iono"], value["prr"] + value["sclkd"]
    stated = value["sd_pr"], value["sd_prr"], (at - centre) @ axes.T, velocity @ axes.T
    angles = np.radians(value["az"]), np.radians(value["el"])
    return Sky(tuple(names.tolist()), *(laid(column) for column in (*corrected, *stated, *angles)))


def _local(table: Table, origin: Sequence[float] | None) -> tuple[Array, Array]:
    """The local frame's origin [3] m and axes East, North, Up [3, 3], Earth-fixed."""
    keys = [f"origin_{part}" for part in ("lat_deg", "lon_deg", "h_m")]
    if origin is None and not all(key in table.stated for key in keys):
        raise ValueError(f"{table.name} does not say where pn = pe = pd = 0 is; set origin=[lat_deg, lon_deg, h_m]")
    lat, lon, h = [float(table.stated[key]) for key in keys] if origin is None else origin
    pos = torch.tensor([math.radians(lat), math.radians(lon), h], dtype=torch.float64)
    return earth.ecef(pos).numpy(), earth.local_axes(pos).numpy()


def reduced(sky: Sky, time: Array, velocity: Array) -> tuple[Array, tuple[str, ...]]:
    """Ranges and rates [K, 2 S] less what a receiver at rest at the start would see, and less the clocks' nominal course.

    Args:
        sky: seen from the start.
        time: [K] s.
        velocity: of the receiver at the first time, East, North, Up [3] m/s.

    Returns:
        The measurements, and what was taken off, for the report.

    Raises:
        ValueError: no satellite of GPS at the first time.
    """
    reach = np.linalg.norm(sky.place, axis=-1)
    line = sky.place / reach[..., None]
    ranges, rates = sky.range - reach, sky.rate - (line * sky.velocity).sum(-1)
    gps = np.array([name.startswith("G") for name in sky.names])
    if np.isnan(ranges[0, gps]).all():
        raise ValueError(f"no GPS satellite at t = {time[0]:.3f}, where the runs would start: choose another start")
    drift = _mean(rates[0] + line[0] @ velocity, sky.rate_sd[0])
    level = _mean(ranges[0, gps], sky.range_sd[0, gps])
    other = _mean(ranges[0, ~gps], sky.range_sd[0, ~gps]) if np.isfinite(ranges[0, ~gps]).any() else level
    ranges = ranges - np.where(gps, level, other) - drift * (time - time[0])[:, None]
    note = f"clock: {level:.0f} m and {drift:.2f} m/s taken off, of other systems {other - level:+.1f} m more"
    return np.concatenate([ranges, rates - drift], -1), (note,)


def _mean(values: Array, sd: Array) -> float:
    """Mean of those seen, weighted by their stated accuracy."""
    seen = np.isfinite(values)
    return float(np.average(values[seen], weights=sd[seen] ** -2))


def sighted(u: Increments, sky: Sky) -> Sighted:
    """Inputs of the steps."""
    # what was not seen is filled with harmless numbers: a NaN would spread from weight zero to gradients
    seen = np.isfinite(sky.range)[1:]
    reach = np.linalg.norm(sky.place, axis=-1)
    line = np.where(seen[..., None], (sky.place / reach[..., None])[1:], [0.0, 0.0, 1.0])
    other = np.broadcast_to([float(not name.startswith("G")) for name in sky.names], seen.shape)
    filled = [np.where(seen, a[1:], fill) for a, fill in ((sky.range_sd, 1.0), (sky.rate_sd, 1.0))]
    velocity = np.where(seen[..., None], sky.velocity[1:], 0.0)
    leaves = (line, np.where(seen, reach[1:], 2e7), velocity, other, *filled)
    return Sighted(*u, *(torch.from_numpy(np.ascontiguousarray(leaf))[None] for leaf in leaves))
