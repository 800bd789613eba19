"""The report of a study: an offline page, its data as a file, decisions, verdicts and figures."""

from __future__ import annotations

import gzip
import io
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa

from pfbench.files import limits
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.files.table_file import check_parquet
from pfbench.report import cost, provenance, writers
from pfbench.report.board import build_pack, read_study
from pfbench.report.board.entries import ViewKey
from pfbench.report.board.pack import StudyFacts, decide_parts
from pfbench.report.journal.ratio_figures import HEADLINE, write_headline
from pfbench.report.methods_text import MethodsFacts
from pfbench.report.options import ReportOptions
from pfbench.report.overview.page import BOARD_PAGE, write_overview
from pfbench.report.overview.tables import (
    FEWEST_WORLDS,
    Overview,
    build_overviews,
    has_overview,
)
from pfbench.report.papers import figures
from pfbench.report.provenance import renew_bibliography
from pfbench.report.study_page import write_page
from pfbench.report.writers import format_csv, write_json
from pfbench.results.conditions import (
    Condition,
    component_groups,
    load_conditions,
)
from pfbench.results.frame import list_main_groups
from pfbench.results.looks import study_looks
from pfbench.results.metrics import METRICS
from pfbench.results.paper_block import name_run_command, plan_installed_pairs
from pfbench.results.plotting import line_styles
from pfbench.results.step_times import STEP_TIMES
from pfbench.stats.consistency_bands import decide_consistency
from pfbench.stats.decision import Decision, MetricRule
from pfbench.stats.filter_sets import order_filters
from pfbench.stats.main_metrics import (
    RULES,
    main_rule,
    select_common_runs,
    select_main_metrics,
    tidy_main,
    tidy_other_groups,
    tidy_secondary,
)
from pfbench.stats.planned_pairs import decide_planned_pairs, decide_secondary_metrics
from pfbench.stats.study_runs import natural_sort_key

# --------------------------------------------------------------------------------------------------
# The report of a study: an offline page, its numbers, decisions and figures.


def write_report(
    study: str,
    results: str | Path = "results",
    out: str | Path = "reports",
    options: ReportOptions | None = None,
) -> Path:
    """Write the report of a study to `<out>/<study>/`.

    The folder contains the page (index.html, report.md) with its numbers (verdicts.csv, runs.parquet,
    metrics.csv, page.json.gz), decisions.json, consistency.json, pfbench.bib, headline.svg, and the figures of the papers. Equal
    results give equal bytes. Files that an earlier report wrote are removed if this one does not write
    them and they are unchanged (manifest.json). Other files stay.

    Args:
        study: Name of the study.
        results: Folder of all results.
        out: Folder of all reports.
        options: Options of the report. None for the defaults.

    Returns:
        Path of index.html.
    """
    options = options or ReportOptions()
    conditions = load_conditions(study, results, allow_mixed_versions=options.allow_mixed_versions)
    _check_groups(conditions, options.convergence_threshold)
    labels = sorted({job.label for c in conditions for job in c.jobs}, key=natural_sort_key)
    style = line_styles(labels, study_looks(conditions))
    drawings = figures.paper_figures(
        study, conditions, style, options.paper_figures, options.start_time_s
    )
    data = read_study(conditions, options, has_metrics=True)
    pack = build_pack(study, conditions, options, data)
    with RecordedFolder(Path(out) / study) as folder:
        pack["downloads"] = write_verdict_files(pack, data.table, folder)
        pack["downloads"] += write_study_files(data.metrics, conditions, options, folder)
        pack["provenance"] += list_job_settings(conditions, options.planned)
        pack |= {
            "paper_figures": writers.render_figures(
                drawings, "paper", folder, options.figure_formats
            ),
            "definitions": [(metric.name, metric.caption) for metric in METRICS],
        }
        write_page_data(pack, folder)
        write_headline(pack, folder)
        pack["downloads"] += list_figure_files(folder.path)
        return write_pages(pack, data.table, folder)


