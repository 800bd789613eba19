"""Sufficient statistics of paths under fixed noises, for kernels that shift x_t."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import distribution_covariance, factor
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.linearisation import (
    derivative,
    mask_covariance,
    measurement_jacobian,
    transition_jacobian,
)
from pfbench.filter.moves.path_history import PathHistory
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class PathStatistics(PathHistory):
    """Gradient and curvature of a particle's log path density under fixed noises.

    If the newest state moves by delta, the log density changes by b.delta - delta' Lambda delta / 2
    to first order, exactly on linear-Gaussian models. `score` b [R, N, d] belongs to each particle,
    `information` Lambda [R, 1, d, d] to the run. With the Jacobian Phi of a step at the mean,

        Lambda <- Phi^-T Lambda Phi^-1 + J,   b_i <- Phi^-T b_i + d log p(y | x_i) / dx.

    J is the Fisher information of the measurement at the mean. Initially Lambda = P0^-1 and
    b_i = -P0^-1 xi_i. The derivative at each particle [ours] also uses variance measurements.
    """

    @override
    def merge(self, history: PathHistory) -> PathHistory:
        if isinstance(history, PathStatistics):
            return self
        raise ValueError(
            "filter.moves must not combine NoiseFlowStatKernel or NoiseFlowGibbsKernel with other "
            "kernels, got both. Remove the other kernels, because these two do not store paths."
        )

    @override
    def start(
        self, model: StateSpaceModel, belief: ParticleBelief, mean: Tensor, covariance: Tensor
    ) -> ParticleBelief:
        """Start with the information and score of the initial distribution."""
        root, ok = factor(covariance)
        if not bool((ok & (root.diagonal(dim1=-2, dim2=-1) > 0.0).all(-1)).all()):
            variance = covariance[0].diagonal().tolist()
            raise ValueError(
                "filter.moves: the initial covariance must be positive definite for kernels that use "
                f"statistics of the path, got variances {variance} of the particles. Use "
                "NoiseFlowKernel, or a larger initial standard deviation or number of particles."
            )
        information = torch.cholesky_inverse(root)
        score = -model.chart.subtract(belief.x, mean.unsqueeze(1)) @ information
        return belief._replace(window={"score": score, "information": information.unsqueeze(1)})

    @override
    def append(
        self,
        model: StateSpaceModel,
        before: ParticleBelief,
        after: ParticleBelief,
        w: Tensor | None,
        record: Record,
    ) -> ParticleBelief:
        """Propagate information and score, and add those of the measurement."""
        chart = model.chart
        start, end = (
            chart.mean(belief.x, normalise_log_weights(belief.log_w)).unsqueeze(1)
            for belief in (before, after)
        )
        inverse_step = torch.linalg.inv_ex(transition_jacobian(model, start, record.u)[:, 0])[0]
        information = inverse_step.mT @ before.window["information"][:, 0] @ inverse_step
        information = information + fisher_information(model, end, record)
        information = 0.5 * (information + information.mT)
        score = before.window["score"] @ inverse_step + _likelihood_gradient(model, after.x, record)
        return after._replace(window={"score": score, "information": information.unsqueeze(1)})


def fisher_information(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Compute the Fisher information of a measurement, by moments if not normal.

    Args:
        model: State-space model.
        x: State, [R, 1, D].
        record: Record of the step.

    Returns:
        Information matrix, [R, d, d].
    """
    observed_mask, h = ~torch.isnan(record.y), measurement_jacobian(model, x, record)[:, 0]
    distribution: Any = model.observation(x, record.u)
    covariance = mask_covariance(distribution_covariance(distribution)[:, 0], observed_mask)
    information = h.mT @ torch.linalg.solve_ex(covariance, h)[0]
    if isinstance(distribution, torch.distributions.MultivariateNormal):
        return information

    def log_sd(a: Tensor, xi: Tensor) -> Tensor:
        shifted: Any = model.observation(model.chart.add(a, xi), record.u)
        return torch.log(shifted.stddev)

    log_sd_jacobian = torch.where(
        observed_mask.unsqueeze(-1), derivative(log_sd, x, model.chart.dimension)[:, 0], 0.0
    )
    return information + 2.0 * log_sd_jacobian.mT @ log_sd_jacobian


def _likelihood_gradient(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Compute d log p(y | x) / dx along the chart for each particle [R, N, d]."""
    with torch.enable_grad():
        xi = x.new_zeros(*x.shape[:2], model.chart.dimension, requires_grad=True)
        total = model.log_likelihood(record.y, model.chart.add(x.detach(), xi), record.u).sum()
        if not total.requires_grad:
            return torch.zeros_like(xi)
        return torch.autograd.grad(total, xi, materialize_grads=True)[0]
