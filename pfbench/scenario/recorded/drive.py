"""Recorded drives and flights with degraded fixes, scored against a reference.

All runs of a drive have the same motion. They differ in receiver errors and initial errors.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import astuple, dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode
from pfbench.files.reader_notes import announce_notes
from pfbench.model.strapdown.tuning import StrapdownTuning
from pfbench.nav.plausible_limits import PlausibleLimits
from pfbench.nav.preintegration import PreintegratedImu
from pfbench.noise.base import NoiseRegime
from pfbench.scenario.base import Scenario, check_duration
from pfbench.scenario.recorded.assembly import FixReceiver, assemble
from pfbench.scenario.recorded.fix_codes import FixCodes, check_fix_codes
from pfbench.scenario.recorded.fix_holdout import FixHoldout
from pfbench.scenario.recorded.log_reader import read_log
from pfbench.scenario.recorded.log_tables import find_dataset, list_tables
from pfbench.scenario.recorded.navigation_log import LogFiles
from pfbench.scenario.recorded.time_grid import TIME_TOLERANCE, ResampledLog, resample_log


@dataclass(frozen=True)
class RecordedDrive(Scenario):
    """One recorded log. Runs differ in receiver errors and initial errors.

    Times of an episode are those of the log.

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
        limits: Limits of the platform for the checks of the log. None for the default limits.
        holdout: Selection of withheld fixes, which are the truth instead of the reference. None
            withholds no fixes.
        fix_codes: Meaning of the column `fix` of the fixes, see `read_log`.

    Raises:
        ValueError: If a step, an interval or the threshold is not positive. `draw` raises it for a
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
    limits: PlausibleLimits | None = None
    holdout: FixHoldout | None = None
    fix_codes: FixCodes = None
    input_type = PreintegratedImu

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Measured channels: those of the fixes."""
        return self.receiver.channel_names

    def __post_init__(self) -> None:
        check_duration("scenario.filter_step_s", self.filter_step_s)
        check_fix_codes(self.fix_codes)

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        return self.over(self.read(), noise, runs, seed)

    def input_files(self) -> list[Path]:
        """List the files that `draw` reads."""
        return list_tables(self.root, self.folder, astuple(self.files))

    def read(self) -> ResampledLog:
        """Read the log and resample it to filter steps."""
        folder = find_dataset(self.root, self.folder)
        log = read_log(
            folder,
            self.files,
            origin=self.origin,
            limits=self.limits,
            fix_codes=self.fix_codes,
        )
        leg = resample_log(
            log,
            self.receiver.fix_interval_s,
            self.filter_step_s,
            self.receiver.velocity_sd is not None,
            self.start_s,
            self.end_s,
        )
        announce_notes(folder, leg.notes)
        return leg

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
class RecordedFlights(Scenario):
    """Several flights of one data set as one batch.

    Run r is flight r modulo the number of flights, each time with new errors. Short flights are
    extended to the longest one, without motion, measurements and truth. Times are relative to the
    start of each flight.

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
        limits: Limits of the platform for the checks of the log. None for the default limits.
        fix_codes: Meaning of the column `fix` of the fixes, see `read_log`.

    Raises:
        ValueError: If the step or the threshold is not positive, or no flight is selected. `draw`
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
    limits: PlausibleLimits | None = None
    fix_codes: FixCodes = None
    input_type = PreintegratedImu

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Measured channels: those of the fixes."""
        return self.receiver.channel_names

    def __post_init__(self) -> None:
        check_duration("scenario.filter_step_s", self.filter_step_s)
        check_fix_codes(self.fix_codes)
        if not self.flights:
            raise ValueError("scenario.flights must not be empty, got []. Select a flight.")

    def input_files(self) -> list[Path]:
        """List the files that `draw` reads."""
        return list_tables(self.root, self.folder, astuple(self.files))

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        folder, velocity = (
            find_dataset(self.root, self.folder),
            self.receiver.velocity_sd is not None,
        )
        # only flights of the requested runs are read
        used = torch.unique(runs % len(self.flights)).tolist()
        logs = [
            read_log(
                folder,
                self.files,
                self.flights[i],
                self.imu_index,
                self.origin,
                self.limits,
                self.fix_codes,
            )
            for i in used
        ]
        legs = [
            resample_log(log, self.receiver.fix_interval_s, self.filter_step_s, velocity)
            for log in logs
        ]
        longest = max(legs, key=lambda leg: len(leg.time))
        for i, leg in zip(used, legs, strict=True):
            n = len(leg.time)
            same = np.allclose(
                leg.since_start, longest.since_start[:n], rtol=0.0, atol=TIME_TOLERANCE
            )
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
