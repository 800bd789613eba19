"""Recorded walk with IMU, raw pseudoranges and Doppler, scored against a reference.

The recorded measurements are corrected for satellite clocks, troposphere and ionosphere. Runs
differ in initial errors and in the errors that a noise regime adds to each satellite.
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
from pfbench.core.record import Episode, MeasurementChannels, Record
from pfbench.files.reader_notes import announce_notes
from pfbench.model.strapdown.tight import StrapdownTight
from pfbench.model.strapdown.tuning import TightTuning
from pfbench.nav.plausible_limits import PlausibleLimits
from pfbench.noise.base import NoiseRegime, check_unit_process
from pfbench.noise.white import NominalNoise
from pfbench.scenario.base import (
    Scenario,
    check_added_sd,
    check_duration,
)
from pfbench.scenario.plausibility.sky_checks import check_sky
from pfbench.scenario.recorded.assembly import FixReceiver, assemble, encode_names
from pfbench.scenario.recorded.fix_codes import FixCodes, check_fix_codes
from pfbench.scenario.recorded.log_reader import read_log
from pfbench.scenario.recorded.log_tables import find_dataset, list_tables
from pfbench.scenario.recorded.navigation_log import LogFiles
from pfbench.scenario.recorded.raw_gnss_log import (
    SKY,
    RawGnssLog,
    make_step_inputs,
    read_sky,
    subtract_nominal_ranges,
)
from pfbench.scenario.recorded.time_grid import ResampledLog, interpolate, resample_log


@dataclass(frozen=True)
class RawGnssReceiver:
    """Conversion of recorded pseudoranges and range rates to measurements.

    Attributes:
        fix_interval_s: Time between used epochs, s.
        range_sd: Standard deviation of added range errors, m. With 0 a noise regime can only remove
            satellites.
        rate_sd: Standard deviation of added range-rate errors, m/s.
        mask_deg: Smallest elevation, degrees.

    Raises:
        ValueError: If the interval is not positive, a standard deviation is negative, or the mask is
            outside [-90, 90].
    """

    fix_interval_s: float = 1.0
    range_sd: float = 0.0
    rate_sd: float = 0.0
    mask_deg: float = 10.0

    def __post_init__(self) -> None:
        check_duration("scenario.receiver.fix_interval_s", self.fix_interval_s)
        check_added_sd("scenario.receiver.range_sd", self.range_sd)
        check_added_sd("scenario.receiver.rate_sd", self.rate_sd)
        if not -90.0 <= self.mask_deg <= 90.0:
            raise ValueError(
                "scenario.receiver.mask_deg must be between -90 and 90, "
                f"got {self.mask_deg}. Set an elevation in degrees."
            )

    def channels(self, satellites: int) -> MeasurementChannels:
        """Return the channels of all ranges, then of all range rates."""
        sd = torch.tensor(
            [self.range_sd] * satellites + [self.rate_sd] * satellites, dtype=torch.float64
        )
        kind = ("range",) * satellites + ("rate",) * satellites
        return MeasurementChannels(sd, kind, tuple(range(satellites)) * 2)


@dataclass(frozen=True)
class RecordedWalk(Scenario):
    """One recorded log with raw measurements. Runs differ in initial and added errors.

    The nominal receiver clock has the bias and drift of the first recorded epoch at the reference.
    It is subtracted from the measurements. The initial clock errors are drawn about it.

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        folder: Folder of the log in `root`. In addition to IMU and reference it contains a table
            `pseudorange`, with one row per epoch and satellite. The columns are t, sys (G or E),
            svid, pr, prr, sd_pr, sd_prr, sx..sz, svx..svz, sclk, sclkd, tropo, iono in SI units,
            and az, el in degrees.
        tuning: Parameters that the filter assumes. The initial errors of the runs have the assumed
            distribution.
        receiver: Selection of measurements, and standard deviations of added errors.
        filter_step_s: Longest filter interval, s.
        start_s: Start, s of the log. None for the start of the log.
        end_s: End, s of the log. None for the end of the log.
        files: Names of the tables. Steps end at the times of `gnss`.
        origin: lat_deg, lon_deg, h_m of the local frame. None if the files contain it.
        limits: Limits of the platform for the checks of the log. None for the default limits.
        fix_codes: Meaning of the column `fix` of the fixes, see `read_log`.

    Raises:
        ValueError: If the step or the threshold is not positive. `draw` raises it for a missing root
            or folder, an invalid log, a start without GPS satellites, or a regime that changes the
            process noise.
    """

    root: str | None
    folder: str
    tuning: TightTuning
    receiver: RawGnssReceiver = field(default_factory=RawGnssReceiver)
    filter_step_s: float = 0.25
    start_s: float | None = None
    end_s: float | None = None
    files: LogFiles = field(default_factory=lambda: LogFiles(gnss="reference"))
    origin: Sequence[float] | None = None
    limits: PlausibleLimits | None = None
    fix_codes: FixCodes = None
    channel_names, input_type = StrapdownTight.channel_names, StrapdownTight.input_type

    def __post_init__(self) -> None:
        check_duration("scenario.filter_step_s", self.filter_step_s)
        check_fix_codes(self.fix_codes)

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        leg, gnss_log = self._read()
        draws, fix_mask = PhiloxStream(seed, runs), torch.from_numpy(leg.fix_steps)
        motion = assemble(
            [leg],
            leg.time,
            torch.zeros_like(runs),
            self.tuning.motion,
            FixReceiver(),
            NominalNoise(),
            draws,
        )
        time = np.concatenate([[leg.start_s], leg.time])
        measurements, notes = subtract_nominal_ranges(gnss_log, time, leg.start[4:7])
        y = torch.where(fix_mask[:, None], torch.from_numpy(measurements[1:]), torch.nan).repeat(
            len(runs), 1, 1
        )
        check_unit_process(noise, motion.time)
        # errors are drawn per epoch, so that they do not depend on the filter step
        y[:, fix_mask] += noise.draw_errors(
            draws.at_step(0), self.receiver.channels(len(gnss_log.names)), motion.time[fix_mask]
        )
        record = Record(
            y,
            make_step_inputs(motion.record.u, gnss_log),
            self._draw_start(motion.record.start, draws),
        )
        azimuth, elevation = (
            torch.from_numpy(a[1:]) for a in (gnss_log.azimuth, gnss_log.elevation)
        )
        datasheet = {
            "azimuth": azimuth,
            "elevation": elevation,
            "satellites": encode_names(gnss_log.names),
        }
        return Episode(
            record,
            motion.time,
            motion.truth,
            motion.track,
            (*motion.notes, *notes),
            motion.datasheet | datasheet,
        )

    def input_files(self) -> list[Path]:
        """List the files that `draw` reads."""
        return list_tables(self.root, self.folder, (*astuple(self.files), SKY))

    def _draw_start(self, motion: Tensor | None, draws: PhiloxStream) -> Tensor:
        """Draw starts [R, 19], about which the true state has the assumed distribution."""
        # the true clock is the nominal one
        clock = self.tuning.clock_sd * draws.at_step(0).normal("world.clock", 1, 3)[:, 0]
        return torch.cat([clock.new_zeros(len(clock), 0) if motion is None else motion, -clock], -1)

    def _read(self) -> tuple[ResampledLog, RawGnssLog]:
        """Read the log on filter steps and the raw measurements relative to the start."""
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
            start=self.start_s,
            end=self.end_s,
        )
        gnss_log = read_sky(
            folder, np.concatenate([[leg.start_s], leg.time]), self.receiver.mask_deg, self.origin
        )
        time = np.concatenate([[leg.start_s], leg.time])
        motion = interpolate(log.reference, time)
        notes = check_sky(gnss_log, time, motion, self.limits or PlausibleLimits())
        leg = leg._replace(notes=(*leg.notes, *notes))
        announce_notes(folder, leg.notes)
        start = motion[0, 7:]
        return leg, gnss_log._replace(satellite_position=gnss_log.satellite_position - start)
