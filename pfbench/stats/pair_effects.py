"""Effects of one metric of one pair of filters, for the questions (a) and (b).

All functions accept leading axes, so that simulated studies take the path of a report.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pfbench.stats.decision import DecisionOptions, MetricRule, Scale
from pfbench.stats.effects import (
    MIN_RUNS,
    TRIM_SHARE,
    ConditionEffects,
    EffectEstimate,
    WorldEffects,
    combine_conditions,
    estimate_in_new_world,
    estimate_in_these_worlds,
    is_identical,
    log_levels,
    order_failed_runs,
    paired_log_ratio,
    subtract_levels,
    trimmed_effects,
    world_sd,
)
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.rank_tests import flip_p_value, run_contributions
from pfbench.stats.study_runs import PairRuns


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

    Returns effects. Shapes: d [..., W, C, N], weights [W, C].
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

    Returns effects. Shapes: d [..., W, C, N], weights [W, C].
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

    Shapes: d [..., W, C, N], weights [W, C].
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


# --------------------------------------------------------------------------------------------------
# Comparisons of one metric of one pair of filters, for both questions.

TRACK = "keeps track"


class PairComparison(NamedTuple):
    """One metric of one pair before the test of its family.

    Attributes:
        pair: Runs of both filters.
        metric: Name of the metric.
        group: Group of the state.
        scale: Scale of the effect.
        margin: Margin of equivalence in the unit of the effect.
        effects: Effects for both questions.
        both_keep: Effect among the runs in which both keep track.
    """

    pair: PairRuns
    metric: str
    group: str
    scale: Scale
    margin: float
    effects: PairEffects
    both_keep: float


def paired_differences(pair: PairRuns, rule: MetricRule) -> Array:
    """Compute the differences of a metric, [W, C, N]; NaN for an absent run."""
    sign = -1.0 if rule.higher_is_better else 1.0
    succeeds = (pair.keeps_a, pair.keeps_b)
    if rule.scale == "log ratio":
        ratio = paired_log_ratio(pair.value_a, pair.value_b, *succeeds)
        failed = ~(pair.keeps_a & pair.keeps_b)
        d = np.where(failed, ratio, sign * ratio)
    else:
        with np.errstate(invalid="ignore"):
            d = sign * (pair.value_a - pair.value_b)
        d = np.where(pair.value_a == pair.value_b, 0.0, d)
        d = order_failed_runs(d, *succeeds) if rule.scale == "difference" else d
    return np.where(pair.present, d, np.nan)


def compare_metric(pair: PairRuns, rule: MetricRule, options: DecisionOptions) -> PairComparison:
    """Compare a metric of a pair.

    Returns PairComparison for both questions.
    """
    d, shared = paired_differences(pair, rule), options.shared_runs
    margin = rule.margin if rule.margin is not None else options.log_margin
    if rule.scale == "share":
        effects = share_effects(d, pair.weights, shared, _key(pair, rule.name))
        return PairComparison(pair, rule.name, rule.group, "share", margin, effects, np.nan)
    trim = 0.0 if rule.scale == "mean difference" else TRIM_SHARE
    is_ratio = rule.scale == "log ratio"
    by_levels = is_ratio and options.estimate == "levels"
    levels = _subtract_pair_levels(pair, rule) if by_levels else None
    effects = location_effects(d, pair.weights, trim, shared, levels)
    scale: Scale = "log ratio" if is_ratio else "difference"
    scale = "runs won" if effects.by_runs_won else scale
    both_kept = np.where(pair.keeps_a & pair.keeps_b, d, np.nan)
    both = _mean_location(both_kept, pair.weights, trim)
    return PairComparison(pair, rule.name, rule.group, scale, margin, effects, both)


def compare_track(pair: PairRuns, group: str, options: DecisionOptions) -> PairComparison:
    """Compare the shares of runs that keep track.

    Returns PairComparison for both questions.
    """
    d = np.where(pair.present, pair.keeps_b.astype(float) - pair.keeps_a, np.nan)
    effects = share_effects(d, pair.weights, options.shared_runs, _key(pair, TRACK))
    return PairComparison(pair, TRACK, group, "share", options.track_margin, effects, np.nan)


def _subtract_pair_levels(pair: PairRuns, rule: MetricRule) -> ConditionEffects:
    """Subtract the levels of the second filter from those of the first, by condition."""
    first, second = (pair.value_a, pair.value_b)
    if rule.higher_is_better:
        first, second = 1 / first, 1 / second
    return subtract_levels(
        log_levels(first, pair.keeps_a, pair.present),
        log_levels(second, pair.keeps_b, pair.present),
    )


def _mean_location(d: Array, weights: Array, trim: float) -> float:
    """Average the locations of the conditions that have runs; NaN without one."""
    location = trimmed_effects(d, trim).location
    used = np.where(np.isfinite(location), weights, 0.0)
    total = used.sum()
    return (
        float((used * np.nan_to_num(location, posinf=0.0, neginf=0.0)).sum() / total)
        if total
        else np.nan
    )


def _key(pair: PairRuns, metric: str) -> str:
    return f"{pair.a} {pair.b} {metric}"
