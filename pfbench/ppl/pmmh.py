"""Particle marginal Metropolis-Hastings: a random walk in the unknown numbers, a filter run for every step of it.

All chains walk at once, as runs of one batch: the Python loop is over iterations alone. Each chain has a model of its own, and
`Apiece` maps a model over them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.draws import Draws, MonteCarlo
from pfbench.filter.belief import Cloud, Filter, gather
from pfbench.filter.derived_draws import named
from pfbench.filter.loop import run_filter
from pfbench.filter.resamplers import Resampler
from pfbench.model.base import StateSpaceModel
from pfbench.ppl.posterior import Posterior
from pfbench.ppl.program import Law, Unknown
from pfbench.record import Record, map_inputs

_ASKED = 0.25  # acceptance that the walk's size is tuned to: near the optimum for few dimensions and a noisy likelihood
_TRIES = 20
_FREEDOM = 5  # of the t law of leaps: tails heavier than the posterior's, so that no chain is left behind in one


@dataclass(frozen=True, eq=False)
class Held:
    """Draws of an iteration that remember those of the last one accepted: the correlated variant.

    A proposed normal is rho u + sqrt(1 - rho^2) e, which leaves N(0, I) invariant, so that estimates of the likelihood before
    and after move together and their ratio is less noisy [Deligiannidis, Doucet and Pitt 2018]. A uniform is Phi of a normal.

    Args:
        fresh: draws e of this iteration.
        rho: correlation, 0 for the plain algorithm.
        kept: those of the chains' last accepted iteration {(step, purpose, n, w): [R, n, w]}.
        proposed: is filled with those of this one.
    """

    fresh: Draws
    rho: float
    kept: dict[tuple[int, str, int, int], Tensor]
    proposed: dict[tuple[int, str, int, int], Tensor] = field(default_factory=dict)
    step: int = 0

    @property
    def dtype(self) -> torch.dtype:
        return self.fresh.dtype

    def at(self, step: int) -> Held:
        return replace(self, fresh=self.fresh.at(step), step=step)

    def of(self, runs: slice) -> Draws:
        raise ValueError("pmmh: draws that are held belong to all runs together")

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        key, e = (self.step, purpose, n, w), self.fresh.normal(purpose, n, w)
        u = self.kept.get(key)
        self.proposed[key] = e if u is None else self.rho * u + (1.0 - self.rho**2) ** 0.5 * e
        return self.proposed[key]

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return torch.special.ndtr(self.normal("uniform." + purpose, n, w).double()).clamp(1e-12, 1.0 - 1e-12)

    def accept(self, hit: Tensor) -> None:
        """Runs hit [R] keep what was proposed."""
        for key, new in self.proposed.items():
            old = self.kept.get(key)
            self.kept[key] = new if old is None else torch.where(hit[:, None, None], new, old)


@dataclass(frozen=True)
class Ordered:
    """Resamples particles in the order of one component, so that with draws that are held neighbours stay neighbours: without
    it the first resampling undoes the correlation. The law of the filter is the same.

    Args:
        resampler: of the filter.
        component: of the state.
    """

    resampler: Resampler
    component: int = 0

    @property
    def exact(self) -> bool:
        return self.resampler.exact

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        order = torch.where(torch.isfinite(cloud.log_w), cloud.x[..., self.component], torch.inf).argsort(1)
        sorted_cloud = gather(cloud, order)
        log_a = sorted_cloud.log_w if log_a is cloud.log_w else log_a.gather(1, order)
        return self.resampler(model, sorted_cloud, log_a, n, draws)


class _Walk(NamedTuple):
    """What the random walk has learned of the posterior, for each of Q posteriors: mean [Q, P], covariance, log size [Q]."""

    mean: Tensor
    covariance: Tensor
    log_size: Tensor

    def root(self) -> Tensor:
        return torch.linalg.cholesky(self.covariance + 1e-6 * torch.eye(self.mean.shape[-1], dtype=self.mean.dtype))

    def step(self, z: Tensor, own: Draws) -> tuple[Tensor, Tensor]:
        """A proposal around z [C, Q, P], and log q(z | new) - log q(new | z) [C, Q]."""
        e = own.normal("pmmh.walk", 1, z.shape[-1]).view_as(z)
        root = torch.exp(self.log_size)[:, None, None] * self.root()
        return z + (root @ e.unsqueeze(-1)).squeeze(-1), torch.zeros_like(z[..., 0])

    def leap(self, z: Tensor, own: Draws) -> tuple[Tensor, Tensor]:
        """The same for one that does not know where z is: a t law with the posterior's mean and covariance."""
        e, root = own.normal("pmmh.leap", 1, z.shape[-1]).view_as(z), self.root()
        scale = own.normal("pmmh.tail", 1, _FREEDOM).square().mean(-1).view_as(z[..., 0]).rsqrt().unsqueeze(-1)
        before = torch.linalg.solve_triangular(root, (z - self.mean).unsqueeze(-1), upper=False).squeeze(-1)

        def log_q(off: Tensor) -> Tensor:
            return -0.5 * (_FREEDOM + off.shape[-1]) * torch.log1p(off.square().sum(-1) / _FREEDOM)

        return self.mean + scale * (root @ e.unsqueeze(-1)).squeeze(-1), log_q(before) - log_q(scale * e)

    def learned(self, z: Tensor, share: Tensor | None, rate: float) -> _Walk:
        """One step of stochastic approximation, by chains z [C, Q, P] and, of a step, their acceptance share [Q]."""
        d = z - self.mean
        spread = (d.unsqueeze(-1) * d.unsqueeze(-2)).mean(0)
        size = self.log_size if share is None else self.log_size + rate * (share - _ASKED)
        return _Walk(self.mean + rate * d.mean(0), self.covariance + rate * (spread - self.covariance), size)


