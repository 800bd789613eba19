"""Which particles a resampler prefers. Weights carry the correction, so any preference is honest; Flattened is not."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import torch
from torch import Tensor

from pfbench.filter.belief import Cloud
from pfbench.filter.weights import Bayes, Weighing
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


class Preference(Protocol):
    """The cloud at t-1 and what is seen at t -> log resampling probabilities [R, N], logsumexp 0."""

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Tensor: ...


@dataclass(frozen=True)
class Weights:
    """The weights themselves: the plain particle filter."""

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Tensor:
        return cloud.log_w


@dataclass(frozen=True)
class LookAhead:
    """First-stage weights of the auxiliary particle filter: w p(y | x propagated without noise) [Pitt and Shephard 1999].

    Args:
        power: exponent on the look-ahead likelihood. 1 is as published; less guards against a look-ahead that is more certain
            than the particles deserve, which makes the second-stage weights heavy-tailed.
    """

    power: float = 1.0

    def __post_init__(self) -> None:
        if not 0.0 < self.power <= 1.0:
            raise ValueError(f"preference.power={self.power}: give an exponent in (0, 1]; 1 is the published filter")

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Tensor:
        quiet = model.noise.mean.expand(*cloud.x.shape[:2], model.noise_dim)
        ahead = model.log_likelihood(seen.y, model.propagate(cloud.x, seen.u, quiet), seen.u)
        log_a = cloud.log_w + self.power * torch.where(torch.isnan(ahead), -torch.inf, ahead)
        total = log_a.logsumexp(1, keepdim=True)
        return torch.where(torch.isfinite(total), log_a - total, cloud.log_w)


class Form(Protocol):
    """Log weights [R, N], logsumexp 0, -inf where a slot is empty -> flatter ones, likewise."""

    def __call__(self, log_w: Tensor) -> Tensor: ...


@dataclass(frozen=True)
class Temper:
    """a ~ W^(1 / (1 + strength)), which minimises KL(a || W) - strength H(a) [ours].

    [COFM-AMSSRCPF 2024, Measurement and Control] names an entropy regularisation of this strength; its equation is lost.
    """

    strength: float = 0.5

    def __post_init__(self) -> None:
        _check_strength(self.strength, torch.inf)

    def __call__(self, log_w: Tensor) -> Tensor:
        if self.strength == 0.0:  # the same object, so that a resampler knows that there is nothing to correct
            return log_w
        return torch.log_softmax(log_w / (1.0 + self.strength), -1)


@dataclass(frozen=True)
class Additive:
    """a ~ W (1 - strength log W): each weight and its share of the entropy, a literal reading [ours]."""

    strength: float = 0.5

    def __post_init__(self) -> None:
        _check_strength(self.strength, torch.inf)

    def __call__(self, log_w: Tensor) -> Tensor:
        if self.strength == 0.0:
            return log_w
        finite = torch.where(log_w > -torch.inf, log_w, 0.0)
        return torch.log_softmax(log_w + torch.log1p(-self.strength * finite.clamp(max=0.0)), -1)


@dataclass(frozen=True)
class Mix:
    """a = (1 - strength) W + strength / N, N counting the particles that weigh anything [ours]."""

    strength: float = 0.5

    def __post_init__(self) -> None:
        _check_strength(self.strength, 1.0)

    def __call__(self, log_w: Tensor) -> Tensor:
        if self.strength == 0.0:
            return log_w
        there = log_w > -torch.inf
        n = there.sum(-1, keepdim=True)
        a = (1.0 - self.strength) * torch.softmax(log_w, -1) + self.strength / n
        return torch.where(there, torch.log(a), -torch.inf)


@dataclass(frozen=True)
class Entropy:
    """Weights flattened by entropy regularisation, as resampling probabilities alone: particles are spared, nothing is biased.

    Args:
        form: how the weights are flattened.
    """

    form: Form = field(default_factory=Temper)

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Tensor:
        return self.form(cloud.log_w)


@dataclass(frozen=True)
class Flattened:
    """Weights flattened for good, as printed: estimate, effective size and what comes later know of no others.

    The cloud is then one of another posterior, nearer to the proposal, and the evidence is wrong, too large or too small as the
    record may be. The sum of the weights stays, since flattening comes after normalisation.

    Args:
        form: how the weights are flattened.
        weigh: how particles are weighed first.
    """

    form: Form = field(default_factory=Temper)
    weigh: Weighing = field(default_factory=Bayes)

    @property
    def exact(self) -> bool:
        return False

    def __call__(self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, seen: Record) -> Tensor:
        value = self.weigh(model, log_w, x, log_ratio, seen)
        total = value.logsumexp(1, keepdim=True)
        alive = torch.isfinite(total)
        log_w = torch.where(alive, value - total, 0.0)
        flat = self.form(log_w)
        return value if flat is log_w else torch.where(alive, flat + total, value)


def _check_strength(strength: float, most: float) -> None:
    if not 0.0 <= strength <= most:
        raise ValueError(f"form.strength={strength}: give 0 (as they are) or more" + (", at most 1" if most == 1.0 else ""))
