"""Epochs that all programs share, and their errors at these epochs."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from pfbench.logs.doctor.turn_search import select_nodes
from pfbench.logs.judge.judge_options import JudgeOptions
from pfbench.logs.judge.reference_track import (
    ReferenceTrack,
    check_coverage,
    check_scored_time,
    check_shared,
    space_evenly,
)
from pfbench.logs.judge.trajectory_table import (
    ATTITUDE_COLUMNS,
    VELOCITY_COLUMNS,
    TrajectoryTable,
    wrap_to_half_turn,
)
from pfbench.results.store import JobResult
from pfbench.stats.error_measures import Array

_CELL = 1.0  # s, coverage is a share of cells of this length


class CommonEpochs(NamedTuple):
    """Rows of each trajectory at the common epochs.

    Attributes:
        time: Epochs of the trajectory with the longest steps, [T], s; instants if its steps differ.
        rows: Rows of each valid trajectory, [T] each; None for a lost one. At a hole, the nearest row.
        holes: Epochs that a valid trajectory leaves out although another one has them, [T] each.
        coverage: Share of the time that each trajectory covers.
        unused: Rows of each trajectory within the scored time that are not common.
        share: Share of the epochs outside of holes that are common.
        tolerance_needed: Tolerance that makes nearly all of them common, s.
        is_weighted: Whether epochs are repeated or left out by their time, since steps differ.
    """

    time: Array
    rows: tuple[np.ndarray | None, ...]
    holes: tuple[np.ndarray | None, ...]
    coverage: tuple[float, ...]
    unused: tuple[int, ...]
    share: float
    tolerance_needed: float
    is_weighted: bool


def find_common_epochs(
    tables: Sequence[TrajectoryTable], reference: ReferenceTrack, options: JudgeOptions
) -> CommonEpochs:
    """Find the epochs at which all valid trajectories have a row or a hole.

    The trajectories are never interpolated. A trajectory that covers less than `coverage` of the
    time that any of them covers is lost, and does not limit the epochs of the others. A hole is longer
    than 1.5 steps. It keeps its epochs, so that a program gains nothing by leaving out bad ones.
    """
    check_scored_time(reference, options)
    masks = [_scored(table.time, reference, options) for table in tables]
    coverage = _shares_covered([t.time[m] for t, m in zip(tables, masks, strict=True)])
    valid = [k for k, share in enumerate(coverage) if share >= options.coverage]
    times = {k: tables[k].time[masks[k]] for k in valid}
    check_coverage([table.file for table in tables], coverage, options.coverage)
    grid, instants, is_weighted = _weigh(_slowest(list(times.values())))
    nearest = {k: _nearest(times[k], grid) for k in valid}
    has_row = {k: _has_row(times[k], grid, options.tolerance) for k in valid}
    in_hole = {  # a row that rounding puts outside the scored time is not a hole
        k: is_in_hole(times[k], grid) & ~_has_row(tables[k].time, grid, options.tolerance)
        for k in valid
    }
    everywhere = np.ones(len(grid), dtype=bool)
    shared = np.logical_and.reduce([everywhere, *has_row.values()])
    is_hole = np.logical_or.reduce([~everywhere, *in_hole.values()])
    common = np.logical_and.reduce([everywhere, *(has_row[k] | in_hole[k] for k in valid)])
    share = float(shared.sum() / max((~is_hole).sum(), 1))
    needed = _tolerance_needed([times[k] for k in valid], grid[~is_hole])
    common = _thin(instants, common, options.every)
    sizes = ", ".join(f"{len(times[k])} ({tables[k].file})" for k in valid) or "none"
    remedy = "a smaller every" if options.every and share > 0.5 else f"tolerance={needed:g}"
    counts = int((common & shared).sum()), int((common & is_hole).sum())
    check_shared(counts, share, (reference.file, sizes, remedy), options.tolerance)
    rows = tuple(
        np.flatnonzero(masks[k])[nearest[k][common]] if k in times else None
        for k in range(len(tables))
    )
    holes = tuple(~has_row[k][common] if k in times else None for k in range(len(tables)))
    unused = _count_unused(masks, rows, holes)
    return CommonEpochs(instants[common], rows, holes, coverage, unused, share, needed, is_weighted)


def _thin(grid: Array, common: np.ndarray, every: float) -> np.ndarray:
    """Return a mask of common epochs that are at least `every` seconds after the last one."""
    rows = np.flatnonzero(common)
    keep = rows[select_nodes(grid[rows], every)] if every > 0 and len(rows) else rows
    return np.isin(np.arange(len(grid)), keep)


def _weigh(grid: Array) -> tuple[Array, Array, bool]:
    """Return the epoch of each instant, the instants, and whether they differ from the epochs."""
    epochs, instants = space_evenly(grid)
    return grid[epochs], instants, not np.array_equal(epochs, np.arange(len(grid)))


def _count_unused(
    masks: Sequence[np.ndarray],
    rows: Sequence[np.ndarray | None],
    holes: Sequence[np.ndarray | None],
) -> tuple[int, ...]:
    """Count the rows of each trajectory in the scored time that are at no common epoch."""
    used = [
        0 if hole is None or row is None else len(np.unique(row[~hole]))
        for row, hole in zip(rows, holes, strict=True)
    ]
    return tuple(int(mask.sum()) - n for mask, n in zip(masks, used, strict=True))


def _tolerance_needed(times: Sequence[Array], grid: Array) -> float:
    """Return the tolerance that makes 99 % of a grid common, rounded up to 1 ms."""
    if not len(grid) or not times:
        return 0.0
    distances = np.max([np.abs(time[_nearest(time, grid)] - grid) for time in times], axis=0)
    return math.ceil(1000 * float(np.quantile(distances, 0.99)) + 1e-6) / 1000


def _slowest(times: Sequence[Array]) -> Array:
    """Return the epochs of the longest steps; of several such trajectories, of the longest one."""
    steps = [float(np.median(np.diff(time))) if len(time) > 1 else 0.0 for time in times]
    longest = max(steps, default=0.0)
    candidates = [t for t, step in zip(times, steps, strict=True) if step >= 0.9 * longest]
    return max(candidates, key=len, default=np.zeros(0))


def _has_row(time: Array, grid: Array, tolerance: float) -> np.ndarray:
    """Return the epochs of a grid at which a trajectory has a row."""
    return np.asarray(np.abs(time[_nearest(time, grid)] - grid) <= tolerance)


def _scored(time: Array, reference: ReferenceTrack, options: JudgeOptions) -> np.ndarray:
    inside = (time >= options.start) & (time <= options.end)
    return np.asarray(inside & reference.is_bridged(time))


def _shares_covered(times: Sequence[Array]) -> tuple[float, ...]:
    """Return the share of the cells with an epoch, of the cells in which any trajectory has one."""
    steps = [float(np.median(np.diff(time))) for time in times if len(time) > 1]
    cell = max([_CELL, *(2 * step for step in steps)])
    sets = [set(np.floor(time / cell).astype(np.int64).tolist()) for time in times]
    every = set().union(*sets)
    return tuple(len(cells) / max(len(every), 1) for cells in sets)


def _nearest(time: Array, grid: Array) -> np.ndarray:
    """Return the index of the nearest time for each epoch of a grid."""
    right = np.clip(np.searchsorted(time, grid), 1, max(len(time) - 1, 1))
    is_left = np.abs(time[right - 1] - grid) <= np.abs(
        time[np.minimum(right, len(time) - 1)] - grid
    )
    return np.asarray(np.where(is_left, right - 1, np.minimum(right, len(time) - 1)))


def position_errors(
    table: TrajectoryTable, reference: ReferenceTrack, rows: np.ndarray, align: str
) -> Array:
    """Compute position errors North, East, Down at rows of a trajectory.

    Returns estimate minus reference, [T, 3], m. Shapes: rows [T].
    """
    estimate = reference.locate(table)[rows]
    truth = reference.interpolate_position(table.time[rows])
    if align == "none":
        return estimate - truth
    mine, theirs = estimate - estimate.mean(axis=0), truth - truth.mean(axis=0)
    if align == "yaw":
        cross = float((mine[:, 0] * theirs[:, 1] - mine[:, 1] * theirs[:, 0]).sum())
        dot = float((mine[:, :2] * theirs[:, :2]).sum())
        c, s = np.cos(np.arctan2(cross, dot)), np.sin(np.arctan2(cross, dot))
        mine = mine @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
    return mine - theirs


def column_errors(
    table: TrajectoryTable, reference: ReferenceTrack, rows: np.ndarray, names: tuple[str, ...]
) -> Array:
    """Compute errors of velocities or angles at rows of a trajectory.

    Returns estimate minus reference, [T, C], m/s or rad. Shapes: rows [T].
    """
    truth = reference.interpolate_columns(names, table.time[rows])
    difference = table.select(names)[rows] - truth
    return np.asarray(wrap_to_half_turn(difference) if names[0] in ATTITUDE_COLUMNS else difference)


def common_columns(
    tables: Sequence[TrajectoryTable], reference: ReferenceTrack
) -> dict[str, tuple[str, ...]]:
    """Return the columns of velocity and attitude that the reference and all tables have."""
    everywhere = [set(table.values) for table in (*tables, reference.table)]
    shared = set.intersection(*everywhere)
    groups = {"velocity": VELOCITY_COLUMNS, "attitude": ATTITUDE_COLUMNS}
    names = {group: tuple(n for n in columns if n in shared) for group, columns in groups.items()}
    return {group: columns for group, columns in names.items() if columns}


# --------------------------------------------------------------------------------------------------
# Errors of a program in the epochs that it leaves out although another program has them.
#
# The error in a hole is the largest one of any program in the sequence, so that a program which leaves out
# its bad epochs gains nothing [ours].

_GAP_STEPS = 1.5


def is_in_hole(time: Array, grid: Array) -> np.ndarray:
    """Return the epochs of a grid that lie in a hole of a trajectory, before it or after it.

    A gap of more than 1.5 steps between two rows is a hole. Half of it, 0.75 steps, counts before the
    first row and after the last one, where the next row may still be due.

    Returns mask, [T]. Shapes: time [K], grid [T].
    """
    if len(time) < 2:
        return np.zeros(len(grid), dtype=bool)
    limit = _GAP_STEPS * float(np.median(np.diff(time)))
    right = np.searchsorted(time, grid)
    inner = np.clip(right, 1, len(time) - 1)
    is_outside = (grid < time[0] - limit / 2) | (grid > time[-1] + limit / 2)
    is_between = (right > 0) & (right < len(time))
    return np.asarray(is_outside | (is_between & (time[inner] - time[inner - 1] > limit)))


def fill_holes(results: Mapping[str, JobResult], holes: Mapping[str, np.ndarray]) -> None:
    """Set the errors in holes to the largest error of any program, in place.

    Shapes: holes [R, T].
    """
    groups = {name for result in results.values() for name in result.meta["state"]["groups"]}
    for group in groups:
        norms = {
            program: np.where(holes[program], np.nan, _norm(result, group))
            for program, result in results.items()
            if group in result.meta["state"]["groups"]
        }
        finite = np.concatenate([norm[np.isfinite(norm)] for norm in norms.values()])
        largest = float(finite.max()) if finite.size else math.nan
        for program in norms:
            _fill_group(results[program], holes[program], group, largest)


def _norm(result: JobResult, group: str) -> Array:
    """Return the norm of the error of a group, [R, T]."""
    indices = list(result.meta["state"]["groups"][group])
    return np.asarray(np.linalg.norm(result.data["error"][..., indices], axis=-1))


def _fill_group(result: JobResult, holes: np.ndarray, group: str, norm: float) -> None:
    """Set the error of a group in holes to a norm, with equal components."""
    runs, times = np.nonzero(holes)
    names = list(result.meta["state"]["groups"])
    indices = result.meta["state"]["groups"][group]
    component = norm / math.sqrt(len(indices))
    result.data["nees"][runs, times, names.index(group)] = np.nan
    for index in indices:
        result.data["error"][runs, times, index] = component
        if "crps" in result.data:
            result.data["crps"][runs, times, index] = component
            result.data["pit"][runs, times, index] = np.nan
