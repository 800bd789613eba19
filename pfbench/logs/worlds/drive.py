"""Recorded drives and flights with degraded fixes, scored against a reference or against withheld fixes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.fix_codes import FixCodes, check_fix_codes
from pfbench.logs.worlds.log_reader import read_log
from pfbench.logs.worlds.log_tables import (
    Array,
    LogFiles,
    NavigationLog,
    check_changes,
    find_dataset,
    list_tables,
    parse_numbers,
    read_table,
    swap_frd_rfu,
)
from pfbench.logs.worlds.time_grid import (
    TIME_TOLERANCE,
    FixReceiver,
    ResampledLog,
    assemble,
    resample_log,
)
from pfbench.model.strapdown import INSTRUMENT_CHANNELS
from pfbench.model.strapdown_tuning import AidedTuning, StrapdownTuning
from pfbench.nav.strapdown import PreintegratedImu
from pfbench.noise.base import (
    NoiseRegime,
    NominalNoise,
    check_unit_process,
    draw_added_errors,
)
from pfbench.scenario.base import Scenario, check_added_sd, check_duration

# All runs of a drive have the same motion. They differ in receiver errors and initial errors.


@dataclass(frozen=True)
class RecordedScenario(Scenario):
    """Recorded IMU, fixes and reference on filter steps.

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        folder: Folder of the log in `root`.
        tuning: Parameters that the filter assumes. The initial errors of the runs have the assumed
            distribution.
        receiver: Selection of measurements, and standard deviations of added errors.
        filter_step_s: Longest filter interval, s.
        files: Names of the tables.
        origin: lat_deg, lon_deg, h_m of the local frame. None if the files contain it.
        limits: Limits of the platform for the checks of the log. None for the default limits.
        fix_codes: Meaning of the column `fix` of the fixes, see `read_log`.

    Raises:
        ValueError: If the step is not positive. `draw` raises it for a missing root or folder, and an invalid log.
    """

    root: str | None
    folder: str
    tuning: Any
    receiver: Any = field(default_factory=FixReceiver)
    filter_step_s: float = 0.25
    files: LogFiles = field(default_factory=LogFiles)
    origin: Sequence[float] | None = None
    limits: PlausibleLimits | None = None
    fix_codes: FixCodes = None

    def __post_init__(self) -> None:
        check_duration("scenario.filter_step_s", self.filter_step_s)
        check_fix_codes(self.fix_codes)

    def input_files(self) -> list[Path]:
        """List the files that `draw` reads."""
        return list_tables(self.root, self.folder, astuple(self.files))

    def read_checked(self, folder: Path, **select: Any) -> NavigationLog:
        """Read and check the log in a folder.

        Args:
            folder: Folder of the tables.
            select: Other attributes of a source, such as the number of a flight.

        Returns:
            The log.
        """
        keys = ("files", "origin", "limits", "fix_codes")
        return read_log(folder, **{key: getattr(self, key) for key in keys}, **select)


@dataclass(frozen=True)
class RecordedDrive(RecordedScenario):
    """One recorded log. Runs differ in receiver errors and initial errors.

    Times of an episode are those of the log. The other attributes are those of `RecordedScenario`.

    Attributes:
        tuning: Parameters that the filter assumes.
        receiver: Selection of fixes, and standard deviations of added errors.
        start_s: Start, s of the log. None for the start of the data common to all tables.
        end_s: End, s of the log. None for the end of the data common to all tables.
        holdout: Selection of withheld fixes, which are the truth instead of the reference. None
            withholds no fixes.

    Raises:
        ValueError: If a step or an interval is not positive. `draw` raises it for a
            missing root or folder, an invalid log, or a run without withheld fixes.
    """

    tuning: StrapdownTuning
    receiver: FixReceiver = field(default_factory=FixReceiver)
    start_s: float | None = None
    end_s: float | None = None
    holdout: FixHoldout | None = None
    input_type = PreintegratedImu

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Measured channels: those of the fixes."""
        return self.receiver.channel_names

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        return self.over(self.read(), noise, runs, seed)

    def read(self) -> ResampledLog:
        """Read the log and resample it to filter steps."""
        return self.resample(self.read_checked(find_dataset(self.root, self.folder)))

    def resample(self, log: NavigationLog) -> ResampledLog:
        """Resample a log to filter steps."""
        leg = resample_log(
            log,
            self.receiver.fix_interval_s,
            self.filter_step_s,
            self.receiver.velocity_sd is not None,
            self.start_s,
            self.end_s,
        )
        announce_notes(find_dataset(self.root, self.folder), leg.notes)
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
class RecordedFlights(RecordedScenario):
    """Several flights of one data set as one batch.

    Run r is flight r modulo the number of flights, each time with new errors. Short flights are
    extended to the longest one, without motion, measurements and truth. Times are relative to the
    start of each flight. The other attributes are those of `RecordedScenario`.

    Attributes:
        tuning: Parameters that the filter assumes.
        receiver: Selection of fixes, and standard deviations of added errors.
        filter_step_s: Longest filter interval, s.
        files: Names of the tables.
        flights: Numbers of the flights in the column `path`.
        imu_index: Number of the sensor in the column `imu`. `tuning` contains its nominal biases.

    Raises:
        ValueError: If the step is not positive, or no flight is selected. `draw`
            raises it for a missing root or folder, an invalid log, or flights with different fix
            times.
    """

    tuning: StrapdownTuning
    receiver: FixReceiver = field(default_factory=lambda: FixReceiver(position_sd=(1.0, 1.0, 1.0)))
    filter_step_s: float = 0.2
    files: LogFiles = field(default_factory=lambda: LogFiles(gnss="reference"))
    flights: Sequence[int] = tuple(range(1, 21))
    imu_index: int = 1
    input_type = PreintegratedImu

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Measured channels: those of the fixes."""
        return self.receiver.channel_names

    def __post_init__(self) -> None:
        super().__post_init__()
        require(self.flights, "scenario.flights", "not be empty", "[]", "Select a flight.")

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        folder, velocity = (
            find_dataset(self.root, self.folder),
            self.receiver.velocity_sd is not None,
        )
        # only flights of the requested runs are read
        used = torch.unique(runs % len(self.flights)).tolist()
        logs = [self.read_checked(folder, path=self.flights[i], imu=self.imu_index) for i in used]
        legs = [
            resample_log(log, self.receiver.fix_interval_s, self.filter_step_s, velocity)
            for log in logs
        ]
        longest = max(legs, key=lambda leg: len(leg.time))
        for i, leg in zip(used, legs, strict=True):
            n = len(leg.time)
            require(
                np.allclose(leg.since_start, longest.since_start[:n], rtol=0.0, atol=TIME_TOLERANCE)
                and np.array_equal(leg.fix_steps, longest.fix_steps[:n]),
                "scenario.flights",
                "have equal fix times",
                f"different times in flight {self.flights[i]} of {folder}",
                "Remove this flight.",
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


# --------------------------------------------------------------------------------------------------
# Recorded flight with barometer and magnetometer readings in addition to fixes.

_COLUMNS = ("t", "p_static_kpa", "mx", "my", "mz")


@dataclass(frozen=True)
class BaroMagSensors:
    """Conversion of barometer and magnetometer readings to measurements.

    Filters receive the reading nearest to the time of each fix, also for withheld fixes.

    Attributes:
        hard_iron: Magnetic field of the aircraft, forward, right, down, gauss, [3]. It is subtracted
            from the readings.
        height_sd: Standard deviation of added height errors, m. 0 adds no errors.
        magnetic_sd: Standard deviation of added field errors, gauss. 0 adds no errors.

    Raises:
        ValueError: If the hard iron does not have three numbers, or a standard deviation is
            negative.
    """

    hard_iron: Sequence[float] = (0.0, 0.0, 0.0)
    height_sd: float = 0.0
    magnetic_sd: float = 0.0

    def __post_init__(self) -> None:
        require(
            len(self.hard_iron) == 3,
            "scenario.instruments.hard_iron",
            "have 3 numbers",
            list(self.hard_iron),
            "Set forward, right and down in gauss.",
        )
        for name, sd in (("height_sd", self.height_sd), ("magnetic_sd", self.magnetic_sd)):
            check_added_sd(f"scenario.instruments.{name}", sd)

    def make_measurements(self, fixes: MeasurementChannels) -> MeasurementChannels:
        """Append the channels of height and magnetic field to those of the fixes."""
        sd = torch.tensor([self.height_sd] + [self.magnetic_sd] * 3, dtype=torch.float64)
        return MeasurementChannels(
            torch.cat([fixes.sd, sd]),
            (*fixes.kind, "position", *["other"] * 3),
            (*fixes.source, 1, 2, 2, 2),
        )


@dataclass(frozen=True)
class RecordedAidedFlight(Scenario):
    """Recorded flight with barometer and magnetometer.

    Runs differ as in the flight, and in the initial errors of the instrument biases. The pressure
    height at the start equals the recorded height, so that the barometer bias starts at 0.

    Attributes:
        root: Folder of all data sets (configuration key data.root). It replaces `flight.root`.
        flight: Log with fixes. Its IMU table also has p_static_kpa [kPa] and mx, my, mz [gauss],
            forward, right, down.
        tuning: Parameters that the filter assumes. `flight.tuning` is `tuning.motion`.
        instruments: Conversion of the readings to measurements.

    Raises:
        ValueError: If the threshold is not positive. `draw` raises it for errors of the flight and
            for a missing column.
    """

    root: str | None
    flight: RecordedDrive
    tuning: AidedTuning
    instruments: BaroMagSensors
    input_type = PreintegratedImu

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Measured channels: those of the fixes, then those of the instruments."""
        return (*self.flight.channel_names, *INSTRUMENT_CHANNELS)

    def input_files(self) -> list[Path]:
        """List the files that `draw` reads."""
        return replace(self.flight, root=self.root).input_files()

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        flight, draws = self.flight, PhiloxStream(seed, runs)
        error_free = FixReceiver(
            flight.receiver.fix_interval_s, [0.0] * 3, flight.receiver.velocity_sd and [0.0] * 3
        )
        leg = replace(flight, root=self.root).read()
        episode = replace(flight, receiver=error_free).over(leg, NominalNoise(), runs, seed)
        fix_mask = torch.from_numpy(leg.fix_steps)
        readings = torch.from_numpy(self._read(np.concatenate([[leg.start_s], leg.time])))
        observed = torch.where(fix_mask[:, None], readings, torch.nan).expand(len(runs), -1, -1)
        y = torch.cat([episode.record.y, observed], -1)
        check_unit_process(noise, episode.time)
        channels = self.instruments.make_measurements(flight.receiver.channels)
        y[:, fix_mask] += draw_added_errors(
            noise, draws.at_step(0), channels, episode.time[fix_mask]
        )
        bias = self.tuning.bias_sd * draws.at_step(0).normal("world.bias", 1, 4)[:, 0]
        start = torch.cat(
            [
                bias.new_zeros(len(runs), 0)
                if episode.record.start is None
                else episode.record.start,
                -bias,
            ],
            -1,
        )
        note = (
            f"hard iron {list(self.instruments.hard_iron)} gauss and the pressure height at the start "
            "are subtracted from the readings"
        )
        return replace(
            episode, record=episode.record._replace(y=y, start=start), notes=(*episode.notes, note)
        )

    def _read(self, time: Array) -> Array:
        """Read relative height, m, and magnetic field (right, forward, up), [T, 4]."""
        table = read_table(
            find_dataset(self.root, self.flight.folder),
            self.flight.files.imu,
            {},
            self.flight.limits,
        )
        t, pressure, *field = parse_numbers(table, _COLUMNS).T
        check_changes(table, _COLUMNS[1:], t, np.column_stack([pressure, *field]))
        after = np.searchsorted(t, time).clip(1, len(t) - 1)
        nearest_index = np.where(time - t[after - 1] < t[after] - time, after - 1, after)
        height = pressure_height(pressure[nearest_index])
        magnetic = swap_frd_rfu(
            np.stack(field, -1)[nearest_index] - np.array(self.instruments.hard_iron)
        )
        return np.column_stack([height - height[0], magnetic])[1:]


