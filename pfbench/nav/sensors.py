"""Errors of gyros and accelerometers: constant, first-order Markov, white; all axes independent.

The white noise is the random walk of the integrated output: angular random walk N_g for gyros, velocity random walk N_a
for accelerometers. Markov parts are sampled exactly and start in their stationary law [Maybeck 1979, section 4.11].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from pfbench.draws import Draws

DEG_H = math.radians(1.0) / 3600  # rad/s
DEG_SQRT_H = math.radians(1.0) / 60  # rad/sqrt(s)
UG = 9.80665e-6  # m/s^2

Matrix: TypeAlias = tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]
_ZERO: Matrix = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_BLOCK = 128  # samples of a Markov process done by one matrix product


@dataclass(frozen=True)
class ImuErrors:
    """Size of the errors of an inertial measurement unit; one sigma per axis.

    Args:
        gyro_bias_deg_h: constant part, deg/h.
        gyro_markov_deg_h: stationary sigma of the Markov part, deg/h.
        gyro_markov_time: its correlation time, s; needed where the sigma is not 0.
        gyro_random_walk_deg_sqrt_h: angular random walk, deg/sqrt(h).
        accelerometer_bias_ug: constant part, micro-g (g = 9.80665 m/s^2).
        accelerometer_markov_ug: stationary sigma of the Markov part, micro-g.
        accelerometer_markov_time: its correlation time, s.
        accelerometer_random_walk_ug_sqrt_hz: velocity random walk, micro-g/sqrt(Hz).
        drawn_biases: True draws the constant parts from N(0, sigma^2) for each run and axis; False gives every run and
            axis the stated value itself.
        gyro_misalignment: M_g in w~ = (I + M_g) w + errors: scale factors on the diagonal, misalignments beside it.
        accelerometer_misalignment: M_a likewise.

    Raises:
        ValueError: a negative size, or a Markov part without a correlation time.
    """

    gyro_bias_deg_h: float = 0.0
    gyro_markov_deg_h: float = 0.0
    gyro_markov_time: float = 0.0
    gyro_random_walk_deg_sqrt_h: float = 0.0
    accelerometer_bias_ug: float = 0.0
    accelerometer_markov_ug: float = 0.0
    accelerometer_markov_time: float = 0.0
    accelerometer_random_walk_ug_sqrt_hz: float = 0.0
    drawn_biases: bool = True
    gyro_misalignment: Matrix = _ZERO
    accelerometer_misalignment: Matrix = _ZERO

    def __post_init__(self) -> None:
        for name in (f.name for f in fields(self) if f.type == "float"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name}={getattr(self, name)}: give a size, 0 or more; signs are drawn")
        for kind, sigma in (("gyro", self.gyro_markov_deg_h), ("accelerometer", self.accelerometer_markov_ug)):
            time = getattr(self, f"{kind}_markov_time")
            if sigma > 0 and not time > 0:
                raise ValueError(f"{kind}_markov_time={time}: a Markov part needs a correlation time in seconds")

    @property
    def gyro_bias(self) -> float:
        """rad/s."""
        return self.gyro_bias_deg_h * DEG_H

    @property
    def gyro_markov(self) -> float:
        """rad/s."""
        return self.gyro_markov_deg_h * DEG_H

    @property
    def gyro_random_walk(self) -> float:
        """rad/sqrt(s)."""
        return self.gyro_random_walk_deg_sqrt_h * DEG_SQRT_H

    @property
    def accelerometer_bias(self) -> float:
        """m/s^2."""
        return self.accelerometer_bias_ug * UG

    @property
    def accelerometer_markov(self) -> float:
        """m/s^2."""
        return self.accelerometer_markov_ug * UG

    @property
    def accelerometer_random_walk(self) -> float:
        """(m/s)/sqrt(s)."""
        return self.accelerometer_random_walk_ug_sqrt_hz * UG


class Corrupted(NamedTuple):
    """Increments as real sensors give them, and the errors inside; R runs, n samples, body axes.

    Attributes:
        dtheta: angle increments [R, n, 3] rad.
        dv: velocity increments [R, n, 3] m/s.
        gyro_bias: constant part [R, 3] rad/s.
        gyro_markov: Markov part during each sample [R, n, 3] rad/s.
        accelerometer_bias: [R, 3] m/s^2.
        accelerometer_markov: [R, n, 3] m/s^2.
    """

    dtheta: Tensor
    dv: Tensor
    gyro_bias: Tensor
    gyro_markov: Tensor
    accelerometer_bias: Tensor
    accelerometer_markov: Tensor


def corrupt(
    dtheta: Tensor, dv: Tensor, dt: float, errors: ImuErrors, draws: Draws, process: Tensor | None = None
) -> Corrupted:
    """Ideal increments to those of imperfect sensors.

    Args:
        dtheta: [n, 3] or [R, n, 3] rad.
        dv: [n, 3] or [R, n, 3] m/s.
        dt: sampling interval, s.
        errors: their sizes.
        draws: decides the runs R; purposes "world.imu.*".
        process: factor on the variance of what drives the errors in each sample [n], white noise and Markov parts; None is 1.
    """
    n = dtheta.shape[-2]
    swell = 1.0 if process is None else process.sqrt()[:, None]
    e = errors
    gyro_bias = _constant("world.imu.gyro_bias", e.gyro_bias, e.drawn_biases, draws)
    gyro_markov = markov("world.imu.gyro_markov", n, e.gyro_markov, e.gyro_markov_time, dt, draws, swell)
    acc_bias = _constant("world.imu.accelerometer_bias", e.accelerometer_bias, e.drawn_biases, draws)
    acc_markov = markov(
        "world.imu.accelerometer_markov", n, e.accelerometer_markov, e.accelerometer_markov_time, dt, draws, swell
    )
    w = _misaligned(dtheta, e.gyro_misalignment) + (gyro_bias[:, None] + gyro_markov) * dt
    f = _misaligned(dv, e.accelerometer_misalignment) + (acc_bias[:, None] + acc_markov) * dt
    if e.gyro_random_walk > 0:
        w = w + swell * e.gyro_random_walk * math.sqrt(dt) * draws.normal("world.imu.gyro", n, 3)
    if e.accelerometer_random_walk > 0:
        f = f + swell * e.accelerometer_random_walk * math.sqrt(dt) * draws.normal("world.imu.accelerometer", n, 3)
    return Corrupted(w, f, gyro_bias, gyro_markov, acc_bias, acc_markov)


def markov(
    purpose: str, n: int, sigma: float, time: float, dt: float, draws: Draws, swell: Tensor | float = 1.0
) -> Tensor:
    """Three independent first-order Markov processes [R, n, 3]: x' = -x / time + white, of stationary sigma.

    Its driving noise is multiplied by `swell` [n, 1]. Exact at every dt:
    x_k = e^(-dt/time) x_(k-1) + sigma sqrt(1 - e^(-2 dt/time)) N(0, 1), x_0 in the stationary law.
    """
    if sigma == 0:
        return torch.zeros_like(draws.normal(purpose, 1, 3)).expand(-1, n, 3)
    noise = (draws.normal(purpose, n, 3) * swell).transpose(1, 2) * (sigma * math.sqrt(-math.expm1(-2 * dt / time)))
    noise = torch.cat([draws.normal(f"{purpose}.start", 1, 3).transpose(1, 2) * sigma, noise[..., 1:]], dim=-1)
    return _autoregression(noise, dt / time).transpose(1, 2)


def _autoregression(noise: Tensor, decay: float) -> Tensor:
    """x_k = e^(-decay) x_(k-1) + noise_k along the last axis, x_(-1) = 0.

    Within a block by a triangular matrix of powers; the blocks' last values obey the same law with a decay `_BLOCK`
    times as large, hence the recursion. A loop over samples would take a second for 50 000 of them, whatever the batch.
    """
    n = noise.shape[-1]
    k = torch.arange(min(n, _BLOCK), dtype=noise.dtype, device=noise.device)
    powers = torch.tril(torch.exp(-decay * (k[:, None] - k)))
    if n <= _BLOCK:
        return noise @ powers.T
    padded = torch.nn.functional.pad(noise, (0, -n % _BLOCK)).unflatten(-1, (-1, _BLOCK))
    x = padded @ powers.T
    ends = _autoregression(x[..., -1], decay * _BLOCK)
    x[..., 1:, :] += ends[..., :-1, None] * torch.exp(-decay * (k + 1))
    return x.flatten(-2)[..., :n]


def _constant(purpose: str, size: float, drawn: bool, draws: Draws) -> Tensor:
    z = draws.normal(purpose, 1, 3)[:, 0]
    return size * (z if drawn else torch.ones_like(z))


def _misaligned(increments: Tensor, m: Matrix) -> Tensor:
    if m == _ZERO:
        return increments
    return increments + increments @ increments.new_tensor(m).T
