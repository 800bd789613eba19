"""Models with unknown parameters and the prior distributions of these."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch import Tensor
from torch.distributions import Distribution, Independent, biject_to

from pfbench.core.parameter_checks import require_range
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.simulate import draw_values
from pfbench.model.base import StateSpaceModel
from pfbench.ppl.model_batch import ModelBatch, list_non_buffers

Values: TypeAlias = dict[str, Tensor]
Prior: TypeAlias = (
    Any  # a distribution of pyro.distributions; their stubs share no useful base type
)


@dataclass(frozen=True)
class ParameterisedModel:
    """A model with unknown parameters.

    Attributes:
        make: Model constructor with the parameters as keyword arguments, tensors []. A gradient
            reaches them if the constructor keeps them as tensors.
        prior: Distribution of each parameter by name, scalar and from pyro.distributions.

    Raises:
        ValueError: If `prior` is empty, a distribution is not scalar or not from Pyro, or a
            parameter does not change the model.
    """

    make: Callable[..., StateSpaceModel]
    prior: Mapping[str, Prior]

    def __post_init__(self) -> None:
        if not self.prior:
            raise ValueError(
                "prior must have at least one parameter, got none. Name a parameter and its "
                "distribution."
            )
        for name, distribution in self.prior.items():
            _check_prior(name, distribution)
        samples = self.sample(2, 0)
        values = {name: sample[0] for name, sample in samples.items()}
        first = self.model(values)
        for name in self.prior:
            second = self.model({**values, name: samples[name][1]})
            same = all(map(torch.equal, first.buffers(), second.buffers()))
            if same and not list_non_buffers(first, second):
                raise ValueError(
                    f"prior[{name}] must change the model, got a {type(first).__name__} whose buffers "
                    f"do not depend on it. Check that `make` uses `{name}`."
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.prior)

    def model(self, values: Mapping[str, Tensor]) -> StateSpaceModel:
        """Build the model with these parameters, tensors []."""
        return self.make(**{name: values[name].double() for name in self.prior})

    def models_per_run(
        self, values: Mapping[str, Tensor], runs_per_model: int = 1
    ) -> StateSpaceModel:
        """Build one model for each parameter value.

        Args:
            values: Parameters by name, [G].
            runs_per_model: Number of consecutive runs that share a model.

        Returns:
            Model of G `runs_per_model` runs.

        Raises:
            ValueError: If the model stores a parameter outside its buffers.
        """
        rows = zip(*(values[name].unbind(0) for name in self.prior), strict=True)
        models = [self.model(dict(zip(self.prior, row, strict=True))) for row in rows]
        return ModelBatch(models, runs_per_model)

    def sample(self, count: int, seed: int) -> Values:
        """Draw parameters from the prior by counters.

        Args:
            count: Number of values; value i does not depend on it.
            seed: Seed.

        Returns:
            Values by name, [count].

        Raises:
            ValueError: If a prior cannot be drawn, see `draw_values`.
        """
        stream = PhiloxStream(seed, torch.arange(count))
        return {
            name: draw_values(_as_event(distribution), stream, f"prior.{name}", 1)[:, 0, 0].double()
            for name, distribution in self.prior.items()
        }

    def in_support(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return a mask of the values that are finite and inside their support.

        A long step of a sampler can overflow and leave the support.
        """
        valid_masks = [
            torch.isfinite(values[name]) & distribution.support.check(values[name])
            for name, distribution in self.prior.items()
        ]
        return torch.stack(valid_masks).all(0)

    def constrained(self, z: Tensor) -> tuple[Values, Tensor]:
        """Map unconstrained numbers to parameters.

        Args:
            z: Real numbers, [..., P].

        Returns:
            Parameters by name, [...], and log prior density of z, [...].
        """
        values, log_prior = {}, torch.zeros_like(z[..., 0])
        for (name, distribution), column in zip(self.prior.items(), z.unbind(-1), strict=True):
            to_support = biject_to(distribution.support)
            values[name] = to_support(column)
            log_det = to_support.log_abs_det_jacobian(column, values[name])
            log_prior = log_prior + distribution.log_prob(values[name]) + log_det
        return values, log_prior

    def unconstrained(self, values: Mapping[str, Tensor]) -> Tensor:
        """Map parameters to unconstrained numbers [..., P]; the inverse of `constrained`."""
        columns = [biject_to(d.support).inv(values[name]) for name, d in self.prior.items()]
        return torch.stack(columns, -1)


def _check_prior(name: str, distribution: Prior) -> None:
    """Raise ValueError if a prior is not a scalar distribution of Pyro."""
    if not isinstance(distribution, TorchDistributionMixin):
        raise ValueError(
            f"prior[{name}] must be a distribution of pyro.distributions, got {distribution}. "
            "Import the distribution of that name from pyro.distributions."
        )
    if distribution.batch_shape or distribution.event_shape:
        shape = tuple(distribution.batch_shape + distribution.event_shape)
        raise ValueError(
            f"prior[{name}] must be a scalar distribution, got shape {shape}. Give several "
            "parameters several names."
        )


def _as_event(distribution: Prior) -> Distribution:
    """Return a scalar distribution as one with event [1]."""
    return Independent(distribution.expand(torch.Size((1,))), 1)


# --------------------------------------------------------------------------------------------------
# Checks of the arguments of inference algorithms.


def check_counts(algorithm: str, counts: Mapping[str, tuple[Any, int]]) -> None:
    """Check whole numbers."""
    for name, (value, least) in counts.items():
        require_range(f"{algorithm}.{name}", value, f"whole [{least}, inf)")


def check_kinds(algorithm: str, values: Mapping[str, tuple[Any, Any]]) -> None:
    """Check the classes of arguments."""
    for name, (value, kind) in values.items():
        is_class = isinstance(value, type) and kind is not Callable
        if is_class or not isinstance(value, kind):
            class_name = (value if isinstance(value, type) else type(value)).__name__
            raise ValueError(
                f"{algorithm}.{name} must be a {kind.__name__}, got {class_name}. "
                f"Pass an instance of {kind.__name__}."
            )
