"""Where recorded data lie, and what filters believe of a made-up log."""

import os

import pytest

from pfbench.model.strapdown_tuning import StrapdownTuning

DATA = os.environ.get("PFBENCH_DATA")
recorded = pytest.mark.skipif(
    DATA is None, reason="PFBENCH_DATA does not name the folder of the recorded data sets"
)


def believed(position_sd: list[float], velocity_sd: list[float] | None) -> StrapdownTuning:
    """Good sensors and a good start; fixes as told."""
    return StrapdownTuning(
        gyro_density=1e-4,
        accelerometer_density=1e-3,
        gyro_bias_walk=1e-6,
        accelerometer_bias_walk=1e-5,
        position_sd=position_sd,
        velocity_sd=velocity_sd,
        attitude_sd_deg=[0.5, 0.5, 2.0],
        initial_velocity_sd=[0.2, 0.2, 0.1],
        initial_position_sd=[1.0, 1.0, 2.0],
        gyro_bias_sd_deg_s=0.01,
        accelerometer_bias_sd=0.01,
    )
