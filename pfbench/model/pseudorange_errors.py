"""Inputs of urban positioning, and distributions of pseudoranges with and without line of sight."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from pyro.distributions import Independent, TorchDistribution
from torch import Tensor
from torch.distributions import Distribution, constraints
from typing_extensions import override

from pfbench.core.normal import independent_normal
from pfbench.core.parameter_checks import check_positive

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
        if not 0.0 < self.share < 1.0:
            raise ValueError(
                "model.range_error.share must be between 0 and 1, exclusive, "
                f"got {self.share}. Set a probability."
            )
        check_positive("model.range_error.sd", self.sd)
        check_positive("model.range_error.tail", self.tail)
        if not math.isfinite(self.slope):
            raise ValueError(
                f"model.range_error.slope must be finite, got {self.slope}. "
                "Use 0 for the same share at every carrier-to-noise density."
            )

    @override
    def __call__(self, mean: Tensor, u: UrbanInputs) -> Distribution:
        odds = math.log(self.share / (1.0 - self.share)) + self.slope * (u.cn0 - self.cn0_reference)
        distribution = NormalExponentialMixture(
            mean, odds.unsqueeze(1), mean.new_tensor(self.sd), mean.new_tensor(self.tail)
        )
        return Independent(distribution, 1)


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
