"""Particle marginal Metropolis-Hastings: a random walk of parameters with a filter run per step.

All chains move at once, as runs of one batch. Each chain has its own model, and `ModelBatch` maps a
model over them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import Filter, ParticleBelief, gather_ancestors
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.loop import run_filter
from pfbench.filter.particle.resampling import Resampler
from pfbench.model.base import StateSpaceModel
from pfbench.ppl.parameter_posterior import ParameterPosterior
from pfbench.ppl.program import Law, ParameterisedModel

_ACCEPTANCE = 0.25  # target: near the optimum for few dimensions and a noisy likelihood
_TRIES = 20
_FREEDOM = 5  # degrees of freedom of leaps; their tails must be heavier than the posterior's


@dataclass(frozen=True, eq=False)
class CorrelatedStream:
    """A random stream correlated with the one of the last accepted iteration.

    A proposed normal number is rho u + sqrt(1 - rho^2) e, which leaves N(0, I) invariant. The two
    estimates of the likelihood are then correlated, and their ratio is less noisy [Deligiannidis,
    Doucet and Pitt 2018]. A uniform number is Phi of a normal one.

    Attributes:
        fresh: Random stream e of this iteration.
        rho: Correlation, 0 for the plain algorithm.
        kept: Numbers of the chains' last accepted iteration, [R, n, w], by (step, purpose, n, w).
        proposed: Numbers of this iteration, filled when they are drawn.
        step: Time step.
    """

    independent_stream: RandomStream
    correlation: float
    stored: dict[tuple[int, str, int, int], Tensor]
    proposed: dict[tuple[int, str, int, int], Tensor] = field(default_factory=dict)
    step: int = 0

    @property
    def dtype(self) -> torch.dtype:
        return self.independent_stream.dtype

    def at_step(self, step: int) -> CorrelatedStream:
        return replace(self, independent_stream=self.independent_stream.at_step(step), step=step)

    def select_runs(self, runs: slice) -> RandomStream:
        raise ValueError(
            "pmmh.rho must be 0 for a filter that splits the runs, because correlated numbers "
            "belong to all of them. Set rho=0."
        )

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        key, e = (self.step, purpose, n, w), self.independent_stream.normal(purpose, n, w)
        u = self.stored.get(key)
        self.proposed[key] = (
            e if u is None else self.correlation * u + (1.0 - self.correlation**2) ** 0.5 * e
        )
        return self.proposed[key]

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        z = self.normal("uniform." + purpose, n, w).double()
        return torch.special.ndtr(z).clamp(1e-12, 1.0 - 1e-12)

    def accept(self, hit: Tensor) -> None:
        """Store the proposed numbers of accepted runs, bool [R]."""
        for key, new in self.proposed.items():
            old = self.stored.get(key)
            self.stored[key] = new if old is None else torch.where(hit[:, None, None], new, old)


@dataclass(frozen=True)
class SortedResampler:
    """A resampler that sorts the particles by one component first.

    With correlated random numbers neighbours then stay neighbours. Without sorting the first
    resampling removes the correlation. The distribution of the filter does not change.

    Attributes:
        resampler: Resampler of the filter.
        component: Component of the state.
    """

    resampler: Resampler
    component: int = 0

    @property
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"resampler.resampler": self.resampler})

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        active_mask = torch.isfinite(belief.log_w)
        order = torch.where(active_mask, belief.x[..., self.component], torch.inf).argsort(1)
        sorted_cloud = gather_ancestors(belief, order)
        log_a = sorted_cloud.log_w if log_a is belief.log_w else log_a.gather(1, order)
        return self.resampler(model, sorted_cloud, log_a, n, draws)


class _Walk(NamedTuple):
    """Mean [Q, P], covariance and log size [Q] of the random walk of each of Q posteriors."""

    mean: Tensor
    covariance: Tensor
    log_size: Tensor

    def root(self) -> Tensor:
        eye = torch.eye(self.mean.shape[-1], dtype=self.mean.dtype)
        return torch.linalg.cholesky(self.covariance + 1e-6 * eye)

    def step(self, z: Tensor, stream: RandomStream) -> tuple[Tensor, Tensor]:
        """Propose around z [C, Q, P], with log q(z | new) - log q(new | z) [C, Q]."""
        e = stream.normal("pmmh.walk", 1, z.shape[-1]).view_as(z)
        root = torch.exp(self.log_size)[:, None, None] * self.root()
        return z + (root @ e.unsqueeze(-1)).squeeze(-1), torch.zeros_like(z[..., 0])

    def leap(self, z: Tensor, stream: RandomStream) -> tuple[Tensor, Tensor]:
        """Propose from a t distribution with the posterior's mean and covariance, whatever z is."""
        e, root = stream.normal("pmmh.leap", 1, z.shape[-1]).view_as(z), self.root()
        chi2 = stream.normal("pmmh.tail", 1, _FREEDOM).square().mean(-1)
        scale = chi2.view_as(z[..., 0]).rsqrt().unsqueeze(-1)
        off = (z - self.mean).unsqueeze(-1)
        whitened = torch.linalg.solve_triangular(root, off, upper=False).squeeze(-1)

        def log_q(a: Tensor) -> Tensor:
            return -0.5 * (_FREEDOM + a.shape[-1]) * torch.log1p(a.square().sum(-1) / _FREEDOM)

        proposed_z = self.mean + scale * (root @ e.unsqueeze(-1)).squeeze(-1)
        return proposed_z, log_q(whitened) - log_q(scale * e)

    def learned(self, z: Tensor, share: Tensor | None, rate: float) -> _Walk:
        """Update by stochastic approximation, from chains z [C, Q, P] and acceptance share [Q]."""
        d = z - self.mean
        spread = (d.unsqueeze(-1) * d.unsqueeze(-2)).mean(0)
        size = self.log_size if share is None else self.log_size + rate * (share - _ACCEPTANCE)
        covariance = self.covariance + rate * (spread - self.covariance)
        return _Walk(self.mean + rate * d.mean(0), covariance, size)


