"""Record of one decision: all data behind a sentence, for pages, tables and claims."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Final, Literal

import numpy as np

from pfbench.stats.effects import PRIOR_SD

Question = Literal["a", "b"]
Scale = Literal["log ratio", "difference", "share", "runs won"]


@dataclass(frozen=True)
class Decision:
    """Decision on one metric of one pair for one question.

    Effects are negative if filter a is better. An effect is a log ratio of values, a difference, a
    difference of shares that fail, or a difference of shares of runs won.

    Attributes:
        question: "a" for the worlds of the study, "b" for a new world of the same kind.
        a: Label of the first filter.
        b: Label of the second filter.
        metric: Name of the metric; "keeps track" for the share of runs that keep track.
        group: Group of the state.
        scale: Scale of the effect.
        estimate: Effect.
        low: Lower end of the simultaneous interval.
        high: Upper end.
        level: Level of the simultaneous interval, 1 - alpha / family_size.
        plain_low: Lower end of the interval of this comparison alone, which other pairs do not change.
        plain_high: Upper end.
        p: p-value, NaN without a test.
        p_corrected: p-value with Holm's correction.
        family: Name of the family of the correction.
        family_size: Number of tests of the family.
        worlds: Number of worlds.
        regimes: Number of regimes.
        runs: Runs per condition that both filters have, at least.
        share_a: Share of runs in which a keeps track.
        share_b: Share of runs in which b keeps track.
        world_sd: SD of the effect over worlds, NaN for one world.
        run_sd: SD of the effect over runs.
        looks: Number of looks at the data so far.
        word: better, worse, equivalent, inconclusive, identical or not tested; of this metric.
        size: Statement about the margin.
        pair_word: Decision on the pair from track and error, with "trade-off".
        reason: Reason why a decision is missing or has another scale; empty otherwise.
        margin: Margin of equivalence in the unit of the effect.
        runs_needed: Runs per condition that show an effect of the margin with power 0.8.
        worlds_needed: Worlds that show an effect of twice the SD between worlds with power 0.8.
        worlds_better: Worlds in which the effect is below 0.
        worlds_worse: Worlds in which the effect is above 0.
        new_low: Lower end of the 95 % interval of one new world; question (b).
        new_high: Upper end.
        posterior_low: Lower end of the posterior interval with the stated prior; 2 to 5 worlds.
        posterior_high: Upper end.
        prior_sd: Scale of the half-normal prior of the SD between worlds.
        p_moderated: Corrected p-value with moderated variances; sensitivity value.
        both_keep: Effect among the runs in which both filters keep track; descriptive.
    """

    question: Question
    a: str
    b: str
    metric: str
    group: str
    scale: Scale
    estimate: float
    low: float
    high: float
    level: float
    plain_low: float
    plain_high: float
    p: float
    p_corrected: float
    family: str
    family_size: int
    worlds: int
    regimes: int
    runs: int
    share_a: float
    share_b: float
    world_sd: float
    run_sd: float
    looks: int
    word: str
    size: str
    pair_word: str
    reason: str
    margin: float
    runs_needed: float
    worlds_needed: float
    worlds_better: int
    worlds_worse: int
    new_low: float = math.nan
    new_high: float = math.nan
    posterior_low: float = math.nan
    posterior_high: float = math.nan
    prior_sd: float = math.nan
    p_moderated: float = math.nan
    both_keep: float = math.nan

    def to_dict(self) -> dict[str, Any]:
        """Return values that JSON can store: numbers that are not finite become text."""
        return {name: plain_value(value) for name, value in asdict(self).items()}


def plain_value(value: Any) -> Any:
    """Return a value that JSON can store; a number that is not finite becomes text."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float) and not math.isfinite(value):
        return str(value)
    return value


# --------------------------------------------------------------------------------------------------
# Words of a decision. Every word is a function of one interval and of one margin.
#
# An effect is negative if the first filter is better. An interval whose decided end is 0 excludes 0.

BETTER: Final = "better"
WORSE: Final = "worse"
EQUIVALENT: Final = "equivalent"
INCONCLUSIVE_PAIR: Final = "inconclusive"
IDENTICAL: Final = "identical"
TRADE_OFF: Final = "trade-off"
NOT_TESTED: Final = "not tested"

