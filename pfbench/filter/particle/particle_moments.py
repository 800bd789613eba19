"""Moments and diagnostics of weighted particles, for the information of a step."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import torch
from torch import Tensor

from pfbench.core.density import has_finite_moments
from pfbench.core.linear_algebra import shared_distribution_covariance, squared_length
from pfbench.core.record import Record
from pfbench.filter.belief import (
    ParticleBelief,
    StepInfo,
    exponentiate,
    has_long_rows,
    normalise_log_weights,
)
from pfbench.filter.gaussian.linearisation_rules import around_first
from pfbench.filter.linearisation import mask_covariance
from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable
from pfbench.model.base import StateSpaceModel

T = TypeVar("T")


def compute_once(function: Callable[[], T]) -> Callable[[], T]:
    """Make a function that computes its value at the first call only.

    One is made at each step, and `functools.cache` takes 5 microseconds to make.
    """
    values: list[T] = []

    def call() -> T:
        if not values:
            values.append(function())
        return values[0]

    return call


class StepSummary(NamedTuple):
    """Moments and diagnostics of one filter step.

    Attributes:
        mean: Mean of the particles, [R, D].
        variance: Variance in the chart, [R, d].
        predicted_log_w: Log weights before the measurement update, [R, N], not normalised.
        trace: Numbers per run, {name: [R]}.
    """

    mean: Tensor
    variance: Tensor
    predicted_log_w: Tensor
    trace: dict[str, Tensor]


def summarise(model: StateSpaceModel, belief: ParticleBelief, trace: dict[str, Tensor]) -> StepInfo:
    """Return mean and variance of particles for a report, without a copy of them.

    Shapes: trace [R].
    """
    return make_step_info(
        model,
        belief,
        *weighted_mean_variance(model, belief, normalise_log_weights(belief.log_w)),
        trace,
    )


def weighted_mean_variance(
    model: StateSpaceModel, belief: ParticleBelief, w: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the mean [R, D] and, in the chart about it, the variance [R, d].

    Shapes: w [R, N].
    """
    if model.chart.flat:
        mean, variance = _flat_moments(belief.x, w)
        return mean, variance
    mean = model.chart.mean(belief.x, w)
    return mean, (
        w.unsqueeze(-2) @ model.chart.subtract(belief.x, mean.unsqueeze(1)).square()
    ).squeeze(-2)


def make_step_info(
    model: StateSpaceModel,
    belief: ParticleBelief,
    mean: Tensor,
    variance: Tensor,
    trace: dict[str, Tensor],
    nis: Callable[[], tuple[Tensor, Tensor]] | None = None,
) -> StepInfo:
    """Make the information of a step from particles, their mean and their variance.

    Shapes: mean [R, D], variance [R, d], trace [R], nis [R].
    """

    def deviations() -> tuple[Tensor, Tensor]:
        return model.chart.subtract(belief.x, mean.unsqueeze(1)), belief.log_w

    def covariance() -> Tensor:
        d, log_w = deviations()
        return (normalise_log_weights(log_w).unsqueeze(-1) * d).mT @ d

    @compute_once
    def w() -> Tensor:  # once for all groups; the weights are normalised already
        return exponentiate(belief.log_w, belief.weights)

    def group_covariance(groups: Tensor) -> Tensor:
        if model.chart.flat:
            return _spread(belief.x, mean, w(), groups)
        return _spread(deviations()[0], torch.zeros_like(variance), w(), groups)

    return StepInfo(mean, variance, covariance, trace, deviations, nis, group_covariance)


def compute_nis(
    model: StateSpaceModel, x: Tensor, log_w: Tensor, record: Record
) -> tuple[Tensor, Tensor]:
    """Compute the normalised innovation squared (NIS) of predicted particles.

    Returns NIS [R] and the number of observed components [R], which is its expectation. The NIS is
    NaN where the mean or variance of the observation distribution is infinite. Shapes: x [R, N, D],
    log_w [R, N].
    """
    predicted_y: Any = model.observation(x, record.u)
    observed_mask = ~torch.isnan(record.y)
    if not has_finite_moments(predicted_y):
        return torch.full_like(log_w[:, 0], torch.nan), observed_mask.sum(1)
    y, covariance = predicted_y.mean, shared_distribution_covariance(predicted_y)
    if y.shape[1] == 1:  # no spread
        y_hat = y[:, 0] + model.residual(y[:, 0], y[:, 0])  # infinite becomes NaN
        covariance = covariance[:, 0]
    else:
        w = normalise_log_weights(log_w)
        y_hat, spread, noise = predict_moments(model, y, covariance, w)
        covariance = spread + noise
    r = torch.where(observed_mask, model.residual(record.y.nan_to_num(), y_hat), 0.0)
    return squared_length(r, mask_covariance(covariance, observed_mask)), observed_mask.sum(1)


def predict_moments(
    model: StateSpaceModel, y: Tensor, covariance: Tensor, w: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the moments of a measurement predicted by weighted particles.

    Returns mean [R, k], covariance due to the particles [R, k, k], and mean noise covariance
    [R or 1, k, k]. Shapes: y [R, N, k], covariance [R, N or 1, k, k], w [R, N].
    """
    y_hat = around_first(model.residual)(y, w)
    deviations = torch.where(w.unsqueeze(-1) > 0.0, model.residual(y, y_hat.unsqueeze(1)), 0.0)
    noise = (
        (w[..., None, None] * covariance).sum(1) if covariance.shape[1] > 1 else covariance[:, 0]
    )
    all_components = torch.arange(y.shape[-1], device=y.device).unsqueeze(0)
    spread = _spread(deviations, torch.zeros_like(y_hat), w, all_components).squeeze(1)
    return y_hat, spread, noise


def _count_distinct(copy_of: Tensor, log_w: Tensor) -> Tensor:
    """Count distinct values below 2 N in copy_of [R, N] at active slots, [R]."""
    marks = torch.zeros(len(copy_of), 2 * copy_of.shape[1], dtype=log_w.dtype, device=log_w.device)
    return (marks.scatter_add_(1, copy_of, (log_w > -torch.inf).to(log_w.dtype)) > 0.0).sum(1)


count_distinct_ancestors = compilable(_count_distinct, operator=dispatch.count_unique)


def _separate_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Return weighted mean and variance [R, D], by matrix products."""
    mean = w.unsqueeze(-2) @ x
    d = x - mean
    return mean.squeeze(-2), (w.unsqueeze(-2) @ (d * d)).squeeze(-2)


def _fused_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Return weighted mean and variance [R, D] of numbers [R, N, D] by weights [R, N]."""
    components = x.permute(2, 0, 1)
    mean = (w * components).sum(-1)
    d = components - mean.unsqueeze(-1)
    return mean.T, (w * d * d).sum(-1).T


def _separate_spread(x: Tensor, mean: Tensor, w: Tensor, groups: Tensor) -> Tensor:
    """Return covariances [R, G, s, s] of groups [G, s] of numbers [R, N, k]."""
    deviations = x.permute(0, 2, 1)[:, groups] - mean[:, groups].unsqueeze(-1)  # [R, G, s, N]
    return (w[:, None, None] * deviations) @ deviations.mT


_spread = compilable(_separate_spread, operator=dispatch.group_covariance, keep_in_graph=False)
_flat_moments = compilable(
    _fused_moments,
    eager=_separate_moments,
    operator=dispatch.weighted_moments,
    keep_in_graph=has_long_rows,
)
