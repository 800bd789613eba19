"""All data of the results of a study that its page needs, from one reading of each file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import pandas as pd

from pfbench.report.board.curves import CellKey, make_curves
from pfbench.report.board.method_notes import MethodNotes
from pfbench.report.board.run_table import job_rows, join_rows, name_regimes
from pfbench.report.board.tracks import count_carried_runs, make_tracks
from pfbench.report.options import ReportOptions
from pfbench.results.conditions import Condition
from pfbench.results.frame import drop_before, to_long_rows
from pfbench.results.statistics.run_dependence import assess_runs, drop_runs
from pfbench.results.step_times import StepTimes
from pfbench.results.study_decisions.independent_runs import RUN


class StudyData(NamedTuple):
    """Data of a study.

    Attributes:
        table: One row per filter, condition and run, see `run_table.build_run_table`.
        metrics: All metrics in long rows, see `frame.load_frame`; empty unless requested.
        curves: Quantiles of the error over time by condition.
        tracks: Single runs by condition.
        notes: Notes on the filters.
        times: Times in rounds by label, of each condition; without filters that were not measured.
        warning: Sentence on runs that are not independent; empty if none is shown.
    """

    table: pd.DataFrame
    metrics: pd.DataFrame
    curves: dict[CellKey, dict[str, Any]]
    tracks: dict[CellKey, dict[str, Any]]
    notes: MethodNotes
    times: dict[CellKey, dict[str, StepTimes]]
    warning: str = ""


def read_study(
    conditions: Sequence[Condition], options: ReportOptions, *, has_metrics: bool = False
) -> StudyData:
    """Read the results of a study, one condition at a time.

    Args:
        conditions: Conditions of the study.
        options: Options of the report.
        has_metrics: Whether to collect all metrics.

    Raises:
        ValueError: If a job lacks values of the metric that decides.
    """
    rows, metrics, notes = [], [], MethodNotes()
    data = StudyData(pd.DataFrame(), pd.DataFrame(), {}, {}, notes, {})
    start, converged = options.start_time_s, options.convergence_threshold
    most = count_carried_runs(max(len(c.jobs) for c in conditions), len(conditions))
    for condition, regime in zip(conditions, name_regimes(conditions), strict=True):
        results = {job.label: job.load() for job in condition.jobs}
        parts = [
            job_rows((condition, regime, label), drop_before(result, start), options.metric)
            for label, result in results.items()
        ]  # fmt: skip
        rows += parts
        for job in condition.jobs:
            notes.add(job.label, results[job.label])
            if has_metrics:
                metrics.append(to_long_rows(condition, job, results[job.label], start, converged))
        key = condition.scenario, regime
        times = {job.label: StepTimes.from_metadata(job.meta) for job in condition.jobs}
        data.times[key] = {label: rounds for label, rounds in times.items() if rounds}
        data.curves[key] = make_curves(results, len(conditions))
        errors = pd.concat(parts).pivot_table("rmse", "filter", "run", dropna=False)
        if errors.shape == (len(results), len(parts[0])):  # all filters have the same runs
            values = errors.loc[list(results)].to_numpy()
            data.tracks[key] = make_tracks(
                results, values, [int(run) for run in errors.columns.to_numpy()], most
            )
    long_rows = pd.concat(metrics, ignore_index=True) if metrics else data.metrics
    return _leave_out_copies(
        data._replace(table=join_rows(rows, options.metric), metrics=long_rows)
    )


def _leave_out_copies(data: StudyData) -> StudyData:
    """Leave out copies of runs, and state runs that are not independent."""
    copies, warning = assess_runs(data.table, "rmse", RUN)
    return data._replace(
        table=drop_runs(data.table, copies, RUN),
        metrics=drop_runs(data.metrics, copies, RUN),
        warning=warning,
    )
