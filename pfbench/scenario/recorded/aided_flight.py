"""Recorded flight with barometer and magnetometer readings in addition to fixes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels
from pfbench.model.strapdown.aided import INSTRUMENT_CHANNELS
from pfbench.model.strapdown.tuning import AidedTuning
from pfbench.nav.preintegration import PreintegratedImu
from pfbench.noise.base import NoiseRegime, check_unit_process
from pfbench.noise.white import NominalNoise
from pfbench.scenario.base import Scenario, check_added_sd
from pfbench.scenario.plausibility.column_checks import check_changes
from pfbench.scenario.recorded.assembly import FixReceiver
from pfbench.scenario.recorded.drive import RecordedDrive
from pfbench.scenario.recorded.log_tables import (
    Array,
    find_dataset,
    parse_numbers,
    read_table,
)
from pfbench.scenario.recorded.navigation_log import swap_frd_rfu

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
        if len(self.hard_iron) != 3:
            raise ValueError(
                "scenario.instruments.hard_iron must have 3 numbers, "
                f"got {list(self.hard_iron)}. Set forward, right and down in gauss."
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
        y[:, fix_mask] += noise.draw_errors(
            draws.at_step(0),
            self.instruments.make_measurements(flight.receiver.channels),
            episode.time[fix_mask],
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
