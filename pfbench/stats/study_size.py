"""Runs and worlds that a study requires, and differences that a planned study can show."""

from __future__ import annotations

import math
from functools import cache
from typing import NamedTuple

import numpy as np
import scipy  # scipy.special is imported at its first use, which takes a tenth of the start of a job

from pfbench.core.parameter_checks import require
from pfbench.stats.comparison import ALPHA, MIN_RUNS, TRIM_SHARE
from pfbench.stats.error_measures import Array
from pfbench.stats.sentences import format_count

POWER = 0.8


_HALVINGS = 60
_MOST_RUNS = 10_000
_SURE = 0.95  # share of negative means of two differences, above which Noether's formula asks for too much


# typical standard deviations of log ratios, measured on stored studies: over runs of a world (standard error times root of
# the runs), and over worlds; and the correlation of two worlds over runs
RUN_SD, WORLD_SD, WORLD_CORRELATION = 0.4, 0.25, 0.15


class DetectableEffects(NamedTuple):
    """Least log ratios of errors that a study shows with a given power; infinite if it cannot show any.

    Attributes:
        error_same_worlds: Log ratio of errors in the worlds of the study.
        error_new: Log ratio of errors in a new world.
    """

    error_same_worlds: float
    error_new: float


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


def detectable_score(df: float, alpha: float) -> float:
    """Compute the effect in standard errors that the two-sided t test shows with the power."""
    if df <= 0:
        return math.inf
    limit = float(-scipy.special.stdtrit(df, alpha / 2))
    low, high = 0.0, 6 * limit + 20
    for _ in range(_HALVINGS):  # scipy.optimize takes a tenth of a second to import
        middle = (low + high) / 2
        low, high = (middle, high) if t_test_power(middle, df, alpha) < POWER else (low, middle)
    return high


def detectable_effects(runs: int, worlds: int, pairs: int) -> DetectableEffects:
    """Compute the least effects that a planned study shows, before it runs.

    Args:
        runs: Runs per condition.
        worlds: Number of worlds.
        pairs: Number of planned pairs. Track and error of each pair are one family.

    Returns:
        Effects of the questions (a) and (b).

    Raises:
        ValueError: if a number is not positive.
    """
    require(
        min(runs, worlds, pairs) >= 1,
        "runs, worlds and pairs",
        "be positive",
        f"{runs}, {worlds} and {pairs}",
        "Use 1 or more.",
    )
    level = ALPHA / (2 * pairs)
    middle = runs - 2 * math.floor(TRIM_SHARE * runs + 1e-9)  # that remain after trimming
    same_worlds = detectable_score(middle - 1 if runs >= MIN_RUNS else 0, level)
    over_runs = RUN_SD * math.sqrt((1 + (worlds - 1) * WORLD_CORRELATION) / (worlds * runs))
    of_worlds = math.hypot(over_runs, WORLD_SD / math.sqrt(worlds))
    return DetectableEffects(
        same_worlds * over_runs, detectable_score(worlds - 1, level) * of_worlds
    )


def count_needed_runs(d: Array, ratio: float, alpha: float) -> float:
    """Count the paired runs with which the sign test and the signed-rank test of one side show a ratio with the power.

    The differences keep their scatter and get the ratio as their centre. Exact for the sign test, the formula of Noether [1987] for the
    other one. Infinite beyond 10 000 runs.

    Args:
        d: Log ratios of losses, [n], at least two.
        ratio: Ratio of errors that is to be shown.
        alpha: Error rate of each test, on the side of the ratio.

    Returns:
        Number of runs.
    """
    means = np.add.outer(d, d) / 2
    centred = means - np.median(means[np.triu_indices(len(d))]) + math.log(ratio)
    share = float((centred.diagonal() < 0).mean())
    counts = np.arange(1, _MOST_RUNS + 1)
    enough = scipy.stats.binom.sf(_count_signs(alpha), counts, share) >= POWER
    of_signs = counts[enough][0] if enough.any() else math.inf
    both = float((centred[np.triu_indices(len(d), 1)] < 0).mean())
    if both >= _SURE:  # one that rejects with few signs rejects with their ranks
        return float(of_signs)
    score = float(scipy.special.ndtri(1 - alpha) + scipy.special.ndtri(POWER))
    of_ranks = math.ceil(score**2 / (3 * (both - 0.5) ** 2)) if both > 0.5 else math.inf
    needed = float(max(of_signs, of_ranks))
    return needed if needed <= _MOST_RUNS else math.inf


@cache
def _count_signs(alpha: float) -> Array:
    """Return the largest count of signs that the sign test does not reject, for 1 to 10 000 runs."""
    return np.asarray(scipy.stats.binom.isf(alpha, np.arange(1, _MOST_RUNS + 1), 0.5))


_LARGEST_RATIO = 1000.0


def describe_study_size(runs: int, worlds: int, pairs: int) -> str:
    """Describe the least differences that a study shows, before it runs.

    Returns one or two sentences on errors, for the worlds of the study and for a new one.
    """
    effects = detectable_effects(runs, worlds, pairs)
    size = f"{format_count(runs, 'run')} and {format_count(worlds, 'world')}"
    if runs < MIN_RUNS:
        return (
            f"{format_count(runs, 'run')} can show nothing: tests require at least {MIN_RUNS} runs."
        )
    scope = "this world" if worlds == 1 else f"these {worlds} worlds"
    sentence = f"{size} can show {_ratio(effects.error_same_worlds)} in {scope}"
    if worlds == 1:
        new = "and nothing about a new world, which requires at least 2 worlds"
    else:
        new = f"and {_ratio(effects.error_new)} in a new world"
    basis = f"{format_count(pairs, 'pair')} of filters, power {POWER:g}, typical spread"
    return f"{sentence}, {new} ({basis})."


def _ratio(effect: float) -> str:
    """Format a log ratio of errors as a requirement."""
    ratio = math.exp(min(effect, 700.0))
    if ratio > _LARGEST_RATIO:
        return "no error ratio below 1000"
    return f"error ratios of at least {ratio:.3g}"
