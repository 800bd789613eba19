"""Judgement of programs: metrics of each, decisions on each pair, with the statistics of a study."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.judge.block_decisions import METRIC, BlockDecision, decide_along_runs
from pfbench.judge.judge_options import JudgeOptions, SourceOptions
from pfbench.judge.readers.trajectory_files import TrajectoryFile, list_trajectory_files
from pfbench.judge.reference_checks import check_interpolation
from pfbench.judge.reference_track import read_reference
from pfbench.judge.sequence_results import JudgedRun, SequenceResults, read_runs, score_sequence
from pfbench.report.options import ReportOptions
from pfbench.results.decisions.decision import Decision
from pfbench.results.decisions.filter_sets import FilterRanking, order_filters
from pfbench.results.decisions.options import MetricRule
from pfbench.results.decisions.planned_pairs import Pairs, decide_planned_pairs
from pfbench.results.metrics import compute_metric, data_by_scope
from pfbench.results.statistics.paired_effects import MIN_RUNS
from pfbench.results.statistics.run_dependence import find_copied_runs
from pfbench.results.status import keeps_track


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
    """Return all pairs of programs, or those with the baseline.

    Args:
        programs: Names.
        baseline: Name of the baseline; empty for all pairs.

    Raises:
        ValueError: If the baseline is not a program.
    """
    if not baseline:
        return tuple(combinations(programs, 2))
    if baseline not in programs:
        raise ValueError(
            f"baseline must be a program, got {baseline}. Choose from {', '.join(programs)}."
        )
    return tuple((name, baseline) for name in programs if name != baseline)


def tabulate_runs(sequences: Sequence[SequenceResults]) -> pd.DataFrame:
    """Return one row per program, sequence and run, in the form of `decide_planned_pairs`.

    Args:
        sequences: Results of all sequences.

    Returns:
        Columns filter, scenario, family, regime, run, value (position RMSE, m) and keeps_track.
    """
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
