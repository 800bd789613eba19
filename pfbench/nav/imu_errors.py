"""Gyro and accelerometer errors: constant, Gauss-Markov, white, independent axes.

White noise is the random walk of the integrated output: angular random walk N_g for gyros,
velocity random walk N_a for accelerometers. Gauss-Markov parts are sampled exactly and start in
their stationary distribution [Maybeck 1979, section 4.11].
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream

DEG_H = math.radians(1.0) / 3600  # rad/s
DEG_SQRT_H = math.radians(1.0) / 60  # rad/sqrt(s)
UG = 9.80665e-6  # m/s^2

Matrix: TypeAlias = tuple[
    tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]
]
_ZERO: Matrix = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
_BLOCK = 128  # samples of a Markov process per matrix product


@dataclass(frozen=True)
class ImuErrors:
    """Error sizes of an inertial measurement unit, one standard deviation per axis.

    Attributes:
        gyro_bias_deg_h: Constant part, deg/h.
        gyro_markov_deg_h: Stationary standard deviation of the Gauss-Markov part, deg/h.
        gyro_markov_time_s: Correlation time, s. Required if the Gauss-Markov part is not 0.
        gyro_random_walk_deg_sqrt_h: Angular random walk, deg/sqrt(h).
        accelerometer_bias_ug: Constant part, micro-g (g = 9.80665 m/s^2).
        accelerometer_markov_ug: Stationary standard deviation of the Gauss-Markov part, micro-g.
        accelerometer_markov_time_s: Correlation time, s.
        accelerometer_random_walk_ug_sqrt_hz: Velocity random walk, micro-g/sqrt(Hz).
        randomise_biases: If true, the constant parts are drawn from N(0, sd^2) for each run and axis.
            Otherwise they equal the stated value in every run and axis.
        gyro_misalignment: M_g in w~ = (I + M_g) w + errors, with scale factors on the diagonal
            and misalignments elsewhere.
        accelerometer_misalignment: M_a, in the same form.

    Raises:
        ValueError: If a size is negative, or a Gauss-Markov part lacks a correlation time.
    """

    gyro_bias_deg_h: float = 0.0
    gyro_markov_deg_h: float = 0.0
    gyro_markov_time_s: float = 0.0
    gyro_random_walk_deg_sqrt_h: float = 0.0
    accelerometer_bias_ug: float = 0.0
    accelerometer_markov_ug: float = 0.0
    accelerometer_markov_time_s: float = 0.0
    accelerometer_random_walk_ug_sqrt_hz: float = 0.0
    randomise_biases: bool = True
    gyro_misalignment: Matrix = _ZERO
    accelerometer_misalignment: Matrix = _ZERO

    def __post_init__(self) -> None:
        rules = {f.name: "[0, inf] Signs are random." for f in fields(self) if f.type == "float"}
        time = "(0, inf] Give the correlation time of the Markov part in seconds."
        rules |= {"gyro_markov_time_s": time} if self.gyro_markov_deg_h > 0 else {}
        rules |= {"accelerometer_markov_time_s": time} if self.accelerometer_markov_ug > 0 else {}
        require_ranges("", self, **rules)

    @property
    def gyro_bias(self) -> float:
        """Constant part, rad/s."""
        return self.gyro_bias_deg_h * DEG_H

    @property
    def gyro_markov(self) -> float:
        """Stationary standard deviation of the Gauss-Markov part, rad/s."""
        return self.gyro_markov_deg_h * DEG_H

    @property
    def gyro_random_walk(self) -> float:
        """Angular random walk, rad/sqrt(s)."""
        return self.gyro_random_walk_deg_sqrt_h * DEG_SQRT_H

    @property
    def accelerometer_bias(self) -> float:
        """Constant part, m/s^2."""
        return self.accelerometer_bias_ug * UG

    @property
    def accelerometer_markov(self) -> float:
        """Stationary standard deviation of the Gauss-Markov part, m/s^2."""
        return self.accelerometer_markov_ug * UG

    @property
    def accelerometer_random_walk(self) -> float:
        """Velocity random walk, (m/s)/sqrt(s)."""
        return self.accelerometer_random_walk_ug_sqrt_hz * UG


class ImuMeasurements(NamedTuple):
    """Increments with sensor errors, and the errors. R runs, n samples, body axes.

    Attributes:
        dtheta: Angle increments, [R, n, 3], rad.
        dv: Velocity increments, [R, n, 3], m/s.
        gyro_bias: Constant part, [R, 3], rad/s.
        gyro_markov: Gauss-Markov part during each sample, [R, n, 3], rad/s.
        accelerometer_bias: Constant part, [R, 3], m/s^2.
        accelerometer_markov: Gauss-Markov part during each sample, [R, n, 3], m/s^2.
    """

    dtheta: Tensor
    dv: Tensor
    gyro_bias: Tensor
    gyro_markov: Tensor
    accelerometer_bias: Tensor
    accelerometer_markov: Tensor


def add_imu_errors(
    dtheta: Tensor,
    dv: Tensor,
    dt: float,
    errors: ImuErrors,
    draws: RandomStream,
    process: Tensor | None = None,
) -> ImuMeasurements:
    """Add sensor errors to ideal increments.

    Returns increments with errors, and the errors. Shapes: dtheta [n, 3], dv [n, 3], process [n].
    """
    n = dtheta.shape[-2]
    scale = 1.0 if process is None else process.sqrt()[:, None]
    e = errors
    gyro_bias = _draw_constant("world.imu.gyro_bias", e.gyro_bias, e.randomise_biases, draws)
    gyro_markov = simulate_gauss_markov(
        "world.imu.gyro_markov", n, e.gyro_markov, e.gyro_markov_time_s, dt, draws, scale
    )
    acc_bias = _draw_constant(
        "world.imu.accelerometer_bias", e.accelerometer_bias, e.randomise_biases, draws
    )
    acc_markov = simulate_gauss_markov(
        "world.imu.accelerometer_markov",
        n,
        e.accelerometer_markov,
        e.accelerometer_markov_time_s,
        dt,
        draws,
        scale,
    )
    w = _apply_misalignment(dtheta, e.gyro_misalignment) + (gyro_bias[:, None] + gyro_markov) * dt
    f = (
        _apply_misalignment(dv, e.accelerometer_misalignment)
        + (acc_bias[:, None] + acc_markov) * dt
    )
    if e.gyro_random_walk > 0:
        w = w + scale * e.gyro_random_walk * math.sqrt(dt) * draws.normal("world.imu.gyro", n, 3)
    if e.accelerometer_random_walk > 0:
        f = f + scale * e.accelerometer_random_walk * math.sqrt(dt) * draws.normal(
            "world.imu.accelerometer", n, 3
        )
    return ImuMeasurements(w, f, gyro_bias, gyro_markov, acc_bias, acc_markov)


def simulate_gauss_markov(
    label: str,
    n: int,
    sigma: float,
    time: float,
    dt: float,
    draws: RandomStream,
    scale: Tensor | float = 1.0,
) -> Tensor:
    """Simulate three independent first-order Gauss-Markov processes.

    x' = -x / time + white noise, with stationary standard deviation sigma. Exact at every dt:
    x_k = e^(-dt/time) x_(k-1) + sigma sqrt(1 - e^(-2 dt/time)) N(0, 1), and x_0 has the
    stationary distribution.

    Returns processes, [R, n, 3]. Shapes: scale [n, 1].
    """
    if sigma == 0:
        return torch.zeros_like(draws.normal(label, 1, 3)).expand(-1, n, 3)
    noise = (draws.normal(label, n, 3) * scale).transpose(1, 2) * (
        sigma * math.sqrt(-math.expm1(-2 * dt / time))
    )
    noise = torch.cat(
        [draws.normal(f"{label}.start", 1, 3).transpose(1, 2) * sigma, noise[..., 1:]], dim=-1
    )
    return _autoregression(noise, dt / time).transpose(1, 2)


def _autoregression(noise: Tensor, decay: float) -> Tensor:
    """Compute x_k = e^(-decay) x_(k-1) + noise_k along the last axis, x_(-1) = 0."""
    # A triangular matrix of powers within a block, and recursion over the last values of the
    # blocks. A loop over 50 000 samples takes a second for any batch size.
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


def _draw_constant(purpose: str, size: float, randomise: bool, draws: RandomStream) -> Tensor:
    z = draws.normal(purpose, 1, 3)[:, 0]
    return size * (z if randomise else torch.ones_like(z))


def _apply_misalignment(increments: Tensor, m: Matrix) -> Tensor:
    return increments if m == _ZERO else increments + increments @ increments.new_tensor(m).T
