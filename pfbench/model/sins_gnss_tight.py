"""Tightly coupled SINS/GNSS: 17 linear error states seen through pseudoranges and range rates."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from pfbench.covariance import factor
from pfbench.model.base import StateSpaceModel, affine, independent_normal, normal_batch
from pfbench.nav import attitude, earth, error_dynamics
from pfbench.nav.aiding import Alignment, Inflation
from pfbench.nav.ranging import Clock, Sight, TightReceiver, Tracked
from pfbench.nav.sensors import ImuErrors
from pfbench.record import Record, map_inputs

_AXES = {
    "attitude": (("E", "N", "U"), ("rad",) * 3),
    "velocity": (("E", "N", "U"), ("m/s",) * 3),
    "position": (("N", "E", "U"), ("m",) * 3),
    "gyro_bias": (("x", "y", "z"), ("rad/s",) * 3),
    "accelerometer_bias": (("x", "y", "z"), ("m/s^2",) * 3),
    "clock": (("bias", "drift"), ("m", "m/s")),
}
NAMES = tuple(f"{block}_{axis}" for block, (axes, _) in _AXES.items() for axis in axes)
UNITS = tuple(unit for _, units in _AXES.values() for unit in units)
GROUPS = {block: tuple(i for i, name in enumerate(NAMES) if name.startswith(f"{block}_")) for block in _AXES}
_TAYLOR = 4  # terms of the matrix exponential; at 1 s the fifth is below 1e-6 in any entry
_CHAIN = 5  # terms of the noise: gyro noise reaches the position through the velocity as T^5 / 20
_EPOCHS = 64  # prepared at once: temporaries for 100 runs stay below 50 MB


class Step(NamedTuple):
    """Motion of the first nine errors over each interval, and what is expected at its end.

    Attributes:
        phi: their transition from the first fifteen [R, T, 9, 15].
        gain: lower triangular root of their noise [R, T, 9, 9].
        duration: [R or 1, T] s.
        sine, cosine, height, vel, distance, line, closing: see `ranging.Sight`.
    """

    phi: Tensor
    gain: Tensor
    duration: Tensor
    sine: Tensor
    cosine: Tensor
    height: Tensor
    vel: Tensor
    distance: Tensor
    line: Tensor
    closing: Tensor


class SinsGnssTight(StateSpaceModel):
    """Errors of an INS (INS minus truth) and a receiver's clock, seen in ranges and rates, INS minus receiver.

    States [17]: attitude phi (E, N, U), velocity (E, N, U), position in metres (N, E, U), where the paper has radians for
    latitude and longitude [ours]; constant gyro and accelerometer biases; clock bias and drift in m and m/s. The groups are
    the paper's [COFM-AMSSRCPF 2024, Measurement and Control, section 2]; order, axes and signs are ours.

    Phi is the matrix exponential to order 4 of the interval's mean F, the noise its exact integral, so of rank 11: attitude,
    velocity, position, clock. The biases do not move, so the transition has no density. With `inflation` it has rank 17 and
    one. What is seen is not linearised, but next to linear: 2.5e-6 m of 10 m.

    Args:
        imu: what the model believes of the sensors.
        receiver: what it believes of the receiver and its clock.
        initial: what it believes of the initial errors.
        inflation: noise added on purpose, or None.

    Raises:
        ValueError: a sensor's bias of 0, which would make the initial law improper, or one with a Markov part.
    """

    p0: Tensor
    r: Tensor
    names, units, groups = NAMES, UNITS, GROUPS

    def __init__(
        self, imu: ImuErrors, receiver: TightReceiver, initial: Alignment, inflation: Inflation | None = None
    ) -> None:
        super().__init__()
        self.imu, self.clock, self.inflation = imu, receiver.clock, inflation
        self.register_buffer("p0", initial_sd(imu, receiver.clock, initial))
        self.register_buffer("r", receiver.sd)
        self.noise_dim = 17 if inflation else 11
        self.choices = (f"every filter's model is inflated: {inflation}",) if inflation else ()

    @property
    def anchor(self) -> Tensor:
        return self.p0

    def prepare(self, record: Record) -> Record:
        """Intervals and satellites to transitions, noise gains and what is expected, once for all steps.

        Raises:
            ValueError: inputs of another kind, or satellites that are not the receiver's.
        """
        if isinstance(record.u, Step):
            return record
        u = tracked(record, len(self.r))
        steps = u.duration.shape[-1]
        parts = [self.discretise(map_inputs(lambda a, i=i: a[:, i : i + _EPOCHS], u)) for i in range(0, steps, _EPOCHS)]
        phi, gain = (torch.cat(a, 1) for a in zip(*parts, strict=True))
        return record._replace(u=Step(phi, gain, u.duration, *u.sight))

    def discretise(self, u: Tracked) -> tuple[Tensor, Tensor]:
        """Transition [..., 9, 15] and noise gain [..., 9, 9] of the first nine errors over intervals, float64."""
        f, b, q = self.continuous(u)
        span = u.duration[..., None, None]
        eye = torch.eye(9, dtype=f.dtype, device=f.device).expand_as(f)
        phi, gamma, power = eye, eye, eye
        for n in range(1, _TAYLOR + 1):
            power = power @ f * (span / n)  # (F T)^n / n!
            phi, gamma = phi + power, gamma + power / (n + 1)
        noise, term = q * span, q * span
        for n in range(2, _CHAIN + 1):
            term = (f @ term + term @ f.mT) * (span / n)  # of the series of the integral of Phi Q Phi'
            noise = noise + term
        phi, driven = (error_dynamics.in_metres(a, u.pos_start, u.pos_end) for a in (phi, gamma))
        scale = torch.cat([torch.ones_like(u.vel), torch.ones_like(u.vel), earth.metre_scale(u.pos_end)], -1)
        noise = noise * scale.unsqueeze(-1) * scale.unsqueeze(-2)
        if self.inflation is not None:
            noise = noise + torch.diag(self.inflation.motion.to(noise).square())
        root, ok = factor(noise)
        if not bool(ok.all()):
            raise ValueError(f"model.imu={self.imu}: no square root of the noise exists; give both sensors a random walk")
        return torch.cat([phi, driven @ b * span], -1), root

    @staticmethod
    def _bias_columns(dcm: Tensor) -> Tensor:
        zero = torch.zeros_like(dcm)
        return torch.cat([torch.cat([-dcm, zero], -1), torch.cat([zero, dcm], -1), torch.cat([zero, zero], -1)], -2)

    def continuous(self, u: Tracked) -> tuple[Tensor, Tensor, Tensor]:
        """F of the first nine errors [..., 9, 9], of the biases [..., 9, 6], and their noise density [9, 9]; radians."""
        dcm = error_dynamics.mid_interval(u.intervals).dcm
        f = error_dynamics.small_angle_matrix(u.pos, u.vel, u.f)
        densities = [self.imu.gyro_random_walk**2] * 3 + [self.imu.accelerometer_random_walk**2] * 3 + [0.0] * 3
        return f, self._bias_columns(dcm), torch.diag(f.new_tensor(densities))  # isotropic: turning it changes nothing

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Step, w: Tensor) -> Tensor:
        return affine(self.transition_matrix(u), x, self.noise_gain(u), w)

    def transition_matrix(self, u: Step) -> Tensor:
        """Phi of one step [R or 1, 17, 17]."""
        phi = torch.eye(17, dtype=u.phi.dtype, device=u.phi.device).repeat(u.phi.shape[0], 1, 1)
        phi[:, :9, :15] = u.phi
        phi[:, 15, 16] = u.duration
        return phi

    def noise_gain(self, u: Step) -> Tensor:
        gain = u.gain.new_zeros(u.gain.shape[0], 17, self.noise_dim)
        gain[:, :9, :9] = u.gain
        gain[:, 15:, -2:] = self.clock.gain(u.duration)
        if self.inflation is not None:
            gain[:, 9:15, 9:15] = torch.diag(torch.cat([self.inflation.gyro, self.inflation.accelerometer]).to(gain))
        return gain

    def observation(self, x: Tensor, u: Step) -> Distribution:
        return independent_normal(expected(x[..., 6:9], x[..., 3:6], x[..., 15:], Sight(*u[3:])), self.r)

    def transition(self, x: Tensor, u: Step) -> Distribution | None:
        if self.inflation is None:
            return None
        mean = self.propagate(x, u, x.new_zeros(*x.shape[:2], self.noise_dim))
        return MultivariateNormal(mean, scale_tril=self.noise_gain(u).unsqueeze(1), validate_args=False)

    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        """Corrected navigation minus truth; for the sensors and the clock, estimate minus truth."""
        turned = attitude.residual_error(truth[..., :3], mean[..., :3])
        return torch.cat([turned, truth[..., 3:9] - mean[..., 3:9], mean[..., 9:] - truth[..., 9:]], -1)


def expected(position: Tensor, velocity: Tensor, clock: Tensor, sight: Sight) -> Tensor:
    """INS minus receiver, ranges and then rates [R, N, 2 S], for errors and clocks [R, N, ...] and what one step expects."""
    ranges, rates = sight.differences(position, velocity)
    return torch.cat([ranges - clock[..., :1], rates - clock[..., 1:]], -1)


def initial_sd(imu: ImuErrors, clock: Clock, initial: Alignment) -> Tensor:
    """Standard deviations of the initial errors [17].

    Raises:
        ValueError: a bias that is not constant or of no size.
    """
    if imu.gyro_markov > 0.0 or imu.accelerometer_markov > 0.0:
        raise ValueError(
            f"model.imu: Markov parts of {imu.gyro_markov_deg_h} deg/h and {imu.accelerometer_markov_ug} ug; this model has "
            "constant biases only: set gyro_markov_deg_h and accelerometer_markov_ug to 0"
        )
    sizes = [imu.gyro_bias] * 3 + [imu.accelerometer_bias] * 3 + [clock.bias_sd, clock.drift_sd]
    if min(sizes) <= 0.0:
        raise ValueError(
            f"model.imu: biases of {imu.gyro_bias_deg_h} deg/h and {imu.accelerometer_bias_ug} ug; give positive gyro and "
            "accelerometer biases"
        )
    return torch.cat([initial.sd, torch.tensor(sizes, dtype=torch.float64)])


def tracked(record: Record, components: int) -> Tracked:
    """The inputs of a tightly coupled model.

    Raises:
        ValueError: inputs of another kind, or measurements that do not fit the receiver that the model believes in.
    """
    if not isinstance(record.u, Tracked):
        raise ValueError(
            f"record.u is {type(record.u).__name__}: this model needs ranges; choose a scenario whose receiver is a TightReceiver"
        )
    if record.y.shape[-1] != components:
        raise ValueError(
            f"the scenario measures {record.y.shape[-1]} components, model.receiver expects {components}: "
            "give both the same satellites"
        )
    return record.u
