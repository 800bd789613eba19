"""Files of a study next to its page: decisions, consistency of the filters, and all metrics."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pfbench.config.paper_files import plan_installed_pairs
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.journal.headline import HEADLINE
from pfbench.report.options import ReportOptions
from pfbench.report.table_formats import format_csv
from pfbench.report.writers import write_json
from pfbench.results.conditions import Condition, natural_sort_key
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.filter_sets import order_filters
from pfbench.results.decisions.options import MetricRule
from pfbench.results.decisions.planned_pairs import decide_planned_pairs, decide_secondary_metrics
from pfbench.results.frame import list_main_groups
from pfbench.results.step_times import STEP_TIMES
from pfbench.results.study_decisions.common_conditions import select_common_runs
from pfbench.results.study_decisions.consistency_bands import decide_consistency
from pfbench.results.study_decisions.main_metrics import (
    RULES,
    main_rule,
    select_main_metrics,
    tidy_main,
    tidy_other_groups,
    tidy_secondary,
)

MAIN = "main group"  # if scenarios differ in it
_KEYS = ("scenario", "noise", "model", "label", "group", "component", "metric", "unit")


def write_study_files(
    table: pd.DataFrame,
    conditions: Sequence[Condition],
    options: ReportOptions,
    folder: RecordedFolder,
) -> list[dict[str, Any]]:
    """Write decisions.json, consistency.json, metrics.csv, and the times of `pfbench cost` if there are any.

    Args:
        table: Rows of `load_frame`.
        conditions: Conditions of the study.
        options: Options of the report.
        folder: Folder of the report.

    Returns:
        Entries of the downloads of the page.
    """
    mains = list_main_groups(conditions)
    names = set(mains.values())
    name = names.pop() if len(names) == 1 else MAIN
    others = tidy_other_groups(table, mains)
    decisions = decide_study(select_main_metrics(table, mains, name), name, options, others)
    bands = decide_consistency(table, options.decision_options)
    files = {
        "Decisions on all pairs (JSON)": write_json(folder, "decisions", decisions),
        "Bands of NEES and NIS (JSON)": write_json(folder, "consistency", bands),
        "All metrics, summarised over runs (CSV)": folder.write(
            "metrics.csv", format_csv(summarise_metrics(table))
        ).name,
    }
    times = conditions[0].jobs[0].path.parent / STEP_TIMES
    if times.is_file():
        files["Times per step by round (JSON)"] = folder.write(STEP_TIMES, times.read_bytes()).name
    return [
        {"name": title, "href": file, "bytes": (folder.path / file).stat().st_size, "group": "Numbers"}
        for title, file in files.items()
    ]  # fmt: skip


def list_figure_files(folder: Path) -> list[dict[str, Any]]:
    """List the files of figures of a report as downloads: the leaderboard, and figures of the papers.

    Args:
        folder: Folder of the report.

    Returns:
        Entries of the downloads of the page.
    """
    files = [folder / HEADLINE, *sorted((folder / "figures").glob("paper_*.*"))]
    names = {HEADLINE: "Error relative to the baseline"}
    return [
        {
            "name": f"{names.get(file.name) or file.stem.removeprefix('paper_').replace('_', ' ')} ({file.suffix[1:].upper()})",
            "href": file.relative_to(folder).as_posix(),
            "bytes": file.stat().st_size,
            "group": "Figures",
        }
        for file in files
        if file.is_file()
    ]


def decide_study(
    rows: pd.DataFrame,
    group: str,
    options: ReportOptions,
    others: Mapping[str, pd.DataFrame] | None = None,
) -> list[Decision]:
    """Decide planned pairs, the metrics of the second family, and the other pairs.

    Args:
        rows: Rows of `select_main_metrics`.
        group: Name of the main group in these rows.
        options: Options of the report.
        others: Tables of `tidy_other_groups`, None for none.
    """
    settings = options.decision_options
    rule, tidy = main_rule(options.metric, group), tidy_main(rows, options.metric, group)
    labels = sorted(tidy["filter"].unique(), key=natural_sort_key)
    pairs = [pair for pair in plan_installed_pairs(labels) if _share_condition(tidy, *pair)]
    planned = decide_planned_pairs(tidy, pairs, rule, settings) if pairs else []
    metrics = tidy_secondary(rows, group)
    metrics.pop(options.metric, None)
    rules = [replace(RULES[name], group=group) for name in metrics]
    rules += [MetricRule(f"{name} error", group=name) for name in others or {}]
    values = [*metrics.values(), *(others or {}).values()]
    tables = {rule.name: table for rule, table in zip(rules, values, strict=True)}
    secondary = decide_secondary_metrics(tables, pairs, rules, settings) if pairs else []
    common = select_common_runs(tidy)
    orders = order_filters(common, rule, settings, planned) if len(common) else ()
    return [
        *planned, *secondary, *(d for order in orders for d in order.decisions if d not in planned)
    ]  # fmt: skip


def summarise_metrics(table: pd.DataFrame) -> pd.DataFrame:
    """Summarise each metric and component of each filter over valid runs.

    Args:
        table: Rows of `load_frame`.

    Returns:
        A row per condition, filter, group, component and metric, with mean, root mean square and
        quantiles over the valid runs. NaN without a value.
    """
    keys = list(_KEYS)
    valid = table["value"].where(~table["lost"] & np.isfinite(table["value"]))
    grouped = table.assign(value=valid, square=valid**2).groupby(keys, sort=False)
    quantiles = grouped["value"].quantile(np.array([0.1, 0.5, 0.9])).unstack()
    summary = pd.DataFrame({
        "runs": grouped["value"].size(),
        "runs_with_value": grouped["value"].count(),
        "mean": grouped["value"].mean(),
        "root_mean_square": grouped["square"].mean().map(math.sqrt),
        "quantile_10": quantiles[0.1], "median": quantiles[0.5], "quantile_90": quantiles[0.9],
    })  # fmt: skip
    return summary.reset_index().rename(columns={"label": "filter"})


def _share_condition(tidy: pd.DataFrame, a: str, b: str) -> bool:
    """Return whether two filters have a condition in common."""
    conditions = [
        set(map(tuple, tidy.loc[tidy["filter"] == label, ["scenario", "regime"]].to_numpy()))
        for label in (a, b)
    ]
    return bool(conditions[0] & conditions[1])
