"""The Rao-Blackwellised particle filter: particles where the model is not linear, a Kalman filter of each particle for the rest.

A state's components are sampled (s) or marginalised (l). Given the path of s, l is normal: a particle carries s as drawn and, in
place of l, its conditional mean; a root of the conditional covariance goes with it, one for all particles where the model is
linear. A step treats the normal law of (s', l') given a particle as one: it draws s' from its marginal, which is at once what l'
learns from s', and then l' learns from the measurement, whose density given s' is the weight. [Schon, Gustafsson and Nordlund
2005, "Marginalized particle filters for mixed linear/nonlinear state-space models"; Doucet, Godsill and Andrieu 2000]
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, Info, weights
from pfbench.filter.linearisation import base, derivative, innovation, is_normal, mean, quiet, where_seen
from pfbench.filter.particle import ParticleFilter
from pfbench.filter.proposals import Bootstrap, Proposed
from pfbench.filter.resamplers import Resample, Resampler, Systematic
from pfbench.filter.square_root import absorbed, swept
from pfbench.filter.whitening import LOG_2PI, log_det
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.record import Record


class Split(NamedTuple):
    """Components of a difference of states, in the chart.

    Attributes:
        sampled: s.
        linear: l.
        common: all particles have the same covariance of l.
    """

    sampled: list[int]
    linear: list[int]
    common: bool


@dataclass(frozen=True)
class Given:
    """Log weights before, times what the proposal knows: here the density of what was seen, given the sampled path."""

    exact = True

    def __call__(self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, seen: Record) -> Tensor:
        value = log_w + log_ratio
        return torch.where(torch.isnan(value), -torch.inf, value)


@dataclass(frozen=True)
class Marginalised:
    """Draws the sampled part and conditions the rest on it and on the measurement.

    Its log_ratio is the log density of the measurement given the sampled path, to be weighed by Given. x holds sampled values and
    conditional means; memory["root"] [R, N or 1, l, l] a root of the conditional covariance.
    """

    split: Split
    exact = True  # if l is linear and normal given s

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        if not self.split.linear:
            sent = Bootstrap()(model, cloud, seen, draws)
            return sent._replace(log_ratio=model.log_likelihood(seen.y, sent.x, seen.u))
        before = cloud.memory["root"]
        predicted, noise = _spread(model, cloud.x, before, seen.u, self.split)
        columns, root = swept(noise, self.split.sampled, self.split.linear)
        z = draws.normal("noise", cloud.x.shape[1], len(columns)).to(cloud.x)
        x = model.chart.add(predicted, _along(columns, z, noise))
        h, r, log_sd = _expected(model, x, seen, self.split)
        shift, root, log_like = absorbed(root, h, r)
        x = model.chart.add(x, _placed(shift, self.split.linear, model.chart.dimension))
        known = (~torch.isnan(seen.y)).sum(-1, dtype=x.dtype).unsqueeze(-1)
        log_like = log_like - log_sd - 0.5 * LOG_2PI * known
        sound = torch.isfinite(root).all(-1).all(-1)  # where not, the particle weighs nothing and stays as it was
        memory = {"root": torch.where(sound[..., None, None], root, before)}
        return Proposed(x, torch.where(sound, log_like, -torch.inf), memory)


@dataclass(frozen=True)
class RaoBlackwellised:
    """A particle filter of part of the state, a Kalman filter for the rest.

    The map and what is seen are linearised at each particle in l and, where it is not additive, in the noise: no approximation
    where the model is linear in them given s, an extended Kalman filter of each particle elsewhere. The driving noise and
    the measurement's must be normal, the latter's covariance not dependent on l. Means and covariances told are of the whole
    mixture, those of l's conditional laws included.

    Args:
        particles: N.
        sampled: groups or states to be sampled, by name; all others are marginalised. None samples what the model does not
            declare `linear_given` the rest: then the filter is exact, and on a linear model it is the Kalman filter.
        resampler: as of a particle filter.

    Raises:
        ValueError: fewer than two particles; on use, a name that the model does not have, a model that declares nothing linear
            when no name is given, or a law that is not normal.
    """

    particles: int
    sampled: Sequence[str] | None = None
    resampler: Resampler = field(default_factory=lambda: Resample(Systematic()))

    def __post_init__(self) -> None:
        if self.particles < 2:
            raise ValueError(f"filter.particles={self.particles}: give at least 2 particles")

    @property
    def exact(self) -> bool:
        """Does the cloud target p(x_t | y_1:t) as N grows? Not claimed where components are chosen by name."""
        return self.sampled is None and self.resampler.exact

    def init(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None = None, spread: Tensor | None = None
    ) -> Cloud:
        """The sampled part drawn from its marginal law, the rest at its conditional mean, all of one weight."""
        split = split_of(model, self.sampled)
        cloud = ParticleFilter(self.particles).init(model, runs, draws, start, spread)
        if not split.linear:
            return cloud
        _check_normal(model, "the driving noise", model.noise)
        law: Any = initial_law(model, runs, spread)
        root = law.scale_tril if isinstance(law, MultivariateNormal) else torch.diag_embed(law.stddev)
        columns, root = swept(root.unsqueeze(1), split.sampled, split.linear)
        z = draws.normal("initial", self.particles, len(columns)).to(cloud.x)
        origin = model.origin.expand(runs, -1) if start is None else start
        shift = law.mean.unsqueeze(1) + _along(columns, z, law.mean.unsqueeze(1).unsqueeze(-1))
        x = model.chart.add(origin.unsqueeze(1), shift)
        each = 1 if split.common else self.particles
        return cloud._replace(x=x, memory={"root": root.expand(-1, each, -1, -1)})

    def step(self, model: StateSpaceModel, belief: Cloud, seen: Record, draws: Draws) -> tuple[Cloud, Info]:
        """The cloud at t-1 and what is seen at t -> the weighted cloud at t."""
        split = split_of(model, self.sampled)
        inner = ParticleFilter(self.particles, self.resampler, proposal=Marginalised(split), weigh=Given())
        cloud, info = inner.step(model, belief, seen, draws)
        info = info._replace(nis=None)  # the ratio of its proposal holds what was seen
        return cloud, _with_conditional(info, cloud, split) if split.linear else info


def split_of(model: StateSpaceModel, sampled: Sequence[str] | None) -> Split:
    """The split by names of groups or states, or by what the model declares.

    Raises:
        ValueError: an unknown name; without names, a model that declares nothing.
    """
    d = len(model.names)
    if sampled is None:
        linear = list(range(d)) if model.linear else sorted(model.linear_given)
        if not linear:
            raise ValueError(
                f"filter.sampled=null: {type(model).__name__} declares no component that is linear given the rest; name what to "
                f"sample, of the groups {sorted(model.groups)} (all of them is filter=sir), and the rest is linearised"
            )
        return Split([i for i in range(d) if i not in linear], linear, model.linear)
    unknown = [name for name in sampled if name not in model.groups and name not in model.names]
    if unknown:
        raise ValueError(
            f"filter.sampled={list(sampled)}: {type(model).__name__} has no {unknown}; give groups of {sorted(model.groups)} or "
            f"states of {list(model.names)}"
        )
    chosen: set[int] = set()
    for name in sampled:
        chosen |= set(model.groups[name]) if name in model.groups else {model.names.index(name)}
    return Split(sorted(chosen), [i for i in range(d) if i not in chosen], model.linear)


def _spread(model: StateSpaceModel, x: Tensor, root: Tensor, u: Any, split: Split) -> tuple[Tensor, Tensor]:
    """Where particles go without noise [R, N, D], and A of the normal law A xi about it, in the chart [R, N or 1, d, m]."""
    chart, noise, gain = model.chart, model.noise, model.noise_gain(u)
    l, w = len(split.linear), 0 if gain is not None else model.noise_dim
    predicted = model.propagate(x, u, quiet(model, x))

    def moved(at: Tensor, xi: Tensor) -> Tensor:
        driven = quiet(model, xi)
        if w:
            driven = driven + noise.stddev * xi[..., l:]
        start = chart.add(at, _placed(xi[..., :l], split.linear, chart.dimension))
        return model.propagate(start, u, driven)

    centre = model.origin.expand(len(x), 1, -1) if split.common else x
    slopes = derivative(moved, centre, l + w, chart.subtract)
    if gain is not None:
        sized = (gain * noise.stddev).unsqueeze(1)
        slopes = torch.cat([slopes, sized.expand(*slopes.shape[:2], -1, -1)], -1)
    moving, noisy = slopes[..., :l] @ root, slopes[..., l:]
    return predicted, torch.cat([moving, noisy.expand(*moving.shape[:2], -1, -1)], -1)


def _expected(model: StateSpaceModel, x: Tensor, seen: Record, split: Split) -> tuple[Tensor, Tensor, Tensor]:
    """In units of the measurement's noise: H [R, N or 1, k, l], y - y_hat [R, N, k], 0 where unseen; log of its units [R, N]."""
    law: Any = model.observation(x, seen.u)
    _check_normal(model, "the measurement's noise", law)

    def looked(at: Tensor, xi: Tensor) -> Tensor:
        return mean(model.observation(model.chart.add(at, _placed(xi, split.linear, model.chart.dimension)), seen.u))

    centre = model.origin.expand(len(x), 1, -1) if split.common else x
    h = derivative(looked, centre, len(split.linear), model.residual)
    there = ~torch.isnan(seen.y).unsqueeze(1)
    h = torch.where(there.unsqueeze(-1), h, 0.0)
    r = innovation(model, x, seen)
    if not isinstance(law, MultivariateNormal):
        sd = torch.where(there, law.stddev, 1.0)
        return h / (sd[:, :1] if split.common else sd).unsqueeze(-1), r / sd, sd.log().sum(-1)
    covariance = law.covariance_matrix[:, :1] if split.common else law.covariance_matrix
    root, ok = factor(where_seen(covariance, there))
    log_sd = torch.where(ok, log_det(root), torch.nan)
    white = torch.linalg.solve_triangular(root, h, upper=False)
    return white, torch.linalg.solve_triangular(root, r.unsqueeze(-1), upper=False).squeeze(-1), log_sd


