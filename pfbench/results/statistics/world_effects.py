"""Estimates of a paired effect in the worlds of a study and in a new world of the same kind.

A world is a family of scenarios that are variants of each other. Question (a) concerns the worlds of
the study: only runs are random. Question (b) concerns a new world: worlds are random, and the
conditions of a world are not worlds.

A stream of random numbers depends on the seed and the number of the run alone, so a run has the same
random numbers in all worlds. Differences of two filters in different scenarios correlate by 0.1 to
0.2 over runs. Contributions are therefore added over worlds by the key of the run [ours].

References:
    B. L. Welch (1947), The generalization of Student's problem.
    F. E. Satterthwaite (1946), An approximate distribution of estimates of variance components.
    J. P. T. Higgins, S. G. Thompson and D. J. Spiegelhalter (2009), A re-evaluation of
        random-effects meta-analysis.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.special import stdtr, stdtrit

from pfbench.results.error_measures import Array
from pfbench.results.statistics.paired_effects import ConditionEffects


class WorldEffects(NamedTuple):
    """Effects of the worlds of a study, with leading axes [...] of pairs or studies.

    Attributes:
        location: Effect of each world, [..., W].
        parts: Contribution of each run, [..., W, N].
        middle: Least number of runs that a location of the world uses, [..., W].
    """

    location: Array
    parts: Array
    middle: Array

    @property
    def standard_error(self) -> Array:
        """Standard error of each world over runs, [..., W]; NaN for fewer than two runs."""
        return _standard_error(self.parts, self.middle)


class EffectEstimate(NamedTuple):
    """Estimate with a Student distribution, [...].

    Attributes:
        value: Estimate.
        standard_error: Standard error.
        df: Degrees of freedom, NaN if the error cannot be estimated.
    """

    value: Array
    standard_error: Array
    df: Array

    @property
    def p(self) -> Array:
        """Two-sided p-value of no effect; NaN without degrees of freedom or for an infinite value.

        An effect that is exactly 0 without any spread has p = 1.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            t = np.where(self.value == 0.0, 0.0, np.abs(self.value) / self.standard_error)
            p = 2 * stdtr(self.df, -t)
        return np.where(np.isfinite(self.value) & (self.df > 0), p, np.nan)

    def interval(self, alpha: float | Array) -> tuple[Array, Array]:
        """Return the ends of the interval of level 1 - alpha; infinite if it does not exist."""
        df = np.where(self.df > 0, self.df, 1.0)
        with np.errstate(invalid="ignore"):
            half = -stdtrit(df, np.asarray(alpha) / 2) * self.standard_error
        exists = np.isfinite(self.value) & np.isfinite(half) & (self.df > 0)
        half = np.where(exists, half, np.inf)
        centre = np.where(exists, self.value, 0.0)
        return centre - half, centre + half


def combine_conditions(conditions: ConditionEffects, weights: Array) -> WorldEffects:
    """Average the conditions of each world; contributions are added run by run.

    Args:
        conditions: Effects of the conditions, with axes [..., W, C] and runs [..., W, C, N].
        weights: Weights of the conditions of a world, [W, C]; 0 for absent conditions. They sum to
            1 for each world.

    Returns:
        Effects of the worlds.
    """
    used = weights > 0
    with np.errstate(invalid="ignore"):
        location = (np.where(used, weights * conditions.location, 0.0)).sum(axis=-1)
    parts = np.einsum("wc,...wcn->...wn", weights, conditions.parts)
    middle = np.where(used, conditions.middle, np.inf).min(axis=-1)
    return WorldEffects(location, parts, middle)


def estimate_in_these_worlds(worlds: WorldEffects, shared_runs: bool = True) -> EffectEstimate:
    """Estimate the mean effect of the worlds of a study; question (a).

    Args:
        worlds: Effects of the worlds.
        shared_runs: Whether a run has the same random numbers in all worlds. If not, the worlds
            are independent, and the degrees of freedom are those of Welch and Satterthwaite.

    Returns:
        Estimate whose standard error describes other runs of the same study.
    """
    count = worlds.location.shape[-1]
    with np.errstate(invalid="ignore"):  # lost runs at both ends
        value = worlds.location.mean(axis=-1)
    if shared_runs:
        middle = worlds.middle.min(axis=-1)
        error = _standard_error(worlds.parts.mean(axis=-2), middle)
        return EffectEstimate(value, error, middle - 1)
    variance = worlds.standard_error**2
    total = variance.sum(axis=-1)
    with np.errstate(divide="ignore", invalid="ignore"):
        df = total**2 / (variance**2 / (worlds.middle - 1)).sum(axis=-1)
    df = np.where(total == 0, worlds.middle.min(axis=-1) - 1, df)
    return EffectEstimate(value, np.sqrt(total) / count, df)


def estimate_in_new_world(worlds: WorldEffects, shared_runs: bool = True) -> EffectEstimate:
    """Estimate the mean effect over worlds like those of the study; question (b).

    The SD over worlds contains the errors of the worlds, but not the error that all worlds share. Its
    variance is the mean covariance of two worlds over runs, and is added if it is positive [ours].

    Args:
        worlds: Effects of the worlds.
        shared_runs: Whether a run has the same random numbers in all worlds.

    Returns:
        Estimate with W - 1 degrees of freedom.
    """
    count = worlds.location.shape[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        value = worlds.location.mean(axis=-1)
        between = world_sd(worlds.location) ** 2 / count
        common = common_variance(worlds) if shared_runs else np.zeros(value.shape)
        total = between + common
    return EffectEstimate(value, np.sqrt(total), np.full(value.shape, count - 1.0))


def common_variance(worlds: WorldEffects) -> Array:
    """Estimate the variance over runs of the error that all worlds share, [...], at least 0."""
    count = worlds.location.shape[-1]
    if count < 2:
        return np.zeros(worlds.location.shape[:-1])
    error = _standard_error(worlds.parts.sum(axis=-2), worlds.middle.min(axis=-1))
    covariance = (error**2 - (worlds.standard_error**2).sum(axis=-1)) / (count * (count - 1))
    return np.nan_to_num(np.maximum(covariance, 0.0))


def prediction_interval(locations: Array, alpha: float) -> tuple[Array, Array]:
    """Compute the interval of the effect of one new world.

    Args:
        locations: Effects of the worlds, [..., W].
        alpha: Probability outside the interval.

    Returns:
        Lower and upper end, [...]; infinite for one world.
    """
    count = locations.shape[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        error = world_sd(locations) * np.sqrt(1 + 1 / count)
        value = locations.mean(axis=-1)
    return EffectEstimate(value, error, np.full(value.shape, count - 1.0)).interval(alpha)


def world_sd(locations: Array) -> Array:
    """Compute the standard deviation over worlds of effects [..., W]; NaN for one world."""
    count = locations.shape[-1]
    with np.errstate(divide="ignore", invalid="ignore"):
        centred = locations - locations.mean(axis=-1, keepdims=True)
        return np.sqrt((centred**2).sum(axis=-1) / (count - 1 if count > 1 else np.nan))


def _standard_error(parts: Array, middle: Array) -> Array:
    """Compute the standard error of a sum of contributions [..., N]."""
    with np.errstate(divide="ignore", invalid="ignore"):
        correction = np.where(middle > 1, middle / (middle - 1), np.nan)
        return np.sqrt(correction * (parts**2).sum(axis=-1))
