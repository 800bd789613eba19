"""Checks of raw measurements of a log against its reference."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from pfbench.nav import earth
from pfbench.nav.plausible_limits import PlausibleLimits
from pfbench.scenario.plausibility.satellite_agreement import (
    check_orbits,
    compare_directions,
    compare_ranges,
    compare_rates,
)
from pfbench.scenario.recorded.log_tables import Array

if TYPE_CHECKING:
    from pfbench.scenario.recorded.raw_gnss_log import RawGnssLog


def check_sky(
    gnss_log: RawGnssLog, time: Array, motion: Array, limits: PlausibleLimits
) -> tuple[str, ...]:
    """Check satellites, ranges and range rates against the reference.

    Args:
        gnss_log: Raw measurements relative to the origin of the log.
        time: Times, s, [K].
        motion: Attitude, velocity and position of the reference, [K, 10].
        limits: Limits of the platform.

    Returns:
        Notes.

    Raises:
        ValueError: If a satellite jumps, or a range or range rate is impossible.
    """
    name, names = "pseudorange", gnss_log.names
    # a sphere about the Earth's centre, which lies below the origin of the log
    position = gnss_log.satellite_position + np.array([0.0, 0.0, earth.A])
    check_orbits(name, names, time, position, gnss_log.velocity)
    sight = gnss_log.satellite_position - motion[:, None, 7:]
    reach = np.linalg.norm(sight, axis=-1)
    rate = (sight / reach[..., None] * (gnss_log.velocity - motion[:, None, 4:7])).sum(-1)
    azimuth = np.arctan2(sight[..., 0], sight[..., 1])
    elevation = np.arcsin(sight[..., 2] / reach)
    return (
        *gnss_log.notes,
        *compare_directions(
            name, names, time, gnss_log.azimuth - azimuth, gnss_log.elevation - elevation
        ),
        *compare_ranges(name, names, time, gnss_log.range - reach, limits),
        *compare_rates(name, names, time, gnss_log.rate - rate),
    )
