"""Base of the filters of several hypotheses: K weighted normal distributions of each run.

They lie about the estimate, and the evidence is a density of the measurements.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import torch
from torch import Tensor

from pfbench.core.covariance import squared_length
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief, StepInfo
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import LinearisationRule, TaylorLinearisation
from pfbench.filter.robust.hypotheses import (
    Branches,
    BranchSteps,
    NoiseHypotheses,
    advance_branches,
    mixture_moments,
)
from pfbench.model.base import StateSpaceModel

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

        Args:
            model: State-space model.
            runs: Number of runs R.
            draws: Random stream, not used.
            start: States about which the initial distribution is placed, [R, D].
            spread: Cholesky factors of the initial covariances, [R, d, d].

        Returns:
            The belief.

        Raises:
            ValueError: If mean or variance of the initial or the noise distribution is not finite.
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
        """Compute the belief after a measurement.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            record: Measurement and inputs of step t.
            draws: Random stream of the step.

        Returns:
            Belief at t and diagnostics.
        """
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
        """Return log probabilities of hypothesis j after i, [M, M].

        Args:
            template: Tensor of the dtype and device.
        """
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

    Args:
        offset: Means minus the estimate, [R, K, d].
        covariance: Covariances, [R, K, d, d].
        log_weight: Log weights, [R, K].
        log_next: Log probabilities of the next hypothesis, [R, K, M].
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
