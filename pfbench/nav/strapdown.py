"""INS mechanisation from sensor increments: coning and sculling, attitude, velocity and position, preintegration."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.core.parameter_checks import require
from pfbench.nav import attitude, earth

# Two-sample (or one-sample) mechanisation in East, North, Up with coning, rotation and sculling
# corrections [Savage 1998, "Strapdown inertial navigation integration algorithm design", parts 1
# and 2; Yan Gongmin, PSINS].
#
# This is the inner loop of every simulation. The step works component-major, [3, R] and
# [3, 4, R], because eager torch spends its time on the number of operations, not on their size.


class InsState(NamedTuple):
    """State of an inertial navigation system.

    Attributes:
        dcm: Body to level, with the INS errors, [R, 3, 3].
        vel: East, North, Up, [R, 3], m/s.
        pos: Latitude, longitude, height, [R, 3], rad, rad, m.
        acc: Mean acceleration over the last step, [R, 3], m/s^2. It extrapolates the velocity to
            the middle of a step. Start with 0.
    """

    dcm: Tensor
    vel: Tensor
    pos: Tensor
    acc: Tensor


class InsIntervals(NamedTuple):
    """Inputs of an error-state filter for T intervals, in the INS level frame n'.

    Attributes:
        dcm: Body to level at the start, [R, T, 3, 3].
        dcm_end: Body to level at the end, [R, T, 3, 3].
        pos: Mean of start and end, [R, T, 3], rad, rad, m.
        pos_start: Position at the start, [R, T, 3].
        pos_end: Position at the end, [R, T, 3].
        vel: Mean of start and end, [R, T, 3], m/s.
        vel_end: Velocity at the end, [R, T, 3].
        w_in: Rate of the level frame in inertial space at pos and vel, [R, T, 3], rad/s.
        f: Mean specific force in n', [R, T, 3], m/s^2. The last sample would alias vibration.
        duration: [R or 1, T], s.
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


def align(
    dcm: Tensor, vel: Tensor, pos: Tensor, alpha: Tensor, dvel: Tensor, dpos: Tensor
) -> InsState:
    """Start an INS from the truth plus errors (INS minus truth), broadcast to R runs.

    Returns state of the INS. Shapes: dcm [..., 3, 3], vel [..., 3], pos [..., 3], alpha [R, 3],
    dvel [R, 3], dpos [R, 3].
    """
    c = attitude.dcm_from_euler(alpha).transpose(-1, -2) @ dcm
    v, p = torch.broadcast_tensors(vel + dvel, pos + dpos / earth.metre_scale(pos))
    return InsState(c.expand(*v.shape, 3), v, p, torch.zeros_like(v))


@torch.no_grad()
def navigate(
    ins: InsState,
    dtheta: Tensor,
    dv: Tensor,
    dt: float | Tensor,
    samples_per_interval: int,
    samples_per_step: int = 2,
    tick: Callable[[], object] | None = None,
) -> tuple[InsState, InsIntervals]:
    """Run the mechanisation over all samples.

    Returns the state at the end, and the T = n / samples_per_interval intervals. Shapes: dtheta
    [R, n, 3], dv [R, n, 3], dt [n].
    """
    n, per_interval = dtheta.shape[-2], samples_per_interval
    _check_samples(n, dv.shape[-2], per_interval, samples_per_step)
    runs = torch.broadcast_tensors(ins.vel[..., 0], dtheta[..., 0, 0], dv[..., 0, 0])[0].shape
    d = torch.as_tensor(dt, dtype=dv.dtype, device=dv.device)
    d = d.expand(n)[None] if d.dim() < 2 else d
    state = _start(ins, runs)
    nodes, forces, impulse = [state], [], torch.zeros_like(state.v)
    for k, (turn, push, span) in enumerate(prepare_steps(dtheta, dv, d, samples_per_step), start=1):
        state, force = _advance(state, turn, push, span)
        impulse = impulse + force
        if k * samples_per_step % per_interval == 0:
            nodes.append(state)
            forces.append(impulse)
            impulse = torch.zeros_like(impulse)
            if tick:
                tick()
    end = InsState(state.c.permute(2, 0, 1), state.v.T, state.p.T, state.a.T)
    return end, _intervals(nodes, forces, d.unflatten(-1, (-1, per_interval)).sum(-1))


class _State(NamedTuple):
    """Component-major state: c [3, 3, R], v, p, a [3, R], inv_rm = 1 / (R_M + h) [R]."""

    c: Tensor
    v: Tensor
    p: Tensor
    a: Tensor
    inv_rm: Tensor


