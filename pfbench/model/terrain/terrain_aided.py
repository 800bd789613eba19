"""Terrain-referenced navigation: the horizontal position error of an INS, observed by the terrain's height."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.normal import independent_normal, normal_batch
from pfbench.core.parameter_checks import check_positive
from pfbench.model.base import StateSpaceModel
from pfbench.model.terrain.random_terrain import (
    RandomTerrain,
    TerrainWaves,
    compute_elevation,
    compute_slope,
)


class TerrainInputs(NamedTuple):
    """Inputs of `TerrainAided`.

    Attributes:
        position: Position of the INS on the map, East and North, [R or 1, T, 2], m.
    """

    position: Tensor


class TerrainAided(StateSpaceModel):
    """Position error of an INS as a random walk, observed by the height of the terrain below.

    x' = x + drift sqrt(interval) w and y = h(p - x) + v, with the position p of the INS and the
    height h of the map. The measurement is the height above sea level minus the height above the
    ground [Bergman, Ljung, Gustafsson 1999]. The likelihood of a measurement is a set of contour
    lines. The posterior therefore has several modes while the uncertainty exceeds a hill.

    Args:
        terrain: Terrain of the map.
        interval: Time between measurements, s.
        drift: Random walk of the position error per axis, m/sqrt(s).
        measurement_sd: Standard deviation of the measured height of the terrain, m.
        initial_sd: Standard deviation of the initial position error per axis, m.

    Raises:
        ValueError: If a value is not positive.

    References:
        N. Bergman, L. Ljung, F. Gustafsson 1999, "Terrain navigation using Bayesian statistics",
            IEEE Control Systems Magazine.
    """

    channel_names = ("height of the terrain below [m]",)
    input_type = TerrainInputs
    wave_vector: Tensor
    amplitude: Tensor
    phase: Tensor
    step_sd: Tensor
    r: Tensor
    p0: Tensor

    def __init__(
        self,
        terrain: RandomTerrain,
        interval: float,
        drift: float,
        measurement_sd: float,
        initial_sd: float,
    ) -> None:
        super().__init__()
        for name, values in terrain.draw_waves()._asdict().items():
            self.register_buffer(name, values)
        step = check_positive("model.interval", interval).sqrt()
        sizes = {"drift": drift, "initial_sd": initial_sd}
        walk, start = (check_positive(f"model.{key}", [v, v]) for key, v in sizes.items())
        self.register_buffer("step_sd", step * walk)
        self.register_buffer("p0", start)
        self.register_buffer("r", check_positive("model.measurement_sd", [measurement_sd]))
        self.names, self.units = ("east", "north"), ("m", "m")
        self.groups, self.noise_dim = {"position": (0, 1)}, 2

    @property
    def waves(self) -> TerrainWaves:
        """Waves of the terrain, of the dtype and device of the model."""
        return TerrainWaves(self.wave_vector, self.amplitude, self.phase)

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    @override
    def propagate(self, x: Tensor, u: TerrainInputs, w: Tensor) -> Tensor:
        return x + self.step_sd * w

    def propagation_jacobian(self, x: Tensor, u: TerrainInputs) -> Tensor:
        """Return the identity, [1, 1, 2, 2].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return torch.eye(2, dtype=x.dtype, device=x.device)[None, None]

    @override
    def noise_gain(self, u: TerrainInputs) -> Tensor:
        return torch.diag(self.step_sd).unsqueeze(0)

    @override
    def transition(self, x: Tensor, u: TerrainInputs) -> Distribution:
        return independent_normal(x, self.step_sd)

    @override
    def observation(self, x: Tensor, u: TerrainInputs) -> Distribution:
        height = compute_elevation(u.position.unsqueeze(-2) - x, self.waves)
        return independent_normal(height.unsqueeze(-1), self.r)

    def observation_jacobian(self, x: Tensor, u: TerrainInputs) -> Tensor:
        """Return the negative slope at the corrected position, [R, N, 1, 2].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return -compute_slope(u.position.unsqueeze(-2) - x, self.waves).unsqueeze(-2)
