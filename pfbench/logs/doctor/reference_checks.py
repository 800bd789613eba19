"""Check of the reference alone: positions must change as velocities say."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pfbench.files.table_file import Array
from pfbench.logs.doctor.axis_orders import BODY_ORDERS, name_axes
from pfbench.logs.doctor.finding import REFUSE, WARN, Finding, Picture, thin_curve
from pfbench.logs.doctor.raw_log import RawReference, dcm_of, take_rows
from pfbench.logs.doctor.thresholds import limit_of
from pfbench.logs.doctor.turn_search import integrate, select_nodes, turns_between
from pfbench.logs.units import find_units

_LONGEST, _FEWEST, _LEAST_MOTION = (
    1.8,
    5,
    0.3,
)  # s of a window, windows, and m in one on an axis that is judged
_SLOPES, _CORRELATION = (0.8, 1.25), 0.8
_SLOW_SLOPES, _CLEAR_CORRELATION = (0.7, 1.4), 0.95  # of an axis with less motion
_EXPLAINED, _UNIT_ERROR = (
    0.3,
    0.03,
)  # part of the residual that other axes may leave, and relative error of a unit
_LEAST_JUMP, _LEAST_TURN, _LEAST_KICK, _IMPOSSIBLE = (
    2.0,
    0.25,
    3.0,
    1.5,
)  # m, rad and m/s of a wrong row, rad of an impossible one
_ALONE, _USUAL = 4.0, 98.0  # times the jump that so many percent of the rows do not reach
# part of a jump that remains after the next row, share of rows (more are another fault), and rows that show a jump
_RETURN, _MOST_WRONG, _FEWEST_ROWS = 0.5, 0.01, 3


def check_rows(
    name: str, reference: RawReference, describe_row: Callable[[int], str]
) -> tuple[RawReference, list[Finding]]:
    """Name single rows whose attitude or velocity jumps there and back, and leave them out, since they spoil sums.

    Rows whose position jumps are left out, too; readers name them, with their limits.
    """
    time, velocity = reference.time, reference.velocity
    if len(time) < _FEWEST_ROWS:
        return reference, []
    difference = np.diff(reference.position, axis=0) - np.diff(integrate(time, velocity), axis=0)
    turned = turns_between(dcm_of(reference.angles), np.arange(len(time)))
    changes = {
        ("position", "m"): (difference, _LEAST_JUMP),
        ("attitude", "rad"): (turned, _LEAST_TURN),
        ("velocity", "m/s"): (np.diff(velocity, axis=0), _LEAST_KICK),
    }
    wrong, findings = np.zeros(len(time), bool), []
    for (quantity, unit), (change, least) in changes.items():
        size = np.linalg.norm(change, axis=1)
        jump = np.minimum(size[1:], size[:-1])
        rest = np.linalg.norm(change[1:] + change[:-1], axis=1)
        least = max(least, _ALONE * float(np.percentile(jump, _USUAL)))  # also in another unit
        jump[(jump <= least) | (rest >= _RETURN * jump)] = 0.0
        wrong[1:-1] |= jump > 0.0
        largest, row = float(jump.max()), describe_row(int(reference.rows[jump.argmax() + 1]))
        if largest and unit != "m":
            findings.append(Finding(
                "reference rows", REFUSE if unit == "rad" and largest > _IMPOSSIBLE else WARN, largest, 0.0, unit,
                f"{name}: the {quantity} jumps by {largest:.3g} {unit} there and back in {row}",
                "Correct or remove this row",
            ))  # fmt: skip
    if wrong.sum() > max(1.0, _MOST_WRONG * len(time)):
        return reference, []
    return take_rows(reference, ~wrong), findings


def check_reference(
    name: str, reference: RawReference, facts: dict[str, Any]
) -> tuple[RawReference, list[Finding]]:
    """Check velocities against positions.

    Returns the reference with velocities that agree, and findings.
    """
    time, nodes = reference.time, select_nodes(reference.time, 1.0)
    good = np.diff(time[nodes]) < _LONGEST
    expected = np.diff(integrate(time, reference.velocity)[nodes], axis=0)[good]
    change = np.diff(reference.position[nodes], axis=0)[good]
    if len(expected) < _FEWEST:
        return reference, []
    moves = np.sqrt(np.square(expected).mean(0)) > _LEAST_MOTION
    square, both = np.square(expected).sum(0), (expected * change).sum(0)
    slope = both / np.maximum(square, 1e-9)
    correlation = both / np.maximum(np.sqrt(square * np.square(change).sum(0)), 1e-9)
    facts["slope of position and velocity"] = slope[moves].round(3).tolist()
    bad = moves & ((slope < _SLOPES[0]) | (slope > _SLOPES[1]) | (correlation < _CORRELATION))
    # noise of a slow axis reduces the slope, and the correlation with it
    is_clear = ~moves & (np.abs(correlation) > _CLEAR_CORRELATION)
    bad |= is_clear & ((slope < _SLOW_SLOPES[0]) | (slope > _SLOW_SLOPES[1]))
    if not bad.any():
        return reference, []
    text, corrections, velocity = _explain(reference, expected, change, slope[moves | bad])
    axis = int(np.argmax(np.where(bad, np.sqrt(square), -1.0)))
    seconds = time[nodes][:-1][good]
    finding = Finding(
        "reference velocity", REFUSE, float(np.abs(slope[bad] - 1.0).max()), limit_of("reference velocity"), "1",
        f"{name}: positions do not change as velocities say, by factors of {slope.round(3).tolist()} "
        f"North, East, Down: {text}",
        "Correct the columns" + (f", or set scenario.corrections: {corrections}" if corrections else ""),
        {"corrections": corrections} if corrections else {},
        picture=Picture("t [s]", f"motion {('North', 'East', 'Down')[axis]} per second [m]", (
            thin_curve("position", seconds, change[:, axis]), thin_curve("velocity", seconds, expected[:, axis]),
        )),
    )  # fmt: skip
    return reference._replace(velocity=velocity), [finding]


def _explain(
    reference: RawReference, expected: Array, change: Array, slope: Array
) -> tuple[str, dict[str, Any], Array]:
    """Return what is wrong, the settings that mend it, and the mended velocities."""
    costs = [float(np.square(change - expected @ m.T).sum()) for m in BODY_ORDERS]
    best = BODY_ORDERS[int(np.argmin(costs))]
    if min(costs) < _EXPLAINED * costs[0] and not np.array_equal(best, np.eye(3)):
        names = name_axes(best, is_level=True)
        text = f"the velocities North, East, Down are the columns {', '.join(names)}"
        corrections = {"level_axes": {"reference_velocity": names}}
        return text, corrections, reference.velocity @ best.T
    for unit, factor in find_units(
        "velocity", 1.0 / (float(np.median(slope)) or np.inf), _UNIT_ERROR
    ).items():
        if (np.abs(slope / factor - 1.0) < _UNIT_ERROR).all():
            scale = {"reference": dict.fromkeys(("vn", "ve", "vd"), factor)}
            return f"velocities are in {unit}", {"scale": scale}, reference.velocity * factor
    derived = np.gradient(reference.position, reference.time, axis=0)
    return "the unit of velocity or position, or another order", {}, derived