def pmmh(
    unknown: Unknown, method: Filter, record: Record, draws: int, warmup: int, chains: int = 4, seed: int = 0,
    apart: bool = False, rho: float = 0.0, thin: int = 1, start: Mapping[str, Law] | None = None, leaps: int = 0,
    tick: Callable[[], object] | None = None,
) -> Posterior:  # fmt: skip
    """Draws from p(numbers | y_1:T), exact for any number of particles if the filter's likelihood estimate is unbiased [Andrieu,
    Doucet and Holenstein 2010]. With a Gaussian filter it is plain Metropolis-Hastings on that filter's likelihood.

    The walk is on the whole real line (logarithms of scales), normal with a covariance and a size that are learned in the
    warm-up from all chains of a posterior [Andrieu and Thoms 2008, algorithm 4] and then stay as they are. Chains start from the
    prior, and anew where the filter is lost. Where the posterior is about normal, leaps between the steps of the walk mix better:
    proposals from a t law with the learned mean and covariance, wherever the chain is.

    Args:
        unknown: the model and the prior of its numbers.
        method: any filter. Particles enough for a variance of the log likelihood of about 1 serve best.
        record: measurements [R, T, Dy] and inputs.
        draws: kept from each chain.
        warmup: iterations before.
        chains: for each posterior.
        seed: of everything random.
        apart: every run has numbers of its own, R posteriors; else the runs have one posterior together.
        rho: correlation of the filter's draws from iteration to iteration; memory holds them all. Needs a resampler that is
            `Ordered` and, for more than a few states, helps little.
        thin: iterations for each draw kept.
        start: laws that chains start from and the walk's first covariance is of, by the numbers' names, with the prior's
            supports; wider than the posterior, so that r-hat can tell whether they have met. None takes the prior.
        leaps: after every step of the walk.
        tick: called after each iteration (a progress bar).

    Raises:
        ValueError: no draws or chains, rho outside [0, 1); a start of other numbers; chains that find no start.
    """
    least = {"draws": (draws, 1), "warmup": (warmup, 0), "chains": (chains, 1), "thin": (thin, 1), "leaps": (leaps, 0)}
    for name, (value, low) in least.items():
        if value < low:
            raise ValueError(f"pmmh: {name}={value}; give a whole number, {low} or more")
    if start is not None and set(start) != set(unknown.names):
        raise ValueError(f"pmmh: start of {sorted(start)}; give a law for each of {sorted(unknown.names)}")
    if not 0.0 <= rho < 1.0:
        raise ValueError(f"pmmh: rho={rho}; give a correlation, 0 or more and below 1")
    first = unknown if start is None else Unknown(unknown.make, {name: start[name] for name in unknown.names})
    target = _Target(unknown, first, method, record, chains, seed, apart, rho)
    with torch.no_grad():
        return _walked(target, draws, warmup, thin, leaps, tick)


