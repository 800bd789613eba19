"""Fixes kept from the filters: where a log has no better reference, they serve as the truth.

An estimate is scored where a fix was withheld, and nowhere else. The attitude has no truth at all: it is compared with what
the log's reference says, and a report says so.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.record import Episode
from pfbench.scenario.legs import Leg


@dataclass(frozen=True)
class Withholding:
    """Which fixes are kept from the filters: from `begin` on, `given` fixes are handed out, then `withheld` are not, again and
    again.

    One and one withholds every second fix, 10 and 10 makes gaps of ten fixes. All runs follow the same recorded flight; with
    `shifted`, run r begins r fixes later in this pattern, so that over the runs every fix is withheld in its turn [ours].

    Args:
        given, withheld: numbers of fixes.
        begin: seconds of the log before which nothing is withheld; None for its start.
        shifted: runs differ in where the pattern begins.

    Raises:
        ValueError: a number below 1.
    """

    given: int = 1
    withheld: int = 1
    begin: float | None = None
    shifted: bool = True

    def __post_init__(self) -> None:
        for name, count in (("given", self.given), ("withheld", self.withheld)):
            if count < 1:
                raise ValueError(f"scenario.withholding.{name}={count}: give a whole number of fixes, 1 or more")

    def of(self, fixed: Tensor, time: Tensor, runs: Tensor) -> Tensor:
        """The steps that end on a withheld fix [R, T], of the steps that end on a fix [T] at times [T]."""
        concerned = fixed if self.begin is None else fixed & (time >= self.begin)
        number = torch.cumsum(concerned, 0) - 1
        shift = runs[:, None] if self.shifted else torch.zeros_like(runs)[:, None]
        return concerned & ((number + shift) % (self.given + self.withheld) >= self.given)

    def score(self, world: Episode, leg: Leg, runs: Tensor, reference: str) -> Episode:
        """The world of these runs over a leg without its withheld fixes, scored on them.

        Args:
            world: whose measurements begin with position, and velocity where it is measured.
            leg: with the fixes as recorded, whatever errors a regime adds to those that are handed out.
            runs: numbers of the runs [R].
            reference: name of the table with whose attitude estimates are compared.

        Raises:
            ValueError: a run from which nothing is withheld.
        """
        recorded = torch.from_numpy(leg.fixes)
        held = self.of(torch.from_numpy(leg.fixed) & ~torch.isnan(recorded[:, 0]), world.time, runs)
        if not bool(held.any(1).all()):
            raise ValueError(
                f"scenario.withholding={self}: some run has no withheld fix between t = {leg.time[0]:.3f} and "
                f"{leg.time[-1]:.3f}, so nothing to be scored on; begin earlier, or withhold more often"
            )
        notes = (
            f"position and velocity are scored on {int(held[0].sum())} withheld fixes (run 0) and nowhere else; a fix has errors "
            "of its own, which count as the filter's: NEES of a consistent filter lies above its band",
            f"attitude has no truth: its errors are differences from {reference}, and so is the track that is drawn",
        )
        held = held.unsqueeze(-1)
        position, velocity = (torch.where(held, part, torch.nan) for part in recorded.split(3, -1))
        truth = {"attitude": world.truth["attitude"], "velocity": velocity, "position": position}
        record = world.record._replace(y=torch.where(held, torch.nan, world.record.y))
        return Episode(record, world.time, truth, world.track, (*world.notes, *notes), world.sheet)
