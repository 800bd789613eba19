"""View of a board: the filters of a selection of conditions against one baseline, with a sentence."""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache, cached_property
from typing import Any

import numpy as np
import pandas as pd
import scipy  # scipy.stats is imported at its first use

from pfbench.results.looks import MethodLook
from pfbench.results.step_times import StepTimes, describe_costs
from pfbench.stats.comparison import (
    EQUAL_WORDS,
    EQUALITY_MARGIN,
    MIN_RUNS,
    Verdict,
)
from pfbench.stats.consistency_bands import compare_share
from pfbench.stats.court import Court, find_lost_conditions
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.rank_tests import holm
from pfbench.stats.sentences import format_with_interval
from pfbench.stats.study_runs import StudyRuns, compute_losses, weigh_conditions

BASE, MISSING, LOSES_TRACK = "baseline", "missing", "loses track"
_SAME_LEVEL = 1e-6
_INTERVAL_LEVEL = 0.9
_MOST_WORDS = 55  # of the sentence of a view
BoardRow = dict[str, Any]


@dataclass(frozen=True)
class View:
    """Filters in the conditions of a view, whatever the baseline.

    Attributes:
        court: Court that decides the pairs of the study.
        mask: Conditions of the view, [C].
        metric: Column of the error.
        unit: Unit of the error, empty for several conditions.
        filters: Description of each filter, see `describe_filters`.
        times: Times of the filters in rounds, by label in each condition.
        has_limit: Whether all scenarios state a divergence threshold.
        scope: Scenario and noise regime, or "all".
        groups: Unit and main group of each condition.
        where: Words on the scope.
        small_print: Note below the view.
    """

    court: Court
    mask: Flags
    metric: str
    unit: str
    filters: Mapping[str, BoardRow]
    times: Sequence[Mapping[str, StepTimes]]
    has_limit: bool
    scope: tuple[str, str] = ("", "")
    groups: pd.DataFrame = field(default_factory=pd.DataFrame)
    where: str = ""
    small_print: str = ""

    @cached_property
    def runs(self) -> StudyRuns:
        """Runs of the conditions of the view."""
        return self.court.runs.select(self.mask)


def build_rows(view: View, baseline: str) -> list[BoardRow]:
    """Build the rows of a view, ordered by level; filters that lack a condition come last.

    A row has filter, rank, value with its interval (of a single condition), ratio with its simultaneous interval,
    verdict and its words, and the description of the filter. A value that does not exist is NaN.
    """
    runs, alpha = view.runs, view.court.alpha
    complete = np.all(runs.present.any(axis=2), axis=1)
    verdicts = find_against(view, baseline, complete)
    values = summarise_levels(view)
    level = np.where(complete, values[0], np.nan)
    track = np.array([view.filters[label]["track"] for label in runs.filters])
    order = np.lexsort((np.array(runs.filters), -track, level)).tolist()
    rows = []
    for i in order:
        label = runs.filters[i]
        costs = describe_costs(view.times, label, baseline, alpha)
        rows.append({
            "filter": label,
            "rank": int((level < level[i] - _SAME_LEVEL).sum()) + 1 if complete[i] else None,
            **_show_level(view, values[:, i]), "unit": view.unit,
            **_show_verdict(view, label, verdicts), **view.filters[label], **costs,
        })  # fmt: skip
        if complete[i] and label not in verdicts:
            rows[-1]["words"] = "the baseline was not run in all conditions"
    return rows


def find_against(view: View, baseline: str, complete: Flags) -> dict[str, Verdict | None]:
    """Find the verdicts on all filters of a view against a baseline; None for the baseline."""
    labels = [name for name, is_there in zip(view.runs.filters, complete, strict=True) if is_there]
    others = [name for name in labels if name != baseline and baseline in labels]
    verdicts = {name: view.court.find(view.metric, view.mask, name, baseline) for name in others}
    return {baseline: None, **verdicts}


