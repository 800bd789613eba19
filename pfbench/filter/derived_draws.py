"""Draws made of other draws: under another name, of some runs only, or with every normal by inversion of a uniform."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch
from torch import Tensor

from pfbench.draws import Draws, MonteCarlo

Make: TypeAlias = Callable[[Draws, str, int, int], Tensor]
"""Draws to make of, purpose, n, w -> [R, n, w]."""


@dataclass(frozen=True, eq=False)
class Derived:
    """Draws of which each number is made of numbers of other draws, run by run.

    Args:
        draws: the others.
        uniforms, normals: how; None for normals that are the quantiles of the uniforms.
    """

    draws: Draws
    uniforms: Make
    normals: Make | None = None

    @property
    def dtype(self) -> torch.dtype:
        return self.draws.dtype

    def at(self, step: int) -> Draws:
        return replace(self, draws=self.draws.at(step))

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return self.uniforms(self.draws, purpose, n, w)

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        if self.normals is None:
            return torch.special.ndtri(self.uniform(purpose, n, w)).to(self.dtype)
        return self.normals(self.draws, purpose, n, w)


def named(draws: Draws, name: str) -> Draws:
    """Draws under a name of their own, so that the sweeps and kernels of a step do not share any."""
    return Derived(draws, lambda d, p, n, w: d.uniform(name + p, n, w), lambda d, p, n, w: d.normal(name + p, n, w))


def of_runs(draws: Draws, rows: Tensor) -> Draws:
    """The draws of some runs; the others' numbers are not drawn, where that can be helped."""
    if isinstance(draws, Derived):
        return replace(draws, draws=of_runs(draws.draws, rows))
    if isinstance(draws, MonteCarlo):
        return replace(draws, runs=draws.runs[rows])
    return Derived(draws, lambda d, p, n, w: d.uniform(p, n, w)[rows], lambda d, p, n, w: d.normal(p, n, w)[rows])
