"""One cell of a report: its figures, tables and decisions."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from pfbench import store
from pfbench.report import budget, calibration, figures, files, headline, ranking_figures, tables
from pfbench.report.canvas import slug
from pfbench.report.frame import Cell, blocks, differing, later, tidy
from pfbench.report.provenance import distinct
from pfbench.report.significance import NO_DIFFERENCE, Verdict, verdicts
from pfbench.report.view import View, looks_of

PAIRS = 60  # of one group of one cell that a table holds


def section_of(cell: Cell, view: View) -> tuple[dict[str, Any], list[Verdict], pd.DataFrame]:
    """What the templates need of one cell, what is decided in it, and its runs; writes its figures and tables."""
    options, folder = view.options, view.folder
    whole = {job.label: job.load() for job in cell.jobs}
    used = {label: later(result, options.from_time) for label, result in whole.items()}
    runs = pd.concat([tidy(cell, job, whole[job.label], options.from_time, options.converged) for job in cell.jobs])
    known = [group for group in view.groups if _scored(used, group)]
    fronts = [budget.front(cell.name, runs, group) for group in known]
    runs = runs[runs.group.isin(known)]
    decided = verdicts(runs, options.alpha, options.margin, options.wanted)
    regions = calibration.calibrated(runs, options.alpha)
    note = budget.stated([job.meta for job in cell.jobs])
    if apart := differing(cell.jobs):
        note += f" Jobs of this cell differ in {', '.join(apart)}: runs share their draws there, not their worlds."
    prefix = slug(f"{cell.scenario}_{cell.noise}_{cell.model}")
    main = headline.main_group(known)
    parts = []
    for group, front in zip(known, fronts, strict=True):
        own = [v for v in decided if v.group == group]
        accuracy = tables.accuracy(used, group, own, options.alpha, options.converged.get(group), whole)
        if len(accuracy):
            chosen = _with_best(own, front) if len(own) > PAIRS else own
            files.save_table(folder, f"{prefix}_{slug(group)}", accuracy, note)
            pairs, effects = tables.decisions(chosen), tables.effects(chosen)
            if chosen and (group == main or not view.brief):
                files.save_table(folder, f"{prefix}_{slug(group)}_pairs", pairs, note)
                files.save_table(folder, f"{prefix}_{slug(group)}_effects", effects, note)
            short = tables.in_brief(accuracy) if view.brief and group != main else accuracy
            shown = {"accuracy": short, "pairs": pairs, "effects": effects, "regions": calibration.said(regions, group)}
            best = _best_first([front], group)[0]
            parts.append({"name": group, "main": group == main, "chosen": chosen, "best": best, **shown, **_said(own, front)})
    ran = tables.overview(used, options.alpha)
    files.save_table(folder, f"{prefix}_overview", ran, note)
    seen = known if not view.brief else [main] if main else []
    look, who = looks_of(view, list(whole), _best_first(fronts, main), f"the smallest median RMSE of {main}")
    drawings = [
        *figures.drawings(whole, runs, look, seen, options.alpha, brief=view.brief, note=who),
        *calibration.drawings(used, seen, look, options.alpha, who),
        *ranking_figures.of_cell([v for v in decided if v.group in seen], [f for f in fronts if f.group in seen], look, who),
    ]  # fmt: skip
    pictures = [files.drawn(drawing, prefix, folder, options.formats) for drawing in drawings]
    section: dict[str, Any] = {"budget": note, "name": cell.name, "anchor": prefix, "main": main}
    section["fates"] = [
        (label, int(whole[label].arrays["lost"].sum()), int(tables.diverged(result).sum()), result.meta["runs"])
        for label, result in used.items()
    ]
    section |= {"overview": ran, "parts": parts, "drawings": pictures}
    there = {block.group for result in used.values() for block in blocks(result.meta["state"])}
    section["unscored"] = [group for group in view.groups if group in there and group not in known]
    section["bounds"] = distinct(result.meta["bound"] for result in whole.values() if "bound" in result.meta)
    section["lost"] = [(label, lost, n) for label, lost, _, n in section["fates"] if lost]
    section["diverged"] = [(label, off, n) for label, _, off, n in section["fates"] if off]
    return section, decided, runs


def _best_first(fronts: Sequence[budget.Front], group: str) -> list[str]:
    return [label for f in fronts if f.group == group for _, label in sorted(zip(f.rmse, f.filters, strict=True))]


def _with_best(own: Sequence[Verdict], front: budget.Front) -> list[Verdict]:
    """The comparisons with the filter whose median RMSE is the smallest."""
    best = _best_first([front], front.group)[0]
    return [v for v in own if best in (v.a, v.b)]


def _said(own: Sequence[Verdict], front: budget.Front) -> dict[str, Any]:
    """What the text says of one group of one cell."""
    runs = [v.needed for v in own if math.isfinite(v.needed)]
    least = [v.detectable for v in own if math.isfinite(v.detectable)]
    return {
        "unbeaten": _unbeaten(own),
        "shown": sum(v.winner != NO_DIFFERENCE for v in own),
        "equal": sum(v.equivalent for v in own),
        "n": len(own),
        "needed": (int(min(runs)), int(max(runs))) if runs else None,
        "detectable": (100 * min(least), 100 * max(least)) if least else None,
        "had": (min(v.pairs for v in own), max(v.pairs for v in own)) if own else None,
        "front": [label for label, kept in zip(front.filters, front.kept, strict=True) if kept],
    }


def _unbeaten(own: Sequence[Verdict]) -> list[str]:
    labels = dict.fromkeys(label for v in own for label in (v.a, v.b))
    beaten = {v.b if v.winner == v.a else v.a for v in own if v.winner != NO_DIFFERENCE}
    return [label for label in labels if label not in beaten]


def _scored(results: Mapping[str, store.Result], group: str) -> bool:
    """Is there a truth for the group in any run that was not lost, or no such run to tell?"""
    for result in results.values():
        error = result.arrays["error"][~result.arrays["lost"]]
        places = [place for block in blocks(result.meta["state"]) if block.group == group for place in block.places]
        if places and (not len(error) or not np.isnan(error[..., places]).all()):
            return True
    return False
