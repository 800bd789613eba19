"""Warning of sigma points that pass half a turn in angles and rotations."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable

import torch
from torch import Tensor

from pfbench.core.chart import Chart, EuclideanBlock, QuaternionBlock

log = logging.getLogger("pfbench")

_SAFE_REACH = 2.0  # rad: points at 1.8 rad settle from any heading, points at 3.0 rad do not [ours]


def warn_of_point_reach(
    points: Callable[[int], tuple[Tensor, Tensor, Tensor]], chart: Chart, covariance: Tensor
) -> None:
    """Warn if a point lies half a turn or more from the mean, with a spread that avoids it.

    A point beyond half a turn has the shorter angle on the other side, so that the rule sees another
    distribution. It is not refused, since papers compare rules at such uncertainties.

    Args:
        points: Points of the rule.
        chart: Chart of the state.
        covariance: Initial covariance, [R, d, d].
    """
    reach = _largest_angle(points, chart, covariance)
    if not reach < math.pi:
        spread = getattr(points, "alpha", 1.0) * _SAFE_REACH / reach
        log.warning(
            "warning filter: filter.linearisation.points must lie within 180 degrees of the mean in "
            "angles and rotations, got %.0f degrees for the initial distribution. Use filter=ukf "
            "filter.linearisation.points.alpha=%s.",
            math.degrees(reach),
            _round_down(spread),
        )


def _largest_angle(
    points: Callable[[int], tuple[Tensor, Tensor, Tensor]], chart: Chart, covariance: Tensor
) -> float:
    """Return the largest angle of a point from the mean over all blocks and runs, rad."""
    if chart.flat:
        return 0.0
    xi = points(chart.dimension)[0].to(covariance)
    rows = xi @ torch.linalg.cholesky_ex(covariance)[0].mT
    offsets = rows.split([block.dimension for block in chart.blocks], -1)
    angles = [
        offset.norm(dim=-1) if isinstance(block, QuaternionBlock) else offset.abs()
        for offset, block in zip(offsets, chart.blocks, strict=True)
        if not isinstance(block, EuclideanBlock)
    ]
    return max(float(angle.amax()) for angle in angles)


def _round_down(value: float) -> float:
    """Round down to one significant digit."""
    digit = 10.0 ** math.floor(math.log10(value))
    return float(f"{math.floor(value / digit) * digit:.1g}")
