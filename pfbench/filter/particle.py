"""The particle filter: refresh, move, propose, weigh. Every method is a choice of stages."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench import native
from pfbench.covariance import common_covariance_of, covariance_of, squared_length
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, Info, weights
from pfbench.filter.derived_draws import named
from pfbench.filter.gaussian import around_first
from pfbench.filter.linearisation import where_seen
from pfbench.filter.moves import Move, together
from pfbench.filter.points import Independent, Points
from pfbench.filter.preferences import Preference, Weights
from pfbench.filter.proposals import Bootstrap, Proposal
from pfbench.filter.resamplers import Resample, Resampler, Systematic
from pfbench.filter.sizes import Fixed, Size
from pfbench.filter.weights import Bayes, Weighing
from pfbench.filter.window import Keeper
from pfbench.fusion import fusible, recording
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.record import Record


class Told(NamedTuple):
    """What a step tells beside the cloud.

    Attributes:
        mean, variance: of the cloud [R, D], [R, d].
        expected: log weights before what was seen [R, N], not normalised.
        trace: {name: [R]}.
    """

    mean: Tensor
    variance: Tensor
    expected: Tensor
    trace: dict[str, Tensor]


class Stage(Protocol):
    """What every stage says of itself."""

    @property
    def exact(self) -> bool:
        """Does the cloud that it leaves still target what it should, as N grows?"""


@dataclass(frozen=True)
class ParticleFilter:
    """A recipe; it holds no particles.

    Resampling comes at the START of a step, so the belief handed out is always the weighted one and the log evidence is the
    sum of one line.

    Args:
        particles: N, the number of slots.
        resampler, size, preference, moves, proposal, weigh: the stages; the defaults make the SIR filter.
        points: where the particles of the initial law come from; stages have points of their own.

    Raises:
        ValueError: fewer than two particles; moves of a past after a resampler that does not copy particles with theirs, or
            that cannot share one.
    """

    particles: int
    resampler: Resampler = field(default_factory=lambda: Resample(Systematic()))
    size: Size = field(default_factory=Fixed)
    preference: Preference = field(default_factory=Weights)
    moves: tuple[Move, ...] = ()
    proposal: Proposal = field(default_factory=Bootstrap)
    weigh: Weighing = field(default_factory=Bayes)
    points: Points = field(default_factory=Independent)

    def __post_init__(self) -> None:
        if self.particles < 2:
            raise ValueError(f"filter.particles={self.particles}: give at least 2 particles")
        if self.keeper is not None and not isinstance(self.resampler, Resample):
            name = type(self.resampler).__name__
            raise ValueError(f"filter.resampler={name}: moves need particles that are copied with their past; choose Resample")

    @property
    def exact(self) -> bool:
        """Does the weighted cloud target p(x_t | y_1:t) as N grows? True if every stage says so."""
        stages: list[Stage] = [self.resampler, *self.moves, self.proposal, self.weigh]
        return all(stage.exact for stage in stages)

    @property
    def keeper(self) -> Keeper | None:
        """What particles carry of their past: exactly what the moves ask for."""
        return together(self.moves)

    def init(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None = None, spread: Tensor | None = None
    ) -> Cloud:
        """N equally weighted particles of the initial law, drawn by its Cholesky factor or its scales."""
        law: Any = initial_law(model, runs, spread)
        z = self.points(draws).normal("initial", self.particles, model.chart.dimension)
        if isinstance(law, torch.distributions.MultivariateNormal):
            spread = z @ law.scale_tril.mT
        else:
            spread = z * law.stddev.unsqueeze(1)
        origin = model.origin.expand(1, -1) if start is None else start
        x = model.chart.add(origin.unsqueeze(1), law.mean.unsqueeze(1) + spread)
        first = self.size.first(self.particles)
        log_w = torch.full(x.shape[:2], -math.log(first), dtype=x.dtype, device=x.device)
        log_w[:, first:] = -torch.inf
        cloud = Cloud(x=x, log_w=log_w, log_z=torch.zeros_like(log_w[:, 0], dtype=torch.float64))
        if self.keeper is None:
            return cloud
        mean = model.chart.add(origin, law.mean)
        return self.keeper.begin(model, cloud, mean.expand(runs, -1), covariance_of(law).expand(runs, -1, -1))

    def step(self, model: StateSpaceModel, belief: Cloud, seen: Record, draws: Draws) -> tuple[Cloud, Info]:
        """The cloud at t-1 and what is seen at t -> the weighted cloud at t."""
        cloud, told = self.advance(model, belief, seen, draws)
        return cloud, self.tell(model, cloud, told, lambda: seen)

    def advance(self, model: StateSpaceModel, belief: Cloud, seen: Record, draws: Draws) -> tuple[Cloud, Told]:
        """The same, tensors alone."""
        trace: dict[str, Tensor] = {}
        log_a = self.preference(model, belief, seen)
        cloud, trace["resampled"] = self.resampler(model, belief, log_a, self.size(belief), draws)
        if cloud.copy_of is not None:
            trace["ancestors"] = distinct(cloud.copy_of, cloud.log_w)
        for i, move in enumerate(self.moves):
            cloud, trace[f"accepted_{i}"] = move(model, cloud, trace["resampled"], named(draws, f"move_{i}."))
        if self.moves and cloud.copy_of is not None:
            trace["unique"] = distinct(cloud.copy_of, cloud.log_w)
        x, log_ratio, memory, w, told = self.proposal(model, cloud, seen, draws)
        log_w = self.weigh(model, cloud.log_w, x, log_ratio, seen)
        x, log_w = bury(x, log_w, cloud.x)
        expected = cloud.log_w + log_ratio
        # a lost run stays lost (its evidence is -inf for good) but goes on with flat weights, so that nothing else breaks
        log_w, total, heft, trace["ess"] = _normalise(log_w)
        if not isinstance(self.size, Fixed):
            trace["particles"] = (cloud.log_w > -torch.inf).sum(1).to(log_w)
        parents, keeper = cloud, self.keeper
        cloud = cloud._replace(x=x, log_w=log_w, log_z=belief.log_z + total, memory=memory, copy_of=None)
        if keeper is not None:
            cloud = keeper.follow(model, parents, cloud, w, seen)
        return cloud, Told(*mean_and_variance(model, cloud, heft), expected, trace | told)

    def tell(self, model: StateSpaceModel, cloud: Cloud, told: Told, seen: Callable[[], Record]) -> Info:
        """For the report, which seldom asks for what was `seen`."""

        def nis() -> tuple[Tensor, Tensor]:
            return surprise(model, cloud.x, told.expected, seen())

        return described(model, cloud, told.mean, told.variance, told.trace, nis)


def _normalise(log_w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Log weights -> normalised (flat where none is finite), logsumexp (then -inf) [R], the weights, their effective number [R].

    One exponential for each particle: they cost more than all else of a small step that is not drawn or copied.
    """
    top = log_w.detach().amax(1, keepdim=True)
    top = torch.where(torch.isfinite(top), top, 0.0)
    part = torch.exp(log_w - top)
    whole, square = _totals(part)
    lost = ~(torch.isfinite(whole) & (whole > 0.0))
    whole, slots = torch.where(lost, 1.0, whole), log_w.shape[1]
    total = top + torch.log(whole)
    log_w, heft = torch.where(lost, -math.log(slots), log_w - total), torch.where(lost, 1.0 / slots, part * (1.0 / whole))
    ess = torch.where(lost, slots, whole * whole / square).squeeze(1)
    return log_w, torch.where(lost, -torch.inf, total).squeeze(1), heft, ess


