"""The ledger: the word on each claim in both columns, what turns it, and the price of the runs that it lacks."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from pfbench.claims.claim_lines import (
    DIRECTION_PART,
    MUCH,
    PUBLISHED,
    REPAIRED,
    SIZE_PART,
    WINDOW,
    ClaimPlan,
    list_factor_levels,
    list_main_parts,
    read_claim_data,
)
from pfbench.claims.claim_list import KINDS
from pfbench.claims.claim_runs import Decisions
from pfbench.claims.words import (
    CONFIRMED,
    FALSE,
    NOT_RUN,
    OPEN,
    REFUTED,
    TRUE,
    WORDS,
    ClaimDecision,
)
from pfbench.job.readings import CENTRAL_READING, read_reading_table


class ClaimWord(NamedTuple):
    """Word on a claim.

    Attributes:
        plan: Claim and what decides it.
        word: Word as published.
        reason: Reason in words; empty for a word that runs give.
        repaired: Word for our repair; empty if the claim is about no repaired form.
        repaired_reason: Its reason.
        size: Word on the printed number; empty if the claim has a direction only, or a number only.
        decision: Decision by runs; None for a word without.
    """

    plan: ClaimPlan
    word: str
    reason: str
    repaired: str
    repaired_reason: str
    size: str
    decision: ClaimDecision | None

    @property
    def label(self) -> str:
        """Word with the factor on which it depends most."""
        factor = self.decision.factor if self.decision else ""
        return f"{self.word} on {factor}" if factor else self.word

    @property
    def state(self) -> str:
        """Word, or "not run" of an open claim that lacks runs of a reading."""
        return NOT_RUN if self.word == OPEN and self.reason.endswith(NOT_RUN) else self.word


def conclude(plan: ClaimPlan, decisions: Decisions) -> ClaimWord:
    """Conclude on a claim from its decisions, or from what decides it without runs."""
    if plan.word:
        return ClaimWord(plan, plan.word, plan.reason, "", "", "", None)
    mine = {column: decisions[plan.claim.id, column, portion] for column, portion in list_main_parts(plan)}  # fmt: skip
    published, repaired = mine[PUBLISHED], mine.get(REPAIRED)
    has_both = {(PUBLISHED, SIZE_PART), (PUBLISHED, DIRECTION_PART)} <= plan.parts.keys()
    return ClaimWord(
        plan,
        published.word,
        _explain(plan, published),
        repaired.word if repaired else "",
        _explain(plan, repaired) if repaired else "",
        decisions[plan.claim.id, PUBLISHED, SIZE_PART].word if has_both else "",
        published,
    )


def _explain(plan: ClaimPlan, decision: ClaimDecision) -> str:
    """Explain on which readings a word rests, and what a proof or a small difference has to do with it."""
    outcomes = list(decision.outcomes.values())
    missing = outcomes.count(NOT_RUN)
    if decision.word == OPEN and missing:
        is_begun = decision.share.counted > 0
        return f"{missing} of {len(outcomes)} readings not run" if is_begun else NOT_RUN
    texts = [describe_share(decision)]
    if plan.proved:
        texts += [f"proof {plan.claim.proof} in all readings but those of {', '.join(plan.but)}"]
    effect = decision.first[1]
    is_small = KINDS["better"][1] < effect.low < effect.high < 1
    if decision.word == CONFIRMED and plan.claim.kind != "same" and is_small:
        texts += ["by less than 1 %"]
    return "; ".join(filter(None, texts))


def describe_share(decision: ClaimDecision) -> str:
    """Describe the readings that a word rests on: the share of joint draws, or how many listed ones agree."""
    true, false, n, low, high = decision.share
    if decision.is_drawn:
        interval = f"{100 * low:.0f} to {100 * high:.0f} %" if n else "none"
        return f"true in {true} and false in {false} of {n} joint readings, a share of {interval}"
    if decision.word in (CONFIRMED, REFUTED):
        return f"in {n} readings, one level changed in each" if n > 1 else "in one reading"
    return f"true in {true} and false in {false} of {n} readings, one level changed in each" if n else ""  # fmt: skip


def describe_levels(line: ClaimWord) -> list[str]:
    """Describe the outcomes at each level of the factor on which a claim depends."""
    decision = line.decision
    if decision is None or not decision.factor:
        return []
    counts: dict[str, list[str]] = {}
    for dot in decision.readings.values():
        counts.setdefault(dot.levels[decision.factor], []).append(dot.outcome)
    return [
        f"{name_level(line.plan, decision.factor, level)}: true in {outcomes.count(TRUE)}, false in {outcomes.count(FALSE)}"
        for level, outcomes in counts.items()
    ]


def name_level(plan: ClaimPlan, factor: str, level: str) -> str:
    """Name a level of a factor in words."""
    if factor in (MUCH, WINDOW):
        return f"{factor} as {level}"
    rows = read_reading_table(plan.claim.paper)
    return f"{factor} as in the central reading" if level == CENTRAL_READING else rows[level]["text"].rstrip(".")  # fmt: skip


def name_reading(plan: ClaimPlan, name: str, decision: ClaimDecision) -> str:
    """Name a reading by its levels that are not central."""
    if plan.toy:
        return f"World of this project, {' '.join(plan.toy)}"
    options, levels = list_factor_levels(plan), decision.readings[name].levels
    changed = [name_level(plan, f, level) for f, level in levels.items() if level != options[f][0]]
    return "; ".join(changed) or "Central reading"


def list_choices(plan: ClaimPlan) -> list[str]:
    """List the choices of this project that enter a claim: completions of the central reading, and own levels."""
    paper = plan.claim.paper
    if plan.toy:
        return ["a world of this project: " + ", ".join(plan.toy)]
    rows = read_reading_table(paper)
    completed = [entry["why"] for entry in rows[CENTRAL_READING].get("completions", ())]
    names = [level for levels in list_factor_levels(plan).values() for level in levels[1:]]
    ours = [rows[name] for name in names if rows.get(name, {}).get("class") == "ours"]
    return [*completed, *(f"{row['text']} {row['why']}" for row in ours)]


def count_by_paper(lines: Sequence[ClaimWord]) -> dict[str, dict[str, int]]:
    """Count the words of each paper, and the open claims that lack runs apart."""
    return {
        paper: {
            state: sum(line.state == state and line.plan.claim.paper == paper for line in lines)
            for state in (*WORDS, NOT_RUN)
        }
        for paper in read_claim_data()["papers"]
    }
