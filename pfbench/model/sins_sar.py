"""SINS/SAR: errors of an INS, attitude as a quaternion, aided by a radar's heading and position and by a barometer."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.chart import Chart, Euclidean, Quaternion, wrap
from pfbench.covariance import factor
from pfbench.model.base import StateSpaceModel, independent_normal, normal_batch
from pfbench.nav import attitude, earth
from pfbench.nav.aiding import Alignment, Inflation
from pfbench.nav.sar import Sar, heading_difference
from pfbench.nav.sensors import ImuErrors
from pfbench.nav.strapdown import Intervals
from pfbench.record import Record

_SIZES = (4, 3, 3, 3, 3)  # quaternion, velocity, position, gyro bias, accelerometer bias
_CHART = Chart((Quaternion(), Euclidean(12)))
_AXES = {
    "attitude": (("E", "N", "U"), "rad"),
    "velocity": (("E", "N", "U"), "m/s"),
    "position": (("N", "E", "U"), "m"),
    "gyro_bias": (("x", "y", "z"), "rad/s"),
    "accelerometer_bias": (("x", "y", "z"), "m/s^2"),
}


class Step(NamedTuple):
    """What the INS makes of each interval, in its own frame n', with its errors.

    Attributes:
        dcm: mean body to level [R, T, 3, 3].
        forward: the body's forward axis at the end [R, T, 3].
        f: mean specific force [R, T, 3] m/s^2.
        vel: mean velocity [R, T, 3] m/s.
        pos: mean position [R, T, 3] rad, rad, m; pos_start and pos_end likewise.
        w_in: rate of the level frame in inertial space [R, T, 3] rad/s.
        free: gravity and Coriolis acceleration [R, T, 3] m/s^2.
        drift: rate of the position [R, T, 3] rad/s, rad/s, m/s.
        gain: noise in the chart [R, T, 15, W].
        duration: [R or 1, T] s.
    """

    dcm: Tensor
    forward: Tensor
    f: Tensor
    vel: Tensor
    pos: Tensor
    pos_start: Tensor
    pos_end: Tensor
    w_in: Tensor
    free: Tensor
    drift: Tensor
    gain: Tensor
    duration: Tensor


class SinsSar(StateSpaceModel):
    """State [16] [Yan et al. 2016, eq. 1]: attitude error quaternion; errors of velocity (E, N, U) and position (N, E, U) in
    metres; gyro and accelerometer bias in body axes. Errors are INS minus truth.

    The paper gives its f and h by reference only; this is the standard model for misalignments of any size [ours]. The
    quaternion turns the INS's level frame n' into the true one n, C_b^n = R(q) C_b^n'; with
    w = w_in' - R(q)^T w_in - C gyro_bias,

        q' = q [0, w] / 2,   dv' = (I - R(q)) f + R(q) C accelerometer_bias + free(INS) - free(truth),

    and the position's error grows by the difference of INS's and true position rates; biases are constant. A step is the
    midpoint rule with inputs that are means over the interval. Metres are those of the true position.

    White noise of gyros and accelerometers over an interval enters as x (+) G w with G = (-C, C) sqrt(T) times the densities:
    rank 6. With `noise_at_q` the velocity's part is R(q) C; all axes being alike, the law is the same.

    What is seen: the difference of headings, and the position's error in metres (North, East from the radar, Up from the
    barometer) [eqs. 4 and 5].

    Args:
        imu: what the model believes of the sensors.
        receiver: what it believes of radar and barometer.
        initial: what it believes of the initial errors.
        noise_at_q: the accelerometers' noise is turned by each state's own attitude error, as the continuous G(x) says; else it
            is not, as the paper prints G(t), and the noise is additive in the chart.
        inflation: noise added on purpose, or None.

    Raises:
        ValueError: a sensor without a constant bias or with a Markov part; `noise_at_q` together with `inflation`.
    """

    p0: Tensor
    r: Tensor
    density: Tensor

    def __init__(
        self, imu: ImuErrors, receiver: Sar, initial: Alignment, noise_at_q: bool = False, inflation: Inflation | None = None
    ) -> None:
        super().__init__()
        if imu.gyro_markov > 0 or imu.accelerometer_markov > 0:
            raise ValueError("model.imu: biases are constant here; set gyro_markov_deg_h and accelerometer_markov_ug to 0")
        biases = [imu.gyro_bias] * 3 + [imu.accelerometer_bias] * 3
        if min(biases) <= 0.0:
            raise ValueError(
                f"model.imu: gyro_bias_deg_h={imu.gyro_bias_deg_h}, accelerometer_bias_ug={imu.accelerometer_bias_ug}; "
                "give positive ones, of which the initial law is made"
            )
        if noise_at_q and inflation:
            raise ValueError("model.noise_at_q=true with model.inflation, which knows the chart alone: set noise_at_q=false")
        self.names = tuple(f"{group}_{axis}" for group, (axes, _) in _AXES.items() for axis in axes)
        self.units = tuple(unit for _, unit in _AXES.values() for _ in range(3))
        self.groups = {group: (3 * i, 3 * i + 1, 3 * i + 2) for i, group in enumerate(_AXES)}
        self.noise_at_q, self.inflation = noise_at_q, inflation
        density = [imu.gyro_random_walk] * 3 + [imu.accelerometer_random_walk] * 3
        self.register_buffer("p0", torch.cat([initial.sd, torch.tensor(biases, dtype=torch.float64)]))
        self.register_buffer("r", receiver.sd)
        self.register_buffer("density", torch.tensor(density, dtype=torch.float64))
        self.noise_dim = len(self.names) if inflation else 6
        self.choices = (
            "the attitude error quaternion turns the INS's level frame into the true one (multiplicative reading)",
            *([f"every filter's model is inflated: {inflation}"] if inflation else []),
        )

    @property
    def chart(self) -> Chart:
        return _CHART

    @property
    def anchor(self) -> Tensor:
        return self.p0

    @property
    def origin(self) -> Tensor:
        """No error."""
        return torch.cat([self.p0.new_ones(1), self.p0.new_zeros(15)])

    def prepare(self, record: Record) -> Record:
        """Intervals of the nominal trajectory to means over each, once for all steps."""
        return record if isinstance(record.u, Step) else record._replace(u=self.discretise(record.u))

    def discretise(self, u: Intervals) -> Step:
        """Means over intervals with leading axes [...]; the gain is that at the identity."""
        dcm = (u.dcm + u.dcm_end) / 2
        w_in, free, drift = (a.squeeze(-1) for a in surroundings(u.pos.unsqueeze(-1), u.vel.unsqueeze(-1)))
        gain = self._gain(dcm, u.duration)
        means = (dcm, u.dcm_end[..., 1], u.f, u.vel, u.pos, u.pos_start, u.pos_end, w_in, free, drift)
        return Step(*means, gain, u.duration)

    def _gain(self, dcm: Tensor, duration: Tensor) -> Tensor:
        """[..., 15, W]."""
        root = torch.sqrt(duration)[..., None, None]
        gyro, accelerometer = self.density.to(dcm).split(3)
        gain = dcm.new_zeros(*dcm.shape[:-2], 15, 6)
        gain[..., 0:3, 0:3], gain[..., 3:6, 3:6] = -dcm * gyro * root, dcm * accelerometer * root
        if self.inflation is None:
            return gain
        extra = torch.cat([self.inflation.motion, self.inflation.gyro, self.inflation.accelerometer])
        full, ok = factor(gain @ gain.mT + torch.diag(extra.to(gain).square()))
        if not bool(ok.all()):
            raise ValueError(f"model.inflation={self.inflation}: no square root of the noise exists; give every state some")
        return full

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Step, w: Tensor) -> Tensor:
        q, dv, metres, *biases = x.mT.split(_SIZES, -2)  # component-major from here on: [R, k, N]
        drifting, pushed = (u.dcm @ bias for bias in biases)
        pos_start, pos_end, span = u.pos_start.unsqueeze(-1), u.pos_end.unsqueeze(-1), u.duration[:, None, None]
        dp = from_metres(metres, pos_start)
        turn, push, slide = _rates(u, q, dv, dp, drifting, pushed)
        half = 0.5 * span
        turn, push, slide = _rates(u, _turned_on(q, turn * half), dv + push * half, dp + slide * half, drifting, pushed)
        q, plain = _turned_on(q, turn * span), [dv + push * span, to_metres(dp + slide * span, pos_end), *biases]
        shaken = u.gain @ w.mT
        tilt, rest = shaken.split((3, 12), -2)
        if self.noise_at_q:
            rest = torch.cat([_turned(_matrix(q), rest[..., :3, :]), rest[..., 3:, :]], -2)
        return torch.cat([_turned_on(q, tilt), torch.cat(plain, -2) + rest], -2).mT

    def noise_gain(self, u: Step) -> Tensor | None:
        return None if self.noise_at_q else u.gain

    def observation(self, x: Tensor, u: Step) -> Distribution:
        forward = u.forward.unsqueeze(-1)
        turn = heading_difference(forward.mT, _turned(_matrix(x.mT[:, :4]), forward).mT)
        return independent_normal(torch.cat([turn.unsqueeze(-2), x.mT[:, 7:10]], -2).mT, self.r)

    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        r = y - y_hat
        return torch.cat([wrap(r[..., :1]), r[..., 1:]], -1)

    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        """The true state of a flight, whose attitude error is `attitude.attitude_error`: {group: [R, T, 3]} -> [R, T, 16]."""
        laid = super().assemble(truth)  # [R, T, 16], the last component unused
        q = attitude.quaternion_from_dcm(attitude.dcm_from_euler(laid[..., :3]))
        return torch.cat([q, laid[..., 3:15]], -1)

    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        """Corrected navigation minus truth, attitude as a rotation vector; for the sensor states, estimate minus truth."""
        left = self.chart.subtract(truth, mean)
        return torch.cat([left[..., :9], -left[..., 9:]], -1)


# what follows works on [..., k, N]: components before particles, as a cloud lies in memory; N may be 1


def surroundings(pos: Tensor, vel: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """What place and velocity alone decide, at pos (rad, rad, m) and vel (E, N, U) [..., 3, N].

    Returns:
        Rate of the level frame in inertial space rad/s, gravity with Coriolis acceleration m/s^2, and rate of the position
        (rad/s, rad/s, m/s) [..., 3, N] each.
    """
    (lat, _, h), (v_e, v_n, v_u) = pos.unbind(-2), vel.unbind(-2)
    r_m, r_n = earth.radii(lat)
    sine, cosine = torch.sin(lat), torch.cos(lat)
    north, east = v_n / (r_m + h), v_e / (r_n + h)
    lon, spin_n, spin_u = east / cosine, earth.OMEGA * cosine, earth.OMEGA * sine
    w = torch.stack([-north, spin_n + east, spin_u + lon * sine], -2)
    c_e, c_n, c_u = -north, 2.0 * spin_n + east, 2.0 * spin_u + lon * sine
    free = [v_n * c_u - v_u * c_n, v_u * c_e - v_e * c_u, v_e * c_n - v_n * c_e - earth.gravity(lat, h)]
    return w, torch.stack(free, -2), torch.stack([north, lon, v_u], -2)


def to_metres(dp: Tensor, pos: Tensor) -> Tensor:
    """Position errors (rad, rad, m) of an INS at pos to North, East, Up in metres of the true place [..., 3, N]."""
    return dp * _metre_scale(pos - dp)


def from_metres(metres: Tensor, pos: Tensor) -> Tensor:
    """The inverse of `to_metres`; each pass gains the factor 0.01 error / Earth radius: 200 km are good to a millimetre."""
    dp = metres * metres.new_tensor([[0.0], [0.0], [1.0]])  # the height's error is known at once
    for _ in range(3):
        dp = metres / _metre_scale(pos - dp)
    return dp


def _metre_scale(pos: Tensor) -> Tensor:
    lat, _, h = pos.unbind(-2)
    r_m, r_n = earth.radii(lat)
    return torch.stack([r_m + h, (r_n + h) * torch.cos(lat), torch.ones_like(h)], -2)


def _rates(u: Step, q: Tensor, dv: Tensor, dp: Tensor, drifting: Tensor, pushed: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Rates of attitude (in n'), velocity error and position error; the sensors' errors are given in n'."""
    pos, vel, w_ins, f, free_ins, drift_ins = (a.unsqueeze(-1) for a in (u.pos, u.vel, u.w_in, u.f, u.free, u.drift))
    w_in, free, drift = surroundings(pos - dp, vel - dv)
    m = _matrix(q)
    turn = w_ins - (m * w_in.unsqueeze(-2)).sum(-3) - drifting  # transposed: true level frame to the INS's
    return turn, f - _turned(m, f - pushed) + free_ins - free, drift_ins - drift


