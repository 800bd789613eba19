"""Resolution of the number type: whether it represents the standard deviations of a problem.

A number x of a type has a spacing of eps |x|. The estimate of a filter is off by about the largest of these ratios, in
standard deviations (measured for EKF, CKF and UKF on linear models, see `tests/filter/test_resolution.py`):

- the spacing of a measurement against its noise,
- the spacing of a state against its standard deviation,
- eps against the smallest share of variance that a component has, given those before it. It is the
  reciprocal of the condition of the correlations.

The limit is a tenth of a standard deviation [ours]. A component of zero variance is known exactly and is left out. Double
precision always passes. Of particle filters only the measurements are checked: after resampling, constant components such as
sensor biases may be equal in all particles, in any number type.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pfbench.core.density import has_finite_moments
from pfbench.model.base import StateSpaceModel, initial_law

LIMIT = 0.1  # standard deviations

_LARGE = 0.9  # quantile of the measurements that decides, so that outliers do not
_STEPS = 10
_PIVOT_SCALE = 4.0  # the error of the narrowest direction is a quarter of eps / pivot


def is_coarse(value: Tensor, variance: Tensor) -> Tensor:
    """Return where the spacing of numbers exceeds the limit.

    Args:
        value: Numbers in the type of the computation.
        variance: Their variances.

    Returns:
        Mask. False where a variance is zero or not finite, and for float64.
    """
    if value.dtype == torch.float64:
        return torch.zeros_like(value, dtype=torch.bool)
    spacing = torch.finfo(value.dtype).eps * value.abs()
    return (spacing > LIMIT * variance.sqrt()) & (variance > 0.0)


def is_ill_conditioned(covariance: Tensor) -> Tensor:
    """Return the runs whose correlations the number type does not resolve.

    Args:
        covariance: Covariances, [R, d, d].

    Returns:
        Mask, [R]. False where the covariance is not finite, and for float64.
    """
    if covariance.dtype == torch.float64:
        return torch.zeros(len(covariance), dtype=torch.bool, device=covariance.device)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    sd = torch.sqrt(torch.where(variance > 0.0, variance, 1.0))
    correlation = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    fixed = torch.diag_embed((variance <= 0.0).to(sd))  # known exactly: a one on the diagonal
    lower, info = torch.linalg.cholesky_ex(correlation + fixed)
    pivot = lower.diagonal(dim1=-2, dim2=-1).square().amin(-1)
    eps = torch.finfo(covariance.dtype).eps
    is_finite = torch.isfinite(covariance).flatten(1).all(1)
    return is_finite & ((info > 0) | (eps > _PIVOT_SCALE * LIMIT * pivot))


def starts_certain(model: StateSpaceModel, runs: int, spread: Tensor | None) -> Tensor:
    """Return the runs whose initial state is known exactly.

    Args:
        model: State-space model.
        runs: Number of runs R.
        spread: Cholesky factor of each run's initial covariance, [R, d, d]; None uses the model.

    Returns:
        Mask, [R]. False where the variance of the initial distribution does not exist.
    """
    initial = initial_law(model, runs, spread)
    if not has_finite_moments(initial):
        return torch.zeros(runs, dtype=torch.bool, device=model.anchor.device)
    return (initial.variance == 0.0).all(-1).expand(runs)


def check_measurement_resolution(distribution: Any, y: Tensor, model: str) -> None:
    """Check that a type other than float64 resolves the measurements.

    Args:
        distribution: Distribution of the measurements of the first step, batch [R, N].
        y: Prepared measurements, [R, T, Dy], in the type of the computation.
        model: Name of the model.

    Raises:
        ValueError: If a tenth of the measurements of a component have a spacing above a tenth of
            their standard deviation.
    """
    if y.dtype == torch.float64 or not has_finite_moments(distribution):
        return
    sd = distribution.stddev.flatten(0, 1).nanmedian(0).values
    some = y[:, :: max(1, y.shape[1] // _STEPS)].flatten(0, 1).abs()
    size = some.nanquantile(_LARGE, 0)
    coarse = is_coarse(size, sd.square()).nonzero().flatten().tolist()
    if coarse:
        k, name = coarse[0], str(y.dtype).removeprefix("torch.")
        spacing = torch.finfo(y.dtype).eps * float(size[k])
        raise ValueError(
            f"dtype must resolve a tenth of the measurement noise of {model}, got {name} with a "
            f"spacing of {spacing:.2g} for component {k} of standard deviation {float(sd[k]):.2g}. "
            "Set dtype=float64."
        )
