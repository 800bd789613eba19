"""Square roots and densities of covariances, batched, that never raise: what has no root is reported."""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal

from pfbench import native
from pfbench.fusion import fusible, recording

_LOG_2PI = math.log(2.0 * math.pi)


def _factor(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Lower triangular A with A A' = covariance, and whether it exists: [..., d, d] -> [..., d, d], bool [...].

    Works on the correlation matrix, so that metres beside radians do no harm. Where rounding has left it slightly
    indefinite, a relative 1e-12 (1e-6 in float32) is added to the diagonal; a covariance that this does not heal is
    reported, never repaired in silence. A component without spread has none in the root either.
    """
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    sd = torch.sqrt(torch.where(variance > 0, variance, 1.0))
    correlation = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    lower, info = torch.linalg.cholesky_ex(correlation)
    ok = info == 0
    if covariance.is_cuda or recording() or not bool(ok.all()):  # looking costs next to nothing on the CPU
        jitter = 1e-6 if covariance.dtype == torch.float32 else 1e-12
        eye = torch.eye(covariance.shape[-1], dtype=covariance.dtype, device=covariance.device)
        healed, still = torch.linalg.cholesky_ex(correlation + jitter * eye)
        lower, ok = torch.where(ok[..., None, None], lower, healed), ok | (still == 0)
    return torch.where(variance > 0, sd, 0.0).unsqueeze(-1) * lower, ok & (variance >= 0).all(-1)


factor = fusible(_factor, by_hand=native.rooted, compiles=False)


def covariance_of(law: Any) -> Tensor:
    """Covariance [..., k, k] of a law with independent components or a multivariate normal one."""
    return law.covariance_matrix if isinstance(law, MultivariateNormal) else torch.diag_embed(law.variance)


def common_covariance_of(law: Any) -> Tensor:
    """The same of laws with batch [R, N]; [R, 1, k, k] of normal ones whose scale torch has expanded to all N."""
    if isinstance(law, MultivariateNormal) and law.scale_tril.stride(1) == 0:
        root = law.scale_tril[:, :1]
        return root @ root.mT
    if isinstance(law, Independent) and isinstance(law.base_dist, Normal) and law.base_dist.scale.stride(1) == 0:
        return torch.diag_embed(law.base_dist.scale[:, :1].square())
    return covariance_of(law)


def _solved_length(e: Tensor, covariance: Tensor) -> Tensor:
    """e' covariance^-1 e: [..., d], [..., d, d] -> [...]; NaN or infinite where the covariance is singular."""
    e = e.unsqueeze(-1)
    return (e.mT @ torch.linalg.solve_ex(covariance, e)[0]).flatten(-3)


squared_length = fusible(_solved_length, by_hand=native.squared_length, whole=False, compiles=False)


def gaussian_log_density(r: Tensor, covariance: Tensor, seen: Tensor) -> Tensor:
    """log N(r; 0, covariance) over the components seen: r [..., D], covariance [..., D, D], seen [..., D] -> [...].

    A component that was not seen gets unit variance, no correlation and no residual; its constant is taken back. A covariance
    that is not positive gives NaN.
    """
    both = seen.unsqueeze(-1) & seen.unsqueeze(-2)
    eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(both, covariance, eye))
    z = torch.linalg.solve_triangular(factor, r.unsqueeze(-1), upper=False).squeeze(-1)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    known = seen.sum(-1, dtype=r.dtype)  # an int64 count times a number would be float32
    value = -0.5 * (z * z).sum(-1) - log_det - 0.5 * _LOG_2PI * known
    return torch.where(info == 0, value, torch.nan)
