"""One verdict for each pair of filters, metric and selection of conditions, for all who ask for it.

Two families of tests share the pairs of a selection: those that are fixed before the results, and all others. A pair
is in one of them, so that pages, tables and consoles have the same word for it. They select verdicts, and compute none.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from itertools import combinations

from pfbench.stats.comparison import (
    ALPHA,
    EQUALITY_MARGIN,
    NO_DECISION,
    Verdict,
    flip,
    open_family,
)
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.study_runs import (
    StudyRuns,
    compare_filters,
    compute_losses,
    natural_sort_key,
    share_conditions,
)

Pair = tuple[str, str]
_Family = dict[Pair, Callable[[], Verdict]]


class Court:
    """Verdicts on the pairs of a study.

    Attributes:
        runs: Runs of the study.
        margin: Log ratio within which two filters are equal.
        alpha: Error rate of each family.
    """

    def __init__(
        self,
        runs: StudyRuns,
        fixed: Iterable[Pair],
        margin: float = EQUALITY_MARGIN,
        alpha: float = ALPHA,
    ) -> None:
        self.runs, self.margin, self.alpha = runs, margin, alpha
        self._fixed = set(map(frozenset, fixed))
        self._pairs = list(combinations(sorted(runs.filters, key=natural_sort_key), 2))
        self._losses: dict[str, Array] = {}
        self._families: dict[tuple[str, bytes, bool], _Family] = {}

    def find(self, metric: str, mask: Flags, a: str, b: str) -> Verdict:
        """Return the verdict on the first of two filters in a selection of conditions.

        Args:
            metric: Column of the error.
            mask: Conditions, [C].
            a: Label of the first filter.
            b: Label of the second filter.
        """
        family = self._decide(metric, mask, frozenset((a, b)) in self._fixed)
        if (a, b) in family:
            return family[a, b]()
        if (b, a) in family:
            return flip(family[b, a]())
        reason = "no common runs"
        return Verdict(a, b, NO_DECISION, math.nan, 0.0, math.inf, math.nan, 0, reason=reason)

    def list_verdicts(self, metric: str, mask: Flags) -> list[tuple[str, Verdict]]:
        """List the verdicts on all pairs with common runs in a selection, each with the name of its family."""
        both = {
            pair: (name, verdict())
            for name, is_fixed in (("fixed in advance", True), ("all other pairs", False))
            for pair, verdict in self._decide(metric, mask, is_fixed).items()
        }
        return [both[pair] for pair in self._pairs if pair in both]

    def _decide(self, metric: str, mask: Flags, is_fixed: bool) -> _Family:
        """Decide a family, once."""
        key = metric, mask.tobytes(), is_fixed
        if key not in self._families:
            if metric not in self._losses:
                self._losses[metric] = compute_losses(self.runs, metric)
            selected, losses = self.runs.select(mask), self._losses[metric][:, mask]
            pairs = [p for p in self._pairs if (frozenset(p) in self._fixed) == is_fixed]
            pairs = [p for p in pairs if share_conditions(selected, *p)]
            effects = compare_filters(selected, losses, pairs)
            verdicts = map(cache, open_family(effects, self.margin, self.alpha))
            self._families[key] = dict(zip(pairs, verdicts, strict=True))
        return self._families[key]


def fix_pairs(filters: Sequence[str], planned: Iterable[Pair], baseline: str) -> list[Pair]:
    """List the pairs that are fixed before the results: those planned, and each filter with the baseline of the page."""
    return [*planned, *((label, baseline) for label in filters if label != baseline)]
