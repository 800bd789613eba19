"""Laws that a filter can be told: what the errors of one step are, given their nominal standard deviations."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple, TypeAlias

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Laplace, Normal, StudentT, constraints

Family: TypeAlias = Callable[[Tensor, Tensor], Distribution]
"""Centre and scale [..., Dy] of each component -> a law with event [Dy]: Independent, or a Mixture of such."""


class Law(NamedTuple):
    """Errors at each step: the family, about `shift` and of `scale` nominal standard deviations.

    Attributes:
        family: what is the same at all steps.
        shift, scale: [T, Dy].
    """

    family: Family
    shift: Tensor
    scale: Tensor


class Mixture(Distribution):
    """With probability weights[k] the law parts[k]; all parts have the same shapes.

    torch's own mixture wants parts of one family. Of univariate parts it is a univariate law, of Independent ones it is a law
    of whole vectors, whose components are drawn from the same part.

    Args:
        weights: of each part, a tensor that broadcasts against the parts' batch; 0 leaves a part out.
        parts: univariate, or Independent.
    """

    arg_constraints = {}  # noqa: RUF012 (torch's name for what it checks)
    support = constraints.real

    def __init__(self, weights: Sequence[Tensor], parts: Sequence[Distribution]) -> None:
        self.weights, self.parts = tuple(weights), tuple(parts)
        super().__init__(parts[0].batch_shape, parts[0].event_shape, validate_args=False)

    @property
    def mean(self) -> Tensor:
        return self._average([part.mean for part in self.parts])

    @property
    def variance(self) -> Tensor:
        centre = self.mean
        return self._average([part.variance + (part.mean - centre).square() for part in self.parts])

    def log_prob(self, value: Tensor) -> Tensor:
        return self.combine([part.log_prob(value) for part in self.parts])

    def combine(self, log_densities: Sequence[Tensor]) -> Tensor:
        """Log densities of the parts to that of the mixture."""
        weighted = [torch.log(w) + log_p for w, log_p in zip(self.weights, log_densities, strict=True)]
        return torch.logsumexp(torch.stack(torch.broadcast_tensors(*weighted)), 0)

    def _average(self, values: Sequence[Tensor]) -> Tensor:
        joint = len(self.event_shape)  # weights of whole vectors have no axis of components
        return torch.stack([w.reshape(w.shape + (1,) * joint) * v for w, v in zip(self.weights, values, strict=True)]).sum(0)


class Late(Distribution):
    """Normal plus an independent exponential of mean `lag`, the exponentially modified Gaussian [Grushka 1972].

    log p(y) = s^2/(2 m^2) - (y - loc)/m - log m + log Phi((y - loc)/s - s/m), with s the normal's deviation and m the lag.
    """

    arg_constraints = {}  # noqa: RUF012
    support = constraints.real

    def __init__(self, loc: Tensor, scale: Tensor, lag: Tensor) -> None:
        self.loc, self.scale, self.lag = torch.broadcast_tensors(loc, scale, lag)
        super().__init__(self.loc.shape, validate_args=False)

    @property
    def mean(self) -> Tensor:
        return self.loc + self.lag

    @property
    def variance(self) -> Tensor:
        return self.scale.square() + self.lag.square()

    def log_prob(self, value: Tensor) -> Tensor:
        z, slope = (value - self.loc) / self.scale, self.scale / self.lag
        return 0.5 * slope.square() - slope * z - torch.log(self.lag) + torch.special.log_ndtr(z - slope)


def normal(loc: Tensor, scale: Tensor) -> Distribution:
    """The nominal family."""
    return Independent(Normal(loc, scale, validate_args=False), 1, validate_args=False)


def student(dof: int) -> Family:
    """Student's t."""
    return lambda loc, scale: Independent(
        StudentT(loc.new_tensor(float(dof)), loc, scale, validate_args=False), 1, validate_args=False
    )


def laplace(loc: Tensor, scale: Tensor) -> Distribution:
    """Laplace of standard deviation `scale`."""
    return Independent(_laplace(loc, scale), 1, validate_args=False)


def contaminated(probability: float, size: float, together: bool, heavy: Family) -> Family:
    """With `probability` the family `heavy` of `size` scales, else normal; of all components at once, or of each for itself."""

    def family(loc: Tensor, scale: Tensor) -> Distribution:
        parts = [normal(loc, scale), heavy(loc, size * scale)]
        weights = loc.new_tensor([1.0 - probability, probability]).unbind()
        if together:
            return Mixture(weights, parts)
        return Independent(Mixture(weights, [part.base_dist for part in parts]), 1, validate_args=False)  # type: ignore[attr-defined]

    return family


def one_sided(probability: Tensor, mean: float) -> Family:
    """With `probability` [Dy] of each component an exponential of `mean` scales on top of the normal."""

    def family(loc: Tensor, scale: Tensor) -> Distribution:
        p = probability.to(loc)
        parts = [Normal(loc, scale, validate_args=False), Late(loc, scale, mean * scale)]
        return Independent(Mixture([1.0 - p, p], parts), 1, validate_args=False)

    return family


def to_laplace(z: Tensor) -> Tensor:
    """Standard normal numbers to Laplace numbers of variance 1, larger to larger: -log of twice the tail is exponential."""
    return torch.sign(z) * -(torch.special.log_ndtr(-z.abs()) + math.log(2.0)) / math.sqrt(2.0)


def _laplace(loc: Tensor, scale: Tensor) -> Laplace:
    return Laplace(loc, scale / math.sqrt(2.0), validate_args=False)