def pmmh(
    unknown: ParameterisedModel,
    method: Filter,
    record: Record,
    draws: int,
    warmup: int,
    chains: int = 4,
    seed: int = 0,
    separate_parameters: bool = False,
    rho: float = 0.0,
    thin: int = 1,
    start: Mapping[str, Law] | None = None,
    leaps: int = 0,
    tick: Callable[[], object] | None = None,
) -> ParameterPosterior:
    """Draw from p(parameters | y_1:T) by particle marginal Metropolis-Hastings.

    It is exact for any number of particles if the filter's likelihood estimate is unbiased
    [Andrieu, Doucet and Holenstein 2010]. With a Gaussian filter it is Metropolis-Hastings with
    that filter's likelihood.

    The random walk of the unconstrained parameters is normal. Its covariance and size are learned
    in the warm-up from all chains of a posterior [Andrieu and Thoms 2008, algorithm 4] and then
    stay fixed. Chains start from draws of the prior, repeated while the filter is lost. If the
    posterior is nearly normal, leaps between the steps improve mixing: they are proposed from a t
    distribution with the learned mean and covariance.

    Args:
        unknown: Model and prior.
        method: Any filter. Particles for a variance of the log likelihood of about 1 serve best.
        record: Measurements [R, T, Dy] and inputs.
        draws: Draws of each chain.
        warmup: Iterations before the draws.
        chains: Chains of each posterior.
        seed: Seed of all random numbers.
        apart: If true, each run has its own parameters, R posteriors. Otherwise they are shared.
        rho: Correlation of the filter's random numbers between iterations; they are all stored.
            It needs a resampler `SortedResampler` and helps little for more than a few states.
        thin: Iterations for each draw.
        start: Distributions of the chains' starts and of the walk's first covariance, by parameter,
            with the supports of the prior. They should be wider than the posterior, so that r-hat
            detects chains that disagree. None is the prior.
        leaps: Leaps after each step of the walk.
        tick: Called after each iteration (a progress bar).

    Returns:
        Draws and acceptance rates.

    Raises:
        ValueError: if a count is too small, rho is outside [0, 1), start names other parameters,
            or the filter is lost for all starts of a chain.
    """
    least = {
        "draws": (draws, 1),
        "warmup": (warmup, 0),
        "chains": (chains, 1),
        "thin": (thin, 1),
        "leaps": (leaps, 0),
    }
    for name, (value, low) in least.items():
        if value < low:
            raise ValueError(
                f"pmmh.{name} must be at least {low}, got {name}={value}. Increase {name}."
            )
    if start is not None and set(start) != set(unknown.names):
        raise ValueError(
            f"pmmh.start must have a distribution for each of {sorted(unknown.names)}, got "
            f"{sorted(start)}. Name the same parameters."
        )
    if not 0.0 <= rho < 1.0:
        raise ValueError(f"pmmh.rho must be in [0, 1), got rho={rho}. Use 0 for no correlation.")
    first = unknown
    if start is not None:
        first = ParameterisedModel(unknown.make, {name: start[name] for name in unknown.names})
    target = _Target(unknown, first, method, record, chains, seed, separate_parameters, rho)
    with torch.no_grad():
        return _run_chains(target, draws, warmup, thin, leaps, tick)


