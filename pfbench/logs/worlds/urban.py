"""Recorded city drive with raw pseudoranges and odometry.

`urban_error_fit` estimates the distribution of the range errors.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.log_agreement import (
    check_orbits,
    check_wheel_direction,
    compare_ranges,
    compare_velocities,
    compare_wheels,
)
from pfbench.logs.worlds.log_tables import (
    Array,
    LogTable,
    ReferenceLog,
    check_changes,
    find_dataset,
    index_satellites,
    list_tables,
    parse_numbers,
    parse_satellites,
    read_table,
    read_times,
)
from pfbench.logs.worlds.signal_weights import SignalWeights
from pfbench.logs.worlds.time_grid import encode_names
from pfbench.model.urban_gnss import NormalRangeError, UrbanGnss, UrbanInputs, UrbanTuning
from pfbench.nav import earth
from pfbench.nav.orbits import LIGHT, azimuth_elevation
from pfbench.noise.base import NoiseRegime, check_unit_process, draw_added_errors
from pfbench.scenario.base import Scenario, check_added_sd, check_duration


@dataclass(frozen=True)
class PseudorangeReceiver:
    """Conversion of recorded pseudoranges to measurements.

    Attributes:
        fix_interval_s: Time between used epochs, s.
        range_sd: Standard deviation of added range errors, m. With 0 a noise regime can only remove
            satellites.
        clock_drift: Nominal drift of the receiver clock, m/s. It is subtracted from the ranges.
        weights: Standard deviations by elevation and signal strength, in place of those of the receiver. None for those.

    Raises:
        ValueError: If the interval is not positive, or range_sd is negative.
    """

    fix_interval_s: float = 1.0
    range_sd: float = 0.0
    clock_drift: float = -49.7
    weights: SignalWeights | None = None

    def __post_init__(self) -> None:
        check_duration("scenario.receiver.fix_interval_s", self.fix_interval_s)
        check_added_sd("scenario.receiver.range_sd", self.range_sd)


@dataclass(frozen=True)
class UrbanDrive(Scenario):
    """One recorded city drive. Runs differ in initial and added errors.

    Steps end at the epochs of the odometry. Steps at intervals of `receiver.fix_interval_s` have
    pseudoranges. The true clock bias at the start is the 20 % quantile of the GPS range residuals
    against the reference, since delays are not negative. The nominal drift, inter-system bias, wheel
    scale and yaw-rate bias are true when starts are drawn.

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        folder: Folder of the drive in `root`.
        tuning: Parameters that the filter assumes. The initial errors of the runs have the assumed
            distribution.
        receiver: Selection of pseudoranges, and standard deviation of added errors.
        start_s: Start, s of the drive. None for the start of the drive.
        end_s: End, s of the drive. None for the end of the drive.
        limits: Limits of the platform for the checks of the log. None for the default limits.

    Raises:
        ValueError: If the threshold is not positive. `draw` raises it for a missing root or folder,
            an invalid table, fewer than two epochs, a start without heading, or a regime that
            changes the process noise.
    """

    root: str | None
    folder: str
    tuning: UrbanTuning
    receiver: PseudorangeReceiver = field(default_factory=PseudorangeReceiver)
    start_s: float | None = None
    end_s: float | None = None
    limits: PlausibleLimits | None = None
    channel_names, input_type = UrbanGnss.channel_names, UrbanGnss.input_type

    def input_files(self) -> list[Path]:
        """List the files that `draw` reads."""
        return list_tables(self.root, self.folder, TABLES)

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        drive = select_stretch(
            read_drive(find_dataset(self.root, self.folder), self.limits), self.start_s, self.end_s
        )
        if self.receiver.weights is not None:
            elevation = _find_directions(drive)[1].numpy()
            drive = drive._replace(sd=self.receiver.weights.sd(elevation, drive.cn0)[0])
        draws = PhiloxStream(seed, runs)
        time, (reduced, inputs) = (
            torch.from_numpy(drive.time[1:]),
            reduce_ranges(drive, self.receiver.clock_drift),
        )
        truth = {
            name: values[1:].expand(len(runs), -1, -1)
            for name, values in interpolate_reference(drive).items()
        }
        clock_bias = np.nanquantile(
            reduced[0, [name.startswith("G") for name in drive.satellites]].numpy(), 0.2
        )
        epochs = select_epochs(drive.time, self.receiver.fix_interval_s)[1:]
        y = torch.where(
            torch.from_numpy(epochs)[:, None], reduced[1:] - clock_bias, torch.nan
        ).repeat(len(runs), 1, 1)
        satellites = len(drive.satellites)
        sd = torch.full((satellites,), self.receiver.range_sd, dtype=torch.float64)
        channels = MeasurementChannels(sd, ("range",) * satellites, tuple(range(satellites)))
        check_unit_process(noise, time)
        y[:, epochs] += draw_added_errors(noise, draws.at_step(0), channels, time[epochs])
        record = Record(y, inputs, self._draw_start(drive, draws))
        track = torch.cat([truth["position"], truth["height"]], -1)
        notes = (f"clock: nominal drift {self.receiver.clock_drift} m/s subtracted", *drive.notes)
        return Episode(record, time, truth, track, notes, line_of_sight_directions(drive))

    def _draw_start(self, drive: UrbanLog, draws: PhiloxStream) -> Tensor:
        """Draw starts [R, 9], about which the reference has the assumed distribution."""
        heading = interpolate_reference(drive)["heading"][0]
        require(
            heading.isfinite(),
            "scenario.start_s",
            "be a time at which the car moves",
            f"{self.start_s} (standing at {drive.time[0]} s)",
            "Select another start.",
        )
        model = UrbanGnss(self.tuning, NormalRangeError())
        true = torch.cat([heading.new_zeros(3), heading, heading.new_zeros(5)])
        error = model.p0 * draws.at_step(0).normal("world.start", 1, len(model.p0))[:, 0]
        return model.chart.add(true.expand_as(error), -error)


# --------------------------------------------------------------------------------------------------
# Log of a city drive, and its ranges relative to the start.
#
# The log contains satellite positions in the Earth-fixed axes of transmission. They are rotated to the
# axes of reception at the start. A range is then a distance, accurate to a millimetre within a
# kilometre of the start. The file is long since it also checks the tables against each other.

MIN_HEADING_SPEED = 1.0  # m/s; smallest speed at which the velocity determines the heading
TABLES = ("pseudorange", "odometry", "truth")
_SAME_TIME = 1e-3  # s


class UrbanLog(NamedTuple):
    """Recorded drive with T epochs and S satellites. Missing values are NaN.

    Attributes:
        time: Times, s, [T].
        speed: Wheel speed, m/s, [T].
        yaw_rate: Yaw rate of the gyro, clockwise from above, rad/s, [T].
        position: Reference latitude, longitude, height, rad and m, [T, 3].
        velocity: Reference velocity East and North, m/s, [T, 2].
        satellites: Names, such as G12.
        range: Pseudorange, corrected for satellite clock, troposphere and ionosphere, m, [T, S].
        sd: Standard deviation reported by the receiver, m, [T, S].
        cn0: Carrier-to-noise density, dB-Hz, [T, S].
        satellite_position: Satellite positions in the Earth-fixed axes of transmission, m, [T, S, 3].
        notes: Messages of the checks.
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
    satellite_position: Array
    notes: tuple[str, ...] = ()