def _walked(
    target: _Target, draws: int, warmup: int, thin: int, leaps: int, tick: Callable[[], object] | None
) -> Posterior:
    z, log_p = target.start()
    walk = _Walk(z.mean(0), target.first_covariance(), torch.full((z.shape[1],), -0.5, dtype=z.dtype))
    kept, hits = [], torch.zeros_like(log_p)
    for i in range(1, warmup + draws * thin + 1):
        own = MonteCarlo(target.seed, torch.arange(log_p.numel())).at(i)
        stepping = i % (leaps + 1) == 0
        new, log_back = walk.step(z, own) if stepping else walk.leap(z, own)
        log_new, held = target(new, i)
        share = torch.exp(log_new - log_p + log_back).clamp(max=1.0)
        hit = own.uniform("pmmh.accept", 1, 1).view_as(share) < share
        target.keep(held, hit)
        z, log_p = torch.where(hit.unsqueeze(-1), new, z), torch.where(hit, log_new, log_p)
        if i <= warmup:
            walk = walk.learned(z, share.mean(0) if stepping else None, (i + 1.0) ** -0.6)
        else:
            hits += hit
            if (i - warmup) % thin == 0:
                kept.append(z)
        if tick:
            tick()
    values, _ = target.unknown.constrained(torch.stack(kept, 1))  # {name: [C, S, Q]}
    accepted = hits / (draws * thin)
    if not target.apart:
        values, accepted = {name: a[..., 0] for name, a in values.items()}, accepted[:, 0]
    return Posterior(values, accepted, "PMMH")


class _Target:
    """log p(z) + log p(y | z) of chains z [C, Q, P] (Q = R posteriors apart, 1 together), estimated anew at every call."""

    def __init__(
        self, unknown: Unknown, first: Unknown, method: Filter, record: Record, chains: int, seed: int, apart: bool, rho: float
    ) -> None:
        self.unknown, self.first, self.method, self.seed, self.apart, self.rho = unknown, first, method, seed, apart, rho
        self.runs = len(record.y)
        self.shape = (chains, self.runs if apart else 1)
        self.each = 1 if apart else self.runs
        self.record = tiled(record, chains)
        self.kept: dict[tuple[int, str, int, int], Tensor] = {}

    def __call__(self, z: Tensor, iteration: int) -> tuple[Tensor, Held | None]:
        values, log_prior = self.unknown.constrained(z.flatten(0, 1))
        possible = self.unknown.possible(values) & torch.isfinite(log_prior)
        if not bool(possible.all()):  # by any value that a model can be made of: they are refused all the same
            values = {name: torch.where(possible, a, self.somewhere[name]) for name, a in values.items()}
        source: Draws = MonteCarlo(self.seed, torch.arange(possible.numel() * self.each))
        source = named(source, f"pmmh_{iteration}.")
        held = Held(source, self.rho, self.kept) if self.rho else None
        model = self.unknown.apiece(values, self.each)
        log_z = run_filter(self.method, model, self.record, held or source).log_evidence  # type: ignore[arg-type]
        log_z = log_z.view(-1, self.each).sum(1)
        total = torch.where(possible & torch.isfinite(log_z), log_prior + log_z, -torch.inf)
        return total.view(self.shape), held

    def keep(self, held: Held | None, hit: Tensor) -> None:
        if held is not None:
            held.accept(hit.flatten().repeat_interleave(self.each))

    def start(self) -> tuple[Tensor, Tensor]:
        z, log_p = self._drawn(0), torch.full(self.shape, -torch.inf, dtype=torch.float64)
        for attempt in range(_TRIES):
            fresh = self._drawn(attempt)
            z = torch.where(torch.isfinite(log_p).unsqueeze(-1), z, fresh)
            log_new, held = self(z, -attempt - 1)
            missing = ~torch.isfinite(log_p)
            self.keep(held, missing)
            log_p = torch.where(missing, log_new, log_p)
            if bool(torch.isfinite(log_p).all()):
                return z, log_p
        lost = int((~torch.isfinite(log_p)).sum())
        raise ValueError(f"pmmh: {lost} chains are lost at {_TRIES} draws of a start; narrow the prior, or take more particles")

    @property
    def somewhere(self) -> dict[str, Tensor]:
        return {name: a.median() for name, a in self.unknown.draw(101, self.seed).items()}

    def first_covariance(self) -> Tensor:
        z = self.unknown.unconstrained(self.first.draw(1000, self.seed))
        p = z.shape[-1]
        return torch.cov(z.T).view(1, p, p).repeat(self.shape[1], 1, 1)

    def _drawn(self, attempt: int) -> Tensor:
        count = self.shape[0] * self.shape[1]
        return self.unknown.unconstrained(self.first.draw(count, self.seed + 7919 * (attempt + 1))).view(*self.shape, -1)


def tiled(record: Record, copies: int) -> Record:
    """The runs of a record, and all of them again, `copies` times in all."""
    start, spread = (None if a is None else a.repeat(copies, *[1] * (a.dim() - 1)) for a in (record.start, record.spread))
    u = map_inputs(lambda a: a if len(a) == 1 else a.repeat(copies, *[1] * (a.dim() - 1)), record.u)
    return Record(record.y.repeat(copies, 1, 1), u, start, spread, record.loop)
