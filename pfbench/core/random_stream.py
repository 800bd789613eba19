"""Counter-based random streams: Philox4x32-10.

Each number is a pure function of (seed, run, step, purpose, component, particle). A run therefore
gets the same numbers alone, in any batch and on any device. More filters, runs or stages do not
change the numbers of the others. The generator is stateless.

References:
    J. Salmon, M. Moraes, R. Dror and D. Shaw (2011), Parallel random numbers: as easy as 1, 2, 3.
"""

from __future__ import annotations

import zlib
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import check_run_numbers
from pfbench.kernels import cpp, cuda
from pfbench.kernels.compilation import compilable

_MULTIPLY = (0xD2511F53, 0xCD9E8D57)
_WEYL = (0x9E3779B9, 0xBB67AE85)
_WORD = 0xFFFFFFFF
_BLOCK = 16384  # words whose temporaries fit the second-level cache: 7 instead of 19 ms for 750 000 normals

Words: TypeAlias = tuple[Tensor, Tensor, Tensor, Tensor]


class RandomStream(Protocol):
    """A random stream of R runs. Its arrays [R, n, w] belong to one step and one purpose.

    Quasi-Monte Carlo streams obey the same protocol: n points in w dimensions, independent between
    steps and purposes.
    """

    @property
    def dtype(self) -> torch.dtype:
        """Type of the normals."""

    def at_step(self, step: int) -> RandomStream:
        """Return the stream of another time step."""

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        """Draw standard normal numbers.

        Args:
            purpose: Label of the numbers.
            n: Number of particles.
            w: Number of components.

        Returns:
            Numbers, [R, n, w].
        """

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        """Draw uniform numbers on the open interval (0, 1).

        They are float64, because float32 has too few levels for 1e6 particles.

        Args:
            purpose: Label of the numbers.
            n: Number of particles.
            w: Number of components.

        Returns:
            Numbers, [R, n, w].
        """


class BatchRandomStream(RandomStream, Protocol):
    """A random stream that can be split by runs."""

    def select_runs(self, runs: slice) -> RandomStream:
        """Return the stream of some runs."""


