"""Kernels in C++ for the CPU and one thread, registered as torch operators.

They are compiled at first use. The file has one function per operator, which makes it long. Each
computes the results of a torch function. It raises ValueError for wrong arguments, and OSError or
CalledProcessError if the C++ compiler is missing or rejects the source. Gradients do not pass through
the kernels.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from inspect import unwrap
from typing import Any, cast

import torch
from torch import Tensor

from pfbench.kernels import cuda
from pfbench.kernels.cpp_library import load_library
from pfbench.kernels.operator_door import explain_errors
from pfbench.kernels.operator_results import register_shapes

_operators = torch.library.Library("pfbench", "DEF")


@explain_errors
def philox_normals(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw standard normal numbers.

    They equal those of `philox.compute_normals` bit for bit.

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


@explain_errors
def philox_normals_float64(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw standard normal numbers in double precision.

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
    return _operator("philox_normals_float64")(seed, purpose, step, runs, components, quarters)


@explain_errors
def philox_uniforms(
    seed: Tensor, purpose: int, step: Tensor, runs: Tensor, components: int, quarters: int
) -> Tensor:
    """Draw uniform numbers on (0, 1).

    They equal those of `philox.compute_uniforms` bit for bit.

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


@explain_errors
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


@explain_errors
def gather_particles(x: Tensor, ancestors: Tensor) -> Tensor:
    """Gather particles by their ancestors.

    Args:
        x: Particles, [D, R, N].
        ancestors: Indices, int64, [R, M].

    Returns:
        Particles, [D, R, M].
    """
    return _operator("gather_particles")(x, ancestors)


@explain_errors
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


@explain_errors
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


@explain_errors
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


@explain_errors
def count_unique(ancestors: Tensor, log_w: Tensor) -> Tensor:
    """Count the distinct ancestors of particles with a finite log weight.

    Args:
        ancestors: Indices below 2 N, [R, N].
        log_w: Log weights, [R, N].

    Returns:
        Counts, [R].
    """
    return _operator("count_unique")(ancestors, log_w)


@explain_errors
def sum_and_squares(terms: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the sums of terms [R, N] and of their squares, [R, 1] each."""
    return _operator("sum_and_squares")(terms)


@explain_errors
def weighted_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the mean and the variance of weighted particles.

    Args:
        x: Particles, [R, N, D].
        w: Weights with sum 1, [R, N].

    Returns:
        Mean and variance, [R, D] each.
    """
    return _operator("weighted_moments")(x, w)


@explain_errors
def cholesky_factor(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Compute lower triangular roots, as `core.covariance.factor`.

    Args:
        covariance: Covariances, [..., d, d].

    Returns:
        Roots, [..., d, d], and a mask of the valid roots, [...].
    """
    batch, matrix = covariance.shape[:-2], covariance.shape[-2:]
    lower, valid = _operator("cholesky_factor")(covariance.reshape(batch.numel(), *matrix))
    return lower.view(covariance.shape), valid.view(batch)


@explain_errors
def kalman_update(
    m: Tensor, r: Tensor, omega: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Condition xi ~ N(0, I) on r = m xi + e with Cov e = omega.

    Args:
        m: Measurement matrices, [R, k, d].
        r: Residuals, [R, k].
        omega: Covariances of e, [R, k, k].

    Returns:
        Mean of xi, [R, d]. Root of its covariance, [R, d, d]. Normalised distance, [R]. Diagonals
        of the roots of omega and of the information of xi, [R, k + d]. Mask of valid omega, [R].
    """
    return _operator("kalman_update")(m, r, omega)


@explain_errors
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


@explain_errors
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


@explain_errors
def squared_mahalanobis(e: Tensor, covariance: Tensor) -> Tensor:
    """Compute e' covariance^-1 e.

    Args:
        e: Errors, [..., d].
        covariance: Symmetric covariances, [..., d, d].

    Returns:
        Squared distances, [...].
    """
    batch, matrix = e.shape[:-1], covariance.shape[-2:]
    return _operator("squared_mahalanobis")(
        e.reshape(batch.numel(), e.shape[-1]),
        covariance.expand(*batch, *matrix).reshape(batch.numel(), *matrix),
    ).view(batch)


@explain_errors
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


@explain_errors
def energy_score(points: Tensor) -> Tensor:
    """Compute the energy score [R] of equally weighted points [R, n, s] against 0."""
    return _operator("energy_score")(points)


_STEP = (
    philox_normals,
    philox_normals_float64,
    philox_uniforms,
    resample_systematic,
    gather_particles,
    log_normal,
    propagate_affine,
    gather_propagate,
    count_unique,
    sum_and_squares,
    weighted_moments,
)
_GAUSSIAN = cholesky_factor, kalman_update, fit_affine
_REPORT = group_covariance, squared_mahalanobis, marginal_scores, energy_score
for _kernel in _STEP + _GAUSSIAN + _REPORT:
    _schema = torch.library.infer_schema(unwrap(_kernel), mutates_args=())
    _operators.define(_kernel.__name__ + _schema)
    register_shapes(_kernel.__name__)
cuda.register(_operators)


@cache
def _operator(name: str) -> Callable[..., Any]:
    load_library()
    return cast(Callable[..., Any], getattr(torch.ops.pfbench, name).default)
