"""Kernels of particles.cu: operators of `pfbench.kernels.dispatch` on a CUDA device, compiled by torch's NVRTC.

If they do not compile, a warning is logged and torch's own compiler is used.
"""

from __future__ import annotations

import ctypes
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from pfbench.kernels.manifest import check_first

_SOURCES = Path(__file__).parent / "src"


def launch_kernel(
    name: str, grid: tuple[int, int, int], threads: int, *args: Tensor | int, shared: int = 0
) -> None:
    """Launch a kernel of particles.cu in the current stream of its first argument's device."""
    assert isinstance(args[0], Tensor)
    if 0 in grid:  # the driver rejects empty grids
        return None
    device = args[0].device
    if torch.cuda.current_device() != device.index:
        with torch.cuda.device(device):
            return launch_kernel(name, grid, threads, *args, shared=shared)
    function, driver = compile_kernel(name, device.index)
    values = [
        ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else ctypes.c_int(a) for a in args
    ]
    pointers = (ctypes.c_void_p * len(values))(*map(ctypes.addressof, values))
    stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
    code = driver.cuLaunchKernel(function, *grid, threads, 1, 1, shared, stream, pointers, None)
    if code:
        raise RuntimeError(f"{name} cannot run: the CUDA driver returned error {code}.")


@cache
def compile_kernel(name: str, device: int) -> tuple[Any, Any]:
    """Compile a kernel.

    Returns the kernel, and the driver, which torch would open again at each call.
    """
    return torch.cuda._compile_kernel(read_source(), name).func, ctypes.CDLL("libcuda.so.1")


def read_source() -> str:
    """Return the source of the kernels as one text, with the generator that C++ uses, too."""
    generator = (_SOURCES / "generator.h").read_text().replace("#pragma once\n", "")
    text = (_SOURCES / "particles.cu").read_text()
    line = next(line for line in text.splitlines() if line.startswith('#include "generator.h"'))
    return text.replace(line, generator)


log = logging.getLogger("pfbench")
_REAL = {torch.float32: "float", torch.float64: "double"}
_ROWS = 65535  # blocks along the second axis of a grid
_SHARED = 48 * 1024  # bytes of shared memory of a block without a special attribute
_STATES = {
    torch.float32: 32,
    torch.float64: 20,
}  # components whose sums fit the registers of a thread
_BLOCK = 512
_INDEX = {torch.int32: "int", torch.int64: "long long"}
_PART = 128  # particles of a warp; `weighed` writes one record for them
_BLOCKS = 4096  # several times as many as a device runs at once


@cache
def is_cuda_available() -> bool:
    """Return whether a CUDA device is available."""
    return torch.cuda.is_available() and torch.version.hip is None


@cache
def _compiles(name: str = "uniforms") -> bool:
    """Return whether torch compiles a kernel here, which needs headers of a CUDA toolkit."""
    try:
        compile_kernel(name, torch.cuda.current_device())
    except Exception as error:  # torch raises many kinds
        reason = f"{type(error).__name__}: {error}".splitlines()[0]
        log.warning("CUDA kernels do not compile here (%s). Using torch's compiler", reason)
        return False
    return True


def find_kernel(name: str, args: tuple[Any, ...]) -> Callable[..., Any] | None:
    """Return the operator of this name on a CUDA device, or None if it does not take the arguments."""
    accepts = _ACCEPTS.get(name)
    if accepts is None or not _compiles() or not accepts(*args):
        return None
    return cast(Callable[..., Any], getattr(torch.ops.pfbench, name).default)


