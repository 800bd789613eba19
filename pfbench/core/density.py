"""Log densities of measurements with missing components, and existence of moments."""

from __future__ import annotations

import math
from typing import Any, ClassVar

import torch
from pyro import distributions as pyro
from torch import Tensor
from torch.distributions import (
    Distribution,
    Independent,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    biject_to,
)
from torch.distributions.constraints import Constraint
from typing_extensions import override

from pfbench.core.chart import Chart
from pfbench.core.linear_algebra import gaussian_log_density
from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable

_HALF_LOG_2PI = 0.5 * math.log(2.0 * math.pi)


def log_density(distribution: Distribution, y: Tensor, observed_mask: Tensor, name: str) -> Tensor:
    """Compute the log density of the observed components of a measurement.

    Missing components are integrated out. This is possible for independent components, normal
    distributions and mixtures of both.

    Returns log density, [R, N]; 0 where no component is observed. Shapes: distribution [R, N], y
    [R, 1 or N, Dy], observed_mask [R, 1, Dy].
    """
    kind = type(distribution).__name__
    check_event_dimension(distribution, name, y.shape[-1])
    if isinstance(distribution, Independent) and not distribution.base_dist.event_shape:
        base = distribution.base_dist
        value = _log_prob(base, _filled(base, y, observed_mask), name)
        return torch.where(observed_mask, value, 0.0).sum(-1)
    if isinstance(distribution, MultivariateNormal | LowRankMultivariateNormal):
        r = torch.where(observed_mask, y - distribution.loc, 0.0)
        return gaussian_log_density(r, distribution.covariance_matrix, observed_mask)
    if isinstance(distribution, MixtureSameFamily):
        parts = log_density(
            distribution.component_distribution, y.unsqueeze(-2), observed_mask.unsqueeze(-2), name
        )
        return torch.logsumexp(distribution.mixture_distribution.logits + parts, -1)
    observed, complete = observed_mask.any(-1), observed_mask.all(-1)
    if bool((observed & ~complete).any()):
        raise ValueError(
            f"{name} must return Independent, MultivariateNormal or a mixture of them for a "
            f"measurement with missing components, got {kind}. Provide complete measurements."
        )
    value = _log_prob(distribution, _filled(distribution, y, observed_mask), name)
    return torch.where(observed, value, 0.0)


def _log_prob(distribution: Any, y: Tensor, name: str) -> Tensor:
    """Return `log_prob`; a value that torch refuses is named with a remedy."""
    try:
        value: Tensor = distribution.log_prob(y)
    except ValueError as error:
        kind = type(distribution).__name__
        if "within the support" not in str(error) or distribution.event_shape:
            raise
        is_inside = distribution.support.check(y)
        wrong = y.expand(is_inside.shape)[~is_inside]
        raise ValueError(
            f"{name} must return a distribution whose support contains the measurement at every state, "
            f"got {kind} for {float(wrong[0]):g}. Mark the component as NaN, or create {kind} with "
            "validate_args=False if its log_prob is -inf outside the support."
        ) from error
    return value


def check_event_dimension(distribution: Distribution, name: str, width: int | None = None) -> None:
    """Check that the components of a vector are the event of its distribution."""
    if len(distribution.event_shape) != 1:
        size = "" if width is None else f" of {width} components"
        raise TypeError(
            f"{name} must be a distribution with one event dimension{size}, got "
            f"{type(distribution).__name__} with batch shape {list(distribution.batch_shape)} and event "
            f"shape {list(distribution.event_shape)}. Keep a last axis of components and append "
            ".to_event(1), or use MultivariateNormal."
        )


def has_finite_moments(distribution: Any) -> bool:
    """Return whether mean and variance are finite wherever the parameters are finite."""
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    if isinstance(base, Normal | MultivariateNormal):
        return True
    if isinstance(base, MixtureSameFamily):
        return has_finite_moments(base.component_distribution)
    try:
        mean, variance = base.mean, base.variance
    except NotImplementedError:
        return False
    finite_mask = torch.isfinite(mean) & torch.isfinite(variance)
    names = base.arg_constraints if isinstance(distribution, Independent) else ("loc",)
    values = [getattr(base, name, None) for name in names]
    parameters = [value for value in values if isinstance(value, Tensor)]
    if not parameters:  # a lost run has NaN moments too: only a distribution without any is refused
        return bool(finite_mask.any())
    valid_mask = torch.ones_like(finite_mask)
    for value in parameters:
        valid_mask = valid_mask & torch.isfinite(value)
    return not bool((valid_mask & ~finite_mask).any())


def _filled(distribution: Any, y: Tensor, observed_mask: Tensor) -> Tensor:
    """Replace missing components by a value inside the support, so that no gradient is NaN."""
    try:
        support = distribution.support
    except (AttributeError, NotImplementedError):
        return torch.where(observed_mask, y, 0.0)
    while hasattr(support, "base_constraint"):
        support = support.base_constraint
    if support.is_discrete:
        inside: Any = getattr(support, "lower_bound", 0.0)
    else:
        inside = biject_to(support)(torch.zeros_like(y))
    return torch.where(observed_mask, y, inside)


def log_normal_density(y: Tensor, mean: Tensor, sd: Tensor) -> Tensor:
    """Compute the log density of observed independent normal components.

    It replaces torch's `log_prob`, which passes over the particles eight times and took half of a
    step of a bootstrap filter.

    Returns log density, [R, N]. Shapes: y [R, Dy], NaN where missing, mean [R, N, Dy], sd [R or 1, 1
    or N, Dy].
    """
    if sd.shape[1] == 1:
        return _density(y, mean, sd[:, 0])
    y, scale, constant = _observe(y.unsqueeze(1), sd)
    return _particle_quadratic(y, mean, scale) - constant


