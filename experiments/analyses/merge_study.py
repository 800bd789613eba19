"""Add newer cells to a published study: `python experiments/analyses/merge_study.py FOLDER STUDY ...`.

A cell is a filter in a condition. FOLDER/STUDY is a report of some jobs of the study on the same runs, written by
`pfbench report reports_dir=FOLDER`. Cells that the published study lacks are added. All others are a check: their errors
must be those of the published study, and each condition needs one. The page is then decided again from all runs.

A filter with several numbers of particles has its number in its name in all conditions, as in a report of all jobs.
"""

from __future__ import annotations

import math
import re
import sys
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pfbench.files import RecordedFolder
from pfbench.report import (
    RUNS_FILE,
    StudyFacts,
    cell_entries,
    count_tuned,
    format_runs,
    read_stored_study,
    rebuild_page,
)

REPORTS = Path(__file__).parents[2] / "reports"
CONDITION = ["scenario", "regime"]
RUN = [*CONDITION, "filter", "seed", "run"]
TOLERANCE = 1e-5  # relative, of errors that are stored in single precision
_COUNTS = ("runs", "lost", "diverged", "collapsed", "severely_overconfident")
_NUMBER = {"particles", "budget"}  # settings of a label that a number of particles replaces
_WORLD = re.compile(r"(?<=\)), ")  # worlds of a tuning end with their settings in brackets
Pack = dict[str, Any]


def name_by_number(tables: Sequence[pd.DataFrame]) -> list[dict[str, str]]:
    """Name the filters of reports of one study by their numbers of particles, where a filter has several.

    Args:
        tables: Runs of the reports.

    Returns:
        New labels by the labels of each report.

    Raises:
        ValueError: If a label of a report stands for several numbers of particles that need names of their own.
    """
    numbers: dict[str, set[float]] = {}
    found = []
    for table in tables:
        counts: dict[str, set[float]] = {}
        for label, rows in table.groupby(table["filter"].astype(str)):
            counts[str(label)] = set(rows["particles"].dropna())
            if name := find_numbered_name(str(label)):
                numbers.setdefault(name, set()).update(counts[str(label)])
        found.append(counts)
    return [
        {label: _name_by_number(label, some, numbers) for label, some in counts.items()}
        for counts in found
    ]


def find_numbered_name(label: str) -> str:
    """Return the name of a filter without its number of particles; empty at equal time, or with other settings."""
    name, _, text = label.partition("[")
    is_numbered = set(re.findall(r"([\w.]+)=", text)) <= _NUMBER and "budget=time" not in text
    return name if is_numbered else ""


def _name_by_number(label: str, counts: set[float], numbers: Mapping[str, set[float]]) -> str:
    """Return the new label of a filter that has some numbers of particles in a report."""
    name = find_numbered_name(label)
    if not name:
        return label
    if len(numbers[name]) <= 1:
        return name
    if len(counts) != 1:
        raise ValueError(
            f"{label} must have one number of particles in each report, got {sorted(counts)}. "
            "Write a report of the jobs of each number."
        )
    return f"{name}[particles={int(*counts)}]"


def merge_runs(
    published: pd.DataFrame, newer: pd.DataFrame, has_rounds: bool = False
) -> pd.DataFrame:
    """Add the cells that a published study lacks, and check those that both have.

    Args:
        published: Runs of the published study, with the labels of `name_by_number`.
        newer: Runs of the newer report, with the same.
        has_rounds: Whether the times of the published study are those of rounds. New cells have no time then.

    Raises:
        ValueError: If a condition of the newer report has no cell of the published study, or one whose errors differ.
    """
    cell = [*CONDITION, "filter"]
    rows = newer.merge(published[cell].drop_duplicates(), on=cell, how="left", indicator="place")
    common, added = rows[rows["place"] == "both"], rows[rows["place"] == "left_only"]
    pairs = common.merge(published, on=RUN, suffixes=("", "_published"))
    runs = [
        set(_list_runs(table))
        for table in (newer, published.merge(newer[CONDITION].drop_duplicates()))
    ]
    lacking = set(_list_conditions(added)) - set(_list_conditions(pairs))
    if lacking or len(pairs) < len(common) or runs[0] != runs[1]:
        raise ValueError(
            "each condition of the newer report must have a filter of the published study on the same runs, got "
            f"{len(runs[0] ^ runs[1])} other runs and {len(lacking)} conditions without one. Run ekf in each of them."
        )
    errors, expected = pairs["rmse"].to_numpy(), pairs["rmse_published"].to_numpy()
    differs = ~np.isclose(errors, expected, rtol=TOLERANCE, atol=0.0, equal_nan=True)
    if differs.any():
        raise ValueError(
            f"errors of {', '.join(sorted(set(pairs['filter'][differs].astype(str))))} must be those of the published "
            "study, got others. The data have changed: run the whole study again."
        )
    new = added[list(newer.columns)]
    if has_rounds:  # a time of a single job does not stand beside those of rounds
        new = new.assign(ms=math.nan)
    return pd.concat([published, new], ignore_index=True)


