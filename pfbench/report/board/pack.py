"""Data of the page of a study: one dictionary, all numbers decided here."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import pandas as pd

from pfbench.report import provenance
from pfbench.report.board.curves import list_calibration, list_curves, list_runs
from pfbench.report.board.pack_entries import (
    cell_entries,
    describe_versions,
    filter_entry,
    list_metrics,
    metric_entries,
    planned_entries,
    planned_words,
    regime_entries,
    round_values,
)
from pfbench.report.board.run_table import METRIC_NAMES, build_run_table
from pfbench.report.board.sentence import count_words, describe_view
from pfbench.report.board.view import ViewOptions, build_rows
from pfbench.report.looks import (
    MethodLook,
    PartName,
    plan_look_pairs,
    study_looks,
    study_part_names,
)
from pfbench.report.options import ReportOptions
from pfbench.results.conditions import Condition
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.options import DecisionOptions
from pfbench.results.decisions.planned_pairs import decide_planned_pairs

ALL = "all"
_BASELINES = ("sir", "ekf", "ukf", "ckf")  # offered first if they are in the study
_MOST_BASELINES = 3


def build_pack(
    study: str,
    conditions: Sequence[Condition],
    options: ReportOptions,
    table: pd.DataFrame | None = None,
) -> dict[str, Any]:
    """Build the data of the page of a study.

    Args:
        study: Name of the study.
        conditions: Conditions of the study.
        options: Options of the report.
        table: Table of `build_run_table`, None to build it.

    Returns:
        Dictionary of plain values. None is a value that does not exist.
    """
    table = build_run_table(conditions, options.start_time_s) if table is None else table
    looks = study_looks(conditions)
    worlds = study_part_names(conditions, "scenario")
    regimes = study_part_names(conditions, "noise")
    planned = _decide_planned(table, looks, options)
    baselines = _select_baselines(looks)
    words = planned_words(planned)
    views = {
        f"{metric}/{w}/{r}/{baseline}": view
        for metric in list_metrics(table)
        for w in (ALL, *worlds)
        for r in (ALL, *table["regime"].unique())
        for baseline, view in _build_views(
            table, (metric, w, r), baselines, (looks, worlds, regimes), options, words
        ).items()
    }
    first = next(iter(views.values()))["rows"]
    return {
        "study": study,
        "title": study,
        "generated": describe_versions(conditions),
        "alpha": options.alpha,
        "filters": [filter_entry(looks[row["filter"]]) for row in first],
        "worlds": [asdict(name) for name in worlds.values()],
        "regimes": regime_entries(table, regimes),
        "cells": cell_entries(table),
        "metrics": metric_entries(table),
        "baselines": baselines,
        "budgets": [{"key": "particles", "name": "Same N", "reason_missing": None}],
        "views": views,
        "planned": planned_entries(planned, looks),
        "curves": list_curves(conditions),
        "calibration": list_calibration(table),
        "runs": list_runs(table),
        "replay": f"pfbench replay study={study} scenario={{world}} noise={{regime}} "
        "filter={filter} run={run}",
        "bibtex": provenance.format_bibtex(conditions),
        "provenance": [list(row) for row in provenance.list_shared_settings(conditions)],
    }


def _select_baselines(looks: Mapping[str, MethodLook]) -> list[str]:
    """Select the baselines that a reader may choose."""
    stated = [label for look in looks.values() for label in look.baselines]
    available = [label for label in (*_BASELINES, *stated) if label in looks]
    return list(dict.fromkeys(available))[:_MOST_BASELINES] or list(looks)[:1]


def _build_views(
    table: pd.DataFrame,
    scope: tuple[str, str, str],
    baselines: Sequence[str],
    names: tuple[Mapping[str, MethodLook], Mapping[str, PartName], Mapping[str, PartName]],
    options: ReportOptions,
    words: Mapping[tuple[str, str], str],
) -> dict[str, Any]:
    """Build the views of a metric, a world and a regime by baseline; none without runs."""
    metric, world, regime = scope
    looks, worlds, regimes = names
    rows = table[
        ((world == ALL) | (table["scenario"] == world))
        & ((regime == ALL) | (table["regime"] == regime))
    ]
    if rows.empty:
        return {}
    is_opening = (metric, world, regime) == ("rmse", ALL, ALL)
    view_options = ViewOptions(
        options.alpha, options.equivalence_margin, words if is_opening else None
    )
    where = f"in {count_words(rows['family'].nunique(), 'world')}"
    if rows["scenario"].nunique() == 1:
        where = f"in {worlds[rows['scenario'].iloc[0]].name}"
    if rows["regime"].nunique() == 1 and rows["regime"].iloc[0] in regimes:
        where += f" with {regimes[rows['regime'].iloc[0]].words}"
    name = f"{rows['group'].iloc[0]} {METRIC_NAMES[metric]}" if rows["group"].nunique() == 1 else METRIC_NAMES[metric]  # fmt: skip
    views = {}
    for baseline in baselines:
        built = build_rows(rows, metric, baseline, tuple(looks), view_options)
        views[baseline] = {
            "sentence": describe_view(built, looks, baseline, where, name),
            "small_print": _small_print(rows, options),
            "rows": [round_values(asdict(row)) for row in built],
        }
    return views


def _small_print(rows: pd.DataFrame, options: ReportOptions) -> str:
    """Describe the sample of a view and its intervals."""
    runs = rows.groupby(["filter", "scenario", "regime"]).size()
    seeds = rows["seed"].nunique()
    return (
        f"{count_words(rows['filter'].nunique(), 'filter')}, "
        f"{count_words(rows['family'].nunique(), 'world')}, "
        f"{count_words(rows['regime'].nunique(), 'noise regime')}, "
        f"{count_words(int(runs.max()), 'paired run')} per condition, {count_words(seeds, 'seed')}. "
        "Errors are trimmed means over runs on the logarithmic scale, averaged over conditions. "
        "Intervals of the ratio: 95 % each. "
        f"Verdicts against the best hold for all pairs together at {100 * (1 - options.alpha):g} %. "
        "They concern these worlds."
    )


def _decide_planned(
    table: pd.DataFrame, looks: Mapping[str, MethodLook], options: ReportOptions
) -> list[Decision]:
    """Decide the planned pairs that share runs."""
    keys = ["family", "scenario", "regime", "seed", "run"]
    by_filter = {label: pd.MultiIndex.from_frame(rows[keys]) for label, rows in table.groupby("filter")}  # fmt: skip
    pairs = [
        pair
        for pair in plan_look_pairs(looks)
        if len(by_filter[pair[0]].intersection(by_filter[pair[1]]))
    ]
    if not pairs:
        return []
    runs = table["seed"].map("{:012d}".format) + " " + table["run"].map("{:09d}".format)
    tidy = table.assign(run=runs, value=table["rmse"].fillna(math.inf))
    return decide_planned_pairs(
        tidy, pairs, options=DecisionOptions(options.alpha, options.equivalence_margin)
    )
