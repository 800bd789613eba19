"""Raw ranges of one's own: an antenna alone, or with an IMU, from RINEX files in the folder of a log."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasuredTruth, Record
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.sky.raw_gnss import RawGnss, RawGnssInputs, RawGnssTuning
from pfbench.logs.sky.rinex_observations import RawEpochs
from pfbench.logs.worlds.corrections import LogCorrections
from pfbench.logs.worlds.drive import FixHoldout
from pfbench.logs.worlds.log_frames import find_origin, place_of
from pfbench.logs.worlds.log_reader import read_track
from pfbench.logs.worlds.log_tables import (
    Array,
    GnssLog,
    NavigationLog,
    ReferenceLog,
    find_dataset,
    list_tables,
    read_table,
)
from pfbench.logs.worlds.point_solutions import PointSolutions, solve_points
from pfbench.logs.worlds.raw_gnss import (
    RawGnssLog,
    RawGnssReceiver,
    RecordedWalk,
    check_sky,
    collect_sky,
    make_sky_inputs,
    subtract_nominal_ranges,
)
from pfbench.logs.worlds.rinex_source import RinexSource
from pfbench.logs.worlds.signal_weights import SignalWeights
from pfbench.logs.worlds.time_grid import encode_names, interpolate, select_fixes
from pfbench.nav import earth
from pfbench.noise.base import NoiseRegime, check_unit_process, draw_added_errors
from pfbench.scenario.base import Scenario

HELD_OUT_POINTS = "held-out point solutions"
HEADER = "header"  # the position in the header of the observations
_OPTIONAL = ("prr", "cn0")  # what receivers may leave out


def check_weights(receiver: RawGnssReceiver) -> None:
    """Check that the receiver has weights."""
    require(
        receiver.weights,
        "scenario.receiver.weights",
        "be set, RINEX states no standard deviations",
        "null",
        "Set scenario.receiver.weights._target_=pfbench.scenario.SignalWeights.",
    )


@dataclass(frozen=True)
class UserRawLog(Scenario):
    """Raw ranges of one's own, without an IMU: filters estimate position, velocity and the receiver clock.

    The truth is a table of positions, or the position of a fixed antenna. Runs differ in the initial errors,
    which have the assumed distribution about the truth, and in the errors that the receiver adds. Without a truth
    the filters start at the solution of the first epoch. Errors are distances to the solutions of epochs that
    they do not get, and runs differ in these epochs.

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        folder: Folder of the log in `root`, with the RINEX files.
        tuning: Parameters that the filter assumes.
        rinex: Files, signals and the time of t = 0.
        reference: Name of the table of positions: t, and lat_deg, lon_deg, h_m or pn, pe, pd; optional vn, ve, vd.
            Not read if `standing` is set. None without a truth.
        standing: Position of a fixed antenna: `header` of the observations, or lat_deg, lon_deg, h_m. None if it moves.
        receiver: Selection and weights of the measurements, and standard deviations of added errors.
        start_s: Start, s of the tables. None for the first epoch.
        end_s: End, s of the tables. None for the last epoch.
        origin: lat_deg, lon_deg, h_m of pn = pe = pd = 0. None if the table contains it.
        limits: Limits of the platform for the checks. None for the default limits.
        holdout: Epochs that filters do not get, for a log without a truth.

    Raises:
        ValueError: If the receiver is without weights. `draw` raises it for missing or invalid files, or times
            that do not overlap.
    """

    root: str | None
    folder: str
    tuning: RawGnssTuning
    rinex: RinexSource = field(default_factory=RinexSource)
    reference: str | None = "reference"
    standing: str | Sequence[float] | None = None
    # measurements as recorded, with weights, since RINEX states no standard deviations
    receiver: RawGnssReceiver = field(
        default_factory=lambda: RawGnssReceiver(weights=SignalWeights())
    )
    start_s: float | None = None
    end_s: float | None = None
    origin: Sequence[float] | None = None
    limits: PlausibleLimits | None = None
    holdout: FixHoldout = field(default_factory=lambda: FixHoldout(used_fixes=4))
    channel_names, input_type = RawGnss.channel_names, RawGnss.input_type

    def __post_init__(self) -> None:
        check_weights(self.receiver)

    def input_files(self) -> list[Path]:
        """List the files that `draw` reads."""
        names = (self.reference,) if self.standing is None and self.reference else ()
        rinex = self.rinex.list_files(self.root, self.folder)
        return [*list_tables(self.root, self.folder, names), *rinex]

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        gnss_log, grid, motion, points = self._read()
        measurements, notes = subtract_nominal_ranges(gnss_log, grid, motion[0, 4:7])
        draws, time = PhiloxStream(seed, runs), torch.from_numpy(grid[1:])
        check_unit_process(noise, time)
        y = torch.from_numpy(measurements[1:]).repeat(len(runs), 1, 1)
        y += draw_added_errors(
            noise, draws.at_step(0), self.receiver.channels(len(gnss_log.names)), time
        )
        inputs = RawGnssInputs(torch.from_numpy(np.diff(grid))[None], *make_sky_inputs(gnss_log))
        path = torch.from_numpy(motion[1:]).expand(len(runs), -1, -1)
        truth = {"position": path[..., 7:], "velocity": path[..., 4:7]}
        record = Record(y, inputs, self._draw_start(motion, draws, points is None))
        angles = {"azimuth": gnss_log.azimuth, "elevation": gnss_log.elevation}
        sky = {name: torch.from_numpy(values[1:]) for name, values in angles.items()}
        sheet = {**sky, "satellites": encode_names(gnss_log.names)}
        episode = Episode(record, time, truth, truth["position"], (*gnss_log.notes, *notes), sheet)
        return episode if points is None else self._hold_out(episode, points, runs)

    def _hold_out(self, episode: Episode, points: PointSolutions, runs: Tensor) -> Episode:
        """Withhold epochs, and make their solutions the only truth."""
        fixes = {"position": torch.from_numpy(points.position[1:])}
        scored, count = self.holdout.withhold(episode, fixes, runs)
        sd = torch.from_numpy(np.sqrt(np.nanmean(points.position_sd[1:] ** 2, axis=0)))
        notes = (
            f"errors are distances to {count} {HELD_OUT_POINTS} (run 0), which the filter does not get; their "
            f"standard deviations, {', '.join(f'{v:.1f}' for v in sd.tolist())} m East, North, Up, are part of NEES, scores and coverage",
            "errors that last for seconds, such as reflections, are in the ranges before and in the solution: the distance does not show them",
        )
        return replace(
            scored, measured_truth=MeasuredTruth(HELD_OUT_POINTS, {"position": sd}),
            notes=(*episode.notes, *notes),
        )  # fmt: skip

    def _draw_start(self, motion: Array, draws: PhiloxStream, has_truth: bool) -> Tensor:
        """Draw starts [R, 9], about which the true state has the assumed distribution; the true clock is the nominal one.

        Without a truth the start is a solution already, and stays.
        """
        sd = self.tuning.initial_sd
        true = torch.from_numpy(np.concatenate([motion[0, 7:], motion[0, 4:7], np.zeros(3)]))
        error = sd * draws.at_step(0).normal("world.start", 1, len(sd))[:, 0]
        return true - error if has_truth else true - 0.0 * error

    def _read(self) -> tuple[RawGnssLog, Array, Array, PointSolutions | None]:
        """Read measurements relative to the start, times from the start on, [K], the truth there, [K, 10], or solutions."""
        folder = find_dataset(self.root, self.folder)
        epochs = self.rinex.read_epochs(folder)
        track, centre = self._read_truth(folder, epochs)
        table = self.rinex.compute_sky(folder, epochs, track, centre)
        times = np.unique(table.rows["t"].to_numpy())
        low = -np.inf if self.start_s is None else self.start_s
        high = np.inf if self.end_s is None else self.end_s
        grid = (
            times[select_fixes(times, self.receiver.fix_interval_s, low, high)]
            if len(times) > 1
            else times
        )
        require(
            len(grid) > 1,
            f"{epochs.name}",
            "have at least 2 epochs between start_s and end_s",
            f"{len(grid)} between t = {times[0]:.3f} and {times[-1]:.3f}",
            "Choose an earlier start or a later end.",
        )
        gnss_log = collect_sky(table, grid, self.receiver, optional=_OPTIONAL)
        motion = interpolate(track, grid)
        points = solve_points(gnss_log, self.tuning, motion[:, 7:]) if self._is_alone else None
        require(
            not np.isnan(motion[0, 4:]).any(),
            "scenario.start_s",
            "not be in a gap of the reference",
            f"t = {grid[0]:.3f}",
        )
        notes = check_sky(gnss_log, grid, motion, self.limits or PlausibleLimits())
        announce_notes(folder, notes)
        start = motion[0, 7:].copy()
        motion[:, 7:] -= start
        if points:
            points = points._replace(position=points.position - start)
        position = gnss_log.satellite_position - start
        return gnss_log._replace(satellite_position=position, notes=notes), grid, motion, points

    @property
    def _is_alone(self) -> bool:
        """Return whether the log is without a truth."""
        return self.reference is None and self.standing is None

    def _solve_track(self, folder: Path, epochs: RawEpochs) -> tuple[ReferenceLog, Sequence[float]]:
        """Return the track of the solutions of all epochs, from `origin` or from the first solution, and this origin.

        The first two searches begin in the middle below the satellites, and at the first solution. Directions and delays
        need the place to some hundred metres, so that the mask applies to the last one alone.
        """
        times, ends = epochs.time, epochs.time[[0, -1]]
        still = ReferenceLog(ends, np.full((2, 4), np.nan), np.zeros((2, 3)), np.zeros((2, 3)))
        everything = replace(self.receiver, mask_deg=-90.0)
        centre = tuple(self.origin) if self.origin else self._guess_place(folder, epochs, still)
        track = still
        for k, receiver in enumerate((everything, everything, self.receiver)):
            table = self.rinex.compute_sky(folder, epochs, track, centre)
            sky = collect_sky(table, times, receiver, optional=_OPTIONAL)
            start = np.stack([np.interp(times, track.time, p) for p in track.position.T], -1)
            points = solve_points(sky, self.tuning, start)
            is_solved = np.isfinite(points.position[:, 0])
            require(
                is_solved.sum() > 1,
                epochs.name,
                "have 2 epochs whose satellites show a position",
                is_solved.sum(),
                "Use a longer log, lower scenario.receiver.mask_deg, or give a reference.",
            )
            time, position = times[is_solved], points.position[is_solved]
            if not k and not self.origin:
                centre = _move(centre, position[0])
                continue
            slow = np.gradient(position, time, axis=0)
            fast = points.velocity[is_solved]
            velocity = np.where(np.isfinite(fast), fast, slow)
            track = ReferenceLog(time, np.full((len(time), 4), np.nan), velocity, position)
        return track, centre

    def _guess_place(
        self, folder: Path, epochs: RawEpochs, still: ReferenceLog
    ) -> tuple[float, ...]:
        """Return lat_deg, lon_deg, h_m in the middle below the satellites of the first epoch."""
        rows = self.rinex.compute_sky(folder, epochs, still, (0.0, 0.0, 0.0)).rows
        first = rows[rows["t"] == rows["t"].min()]
        x, y, z = first[["sx", "sy", "sz"]].mean()
        return math.degrees(math.atan2(z, math.hypot(x, y))), math.degrees(math.atan2(y, x)), 0.0

    def _read_header(self, epochs: RawEpochs) -> tuple[float, ...]:
        """Return the place in the header of the observations, lat_deg, lon_deg, h_m."""
        require(
            epochs.position,
            f"{epochs.name}: APPROX POSITION XYZ",
            "be a position",
            "none",
            "Set scenario.standing=[lat_deg,lon_deg,h_m].",
        )
        at = earth.geodetic(torch.tensor(epochs.position, dtype=torch.float64))
        return tuple((at / place_of((1.0, 1.0, 1.0))).tolist())

    def _read_truth(self, folder: Path, epochs: RawEpochs) -> tuple[ReferenceLog, Sequence[float]]:
        """Return the track of the antenna from an origin, and the origin."""
        if self._is_alone:
            return self._solve_track(folder, epochs)
        if self.standing is None:
            require(
                list_tables(self.root, self.folder, (self.reference,)),
                f"{folder}",
                f"contain {self.reference}.csv or .parquet",
                "none",
                "Without one set scenario.reference=null, and for a fixed antenna scenario.standing=header.",
            )
            table = read_table(folder, self.reference, {}, self.limits)
            centre = find_origin(self.origin, table, table)
            require(
                centre,
                f"{table.name}",
                "contain or have an origin",
                "pn, pe, pd alone",
                "Set scenario.origin=[lat_deg,lon_deg,h_m].",
            )
            return read_track(table, centre), centre or ()
        if self.standing == HEADER:
            centre = self._read_header(epochs)
        else:
            require(
                not isinstance(self.standing, str) and len(self.standing) == 3,
                "scenario.standing",
                "be header, or lat_deg, lon_deg, h_m",
                self.standing,
            )
            centre = tuple(float(a) for a in self.standing)
        ends = epochs.time[[0, -1]]
        still = np.zeros((2, 3))
        return ReferenceLog(ends, np.full((2, 4), np.nan), still, still), centre


def _move(centre: Sequence[float], enu: Array) -> tuple[float, ...]:
    """Return lat_deg, lon_deg, h_m of a position, East, North, Up from a place, m, [3]."""
    at = earth.from_local_enu(torch.from_numpy(enu)[None], place_of(centre))[0]
    return tuple((at / place_of((1.0, 1.0, 1.0))).tolist())


@dataclass(frozen=True)
class UserInsLog(RecordedWalk):
    """Raw ranges of one's own with an IMU, tightly coupled, scored against a reference with attitude.

    The other attributes are those of `RecordedWalk`. Steps end at the epochs of the observations.

    Attributes:
        rinex: Files, signals and the time of t = 0.
        corrections: Corrections that the reader applies before its checks.
    """

    rinex: RinexSource = field(default_factory=RinexSource)
    corrections: LogCorrections = field(default_factory=LogCorrections)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_weights(self.receiver)
        of_fixes = (self.corrections.lever_arm, self.corrections.offset_m)
        require(
            all(value is None for value in of_fixes),
            "scenario.corrections",
            "not be of fixes, which this log has not",
            "lever_arm or offset_m",
            "Leave lever_arm and offset_m out, and give the reference of the antenna.",
        )

    def input_files(self) -> list[Path]:
        """List the files that `draw` reads."""
        tables = list_tables(self.root, self.folder, (self.files.imu, self.files.reference))
        return [*tables, *self.rinex.list_files(self.root, self.folder)]

    @override
    def read_checked(self, folder: Path, **select: Any) -> NavigationLog:
        source = replace(self, files=replace(self.files, gnss=self.files.reference or ""))
        log = RecordedWalk.read_checked(source, folder, corrections=self.corrections, **select)
        require(
            log.centre,
            "the log",
            "contain its origin",
            "pn, pe, pd alone",
            "Set scenario.origin=[lat_deg,lon_deg,h_m].",
        )
        time = self.rinex.read_epochs(folder).time
        time = time[(time >= log.reference.time[0]) & (time <= log.reference.time[-1])]
        motion = interpolate(log.reference, time) if len(time) else np.empty((0, 10))
        return replace(log, fixes=GnssLog(time, motion[:, 7:], motion[:, 4:7]))

    @override
    def _read_sky(self, folder: Path, log: NavigationLog, time: Array) -> RawGnssLog:
        epochs = self.rinex.read_epochs(folder)
        table = self.rinex.compute_sky(folder, epochs, log.reference, log.centre or ())
        return collect_sky(table, time, self.receiver, optional=_OPTIONAL)
