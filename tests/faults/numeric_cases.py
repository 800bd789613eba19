"""Models and measurements at the edge of what numbers can represent."""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.model.linear_gaussian import LinearGaussian

RUNS, STEPS = 2, 6
MATRICES: dict[str, Any] = {  # two states, each with noise, and two sensors
    "transition_matrix": [[1.0, 0.5], [0.0, 0.9]],
    "noise_factor": [[0.6, 0.0], [0.2, 0.5]],
    "measurement_matrix": [[1.0, 0.0], [0.3, 1.0]],
    "measurement_sd": [1.0, 0.8],
    "initial_mean": [0.3, -0.2],
    "initial_sd": [1.5, 1.0],
}
Y = torch.tensor(
    [[0.8, -1.0], [1.9, 0.2], [0.4, 0.5], [-0.3, 0.7], [1.6, 0.9], [1.1, -0.4]],
    dtype=torch.float64,
).expand(RUNS, -1, -1)


class Extreme(NamedTuple):
    """One case.

    Attributes:
        build: Builds the model, and may refuse the parameters.
        y: Measurements, [R, T, 2].
        is_certain: Whether a variance of zero is correct.
    """

    build: Callable[[], LinearGaussian]
    y: Tensor = Y
    is_certain: bool = False


def model(**matrices: Any) -> LinearGaussian:
    return LinearGaussian(**(MATRICES | matrices))


def extreme(y: Tensor = Y, is_certain: bool = False, **matrices: Any) -> Extreme:
    return Extreme(lambda: model(**matrices), y, is_certain)


def changed(step: int | slice, sensor: int | slice, value: float) -> Tensor:
    y = Y.clone()
    y[:, step, sensor] = value
    return y


def single_precision(**matrices: Any) -> Callable[[], LinearGaussian]:
    return lambda: model(**matrices).float()


def with_buffer(name: str, value: float) -> Callable[[], LinearGaussian]:
    """Return a builder of a model whose parameter is changed after its check."""

    def build() -> LinearGaussian:
        built = model()
        getattr(built, name).fill_(value)
        return built

    return build


EVERY = slice(None)
CASES: dict[str, Extreme] = {
    "measurement of 1e200": extreme(changed(2, 0, 1e200)),
    "measurement of 1e-200": extreme(changed(2, EVERY, 1e-200)),
    "subnormal measurement": extreme(changed(EVERY, EVERY, 5e-324)),
    "largest number": extreme(changed(3, 0, 1.7e308)),
    "alternating 1e100": extreme(Y * 1e100),
    "infinite measurement": extreme(changed(2, 0, math.inf)),
    "negative infinite measurement": extreme(changed(2, 0, -math.inf)),
    "outlier of 1e6 sd": extreme(changed(2, 0, 1e6)),
    "outlier of 1e12 sd": extreme(changed(2, 0, 1e12)),
    "all outliers of 1e6 sd": extreme(changed(EVERY, EVERY, 1e6)),
    "no measurement": extreme(changed(EVERY, EVERY, math.nan)),
    "block of NaN": extreme(changed(slice(1, 4), EVERY, math.nan)),
    "dead sensor": extreme(changed(EVERY, 1, math.nan)),
    "constant measurement": extreme(changed(EVERY, EVERY, 7.0)),
    "zero R": extreme(measurement_sd=[0.0, 0.8]),
    "zero R after the check": Extreme(with_buffer("r", 0.0)),
    "negative R": extreme(measurement_sd=[-1.0, 0.8]),
    "R of 1e-24": extreme(measurement_sd=[1e-12, 1e-12]),
    "R of 1e-300": extreme(measurement_sd=[1e-150, 1e-150]),
    "R of 1e24": extreme(measurement_sd=[1e12, 1e12]),
    "Q of 1e24": extreme(noise_factor=[[1e12, 0.0], [0.0, 1e12]]),
    "Q of 1e300": extreme(noise_factor=[[1e150, 0.0], [0.0, 1e150]]),
    "zero Q": extreme(noise_factor=[[0.0, 0.0], [0.0, 0.0]]),
    "zero Q and P0": extreme(
        is_certain=True, noise_factor=[[0.0, 0.0], [0.0, 0.0]], initial_sd=[[0.0, 0.0], [0.0, 0.0]]
    ),
    "singular P0": extreme(initial_sd=[[1.0, 0.0], [1.0, 0.0]]),
    "P0 of 1e24": extreme(initial_sd=[1e12, 1e12]),
    "prior mean of 1e12": extreme(initial_mean=[1e12, -1e12]),
    "unstable state": extreme(transition_matrix=[[1e60, 0.0], [0.0, 0.9]]),
    "H of zero": extreme(measurement_matrix=[[0.0, 0.0], [0.0, 0.0]]),
    "H of 1e100": extreme(measurement_matrix=[[1e100, 0.0], [0.0, 1e100]]),
    "equal sensors, small R": extreme(
        measurement_matrix=[[1.0, 0.0], [1.0, 0.0]], measurement_sd=[1e-9, 1e-9]
    ),
    "float32, offset of 1e8": Extreme(
        single_precision(initial_mean=[1e8, 0.0]), (Y + torch.tensor([1e8, 3e7])).float()
    ),
    "float32, R of 1e-24": Extreme(single_precision(measurement_sd=[1e-12, 1e-12]), Y.float()),
    "float32, measurement of 1e30": Extreme(single_precision(), changed(2, 0, 1e30).float()),
    "NaN in F": Extreme(with_buffer("f", math.nan)),
    "NaN in P0": Extreme(with_buffer("l0", math.nan)),
}
