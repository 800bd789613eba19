"""The report of a study: a page that works offline, the same in Markdown, figures, tables and verdicts beside them."""

from __future__ import annotations

import base64
import gzip
import json
import math
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import jinja2
import numpy as np
import pandas as pd
from tqdm import tqdm

from pfbench import store
from pfbench.report import (
    across,
    budget,
    calibration,
    figures,
    headline,
    headline_figures,
    paper_figures,
    ranking_figures,
    tables,
    vector,
)
from pfbench.report.across import Across
from pfbench.report.canvas import Look, dimmed, looks, slug
from pfbench.report.frame import Cell, blocks, cells, differing, later, natural, tidy
from pfbench.report.significance import LOST_RULES, NO_DIFFERENCE, Verdict, over_page, sensitivity, verdicts

_HERE = Path(__file__).parent
_PLENTY = 50  # filters times cells; of more, a page shows the figures of one group per cell, and comparisons with the best [ours]
_NAMED = 7  # filters of which each has a colour of its own; of more than eight the others are grey [ours]
_PAIRS = 60  # of one group of one cell that a table holds
_ROWS = 2000  # of the table of all comparisons
_FORMATS = ("svg", "png")
_SHARED = (
    ("pfbench", "versions.pfbench"),
    ("commit", "versions.commit"),
    ("python", "versions.python"),
    ("torch", "versions.torch"),
    ("numpy", "versions.numpy"),
    ("host", "host"),
    ("device", "device"),
    ("number type", "dtype"),
    ("threads", "threads"),
    ("seed", "seed"),
    ("first run", "first_run"),
    ("runs per filter", "runs"),
    ("steps per run", "steps"),
)


_TAKEN = {"filter": "filters", "scores": "scores", "world": "worlds", "bound": "bounds", "compile": "compilation"}


@dataclass(frozen=True)
class Options:
    """What a report shows.

    Attributes:
        groups: groups of the state, None for all.
        alpha: level of the tests after Holm's correction, and probability outside the bands.
        from_time: leave out of all figures of merit what came before, seconds; curves over time show all.
        formats: of the figures: svg, png; the page carries of each figure the smaller one.
        mixed: accept results of several versions, seeds, runs or lengths side by side.
        converged: bounds by group, in the unit shown, for the time to converge, which counts from the start of the record.
        margin: share by which RMSE may differ between filters that count as equal.
        wanted: share by which RMSE differs in the effect for which the needed number of runs is computed.
        figures: names of `paper_figures.FIGURES` to draw; None for those of the paper that the study is named after.
        highlight: filters in colour where there are more than eight, the others being grey; None for the best of each cell.
        full: show all figures and comparisons; None for all where filters times cells are at most 50.
        planned: how many jobs the study's experiment asks for, where one does.

    Raises:
        ValueError: a value out of range.
    """

    groups: tuple[str, ...] | None = None
    alpha: float = 0.05
    from_time: float = 0.0
    formats: tuple[str, ...] = ("svg", "png")
    mixed: bool = False
    converged: Mapping[str, float] = field(default_factory=dict)
    margin: float = 0.05
    wanted: float = 0.1
    figures: tuple[str, ...] | None = None
    highlight: tuple[str, ...] | None = None
    full: bool | None = None
    planned: int | None = None

    def __post_init__(self) -> None:
        if not 0 < self.alpha < 1:
            raise ValueError(f"alpha={self.alpha} is no probability; 0.05 is usual")
        for name in ("margin", "wanted"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name}={getattr(self, name)} is no share by which errors differ; 0.05 is five per cent")
        if not self.formats or set(self.formats) - set(_FORMATS):
            raise ValueError(f"formats={list(self.formats)}: choose from {', '.join(_FORMATS)}")


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
    view = View(groups, looks(_first(labels, options.highlight)), folder, options, _is_brief(found, options))
    redrawn = paper_figures.drawings(study, found, view.style, options.figures, options.from_time)
    clear(folder)  # after all that may be refused
    sections, decided, runs = [], [], []
    for cell in tqdm(found, desc=f"report {study}", disable=None, delay=2):
        section, own, rows = _section(cell, view)
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
        "paper": [drawn(drawing, "paper", folder, options.formats) for drawing in redrawn],
        "page_shown": sum(v.p_page <= options.alpha for v in decided),
        "shown": sum(v.winner != NO_DIFFERENCE for v in decided),
        "family_sizes": sorted({v.family for v in decided}),
        "budget": note,
        "across": _across(table, over_cells, [*of_mains, *decided] if scored[0] == headline.MAIN else decided, view, note),
        "headline": _headline(table, over_cells[0], of_mains, mains, sections, view, note) if view.brief and over_cells else None,
        "lost_rules": [rule.name for rule in LOST_RULES],
        "bibtex": (bibtex := _bibtex(found)),
        "shared": [*_shared(found), *_spent(found, options.planned), *_trained(found)],
        "choices": _choices(found),
        "failures": store.failures(Path(results) / study),
    }
    (folder / "pfbench.bib").write_text(bibtex, encoding="utf-8")
    context["verdict_file"] = save_typed(folder, "verdicts", decided)
    save_typed(folder, "across", over_cells)
    return render("page", folder, context)


