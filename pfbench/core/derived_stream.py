"""Random streams derived from another: with other labels, of some runs, or transformed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TypeAlias

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream, RandomStream

Make: TypeAlias = Callable[[RandomStream, str, int, int], Tensor]
"""(stream, purpose, n, w) -> [R, n, w]."""


@dataclass(frozen=True, eq=False)
class DerivedStream(RandomStream):
    """Random stream whose numbers are functions of another stream's numbers, run by run.

    Attributes:
        draws: The other stream.
        uniforms: Function that draws uniforms from it.
        normals: Function that draws normals from it. None for the quantiles of the uniforms.
    """

    draws: RandomStream
    uniforms: Make
    normals: Make | None = None

    @property
    @override
    def dtype(self) -> torch.dtype:
        return self.draws.dtype

    @override
    def at_step(self, step: int) -> RandomStream:
        return replace(self, draws=self.draws.at_step(step))

    @override
    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return self.uniforms(self.draws, purpose, n, w)

    @override
    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        if self.normals is None:
            return torch.special.ndtri(self.uniform(purpose, n, w)).to(self.dtype)
        return self.normals(self.draws, purpose, n, w)


def relabel(draws: RandomStream, name: str) -> RandomStream:
    """Return a stream with a prefix to its labels, so that parts of a step do not share numbers.

    Args:
        draws: The other stream.
        name: Prefix of the labels.

    Returns:
        The derived stream.
    """
    return DerivedStream(
        draws,
        lambda d, p, n, w: d.uniform(name + p, n, w),
        lambda d, p, n, w: d.normal(name + p, n, w),
    )


def select_runs(draws: RandomStream, rows: Tensor) -> RandomStream:
    """Return the stream of some runs; where possible, the numbers of other runs are not drawn.

    Args:
        draws: Stream of all runs.
        rows: Indices or mask of the runs.

    Returns:
        The stream of these runs.
    """
    if isinstance(draws, DerivedStream):
        return replace(draws, draws=select_runs(draws.draws, rows))
    if isinstance(draws, PhiloxStream):
        return replace(draws, runs=draws.runs[rows])
    return DerivedStream(
        draws,
        lambda d, p, n, w: d.uniform(p, n, w)[rows],
        lambda d, p, n, w: d.normal(p, n, w)[rows],
    )
