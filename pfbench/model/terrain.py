"""Terrain-referenced navigation: the horizontal position error of an INS, observed by the terrain's height."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.parameter_checks import check_positive, require_ranges
from pfbench.core.random_stream import PhiloxStream
from pfbench.model.base import StateSpaceModel


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


# --------------------------------------------------------------------------------------------------
# Synthetic terrain: a random surface of plane waves, with height and slope in closed form.


class TerrainWaves(NamedTuple):
    """Plane waves whose sum is the height of a terrain.

    Attributes:
        wave_vector: East and North, [K, 2], rad/m.
        amplitude: [K], m.
        phase: [K], rad.
    """

    wave_vector: Tensor
    amplitude: Tensor
    phase: Tensor


@dataclass(frozen=True)
class RandomTerrain:
    """Self-affine random terrain: K sine waves of random directions and phases.

    Wavelengths are spaced evenly on a logarithmic scale. The variance of a wave is proportional to
    wavelength^(2 H), the variance per octave of a surface with Hurst exponent H [Saupe 1988]. A
    small H is a rough surface. The sum is close to a normal random field between the limits of
    the wavelengths, the same in all directions and places.

    Attributes:
        height_sd: Standard deviation of the height, m.
        shortest_m: Shortest wavelength, m.
        longest_m: Longest wavelength, m.
        hurst_exponent: Exponent H.
        waves: Number of waves K.
        seed: Seed of directions and phases.

    Raises:
        ValueError: If a length is not positive, the wavelengths are not in order, or there are
            fewer than 8 waves.

    References:
        D. Saupe 1988, "Algorithms for random fractals", in The Science of Fractal Images.
    """

    height_sd: float = 60.0
    shortest_m: float = 500.0
    longest_m: float = 8000.0
    hurst_exponent: float = 0.8
    waves: int = 48
    seed: int = 1

    def __post_init__(self) -> None:
        longest = f"({self.shortest_m}, inf) Increase longest_m, above shortest_m."
        require_ranges(
            "scenario.terrain",
            self,
            height_sd="(0, inf)",
            shortest_m="(0, inf)",
            longest_m=longest,
            hurst_exponent="(0, inf)",
            waves="whole [8, inf) Use 48.",
        )

    def draw_waves(self) -> TerrainWaves:
        """Draw the waves of the terrain."""
        draws = PhiloxStream(self.seed, torch.zeros(1, dtype=torch.int64))
        angle, phase = (2.0 * math.pi * draws.uniform("terrain", self.waves, 2))[0].unbind(-1)
        share = (torch.arange(self.waves, dtype=torch.float64) + 0.5) / self.waves
        wavelength = self.longest_m * (self.shortest_m / self.longest_m) ** share
        number = 2.0 * math.pi / wavelength
        vector = torch.stack([number * torch.sin(angle), number * torch.cos(angle)], -1)
        size = wavelength**self.hurst_exponent
        amplitude = self.height_sd * math.sqrt(2.0) * size / size.norm()
        return TerrainWaves(vector, amplitude, phase)


def compute_elevation(position: Tensor, waves: TerrainWaves) -> Tensor:
    """Compute the height of a terrain.

    Args:
        position: East and North, [..., 2], m.
        waves: Waves of the terrain.

    Returns:
        Heights, [...], m.
    """
    return torch.sin(position @ waves.wave_vector.mT + waves.phase) @ waves.amplitude


def compute_slope(position: Tensor, waves: TerrainWaves) -> Tensor:
    """Compute the gradient of the height of a terrain.

    Args:
        position: East and North, [..., 2], m.
        waves: Waves of the terrain.

    Returns:
        Slopes towards East and North, [..., 2].
    """
    slopes = waves.amplitude.unsqueeze(-1) * waves.wave_vector
    return torch.cos(position @ waves.wave_vector.mT + waves.phase) @ slopes