class View(NamedTuple):
    """What all parts of a page are made with.

    Attributes:
        groups: of the state, shown.
        style: looks of the filters.
        folder: of the report.
        options: as given.
        brief: the study is too large to show all.
    """

    groups: Sequence[str]
    style: Mapping[str, Look]
    folder: Path
    options: Options
    brief: bool


def save_typed(folder: Path, name: str, typed: Sequence[Any]) -> str:
    """Writes dataclasses as JSON, compressed and with nine digits where they are thousands; returns the name of the file."""
    many = len(typed) > _ROWS
    text = json.dumps([_plain(asdict(one), 9 if many else None) for one in typed], indent=None if many else 1, allow_nan=False)
    for old in (folder / f"{name}.json", folder / f"{name}.json.gz"):
        old.unlink(missing_ok=True)
    if not many:
        (folder / f"{name}.json").write_text(text + "\n", encoding="utf-8")
        return f"{name}.json"
    (folder / f"{name}.json.gz").write_bytes(gzip.compress(text.encode(), mtime=0))
    return f"{name}.json.gz"


def render(template: str, folder: Path, context: Mapping[str, Any]) -> Path:
    """Writes index.html and report.md by the templates of that name; returns the first."""
    css = (_HERE / "style.css").read_text(encoding="utf-8")
    for kind, name in (("md", "report.md"), ("html", "index.html")):
        page = _environment(kind == "html").get_template(f"{template}.{kind}.jinja").render({**context, "css": css})
        (folder / name).write_text(page, encoding="utf-8")
    return folder / "index.html"


def _section(cell: Cell, view: View) -> tuple[dict[str, Any], list[Verdict], pd.DataFrame]:
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
            chosen = _with_best(own, front) if len(own) > _PAIRS else own
            save_table(folder, f"{prefix}_{slug(group)}", accuracy, note)
            pairs, effects = tables.decisions(chosen), tables.effects(chosen)
            if chosen and (group == main or not view.brief):
                save_table(folder, f"{prefix}_{slug(group)}_pairs", pairs, note)
                save_table(folder, f"{prefix}_{slug(group)}_effects", effects, note)
            short = tables.in_brief(accuracy) if view.brief and group != main else accuracy
            shown = {"accuracy": short, "pairs": pairs, "effects": effects, "regions": calibration.said(regions, group)}
            best = _best_first([front], group)[0]
            parts.append({"name": group, "main": group == main, "chosen": chosen, "best": best, **shown, **_said(own, front)})
    ran = tables.overview(used, options.alpha)
    save_table(folder, f"{prefix}_overview", ran, note)
    seen = known if not view.brief else [main] if main else []
    look, who = _looks_of(view, list(whole), _best_first(fronts, main), f"the smallest median RMSE of {main}")
    drawings = [
        *figures.drawings(whole, runs, look, seen, options.alpha, brief=view.brief, note=who),
        *calibration.drawings(used, seen, look, options.alpha, who),
        *ranking_figures.of_cell([v for v in decided if v.group in seen], [f for f in fronts if f.group in seen], look, who),
    ]  # fmt: skip
    pictures = [drawn(drawing, prefix, folder, options.formats) for drawing in drawings]
    section: dict[str, Any] = {"budget": note, "name": cell.name, "anchor": prefix, "main": main}
    section["fates"] = [
        (label, int(whole[label].arrays["lost"].sum()), int(tables.diverged(result).sum()), result.meta["runs"])
        for label, result in used.items()
    ]
    section |= {"overview": ran, "parts": parts, "drawings": pictures}
    there = {block.group for result in used.values() for block in blocks(result.meta["state"])}
    section["unscored"] = [group for group in view.groups if group in there and group not in known]
    section["bounds"] = _distinct(result.meta["bound"] for result in whole.values() if "bound" in result.meta)
    section["lost"] = [(label, lost, n) for label, lost, _, n in section["fates"] if lost]
    section["diverged"] = [(label, off, n) for label, _, off, n in section["fates"] if off]
    return section, decided, runs


