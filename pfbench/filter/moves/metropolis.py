"""MCMC moves of particles after resampling.

A kernel leaves the distribution of a particle's path given the record invariant. A move makes copies
distinct and keeps the target.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.core.derived_stream import relabel, select_runs
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.moves.path_history import PathHistory
from pfbench.model.base import StateSpaceModel


class Move(Protocol):
    """Move the particles of resampled runs.

    It returns the belief and the acceptance rate [R], 0 in other runs.
    """

    @property
    def is_exact(self) -> bool:
        """Whether it leaves p(x_0:t | y_1:t) invariant."""

    @property
    def required_history(self) -> PathHistory | None:
        """History that the particles must store."""

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, hit: Tensor, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]: ...


class McmcKernel(Protocol):
    """Proposal of paths for Metropolis-Hastings steps."""

    @property
    def is_exact(self) -> bool:
        """Whether it leaves p(x_0:t | y_1:t) invariant."""

    @property
    def required_history(self) -> PathHistory:
        """History that the particles must store."""

    def propose(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        """Propose paths, with the log Metropolis-Hastings ratio [R, N]. NaN is never accepted."""


@dataclass(frozen=True)
class MetropolisHastings:
    """Metropolis-Hastings steps, one chain per particle, in one batch [Gilks and Berzuini 2001].

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
                f"move.mcmc_steps must be 0 or more, got {self.mcmc_steps}. Choose the number of MCMC steps"
            )

    @property
    def is_exact(self) -> bool:
        """Whether it leaves p(x_0:t | y_1:t) invariant."""
        return self.mcmc_steps == 0 or is_every_part_exact(**{"move.kernel": self.kernel})

    @property
    def required_history(self) -> PathHistory | None:
        """History that the particles must store."""
        return self.kernel.required_history if self.mcmc_steps else None

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, hit: Tensor, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        rate = torch.zeros_like(belief.log_w[:, 0])
        if self.mcmc_steps == 0:
            return belief, rate
        if belief.x.is_cuda:  # a mask is cheaper than waiting for the number of runs
            moved_belief, accepted = self._sweep(model, belief, draws)
            return _put(belief, moved_belief, None, hit), torch.where(
                hit, self._rate(accepted, belief.log_w), rate
            )
        rows = hit.nonzero().squeeze(1)
        if len(rows) == 0:
            return belief, rate
        moved_belief, accepted = self._sweep(model, _pick(belief, rows), select_runs(draws, rows))
        return _put(belief, moved_belief, rows, hit), rate.index_copy(
            0, rows, self._rate(accepted, moved_belief.log_w)
        )

    def _sweep(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        living = torch.isfinite(belief.log_w)
        accepted = torch.zeros_like(belief.log_w)
        for sweep in range(self.mcmc_steps):
            step_draws = relabel(draws, f"sweep_{sweep}.")
            proposed, log_alpha = self.kernel.propose(model, belief, step_draws)
            toss = torch.log(step_draws.uniform("accept", living.shape[1], 1).squeeze(2))
            accept = toss < log_alpha  # never where it is NaN
            belief = _choose(accept, proposed, belief)
            accepted = accepted + (accept & living)
        if belief.ancestors is not None:
            itself = torch.arange(living.shape[1], 2 * living.shape[1], device=accepted.device)
            belief = belief._replace(
                ancestors=torch.where(accepted > 0.0, itself, belief.ancestors)
            )
        return belief, accepted

    def _rate(self, accepted: Tensor, log_w: Tensor) -> Tensor:
        return accepted.sum(1) / (self.mcmc_steps * torch.isfinite(log_w).sum(1))


@dataclass(frozen=True)
class KernelCycle:
    """Moves in turn, repeated. A cycle of invariant kernels is invariant.

    Attributes:
        moves: Moves in order.
        mcmc_steps: Number of repetitions.
    """

    moves: Sequence[Move]
    mcmc_steps: int = 1

    @property
    def is_exact(self) -> bool:
        """Whether it leaves p(x_0:t | y_1:t) invariant."""
        return is_every_part_exact(
            **{f"move.moves[{i}]": move for i, move in enumerate(self.moves)}
        )

    @property
    def required_history(self) -> PathHistory | None:
        """History that the particles must store."""
        return combine_histories(self.moves)

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, hit: Tensor, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        total = torch.zeros_like(belief.log_w[:, 0])
        for turn in range(self.mcmc_steps):
            for i, move in enumerate(self.moves):
                belief, rate = move(model, belief, hit, relabel(draws, f"turn_{turn}.{i}."))
                total = total + rate
        return belief, total / max(1, self.mcmc_steps * len(self.moves))


def combine_histories(moves: Sequence[Move]) -> PathHistory | None:
    """Return one history for all moves.

    Args:
        moves: Moves of a filter.

    Returns:
        The joint history, None if no move needs any.
    """
    joint: PathHistory | None = None
    for keeper in (move.required_history for move in moves):
        if keeper is not None:
            joint = keeper if joint is None else joint.merge(keeper)
    return joint


def _pick(belief: ParticleBelief, rows: Tensor) -> ParticleBelief:
    """Return some runs of a belief, without its memory."""
    runs = belief.x.shape[0]
    if len(rows) == runs:
        return belief

    def of(a: Tensor) -> Tensor:
        order = (*range(2, a.dim()), 0, 1)
        back = (a.dim() - 2, a.dim() - 1, *range(a.dim() - 2))
        return a.permute(order).index_select(a.dim() - 2, rows).permute(back)

    def some(a: Tensor) -> Tensor:
        return a[rows] if len(a) == runs else a

    return ParticleBelief(
        x=of(belief.x),
        log_w=belief.log_w[rows],
        log_evidence=belief.log_evidence[rows],
        window={name: of(a) for name, a in belief.window.items()},
        past=tuple(Record(seen.y[rows], map_inputs(some, seen.u)) for seen in belief.past),
        ancestors=None if belief.ancestors is None else belief.ancestors[rows],
    )


def _put(
    belief: ParticleBelief, moved_belief: ParticleBelief, rows: Tensor | None, hit: Tensor
) -> ParticleBelief:
    """Put states and windows of the moved runs back. Parts shared by all particles do not move."""

    def back(old: Tensor, new: Tensor) -> Tensor:
        if old.shape[1] == 1 or old is new:
            return old
        if rows is None:
            return _where(hit.unsqueeze(1), new, old)
        return new if len(rows) == len(old) else old.index_copy(0, rows, new)

    window = {name: back(old, moved_belief.window[name]) for name, old in belief.window.items()}
    copy_of = None
    if belief.ancestors is not None and moved_belief.ancestors is not None:
        copy_of = back(belief.ancestors, moved_belief.ancestors)
    return belief._replace(x=back(belief.x, moved_belief.x), window=window, ancestors=copy_of)


def _choose(accept: Tensor, new: ParticleBelief, old: ParticleBelief) -> ParticleBelief:
    """Return `new` for accepted particles [R, N], else `old`."""
    window = {
        name: a if new.window[name] is a else _where(accept, new.window[name], a)
        for name, a in old.window.items()
    }
    return old._replace(x=_where(accept, new.x, old.x), window=window)


def _where(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Select among [R, N, ...] by a mask [R, N or 1]."""
    return torch.where(mask.reshape(*mask.shape, *[1] * (old.dim() - 2)), new, old)
