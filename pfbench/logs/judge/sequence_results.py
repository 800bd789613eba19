"""Errors of all programs in one sequence, in the form of results of a study."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import ndtr

from pfbench.logs.judge.alignment import (
    CommonEpochs,
    column_errors,
    common_columns,
    fill_holes,
    find_common_epochs,
    position_errors,
)
from pfbench.logs.judge.checks import check_run
from pfbench.logs.judge.formats import TrajectoryFile, read_trajectories
from pfbench.logs.judge.judge_options import JudgeOptions, SourceOptions, name_program
from pfbench.logs.judge.reference_track import ReferenceTrack
from pfbench.logs.judge.trajectory_table import (
    ATTITUDE_SD,
    COVARIANCE_COLUMNS,
    LOCAL,
    POSITION_SD,
    VELOCITY_COLUMNS,
    VELOCITY_SD,
    TrajectoryTable,
    covariance_matrices,
)
from pfbench.results.store import JobResult
from pfbench.stats.error_measures import Array

_DEG = 180 / np.pi
_SD = {"position": POSITION_SD, "velocity": VELOCITY_SD, "attitude": ATTITUDE_SD}
_UNITS = {"position": ("m", 1.0), "velocity": ("m/s", 1.0), "attitude": ("deg", _DEG)}

_NAMES = {
    **dict(zip(LOCAL, ("north", "east", "down"), strict=True)),
    **dict(
        zip(VELOCITY_COLUMNS, ("velocity north", "velocity east", "velocity down"), strict=True)
    ),
}


class JudgedRun(NamedTuple):
    """Trajectory of one run of a program.

    Attributes:
        program: Name of the program.
        run: Name of the run.
        path: File.
        table: Trajectory.
        clock_offset: Time that would have to be added to its clock, s; NaN if not shown.
    """

    program: str
    run: str
    path: Path
    table: TrajectoryTable
    clock_offset: float


class SequenceResults(NamedTuple):
    """Results of all programs in one sequence.

    Attributes:
        name: Name of the sequence.
        reference: Reference.
        runs: Trajectories of all programs.
        epochs: Common epochs; its fields have the order of `runs`.
        results: Errors by program: `time` [T], `error` and `sd` [R, T, D], `nees` [R, T, G], `lost`
            [R], and `crps`, `pit` [R, T, D] where standard deviations exist.
        run_names: Names of the runs by program, [R].
    """

    name: str
    reference: ReferenceTrack
    runs: tuple[JudgedRun, ...]
    epochs: CommonEpochs
    results: dict[str, JobResult]
    run_names: dict[str, tuple[str, ...]]

    def list_runs(
        self,
    ) -> Iterator[tuple[JudgedRun, np.ndarray | None, np.ndarray | None, int, float]]:
        """Return each run with its rows and holes at the common epochs, its unused rows and its coverage."""
        epochs = self.epochs
        return zip(
            self.runs, epochs.rows, epochs.holes, epochs.unused, epochs.coverage, strict=True
        )


def read_runs(
    program: str,
    files: Sequence[TrajectoryFile],
    reference: ReferenceTrack,
    source: SourceOptions,
    align: str = "none",
) -> list[JudgedRun]:
    """Read all runs of a program in one sequence and check them against the reference."""
    runs = []
    for file in files:
        sd = source.sd.format(sequence=file.sequence, run=file.run)
        with name_program(program):
            tables = read_trajectories(file.path, replace(source, sd=sd))
            checked = [
                check_run(reference.place(t), reference, align, source.shift) for t in tables
            ]
        for table, offset in checked:
            number = f"{table.run:09d}" if len(tables) > 1 else ""
            runs.append(JudgedRun(program, f"{file.run}{number}", file.path, table, offset))
    return runs


def score_sequence(
    name: str, reference: ReferenceTrack, runs: Sequence[JudgedRun], options: JudgeOptions
) -> SequenceResults:
    """Compute the errors of all runs at the common epochs."""
    epochs = find_common_epochs([run.table for run in runs], reference, options)
    results, names, holes = {}, {}, {}
    nothing = np.zeros(len(epochs.time), dtype=bool)
    for program in dict.fromkeys(run.program for run in runs):
        rows = [k for k, run in enumerate(runs) if run.program == program]
        tables = [runs[k].table for k in rows]
        groups = common_columns(tables, reference) if options.align == "none" else {}
        columns = {"position": LOCAL, **groups}
        parts = [
            _score_run(runs[k].table, reference, epochs.rows[k], columns, options) for k in rows
        ]
        results[program] = _to_result(program, epochs.time, columns, parts, options)
        names[program] = tuple(runs[k].run for k in rows)
        masks = [epochs.holes[k] for k in rows]
        holes[program] = np.stack([nothing if mask is None else mask for mask in masks])
    fill_holes(results, holes)
    return SequenceResults(name, reference, tuple(runs), epochs, results, names)


class _RunScores(NamedTuple):
    error: Array  # [T, D]
    sd: Array
    nees: Array  # [T, G]


def _score_run(
    table: TrajectoryTable,
    reference: ReferenceTrack,
    rows: np.ndarray | None,
    columns: Mapping[str, tuple[str, ...]],
    options: JudgeOptions,
) -> _RunScores | None:
    """Return the errors of a run, or None if it is lost."""
    if rows is None:
        return None
    parts = []
    for group, names in columns.items():
        factor = _UNITS[group][1]
        if group == "position":
            error = position_errors(table, reference, rows, options.align)
        else:
            error = factor * column_errors(table, reference, rows, names)
        sd, sd_names = np.full(error.shape, np.nan), _SD[group][: len(names)]
        if table.has(sd_names):
            sd = factor * table.select(sd_names)[rows]
        normalised = ((error / sd) ** 2).sum(axis=-1)
        if group == "position" and table.has(COVARIANCE_COLUMNS):
            matrices = covariance_matrices(table.select(COVARIANCE_COLUMNS)[rows])
            sd = np.sqrt(np.diagonal(matrices, axis1=-2, axis2=-1))
            solved = np.linalg.solve(matrices, error[..., None])[..., 0]
            normalised = (error * solved).sum(axis=-1)
        parts.append((error, sd, normalised[:, None]))
    return _RunScores(
        *(np.concatenate(columns_of_group, -1) for columns_of_group in zip(*parts, strict=True))
    )


def _to_result(
    program: str,
    time: Array,
    columns: Mapping[str, tuple[str, ...]],
    parts: Sequence[_RunScores | None],
    options: JudgeOptions,
) -> JobResult:
    """Stack the runs of a program; lost runs are NaN."""
    names = [_NAMES.get(name, name) for of_group in columns.values() for name in of_group]
    units = [_UNITS[group][0] for group, of_group in columns.items() for _ in of_group]
    ends = np.cumsum([len(of_group) for of_group in columns.values()])
    places = {
        group: tuple(range(end - len(of_group), end))
        for (group, of_group), end in zip(columns.items(), ends.tolist(), strict=True)
    }
    shapes = ((len(time), len(names)), (len(time), len(names)), (len(time), len(columns)))
    empty = _RunScores(*(np.full(shape, np.nan) for shape in shapes))
    stacked = _RunScores(*(np.stack(v) for v in zip(*(p or empty for p in parts), strict=True)))
    lost = np.array([scores is None for scores in parts])
    threshold = {"paper": {"divergence_threshold": options.limit}} if options.limit else {}
    meta: dict[str, Any] = {
        "key": program,
        "label": program,
        "config": {"scenario": threshold},
        "state": {"names": names, "units": units, "groups": places},
    }
    data = {"time": time, "error": stacked.error, "sd": stacked.sd, "nees": stacked.nees}
    return JobResult(meta, {**data, "lost": lost, **_normal_scores(stacked)})


def _normal_scores(scores: _RunScores) -> dict[str, Array]:
    """Return CRPS and PIT of normal distributions [R, T, D]; empty without standard deviations."""
    if not np.isfinite(scores.sd).any():
        return {}
    z = scores.error / scores.sd
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    crps = scores.sd * (z * (2 * ndtr(z) - 1) + 2 * density - 1 / np.sqrt(np.pi))
    return {"score_steps": np.arange(z.shape[1]), "crps": crps, "pit": ndtr(-z)}
