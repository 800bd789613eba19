"""Earth of a strapdown model in the plane that touches it at the start: flat and at rest, or round and rotating."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core import chart as quaternion
from pfbench.core.parameter_checks import require_ranges
from pfbench.model.strapdown import StrapdownTotal
from pfbench.nav import earth
from pfbench.nav.strapdown import PreintegratedImu, rotate


class EarthForm(Protocol):
    """Form of the Earth's rate and gravity.

    Attributes:
        choice: What a report must mention.
    """

    choice: str

    @property
    def site(self) -> Tensor:
        """Numbers of the start that the functions take, a buffer of the model, [k]."""

    def correct(self, x: Tensor, end: Tensor, u: PreintegratedImu, site: Tensor) -> Tensor:
        """Correct the end of a step on a flat Earth.

        Args:
            x: States at the start of the step, [R, N, 16 or more].
            end: States of the motion at its end, [R, N, 16].
            u: Inputs of the step.
            site: Numbers of `site`.

        Returns:
            States of the motion, [R, N, 16].
        """

    def sense(self, to_body: Tensor, site: Tensor) -> Tensor | float:
        """Compute the rate that a gyro at rest measures besides its bias.

        Args:
            to_body: Quaternions from level to body axes, [R, N, 4].
            site: Numbers of `site`.

        Returns:
            Rate, right, forward, up, rad/s, [R, N, 3]; 0 for none.
        """


@dataclass(frozen=True)
class FlatEarth(EarthForm):
    """A flat Earth at rest with the gravity of the scenario. The gyro bias absorbs the Earth's rate."""

    choice = StrapdownTotal.choices[0]

    @property
    @override
    def site(self) -> Tensor:
        return torch.zeros(0, dtype=torch.float64)

    @override
    def correct(self, x: Tensor, end: Tensor, u: PreintegratedImu, site: Tensor) -> Tensor:
        return end

    @override
    def sense(self, to_body: Tensor, site: Tensor) -> float:
        return 0.0


@dataclass(frozen=True)
class RotatingEarth(EarthForm):
    """The WGS-84 Earth: its rate, Coriolis acceleration, and normal gravity with height and direction.

    Attitude, velocity and position are those in East, North, Up of the start, which are fixed to the Earth.
    Transport rate belongs to level axes that move with the vehicle. Here the direction of gravity, normal to the
    ellipsoid at the vehicle, takes its place.

    Attributes:
        latitude_deg: Latitude of the start, deg.
        height_m: Height of the start above the ellipsoid, m.

    Raises:
        ValueError: If the latitude is not one.
    """

    latitude_deg: float
    height_m: float = 0.0

    choice = "rotating WGS-84 Earth with normal gravity by position, second order in the length of a step"

    def __post_init__(self) -> None:
        require_ranges("model.earth", self, latitude_deg="[-90, 90]", height_m="(-inf, inf)")

    @property
    @override
    def site(self) -> Tensor:
        # latitude, rad, height, m, and the Earth's rate in East, North, Up, rad/s
        first = torch.tensor([math.radians(self.latitude_deg), self.height_m], dtype=torch.float64)
        return torch.cat([first, earth.earth_rate(first[0])])

    @override
    def correct(self, x: Tensor, end: Tensor, u: PreintegratedImu, site: Tensor) -> Tensor:
        span, rate = u.duration[:, None, None], site[2:].expand(*x.shape[:-1], 3)
        down = torch.nn.functional.pad(u.gravity[:, None, None], (2, 0))
        impulse = rotate(x[..., :4], u.velocity_increment.unsqueeze(1))
        velocity = x[..., 4:7] + 0.5 * (impulse - down * span)
        position = x[..., 7:10] + 0.5 * span * x[..., 4:7]
        coriolis = torch.linalg.cross(rate, 2.0 * velocity * span + 0.5 * impulse * span)
        added = (_compute_gravity(position, site) + down) * span - coriolis
        turn = quaternion.quaternion_from_rotation_vector(-rate * span)
        q, v, p, biases = end.split([4, 3, 3, 6], -1)
        attitude = quaternion.quaternion_multiply(turn, q)
        return torch.cat([attitude, v + added, p + 0.5 * span * added, biases], -1)

    @override
    def sense(self, to_body: Tensor, site: Tensor) -> Tensor:
        return rotate(to_body, site[2:])


def _compute_gravity(position: Tensor, site: Tensor) -> Tensor:
    """Compute normal gravity in the axes of the start, m/s^2, [..., 3], of positions [..., 3], to 1e-3 of their tilt."""
    r_m, r_n = earth.radii(site[0])
    east = position[..., 0] / (r_n + site[1])
    north = position[..., 1] / (r_m + site[1])
    bulge = 0.5 * (position[..., 0] * east + position[..., 1] * north)
    size = earth.gravity(site[0] + north, site[1] + position[..., 2] + bulge)
    normal = torch.stack([east, north, torch.ones_like(east)], -1)
    return -size.unsqueeze(-1) * normal / normal.norm(dim=-1, keepdim=True)
