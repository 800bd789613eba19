"""Synthetic aperture radar with a barometer as aids of an INS: heading, position, height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.nav import earth
from pfbench.nav.aiding import Aided, Flown
from pfbench.nav.sensors import DEG_H
from pfbench.record import Channels

_DEG = DEG_H * 3600.0
_KINDS = ("angle", "position", "position", "position")
_SOURCES = (0, 0, 0, 1)  # the radar with its map gives three components, the barometer the fourth


@dataclass(frozen=True)
class Sar:
    """A radar whose images are matched with a map (heading, latitude, longitude), and a barometric altimeter.

    What is measured is INS minus instrument [Yan et al. 2016, eq. 4]: heading in rad, then North, East, Up in metres where the
    paper has latitude and longitude in rad; metres are those of the true position [ours]. The paper's table of sizes is lost;
    the defaults are typical of the class [ours].

    Args:
        heading_sd_deg: standard deviation of the radar's heading, degrees.
        position_sd: of its position, North, East [2] m.
        height_sd: of the barometer, m.

    Raises:
        ValueError: a number that is not positive, or not two of position.
    """

    heading_sd_deg: float = 0.05
    position_sd: Sequence[float] = (20.0, 20.0)
    height_sd: float = 10.0

    def __post_init__(self) -> None:
        if len(self.position_sd) != 2:
            raise ValueError(f"receiver.position_sd={list(self.position_sd)}: give two standard deviations, North and East")
        sizes = {"heading_sd_deg": [self.heading_sd_deg], "position_sd": self.position_sd, "height_sd": [self.height_sd]}
        for name, values in sizes.items():
            if not all(value > 0.0 for value in values):
                raise ValueError(f"receiver.{name}={list(values)}: give positive standard deviations")

    @property
    def sd(self) -> Tensor:
        """Heading rad, position North, East, Up m [4]."""
        return torch.tensor([self.heading_sd_deg * _DEG, *self.position_sd, self.height_sd], dtype=torch.float64)

    @property
    def channels(self) -> Channels:
        return Channels(self.sd, _KINDS, _SOURCES)

    def aid(self, flown: Flown, draws: Draws, process: Tensor) -> Aided:
        """INS minus instruments."""
        ins = flown.ins
        turned = heading_difference(ins.dcm_end[..., 1], flown.dcm[..., 1])
        apart = (ins.pos_end - flown.pos) * earth.metre_scale(flown.pos)
        return Aided(torch.cat([turned.unsqueeze(-1), apart], -1), ins)


def heading_difference(a: Tensor, b: Tensor) -> Tensor:
    """Heading of a minus heading of b, clockwise from North, the short way round: [..., 3], [..., 3] -> [...] rad.

    Both point along a body's forward axis in East, North, Up: the second column of a body-to-level matrix.
    """
    east, north, _ = a.unbind(-1)
    other_east, other_north, _ = b.unbind(-1)
    # not atan2 - atan2: that would lose digits of a small difference, and would have to be wrapped
    return torch.atan2(east * other_north - north * other_east, north * other_north + east * other_east)
