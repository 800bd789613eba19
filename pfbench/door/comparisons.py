"""Summary of a study and comparison of two filters, decided by the package: here they are only selected and printed."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from pfbench.core.parameter_checks import require
from pfbench.door.parts import format_html_table
from pfbench.job.config import CHOICES
from pfbench.report.board.entries import build_run_table, name_regimes
from pfbench.report.board.pack import build_pack, open_court
from pfbench.report.board.recorded_units import count_drives, describe_drives
from pfbench.report.board.view import word_verdict
from pfbench.report.methods_text import is_recorded
from pfbench.report.options import ReportOptions
from pfbench.report.study_page.page_writer import describe_opening
from pfbench.results.conditions import Condition
from pfbench.results.looks import study_looks
from pfbench.stats.comparison import ALPHA, NO_DECISION, Verdict
from pfbench.stats.pair_states import find_level
from pfbench.stats.run_dependence import RUN, assess_runs, drop_runs
from pfbench.stats.sentences import format_with_interval

_HEADS = (
    "#",
    "filter",
    "median error",
    "ratio",
    "verdict",
    "track kept",
    "coverage of 90 % intervals",
    "ms/step",
)
_FAILED_HEADS = ("failed scenario", "noise", "filter", "message", "if it is mended")


@dataclass(frozen=True, repr=False)
class Summary:
    """Sentence and leaderboard of a study.

    Attributes:
        sentence: Result in words.
        caption: Metric, worlds and baseline of the leaderboard.
        rows: Rows of the leaderboard: rank, filter, median error of a single condition, ratio with interval, words, track kept, coverage, ms/step.
        failures: Scenario, noise, filter and message of each failed job, which the leaderboard lacks, and how to remove its note.
    """

    sentence: str
    caption: str
    rows: tuple[tuple[str, ...], ...]
    failures: tuple[tuple[str, ...], ...] = ()

    def table(self) -> pd.DataFrame:
        """Return the leaderboard as a table of texts."""
        return pd.DataFrame(self.rows, columns=list(_HEADS))

    def __repr__(self) -> str:
        lines = [_HEADS, *self.rows] if self.rows else []
        widths = [max(len(line[k]) for line in lines) for k in range(len(_HEADS) if lines else 0)]
        texts = ["  ".join(f"{v:{w}}" for v, w in zip(line, widths, strict=True)) for line in lines]
        table = "\n".join(text.rstrip() for text in texts)
        failed = "\n".join(
            f"failed: {' / '.join(row[:3])}: {row[3]}\n  if another setting has mended it: {row[4]}"
            for row in self.failures
        )
        return "\n\n".join(filter(None, (self.sentence, table, self.caption, failed)))

    def _repr_html_(self) -> str:
        table = format_html_table(_HEADS, self.rows) if self.rows else ""
        failed = format_html_table(_FAILED_HEADS, self.failures) if self.failures else ""
        sentence, caption = html.escape(self.sentence), html.escape(self.caption)
        return f"<p><b>{sentence}</b></p>{table}<p>{caption}</p>{failed}"


def summarise_study(
    study: str,
    conditions: Sequence[Condition],
    failed: Sequence[Mapping[str, str]],
    options: Mapping[str, Any],
) -> Summary:
    """Summarise a study by the opening view of its page, and its failed jobs."""
    failures = tuple(
        (*(note[k] for k in (*CHOICES[:3], "message")), f"remove {note['note']}") for note in failed
    )
    if not conditions:
        return Summary("No job has finished.", "", (), failures)
    opening = describe_opening(build_pack(study, conditions, ReportOptions(**options)))
    rows = tuple(
        (
            str(row["rank"]), str(row["name"]), str(row["value"]).partition(" [")[0].strip(), f"{row['ratio']} {row['interval']}".strip(),
            str(row["words"]),
            str(row["track"]), str(row["calibration"]), str(row["ms"]),
        )
        for row in opening["rows"]
    )  # fmt: skip
    return Summary(opening["text"], opening["caption"], rows, failures)


@dataclass(frozen=True, repr=False)
class Comparison:
    """Verdicts on two filters, one for each condition.

    Attributes:
        verdicts: Verdicts by the name of the condition, one family of tests.
        reach: Of what the runs of recorded conditions are a sample; empty for simulated ones.
        chances: Probabilities that the first filter is better, equal and worse, of the conditions in which nothing is decided. They
            are the posterior of the signed-rank test, and no verdict.
    """

    verdicts: Mapping[str, Verdict]
    reach: str = ""
    chances: Mapping[str, str] = field(default_factory=dict)

    @property
    def word(self) -> str:
        """The verdict of a study of one condition: better, worse, equal, identical or not decided, of the first filter."""
        return self._single().word

    @property
    def ratio(self) -> float:
        """Error of the first filter divided by that of the second, in a study of one condition."""
        return self._single().ratio

    @property
    def interval(self) -> tuple[float, float]:
        """Simultaneous interval of the ratio, in a study of one condition."""
        verdict = self._single()
        return verdict.low, verdict.high

    def table(self) -> pd.DataFrame:
        """Return the verdicts as a table, a row per condition."""
        rows = [{"condition": name, **verdict.to_row()} for name, verdict in self.verdicts.items()]
        return pd.DataFrame(rows)

    def _single(self) -> Verdict:
        """Return the only verdict."""
        require(
            len(self.verdicts) == 1,
            "the study",
            "have one condition",
            len(self.verdicts),
            "Use comparison.table() or comparison.verdicts.",
        )
        return next(iter(self.verdicts.values()))

    def __repr__(self) -> str:
        lines = (f"{name}: {self._format(name)}" for name in self.verdicts)
        return "\n".join(filter(None, (*lines, self.reach)))

    def _repr_html_(self) -> str:
        heads = ("condition", "verdict")
        table = format_html_table(heads, [(name, self._format(name)) for name in self.verdicts])
        return f"{table}<p>{html.escape(self.reach)}</p>" if self.reach else table

    def _format(self, name: str) -> str:
        """Format the verdict of a condition as a sentence, in the words of the pages, and where it tends if nothing is decided."""
        verdict, chances = self.verdicts[name], self.chances.get(name)
        compared = f"{verdict.a} against {verdict.b}"
        if np.isfinite(verdict.ratio):
            size = format_with_interval(verdict.ratio, verdict.low, verdict.high)
            compared = f"the error of {verdict.a} is {size} times that of {verdict.b} ({verdict.n} paired runs)"
        tendency = f" Probabilities: {chances}." if chances else ""
        return f"{compared}: {word_verdict(verdict)}.{tendency}"


def compare_in_conditions(conditions: Sequence[Condition], a: str, b: str) -> Comparison:
    """Select the verdicts on two filters in all conditions that have both, as the page of the study has them."""
    labels = sorted({job.label for condition in conditions for job in condition.jobs})
    for label in (a, b):
        require(
            label in labels,
            "filter",
            "be a filter of the study",
            f"{label!r}",
            f"Choose from {', '.join(labels)}.",
        )
    require(a != b, "filters", "be two", f"{a} twice", f"Choose from {', '.join(labels)}.")
    table = build_run_table(conditions)
    table = drop_runs(table, assess_runs(table, "rmse", RUN).copies, RUN)
    level, _ = find_level(conditions[0].jobs[0].path.parent, ALPHA)
    court = open_court(table, study_looks(conditions), ReportOptions(alpha=level))
    present = court.runs.conditions
    verdicts, chances = {}, {}
    for condition, regime in zip(conditions, name_regimes(conditions), strict=True):
        mask = (present["scenario"] == condition.scenario) & (present["regime"] == regime)
        if {a, b} <= {job.label for job in condition.jobs}:
            where = "rmse", mask.to_numpy(), a, b
            verdict = verdicts[condition.name] = court.find(*where)
            if verdict.word == NO_DECISION:
                chances[condition.name] = court.weigh(*where)
    require(
        verdicts, f"{a} and {b}", "have a condition in common", "none", "Run both in one scenario."
    )
    recorded = {c.scenario: c.jobs[0].meta for c in conditions if is_recorded(c.jobs[0].meta)}
    drives = (describe_drives(name, count_drives(meta)) for name, meta in recorded.items())
    reach = " ".join(
        f"{text}. The page of the study has other stretches and drives." for text in drives
    )
    return Comparison(verdicts, reach, chances)