def _check_samples(n: int, n_dv: int, per_interval: int, per_step: int) -> None:
    """Raise ValueError unless the numbers of samples divide."""
    require(
        n == n_dv,
        "dtheta and dv",
        "have the same number of samples",
        f"{n} and {n_dv}",
        "Give one of each per sample.",
    )
    require(per_step in (1, 2), "samples_per_step", "be 1 or 2", per_step)
    require(
        not per_interval < 1 and (not per_interval % per_step),
        "samples_per_interval",
        f"be a positive multiple of samples_per_step={per_step}",
        per_interval,
        "Choose an even number of samples, or samples_per_step=1.",
    )
    if n < 1 or n % per_interval:
        raise ValueError(
            f"the number of samples must be a multiple of samples_per_interval={per_interval}, "
            f"got {n}. Give {n - n % per_interval} or {n + -n % per_interval} samples."
        )


def _start(ins: InsState, runs: torch.Size) -> _State:
    c = ins.dcm.expand(*runs, 3, 3).permute(1, 2, 0).contiguous()
    v, p, a = (x.expand(*runs, 3).T.contiguous() for x in (ins.vel, ins.pos, ins.acc))
    return _State(c, v, p, a, 1 / (earth.radii(p[0])[0] + p[2]))


def _advance(s: _State, turn: Tensor, push: Tensor, spans: Tensor) -> tuple[_State, Tensor]:
    """Advance one step and return also the velocity change by specific force [3, R]."""
    half, span, inverse = spans.unbind(0)
    v_mid = torch.addcmul(s.v, s.a, half)
    v_e, v_n, v_u = v_mid.unbind(0)
    lat, lon, h = s.p.unbind(0)
    lat_mid, h_mid = torch.addcmul(lat, v_n, half * s.inv_rm), torch.addcmul(h, v_u, half)
    sine, cosine = torch.sin(lat_mid), torch.cos(lat_mid)
    inv_rm, inv_rn, g = earth.inverse_radii_and_gravity(sine * sine, h_mid)

    # rates of the level frame, and gravity with Coriolis terms
    inv_parallel = inv_rn / cosine
    w_n, w_u = cosine * earth.OMEGA, sine * earth.OMEGA
    lon_rate = v_e * inv_parallel
    rate = torch.stack(
        [v_n * -inv_rm, torch.addcmul(w_n, lon_rate, cosine), torch.addcmul(w_u, lon_rate, sine)]
    )
    c_e, c_n, c_u = rate[0], rate[1] + w_n, rate[2] + w_u
    free = torch.stack(
        [
            c_u * v_n - c_n * v_u,
            c_e * v_u - c_u * v_e,
            torch.addcmul(c_n * v_e, c_e, v_n, value=-1) - g,
        ]
    )

    # body rotation and velocity increment rotated to n' in one operation: [3, 4, R]
    b = torch.cat([turn.expand(3, 3, s.v.shape[-1]), push.expand(3, 1, s.v.shape[-1])], dim=1)
    m = s.c[:, 0, None] * b[0]
    m.addcmul_(s.c[:, 1, None], b[1]).addcmul_(s.c[:, 2, None], b[2])
    q = _cross(rate * span, m)
    force = torch.add(m[:, 3], q[:, 3], alpha=-0.5)
    # R(-w T) to second order: the third is below 1e-17 at 100 Hz and 1e-12 at 1 Hz
    c = m[:, :3] - q[:, :3] + 0.5 * _cross(rate * span, q[:, :3])

    v = s.v + torch.addcmul(force, free, span)
    mean = (s.v + v) * half
    p = torch.stack(
        [
            torch.addcmul(lat, mean[1], inv_rm),
            torch.addcmul(lon, mean[0], inv_parallel),
            h + mean[2],
        ]
    )
    return _State(c, v, p, (v - s.v) * inverse, inv_rm), force


def _cross(w: Tensor, m: Tensor) -> Tensor:
    """Compute w x each column: [3, R], [3, k, R] -> [3, k, R]."""
    x, y, z = w.unbind(0)
    a, b, c = m.unbind(0)
    return torch.stack([y * c - z * b, z * a - x * c, x * b - y * a])


