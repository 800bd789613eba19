"""Inertial navigation: from increments of angle and velocity to attitude, velocity and position.

Two-sample (or one-sample) mechanisation in East, North, Up with coning, rotation and sculling corrections
[Savage 1998, "Strapdown inertial navigation integration algorithm design", parts 1 and 2; Yan Gongmin, PSINS].

This is the hot loop of every simulation. What does not depend on the navigation state (coning, sculling, body
rotations) is done for many steps at once; the step itself works component-major, [3, R] and [3, 4, R], so that R runs
cost little more than one: eager torch spends its time on the number of operations, not on their size.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.nav import attitude, earth

_CHUNK = 256  # steps prepared at once: enough to hide the overhead, few enough to stay in the cache


class Ins(NamedTuple):
    """State of an inertial navigation system; R runs.

    Attributes:
        dcm: body to level, as the INS believes [R, 3, 3].
        vel: East, North, Up [R, 3] m/s.
        pos: latitude, longitude, height [R, 3] rad, rad, m.
        acc: mean acceleration over the last step [R, 3] m/s^2; it extrapolates the velocity to mid-step. Start with 0.
    """

    dcm: Tensor
    vel: Tensor
    pos: Tensor
    acc: Tensor


class Intervals(NamedTuple):
    """What an error-state filter needs of each of T filter intervals; all in the INS's own frame n', with its errors.

    Attributes:
        dcm: body to level at the start [R, T, 3, 3].
        dcm_end: at the end [R, T, 3, 3].
        pos: mean of start and end [R, T, 3] rad, rad, m.
        pos_start: [R, T, 3].
        pos_end: [R, T, 3].
        vel: mean of start and end [R, T, 3] m/s.
        vel_end: [R, T, 3].
        w_in: rate of the level frame in inertial space at pos and vel [R, T, 3] rad/s.
        f: mean specific force in n' [R, T, 3] m/s^2; not the last sample, which aliases vibration.
        duration: [R or 1, T] s.
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


def align(dcm: Tensor, vel: Tensor, pos: Tensor, alpha: Tensor, dvel: Tensor, dpos: Tensor) -> Ins:
    """An INS that starts from the truth plus errors (INS minus truth); everything broadcasts to R runs.

    Args:
        dcm: true attitude [..., 3, 3].
        vel: true velocity [..., 3].
        pos: true position [..., 3].
        alpha: attitude error East, North, Up [R, 3] rad: C_ins = C(alpha)^T C_true.
        dvel: velocity error East, North, Up [R, 3] m/s.
        dpos: position error North, East, Up [R, 3] m, the order of (dL, dlam, dh).
    """
    c = attitude.dcm_from_euler(alpha).transpose(-1, -2) @ dcm
    v, p = torch.broadcast_tensors(vel + dvel, pos + dpos / earth.metre_scale(pos))
    return Ins(c.expand(*v.shape, 3), v, p, torch.zeros_like(v))


@torch.no_grad()
def navigate(
    ins: Ins,
    dtheta: Tensor,
    dv: Tensor,
    dt: float | Tensor,
    samples_per_interval: int,
    samples_per_step: int = 2,
    tick: Callable[[], object] | None = None,
) -> tuple[Ins, Intervals]:
    """Run the mechanisation over all samples.

    Args:
        ins: state at the start.
        dtheta: angle increments, body axes [R, n, 3] (or [1, n, 3]) rad.
        dv: velocity increments, body axes [R, n, 3] (or [1, n, 3]) m/s.
        dt: sampling interval in s: a number, or one per sample, [n] or [R, n]. The corrections allow for unequal
            samples; one of no duration and no increment does nothing, so ragged intervals can be filled up with such.
        samples_per_interval: IMU samples in a filter interval; divides n.
        samples_per_step: 2, or 1, which uses the sample before (of this call) for coning and sculling.
        tick: called after each interval (a progress bar).

    Returns:
        The state at the end, and the T = n / samples_per_interval intervals.

    Raises:
        ValueError: numbers of samples that do not divide.
    """
    n, per_interval = dtheta.shape[-2], samples_per_interval
    _check(n, dv.shape[-2], per_interval, samples_per_step)
    runs = torch.broadcast_shapes(ins.vel.shape[:-1], dtheta.shape[:-2], dv.shape[:-2])
    d = torch.as_tensor(dt, dtype=dv.dtype, device=dv.device)
    d = d.expand(n)[None] if d.dim() < 2 else d
    state = _start(ins, runs)
    nodes, forces, impulse = [state], [], torch.zeros_like(state.v)
    for k, (turn, push, span) in enumerate(_steps(dtheta, dv, d, samples_per_step), start=1):
        state, force = _advance(state, turn, push, span)
        impulse = impulse + force
        if k * samples_per_step % per_interval == 0:
            nodes.append(state)
            forces.append(impulse)
            impulse = torch.zeros_like(impulse)
            if tick:
                tick()
    end = Ins(state.c.permute(2, 0, 1), state.v.T, state.p.T, state.a.T)
    return end, _intervals(nodes, forces, d.unflatten(-1, (-1, per_interval)).sum(-1))


