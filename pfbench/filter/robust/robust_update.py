"""Robust updates of Gaussian filters: weight functions, groups of components, weights by the residual."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.special import gammainc, gammaincc, gammaln
from typing_extensions import override

from pfbench.core.chi_square import chi_square_limit
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import (
    Innovation,
    NoiseAdaptation,
    axes_by_group,
    compute_group_root,
    diagonal_axes,
    whitened_measurement,
)
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.whitening import LOG_2PI

GROUPINGS = ("all", "sensor", "component", "satellite")
DOWNWEIGHTED = 0.5  # a fix whose weight is below this counts as downweighted [ours]


@dataclass(frozen=True)
class ComponentGrouping:
    """Choice of the components that are judged together.

    Attributes:
        kind: `all` for the whole measurement, `sensor` for components of equal nominal variance,
            `component` for single components, or `satellite` for ranges followed by as many range
            rates.
        groups: Group number of each component, which replaces `kind`.
    """

    kind: str = "component"
    groups: Sequence[int] | None = None

    def __post_init__(self) -> None:
        require(
            self.kind in GROUPINGS,
            "grouping",
            f"be {', '.join(GROUPINGS[:-1])} or {GROUPINGS[-1]}",
            self.kind,
            "Choose one of them.",
        )
        require(
            all(isinstance(number, int) for number in self.groups or ()),
            "groups",
            "be a whole number for each component",
            list(self.groups or ()),
            "Give components of one group the same number.",
        )

    def numbers(self, components: int) -> Sequence[int] | None:
        """Return the group number of each component, None for groups of equal variance."""
        if self.groups is not None:
            require(
                len(self.groups) == components,
                "groups",
                f"be one number for each of the {components} components of the measurement",
                list(self.groups),
                "Give as many numbers.",
            )
            return self.groups
        if self.kind == "satellite":
            require(
                not components % 2,
                "grouping",
                "be component for a measurement without a range rate for each range",
                f"satellite with {components} components",
                "Choose component.",
            )
            return [i % (components // 2) for i in range(components)]
        return {"all": [0] * components, "component": range(components)}.get(self.kind)

    def apply(self, innovation: Innovation, covariance: Tensor) -> GroupDistances:
        """Build the distances by group, in units of a covariance.

        Returns the distances. Shapes: covariance [R, k, k].
        """
        group_mask, joint_mask = axes_by_group(innovation, self.numbers(innovation.r.shape[-1]))
        root = compute_group_root(covariance, joint_mask)
        observed = innovation.observed_mask.to(innovation.r)
        count = (group_mask.to(observed) @ observed.unsqueeze(-1)).squeeze(-1)
        return GroupDistances(group_mask.to(observed), joint_mask, root, observed, count)


class GroupDistances(NamedTuple):
    """Squared distances of a residual by group, in units of a covariance.

    Attributes:
        group_mask: 1 where two components belong to one group, [R, k, k].
        joint_mask: Mask of observed component pairs of one group, [R, k, k].
        root: Block-diagonal root of the covariance, [R, k, k].
        observed: 1 for observed components, [R, k].
        size: Number of observed components in the group of a component, [R, k].
    """

    group_mask: Tensor
    joint_mask: Tensor
    root: Tensor
    observed: Tensor
    size: Tensor

    def sum_groups(self, squares: Tensor) -> Tensor:
        """Sum values [R, k] over the observed components of each group, [R, k]."""
        return (self.group_mask @ (squares * self.observed).unsqueeze(-1)).squeeze(-1)

    def squared_distance(self, residual: Tensor) -> Tensor:
        """Compute d^2 of the group of each component, [R, k], of a residual [R, k]."""
        white = torch.linalg.solve_triangular(self.root, residual.unsqueeze(-1), upper=False)
        return self.sum_groups(white.squeeze(-1).square())

    def trace(self, covariance: Tensor) -> Tensor:
        """Compute the trace of C in units of the covariance, by group, [R, k]; C [R, k, k]."""
        white = whitened_measurement(self.root, covariance, self.joint_mask)
        return self.sum_groups(diagonal_axes(white).clamp(min=0.0))

    def count_groups(self, mask: Tensor) -> Tensor:
        """Count the groups whose components are marked in a mask [R, k], [R]."""
        return (mask.to(self.observed) * self.observed / self.size.clamp(min=1.0)).sum(-1)


# --------------------------------------------------------------------------------------------------
# Robust updates of Gaussian filters: weights of a measurement that depend on its residual.
#
# A weight w divides the noise of its components, R_ij / sqrt(w_i w_j). It belongs to the filter, not
# to the model. Since it depends on y, the evidence of the filter is not a density.


class RobustUpdate(NoiseAdaptation):
    """Base of the updates that judge a measurement by its residual.

    A filter takes at most one of them: a second would judge the residual again.

    Attributes:
        grouping: Components with a common weight, see ComponentGrouping.
        groups: Group number of each component, instead of `grouping`.
    """

    has_evidence = False
    grouping: str = "component"
    groups: Sequence[int] | None = None
    rules: ClassVar[Mapping[str, str]] = {}  # ranges of the fields

    def __post_init__(self) -> None:
        _ = self.component_grouping  # refuses what is none
        require_ranges(type(self).__name__, self, **self.rules)

    @property
    def component_grouping(self) -> ComponentGrouping:
        """The groups of components that are judged together."""
        return ComponentGrouping(self.grouping, self.groups)

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        return predicted


class ResidualLoss(RobustUpdate, ABC):
    """Base of the updates that follow from a loss of the residual, a function of its distance.

    The measurement is reweighted by the residual after the update, a fixed number of times.

    Attributes:
        iterations: Number of reweightings, equal for all runs.
        is_density: True if exp(-loss) is a density of the measurement given the state.
        adds_spread: True if the distance includes the covariance of the predicted measurement.
    """

    iterations: int
    is_density: bool = False
    adds_spread: bool = False

    @abstractmethod
    def weight_of(self, size: Tensor) -> Callable[[Tensor], Tensor]:
        """Return the weight as a function of squared distances, for groups of a size [R, k]."""

    @abstractmethod
    def log_density(self, squared: Tensor, size: Tensor) -> Tensor:
        """Compute minus the loss of groups in whitened coordinates, with its constant."""

    def residual_weight(self, squared: Tensor, size: Tensor) -> Tensor:
        """Compute the weight of groups."""
        return self.weight_of(size)(squared)

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        groups = self.component_grouping.apply(innovation, innovation.noise)
        weight, w = self.weight_of(groups.size), torch.ones_like(innovation.r)
        for _ in range(self.iterations):
            residual, covariance = updated_residual(innovation.reweight(w, groups.group_mask))
            squared = groups.squared_distance(residual)
            squared = squared + groups.trace(covariance) if self.adds_spread else squared
            w = finite_weight(weight(squared))
        return innovation.reweight(w, groups.group_mask), count_downweighted(groups, w)


class InnovationWeight(RobustUpdate, ABC):
    """Base of the updates that weigh a measurement by the innovation, in one step."""

    @abstractmethod
    def innovation_weight(
        self, innovation: Innovation, memory: Mapping[str, Tensor]
    ) -> tuple[Tensor, GroupDistances, dict[str, Tensor]]:
        """Compute the weight of each component.

        Returns weights [R, k], 0 for a rejected component, the groups, and values by name,
        [R, ...].
        """


def updated_residual(innovation: Innovation) -> tuple[Tensor, Tensor]:
    """Compute the residual after the update, and the covariance of its prediction.

    Returns e = r - M xi+ [R, k], and M P+ M' with the error of the linearisation [R, k, k].
    """
    shift, root, _ = kalman_gain_update(innovation)
    half = innovation.m @ root
    residual = innovation.r - (innovation.m @ shift.unsqueeze(-1)).squeeze(-1)
    return residual, half @ half.mT + (innovation.omega - innovation.noise)


def finite_weight(weight: Tensor) -> Tensor:
    """Return weights, 1 in place of NaN: a run without a root is lost in the update itself."""
    return torch.where(weight == weight, weight, 1.0)


def count_downweighted(groups: GroupDistances, weight: Tensor) -> dict[str, Tensor]:
    """Count the fixes of the step whose weight is below 1/2.

    Returns the count [R] by the name of its trace. Shapes: weight [R, k].
    """
    return {"downweighted": groups.count_groups(weight < DOWNWEIGHTED)}


THRESHOLD_RULES = {
    "threshold": "null or (0, inf] Use null for the threshold of 95 % efficiency.",
    "efficiency": "(0, 1) Use 0.95.",
}


# --------------------------------------------------------------------------------------------------
# Weights of standardised distances, and their thresholds for an efficiency at the normal law.
#
# A weight w(d) multiplies the information of a measurement at the distance d. Its asymptotic
# efficiency in k components with normal errors is A^2 / B with A = E[w d^2] / k and
# B = E[w^2 d^2] / k, d ~ chi_k [Huber and Ronchetti 2009]. A follows from Stein's lemma, so it
# holds for rejection too.
#
# A loss is the log density of a group of components at a squared distance. Huber's and Student's have
# the constant with which they integrate to 1. Welsch's is bounded and has the constant of the normal.

_NODES = 4000  # of the quadrature over the distance
_HALVINGS = 40
_SMALLEST = 1e-3  # smallest threshold


def huber_weight(squared: Tensor, threshold: Tensor) -> Tensor:
    """Compute min(1, c / d)."""
    return (threshold / squared.clamp(min=1e-300).sqrt()).clamp(max=1.0)


def cauchy_weight(squared: Tensor, threshold: Tensor) -> Tensor:
    """Compute 1 / (1 + d^2 / c^2)."""
    return 1.0 / (1.0 + squared / threshold.square())


def welsch_weight(squared: Tensor, threshold: Tensor) -> Tensor:
    """Compute exp(-d^2 / (2 c^2))."""
    return torch.exp(-0.5 * squared / threshold.square())


def huber_log_density(squared: Tensor, size: Tensor, threshold: Tensor) -> Tensor:
    """Compute the log density exp(-d^2 / 2) up to c and exp(-c d + c^2 / 2) beyond, normalised."""
    c, half = threshold, 0.5 * size.clamp(min=1.0)
    distance = squared.clamp(min=0.0).sqrt()
    loss = torch.where(distance <= c, 0.5 * squared, c * distance - 0.5 * c.square())
    log_sphere = math.log(2.0) + half * math.log(math.pi) - gammaln(half)
    log_inside = (half - 1.0) * math.log(2.0) + gammaln(half) + gammainc(half, 0.5 * c**2).log()
    tail = gammaincc(2.0 * half, c.square())
    log_outside = 0.5 * c.square() - 2.0 * half * c.log() + gammaln(2.0 * half) + tail.log()
    log_outside = torch.where(tail > 0.0, log_outside, -torch.inf)  # an infinite threshold
    return -loss - log_sphere - torch.logaddexp(log_inside, log_outside)


def student_log_density(squared: Tensor, size: Tensor, dof: float) -> Tensor:
    """Compute the log density of Student's t in k components; normal for infinite dof."""
    if math.isinf(dof):
        return -0.5 * squared - 0.5 * size * LOG_2PI
    half = 0.5 * (dof + size)
    constant = gammaln(half) - math.lgamma(0.5 * dof) - 0.5 * size * math.log(dof * math.pi)
    return constant - half * torch.log1p(squared / dof)


