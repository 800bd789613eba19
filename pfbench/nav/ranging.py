"""GNSS receiver that aids an INS by pseudoranges and range rates, with its clock."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from typing import NamedTuple

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import as_float64, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import EACH_SATELLITE, MeasurementChannels
from pfbench.nav.aiding import AidingData, AidingSensor, FlightSolution
from pfbench.nav.orbits import (
    Constellation,
    SatelliteGeometry,
    azimuth_elevation,
    convert_to_earth_fixed,
    predict_ranges,
    receive_signals,
)
from pfbench.nav.strapdown import InsIntervals


@dataclass(frozen=True)
class ReceiverClock:
    """A receiver clock in metres: b' = d + white noise, d' = white noise.

    Bias b and drift d [Brown and Hwang 2012, section 9.3].

    Attributes:
        bias_sd: Standard deviation of the initial bias, m.
        drift_sd: Standard deviation of the initial drift, m/s.
        bias_walk: Root density of the bias noise, m/sqrt(s).
        drift_walk: Root density of the drift noise, (m/s)/sqrt(s).

    Raises:
        ValueError: If a size is not positive.
    """

    bias_sd: float = 30.0
    drift_sd: float = 1.0
    bias_walk: float = 0.3
    drift_walk: float = 0.03

    def __post_init__(self) -> None:
        require_ranges("clock", self, **{item.name: "(0, inf]" for item in fields(self)})

    def noise_gain(self, duration: Tensor) -> Tensor:
        """Compute the noise root of (bias, drift) over durations [...] s: [..., 2, 2].

        The matrix is lower triangular.
        """
        q_b, q_d = self.bias_walk**2, self.drift_walk**2
        bias = torch.sqrt(q_b * duration + q_d * duration**3 / 3)
        cross = torch.where(
            bias > 0, 0.5 * q_d * duration**2 / torch.where(bias > 0, bias, 1.0), 0.0
        )
        drift = torch.sqrt((q_d * duration - cross**2).clamp(min=0))
        return torch.stack([bias, torch.zeros_like(bias), cross, drift], -1).unflatten(-1, (2, 2))

    def simulate(self, duration: Tensor, process: Tensor, draws: RandomStream) -> Tensor:
        """Simulate bias and drift at the ends of intervals, exact at any duration.

        Args:
            duration: Duration of the intervals, [T], s.
            process: Factor on the variance of the noise, [T].
            draws: Random stream, labels "world.clock*". It decides the runs.

        Returns:
            Bias and drift, [R, T, 2], m and m/s.
        """
        start = draws.normal("world.clock.start", 1, 2)
        noise = draws.normal("world.clock", len(duration), 2).unsqueeze(-1)
        noise = (self.noise_gain(duration) @ noise).squeeze(-1) * process.sqrt()[:, None]
        drift = self.drift_sd * start[..., 1] + torch.cumsum(noise[..., 1], -1)
        before = torch.cat([self.drift_sd * start[..., 1], drift[:, :-1]], -1)
        bias = self.bias_sd * start[..., 0] + torch.cumsum(before * duration + noise[..., 0], -1)
        return torch.stack([bias, drift], -1)


class RangingInputs(NamedTuple):
    """Inputs of a tightly coupled filter: INS intervals, and satellites at their ends.

    Attributes:
        dcm, dcm_end, pos, pos_start, pos_end, vel, vel_end, w_in, f, duration: See `InsIntervals`.
        satellite: Earth-fixed positions of S satellites, [1, T, S, 3], m. Unknown satellites are
            at the Earth's centre.
        satellite_vel: Velocities, [1, T, S, 3], m/s.
    """

    dcm: Tensor
    dcm_end: Tensor
    pos: Tensor
    pos_start: Tensor
    pos_end: Tensor
    vel: Tensor
    vel_end: Tensor
    w_in: Tensor
    f: Tensor
    duration: Tensor
    satellite: Tensor
    satellite_vel: Tensor

    @property
    def intervals(self) -> InsIntervals:
        """The intervals of the INS."""
        return InsIntervals(*self[: len(InsIntervals._fields)])

    @property
    def sight(self) -> SatelliteGeometry:
        """Ranging geometry predicted by the INS at the end of each interval."""
        return predict_ranges(self.pos_end, self.vel_end, self.satellite, self.satellite_vel)


@dataclass(frozen=True)
class RangingReceiver(AidingSensor):
    """A receiver of pseudorange and range rate to every satellite above a mask.

    Measurements are INS minus receiver: r(INS) - (r(truth) + b) for each satellite, then the rates
    in the same form with d, where b and d are clock bias and drift. NaN marks a satellite below the
    mask. Atmosphere, ephemeris errors and satellite clocks are omitted, because they cancel in a
    simulation if both sides use the same values. [ours]

    Attributes:
        constellation: The satellites.
        pseudorange_sd: Standard deviation, m.
        rate_sd: Standard deviation, m/s.
        clock: Clock of the receiver.
        mask_deg: Smallest elevation.
        satellites: Names of the satellites with a channel. None means all.
        sagnac: Whether signals take time: satellites are at their positions of transmission, in
            the Earth-fixed axes of reception. Otherwise propagation is instantaneous.

    Raises:
        ValueError: If a size is not positive, the mask is outside [-90, 90], or a satellite is
            unknown.
    """

    constellation: Constellation
    pseudorange_sd: float = 10.0
    rate_sd: float = 0.1
    clock: ReceiverClock = field(default_factory=ReceiverClock)
    mask_deg: float = 10.0
    satellites: Sequence[str] | None = None
    sagnac: bool = False
    channel_names = (
        f"INS minus measured range {EACH_SATELLITE} [m]",
        f"INS minus measured range rate {EACH_SATELLITE} [m/s]",
    )
    input_type = RangingInputs

    def __post_init__(self) -> None:
        require_ranges(
            "receiver",
            self,
            pseudorange_sd="(0, inf]",
            rate_sd="(0, inf]",
            mask_deg="[-90, 90] Set the smallest elevation.",
        )
        names = self.satellites
        if names is not None and (not names or len(set(names)) < len(names)):
            raise ValueError(
                f"receiver.satellites must be a list of different names, got {list(names)}. "
                "Give each satellite once, or null for all satellites."
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the S satellites with a channel."""
        return self.constellation.names if self.satellites is None else tuple(self.satellites)

    @property
    def sd(self) -> Tensor:
        """Standard deviation of S ranges, then S rates, [2 S]."""
        count = len(self.names)
        return as_float64([self.pseudorange_sd] * count + [self.rate_sd] * count)

    @property
    @override
    def channels(self) -> MeasurementChannels:
        count = len(self.names)
        return MeasurementChannels(
            self.sd, ("range",) * count + ("rate",) * count, tuple(range(count)) * 2
        )

    @override
    def measure(self, flown: FlightSolution, draws: RandomStream, process: Tensor) -> AidingData:
        position, velocity = convert_to_earth_fixed(flown.pos, flown.vel)
        satellite, satellite_vel = self._satellites(flown.time, position)
        duration = flown.ins.duration[0]
        clock = self.clock.simulate(duration, process, draws)
        true = _ranges(position, velocity, satellite, satellite_vel)
        ins = convert_to_earth_fixed(flown.ins.pos_end, flown.ins.vel_end)
        predicted = _ranges(*ins, satellite, satellite_vel)
        differences = [
            p - t - c.unsqueeze(-1)
            for p, t, c in zip(predicted, true, clock.unbind(-1), strict=True)
        ]
        azimuth, elevation = azimuth_elevation(flown.pos, satellite)
        hidden = ~(elevation >= math.radians(self.mask_deg))
        y = torch.where(hidden.repeat(1, 2), torch.nan, torch.cat(differences, -1))
        inputs = (torch.nan_to_num(a).unsqueeze(0) for a in (satellite, satellite_vel))
        angles = {"azimuth": azimuth, "elevation": elevation}
        sky = {name: torch.where(elevation >= 0, a, torch.nan) for name, a in angles.items()}
        return AidingData(y, RangingInputs(*flown.ins, *inputs), {"clock": clock}, sky)

    def _satellites(self, time: Tensor, position: Tensor) -> tuple[Tensor, Tensor]:
        """Compute positions and velocities [T, S, 3] of the tracked satellites."""
        names = self.constellation.names
        unknown = sorted(set(self.names) - set(names))
        if unknown:
            raise ValueError(
                "receiver.satellites must be names of the constellation, "
                f"got {', '.join(unknown)}. Choose from {', '.join(names)}."
            )
        if self.sagnac:
            signal = receive_signals(self.constellation, time, position)
            pos, vel = signal.pos, signal.vel
        else:
            pos, vel = self.constellation.at(time)
        indices = [names.index(name) for name in self.names]
        return pos[:, indices], vel[:, indices]


def _ranges(
    pos: Tensor, vel: Tensor, satellite: Tensor, satellite_vel: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute ranges and rates [..., S] between a receiver [..., 3] and satellites."""
    line = pos.unsqueeze(-2) - satellite
    distance = torch.linalg.vector_norm(line, dim=-1)
    return distance, (line * (vel.unsqueeze(-2) - satellite_vel)).sum(-1) / distance
