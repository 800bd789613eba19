"""Intervals of a median by order statistics, which decide claims, and of a mean over two crossed samples."""

from __future__ import annotations

from typing import NamedTuple


class ConfidenceInterval(NamedTuple):
    """Interval and the method that produced it.

    Attributes:
        low: Lower end.
        high: Upper end.
        method: Name of the method, "none" if the sample is too small.
    """

    low: float
    high: float
    method: str
