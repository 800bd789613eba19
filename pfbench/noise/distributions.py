"""Distributions of measurement errors in one step, for filters with oracle noise."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Laplace, Normal, StudentT, constraints
from typing_extensions import override

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
    return Independent(_laplace(loc, scale), 1, validate_args=False)


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


def _laplace(loc: Tensor, scale: Tensor) -> Laplace:
    return Laplace(loc, scale / math.sqrt(2.0), validate_args=False)
