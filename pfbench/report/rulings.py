"""Which claims of the papers hold: every comparison is decided once, and a claim holds where all of its comparisons do.

A comparison claims that the median over runs of some figure lies in a region: of the logarithm of a ratio to another filter on
the same worlds, of one to a number, of a difference, of a share. It holds when one-sided signed-rank tests (exact binomial for
shares) put the median into the region, with Holm's correction over all comparisons made for one paper; equivalence is two
such tests [Schuirmann 1987]. It fails when the interval of the median [order statistics, exact for any law] leaves out what is
claimed, with an effect worth the name: half of the printed one on the logarithmic scale, or the margin. Else the runs are too
few to tell. Where a ratio is printed, the effect must also be within a factor of 2 of it on the logarithmic scale [ours].

Lost runs are worse than any other, as in `significance`; where neither filter has half of its runs left, nothing is decided.
Times per step are one measurement for all runs of a job: they are told apart beyond a tenth, without an interval [ours].

Of what the runs were too few to tell, the runs are counted that find the measured effect with power 0.8: in the region by the
signed-rank test at the level of the first step of Holm's correction, or outside of it by the interval of the median, which is as
good as the t test of 2/pi as many normal differences; the fewer of the two [ours].
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy import stats

from pfbench.metrics import Array
from pfbench.report import power
from pfbench.report.claims import Claim, Comparison
from pfbench.report.significance import log_ratio

VERDICTS = (
    "reproduced", "reproduced only as printed", "reproduced only as repaired", "not reproduced", "cannot be decided"
)  # fmt: skip
HOLDS, FAILS, OPEN = "holds", "fails", "open"
_FACTOR = 2.0  # of the printed effect
_CLOCK = 1.1  # one timing against another
_MEDIAN = 2 / np.pi  # efficiency of the interval between order statistics, relative to the t test, of normal differences
_PAIRED = ("less", "greater", "equal", "no_worse", "close")


@dataclass(frozen=True)
class Finding:
    """One comparison, decided.

    Attributes:
        comparison: what was asked.
        outcome: "holds", "fails" or "open".
        why: of an open one its reason, of a failed one what stands against it; may be empty.
        pairs: runs that entered; 0 where nothing ran.
        lost_a, lost_b: lost runs among all.
        unit: of a level or a difference; empty for ratios and shares.
        effect: median over runs of the ratio a / b, the difference, the level or the share.
        low, high: interval of it; infinite where there is none.
        p: one-sided, of this comparison alone; NaN where nothing is tested.
        p_holm: corrected over `family` comparisons of the paper.
        family: how many these are.
        within: how deep the median lies in the claimed region, in standard deviations over runs of what neither filter lost;
            negative outside of it, NaN where lost runs decide the median.
        beyond: how far it lies outside of what the claim must exceed to be worth its name, likewise.
        needed: runs per cell that decide an effect as large as the measured one with power 0.8, where those at hand were too
            few; infinite where no number does, NaN where nothing of that kind is asked.
    """

    comparison: Comparison
    outcome: str
    why: str = ""
    pairs: int = 0
    lost_a: int = 0
    lost_b: int = 0
    unit: str = ""
    effect: float = np.nan
    low: float = np.nan
    high: float = np.nan
    p: float = np.nan
    p_holm: float = np.nan
    family: int = 0
    within: float = np.nan
    beyond: float = np.nan
    needed: float = np.nan


@dataclass(frozen=True)
class Ruling:
    """One claim, decided.

    Attributes:
        claim: the record.
        verdict: one of `VERDICTS`.
        reason: of what cannot be decided one of `claims.REASONS`; else empty.
        note: what else must be said, in words.
        findings: by form of the method.
    """

    claim: Claim
    verdict: str
    reason: str
    note: str
    findings: Mapping[str, tuple[Finding, ...]]


@dataclass(frozen=True)
class Sample:
    """What one comparison says of each run, and what is claimed of its median.

    Attributes:
        d: one number per run, finite.
        low, high: the median is claimed to lie between them.
        worth: distance from an end of that region that the claim must exceed to be worth its name.
        logs: d are logarithms.
        beyond: what is larger stands for lost runs.
    """

    d: Array
    low: float
    high: float
    worth: float
    logs: bool
    beyond: float


def decide(claims: Sequence[Claim], frame: pd.DataFrame, alpha: float = 0.05) -> list[Ruling]:
    """All claims, in their order.

    Args:
        claims: from `claims.load`.
        frame: from `claims.gather`; the order of its rows is of no importance.
        alpha: level of the tests after correction, and probability outside the intervals.
    """
    columns = ["study", "cell", "label", "measure"]
    series = {tuple(map(str, key)): part for key, part in frame.groupby(columns, sort=False)}
    first = [
        {form: tuple(_find(test, series, alpha) for test in tests) for form, tests in claim.tests.items()} for claim in claims
    ]
    final = _corrected(claims, first, alpha)
    return [_rule(claim, findings) for claim, findings in zip(claims, final, strict=True)]


def sample(test: Comparison, a: Array, b: Array | None) -> Sample:
    """The numbers of one comparison and the region claimed for their median.

    Args:
        test: says which.
        a, b: one number per run [n], paired; infinite where lost.
    """
    name = test.statistic
    if name in ("flat", "falls"):
        width = test.margin if name == "flat" else 0.0
        return Sample(a, -width if name == "flat" else -np.inf, width, 0.0, False, np.inf)
    if name == "close":
        assert b is not None  # checked when the record was read
        d, beyond = _finite(np.where(a == b, 0.0, np.subtract(a, b)))
        return Sample(d, -test.margin, test.margin, 0.0, False, beyond)
    width = float(np.log1p(test.margin))
    reference = b if name in _PAIRED and b is not None else np.full(a.size, test.printed if name == "near" else 1.0)
    d = log_ratio(a, reference)
    finite = np.isfinite(a) & np.isfinite(reference) & (a > 0) & (reference > 0)
    beyond = float(np.abs(d[finite]).max(initial=0.0)) * (1 + 1e-12)
    worth = abs(np.log(test.printed)) / _FACTOR if np.isfinite(test.printed) else width
    with np.errstate(divide="ignore", invalid="ignore"):
        limits = np.log([test.low, test.high])
    low, high, worth = {
        "less": (-np.inf, 0.0, worth), "greater": (0.0, np.inf, worth), "no_worse": (-np.inf, width, 0.0),
        "equal": (-width, width, 0.0), "near": (-width, width, 0.0), "below": (-np.inf, limits[1], 0.0),
        "above": (limits[0], np.inf, 0.0), "within": (limits[0], limits[1], 0.0), "report": (-np.inf, np.inf, 0.0),
    }[name]  # fmt: skip
    return Sample(d, float(low), float(high), float(worth), True, beyond)


def p_value(s: Sample) -> float:
    """p of the signed-rank tests that the median lies in the region: the larger of both sides."""
    sides = [(s.d - s.high, "less")] if np.isfinite(s.high) else []
    sides += [(s.d - s.low, "greater")] if np.isfinite(s.low) else []
    return max((_signed_rank(d, side) for d, side in sides), default=np.nan)


def median_interval(d: Array, level: float) -> tuple[float, float]:
    """Interval of the median between two order statistics, of at least the level; infinite where d [n] are too few."""
    ordered, n = np.sort(d), d.size
    k = int(stats.binom.ppf((1 - level) / 2, n, 0.5)) if n else 0
    if n and stats.binom.cdf(k, n, 0.5) > (1 - level) / 2:
        k -= 1
    return (float(ordered[k]), float(ordered[n - 1 - k])) if n and k >= 0 else (-np.inf, np.inf)


def holm_adjusted(p: Array) -> list[float]:
    """p with Holm's correction [Holm 1979], in the order given."""
    order = np.argsort(p, kind="stable")
    adjusted = np.minimum(1.0, np.maximum.accumulate(p[order] * np.arange(p.size, 0, -1)))
    return [float(value) for value in adjusted[np.argsort(order, kind="stable")]]


