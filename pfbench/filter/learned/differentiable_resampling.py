"""Differentiable resampling for training, with the bias of each method.

`EssResampler` ignores that the choice of ancestors depends on the parameters. Variational SMC, FIVO and
AESMC drop this term too [Naesseth et al. 2018; Maddison et al. 2017; Le et al. 2018]. The gradient then
has a low variance and a bias.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
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
from typing_extensions import override

from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.particle.stages import EssResampler, Resampler, Systematic
from pfbench.model.base import StateSpaceModel


def _always() -> EssResampler:
    """Return systematic resampling at every step."""
    return EssResampler(Systematic(), 1.0)


@dataclass(frozen=True)
class StopGradientResampler(Resampler):
    """Resample with weights 1/N w / stop(w): their value is 1/N, their gradient the score.

    For any unbiased scheme the gradient of the estimated evidence (not of its logarithm) is
    unbiased: E[grad Z_hat] = grad Z. It has the variance of a score and needs many particles.

    Attributes:
        resampler: Resampler that copies.

    References:
        Scibior and Wood 2021, "Differentiable particle filtering without modifying the forward
        pass".
    """

    resampler: EssResampler = field(default_factory=_always)

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"resampler.inner": self.resampler})

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        # the resampler corrects weights by log w - log a; with a detached this has the gradient of the score
        return self.resampler(model, belief, log_a.detach(), n, draws)


@dataclass(frozen=True)
class SoftResampler(Resampler):
    """Ancestors by a' = alpha a + (1 - alpha) / N with weights w / (N a') [Karkus, Hsu, Lee 2018].

    Part of the gradient passes through the weights. The choice of ancestors is ignored, with a
    smaller bias for a smaller alpha. The target of the particles is the same for any alpha.

    Attributes:
        alpha: 1 is plain resampling. Towards 0 the influence of the weights vanishes.
        resampler: Resampler that copies. StopGradientResampler removes the remaining bias.

    Raises:
        ValueError: If alpha is outside (0, 1].
    """

    alpha: float = 0.5
    resampler: Resampler = field(default_factory=_always)

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"resampler.inner": self.resampler})

    def __post_init__(self) -> None:
        require_ranges("resampler", self, alpha="(0, 1] Use 1 for resampling by the weights.")

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        living = belief.log_w > -torch.inf
        even = torch.where(living, -torch.log(living.sum(1, keepdim=True).to(log_a)), -torch.inf)
        if self.alpha < 1.0:
            log_a = torch.where(
                living,
                torch.logaddexp(log_a + math.log(self.alpha), even + math.log1p(-self.alpha)),
                -torch.inf,
            )
        return self.resampler(model, belief, log_a, n, draws)


# --------------------------------------------------------------------------------------------------
# Reparameterised samples of any distribution that a network returns, from counter-based streams.
#
# A run gets the same samples in any batch, unlike with torch's `rsample`. Gradients with respect to
# the parameters of the distribution pass through the samples.


def sample_from(
    distribution: Distribution, z: Tensor, draws: RandomStream, purpose: str = "learned"
) -> Tensor:
    """Sample a distribution from standard normal numbers.

    Normals are shifted and scaled. Transformed distributions are sampled and transformed. Others
    are sampled by their inverse cdf. A mixture of diagonal normals selects a component first.
    Its gradient is the implicit one, component by component.

    Returns samples, [R, N, W]. Shapes: distribution [R, N], z [R, N, W].

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
    component = (
        (u > torch.softmax(logits.detach(), -1).cumsum(-1))
        .sum(-1, keepdim=True)
        .clamp(max=logits.shape[-1] - 1)
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