class _State(NamedTuple):
    """Component-major: c [3, 3, R], v, p, a [3, R]; inv_rm [R] is 1 / (R_M + h) of the last step."""

    c: Tensor
    v: Tensor
    p: Tensor
    a: Tensor
    inv_rm: Tensor


def _check(n: int, n_dv: int, per_interval: int, per_step: int) -> None:
    if n != n_dv:
        raise ValueError(f"dtheta has {n} samples, dv has {n_dv}: give one of each per sample")
    if per_step not in (1, 2):
        raise ValueError(f"samples_per_step={per_step}: give 2, or 1")
    if per_interval < 1 or per_interval % per_step:
        raise ValueError(
            f"samples_per_interval={per_interval} is not a positive multiple of samples_per_step={per_step}: "
            "choose an even number of samples per filter interval, or samples_per_step=1"
        )
    if n < 1 or n % per_interval:
        raise ValueError(
            f"{n} samples are no whole number of intervals of samples_per_interval={per_interval}: "
            f"give {n - n % per_interval} or {n + -n % per_interval} samples"
        )


def _start(ins: Ins, runs: torch.Size) -> _State:
    c = ins.dcm.expand(*runs, 3, 3).permute(1, 2, 0).contiguous()
    v, p, a = (x.expand(*runs, 3).T.contiguous() for x in (ins.vel, ins.pos, ins.acc))
    return _State(c, v, p, a, 1 / (earth.radii(p[0])[0] + p[2]))


def _steps(dtheta: Tensor, dv: Tensor, d: Tensor, per_step: int) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """For each step: body rotation [3, 3, R], velocity increment in body axes of its start [3, 1, R], spans [3, R].

    The spans are half the duration, the duration, and its inverse.
    """
    n = dtheta.shape[-2]
    for begin in range(0, n, _CHUNK * per_step):
        stop = min(begin + _CHUNK * per_step, n)
        first = max(begin - 1, 0) if per_step == 1 else begin
        taken = (dtheta[..., first:stop, :], dv[..., first:stop, :], d[..., first:stop])
        turn, push, t = _corrected(*taken, per_step, has_previous=first < begin)
        inverse = torch.where(t > 0, 1 / t, torch.zeros_like(t))  # a filled-up step of no duration has no acceleration
        spans = torch.stack([t / 2, t, inverse], dim=-1)
        turns = attitude.dcm_from_rotation_vector(turn).permute(1, 2, 3, 0).contiguous()
        pushes = push.permute(1, 2, 0).unsqueeze(2).contiguous()
        yield from zip(turns.unbind(0), pushes.unbind(0), spans.permute(1, 2, 0).contiguous().unbind(0), strict=True)


