"""The iterated smoother: a dense solve on linear models, a grid on a bent one, a rotation on a chart."""

from typing import Any

import numpy as np
import pytest
import torch
from refusals import check_refused
from smoothing_cases import SINGULAR, Tumbler, dense, record_of
from torch import Tensor

from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.record import Record
from pfbench.filter import (
    AxisDegree3,
    CubaturePoints,
    FadingMemory,
    GaussianFilter,
    RadialDegree5,
    SigmaPointLinearisation,
    SphericalRadialPoints,
    TaylorLinearisation,
    smooth,
    smooth_iteratively,
)
from pfbench.model import LinearGaussian, StateSpaceModel, linear_walk, local_level

TAYLOR = GaussianFilter(TaylorLinearisation())
CUBATURE = GaussianFilter(SigmaPointLinearisation(CubaturePoints()))


@pytest.mark.parametrize("method", [TAYLOR, CUBATURE], ids=["taylor", "cubature"])
@pytest.mark.parametrize(
    "model",
    [
        linear_walk(0.5, 0.3, 0.7),
        SINGULAR,
        local_level(0.4, 1.0, 2.0, 3.0, observes_initial=True),
    ],
    ids=["walk", "singular", "at_rest"],
)
def test_on_linear_models_it_is_the_dense_joint_law(
    model: LinearGaussian, method: GaussianFilter
) -> None:
    record = record_of(model, 2, 9)
    result = smooth_iteratively(method, model, record, 2)
    for run in range(2):
        mean, covariance = dense(model, record.y[run].numpy())
        np.testing.assert_allclose(result.mean[run], mean, rtol=0, atol=1e-8)
        np.testing.assert_allclose(result.covariance[run], covariance, rtol=0, atol=1e-8)
    assert result.changes[:, 1].max() < 1e-8


class Cubic(StateSpaceModel):
    """A walk whose measurement bends: y = x + x^3 / 4 + v."""

    noise_dim, names, units, groups = 1, ("x",), ("1",), {"x": (0,)}
    sd: Tensor

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("sd", torch.tensor([0.6, 0.5, 1.0], dtype=torch.float64))

    def initial(self, runs: int) -> Any:
        return normal_batch(runs, self.sd[2:])

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x + self.sd[:1] * w

    def observation(self, x: Tensor, u: Any) -> Any:
        return independent_normal(x + x**3 / 4.0, self.sd[1:2])


def grid_smoother(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Means and variances [T] by forward and backward sums on a fine grid."""
    grid = np.linspace(-7.0, 7.0, 1401)
    seen = np.exp(-0.5 * ((y[:, None] - grid - grid**3 / 4.0) / 0.5) ** 2)
    step = np.exp(-0.5 * ((grid[:, None] - grid[None]) / 0.6) ** 2)
    ahead, p = [], np.exp(-0.5 * grid**2)
    for likelihood in seen:
        p = (step @ p) * likelihood
        p /= p.sum()
        ahead.append(p)
    behind, means, variances = np.ones_like(grid), [], []
    for p, likelihood in zip(ahead[::-1], seen[::-1], strict=True):
        law = p * behind
        law /= law.sum()
        means.append((law * grid).sum())
        variances.append((law * (grid - means[-1]) ** 2).sum())
        behind = step @ (likelihood * behind)
        behind /= behind.sum()
    return np.array(means[::-1]), np.array(variances[::-1])


def test_on_a_bent_model_it_is_nearer_to_a_grid_than_one_pass_is() -> None:
    y = np.array([0.3, 2.9, 4.5, 1.0, -0.8, -3.9, -6.0, -1.5, 0.4, 2.0])
    mean, variance = grid_smoother(y)
    record = Record(torch.from_numpy(y)[None, :, None])
    method = GaussianFilter(
        SigmaPointLinearisation(SphericalRadialPoints(AxisDegree3(), RadialDegree5()))
    )
    once = smooth(TAYLOR, Cubic(), record)
    results = {
        "one pass": smooth(method, Cubic(), record),
        "iterated": smooth_iteratively(method, Cubic(), record, 8),
    }
    off = {
        name: np.abs(result.mean[0, :, 0].numpy() - mean) / np.sqrt(variance)
        for name, result in (results | {"extended": once}).items()
    }
    # the result is approximate: a quarter of a posterior standard deviation, one pass is off by two of them
    iterated, others = off["iterated"].max(), (off["one pass"].max(), off["extended"].max())
    assert iterated < 0.25 < 1.0 < min(others), off
    ratio = results["iterated"].covariance[0, :, 0, 0].numpy() / variance
    assert np.abs(np.log(ratio)).max() < 0.4, ratio
    assert results["iterated"].changes[0, -1] < 1e-3


def test_on_a_curved_chart_it_is_the_flat_one_where_angles_are_small() -> None:
    size = 1e-3
    flat = LinearGaussian(
        np.eye(3), 0.5 * size * np.eye(3), np.eye(3), [size] * 3, [0.0] * 3, [size] * 3
    )
    record = record_of(flat, 2, 8)
    curved = smooth_iteratively(CUBATURE, Tumbler(size), record, 2)
    plain = smooth(TAYLOR, flat, record)
    vectors = Tumbler(size).chart.subtract(curved.mean, Tumbler(size).origin)
    torch.testing.assert_close(vectors, plain.mean, rtol=0, atol=10 * size**2)
    torch.testing.assert_close(curved.covariance, plain.covariance, rtol=2e-2, atol=1e-10)


def test_what_cannot_be_iterated_says_why() -> None:
    model = linear_walk(1.0, 0.5, 0.8)
    check_refused(
        [
            (
                "passes must be at least 1",
                lambda: smooth_iteratively(TAYLOR, model, record_of(model, 1, 4), 0),
            )
        ],
        remedy=False,
    )
    adapting = GaussianFilter(TaylorLinearisation(), noise_adaptations=[FadingMemory()])
    check_refused(
        [("adapts", lambda: smooth_iteratively(adapting, model, record_of(model, 1, 4)))],
        remedy=False,
    )
