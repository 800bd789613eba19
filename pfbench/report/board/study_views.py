"""All views of a study: metric, world, regime and baseline, with sentence and rows; the order of each world."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.board.entries import (
    StudyFacts,
    ViewKey,
    format_interval_level,
    list_metrics,
    round_values,
)
from pfbench.report.board.view import (
    BoardRow,
    View,
    build_rows,
    describe_filters,
    describe_view,
    word_verdict,
)
from pfbench.report.journal.study_pack import ALL
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
from pfbench.results.metrics import page_metrics
from pfbench.results.step_times import StepTimes
from pfbench.stats.comparison import MIN_RUNS, NO_DECISION, Verdict, decide
from pfbench.stats.court import Court
from pfbench.stats.error_measures import Flags
from pfbench.stats.sentences import format_count
from pfbench.stats.study_runs import (
    StudyRuns,
    compare_filters,
    compute_losses,
    select_conditions,
    share_conditions,
)


def build_views(
    court: Court, groups: pd.DataFrame, facts: StudyFacts, baselines: Sequence[str]
) -> dict[ViewKey, dict[str, Any]]:
    """Build all views that have runs. The first one opens the page.

    Args:
        court: Court that decides the pairs of the study.
        groups: Unit and main group by scenario and regime.
        facts: Names, options and times of the study.
        baselines: Labels of the baselines.
    """
    scopes = [_make_view(court, scope, groups, facts) for scope in _list_scopes(court.runs.conditions)]  # fmt: skip
    views: dict[ViewKey, dict[str, Any]] = {}
    for metric in list_metrics(court.runs.values, facts.options.metric):
        for scope in scopes:
            has_unit = len(scope.groups) == 1 and page_metrics()[metric].is_of_group
            view = replace(
                scope, metric=metric, unit=scope.groups["unit"].iloc[0] if has_unit else ""
            )
            name = _name_metric(metric, scope.groups["group"])
            for baseline in baselines:
                rows = build_rows(view, baseline)
                views[ViewKey(metric, *view.scope, baseline)] = {
                    "sentence": describe_view(rows, facts.looks, baseline, view.where, name),
                    "small_print": view.small_print,
                    "rows": [_round_row(row, view.has_limit) for row in rows],
                }
    return views


def _make_view(
    court: Court, scope: tuple[str, str, Flags], groups: pd.DataFrame, facts: StudyFacts
) -> View:
    """Collect the data of a scope, and what is said of it whatever the metric."""
    world, regime, in_scope = scope
    mask = select_common(court.runs, in_scope)
    runs = court.runs.select(mask)
    keys = list(runs.conditions[["scenario", "regime"]].itertuples(index=False, name=None))
    times = [facts.times.get(key, {}) for key in keys]
    notes = _describe_common(mask, in_scope, len(runs.filters)) + _small_print(runs, facts)
    worlds = [facts.worlds.get(name) for name in runs.conditions["scenario"].unique()]
    return View(
        court, mask, "", "", describe_filters(runs, facts.options.alpha), times,
        all(name is None or name.limit is not None for name in worlds), (world, regime), groups.loc[keys],
        _describe_scope(runs.conditions, facts), f"{notes} {_describe_timing(runs, times, court.alpha)}".rstrip(),
    )  # fmt: skip


def _round_row(row: BoardRow, has_limit: bool) -> BoardRow:
    """Return the values of a row for the page: no track without a divergence threshold, an open interval as infinity.

    Pages print three digits. A number that was rounded to four before could have another third one than its sentence.
    """
    rounded: BoardRow = round_values(row if has_limit else {**row, "track": math.nan}, 8)
    return rounded | ({"ratio_high": math.inf} if row["ratio_high"] == math.inf else {})


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
    entry = page_metrics()[metric]
    is_one = groups.nunique() == 1 and entry.is_of_group
    return f"{groups.iloc[0]} {entry.page_name}" if is_one else entry.page_name


def select_common(runs: StudyRuns, mask: Flags) -> Flags:
    """Select the conditions of a scope in which its filters are compared; all if none is common."""
    common = select_conditions(runs.present.any(axis=2) & mask)
    return common if common.any() else mask


def _describe_common(mask: Flags, in_scope: Flags, filters: int) -> str:
    """State that filters are compared in a selection of the conditions; empty if in all."""
    if mask.sum() == in_scope.sum():
        return ""
    count = f"{mask.sum()} of {format_count(int(in_scope.sum()), 'condition')}"
    verb = "is" if mask.sum() == 1 else "are"
    return f"{count} {verb} compared: not all {filters} filters were run in the others. "


def _describe_scope(conditions: pd.DataFrame, names: StudyFacts) -> str:
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
    text = format_count(scenarios, "scenario")
    return text if scenarios == worlds else f"{text} of {format_count(worlds, 'world')}"


def _describe_timing(
    runs: StudyRuns, times: Sequence[Mapping[str, StepTimes]], alpha: float
) -> str:
    """Describe how the times per step of a view were measured."""
    if not all(set(runs.filters) <= set(by_label) for by_label in times):
        return "" if np.isnan(runs.values["ms"]).all() else "ms/step: one timing per job of all its runs, which other programs can change."  # fmt: skip
    rounds = sorted({t.seconds.size for by_label in times for t in by_label.values()})
    number = str(rounds[0]) if len(rounds) == 1 else f"{rounds[0]} to {rounds[-1]}"
    return (
        f"ms/step: of all runs of a job; median and quartiles of {number} rounds in which the filters took turns. "
        f"Ratio of the times paired by round, {format_interval_level(alpha)} interval."
    )


def _small_print(runs: StudyRuns, names: StudyFacts) -> str:
    """Describe the sample of a view, its tests, settings in names, and what was tuned."""
    filters = int(runs.present.any(axis=(1, 2)).sum())
    seeds = np.unique(runs.values["seed"][runs.present])
    texts = (
        describe_data_settings([*names.worlds, *names.regimes]),
        describe_settings(list(names.looks)),
        describe_tuning(count_tuned(names.looks), len(names.looks)),
    )
    sample = ", ".join((
        format_count(filters, "filter"), _count_worlds(runs.conditions),
        format_count(runs.conditions["regime"].nunique(), "noise regime"),
        _count_runs(runs, names.options.metric), format_count(len(seeds), "seed"),
    ))  # fmt: skip
    return (
        f"{sample}. Ratios are those of Hodges and Lehmann over paired runs, with simultaneous "
        f"{format_interval_level(names.options.alpha)} intervals; without one where more than a fifth of the pairs has a lost run. "
        f"Better and worse: Wilcoxon's test, the trimmed mean and the sign test agree. "
        f"A lost run is worse than every kept one. {' '.join(filter(None, texts))}"
    ).rstrip()


def _count_runs(runs: StudyRuns, metric: str) -> str:
    """Count the paired runs of a condition, as a range where conditions differ, and those without truth."""
    counts = (~np.isnan(compute_losses(runs, metric))).any(axis=0).sum(axis=1)
    total = int(runs.present.any(axis=0).sum())
    few = "" if counts.min() == counts.max() else f"{counts.min()} to "
    lacking = f" ({total - counts.sum()} of {total} runs have no truth)" * bool(
        counts.sum() < total
    )
    return f"{few}{format_count(int(counts.max()), 'paired run')} per condition{lacking}"


# --------------------------------------------------------------------------------------------------
# Pairs that a study compares in advance: each method with its own baselines.


def planned_entries(court: Court, facts: StudyFacts) -> list[dict[str, Any]]:
    """List the entries of the pairs that were compared in advance, in ratios, with each scenario and a new world."""
    looks, options = facts.looks, facts.options
    mask = select_everywhere(court.runs)
    runs = court.runs.select(mask)
    pairs = [pair for pair in plan_look_pairs(looks) if share_conditions(runs, *pair)]
    planned = [court.find(options.metric, mask, *pair) for pair in pairs]
    losses = compute_losses(runs, options.metric)
    new = decide(compare_filters(runs, losses, pairs, "world"), court.margin, court.alpha)
    return [
        {
            "a": v.a, "b": v.b, "kind": _find_kind(looks[v.a], looks[v.b]), "word": v.word, "reason": v.reason or None,
            "words": word_verdict(v, court.margin), **show_ratio(v), "p": round_values(v.p),
            "loses": v.lost.word, "cells": _list_cells(court, options.metric, (v.a, v.b), facts.worlds),
            "new_world": {**show_ratio(w), "word": w.word, "worlds": w.n} if w.n >= MIN_RUNS else None,
        }
        for v, w in zip(planned, new, strict=True)
    ]  # fmt: skip


_NO_VERDICT = Verdict("", "", NO_DECISION, math.nan, math.nan, math.nan, math.nan, 0)
DECISION_COLUMNS = ("world", "family", *_NO_VERDICT.to_row())  #: of the table of all pairs


def list_decisions(court: Court, metric: str) -> list[dict[str, Any]]:
    """List the verdicts on all pairs with their families: over all conditions, and in each of a few scenarios.

    Of a scenario with pairs of its own that are fixed in advance, these pairs are listed.
    """
    scenarios = court.runs.conditions["scenario"]
    is_few = 1 < scenarios.nunique() <= MOST_WORLDS  # whose page has the order of each world
    scopes = [(ALL, select_everywhere(court.runs))]
    if is_few or court.fixed_in:
        scopes += [(str(name), select_common(court.runs, (scenarios == name).to_numpy())) for name in scenarios.unique()]  # fmt: skip
    return [
        {"world": world, "family": family, **verdict.to_row()}
        for world, mask in scopes
        for family, verdict in court.list_verdicts(metric, mask, world == ALL or is_few)
    ]


def select_everywhere(runs: StudyRuns) -> Flags:
    """Select the conditions of the view that opens a page, [C]."""
    return select_common(runs, np.ones(len(runs.conditions), dtype=bool))


def _find_kind(method: MethodLook, baseline: MethodLook) -> str:
    """Return whether a baseline is of the paper or a tuned one; empty for neither."""
    if parse_label(baseline.key)[0] in method.baselines:
        return "paper"
    return "tuned" if method.baselines and baseline.tuning else ""


def _list_cells(
    court: Court, metric: str, pair: tuple[str, str], worlds: Mapping[str, PartName]
) -> list[dict[str, Any]]:
    """List the ratio of a pair in each scenario, of its view; none for one scenario."""
    scenarios = court.runs.conditions["scenario"]
    if scenarios.nunique() < 2:
        return []
    cells = []
    for scenario in scenarios.unique():
        mask = select_common(court.runs, (scenarios == scenario).to_numpy())
        verdict = court.find(metric, mask, *pair)
        if verdict.n:
            name = worlds[scenario].name
            cells.append({"world": scenario, "regime": "all", "name": name, **show_ratio(verdict)})
    return cells


_ENDS = ("estimate", "low", "high")
_NEAR = 0.1  # distance from 1 that is shown in percent with digits of its own


def round_ratio(log_ratio: float) -> float | None:
    """Return a ratio with four digits, and four of its distance from 1 if it is near; None without a number."""
    if not math.isfinite(log_ratio):
        return None
    distance = math.expm1(min(log_ratio, 700.0))
    if abs(distance) < _NEAR:
        return round(1 + float(f"{distance:.4g}"), 12)
    return float(f"{1 + distance:.4g}")


def show_ratio(verdict: Verdict) -> dict[str, float | None]:
    """Return the ratio of a verdict and its interval."""
    logs = (math.log(v) if v > 0 else -math.inf for v in (verdict.ratio, verdict.low, verdict.high))
    ends = dict(zip(_ENDS, map(round_ratio, logs), strict=True))
    return ends | ({"high": math.inf} if verdict.high == math.inf and verdict.low > 0 else {})


# --------------------------------------------------------------------------------------------------
# Orders of the filters in each world of a study of few worlds, whose average over worlds is the answer of none of them.

MOST_WORLDS = 3  # more worlds have a page of their own, or an average


def order_worlds(
    court: Court, views: Mapping[ViewKey, Mapping[str, Any]], facts: StudyFacts
) -> list[dict[str, Any]]:
    """Describe the order of each world: its sentence, its first filter, and the filters that do as well.

    Empty unless the study has two or three worlds, each one scenario, in one noise regime.
    """
    conditions = court.runs.conditions
    worlds = list(conditions["scenario"].unique())
    is_few = 1 < len(worlds) <= MOST_WORLDS and conditions["family"].nunique() == len(worlds)
    if not is_few or conditions["regime"].nunique() > 1:
        return []
    baseline, orders = next(iter(views)).baseline, []
    for world in worlds:
        view = views[ViewKey(facts.options.metric, world, ALL, baseline)]
        labels = [row["filter"] for row in view["rows"] if row["rank"] is not None]
        mask = select_common(court.runs, (conditions["scenario"] == world).to_numpy())
        verdicts = [
            court.find(facts.options.metric, mask, label, labels[0]) for label in labels[1:]
        ]
        ties = [v.a for v in verdicts if v.word != "worse"]
        is_said = not ties and labels[0] == baseline  # by the sentence of the view
        text = "" if is_said else _describe_ties(labels[0], ties, len(verdicts), facts.looks)
        orders.append({"world": world, "sentence": f"{view['sentence']} {text}".rstrip()})
    return orders


def _describe_ties(
    best: str, ties: Sequence[str], others: int, looks: Mapping[str, MethodLook]
) -> str:
    """Say which filters are not shown to be worse than the first one of a world."""
    first = f"[[{looks[best].name}]]"
    if not ties:
        return f"All others are worse than {first}." if others else ""
    names = ", ".join(f"[[{looks[label].name}]]" for label in ties)
    verb = "is" if len(ties) == 1 else "are"
    end = "" if len(ties) == others else " All others are."
    return f"{names} {verb} not shown to be worse than {first}, the first of this world.{end}"