def _run_chains(
    target: _Target,
    draws: int,
    warmup: int,
    thin: int,
    leaps: int,
    tick: Callable[[], object] | None,
) -> ParameterPosterior:
    """Run all chains of a target."""
    z, log_p = target.start()
    log_size = torch.full((z.shape[1],), -0.5, dtype=z.dtype)
    walk = _Walk(z.mean(0), target.first_covariance(), log_size)
    samples, accepted_count = [], torch.zeros_like(log_p)
    for i in range(1, warmup + draws * thin + 1):
        stream = PhiloxStream(target.seed, torch.arange(log_p.numel())).at_step(i)
        is_step = i % (leaps + 1) == 0
        proposed_z, log_back = (walk.step if is_step else walk.leap)(z, stream)
        proposed_log_p, held = target(proposed_z, i)
        share = torch.exp(proposed_log_p - log_p + log_back).clamp(max=1.0)
        accept = stream.uniform("pmmh.accept", 1, 1).view_as(share) < share
        target.keep(held, accept)
        z = torch.where(accept.unsqueeze(-1), proposed_z, z)
        log_p = torch.where(accept, proposed_log_p, log_p)
        if i <= warmup:
            walk = walk.learned(z, share.mean(0) if is_step else None, (i + 1.0) ** -0.6)
        else:
            accepted_count += accept
            if (i - warmup) % thin == 0:
                samples.append(z)
        if tick:
            tick()
    values, _ = target.unknown.constrained(torch.stack(samples, 1))  # {name: [C, S, Q]}
    accepted = accepted_count / (draws * thin)
    if not target.apart:
        values, accepted = {name: a[..., 0] for name, a in values.items()}, accepted[:, 0]
    return ParameterPosterior(values, accepted, "PMMH")


class _Target:
    """Estimator of log p(z) + log p(y | z) of chains z [C, Q, P]; Q is R or, if shared, 1."""

    def __init__(
        self,
        unknown: ParameterisedModel,
        first: ParameterisedModel,
        method: Filter,
        record: Record,
        chains: int,
        seed: int,
        apart: bool,
        rho: float,
    ) -> None:
        self.unknown, self.first, self.method = unknown, first, method
        self.seed, self.apart, self.rho = seed, apart, rho
        self.runs = len(record.y)
        self.shape = (chains, self.runs if apart else 1)
        self.each = 1 if apart else self.runs
        self.record = repeat_runs(record, chains)
        self.kept: dict[tuple[int, str, int, int], Tensor] = {}

    def __call__(self, z: Tensor, iteration: int) -> tuple[Tensor, CorrelatedStream | None]:
        values, log_prior = self.unknown.constrained(z.flatten(0, 1))
        possible = self.unknown.in_support(values) & torch.isfinite(log_prior)
        if not bool(possible.all()):  # any valid value serves: the proposal is rejected anyway
            valid = self._valid_values
            values = {name: torch.where(possible, a, valid[name]) for name, a in values.items()}
        source: RandomStream = PhiloxStream(self.seed, torch.arange(possible.numel() * self.each))
        source = relabel(source, f"pmmh_{iteration}.")
        held = CorrelatedStream(source, self.rho, self.kept) if self.rho else None
        model = self.unknown.models_per_run(values, self.each)
        stream: Any = held or source
        log_z = run_filter(self.method, model, self.record, stream).log_evidence
        log_z = log_z.view(-1, self.each).sum(1)
        total = torch.where(possible & torch.isfinite(log_z), log_prior + log_z, -torch.inf)
        return total.view(self.shape), held

    def keep(self, held: CorrelatedStream | None, hit: Tensor) -> None:
        if held is not None:
            held.accept(hit.flatten().repeat_interleave(self.each))

    def start(self) -> tuple[Tensor, Tensor]:
        z, log_p = self._draw_start(0), torch.full(self.shape, -torch.inf, dtype=torch.float64)
        for attempt in range(_TRIES):
            fresh = self._draw_start(attempt)
            z = torch.where(torch.isfinite(log_p).unsqueeze(-1), z, fresh)
            log_new, held = self(z, -attempt - 1)
            missing = ~torch.isfinite(log_p)
            self.keep(held, missing)
            log_p = torch.where(missing, log_new, log_p)
            if bool(torch.isfinite(log_p).all()):
                return z, log_p
        lost = int((~torch.isfinite(log_p)).sum())
        raise ValueError(
            f"pmmh needs a start at which the filter is not lost, got {lost} chains lost at "
            f"{_TRIES} draws. Narrow the prior, or use more particles."
        )

    @property
    def _valid_values(self) -> dict[str, Tensor]:
        return {name: a.median() for name, a in self.unknown.sample(101, self.seed).items()}

    def first_covariance(self) -> Tensor:
        z = self.unknown.unconstrained(self.first.sample(1000, self.seed))
        p = z.shape[-1]
        return torch.cov(z.T).view(1, p, p).repeat(self.shape[1], 1, 1)

    def _draw_start(self, attempt: int) -> Tensor:
        count = self.shape[0] * self.shape[1]
        values = self.first.sample(count, self.seed + 7919 * (attempt + 1))
        return self.unknown.unconstrained(values).view(*self.shape, -1)


def repeat_runs(record: Record, copies: int) -> Record:
    """Repeat all runs of a record.

    Args:
        record: Record of R runs.
        copies: Number of repetitions.

    Returns:
        Record of R `copies` runs, all runs in turn.
    """

    def repeat(a: Tensor) -> Tensor:
        return a.repeat(copies, *[1] * (a.dim() - 1))

    start, spread = (None if a is None else repeat(a) for a in (record.start, record.spread))
    u = map_inputs(lambda a: a if len(a) == 1 else repeat(a), record.u)
    return Record(repeat(record.y), u, start, spread, record.feedback)