MORE: Final = "by more than the margin"
LESS: Final = "by less than the margin"
OPEN_SIZE: Final = "size inconclusive"
NOT_BETTER: Final = "not better by the margin"
NOT_WORSE: Final = "not worse by the margin"
NO_SIZE: Final = ""

HOLDS: Final = "holds"
FAILS: Final = "fails"
DIRECTION_HOLDS: Final = "direction holds, size inconclusive"


def pair_word(low: float, high: float, is_decided: bool, margin: float) -> tuple[str, str]:
    """Return the decision on a pair and its size."""
    if is_decided and high <= 0:
        return BETTER, _size(-high, -low, margin)
    if is_decided and low >= 0:
        return WORSE, _size(low, high, margin)
    if -margin < low and high < margin:
        return EQUIVALENT, LESS
    if -margin < low:
        return INCONCLUSIVE_PAIR, NOT_BETTER
    if high < margin:
        return INCONCLUSIVE_PAIR, NOT_WORSE
    return INCONCLUSIVE_PAIR, NO_SIZE


def claim_word(
    low: float, high: float, is_decided: bool, margin: float, states_size: bool = True
) -> str:
    """Return the decision on the claim that the first filter is better."""
    is_better = is_decided and high <= 0
    if is_better and (high < -margin or not states_size):
        return HOLDS
    if is_better and low <= -margin:
        return DIRECTION_HOLDS
    return FAILS if low > -margin else INCONCLUSIVE_PAIR


def combine_words(track: str, error: str, is_trade_off: bool) -> str:
    """Return the decision on a pair from its decisions on track and error."""
    decided = {word for word in (track, error) if word in (BETTER, WORSE)}
    if is_trade_off or len(decided) == 2:
        return TRADE_OFF
    if decided:
        return decided.pop()
    if error == NOT_TESTED:
        return NOT_TESTED
    if {track, error} <= {EQUIVALENT, IDENTICAL}:
        return error
    return INCONCLUSIVE_PAIR


def _size(least: float, most: float, margin: float) -> str:
    """Compare the size of a decided effect with the margin."""
    if least > margin:
        return MORE
    return LESS if most < margin else OPEN_SIZE


# --------------------------------------------------------------------------------------------------
# Options of decisions and rules of metrics.

MetricScale = Literal["log ratio", "difference", "mean difference", "share"]
Estimate = Literal["paired", "levels"]


@dataclass(frozen=True)
class MetricRule:
    """Rule that makes a paired effect of a metric.

    Attributes:
        name: Name of the metric in sentences.
        scale: "log ratio" and "difference" are trimmed, "mean difference" is not. "share" is the
            difference of shares of runs.
        group: Group of the state.
        higher_is_better: Whether larger values are better.
        margin: Margin of equivalence in the unit of the effect, None for that of the options.
        unit: Unit of a difference, for sentences.
    """

    name: str = "error"
    scale: MetricScale = "log ratio"
    group: str = "position"
    higher_is_better: bool = False
    margin: float | None = None
    unit: str = ""


@dataclass(frozen=True)
class DecisionOptions:
    """Options of all decisions of a study.

    Attributes:
        alpha: Error of a family.
        margin: Relative difference of values within which filters are equivalent.
        track_margin: Difference of shares within which filters are equivalent.
        prior_sd: Scale of the prior of the SD between worlds.
        shared_runs: Whether runs of equal name have the same random numbers in all worlds.
        estimate: Log ratio of two filters. It is the difference of their trimmed means for "levels", as
            in the order of a report. For "paired", it is the trimmed mean over runs.

    Raises:
        ValueError: if a value is out of range.
    """

    alpha: float = 0.05
    margin: float = 0.05
    track_margin: float = 0.05
    prior_sd: float = PRIOR_SD
    shared_runs: bool = True
    estimate: Estimate = "levels"

    def __post_init__(self) -> None:
        if not 0 < self.alpha < 1:
            raise ValueError(f"alpha must be between 0 and 1, got {self.alpha}. Use 0.05.")
        for name in ("margin", "track_margin", "prior_sd"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive, got {getattr(self, name)}. Use 0.05.")

    @property
    def log_margin(self) -> float:
        """Margin of log ratios."""
        return math.log1p(self.margin)
