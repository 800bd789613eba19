"""Loosely coupled INS/GNSS: the linear small-angle error model with 15 or 18 states."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.covariance import factor
from pfbench.model.base import StateSpaceModel, affine, independent_normal, normal_batch
from pfbench.nav import attitude, error_dynamics
from pfbench.nav.aiding import Alignment, Inflation, Receiver
from pfbench.nav.sensors import ImuErrors
from pfbench.nav.strapdown import Intervals
from pfbench.record import Record

_AXES = {
    "attitude": (("E", "N", "U"), "rad"),
    "velocity": (("E", "N", "U"), "m/s"),
    "position": (("N", "E", "U"), "m"),
    "gyro_bias": (("x", "y", "z"), "rad/s"),
    "gyro_constant": (("x", "y", "z"), "rad/s"),
    "gyro_markov": (("x", "y", "z"), "rad/s"),
    "accelerometer_bias": (("x", "y", "z"), "m/s^2"),
}
_TAYLOR = 4  # terms of the matrix exponential; at 1 s the fifth is below 1e-6 in any entry, the fourth 1e-4


class Step(NamedTuple):
    """Transition [R or 1, T, D, D] and noise gain [R or 1, T, D, W] of each interval."""

    phi: Tensor
    gain: Tensor


class InsGnss(StateSpaceModel):
    """Errors of an INS (INS minus truth), driven by the nominal trajectory; the receiver sees position and velocity errors.

    States: attitude phi (E, N, U), velocity (E, N, U), position in metres (N, E, U), then

    - 15 states: gyro bias and accelerometer bias, random walks driven as hard as the sensors' Markov parts are;
    - 18 states (`markov`): gyro constant drift, gyro Markov drift, accelerometer Markov bias [Qin Yongyuan's 18-state model].

    Sensor errors enter attitude with -C and velocity with +C. Phi is the matrix exponential to order 4, the noise over an
    interval Gamma sqrt(q / T) with Gamma = sum (F T)^(n-1)/n! G T, rank 12. With `inflation` the noise is full rank, the
    factor of Q + diag(inflation^2), and the transition has a density.

    Args:
        imu: what the model believes of the sensors.
        receiver: what it believes of the receiver; measurement order position N, E, U, velocity E, N, U.
        initial: what it believes of the initial errors.
        markov: 18 states instead of 15.
        inflation: noise added on purpose, or None.

    Raises:
        ValueError: a sensor's bias of 0, which would make the initial law improper.
    """

    linear = True
    p0: Tensor
    r: Tensor
    seen: Tensor

    def __init__(
        self, imu: ImuErrors, receiver: Receiver, initial: Alignment, markov: bool = False, inflation: Inflation | None = None
    ) -> None:
        super().__init__()
        drift = ("gyro_constant", "gyro_markov") if markov else ("gyro_bias",)
        blocks = ("attitude", "velocity", "position", *drift, "accelerometer_bias")
        self.names = tuple(f"{block}_{axis}" for block in blocks for axis in _AXES[block][0])
        self.units = tuple(_AXES[block][1] for block in blocks for _ in range(3))
        self.groups = {block: (3 * i, 3 * i + 1, 3 * i + 2) for i, block in enumerate(blocks)}
        self.imu, self.markov, self.inflation = imu, markov, inflation
        gyro_parts = (imu.gyro_bias, imu.gyro_markov) if markov else (_hypot(imu.gyro_bias, imu.gyro_markov),)
        accelerometer = _hypot(imu.accelerometer_bias, imu.accelerometer_markov)
        biases = [sd for size in (*gyro_parts, accelerometer) for sd in [size] * 3]
        if min(biases) <= 0.0:
            raise ValueError(
                f"model.imu: initial standard deviations {biases} of the sensor errors; give positive gyro and accelerometer "
                "biases" + (" and Markov parts (or markov=false)" if markov else "")
            )
        self.register_buffer("p0", torch.cat([initial.sd, torch.tensor(biases, dtype=torch.float64)]))
        self.register_buffer("r", receiver.sd)
        self.register_buffer("seen", torch.tensor([6, 7, 8, 3, 4, 5][: len(receiver.sd)]))
        self.noise_dim = len(self.names) if inflation else 12
        choices = [f"every filter's model is inflated: {inflation}"] if inflation else []
        if markov and imu.accelerometer_bias > 0 and imu.accelerometer_markov > 0:
            choices.append("the constant accelerometer bias counts as Markov and decays: its spread becomes too small")
        self.choices = tuple(choices)

    @property
    def anchor(self) -> Tensor:
        return self.p0

    def prepare(self, record: Record) -> Record:
        """Intervals of the nominal trajectory to transitions and noise gains, once for all steps."""
        return record if isinstance(record.u, Step) else record._replace(u=self.discretise(record.u))

    def discretise(self, u: Intervals) -> Step:
        """Transition [..., D, D] and noise gain [..., D, W] of intervals with leading axes [...], float64."""
        d = len(self.names)
        f, g, q = self._continuous(u)
        span = u.duration[..., None, None]
        eye = torch.eye(d, dtype=f.dtype, device=f.device).expand_as(f)
        phi, gamma, power = eye, eye, eye
        for n in range(1, _TAYLOR + 1):
            power = power @ f * (span / n)  # (F T)^n / n!
            phi = phi + power
            gamma = gamma + power / (n + 1)
        phi = error_dynamics.in_metres(phi, u.pos_start, u.pos_end)
        noise = error_dynamics.in_metres(gamma, u.pos_start, u.pos_end) @ g * torch.sqrt(q * span)
        if self.inflation is None:
            return Step(phi, noise)
        extra = torch.cat([self.inflation.motion, *[self.inflation.gyro] * (d // 3 - 4), self.inflation.accelerometer])
        full, ok = factor(noise @ noise.mT + torch.diag(extra.to(noise).square()))
        if not bool(ok.all()):
            raise ValueError(f"model.inflation={self.inflation}: no square root of the noise exists; give every state some")
        return Step(phi, full)

    def _continuous(self, u: Intervals) -> tuple[Tensor, Tensor, Tensor]:
        """F [..., D, D], G [..., D, 12], and spectral densities q [12] of gyro, accelerometer, and their drivers."""
        d, imu = len(self.names), self.imu
        f = u.f.new_zeros(*u.f.shape[:-1], d, d)
        g = u.f.new_zeros(*u.f.shape[:-1], d, 12)
        f[..., :9, :9] = error_dynamics.small_angle_matrix(u.pos, u.vel, u.f)
        for start in range(9, d - 3, 3):  # gyro errors
            f[..., 0:3, start : start + 3] = -u.dcm
        f[..., 3:6, d - 3 :] = u.dcm
        g[..., 0:3, 0:3], g[..., 3:6, 3:6] = -u.dcm, u.dcm
        eye = torch.eye(3, dtype=f.dtype, device=f.device)
        g[..., d - 6 : d - 3, 6:9] = eye
        g[..., d - 3 :, 9:12] = eye
        gyro_driver = _driver(imu.gyro_markov, imu.gyro_markov_time)
        accelerometer_driver = _driver(imu.accelerometer_markov, imu.accelerometer_markov_time)
        if self.markov:
            f[..., 12:15, 12:15] = -eye / imu.gyro_markov_time
            f[..., 15:18, 15:18] = -eye / imu.accelerometer_markov_time if imu.accelerometer_markov_time > 0 else 0 * eye
        q = [imu.gyro_random_walk**2, imu.accelerometer_random_walk**2, gyro_driver, accelerometer_driver]
        return f, g, f.new_tensor([value for value in q for _ in range(3)])

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Step, w: Tensor) -> Tensor:
        return affine(u.phi, x, u.gain, w)

    def noise_gain(self, u: Step) -> Tensor:
        return u.gain

    def observation(self, x: Tensor, u: Step) -> Distribution:
        return independent_normal(x.permute(2, 0, 1).index_select(0, self.seen).permute(1, 2, 0), self.r)

    def transition(self, x: Tensor, u: Step) -> Distribution | None:
        if self.inflation is None:
            return None
        mean = self.propagate(x, u, x.new_zeros(*x.shape[:2], self.noise_dim))
        law = torch.distributions.MultivariateNormal
        return law(mean, scale_tril=self.noise_gain(u).unsqueeze(1), validate_args=False)

    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        """Corrected navigation minus truth; for the sensor states, estimate minus truth."""
        turned = attitude.residual_error(truth[..., :3], mean[..., :3])
        return torch.cat([turned, truth[..., 3:9] - mean[..., 3:9], mean[..., 9:] - truth[..., 9:]], -1)


def _hypot(a: float, b: float) -> float:
    return (a * a + b * b) ** 0.5


def _driver(sigma: float, time: float) -> float:
    """Spectral density that keeps a first-order Markov process at `sigma`."""
    return 2.0 * sigma**2 / time if sigma > 0 else 0.0
