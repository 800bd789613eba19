"""The report of a study: a page that works offline, the same in Markdown, figures, tables and verdicts beside them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from tqdm import tqdm

from pfbench import store
from pfbench.report import (
    across,
    budget,
    files,
    headline,
    headline_figures,
    paper_figures,
    provenance,
    ranking_figures,
    tables,
)
from pfbench.report.across import Across
from pfbench.report.canvas import looks, slug
from pfbench.report.frame import Cell, blocks, cells, natural
from pfbench.report.section import PAIRS, section_of
from pfbench.report.significance import LOST_RULES, NO_DIFFERENCE, Verdict, over_page, sensitivity
from pfbench.report.view import Options, View, colours_first, is_brief, looks_of

_ROWS = 2000  # of the table of all comparisons


def write(
    study: str, results: str | Path = "results", out: str | Path = "reports", options: Options | None = None
) -> Path:
    """Writes `<out>/<study>/`: index.html, report.md, verdicts.json, across.json, pfbench.bib, figures/, tables/.

    The same results give the same bytes. Figures and tables of an earlier report in that folder are removed.

    Args:
        study: name of the folder in `results`.
        results: folder of all studies.
        out: folder of all reports.
        options: what is shown.

    Returns:
        The page, index.html.

    Raises:
        FileNotFoundError: the study has no results.
        ValueError: results that do not belong together; a group, a filter or a figure that no result has.
    """
    options = options or Options()
    found = cells(study, results, mixed=options.mixed)
    groups = _groups(found, options.groups)
    _check_converged(found, options.converged)
    folder = Path(out) / study
    labels = sorted({job.label for cell in found for job in cell.jobs}, key=natural)
    view = View(groups, looks(colours_first(labels, options.highlight)), folder, options, is_brief(found, options))
    redrawn = paper_figures.drawings(study, found, view.style, options.figures, options.from_time)
    files.clear(folder)  # after all that may be refused
    sections, decided, runs = [], [], []
    for cell in tqdm(found, desc=f"report {study}", disable=None, delay=2):
        section, own, rows = section_of(cell, view)
        sections.append(section)
        decided += own
        runs.append(rows)
    decided = over_page(decided)
    table = pd.concat(runs, ignore_index=True)
    mains = {(cell.scenario, cell.noise, cell.model): section["main"] for cell, section in zip(found, sections, strict=True)}
    rows, of_mains, name = headline.joined(table, decided, mains)
    if view.brief and name == headline.MAIN:
        table = pd.concat([rows, table], ignore_index=True)
    scored = [group for group in (name, *groups) if (table.group == group).any()]
    over_cells = [across.across(table, group, options.alpha, options.margin) for group in dict.fromkeys(scored)]
    note = budget.stated([job.meta for cell in found for job in cell.jobs])
    listed = _listed(decided, sections)
    context = {
        "study": study,
        "options": options,
        "groups": groups,
        "brief": view.brief,
        "cells": sections,
        "verdicts": decided,
        "everything": tables.everything(listed),
        "paper": [files.drawn(drawing, "paper", folder, options.formats) for drawing in redrawn],
        "page_shown": sum(v.p_page <= options.alpha for v in decided),
        "shown": sum(v.winner != NO_DIFFERENCE for v in decided),
        "family_sizes": sorted({v.family for v in decided}),
        "budget": note,
        "across": _across(table, over_cells, [*of_mains, *decided] if scored[0] == headline.MAIN else decided, view, note),
        "headline": _headline(table, over_cells[0], of_mains, mains, sections, view, note) if view.brief and over_cells else None,
        "lost_rules": [rule.name for rule in LOST_RULES],
        "bibtex": (bibtex := provenance.bibtex(found)),
        "shared": [*provenance.shared(found), *provenance.spent(found, options.planned), *provenance.trained(found)],
        "choices": provenance.choices(found),
        "failures": store.failures(Path(results) / study),
    }
    (folder / "pfbench.bib").write_text(bibtex, encoding="utf-8")
    context["verdict_file"] = files.save_typed(folder, "verdicts", decided)
    files.save_typed(folder, "across", over_cells)
    return files.render("page", folder, context)


def _across(
    table: pd.DataFrame, found: Sequence[Across], decided: Sequence[Verdict], view: View, note: str
) -> dict[str, Any]:
    """What the templates need of all cells together; writes its figures and tables."""
    folder, options = view.folder, view.options
    sources = [across.blocks(table, one.group) for one in found]
    own = table[table.group != headline.MAIN]
    ranked, changed = tables.ranked(found), tables.sensitive(sensitivity(own, options.alpha))
    for name, one_table in (("ranks", ranked), ("lost_rules", changed)):
        if len(one_table):
            files.save_table(folder, f"across_{name}", one_table, note)
    parts = []
    for one in found:
        pairs = tables.across_pairs(one)
        if len(pairs):
            files.save_table(folder, f"across_{slug(one.group)}", pairs, note)
        best = min(zip(one.ranks, one.filters, strict=True))[1] if one.ranks else ""
        few = pairs[(pairs.a == best) | (pairs.b == best)] if len(pairs) > PAIRS else pairs
        others = {rule.name: across.winners(table, one.group, options.alpha, rule) for rule in LOST_RULES[1:]}
        parts.append({"one": one, "pairs": few, "n": len(pairs), "best": best, "changed": _changed(one, others)})
    drawings = []
    for one, source in zip(found, sources, strict=True):
        by = one.ranks or tuple(map(float, np.median(source.values, axis=0)))
        best_first = [label for _, label in sorted(zip(by, one.filters, strict=True))]
        what = f"the best mean ranks of {one.group}" if one.ranks else f"the smallest median RMSE of {one.group}"
        look, who = looks_of(view, one.filters, best_first, what)
        drawings += ranking_figures.of_study([(one, source)], decided, look, who)
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
        "drawings": [files.drawn(drawing, "across", folder, options.formats) for drawing in drawings],
    }


def _headline(
    table: pd.DataFrame, one: Across, decided: Sequence[Verdict], mains: Mapping[headline.CellName, str],
    sections: Sequence[Mapping[str, Any]], view: View, note: str,
) -> dict[str, Any]:
    """What a page of many cells says first; writes its figures and its table."""
    folder, options = view.folder, view.options
    source = across.blocks(table, one.group)
    pairs = headline.planned(source, decided, options.alpha)
    planned = tables.planned(pairs)
    if pairs:
        files.save_table(folder, "proposed", planned, note)
        files.save_typed(folder, "proposed", pairs)
    fates = [fate for section in sections for fate in section["fates"]]
    said = headline.summary(one, decided, pairs, table[table.group == one.group], mains, fates)
    drawings = headline_figures.drawings(one, source, pairs, options.alpha, said.group)
    return {
        "said": said,
        "planned": planned,
        "drawings": [files.drawn(drawing, "all", folder, options.formats) for drawing in drawings],
        "critical": f"across_critical_difference_{slug(one.group)}",
    }


def _listed(decided: Sequence[Verdict], sections: Sequence[Mapping[str, Any]]) -> list[Verdict]:
    """What the table of all comparisons holds: all, or where they are too many those with the best filter, of the main groups."""
    if len(decided) <= _ROWS:
        return list(decided)
    kept = {_of(v) for section in sections for part in section["parts"] if part["main"] for v in part["chosen"]}
    return [v for v in decided if _of(v) in kept]


def _of(v: Verdict) -> tuple[str, ...]:
    return v.scenario, v.noise, v.model, v.group, v.a, v.b


def _changed(one: Across, others: Mapping[str, dict[tuple[str, str], str] | str]) -> list[str]:
    """How many decisions across cells change under each other rule for lost runs."""
    if one.refused:
        return []
    said = []
    for rule, winners in others.items():
        if isinstance(winners, str):
            said.append(f"{rule}: {winners}")
        else:
            n = sum(winners.get((p.a, p.b)) != p.winner for p in one.pairs)
            said.append(f"{rule}: {n} of {len(one.pairs)}")
    return said


def _groups(found: Sequence[Cell], wanted: tuple[str, ...] | None) -> list[str]:
    states = [job.meta["state"] for cell in found for job in cell.jobs]
    there = list(dict.fromkeys(block.group for state in states for block in blocks(state)))
    unknown = sorted(set(wanted or ()) - set(there))
    if unknown:
        raise ValueError(f"groups: no result has {', '.join(unknown)}; choose from {', '.join(there)}")
    return there if wanted is None else list(wanted)


def _check_converged(found: Sequence[Cell], converged: Mapping[str, float]) -> None:
    there = {block.group for cell in found for job in cell.jobs for block in blocks(job.meta["state"])}
    if unknown := sorted(set(converged) - there):
        raise ValueError(f"report.converged: no result has {', '.join(unknown)}; choose from {', '.join(sorted(there))}")
