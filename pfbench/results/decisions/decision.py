"""Record of one decision: all data behind a sentence, for pages, tables and claims."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

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
