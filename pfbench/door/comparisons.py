"""Summary of a study and comparison of two filters, decided by the package: here they are only selected and printed."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from pfbench.door.parts import format_html_table
from pfbench.report.board import build_pack, build_run_table
from pfbench.report.board.recorded_units import count_drives, describe_drives
from pfbench.report.methods_text import is_recorded
from pfbench.report.options import ReportOptions
from pfbench.report.overview.tables import read_world_facts
from pfbench.report.study_page.page_writer import describe_opening
from pfbench.results.conditions import Condition, parse_label
from pfbench.results.looks import study_part_names
from pfbench.stats.comparison import Verdict
from pfbench.stats.world_table import World, build_world, compare_methods

_HEADS = (
    "#",
    "filter",
    "ratio",
    "verdict",
    "track kept",
    "coverage of 90 % intervals",
    "ms/step",
)
_FAILED_HEADS = ("failed filter", "scenario", "message")


@dataclass(frozen=True, repr=False)
class Summary:
    """Sentence and leaderboard of a study.

    Attributes:
        sentence: Result in words.
        caption: Metric, worlds and baseline of the leaderboard.
        rows: Rows of the leaderboard: rank, filter, ratio with interval, words, track kept, coverage, ms/step.
        failures: Filter, scenario and message of each failed job, which the leaderboard lacks.
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
        failed = "\n".join(f"failed: {' / '.join(row)}" for row in self.failures)
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
    failures = tuple((note["filter"], note["scenario"], note["message"]) for note in failed)
    if not conditions:
        return Summary("No job has finished.", "", (), failures)
    opening = describe_opening(build_pack(study, conditions, ReportOptions(**options)))
    rows = tuple(
        (
            str(row["rank"]), str(row["name"]), f"{row['ratio']} {row['interval']}".strip(), str(row["words"]),
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
    """

    verdicts: Mapping[str, Verdict]
    reach: str = ""

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
        rows = [{"condition": name, **verdict._asdict()} for name, verdict in self.verdicts.items()]
        return pd.DataFrame(rows)

    def _single(self) -> Verdict:
        """Return the only verdict."""
        if len(self.verdicts) != 1:
            raise ValueError(
                f"the study must have one condition, got {len(self.verdicts)}. Use comparison.table() or comparison.verdicts."
            )
        return next(iter(self.verdicts.values()))

    def __repr__(self) -> str:
        lines = (f"{name}: {_format(v)}" for name, v in self.verdicts.items())
        return "\n".join(filter(None, (*lines, self.reach)))

    def _repr_html_(self) -> str:
        heads = ("condition", "verdict")
        table = format_html_table(heads, [(name, _format(v)) for name, v in self.verdicts.items()])
        return f"{table}<p>{html.escape(self.reach)}</p>" if self.reach else table


def _format(verdict: Verdict) -> str:
    """Format a verdict as a sentence."""
    if not np.isfinite(verdict.ratio):
        return f"{verdict.a} and {verdict.b} are not compared: {verdict.reason}."
    reason = f" ({verdict.reason})" if verdict.reason else ""
    sample = f"{verdict.n} paired runs"
    ends = f"{verdict.low:.3g} to {verdict.high:.3g}"
    return (
        f"the error of {verdict.a} is {verdict.ratio:.3g} times that of {verdict.b} ({ends}, {sample}): "
        f"{verdict.word}{reason}."
    )


def compare_in_conditions(conditions: Sequence[Condition], a: str, b: str) -> Comparison:
    """Compare two filters in all conditions that have both."""
    names = [condition.name for condition in conditions]
    labels = sorted({job.label for condition in conditions for job in condition.jobs})
    for label in (a, b):
        if label not in labels:
            raise ValueError(
                f"filter must be a filter of the study, got {label!r}. Choose from {', '.join(labels)}."
            )
    if a == b:
        raise ValueError(f"filters must be two, got {a} twice. Choose from {', '.join(labels)}.")
    worlds = [
        _make_world(condition, name, (a, b))
        for name, condition in zip(names, conditions, strict=True)
        if {a, b} <= {job.label for job in condition.jobs}
    ]
    if not worlds:
        raise ValueError(
            f"{a} and {b} must have a condition in common, got none. Run both in one scenario."
        )
    recorded = {c.scenario: c.jobs[0].meta for c in conditions if is_recorded(c.jobs[0].meta)}
    drives = (describe_drives(name, count_drives(meta)) for name, meta in recorded.items())
    reach = " ".join(
        f"{text}. The page of the study has other stretches and drives." for text in drives
    )
    verdicts = {pair.world: pair.verdict for pair in compare_methods(worlds, (a, b))}
    return Comparison(verdicts, reach)


def _make_world(condition: Condition, name: str, pair: tuple[str, str]) -> World:
    """Make the world of a condition with two filters."""
    jobs = tuple(job for job in condition.jobs if job.label in pair)
    selected = condition._replace(jobs=jobs)
    rows = build_run_table([selected]).assign(scenario=name)
    return build_world(rows, pair[1], _find_cap(selected, rows))


def _find_cap(condition: Condition, rows: pd.DataFrame) -> float:
    """Return the largest error that counts: that of the world, or any that changes nothing where all runs keep track.

    Raises ValueError where the cap would matter and no file states it.
    """
    limit = study_part_names([condition], "scenario")[condition.scenario].limit
    facts = read_world_facts(parse_label(condition.scenario)[0], condition.model)
    stated = limit or (facts.cap if facts else np.nan)
    if np.isfinite(stated):
        return float(stated)
    errors = rows["rmse"].to_numpy(dtype=float)
    if rows["lost"].any() or not np.isfinite(errors).all():
        raise ValueError(
            f"{condition.scenario} must state the error above which a run has lost the track, since runs were lost, got none. "
            "Set scenario.paper.divergence_threshold, or use own(..., divergence_threshold=...)."
        )
    return float(max(errors.max(), np.finfo(float).tiny))