def _signed_rank(d: Array, side: str) -> float:
    return 1.0 if not d.any() else float(stats.wilcoxon(d, zero_method="zsplit", alternative=side).pvalue)


def _find(one: Comparison, series: Mapping[tuple[str, ...], pd.DataFrame], alpha: float) -> Finding:
    """A comparison before Holm's correction."""
    sides = [series.get((*side, one.measure)) for side in one.sides]
    if any(side is None for side in sides):
        return Finding(one, OPEN, "not run")
    parts = [side.set_index(["seed", "run"]).sort_index() for side in sides if side is not None]
    both = pd.concat([part.value for part in parts], axis=1, join="inner").dropna().to_numpy(dtype=np.float64)
    runs = min(len(part) for part in parts)
    lost = [int(part.lost.sum()) for part in parts] + [0]
    level = len(parts) == 1 or one.statistic == "close"
    known = Finding(one, OPEN, "", len(both), lost[0], lost[1], str(parts[0].unit.iloc[0]) if level and runs else "")
    # an error without bound is an answer where the question is whether it stays below one
    answers = one.metric in ("settled", "diverged") or one.statistic == "below"
    finite = len(both) if answers else int(np.isfinite(both).any(axis=1).sum())
    if finite < (runs + 1) // 2:
        return replace(known, why="lost" if sum(lost) else "not run")
    if one.statistic == "cost":
        return _cost(known, both)
    if one.statistic == "share":
        return _share(known, both[:, 0], alpha)
    return _median(known, sample(one, both[:, 0], both[:, 1] if both.shape[1] > 1 else None), alpha)


