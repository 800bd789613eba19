"""The loops that are written in C++, compiled on the spot where there is a compiler: see normals.cpp and loops.cpp.

Each computes what the torch function of its place does, on the CPU and one thread, and raises OSError or CalledProcessError
where there is no C++ compiler, or one that does not understand the source. Gradients do not pass through them.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import tempfile
from functools import cache
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

_HERE = Path(__file__).parent
_COMMON = ("-O3", "-march=native", "-fopenmp-simd", "-fPIC", "-c")
_FLAGS = {
    "normals": (*_COMMON, "-ffast-math", "-mno-recip"),
    "loops": (*_COMMON, "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math"),
}


def normals(key: Tensor, step: Tensor, runs: Tensor, component: Tensor, particle: Tensor) -> Tensor:
    """Standard normals, float32 [w, R, 4 q], as draws.normals makes them, to 5e-6."""
    return _drawn("normals", torch.float32, key, step, runs, component, particle)


def uniforms(key: Tensor, step: Tensor, runs: Tensor, component: Tensor, particle: Tensor) -> Tensor:
    """Uniforms, float64 [w, R, 4 q], as draws.uniforms makes them, to the last digit."""
    return _drawn("uniforms", torch.float64, key, step, runs, component, particle)


def systematic(a: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Ancestors [R, N] by the positions (j + u) / n; probabilities a [R, N], n [R or 1, 1], u [R, 1]."""
    runs, slots = a.shape
    ancestors = torch.empty(runs, slots, dtype=torch.int64)
    n, u = (part.double().expand(runs, 1).contiguous() for part in (n, u))
    _call("systematic", a.dtype, ancestors, a.contiguous(), n, u, runs, slots)
    return ancestors


def gather(x: Tensor, ancestors: Tensor) -> Tensor:
    """x [D, R, N] by ancestors [R, M] -> [D, R, M]."""
    d, runs, slots = x.shape
    out = x.new_empty(d, *ancestors.shape)
    _call("gather", x.dtype, out, x.contiguous(), ancestors.contiguous(), d, runs, slots, ancestors.shape[1])
    return out


def log_normal(y: Tensor, mean: Tensor, scale: Tensor, constant: Tensor) -> Tensor:
    """-1/2 sum ((y - mean) scale)^2 - constant [R, N]; y, scale [R, K], mean [R, N, K], constant [R]."""
    runs, particles, components = mean.shape
    out = mean.new_empty(runs, particles)
    strides = torch.tensor(mean.stride())
    y, scale = (part.to(mean.dtype).expand(runs, components).contiguous() for part in (y, scale))
    constant = constant.to(mean.dtype).expand(runs).contiguous()
    _call("log_normal", mean.dtype, out, y, mean, scale, constant, strides, runs, particles, components)
    return out


