"""Options of decisions and rules of metrics."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

from pfbench.results.statistics.world_spread import PRIOR_SD

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
