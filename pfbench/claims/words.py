"""The five words on a claim, by the share of its readings in which it is true.

A kind of claim is a region of the log ratio of a to b. A test of a border is the comparison of a with b times the
border, by the three tests of `find_largest_p`. A claim is true in a reading if all of its comparisons are, with the largest
of their p-values. It is false if some comparison is, with the smallest p-value times their number. A reading in which
neither is shown is undecided: it counts for both.

Readings are drawn from the grid of all factors. The share in which the claim is true has an interval of Clopper and Pearson,
at looks after 50, 100 and 200 draws. Its ends allow for the error rate of single readings. A claim without draws, or with
fewer than those of the first look, has the word that all listed readings agree on.

References:
    C. J. Clopper and E. S. Pearson (1934), The use of confidence or fiducial limits in the case of the binomial.
    U. Simonsohn, J. P. Simmons and L. D. Nelson (2020), Specification curve analysis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
import scipy

from pfbench.claims.claim_list import KINDS
from pfbench.stats.comparison import ALPHA, MIN_RUNS, Effect, find_largest_p, subtract_losses
from pfbench.stats.error_measures import Array, Flags

CONFIRMED: Final = "confirmed"
REFUTED: Final = "refuted"
DEPENDS: Final = "depends"
UNTESTABLE: Final = "untestable"
OPEN: Final = "open"
WORDS = (CONFIRMED, REFUTED, DEPENDS, UNTESTABLE, OPEN)

TRUE, FALSE, UNDECIDED = "true", "false", "open"
NOT_RUN, CANNOT_RUN, VACUOUS = "not run", "cannot run", "vacuous"

LOOKS = (50, 100, 200)  # draws after which the share is looked at
SIDE = 0.025  # error rate of an end of the interval of the share, over all looks
READING_SIDE = 0.02  # error rate of an outcome of one reading, over the first runs and all of them
# share, and upper end, of a refuted claim; so for the false ones of a confirmed claim
MOST_TRUE, MOST_BOUND = 0.02, 0.05
LEVEL_BOUND = 1.2  # a printed level holds within 20 %
SIZE_BOUND = 2.0  # a printed ratio holds within this factor of its logarithm
_MOST_LOST = 0.5  # share of runs that both filters lose, above which a reading cannot run
_LEAST_ERROR = 1e-300  # an error of exactly 0 has a finite logarithm


class ClaimSample(NamedTuple):
    """Values of two filters, or of a filter and a bound, in the same runs of a reading.

    Attributes:
        kind: One of `KINDS`, or "level", "size" or "within".
        a: Values of a, [n], positive.
        b: Values of b, [n].
        lost_a: Runs that a lost, [n]. Their loss is infinite.
        lost_b: Runs that b lost, [n].
        early: Runs of the first look, [n].
        printed: Printed ratio of the kind "size", or largest one of the kind "within".
        sides: What is divided by what, for a reader.
    """

    kind: str
    a: Array
    b: Array
    lost_a: Flags
    lost_b: Flags
    early: Flags
    printed: float = math.nan
    sides: str = ""

    def select(self, mask: Flags) -> ClaimSample:
        """Select runs, [n]."""
        return self._replace(**{
            name: getattr(self, name)[mask] for name in ("a", "b", "lost_a", "lost_b", "early")
        })  # fmt: skip


class ShownRatio(NamedTuple):
    """Ratio of a comparison with its interval.

    Attributes:
        ratio: Ratio of a to b.
        low: Lower end of its interval.
        high: Upper end.
        runs: Number of runs.
        order: Share of the runs in which a is smaller.
        sides: What is divided by what.
        excess: How far the log ratio is beyond the border of true; negative on the side of true.
    """

    ratio: float = math.nan
    low: float = math.nan
    high: float = math.nan
    runs: int = 0
    order: float = math.nan
    sides: str = ""
    excess: float = math.nan


class WeighedSample(NamedTuple):
    """Evidence of a comparison in a reading.

    Attributes:
        p_true: p-value against the claim being false.
        p_false: p-value against its being true.
        state: `NOT_RUN`, `CANNOT_RUN` or `VACUOUS` of a comparison that says nothing; empty otherwise.
        effect: Its ratio.
    """

    p_true: float = 1.0
    p_false: float = 1.0
    state: str = ""
    effect: ShownRatio = ShownRatio()


class ReadingDot(NamedTuple):
    """A claim in a reading.

    Attributes:
        levels: Level of each factor.
        comparisons: Comparisons that must all hold, of those that say something.
        draw: Number of the joint draw; -1 for a reading in a list.
    """

    levels: Mapping[str, str]
    comparisons: Sequence[WeighedSample]
    draw: int = -1

    @property
    def p_values(self) -> tuple[float, float]:
        """p-values of true and of false."""
        used = [c for c in self.comparisons if not c.state]
        return max(c.p_true for c in used), min(1.0, len(used) * min(c.p_false for c in used))

    @property
    def outcome(self) -> str:
        """Outcome. Better by less than 1 % is true, and not false as well."""
        states = [c.state for c in self.comparisons]
        if NOT_RUN in states or all(states):
            return NOT_RUN if NOT_RUN in states else states[0]
        p_true, p_false = self.p_values
        return TRUE if p_true <= READING_SIDE else FALSE if p_false <= READING_SIDE else UNDECIDED

    @property
    def effect(self) -> ShownRatio:
        """Ratio of the comparison that is farthest beyond the border of true, or the closest to it."""
        options = [c.effect for c in self.comparisons if c.effect.runs]
        return max(options, key=lambda effect: effect.excess, default=ShownRatio())


class TrueShare(NamedTuple):
    """Share of the readings in which a claim is true.

    Attributes:
        true: Readings in which it is shown to be true.
        false: Readings in which it is shown to be false.
        counted: Readings that can run and say something.
        low: Lower end of the interval of the share; NaN for listed readings, which are not a sample.
        high: Upper end.
    """

    true: int = 0
    false: int = 0
    counted: int = 0
    low: float = math.nan
    high: float = math.nan


class ClaimDecision(NamedTuple):
    """Word on a claim.

    Attributes:
        word: One of `WORDS`.
        factor: Factor that explains most of the outcomes of a claim that depends; empty otherwise.
        explained: Share of the variance of the outcomes that it explains.
        share: Share of the readings in which the claim is true.
        is_drawn: Whether joint draws decide, and not a list of readings.
        readings: Readings that decide, by name.
        outcomes: Outcome by reading, of all readings.
    """

    word: str
    factor: str
    explained: float
    share: TrueShare
    is_drawn: bool
    readings: Mapping[str, ReadingDot]
    outcomes: Mapping[str, str]

    @property
    def ratios(self) -> dict[str, ShownRatio]:
        """Ratios of the readings that have one, by name."""
        return {name: dot.effect for name, dot in self.readings.items() if dot.effect.runs}

    @property
    def first(self) -> tuple[str, ShownRatio]:
        """Name and ratio of the first reading that has one: the central one, if it can run."""
        return next(iter(self.ratios.items()), ("", ShownRatio()))

    @property
    def strongest(self) -> tuple[str, ShownRatio]:
        """Name and ratio of the reading that is the best for the claim."""
        return min(self.ratios.items(), key=lambda row: row[1].excess, default=("", ShownRatio()))


_Region = tuple[float, float]


def find_borders(kind: str, printed: float = math.nan) -> tuple[_Region, _Region]:
    """Find the borders of a kind in the log ratio.

    Returns low and high of the region that is true, and of the region that is not false.
    """
    if kind == "size":
        ends = sorted(math.log(printed) * factor for factor in (SIZE_BOUND, 1 / SIZE_BOUND))
        return (ends[0], ends[1]), (ends[0], ends[1])
    if kind == "within":
        return ((-math.inf, math.log(printed)),) * 2
    if kind in ("same", "level"):
        width = math.log(LEVEL_BOUND if kind == "level" else KINDS["same"][0])
        return (-width, width), (-width, width)
    true, false = KINDS[kind]
    return (-math.inf, math.log(true)), (-math.inf, math.log(false))


def weigh(c: ClaimSample) -> WeighedSample:
    """Weigh the evidence of a comparison, at the first runs and at all: the smaller p-value, twice."""
    c = c.select(~(np.isnan(c.a) & ~c.lost_a) & ~(np.isnan(c.b) & ~c.lost_b))
    losses = [_take_logarithms(c.a, c.lost_a), _take_logarithms(c.b, c.lost_b)]
    effect = _describe(c, *losses)
    if len(c.a) and (c.lost_a & c.lost_b).mean() > _MOST_LOST:
        return WeighedSample(1.0, 1.0, CANNOT_RUN, effect)
    if c.kind == "same" and len(c.a) >= MIN_RUNS and not subtract_losses(*losses).any():
        return WeighedSample(1.0, 1.0, VACUOUS, effect)  # as of two filters that are one
    true, not_false = find_borders(c.kind, c.printed)
    looks = [losses] if c.early.all() else [[loss[c.early] for loss in losses], losses]
    p_true = 2 * min(_find_p_inside(a, b, *true) for a, b in looks)
    p_false = 2 * min(_find_p_outside(a, b, *not_false) for a, b in looks)
    return WeighedSample(min(1.0, p_true), min(1.0, p_false), "", effect)


def _find_p_inside(a: Array, b: Array, low: float, high: float) -> float:
    """Find the p-value of a ratio inside of both borders: the larger one."""
    below = _find_p(a, b + high)
    return max(below, _find_p(b + low, a)) if math.isfinite(low) else below


def _find_p_outside(a: Array, b: Array, low: float, high: float) -> float:
    """Find the p-value of a ratio beyond one of the borders: the smaller one, twice if there are two."""
    above = _find_p(b + high, a)
    return 2 * min(above, _find_p(a, b + low)) if math.isfinite(low) else above


def _take_logarithms(values: Array, lost: Flags) -> Array:
    """Take the logarithms of errors, infinite for a lost run."""
    return np.where(lost, math.inf, np.log(np.maximum(np.where(lost, 1.0, values), _LEAST_ERROR)))


def _find_p(first: Array, second: Array) -> float:
    """Find the p-value of a smaller first loss: certain if all runs differ by the same, as of a filter and itself."""
    d = subtract_losses(first, second)
    if len(d) >= MIN_RUNS and not subtract_losses(d, np.full_like(d, d[0])).any():
        return float(d[0] >= 0)
    return find_largest_p([(first, second)])


def _describe(c: ClaimSample, a: Array, b: Array) -> ShownRatio:
    """Describe a comparison: ratio, interval, runs, share of runs with a smaller, sides, and distance to its border."""
    if not len(a):
        return ShownRatio(sides=c.sides)
    d = subtract_losses(a, b)
    location, low, high = Effect("a", "b", "run", d, 1.0, 1.0, 1.0).estimate(ALPHA)
    true_low, true_high = find_borders(c.kind, c.printed)[0]
    excess = max(location - true_high, true_low - location)
    order = float((d < 0).mean())
    ratio, low, high = (math.exp(min(x, 700.0)) for x in (location, low, high))
    return ShownRatio(ratio, low, high, len(a), order, c.sides, excess)


def decide_claim(dots: Mapping[str, ReadingDot]) -> ClaimDecision:
    """Decide a claim by its joint draws, or by all readings if the draws of the first look have not all run.

    Args:
        dots: Readings of the claim by name. The first is the central one; joint draws are in their order, from the first.

    Returns:
        Decision.
    """
    outcomes = {name: dot.outcome for name, dot in dots.items()}
    joint = [name for name, dot in dots.items() if dot.draw >= 0]
    looks = [look for look in LOOKS if look <= len(joint)]
    for look in looks:
        readings = {name: dots[name] for name in joint[:look]}
        word, share = _judge_share([outcomes[name] for name in readings])
        if word != OPEN or look == looks[-1]:
            return _conclude(word, share, True, readings, outcomes)
    counts = list(outcomes.values())
    share = TrueShare(counts.count(TRUE), counts.count(FALSE), sum(map(counts.count, (TRUE, FALSE, UNDECIDED))))  # fmt: skip
    return _conclude(_agree(dots, share, NOT_RUN in counts), share, False, dots, outcomes)


def _judge_share(outcomes: Sequence[str]) -> tuple[str, TrueShare]:
    """Judge a share by its interval. The looks divide the error rate."""
    true, false = outcomes.count(TRUE), outcomes.count(FALSE)
    n = true + false + outcomes.count(UNDECIDED)
    if not n:
        return UNTESTABLE, TrueShare()
    low, high = bound_share(true, n), 1 - bound_share(false, n)
    share = TrueShare(true, false, n, low, high)
    if n - false <= MOST_TRUE * n and high <= MOST_BOUND:
        return REFUTED, share
    if n - true <= MOST_TRUE * n and low >= 1 - MOST_BOUND:
        return CONFIRMED, share
    return DEPENDS if low > MOST_BOUND and high < 1 - MOST_BOUND else OPEN, share


def bound_share(count: int, n: int) -> float:
    """Bound a share of readings from below, given those in which it is shown.

    Among readings without it, at most `READING_SIDE` show it falsely.
    """
    if not count:
        return 0.0
    low = float(scipy.special.betaincinv(count, n - count + 1, SIDE / len(LOOKS)))
    return max(0.0, (low - READING_SIDE) / (1 - READING_SIDE))


def _agree(readings: Mapping[str, ReadingDot], share: TrueShare, is_missing: bool) -> str:
    """Find the word of listed readings: all must agree, or two differ after correction for their number."""
    if not share.counted:
        return OPEN if is_missing else UNTESTABLE
    if not is_missing and share.counted in (share.true, share.false):
        return CONFIRMED if share.true else REFUTED
    level = READING_SIDE / share.counted
    evidence = [[p <= level for p in dot.p_values] for dot in readings.values() if dot.outcome in (TRUE, FALSE)]  # fmt: skip
    is_both = any(is_true for is_true, _ in evidence) and any(is_false and not is_true for is_true, is_false in evidence)  # fmt: skip
    return DEPENDS if is_both else OPEN


def _conclude(word: str, share: TrueShare, is_drawn: bool, readings: Mapping[str, ReadingDot], outcomes: Mapping[str, str]) -> ClaimDecision:  # fmt: skip
    """Conclude on a claim, and name the factor on which it depends."""
    shares = explain_outcomes(readings) if word == DEPENDS else {}
    factor = max(shares, key=lambda name: shares[name], default="")
    return ClaimDecision(word, factor, shares.get(factor, math.nan), share, is_drawn, readings, outcomes)  # fmt: skip


def explain_outcomes(readings: Mapping[str, ReadingDot]) -> dict[str, float]:
    """Find the share of the variance of true and false that each factor explains, corrected for its number of levels."""
    dots = [dot for dot in readings.values() if dot.outcome in (TRUE, FALSE)]
    y = np.array([dot.outcome == TRUE for dot in dots], float)
    total = ((y - y.mean()) ** 2).sum()
    shares = {}
    for factor in dots[0].levels:
        levels = np.array([dot.levels[factor] for dot in dots])
        names = np.unique(levels)
        within = sum(((y[levels == name] - y[levels == name].mean()) ** 2).sum() for name in names)
        rest = max(len(y) - len(names), 1)
        shares[factor] = float(1 - within / rest / (total / (len(y) - 1)))
    return shares