def _along(columns: list[Tensor], z: Tensor, like: Tensor) -> Tensor:
    """sum_j L_j z_j [R, N, d]; zeros where there are none, for A [R, N or 1, d, m]."""
    shift = like.new_zeros(*z.shape[:2], like.shape[-2])
    for j, column in enumerate(columns):
        shift = shift + column * z[..., j : j + 1]
    return shift


def _placed(part: Tensor, where: list[int], d: int) -> Tensor:
    """Some components [..., l] as a difference of states [..., d], the others 0; it may carry tangents."""
    return part @ torch.eye(d, dtype=part.dtype, device=part.device)[where]


def _with_conditional(info: Info, cloud: Cloud, split: Split) -> Info:
    """The spread of the particles and, for l, the mean of their conditional covariances: the law of total variance."""
    root, w = cloud.memory["root"], weights(cloud.log_w)
    own = root.square().sum(-1)  # [R, N or 1, l]
    mean = own[:, 0] if own.shape[1] == 1 else (w.unsqueeze(-2) @ own).squeeze(-2)
    variance = info.variance + _placed(mean, split.linear, info.variance.shape[-1])

    def covariance() -> Tensor:
        shared = root.shape[1] == 1
        p = root[:, 0] @ root[:, 0].mT if shared else (w[..., None, None] * (root @ root.mT)).sum(1)
        place = torch.eye(info.variance.shape[-1], dtype=p.dtype, device=p.device)[split.linear]
        return info.covariance() + place.mT @ p @ place

    return info._replace(variance=variance, covariance=covariance, some=None)


def _check_normal(model: StateSpaceModel, what: str, law: Distribution) -> None:
    if not is_normal(law):
        raise ValueError(
            f"RaoBlackwellised: {what} of {type(model).__name__} is {type(base(law)).__name__}, and a Kalman filter for part of "
            "the state needs it normal; sample all states (filter=sir), or choose a normal law"
        )
