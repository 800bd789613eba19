"""Extended Kalman filter of StrapdownTotal in closed form for a batch of noise numbers, with lever arm and delay of the fixes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.core.chart import rotation_vector_from_quaternion
from pfbench.core.record import Record
from pfbench.model.strapdown_tuning import StrapdownTuning
from pfbench.nav.attitude import dcm_from_quaternion, dcm_from_rotation_vector, skew
from pfbench.nav.strapdown import PreintegratedImu, right_jacobian

_EYE = torch.eye(3, dtype=torch.float64)
_HALF_LOG_TURN = 0.5 * math.log(2 * math.pi)


class FixTerms(NamedTuple):
    """Terms of each fix in a pass, for V values, G records and F fixes with m components.

    Attributes:
        log_density: Log density of the fix given those before, [V, G, F]. 0 where a record lacks it.
        innovation: Fix minus its prediction, [V, G, F, m]. 0 where a component is missing.
        covariance: Covariance of the innovation, [V, G, F, m, m]. The unit matrix in missing components.
        position: Estimate after the fix, [V, G, F, 3], m.
        position_variance: Its variance, [V, G, F, 3], m^2.
    """

    log_density: Tensor
    innovation: Tensor
    covariance: Tensor
    position: Tensor
    position_variance: Tensor

    @property
    def nis(self) -> Tensor:
        """Normalised innovations squared, [V, G, F]."""
        white = torch.linalg.solve_ex(self.covariance, self.innovation.unsqueeze(-1))[0]
        return (self.innovation * white.squeeze(-1)).sum(-1)


class _Belief(NamedTuple):
    """Mean and covariance of each value and record: attitude matrix, velocity, position, biases, [V, G, ...]."""

    turn: Tensor
    velocity: Tensor
    position: Tensor
    bias: Tensor
    covariance: Tensor


class _Noise(NamedTuple):
    """Noise numbers as the filter reads them: densities squared [V, 1, 12], fix variances [V, 1, m], lever arm, delay."""

    density: Tensor
    fix: Tensor
    lever: Tensor
    delay: Tensor


@dataclass(frozen=True)
class FixFilter:
    """The filter over the records of a log: values of the noise numbers are a batch.

    The evidence is that of an extended Kalman filter of StrapdownTotal with the same numbers. Fixes are those of an antenna
    at the lever arm l that are late by the delay tau:
    p + C l - tau (v + C (w x l)). The mean rate of the step is w.

    Attributes:
        record: Measurements of StrapdownTotal with starts, y [G, T, 3 or 6].
        tuning: Numbers that are not among the values, and the spread of the starts.
    """

    record: Record
    tuning: StrapdownTuning

    @cached_property
    def fix_steps(self) -> list[int]:
        """Steps at which a record has a fix."""
        return torch.nonzero(torch.isfinite(self.record.y).any(-1).any(0))[:, 0].tolist()

    @property
    def numbers(self) -> dict[str, float]:
        """The noise numbers of the tuning by name: standard deviations of a pair of level axes are one number."""
        numbers = {name: float(getattr(self.tuning, name)) for name in DENSITIES}
        for name in FIX_KINDS[: self.record.y.shape[-1] // 3]:
            east, north, up = getattr(self.tuning, f"{name}_sd")
            numbers |= {f"{name}_horizontal": math.hypot(east, north) / math.sqrt(2.0), f"{name}_vertical": float(up)}  # fmt: skip
        # the delay of a fix with velocity would need the acceleration
        geometry = LEVER if self.record.y.shape[-1] > len(LEVER) else (*LEVER, "delay")
        return numbers | dict.fromkeys(geometry, 0.0)

    def __call__(self, values: Mapping[str, Tensor]) -> FixTerms:
        """Pass over the records.

        Args:
            values: Noise numbers by name, [V]; the others are those of the tuning.

        Returns:
            Terms of the fixes.
        """
        u = PreintegratedImu(*(a.double() for a in self.record.u))
        turns, noise = dcm_from_quaternion(u.rotation), self._arrange(values)
        belief, rows = self._start(len(noise.density)), []
        for t, y in enumerate(self.record.y.double().unbind(1)):
            step = PreintegratedImu(*(a[:, t] for a in u))
            belief = _predict(belief, step, turns[:, t], noise.density)
            if t in self.fix_steps:
                belief, row = _update(belief, y, _mean_rate(step, belief.bias), noise)
                rows.append(row)
        return FixTerms(*(torch.stack(column, 2) for column in zip(*rows, strict=True)))

    def _arrange(self, values: Mapping[str, Tensor]) -> _Noise:
        """Arrange the values as a filter reads them."""
        count = len(next(iter(values.values())))
        full = {
            k: values.get(k, torch.tensor(v).double()).double().expand(count)
            for k, v in ({"delay": 0.0} | self.numbers).items()
        }
        density = torch.stack([full[name] for name in DENSITIES], -1).repeat_interleave(3, -1)
        kinds = FIX_KINDS[: self.record.y.shape[-1] // 3]
        axes = ("horizontal", "horizontal", "vertical")
        fix = torch.stack([full[f"{kind}_{axis}"] for kind in kinds for axis in axes], -1)
        lever = torch.stack([full[name] for name in LEVER], -1)
        return _Noise(*(a.unsqueeze(1) for a in (density.square(), fix.square(), lever, full["delay"])))  # fmt: skip

    def _start(self, count: int) -> _Belief:
        """Return the belief before the first step."""
        start, spread = self.record.start, self.record.spread
        assert start is not None
        q, velocity, position, bias = (
            a.double().expand(count, -1, -1) for a in start.split((4, 3, 3, 6), -1)
        )
        root = torch.diag(self.tuning.initial_sd) if spread is None else spread.double()
        covariance = (root @ root.mT).expand(count, len(start), -1, -1)
        return _Belief(dcm_from_quaternion(q), velocity, position, bias, covariance)


DENSITIES = ("gyro_density", "accelerometer_density", "gyro_bias_walk", "accelerometer_bias_walk")
FIX_KINDS = ("position", "velocity")
LEVER = ("lever_right", "lever_forward", "lever_up")


def _apply(matrix: Tensor, vector: Tensor) -> Tensor:
    """Multiply matrices [..., n, k] by vectors [..., k]."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _predict(belief: _Belief, u: PreintegratedImu, turn: Tensor, density: Tensor) -> _Belief:
    """Advance mean and covariance over a step; its attitude is `belief.turn` before and after."""
    c, velocity, position, bias, covariance = belief
    change = _apply(u.jacobian, bias - u.bias)
    rotation, push, shift = change.split(3, -1)
    push, shift = push + u.velocity_increment, shift + u.position_increment
    full_turn, span = turn @ dcm_from_rotation_vector(rotation), u.duration[:, None]
    fall = torch.zeros_like(velocity)
    fall[..., 2] = -u.gravity * u.duration
    f = torch.eye(15, dtype=torch.float64).repeat(*velocity.shape[:-1], 1, 1)
    f[..., :3, :3] = full_turn.mT
    f[..., :3, 9:] = right_jacobian(rotation) @ u.jacobian[:, :3]
    f[..., 3:6, :3], f[..., 6:9, :3] = -c @ skew(push), -c @ skew(shift)
    f[..., 3:6, 9:], f[..., 6:9, 9:] = c @ u.jacobian[:, 3:6], c @ u.jacobian[:, 6:]
    f[..., 6:9, 3:6] = span.unsqueeze(-1) * _EYE
    q = torch.diag_embed(torch.cat([density[..., :6], density[..., 3:]], -1) * _spans(span))
    q[..., 3:6, 6:9] = q[..., 6:9, 3:6] = torch.diag_embed(0.5 * span**2 * density[..., 3:6])
    position = position + (velocity + 0.5 * fall) * span + _apply(c, shift)
    velocity = velocity + fall + _apply(c, push)
    return _Belief(c @ full_turn, velocity, position, bias, f @ covariance @ f.mT + q)


