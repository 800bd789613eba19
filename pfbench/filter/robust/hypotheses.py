"""Hypotheses on the noise, each with a factor on Q and on R, stepped together as further runs."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.chart import Chart
from pfbench.core.linear_algebra import squared_length
from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record, map_inputs
from pfbench.filter.belief import GaussianBelief, StepInfo
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.linearisation_rules import (
    AffineApproximation,
    LinearisationRule,
    TaylorLinearisation,
)
from pfbench.filter.robust.updates import scale_process_noise
from pfbench.model.base import StateSpaceModel

_ROUNDING = 1e-9  # of the sum of a row


@dataclass(frozen=True)
class NoiseHypotheses:
    """Hypotheses and the Markov chain of the one that holds.

    Attributes:
        process_factors: Factor on Q of each hypothesis, [M].
        measurement_factors: Factor on R of each hypothesis, [M].
        transition: Probability of hypothesis j after hypothesis i, M rows. With equal rows the
            hypothesis of a step does not depend on the past, as for single outliers.

    Raises:
        ValueError: If lengths differ, a factor is not positive, a row is not a distribution, or
            the chain has several stationary distributions.
    """

    process_factors: Sequence[float] = (1.0, 1.0)
    measurement_factors: Sequence[float] = (1.0, 100.0)
    transition: Sequence[Sequence[float]] = ((0.95, 0.05), (0.95, 0.05))

    def __post_init__(self) -> None:
        for name in ("process_factors", "measurement_factors"):
            factors = getattr(self, name)
            require(
                not len(factors) < 2 and all(0.0 < f < float("inf") for f in factors),
                f"hypotheses.{name}",
                "be at least two positive numbers",
                list(factors),
                "Use 1 for the model's noise.",
            )
        m = len(self.process_factors)
        require(
            len(self.measurement_factors) == m,
            "hypotheses.measurement_factors",
            "be as many as process_factors",
            f"{len(self.measurement_factors)} and {m}",
            "Give both for each hypothesis.",
        )
        matrix: Any = self.transition  # of a configuration: anything
        rows = [list(r) if _is_row(r) else r for r in matrix] if _is_row(matrix) else [matrix]
        is_square = len(rows) == m and all(_is_row(row) and len(row) == m for row in rows)
        require(
            is_square
            and all(
                min(row) >= 0.0 and max(row) <= 1.0 and abs(sum(row) - 1.0) <= _ROUNDING
                for row in rows
            ),
            "hypotheses.transition",
            f"be {m} rows of {m} probabilities with sum 1",
            rows,
            "Correct the rows.",
        )
        flow = np.array(rows) - np.eye(m)
        require(
            not np.linalg.matrix_rank(flow, tol=_ROUNDING) < m - 1,
            "hypotheses.transition",
            "have one stationary distribution",
            rows,
            "Let each hypothesis be reached from the others.",
        )

    def start_probabilities(self) -> list[float]:
        """Return the stationary distribution, [M]."""
        p = np.array(self.transition, dtype=float)
        m = len(p)
        system = np.concatenate([p.T - np.eye(m), np.ones((1, m))])
        stationary = np.linalg.lstsq(system, np.eye(m + 1)[m], rcond=None)[0].clip(min=0.0)
        return (stationary / stationary.sum()).tolist()


def _is_row(row: Any) -> bool:
    """Return whether a row of a matrix is a sequence."""
    return isinstance(row, Sequence) and not isinstance(row, str)


class Branches(NamedTuple):
    """Normal distributions of K branches of each run.

    Attributes:
        mean: [R, K, D].
        covariance: [R, K, d, d].
    """

    mean: Tensor
    covariance: Tensor


class BranchSteps(NamedTuple):
    """Results of a step of all branches.

    Attributes:
        branches: Branches after the step.
        log_likelihood: Log evidence of each branch, [R, K]; -inf without a root.
        r: Innovations, [R, K, k].
        covariance: Innovation covariances, [R, K, k, k].
        observed_mask: Observed components, [R, k].
    """

    branches: Branches
    log_likelihood: Tensor
    r: Tensor
    covariance: Tensor
    observed_mask: Tensor


@dataclass(frozen=True)
class _BranchNoise(NoiseAdaptation):
    """Factors on Q and R of each folded run, from the memory of its belief."""

    has_evidence = True  # the factors do not depend on the measurement

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        return scale_process_noise(predicted, belief.memory["process_factor"])

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        factor = belief.memory["measurement_factor"]
        return innovation.with_noise(innovation.noise * factor[:, None, None]), {}


def advance_branches(
    linearisation: LinearisationRule,
    model: StateSpaceModel,
    branches: Branches,
    factors: tuple[Tensor, Tensor],
    record: Record,
) -> BranchSteps:
    """Take a step of a Gaussian filter for all branches, folded into the axis of runs.

    Returns the results. Shapes: branches [R, K, ...], factors [K].
    """
    runs, k = branches.mean.shape[:2]

    def repeat(a: Tensor) -> Tensor:
        return a.repeat_interleave(k, 0) if len(a) == runs else a

    folded = Record(repeat(record.y), map_inputs(repeat, record.u))
    memory = {
        name: factor.to(branches.mean).repeat(runs)
        for name, factor in zip(("process_factor", "measurement_factor"), factors, strict=True)
    }
    zero = branches.mean.new_zeros(runs * k, dtype=torch.float64)
    belief = GaussianBelief(
        branches.mean.flatten(0, 1), branches.covariance.flatten(0, 1), zero, memory
    )
    step = GaussianFilter(linearisation, [_BranchNoise()]).advance(model, belief, folded)
    innovation = step.innovation
    s = innovation.m @ innovation.m.mT + innovation.omega

    def unfold(a: Tensor) -> Tensor:
        return a.unflatten(0, (runs, k))

    after = Branches(unfold(step.mean), unfold(step.root @ step.root.mT))
    log_like, mask = unfold(step.log_likelihood), unfold(innovation.observed_mask)[:, 0]
    return BranchSteps(after, log_like, unfold(innovation.r), unfold(s), mask)


def mixture_moments(
    chart: Chart, branches: Branches, weight: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute mean and covariance of a mixture.

    Returns mean [R, D], covariance [R, d, d], and the offsets of the components from the mean
    [R, K, d]. Shapes: branches [R, K, ...], weight [R, K].
    """
    heaviest = weight.argmax(1)
    centre = branches.mean[torch.arange(len(weight), device=weight.device), heaviest]
    used = (weight > 0).unsqueeze(-1)
    offset = torch.where(used, chart.subtract(branches.mean, centre.unsqueeze(1)), 0.0)
    shift = (weight.unsqueeze(-1) * offset).sum(1)
    offset = offset - shift.unsqueeze(1)
    spread = offset.unsqueeze(-1) * offset.unsqueeze(-2)
    parts = torch.where(used.unsqueeze(-1), branches.covariance + spread, 0.0)
    covariance = (weight[..., None, None] * parts).sum(1)
    return chart.add(centre, shift), covariance, offset


