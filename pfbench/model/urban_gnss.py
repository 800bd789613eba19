"""Car in a city, with direct or reflected pseudoranges and odometry.

The model works with range differences relative to the origin of the local frame. Each satellite is
given by its direction and distance from that origin. Single precision resolves a range difference
to a millimetre, but a full range of 2e7 m only to two metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from pyro.distributions import Independent, TorchDistribution
from torch import Tensor
from torch.distributions import Distribution, constraints
from torch.nn.functional import normalize
from typing_extensions import override

from pfbench.core.chart import AngleBlock, Chart, EuclideanBlock, wrap_angle
from pfbench.core.density import independent_normal, normal_batch
from pfbench.core.parameter_checks import (
    as_float64,
    check_positive,
    check_three_positive,
    check_tuning,
    require,
    require_ranges,
)
from pfbench.core.record import EACH_SATELLITE
from pfbench.model.base import StateSpaceModel

_LOG_ROOT_2PI = 0.5 * math.log(2.0 * math.pi)


class UrbanInputs(NamedTuple):
    """Odometry over each step, and the S satellites at its end.

    Each satellite has the same index in all steps.

    Attributes:
        duration: Duration of the step, s, [1, T].
        speed: Mean wheel speed, m/s, [1, T].
        yaw_rate: Mean yaw rate, clockwise from above, rad/s, [1, T].
        line: Unit vectors from the origin of the local frame to the satellites, East, North, Up,
            [1, T, S, 3].
        reach: Distances from that origin to the satellites, m, [1, T, S].
        glonass: 1 for a satellite with the inter-system bias, else 0, [1, T, S].
        cn0: Carrier-to-noise density, dB-Hz, [1, T, S].
        sd: Standard deviation of the range reported by the receiver, m, [1, T, S].
    """

    duration: Tensor
    speed: Tensor
    yaw_rate: Tensor
    line: Tensor
    reach: Tensor
    glonass: Tensor
    cn0: Tensor
    sd: Tensor


class PseudorangeError(Protocol):
    """Distribution of a pseudorange about its line-of-sight value."""

    def __call__(self, mean: Tensor, u: UrbanInputs) -> Distribution:
        """Return the distribution of the pseudoranges.

        Args:
            mean: Line-of-sight values, m, [R, N, S].
            u: Inputs of the step.

        Returns:
            Distribution with batch [R, N] and event [S].
        """


@dataclass(frozen=True)
class NormalRangeError(PseudorangeError):
    """Normal errors.

    Attributes:
        factor: Factor on the standard deviation reported by the receiver.

    Raises:
        ValueError: If the factor is not positive.
    """

    factor: float = 1.0

    def __post_init__(self) -> None:
        check_positive("model.range_error.factor", self.factor)

    @override
    def __call__(self, mean: Tensor, u: UrbanInputs) -> Distribution:
        return independent_normal(mean, (self.factor * u.sd).unsqueeze(1))


@dataclass(frozen=True)
class LosNlosRangeError(PseudorangeError):
    """Normal errors, with an additional exponential delay without line of sight.

    The probability of a line of sight depends on the carrier-to-noise density C:
    logit(probability) = logit(share) + slope (C - 40 dB-Hz). [ours: reflected signals are weak.
    With slope 0 all satellites have the same probability.]

    Attributes:
        share: Probability of a line of sight at 40 dB-Hz.
        sd: Standard deviation of the normal error, m.
        tail: Mean of the exponential delay, m.
        slope: Slope of the logit, per dB-Hz.

    Raises:
        ValueError: If the share is not in (0, 1), sd or tail is not positive, or the slope is not
            finite.
    """

    cn0_reference: ClassVar[float] = 40.0  # dB-Hz; where `share` is defined
    share: float
    sd: float
    tail: float
    slope: float = 0.0

    def __post_init__(self) -> None:
        require_ranges("model.range_error", self, share="(0, 1)")
        check_positive("model.range_error.sd", self.sd)
        check_positive("model.range_error.tail", self.tail)
        require(
            math.isfinite(self.slope),
            "model.range_error.slope",
            "be finite",
            self.slope,
            "Use 0 for the same share at every carrier-to-noise density.",
        )

    @override
    def __call__(self, mean: Tensor, u: UrbanInputs) -> Distribution:
        share, sd, tail = (as_float64(v).to(mean) for v in (self.share, self.sd, self.tail))
        odds = torch.logit(share) + self.slope * (u.cn0 - self.cn0_reference)
        return Independent(NormalExponentialMixture(mean, odds.unsqueeze(1), sd, tail), 1)


class NormalExponentialMixture(TorchDistribution):
    """Mixture of a normal and an exponentially modified normal distribution.

    A value is loc + sd n with probability p = sigmoid(odds), and loc + sd n + tail e otherwise.
    n is standard normal, e is exponential with mean 1. The second component is the exponentially
    modified normal distribution [Grushka 1972, "Characterization of exponentially modified Gaussian
    peaks in chromatography"]. Its log density is -log tail + s^2/2 - r/tail + log Phi(r/sd - s),
    with s = sd/tail and r = value - loc.

    Args:
        loc: Line-of-sight value.
        odds: Logit of the probability of a line of sight.
        sd: Standard deviation of the normal error, positive.
        tail: Mean of the delay, positive.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {
        "loc": constraints.real, "odds": constraints.real, "sd": constraints.positive, "tail": constraints.positive,
    }  # fmt: skip
    support = constraints.real

    def __init__(self, loc: Tensor, odds: Tensor, sd: Tensor, tail: Tensor) -> None:
        # only loc has the full shape, so that values shared by all particles are computed once
        shape = torch.broadcast_shapes(loc.shape, odds.shape, sd.shape, tail.shape)
        self.loc, self.odds, self.sd, self.tail = loc.expand(shape), odds, sd, tail
        super().__init__(shape, validate_args=False)

    @override
    def expand(
        self, batch_shape: Sequence[int], _instance: object = None
    ) -> NormalExponentialMixture:
        return NormalExponentialMixture(self.loc.expand(batch_shape), self.odds, self.sd, self.tail)

    @property
    @override
    def mean(self) -> Tensor:
        return self.loc + torch.sigmoid(-self.odds) * self.tail

    @property
    @override
    def variance(self) -> Tensor:
        delayed = torch.sigmoid(-self.odds)
        return (self.sd.square() + delayed * (2.0 - delayed) * self.tail.square()).expand_as(
            self.loc
        )

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        log_sigmoid, s, z = (
            torch.nn.functional.logsigmoid,
            self.sd / self.tail,
            (value - self.loc) / self.sd,
        )
        direct = log_sigmoid(self.odds) - torch.log(self.sd) - _LOG_ROOT_2PI
        delayed = log_sigmoid(-self.odds) - torch.log(self.tail) + 0.5 * s.square()
        return torch.logaddexp(
            direct - 0.5 * z.square(), delayed - s * z + torch.special.log_ndtr(z - s)
        )

    @override
    def sample(self, sample_shape: Any = ()) -> Tensor:
        shape = self._extended_shape(torch.Size(sample_shape))
        with torch.no_grad():
            n, detour = (
                torch.empty(shape, dtype=self.loc.dtype, device=self.loc.device) for _ in range(2)
            )
            delayed = torch.rand_like(n) > torch.sigmoid(self.odds)
            return self.loc + self.sd * n.normal_() + self.tail * detour.exponential_() * delayed


_CHART = Chart((EuclideanBlock(3), AngleBlock(1), EuclideanBlock(5)))


@dataclass(frozen=True)
class UrbanDensities:
    """Root densities of the noise that the filter assumes for odometry and clock.

    Attributes:
        distance_density: Error of the wheel distance, m/sqrt(s).
        heading_density: Error of the integrated yaw rate, rad/sqrt(s).
        height_density: Random walk of the height, m/sqrt(s).
        clock_density: White frequency noise of the receiver clock, m/sqrt(s).
        drift_density: Random walk of the clock frequency, m/s/sqrt(s).
        inter_system_density: Random walk of the inter-system bias, m/sqrt(s).
        scale_density: Random walk of the wheel scale error, 1/sqrt(s). A particle filter needs a
            small positive value.
        yaw_bias_density: Random walk of the yaw-rate bias, rad/s/sqrt(s). A particle filter needs a
            small positive value.
    """

    distance_density: float
    heading_density: float
    height_density: float
    clock_density: float
    drift_density: float
    inter_system_density: float
    scale_density: float
    yaw_bias_density: float

    @property
    def density(self) -> Tensor:
        """Root densities in the order of the process noise, SI units, [8].

        Raises:
            ValueError: If a density is not positive.
        """
        return _check_positive(self, [item.name for item in fields(UrbanDensities)])


@dataclass(frozen=True)
class UrbanTuning(UrbanDensities):
    """Parameters that the filter assumes for odometry, clock and initial state.

    Attributes:
        initial_position_sd: Initial position, East, North, Up, m, [3].
        initial_heading_sd_deg: Initial heading, degrees.
        initial_clock_sd: Initial clock bias, m.
        initial_drift_sd: Initial clock drift, m/s.
        initial_inter_system_sd: Initial inter-system bias, m.
        initial_scale_sd: Initial wheel scale error, dimensionless.
        initial_yaw_bias_sd: Initial yaw-rate bias, rad/s.
    """

    initial_position_sd: Sequence[float]
    initial_heading_sd_deg: float
    initial_clock_sd: float
    initial_drift_sd: float
    initial_inter_system_sd: float
    initial_scale_sd: float
    initial_yaw_bias_sd: float

    @property
    def initial_sd(self) -> Tensor:
        """Initial standard deviations in the chart, SI units, [9].

        Raises:
            ValueError: If a standard deviation is not positive, or the position does not have three.
        """
        names = ["clock", "drift", "inter_system", "scale", "yaw_bias"]
        position = check_three_positive(
            "scenario.tuning.initial_position_sd", self.initial_position_sd
        )
        heading = _check_positive(self, ["initial_heading_sd_deg"]) * (math.pi / 180.0)
        others = _check_positive(self, [f"initial_{name}_sd" for name in names])
        return torch.cat([position, heading, others])


def _check_positive(tuning: UrbanDensities, names: Sequence[str]) -> Tensor:
    """Return attributes after a check that they are positive."""
    return torch.cat(
        [check_positive(f"scenario.tuning.{name}", [getattr(tuning, name)]) for name in names]
    )


class UrbanGnss(StateSpaceModel):
    """Urban positioning by odometry and pseudoranges, with nine states.

    The states are position (East, North, Up), heading, clock bias, clock drift, inter-system bias,
    wheel scale error and yaw-rate bias.

    Over a step T the car follows an arc with distance d = (1 + scale) v T + n and turn
    a = (rate - bias) T + n'. Then p' = p + d sinc(a/2) (sin, cos)(heading + a/2) and
    heading' = heading + a, clockwise from North. The height is a random walk. Clock bias and drift
    form a two-state clock. The bias receives half the step times the noise of the drift, its exact
    regression on that noise.

    A measurement is the pseudorange of a satellite, reduced by its range from the origin and by a
    nominal clock. Its line-of-sight value is the difference of ranges plus the clock bias. GLONASS
    adds the inter-system bias.

    Args:
        tuning: Noise densities and initial standard deviations.
        range_error: Distribution of a pseudorange about its line-of-sight value.

    Raises:
        ValueError: If a density or standard deviation is not positive.
    """

    channel_names = (f"range {EACH_SATELLITE} minus that from the local origin [m]",)
    input_type = UrbanInputs
    density: Tensor
    p0: Tensor
    noise_dim = 8
    names = (
        "position_E", "position_N", "height", "heading", "clock_bias", "clock_drift", "inter_system_bias", "wheel_scale",
        "yaw_rate_bias",
    )  # fmt: skip
    units = ("m", "m", "m", "rad", "m", "m/s", "m", "", "rad/s")
    choices = (
        "pseudorange errors are independent between epochs, although errors of reflections last for seconds",
        "the clock bias is driven by half the noise of the clock drift (its exact regression) and by white frequency noise",
    )

    def __init__(self, tuning: UrbanTuning, range_error: PseudorangeError) -> None:
        super().__init__()
        check_tuning(tuning, UrbanTuning)
        self.register_buffer("density", tuning.density)
        self.register_buffer("p0", tuning.initial_sd)
        self.range_error = range_error
        self.groups = {
            "position": (0, 1),
            "height": (2,),
            "heading": (3,),
            "clock": (4, 5, 6),
            "odometry": (7, 8),
        }

    @property
    @override
    def chart(self) -> Chart:
        return _CHART

    @override
    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    @override
    def propagate(self, x: Tensor, u: UrbanInputs, w: Tensor) -> Tensor:
        duration = u.duration.unsqueeze(-1)  # [R or 1, 1]
        noise = w * self.density * torch.sqrt(duration).unsqueeze(-1)
        east, north, up, heading, clock, drift, inter, scale, bias = x.unbind(-1)
        n_distance, n_heading, n_up, n_clock, n_drift, n_inter, n_scale, n_bias = noise.unbind(-1)
        distance = (1.0 + scale) * (u.speed.unsqueeze(-1) * duration) + n_distance
        turn = (u.yaw_rate.unsqueeze(-1) - bias) * duration + n_heading
        chord, middle = distance * torch.sinc(turn / (2.0 * torch.pi)), heading + 0.5 * turn
        east, north = east + chord * torch.sin(middle), north + chord * torch.cos(middle)
        clock = clock + (drift + 0.5 * n_drift) * duration + n_clock
        remaining_states = [
            up + n_up,
            wrap_angle(heading + turn),
            clock,
            drift + n_drift,
            inter + n_inter,
            scale + n_scale,
            bias + n_bias,
        ]
        return torch.stack([east, north, *remaining_states], -1)

    @override
    def observation(self, x: Tensor, u: UrbanInputs) -> Distribution:
        offset = x[..., 4:5] + x[..., 6:7] * u.glonass.unsqueeze(1)
        return self.range_error(range_change(x[..., :3], u.line, u.reach) + offset, u)

    def observation_jacobian(self, x: Tensor, u: UrbanInputs) -> Tensor:
        """Return unit vectors from the satellites and the derivatives of the clock, [R, N, S, 9].

        Args:
            x: States, [R, N, 9].
            u: Inputs of the step.
        """
        sight = x[..., None, :3] - (u.reach.unsqueeze(-1) * u.line).unsqueeze(1)
        rows = x.new_zeros(*sight.shape[:-1], x.shape[-1])
        rows[..., :3], rows[..., 4] = normalize(sight, dim=-1), 1.0
        rows[..., 6] = u.glonass.unsqueeze(1)
        return rows


def range_change(position: Tensor, line: Tensor, reach: Tensor) -> Tensor:
    """Compute |reach line - position| - reach without cancellation.

    Args:
        position: Positions, m, [R, N, 3].
        line: Unit vectors to the satellites, [R or 1, S, 3].
        reach: Distances of the satellites, m, [R or 1, S].

    Returns:
        Range differences, m, [R, N, S].
    """
    change = (
        position.square().sum(-1, keepdim=True) / reach.unsqueeze(1)
    ) - 2.0 * position @ line.mT
    return change / (1.0 + torch.sqrt(1.0 + change / reach.unsqueeze(1)))
