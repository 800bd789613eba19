"""Pyro programs of models with unknown parameters.

The marginal likelihood enters a program as one factor, or the program samples the path of the
states.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import pyro
import torch
from pyro.distributions import DiscreteHMM, Normal, Unit
from torch import Tensor
from torch.distributions import Independent

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record, iterate_steps
from pfbench.core.simulate import draw_initial_state, draw_measurements, simulate_steps
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.ppl.likelihood import MarginalLikelihood
from pfbench.ppl.parameterised_model import ParameterisedModel, Prior, Values, check_inference_call
from pfbench.ppl.priors import as_pyro
from pfbench.ppl.step_program import value_at


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
        model, log_evidence = unknown.find_model(values), torch.tensor(-torch.inf)
        if model is not None:
            log_evidence = likelihood(model, record).sum()
        pyro.factor("evidence", log_evidence)
        return values

    def sample_by_run(record: Record) -> Values:
        with pyro.plate("runs", len(record.y)):
            values = _sample_prior(unknown)
            model, is_possible = unknown.models_per_run(values)
            log_evidence = likelihood(model, record)
            pyro.factor("evidence", torch.where(is_possible, log_evidence, -torch.inf))
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
    require(
        not reserved,
        "prior",
        "not use the names of path sites",
        sorted(reserved),
        "Rename these parameters.",
    )

    def run(record: Record) -> Values:
        values = _sample_prior(unknown)
        possible = unknown.find_model(values)
        model = unknown.some_model() if possible is None else possible
        runs, steps = record.y.shape[:2]
        initial = initial_law(model, runs, record.to(model.anchor).spread)
        shift = _sample_site("initial_state", initial, (runs,))
        w = _sample_site("driving_noise", model.noise, (runs, steps))
        states, log_like = compute_path(model, record, shift, w)
        pyro.deterministic("path", states)
        pyro.factor("seen", torch.tensor(-torch.inf) if possible is None else log_like.sum())
        return values

    return run


def compute_path(
    model: StateSpaceModel, record: Record, shift: Tensor, w: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute states and log likelihoods from initial state and noise.

    Returns states, [R, T, D], and log p(y_t | x_t), [R, T]. Shapes: shift [R, d], w [R, T, W].
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


def _sample_prior(unknown: ParameterisedModel) -> Values:
    """Sample a site for each parameter."""
    return {name: pyro.sample(name, prior) for name, prior in unknown.prior.items()}


def _sample_site(name: str, distribution: Any, shape: tuple[int, ...]) -> Tensor:
    """Sample a site [*shape, k]; normal distributions scale a standard normal site."""
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    if isinstance(base, torch.distributions.Normal | torch.distributions.MultivariateNormal):
        standard = Normal(base.loc.new_zeros(*shape, *distribution.event_shape), 1.0)
        z: Tensor = pyro.sample(name, standard.to_event(len(shape) + 1))
        return value_at(name, distribution, z)
    value: Tensor = pyro.sample(name, as_pyro(distribution).expand(shape).to_event(len(shape)))
    return value


# --------------------------------------------------------------------------------------------------
# Simulation of measurements from a model, for prior predictive draws.


def simulate(model: StateSpaceModel, record: Record, seed: int) -> tuple[Record, Tensor]:
    """Simulate measurements of a model with the runs and inputs of a record.

    With a model whose parameters come from the prior these are draws from the prior predictive
    distribution. The random numbers are those of the scenario `ModelSimulation`. Run i does not
    depend on the number of runs.

    Args:
        model: State-space model.
        record: Template: shape, inputs, start, spread and missing components are kept.
        seed: Seed.

    Returns:
        Record with simulated measurements, and the states, [R, T, D].

    Raises:
        ValueError: If an argument is of another class, or the seed is negative.
    """
    check_inference_call("simulate", model=(model, StateSpaceModel), record=(record, Record), seed=(seed, 0))  # fmt: skip
    stream = PhiloxStream(seed, torch.arange(len(record.y)), model.anchor.dtype)
    converted = record.to(model.anchor)
    with torch.no_grad():
        inputs = model.prepare(converted).to(model.anchor)
        initial = initial_law(model, len(record.y), converted.spread)
        x = draw_initial_state(model, initial, stream, "world.state", start=converted.start)
        steps = list(simulate_steps(model, inputs, stream, x, "world.state"))
        y = draw_measurements([s.distribution for s in steps], stream, "world.receiver")
    y = torch.where(torch.isnan(record.y), torch.nan, y.to(record.y))
    return record._replace(y=y), torch.cat([step.x for step in steps], 1)


# --------------------------------------------------------------------------------------------------
# Noise levels that switch by a Markov chain, by Pyro's DiscreteHMM.


@dataclass(frozen=True)
class SwitchingNoise:
    """Independent normal errors of two sizes, switched by a Markov chain.

    It fits errors that are independent from step to step given the regime: errors of a sensor at
    rest or against a reference, or innovations of a filter. The sum over the chain is exact, so
    the program is differentiable.

    Attributes:
        sd: Distribution of the nominal standard deviation.
        ratio: Distribution of the ratio of the surge's standard deviation to the nominal one.
            Values must exceed 1, or the regimes could exchange their meaning.
        stay: Distribution of the probability to stay in the nominal regime.
        surge_stay: Distribution of the probability to stay in the surge.
    """

    sd: Prior
    ratio: Prior
    stay: Prior
    surge_stay: Prior

    @property
    def prior(self) -> dict[str, Prior]:
        """Distributions of the parameters by name."""
        return dict(vars(self))

    def program(self) -> Callable[[Record], Values]:
        """Build a Pyro program of a record whose y [R, T, Dy] are the errors.

        NaN marks a missing error. A regime applies to all Dy components.
        """

        def run(record: Record) -> Values:
            values = {name: pyro.sample(name, prior) for name, prior in self.prior.items()}
            pyro.factor("evidence", self.chain(values, emission_distribution(record, values)).sum())
            return values

        return run

    def chain(self, values: Values, table: Tensor) -> Tensor:
        """Compute log p(y_1:T).

        Args:
            values: Parameters, [].
            table: Log densities of each step under each regime, [R, T, 2].

        Returns:
            Log evidence, [R].
        """
        stay, surge_stay = values["stay"].double(), values["surge_stay"].double()
        rows = [torch.stack([stay, 1.0 - stay]), torch.stack([1.0 - surge_stay, surge_stay])]
        log_transition = torch.stack(rows).log()
        to_surge, to_nominal = 1.0 - stay, 1.0 - surge_stay
        log_total = (to_surge + to_nominal).log()
        log_initial = torch.stack([to_nominal, to_surge]).log() - log_total  # stationary
        observation = Unit(table, validate_args=False)
        hmm = DiscreteHMM(log_initial, log_transition, observation, duration=table.shape[1])
        log_evidence: Tensor = hmm.log_prob(table.new_empty(*table.shape[:2], 0))
        return log_evidence

    def probability(self, record: Record, values: Values) -> Tensor:
        """Compute the probability of the surge at each step, given the whole record.

        It is the derivative of log p(y_1:T) by the log density of that step under that regime.

        Args:
            record: Errors, y [R, T, Dy].
            values: Parameters, [].

        Returns:
            Probabilities, [R, T].
        """
        with torch.enable_grad():
            table = emission_distribution(record, values).detach().requires_grad_()
            (gradient,) = torch.autograd.grad(self.chain(values, table).sum(), table)
        return gradient[..., 1].detach()


def emission_distribution(record: Record, values: Values) -> Tensor:
    """Compute log densities of the errors under each regime.

    Returns log densities, [R, T, 2]; 0 where all components are missing. Shapes: record [R, T, Dy].
    """
    observed_mask = ~torch.isnan(record.y)
    ratios = torch.stack([torch.ones_like(values["ratio"]), values["ratio"]])
    sds = values["sd"].double() * ratios.double()
    y = torch.where(observed_mask, record.y, 0.0).unsqueeze(-1)
    return (Normal(0.0, sds).log_prob(y) * observed_mask.unsqueeze(-1)).sum(2)
