"""Unit of the specific force: by its size, and with a reference by the change of velocity that it explains."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np

from pfbench.files.table_file import Array
from pfbench.logs.doctor.axis_orders import BODY_ORDERS
from pfbench.logs.doctor.finding import REFUSE, Finding, Picture, thin_curve
from pfbench.logs.doctor.force_windows import ForceWindows, fit_force
from pfbench.logs.doctor.raw_log import RawLog
from pfbench.logs.doctor.thresholds import LEAST_ACCELERATION, limit_of
from pfbench.logs.units import STANDARD_GRAVITY, find_units

_UNIT_ERROR, _LEFT = (
    0.25,
    0.25,
)  # relative, and part of the squared force that a true unit may leave
_MISSING = (
    "gravity is missing, as in a linear acceleration",
    "Record the specific force, or {unit}add 9.80665 sin(pitch) to fx, and subtract 9.80665 cos(pitch) sin(roll) "
    "from fy and 9.80665 cos(pitch) cos(roll) from fz",
)


def check_force_unit(
    log: RawLog, windows: ForceWindows | None, facts: dict[str, Any]
) -> tuple[RawLog, list[Finding]]:
    """Check the unit of the force by its median norm, and name one that agrees with the windows of a reference.

    Returns the log with a force, or a gravity, that agrees, and findings.
    """
    size = np.linalg.norm(log.imu.force, axis=1)
    norm, largest, gravity = float(np.median(size)), limit_of("unit of force"), log.gravity
    facts["median force [m/s^2]"] = round(norm, 4)
    is_usual = gravity / largest < norm < gravity * largest
    if norm == 0.0 or (is_usual and (windows is None or not _may_lack_gravity(windows))):
        return log, []
    near = {f: f"in {u}" for u, f in find_units("force", norm / gravity, _UNIT_ERROR).items()}
    units = {1.0: ""} if is_usual else near or {gravity / norm: "in another unit"}
    factor = next(iter(units))
    if windows is not None:
        factor, gravity = _select_unit(windows, units, gravity)
        if is_usual and (gravity or not factor):
            return log, []
    text = f"they are {units.get(factor, '')}"
    remedy = f"Multiply by {factor:.7g}, or set scenario.corrections.scale"
    if not factor:
        text = "no other unit, sign or axes of fx, fy, fz agree with the reference"
        remedy = "Check this table"
    elif not gravity:
        text = _MISSING[0]
        remedy = _MISSING[1].format(unit="" if factor == 1.0 else f"multiply by {factor:g}, and ")
    is_unit = factor and gravity
    finding = Finding(
        "unit of force", REFUSE, norm / log.gravity, largest, "times gravity",
        f"{log.names[0]}: fx, fy, fz have a median norm of {norm:.3g}, not about 9.8 m/s^2: {text}", remedy,
        {"corrections": {"scale": {"imu": dict.fromkeys(("fx", "fy", "fz"), factor)}}} if is_unit else {},
        ("another unit", "a linear acceleration without gravity") if windows is None else (),
        Picture("t [s]", "norm of fx, fy, fz", (thin_curve(log.names[0], log.imu.time, size),)),
    )  # fmt: skip
    mended = log.imu._replace(force=log.imu.force * (factor or 1.0))
    return log._replace(imu=mended, gravity=gravity), [finding]


def _select_unit(
    windows: ForceWindows, units: Iterable[float], gravity: float
) -> tuple[float, float]:
    """Return factor and gravity with which the force explains the motion best; a factor of 0 if none does."""
    pairs = (*((factor, gravity) for factor in units), (1.0, 0.0), (STANDARD_GRAVITY, 0.0))
    costs = {pair: min(_find_cost(windows, *pair, axes) for axes in BODY_ORDERS) for pair in pairs}
    best = min(costs, key=lambda pair: costs[pair])
    needed = float(np.square(windows.change - [0.0, 0.0, best[1]]).sum(1).mean())
    is_explained = costs[best] < _LEFT * (needed + LEAST_ACCELERATION**2)
    return best if is_explained else (0.0, gravity)


def _may_lack_gravity(windows: ForceWindows) -> bool:
    """Return whether the recorded axes explain the motion better without gravity."""
    with_gravity, without = (_find_cost(windows, 1.0, g) for g in (windows.gravity, 0.0))
    return without < with_gravity


def _find_cost(
    windows: ForceWindows, factor: float, gravity: float, axes: Array | None = None
) -> float:
    """Return what the force leaves of the acceleration, (m/s^2)^2, with another unit, gravity and axes."""
    return fit_force(
        windows._replace(products=factor * windows.products, gravity=gravity), axes
    ).cost
