"""Views of a study: the filters of a selection of conditions against one baseline by one metric, with a sentence."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache, cached_property
from typing import Any

import numpy as np
import pandas as pd
import scipy  # scipy.stats is imported at its first use

from pfbench.report.board.entries import (
    StudyFacts,
    ViewKey,
    format_interval_level,
    list_metrics,
    round_values,
)
from pfbench.report.journal.study_pack import ALL
from pfbench.results.looks import (
    MethodLook,
    count_tuned,
    describe_data_settings,
    describe_settings,
    describe_tuning,
)
from pfbench.results.metrics import page_metrics
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
from pfbench.stats.sentences import format_count, format_with_interval
from pfbench.stats.study_runs import (
    StudyRuns,
    compute_losses,
    select_conditions,
    weigh_conditions,
)

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


def build_views(
    court: Court, groups: pd.DataFrame, facts: StudyFacts, baselines: Sequence[str]
) -> dict[ViewKey, dict[str, Any]]:
    """Build all views that have runs. The first one opens the page.

    Args:
        court: Court that decides the pairs of the study.
        groups: Unit and main group by scenario and regime.
        facts: Names, options and times of the study.
        baselines: Labels of the baselines.
    """
    scopes = [_make_view(court, scope, groups, facts) for scope in _list_scopes(court.runs.conditions)]  # fmt: skip
    views: dict[ViewKey, dict[str, Any]] = {}
    for metric in list_metrics(court.runs.values, facts.options.metric):
        entry = page_metrics()[metric]
        for scope in scopes:
            names, units = scope.groups["group"], scope.groups["unit"]
            has_unit = len(units) == 1 and entry.is_of_group
            view = replace(scope, metric=metric, unit=units.iloc[0] if has_unit else "")
            is_one = names.nunique() == 1 and entry.is_of_group
            name = f"{names.iloc[0]} {entry.page_name}" if is_one else entry.page_name
            for baseline in baselines:
                rows = build_rows(view, baseline)
                views[ViewKey(metric, *view.scope, baseline)] = {
                    "sentence": describe_view(rows, facts.looks, baseline, view.where, name),
                    "small_print": view.small_print,
                    "rows": [_round_row(row, view.has_limit) for row in rows],
                }
    return views


def _make_view(
    court: Court, scope: tuple[str, str, Flags], groups: pd.DataFrame, facts: StudyFacts
) -> View:
    """Collect the data of a scope, and what is said of it whatever the metric."""
    world, regime, in_scope = scope
    mask = select_common(court.runs, in_scope)
    runs = court.runs.select(mask)
    keys = list(runs.conditions[["scenario", "regime"]].itertuples(index=False, name=None))
    times = [facts.times.get(key, {}) for key in keys]
    count, total = int(mask.sum()), format_count(int(in_scope.sum()), "condition")
    common = "" if count == in_scope.sum() else (
        f"{count} of {total} {'is' if count == 1 else 'are'} compared: "
        f"not all {len(runs.filters)} filters were run in the others. "
    )  # fmt: skip
    notes = f"{common}{_small_print(runs, facts)} {_describe_timing(runs, times, court.alpha)}"
    worlds = [facts.worlds.get(name) for name in runs.conditions["scenario"].unique()]
    return View(
        court, mask, "", "", describe_filters(runs, facts.options.alpha), times,
        all(name is None or name.limit is not None for name in worlds), (world, regime), groups.loc[keys],
        _describe_scope(runs.conditions, facts), notes.rstrip(),
    )  # fmt: skip


def _round_row(row: BoardRow, has_limit: bool) -> BoardRow:
    """Return the values of a row for the page: no track without a divergence threshold, an open interval as infinity.

    Pages print three digits. A number that was rounded to four before could have another third one than its sentence.
    """
    rounded: BoardRow = round_values(row if has_limit else {**row, "track": math.nan}, 8)
    return rounded | ({"ratio_high": math.inf} if row["ratio_high"] == math.inf else {})


def _list_scopes(conditions: pd.DataFrame) -> Iterator[tuple[str, str, Flags]]:
    """Yield world, regime and mask of the conditions of each scope that has conditions."""
    for world in (ALL, *conditions["scenario"].unique()):
        for regime in (ALL, *conditions["regime"].unique()):
            mask = ((world == ALL) | (conditions["scenario"] == world)) & (
                (regime == ALL) | (conditions["regime"] == regime)
            )
            if mask.any():
                yield world, regime, mask.to_numpy()


def select_common(runs: StudyRuns, mask: Flags) -> Flags:
    """Select the conditions of a scope in which its filters are compared; all if none is common."""
    common = select_conditions(runs.present.any(axis=2) & mask)
    return common if common.any() else mask


def select_everywhere(runs: StudyRuns) -> Flags:
    """Select the conditions of the view that opens a page, [C]."""
    return select_common(runs, np.ones(len(runs.conditions), dtype=bool))


def _describe_scope(conditions: pd.DataFrame, names: StudyFacts) -> str:
    """Describe worlds and regimes in words."""
    scenarios, regimes = conditions["scenario"].unique(), conditions["regime"].unique()
    is_one = len(scenarios) == 1
    where = names.worlds[scenarios[0]].name if is_one else _count_worlds(conditions)
    noise = names.regimes.get(regimes[0]) if len(regimes) == 1 else None
    return f"in {where} with {noise.words}" if noise else f"in {where}"


def _count_worlds(conditions: pd.DataFrame) -> str:
    """Count the scenarios, and the worlds where several scenarios share a trajectory."""
    scenarios, worlds = conditions["scenario"].nunique(), conditions["family"].nunique()
    text = format_count(scenarios, "scenario")
    return text if scenarios == worlds else f"{text} of {format_count(worlds, 'world')}"


def _describe_timing(
    runs: StudyRuns, times: Sequence[Mapping[str, StepTimes]], alpha: float
) -> str:
    """Describe how the times per step of a view were measured."""
    if not all(set(runs.filters) <= set(by_label) for by_label in times):
        return "" if np.isnan(runs.values["ms"]).all() else "ms/step: one timing per job of all its runs, which other programs can change."  # fmt: skip
    rounds = sorted({t.seconds.size for by_label in times for t in by_label.values()})
    number = str(rounds[0]) if len(rounds) == 1 else f"{rounds[0]} to {rounds[-1]}"
    return (
        f"ms/step: of all runs of a job; median and quartiles of {number} rounds in which the filters took turns. "
        f"Ratio of the times paired by round, {format_interval_level(alpha)} interval."
    )


def _small_print(runs: StudyRuns, names: StudyFacts) -> str:
    """Describe the sample of a view, its tests, settings in names, and what was tuned."""
    texts = (
        describe_data_settings([*names.worlds, *names.regimes]),
        describe_settings(list(names.looks)),
        describe_tuning(count_tuned(names.looks), len(names.looks)),
    )
    sample = ", ".join((
        format_count(int(runs.present.any(axis=(1, 2)).sum()), "filter"), _count_worlds(runs.conditions),
        format_count(runs.conditions["regime"].nunique(), "noise regime"), _count_runs(runs, names.options.metric),
        format_count(len(np.unique(runs.values["seed"][runs.present])), "seed"),
    ))  # fmt: skip
    return (
        f"{sample}. Ratios are those of Hodges and Lehmann over paired runs, with simultaneous "
        f"{format_interval_level(names.options.alpha)} intervals; without one where more than a fifth of the pairs has a lost run. "
        f"Better and worse: Wilcoxon's test, the trimmed mean and the sign test agree. "
        f"A lost run is worse than every kept one. {' '.join(filter(None, texts))}"
    ).rstrip()


def _count_runs(runs: StudyRuns, metric: str) -> str:
    """Count the paired runs of a condition, as a range where conditions differ, and those without truth."""
    counts = (~np.isnan(compute_losses(runs, metric))).any(axis=0).sum(axis=1)
    total, few = int(runs.present.any(axis=0).sum()), "" if counts.min() == counts.max() else f"{counts.min()} to "  # fmt: skip
    lacking = f" ({total - counts.sum()} of {total} runs have no truth)" * bool(counts.sum() < total)  # fmt: skip
    return f"{few}{format_count(int(counts.max()), 'paired run')} per condition{lacking}"


def build_rows(view: View, baseline: str) -> list[BoardRow]:
    """Build the rows of a view, ordered by level; filters that lack a condition come last.

    A row has filter, rank, value with its interval (of a single condition), ratio with its simultaneous interval,
    verdict and its words, and the description of the filter. A value that does not exist is NaN.
    """
    runs, alpha = view.runs, view.court.alpha
    is_complete = np.all(runs.present.any(axis=2), axis=1)
    complete = dict(zip(runs.filters, map(bool, is_complete), strict=True))
    verdicts = {
        name: view.court.find(view.metric, view.mask, name, baseline)
        for name, is_there in complete.items()
        if is_there and complete.get(baseline) and name != baseline
    }
    levels, values = summarise_levels(view)
    level = np.where(is_complete, levels, np.nan)
    track = np.array([view.filters[label]["track"] for label in runs.filters])
    rows = []
    for i in np.lexsort((np.array(runs.filters), -track, level)).tolist():
        label = runs.filters[i]
        rows.append({
            "filter": label,
            "rank": int((level < level[i] - _SAME_LEVEL).sum()) + 1 if complete[label] else None,
            **dict(zip(("value", "low", "high"), values[:, i].tolist(), strict=True)), "unit": view.unit,
            **_show_verdict(view, label, {baseline: None, **verdicts}), **view.filters[label],
            **describe_costs(view.times, label, baseline, alpha),
        })  # fmt: skip
        if complete[label] and label not in (baseline, *verdicts):
            rows[-1]["words"] = "the baseline was not run in all conditions"
    return rows


def summarise_levels(view: View) -> tuple[Array, Array]:
    """Summarise the losses of each filter: mean over conditions of the logs of median errors, and an interval.

    Returns the level, [F], and for a single condition the error with the ends of the interval of its median, [3, F].
    A level is infinite where half of the runs are lost, and its error NaN.
    """
    losses = compute_losses(view.runs, view.metric)
    ordered, count = np.sort(losses, axis=2), (~np.isnan(losses)).sum(axis=2, keepdims=True)
    middle = [np.maximum(count - 1, 0) // 2, count // 2]  # of errors, as a reader takes the median
    pair = (np.take_along_axis(ordered, places, axis=2)[..., 0] for places in middle)
    with np.errstate(invalid="ignore"):
        medians = np.logaddexp(*pair) - math.log(2.0)
        level = medians @ weigh_conditions(view.runs.conditions)
    values = np.full((3, len(level)), np.nan)
    if losses.shape[1] == 1:
        for i in np.flatnonzero(np.isfinite(level)):
            n = int(count[i, 0, 0])
            k = _count_below(n, view.court.alpha)
            values[:, i] = [level[i], *(ordered[i, 0, [k, n - 1 - k]] if k >= 0 else [np.nan] * 2)]
    return level, np.exp(np.where(np.isfinite(values), values, np.nan))


@cache
def _count_below(n: int, alpha: float) -> int:
    """Return the number of values below the interval of a median of n values; -1 without an interval."""
    below = scipy.stats.binom.cdf(np.arange(n), n, 0.5) if n else np.ones(1)
    return int((below <= alpha / 2).sum()) - 1


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
    if not lost:
        return ""
    if count > 1:
        return f"loses {'track' if view.has_limit else 'runs'} in {lost}/{count}"
    share = f"{100 * (1 - view.filters[label]['track']):.0f} % of runs"
    return f"loses track in {share}" if view.has_limit else f"loses {share}"


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
    values = [row[~np.isnan(row)] for row in by_run]
    p = holm([compare_share(v, _INTERVAL_LEVEL) if v.size >= MIN_RUNS else 1.0 for v in values])
    calibration = [
        "" if p_value >= alpha else "too low" if v.mean() < _INTERVAL_LEVEL else "too high"
        for v, p_value in zip(values, p, strict=True)
    ]
    return {
        label: {
            "track": float(track[i]), "lost": int(lost[i]), "lost_conditions": int(lost_conditions[i]),
            "coverage": float(coverage[i]), "nees": float(nees[i]), "calibration": calibration[i],
            "ms": float(cost[i]),
        }
        for i, label in enumerate(runs.filters)
    }  # fmt: skip


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
        level = f"has a median {metric} of {value['value']:.3g} {value['unit']}".rstrip()
        if math.isnan(value["value"]):  # of runs that are lost
            level = value["words"].partition(", ")[2] or f"has no finite median {metric}"
        return f"{base} {level} {where}; no other filter is compared with it."
    better = [row for row in others if row["verdict"] == "better"]  # in the order of the table
    words = {
        "equal to it": EQUAL_WORDS, "not decided": ["not decided"], "worse": ["worse"], "without track": [LOSES_TRACK]
    }  # fmt: skip
    counts = {text: sum(row["verdict"] in some for row in others) for text, some in words.items()}
    rest = ", ".join(f"{n} {'is' if n == 1 else 'are'} {text}" for text, n in counts.items() if n)
    head = (
        f"Of {format_count(len(others), 'filter')}, {len(better) or 'none'} "
        f"{'is' if len(better) < 2 else 'are'} better than {base} {where}"
    )
    if better:
        first, size = better[0], _word_ratio(better[0])
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
