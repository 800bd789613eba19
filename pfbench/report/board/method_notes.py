"""Notes on each filter: particles, exactness, failures and modelling choices."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Any

from pfbench.report.looks import MethodLook
from pfbench.results.status import count_statuses
from pfbench.results.store import JobResult

_COUNTS = ("runs", "lost", "diverged", "collapsed", "severely_overconfident")


class MethodNotes:
    """Notes on all filters of a study, collected job by job."""

    def __init__(self) -> None:
        self._counts: dict[str, Counter[str]] = {}
        self._particles: dict[str, dict[str, None]] = {}
        self._exact: dict[str, bool] = {}
        self._bounded: dict[str, set[bool | None]] = {}
        self._choices: dict[str, dict[str, None]] = {}

    def add(self, label: str, result: JobResult) -> None:
        """Add a job.

        Args:
            label: Label of the filter.
            result: Result of the job.
        """
        meta = result.meta
        status = count_statuses(result.data, meta)._asdict()
        counts = self._counts.setdefault(label, Counter())
        counts.update({name: int(status[name] or 0) for name in _COUNTS})
        counts["limited_runs"] += int(meta["runs"]) if status["diverged"] is not None else 0
        particles = meta.get("particles")
        self._particles.setdefault(label, {})[str(particles)] = None
        self._exact[label] = self._exact.get(label, True) and bool(meta.get("is_exact"))
        self._bounded.setdefault(label, set()).add(meta.get("has_bounded_weights"))
        for text in meta.get("modelling_choices", ()):
            self._choices.setdefault(str(text), {})[label] = None

    def to_entries(self, looks: Mapping[str, MethodLook]) -> dict[str, Any]:
        """Return the entries of the page.

        Args:
            looks: Looks by label.

        Returns:
            `filter_notes`, one per filter, and `choices`, each with the names of its filters.
        """
        notes = []
        for label, counts in self._counts.items():
            particles = [n for n in self._particles[label] if n != "None"]
            has_limit = counts["limited_runs"] > 0
            notes.append({
                "filter": label, "particles": " or ".join(particles), "is_exact": self._exact[label],
                "has_bounded_weights": _common(self._bounded[label]),
                **{name: counts[name] for name in _COUNTS},
                "diverged": counts["diverged"] if has_limit else None,
            })  # fmt: skip
        choices = [
            {"text": text, "filters": _name_filters(labels, looks)}
            for text, labels in sorted(self._choices.items())
        ]
        return {"filter_notes": notes, "choices": choices}


def _common(statements: set[bool | None]) -> bool | None:
    """Return whether weights are bounded in all jobs, None if a job does not state it."""
    return None if None in statements else all(statements)


def _name_filters(labels: Mapping[str, None], looks: Mapping[str, MethodLook]) -> str:
    """Return the names of filters, "all filters" if none is missing."""
    if set(labels) == set(looks):
        return "all filters"
    return ", ".join(looks[label].name for label in looks if label in labels)
