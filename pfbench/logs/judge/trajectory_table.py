"""Trajectory of a program as a table, and the checks that every reader shares."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.logs.doctor.axis_orders import ENU_TO_NED
from pfbench.logs.sky.plausible_limits import LIMIT_COLUMNS, QUANTITIES, Quantity
from pfbench.logs.worlds.time_order import check_time_order
from pfbench.stats.error_measures import Array

LOCAL = ("pn", "pe", "pd")
GEODETIC = ("lat_deg", "lon_deg", "h_m")
VELOCITY_COLUMNS = ("vn", "ve", "vd")
ATTITUDE_COLUMNS = ("roll", "pitch", "yaw")
IMU_COLUMNS = ("fx", "fy", "fz", "wx", "wy", "wz")
POSITION_SD = ("sd_pn", "sd_pe", "sd_pd")
VELOCITY_SD = ("sd_vn", "sd_ve", "sd_vd")
ATTITUDE_SD = ("sd_roll", "sd_pitch", "sd_yaw")
COVARIANCE_COLUMNS = (
    "cov_nn",
    "cov_ne",
    "cov_nd",
    "cov_ee",
    "cov_ed",
    "cov_dd",
)  # of the position, m^2
COLUMN_GROUPS = (
    LOCAL,
    GEODETIC,
    VELOCITY_COLUMNS,
    ATTITUDE_COLUMNS,
    POSITION_SD,
    VELOCITY_SD,
    ATTITUDE_SD,
    COVARIANCE_COLUMNS,
)
SD_GROUPS = (POSITION_SD, VELOCITY_SD, ATTITUDE_SD)
ALL_COLUMNS = ("t", *(name for group in COLUMN_GROUPS for name in group))
TRAJECTORY = "trajectory"
ROLES = {  # columns of a trajectory, and of the tables of an own log
    TRAJECTORY: ALL_COLUMNS,
    "imu": ("t", *IMU_COLUMNS),
    "gnss": ("t", *GEODETIC, *LOCAL, *VELOCITY_COLUMNS, "fix"),
    "reference": ("t", *GEODETIC, *LOCAL, *VELOCITY_COLUMNS, *ATTITUDE_COLUMNS),
}
_MOSTLY = 0.1  # share of the rows that are not removed for a column
_SD_COLUMNS = {"cov_nn", "cov_ee", "cov_dd", *(name for group in SD_GROUPS for name in group)}
_UNCERTAINTY = Quantity("", float(np.nextafter(0.0, 1.0)), 1e12)


@dataclass(frozen=True)
class TrajectoryTable:
    """Trajectory of one run of a program.

    Attributes:
        file: Name of the file, for messages.
        time: Time, [T], s, increasing.
        values: Columns by name, [T] each: groups of `COLUMN_GROUPS` in m, deg (latitude, longitude), m/s
            and rad.
        lines: Line of each row in the file, [T].
        notes: Notes of the reader.
        run: Number of the run within the file.
        origin: Latitude, longitude, height of the local frame if the file states it; deg, deg, m.
        angle_unit: Unit of roll, pitch and yaw in the file, for messages.
        frame: Axes that the option of a TUM file states, "enu" or "ned"; empty for others.
        truth: Truth of a result of pfbench in the frame of its positions, [T, 3], m.
    """

    file: str
    time: Array
    values: Mapping[str, Array]
    lines: np.ndarray
    notes: tuple[str, ...] = ()
    run: int = 0
    origin: tuple[float, ...] = ()
    angle_unit: str = "rad"
    frame: str = ""
    truth: Array | None = None

    def select(self, group: tuple[str, ...]) -> Array:
        """Return the columns of a group, [T, K]."""
        return np.stack([self.values[name] for name in group], axis=-1)

    def has(self, group: tuple[str, ...]) -> bool:
        """Return whether a group of columns is present."""
        return group[0] in self.values

    def scale_columns(self, factors: Mapping[str, float]) -> TrajectoryTable:
        """Return the table with columns, or t, multiplied by factors."""
        values = {name: value * factors.get(name, 1.0) for name, value in self.values.items()}
        return replace(self, time=self.time * factors.get("t", 1.0), values=values)

    def keep_rows(self, mask: np.ndarray) -> TrajectoryTable:
        """Return the rows of a mask [T]."""
        values = {name: value[mask] for name, value in self.values.items()}
        truth = None if self.truth is None else self.truth[mask]
        return replace(
            self, time=self.time[mask], values=values, lines=self.lines[mask], truth=truth
        )


def check_trajectory(table: TrajectoryTable) -> TrajectoryTable:
    """Check groups, numbers, order of time and plausible ranges.

    Returns the table.
    """
    count = len(table.time)
    require(count > 1, table.file, "have at least 2 rows", count, "Write the file again.")
    for group in COLUMN_GROUPS:
        present = [name for name in group if name in table.values]
        require(
            len(present) in (0, len(group)) or present == ["vn", "ve"],
            f"{table.file}: columns {', '.join(group)}",
            "be complete",
            f"{', '.join(present)} without {', '.join(name for name in group if name not in present)}",
            "Add the missing columns or rename all of the group.",
        )
    require(
        table.has(LOCAL) or table.has(GEODETIC),
        table.file,
        "have the position columns pn, pe, pd or lat_deg, lon_deg, h_m",
        ", ".join(table.values) or "none",
        "Rename columns with NAME.columns=pn:north,...",
    )
    for name, value in (("t", table.time), *table.values.items()):
        _check_finite(table, name, value)
    check_time_order(table.file, table.time, lambda i: f"line {table.lines[i]}")
    for name, value in table.values.items():
        _check_range(table, name, value)
    _check_covariance(table)
    return table


def _place(table: TrajectoryTable, row: int, name: str) -> str:
    return f"{table.file}: line {table.lines[row]}, column {name}"


def _check_finite(table: TrajectoryTable, name: str, value: Array) -> None:
    bad = ~np.isfinite(value)
    row, count = int(bad.argmax()), int(bad.sum())
    remedy = "Remove these rows or repair the column."
    if count > _MOSTLY * len(value):
        needed = name in ("t", *LOCAL, *GEODETIC)
        remedy = "Repair the column." if needed else "Remove or rename the columns of its group."
    require(
        not count,
        _place(table, row, name),
        "be a finite number",
        f"{value[row]} (in {count} of {len(value)} rows)",
        remedy,
    )


def _check_range(table: TrajectoryTable, name: str, value: Array) -> None:
    quantity = _quantity_of(name)
    least, largest = quantity.least, quantity.largest
    bad = (value < least) | (value > largest)
    row = int(bad.argmax())
    options = [
        f"if in {unit}, set NAME.scale={name}:{factor:.8g}"
        for unit, factor in quantity.units.items()
        if least <= (factor * value).min() and (factor * value).max() <= largest
    ]
    remedy = (
        f"I{'; '.join(options)[1:]}." if options else "Check the unit and the order of the columns."
    )
    must = f"be from {least:g} to {largest:g} {quantity.unit}"
    if quantity is _UNCERTAINTY:
        must, remedy = (
            f"be above 0, at most {largest:g}",
            "Remove the uncertainty columns or repair them.",
        )
    require(not bad[row], _place(table, row, name), must, f"{value[row]:.10g}", remedy)


def _quantity_of(name: str) -> Quantity:
    """Return the range of a column; without limits for one that has none."""
    if name in _SD_COLUMNS:
        return _UNCERTAINTY
    return (
        QUANTITIES[LIMIT_COLUMNS[name]] if name in LIMIT_COLUMNS else Quantity("", -np.inf, np.inf)
    )


def _check_covariance(table: TrajectoryTable) -> None:
    if not table.has(COVARIANCE_COLUMNS):
        return
    least = np.linalg.eigvalsh(covariance_matrices(table.select(COVARIANCE_COLUMNS)))[:, 0]
    row = int(least.argmin())
    got, remedy = f"the least eigenvalue {least[row]:.3g} m^2", "Repair the columns or remove them."
    require(
        least[row] > 0,
        _place(table, row, "cov_nn ... cov_dd"),
        "be a positive definite matrix",
        got,
        remedy,
    )


def covariance_matrices(entries: Array) -> Array:
    """Return matrices [T, 3, 3] from the columns `COVARIANCE_COLUMNS`, [T, 6]."""
    upper = entries[:, [0, 1, 2, 1, 3, 4, 2, 4, 5]]
    return upper.reshape(-1, 3, 3)


def to_north_east_down(geodetic: Array, origin: Array) -> Array:
    """Convert geodetic positions to the tangent frame of an origin.

    Returns north, East, Down, [T, 3], m. Shapes: geodetic [T, 3].
    """
    from pfbench.logs.worlds.log_frames import to_east_north_up  # imports torch

    return to_east_north_up(geodetic, origin) @ ENU_TO_NED


def euler_angles(rotation: Array) -> Array:
    """Return roll, pitch, yaw [T, 3] in rad of rotations [T, 3, 3] from body to North, East, Down."""
    roll = np.arctan2(rotation[:, 2, 1], rotation[:, 2, 2])
    pitch = -np.arcsin(np.clip(rotation[:, 2, 0], -1.0, 1.0))
    return np.stack([roll, pitch, np.arctan2(rotation[:, 1, 0], rotation[:, 0, 0])], axis=-1)


def wrap_to_half_turn(angle: Array) -> Array:
    """Return angles in rad within half a turn of 0."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