def _spans(span: Tensor) -> Tensor:
    """Return the factors on squared densities of attitude, velocity, position and biases, [G or 1, 15]."""
    ones = span.new_ones(1, 3)
    return torch.cat([span * ones, span * ones, 0.25 * span**3 * ones, span * ones, span * ones], -1)  # fmt: skip


def _mean_rate(u: PreintegratedImu, bias: Tensor) -> Tensor:
    """Return the mean rate of a step without the gyro bias, body axes, rad/s."""
    span = u.duration.clamp(min=1e-9).unsqueeze(-1)  # a padded step does not turn
    return rotation_vector_from_quaternion(u.rotation) / span + u.bias[:, :3] - bias[..., :3]


def _observe(belief: _Belief, rate: Tensor, noise: _Noise, size: int) -> tuple[Tensor, Tensor]:
    """Return mean and Jacobian of a fix."""
    c, lever, late = belief.turn, noise.lever, noise.delay[..., None, None]
    swept = torch.linalg.cross(*torch.broadcast_tensors(rate, lever))
    fast = belief.velocity + _apply(c, swept)
    mean = belief.position + _apply(c, lever) - late[..., 0] * fast
    h = mean.new_zeros(*mean.shape[:-1], size, 15)
    h[..., :3, 6:9] = _EYE
    h[..., :3, :3] = c @ (late * skew(swept) - skew(lever))
    h[..., :3, 3:6] = -late * _EYE
    h[..., :3, 9:12] = -late * (c @ skew(lever))
    if size > 3:
        mean = torch.cat([mean, fast], -1)
        h[..., 3:, 3:6] = _EYE
        h[..., 3:, :3], h[..., 3:, 9:12] = -c @ skew(swept), c @ skew(lever)
    return mean, h


def _update(belief: _Belief, y: Tensor, rate: Tensor, noise: _Noise) -> tuple[_Belief, FixTerms]:
    """Condition on a fix; a missing component changes nothing."""
    mean, h = _observe(belief, rate, noise, y.shape[-1])
    has_value = torch.isfinite(y)
    innovation = torch.where(has_value, y - mean, 0.0)
    h = h * has_value.unsqueeze(-1)
    gain = belief.covariance @ h.mT
    s = h @ gain + torch.diag_embed(torch.where(has_value, noise.fix, 1.0))
    root, failed = torch.linalg.cholesky_ex(s)
    white = torch.linalg.solve_triangular(root, torch.cat([innovation.unsqueeze(-1), gain.mT], -1), upper=False)  # fmt: skip
    e, w = white[..., 0], white[..., 1:]
    log_density = -0.5 * e.square().sum(-1) - root.diagonal(dim1=-2, dim2=-1).log().sum(-1) - _HALF_LOG_TURN * has_value.sum(-1)  # fmt: skip
    step = _apply(w.mT, e)
    covariance = belief.covariance - w.mT @ w
    turn, velocity, position, bias = step.split((3, 3, 3, 6), -1)
    after = _Belief(
        belief.turn @ dcm_from_rotation_vector(turn), belief.velocity + velocity, belief.position + position,
        belief.bias + bias, 0.5 * (covariance + covariance.mT),
    )  # fmt: skip
    terms = torch.where(failed > 0, -torch.inf, log_density)
    variance = after.covariance.diagonal(dim1=-2, dim2=-1)[..., 6:9]
    return after, FixTerms(terms, innovation, s, after.position, variance)