def _intervals(nodes: list[_State], forces: list[Tensor], duration: Tensor) -> InsIntervals:
    dcm = torch.stack([s.c for s in nodes]).permute(3, 0, 1, 2).contiguous()  # [R, T + 1, 3, 3]
    vel = torch.stack([s.v for s in nodes]).permute(2, 0, 1).contiguous()  # [R, T + 1, 3]
    pos = torch.stack([s.p for s in nodes]).permute(2, 0, 1).contiguous()
    f = torch.stack(forces).permute(2, 0, 1) / torch.where(duration > 0, duration, 1.0).unsqueeze(
        -1
    )
    pos_mid, vel_mid = (pos[:, :-1] + pos[:, 1:]) / 2, (vel[:, :-1] + vel[:, 1:]) / 2
    w_in = earth.earth_rate(pos_mid[..., 0]) + earth.transport_rate(
        pos_mid[..., 0], pos_mid[..., 2], vel_mid
    )
    return InsIntervals(
        dcm[:, :-1],
        dcm[:, 1:],
        pos_mid,
        pos[:, :-1],
        pos[:, 1:],
        vel_mid,
        vel[:, 1:],
        w_in,
        f,
        duration,
    )


# --------------------------------------------------------------------------------------------------
# Coning and sculling corrections of inertial increments, for many steps at once.
#
# Rotation vectors and velocity increments do not depend on the navigation state
# [Savage 1998, "Strapdown inertial navigation integration algorithm design", parts 1 and 2].

_CHUNK = 256  # steps prepared at once: hides the overhead and fits in the cache


