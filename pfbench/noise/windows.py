"""Windows of time in which a regime is another."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

Windows = Sequence[Sequence[float | None]]
"""Pairs of seconds (from, to), from inclusive, to exclusive, in order; a `to` of None is the end of the record."""


def checked(windows: Windows, span: float | None) -> None:
    """Raises ValueError for a window that ends before it starts, windows that overlap, a span that is not positive."""
    last = -math.inf
    for window in windows:
        start, stop = edges(window)
        if not start < stop:
            raise ValueError(f"noise.windows: {list(window)} is not a window; give [from, to] in seconds with from < to")
        if start < last:
            raise ValueError(f"noise.windows: {list(window)} starts before the one above it ends; give them in order, apart")
        last = stop
    if span is not None and not 0.0 < span < math.inf:
        raise ValueError(f"noise.span={span}: give the seconds of the record that the windows are written for, or null")


def within(windows: Windows, time: Tensor, span: float | None = None) -> Tensor:
    """Which window holds each of the times, from inclusive, to exclusive: [T] -> int64 [T], -1 outside all.

    Args:
        windows: see Windows.
        time: s [T], up to the end of the record.
        span: seconds of the record that the windows are written for: they are stretched to the one at hand. None takes them
            as they are.

    Raises:
        ValueError: a window that begins after the record's end, so that nothing would happen.
    """
    end = float(time[-1])
    stretch = end / span if span else 1.0
    which = torch.full_like(time, -1, dtype=torch.int64)
    for k, window in enumerate(windows):
        start, stop = edges(window)
        if start * stretch > end:
            raise ValueError(
                f"noise.windows: {list(window)} begins after the record's end at {end:g} s; give an earlier one, or noise.span, "
                "the seconds for which the windows are written, to have them stretched"
            )
        which = torch.where((time >= start * stretch) & (time < stop * stretch), k, which)
    return which


def edges(window: Sequence[float | None]) -> tuple[float, float]:
    """Of one window; what is none has nan for edges, which no order holds for."""
    if len(window) != 2 or window[0] is None:
        return math.nan, math.nan
    return window[0], math.inf if window[1] is None else window[1]
