"""Raw pseudoranges and Doppler of a log, relative to nominal ranges and a nominal clock."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch

from pfbench.model.strapdown.tight import TightMemsInputs
from pfbench.nav import earth
from pfbench.nav.preintegration import PreintegratedImu
from pfbench.scenario.plausibility.log_agreement import describe_missing_times
from pfbench.scenario.plausibility.log_table import LogTable
from pfbench.scenario.recorded.log_tables import (
    Array,
    parse_numbers,
    parse_satellites,
    read_table,
)

_SAME_EPOCH = 0.02  # s; the receiver clock is accurate to some milliseconds
_MEASURED = (
    "t",
    "svid",
    "pr",
    "prr",
    "sd_pr",
    "sd_prr",
    "sclk",
    "sclkd",
    "tropo",
    "iono",
    "az",
    "el",
)
SKY = "pseudorange"  # table of the raw measurements
_COLUMNS = (*_MEASURED, "sx", "sy", "sz", "svx", "svy", "svz")


class RawGnssLog(NamedTuple):
    """Raw measurements of S satellites at K times, relative to the origin of the log.

    Missing values are NaN. Vectors are in East, North, Up at the time of reception.

    Attributes:
        names: Names of the satellites, such as G10 or E07.
        range: Pseudorange, corrected for satellite clock, troposphere and ionosphere, m, [K, S].
        rate: Range rate, corrected for the drift of the satellite clock, m/s, [K, S].
        range_sd: Standard deviation of the range reported by the receiver, m, [K, S].
        rate_sd: Standard deviation of the range rate reported by the receiver, m/s, [K, S].
        satellite_position: Positions of the satellites, m, [K, S, 3].
        velocity: Velocities of the satellites, m/s, [K, S, 3].
        azimuth: Azimuth, rad, [K, S].
        elevation: Elevation, rad, [K, S].
        notes: Messages of the reader.
    """

    names: tuple[str, ...]
    range: Array
    rate: Array
    range_sd: Array
    rate_sd: Array
    satellite_position: Array
    velocity: Array
    azimuth: Array
    elevation: Array
    notes: tuple[str, ...] = ()


def read_sky(
    folder: Path, time: Array, mask_deg: float, origin: Sequence[float] | None = None
) -> RawGnssLog:
    """Read raw measurements at given times.

    Each epoch is assigned to the nearest time within a tolerance.

    Args:
        folder: Folder of the log.
        time: Times, s, [K].
        mask_deg: Smallest elevation, degrees.
        origin: lat_deg, lon_deg, h_m of the local frame. None if the file contains it.

    Returns:
        The measurements.

    Raises:
        ValueError: If a column or the origin is missing, an epoch contains a satellite twice, or
            the times do not match any epoch.
    """
    table = read_table(folder, SKY, {})
    value = dict(zip(_COLUMNS, parse_numbers(table, _COLUMNS).T, strict=True))
    after = np.searchsorted(time, value["t"]).clip(1, len(time) - 1)
    row = np.where(value["t"] - time[after - 1] < time[after] - value["t"], after - 1, after)
    selected_mask = (np.abs(time[row] - value["t"]) <= _SAME_EPOCH) & (value["el"] >= mask_deg)
    if not selected_mask.any():
        raise ValueError(
            f"{table.name} does not contain a row above {mask_deg} degrees within {_SAME_EPOCH} s of the "
            "end of a step. Use the same clock for t in all tables."
        )
    row_names = np.array(parse_satellites(table, value["svid"]))
    names, slot = np.unique(row_names[selected_mask], return_inverse=True)
    index = (row[selected_mask], slot)
    if len(set(zip(*index, strict=True))) < len(slot):
        raise ValueError(
            f"{table.name} must have one row for each satellite and epoch, got two. Remove one."
        )

    def fill(column: Array) -> Array:
        out = np.full((len(time), len(names), *column.shape[1:]), np.nan)
        out[index] = column[selected_mask]
        return out

    centre, axes = _local(table, origin)
    position, velocity = (
        np.stack([value[prefix + axis] for axis in "xyz"], -1) for prefix in ("s", "sv")
    )
    corrected = (
        value["pr"] + value["sclk"] - value["tropo"] - value["iono"],
        value["prr"] + value["sclkd"],
    )
    reported = value["sd_pr"], value["sd_prr"], (position - centre) @ axes.T, velocity @ axes.T
    angles = np.radians(value["az"]), np.radians(value["el"])
    columns = [fill(column) for column in (*corrected, *reported, *angles)]
    notes = (*table.notes, *describe_missing_times(table.name, np.unique(value["t"]), time))
    return RawGnssLog._make([tuple(names.tolist()), *columns, notes])


def _local(table: LogTable, origin: Sequence[float] | None) -> tuple[Array, Array]:
    """Return Earth-fixed origin, m, [3], and axes East, North, Up, [3, 3]."""
    keys = [f"origin_{name}" for name in ("lat_deg", "lon_deg", "h_m")]
    if origin is None and not all(key in table.stated for key in keys):
        raise ValueError(
            f"{table.name} does not contain the origin pn = pe = pd = 0. "
            "Set scenario.origin=[lat_deg, lon_deg, h_m]."
        )
    lat, lon, h = [float(table.stated[key]) for key in keys] if origin is None else origin
    pos = torch.tensor([math.radians(lat), math.radians(lon), h], dtype=torch.float64)
    return earth.ecef(pos).numpy(), earth.local_axes(pos).numpy()


def subtract_nominal_ranges(
    gnss_log: RawGnssLog, time: Array, velocity: Array
) -> tuple[Array, tuple[str, ...]]:
    """Subtract nominal ranges and rates, and the nominal clock.

    Nominal ranges and rates are those of a receiver at rest at the start.

    Args:
        gnss_log: Raw measurements relative to the start.
        time: Times, s, [K].
        velocity: Velocity of the receiver at the first time, East, North, Up, m/s, [3].

    Returns:
        Reduced ranges, m, and rates, m/s, [K, 2 S], and a note for the report.

    Raises:
        ValueError: If the first time does not have a GPS satellite.
    """
    reach = np.linalg.norm(gnss_log.satellite_position, axis=-1)
    line = gnss_log.satellite_position / reach[..., None]
    ranges, rates = gnss_log.range - reach, gnss_log.rate - (line * gnss_log.velocity).sum(-1)
    gps = np.array([name.startswith("G") for name in gnss_log.names])
    if np.isnan(ranges[0, gps]).all():
        raise ValueError(
            f"scenario.start_s must have a GPS satellite, got none at t = {time[0]:.3f}. "
            "Select another start."
        )
    drift = _mean(rates[0] + line[0] @ velocity, gnss_log.rate_sd[0])
    level = _mean(ranges[0, gps], gnss_log.range_sd[0, gps])
    other_level = (
        _mean(ranges[0, ~gps], gnss_log.range_sd[0, ~gps])
        if np.isfinite(ranges[0, ~gps]).any()
        else level
    )
    ranges = ranges - np.where(gps, level, other_level) - drift * (time - time[0])[:, None]
    note = (
        f"clock: {level:.0f} m and {drift:.2f} m/s subtracted, "
        f"for other systems {other_level - level:+.1f} m more"
    )
    return np.concatenate([ranges, rates - drift], -1), (note,)


def _mean(values: Array, sd: Array) -> float:
    """Compute the mean of the finite values, weighted by reported variances."""
    finite_mask = np.isfinite(values)
    return float(np.average(values[finite_mask], weights=sd[finite_mask] ** -2))


def make_step_inputs(u: PreintegratedImu, gnss_log: RawGnssLog) -> TightMemsInputs:
    """Build the inputs of the steps.

    Args:
        u: Preintegrated IMU samples.
        gnss_log: Raw measurements relative to the start, at the start and the step ends.

    Returns:
        Inputs of the tightly coupled model.
    """
    # finite values replace missing inputs, since a NaN would propagate to gradients
    observed_mask = np.isfinite(gnss_log.range)[1:]
    reach = np.linalg.norm(gnss_log.satellite_position, axis=-1)
    line = np.where(
        observed_mask[..., None],
        (gnss_log.satellite_position / reach[..., None])[1:],
        [0.0, 0.0, 1.0],
    )
    other_system = np.broadcast_to(
        [float(not name.startswith("G")) for name in gnss_log.names], observed_mask.shape
    )
    filled = [
        np.where(observed_mask, a[1:], fill)
        for a, fill in ((gnss_log.range_sd, 1.0), (gnss_log.rate_sd, 1.0))
    ]
    velocity = np.where(observed_mask[..., None], gnss_log.velocity[1:], 0.0)
    leaves = (line, np.where(observed_mask, reach[1:], 2e7), velocity, other_system, *filled)
    return TightMemsInputs(
        *u, *(torch.from_numpy(np.ascontiguousarray(leaf))[None] for leaf in leaves)
    )