# --------------------------------------------------------------------------------------------------
# Base of the filters of several hypotheses: K weighted normal distributions of each run.
#
# They lie about the estimate, and the evidence is a density of the measurements.

OFFSET = "branch_offset"  # memory: branch means minus the estimate, [R, K, d]


@dataclass(frozen=True)
class HypothesisFilter(ABC):
    """Base of the filters of several hypotheses.

    Attributes:
        hypotheses: Factors on the noise, and their Markov chain.
        linearisation: Linearisation rule of all branches.
    """

    hypotheses: NoiseHypotheses = field(default_factory=NoiseHypotheses)
    linearisation: LinearisationRule = field(default_factory=TaylorLinearisation)
    is_exact = False  # branches are merged or discarded
    has_evidence = True

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> GaussianBelief:
        """Compute the belief at step 0: equal branches, and the stationary distribution of hypotheses.

        Shapes: start [R, D], spread [R, d, d].
        """
        belief = GaussianFilter(self.linearisation).init(model, runs, draws, start, spread)
        log_law = (
            torch.tensor(self.hypotheses.start_probabilities(), dtype=torch.float64)
            .to(belief.mean)
            .log()
        )
        log_w, log_next = self._start(log_law)
        k = len(log_w)
        memory = branch_memory(
            belief.covariance.new_zeros(runs, k, belief.covariance.shape[-1]),
            belief.covariance.unsqueeze(1).repeat(1, k, 1, 1),
            log_w.repeat(runs, 1),
            log_next.repeat(runs, 1, 1),
        )
        return belief._replace(memory=memory)

    def step(
        self, model: StateSpaceModel, belief: GaussianBelief, record: Record, draws: RandomStream
    ) -> tuple[GaussianBelief, StepInfo]:
        """Compute the belief after a measurement."""
        branches, number, log_prior = self._predict_branches(model, belief)
        parts = self.hypotheses.process_factors, self.hypotheses.measurement_factors
        factors = [torch.tensor(f, dtype=torch.float64).to(belief.mean)[number] for f in parts]
        steps = advance_branches(
            self.linearisation, model, branches, (factors[0], factors[1]), record
        )
        joint = log_prior + steps.log_likelihood
        evidence = joint.logsumexp(1)
        log_w = torch.where(torch.isfinite(evidence)[:, None], joint - evidence[:, None], log_prior)
        mean, covariance, offset = mixture_moments(model.chart, steps.branches, log_w.exp())
        memory = self._keep(log_w, offset, steps.branches.covariance, number, draws)
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        trace = {"hypothesis": (log_w.exp() * (number > 0)).sum(1)}
        prior = log_prior.exp()
        info = StepInfo(mean, variance, lambda: covariance, trace, nis=lambda: _nis(steps, prior))
        log_z = belief.log_evidence + evidence
        return GaussianBelief(mean, covariance, log_z, memory), info

    def log_transition(self, template: Tensor) -> Tensor:
        """Return log probabilities of hypothesis j after i, [M, M]."""
        rows = [list(row) for row in self.hypotheses.transition]
        return torch.tensor(rows, dtype=torch.float64).to(template).log()

    @abstractmethod
    def _start(self, log_law: Tensor) -> tuple[Tensor, Tensor]:
        """Return log weights [K] and log probabilities of the next hypothesis of each branch [K, M]."""

    @abstractmethod
    def _predict_branches(
        self, model: StateSpaceModel, belief: GaussianBelief
    ) -> tuple[Branches, Tensor, Tensor]:
        """Return branches [R, L, ...], their hypotheses [L] and log prior weights [R, L]."""

    @abstractmethod
    def _keep(
        self,
        log_w: Tensor,
        offset: Tensor,
        covariance: Tensor,
        number: Tensor,
        draws: RandomStream,
    ) -> dict[str, Tensor]:
        """Return the memory of K branches of L updated ones."""


def branch_memory(
    offset: Tensor, covariance: Tensor, log_weight: Tensor, log_next: Tensor
) -> dict[str, Tensor]:
    """Return the memory of branches by name.

    Shapes: offset [R, K, d], covariance [R, K, d, d], log_weight [R, K], log_next [R, K, M].
    """
    return {
        OFFSET: offset,
        "branch_covariance": covariance,
        "branch_log_weight": log_weight,
        "branch_log_next": log_next,
    }


def _nis(steps: BranchSteps, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the NIS of the moments of the predicted mixture, and the observed components, [R]."""
    used = (weight > 0).unsqueeze(-1)
    r = torch.where(used, steps.r, 0.0)
    mean = (weight.unsqueeze(-1) * r).sum(1)
    deviation = torch.where(used, r - mean.unsqueeze(1), 0.0)
    s = torch.where(used[..., None], steps.covariance, 0.0)
    parts = s + deviation.unsqueeze(-1) * deviation.unsqueeze(-2)
    covariance = (weight[..., None, None] * parts).sum(1)
    return squared_length(mean, covariance), steps.observed_mask.sum(1)
