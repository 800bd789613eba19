"""Own log without a reference of the attitude: a start from level and course, scored at withheld fixes or positions."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.record import Episode, MeasuredTruth
from pfbench.files.reader_notes import announce_notes
from pfbench.files.table_file import Array
from pfbench.noise.base import NoiseRegime
from pfbench.scenario.diagnosis.raw_log import take_log
from pfbench.scenario.recorded.corrections import LogCorrections
from pfbench.scenario.recorded.drive import RecordedDrive
from pfbench.scenario.recorded.fix_codes import select_usable
from pfbench.scenario.recorded.log_checks import check_overlap
from pfbench.scenario.recorded.log_frames import find_origin, gravity_at, read_positions
from pfbench.scenario.recorded.log_reader import diagnose, read_fixes, read_samples
from pfbench.scenario.recorded.log_tables import (
    GnssLog,
    LogTable,
    NavigationLog,
    ReferenceLog,
    find_dataset,
    parse_numbers,
    read_table,
    read_times,
    swap_frd_rfu,
)
from pfbench.scenario.recorded.odometer import SimulatedOdometer
from pfbench.scenario.recorded.start_alignment import StartAlignment, StartEstimate
from pfbench.scenario.recorded.time_grid import ResampledLog, interpolate
from pfbench.scenario.recorded.user_log import UserLog

HELD_OUT = "held-out fixes"
_VELOCITY = ("vn", "ve", "vd")
_REMEDY = "Leave these out. A lever arm is a key of scenario.constraints, too."


@dataclass(frozen=True)
class AlignedLog(UserLog):
    """Own log whose filters start from level and course, not from a reference.

    `files.reference` is None without a reference, or names a table of positions. Errors are distances to the fixes that
    `holdout` withholds, or, without it, to the positions of the reference. The attitude is estimated and not scored.
    The other attributes are those of `UserLog`.

    Attributes:
        alignment: Search for the start.

    Raises:
        ValueError: If a correction or the odometer needs the attitude of a reference; see also `UserLog`.
    """

    alignment: StartAlignment = field(default_factory=StartAlignment)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_corrections(self.corrections, self.files.reference is not None)
        remedy = "Use a table of speeds: pfbench.scenario.RecordedOdometer"
        is_recorded = not isinstance(self.odometer, SimulatedOdometer)
        require(is_recorded, "scenario.odometer", "not be simulated, which needs a reference", "one that is", remedy)  # fmt: skip

    def _read_log(self, folder: Path) -> NavigationLog:
        inertial, gnss = (read_table(folder, name, {}, self.limits) for name in (self.files.imu, self.files.gnss))  # fmt: skip
        truth = read_table(folder, self.files.reference, {}, self.limits) if self.files.reference else None  # fmt: skip
        (inertial, gnss, other), mended = self.corrections.correct_tables(inertial, gnss, truth or gnss)  # fmt: skip
        truth = other if truth else None
        sensors, notes = read_samples(inertial)
        check_level(sensors.force, inertial.name)
        centre = find_origin(self.origin, gnss, truth or gnss)
        usable, usable_notes = select_usable(gnss, self.fix_codes)
        fixes = read_fixes(gnss, centre, usable)
        position = self.corrections.offset_m
        if position is not None:
            fixes = fixes._replace(position=fixes.position - swap_frd_rfu(np.array(position, float)))  # fmt: skip
            mended = (*mended, f"{gnss.name}: {list(position)} m North, East, Down subtracted from the fixes")  # fmt: skip
        check_overlap(inertial.name, sensors.time, gnss.name, fixes.time)
        gravity, gravity_notes = gravity_at(centre)
        diagnosed = diagnose(take_log((inertial, gnss, gnss), sensors, fixes, None, gravity), has_own_fixes=True)  # fmt: skip
        dropped = dict.fromkeys(note for table in (inertial, gnss) for note in table.notes)
        notes = (*dropped, *mended, *usable_notes, *notes, *gravity_notes, *diagnosed)
        announce_notes(folder, notes)
        reference = _read_track(truth, centre) if truth else _join_fixes(fixes)
        return NavigationLog(sensors, fixes, reference, gravity, notes, centre)

    @override
    def resample(self, log: NavigationLog) -> ResampledLog:
        start = self.alignment.find(log, self.tuning, self.start_s)
        leg = replace(self, start_s=start.time)._resample_from(log, start)
        announce_notes(find_dataset(self.root, self.folder), (start.note,))
        return leg

    def _resample_from(self, log: NavigationLog, start: StartEstimate) -> ResampledLog:
        """Resample the log from a start; positions are relative to it."""
        leg = super().resample(log)
        truth, shift = leg.truth.copy(), start.state[7:] - find_start(log, leg)
        truth[:, 7:] -= shift
        fixes = leg.fixes.copy()
        fixes[:, :3] -= shift
        state = np.concatenate([start.state[:7], np.zeros(3)])
        return leg._replace(truth=truth, fixes=fixes, start=state, start_sd=start.sd, notes=(*leg.notes, start.note))  # fmt: skip

    @override
    def over(self, leg: ResampledLog, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        episode = RecordedDrive.over(replace(self, holdout=None), leg, noise, runs, seed)
        if self.holdout is None and self.files.reference:
            truth = {name: episode.truth[name] for name in ("velocity", "position")}
            note = "the attitude is not scored: the log has no reference of it"
            return replace(episode, truth=truth, notes=(*episode.notes, note))
        if self.holdout is None:
            note = "nothing is scored: the log has no reference, and no fix is withheld"
            truth = {"position": torch.full_like(episode.truth["position"], torch.nan)}
            return replace(episode, truth=truth, notes=(*episode.notes, note))
        scored, count = self.holdout.withhold(episode, leg, runs)
        sd = self.tuning.measurement_sd
        names = ("position", "velocity") if len(sd) == 6 else ("position",)
        truth = {name: scored.truth[name] for name in names}
        measured = MeasuredTruth(HELD_OUT, dict(zip(names, sd.split(3), strict=True)))
        notes = (
            f"errors are distances to {count} {HELD_OUT} (run 0), which the filter does not get; their standard deviations "
            "are part of NEES, scores and coverage. The attitude is not scored, and the track is that of the fixes",
            "runs differ in the fixes that are withheld and in the numbers of the filter: they are parts of one log",
        )
        return replace(scored, truth=truth, measured_truth=measured, notes=(*episode.notes, *notes))


def check_level(force: Array, name: str) -> None:
    """Check that the specific force is upward for most of the time, which a course cannot show.

    Shapes: force [n, 3], right, forward, up.
    """
    typical, up = float(np.median(np.linalg.norm(force, axis=1))), float(np.median(force[:, 2]))
    must = "be about -9.8 on fz for most of the time, in axes forward, right, down"
    remedy = "Axes forward, left, up need +scenario.corrections.mounting.imu=[x,-y,-z]; see pfbench inspect."
    require(
        up > 0.5 * typical, f"{name}: the specific force", must, f"a median of {-up:.3g}", remedy
    )


def check_corrections(corrections: LogCorrections, has_positions: bool) -> None:
    """Check that no correction needs a reference that the log does not have."""
    tables = {
        key: getattr(corrections, key) or {}
        for key in ("times", "scale", "bias", "shift_s", "level_axes")
    }
    named = [
        f"{key}.{name}"
        for key, names in tables.items()
        for name in names
        if name.startswith("reference") and not has_positions
    ]
    named += [name for name in ("attitude", "lever_arm") if getattr(corrections, name) is not None]
    named += [f"drop={name}" for name in corrections.drop or () if name in ("outliers", "frozen")]
    require(not named, "scenario.corrections", "not need a reference that the log lacks", ", ".join(named), _REMEDY)  # fmt: skip


def find_start(log: NavigationLog, leg: ResampledLog) -> Array:
    """Return the position of the reference at the start of a resampled log, m, [3]."""
    return interpolate(log.reference, np.array([leg.start_s]))[0, 7:]


def _join_fixes(fixes: GnssLog) -> ReferenceLog:
    """Return the usable fixes as a track without attitude, for the map and the start of the steps."""
    usable = np.isfinite(fixes.position).all(1)
    time, position = fixes.time[usable], fixes.position[usable]
    require(len(time) > 1, "the log", "have at least 2 usable fixes", len(time), "Check the column fix.")  # fmt: skip
    return ReferenceLog(time, np.full((len(time), 4), np.nan), np.gradient(position, time, axis=0), position)  # fmt: skip


def _read_track(table: LogTable, centre: tuple[float, ...] | None) -> ReferenceLog:
    """Read a reference of positions; its velocities are those of the table, or the change of the positions."""
    time, position = read_times(table, longest=100.0), read_positions(table, centre)
    velocity = swap_frd_rfu(parse_numbers(table, _VELOCITY)) if table.has(_VELOCITY) else np.gradient(position, time, axis=0)  # fmt: skip
    return ReferenceLog(time, np.full((len(time), 4), np.nan), velocity, position)
