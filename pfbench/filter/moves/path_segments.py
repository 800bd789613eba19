"""Segments of a path: densities, and proposals that ignore the measurements."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.linearisation import mean_noise
from pfbench.filter.moves.path_history import get_transition, stack_history
from pfbench.filter.particle.proposals import draw_noise
from pfbench.model.base import StateSpaceModel


class PathSegment(NamedTuple):
    """End of a path.

    Attributes:
        states: Fixed state, re-drawn states and child, [R, N, L+2, D].
        records: Records of all but the first state.
    """

    states: Tensor
    records: tuple[Record, ...]


class SegmentProposal(Protocol):
    """Distribution g of the states between the fixed one and the child."""

    @property
    def is_exact(self) -> bool:
        """True if the returned ratio belongs to g."""

    def __call__(
        self, model: StateSpaceModel, old: PathSegment, child: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor | None]:
        """Draw the states between the fixed one and the child.

        Args:
            model: State-space model.
            old: Present end of the path.
            child: Proposed child, [R, N, D].
            draws: Random stream.

        Returns:
            States [R, N, L, D], and a log ratio [R, N]: log g of the old states given the old
            child, minus log g of the new ones. The ratio is None if g without a density replaces
            p(block | fixed state, y).
        """


def measurement_log_density(model: StateSpaceModel, path: PathSegment) -> Tensor:
    """Compute log p(y_j | x_j) along the end of a path.

    Args:
        model: State-space model.
        path: End of a path.

    Returns:
        Log densities, [R, N, L+1].
    """
    return stack_history(
        [
            model.log_likelihood(record.y, path.states[:, :, j + 1], record.u)
            for j, record in enumerate(path.records)
        ]
    )


def transition_log_density(model: StateSpaceModel, path: PathSegment) -> Tensor:
    """Compute log p(x_j | x_j-1) along the end of a path.

    Args:
        model: State-space model.
        path: End of a path.

    Returns:
        Log densities, [R, N, L+1].
    """
    x = path.states
    return stack_history(
        [
            get_transition(model, x[:, :, j], record).log_prob(x[:, :, j + 1])
            for j, record in enumerate(path.records)
        ]
    )


def driving_noise(model: StateSpaceModel, path: PathSegment) -> Tensor:
    """Compute the noises that lead from state to state.

    Args:
        model: State-space model.
        path: End of a path.

    Returns:
        Noises, [R, N, L+1, W].

    Raises:
        ValueError: If the states of the model do not determine the noise.
    """
    noises = []
    for j, record in enumerate(path.records):
        gain, x = model.noise_gain(record.u), path.states[:, :, j]
        if gain is None or gain.shape[-2] != gain.shape[-1]:
            raise ValueError(
                "filter.moves must not combine this kernel with NoiseFlowKernel for a model whose "
                f"states do not determine its noise, got {type(model).__name__}. "
                "Remove one of the kernels."
            )
        prediction = model.propagate(x, record.u, mean_noise(model, x))
        r = model.chart.subtract(path.states[:, :, j + 1], prediction)
        noises.append(model.noise.mean + torch.linalg.solve_ex(gain, r.mT)[0].mT)
    return stack_history(noises)


@dataclass(frozen=True)
class PriorSegment(SegmentProposal):
    """Block from the model's dynamics, which is rarely accepted.

    The block depends neither on the measurements nor on the child.
    """

    is_exact = True

    @override
    def __call__(
        self, model: StateSpaceModel, old: PathSegment, child: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor | None]:
        states = [old.states[:, :, 0]]
        for j, record in enumerate(old.records[:-1]):
            w = draw_noise(model, child.shape[1], relabel(draws, f"block_{j}."))
            states.append(model.propagate(states[-1], record.u, w))
        if len(states) == 1:
            return old.states[:, :, :0], torch.zeros_like(child[..., 0])
        path = stack_history(states)
        log_new = transition_log_density(model, PathSegment(path, old.records[:-1]))
        before = PathSegment(old.states[:, :, :-1], old.records[:-1])
        return path[:, :, 1:], (transition_log_density(model, before) - log_new).sum(-1)


@dataclass(frozen=True)
class CopiedSegment(SegmentProposal):
    """Block of another particle. It lacks a density, so the ratio is approximate."""

    is_exact = False

    @override
    def __call__(
        self, model: StateSpaceModel, old: PathSegment, child: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor | None]:
        n = child.shape[1]
        index = (draws.uniform("other", n, 1).squeeze(2) * n).long().clamp(max=n - 1)
        return torch.take_along_dim(old.states[:, :, 1:-1], index[:, :, None, None], 1), None
