"""Moves for the tests: filters with a move, and one that accepts everything."""

import dataclasses
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.filter import (
    EssResampler,
    McmcKernel,
    Move,
    ParticleBelief,
    ParticleFilter,
    Systematic,
)


def moving(*moves: Move, n: int = 40, threshold: float = 1.0) -> ParticleFilter:
    return ParticleFilter(n, EssResampler(Systematic(), threshold), moves=moves)


@dataclasses.dataclass(frozen=True)
class Always(McmcKernel):
    """Accepts whatever is proposed."""

    kernel: McmcKernel
    is_exact = False

    @property
    @override
    def required_history(self) -> Any:
        return self.kernel.required_history

    @override
    def propose(
        self, model: Any, belief: ParticleBelief, draws: Any
    ) -> tuple[ParticleBelief, Tensor]:
        return self.kernel.propose(model, belief, draws)[0], torch.zeros_like(belief.log_w)
