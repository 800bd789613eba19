"""Airborne passive location: one aircraft hears an emitter on the ground, and its own motion gives the range away."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.chart import wrap
from pfbench.model.base import StateSpaceModel, independent_normal, normal_batch, positive

SPEED_OF_LIGHT = 299792458.0  # m/s


class Platform(NamedTuple):
    """What the aircraft is given of itself and of the signal; leading axes [R or 1, T].

    Attributes:
        position: of its centroid in the ground frame, Z up [..., 3] m.
        velocity: [..., 3] m/s.
        attitude: ground to body [..., 3, 3]; body axes starboard, forward, up.
        carrier: frequency of the emitter [...] Hz.
    """

    position: Tensor
    velocity: Tensor
    attitude: Tensor
    carrier: Tensor


class PassiveLocation(StateSpaceModel):
    """An emitter on the plane Z = 0, its bearing, elevation, their rates and the Doppler rate measured in body axes.

    State [x, y, vx, vy] in the ground frame, driven by white acceleration that is constant over a step, so that the noise has
    rank 2 of 4 and the transition no density [Pu and Qin, "Application of quasi Monte Carlo polymerization re-sampling particle
    filter algorithm in airborne passive location", eqs 1-7, 10]. The body's own rotation is left out of the rates: A is that of
    the moment. [ours]

    Args:
        interval: s.
        acceleration_sd: of each component of the acceleration, m/s^2; 0 for an emitter on a straight line. The paper does not
            give it. [ours]
        measurement_sd: bearing, elevation rad, their rates rad/s, Doppler rate Hz/s [5].
        initial_mean, initial_sd: of the state [4]; for records that bring no start and spread of their own. [ours]

    Raises:
        ValueError: a size that is not positive (not negative, for the acceleration), or not 5 or 4 numbers.
    """

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
        sized = {"measurement_sd": (measurement_sd, 5), "initial_mean": (initial_mean, 4), "initial_sd": (initial_sd, 4)}
        for name, (values, size) in sized.items():
            if len(values) != size:
                raise ValueError(f"model.{name}={list(values)}: give {size} numbers")
        if not 0.0 <= acceleration_sd < float("inf"):
            raise ValueError(f"model.acceleration_sd={acceleration_sd}: give m/s^2, 0 or more")
        t = float(positive("model.interval", interval))
        eye = torch.eye(2, dtype=torch.float64)
        self.register_buffer("phi", torch.kron(torch.tensor([[1.0, t], [0.0, 1.0]], dtype=torch.float64), eye))
        step = torch.tensor([[0.5 * t * t], [t]], dtype=torch.float64)
        self.register_buffer("gain", acceleration_sd * torch.kron(step, eye))
        self.register_buffer("r", positive("model.measurement_sd", list(measurement_sd)))
        self.register_buffer("m0", torch.tensor(list(initial_mean), dtype=torch.float64))
        self.register_buffer("p0", positive("model.initial_sd", list(initial_sd)))
        self.names, self.units = ("x", "y", "vx", "vy"), ("m", "m", "m/s", "m/s")
        self.groups, self.noise_dim = {"position": (0, 1), "velocity": (2, 3)}, 2

    @property
    def origin(self) -> Tensor:
        return self.m0

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Platform, w: Tensor) -> Tensor:
        return x @ self.phi.mT + w @ self.gain.mT

    def noise_gain(self, u: Platform) -> Tensor:
        return self.gain.unsqueeze(0)

    def observation(self, x: Tensor, u: Platform) -> Distribution:
        return independent_normal(look(*relative(x, u), u.carrier.unsqueeze(-1)), self.r)

    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        """The bearing the short way round; an elevation lies within a right angle and cannot wrap."""
        r = y - y_hat
        return torch.cat([wrap(r[..., :1]), r[..., 1:]], -1)


def relative(x: Tensor, u: Platform) -> tuple[Tensor, Tensor]:
    """Position and velocity of emitters x [R, N, 4] relative to the aircraft, in body axes [R, N, 3] [Pu and Qin, eq. 1]."""
    up = x.new_zeros(*x.shape[:-1], 1)
    place = torch.cat([x[..., :2], up], -1) - u.position.unsqueeze(-2)
    motion = torch.cat([x[..., 2:], up], -1) - u.velocity.unsqueeze(-2)
    return place @ u.attitude.mT, motion @ u.attitude.mT


def look(p: Tensor, v: Tensor, carrier: Tensor, a: Tensor | None = None) -> Tensor:
    """What is measured without noise: bearing, elevation, their rates, Doppler rate [..., 5].

    The rates are derived anew where the print is damaged [Pu and Qin, eqs 4-7; eq. 10, and eq. 9 with an acceleration].

    Args:
        p, v: position and velocity of the emitter relative to the aircraft, in body axes [..., 3].
        carrier: Hz [...].
        a: relative acceleration in body axes [..., 3]; None leaves it out.
    """
    x, y, z = p.unbind(-1)
    vx, vy, vz = v.unbind(-1)
    level2 = x * x + y * y
    level, r2 = torch.sqrt(level2), level2 + z * z
    r = torch.sqrt(r2)
    turning = (vx * y - x * vy) / level2
    rising = (vz * level2 - z * (x * vx + y * vy)) / (r2 * level)
    stretch = (turning * turning * level2 + rising * rising * r2) / r  # r'' but for the acceleration
    if a is not None:
        stretch = stretch + (a * p).sum(-1) / r
    return torch.stack([torch.atan2(x, y), torch.atan2(z, level), turning, rising, -carrier / SPEED_OF_LIGHT * stretch], -1)


def level_attitude(velocity: Tensor) -> Tensor:
    """Ground to body axes (starboard, forward, up) in level flight along a velocity [..., 3] -> [..., 3, 3]. [ours]"""
    ahead = velocity[..., :2] / velocity[..., :2].norm(dim=-1, keepdim=True)
    east, north = ahead.unbind(-1)
    zero, one = torch.zeros_like(east), torch.ones_like(east)
    rows = [torch.stack(row, -1) for row in ((north, -east, zero), (east, north, zero), (zero, zero, one))]
    return torch.stack(rows, -2)
