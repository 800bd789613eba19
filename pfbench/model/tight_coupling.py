"""States, measurements and inputs that tightly coupled SINS/GNSS models share."""

from __future__ import annotations

import torch
from torch import Tensor

from pfbench.core.record import Record
from pfbench.model.ins_errors import BIASES, NAVIGATION, name_ins_components
from pfbench.nav.aiding import AlignmentErrors
from pfbench.nav.gnss.ranging import RangingInputs
from pfbench.nav.gnss.receiver_clock import ReceiverClock
from pfbench.nav.gnss.satellite_geometry import SatelliteGeometry
from pfbench.nav.imu_errors import ImuErrors

_INS = name_ins_components(NAVIGATION + BIASES)
NAMES = (*_INS.names, "clock_bias", "clock_drift")
UNITS = (*_INS.units, "m", "m/s")
TIGHT_GROUPS = {**_INS.groups, "clock": (15, 16)}


def predict_measurement(
    position: Tensor, velocity: Tensor, clock: Tensor, sight: SatelliteGeometry
) -> Tensor:
    """Predict INS minus receiver, ranges and then rates, [R, N, 2 S].

    Args:
        position: Position errors North, East, Up, [R, N, 3], m.
        velocity: Velocity errors East, North, Up, [R, N, 3], m/s.
        clock: Clock bias and drift, [R, N, 2], m and m/s.
        sight: Ranging geometry of one step.

    Returns:
        The prediction.
    """
    ranges, rates = sight.range_differences(position, velocity)
    return torch.cat([ranges - clock[..., :1], rates - clock[..., 1:]], -1)


def compute_initial_sd(imu: ImuErrors, clock: ReceiverClock, initial: AlignmentErrors) -> Tensor:
    """Return the standard deviations of the initial errors, [17].

    Args:
        imu: Sensor errors.
        clock: Receiver clock.
        initial: Initial navigation errors.

    Raises:
        ValueError: If a bias is 0, or a sensor has a Markov part.
    """
    if imu.gyro_markov > 0.0 or imu.accelerometer_markov > 0.0:
        raise ValueError(
            f"model.imu must not have Markov parts, got {imu.gyro_markov_deg_h} deg/h and "
            f"{imu.accelerometer_markov_ug} ug. Biases are constant in this model. "
            "Set gyro_markov_deg_h and accelerometer_markov_ug to 0."
        )
    sizes = [imu.gyro_bias] * 3 + [imu.accelerometer_bias] * 3 + [clock.bias_sd, clock.drift_sd]
    if min(sizes) <= 0.0:
        raise ValueError(
            f"model.imu must have positive gyro and accelerometer biases, "
            f"got {imu.gyro_bias_deg_h} deg/h and {imu.accelerometer_bias_ug} ug. Change them."
        )
    return torch.cat([initial.sd, torch.tensor(sizes, dtype=torch.float64)])


def check_satellites(record: Record, components: int) -> RangingInputs:
    """Check that the measurements are of the satellites of a tightly coupled model.

    Args:
        record: Measurements, and inputs of the type that the model reads.
        components: Number of measurement components of the model.

    Returns:
        Inputs.

    Raises:
        ValueError: If the measurements do not fit the receiver of the model.
    """
    if record.y.shape[-1] != components:
        raise ValueError(
            f"the scenario must measure the {components} components of model.receiver, "
            f"got {record.y.shape[-1]}. Give both the same satellites."
        )
    u: RangingInputs = record.u
    return u
