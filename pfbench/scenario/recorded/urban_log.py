"""Log of a city drive, and its ranges relative to the start.

The log contains satellite positions in the Earth-fixed axes of transmission. They are rotated to the
axes of reception at the start. A range is then a distance, accurate to a millimetre within a
kilometre of the start. The file is long since it also checks the tables against each other.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pfbench.files.reader_notes import announce_notes
from pfbench.model.pseudorange_errors import UrbanInputs
from pfbench.nav import earth
from pfbench.nav.gnss.orbits import LIGHT, azimuth_elevation
from pfbench.nav.plausible_limits import PlausibleLimits
from pfbench.scenario.plausibility.column_checks import check_changes
from pfbench.scenario.plausibility.drive_checks import check_geocentric, check_wheel_direction
from pfbench.scenario.plausibility.log_agreement import compare_reference, compare_wheels
from pfbench.scenario.plausibility.log_table import LogTable
from pfbench.scenario.plausibility.satellite_agreement import check_orbits, compare_ranges
from pfbench.scenario.recorded.assembly import encode_names
from pfbench.scenario.recorded.log_tables import (
    Array,
    parse_numbers,
    parse_satellites,
    read_table,
    read_times,
)
from pfbench.scenario.recorded.navigation_log import ReferenceLog

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
    if not np.array_equal(time, reference[:, 0]):
        raise ValueError(
            f"{folder}: {wheels.name} and {truth.name} must have equal times t. "
            "Use the same epochs in both."
        )
    t, svid, value, variance, cn0, *positions = parse_numbers(
        pseudoranges, ("t", "svid", "pr", "pr_var", "cn0", "sx", "sy", "sz")
    ).T
    row = np.searchsorted(time, t - _SAME_TIME).clip(max=len(time) - 1)
    if np.abs(time[row] - t).max() > _SAME_TIME:
        raise ValueError(
            f"{folder}: {pseudoranges.name} must have only times t of {wheels.name}. "
            "Use the same epochs in both."
        )
    names = parse_satellites(pseudoranges, svid)
    satellites, slot = np.unique(names, return_inverse=True)
    if len(set(zip(row, slot, strict=True))) < len(slot):
        raise ValueError(
            f"{pseudoranges.name} must have one row for each satellite and epoch, got two. Remove one."
        )
    columns = np.full((6, len(time), len(satellites)), np.nan)
    columns[:, row, slot] = value, np.sqrt(variance), cn0, *positions
    position = np.column_stack([np.radians(reference[:, 1:3]), reference[:, 3]])
    speed, yaw_rate = parse_numbers(wheels, ("v_fwd", "yaw_rate_ned")).T
    sky_columns = columns[0], columns[1], columns[2], np.moveaxis(columns[3:], 0, -1)
    check_changes(wheels, ("v_fwd", "yaw_rate_ned"), time, np.column_stack([speed, yaw_rate]))
    drive = UrbanLog(
        time, speed, yaw_rate, position, reference[:, 4:], tuple(satellites.tolist()), *sky_columns
    )
    notes = _check_drive(drive, (pseudoranges, wheels, truth))
    announce_notes(folder, notes)
    return drive._replace(notes=notes)


def _check_drive(drive: UrbanLog, tables: tuple[LogTable, LogTable, LogTable]) -> tuple[str, ...]:
    """Check satellites, ranges, wheels and reference against each other; return notes."""
    pseudoranges, wheels, truth = tables
    check_geocentric(truth)
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
        *compare_reference(truth, motion),
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

    Args:
        satellite: Satellite positions, m, [..., 3].
        at: Position of the receiver, m, [..., 3].

    Returns:
        Satellite positions, m, [..., 3].
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
    if inside.sum() < 2:
        raise ValueError(
            "scenario.start_s and end_s must select at least 2 epochs, "
            f"got {inside.sum()} between {start} and {end}. "
            f"The drive covers {drive.time[0]} to {drive.time[-1]} s."
        )
    leaves = {
        name: value[inside]
        for name, value in drive._asdict().items()
        if name not in ("satellites", "notes")
    }
    return drive._replace(**leaves)


def select_epochs(time: Array, interval: float) -> NDArray[np.bool_]:
    """Select epochs at intervals from the first one.

    Args:
        time: Times of the epochs, s, [T].
        interval: Time between selected epochs, s.

    Returns:
        Mask [T] of the first epochs at or after 0, interval, 2 interval, ...
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

    Args:
        drive: Drive.

    Returns:
        Azimuth and elevation, rad, [T - 1, S], without the first epoch, and encoded names.
    """
    origin = torch.from_numpy(drive.position[0])
    positions = torch.from_numpy(
        rotate_heading(drive.satellite_position[1:], earth.ecef(origin).numpy())
    )
    azimuth, elevation = azimuth_elevation(origin, positions)
    return {
        "azimuth": azimuth,
        "elevation": elevation,
        "satellites": encode_names(drive.satellites),
    }


def reduce_ranges(drive: UrbanLog, clock_drift: float) -> tuple[Tensor, UrbanInputs]:
    """Subtract the ranges from the start and the nominal clock drift.

    Args:
        drive: Drive.
        clock_drift: Nominal drift of the receiver clock, m/s.

    Returns:
        Reduced pseudoranges, m, [T, S], and the inputs of the T - 1 steps.
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
