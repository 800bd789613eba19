"""MCMC moves of particles after resampling.

A kernel leaves the distribution of a particle's path given the record invariant. A move makes
copies distinct and keeps the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.derived_stream import relabel, select_runs
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.moves.path_history import PathHistory, combine_histories
from pfbench.model.base import StateSpaceModel


class Move(Protocol):
    """MCMC move of the particles of resampled runs."""

    @property
    def is_exact(self) -> bool:
        """True if the move leaves p(x_0:t | y_1:t) invariant."""

    @property
    def required_history(self) -> PathHistory | None:
        """History that the particles must store."""

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, resampled: Tensor, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        """Move the particles.

        Args:
            model: State-space model of the step.
            belief: Particles after resampling, with their history.
            resampled: Mask of the resampled runs, [R].
            draws: Random stream of the move.

        Returns:
            Moved particles and acceptance rate [R], 0 in other runs.
        """


class McmcKernel(Protocol):
    """Proposal of paths for Metropolis-Hastings steps."""

    @property
    def is_exact(self) -> bool:
        """True if Metropolis-Hastings steps with it leave p(x_0:t | y_1:t) invariant."""

    @property
    def required_history(self) -> PathHistory:
        """History that the particles must store."""

    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        """Propose paths.

        Args:
            model: State-space model of the step.
            belief: Particles with their history.
            draws: Random stream of the Metropolis-Hastings step.

        Returns:
            Proposed particles and log Metropolis-Hastings ratio [R, N]. NaN is never accepted.
        """


@dataclass(frozen=True)
class MetropolisHastings(Move):
    """Metropolis-Hastings steps, one chain per particle [Gilks and Berzuini 2001].

    Attributes:
        kernel: Proposal of a step.
        mcmc_steps: Steps after each resampling. 0 makes no move.

    Raises:
        ValueError: If the number of steps is negative.
    """

    kernel: McmcKernel
    mcmc_steps: int = 1

    def __post_init__(self) -> None:
        if self.mcmc_steps < 0:
            raise ValueError(
                f"move.mcmc_steps must be 0 or more, got {self.mcmc_steps}. "
                "Choose the number of MCMC steps."
            )

    @property
    @override
    def is_exact(self) -> bool:
        return self.mcmc_steps == 0 or is_every_part_exact(**{"move.kernel": self.kernel})

    @property
    @override
    def required_history(self) -> PathHistory | None:
        return self.kernel.required_history if self.mcmc_steps else None

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, resampled: Tensor, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        rate = torch.zeros_like(belief.log_w[:, 0])
        if self.mcmc_steps == 0:
            return belief, rate
        if belief.x.is_cuda:  # a mask is cheaper than waiting for the number of runs
            moved_belief, accepted = self._sweep(model, belief, draws)
            rate = torch.where(resampled, self._rate(accepted, belief.log_w), rate)
            return _replace_runs(belief, moved_belief, None, resampled), rate
        rows = resampled.nonzero().squeeze(1)
        if len(rows) == 0:
            return belief, rate
        moved_belief, accepted = self._sweep(
            model, _select_runs(belief, rows), select_runs(draws, rows)
        )
        rate = rate.index_copy(0, rows, self._rate(accepted, moved_belief.log_w))
        return _replace_runs(belief, moved_belief, rows, resampled), rate

    def _sweep(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        active_mask = torch.isfinite(belief.log_w)
        accepted = torch.zeros_like(belief.log_w)
        for sweep in range(self.mcmc_steps):
            step_draws = relabel(draws, f"sweep_{sweep}.")
            proposed, log_alpha = self.kernel.propose(model, belief, step_draws)
            log_u = torch.log(step_draws.uniform("accept", active_mask.shape[1], 1).squeeze(2))
            accept = log_u < log_alpha  # never where it is NaN
            belief = _choose(accept, proposed, belief)
            accepted = accepted + (accept & active_mask)
        if belief.ancestors is not None:
            n = active_mask.shape[1]
            moved_slots = torch.arange(n, 2 * n, device=accepted.device)
            ancestors = torch.where(accepted > 0.0, moved_slots, belief.ancestors)
            belief = belief._replace(ancestors=ancestors)
        return belief, accepted

    def _rate(self, accepted: Tensor, log_w: Tensor) -> Tensor:
        return accepted.sum(1) / (self.mcmc_steps * torch.isfinite(log_w).sum(1))


@dataclass(frozen=True)
class KernelCycle(Move):
    """Moves in turn, repeated. A cycle of invariant kernels is invariant.

    Attributes:
        moves: Moves in order.
        mcmc_steps: Number of repetitions.
    """

    moves: Sequence[Move]
    mcmc_steps: int = 1

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(
            **{f"move.moves[{i}]": move for i, move in enumerate(self.moves)}
        )

    @property
    @override
    def required_history(self) -> PathHistory | None:
        return combine_histories([move.required_history for move in self.moves])

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, resampled: Tensor, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        total = torch.zeros_like(belief.log_w[:, 0])
        for turn in range(self.mcmc_steps):
            for i, move in enumerate(self.moves):
                belief, rate = move(model, belief, resampled, relabel(draws, f"turn_{turn}.{i}."))
                total = total + rate
        return belief, total / max(1, self.mcmc_steps * len(self.moves))


def _select_runs(belief: ParticleBelief, rows: Tensor) -> ParticleBelief:
    """Return some runs of a belief, without its memory."""
    runs = belief.x.shape[0]
    if len(rows) == runs:
        return belief

    def select_rows(a: Tensor) -> Tensor:
        order = (*range(2, a.dim()), 0, 1)
        back = (a.dim() - 2, a.dim() - 1, *range(a.dim() - 2))
        return a.permute(order).index_select(a.dim() - 2, rows).permute(back)

    def select_input(a: Tensor) -> Tensor:
        return a[rows] if len(a) == runs else a

    return ParticleBelief(
        x=select_rows(belief.x),
        log_w=belief.log_w[rows],
        log_evidence=belief.log_evidence[rows],
        window={name: select_rows(a) for name, a in belief.window.items()},
        past=tuple(
            Record(record.y[rows], map_inputs(select_input, record.u)) for record in belief.past
        ),
        ancestors=None if belief.ancestors is None else belief.ancestors[rows],
    )


def _replace_runs(
    belief: ParticleBelief, moved_belief: ParticleBelief, rows: Tensor | None, resampled: Tensor
) -> ParticleBelief:
    """Return a belief with the states and windows of the moved runs.

    Tensors that all particles of a run share do not change.
    """

    def replace(old: Tensor, new: Tensor) -> Tensor:
        if old.shape[1] == 1 or old is new:
            return old
        if rows is None:
            return _where(resampled.unsqueeze(1), new, old)
        return new if len(rows) == len(old) else old.index_copy(0, rows, new)

    window = {name: replace(old, moved_belief.window[name]) for name, old in belief.window.items()}
    ancestors = None
    if belief.ancestors is not None and moved_belief.ancestors is not None:
        ancestors = replace(belief.ancestors, moved_belief.ancestors)
    return belief._replace(x=replace(belief.x, moved_belief.x), window=window, ancestors=ancestors)


def _choose(accept: Tensor, new: ParticleBelief, old: ParticleBelief) -> ParticleBelief:
    """Return `new` for accepted particles [R, N] and `old` for others."""
    window = {
        name: a if new.window[name] is a else _where(accept, new.window[name], a)
        for name, a in old.window.items()
    }
    return old._replace(x=_where(accept, new.x, old.x), window=window)


def _where(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Select among [R, N, ...] by a mask [R, N or 1]."""
    return torch.where(mask.reshape(*mask.shape, *[1] * (old.dim() - 2)), new, old)
