"""Coning and sculling corrections of inertial increments, for many steps at once.

Rotation vectors and velocity increments do not depend on the navigation state
[Savage 1998, "Strapdown inertial navigation integration algorithm design", parts 1 and 2].
"""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

from pfbench.nav import attitude

_CHUNK = 256  # steps prepared at once: hides the overhead and fits in the cache


def prepare_steps(
    dtheta: Tensor, dv: Tensor, d: Tensor, per_step: int
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Yield body rotation, velocity increment and spans of each step.

    Args:
        dtheta: Angle increments, [R or 1, n, 3], rad.
        dv: Velocity increments, [R or 1, n, 3], m/s.
        d: Sampling intervals, [R or 1, n], s.
        per_step: Samples per step, 1 or 2.

    Yields:
        Body rotation, [3, 3, R], velocity increment in body axes at the start of the step,
        [3, 1, R], and spans, [3, R]. The spans are half the duration, the duration, and its inverse.
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

    Args:
        dtheta: Angle increments, [R or 1, n, 3], rad.
        dv: Velocity increments, [R or 1, n, 3], m/s.
        d: Sampling intervals, [R or 1, n], s.
        per_step: Samples per step, 1 or 2.
        has_previous: Whether the first sample precedes the first step (one sample per step).

    Returns:
        Rotation vectors and velocity increments [R, s, 3], and durations [R or 1, s].
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
