"""Moves: rejuvenation of refreshed runs by Markov kernels.

A kernel leaves the law of a particle's path given what was seen as it is, so a move spreads copies apart without changing
what the cloud stands for.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud
from pfbench.filter.derived_draws import named, of_runs
from pfbench.filter.window import Keeper
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record, map_inputs


class Move(Protocol):
    """A rejuvenation of the runs that were refreshed, from what the cloud carries; rate of acceptance [R], 0 where not hit."""

    @property
    def exact(self) -> bool: ...

    @property
    def keeps(self) -> Keeper | None:
        """What it needs the particles to carry."""

    def __call__(self, model: StateSpaceModel, cloud: Cloud, hit: Tensor, draws: Draws) -> tuple[Cloud, Tensor]: ...


class Kernel(Protocol):
    """Proposes a cloud with other pasts, and the log of the Metropolis-Hastings ratio [R, N]; NaN is never accepted."""

    @property
    def exact(self) -> bool:
        """Does it leave p(x_0:t | y_1:t) invariant?"""

    @property
    def keeps(self) -> Keeper: ...

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]: ...


@dataclass(frozen=True)
class Metropolis:
    """Metropolis-Hastings steps, one chain per particle, all chains at once [Gilks and Berzuini 2001].

    Args:
        kernel: what is proposed.
        sweeps: steps at each refresh; 0 makes no move.

    Raises:
        ValueError: a negative number of sweeps.
    """

    kernel: Kernel
    sweeps: int = 1

    def __post_init__(self) -> None:
        if self.sweeps < 0:
            raise ValueError(f"move.sweeps={self.sweeps}: give the number of Metropolis-Hastings steps, 0 for none")

    @property
    def exact(self) -> bool:
        return self.kernel.exact or self.sweeps == 0

    @property
    def keeps(self) -> Keeper | None:
        return self.kernel.keeps if self.sweeps else None

    def __call__(self, model: StateSpaceModel, cloud: Cloud, hit: Tensor, draws: Draws) -> tuple[Cloud, Tensor]:
        rate = torch.zeros_like(cloud.log_w[:, 0])
        if self.sweeps == 0:
            return cloud, rate
        if cloud.x.is_cuda:  # there a mask is cheaper than waiting for the number of runs
            moved, accepted = self._sweep(model, cloud, draws)
            return _put(cloud, moved, None, hit), torch.where(hit, self._rate(accepted, cloud.log_w), rate)
        rows = hit.nonzero().squeeze(1)
        if len(rows) == 0:
            return cloud, rate
        moved, accepted = self._sweep(model, _pick(cloud, rows), of_runs(draws, rows))
        return _put(cloud, moved, rows, hit), rate.index_copy(0, rows, self._rate(accepted, moved.log_w))

    def _sweep(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        living = torch.isfinite(cloud.log_w)
        accepted = torch.zeros_like(cloud.log_w)
        for sweep in range(self.sweeps):
            own = named(draws, f"sweep_{sweep}.")
            proposed, log_alpha = self.kernel.propose(model, cloud, own)
            toss = torch.log(own.uniform("accept", living.shape[1], 1).squeeze(2))
            accept = toss < log_alpha  # never where it is NaN
            cloud = _choose(accept, proposed, cloud)
            accepted = accepted + (accept & living)
        if cloud.copy_of is not None:
            itself = torch.arange(living.shape[1], 2 * living.shape[1], device=accepted.device)
            cloud = cloud._replace(copy_of=torch.where(accepted > 0.0, itself, cloud.copy_of))
        return cloud, accepted

    def _rate(self, accepted: Tensor, log_w: Tensor) -> Tensor:
        return accepted.sum(1) / (self.sweeps * torch.isfinite(log_w).sum(1))


@dataclass(frozen=True)
class Cycle:
    """Moves in turn, `sweeps` times over; a cycle of kernels that leave a law invariant does so too."""

    moves: Sequence[Move]
    sweeps: int = 1

    @property
    def exact(self) -> bool:
        return all(move.exact for move in self.moves)

    @property
    def keeps(self) -> Keeper | None:
        return together(self.moves)

    def __call__(self, model: StateSpaceModel, cloud: Cloud, hit: Tensor, draws: Draws) -> tuple[Cloud, Tensor]:
        total = torch.zeros_like(cloud.log_w[:, 0])
        for turn in range(self.sweeps):
            for i, move in enumerate(self.moves):
                cloud, rate = move(model, cloud, hit, named(draws, f"turn_{turn}.{i}."))
                total = total + rate
        return cloud, total / max(1, self.sweeps * len(self.moves))


def together(moves: Sequence[Move]) -> Keeper | None:
    """One keeper for all moves; None where none of them needs a past."""
    kept: Keeper | None = None
    for keeper in (move.keeps for move in moves):
        if keeper is not None:
            kept = keeper if kept is None else kept.joined(keeper)
    return kept


def _pick(cloud: Cloud, rows: Tensor) -> Cloud:
    """Some runs of a cloud, without its memory."""
    runs = cloud.x.shape[0]
    if len(rows) == runs:
        return cloud

    def of(a: Tensor) -> Tensor:
        order = (*range(2, a.dim()), 0, 1)
        back = (a.dim() - 2, a.dim() - 1, *range(a.dim() - 2))
        return a.permute(order).index_select(a.dim() - 2, rows).permute(back)

    def some(a: Tensor) -> Tensor:
        return a[rows] if len(a) == runs else a

    return Cloud(
        x=of(cloud.x),
        log_w=cloud.log_w[rows],
        log_z=cloud.log_z[rows],
        window={name: of(a) for name, a in cloud.window.items()},
        past=tuple(Record(seen.y[rows], map_inputs(some, seen.u)) for seen in cloud.past),
        copy_of=None if cloud.copy_of is None else cloud.copy_of[rows],
    )


def _put(cloud: Cloud, moved: Cloud, rows: Tensor | None, hit: Tensor) -> Cloud:
    """The states and windows of the moved runs put back; what all particles share has not moved."""

    def back(old: Tensor, new: Tensor) -> Tensor:
        if old.shape[1] == 1 or old is new:
            return old
        if rows is None:
            return _where(hit.unsqueeze(1), new, old)
        return new if len(rows) == len(old) else old.index_copy(0, rows, new)

    window = {name: back(old, moved.window[name]) for name, old in cloud.window.items()}
    copy_of = None
    if cloud.copy_of is not None and moved.copy_of is not None:
        copy_of = back(cloud.copy_of, moved.copy_of)
    return cloud._replace(x=back(cloud.x, moved.x), window=window, copy_of=copy_of)


def _choose(accept: Tensor, new: Cloud, old: Cloud) -> Cloud:
    """Particle by particle: `new` where accepted [R, N]."""
    window = {name: a if new.window[name] is a else _where(accept, new.window[name], a) for name, a in old.window.items()}
    return old._replace(x=_where(accept, new.x, old.x), window=window)


def _where(chosen: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """[R, N or 1] chooses among [R, N, ...]."""
    return torch.where(chosen.reshape(*chosen.shape, *[1] * (old.dim() - 2)), new, old)
