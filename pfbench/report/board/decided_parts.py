"""Decided parts of a page: all that follows from the runs of a study, and its other inputs.

A published study keeps its runs and these facts, so that its page is decided again without results.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from pfbench.config.paper_files import list_named_parts
from pfbench.report.board.curves import CellKey, list_calibration, list_runs
from pfbench.report.board.pack_entries import StudyNames, ViewKey, filter_entry, metric_entries
from pfbench.report.board.planned import decide_planned, planned_entries, planned_words
from pfbench.report.board.robust_word import describe_robustness
from pfbench.report.board.study_views import build_views
from pfbench.report.board.sweeps import list_sweeps
from pfbench.report.board.view import BEST, EQUAL, MISSING, NOT_KEPT, OPEN
from pfbench.report.journal.study_pack import ALL
from pfbench.report.looks import MethodLook, PartName, add_tuning, find_looks
from pfbench.report.options import ReportOptions
from pfbench.results.comparison.baselines import REFERENCES
from pfbench.results.decisions.words import WORSE
from pfbench.results.job_labels import parse_label
from pfbench.results.step_times import StepTimes

_BASELINES = (*REFERENCES, "ukf", "ckf")  # offered first if they are in the study
_MOST_BASELINES, _FEW_BASELINES = 3, 2
_MANY = 300  # filters times conditions, from which a page offers few baselines
_OPTIONS = ("alpha", "equivalence_margin", "metric", "baseline")  # that decide
_OUTCOMES = {  # in the order in which methods are ranked
    BEST: "smallest error in {}",
    EQUAL: "equal to it in {}",
    OPEN: "not decided in {}",
    WORSE: "worse in {}",
    NOT_KEPT: "track not kept in {}",
    MISSING: "not run in {}",
}


class StudyFacts(NamedTuple):
    """Inputs of decisions other than the runs.

    Attributes:
        looks: Looks by label.
        worlds: Names of the scenarios by key.
        regimes: Names of the noise regimes by key.
        options: Options of the report.
        times: Times in rounds by label, of each scenario and regime.
        failures: Jobs that failed.
        warning: Sentence on runs that are not independent; empty if none is shown.
        differing: Sentence on conditions whose jobs differ in their data; empty without any.
    """

    looks: Mapping[str, MethodLook]
    worlds: Mapping[str, PartName]
    regimes: Mapping[str, PartName]
    options: ReportOptions
    times: Mapping[CellKey, Mapping[str, StepTimes]]
    failures: Sequence[Any] = ()
    warning: str = ""
    differing: str = ""

    def to_entries(self) -> dict[str, Any]:
        """Return plain values, from which `from_pack` restores the facts."""
        return {
            "options": {name: getattr(self.options, name) for name in _OPTIONS},
            "looks": [asdict(look) for look in self.looks.values()],
            "regimes": [asdict(name) for name in self.regimes.values()],
            "times": [
                [*key, {label: times._replace(seconds=times.seconds.tolist())._asdict()
                        for label, times in by_label.items()}]
                for key, by_label in self.times.items() if by_label
            ],
            "warning": self.warning,
            "differing": self.differing,
        }  # fmt: skip

    @classmethod
    def from_pack(cls, pack: Mapping[str, Any]) -> StudyFacts:
        """Restore the facts of a stored page. Installed methods have their present looks, and the stored data of their tuning.

        Args:
            pack: Data of a page.
        """
        facts = pack["facts"]
        stored = [MethodLook(**{**v, "baselines": tuple(v["baselines"])}) for v in facts["looks"]]
        labels = [look.key for look in stored]
        methods = {parse_label(label)[0] for label in labels}
        is_installed = methods <= set(list_named_parts("filter"))
        looks = {look.key: look for look in stored}
        present = find_looks(labels) if is_installed else looks
        return cls(
            {
                key: add_tuning(look, looks[key].tuning, looks[key].tuned_on)
                for key, look in present.items()
            },
            {entry["key"]: PartName(**entry) for entry in pack["worlds"]},
            {entry["key"]: PartName(**entry) for entry in facts["regimes"]},
            ReportOptions(**facts["options"]),
            {
                (world, regime): {
                    label: StepTimes(np.array(times["seconds"]), times["group"])
                    for label, times in by_label.items()
                }
                for world, regime, by_label in facts["times"]
            },
            pack["failures"],
            facts["warning"],
            facts["differing"],
        )


def decide_parts(table: pd.DataFrame, facts: StudyFacts) -> dict[str, Any]:
    """Decide all parts of a page that follow from the runs.

    Args:
        table: Table of `build_run_table`.
        facts: Inputs of decisions other than the runs.
    """
    looks, worlds, options = facts.looks, facts.worlds, facts.options
    planned = decide_planned(table, looks, options)
    conditions = len(table[["scenario", "regime"]].drop_duplicates())
    most = _MOST_BASELINES if len(looks) * conditions <= _MANY else _FEW_BASELINES
    names = StudyNames(
        looks, worlds, facts.regimes, select_baselines(looks, options.baseline)[:most]
    )
    views = build_views(table, names, options, planned_words(planned), facts.times)
    warnings = (
        _count_failures(len(facts.failures)),
        facts.warning,
        _describe_baseline(looks, options.baseline, next(iter(views)).baseline),
    )
    for key, view in views.items():
        proposed = _describe_best_proposed(views, key, looks)
        view["sentence"] = " ".join(filter(None, (*warnings, view["sentence"], proposed)))
        view["small_print"] = " ".join(filter(None, (view["small_print"], facts.differing)))
    first = next(iter(views.values()))["rows"]
    return {
        "alpha": options.alpha,
        "filters": [filter_entry(looks[row["filter"]]) for row in first],
        "worlds": [asdict(name) for name in worlds.values()],
        "metrics": metric_entries(table, options.metric),
        "baselines": list(dict.fromkeys(key.baseline for key in views)),
        "views": views,
        "planned": planned_entries(planned, table, looks, worlds, options),
        "robustness": describe_robustness(table, looks, options),
        "calibration": list_calibration(table),
        "runs": list_runs(table),
        "sweeps": list_sweeps(views, looks, options.metric),
        "failures": list(facts.failures),
    }


def _count_failures(number: int) -> str:
    """State how many jobs failed; empty if none did."""
    jobs = (
        "1 job has no valid result and is"
        if number == 1
        else f"{number} jobs have no valid result and are"
    )
    return f"{jobs} missing from all tables." if number else ""


def _describe_best_proposed(
    views: Mapping[ViewKey, Mapping[str, Any]], key: ViewKey, looks: Mapping[str, MethodLook]
) -> str:
    """Count the verdicts of the best proposed method over the conditions of a view, each decided alone.

    Empty for a view of one condition, without a proposed method, and where one has an error in all conditions.
    """
    proposed = [row["filter"] for row in views[key]["rows"] if looks[row["filter"]].proposed]
    ranked = {row["filter"] for row in views[key]["rows"] if row["rank"] is not None}
    conditions = [
        view
        for view_key, view in views.items()
        if (view_key.metric, view_key.baseline) == (key.metric, key.baseline)
        and ALL not in (view_key.world, view_key.regime)
        and key.world in (ALL, view_key.world)
        and key.regime in (ALL, view_key.regime)
    ]
    if len(conditions) < 2 or not proposed or ranked & set(proposed):
        return ""
    counts = {label: dict.fromkeys(_OUTCOMES, 0) for label in proposed}
    for view in conditions:
        for row in view["rows"]:
            if row["filter"] in counts:
                counts[row["filter"]][row["verdict"]] += 1
    best = max(proposed, key=lambda label: tuple(counts[label].values()))
    parts = [
        text.format(n)
        for text, n in zip(_OUTCOMES.values(), counts[best].values(), strict=True)
        if n
    ]
    return (
        f"Best proposed method in single conditions, each decided alone: [[{looks[best].name}]]. "
        f"Of {len(conditions)} conditions: {', '.join(parts)}."
    )


def _describe_baseline(looks: Mapping[str, MethodLook], requested: str, baseline: str) -> str:
    """State that another baseline is shown than the selected one; empty if it is shown."""
    if requested in ("", baseline):
        return ""
    return (
        f"[[{looks[requested].name}]] has no error to compare in all conditions: "
        f"[[{looks[baseline].name}]] is the baseline in its place."
    )


def select_baselines(looks: Mapping[str, MethodLook], baseline: str = "") -> list[str]:
    """Select the baselines that a reader may choose, the one of the opening view first.

    Args:
        looks: Looks by label.
        baseline: Label of the first baseline, empty for the default.

    Raises:
        ValueError: If the study lacks it.
    """
    if baseline and baseline not in looks:
        raise ValueError(
            f"report.baseline must be a filter of the study, got {baseline}. "
            f"Choose from {', '.join(looks)}."
        )
    stated = [label for look in looks.values() for label in look.baselines]
    available = [label for label in (baseline, *_BASELINES, *stated) if label in looks]
    return list(dict.fromkeys(available)) or list(looks)[:1]
