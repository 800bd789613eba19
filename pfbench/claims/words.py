"""The five words on a claim over its readings, from `compare` and `decide` alone.

A kind of claim is a region of the log ratio of a to b. A test of a border is the comparison of a with b times the
border. A claim is true in a reading if all of its comparisons are, with the largest of their p-values. It is false if
some comparison is, with the smallest p-value times their number. It is confirmed if it is true in all readings, with
the largest p-value over them, and Holm's correction over the claims of a paper. The rules for refuted are the same.
"It depends" needs a reading of both outcomes after Holm's correction over claims times readings.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Final, NamedTuple, TypeVar

import numpy as np
import pandas as pd

from pfbench.claims.claim_list import KINDS
from pfbench.stats.comparison import (
    ALPHA,
    BETTER_THAN,
    MIN_RUNS,
    Effect,
    decide,
    is_testable,
)
from pfbench.stats.error_measures import Array, Flags
from pfbench.stats.study_runs import CONDITION, StudyRuns, compare_filters, compute_losses

CONFIRMED: Final = "confirmed"
REFUTED: Final = "refuted"
DEPENDS: Final = "depends"
UNTESTABLE: Final = "untestable"
OPEN: Final = "open"
WORDS = (CONFIRMED, REFUTED, DEPENDS, UNTESTABLE, OPEN)

TRUE, FALSE, UNDECIDED = "true", "false", "open"
NOT_RUN, CANNOT_RUN, VACUOUS, NOT_COUNTED = "not run", "cannot run", "vacuous", "not counted"

PAIR = "pair"  # factor of two levels together that turn a claim alone
LOOKS = (0.01, 0.04)  # error rates of both sides at the first look and at all runs; half on a side
LEVEL_BOUND = 1.2  # a printed level holds within 20 %
SIZE_BOUND = 2.0  # a printed ratio holds within this factor of its logarithm
_MOST_LOST = 0.5  # share of runs that both filters lose, above which a reading cannot run


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


class ReadingDot(NamedTuple):
    """A claim in a reading.

    Attributes:
        factor: Factor of the reading; "none" for the central one.
        comparisons: Comparisons that must all hold; empty if there is none to decide by.
        state: Outcome without runs: `NOT_RUN`, `CANNOT_RUN`, `VACUOUS`, `NOT_COUNTED`, `FALSE` by a proof, or
            empty.
    """

    factor: str
    comparisons: Sequence[ClaimSample] = ()
    state: str = ""


class ClaimDecision(NamedTuple):
    """Word on a claim.

    Attributes:
        word: One of `WORDS`.
        factors: Factors on which it depends.
        outcomes: Outcome by reading.
        ratio: Ratio of a to b in the central reading, of the comparison that is closest to turn the claim. If that
            reading cannot run, in the first one that can.
        low: Lower end of its interval.
        high: Upper end.
        runs: Runs of that comparison.
        order: Share of its runs in which a is smaller.
        sides: What is divided by what in that comparison.
        reading: Reading of the ratio.
    """

    word: str
    factors: tuple[str, ...]
    outcomes: Mapping[str, str]
    ratio: float = math.nan
    low: float = math.nan
    high: float = math.nan
    runs: int = 0
    order: float = math.nan
    sides: str = ""
    reading: str = ""


class _Evidence(NamedTuple):
    """Evidence for one outcome: an effect whose "better" is the outcome, or certainty without a test."""

    effect: Effect
    is_certain: bool = False
    is_excluded: bool = False  # certain that it is not the outcome


_Region = tuple[float, float]
_Key = TypeVar("_Key", str, tuple[str, str])
_TABLE = pd.DataFrame([["claim", "claim", "claim"]], columns=CONDITION)
_NOTHING = Effect("claim", "border", "run", np.zeros(0), 1.0, 1.0, 1.0)
_TESTS = ("p", "p_trimmed", "p_sign")  # of an effect


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


def decide_paper(claims: Mapping[str, Mapping[str, ReadingDot]]) -> dict[str, ClaimDecision]:
    """Decide the claims of a paper, in one column.

    Args:
        claims: Readings of each claim by name. The first is the central one.

    Returns:
        Decision by claim.
    """
    weighed: dict[tuple[str, str, str], _Evidence] = {}
    looks = [_decide_look(claims, is_early, alpha, weighed) for is_early, alpha in ((True, LOOKS[0]), (False, LOOKS[1]))]  # fmt: skip
    return {
        name: _conclude(dots, [(look[0][name], look[1][name]) for look in looks])
        for name, dots in claims.items()
    }


_Look = tuple[dict[str, set[str]], dict[str, dict[str, set[str]]]]


def _decide_look(
    claims: Mapping[str, Mapping[str, ReadingDot]],
    is_early: bool,
    alpha: float,
    weighed: dict[tuple[str, str, str], _Evidence],
) -> _Look:
    """Decide all claims and all readings at a look; returns the outcomes shown by claim, and by claim and reading.

    Evidence of readings whose runs are all of the first look is stored in `weighed`, and not computed twice.
    """
    decided: dict[str, set[str]] = {name: set() for name in claims}
    dots_shown: dict[str, dict[str, set[str]]] = {
        name: {reading: set() for reading in dots} for name, dots in claims.items()
    }
    for outcome in (TRUE, FALSE):
        dots = {
            (name, reading): weighed.get((outcome, name, reading)) or _weigh(dot, outcome, is_early)
            for name, readings in claims.items()
            for reading, dot in readings.items()
            if is_counted(dot)
        }
        weighed |= {
            (outcome, *key): item
            for key, item in dots.items()
            if all(c.early.all() for c in claims[key[0]][key[1]].comparisons)
        }
        everywhere = {name: _hold_everywhere([e for (n, _), e in dots.items() if n == name]) for name in claims}  # fmt: skip
        for name in _select_decided(everywhere, alpha):
            _add_outcome(decided[name], outcome)
        for name, reading in _select_decided(dots, alpha):
            _add_outcome(dots_shown[name][reading], outcome)
    return decided, dots_shown


def _add_outcome(decided: set[str], outcome: str) -> None:
    """Add an outcome of a look. Better by less than 1 % is true, and not false as well."""
    if TRUE not in decided:
        decided.add(outcome)


def is_counted(dot: ReadingDot) -> bool:
    """Return whether a reading counts for the word: it can run, says something, and is not fitted to the claim."""
    if dot.state in (CANNOT_RUN, VACUOUS, NOT_COUNTED):
        return False
    return not dot.comparisons or bool(_select_informative(dot))


def _select_informative(dot: ReadingDot) -> list[ClaimSample]:
    """Select the comparisons that say something: not lost on both sides, and not equal by construction."""
    return [
        c for c in dot.comparisons
        if (c.lost_a & c.lost_b).mean() <= _MOST_LOST and not (c.kind == "same" and _is_equal(c))
    ]  # fmt: skip


def _is_equal(c: ClaimSample) -> bool:
    """Return whether a and b are equal in all runs, as of two filters that are one algebraically."""
    d = compare_to_border(c, 0.0).differences
    return len(d) >= MIN_RUNS and not d.any() and not (c.lost_a | c.lost_b).any()


def compare_to_border(c: ClaimSample, border: float) -> Effect:
    """Compare the losses of a with those of b times a border of the ratio, by the comparison of all pages."""
    values = np.stack([c.a, c.b])[:, None]
    is_lost = np.stack([c.lost_a, c.lost_b])[:, None]
    present = ~np.isnan(values) | is_lost
    runs = StudyRuns(("a", "b"), _TABLE, {"value": values}, ~is_lost, present)
    losses = compute_losses(runs, "value")
    losses[1] += border
    return compare_filters(runs, losses, [("a", "b")])[0]


def _weigh(dot: ReadingDot, outcome: str, is_early: bool) -> _Evidence:
    """Weigh the evidence of a reading for an outcome."""
    if dot.state or not dot.comparisons:
        return _Evidence(_NOTHING, is_certain=dot.state == outcome, is_excluded=dot.state == (FALSE if outcome == TRUE else TRUE))  # fmt: skip
    tests = []
    for c in _select_informative(dot):
        used = c.select(c.early) if is_early else c
        borders = find_borders(c.kind, c.printed)[0 if outcome == TRUE else 1]
        # below the high end and above the low end, or beyond one of them
        turn = 1.0 if outcome == TRUE else -1.0
        signs = ((borders[1], -turn), (borders[0], turn))
        tests += [_orient(used, b, sign) for b, sign in signs if math.isfinite(b)]
    return _hold_everywhere(tests) if outcome == TRUE else _hold_somewhere(tests)


def _orient(c: ClaimSample, border: float, sign: float) -> _Evidence:
    """Compare with a border such that "better" is the side of the sign; p is 1 on the other side."""
    effect = compare_to_border(c, border)
    d = -sign * effect.differences if sign > 0 else effect.differences
    effect = effect._replace(differences=d)
    if len(d) >= MIN_RUNS and not is_testable(effect):
        is_certain = bool(d.max() < 0)
        return _Evidence(
            effect._replace(p=1.0, p_trimmed=1.0, p_sign=1.0), is_certain, not is_certain
        )
    if len(d) < MIN_RUNS or not effect.is_smaller:
        effect = effect._replace(p=1.0, p_trimmed=1.0, p_sign=1.0)
    return _Evidence(effect)


def _hold_everywhere(parts: Sequence[_Evidence]) -> _Evidence:
    """Combine evidence for an outcome that all parts must have: the largest p-values."""
    if not parts or any(item.is_excluded for item in parts):
        return _Evidence(_NOTHING, is_excluded=bool(parts))
    tested = [item.effect for item in parts if not item.is_certain]
    if not tested:
        return parts[0]
    weakest = max(tested, key=lambda e: max(e.p, e.p_trimmed))
    largest = {name: max(getattr(e, name) for e in tested) for name in _TESTS}
    return _Evidence(weakest._replace(**largest))


def _hold_somewhere(parts: Sequence[_Evidence]) -> _Evidence:
    """Combine evidence for an outcome that one part may have: the smallest p-values times the number of parts."""
    if any(item.is_certain for item in parts):
        return next(item for item in parts if item.is_certain)
    if not parts or all(item.is_excluded for item in parts):
        return _Evidence(_NOTHING, is_excluded=bool(parts))
    strongest = min((item.effect for item in parts), key=lambda e: max(e.p, e.p_trimmed))
    smallest = {name: min(1.0, len(parts) * getattr(strongest, name)) for name in _TESTS}
    return _Evidence(strongest._replace(**smallest))


def _select_decided(evidence: Mapping[_Key, _Evidence], alpha: float) -> list[_Key]:
    """Select what is shown: certain, or decided by the verdicts of one family."""
    tested = {key: item for key, item in evidence.items() if not item.is_certain}
    verdicts = decide([item.effect for item in tested.values()], margin=0.0, alpha=alpha)
    better = {
        key for key, verdict in zip(tested, verdicts, strict=True) if verdict.word == BETTER_THAN
    }
    return [key for key in evidence if key not in tested or key in better]


def _conclude(
    dots: Mapping[str, ReadingDot], looks: Sequence[tuple[set[str], Mapping[str, set[str]]]]
) -> ClaimDecision:
    """Conclude on a claim from both looks."""
    decided = set().union(*(look[0] for look in looks))
    outcomes = {
        reading: _name_outcome(dot, set().union(*(look[1][reading] for look in looks)))
        for reading, dot in dots.items()
    }
    counted = [reading for reading, dot in dots.items() if is_counted(dot)]
    if len(decided) == 1:  # what holds in all readings holds in each of them
        outcomes |= dict.fromkeys(counted, next(iter(decided)))
    central = _describe_first(dots)
    if not counted:
        return ClaimDecision(UNTESTABLE, (), outcomes, *central)
    if len(decided) == 1:
        return ClaimDecision(CONFIRMED if decided == {TRUE} else REFUTED, (), outcomes, *central)
    if {TRUE, FALSE} <= set(outcomes.values()):
        return ClaimDecision(DEPENDS, _find_factors(dots, outcomes), outcomes, *central)
    return ClaimDecision(OPEN, (), outcomes, *central)


def _name_outcome(dot: ReadingDot, decided: set[str]) -> str:
    """Name the outcome of a reading; open if both looks differ."""
    is_lost = any(
        (c.lost_a & c.lost_b).mean() > _MOST_LOST for c in dot.comparisons
    )  # in most runs, both
    if not is_counted(dot):
        return dot.state or (CANNOT_RUN if is_lost else VACUOUS)
    if len(decided) == 1:
        return next(iter(decided))
    return UNDECIDED if dot.comparisons else NOT_RUN


def _find_factors(dots: Mapping[str, ReadingDot], outcomes: Mapping[str, str]) -> tuple[str, ...]:
    """Find the factors whose levels turn the outcome of the central reading; of all decided levels if it is open."""
    central = next(iter(outcomes.values()))
    turned = {TRUE: (FALSE,), FALSE: (TRUE,)}.get(central, (TRUE, FALSE))
    names = (dot.factor for reading, dot in dots.items() if outcomes[reading] in turned)
    return tuple(dict.fromkeys(name for name in names if name not in ("none", PAIR)))


_Description = tuple[float, float, float, int, float, str]


def _describe_first(dots: Mapping[str, ReadingDot]) -> tuple[*_Description, str]:
    """Describe the comparison that decides, in the central reading or the first that runs.

    It is the one that is shown to be beyond a border of true by most, else the one that is closest to turn the claim.

    Returns ratio, interval, runs, order, sides and reading.
    """
    for reading, dot in dots.items():
        options = [_describe(c) for c in dot.comparisons if len(c.a)]
        if options:
            return *max(options, key=lambda row: row[0])[1], reading
        if not dot.state:
            break
    return math.nan, math.nan, math.nan, 0, math.nan, "", ""


def _describe(c: ClaimSample) -> tuple[tuple[bool, float], _Description]:
    """Return how far a comparison is beyond its border, and ratio, interval, runs, share of runs with a smaller, and sides."""
    effect = compare_to_border(c, 0.0)
    location, low, high = effect.estimate(ALPHA)
    true_low, true_high = find_borders(c.kind, c.printed)[0]
    excess = max(low - true_high, true_low - high)
    nearness = (excess > 0, excess if excess > 0 else max(high - true_high, true_low - low))
    order = float((effect.differences < 0).mean())
    count = len(effect.differences)
    return nearness, (math.exp(location), math.exp(low), math.exp(high), count, order, c.sides)
