"""The loops of loops.cu: what operators of pfbench.native do on a CUDA device, compiled on the spot by torch's NVRTC.

Where they cannot be compiled, one line says so, and torch's own compiler is left with the work.
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

log = logging.getLogger("pfbench")
_SOURCE = Path(__file__).parent / "loops.cu"
_REAL = {torch.float32: "float", torch.float64: "double"}
_ROWS = 65535  # blocks along the second axis of a grid
_SHARED = 48 * 1024  # bytes that a block may have of its own without asking
_STATES = {torch.float32: 32, torch.float64: 20}  # components of which a thread can hold the sums in its registers
_BLOCK = 512


@cache
def available() -> bool:
    """Is there a CUDA device?"""
    return torch.cuda.is_available() and torch.version.hip is None


@cache
def _compiles() -> bool:
    """Does torch compile CUDA C++ here? By an inner part of it, for which the headers of a CUDA toolkit have to be found."""
    try:
        _kernel("uniforms", torch.cuda.current_device())
    except Exception as error:  # torch raises many kinds
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        log.warning("the loops for CUDA devices do not compile here (%s); torch compiles its own instead", why)
        return False
    return True


def kernel(name: str, args: tuple[Any, ...]) -> Callable[..., Any] | None:
    """The operator of this name, where it can be had on a CUDA device for these arguments."""
    fit = _FIT.get(name)
    if fit is None or not _compiles() or not fit(*args):
        return None
    return cast(Callable[..., Any], getattr(torch.ops.pfbench, name).default)


def _drawn(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int, dtype: torch.dtype) -> Tensor:
    out = runs.new_empty(components, len(runs), 4 * quarters, dtype=dtype)
    name = "normals" if dtype == torch.float32 else "uniforms"
    threads = min(256, 32 * -(-quarters // 32))
    grid = -(-quarters // threads), min(_ROWS, components * len(runs)), 1
    _launch(name, grid, threads, out, runs, int(seed), purpose, int(step), components, len(runs), quarters)
    return out


def normals(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int) -> Tensor:
    return _drawn(seed, purpose, step, runs, components, quarters, torch.float32)


def uniforms(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int) -> Tensor:
    return _drawn(seed, purpose, step, runs, components, quarters, torch.float64)


def copied(x: Tensor, ancestors: Tensor) -> Tensor:
    (d, runs, n), m = x.shape, ancestors.shape[1]
    out = x.new_empty(d, runs, m)
    grid = -(-m // 256), min(_ROWS, runs), 1
    _launch(f"copied<{_REAL[x.dtype]}>", grid, 256, out, x.contiguous(), ancestors.contiguous(), d, runs, n, m)
    return out


def affine(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    own = x.permute(2, 0, 1).contiguous()
    return _affine(phi, own, gain, own.shape[2], noise=w.permute(2, 0, 1).to(x.dtype).contiguous())


def driven(
    phi: Tensor, x: Tensor, ancestors: Tensor, gain: Tensor, seed: Tensor, purpose: int, step: Tensor, runs: Tensor
) -> Tensor:
    if x.shape[0] != phi.shape[-1]:
        raise ValueError(f"driven: {x.shape[0]} components of {phi.shape[-1]}")
    return _affine(phi, x.contiguous(), gain, ancestors.shape[1], ancestors.contiguous(), (int(seed), purpose, int(step), runs))


def _affine(
    phi: Tensor, x: Tensor, gain: Tensor, m: int, ancestors: Tensor | None = None, key: Any = (0, 0, 0, None),
    noise: Tensor | None = None,
) -> Tensor:  # fmt: skip
    (d, runs, n), width = x.shape, gain.shape[-1]
    phi, gain = phi.to(x.dtype).contiguous(), gain.to(x.dtype).contiguous()
    out, (seed, purpose, step, numbers) = x.new_empty(d, runs, m), key
    words = [_REAL[x.dtype], d, width, *("true" if given else "false" for given in (ancestors is not None, noise is None))]
    parent = x if ancestors is None else ancestors  # what a kernel does not look at is anything that has an address
    w, numbers = x if noise is None else noise, x if numbers is None else numbers
    own = (len(phi) > 1) + 2 * (len(gain) > 1)
    grid = -(-m // 512), min(_ROWS, runs), 1
    name = f"affine<{', '.join(map(str, words))}>"
    _launch(name, grid, 128, out, x, parent, w, phi, gain, own, numbers, seed, purpose, step, runs, n, m)
    return out


def systematic(a: Tensor, n: Tensor, u: Tensor) -> Tensor:
    runs, slots = a.shape
    out = a.new_empty(runs, slots, dtype=torch.int64)
    inside = 4 * slots <= _SHARED - 1024
    blocks = min(runs, _ROWS)
    marks = out if inside else a.new_empty(blocks, slots, dtype=torch.int32)
    wanted = n.to(a.dtype).contiguous()
    given = a.contiguous(), wanted, int(len(n) > 1), u.to(torch.float64).contiguous(), marks, int(inside), runs, slots
    _launch(f"systematic<{_REAL[a.dtype]}>", (blocks, 1, 1), _BLOCK, out, *given, shared=4 * slots if inside else 0)
    return out


def distinct(copy_of: Tensor, log_w: Tensor) -> Tensor:
    (runs, slots), bytes_ = log_w.shape, 4 * -(-2 * log_w.shape[1] // 4)
    out = copy_of.new_empty(runs)
    given = copy_of.contiguous(), log_w.contiguous(), runs, slots
    _launch(f"distinct<{_REAL[log_w.dtype]}>", (min(runs, _ROWS), 1, 1), _BLOCK, out, *given, shared=bytes_)
    return out


def moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    runs, slots, d = x.shape
    mean, variance = x.new_empty(runs, d), x.new_empty(runs, d)
    given = x.permute(2, 0, 1).contiguous(), w.contiguous(), runs, slots
    _launch(f"moments<{_REAL[x.dtype]}, {d}>", (min(runs, _ROWS), 1, 1), 256, mean, variance, *given)
    return mean, variance


def _many(a: Tensor, most: int) -> bool:
    """Enough runs for a block each, of particles that it can go through."""
    return a.dtype in _REAL and a.shape[1] <= most and (len(a) >= 64 or a.shape[1] <= 8192)


def _held(x: Tensor) -> bool:
    return x.shape[-1] <= _STATES.get(x.dtype, 0)


_FIT: dict[str, Callable[..., bool]] = {
    "normals": lambda *_: True,
    "uniforms": lambda *_: True,
    "copied": lambda x, ancestors: x.dtype in _REAL,
    "affine": lambda phi, x, gain, w: _held(x),
    "systematic": lambda a, n, u: _many(a, 1 << 20),
    "distinct": lambda copy_of, log_w: _many(log_w, (_SHARED - 1024) // 2),
    "moments": lambda x, w: _many(w, 1 << 20) and _held(x),
}


def _launch(name: str, grid: tuple[int, int, int], threads: int, *given: Tensor | int, shared: int = 0) -> None:
    """Runs a kernel of loops.cu, in the current stream of the device on which its first argument lies."""
    assert isinstance(given[0], Tensor)
    if 0 in grid:  # nothing to be done, which the driver refuses
        return None
    device = given[0].device
    if torch.cuda.current_device() != device.index:
        with torch.cuda.device(device):
            return _launch(name, grid, threads, *given, shared=shared)
    function, driver = _kernel(name, device.index)
    values = [ctypes.c_void_p(a.data_ptr()) if isinstance(a, Tensor) else ctypes.c_int(a) for a in given]
    places = (ctypes.c_void_p * len(values))(*map(ctypes.addressof, values))
    stream = ctypes.c_void_p(torch.cuda.current_stream().cuda_stream)
    code = driver.cuLaunchKernel(function, *grid, threads, 1, 1, shared, stream, places, None)
    if code:
        raise RuntimeError(f"{name}: the CUDA driver says {code}")


@cache
def _kernel(name: str, device: int) -> tuple[Any, Any]:
    """A compiled kernel, and the driver that runs it: called directly, since through torch each call opens the driver anew."""
    return torch.cuda._compile_kernel(_SOURCE.read_text(), name).func, ctypes.CDLL("libcuda.so.1")


def register(operators: torch.library.Library) -> None:
    """Has torch call these for tensors on a CUDA device."""
    for loop in (normals, uniforms, copied, affine, driven, systematic, distinct, moments):
        operators.impl(loop.__name__, loop, "CUDA")
