"""Particle Markov chain Monte Carlo: chains of parameters with a filter each, or with a path of the states each.

All chains move at once, as runs of one batch. `ModelBatch` maps the model of each chain over them.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream, RandomStream, relabel
from pfbench.core.record import Record
from pfbench.files.atomic_write import write_atomically
from pfbench.filter.belief import Filter
from pfbench.filter.smoothing.noise_space import ConditionalSmcKernel, NoiseSpace, PathKernel
from pfbench.ppl.likelihood import PosteriorEstimator, repeat_runs
from pfbench.ppl.parameter_posterior import ParameterPosterior
from pfbench.ppl.parameterised_model import ParameterisedModel, Prior, check_inference_call

_STORE_EVERY = 20.0  # s between two stored states of the chains
_Proposal: TypeAlias = Callable[[Tensor, RandomStream], tuple[Tensor, Tensor]]


@dataclass(frozen=True)
class PmmhSettings:
    """Settings of particle marginal Metropolis-Hastings.

    Attributes:
        separate_parameters: Whether each run has its own parameters, R posteriors. Otherwise the
            runs share them.
        thin: Iterations for each draw.
        start: Distributions of the chains' starts and of the walk's first covariance, by parameter,
            with the supports of the prior. They should be wider than the posterior, so that r-hat
            detects chains that disagree. None is the prior.
        leaps: Leaps after each step of the walk. They improve mixing if the posterior is nearly
            normal.
        tick: Function that is called after each iteration with its number and the acceptance rate, for a progress bar.
        checkpoint: File in which the chains are stored each 20 s. The same call continues from it, with the same result.

    Raises:
        ValueError: If a value is out of range.
    """

    separate_parameters: bool = False
    thin: int = 1
    start: Mapping[str, Prior] | None = None
    leaps: int = 0
    tick: Callable[[int, float], object] | None = None
    checkpoint: Path | None = None

    def __post_init__(self) -> None:
        check_inference_call("pmmh", thin=(self.thin, 1), leaps=(self.leaps, 0))


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
    check_inference_call(
        "pmmh", unknown=(unknown, ParameterisedModel), record=(record, Record), method=(method, Filter),
        settings=(settings, PmmhSettings), draws=(draws, 1), warmup=(warmup, 0), chains=(chains, 1), seed=(seed, 0),
    )  # fmt: skip
    start = unknown
    if settings.start is not None:
        require(
            set(settings.start) == set(unknown.names),
            "pmmh.start",
            f"have a distribution for each of {sorted(unknown.names)}",
            sorted(settings.start),
            "Name the same parameters.",
        )
        start = ParameterisedModel(unknown.make, {k: settings.start[k] for k in unknown.names})
    target = PosteriorEstimator(unknown, method, record, chains, seed, settings.separate_parameters)
    return _run_chains(target, start, draws, warmup, settings)


@torch.no_grad()
def _run_chains(
    target: PosteriorEstimator,
    start: ParameterisedModel,
    draws: int,
    warmup: int,
    settings: PmmhSettings,
) -> ParameterPosterior:
    """Run all chains of a posterior."""
    counts = (target.shape, target.seed, draws, warmup, settings.thin, settings.leaps)
    call = repr((*counts, start.names, float(target.record.y.nansum())))
    z, log_p, moments, samples, accepted_count, done = _find_chains(target, start, settings, call)
    walk, stored = ParameterWalk(*moments), time.monotonic()
    for i in range(done + 1, warmup + draws * settings.thin + 1):
        is_step = i % (settings.leaps + 1) == 0
        proposal = walk.step if is_step else walk.leap
        z, log_p, probability, is_accepted = _metropolis_step(target, proposal, z, log_p, i)
        if i <= warmup:
            walk = walk.adapt(z, probability.mean(0) if is_step else None, (i + 1.0) ** -0.6)
        else:
            accepted_count += is_accepted
            if (i - warmup) % settings.thin == 0:
                samples.append((z, log_p))
        if settings.tick:
            settings.tick(i, float(probability.mean()))
        if settings.checkpoint and time.monotonic() - stored > _STORE_EVERY:
            state = (z, log_p, tuple(walk), samples, accepted_count, i)
            write_atomically(settings.checkpoint, partial(torch.save, (call, state)))
            stored = time.monotonic()
    paths, densities = (torch.stack(parts, 1) for parts in zip(*samples, strict=True))
    values, _ = target.unknown.constrained(paths)  # {name: [C, S, Q]}
    of_runs = slice(None) if settings.separate_parameters else 0
    values = {name: a[..., of_runs] for name, a in values.items()}
    rate = accepted_count[:, of_runs] / (draws * settings.thin)
    return ParameterPosterior(values, rate, "PMMH", {"lp": densities[..., of_runs]})


def _find_chains(
    target: PosteriorEstimator, start: ParameterisedModel, settings: PmmhSettings, call: str
) -> tuple[Any, ...]:
    """Return states, log densities, moments of the walk, samples, counts and the number of iterations done: stored ones, or new ones."""
    if settings.checkpoint and settings.checkpoint.is_file():
        stored_call, state = torch.load(settings.checkpoint, weights_only=True)
        remedy = "Remove the file, or repeat that call."
        require(stored_call == call, "pmmh.checkpoint", f"be of the same call, {call}", stored_call, remedy)  # fmt: skip
        return tuple(state)
    z, log_p = target.draw_start(start)
    return z, log_p, ParameterWalk.start(start, z, target.seed), [], torch.zeros_like(log_p), 0


def _metropolis_step(
    target: PosteriorEstimator, proposal: _Proposal, z: Tensor, log_p: Tensor, iteration: int
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Return states, log densities, acceptance probabilities and outcomes."""
    stream = PhiloxStream(target.seed, torch.arange(log_p.numel())).at_step(iteration)
    proposed_z, log_back = proposal(z, stream)
    proposed_log_p = target(proposed_z, iteration)
    probability, is_accepted = _accept(proposed_log_p - log_p + log_back, stream, "pmmh")
    z = torch.where(is_accepted.unsqueeze(-1), proposed_z, z)
    return z, torch.where(is_accepted, proposed_log_p, log_p), probability, is_accepted


