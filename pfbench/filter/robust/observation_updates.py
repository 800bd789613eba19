"""Measurement updates of Gaussian filters for Student's t, Cauchy and mixtures of normal distributions."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.distributions import (
    Cauchy,
    Distribution,
    Independent,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    StudentT,
)
from typing_extensions import override

from pfbench.core.linear_algebra import distribution_covariance
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.kalman_update import (
    MeasurementUpdate,
    WhitenedPosterior,
    kalman_gain_update,
)
from pfbench.filter.robust.robust_update import DOWNWEIGHTED, finite_weight, updated_residual
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
        require_ranges("StudentObservationUpdate", self, iterations="whole [1, inf) Use 4.")

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


MOST_PARTS = 256


class StudentParameters(NamedTuple):
    """Independent Student's t, y_i = location_i + e_i / sqrt(lambda_i).

    Attributes:
        location: [..., k].
        covariance: Covariance of e, the squared scales, [..., k, k].
        dof: Degrees of freedom nu of lambda ~ Gamma(nu / 2, nu / 2), [..., k]; infinite for normal
            errors.
    """

    location: Tensor
    covariance: Tensor
    dof: Tensor


class NormalMixtureParameters(NamedTuple):
    """A mixture of J normal distributions.

    Attributes:
        log_weight: [..., J].
        location: [..., J, k].
        covariance: [..., J, k, k].
    """

    log_weight: Tensor
    location: Tensor
    covariance: Tensor


def read_student(distribution: Any) -> StudentParameters | None:
    """Return the parameters of independent Student's t, Cauchy or normal components, else None."""
    if _is_normal(distribution):
        location = distribution.mean
        dof = torch.full_like(location, torch.inf)
        return StudentParameters(location, distribution_covariance(distribution), dof)
    base = distribution.base_dist if isinstance(distribution, Independent) else None
    if not isinstance(base, StudentT | Cauchy):
        return None
    dof = base.df if isinstance(base, StudentT) else torch.ones_like(base.loc)
    return StudentParameters(base.loc, torch.diag_embed(base.scale.square()), dof)


def read_normal_mixture(distribution: Any) -> NormalMixtureParameters | None:
    """Return the parameters of a mixture of normal distributions, else None."""
    if _is_normal(distribution):
        location = distribution.mean
        covariance = distribution_covariance(distribution).unsqueeze(-3)
        zero = torch.zeros_like(location[..., :1])
        return NormalMixtureParameters(zero, location.unsqueeze(-2), covariance)
    if isinstance(distribution, Independent):
        return _combine_components(distribution)
    values = [(log_w, read_normal_mixture(item)) for log_w, item in _list_parts(distribution)]
    if not values or any(value is None for _, value in values):
        return None
    lists = [(log_w.unsqueeze(-1) + v.log_weight, v) for log_w, v in values if v is not None]
    batch = distribution.batch_shape
    log_weight = torch.cat([a.expand(*batch, a.shape[-1]) for a, _ in lists], -1)
    location = torch.cat([v.location for _, v in lists], -2)
    return NormalMixtureParameters(
        log_weight, location, torch.cat([v.covariance for _, v in lists], -3)
    )


def normal_mixture_moments(
    parameters: NormalMixtureParameters, model: StateSpaceModel
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the moments of a mixture, with differences that wrap angles.

    Returns mean [R, P, k], offsets of the parts from it [R, P, J, k], covariance [R, P, k, k].
    Shapes: parameters [R, P].
    """
    w, location = parameters.log_weight.exp(), parameters.location
    parts = location.shape[2]

    def subtract(a: Tensor, b: Tensor) -> Tensor:
        b = b.unsqueeze(2).expand_as(a)
        return model.residual(a.flatten(1, 2), b.flatten(1, 2)).unflatten(1, (-1, parts))

    first = location[:, :, 0]
    mean = first + (w.unsqueeze(-1) * subtract(location, first)).sum(2)
    offset = subtract(location, mean)
    outer = parameters.covariance + offset.unsqueeze(-1) * offset.unsqueeze(-2)
    return mean, offset, (w[..., None, None] * outer).sum(2)


def _is_normal(distribution: Any) -> bool:
    """Return whether a distribution of vectors is normal."""
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    kinds = MultivariateNormal | LowRankMultivariateNormal
    is_vector = len(distribution.event_shape) == 1
    return is_vector and (isinstance(base, kinds) or type(base) is Normal)


def _list_parts(distribution: Any) -> list[tuple[Tensor, Distribution]]:
    """Return log weights and distributions of the parts of a mixture, empty for others."""
    if isinstance(distribution, MixtureSameFamily):
        logits, family = (
            distribution.mixture_distribution.logits,
            distribution.component_distribution,
        )
        dims, count = len(family.batch_shape), family.batch_shape[-1]
        return [(logits[..., j], _select_part(family, j, dims)) for j in range(count)]
    weights, components = (getattr(distribution, name, ()) for name in ("weights", "components"))
    return [(torch.log(w), item) for w, item in zip(weights, components, strict=True)]


def _select_part(family: Any, j: int, dims: int) -> Distribution:
    """Return entry j of the last of `dims` batch axes of normal distributions."""
    if isinstance(family, Independent) and type(family.base_dist) is Normal:
        index = (slice(None),) * (dims - 1) + (j,)
        loc, scale = family.base_dist.loc[index], family.base_dist.scale[index]
        return Independent(Normal(loc, scale, validate_args=False), 1)
    if isinstance(family, MultivariateNormal):
        return MultivariateNormal(
            family.loc[..., j, :], scale_tril=family.scale_tril[..., j, :, :], validate_args=False
        )
    if type(family) is Normal:
        return Normal(family.loc[..., j], family.scale[..., j], validate_args=False)
    return cast(Distribution, family)


def _combine_components(distribution: Any) -> NormalMixtureParameters | None:
    """Return all combinations of the parts of independent components [..., k]."""
    base, k = distribution.base_dist, distribution.event_shape[-1]
    parts = _list_parts(base)
    if not parts or any(type(item) is not Normal for _, item in parts):
        return None
    count = len(parts) ** k
    require(
        not count > MOST_PARTS,
        "filter.measurement_update",
        f"have at most {MOST_PARTS} parts of the observation distribution",
        f"{len(parts)}^{k} for {k} components",
        "Use a particle filter, for example filter=sir.",
    )
    shape = base.batch_shape
    log_w = torch.stack([a.expand(shape) for a, _ in parts], -1)
    mean = torch.stack([item.mean.expand(shape) for _, item in parts], -1)
    variance = torch.stack([item.variance.expand(shape) for _, item in parts], -1)
    index = torch.tensor(list(product(range(len(parts)), repeat=k)), device=mean.device)
    rows = torch.arange(k, device=mean.device).expand_as(index)
    log_w, mean, variance = (a[..., rows, index] for a in (log_w, mean, variance))  # [..., J, k]
    return NormalMixtureParameters(log_w.sum(-1), mean, torch.diag_embed(variance))
