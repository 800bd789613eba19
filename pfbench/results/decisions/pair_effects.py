"""Effects of one metric of one pair of filters, for the questions (a) and (b).

All functions accept leading axes, so that simulated studies take the path of a report.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pfbench.results.error_measures import Array, Flags
from pfbench.results.statistics.label_flips import flip_p_value, run_contributions
from pfbench.results.statistics.paired_effects import (
    MIN_RUNS,
    TRIM_SHARE,
    ConditionEffects,
    is_identical,
    trimmed_effects,
)
from pfbench.results.statistics.world_effects import (
    EffectEstimate,
    WorldEffects,
    combine_conditions,
    estimate_in_new_world,
    estimate_in_these_worlds,
    world_sd,
)


class QuestionEffect(NamedTuple):
    """Effect for one question, with leading axes [...].

    Attributes:
        value: Estimate, negative if the first filter is better.
        estimate: Estimate that gives the intervals. For shares it is shrunk towards 0.
        p: p-value, NaN if no test is possible.
    """

    value: Array
    estimate: EffectEstimate
    p: Array


class PairEffects(NamedTuple):
    """Effects of one metric of one pair, with leading axes [...].

    Attributes:
        same_worlds: Question (a), the worlds of the study.
        new_world: Question (b), a new world.
        worlds: Effects of the worlds.
        by_runs_won: Whether the effect is the difference of the shares of runs won, [...].
        identical: Whether all runs agree, [...].
        too_few: Whether a condition has fewer than 10 runs, [...].
    """

    same_worlds: QuestionEffect
    new_world: QuestionEffect
    worlds: WorldEffects
    by_runs_won: Flags
    identical: Flags
    too_few: Flags


def location_effects(
    d: Array,
    weights: Array,
    trim: float = TRIM_SHARE,
    shared_runs: bool = True,
    conditions: ConditionEffects | None = None,
) -> PairEffects:
    """Estimate the effect as the mean over worlds of locations.

    If lost runs decide a location, or ties hide all spread, the effect is the difference of the
    shares of runs won.

    Args:
        d: Differences, [..., W, C, N], negative if the first filter is better, infinite where one
            filter failed, NaN for an absent run.
        weights: Weights of the conditions, [W, C]; 0 for an absent one.
        trim: Share removed at each end; 0 for the mean.
        shared_runs: Whether a run has the same random numbers in all worlds.
        conditions: Locations of the conditions, None for trimmed means of the differences.

    Returns:
        Effects.
    """
    conditions = trimmed_effects(d, trim) if conditions is None else conditions
    worlds = combine_conditions(conditions, weights)
    same_worlds = _as_question(estimate_in_these_worlds(worlds, shared_runs))
    new = _as_question(estimate_in_new_world(worlds, shared_runs))
    effects = _mark(
        PairEffects(same_worlds, new, worlds, *_no_flags(same_worlds.value)), d, weights
    )
    tied = (same_worlds.estimate.standard_error == 0) & ~_is_constant(d, weights)
    replaced = (~np.isfinite(same_worlds.value) | tied) & ~effects.identical
    if not replaced.any():
        return effects
    won = share_effects(np.sign(d[replaced]), weights, shared_runs)
    return _replace(effects, won, replaced)


def share_effects(d: Array, weights: Array, shared_runs: bool = True, key: str = "") -> PairEffects:
    """Estimate a difference of shares; filters are exchanged run by run.

    The interval has one run added to each side [after Agresti, Min 2005], so that it exists for
    shares of 0 and 1. For a new world, the error over worlds is at least the error over runs.

    Args:
        d: Differences -1, 0 or 1, [..., W, C, N], NaN for an absent run.
        weights: Weights of the conditions, [W, C].
        shared_runs: Whether a run has the same random numbers in all worlds.
        key: Name of the comparison, for random exchanges.

    Returns:
        Effects.
    """
    worlds = combine_conditions(trimmed_effects(d, 0.0), weights)
    contributions = run_contributions(d, weights, shared_runs)
    value = contributions.sum(axis=-1)
    runs = _run_count(d, weights, shared_runs)
    by_runs = _shrunk_share(contributions, runs)
    p = np.array(
        [flip_p_value(x, key=key) for x in contributions.reshape(-1, contributions.shape[-1])]
    )
    same_worlds = QuestionEffect(value, by_runs, p.reshape(value.shape))
    new = estimate_in_new_world(worlds, shared_runs)
    error = np.fmax(new.standard_error, by_runs.standard_error)
    new = EffectEstimate(new.value, error, new.df)
    return _mark(PairEffects(same_worlds, _as_question(new), worlds, *_no_flags(value)), d, weights)


def estimate_share_difference(d: Array, weights: Array, shared_runs: bool = True) -> EffectEstimate:
    """Estimate the difference of shares in these worlds, as `share_effects` does, without a test.

    Args:
        d: Differences -1, 0 or 1, [..., W, C, N], NaN for an absent run.
        weights: Weights of the conditions, [W, C].
        shared_runs: Whether a run has the same random numbers in all worlds.
    """
    contributions = run_contributions(d, weights, shared_runs)
    return _shrunk_share(contributions, _run_count(d, weights, shared_runs))


def run_sd(effects: PairEffects) -> Array:
    """Compute the SD over runs of the mean over worlds: standard error times root of the runs."""
    runs = np.count_nonzero(effects.worlds.parts.any(axis=-2), axis=-1)
    return np.asarray(effects.same_worlds.estimate.standard_error * np.sqrt(np.maximum(runs, 1)))


def between_sd(effects: PairEffects) -> Array:
    """Compute the SD of the effects of the worlds; NaN for one world."""
    return world_sd(effects.worlds.location)


def _as_question(estimate: EffectEstimate) -> QuestionEffect:
    return QuestionEffect(estimate.value, estimate, estimate.p)


def _no_flags(value: Array) -> tuple[Flags, Flags, Flags]:
    flags = np.zeros(np.shape(value), dtype=bool)
    return flags, flags, flags


def _mark(effects: PairEffects, d: Array, weights: Array) -> PairEffects:
    """Remove the tests of identical pairs, and those of question (a) with too few runs."""
    used = weights > 0
    runs = np.where(used, np.count_nonzero(~np.isnan(d), axis=-1), MIN_RUNS)
    too_few = np.asarray((runs < MIN_RUNS).any(axis=(-2, -1)))
    identical = is_identical(d, (-3, -2, -1))
    same_worlds = effects.same_worlds._replace(
        p=np.where(identical | too_few, np.nan, effects.same_worlds.p)
    )
    new = effects.new_world._replace(p=np.where(identical, np.nan, effects.new_world.p))
    return effects._replace(
        same_worlds=same_worlds, new_world=new, identical=identical, too_few=too_few
    )


def _is_constant(d: Array, weights: Array) -> Flags:
    """Return whether all runs of each condition agree: filters without random numbers."""
    ordered = np.sort(d, axis=-1)
    with np.errstate(invalid="ignore"):
        same = np.isnan(d) | (np.abs(d - ordered[..., :1]) <= 1e-9)
    return np.asarray((same.all(axis=-1) | (weights <= 0)).all(axis=(-2, -1)))


def _run_count(d: Array, weights: Array, shared_runs: bool) -> Array:
    """Count the runs, [...]; those of all worlds if they are not shared."""
    present = np.asarray((~np.isnan(d) & (weights > 0)[..., None]).any(axis=-2))
    if shared_runs:
        return np.asarray(np.count_nonzero(present.any(axis=-2), axis=-1))
    return np.asarray(np.count_nonzero(present, axis=(-2, -1)))


def _shrunk_share(contributions: Array, runs: Array) -> EffectEstimate:
    """Estimate a mean difference with one run added to each side."""
    count = np.maximum(runs, 1)
    by_run = contributions * count[..., None]
    value = by_run.sum(axis=-1) / (count + 2)
    variance = ((by_run**2).sum(axis=-1) + 1) / (count + 2) - value**2
    error = np.sqrt(np.maximum(variance, 0.0) / (count + 2))
    return EffectEstimate(value, error, np.maximum(count - 1.0, 1.0))


def _replace(effects: PairEffects, won: PairEffects, mask: Flags) -> PairEffects:
    """Insert effects of runs won where a mask is set."""

    def insert(old: Array, new: Array) -> Array:
        mixed = np.array(old, dtype=np.float64)
        mixed[mask] = new
        return mixed

    def insert_question(old: QuestionEffect, new: QuestionEffect) -> QuestionEffect:
        estimate = EffectEstimate(*map(insert, old.estimate, new.estimate))
        return QuestionEffect(insert(old.value, new.value), estimate, insert(old.p, new.p))

    worlds = WorldEffects(*map(insert, effects.worlds, won.worlds))
    return effects._replace(
        same_worlds=insert_question(effects.same_worlds, won.same_worlds),
        new_world=insert_question(effects.new_world, won.new_world),
        worlds=worlds,
        by_runs_won=mask,
    )
