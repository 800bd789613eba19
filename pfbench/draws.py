"""Where randomness comes from: one counter-based stream per run.

Monte Carlo draws are Philox4x32-10 [Salmon, Moraes, Dror, Shaw 2011, "Parallel random numbers: as easy as 1, 2, 3"]. Every
number is a pure function of (seed, run, step, purpose, component, particle), so a run gets the same draws alone, in any batch
and on any device, and adding a filter, a run or a stage changes no one else's numbers. There is no generator state to carry,
to seed or to forget.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import torch
from torch import Tensor

from pfbench import cuda, native
from pfbench.fusion import fusible

_MULTIPLY = (0xD2511F53, 0xCD9E8D57)
_WEYL = (0x9E3779B9, 0xBB67AE85)
_WORD = 0xFFFFFFFF
_BLOCK = 16384  # words for which eager temporaries stay in the second-level cache: 19 -> 7 ms for 750 000 normals

Words: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor]


class Draws(Protocol):
    """What filters and worlds draw from. All arrays are [R, n, w] and belong to one step and one purpose.

    Quasi-Monte-Carlo sources obey the same protocol: n points in w dimensions, fresh for each step and purpose.
    """

    @property
    def dtype(self) -> torch.dtype:
        """Of the normals."""

    def at(self, step: int) -> Draws:
        """The same source at another time step."""

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        """Standard normal [R, n, w]."""

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        """Uniform on the open interval (0, 1) [R, n, w], float64: single precision has too few levels for 1e6 particles."""


class Source(Draws, Protocol):
    """Draws of a whole batch, which can be told apart by its runs."""

    def of(self, runs: slice) -> Draws:
        """The same source for some of the runs."""


def blocked_normals(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int) -> Tensor:
    """`normals`, component by component where the whole would fall out of the cache; the same numbers."""
    size = max(1, _BLOCK // max(1, runs.shape[0] * quarters))
    blocks = torch.arange(components, device=runs.device).split(size)
    return torch.cat([_boxed(_words((seed, purpose), step, runs, block, quarters)) for block in blocks])


def _normals(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int) -> Tensor:
    """Standard normals by Box and Muller, float32 [w, R, 4 q]: four for each counter (quarter, component, step, run).

    Args: seed [] and the purpose's number are the key; step [], runs [R], w components and q quarters the counter.
    """
    return _boxed(_words((seed, purpose), step, runs, torch.arange(components, device=runs.device), quarters))


def _boxed(words: Words) -> Tensor:
    parts = []
    a, b, c, d = words
    for radial, angular in ((a, b), (c, d)):
        # + 1/2 keeps the logarithm away from 0; a word that rounds up to 1 gives radius 0, which is harmless
        radius = torch.sqrt(-2.0 * torch.log((radial.float() + 0.5) * 2.0**-32))
        angle = angular.float() * (2.0 * torch.pi * 2.0**-32)
        parts += [radius * torch.cos(angle), radius * torch.sin(angle)]
    return torch.cat(parts, dim=-1)


def _eager_normals(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int) -> Tensor:
    """On a CUDA device by its kernel: in separate operations they would take nine tenths of a step there."""
    args = seed, purpose, step, runs, components, quarters
    return ((cuda.kernel("normals", args) if runs.is_cuda else None) or blocked_normals)(*args)


normals = fusible(_normals, eager=_eager_normals, by_hand=native.normals)


def _uniforms(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int) -> Tensor:
    """Uniforms on the open interval (0, 1), float64 [w, R, 4 q]; arguments as for `normals`."""
    words = _words((seed, purpose), step, runs, torch.arange(components, device=runs.device), quarters)
    return (torch.cat(words, dim=-1).double() + 0.5) * 2.0**-32


def _eager_uniforms(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int) -> Tensor:
    args = seed, purpose, step, runs, components, quarters
    return ((cuda.kernel("uniforms", args) if runs.is_cuda else None) or _uniforms)(*args)


uniforms = fusible(_uniforms, eager=_eager_uniforms, by_hand=native.uniforms)


@dataclass(frozen=True, eq=False)
class MonteCarlo:
    """Independent draws.

    Args:
        seed: an integer from 0 to 2**32 - 1; in a recorded step a tensor [], as `step` is.
        runs: run numbers, int64 [R]; a run's number, not its place in the batch, decides its draws.
        dtype: of the normals. They are made in single precision (24 bits of resolution, largest value 6.7) and then
            converted: no statistic of ours can tell their law from a double-precision one, and they cost a sixth.
        step: time step; 0 is the time of the initial law.

    Raises:
        ValueError: seed out of range.
    """

    seed: int | Tensor
    runs: Tensor
    dtype: torch.dtype = torch.float64
    step: int | Tensor = 0

    def __post_init__(self) -> None:
        if not isinstance(self.seed, Tensor) and not 0 <= self.seed <= _WORD:
            raise ValueError(f"seed={self.seed}: give an integer from 0 to 2**32 - 1")

    def at(self, step: int) -> MonteCarlo:
        return replace(self, step=step)

    def of(self, runs: slice) -> MonteCarlo:
        return replace(self, runs=self.runs[runs])

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        return normals(*self._counter(purpose, n, w))[..., :n].to(self.dtype).permute(1, 2, 0)

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return uniforms(*self._counter(purpose, n, w))[..., :n].permute(1, 2, 0)

    def _counter(self, purpose: str, n: int, w: int) -> tuple[Tensor, int, Tensor, Tensor, int, int]:
        seed, step = torch.as_tensor(self.seed), torch.as_tensor(self.step)
        return seed, zlib.crc32(purpose.encode()), step, self.runs, w, -(-n // 4)


def _words(key: tuple[Tensor, int], step: Tensor, runs: Tensor, component: Tensor, quarters: int) -> Words:
    """Four random words for each (component, run, quarter of the particles): [w, R, q] each."""
    particle, step, seed = torch.arange(quarters, device=runs.device), step.to(runs.device), key[0].to(runs.device)
    shape = (component.shape[0], runs.shape[0], quarters)
    counter = (particle, component[:, None, None], step, runs[:, None])
    c0, c1, c2, c3 = (part.expand(shape) for part in counter)
    return philox((c0, c1, c2, c3), (seed, key[1]))


def philox(counter: Words, key: tuple[Tensor | int, Tensor | int], rounds: int = 10) -> Words:
    """Philox4x32: counter and key as int64 tensors that hold 32-bit words, to four tensors of 32-bit random words.

    Agrees with the generator's published known-answer vectors. A 32 x 32 -> 64 bit product wraps around in int64; what the
    arithmetic shift drags along and the high half of the other product are masked away together, after the exclusive or.
    """
    c0, c1, c2, c3 = counter
    turn = torch.arange(rounds, device=counter[0].device)
    keys = zip(*(((k + weyl * turn) & _WORD).unbind(0) for k, weyl in zip(key, _WEYL, strict=True)), strict=True)
    for k0, k1 in keys:
        p0, p1 = c0 * _MULTIPLY[0], c2 * _MULTIPLY[1]
        c0, c1, c2, c3 = ((p1 >> 32) ^ c1 ^ k0) & _WORD, p1, ((p0 >> 32) ^ c3 ^ k1) & _WORD, p0
    return c0, c1 & _WORD, c2, c3 & _WORD
