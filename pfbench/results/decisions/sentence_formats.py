"""Numbers and intervals of decisions as text, with units."""

from __future__ import annotations

import math

import numpy as np

from pfbench.results.decisions.decision import Decision

_TENFOLD, _MILLION = math.log(10.0), math.log(1e6)


def format_effect(decision: Decision, value: float, low: float, high: float) -> str:
    """Format an effect as "26 % smaller (18 to 33 %)".

    Args:
        decision: Record that gives the scale.
        value: Effect.
        low: Lower end of its interval.
        high: Upper end.
    """
    if decision.scale == "log ratio":
        return _format_change(value, low, high)
    if decision.scale == "difference":
        return f"difference {value:.3g} ({low:.3g} to {high:.3g})"
    ends = [100 * v for v in (low, high)]
    return f"difference {format_digits(100 * value)} percentage points ({format_digits(ends[0])} to {format_digits(ends[1])})"


def _format_change(value: float, low: float, high: float) -> str:
    """Format a log ratio in percent, and as a ratio where percent are beyond tenfold."""
    direction = "smaller" if value < 0 else "larger"
    size = f"{format_digits(100 * abs(math.expm1(min(value, _TENFOLD))))} %"
    if value > _TENFOLD:
        size = f"{_format_ratio(value)} times"
    if max(abs(low), abs(high)) > _TENFOLD:
        return f"{size} {direction} (ratio {_format_ratio(low)} to {_format_ratio(high)})"
    sign = -1.0 if value < 0 else 1.0
    ends = sorted(100 * sign * math.expm1(v) for v in (low, high))
    return f"{size} {direction} ({format_digits(ends[0])} to {format_digits(ends[1])} %)"


def _format_ratio(log_ratio: float) -> str:
    """Format a ratio. A ratio of more than a million is "any number"."""
    if log_ratio > _MILLION:
        return "any number"
    return format_digits(math.exp(log_ratio)) if log_ratio > -_MILLION else "0"


def format_range(error: Decision, low: float, high: float) -> str:
    """Format two ends as "45 % smaller to 2 % larger".

    Args:
        error: Record that gives the scale.
        low: Lower end.
        high: Upper end.
    """
    if error.scale != "log ratio":
        return f"{low:.3g} to {high:.3g}"
    words = [
        f"{format_digits(100 * abs(math.expm1(v)))} % {'smaller' if v < 0 else 'larger'}"
        if abs(v) <= _TENFOLD
        else f"{_format_ratio(v)} times as large"
        if abs(v) <= _MILLION
        else ("any amount smaller" if v < 0 else "any amount larger")
        for v in (low, high)
    ]
    return f"{words[0]} to {words[1]}"


def format_worlds(error: Decision) -> str:
    """Format the worlds of the study."""
    return "this world" if error.worlds == 1 else f"these {error.worlds} worlds"


def format_world_count(error: Decision) -> str:
    """Format the number of worlds with the sign of the estimate."""
    count = error.worlds_better if error.estimate < 0 else error.worlds_worse
    return f"{'smaller' if error.estimate < 0 else 'larger'} in {count} of {format_count(error.worlds, 'world')}"


def format_margin(error: Decision) -> str:
    """Format the margin of equivalence."""
    if error.scale == "log ratio":
        return f"{format_digits(100 * math.expm1(error.margin))} %"
    return f"{error.margin:.3g}"


def format_level(error: Decision) -> str:
    """Format the joint level of the intervals of a family."""
    return f"{format_percent(1 - (1 - error.level) * max(error.family_size, 1))} %"


def format_count(number: int, noun: str) -> str:
    """Format a count with its noun.

    Args:
        number: Count.
        noun: Noun, singular.
    """
    return f"{number} {noun}{'' if number == 1 else 's'}"


def format_percent(share: float) -> str:
    """Format a share in percent, without the sign."""
    return f"{100 * share:.3g}"


def format_digits(value: float, digits: int = 3) -> str:
    """Format a number with significant digits, without an exponent below 1e6.

    Args:
        value: Number.
        digits: Number of significant digits.
    """
    if not math.isfinite(value):
        return (
            "no number of" if math.isnan(value) else ("any amount" if value > 0 else "-any amount")
        )
    if abs(value) >= 1e6:
        return f"{value:.{digits - 1}e}"
    return np.format_float_positional(
        value + 0.0, precision=digits, unique=False, fractional=False, trim="-"
    )


def percent(log_ratio: float) -> str:
    """Format a log ratio as a change in percent with two digits, without its sign.

    Args:
        log_ratio: Log ratio.
    """
    value = abs(100 * math.expm1(min(log_ratio, 20.0)))
    digits = 0 if value >= 10 else 1 if value >= 1 else 2
    return f"{value:.{digits}f}" if value < 1e4 else f"{value:.1e}"
