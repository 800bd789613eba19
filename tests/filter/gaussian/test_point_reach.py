"""Sigma points beyond half a turn are named with a spread that avoids it; others are not."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from config_cases import composed
from filter_cases import method_of

from pfbench import job
from pfbench.core.chart import AngleBlock, Chart, EuclideanBlock, QuaternionBlock
from pfbench.core.random_stream import PhiloxStream
from pfbench.filter.gaussian.linearisation_rules import CubaturePoints, UnscentedPoints
from pfbench.filter.gaussian.point_reach import warn_of_point_reach

CHART = Chart((EuclideanBlock(6), QuaternionBlock(), EuclideanBlock(6)))


def covariance(heading_sd_deg: float, chart: Chart = CHART, place: int = 8) -> torch.Tensor:
    sd = torch.full((chart.dimension,), 0.01, dtype=torch.float64)
    sd[place] = math.radians(heading_sd_deg)
    return torch.stack([torch.diag(torch.full_like(sd, 1e-4)), torch.diag(sd**2)])


def alpha_of(message: str) -> float:
    found = re.search(r"points\.alpha=([\d.]+)\.", message)
    assert found
    return float(found[1])


@pytest.fixture
def said(caplog: pytest.LogCaptureFixture) -> Callable[..., str]:
    """Return the warning of a check, empty without one."""

    def check(*arguments: Any) -> str:
        caplog.clear()
        warn_of_point_reach(*arguments)
        return caplog.text

    return check


@pytest.mark.parametrize("points", [UnscentedPoints(), CubaturePoints()])
def test_the_limit_is_half_a_turn(points: Any, said: Callable[..., str]) -> None:
    """In 15 dimensions the points lie at sqrt(15) standard deviations: the limit is 46.5 degrees."""
    limit = 180.0 / math.sqrt(15)
    assert said(points, CHART, covariance(limit - 0.1)) == ""
    message = said(points, CHART, covariance(limit + 0.1))
    assert "must lie within 180 degrees of the mean" in message
    assert "got 180 degrees" in message


@pytest.mark.parametrize("heading_sd_deg", [50.0, 90.0, 150.0])
def test_the_spread_of_the_message_would_do(
    heading_sd_deg: float, said: Callable[..., str]
) -> None:
    alpha = alpha_of(said(CubaturePoints(), CHART, covariance(heading_sd_deg)))
    assert said(UnscentedPoints(alpha), CHART, covariance(heading_sd_deg)) == ""
    reach = alpha * math.sqrt(15) * math.radians(heading_sd_deg)
    assert 1.0 < reach <= 2.0  # the largest of one digit


def test_points_beyond_the_limit_have_another_spread_and_those_within_do_not(
    said: Callable[..., str],
) -> None:
    """Measured through the chart, without code of the check: the spread that a rule gets back."""
    chart = Chart((AngleBlock(1),))
    zero = torch.zeros(1, dtype=torch.float64)
    for sd_deg, is_kept in ((120.0, True), (200.0, False)):
        xi, _, w = UnscentedPoints()(1)
        offsets = xi * math.radians(sd_deg)
        back = chart.subtract(chart.add(zero, offsets), zero)
        spread = math.degrees(math.sqrt(float((w * back[:, 0] ** 2).sum())))
        assert (abs(spread - sd_deg) < 1e-9) == is_kept
        initial = torch.tensor([[[math.radians(sd_deg) ** 2]]], dtype=torch.float64)
        assert (said(UnscentedPoints(), chart, initial) == "") == is_kept


def test_flat_states_and_correlated_angles(said: Callable[..., str]) -> None:
    flat = Chart((EuclideanBlock(3),))
    assert said(CubaturePoints(), flat, 1e12 * torch.eye(3, dtype=torch.float64)[None]) == ""
    # two angles that move together: each has its own limit
    full = np.array([[1.0, 0.99], [0.99, 1.0]]) * math.radians(150.0) ** 2
    largest = math.sqrt(2) * np.abs(np.linalg.cholesky(full)).max()
    message = said(CubaturePoints(), Chart((AngleBlock(2),)), torch.tensor(full)[None])
    assert f"got {math.degrees(largest):.0f} degrees" in message


@pytest.mark.parametrize("name", ["ckf", "ukf", "ekf"])
def test_filters_of_sigma_points_warn_at_their_start(
    name: str, caplog: pytest.LogCaptureFixture
) -> None:
    model = job.instantiate(composed("scenario=anshun_nl").model)
    variance = torch.full((model.chart.dimension,), 1e-6, dtype=torch.float64)
    turning = [not isinstance(block, EuclideanBlock) for block in model.chart.blocks]
    place = sum(b.dimension for b in model.chart.blocks[: turning.index(True)])
    variance[place] = math.radians(80.0) ** 2
    spread = torch.diag(variance.sqrt()).expand(2, -1, -1)
    draws = PhiloxStream(1, torch.arange(2)).at_step(0)
    method_of(name).init(model, 2, draws, None, spread)
    assert ("must lie within 180 degrees" in caplog.text) == (name != "ekf")
