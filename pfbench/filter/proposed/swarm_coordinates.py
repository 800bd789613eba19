"""Coordinates and objectives of a particle swarm."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.chart import Chart
from pfbench.core.linear_algebra import factor, jacobian
from pfbench.core.parameter_checks import require_ranges
from pfbench.core.record import Record
from pfbench.filter.whitening import fill_missing, whiten
from pfbench.model.base import StateSpaceModel


class SwarmFrame(NamedTuple):
    """Coordinates of a swarm: chart components about the mean, or linear in them.

    Attributes:
        q: Predicted particles, [R, N, k].
        covariance: Covariance of the predicted particles, [R, k, k].
        components: Indices of the chart components, [k].
        chart: Chart of the states.
        origin: Mean of the predicted particles, [R, 1, D].
        deviation: Chart components of the predicted particles about it, [R, N, d].
        direction: Chart components that a coordinate moves, [R, k, d].
    """

    q: Tensor
    covariance: Tensor
    components: Tensor
    chart: Chart
    origin: Tensor
    deviation: Tensor
    direction: Tensor

    def to_states(self, q: Tensor) -> Tensor:
        """Return the states [R, N, D] of coordinates q [R, N, k] of each particle."""
        difference = torch.baddbmm(self.deviation, q - self.q, self.direction)
        return self.chart.add(self.origin, difference)


class SwarmCoordinates(Protocol):
    """Coordinates in which a swarm moves."""

    @property
    def whiten(self) -> bool:
        """True if the coordinates are whitened."""

    def __call__(self, model: StateSpaceModel, x: Tensor, w: Tensor, u: Any) -> SwarmFrame:
        """Compute the coordinates of predicted particles.

        Args:
            model: State-space model of the step.
            x: Predicted particles, [R, N, D].
            w: Weights, [R, N].
            u: Inputs of the step.

        Returns:
            Coordinates, and their map to states.
        """


@dataclass(frozen=True)
class AllComponents(SwarmCoordinates):
    """All components of the chart, as in the paper, including unobserved ones."""

    whiten = False

    @override
    def __call__(self, model: StateSpaceModel, x: Tensor, w: Tensor, u: Any) -> SwarmFrame:
        chart = model.chart
        mean = chart.mean(x, w).unsqueeze(1)
        c = chart.subtract(x, mean)
        index = torch.arange(c.shape[-1], device=c.device)
        covariance = (w.unsqueeze(-1) * c).mT @ c
        eye = torch.eye(len(index), dtype=c.dtype, device=c.device).expand_as(covariance)
        return SwarmFrame(c, covariance, index, chart, mean, c, eye)


@dataclass(frozen=True)
class ObservedComponents(SwarmCoordinates):
    """Components o that the measurement depends on. The others may follow [ours].

    Attributes:
        regress_unobserved: The others move by their regression S_uo S_oo^-1 (o' - o) on o, which
            leaves their residual unchanged. False does not move them.
        whiten: Use a = L^-1 o, L L' = S_oo, with the same standard deviation in all directions.
    """

    regress_unobserved: bool = True
    whiten: bool = False

    @override
    def __call__(self, model: StateSpaceModel, x: Tensor, w: Tensor, u: Any) -> SwarmFrame:
        chart = model.chart
        mean = chart.mean(x, w).unsqueeze(1)
        c = chart.subtract(x, mean)
        index = observed_components(model, mean, u)
        observed = c[..., index]
        joint = (w.unsqueeze(-1) * observed).mT @ c  # [R, k, d]
        covariance = joint[..., index]
        root = bounded_root(covariance)
        eye = torch.eye(len(index), dtype=c.dtype, device=c.device)
        # (d c / d a)', [R, k, d]
        direction = torch.linalg.solve_triangular(root, joint, upper=False)
        if not self.regress_unobserved:
            direction = direction.new_zeros(direction.shape)
        has_spread = (observed.square().sum(1) > 0.0).unsqueeze(-1)
        direction = direction.index_copy(-1, index, (root * has_spread).mT)
        if self.whiten:
            q, covariance = whiten(observed, root), eye.expand_as(covariance)
        else:
            q = observed
            direction = torch.linalg.solve_triangular(root.mT, direction, upper=True).index_copy(
                -1, index, eye.expand_as(covariance)
            )
        return SwarmFrame(q, covariance, index, chart, mean, c, direction)


class Fitness(Protocol):
    """Fitness of swarm positions: that of the measurement, less |W q|^2 / 2."""

    def __call__(self, frame: SwarmFrame) -> Tensor:
        """Return W, [R, k, k]."""

    def fit_measurement(self, model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
        """Return the fitness of the measurement, its log likelihood [R, N].

        Args:
            model: State-space model of the step.
            x: States, [R, N, D].
            record: Record of the step.
        """
        return model.log_likelihood(record.y, x, record.u)


@dataclass(frozen=True)
class LikelihoodFitness(Fitness):
    """No additional term: ln Y = ln p(y | x), the meaning of eq. 37.

    As printed, eq. 37 is linear in the residual, without a maximum.
    """

    @override
    def __call__(self, frame: SwarmFrame) -> Tensor:
        return torch.zeros_like(frame.covariance)


@dataclass(frozen=True)
class PrintedFitness(LikelihoodFitness):
    """ln Y = -sum_i (y_i - y_hat_i) / (2 R_i), eq. 37 as printed, over the components of y.

    The paper writes one residual and one R. The sum over components is [ours]. It is linear in the
    state where y_hat is, so it is unbounded. The limit of the velocity alone holds the swarm.
    """

    @override
    def fit_measurement(self, model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
        y: Any = model.observation(x, record.u)
        terms = model.residual(record.y.unsqueeze(1), y.mean) / (2.0 * y.variance)
        return -torch.where(torch.isnan(terms), 0.0, terms).sum(-1)


@dataclass(frozen=True)
class PosteriorFitness(Fitness):
    """Log density of the normal distribution fitted to the predicted particles [ours].

    The swarm then seeks a mode of the posterior.

    Attributes:
        covariance_shrinkage: Shrinkage of the covariance towards its diagonal, for few particles.

    Raises:
        ValueError: If the shrinkage is outside [0, 1].
    """

    covariance_shrinkage: float = 0.05

    def __post_init__(self) -> None:
        require_ranges(
            "proposal.fitness", self, covariance_shrinkage="[0, 1] Use 0 for no shrinkage."
        )

    @override
    def __call__(self, frame: SwarmFrame) -> Tensor:
        s = frame.covariance
        diagonal = torch.diag_embed(s.diagonal(dim1=-2, dim2=-1))
        root = bounded_root(s + self.covariance_shrinkage * (diagonal - s))
        eye = torch.eye(s.shape[-1], dtype=s.dtype, device=s.device)
        return torch.linalg.solve_triangular(root, eye, upper=False)


def observed_components(model: StateSpaceModel, mean: Tensor, u: Any) -> Tensor:
    """Return the components on which mean or variance of the measurement depends.

    Shapes: mean [R, 1, D].
    """

    def moments_of_y(xi: Tensor) -> Tensor:
        x = model.chart.add(mean.expand(-1, xi.shape[1], -1), xi)
        distribution: Any = model.observation(x, u)
        return torch.cat([distribution.mean, distribution.variance], -1)

    zero = mean.new_zeros(len(mean), 1, model.chart.dimension)
    slope = jacobian(moments_of_y, moments_of_y(zero), zero.shape[-1]).nan_to_num()  # [R, 2 Dy, d]
    return (slope != 0.0).flatten(0, 1).any(0).nonzero().squeeze(-1)


def bounded_root(covariance: Tensor) -> Tensor:
    """Compute a Cholesky factor [R, k, k]. Runs without one get NaN and are lost."""
    root, ok = factor(covariance)
    return torch.where(ok[:, None, None], fill_missing(root), torch.nan)
