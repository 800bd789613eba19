"""MCMC kernels that draw the end of a path: the child and previous states.

t is the newest step of the window, x_t the child and x_t-1 its parent. A symmetric random walk
proposes the child.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.moves.flow_kernels import RandomWalk
from pfbench.filter.moves.metropolis import McmcKernel
from pfbench.filter.moves.path_history import (
    StateHistory,
    concatenate_histories,
)
from pfbench.filter.moves.path_segments import (
    PathSegment,
    PriorSegment,
    SegmentProposal,
    driving_noise,
    measurement_log_density,
    transition_log_density,
)
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class LastStateKernel(McmcKernel):
    """Move x_t only, with its parent fixed.

    The ratio is beta = p(y_t | x') p(x' | x_t-1) / (p(y_t | x) p(x | x_t-1)). x_0 does not move.
    See [Gilks and Berzuini 2001; Ristic, Arulampalam, Gordon 2004].

    Attributes:
        random_walk: Step of x_t.
    """

    random_walk: RandomWalk = field(default_factory=RandomWalk)
    required_history = StateHistory(1, store_density=True)

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(**{"kernel.walk": self.random_walk})

    @override
    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        return PathBlockKernel(0, PriorSegment(), self.random_walk).propose(model, belief, draws)


@dataclass(frozen=True)
class PathBlockKernel(McmcKernel):
    """Move the child and locally resample `block_length` states before it.

    [Yan et al. 2016, eqs. 10-13]: beta = prod_{j = t-length..t} p(y_j | x'_j) p(x'_j | x'_j-1)
    g(block) / (the same product without primes and with g(block')). If g is exactly
    p(block | fixed state, y), this is the ratio of the child's terms alone. The missing eq. 13 of
    the paper was probably this ratio [ours].

    Attributes:
        block_length: Number of re-drawn states. The paper's indices re-draw L of them, its text
            L - 1. Fewer are available near the start, and x_0 does not move.
        segment_proposal: g.
        random_walk: Step of the child.

    Raises:
        ValueError: If the length is negative. On use, if the transition density does not exist.
    """

    block_length: int
    segment_proposal: SegmentProposal
    random_walk: RandomWalk = field(default_factory=RandomWalk)

    def __post_init__(self) -> None:
        if self.block_length < 0:
            raise ValueError(
                f"kernel.block_length must be at least 0, got {self.block_length}. "
                "Use 0 to re-draw no state."
            )

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(
            **{"kernel.redraw": self.segment_proposal, "kernel.walk": self.random_walk}
        )

    @property
    @override
    def required_history(self) -> StateHistory:
        return StateHistory(self.block_length + 1, store_density=True)

    @override
    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        steps = len(belief.past) - 1
        if steps < 1:
            return belief, torch.full_like(belief.log_w, -torch.inf)
        first = steps - min(self.block_length, steps - 1)
        window = belief.window
        old = PathSegment(window["states"][:, :, first - 1 :], belief.past[first:])
        child = model.chart.add(belief.x, self.random_walk(model, belief, belief.x, draws))
        block, log_g = self.segment_proposal(model, old, child, draws)
        new = PathSegment(
            concatenate_histories([old.states[:, :, :1], block, child.unsqueeze(2)]), old.records
        )
        log_like = measurement_log_density(model, new)
        log_ratios = (
            log_like
            + transition_log_density(model, new)
            - window["log_like"][:, :, first:]
            - transition_log_density(model, old)
        )
        log_alpha = log_ratios[..., -1] if log_g is None else log_ratios.sum(-1) + log_g
        new_window = {"states": new.states[:, :, 1:], "log_like": log_like}
        if "noise" in window:
            new_window["noise"] = driving_noise(model, new)
        ends = {
            name: concatenate_histories([window[name][:, :, : -a.shape[2]], a])
            for name, a in new_window.items()
        }
        return belief._replace(x=child, window=window | ends), log_alpha
