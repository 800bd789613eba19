"""Recorded trajectories for flights with simulated sensors."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import hash_file
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.doctor.raw_log import RawReference
from pfbench.logs.doctor.reference_checks import check_reference, check_rows
from pfbench.logs.worlds.log_agreement import compare_velocities
from pfbench.logs.worlds.log_frames import place_of
from pfbench.logs.worlds.log_reader import read_motion_log
from pfbench.logs.worlds.log_tables import (
    find_dataset,
    find_table,
    list_tables,
    parse_numbers,
    read_table,
    swap_frd_rfu,
)
from pfbench.nav import attitude, earth
from pfbench.nav.trajectory import MotionSpline, RecordedMotion, TrajectoryData


@dataclass(frozen=True)
class RecordedTrajectory:
    """Recorded trajectory, smoothed by splines and sampled at any rate.

    It is a `TrajectorySource` of `SimulatedFlight`. The `repr` is part of the episode cache key. It
    contains the checksum of the file, but not its location.

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        folder: Folder of the trajectory in `root`.
        origin: lat_deg, lon_deg, h_m of pn = pe = pd = 0.
        file: Name of the table, without .parquet or .csv.
        start_s: Start, s of the file. None for the start of the file.
        end_s: End, s of the file. None for the end of the file.
        knot_interval_s: Time between the knots of the splines, s; see `MotionSpline`.
        use_full_log: Time unit, s. The duration is an integer multiple of it. It must be a multiple
            of the filter interval.
        checksum: Checksum of the table, set by the class.

    Raises:
        ValueError: If root, folder or file is missing, or the end is not after the start.
            `generate` raises it for an invalid table, and for errors of `MotionSpline`.
    """

    root: str | None = field(repr=False)
    folder: str
    origin: Sequence[float]
    file: str = "trajectory"
    start_s: float | None = None
    end_s: float | None = None
    knot_interval_s: float = 0.4
    use_full_log: float = 1.0
    checksum: str = field(init=False, default="")

    def __post_init__(self) -> None:
        require(
            self.start_s is None or self.end_s is None or self.start_s < self.end_s,
            "scenario.trajectory.end_s",
            f"be later than start_s = {self.start_s}",
            self.end_s,
            "Change start_s or end_s.",
        )
        table = find_table(find_dataset(self.root, self.folder), self.file)
        object.__setattr__(self, "checksum", hash_file(table))

    def input_files(self) -> list[Path]:
        """List the file of the trajectory."""
        return list_tables(self.root, self.folder, (self.file,))

    def generate(self, rate: float) -> TrajectoryData:
        """Generate truth and ideal sensors at `rate` samples per second."""
        recorded = read_motion(find_dataset(self.root, self.folder), self.file, self.origin)
        low, high = (
            limit if setting is None else setting
            for setting, limit in ((self.start_s, -np.inf), (self.end_s, np.inf))
        )
        selected_mask = (recorded.time >= low) & (recorded.time <= high)
        require(
            int(selected_mask.sum()) >= 2,
            "scenario.trajectory.start_s and end_s",
            "select at least 2 rows",
            f"{self.start_s} and {self.end_s}",
            f"The file covers t = {recorded.time[0]:.3f} to {recorded.time[-1]:.3f} s.",
        )
        return MotionSpline(
            RecordedMotion(*(leaf[selected_mask] for leaf in recorded)),
            self.knot_interval_s,
            self.use_full_log,
        ).generate(rate)


def read_motion(folder: str | Path, name: str, origin: Sequence[float]) -> RecordedMotion:
    """Read a trajectory from a table.

    The columns are t [s], pn, pe, pd [m], vn, ve, vd [m/s] and roll, pitch, yaw [rad], in
    forward-right-down axes. North and East of any map grid are accepted. The meridian convergence
    of the grid rotates the track slightly, which does not affect the motion. The height is -pd above
    the height of the origin, not above its tangent plane [ours].
    """
    require(
        len(origin) == 3 and abs(origin[0]) <= 89.0,
        "scenario.trajectory.origin",
        "be lat_deg (-89 to 89), lon_deg, h_m",
        list(origin),
        "Set the point pn = pe = pd = 0.",
    )
    table = read_table(Path(folder), name, {})
    announce_notes(folder, table.notes)
    motion = read_motion_log(table, tuple(origin), longest=1.0)
    angles = parse_numbers(table, ("roll", "pitch", "yaw"))
    roll, pitch, yaw = angles.T
    dcm = attitude.dcm_from_euler(torch.from_numpy(np.stack([pitch, roll, -yaw], axis=-1)))
    velocity, position = swap_frd_rfu(motion.velocity), swap_frd_rfu(motion.position)
    raw = RawReference(motion.time, angles, velocity, position, np.arange(len(angles)))
    raw, findings = check_rows(table.name, raw, table.row)
    findings += check_reference(table.name, raw, {})[1]
    wrong = [*compare_velocities(table, motion), *(finding.text for finding in findings)]
    require(  # a truth is free of measurement errors
        not wrong,
        "a trajectory",
        "have positions and velocities that agree",
        "; ".join(wrong).removesuffix("."),
        "Correct units, signs and order of the columns, or remove this row.",
    )
    time, vel, enu = map(torch.from_numpy, (motion.time, motion.velocity, motion.position))
    centre = place_of(origin)
    plan = earth.from_local_enu(enu * enu.new_tensor([1.0, 1.0, 0.0]), centre)
    return RecordedMotion(time, torch.cat([plan[:, :2], centre[2] + enu[:, 2:]], -1), vel, dcm)