def _median(known: Finding, s: Sample, alpha: float) -> Finding:
    low, high = median_interval(s.d, 1 - alpha)
    # a level near a printed one is tested as its ratio to that, and shown as what it is
    scale = known.comparison.printed if known.comparison.statistic == "near" else 1.0
    effect, *between = (scale * _shown(value, s) for value in (float(np.median(s.d)), low, high))
    found = replace(known, effect=effect, low=between[0], high=between[1])
    if known.comparison.statistic == "report":
        return found
    within, beyond = _depth(s)
    found = replace(found, within=within, beyond=beyond)
    apart = low >= s.high - s.worth if s.worth else low > s.high
    below = high <= s.low + s.worth if s.worth else high < s.low
    if apart or below:
        return replace(found, outcome=FAILS, p=p_value(s))
    return replace(found, why="no power", p=p_value(s))


def _depth(s: Sample) -> tuple[float, float]:
    """`within` and `beyond` of a finding."""
    own, middle = s.d[np.abs(s.d) <= s.beyond], float(np.median(s.d))
    if own.size < 2 or abs(middle) > s.beyond:
        return np.nan, np.nan
    into, outside = min(s.high - middle, middle - s.low), max(middle - s.high, s.low - middle) + s.worth
    with np.errstate(divide="ignore", invalid="ignore"):  # where all runs agree, one more tells
        within, beyond = np.array([into, outside]) / own.std(ddof=1)
    return float(within), float(beyond)


def _share(known: Finding, hits: Array, alpha: float) -> Finding:
    """Share of the runs in which the metric is 1, claimed to exceed the limit."""
    count, limit = int(hits.sum()), known.comparison.low
    exact = stats.binomtest(count, hits.size, limit, alternative="greater")
    between = stats.binomtest(count, hits.size, limit).proportion_ci(1 - alpha, method="exact")
    found = replace(known, effect=count / hits.size, low=float(between.low), high=float(between.high), p=float(exact.pvalue))
    return replace(found, outcome=FAILS) if between.high <= limit else replace(found, why="no power")


def _cost(known: Finding, seconds: Array) -> Finding:
    """Ratio of two times per step, or one time in seconds, each measured once."""
    one, ratio = known.comparison, float(seconds[0, 0] / (seconds[0, 1] if seconds.shape[1] > 1 else 1.0))
    found = replace(known, effect=ratio, low=-np.inf, high=np.inf)
    if np.isfinite(one.printed):
        return _size(replace(found, outcome=HOLDS if (ratio > 1) == (one.printed > 1) else FAILS))
    if one.low * _CLOCK <= ratio <= one.high / _CLOCK:
        return replace(found, outcome=HOLDS)
    outside = ratio < one.low / _CLOCK or ratio > one.high * _CLOCK
    return replace(found, outcome=FAILS) if outside else replace(found, why="no power")


def _corrected(
    claims: Sequence[Claim], first: Sequence[Mapping[str, tuple[Finding, ...]]], alpha: float
) -> list[dict[str, tuple[Finding, ...]]]:
    """With Holm's correction over all tests made for one paper."""
    holm: dict[tuple[str, Comparison], float] = {}
    size: dict[str, int] = {}
    for paper in {claim.paper for claim in claims}:
        of_paper = (findings for claim, findings in zip(claims, first, strict=True) if claim.paper == paper)
        # what several claims, or both forms of one, ask for is tested once
        p = {f.comparison: f.p for findings in of_paper for form in findings.values() for f in form if not np.isnan(f.p)}
        size[paper] = len(p)
        adjusted = holm_adjusted(np.array(list(p.values())))
        holm |= {(paper, one): value for one, value in zip(p, adjusted, strict=True)}

    def settle(found: Finding, paper: str) -> Finding:
        if np.isnan(found.p):
            return found
        found = replace(found, p_holm=holm[paper, found.comparison], family=size[paper])
        if found.p_holm > alpha:
            return replace(found, needed=_needed(found, alpha)) if found.why == "no power" else found
        if found.outcome == FAILS:
            return replace(found, why=found.why or "the direction holds, the effect is below what was claimed")
        return _size(replace(found, outcome=HOLDS, why=""))

    return [
        {form: tuple(settle(f, claim.paper) for f in findings) for form, findings in forms.items()}
        for claim, forms in zip(claims, first, strict=True)
    ]


