"""The covariance at the updated mean, against samples of the exact posterior about it, and its effect in flight."""

from dataclasses import replace
from typing import Any

import heading_cases
import numpy as np
import pytest
import torch
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.core.chart import SIDES, Chart, EuclideanBlock, LieGroupBlock
from pfbench.core.density import independent_normal, normal_batch
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    InvariantFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    run_filter,
)
from pfbench.model import StateSpaceModel

EKF = GaussianFilter(TaylorLinearisation())
CKF = GaussianFilter(SigmaPointLinearisation(CubaturePoints()))
METHODS = {"EKF": EKF, "CKF": CKF, "IPLF": replace(CKF, iterations=3)}
PRIOR_SD = torch.tensor([0.3, 0.2, 0.3, 2.0, 1.0, 2.0, 3.0, 3.0, 1.0, 0.5], dtype=torch.float64)
NOISE_SD = 0.1 * PRIOR_SD
Y = torch.tensor([0.5, -0.4, 0.9, 4.0, -3.0, 2.0, 9.0, 5.0, -1.0, 1.0], dtype=torch.float64)


class FixedPose(StateSpaceModel):
    """A pose that does not move, measured once in coordinates about the start: the exact posterior is normal in them."""

    noise_dim, names, groups = 1, tuple("abcdefghij"), {"all": tuple(range(10))}
    units = ("1",) * 10
    p0: Tensor

    def __init__(self, side: str) -> None:
        super().__init__()
        self.side = side
        self.register_buffer("p0", PRIOR_SD)

    @property
    def chart(self) -> Chart:
        return Chart((LieGroupBlock(10, self.side), EuclideanBlock(1)))

    @property
    def origin(self) -> Tensor:
        return self.p0.new_tensor([1.0, *[0.0] * 10])

    def initial(self, runs: int) -> Any:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x

    def noise_gain(self, u: Any) -> Tensor:
        return self.p0.new_zeros(1, 10, 1)

    def observation(self, x: Tensor, u: Any) -> Any:
        return independent_normal(self.chart.subtract(x, self.origin), NOISE_SD)


def exact_moments(model: FixedPose, mean: Tensor, draws: int = 40_000) -> np.ndarray:
    """Return the covariance of samples of the posterior in differences from a state, by scalar Kalman updates."""
    variance = 1.0 / (PRIOR_SD**-2 + NOISE_SD**-2)
    centre = variance * Y / NOISE_SD**2
    z = torch.from_numpy(np.random.default_rng(1).normal(size=(draws, 10)))
    x = model.chart.add(model.origin, centre + variance.sqrt() * z)
    return np.cov(model.chart.subtract(x, mean).numpy().T)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("name", METHODS)
def test_after_a_large_correction_the_covariance_is_that_of_the_exact_posterior(
    name: str, side: str
) -> None:
    """Samples have an error of 1 %; corrections of 1.1 rad and posterior errors of 0.03 rad leave 3 % of second order."""
    model, record = FixedPose(side), Record(Y[None, None])
    gaps = {}
    for reset in (True, False):
        method = replace(METHODS[name], reset_covariance=reset)
        with torch.no_grad():
            draws = PhiloxStream(1, torch.arange(1))
            belief = method.init(model, 1, draws)
            belief, _ = method.step(model, belief, record.at_step(0), draws)
        exact = exact_moments(model, belief.mean[0])
        scale = np.sqrt(np.diag(exact))
        gaps[reset] = float(
            np.abs((belief.covariance[0].numpy() - exact) / np.outer(scale, scale)).max()
        )
    assert gaps[True] < 0.06
    assert gaps[False] > 0.3


def test_with_a_reset_the_side_of_the_chart_does_not_matter_to_the_ekf() -> None:
    """Left and right differences of one state differ by a matrix, and the reset carries it to the new mean."""
    model, record, _ = heading_cases.draw(90.0, 4, 8.0, seed=3)
    gaps = {}
    for reset in (True, False):
        method = replace(EKF, reset_covariance=reset)
        with torch.no_grad():
            left, right = (
                run_filter(
                    InvariantFilter(method, side), model, record, PhiloxStream(1, torch.arange(4))
                )
                for side in SIDES
            )
        gaps[reset] = float(((left.mean - right.mean)[..., 4:10]).abs().max())
    assert gaps[True] < 1e-3 < 0.1 < gaps[False], gaps
