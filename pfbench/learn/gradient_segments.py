"""Pass of a filter through training data, with gradients cut between segments."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import Filter, GaussianBelief, ParticleBelief, StepInfo
from pfbench.filter.learned.gain_filter import LearnedGainFilter
from pfbench.filter.learned.objectives import Objective, TrainableFilter, TrainingStep
from pfbench.filter.loop import FilterPass
from pfbench.learn.training_data import TrainingData
from pfbench.model.base import StateSpaceModel


def iterate_segments(
    objective: Objective,
    segment: int | None,
    method: TrainableFilter,
    model: StateSpaceModel,
    data: TrainingData,
    draws: RandomStream,
    scale: Tensor,
) -> Iterator[tuple[Tensor, Tensor]]:
    """Iterate over segments of steps of training data, without gradients between them.

    Args:
        objective: Loss function.
        segment: Steps of a segment. None for all.
        method: The filter.
        model: State-space model.
        data: Training data of R runs.
        draws: Random stream of the filter.
        scale: Standard deviations of the initial distribution, [R or 1, d].

    Yields:
        Losses and ESS / N of a segment's S steps, [S, R] each. ESS / N is NaN without particles.
    """
    steps = data.record.y.shape[1]
    recording = torch.is_grad_enabled() and objective.needs_filter_gradient
    filter_pass = FilterPass(_GradientMode(method, recording), model, data.record, draws)
    losses, ess_fractions, before = [], [], filter_pass.belief
    for t, step_model, record, info, step_draws in filter_pass:
        parent, noise = (None if a is None else a[:, t] for a in (data.parents, data.noises))
        training_step = TrainingStep(
            method, step_model, before, filter_pass.belief, info, record,
            data.states[:, t], parent, noise, scale, relabel(step_draws, "lesson."),
        )  # fmt: skip
        losses.append(objective(training_step))
        ess_fractions.append(_ess_fraction(method, info))
        if t + 1 == steps or (segment is not None and (t + 1) % segment == 0):
            yield torch.stack(losses), torch.stack(ess_fractions)
            losses, ess_fractions = [], []
            filter_pass.belief = _detach(filter_pass.belief)
        before = filter_pass.belief


@dataclass(frozen=True)
class _GradientMode:
    """A filter whose steps record gradients if enabled."""

    method: Filter
    enabled: bool

    @property
    def is_exact(self) -> bool:
        return self.method.is_exact

    def init(self, *args: Any) -> Any:
        return self.method.init(*args)

    def step(
        self, model: StateSpaceModel, belief: Any, record: Record, draws: RandomStream
    ) -> tuple[Any, StepInfo]:
        with torch.set_grad_enabled(self.enabled):
            return self.method.step(model, belief, record, draws)


def _ess_fraction(method: TrainableFilter, info: StepInfo) -> Tensor:
    """Return ESS / N of a step, [R]; NaN for a filter without particles."""
    if isinstance(method, LearnedGainFilter):
        return torch.full_like(info.mean[:, 0], torch.nan).detach()
    return info.trace["ess"].detach() / method.particles


def _detach(value: Any) -> Any:
    """Return a belief, or a part of one, without gradient history."""
    if isinstance(value, Tensor):
        return value.detach()
    if isinstance(value, dict):
        return {name: _detach(a) for name, a in value.items()}
    if isinstance(value, ParticleBelief | GaussianBelief):
        return value._replace(**{name: _detach(a) for name, a in value._asdict().items()})
    return value
