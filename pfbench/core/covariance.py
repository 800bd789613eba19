"""Batched square roots and densities of covariances, with a mask instead of exceptions."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal

from pfbench.kernels import cpp
from pfbench.kernels.compilation import compilable, is_capturing

_LOG_2PI = math.log(2.0 * math.pi)


def _factor(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Return the lower triangular A with A A' = covariance [..., d, d], and a mask of success [...].

    The correlation matrix is factorised, so that units of different scale do not matter. If rounding
    made it slightly indefinite, a relative 1e-12 (1e-6 in float32) is added to the diagonal. If that
    is not enough, the mask is False. A component of zero variance has a zero row in the root.
    """
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    sd = torch.sqrt(torch.where(variance > 0, variance, 1.0))
    correlation = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    lower, info = torch.linalg.cholesky_ex(correlation)
    ok = info == 0
    if covariance.is_cuda or is_capturing() or not bool(ok.all()):  # the check is cheap on the CPU
        jitter = 1e-6 if covariance.dtype == torch.float32 else 1e-12
        eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
        repaired, still = torch.linalg.cholesky_ex(correlation + jitter * eye)
        lower, ok = torch.where(ok[..., None, None], lower, repaired), ok | (still == 0)
    return torch.where(variance > 0, sd, 0.0).unsqueeze(-1) * lower, ok & (variance >= 0).all(-1)


factor = compilable(_factor, operator=cpp.cholesky_factor, use_torch_compiler=False)


def distribution_covariance(distribution: Any) -> Tensor:
    """Return the covariance [..., k, k] of a multivariate normal or an independent distribution."""
    covariance: Tensor = (
        distribution.covariance_matrix
        if isinstance(distribution, MultivariateNormal)
        else torch.diag_embed(distribution.variance)
    )
    return covariance


def shared_distribution_covariance(distribution: Any) -> Tensor:
    """Return the covariance of a batch [R, N]; [R, 1, k, k] if all particles share a normal scale."""
    if isinstance(distribution, MultivariateNormal) and distribution.scale_tril.stride(1) == 0:
        root = distribution.scale_tril[:, :1]
        return root @ root.mT
    base = distribution.base_dist if isinstance(distribution, Independent) else None
    if isinstance(base, Normal) and base.scale.stride(1) == 0:
        return torch.diag_embed(base.scale[:, :1].square())
    return distribution_covariance(distribution)


def _solved_length(e: Tensor, covariance: Tensor) -> Tensor:
    """Return e' covariance^-1 e, [...]; NaN or infinite where the covariance is singular."""
    e = e.unsqueeze(-1)
    return (e.mT @ torch.linalg.solve_ex(covariance, e)[0]).flatten(-3)


squared_length = compilable(
    _solved_length, operator=cpp.squared_mahalanobis, keep_in_graph=False, use_torch_compiler=False
)


def gaussian_log_density(r: Tensor, covariance: Tensor, observed_mask: Tensor) -> Tensor:
    """Compute log N(r; 0, covariance) over the observed components.

    A missing component gets unit variance, zero correlation and zero residual, and its constant is
    left out.

    Args:
        r: Residual, [..., D]. Zero where missing.
        covariance: Covariance, [..., D, D].
        observed_mask: Mask of observed components, [..., D].

    Returns:
        Log density, [...]. NaN where the covariance is not positive definite.
    """
    both = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
    eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(both, covariance, eye))
    z = torch.linalg.solve_triangular(factor, r.unsqueeze(-1), upper=False).squeeze(-1)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    count = observed_mask.sum(-1, dtype=r.dtype)  # an int64 count times a float would be float32
    value = -0.5 * (z * z).sum(-1) - log_det - 0.5 * _LOG_2PI * count
    return torch.where(info == 0, value, torch.nan)
