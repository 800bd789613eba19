"""The report of a study: an offline HTML page, Markdown, figures, tables and decisions."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from pfbench.report import cost, provenance, summary, tables, writers
from pfbench.report.condition_section import PAIRS, write_condition_section
from pfbench.report.options import (
    ReportContext,
    ReportOptions,
    is_brief,
    order_by_highlight,
    select_line_styles,
)
from pfbench.report.plots import comparison_figures, paper_figures, summary_figures
from pfbench.report.plots.plotting import format_slug, line_styles
from pfbench.results import store
from pfbench.results.comparison import condition_blocks, rankings
from pfbench.results.comparison.lost_run_rules import LOST_RUN_RULES
from pfbench.results.comparison.lost_run_sensitivity import lost_rule_sensitivity
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.comparison.pairwise_tests import correct_over_report
from pfbench.results.comparison.ranking_results import RankingResult
from pfbench.results.conditions import Condition, load_conditions, natural_sort_key
from pfbench.results.metrics import metric_definitions
from pfbench.results.state_groups import component_groups

_ROWS = 2000  # rows of the table of all comparisons at most


def write_report(
    study: str,
    results: str | Path = "results",
    out: str | Path = "reports",
    options: ReportOptions | None = None,
) -> Path:
    """Write the report of a study to `<out>/<study>/`.

    The folder contains index.html, report.md, verdicts.json, across.json, pfbench.bib, figures/ and
    tables/. Equal results give equal bytes. Figures and tables of an earlier report are removed.

    Args:
        study: Name of the folder in `results`.
        results: Folder of all studies.
        out: Folder of all reports.
        options: Options of the report.

    Returns:
        Path of index.html.

    Raises:
        FileNotFoundError: If the study has no results.
        ValueError: If results do not belong together, or no result has a selected group, filter or figure.
    """
    options = options or ReportOptions()
    found = load_conditions(study, results, allow_mixed_versions=options.allow_mixed_versions)
    groups = _groups(found, options.groups)
    _check_converged(found, options.convergence_threshold)
    folder = Path(out) / study
    labels = sorted({job.label for cell in found for job in cell.jobs}, key=natural_sort_key)
    view = ReportContext(
        groups,
        line_styles(order_by_highlight(labels, options.highlight_filters)),
        folder,
        options,
        is_brief(found, options),
    )
    redrawn = paper_figures.paper_figures(
        study, found, view.style, options.paper_figures, options.start_time_s
    )
    writers.remove_old_files(folder)  # after all checks
    sections, decided, runs = [], [], []
    for cell in tqdm(found, desc=f"report {study}", disable=None, delay=2):
        section, own, rows = write_condition_section(cell, view)
        sections.append(section)
        decided += own
        runs.append(rows)
    decided = correct_over_report(decided)
    table = pd.concat(runs, ignore_index=True)
    mains = {
        (cell.scenario, cell.noise, cell.model): section["main"]
        for cell, section in zip(found, sections, strict=True)
    }
    rows, of_mains, name = summary.merge(table, decided, mains)
    if view.brief and name == summary.MAIN:
        table = pd.concat([rows, table], ignore_index=True)
    scored = [group for group in (name, *groups) if (table.group == group).any()]
    over_cells = [
        rankings.rank_filters(table, group, options.alpha, options.equivalence_margin)
        for group in dict.fromkeys(scored)
    ]
    note = cost.format_budget([job.meta for cell in found for job in cell.jobs])
    listed = _listed(decided, sections)
    context = {
        "study": study,
        "options": options,
        "groups": groups,
        "brief": view.brief,
        "cells": sections,
        "verdicts": decided,
        "everything": tables.all_comparisons_table(listed),
        "paper": [
            writers.render_figure(drawing, "paper", folder, options.figure_formats)
            for drawing in redrawn
        ],
        "page_shown": sum(v.p_page <= options.alpha for v in decided),
        "shown": sum(v.winner != INCONCLUSIVE for v in decided),
        "family_sizes": sorted({v.family for v in decided}),
        "budget": note,
        "across": write_across_section(
            table,
            over_cells,
            [*of_mains, *decided] if scored[0] == summary.MAIN else decided,
            view,
            note,
        ),
        "headline": write_headline(table, over_cells[0], of_mains, mains, sections, view, note)
        if view.brief and over_cells
        else None,
        "metric_definitions": metric_definitions(),
        "lost_rules": [rule.name for rule in LOST_RUN_RULES],
        "bibtex": (bibtex := provenance.format_bibtex(found)),
        "shared": [
            *provenance.list_shared_settings(found),
            *provenance.compute_cost(found, options.planned),
            *provenance.training_cost(found),
        ],
        "choices": provenance.modelling_choices(found),
        "failures": store.list_failures(Path(results) / study),
    }
    (folder / "pfbench.bib").write_text(bibtex, encoding="utf-8")
    context["verdict_file"] = writers.write_json(folder, "verdicts", decided)
    writers.write_json(folder, "across", over_cells)
    return writers.render_template("page", folder, context)


def write_across_section(
    table: pd.DataFrame,
    found: Sequence[RankingResult],
    decided: Sequence[PairwiseTest],
    view: ReportContext,
    note: str,
) -> dict[str, Any]:
    """Write the figures and tables across conditions and return their template variables."""
    folder, options = view.folder, view.options
    sources = [condition_blocks.ranking_blocks(table, one.group) for one in found]
    own = table[table.group != summary.MAIN]
    ranked, changed = (
        tables.rank_table(found),
        tables.lost_rule_table(lost_rule_sensitivity(own, options.alpha)),
    )
    for name, one_table in (("ranks", ranked), ("lost_rules", changed)):
        if len(one_table):
            writers.write_table(folder, f"across_{name}", one_table, note)
    parts = []
    for one in found:
        pairs = tables.ranking_pair_table(one)
        if len(pairs):
            writers.write_table(folder, f"across_{format_slug(one.group)}", pairs, note)
        best = min(zip(one.ranks, one.filters, strict=True))[1] if one.ranks else ""
        few = pairs[(pairs.a == best) | (pairs.b == best)] if len(pairs) > PAIRS else pairs
        others = {
            rule.name: rankings.winners_by_rule(table, one.group, options.alpha, rule)
            for rule in LOST_RUN_RULES[1:]
        }
        parts.append(
            {
                "one": one,
                "pairs": few,
                "n": len(pairs),
                "best": best,
                "changed": _changed(one, others),
            }
        )
    drawings = []
    for one, source in zip(found, sources, strict=True):
        by = one.ranks or tuple(map(float, np.median(source.values, axis=0)))
        best_first = [label for _, label in sorted(zip(by, one.filters, strict=True))]
        criterion = (
            f"the best mean ranks of {one.group}"
            if one.ranks
            else f"the smallest median RMSE of {one.group}"
        )
        look, who = select_line_styles(view, one.filters, best_first, criterion)
        drawings += comparison_figures.study_figures([(one, source)], decided, look, who)
    refused: dict[str, list[str]] = {}
    for one in found:
        if one.refused:
            refused.setdefault(one.refused, []).append(one.group)
    return {
        "parts": parts,
        "refused": refused,
        "ranked": ranked,
        "sensitive": changed,
        "lost": bool(table.lost.any()),
        "drawings": [
            writers.render_figure(drawing, "across", folder, options.figure_formats)
            for drawing in drawings
        ],
    }


def write_headline(
    table: pd.DataFrame,
    one: RankingResult,
    decided: Sequence[PairwiseTest],
    mains: Mapping[summary.CellName, str],
    sections: Sequence[Mapping[str, Any]],
    view: ReportContext,
    note: str,
) -> dict[str, Any]:
    """Write the figures and the table of the summary and return its template variables."""
    folder, options = view.folder, view.options
    source = condition_blocks.ranking_blocks(table, one.group)
    pairs = summary.compare_with_baselines(source, decided, options.alpha)
    planned = tables.baseline_table(pairs)
    if pairs:
        writers.write_table(folder, "proposed", planned, note)
        writers.write_json(folder, "proposed", pairs)
    fates = [fate for section in sections for fate in section["fates"]]
    said = summary.summarise_study(
        one, decided, pairs, table[table.group == one.group], mains, fates
    )
    drawings = summary_figures.summary_figures(one, source, pairs, options.alpha, said.group)
    return {
        "said": said,
        "planned": planned,
        "drawings": [
            writers.render_figure(drawing, "all", folder, options.figure_formats)
            for drawing in drawings
        ],
        "critical": f"across_critical_difference_{format_slug(one.group)}",
    }


def _listed(
    decided: Sequence[PairwiseTest], sections: Sequence[Mapping[str, Any]]
) -> list[PairwiseTest]:
    """Select all comparisons, or those of main groups with the best filter if there are too many."""
    if len(decided) <= _ROWS:
        return list(decided)
    kept = {
        _of(v)
        for section in sections
        for part in section["parts"]
        if part["main"]
        for v in part["chosen"]
    }
    return [v for v in decided if _of(v) in kept]


def _of(v: PairwiseTest) -> tuple[str, ...]:
    """Return the key of a comparison."""
    return v.scenario, v.noise, v.model, v.group, v.a, v.b


def _changed(
    one: RankingResult, others: Mapping[str, dict[tuple[str, str], str] | str]
) -> list[str]:
    """Format the number of decisions across conditions that change under other lost-run rules."""
    if one.refused:
        return []
    texts = []
    for rule, winners in others.items():
        if isinstance(winners, str):
            texts.append(f"{rule}: {winners}")
        else:
            n = sum(winners.get((p.a, p.b)) != p.winner for p in one.pairs)
            texts.append(f"{rule}: {n} of {len(one.pairs)}")
    return texts


def _groups(found: Sequence[Condition], wanted: tuple[str, ...] | None) -> list[str]:
    """Return the selected groups, checked against the results."""
    states = [job.meta["state"] for cell in found for job in cell.jobs]
    groups = list(
        dict.fromkeys(block.group for state in states for block in component_groups(state))
    )
    unknown = sorted(set(wanted or ()) - set(groups))
    if unknown:
        names = ", ".join(groups)
        raise ValueError(
            f"report.groups must be groups of the results, got {', '.join(unknown)}. Choose from {names}."
        )
    return groups if wanted is None else list(wanted)


def _check_converged(found: Sequence[Condition], converged: Mapping[str, float]) -> None:
    """Check the groups of the convergence limits."""
    groups = {
        block.group
        for cell in found
        for job in cell.jobs
        for block in component_groups(job.meta["state"])
    }
    if unknown := sorted(set(converged) - groups):
        names = ", ".join(sorted(groups))
        raise ValueError(
            f"report.convergence_threshold must name groups of the results, got {', '.join(unknown)}. Choose from {names}."
        )
