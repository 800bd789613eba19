"""Runs and worlds that a study requires, and differences that a planned study can show."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy  # scipy.special is imported at its first use, which takes a tenth of the start of a job

from pfbench.stats.comparison import MIN_RUNS, TRIM_SHARE

POWER = 0.8


# --------------------------------------------------------------------------------------------------
# Runs and worlds that a study requires, and differences that a planned study can show.

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
    """Compute the power of the two-sided t test."""
    if df <= 0:
        return 0.0
    limit = float(-scipy.special.stdtrit(df, alpha / 2))
    tails = (
        1
        - scipy.special.nctdtr(df, abs(score), limit)
        + scipy.special.nctdtr(df, abs(score), -limit)
    )
    return float(tails) if np.isfinite(tails) else float(scipy.special.ndtr(abs(score) - limit))


def detectable_score(df: float, alpha: float, power: float = POWER) -> float:
    """Compute the effect in standard errors that the two-sided t test shows with a given power."""
    if df <= 0:
        return math.inf
    limit = float(-scipy.special.stdtrit(df, alpha / 2))
    low, high = 0.0, 6 * limit + 20
    for _ in range(_HALVINGS):  # scipy.optimize takes a tenth of a second to import
        middle = (low + high) / 2
        low, high = (middle, high) if t_test_power(middle, df, alpha) < power else (low, middle)
    return high


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


# --------------------------------------------------------------------------------------------------
# Sentence about what a study can show, printed before it runs.

_LARGEST_RATIO = 1000.0


def describe_study_size(runs: int, worlds: int, pairs: int) -> str:
    """Describe the least differences that a study shows, before it runs.

    Returns one or two sentences on errors, for the worlds of the study and for a new one.
    """
    effects = detectable_effects(runs, worlds, pairs)
    size = f"{_count(runs, 'run')} and {_count(worlds, 'world')}"
    if runs < MIN_RUNS:
        return f"{_count(runs, 'run')} can show nothing: tests require at least {MIN_RUNS} runs."
    scope = "this world" if worlds == 1 else f"these {worlds} worlds"
    sentence = f"{size} can show {_ratio(effects.error_same_worlds)} in {scope}"
    if worlds == 1:
        new = "and nothing about a new world, which requires at least 2 worlds"
    else:
        new = f"and {_ratio(effects.error_new)} in a new world"
    basis = f"{_count(pairs, 'pair')} of filters, power {POWER:g}, typical spread"
    return f"{sentence}, {new} ({basis})."


def _ratio(effect: float) -> str:
    """Format a log ratio of errors as a requirement."""
    ratio = math.exp(min(effect, 700.0))
    if ratio > _LARGEST_RATIO:
        return "no error ratio below 1000"
    return f"error ratios of at least {ratio:.3g}"


def _count(number: int, noun: str) -> str:
    """Format a count with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"
