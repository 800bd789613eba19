"""Tests of filters: causality, independence of runs, and all tests that apply."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import Filter
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.model.base import StateSpaceModel
from pfbench.testing.averages import (
    check_convergence,
    check_evidence,
    filter_record,
    has_particles,
)
from pfbench.testing.reference import case_or_default
from pfbench.testing.results import LawCheck
from pfbench.testing.subjects import check_count, check_subject, compute_twice

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


def check_filter(method: Any, runs: int = 1000) -> dict[str, LawCheck]:
    """Run all checks that apply to a filter on a linear-Gaussian model.

    Causality and independence apply to every filter. Evidence and convergence apply to particle
    filters that state that they are asymptotically exact.

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
    return results


def _estimates(result: FilterResult) -> dict[str, Tensor]:
    """Return what a repeated call must give again."""
    return {name: getattr(result, name) for name in _NAMES}


def _records(model: StateSpaceModel | None, y: Tensor | None) -> tuple[StateSpaceModel, Tensor]:
    """Return the given model and records [R, T, Dy], or four of the default model."""
    case_model, record = case_or_default(model, y)
    if y is None:
        record = record + PhiloxStream(8, torch.arange(4)).normal("y", *record.shape)
    return case_model, record
