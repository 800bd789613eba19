"""Own logs: with a reference, and without one of the attitude, from a start by level and course."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.record import Episode, MeasuredTruth
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.worlds.constrained import ConstrainedDrive
from pfbench.logs.worlds.corrections import LogCorrections
from pfbench.logs.worlds.drive import RecordedDrive
from pfbench.logs.worlds.log_reader import check_corrections
from pfbench.logs.worlds.log_tables import Array, NavigationLog, find_dataset
from pfbench.logs.worlds.odometer import SimulatedOdometer
from pfbench.logs.worlds.start_alignment import StartAlignment, StartEstimate
from pfbench.logs.worlds.time_grid import ResampledLog, interpolate
from pfbench.noise.base import NoiseRegime

HELD_OUT = "held-out fixes"


@dataclass(frozen=True)
class UserLog(ConstrainedDrive):
    """Recorded drive with corrections of its tables.

    The other attributes are those of `ConstrainedDrive`.

    Attributes:
        corrections: Corrections that the reader applies before its checks.
    """

    corrections: LogCorrections = field(default_factory=LogCorrections)

    @override
    def read_checked(self, folder: Path, **select: Any) -> NavigationLog:
        return super().read_checked(folder, corrections=self.corrections, **select)


@dataclass(frozen=True)
class AlignedLog(UserLog):
    """Own log whose filters start from level and course, not from a reference.

    `files.reference` is None without a reference, or names a table of positions. Errors are distances to the fixes that
    `holdout` withholds, or, without it, to the positions of the reference. The attitude is estimated and not scored.
    The other attributes are those of `UserLog`.

    Attributes:
        alignment: Search for the start.

    Raises:
        ValueError: If a correction or the odometer needs the attitude of a reference; see also `UserLog`.
    """

    alignment: StartAlignment = field(default_factory=StartAlignment)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_corrections(self.corrections, self.files.reference is not None)
        require(
            not isinstance(self.odometer, SimulatedOdometer),
            "scenario.odometer",
            "not be simulated, which needs a reference",
            "one that is",
            "Use a table of speeds: pfbench.scenario.RecordedOdometer",
        )

    @override
    def read_checked(self, folder: Path, **select: Any) -> NavigationLog:
        return super().read_checked(folder, has_attitude=False, **select)

    @override
    def resample(self, log: NavigationLog) -> ResampledLog:
        start = self.alignment.find(log, self.tuning, self.start_s)
        leg = replace(self, start_s=start.time)._resample_from(log, start)
        announce_notes(find_dataset(self.root, self.folder), (start.note,))
        return leg

    def _resample_from(self, log: NavigationLog, start: StartEstimate) -> ResampledLog:
        """Resample the log from a start; positions are relative to it."""
        leg = super().resample(log)
        truth, shift = leg.truth.copy(), start.state[7:] - find_start(log, leg)
        truth[:, 7:] -= shift
        fixes = leg.fixes.copy()
        fixes[:, :3] -= shift
        state = np.concatenate([start.state[:7], np.zeros(3)])
        return leg._replace(truth=truth, fixes=fixes, start=state, start_sd=start.sd, notes=(*leg.notes, start.note))  # fmt: skip

    @override
    def over(self, leg: ResampledLog, noise: NoiseRegime, runs: Tensor, seed: int) -> Episode:
        episode = RecordedDrive.over(replace(self, holdout=None), leg, noise, runs, seed)
        if self.holdout is None and self.files.reference:
            truth = {name: episode.truth[name] for name in ("velocity", "position")}
            note = "the attitude is not scored: the log has no reference of it"
            return replace(episode, truth=truth, notes=(*episode.notes, note))
        if self.holdout is None:
            note = "nothing is scored: the log has no reference, and no fix is withheld"
            truth = {"position": torch.full_like(episode.truth["position"], torch.nan)}
            return replace(episode, truth=truth, notes=(*episode.notes, note))
        scored, count = self.holdout.withhold(episode, leg.recorded_fixes, runs)
        sd = self.tuning.measurement_sd
        names = ("position", "velocity") if len(sd) == 6 else ("position",)
        truth = {name: scored.truth[name] for name in names}
        measured = MeasuredTruth(HELD_OUT, dict(zip(names, sd.split(3), strict=True)))
        notes = (
            f"errors are distances to {count} {HELD_OUT} (run 0), which the filter does not get; their standard deviations "
            "are part of NEES, scores and coverage. The attitude is not scored, and the track is that of the fixes",
            "runs differ in the fixes that are withheld and in the numbers of the filter: they are parts of one log",
        )
        return replace(scored, truth=truth, measured_truth=measured, notes=(*episode.notes, *notes))


def find_start(log: NavigationLog, leg: ResampledLog) -> Array:
    """Return the position of the reference at the start of a resampled log, m, [3]."""
    return interpolate(log.reference, np.array([leg.start_s]))[0, 7:]
