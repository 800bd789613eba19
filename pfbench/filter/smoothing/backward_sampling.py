"""Smoothing of particle filters: paths by forward filtering and backward sampling."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_range, require_ranges
from pfbench.core.random_stream import BatchRandomStream, RandomStream, relabel
from pfbench.core.record import Record
from pfbench.filter.belief import Filter, ParticleBelief, StepInfo, weighted_mean_cov
from pfbench.filter.loop import FilterResult, prepare_record, run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.stages import EssResampler, Resampler
from pfbench.filter.smoothing.gaussian_smoother import SmoothedStates, check_no_feedback
from pfbench.model.base import StateSpaceModel


def sample_trajectories(
    method: Filter,
    model: StateSpaceModel,
    record: Record,
    draws: BatchRandomStream,
    paths: int,
    sampler: BackwardSampler | None = None,
) -> Tensor:
    """Sample paths from p(x_1:T | y_1:T) by forward filtering and backward sampling.

    The last state of a path is sampled by the last weights. Each earlier state is sampled from the
    particles of its step, by their weights times the transition density to the next state. Later
    resampling does not reduce the diversity of earlier states. The paths of a run are independent
    given its particles.

    Args:
        method: Particle filter.
        model: State-space model with a transition density.
        record: Measurements [R, T, Dy] and inputs.
        draws: Random stream of filter and paths.
        paths: Number of paths of each run.
        sampler: How an earlier state is drawn, `ExactBackwardSampler` by default. The time per path
            of `RejectionBackwardSampler` and `MetropolisBackwardSampler` hardly grows with the
            number of particles.

    Returns:
        Sampled paths, [R, paths, T, D]. NaN where a run is lost.

    Raises:
        ValueError: If paths is below 1, the filter is not a particle filter, or the record has
            feedback. If the model lacks a transition density, or the sampler lacks parents.

    References:
        S. Godsill, A. Doucet and M. West (2004), Monte Carlo smoothing for nonlinear time series.
    """
    require_range("trajectories: paths", paths, "[1, inf]")
    check_no_feedback(record)
    sampler = sampler or ExactBackwardSampler()
    inputs = prepare_record(model, record)
    _check_dense(model, inputs, record)
    clouds, parents, filtered = _filter_forward(method, model, record, draws, sampler)
    x, log_w = clouds[-1]
    last = relabel(draws.at_step(len(clouds)), "path.").uniform("state", paths, 1)
    slots = draw_by_weight(log_w, last.squeeze(-1))
    path = [gather_states(x, slots)]
    for t in reversed(range(len(clouds) - 1)):
        x, log_w = clouds[t]
        transition = partial(model.transition, u=inputs.at_step(t + 1).u)
        before = parents[t + 1].gather(1, slots) if parents else slots
        step = BackwardStep(x, log_w, transition, path[-1], before)
        slots = sampler(step, relabel(draws.at_step(t + 1), "path."))
        path.append(gather_states(x, slots))
    return torch.where(filtered.lost[:, None, None, None], torch.nan, torch.stack(path[::-1], 2))


def smooth_particles(
    method: ParticleFilter,
    model: StateSpaceModel,
    record: Record,
    draws: BatchRandomStream,
    lag: int,
) -> SmoothedStates:
    """Compute means and covariances of p(x_t | y_1:t+lag) by the particles of step t + lag and their ancestors.

    The estimate of a step is ready `lag` steps later and needs no transition density. With a long lag few distinct
    ancestors remain, and with a short one later measurements are missing: choose the time in which the model forgets its state.

    Args:
        method: Particle filter that copies particles and makes no moves.
        model: State-space model.
        record: Measurements [R, T, Dy] and inputs.
        draws: Random stream of the filter.
        lag: Number of later measurements that a state may use.

    Returns:
        Smoothed means and covariances in the chart, and the result of the filter.

    Raises:
        ValueError: If lag is negative, the record has feedback, or the filter does not know the parents of its particles.

    References:
        G. Kitagawa and S. Sato (2001), Monte Carlo smoothing and self-organising state-space model.
    """
    require_range("smooth_particles: lag", lag, "whole [0, inf)")
    check_no_feedback(record)
    clouds, parents, filtered = _filter_forward(
        method, model, record, draws, MetropolisBackwardSampler()
    )
    moments = []
    for t, (x, _) in enumerate(clouds):
        end = min(t + lag, len(clouds) - 1)
        log_w = clouds[end][1]
        slots = torch.arange(log_w.shape[1], device=x.device).expand_as(log_w)
        for s in range(end, t, -1):
            slots = parents[s].gather(1, slots)
        belief = ParticleBelief(gather_states(x, slots), log_w, log_w[:, 0])
        moments.append(weighted_mean_cov(model.chart, belief))
    means, covariances = zip(*moments, strict=True)
    return SmoothedStates(torch.stack(means, 1), torch.stack(covariances, 1), filtered)


@dataclass(frozen=True)
class _AncestorRecorder(Resampler):
    """A resampler that records the ancestors of each step, [R, N], in a list."""

    resampler: EssResampler
    ancestors: list[Tensor] = field(default_factory=list)

    @property
    @override
    def is_exact(self) -> bool:
        return self.resampler.is_exact

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        new, resampled_mask = self.resampler(model, belief, log_a, n, draws)
        assert new.ancestors is not None  # an EssResampler copies
        self.ancestors.append(new.ancestors)
        return new, resampled_mask


def _filter_forward(
    method: Filter,
    model: StateSpaceModel,
    record: Record,
    draws: BatchRandomStream,
    sampler: BackwardSampler,
) -> tuple[list[tuple[Tensor, Tensor]], list[Tensor], FilterResult]:
    """Return particles and log weights of each step, their parents if needed, and the result of the filter."""
    clouds: list[tuple[Tensor, Tensor]] = []

    def store(t: int, info: StepInfo) -> dict[str, Tensor]:
        if info.cloud is None:
            raise ValueError(
                f"trajectories: method must be a particle filter, got {type(method).__name__}. "
                "Use smooth() for a Gaussian filter."
            )
        deviations, log_w = info.cloud()
        clouds.append((model.chart.add(info.mean.unsqueeze(1), deviations), log_w))
        return {}

    parents: list[Tensor] = []
    if sampler.needs_parents:
        resampler = method.resampler if isinstance(method, ParticleFilter) else None
        if (
            not isinstance(method, ParticleFilter)
            or not isinstance(resampler, EssResampler)
            or method.moves
        ):
            raise ValueError(
                "sampler must get the parents of particles, which requires a ParticleFilter with "
                f"EssResampler and without moves, got {method}. Use RejectionBackwardSampler."
            )
        method = replace(method, resampler=_AncestorRecorder(resampler, parents))
    return clouds, parents, run_filter(method, model, record, draws, store)


def _check_dense(model: StateSpaceModel, inputs: Record, record: Record) -> None:
    """Raise an error if the model lacks a transition density."""
    start = (
        model.origin.expand(len(record.y), 1, -1)
        if inputs.start is None
        else inputs.start.unsqueeze(1)
    )
    require(
        model.transition(start.to(model.anchor), inputs.at_step(0).u) is not None,
        "trajectories: model",
        "have a transition density",
        f"{type(model).__name__} without one (fewer noise than state components)",
        "Use smooth() with a Gaussian filter.",
    )


# --------------------------------------------------------------------------------------------------
# Choice of the earlier particle of each path, given its later state.
#
# The exact choice weighs every particle for every path. Rejection and Metropolis steps weigh a few
# candidates of each path, so that their cost per path does not grow with the number of particles.

_PAIRS = 4_000_000  # numbers of pairs of particle and path that are weighted at a time


class BackwardStep(NamedTuple):
    """Particles of a step, and the later states of the paths.

    Attributes:
        x: Particles at t, [R, N, D].
        log_w: Their log weights, [R, N].
        transition: States [R, K, D] -> distribution of the next state, batch [R, K], event [D].
        next_x: Later states of the paths at t + 1, [R, M, D].
        parents: Slots at t of the parents of the later particles, [R, M].
    """

    x: Tensor
    log_w: Tensor
    transition: Callable[[Tensor], Any]
    next_x: Tensor
    parents: Tensor

    def log_density(self, candidates: Tensor, paths: Tensor) -> Tensor:
        """Return log p(next state of a path | particle).

        Returns log densities, [R, m, B]. Shapes: candidates [R, m, B], paths [R, m].
        """
        size = candidates.shape[-1]
        parts = []
        rows = max(1, _PAIRS // (self.x.shape[0] * self.x.shape[2] * size))
        for slots, path in zip(candidates.split(rows, 1), paths.split(rows, 1), strict=True):
            x = gather_states(self.x, slots.flatten(1))
            later = gather_states(self.next_x, path.repeat_interleave(size, 1))
            parts.append(self.transition(x).log_prob(later).unflatten(1, (-1, size)))
        return torch.cat(parts, 1)


def draw_by_weight(log_w: Tensor, u: Tensor) -> Tensor:
    """Draw slots by log weights [R, N].

    Returns slots, [R, ...]. Shapes: log_w [R, N], u [R, ...].
    """
    cumulative = torch.softmax(log_w, -1).nan_to_num().cumsum(-1)
    return _invert(cumulative, u.to(cumulative).flatten(1)).view(u.shape)


class BackwardSampler(Protocol):
    """Draws a particle of step t for each path."""

    @property
    def needs_parents(self) -> bool:
        """True if the parents of the later particles must be recorded."""

    def __call__(self, step: BackwardStep, draws: RandomStream) -> Tensor:
        """Draw particles.

        Args:
            step: Particles, and later states of the paths.
            draws: Random stream of the step.

        Returns:
            Slots of the particles, [R, M].
        """


@dataclass(frozen=True)
class ExactBackwardSampler(BackwardSampler):
    """Weigh every particle for every path: M N densities per step [Godsill et al. 2004]."""

    needs_parents = False

    @override
    def __call__(self, step: BackwardStep, draws: RandomStream) -> Tensor:
        paths = torch.arange(step.next_x.shape[1], device=step.x.device).expand(len(step.x), -1)
        return _draw_exactly(step, paths, draws)


@dataclass(frozen=True)
class RejectionBackwardSampler(BackwardSampler):
    """Accept particles drawn by weight with probability p(next | x) / sup p, then draw exactly.

    Round k proposes 2^k candidates for each open path. A path that is open after N candidates is
    drawn exactly, since the number of candidates until acceptance may have an infinite mean. The
    distribution is that of `ExactBackwardSampler`. The bound is the largest density at the mode
    over the particles of a run.

    References:
        R. Douc, A. Garivier, E. Moulines and J. Olsson (2011), Sequential Monte Carlo smoothing for
        general state space hidden Markov models. H.-D. Dau and N. Chopin (2023), On backward
        smoothing algorithms, section 3.
    """

    needs_parents = False

    @override
    def __call__(self, step: BackwardStep, draws: RandomStream) -> Tensor:
        runs, count = step.next_x.shape[:2]
        bound = _largest_log_density(step.transition(step.x))[:, None, None]
        result = torch.zeros(runs, count, dtype=torch.long, device=step.x.device)
        is_open = torch.ones_like(result, dtype=torch.bool)
        k = 0
        while bool(is_open.any()) and 2**k < step.x.shape[1]:
            paths, is_valid = _list_open_paths(is_open)
            # a run's j-th open path has the same numbers in any batch
            u = _draw_uniforms(draws, f"rejection_{k}", paths.shape[1], 2 ** (k + 1))
            candidates = draw_by_weight(step.log_w, u[..., : 2**k].contiguous())
            ratio = step.log_density(candidates, paths) - bound
            accepted = u[..., 2**k :].log().to(ratio) < ratio
            first = accepted.to(torch.uint8).argmax(-1, keepdim=True)
            is_done = accepted.any(-1) & is_valid
            previous = result.gather(1, paths)
            new = torch.where(is_done, candidates.gather(-1, first).squeeze(-1), previous)
            result.scatter_(1, paths, new)
            is_open = is_open.scatter(1, paths, is_open.gather(1, paths) & ~is_done)
            k += 1
        if not bool(is_open.any()):
            return result
        paths, is_valid = _list_open_paths(is_open)
        new = torch.where(is_valid, _draw_exactly(step, paths, draws), result.gather(1, paths))
        return result.scatter(1, paths, new)


@dataclass(frozen=True)
class MetropolisBackwardSampler(BackwardSampler):
    """Metropolis-Hastings steps on the slot, from the parent of the later particle.

    A candidate is drawn by weight, and accepted by the ratio of its density to that of the present
    slot. The parent is a draw of the target as N grows, so that any number of steps is consistent.
    More steps make the paths of a run less alike.

    Attributes:
        mcmc_steps: Number of steps.

    Raises:
        ValueError: If mcmc_steps is below 1.

    References:
        P. Bunch and S. Godsill (2013), Improved particle approximations to the joint smoothing
        distribution using Markov chain Monte Carlo. H.-D. Dau and N. Chopin (2023).
    """

    mcmc_steps: int = 3
    needs_parents = True

    def __post_init__(self) -> None:
        require_ranges("sampler", self, mcmc_steps="[1, inf]")

    @override
    def __call__(self, step: BackwardStep, draws: RandomStream) -> Tensor:
        slots = step.parents
        paths = torch.arange(slots.shape[1], device=slots.device).expand(len(slots), -1)
        density = step.log_density(slots.unsqueeze(-1), paths).squeeze(-1)
        u = draws.uniform("metropolis", slots.shape[1], 2 * self.mcmc_steps)
        for k in range(self.mcmc_steps):
            candidate = draw_by_weight(step.log_w, u[..., 2 * k].contiguous())
            proposed = step.log_density(candidate.unsqueeze(-1), paths).squeeze(-1)
            accepted = u[..., 2 * k + 1].log().to(proposed) < proposed - density
            slots = torch.where(accepted, candidate, slots)
            density = torch.where(accepted, proposed, density)
        return slots


def _draw_exactly(step: BackwardStep, paths: Tensor, draws: RandomStream) -> Tensor:
    """Draw slots [R, m] of some paths [R, m] by weights times densities of all particles."""
    n, parts = step.x.shape[1], []
    slots = torch.arange(n, device=step.x.device)
    rows = max(1, _PAIRS // step.x.numel())
    u = _draw_uniforms(draws, "state", paths.shape[1], 1)
    for path, level in zip(paths.split(rows, 1), u.split(rows, 1), strict=True):
        log_density = step.log_density(slots.expand(*path.shape, -1), path)
        log_a = step.log_w.unsqueeze(1) + log_density
        cumulative = torch.softmax(log_a, -1).nan_to_num().cumsum(-1)
        parts.append(_invert(cumulative, level.to(cumulative)).squeeze(-1))
    return torch.cat(parts, 1)


def _draw_uniforms(draws: RandomStream, purpose: str, rows: int, columns: int) -> Tensor:
    """Draw [R, rows, columns]; the numbers of a row do not depend on the number of rows."""
    numbers = draws.uniform(purpose, 4, -(-rows * columns // 4)).mT.flatten(1)
    return numbers[:, : rows * columns].unflatten(1, (rows, columns))


def _invert(cumulative: Tensor, u: Tensor) -> Tensor:
    """Return the slots at which cumulative weights [..., N] pass levels u [..., m]."""
    level = (u * cumulative[..., -1:]).contiguous()
    return torch.searchsorted(cumulative, level, right=True).clamp(max=cumulative.shape[-1] - 1)


def _list_open_paths(is_open: Tensor) -> tuple[Tensor, Tensor]:
    """Return paths [R, m] with each run's open paths first, and a mask of these."""
    counts = is_open.sum(1)
    order = torch.sort(is_open.to(torch.uint8), dim=1, descending=True, stable=True).indices
    m = int(counts.max())
    return order[:, :m], torch.arange(m, device=is_open.device) < counts[:, None]


def _largest_log_density(distribution: Distribution) -> Tensor:
    """Return the largest log density [R] over the modes of a batch of distributions [R, N]."""
    try:
        return distribution.log_prob(distribution.mode).amax(1)
    except NotImplementedError as error:
        raise ValueError(
            "sampler must have a bound of the transition density, got a transition of type "
            f"{type(distribution).__name__} without a mode. Use MetropolisBackwardSampler."
        ) from error


def gather_states(x: Tensor, slots: Tensor) -> Tensor:
    """Gather [R, m, D] of x [R, N, D] by slots [R, m].

    Returns states, [R, m, D]. Shapes: x [R, N, D], slots [R, m].
    """
    return x.gather(1, slots.unsqueeze(-1).expand(-1, -1, x.shape[-1]))
