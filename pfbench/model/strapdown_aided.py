"""Total-state INS/GNSS of an aircraft with a barometer and a magnetometer beside the fixes.

Motion and sensor biases are those of the loosely coupled model. Pressure tells the height but for a bias that wanders with
weather, airspeed and temperature; the magnetometer tells the Earth's field in body axes but for what the aircraft adds to it.
The field is used as three components, not as a heading: that keeps the law normal and needs no attitude to level it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.chart import Chart, Euclidean, Quaternion
from pfbench.model.base import StateSpaceModel, independent_normal, normal_batch, positive
from pfbench.model.strapdown_total import Believed, Increments, StrapdownTotal, three, turned
from pfbench.record import Record

_MOTION, _BIASES = 16, 4
_DRIVEN = StrapdownTotal.noise_dim
_CHART = Chart((Quaternion(), Euclidean(_MOTION - 4 + _BIASES)))


@dataclass(frozen=True)
class BelievedAided:
    """What filters are told.

    Args:
        motion: of inertial sensors, receiver and start.
        height_sd: of a pressure height, m.
        magnetic_sd: of the measured field about the forward, right and down axis, gauss.
        field: the Earth's, North, East, Down, gauss.
        height_bias_sd, height_bias_walk: of the barometer, initially about the level that the record takes off, m, m/sqrt(s).
        magnetic_bias_sd, magnetic_bias_walk: of each axis, about the hard iron that the record takes off, gauss, gauss/sqrt(s).
    """

    motion: Believed
    height_sd: float
    magnetic_sd: Sequence[float]
    field: Sequence[float]
    height_bias_sd: float
    height_bias_walk: float
    magnetic_bias_sd: float
    magnetic_bias_walk: float

    @property
    def bias_sd(self) -> Tensor:
        """Initial, of the barometer and of the magnetometer about right, forward and up [4].

        Raises:
            ValueError: one that is not positive.
        """
        height = positive("believed.height_bias_sd", [self.height_bias_sd])
        return torch.cat([height, positive("believed.magnetic_bias_sd", [self.magnetic_bias_sd] * 3)])

    @property
    def measurement_sd(self) -> Tensor:
        """Of fix, height and field (right, forward, up) [7 or 10]. Raises as `bias_sd`."""
        height = positive("believed.height_sd", [self.height_sd])
        magnetic = three("believed.magnetic_sd", self.magnetic_sd)[[1, 0, 2]]
        return torch.cat([self.motion.measurement_sd, height, magnetic])


class StrapdownAided(StateSpaceModel):
    """State [20]: that of StrapdownTotal, then the barometer's bias m and the magnetometer's, right, forward, up, gauss.

    What is seen: position, or position and velocity; the height above the start plus the barometer's bias; and C^T B + b, with
    the Earth's field B in level axes. The biases walk. About a vertical axis the heading and the two level components of b
    cannot be told apart on a straight flight; turns and fixes part them. Scale and soft iron of the magnetometer are no states:
    the field's strength is known to 1 per cent, and turns alone tell little of them [ours].

    Args:
        believed: standard deviations, densities and the field.

    Raises:
        ValueError: a density or standard deviation that is not positive, a field that is not three numbers or is zero.
    """

    p0: Tensor
    r: Tensor
    field: Tensor
    walk: Tensor
    noise_dim = _DRIVEN + _BIASES

    def __init__(self, believed: BelievedAided) -> None:
        super().__init__()
        north, east, down = _field(believed.field)
        self.motion = StrapdownTotal(believed.motion)
        self.register_buffer("p0", torch.cat([believed.motion.initial_sd, believed.bias_sd]))
        self.register_buffer("r", believed.measurement_sd)
        self.register_buffer("field", self.p0.new_tensor([east, north, -down]))
        height = positive("believed.height_bias_walk", [believed.height_bias_walk])
        magnetic = positive("believed.magnetic_bias_walk", [believed.magnetic_bias_walk] * 3)
        self.register_buffer("walk", torch.cat([height, magnetic]))
        first = len(self.motion.names)
        self.names = (*self.motion.names, "height_bias", *(f"magnetic_bias_{axis}" for axis in ("right", "forward", "up")))
        self.units = (*self.motion.units, "m", "gauss", "gauss", "gauss")
        self.groups = {**self.motion.groups, "height_bias": (first,), "magnetic_bias": (first + 1, first + 2, first + 3)}
        self.choices = (
            *self.motion.choices,
            "errors of pressure height and magnetic field last for seconds and are taken for white beside a walking bias",
        )

    @property
    def chart(self) -> Chart:
        return _CHART

    @property
    def anchor(self) -> Tensor:
        return self.p0

    @property
    def origin(self) -> Tensor:
        """Level, facing North, at rest, without biases; a recorded world hands over each run's own start instead."""
        return torch.cat([self.motion.origin, self.p0.new_zeros(_BIASES)])

    def prepare(self, record: Record) -> Record:
        """The record as it is.

        Raises:
            ValueError: inputs of another kind, or measurements that do not fit the believed standard deviations.
        """
        if not isinstance(record.u, Increments) or record.y.shape[-1] != len(self.r):
            raise ValueError(
                f"record.u is {type(record.u).__name__} with {record.y.shape[-1]} measured components: StrapdownAided needs "
                f"Increments and {len(self.r)} (a fix, a height, a field); choose scenario=fixed_wing_aided, and set "
                "velocity_sd of believed.motion and of the receiver both to three numbers or both to null"
            )
        return record

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Increments, w: Tensor) -> Tensor:
        moved = self.motion.propagate(x[..., :_MOTION], u, w[..., :_DRIVEN])
        wander = torch.sqrt(u.duration)[:, None, None] * self.walk * w[..., _DRIVEN:]
        return torch.cat([moved, x[..., _MOTION:] + wander], -1)

    def noise_gain(self, u: Increments) -> Tensor:
        motion, walk = self.motion.noise_gain(u), torch.diag_embed(torch.sqrt(u.duration)[:, None] * self.walk)
        beside = motion.new_zeros(motion.shape[0], motion.shape[1], _BIASES)
        below = motion.new_zeros(motion.shape[0], _BIASES, motion.shape[2])
        return torch.cat([torch.cat([motion, beside], -1), torch.cat([below, walk], -1)], -2)

    def observation(self, x: Tensor, u: Increments) -> Distribution:
        fix = self.motion.observation(x[..., :_MOTION], u).mean
        to_body = torch.cat([x[..., :1], -x[..., 1:4]], -1)
        magnetic = turned(to_body, self.field) + x[..., _MOTION + 1 :]
        height = x[..., 9:10] + x[..., _MOTION : _MOTION + 1]
        return independent_normal(torch.cat([fix, height, magnetic], -1), self.r)

    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        """True state of an Episode; NaN where a group has no truth. Raises as `StrapdownTotal.assemble`."""
        motion = self.motion.assemble(truth)
        height = truth.get("height_bias", motion.new_full((*motion.shape[:-1], 1), torch.nan))
        magnetic = truth.get("magnetic_bias", motion.new_full((*motion.shape[:-1], 3), torch.nan))
        return torch.cat([motion, height, magnetic], -1)


def _field(values: Sequence[float]) -> Sequence[float]:
    if len(values) != 3 or not any(values):
        raise ValueError(f"believed.field={list(values)}: give the Earth's field, North, East, Down, in gauss")
    return values
