"""Pyro programs of models with unknown parameters.

The marginal likelihood enters a program as one factor, or the program samples the path of the
states.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pyro
import torch
from pyro.distributions import Normal
from torch import Tensor
from torch.distributions import Independent

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record, iterate_steps
from pfbench.core.simulate import draw_initial_state, draw_measurements, simulate_steps
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.ppl.likelihood import MarginalLikelihood
from pfbench.ppl.parameterised_model import ParameterisedModel, Values, check_inference_call
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
