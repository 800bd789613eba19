"""Time offset at which the integrated angular rate turns as the reference, for any axes of the gyroscope."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from pfbench.files.table_file import Array
from pfbench.logs.doctor.raw_log import RawImu, interpolate_columns

_Mask = NDArray[np.bool_]
TURN_WINDOW, FEWEST_TURNS = (
    0.5,
    12,
)  # s: turns are compared over windows of this length; and their number
_LEAST_SHARE, _LARGEST = 0.4, 25.0  # of the windows, and s: more than the leap seconds
_COARSE = np.unique(np.round(np.r_[np.arange(-_LARGEST, _LARGEST, 0.25), np.arange(-1.5, 1.5, 0.1)], 3))  # fmt: skip
_FINE = np.arange(-0.3, 0.301, 0.02)


def select_nodes(time: Array, interval: float) -> NDArray[np.intp]:
    """Select rows that are an interval apart, or more where the rows are.

    Shapes: time [n].
    """
    nodes, last = [0], 0
    while True:
        last = int(np.searchsorted(time, time[last] + interval - 1e-6))
        if last >= len(time):
            return np.array(nodes)
        nodes.append(last)


@dataclass(frozen=True)
class TurnSearch:
    """Turns of the IMU in the windows of the reference.

    Attributes:
        time: Times of the IMU, s, [n].
        angle: Integrated angular rate, rad, [n, 3].
        nodes: Times of the reference at the borders of the windows, s, [m + 1].
        usable: Windows without a gap of the reference, [m].
    """

    time: Array
    angle: Array
    nodes: Array
    usable: _Mask

    @classmethod
    def over(cls, imu: RawImu, nodes: Array) -> TurnSearch:
        """Integrate the angular rate."""
        step = np.diff(nodes)
        usable = step < max(0.8, 2.5 * float(np.median(step)))
        return cls(imu.time, integrate(imu.time, imu.rate), nodes, usable)

    def pairs(self, turns: Array, offset: float, stretch: _Mask | None = None) -> tuple[Array, Array, _Mask] | None:  # fmt: skip
        """Return turns of the reference and of the IMU without their lines over time, and their windows; None if few.

        Args:
            turns: Rotation vectors of the reference, rad, [m, 3].
            offset: Delay of the IMU, s.
            stretch: Windows to compare, [m]. None for all.

        Returns:
            Two arrays [p, 3] and the mask of their windows, [m].
        """
        at = self.nodes + offset
        required = self.usable if stretch is None else self.usable & stretch
        used = required & (at[:-1] >= self.time[0]) & (at[1:] <= self.time[-1])
        if used.sum() < max(FEWEST_TURNS, _LEAST_SHARE * required.sum()):
            return None
        measured = np.diff(interpolate_columns(at, self.time, self.angle), axis=0)[used]
        # a bias does not turn, nor does one that moves evenly
        return remove_line(turns[used]), remove_line(measured), used

    def score(self, turns: Array, offset: float, stretch: _Mask | None = None) -> float:
        """Return the common part of the turns after the best rotation or reflection of the axes, 0 to 1.

        Args:
            turns: Rotation vectors of the reference, rad, [m, 3].
            offset: Delay of the IMU, s.
            stretch: Windows to compare, [m]. None for all.

        Returns:
            The score.
        """
        pair = self.pairs(turns, offset, stretch)
        if pair is None:
            return 0.0
        true, measured, _ = pair
        size = float(np.linalg.norm(true) * np.linalg.norm(measured))
        if not size > 0.0:
            return 0.0
        return float(np.linalg.svd(true.T @ measured, compute_uv=False).sum()) / size

    def find_error(self, turns: Array, offset: float, stretch: _Mask | None = None) -> float:
        """Return the standard error of an offset, s, by the bend of the scores around it; infinite without one."""
        pair = self.pairs(turns, offset, stretch)
        before, score, after = (self.score(turns, offset + a, stretch) for a in (-0.02, 0.0, 0.02))
        bend = (2.0 * score - before - after) / 0.02**2
        return float(np.sqrt((1.0 - score**2) / (score * len(pair[0]) * bend))) if pair and bend > 0.0 else np.inf  # fmt: skip

    def find(self, turns: Array, around: float | None = None, stretch: _Mask | None = None, reach: float = 0.6) -> tuple[float, float]:  # fmt: skip
        """Find the offset of the largest score.

        Args:
            turns: Rotation vectors of the reference, rad, [m, 3].
            around: Centre of a search. None for 25 s about 0.
            stretch: Windows to compare, [m]. None for all.
            reach: Half of the search about a centre, s.

        Returns:
            Offset, s, and score.
        """
        grid = _COARSE if around is None else around + np.arange(-reach, reach + 0.01, 0.1)
        start = float(grid[int(np.argmax([self.score(turns, float(a), stretch) for a in grid]))])
        fine = start + _FINE
        scores = np.array([self.score(turns, float(a), stretch) for a in fine])
        i = int(np.clip(scores.argmax(), 1, len(fine) - 2))
        bend = scores[i - 1] - 2.0 * scores[i] + scores[i + 1]
        shift = 0.5 * (scores[i - 1] - scores[i + 1]) / bend * 0.02 if bend < 0.0 else 0.0
        return float(fine[i] + np.clip(shift, -0.02, 0.02)), float(scores[i])


def remove_line(values: Array) -> Array:
    """Remove the mean and the line over the row number from columns, [n, k]."""
    row, values = np.arange(len(values)) - 0.5 * (len(values) - 1), values - values.mean(0)
    return np.asarray(values - np.outer(row, row @ values / (row @ row)))


def integrate(time: Array, values: Array) -> Array:
    """Integrate columns by the trapezoidal rule from the first row, [n, k]."""
    steps = 0.5 * np.diff(time)[:, None] * (values[1:] + values[:-1])
    return np.vstack([np.zeros(values.shape[1]), np.cumsum(steps, axis=0)])


def turns_between(dcm: Array, nodes: NDArray[np.intp]) -> Array:
    """Return rotation vectors between nodes in body axes, rad, [m, 3].

    Args:
        dcm: Rotations from the body to the level frame, [k, 3, 3].
        nodes: Rows, [m + 1].

    Returns:
        Rotation vectors.
    """
    a, b = dcm[nodes[:-1]], dcm[nodes[1:]]
    return Rotation.from_matrix(np.swapaxes(a, 1, 2) @ b).as_rotvec()
