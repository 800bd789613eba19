"""Particle marginal Metropolis-Hastings: chains of parameters with a filter each.

All chains move at once, as runs of one batch. `ModelBatch` maps the model of each chain over them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require, require_range
from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import Filter
from pfbench.ppl.likelihood import PosteriorEstimator
from pfbench.ppl.parameter_posterior import ParameterPosterior
from pfbench.ppl.parameterised_model import (
    ParameterisedModel,
    Prior,
    check_counts,
    check_kinds,
)

_Proposal: TypeAlias = Callable[[Tensor, RandomStream], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class PmmhSettings:
    """Settings of particle marginal Metropolis-Hastings.

    Attributes:
        separate_parameters: Whether each run has its own parameters, R posteriors. Otherwise the
            runs share them.
        rho: Correlation of the filter's random numbers between iterations; they are all stored.
            It needs a resampler `SortedResampler` and helps little for more than a few states.
        thin: Iterations for each draw.
        start: Distributions of the chains' starts and of the walk's first covariance, by parameter,
            with the supports of the prior. They should be wider than the posterior, so that r-hat
            detects chains that disagree. None is the prior.
        leaps: Leaps after each step of the walk. They improve mixing if the posterior is nearly
            normal.
        tick: Function that is called after each iteration, for a progress bar.

    Raises:
        ValueError: If a value is out of range.
    """

    separate_parameters: bool = False
    rho: float = 0.0
    thin: int = 1
    start: Mapping[str, Prior] | None = None
    leaps: int = 0
    tick: Callable[[], object] | None = None

    def __post_init__(self) -> None:
        check_counts("pmmh", {"thin": (self.thin, 1), "leaps": (self.leaps, 0)})
        require_range("pmmh.rho", self.rho, "[0, 1)")


def pmmh(
    unknown: ParameterisedModel,
    method: Filter,
    record: Record,
    draws: int,
    warmup: int,
    chains: int = 4,
    seed: int = 0,
    settings: PmmhSettings | None = None,
) -> ParameterPosterior:
    """Draw from p(parameters | y_1:T) by particle marginal Metropolis-Hastings.

    It is exact for any number of particles if the filter's likelihood estimate is unbiased
    [Andrieu, Doucet and Holenstein 2010]. With a Gaussian filter it is Metropolis-Hastings with
    that filter's likelihood.

    The random walk of the unconstrained parameters is normal. Its covariance and size are learned
    in the warm-up from all chains of a posterior [Andrieu and Thoms 2008, algorithm 4] and then
    stay fixed. Chains start from draws of the prior, repeated while the filter is lost. Leaps are
    proposed from a t distribution with the learned mean and covariance.

    Args:
        unknown: Model and prior.
        method: Any filter. A number of particles that gives the log likelihood a variance of about
            1 is efficient.
        record: Measurements [R, T, Dy] and inputs.
        draws: Draws of each chain.
        warmup: Iterations before the draws.
        chains: Chains of each posterior.
        seed: Seed of all random numbers.
        settings: Further settings. None for the defaults.

    Returns:
        Draws and acceptance rates.

    Raises:
        ValueError: If a count is too small, `start` has other parameters than the prior, or the
            filter is lost for all starts of a chain.
    """
    settings = settings or PmmhSettings()
    check_kinds("pmmh", {"unknown": (unknown, ParameterisedModel), "record": (record, Record)})
    check_kinds("pmmh", {"method": (method, Filter), "settings": (settings, PmmhSettings)})
    counts = {"draws": (draws, 1), "warmup": (warmup, 0), "chains": (chains, 1), "seed": (seed, 0)}
    check_counts("pmmh", counts)
    start = unknown
    if settings.start is not None:
        require(
            set(settings.start) == set(unknown.names),
            "pmmh.start",
            f"have a distribution for each of {sorted(unknown.names)}",
            sorted(settings.start),
            "Name the same parameters.",
        )
        distributions = {name: settings.start[name] for name in unknown.names}
        start = ParameterisedModel(unknown.make, distributions)
    target = PosteriorEstimator(
        unknown, method, record, chains, seed, settings.separate_parameters, settings.rho
    )
    with torch.no_grad():
        return _run_chains(target, start, draws, warmup, settings)


def _run_chains(
    target: PosteriorEstimator,
    start: ParameterisedModel,
    draws: int,
    warmup: int,
    settings: PmmhSettings,
) -> ParameterPosterior:
    """Run all chains of a posterior."""
    z, log_p = target.draw_start(start)
    log_size = torch.full((z.shape[1],), -0.5, dtype=z.dtype)
    walk = ParameterWalk(z.mean(0), target.start_covariance(start), log_size)
    samples, accepted_count = [], torch.zeros_like(log_p)
    for i in range(1, warmup + draws * settings.thin + 1):
        is_step = i % (settings.leaps + 1) == 0
        proposal = walk.step if is_step else walk.leap
        z, log_p, probability, is_accepted = _metropolis_step(target, proposal, z, log_p, i)
        if i <= warmup:
            walk = walk.adapt(z, probability.mean(0) if is_step else None, (i + 1.0) ** -0.6)
        else:
            accepted_count += is_accepted
            if (i - warmup) % settings.thin == 0:
                samples.append(z)
        if settings.tick:
            settings.tick()
    values, _ = target.unknown.constrained(torch.stack(samples, 1))  # {name: [C, S, Q]}
    acceptance = accepted_count / (draws * settings.thin)
    if not settings.separate_parameters:
        values, acceptance = {name: a[..., 0] for name, a in values.items()}, acceptance[:, 0]
    return ParameterPosterior(values, acceptance, "PMMH")


def _metropolis_step(
    target: PosteriorEstimator, proposal: _Proposal, z: Tensor, log_p: Tensor, iteration: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return states, log densities, acceptance probabilities and outcomes."""
    stream = PhiloxStream(target.seed, torch.arange(log_p.numel())).at_step(iteration)
    proposed_z, log_back = proposal(z, stream)
    proposed_log_p, numbers = target(proposed_z, iteration)
    probability = torch.exp(proposed_log_p - log_p + log_back).clamp(max=1.0)
    is_accepted = stream.uniform("pmmh.accept", 1, 1).view_as(probability) < probability
    target.store_numbers(numbers, is_accepted)
    z = torch.where(is_accepted.unsqueeze(-1), proposed_z, z)
    return z, torch.where(is_accepted, proposed_log_p, log_p), probability, is_accepted


