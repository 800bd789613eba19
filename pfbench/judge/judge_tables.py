"""Tables and figures of a judgement."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pfbench.judge.block_decisions import BlockDecision
from pfbench.judge.sequence_results import SequenceResults
from pfbench.report.plots.axis_ticks import use_log_if_wide
from pfbench.report.plots.figure_files import FigureSpec
from pfbench.report.plots.plotting import INSTANTS, stacked_axes
from pfbench.results.decisions.sentence_formats import format_effect
from pfbench.results.decisions.words import NOT_TESTED
from pfbench.results.error_measures import Array, finite_mean
from pfbench.results.metrics import compute_metric, data_by_scope, table_columns
from pfbench.results.state_groups import component_groups
from pfbench.results.status import count_statuses
from pfbench.results.store import JobResult

_QUANTILE = 0.95


def tabulate_accuracy(sequences: Sequence[SequenceResults]) -> pd.DataFrame:
    """Return one row per sequence and program with its metrics, averaged over valid runs."""
    rows = [
        {"sequence": sequence.name, "program": program, **_accuracy(result)}
        for sequence in sequences
        for program, result in sequence.results.items()
    ]
    return pd.DataFrame(rows).dropna(axis="columns", how="all")


def _accuracy(result: JobResult) -> dict[str, float]:
    """Compute the columns of one program in one sequence."""
    status, lost = count_statuses(result.data, result.meta), result.data["lost"]
    row: dict[str, float] = {"runs": status.runs, "lost": status.lost}
    if status.diverged is not None:
        row["diverged"] = status.diverged
    for data in data_by_scope(result, "components"):
        group, values = data.group, compute_metric("rmse", data)
        if group is None:
            continue
        for name, value in values.items():
            head = f"{name.replace('_', ' ')} RMSE" if name != "norm" else f"{group.group} RMSE"
            row[f"{head} [{group.unit}]"] = _mean(value, lost)
        if group.group == "position":
            largest = compute_metric("max_error", data)["norm"]
            row |= _position_columns(data.select("error"), lost)
            row["position maximum [m]"] = _mean(largest, lost)
            row |= table_columns(result, group)
    for data in data_by_scope(result, "group"):
        nees = _mean(compute_metric("nees", data)["norm"], lost)
        count = len(result.meta["state"]["groups"][data.state_group])
        row[f"{data.state_group} NEES (expected {count})"] = nees
    return row


def _position_columns(error: Array, lost: np.ndarray) -> dict[str, float]:
    horizontal = np.sqrt(finite_mean((error[..., :2] ** 2).sum(-1), axis=1))
    norm = np.linalg.norm(error, axis=-1)
    quantile = np.full(len(norm), np.nan)
    quantile[~lost] = np.quantile(norm[~lost], _QUANTILE, axis=1)
    return {
        "horizontal RMSE [m]": _mean(horizontal, lost),
        "position 95 % quantile [m]": _mean(quantile, lost),
    }


def _mean(values: Array, lost: np.ndarray) -> float:
    return float(finite_mean(np.asarray(values, dtype=np.float64)[~lost], axis=0))


def blocks_table(results: Sequence[BlockDecision]) -> pd.DataFrame:
    """Return one row per decision along the runs of a sequence."""
    rows = []
    for result in results:
        d = result.decision
        effect = format_effect(d, d.estimate, d.low, d.high)
        if d.word == NOT_TESTED:
            effect = effect.partition(" (")[0]
        rows.append(
            {
                "sequence": result.sequence,
                "first": d.a,
                "second": d.b,
                "decision on first": d.word,
                "position RMSE of first": effect,
                "adjusted p": d.p_corrected,
                "length [s]": result.seconds,
                "block [s]": result.block_s,
                "blocks": result.blocks,
            }
        )
    return pd.DataFrame(rows)


def files_table(sequences: Sequence[SequenceResults]) -> pd.DataFrame:
    """Return one row per trajectory: file, rows, share used, clock and notes."""
    rows = []
    for sequence in sequences:
        epochs = sequence.epochs
        for k, run in enumerate(sequence.runs):
            used, holes, table = epochs.rows[k], epochs.holes[k], run.table
            rows.append(
                {
                    "sequence": sequence.name,
                    "program": run.program,
                    "run": run.run or "-",
                    "file": table.file,
                    "rows": len(table.time),
                    "scored": 0 if used is None else len(used),
                    "in holes": 0 if holes is None else int(holes.sum()),
                    "not common": epochs.unused[k],
                    "time covered [%]": 100 * epochs.coverage[k],
                    "clock offset [s]": run.clock_offset,
                    "notes": "; ".join(table.notes) or "-",
                }
            )
    return pd.DataFrame(rows)


def error_figures(sequences: Sequence[SequenceResults], largest: int = 8) -> list[FigureSpec]:
    """Return one figure of position errors over time per sequence.

    Args:
        sequences: Results of all sequences.
        largest: Number of sequences with a figure.
    """
    return [
        FigureSpec(
            f"error_{k}",
            f"Position error over time in {sequence.name}: root mean square over valid runs, "
            "at the common epochs.",
            partial(_plot_errors, sequence),
        )
        for k, sequence in enumerate(sequences[:largest])
    ]


def _plot_errors(sequence: SequenceResults) -> Figure:
    figure, (axis,) = stacked_axes(1, 2.2)
    time = sequence.epochs.time
    edges = np.unique(np.linspace(0, len(time), INSTANTS + 1).astype(int))
    for program, result in sequence.results.items():
        valid = ~result.data["lost"]
        if not valid.any():
            continue
        places = component_groups(result.meta["state"])[0].places
        square = (result.data["error"][valid][..., places] ** 2).sum(axis=-1).mean(axis=0)
        mean = np.add.reduceat(square, edges[:-1]) / np.diff(edges)
        axis.plot(time[edges[:-1]], np.sqrt(mean), label=program)
    curves = [np.asarray(line.get_ydata(), dtype=np.float64) for line in axis.get_lines()]
    axis.set(xlabel="time [s]", ylabel="position error [m]")
    use_log_if_wide(axis, axis.yaxis, curves)
    axis.legend()
    return figure
