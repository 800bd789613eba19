"""Thresholds of the checks, with the ranges of clean logs behind them.

Clean ranges: 53 recorded logs of a car, a walk, a fixed wing and quadrotors, and 15 of them were not used to choose a
threshold. The largest clean value is that of any of these logs.
"""

from __future__ import annotations

from typing import NamedTuple


class Threshold(NamedTuple):
    """Limit of a statistic.

    Attributes:
        value: Limit.
        unit: Unit.
        usual: Median over clean logs, or None where any case is a fault.
        largest: Largest value of a clean log.
    """

    value: float
    unit: str
    usual: float | None = None
    largest: float | None = None


THRESHOLDS = {
    "time order": Threshold(0, "rows", 0, 0),
    "repeated times": Threshold(3, "rows", 0, 2),
    "repeated column": Threshold(0, "rows", 0, 0),
    "imu gap": Threshold(0.1, "s", 0.01, 0.1),
    "imu jitter": Threshold(1.0, "samples", 0.0, 0.5),
    "imu rate": Threshold(15.0, "Hz", 100.0, 50.0),
    "fix hole": Threshold(5.0, "s"),
    "absurd samples": Threshold(0, "rows", 0, 0),
    "stuck samples": Threshold(0.1, "s", 0.0, 0.010),
    "dead axis": Threshold(5.0, "s", 0.0, 0.32),
    "saturated axis": Threshold(10.0, "samples", 1.0, 2.0),
    "spikes": Threshold(25.0, "times the level", 5.1, 24.1),
    "unit of force": Threshold(2.0, "times gravity", 1.0, 1.3),
    "common motion": Threshold(0.5, "score", 1.0, 0.976),
    "imu clock": Threshold(0.02, "s", 0.003, 0.011),
    "imu clock drift": Threshold(0.03, "s", 0.001, 0.017),
    "unit of rate": Threshold(2.0, "times the reference", 1.0, 1.1),
    "axes": Threshold(1.5, "times the least residual", 1.0, 1.43),
    "heading": Threshold(4.0, "deg"),
    "mounting": Threshold(4.0, "deg", 1.2, 2.97),
    "accelerometer bias": Threshold(0.7, "m/s^2", 0.29, 0.67),
    "accelerometer bias drift": Threshold(1.0, "m/s^2", 0.25, 0.83),
    "force clock": Threshold(4.0, "times the least residual", 1.1, 2.2),
    "force scale": Threshold(0.08, "1", 0.007, 0.058),
    "gyro bias": Threshold(1.5, "deg/s", 0.82, 3.87),
    "gyro bias drift": Threshold(2.0, "deg/s", 0.13, 1.80),
    "attitude jump": Threshold(5.0, "deg", 0.6, 18.2),
    "gyro scale": Threshold(0.03, "1", 0.005, 0.042),
    "rest of the force": Threshold(1.5, "m/s^2", 0.6, 1.07),
    "rest of the rate": Threshold(3.0, "deg/s", 0.3, 1.8),
    "reference velocity": Threshold(0.2, "1", 0.02, 0.1),
    "fix turn": Threshold(2.0, "deg", 0.0, 0.33),
    "fix scale": Threshold(0.03, "1", 0.0, 0.001),
    "slow errors": Threshold(3.0, "m", 0.0, 1.97),
    "fix axes": Threshold(1.5, "times the least residual", 1.0, 1.06),
    "gnss clock": Threshold(0.05, "s", 0.006, 0.088),
    "lever arm": Threshold(0.3, "m", 0.05, 0.25),
    "fix shift": Threshold(5.0, "m", 0.5, 3.0),
    "fix outliers": Threshold(12.0, "times the level", 2.6, 18.3),
    "frozen fixes": Threshold(2.0, "m", 0.0, 0.01),
    "fix codes": Threshold(0.5, "share of fixes"),
    "turn of the course": Threshold(0.3, "1"),
}
REFUSED_OFFSET = 0.5  # s of a clock
SPIKE_DEVIATIONS = (
    8.0  # robust standard deviations of second differences: the second statistic of a spike
)
STANDARD_ERRORS = 5.0  # of a bias, an offset, a lever arm and a difference of residuals
CLEAR_AXES = 2.0  # times the least residual: enough without the standard errors of blocks
LEAST_OUTLIER = 2.0  # m
LEAST_ACCELERATION = 0.15  # m/s^2, horizontal: less does not show the axes of the force


def limit_of(check: str) -> float:
    """Return the threshold of a check."""
    return THRESHOLDS[check].value