def _accept(log_ratio: Tensor, stream: RandomStream, use: str) -> tuple[Tensor, Tensor]:
    """Return the acceptance probability of each chain, and whether it accepts; from an impossible state it always does."""
    probability = torch.exp(log_ratio).nan_to_num(nan=1.0).clamp(max=1.0)
    return probability, stream.uniform(f"{use}.accept", 1, 1).view_as(probability) < probability


# --------------------------------------------------------------------------------------------------
# Particle Gibbs: parameters given a path of the states, and a path given parameters, in turn.


class GibbsSample(NamedTuple):
    """Draws of parameters and states.

    Attributes:
        posterior: Draws of the parameters, and the acceptance rates of their moves.
        states: Paths that belong to them, [chains, S, R, T, D].
    """

    posterior: ParameterPosterior
    states: Tensor


def particle_gibbs(
    unknown: ParameterisedModel,
    record: Record,
    draws: int,
    warmup: int,
    chains: int = 4,
    seed: int = 0,
    kernel: PathKernel | None = None,
) -> GibbsSample:
    """Draw from p(parameters, x_1:T | y_1:T) by particle Gibbs with ancestor sampling.

    A sweep draws a path by conditional SMC, and moves the parameters twice by a random walk. One move keeps the states, the other
    the noises of the path. Where the states do not determine the noises, both keep the noises. Which of them mixes well
    depends on the parameter [Papaspiliopoulos, Roberts and Skold 2007]. The filter needs few particles, and the path of the states is part
    of the answer. The time grows with the length of the record, squared where the model has fewer noises than states.

    Args:
        unknown: Model and prior; initial state and noise of the model are normal.
        record: Measurements [R, T, Dy] and inputs. All runs share the parameters.
        draws: Sweeps of each chain that are stored.
        warmup: Sweeps before, in which the walks are learned.
        chains: Number of chains.
        seed: Seed of all random numbers.
        kernel: Step of a path, `ConditionalSmcKernel(20)` by default.

    Returns:
        Draws of parameters and states.

    Raises:
        ValueError: If a count is too small, a distribution is not normal, or the record has feedback.

    References:
        Andrieu, Doucet and Holenstein 2010. Lindsten, Jordan and Schon 2014.
    """
    check_inference_call(
        "particle_gibbs", unknown=(unknown, ParameterisedModel), record=(record, Record), draws=(draws, 1), warmup=(warmup, 0),
        chains=(chains, 1), seed=(seed, 0),
    )  # fmt: skip
    target = _PathPosterior(unknown, record, chains)
    return _run_sweeps(target, draws, warmup, seed, kernel or ConditionalSmcKernel(20))