def affine(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    """phi x + gain w [D, R, N]; x [R, N, D], w [R, N, W], phi [R or 1, D, D], gain [R or 1, D, W]."""
    runs, particles, _ = x.shape
    first, driven = x.permute(2, 0, 1).contiguous(), w.permute(2, 0, 1).contiguous()
    shared = int(len(phi) == 1), int(len(gain) == 1)
    out = x.new_empty(phi.shape[1], runs, particles)
    _call(
        "affine", x.dtype, out, phi.contiguous(), first, gain.contiguous(), driven, *shared, runs, particles,
        *phi.shape[1:], gain.shape[2],
    )  # fmt: skip
    return out


def distinct(copy_of: Tensor, log_w: Tensor) -> Tensor:
    """How many values there are in copy_of [R, N], below 2 N, at the slots whose log weight [R, N] is finite: [R]."""
    runs, slots = copy_of.shape
    counts = torch.empty(runs, dtype=torch.int64)
    _call("distinct", log_w.dtype, counts, copy_of.contiguous(), log_w.contiguous(), runs, slots)
    return counts


def moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance [R, D] of x [R, N, D] by weights [R, N] whose sum is 1."""
    parts, (runs, particles, components) = x.permute(2, 0, 1).contiguous(), x.shape
    mean, variance = x.new_empty(runs, components), x.new_empty(runs, components)
    _call("moments", x.dtype, mean, variance, parts, w.contiguous(), components, runs, particles)
    return mean, variance


def spread(x: Tensor, mean: Tensor, w: Tensor, groups: Tensor) -> Tensor:
    """Covariance of groups of components [G, s] of x [R, N, K], by mean [R, K] and weights [R, N] -> [R, G, s, s]."""
    (runs, particles, components), (many, size) = x.shape, groups.shape
    out, strides = x.new_empty(runs, many, size, size), torch.tensor(x.stride())
    parts = x, mean.contiguous(), w.contiguous(), groups.contiguous(), strides
    _call("spread", x.dtype, out, *parts, many, size, runs, particles, components)
    return out


@cache
def keep_memory() -> None:
    """Has the C library keep what is freed, for the next step, where it can be told so.

    It gives blocks of some megabytes back to the system otherwise and fetches them again, page by page, at each step: about a
    sixth of a bootstrap filter's time, 100 runs of 500 particles, was the system's. Of glibc; elsewhere nothing happens.
    """
    tell = getattr(ctypes.CDLL(None), "mallopt", None)
    if tell is not None:
        for option in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of malloc.h
            tell(option, 1 << 30)


def peak_from_here() -> int | None:
    """The memory of the process, bytes, from which on `peak` is counted anew; None where the system does not tell (of Linux)."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # what an earlier job has left would hide what this one takes
        trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return None
    return _memory("VmRSS")


def peak() -> int:
    """The most memory that the process has had since `peak_from_here`, bytes."""
    return _memory("VmHWM")


def _memory(name: str) -> int:
    (line,) = (line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name))
    return 1024 * int(line.split()[1])


def _drawn(
    name: str, dtype: torch.dtype, key: Tensor, step: Tensor, runs: Tensor, component: Tensor, particle: Tensor
) -> Tensor:
    out = torch.empty(len(component), len(runs), 4 * len(particle), dtype=dtype)
    axes = [part for axis in (runs, component, particle) for part in (axis.contiguous(), len(axis))]
    _run(_function("normals", name, None), out, *axes, int(step), *key.tolist())
    return out


def _call(name: str, dtype: torch.dtype, *arguments: Tensor | int) -> None:
    _run(_function("loops", name, dtype), *arguments)


def _run(function: Any, *arguments: Tensor | int) -> None:
    if function.argtypes is None:  # told once: converting each number anew costs as much as a small cloud's loop
        function.argtypes = [ctypes.c_void_p if isinstance(a, Tensor) else ctypes.c_int64 for a in arguments]
    function(*[a.data_ptr() if isinstance(a, Tensor) else a for a in arguments])


@cache
def _function(source: str, name: str, dtype: torch.dtype | None) -> Any:
    found = getattr(_library(source), name if dtype is None else f"{name}_{str(dtype).removeprefix('torch.')}")
    found.restype = None
    return found


@cache
def _library(source: str) -> Any:
    compiler = next((found for name in ("c++", "g++", "clang++") if (found := shutil.which(name))), None)
    if compiler is None:
        raise OSError("no C++ compiler")
    path = _HERE / f"{source}.cpp"
    name = hashlib.sha256(path.read_bytes() + repr((compiler, _FLAGS[source], os.cpu_count())).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"pfbench_{os.getuid()}"
    built = folder / f"{name}.so"
    if not built.exists():
        folder.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            part, new = Path(scratch) / f"{source}.o", Path(scratch) / built.name
            subprocess.run([compiler, *_FLAGS[source], "-o", part, path], check=True, capture_output=True)
            # linked without -ffast-math, with which a library switches small numbers off in the whole process
            subprocess.run([compiler, "-shared", "-o", new, part, "-lm"], check=True, capture_output=True)
            os.replace(new, built)
    return ctypes.CDLL(str(built))
