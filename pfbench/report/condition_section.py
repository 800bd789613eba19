"""Section of a condition: its figures, tables and decisions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pfbench.report import comparison_tables, cost, summary, tables, writers
from pfbench.report.options import ReportContext, select_line_styles
from pfbench.report.plots import calibration_plots, comparison_figures, condition_figures
from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.plotting import format_slug
from pfbench.report.provenance import distinct_values
from pfbench.results import coverage, store
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.comparison.pairwise_tests import compare_pairs
from pfbench.results.conditions import Condition, differing_settings
from pfbench.results.frame import drop_before, to_long_rows
from pfbench.results.state_groups import component_groups, select_main_group

PAIRS = 60  # pairs of a table at most


class _ConditionData(NamedTuple):
    """Results of a condition and what was computed from them.

    Attributes:
        full_results: Results by label, with all times.
        results: Results by label, from the start time on.
        runs: Rows of the runs, of the groups with truth.
        fronts: Accuracy and time of each group with truth.
        tests: Pairwise tests.
        main: Main group.
    """

    full_results: Mapping[str, store.JobResult]
    results: Mapping[str, store.JobResult]
    runs: pd.DataFrame
    fronts: Sequence[cost.ParetoFront]
    tests: Sequence[PairwiseTest]
    main: str


def write_condition_section(
    condition: Condition, context: ReportContext
) -> tuple[dict[str, Any], list[PairwiseTest], pd.DataFrame]:
    """Write the figures and tables of a condition.

    Args:
        condition: Condition.
        context: Context of the report.

    Returns:
        Template variables, pairwise tests, and rows of the runs.
    """
    options, folder = context.options, context.folder
    data = _load_condition(condition, context)
    key = (condition.scenario, condition.noise, condition.model)
    prefix, note = format_slug("_".join(key)), _format_note(condition)
    regions = coverage.compute_coverage(data.runs, options.alpha)
    groups = [_write_group(data, front, context, prefix, note) for front in data.fronts]
    overview = tables.overview_table(data.results, options.alpha)
    writers.write_table(folder, f"{prefix}_overview", overview, note)
    section = {
        "key": key,
        "budget": note,
        "name": condition.name,
        "anchor": prefix,
        "main": data.main,
        "overview": overview,
        "parts": [
            group | {"regions": coverage.format_coverage(regions, group["name"])}
            for group in groups
            if group
        ],
        "drawings": writers.render_figures(
            _list_figures(data, context), prefix, folder, options.figure_formats
        ),
        "unscored": _list_unscored(data, context.groups),
        "bounds": distinct_values(
            result.meta["pcrb"] for result in data.full_results.values() if "pcrb" in result.meta
        ),
        **summary.status_lists(data.results),
    }
    return section, list(data.tests), data.runs


def _load_condition(condition: Condition, context: ReportContext) -> _ConditionData:
    """Read the results of a condition and compare its filters."""
    options = context.options
    full_results = {job.label: job.load() for job in condition.jobs}
    results = {
        label: drop_before(result, options.start_time_s) for label, result in full_results.items()
    }
    rows = [
        to_long_rows(
            condition,
            job,
            full_results[job.label],
            options.start_time_s,
            options.convergence_threshold,
        )
        for job in condition.jobs
    ]
    runs = pd.concat(rows)
    groups = [group for group in context.groups if _has_scores(results, group)]
    fronts = [cost.pareto_front(condition.name, runs, group) for group in groups]
    # with the metrics of a job, and those of a state's group of mixed units
    names = {*groups, *(group.partition(" [")[0] for group in groups), ""}
    runs = runs[runs.group.isin(names)]
    tests = compare_pairs(runs, options.alpha, options.equivalence_margin, options.target_effect)
    main = select_main_group(groups)
    return _ConditionData(full_results, results, runs, fronts, tests, main)


def _format_note(condition: Condition) -> str:
    """Format the budget of the jobs, and the settings in which their data differ."""
    note = cost.format_budget([job.meta for job in condition.jobs])
    if settings := differing_settings(condition.jobs):
        note += (
            f" Jobs of this condition differ in {', '.join(settings)}: "
            "their runs share random numbers, but not the data."
        )
    return note


def _write_group(
    data: _ConditionData, front: cost.ParetoFront, context: ReportContext, prefix: str, note: str
) -> dict[str, Any]:
    """Write the tables of a group; return their template variables, none without results."""
    options, group = context.options, front.group
    tests = [v for v in data.tests if v.group == group]
    bound = options.convergence_threshold.get(group)
    accuracy = tables.accuracy_table(
        data.results, group, tests, options.alpha, bound, data.full_results
    )
    if not len(accuracy):
        return {}
    best = _order_by_rmse([front], group)[0]
    selection = [v for v in tests if best in (v.a, v.b)] if len(tests) > PAIRS else tests
    pairs = comparison_tables.decision_table(selection)
    effects = comparison_tables.effect_table(selection)
    is_full = group == data.main or not context.brief
    files = {"": accuracy, "_pairs": pairs, "_effects": effects}
    for suffix, table in files.items() if selection and is_full else [("", accuracy)]:
        name = f"{prefix}_{format_slug(group)}{suffix}"
        writers.write_table(context.folder, name, table, note)
    return {
        "name": group,
        "main": group == data.main,
        "chosen": selection,
        "best": best,
        "accuracy": accuracy if is_full else tables.short_accuracy_table(accuracy),
        "pairs": pairs,
        "effects": effects,
        **_summarise_tests(tests),
        "front": [
            label for label, on_front in zip(front.filters, front.on_front, strict=True) if on_front
        ],
    }


def _list_figures(data: _ConditionData, context: ReportContext) -> list[FigureSpec]:
    """List the figures of a condition, of the main group only in a brief report."""
    alpha, labels = context.options.alpha, list(data.full_results)
    fronts = [f for f in data.fronts if not context.brief or f.group == data.main]
    groups = [front.group for front in fronts]
    tests = [v for v in data.tests if v.group in groups]
    best_first = _order_by_rmse(data.fronts, data.main)
    style, note = select_line_styles(
        context, labels, best_first, f"the smallest median RMSE of {data.main}"
    )
    return [
        *condition_figures.condition_figures(
            data.full_results, data.runs, style, groups, alpha, brief=context.brief, note=note
        ),
        *calibration_plots.calibration_figures(data.results, groups, style, alpha, note),
        *comparison_figures.comparison_figures_of_condition(tests, fronts, style, note),
    ]


def _list_unscored(data: _ConditionData, groups: Sequence[str]) -> list[str]:
    """List the groups of the results without truth."""
    available = {
        block.group
        for result in data.results.values()
        for block in component_groups(result.meta["state"])
    }
    scored = {front.group for front in data.fronts}
    return [group for group in groups if group in available - scored]


def _order_by_rmse(fronts: Sequence[cost.ParetoFront], group: str) -> list[str]:
    """Order the filters of a group by median RMSE."""
    return [
        label
        for f in fronts
        if f.group == group
        for _, label in sorted(zip(f.rmse, f.filters, strict=True))
    ]


def _summarise_tests(tests: Sequence[PairwiseTest]) -> dict[str, Any]:
    """Summarise the comparisons of a group for the text."""
    runs = [v.needed for v in tests if math.isfinite(v.needed)]
    effects = [v.detectable for v in tests if math.isfinite(v.detectable)]
    pairs = [v.pairs for v in tests]
    return {
        "unbeaten": summary.list_top_group(tests),
        "shown": sum(v.winner != INCONCLUSIVE for v in tests),
        "equal": sum(v.equivalent for v in tests),
        "n": len(tests),
        "needed": (int(min(runs)), int(max(runs))) if runs else None,
        "detectable": (100 * min(effects), 100 * max(effects)) if effects else None,
        "had": (min(pairs), max(pairs)) if pairs else None,
    }


def _has_scores(results: Mapping[str, store.JobResult], group: str) -> bool:
    """Return whether a valid run has a truth for the group, or all runs are lost."""
    for result in results.values():
        error = result.data["error"][~result.data["lost"]]
        indices = [
            index
            for block in component_groups(result.meta["state"])
            if block.group == group
            for index in block.places
        ]
        if indices and (not len(error) or not np.isnan(error[..., indices]).all()):
            return True
    return False
