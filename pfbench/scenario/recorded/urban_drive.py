"""Recorded city drive with raw pseudoranges and odometry.

`urban_error_fit` estimates the distribution of the range errors.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record
from pfbench.model.pseudorange_errors import NormalRangeError
from pfbench.model.urban_gnss import UrbanGnss, UrbanTuning
from pfbench.nav.plausible_limits import PlausibleLimits
from pfbench.noise.base import NoiseRegime, check_unit_process
from pfbench.scenario.base import (
    Scenario,
    check_added_sd,
    check_duration,
)
from pfbench.scenario.recorded.log_tables import find_dataset, list_tables
from pfbench.scenario.recorded.urban_log import (
    TABLES,
    UrbanLog,
    interpolate_reference,
    line_of_sight_directions,
    read_drive,
    reduce_ranges,
    select_epochs,
    select_stretch,
)


@dataclass(frozen=True)
class PseudorangeReceiver:
    """Conversion of recorded pseudoranges to measurements.

    Attributes:
        fix_interval_s: Time between used epochs, s.
        range_sd: Standard deviation of added range errors, m. With 0 a noise regime can only remove
            satellites.
        clock_drift: Nominal drift of the receiver clock, m/s. It is subtracted from the ranges.

    Raises:
        ValueError: If the interval is not positive, or range_sd is negative.
    """

    fix_interval_s: float = 1.0
    range_sd: float = 0.0
    clock_drift: float = -49.7

    def __post_init__(self) -> None:
        check_duration("scenario.receiver.fix_interval_s", self.fix_interval_s)
        check_added_sd("scenario.receiver.range_sd", self.range_sd)


@dataclass(frozen=True)
class UrbanDrive(Scenario):
    """One recorded city drive. Runs differ in initial and added errors.

    Steps end at the epochs of the odometry. Steps at intervals of `receiver.fix_interval_s` have
    pseudoranges. The true clock bias at the start is the 20 % quantile of the GPS range residuals
    against the reference, since delays are not negative. The nominal drift, inter-system bias, wheel
    scale and yaw-rate bias are true when starts are drawn.

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        folder: Folder of the drive in `root`.
        tuning: Parameters that the filter assumes. The initial errors of the runs have the assumed
            distribution.
        receiver: Selection of pseudoranges, and standard deviation of added errors.
        start_s: Start, s of the drive. None for the start of the drive.
        end_s: End, s of the drive. None for the end of the drive.
        limits: Limits of the platform for the checks of the log. None for the default limits.

    Raises:
        ValueError: If the threshold is not positive. `draw` raises it for a missing root or folder,
            an invalid table, fewer than two epochs, a start without heading, or a regime that
            changes the process noise.
    """

    root: str | None
    folder: str
    tuning: UrbanTuning
    receiver: PseudorangeReceiver = field(default_factory=PseudorangeReceiver)
    start_s: float | None = None
    end_s: float | None = None
    limits: PlausibleLimits | None = None
    channel_names, input_type = UrbanGnss.channel_names, UrbanGnss.input_type

    def input_files(self) -> list[Path]:
        """List the files that `draw` reads."""
        return list_tables(self.root, self.folder, TABLES)

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        drive = select_stretch(
            read_drive(find_dataset(self.root, self.folder), self.limits), self.start_s, self.end_s
        )
        draws = PhiloxStream(seed, runs)
        time, (reduced, inputs) = (
            torch.from_numpy(drive.time[1:]),
            reduce_ranges(drive, self.receiver.clock_drift),
        )
        truth = {
            name: values[1:].expand(len(runs), -1, -1)
            for name, values in interpolate_reference(drive).items()
        }
        clock_bias = np.nanquantile(
            reduced[0, [name.startswith("G") for name in drive.satellites]].numpy(), 0.2
        )
        epochs = select_epochs(drive.time, self.receiver.fix_interval_s)[1:]
        y = torch.where(
            torch.from_numpy(epochs)[:, None], reduced[1:] - clock_bias, torch.nan
        ).repeat(len(runs), 1, 1)
        satellites = len(drive.satellites)
        sd = torch.full((satellites,), self.receiver.range_sd, dtype=torch.float64)
        channels = MeasurementChannels(sd, ("range",) * satellites, tuple(range(satellites)))
        check_unit_process(noise, time)
        y[:, epochs] += noise.draw_errors(draws.at_step(0), channels, time[epochs])
        record = Record(y, inputs, self._draw_start(drive, draws))
        track = torch.cat([truth["position"], truth["height"]], -1)
        notes = (f"clock: nominal drift {self.receiver.clock_drift} m/s subtracted", *drive.notes)
        return Episode(record, time, truth, track, notes, line_of_sight_directions(drive))

    def _draw_start(self, drive: UrbanLog, draws: PhiloxStream) -> Tensor:
        """Draw starts [R, 9], about which the reference has the assumed distribution."""
        heading = interpolate_reference(drive)["heading"][0]
        if bool(torch.isnan(heading)):
            raise ValueError(
                "scenario.start_s must be a time at which the car moves, "
                f"got {self.start_s} (standing at {drive.time[0]} s). Select another start."
            )
        model = UrbanGnss(self.tuning, NormalRangeError())
        true = torch.cat([heading.new_zeros(3), heading, heading.new_zeros(5)])
        error = model.p0 * draws.at_step(0).normal("world.start", 1, len(model.p0))[:, 0]
        return model.chart.add(true.expand_as(error), -error)