def prepare_steps(
    dtheta: Tensor, dv: Tensor, d: Tensor, per_step: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield body rotation, velocity increment and spans of each step.

    Shapes: dtheta [R or 1, n, 3], dv [R or 1, n, 3], d [R or 1, n].
    """
    n = dtheta.shape[-2]
    for begin in range(0, n, _CHUNK * per_step):
        stop = min(begin + _CHUNK * per_step, n)
        first = max(begin - 1, 0) if per_step == 1 else begin
        chunk = (dtheta[..., first:stop, :], dv[..., first:stop, :], d[..., first:stop])
        turn, push, t = correct_coning_sculling(*chunk, per_step, has_previous=first < begin)
        inverse = torch.where(t > 0, 1 / t, torch.zeros_like(t))  # a padded step has t = 0
        spans = torch.stack([t / 2, t, inverse], dim=-1)
        turns = attitude.dcm_from_rotation_vector(turn).permute(1, 2, 3, 0).contiguous()
        pushes = push.permute(1, 2, 0).unsqueeze(2).contiguous()
        yield from zip(
            turns.unbind(0),
            pushes.unbind(0),
            spans.permute(1, 2, 0).contiguous().unbind(0),
            strict=True,
        )


def correct_coning_sculling(
    dtheta: Tensor, dv: Tensor, d: Tensor, per_step: int, has_previous: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute rotation vectors, velocity increments and durations of steps.

    Rates are linear in time over two samples of d1 and d2 seconds. The coning and the sculling
    integral are then cross products of the samples times (d1 + d2)^2 / (6 d1 d2), 2/3 for equal
    samples. Over the second sample alone the factor is d2^2 / (6 d1 (d1 + d2)), 1/12. A constant
    force in a body that turns at a constant rate gives f + w x f / 2 + w x (w x f) / 6 + ...
    Terms of the varying part are correct to second order.

    Returns rotation vectors and velocity increments [R, s, 3], and durations [R or 1, s]. Shapes:
    dtheta [R or 1, n, 3], dv [R or 1, n, 3], d [R or 1, n].
    """
    if per_step == 2:
        w1, w2, f1, f2, d1, d2 = *_pair(dtheta, -2), *_pair(dv, -2), *_pair(d, -1)
        w, f, t, factor = w1 + w2, f1 + f2, d1 + d2, (d1 + d2) ** 2 / (6 * d1 * d2)
    else:
        if not has_previous:
            dtheta, dv = (
                torch.cat([torch.zeros_like(x[..., :1, :]), x], dim=-2) for x in (dtheta, dv)
            )
            d = torch.cat([d[..., :1], d], dim=-1)
        w1, w2, f1, f2, d1, d2 = *_lag(dtheta, -2), *_lag(dv, -2), *_lag(d, -1)
        w, f, t, factor = w2, f2, d2, d2**2 / (6 * d1 * (d1 + d2))
    factor = torch.where((d1 > 0) & (d2 > 0), factor, torch.zeros_like(factor)).unsqueeze(-1)
    coning = factor * torch.linalg.cross(w1, w2)
    sculling = factor * (torch.linalg.cross(w1, f2) + torch.linalg.cross(f1, w2))
    swept = torch.linalg.cross(w, f)
    return w + coning, f + 0.5 * swept + torch.linalg.cross(w, swept) / 6 + sculling, t


def _pair(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    first, second = x.unflatten(dim, (-1, 2)).unbind(dim)
    return first, second


def _lag(x: Tensor, dim: int) -> tuple[Tensor, Tensor]:
    return x.narrow(dim, 0, x.shape[dim] - 1), x.narrow(dim, 1, x.shape[dim] - 1)


# --------------------------------------------------------------------------------------------------
# Preintegration of IMU samples over filter intervals, with bias corrections.
#
# [Forster, Carlone, Dellaert, Scaramuzza 2017, "On-manifold preintegration for real-time
# visual-inertial odometry"]


class PreintegratedImu(NamedTuple):
    """IMU increments of each interval, in body axes at its start, without gravity.

    Body axes are right, forward, up.

    Attributes:
        rotation: Rotation from the body at the end to the body at the start, quaternion,
            [R or 1, T, 4].
        velocity_increment: Velocity increment, [R or 1, T, 3], m/s.
        position_increment: Position increment from rest, [R or 1, T, 3], m.
        jacobian: Derivatives of (rotation vector on the right of `rotation`, velocity and position
            increment) with respect to (gyro, accelerometer) bias, [R or 1, T, 9, 6].
        bias: Gyro and accelerometer bias that were subtracted, [R or 1, T, 6], rad/s, m/s^2.
        gravity: [R or 1, T], m/s^2, downwards.
        duration: [R or 1, T], s. 0 pads a short run: the interval changes nothing.
    """

    rotation: Tensor
    velocity_increment: Tensor
    position_increment: Tensor
    jacobian: Tensor
    bias: Tensor
    gravity: Tensor
    duration: Tensor


@torch.no_grad()
def preintegrate(
    force: Tensor, rate: Tensor, spans: Tensor, bias: Tensor
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Preintegrate S samples of an interval, each with mean force and angular rate.

    The force of a sample is rotated by the attitude at its middle, which is second order. Samples
    of zero duration change nothing and can pad intervals with fewer samples.

    Returns rotation [..., 4], velocity and position increment [..., 3] and Jacobian [..., 9, 6],
    see `PreintegratedImu`. Shapes: force [..., S, 3], rate [..., S, 3], spans [..., S], bias
    [..., 6].
    """
    half_turn = (rate - bias[..., None, :3]) * (0.5 * spans.unsqueeze(-1))
    halves = attitude.dcm_from_rotation_vector(half_turn)
    slips = 0.5 * spans[..., None, None] * right_jacobian(half_turn)
    f = force - bias[..., None, 3:]
    c = torch.eye(3, dtype=f.dtype, device=f.device).expand(*f.shape[:-2], 3, 3)
    v, p = torch.zeros_like(f[..., 0, :]), torch.zeros_like(f[..., 0, :])
    by_c, by_v, by_p = (
        f.new_zeros(*f.shape[:-2], 3, k) for k in (3, 6, 6)
    )  # by_c: gyro bias alone
    for k in range(spans.shape[-1]):
        half, slip, dt = halves[..., k, :, :], slips[..., k, :, :], spans[..., k, None]
        middle, by_middle = c @ half, half.mT @ by_c - slip
        a = (middle @ f[..., k, :, None]).squeeze(-1)
        by_a = torch.cat([-middle @ attitude.skew(f[..., k, :]) @ by_middle, -middle], -1)
        p, by_p = (
            p + (v + 0.5 * a * dt) * dt,
            by_p + (by_v + 0.5 * by_a * dt[..., None]) * dt[..., None],
        )
        v, by_v = v + a * dt, by_v + by_a * dt[..., None]
        c, by_c = middle @ half, half.mT @ by_middle - slip
    top = torch.cat([by_c, torch.zeros_like(by_c)], -1)
    return attitude.quaternion_from_dcm(c), v, p, torch.cat([top, by_v, by_p], -2)


def right_jacobian(r: Tensor) -> Tensor:
    """Compute J with exp(r + d) = exp(r) exp(J d) to first order in d, [..., 3, 3].

    Correct to third order in the rotation vector r [..., 3].
    """
    k = attitude.skew(r)
    unit = torch.eye(3, dtype=r.dtype, device=r.device)
    return unit - 0.5 * k + k @ k / 6.0 - k @ k @ k / 24.0


def rotate(q: Tensor, a: Tensor) -> Tensor:
    """Rotate vectors by unit quaternions.

    Shapes: q [..., 4], a [..., 3].
    """
    axis, a = torch.broadcast_tensors(q[..., 1:], a)
    twice = 2.0 * torch.linalg.cross(axis, a)
    return a + q[..., :1] * twice + torch.linalg.cross(axis, twice)