def _looks_of(view: View, labels: Sequence[str], best: Sequence[str], by: str) -> tuple[Mapping[str, Look], str]:
    """Looks for a figure with a line per filter, and who is grey, for its caption; all are named where they are few.

    Args:
        view: of the page.
        labels: of the filters shown.
        best: the same, best first.
        by: what makes them best.
    """
    if len(labels) <= _NAMED + 1:
        return view.style, ""
    chosen = [label for label in view.options.highlight or () if label in labels]
    if chosen:
        others = len(labels) - len(chosen)
        return dimmed(view.style, chosen), f" In colour: {', '.join(chosen)}; grey: the other {others}."
    kept = sorted(best[:_NAMED], key=natural)
    said = f" In colour: the {_NAMED} with {by}, in colours of these figures' own; grey: the other {len(labels) - len(kept)}."
    quiet = dimmed(view.style, kept)
    return {**quiet, **{label: look._replace(instants=quiet[label].instants) for label, look in looks(kept).items()}}, said


def _best_first(fronts: Sequence[budget.Front], group: str) -> list[str]:
    return [label for f in fronts if f.group == group for _, label in sorted(zip(f.rmse, f.filters, strict=True))]


def _with_best(own: Sequence[Verdict], front: budget.Front) -> list[Verdict]:
    """The comparisons with the filter whose median RMSE is the smallest."""
    best = _best_first([front], front.group)[0]
    return [v for v in own if best in (v.a, v.b)]


def _listed(decided: Sequence[Verdict], sections: Sequence[Mapping[str, Any]]) -> list[Verdict]:
    """What the table of all comparisons holds: all, or where they are too many those with the best filter, of the main groups."""
    if len(decided) <= _ROWS:
        return list(decided)
    kept = {_of(v) for section in sections for part in section["parts"] if part["main"] for v in part["chosen"]}
    return [v for v in decided if _of(v) in kept]


def _of(v: Verdict) -> tuple[str, ...]:
    return v.scenario, v.noise, v.model, v.group, v.a, v.b


def _first(labels: Sequence[str], highlight: Sequence[str] | None) -> list[str]:
    """Labels with those in colour before the others, whose looks repeat.

    Raises:
        ValueError: a filter that did not run.
    """
    unknown = sorted(set(highlight or ()) - set(labels))
    if unknown:
        raise ValueError(f"report.highlight: no result is of {', '.join(unknown)}; there are {', '.join(labels)}")
    return list(dict.fromkeys([*(highlight or ()), *labels]))


