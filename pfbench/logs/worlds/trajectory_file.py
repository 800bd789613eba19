"""Recorded trajectories for flights with simulated sensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import hash_file
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.worlds.log_agreement import compare_reference
from pfbench.logs.worlds.log_reader import read_motion_log
from pfbench.logs.worlds.log_tables import (
    LogTable,
    ReferenceLog,
    find_dataset,
    find_table,
    list_tables,
    parse_numbers,
    read_table,
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
            for setting, limit in ((self.start_s, -math.inf), (self.end_s, math.inf))
        )
        selected_mask = (recorded.time >= low) & (recorded.time <= high)
        if int(selected_mask.sum()) < 2:
            first, last = float(recorded.time[0]), float(recorded.time[-1])
            raise ValueError(
                "scenario.trajectory.start_s and end_s must select at least 2 rows, "
                f"got {self.start_s} and {self.end_s}. "
                f"The file covers t = {first:.3f} to {last:.3f} s."
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
    roll, pitch, yaw = parse_numbers(table, ("roll", "pitch", "yaw")).T
    dcm = attitude.dcm_from_euler(torch.from_numpy(np.stack([pitch, roll, -yaw], axis=-1)))
    check_single_velocities(table, motion)
    require(  # a truth is free of measurement errors
        not (contradictions := compare_reference(table, motion)),
        "a trajectory",
        "have positions and velocities that agree",
        "; ".join(contradictions),
        "Correct or remove this row.",
    )
    time, vel, enu = map(torch.from_numpy, (motion.time, motion.velocity, motion.position))
    centre = torch.tensor(
        [math.radians(origin[0]), math.radians(origin[1]), origin[2]], dtype=torch.float64
    )
    plan = earth.from_local_enu(enu * enu.new_tensor([1.0, 1.0, 0.0]), centre)
    return RecordedMotion(time, torch.cat([plan[:, :2], centre[2] + enu[:, 2:]], -1), vel, dcm)


def check_single_velocities(table: LogTable, motion: ReferenceLog) -> None:
    """Check that no velocity is a single outlier among its neighbours.

    The mean of both neighbours is as far from a single outlier as each of them. Smooth motion
    leaves it by half of the change between rows at most, so the limit is half of that of a change:
    5 m/s and 10 g [ours].
    """
    if len(motion.time) < 3:
        return
    quantity = table.limits.select("velocity")
    middle = 0.5 * (motion.velocity[2:] + motion.velocity[:-2])
    off = np.abs(motion.velocity[1:-1] - middle).max(axis=1)
    largest = 0.5 * (quantity.allowance + quantity.rate * (motion.time[2:] - motion.time[:-2]) / 2)
    wrong = np.flatnonzero(off > largest)
    if wrong.size:
        i = int(wrong[0])
        raise ValueError(
            f"{table.name}: a velocity must agree with its neighbours to {largest[i]:.3g} m/s, got "
            f"{off[i]:.3g} m/s in {table.row(i + 1)}. Correct or remove this row."
        )
