"""Preintegration of IMU samples over filter intervals, with bias corrections.

[Forster, Carlone, Dellaert, Scaramuzza 2017, "On-manifold preintegration for real-time
visual-inertial odometry"]
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.nav import attitude


class PreintegratedImu(NamedTuple):
    """IMU increments of each interval, in body axes at its start, without gravity.

    Body axes are right, forward, up.

    Attributes:
        rotation: Rotation from the body at the end to the body at the start, quaternion,
            [R or 1, T, 4].
        velocity_increment: Velocity increment, [R or 1, T, 3], m/s.
        position_increment: Position increment from rest, [R or 1, T, 3], m.
        jacobian: Derivatives of (rotation vector on the right of `rotation`, velocity and position
            increment) with respect to (gyro, accelerometer) bias, [R or 1, T, 9, 6].
        bias: Gyro and accelerometer bias that were subtracted, [R or 1, T, 6], rad/s, m/s^2.
        gravity: [R or 1, T], m/s^2, downwards.
        duration: [R or 1, T], s. 0 pads a short run: the interval changes nothing.
    """

    rotation: Tensor
    velocity_increment: Tensor
    position_increment: Tensor
    jacobian: Tensor
    bias: Tensor
    gravity: Tensor
    duration: Tensor


@torch.no_grad()
def preintegrate(
    force: Tensor, rate: Tensor, spans: Tensor, bias: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Preintegrate S samples of an interval, each with mean force and angular rate.

    The force of a sample is rotated by the attitude at its middle, which is second order. Samples
    of zero duration change nothing and can pad intervals with fewer samples.

    Args:
        force: Measured specific force, body axes, [..., S, 3], m/s^2.
        rate: Measured angular rate, [..., S, 3], rad/s.
        spans: Durations, [..., S], s.
        bias: Gyro and accelerometer bias to subtract, [..., 6].

    Returns:
        Rotation [..., 4], velocity and position increment [..., 3] and Jacobian [..., 9, 6], see
        `PreintegratedImu`.
    """
    half_turn = (rate - bias[..., None, :3]) * (0.5 * spans.unsqueeze(-1))
    halves = attitude.dcm_from_rotation_vector(half_turn)
    slips = 0.5 * spans[..., None, None] * right_jacobian(half_turn)
    f = force - bias[..., None, 3:]
    c = torch.eye(3, dtype=f.dtype, device=f.device).expand(*f.shape[:-2], 3, 3)
    v, p = torch.zeros_like(f[..., 0, :]), torch.zeros_like(f[..., 0, :])
    by_c, by_v, by_p = (
        f.new_zeros(*f.shape[:-2], 3, k) for k in (3, 6, 6)
    )  # by_c: gyro bias alone
    for k in range(spans.shape[-1]):
        half, slip, dt = halves[..., k, :, :], slips[..., k, :, :], spans[..., k, None]
        middle, by_middle = c @ half, half.mT @ by_c - slip
        a = (middle @ f[..., k, :, None]).squeeze(-1)
        by_a = torch.cat([-middle @ attitude.skew(f[..., k, :]) @ by_middle, -middle], -1)
        p, by_p = (
            p + (v + 0.5 * a * dt) * dt,
            by_p + (by_v + 0.5 * by_a * dt[..., None]) * dt[..., None],
        )
        v, by_v = v + a * dt, by_v + by_a * dt[..., None]
        c, by_c = middle @ half, half.mT @ by_middle - slip
    top = torch.cat([by_c, torch.zeros_like(by_c)], -1)
    return attitude.quaternion_from_dcm(c), v, p, torch.cat([top, by_v, by_p], -2)


def right_jacobian(r: Tensor) -> Tensor:
    """Compute J with exp(r + d) = exp(r) exp(J d) to first order in d, [..., 3, 3].

    Correct to third order in the rotation vector r [..., 3].
    """
    k = attitude.skew(r)
    unit = torch.eye(3, dtype=r.dtype, device=r.device)
    return unit - 0.5 * k + k @ k / 6.0 - k @ k @ k / 24.0


def rotate(q: Tensor, a: Tensor) -> Tensor:
    """Rotate vectors by unit quaternions.

    Args:
        q: Unit quaternions, [..., 4].
        a: Vectors, [..., 3].
    """
    axis, a = torch.broadcast_tensors(q[..., 1:], a)
    twice = 2.0 * torch.linalg.cross(axis, a)
    return a + q[..., :1] * twice + torch.linalg.cross(axis, twice)
