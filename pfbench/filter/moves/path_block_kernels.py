"""MCMC kernels that draw the end of a path: the child and previous states.

t is the newest step of the window, x_t the child and x_t-1 its parent. A symmetric random walk
proposes the child.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.linearisation import mean_noise
from pfbench.filter.moves.flow_kernels import RandomWalk
from pfbench.filter.moves.path_history import StateHistory, concatenate_histories, get_transition
from pfbench.filter.particle.proposals import draw_noise
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class LastStateKernel:
    """Move x_t only, with its parent fixed.

    The ratio is beta = p(y_t | x') p(x' | x_t-1) / (p(y_t | x) p(x | x_t-1)). x_0 does not move.
    See [Gilks and Berzuini 2001; Ristic, Arulampalam, Gordon 2004].

    Attributes:
        random_walk: Step of x_t.
    """

    random_walk: RandomWalk = field(default_factory=RandomWalk)
    required_history = StateHistory(1, store_density=True)

    @property
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"kernel.walk": self.random_walk})

    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        """Propose new last states and their log ratio [R, N]."""
        return PathBlockKernel(0, PriorSegment(), self.random_walk).propose(model, belief, draws)


class PathSegment(NamedTuple):
    """End of a path.

    Attributes:
        states: Fixed state, re-drawn states and child, [R, N, L+2, D].
        records: Records of all but the first state.
    """

    states: Tensor
    records: tuple[Record, ...]


class SegmentProposal(Protocol):
    """Distribution g of the states between the fixed one and the child.

    Called with a path end and the proposed child. Returns the states [R, N, L, D] and a log ratio
    [R, N]: log g of the old states given the old child, minus log g of the new ones. The second
    value is None if g without a density replaces p(block | fixed state, y).
    """

    @property
    def is_exact(self) -> bool:
        """Whether the returned ratio belongs to g."""

    def __call__(
        self, model: StateSpaceModel, old: PathSegment, child: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor | None]: ...


@dataclass(frozen=True)
class PathBlockKernel:
    """Move the child and locally resample `block_length` states before it.

    [Yan et al. 2016, eqs. 10-13]: beta = prod_{j = t-length..t} p(y_j | x'_j) p(x'_j | x'_j-1)
    g(block) / (the same product without primes and with g(block')). If g is exactly
    p(block | fixed state, y), this is the ratio of the child's terms alone. The missing eq. 13 of
    the paper must have been this [ours].

    Attributes:
        block_length: Number of re-drawn states. The paper's indices re-draw L of them, its text L - 1.
            Fewer are available near the start, and x_0 does not move.
        segment_proposal: g.
        random_walk: Step of the child.

    Raises:
        ValueError: If length is negative. On use, if the transition density does not exist.
    """

    block_length: int
    segment_proposal: SegmentProposal
    random_walk: RandomWalk = field(default_factory=RandomWalk)

    def __post_init__(self) -> None:
        if self.block_length < 0:
            raise ValueError(
                f"kernel.block_length must be at least 0, got {self.block_length}. Use 0 to re-draw no state."
            )

    @property
    def is_exact(self) -> bool:
        return is_every_part_exact(
            **{"kernel.redraw": self.segment_proposal, "kernel.walk": self.random_walk}
        )

    @property
    def required_history(self) -> StateHistory:
        """History that the kernel needs."""
        return StateHistory(self.block_length + 1, store_density=True)

    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        """Propose new path ends and their log ratio [R, N]."""
        steps = len(belief.past) - 1
        if steps < 1:
            return belief, torch.full_like(belief.log_w, -torch.inf)
        first = steps - min(self.block_length, steps - 1)
        window, old = (
            belief.window,
            PathSegment(belief.window["states"][:, :, first - 1 :], belief.past[first:]),
        )
        child = model.chart.add(belief.x, self.random_walk(model, belief, belief.x, draws))
        block, log_g = self.segment_proposal(model, old, child, draws)
        new = PathSegment(
            concatenate_histories([old.states[:, :, :1], block, child.unsqueeze(2)]), old.records
        )
        log_like = measurement_log_density(model, new)
        log_density_change = (
            log_like
            + transition_log_density(model, new)
            - window["log_like"][:, :, first:]
            - transition_log_density(model, old)
        )
        log_alpha = (
            log_density_change[..., -1] if log_g is None else log_density_change.sum(-1) + log_g
        )
        new_window = {"states": new.states[:, :, 1:], "log_like": log_like}
        if "noise" in window:
            new_window["noise"] = driving_noise(model, new)
        ends = {
            name: concatenate_histories([window[name][:, :, : -a.shape[2]], a])
            for name, a in new_window.items()
        }
        return belief._replace(x=child, window=window | ends), log_alpha


def measurement_log_density(model: StateSpaceModel, path: PathSegment) -> Tensor:
    """Compute log p(y_j | x_j) of a path end [R, N, L+1]."""
    values = [
        model.log_likelihood(seen.y, path.states[:, :, j + 1], seen.u)
        for j, seen in enumerate(path.records)
    ]
    return concatenate_histories([a.unsqueeze(2) for a in values])


def transition_log_density(model: StateSpaceModel, path: PathSegment) -> Tensor:
    """Compute log p(x_j | x_j-1) of a path end [R, N, L+1]."""
    x = path.states
    distributions = [get_transition(model, x[:, :, j], seen) for j, seen in enumerate(path.records)]
    return concatenate_histories(
        [
            distribution.log_prob(x[:, :, j + 1]).unsqueeze(2)
            for j, distribution in enumerate(distributions)
        ]
    )


def driving_noise(model: StateSpaceModel, path: PathSegment) -> Tensor:
    """Compute the noises that lead from state to state [R, N, L+1, W].

    Raises:
        ValueError: If the states of the model do not determine the noise.
    """
    noises = []
    for j, seen in enumerate(path.records):
        gain, x = model.noise_gain(seen.u), path.states[:, :, j]
        if gain is None or gain.shape[-2] != gain.shape[-1]:
            raise ValueError(
                "filter.moves must not combine this kernel with NoiseFlowKernel, got both: the states of "
                f"{type(model).__name__} do not determine its noise. Remove one of the kernels."
            )
        r = model.chart.subtract(
            path.states[:, :, j + 1], model.propagate(x, seen.u, mean_noise(model, x))
        )
        noises.append((model.noise.mean + torch.linalg.solve_ex(gain, r.mT)[0].mT).unsqueeze(2))
    return concatenate_histories(noises)


@dataclass(frozen=True)
class PriorSegment:
    """Draw the block from the model's dynamics, without the measurements or the child.

    Rarely accepted.
    """

    is_exact = True

    def __call__(
        self, model: StateSpaceModel, old: PathSegment, child: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor | None]:
        states = [old.states[:, :, 0]]
        for j, seen in enumerate(old.records[:-1]):
            w = draw_noise(model, child.shape[1], relabel(draws, f"block_{j}."))
            states.append(model.propagate(states[-1], seen.u, w))
        if len(states) == 1:
            return old.states[:, :, :0], torch.zeros_like(child[..., 0])
        path = concatenate_histories([x.unsqueeze(2) for x in states])
        new, before = (
            PathSegment(path, old.records[:-1]),
            PathSegment(old.states[:, :, :-1], old.records[:-1]),
        )
        return path[:, :, 1:], (
            transition_log_density(model, before) - transition_log_density(model, new)
        ).sum(-1)


@dataclass(frozen=True)
class CopiedSegment:
    """Copy the block of another particle. Without a density, the ratio is approximate."""

    is_exact = False

    def __call__(
        self, model: StateSpaceModel, old: PathSegment, child: Tensor, draws: RandomStream
    ) -> tuple[Tensor, Tensor | None]:
        n = child.shape[1]
        index = (draws.uniform("other", n, 1).squeeze(2) * n).long().clamp(max=n - 1)
        return torch.take_along_dim(old.states[:, :, 1:-1], index[:, :, None, None], 1), None
