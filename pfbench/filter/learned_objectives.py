"""What a learned part of a filter is trained for: a loss of each step, less of which is better.

Some losses are a function of the filter's whole past, and their gradient passes through it, resampling included; others are of
one step, and the filter goes by without a gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, Info
from pfbench.filter.learned import Learned
from pfbench.filter.learned_draws import drawn
from pfbench.filter.learned_kernel import LearnedWalk
from pfbench.filter.moves import Metropolis
from pfbench.filter.particle import ParticleFilter
from pfbench.filter.proposals import draw_noise
from pfbench.model.base import AtRest, StateSpaceModel, initial_law
from pfbench.record import Record


class Lesson(NamedTuple):
    """One step as an objective sees it.

    Attributes:
        method, model: the filter, and what it believes of this step.
        before, after: its clouds at t-1 and t.
        info: what the step told.
        seen: at t.
        truth: the true state [R, D], NaN where it is not known.
        parent, noise: of an imagined world, the true state before and the noise that led on [R, D], [R, W]; else None.
        scale: standard deviations of the initial law [R or 1, d].
        draws: of this step.
    """

    method: ParticleFilter
    model: StateSpaceModel
    before: Cloud
    after: Cloud
    info: Info
    seen: Record
    truth: Tensor
    parent: Tensor | None
    noise: Tensor | None
    scale: Tensor
    draws: Draws


class Objective(Protocol):
    """A loss of each run and step [R].

    Attributes:
        through: its gradient passes through the filter.
        imagined: it needs worlds of which all is known: they are drawn anew from the model itself, with the inputs and the gaps
            of the worlds that it is given.
    """

    @property
    def through(self) -> bool: ...

    @property
    def imagined(self) -> bool: ...

    def __call__(self, lesson: Lesson) -> Tensor: ...


@dataclass(frozen=True)
class Bound:
    """Minus the growth of log Z_hat: E[log Z_hat] <= log p(y), tighter with more particles.

    The objective of variational SMC, FIVO and AESMC, which differ in when they resample [Naesseth et al. 2018; Maddison et al.
    2017; Le et al. 2018]. A step at which a run is lost teaches nothing.
    """

    through = True
    imagined = False

    def __call__(self, lesson: Lesson) -> Tensor:
        gone = torch.isfinite(lesson.after.log_z)
        return torch.where(gone, lesson.before.log_z - torch.where(gone, lesson.after.log_z, 0.0), 0.0)


@dataclass(frozen=True)
class StateError:
    """Mean square error of the estimate, each component in standard deviations of the initial law [ours].

    It asks for a good mean, not for good weights, and needs the truth and a resampling through which gradients pass
    [Jonschkowski, Rastogi, Brock 2018; Karkus, Hsu, Lee 2018]. The filter's weights stay corrected all the same.
    """

    through = True
    imagined = False

    def __call__(self, lesson: Lesson) -> Tensor:
        error = lesson.model.error(lesson.info.mean, lesson.truth) / lesson.scale
        known = torch.isfinite(error)
        return torch.where(known, error, 0.0).square().sum(-1) / known.sum(-1).clamp(min=1)


@dataclass(frozen=True)
class InferenceCompilation:
    """-log q(w | parent, y) of the noise that made an imagined world: forward KL, which covers all modes [Le, Baydin, Wood 2017].

    The proposal is asked at the true parent, beside the filter's cloud. Nothing of the filter needs a gradient.
    """

    through = False
    imagined = True

    def __call__(self, lesson: Lesson) -> Tensor:
        proposal = lesson.method.proposal
        if not isinstance(proposal, Learned):
            name = type(proposal).__name__
            raise ValueError(f"train.objective=InferenceCompilation: trains a Learned proposal, filter.proposal is {name}")
        if isinstance(lesson.model, AtRest):
            return torch.zeros_like(lesson.after.log_w[:, 0])
        assert lesson.parent is not None
        assert lesson.noise is not None
        return -proposal.log_density(lesson.model, lesson.before, lesson.seen, lesson.parent, lesson.noise)


@dataclass(frozen=True)
class Jump:
    """Minus the expected squared jump of a learned kernel, acceptance times length of step squared [Pasarica and Gelman 2010]."""

    through = False
    imagined = False

    def __call__(self, lesson: Lesson) -> Tensor:
        moves = lesson.method.moves
        found = [m.kernel for m in moves if isinstance(m, Metropolis) and isinstance(m.kernel, LearnedWalk)]
        if not found:
            raise ValueError("train.objective=Jump: trains a LearnedWalk, and filter.moves has none; choose filter=neural_mh")
        _, log_alpha, step = found[0].step(lesson.model, lesson.after, lesson.draws)
        share = torch.exp(torch.nan_to_num(log_alpha, -torch.inf, 0.0).clamp(max=0.0)) * lesson.after.log_w.exp()
        return -(share * step.square().mean(-1)).sum(-1)


def learned_parts(method: ParticleFilter) -> dict[str, Learned | LearnedWalk]:
    """What there is to train, by its name in a checkpoint.

    Raises:
        ValueError: nothing.
    """
    stages = [method.proposal, *(move.kernel for move in method.moves if isinstance(move, Metropolis))]
    parts = {stage.part: stage for stage in stages if isinstance(stage, Learned | LearnedWalk)}
    if not parts:
        raise ValueError("filter: there is nothing to train in it; choose one with a network, such as filter=neural_sir")
    return parts


def imagine(model: StateSpaceModel, record: Record, draws: Draws) -> tuple[Record, Tensor, Tensor]:
    """A world drawn from the model itself with the inputs, the starts and the gaps of a record.

    Returns:
        The record, with measurements drawn anew; the states from the first one on [R, T + 1, D]; the noises [R, T, W].

    Raises:
        ValueError: a model that gives no draws of its measurement.
    """
    runs, steps = record.y.shape[:2]
    start = model.origin.expand(runs, -1) if record.start is None else record.start
    z = draws.at(0).normal("imagined", 1, model.chart.dimension).squeeze(1)
    x = model.chart.add(start, drawn(initial_law(model, runs, record.spread), z, draws)).unsqueeze(1)
    states, noises, rows = [x], [], []
    for t in range(steps):
        seen, own = record.at(t), draws.at(t + 1)
        w = draw_noise(model, 1, own)
        if not (t == 0 and model.observes_initial):
            x = model.propagate(x, seen.u, w)
        y = drawn(model.observation(x, seen.u), own.normal("imagined", 1, seen.y.shape[-1]), own, "imagined")
        states.append(x)
        noises.append(w)
        rows.append(torch.where(torch.isnan(seen.y), torch.nan, y[:, 0]))
    return record._replace(y=torch.stack(rows, 1)), torch.cat(states, 1), torch.cat(noises, 1)
