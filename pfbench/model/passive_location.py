"""Airborne passive location: a moving aircraft locates an emitter on the ground."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.chart import wrap_angle
from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.parameter_checks import as_float64, check_positive, require, require_range
from pfbench.model.base import StateSpaceModel

SPEED_OF_LIGHT = 299792458.0  # m/s


class PlatformInputs(NamedTuple):
    """Navigation of the aircraft and emitter frequency, leading axes [R or 1, T].

    Attributes:
        position: Centroid in the ground frame, Z up, [..., 3], m.
        velocity: [..., 3], m/s.
        attitude: Ground to body, [..., 3, 3]. Body axes are starboard, forward, up.
        carrier: Frequency of the emitter, [...], Hz.
    """

    position: Tensor
    velocity: Tensor
    attitude: Tensor
    carrier: Tensor


class PassiveLocation(StateSpaceModel):
    """An emitter on the plane Z = 0, measured by direction, its rates, Doppler rate.

    State [x, y, vx, vy] in the ground frame, driven by white acceleration that is constant over a
    step. The noise has rank 2 of 4, so the transition density does not exist. [Pu and Qin,
    "Application of quasi Monte Carlo polymerization re-sampling particle filter algorithm in
    airborne passive location", eqs 1-7, 10]. The rates omit the rotation of the body: A is the
    attitude at the moment of the measurement. [ours]

    Measurements are in body axes. The bearing residual is wrapped. The elevation is within +-90
    degrees and does not wrap.

    Args:
        interval: Length of a step, s.
        acceleration_sd: Standard deviation of each acceleration component, m/s^2. 0 is an emitter
            on a straight line. The paper does not give it. [ours]
        measurement_sd: Bearing, elevation rad, their rates rad/s, Doppler rate Hz/s, [5].
        initial_mean: Mean of the initial state, [4]. Used if a record contains no initial
            distribution. [ours]
        initial_sd: Standard deviation of the initial state, [4].

    Raises:
        ValueError: If a size is not positive (or negative, for the acceleration), or a list has not
            the stated length.
    """

    channel_names = (
        "bearing of the emitter in body axes [rad]",
        "elevation of the emitter in body axes [rad]",
        "bearing rate [rad/s]",
        "elevation rate [rad/s]",
        "Doppler rate [Hz/s]",
    )
    input_type = PlatformInputs
    phi: Tensor
    gain: Tensor
    r: Tensor
    m0: Tensor
    p0: Tensor
    choices = ("Doppler rate without relative acceleration, in every filter's model",)

    def __init__(
        self,
        interval: float,
        acceleration_sd: float,
        measurement_sd: Sequence[float],
        initial_mean: Sequence[float] = (160e3, 160e3, 0.0, 0.0),
        initial_sd: Sequence[float] = (60e3, 60e3, 30.0, 30.0),
    ) -> None:
        super().__init__()
        lengths = {
            "measurement_sd": (measurement_sd, 5),
            "initial_mean": (initial_mean, 4),
            "initial_sd": (initial_sd, 4),
        }
        for name, (values, length) in lengths.items():
            require(len(values) == length, f"model.{name}", f"be {length} numbers", list(values))
        require_range("model.acceleration_sd", acceleration_sd, "[0, inf) Give m/s^2.")
        t = check_positive("model.interval", interval)
        eye = torch.eye(2, dtype=torch.float64)
        self.register_buffer("phi", torch.kron(as_float64([[1.0, t], [0.0, 1.0]]), eye))
        step = as_float64([[0.5 * t * t], [t]])
        self.register_buffer("gain", acceleration_sd * torch.kron(step, eye))
        self.register_buffer("r", check_positive("model.measurement_sd", list(measurement_sd)))
        self.register_buffer("m0", as_float64(list(initial_mean)))
        self.register_buffer("p0", check_positive("model.initial_sd", list(initial_sd)))
        self.names, self.units = ("x", "y", "vx", "vy"), ("m", "m", "m/s", "m/s")
        self.groups, self.noise_dim = {"position": (0, 1), "velocity": (2, 3)}, 2

    @property
    @override
    def origin(self) -> Tensor:
        return self.m0

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    @override
    def propagate(self, x: Tensor, u: PlatformInputs, w: Tensor) -> Tensor:
        return x @ self.phi.mT + w @ self.gain.mT

    def propagation_jacobian(self, x: Tensor, u: PlatformInputs) -> Tensor:
        """Return the transition matrix, [1, 1, 4, 4].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return self.phi[None, None]

    @override
    def noise_gain(self, u: PlatformInputs) -> Tensor:
        return self.gain.unsqueeze(0)

    @override
    def observation(self, x: Tensor, u: PlatformInputs) -> Distribution:
        return independent_normal(
            predict_bearing(*relative_motion(x, u), u.carrier.unsqueeze(-1)), self.r
        )

    @override
    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        r = y - y_hat
        return torch.cat([wrap_angle(r[..., :1]), r[..., 1:]], -1)


def relative_motion(x: Tensor, u: PlatformInputs) -> tuple[Tensor, Tensor]:
    """Compute relative position and velocity of emitters in body axes.

    [Pu and Qin, eq. 1]

    Returns position and velocity, [R, N, 3] each. Shapes: x [R, N, 4].
    """
    up = x.new_zeros(*x.shape[:-1], 1)
    position = torch.cat([x[..., :2], up], -1) - u.position.unsqueeze(-2)
    velocity = torch.cat([x[..., 2:], up], -1) - u.velocity.unsqueeze(-2)
    return position @ u.attitude.mT, velocity @ u.attitude.mT


def predict_bearing(p: Tensor, v: Tensor, carrier: Tensor, a: Tensor | None = None) -> Tensor:
    """Predict noise-free bearing, elevation, their rates, Doppler rate, [..., 5].

    The rates are derived independently, because the print is damaged
    [Pu and Qin, eqs 4-7, eq. 10, and eq. 9 with an acceleration].

    Shapes: p [..., 3], v [..., 3], carrier [...], a [..., 3].
    """
    x, y, z = p.unbind(-1)
    vx, vy, vz = v.unbind(-1)
    level2 = x * x + y * y
    level, r2 = torch.sqrt(level2), level2 + z * z
    r = torch.sqrt(r2)
    bearing1 = (vx * y - x * vy) / level2
    elevation1 = (vz * level2 - z * (x * vx + y * vy)) / (r2 * level)
    range2 = (
        bearing1 * bearing1 * level2 + elevation1 * elevation1 * r2
    ) / r  # without acceleration
    if a is not None:
        range2 = range2 + (a * p).sum(-1) / r
    doppler1 = -carrier / SPEED_OF_LIGHT * range2
    angles = [torch.atan2(x, y), torch.atan2(z, level)]
    return torch.stack([*angles, bearing1, elevation1, doppler1], -1)


def compute_level_attitude(velocity: Tensor) -> Tensor:
    """Compute ground-to-body matrices [..., 3, 3] of level flight along velocities.

    Body axes are starboard, forward, up. [ours]
    """
    direction = velocity[..., :2] / velocity[..., :2].norm(dim=-1, keepdim=True)
    east, north = direction.unbind(-1)
    zeros, ones = torch.zeros_like(east), torch.ones_like(east)
    rows = ((north, -east, zeros), (east, north, zeros), (zeros, zeros, ones))
    return torch.stack([torch.stack(row, -1) for row in rows], -2)
