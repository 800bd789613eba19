"""Kernels of Markov chain Monte Carlo moves that draw the end of a path anew: the child, and the states before it.

Written t for the newest instant of the window, x_t the child and x_t-1 its parent. The child is sent off by a symmetric walk.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud
from pfbench.filter.derived_draws import named
from pfbench.filter.kernels import Walk
from pfbench.filter.linearisation import quiet
from pfbench.filter.proposals import draw_noise
from pfbench.filter.window import Path, join, transition
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


@dataclass(frozen=True)
class Tail:
    """Only x_t moves, its parent stays: beta = p(y_t | x') p(x' | x_t-1) / (p(y_t | x) p(x | x_t-1)).

    [Gilks and Berzuini 2001; Ristic, Arulampalam, Gordon 2004.] x_0 has no parent and stays.
    """

    walk: Walk = field(default_factory=Walk)
    exact = True
    keeps = Path(1, dense=True)

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        return Block(0, Simulated(), self.walk).propose(model, cloud, draws)


class Stretch(NamedTuple):
    """The end of a path: kept, re-drawn states, child [R, N, L+2, D]; what was seen at all but the first."""

    states: Tensor
    seen: tuple[Record, ...]


class Redraw(Protocol):
    """Other states between the kept one and the child, by a law g.

    Called with a stretch and the child that is proposed. Returns the states [R, N, L, D] and log g of the old ones given the
    old child, minus log g of the new ones given the new child [R, N]; None where g has no density and is passed off as
    p(block | kept, y).
    """

    @property
    def exact(self) -> bool: ...

    def __call__(self, model: StateSpaceModel, old: Stretch, child: Tensor, draws: Draws) -> tuple[Tensor, Tensor | None]: ...


@dataclass(frozen=True)
class Block:
    """The child moves and `length` states before it are locally resampled [Yan et al. 2016, eqs. 10-13].

    beta = prod_{j = t-length..t} p(y_j | x'_j) p(x'_j | x'_j-1) g(block) / (the same without primes, g(block')). With g exactly
    p(block | kept, y) this is the ratio of the child's terms alone, which is what the paper's lost eq. 13 must have been [ours].

    Args:
        length: states re-drawn; the paper's indices re-draw L of them, its words L - 1. Fewer near the start, x_0 is kept.
        redraw: g.
        walk: where the child goes.

    Raises:
        ValueError: a negative length; on use, a model whose transition has no density.
    """

    length: int
    redraw: Redraw
    walk: Walk = field(default_factory=Walk)

    def __post_init__(self) -> None:
        if self.length < 0:
            raise ValueError(f"kernel.length={self.length}: give the number of states to draw anew, 0 for none")

    @property
    def exact(self) -> bool:
        return self.redraw.exact

    @property
    def keeps(self) -> Path:
        return Path(self.length + 1, dense=True)

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        steps = len(cloud.past) - 1
        if steps < 1:
            return cloud, torch.full_like(cloud.log_w, -torch.inf)
        first = steps - min(self.length, steps - 1)
        window, old = cloud.window, Stretch(cloud.window["states"][:, :, first - 1 :], cloud.past[first:])
        child = model.chart.add(cloud.x, self.walk(model, cloud, cloud.x, draws))
        block, log_g = self.redraw(model, old, child, draws)
        new = Stretch(join([old.states[:, :, :1], block, child.unsqueeze(2)]), old.seen)
        log_like = sighted(model, new)
        gained = log_like + arrived(model, new) - window["log_like"][:, :, first:] - arrived(model, old)
        log_alpha = gained[..., -1] if log_g is None else gained.sum(-1) + log_g
        fresh = {"states": new.states[:, :, 1:], "log_like": log_like}
        if "noise" in window:
            fresh["noise"] = driven(model, new)
        ends = {name: join([window[name][:, :, : -a.shape[2]], a]) for name, a in fresh.items()}
        return cloud._replace(x=child, window=window | ends), log_alpha


def sighted(model: StateSpaceModel, path: Stretch) -> Tensor:
    """log p(y_j | x_j) [R, N, L+1]."""
    values = [model.log_likelihood(seen.y, path.states[:, :, j + 1], seen.u) for j, seen in enumerate(path.seen)]
    return join([a.unsqueeze(2) for a in values])


def arrived(model: StateSpaceModel, path: Stretch) -> Tensor:
    """log p(x_j | x_j-1) [R, N, L+1]."""
    x = path.states
    laws = [transition(model, x[:, :, j], seen) for j, seen in enumerate(path.seen)]
    return join([law.log_prob(x[:, :, j + 1]).unsqueeze(2) for j, law in enumerate(laws)])


def driven(model: StateSpaceModel, path: Stretch) -> Tensor:
    """The noises that lead from state to state [R, N, L+1, W].

    Raises:
        ValueError: a model in which they are not known from the states.
    """
    noises = []
    for j, seen in enumerate(path.seen):
        gain, x = model.noise_gain(seen.u), path.states[:, :, j]
        if gain is None or gain.shape[-2] != gain.shape[-1]:
            name = f"{type(model).__name__}'s noise"
            raise ValueError(f"filter.moves: {name} is not known from its states; do not mix this kernel with Flow")
        r = model.chart.subtract(path.states[:, :, j + 1], model.propagate(x, seen.u, quiet(model, x)))
        noises.append((model.noise.mean + torch.linalg.solve_ex(gain, r.mT)[0].mT).unsqueeze(2))
    return join(noises)


@dataclass(frozen=True)
class Simulated:
    """The block by the model's own dynamics from the kept state, blind to what was seen and to the child: rarely accepted."""

    exact = True

    def __call__(self, model: StateSpaceModel, old: Stretch, child: Tensor, draws: Draws) -> tuple[Tensor, Tensor | None]:
        states = [old.states[:, :, 0]]
        for j, seen in enumerate(old.seen[:-1]):
            w = draw_noise(model, child.shape[1], named(draws, f"block_{j}."))
            states.append(model.propagate(states[-1], seen.u, w))
        if len(states) == 1:
            return old.states[:, :, :0], torch.zeros_like(child[..., 0])
        path = join([x.unsqueeze(2) for x in states])
        new, before = Stretch(path, old.seen[:-1]), Stretch(old.states[:, :, :-1], old.seen[:-1])
        return path[:, :, 1:], (arrived(model, before) - arrived(model, new)).sum(-1)


@dataclass(frozen=True)
class Copied:
    """The block of another particle of the cloud, any one. It has no density, so the ratio is only approximate."""

    exact = False

    def __call__(self, model: StateSpaceModel, old: Stretch, child: Tensor, draws: Draws) -> tuple[Tensor, Tensor | None]:
        n = child.shape[1]
        other = (draws.uniform("other", n, 1).squeeze(2) * n).long().clamp(max=n - 1)
        return torch.take_along_dim(old.states[:, :, 1:-1], other[:, :, None, None], 1), None
