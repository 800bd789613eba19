"""Total-state INS/GNSS with constraints of the motion, an odometer, and place and delay of the antenna."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.distributions import Distribution
from torch.nn.functional import pad
from typing_extensions import override

from pfbench.core import chart as quaternion
from pfbench.core.density import independent_normal
from pfbench.core.parameter_checks import check_tuning, require
from pfbench.model.constraints import Constraints, swap_axes
from pfbench.model.strapdown import StrapdownModel, StrapdownTotal
from pfbench.model.strapdown_tuning import StrapdownTuning
from pfbench.nav.strapdown import PreintegratedImu, rotate

_MOTION = 16
_AXES = ("right", "forward", "up")


class StrapdownBlocks(StrapdownModel):
    """StrapdownTotal with further components of the measurement, and further states.

    With attitude C, velocity v, position p, gyro bias b, and the mean rate w of a step less b, the
    components are, in this order,

        fix                  p + C l - tau (v + C (w x l)), and v + C (w x l) if velocity is measured
        non-holonomic        right and up component of C^T v + w x a
        zero velocity        v
        zero rate            b
        odometer             (1 + s) times the forward component of C^T v + w x a

    for the lever arm l, the delay tau, the axle a and the scale error s. Lever arm (right, forward, up),
    scale error and delay are states behind the 16 of StrapdownTotal if the constraints say so. They are
    constant. A component that is missing at a step is NaN.

    Args:
        tuning: Standard deviations and densities of the motion.
        constraints: Components and states.

    Raises:
        ValueError: If a density or standard deviation is not positive, or the delay of fixes with velocity
            is a state.
    """

    noise_dim = StrapdownTotal.noise_dim
    measured = "tuning and constraints"
    remedy = "Use scenario.constraints as constraints of the model, and the same velocity_sd in receiver and tuning."
    lever: Tensor
    axle: Tensor

    def __init__(self, tuning: StrapdownTuning, constraints: Constraints) -> None:
        super().__init__()
        check_tuning(tuning, StrapdownTuning)
        self.motion, self.constraints = StrapdownTotal(tuning), constraints
        delay, remedy = constraints.delay_sd, "Set delay_sd or velocity_sd to null."
        is_of_position = delay is None or len(self.motion.r) == 3
        require(is_of_position, "constraints.delay_sd", "be null for fixes with velocity", delay, remedy)  # fmt: skip
        names, units, groups = (
            list(self.motion.names),
            list(self.motion.units),
            {**self.motion.groups},
        )
        self.places = {}
        for group, (unit, _, sd) in constraints.states.items():
            first, size = len(names), len(sd)
            groups[group] = tuple(range(first, first + size))
            self.places[group] = slice(
                first + 1, first + 1 + size
            )  # a quaternion has a number more
            names += [f"{group}_{axis}" for axis in _AXES] if size == 3 else [group]
            units += [unit] * size
        self.names, self.units, self.groups = tuple(names), tuple(units), groups
        self.further = len(names) - len(self.motion.names)
        sds = [sd for _, _, sd in constraints.states.values()]
        self.register_buffer("p0", torch.cat([tuning.initial_sd, *sds]))
        self.register_buffer("r", torch.cat([tuning.measurement_sd, constraints.measurement_sd]))
        self.register_buffer("lever", swap_axes(constraints.lever_arm or (0.0, 0.0, 0.0)))
        self.register_buffer("axle", swap_axes(constraints.axle))
        self.has_axle = any(constraints.axle)
        self.channel_names = (
            *constraints.name_fixes(self.motion.channel_names),
            *constraints.channel_names,
        )
        self.choices = (
            *self.motion.choices,
            "errors of constraints are correlated over seconds and modelled as white noise",
        )

    @override
    def propagate(self, x: Tensor, u: PreintegratedImu, w: Tensor) -> Tensor:
        motion = self.motion.propagate(x[..., :_MOTION], u, w)
        return torch.cat([motion, x[..., _MOTION:]], -1) if self.further else motion

    @override
    def noise_gain(self, u: PreintegratedImu) -> Tensor:
        return pad(self.motion.noise_gain(u), (0, 0, 0, self.further))

    @override
    def observation(self, x: Tensor, u: PreintegratedImu) -> Distribution:
        known, v = self.constraints, x[..., 4:7]
        seen = [self._observe_fix(x, u)]
        if known.non_holonomic_sd is not None or known.odometer_sd is not None:
            velocity = self._body_velocity(x, u)
        if known.non_holonomic_sd is not None:
            seen.append(velocity[..., ::2])
        if known.zero_velocity_sd is not None:
            seen.append(v)
        if known.zero_rate_sd is not None:
            seen.append(x[..., 10:13])
        if known.odometer_sd is not None:
            forward = velocity[..., 1:2]
            scaled = "odometer_scale" in self.places
            seen.append(
                forward * (1.0 + x[..., self.places["odometer_scale"]]) if scaled else forward
            )
        return independent_normal(torch.cat(seen, -1), self.r)

    def _observe_fix(self, x: Tensor, u: PreintegratedImu) -> Tensor:
        """Return position, and velocity if it is measured, of the antenna, [R, N, 3 or 6]."""
        q, v, p, has_velocity = x[..., :4], x[..., 4:7], x[..., 7:10], len(self.motion.r) == 6
        if self.constraints.has_lever_arm:
            lever = x[..., self.places["lever_arm"]] if "lever_arm" in self.places else self.lever
            p = p + rotate(q, lever)
            if has_velocity or "delay" in self.places:
                swept = torch.linalg.cross(*torch.broadcast_tensors(_mean_rate(x, u), lever))
                v = v + rotate(q, swept)
        if "delay" in self.places:
            p = p - x[..., self.places["delay"]] * v
        return torch.cat([p, v], -1) if has_velocity else p

    def _body_velocity(self, x: Tensor, u: PreintegratedImu) -> Tensor:
        """Return the velocity of the axle in body axes, [R, N, 3]."""
        to_body = torch.cat([x[..., :1], -x[..., 1:4]], -1)
        velocity = rotate(to_body, x[..., 4:7])
        if not self.has_axle:
            return velocity
        rate, axle = torch.broadcast_tensors(_mean_rate(x, u), self.axle)
        return velocity + torch.linalg.cross(rate, axle)

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        motion = self.motion.assemble(truth)
        missing = [motion.new_full((*motion.shape[:-1], len(sd)), torch.nan) for _, _, sd in self.constraints.states.values()]  # fmt: skip
        return torch.cat([motion, *map(truth.get, self.places, missing)], -1)


def _mean_rate(x: Tensor, u: PreintegratedImu) -> Tensor:
    """Return the mean rate of a step without the gyro bias, body axes, rad/s, [R, N, 3]."""
    turn = quaternion.rotation_vector_from_quaternion(u.rotation)
    span = u.duration.clamp(min=1e-9).unsqueeze(-1)  # a padded step does not turn
    return (turn / span + u.bias[..., :3]).unsqueeze(1) - x[..., 10:13]
