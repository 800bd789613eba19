"""Check of the reference alone: positions must change as velocities say."""

from __future__ import annotations

from typing import Any

import numpy as np

from pfbench.files.table_file import Array
from pfbench.logs.doctor.axis_orders import BODY_ORDERS, name_axes
from pfbench.logs.doctor.finding import REFUSE, Finding, Picture, thin_curve
from pfbench.logs.doctor.raw_log import RawReference, dcm_of, take_rows
from pfbench.logs.doctor.thresholds import limit_of
from pfbench.logs.doctor.turn_search import integrate, select_nodes, turns_between
from pfbench.logs.units import find_units

_LONGEST = 1.8  # s of a window
_FEWEST = 5  # windows
_LEAST_MOTION = 0.3  # m per window on an axis that is judged
_SLOPES, _CORRELATION = (0.8, 1.25), 0.8
_SLOW_SLOPES, _CLEAR_CORRELATION = (0.7, 1.4), 0.95  # of an axis with less motion
_EXPLAINED = 0.3  # part of the residual that other axes may leave
_UNIT_ERROR = 0.03  # relative
_LEAST_JUMP, _LEAST_TURN = 2.0, 0.25  # m and rad of a wrong row
_RETURN = 0.5  # part of a jump that remains after the next row
_MOST_WRONG = 0.01  # share of rows: more are another fault


def drop_wrong_rows(reference: RawReference) -> RawReference:
    """Leave out single rows whose position or attitude jumps there and back, which spoil sums over all rows.

    Readers name these rows, with their limits.
    """
    time, velocity = reference.time, reference.velocity
    difference = np.diff(reference.position, axis=0) - np.diff(integrate(time, velocity), axis=0)
    turned = turns_between(dcm_of(reference.angles), np.arange(len(time)))
    wrong = np.zeros(len(time), bool)
    for change, least in ((difference, _LEAST_JUMP), (turned, _LEAST_TURN)):
        size = np.linalg.norm(change, axis=1)
        jump = np.minimum(size[1:], size[:-1])
        rest = np.linalg.norm(change[1:] + change[:-1], axis=1)
        wrong[1:-1] |= (jump > least) & (rest < _RETURN * jump)
    return take_rows(reference, ~wrong if wrong.mean() < _MOST_WRONG else slice(None))


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
    for unit, factor in find_units("velocity", 1.0 / float(np.median(slope)), _UNIT_ERROR).items():
        if (np.abs(slope / factor - 1.0) < _UNIT_ERROR).all():
            scale = {"reference": dict.fromkeys(("vn", "ve", "vd"), factor)}
            return f"velocities are in {unit}", {"scale": scale}, reference.velocity * factor
    derived = np.gradient(reference.position, reference.time, axis=0)
    return "the unit of velocity or position, or another order", {}, derived
