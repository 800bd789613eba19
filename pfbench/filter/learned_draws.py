"""Draws of any law that a network may return, made of the house's standard normals: a run gets the same ones in any batch.

torch's own `rsample` draws from one stream for all runs. Here a law is drawn by its reparametrisation, so that gradients with
respect to its parameters pass through the draw.
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

from pfbench.draws import Draws


def drawn(law: Distribution, z: Tensor, draws: Draws, purpose: str = "learned") -> Tensor:
    """A draw [R, N, W] of a law with batch [R, N] (or [R, 1]) and event [W], made of standard normals z [R, N, W].

    Normals are shifted and scaled, transformed laws are drawn and transformed, laws with an inverse distribution function are
    inverted. A mixture of diagonal normals chooses a component by one more uniform; its gradient is the implicit one
    [Figurnov, Mohamed, Mnih 2018, "Implicit reparameterization gradients"], component by component.

    Raises:
        ValueError: a law that cannot be drawn so.
    """
    each: Any = law.base_dist if isinstance(law, Independent) else law
    if isinstance(each, Normal):
        return each.loc + each.scale * z
    if isinstance(law, LowRankMultivariateNormal):
        factor: Tensor = law.cov_factor
        more = draws.normal(f"{purpose}.factor", z.shape[1], factor.shape[-1])
        return law.loc + law.cov_diag.sqrt() * z + (factor @ more.unsqueeze(-1)).squeeze(-1)
    if isinstance(law, MultivariateNormal):
        return law.loc + (law.scale_tril @ z.unsqueeze(-1)).squeeze(-1)
    if isinstance(each, TransformedDistribution):
        value = drawn(each.base_dist, z, draws, purpose)
        for transform in each.transforms:
            value = transform(value)
        return value
    if isinstance(law, MixtureSameFamily):
        return _of_mixture(law, z, draws.uniform(f"{purpose}.which", z.shape[1], 1).to(z))
    try:
        return each.icdf(torch.special.ndtr(z))
    except NotImplementedError:
        raise ValueError(
            f"proposal.network returned {type(each).__name__}, which cannot be made of standard normals: return Normal, "
            "MultivariateNormal, LowRankMultivariateNormal, a mixture of diagonal normals, a law with icdf, or one of these "
            "transformed"
        ) from None


def _of_mixture(law: MixtureSameFamily, z: Tensor, u: Tensor) -> Tensor:
    """z [R, N, W], u [R, N, 1] -> [R, N, W]."""
    parts, chosen = law.component_distribution, law.mixture_distribution
    normal = parts.base_dist if isinstance(parts, Independent) else None
    if not (isinstance(normal, Normal) and isinstance(chosen, Categorical)):
        raise ValueError("proposal.network returned a mixture, but not of diagonal normals; return one of Independent(Normal)")
    logits = chosen.logits.expand(*z.shape[:2], -1)
    mean, sd = (a.expand(*logits.shape, z.shape[-1]) for a in (normal.loc, normal.scale))
    last = logits.shape[-1] - 1
    which = (u > torch.softmax(logits.detach(), -1).cumsum(-1)).sum(-1, keepdim=True).clamp(max=last).unsqueeze(-1)
    where = which.expand(*which.shape[:-1], z.shape[-1])
    value = (mean.gather(2, where) + sd.gather(2, where) * z.unsqueeze(2)).squeeze(2)
    return _implicit(value, logits, mean, sd) if torch.is_grad_enabled() and logits.requires_grad else value


def _implicit(value: Tensor, logits: Tensor, mean: Tensor, sd: Tensor) -> Tensor:
    """The same numbers [R, N, W], moving with the parameters so that all conditional distribution functions stay as they are."""
    moved, log_share = [], torch.log_softmax(logits, -1)
    for j in range(value.shape[-1]):
        at = value[..., j : j + 1].detach()
        s, share = (at - mean[..., j]) / sd[..., j], torch.softmax(log_share, -1)
        below = (share * torch.special.ndtr(s)).sum(-1)
        density = (share * torch.exp(-0.5 * s * s) / sd[..., j]).sum(-1).detach() / math.sqrt(2.0 * math.pi)
        moved.append(at.squeeze(-1) - (below - below.detach()) / density.clamp(min=1e-300))
        log_share = log_share - 0.5 * ((moved[-1].unsqueeze(-1) - mean[..., j]) / sd[..., j]).square() - sd[..., j].log()
    return torch.stack(moved, -1)
