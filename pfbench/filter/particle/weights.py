"""Weights other than the plain ones: with a look-ahead, tempered or floored."""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require_ranges
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, add_log_weights
from pfbench.filter.exactness import has_bounded_weights, is_every_part_exact
from pfbench.filter.particle.stages import (
    AuxiliaryWeights,
    BayesWeightUpdate,
    WeightUpdate,
)
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class LookAheadWeights(AuxiliaryWeights):
    """First-stage weights of the auxiliary particle filter.

    (1 - c) a + c w, with a ~ w p(y | f(x)) and f(x) the state propagated with mean noise. A parent
    whose prediction the measurement excludes may have children that it does not exclude. The part
    c w keeps such parents, and bounds the second-stage weights by 1 / c times the likelihood.

    Attributes:
        likelihood_power: Exponent of the look-ahead likelihood. 1 is as published. A smaller one
            avoids heavy-tailed second-stage weights if the look-ahead is overconfident.
        defensive_fraction: Fraction c of the probabilities that ignores the measurement, in [0, 1].
            0 is as published. The filter then converges to a wrong distribution if measurement
            errors are bounded, and its second-stage weights are unbounded.

    Raises:
        ValueError: If the exponent is outside (0, 1], or the fraction is outside [0, 1].

    References:
        Pitt and Shephard 1999. Hesterberg 1995 (defensive mixture).
    """

    likelihood_power: float = 1.0
    defensive_fraction: float = 0.1

    @property
    @override
    def is_exact(self) -> bool:
        """True if no parent is excluded."""
        return self.defensive_fraction > 0.0

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return self.defensive_fraction > 0.0

    def __post_init__(self) -> None:
        require_ranges(
            "auxiliary_weights",
            self,
            defensive_fraction="[0, 1]",
            likelihood_power="(0, 1] Use 1 for the published filter.",
        )

    @override
    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
        mean_noise = model.noise.mean.expand(*belief.x.shape[:2], model.noise_dim)
        ahead = model.log_likelihood(
            record.y, model.propagate(belief.x, record.u, mean_noise), record.u
        )
        log_a = belief.log_w + self.likelihood_power * torch.where(
            torch.isnan(ahead), -torch.inf, ahead
        )
        total = log_a.logsumexp(1, keepdim=True)
        log_a = torch.where(torch.isfinite(total), log_a - total, belief.log_w)
        if self.defensive_fraction == 0.0:
            return log_a
        c = self.defensive_fraction
        if c == 1.0:
            return belief.log_w
        return torch.logaddexp(log_a + math.log1p(-c), belief.log_w + math.log(c))


class Tempering(Protocol):
    """Tempering of weights: it makes them more uniform."""

    @property
    def is_exact(self) -> bool:
        """True if positive weights stay positive."""

    @property
    def has_bounded_weights(self) -> bool:
        """True if weights divided by tempered ones have a bound. Silence counts as False."""
        return False

    def __call__(self, log_w: Tensor) -> Tensor:
        """Temper log weights [R, N], logsumexp 0; -inf marks an inactive slot."""


@dataclass(frozen=True)
class PowerTempering(Tempering):
    """a ~ W^(1 / (1 + strength)), which minimises KL(a || W) - strength H(a) [ours].

    Attributes:
        strength: 0 leaves the weights unchanged. COFM-AMSSRCPF 2024 (Measurement and Control) names
            an entropy regularisation of strength 0.5. Its equation is missing in print.
    """

    strength: float = 0.5
    is_exact = True
    has_bounded_weights = True  # tempering flattens

    def __post_init__(self) -> None:
        require_ranges("tempering", self, strength="[0, inf] Use 0 for unchanged weights.")

    @override
    def __call__(self, log_w: Tensor) -> Tensor:
        if self.strength == 0.0:  # the same object: the resampler then omits the correction
            return log_w
        return torch.log_softmax(log_w / (1.0 + self.strength), -1)


