"""Robust updates as weight updates of particle filters.

Huber's, Student's and the correntropy loss replace the log likelihood of each particle. The gate
and the weighted likelihood judge the innovation of the predicted particles of a run, and raise the
likelihood of each component to a power: 0 for a rejected one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal
from typing_extensions import override

from pfbench.core.linear_algebra import factor, shared_distribution_covariance
from pfbench.core.parameter_checks import require
from pfbench.core.record import Record
from pfbench.filter.belief import normalise_log_weights
from pfbench.filter.gaussian.innovation import Innovation, diagonal_axes
from pfbench.filter.linearisation import mask_covariance, predict_moments
from pfbench.filter.particle.stages import WEIGHT_UPDATE_MEMORY, MemoryWeightUpdate, UpdatedWeights
from pfbench.filter.robust.robust_update import (
    DOWNWEIGHTED,
    GroupDistances,
    InnovationWeight,
    ResidualLoss,
)
from pfbench.filter.whitening import LOG_2PI
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class RobustWeightUpdate(MemoryWeightUpdate):
    """Weights of particles by a robust update, whose settings are those of a Gaussian filter.

    The measurement errors of the model must be normal, since their covariance R is the unit of
    distances. Correlations of R between groups are ignored [ours]. `iterations` of the update is
    of Gaussian filters alone: a particle has one residual.

    Attributes:
        update: Robust update: gate, Huber, Student, correntropy or weighted likelihood.

    Raises:
        ValueError: If the update is none of these, or weighs a prior, which particles do not have.
            On use, if the measurement errors are not normal.
    """

    update: ResidualLoss | InnovationWeight
    is_exact = False  # the model has other errors

    def __post_init__(self) -> None:
        name = type(self.update).__name__
        require(
            isinstance(self.update, (ResidualLoss, InnovationWeight)),
            "weight_update.update",
            "be a robust update",
            name,
            "Choose InnovationGate, HuberUpdate, StudentUpdate, CorrentropyUpdate or WeightedLikelihoodUpdate.",
        )
        require(
            not getattr(self.update, "weight_prior", False),
            "weight_update.update.weight_prior",
            "be false for particles",
            f"{name} with true",
            "Set it to false.",
        )

    @property
    def has_evidence(self) -> bool:
        """True if the weights are densities of y given x, those of Huber's or Student's errors."""
        return getattr(self.update, "is_density", False)

    @override
    def update_weights(
        self,
        model: StateSpaceModel,
        log_w: Tensor,
        x: Tensor,
        log_ratio: Tensor,
        record: Record,
        memory: dict[str, Tensor],
    ) -> UpdatedWeights:
        predicted_y: Any = model.observation(x, record.u)
        _check_normal(model, predicted_y)
        prior_log_w = log_w + log_ratio
        innovation = _predicted_innovation(model, predicted_y, prior_log_w, record)
        white, log_scale = _whitened_residuals(model, predicted_y, innovation, record, self.update)
        if isinstance(self.update, ResidualLoss):
            groups = self.update.component_grouping.apply(innovation, innovation.noise)
            log_likelihood, weight = _weigh_by_loss(self.update, groups, white, prior_log_w)
            log_w = prior_log_w + log_likelihood - log_scale.sum(-1)
            counts = {"downweighted": groups.count_groups(weight < DOWNWEIGHTED)}
        else:
            before = {
                k.removeprefix(WEIGHT_UPDATE_MEMORY): v[:, 0]
                for k, v in memory.items()
                if k.startswith(WEIGHT_UPDATE_MEMORY)
            }
            power, groups, counts = self.update.innovation_weight(innovation, before)
            log_normal = -0.5 * white.square() - log_scale - 0.5 * LOG_2PI
            log_w = prior_log_w + ((power * groups.observed).unsqueeze(1) * log_normal).sum(-1)
        carried = {
            WEIGHT_UPDATE_MEMORY + k: v.unsqueeze(1) for k, v in counts.items() if v.dim() > 1
        }
        trace = {k: v for k, v in counts.items() if v.dim() == 1}
        return UpdatedWeights(torch.where(log_w == log_w, log_w, -torch.inf), carried, trace)


def _check_normal(model: StateSpaceModel, predicted_y: Any) -> None:
    """Raise an error if measurement errors are not normal."""
    inner = getattr(predicted_y, "base_dist", predicted_y)
    is_normal = isinstance(predicted_y, MultivariateNormal) or (
        isinstance(predicted_y, Independent) and isinstance(inner, Normal)
    )
    require(
        is_normal,
        f"{type(model).__name__}.observation",
        "be normal for a robust weight update",
        type(inner).__name__,
        "Use filter.weight_update of filter=sir: the model has a distribution of its own.",
    )


def _predicted_innovation(
    model: StateSpaceModel, predicted_y: Any, log_w: Tensor, record: Record
) -> Innovation:
    """Return the innovation of the predicted particles; its covariance is all in Omega."""
    covariance = shared_distribution_covariance(predicted_y)
    w = normalise_log_weights(log_w)
    y_hat, spread, noise = predict_moments(model, predicted_y.mean, covariance, w)
    noise, observed_mask = noise.expand_as(spread), ~torch.isnan(record.y)
    r = torch.where(observed_mask, model.residual(record.y.nan_to_num(), y_hat), 0.0)
    total, observed_noise = (mask_covariance(a, observed_mask) for a in (spread + noise, noise))
    return Innovation(
        r, observed_mask, torch.zeros_like(r).unsqueeze(-1), total, observed_noise, noise
    )


def _whitened_residuals(
    model: StateSpaceModel,
    predicted_y: Any,
    innovation: Innovation,
    record: Record,
    update: ResidualLoss | InnovationWeight,
) -> tuple[Tensor, Tensor]:
    """Return residuals in units of R [R, N, k], and log of the units [R, N or 1, k]; 0 if missing."""
    observed_mask = innovation.observed_mask.unsqueeze(1)
    residual = model.residual(record.y.nan_to_num().unsqueeze(1), predicted_y.mean)
    residual = torch.where(observed_mask, residual, 0.0)
    if isinstance(predicted_y, Independent):
        sd = torch.where(observed_mask, predicted_y.base_dist.scale, 1.0)
        return residual / sd, sd.log()
    groups = update.component_grouping.apply(innovation, innovation.noise)
    covariance = shared_distribution_covariance(predicted_y)
    eye = torch.eye(residual.shape[-1], dtype=residual.dtype, device=residual.device)
    root = factor(torch.where(groups.joint_mask.unsqueeze(1), covariance, eye))[0]
    if root.shape[1] == 1:
        white = torch.linalg.solve_triangular(root[:, 0], residual.mT, upper=False).mT
    else:
        white = torch.linalg.solve_triangular(root, residual.unsqueeze(-1), upper=False).squeeze(-1)
    return white, diagonal_axes(root).log()


def _weigh_by_loss(
    update: ResidualLoss, groups: GroupDistances, white: Tensor, prior_log_w: Tensor
) -> tuple[Tensor, Tensor]:
    """Return log densities [R, N] and posterior means of the weights of components [R, k]."""
    observed = groups.observed.unsqueeze(1)
    squared = (white.square() * observed) @ groups.group_mask.mT
    size = groups.size.unsqueeze(1)
    density = update.log_density(squared, size)
    log_likelihood = (density * observed / size.clamp(min=1.0)).sum(-1)
    w = normalise_log_weights(prior_log_w + log_likelihood).unsqueeze(-1)
    return log_likelihood, (w * update.residual_weight(squared, size)).sum(1)
