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

from pfbench.stats.decision import Estimate
from pfbench.stats.effects import log_levels, order_failed_runs, subtract_levels, trimmed_effects
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.pair_effects import PairEffects, location_effects, share_effects

NoiseName = Literal["normal", "t3", "exponential"]
_DIFFICULTY = 0.6  # share of the variance of difficulty that both filters have in common


class SimulatedPairs(NamedTuple):
    """Simulated studies of one pair.

    Attributes:
        d: Log ratios, [S, W, R, N].
        mean: Mean log errors of both filters, [S, W, R, N]: the difficulty of a run.
        keeps_a: Runs in which the first filter keeps track, [S, W, R, N].
        keeps_b: Runs in which the second filter keeps track, [S, W, R, N].
    """

    d: Array
    mean: Array
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
        run_sd: SD of the log ratio of a condition over runs.
        mean_sd: SD over runs of the mean log error of both filters. The median of its ratio to
            `run_sd` is 0.99 over pairs of filters in the conditions of all_seven.
        regime_correlation: Share of the run variance that the regimes of a world have in common,
            with that of worlds.
        world_correlation: Share of the run variance that all worlds have in common.
        noise: Distribution of the runs.
        lost_a: Share of runs in which the first filter does not keep track.
        lost_b: Share of runs in which the second filter does not keep track.
        estimate: Estimate whose expectation is the effect; skewed noise has another one for each.
    """

    worlds: int = 3
    regimes: int = 4
    runs: int = 30
    world_sd: float = 0.25
    regime_sd: float = 0.2
    run_sd: float = 0.4
    mean_sd: float = 0.4
    regime_correlation: float = 0.34
    world_correlation: float = 0.15
    noise: NoiseName = "t3"
    lost_a: float = 0.0
    lost_b: float = 0.0
    estimate: Estimate = "levels"

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
        """Draw studies."""
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
        ratio = self.mean_sd / self.run_sd if self.estimate == "levels" else None
        centre = _noise_centre(self.noise, tuple(map(float, shares)), ratio)
        d = effect + worlds + self.run_sd * (runs - centre)
        common = self._difficulty(rng, studies)
        keeps = [
            np.sqrt(_DIFFICULTY) * common + np.sqrt(1 - _DIFFICULTY) * self._difficulty(rng, studies)
            <= -ndtri(lost) if lost > 0 else np.ones(shape, dtype=bool)
            for lost in (self.lost_a, self.lost_b)
        ]  # fmt: skip
        mean = self.mean_sd * rng.standard_normal(shape)
        return SimulatedPairs(d, mean, keeps[0], keeps[1])

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
    """Draw noise of unit variance."""
    if noise == "t3":
        return rng.standard_t(3, size) / np.sqrt(3.0)
    return rng.standard_normal(size) if noise == "normal" else rng.standard_exponential(size) - 1.0


def assess_pairs(
    pairs: SimulatedPairs, weights: Array, shared_runs: bool = True, estimate: Estimate = "levels"
) -> tuple[PairEffects, PairEffects]:
    """Estimate track and error of simulated studies by the functions of a report.

    Returns effects of track and of error. Shapes: weights [W, R].
    """
    d = order_failed_runs(pairs.d, pairs.keeps_a, pairs.keeps_b)
    track = share_effects(pairs.keeps_b.astype(float) - pairs.keeps_a, weights, shared_runs)
    levels = None
    if estimate == "levels":
        present = np.ones(d.shape, dtype=bool)
        first, second = np.exp(pairs.mean + pairs.d / 2), np.exp(pairs.mean - pairs.d / 2)
        levels = subtract_levels(
            log_levels(first, pairs.keeps_a, present), log_levels(second, pairs.keeps_b, present)
        )
    return track, location_effects(d, weights, shared_runs=shared_runs, conditions=levels)


@cache
def _noise_centre(noise: NoiseName, shares: tuple[float, ...], ratio: float | None) -> float:
    """Compute the location of skewed noise, so that the effect is exact."""
    if noise != "exponential":
        return 0.0
    rng = np.random.default_rng(0)
    sample = np.asarray(
        sum(np.sqrt(share) * draw_run_noise(rng, noise, (2_000_000,)) for share in shares)
    )
    if ratio is None:
        return float(trimmed_effects(sample).location)
    mean = ratio * rng.standard_normal(sample.shape)
    ends = [trimmed_effects(mean + sign * sample / 2).location for sign in (1, -1)]
    return float(ends[0] - ends[1])
