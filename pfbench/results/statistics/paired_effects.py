"""Location of paired differences of one condition, with the influence of each run.

All statistics of a study have this form: a location and the contribution of each run to its error.
Contributions of several conditions are added run by run, so that runs that share random numbers need
no model of their correlation.

A difference is negative where the first filter is better. NaN marks a run that a condition does not
have. A lost run is infinite and remains at its end of the order.

References:
    J. W. Tukey and D. H. McLaughlin (1963), Less vulnerable confidence and significance procedures.
    K. K. Yuen (1974), The two-sample trimmed t for unequal population variances.
    T. Permutt and F. Li (2017), Trimmed means for symptom trials with dropouts.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pfbench.results.error_measures import Array, Flags
from pfbench.results.statistics.effect_sizes import LOG_TOLERANCE

TRIM_SHARE = 0.2  # removed at each end; the middle 60 % of the runs remain
_ROUNDING = 1e-12  # relative deviation from the mean of equal values
MIN_RUNS = 10  # runs that a condition requires for a decision [ours]


class ConditionEffects(NamedTuple):
    """Locations of conditions, with leading axes [...] of conditions, pairs or studies.

    Attributes:
        location: Location of the differences, [...]; infinite or NaN if lost runs decide it.
        parts: Contribution of each run, [..., N]: the influence value divided by the number of
            runs, 0 for a run that the condition does not have. Their sum is 0, and the sum of
            their squares estimates the variance of the location.
        middle: Number of runs that the location uses, [...].
        runs: Number of runs, [...].
    """

    location: Array
    parts: Array
    middle: Array
    runs: Array


def paired_log_ratio(a: Array, b: Array, succeeds_a: Flags, succeeds_b: Flags) -> Array:
    """Compute log ratios of losses in which a failed run lies beyond all others.

    A failed run is a run that does not keep track. Its loss is not used, since a filter that stops
    early can have a small loss.

    Args:
        a: Losses of the first filter, [...], positive.
        b: Losses of the second filter in the same runs, [...].
        succeeds_a: Runs in which the first filter keeps track, [...].
        succeeds_b: Runs in which the second filter keeps track, [...].

    Returns:
        log(a / b): infinite where only one filter fails, 0 where both do, NaN without a loss.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        d = np.where(a == b, 0.0, np.log(a) - np.log(b))
    return order_failed_runs(d, succeeds_a, succeeds_b)


def order_failed_runs(d: Array, succeeds_a: Flags, succeeds_b: Flags) -> Array:
    """Place failed runs at the ends of the order of differences; rounding counts as equality.

    Args:
        d: Differences, [...].
        succeeds_a: Runs in which the first filter keeps track, [...].
        succeeds_b: Runs in which the second filter keeps track, [...].

    Returns:
        Differences, [...]: +inf where only a fails, -inf where only b fails, 0 where both do.
    """
    d = np.where(np.abs(d) <= LOG_TOLERANCE, 0.0, d)
    failed = np.where(succeeds_b, np.inf, -np.inf)
    failed = np.where(succeeds_a == succeeds_b, 0.0, failed)
    return np.where(succeeds_a & succeeds_b, d, failed)


def trimmed_effects(d: Array, trim: float = TRIM_SHARE) -> ConditionEffects:
    """Compute trimmed means of differences and the contributions of the runs.

    Args:
        d: Differences, [..., N]; NaN marks a run that a condition does not have.
        trim: Share of runs removed at each end; 0 gives the mean.

    Returns:
        Locations and contributions. The location is infinite if failed runs reach into the
        middle, and NaN if they do so from both ends or for a condition without runs.
    """
    runs = np.count_nonzero(~np.isnan(d), axis=-1)
    cut = np.floor(trim * runs + 1e-9).astype(int)
    middle = runs - 2 * cut
    ordered = np.sort(d, axis=-1)  # NaN last
    index = np.arange(d.shape[-1])
    inside = (index >= cut[..., None]) & (index < (runs - cut)[..., None])
    with np.errstate(divide="ignore", invalid="ignore"):  # no run, or lost runs in the middle
        location = np.where(inside, ordered, 0.0).sum(axis=-1) / middle
        low, high = (
            np.take_along_axis(ordered, np.clip(k, 0, None)[..., None], axis=-1)
            for k in (cut, runs - cut - 1)
        )
        winsorised = np.clip(d, low, high)
        centre = np.nansum(winsorised, axis=-1) / runs
        deviation = winsorised - centre[..., None]
        deviation = np.where(np.abs(deviation) <= _ROUNDING * np.abs(winsorised), 0.0, deviation)
        parts = deviation / middle[..., None]
    finite = np.isfinite(location)[..., None] & ~np.isnan(d)
    return ConditionEffects(location, np.where(finite, parts, 0.0), middle, runs)


def log_levels(value: Array, keeps_track: Flags, present: Flags) -> ConditionEffects:
    """Compute the level of one filter in each condition: the trimmed mean of the log error.

    The difference of two levels is transitive, unlike a location of paired differences.

    Args:
        value: Errors, [..., N].
        keeps_track: Runs that keep track, [..., N]. The others lie at the upper end.
        present: Runs that exist, [..., N].

    Returns:
        Levels and contributions of the runs.
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        log_error = np.where(keeps_track, np.log(value), np.inf)
    return trimmed_effects(np.where(present, log_error, np.nan))


def subtract_levels(a: ConditionEffects, b: ConditionEffects) -> ConditionEffects:
    """Subtract the levels of two filters; contributions are subtracted run by run.

    Args:
        a: Levels of the first filter.
        b: Levels of the second filter in the same runs.
    """
    with np.errstate(invalid="ignore"):  # lost runs decide both
        location = a.location - b.location
    parts = np.where(np.isfinite(location)[..., None], a.parts - b.parts, 0.0)
    return ConditionEffects(
        location, parts, np.minimum(a.middle, b.middle), np.minimum(a.runs, b.runs)
    )


def is_identical(d: Array, axes: int | tuple[int, ...] = -1) -> Flags:
    """Return whether all differences agree with 0 to the stored precision.

    Args:
        d: Differences, [...]; NaN is left out.
        axes: Axes over which all differences must be 0.
    """
    return np.asarray(np.all(np.isnan(d) | (np.abs(d) <= LOG_TOLERANCE), axis=axes))
