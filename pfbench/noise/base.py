"""Protocol of noise regimes, and the regimes without memory: nominal, heavy-tailed and impulsive errors."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol, TypeAlias

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Laplace, Normal, StudentT, constraints
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels

_SAMPLES = 20  # samples of process noise within a step


class NoiseRegime(Protocol):
    """Deviations of a scenario from nominal noise.

    A regime of your own is a subclass with `draw_errors`. Errors that are multiples of `channels.sd` fit any scenario. The other
    two methods are for process noise that changes with time, and for filters and bounds that know the distribution.
    """

    @abstractmethod
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        """Draw the errors of the measurements.

        Args:
            draws: Random stream, which decides the runs.
            channels: Nominal noise, kind and source of each component.
            time: Times of the measurements, [T], s.

        Returns:
            Errors, [R, T, Dy]. NaN marks a missing component.
        """

    def process_factors(self, time: Tensor) -> Tensor:
        """Return factors on the process noise variance at times [T] s: [T], 1 unless a regime changes them.

        In a simulation the factor applies to the white noise of the inertial sensors.
        """
        return torch.ones_like(time)

    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        """Return the distribution of the errors at times [T] s, for oracle noise and the bound of all filters.

        Args:
            channels: Nominal noise, kind and source of each component.
            time: Times of the measurements, [T], s.

        Returns:
            Family, shift and scale of the errors.

        Raises:
            ValueError: If the errors do not have a distribution per step, or the regime does not define this method.
        """
        name = type(self).__name__
        raise make_no_distribution_error(name, f"{name} does not define error_distribution")


class LayeredRegime(NoiseRegime):
    """A regime that changes the errors of another regime, with the process noise of that one.

    Attributes:
        base_regime: The other regime.
    """

    base_regime: NoiseRegime

    @override
    def process_factors(self, time: Tensor) -> Tensor:
        return self.base_regime.process_factors(time)


def process_variance_factors(noise: NoiseRegime, time: Tensor) -> Tensor:
    """Compute factors on the process noise variance of each step.

    A factor is the mean over the interval that ends at the time of the step. The first interval is
    as long as the second.

    Returns factors, [T]. Shapes: time [T].
    """
    spans = torch.diff(time, prepend=2 * time[:1] - time[1:2]) if len(time) > 1 else time
    inside = 1.0 - (torch.arange(_SAMPLES, dtype=time.dtype) + 0.5) / _SAMPLES
    middles = (time[:, None] - spans[:, None] * inside).flatten()
    factors = noise.process_factors(torch.cat([middles, time[-1:]]))[
        :-1
    ]  # the last time defines the end of the record
    return factors.unflatten(0, (-1, _SAMPLES)).mean(1)


def check_unit_process(noise: NoiseRegime, time: Tensor) -> None:
    """Check that a regime does not change process noise, for recorded motion.

    Shapes: time [T].
    """
    if bool((noise.process_factors(time) != 1.0).any()):
        raise ValueError(
            "noise must not change the process noise of a scenario with recorded sensors. "
            "Set noise.process_variance_factors=[1.0,1.0], or choose a simulated scenario."
        )


def draw_added_errors(
    noise: NoiseRegime, draws: RandomStream, channels: MeasurementChannels, time: Tensor
) -> Tensor:
    """Draw the errors that a regime adds to recorded measurements, whose standard deviations can be 0.

    Returns errors, [R, T, Dy]. A regime that would change nothing is refused. Shapes: time [T].
    """
    errors = noise.draw_errors(draws, channels, time)
    inner = getattr(noise, "regime", noise)  # a job wraps it
    if isinstance(inner, NominalNoise | AddedErrors) or bool((errors != 0.0).any()):
        return errors
    sd = "position_sd=[1.5,1.5,3.0]" if "position" in channels.kind else "range_sd=1.0"
    raise ValueError(
        f"noise must change the measurements, got {type(inner).__name__} with errors of 0: it scales the standard "
        f"deviations of scenario.receiver, which are 0, or acts outside of the record, {float(time[0]):g} to "
        f"{float(time[-1]):g} s. Set scenario.receiver.{sd}, or noise=added_white, added_outliers or random_outage."
    )


def make_no_distribution_error(noise: str, reason: str) -> ValueError:
    """Make the error of a regime without a distribution per step."""
    return ValueError(
        f"oracle_noise must be false for noise={noise}, got true. Its errors do not have a "
        f"distribution per step, because {reason}. Set oracle_noise=false."
    )


# The nominal part of each regime uses the random numbers of the nominal regime, so filters are compared
# across regimes on common random numbers.


def _same_at_all_steps(
    family: Family, channels: MeasurementChannels, time: Tensor
) -> ErrorDistribution:
    """Return the same distribution at all steps."""
    shape = len(time), len(channels.sd)
    return ErrorDistribution(family, time.new_zeros(shape), time.new_ones(shape))


@dataclass(frozen=True)
class NominalNoise(NoiseRegime):
    """White normal errors of nominal size."""

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        return channels.sd * draws.normal("world.receiver", len(time), len(channels.sd))

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        return _same_at_all_steps(make_normal, channels, time)


@dataclass(frozen=True)
class StudentTNoise(NoiseRegime):
    """Student's t errors with `dof` degrees of freedom and nominal scale.

    The scale, and not the variance, is nominal. Nominal variance would make most errors smaller
    than the filter assumes. [ours]

    Attributes:
        dof: Degrees of freedom.

    Raises:
        ValueError: If `dof` is below 3, where the variance is large or infinite.
    """

    dof: int = 4

    def __post_init__(self) -> None:
        require_ranges(
            "noise", self, dof="[3, inf] The variance of smaller values is large or infinite."
        )

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        t, k = len(time), len(channels.sd)
        z = draws.normal("world.receiver", t, k)
        squares = draws.normal("world.tails", t, k * self.dof).square()
        chi2 = squares.reshape(-1, t, k, self.dof).sum(-1)
        return channels.sd * z / torch.sqrt(chi2 / self.dof)

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        return _same_at_all_steps(make_student_t(self.dof), channels, time)


@dataclass(frozen=True)
class LaplaceNoise(NoiseRegime):
    """Laplace errors of nominal variance.

    Only the shape differs from the assumption of a Kalman filter. Larger nominal errors become
    larger errors (monotone transformation). [ours]
    """

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        return channels.sd * normal_to_laplace(
            draws.normal("world.receiver", len(time), len(channels.sd))
        )

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        return _same_at_all_steps(make_laplace, channels, time)


@dataclass(frozen=True)
class _ContaminatedNoise(NoiseRegime):
    """Normal errors, with some probability errors of another distribution.

    Attributes:
        probability: Probability of a large error per epoch, or per component.
        sd_factor: Standard deviation of a large error in nominal standard deviations.
        joint: Whether all components of an epoch have large errors together, or each independently.
    """

    probability: float
    sd_factor: float
    joint: bool

    def __post_init__(self) -> None:
        require_ranges(
            "noise",
            self,
            probability="[0, 1]",
            sd_factor="[1, inf] Give a factor on the nominal standard deviation.",
        )

    @property
    def _large_errors(self) -> Family:
        return make_normal

    def _outlier_mask(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        """Draw a mask of large errors, [R, T, 1 or Dy]."""
        size = 1 if self.joint else len(channels.sd)
        return draws.uniform("world.outliers", len(time), size) < self.probability

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        family = contaminated_normal(
            self.probability, self.sd_factor, self.joint, self._large_errors
        )
        return _same_at_all_steps(family, channels, time)


@dataclass(frozen=True)
class OutlierNoise(_ContaminatedNoise):
    """Impulsive errors, a contaminated normal [Tukey 1960; Huber 1964].

    The attributes are those of `GlintNoise`. An outlier is a nominal error times `sd_factor`.
    """

    probability: float = 0.05
    sd_factor: float = 10.0
    joint: bool = True

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        outlier_mask = self._outlier_mask(draws, channels, time)
        factor = torch.where(outlier_mask, self.sd_factor, 1.0).to(channels.sd)
        return factor * NominalNoise().draw_errors(draws, channels, time)


@dataclass(frozen=True)
class GlintNoise(_ContaminatedNoise):
    """Radar glint: normal errors, with some probability Laplace errors.

    [Wu 1993, "Target tracking with glint noise"]. For glint with a wide normal use `OutlierNoise`
    with joint=false.

    Attributes:
        probability: Probability of a glint per epoch, or per component.
        sd_factor: Standard deviation of a glint in nominal standard deviations.
        joint: Whether all components of an epoch have glint together, or each independently.

    Raises:
        ValueError: If `probability` is outside [0, 1], or `sd_factor` is below 1.
    """

    probability: float = 0.1
    sd_factor: float = 10.0
    joint: bool = False

    @property
    @override
    def _large_errors(self) -> Family:
        return make_laplace

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        outlier_mask = self._outlier_mask(draws, channels, time)
        spike = self.sd_factor * LaplaceNoise().draw_errors(draws, channels, time)
        return torch.where(outlier_mask, spike, NominalNoise().draw_errors(draws, channels, time))


@dataclass(frozen=True)
class AddedErrors(NoiseRegime):
    """Errors in metres in addition to the nominal ones, for records whose measurements have errors already.

    Positions or, without positions, ranges get them; a scenario without both is refused. [ours]

    Attributes:
        sd_m: Standard deviation of a white normal error, m.
        probability: Probability of an outlier per epoch and source.
        outlier_sd_m: Standard deviation of an outlier, m, in all components of the source.

    Raises:
        ValueError: If a number is negative, the probability is above 1, or nothing is added.
    """

    sd_m: float = 0.0
    probability: float = 0.0
    outlier_sd_m: float = 0.0

    def __post_init__(self) -> None:
        require_ranges(
            "noise", self, sd_m="[0, inf]", probability="[0, 1]", outlier_sd_m="[0, inf]"
        )
        require(
            self.sd_m or self.probability * self.outlier_sd_m,
            "noise",
            "add errors",
            "sd_m, probability or outlier_sd_m of 0",
            "Set noise.sd_m, or both others.",
        )

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        kind = next((kind for kind in ("position", "range") if kind in channels.kind), None)
        require(
            kind is not None,
            "noise",
            "add metres to positions or ranges",
            "a scenario without both",
            "Choose a regime in standard deviations, such as noise=outliers.",
        )
        is_changed = torch.tensor([k == kind for k in channels.kind])
        sources, source = torch.unique(torch.tensor(channels.source), return_inverse=True)
        t, k = len(time), len(channels.sd)
        is_outlier = draws.uniform("world.outliers", t, len(sources)) < self.probability
        errors = self.sd_m * draws.normal("world.added", t, k)
        errors = errors + is_outlier[..., source] * self.outlier_sd_m * draws.normal("world.tails", t, k)  # fmt: skip
        return NominalNoise().draw_errors(draws, channels, time) + torch.where(is_changed, errors, 0.0)  # fmt: skip

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        raise make_no_distribution_error(
            noise="added errors", reason="those of the record beside them are unknown"
        )


# --------------------------------------------------------------------------------------------------
# Distributions of measurement errors in one step, for filters with oracle noise.

Family: TypeAlias = Callable[[Tensor, Tensor], Distribution]

"""Centre and scale [..., Dy] -> a distribution with event [Dy]: Independent or Mixture."""


class ErrorDistribution(NamedTuple):
    """Distribution of the errors at each step.

    Attributes:
        family: Distribution family of all steps.
        shift: Centre in nominal standard deviations, [T, Dy].
        scale: Scale in nominal standard deviations, [T, Dy].
    """

    family: Family
    shift: Tensor
    scale: Tensor


class MixtureDistribution(Distribution):
    """A mixture: with probability weights[k] the distribution components[k].

    Torch's mixture requires components of one family. A mixture of univariate distributions is
    univariate. A mixture of Independent ones draws all components of a vector from the same part.
    """

    arg_constraints = {}  # noqa: RUF012
    support = constraints.real

    def __init__(self, weights: Sequence[Tensor], components: Sequence[Distribution]) -> None:
        self.weights, self.components = tuple(weights), tuple(components)
        super().__init__(components[0].batch_shape, components[0].event_shape, validate_args=False)

    @property
    @override
    def mean(self) -> Tensor:
        return self._average([component.mean for component in self.components])

    @property
    @override
    def variance(self) -> Tensor:
        centre = self.mean
        return self._average(
            [
                component.variance + (component.mean - centre).square()
                for component in self.components
            ]
        )

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        return self.combine_log_densities(
            [component.log_prob(value) for component in self.components]
        )

    def combine_log_densities(self, log_densities: Sequence[Tensor]) -> Tensor:
        """Combine the log densities of the components into the log density of the mixture."""
        weighted = [
            torch.log(w) + log_p for w, log_p in zip(self.weights, log_densities, strict=True)
        ]
        return torch.logsumexp(torch.stack(torch.broadcast_tensors(*weighted)), 0)

    def _average(self, values: Sequence[Tensor]) -> Tensor:
        dims = len(self.event_shape)  # weights of vectors lack the axis of components
        pairs = zip(self.weights, values, strict=True)
        return torch.stack([w.reshape(w.shape + (1,) * dims) * v for w, v in pairs]).sum(0)


class ExponentiallyModifiedGaussian(Distribution):
    """Normal plus independent exponential (exponentially modified Gaussian).

    With s the standard deviation of the normal and m the mean `lag` of the exponential,
    log p(y) = s^2/(2 m^2) - (y - loc)/m - log m + log Phi((y - loc)/s - s/m) [Grushka 1972].
    """

    arg_constraints = {}  # noqa: RUF012
    support = constraints.real

    def __init__(self, loc: Tensor, scale: Tensor, lag: Tensor) -> None:
        self.loc, self.scale, self.lag = torch.broadcast_tensors(loc, scale, lag)
        super().__init__(self.loc.shape, validate_args=False)

    @property
    @override
    def mean(self) -> Tensor:
        return self.loc + self.lag

    @property
    @override
    def variance(self) -> Tensor:
        return self.scale.square() + self.lag.square()

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        z, slope = (value - self.loc) / self.scale, self.scale / self.lag
        return (
            0.5 * slope.square()
            - slope * z
            - torch.log(self.lag)
            + torch.special.log_ndtr(z - slope)
        )


def make_normal(loc: Tensor, scale: Tensor) -> Distribution:
    """Build independent normal distributions (the nominal family).

    Args:
        loc: Centre, [..., Dy].
        scale: Standard deviation, [..., Dy].
    """
    return Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)


def make_student_t(dof: int) -> Family:
    """Return the family of Student's t with `dof` degrees of freedom."""
    return lambda loc, scale: Independent(
        StudentT(loc.new_tensor(float(dof)), loc, scale, validate_args=False),
        1,
        validate_args=False,
    )


