"""Tests of filters: causality, independence of runs, and all tests that apply."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import Filter
from pfbench.filter.exactness import has_bounded_weights
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.model.base import StateSpaceModel
from pfbench.model.linear_gaussian import linear_walk
from pfbench.testing.reference import (
    FilterMoments,
    bounded_case,
    case_or_default,
    reference_moments,
    run_kalman_filter,
)
from pfbench.testing.results import (
    LawCheck,
    check_count,
    check_is_model,
    check_means,
    check_subject,
    compute_twice,
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
    """Return whether a filter is a dataclass with a field `particles`."""
    is_instance = is_dataclass(method) and not isinstance(method, type)
    return is_instance and "particles" in {field.name for field in fields(method)}  # type: ignore[arg-type]


Runner = Callable[[Filter, StateSpaceModel, Tensor], FilterResult]
_NAMES = ("mean", "variance", "log_evidence")


def check_causality(
    method: Filter,
    model: StateSpaceModel | None = None,
    y: Tensor | None = None,
    run: Runner = filter_record,
) -> LawCheck:
    """Check that an estimate does not use later measurements.

    Args:
        method: Filter to test.
        model: State-space model. A walk with constant velocity by default.
        y: Records, [R, T, Dy]. Required with `model`.
        run: Function (method, model, y) that filters the records.

    Returns:
        The largest difference, which is 0.

    Raises:
        AssertionError: If the filter is not repeatable, or if a change of y after step t changes an
            estimate up to t.
        ValueError: If the filter, the model or the measurements are of another type.
    """
    check_subject("check_causality", method, model, y, "R, T, Dy")
    case_model, y = _records(model, y)
    statement = "an estimate uses no later measurement"
    record = y
    before = compute_twice("filter", lambda: run(method, case_model, record), _estimates)
    assert before.mean.isfinite().any(), (
        "the estimate of a run must be finite, got NaN in all runs and steps. A NaN among the weights or the states of one "
        "particle loses its run: print them"
    )
    for t in range(1, y.shape[1]):
        changed_y = y.clone()
        changed_y[:, t:] = changed_y[:, t:] + 0.7
        changed_y[:, t + 1 :: 2] = torch.nan
        after = run(method, case_model, changed_y)
        for name in ("mean", "variance"):
            old, new = (getattr(estimate, name)[:, :t] for estimate in (before, after))
            difference = float((new - old).abs().nan_to_num().max())
            same = torch.equal(old.nan_to_num(), new.nan_to_num())
            assert same, (
                f"{statement}: the {name} up to step {t} must not change, got {difference:.3g}. "
                "The limit is 0"
            )
    return LawCheck(statement, 0.0, 0.0)


def check_independence(
    method: Filter,
    model: StateSpaceModel | None = None,
    y: Tensor | None = None,
    tolerance: float = 1e-12,
) -> LawCheck:
    """Check that a run does not depend on the other runs of its batch.

    Args:
        method: Filter to test.
        model: State-space model. A walk with constant velocity by default.
        y: Records, [R, T, Dy]. Required with `model`.
        tolerance: Relative and absolute tolerance.

    Returns:
        The largest difference.

    Raises:
        AssertionError: If the filter is not repeatable, or if a run alone differs from the same run
            in its batch.
        ValueError: If the filter, the model or the measurements are of another type.
    """
    check_subject("check_independence", method, model, y, "R, T, Dy")
    case_model, records = _records(model, y)
    statement, last = "a run does not depend on others", records.shape[0] - 1
    joint = compute_twice("filter", lambda: filter_record(method, case_model, records), _estimates)
    stream = PhiloxStream(1, torch.tensor([last]), case_model.anchor.dtype)
    alone = run_filter(method, case_model, Record(records[last:]), stream)
    largest = 0.0
    for name in _NAMES:
        a, b = getattr(alone, name)[0], getattr(joint, name)[last]
        difference = float((a - b).abs().nan_to_num().max())
        same = torch.allclose(a, b, rtol=tolerance, atol=tolerance, equal_nan=True)
        assert same, f"{statement}: {name} differs by {difference:.3g}. The limit is {tolerance:g}"
        largest = max(largest, difference)
    return LawCheck(statement, largest, tolerance)


@dataclass(frozen=True, eq=False)
class _WideStream(PhiloxStream):
    """A stream of normal numbers that are five times as far out: an adversary of a density ratio."""

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        return 5.0 * super().normal(purpose, n, w)


def check_bounded_weights(method: ParticleFilter, limit: float = 1000.0) -> LawCheck:
    """Check that ratios of densities are bounded, where an adversary chooses noise and measurement.

    Normal numbers are five times as far out as drawn. Weights differ by several powers of ten.
    Measurements are up to a thousand standard deviations away, and 50 times as sharp as the noise or
    as wide as it. Ratios without a bound are then above e^20.

    Args:
        method: Particle filter.
        limit: Largest ratio.

    Returns:
        The largest ratio, of proposals and of weights to resampling probabilities.

    Raises:
        AssertionError: If a ratio exceeds the limit.
    """
    statement, runs = "density ratios are bounded", torch.arange(8)
    draws = _WideStream(1, runs)
    largest = -math.inf
    for sd in (0.02, 1.0):
        model = linear_walk(1.0, 1.0, sd)
        y = torch.tensor([0.0, 1.0, -3.0, 10.0, -30.0, 100.0, 300.0, -1000.0]).double()
        record = Record(y[:, None])
        if method.initial_proposal is not None:
            first = method.initial_proposal(
                model, Record(y[:, None, None]), method.particles, draws
            )
            largest = max(largest, float(first[1].amax()))
        later = replace(method, initial_proposal=None)
        belief = later.init(model, len(runs), draws.at_step(0))
        log_w = 3.0 * draws.normal("weights", belief.x.shape[1], 1)[..., 0]
        belief = belief._replace(log_w=torch.log_softmax(log_w, -1))
        log_a = method.auxiliary_weights(model, belief, record)
        sample = method.proposal(model, belief, record, draws.at_step(1))
        for log_ratio in (belief.log_w - log_a, sample.log_ratio):
            largest = max(largest, float(log_ratio.amax()))
    assert largest <= math.log(limit), (
        f"{statement}: the largest ratio must be at most {limit:g}, got e^{largest:.1f}. Mix the "
        "proposal or the probabilities with those of the model, or state has_bounded_weights = False"
    )
    return LawCheck(statement, math.exp(largest), limit)


def check_filter(method: Any, runs: int = 1000) -> dict[str, LawCheck]:
    """Run all checks that apply to a filter, on models with a known answer.

    Causality and independence apply to every filter. Evidence and convergence apply to particle
    filters that state that they are asymptotically exact: on a linear-Gaussian model, and with
    measurement errors of bounded support unless the filter refuses them. Filters that state that
    their weights are bounded are searched for a large one.

    Args:
        method: Filter to test.
        runs: Number of runs of the statistical checks.

    Returns:
        Results by the name of the check.

    Raises:
        AssertionError: If the filter is not repeatable, or a statement does not hold.
        ValueError: If it is not a filter.
    """
    check_count("check_filter", 2, runs=runs)
    results = {"causality": check_causality(method), "independence": check_independence(method)}
    if has_particles(method) and method.is_exact:
        results["evidence"] = check_evidence(method, runs=runs)
        results["convergence"] = check_convergence(method, runs=max(40, runs // 10), faster=True)
        model, y, exact = bounded_case()
        if _takes(method, model, y):
            results["bounded errors"] = check_evidence(method, model, y, exact, runs)
    if isinstance(method, ParticleFilter) and has_bounded_weights(method):
        results["bounded weights"] = check_bounded_weights(method)
    return results


def _takes(method: Any, model: StateSpaceModel, y: Tensor) -> bool:
    """Return whether a filter takes a model, instead of a refusal in words."""
    try:
        filter_record(method, model, y)
    except ValueError:
        return False
    return True


def _estimates(result: FilterResult) -> dict[str, Tensor]:
    """Return what a repeated call must give again."""
    return {name: getattr(result, name) for name in _NAMES}


def _records(model: StateSpaceModel | None, y: Tensor | None) -> tuple[StateSpaceModel, Tensor]:
    """Return the given model and records [R, T, Dy], or four of the default model."""
    case_model, record = case_or_default(model, y)
    if y is None:
        record = record + PhiloxStream(8, torch.arange(4)).normal("y", *record.shape)
    return case_model, record