def _list_conditions(table: pd.DataFrame) -> list[tuple[Any, ...]]:
    """List the conditions of runs."""
    return [tuple(row) for row in table[CONDITION].drop_duplicates().to_numpy()]


def _list_runs(table: pd.DataFrame) -> list[tuple[Any, ...]]:
    """List the runs of a study, without their filters."""
    return [tuple(row) for row in table[[*CONDITION, "seed", "run"]].drop_duplicates().to_numpy()]


def select_added_notes(
    notes: Sequence[Mapping[str, Any]], published: pd.DataFrame, newer: pd.DataFrame
) -> list[Mapping[str, Any]]:
    """Select the notes on filters whose cells are all new.

    Args:
        notes: Notes of the newer report.
        published: Runs of the published study.
        newer: Runs of the newer report.

    Raises:
        ValueError: If some cells of a filter are new and others a check, whose notes would count twice.
    """
    known = set(map(tuple, published[[*CONDITION, "filter"]].drop_duplicates().to_numpy()))
    selected = []
    for note in notes:
        cells = newer[newer["filter"] == note["filter"]][[*CONDITION, "filter"]].drop_duplicates()
        new = [tuple(cell) not in known for cell in cells.to_numpy()]
        if any(new) and not all(new):
            raise ValueError(
                f"{note['filter']} must be new in all conditions of the report or in none, got {sum(new)} of "
                f"{len(new)}. Write a report of the others."
            )
        selected += [note] * all(new)
    return selected


def rename_pack(pack: Pack, names: Mapping[str, str]) -> Pack:
    """Give the filters of a page new labels; several old labels may have the same one."""
    looks: dict[str, Pack] = {}
    for look in pack["facts"]["looks"]:
        key = names[look["key"]]
        other = looks.get(key, {**look, "tuning": "", "tuned_on": ""})
        texts = {name: join_tunings([other[name], look[name]]) for name in ("tuning", "tuned_on")}
        looks[key] = {**other, **texts, "key": key}
    by_name = {look.name: names[label] for label, look in StudyFacts.from_pack(pack).looks.items()}
    return {
        **pack,
        "facts": {**pack["facts"], "looks": list(looks.values())},
        "curves": {
            key: {**curve, "filters": {names[k]: v for k, v in curve["filters"].items()}}
            for key, curve in pack["curves"].items()
        },
        "filter_notes": add_notes({**n, "filter": names[n["filter"]]} for n in pack["filter_notes"]),
        "choices": {
            entry["text"]: _read_names(entry["filters"], by_name) for entry in pack["choices"]
        },
        "methods": {
            **pack["methods"],
            "particles": _join_lists([{names[k]: v} for k, v in pack["methods"]["particles"].items()]),
        },
    }  # fmt: skip


def _read_names(text: str, labels: Mapping[str, str]) -> set[str]:
    """Return the labels of filters whose names are in a list of a page."""
    if text == "all filters":
        return set(labels.values())
    return {labels[name] for name in re.split(r", (?![^\[]*\])", text)}


