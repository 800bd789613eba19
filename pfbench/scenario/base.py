"""Interface of scenarios: generators of episodes."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from pfbench.core.record import Episode
from pfbench.noise.base import NoiseRegime


class Scenario(Protocol):
    """Generator of episodes, independent of the filters.

    It may state what it provides, which is then compared with the model (`pfbench.core.channels`):
    `channel_names`, the quantity, frame and unit of each component of y, and `input_type`, the NamedTuple
    of the inputs u.
    """

    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        """Draw the episode of some runs.

        Args:
            noise: Noise regime.
            runs: Run numbers, int64, [R].
            seed: Seed. With the run number it fixes all random numbers of a run.

        Returns:
            Episode with R runs.
        """


def check_duration(name: str, value: float) -> None:
    """Check that a time is positive."""
    if not value > 0.0:
        raise ValueError(f"{name} must be positive, got {value}. Set a time in seconds.")


def check_added_sd(name: str, sd: float) -> None:
    """Check the standard deviation of errors that are added to recorded measurements."""
    if not sd >= 0.0:
        raise ValueError(f"{name} must be at least 0, got {sd}. Use 0 for no added errors.")
