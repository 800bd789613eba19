"""Entries of the data of a page: filters, parts, metrics and planned pairs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import pandas as pd

from pfbench.report.board.run_table import METRIC_NAMES, SHOWN_METRICS
from pfbench.report.looks import MethodLook, PartName
from pfbench.results.conditions import Condition
from pfbench.results.decisions.comparisons import TRACK
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.sentences import describe_pair

OPPOSITE = {"better": "worse", "worse": "better"}


def list_metrics(table: pd.DataFrame) -> list[str]:
    """List the metrics that have values, and the main one though all runs are lost."""
    return [name for name in SHOWN_METRICS if name == "rmse" or table[name].notna().any()]


def planned_words(planned: Sequence[Decision]) -> dict[tuple[str, str], str]:
    """Return the words of planned pairs for the verdict on the first filter against the second."""
    words = {}
    for d in planned:
        if d.question == "a" and d.metric != TRACK:
            words[d.a, d.b] = d.word
            words[d.b, d.a] = OPPOSITE.get(d.word, d.word)
    return {pair: {"better": "best"}.get(word, word) for pair, word in words.items()}


def planned_entries(
    planned: Sequence[Decision], looks: Mapping[str, MethodLook]
) -> list[dict[str, Any]]:
    """Return the entries of planned pairs, in ratios.

    Args:
        planned: Decisions on the planned pairs.
        looks: Looks by label of the filter.
    """
    errors = {(d.question, d.a, d.b): d for d in planned if d.metric != TRACK}
    entries = []
    for (question, a, b), d in errors.items():
        if question != "a":
            continue
        new = errors["b", a, b]
        track = next(t for t in planned if (t.a, t.b, t.question, t.metric) == (a, b, "a", TRACK))
        ratios = {k: _ratio(d, getattr(d, k)) for k in ("estimate", "low", "high")}
        entry = {
            "a": a, "b": b, "question": "Error in these worlds", "kind": "paper" if b in looks[a].baselines else "",
            "sentence": describe_pair(track, d), **ratios, "p": d.p_corrected, "word": d.pair_word,
            "cells": [],
            "new_world": None if new.worlds < 2 else {
                **{k: _ratio(new, getattr(new, k)) for k in ("estimate", "low", "high")}, "word": new.word,
            },
            "prediction": None if new.worlds < 3 else [_ratio(new, new.new_low), _ratio(new, new.new_high)],
        }  # fmt: skip
        entries.append(round_values(entry))
    return entries


def _ratio(decision: Decision, value: float) -> float:
    """Return a log ratio as a ratio, NaN for an effect of another scale."""
    if decision.scale != "log ratio":
        return math.nan
    return math.exp(value) if value < 700 else math.inf


def round_values(values: Any) -> Any:
    """Round numbers to four digits; a number that is not finite becomes None."""
    if isinstance(values, dict):
        return {key: round_values(value) for key, value in values.items()}
    if isinstance(values, list):
        return [round_values(value) for value in values]
    if isinstance(values, float):
        return float(f"{values:.4g}") if math.isfinite(values) else None
    return None if values == "" else values


def describe_versions(conditions: Sequence[Condition]) -> dict[str, str]:
    """Return commit, date and version of the results."""
    metadata = [job.meta for c in conditions for job in c.jobs]
    versions = metadata[0].get("versions", {})
    return {
        "commit": str(versions.get("commit") or "")[:7],
        "date": max(str(meta.get("created", ""))[:10] for meta in metadata),
        "version": str(versions.get("pfbench", "")),
    }


def filter_entry(look: MethodLook) -> dict[str, Any]:
    """Return the entry of a filter."""
    return {
        "key": look.key, "name": look.name, "long": look.long_name, "family": look.family,
        "proposed": look.proposed, "colour": look.colour, "dark": look.dark_colour,
        "marker": look.marker, "cite": look.cite,
    }  # fmt: skip


def regime_entries(table: pd.DataFrame, regimes: Mapping[str, PartName]) -> list[dict[str, Any]]:
    """List the entries of the noise regimes.

    Args:
        table: Table of `build_run_table`.
        regimes: Names by key.
    """
    entries = []
    for key in table["regime"].unique():
        noise, _, model = key.partition(" + ")
        name = f"{regimes[noise].name} + {model}" if model else regimes[noise].name
        entries.append({"key": key, "name": name, "words": regimes[noise].words})
    return entries


def cell_entries(table: pd.DataFrame) -> list[dict[str, Any]]:
    """List the entries of the cells."""
    cells = []
    for (world, regime), rows in table.groupby(["scenario", "regime"], sort=False):
        particles = rows["particles"].max()
        cells.append({
            "key": f"{world}/{regime}", "world": world, "regime": regime, "model": rows["model"].iloc[0],
            "runs": int(rows.groupby("filter").size().max()), "seed": int(rows["seed"].iloc[0]),
            "particles": None if math.isnan(particles) else int(particles),
        })  # fmt: skip
    return cells


def metric_entries(table: pd.DataFrame) -> list[dict[str, Any]]:
    """List the entries of the metrics."""
    units, groups = table["unit"].unique(), table["group"].unique()
    unit, group = units[0] if len(units) == 1 else "", groups[0] if len(groups) == 1 else "main"
    return [
        {"key": key, "name": METRIC_NAMES[key], "unit": unit, "direction": "lower",
         "caption": f"{METRIC_NAMES[key]} of the group {group}."} for key in list_metrics(table)
    ]  # fmt: skip
