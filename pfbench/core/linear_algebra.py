"""Square roots and densities of covariances, derivatives of maps, and affine maps with sparse matrices."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.distributions import Independent, MultivariateNormal, Normal

from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable, is_capturing, use_kernels

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


factor = compilable(_factor, operator=dispatch.cholesky_factor, use_torch_compiler=False)


def distribution_covariance(distribution: Any) -> Tensor:
    """Return the covariance [..., k, k] of a multivariate normal or an independent distribution, or of differences in a chart."""
    covariance: Tensor = (
        distribution.covariance_matrix
        if hasattr(distribution, "covariance_matrix")
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
    _solved_length,
    operator=dispatch.squared_mahalanobis,
    keep_in_graph=False,
    use_torch_compiler=False,
)


def gaussian_log_density(r: Tensor, covariance: Tensor, observed_mask: Tensor) -> Tensor:
    """Compute log N(r; 0, covariance) over the observed components.

    A missing component gets unit variance, zero correlation and zero residual, and its constant is
    left out.

    Returns log density, [...]. NaN where the covariance is not positive definite. Shapes: r
    [..., D], covariance [..., D, D], observed_mask [..., D].
    """
    both = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
    eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
    factor, info = torch.linalg.cholesky_ex(torch.where(both, covariance, eye))
    z = torch.linalg.solve_triangular(factor, r.unsqueeze(-1), upper=False).squeeze(-1)
    log_det = factor.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    count = observed_mask.sum(-1, dtype=r.dtype)  # an int64 count times a float would be float32
    value = -0.5 * (z * z).sum(-1) - log_det - 0.5 * _LOG_2PI * count
    return torch.where(info == 0, value, torch.nan)


# --------------------------------------------------------------------------------------------------
# Exact derivatives of maps of single states, in one pass: the particle axis holds components.

Map: TypeAlias = Callable[[Tensor], Tensor]
"""A map [R, P, d] -> [R, P, D] of each of the P values alone."""
Subtract: TypeAlias = Callable[[Tensor, Tensor], Tensor]
"""The difference of values of a map: [R, P, D], [R, 1, D] -> [R, P, k]."""


def jacobian(f: Map, value: Tensor, d: int, subtract: Subtract = torch.subtract) -> Tensor:
    """Compute the derivative of a map at zero.

    Backward mode is used unless a gradient of the result is required, which the value at zero
    shows. In forward mode torch computes a shape for each operation between values with and without
    a tangent, which costs a third of a millisecond. In backward mode the branch that `torch.where`
    does not select can spoil a derivative (0 times infinity). The derivative is then computed
    forward.

    Returns derivative, [R, k, d]. Shapes: value [R, 1, D].
    """
    derivative = None
    if not (value.requires_grad or value.is_cuda or is_capturing()):
        derivative = _backward(f, value, d, subtract)
    return _forward(f, value, d, subtract) if derivative is None else derivative


def _backward(f: Map, value: Tensor, d: int, subtract: Subtract) -> Tensor | None:
    """Compute `slopes` in backward mode; None if a derivative is spoilt."""
    k = subtract(value, value).shape[-1]
    with torch.enable_grad(), use_kernels(False):
        centre = value.new_zeros(len(value), k, d).requires_grad_()
        difference = subtract(f(centre), value)
        if not difference.requires_grad:  # the map does not depend on its argument
            return torch.zeros_like(centre)
        total = difference.diagonal(dim1=1, dim2=2).sum()
        (derivative,) = torch.autograd.grad(total, centre)
    finite_mask = torch.isfinite(value).all(-1).squeeze(1)
    spoilt = finite_mask & ~torch.isfinite(derivative.sum((1, 2)))
    return None if bool(spoilt.any()) else derivative


def _forward(f: Map, value: Tensor, d: int, subtract: Subtract) -> Tensor:
    """Compute `slopes` in forward mode; the particle axis holds the directions."""
    centre = value.new_zeros(len(value), d, d)
    eye = torch.eye(d, dtype=value.dtype, device=value.device)
    directions = eye.expand_as(centre).contiguous()
    with forward_ad.dual_level():  # torch.func.jvp costs three times as much
        difference = subtract(f(forward_ad.make_dual(centre, directions)), value)
        primal, tangent = forward_ad.unpack_dual(difference)
    return torch.zeros_like(primal).mT if tangent is None else tangent.mT


def affine_map(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    """Compute phi x + gain w.

    The compiled version skips zero coefficients, which most are in error models of an INS.

    Returns states, [R, N, D]. Shapes: phi [R or 1, D, D], x [R, N, D], gain [R or 1, D, W], w
    [R, N, W].
    """
    return _affine(phi, x, gain, w).permute(1, 2, 0)


def _dense_affine(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    runs = x.shape[0]
    if len(phi) == len(gain) == 1:  # the same for all runs: one product, components first in memory
        shifted = gain[0] @ w.permute(2, 0, 1).flatten(1)
        return shifted.addmm_(phi[0], x.permute(2, 0, 1).flatten(1)).unflatten(1, x.shape[:2])
    noise = gain.expand(runs, -1, -1) @ w.mT
    return torch.baddbmm(noise, phi.expand(runs, -1, -1), x.mT).transpose(0, 1)


_affine = compilable(_dense_affine, operator=dispatch.propagate_affine)
