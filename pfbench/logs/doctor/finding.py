"""Result of a diagnosis: findings with their evidence, measured facts and the settings that mend the log."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from pfbench.files.table_file import Array

REFUSE, WARN, TELL = "refuse", "warn", "tell"
_MOST_POINTS = 1200  # of a curve of a picture


class Picture(NamedTuple):
    """Curves that show the evidence of a finding.

    Attributes:
        xlabel: Label of the horizontal axis.
        ylabel: Label of the vertical axis.
        curves: Label, horizontal and vertical values of each curve, [n].
        marks: Horizontal values that are marked.
    """

    xlabel: str
    ylabel: str
    curves: tuple[tuple[str, Array, Array], ...]
    marks: tuple[float, ...] = ()


class Finding(NamedTuple):
    """Fault of a log that a check names.

    Attributes:
        check: Name of the check.
        level: refuse, warn or tell.
        statistic: Measured value of the check.
        threshold: Value beyond which the check speaks.
        unit: Unit of both.
        evidence: Sentence with what was measured.
        remedy: Sentence with what to do. Empty if nothing is known to help.
        settings: Keys below `scenario` with the values that mend the log. Empty without a remedy by keys.
        explanations: Competing causes, the likeliest first.
        picture: Evidence as curves.
    """

    check: str
    level: str
    statistic: float
    threshold: float
    unit: str
    evidence: str
    remedy: str = ""
    settings: Mapping[str, Any] = {}
    explanations: tuple[str, ...] = ()
    picture: Picture | None = None

    @property
    def text(self) -> str:
        """Evidence, explanations and remedy in sentences."""
        causes = f" It can be: {'; or '.join(self.explanations)}." if self.explanations else ""
        return f"{self.evidence}.{causes}{f' {self.remedy}.' if self.remedy else ''}"


@dataclass(frozen=True)
class LogDiagnosis:
    """Findings of a log in the order of the checks.

    Attributes:
        findings: Findings.
        facts: Measured values by name, with and without a finding.
        settings: Keys below `scenario` that mend all findings with a remedy by keys.
        remaining: Checks of the findings that remain with these settings.
    """

    findings: tuple[Finding, ...]
    facts: Mapping[str, Any]
    settings: Mapping[str, Any] = field(default_factory=dict)
    remaining: tuple[str, ...] = ()

    def of(self, level: str) -> tuple[Finding, ...]:
        """Return the findings of a level."""
        return tuple(finding for finding in self.findings if finding.level == level)


def describe_change(offset: float) -> str:
    """Return what removes the delay of a clock, s."""
    return f"Add {-offset:.3f} to t" if offset < 0.0 else f"Subtract {offset:.3f} from t"


def thin_curve(label: str, x: NDArray[Any], y: NDArray[Any]) -> tuple[str, Array, Array]:
    """Thin a curve to about a thousand points that keep its extremes.

    Shapes: x [n], y [n].
    """
    if len(x) <= _MOST_POINTS:
        return label, np.asarray(x, float), np.asarray(y, float)
    edges = np.linspace(0, len(x), _MOST_POINTS // 2 + 1).astype(int)[:-1]
    rows = np.arange(len(y))
    values = np.where(np.isfinite(y), y, 0.0)
    least, largest = np.minimum.reduceat(values, edges), np.maximum.reduceat(values, edges)
    block = np.repeat(np.arange(len(edges)), np.diff(np.append(edges, len(y))))
    extremes = [rows[values == bound[block]] for bound in (least, largest)]
    keep = np.unique(
        np.concatenate([at[np.unique(block[at], return_index=True)[1]] for at in extremes])
    )
    return label, np.asarray(x, float)[keep], values[keep]


def merge_settings(parts: Iterable[Mapping[str, Any]]) -> dict[str, Any]:
    """Merge nested settings; the first value of a key stays, lists of `drop` are joined."""
    merged: dict[str, Any] = {}
    for settings in parts:
        for key, value in settings.items():
            if isinstance(value, Mapping):
                merged[key] = merge_settings([merged.get(key, {}), value])
            elif key == "drop" and key in merged:
                merged[key] = [*merged[key], *(name for name in value if name not in merged[key])]
            else:
                merged.setdefault(key, value)
    return merged