def read_drive(folder: Path, limits: PlausibleLimits | None = None) -> UrbanLog:
    """Read the tables `pseudorange`, `odometry` and `truth` of a folder.

    Args:
        folder: Folder of the tables.
        limits: Limits of the platform. None for the default limits.

    Returns:
        The drive.

    Raises:
        ValueError: If a table or column is missing, the tables have different epochs, or a check
            fails.
    """
    pseudoranges, wheels, truth = (read_table(folder, name, {}, limits) for name in TABLES)
    time = read_times(wheels, 1.0)
    reference = parse_numbers(truth, ("t", "lat_deg", "lon_deg", "h_m", "ve_d", "vn_d"))
    remedy = "Use the same epochs in both."
    require(
        np.array_equal(time, reference[:, 0]),
        f"{folder}: {wheels.name} and {truth.name}",
        "have equal times t",
        "others",
        remedy,
    )
    t, svid, value, variance, cn0, *positions = parse_numbers(
        pseudoranges, ("t", "svid", "pr", "pr_var", "cn0", "sx", "sy", "sz")
    ).T
    row = np.searchsorted(time, t - _SAME_TIME).clip(max=len(time) - 1)
    require(
        np.abs(time[row] - t).max() <= _SAME_TIME,
        f"{folder}: {pseudoranges.name}",
        f"have only times t of {wheels.name}",
        "others",
        remedy,
    )
    satellites, index = index_satellites(pseudoranges, row, parse_satellites(pseudoranges, svid))
    columns = np.full((6, len(time), len(satellites)), np.nan)
    columns[(slice(None), *index)] = value, np.sqrt(variance), cn0, *positions
    position = np.column_stack([np.radians(reference[:, 1:3]), reference[:, 3]])
    speed, yaw_rate = parse_numbers(wheels, ("v_fwd", "yaw_rate_ned")).T
    sky_columns = columns[0], columns[1], columns[2], np.moveaxis(columns[3:], 0, -1)
    check_changes(wheels, ("v_fwd", "yaw_rate_ned"), time, np.column_stack([speed, yaw_rate]))
    drive = UrbanLog(
        time, speed, yaw_rate, position, reference[:, 4:], tuple(satellites), *sky_columns
    )
    notes = _check_drive(drive, (pseudoranges, wheels, truth))
    announce_notes(folder, notes)
    return drive._replace(notes=notes)


