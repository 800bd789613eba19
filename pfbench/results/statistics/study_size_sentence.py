"""Sentence about what a study can show, printed before it runs."""

from __future__ import annotations

import math

from pfbench.results.statistics.paired_effects import MIN_RUNS
from pfbench.results.statistics.power import POWER
from pfbench.results.statistics.study_size import detectable_effects

_LARGEST_RATIO = 1000.0


def describe_study_size(runs: int, worlds: int, pairs: int) -> str:
    """Describe the least differences that a study shows, before it runs.

    Args:
        runs: Runs per condition.
        worlds: Number of worlds, families of scenarios.
        pairs: Number of planned pairs of filters.

    Returns:
        One or two sentences on errors, for the worlds of the study and for a new one.

    Raises:
        ValueError: if a number is not positive.
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