def _separate_totals(part: Tensor) -> tuple[Tensor, Tensor]:
    """Sums of parts [R, N], and of their squares: [R, 1] each."""
    return part.sum(1, keepdim=True), part.square().sum(1, keepdim=True)


def _long(a: Tensor, *_: Tensor) -> bool:
    """Rows [R, N, ...] that torch's compiler sums through memory, for precision; shorter ones it sums best itself."""
    return a.shape[1] > 4096


_totals = fusible(_separate_totals, by_hand=native.totals, whole=_long)


def surprise(model: StateSpaceModel, x: Tensor, log_w: Tensor, seen: Record) -> tuple[Tensor, Tensor]:
    """Normalised innovation squared [R] of a predicted cloud x [R, N, D], log weights [R, N]; components seen [R]."""
    law: Any = model.observation(x, seen.u)
    w, there = weights(log_w).unsqueeze(-1), ~torch.isnan(seen.y)
    y_hat = around_first(model.residual)(law.mean, w.squeeze(-1))
    off = torch.where(w > 0.0, model.residual(law.mean, y_hat.unsqueeze(1)), 0.0)
    own = common_covariance_of(law)
    noise = (w.unsqueeze(-1) * own).sum(1) if own.shape[1] > 1 else own[:, 0]
    r = torch.where(there, model.residual(seen.y.nan_to_num(), y_hat), 0.0)
    every = torch.arange(off.shape[-1], device=off.device).unsqueeze(0)
    spread = _spread(off, torch.zeros_like(y_hat), w.squeeze(-1), every).squeeze(1)
    return squared_length(r, where_seen(spread + noise, there)), there.sum(1)