def _check_drive(drive: UrbanLog, tables: tuple[LogTable, LogTable, LogTable]) -> tuple[str, ...]:
    """Check satellites, ranges, wheels and reference against each other; return notes."""
    pseudoranges, wheels, truth = tables
    receiver = earth.ecef(torch.from_numpy(drive.position)).numpy()
    check_orbits(pseudoranges.name, drive.satellites, drive.time, drive.satellite_position)
    distance = np.linalg.norm(
        rotate_heading(drive.satellite_position, receiver[:, None]) - receiver[:, None], axis=-1
    )
    enu = earth.local_enu(torch.from_numpy(drive.position), torch.from_numpy(drive.position[0]))
    velocity = np.column_stack([drive.velocity, np.gradient(enu[:, 2].numpy(), drive.time)])
    check_changes(truth, ("ve_d", "vn_d"), drive.time, drive.velocity)
    level = np.tile([1.0, 0.0, 0.0, 0.0], (len(drive.time), 1))
    motion = ReferenceLog(drive.time, level, velocity, enu.numpy())
    return (
        *(note for table in tables for note in table.notes),
        *compare_velocities(truth, motion),
        *check_wheel_direction(wheels, drive.time, drive.speed),
        *compare_wheels(wheels, drive.speed, drive.yaw_rate, motion),
        *compare_ranges(
            pseudoranges.name,
            drive.satellites,
            drive.time,
            drive.range - distance,
            pseudoranges.limits,
        ),
    )


def rotate_heading(satellite: Array, at: Array) -> Array:
    """Rotate satellites from Earth-fixed axes at transmission to those at reception.

    Returns satellite positions, m, [..., 3]. Shapes: satellite [..., 3], at [..., 3].
    """
    angle = earth.OMEGA / LIGHT * np.linalg.norm(satellite - at, axis=-1)
    c, s = np.cos(angle), np.sin(angle)
    x, y, z = np.moveaxis(satellite, -1, 0)
    return np.stack([c * x + s * y, c * y - s * x, z], -1)


