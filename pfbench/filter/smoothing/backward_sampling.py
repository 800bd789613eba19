"""Smoothing of particle filters: paths by forward filtering and backward sampling."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import partial

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import BatchRandomStream, RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import Filter, ParticleBelief, StepInfo
from pfbench.filter.loop import prepare_record, run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.resampling import EssResampler, Resampler
from pfbench.filter.smoothing.backward_samplers import (
    BackwardSampler,
    BackwardStep,
    ExactBackwardSampler,
    draw_by_weight,
    gather_states,
)
from pfbench.filter.smoothing.gaussian_smoother import check_no_feedback
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
    if paths < 1:
        raise ValueError(f"trajectories: paths must be at least 1, got {paths}. Increase it.")
    check_no_feedback(record)
    sampler = sampler or ExactBackwardSampler()
    inputs = prepare_record(model, record)
    _check_dense(model, inputs, record)
    clouds, parents, lost = _filter_forward(method, model, record, draws, sampler)
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
    return torch.where(lost[:, None, None, None], torch.nan, torch.stack(path[::-1], 2))


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
) -> tuple[list[tuple[Tensor, Tensor]], list[Tensor], Tensor]:
    """Return particles and log weights of each step, their parents if needed, and lost runs [R]."""
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
    estimate = run_filter(method, model, record, draws, store)
    return clouds, parents, estimate.lost


def _check_dense(model: StateSpaceModel, inputs: Record, record: Record) -> None:
    """Raise an error if the model lacks a transition density."""
    start = (
        model.origin.expand(len(record.y), 1, -1)
        if inputs.start is None
        else inputs.start.unsqueeze(1)
    )
    if model.transition(start.to(model.anchor), inputs.at_step(0).u) is None:
        raise ValueError(
            "trajectories: model must have a transition density, got "
            f"{type(model).__name__} without one (fewer noise than state components). "
            "Use smooth() with a Gaussian filter."
        )
