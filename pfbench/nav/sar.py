"""Synthetic aperture radar and barometer as INS aids: heading, position, height."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels
from pfbench.nav import earth
from pfbench.nav.aiding import POSITION_DIFFERENCES, AidingData, AidingSensor, FlightSolution
from pfbench.nav.imu_errors import DEG_H
from pfbench.nav.strapdown import InsIntervals

_DEG = DEG_H * 3600.0
_KINDS = ("angle", "position", "position", "position")
_SOURCES = (0, 0, 0, 1)  # the radar with its map gives three components, the barometer the fourth


@dataclass(frozen=True)
class SarSensor(AidingSensor):
    """A radar with map matching (heading, position) and a barometric altimeter.

    The measurement is INS minus instrument [Yan et al. 2016, eq. 4]: heading in rad, then North,
    East, Up in metres, where the paper has latitude and longitude in rad. Metres are taken at the
    true position [ours]. The paper's table of noise sizes is lost, so the defaults are typical
    values for such instruments [ours].

    Attributes:
        heading_sd_deg: Standard deviation of the radar heading, deg.
        position_sd: Standard deviation of the radar position North, East, [2], m.
        height_sd: Standard deviation of the barometric height, m.

    Raises:
        ValueError: If a number is not positive, or `position_sd` has not two entries.
    """

    heading_sd_deg: float = 0.05
    position_sd: Sequence[float] = (20.0, 20.0)
    height_sd: float = 10.0
    channel_names = ("INS minus measured heading [rad]", *POSITION_DIFFERENCES)
    input_type = InsIntervals

    def __post_init__(self) -> None:
        if len(self.position_sd) != 2:
            raise ValueError(
                f"receiver.position_sd must be two standard deviations, "
                f"got {list(self.position_sd)}. "
                "Give North and East."
            )
        sizes = {
            "heading_sd_deg": [self.heading_sd_deg],
            "position_sd": self.position_sd,
            "height_sd": [self.height_sd],
        }
        for name, values in sizes.items():
            if not all(value > 0.0 for value in values):
                raise ValueError(
                    f"receiver.{name} must be positive, got {list(values)}. "
                    "Give standard deviations."
                )

    @property
    def sd(self) -> Tensor:
        """Standard deviation of heading rad, position North, East, Up m, [4]."""
        return torch.tensor(
            [self.heading_sd_deg * _DEG, *self.position_sd, self.height_sd], dtype=torch.float64
        )

    @property
    @override
    def channels(self) -> MeasurementChannels:
        return MeasurementChannels(self.sd, _KINDS, _SOURCES)

    @override
    def measure(self, flown: FlightSolution, draws: RandomStream, process: Tensor) -> AidingData:
        ins = flown.ins
        heading_error = compute_heading_difference(ins.dcm_end[..., 1], flown.dcm[..., 1])
        position_error = (ins.pos_end - flown.pos) * earth.metre_scale(flown.pos)
        return AidingData(torch.cat([heading_error.unsqueeze(-1), position_error], -1), ins)


def compute_heading_difference(a: Tensor, b: Tensor) -> Tensor:
    """Compute heading of a minus heading of b, clockwise from North, in [-pi, pi].

    Args:
        a: Forward axis of a body in East, North, Up (second column of its matrix), [..., 3].
        b: Forward axis of the other body, [..., 3].

    Returns:
        Difference, [...], rad.
    """
    a_east, a_north, _ = a.unbind(-1)
    b_east, b_north, _ = b.unbind(-1)
    # not atan2 - atan2: it loses digits of a small difference and needs wrapping
    return torch.atan2(a_east * b_north - a_north * b_east, a_north * b_north + a_east * b_east)
