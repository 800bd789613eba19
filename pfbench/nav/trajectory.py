"""Trajectories: truth along a motion, and the output of ideal inertial sensors.

A motion is three scalar profiles: speed, climb (flight-path) angle, heading. Roll follows from
coordinated turns. Positions and increments are closed form or Gauss-Legendre quadrature,
vectorised over time [ours]. Modules `manoeuvres` and `ramps` build motions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation, RotationSpline, Slerp
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.nav import attitude, earth

G_TURN = 9.80665  # gravity of a coordinated turn [m/s^2], constant, independent of position
NODES = torch.tensor(
    [0.5 - 0.5 * math.sqrt(0.6), 0.5, 0.5 + 0.5 * math.sqrt(0.6)], dtype=torch.float64
)
WEIGHTS = torch.tensor([5.0, 8.0, 5.0], dtype=torch.float64) / 18  # Gauss-Legendre, at NODES


@dataclass(frozen=True)
class TrajectoryStart:
    """Initial position, speed and heading of a trajectory.

    Attributes:
        lat_deg: Latitude, within +-89 deg.
        lon_deg: Longitude.
        height: m.
        speed: m/s.
        heading_deg: Clockwise from North.
    """

    lat_deg: float
    lon_deg: float
    height: float
    speed: float = 0.0
    heading_deg: float = 0.0

    def __post_init__(self) -> None:
        require_ranges("", self, lat_deg="[-89, 89] East and North are undefined near a pole.")


class TrajectoryData(NamedTuple):
    """The truth and the ideal sensors over n samples.

    Attributes:
        time: [n + 1], s.
        pos: Latitude, longitude, height, [n + 1, 3], rad, rad, m.
        vel: East, North, Up, [n + 1, 3], m/s.
        dcm: Body to level, [n + 1, 3, 3].
        dtheta: Angle increments of ideal gyros, body axes, from time k to k + 1, [n, 3], rad.
        dv: Velocity increments of ideal accelerometers, [n, 3], m/s.
    """

    time: Tensor
    pos: Tensor
    vel: Tensor
    dcm: Tensor
    dtheta: Tensor
    dv: Tensor


class MotionProfile(NamedTuple):
    """Motion profiles and their time derivatives on a grid of instants.

    Attributes:
        speed: m/s.
        speed1: m/s^2.
        climb: Climb angle, rad.
        climb1: rad/s.
        heading: Clockwise from North, rad.
        heading1: rad/s.
        heading2: rad/s^2.
    """

    speed: Tensor
    speed1: Tensor
    climb: Tensor
    climb1: Tensor
    heading: Tensor
    heading1: Tensor
    heading2: Tensor


class TrajectorySource(Protocol):
    """A motion that can be sampled at any rate.

    It may state `duration_s`, so that a flight that does not fit into memory is refused before it is generated.
    """

    def generate(self, rate: float) -> TrajectoryData:
        """Generate truth and ideal sensors at `rate` samples per second, from time 0."""


def integrate_motion(
    samples: MotionProfile, nodes: MotionProfile, start: TrajectoryStart, rate: float
) -> TrajectoryData:
    """Integrate a motion to a flight.

    Returns truth and ideal increments, float64.
    """
    if samples.speed.min() < 0:
        raise ValueError(
            f"speed must not be negative, got {samples.speed.min():.3f} m/s. "
            "Brake less, or start faster."
        )
    pos, node_pos = _positions(samples, nodes, start, 1 / rate)
    w, f = _ideal_sensors(nodes, node_pos)
    weights = WEIGHTS[:, None] / rate
    time = torch.arange(len(samples.speed), dtype=torch.float64) / rate
    dcm = attitude.dcm_from_euler(_euler(samples))
    return TrajectoryData(
        time, pos, _velocity(samples), dcm, (weights * w).sum(1), (weights * f).sum(1)
    )


def _velocity(m: MotionProfile) -> Tensor:
    """Compute the velocity East, North, Up [..., 3]."""
    level, up = m.speed * torch.cos(m.climb), m.speed * torch.sin(m.climb)
    return torch.stack([level * torch.sin(m.heading), level * torch.cos(m.heading), up], dim=-1)


def _acceleration(m: MotionProfile) -> Tensor:
    """Compute the time derivative of the velocity components [..., 3]."""
    sg, cg, sc, cc = (
        torch.sin(m.climb),
        torch.cos(m.climb),
        torch.sin(m.heading),
        torch.cos(m.heading),
    )
    along, across = m.speed1 * cg - m.speed * sg * m.climb1, m.speed * cg * m.heading1
    up = m.speed1 * sg + m.speed * cg * m.climb1
    return torch.stack([along * sc + across * cc, along * cc - across * sc, up], dim=-1)


def _bank(m: MotionProfile) -> Tensor:
    return m.speed * torch.cos(m.climb) * m.heading1 / G_TURN


def _euler(m: MotionProfile) -> Tensor:
    return torch.stack([m.climb, torch.atan(_bank(m)), -m.heading], dim=-1)


def _body_rate(m: MotionProfile) -> Tensor:
    """Compute the rate of the body relative to the level frame, body axes [..., 3]."""
    bank = _bank(m)
    roll, sg, cg = torch.atan(bank), torch.sin(m.climb), torch.cos(m.climb)
    bank1 = (
        (m.speed1 * cg - m.speed * sg * m.climb1) * m.heading1 + m.speed * cg * m.heading2
    ) / G_TURN
    roll1, yaw1 = bank1 / (1 + bank**2), -m.heading1
    x = torch.cos(roll) * m.climb1 - torch.sin(roll) * cg * yaw1
    z = torch.sin(roll) * m.climb1 + torch.cos(roll) * cg * yaw1
    return torch.stack([x, roll1 + sg * yaw1, z], dim=-1)


def _positions(
    samples: MotionProfile, nodes: MotionProfile, start: TrajectoryStart, d: float
) -> tuple[Tensor, Tensor]:
    """Compute positions at samples [n + 1, 3] and quadrature nodes [n, 3, 3]."""
    v, node_v = _velocity(samples), _velocity(nodes)

    def integral(rate_at_nodes: Tensor, begin: float) -> Tensor:
        steps = (rate_at_nodes * WEIGHTS).sum(-1) * d
        return torch.cat(
            [torch.tensor([begin], dtype=torch.float64), begin + torch.cumsum(steps, 0)]
        )

    h = integral(node_v[..., 2], start.height)
    node_h = _hermite(h, v[:, 2], d)
    lat = torch.full_like(h, math.radians(start.lat_deg))
    node_lat = lat[0].expand_as(node_h)
    for _ in range(4):  # Picard iteration, with error factor (distance / Earth radius) per pass
        lat = integral(
            node_v[..., 1] / (earth.radii(node_lat)[0] + node_h), math.radians(start.lat_deg)
        )
        node_lat = _hermite(lat, v[:, 1] / (earth.radii(lat)[0] + h), d)

    def lon_rate(lat: Tensor, h: Tensor, east: Tensor) -> Tensor:
        return east / ((earth.radii(lat)[1] + h) * torch.cos(lat))

    lon = integral(lon_rate(node_lat, node_h, node_v[..., 0]), math.radians(start.lon_deg))
    node_lon = _hermite(lon, lon_rate(lat, h, v[:, 0]), d)
    return torch.stack([lat, lon, h], dim=-1), torch.stack([node_lat, node_lon, node_h], dim=-1)


def _hermite(y: Tensor, y1: Tensor, d: float) -> Tensor:
    """Interpolate samples [n + 1] and derivatives by cubics at the nodes [n, 3]."""
    u, (a, b) = NODES, (y[:-1, None], y[1:, None])
    return (
        a
        + (b - a) * u**2 * (3 - 2 * u)
        + d * u * (1 - u) * ((1 - u) * y1[:-1, None] - u * y1[1:, None])
    )


def _ideal_sensors(m: MotionProfile, pos: Tensor) -> tuple[Tensor, Tensor]:
    """Compute angular rate and specific force, body axes [n, 3 nodes, 3 axes]."""
    to_body = attitude.dcm_from_euler(_euler(m)).transpose(-1, -2)
    return ideal_sensors(pos, _velocity(m), _acceleration(m), _body_rate(m), to_body)


def ideal_sensors(
    pos: Tensor, vel: Tensor, acceleration: Tensor, body_rate: Tensor, to_body: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute the output of ideal gyros and accelerometers.

    Returns angular rate, rad/s, and specific force, m/s^2, in body axes, [..., 3] each. Shapes: pos
    [..., 3], vel [..., 3], acceleration [..., 3], body_rate [..., 3], to_body [..., 3, 3].
    """
    lat, h = pos[..., 0], pos[..., 2]
    w_ie, w_en = earth.earth_rate(lat), earth.transport_rate(lat, h, vel)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    coriolis = torch.linalg.cross(2 * w_ie + w_en, vel)
    f = acceleration + coriolis + earth.gravity(lat, h)[..., None] * up
    w = body_rate + (to_body @ (w_ie + w_en)[..., None]).squeeze(-1)
    return w, (to_body @ f[..., None]).squeeze(-1)