# --------------------------------------------------------------------------------------------------
# Proposals of particle marginal Metropolis-Hastings, adapted to the chains.

_TARGET_ACCEPTANCE = 0.25  # near the optimum for few dimensions and a noisy likelihood
_DEGREES_OF_FREEDOM = 5  # of leaps; their tails must be heavier than the posterior's


class ParameterWalk(NamedTuple):
    """Moments of the proposals of each of Q posteriors.

    Attributes:
        mean: Mean of the unconstrained parameters, [Q, P].
        covariance: Covariance of the unconstrained parameters, [Q, P, P].
        log_size: Logarithm of the step size of the random walk, [Q].
    """

    mean: Tensor
    covariance: Tensor
    log_size: Tensor

    def step(self, z: Tensor, stream: RandomStream) -> tuple[Tensor, Tensor]:
        """Propose a step of the random walk.

        Returns proposals [C, Q, P], and log q(z | new) - log q(new | z), [C, Q]. Shapes: z
        [C, Q, P].
        """
        e = stream.normal("pmmh.walk", 1, z.shape[-1]).view_as(z)
        root = torch.exp(self.log_size)[:, None, None] * self._root()
        return z + (root @ e.unsqueeze(-1)).squeeze(-1), torch.zeros_like(z[..., 0])

    def leap(self, z: Tensor, stream: RandomStream) -> tuple[Tensor, Tensor]:
        """Propose from a t distribution with the learned moments, independently of z.

        Returns proposals [C, Q, P], and log q(z) - log q(new), [C, Q]. Shapes: z [C, Q, P].
        """
        e, root = stream.normal("pmmh.leap", 1, z.shape[-1]).view_as(z), self._root()
        chi2 = stream.normal("pmmh.tail", 1, _DEGREES_OF_FREEDOM).square().mean(-1)
        scale = chi2.view_as(z[..., 0]).rsqrt().unsqueeze(-1)
        deviation = (z - self.mean).unsqueeze(-1)
        whitened = torch.linalg.solve_triangular(root, deviation, upper=False).squeeze(-1)
        proposed_z = self.mean + scale * (root @ e.unsqueeze(-1)).squeeze(-1)
        return proposed_z, _log_t_density(whitened) - _log_t_density(scale * e)

    def adapt(self, z: Tensor, acceptance: Tensor | None, rate: float) -> ParameterWalk:
        """Update the moments by stochastic approximation.

        Returns the updated walk. Shapes: z [C, Q, P], acceptance [Q].
        """
        d = z - self.mean
        spread = (d.unsqueeze(-1) * d.unsqueeze(-2)).mean(0)
        log_size = self.log_size
        if acceptance is not None:
            log_size = log_size + rate * (acceptance - _TARGET_ACCEPTANCE)
        covariance = self.covariance + rate * (spread - self.covariance)
        return ParameterWalk(self.mean + rate * d.mean(0), covariance, log_size)

    def _root(self) -> Tensor:
        eye = torch.eye(self.mean.shape[-1], dtype=self.mean.dtype)
        return torch.linalg.cholesky(self.covariance + 1e-6 * eye)


def _log_t_density(a: Tensor) -> Tensor:
    """Return the log density of a whitened t distribution, up to a constant."""
    exponent = -0.5 * (_DEGREES_OF_FREEDOM + a.shape[-1])
    return exponent * torch.log1p(a.square().sum(-1) / _DEGREES_OF_FREEDOM)
