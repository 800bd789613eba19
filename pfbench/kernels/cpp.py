"""Kernels in C++ for the CPU and one thread, registered as torch operators.

They are compiled at first use. The file has one function per operator, which makes it long. Each
computes the results of a torch function. It raises OSError or CalledProcessError if the C++ compiler
is missing or rejects the source. Gradients do not pass through the kernels.
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

from pfbench.kernels import cuda

_SOURCES = Path(__file__).parent / "src"
_TORCH = Path(torch.__file__).parent
_COMMON = ("-O3", "-march=native", "-fopenmp-simd", "-fPIC", "-std=c++17", "-c")
_FLAGS = {
    "random_normal": (*_COMMON, "-ffast-math", "-mno-recip"),
    "compiled_step": _COMMON,
    "particles": (
        *_COMMON,
        "-fno-math-errno",
        "-fno-trapping-math",
        "-fno-signed-zeros",
        "-fassociative-math",
    ),
    "linear_algebra": (*_COMMON, "-fno-math-errno", "-fno-trapping-math"),
    "scores": (
        *_COMMON,
        "-fno-math-errno",
        "-fno-trapping-math",
        "-fno-signed-zeros",
        "-fassociative-math",
    ),
}
_operators = torch.library.Library("pfbench", "DEF")


def philox_normals(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw standard normal numbers.

    They equal those of `random_stream.draw_normals` to 5e-6.

    Args:
        seed: Seed, an integer tensor [].
        purpose: Integer code of the label of the random numbers.
        step: Time step, an integer tensor [].
        runs: Run numbers, int64, [R].
        components: Number of components w.
        quarters: A quarter q of the numbers of a component.

    Returns:
        Numbers, float32, [w, R, 4 q].
    """
    return _operator("philox_normals")(seed, purpose, step, runs, components, quarters)


