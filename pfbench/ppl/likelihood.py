"""Marginal likelihoods and posterior densities of parameters by a filter."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from pyro.distributions import GaussianHMM, MultivariateNormal
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import distribution_covariance
from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream, relabel
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import Filter
from pfbench.filter.exactness import check_has_evidence
from pfbench.filter.loop import FilterPass, prepare_record, run_filter
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.ppl.model_batch import ModelBatch
from pfbench.ppl.parameterised_model import ParameterisedModel


class MarginalLikelihood(Protocol):
    """A function that computes log p(y_1:T) of each run of a record under a model.

    It is differentiable where the model is.
    """

    def __call__(self, model: StateSpaceModel, record: Record) -> Tensor:
        """Compute the log evidence.

        Args:
            model: State-space model.
            record: Measurements and inputs of R runs.

        Returns:
            Log evidence, [R].
        """


@dataclass(frozen=True)
class FilterLikelihood(MarginalLikelihood):
    """Marginal likelihood computed by a filter, exact if the filter is.

    Through a Gaussian filter it is differentiable. A particle filter gives an unbiased estimate
    with fixed random numbers. Its gradient is not that of the likelihood: use it in `pmmh`, which
    needs no gradient.

    Attributes:
        method: The filter.
        seed: Seed of its random numbers, the same at every call.

    Raises:
        ValueError: If the evidence of the filter is not a density, as with a robust update.
    """

    method: Filter
    seed: int = 0

    def __post_init__(self) -> None:
        check_has_evidence(self.method, "FilterLikelihood")

    @override
    def __call__(self, model: StateSpaceModel, record: Record) -> Tensor:
        stream = PhiloxStream(self.seed, torch.arange(len(record.y)))
        return run_filter(self.method, model, record, stream).log_evidence


@dataclass(frozen=True)
class GaussianHmmLikelihood(MarginalLikelihood):
    """Marginal likelihood of a linear-Gaussian model by Pyro's GaussianHMM.

    A call raises ValueError for models that are not linear, have singular noise, observe their
    initial state or need inputs, and for records with missing measurements.
    """

    @override
    def __call__(self, model: StateSpaceModel, record: Record) -> Tensor:
        return gaussian_hmm(model, record).log_prob(record.y.to(model.anchor))


def gaussian_hmm(model: StateSpaceModel, record: Record) -> GaussianHMM:
    """Build Pyro's GaussianHMM of a linear-Gaussian model over measurements [T, Dy].

    Returns distribution with batch [R].
    """
    kind = type(model.model if isinstance(model, ModelBatch) else model).__name__
    gain = model.noise_gain(()) if model.linear else None
    is_regular = gain is not None and model.noise_dim >= model.chart.dimension
    has_inputs = bool(record.u) or record.start is not None
    ok = is_regular and not (model.observes_initial or has_inputs)
    must = "have a linear model with full noise, without inputs, with a step before the first measurement"
    require(ok, "GaussianHmmLikelihood", must, kind, "Use FilterLikelihood(GaussianFilter(TaylorLinearisation())), which is exact on every linear model.")  # fmt: skip
    is_complete = not bool(torch.isnan(record.y).any())
    require(is_complete, "GaussianHmmLikelihood", "have complete measurements", "missing components (NaN)", "Use FilterLikelihood.")  # fmt: skip
    assert gain is not None
    runs, d = len(record.y), model.chart.dimension
    eye = torch.eye(d, dtype=gain.dtype, device=gain.device).expand(runs, -1, -1)
    initial: Any = initial_law(model, runs)
    start = MultivariateNormal(initial.mean, distribution_covariance(initial))
    zero = torch.zeros_like(eye)
    phi = model.propagate(eye, (), zero)  # transposed: row i is the image of unit state i
    observation: Any = model.observation(torch.cat([eye, zero[:, :1]], 1), ())
    y_hat, offset = observation.mean[:, :-1], observation.mean[:, -1]
    q = (gain @ gain.mT).expand(runs, d, d)
    transition_noise = MultivariateNormal(zero[:, 0].unsqueeze(1), q.unsqueeze(1))
    r = distribution_covariance(observation)[:, -1].unsqueeze(1)
    observation_noise = MultivariateNormal(offset.unsqueeze(1), r)
    h = (y_hat - offset.unsqueeze(1)).unsqueeze(1)
    steps = record.y.shape[1]
    return GaussianHMM(
        start, phi.unsqueeze(1), transition_noise, h, observation_noise, duration=steps
    )


_BATCH = 200  # values of the parameters in a batch


def evaluate_fixes(
    unknown: ParameterisedModel, method: Filter, record: Record, values: Mapping[str, Tensor]
) -> Tensor:
    """Compute the log density of each measurement given those before it, for values [S] of the parameters.

    Returns log densities, [S, F] for the F steps of all runs that have a measurement, run after run.
    """
    runs, is_fix = len(record.y), (~torch.isnan(record.y)).any(-1).flatten()
    rows = []
    for some in zip(*(a.split(_BATCH) for a in values.values()), strict=True):
        size = len(some[0])
        model, _ = unknown.models_per_run(dict(zip(values, some, strict=True)), runs)
        prepared = prepare_record(model, repeat_runs(record, size))
        filters = FilterPass(method, model, prepared, PhiloxStream(0, torch.arange(size * runs)))
        totals = [filters.belief.log_evidence, *(filters.belief.log_evidence for _ in filters)]
        rows.append(torch.stack(totals, 1).diff(dim=1).view(size, -1)[:, is_fix])
    return torch.cat(rows)


# --------------------------------------------------------------------------------------------------
# Estimates of the posterior density of parameters by a filter.

_START_ATTEMPTS = 20


class PosteriorEstimator:
    """Estimator of log p(z) + log p(y | z) for chains z [C, Q, P].

    Q is the number of runs R if they have separate parameters, otherwise 1.
    """

    def __init__(
        self,
        unknown: ParameterisedModel,
        method: Filter,
        record: Record,
        chains: int,
        seed: int,
        separate_parameters: bool,
    ) -> None:
        check_has_evidence(method, "pmmh")
        self.unknown, self.method = unknown, method
        self.seed, self.separate_parameters = seed, separate_parameters
        runs = len(record.y)
        self.shape = (chains, runs if separate_parameters else 1)
        self.runs_per_model = 1 if separate_parameters else runs
        self.record = repeat_runs(record, chains)

    def __call__(self, z: Tensor, iteration: int) -> Tensor:
        """Estimate the log density with the random numbers of an iteration.

        Returns log density [C, Q]. Shapes: z [C, Q, P].
        """
        model, log_prior = self.unknown.models_at(z.flatten(0, 1), self.runs_per_model)
        runs = torch.arange(len(log_prior) * self.runs_per_model)
        stream: Any = relabel(PhiloxStream(self.seed, runs), f"pmmh_{iteration}.")
        log_z = run_filter(self.method, model, self.record, stream).log_evidence
        total = log_prior + log_z.view(-1, self.runs_per_model).sum(1)
        return torch.where(torch.isfinite(total), total, -torch.inf).view(self.shape)

    def draw_start(self, start: ParameterisedModel) -> tuple[Tensor, Tensor]:
        """Draw the starts of the chains, repeated while the filter is lost.

        Returns unconstrained parameters [C, Q, P], and their log densities, [C, Q].
        """
        log_p = torch.full(self.shape, -torch.inf, dtype=torch.float64)
        z = torch.zeros(*self.shape, len(start.prior), dtype=torch.float64)
        for attempt in range(_START_ATTEMPTS):
            is_lost = ~torch.isfinite(log_p)
            if not bool(is_lost.any()):
                break
            values = start.draw(is_lost.numel(), self.seed + 7919 * (attempt + 1))
            z = torch.where(is_lost.unsqueeze(-1), self.unknown.unconstrained(values).view_as(z), z)
            log_p = torch.where(is_lost, self(z, -attempt - 1), log_p)
        lost = int((~torch.isfinite(log_p)).sum())
        require(not lost, "pmmh", "have a start at which the filter is not lost", f"{lost} chains lost at {_START_ATTEMPTS} draws", "Narrow the prior, or use more particles.")  # fmt: skip
        return z, log_p


def repeat_runs(record: Record, copies: int) -> Record:
    """Repeat all runs of a record.

    Args:
        record: Record of R runs.
        copies: Number of repetitions.

    Returns:
        Record of R `copies` runs, all runs in turn.
    """

    def repeat(a: Tensor) -> Tensor:
        return a.repeat(copies, *[1] * (a.dim() - 1))

    start, spread = (None if a is None else repeat(a) for a in (record.start, record.spread))
    u = map_inputs(lambda a: a if len(a) == 1 else repeat(a), record.u)
    return Record(repeat(record.y), u, start, spread, record.feedback)