def write_pages(
    pack: Mapping[str, Any], table: pd.DataFrame | None, folder: RecordedFolder
) -> Path:
    """Write the page of a study; one with several proposed methods in several worlds has a page before it."""
    overviews = find_overviews(pack, table)
    if overviews is None:
        return write_page(pack, folder)
    write_page(pack, folder, BOARD_PAGE)
    return write_overview(overviews, pack, folder)


def find_overviews(
    pack: Mapping[str, Any], table: pd.DataFrame | None
) -> dict[int, Overview] | None:
    """Decide the first page of a study with several proposed methods in several worlds.

    Args:
        pack: Data of the page.
        table: Runs of the study, None if they are not there.

    Returns:
        Tables of the page by number of particles; None for other studies.
    """
    facts = StudyFacts.from_pack(pack)
    if table is None or not has_overview(table, facts.looks):
        return None
    overviews = build_overviews(table, facts.looks, facts.worlds)
    enough = all(len(overview.worlds) >= FEWEST_WORLDS for overview in overviews.values())
    return overviews if enough else None  # without references of worlds there is nothing to show


def list_job_settings(conditions: Sequence[Condition], planned: int | None) -> list[list[str]]:
    """Describe budget, PCRB, cost and training of the jobs.

    Returns names and values, for the settings of the page.
    """
    budget = cost.format_budget([job.meta for condition in conditions for job in condition.jobs])
    rows = [("budget", budget.removeprefix("Budget: "))]
    bounds = [job.meta["pcrb"] for c in conditions for job in c.jobs if "pcrb" in job.meta]
    rows += [("PCRB", text) for text in provenance.distinct_values(bounds)]
    rows += provenance.compute_cost(conditions, planned)
    rows += provenance.training_cost(conditions)
    return [list(row) for row in rows]


def _check_groups(conditions: Sequence[Condition], thresholds: Mapping[str, float]) -> None:
    """Check that the groups with a convergence threshold exist."""
    states = [job.meta["state"] for condition in conditions for job in condition.jobs]
    available = sorted({block.group for state in states for block in component_groups(state)})
    if unknown := sorted(set(thresholds) - set(available)):
        raise ValueError(
            "report.convergence_threshold must name groups of the results, "
            f"got {', '.join(unknown)}. Choose from {', '.join(available)}."
        )


# --------------------------------------------------------------------------------------------------
# Files of a study next to its page: decisions, consistency of the filters, and all metrics.

MAIN = "main group"  # if scenarios differ in it
_KEYS = ("scenario", "noise", "model", "label", "group", "component", "metric", "unit")


