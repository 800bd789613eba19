"""Delays of GNSS signals in the atmosphere: Saastamoinen's troposphere and the broadcast ionosphere of GPS."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.nav.orbits import LIGHT

_HUMIDITY = 0.5  # relative, of the standard atmosphere
_NIGHT, _PEAK = 5e-9, 50400.0  # s; delay at night, and local time of the largest delay
_LEAST_PERIOD = 72000.0  # s


class Sight(NamedTuple):
    """Place at which a signal arrives, and its direction.

    Attributes:
        receiver: Latitude, longitude, height, rad and m, [..., 3].
        azimuth: Clockwise from North, rad, [..., S].
        elevation: rad, [..., S].
    """

    receiver: Tensor
    azimuth: Tensor
    elevation: Tensor


def delay_in_troposphere(sight: Sight) -> Tensor:
    """Compute the delay in a standard atmosphere, m, [..., S].

    Zenith delays of the dry and the wet part [Saastamoinen 1972], and the mapping function of
    Black and Eisner [1984], which holds above 5 degrees.
    """
    latitude, _, height = (a.unsqueeze(-1) for a in sight.receiver.unbind(-1))
    h = height.clamp(0.0, 1.1e4)
    pressure = 1013.25 * (1.0 - 2.2557e-5 * h) ** 5.2568  # hPa
    temperature = 288.15 - 6.5e-3 * h
    vapour = 6.108 * _HUMIDITY * torch.exp((17.15 * temperature - 4684.0) / (temperature - 38.45))
    dry = 0.0022768 * pressure / (1.0 - 0.00266 * torch.cos(2.0 * latitude) - 2.8e-7 * h)
    wet = 0.002277 * (1255.0 / temperature + 0.05) * vapour
    return (dry + wet) * 1.001 / torch.sqrt(0.002001 + torch.sin(sight.elevation) ** 2)


def delay_in_ionosphere(sight: Sight, time: Tensor, coefficients: Sequence[float]) -> Tensor:
    """Compute the delay on 1575.42 MHz by the broadcast model of GPS, m, [..., S].

    [Klobuchar 1987; IS-GPS-200, 20.3.3.5.2.5] Angles of the model are in half turns.

    Shapes: time [...], GPS time in seconds; coefficients alpha and beta, [8].
    """
    latitude, longitude, _ = (a.unsqueeze(-1) / math.pi for a in sight.receiver.unbind(-1))
    elevation = sight.elevation / math.pi
    central = 0.0137 / (elevation + 0.11) - 0.022
    north = (latitude + central * torch.cos(sight.azimuth)).clamp(-0.416, 0.416)
    east = longitude + central * torch.sin(sight.azimuth) / torch.cos(north * math.pi)
    magnetic = north + 0.064 * torch.cos((east - 1.617) * math.pi)
    local = torch.remainder(43200.0 * east + time.unsqueeze(-1), 86400.0)
    amplitude, period = (
        sum(c * magnetic**k for k, c in enumerate(coefficients[first : first + 4]))
        for first in (0, 4)
    )
    amplitude, period = (
        torch.as_tensor(amplitude).clamp(min=0.0),
        torch.as_tensor(period).clamp(min=_LEAST_PERIOD),
    )
    phase = 2.0 * math.pi * (local - _PEAK) / period
    day = amplitude * (1.0 - phase**2 / 2.0 + phase**4 / 24.0)
    slant = 1.0 + 16.0 * (0.53 - elevation) ** 3
    return LIGHT * slant * (_NIGHT + torch.where(phase.abs() < 1.57, day, 0.0))
