"""Judgement of programs: metrics of each, and decisions on each pair, over sequences or blocks of time."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
from scipy.stats import norm

from pfbench.judge.block_bootstrap import MIN_BLOCKS, BlockEstimate, compare_along_run
from pfbench.judge.checks import check_interpolation
from pfbench.judge.formats import TrajectoryFile, list_trajectory_files
from pfbench.judge.judge_options import JudgeOptions, SourceOptions
from pfbench.judge.reference_track import read_reference
from pfbench.judge.sequence_results import JudgedRun, SequenceResults, read_runs, score_sequence
from pfbench.report.options import ReportOptions
from pfbench.results.metrics import compute_metric, data_by_scope
from pfbench.results.status import keeps_track
from pfbench.stats.decision import (
    BETTER,
    EQUIVALENT,
    IDENTICAL,
    NO_SIZE,
    NOT_TESTED,
    WORSE,
    Decision,
    MetricRule,
    pair_word,
)
from pfbench.stats.effects import MIN_RUNS, EffectEstimate
from pfbench.stats.error_measures import Array
from pfbench.stats.filter_sets import FilterRanking, order_filters
from pfbench.stats.pair_effects import QuestionEffect
from pfbench.stats.planned_pairs import (
    FamilyTests,
    Pairs,
    decide_family,
    decide_planned_pairs,
    stack_questions,
)
from pfbench.stats.run_dependence import find_copied_runs
from pfbench.stats.sentences import (
    format_count,
    format_digits,
    format_effect,
    format_level,
    format_margin,
)

# --------------------------------------------------------------------------------------------------
# Judgement of programs: metrics of each, decisions on each pair, with the statistics of a study.


class Judgement(NamedTuple):
    """Everything that a report on programs shows.

    Attributes:
        sequences: Results of all sequences.
        pairs: Planned pairs.
        decisions: Decisions of a study, for the sequences (a) and for a new one (b); empty if one
            sequence has fewer than 10 runs.
        along_runs: Decisions by blocks of time, one per sequence and pair.
        rankings: Orders of three programs or more for both questions; empty otherwise.
    """

    sequences: tuple[SequenceResults, ...]
    pairs: tuple[tuple[str, str], ...]
    decisions: tuple[Decision, ...]
    along_runs: tuple[BlockDecision, ...]
    rankings: tuple[FilterRanking, ...]


def judge_programs(
    reference: str,
    programs: Mapping[str, str],
    options: JudgeOptions | None = None,
    sources: Mapping[str, SourceOptions] | None = None,
) -> Judgement:
    """Read all trajectories, compute their errors and decide which program is better.

    Args:
        reference: File of the reference, or a pattern with {sequence}.
        programs: File or pattern with {sequence} and {run} by name of the program.
        options: Options, None for the defaults.
        sources: Options of the files by name of the program; "reference" for the reference.

    Returns:
        The judgement.

    Raises:
        ValueError: If a file is not valid or does not belong to the others. Nothing is written.
    """
    options, sources = options or JudgeOptions(), sources or {}
    references = {file.sequence: file for file in list_trajectory_files(reference)}
    files = {name: list_trajectory_files(pattern) for name, pattern in programs.items()}
    _check_sequences(references, files)
    sequences = []
    for name, file in references.items():
        track = read_reference(file.path, options, sources.get("reference", SourceOptions()))
        runs: list[JudgedRun] = []
        for program, of_program in files.items():
            of_sequence = [f for f in of_program if f.sequence == name]
            source = sources.get(program, SourceOptions())
            runs += read_runs(program, of_sequence, track, source, options.align)
        if runs:
            sequences.append(score_sequence(name, track, runs, options))
            if options.align == "none":
                check_interpolation(track, sequences[-1].epochs.time, _position_rmse(sequences[-1]))
    pairs = plan_pairs(tuple(programs), options.baseline)
    return _decide(tuple(sequences), pairs, options)


def plan_pairs(programs: Sequence[str], baseline: str = "") -> tuple[tuple[str, str], ...]:
    """Return all pairs of programs, or those with the baseline."""
    if not baseline:
        return tuple(combinations(programs, 2))
    if baseline not in programs:
        raise ValueError(
            f"baseline must be a program, got {baseline}. Choose from {', '.join(programs)}."
        )
    return tuple((name, baseline) for name in programs if name != baseline)


def tabulate_runs(sequences: Sequence[SequenceResults]) -> pd.DataFrame:
    """Return one row per program, sequence and run, in the form of `decide_planned_pairs`."""
    rows = []
    for sequence in sequences:
        for program, result in sequence.results.items():
            position = next(d for d in data_by_scope(result, "components"))
            values = compute_metric("rmse", position)["norm"]
            keeps = keeps_track(result.data, result.meta)
            for run, value, keep in zip(sequence.run_names[program], values, keeps, strict=True):
                rows.append((program, sequence.name, sequence.name, "recorded", run, value, keep))
    names = ["filter", "scenario", "family", "regime", "run", "value", "keeps_track"]
    return pd.DataFrame(rows, columns=names)


def _position_rmse(sequence: SequenceResults) -> dict[str, float]:
    """Return the position RMSE by program, m; NaN if all runs are lost."""
    squares = {
        program: (result.data["error"][~result.data["lost"]][..., :3] ** 2).sum(axis=-1)
        for program, result in sequence.results.items()
    }
    return {name: float(np.sqrt(s.mean())) if s.size else math.nan for name, s in squares.items()}


def _decide(
    sequences: tuple[SequenceResults, ...], pairs: Pairs, options: JudgeOptions
) -> Judgement:
    """Make the decisions that the numbers of sequences and runs allow."""
    table = tabulate_runs(sequences)
    _check_copies(table)
    rule = MetricRule(METRIC)
    report = ReportOptions(alpha=options.alpha, equivalence_margin=options.margin)
    study = replace(report.decision_options, shared_runs=False)
    decisions: list[Decision] = []
    rankings: tuple[FilterRanking, ...] = ()
    runs = table.groupby(["filter", "family"]).size().min()
    if pairs and (len(sequences) > 1 or runs >= MIN_RUNS):
        decisions = decide_planned_pairs(table, pairs, rule, study)
        if table["filter"].nunique() > 2 and not options.baseline:
            rankings = order_filters(table, rule, study)
    along = decide_along_runs(sequences, pairs, options)
    return Judgement(sequences, tuple(pairs), tuple(decisions), tuple(along), rankings)


def _check_copies(table: pd.DataFrame) -> None:
    """Raise ValueError if two runs of a program have equal errors."""
    copies = find_copied_runs(table, "value", ["run"])
    if copies:
        copy, original = next(iter(copies.items()))
        raise ValueError(
            f"runs must be independent, got {len(copies)} with the errors of another run (run {copy} is "
            f"equal to run {original}). Remove the files of the copies."
        )


def _check_sequences(
    references: Mapping[str, TrajectoryFile], files: Mapping[str, Sequence[TrajectoryFile]]
) -> None:
    """Check that each file belongs to a reference and that each pair of runs has two names."""
    for program, of_program in files.items():
        for file in of_program:
            if file.sequence not in references:
                raise ValueError(
                    f"{file.path} must have a reference of its sequence {file.sequence}, got "
                    f"{', '.join(references)}. Use {{sequence}} in all patterns, or in none."
                )
        keys = [(file.sequence, file.run) for file in of_program]
        if len(set(keys)) < len(keys):
            double = next(key for key in keys if keys.count(key) > 1)
            raise ValueError(
                f"{program} must have one file per sequence and run, got several for {double}. Use "
                "{run} in the pattern."
            )


# --------------------------------------------------------------------------------------------------
# Decisions along one run, from blocks of time, with the words and the family of a study.

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

    Returns one decision per sequence and pair; programs that are absent from a sequence are left
    out.
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
