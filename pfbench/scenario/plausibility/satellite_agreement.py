"""Agreement of recorded satellites, pseudoranges and range rates.

A range can be off by a reflection, so it stays in the data up to the limit of a fix. A satellite
moves smoothly, so its positions must agree.
"""

from __future__ import annotations

import numpy as np

from pfbench.nav.plausible_limits import PlausibleLimits
from pfbench.scenario.recorded.log_tables import Array

LEAST_RADIUS, LARGEST_RADIUS = 2.2e7, 4.6e7  # m; perigee of E14 23.3e6, geostationary 42.2e6
_LONGEST = 5.0  # s between compared epochs
POSITION_NOISE = 20.0  # m; position against those of the neighbouring epochs
VELOCITY_NOISE = 20.0  # m/s; velocity against the change of position
RANGE_NOTE = 200.0  # m; range residual beyond which a note names the satellite
RATE_NOTE, LARGEST_RATE = 20.0, 200.0  # m/s; residual of a range rate

DIRECTION_NOTE = np.radians(1.0)


def check_orbits(
    name: str, names: tuple[str, ...], time: Array, position: Array, velocity: Array | None = None
) -> None:
    """Check radius, smoothness and velocity of satellites.

    Args:
        name: Name of the table, for messages.
        names: Names of the S satellites.
        time: Times, s, [K].
        position: Earth-fixed positions, m, [K, S, 3]. NaN where missing.
        velocity: Velocities, m/s, [K, S, 3], or None.

    Raises:
        ValueError: If a satellite leaves the range of orbits, jumps, or moves against its velocity.
    """
    for s, satellite in enumerate(names):
        rows = np.flatnonzero(np.isfinite(position[:, s, 0]))
        p, t = position[rows, s], time[rows]
        radius = np.linalg.norm(p, axis=1)
        wrong = np.flatnonzero((radius < LEAST_RADIUS) | (radius > LARGEST_RADIUS))
        if wrong.size:
            raise ValueError(
                f"{name}: sx, sy, sz must be {LEAST_RADIUS:g} to {LARGEST_RADIUS:g} m from the "
                f"centre of the Earth, got {radius[wrong[0]]:g} for {satellite} at "
                f"t = {t[wrong[0]]:.3f}. Correct or remove this row."
            )
        dt = np.diff(t)
        speed = np.diff(p, axis=0) / dt[:, None]
        # accelerations are below 1 m/s^2
        bend = np.linalg.norm(np.diff(speed, axis=0), axis=1) * np.minimum(dt[1:], dt[:-1])
        near = (dt[1:] <= _LONGEST) & (dt[:-1] <= _LONGEST)
        _reject(name, satellite, t[1:-1][near], bend[near], POSITION_NOISE, "position jump", "m")
        if velocity is not None and len(t) > 1:
            mean = 0.5 * (velocity[rows, s][1:] + velocity[rows, s][:-1])
            off = np.linalg.norm(mean - speed, axis=1)
            near = dt <= _LONGEST
            _reject(
                name, satellite, t[1:][near], off[near], VELOCITY_NOISE, "velocity error", "m/s"
            )


def compare_ranges(
    name: str, names: tuple[str, ...], time: Array, residual: Array, limits: PlausibleLimits
) -> tuple[str, ...]:
    """Compare range residuals with the median of each epoch and system.

    Args:
        name: Name of the table, for messages.
        names: Names of the S satellites. The first letter is the system.
        time: Times, s, [K].
        residual: Corrected pseudoranges minus distances from the reference, m, [K, S].
        limits: Limits of the platform.

    Returns:
        Notes.

    Raises:
        ValueError: If a residual is beyond `limits.fix_error_m`.
    """
    return _judge_residuals(
        f"{name}: pseudorange residual",
        names,
        time,
        residual,
        (RANGE_NOTE, limits.fix_error_m),
        "m",
    )


def compare_rates(
    name: str, names: tuple[str, ...], time: Array, residual: Array
) -> tuple[str, ...]:
    """Compare residuals of range rates with the median of each epoch and system.

    Args:
        name: Name of the table, for messages.
        names: Names of the S satellites.
        time: Times, s, [K].
        residual: Range rates minus those from the reference, m/s, [K, S].

    Returns:
        Notes.

    Raises:
        ValueError: If a residual is beyond 200 m/s.
    """
    return _judge_residuals(
        f"{name}: range rate residual", names, time, residual, (RATE_NOTE, LARGEST_RATE), "m/s"
    )


def compare_directions(
    name: str, names: tuple[str, ...], time: Array, azimuth: Array, elevation: Array
) -> tuple[str, ...]:
    """Check recorded directions against those from the reference.

    Args:
        name: Name of the table, for messages.
        names: Names of the S satellites.
        time: Times, s, [K].
        azimuth: Errors of the azimuth, rad, [K, S].
        elevation: Errors of the elevation, rad, [K, S].

    Returns:
        A note if a direction is off by more than a degree.
    """
    # near the zenith the azimuth is free, and angles wrap
    off = np.nan_to_num(np.maximum(np.abs(np.sin(0.5 * azimuth)) * 2.0, np.abs(elevation)))
    k, s = (int(i) for i in np.unravel_index(np.argmax(off), off.shape))
    count = int((off > DIRECTION_NOTE).sum())
    if not count:
        return ()
    return (
        f"{name}: az and el differ from the direction of the satellite by more than 1 degree in "
        f"{count} rows, at most {np.degrees(off[k, s]):.1f} for {names[s]} at t = {time[k]:.3f}",
    )


def _judge_residuals(
    label: str,
    names: tuple[str, ...],
    time: Array,
    residual: Array,
    thresholds: tuple[float, float],
    unit: str,
) -> tuple[str, ...]:
    """Reject or note residuals without the median of each epoch and system."""
    off = np.zeros_like(residual)
    for system in sorted({satellite[0] for satellite in names}):
        columns = [i for i, satellite in enumerate(names) if satellite[0] == system]
        group = residual[:, columns]
        counts = np.isfinite(group).sum(1, keepdims=True)
        clock = np.zeros(len(group))
        some = counts[:, 0] > 0
        clock[some] = np.nanmedian(group[some], axis=1)
        # the common clock of one satellite alone is not confirmed
        off[:, columns] = np.nan_to_num(np.abs(group - clock[:, None]))
    k, s = (int(i) for i in np.unravel_index(np.argmax(off), off.shape))
    value = f"{off[k, s]:.0f} {unit} for {names[s]} at t = {time[k]:.3f}"
    noted, largest = thresholds
    if off[k, s] > largest:
        raise ValueError(
            f"{label} must be at most {largest:g} {unit}, got {value}. Correct or remove this row, "
            "or set scenario.limits.fix_error_m."
        )
    count = int((off > noted).sum())
    return (f"{label} above {noted:g} {unit} in {count} rows, at most {value}",) if count else ()


def _reject(
    name: str, satellite: str, time: Array, values: Array, largest: float, label: str, unit: str
) -> None:
    if len(values) and values.max() > largest:
        i = int(np.argmax(values))
        raise ValueError(
            f"{name}: {label} of a satellite must be at most {largest:g} {unit}, got "
            f"{values[i]:.0f} for {satellite} near t = {time[i]:.3f}. Correct or remove this row."
        )