def _is_brief(found: Sequence[Cell], options: Options) -> bool:
    most = max(len(cell.jobs) for cell in found) * len(found)
    return not options.full if options.full is not None else most > _PLENTY


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
            save_table(folder, f"across_{name}", one_table, note)
    parts = []
    for one in found:
        pairs = tables.across_pairs(one)
        if len(pairs):
            save_table(folder, f"across_{slug(one.group)}", pairs, note)
        best = min(zip(one.ranks, one.filters, strict=True))[1] if one.ranks else ""
        few = pairs[(pairs.a == best) | (pairs.b == best)] if len(pairs) > _PAIRS else pairs
        others = {rule.name: across.winners(table, one.group, options.alpha, rule) for rule in LOST_RULES[1:]}
        parts.append({"one": one, "pairs": few, "n": len(pairs), "best": best, "changed": _changed(one, others)})
    drawings = []
    for one, source in zip(found, sources, strict=True):
        by = one.ranks or tuple(map(float, np.median(source.values, axis=0)))
        best_first = [label for _, label in sorted(zip(by, one.filters, strict=True))]
        what = f"the best mean ranks of {one.group}" if one.ranks else f"the smallest median RMSE of {one.group}"
        look, who = _looks_of(view, one.filters, best_first, what)
        drawings += ranking_figures.of_study([(one, source)], decided, look, who)
    return {
        "parts": parts,
        "ranked": ranked,
        "sensitive": changed,
        "lost": bool(table.lost.any()),
        "drawings": [drawn(drawing, "across", folder, options.formats) for drawing in drawings],
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
        save_table(folder, "proposed", planned, note)
        save_typed(folder, "proposed", pairs)
    fates = [fate for section in sections for fate in section["fates"]]
    said = headline.summary(one, decided, pairs, table[table.group == one.group], mains, fates)
    drawings = headline_figures.drawings(one, source, pairs, options.alpha, said.group)
    return {
        "said": said,
        "planned": planned,
        "drawings": [drawn(drawing, "all", folder, options.formats) for drawing in drawings],
        "critical": f"across_critical_difference_{slug(one.group)}",
    }


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


def _bibtex(found: Sequence[Cell]) -> str:
    """An entry that a user can paste: the versions that made the results, and the year they were made in."""
    metas = [job.meta for cell in found for job in cell.jobs]
    version = ", ".join(_distinct(str(_at(meta, "versions.pfbench")) for meta in metas))
    commit = ", ".join(_distinct(str(_at(meta, "versions.commit")) for meta in metas if _at(meta, "versions.commit")))
    years = [str(meta["created"])[:4] for meta in metas if meta.get("created")]
    note = f"  note    = {{Commit {commit}}},\n" if commit else ""
    return (
        "@software{pfbench,\n"
        "  author  = {{The pfbench authors}},\n"
        "  title   = {{pfbench}: probabilistic programming and benchmarking of particle filters in integrated navigation},\n"
        f"  version = {{{version}}},\n{note}"
        + (f"  year    = {{{max(years)}}},\n" if years else "")
        + "}\n"
    )


def _scored(results: Mapping[str, store.Result], group: str) -> bool:
    """Is there a truth for the group in any run that was not lost, or no such run to tell?"""
    for result in results.values():
        error = result.arrays["error"][~result.arrays["lost"]]
        places = [place for block in blocks(result.meta["state"]) if block.group == group for place in block.places]
        if places and (not len(error) or not np.isnan(error[..., places]).all()):
            return True
    return False


def drawn(drawing: figures.Drawing, prefix: str, folder: Path, formats: Sequence[str]) -> dict[str, Any]:
    """What the templates need of one figure; writes its files."""
    paths = figures.save(drawing._replace(name=f"{prefix}_{drawing.name}"), folder / "figures", formats)
    first = max(paths, key=lambda path: path.suffix)  # svg where there is one
    return {
        "file": f"figures/{first.name}",
        "caption": drawing.caption,
        "source": min(map(_address, paths), key=len),
        "name": drawing.name,
        "anchor": slug(f"{prefix}_{drawing.name}"),
        "broad": drawing.name.startswith("spread_"),
    }


def _address(path: Path) -> str:
    """The picture as an address that needs no file."""
    if path.suffix == ".svg":
        return vector.linked(path.read_text(encoding="utf-8"))
    return f"data:image/png;base64,{base64.b64encode(path.read_bytes()).decode('ascii')}"


def save_table(folder: Path, name: str, table: pd.DataFrame, note: str = "") -> None:
    """As CSV and LaTeX; a note, such as the budget, stands below the LaTeX table and in a last column of the CSV."""
    (folder / "tables").mkdir(parents=True, exist_ok=True)
    (folder / "tables" / f"{name}.csv").write_text(tables.csv(table.assign(note=note) if note else table), encoding="utf-8")
    (folder / "tables" / f"{name}.tex").write_text(tables.latex(table, note), encoding="utf-8")


def clear(folder: Path) -> None:
    """Removes what an earlier report drew, so that no figure of a cell that is gone stays behind."""
    for pattern in ("figures/*.svg", "figures/*.png", "tables/*.csv", "tables/*.tex"):
        for path in folder.glob(pattern):
            path.unlink()
    folder.mkdir(parents=True, exist_ok=True)


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


def _unbeaten(own: Sequence[Verdict]) -> list[str]:
    labels = dict.fromkeys(label for v in own for label in (v.a, v.b))
    beaten = {v.b if v.winner == v.a else v.a for v in own if v.winner != NO_DIFFERENCE}
    return [label for label in labels if label not in beaten]


def _shared(found: Sequence[Cell]) -> list[tuple[str, str]]:
    """What all jobs ran with; several values are listed, as they are in a mixed report."""
    rows = []
    for name, path in _SHARED:
        values = [_at(job.meta, path) for cell in found for job in cell.jobs]
        rows.append((name, ", ".join(_distinct(str(value) for value in values if value is not None)) or "not stated"))
    return rows


def _spent(found: Sequence[Cell], planned: int | None) -> list[tuple[str, str]]:
    """How many jobs there are, and what they took, from the drawing of worlds to the scores."""
    parts: Counter[str] = Counter()
    jobs = [job for cell in found for job in cell.jobs]
    for job in jobs:
        parts.update({name: job.meta["seconds"].get(name, 0.0) for name in _TAKEN})
    shares = ", ".join(f"{what} {100 * parts[name] / parts.total():.0f} %" for name, what in _TAKEN.items() if parts[name])
    of = f" of {planned} that the experiment asks for" if planned else ""
    took = f"{_duration(parts.total())} ({shares})" if shares else "not stated"
    return [("jobs", f"{len(jobs)}{of}"), ("time of all jobs", took)]


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def _trained(found: Sequence[Cell]) -> list[tuple[str, str]]:
    """What networks were trained on, and what that cost, filter by filter."""
    rows = []
    for job in (job for cell in found for job in cell.jobs if job.meta.get("trained")):
        split, cost = job.meta["trained"]["split"], job.meta["trained"]["cost"]
        worlds = f"{split['train']['runs']} worlds of {split['scenario']}, " if split else ""
        spent = f"{cost['updates']} updates, {cost['seconds']:.0f} s on {cost['device']} ({cost['threads']} threads)"
        rows.append((f"training of {job.label}", worlds + spent))
    return list(dict.fromkeys(rows))


def _choices(found: Sequence[Cell]) -> list[tuple[str, str]]:
    """Each reading or choice that a job made, with the filters that made it."""
    made: dict[str, list[str]] = {}
    for cell in found:
        for job in cell.jobs:
            for text in job.meta.get("choices_made", ()):
                made.setdefault(text, []).append(job.label)
    everyone = {job.label for cell in found for job in cell.jobs}
    return [(text, "all" if set(who) == everyone else ", ".join(_distinct(who))) for text, who in sorted(made.items())]


def _distinct(values: Iterable[str]) -> list[str]:
    return sorted(set(values), key=natural)


def _at(meta: Any, path: str) -> Any:
    for name in path.split("."):
        meta = meta.get(name) if isinstance(meta, Mapping) else None
    return meta


def _plain(value: Any, digits: int | None = None) -> Any:
    """For JSON, which has no infinity; with so many digits, or all."""
    if isinstance(value, Mapping):
        return {name: _plain(below, digits) for name, below in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(below, digits) for below in value]
    if not isinstance(value, float):
        return value
    if not math.isfinite(value):
        return str(value)
    return value if digits is None else float(f"{value:.{digits}g}")


def _environment(escaping: bool) -> jinja2.Environment:
    """Of one kind of page: what templates share is escaped, or not, as the page that imports it needs."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(_HERE),
        autoescape=escaping,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"table": tables.html, "pipe": tables.markdown, "number": tables.number}
    return environment
