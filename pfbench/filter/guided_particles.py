"""A proposal shaped by a Gaussian filter of each particle: the unscented particle filter [van der Merwe et al. 2000]."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud
from pfbench.filter.gaussian import GaussianFilter, update
from pfbench.filter.guides import COVARIANCE, check_widen, log_ratio_of, recall, remember, standard
from pfbench.filter.linearisation import quiet
from pfbench.filter.points import Independent, Points
from pfbench.filter.proposals import Bootstrap, Proposed
from pfbench.filter.whitening import LOG_2PI, half_square, log_det
from pfbench.model.base import AtRest, StateSpaceModel, Wrapped, dense_normal, independent_normal
from pfbench.record import Record


@dataclass(frozen=True)
class GuidedParticles:
    """A guide for each particle, which carries a covariance of its own: unscented particle filter [van der Merwe et al. 2000].

    Each particle's P is predicted and updated, x ~ N(x+, P+), and the ratio is p(x | parent) / N(x; x+, P+). P is that of a
    Kalman filter that knows nothing of the other particles, so the proposal is much wider than p(x | parent, y), and in several
    dimensions few particles weigh anything: GuidedNoise is cheaper and better. It costs N steps of the guide.

    Args:
        guide: the Gaussian filter; adaptations are each particle's own and shape the proposal alone.
        widen: factor on the proposal's covariance.
        points: where the z come from.

    Raises:
        ValueError: a factor that is not positive; at the first step, a transition that has no density, or states whose
            differences are not laid out as they are (quaternions).
    """

    guide: GaussianFilter
    widen: float = 1.0
    points: Points = field(default_factory=Independent)
    exact = True

    def __post_init__(self) -> None:
        check_widen(self.widen)

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        runs, n, _ = cloud.x.shape
        if isinstance(model, AtRest):  # nothing moves, so there is nothing to propose
            return Bootstrap()(model, cloud, seen, draws)
        covariance = cloud.memory[COVARIANCE] if COVARIANCE in cloud.memory else self._first(model, runs, seen, draws)
        before = recall(cloud.memory, cloud.x, covariance.expand(-1, n, -1, -1))
        new = self.guide.advance(_Each(model, runs, n), before, Record(seen.y.repeat_interleave(n, 0), seen.u))
        shift, root, _ = update(new.innovation)
        z = self.points(draws).normal("guide", n, model.chart.dimension)
        step = math.sqrt(self.widen) * (root @ z.reshape(runs * n, -1, 1)).squeeze(-1)
        xi = shift + step
        x = model.chart.add(new.prior, (new.prior_root @ xi.unsqueeze(-1)).squeeze(-1)).unflatten(0, (runs, n))
        xi, scale = xi.unflatten(0, (runs, n)), log_det(new.prior_root).unflatten(0, (runs, n))
        log_q = -log_ratio_of(xi, z, log_det(root).unflatten(0, (runs, n)), self.widen) - half_square(xi) - scale
        log_ratio = _log_transition(model, cloud.x, x, seen.u) - log_q
        sound = torch.isfinite(new.log_like).unflatten(0, (runs, n))
        return Proposed(x, torch.where(sound, log_ratio, -torch.inf), cloud.memory | remember(new, (runs, n)))

    def _first(self, model: StateSpaceModel, runs: int, seen: Record, draws: Draws) -> Tensor:
        """The initial law's covariance, one for all [R, 1, d, d]."""
        d = model.chart.dimension
        cost = f"at every step one update of {d} states for each particle of {runs} runs: N times the cost of Guided"
        warnings.warn(f"GuidedParticles: {cost}", stacklevel=2)
        return self.guide.init(model, runs, draws, seen.start, seen.spread).covariance.unsqueeze(1)


class _Each(Wrapped):
    """A model to which every particle is a run of its own: what is [R N, P, ...] here is [R, N P, ...] there."""

    def __init__(self, model: StateSpaceModel, runs: int, n: int) -> None:
        super().__init__(model)
        self.runs, self.n = runs, n

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        inside, points = self.model.propagate(self._joined(x), u, self._joined(w)), x.shape[1]
        return inside.reshape(self.runs * self.n, points, -1)

    def noise_gain(self, u: Any) -> Tensor | None:
        gain = self.model.noise_gain(u)
        return None if gain is None else gain.expand(self.runs, -1, -1).repeat_interleave(self.n, 0)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        law = self.model.observation(self._joined(x), u)
        mean = law.mean.reshape(*x.shape[:2], -1)
        if isinstance(law, torch.distributions.MultivariateNormal):
            return dense_normal(mean, law.scale_tril.reshape(*mean.shape, -1))
        return independent_normal(mean, law.stddev.reshape(mean.shape))

    def _joined(self, a: Tensor) -> Tensor:
        return a.reshape(self.runs, -1, a.shape[-1])


def _log_transition(model: StateSpaceModel, parents: Tensor, x: Tensor, u: Any) -> Tensor:
    """log p(x | parent) + d / 2 log 2 pi [R, N].

    Raises:
        ValueError: it does not exist, or its volume is not the chart's.
    """
    chart, gain = model.chart, model.noise_gain(u)
    if chart.size == chart.dimension and gain is not None and gain.shape[-1] == chart.dimension and standard(model.noise):
        still = model.propagate(parents, u, quiet(model, parents))
        w = torch.linalg.solve_ex(gain, chart.subtract(x, still).mT)[0]
        return -0.5 * (w * w).sum(-2) - torch.linalg.slogdet(gain)[1].unsqueeze(-1)
    law = model.transition(parents, u) if chart.flat else None
    if law is None:
        raise ValueError(
            f"proposal: GuidedParticles needs the density of {type(model).__name__}'s transition, which is singular or not known "
            "in the chart; choose GuidedNoise, which works on the noise, or Guided"
        )
    return law.log_prob(x) + 0.5 * x.shape[-1] * LOG_2PI
