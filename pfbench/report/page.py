"""The report of a study: an offline page, its numbers, decisions and figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import cost, provenance, writers
from pfbench.report.board import build_pack, read_study
from pfbench.report.journal.headline import write_headline
from pfbench.report.looks import study_looks
from pfbench.report.options import ReportOptions
from pfbench.report.plots.paper import paper_figures
from pfbench.report.plots.plotting import line_styles
from pfbench.report.stored_page import write_page_data
from pfbench.report.study_files import list_figure_files, write_study_files
from pfbench.report.study_page import write_page
from pfbench.report.verdict_files import write_verdict_files
from pfbench.results.conditions import (
    Condition,
    load_conditions,
    natural_sort_key,
)
from pfbench.results.metrics import METRICS
from pfbench.results.state_groups import component_groups


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
        study: Name of the folder in `results`.
        results: Folder of all studies.
        out: Folder of all reports.
        options: Options of the report.

    Returns:
        Path of index.html.

    Raises:
        FileNotFoundError: If results of the study are missing.
        ValueError: If results cannot be compared, or a selected group or figure does not exist.
    """
    options = options or ReportOptions()
    conditions = load_conditions(study, results, allow_mixed_versions=options.allow_mixed_versions)
    _check_groups(conditions, options.convergence_threshold)
    labels = sorted({job.label for c in conditions for job in c.jobs}, key=natural_sort_key)
    style = line_styles(labels, study_looks(conditions))
    drawings = paper_figures.paper_figures(
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
        return write_page(pack, folder)


def list_job_settings(conditions: Sequence[Condition], planned: int | None) -> list[list[str]]:
    """Describe budget, PCRB, cost and training of the jobs.

    Args:
        conditions: Conditions of the study.
        planned: Number of jobs of the experiment, if known.

    Returns:
        Names and values, for the settings of the page.
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
