"""Loosely coupled INS/GNSS: the linear small-angle error model, 15 or 18 states."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.density import ChartNormal, dense_normal, independent_normal, normal_batch
from pfbench.core.linear_algebra import affine_map, factor
from pfbench.core.parameter_checks import as_float64, require
from pfbench.core.record import Record, describe_misfit
from pfbench.model.base import StateSpaceModel
from pfbench.nav import attitude, error_dynamics
from pfbench.nav.aiding import LOOSE_CHANNELS, AlignmentErrors, GnssReceiver, ProcessNoiseInflation
from pfbench.nav.imu_errors import ImuErrors
from pfbench.nav.strapdown import InsIntervals

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

    Returns the components, in the order of the groups.
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
        """Check that a sensor measures what the model reads."""
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
    """Return the transition distribution for noise of full rank in the chart with a triangular gain.

    Returns distribution with batch [R, N], event [D]. Shapes: x [R, N, D].
    """
    mean = model.propagate(x, u, x.new_zeros(*x.shape[:2], model.noise_dim))
    root = model.noise_gain(u)
    assert root is not None
    if not model.chart.flat:
        return ChartNormal(model.chart, mean, root.unsqueeze(1))
    return dense_normal(mean, root.unsqueeze(1))


def inflate_noise(gain: Tensor, inflation: ProcessNoiseInflation, gyro: int) -> Tensor:
    """Return the triangular root of the process noise plus additional noise.

    Returns root, [..., D, D]. Shapes: gain [..., D, W].
    """
    sd = [inflation.motion, *[inflation.gyro] * gyro, inflation.accelerometer]
    root, ok = factor(gain @ gain.mT + torch.diag(torch.cat(sd).to(gain).square()))
    require(
        bool(ok.all()),
        "model.inflation",
        "be positive for every state",
        inflation,
        "Otherwise the noise covariance is singular.",
    )
    return root


_TAYLOR = 4  # terms of exp(F T), at 1 s the fifth is below 1e-6 in any entry


class LooseStep(NamedTuple):
    """Discrete model of each interval.

    Attributes:
        phi: Transition, [R or 1, T, D, D].
        gain: Noise gain, [R or 1, T, D, W].
    """

    phi: Tensor
    gain: Tensor


class InsGnss(InsErrorModel):
    """INS errors (INS minus truth) about the nominal trajectory, aided by a receiver.

    States: attitude phi (E, N, U), velocity (E, N, U), position in metres (N, E, U), then

    - 15 states: gyro bias and accelerometer bias, random walks with the driving noise of the
      sensors' Gauss-Markov parts,
    - 18 states (`markov`): gyro constant drift, gyro Markov drift, accelerometer Markov bias
      [Qin Yongyuan's 18-state model].

    The receiver measures position and velocity errors. Sensor errors enter attitude with -C and
    velocity with +C. Phi is the matrix exponential to order 4. The noise over an interval is
    Gamma sqrt(q / T) with Gamma = sum (F T)^(n-1)/n! G T, rank 12. With `inflation` the noise has
    full rank, the factor of Q + diag(inflation^2), and the transition has a density. `prepare`
    computes all transitions and noise gains once. `error` is corrected navigation minus truth, for
    sensor states estimate minus truth.

    Args:
        imu: Sensor errors that the model assumes.
        receiver: Receiver noise that the model assumes, order position N, E, U, velocity E, N, U.
        initial: Initial errors that the model assumes.
        markov: Whether to use 18 states instead of 15.
        inflation: Additional process noise, or None.

    Raises:
        ValueError: If a sensor bias is 0, which makes the initial distribution improper, or the receiver
            measures other channels.
    """

    linear = True
    input_type = InsIntervals
    r: Tensor
    observed_indices: Tensor

    def __init__(
        self,
        imu: ImuErrors,
        receiver: GnssReceiver,
        initial: AlignmentErrors,
        markov: bool = False,
        inflation: ProcessNoiseInflation | None = None,
    ) -> None:
        super().__init__()
        self.channel_names = LOOSE_CHANNELS[: len(receiver.sd)]
        self.check_receiver(receiver)
        drift = ("gyro_constant", "gyro_markov") if markov else ("gyro_bias",)
        self.names, self.units, self.groups = name_ins_components(
            (*NAVIGATION, *drift, "accelerometer_bias")
        )
        self.imu, self.markov, self.inflation = imu, markov, inflation
        constant, random = imu.gyro_bias, imu.gyro_markov
        gyro = (constant, random) if markov else (_hypot(constant, random),)
        accelerometer = _hypot(imu.accelerometer_bias, imu.accelerometer_markov)
        biases = [sd for size in (*gyro, accelerometer) for sd in [size] * 3]
        if min(biases) <= 0.0:
            raise ValueError(
                "model.imu must have positive initial standard deviations of sensor errors, "
                f"got {biases}. "
                "Give positive gyro and accelerometer biases"
                + (" and Markov parts (or markov=false)." if markov else ".")
            )
        self.register_buffer("p0", torch.cat([initial.sd, as_float64(biases)]))
        self.register_buffer("r", receiver.sd)
        self.register_buffer(
            "observed_indices", torch.tensor([6, 7, 8, 3, 4, 5][: len(receiver.sd)])
        )
        self.noise_dim = len(self.names) if inflation else 12
        choices = [f"process noise is inflated for every filter: {inflation}"] if inflation else []
        if markov and imu.accelerometer_bias > 0 and imu.accelerometer_markov > 0:
            choices.append(
                "the constant accelerometer bias is modelled as Markov and decays: "
                "its standard deviation becomes too small"
            )
        self.choices = tuple(choices)

    @override
    def prepare(self, record: Record) -> Record:
        if isinstance(record.u, LooseStep):
            return record
        return record._replace(u=self.discretise(super().prepare(record).u))

    def discretise(self, u: InsIntervals) -> LooseStep:
        """Compute transition [..., D, D] and noise gain [..., D, W] of intervals, float64."""
        d = len(self.names)
        f, g, q = self._continuous(u)
        span = u.duration[..., None, None]
        eye = torch.eye(d, dtype=f.dtype, device=f.device).expand_as(f)
        phi, gamma, power = eye, eye, eye
        for n in range(1, _TAYLOR + 1):
            power = power @ f * (span / n)  # (F T)^n / n!
            phi = phi + power
            gamma = gamma + power / (n + 1)
        phi = error_dynamics.convert_transition_to_metres(phi, u.pos_start, u.pos_end)
        noise = (
            error_dynamics.convert_transition_to_metres(gamma, u.pos_start, u.pos_end)
            @ g
            * torch.sqrt(q * span)
        )
        if self.inflation is None:
            return LooseStep(phi, noise)
        return LooseStep(phi, inflate_noise(noise, self.inflation, d // 3 - 4))

    def _continuous(self, u: InsIntervals) -> tuple[Tensor, Tensor, Tensor]:
        """Return F [..., D, D], G [..., D, 12], and spectral densities q [12]."""
        d, imu = len(self.names), self.imu
        f = u.f.new_zeros(*u.f.shape[:-1], d, d)
        g = u.f.new_zeros(*u.f.shape[:-1], d, 12)
        f[..., :9, :9] = error_dynamics.small_angle_matrix(u.pos, u.vel, u.f)
        for start in range(9, d - 3, 3):  # gyro errors
            f[..., 0:3, start : start + 3] = -u.dcm
        f[..., 3:6, d - 3 :] = u.dcm
        g[..., 0:3, 0:3], g[..., 3:6, 3:6] = -u.dcm, u.dcm
        eye = torch.eye(3, dtype=f.dtype, device=f.device)
        g[..., d - 6 : d - 3, 6:9] = eye
        g[..., d - 3 :, 9:12] = eye
        gyro_driver = _driver_density(imu.gyro_markov, imu.gyro_markov_time_s)
        accelerometer_driver = _driver_density(
            imu.accelerometer_markov, imu.accelerometer_markov_time_s
        )
        if self.markov:
            f[..., 12:15, 12:15] = -eye / imu.gyro_markov_time_s
            time = imu.accelerometer_markov_time_s
            f[..., 15:18, 15:18] = -eye / time if time > 0 else 0 * eye
        q = [
            imu.gyro_random_walk**2,
            imu.accelerometer_random_walk**2,
            gyro_driver,
            accelerometer_driver,
        ]
        return f, g, as_float64([value for value in q for _ in range(3)]).to(f)

    @override
    def propagate(self, x: Tensor, u: LooseStep, w: Tensor) -> Tensor:
        return affine_map(u.phi, x, u.gain, w)

    def propagation_jacobian(self, x: Tensor, u: LooseStep) -> Tensor:
        """Return the transition matrix, [R or 1, 1, D, D].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        return u.phi.unsqueeze(1)

    def observation_jacobian(self, x: Tensor, u: LooseStep) -> Tensor:
        """Return the matrix that selects the measured components, [1, 1, k, D].

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
        """
        eye = torch.eye(x.shape[-1], dtype=x.dtype, device=x.device)
        return eye[self.observed_indices][None, None]

    @override
    def noise_gain(self, u: LooseStep) -> Tensor:
        return u.gain

    @override
    def observation(self, x: Tensor, u: LooseStep) -> Distribution:
        return independent_normal(
            x.permute(2, 0, 1).index_select(0, self.observed_indices).permute(1, 2, 0), self.r
        )

    @override
    def transition(self, x: Tensor, u: LooseStep) -> Distribution | None:
        return None if self.inflation is None else additive_transition(self, x, u)


def _hypot(a: float, b: float) -> float:
    return (a * a + b * b) ** 0.5


def _driver_density(sigma: float, time: float) -> float:
    """Return the driving spectral density of a Markov process of stationary `sigma`."""
    return 2.0 * sigma**2 / time if sigma > 0 else 0.0
