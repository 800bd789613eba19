"""Verdicts on the claims of the papers: samples, tests with Holm's correction, words."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import stats

from pfbench.claims.claim_records import FAILS, HOLDS, LOST, NO_POWER, NOT_RUN, Claim, ClaimTest
from pfbench.stats import study_size
from pfbench.stats.effects import beyond_finite, log_ratio
from pfbench.stats.error_measures import Array
from pfbench.stats.intervals import order_statistic_interval
from pfbench.stats.rank_tests import holm, wilcoxon_signed_rank

# --------------------------------------------------------------------------------------------------
# Tests of single claims: samples, regions, p-values and intervals, before Holm's correction.
#
# A test claims that the median over runs of a value lies in a region. The value is the logarithm of a
# ratio to another filter in the same episodes or to a number, a difference, or a share. One-sided
# signed-rank tests (exact binomial for shares) show that the median lies in the region. The test
# fails if sign tests, which the order-statistic interval inverts, exclude every effect that is large
# enough: half of the printed effect on the logarithmic scale, or the margin. Both p-values are
# corrected by Holm's method over the tests of the paper. Otherwise the runs are too few.
#
# Lost runs rank last. If neither filter has half of its runs, the test is undecided. Times per step
# are one measurement per job: only differences above 10 % count, without an interval [ours].

NOT_DECIDED = "open"
_TIMING_FACTOR = 1.1  # between two timings


@dataclass(frozen=True)
class ClaimTestResult:
    """Decision on one test of a claim.

    Attributes:
        comparison: Test.
        outcome: "holds", "fails" or "open".
        reason: Reason of an open outcome, or what contradicts a claim that fails; may be empty.
        pairs: Runs included; 0 if nothing ran.
        lost_a: Lost runs of a.
        lost_b: Lost runs of b.
        unit: Unit of a level or a difference; empty for ratios and shares.
        effect: Median over runs of the ratio a / b, the difference, the level or the share.
        low: Lower end of its interval, infinite without one.
        high: Upper end of that interval.
        p: One-sided p-value of this test alone; NaN if nothing is tested.
        p_holm: p-value corrected over `family` tests of the paper.
        p_fails: Two-sided p-value that every sufficient effect is excluded; NaN if nothing is tested.
        p_fails_holm: That p-value, corrected over the tests of the paper.
        family: Number of these tests.
        within: Distance of the median from the border inside the claimed region, in SD over valid
            runs. Negative outside, NaN if lost runs decide the median.
        outside: Distance of the median outside the region of sufficient effects, in the same unit.
        needed: Runs per condition that decide the measured effect with power 0.8, if the runs were
            too few. Infinite if no number does, else NaN.
    """

    comparison: ClaimTest
    outcome: str
    reason: str = ""
    pairs: int = 0
    lost_a: int = 0
    lost_b: int = 0
    unit: str = ""
    effect: float = np.nan
    low: float = np.nan
    high: float = np.nan
    p: float = np.nan
    p_holm: float = np.nan
    p_fails: float = np.nan
    p_fails_holm: float = np.nan
    family: int = 0
    within: float = np.nan
    outside: float = np.nan
    needed: float = np.nan


def run_claim_test(
    test: ClaimTest, series: Mapping[tuple[str, ...], pd.DataFrame], alpha: float
) -> ClaimTestResult:
    """Decide a test before Holm's correction.

    Returns the decision; "open" if it needs Holm's correction.
    """
    tables = [series.get((*side, test.measure)) for side in test.sides]
    rows = [table.set_index(["seed", "run"]).sort_index() for table in tables if table is not None]
    if len(rows) < len(tables):
        return ClaimTestResult(test, NOT_DECIDED, NOT_RUN)
    columns = [table.value for table in rows]
    values = pd.concat(columns, axis=1, join="inner").dropna().to_numpy(dtype=np.float64)
    runs = min(len(table) for table in rows)
    lost_a, lost_b, *_ = [int(table.lost.sum()) for table in rows] + [0]
    has_unit = (len(rows) == 1 or test.statistic == "close") and runs
    unit = str(rows[0].unit.iloc[0]) if has_unit else ""
    result = ClaimTestResult(test, NOT_DECIDED, "", len(values), lost_a, lost_b, unit)
    # An infinite value is an answer if the test asks whether it stays below a limit.
    counts_lost = test.metric in ("settled", "severely_overconfident")
    counts_lost |= test.statistic == "below"
    finite = len(values) if counts_lost else int(np.isfinite(values).any(axis=1).sum())
    if finite < (runs + 1) // 2:
        return replace(result, reason=LOST if lost_a + lost_b else NOT_RUN)
    if test.statistic == "cost":
        return _test_cost(result, values)
    if test.statistic == "share":
        return _test_share(result, values[:, 0], alpha)
    b = values[:, 1] if values.shape[1] > 1 else None
    return _test_median(result, sample_claim_test(test, values[:, 0], b), alpha)


def check_effect_size(result: ClaimTestResult) -> ClaimTestResult:
    """Fail a result whose effect is not within a factor of the printed one, on a log scale."""
    printed = result.comparison.printed
    if result.outcome != HOLDS or np.isnan(printed) or result.comparison.statistic == "near":
        return result
    with np.errstate(divide="ignore"):
        share = float(np.log(result.effect) / np.log(printed))
    if 1 / EFFECT_FACTOR <= share <= EFFECT_FACTOR:
        return result
    reason = f"the direction holds, the effect is {share:.2g} of the printed effect"
    return replace(result, outcome=FAILS, reason=reason)


def _test_median(result: ClaimTestResult, s: ClaimSample, alpha: float) -> ClaimTestResult:
    """Decide a test about a median, as far as its interval decides it."""
    interval = order_statistic_interval(s.d, 1 - alpha)
    low, high = interval.low, interval.high
    # A level near a printed number is tested as a ratio and shown as a level.
    is_near = result.comparison.statistic == "near"
    scale = result.comparison.printed if is_near else 1.0
    values = (float(np.median(s.d)), low, high)
    effect, shown_low, shown_high = (scale * _display(value, s) for value in values)
    result = replace(result, effect=effect, low=shown_low, high=shown_high)
    if result.comparison.statistic == "report":
        return result
    inside, outside = _measure_depth(s)
    result = replace(result, p=region_p_value(s), p_fails=exclusion_p_value(s))
    return replace(result, within=inside, outside=outside, reason=NO_POWER)


def _measure_depth(s: ClaimSample) -> tuple[float, float]:
    """Compute `within` and `outside` of a result."""
    valid, median = s.d[np.abs(s.d) <= s.largest], float(np.median(s.d))
    if valid.size < 2 or abs(median) > s.largest:
        return np.nan, np.nan
    inside = min(s.high - median, median - s.low)
    outside = max(median - s.high, s.low - median) + s.worth
    with np.errstate(divide="ignore", invalid="ignore"):  # equal runs: infinite
        depths = np.array([inside, outside]) / valid.std(ddof=1)
    return float(depths[0]), float(depths[1])


def _test_share(result: ClaimTestResult, hits: Array, alpha: float) -> ClaimTestResult:
    """Test whether the share of runs with metric 1 exceeds a limit."""
    count, limit = int(hits.sum()), result.comparison.low
    p = stats.binomtest(count, hits.size, limit, alternative="greater").pvalue
    interval = stats.binomtest(count, hits.size, limit).proportion_ci(1 - alpha, method="exact")
    result = replace(
        result,
        effect=count / hits.size,
        low=float(interval.low),
        high=float(interval.high),
        p=float(p),
    )
    p_fails = min(1.0, 2 * float(stats.binom.cdf(count, hits.size, limit)))
    return replace(result, reason=NO_POWER, p_fails=p_fails)


def _test_cost(result: ClaimTestResult, seconds: Array) -> ClaimTestResult:
    """Compare two times per step, or one time with limits; each was measured once."""
    test = result.comparison
    ratio = float(seconds[0, 0] / (seconds[0, 1] if seconds.shape[1] > 1 else 1.0))
    result = replace(result, effect=ratio, low=-np.inf, high=np.inf)
    if np.isfinite(test.printed):
        is_same_side = (ratio > 1) == (test.printed > 1)
        return check_effect_size(replace(result, outcome=HOLDS if is_same_side else FAILS))
    if test.low * _TIMING_FACTOR <= ratio <= test.high / _TIMING_FACTOR:
        return replace(result, outcome=HOLDS)
    is_outside = ratio < test.low / _TIMING_FACTOR or ratio > test.high * _TIMING_FACTOR
    return replace(result, outcome=FAILS) if is_outside else replace(result, reason=NO_POWER)


def _display(value: float, s: ClaimSample) -> float:
    """Invert the logarithm; values beyond every valid number represent lost runs."""
    if np.isinf(value) or abs(value) > s.largest:
        return 0.0 if s.logs and value < 0 else float(np.sign(value) * np.inf)
    return float(np.exp(value)) if s.logs else value


# --------------------------------------------------------------------------------------------------
# Verdicts on the claims of the papers: a claim holds if all of its tests hold.
#
# `claim_tests` tests single claims. Holm's correction covers all tests of one paper, for "holds" and
# for "fails". Tests that do not decide have a family of their own. If a ratio is printed, the measured effect must also be within a factor of 2 of it on the logarithmic scale
# [ours].
#
# For a test with too few runs, the required runs are computed: those that show the measured effect
# with power 0.8. Inside the region, the signed-rank test shows it at the level of the first step of
# Holm's correction. Outside, the sign test shows it at that level, which equals the t test of 2/pi as
# many normal differences. The smaller number counts [ours].

UNDECIDED = "undecided"
VERDICTS = (
    "reproduced",
    "reproduced only as printed",
    "reproduced only as repaired",
    "not reproduced",
    UNDECIDED,
)
_MEDIAN_EFFICIENCY = 2 / np.pi  # order-statistic interval relative to the t test, normal numbers
_TWO_SIDED = ("equal", "close", "near", "within", "flat")
_Results = tuple[ClaimTestResult, ...]


@dataclass(frozen=True)
class ClaimVerdict:
    """Verdict on one claim.

    Attributes:
        claim: Record.
        verdict: One of `VERDICTS`.
        reason: Reason of an undecided claim, one of `schema.REASONS` or `schema.MARKS`; else empty.
        note: Further remarks.
        findings: Results of the tests, by form of the method.
    """

    claim: Claim
    verdict: str
    reason: str
    note: str
    findings: Mapping[str, tuple[ClaimTestResult, ...]]


def decide_claims(
    claims: Sequence[Claim], frame: pd.DataFrame, alpha: float = 0.05
) -> list[ClaimVerdict]:
    """Decide all claims, in their order.

    Returns one verdict per claim.
    """
    columns = ["study", "cell", "label", "measure"]
    groups = frame.groupby(columns, sort=False)
    series = {tuple(map(str, key)): rows for key, rows in groups}
    raw = [
        {
            form: tuple(run_claim_test(test, series, alpha) for test in tests)
            for form, tests in claim.tests.items()
        }
        for claim in claims
    ]
    corrected = _correct_by_paper(claims, raw, alpha)
    return [_decide(claim, results) for claim, results in zip(claims, corrected, strict=True)]


def _correct_by_paper(
    claims: Sequence[Claim], raw: Sequence[Mapping[str, _Results]], alpha: float
) -> list[dict[str, _Results]]:
    """Apply Holm's correction to all tests of each paper that decide, and to all others."""
    families: dict[tuple[str, bool], dict[ClaimTest, ClaimTestResult]] = {}
    for claim, forms in zip(claims, raw, strict=True):
        for result in (r for results in forms.values() for r in results):
            if not np.isnan(result.p):
                # A test that several claims, or both forms, share is counted once.
                family = families.setdefault((claim.paper, result.comparison.decides), {})
                family[result.comparison] = result
    corrected = {key: _correct_family(family, alpha) for key, family in families.items()}

    def correct(result: ClaimTestResult, paper: str) -> ClaimTestResult:
        family = corrected.get((paper, result.comparison.decides), {})
        return family.get(result.comparison, result)

    return [
        {form: tuple(correct(r, claim.paper) for r in results) for form, results in forms.items()}
        for claim, forms in zip(claims, raw, strict=True)
    ]