def make_laplace(loc: Tensor, scale: Tensor) -> Distribution:
    """Build independent Laplace distributions.

    Shapes: loc [..., Dy], scale [..., Dy].
    """
    return Independent(
        Laplace(loc, scale / math.sqrt(2.0), validate_args=False), 1, validate_args=False
    )


def contaminated_normal(probability: float, sd_factor: float, joint: bool, heavy: Family) -> Family:
    """Return the family of a contaminated normal distribution."""

    def family(loc: Tensor, scale: Tensor) -> Distribution:
        parts = [make_normal(loc, scale), heavy(loc, sd_factor * scale)]
        weights = loc.new_tensor([1.0 - probability, probability]).unbind()
        if joint:
            return MixtureDistribution(weights, parts)
        univariate = [component.base_dist for component in parts]  # type: ignore[attr-defined]
        return Independent(MixtureDistribution(weights, univariate), 1, validate_args=False)

    return family


def normal_plus_exponential(probability: Tensor, mean: float) -> Family:
    """Return the family of a normal plus an exponential with some probability."""

    def family(loc: Tensor, scale: Tensor) -> Distribution:
        p = probability.to(loc)
        parts = [
            Normal(loc, scale, validate_args=False),
            ExponentiallyModifiedGaussian(loc, scale, mean * scale),
        ]
        return Independent(MixtureDistribution([1.0 - p, p], parts), 1, validate_args=False)

    return family


def normal_to_laplace(z: Tensor) -> Tensor:
    """Transform standard normal numbers to Laplace numbers of variance 1.

    The transformation is monotone: minus the log of twice the normal tail is exponential.
    """
    return torch.sign(z) * -(torch.special.log_ndtr(-z.abs()) + math.log(2.0)) / math.sqrt(2.0)