def _observe(y: Tensor, sd: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Return measurements, inverse standard deviations, 0 where missing, [..., Dy], and the constant of the density [...]."""
    observed_mask = y == y
    constant = ((torch.log(sd) + _HALF_LOG_2PI) * observed_mask).sum(-1)
    return y.nan_to_num(), observed_mask / sd, constant


def _run_density(y: Tensor, mean: Tensor, sd: Tensor) -> Tensor:
    """Compute the log density [R, N] for standard deviations [R or 1, Dy] of runs."""
    y, scale, constant = _observe(y, sd)
    return _quadratic(y, mean, scale, constant)


def _run_quadratic(y: Tensor, mean: Tensor, scale: Tensor, constant: Tensor) -> Tensor:
    """Compute -1/2 sum ((y - mean) scale)^2 - constant [R, N] for scales [R, K] of runs."""
    z = (y[:, None] - mean) * scale[:, None]
    return -0.5 * (z * z).sum(-1) - constant[:, None]


@compilable
def _particle_quadratic(y: Tensor, mean: Tensor, scale: Tensor) -> Tensor:
    """Compute -1/2 sum ((y - mean) scale)^2 [R, N] for scales [R, N, K] of particles."""
    z = (y - mean) * scale
    return -0.5 * (z * z).sum(-1)


_quadratic = compilable(_run_quadratic, operator=dispatch.log_normal, keep_in_graph=False)
_density = compilable(
    _run_density,
    operator=dispatch.log_observed_normal,
    keep_in_graph=False,
    use_torch_compiler=False,
)


class StandardNormal(pyro.Normal):
    """Standard normal distribution; code that recognises the type skips scale and shift."""


def independent_normal(mean: Tensor, sd: Tensor) -> pyro.Independent:
    """Build a normal distribution with independent components.

    Args:
        mean: Means, [..., k].
        sd: Standard deviations, broadcast against the mean.

    Returns:
        Distribution with event [k].
    """
    normal = pyro.Normal.__new__(
        pyro.Normal
    )  # the constructor takes four times as long at each step
    normal.loc, normal.scale = mean, sd.expand_as(mean)
    Distribution.__init__(normal, mean.shape, validate_args=False)
    return normal.to_event(1)


def normal_batch(runs: int, sd: Tensor, mean: Tensor | None = None) -> pyro.Independent:
    """Build the same independent normal distribution for each run.

    Args:
        runs: Number of runs R.
        sd: Standard deviations, [d].
        mean: Means, [d]; None is zero.

    Returns:
        Distribution with batch [R], event [d].
    """
    centre = torch.zeros_like(sd) if mean is None else mean
    return independent_normal(centre.expand(runs, -1), sd)


def dense_normal(mean: Tensor, factor: Tensor) -> pyro.MultivariateNormal:
    """Build a normal distribution from its mean and Cholesky factor, without checks.

    As `MultivariateNormal(mean, scale_tril=factor)`, whose constructor imports SymPy for the shape.

    Returns distribution with event [d]. Shapes: mean [..., d], factor [..., d, d].
    """
    batch = torch.broadcast_tensors(mean[..., 0], factor[..., 0, 0])[0].shape
    normal = pyro.MultivariateNormal.__new__(pyro.MultivariateNormal)
    normal.loc, normal.scale_tril = mean.expand(*batch, -1), factor.expand(*batch, -1, -1)
    normal._unbroadcasted_scale_tril = factor
    Distribution.__init__(normal, batch, mean.shape[-1:], validate_args=False)
    return normal


class ChartNormal(Distribution):
    """Normal distribution in a chart: x = mean (+) L z, z ~ N(0, I).

    The density is relative to the invariant measure of states, so that densities about different means can be
    compared. On a flat chart it is that of `MultivariateNormal`.

    Attributes:
        chart: Chart of the states.
        loc: Mean states, [..., D].
        scale_tril: Factors L, [..., d, d], broadcast against the means.
    """

    arg_constraints: ClassVar[dict[str, Constraint]] = {}

    def __init__(self, chart: Chart, mean: Tensor, factor: Tensor) -> None:
        self.chart, self.loc, self.scale_tril = chart, mean, factor
        super().__init__(mean.shape[:-1], mean.shape[-1:], validate_args=False)

    @property
    @override
    def mean(self) -> Tensor:
        return self.loc

    @property
    @override
    def mode(self) -> Tensor:
        return self.loc

    @property
    def covariance_matrix(self) -> Tensor:
        """Covariance of the differences from the mean, [..., d, d]."""
        return self.scale_tril @ self.scale_tril.mT

    @override
    def rsample(self, sample_shape: Any = ()) -> Tensor:
        shape = (*sample_shape, *self.batch_shape, self.chart.dimension, 1)
        z = torch.randn(shape, dtype=self.loc.dtype, device=self.loc.device)
        step = (self.scale_tril @ z).squeeze(-1)
        return self.chart.add(self.loc.expand(*step.shape[:-1], -1), step)

    @override
    def log_prob(self, value: Tensor) -> Tensor:
        d = self.chart.subtract(value, self.loc)
        normal = dense_normal(torch.zeros_like(d), self.scale_tril)
        return normal.log_prob(d) - self.chart.log_volume(d)
