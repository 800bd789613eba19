"""Synthetic terrain: a random surface of plane waves, with height and slope in closed form."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.core.parameter_checks import check_positive, check_whole_number
from pfbench.core.random_stream import PhiloxStream


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
        for name in ("height_sd", "shortest_m", "longest_m", "hurst_exponent"):
            check_positive(f"scenario.terrain.{name}", getattr(self, name))
        if not self.shortest_m < self.longest_m:
            raise ValueError(
                f"scenario.terrain.longest_m must be above shortest_m = {self.shortest_m}, got "
                f"{self.longest_m}. Increase longest_m."
            )
        check_whole_number("scenario.terrain.waves", self.waves, 8, "Use 48.")

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
