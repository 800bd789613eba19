"""Data of the page and of the paper of a study: one dictionary, all numbers decided here."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pfbench.report import provenance
from pfbench.report.board.decided_parts import StudyFacts, decide_parts
from pfbench.report.board.pack_entries import (
    budget_entries,
    cell_entries,
    describe_uncommitted,
    describe_versions,
    regime_entries,
)
from pfbench.report.board.run_table import METRIC_NAMES
from pfbench.report.board.study_data import StudyData, read_study
from pfbench.report.journal.references import format_bibliography
from pfbench.report.looks import study_looks, study_part_names
from pfbench.report.methods_facts import collect_methods_facts
from pfbench.report.options import ReportOptions
from pfbench.results.conditions import Condition, differing_settings
from pfbench.results.store import list_failures


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
    regimes = study_part_names(conditions, "noise")
    facts = StudyFacts(
        study_looks(conditions),
        study_part_names(conditions, "scenario"),
        regimes,
        options,
        data.times,
        list_failures(conditions[0].jobs[0].path.parent),
        " ".join(filter(None, (conditions[0].older, data.warning))),
        " ".join(filter(None, (describe_uncommitted(conditions), _describe_differing(conditions)))),
    )
    decided = decide_parts(table, facts)
    cells = cell_entries(table)
    model = " model={model}" if any(cell["model"] for cell in cells) else ""
    pack = {
        "study": study,
        "title": options.title or study,
        "generated": describe_versions(conditions),
        **decided,
        "regimes": regime_entries(table, regimes),
        "cells": cells,
        "budgets": budget_entries(conditions),
        "curves": data.curves,
        "tracks": data.tracks,
        "replay": f"pfbench replay study={study} scenario={{world}} noise={{noise}}"
        f"{model} filter={{filter}} run={{run}}",
        "methods": collect_methods_facts(
            conditions,
            alpha=options.alpha,
            margin=options.equivalence_margin,
            metric=METRIC_NAMES[options.metric],
        ).to_entries(),
        **data.notes.to_entries(facts.looks),
        "provenance": [list(row) for row in provenance.list_shared_settings(conditions)],
        "facts": facts.to_entries(),
    }
    return pack | {"bibtex": format_bibliography(pack, conditions)}


def _describe_differing(conditions: Sequence[Condition]) -> str:
    """Name the conditions whose jobs differ in their data."""
    return " ".join(
        f"Jobs of {condition.name} differ in {', '.join(settings)}: "
        "their runs share random numbers, but not the data."
        for condition in conditions
        if (settings := differing_settings(condition.jobs))
    )
