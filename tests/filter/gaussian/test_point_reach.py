"""Sigma points far from the mean in angles are refused with a spread that would do; others are not."""

import math
import re
from dataclasses import replace
from typing import Any

import heading_cases
import numpy as np
import pytest
import torch
from config_cases import composed
from filter_cases import method_of

from pfbench import job
from pfbench.core import (
    AngleBlock,
    Chart,
    EuclideanBlock,
    LieGroupBlock,
    PhiloxStream,
    QuaternionBlock,
)
from pfbench.filter.gaussian.gaussian_filter import check_point_reach
from pfbench.filter.gaussian.linearisation_rules import (
    CubaturePoints,
    SigmaPointLinearisation,
    UnscentedPoints,
)

CHART = Chart((EuclideanBlock(6), QuaternionBlock(), EuclideanBlock(6)))


def covariance(heading_sd_deg: float, chart: Chart = CHART, place: int = 8) -> torch.Tensor:
    sd = torch.full((chart.dimension,), 0.01, dtype=torch.float64)
    sd[place] = math.radians(heading_sd_deg)
    return torch.stack([torch.diag(torch.full_like(sd, 1e-4)), torch.diag(sd**2)])


def alpha_of(message: str) -> float:
    match = re.search(r"points\.alpha=([\d.]+)\. ", message)
    assert match
    return float(match[1])


def refusal(points: Any, chart: Chart, initial: torch.Tensor) -> str:
    """Return the message of the check, empty without one."""
    try:
        check_point_reach(SigmaPointLinearisation(points), chart, initial)
    except ValueError as error:
        return str(error)
    return ""


@pytest.mark.parametrize("points", [UnscentedPoints(), CubaturePoints()])
def test_the_limit_is_two_radians(points: Any) -> None:
    """In 15 dimensions the points lie at sqrt(15) standard deviations: the limit is 29.6 degrees."""
    limit = math.degrees(2.0) / math.sqrt(15)
    assert refusal(points, CHART, covariance(limit - 0.1)) == ""
    message = refusal(points, CHART, covariance(limit + 0.1))
    assert "filter.linearisation.points must lie within 115 degrees of the mean" in message
    assert "got 115 degrees" in message
    rule = SigmaPointLinearisation(points, largest_angle=None)
    check_point_reach(rule, CHART, covariance(150.0))  # an explicit choice


RULES = [CubaturePoints(), UnscentedPoints(0.9, kappa=-5.0)]


@pytest.mark.parametrize("points", RULES)
@pytest.mark.parametrize("heading_sd_deg", [50.0, 90.0, 150.0])
def test_the_spread_of_the_message_would_do(points: Any, heading_sd_deg: float) -> None:
    initial = covariance(heading_sd_deg)
    alpha = alpha_of(refusal(points, CHART, initial))
    changed = replace(points, alpha=alpha) if hasattr(points, "alpha") else UnscentedPoints(alpha)
    assert refusal(changed, CHART, initial) == ""
    reach = float(changed(15)[0].amax()) * math.radians(heading_sd_deg)
    assert 1.0 < reach <= 2.0  # the largest of one digit


def test_points_beyond_half_a_turn_have_another_spread_and_those_within_do_not() -> None:
    """Measured through the chart, without code of the check: the spread that a rule gets back."""
    chart = Chart((AngleBlock(1),))
    zero = torch.zeros(1, dtype=torch.float64)
    for sd_deg, is_kept in ((110.0, True), (200.0, False)):
        xi, _, w = UnscentedPoints()(1)
        offsets = xi * math.radians(sd_deg)
        back = chart.subtract(chart.add(zero, offsets), zero)
        spread = math.degrees(math.sqrt(float((w * back[:, 0] ** 2).sum())))
        assert (abs(spread - sd_deg) < 1e-9) == is_kept
        initial = torch.tensor([[[math.radians(sd_deg) ** 2]]], dtype=torch.float64)
        assert (refusal(UnscentedPoints(), chart, initial) == "") == is_kept


def test_only_angles_count() -> None:
    wide = 1e12 * torch.eye(3, dtype=torch.float64)[None]
    assert refusal(CubaturePoints(), Chart((EuclideanBlock(3),)), wide) == ""
    # two angles that move together: each has its own limit
    full = np.array([[1.0, 0.99], [0.99, 1.0]]) * math.radians(150.0) ** 2
    largest = math.sqrt(2) * np.abs(np.linalg.cholesky(full)).max()
    message = refusal(CubaturePoints(), Chart((AngleBlock(2),)), torch.tensor(full)[None])
    assert f"got {math.degrees(largest):.0f} degrees" in message
    # metres and metres per second of a group are no angles
    group = torch.tensor([0.1] * 3 + [50.0] * 6, dtype=torch.float64).square().diag_embed()[None]
    chart = Chart((LieGroupBlock(10, "left"),))
    assert refusal(CubaturePoints(), chart, group) == ""
    assert "got 172 degrees" in refusal(CubaturePoints(), chart, 100.0 * group)
    # a component without uncertainty has a singular covariance
    assert "got" in refusal(CubaturePoints(), CHART, covariance(90.0) * (torch.arange(15) > 5))


@pytest.mark.parametrize("name", ["ckf", "ukf", "ekf", "imm", "ckf_pf"])
def test_filters_of_sigma_points_refuse_at_their_start(name: str) -> None:
    model = job.instantiate(composed("scenario=anshun_nl").model)
    variance = torch.full((model.chart.dimension,), 1e-6, dtype=torch.float64)
    turning = [not isinstance(block, EuclideanBlock) for block in model.chart.blocks]
    place = sum(b.dimension for b in model.chart.blocks[: turning.index(True)])
    variance[place] = math.radians(40.0) ** 2
    spread = torch.diag(variance.sqrt()).expand(2, -1, -1)
    draws = PhiloxStream(1, torch.arange(2)).at_step(0)
    if name in (
        "ekf",
        "imm",
        "ckf_pf",
    ):  # particles are drawn; their guide starts with the first step
        method_of(name).init(model, 2, draws, None, spread)
        return
    with pytest.raises(ValueError, match=r"got 165 degrees .*points\.alpha=0\.6"):
        method_of(name).init(model, 2, draws, None, spread)


def test_the_spread_decides_at_ninety_degrees() -> None:
    """Points at 2 rad settle, points at 6 rad do not: the table of docs/methods/invariant.md with few runs."""
    near, far = (
        heading_cases.measure(heading_cases.unscented_filter(alpha), 90.0, 6)
        for alpha in (0.33, 1.0)
    )
    assert near["settled"] == 6
    assert far["settled"] == 0
