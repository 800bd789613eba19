"""Banks of Gaussian filters: from a Gaussian sum of the initial distribution, and with split components."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import GaussianBelief, ParticleBelief, StepInfo
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter, check_point_reach
from pfbench.filter.gaussian.invariant import ChartModel, InvariantFilter, change_covariance
from pfbench.filter.gaussian.kalman_update import move_root
from pfbench.filter.gaussian.linearisation_rules import TaylorLinearisation
from pfbench.filter.marginal.rao_blackwellised import partition_state
from pfbench.filter.particle.sqmc import SobolPoints
from pfbench.filter.particle.stages import PointSet, Systematic
from pfbench.filter.robust.hypotheses import (
    OFFSET,
    Branches,
    HypothesisFilter,
    branch_memory,
    mixture_moments,
)
from pfbench.filter.whitening import split_root
from pfbench.model.base import StateSpaceModel

# --------------------------------------------------------------------------------------------------
# Bank of Gaussian filters that start from the components of a Gaussian sum of the initial distribution.
#
# References:
#     D. L. Alspach, H. W. Sorenson 1972, "Nonlinear Bayesian estimation using Gaussian sum
#         approximations".
#     L. D. Hostetler, R. D. Andreas 1983, "Nonlinear Kalman filtering techniques for terrain-aided
#         navigation" (parallel filters).

SPACING = 1.0  # largest distance of two components, standard deviations


@dataclass(frozen=True)
class FilterBank(HypothesisFilter):
    """Gaussian filters from a grid of initial means, weighed by their evidence.

    The initial normal distribution is split in a group of states into a mixture with the same mean
    and covariance. The components are equally spaced along each axis of the Cholesky factor. Of n
    components the outermost ones are at sqrt(n) standard deviations, or nearer if n is below 6. A
    denser bank thus has narrower components, and is closer to the normal distribution. Each is the
    start of a filter under the first hypothesis on the noise. The estimate is the mean of the
    mixture.

    Attributes:
        branches: Largest number K of filters. Each of k axes has the largest whole number of components
            that is not above K^(1/k).
        group: Component group that is split. None for the position, or the first group of a model
            without one.
        overlap: Standard deviation of a component before the variance is matched, in distances of
            two components.

    Raises:
        ValueError: If the number of filters is below 1, or the overlap is outside (0, 1). `init` raises it for an unknown group.
    """

    branches: int = 81
    group: str | None = None
    overlap: float = 0.6

    def __post_init__(self) -> None:
        require_ranges("filter", self, overlap="(0, 1) Use 0.6.", branches="whole [1, inf) Use 81.")

    @override
    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> GaussianBelief:
        belief = super().init(model, runs, draws, start, spread)
        axes = list(model.groups[self._find_group(model)])
        points = round(self.branches ** (1.0 / len(axes)))
        points -= points ** len(axes) > self.branches
        count = points ** len(axes)
        node, log_w, sd = split_normal(points, belief.covariance, self.overlap)
        grid = torch.cartesian_prod(*[node] * len(axes)).reshape(count, len(axes))
        weights = torch.cartesian_prod(*[log_w] * len(axes)).reshape(count, len(axes)).sum(-1)
        root, is_valid = factor(belief.covariance)  # a run without a root is lost
        root = torch.where(is_valid[:, None, None], root, torch.nan)
        scale = root.new_ones(root.shape[-1])
        scale[axes] = sd
        offset = root[..., axes] @ grid.mT  # [R, d, K]
        component = (root * scale).unsqueeze(1) @ (root * scale).unsqueeze(1).mT
        return belief._replace(
            memory=branch_memory(
                offset.mT.contiguous(),
                component.repeat(1, count, 1, 1),
                weights.repeat(runs, 1),
                weights.new_zeros(runs, count, 1),
            )
        )

    def _find_group(self, model: StateSpaceModel) -> str:
        """Return the name of the group that is split."""
        if self.group is None:
            return "position" if "position" in model.groups else next(iter(model.groups))
        require(
            self.group in model.groups,
            "filter.group",
            f"be of {', '.join(model.groups)}",
            self.group,
            "Choose a component group of the model.",
        )
        return self.group

    @override
    def _start(self, log_law: Tensor) -> tuple[Tensor, Tensor]:
        return log_law[:1] * 0.0, log_law[:1, None] * 0.0  # replaced by `init`

    @override
    def _predict_branches(
        self, model: StateSpaceModel, belief: GaussianBelief
    ) -> tuple[Branches, Tensor, Tensor]:
        memory = belief.memory
        mean = model.chart.add(belief.mean.unsqueeze(1), memory[OFFSET])
        log_w = memory["branch_log_weight"]
        number = torch.zeros(log_w.shape[1], dtype=torch.int64, device=log_w.device)
        return Branches(mean, memory["branch_covariance"]), number, log_w

    @override
    def _keep(
        self,
        log_w: Tensor,
        offset: Tensor,
        covariance: Tensor,
        number: Tensor,
        draws: RandomStream,
    ) -> dict[str, Tensor]:
        return branch_memory(offset, covariance, log_w, torch.zeros_like(log_w).unsqueeze(-1))


def split_normal(
    points: int, template: Tensor, overlap: float = 0.6
) -> tuple[Tensor, Tensor, Tensor]:
    """Split the standard normal distribution into equally spaced components.

    Weights are those of the density at the means with the variance that the components leave. The
    variance of the components is then set so that the mixture has variance 1.

    Returns means [n], log weights [n], and the standard deviation of every component.
    """
    if points == 1:
        return template.new_zeros(1), template.new_zeros(1), template.new_ones(())
    # with the root of n both the tails left out and the width of the components shrink
    reach = min(math.sqrt(points), 0.5 * SPACING * (points - 1))
    node = torch.linspace(-reach, reach, points, dtype=torch.float64)
    first = overlap * 2.0 * reach / (points - 1)
    log_w = (-0.5 * node.square() / (1.0 - first**2)).log_softmax(0)
    variance = 1.0 - (log_w.exp() * node.square()).sum()
    return node.to(template), log_w.to(template), variance.sqrt().to(template)


# --------------------------------------------------------------------------------------------------
# Rao-Blackwellised filter whose sampled states keep a small variance: a bank of Gaussian filters.
#
# Each particle is a normal distribution of the state. Where a sampled state has too large a standard
# deviation for one linearisation, the particle is split: an offset is drawn, and the rest of the
# variance remains. The split is exact, while each Gaussian filter linearises.
#
# References:
#     Kotecha and Djuric 2003, Gaussian sum particle filtering.

_COVARIANCE = "covariance"  # in the memory of particles, [R, N, d, d]
_NEGLIGIBLE = 1e-9  # weight of a particle that is discarded


@dataclass(frozen=True)
class GaussianSplitFilter:
    """Particles that are normal distributions, each with a Gaussian filter, for few nonlinear states.

    Before a step, a run whose particles have a standard deviation above `largest_sd` in a sampled state
    is resampled. Each particle is split: its mean moves by an offset along the regression on the state,
    and half the limit remains. After a step, a mixture with less than that is merged to its moments.

    On a linear model without merging, mean and evidence are unbiased for any number of particles.
    Otherwise each particle has the linearisation error of its filter.

    Attributes:
        filter: Gaussian filter of a particle, or one in an invariant chart. No adaptations.
        particles: Largest number N of particles.
        sampled_states: Names of groups or states to be sampled. All have the same unit.
        largest_sd: Largest standard deviation of a sampled state within a particle before a step, in
            its unit. The noise of a step adds to it.
        merge: Whether to merge a mixture that one particle can represent.
        points: Point set of the offsets.

    Raises:
        ValueError: If there are fewer than two particles, the limit is not positive, or the filter
            has adaptations. On use, if a name is unknown, or units differ.
    """

    filter: GaussianFilter | InvariantFilter
    particles: int
    sampled_states: Sequence[str] = ("attitude_yaw",)
    largest_sd: float = 0.35
    merge: bool = True
    points: PointSet = field(default_factory=SobolPoints)
    is_exact = False  # each particle linearises within the limit

    def __post_init__(self) -> None:
        require_ranges(
            "filter",
            self,
            particles="whole [2, inf) Use 32.",
            largest_sd="(0, inf) Use 0.35 for angles.",
        )
        inner = self.filter.filter if isinstance(self.filter, InvariantFilter) else self.filter
        require(
            isinstance(inner, GaussianFilter) and inner.plain,
            "filter.filter",
            "be a Gaussian filter without adaptations, or an invariant filter with one",
            type(inner).__name__,
            "Choose ekf, ukf or invariant_ekf.",
        )

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief:
        """Split the moments of the initial distribution.

        Args:
            model: State-space model.
            runs: Number of runs R.
            draws: Random stream of step 0.
            start: States about which the initial distribution is placed, [R, D].
            spread: Cholesky factors of the initial covariances, [R, d, d].

        Returns:
            Weighted particles. Those that are not used have weight 0.

        Raises:
            ValueError: If a mean or variance is not finite, a name is unknown, or units differ.
        """
        method, inner = self._unwrap(model)
        initial = GaussianFilter(TaylorLinearisation()).init(model, runs, draws, start, spread)
        covariance = initial.covariance
        if inner is not model:
            covariance = change_covariance(model.chart, inner.chart, initial.mean, covariance)
        x = initial.mean.unsqueeze(1).repeat(1, self.particles, 1)
        log_w = _first_alone(x[..., 0])
        memory = {_COVARIANCE: covariance.unsqueeze(1).repeat(1, self.particles, 1, 1)}
        belief = ParticleBelief(x, log_w, initial.log_evidence, memory=memory)
        belief = self._split(inner, belief, draws)
        check_point_reach(
            method.linearisation, inner.chart, belief.memory[_COVARIANCE][belief.log_w > -math.inf]
        )
        return belief

    def step(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief, StepInfo]:
        """Compute the belief after a measurement.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            record: Measurement and inputs of step t.
            draws: Random stream of the step.

        Returns:
            Belief at t and diagnostics.
        """
        method, inner = self._unwrap(model)
        belief = self._split(inner, belief, draws)
        used = belief.log_w > -math.inf
        x, covariance, log_like = _advance(method, inner, belief, used, record)
        joint = belief.log_w + log_like
        evidence = joint.logsumexp(1)
        is_valid = torch.isfinite(evidence).unsqueeze(1)
        log_w = torch.where(is_valid, joint - evidence.unsqueeze(1), belief.log_w)
        log_w = torch.where(log_w > math.log(_NEGLIGIBLE), log_w, -math.inf)
        log_w = log_w - log_w.logsumexp(1, keepdim=True)
        mean, mixture, _ = mixture_moments(inner.chart, Branches(x, covariance), log_w.exp())
        count = (log_w > -math.inf).sum(1).to(x)
        log_z = belief.log_evidence + evidence
        new = ParticleBelief(x, log_w, log_z, memory={_COVARIANCE: covariance})
        if self.merge:
            new = self._merged(inner, new, mean, mixture)
        if inner is not model:
            mixture = change_covariance(inner.chart, model.chart, mean, mixture)
        variance, trace = mixture.diagonal(dim1=-2, dim2=-1), {"components": count}
        return new, StepInfo(mean, variance, lambda: mixture, trace)

    def _unwrap(self, model: StateSpaceModel) -> tuple[GaussianFilter, StateSpaceModel]:
        """Return the Gaussian filter, and the model in its chart."""
        if isinstance(self.filter, InvariantFilter):
            assert isinstance(self.filter.filter, GaussianFilter)
            return self.filter.filter, ChartModel(model, self.filter.chart)
        return self.filter, model

    def _sampled(self, model: StateSpaceModel) -> list[int]:
        """Return the indices of the sampled states."""
        sampled = partition_state(model, self.sampled_states).sampled_states
        units = sorted({model.units[i] for i in sampled})
        require(
            len(units) == 1,
            "filter.sampled_states",
            "have one unit, that of largest_sd",
            f"{units} of {list(self.sampled_states)}",
            "Select states of one unit.",
        )
        return sampled

    def _split(
        self, model: StateSpaceModel, belief: ParticleBelief, draws: RandomStream
    ) -> ParticleBelief:
        """Resample and split the runs whose particles have too large a variance."""
        sampled, covariance = self._sampled(model), belief.memory[_COVARIANCE]
        w, n = belief.log_w.exp(), self.particles
        variance = covariance.diagonal(dim1=-2, dim2=-1)[..., sampled]
        mean_variance = (w.unsqueeze(-1) * torch.where(w.unsqueeze(-1) > 0, variance, 0.0)).sum(1)
        rows = torch.nonzero((mean_variance > self.largest_sd**2).any(-1)).squeeze(-1)
        if not len(rows):
            return belief
        ancestors = Systematic()(w, torch.full_like(w[:, :1], n, dtype=torch.long), draws)[rows]
        z = self.points(draws).normal("split", n, len(sampled)).to(w)[rows]
        at = rows.unsqueeze(1)
        x, (root, is_valid) = belief.x[at, ancestors], factor(covariance[at, ancestors])
        root = torch.where(is_valid[..., None, None], root, torch.nan)  # the run is lost
        columns, root = split_root(root, sampled, 0.5 * self.largest_sd)
        shift = (torch.stack(columns, -1) @ z.unsqueeze(-1)).squeeze(-1)
        root = move_root(model.chart, *(a.flatten(0, 1) for a in (x, shift, root)))
        root = root.unflatten(0, (len(rows), n))
        return belief._replace(
            x=belief.x.index_copy(0, rows, model.chart.add(x, shift)),
            log_w=belief.log_w.index_copy(0, rows, torch.full_like(w[rows], -math.log(n))),
            memory={_COVARIANCE: covariance.index_copy(0, rows, root @ root.mT)},
        )

    def _merged(
        self, model: StateSpaceModel, belief: ParticleBelief, mean: Tensor, covariance: Tensor
    ) -> ParticleBelief:
        """Replace mixtures with a small variance of the sampled states by their moments."""
        variance = covariance.diagonal(dim1=-2, dim2=-1)[:, self._sampled(model)]
        merged = (variance <= (0.5 * self.largest_sd) ** 2).all(-1).unsqueeze(1)
        x = torch.where(merged.unsqueeze(-1), mean.unsqueeze(1), belief.x)
        parts = torch.where(
            merged[..., None, None], covariance.unsqueeze(1), belief.memory[_COVARIANCE]
        )
        log_w = torch.where(merged, _first_alone(belief.log_w), belief.log_w)
        return belief._replace(x=x, log_w=log_w, memory={_COVARIANCE: parts})


def _first_alone(template: Tensor) -> Tensor:
    """Return log weights [R, N] of the first particle alone."""
    rest = torch.full_like(template[:, 1:], -math.inf)
    return torch.cat([torch.zeros_like(template[:, :1]), rest], 1)


def _advance(
    method: GaussianFilter,
    model: StateSpaceModel,
    belief: ParticleBelief,
    used: Tensor,
    record: Record,
) -> tuple[Tensor, Tensor, Tensor]:
    """Take a step of the Gaussian filter of each used particle, as runs of one batch.

    Returns means [R, N, D], covariances [R, N, d, d] and log evidences of the step [R, N].
    """
    runs, (row, _) = len(used), used.nonzero(as_tuple=True)

    def repeat(a: Tensor) -> Tensor:
        return a[row] if len(a) == runs else a

    folded = Record(repeat(record.y), map_inputs(repeat, record.u))
    zero = belief.x.new_zeros(len(row), dtype=torch.float64)
    covariance = belief.memory[_COVARIANCE]
    new = method.advance(model, GaussianBelief(belief.x[used], covariance[used], zero), folded)
    log_like = torch.full_like(belief.log_w, -math.inf).masked_scatter(
        used, new.log_likelihood.to(belief.log_w)
    )
    x, roots = belief.x.clone(), covariance.clone()
    x[used], roots[used] = new.mean, new.root @ new.root.mT
    return x, roots, log_like
