"""Models as probabilistic programs: priors of unknown parameters and the marginal likelihood.

The marginal likelihood enters a Pyro program as one factor.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeAlias

import pyro
import torch
from pyro.distributions import GaussianHMM, MultivariateNormal, Normal, TorchDistribution
from pyro.distributions.torch_distribution import TorchDistributionMixin
from torch import Tensor
from torch.distributions import Distribution, Independent, biject_to
from typing_extensions import override

from pfbench.core.covariance import distribution_covariance
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record, iterate_steps
from pfbench.core.simulate import draw_initial_state, draw_measurements, draw_values, simulate_steps
from pfbench.filter.belief import Filter
from pfbench.filter.loop import run_filter
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.ppl.model_batch import ModelBatch, list_non_buffers

Values: TypeAlias = dict[str, Tensor]
Law: TypeAlias = Any  # a distribution of pyro.distributions; their stubs share no useful base type


class MarginalLikelihood(Protocol):
    """A function that computes log p(y_1:T) of each run of a record under a model, [R].

    It is differentiable where the model is.
    """

    def __call__(self, model: StateSpaceModel, record: Record) -> Tensor: ...


@dataclass(frozen=True)
class FilterLikelihood:
    """The marginal likelihood computed by a filter, exact or approximate as the filter is.

    Through a Gaussian filter it is differentiable. A particle filter gives an unbiased estimate
    with fixed random numbers. Its gradient is not that of the likelihood: use it in `pmmh`, which
    needs no gradient.

    Attributes:
        method: The filter.
        seed: Seed of its random numbers, the same at every call.
    """

    method: Filter
    seed: int = 0

    def __call__(self, model: StateSpaceModel, record: Record) -> Tensor:
        stream = PhiloxStream(self.seed, torch.arange(len(record.y)))
        return run_filter(self.method, model, record, stream).log_evidence


@dataclass(frozen=True)
class GaussianHmmLikelihood:
    """The marginal likelihood of a linear-Gaussian model by Pyro's GaussianHMM, parallel over time.

    A call raises ValueError for models that are not linear, have singular noise, observe their
    initial state or need inputs, and for records with missing measurements.
    """

    def __call__(self, model: StateSpaceModel, record: Record) -> Tensor:
        return gaussian_hmm(model, record).log_prob(record.y.to(model.anchor))


@dataclass(frozen=True)
class ParameterisedModel:
    """A model with unknown parameters.

    Attributes:
        make: Model constructor with the parameters as keyword arguments, tensors []. A gradient
            reaches them if the constructor keeps them as tensors.
        prior: Distribution of each parameter by name, scalar and from pyro.distributions.

    Raises:
        ValueError: if `prior` is empty, a distribution is not scalar or not from Pyro, or a
            parameter does not change the model.
    """

    make: Callable[..., StateSpaceModel]
    prior: Mapping[str, Law]

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
                    f"prior[{name}] must change the model, but no buffer of {type(first).__name__} "
                    f"depends on it. Check that `make` uses `{name}`."
                )

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the parameters."""
        return tuple(self.prior)

    def model(self, values: Mapping[str, Tensor]) -> StateSpaceModel:
        """Build the model with these parameters, tensors []."""
        return self.make(**{name: values[name].double() for name in self.prior})

    def models_per_run(self, values: Mapping[str, Tensor], each: int = 1) -> StateSpaceModel:
        """Build one model for each parameter value.

        Args:
            values: Parameters by name, [G].
            each: Consecutive runs that share a model.

        Returns:
            Model of G `each` runs.

        Raises:
            ValueError: if the model stores a parameter outside its buffers.
        """
        rows = zip(*(values[name].unbind(0) for name in self.prior), strict=True)
        models = [self.model(dict(zip(self.prior, row, strict=True))) for row in rows]
        return ModelBatch(models, each)

    def sample(self, count: int, seed: int) -> Values:
        """Draw parameters from the prior by counters.

        Args:
            count: Number of values; value i does not depend on it.
            seed: Seed.

        Returns:
            Values by name, [count].

        Raises:
            ValueError: if a prior cannot be drawn, see `draw_values`.
        """
        stream = PhiloxStream(seed, torch.arange(count))
        return {
            name: draw_values(_as_event(distribution), stream, f"prior.{name}", 1)[:, 0, 0].double()
            for name, distribution in self.prior.items()
        }

    def in_support(self, values: Mapping[str, Tensor]) -> Tensor:
        """Return which values are finite and inside their support.

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
        for (name, distribution), part in zip(self.prior.items(), z.unbind(-1), strict=True):
            to_support = biject_to(distribution.support)
            values[name] = to_support(part)
            log_det = to_support.log_abs_det_jacobian(part, values[name])
            log_prior = log_prior + distribution.log_prob(values[name]) + log_det
        return values, log_prior

    def unconstrained(self, values: Mapping[str, Tensor]) -> Tensor:
        """Map parameters to unconstrained numbers [..., P]; the inverse of `constrained`."""
        parts = [biject_to(d.support).inv(values[name]) for name, d in self.prior.items()]
        return torch.stack(parts, -1)


def program(
    unknown: ParameterisedModel, likelihood: MarginalLikelihood, separate_parameters: bool = False
) -> Callable[[Record], Values]:
    """Build a Pyro program of a record: a site per parameter and the factor `evidence`.

    Args:
        unknown: Model and prior.
        likelihood: Marginal likelihood; differentiable for NUTS and SVI.
        apart: If true, each run has its own parameters, in the plate `runs`. Otherwise all runs
            share them.

    Returns:
        Program that takes a record and returns the parameters.
    """

    def sample_shared(record: Record) -> Values:
        values = {name: pyro.sample(name, law) for name, law in unknown.prior.items()}
        log_evidence = torch.tensor(-torch.inf)
        if bool(unknown.in_support(values)):
            log_evidence = likelihood(unknown.model(values), record).sum()
        pyro.factor("evidence", log_evidence)
        return values

    def sample_by_run(record: Record) -> Values:
        with pyro.plate("runs", len(record.y)):
            values = {name: pyro.sample(name, law) for name, law in unknown.prior.items()}
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
        ValueError: if a parameter has the name of a site.
    """
    reserved = {"initial_state", "driving_noise", "path", "seen"} & set(unknown.prior)
    if reserved:
        raise ValueError(
            f"prior must not use the names of path sites, got {sorted(reserved)}. Rename these "
            "parameters."
        )

    def run(record: Record) -> Values:
        values = {name: pyro.sample(name, law) for name, law in unknown.prior.items()}
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


