"""Result of a statistical test, and comparison of averages with expectations."""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require_range
from pfbench.files.table_file import Array
from pfbench.filter.input_check import check_is_filter
from pfbench.model.base import StateSpaceModel, check_components


class LawCheck(NamedTuple):
    """A statement that holds within the limits of its test.

    Attributes:
        statement: Statement in words.
        statistic: Value that is compared with the limit: a number of standard errors, a p-value or
            a slope.
        limit: Bound on the statistic.
        standard_error: Standard error of the estimate with the largest statistic, in its unit. NaN
            if the statement is an equality or the statistic a p-value.
        details: Further numbers of the test, by name.
    """

    statement: str
    statistic: float
    limit: float
    standard_error: float = math.nan
    details: Mapping[str, float] = {}


def check_means(
    statement: str, deviations: Mapping[str, Array], limit: float, max_error: float = 0.2
) -> LawCheck:
    """Check that independent deviations average to zero.

    Returns the deviation with the most standard errors.
    """
    worst = LawCheck(statement, 0.0, limit)
    for name, values in deviations.items():
        mean, error = float(values.mean()), float(values.std()) / math.sqrt(len(values))
        statistic = abs(mean) / max(error, 1e-12)
        text = f"{mean:.4g} +- {error:.2g}"
        assert abs(mean) < limit * error + 1e-9, (
            f"{statement}: {name} must average to 0, got {text}, {statistic:.1f} standard errors. "
            f"The limit is {limit:g}"
        )
        assert error < max_error, (
            f"{statement}: {name} is {text}, too uncertain to decide. Use more runs or particles"
        )
        if statistic >= worst.statistic:
            worst = LawCheck(statement, statistic, limit, error, {"mean": mean})
    return worst


def check_p_values(
    statement: str, p_values: Mapping[str, float], limit: float, **details: float
) -> LawCheck:
    """Check that no p-value is below the limit.

    Returns the smallest p-value.
    """
    name, smallest = min(p_values.items(), key=lambda item: item[1])
    numbers = "".join(f", {key} {value:.3g}" for key, value in details.items())
    assert smallest > limit, (
        f"{statement}: p = {smallest:.2g} for {name}{numbers}. The limit is {limit:g}"
    )
    return LawCheck(statement, smallest, limit, details=dict(details))


def find_kind(
    tester: str, stage: object, kinds: Mapping[str, tuple[str, ...]], example: str
) -> str:
    """Return the kind of a stage, by the arguments of its call."""
    if callable(stage) and not isinstance(stage, type):
        for kind, arguments in kinds.items():
            if takes_arguments(stage, len(arguments)):
                return kind
    expected = " or ".join(
        f"a {kind}, called with ({', '.join(arguments)})" for kind, arguments in kinds.items()
    )
    raise ValueError(f"{tester}: stage must be {expected}, got {describe_subject(stage, example)}")


def describe_subject(item: object, example: str) -> str:
    """Return what a test received, with the remedy."""
    if isinstance(item, type):
        return f"the class {item.__name__}. Pass an instance, such as {example}."
    if _is_filter(item):
        return f"the filter {type(item).__name__}. Test a whole filter by check_filter."
    text = repr(item) if isinstance(item, str | int | float | None) else type(item).__name__
    return f"{text}. Pass an instance, such as {example}."


def check_subject(tester: str, method: object, model: object, y: object, dimensions: str) -> None:
    """Check the types of a filter, its model and the measurements."""
    check_is_filter(method)
    if model is not None:
        check_is_model(tester, model)
    axes = len(dimensions.split(","))
    if y is not None and not (isinstance(y, Tensor) and y.dim() == axes):
        got = f"shape {list(y.shape)}" if isinstance(y, Tensor) else type(y).__name__
        raise ValueError(
            f"{tester}: y must be a tensor [{dimensions}], got {got}. Mark a missing component "
            "as NaN."
        )


def check_is_model(tester: str, model: object) -> None:
    """Check that a model is an instance of `StateSpaceModel`, with units and groups of its components."""
    if not isinstance(model, StateSpaceModel):
        got = describe_subject(model, "linear_walk(1.0, 0.5, 1.0)")
        raise ValueError(f"{tester}: model must be a StateSpaceModel, got {got}")
    check_components(model)


def check_count(tester: str, least: int = 1, **counts: object) -> None:
    """Check numbers of runs, particles or paths."""
    for name, value in counts.items():
        require_range(f"{tester}: {name}", value, f"whole [{least}, inf) Choose a larger one.")


def compute_twice(
    subject: str, compute: Callable[[], Any], values: Callable[[Any], Mapping[str, Any]]
) -> Any:
    """Return a result that is computed twice with the same inputs and the same random stream."""
    first, second = compute(), compute()
    later = values(second)
    for name, value in values(first).items():
        old, new = (torch.as_tensor(a).nan_to_num() for a in (value, later[name]))
        is_same = old.shape == new.shape and torch.equal(old, new)
        assert is_same, (
            f"a {subject} is repeatable: the {name} must be the same in a second call with the same "
            "inputs and random stream, got others. This one is not repeatable. Draw all random "
            "numbers from `draws`, not from torch, NumPy or random, and keep no state between calls"
        )
    return first


def takes_arguments(stage: Callable[..., object], count: int) -> bool:
    """Return whether a call takes a number of positional arguments."""
    try:
        inspect.signature(stage).bind(*range(count))
    except ValueError:
        return True
    except TypeError:
        return False
    return True


def _is_filter(item: object) -> bool:
    try:
        check_is_filter(item)
    except ValueError:
        return False
    return True
