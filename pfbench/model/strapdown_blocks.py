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
from pfbench.model.earth_form import EarthForm, FlatEarth
from pfbench.model.strapdown import StrapdownModel, StrapdownTotal
from pfbench.model.strapdown_tuning import StrapdownTuning
from pfbench.nav.strapdown import PreintegratedImu, rotate

_MOTION = 16
_AXES = ("right", "forward", "up")
_FLAT = FlatEarth()


class StrapdownBlocks(StrapdownModel):
    """StrapdownTotal with further components of the measurement, and further states.

    A state has attitude C, velocity v, position p and gyro bias b. w is the mean rate of a step less b. The
    components are, in this order:

    - Fix: p + C l - tau (v + C (w x l)), and v + C (w x l) if velocity is measured.
    - Non-holonomic: right and up component of C^T v + w x a.
    - Zero velocity: v.
    - Zero rate: b, and on a rotating Earth its rate in body axes.
    - Odometer: (1 + s) times the forward component of C^T v + w x a.

    l is the lever arm, tau the delay, a the axle and s the scale error. Lever arm (right, forward, up), scale
    error and delay are states behind the 16 of StrapdownTotal if the constraints say so. They are constant. A
    component that is missing at a step is NaN.

    Args:
        tuning: Standard deviations and densities of the motion.
        constraints: Components and states.
        earth: FlatEarth or RotatingEarth.

    Raises:
        ValueError: If a density or standard deviation is not positive, or the delay of fixes with velocity
            is a state.
    """

    noise_dim = StrapdownTotal.noise_dim
    measured = "tuning and constraints"
    remedy = "Use scenario.constraints as constraints of the model, and the same velocity_sd in receiver and tuning."
    lever: Tensor
    site: Tensor
    axle: Tensor

    def __init__(
        self, tuning: StrapdownTuning, constraints: Constraints, earth: EarthForm = _FLAT
    ) -> None:
        super().__init__()
        check_tuning(tuning, StrapdownTuning)
        self.motion, self.constraints, self.earth = StrapdownTotal(tuning), constraints, earth
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
        self.register_buffer("site", earth.site)
        self.register_buffer("axle", swap_axes(constraints.axle))
        self.has_axle = any(constraints.axle)
        self.channel_names = (
            *constraints.name_fixes(self.motion.channel_names),
            *constraints.channel_names,
        )
        self.choices = (
            earth.choice,
            *self.motion.choices[1:],
            "errors of constraints are correlated over seconds and modelled as white noise",
        )

    @override
    def propagate(self, x: Tensor, u: PreintegratedImu, w: Tensor) -> Tensor:
        motion = self.motion.propagate(x[..., :_MOTION], u, w)
        motion = self.earth.correct(x, motion, u, self.site)
        return torch.cat([motion, x[..., _MOTION:]], -1) if self.further else motion

    @override
    def noise_gain(self, u: PreintegratedImu) -> Tensor:
        return pad(self.motion.noise_gain(u), (0, 0, 0, self.further))

    @override
    def observation(self, x: Tensor, u: PreintegratedImu) -> Distribution:
        constraints = self.constraints
        to_body = torch.cat([x[..., :1], -x[..., 1:4]], -1)
        means = [self._observe_fix(x, u)]
        if constraints.non_holonomic_sd is not None or constraints.odometer_sd is not None:
            velocity = self._body_velocity(x, u, to_body)
        if constraints.non_holonomic_sd is not None:
            means.append(velocity[..., ::2])
        if constraints.zero_velocity_sd is not None:
            means.append(x[..., 4:7])
        if constraints.zero_rate_sd is not None:
            means.append(x[..., 10:13] + self.earth.sense(to_body, self.site))
        if constraints.odometer_sd is not None:
            forward = velocity[..., 1:2]
            scaled = "odometer_scale" in self.places
            means.append(
                forward * (1.0 + x[..., self.places["odometer_scale"]]) if scaled else forward
            )
        return independent_normal(torch.cat(means, -1), self.r)

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

    def _body_velocity(self, x: Tensor, u: PreintegratedImu, to_body: Tensor) -> Tensor:
        """Return the velocity of the axle in body axes, [R, N, 3]."""
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
