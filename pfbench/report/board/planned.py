"""Planned pairs of a study, decided by the levels of the board."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report.board.levels import (
    StudyArrays,
    arrange_runs,
    average_levels,
    compute_condition_levels,
)
from pfbench.report.board.pack_entries import round_values
from pfbench.report.looks import MethodLook, PartName, plan_look_pairs
from pfbench.report.options import ReportOptions
from pfbench.results.decisions.comparisons import TRACK
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.family_records import RUNS_WON
from pfbench.results.decisions.planned_pairs import decide_planned_pairs
from pfbench.results.decisions.sentences import describe_pair, describe_runs_won, describe_shares
from pfbench.results.job_labels import parse_label
from pfbench.results.statistics.paired_effects import ConditionEffects
from pfbench.results.study_decisions.main_metrics import main_rule

OPPOSITE = {"better": "worse", "worse": "better"}
_ENDS = ("estimate", "low", "high")
_NEAR = 0.1  # distance from 1 that is shown in percent with digits of its own


def decide_planned(
    table: pd.DataFrame, looks: Mapping[str, MethodLook], options: ReportOptions
) -> list[Decision]:
    """Decide the planned pairs that share runs.

    Args:
        table: Table of `build_run_table`.
        looks: Looks by label.
        options: Options of the report.
    """
    keys = ["family", "scenario", "regime", "seed", "run"]
    number = table.groupby(keys, sort=False, dropna=False, observed=True).ngroup()
    by_filter = {label: set(numbers) for label, numbers in number.groupby(table["filter"])}
    pairs = [(a, b) for a, b in plan_look_pairs(looks) if not by_filter[a].isdisjoint(by_filter[b])]
    if not pairs:
        return []
    groups = table["group"].unique()
    rule = main_rule(options.metric, groups[0] if len(groups) == 1 else "main")
    runs = table["seed"].map("{:012d}".format) + " " + table["run"].map("{:09d}".format)
    tidy = table.assign(run=runs, value=table[options.metric].fillna(math.inf))
    tidy = tidy[~(table[options.metric].isna() & table["keeps_track"])]
    return decide_planned_pairs(tidy, pairs, rule, options.decision_options)


def planned_words(planned: Sequence[Decision]) -> dict[tuple[str, str], str]:
    """Return the words of planned pairs for the verdict on the first filter against the second.

    Args:
        planned: Decisions on the planned pairs.
    """
    words = {}
    for d in planned:
        if d.question == "a" and d.metric != TRACK:
            words[d.a, d.b] = d.word
            words[d.b, d.a] = OPPOSITE.get(d.word, d.word)
    return {pair: {"better": "best"}.get(word, word) for pair, word in words.items()}


def planned_entries(
    planned: Sequence[Decision],
    table: pd.DataFrame,
    looks: Mapping[str, MethodLook],
    worlds: Mapping[str, PartName],
    options: ReportOptions,
) -> list[dict[str, Any]]:
    """List the entries of planned pairs, in ratios.

    Args:
        planned: Decisions on the planned pairs.
        table: Table of `build_run_table`.
        looks: Looks by label of the filter.
        worlds: Names of the scenarios by key.
        options: Options of the report.
    """
    if not planned:
        return []
    errors = {(d.question, d.a, d.b): d for d in planned if d.metric != TRACK}
    tracks = {(d.question, d.a, d.b): d for d in planned if d.metric == TRACK}
    runs = arrange_runs(table, tuple(looks))
    levels = compute_condition_levels(runs, options.metric)
    entries = []
    for (question, a, b), d in errors.items():
        if question != "a":
            continue
        new = errors["b", a, b]
        records = [
            replace(record, a=f"[[{looks[a].name}]]", b=f"[[{looks[b].name}]]")
            for record in (tracks["a", a, b], d)
        ]
        entry = {
            "a": a, "b": b, "question": "Error in these worlds", "kind": _find_kind(looks[a], looks[b]),
            "sentence": describe_pair(*records), **_list_ratios(d), "p": round_values(d.p_corrected), "word": d.pair_word,
            "reason": _describe_gap(d, tracks["a", a, b]) or None, "cells": _list_cells(runs, levels, (a, b), worlds, options.alpha) if d.scale == "log ratio" else [],
            "new_world": None if new.worlds < 2 else {**_list_ratios(new), "word": new.word},
            "prediction": None if new.worlds < 3 else [_ratio(new, new.new_low), _ratio(new, new.new_high)],
            "won": _list_won(d, new, tracks["a", a, b]),
        }  # fmt: skip
        entries.append(entry)
    return entries


def _find_kind(method: MethodLook, baseline: MethodLook) -> str:
    """Return whether a baseline is of the paper or a tuned one; empty for neither."""
    if parse_label(baseline.key)[0] in method.baselines:
        return "paper"
    return "tuned" if method.baselines and baseline.tuning else ""


def _describe_gap(decision: Decision, track: Decision) -> str:
    """Return the reason of a missing ratio or interval, empty if the pair has both.

    Where tracks are not kept, it has the shares of runs won and of runs that keep track, short enough for
    the cell of a table.
    """
    if decision.reason == RUNS_WON:
        text = f"runs won: {describe_runs_won(decision)}; track kept: {describe_shares(track)}"
        for long, short in (("difference ", ""), ("percentage points", "points"), (" of runs", "")):
            text = text.replace(long, short)
        return text
    if decision.reason:
        return decision.reason
    if decision.scale == "log ratio":
        return ""
    return "a difference, which is no ratio"


def _list_cells(
    runs: StudyArrays,
    levels: ConditionEffects,
    pair: tuple[str, str],
    worlds: Mapping[str, PartName],
    alpha: float,
) -> list[dict[str, Any]]:
    """List the ratio of a pair in each scenario with its own interval; none for one scenario."""
    i, j = (runs.filters.index(label) for label in pair)
    scenarios = runs.conditions["scenario"]
    if scenarios.nunique() < 2:
        return []
    cells = []
    for scenario in scenarios.unique():
        mask = (scenarios == scenario).to_numpy()
        selected = ConditionEffects(*(array[:, mask] for array in levels))
        estimate = average_levels(selected, runs.conditions[mask]).difference(i, j)
        if np.isfinite(estimate.value):
            ends = (estimate.value, *estimate.interval(alpha))
            cells.append({
                "world": scenario, "regime": "all", "name": worlds[scenario].name,
                **dict(zip(_ENDS, (round_ratio(float(end)) for end in ends), strict=True)),
            })  # fmt: skip
    return cells


def round_ratio(log_ratio: float) -> float | None:
    """Return a ratio with four digits, and four of its distance from 1 if it is near; None without a number.

    Args:
        log_ratio: Log ratio.
    """
    if not math.isfinite(log_ratio):
        return None
    distance = math.expm1(min(log_ratio, 700.0))
    if abs(distance) < _NEAR:
        return round(1 + float(f"{distance:.4g}"), 12)
    return float(f"{1 + distance:.4g}")


def _ratio(decision: Decision, value: float) -> float | None:
    """Return a log ratio as a ratio, None for an effect of another scale or an end that does not exist."""
    return round_ratio(value) if decision.scale == "log ratio" else None


def _list_ratios(decision: Decision) -> dict[str, float | None]:
    """Return the ratio of a decision and its interval."""
    return {name: _ratio(decision, getattr(decision, name)) for name in _ENDS}


def _list_won(decision: Decision, new: Decision, track: Decision) -> dict[str, Any] | None:
    """Return the difference of the shares of runs won in percentage points, and the shares of tracks kept.

    None for a pair that is decided by its errors.
    """
    if decision.reason != RUNS_WON:
        return None
    points, new_points = (
        dict(zip(_ENDS, (_round_points(v) for v in (d.estimate, d.high, d.low)), strict=True))
        for d in (decision, new)
    )
    has_new = new.worlds > 1 and new.scale == decision.scale
    return {
        **points, "track": [float(f"{share:.6g}") for share in (track.share_a, track.share_b)],
        "new_world": {**new_points, "word": new.word} if has_new else None,
    }  # fmt: skip


def _round_points(shares: float) -> float | None:
    """Return percentage points for the first filter, of an effect that is negative for it; None without a number."""
    return float(f"{-100 * shares:.6g}") if math.isfinite(shares) else None
