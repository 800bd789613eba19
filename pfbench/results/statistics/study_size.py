"""Runs and worlds that a study requires, and differences that a planned study can show.

References:
    J. L. Hodges and E. L. Lehmann (1956), The efficiency of some nonparametric competitors of the t-test.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import nctdtr, ndtr, stdtrit

from pfbench.results.statistics.paired_effects import MIN_RUNS, TRIM_SHARE
from pfbench.results.statistics.power import POWER

_HALVINGS = 60
_MOST = 100_000


@dataclass(frozen=True)
class TypicalSpread:
    """Typical standard deviations of paired differences, measured on stored studies.

    Attributes:
        run_sd: SD over runs of the log ratio of a world: standard error times root of the runs.
        world_sd: SD over worlds of the log ratio.
        world_correlation: Correlation of two worlds over runs.
        track_run_sd: SD over runs of the difference of the shares that keep track.
        track_world_sd: SD over worlds of the same difference.
    """

    run_sd: float = 0.4
    world_sd: float = 0.25
    world_correlation: float = 0.15
    track_run_sd: float = 0.3
    track_world_sd: float = 0.05


class DetectableEffects(NamedTuple):
    """Least effects that a study shows with a given power; infinite if it cannot show any.

    Attributes:
        error_same_worlds: Log ratio of errors in the worlds of the study.
        error_new: Log ratio of errors in a new world.
        track_same_worlds: Difference of shares that keep track in the worlds of the study.
        track_new: Difference of shares in a new world.
    """

    error_same_worlds: float
    error_new: float
    track_same_worlds: float
    track_new: float


def t_test_power(score: float, df: float, alpha: float) -> float:
    """Compute the power of the two-sided t test.

    Args:
        score: Effect divided by the standard error.
        df: Degrees of freedom.
        alpha: Level.

    Returns:
        Power, 0 to 1.
    """
    if df <= 0:
        return 0.0
    limit = float(-stdtrit(df, alpha / 2))
    tails = 1 - nctdtr(df, abs(score), limit) + nctdtr(df, abs(score), -limit)
    return float(tails) if np.isfinite(tails) else float(ndtr(abs(score) - limit))


def detectable_score(df: float, alpha: float, power: float = POWER) -> float:
    """Compute the effect in standard errors that the two-sided t test shows with a given power.

    Args:
        df: Degrees of freedom.
        alpha: Level.
        power: Power required.

    Returns:
        Score, infinite without degrees of freedom.
    """
    if df <= 0:
        return math.inf
    limit = float(-stdtrit(df, alpha / 2))
    low, high = 0.0, 6 * limit + 20
    for _ in range(_HALVINGS):  # scipy.optimize takes a tenth of a second to import
        middle = (low + high) / 2
        low, high = (middle, high) if t_test_power(middle, df, alpha) < power else (low, middle)
    return high


def required_worlds(
    effect: float, comparisons: int = 1, alpha: float = 0.05, power: float = POWER
) -> float:
    """Compute the worlds required to show an effect in a new world.

    Args:
        effect: Mean effect in standard deviations over worlds.
        comparisons: Size of the family. Each comparison is tested at alpha / comparisons.
        alpha: Error of the family.
        power: Power required.

    Returns:
        Number of worlds, infinite for no effect.
    """
    level = alpha / comparisons
    return _least(lambda w: t_test_power(effect * math.sqrt(w), w - 1, level) >= power, 2, effect)


def required_runs_per_condition(
    effect: float, comparisons: int = 1, alpha: float = 0.05, power: float = POWER
) -> float:
    """Compute the runs required to show an effect in the worlds of a study.

    Args:
        effect: Effect in standard deviations over runs of the mean over worlds.
        comparisons: Size of the family.
        alpha: Error of the family.
        power: Power required.

    Returns:
        Number of runs per condition, at least 10, infinite for no effect.
    """
    level = alpha / comparisons
    return _least(
        lambda n: t_test_power(effect * math.sqrt(n), middle_runs(n) - 1, level) >= power,
        MIN_RUNS,
        effect,
    )


def middle_runs(runs: int) -> int:
    """Return the number of runs that remain after trimming."""
    return runs - 2 * math.floor(TRIM_SHARE * runs + 1e-9)


def detectable_effects(
    runs: int,
    worlds: int,
    pairs: int,
    spread: TypicalSpread | None = None,
    alpha: float = 0.05,
    power: float = POWER,
) -> DetectableEffects:
    """Compute the least effects that a planned study shows, before it runs.

    Args:
        runs: Runs per condition.
        worlds: Number of worlds.
        pairs: Number of planned pairs. Track and error of each pair are one family.
        spread: Typical standard deviations, None for those of stored studies.
        alpha: Error of the family.
        power: Power required of each comparison.

    Returns:
        Effects of the questions (a) and (b).

    Raises:
        ValueError: if a number is not positive.
    """
    if min(runs, worlds, pairs) < 1:
        raise ValueError(
            f"runs, worlds and pairs must be positive, got {runs}, {worlds} and {pairs}. Use 1 or more."
        )
    spread = spread or TypicalSpread()
    level, rho = alpha / (2 * pairs), spread.world_correlation
    same_worlds = detectable_score(middle_runs(runs) - 1 if runs >= MIN_RUNS else 0, level, power)
    new = detectable_score(worlds - 1, level, power)
    effects = []
    for run_sd, world_sd in (
        (spread.run_sd, spread.world_sd),
        (spread.track_run_sd, spread.track_world_sd),
    ):
        over_runs = run_sd * math.sqrt((1 + (worlds - 1) * rho) / (worlds * runs))
        effects += [
            same_worlds * over_runs,
            new * math.hypot(over_runs, world_sd / math.sqrt(worlds)),
        ]
    return DetectableEffects(*effects)


def _least(is_enough: Callable[[int], bool], start: int, effect: float) -> float:
    """Return the least number from a start that is enough, by doubling and bisection."""
    if not effect or not math.isfinite(effect):
        return math.inf if not effect else float(start)
    high = start
    while not is_enough(high):
        if high > _MOST:
            return math.inf
        high *= 2
    low = max(start, high // 2)
    while low < high:
        middle = (low + high) // 2
        low, high = (low, middle) if is_enough(middle) else (middle + 1, high)
    return float(low)
