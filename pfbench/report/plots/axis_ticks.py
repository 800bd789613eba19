"""Scales, limits and tick labels of axes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib import ticker
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from typing_extensions import override

_SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def use_log_if_wide(
    axis: Axes, side: Axis, values: Sequence[np.ndarray], narrow: bool = False
) -> None:
    """Use a logarithmic scale if the values span more than a factor of 10.

    Args:
        axis: Panel.
        side: Its x or y axis.
        values: Plotted values, in arrays of any shape.
        narrow: Whether space is short, so that fewer ticks are labelled.
    """
    positive = _finite(values)
    positive = positive[positive > 0]
    if positive.size and np.quantile(positive, 0.995) > 10 * np.quantile(positive, 0.005):
        (axis.set_xscale if side is axis.xaxis else axis.set_yscale)("log")
        set_plain_ticks(side, positive, narrow)


def set_plain_ticks(side: Axis, values: Sequence[float] | np.ndarray, narrow: bool = False) -> None:
    """Label a logarithmic axis with plain numbers.

    Args:
        side: Axis.
        values: Values that the axis spans.
        narrow: Place ticks at 1 and 3 instead of 1, 2 and 5, where space is short.
    """
    positive = _finite([np.asarray(values)])
    positive = positive[positive > 0]
    span = positive.max() / positive.min() if positive.size else 1.0
    if span < 10:
        side.set_major_locator(ticker.MaxNLocator(4, steps=[1, 2, 5, 10]))
    else:
        narrow = narrow or (side is side.axes.xaxis and positive.max() >= 1e4)
        factors = (1.0, 3.0) if narrow else (1.0, 2.0, 5.0)
        subs = factors if span < 100 else (1.0,)
        side.set_major_locator(ticker.LogLocator(subs=subs, numticks=4 if narrow else 8))
    side.set_major_formatter(_PlainFormatter())
    if span < 100:  # major ticks are dense enough, and minor ticks cost time
        side.set_minor_locator(ticker.NullLocator())
    side.set_minor_formatter(ticker.NullFormatter())


def format_ticks(values: Sequence[float]) -> list[str]:
    """Format the numbers of one axis in one style: all plain, or all as powers of ten."""
    sizes = [abs(value) for value in values if value]
    if not sizes or (max(sizes) < 1e5 and min(sizes) >= 1e-4):
        return [f"{value:g}" for value in values]
    return list(map(_format_power, values))


def _finite(values: Sequence[np.ndarray]) -> np.ndarray:
    """Return all finite values in one array."""
    if not values:
        return np.empty(0)
    flat = np.concatenate([np.ravel(np.asarray(v, dtype=np.float64)) for v in values])
    return flat[np.isfinite(flat)]


def _format_power(value: float) -> str:
    """Format a number as a multiple of a power of ten."""
    if not value:
        return "0"
    digits, _, exponent = f"{value:.3e}".partition("e")
    factor, power = float(digits), "10" + str(int(exponent)).translate(_SUPERSCRIPTS)
    if abs(factor) != 1:
        return f"{factor:g}·{power}"
    return power if factor > 0 else f"-{power}"


class _PlainFormatter(ticker.Formatter):
    """Tick labels in the common style of the visible ticks."""

    @override
    def __call__(self, value: float, pos: int | None = None) -> str:
        return format_ticks([value])[0]

    @override
    def format_ticks(self, values: Any) -> list[str]:
        limits = (-np.inf, np.inf) if self.axis is None else self.axis.get_view_interval()
        low, high = sorted(limits)
        tolerance = 1e-9  # the ends of an axis are ticks up to rounding
        visible = [v for v in values if low * (1 - tolerance) <= v <= high * (1 + tolerance)]
        labels = dict(zip(visible, format_ticks(visible), strict=True))
        return [labels.get(value, "") for value in values]
