"""Notes above the decisions: what was removed, lost, missing or doubtful."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np

from pfbench.judge.epoch_checks import LEAST_SHARE
from pfbench.judge.judge_options import JudgeOptions
from pfbench.judge.judgement import Judgement
from pfbench.judge.sequence_results import SequenceResults
from pfbench.results.decisions.sentence_formats import format_count
from pfbench.results.error_measures import Array

_ALIGNED = {
    "offset": "The mean position error of each run is removed (align=offset): errors are relative.",
    "yaw": "A shift and a turn about the vertical are removed from each run (align=yaw): errors are relative.",
}
_CLOCK_SHOWN = 0.05  # s
_OFFSET_SHOWN = 5.0  # m
_TREND_SHOWN = 0.5  # share of the squared error
_INTERPOLATION_SHOWN = 0.2  # share of the smallest RMSE
_AXES = ("North", "East", "Down")


def describe_notes(judgement: Judgement, options: JudgeOptions) -> Iterator[str]:
    """Yield notes on alignment, files, lost and missing runs, clocks, epochs, the reference and offsets.

    Args:
        judgement: Judgement.
        options: Options of the comparison.
    """
    if options.align in _ALIGNED:
        yield _ALIGNED[options.align]
    programs = list(dict.fromkeys(run.program for s in judgement.sequences for run in s.runs))
    yield from _describe_files(judgement.sequences)
    for sequence in judgement.sequences:
        yield from _describe_missing(sequence, programs)
        yield from _describe_epochs(sequence)
        yield from _describe_reference(sequence)
        yield from _describe_offsets(sequence)
        yield from _describe_trends(sequence)
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
    for k, run in enumerate(sequence.runs):
        label = f"{run.program} {run.run}".strip() + f" in {sequence.name}"
        if sequence.epochs.rows[k] is None:
            share = 100 * sequence.epochs.coverage[k]
            yield f"Lost: {label} covers {share:.3g} % of the time, {100 * options.coverage:g} % are required."
        holes = sequence.epochs.holes[k]
        if holes is not None and holes.any():
            yield (
                f"Holes: {label} lacks {int(holes.sum())} of {len(holes)} epochs that another program "
                "has. The error there is the largest one of any program. Set from or to, to leave out "
                "a time for all programs."
            )
        if math.isfinite(run.clock_offset) and abs(run.clock_offset) > _CLOCK_SHOWN:
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
    errors = {name: _valid_errors(sequence, name).reshape(-1, 3) for name in sequence.results}
    sizes = [float(np.sqrt((e**2).sum(axis=1).mean())) for e in errors.values() if len(e)]
    if sizes and size > max(_INTERPOLATION_SHOWN * min(sizes), _CLOCK_SHOWN):
        yield (
            f"Reference: interpolation of {sequence.name} has an error of about {size:.3g} m, and the "
            f"smallest position RMSE is {min(sizes):.3g} m. Use a reference with shorter steps."
        )


def _valid_errors(sequence: SequenceResults, program: str) -> Array:
    """Return the position errors of the runs that are not lost, [R, T, 3], m."""
    data = sequence.results[program].data
    return np.asarray(data["error"][~data["lost"]][..., :3])


def _describe_offsets(sequence: SequenceResults) -> Iterator[str]:
    """Yield a note on each constant position error, as of heights above the geoid."""
    for program in sequence.results:
        error = _valid_errors(sequence, program).reshape(-1, 3)
        if not len(error):
            continue
        median = np.median(error, axis=0)
        spread = np.median(np.abs(error - median), axis=0)
        for axis in np.flatnonzero(np.abs(median) > np.maximum(_OFFSET_SHOWN, 3 * spread)):
            hint = "heights (ellipsoid or geoid)" if axis == 2 else "datum"
            yield (
                f"Offset: {program} in {sequence.name} has a median error of {median[axis]:.4g} m "
                f"{_AXES[axis]}. It is not removed. Check {hint} and origin."
            )


def _describe_trends(sequence: SequenceResults) -> Iterator[str]:
    """Yield a note on each program whose errors are mostly a constant and a drift of the run."""
    time = sequence.epochs.time - sequence.epochs.time.mean()
    basis = np.linalg.qr(np.stack([np.ones_like(time), time], axis=-1))[0]
    for program in sequence.results:
        error = _valid_errors(sequence, program)
        total = float((error**2).sum())
        share = float((np.einsum("tb,rtc->rbc", basis, error) ** 2).sum()) / total if total else 0.0
        if share > _TREND_SHOWN:
            yield (
                f"Trend: {100 * share:.3g} % of the squared position error of {program} in {sequence.name} "
                "is a constant and a drift of the run. Blocks of time cannot show how these differ "
                "between runs, so another run can decide otherwise. Judge several runs."
            )
