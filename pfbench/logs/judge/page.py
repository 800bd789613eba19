"""Page of a judgement: notes, tables, figures, report.md, index.html and decisions.json."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.figure import Figure

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.logs.judge.judge_options import JudgeOptions
from pfbench.logs.judge.judgement import Judgement
from pfbench.logs.judge.pair_sentences import describe_judgement, describe_limits, format_size
from pfbench.logs.judge.pair_verdicts import PairVerdict, cap_of
from pfbench.logs.judge.reference_track import LEAST_SHARE
from pfbench.logs.judge.sequence_results import SequenceResults
from pfbench.report import writers
from pfbench.report.page_kit import Block, with_heading, write_page
from pfbench.results.conditions import component_groups
from pfbench.results.metrics import compute_metric, data_by_scope, metric_definitions, table_columns
from pfbench.results.plotting import INSTANTS, FigureSpec, stacked_axes, use_log_if_wide
from pfbench.results.status import count_statuses
from pfbench.results.store import JobResult
from pfbench.stats.error_measures import Array, finite_mean
from pfbench.stats.sentences import format_count


def write_judgement(
    judgement: Judgement,
    out: str | Path,
    name: str,
    options: JudgeOptions,
    formats: tuple[str, ...] = ("svg", "png"),
) -> Path:
    """Write `<out>/<name>/`. Equal files give equal bytes.

    Returns path of index.html.
    """
    tables = {
        "accuracy": tabulate_accuracy(judgement.sequences),
        "verdicts": tabulate_verdicts(judgement.pairs),
        "files": files_table(judgement.sequences),
    }
    has_sensors = "CRPS [m]" in tables["accuracy"]
    definitions = [
        d for d in metric_definitions() if has_sensors and d.startswith(("CRPS", "coverage"))
    ]
    pairs = [{**pair._asdict(), **pair.verdict.to_row()} for pair in judgement.pairs]
    verdicts = [{name: value for name, value in pair.items() if name != "verdict"} for pair in pairs]  # fmt: skip
    decisions = writers.to_json_types({"options": asdict(options), "verdicts": verdicts})
    with RecordedFolder(Path(out) / name) as folder:
        folder.write("decisions.json", json.dumps(decisions, indent=1, allow_nan=False) + "\n")
        for table, content in tables.items():
            if len(content):
                writers.write_table(folder, table, content)
        caption = "Position error over time in {}: root mean square over valid runs, at the common epochs."
        figures = [
            FigureSpec(f"error_{k}", caption.format(sequence.name), partial(_plot_errors, sequence))
            for k, sequence in enumerate(judgement.sequences[:_MOST_FIGURES])
        ]
        blocks = [
            Block("title", f"Trajectories of programs: {name}"),
            Block("text", describe_material(judgement)),
            Block("heading", "Summary"),
            *(Block("alarm", sentence) for sentence in describe_notes(judgement, options)),
            Block("list", list(describe_judgement(judgement))),
            *with_heading(
                Block("heading", "Errors over time"), Block("figures", writers.write_figures(figures, "judge", folder, formats))
            ),
            Block("heading", "Accuracy"),
            Block("table", tables["accuracy"]),
            *with_heading(Block("heading", "Verdicts"), Block("table", tables["verdicts"])),
            Block("heading", "Reach of the verdicts"),
            Block("list", list(describe_limits(judgement))),
            Block("heading", "Files"),
            Block("table", tables["files"]),
            *with_heading(Block("heading", "Definitions"), Block("list", definitions)),
        ]  # fmt: skip
        return write_page(folder, f"Trajectories of programs: {name}", blocks)


def describe_material(judgement: Judgement) -> str:
    """Describe programs, sequences, runs and scored time."""
    programs = list(dict.fromkeys(run.program for s in judgement.sequences for run in s.runs))
    runs = sum(len(s.runs) for s in judgement.sequences)
    seconds = sum(float(s.epochs.time[-1] - s.epochs.time[0]) for s in judgement.sequences)
    epochs = sum(len(s.epochs.time) for s in judgement.sequences)
    return (
        f"Programs: {', '.join(programs)}. Sequences: {len(judgement.sequences)}. Trajectories: {runs}. "
        f"Scored: {epochs} common epochs in {seconds:.6g} s."
    )


# --------------------------------------------------------------------------------------------------
# Notes above the decisions: what was removed, lost, missing or doubtful.

_ALIGNED = {
    "offset": "The mean position error of each run is removed (align=offset): errors are relative.",
    "yaw": "A shift and a turn about the vertical are removed from each run (align=yaw): errors are relative.",
}
_CLOCK_SHOWN = 0.05  # s
_INTERPOLATION_SHOWN = 0.2  # share of the smallest RMSE


def describe_notes(judgement: Judgement, options: JudgeOptions) -> Iterator[str]:
    """Yield notes on alignment, files, lost and missing runs, clocks, epochs, the reference and offsets."""
    if options.align in _ALIGNED:
        yield _ALIGNED[options.align]
    programs = list(dict.fromkeys(run.program for s in judgement.sequences for run in s.runs))
    yield from _describe_files(judgement.sequences)
    for sequence in judgement.sequences:
        yield from _describe_missing(sequence, programs)
        yield from _describe_epochs(sequence)
        yield from _describe_reference(sequence)
        yield from _describe_runs(sequence, options)


def _describe_files(sequences: Sequence[SequenceResults]) -> Iterator[str]:
    """Yield the notes of the readers, once for all files of a program with the same note."""
    counts: Counter[tuple[str, str]] = Counter()
    for sequence in sequences:
        counts.update(("reference", note) for note in sequence.reference.table.notes)
        for run in sequence.runs:
            counts.update((run.program, note) for note in run.table.notes)
    for (program, note), count in counts.items():
        files = f" ({count} files)" if count > 1 else ""
        yield f"File of {program}: {note.replace('NAME.', f'{program}.')}{files}."


def _describe_runs(sequence: SequenceResults, options: JudgeOptions) -> Iterator[str]:
    """Yield a note on each run that is lost, has holes, or has another clock."""
    for run, used, holes, _, coverage in sequence.list_runs():
        label = f"{run.program} {run.run}".strip() + f" in {sequence.name}"
        if used is None:
            yield (
                f"Lost: {label} covers {100 * coverage:.3g} % of the time, {100 * options.coverage:g} % are required. "
                f"Among runs or sequences it counts as an error of {cap_of(sequence, options):.4g} m."
            )
        if holes is not None and holes.any():
            yield (
                f"Holes: {label} lacks {int(holes.sum())} of {len(holes)} epochs that another program "
                "has. The error there is the largest one of any program. Set from or to, to leave out "
                "a time for all programs."
            )
        if np.isfinite(run.clock_offset) and abs(run.clock_offset) > _CLOCK_SHOWN:
            yield (
                f"Clock: {label} agrees best with the reference at an offset of "
                f"{run.clock_offset:.3f} s. It is not removed."
            )


def _describe_missing(sequence: SequenceResults, programs: list[str]) -> Iterator[str]:
    """Yield a note on each program that lacks runs of others."""
    names = sequence.run_names
    every = list(dict.fromkeys(run for runs in names.values() for run in runs))
    for program in programs:
        missing = [run for run in every if run not in names.get(program, ())]
        if missing:
            runs = ", ".join(run for run in missing[:5] if run) or "its file"
            more = ", ..." if len(missing) > 5 else ""
            yield (
                f"Missing: {program} in {sequence.name} lacks {runs}{more}, which another program has. "
                "Missing runs are not compared. If the program failed there, this favours it."
            )


def _describe_epochs(sequence: SequenceResults) -> Iterator[str]:
    """Yield a note if many epochs are not common, if steps differ, or if the reference has holes."""
    epochs = sequence.epochs
    if epochs.share < LEAST_SHARE:
        yield (
            f"Epochs: {100 * epochs.share:.3g} % of the epochs in {sequence.name} are common. "
            f"tolerance={epochs.tolerance_needed:g} makes nearly all of them common; each program is "
            "scored at its own time."
        )
    if epochs.is_weighted:
        yield f"Steps: the steps of the epochs in {sequence.name} differ. Each epoch counts by its time."
    clock, first, last = sequence.reference.table.time, epochs.time[0], epochs.time[-1]
    seconds = np.diff(np.clip(clock, first, last))[np.diff(clock) > sequence.reference.largest_gap]
    if (seconds > 0).any():
        holes = format_count(int((seconds > 0).sum()), "hole")
        yield f"Reference: {seconds.sum():.4g} s in {holes} of {sequence.name} are left out."


def _describe_reference(sequence: SequenceResults) -> Iterator[str]:
    """Yield a note if the interpolation of the reference is a part of the smallest error."""
    between = sequence.reference.interpolation_error(sequence.epochs.time)
    size = float(np.sqrt(np.mean(between**2)))
    errors = (result.data["error"][~result.data["lost"]][..., :3].reshape(-1, 3) for result in sequence.results.values())  # fmt: skip
    sizes = [float(np.sqrt((e**2).sum(axis=1).mean())) for e in errors if len(e)]
    if sizes and size > max(_INTERPOLATION_SHOWN * min(sizes), _CLOCK_SHOWN):
        yield (
            f"Reference: interpolation of {sequence.name} has an error of about {size:.3g} m, and the "
            f"smallest position RMSE is {min(sizes):.3g} m. Use a reference with shorter steps."
        )


_QUANTILE, _MOST_FIGURES = 0.95, 8


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


def tabulate_verdicts(pairs: Sequence[PairVerdict]) -> pd.DataFrame:
    """Return one row per pair of programs."""
    return pd.DataFrame(
        {
            "first": v.a,
            "second": v.b,
            "verdict on first": v.word,
            "position error of first": format_size(v.ratio, v.low, v.high) if v.n else "-",
            "adjusted p": v.p,
            "sample": "sequence" if pair.unit == "world" else pair.unit,
            "number": v.n,
            "independent": pair.effective,
            "block [s]": pair.block_s,
            "reason": v.reason or "-",
        }
        for pair in pairs
        for v in (pair.verdict,)
    )


def files_table(sequences: Sequence[SequenceResults]) -> pd.DataFrame:
    """Return one row per trajectory: file, rows, share used, clock and notes."""
    return pd.DataFrame(
        {
            "sequence": sequence.name,
            "program": run.program,
            "run": run.run or "-",
            "file": run.table.file,
            "rows": len(run.table.time),
            "scored": 0 if used is None else len(used),
            "in holes": 0 if holes is None else int(holes.sum()),
            "not common": unused,
            "time covered [%]": 100 * coverage,
            "clock offset [s]": run.clock_offset,
            "notes": "; ".join(run.table.notes) or "-",
        }
        for sequence in sequences
        for run, used, holes, unused, coverage in sequence.list_runs()
    )


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