def pressure_height(pressure: Array) -> Array:
    """Convert static pressure, kPa, to height, m [ISO 2533:1975], below 11 km."""
    return np.asarray(44330.769 * (1.0 - (pressure / 101.325) ** 0.19026324))


# --------------------------------------------------------------------------------------------------
# Withheld fixes as the truth, for logs without a more accurate reference.
#
# Position and velocity are scored at withheld fixes only. The attitude does not have a truth. It is
# compared with the reference of the log, and the report mentions this.


@dataclass(frozen=True)
class FixHoldout:
    """Periodic pattern of used and withheld fixes.

    1 and 1 withhold every second fix. 10 and 10 create gaps of ten fixes. All runs have the same
    recorded flight. With `shift_between_runs`, run r starts r fixes later in the pattern, so that
    each fix is withheld in some runs [ours].

    Attributes:
        used_fixes: Used fixes per period.
        withheld_fixes: Withheld fixes per period.
        start_s: Start of the pattern, s of the log. None for the start of the log.
        shift_between_runs: Whether the pattern depends on the run number.

    Raises:
        ValueError: If a number of fixes is below 1.
    """

    used_fixes: int = 1
    withheld_fixes: int = 1
    start_s: float | None = None
    shift_between_runs: bool = True

    def __post_init__(self) -> None:
        rule = "[1, inf] Increase it."
        require_ranges("scenario.holdout", self, used_fixes=rule, withheld_fixes=rule)

    def select(self, fix_mask: Tensor, time: Tensor, runs: Tensor) -> Tensor:
        """Select the steps that end on a withheld fix.

        Args:
            fix_mask: Mask of steps that end on a fix, [T].
            time: Times of the steps, s, [T].
            runs: Run numbers, [R].

        Returns:
            Mask, [R, T].
        """
        eligible_mask = fix_mask if self.start_s is None else fix_mask & (time >= self.start_s)
        number = torch.cumsum(eligible_mask, 0) - 1
        shift = runs[:, None] if self.shift_between_runs else torch.zeros_like(runs)[:, None]
        return eligible_mask & (
            (number + shift) % (self.used_fixes + self.withheld_fixes) >= self.used_fixes
        )

    def score(
        self, episode: Episode, leg: ResampledLog, runs: Tensor, reference: str | None
    ) -> Episode:
        """Remove the withheld fixes from an episode and make them its truth.

        Args:
            episode: Episode whose first measurement components are position, and velocity if
                measured.
            leg: Resampled log with the fixes as recorded.
            runs: Run numbers, [R].
            reference: Name of the table with the reference attitude, for the report.

        Returns:
            The episode without the withheld fixes.

        Raises:
            ValueError: If a run does not have a withheld fix.
        """
        scored, count = self.withhold(episode, leg.recorded_fixes, runs)
        notes = (
            f"position and velocity are scored at {count} withheld fixes (run 0) only. "
            "Errors of these fixes increase the NEES, so that a consistent filter exceeds its band",
            f"attitude errors are differences from {reference}, which is not a truth, and the track is from {reference}",
        )
        truth = {"attitude": episode.truth["attitude"], **scored.truth}
        return replace(scored, truth=truth, notes=(*scored.notes, *notes))

    def withhold(
        self, episode: Episode, fixes: Mapping[str, Tensor], runs: Tensor
    ) -> tuple[Episode, int]:
        """Remove the withheld fixes from an episode, and make them its only truth.

        Args:
            episode: Episode whose first measurement components are those of the fixes.
            fixes: Fixes as recorded by quantity, with `position`, [T, k]; NaN where there is none.
            runs: Run numbers, [R].

        Returns:
            The episode, and the number of withheld fixes of the first run.

        Raises:
            ValueError: If a run does not have a withheld fix.
        """
        withheld_mask = self.select(torch.isfinite(fixes["position"][:, 0]), episode.time, runs)
        require(
            withheld_mask.any(1).all(),
            "scenario.holdout",
            f"withhold a fix in each run between t = {episode.time[0]:.3f} and {episode.time[-1]:.3f}",
            self,
            "Start earlier or withhold more fixes.",
        )
        count, withheld_mask = int(withheld_mask[0].sum()), withheld_mask.unsqueeze(-1)
        truth = {name: torch.where(withheld_mask, values, torch.nan) for name, values in fixes.items()}  # fmt: skip
        record = episode.record._replace(y=torch.where(withheld_mask, torch.nan, episode.record.y))
        return replace(episode, record=record, truth=truth), count
