"""Units of recorded columns: one table of names and factors for readers, inspection and judge."""

from __future__ import annotations

import math

DEGREE = math.pi / 180.0
WEEK = 604800.0  # s
STANDARD_GRAVITY = 9.80665  # m/s^2
# factors that convert to the unit of a table: s, m, m/s, m/s^2, rad, rad/s, deg (of places), kPa, gauss
UNIT_FACTORS: dict[str, dict[str, float]] = {
    "time": {"ms": 1e-3, "us": 1e-6, "ns": 1e-9, "minutes": 60.0, "hours": 3600.0},
    "length": {"cm": 1e-2, "mm": 1e-3, "km": 1e3, "feet": 0.3048},
    "velocity": {"cm/s": 1e-2, "mm/s": 1e-3, "km/h": 1.0 / 3.6, "knots": 1852.0 / 3600.0, "feet/s": 0.3048},
    "force": {"g": STANDARD_GRAVITY, "mg": 1e-3 * STANDARD_GRAVITY, "cm/s^2": 1e-2},
    "angle": {"degrees": DEGREE},
    "rare angle": {"0.1 degrees": 0.1 * DEGREE, "0.01 degrees": 0.01 * DEGREE, "gon": 0.9 * DEGREE},
    "rate": {"deg/s": DEGREE},
    "place": {"1e-7 deg": 1e-7, "radians": 1.0 / DEGREE},
    "pressure": {"hPa": 0.1, "Pa": 1e-3},
    "field": {"nT": 1e-5, "uT": 1e-2, "mgauss": 1e-3},
}  # fmt: skip
SECONDS = {"s": 1.0, **UNIT_FACTORS["time"]}  # units of the times of a table
# other names, as in time [msec]
ALIASES = {
    "msec": "ms", "µs": "us", "min": "minutes", "h": "hours", "ft": "feet", "kn": "knots", "ft/s": "feet/s",
    "deg": "degrees", "°": "degrees", "rad": "radians",
}  # fmt: skip


def find_units(dimension: str, ratio: float, error: float) -> dict[str, float]:
    """Return the units, with their factors, in which values are a ratio too large, to a relative error."""
    units = UNIT_FACTORS[dimension].items()
    return {name: factor for name, factor in units if abs(ratio * factor - 1.0) < error}