def _needed(found: Finding, alpha: float) -> float:
    """Runs that decide a comparison, one way or the other, with power 0.8 if the effect is what it was."""
    one, level = found.comparison, alpha / found.family
    if one.statistic == "share":
        return power.needed_share(found.effect, one.low, level if found.effect > one.low else alpha / 2)
    if np.isnan(found.within):
        return np.nan
    # where both sides of a region must be shown, each is missed half as often
    both = one.statistic in ("equal", "close", "near", "within", "flat")
    wanted = 1 - (1 - power.POWER) / 2 if both else power.POWER
    # one-sided tests: two-sided ones at twice the level
    ways = [power.needed(found.within, min(1.0, 2 * level), wanted)] if found.within > 0 else []
    ways += [power.needed(found.beyond, alpha, efficiency=_MEDIAN)] if found.beyond > 0 else []
    return min(ways, default=np.inf)


def _size(found: Finding) -> Finding:
    """A direction that holds, with an effect that must be within a factor of the printed one on the logarithmic scale."""
    printed = found.comparison.printed
    if found.outcome != HOLDS or np.isnan(printed) or found.comparison.statistic == "near":
        return found
    with np.errstate(divide="ignore"):
        share = float(np.log(found.effect) / np.log(printed))
    if 1 / _FACTOR <= share <= _FACTOR:
        return found
    return replace(found, outcome=FAILS, why=f"the direction holds, the effect is {share:.2g} of the printed one")


def _rule(claim: Claim, findings: Mapping[str, tuple[Finding, ...]]) -> Ruling:
    """The verdict on one claim from what was found for each form of the method."""
    if "" in claim.why:
        return Ruling(claim, VERDICTS[4], *claim.why[""], findings)
    told = {form: _together(found) for form, found in findings.items()}
    told |= {form: (OPEN, reason) for form, (reason, _) in claim.why.items()}
    told |= {form: (outcome, "") for form, (outcome, _) in claim.shown.items()}
    states = {state for state, _ in told.values()}
    said = [f"{f'as {form}: ' if form else ''}{text}" for form, (_, text) in [*claim.why.items(), *claim.shown.items()]]
    said += _timings(findings)
    for form, (state, why) in told.items():
        if state == FAILS and why:
            said.append(f"{f'as {form}: ' if form else ''}{why}")
    tested = {form: one for form, one in told.items() if form not in claim.why}
    holding = [form for form, (state, _) in tested.items() if state == HOLDS]
    unknown = [why for state, why in tested.values() if state == OPEN]
    if unknown:
        return Ruling(claim, VERDICTS[4], unknown[0], "; ".join([*said, *(f"as {form} it holds" for form in holding)]), findings)
    note = "; ".join(said)
    if states == {HOLDS}:
        return Ruling(claim, VERDICTS[0], "", note, findings)
    return Ruling(claim, f"reproduced only as {holding[0]}" if holding else VERDICTS[3], "", note, findings)


def _timings(findings: Mapping[str, tuple[Finding, ...]]) -> list[str]:
    """How far times per step can be trusted: the range over cells where there are several, else that there is one timing."""
    ratios: dict[tuple[str, str, str], list[float]] = {}
    for form, found in findings.items():
        for f in found:
            if f.comparison.statistic == "cost" and not np.isnan(f.effect):
                ratios.setdefault((form, f.comparison.a, f.comparison.b), []).append(f.effect)
    said = ["time per step: one timing a job, no interval"] if any(len(values) == 1 for values in ratios.values()) else []
    for (form, a, b), values in ratios.items():
        if len(values) > 1:
            sides = f"{f'as {form}: ' if form else ''}time per step of {a}{f' to {b}' if b else ' in s'}"
            said.append(f"{sides}: {min(values):.3g} to {max(values):.3g} over {len(values)} cells, one timing a job")
    return said


def _together(found: Sequence[Finding]) -> tuple[str, str]:
    """All must hold; one that fails decides, whatever is open."""
    for outcome in (FAILS, OPEN):
        whys = [f.why for f in found if f.outcome == outcome]
        if whys:
            return outcome, "; ".join(dict.fromkeys(why for why in whys if why)) if outcome == FAILS else whys[0]
    return HOLDS, ""


def _finite(d: Array) -> tuple[Array, float]:
    """Differences made finite: lost runs lie beyond all others; and beyond what they do."""
    largest = float(np.abs(d[np.isfinite(d)]).max(initial=0.0))
    return np.where(np.isfinite(d), d, np.sign(d) * (4 * largest + 1)), largest * (1 + 1e-12)


def _shown(value: float, s: Sample) -> float:
    """Back from the logarithm; what lies beyond every finite number stands for lost runs."""
    if np.isinf(value) or abs(value) > s.beyond:
        return 0.0 if s.logs and value < 0 else float(np.sign(value) * np.inf)
    return float(np.exp(value)) if s.logs else value
