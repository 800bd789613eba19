"""All views of a study: metric, world, regime and baseline, each with its sentence and its rows."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.board.curves import CellKey
from pfbench.report.board.levels import (
    Selection,
    StudyArrays,
    arrange_runs,
    average_levels,
    compare_track_shares,
    compute_condition_levels,
)
from pfbench.report.board.pack_entries import (
    StudyNames,
    ViewKey,
    format_interval_level,
    list_metrics,
    round_values,
)
from pfbench.report.board.run_table import LOG_SCORE, METRIC_NAMES
from pfbench.report.board.sentence import count_failing, count_words, describe_view, name_lost_runs
from pfbench.report.board.view import Scope, ViewOptions, build_rows, describe_filters, show_row
from pfbench.report.journal.study_pack import ALL
from pfbench.report.options import ReportOptions
from pfbench.report.setting_names import describe_data_settings, describe_settings
from pfbench.report.tuning_words import count_tuned, describe_tuning
from pfbench.results.error_measures import Flags
from pfbench.results.statistics.paired_effects import ConditionEffects
from pfbench.results.step_times import StepTimes
from pfbench.results.study_decisions.common_conditions import select_conditions


def build_views(
    table: pd.DataFrame,
    names: StudyNames,
    options: ReportOptions,
    words: Mapping[tuple[str, str], str],
    times: Mapping[CellKey, Mapping[str, StepTimes]] | None = None,
) -> dict[ViewKey, dict[str, Any]]:
    """Build all views that have runs. The first one opens the page.

    Args:
        table: Table of `build_run_table`.
        names: Names of the parts.
        options: Options of the report.
        words: Words of planned pairs, which decide in the view of all conditions.
        times: Times in rounds by label, of each scenario and regime; None without any.
    """
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
