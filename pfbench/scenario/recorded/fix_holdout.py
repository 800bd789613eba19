"""Withheld fixes as the truth, for logs without a more accurate reference.

Position and velocity are scored at withheld fixes only. The attitude does not have a truth. It is
compared with the reference of the log, and the report mentions this.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.core.record import Episode
from pfbench.scenario.recorded.time_grid import ResampledLog


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
        for name, count in (
            ("used_fixes", self.used_fixes),
            ("withheld_fixes", self.withheld_fixes),
        ):
            if count < 1:
                raise ValueError(
                    f"scenario.holdout.{name} must be at least 1, got {count}. Increase it."
                )

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

    def score(self, episode: Episode, leg: ResampledLog, runs: Tensor, reference: str) -> Episode:
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
        recorded = torch.from_numpy(leg.fixes)
        withheld_mask = self.select(
            torch.from_numpy(leg.fix_steps) & ~torch.isnan(recorded[:, 0]), episode.time, runs
        )
        if not bool(withheld_mask.any(1).all()):
            raise ValueError(
                "scenario.holdout must withhold a fix in each run between "
                f"t = {leg.time[0]:.3f} and {leg.time[-1]:.3f}, got {self}. "
                "Start earlier or withhold more fixes."
            )
        notes = (
            f"position and velocity are scored at {int(withheld_mask[0].sum())} withheld fixes (run 0) only. "
            "Errors of these fixes increase the NEES, so that a consistent filter exceeds its band",
            f"attitude errors are differences from {reference}, which is not a truth, and the track is from {reference}",
        )
        withheld_mask = withheld_mask.unsqueeze(-1)
        position, velocity = (
            torch.where(withheld_mask, values, torch.nan) for values in recorded.split(3, -1)
        )
        truth = {"attitude": episode.truth["attitude"], "velocity": velocity, "position": position}
        record = episode.record._replace(y=torch.where(withheld_mask, torch.nan, episode.record.y))
        return Episode(
            record, episode.time, truth, episode.track, (*episode.notes, *notes), episode.datasheet
        )
