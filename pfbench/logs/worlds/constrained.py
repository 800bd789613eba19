"""Recorded drive with constraints of the motion and an odometer as further components of its measurements."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode
from pfbench.logs.worlds.drive import RecordedDrive
from pfbench.logs.worlds.log_tables import NavigationLog, find_dataset
from pfbench.logs.worlds.odometer import Odometer
from pfbench.logs.worlds.standing import detect_standing
from pfbench.logs.worlds.time_grid import ResampledLog
from pfbench.model.constraints import Constraints
from pfbench.noise.base import NoiseRegime


@dataclass(frozen=True)
class ConstrainedDrive(RecordedDrive):
    """Recorded drive with further components; the other attributes are those of `RecordedDrive`.

    The components depend on the IMU, the fixes and the odometer. The reference decides the thresholds of
    standing, and nothing else. Noise regimes change the fixes alone.

    Attributes:
        constraints: Components that are measured. The model must have the same.
        odometer: Source of the speed of the wheels. None without `constraints.odometer_sd`.

    Raises:
        ValueError: If a constraint needs what the log does not have; see also `RecordedDrive`.
    """

    constraints: Constraints = field(default_factory=Constraints)
    odometer: Odometer | None = None

    def __post_init__(self) -> None:
        super().__post_init__()
        require(
            (self.odometer is None) == (self.constraints.odometer_sd is None),
            "scenario.odometer",
            "be null without, and a source of speeds with, constraints.odometer_sd",
            self.odometer,
            "Set both, or none: scenario.odometer._target_=pfbench.scenario.RecordedOdometer",
        )

    @property
    @override
    def channel_names(self) -> tuple[str, ...]:
        constraints = self.constraints
        return (*constraints.name_fixes(super().channel_names), *constraints.channel_names)

    @override
    def input_files(self) -> list[Path]:
        tables = self.odometer.list_files(self.root, self.folder) if self.odometer else []
        return [*super().input_files(), *tables]

    @override
    def draw(self, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        folder = find_dataset(self.root, self.folder)
        log = self.read_checked(folder)
        leg = self.resample(log)
        episode = self.over(leg, noise, runs, seed)
        extra, notes = self._observe_standing(log, leg)
        truth = dict(episode.truth)
        if self.odometer is not None:
            draws = PhiloxStream(seed, runs).at_step(0)
            extra.append(self.odometer.measure(folder, leg, draws).unsqueeze(-1))
            true = self.odometer.make_truth(len(leg.time))
            truth |= {name: a.expand(len(runs), -1, -1) for name, a in true.items()}
        y = [episode.record.y, *(a.expand(len(runs), -1, -1) for a in extra)]
        start = (episode.record.start, self.constraints.start.expand(len(runs), -1))
        record = episode.record._replace(
            y=torch.cat(y, -1),
            start=torch.cat([a for a in start if a is not None], -1),
            spread=self._extend_spread(episode.record.spread),
        )
        return replace(episode, record=record, truth=truth, notes=(*episode.notes, *notes))

    def _extend_spread(self, spread: Tensor | None) -> Tensor | None:
        """Add the standard deviations of the states of the constraints to the root of a start."""
        if spread is None:
            return None
        sds = [sd for _, _, sd in self.constraints.states.values()]
        return torch.stack([torch.block_diag(root, *map(torch.diag, sds)) for root in spread])

    def _observe_standing(
        self, log: NavigationLog, leg: ResampledLog
    ) -> tuple[list[Tensor], tuple[str, ...]]:
        """Return the components without an odometer, each [1, T, k], and notes."""
        constraints, zero = self.constraints, torch.zeros(1, len(leg.time), 3, dtype=torch.float64)
        extra = [zero[..., :2]] if constraints.non_holonomic_sd is not None else []
        if not constraints.needs_standing:
            return extra, ()
        standing, note = detect_standing(log, leg.time)
        mask = torch.from_numpy(standing)[:, None]
        rate = torch.from_numpy(leg.sensed()["rate"])
        sources = ((constraints.zero_velocity_sd, zero), (constraints.zero_rate_sd, rate))
        extra += [torch.where(mask, a, torch.nan) for sd, a in sources if sd is not None]
        return extra, (note,)
