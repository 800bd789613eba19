"""A recorded drive through a city with raw pseudoranges and odometry; `urban_law` estimates the law of its range errors.

Satellites come in the Earth-fixed axes of transmission and are turned into those of reception, about the start; a range is then
a plain distance (to a millimetre within a kilometre of the start).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pfbench.draws import MonteCarlo
from pfbench.model.urban_gnss import Believed, Normal, Sky, UrbanGnss
from pfbench.nav import earth
from pfbench.nav.orbits import azimuth_elevation
from pfbench.noise.regimes import Regime, untouched_process
from pfbench.record import Channels, Episode, Record
from pfbench.scenario.recorded import locate, spelled
from pfbench.scenario.tables import Array, numbers, read_table, times

LIGHT = 299792458.0  # m/s
MOVING = 1.0  # m/s, above which the track tells the heading
_SAME_TIME = 1e-3  # s


class Drive(NamedTuple):
    """A recorded drive: T epochs, S slots of which each belongs to one satellite; NaN where it was not seen.

    Attributes:
        time: [T] s.
        speed, yaw_rate: of the wheels and of the gyro, clockwise seen from above [T] m/s, rad/s.
        position: reference, latitude, longitude, height [T, 3] rad, m.
        velocity: reference, East and North [T, 2] m/s.
        satellites: names, such as G12.
        range: pseudorange corrected for satellite clock, troposphere and ionosphere [T, S] m.
        sd: as the receiver states it [T, S] m.
        cn0: carrier-to-noise density [T, S] dB-Hz.
        place: satellite in the Earth-fixed axes of transmission [T, S, 3] m.
    """

    time: Array
    speed: Array
    yaw_rate: Array
    position: Array
    velocity: Array
    satellites: tuple[str, ...]
    range: Array
    sd: Array
    cn0: Array
    place: Array


def read_drive(folder: Path) -> Drive:
    """The tables `pseudorange`, `odometry` and `truth` of a folder.

    Raises:
        ValueError: a missing table or column, or tables whose epochs differ.
    """
    sky, wheels, truth = (read_table(folder, name, {}) for name in ("pseudorange", "odometry", "truth"))
    time = times(wheels, 1.0)
    at = numbers(truth, ("t", "lat_deg", "lon_deg", "h_m", "ve_d", "vn_d"))
    if not np.array_equal(time, at[:, 0]):
        raise ValueError(f"{folder}: {wheels.name} and {truth.name} have other times t; give both at the same epochs")
    t, svid, value, variance, cn0, *place = numbers(sky, ("t", "svid", "pr", "pr_var", "cn0", "sx", "sy", "sz")).T
    row = np.searchsorted(time, t - _SAME_TIME).clip(max=len(time) - 1)
    if np.abs(time[row] - t).max() > _SAME_TIME:
        raise ValueError(f"{folder}: {sky.name} has times t that {wheels.name} has not; give both at the same epochs")
    names = [f"{system}{int(number):02d}" for system, number in zip(sky.rows["sys"], svid, strict=True)]
    satellites, slot = np.unique(names, return_inverse=True)
    columns = np.full((6, len(time), len(satellites)), np.nan)
    columns[:, row, slot] = value, np.sqrt(variance), cn0, *place
    position = np.column_stack([np.radians(at[:, 1:3]), at[:, 3]])
    speed, yaw_rate = numbers(wheels, ("v_fwd", "yaw_rate_ned")).T
    sky_columns = columns[0], columns[1], columns[2], np.moveaxis(columns[3:], 0, -1)
    return Drive(time, speed, yaw_rate, position, at[:, 4:], tuple(satellites.tolist()), *sky_columns)


def turned(place: Array, at: Array) -> Array:
    """Satellites [..., 3] turned from the Earth's axes of transmission into those of reception at a point [..., 3], m."""
    angle = earth.OMEGA / LIGHT * np.linalg.norm(place - at, axis=-1)
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = np.moveaxis(place, -1, 0)
    return np.stack([c * x + s * y, c * y - s * x, z], -1)


@dataclass(frozen=True)
class Receiver:
    """How recorded pseudoranges become measurements.

    Args:
        interval: seconds between the epochs that are handed out.
        range_sd: standard deviation of the errors that a regime adds to them, m; 0 leaves them as recorded (a regime can then
            only silence them).
        clock_drift: nominal drift of the receiver's clock that is taken off, m/s.

    Raises:
        ValueError: an interval that is not positive, a negative range_sd.
    """

    interval: float = 1.0
    range_sd: float = 0.0
    clock_drift: float = -49.7

    def __post_init__(self) -> None:
        if not self.interval > 0.0:
            raise ValueError(f"receiver.interval={self.interval}: give a positive number of seconds")
        if not self.range_sd >= 0.0:
            raise ValueError(f"receiver.range_sd={self.range_sd}: give a standard deviation in m (0 adds nothing)")