def _turned(m: Tensor, a: Tensor) -> Tensor:
    """Matrices [..., 3, 3, N] times vectors [..., 3, N]."""
    return (m * a.unsqueeze(-3)).sum(-2)


def _matrix(q: Tensor) -> Tensor:
    """R(q) [..., 3, 3, N] of unit quaternions [..., 4, N]."""
    return (_MATRIX.to(q) @ _outer(q, q)).unflatten(-2, (3, 3))


def _turned_on(q: Tensor, r: Tensor) -> Tensor:
    """q exp(r) by the series of tan(|r| / 2), smooth at 0; at 0.1 rad it is good to 1e-10, and a step turns by 1e-4."""
    s = _square(r)
    small = torch.cat([torch.ones_like(s), r * (0.5 + s * (1.0 / 24.0 + s / 240.0))], -2)
    product = _PRODUCT.to(q) @ _outer(q, small)
    return product * torch.rsqrt(_square(product))


def _outer(p: Tensor, q: Tensor) -> Tensor:
    """All products of components [..., 16, N]: few operations, of which a filter that differentiates pays for each."""
    return (p.unsqueeze(-2) * q.unsqueeze(-3)).flatten(-3, -2)


def _square(a: Tensor) -> Tensor:
    return (a * a).sum(-2, keepdim=True)


def _tables() -> tuple[Tensor, Tensor]:
    """Rotation matrix [9, 16] and Hamilton's product [4, 16] as linear maps of the products of components."""
    unit = torch.eye(4, dtype=torch.float64)
    first, second = (a.flatten(0, 1) for a in torch.broadcast_tensors(unit[:, None], unit))
    whole, parts = attitude.dcm_from_quaternion(first + second), (attitude.dcm_from_quaternion(a) for a in (first, second))
    matrix = 0.5 * (whole - sum(parts, torch.zeros_like(whole)))  # polarised, since it is quadratic
    return matrix.flatten(1).T.contiguous(), attitude.quaternion_multiply(first, second).T.contiguous()


_MATRIX, _PRODUCT = _tables()
