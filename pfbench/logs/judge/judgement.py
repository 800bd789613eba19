"""Judgement of programs: errors of all sequences, and verdicts on all pairs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pandas as pd

from pfbench.core.parameter_checks import require
from pfbench.logs.judge.checks import check_interpolation
from pfbench.logs.judge.formats import TrajectoryFile, list_trajectory_files
from pfbench.logs.judge.judge_options import JudgeOptions, SourceOptions
from pfbench.logs.judge.pair_verdicts import PairVerdict, judge_pairs
from pfbench.logs.judge.reference_track import read_reference
from pfbench.logs.judge.sequence_results import (
    JudgedRun,
    SequenceResults,
    read_runs,
    score_sequence,
)
from pfbench.results.metrics import compute_metric, data_by_scope
from pfbench.stats.run_dependence import find_copied_runs


class Judgement(NamedTuple):
    """Everything that a report on programs shows.

    Attributes:
        sequences: Results of all sequences.
        pairs: Verdicts on all pairs, one family of tests.
    """

    sequences: tuple[SequenceResults, ...]
    pairs: tuple[PairVerdict, ...]


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
    _check_copies(tabulate_runs(sequences))
    return Judgement(tuple(sequences), tuple(judge_pairs(sequences, pairs, options)))


def plan_pairs(programs: Sequence[str], baseline: str = "") -> tuple[tuple[str, str], ...]:
    """Return all pairs of programs, or those with the baseline."""
    if not baseline:
        return tuple(combinations(programs, 2))
    require(
        baseline in programs,
        "baseline",
        "be a program",
        baseline,
        f"Choose from {', '.join(programs)}.",
    )
    return tuple((name, baseline) for name in programs if name != baseline)


def tabulate_runs(sequences: Sequence[SequenceResults]) -> pd.DataFrame:
    """Return the position RMSE of each program, sequence and run."""
    rows = []
    for sequence in sequences:
        for program, result in sequence.results.items():
            position = next(d for d in data_by_scope(result, "components"))
            values = compute_metric("rmse", position)["norm"]
            for run, value in zip(sequence.run_names[program], values, strict=True):
                rows.append((program, sequence.name, "recorded", run, value))
    return pd.DataFrame(rows, columns=["filter", "scenario", "regime", "run", "value"])


def _position_rmse(sequence: SequenceResults) -> dict[str, float]:
    """Return the position RMSE by program, m; NaN if all runs are lost."""
    squares = {
        program: (result.data["error"][~result.data["lost"]][..., :3] ** 2).sum(axis=-1)
        for program, result in sequence.results.items()
    }
    return {name: float(np.sqrt(s.mean())) if s.size else np.nan for name, s in squares.items()}


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
            require(
                file.sequence in references,
                file.path,
                f"have a reference of its sequence {file.sequence}",
                ", ".join(references),
                "Use {sequence} in all patterns, or in none.",
            )
        keys = [(file.sequence, file.run) for file in of_program]
        double = next((key for key in keys if keys.count(key) > 1), None)
        require(
            not double,
            program,
            "have one file per sequence and run",
            f"several for {double}",
            "Use {run} in the pattern.",
        )
