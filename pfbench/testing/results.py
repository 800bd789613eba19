"""Result of a statistical test, and comparison of averages with expectations."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

from pfbench.files.table_file import Array


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

    Args:
        statement: Statement in words, for the message.
        deviations: Deviations from the expectation by name, each [runs], scaled to about 1.
        limit: Largest number of standard errors.
        max_error: Largest standard error with which the test can decide.

    Returns:
        The deviation with the most standard errors.

    Raises:
        AssertionError: If an average exceeds the limit, or its standard error `max_error`.
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

    Args:
        statement: Statement in words, for the message.
        p_values: p-values by the name of the comparison.
        limit: Smallest p-value.
        **details: Further numbers for the result and the message.

    Returns:
        The smallest p-value.

    Raises:
        AssertionError: If a p-value is below the limit.
    """
    name, smallest = min(p_values.items(), key=lambda item: item[1])
    numbers = "".join(f", {key} {value:.3g}" for key, value in details.items())
    assert smallest > limit, (
        f"{statement}: p = {smallest:.2g} for {name}{numbers}. The limit is {limit:g}"
    )
    return LawCheck(statement, smallest, limit, details=dict(details))
