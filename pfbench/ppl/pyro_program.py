"""Pyro programs of models with unknown parameters.

The marginal likelihood enters a program as one factor, or the program samples the path of the
states.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pyro
import torch
from pyro.distributions import Normal, TorchDistribution
from torch import Tensor
from torch.distributions import Distribution, Independent
from typing_extensions import override

from pfbench.core.record import Record, iterate_steps
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.ppl.marginal_likelihood import MarginalLikelihood
from pfbench.ppl.parameterised_model import ParameterisedModel, Values


def program(
    unknown: ParameterisedModel, likelihood: MarginalLikelihood, separate_parameters: bool = False
) -> Callable[[Record], Values]:
    """Build a Pyro program with a site per parameter and the factor `evidence`.

    Args:
        unknown: Model and prior.
        likelihood: Marginal likelihood; differentiable for NUTS and SVI.
        separate_parameters: Whether each run has its own parameters, in the plate `runs`.
            Otherwise all runs share them.

    Returns:
        Program that takes a record and returns the parameters.
    """

    def sample_shared(record: Record) -> Values:
        values = _sample_prior(unknown)
        log_evidence = torch.tensor(-torch.inf)
        if bool(unknown.in_support(values)):
            log_evidence = likelihood(unknown.model(values), record).sum()
        pyro.factor("evidence", log_evidence)
        return values

    def sample_by_run(record: Record) -> Values:
        with pyro.plate("runs", len(record.y)):
            values = _sample_prior(unknown)
            pyro.factor("evidence", likelihood(unknown.models_per_run(values), record))
        return values

    return sample_by_run if separate_parameters else sample_shared


def latent_program(unknown: ParameterisedModel) -> Callable[[Record], Values]:
    """Build a Pyro program that samples the path of the states as well.

    It uses no filter and no approximation, but has R (d + T W) more dimensions: use it for short
    records. The sites are `initial_state` [R, d] and `driving_noise` [R, T, W]. They are standard
    normal where the model's distribution is normal, and have the model's distribution otherwise.
    The deterministic site `path` [R, T, D] holds the states. The noise has a density even where
    the transition is singular.

    Args:
        unknown: Model and prior.

    Returns:
        Program that takes a record and returns the parameters.

    Raises:
        ValueError: If a parameter has the name of a site.
    """
    reserved = {"initial_state", "driving_noise", "path", "seen"} & set(unknown.prior)
    if reserved:
        raise ValueError(
            f"prior must not use the names of path sites, got {sorted(reserved)}. Rename these "
            "parameters."
        )

    def run(record: Record) -> Values:
        values = _sample_prior(unknown)
        model = unknown.model(values)
        runs, steps = record.y.shape[:2]
        initial = initial_law(model, runs, record.to(model.anchor).spread)
        shift = _sample_site("initial_state", initial, (runs,))
        w = _sample_site("driving_noise", model.noise, (runs, steps))
        states, log_like = compute_path(model, record, shift, w)
        pyro.deterministic("path", states)
        pyro.factor("seen", log_like.sum())
        return values

    return run


def compute_path(
    model: StateSpaceModel, record: Record, shift: Tensor, w: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute states and log likelihoods from initial state and noise.

    Args:
        model: State-space model.
        record: Measurements and inputs.
        shift: Initial states in the chart about the start, [R, d].
        w: Driving noise, [R, T, W].

    Returns:
        States, [R, T, D], and log p(y_t | x_t), [R, T].
    """
    record = record.to(model.anchor)
    inputs = model.prepare(record).to(model.anchor)
    origin = model.origin.expand(len(shift), -1) if record.start is None else record.start
    x, path, log_like = model.chart.add(origin, shift).unsqueeze(1), [], []
    for t, step_model, step in iterate_steps(model, inputs):
        x = step_model.propagate(x, step.u, w[:, t].unsqueeze(1))
        path.append(x[:, 0])
        log_like.append(model.log_likelihood(step.y, x, step.u)[:, 0])
    return torch.stack(path, 1), torch.stack(log_like, 1)


class _PyroDistribution(TorchDistribution):
    """A torch distribution as a Pyro site of batch shape []."""

    def __init__(self, inner: Distribution) -> None:
        self.inner = inner
        self.has_rsample = inner.has_rsample
        super().__init__(torch.Size(), inner.batch_shape + inner.event_shape, validate_args=False)

    @property
    @override
    def support(self) -> Any:
        return self.inner.support

    @override
    def sample(self, sample_shape: Any = torch.Size()) -> Tensor:  # noqa: B008
        return self.inner.sample(sample_shape)

    @override
    def rsample(self, sample_shape: Any = torch.Size()) -> Tensor:  # noqa: B008
        return self.inner.rsample(sample_shape)

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        return self.inner.log_prob(value).sum()


def _sample_prior(unknown: ParameterisedModel) -> Values:
    """Sample a site for each parameter."""
    return {name: pyro.sample(name, prior) for name, prior in unknown.prior.items()}


def _sample_site(name: str, distribution: Any, shape: tuple[int, ...]) -> Tensor:
    """Sample a site [*shape, k]; normal distributions scale a standard normal site."""
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    size = [*shape, distribution.event_shape[0]]
    if not isinstance(base, torch.distributions.Normal | torch.distributions.MultivariateNormal):
        return pyro.sample(name, _PyroDistribution(distribution.expand(torch.Size(shape))))
    standard = Normal(base.loc.new_zeros(()), 1.0).expand(size).to_event(len(size))
    z: Tensor = pyro.sample(name, standard)
    if isinstance(base, torch.distributions.Normal):
        return base.loc + base.scale * z
    return base.loc + (base.scale_tril @ z.unsqueeze(-1)).squeeze(-1)
