"""Time offset at which positions move as a reference does."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from pfbench.files.table_file import Array

# Rows within the reference, and the weight of the median difference among shifts at which the motion agrees.
_LEAST_ROWS, _OFFSET_WEIGHT = 12, 0.02
_MOST, _MOST_COARSE = 1500, 300  # positions that are compared, and in the coarse search


class MotionSearch:
    """Positions that are moved in time against a reference.

    Args:
        time: Times of the positions, s, [n].
        position: Positions, m, [n, 3].
        clock: Times of the reference, s, [k].
        follow: Positions of the reference at times [m], m, [m, 3].
    """

    def __init__(self, time: Array, position: Array, clock: Array, follow: Callable[[Array], Array]) -> None:  # fmt: skip
        every = max(1, len(time) // _MOST)
        self.time, self.position = time[::every], position[::every]
        self.clock, self.follow = clock, follow

    def spread(self, shift: float, every: int = 1, offset_weight: float = 0.0) -> float:
        """Return the median distance from the reference after removal of the median difference, m.

        A motion with a period agrees at several shifts. The weight of the median difference
        selects among them.
        """
        time = self.time[::every] + shift
        inside = (time >= self.clock[0]) & (time <= self.clock[-1])
        if inside.sum() < max(_LEAST_ROWS, len(time) // 2):
            return np.inf
        difference = self.position[::every][inside] - self.follow(time[inside])
        move = float(np.linalg.norm(np.median(difference, axis=0)))
        return extent_of(difference) + offset_weight * move

    def search(self, first: float, last: float) -> tuple[float, float]:
        """Return spread, m, and shift of the best one from first to last, s, to 1 ms."""
        step, every = max(0.25, (last - first) / 4000), max(1, len(self.time) // _MOST_COARSE)
        grid = np.arange(first, last + step / 2, step)
        shift = float(grid[np.argmin([self.spread(s, every, _OFFSET_WEIGHT) for s in grid])])
        for half, finer in ((2 * step, step / 5), (0.5, 0.02), (0.03, 0.001)):
            grid = shift + np.arange(-half, half + finer / 2, finer)
            shift = float(grid[np.argmin([self.spread(s) for s in grid])])
        return self.spread(shift), shift

    def search_all(self) -> tuple[float, float]:
        """Search all shifts that leave half of the positions in the reference."""
        middle = float(np.median(self.time))
        return self.search(self.clock[0] - middle, self.clock[-1] - middle)


def extent_of(points: Array) -> float:
    """Return the median distance of points [n, 3] from their median."""
    return float(np.median(np.linalg.norm(points - np.median(points, axis=0), axis=1)))
