"""Recorded drives and flights with degraded fixes, scored against a reference.

All runs of a drive have the same motion. They differ in receiver errors and initial errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record, fix_channels
from pfbench.model.strapdown.total import StrapdownTotal
from pfbench.model.strapdown.tuning import StrapdownTuning
from pfbench.nav.preintegration import PreintegratedImu, preintegrate
from pfbench.noise.base import NoiseRegime, check_unit_process
from pfbench.scenario.base import check_divergence_threshold
from pfbench.scenario.recorded.fix_holdout import FixHoldout
from pfbench.scenario.recorded.log_reader import LogFiles, read_log
from pfbench.scenario.recorded.log_tables import Array
from pfbench.scenario.recorded.time_grid import SAME_TIME, ResampledLog, resample_log


@dataclass(frozen=True)
class FixReceiver:
    """Conversion of recorded fixes to measurements.

    Attributes:
        fix_interval_s: Time between used fixes, s. A record with fewer fixes uses all of them.
        position_sd: Standard deviations of added position errors, East, North, Up, m, [3]. With
            zeros a noise regime can only remove fixes.
        velocity_sd: Standard deviations of added velocity errors, m/s, [3]. None if velocity is not
            measured.

    Raises:
        ValueError: if the interval is not positive, or the standard deviations are not three
            numbers of at least 0.
    """

    fix_interval_s: float = 1.0
    position_sd: Sequence[float] = (1.5, 1.5, 3.0)
    velocity_sd: Sequence[float] | None = None

    def __post_init__(self) -> None:
        _check_seconds("scenario.receiver.fix_interval_s", self.fix_interval_s)
        for name, sd in (("position_sd", self.position_sd), ("velocity_sd", self.velocity_sd)):
            if sd is not None and (len(sd) != 3 or min(sd) < 0.0):
                raise ValueError(
                    f"scenario.receiver.{name} must be 3 numbers of at least 0, got {list(sd)}. "
                    "Set East, North and Up, with 0 for no added errors."
                )

    @property
    def channels(self) -> MeasurementChannels:
        """Channels of position, and of velocity if measured, from one source."""
        return fix_channels(self.sd)

    @property
    def sd(self) -> Tensor:
        """Standard deviations of the added errors, m and m/s, [3 or 6]."""
        return torch.tensor([*self.position_sd, *(self.velocity_sd or ())], dtype=torch.float64)


@dataclass(frozen=True)
class RecordedDrive:
    """One recorded log. Runs differ in receiver errors and initial errors.

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        folder: Folder of the log in `root`.
        tuning: Parameters that the filter assumes. The initial errors of the runs have the assumed
            distribution.
        receiver: Selection of fixes, and standard deviations of added errors.
        filter_step_s: Longest filter interval, s.
        start_s: Start, s of the log. None for the start of the data common to all tables.
        end_s: End, s of the log. None for the end of the data common to all tables.
        files: Names of the tables.
        origin: lat_deg, lon_deg, h_m of the local frame. None if the files contain it.
        holdout: Selection of withheld fixes, which are the truth instead of the reference. None
            withholds no fixes.
        divergence_threshold_m: Position error, m, beyond which a run counts as diverged. None if
            the scenario does not define divergence.

    Raises:
        ValueError: if a step, an interval or the threshold is not positive. `draw` raises it for a
            missing root or folder, an invalid log, or a run without withheld fixes.
    """

    root: str | None
    folder: str
    tuning: StrapdownTuning
    receiver: FixReceiver = field(default_factory=FixReceiver)
    filter_step_s: float = 0.25
    start_s: float | None = None
    end_s: float | None = None
    files: LogFiles = field(default_factory=LogFiles)
    origin: Sequence[float] | None = None
    holdout: FixHoldout | None = None
    divergence_threshold_m: float | None = None

    def __post_init__(self) -> None:
        check_divergence_threshold(self.divergence_threshold_m)
        _check_seconds("scenario.filter_step_s", self.filter_step_s)

    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        """Read the log and draw the errors of some runs.

        Args:
            noise: Noise regime.
            runs: Run numbers, [R].
            seed: Seed. With the run number it fixes all random numbers of a run.

        Returns:
            Episode with R runs. Times are those of the log.
        """
        return self.over(self.read(), noise, runs, seed)

    def read(self) -> ResampledLog:
        """Read the log and resample it to filter steps."""
        log = read_log(find_dataset(self.root, self.folder), self.files, origin=self.origin)
        return resample_log(
            log,
            self.receiver.fix_interval_s,
            self.filter_step_s,
            self.receiver.velocity_sd is not None,
            self.start_s,
            self.end_s,
        )

    def over(self, leg: ResampledLog, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        """Draw the errors of some runs over a resampled log.

        Args:
            leg: Resampled log.
            noise: Noise regime.
            runs: Run numbers, [R].
            seed: Seed. With the run number it fixes all random numbers of a run.

        Returns:
            Episode with R runs.
        """
        log_index, draws = torch.zeros_like(runs), PhiloxStream(seed, runs)
        episode = assemble([leg], leg.time, log_index, self.tuning, self.receiver, noise, draws)
        if self.holdout is None:
            return episode
        return self.holdout.score(episode, leg, runs, self.files.reference)


@dataclass(frozen=True)
class RecordedFlights:
    """Several flights of one data set as one batch.

    Run r is flight r modulo the number of flights, each time with new errors. Short flights are
    extended to the longest one, without motion, measurements and truth.

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        folder: Folder of the log in `root`.
        tuning: Parameters that the filter assumes. The initial errors of the runs have the assumed
            distribution.
        receiver: Selection of fixes, and standard deviations of added errors.
        filter_step_s: Longest filter interval, s.
        flights: Numbers of the flights in the column `path`.
        imu_index: Number of the sensor in the column `imu`. `tuning` contains its nominal biases.
        files: Names of the tables.
        origin: lat_deg, lon_deg, h_m of the local frame. None if the files contain it.
        divergence_threshold_m: Position error, m, beyond which a run counts as diverged. None if
            the scenario does not define divergence.

    Raises:
        ValueError: if the step or the threshold is not positive, or no flight is selected. `draw`
            raises it for a missing root or folder, an invalid log, or flights with different fix
            times.
    """

    root: str | None
    folder: str
    tuning: StrapdownTuning
    receiver: FixReceiver = field(default_factory=lambda: FixReceiver(position_sd=(1.0, 1.0, 1.0)))
    filter_step_s: float = 0.2
    flights: Sequence[int] = tuple(range(1, 21))
    imu_index: int = 1
    files: LogFiles = field(default_factory=lambda: LogFiles(gnss="reference"))
    origin: Sequence[float] | None = None
    divergence_threshold_m: float | None = None

    def __post_init__(self) -> None:
        check_divergence_threshold(self.divergence_threshold_m)
        _check_seconds("scenario.filter_step_s", self.filter_step_s)
        if not self.flights:
            raise ValueError("scenario.flights must not be empty, got []. Select a flight.")

    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        """Read the flights and draw the errors of some runs.

        Args:
            noise: Noise regime.
            runs: Run numbers, [R].
            seed: Seed. With the run number it fixes all random numbers of a run.

        Returns:
            Episode with R runs. Times are relative to the start of each flight.
        """
        folder, velocity = (
            find_dataset(self.root, self.folder),
            self.receiver.velocity_sd is not None,
        )
        # only flights of the requested runs are read
        used = torch.unique(runs % len(self.flights)).tolist()
        logs = [
            read_log(folder, self.files, self.flights[i], self.imu_index, self.origin) for i in used
        ]
        legs = [
            resample_log(log, self.receiver.fix_interval_s, self.filter_step_s, velocity)
            for log in logs
        ]
        longest = max(legs, key=lambda leg: len(leg.time))
        for i, leg in zip(used, legs, strict=True):
            n = len(leg.time)
            same = np.allclose(leg.since_start, longest.since_start[:n], rtol=0.0, atol=SAME_TIME)
            if not same or not np.array_equal(leg.fix_steps, longest.fix_steps[:n]):
                raise ValueError(
                    "scenario.flights must have equal fix times, "
                    f"got different times in flight {self.flights[i]} of {folder}. Remove this flight."
                )
        log_index = torch.searchsorted(torch.tensor(used), runs % len(self.flights))
        return assemble(
            legs,
            longest.since_start,
            log_index,
            self.tuning,
            self.receiver,
            noise,
            PhiloxStream(seed, runs),
        )


def find_dataset(root: str | None, folder: str) -> Path:
    """Return the folder of a data set.

    Args:
        root: Folder of all data sets.
        folder: Name of the data set.

    Returns:
        The folder.

    Raises:
        ValueError: if data.root is not set, or does not contain the folder.
    """
    remedy = f"Set the environment variable PFBENCH_DATA or data.root to the folder with {folder}/."
    if root is None:
        raise ValueError(
            f"data.root is not set. Recorded data are not part of the package. {remedy}"
        )
    path = Path(root) / folder
    if not path.is_dir():
        raise ValueError(f"data.root must contain the folder {folder}, got {root}. {remedy}")
    return path


def encode_names(names: Sequence[str]) -> Tensor:
    """Encode names, such as G12, as character codes padded with spaces, [S, longest]."""
    longest = max(map(len, names), default=0)
    return torch.tensor(
        [[ord(letter) for letter in name.ljust(longest)] for name in names], dtype=torch.float64
    )


def assemble(
    legs: Sequence[ResampledLog],
    time: Array,
    log_index: Tensor,
    tuning: StrapdownTuning,
    receiver: FixReceiver,
    noise: NoiseRegime,
    draws: PhiloxStream,
) -> Episode:
    """Build the episode of runs over resampled logs.

    Args:
        legs: Resampled logs.
        time: Times of the steps of the longest log, s, [T].
        log_index: Index of each run's log, [R].
        tuning: Parameters that the filter assumes, for the initial errors.
        receiver: Standard deviations of added errors.
        noise: Noise regime.
        draws: Random stream of the runs.

    Returns:
        Episode with R runs.
    """
    t, longest = torch.from_numpy(time), max(legs, key=lambda leg: len(leg.time))
    fix_mask = torch.from_numpy(longest.fix_steps)
    truth = _pad([leg.truth for leg in legs], np.nan)[log_index]
    sd = receiver.sd
    y = _pad([leg.fixes for leg in legs], np.nan)[log_index][..., : len(sd)]
    # errors are drawn per fix, so that they do not depend on the filter step
    check_unit_process(noise, t)
    y[:, fix_mask] += noise.draw_errors(draws.at_step(0), receiver.channels, t[fix_mask])
    record = Record(
        y, _preintegrate_logs(legs, log_index, tuning), _draw_start(legs, log_index, tuning, draws)
    )
    groups = {"attitude": truth[..., :4], "velocity": truth[..., 4:7], "position": truth[..., 7:]}
    notes = tuple(dict.fromkeys(note for leg in legs for note in leg.notes))
    first = legs[int(log_index[0])] if len(log_index) else longest
    datasheet = {
        name: _pad([values, np.empty((len(t), 3))], np.nan)[0]
        for name, values in first.sensed().items()
    }
    return Episode(record, t, groups, truth[..., 7:], notes, datasheet)


def _draw_start(
    legs: Sequence[ResampledLog], log_index: Tensor, tuning: StrapdownTuning, draws: PhiloxStream
) -> Tensor:
    """Draw starts [R, 16], about which the true state has the assumed distribution."""
    recorded = torch.from_numpy(np.stack([leg.start for leg in legs]))[log_index]
    nominal = torch.cat([recorded, tuning.bias.expand(len(log_index), -1)], -1)
    error = (
        tuning.initial_sd * draws.at_step(0).normal("world.start", 1, len(tuning.initial_sd))[:, 0]
    )
    return StrapdownTotal(tuning).chart.add(nominal, -error)


def _preintegrate_logs(
    legs: Sequence[ResampledLog], log_index: Tensor, tuning: StrapdownTuning
) -> PreintegratedImu:
    """Preintegrate the IMU samples of each run's log."""
    force, rate, spans = (
        _pad(samples, 0.0)
        for samples in zip(*((leg.force, leg.rate, leg.spans) for leg in legs), strict=True)
    )
    bias = tuning.bias.expand(*spans.shape[:2], 6)
    gravity = torch.tensor([leg.gravity for leg in legs], dtype=torch.float64)[:, None].expand(
        spans.shape[:2]
    )
    u = (*preintegrate(force, rate, spans, bias), bias, gravity, spans.sum(-1))
    if len(legs) == 1:
        return PreintegratedImu(*u)  # leading axis 1: shared by all runs
    return PreintegratedImu(*(leaf[log_index] for leaf in u))


def _pad(arrays: Sequence[Array], fill: float) -> Tensor:
    """Stack K arrays, with each axis padded to the longest, [K, ...]."""
    out = np.full((len(arrays), *np.max([a.shape for a in arrays], axis=0)), fill)
    for row, a in zip(out, arrays, strict=True):
        row[tuple(slice(n) for n in a.shape)] = a
    return torch.from_numpy(out)


def _check_seconds(name: str, value: float) -> None:
    if not value > 0.0:
        raise ValueError(f"{name} must be positive, got {value}. Set a time in seconds.")
