"""Measurement updates of Gaussian filters for Student's t, Cauchy and mixtures of normal distributions."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import check_whole_number
from pfbench.filter.error_distributions.distribution_parameters import (
    NormalMixtureParameters,
    StudentParameters,
    normal_mixture_moments,
    read_normal_mixture,
    read_student,
)
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.gaussian.measurement_update import MeasurementUpdate, WhitenedPosterior
from pfbench.filter.robust.component_groups import DOWNWEIGHTED
from pfbench.filter.robust.robust_update import finite_weight, updated_residual
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class StudentObservationUpdate(MeasurementUpdate):
    """Update for independent Student's t or Cauchy components of the model, by variational scales.

    y_i = h_i + e_i / sqrt(lambda_i), lambda_i ~ Gamma(nu_i / 2, nu_i / 2). The approximation q(x) q(lambda)
    is optimised in turn [Piche, Sarkka and Hartikainen 2012]. The location h exists for Cauchy components
    too, and is linearised. The belief is too narrow. Normal components have the weight 1. The log evidence is
    that of the last normal approximation.

    Attributes:
        iterations: Number of updates of the scales, equal for all runs.

    Raises:
        ValueError: If iterations is not a whole number from 1. On use, if the observation distribution
            is another one.
    """

    iterations: int = 4
    has_evidence = False

    def __post_init__(self) -> None:
        check_whole_number("StudentObservationUpdate.iterations", self.iterations, 1, "Use 4.")

    @override
    def observe(self, model: StateSpaceModel, distribution: Any) -> tuple[Tensor, Tensor]:
        parameters = self._read(model, distribution)
        return parameters.location, parameters.covariance

    @override
    def read_parameters(self, model: StateSpaceModel, distribution: Any) -> tuple[Tensor, ...]:
        return (self._read(model, distribution).dof[:, 0],)

    @override
    def __call__(self, innovation: Innovation) -> WhitenedPosterior:
        (dof,) = innovation.parameters
        eye = torch.eye(innovation.r.shape[-1]).to(innovation.r)
        variance = innovation.noise.diagonal(dim1=-2, dim2=-1)
        w = torch.ones_like(innovation.r)
        for _ in range(self.iterations):
            residual, covariance = updated_residual(innovation.reweight(w, eye))
            spread = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0)
            squared = (residual.square() + spread) / variance
            w = torch.where(dof.isinf(), 1.0, finite_weight((dof + 1.0) / (dof + squared)))
        weighted = innovation.reweight(w, eye)
        count = ((w < DOWNWEIGHTED) & innovation.observed_mask).sum(-1).to(w)
        return WhitenedPosterior(*kalman_gain_update(weighted), weighted, {"downweighted": count})

    def _read(self, model: StateSpaceModel, distribution: Any) -> StudentParameters:
        parameters = read_student(distribution)
        if parameters is None:
            raise _refusal(model, distribution, "Student's t, Cauchy or normal", type(self))
        return parameters


@dataclass(frozen=True)
class MixtureObservationUpdate(MeasurementUpdate):
    """Update for a mixture of normal distributions of the model, by the moments of the posterior.

    Each part has its own update, and the posterior, a mixture, is replaced by a normal distribution with its
    moments: mean and covariance are exact for a normal prior and a linear h. The mean of the mixture is
    linearised. Offsets of the parts from it, covariances and weights are those at the predicted mean.
    """

    has_evidence = True

    @override
    def observe(self, model: StateSpaceModel, distribution: Any) -> tuple[Tensor, Tensor]:
        mean, _, covariance = normal_mixture_moments(self._read(model, distribution), model)
        return mean, covariance

    @override
    def read_parameters(self, model: StateSpaceModel, distribution: Any) -> tuple[Tensor, ...]:
        parameters = self._read(model, distribution)
        _, offset, _ = normal_mixture_moments(parameters, model)
        values = (parameters.log_weight, offset, parameters.covariance)
        return tuple(value[:, 0] for value in values)

    @override
    def __call__(self, innovation: Innovation) -> WhitenedPosterior:
        log_weight, offset, covariance = innovation.parameters
        runs, parts = log_weight.shape
        observed_mask = innovation.observed_mask.unsqueeze(1)
        pair_mask = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
        eye = torch.eye(offset.shape[-1]).to(offset)
        error = (innovation.omega - innovation.noise).unsqueeze(1)  # of the linearisation
        omega = torch.where(pair_mask, covariance, eye) + error
        r = torch.where(observed_mask, innovation.r.unsqueeze(1) - offset, 0.0)
        branches = innovation._replace(
            r=r.flatten(0, 1),
            omega=omega.flatten(0, 1),
            m=innovation.m.repeat_interleave(parts, 0),
            observed_mask=innovation.observed_mask.repeat_interleave(parts, 0),
        )
        shift, root, log_like = (
            a.unflatten(0, (runs, parts)) for a in kalman_gain_update(branches)
        )
        joint = log_weight + log_like
        evidence = joint.logsumexp(1)
        w = (joint - evidence.unsqueeze(1)).exp()
        mean = (w.unsqueeze(-1) * shift).sum(1)
        rows = torch.cat([root.mT, (shift - mean.unsqueeze(1)).unsqueeze(-2)], -2)
        rows = (w.sqrt()[..., None, None] * rows).flatten(1, 2)
        return WhitenedPosterior(mean, _upper_root(rows), evidence, innovation, {})

    def _read(self, model: StateSpaceModel, distribution: Any) -> NormalMixtureParameters:
        parameters = read_normal_mixture(distribution)
        if parameters is None:
            raise _refusal(model, distribution, "a mixture of normal distributions", type(self))
        return parameters


def _upper_root(rows: Tensor) -> Tensor:
    """Return the upper triangular U with U U' = A' A of rows A [R, n, d]."""
    triangle = torch.linalg.qr(rows.flip(-1), mode="r")[1]
    diagonal = triangle.diagonal(dim1=-2, dim2=-1)
    sign = torch.where(diagonal < 0, -1.0, 1.0).unsqueeze(-1)  # QR leaves it to rounding
    return (sign * triangle).mT.flip((-2, -1))


def _refusal(model: StateSpaceModel, distribution: Any, kinds: str, update: type) -> ValueError:
    """Return the error of a distribution that an update does not support."""
    base = getattr(distribution, "base_dist", distribution)
    return ValueError(
        f"{type(model).__name__}.observation must return {kinds} for {update.__name__}, got "
        f"{type(base).__name__}. Use another filter.measurement_update, or a particle filter, for "
        "example filter=sir."
    )
