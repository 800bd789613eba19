"""Integrated force in windows of a second: 27 running integrals, from which any order of axes is a sum."""

from __future__ import annotations

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation, Slerp

from pfbench.files.table_file import Array
from pfbench.logs.doctor.raw_log import RawLog, interpolate_columns
from pfbench.logs.doctor.turn_search import integrate, select_nodes

_WINDOW, _LONGEST, _FEWEST = 1.0, 1.6, 8  # s of a window, s at most, and number
_BLOCK = 120  # windows that are integrated at once
# Of the residual's weight per (m/s^2)^2 of bias, else gravity is explained by a bias; median residuals of windows that count.
_PENALTY, _GROSS = 0.03, 6.0
DOWN = np.array([0.0, 0.0, 1.0])


class ForceWindows(NamedTuple):
    """Windows of the reference with the integrals of the IMU.

    Attributes:
        change: Mean acceleration of the reference, m/s^2, [p, 3].
        products: Mean products of rotation (i, j) and force k, [p, 3, 3, 3].
        rotation: Mean rotation from the body to the level frame, [p, 3, 3].
        time: Start of each window, s, [p].
        gravity: Gravity, m/s^2.
    """

    change: Array
    products: Array
    rotation: Array
    time: Array
    gravity: float


class ForceFit(NamedTuple):
    """Fit of the force to the reference with some axes.

    Attributes:
        cost: Mean squared residual with the penalty of the bias, (m/s^2)^2.
        bias: Addition to the force in body axes that fits best, m/s^2, [3].
        residual: Residuals, m/s^2, [p, 3].
        keep: Windows that count, [p].
    """

    cost: float
    bias: Array
    residual: Array
    keep: NDArray[np.bool_]


def integrate_force(log: RawLog, dcm: Array, offset: float) -> ForceWindows | None:
    """Integrate the force over windows of the reference.

    Args:
        log: Log.
        dcm: Rotations of the reference from the body to the level frame, [k, 3, 3].
        offset: Delay of the IMU, s.

    Returns:
        Windows, or None if there are few.
    """
    time, imu_time = log.reference.time, log.imu.time - offset
    nodes = select_nodes(time, _WINDOW)
    step = np.diff(time[nodes])
    good = (step < _LONGEST) & (time[nodes[:-1]] >= imu_time[0]) & (time[nodes[1:]] <= imu_time[-1])
    if good.sum() < _FEWEST:
        return None
    sums = np.vstack(list(_integrate_blocks(log, dcm, imu_time, nodes)))[good]
    change = np.diff(log.reference.velocity[nodes], axis=0)[good]
    mean = sums / step[good][:, None]
    return ForceWindows(
        change / step[good][:, None],
        mean[:, :27].reshape(-1, 3, 3, 3),
        mean[:, 27:].reshape(-1, 3, 3),
        time[nodes[:-1]][good],
        log.gravity,
    )


def _integrate_blocks(
    log: RawLog, dcm: Array, imu_time: Array, nodes: NDArray[np.intp]
) -> Iterator[Array]:
    """Yield the integrals of products and rotations in the windows, [b, 36], so that memory stays small."""
    time = log.reference.time
    for first in range(0, len(nodes) - 1, _BLOCK):
        borders = nodes[first : first + _BLOCK + 1]
        rows = slice(int(borders[0]), int(borders[-1]) + 1)
        low, high = np.searchsorted(imu_time, (time[borders[0]], time[borders[-1]]))
        samples = slice(max(0, int(low) - 1), int(high) + 1)
        t, force = imu_time[samples], log.imu.force[samples]
        if len(t) < 2:
            yield np.zeros((len(borders) - 1, 36))
            continue
        inside = np.clip(t, time[rows][0], time[rows][-1])
        rotation = Slerp(time[rows], Rotation.from_matrix(dcm[rows]))(inside).as_matrix()
        products = (rotation[:, :, :, None] * force[:, None, None, :]).reshape(len(t), 27)
        sums = integrate(t, np.hstack([products, rotation.reshape(len(t), 9)]))
        yield np.diff(interpolate_columns(time[borders], t, sums), axis=0)


def fit_force(windows: ForceWindows, body: Array | None = None, level: Array | None = None) -> ForceFit:  # fmt: skip
    """Fit the bias of the force, and return what remains.

    Args:
        windows: Windows.
        body: Matrix from the recorded to the true body axes, [3, 3]. None for the recorded axes.
        level: Matrix from the recorded to the true level axes, [3, 3]. None for the recorded axes.

    Returns:
        The fit.
    """
    body = np.eye(3) if body is None else body
    predicted = np.einsum("nijk,jk->ni", windows.products, body) + windows.gravity * DOWN
    change = windows.change if level is None else windows.change @ level.T
    residual = change - predicted
    size = np.linalg.norm(residual, axis=1)
    keep = size < _GROSS * np.median(size) + 0.5
    a, z = windows.rotation[keep].reshape(-1, 3), residual[keep].reshape(-1)
    bias = np.linalg.solve(a.T @ a + _PENALTY * keep.sum() * np.eye(3), a.T @ z)
    rest = residual - windows.rotation @ bias
    cost = float(np.square(rest[keep]).sum()) / float(keep.sum()) + _PENALTY * float(bias @ bias)
    return ForceFit(cost, bias, rest, keep)
