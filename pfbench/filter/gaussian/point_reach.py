"""Check of sigma points whose angles are so large that a rule sees another distribution."""

from __future__ import annotations

import math

from torch import Tensor

from pfbench.core.chart import Chart
from pfbench.core.covariance import factor
from pfbench.filter.gaussian.linearisation_rules import (
    LinearisationRule,
    SigmaPointLinearisation,
    SigmaPoints,
    UnscentedPoints,
)


def check_point_reach(rule: LinearisationRule, chart: Chart, covariance: Tensor) -> None:
    """Check the largest angle between the mean and a point of the initial distribution.

    A point beyond half a turn has the shorter angle on the other side. Closer points fail too, because
    the first measurements move the mean: benchmarks/point_reach.md.

    Args:
        rule: Linearisation rule. One without points is valid.
        chart: Chart of the state.
        covariance: Initial covariance, [R, d, d].

    Raises:
        ValueError: If the angle of a point exceeds `rule.largest_angle`.
    """
    if not isinstance(rule, SigmaPointLinearisation) or rule.largest_angle is None or chart.flat:
        return
    limit = rule.largest_angle
    reach = _largest_angle(rule.points, chart, covariance)
    if reach > limit:
        unscented = rule.points if isinstance(rule.points, UnscentedPoints) else UnscentedPoints()
        spread = unscented.alpha * limit / _largest_angle(unscented, chart, covariance)
        raise ValueError(
            f"filter.linearisation.points must lie within {math.degrees(limit):.0f} degrees of the "
            f"mean in angles and rotations, got {math.degrees(reach):.0f} degrees for the initial "
            f"distribution. Use filter=ukf filter.linearisation.points.alpha={_round_down(spread)}. "
            "To compare rules at this uncertainty, add +filter.linearisation.largest_angle=null."
        )


def _largest_angle(points: SigmaPoints, chart: Chart, covariance: Tensor) -> float:
    """Return the largest angle of a point from the mean over all blocks and runs, rad."""
    xi = points(chart.dimension)[0].to(covariance)
    angles = chart.rotation_angles(xi @ factor(covariance)[0].mT)
    return float(angles.nan_to_num().amax()) if angles.numel() else 0.0


def _round_down(value: float) -> float:
    """Round down to one significant digit."""
    digit = 10.0 ** math.floor(math.log10(value))
    return float(f"{math.floor(value / digit) * digit:.1g}")
