"""Resampling probabilities. The weights correct for them, so the filter stays exact, except with Flattened."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.particle.weight_update import BayesWeightUpdate, WeightUpdate
from pfbench.model.base import StateSpaceModel


class AuxiliaryWeights(Protocol):
    """Compute log resampling probabilities [R, N], logsumexp 0, of particles at t-1 from the record at t."""

    @property
    def is_exact(self) -> bool:
        """Whether every particle of positive weight has a positive probability."""

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record
    ) -> Tensor: ...


@dataclass(frozen=True)
class PosteriorWeights:
    """The weights themselves, as in the plain particle filter."""

    is_exact = True

    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
        return belief.log_w


@dataclass(frozen=True)
class LookAheadWeights:
    """First-stage weights of the auxiliary particle filter: w p(y | x propagated with mean noise).

    Attributes:
        likelihood_power: Exponent of the look-ahead likelihood. 1 is as published. Less avoids heavy-tailed
            second-stage weights if the look-ahead is overconfident.

    References:
        Pitt and Shephard 1999.
    """

    likelihood_power: float = 1.0
    is_exact = True

    def __post_init__(self) -> None:
        if not 0.0 < self.likelihood_power <= 1.0:
            raise ValueError(
                f"auxiliary_weights.likelihood_power must be in (0, 1], got {self.likelihood_power}. Use 1 for the published filter"
            )

    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
        mean_noise = model.noise.mean.expand(*belief.x.shape[:2], model.noise_dim)
        ahead = model.log_likelihood(
            record.y, model.propagate(belief.x, record.u, mean_noise), record.u
        )
        log_a = belief.log_w + self.likelihood_power * torch.where(
            torch.isnan(ahead), -torch.inf, ahead
        )
        total = log_a.logsumexp(1, keepdim=True)
        return torch.where(torch.isfinite(total), log_a - total, belief.log_w)


class Tempering(Protocol):
    """Flatten log weights [R, N], logsumexp 0; -inf marks an inactive slot."""

    @property
    def is_exact(self) -> bool:
        """Whether positive weights stay positive."""

    def __call__(self, log_w: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class PowerTempering:
    """a ~ W^(1 / (1 + strength)), which minimises KL(a || W) - strength H(a) [ours].

    Attributes:
        strength: 0 leaves the weights unchanged. COFM-AMSSRCPF 2024 (Measurement and Control) names
            an entropy regularisation of strength 0.5. Its equation is missing in print.
    """

    strength: float = 0.5
    is_exact = True

    def __post_init__(self) -> None:
        _check_strength(self.strength, torch.inf)

    def __call__(self, log_w: Tensor) -> Tensor:
        if self.strength == 0.0:  # the same object: the resampler then skips the correction
            return log_w
        return torch.log_softmax(log_w / (1.0 + self.strength), -1)


@dataclass(frozen=True)
class AdditiveTempering:
    """a ~ W (1 - strength log W): each weight and its part of the entropy, a literal reading [ours].

    Attributes:
        strength: 0 leaves the weights unchanged.
    """

    strength: float = 0.5
    is_exact = True

    def __post_init__(self) -> None:
        _check_strength(self.strength, torch.inf)

    def __call__(self, log_w: Tensor) -> Tensor:
        if self.strength == 0.0:
            return log_w
        finite = torch.where(log_w > -torch.inf, log_w, 0.0)
        return torch.log_softmax(log_w + torch.log1p(-self.strength * finite.clamp(max=0.0)), -1)


@dataclass(frozen=True)
class UniformTempering:
    """a = (1 - strength) W + strength / N, with N active particles [ours].

    Attributes:
        strength: From 0 (weights unchanged) to 1 (uniform).
    """

    strength: float = 0.5
    is_exact = True

    def __post_init__(self) -> None:
        _check_strength(self.strength, 1.0)

    def __call__(self, log_w: Tensor) -> Tensor:
        if self.strength == 0.0:
            return log_w
        active = log_w > -torch.inf
        n = active.sum(-1, keepdim=True)
        a = (1.0 - self.strength) * torch.softmax(log_w, -1) + self.strength / n
        return torch.where(active, torch.log(a), -torch.inf)


@dataclass(frozen=True)
class TemperedWeights:
    """Flattened weights as resampling probabilities only: more particles survive, without bias.

    Attributes:
        tempering: How the weights are flattened.
    """

    tempering: Tempering = field(default_factory=PowerTempering)

    @property
    def is_exact(self) -> bool:
        """Whether the form keeps positive weights positive."""
        return is_every_part_exact(**{"preference.form": self.tempering})

    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
        return self.tempering(belief.log_w)


@dataclass(frozen=True)
class TemperedPosterior:
    """Weights replaced by flattened ones, as printed, which biases the estimate and the evidence.

    The particles then represent another distribution, closer to the proposal. The sum of the weights
    is kept, because flattening follows normalisation.

    Attributes:
        tempering: How the weights are flattened.
        weight_update: Weight update before flattening.
    """

    tempering: Tempering = field(default_factory=PowerTempering)
    weight_update: WeightUpdate = field(default_factory=BayesWeightUpdate)
    is_exact = False

    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        value = self.weight_update(model, log_w, x, log_ratio, record)
        total = value.logsumexp(1, keepdim=True)
        valid = torch.isfinite(total)
        log_w = torch.where(valid, value - total, 0.0)
        flat = self.tempering(log_w)
        return value if flat is log_w else torch.where(valid, flat + total, value)


def _check_strength(strength: float, most: float) -> None:
    """Raise a ValueError if the strength is outside [0, most]."""
    if not 0.0 <= strength <= most:
        raise ValueError(
            f"tempering.strength must be from 0 to {most:g}, got {strength}. Use 0 for unchanged weights"
        )
