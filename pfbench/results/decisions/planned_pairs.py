"""Decisions on planned pairs of filters: the public entry of a study.

The first family contains the share of runs that keep track and the error of each planned pair. The
questions (a) and (b) have separate families. All other metrics form the second family.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations

import numpy as np
import pandas as pd

from pfbench.results.decisions.comparisons import (
    TRACK,
    PairComparison,
    compare_metric,
    compare_track,
)
from pfbench.results.decisions.decision import Decision, Question
from pfbench.results.decisions.family_records import ONE_WORLD, FamilyContext, record_family
from pfbench.results.decisions.family_tests import correct_p_values
from pfbench.results.decisions.options import DecisionOptions, MetricRule
from pfbench.results.decisions.study_runs import (
    StudyRuns,
    have_common_runs,
    select_pair,
    to_study_runs,
)
from pfbench.results.decisions.words import combine_words
from pfbench.results.statistics.world_spread import moderated_p_values

QUESTIONS: tuple[Question, Question] = ("a", "b")
FAMILY_1 = "planned pairs, track and error"
FAMILY_2 = "planned pairs, secondary metrics"
MODERATED_FILTERS, MODERATED_WORLDS = 8, 3  # from which moderated variances are shown
Pairs = Sequence[tuple[str, str]]


def decide_planned_pairs(
    table: pd.DataFrame,
    pairs: Pairs,
    rule: MetricRule | None = None,
    options: DecisionOptions | None = None,
) -> list[Decision]:
    """Decide which filter of each planned pair is better, for both questions.

    Args:
        table: Columns filter, scenario, family, regime, run, value and keeps_track. See
            `tidy_table.tidy_runs` for results of pfbench.
        pairs: Labels of the planned pairs.
        rule: Rule of the main metric, None for the log ratio of errors.
        options: Options, None for the defaults.

    Returns:
        Four records per pair: question (a) track and error of all pairs, then question (b).

    Raises:
        ValueError: if the table or a pair is not valid.
    """
    rule, options = rule or MetricRule(), options or DecisionOptions()
    study = to_study_runs(table)
    check_pairs(pairs)
    comparisons: list[PairComparison] = []
    for a, b in pairs:
        runs = select_pair(study, a, b)
        comparisons += [
            compare_track(runs, rule.group, options),
            compare_metric(runs, rule, options),
        ]
    context = FamilyContext(FAMILY_1, study.regimes, options)
    same_worlds, new = (
        add_pair_words(record_family(comparisons, question, context), options)
        for question in QUESTIONS
    )
    return [*same_worlds, *_add_moderated(new, study, rule, options)]


def decide_secondary_metrics(
    tables: Mapping[str, pd.DataFrame],
    pairs: Pairs,
    rules: Sequence[MetricRule],
    options: DecisionOptions | None = None,
) -> list[Decision]:
    """Decide the secondary metrics of planned pairs in one family per question.

    Args:
        tables: Table by name of the metric, as in `decide_planned_pairs`.
        pairs: Labels of the planned pairs.
        rules: Rules of the metrics.
        options: Options, None for the defaults.

    Returns:
        Records of question (a), then of question (b). A pair without a common
        run of a metric lacks its record.

    Raises:
        ValueError: if a table or a pair is not valid.
    """
    options = options or DecisionOptions()
    check_pairs(pairs)
    comparisons, regimes = [], 0
    for rule in rules:
        study = to_study_runs(tables[rule.name])
        regimes = max(regimes, study.regimes)
        comparisons += [
            compare_metric(select_pair(study, a, b), rule, options)
            for a, b in pairs
            if have_common_runs(study, a, b)
        ]
    context = FamilyContext(FAMILY_2, regimes, options)
    return [
        decision
        for question in QUESTIONS
        for decision in record_family(comparisons, question, context)
    ]


def decision_frame(decisions: Sequence[Decision]) -> pd.DataFrame:
    """Return decisions as a table, one row per record."""
    return pd.DataFrame([decision.to_dict() for decision in decisions])


def check_pairs(pairs: Pairs) -> None:
    """Check that pairs exist and that no pair occurs twice, in any order.

    Raises:
        ValueError: if a pair occurs twice or none exists.
    """
    names = [frozenset(pair) for pair in pairs]
    if not names or len(set(names)) < len(names):
        raise ValueError(
            f"pairs must be at least one pair and different from each other, got {list(pairs)}. "
            "Remove repetitions."
        )


def add_pair_words(decisions: Sequence[Decision], options: DecisionOptions) -> list[Decision]:
    """Combine the words of track and error of each pair.

    Args:
        decisions: Records of one question, track before error for each pair.
        options: Options with the margins of a trade-off.

    Returns:
        Records with the word of the pair.
    """
    combined: list[Decision] = []
    for track, error in zip(decisions[::2], decisions[1::2], strict=True):
        opposite = track.estimate * error.both_keep < 0
        is_material = (
            abs(track.estimate) > options.track_margin and abs(error.both_keep) > error.margin
        )
        word = combine_words(track.word, error.word, bool(opposite and is_material))
        if error.reason == ONE_WORLD:
            word = error.word
        combined += [replace(record, pair_word=word) for record in (track, error)]
    return combined


def _add_moderated(
    decisions: Sequence[Decision], study: StudyRuns, rule: MetricRule, options: DecisionOptions
) -> list[Decision]:
    """Add p-values with moderated variances to the errors of question (b)."""
    enough = len(study.filters) >= MODERATED_FILTERS and len(study.worlds) >= MODERATED_WORLDS
    effects = {
        (a, b): compare_metric(select_pair(study, a, b), rule, options)
        for a, b in (combinations(study.filters, 2) if enough else ())
        if have_common_runs(study, a, b)
    }
    names, means, sds = [], [], []
    for name, comparison in effects.items():
        location = comparison.effects.worlds.location
        sd = float(np.std(location, ddof=1)) if location.size == len(study.worlds) else 0.0
        if np.isfinite(location).all() and sd > 0 and comparison.scale == "log ratio":
            names.append(frozenset(name))
            means.append(float(location.mean()))
            sds.append(sd)
    if len(names) < MODERATED_FILTERS:
        return list(decisions)
    p = dict(
        zip(
            names,
            moderated_p_values(np.array(means), np.array(sds), len(study.worlds)),
            strict=True,
        )
    )
    raw = np.array(
        [p.get(frozenset((d.a, d.b)), np.nan) if d.metric != TRACK else np.nan for d in decisions]
    )
    return [
        replace(decision, p_moderated=float(value))
        for decision, value in zip(decisions, correct_p_values(raw), strict=True)
    ]
