"""Tests of a family of comparisons: Holm's correction and simultaneous intervals that agree with it.

References:
    S. Holm (1979), A simple sequentially rejective multiple test procedure.
    O. Guilbaud (2008), Simultaneous confidence regions corresponding to Holm's step-down procedure.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from pfbench.results.decisions.pair_effects import QuestionEffect
from pfbench.results.error_measures import Array, Flags
from pfbench.results.statistics.signed_rank import holm
from pfbench.results.statistics.world_effects import EffectEstimate


class FamilyTests(NamedTuple):
    """Tests of a family, [..., M].

    Attributes:
        low: Lower ends of the simultaneous intervals.
        high: Upper ends.
        p_corrected: p-values with Holm's correction, NaN without a test.
        is_decided: Whether the interval excludes 0. An end of 0 is excluded, too: it is the bound
            of the interval that belongs to Holm's test.
        size: Number of tests of the family, [...].
    """

    low: Array
    high: Array
    p_corrected: Array
    is_decided: Flags
    size: Array


def stack_questions(members: list[QuestionEffect]) -> QuestionEffect:
    """Stack comparisons along a new last axis."""
    estimates = (np.stack(v, axis=-1) for v in zip(*(m.estimate for m in members), strict=True))
    value, p = (np.stack([m[k] for m in members], axis=-1) for k in (0, 2))
    return QuestionEffect(value, EffectEstimate(*estimates), p)


def correct_p_values(p: Array) -> Array:
    """Apply Holm's correction along the last axis; NaN is not part of the family."""
    rows = p.reshape(-1, p.shape[-1])
    corrected = np.full(rows.shape, np.nan)
    for row, result in zip(rows, corrected, strict=True):
        tested = np.isfinite(row)
        result[tested] = holm(row[tested])
    return corrected.reshape(p.shape)


def decide_family(members: QuestionEffect, alpha: float) -> FamilyTests:
    """Test a family of comparisons, [..., M].

    Intervals have level 1 - alpha / M. If Holm's test decides and the interval includes 0, its end
    becomes 0. An interval of a comparison that is not decided includes 0.

    Args:
        members: Comparisons.
        alpha: Error of the family.

    Returns:
        Decisions and intervals.
    """
    size = np.isfinite(members.p).sum(axis=-1)
    low, high = members.estimate.interval(alpha / np.maximum(size, 1)[..., None])
    corrected = correct_p_values(members.p)
    decided = np.nan_to_num(corrected, nan=1.0) <= alpha
    is_negative, is_positive = decided & (members.value < 0), decided & (members.value > 0)
    low = np.where(
        is_positive, np.maximum(low, 0.0), np.where(is_negative, low, np.minimum(low, 0.0))
    )
    high = np.where(
        is_negative, np.minimum(high, 0.0), np.where(is_positive, high, np.maximum(high, 0.0))
    )
    return FamilyTests(low, high, corrected, is_negative | is_positive, size)