def welsch_log_loss(squared: Tensor, size: Tensor, threshold: Tensor) -> Tensor:
    """Compute -c^2 (1 - exp(-d^2 / (2 c^2))), with the constant of the normal density."""
    c2 = threshold.square()
    return c2 * torch.expm1(-0.5 * squared / c2) - 0.5 * size * LOG_2PI


WeightFunction = Callable[[Tensor, Tensor], Tensor]


def compute_efficiency(weight: WeightFunction, threshold: float, k: int) -> float:
    """Compute the asymptotic efficiency of a weight at the normal law."""
    squared, probability = _chi_nodes(k)
    values = weight(squared, torch.tensor(threshold, dtype=torch.float64))
    a = (values * squared * probability).sum() / k
    b = (values.square() * squared * probability).sum() / k
    return float(a * a / b)


@lru_cache(maxsize=64)
def _chi_nodes(k: int) -> tuple[Tensor, Tensor]:
    """Return squared distances and their probabilities for d ~ chi_k."""
    d = np.linspace(0.0, math.sqrt(k) + 12.0, _NODES + 1)[1:]
    probability = np.exp(
        (k - 1) * np.log(d) - d * d / 2 - (k / 2 - 1) * math.log(2.0) - math.lgamma(k / 2)
    )
    probability *= d[1] - d[0]
    return torch.from_numpy(d * d), torch.from_numpy(probability)


