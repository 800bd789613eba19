"""Section of a condition: its figures, tables and decisions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report import calibration, cost, summary, tables, writers
from pfbench.report.options import ReportContext, select_line_styles
from pfbench.report.plots import comparison_figures, condition_figures
from pfbench.report.plots.plotting import format_slug
from pfbench.report.provenance import distinct_values
from pfbench.results import coverage, status, store
from pfbench.results.comparison.pairwise_results import INCONCLUSIVE, PairwiseTest
from pfbench.results.comparison.pairwise_tests import compare_pairs
from pfbench.results.conditions import Condition, differing_settings
from pfbench.results.frame import drop_before, to_long_rows
from pfbench.results.state_groups import component_groups

PAIRS = 60  # pairs of a table at most


def write_condition_section(
    cell: Condition, view: ReportContext
) -> tuple[dict[str, Any], list[PairwiseTest], pd.DataFrame]:
    """Write the figures and tables of a condition.

    Args:
        cell: Condition.
        view: Context of the report.

    Returns:
        Template variables, pairwise tests, and rows of the runs.
    """
    options, folder = view.options, view.folder
    whole = {job.label: job.load() for job in cell.jobs}
    used = {label: drop_before(result, options.start_time_s) for label, result in whole.items()}
    runs = pd.concat(
        [
            to_long_rows(
                cell, job, whole[job.label], options.start_time_s, options.convergence_threshold
            )
            for job in cell.jobs
        ]
    )
    known = [group for group in view.groups if _scored(used, group)]
    fronts = [cost.pareto_front(cell.name, runs, group) for group in known]
    runs = runs[runs.group.isin(known)]
    decided = compare_pairs(runs, options.alpha, options.equivalence_margin, options.target_effect)
    regions = coverage.compute_coverage(runs, options.alpha)
    note = cost.format_budget([job.meta for job in cell.jobs])
    if apart := differing_settings(cell.jobs):
        note += f" Jobs of this condition differ in {', '.join(apart)}: their runs share random numbers, but not the data."
    prefix = format_slug(f"{cell.scenario}_{cell.noise}_{cell.model}")
    main = summary.select_main_group(known)
    parts = []
    for group, front in zip(known, fronts, strict=True):
        own = [v for v in decided if v.group == group]
        accuracy = tables.accuracy_table(
            used, group, own, options.alpha, options.convergence_threshold.get(group), whole
        )
        if len(accuracy):
            chosen = _with_best(own, front) if len(own) > PAIRS else own
            writers.write_table(folder, f"{prefix}_{format_slug(group)}", accuracy, note)
            pairs, effects = tables.decision_table(chosen), tables.effect_table(chosen)
            if chosen and (group == main or not view.brief):
                writers.write_table(folder, f"{prefix}_{format_slug(group)}_pairs", pairs, note)
                writers.write_table(folder, f"{prefix}_{format_slug(group)}_effects", effects, note)
            short = (
                tables.short_accuracy_table(accuracy) if view.brief and group != main else accuracy
            )
            shown = {
                "accuracy": short,
                "pairs": pairs,
                "effects": effects,
                "regions": coverage.format_coverage(regions, group),
            }
            best = _best_first([front], group)[0]
            parts.append(
                {
                    "name": group,
                    "main": group == main,
                    "chosen": chosen,
                    "best": best,
                    **shown,
                    **_said(own, front),
                }
            )
    ran = tables.overview_table(used, options.alpha)
    writers.write_table(folder, f"{prefix}_overview", ran, note)
    seen = known if not view.brief else [main] if main else []
    look, who = select_line_styles(
        view, list(whole), _best_first(fronts, main), f"the smallest median RMSE of {main}"
    )
    drawings = [
        *condition_figures.condition_figures(whole, runs, look, seen, options.alpha, brief=view.brief, note=who),
        *calibration.calibration_figures(used, seen, look, options.alpha, who),
        *comparison_figures.comparison_figures_of_condition([v for v in decided if v.group in seen], [f for f in fronts if f.group in seen], look, who),
    ]  # fmt: skip
    pictures = [
        writers.render_figure(drawing, prefix, folder, options.figure_formats)
        for drawing in drawings
    ]
    section: dict[str, Any] = {"budget": note, "name": cell.name, "anchor": prefix, "main": main}
    section["fates"] = [(label, status.count_statuses(result)) for label, result in used.items()]
    section |= {"overview": ran, "parts": parts, "drawings": pictures}
    there = {
        block.group for result in used.values() for block in component_groups(result.meta["state"])
    }
    section["unscored"] = [group for group in view.groups if group in there and group not in known]
    section["bounds"] = distinct_values(
        result.meta["bound"] for result in whole.values() if "bound" in result.meta
    )
    section["lost"] = [(label, n.lost, n.runs) for label, n in section["fates"] if n.lost]
    section["diverged"] = [
        (label, n.diverged, n.runs) for label, n in section["fates"] if n.diverged
    ]
    section["overconfident"] = [
        (label, n.severely_overconfident, n.runs)
        for label, n in section["fates"]
        if n.severely_overconfident
    ]
    return section, decided, runs


def _best_first(fronts: Sequence[cost.ParetoFront], group: str) -> list[str]:
    """Order the filters of a group by median RMSE."""
    return [
        label
        for f in fronts
        if f.group == group
        for _, label in sorted(zip(f.rmse, f.filters, strict=True))
    ]


def _with_best(own: Sequence[PairwiseTest], front: cost.ParetoFront) -> list[PairwiseTest]:
    """Select the comparisons with the filter of the smallest median RMSE."""
    best = _best_first([front], front.group)[0]
    return [v for v in own if best in (v.a, v.b)]


def _said(own: Sequence[PairwiseTest], front: cost.ParetoFront) -> dict[str, Any]:
    """Summarise the comparisons of a group for the text."""
    runs = [v.needed for v in own if math.isfinite(v.needed)]
    least = [v.detectable for v in own if math.isfinite(v.detectable)]
    return {
        "unbeaten": summary.list_top_group(own),
        "shown": sum(v.winner != INCONCLUSIVE for v in own),
        "equal": sum(v.equivalent for v in own),
        "n": len(own),
        "needed": (int(min(runs)), int(max(runs))) if runs else None,
        "detectable": (100 * min(least), 100 * max(least)) if least else None,
        "had": (min(v.pairs for v in own), max(v.pairs for v in own)) if own else None,
        "front": [label for label, kept in zip(front.filters, front.kept, strict=True) if kept],
    }


def _scored(results: Mapping[str, store.JobResult], group: str) -> bool:
    """Return whether a valid run has a truth for the group, or all runs are lost."""
    for result in results.values():
        error = result.arrays["error"][~result.arrays["lost"]]
        places = [
            place
            for block in component_groups(result.meta["state"])
            if block.group == group
            for place in block.places
        ]
        if places and (not len(error) or not np.isnan(error[..., places]).all()):
            return True
    return False
