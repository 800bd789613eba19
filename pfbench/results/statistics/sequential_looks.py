"""Planned looks at a growing number of runs: levels of the looks and intervals valid at all of them.

The error is spent over looks as a function of the share of runs. Intervals of all looks are
intersected, and their coverage holds at the look at which a study stops.

References:
    P. Armitage, C. K. McPherson and B. C. Rowe (1969), Repeated significance tests on accumulating data.
    K. K. G. Lan and D. L. DeMets (1983), Discrete sequential boundaries for clinical trials.
    C. Jennison and B. W. Turnbull (1989), Interim analyses: the repeated confidence interval approach.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Literal

import numpy as np
from scipy.optimize import brentq
from scipy.special import ndtr, ndtri

from pfbench.results.error_measures import Array
from pfbench.results.statistics.world_effects import EffectEstimate

Spending = Literal["pocock", "obrien_fleming"]
_NODES = 121
LEAST_P = 1e-8
_BISECTIONS = 20
_LARGEST = 37.0  # standard score beyond which a normal tail is zero in double precision


@dataclass(frozen=True)
class LookPlan:
    """Plan of the looks of a study that adds runs until every pair is decided.

    Attributes:
        runs: Runs per condition at each look, increasing.
        alpha: Error of all planned pairs together.
        comparisons: Number of comparisons that share the error. Each has an equal part.
        spending: Error spent by a share of the runs: "pocock" or "obrien_fleming".

    Raises:
        ValueError: if the runs do not increase, or a number is out of range.
    """

    runs: tuple[int, ...] = (20, 40, 80, 160, 320)
    alpha: float = 0.05
    comparisons: int = 1
    spending: Spending = "pocock"

    def __post_init__(self) -> None:
        if not self.runs or min(self.runs) < 1 or list(self.runs) != sorted(set(self.runs)):
            raise ValueError(
                f"runs must be positive and increasing, got {self.runs}. Use (20, 40, 80)."
            )
        if not 0 < self.alpha < 1 or self.comparisons < 1:
            raise ValueError(
                f"alpha and comparisons must be within 0 to 1 and at least 1, got {self.alpha} and "
                f"{self.comparisons}. Use 0.05 and the number of planned comparisons."
            )

    @property
    def levels(self) -> tuple[float, ...]:
        """Two-sided levels of the looks of each comparison."""
        times = tuple(n / self.runs[-1] for n in self.runs)
        scores = boundary_scores(times, self.alpha / self.comparisons, self.spending)
        return tuple(2 * float(ndtr(-z)) for z in scores)


def spent_error(time: float, alpha: float, spending: Spending) -> float:
    """Return the error that may be spent until a share of the runs.

    Args:
        time: Share of the runs, 0 to 1.
        alpha: Error of all looks, two-sided.
        spending: Spending function of Lan and DeMets.
    """
    if spending == "pocock":
        return float(alpha * np.log1p(np.expm1(1.0) * time))
    return float(4 * ndtr(ndtri(alpha / 4) / np.sqrt(time)))


@lru_cache(maxsize=512)
def boundary_scores(
    times: tuple[float, ...], alpha: float, spending: Spending
) -> tuple[float, ...]:
    """Compute the standard scores at which a look shows a difference, two-sided.

    The distribution of the sum of runs that have not yet decided is integrated from look to look
    with Gauss-Legendre points.

    Args:
        times: Shares of the runs at the looks, increasing, the last one at most 1.
        alpha: Error of all looks.
        spending: Spending function.

    Returns:
        One score per look.
    """
    nodes, node_weights = np.polynomial.legendre.leggauss(_NODES)
    scores: list[float] = []
    x, mass, before, spent = np.zeros(1), np.ones(1), 0.0, 0.0
    for time in times:
        target = spent_error(time, alpha, spending) - spent
        sd, root = np.sqrt(time - before), np.sqrt(time)
        excess = partial(_excess, x, mass, root, sd, target)
        z = float(brentq(excess, 0.0, _LARGEST, xtol=1e-10)) if target > 0 else _LARGEST
        scores.append(z)
        following = z * root * nodes
        kernel = np.exp(-0.5 * ((following[:, None] - x) / sd) ** 2) / (sd * np.sqrt(2 * np.pi))
        mass = z * root * node_weights * (kernel @ mass)
        x, before, spent = following, time, spent + max(target, 0.0)
    return tuple(scores)


def repeated_interval(
    estimates: Sequence[EffectEstimate], levels: Sequence[float]
) -> tuple[Array, Array]:
    """Intersect the intervals of all looks so far.

    Args:
        estimates: Estimates of question (a) at the looks so far.
        levels: Two-sided levels of the looks, at least as many.

    Returns:
        Lower and upper end. If the intervals of two looks do not overlap, the last one remains.
    """
    ends = [estimate.interval(level) for estimate, level in zip(estimates, levels, strict=False)]
    low = np.max([end[0] for end in ends], axis=0)
    high = np.min([end[1] for end in ends], axis=0)
    overlap = low <= high
    return np.where(overlap, low, ends[-1][0]), np.where(overlap, high, ends[-1][1])


def repeated_p_value(p: Sequence[float], plan: LookPlan) -> float:
    """Compute the least error of the plan at which some look so far shows a difference.

    Args:
        p: p-values at the looks so far.
        plan: Plan of the looks.

    Returns:
        p-value of one comparison, at least 1e-8, before the multiplication by their number.
    """
    times = tuple(n / plan.runs[-1] for n in plan.runs)

    def is_shown(alpha: float) -> bool:
        scores = boundary_scores(times, alpha, plan.spending)
        return any(v <= 2 * ndtr(-z) for v, z in zip(p, scores, strict=False))

    low, high = np.log(LEAST_P), np.log(1.0 - 1e-9)
    if not is_shown(float(np.exp(high))):
        return 1.0
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if is_shown(float(np.exp(middle))) else (middle, high)
    return float(np.exp(high))


def _excess(x: Array, mass: Array, root: float, sd: float, target: float, score: float) -> float:
    """Return the probability that the next sum exceeds a score, minus the target."""
    limit = score * root
    return float(mass @ (ndtr((x - limit) / sd) + ndtr((-x - limit) / sd))) - target
