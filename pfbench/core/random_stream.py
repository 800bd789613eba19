"""Counter-based random streams.

Each number is a pure function of (seed, run, step, purpose, component, particle). A run therefore
gets the same numbers alone, in any batch, in every engine and on any device, bit by bit. More filters,
runs or stages do not change the numbers of the others. The generator is stateless.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, TypeAlias

import torch
from torch import Tensor
from torch._subclasses.fake_tensor import FakeTensor
from typing_extensions import override

from pfbench.core.parameter_checks import RUN_NUMBERS
from pfbench.kernels import cuda, dispatch
from pfbench.kernels.dispatch import compilable

Draw: TypeAlias = Callable[..., Tensor]
"""(seed [], purpose, step [], runs [R], components w, quarters q) -> [w, R, 4 q]."""


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


def _normals(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw standard normal numbers, float32 [w, R, 4 q].

    Seed and purpose are the key. (quarter, component, step, run) is the counter of four numbers.
    """
    from pfbench.kernels import philox

    return philox.compute_normals((seed, purpose, step, runs, components, quarters), philox.SINGLE)


def _normals_float64(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw standard normal numbers, float64 [w, R, 4 q]."""
    from pfbench.kernels import philox

    return philox.compute_normals((seed, purpose, step, runs, components, quarters), philox.DOUBLE)


def _uniforms(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw uniform numbers on the open interval (0, 1), float64 [w, R, 4 q]."""
    from pfbench.kernels import philox

    return philox.compute_uniforms((seed, purpose, step, runs, components, quarters))


def _prefer_kernel(name: str, function: Draw) -> Draw:
    """Use the CUDA kernel if there is one: separate operations would take 90 % of a step."""

    def draw(*args: Any) -> Tensor:
        kernel = cuda.find_kernel(name, args) if args[3].is_cuda else None
        return (kernel or function)(*args)

    return draw


def _make_draw(function: Draw, operator: Draw) -> Draw:
    """Return the fastest form of a draw. All forms draw the same bits."""
    return compilable(
        function,
        eager=_prefer_kernel(operator.__name__, function),
        operator=operator,
        use_torch_compiler=False,
    )


draw_normals = _make_draw(_normals, dispatch.philox_normals)
draw_normals_float64 = _make_draw(_normals_float64, dispatch.philox_normals_float64)
draw_uniforms = _make_draw(_uniforms, dispatch.philox_uniforms)


@dataclass(frozen=True, eq=False)
class PhiloxStream(BatchRandomStream):
    """Stream of independent random numbers.

    Attributes:
        seed: Integer from 0 to 2**32 - 1. In a recorded step a tensor [], as `step`.
        runs: Run numbers, int64, [R]. The number of a run, not its index in the batch, decides its
            random numbers. From 0 to 2**32 - 1.
        dtype: Type of the normals. Single precision has 24 bits and a largest value of 6.7. Double
            precision has 52 bits and a largest value of 8.6, and takes 2.5 times as long. The
            numbers of both agree to about 1e-5.
        step: Time step. 0 is the step of the initial distribution.

    Raises:
        ValueError: If the seed or a run number is out of range. It would repeat another stream.
    """

    seed: int | Tensor
    runs: Tensor
    dtype: torch.dtype = torch.float64
    step: int | Tensor = 0

    def __post_init__(self) -> None:
        if not isinstance(self.seed, Tensor) and not 0 <= self.seed < 2**32:
            raise ValueError(f"seed must be from 0 to 2**32 - 1, got {self.seed}. Set seed=1.")
        if isinstance(self.step, int) and self.step == 0:  # later steps have the same runs
            check_run_numbers(self.runs)

    @override
    def at_step(self, step: int) -> PhiloxStream:
        stream = object.__new__(type(self))  # `replace` takes four times as long at each step
        vars(stream).update(vars(self), step=step)
        vars(stream).pop("_key", None)
        stream.__post_init__()
        return stream

    @override
    def select_runs(self, runs: slice) -> PhiloxStream:
        return replace(self, runs=self.runs[runs])

    @override
    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        draw = draw_normals if self.dtype == torch.float32 else draw_normals_float64
        return draw(*self._counter(purpose, n, w))[..., :n].to(self.dtype).permute(1, 2, 0)

    @override
    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return draw_uniforms(*self._counter(purpose, n, w))[..., :n].permute(1, 2, 0)

    @cached_property
    def _key(self) -> tuple[Tensor, Tensor]:
        return torch.as_tensor(self.seed), torch.as_tensor(self.step)

    def _counter(
        self, purpose: str, n: int, w: int
    ) -> tuple[Tensor, int, Tensor, Tensor, int, int]:
        seed, step = self._key
        return seed, zlib.crc32(purpose.encode()), step, self.runs, w, -(-n // 4)


# --------------------------------------------------------------------------------------------------
# Random streams derived from another: with other labels, of some runs, or transformed.

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
    """Return a stream with a prefix to its labels, so that parts of a step do not share numbers."""
    return DerivedStream(
        draws,
        lambda d, p, n, w: d.uniform(name + p, n, w),
        lambda d, p, n, w: d.normal(name + p, n, w),
    )


def select_runs(draws: RandomStream, rows: Tensor) -> RandomStream:
    """Return the stream of some runs; where possible, the numbers of other runs are not drawn."""
    if isinstance(draws, DerivedStream):
        return replace(draws, draws=select_runs(draws.draws, rows))
    if isinstance(draws, PhiloxStream):
        return replace(draws, runs=draws.runs[rows])
    return DerivedStream(
        draws,
        lambda d, p, n, w: d.uniform(p, n, w)[rows],
        lambda d, p, n, w: d.normal(p, n, w)[rows],
    )


def check_run_numbers(runs: Tensor) -> None:
    """Check the range of run numbers on the CPU. On another device the host would wait for them.

    Shapes: runs [R].
    """
    if runs.device.type != "cpu" or isinstance(runs, FakeTensor):
        return
    wrong = runs[(runs < 0) | (runs >= RUN_NUMBERS)].tolist()
    if wrong:
        raise ValueError(
            f"runs must be from 0 to 2**32 - 1, got {wrong[0]}. Use another seed for more runs."
        )
