"""The report of a study in three passes: load the results, decide, and write a dictionary of files once."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pfbench.files.recorded_folder import RecordedFolder, find_published_file
from pfbench.report import provenance, writers
from pfbench.report.board.entries import StudyFacts, ViewKey
from pfbench.report.board.pack import (
    DECISION_COLUMNS,
    StudyData,
    build_pack,
    open_court,
    read_study,
)
from pfbench.report.journal.ratio_figures import HEADLINE, render_headline
from pfbench.report.options import ReportOptions
from pfbench.report.overview.page import BOARD_PAGE, choose_level, render_overview
from pfbench.report.overview.tables import (
    AT_HOME,
    FEWEST_WORLDS,
    WITH_KNOBS,
    Overview,
    TabKey,
    add_levels,
    build_overviews,
    has_overview,
)
from pfbench.report.papers import figures
from pfbench.report.provenance import renew_bibliography
from pfbench.report.stored_study import RUNS_FILE, format_runs, read_stored_study, round_runs
from pfbench.report.study_page.page_writer import render_page
from pfbench.report.writers import format_csv
from pfbench.results.conditions import (
    Condition,
    component_groups,
    load_conditions,
)
from pfbench.results.metrics import METRICS
from pfbench.results.paper_block import name_run_command
from pfbench.results.step_times import STEP_TIMES
from pfbench.stats.consistency_bands import assess_consistency

Files = dict[str, str | bytes]
_SUMMARISED = ("scenario", "noise", "model", "label", "group", "component", "metric", "unit")
# group and title of the files that a page offers
_TITLES = {
    "verdicts.csv": ("Numbers", "Verdicts of all views (CSV)"),
    "decisions.csv": ("Numbers", "Verdicts on all pairs (CSV)"),
    RUNS_FILE: ("Numbers", "Values of all runs (Parquet)"),
    "metrics.csv": ("Numbers", "All metrics, summarised over runs (CSV)"),
    "consistency.csv": ("Numbers", "NEES and NIS over their expectation (CSV)"),
    STEP_TIMES: ("Numbers", "Times per step by round (JSON)"),
    "pfbench.bib": ("LaTeX", "References (BibTeX)"),
    HEADLINE: ("Figures", "Error relative to the baseline (SVG)"),
}


def write_report(
    study: str,
    results: str | Path = "results",
    out: str | Path = "reports",
    options: ReportOptions | None = None,
) -> Path:
    """Write the report of a study to `<out>/<study>/`.

    The folder has the page (index.html, report.md), its numbers (verdicts.csv, decisions.csv, metrics.csv,
    consistency.csv), the runs with all that a page needs (runs.parquet), pfbench.bib, headline.svg, and the figures of
    the papers. Equal results give equal bytes. Files that an earlier report wrote are removed if this one does not
    write them and they are unchanged (manifest.json). Other files stay.

    Args:
        study: Name of the study.
        results: Folder of all results.
        out: Folder of all reports.
        options: Options of the report, None for the defaults.

    Returns:
        Path of index.html.
    """
    options = options or ReportOptions()
    pack, data, files = read_results(study, results, options, options.figure_formats)
    files |= {
        "metrics.csv": format_csv(summarise_metrics(data.metrics)),
        "consistency.csv": format_csv(assess_consistency(data.metrics, options.alpha)),
        RUNS_FILE: format_runs(data.table, pack),
    }
    times = Path(results) / study / STEP_TIMES
    if times.is_file():
        files[STEP_TIMES] = times.read_bytes()
    with RecordedFolder(Path(out) / study) as folder:
        return _write_all(folder, {**files, **render_study(pack, data.table, folder.path, files)})


def read_results(
    study: str, results: str | Path, options: ReportOptions, formats: Sequence[str]
) -> tuple[dict[str, Any], StudyData, Files]:
    """Read the results of a study, decide them, and draw the figures of its paper.

    Args:
        study: Name of the study.
        results: Folder of all results.
        options: Options of the report.
        formats: Formats of the figures.

    Returns:
        Data of the page, tables of the results, and figures by file name.
    """
    conditions = load_conditions(study, results, allow_mixed_versions=options.allow_mixed_versions)
    _check_groups(conditions, options.convergence_threshold)
    data = read_study(conditions, options, has_metrics=True)
    data = data._replace(table=round_runs(data.table))
    pack = build_pack(study, conditions, options, data)
    pack["provenance"] += list_job_settings(conditions, options.planned)
    pack["definitions"] = [(metric.name, metric.caption) for metric in METRICS]
    pack["paper_figures"], files = _draw_paper_figures(study, conditions, options, formats)
    return pack, data, files


def rebuild_page(folder: Path) -> Path:
    """Write the page of a study again, from the file of its runs, which does not change.

    Args:
        folder: Folder of the report.

    Returns:
        Path of index.html.

    Raises:
        ValueError: If the file is damaged.
    """
    pack, table = read_stored_study(folder)
    pack["bibtex"] = renew_bibliography(pack)
    pack["replay_first"] = name_run_command(str(pack["study"]))
    pack["paper_figures"] = [
        {**entry, "source": _embed(entry, (folder / entry["file"]).read_bytes())}
        for entry in pack["paper_figures"]
    ]
    others = {name: (folder / name).read_bytes() for name in _TITLES if (folder / name).is_file()}
    others |= {f"figures/{path.name}": path.read_bytes() for path in (folder / "figures").glob("paper_*.*") if path.is_file()}  # fmt: skip
    with RecordedFolder(folder, is_complete=False) as target:
        return _write_all(target, render_study(pack, table, folder, others))


def render_study(
    pack: dict[str, Any], table: pd.DataFrame, folder: Path, others: Mapping[str, str | bytes]
) -> Files:
    """Render all files of a study that follow from its runs: page, tables, references and figures.

    Args:
        pack: Data of the page.
        table: Values of all runs.
        folder: Folder of the report, whose headline figure stays if it is equal.
        others: Other files of the folder, which the page offers.
    """
    stored = (folder / HEADLINE).read_bytes() if (folder / HEADLINE).is_file() else b""
    headline = render_headline(pack, stored)
    pack["headline"] = "Error of each filter relative to the baseline" if headline else ""
    if headline and (orders := pack.get("world_orders")):
        pack["headline"] += ", in each world"
        pack["world_pictures"] = [
            writers.format_data_address("svg", render_headline({**pack, "world_orders": [order]}))
            for order in orders
        ]
    files: Files = {
        "verdicts.csv": format_verdicts(pack),
        "decisions.csv": format_csv(
            pd.DataFrame(pack["decisions"], columns=list(DECISION_COLUMNS))
        ),
        "pfbench.bib": pack["bibtex"],
        **({HEADLINE: headline} if headline else {}),
    }
    pack["downloads"] = list_downloads({**others, **files})
    overviews = find_overviews(pack, table)
    if overviews is None:
        return files | render_page(pack)
    home = collect_home(str(pack["facts"]["options"].get("home", "")))
    return files | render_page(pack, BOARD_PAGE) | render_overview({**overviews, **home}, pack)


def find_overviews(pack: Mapping[str, Any], table: pd.DataFrame) -> dict[TabKey, Overview] | None:
    """Collect the first page of a study with several proposed methods in several worlds, from the court of the study.

    Args:
        pack: Data of the page.
        table: Runs of the study.

    Returns:
        Tables of the page by number of particles, at equal time and as printed; None for other studies.
    """
    facts = StudyFacts.from_pack(pack)
    if not has_overview(table, facts.looks):
        return None
    table = add_levels(table, facts.looks)
    court = open_court(table, facts.looks, facts.options)
    overviews = build_overviews(table, facts.looks, facts.worlds, court)
    enough = all(len(overview.worlds) >= FEWEST_WORLDS for overview in overviews.values())
    return overviews if enough else None  # without references of worlds there is nothing to show


def collect_home(study: str) -> dict[TabKey, Overview]:
    """Collect the table of a published study of the methods in the worlds of their papers: of tuned forms, if it has some; none without it."""
    path = find_published_file(f"{study}/{RUNS_FILE}")
    if path is None:
        return {}
    tables = find_overviews(*read_stored_study(path.parent, decides=False)) or {}
    return {AT_HOME: tables.get(WITH_KNOBS, tables[choose_level(tables)])} if tables else {}


def format_verdicts(pack: Mapping[str, Any]) -> str:
    """Format all rows of all views as CSV."""
    rows = [
        {**dict(zip(ViewKey._fields, key, strict=True)), **row}
        for key, view in pack["views"].items()
        for row in view["rows"]
    ]
    return format_csv(pd.DataFrame(rows))


def list_downloads(files: Mapping[str, str | bytes]) -> list[dict[str, Any]]:
    """List files as downloads of the page, whatever the order in which they were made."""
    entries = []
    for name in (*(n for n in _TITLES if n in files), *sorted(files.keys() - _TITLES.keys())):
        content, path = files[name], Path(name)
        figure = f"{path.stem.removeprefix('paper_').replace('_', ' ')} ({path.suffix[1:].upper()})"
        group, title = _TITLES.get(name, ("Figures", figure))
        size = len(content.encode() if isinstance(content, str) else content)
        entries.append({"name": title, "href": name, "bytes": size, "group": group})
    return entries


def list_job_settings(conditions: Sequence[Condition], planned: int | None) -> list[list[str]]:
    """Describe budget, PCRB, cost and training of the jobs.

    Returns names and values, for the settings of the page.
    """
    metadata = [job.meta for condition in conditions for job in condition.jobs]
    bounds = [meta["pcrb"] for meta in metadata if "pcrb" in meta]
    rows = [
        ("budget", provenance.format_budget(metadata).removeprefix("Budget: ")),
        *(("PCRB", text) for text in provenance.distinct_values(bounds)),
        *provenance.compute_cost(metadata, planned),
        *provenance.training_cost(conditions),
    ]
    return [list(row) for row in rows]


def summarise_metrics(table: pd.DataFrame) -> pd.DataFrame:
    """Summarise each metric and component of each filter over valid runs.

    Returns a row per condition, filter, group, component and metric, with mean, root mean square
    and quantiles over the valid runs. NaN without a value.
    """
    keys = list(_SUMMARISED)
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


def _draw_paper_figures(
    study: str, conditions: Sequence[Condition], options: ReportOptions, formats: Sequence[str]
) -> tuple[list[dict[str, Any]], Files]:
    """Draw the figures of the paper of a study; return template variables and files."""
    pairs = figures.paper_figures(study, conditions, options.paper_figures, options.start_time_s)
    entries, files = writers.render_figures([drawing for _, drawing in pairs], "paper", formats)
    for (name, _), entry in zip(pairs, entries, strict=True):
        entry |= {"entry": name, "source": _embed(entry, files[entry["file"]])}
    return entries, dict(files)


def _embed(entry: Mapping[str, Any], content: bytes) -> str:
    """Return the figure that a page shows: the file that is stored."""
    return writers.format_data_address(Path(entry["file"]).suffix, content)


def _write_all(folder: RecordedFolder, files: Files) -> Path:
    """Write files to a folder; return the path of the page."""
    for name, content in files.items():
        folder.write(name, content)
    return folder.path / "index.html"


def _check_groups(conditions: Sequence[Condition], thresholds: Mapping[str, float]) -> None:
    """Check that the groups with a convergence threshold exist."""
    states = [job.meta["state"] for condition in conditions for job in condition.jobs]
    available = sorted({block.group for state in states for block in component_groups(state)})
    if unknown := sorted(set(thresholds) - set(available)):
        raise ValueError(
            "report.convergence_threshold must name groups of the results, "
            f"got {', '.join(unknown)}. Choose from {', '.join(available)}."
        )