@lru_cache(maxsize=256)
def threshold_for_efficiency(weight: WeightFunction, efficiency: float, k: int) -> float:
    """Compute the threshold c at which a weight has an efficiency."""
    low, high = _SMALLEST, 1.0 / _SMALLEST
    if compute_efficiency(weight, low, k) > efficiency:
        return math.nan
    for _ in range(_HALVINGS):
        middle = math.sqrt(low * high)
        is_above = compute_efficiency(weight, middle, k) > efficiency
        low, high = (low, middle) if is_above else (middle, high)
    return math.sqrt(low * high)


def threshold_table(
    weight: WeightFunction, threshold: float | None, efficiency: float, count: Tensor
) -> Tensor:
    """Return the threshold of each group, [R, k].

    Shapes: count [R, k].
    """
    if threshold is not None:
        return torch.full_like(count, threshold)
    values = [threshold_for_efficiency(weight, efficiency, n) for n in _counts(count)]
    table = _look_up(values, count)
    if any(map(math.isnan, values)) and not torch.compiler.is_compiling():
        _check_efficiency_reached(weight, table, efficiency, count)
    return table


def _check_efficiency_reached(
    weight: WeightFunction, table: Tensor, efficiency: float, count: Tensor
) -> None:
    """Raise an error if a group lacks a threshold."""
    missing = table.isnan()
    if bool(missing.any()):
        k = int(count[missing].max())
        least = compute_efficiency(weight, _SMALLEST, k)
        raise ValueError(
            f"efficiency must be at least {math.ceil(1e3 * least) / 1e3:g} for a group with k = {k} "
            f"measured components, got {efficiency:g}. Increase it, set a threshold, or use "
            "grouping=component."
        )


def quantile_table(probability: float, count: Tensor) -> Tensor:
    """Return the quantile of chi-square for the size of each group, [R, k].

    Shapes: count [R, k].
    """
    return _look_up([chi_square_limit(n, 1.0 - probability) for n in _counts(count)], count)


def _counts(count: Tensor) -> range:
    """Return all possible numbers of components of a group, from 1."""
    return range(1, count.shape[-1] + 1)


def _look_up(values: list[float], count: Tensor) -> Tensor:
    """Gather values for 1, 2, ... components; an empty group takes the first."""
    table = torch.tensor(values, dtype=count.dtype, device=count.device)
    return table[(count.long() - 1).clamp(min=0)]
