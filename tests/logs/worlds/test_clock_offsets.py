"""Offsets of clocks: found to hundredths of a second where the motion shows them, and never where there is none."""

import numpy as np
import pandas as pd
import pytest
from log_faults import findings_of

Log = dict[str, pd.DataFrame]


def turning(yaw: np.ndarray, speed: np.ndarray, arm: float, delay: float) -> Log:
    """A level drive at 10 Hz with fixes of 0.3 m, of an antenna ahead of the reference point."""
    rng, time = np.random.default_rng(2), np.arange(len(yaw)) / 10
    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], -1)
    velocity = speed[:, None] * ahead
    position = np.r_[np.zeros((1, 3)), np.cumsum(0.05 * (velocity[1:] + velocity[:-1]), 0)]
    seen = (position + arm * ahead + 0.3 * rng.normal(size=position.shape))[::5]
    columns = ["t", "pn", "pe", "pd", "vn", "ve", "vd", "roll", "pitch", "yaw"]
    reference = np.column_stack([time, position, velocity, 0 * yaw, 0 * yaw, yaw])
    fixes = pd.DataFrame(np.column_stack([time[::5] + delay, seen]), columns=columns[:4])
    force = np.stack([np.gradient(speed, time), speed * np.gradient(yaw, time), 0 * yaw - 9.80665])
    imu = np.vstack([time, force, 0 * yaw, 0 * yaw, np.gradient(yaw, time)]).T
    return {
        "imu": pd.DataFrame(imu, columns=["t", "fx", "fy", "fz", "wx", "wy", "wz"]),
        "gnss": fixes,
        "reference": pd.DataFrame(reference, columns=columns),
    }


def offset_of(log: Log, table: str) -> float | None:
    """Offset of a clock that is named, s."""
    return next((f.statistic for f in findings_of(log) if f.check == f"{table} clock"), None)


@pytest.mark.parametrize("delay", [0.0, 2.0])
def test_a_straight_drive_at_constant_speed_shows_no_offset(delay: float) -> None:
    """A delay of 2 s is 20 m along the track there, which a constant error of the fixes explains as well."""
    level = np.zeros(1801)
    assert offset_of(turning(level, level + 10.0, 0.0, delay), "gnss") is None


@pytest.mark.parametrize("arm", [0.0, 3.0])
def test_a_lever_arm_is_told_from_a_late_clock(arm: float) -> None:
    """An antenna ahead of the reference point is 0.3 s early at 10 m/s; turns and changes of speed tell them apart."""
    time = np.arange(1801) / 10
    yaw, speed = 1.2 * np.sin(0.25 * time) + 0.6 * np.sin(0.11 * time), 10 + 5 * np.sin(0.4 * time)
    found = offset_of(turning(yaw, speed, arm, 1.0), "gnss")
    assert found == pytest.approx(1.0, abs=0.03)  # 361 fixes of 0.3 m at 10 m/s: 0.002 s