def write_study_files(
    table: pd.DataFrame,
    conditions: Sequence[Condition],
    options: ReportOptions,
    folder: RecordedFolder,
) -> list[dict[str, Any]]:
    """Write decisions.json, consistency.json, metrics.csv, and the times of `pfbench cost` if there are any.

    Returns entries of the downloads of the page.
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

    Returns entries of the downloads of the page.
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
    """Decide planned pairs, the metrics of the second family, and the other pairs."""
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

    Returns a row per condition, filter, group, component and metric, with mean, root mean square
    and quantiles over the valid runs. NaN without a value.
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


# --------------------------------------------------------------------------------------------------
# Files next to the page: verdicts.csv with all that the board shows, runs.parquet and pfbench.bib.


def write_verdict_files(
    pack: Mapping[str, Any], table: pd.DataFrame, folder: RecordedFolder
) -> list[dict[str, Any]]:
    """Write verdicts.csv, runs.parquet and pfbench.bib.

    Returns entries of the downloads of the page.
    """
    buffer = io.BytesIO()
    table.to_parquet(buffer, index=False, compression="zstd")
    contents: list[tuple[str, str, str, str | bytes]] = [
        ("Numbers", "Verdicts of all views (CSV)", "verdicts.csv", format_verdicts(pack)),
        ("Numbers", "Values of all runs (Parquet)", "runs.parquet", buffer.getvalue()),
        ("LaTeX", "References (BibTeX)", "pfbench.bib", pack["bibtex"]),
    ]
    downloads = []
    for group, title, name, content in contents:
        size = folder.write(name, content).stat().st_size
        downloads.append({"name": title, "href": name, "bytes": size, "group": group})
    return downloads


def format_verdicts(pack: Mapping[str, Any]) -> str:
    """Format all rows of all views as CSV."""
    rows = [
        {**dict(zip(ViewKey._fields, key, strict=True)), **row}
        for key, view in pack["views"].items()
        for row in view["rows"]
    ]
    return format_csv(pd.DataFrame(rows))


# --------------------------------------------------------------------------------------------------
# Data of a page as a file, from which the page is written again where the results are missing.
#
# All that follows from the runs is decided again from runs.parquet, so that a published page has the
# rules and the words of the program. Times per step and curves are those of the file.

PAGE_DATA = "page.json.gz"
_OMITTED: dict[str, Any] = {"paper_figures": [], "tracks": {}}  # too large; they need the results
_KEYED = ("views", "curves", "calibration", "runs")  # parts with a tuple as key


def write_page_data(pack: Mapping[str, Any], folder: RecordedFolder) -> None:
    """Write the data of a page, without tracks of single runs and figures of the papers.

    Args:
        pack: Data of the page.
        folder: Folder of the report.
    """
    keyed = {
        name: {"keys": [list(key) for key in pack[name]], "values": list(pack[name].values())}
        for name in _KEYED
    }
    text = json.dumps({**pack, **_OMITTED, **keyed}, separators=(",", ":"), allow_nan=False)
    folder.write(PAGE_DATA, gzip.compress(text.encode(), mtime=0))


def read_page_data(folder: Path) -> dict[str, Any]:
    """Read the data of a page.

    Args:
        folder: Folder of the report.

    Raises:
        ValueError: If the file is damaged, or lacks facts of the methods paragraph.
    """
    path = folder / PAGE_DATA
    try:
        pack: dict[str, Any] = json.loads(limits.read_gzip(path))
        pack["facts"]["looks"]  # a file of an early version has none
        for name in _KEYED:
            keys = [tuple(key) for key in pack[name]["keys"]]
            pack[name] = dict(zip(keys, pack[name]["values"], strict=True))
    except limits.LimitError:
        raise
    except (OSError, EOFError, ValueError, TypeError, KeyError) as error:
        raise ValueError(
            f"{path} must be the data of a page, got {error}. Run the study and write its report again."
        ) from error
    MethodsFacts.from_entries(pack.get("methods"), str(path))
    return pack


def decide_again(pack: Mapping[str, Any], runs: Path) -> dict[str, Any]:
    """Decide the parts of a page again from the runs of a study."""
    try:
        check_parquet(runs)
        table = pd.read_parquet(runs)
        missing = {look["key"] for look in pack["facts"]["looks"]} - set(table["filter"])
        parts = {} if missing else decide_parts(table, StudyFacts.from_pack(pack))
    except (OSError, KeyError, TypeError, ValueError, pa.ArrowException) as error:
        raise ValueError(
            f"{runs} must have the runs of the page in its folder, got {error}. "
            "Run the study and write its report again."
        ) from error
    if missing:
        raise ValueError(
            f"{runs} must have runs of all filters of the page, got none of "
            f"{', '.join(sorted(missing))}. Run the study and write its report again."
        )
    return {**pack, **parts}


def rebuild_page(folder: Path) -> Path:
    """Write the page of a study again, from the data of the page and from its runs if they are there.

    Files that are missing are not offered.

    Args:
        folder: Folder of the report.

    Returns:
        Path of index.html.

    Raises:
        ValueError: If a file is damaged.
    """
    pack, runs = read_page_data(folder), folder / "runs.parquet"
    if has_runs := runs.is_file():
        pack = decide_again(pack, runs)
    table = pd.read_parquet(runs) if has_runs else None
    pack["bibtex"] = renew_bibliography(pack)
    with RecordedFolder(folder, is_complete=False) as target:
        if has_runs:
            target.write("verdicts.csv", format_verdicts(pack))
            write_page_data(pack, target)
        pack["replay_first"] = name_run_command(str(pack["study"]))
        stored = [d for d in pack["downloads"] if (folder / d["href"]).is_file()]
        pack["downloads"] = stored + list_figure_files(folder)
        return write_pages(pack, table, target)