# --------------------------------------------------------------------------------------------------
# Smooth motion through a recorded one, and the output of ideal inertial sensors.
#
# Recorded positions, velocities and attitudes contradict each other by centimetres and cannot be
# differentiated. Splines through them are twice differentiable, and their position, velocity,
# attitude and sensors agree exactly. The splines stay within the errors of the record and serve as
# the truth of a scenario. Knots are evenly spaced and the fit is least squares [ours].

_POSITION, _ATTITUDE = 5, 3  # degrees of the splines
_PASSES = 4  # Gauss-Newton steps for attitude, each squares the angular error


class RecordedMotion(NamedTuple):
    """A recorded motion at n instants, float64.

    Attributes:
        time: Increasing times, [n], s.
        pos: Latitude, longitude, height, [n, 3], rad, rad, m.
        vel: East, North, Up, [n, 3], m/s.
        dcm: Body (right, forward, up) to level, [n, 3, 3].
    """

    time: Tensor
    pos: Tensor
    vel: Tensor
    dcm: Tensor


@dataclass(frozen=True, eq=False)
class MotionSpline(TrajectorySource):
    """A smooth motion close to a recorded one.

    Position is a quintic spline, fitted to recorded positions and velocities. Attitude is scipy's
    RotationSpline: its rotation vector between knots is cubic, angular rate and acceleration are
    continuous, and the angular acceleration is zero at both ends. It is fitted to the recorded
    attitudes by Gauss-Newton steps. Recorded angular rates are not used.

    Attributes:
        recorded: The motion.
        knot_interval_s: Time between knots, s. Motion with a shorter period than about twice this
            value is smoothed out.
        use_full_log: Time, s. The flight is cut to a multiple of it.
        position_sd: Position errors of the record, m. Only the ratio to `velocity_sd` matters.
        velocity_sd: Velocity errors of the record, m/s.
    """

    recorded: RecordedMotion
    knot_interval_s: float = 0.4
    use_full_log: float = 1.0
    position_sd: float = 0.02
    velocity_sd: float = 0.05

    def __post_init__(self) -> None:
        names = ("knot_interval_s", "use_full_log", "position_sd", "velocity_sd")
        require_ranges("trajectory", self, **dict.fromkeys(names, "(0, inf]"))
        time = self.recorded.time
        step = time.diff()
        require(
            not len(time) < 2 and bool((step > 0.0).all()),
            "recorded times",
            "increase",
            f"{len(time)} rows",
            "Sort at least 2 rows by time.",
        )
        i = int(step.argmax())
        # splines need two instants between knots
        if float(step[i]) > 0.5 * self.knot_interval_s + 1e-9:
            raise ValueError(
                f"trajectory.knot_interval_s must be at least twice the longest gap of the record, "
                f"{float(step[i]):.3f} s after t = {float(time[i]):.3f}, got {self.knot_interval_s}. "
                "Increase it, or choose start and end without this gap."
            )
        if float(time[-1] - time[0]) < self.use_full_log:
            raise ValueError(
                "trajectory.use_full_log must be at most the duration of the record, "
                f"{float(time[-1] - time[0]):.3f} s, got {self.use_full_log}. Reduce it."
            )

    @override
    def generate(self, rate: float) -> TrajectoryData:
        samples = self.use_full_log * rate
        require(
            not abs(samples - round(samples)) > 1e-06 and (not round(samples) < 1),
            "trajectory.use_full_log",
            f"be a whole number of samples at rate={rate}",
            f"{self.use_full_log} ({samples:g} samples)",
            "Change it.",
        )
        start = float(self.recorded.time[0])
        n = int((float(self.recorded.time[-1]) - start) / self.use_full_log + 1e-6) * round(samples)
        steps = torch.arange(n + 1, dtype=torch.float64)
        ends, nodes = start + steps / rate, start + (steps[:-1, None] + NODES) / rate
        last = float(self.recorded.time[-1])
        ends, nodes = (t.clamp(max=last) for t in (ends, nodes))  # rounding
        position, attitude = self._fit_position(), self._fit_attitude()
        pos, vel, _ = position.at_step(ends)
        w, f = _ideal_spline_sensors(position, attitude, nodes)
        weights = WEIGHTS[:, None] / rate
        dtheta, dv = (weights * w).sum(1), (weights * f).sum(1)
        return TrajectoryData(steps / rate, pos, vel, _dcm(attitude, ends), dtheta, dv)

    def _fit_position(self) -> _PositionSpline:
        pos, vel = self.recorded.pos, self.recorded.vel
        origin = pos[0]
        scale = earth.metre_scale(origin)
        metres, rates = (
            ((pos - origin) * scale).numpy(),
            (earth.position_rate(pos, vel) * scale).numpy(),
        )
        weight = (self.position_sd / self.velocity_sd) ** 2
        time = self.recorded.time.numpy()
        spline = _fit_spline(
            time, _knots(time, self.knot_interval_s), _POSITION, metres, rates, weight
        )
        return _PositionSpline(spline, origin, scale)

    def _fit_attitude(self) -> Any:
        time, recorded = self.recorded.time.numpy(), Rotation.from_matrix(self.recorded.dcm.numpy())
        knots = _knots(time, self.knot_interval_s)
        at_knots = Slerp(time, recorded)(knots)
        for _ in range(_PASSES):
            error = (RotationSpline(knots, at_knots)(time).inv() * recorded).as_rotvec()
            correction = _fit_spline(time, knots, _ATTITUDE, error)(knots)
            at_knots = at_knots * Rotation.from_rotvec(correction)
        return RotationSpline(knots, at_knots)