def simulate(model: StateSpaceModel, record: Record, seed: int) -> tuple[Record, Tensor]:
    """Simulate measurements of a model with the runs and inputs of a record.

    With a model drawn from a prior these are draws from the prior predictive distribution. The
    random numbers are those of the scenario `ModelSimulation`; run i does not depend on the number of
    runs.

    Args:
        model: State-space model.
        record: Template: shape, inputs, start, spread and missing components are kept.
        seed: Seed.

    Returns:
        Record with simulated measurements, and the states, [R, T, D].
    """
    stream = PhiloxStream(seed, torch.arange(len(record.y)), model.anchor.dtype)
    own = record.to(model.anchor)
    with torch.no_grad():
        inputs = model.prepare(own).to(model.anchor)
        initial = initial_law(model, len(record.y), own.spread)
        x = draw_initial_state(model, initial, stream, "world.state", start=own.start)
        steps = list(simulate_steps(model, inputs, stream, x, "world.state"))
        y = draw_measurements([s.distribution for s in steps], stream, "world.receiver")
    y = torch.where(torch.isnan(record.y), torch.nan, y.to(record.y))
    return record._replace(y=y), torch.cat([step.x for step in steps], 1)


def gaussian_hmm(model: StateSpaceModel, record: Record) -> GaussianHMM:
    """Build Pyro's GaussianHMM of a linear-Gaussian model over measurements [T, Dy].

    Args:
        model: Model, or models of `ModelBatch`.
        record: Measurements; its shape is used.

    Returns:
        Distribution with batch [R].

    Raises:
        ValueError: if the model or the record is not supported, see `GaussianHmmLikelihood`.
    """
    kind = type(model.model if isinstance(model, ModelBatch) else model).__name__
    gain = model.noise_gain(()) if model.linear else None
    singular = model.noise_dim < model.chart.dimension
    has_inputs = bool(record.u) or record.start is not None
    if gain is None or singular or model.observes_initial or has_inputs:
        raise ValueError(
            "GaussianHmmLikelihood needs a linear model with full noise, without inputs, with a step "
            f"before the first measurement, got {kind}. Use "
            "FilterLikelihood(GaussianFilter(TaylorLinearisation())), which is exact on every "
            "linear model."
        )
    if bool(torch.isnan(record.y).any()):
        raise ValueError(
            "GaussianHmmLikelihood needs complete measurements, got missing components (NaN). "
            "Use FilterLikelihood."
        )
    runs, d = len(record.y), model.chart.dimension
    eye = torch.eye(d, dtype=gain.dtype, device=gain.device).expand(runs, -1, -1)
    initial: Any = initial_law(model, runs)
    start = MultivariateNormal(initial.mean, distribution_covariance(initial))
    zero = torch.zeros_like(eye)
    phi = model.propagate(eye, (), zero)  # transposed: row i is where unit state i goes
    law: Any = model.observation(torch.cat([eye, zero[:, :1]], 1), ())
    y_hat, offset = law.mean[:, :-1], law.mean[:, -1]
    q = (gain @ gain.mT).expand(runs, d, d)
    transition_noise = MultivariateNormal(zero[:, 0].unsqueeze(1), q.unsqueeze(1))
    r = distribution_covariance(law)[:, -1].unsqueeze(1)
    observation_noise = MultivariateNormal(offset.unsqueeze(1), r)
    h = (y_hat - offset.unsqueeze(1)).unsqueeze(1)
    steps = record.y.shape[1]
    return GaussianHMM(
        start, phi.unsqueeze(1), transition_noise, h, observation_noise, duration=steps
    )


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


def _check_prior(name: str, distribution: Law) -> None:
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


def _as_event(distribution: Law) -> Distribution:
    """Return a scalar distribution as one with event [1]."""
    return Independent(distribution.expand(torch.Size((1,))), 1)
