"""INS mechanisation: attitude, velocity and position from sensor increments.

Two-sample (or one-sample) mechanisation in East, North, Up with coning, rotation and sculling
corrections [Savage 1998, "Strapdown inertial navigation integration algorithm design", parts 1
and 2; Yan Gongmin, PSINS].

This is the inner loop of every simulation. The step works component-major, [3, R] and
[3, 4, R], because eager torch spends its time on the number of operations, not on their size.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.nav import attitude, earth
from pfbench.nav.increments import prepare_steps


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

    Args:
        dcm: True attitude, [..., 3, 3].
        vel: True velocity, [..., 3].
        pos: True position, [..., 3].
        alpha: Attitude error East, North, Up, [R, 3], rad: C_ins = C(alpha)^T C_true.
        dvel: Velocity error East, North, Up, [R, 3], m/s.
        dpos: Position error North, East, Up, [R, 3], m, in the order of (dL, dlam, dh).

    Returns:
        State of the INS.
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

    Args:
        ins: State at the start.
        dtheta: Angle increments, body axes, [R, n, 3] (or [1, n, 3]), rad.
        dv: Velocity increments, body axes, [R, n, 3] (or [1, n, 3]), m/s.
        dt: Sampling interval in s: a number, or one per sample, [n] or [R, n]. Samples may be
            unequal. Samples of zero duration and zero increment change nothing, so they can pad.
        samples_per_interval: IMU samples in a filter interval, a divisor of n.
        samples_per_step: 2, or 1, which uses the previous sample for coning and sculling.
        tick: Called after each interval (for a progress bar).

    Returns:
        The state at the end, and the T = n / samples_per_interval intervals.

    Raises:
        ValueError: If the numbers of samples do not divide.
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
    if n != n_dv:
        raise ValueError(
            f"dtheta and dv must have the same number of samples, got {n} and {n_dv}. "
            "Give one of each per sample."
        )
    if per_step not in (1, 2):
        raise ValueError(f"samples_per_step must be 1 or 2, got {per_step}. Choose one.")
    if per_interval < 1 or per_interval % per_step:
        raise ValueError(
            f"samples_per_interval must be a positive multiple of samples_per_step={per_step}, "
            f"got {per_interval}. Choose an even number of samples, or samples_per_step=1."
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
