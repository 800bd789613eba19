"""Models with unknown parameters and the prior distributions of these."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from torch import Tensor
from torch.distributions import Independent, biject_to

from pfbench.core.parameter_checks import require, require_range
from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.simulate import draw_values
from pfbench.model.base import StateSpaceModel
from pfbench.ppl.model_batch import ModelBatch, list_differences
from pfbench.ppl.priors import as_prior

Values: TypeAlias = dict[str, Tensor]
Prior: TypeAlias = Any  # a distribution of torch or Pyro; their stubs share no useful base type


@dataclass(frozen=True)
class ParameterisedModel:
    """A model with unknown parameters.

    Attributes:
        make: Model constructor with the parameters as keyword arguments, tensors []. A gradient
            reaches them if the constructor keeps them as tensors.
        prior: Distribution of each parameter by name, scalar, of torch or Pyro. Values that the
            constructor refuses with a ValueError are impossible, their density is 0.

    Raises:
        ValueError: If `prior` is empty, a distribution is not scalar, the model refuses all draws,
            or a parameter does not change the model.
    """

    make: Callable[..., StateSpaceModel]
    prior: Mapping[str, Prior]

    def __post_init__(self) -> None:
        remedy = "Name a parameter and its distribution."
        require(self.prior, "prior", "have at least one parameter", "none", remedy)
        priors = {name: as_prior(name, prior) for name, prior in self.prior.items()}
        object.__setattr__(self, "prior", priors)
        values, others = self._rows(self.sample(2, 0))
        first = self.model(values)
        for name in self.prior:
            second = self.find_model({**values, name: others[name]})
            require(
                second is None or list_differences(first, second),
                f"prior[{name}]",
                "change the model",
                f"a {type(first).__name__} whose buffers do not depend on it",
                f"Check that `make` uses `{name}`.",
            )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.prior)

    def model(self, values: Mapping[str, Tensor]) -> StateSpaceModel:
        """Build the model with these parameters, tensors []."""
        return self.make(**{name: values[name].double() for name in self.prior})

    def find_model(self, values: Mapping[str, Tensor]) -> StateSpaceModel | None:
        """Build the model with these parameters, tensors [], or return None where they are impossible.

        Parameters are impossible outside the support of their prior, and where the constructor
        refuses them with a ValueError. Their density is 0.
        """
        if not all(
            d.support.check(values[k]) & values[k].isfinite() for k, d in self.prior.items()
        ):
            return None
        try:
            return self.model(values)
        except ValueError:
            return None

    def some_model(self) -> StateSpaceModel:
        """Build the model with a draw of the prior."""
        return self.model({name: value[0] for name, value in self.sample(1, 0).items()})

    def models_per_run(
        self, values: Mapping[str, Tensor], runs_per_model: int = 1
    ) -> tuple[StateSpaceModel, Tensor]:
        """Build one model for each parameter value.

        Args:
            values: Parameters by name, [G].
            runs_per_model: Number of consecutive runs that share a model.

        Returns:
            Model of G `runs_per_model` runs, the model itself of one value, and a mask of the values that are possible, [G].
            The runs of the others have any model.
        """
        models = [self.find_model(row) for row in self._rows(values)]
        is_possible = torch.tensor([model is not None for model in models])
        spare = next(filter(None, models), None) or self.some_model()
        possible = [model or spare for model in models]
        return possible[0] if len(possible) == 1 else ModelBatch(
            possible, runs_per_model
        ), is_possible

    def models_at(self, z: Tensor, runs_per_model: int) -> tuple[StateSpaceModel, Tensor]:
        """Build one model for each point of unconstrained parameters, as `models_per_run` does.

        Args:
            z: Points, [G, P].
            runs_per_model: Number of consecutive runs that share a model.

        Returns:
            Model, and the log prior density of the points [G], -inf where a model is impossible.
        """
        values, log_prior = self.constrained(z)
        model, is_possible = self.models_per_run(values, runs_per_model)
        is_valid = is_possible & torch.isfinite(log_prior)
        return model, torch.where(is_valid, log_prior, -torch.inf)

    def draw(self, count: int, seed: int, attempt: int = 0) -> Values:
        """Draw parameters from the prior by counters, whether the model accepts them or not.

        Args:
            count: Number of values; value i does not depend on it.
            seed: Seed.
            attempt: Number of the draw of each value.

        Returns:
            Values by name, [count].

        Raises:
            ValueError: If a prior cannot be drawn, see `draw_values`.
        """
        stream, use = PhiloxStream(seed, torch.arange(count)), f"prior{attempt or ''}"
        return {
            name: draw_prior(distribution, stream, f"{use}.{name}", 1)[:, 0]
            for name, distribution in self.prior.items()
        }

    def sample(self, count: int, seed: int) -> Values:
        """Draw parameters from the prior that the model accepts, as `draw` does.

        Args:
            count: Number of values; value i does not depend on it.
            seed: Seed.

        Returns:
            Values by name, [count].

        Raises:
            ValueError: If the model refuses a hundred draws of a value; that of the last one.
        """
        values = self.draw(count, seed)
        for attempt in range(1, 100):
            refused = torch.tensor([self.find_model(row) is None for row in self._rows(values)])
            if not bool(refused.any()):
                return values
            again = self.draw(count, seed, attempt)
            values = {name: torch.where(refused, again[name], a) for name, a in values.items()}
        self.model(next(self._rows({name: a[refused] for name, a in values.items()})))  # raises
        return values

    def _rows(self, values: Mapping[str, Tensor]) -> Iterator[Values]:
        """Yield the parameters of each value."""
        for row in zip(*(values[name].unbind(0) for name in self.prior), strict=True):
            yield dict(zip(self.prior, row, strict=True))

    def constrained(self, z: Tensor) -> tuple[Values, Tensor]:
        """Map unconstrained numbers to parameters.

        Args:
            z: Real numbers, [..., P].

        Returns:
            Parameters by name, [...], and log prior density of z, [...].
        """
        return constrain(self.prior, z)

    def unconstrained(self, values: Mapping[str, Tensor]) -> Tensor:
        """Map parameters to unconstrained numbers [..., P]; the inverse of `constrained`."""
        return unconstrain(self.prior, values)


def constrain(prior: Mapping[str, Prior], z: Tensor) -> tuple[Values, Tensor]:
    """Map unconstrained numbers [..., P] to values of a prior by name, and return the log prior density of z, [...]."""
    values, log_prior = {}, torch.zeros_like(z[..., 0])
    for (name, distribution), column in zip(prior.items(), z.unbind(-1), strict=True):
        to_support = biject_to(distribution.support)
        values[name] = to_support(column)
        log_det = to_support.log_abs_det_jacobian(column, values[name])
        log_prior = log_prior + distribution.log_prob(values[name]) + log_det
    return values, log_prior


def unconstrain(prior: Mapping[str, Prior], values: Mapping[str, Tensor]) -> Tensor:
    """Map values of a prior by name to unconstrained numbers [..., P]; the inverse of `constrain`."""
    return torch.stack([biject_to(d.support).inv(values[name]) for name, d in prior.items()], -1)


def draw_prior(distribution: Prior, stream: RandomStream, use: str, n: int) -> Tensor:
    """Draw n values of a scalar distribution for each run of a stream, [R, n]."""
    event = Independent(distribution.expand(torch.Size((1,))), 1)
    return draw_values(event, stream, use, n)[..., 0].double()


# --------------------------------------------------------------------------------------------------
# Checks of the arguments of inference algorithms.


def check_inference_call(algorithm: str, **arguments: tuple[Any, Any]) -> None:
    """Check arguments of an algorithm, each a pair: a whole number and its least value, or an object and its class."""
    for name, (value, allowed) in arguments.items():
        key = f"{algorithm}.{name}"
        if isinstance(allowed, int):
            require_range(key, value, f"whole [{allowed}, inf)")
            continue
        is_class = isinstance(value, type)
        got, kind = (value if is_class else type(value)).__name__, allowed.__name__
        ok = isinstance(value, allowed) and (allowed is Callable or not is_class)
        require(ok, key, f"be a {kind}", got, f"Pass an instance of {kind}.")