@dataclass(frozen=True)
class AdditiveTempering(Tempering):
    """a ~ W (1 - strength log W), each weight plus its term of the entropy [ours].

    Attributes:
        strength: 0 leaves the weights unchanged.
    """

    strength: float = 0.5
    is_exact = True
    has_bounded_weights = True  # tempering flattens

    def __post_init__(self) -> None:
        require_ranges("tempering", self, strength="[0, inf] Use 0 for unchanged weights.")

    @override
    def __call__(self, log_w: Tensor) -> Tensor:
        if self.strength == 0.0:
            return log_w
        finite = torch.where(log_w > -torch.inf, log_w, 0.0)
        return torch.log_softmax(log_w + torch.log1p(-self.strength * finite.clamp(max=0.0)), -1)


@dataclass(frozen=True)
class UniformTempering(Tempering):
    """a = (1 - strength) W + strength / N, with N active particles [ours].

    Attributes:
        strength: From 0 (weights unchanged) to 1 (uniform).
    """

    strength: float = 0.5
    is_exact = True

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return self.strength < 1.0

    def __post_init__(self) -> None:
        require_ranges("tempering", self, strength="[0, 1] Use 0 for unchanged weights.")

    @override
    def __call__(self, log_w: Tensor) -> Tensor:
        if self.strength == 0.0:
            return log_w
        active = log_w > -torch.inf
        n = active.sum(-1, keepdim=True)
        a = (1.0 - self.strength) * torch.softmax(log_w, -1) + self.strength / n
        return torch.where(active, torch.log(a), -torch.inf)


@dataclass(frozen=True)
class TemperedWeights(AuxiliaryWeights):
    """Tempered weights as resampling probabilities: more particles survive, no bias.

    Attributes:
        tempering: Tempering of the weights.
    """

    tempering: Tempering = field(default_factory=PowerTempering)

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"preference.form": self.tempering})

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return bool(has_bounded_weights(self.tempering))

    @override
    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
        return self.tempering(belief.log_w)


@dataclass(frozen=True)
class TemperedPosterior(WeightUpdate):
    """Weights replaced by tempered ones, as printed.

    This biases the estimate and the evidence: the particles then represent another distribution,
    closer to the proposal. The sum of the weights does not change, because tempering follows
    normalisation.

    Attributes:
        tempering: Tempering of the weights.
        weight_update: Weight update before tempering.
    """

    tempering: Tempering = field(default_factory=PowerTempering)
    weight_update: WeightUpdate = field(default_factory=BayesWeightUpdate)
    is_exact = False

    @override
    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        value = self.weight_update(model, log_w, x, log_ratio, record)
        total = value.logsumexp(1, keepdim=True)
        valid = torch.isfinite(total)
        log_w = torch.where(valid, value - total, 0.0)
        tempered = self.tempering(log_w)
        return value if tempered is log_w else torch.where(valid, tempered + total, value)


@dataclass(frozen=True)
class PowerLikelihoodUpdate(WeightUpdate):
    """Bayes' rule with the likelihood to the power 1 / r_factor.

    For normal errors this is their likelihood with `r_factor` times the covariance, up to a constant. Moves of
    particles accept by the same likelihood.

    Attributes:
        r_factor: Factor on the measurement noise covariance.

    Raises:
        ValueError: If the factor is not positive.
    """

    r_factor: float = 1.0

    def __post_init__(self) -> None:
        require_ranges(
            "PowerLikelihoodUpdate", self, r_factor="(0, inf) Use 1 for the model's noise."
        )

    @property
    @override
    def is_exact(self) -> bool:
        """True without tempering."""
        return self.r_factor == 1.0

    @property
    def has_evidence(self) -> bool:
        """True if the weights are densities of y given x."""
        return self.is_exact

    def temper(self, model: StateSpaceModel) -> StateSpaceModel:
        """Return the model with the likelihood of the weights, for the flow to accept by.

        It is not linear, since a linear model has a shorter way that does not ask for the likelihood.
        """
        tempered, plain = copy.copy(model), model.log_likelihood
        tempered.__dict__.update(
            log_likelihood=lambda y, x, u: plain(y, x, u) / self.r_factor,
            linear=False,
            tape_key=(id(model), self.r_factor),
        )
        return tempered

    @override
    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        log_likelihood = model.log_likelihood(record.y, x, record.u).expand_as(log_w).to(log_w)
        return add_log_weights(log_likelihood / self.r_factor, log_w, log_ratio)
