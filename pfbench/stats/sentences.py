"""Numbers as text: counts, percent, significant digits."""

from __future__ import annotations

import math

import numpy as np


def format_count(number: int, noun: str) -> str:
    """Format a count with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def format_digits(value: float, digits: int = 3) -> str:
    """Format a number with significant digits, without an exponent below 1e6."""
    if not math.isfinite(value):
        return (
            "no number of" if math.isnan(value) else ("any amount" if value > 0 else "-any amount")
        )
    if abs(value) >= 1e6:
        return f"{value:.{digits - 1}e}"
    return np.format_float_positional(
        value + 0.0, precision=digits, unique=False, fractional=False, trim="-"
    )


def format_with_interval(ratio: float, low: float, high: float) -> str:
    """Format a ratio with its interval: three decimals where two would put a bound on one that is not one.

    An end that lost runs or few runs leave open is infinite. One that is exactly 1, where a test stops, is written 1.

    Args:
        ratio: Ratio of errors.
        low: Lower end of its interval.
        high: Upper end.
    """
    digits = 3 if any(end != 1.0 and f"{end:.2f}" == "1.00" for end in (low, high)) else 2
    ends = {1.0: "1", math.inf: "∞"}
    texts = (ends.get(end, f"{end:.{digits}f}") for end in (low, high))
    return f"{ratio:.{digits}f} [{', '.join(texts)}]"


def percent(log_ratio: float) -> str:
    """Format a log ratio as a change in percent with two digits, without its sign."""
    value = abs(100 * math.expm1(min(log_ratio, 20.0)))
    digits = 0 if value >= 10 else 1 if value >= 1 else 2
    return f"{value:.{digits}f}" if value < 1e4 else f"{value:.1e}"
