"""Tests of filters by averages over runs: unbiased evidence, and convergence."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import Filter
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.model.base import StateSpaceModel
from pfbench.model.linear_gaussian import linear_walk
from pfbench.testing.reference import (
    FilterMoments,
    case_or_default,
    reference_moments,
    run_kalman_filter,
)
from pfbench.testing.results import LawCheck, check_means
from pfbench.testing.subjects import (
    check_count,
    check_is_model,
    check_subject,
    describe_subject,
    takes_arguments,
)


def filter_record(
    method: Filter, model: StateSpaceModel, y: Tensor, seed: int = 1, **options: Any
) -> FilterResult:
    """Filter one record in many runs, or one record per run.

    Args:
        method: Filter to run.
        model: State-space model.
        y: One record [T, Dy], or one per run [R, T, Dy].
        seed: Seed of the random stream.
        **options: `runs` (number of runs of one record), `u` (inputs), `start` [R, D], and options
            of `run_filter`.

    Returns:
        Estimate of all runs.

    Raises:
        ValueError: If `method` is not a filter, or model and measurements are of another type.
    """
    one_record = isinstance(y, Tensor) and y.dim() == 2
    check_subject("filter_record", method, model, y, "T, Dy" if one_record else "R, T, Dy")
    check_is_model("filter_record", model)
    if one_record:
        runs = options.pop("runs", 1)
        check_count("filter_record", runs=runs)
        y = y.expand(runs, -1, -1)
    draws = PhiloxStream(seed, torch.arange(y.shape[0]), model.anchor.dtype)
    record = Record(y, options.pop("u", ()), options.pop("start", None))
    return run_filter(method, model, record, draws, **options)


def check_evidence(
    method: Filter,
    model: StateSpaceModel | None = None,
    y: Tensor | None = None,
    exact: FilterMoments | None = None,
    runs: int = 2000,
    limit: float = 4.5,
) -> LawCheck:
    """Check E[Z_hat f_hat] = Z E[f | y] for f = 1, x and x^2 [Del Moral 2004].

    It holds for any number of particles.

    Args:
        method: Particle filter that is asymptotically exact.
        model: Model with a known answer. A walk with constant velocity by default.
        y: One record, [T, Dy]. Required with `model`.
        exact: Exact answer. The answer of the Kalman filter by default, for linear-Gaussian models.
        runs: Number of independent runs.
        limit: Largest number of standard errors.

    Returns:
        The average with the most standard errors.

    Raises:
        AssertionError: If the statement does not hold.
        ValueError: If the filter, the model or the measurements are of another type.
    """
    check_subject("check_evidence", method, model, y, "T, Dy")
    check_count("check_evidence", 2, runs=runs)
    model, y = case_or_default(model, y)
    answer = reference_moments(model, y) if exact is None else exact  # type: ignore[arg-type]
    estimate = filter_record(method, model, y, runs=runs)
    ratio = torch.exp(estimate.log_evidence - answer.log_evidence).numpy()
    mean, variance = estimate.mean[:, -1].numpy(), estimate.variance[:, -1].numpy()
    mean, variance = (
        np.where(ratio[:, None] > 0.0, a, 0.0) for a in (mean, variance)
    )  # a lost run counts with Z = 0
    scale = np.sqrt(answer.square)
    deviations = {"Z_hat / Z - 1": ratio - 1.0}
    for i in range(mean.shape[1]):
        deviations[f"Z_hat x[{i}]"] = ratio * (mean[:, i] - answer.mean[i]) / scale[i]
        deviations[f"Z_hat x[{i}]^2"] = ratio * (
            (variance[:, i] + mean[:, i] ** 2) / answer.square[i] - 1.0
        )
    return check_means("the evidence is unbiased", deviations, limit)


def check_convergence(
    method: Any,
    sizes: Sequence[int] = (128, 512, 2048),
    runs: int = 100,
    faster: bool = False,
    limit: float = 4.0,
) -> LawCheck:
    """Check that errors fall with the root of the number of particles.

    The error is the distance to the Kalman filter's mean over 20 steps of a walk with constant
    velocity, in its standard deviations.

    Args:
        method: Filter with a field `particles`, or a function from their number to a filter.
        sizes: Numbers of particles.
        runs: Number of independent runs of each.
        faster: Whether a steeper fall passes, as with low-discrepancy points.
        limit: Largest number of standard errors between the slope and -1/2.

    Returns:
        The slope of log error against log particles.

    Raises:
        AssertionError: If the slope is not -1/2.
        ValueError: If `method` is neither a filter with particles nor a function that returns one.
    """
    check_count("check_convergence", 2, runs=runs)
    model, rng = linear_walk(1.0, 0.5, 1.0), np.random.default_rng(2)
    y = torch.tensor(np.cumsum(rng.normal(size=(20, 1)), 0) + rng.normal(size=(20, 1)))
    exact = run_kalman_filter(model, y)
    sd = np.sqrt(np.diagonal(exact.covariance, axis1=1, axis2=2))
    logs, errors = [], []
    for n in sizes:
        sized = _with_particles(method, n)
        estimate = filter_record(sized, model, y, runs=runs)
        squares = (((estimate.mean.numpy() - exact.mean) / sd) ** 2).mean((1, 2))
        logs.append(0.5 * math.log(squares.mean()))
        errors.append(0.5 * squares.std() / squares.mean() / math.sqrt(runs))
    x = np.log(sizes) - np.log(sizes).mean()
    slope, error = float(x @ logs / (x @ x)), float(math.sqrt((x**2) @ np.square(errors)) / (x @ x))
    statement = "errors fall with the root of the number of particles"
    excess = slope + 0.5 if faster else abs(slope + 0.5)
    assert excess < limit * error, (
        f"{statement}: the slope must be -0.5, got {slope:.3f} +- {error:.3f}. "
        f"The limit is {limit:g} errors"
    )
    return LawCheck(statement, slope, limit, error)


def _with_particles(method: Any, n: int) -> Any:
    """Return a filter with n particles."""
    if has_particles(method):
        return replace(method, particles=n)
    if not (callable(method) and takes_arguments(method, 1)):
        got = describe_subject(method, "ParticleFilter(100)")
        raise ValueError(
            "check_convergence: method must be a dataclass with a field `particles`, or a function "
            f"from their number to a filter, got {got}"
        )
    return method(n)


def has_particles(method: object) -> bool:
    """Return whether a filter is a dataclass with a field `particles`.

    Args:
        method: Filter, or another object.

    Returns:
        False for a class.
    """
    is_instance = is_dataclass(method) and not isinstance(method, type)
    return is_instance and "particles" in {field.name for field in fields(method)}  # type: ignore[arg-type]