def add_notes(notes: Iterable[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Add the counts of notes on the same filter."""
    added: dict[str, dict[str, Any]] = {}
    for note in notes:
        old = added.get(note["filter"])
        if old is None:
            added[note["filter"]] = dict(note)
            continue
        counts = {name: _add(old[name], note[name]) for name in _COUNTS}
        bounded = {old["has_bounded_weights"], note["has_bounded_weights"]}
        added[note["filter"]] = {
            **old,
            **counts,
            "particles": join_texts([old["particles"], note["particles"]], " or "),
            "is_exact": old["is_exact"] and note["is_exact"],
            "has_bounded_weights": None if None in bounded else all(bounded),
        }
    return list(added.values())


def _add(first: int | None, second: int | None) -> int | None:
    """Add two counts; one that does not exist is left out."""
    numbers = [number for number in (first, second) if number is not None]
    return sum(numbers) if numbers else None


def join_texts(texts: Sequence[str], separator: str) -> str:
    """Join lists in words, each entry once."""
    parts = [part for text in texts if text for part in text.split(separator)]
    return separator.join(dict.fromkeys(parts))


def join_tunings(texts: Sequence[str]) -> str:
    """Join lists of worlds on which a filter was tuned, in one order: equal lists are told once on a page."""
    return ", ".join(sorted({world for text in texts if text for world in _WORLD.split(text)}))


def _join_lists(tables: Sequence[Mapping[str, Sequence[Any]]]) -> dict[str, list[Any]]:
    """Join lists by name, each entry once."""
    joined: dict[str, list[Any]] = {}
    for table in tables:
        for name, values in table.items():
            known = joined.setdefault(name, [])
            known += [value for value in values if value not in known]
    return joined


def merge_packs(published: Pack, newer: Pack, runs: pd.DataFrame) -> Pack:
    """Merge what a page has beside its decisions: looks, curves, notes, failures and provenance.

    Args:
        published: Data of the published page, of `rename_pack`.
        newer: Data of the newer page, of `rename_pack`.
        runs: Runs of the merged study.

    Raises:
        ValueError: If the newer page has times per step in rounds.
    """
    if newer["facts"]["times"]:
        raise ValueError(
            "a report to merge must have one time per job, got rounds of `pfbench cost`. Leave it out for this report."
        )
    looks = {look["key"]: look for look in (*newer["facts"]["looks"], *published["facts"]["looks"])}
    for look in newer["facts"]["looks"]:
        texts = [looks[look["key"]]["tuning"], look["tuning"]]
        looks[look["key"]] = {**looks[look["key"]], "tuning": join_tunings(texts)}
    curves = dict(published["curves"])
    for key, added in newer["curves"].items():
        own = curves[key]["filters"]
        new = {
            label: interpolate_curve(curve, added["t"], curves[key]["t"])
            for label, curve in added["filters"].items()
            if label not in own
        }
        curves[key] = {**curves[key], "filters": dict(sorted({**own, **new}.items()))}
    stored = dict(newer["provenance"])
    generated = {
        name: join_texts([published["generated"][name], newer["generated"][name]], ", ")
        for name in published["generated"]
    }
    facts = {
        **published["facts"],
        "looks": [looks[label] for label in sorted(looks)],
    }
    pack = {
        **published,
        "generated": {**generated, "date": newer["generated"]["date"]},
        "curves": curves,
        "cells": cell_entries(runs),
        "facts": facts,
        "failures": list(
            {e["key"]: e for e in (*published["failures"], *newer["failures"])}.values()
        ),
        "provenance": [
            [name, join_texts([value, stored.get(name, "")], ", ")]
            for name, value in published["provenance"]
        ],
        "choices": {**published["choices"], **newer["choices"]},
    }
    present = StudyFacts.from_pack(pack).looks
    pack["choices"] = [
        _name_choice(text, [p["choices"].get(text, set()) for p in (published, newer)], present)
        for text in sorted(pack["choices"])
    ]
    pack["methods"] = _merge_methods(published["methods"], newer["methods"], pack, runs)
    return pack


def interpolate_curve(
    curve: Mapping[str, Sequence[float | None]], times: Sequence[float], wanted: Sequence[float]
) -> dict[str, list[float | None]]:
    """Interpolate quantiles of the error to the instants of another page, which has fewer. None is a lost error.

    Args:
        curve: Quantiles by name, at each of the times.
        times: Instants of the curve, s.
        wanted: Instants of the other page, s.
    """
    found = {}
    for name, values in curve.items():
        numbers = [math.nan if value is None else value for value in values]
        at = np.interp(wanted, times, numbers)
        found[name] = [None if math.isnan(value) else float(f"{value:.4g}") for value in at]
    return found


def _name_choice(text: str, labels: Sequence[set[str]], looks: Mapping[str, Any]) -> dict[str, str]:
    """Return the entry of a modelling choice, with the present names of its filters."""
    members = set().union(*labels)
    names = ", ".join(look.name for label, look in looks.items() if label in members)
    return {"text": text, "filters": "all filters" if members == set(looks) else names}


def _merge_methods(old: Pack, new: Pack, pack: Pack, runs: pd.DataFrame) -> Pack:
    """Merge the facts of the methods paragraph."""
    looks = StudyFacts.from_pack(pack).looks
    conditions = runs.groupby(CONDITION)["filter"].nunique()
    return {
        **old,
        "filters": len(looks),
        "particles": _join_lists([old["particles"], new["particles"]]),
        "software": _join_lists([old["software"], new["software"]]),
        "tuned": count_tuned(looks),
        "is_complete": bool((conditions == len(looks)).all()),
    }


def merge_study(study: str, folder: Path, reports: Path = REPORTS) -> list[str]:
    """Add the cells of a newer report to a published study and write its page again.

    Args:
        study: Name of the study.
        folder: Folder of newer reports.
        reports: Folder of published reports.

    Returns:
        Added cells as "scenario / filter".
    """
    stored = [read_stored_study(place / study) for place in (reports, folder)]
    names = name_by_number([table for _, table in stored])
    (published, old), (newer, new) = (
        (rename_pack(pack, labels), table.assign(filter=table["filter"].astype(str).map(labels)))
        for (pack, table), labels in zip(stored, names, strict=True)
    )
    runs = merge_runs(old, new, bool(published["facts"]["times"]))
    cells = [
        set(map(tuple, table[["scenario", "filter"]].drop_duplicates().to_numpy()))
        for table in (old, new)
    ]
    added = select_added_notes(newer["filter_notes"], old, new)
    pack = merge_packs(published, newer, runs)
    pack["filter_notes"] = add_notes([*published["filter_notes"], *added])
    with RecordedFolder(reports / study, is_complete=False) as target:
        target.write(RUNS_FILE, format_runs(runs, pack))
    rebuild_page(reports / study)
    return [" / ".join(cell) for cell in sorted(cells[1] - cells[0])]


if __name__ == "__main__":
    for name in sys.argv[2:]:
        print(f"{name}: {', '.join(merge_study(name, Path(sys.argv[1])))}")
