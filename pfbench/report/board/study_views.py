"""All views of a study: metric, world, regime and baseline, each with its sentence and its rows."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.board.curves import CellKey
from pfbench.report.board.entries import (
    LOG_SCORE,
    METRIC_NAMES,
    StudyNames,
    ViewKey,
    format_interval_level,
    list_metrics,
    round_values,
)
from pfbench.report.board.levels import (
    Selection,
    StudyArrays,
    arrange_runs,
    average_levels,
    compare_track_shares,
    compute_condition_levels,
)
from pfbench.report.board.view import (
    Scope,
    ViewOptions,
    build_rows,
    count_failing,
    count_words,
    describe_filters,
    describe_view,
    name_lost_runs,
    show_row,
)
from pfbench.report.journal.study_pack import ALL
from pfbench.report.options import ReportOptions
from pfbench.results.conditions import parse_label
from pfbench.results.looks import (
    MethodLook,
    PartName,
    count_tuned,
    describe_data_settings,
    describe_settings,
    describe_tuning,
    plan_look_pairs,
)
from pfbench.results.step_times import StepTimes
from pfbench.stats.decision import Decision
from pfbench.stats.effects import ConditionEffects
from pfbench.stats.error_measures import Flags
from pfbench.stats.main_metrics import main_rule, select_conditions
from pfbench.stats.pair_effects import TRACK
from pfbench.stats.planned_pairs import RUNS_WON, decide_planned_pairs
from pfbench.stats.sentences import describe_pair, describe_runs_won, describe_shares


def build_views(
    table: pd.DataFrame,
    names: StudyNames,
    options: ReportOptions,
    words: Mapping[tuple[str, str], str],
    times: Mapping[CellKey, Mapping[str, StepTimes]] | None = None,
) -> dict[ViewKey, dict[str, Any]]:
    """Build all views that have runs. The first one opens the page."""
    runs = arrange_runs(table, tuple(names.looks))
    selections = _list_selections(runs, table, names, options)
    views: dict[ViewKey, dict[str, Any]] = {}
    baselines: list[str] = []
    for metric in list_metrics(table, options.metric):
        levels = compute_condition_levels(runs, metric)
        for selection in selections:
            scope = _assess_scope(selection, levels)._replace(
                unit=""
                if metric == LOG_SCORE or len(selection.groups) > 1
                else selection.groups["unit"].iloc[0],
                times=[(times or {}).get(key, {}) for key in selection.groups.index],
            )
            is_opening = metric == options.metric and selection.in_scope.all()
            view_options = ViewOptions(  # planned words are of all conditions of a pair
                options.alpha,
                options.equivalence_margin,
                words if is_opening and selection.mask.all() else None,
            )
            notes = (
                selection.small_print,
                _describe_hard_condition(scope, selection.runs.conditions, names),
                _describe_timing(scope, options),
            )
            if not views:  # the page opens with a baseline that has an error
                baselines = _order_baselines(scope, names.baselines)
            for baseline in baselines:
                rows = build_rows(scope, baseline, view_options)
                has_limit = _has_limits(selection.runs.conditions, names)
                views[ViewKey(metric, selection.world, selection.regime, baseline)] = {
                    "sentence": _describe_common(selection.mask, selection.in_scope, len(rows))
                    + describe_view(
                        rows,
                        names.looks,
                        baseline,
                        selection.where,
                        _name_metric(metric, selection.groups["group"]),
                        format_interval_level(options.alpha),
                        partial(compare_track_shares, selection.runs, alpha=options.alpha),
                        has_limit=has_limit,
                    ),
                    "small_print": " ".join(filter(None, notes)),
                    "rows": [round_values(show_row(row, has_limit=has_limit)) for row in rows],
                }
    return views


def _has_limits(conditions: pd.DataFrame, names: StudyNames) -> bool:
    """Return whether all scenarios of a view state a divergence threshold."""
    worlds = (names.worlds.get(name) for name in conditions["scenario"].unique())
    return all(world is None or world.limit is not None for world in worlds)


def _order_baselines(scope: Scope, baselines: Sequence[str]) -> list[str]:
    """Order baselines with an error first. If none has one, the filter of the smallest error leads."""
    level = dict(zip(scope.filters, scope.levels.level, strict=True))
    ordered = sorted(baselines, key=lambda label: not np.isfinite(level[label]))
    best = min(level, key=lambda label: (not np.isfinite(level[label]), level[label]))
    is_needed = np.isfinite(level[best]) and not np.isfinite(level[ordered[0]])
    return [best, *ordered] if is_needed else ordered


def _list_scopes(conditions: pd.DataFrame) -> Iterator[tuple[str, str, Flags]]:
    """Yield world, regime and mask of the conditions of each scope that has conditions."""
    for world in (ALL, *conditions["scenario"].unique()):
        for regime in (ALL, *conditions["regime"].unique()):
            mask = ((world == ALL) | (conditions["scenario"] == world)) & (
                (regime == ALL) | (conditions["regime"] == regime)
            )
            if mask.any():
                yield world, regime, mask.to_numpy()


def _name_metric(metric: str, groups: pd.Series[str]) -> str:
    """Name a metric with its group, if all conditions have the same main group."""
    is_one = groups.nunique() == 1 and metric != LOG_SCORE
    return f"{groups.iloc[0]} {METRIC_NAMES[metric]}" if is_one else METRIC_NAMES[metric]


def _select_common(runs: StudyArrays, mask: Flags) -> Flags:
    """Select the conditions of a scope in which its filters are compared; all if none is common."""
    present = runs.present.any(axis=2) & mask
    common = select_conditions(present).conditions
    return common if common.any() else mask


def _describe_common(mask: Flags, in_scope: Flags, filters: int) -> str:
    """State that filters are compared in a selection of the conditions; empty if in all."""
    if mask.sum() == in_scope.sum():
        return ""
    count = f"{mask.sum()} of {count_words(int(in_scope.sum()), 'condition')}"
    verb = "is" if mask.sum() == 1 else "are"
    return f"{count} {verb} compared: not all {filters} filters were run in the others. "


def _list_selections(
    runs: StudyArrays, table: pd.DataFrame, names: StudyNames, options: ReportOptions
) -> list[Selection]:
    """List the scopes, their runs and what is said of them whatever the metric."""
    groups = table.groupby(["scenario", "regime"])[["unit", "group"]].first()
    selections = []
    for world, regime, in_scope in _list_scopes(runs.conditions):
        mask = _select_common(runs, in_scope)
        selected = runs.select(mask)
        keys = list(selected.conditions[["scenario", "regime"]].itertuples(index=False, name=None))
        described = describe_filters(selected, options.alpha)
        texts = _describe_scope(selected.conditions, names), _small_print(selected, options, names)
        selections.append(
            Selection(world, regime, in_scope, mask, selected, groups.loc[keys], described, *texts)
        )
    return selections


def _assess_scope(selection: Selection, levels: ConditionEffects) -> Scope:
    """Average the levels of the conditions of a scope."""
    selected = ConditionEffects(*(array[:, selection.mask] for array in levels))
    return Scope(
        selection.runs.filters,
        average_levels(selected, selection.runs.conditions),
        selection.filters,
        "",
        len(selection.runs.conditions) == 1,
    )


def _describe_scope(conditions: pd.DataFrame, names: StudyNames) -> str:
    """Describe worlds and regimes in words."""
    where = f"in {_count_worlds(conditions)}"
    scenarios, regimes = conditions["scenario"].unique(), conditions["regime"].unique()
    if len(scenarios) == 1:
        where = f"in {names.worlds[scenarios[0]].name}"
    if len(regimes) == 1 and regimes[0] in names.regimes:
        where += f" with {names.regimes[regimes[0]].words}"
    return where


def _count_worlds(conditions: pd.DataFrame) -> str:
    """Count the scenarios, and the worlds where several scenarios share a trajectory."""
    scenarios, worlds = conditions["scenario"].nunique(), conditions["family"].nunique()
    text = count_words(scenarios, "scenario")
    return text if scenarios == worlds else f"{text} of {count_words(worlds, 'world')}"


def _describe_hard_condition(scope: Scope, conditions: pd.DataFrame, names: StudyNames) -> str:
    """Name the condition in which most filters do not keep track, where there are several conditions."""
    counts = scope.levels.off.sum(axis=0)
    if len(counts) == 1 or not counts.any():
        return ""
    hardest = conditions.iloc[[int(counts.argmax())]]
    text = (
        f"{count_failing(int(counts.max()), len(scope.filters))} in over a fifth of runs "
        f"{_describe_scope(hardest, names)}, the most of a condition."
    )
    return text if _has_limits(hardest, names) else name_lost_runs(text)


def _describe_timing(scope: Scope, options: ReportOptions) -> str:
    """Describe how the times per step of a view were measured."""
    measured = [scope.filters and set(scope.filters) <= set(times) for times in scope.times]
    if not all(measured):
        return "ms/step: one timing per job, which other programs can change."
    rounds = sorted({t.seconds.size for times in scope.times for t in times.values()})
    number = str(rounds[0]) if len(rounds) == 1 else f"{rounds[0]} to {rounds[-1]}"
    level = format_interval_level(options.alpha)
    return (
        f"ms/step: median and quartiles of {number} rounds in which the filters took turns; "
        f"ratio of the times paired by round, {level} interval."
    )


def _small_print(runs: StudyArrays, options: ReportOptions, names: StudyNames) -> str:
    """Describe the sample of a view, its intervals, settings in names, and what was tuned."""
    filters = int(runs.present.any(axis=(1, 2)).sum())
    seeds = np.unique(runs.values["seed"][runs.present])
    level = format_interval_level(options.alpha)
    settings = describe_data_settings([*names.worlds, *names.regimes])
    texts = (
        settings,
        describe_settings(list(names.looks)),
        describe_tuning(count_tuned(names.looks), len(names.looks)),
    )
    notes = " ".join(filter(None, texts))
    return (
        f"{count_words(filters, 'filter')}, "
        f"{_count_worlds(runs.conditions)}, "
        f"{count_words(runs.conditions['regime'].nunique(), 'noise regime')}, "
        f"{_count_runs(runs)} per condition, "
        f"{count_words(len(seeds), 'seed')}. "
        "Errors are trimmed means over runs on the logarithmic scale, averaged over conditions, as are shares of runs. "
        f"Intervals of the ratio: {level} each. "
        f"Verdicts against the best hold for all pairs together at {level}. "
        f"They concern these worlds. {notes}"
    ).rstrip()


def _count_runs(runs: StudyArrays) -> str:
    """Count the paired runs of a condition, as a range where conditions differ."""
    counts = runs.present.any(axis=0).sum(axis=1)
    largest = count_words(int(counts.max()), "paired run")
    return largest if counts.min() == counts.max() else f"{counts.min()} to {largest}"


# --------------------------------------------------------------------------------------------------
# Planned pairs of a study, decided by the levels of the board.

OPPOSITE = {"better": "worse", "worse": "better"}
_ENDS = ("estimate", "low", "high")
_NEAR = 0.1  # distance from 1 that is shown in percent with digits of its own


def decide_planned(
    table: pd.DataFrame, looks: Mapping[str, MethodLook], options: ReportOptions
) -> list[Decision]:
    """Decide the planned pairs that share runs."""
    keys = ["family", "scenario", "regime", "seed", "run"]
    number = table.groupby(keys, sort=False, dropna=False, observed=True).ngroup()
    by_filter = {label: set(numbers) for label, numbers in number.groupby(table["filter"])}
    pairs = [(a, b) for a, b in plan_look_pairs(looks) if not by_filter[a].isdisjoint(by_filter[b])]
    if not pairs:
        return []
    groups = table["group"].unique()
    rule = main_rule(options.metric, groups[0] if len(groups) == 1 else "main")
    runs = table["seed"].map("{:012d}".format) + " " + table["run"].map("{:09d}".format)
    tidy = table.assign(run=runs, value=table[options.metric].fillna(math.inf))
    tidy = tidy[~(table[options.metric].isna() & table["keeps_track"])]
    return decide_planned_pairs(tidy, pairs, rule, options.decision_options)


def planned_words(planned: Sequence[Decision]) -> dict[tuple[str, str], str]:
    """Return the words of planned pairs for the verdict on the first filter against the second."""
    words = {}
    for d in planned:
        if d.question == "a" and d.metric != TRACK:
            words[d.a, d.b] = d.word
            words[d.b, d.a] = OPPOSITE.get(d.word, d.word)
    return {pair: {"better": "best"}.get(word, word) for pair, word in words.items()}


def planned_entries(
    planned: Sequence[Decision],
    table: pd.DataFrame,
    looks: Mapping[str, MethodLook],
    worlds: Mapping[str, PartName],
    options: ReportOptions,
) -> list[dict[str, Any]]:
    """List the entries of planned pairs, in ratios."""
    if not planned:
        return []
    errors = {(d.question, d.a, d.b): d for d in planned if d.metric != TRACK}
    tracks = {(d.question, d.a, d.b): d for d in planned if d.metric == TRACK}
    runs = arrange_runs(table, tuple(looks))
    levels = compute_condition_levels(runs, options.metric)
    entries = []
    for (question, a, b), d in errors.items():
        if question != "a":
            continue
        new = errors["b", a, b]
        records = [
            replace(record, a=f"[[{looks[a].name}]]", b=f"[[{looks[b].name}]]")
            for record in (tracks["a", a, b], d)
        ]
        entry = {
            "a": a, "b": b, "question": "Error in these worlds", "kind": _find_kind(looks[a], looks[b]),
            "sentence": describe_pair(*records), **_list_ratios(d), "p": round_values(d.p_corrected), "word": d.pair_word,
            "reason": _describe_gap(d, tracks["a", a, b]) or None, "cells": _list_cells(runs, levels, (a, b), worlds, options.alpha) if d.scale == "log ratio" else [],
            "new_world": None if new.worlds < 2 else {**_list_ratios(new), "word": new.word},
            "prediction": None if new.worlds < 3 else [_ratio(new, new.new_low), _ratio(new, new.new_high)],
            "won": _list_won(d, new, tracks["a", a, b]),
        }  # fmt: skip
        entries.append(entry)
    return entries


def _find_kind(method: MethodLook, baseline: MethodLook) -> str:
    """Return whether a baseline is of the paper or a tuned one; empty for neither."""
    if parse_label(baseline.key)[0] in method.baselines:
        return "paper"
    return "tuned" if method.baselines and baseline.tuning else ""


def _describe_gap(decision: Decision, track: Decision) -> str:
    """Return the reason of a missing ratio or interval, empty if the pair has both.

    Where tracks are not kept, it has the shares of runs won and of runs that keep track, short enough for
    the cell of a table.
    """
    if decision.reason == RUNS_WON:
        text = f"runs won: {describe_runs_won(decision)}; track kept: {describe_shares(track)}"
        for long, short in (("difference ", ""), ("percentage points", "points"), (" of runs", "")):
            text = text.replace(long, short)
        return text
    if decision.reason:
        return decision.reason
    if decision.scale == "log ratio":
        return ""
    return "a difference, which is no ratio"


def _list_cells(
    runs: StudyArrays,
    levels: ConditionEffects,
    pair: tuple[str, str],
    worlds: Mapping[str, PartName],
    alpha: float,
) -> list[dict[str, Any]]:
    """List the ratio of a pair in each scenario with its own interval; none for one scenario."""
    i, j = (runs.filters.index(label) for label in pair)
    scenarios = runs.conditions["scenario"]
    if scenarios.nunique() < 2:
        return []
    cells = []
    for scenario in scenarios.unique():
        mask = (scenarios == scenario).to_numpy()
        selected = ConditionEffects(*(array[:, mask] for array in levels))
        estimate = average_levels(selected, runs.conditions[mask]).difference(i, j)
        if np.isfinite(estimate.value):
            ends = (estimate.value, *estimate.interval(alpha))
            cells.append({
                "world": scenario, "regime": "all", "name": worlds[scenario].name,
                **dict(zip(_ENDS, (round_ratio(float(end)) for end in ends), strict=True)),
            })  # fmt: skip
    return cells


def round_ratio(log_ratio: float) -> float | None:
    """Return a ratio with four digits, and four of its distance from 1 if it is near; None without a number."""
    if not math.isfinite(log_ratio):
        return None
    distance = math.expm1(min(log_ratio, 700.0))
    if abs(distance) < _NEAR:
        return round(1 + float(f"{distance:.4g}"), 12)
    return float(f"{1 + distance:.4g}")


def _ratio(decision: Decision, value: float) -> float | None:
    """Return a log ratio as a ratio, None for an effect of another scale or an end that does not exist."""
    return round_ratio(value) if decision.scale == "log ratio" else None


def _list_ratios(decision: Decision) -> dict[str, float | None]:
    """Return the ratio of a decision and its interval."""
    return {name: _ratio(decision, getattr(decision, name)) for name in _ENDS}


def _list_won(decision: Decision, new: Decision, track: Decision) -> dict[str, Any] | None:
    """Return the difference of the shares of runs won in percentage points, and the shares of tracks kept.

    None for a pair that is decided by its errors.
    """
    if decision.reason != RUNS_WON:
        return None
    points, new_points = (
        dict(zip(_ENDS, (_round_points(v) for v in (d.estimate, d.high, d.low)), strict=True))
        for d in (decision, new)
    )
    has_new = new.worlds > 1 and new.scale == decision.scale
    return {
        **points, "track": [float(f"{share:.6g}") for share in (track.share_a, track.share_b)],
        "new_world": {**new_points, "word": new.word} if has_new else None,
    }  # fmt: skip


def _round_points(shares: float) -> float | None:
    """Return percentage points for the first filter, of an effect that is negative for it; None without a number."""
    return float(f"{-100 * shares:.6g}") if math.isfinite(shares) else None
