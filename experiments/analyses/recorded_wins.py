"""Whether a particle filter beats every Kalman filter on recorded data: the block `recorded` of docs/robustness.md.

Each particle filter is compared with each Kalman filter of its condition on paired runs, by Wilcoxon's signed-rank test of the
logarithms of the ratios of errors. It is better than all if the largest of these p-values is small enough, with Holm's
correction over all particle filters in all conditions.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import pandas as pd
from paired_errors import ALPHA, Comparison, compare_with_all, describe_comparison

from pfbench.files import markdown_head, markdown_row
from pfbench.results import holm

KALMAN = "kalman"
KINDS = ("particles of the state", "particles of hypotheses")


class Condition(NamedTuple):
    """A regime of a study.

    Attributes:
        study: Name of the study.
        regime: Noise regime.
        errors: Error of each run by filter, NaN for a lost run.
        kinds: `KALMAN` or one of `KINDS` by filter.
        coverage: Share of true values in 90 % intervals by filter.
    """

    study: str
    regime: str
    errors: pd.DataFrame
    kinds: Mapping[str, str]
    coverage: Mapping[str, float]

    def list_filters(self, kind: str) -> list[str]:
        """List the filters of a kind.

        Args:
            kind: `KALMAN` or one of `KINDS`.
        """
        return [label for label in self.errors if self.kinds[label] == kind]


def recorded_table(conditions: Sequence[Condition], second: Mapping[str, Condition]) -> str:
    """Table and sentences on all conditions of recorded data.

    Args:
        conditions: Conditions of all studies.
        second: The same conditions with another seed, by study and regime, where they were repeated.
    """
    found = {
        (place, kind, label): compare_with_all(c.errors, label, c.list_filters(KALMAN))
        for place, c in enumerate(conditions)
        for kind in KINDS
        for label in c.list_filters(kind)
    }
    adjusted = dict(zip(found, holm([one.p for one in found.values()]), strict=True))
    won = [key for key in found if adjusted[key] <= ALPHA]
    lines = markdown_head("study", "regime", *KINDS)
    for place, c in enumerate(conditions):
        cells = []
        for kind in KINDS:
            keys = [key for key in found if key[:2] == (place, kind)]
            first = min(keys, key=lambda key: (adjusted[key], found[key].ratio), default=None)
            word = "better" if first in won else "not better"
            cells.append(
                f"{describe_comparison(first[2], found[first])}, {word}"
                if first
                else "not in the study"
            )
        lines.append(markdown_row(f"`{c.study}`", c.regime, *cells))
    ends = [
        f"No filter with {kind} is shown to be better than every Kalman filter in any condition."
        for kind in KINDS
        if kind not in {kind for _, kind, _ in won}
    ]
    ends += [
        describe_win(conditions[place], label, found[place, kind, label], second)
        for place, kind, label in won
    ]
    return "\n".join([*lines, "", *ends])


def describe_win(
    condition: Condition, label: str, found: Comparison, second: Mapping[str, Condition]
) -> str:
    """State that a filter is better than every Kalman filter, and what another seed says.

    Args:
        condition: Condition.
        label: Filter.
        found: Its comparison.
        second: Conditions with another seed by study and regime.
    """
    shares = (
        f"{100 * condition.coverage[name]:.0f} % for `{name}`" for name in (label, found.closest)
    )
    text = (
        f"`{label}` is better than every Kalman filter in `{condition.study}`, {condition.regime}: "
        f"{describe_comparison(label, found)}, the closest one. The 90 % intervals have "
        f"{' and '.join(shares)} of the true values."
    )
    other = second.get(f"{condition.study} {condition.regime}")
    if other is None or label not in other.errors:
        return f"{text} This condition was not repeated with a second seed."
    again = compare_with_all(other.errors, label, other.list_filters(KALMAN))
    word = "also" if again.p <= ALPHA else "not"
    return f"{text} With a second seed it is {word} shown to be better: {describe_comparison(label, again)}."
