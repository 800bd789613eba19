"""A recorded flight without a better reference: some of its fixes are withheld from the filters and serve as the truth.

An estimate is scored where a fix was withheld, and nowhere else. The attitude has no truth at all: it is compared with what
the flight's own filter said, and a report says so.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from torch import Tensor

from pfbench.draws import MonteCarlo
from pfbench.model.strapdown_total import Believed
from pfbench.noise.regimes import Regime
from pfbench.record import Episode
from pfbench.scenario.legs import cut
from pfbench.scenario.logs import Files, read_log
from pfbench.scenario.recorded import Receiver, assemble, locate


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


@dataclass(frozen=True)
class RecordedWing:
    """One recorded flight, scored on withheld fixes; run numbers differ in the initial errors and in which fixes are withheld.

    Arguments as for `RecordedDrive`, and

    Args:
        withholding: which fixes are withheld.
        files: names of the tables; `reference` is the flight's own filter, about which the runs start and with whose attitude
            estimates are compared.

    Raises:
        ValueError: a step that is not positive; on drawing, a missing root or folder, a faulty log, or no fix withheld.
    """

    root: str | None
    folder: str
    believed: Believed
    receiver: Receiver = field(default_factory=lambda: Receiver(position_sd=(0.0, 0.0, 0.0), velocity_sd=(0.0, 0.0, 0.0)))
    withholding: Withholding = field(default_factory=Withholding)
    step: float = 0.25
    start: float | None = None
    end: float | None = None
    files: Files = field(default_factory=Files)
    origin: Sequence[float] | None = None

    def __post_init__(self) -> None:
        if not self.step > 0.0:
            raise ValueError(f"scenario.step={self.step}: give a positive number of seconds")

    def draw(self, noise: Regime, runs: Tensor, seed: int) -> Episode:
        """The flight with these runs' errors and gaps; times are those of the log."""
        log = read_log(locate(self.root, self.folder), self.files, origin=self.origin)
        leg = cut(log, self.receiver.interval, self.step, self.receiver.velocity_sd is not None, self.start, self.end)
        one = torch.zeros_like(runs)
        world = assemble([leg], leg.time, one, self.believed, self.receiver, noise, MonteCarlo(seed, runs))
        held = self.withholding.of(torch.from_numpy(leg.fixed & ~np.isnan(leg.fixes[:, 0])), world.time, runs)
        if not bool(held.any(1).all()):
            raise ValueError(
                f"scenario.withholding={self.withholding}: some run has no withheld fix between t = {leg.time[0]:.3f} and "
                f"{leg.time[-1]:.3f}, so nothing to be scored on; begin earlier, or withhold more often"
            )
        held, recorded = held.unsqueeze(-1), torch.from_numpy(leg.fixes)
        unseen = torch.full_like(recorded, torch.nan)
        truth = {"attitude": world.truth["attitude"]}
        # as recorded, whatever errors the regime adds to the fixes that are handed out
        truth["velocity"], truth["position"] = (torch.where(held, recorded, unseen)[..., part] for part in (_VELOCITY, _POSITION))
        record = world.record._replace(y=torch.where(held, torch.nan, world.record.y))
        return Episode(record, world.time, truth, world.track, (*world.notes, *self._notes(held)))

    def _notes(self, held: Tensor) -> tuple[str, ...]:
        reference = self.files.reference
        return (
            f"position and velocity are scored on {int(held[0].sum())} withheld fixes (run 0) and nowhere else; a fix has errors "
            "of its own, which count as the filter's: NEES of a consistent filter lies above its band",
            f"attitude has no truth: its errors are differences from {reference}, and so is the track that is drawn",
        )


_POSITION, _VELOCITY = slice(0, 3), slice(3, 6)
