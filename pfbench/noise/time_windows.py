"""Time windows in which a noise regime acts."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

Windows = Sequence[Sequence[float | None]]
"""Pairs (from, to) in s, from inclusive, to exclusive, in order. None is the end of the record."""


def check_windows(windows: Windows, span: float | None) -> None:
    """Check windows and their reference duration.

    Args:
        windows: See Windows.
        span: Duration of the record for which the windows are written, s, or None.

    Raises:
        ValueError: If a window ends before it starts, windows overlap, or `span` is not positive.
    """
    last = -math.inf
    for window in windows:
        start, stop = window_edges(window)
        if not start < stop:
            raise ValueError(
                "noise.windows_s must be windows [from, to] in seconds with from < to, "
                f"got {list(window)}. Exchange or change its times."
            )
        if start < last:
            raise ValueError(
                f"noise.windows_s must be in order without overlap, got {list(window)}, which "
                "starts before the previous window ends. Sort or join the windows."
            )
        last = stop
    if span is not None and not 0.0 < span < math.inf:
        raise ValueError(
            f"noise.reference_duration_s must be positive, got {span}. "
            "Give the duration in seconds for which the windows are written, or null."
        )


def window_index(windows: Windows, time: Tensor, span: float | None = None) -> Tensor:
    """Find the window of each time: int64 [T], -1 outside all windows.

    Args:
        windows: See Windows.
        time: Times up to the end of the record, [T], s.
        span: Duration for which the windows are written, s. They are stretched to the record. None
            uses them unchanged.

    Returns:
        Index of the window, [T].

    Raises:
        ValueError: If a window begins after the end of the record.
    """
    end = float(time[-1])
    stretch = end / span if span else 1.0
    index = torch.full_like(time, -1, dtype=torch.int64)
    for k, window in enumerate(windows):
        start, stop = window_edges(window)
        if start * stretch > end:
            raise ValueError(
                f"noise.windows_s must begin before the end of the record at {end:g} s, "
                f"got {list(window)}. Give an earlier window, or stretch the windows by "
                "noise.reference_duration_s, the duration for which they are written."
            )
        index = torch.where((time >= start * stretch) & (time < stop * stretch), k, index)
    return index


def window_edges(window: Sequence[float | None]) -> tuple[float, float]:
    """Return start and end of a window, NaN if it is not a valid pair."""
    if len(window) != 2 or window[0] is None:
        return math.nan, math.nan
    return window[0], math.inf if window[1] is None else window[1]