def _correct_family(
    family: Mapping[ClaimTest, ClaimTestResult], alpha: float
) -> dict[ClaimTest, ClaimTestResult]:
    """Correct the p-values of holding and of failing, each with Holm's method, and decide."""
    holding = holm([r.p for r in family.values()])
    failing = holm([r.p_fails for r in family.values()])
    return {
        test: _decide_corrected(
            replace(r, p_holm=float(p), p_fails_holm=float(q), family=len(family)), alpha
        )
        for (test, r), p, q in zip(family.items(), holding, failing, strict=True)
    }


def _decide_corrected(result: ClaimTestResult, alpha: float) -> ClaimTestResult:
    """Decide a test by its corrected p-values."""
    is_inside, is_excluded = result.p_holm <= alpha, result.p_fails_holm <= alpha
    if is_excluded:
        reason = "the direction holds, the effect is below the claimed effect" if is_inside else ""
        return replace(result, outcome=FAILS, reason=reason)
    if is_inside:
        return check_effect_size(replace(result, outcome=HOLDS, reason=""))
    return replace(result, needed=_required_runs(result, alpha))


def _required_runs(result: ClaimTestResult, alpha: float) -> float:
    """Compute the runs that decide a test with power 0.8 if the effect is as measured."""
    test, level = result.comparison, alpha / result.family
    if test.statistic == "share":
        level = level if result.effect > test.low else level / 2
        return study_size.required_runs_proportion(result.effect, test.low, level)
    if np.isnan(result.within):
        return np.nan
    # If both borders of a region must be shown, each has half of the error probability.
    is_two_sided = test.statistic in _TWO_SIDED
    target = 1 - (1 - study_size.POWER) / 2 if is_two_sided else study_size.POWER
    runs = []
    if result.within > 0:  # one-sided: the two-sided test at twice the level
        runs.append(study_size.required_runs(result.within, min(1.0, 2 * level), target))
    if result.outside > 0:
        runs.append(study_size.required_runs(result.outside, level, efficiency=_MEDIAN_EFFICIENCY))
    return min(runs, default=np.inf)


