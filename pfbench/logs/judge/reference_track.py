"""Reference of a sequence: positions in one local frame, interpolated to the epochs of programs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.ndimage import median_filter

from pfbench.core.parameter_checks import require
from pfbench.logs.judge.formats import read_trajectories
from pfbench.logs.judge.judge_options import JudgeOptions, SourceOptions, name_program
from pfbench.logs.judge.trajectory_table import (
    ATTITUDE_COLUMNS,
    GEODETIC,
    LOCAL,
    VELOCITY_COLUMNS,
    TrajectoryTable,
    to_north_east_down,
    wrap_to_half_turn,
)
from pfbench.logs.judge.unit_checks import check_consistent_units
from pfbench.stats.error_measures import Array

_SAME_TRUTH = 0.5  # m, largest difference of one truth that two files interpolate
_MOVED = 1e-3  # m, smallest move
_LEAST_ROWS = 10  # rows that show a motion
_LEAST_GAP, _GAP_STEPS = 1.0, 2.5  # s, median steps


@dataclass(frozen=True)
class ReferenceTrack:
    """Reference trajectory of a sequence.

    Attributes:
        table: Table of the file.
        origin: Latitude, longitude, height of the local frame, deg, deg, m; empty if unknown.
        is_local: Whether positions are compared in the local coordinates of both files.
        largest_gap: Longest time between two rows that is interpolated, s.
    """

    table: TrajectoryTable
    origin: tuple[float, ...]
    is_local: bool
    largest_gap: float

    @property
    def file(self) -> str:
        """Name of the file."""
        return self.table.file

    @property
    def position(self) -> Array:
        """Positions North, East, Down, [T, 3], m."""
        return self.locate(self.table)

    def locate(self, table: TrajectoryTable) -> Array:
        """Return the positions of a table in the local frame of the reference.

        Returns north, East, Down, [T, 3], m.
        """
        if table.has(LOCAL) and self.is_local:
            return table.select(LOCAL)
        if table.has(GEODETIC) and self.origin:
            return to_north_east_down(table.select(GEODETIC), np.array(self.origin))
        have = ", ".join(GEODETIC if table.has(GEODETIC) else LOCAL)
        raise ValueError(
            f"{table.file} must have positions in the frame of {self.file}, got {have} and no origin "
            "of the local frame. Set origin=LAT_DEG,LON_DEG,H_M of pn = pe = pd = 0."
        )

    def place(self, table: TrajectoryTable) -> TrajectoryTable:
        """Move a result of pfbench, whose positions start at 0, to its truth in the reference.

        Returns the table with a note; unchanged without a truth, or if its truth is not the
        reference.
        """
        inside = self.is_bridged(table.time)
        if table.truth is None or not self.is_local or not inside.any():
            return table
        move = self.interpolate_position(table.time[inside]) - table.truth[inside]
        offset = np.median(move, axis=0)
        if np.abs(move - offset).max() > _SAME_TRUTH or np.abs(offset).max() < _MOVED:
            return table
        columns = {
            name: table.values[name] + shift for name, shift in zip(LOCAL, offset, strict=True)
        }
        note = "moved by {:.4g}, {:.4g}, {:.4g} m to its truth in the reference".format(*offset)
        values = {**table.values, **columns}
        return replace(table, values=values, truth=None, notes=(*table.notes, note))

    def interpolate_position(self, time: Array) -> Array:
        """Interpolate positions, [K, 3]: cubic with the velocities of the file, else linear.

        Shapes: time [K].
        """
        clock, position = self.table.time, self.position
        linear = np.stack([np.interp(time, clock, p) for p in position.T], axis=-1)
        if any(name not in self.table.values for name in VELOCITY_COLUMNS):
            return linear
        velocity, (k, length, share) = self.table.select(VELOCITY_COLUMNS), self._find_steps(time)
        step, s = length[:, None], share[:, None]
        slope = (position[k + 1] - position[k]) / step
        start, end = velocity[k] - slope, velocity[k + 1] - slope
        return linear + step * s * (1 - s) * ((1 - s) * start - s * end)

    def interpolation_error(self, time: Array) -> Array:
        """Estimate the error of interpolated positions, [K], m, from rows that are left out.

        Each row is interpolated between its neighbours. The error grows with the square of the step, and
        with velocities with its fourth power. It is 0 at the rows, and in the long gaps that a user
        bridges. It is infinite between less than 10 rows, which cannot show a motion.

        Shapes: time [K].
        """
        clock, has_velocity = self.table.time, VELOCITY_COLUMNS[-1] in self.table.values
        (k, length, s), step, power = self._find_steps(time), np.diff(clock), 1 + has_velocity
        size = (np.clip(s * (1 - s), 0.0, None) * length**2) ** power
        if len(clock) < _LEAST_ROWS:
            return np.where(size > 1e-9, np.inf, 0.0)
        bend = np.zeros(len(clock))
        for first in (1, 2):
            rows = np.arange(first, len(clock) - 1, 2)
            rest = self.table.keep_rows(~np.isin(np.arange(len(clock)), rows))
            left_out = replace(self, table=rest).interpolate_position(clock[rows])
            distance = np.linalg.norm(self.position[rows] - left_out, axis=1)
            bend[rows] = distance / (step[rows - 1] * step[rows]) ** power
        bend[0], bend[-1] = bend[1], bend[-2]
        is_long = length > _GAP_STEPS * np.median(step)
        return np.where(is_long, 0.0, size * (bend[k] + bend[k + 1]) / 2)

    def interpolate_columns(self, names: tuple[str, ...], time: Array) -> Array:
        """Interpolate velocities or angles linearly, [K, C]; angles along the shorter way.

        Shapes: time [K].
        """
        columns = [self.table.values[name] for name in names]
        columns = [
            np.unwrap(c) if n in ATTITUDE_COLUMNS else c
            for n, c in zip(names, columns, strict=True)
        ]
        values = np.stack([np.interp(time, self.table.time, c) for c in columns], axis=-1)
        return np.asarray(wrap_to_half_turn(values) if names[0] in ATTITUDE_COLUMNS else values)

    def is_bridged(self, time: Array) -> np.ndarray:
        """Return the times [K] that lie within the reference and in none of its long gaps."""
        clock, (k, length, _) = self.table.time, self._find_steps(time)
        inside = (time >= clock[0]) & (time <= clock[-1])
        is_exact = (time == clock[k]) | (time == clock[k + 1])
        return np.asarray(inside & ((length <= self.largest_gap) | is_exact))

    def _find_steps(self, time: Array) -> tuple[np.ndarray, Array, Array]:
        """Return the row before each time [K], the length of the step after it, s, and the passed share of it."""
        clock = self.table.time
        k = np.clip(np.searchsorted(clock, time, side="right") - 1, 0, len(clock) - 2)
        return k, clock[k + 1] - clock[k], (time - clock[k]) / (clock[k + 1] - clock[k])


def read_reference(path: Path, options: JudgeOptions, source: SourceOptions) -> ReferenceTrack:
    """Read the reference of a sequence and check its gaps in the scored time."""
    with name_program("reference"):
        tables = [check_consistent_units(table) for table in read_trajectories(path, source)]
    require(
        len(tables) == 1,
        "reference",
        "be one trajectory",
        f"{len(tables)} runs in {path.name}",
        "Use a .csv file.",
    )
    table, step = tables[0], float(np.median(np.diff(tables[0].time)))
    gap = options.largest_gap or max(_LEAST_GAP, _GAP_STEPS * step)
    is_local = table.has(LOCAL)
    origin = tuple(options.origin) or table.origin
    if not is_local and not origin:
        origin = tuple(float(table.values[name][0]) for name in GEODETIC)
    reference = ReferenceTrack(table, origin, is_local, gap)
    if options.holes == "refuse":
        _refuse_holes(reference, options)
    return reference


def _refuse_holes(reference: ReferenceTrack, options: JudgeOptions) -> None:
    time = reference.table.time
    start, step = time[:-1], np.diff(time)
    holes = (step > reference.largest_gap) & (start < options.end) & (start + step > options.start)
    k = int(holes.argmax())
    require(
        not holes[k],
        f"{reference.file}: line {reference.table.lines[k + 1]}, column t",
        f"follow the row before within {reference.largest_gap:g} s",
        f"a hole of {step[k]:.6g} s from {start[k]:.10g} s ({int(holes.sum())} holes)",
        "Set holes=skip to leave these epochs out, or largest_gap=SECONDS to interpolate them.",
    )


# --------------------------------------------------------------------------------------------------
# Checks of the scored time and of the number of common epochs; epochs of equal weight in time.

LEAST_EPOCHS = 10
LEAST_SHARE = 0.9  # share of the epochs outside of holes that must be common
_UNEQUAL = 0.02  # share of the weight that may lie at another epoch than by time
_SHORT_SHARE = 0.1  # share of the time that has shorter steps than the step of even epochs
_REACH_STEPS, _WINDOW = (
    0.75,
    9,
)  # steps, as before the first row of a program; steps around an epoch


def check_scored_time(reference: ReferenceTrack, options: JudgeOptions) -> None:
    """Check that the scored time is within the reference, and blocks are short enough for it."""
    first, last = (float(t) for t in reference.table.time[[0, -1]])
    span = f"{first:.10g} to {last:.10g} s"
    for name, value, is_valid in (
        ("from", options.start, options.start < last),
        ("to", options.end, options.end > first),
    ):
        require(
            is_valid,
            name,
            f"be within {reference.file} ({span})",
            f"{value:.10g} s",
            f"Change {name}=...",
        )
    half = (min(last, options.end) - max(first, options.start)) / 2
    require(
        options.block <= half,
        "block",
        f"be at most half of the scored time, {half:.10g} s",
        f"{options.block:.10g} s",
        "Set block=0 for the rule.",
    )


def check_shared(
    counts: tuple[int, int], share: float, texts: tuple[str, str, str], tolerance: float
) -> None:
    """Check that enough epochs are shared, for scores and for the weight of holes."""
    (shared, in_holes), (file, sizes, remedy) = counts, texts
    owner = f"trajectories of {file}"
    require(
        shared >= LEAST_EPOCHS,
        owner,
        f"share at least {LEAST_EPOCHS} epochs within {tolerance:g} s",
        f"{shared} of {sizes}",
        f"Set {remedy}, or let the programs write the same epochs.",
    )
    require(
        not in_holes or share >= LEAST_SHARE,
        owner,
        f"share {100 * LEAST_SHARE:g} % of the epochs outside of holes within {tolerance:g} s",
        f"{100 * share:.3g} % of {sizes}",
        f"Set {remedy}.",
    )


def space_evenly(time: Array) -> tuple[np.ndarray, Array]:
    """Choose epochs so that each one counts by the time around it.

    Equal steps are left as they are. Otherwise, instants of equal distance take the nearest epoch, so
    that a slow stretch repeats its epochs and a fast one leaves some out. A program that writes its good
    epochs several times gains nothing. An instant beyond 0.75 steps of the neighbourhood takes none.

    Returns index of the epoch of each instant, [T], and the instants, [T], s. Shapes: time [K].
    """
    steps = np.diff(time)
    if len(steps) < 2:
        return np.arange(len(time)), time
    sizes = np.sort(steps)
    short = float(sizes[np.searchsorted(sizes.cumsum(), _SHORT_SHARE * sizes.sum())])
    local = _REACH_STEPS * np.maximum(median_filter(steps, _WINDOW, mode="nearest"), short)
    half = np.minimum(steps / 2, local)
    weights = np.concatenate([half[:1], half]) + np.concatenate([half, half[-1:]])
    if 0.5 * np.abs(weights / weights.sum() - 1 / len(time)).sum() < _UNEQUAL:
        return np.arange(len(time)), time
    instants = time[0] + short * np.arange(int((time[-1] - time[0]) / short * (1 + 1e-9)) + 1)
    right = np.clip(np.searchsorted(time, instants), 1, len(time) - 1)
    is_left = instants - time[right - 1] <= time[right] - instants
    nearest = np.where(is_left, right - 1, right)
    is_near = np.abs(instants - time[nearest]) <= half[right - 1] * (1 + 1e-9)
    return nearest[is_near], instants[is_near]


def check_coverage(names: list[str], coverage: tuple[float, ...], least: float) -> None:
    """Check that one trajectory at least is not lost."""
    require(
        max(coverage, default=0.0) >= least,
        "one trajectory",
        f"cover {100 * least:g} % of the time that any of them covers",
        ", ".join(f"{100 * c:.3g} % ({n})" for n, c in zip(names, coverage, strict=True)),
        "Set from and to, or a smaller coverage.",
    )
