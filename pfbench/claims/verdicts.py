"""Verdicts on the claims of the papers: a claim holds if all of its tests hold.

`claim_tests` tests single claims. Holm's correction covers all tests of one paper, for "holds" and
for "fails". Tests that do not decide have a family of their own. If a ratio is printed, the measured effect must also be within a factor of 2 of it on the logarithmic scale
[ours].

For a test with too few runs, the required runs are computed: those that show the measured effect
with power 0.8. Inside the region, the signed-rank test shows it at the level of the first step of
Holm's correction. Outside, the sign test shows it at that level, which equals the t test of 2/pi as
many normal differences. The smaller number counts [ours].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd

from pfbench.claims.claim_tests import (
    NOT_DECIDED,
    ClaimTestResult,
    check_effect_size,
    run_claim_test,
)
from pfbench.claims.schema import Claim, ClaimTest
from pfbench.results.decisions.words import FAILS, HOLDS
from pfbench.results.statistics import power
from pfbench.results.statistics.signed_rank import holm

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

    Args:
        claims: Records from `read_claims`.
        frame: Rows of `load_claim_measurements`, in any order.
        alpha: Level of the tests after correction, and probability outside the intervals.

    Returns:
        One verdict per claim.
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
        return power.required_runs_proportion(result.effect, test.low, level)
    if np.isnan(result.within):
        return np.nan
    # If both borders of a region must be shown, each has half of the error probability.
    is_two_sided = test.statistic in _TWO_SIDED
    target = 1 - (1 - power.POWER) / 2 if is_two_sided else power.POWER
    runs = []
    if result.within > 0:  # one-sided: the two-sided test at twice the level
        runs.append(power.required_runs(result.within, min(1.0, 2 * level), target))
    if result.outside > 0:
        runs.append(power.required_runs(result.outside, level, efficiency=_MEDIAN_EFFICIENCY))
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