def _marked(copy_of: Tensor, log_w: Tensor) -> Tensor:
    """How many values there are in copy_of [R, N], below 2 N, at the slots that hold a particle: [R]."""
    marks = torch.zeros(len(copy_of), 2 * copy_of.shape[1], dtype=log_w.dtype, device=log_w.device)
    return (marks.scatter_add_(1, copy_of, (log_w > -torch.inf).to(log_w.dtype)) > 0.0).sum(1)


distinct = fusible(_marked, by_hand=native.distinct)


def bury(x: Tensor, log_w: Tensor, parents: Tensor) -> tuple[Tensor, Tensor]:
    """A particle that is not finite weighs nothing and stays where its parent was.

    Sums over particles would otherwise turn one NaN into the estimate of its run: 0 NaN is NaN.
    """
    if recording():  # whoever runs the graph looks, and does the step again
        return x, log_w
    if not x.is_cuda and bool(torch.isfinite(x.sum())):  # looking costs next to nothing on the CPU
        return x, log_w
    healthy = torch.isfinite(x.sum(-1))
    log_w = torch.where(healthy, log_w, -torch.inf)
    return torch.where(healthy, x.permute(2, 0, 1), parents.permute(2, 0, 1)).permute(1, 2, 0), log_w


def summarise(model: StateSpaceModel, cloud: Cloud, trace: dict[str, Tensor]) -> Info:
    """Estimate and spread of a cloud, for the report: sums over particles, no copy of the cloud is kept."""
    return described(model, cloud, *mean_and_variance(model, cloud, weights(cloud.log_w)), trace)


def mean_and_variance(model: StateSpaceModel, cloud: Cloud, w: Tensor) -> tuple[Tensor, Tensor]:
    """Of a cloud with weights w [R, N]: [R, D] and, in the chart about the mean, [R, d]."""
    if model.chart.flat:
        mean, variance = _flat_moments(cloud.x, w)
        return mean, variance
    mean = model.chart.mean(cloud.x, w)
    return mean, (w.unsqueeze(-2) @ model.chart.subtract(cloud.x, mean.unsqueeze(1)).square()).squeeze(-2)


def described(
    model: StateSpaceModel,
    cloud: Cloud,
    mean: Tensor,
    variance: Tensor,
    trace: dict[str, Tensor],
    nis: Callable[[], tuple[Tensor, Tensor]] | None = None,
) -> Info:
    """What a report wants of a cloud whose mean and variance are known."""

    def deviations() -> tuple[Tensor, Tensor]:
        return model.chart.subtract(cloud.x, mean.unsqueeze(1)), cloud.log_w

    def covariance() -> Tensor:
        d, log_w = deviations()
        return (weights(log_w).unsqueeze(-1) * d).mT @ d

    @cache
    def w() -> Tensor:  # for groups of each size, and without another sum over what sums to 1
        return torch.exp(cloud.log_w)

    def some(groups: Tensor) -> Tensor:
        if model.chart.flat:
            return _spread(cloud.x, mean, w(), groups)
        return _spread(deviations()[0], torch.zeros_like(variance), w(), groups)

    return Info(mean, variance, covariance, trace, deviations, nis, some)


def _separate_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    mean = w.unsqueeze(-2) @ x
    d = x - mean
    return mean.squeeze(-2), (w.unsqueeze(-2) @ (d * d)).squeeze(-2)


def _fused_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Weighted mean and variance [R, D] of plain numbers [R, N, D] by weights [R, N]."""
    parts = x.permute(2, 0, 1)
    mean = (w * parts).sum(-1)
    d = parts - mean.unsqueeze(-1)
    return mean.T, (w * d * d).sum(-1).T


def _separate_spread(x: Tensor, mean: Tensor, w: Tensor, groups: Tensor) -> Tensor:
    """Covariance of groups of components [G, s] of plain numbers [R, N, k], by mean [R, k] and weights [R, N] -> [R, G, s, s]."""
    own = x.permute(0, 2, 1)[:, groups] - mean[:, groups].unsqueeze(-1)  # [R, G, s, N]
    return (w[:, None, None] * own) @ own.mT


_spread = fusible(_separate_spread, by_hand=native.spread, whole=False)
_flat_moments = fusible(_fused_moments, eager=_separate_moments, by_hand=native.moments, whole=_long)
