"""Total-state INS/GNSS of an aircraft with barometer and magnetometer.

Motion and sensor biases are as in the loosely coupled model. Pressure measures the height plus a
bias that varies with weather, airspeed and temperature. The magnetometer measures the Earth's
field in body axes plus the field of the aircraft. The three field components are used, and not a
heading: their errors are normal and need no attitude for levelling.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.channels import name_channels
from pfbench.core.chart import Chart, EuclideanBlock, QuaternionBlock
from pfbench.core.manifold.group_block import LieGroupBlock
from pfbench.core.normal import independent_normal, normal_batch
from pfbench.core.parameter_checks import check_positive, check_tuning
from pfbench.core.record import Record
from pfbench.model.base import StateSpaceModel
from pfbench.model.strapdown.total import StrapdownTotal
from pfbench.model.strapdown.tuning import AidedTuning
from pfbench.nav.preintegration import PreintegratedImu, rotate

_MOTION, _BIASES = 16, 4
INSTRUMENT_CHANNELS = (
    "pressure height above the start [m]",
    *name_channels("magnetic field in body axes", ("right", "forward", "up"), "gauss"),
)
_DRIVEN = StrapdownTotal.noise_dim
_CHART = Chart((QuaternionBlock(), EuclideanBlock(_MOTION - 4 + _BIASES)))


class StrapdownAided(StateSpaceModel):
    """StrapdownTotal with barometer and magnetometer biases.

    State [20]: the state of StrapdownTotal, then the barometer bias m and the magnetometer bias,
    right, forward, up, gauss. Measurements are position, or position and velocity, the height above
    the start plus the barometer bias, and C^T B + b with the Earth's field B in level axes. The
    biases are random walks. On a straight flight, heading and the two level components of b cannot
    be separated. Turns and fixes separate them. Scale and soft iron of the magnetometer are not
    states: the field strength is constant to 1 %, and turns give little information on them [ours].

    The origin is level, facing North, at rest, without biases. Recorded scenarios provide the start
    of each run.

    Args:
        tuning: Standard deviations, densities and the field.

    Raises:
        ValueError: If a density or standard deviation is not positive, or the field is not three
            numbers or is zero.
    """

    input_type = PreintegratedImu
    p0: Tensor
    r: Tensor
    magnetic_field_gauss: Tensor
    walk: Tensor
    noise_dim = _DRIVEN + _BIASES

    def __init__(self, tuning: AidedTuning) -> None:
        super().__init__()
        check_tuning(tuning, AidedTuning)
        north, east, down = _field(tuning.magnetic_field_gauss)
        self.motion = StrapdownTotal(tuning.motion)
        self.channel_names = (*self.motion.channel_names, *INSTRUMENT_CHANNELS)
        self.register_buffer("p0", torch.cat([tuning.motion.initial_sd, tuning.bias_sd]))
        self.register_buffer("r", tuning.measurement_sd)
        self.register_buffer("magnetic_field_gauss", self.p0.new_tensor([east, north, -down]))
        height = check_positive("tuning.height_bias_walk", [tuning.height_bias_walk])
        magnetic = check_positive("tuning.magnetic_bias_walk", [tuning.magnetic_bias_walk] * 3)
        self.register_buffer("walk", torch.cat([height, magnetic]))
        first = len(self.motion.names)
        self.names = (
            *self.motion.names,
            "height_bias",
            *(f"magnetic_bias_{axis}" for axis in ("right", "forward", "up")),
        )
        self.units = (*self.motion.units, "m", "gauss", "gauss", "gauss")
        self.groups = {
            **self.motion.groups,
            "height_bias": (first,),
            "magnetic_bias": (first + 1, first + 2, first + 3),
        }
        self.choices = (
            *self.motion.choices,
            "errors of pressure height and magnetic field are correlated over seconds and modelled "
            "as white noise plus a random-walk bias",
        )

    @property
    @override
    def chart(self) -> Chart:
        return _CHART

    def group_chart(self, side: str) -> Chart:
        """Return an invariant chart, that of StrapdownTotal with further Euclidean components.

        Args:
            side: `left` or `right`, see LieGroupBlock.
        """
        return Chart((LieGroupBlock(side=side), EuclideanBlock(6 + _BIASES)))

    @property
    @override
    def anchor(self) -> Tensor:
        return self.p0

    @property
    @override
    def origin(self) -> Tensor:
        return torch.cat([self.motion.origin, self.p0.new_zeros(_BIASES)])

    @override
    def prepare(self, record: Record) -> Record:
        record = super().prepare(record)
        if record.y.shape[-1] != len(self.r):
            raise ValueError(
                f"the scenario must measure the {len(self.r)} components of StrapdownAided (a fix, a height, "
                f"a field), got {record.y.shape[-1]}. Choose scenario=recorded_fixed_wing_aided, and set "
                "velocity_sd of tuning.motion and of the receiver both to three numbers or both to null."
            )
        return record

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    @override
    def propagate(self, x: Tensor, u: PreintegratedImu, w: Tensor) -> Tensor:
        motion = self.motion.propagate(x[..., :_MOTION], u, w[..., :_DRIVEN])
        change = torch.sqrt(u.duration)[:, None, None] * self.walk * w[..., _DRIVEN:]
        return torch.cat([motion, x[..., _MOTION:] + change], -1)

    @override
    def noise_gain(self, u: PreintegratedImu) -> Tensor:
        motion = self.motion.noise_gain(u)
        walk = torch.diag_embed(torch.sqrt(u.duration)[:, None] * self.walk)
        upper_right = motion.new_zeros(motion.shape[0], motion.shape[1], _BIASES)
        lower_left = motion.new_zeros(motion.shape[0], _BIASES, motion.shape[2])
        rows = [[motion, upper_right], [lower_left, walk]]
        return torch.cat([torch.cat(row, -1) for row in rows], -2)

    @override
    def observation(self, x: Tensor, u: PreintegratedImu) -> Distribution:
        fix = self.motion.observation(x[..., :_MOTION], u).mean
        to_body = torch.cat([x[..., :1], -x[..., 1:4]], -1)
        magnetic = rotate(to_body, self.magnetic_field_gauss) + x[..., _MOTION + 1 :]
        height = x[..., 9:10] + x[..., _MOTION : _MOTION + 1]
        return independent_normal(torch.cat([fix, height, magnetic], -1), self.r)

    @override
    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        motion = self.motion.assemble(truth)
        height = truth.get("height_bias", motion.new_full((*motion.shape[:-1], 1), torch.nan))
        magnetic = truth.get("magnetic_bias", motion.new_full((*motion.shape[:-1], 3), torch.nan))
        return torch.cat([motion, height, magnetic], -1)


def _field(values: Sequence[float]) -> Sequence[float]:
    if len(values) != 3 or not any(values):
        raise ValueError(
            f"tuning.magnetic_field_gauss must be three numbers that are not all zero, got {list(values)}. "
            "Give the Earth's field, North, East, Down, in gauss."
        )
    return values
