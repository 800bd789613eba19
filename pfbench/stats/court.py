"""One verdict for each pair of filters, metric and selection of conditions, for all who ask for it.

Two families of tests share the pairs of a selection: those that are fixed before the results, and all others. A pair
is in one of them, so that pages, tables and consoles have the same word for it. They select verdicts, and compute none.
A selection of one world has the pairs that are fixed in that world among the first, such as those with its reference.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from itertools import combinations

import numpy as np
import scipy  # scipy.stats is imported at its first use

from pfbench.stats.comparison import (
    ALPHA,
    EQUALITY_MARGIN,
    FAR,
    NO_DECISION,
    Verdict,
    flip,
    open_family,
    subtract_losses,
)
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.rank_tests import holm, weigh_regions
from pfbench.stats.study_runs import (
    StudyRuns,
    compare_filters,
    compute_losses,
    natural_sort_key,
    share_conditions,
)

TRACK_SHARE = 0.8  # a filter that keeps track in a smaller share of runs loses track [ours]
Pair = tuple[str, str]
PAIR_FAMILIES = ("fixed in advance", "all other pairs")
_Family = dict[Pair, Callable[[], Verdict]]


class Court:
    """Verdicts on the pairs of a study.

    Attributes:
        runs: Runs of the study.
        margin: Log ratio within which two filters are equal.
        alpha: Error rate of each family.
        fixed_in: Pairs that are fixed in one scenario besides the others.
    """

    def __init__(
        self,
        runs: StudyRuns,
        fixed: Iterable[Pair],
        margin: float = EQUALITY_MARGIN,
        alpha: float = ALPHA,
        fixed_in: Mapping[str, Iterable[Pair]] | None = None,
    ) -> None:
        self.runs, self.margin, self.alpha = runs, margin, alpha
        self._fixed = set(map(frozenset, fixed))
        self.fixed_in = {k: set(map(frozenset, some)) for k, some in (fixed_in or {}).items()}
        self._pairs = list(combinations(sorted(runs.filters, key=natural_sort_key), 2))
        self._losses: dict[str, Array] = {}
        self._families: dict[tuple[str, bytes], tuple[_Family, _Family]] = {}

    def find(self, metric: str, mask: Flags, a: str, b: str) -> Verdict:
        """Return the verdict on the first of two filters in a selection of conditions.

        Args:
            metric: Column of the error.
            mask: Conditions, [C].
            a: Label of the first filter.
            b: Label of the second filter.
        """
        for family in self._decide(metric, mask):
            if (a, b) in family:
                return family[a, b]()
            if (b, a) in family:
                return flip(family[b, a]())
        reason = "no common runs"
        return Verdict(a, b, NO_DECISION, math.nan, 0.0, math.inf, math.nan, 0, reason=reason)

    def list_verdicts(
        self, metric: str, mask: Flags, has_others: bool = True
    ) -> list[tuple[str, Verdict]]:
        """List the verdicts on all pairs with common runs in a selection, or on those fixed in advance, each with its family."""
        both = dict(zip(PAIR_FAMILIES, self._decide(metric, mask), strict=True))
        some = {
            pair: (name, verdict())
            for name in PAIR_FAMILIES[: 1 + has_others] for pair, verdict in both[name].items()
        }  # fmt: skip
        return [some[pair] for pair in self._pairs if pair in some]

    def losses(self, metric: str, mask: Flags) -> Array:
        """Return the losses of all filters in a selection of conditions, [F, C, N]: infinite if lost, NaN without a run."""
        if metric not in self._losses:
            self._losses[metric] = compute_losses(self.runs, metric)
        return self._losses[metric][:, mask]

    def find_lost(self, mask: Flags) -> set[str]:
        """Find the filters that lose track in each condition of a selection, by the tests of `find_lost_conditions`."""
        is_lost = find_lost_conditions(self.runs.select(mask), self.alpha)
        return {label for label, lost in zip(self.runs.filters, is_lost, strict=True) if lost.all()}

    def weigh(self, metric: str, mask: Flags, a: str, b: str) -> str:
        """Name the probabilities that the first of two filters is better, equal and worse in a condition; empty without runs.

        A verdict needs tests, these probabilities show where an undecided pair tends. The region of equality is that of the verdict.
        """
        index = [self.runs.filters.index(label) for label in (a, b)]
        first, second = self.losses(metric, mask)[index].reshape(2, -1)
        is_common = ~(np.isnan(first) | np.isnan(second))
        d = np.clip(subtract_losses(first[is_common], second[is_common]), -FAR, FAR)
        words = zip(("better", "equal", "worse"), weigh_regions(d, self.margin), strict=True)
        return ", ".join(f"{word} {share:.2f}" for word, share in words) if len(d) else ""

    def _decide(self, metric: str, mask: Flags) -> tuple[_Family, _Family]:
        """Decide both families of a selection, once."""
        key = metric, mask.tobytes()
        if key not in self._families:
            selected, losses = self.runs.select(mask), self.losses(metric, mask)
            scenarios = selected.conditions["scenario"].unique()
            fixed = self._fixed | (
                self.fixed_in.get(str(scenarios[0]), set()) if len(scenarios) == 1 else set()
            )
            pairs = [p for p in self._pairs if share_conditions(selected, *p)]
            effects = dict(zip(pairs, compare_filters(selected, losses, pairs), strict=True))
            families: list[_Family] = []
            for is_fixed in (True, False):
                some = [p for p in pairs if (frozenset(p) in fixed) == is_fixed]
                opened = open_family([effects[p] for p in some], self.margin, self.alpha)
                families.append(dict(zip(some, map(cache, opened), strict=True)))
            self._families[key] = families[0], families[1]
        return self._families[key]


def find_lost_conditions(runs: StudyRuns, alpha: float) -> Flags:
    """Find where it is shown that a filter keeps track in fewer than 80 % of runs, by exact binomial tests, [F, C].

    Args:
        runs: Runs of a study.
        alpha: Error rate of all filters and conditions together.
    """
    number = runs.present.sum(axis=2)
    successes = (runs.keeps & runs.present).sum(axis=2)
    p = np.where(number > 0, scipy.stats.binom.cdf(successes, number, TRACK_SHARE), 1.0)
    return np.asarray(holm(p.ravel()).reshape(p.shape) < alpha)


def fix_pairs(filters: Sequence[str], planned: Iterable[Pair], baseline: str) -> list[Pair]:
    """List the pairs that are fixed before the results: those planned, and each filter with the baseline of the page."""
    return [*planned, *((label, baseline) for label in filters if label != baseline)]
