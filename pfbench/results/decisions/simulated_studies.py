"""Simulated studies with known effects, to measure how often each word of a decision is wrong.

A paired difference is the sum of an effect, a world, a regime within the world, and a run. Runs
share draws over the regimes of a world and over worlds. The default spreads are the middle of those
measured on stored studies.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Literal, NamedTuple

import numpy as np
from scipy.special import ndtri

from pfbench.results.decisions.pair_effects import PairEffects, location_effects, share_effects
from pfbench.results.error_measures import Array, Flags
from pfbench.results.statistics.paired_effects import order_failed_runs, trimmed_effects

NoiseName = Literal["normal", "t3", "exponential"]
_DIFFICULTY = 0.6  # share of the variance of difficulty that both filters have in common


class SimulatedPairs(NamedTuple):
    """Simulated studies of one pair.

    Attributes:
        d: Log ratios, [S, W, R, N].
        keeps_a: Runs in which the first filter keeps track, [S, W, R, N].
        keeps_b: Runs in which the second filter keeps track, [S, W, R, N].
    """

    d: Array
    keeps_a: Flags
    keeps_b: Flags


@dataclass(frozen=True)
class StudySetting:
    """Size and spreads of simulated studies.

    Attributes:
        worlds: Number of worlds.
        regimes: Number of regimes of each world.
        runs: Number of runs of each condition.
        world_sd: SD of effects over worlds.
        regime_sd: SD of effects over regimes of a world.
        run_sd: SD of a condition over runs.
        regime_correlation: Share of the run variance that the regimes of a world have in common,
            with that of worlds.
        world_correlation: Share of the run variance that all worlds have in common.
        noise: Distribution of the runs.
        lost_a: Share of runs in which the first filter does not keep track.
        lost_b: Share of runs in which the second filter does not keep track.
    """

    worlds: int = 3
    regimes: int = 4
    runs: int = 30
    world_sd: float = 0.25
    regime_sd: float = 0.2
    run_sd: float = 0.4
    regime_correlation: float = 0.34
    world_correlation: float = 0.15
    noise: NoiseName = "t3"
    lost_a: float = 0.0
    lost_b: float = 0.0

    @property
    def weights(self) -> Array:
        """Weights of the conditions, [W, R]."""
        return np.full((self.worlds, self.regimes), 1 / self.regimes)

    def draw(
        self,
        rng: np.random.Generator,
        studies: int,
        effect: float = 0.0,
        fixed_worlds: bool = False,
    ) -> SimulatedPairs:
        """Draw studies.

        Args:
            rng: Generator.
            studies: Number of studies S.
            effect: Mean log ratio: over the worlds of each study if they are fixed, else over all
                possible worlds.
            fixed_worlds: Whether the effects of the worlds of each study average to `effect`
                exactly, as question (a) requires.

        Returns:
            Studies.
        """
        shape = (studies, self.worlds, self.regimes, self.runs)
        worlds = self.world_sd * rng.standard_normal((studies, self.worlds, 1, 1))
        worlds = worlds + self.regime_sd * rng.standard_normal((*shape[:3], 1))
        if fixed_worlds:
            worlds = worlds - worlds.mean(axis=(1, 2), keepdims=True)
        parts = (self.world_correlation, self.regime_correlation, 1.0)
        shares = np.diff([0.0, *parts])
        shapes = ((studies, 1, 1, self.runs), (studies, self.worlds, 1, self.runs), shape)
        runs = sum(
            np.sqrt(share) * draw_run_noise(rng, self.noise, size)
            for share, size in zip(shares, shapes, strict=True)
        )
        centre = _noise_centre(self.noise, tuple(map(float, shares)))
        d = effect + worlds + self.run_sd * (runs - centre)
        common = self._difficulty(rng, studies)
        keeps = [
            np.sqrt(_DIFFICULTY) * common + np.sqrt(1 - _DIFFICULTY) * self._difficulty(rng, studies)
            <= -ndtri(lost) if lost > 0 else np.ones(shape, dtype=bool)
            for lost in (self.lost_a, self.lost_b)
        ]  # fmt: skip
        return SimulatedPairs(d, keeps[0], keeps[1])

    def _difficulty(self, rng: np.random.Generator, studies: int) -> Array:
        """Draw standard normal difficulties of runs with shared draws over regimes and worlds."""
        shape = (studies, self.worlds, self.regimes, self.runs)
        shares = np.diff([0.0, self.world_correlation, self.regime_correlation, 1.0])
        shapes = ((studies, 1, 1, self.runs), (studies, self.worlds, 1, self.runs), shape)
        parts = [
            np.sqrt(share) * rng.standard_normal(size)
            for share, size in zip(shares, shapes, strict=True)
        ]
        return np.asarray(parts[0] + parts[1] + parts[2])


def draw_run_noise(rng: np.random.Generator, noise: NoiseName, size: tuple[int, ...]) -> Array:
    """Draw noise of unit variance.

    Args:
        rng: Generator.
        noise: Name of the distribution.
        size: Shape.
    """
    if noise == "t3":
        return rng.standard_t(3, size) / np.sqrt(3.0)
    return rng.standard_normal(size) if noise == "normal" else rng.standard_exponential(size) - 1.0


def assess_pairs(
    pairs: SimulatedPairs, weights: Array, shared_runs: bool = True
) -> tuple[PairEffects, PairEffects]:
    """Estimate track and error of simulated studies by the functions of a report.

    Args:
        pairs: Simulated studies.
        weights: Weights of the conditions, [W, R].
        shared_runs: Whether runs share draws over worlds.

    Returns:
        Effects of track and of error.
    """
    d = order_failed_runs(pairs.d, pairs.keeps_a, pairs.keeps_b)
    track = share_effects(pairs.keeps_b.astype(float) - pairs.keeps_a, weights, shared_runs)
    return track, location_effects(d, weights, shared_runs=shared_runs)


@cache
def _noise_centre(noise: NoiseName, shares: tuple[float, ...]) -> float:
    """Compute the trimmed mean of skewed noise, so that the effect is exact."""
    if noise != "exponential":
        return 0.0
    rng = np.random.default_rng(0)
    sample = sum(np.sqrt(share) * draw_run_noise(rng, noise, (2_000_000,)) for share in shares)
    return float(trimmed_effects(np.asarray(sample)).location)
