"""Interface of scenarios: generators of episodes."""

from __future__ import annotations

import math
from typing import Protocol

from torch import Tensor

from pfbench.core.record import Episode
from pfbench.noise.base import NoiseRegime


class Scenario(Protocol):
    """Generator of episodes, independent of the filters."""

    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        """Draw the episode of some runs.

        Args:
            noise: Noise regime.
            runs: Run numbers, int64, [R].
            seed: Seed. With the run number it fixes all random numbers of a run.

        Returns:
            Episode with R runs.
        """


def check_divergence_threshold(threshold: float | None) -> None:
    """Check the position error beyond which a run counts as diverged.

    Args:
        threshold: Position error, m. None if the scenario does not define divergence.

    Raises:
        ValueError: If the threshold is not finite and positive.
    """
    if threshold is not None and not (math.isfinite(threshold) and threshold > 0.0):
        raise ValueError(
            f"scenario.divergence_threshold_m must be finite and positive, got {threshold}. "
            "Use null for a scenario without this limit."
        )


def check_duration(name: str, value: float) -> None:
    """Check that a time is positive.

    Args:
        name: Configuration key.
        value: Time, s.

    Raises:
        ValueError: If the time is not positive.
    """
    if not value > 0.0:
        raise ValueError(f"{name} must be positive, got {value}. Set a time in seconds.")


def check_added_sd(name: str, sd: float) -> None:
    """Check the standard deviation of errors that are added to recorded measurements.

    Args:
        name: Configuration key.
        sd: Standard deviation.

    Raises:
        ValueError: If the standard deviation is negative.
    """
    if not sd >= 0.0:
        raise ValueError(f"{name} must be at least 0, got {sd}. Use 0 for no added errors.")
