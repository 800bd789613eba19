"""A car in a city: pseudoranges seen directly or by reflection, wheel speed and yaw rate as inputs.

Ranges enter as differences about the origin of the local frame, to which each satellite has a direction and a distance. They
keep all digits of a millimetre in single precision, where a range itself (2e7 m) has two metres.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, Protocol

import torch
from pyro.distributions import Independent, TorchDistribution
from torch import Tensor
from torch.distributions import Distribution, constraints

from pfbench.chart import Angles, Chart, Euclidean, wrap
from pfbench.model.base import StateSpaceModel, independent_normal, normal_batch, positive
from pfbench.record import Record

_CHART = Chart((Euclidean(3), Angles(1), Euclidean(5)))
_LOG_ROOT_2PI = 0.5 * math.log(2.0 * math.pi)
CN0_REFERENCE = 40.0  # dB-Hz at which a law's share is told


class Sky(NamedTuple):
    """Odometry over the step, and the satellites at its end, in S slots of which each belongs to one satellite for good.

    Attributes:
        duration: [1, T] s.
        speed: mean of the wheel speed [1, T] m/s.
        yaw_rate: mean rate, clockwise seen from above [1, T] rad/s.
        line: unit vectors from the origin of the local frame to the satellites, East, North, Up [1, T, S, 3].
        reach: their distances from it [1, T, S] m.
        glonass: 1 for a satellite whose ranges carry the inter-system bias, 0 for the others [1, T, S].
        cn0: carrier-to-noise density [1, T, S] dB-Hz.
        sd: standard deviation of the range as the receiver states it [1, T, S] m.
    """

    duration: Tensor
    speed: Tensor
    yaw_rate: Tensor
    line: Tensor
    reach: Tensor
    glonass: Tensor
    cn0: Tensor
    sd: Tensor


class RangeLaw(Protocol):
    """Law of a pseudorange about the one of a straight path: mean [R, N, S], inputs -> batch [R, N], event [S]."""

    def __call__(self, mean: Tensor, u: Sky) -> Distribution: ...


@dataclass(frozen=True)
class Normal:
    """Normal, with the receiver's own standard deviation times `factor`.

    Raises:
        ValueError: a factor that is not positive.
    """

    factor: float = 1.0

    def __post_init__(self) -> None:
        positive("law.factor", self.factor)

    def __call__(self, mean: Tensor, u: Sky) -> Distribution:
        return independent_normal(mean, (self.factor * u.sd).unsqueeze(1))


@dataclass(frozen=True)
class SightOrTail:
    """Line of sight with some probability, else delayed by an exponential detour as well.

    The odds of a line of sight grow with the carrier-to-noise density C: logit of the probability = logit(share) +
    slope (C - 40 dB-Hz). [ours: a reflected signal is a weak one; slope 0 gives every satellite the same probability]

    Args:
        share: probability of a line of sight at 40 dB-Hz.
        sd: of the normal error, m.
        tail: mean of the exponential detour, m.
        slope: of the logit, per dB-Hz.

    Raises:
        ValueError: a share outside (0, 1), an sd or tail that is not positive, a slope that is not finite.
    """

    share: float
    sd: float
    tail: float
    slope: float = 0.0

    def __post_init__(self) -> None:
        if not 0.0 < self.share < 1.0:
            raise ValueError(f"law.share={self.share}: give a probability between 0 and 1, exclusive")
        positive("law.sd", self.sd)
        positive("law.tail", self.tail)
        if not math.isfinite(self.slope):
            raise ValueError(f"law.slope={self.slope}: give a number (0: the same share at every carrier-to-noise density)")

    def __call__(self, mean: Tensor, u: Sky) -> Distribution:
        odds = math.log(self.share / (1.0 - self.share)) + self.slope * (u.cn0 - CN0_REFERENCE)
        law = TailedNormal(mean, odds.unsqueeze(1), mean.new_tensor(self.sd), mean.new_tensor(self.tail))
        return Independent(law, 1)


class TailedNormal(TorchDistribution):
    """loc + sd n, and with probability 1 - p an exponential of mean `tail` besides; p = sigmoid(odds).

    The second part is the exponentially modified normal law [Grushka 1972, "Characterization of exponentially modified
    Gaussian peaks in chromatography"], here in the log domain: log f = -log tail + s^2/2 - r/tail + log Phi(r/sd - s),
    s = sd/tail, r = value - loc.

    Args:
        loc: the line-of-sight value.
        odds: logit of the probability of the line of sight.
        sd, tail: positive.
    """

    arg_constraints: ClassVar[dict[str, Any]] = {
        "loc": constraints.real, "odds": constraints.real, "sd": constraints.positive, "tail": constraints.positive,
    }  # fmt: skip
    support = constraints.real

    def __init__(self, loc: Tensor, odds: Tensor, sd: Tensor, tail: Tensor) -> None:
        # only loc takes the whole shape: what is the same for all particles is computed once
        shape = torch.broadcast_shapes(loc.shape, odds.shape, sd.shape, tail.shape)
        self.loc, self.odds, self.sd, self.tail = loc.expand(shape), odds, sd, tail
        super().__init__(shape, validate_args=False)

    def expand(self, batch_shape: Sequence[int], _instance: object = None) -> TailedNormal:
        return TailedNormal(self.loc.expand(batch_shape), self.odds, self.sd, self.tail)

    @property
    def mean(self) -> Tensor:
        return self.loc + torch.sigmoid(-self.odds) * self.tail

    @property
    def variance(self) -> Tensor:
        delayed = torch.sigmoid(-self.odds)
        return (self.sd.square() + delayed * (2.0 - delayed) * self.tail.square()).expand_as(self.loc)

    def log_prob(self, value: Tensor) -> Tensor:
        log_sigmoid, s, z = torch.nn.functional.logsigmoid, self.sd / self.tail, (value - self.loc) / self.sd
        sight = log_sigmoid(self.odds) - torch.log(self.sd) - _LOG_ROOT_2PI
        delayed = log_sigmoid(-self.odds) - torch.log(self.tail) + 0.5 * s.square()
        return torch.logaddexp(sight - 0.5 * z.square(), delayed - s * z + torch.special.log_ndtr(z - s))

    def sample(self, sample_shape: Any = ()) -> Tensor:
        shape = self._extended_shape(torch.Size(sample_shape))
        with torch.no_grad():
            n, detour = (torch.empty(shape, dtype=self.loc.dtype, device=self.loc.device) for _ in range(2))
            delayed = torch.rand_like(n) > torch.sigmoid(self.odds)
            return self.loc + self.sd * n.normal_() + self.tail * detour.exponential_() * delayed


@dataclass(frozen=True)
class Believed:
    """What filters are told about the odometry, the clock and the start.

    Args:
        distance_density: of the wheel's distance, m/sqrt(s).
        heading_density: of the integrated yaw rate, rad/sqrt(s).
        height_density: walk of the height, m/sqrt(s).
        clock_density, drift_density: white frequency and walk of the frequency of the receiver's clock, m/sqrt(s) and
            m/s/sqrt(s).
        inter_system_density: walk of the inter-system bias, m/sqrt(s).
        scale_density, yaw_bias_density: walks of the wheel's scale error and the yaw rate's bias, 1/sqrt(s) and
            rad/s/sqrt(s). Small, but a particle filter needs some.
        initial_position_sd: East, North, Up in m.
        initial_heading_sd_deg: degrees.
        initial_clock_sd, initial_drift_sd, initial_inter_system_sd: m, m/s, m.
        initial_scale_sd, initial_yaw_bias_sd: -, rad/s.
    """

    distance_density: float
    heading_density: float
    height_density: float
    clock_density: float
    drift_density: float
    inter_system_density: float
    scale_density: float
    yaw_bias_density: float
    initial_position_sd: Sequence[float]
    initial_heading_sd_deg: float
    initial_clock_sd: float
    initial_drift_sd: float
    initial_inter_system_sd: float
    initial_scale_sd: float
    initial_yaw_bias_sd: float

    @property
    def density(self) -> Tensor:
        """Root densities in the order of the noise [8], SI.

        Raises:
            ValueError: one that is not positive.
        """
        names = ("distance", "heading", "height", "clock", "drift", "inter_system", "scale", "yaw_bias")
        return torch.cat([positive(f"believed.{name}_density", [getattr(self, f"{name}_density")]) for name in names])

    @property
    def initial_sd(self) -> Tensor:
        """Standard deviations of the initial errors in the chart [9], SI.

        Raises:
            ValueError: one that is not positive, or positions that are not three.
        """
        if len(self.initial_position_sd) != 3:
            raise ValueError(f"believed.initial_position_sd={list(self.initial_position_sd)}: give three numbers")
        parts = [positive("believed.initial_position_sd", list(self.initial_position_sd))]
        parts += [positive("believed.initial_heading_sd_deg", [self.initial_heading_sd_deg]) * (math.pi / 180.0)]
        for name in ("clock", "drift", "inter_system", "scale", "yaw_bias"):
            key = f"initial_{name}_sd"
            parts.append(positive(f"believed.{key}", [getattr(self, key)]))
        return torch.cat(parts)


class UrbanGnss(StateSpaceModel):
    """State [9]: position (East, North, Up), heading, clock bias and drift, inter-system bias, wheel scale, yaw-rate bias.

    Over a step T the car follows an arc: distance d = (1 + scale) v T + n and turn a = (rate - bias) T + n', so that
    p' = p + d sinc(a/2) (sin, cos)(heading + a/2) and heading' = heading + a, clockwise from North. The height walks; clock
    bias and drift are the usual two-state clock, whose bias gets half the step of the drift's noise (its exact regression).
    What is seen: the pseudorange of each satellite less its range from the origin and a nominal clock; its line-of-sight
    value is the difference of ranges + clock bias (+ inter-system bias for GLONASS).

    Args:
        believed: densities and standard deviations.
        law: of a pseudorange about its line-of-sight value.

    Raises:
        ValueError: a density or standard deviation that is not positive.
    """

    density: Tensor
    p0: Tensor
    noise_dim = 8
    names = (
        "position_E", "position_N", "height", "heading", "clock_bias", "clock_drift", "inter_system_bias", "wheel_scale",
        "yaw_rate_bias",
    )  # fmt: skip
    units = ("m", "m", "m", "rad", "m", "m/s", "m", "", "rad/s")
    choices = (
        "pseudorange errors are taken as independent from epoch to epoch; those of reflections last for seconds",
        "the clock's bias is driven by half the noise of its drift (its exact regression) and white frequency noise of its own",
    )

    def __init__(self, believed: Believed, law: RangeLaw) -> None:
        super().__init__()
        self.register_buffer("density", believed.density)
        self.register_buffer("p0", believed.initial_sd)
        self.law = law
        self.groups = {"position": (0, 1), "height": (2,), "heading": (3,), "clock": (4, 5, 6), "odometry": (7, 8)}

    @property
    def chart(self) -> Chart:
        return _CHART

    def prepare(self, record: Record) -> Record:
        """The record as it is.

        Raises:
            ValueError: inputs of another kind.
        """
        if not isinstance(record.u, Sky):
            raise ValueError(f"record.u is {type(record.u).__name__}: UrbanGnss needs Sky; choose scenario=berlin")
        return record

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.p0)

    def propagate(self, x: Tensor, u: Sky, w: Tensor) -> Tensor:
        span = u.duration.unsqueeze(-1)  # [R or 1, 1]
        noise = w * self.density * torch.sqrt(span).unsqueeze(-1)
        east, north, up, heading, clock, drift, inter, scale, bias = x.unbind(-1)
        n_distance, n_heading, n_up, n_clock, n_drift, n_inter, n_scale, n_bias = noise.unbind(-1)
        distance = (1.0 + scale) * (u.speed.unsqueeze(-1) * span) + n_distance
        turn = (u.yaw_rate.unsqueeze(-1) - bias) * span + n_heading
        chord, middle = distance * torch.sinc(turn / (2.0 * torch.pi)), heading + 0.5 * turn
        east, north = east + chord * torch.sin(middle), north + chord * torch.cos(middle)
        clock = clock + (drift + 0.5 * n_drift) * span + n_clock
        walked = [up + n_up, wrap(heading + turn), clock, drift + n_drift, inter + n_inter, scale + n_scale, bias + n_bias]
        return torch.stack([east, north, *walked], -1)

    def observation(self, x: Tensor, u: Sky) -> Distribution:
        offset = x[..., 4:5] + x[..., 6:7] * u.glonass.unsqueeze(1)
        return self.law(range_change(x[..., :3], u.line, u.reach) + offset, u)


def range_change(position: Tensor, line: Tensor, reach: Tensor) -> Tensor:
    """|reach line - p| - reach, without the cancellation: position [R, N, 3], line [R or 1, S, 3] -> [R, N, S]."""
    across = (position.square().sum(-1, keepdim=True) / reach.unsqueeze(1)) - 2.0 * position @ line.mT
    return across / (1.0 + torch.sqrt(1.0 + across / reach.unsqueeze(1)))