def _corrected(
    dtheta: Tensor, dv: Tensor, d: Tensor, per_step: int, has_previous: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Rotation vector and velocity increment [R, s, 3] of s steps, and durations [R or 1, s].

    With rates linear in time over two samples of d1 and d2 seconds, both the coning and the sculling integral are cross
    products of the samples times (d1 + d2)^2 / (6 d1 d2), 2/3 for equal ones; over the second sample alone, times
    d2^2 / (6 d1 (d1 + d2)), 1/12. A force that is constant in a body that turns at a constant rate gives
    f + w x f / 2 + w x (w x f) / 6 + ..., from the series of the rotation; of what varies, second order is kept.
    """
    if per_step == 2:
        w1, w2, f1, f2, d1, d2 = *_pair(dtheta, -2), *_pair(dv, -2), *_pair(d, -1)
        w, f, t, factor = w1 + w2, f1 + f2, d1 + d2, (d1 + d2) ** 2 / (6 * d1 * d2)
    else:
        if not has_previous:
            dtheta, dv = (torch.cat([torch.zeros_like(x[..., :1, :]), x], dim=-2) for x in (dtheta, dv))
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


def _advance(s: _State, turn: Tensor, push: Tensor, spans: Tensor) -> tuple[_State, Tensor]:
    """One step; returns the state and the velocity that the specific force has added in n' [3, R]."""
    half, span, inverse = spans.unbind(0)
    v_mid = torch.addcmul(s.v, s.a, half)
    v_e, v_n, v_u = v_mid.unbind(0)
    lat, lon, h = s.p.unbind(0)
    lat_mid, h_mid = torch.addcmul(lat, v_n, half * s.inv_rm), torch.addcmul(h, v_u, half)
    sine, cosine = torch.sin(lat_mid), torch.cos(lat_mid)
    inv_rm, inv_rn, g = _local(sine * sine, h_mid)

    # rates of the level frame, and gravity with Coriolis terms
    inv_parallel = inv_rn / cosine
    w_n, w_u = cosine * earth.OMEGA, sine * earth.OMEGA
    lon_rate = v_e * inv_parallel
    rate = torch.stack([v_n * -inv_rm, torch.addcmul(w_n, lon_rate, cosine), torch.addcmul(w_u, lon_rate, sine)])
    c_e, c_n, c_u = rate[0], rate[1] + w_n, rate[2] + w_u
    free = torch.stack([c_u * v_n - c_n * v_u, c_e * v_u - c_u * v_e, torch.addcmul(c_n * v_e, c_e, v_n, value=-1) - g])

    # body rotation and velocity increment turned into n' together: [3, 4, R]
    b = torch.cat([turn.expand(3, 3, s.v.shape[-1]), push.expand(3, 1, s.v.shape[-1])], dim=1)
    m = s.c[:, 0, None] * b[0]
    m.addcmul_(s.c[:, 1, None], b[1]).addcmul_(s.c[:, 2, None], b[2])
    q = _cross(rate * span, m)
    force = torch.add(m[:, 3], q[:, 3], alpha=-0.5)
    # R(-w T) to second order: the third is below 1e-17 at 100 Hz and 1e-12 at 1 Hz
    c = m[:, :3] - q[:, :3] + 0.5 * _cross(rate * span, q[:, :3])

    v = s.v + torch.addcmul(force, free, span)
    mean = (s.v + v) * half
    p = torch.stack([torch.addcmul(lat, mean[1], inv_rm), torch.addcmul(lon, mean[0], inv_parallel), h + mean[2]])
    return _State(c, v, p, (v - s.v) * inverse, inv_rm), force


def _local(s2: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """1 / (R_M + h), 1 / (R_N + h) and gravity from sin^2 of the latitude, sharing terms."""
    w = torch.rsub(s2, 1.0, alpha=earth.E2)
    root = torch.rsqrt(w)
    r_n = root * earth.A
    g0 = root * (s2 * (earth.G_EQUATOR * earth.G_SOMIGLIANA) + earth.G_EQUATOR)
    linear = s2 * (4 * earth.F_E / earth.A) - 2 / earth.A * (1 + earth.F_E + earth.M_RATIO)
    g = g0 * (1 + h * torch.add(linear, h, alpha=3 / earth.A**2))
    return torch.reciprocal(torch.addcdiv(h, r_n, w, value=1 - earth.E2)), torch.reciprocal(r_n + h), g


def _cross(w: Tensor, m: Tensor) -> Tensor:
    """w x each column: [3, R], [3, k, R] -> [3, k, R]."""
    x, y, z = w.unbind(0)
    a, b, c = m.unbind(0)
    return torch.stack([y * c - z * b, z * a - x * c, x * b - y * a])


def _intervals(nodes: list[_State], forces: list[Tensor], duration: Tensor) -> Intervals:
    dcm = torch.stack([s.c for s in nodes]).permute(3, 0, 1, 2).contiguous()  # [R, T + 1, 3, 3]
    vel = torch.stack([s.v for s in nodes]).permute(2, 0, 1).contiguous()  # [R, T + 1, 3]
    pos = torch.stack([s.p for s in nodes]).permute(2, 0, 1).contiguous()
    f = torch.stack(forces).permute(2, 0, 1) / torch.where(duration > 0, duration, 1.0).unsqueeze(-1)
    pos_mid, vel_mid = (pos[:, :-1] + pos[:, 1:]) / 2, (vel[:, :-1] + vel[:, 1:]) / 2
    w_in = earth.earth_rate(pos_mid[..., 0]) + earth.transport_rate(pos_mid[..., 0], pos_mid[..., 2], vel_mid)
    return Intervals(
        dcm[:, :-1], dcm[:, 1:], pos_mid, pos[:, :-1], pos[:, 1:], vel_mid, vel[:, 1:], w_in, f, duration
    )
