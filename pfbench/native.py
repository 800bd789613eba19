"""The loops that are written in C++, compiled on the spot where there is a compiler; each file (`*.cpp`) says what it is for.

They are operators of torch's. Each computes what the torch function of its place does, on the CPU and one thread, and raises
OSError or CalledProcessError where there is no C++ compiler, or one that does not understand the source. Gradients do not pass
through them.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import torch
from torch import Tensor

from pfbench import cuda

_HERE = Path(__file__).parent
_TORCH = Path(torch.__file__).parent
_COMMON = ("-O3", "-march=native", "-fopenmp-simd", "-fPIC", "-std=c++17", "-c")
_FLAGS = {
    "normals": (*_COMMON, "-ffast-math", "-mno-recip"),
    "steps": _COMMON,
    "loops": (*_COMMON, "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math"),
    "matrices": (*_COMMON, "-fno-math-errno", "-fno-trapping-math"),
    "scores": (*_COMMON, "-fno-math-errno", "-fno-trapping-math", "-fno-signed-zeros", "-fassociative-math"),
}
_operators = torch.library.Library("pfbench", "DEF")


def normals(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int) -> Tensor:
    """Standard normals, float32 [w, R, 4 q], as draws.normals makes them, to 5e-6."""
    return _operator("normals")(seed, purpose, step, runs, components, quarters)


def uniforms(seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int) -> Tensor:
    """Uniforms, float64 [w, R, 4 q], as draws.uniforms makes them, to the last digit."""
    return _operator("uniforms")(seed, purpose, step, runs, components, quarters)


def systematic(a: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Ancestors [R, N] by the positions (j + u) / n; probabilities a [R, N], n [R or 1, 1], u [R, 1]."""
    return _operator("systematic")(a, n, u)


def copied(x: Tensor, ancestors: Tensor) -> Tensor:
    """x [D, R, N] by ancestors [R, M] -> [D, R, M]."""
    return _operator("copied")(x, ancestors)


def log_normal(y: Tensor, mean: Tensor, scale: Tensor, constant: Tensor) -> Tensor:
    """-1/2 sum ((y - mean) scale)^2 - constant [R, N]; y, scale [R, K], mean [R, N, K], constant [R]."""
    return _operator("log_normal")(y, mean, scale, constant)