@dataclass(frozen=True)
class _PathPosterior:
    """Density of the parameters of each chain, given a path of it."""

    unknown: ParameterisedModel
    record: Record
    chains: int

    def make_space(self, z: Tensor) -> tuple[NoiseSpace, Tensor]:
        """Return the noise space of the models of z [C, 1, P], and the log prior [C, 1], -inf where a model is impossible."""
        model, log_prior = self.unknown.models_at(z[:, 0], len(self.record.y))
        return NoiseSpace(model, repeat_runs(self.record, self.chains)), log_prior.unsqueeze(1)

    def evaluate(
        self, space: NoiseSpace, log_prior: Tensor, theta: Tensor, states: Tensor | None
    ) -> tuple[Tensor, Tensor]:
        """Return log p(z, path, y) [C, 1] and the vectors of the paths, which keep the states, or the noises without these."""
        solution = None if states is None else _find_vectors(space, theta, states)
        theta, log_p = solution or (theta, space.roll_out(theta)[1])
        total = log_prior + log_p.view(self.chains, -1).sum(1, keepdim=True)
        return total.nan_to_num(nan=-torch.inf), theta


def _find_vectors(space: NoiseSpace, theta: Tensor, states: Tensor) -> tuple[Tensor, Tensor] | None:
    """Return the vectors of given states after the initial state of theta, and their log density with y; None where they are not determined."""
    d = space.model.chart.dimension
    x, parts, total = space.start(theta[..., :d]), [theta[..., :d]], torch.zeros_like(theta[..., 0])
    for t, (model, record) in enumerate(space.steps):
        solution = space.find_noise(t, x, states[:, :, t])
        if solution is None:
            return None
        x, (w, log_det) = states[:, :, t], solution
        parts.append(w)
        log_p = model.log_likelihood(record.y, x, record.u) - log_det
        total = total + log_p - 0.5 * w.square().sum(-1)
    return torch.cat(parts, -1), total


@torch.no_grad()
def _run_sweeps(
    target: _PathPosterior, draws: int, warmup: int, seed: int, kernel: PathKernel
) -> GibbsSample:
    """Run all chains of paths and parameters."""
    unknown, runs = target.unknown, len(target.record.y)
    z = unknown.unconstrained(unknown.sample(target.chains, seed)).unsqueeze(1)
    walks, samples, accepted = [ParameterWalk.start(unknown, z, seed)] * 2, [], []
    source, current = PhiloxStream(seed, torch.arange(target.chains * runs)), target.make_space(z)
    theta = source.normal("gibbs.start", 1, current[0].size).to(z)
    for i in range(warmup + draws):
        theta, _ = kernel(current[0], theta, relabel(source, f"gibbs_{i}."))
        for j, states in enumerate((current[0].roll_out(theta)[0], None)):
            stream = relabel(PhiloxStream(seed, torch.arange(target.chains)), f"gibbs_{i}_{j}.")
            proposed, _ = walks[j].step(z, stream)
            after, new_theta = target.evaluate(*target.make_space(proposed), theta, states)
            after -= target.evaluate(*current, theta, states)[0]
            probability, is_accepted = _accept(after, stream, "gibbs")
            z = torch.where(is_accepted.unsqueeze(-1), proposed, z)
            is_new = is_accepted.repeat_interleave(runs, 0).unsqueeze(-1)
            theta = torch.where(is_new, new_theta, theta)
            current = target.make_space(z)
            if i < warmup:
                walks[j] = walks[j].adapt(z, probability.mean(0), (i + 2.0) ** -0.6)
            accepted.append(probability[:, 0])
        if i >= warmup:
            samples.append((z[:, 0], current[0].roll_out(theta)[0][:, 0]))
    parameters, paths = (torch.stack(parts, 1) for parts in zip(*samples, strict=True))
    posterior = ParameterPosterior(
        unknown.constrained(parameters)[0],
        torch.stack(accepted[2 * warmup :], 1).mean(1),
        "particle Gibbs",
    )
    return GibbsSample(posterior, paths.unflatten(0, (target.chains, runs)).transpose(1, 2))


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

    @classmethod
    def start(cls, unknown: ParameterisedModel, z: Tensor, seed: int) -> ParameterWalk:
        """Return the walk of chains at z [C, Q, P], with the covariance of draws of the prior."""
        covariance = torch.cov(unknown.unconstrained(unknown.draw(1000, seed)).T)
        covariance = covariance.view(1, *2 * z.shape[-1:]).repeat(z.shape[1], 1, 1)
        return cls(z.mean(0), covariance, torch.full_like(z[0, :, 0], -0.5))

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