def _decide(claim: Claim, results: Mapping[str, _Results]) -> ClaimVerdict:
    """Decide a claim from the results of each form of the method."""
    if claim.mark[0]:
        return ClaimVerdict(claim, UNDECIDED, *claim.mark, results)
    if "" in claim.reasons:
        return ClaimVerdict(claim, UNDECIDED, *claim.reasons[""], results)
    deciding = {form: [r for r in rs if r.comparison.decides] for form, rs in results.items()}
    outcomes = {form: _combine(values) for form, values in deciding.items()}
    outcomes |= {form: (NOT_DECIDED, reason) for form, (reason, _) in claim.reasons.items()}
    outcomes |= {form: (outcome, "") for form, (outcome, _) in claim.evidence.items()}
    notes = _notes(claim, results, outcomes)
    tested = {form: outcome for form, outcome in outcomes.items() if form not in claim.reasons}
    holding = [form for form, (state, _) in tested.items() if state == HOLDS]
    reasons = [reason for state, reason in tested.values() if state == NOT_DECIDED]
    if reasons:
        note = "; ".join([*notes, *(f"as {form} it holds" for form in holding)])
        return ClaimVerdict(claim, UNDECIDED, reasons[0], note, results)
    if {state for state, _ in outcomes.values()} == {HOLDS}:
        verdict = "reproduced"
    else:
        verdict = f"reproduced only as {holding[0]}" if holding else "not reproduced"
    return ClaimVerdict(claim, verdict, "", "; ".join(notes), results)


