"""Initial distribution of a passively located emitter, given the first measurement."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.model.passive_location import SPEED_OF_LIGHT, PlatformInputs


class FirstMeasurement(NamedTuple):
    """First measurement of an emitter, with the prior information.

    Attributes:
        z: Bearing and elevation, rad; their rates, rad/s; Doppler rate, Hz/s, [R, 5].
        platform: Aircraft at that time, as given to the filters, [R or 1, ...].
        sd: Standard deviations of the measurement, [5].
        velocity_sd: Standard deviation of the emitter velocity about 0, m/s per axis.
        limits: Smallest and largest range, m.
    """

    z: Tensor
    platform: PlatformInputs
    sd: Tensor
    velocity_sd: float
    limits: tuple[float, float]


class EmitterPrior(Protocol):
    """Distribution of an emitter [x, y, vx, vy] in the ground frame."""

    def initial_moments(self, first: FirstMeasurement) -> tuple[Tensor, Tensor, str]:
        """Compute the distribution given the first measurement.

        Args:
            first: First measurement, with the prior information.

        Returns:
            Mean, [R, 4], Cholesky factor of the covariance, [R, 4, 4], and a note for the report.
        """


@dataclass(frozen=True)
class LinearisedEmitterPrior(EmitterPrior):
    """Prior as printed: the measured range, with its standard deviation to first order.

    `first_fix` contains the equations.
    """

    @override
    def initial_moments(self, first: FirstMeasurement) -> tuple[Tensor, Tensor, str]:
        start, spread, clipped = first_fix(*first)
        note = (
            "range of the first measurement clipped to its limits in "
            f"{int(clipped.sum())} of {len(clipped)} runs"
        )
        return start, spread, note


def first_fix(
    z: Tensor, platform: PlatformInputs, sd: Tensor, velocity_sd: float, limits: tuple[float, float]
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the initial distribution of each run from its first measurement.

    The method is from Pu and Qin, section 3.2, where the covariance is given only in words. The
    range follows from the Doppler rate and the angular rates,
    r = -lambda fd' / (eps'^2 + beta'^2 cos^2 eps), clipped to the limits. The standard deviation
    along the horizontal line of sight is the first-order value for the range. It is at most a
    quarter of the interval between the limits. Across the line of sight it is range times bearing
    standard deviation. The mean velocity is 0. [ours]

    Args:
        z: First measurement, as in `FirstMeasurement`, [R, 5].
        platform: Aircraft at that time, as given to the filters, [R or 1, ...].
        sd: Standard deviations of the measurement, [5].
        velocity_sd: Standard deviation of the emitter velocity, m/s per axis.
        limits: Smallest and largest range, m.

    Returns:
        Mean, [R, 4], Cholesky factor of the covariance, [R, 4, 4], and a mask of runs with clipped
        range, [R].
    """
    bearing, elevation, turning, rising, doppler = z.unbind(-1)
    wavelength = SPEED_OF_LIGHT / platform.carrier
    cos = torch.cos(elevation)
    rate2 = rising.square() + (turning * cos).square()
    measured_range = -wavelength * doppler / rate2
    r = measured_range.clamp(*limits)
    slope = (wavelength / rate2).square()
    variance = slope * (
        sd[4] ** 2
        + (2.0 * doppler / rate2).square()
        * ((turning * sd[2]).square() + (rising * sd[3]).square())
    )
    along = cos * variance.sqrt().clamp(max=(limits[1] - limits[0]) / 4.0)
    ahead = torch.stack([torch.sin(bearing), torch.cos(bearing), torch.zeros_like(bearing)], -1)
    sight = torch.cat([ahead[..., :2] * cos.unsqueeze(-1), torch.sin(elevation).unsqueeze(-1)], -1)
    fix = platform.position + r.unsqueeze(-1) * (sight.unsqueeze(-2) @ platform.attitude).squeeze(
        -2
    )
    start = torch.cat([fix[..., :2], torch.zeros_like(fix[..., :2])], -1)
    u = (ahead.unsqueeze(-2) @ platform.attitude).squeeze(-2)[..., :2]
    axes = torch.stack(
        [u, torch.stack([-u[..., 1], u[..., 0]], -1)], -1
    )  # columns along and across
    root = axes * torch.stack([along, r * cos * sd[0]], -1).unsqueeze(-2)
    spread = torch.zeros(len(z), 4, 4, dtype=z.dtype) + velocity_sd * torch.eye(4, dtype=z.dtype)
    spread[:, :2, :2] = torch.linalg.cholesky(root @ root.mT)
    return start, spread, measured_range != r
