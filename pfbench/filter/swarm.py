"""Particle swarms: after the prediction, particles fly towards what has been seen, and are then weighed.

A swarm remembers the best place of each particle and of all, and a velocity. Gaussian attraction [Krohling 2004] makes the
swarm-optimised particle filter (PSO-PF); inertia, chaotic perturbation and the flight from the worst places are those of
[Tian et al., "Improved adaptive particle filter for integrated navigation system"]. As printed, particles are weighed as if
they had not been moved: the measurement counts twice and the prediction not at all, and the estimate becomes the measurement.
Taken as a proposal with a known density (`Mixture`) the finished swarm does no such harm [ours].
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cache
from typing import Any, NamedTuple, Protocol

import torch
from scipy import stats
from torch import Tensor

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, weights
from pfbench.filter.chaos import Perturbation, Prior, Start, logistic, seeds, settled
from pfbench.filter.particle import bury
from pfbench.filter.proposals import Proposed, draw_noise
from pfbench.filter.reconstruction import derivative
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record

_PAIRS, _PAIRS_CUDA = 2**17, 2**27  # distances held at a time: those of a CPU stay in its cache, ten times faster


class Frame(NamedTuple):
    """The k coordinates in which a swarm flies, those of the chart about the predicted mean or linear in them.

    Attributes:
        q: of the predicted cloud [R, N, k].
        covariance: of the predicted cloud in them [R, k, k].
        components: of the chart, that they are or that they whiten [k].
        place: q [R, N, k] -> states [R, N, D].
    """

    q: Tensor
    covariance: Tensor
    components: Tensor
    place: Callable[[Tensor], Tensor]


class Coordinates(Protocol):
    """Predicted particles x [R, N, D] with weights w [R, N] -> in which coordinates they fly."""

    @property
    def white(self) -> bool: ...

    def __call__(self, model: StateSpaceModel, x: Tensor, w: Tensor, u: Any) -> Frame: ...


@dataclass(frozen=True)
class Everything:
    """All components of the chart, as the paper has it. Those that the measurement does not see are dragged along blindly."""

    white = False

    def __call__(self, model: StateSpaceModel, x: Tensor, w: Tensor, u: Any) -> Frame:
        chart = model.chart
        mean = chart.mean(x, w).unsqueeze(1)
        c = chart.subtract(x, mean)
        index = torch.arange(c.shape[-1], device=c.device)
        return Frame(c, (w.unsqueeze(-1) * c).mT @ c, index, lambda q: chart.add(mean, q))


@dataclass(frozen=True)
class Observed:
    """The components o that the measurement depends on; the others follow by their regression on o in the cloud [ours].

    Args:
        follow: the others move by S_uo S_oo^-1 (o' - o), so that what o does not tell of them is left as it is; else they stay.
        white: fly in a = L^-1 o, L L' = S_oo, in which the cloud is as wide in all directions.
    """

    follow: bool = True
    white: bool = False

    def __call__(self, model: StateSpaceModel, x: Tensor, w: Tensor, u: Any) -> Frame:
        chart = model.chart
        mean = chart.mean(x, w).unsqueeze(1)
        c = chart.subtract(x, mean)
        index = observed(model, mean, u)
        o = c[..., index]
        joint = (w.unsqueeze(-1) * o).mT @ c  # [R, k, d]
        covariance = joint[..., index]
        root = _root(covariance)
        eye = torch.eye(len(index), dtype=c.dtype, device=c.device)
        along = torch.linalg.solve_triangular(root, joint, upper=False)  # d c / d a, transposed [R, k, d]
        if not self.follow:
            along = along.new_zeros(along.shape)
        along = along.index_copy(-1, index, (root * (o.square().sum(1) > 0.0).unsqueeze(-1)).mT)
        if self.white:
            o, covariance = torch.linalg.solve_triangular(root, o.mT, upper=False).mT, eye.expand_as(covariance)
        else:
            along = torch.linalg.solve_triangular(root.mT, along, upper=True).index_copy(-1, index, eye.expand_as(covariance))
        return Frame(o, covariance, index, lambda q: chart.add(mean, c + (q - o) @ along))


class Fitness(Protocol):
    """A frame -> what is added to the log likelihood at q [R, N, k] -> [R, N]."""

    def __call__(self, frame: Frame) -> Callable[[Tensor], Tensor]: ...


@dataclass(frozen=True)
class Likelihood:
    """Nothing: ln Y = ln p(y | x), what eq. 37 means; its print is linear in the residual and has no maximum."""

    def __call__(self, frame: Frame) -> Callable[[Tensor], Tensor]:
        return lambda q: q.new_zeros(q.shape[:-1])


@dataclass(frozen=True)
class Posterior:
    """The log density of the normal law that has the predicted cloud's moments: the swarm seeks a posterior mode [ours].

    Args:
        shrink: of the covariance towards its diagonal, for clouds of few particles.
    """

    shrink: float = 0.05

    def __post_init__(self) -> None:
        if not 0.0 <= self.shrink <= 1.0:
            raise ValueError(f"fitness.shrink={self.shrink}: give a fraction from 0 to 1")

    def __call__(self, frame: Frame) -> Callable[[Tensor], Tensor]:
        s = frame.covariance
        root = _root(s + self.shrink * (torch.diag_embed(s.diagonal(dim1=-2, dim2=-1)) - s))
        return lambda q: -0.5 * torch.linalg.solve_triangular(root, q.mT, upper=False).square().sum(-2)


class Flock(NamedTuple):
    """A swarm in flight: places, velocities, best and worst places so far, chaotic values [R, N, k]; fitness of each [R, N]."""

    q: Tensor
    v: Tensor
    fitness: Tensor
    best: Tensor
    best_fitness: Tensor
    worst: Tensor
    worst_fitness: Tensor
    chaos: Tensor

    def leader(self) -> Tensor:
        """The best place so far [R, 1, k]."""
        return _pick(self.best, self.best_fitness.argmax(1))

    def last(self, live: Tensor) -> Tensor:
        """The worst place at present [R, 1, k]."""
        return _pick(self.q, torch.where(live, self.fitness, torch.inf).argmin(1))


class Velocity(Protocol):
    """The next velocities [R, N, k]; `phase` goes from 0 to 1 over the iterations."""

    def __call__(self, flock: Flock, live: Tensor, phase: float, draws: Draws, purpose: str) -> Tensor: ...


@dataclass(frozen=True)
class Gaussian:
    """|n1| (pbest - x) + |n2| (gbest - x), n ~ N(0, 1) [Krohling 2004; Tian et al., eq. 29]. No inertia, nothing to tune."""

    def __call__(self, flock: Flock, live: Tensor, phase: float, draws: Draws, purpose: str) -> Tensor:
        n, k = flock.q.shape[1:]
        own, common = draws.normal(purpose, n, 2 * k).abs().unflatten(-1, (2, k)).unbind(-2)
        return own * (flock.best - flock.q) + common * (flock.leader() - flock.q)


@dataclass(frozen=True)
class Inertia:
    """w v + c1 r1 (pb - x) + c2 r2 (pg - x) - c3 (r3 (pw - x) + r4 (gw - x)), r ~ U(0, 1) [Tian et al., eqs. 27 and 34].

    c3 = escape (1 - cos(pi it / iterations)), which rises from 0 to twice `escape`: what eq. 35 means. Its print is constant but
    for ripples, and its figure rises.

    Args:
        inertia: w.
        own, common: c1 and c2, which the paper does not give. Mean-square stability asks for c1 + c2 < 24 (1 - w^2) / (7 - 5 w)
            [Poli 2009], 2.88 for w = 0.8; the customary 2 each is unstable. [ours]
        escape: 0 for the plain swarm.

    Raises:
        ValueError: an inertia outside [0, 1), negative numbers.
    """

    inertia: float = 0.8
    own: float = 1.2
    common: float = 1.2
    escape: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 <= self.inertia < 1.0:
            raise ValueError(f"velocity.inertia={self.inertia}: give a number from 0 to below 1")
        if min(self.own, self.common, self.escape) < 0.0:
            raise ValueError(f"velocity: own={self.own}, common={self.common}, escape={self.escape}; give 0 or more")

    def escape_factor(self, phase: float) -> float:
        """c3 = c4."""
        return self.escape * (1.0 - math.cos(math.pi * phase))

    def __call__(self, flock: Flock, live: Tensor, phase: float, draws: Draws, purpose: str) -> Tensor:
        n, k = flock.q.shape[1:]
        pulls = 4 if self.escape else 2
        r = draws.uniform(purpose, n, pulls * k).to(flock.q.dtype).unflatten(-1, (pulls, k)).unbind(-2)
        v = self.inertia * flock.v + self.own * r[0] * (flock.best - flock.q) + self.common * r[1] * (flock.leader() - flock.q)
        if self.escape:
            away = r[2] * (flock.worst - flock.q) + r[3] * (flock.last(live) - flock.q)
            v = v - self.escape_factor(phase) * away
        return v


@dataclass(frozen=True)
class Limits:
    """What keeps a swarm from flying apart, in scales of each coordinate; the paper only names v_max [ours].

    Never taken from the swarm in flight: its shrinking and growing would feed back.

    Args:
        prior: the scale is the initial cloud's standard deviation, the paper's recorded interval; else the predicted cloud's.
        speed: v_max over six scales.
        box: places stay within so many standard deviations of the predicted cloud about its mean; None for anywhere.

    Raises:
        ValueError: a speed or box that is not positive.
    """

    prior: bool = False
    speed: float = 0.5
    box: float | None = 3.0

    def __post_init__(self) -> None:
        if not self.speed > 0.0 or (self.box is not None and not self.box > 0.0):
            raise ValueError(f"limits: speed={self.speed}, box={self.box}; give positive numbers (or box=null for none)")


@dataclass(frozen=True)
class ChiSquare:
    """Stops a run whose best particle is as close to the measurement as the truth would be [ours].

    Its distance, -2 ln p(y | x) + 2 ln p(y_hat | x), is to be at most this quantile of chi-square with as many degrees of freedom
    as components were seen: 5.35 for six and the median. The paper does not give its epsilon.
    """

    quantile: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.quantile < 1.0:
            raise ValueError(f"stop.quantile={self.quantile}: give a probability between 0 and 1")

    def __call__(self, model: StateSpaceModel, best: Tensor, seen: Record) -> Tensor:
        """Best states [R, 1, D] -> which runs stop [R]."""
        y_hat: Tensor = model.observation(best, seen.u).mean[:, 0]
        there = ~torch.isnan(seen.y)
        nearest = model.log_likelihood(torch.where(there, y_hat, torch.nan), best, seen.u)
        distance = 2.0 * (nearest - model.log_likelihood(seen.y, best, seen.u))[:, 0]
        bounds = distance.new_tensor(_quantiles(self.quantile, there.shape[-1]))
        return distance <= bounds[there.sum(-1)]


class Weights(Protocol):
    """Where the swarm ended, q [R, N, k] with log likelihood [R, N] -> where particles go and their log p - log q."""

    @property
    def exact(self) -> bool: ...

    def __call__(
        self, frame: Frame, q: Tensor, log_likelihood: Tensor, log_w: Tensor, draws: Draws
    ) -> tuple[Tensor, Tensor]: ...


@dataclass(frozen=True)
class Printed:
    """The move is ignored [Tian et al., eqs. 38 and 45]. Does not converge to the posterior."""

    exact = False

    def __call__(self, frame: Frame, q: Tensor, log_likelihood: Tensor, log_w: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
        return q, torch.zeros_like(log_w)


@dataclass(frozen=True)
class Equal:
    """Weights stay what they were: takes back the likelihood that `Bayes` will put on. Shows what the swarm alone does [ours]."""

    exact = False

    def __call__(self, frame: Frame, q: Tensor, log_likelihood: Tensor, log_w: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
        return q, torch.where(torch.isfinite(log_likelihood), -log_likelihood, 0.0)


@dataclass(frozen=True)
class Mixture:
    """The finished swarm is the centres of a proposal; a fraction of the predicted cloud is kept as it is [ours].

    In whitened coordinates a, p = N(0, I) for the prediction, m_j for the swarm, and h the optimal Gaussian bandwidth of N points
    in k dimensions [Silverman 1986]:

        log ratio = log p(a) - log(keep p(a) + (1 - keep) sum_j w_j N(a; m_j, h^2 I)),

    a deterministic mixture, at most -log keep. Converges to the posterior where the predicted cloud is normal, as on
    linear-Gaussian models, and all that the measurement does not see follows (`Observed`); elsewhere p is an approximation.
    Costs N^2 k. In many dimensions few particles carry all the weight: not for 18.

    Args:
        keep: fraction kept; who is, is drawn afresh in each step, since neighbours in a resampled cloud are siblings. 1 makes
            it the bootstrap filter.

    Raises:
        ValueError: a fraction that is not above 0 and at most 1.
    """

    keep: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.keep <= 1.0:
            raise ValueError(f"weights.keep={self.keep}: give a fraction above 0, up to 1")

    @property
    def exact(self) -> bool:
        return self.keep == 1.0

    def __call__(self, frame: Frame, q: Tensor, log_likelihood: Tensor, log_w: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
        n, k = q.shape[1:]
        root = _root(frame.covariance)
        before, centres = (torch.linalg.solve_triangular(root, e.mT, upper=False).mT for e in (frame.q, q))
        live = torch.isfinite(log_w)
        count = live.sum(1, keepdim=True).to(q.dtype)
        lot = torch.where(live, draws.uniform("swarm.keep", n, 1).squeeze(-1), torch.inf)
        wanted = torch.round(self.keep * count)
        kept = (lot.argsort(1).argsort(1) < wanted) | ~live
        share = wanted / count
        h = (4.0 / (k + 2)) ** (1.0 / (k + 4)) * count ** (-1.0 / (k + 4))  # [R, 1]
        a = centres + h.unsqueeze(-1) * draws.normal("swarm.kernel", n, k)
        a = torch.where(kept.unsqueeze(-1), before, a)
        log_p = -0.5 * a.square().sum(-1)
        log_g = _kernels(a / h.unsqueeze(-1), centres / h.unsqueeze(-1), torch.log_softmax(log_w, 1)) - k * torch.log(h)
        log_ratio = log_p - torch.logaddexp(log_p + torch.log(share), log_g + torch.log1p(-share))
        return torch.where(kept.unsqueeze(-1), frame.q, a @ root.mT), log_ratio


@dataclass(frozen=True)
class Swarm:
    """Predicts as the bootstrap filter does, then lets the particles fly [Tian et al., steps a to f].

    A run in which nothing is seen does not fly, nor does it from where it has met `stop`. Chaotic sequences belong to slots: were
    they gathered with the particles, siblings would have the same one [ours].

    Args:
        velocity: how they fly.
        perturbation: chaotic, or None.
        fitness: what they seek.
        coordinates: in which coordinates.
        limits: of speed and place.
        stop: when a run stops before the last iteration, or None.
        iterations: at most.
        start: the particles of the very first step.
        weights: what becomes of their weights.

    Raises:
        ValueError: fewer than 1 iteration; limits by the initial cloud in whitened coordinates.
    """

    velocity: Velocity = field(default_factory=lambda: Inertia(escape=0.12))
    perturbation: Perturbation | None = field(default_factory=Perturbation)
    fitness: Fitness = field(default_factory=Posterior)
    coordinates: Coordinates = field(default_factory=lambda: Observed(white=True))
    limits: Limits = field(default_factory=Limits)
    stop: ChiSquare | None = None
    iterations: int = 5
    start: Start = field(default_factory=Prior)
    weights: Weights = field(default_factory=Mixture)

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"proposal.iterations={self.iterations}: give at least 1")
        if self.limits.prior and self.coordinates.white:
            raise ValueError("proposal.limits.prior=true: whitened coordinates have no scale at first; make one of them false")

    @property
    def exact(self) -> bool:
        return self.start.exact and self.weights.exact

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        parents, memory = self._begun(model, cloud, draws)
        w = draw_noise(model, parents.shape[1], draws)
        x, log_w = bury(model.propagate(parents, seen.u, w), cloud.log_w, parents)
        frame = self.coordinates(model, x, weights(log_w), seen.u)
        flock, _ = self.fly(model, frame, torch.isfinite(log_w), memory, seen, draws)
        here = model.log_likelihood(seen.y, frame.place(flock.q), seen.u)
        q, log_ratio = self.weights(frame, flock.q, here, log_w, draws)
        if self.perturbation:
            chaos = memory["swarm.chaos"].index_copy(-1, frame.components, flock.chaos.unsqueeze(1))
            memory = memory | {"swarm.chaos": chaos}
        return Proposed(frame.place(q), torch.where(torch.isfinite(log_w), log_ratio, -torch.inf), memory)

    def fly(
        self, model: StateSpaceModel, frame: Frame, live: Tensor, memory: dict[str, Tensor], seen: Record, draws: Draws
    ) -> tuple[Flock, Tensor]:
        """The finished swarm, and after how many iterations each run stopped [R].

        Args:
            frame: the predicted cloud.
            live: which slots hold a particle [R, N].
            memory: the initial cloud's scale [R, 1, d] and chaotic values [R, 1, N, d], where they are needed.
        """
        penalty = self.fitness(frame)

        def fitness(q: Tensor) -> Tensor:
            value = model.log_likelihood(seen.y, frame.place(q), seen.u) + penalty(q)
            return torch.where(live & ~torch.isnan(value), value, -torch.inf)

        flock = self._gathered(frame, fitness(frame.q), memory)
        spread = frame.covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt().unsqueeze(1)
        scale = memory["swarm.scale"][..., frame.components] if self.limits.prior else spread
        spare = seeds(draws.uniform("swarm.spare", *frame.q.shape[1:])) if self.perturbation else None
        active = ~torch.isnan(seen.y).all(1)
        flown = torch.zeros_like(active, dtype=torch.long)
        for i in range(1, self.iterations + 1):
            if not active.is_cuda and not bool(active.any()):
                break
            v = self.velocity(flock, live, i / self.iterations, draws, f"swarm.velocity.{i}")
            flown = flown + active
            flock = _where(active, self._moved(flock, v, fitness, scale, spread, spare), flock)
            if self.stop:
                best = flock.best_fitness.argmax(1)
                active = active & ~self.stop(model, _pick(frame.place(flock.best), best), seen)
        return flock, flown

    def _moved(
        self, flock: Flock, v: Tensor, fitness: Callable[[Tensor], Tensor], scale: Tensor, spread: Tensor, spare: Tensor | None
    ) -> Flock:
        """One iteration: x + v or, if it is fitter, x + v + Dx; and what is to be remembered of it."""
        fastest, chaos = 6.0 * self.limits.speed * scale, flock.chaos
        v = torch.minimum(torch.maximum(v, -fastest), fastest)
        q = self._boxed(flock.q + v, spread)
        value = fitness(q)
        if self.perturbation and spare is not None:
            chaos = logistic(chaos, spare)
            other = self._boxed(flock.q + v + self.perturbation(chaos, scale), spread)
            there = fitness(other)
            q = torch.where((there > value).unsqueeze(-1), other, q)
            value = torch.maximum(there, value)
        better, worse = value > flock.best_fitness, value < flock.worst_fitness
        best, worst = (torch.where(a.unsqueeze(-1), q, b) for a, b in ((better, flock.best), (worse, flock.worst)))
        best_fitness, worst_fitness = torch.maximum(value, flock.best_fitness), torch.minimum(value, flock.worst_fitness)
        return Flock(q, v, value, best, best_fitness, worst, worst_fitness, chaos)

    def _boxed(self, q: Tensor, spread: Tensor) -> Tensor:
        if self.limits.box is None:
            return q
        edge = self.limits.box * spread
        return torch.minimum(torch.maximum(q, -edge), edge)

    def _gathered(self, frame: Frame, fitness: Tensor, memory: dict[str, Tensor]) -> Flock:
        """The swarm before its first iteration: what the step before remembered is forgotten, but for the chaotic values."""
        q = frame.q
        chaos = memory["swarm.chaos"][:, 0].index_select(-1, frame.components) if self.perturbation else q.new_zeros(len(q), 1, 1)
        return Flock(q, torch.zeros_like(q), fitness, q, fitness, q, fitness, chaos)

    def _begun(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Tensor, dict[str, Tensor]]:
        """Parents [R, N, D] and memory; at the very first step, the particles that the filter starts from."""
        if "swarm.scale" in cloud.memory:
            return cloud.x, cloud.memory
        chart = model.chart
        z = settled(draws.uniform("swarm.chaos", cloud.x.shape[1], chart.dimension))
        w = weights(cloud.log_w)
        c = chart.subtract(cloud.x, chart.mean(cloud.x, w).unsqueeze(1))
        memory = cloud.memory | {"swarm.scale": (w.unsqueeze(-1) * c * c).sum(1, keepdim=True).sqrt()}
        if self.perturbation:
            memory = memory | {"swarm.chaos": z.unsqueeze(1)}
        return self.start(model, cloud, z), memory


def observed(model: StateSpaceModel, mean: Tensor, u: Any) -> Tensor:
    """Components of the chart that the measurement's mean or variance depends on, by its derivative at mean [R, 1, D] -> [k]."""
    d = model.chart.dimension
    centre = mean.expand(-1, d, -1)

    def law(xi: Tensor) -> Tensor:
        seen: Any = model.observation(model.chart.add(centre, xi), u)
        return torch.cat([seen.mean, seen.variance], -1)

    slope = derivative(law, mean, d).nan_to_num()  # [R, 1, 2 Dy, d]
    return (slope != 0.0).flatten(0, 2).any(0).nonzero().squeeze(-1)


@cache
def _quantiles(p: float, most: int) -> list[float]:
    """Of chi-square with 0 to `most` degrees of freedom."""
    return [0.0, *(float(stats.chi2.ppf(p, k)) for k in range(1, most + 1))]


def _root(covariance: Tensor) -> Tensor:
    """Cholesky factor [R, k, k] to solve with: 1 where a component has no spread; NaN, which loses the run, if there is none."""
    root, ok = factor(covariance)
    flat = root.diagonal(dim1=-2, dim2=-1) == 0.0
    return torch.where(ok[:, None, None], root + torch.diag_embed(flat.to(root.dtype)), torch.nan)


def _kernels(a: Tensor, centres: Tensor, log_w: Tensor) -> Tensor:
    """log sum_j w_j exp(-|a - m_j|^2 / 2): a [R, N, k], centres [R, M, k], log_w [R, M] -> [R, N]; N M numbers at a time."""
    rows = max(1, (_PAIRS_CUDA if a.is_cuda else _PAIRS) // (centres.shape[0] * centres.shape[1]))
    base = (log_w - 0.5 * centres.square().sum(-1)).unsqueeze(1)
    parts = [torch.baddbmm(base, part, centres.mT).logsumexp(-1) for part in a.split(rows, 1)]
    return torch.cat(parts, 1) - 0.5 * a.square().sum(-1)


def _pick(q: Tensor, i: Tensor) -> Tensor:
    """q [R, N, k], i [R] -> [R, 1, k]."""
    return q.gather(1, i[:, None, None].expand(-1, 1, q.shape[-1]))


def _where(active: Tensor, new: Flock, old: Flock) -> Flock:
    """Run by run."""
    return Flock(*(torch.where(active.reshape(-1, *[1] * (a.dim() - 1)), a, b) for a, b in zip(new, old, strict=True)))
