"""Line breaks of filter labels, and their placement next to the points of a panel."""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes

from pfbench.report.plots.plotting import LETTER, SMALL

_PASSES = 5  # after two, a label may stand far from its mark
_CLOSE = 9  # points; marks closer than this get a line to their label
_FRACTIONS = np.linspace(0, 1, 25)[:, None]  # positions along a line at which overlap is checked


class _Placement(NamedTuple):
    """Position of a label in points of print: lower left corner, size, line to its mark."""

    corner: np.ndarray
    size: np.ndarray
    mark: np.ndarray
    end: np.ndarray


class _Obstacles(NamedTuple):
    """Points that labels avoid [n, 2], their clearance [n] and the cost of covering them [n]."""

    points: np.ndarray
    clearance: np.ndarray
    cost: np.ndarray


def place_labels(
    axis: Axes, points: np.ndarray, labels: Mapping[int, str], reach: np.ndarray, path: np.ndarray
) -> None:
    """Write small labels near points where they cover nothing, with a line if they are not close.

    Each label takes the position of a grid with the smallest cost. The cost counts the distance
    to its point, and overlap with marks, with the path, and with other labels and their lines.
    Later passes place every label again. The panel must have its final layout.

    Args:
        axis: Panel.
        points: All marks in data coordinates, [n, 2].
        labels: Label texts by row of `points`.
        reach: Radius of each mark in points of print, [n].
        path: Corners of a line through the panel in data coordinates, [m, 2]; NaN for a gap.
    """
    scale = 72 / axis.figure.dpi
    marks, corners = (axis.transData.transform(values) * scale for values in (points, path))
    window = axis.get_window_extent().get_points() * scale
    obstacles = _build_obstacles(marks, corners, reach)
    placements: dict[int, _Placement] = {}
    for k in _PASSES * sorted(labels, key=lambda k: tuple(marks[k])):
        placements.pop(k, None)
        size = _text_size(labels[k])
        boxes = _candidate_boxes(window, size)
        ends = np.clip(marks[k], boxes, boxes + size)
        cost = _position_cost(marks, k, boxes, ends, size, obstacles)
        for placement in placements.values():
            cost += _overlap_cost(marks[k], boxes, ends, size, placement)
        best = int(np.argmin(cost))
        placements[k] = _Placement(boxes[best], size, marks[k], ends[best])
    for k, placement in placements.items():
        distance = np.hypot(*(placement.end - placement.mark))
        is_crowded = (np.hypot(*(marks - marks[k]).T) < _CLOSE).sum() > 1
        _write(axis, labels[k], points[k], placement, bool(distance > reach[k] + 3 or is_crowded))


def _build_obstacles(marks: np.ndarray, corners: np.ndarray, reach: np.ndarray) -> _Obstacles:
    """Return the marks and points along the path that labels avoid."""
    points = np.concatenate([marks, *(a + _FRACTIONS * (b - a) for a, b in pairwise(corners))])
    extra = len(points) - len(marks)
    clearance = np.concatenate([reach, np.full(extra, 1.0)])
    cost = np.concatenate([np.full(len(marks), 300.0), np.full(extra, 4.0)])
    return _Obstacles(points, clearance, cost)


def _candidate_boxes(window: np.ndarray, size: np.ndarray) -> np.ndarray:
    """Return the lower left corners [m, 2] of a grid over the panel."""
    low, high = window
    last = np.maximum(high - size - 1, low + 1)
    x, y = (np.arange(low[i] + 1, last[i] + 1, step) for i, step in enumerate((4, 2.5)))
    return np.stack(np.meshgrid(x, y), -1).reshape(-1, 2)


def _position_cost(
    marks: np.ndarray,
    k: int,
    boxes: np.ndarray,
    ends: np.ndarray,
    size: np.ndarray,
    obstacles: _Obstacles,
) -> np.ndarray:
    """Return the cost [m] of label k at each box, without the other labels."""
    mark = marks[k]
    cost = np.hypot(*(ends - mark).T) + 0.02 * np.abs(boxes + size / 2 - mark).sum(-1)
    cost += _covered(boxes, size, obstacles.points, obstacles.clearance) @ obstacles.cost
    lines = mark + _FRACTIONS[::3] * (ends[:, None] - mark)
    others = marks[np.hypot(*(marks - mark).T) > _CLOSE]
    is_near = ((lines[:, :, None] - others) ** 2).sum(-1) < 3**2
    cost += 20 * is_near.any(1).sum(-1)
    return np.asarray(cost)


def _overlap_cost(
    mark: np.ndarray, boxes: np.ndarray, ends: np.ndarray, size: np.ndarray, placed: _Placement
) -> np.ndarray:
    """Return the cost [m] of overlap with a placed label and its line."""
    lines = mark + _FRACTIONS[::3] * (ends[:, None] - mark)
    corner, top = placed.corner, placed.corner + placed.size
    cost = 1000.0 * ((boxes < top + 1) & (corner < boxes + size + 1)).all(-1)
    placed_line = placed.mark + _FRACTIONS * (placed.end - placed.mark)
    cost += 300 * _covered(boxes, size, placed_line, np.ones(len(placed_line))).any(-1)
    cost += 300 * ((lines > corner) & (lines < top)).all(-1).any(-1)
    cost += 60 * _lines_cross(mark, ends, placed.mark, placed.end)
    return np.asarray(cost)


def _write(
    axis: Axes, text: str, point: np.ndarray, placement: _Placement, with_line: bool
) -> None:
    """Write one label at its position."""
    line: Any = {"arrowstyle": "-", "lw": 0.4, "color": "0.35", "shrinkA": 0, "shrinkB": 0}
    anchor = (placement.end - placement.corner) / placement.size
    # The end near the mark is fixed, because letter widths are estimates.
    side = 0.0 if anchor[0] < 0.1 else 1.0 if anchor[0] > 0.9 else 0.5
    axis.annotate(
        text,
        tuple(point),
        tuple(placement.corner + (side, 0.5) * placement.size - placement.mark),
        textcoords="offset points",
        fontsize=SMALL,
        ha={0.0: "left", 0.5: "center", 1.0: "right"}[side],
        va="center",
        linespacing=1.0,
        zorder=5,
        arrowprops=line | {"relpos": tuple(anchor)} if with_line else None,
        in_layout=False,
    )


def _text_size(text: str) -> np.ndarray:
    """Return the width and height of small text in points of print."""
    lines = text.split("\n")
    return np.array([max(map(len, lines)) * LETTER, 1.2 * SMALL * len(lines)])


def _covered(
    boxes: np.ndarray, size: np.ndarray, points: np.ndarray, clearance: np.ndarray
) -> np.ndarray:
    """Return the mask [m, n] of points [n, 2] within the clearance [n] of boxes [m, 2]."""
    offset = np.clip(points, boxes[:, None], boxes[:, None] + size) - points
    return np.asarray((offset**2).sum(-1) < clearance**2)


def _lines_cross(a: np.ndarray, ends: np.ndarray, c: np.ndarray, d: np.ndarray) -> np.ndarray:
    """Return the mask [m] of lines from a to `ends` [m, 2] that cross the line from c to d."""

    def side(p: np.ndarray, q: np.ndarray, r: np.ndarray) -> np.ndarray:
        u, v = q - p, r - p
        return np.asarray(u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0])

    is_split = side(a, ends, c) * side(a, ends, d) < 0
    return np.asarray(is_split & (side(c, d, a) * side(c, d, ends) < 0))
