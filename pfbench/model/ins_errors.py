"""Components, initial distribution and process noise that models of INS errors share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.channels import describe_misfit
from pfbench.core.covariance import factor
from pfbench.core.normal import dense_normal, normal_batch
from pfbench.model.base import StateSpaceModel
from pfbench.nav import attitude
from pfbench.nav.aiding import ProcessNoiseInflation

_AXES = {
    "attitude": (("E", "N", "U"), "rad"),
    "velocity": (("E", "N", "U"), "m/s"),
    "position": (("N", "E", "U"), "m"),
    "gyro_bias": (("x", "y", "z"), "rad/s"),
    "gyro_constant": (("x", "y", "z"), "rad/s"),
    "gyro_markov": (("x", "y", "z"), "rad/s"),
    "accelerometer_bias": (("x", "y", "z"), "m/s^2"),
}
NAVIGATION, BIASES = ("attitude", "velocity", "position"), ("gyro_bias", "accelerometer_bias")


class StateComponents(NamedTuple):
    """Components of a difference of states, see `StateSpaceModel`.

    Attributes:
        names: Names.
        units: SI units.
        groups: Indices by group.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    groups: dict[str, tuple[int, ...]]


def name_components(axes: Mapping[str, tuple[Sequence[str], str]]) -> StateComponents:
    """Name the components of groups with three axes.

    Args:
        axes: Names of the axes and SI unit by group.

    Returns:
        The components, in the order of the groups.
    """
    return StateComponents(
        tuple(f"{group}_{axis}" for group, (names, _) in axes.items() for axis in names),
        tuple(unit for _, unit in axes.values() for _ in range(3)),
        {group: (3 * i, 3 * i + 1, 3 * i + 2) for i, group in enumerate(axes)},
    )


def name_ins_components(groups: Sequence[str]) -> StateComponents:
    """Name the components of groups of INS errors."""
    return name_components({group: _AXES[group] for group in groups})


class InsErrorModel(StateSpaceModel):
    """Model of INS errors (INS minus truth), attitude, velocity and position first.

    `error` is corrected navigation minus truth, for sensor states estimate minus truth.

    Attributes:
        p0: Standard deviations of the initial errors, [d].
    """

    p0: Tensor

    def check_receiver(self, receiver: Any) -> None:
        """Check that a sensor measures what the model reads.

        Args:
            receiver: Sensor whose noise the model assumes.

        Raises:
            ValueError: If it measures other channels.
        """
        if difference := describe_misfit(self, receiver):
            raise ValueError(
                f"model.receiver must measure what the model reads, but {difference}. Choose another model: "
                "pfbench list model scenario=NAME"
            )

    @property
    @override
    def anchor(self) -> Tensor:
        return self.p0

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    @override
    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        rotation = attitude.residual_error(truth[..., :3], mean[..., :3])
        navigation = truth[..., 3:9] - mean[..., 3:9]
        return torch.cat([rotation, navigation, mean[..., 9:] - truth[..., 9:]], -1)


def additive_transition(model: StateSpaceModel, x: Tensor, u: Any) -> Distribution:
    """Return the transition distribution for additive noise of full rank with a triangular gain.

    Args:
        model: Model with `noise_gain`.
        x: States, [R, N, D].
        u: Inputs of the step.

    Returns:
        Distribution with batch [R, N], event [D].
    """
    mean = model.propagate(x, u, x.new_zeros(*x.shape[:2], model.noise_dim))
    root = model.noise_gain(u)
    assert root is not None
    return dense_normal(mean, root.unsqueeze(1))


def inflate_noise(gain: Tensor, inflation: ProcessNoiseInflation, gyro: int) -> Tensor:
    """Return the triangular root of the process noise plus additional noise.

    Args:
        gain: Noise gain, [..., D, W].
        inflation: Additional process noise.
        gyro: Number of gyro blocks in the state.

    Returns:
        Root, [..., D, D].

    Raises:
        ValueError: If the sum is not positive definite.
    """
    sd = [inflation.motion, *[inflation.gyro] * gyro, inflation.accelerometer]
    root, ok = factor(gain @ gain.mT + torch.diag(torch.cat(sd).to(gain).square()))
    if not bool(ok.all()):
        raise ValueError(
            f"model.inflation must be positive for every state, got {inflation}. "
            "Otherwise the noise covariance is singular."
        )
    return root
