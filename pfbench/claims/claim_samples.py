"""Values of a claim's test, and the region claimed for their median."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import stats

from pfbench.claims.schema import ClaimTest
from pfbench.results.error_measures import Array
from pfbench.results.statistics.effect_sizes import beyond_finite, log_ratio
from pfbench.results.statistics.signed_rank import wilcoxon_signed_rank

EFFECT_FACTOR = 2.0  # between measured and printed effect, on the logarithmic scale
_PAIRED = ("less", "greater", "equal", "no_worse", "close")


@dataclass(frozen=True)
class ClaimSample:
    """Values of one test and the region claimed for their median.

    Attributes:
        d: One finite number per run, [n].
        low: Lower border of the region.
        high: Upper border of the region.
        worth: Distance from a border that a sufficient effect exceeds.
        logs: Whether d are logarithms.
        largest: Largest number of a valid run; larger ones represent lost runs.
    """

    d: Array
    low: float
    high: float
    worth: float
    logs: bool
    largest: float


def sample_claim_test(test: ClaimTest, a: Array, b: Array | None) -> ClaimSample:
    """Compute the values of one test and the region claimed for their median.

    Args:
        test: Test.
        a: One number per run of the first filter, [n], infinite where lost.
        b: Numbers of the second filter in the same runs, if the test has one.

    Returns:
        Values and region.
    """
    name = test.statistic
    if name in ("flat", "falls"):
        width = test.margin if name == "flat" else 0.0
        return ClaimSample(a, -width if name == "flat" else -np.inf, width, 0.0, False, np.inf)
    if name == "close":
        assert b is not None  # checked when the record was read
        d, largest = _make_finite(np.where(a == b, 0.0, np.subtract(a, b)))
        return ClaimSample(d, -test.margin, test.margin, 0.0, False, largest)
    is_paired = name in _PAIRED and b is not None
    reference = b if is_paired else np.full(a.size, test.printed if name == "near" else 1.0)
    assert reference is not None
    d = log_ratio(a, reference)
    finite = np.isfinite(a) & np.isfinite(reference) & (a > 0) & (reference > 0)
    largest = float(np.abs(d[finite]).max(initial=0.0)) * (1 + 1e-12)
    low, high, worth = _log_region(test)
    return ClaimSample(d, low, high, worth, True, largest)


def region_p_value(s: ClaimSample) -> float:
    """Compute the larger p of the signed-rank tests that the median is inside both borders."""
    p = []
    if np.isfinite(s.high):
        p.append(wilcoxon_signed_rank(s.d - s.high, "less").p)
    if np.isfinite(s.low):
        p.append(wilcoxon_signed_rank(s.d - s.low, "greater").p)
    return max(p, default=np.nan)


def exclusion_p_value(s: ClaimSample) -> float:
    """Compute the p-value that the median excludes every sufficient effect.

    It is at most alpha exactly if the order-statistic interval of level 1 - alpha lies outside.

    Args:
        s: Values and region.

    Returns:
        Two-sided p-value of the nearer border; 1 without one.
    """
    # a sufficient effect lies beyond its border, so the border itself is excluded
    allows_equality = s.worth > 0
    inside = []
    if np.isfinite(s.high):
        border = s.high - s.worth
        inside.append(s.d < border if allows_equality else s.d <= border)
    if np.isfinite(s.low):
        border = s.low + s.worth
        inside.append(s.d > border if allows_equality else s.d >= border)
    tails = (stats.binom.cdf(np.count_nonzero(d), d.size, 0.5) for d in inside)
    return min((min(1.0, 2 * float(tail)) for tail in tails), default=1.0)


def _log_region(test: ClaimTest) -> tuple[float, float, float]:
    """Return the region of a median log ratio, and the size of a sufficient effect."""
    width = float(np.log1p(test.margin))
    worth = abs(float(np.log(test.printed))) / EFFECT_FACTOR
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = map(float, np.log([test.low, test.high]))
    worth = worth if np.isfinite(test.printed) else width
    return {
        "less": (-np.inf, 0.0, worth),
        "greater": (0.0, np.inf, worth),
        "no_worse": (-np.inf, width, 0.0),
        "equal": (-width, width, 0.0),
        "near": (-width, width, 0.0),
        "below": (-np.inf, high, 0.0),
        "above": (low, np.inf, 0.0),
        "within": (low, high, 0.0),
        "report": (-np.inf, np.inf, 0.0),
    }[test.statistic]


def _make_finite(d: Array) -> tuple[Array, float]:
    """Replace infinite differences by numbers beyond all others; return the largest finite one."""
    largest = float(np.abs(d[np.isfinite(d)]).max(initial=0.0))
    return np.where(np.isfinite(d), d, np.sign(d) * beyond_finite(d)), largest * (1 + 1e-12)
