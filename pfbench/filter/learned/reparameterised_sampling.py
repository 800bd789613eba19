"""Reparameterised samples of any distribution that a network returns, from counter-based streams.

A run gets the same samples in any batch, unlike with torch's `rsample`. Gradients with respect to
the parameters of the distribution pass through the samples.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor
from torch.distributions import (
    Categorical,
    Distribution,
    Independent,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    TransformedDistribution,
)

from pfbench.core.random_stream import RandomStream


def sample_from(
    distribution: Distribution, z: Tensor, draws: RandomStream, purpose: str = "learned"
) -> Tensor:
    """Sample a distribution from standard normal numbers.

    Normals are shifted and scaled. Transformed distributions are sampled and transformed. Others
    are sampled by their inverse cdf. A mixture of diagonal normals selects a component first.
    Its gradient is the implicit one, component by component.

    Args:
        distribution: Distribution with batch [R, N] or [R, 1] and event [W].
        z: Standard normal numbers, [R, N, W].
        draws: Random stream for further numbers.
        purpose: Label of further numbers.

    Returns:
        Samples, [R, N, W].

    Raises:
        ValueError: If the distribution cannot be sampled from standard normal numbers.

    References:
        M. Figurnov, S. Mohamed and A. Mnih (2018), Implicit reparameterization gradients.
    """
    base: Any = distribution.base_dist if isinstance(distribution, Independent) else distribution
    if isinstance(base, Normal):
        return base.loc + base.scale * z
    if isinstance(distribution, LowRankMultivariateNormal):
        factor: Tensor = distribution.cov_factor
        more = draws.normal(f"{purpose}.factor", z.shape[1], factor.shape[-1])
        return (
            distribution.loc
            + distribution.cov_diag.sqrt() * z
            + (factor @ more.unsqueeze(-1)).squeeze(-1)
        )
    if isinstance(distribution, MultivariateNormal):
        return distribution.loc + (distribution.scale_tril @ z.unsqueeze(-1)).squeeze(-1)
    if isinstance(base, TransformedDistribution):
        value = sample_from(base.base_dist, z, draws, purpose)
        for transform in base.transforms:
            value = transform(value)
        return value
    if isinstance(distribution, MixtureSameFamily):
        return _sample_mixture(
            distribution, z, draws.uniform(f"{purpose}.which", z.shape[1], 1).to(z)
        )
    try:
        return base.icdf(torch.special.ndtr(z))
    except NotImplementedError:
        raise ValueError(
            "proposal.network must return a distribution that standard normals can sample, got "
            f"{type(base).__name__}. Return Normal, MultivariateNormal, LowRankMultivariateNormal, "
            "a mixture of diagonal normals, a distribution with icdf, or one of these transformed."
        ) from None


def _sample_mixture(distribution: MixtureSameFamily, z: Tensor, u: Tensor) -> Tensor:
    """Sample a mixture of diagonal normals from z [R, N, W] and u [R, N, 1]."""
    components, categorical = distribution.component_distribution, distribution.mixture_distribution
    normal = components.base_dist if isinstance(components, Independent) else None
    if not (isinstance(normal, Normal) and isinstance(categorical, Categorical)):
        raise ValueError(
            "proposal.network must return mixtures of diagonal normals, got another. "
            "Return a mixture of Independent(Normal)."
        )
    logits = categorical.logits.expand(*z.shape[:2], -1)
    mean, sd = (a.expand(*logits.shape, z.shape[-1]) for a in (normal.loc, normal.scale))
    last = logits.shape[-1] - 1
    component = (
        (u > torch.softmax(logits.detach(), -1).cumsum(-1))
        .sum(-1, keepdim=True)
        .clamp(max=last)
        .unsqueeze(-1)
    )
    index = component.expand(*component.shape[:-1], z.shape[-1])
    value = (mean.gather(2, index) + sd.gather(2, index) * z.unsqueeze(2)).squeeze(2)
    return (
        _attach_implicit_gradient(value, logits, mean, sd)
        if torch.is_grad_enabled() and logits.requires_grad
        else value
    )


def _attach_implicit_gradient(value: Tensor, logits: Tensor, mean: Tensor, sd: Tensor) -> Tensor:
    """Attach gradients that keep the conditional distribution functions at samples [R, N, W]."""
    samples, log_share = [], torch.log_softmax(logits, -1)
    for j in range(value.shape[-1]):
        x = value[..., j : j + 1].detach()
        s, share = (x - mean[..., j]) / sd[..., j], torch.softmax(log_share, -1)
        below = (share * torch.special.ndtr(s)).sum(-1)
        density = (share * torch.exp(-0.5 * s * s) / sd[..., j]).sum(-1).detach() / math.sqrt(
            2.0 * math.pi
        )
        samples.append(x.squeeze(-1) - (below - below.detach()) / density.clamp(min=1e-300))
        log_share = (
            log_share
            - 0.5 * ((samples[-1].unsqueeze(-1) - mean[..., j]) / sd[..., j]).square()
            - sd[..., j].log()
        )
    return torch.stack(samples, -1)