def affine(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    """phi x + gain w [D, R, N]; x [R, N, D], w [R, N, W], phi [R or 1, D, D], gain [R or 1, D, W]."""
    return _operator("affine")(phi, x, gain, w)


def driven(
    phi: Tensor, x: Tensor, ancestors: Tensor, gain: Tensor, seed: Tensor, purpose: int, step: Tensor, runs: Tensor
) -> Tensor:
    """phi x[ancestors] + gain w [D, R, M]: `copied`, `normals` and `affine` in one pass, of a CUDA device alone.

    x [D, R, N], ancestors [R, M], phi [R or 1, D, D], gain [R or 1, D, W]; the others as for `normals`.
    """
    return cast(Tensor, torch.ops.pfbench.driven.default(phi, x, ancestors, gain, seed, purpose, step, runs))


def distinct(copy_of: Tensor, log_w: Tensor) -> Tensor:
    """How many values there are in copy_of [R, N], below 2 N, at the slots whose log weight [R, N] is finite: [R]."""
    return _operator("distinct")(copy_of, log_w)


def totals(part: Tensor) -> tuple[Tensor, Tensor]:
    """Sums of parts [R, N], and of their squares: [R, 1] each."""
    return _operator("totals")(part)


def moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and variance [R, D] of x [R, N, D] by weights [R, N] whose sum is 1."""
    return _operator("moments")(x, w)


def rooted(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Lower triangular roots [..., d, d], as covariance.factor makes them, and which exist, bool [...]."""
    lower, fine = _operator("rooted")(covariance.reshape(-1, *covariance.shape[-2:]))
    return lower.view(covariance.shape), fine.view(covariance.shape[:-2])


def updated(m: Tensor, r: Tensor, omega: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """For r = m xi + e, xi ~ N(0, I), Cov e = omega; m [R, k, d], r [R, k], omega [R, k, k]: what xi is then.

    Its mean [R, d] and root [R, d, d], the normalised distance [R], diagonals of the roots of omega and of xi's information
    [R, k + d], and where omega has a root, bool [R].
    """
    return _operator("updated")(m, r, omega)


def fitted(r: Tensor, xi: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """r [R, P, k] at points xi [P, d] of weights w [P]: slopes M [R, k, d], and the covariance of what they leave [R, k, k]."""
    return _operator("fitted")(r, xi, w)


def spread(x: Tensor, mean: Tensor, w: Tensor, groups: Tensor) -> Tensor:
    """Covariance of groups of components [G, s] of x [R, N, K], by mean [R, K] and weights [R, N] -> [R, G, s, s]."""
    return _operator("spread")(x, mean, w, groups)


def squared_length(e: Tensor, covariance: Tensor) -> Tensor:
    """e' covariance^-1 e: [..., d], symmetric [..., d, d] -> [...]."""
    d = e.shape[-1]
    return _operator("squared_length")(e.reshape(-1, d), covariance.expand(*e.shape, d).reshape(-1, d, d)).view(e.shape[:-1])


def marginal_scores(error: Tensor, deviation: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """CRPS and probability below 0 [R, d] of particles at error [R, d] + deviation [R, N, d] by weights [R, N] whose sum is 1."""
    return _operator("marginal_scores")(error, deviation, w)


def energy_score(points: Tensor) -> Tensor:
    """Energy score of equally weighted points [R, n, s] against 0: [R]."""
    return _operator("energy_score")(points)


def follow(
    step: int, outputs: int, constants: list[Tensor], state: list[Tensor], seen: list[Tensor], shared: list[Tensor]
) -> list[Tensor]:
    """What a compiled step at this address leaves, `outputs` tensors for each of T steps, one after the other.

    What it leaves as [..., R, N] comes as [R, N, ...]. It is given the constants, the state (its own first outputs, the next
    time), its part of what is seen [T, ...], and what all steps share.
    """
    found: list[Tensor] = _operator("follow")(step, outputs, constants, state, seen, shared)
    return found


_STEP = normals, uniforms, systematic, copied, log_normal, affine, driven, distinct, totals, moments, follow
_GAUSSIAN = rooted, updated, fitted
_REPORT = spread, squared_length, marginal_scores, energy_score
for _loop in _STEP + _GAUSSIAN + _REPORT:
    _operators.define(_loop.__name__ + torch.library.infer_schema(_loop, mutates_args=()))
cuda.register(_operators)
torch.library.register_fake("pfbench::driven", lambda phi, x, ancestors, *_: x.new_empty(x.shape[0], *ancestors.shape))

_KINDS = {"T": "AtenTensorHandle", "i": "int64_t"}
_CALLED = {  # what each is given, and gives
    "normals": ("TiTTii", "T"), "uniforms": ("TiTTii", "T"), "systematic": ("TTT", "T"), "copied": ("TT", "T"),
    "affine": ("TTTT", "T"), "distinct": ("TT", "T"), "totals": ("T", "TT"), "moments": ("TT", "TT"),
}  # fmt: skip


class ByName(dict[str, list[str]]):
    """Knows operators by their names: torch keys its cache on disk by what it is told, and cannot write an operator down."""

    def __contains__(self, operator: object) -> bool:
        return super().__contains__(str(operator))


def shims() -> ByName:
    """C declarations of the operators that compiled code may call by their names, in place of having torch look them up."""

    def declared(name: str, given: str, found: str) -> str:
        words = [*(_KINDS[kind] for kind in given), *(f"{_KINDS[kind]}*" for kind in found)]
        return f"AOTITorchError aoti_torch_cpu_{name}({', '.join(words)})"

    _load()
    return ByName({f"pfbench.{name}.default": [declared(name, *kinds)] for name, kinds in _CALLED.items()})


def address(library: str, function: str) -> int:
    """Of a function in a library that is loaded already.

    Raises:
        AttributeError: it has no such function.
    """
    found = ctypes.cast(getattr(ctypes.CDLL(library), function), ctypes.c_void_p).value
    assert found is not None
    return found


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


@cache
def _operator(name: str) -> Callable[..., Any]:
    _load()
    return cast(Callable[..., Any], getattr(torch.ops.pfbench, name).default)


@cache
def _load() -> None:
    """Compiles what is not compiled yet, and has it registered: what it holds is what operators do on the CPU."""
    compiler = next((found for name in ("c++", "g++", "clang++") if (found := shutil.which(name))), None)
    if compiler is None:
        raise OSError("no C++ compiler")
    what = (compiler, _FLAGS, os.cpu_count(), torch.__version__)
    sources = {name: (_HERE / f"{name}.cpp").read_bytes() for name in _FLAGS}
    text = b"".join(sources.values()) + (_HERE / "tensors.h").read_bytes()
    name = hashlib.sha256(text + repr(what).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"pfbench_{os.getuid()}"
    built = folder / f"{name}.so"
    if not built.exists():
        folder.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            parts, new = [Path(scratch) / f"{source}.o" for source in sources], Path(scratch) / built.name
            commands = [
                [compiler, *_FLAGS[source], f"-I{_TORCH / 'include'}", "-o", str(part), str(_HERE / f"{source}.cpp")]
                for source, part in zip(sources, parts, strict=True)
            ]
            with ThreadPoolExecutor() as together:
                list(together.map(partial(subprocess.run, check=True, capture_output=True), commands))
            # linked without -ffast-math, with which a library switches small numbers off in the whole process
            libraries = [f"-L{_TORCH / 'lib'}", "-ltorch_cpu", "-lm"]
            if sys.platform == "darwin":  # as elsewhere by itself, Python is found when the library is loaded
                libraries.append("-Wl,-undefined,dynamic_lookup")
            subprocess.run([compiler, "-shared", "-o", new, *parts, *libraries], check=True, capture_output=True)
            os.replace(new, built)
    ctypes.CDLL(str(built), mode=ctypes.RTLD_GLOBAL)  # what a compiler makes of a step calls the loops by their names
