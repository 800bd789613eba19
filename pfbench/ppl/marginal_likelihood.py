"""Marginal likelihoods of models: by a filter, or by Pyro's GaussianHMM."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from pyro.distributions import GaussianHMM, MultivariateNormal
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import distribution_covariance
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import Filter
from pfbench.filter.exactness import check_has_evidence
from pfbench.filter.loop import run_filter
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.ppl.model_batch import ModelBatch


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

    Args:
        model: Model, or models of `ModelBatch`.
        record: Measurements; its shape is used.

    Returns:
        Distribution with batch [R].

    Raises:
        ValueError: If the model or the record is not supported, see `GaussianHmmLikelihood`.
    """
    kind = type(model.model if isinstance(model, ModelBatch) else model).__name__
    gain = model.noise_gain(()) if model.linear else None
    singular = model.noise_dim < model.chart.dimension
    has_inputs = bool(record.u) or record.start is not None
    if gain is None or singular or model.observes_initial or has_inputs:
        raise ValueError(
            "GaussianHmmLikelihood needs a linear model with full noise, without inputs, with a "
            f"step before the first measurement, got {kind}. Use "
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
