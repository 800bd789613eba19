"""Ranges and range rates relative to a position that is fixed to the ground, without cancellation."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor

from pfbench.core.record import EACH_SATELLITE

RAW_CHANNELS = (
    f"range {EACH_SATELLITE} minus that from the local origin [m]",
    f"range rate {EACH_SATELLITE} minus that from the local origin [m/s]",
)


class Sky(Protocol):
    """Satellites about a position that is fixed to the ground, as `RawGnssInputs` has them."""

    @property
    def line(self) -> Tensor:
        """Unit vectors to the satellites."""

    @property
    def reach(self) -> Tensor:
        """Distances of the satellites."""

    @property
    def velocity(self) -> Tensor:
        """Velocities of the satellites."""


def predict_raw(p: Tensor, v: Tensor, u: Sky) -> tuple[Tensor, Tensor]:
    """Compute ranges minus those from the fixed position, and range rates, without the clock.

    With x from the fixed position and r = |reach line - x|, a range is r - reach. A rate is
    e.(V - v) - line.V, where e points to the satellite. Two ranges are not subtracted.

    Returns ranges and rates, [R, N, S] each, m and m/s. Shapes: p and v [R, N, 3].
    """
    reach = u.reach.unsqueeze(1)
    relative = (p.square().sum(-1, keepdim=True) / reach - 2 * p @ u.line.mT) / reach
    root = torch.sqrt(1 + relative)
    difference = reach * relative / (1 + root)  # r - reach
    r = reach * root
    # (e - line).V and e.v, with e = (reach line - x) / r
    line_rate = (u.line * u.velocity).sum(-1).unsqueeze(1)
    satellite_rate = -(difference * line_rate + p @ u.velocity.mT) / r
    approach = (reach * (v @ u.line.mT) - (v * p).sum(-1, keepdim=True)) / r
    return difference, satellite_rate - approach