def philox_uniforms(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw uniform numbers on (0, 1).

    They equal those of `random_stream.draw_uniforms` bit for bit.

    Args:
        seed: Seed, an integer tensor [].
        purpose: Integer code of the label of the random numbers.
        step: Time step, an integer tensor [].
        runs: Run numbers, int64, [R].
        components: Number of components w.
        quarters: A quarter q of the numbers of a component.

    Returns:
        Numbers, float64, [w, R, 4 q].
    """
    return _operator("philox_uniforms")(seed, purpose, step, runs, components, quarters)


def resample_systematic(a: Tensor, n: Tensor, u: Tensor) -> Tensor:
    """Choose ancestors by systematic resampling.

    Args:
        a: Resampling probabilities, [R, N].
        n: Number of particles to choose, [R or 1, 1].
        u: Uniform numbers, [R, 1].

    Returns:
        Ancestors, int64, [R, N].
    """
    return _operator("resample_systematic")(a, n, u)


def gather_particles(x: Tensor, ancestors: Tensor) -> Tensor:
    """Gather particles by their ancestors.

    Args:
        x: Particles, [D, R, N].
        ancestors: Indices, int64, [R, M].

    Returns:
        Particles, [D, R, M].
    """
    return _operator("gather_particles")(x, ancestors)


def log_normal(y: Tensor, mean: Tensor, scale: Tensor, constant: Tensor) -> Tensor:
    """Compute -1/2 sum ((y - mean) scale)^2 - constant over components.

    Args:
        y: Measurements, [R, K].
        mean: Predicted measurements, [R, N, K].
        scale: Inverse standard deviations, [R, K].
        constant: Log of the normalising constant, [R].

    Returns:
        Log densities, [R, N].
    """
    return _operator("log_normal")(y, mean, scale, constant)


def propagate_affine(phi: Tensor, x: Tensor, gain: Tensor, w: Tensor) -> Tensor:
    """Compute phi x + gain w.

    Args:
        phi: Transition matrices, [R or 1, D, D].
        x: Particles, [R, N, D].
        gain: Noise gains, [R or 1, D, W].
        w: Process noise, [R, N, W].

    Returns:
        Particles, [D, R, N].
    """
    return _operator("propagate_affine")(phi, x, gain, w)


def gather_propagate(
    phi: Tensor,
    x: Tensor,
    ancestors: Tensor,
    gain: Tensor,
    seed: Tensor,
    purpose: int,
    step: Tensor,
    runs: Tensor,
) -> Tensor:
    """Compute phi x[ancestors] + gain w in one pass, on a CUDA device only.

    It combines `gather_particles`, `philox_normals` and `propagate_affine`.

    Args:
        phi: Transition matrices, [R or 1, D, D].
        x: Particles, [D, R, N].
        ancestors: Indices, int64, [R, M].
        gain: Noise gains, [R or 1, D, W].
        seed: Seed, an integer tensor [].
        purpose: Integer code of the label of the random numbers.
        step: Time step, an integer tensor [].
        runs: Run numbers, int64, [R].

    Returns:
        Particles, [D, R, M].
    """
    return cast(
        Tensor,
        torch.ops.pfbench.gather_propagate.default(
            phi, x, ancestors, gain, seed, purpose, step, runs
        ),
    )


def count_unique(ancestors: Tensor, log_w: Tensor) -> Tensor:
    """Count the distinct ancestors of particles with a finite log weight.

    Args:
        ancestors: Indices below 2 N, [R, N].
        log_w: Log weights, [R, N].

    Returns:
        Counts, [R].
    """
    return _operator("count_unique")(ancestors, log_w)


def sum_and_squares(terms: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the sums of terms [R, N] and of their squares, [R, 1] each."""
    return _operator("sum_and_squares")(terms)


def weighted_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the mean and the variance of weighted particles.

    Args:
        x: Particles, [R, N, D].
        w: Weights with sum 1, [R, N].

    Returns:
        Mean and variance, [R, D] each.
    """
    return _operator("weighted_moments")(x, w)


def cholesky_factor(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Compute lower triangular roots, as `core.covariance.cholesky_with_mask`.

    Returns:
        Roots [..., d, d] and the mask [...] of valid ones.
    """
    lower, valid = _operator("cholesky_factor")(covariance.reshape(-1, *covariance.shape[-2:]))
    return lower.view(covariance.shape), valid.view(covariance.shape[:-2])


def kalman_update(
    m: Tensor, r: Tensor, omega: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Condition xi ~ N(0, I) on r = m xi + e with Cov e = omega.

    Args:
        m: Measurement matrices, [R, k, d].
        r: Residuals, [R, k].
        omega: Covariances of e, [R, k, k].

    Returns:
        Mean [R, d] and root [R, d, d] of xi; normalised distance [R]; diagonals [R, k + d]
        of the roots of omega and of the information of xi; mask [R] of valid omega.
    """
    return _operator("kalman_update")(m, r, omega)


def fit_affine(r: Tensor, xi: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Fit an affine function to residuals at weighted points.

    Args:
        r: Residuals, [R, P, k].
        xi: Points, [P, d].
        w: Weights, [P].

    Returns:
        Slopes [R, k, d] and residual covariance [R, k, k].
    """
    return _operator("fit_affine")(r, xi, w)


def group_covariance(x: Tensor, mean: Tensor, w: Tensor, groups: Tensor) -> Tensor:
    """Compute the covariances of groups of components.

    Args:
        x: Particles, [R, N, K].
        mean: Their mean, [R, K].
        w: Weights with sum 1, [R, N].
        groups: Indices of the components of each group, [G, s].

    Returns:
        Covariances, [R, G, s, s].
    """
    return _operator("group_covariance")(x, mean, w, groups)


def squared_mahalanobis(e: Tensor, covariance: Tensor) -> Tensor:
    """Compute e' covariance^-1 e.

    Args:
        e: Errors, [..., d].
        covariance: Symmetric covariances, [..., d, d].

    Returns:
        Squared distances, [...].
    """
    d = e.shape[-1]
    return _operator("squared_mahalanobis")(
        e.reshape(-1, d), covariance.expand(*e.shape, d).reshape(-1, d, d)
    ).view(e.shape[:-1])


def marginal_scores(error: Tensor, deviation: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the CRPS and P(below 0) of weighted particles.

    Args:
        error: Error of the mean, [R, d].
        deviation: Particles minus their mean, [R, N, d].
        w: Weights with sum 1, [R, N].

    Returns:
        Both scores, [R, d] each.
    """
    return _operator("marginal_scores")(error, deviation, w)


def energy_score(points: Tensor) -> Tensor:
    """Compute the energy score [R] of equally weighted points [R, n, s] against 0."""
    return _operator("energy_score")(points)


def run_steps(
    step: int,
    outputs: int,
    constants: list[Tensor],
    state: list[Tensor],
    inputs: list[Tensor],
    shared: list[Tensor],
) -> list[Tensor]:
    """Run a compiled step T times.

    Args:
        step: Address of the compiled step.
        outputs: Number of tensors that a step returns.
        constants: First arguments of each step.
        state: Next arguments of the first step. Later steps take the first outputs of the last one.
        inputs: Inputs of all steps, [T, ...]. Each step takes one row.
        shared: Last arguments of each step.

    Returns:
        `outputs` tensors of each step, in order, as views [R, N, ...] of [..., R, N].
    """
    results: list[Tensor] = _operator("run_steps")(step, outputs, constants, state, inputs, shared)
    return results


_STEP = (
    philox_normals,
    philox_uniforms,
    resample_systematic,
    gather_particles,
    log_normal,
    propagate_affine,
    gather_propagate,
    count_unique,
    sum_and_squares,
    weighted_moments,
    run_steps,
)
_GAUSSIAN = cholesky_factor, kalman_update, fit_affine
_REPORT = group_covariance, squared_mahalanobis, marginal_scores, energy_score
for _kernel in _STEP + _GAUSSIAN + _REPORT:
    _operators.define(_kernel.__name__ + torch.library.infer_schema(_kernel, mutates_args=()))
cuda.register(_operators)
torch.library.register_fake(
    "pfbench::gather_propagate",
    lambda phi, x, ancestors, *_: x.new_empty(x.shape[0], *ancestors.shape),
)

_KINDS = {"T": "AtenTensorHandle", "i": "int64_t"}
_SIGNATURES = {  # arguments and results
    "philox_normals": ("TiTTii", "T"), "philox_uniforms": ("TiTTii", "T"), "resample_systematic": ("TTT", "T"), "gather_particles": ("TT", "T"),
    "propagate_affine": ("TTTT", "T"), "count_unique": ("TT", "T"), "sum_and_squares": ("T", "TT"), "weighted_moments": ("TT", "TT"),
}  # fmt: skip


class OperatorRegistry(dict[str, list[str]]):
    """Operators by name, because the keys of torch's cache on disk cannot hold an operator."""

    def __contains__(self, operator: object) -> bool:
        return super().__contains__(str(operator))


def declare_shims() -> OperatorRegistry:
    """Return C declarations of the operators that compiled code calls directly."""

    def declare(name: str, arguments: str, results: str) -> str:
        words = [*(_KINDS[kind] for kind in arguments), *(f"{_KINDS[kind]}*" for kind in results)]
        return f"AOTITorchError aoti_torch_cpu_{name}({', '.join(words)})"

    _load()
    return OperatorRegistry(
        {f"pfbench.{name}.default": [declare(name, *kinds)] for name, kinds in _SIGNATURES.items()}
    )


def function_address(library: str, function: str) -> int:
    """Return the address of a function in a loaded library.

    Args:
        library: Path of the library.
        function: Name of the function.

    Returns:
        The address.

    Raises:
        AttributeError: If the library does not have this function.
    """
    value = ctypes.cast(getattr(ctypes.CDLL(library), function), ctypes.c_void_p).value
    assert value is not None
    return value


@cache
def keep_freed_memory() -> None:
    """Make glibc keep freed memory for the next step; without effect for other C libraries.

    Otherwise it returns blocks of some megabytes to the system and maps them again at each step,
    which took a sixth of the time of a bootstrap filter with 100 runs of 500 particles.
    """
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        for option in (-1, -3):  # M_TRIM_THRESHOLD, M_MMAP_THRESHOLD of malloc.h
            set_option(option, 1 << 30)


def reset_peak_memory() -> int | None:
    """Reset the peak and return the present memory, bytes; None if not on Linux."""
    trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
    if trim is not None:  # freed memory of earlier jobs would hide the memory of this one
        trim(0)
    try:
        Path("/proc/self/clear_refs").write_text("5")
    except OSError:
        return None
    return _memory("VmRSS")


def peak_memory() -> int:
    """Return the peak memory of the process since `reset_peak_memory`, bytes."""
    return _memory("VmHWM")


def _memory(name: str) -> int:
    (line,) = (
        line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith(name)
    )
    return 1024 * int(line.split()[1])


@cache
def _operator(name: str) -> Callable[..., Any]:
    _load()
    return cast(Callable[..., Any], getattr(torch.ops.pfbench, name).default)


@cache
def _load() -> None:
    """Compile the kernels unless they are cached, and load the library, which registers them."""
    compiler = next(filter(None, map(shutil.which, ("c++", "g++", "clang++"))), None)
    if compiler is None:
        raise OSError("no C++ compiler")
    environment = (compiler, _FLAGS, os.cpu_count(), torch.__version__)
    sources = {name: (_SOURCES / f"{name}.cpp").read_bytes() for name in _FLAGS}
    text = b"".join(sources.values()) + (_SOURCES / "tensors.h").read_bytes()
    name = hashlib.sha256(text + repr(environment).encode()).hexdigest()[:16]
    folder = Path(tempfile.gettempdir()) / f"pfbench_{os.getuid()}"
    built = folder / f"{name}.so"
    if not built.exists():
        folder.mkdir(mode=0o700, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as scratch:
            parts, new = (
                [Path(scratch) / f"{source}.o" for source in sources],
                Path(scratch) / built.name,
            )
            commands = [
                [
                    compiler,
                    *_FLAGS[source],
                    f"-I{_TORCH / 'include'}",
                    "-o",
                    str(part),
                    str(_SOURCES / f"{source}.cpp"),
                ]
                for source, part in zip(sources, parts, strict=True)
            ]
            with ThreadPoolExecutor() as pool:
                list(pool.map(partial(subprocess.run, check=True, capture_output=True), commands))
            # -ffast-math at linking would flush denormal numbers to zero in the whole process
            libraries = [f"-L{_TORCH / 'lib'}", "-ltorch_cpu", "-lm"]
            if sys.platform == "darwin":  # resolve symbols of Python at loading
                libraries.append("-Wl,-undefined,dynamic_lookup")
            subprocess.run(
                [compiler, "-shared", "-o", new, *parts, *libraries],
                check=True,
                capture_output=True,
            )
            os.replace(new, built)
    ctypes.CDLL(str(built), mode=ctypes.RTLD_GLOBAL)  # compiled steps call the kernels by name