def summarise_levels(view: View) -> Array:
    """Summarise the losses of each filter: mean over conditions of the logs of median errors, and an interval.

    Returns level and, for a single condition, the ends of the interval of its median, [3, F]. A level is infinite
    where half of the runs are lost.
    """
    losses = compute_losses(view.runs, view.metric)
    ordered, count = np.sort(losses, axis=2), (~np.isnan(losses)).sum(axis=2, keepdims=True)
    middle = [np.maximum(count - 1, 0) // 2, count // 2]  # of errors, as a reader takes the median
    pair = (np.take_along_axis(ordered, places, axis=2)[..., 0] for places in middle)
    with np.errstate(invalid="ignore"):
        medians = np.logaddexp(*pair) - math.log(2.0)
        level = medians @ weigh_conditions(view.runs.conditions)
    ends = np.full((2, len(level)), np.nan)
    if losses.shape[1] == 1:
        for i, row in enumerate(losses[:, 0]):
            ends[:, i] = _interval_of_median(row[~np.isnan(row)], view.court.alpha)
    return np.stack([level, *ends])


def _interval_of_median(values: Array, alpha: float) -> tuple[float, float]:
    """Return the order statistics that contain the median with probability 1 - alpha; NaN if none do."""
    k = _count_below(len(values), alpha)
    if k < 0:
        return math.nan, math.nan
    ordered = np.sort(values)
    return float(ordered[k]), float(ordered[len(values) - 1 - k])


@cache
def _count_below(n: int, alpha: float) -> int:
    """Return the number of values below the interval of a median of n values; -1 without an interval."""
    below = scipy.stats.binom.cdf(np.arange(n), n, 0.5) if n else np.ones(1)
    return int((below <= alpha / 2).sum()) - 1


def _show_level(view: View, level: Array) -> BoardRow:
    """Return the error of a filter and its interval, NaN for several conditions or a level of lost runs."""
    is_known = len(view.runs.conditions) == 1 and math.isfinite(level[0])
    logs = np.where(np.isfinite(level), level, np.nan) if is_known else np.full(3, np.nan)
    return dict(zip(("value", "low", "high"), map(float, np.exp(logs)), strict=True))


def _show_verdict(view: View, label: str, verdicts: Mapping[str, Verdict | None]) -> BoardRow:
    """Return ratio, interval, verdict and words of a row."""
    ends = {**dict.fromkeys(("ratio", "ratio_low", "ratio_high", "p"), math.nan), "loses": ""}
    if label not in verdicts:
        return {**ends, "verdict": MISSING, "words": "not run in all conditions"}
    verdict, track = verdicts[label], _word_lost(view, label)
    if verdict is None:
        ends |= dict.fromkeys(("ratio", "ratio_low", "ratio_high"), 1.0)
        return {**ends, "verdict": BASE, "words": ", ".join(filter(None, (BASE, track)))}
    ends = {
        "ratio": verdict.ratio, "ratio_low": verdict.low, "ratio_high": verdict.high, "p": verdict.p,
        "loses": verdict.lost.word,
    }  # fmt: skip
    if track and len(view.runs.conditions) == 1:
        return {**ends, "verdict": LOSES_TRACK, "words": track}
    a, b, both, loses = verdict.lost
    words = word_verdict(verdict, view.court.margin)
    if math.isnan(verdict.ratio) and a + b + both:  # its reason has labels
        counts = f"({a + both} of {verdict.n}, the baseline {b + both})"
        words = f"{word_verdict(verdict._replace(reason=''), view.court.margin)}{'' if loses else ', lost runs'} {counts}"
    return {**ends, "verdict": verdict.word, "words": ", ".join(filter(None, (words, track)))}


def word_verdict(verdict: Verdict, margin: float = EQUALITY_MARGIN) -> str:
    """Word a verdict: with the margin of an equal pair, whether it loses more runs, and what a reader must know."""
    within = f" within {100 * math.expm1(margin):.3g} %" * (verdict.word in EQUAL_WORDS[:2])
    loses = f"{verdict.lost.word} runs" if verdict.lost.word else ""
    return ", ".join(filter(None, (f"{verdict.word}{within}", loses, verdict.reason)))


def _word_lost(view: View, label: str) -> str:
    """State that a filter loses track, with the share of runs or the conditions; empty if it is not shown."""
    lost, count = view.filters[label]["lost_conditions"], len(view.runs.conditions)
    verb = "loses track" if view.has_limit else "loses runs"
    if not lost:
        return ""
    share = f"{100 * (1 - view.filters[label]['track']):.0f} %"
    return f"{verb} in {lost}/{count}" if count > 1 else f"{verb} in {share} of runs"


def describe_filters(runs: StudyRuns, alpha: float = 0.05) -> dict[str, BoardRow]:
    """Describe track, lost runs, coverage and cost of each filter.

    Conditions in which a filter loses track, and coverage that differs from 90 %, are shown by tests with Holm's
    correction over all of them.
    """
    names = ("keeps_track", "coverage_90", "nees_ratio", "ms")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # filters without runs
        by_condition = {name: np.nanmean(runs.values[name], axis=2) for name in names}
        track, coverage, nees = (np.nanmean(by_condition[name], axis=1) for name in names[:3])
        cost = np.exp(np.nanmean(np.log(by_condition["ms"]), axis=1))
        by_run = np.nanmean(runs.values["coverage_90"], axis=1)
        lost = np.nansum(runs.values["lost"], axis=(1, 2))
    lost_conditions = find_lost_conditions(runs, alpha).sum(axis=1)
    calibration = word_calibration(by_run, alpha)
    return {
        label: {
            "track": float(track[i]), "lost": int(lost[i]), "lost_conditions": int(lost_conditions[i]),
            "coverage": float(coverage[i]), "nees": float(nees[i]), "calibration": calibration[i],
            "ms": float(cost[i]),
        }
        for i, label in enumerate(runs.filters)
    }  # fmt: skip


def word_calibration(coverage: Array, alpha: float) -> list[str]:
    """Return "too low" or "too high" where the mean coverage [F, N] of 90 % intervals is shown to differ; else empty."""
    by_run = [row[~np.isnan(row)] for row in coverage]
    p = holm([compare_share(a, _INTERVAL_LEVEL) if a.size >= MIN_RUNS else 1.0 for a in by_run])
    return [
        "" if value >= alpha else "too low" if a.mean() < _INTERVAL_LEVEL else "too high"
        for a, value in zip(by_run, p, strict=True)
    ]


# --------------------------------------------------------------------------------------------------
# The sentence of a view: at most 55 words on the opening screen.


def describe_view(
    rows: Sequence[BoardRow],
    looks: Mapping[str, MethodLook],
    baseline: str,
    where: str,
    metric: str,
) -> str:
    """Describe a view: how many filters are better, equal, worse and not decided, and the best proposed method.

    Names of filters are enclosed in double square brackets.
    """
    base = f"[[{looks[baseline].name}]]"
    others = [row for row in rows if row["verdict"] not in (BASE, MISSING)]
    if not others:
        value = next((row for row in rows if row["filter"] == baseline), rows[0])
        if value["verdict"] == MISSING:
            return f"{base} has no runs {where}, so that no filter is compared with it."
        number = (
            ""
            if math.isnan(value["value"])
            else f" of {value['value']:.3g} {value['unit']}".rstrip()
        )
        return f"{base} has a median {metric}{number} {where}; no other filter is compared with it."
    better = [row for row in others if row["verdict"] == "better"]  # in the order of the table
    counts = [
        (sum(r["verdict"] in EQUAL_WORDS for r in others), "equal to it"),
        (sum(r["verdict"] == "not decided" for r in others), "not decided"),
        (sum(r["verdict"] == "worse" for r in others), "worse"),
        (sum(r["verdict"] == LOSES_TRACK for r in others), "without track"),
    ]
    rest = ", ".join(f"{n} {'is' if n == 1 else 'are'} {text}" for n, text in counts if n)
    head = (
        f"Of {len(others)} {'filter' if len(others) == 1 else 'filters'}, {len(better) or 'none'}"
    )
    head += f" {'is' if len(better) < 2 else 'are'} better than {base} {where}"
    if better:
        first = better[0]
        size = _word_ratio(first)
        text = f", {size} of its {metric}" if size else ""
        position = "first in the table" if first is rows[0] else "the first of them"
        head += f" ({position}: [[{looks[first['filter']].name}]]{text})"
    head = f"{head}; {rest}." if rest else f"{head}."
    if f"[[{looks[rows[0]['filter']].name}]]" not in head:
        head += f" First in the table: [[{looks[rows[0]['filter']].name}]], {rows[0]['verdict']}."
    texts = [f"{head} {text}".rstrip() for text in _describe_proposed(others, better, looks)]
    return next((text for text in texts if len(text.split()) <= _MOST_WORDS), head)


def _describe_proposed(
    others: Sequence[BoardRow], better: Sequence[BoardRow], looks: Mapping[str, MethodLook]
) -> list[str]:
    """State the first proposed method of the table, with its interval and without; empty if the sentence names it."""
    proposed = [row for row in others if looks[row["filter"]].proposed]
    if not proposed or (better and looks[better[0]["filter"]].proposed):
        return [""]
    row = next((r for r in proposed if r["verdict"] != LOSES_TRACK), proposed[0])
    head = f"First proposed method: [[{looks[row['filter']].name}]]"
    sizes = dict.fromkeys((_word_ratio(row), _word_ratio(row).partition(" ")[0]))
    return [", ".join(filter(None, (head, size, row["verdict"]))) + "." for size in sizes]


def _word_ratio(row: BoardRow) -> str:
    """Format the ratio of a row with its interval; empty where lost runs leave none."""
    if math.isnan(row["ratio"]):
        return ""
    return format_with_interval(row["ratio"], row["ratio_low"], row["ratio_high"])


def shorten_view(sentence: str) -> str:
    """Shorten the sentence of a view where it is longer than the opening screen allows."""
    return (
        sentence
        if len(sentence.split()) <= _MOST_WORDS
        else sentence.replace("(first in the table: ", "(first: ").replace(
            "First in the table: ", "First: "
        )
    )
