"""Rotation and velocity increment of the IMU in windows of any length, without padding to the longest."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pfbench.core import chart
from pfbench.logs.worlds.log_tables import Array, ImuLog
from pfbench.logs.worlds.time_grid import list_pieces
from pfbench.nav.strapdown import rotate

_BLOCK = 300  # windows that are integrated at once, so that memory does not grow with the log


def integrate_windows(imu: ImuLog, time: Array) -> tuple[Tensor, Tensor]:
    """Integrate the samples in each window.

    Neighbouring pieces of a window are joined in pairs until one is left, so that memory grows with
    the samples alone. `preintegrate` joins them in the order of time and gives the same to rounding.

    Returns rotation from the body at the end of each window to that at its start, quaternion,
    [n, 4]. Velocity increment in body axes at the start, without gravity, m/s, [n, 3].
    """
    parts = [_integrate_block(imu, time[i : i + _BLOCK + 1]) for i in range(0, len(time) - 1, _BLOCK)]  # fmt: skip
    rotation, velocity = zip(*parts, strict=True)
    return torch.cat(rotation), torch.cat(velocity)


def _integrate_block(imu: ImuLog, time: Array) -> tuple[Tensor, Tensor]:
    """Integrate the samples in each of some neighbouring windows."""
    first, last = np.searchsorted(imu.time, time[[0, -1]])
    near = slice(max(0, int(first) - 1), int(last) + 1)
    imu = ImuLog(imu.time[near], imu.force[near], imu.rate[near])
    window, spans, mean = list_pieces(imu, time)
    force, rate = torch.from_numpy(mean).split(3, -1)
    dt = torch.from_numpy(spans)[:, None]
    rotation = chart.quaternion_from_rotation_vector(rate * dt)
    # the force acts at the attitude in the middle of a piece
    velocity = rotate(chart.quaternion_from_rotation_vector(0.5 * rate * dt), force * dt)
    while len(window) > len(time) - 1:
        first, has_partner = _pairs(window)
        begin, end = torch.from_numpy(first), torch.from_numpy(first[has_partner] + 1)
        mask = torch.from_numpy(has_partner)
        joined_rotation, joined_velocity = rotation[begin], velocity[begin]
        joined_velocity[mask] += rotate(joined_rotation[mask], velocity[end])
        joined_rotation[mask] = chart.quaternion_multiply(joined_rotation[mask], rotation[end])
        window, rotation, velocity = window[first], joined_rotation, joined_velocity
    return rotation, velocity


def _pairs(window: NDArray[np.intp]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return every second piece of each window, and whether the next piece is of the same window."""
    number = np.arange(len(window)) - np.searchsorted(window, window)
    first = np.flatnonzero(number % 2 == 0)
    after = np.minimum(first + 1, len(window) - 1)
    return first, (window[after] == window[first]) & (after > first)
