"""Speed of the wheels of a recorded drive: a table of the log, or simulated from the reference."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.logs.worlds.log_tables import (
    check_changes,
    list_tables,
    parse_numbers,
    read_table,
    read_times,
)
from pfbench.logs.worlds.time_grid import ResampledLog
from pfbench.nav.strapdown import rotate

_LONGEST = 1.9  # intervals of the table; the speed is missing in a longer gap


class Odometer(Protocol):
    """Source of the speed of the wheels."""

    def list_files(self, root: str | None, folder: str) -> list[Path]:
        """List the files that it reads.

        Args:
            root: Folder of all data sets.
            folder: Folder of the log.

        Returns:
            Files.
        """

    def measure(self, folder: Path, leg: ResampledLog, draws: RandomStream) -> Tensor:
        """Measure the speed at the end of each step.

        Args:
            folder: Folder of the log.
            leg: Log on its steps.
            draws: Random stream of the runs.

        Returns:
            Speed, m/s, [R or 1, T]. NaN where it is missing.
        """

    def make_truth(self, steps: int) -> dict[str, Tensor]:
        """Make the true scale error, if it is known.

        Args:
            steps: Number of steps.

        Returns:
            Scale error, [T, 1], by the name of its group.
        """


@dataclass(frozen=True)
class RecordedOdometer(Odometer):
    """Speeds of a table with columns t and v_fwd, interpolated to the ends of the steps.

    Attributes:
        table: Name of the table in the folder of the log.
    """

    table: str = "odometer"

    @override
    def list_files(self, root: str | None, folder: str) -> list[Path]:
        return list_tables(root, folder, (self.table,))

    @override
    def measure(self, folder: Path, leg: ResampledLog, draws: RandomStream) -> Tensor:
        table = read_table(folder, self.table, {})
        time, speed = read_times(table, 1.0), parse_numbers(table, ("v_fwd",))
        check_changes(table, ("v_fwd",), time, speed)
        after = np.clip(np.searchsorted(time, leg.time), 1, len(time) - 1)
        near = np.diff(time)[after - 1] <= _LONGEST * np.median(np.diff(time))
        inside = (leg.time >= time[0]) & (leg.time <= time[-1])
        values = np.interp(leg.time, time, speed[:, 0])
        return torch.from_numpy(np.where(near & inside, values, np.nan)).unsqueeze(0)

    @override
    def make_truth(self, steps: int) -> dict[str, Tensor]:
        return {}  # unknown


@dataclass(frozen=True)
class SimulatedOdometer(Odometer):
    """Forward speed of the reference times one plus a scale error, with white noise.

    Attributes:
        scale_error: Relative error of the speed.
        sd: Standard deviation of the noise of a step, m/s. 0 for none.

    Raises:
        ValueError: If the scale error is not above -1, or the standard deviation is negative.
    """

    scale_error: float = -0.02
    sd: float = 0.1

    def __post_init__(self) -> None:
        require_ranges("scenario.odometer", self, scale_error="(-1, inf)", sd="[0, inf)")

    @override
    def list_files(self, root: str | None, folder: str) -> list[Path]:
        return []

    @override
    def measure(self, folder: Path, leg: ResampledLog, draws: RandomStream) -> Tensor:
        q, v = torch.from_numpy(leg.truth[:, :4]), torch.from_numpy(leg.truth[:, 4:7])
        forward = rotate(torch.cat([q[:, :1], -q[:, 1:]], -1), v)[:, 1]
        errors = draws.normal("world.odometer", len(forward), 1)[..., 0]
        return (1.0 + self.scale_error) * forward + self.sd * errors

    @override
    def make_truth(self, steps: int) -> dict[str, Tensor]:
        return {"odometer_scale": torch.full((steps, 1), self.scale_error, dtype=torch.float64)}
