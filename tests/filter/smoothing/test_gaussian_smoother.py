"""Smoothing of Gaussian filters against one dense solve of the joint normal law."""

import itertools
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from smoothing_cases import SINGULAR, Tumbler, dense, record_of
from torch import Tensor

from pfbench.core.record import Record
from pfbench.filter import (
    CubaturePoints,
    FadingMemory,
    GaussianFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    UnscentedPoints,
    smooth,
)
from pfbench.model import LinearGaussian, ModelWrapper, StateSpaceModel, linear_walk, local_level

RULES = {
    "jacobian": TaylorLinearisation(),
    "unscented": SigmaPointLinearisation(UnscentedPoints()),
    "cubature": SigmaPointLinearisation(CubaturePoints()),
}


class Driven(ModelWrapper):
    """The same linear model, which does not tell how its noise enters: it then goes through the filter's rule."""

    linear = True

    @property
    def observes_initial(self) -> bool:
        return self.model.observes_initial


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize(
    "model",
    [
        linear_walk(0.5, 0.3, 0.7),
        SINGULAR,
        local_level(0.4, 1.0, 2.0, 3.0, observes_initial=True),
        Driven(SINGULAR),
    ],
    ids=["walk", "singular", "at_rest", "driven"],
)
def test_smoothed_laws_are_those_of_the_dense_joint_law(model: StateSpaceModel, rule: str) -> None:
    plain: Any = model.model if isinstance(model, Driven) else model
    record = record_of(plain, 3, 9)
    found = smooth(GaussianFilter(RULES[rule]), model, record)
    for run in range(3):
        mean, covariance = dense(plain, record.y[run].numpy())
        np.testing.assert_allclose(found.mean[run], mean, rtol=0, atol=1e-9)
        np.testing.assert_allclose(found.covariance[run], covariance, rtol=0, atol=1e-9)


def test_states_with_a_lag_are_those_of_the_dense_law_of_so_many_measurements() -> None:
    record = record_of(SINGULAR, 3, 9)
    for lag in (0, 2, 20):
        found = smooth(GaussianFilter(TaylorLinearisation()), SINGULAR, record, lag=lag)
        for run, t in itertools.product(range(3), range(9)):
            mean, covariance = dense(SINGULAR, record.y[run, : t + lag + 1].numpy())
            np.testing.assert_allclose(found.mean[run, t], mean[t], rtol=0, atol=1e-9)
            np.testing.assert_allclose(found.covariance[run, t], covariance[t], rtol=0, atol=1e-9)


class Push(NamedTuple):
    """What is added to the position in each step [1, T]."""

    by: Tensor


class Pushed(Driven):
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.model.propagate(x, u, w) + torch.nn.functional.pad(u.by[:, None, None], (0, 1))


def test_each_step_goes_back_by_its_own_inputs() -> None:
    """Known pushes move a linear model's path by what they alone would do, and nothing else."""
    by, model = (
        torch.tensor([[3.0, -1.0, 0.5, 4.0, -2.0, 1.0, 0.0, 7.0, 5.0]], dtype=torch.float64),
        linear_walk(0.5, 0.3, 0.7),
    )
    record, way = record_of(model, 2, 9), by.cumsum(1)
    pushed = smooth(
        GaussianFilter(TaylorLinearisation()),
        Pushed(model),
        Record(record.y + way[..., None], Push(by)),
    )
    plain = smooth(GaussianFilter(TaylorLinearisation()), model, record)
    torch.testing.assert_close(pushed.mean[..., 0] - way, plain.mean[..., 0])
    torch.testing.assert_close(pushed.mean[..., 1], plain.mean[..., 1])


def test_the_last_state_is_the_filter_s_and_no_other_is() -> None:
    model = linear_walk(0.5, 0.3, 0.7)
    found = smooth(GaussianFilter(TaylorLinearisation()), model, record_of(model, 2, 9))
    variance = found.covariance.diagonal(dim1=-2, dim2=-1)
    torch.testing.assert_close(found.mean[:, -1], found.filtered.mean[:, -1])
    assert bool(
        (variance[1, :-1] < found.filtered.variance[1, :-1]).all()
    )  # of run 0 nothing was seen last


def test_on_a_curved_chart_it_is_the_flat_one_where_angles_are_small() -> None:
    size = 1e-3
    flat = LinearGaussian(
        np.eye(3), 0.5 * size * np.eye(3), np.eye(3), [size] * 3, [0.0] * 3, [size] * 3
    )
    record = record_of(flat, 2, 8)
    curved, plain = (
        smooth(GaussianFilter(TaylorLinearisation()), model, record)
        for model in (Tumbler(size), flat)
    )
    vectors = Tumbler(size).chart.subtract(curved.mean, Tumbler(size).origin)
    assert plain.mean.abs().max() > size  # angles of the second order are a thousand times smaller
    torch.testing.assert_close(vectors, plain.mean, rtol=0, atol=10 * size**2)
    torch.testing.assert_close(curved.covariance, plain.covariance, rtol=2e-2, atol=1e-10)


def test_what_has_no_smoothed_law_says_why() -> None:
    model = linear_walk(1.0, 0.5, 0.8)
    adapting = GaussianFilter(TaylorLinearisation(), noise_adaptations=[FadingMemory()])
    with pytest.raises(ValueError, match="adapts"):
        smooth(adapting, model, record_of(model, 1, 4))