@dataclass(frozen=True)
class UrbanDrive:
    """One recorded drive in a city; runs differ in their initial errors, and in what a regime adds.

    A step ends at each epoch of the odometry; at every `receiver.interval` one has pseudoranges. The true clock at the start is
    the lower fifth of the ranges' residuals against the reference, as delays are never negative; the nominal drift, inter-system
    bias, wheel scale and yaw-rate bias are taken for true when starts are drawn.

    Args:
        root: the folder of all data sets (configuration key data.root).
        folder: the drive's folder in it.
        believed: what filters are told; the initial errors of the runs are drawn from it too.
        receiver: which pseudoranges are handed out.
        start, end: seconds of the drive that are scored; null for all of it.

    Raises:
        ValueError: on drawing, a missing root or folder, a faulty table, fewer than two epochs, a start at which the car stands,
            so that it has no heading, or a regime that swells the noise of recorded sensors.
    """

    root: str | None
    folder: str
    believed: Believed
    receiver: Receiver = field(default_factory=Receiver)
    start: float | None = None
    end: float | None = None

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """The drive with these runs' errors; times are those of the drive."""
        drive = stretch(read_drive(locate(self.root, self.folder)), self.start, self.end)
        draws = MonteCarlo(seed, runs)
        time, (reduced, sky) = torch.from_numpy(drive.time[1:]), reduce(drive, self.receiver.clock_drift)
        truth = {name: part[1:].expand(len(runs), -1, -1) for name, part in reference(drive).items()}
        first = np.nanquantile(reduced[0, [name.startswith("G") for name in drive.satellites]].numpy(), 0.2)
        epochs = handed_out(drive.time, self.receiver.interval)[1:]
        y = torch.where(torch.from_numpy(epochs)[:, None], reduced[1:] - first, torch.nan).repeat(len(runs), 1, 1)
        slots = len(drive.satellites)
        sd = torch.full((slots,), self.receiver.range_sd, dtype=torch.float64)
        channels = Channels(sd, ("range",) * slots, tuple(range(slots)))
        untouched_process(noise, time)
        y[:, epochs] += noise.errors(draws.at(0), channels, time[epochs])
        record = Record(y, sky, self._start(drive, draws))
        track = torch.cat([truth["position"], truth["height"]], -1)
        notes = (f"clock: nominal drift {self.receiver.clock_drift} m/s taken off",)
        return Episode(record, time, truth, track, notes, directions(drive))

    def _start(self, drive: Drive, draws: MonteCarlo) -> Tensor:
        """Starts [R, 9] about which the reference has the believed initial law."""
        heading = reference(drive)["heading"][0]
        if bool(torch.isnan(heading)):
            raise ValueError(f"scenario.start={self.start}: the car stands at {drive.time[0]} s; start where it moves")
        model = UrbanGnss(self.believed, Normal())
        true = torch.cat([heading.new_zeros(3), heading, heading.new_zeros(5)])
        error = model.p0 * draws.at(0).normal("world.start", 1, len(model.p0))[:, 0]
        return model.chart.add(true.expand_as(error), -error)


def stretch(drive: Drive, start: float | None, end: float | None) -> Drive:
    """The epochs from start to end, s, both inclusive.

    Raises:
        ValueError: fewer than two.
    """
    low, high = (-np.inf if start is None else start), (np.inf if end is None else end)
    inside = (drive.time >= low) & (drive.time <= high)
    if inside.sum() < 2:
        raise ValueError(
            f"{inside.sum()} epochs between start={start} and end={end}; the drive has {drive.time[0]} to {drive.time[-1]} s"
        )
    parts = {name: value[inside] for name, value in drive._asdict().items() if name != "satellites"}
    return drive._replace(**parts)


def handed_out(time: Array, interval: float) -> NDArray[np.bool_]:
    """Epochs [T] that are the first at or after 0, interval, 2 interval ... from the first one."""
    count = np.floor((time - time[0] + _SAME_TIME) / interval)
    return np.diff(count, prepend=-1.0) > 0


def reference(drive: Drive) -> dict[str, Tensor]:
    """Reference of the model's groups [T, k]; no heading below `MOVING`."""
    position = torch.from_numpy(drive.position)
    enu = earth.local_enu(position, position[0])
    east, north = torch.from_numpy(drive.velocity).unbind(-1)
    heading = torch.where(torch.hypot(east, north) > MOVING, torch.atan2(east, north), torch.nan)
    return {"position": enu[:, :2], "height": enu[:, 2:], "heading": heading[:, None]}


def directions(drive: Drive) -> dict[str, Tensor]:
    """For the sheet, from the start: azimuth and elevation [T, S] at all epochs but the first, NaN where not seen; names."""
    origin = torch.from_numpy(drive.position[0])
    place = torch.from_numpy(turned(drive.place[1:], earth.ecef(origin).numpy()))
    azimuth, elevation = azimuth_elevation(origin, place)
    return {"azimuth": azimuth, "elevation": elevation, "satellites": spelled(drive.satellites)}


def reduce(drive: Drive, clock_drift: float) -> tuple[Tensor, Sky]:
    """Pseudoranges less the range from the start and the nominal drift [T, S], and the inputs of the steps after the first."""
    origin = torch.from_numpy(drive.position[0])
    at = earth.ecef(origin).numpy()
    sight = turned(drive.place, at) - at
    reach = np.linalg.norm(sight, axis=-1)
    reduced = drive.range - reach - (clock_drift * (drive.time - drive.time[0]))[:, None]
    line = sight / reach[..., None] @ earth.local_axes(origin).numpy().T
    middle = [0.5 * (a[1:] + a[:-1]) for a in (drive.speed, drive.yaw_rate)]
    glonass = np.broadcast_to([float(name.startswith("R")) for name in drive.satellites], reach.shape)
    # what was not seen is filled with harmless numbers: a NaN would spread from weight zero to gradients
    line = np.where(np.isnan(line), [0.0, 0.0, 1.0], line)
    filled = [np.where(np.isnan(a), fill, a) for a, fill in ((reach, 2e7), (glonass, 0.0), (drive.cn0, 40.0), (drive.sd, 1.0))]
    leaves = [np.diff(drive.time), *middle, *(a[1:] for a in (line, *filled))]
    return torch.from_numpy(reduced), Sky(*(torch.from_numpy(np.ascontiguousarray(leaf))[None] for leaf in leaves))
