"""Local frame of a log: its origin, positions in East, North, Up, and attitude from roll, pitch, yaw."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
import torch

from pfbench.core.parameter_checks import require
from pfbench.logs.units import DEGREE, STANDARD_GRAVITY
from pfbench.logs.worlds.log_tables import Array, LogTable, parse_numbers, swap_frd_rfu
from pfbench.nav import attitude, earth

GEODETIC_COLUMNS, LOCAL_COLUMNS = ("lat_deg", "lon_deg", "h_m"), ("pn", "pe", "pd")


def place_of(geodetic: Sequence[float] | Array) -> torch.Tensor:
    """Return places of deg, deg, m in rad, rad, m, [..., 3]."""
    return torch.from_numpy(np.asarray(geodetic, float) * [DEGREE, DEGREE, 1.0])


def to_east_north_up(geodetic: Array, origin: Sequence[float] | Array) -> Array:
    """Convert geodetic positions, deg, deg, m, to the tangent frame of an origin, [T, 3], m."""
    return np.asarray(earth.local_enu(place_of(geodetic), place_of(origin)).numpy())


def find_origin(
    origin: Sequence[float] | None, gnss: LogTable, truth: LogTable
) -> tuple[float, ...] | None:
    """Return lat_deg, lon_deg, h_m of the local frame, or None for local positions only."""
    keys = [f"origin_{name}" for name in GEODETIC_COLUMNS]
    stated = [
        [float(table.stated[key]) for key in keys]
        for table in (truth, gnss)
        if all(key in table.stated for key in keys)
    ]
    if origin is not None or stated:
        centre = stated[0] if origin is None else list(map(float, origin))
        require(
            len(centre) == 3 and abs(centre[0]) <= 90.0,
            "scenario.origin",
            "be lat_deg (-90 to 90), lon_deg, h_m",
            centre,
            "Set the point pn = pe = pd = 0.",
        )
        return tuple(centre)
    for table in (gnss, truth):
        if not table.has(LOCAL_COLUMNS) and not table.has(GEODETIC_COLUMNS):
            parse_numbers(table, LOCAL_COLUMNS)  # raises with the names of the missing columns
    local = [table.has(LOCAL_COLUMNS) for table in (gnss, truth)]
    if all(local):
        return None
    if not any(local):
        return tuple(parse_numbers(truth, GEODETIC_COLUMNS)[0].tolist())
    raise ValueError(
        f"{gnss.name} and {truth.name} must both have pn, pe, pd or both lat_deg, lon_deg, h_m, "
        "got one with each and no file with the origin pn = pe = pd = 0. "
        "Set scenario.origin=[lat_deg, lon_deg, h_m]."
    )


def read_positions(
    table: LogTable,
    origin: tuple[float, ...] | None,
    read: Callable[[LogTable, Sequence[str]], Array] = parse_numbers,
) -> Array:
    """Read positions in East, North, Up from the origin, m, [n, 3], by a reader of columns."""
    if table.has(LOCAL_COLUMNS) or not table.has(GEODETIC_COLUMNS):
        return swap_frd_rfu(read(table, LOCAL_COLUMNS))
    return to_east_north_up(read(table, GEODETIC_COLUMNS), origin or ())


def quaternion_of_angles(roll: Array, pitch: Array, yaw: Array) -> Array:
    """Return quaternions from right-forward-up to East-North-Up, [n, 4], of angles, rad, [n].

    Args:
        roll: Rolls.
        pitch: Pitches.
        yaw: Yaws, clockwise from North.

    Returns:
        Quaternions.
    """
    euler = torch.from_numpy(np.stack([pitch, roll, -yaw], axis=-1))
    return attitude.quaternion_from_dcm(attitude.dcm_from_euler(euler)).numpy()


def gravity_at(centre: tuple[float, ...] | None) -> tuple[float, tuple[str, ...]]:
    """Return the gravity at the origin, m/s^2, and a note if the origin is not known."""
    if centre is None:
        text = f"gravity {STANDARD_GRAVITY} m/s^2: the log does not contain its location"
        return STANDARD_GRAVITY, (text,)
    latitude, height = torch.tensor([centre[0] * DEGREE, centre[2]], dtype=torch.float64)
    return float(earth.gravity(latitude, height)), ()
