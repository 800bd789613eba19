"""What a scenario is: a law of worlds, from which runs are drawn."""

from __future__ import annotations

from typing import Protocol

from torch import Tensor

from pfbench.noise.regimes import Regime
from pfbench.record import Episode


class Scenario(Protocol):
    """Draws worlds. It never knows which filters will run."""

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """The worlds of these run numbers (int64 [R]); a run's world depends on its number and the seed alone."""