def _notes(
    claim: Claim, results: Mapping[str, _Results], outcomes: Mapping[str, tuple[str, str]]
) -> list[str]:
    """List the remarks on a verdict: explanations, timings, and reasons of failures."""
    explained = [
        (form, text) for form, (_, text) in [*claim.reasons.items(), *claim.evidence.items()]
    ]
    failed = [
        (form, reason) for form, (state, reason) in outcomes.items() if state == FAILS and reason
    ]
    notes = [f"{_prefix(form)}{text}" for form, text in explained]
    return [*notes, *_timings(results), *(f"{_prefix(form)}{reason}" for form, reason in failed)]


def _prefix(form: str) -> str:
    """Format the form of a method at the start of a remark."""
    return f"as {form}: " if form else ""


def _timings(results: Mapping[str, _Results]) -> list[str]:
    """State the range of times per step over conditions, or that each is a single timing."""
    ratios: dict[tuple[str, str, str], list[float]] = {}
    for form, values in results.items():
        for r in values:
            if r.comparison.statistic == "cost" and not np.isnan(r.effect):
                key = (form, r.comparison.a, r.comparison.b)
                ratios.setdefault(key, []).append(r.effect)
    has_single = any(len(values) == 1 for values in ratios.values())
    notes = ["time per step: one timing per job, no interval"] if has_single else []
    for (form, a, b), times in ratios.items():
        if len(times) > 1:
            sides = f"{_prefix(form)}time per step of {a}{f' to {b}' if b else ' [s]'}"
            span = f"{min(times):.3g} to {max(times):.3g}"
            notes.append(f"{sides}: {span} over {len(times)} conditions, one timing per job")
    return notes


def _combine(results: Sequence[ClaimTestResult]) -> tuple[str, str]:
    """Combine tests of one form: all must hold, and one failure decides."""
    reasons = [r.reason for r in results if r.outcome == FAILS]
    if reasons:
        return FAILS, "; ".join(dict.fromkeys(reason for reason in reasons if reason))
    reasons = [r.reason for r in results if r.outcome == NOT_DECIDED]
    return (NOT_DECIDED, reasons[0]) if reasons else (HOLDS, "")


# --------------------------------------------------------------------------------------------------
# Values of a claim's test, and the region claimed for their median.

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

    Shapes: a [n].
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
