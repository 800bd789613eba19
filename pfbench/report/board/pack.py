"""Data of the page and of the paper of a study: one dictionary, all numbers decided here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from pfbench.report import provenance
from pfbench.report.board.curves import list_calibration, list_runs
from pfbench.report.board.pack_entries import (
    budget_entries,
    cell_entries,
    describe_versions,
    filter_entry,
    metric_entries,
    regime_entries,
)
from pfbench.report.board.planned import decide_planned, planned_entries, planned_words
from pfbench.report.board.robust_word import describe_robustness
from pfbench.report.board.study_data import StudyData, read_study
from pfbench.report.board.study_views import StudyNames, build_views
from pfbench.report.board.sweeps import list_sweeps
from pfbench.report.journal.methods_text import describe_methods
from pfbench.report.journal.references import format_bibliography
from pfbench.report.looks import MethodLook, study_looks, study_part_names
from pfbench.report.options import ReportOptions
from pfbench.results.comparison.baselines import REFERENCES
from pfbench.results.conditions import Condition

_BASELINES = (*REFERENCES, "ukf", "ckf")  # offered first if they are in the study
_MOST_BASELINES, _FEW_BASELINES = 3, 2
_MANY = 300  # filters times conditions, from which a page offers few baselines


def build_pack(
    study: str,
    conditions: Sequence[Condition],
    options: ReportOptions,
    data: StudyData | None = None,
) -> dict[str, Any]:
    """Build all data of the page of a study but its files.

    Args:
        study: Name of the study.
        conditions: Conditions of the study.
        options: Options of the report.
        data: Data of the results, None to read them.

    Returns:
        Dictionary of plain values. Views have the key `ViewKey`, and data of cells (world, regime).
        None is a value that does not exist.
    """
    data = data or read_study(conditions, options)
    table = data.table
    looks = study_looks(conditions)
    worlds = study_part_names(conditions, "scenario")
    regimes = study_part_names(conditions, "noise")
    planned = decide_planned(table, looks, options)
    most = _MOST_BASELINES if len(looks) * len(conditions) <= _MANY else _FEW_BASELINES
    names = StudyNames(looks, worlds, regimes, select_baselines(looks, options.baseline)[:most])
    views = build_views(table, names, options, planned_words(planned), data.times)
    opening = next(iter(views))
    warnings = (data.warning, _describe_baseline(looks, options.baseline, opening.baseline))
    for view in views.values():
        view["sentence"] = " ".join(filter(None, (*warnings, view["sentence"])))
    entries = planned_entries(planned, table, looks, worlds, options)
    first = next(iter(views.values()))["rows"]
    cells = cell_entries(table)
    model = " model={model}" if any(cell["model"] for cell in cells) else ""
    pack = {
        "study": study,
        "title": options.title or study,
        "generated": describe_versions(conditions),
        "alpha": options.alpha,
        "filters": [filter_entry(looks[row["filter"]]) for row in first],
        "worlds": [asdict(name) for name in worlds.values()],
        "regimes": regime_entries(table, regimes),
        "cells": cells,
        "metrics": metric_entries(table, options.metric),
        "baselines": list(dict.fromkeys(key.baseline for key in views)),
        "budgets": budget_entries(conditions),
        "views": views,
        "planned": entries,
        "robustness": describe_robustness(table, looks, options),
        "curves": data.curves,
        "calibration": list_calibration(table),
        "runs": list_runs(table),
        "tracks": data.tracks,
        "sweeps": list_sweeps(views, looks, options.metric),
        "replay": f"pfbench replay study={study} scenario={{world}} noise={{noise}}"
        f"{model} filter={{filter}} run={{run}}",
        "methods_paragraph": _describe_methods(conditions, options, len(entries)),
        **data.notes.to_entries(looks),
        "provenance": [list(row) for row in provenance.list_shared_settings(conditions)],
    }
    return pack | {"bibtex": format_bibliography(pack, conditions)}


def _describe_baseline(looks: Mapping[str, MethodLook], requested: str, baseline: str) -> str:
    """State that another baseline is shown than the selected one; empty if it is shown."""
    if requested in ("", baseline):
        return ""
    return (
        f"[[{looks[requested].name}]] has no error to compare in all conditions: "
        f"[[{looks[baseline].name}]] is the baseline in its place."
    )


def _describe_methods(conditions: Sequence[Condition], options: ReportOptions, pairs: int) -> str:
    """Describe what was done and what was not, in paragraphs."""
    paragraphs = describe_methods(
        conditions, alpha=options.alpha, margin=options.equivalence_margin, pairs=pairs
    )
    return "\n\n".join(paragraphs)


def select_baselines(looks: Mapping[str, MethodLook], baseline: str = "") -> list[str]:
    """Select the baselines that a reader may choose, the one of the opening view first.

    Args:
        looks: Looks by label.
        baseline: Label of the first baseline, empty for the default.

    Raises:
        ValueError: If the study lacks it.
    """
    if baseline and baseline not in looks:
        raise ValueError(
            f"report.baseline must be a filter of the study, got {baseline}. "
            f"Choose from {', '.join(looks)}."
        )
    stated = [label for look in looks.values() for label in look.baselines]
    available = [label for label in (baseline, *_BASELINES, *stated) if label in looks]
    return list(dict.fromkeys(available)) or list(looks)[:1]