def _draw(
    seed: Tensor,
    purpose: int,
    step: Tensor,
    runs: Tensor,
    components: int,
    quarters: int,
    name: str,
    dtype: torch.dtype = torch.float64,
) -> Tensor:
    out = runs.new_empty(components, len(runs), 4 * quarters, dtype=dtype)
    threads = max(32, min(256, 32 * -(-quarters // 32)))
    grid = -(-quarters // threads), min(_ROWS, components * len(runs)), 1
    numbers = int(seed), purpose, int(step), components, len(runs), quarters
    launch_kernel(name, grid, threads, out, runs.contiguous(), *numbers)
    return out


def _affine(
    phi: Tensor, x: Tensor, gain: Tensor, m: int, ancestors: Tensor | None = None, key: Any = (0, 0, 0, None),
    noise: Tensor | None = None
) -> Tensor:  # fmt: skip
    (d, runs, n), width = x.shape, gain.shape[-1]
    phi, gain = phi.to(x.dtype).contiguous(), gain.to(x.dtype).contiguous()
    out, (seed, purpose, step, numbers) = x.new_empty(d, runs, m), key
    flags = ("true" if flag else "false" for flag in (ancestors is not None, noise is None))
    name = f"affine<{', '.join((_REAL[x.dtype], str(d), str(width), *flags))}>"
    # An unused pointer may be any valid address.
    parent = x if ancestors is None else ancestors
    w, numbers = x if noise is None else noise, x if numbers is None else numbers
    per_run = (len(phi) > 1) + 2 * (len(gain) > 1)
    grid = -(-m // 512), min(_ROWS, runs), 1
    tensors = out, x, parent, w, phi, gain
    launch_kernel(name, grid, 128, *tensors, per_run, numbers, seed, purpose, step, runs, n, m)
    return out


def _philox_normals(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw standard normal numbers of blocks."""
    args = seed, purpose, step, runs, components, quarters
    return _draw(*args, "normals<float>", torch.float32)


def _philox_normals_float64(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw standard normal numbers of blocks in double precision."""
    return _draw(seed, purpose, step, runs, components, quarters, "normals<double>")


def _philox_uniforms(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw uniform numbers of blocks."""
    return _draw(seed, purpose, step, runs, components, quarters, "uniforms")


def _gather_particles(x: Tensor, ancestors: Tensor) -> Tensor:
    """Gather particles by their ancestors."""
    (d, runs, n), m = x.shape, ancestors.shape[1]
    out = x.new_empty(d, runs, m)
    grid = -(-m // 256), min(_ROWS, runs), 1
    name, sources = f"copied<{_REAL[x.dtype]}>", (x.contiguous(), ancestors.contiguous())
    launch_kernel(name, grid, 256, out, *sources, d, runs, n, m)
    return out


def _propagate_affine(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    """Compute phi x + gain w."""
    if not _is_square(phi):
        raise ValueError(f"propagate_affine: phi must be square on CUDA, got {list(phi.shape)}.")
    stored = x.permute(2, 0, 1).contiguous()
    return _affine(
        phi, stored, gain, stored.shape[2], noise=w.permute(2, 0, 1).to(x.dtype).contiguous()
    )


def _gather_propagate(
    phi: Tensor,
    x: Tensor,
    ancestors: Tensor,
    gain: Tensor,
    seed: Tensor,
    purpose: int,
    step: Tensor,
    runs: Tensor,
) -> Tensor:
    """Gather particles by their ancestors and propagate them."""
    key = int(seed), purpose, int(step), runs
    return _affine(phi, x.contiguous(), gain, ancestors.shape[1], ancestors.contiguous(), key)


def _resample(a: Tensor, n: Tensor, u: Tensor, index: torch.dtype) -> tuple[Tensor, Tensor]:
    """Resample systematically. Returns ancestors [R, N] of a type and how many of them are distinct, int64 [R]."""
    runs, slots = a.shape
    out, distinct = a.new_empty(runs, slots, dtype=index), a.new_empty(runs, dtype=torch.int64)
    inside = 4 * slots <= _SHARED - 2048
    blocks = min(runs, _ROWS)
    marks = out if inside else a.new_empty(blocks, slots, dtype=torch.int32)
    counts, uniforms = n.double().contiguous(), u.double().contiguous()
    args = a.contiguous(), counts, int(len(n) > 1), uniforms, marks, int(inside), runs, slots
    name, shared = f"systematic<{_REAL[a.dtype]}, {_INDEX[index]}>", 4 * slots if inside else 0
    launch_kernel(name, (blocks, 1, 1), _BLOCK, out, distinct, *args, shared=shared)
    return out, distinct


def _resample_systematic(a: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Resample systematically."""
    return _resample(a, n, u, torch.int64)[0]


def _sir_step(*args: Any) -> tuple[Tensor, ...]:
    """Take a step. Particles are read once, written once, and weighed and summed in between."""
    a, n, u, phi, x, gain, seed, purpose, step, runs, components, y, scale, constant = args
    (d, rows, slots), width, real = x.shape, gain.shape[-1], _REAL[x.dtype]
    ancestors, distinct = _resample(a, n, u, torch.int32)
    out, log_w, w = x.new_empty(d, rows, slots), x.new_empty(rows, slots), x.new_empty(rows, slots)
    sums = x.new_empty(rows, -(-slots // _PART), 2 * d + 3)
    numbers = [value.to(x.dtype).contiguous() for value in (phi, gain, y, scale, constant, n)]
    per_run = sum((len(value) > 1) << bit for bit, value in enumerate(numbers))
    blocks = -(-slots // 512)
    block_runs = max(1, rows * blocks // _BLOCKS)  # a block reads the matrices once for all of them
    launch_kernel(
        f"weighed<{real}, {d}, {width}>", (blocks, min(_ROWS, -(-rows // block_runs)), 1), 128, out, log_w, sums,
        x.contiguous(), ancestors, *numbers[:2], runs.contiguous(), components.contiguous(), *numbers[2:], per_run,
        int(seed), purpose, int(step), len(components), rows, slots, slots,
    )  # fmt: skip
    log_total, ess = x.new_empty(rows), x.new_empty(rows)
    mean, variance = x.new_empty(rows, d), x.new_empty(rows, d)
    launch_kernel(
        f"finished<{real}, {d}>", (-(-slots // 2048), min(_ROWS, rows), 1), 256, log_w, log_total, w, ess, mean, variance,
        out, sums, sums.shape[1], rows, slots,
    )  # fmt: skip
    return out, log_w, log_total, w, ess, mean, variance, distinct


def can_take_step(x: Tensor, gain: Tensor) -> bool:
    """Return whether `sir_step` takes particles [D, R, N] with a noise gain [R or 1, D, W], and compiles for them."""
    if x.dtype not in _REAL or len(x) > min(31, _STATES[x.dtype]) or gain.shape[1] != len(x):
        return False
    real, d = _REAL[x.dtype], len(x)
    kernels = (
        f"weighed<{real}, {d}, {gain.shape[-1]}>",
        f"finished<{real}, {d}>",
        f"systematic<{real}, int>",
    )
    return all(_compiles(name) for name in kernels)


def _count_unique(ancestors: Tensor, log_w: Tensor) -> Tensor:
    """Count distinct values where a weight is positive."""
    (runs, slots), bytes_ = log_w.shape, 4 * -(-2 * log_w.shape[1] // 4)
    out, sources = ancestors.new_empty(runs), (ancestors.contiguous(), log_w.contiguous())
    name, grid = f"distinct<{_REAL[log_w.dtype]}>", (min(runs, _ROWS), 1, 1)
    launch_kernel(name, grid, _BLOCK, out, *sources, runs, slots, shared=bytes_)
    return out


def _weighted_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Compute weighted means and variances."""
    runs, slots, d = x.shape
    mean, variance = x.new_empty(runs, d), x.new_empty(runs, d)
    args = x.permute(2, 0, 1).contiguous(), w.contiguous(), runs, slots
    launch_kernel(
        f"moments<{_REAL[x.dtype]}, {d}>", (min(runs, _ROWS), 1, 1), 256, mean, variance, *args
    )
    return mean, variance


def _fills_device(a: Tensor, most: int) -> bool:
    """Return whether the runs fill the device with one block each, of at most `most` particles."""
    return a.dtype in _REAL and a.shape[1] <= most and (len(a) >= 64 or a.shape[1] <= 8192)


def _fits_registers(x: Tensor) -> bool:
    """Return whether a thread holds the sums of all components."""
    return x.shape[-1] <= _STATES.get(x.dtype, 0)


def _is_square(phi: Tensor) -> bool:
    """Return whether a state keeps its components, as the kernel of `propagate_affine` assumes."""
    return phi.shape[1:] == phi.shape[2:] * 2


KERNELS: dict[str, Callable[..., Any]] = {
    kernel.__name__.removeprefix("_"): check_first(kernel)
    for kernel in (
        _philox_normals, _philox_normals_float64, _philox_uniforms, _gather_particles,
        _propagate_affine, _gather_propagate, _resample_systematic, _count_unique, _weighted_moments, _sir_step,
    )
}  # fmt: skip
"""Operators of `pfbench.kernels.dispatch` on a CUDA device. They do not check values: the host would wait."""

_ACCEPTS: dict[str, Callable[..., bool]] = {
    "philox_normals": lambda *_: True,
    "philox_normals_float64": lambda *_: True,
    "philox_uniforms": lambda *_: True,
    "gather_particles": lambda x, ancestors: x.dtype in _REAL,
    "propagate_affine": lambda phi, x, gain, w: _fits_registers(x) and _is_square(phi),
    "resample_systematic": lambda a, n, u: _fills_device(a, 1 << 20),
    "count_unique": lambda ancestors, log_w: _fills_device(log_w, (_SHARED - 1024) // 2),
    "weighted_moments": lambda x, w: _fills_device(w, 1 << 20) and _fits_registers(x),
}


def register(operators: torch.library.Library) -> None:
    """Register the kernels for tensors on a CUDA device."""
    for name, kernel in KERNELS.items():
        operators.impl(name, kernel, "CUDA")