def select_stretch(drive: UrbanLog, start: float | None, end: float | None) -> UrbanLog:
    """Select the epochs from start to end, both inclusive.

    Args:
        drive: Drive.
        start: Start, s of the drive. None for the start of the drive.
        end: End, s of the drive. None for the end of the drive.

    Returns:
        The selected part of the drive.

    Raises:
        ValueError: If it contains fewer than two epochs.
    """
    low, high = (-np.inf if start is None else start), (np.inf if end is None else end)
    inside = (drive.time >= low) & (drive.time <= high)
    require(
        inside.sum() >= 2,
        "scenario.start_s and end_s",
        "select at least 2 epochs",
        f"{inside.sum()} between {start} and {end}",
        f"The drive covers {drive.time[0]} to {drive.time[-1]} s.",
    )
    leaves = {
        name: value[inside]
        for name, value in drive._asdict().items()
        if name not in ("satellites", "notes")
    }
    return drive._replace(**leaves)


def select_epochs(time: Array, interval: float) -> NDArray[np.bool_]:
    """Select epochs at intervals from the first one.

    Returns mask [T] of the first epochs at or after 0, interval, 2 interval, ... Shapes: time [T].
    """
    count = np.floor((time - time[0] + _SAME_TIME) / interval)
    return np.diff(count, prepend=-1.0) > 0


def interpolate_reference(drive: UrbanLog) -> dict[str, Tensor]:
    """Return the reference of each component group of the model, [T, k].

    The heading is NaN at speeds below `MIN_HEADING_SPEED`.
    """
    position = torch.from_numpy(drive.position)
    enu = earth.local_enu(position, position[0])
    east, north = torch.from_numpy(drive.velocity).unbind(-1)
    heading = torch.where(
        torch.hypot(east, north) > MIN_HEADING_SPEED, torch.atan2(east, north), torch.nan
    )
    return {"position": enu[:, :2], "height": enu[:, 2:], "heading": heading[:, None]}


def line_of_sight_directions(drive: UrbanLog) -> dict[str, Tensor]:
    """Compute azimuth and elevation from the start, for the datasheet.

    Returns azimuth and elevation, rad, [T - 1, S], without the first epoch, and encoded names.
    """
    azimuth, elevation = (angle[1:] for angle in _find_directions(drive))
    return {
        "azimuth": azimuth,
        "elevation": elevation,
        "satellites": encode_names(drive.satellites),
    }


def _find_directions(drive: UrbanLog) -> tuple[Tensor, Tensor]:
    """Compute azimuth and elevation from the start, rad, [T, S]."""
    origin = torch.from_numpy(drive.position[0])
    at = earth.ecef(origin).numpy()
    return azimuth_elevation(origin, torch.from_numpy(rotate_heading(drive.satellite_position, at)))


def reduce_ranges(drive: UrbanLog, clock_drift: float) -> tuple[Tensor, UrbanInputs]:
    """Subtract the ranges from the start and the nominal clock drift.

    Returns reduced pseudoranges, m, [T, S], and the inputs of the T - 1 steps.
    """
    origin = torch.from_numpy(drive.position[0])
    at = earth.ecef(origin).numpy()
    direction = rotate_heading(drive.satellite_position, at) - at
    reach = np.linalg.norm(direction, axis=-1)
    reduced = drive.range - reach - (clock_drift * (drive.time - drive.time[0]))[:, None]
    line = direction / reach[..., None] @ earth.local_axes(origin).numpy().T
    step_means = [0.5 * (a[1:] + a[:-1]) for a in (drive.speed, drive.yaw_rate)]
    glonass = np.broadcast_to(
        [float(name.startswith("R")) for name in drive.satellites], reach.shape
    )
    # finite values replace missing inputs, since a NaN would propagate to gradients
    line = np.where(np.isnan(line), [0.0, 0.0, 1.0], line)
    filled = [
        np.where(np.isnan(a), fill, a)
        for a, fill in ((reach, 2e7), (glonass, 0.0), (drive.cn0, 40.0), (drive.sd, 1.0))
    ]
    leaves = [np.diff(drive.time), *step_means, *(a[1:] for a in (line, *filled))]
    return torch.from_numpy(reduced), UrbanInputs(
        *(torch.from_numpy(np.ascontiguousarray(leaf))[None] for leaf in leaves)
    )