class _PositionSpline(NamedTuple):
    """Position as a spline of metres North, East, Up from an origin."""

    spline: Any
    origin: Tensor
    scale: Tensor

    def at_step(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Return position, velocity East, North, Up and acceleration, [..., 3] each."""
        x, x1, x2 = (
            torch.from_numpy(self.spline(t.numpy(), order)) / self.scale for order in (0, 1, 2)
        )
        pos = self.origin + x
        metres, metres1 = torch.func.jvp(earth.metre_scale, (pos,), (x1,))[:2]
        vel, acc = metres * x1, metres1 * x1 + metres * x2
        return pos, vel[..., [1, 0, 2]], acc[..., [1, 0, 2]]


def _ideal_spline_sensors(
    position: _PositionSpline, attitude: Any, t: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute angular rate and specific force in body axes [..., 3]."""
    pos, vel, acceleration = position.at_step(t)
    body_rate = torch.from_numpy(attitude(t.numpy().ravel(), 1)).reshape(vel.shape)
    return ideal_sensors(pos, vel, acceleration, body_rate, _dcm(attitude, t).mT)


def _dcm(attitude: Any, t: Tensor) -> Tensor:
    """Evaluate body-to-level matrices [..., 3, 3]."""
    return torch.from_numpy(attitude(t.numpy().ravel()).as_matrix()).reshape(*t.shape, 3, 3)


def _knots(time: NDArray[np.float64], spacing: float) -> NDArray[np.float64]:
    """Place knots at the first time, then every `spacing` seconds, and at the last."""
    intervals = max(1, int((time[-1] - time[0]) / spacing))
    # The last interval is up to twice as long. Evenly stretched knots would lie inside samples,
    # which reduces the order of the quadrature.
    return np.append(time[0] + spacing * np.arange(intervals), time[-1])


def _fit_spline(
    time: NDArray[np.float64],
    knots: NDArray[np.float64],
    degree: int,
    values: NDArray[np.float64],
    rates: NDArray[np.float64] | None = None,
    weight: float = 0.0,
) -> Any:
    """Fit the spline that minimises sum |values - s|^2 + weight sum |rates - s'|^2."""
    t = np.concatenate([np.repeat(knots[0], degree), knots, np.repeat(knots[-1], degree)])
    a = BSpline.design_matrix(time, t, degree)
    normal, right = a.T @ a, a.T @ values
    if rates is not None:
        # the derivative has coefficients degree (c_{i+1} - c_i) / (t_{i+degree+1} - t_{i+1})
        ratio = degree / (t[degree + 1 : -1] - t[1 : -degree - 1])
        difference = sparse.diags_array(
            [-ratio, ratio], offsets=[0, 1], shape=(len(ratio), len(ratio) + 1)
        )
        b = BSpline.design_matrix(time, t[1:-1], degree - 1) @ difference
        normal, right = normal + weight * (b.T @ b), right + weight * (b.T @ rates)
    return BSpline(t, spsolve(normal.tocsc(), right), degree)