def draw_normals_blocked(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw the numbers of `draw_normals` in blocks of components that fit the cache.

    Args:
        seed: Seed, [].
        purpose: Hash of the label.
        step: Time step, [].
        runs: Run numbers, [R].
        components: Number of components w.
        quarters: Number of particles divided by 4, q.

    Returns:
        Standard normal numbers, float32, [w, R, 4 q].
    """
    size = max(1, _BLOCK // max(1, runs.shape[0] * quarters))
    blocks = torch.arange(components, device=runs.device).split(size)
    return torch.cat(
        [_box_muller(_words((seed, purpose), step, runs, block, quarters)) for block in blocks]
    )


def _normals(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw standard normal numbers by Box and Muller, float32 [w, R, 4 q].

    Seed and purpose are the key. (quarter, component, step, run) is the counter of four numbers.
    """
    return _box_muller(
        _words((seed, purpose), step, runs, torch.arange(components, device=runs.device), quarters)
    )


def _box_muller(words: Words) -> Tensor:
    """Transform random words to standard normal numbers."""
    numbers = []
    a, b, c, d = words
    for radial, angular in ((a, b), (c, d)):
        # + 1/2 avoids log(0); a word that rounds up to 1 gives radius 0, which is harmless
        radius = torch.sqrt(-2.0 * torch.log((radial.float() + 0.5) * 2.0**-32))
        angle = angular.float() * (2.0 * torch.pi * 2.0**-32)
        numbers += [radius * torch.cos(angle), radius * torch.sin(angle)]
    return torch.cat(numbers, dim=-1)


def _eager_normals(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Use the CUDA kernel if there is one: separate operations would take 90 % of a step."""
    args = seed, purpose, step, runs, components, quarters
    return (
        (cuda.find_kernel("philox_normals", args) if runs.is_cuda else None) or draw_normals_blocked
    )(*args)


draw_normals = compilable(_normals, eager=_eager_normals, operator=cpp.philox_normals)


def _uniforms(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw uniform numbers on the open interval (0, 1), float64 [w, R, 4 q]."""
    words = _words(
        (seed, purpose), step, runs, torch.arange(components, device=runs.device), quarters
    )
    return (torch.cat(words, dim=-1).double() + 0.5) * 2.0**-32


def _eager_uniforms(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Use the CUDA kernel if there is one."""
    args = seed, purpose, step, runs, components, quarters
    return ((cuda.find_kernel("philox_uniforms", args) if runs.is_cuda else None) or _uniforms)(
        *args
    )


draw_uniforms = compilable(_uniforms, eager=_eager_uniforms, operator=cpp.philox_uniforms)


@dataclass(frozen=True, eq=False)
class PhiloxStream(BatchRandomStream):
    """Stream of independent random numbers.

    Attributes:
        seed: Integer from 0 to 2**32 - 1. In a recorded step a tensor [], as `step`.
        runs: Run numbers, int64, [R]. The number of a run, not its index in the batch, decides its
            random numbers. From 0 to 2**32 - 1.
        dtype: Type of the normals. They are drawn in single precision (24 bits, largest value 6.7)
            and converted, which takes a sixth of the time of double precision.
        step: Time step. 0 is the step of the initial distribution.

    Raises:
        ValueError: If the seed or a run number is out of range. It would repeat another stream.
    """

    seed: int | Tensor
    runs: Tensor
    dtype: torch.dtype = torch.float64
    step: int | Tensor = 0

    def __post_init__(self) -> None:
        if not isinstance(self.seed, Tensor) and not 0 <= self.seed <= _WORD:
            raise ValueError(f"seed must be from 0 to 2**32 - 1, got {self.seed}. Change the seed.")
        if isinstance(self.step, int) and self.step == 0:  # later steps have the same runs
            check_run_numbers(self.runs)

    @override
    def at_step(self, step: int) -> PhiloxStream:
        return replace(self, step=step)

    @override
    def select_runs(self, runs: slice) -> PhiloxStream:
        return replace(self, runs=self.runs[runs])

    @override
    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        return draw_normals(*self._counter(purpose, n, w))[..., :n].to(self.dtype).permute(1, 2, 0)

    @override
    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return draw_uniforms(*self._counter(purpose, n, w))[..., :n].permute(1, 2, 0)

    def _counter(
        self, purpose: str, n: int, w: int
    ) -> tuple[Tensor, int, Tensor, Tensor, int, int]:
        seed, step = torch.as_tensor(self.seed), torch.as_tensor(self.step)
        return seed, zlib.crc32(purpose.encode()), step, self.runs, w, -(-n // 4)


def _words(
    key: tuple[Tensor, int], step: Tensor, runs: Tensor, component: Tensor, quarters: int
) -> Words:
    """Return four random words for each component, run and quarter of the particles, [w, R, q]."""
    particle = torch.arange(quarters, device=runs.device)
    step, seed = step.to(runs.device), key[0].to(runs.device)
    counter = particle, component[:, None, None], step, runs[:, None]
    c0, c1, c2, c3 = (word.expand(len(component), len(runs), quarters) for word in counter)
    return philox((c0, c1, c2, c3), (seed, key[1]))


def philox(counter: Words, key: tuple[Tensor | int, Tensor | int], rounds: int = 10) -> Words:
    """Compute random words by Philox4x32.

    The results agree with the published known-answer vectors. A product of two 32-bit words wraps
    around in int64. The sign bits of the arithmetic shift and the high half of the other product
    are masked after the exclusive or.

    Args:
        counter: Four 32-bit words in int64 tensors.
        key: Two 32-bit words.
        rounds: Number of rounds.

    Returns:
        Four 32-bit random words in int64 tensors.
    """
    c0, c1, c2, c3 = counter
    index = torch.arange(rounds, device=counter[0].device)
    keys = zip(
        *(((k + weyl * index) & _WORD).unbind(0) for k, weyl in zip(key, _WEYL, strict=True)),
        strict=True,
    )
    for k0, k1 in keys:
        p0, p1 = c0 * _MULTIPLY[0], c2 * _MULTIPLY[1]
        c0, c1, c2, c3 = ((p1 >> 32) ^ c1 ^ k0) & _WORD, p1, ((p0 >> 32) ^ c3 ^ k1) & _WORD, p0
    return c0, c1 & _WORD, c2, c3 & _WORD
