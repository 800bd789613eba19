"""Decisions along one run, from blocks of time, with the words and the family of a study."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from scipy.stats import norm

from pfbench.judge.block_bootstrap import MIN_BLOCKS, BlockEstimate, compare_along_run
from pfbench.judge.judge_options import JudgeOptions
from pfbench.judge.sequence_results import SequenceResults
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.family_tests import FamilyTests, decide_family, stack_questions
from pfbench.results.decisions.pair_effects import QuestionEffect
from pfbench.results.decisions.planned_pairs import Pairs
from pfbench.results.decisions.sentence_formats import (
    format_count,
    format_digits,
    format_effect,
    format_level,
    format_margin,
)
from pfbench.results.decisions.words import (
    BETTER,
    EQUIVALENT,
    IDENTICAL,
    NO_SIZE,
    NOT_TESTED,
    WORSE,
    pair_word,
)
from pfbench.results.error_measures import Array
from pfbench.results.statistics.world_effects import EffectEstimate

FAMILY_BLOCKS = "planned pairs, blocks of time"
METRIC = "position RMSE"
_POWER = 0.8


class BlockDecision(NamedTuple):
    """Decision on a pair along the runs of one sequence.

    Attributes:
        sequence: Name of the sequence.
        decision: Record with the fields of a study; `runs` counts the runs that were averaged.
        seconds: Length of the run, s.
        block_s: Mean length of a block, s.
        blocks: Number of blocks.
        seconds_needed: Length that shows an effect of the margin with power 0.8, s.
    """

    sequence: str
    decision: Decision
    seconds: float
    block_s: float
    blocks: float
    seconds_needed: float

    def to_dict(self) -> dict[str, Any]:
        """Return values that JSON can store."""
        names = ("seconds", "block_s", "blocks", "seconds_needed")
        values = {name: float(getattr(self, name)) for name in names}
        numbers = {
            name: float(f"{value:.6g}") if math.isfinite(value) else str(value)
            for name, value in values.items()
        }
        return {"sequence": self.sequence, **numbers, **self.decision.to_dict()}


class _Member(NamedTuple):
    sequence: str
    a: str
    b: str
    runs: int
    seconds: float
    epoch_s: float
    result: BlockEstimate | None  # None without runs of the same name that both keep
    reason: str = ""  # of a missing result


def decide_along_runs(
    sequences: Sequence[SequenceResults], pairs: Pairs, options: JudgeOptions
) -> list[BlockDecision]:
    """Decide each pair in each sequence by blocks of time; all tests form one family.

    Args:
        sequences: Results of all sequences.
        pairs: Pairs of programs.
        options: Options.

    Returns:
        One decision per sequence and pair; programs that are absent from a sequence are left out.
    """
    members = [
        _compare(sequence, a, b, options)
        for sequence in sequences
        for a, b in pairs
        if a in sequence.results and b in sequence.results
    ]
    effects = [_effect(member.result) for member in members]
    if not members:
        return []
    tests = decide_family(stack_questions(effects), options.alpha)
    return [_record(member, tests, k, options) for k, member in enumerate(members)]


def describe_blocks(result: BlockDecision) -> str:
    """Describe a decision along one run.

    Returns:
        One to three sentences.
    """
    d = result.decision
    head = f"Along {format_digits(result.seconds)} s of {result.sequence}, "
    if d.word == IDENTICAL:
        return f"{head}{d.a} and {d.b} give identical errors."
    if not math.isfinite(d.estimate):
        return f"{head}{d.a} and {d.b} are not compared: {d.reason}."
    blocks = f"{format_digits(result.blocks)} blocks of {format_digits(result.block_s)} s"
    effect = format_effect(d, d.estimate, d.low, d.high)
    sample = f"{format_level(d)} simultaneous interval; {blocks}"
    if d.word == NOT_TESTED:
        size = format_effect(d, d.estimate, d.estimate, d.estimate).partition(" (")[0]
        length = MIN_BLOCKS * result.block_s
        needed = f" {_describe_length(length)}" if result.blocks < MIN_BLOCKS else ""
        return (
            f"{head}{d.a} and {d.b} are not tested: {d.reason}. The {d.metric} of {d.a} is {size} "
            f"than that of {d.b} in this run.{needed}"
        )
    if d.word in (BETTER, WORSE):
        return (
            f"{head}the {d.metric} of {d.a} is {effect.replace('(', f'than that of {d.b} (', 1)[:-1]}, "
            f"{sample}; adjusted p = {d.p_corrected:.2g})."
        )
    if d.word == EQUIVALENT:
        return f"{head}{d.a} and {d.b} are equivalent to within {format_margin(d)}: {effect}, {sample}."
    text = f"{head}{d.a} and {d.b} are not decided: {effect}, {sample}."
    if not math.isfinite(result.seconds_needed):
        return text
    needed = format_digits(result.seconds_needed)
    return f"{text} About {needed} s would decide a difference of {format_margin(d)}."


def _describe_length(seconds: float) -> str:
    return f"A test requires about {format_digits(seconds)} s."


def _compare(sequence: SequenceResults, a: str, b: str, options: JudgeOptions) -> _Member:
    names = sequence.run_names
    shared = [run for run in names[a] if run in names[b]]
    squares = [_mean_square(sequence, program, shared) for program in (a, b)]
    time = sequence.epochs.time
    seconds = float(time[-1] - time[0])
    epoch = seconds / (len(time) - 1)
    first, second = squares
    if first is None or second is None:
        reason = _missing_reason(sequence, a, b, shared)
        return _Member(sequence.name, a, b, len(shared), seconds, epoch, None, reason)
    result = compare_along_run(first, second, options.block / epoch)
    return _Member(sequence.name, a, b, len(shared), seconds, epoch, result)


def _mean_square(sequence: SequenceResults, program: str, runs: Sequence[str]) -> Array | None:
    """Return the squared position error averaged over runs, [T]; None if a run is lost."""
    result, names = sequence.results[program], sequence.run_names[program]
    rows = [names.index(run) for run in runs]
    if not rows or result.data["lost"][rows].any():
        return None
    places = list(result.meta["state"]["groups"]["position"])
    return np.asarray((result.data["error"][rows][..., places] ** 2).sum(axis=-1).mean(axis=0))


def _missing_reason(sequence: SequenceResults, a: str, b: str, shared: Sequence[str]) -> str:
    """Name the cause of a missing comparison along the runs of two programs."""
    names = sequence.run_names
    if not shared:
        runs = [", ".join(run or "without a name" for run in names[name][:3]) for name in (a, b)]
        return f"no run has the same name ({a}: {runs[0]}; {b}: {runs[1]})"
    counts = []
    for name in (a, b):
        rows = [names[name].index(run) for run in shared]
        lost = int(sequence.results[name].data["lost"][rows].sum())
        if lost:
            counts.append(f"{name} is lost in {lost} of {format_count(len(shared), 'run')}")
    return " and ".join(counts)


def _effect(result: BlockEstimate | None) -> QuestionEffect:
    if result is None:
        missing = np.full((), np.nan)
        return QuestionEffect(missing, EffectEstimate(missing, missing, missing), missing)
    return QuestionEffect(result.estimate.value, result.estimate, np.array(result.p))


def _record(member: _Member, tests: FamilyTests, k: int, options: JudgeOptions) -> BlockDecision:
    """Make the record of one comparison."""
    result, margin = member.result, math.log1p(options.margin)
    size = max(int(tests.size), 1)
    value = float(result.estimate.value) if result else math.nan
    error = float(result.estimate.standard_error) if result else math.nan
    word, statement, reason = _word(member, tests, k, margin)
    is_tested = word not in (NOT_TESTED, IDENTICAL)
    nothing = (0.0, 0.0) if word == IDENTICAL else (-math.inf, math.inf)
    low, high = (float(tests.low[k]), float(tests.high[k])) if is_tested else nothing
    plain = result.estimate.interval(options.alpha) if result and is_tested else nothing
    blocks = result.blocks if result else math.nan
    length = result.length * member.epoch_s if result else math.nan
    decision = Decision(
        question="a", a=member.a, b=member.b, metric=METRIC, group="position", scale="log ratio",
        estimate=value, low=low, high=high, level=1 - options.alpha / size,
        plain_low=float(plain[0]), plain_high=float(plain[1]), p=result.p if result else math.nan,
        p_corrected=float(tests.p_corrected[k]), family=FAMILY_BLOCKS, family_size=int(tests.size),
        worlds=1, regimes=1, runs=member.runs, share_a=math.nan, share_b=math.nan,
        world_sd=math.nan, run_sd=math.nan, looks=1, word=word, size=statement, pair_word=word,
        reason=reason, margin=margin, runs_needed=math.nan, worlds_needed=math.nan,
        worlds_better=int(value < 0), worlds_worse=int(value > 0),
    )  # fmt: skip
    quantile = norm.isf(options.alpha / size / 2) + norm.ppf(_POWER)
    needed = member.seconds * (quantile * error / margin) ** 2
    return BlockDecision(member.sequence, decision, member.seconds, length, blocks, float(needed))


def _word(member: _Member, tests: FamilyTests, k: int, margin: float) -> tuple[str, str, str]:
    """Return word, statement on the margin, and reason of a missing test."""
    result = member.result
    if result is None:
        return NOT_TESTED, NO_SIZE, member.reason
    if result.estimate.value == 0 and result.estimate.standard_error == 0:
        return IDENTICAL, NO_SIZE, "all errors agree"
    if not np.isfinite(result.estimate.value):
        return NOT_TESTED, NO_SIZE, "one program has no error"
    if not np.isfinite(tests.p_corrected[k]):
        if result.blocks >= MIN_BLOCKS:
            equal = format_count(int(result.equal_blocks), "equal block")
            count = (
                f"few of {int(result.blocks)} blocks of time hold most of the difference, which "
                f"count as {equal}"
            )
        else:
            count = f"{format_count(int(result.blocks), 'block')} of time"
        return NOT_TESTED, NO_SIZE, f"{count}, {MIN_BLOCKS} are required"
    ends = float(tests.low[k]), float(tests.high[k]), bool(tests.is_decided[k])
    return (*pair_word(*ends, margin), "")
