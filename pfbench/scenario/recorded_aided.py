"""A recorded flight with the readings of a barometer and a magnetometer beside its fixes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from pfbench.draws import MonteCarlo
from pfbench.model.strapdown_aided import BelievedAided
from pfbench.noise.regimes import Nominal, Regime, untouched_process
from pfbench.record import Channels, Episode
from pfbench.scenario.logs import frd
from pfbench.scenario.recorded import Receiver, RecordedDrive, locate
from pfbench.scenario.tables import Array, numbers, read_table

_COLUMNS = ("t", "p_static_kpa", "mx", "my", "mz")


@dataclass(frozen=True)
class Instruments:
    """How readings beside the IMU become measurements: those nearest to the fixes' times are handed out, withheld or not.

    Args:
        hard_iron: what the aircraft itself adds to the field, forward, right, down, gauss; taken off.
        height_sd, magnetic_sd: standard deviations of the errors that a regime adds, m and gauss; 0 leaves readings as recorded.

    Raises:
        ValueError: a hard iron that is not three numbers, a negative standard deviation.
    """

    hard_iron: Sequence[float] = (0.0, 0.0, 0.0)
    height_sd: float = 0.0
    magnetic_sd: float = 0.0

    def __post_init__(self) -> None:
        if len(self.hard_iron) != 3:
            raise ValueError(f"instruments.hard_iron={list(self.hard_iron)}: give three numbers, forward, right, down, in gauss")
        for name, sd in (("height_sd", self.height_sd), ("magnetic_sd", self.magnetic_sd)):
            if not sd >= 0.0:
                raise ValueError(f"instruments.{name}={sd}: give a standard deviation (0 adds nothing)")

    def beside(self, fixes: Channels) -> Channels:
        """Channels of the fixes, then of the height, then of the field."""
        sd = torch.tensor([self.height_sd] + [self.magnetic_sd] * 3, dtype=torch.float64)
        return Channels(torch.cat([fixes.sd, sd]), (*fixes.kind, "position", *["other"] * 3), (*fixes.source, 1, 2, 2, 2))


@dataclass(frozen=True)
class RecordedAided:
    """A recorded flight and its instruments; run numbers differ as in the flight, and in the initial errors of the biases.

    The pressure height at the start is taken for the recorded one, so that the barometer's bias starts from 0.

    Args:
        root: the folder of all data sets (configuration key data.root); that of `flight` is not used.
        flight: the log, with fixes handed out or withheld; its table of the IMU also has p_static_kpa [kPa] and mx, my, mz
            [gauss], forward, right, down.
        believed: what filters are told; `flight.believed` is its part `motion`.
        instruments: how readings are handed out.

    Raises:
        ValueError: on drawing, whatever the flight raises, or a missing column.
    """

    root: str | None
    flight: RecordedDrive
    believed: BelievedAided
    instruments: Instruments

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """The flight with these runs' errors; times are those of the log."""
        flight, draws = self.flight, MonteCarlo(seed, runs)
        silent = Receiver(flight.receiver.interval, [0.0] * 3, flight.receiver.velocity_sd and [0.0] * 3)
        leg = replace(flight, root=self.root).read()
        world = replace(flight, receiver=silent).over(leg, Nominal(), runs, seed)
        fixed = torch.from_numpy(leg.fixed)
        readings = torch.from_numpy(self._read(np.concatenate([[leg.begin], leg.time])))
        seen = torch.where(fixed[:, None], readings, torch.nan).expand(len(runs), -1, -1)
        y = torch.cat([world.record.y, seen], -1)
        untouched_process(noise, world.time)
        y[:, fixed] += noise.errors(draws.at(0), self.instruments.beside(flight.receiver.channels), world.time[fixed])
        bias = self.believed.bias_sd * draws.at(0).normal("world.bias", 1, 4)[:, 0]
        start = torch.cat([bias.new_zeros(len(runs), 0) if world.record.start is None else world.record.start, -bias], -1)
        note = f"hard iron {list(self.instruments.hard_iron)} gauss and the pressure height at the start taken off"
        return replace(world, record=world.record._replace(y=y, start=start), notes=(*world.notes, note))

    def _read(self, time: Array) -> Array:
        """Height above that at the first time, and field, right, forward, up, at the others [T, 4]."""
        table = read_table(locate(self.root, self.flight.folder), self.flight.files.imu, {})
        t, pressure, *field = numbers(table, _COLUMNS).T
        after = np.searchsorted(t, time).clip(1, len(t) - 1)
        nearest = np.where(time - t[after - 1] < t[after] - time, after - 1, after)
        height = pressure_height(pressure[nearest])
        magnetic = frd(np.stack(field, -1)[nearest] - np.array(self.instruments.hard_iron))
        return np.column_stack([height - height[0], magnetic])[1:]


def pressure_height(pressure: Array) -> Array:
    """Height m of a static pressure in kPa in the standard atmosphere [ISO 2533:1975], below 11 km."""
    return np.asarray(44330.769 * (1.0 - (pressure / 101.325) ** 0.19026324))
