"""The ledger: the word on each claim in both columns, what turns it, and the price of the runs that it lacks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

from pfbench.claims.claim_lines import (
    COLUMNS,
    DIRECTION_PART,
    PUBLISHED,
    REPAIRED,
    SIZE_PART,
    ClaimPlan,
    list_dots,
    read_claim_data,
    read_readings,
)
from pfbench.claims.claim_list import KINDS, find_tipping_bound
from pfbench.claims.run_claims import Decisions
from pfbench.claims.words import (
    CONFIRMED,
    DEPENDS,
    FALSE,
    NOT_RUN,
    OPEN,
    REFUTED,
    TRUE,
    UNDECIDED,
    WORDS,
    ClaimDecision,
)
from pfbench.job.readings import CENTRAL_READING, read_reading_table
from pfbench.stats.sentences import format_count

_KIND_TEXTS = {
    "better": "a smaller figure than the other one",
    "much better": "a figure at least a fifth smaller",
    "same": "figures within 10 %",
    "number": "a printed number",
    "within": "a figure of at most {printed:g} times the other one",
}


class ClaimWord(NamedTuple):
    """Word on a claim.

    Attributes:
        plan: Claim and what decides it.
        word: Word as published.
        reason: Reason in words; empty for a word that runs give.
        repaired: Word for our repair; empty if the claim is about no repaired form.
        repaired_reason: Its reason.
        size: Word on the printed number; empty if the claim has a direction only, or a number only.
        factors: Factors on which it depends.
        decision: Decision by runs; None for a word without.
    """

    plan: ClaimPlan
    word: str
    reason: str
    repaired: str
    repaired_reason: str
    size: str
    factors: tuple[str, ...]
    decision: ClaimDecision | None

    @property
    def label(self) -> str:
        """Word with the factors on which it depends."""
        return f"{DEPENDS} on {', '.join(self.factors)}" if self.word == DEPENDS else self.word

    @property
    def state(self) -> str:
        """Word, or "not run" of an open claim that lacks runs of a reading."""
        return NOT_RUN if self.word == OPEN and self.reason.endswith(NOT_RUN) else self.word


def conclude(plan: ClaimPlan, decisions: Decisions) -> ClaimWord:
    """Conclude on a claim from its decisions, or from what decides it without runs."""
    if plan.word:
        return ClaimWord(plan, plan.word, plan.reason, "", "", "", (), None)
    by_part = {
        (column, portion): decisions[plan.claim.id, column, portion]
        for column, portion in plan.parts
    }
    main = {c: by_part.get((c, DIRECTION_PART)) or by_part.get((c, SIZE_PART)) for c in COLUMNS}
    published, repaired = main[PUBLISHED], main[REPAIRED]
    assert published is not None  # each claim has a published column
    size = by_part.get((PUBLISHED, SIZE_PART))
    has_both = size is not None and (PUBLISHED, DIRECTION_PART) in by_part
    return ClaimWord(
        plan,
        published.word,
        _explain(plan, published),
        repaired.word if repaired else "",
        _explain(plan, repaired) if repaired else "",
        size.word if size is not None and has_both else "",
        published.factors,
        published,
    )


def _explain(plan: ClaimPlan, decision: ClaimDecision) -> str:
    """Explain a word that runs do not give, or not alone."""
    outcomes = list(decision.outcomes.values())
    missing = outcomes.count(NOT_RUN)
    if decision.word == OPEN and missing:
        has_runs = decision.runs or UNDECIDED in outcomes
        return f"{missing} of {len(outcomes)} readings not run" if has_runs else NOT_RUN
    if plan.proved:
        return f"proof {plan.claim.proof} in all readings but {', '.join(plan.but)}"
    if decision.word == DEPENDS:
        return f"true in {format_count(outcomes.count(TRUE), 'reading')}, false in {outcomes.count(FALSE)}"
    if decision.word == OPEN and len(outcomes) > 1:
        return f"in {outcomes.count(UNDECIDED)} of {len(outcomes)} readings"
    is_same = plan.claim.kind == "same"
    if (
        decision.word == CONFIRMED
        and not is_same
        and KINDS["better"][1] < decision.low < decision.high < 1
    ):
        return "by less than 1 %"
    if (
        decision.word == REFUTED
        and not plan.has_other_kind
        and plan.claim.kind == "much better"
        and decision.high < 1
    ):
        return f"smaller by {100 * (1 - decision.ratio):.0f} %, and much is {100 * (1 - KINDS['much better'][0]):.0f} % or more"
    return ""


def describe_tip(line: ClaimWord) -> str:
    """Describe where the word would turn: the bound of the ratio of a to b."""
    decision = line.decision
    if (
        decision is None
        or not decision.runs
        or not math.isfinite(decision.high)
        or decision.low <= 0
    ):
        return ""
    kind = line.plan.claim.kind
    if line.plan.has_other_kind:
        return ""
    bound = find_tipping_bound(kind, decision.low, decision.high)
    if bound <= KINDS[kind][0]:  # true in the reading that is shown
        return ""
    return (
        f"it would be true if ratios up to {bound:.3g} counted; they count up to {KINDS[kind][0]:g}"
    )


def describe_turns(line: ClaimWord) -> list[str]:
    """Describe the readings that differ from the central one."""
    if line.decision is None:
        return []
    outcomes = dict(line.decision.outcomes)
    first = next(iter(outcomes.values()))
    readings = read_readings(line.plan.claim.paper)
    return [
        f"{readings[name].text.rstrip('.') if name in readings else name}: {outcome}"
        for name, outcome in outcomes.items()
        if outcome != first and outcome not in (NOT_RUN, OPEN)
    ]


def describe_kind(plan: ClaimPlan) -> str:
    """Describe what a claim must show."""
    if not plan.has_other_kind:
        return _KIND_TEXTS[plan.claim.kind]
    comparisons = [c for parts in plan.parts.values() for c in parts]
    texts = (_KIND_TEXTS[c.kind].format(printed=c.printed) for c in comparisons)
    return "; ".join(dict.fromkeys(texts))


def list_choices(plan: ClaimPlan) -> list[str]:
    """List the choices of this project that enter a claim: completions of the central reading, and own levels."""
    paper = plan.claim.paper
    if plan.toy:
        return ["a world of this project: " + ", ".join(plan.toy)]
    completed = [
        entry["why"] for entry in read_reading_table(paper)[CENTRAL_READING].get("completions", ())
    ]
    names = [name for name, _ in list_dots(plan).values() if name in read_readings(paper)]
    ours = [read_readings(paper)[name] for name in dict.fromkeys(names)]
    return [*completed, *(f"{r.text} {r.reason}" for r in ours if r.grade in ("ours", "fitted"))]


def count_by_paper(lines: Sequence[ClaimWord]) -> dict[str, dict[str, int]]:
    """Count the words of each paper, and the open claims that lack runs apart."""
    return {
        paper: {
            state: sum(line.state == state and line.plan.claim.paper == paper for line in lines)
            for state in (*WORDS, NOT_RUN)
        }
        for paper in read_claim_data()["papers"]
    }
