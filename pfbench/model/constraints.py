"""Settings of further components and states: constraints of the motion, odometer, place and delay of the antenna."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.core.parameter_checks import (
    as_float64,
    check_three_positive,
    require,
    require_range,
)
from pfbench.core.record import name_channels

_ANTENNA, _LATE = "position of the antenna", "late position"
_BODY, _LEVEL = ("right", "forward", "up"), ("East", "North", "Up")


@dataclass(frozen=True)
class Constraints:
    """Constraints of the motion and quantities of the sensors. By default none is used.

    A standard deviation switches its component or state on.

    Attributes:
        non_holonomic_sd: Velocity to the right and up of a vehicle that does not slip, which is zero, m/s.
        zero_velocity_sd: Velocity in each axis while standing, which is zero, m/s.
        zero_rate_sd: Mean rate of the gyro over a step while standing, which is its bias, rad/s.
        odometer_sd: Speed of the wheels, m/s.
        odometer_scale_sd: Relative error of this speed, a state. None for no error.
        axle: Point of the vehicle that does not slip, from the IMU, forward, right, down, m.
        lever_arm: Antenna from the IMU, forward, right, down, m. None for the same point.
        lever_arm_sd: Errors of `lever_arm`, forward, right, down, m, which is then three states. None if it is
            known.
        delay_sd: Delay of the fixes, s, a state. None for no delay.

    Raises:
        ValueError: If a standard deviation is not positive, or a vector does not have three numbers.
    """

    non_holonomic_sd: float | None = None
    zero_velocity_sd: float | None = None
    zero_rate_sd: float | None = None
    odometer_sd: float | None = None
    odometer_scale_sd: float | None = None
    axle: Sequence[float] = (0.0, 0.0, 0.0)
    lever_arm: Sequence[float] | None = None
    lever_arm_sd: Sequence[float] | None = None
    delay_sd: float | None = None

    def __post_init__(self) -> None:
        for name in ("non_holonomic", "zero_velocity", "zero_rate", "odometer", "odometer_scale", "delay"):  # fmt: skip
            rule = "null or (0, inf) Use null to leave it out."
            require_range(f"constraints.{name}_sd", getattr(self, f"{name}_sd"), rule)
        for name, vector in (("axle", self.axle), ("lever_arm", self.lever_arm)):
            remedy = "Set forward, right and down in m."
            got = vector if vector is None else list(vector)
            require(vector is None or len(vector) == 3, f"constraints.{name}", "have 3 numbers", got, remedy)  # fmt: skip
        if self.lever_arm_sd is not None:
            check_three_positive("constraints.lever_arm_sd", self.lever_arm_sd)
        scale, remedy = self.odometer_scale_sd, "Set odometer_sd, too."
        is_read = scale is None or self.odometer_sd is not None
        require(is_read, "constraints.odometer_scale_sd", "be null without an odometer", scale, remedy)  # fmt: skip

    @property
    def needs_standing(self) -> bool:
        """True if a component is measured while standing."""
        return self.zero_velocity_sd is not None or self.zero_rate_sd is not None

    @property
    def has_lever_arm(self) -> bool:
        """True if the fixes are those of an antenna away from the IMU."""
        return self.lever_arm is not None or self.lever_arm_sd is not None

    def _list_components(self) -> list[tuple[tuple[str, ...], float]]:
        """List names and standard deviation of the components that are used."""
        components = (
            (name_channels("velocity of the axle", ("right", "up"), "m/s"), self.non_holonomic_sd),
            (name_channels("velocity while standing", _LEVEL, "m/s"), self.zero_velocity_sd),
            (name_channels("rate while standing", _BODY, "rad/s"), self.zero_rate_sd),
            (("speed of the wheels [m/s]",), self.odometer_sd),
        )
        return [(names, sd) for names, sd in components if sd is not None]

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the components behind those of the fixes."""
        return tuple(name for names, _ in self._list_components() for name in names)

    @property
    def measurement_sd(self) -> Tensor:
        """Standard deviations of these components, [k], m/s or rad/s."""
        values = [sd for names, sd in self._list_components() for _ in names]
        return as_float64(values)

    def name_fixes(self, names: Sequence[str]) -> tuple[str, ...]:
        """Return the names of the components of a fix, which say that it is of an antenna or late.

        Args:
            names: Names of the components of a fix at the IMU without a delay.

        Returns:
            Names, as many.
        """
        word = _ANTENNA if self.has_lever_arm else "position"
        word = word.replace("position", _LATE) if self.delay_sd is not None else word
        return tuple(name.replace("position", word) for name in names)

    @property
    def states(self) -> dict[str, tuple[str, Tensor, Tensor]]:
        """Unit, mean and standard deviation of the states of each group, in body axes right, forward, up."""
        states = {}
        if self.lever_arm_sd is not None:
            states["lever_arm"] = ("m", swap_axes(self.lever_arm or (0.0, 0.0, 0.0)), swap_axes(self.lever_arm_sd).abs())  # fmt: skip
        for name, unit in (("odometer_scale", ""), ("delay", "s")):
            sd = getattr(self, f"{name}_sd")
            if sd is not None:
                value = as_float64([sd])
                states[name] = (unit, torch.zeros_like(value), value)
        return states

    @property
    def start(self) -> Tensor:
        """Means of the states, [k]."""
        return torch.cat([mean for _, mean, _ in self.states.values()] or [torch.zeros(0)]).double()


def swap_axes(values: Sequence[float]) -> Tensor:
    """Convert forward, right, down to right, forward, up, [3]."""
    forward, right, down = values
    return as_float64([right, forward, -down])
