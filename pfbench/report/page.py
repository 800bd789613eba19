"""The report of a study: an offline page, all details, figures, tables and decisions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import pandas as pd
from tqdm import tqdm

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import comparison_tables, cost, provenance, writers
from pfbench.report.across_section import write_comparison
from pfbench.report.board import write_report_data
from pfbench.report.condition_section import write_condition_section
from pfbench.report.looks import study_looks
from pfbench.report.options import ReportContext, ReportOptions, is_brief, order_by_highlight
from pfbench.report.plots.paper import paper_figures
from pfbench.report.plots.plotting import line_styles
from pfbench.report.study_page import write_page
from pfbench.results import store
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.comparison.pairwise_tests import correct_over_report
from pfbench.results.conditions import Condition, load_conditions, natural_sort_key
from pfbench.results.metrics import metric_definitions
from pfbench.results.state_groups import component_groups

_DETAILS = ("details.md", "details.html")
_ROWS = 2000  # rows of the table of all comparisons at most


def write_report(
    study: str,
    results: str | Path = "results",
    out: str | Path = "reports",
    options: ReportOptions | None = None,
) -> Path:
    """Write the report of a study to `<out>/<study>/`.

    The folder contains the page (index.html, report.md) with its numbers (verdicts.csv, runs.parquet),
    all figures and tables (details.html, details.md, figures/, tables/), verdicts.json, decisions.json
    and pfbench.bib. Equal results give equal bytes. Files that an earlier report wrote are removed if this one
    does not write them and they are unchanged (manifest.json). Other files stay.

    Args:
        study: Name of the folder in `results`.
        results: Folder of all studies.
        out: Folder of all reports.
        options: Options of the report.

    Returns:
        Path of index.html.

    Raises:
        FileNotFoundError: If results of the study are missing.
        ValueError: If results do not belong together, or no result has a selected group, filter or figure.
    """
    options = options or ReportOptions()
    conditions = load_conditions(study, results, allow_mixed_versions=options.allow_mixed_versions)
    with RecordedFolder(Path(out) / study) as folder:
        context = _make_context(conditions, folder, options)
        drawings = paper_figures.paper_figures(
            study, conditions, context.style, options.paper_figures, options.start_time_s
        )
        variables = _write_parts(study, conditions, context)
        variables |= {
            "paper": writers.render_figures(drawings, "paper", folder, options.figure_formats),
            "failures": store.list_failures(Path(results) / study),
        }
        writers.render_template("page", folder, variables, names=_DETAILS)
        pack = write_report_data(study, conditions, options, folder)
        pack["downloads"].append(_describe_details(folder))
        _state_failures(pack, len(variables["failures"]))
        return write_page(pack, folder)


def _state_failures(pack: dict[str, Any], number: int) -> None:
    """Put the number of failed jobs before the sentence of each view."""
    jobs = "1 job failed and is" if number == 1 else f"{number} jobs failed and are"
    for view in pack["views"].values() if number else ():
        view["sentence"] = f"{jobs} missing from all tables. {view['sentence']}"


def _describe_details(folder: RecordedFolder) -> dict[str, Any]:
    """Return the entry of all figures and tables among the downloads of the page."""
    size = (folder.path / _DETAILS[1]).stat().st_size
    return {
        "name": "All figures and tables",
        "href": _DETAILS[1],
        "bytes": size,
        "group": "Figures",
    }


def _write_parts(
    study: str, conditions: Sequence[Condition], context: ReportContext
) -> dict[str, Any]:
    """Write figures, tables and decisions of a study; return the variables of its page."""
    folder, options = context.folder, context.options
    sections, tests, table = _write_sections(study, conditions, context)
    note = cost.format_budget([job.meta for condition in conditions for job in condition.jobs])
    bibtex = provenance.format_bibtex(conditions)
    return {
        "study": study,
        "options": options,
        "groups": context.groups,
        "brief": context.brief,
        "cells": sections,
        "verdicts": tests,
        "verdict_file": writers.write_json(folder, "verdicts", tests),
        "everything": comparison_tables.all_comparisons_table(_select_tests(tests, sections)),
        "page_shown": sum(v.p_page <= options.alpha for v in tests),
        "shown": sum(v.winner != INCONCLUSIVE for v in tests),
        "family_sizes": sorted({v.family for v in tests}),
        "budget": note,
        **write_comparison(sections, tests, table, context, note),
        "metric_definitions": metric_definitions(),
        "bibtex": bibtex,
        "shared": [
            *provenance.list_shared_settings(conditions),
            *provenance.compute_cost(conditions, options.planned),
            *provenance.training_cost(conditions),
        ],
        "choices": provenance.modelling_choices(conditions),
    }


def _make_context(
    conditions: Sequence[Condition], folder: RecordedFolder, options: ReportOptions
) -> ReportContext:
    """Check the options against the results and return the context of all sections."""
    groups = _select_groups(conditions, options)
    jobs = [job for condition in conditions for job in condition.jobs]
    labels = sorted({job.label for job in jobs}, key=natural_sort_key)
    ordered = order_by_highlight(labels, options.highlight_filters)
    style = line_styles(ordered, study_looks(conditions))
    return ReportContext(groups, style, folder, options, is_brief(conditions, options))


def _select_groups(conditions: Sequence[Condition], options: ReportOptions) -> list[str]:
    """Return the selected groups, and check the groups of the options against the results."""
    states = [job.meta["state"] for condition in conditions for job in condition.jobs]
    available = list(
        dict.fromkeys(block.group for state in states for block in component_groups(state))
    )
    if unknown := sorted(set(options.groups or ()) - set(available)):
        raise ValueError(
            f"report.groups must be groups of the results, got {', '.join(unknown)}. "
            f"Choose from {', '.join(available)}."
        )
    if unknown := sorted(set(options.convergence_threshold) - set(available)):
        raise ValueError(
            "report.convergence_threshold must name groups of the results, "
            f"got {', '.join(unknown)}. Choose from {', '.join(sorted(available))}."
        )
    return available if options.groups is None else list(options.groups)


def _write_sections(
    study: str, conditions: Sequence[Condition], context: ReportContext
) -> tuple[list[dict[str, Any]], list[PairwiseTest], pd.DataFrame]:
    """Write the sections of all conditions; return their variables, tests and rows of runs."""
    sections, tests, tables = [], [], []
    for condition in tqdm(conditions, desc=f"report {study}", disable=None, delay=2):
        section, condition_tests, rows = write_condition_section(condition, context)
        sections.append(section)
        tests += condition_tests
        tables.append(rows)
    return sections, correct_over_report(tests), pd.concat(tables, ignore_index=True)


def _select_tests(
    tests: Sequence[PairwiseTest], sections: Sequence[Mapping[str, Any]]
) -> list[PairwiseTest]:
    """Select all tests, or those of main groups with the best filter if there are too many."""
    if len(tests) <= _ROWS:
        return list(tests)
    selection = {
        _key(v)
        for section in sections
        for group in section["parts"]
        if group["main"]
        for v in group["chosen"]
    }
    return [v for v in tests if _key(v) in selection]


def _key(v: PairwiseTest) -> tuple[str, ...]:
    """Return the key of a comparison."""
    return v.scenario, v.noise, v.model, v.group, v.a, v.b
