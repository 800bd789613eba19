"""A recorded motion flown again: splines through it, and what ideal inertial sensors would have reported along them.

Recorded positions, velocities and attitudes contradict each other by centimetres and cannot be differentiated; the splines can,
twice, and position, velocity, attitude and sensors agree with each other exactly. They stay within the record's own errors,
but they, and not the record, are the truth from then on. Knots are evenly spaced, everything is least squares [ours].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy import sparse
from scipy.interpolate import BSpline
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation, RotationSpline, Slerp
from torch import Tensor

from pfbench.nav import earth
from pfbench.nav.trajectory import NODES, Flight

Array = NDArray[np.float64]
_WEIGHTS = torch.tensor([5.0, 8.0, 5.0], dtype=torch.float64) / 18  # of Gauss and Legendre, at NODES
_POSITION, _ATTITUDE = 5, 3  # degrees of the splines
_PASSES = 4  # of Gauss and Newton for the attitude: each squares the angle between record and spline


class Recorded(NamedTuple):
    """A recorded motion of n instants, float64.

    Attributes:
        time: increasing [n] s.
        pos: latitude, longitude, height [n, 3] rad, rad, m.
        vel: East, North, Up [n, 3] m/s.
        dcm: body (right, forward, up) to level [n, 3, 3].
    """

    time: Tensor
    pos: Tensor
    vel: Tensor
    dcm: Tensor


@dataclass(frozen=True, eq=False)
class Replay:
    """A smooth motion close to a recorded one.

    Position is a quintic spline, fitted to the recorded positions and velocities together; attitude a spline whose rotation
    vector from knot to knot is cubic and whose angular rate and acceleration are continuous (scipy's RotationSpline), fitted to
    the recorded attitudes by Gauss-Newton steps; its angular acceleration vanishes at both ends. Recorded angular rates are not
    used.

    Args:
        recorded: the motion.
        smoothing: seconds between the knots; motion faster than about twice that is smoothed away.
        whole: the flight is cut to a whole number of these seconds.
        position_sd, velocity_sd: errors of the record, m and m/s; only their ratio matters.

    Raises:
        ValueError: a size that is not positive, a hole in the record for which `smoothing` is too short, a record shorter than
            `whole`; on flying, a `whole` that is no whole number of samples.
    """

    recorded: Recorded
    smoothing: float = 0.4
    whole: float = 1.0
    position_sd: float = 0.02
    velocity_sd: float = 0.05

    def __post_init__(self) -> None:
        for name in ("smoothing", "whole", "position_sd", "velocity_sd"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"path.{name}={getattr(self, name)}: give a positive number")
        time = self.recorded.time
        step = time.diff()
        if len(time) < 2 or not bool((step > 0.0).all()):
            raise ValueError("the recorded times must increase, and there must be two of them: sort the rows by time")
        i = int(step.argmax())
        if float(step[i]) > 0.5 * self.smoothing + 1e-9:  # fewer than two instants between knots leave the splines free
            raise ValueError(
                f"path.smoothing={self.smoothing}: {float(step[i]):.3f} s without a record after t = {float(time[i]):.3f}; "
                "give at least twice as much, or start and end beside this hole"
            )
        if float(time[-1] - time[0]) < self.whole:
            raise ValueError(f"path.whole={self.whole}: the record lasts {float(time[-1] - time[0]):.3f} s; give a smaller one")

    def fly(self, rate: float) -> Flight:
        """Truth and ideal sensors at `rate` samples per second, from the first recorded instant; time starts at 0."""
        samples = self.whole * rate
        if abs(samples - round(samples)) > 1e-6 or round(samples) < 1:
            raise ValueError(f"path.whole={self.whole}: at rate={rate} that is {samples:g} samples; give a whole number of them")
        start = float(self.recorded.time[0])
        n = int((float(self.recorded.time[-1]) - start) / self.whole + 1e-6) * round(samples)
        at = torch.arange(n + 1, dtype=torch.float64)
        ends, nodes = start + at / rate, start + (at[:-1, None] + NODES) / rate
        ends, nodes = (t.clamp(max=float(self.recorded.time[-1])) for t in (ends, nodes))  # rounding
        place, turns = self._place(), self._turns()
        pos, vel, _ = place.at(ends)
        w, f = _sensed(place, turns, nodes)
        weights = _WEIGHTS[:, None] / rate
        return Flight(at / rate, pos, vel, _dcm(turns, ends), (weights * w).sum(1), (weights * f).sum(1))

    def _place(self) -> _Place:
        pos, vel = self.recorded.pos, self.recorded.vel
        origin = pos[0]
        scale = earth.metre_scale(origin)
        metres, rates = ((pos - origin) * scale).numpy(), (earth.position_rate(pos, vel) * scale).numpy()
        weight = (self.position_sd / self.velocity_sd) ** 2
        time = self.recorded.time.numpy()
        return _Place(_fitted(time, _knots(time, self.smoothing), _POSITION, metres, rates, weight), origin, scale)

    def _turns(self) -> Any:
        time, recorded = self.recorded.time.numpy(), Rotation.from_matrix(self.recorded.dcm.numpy())
        knots = _knots(time, self.smoothing)
        at_knots = Slerp(time, recorded)(knots)
        for _ in range(_PASSES):
            apart = (RotationSpline(knots, at_knots)(time).inv() * recorded).as_rotvec()
            at_knots = at_knots * Rotation.from_rotvec(_fitted(time, knots, _ATTITUDE, apart)(knots))
        return RotationSpline(knots, at_knots)


class _Place(NamedTuple):
    """Position as a spline of metres North, East, Up from an origin, the metres being those at the origin."""

    spline: Any
    origin: Tensor
    scale: Tensor

    def at(self, t: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Position [..., 3], velocity East, North, Up [..., 3] and the time derivative of its components [..., 3]."""
        x, x1, x2 = (torch.from_numpy(self.spline(t.numpy(), order)) / self.scale for order in (0, 1, 2))
        pos = self.origin + x
        metres, metres1 = torch.func.jvp(earth.metre_scale, (pos,), (x1,))[:2]
        vel, acc = metres * x1, metres1 * x1 + metres * x2
        return pos, vel[..., [1, 0, 2]], acc[..., [1, 0, 2]]


def _sensed(place: _Place, turns: Any, t: Tensor) -> tuple[Tensor, Tensor]:
    """Angular rate and specific force, body axes [..., 3]: the strapdown equations solved for the sensors."""
    pos, v, acc = place.at(t)
    to_body = _dcm(turns, t).mT
    w_ie, w_en = earth.earth_rate(pos[..., 0]), earth.transport_rate(pos[..., 0], pos[..., 2], v)
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    f = acc + torch.linalg.cross(2 * w_ie + w_en, v) + earth.gravity(pos[..., 0], pos[..., 2])[..., None] * up
    w = torch.from_numpy(turns(t.numpy().ravel(), 1)).reshape(v.shape)  # of the body against the level frame, body axes
    return w + (to_body @ (w_ie + w_en)[..., None]).squeeze(-1), (to_body @ f[..., None]).squeeze(-1)


def _dcm(turns: Any, t: Tensor) -> Tensor:
    """Body to level [..., 3, 3]."""
    return torch.from_numpy(turns(t.numpy().ravel()).as_matrix()).reshape(*t.shape, 3, 3)


def _knots(time: Array, apart: float) -> Array:
    """The first time, then every `apart` seconds, and the last time, up to twice `apart` after the one before."""
    within = max(1, int((time[-1] - time[0]) / apart))
    # not stretched to end evenly: a knot inside a sample costs the quadrature its order, and the ends of samples are round
    return np.append(time[0] + apart * np.arange(within), time[-1])


def _fitted(time: Array, knots: Array, degree: int, values: Array, rates: Array | None = None, weight: float = 0.0) -> Any:
    """The spline that minimises sum |values - s|^2 + weight sum |rates - s'|^2, values and rates [n, k]."""
    t = np.concatenate([np.repeat(knots[0], degree), knots, np.repeat(knots[-1], degree)])
    a = BSpline.design_matrix(time, t, degree)
    normal, right = a.T @ a, a.T @ values
    if rates is not None:
        # a spline's derivative has the coefficients degree (c_{i+1} - c_i) / (t_{i+degree+1} - t_{i+1})
        share = degree / (t[degree + 1 : -1] - t[1 : -degree - 1])
        difference = sparse.diags_array([-share, share], offsets=[0, 1], shape=(len(share), len(share) + 1))
        b = BSpline.design_matrix(time, t[1:-1], degree - 1) @ difference
        normal, right = normal + weight * (b.T @ b), right + weight * (b.T @ rates)
    return BSpline(t, spsolve(normal.tocsc(), right), degree)
