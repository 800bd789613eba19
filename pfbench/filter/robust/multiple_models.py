"""Filters of several hypotheses on the noise: interacting multiple models, and Gaussian sums.

Both keep K branches of each run: normal distributions about the estimate with weights. Their
evidence is a density of the measurements.

References:
    G. A. Ackerson, K. S. Fu 1970, "On state estimation in switching environments".
    H. A. P. Blom, Y. Bar-Shalom 1988, "The interacting multiple model algorithm for systems with
        Markovian switching coefficients".
    D. L. Alspach, H. W. Sorenson 1972, "Nonlinear Bayesian estimation using Gaussian sum
        approximations".
    R. Chen, J. S. Liu 2000, "Mixture Kalman filters".
    P. Fearnhead, P. Clifford 2003, "On-line inference for hidden Markov models via particle
        filters".
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.robust.hypotheses import OFFSET, Branches, HypothesisFilter, branch_memory
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class InteractingModelFilter(HypothesisFilter):
    """Interacting multiple models, IMM [Blom and Bar-Shalom 1988]: one branch per hypothesis.

    Before a step the branches are mixed by the probabilities of the last hypothesis given the next
    one. With equal rows of the chain all branches start from the estimate, which is the generalised
    pseudo-Bayesian filter of first order, GPB1 [Ackerson and Fu 1970].
    """

    @override
    def _start(self, log_law: Tensor) -> tuple[Tensor, Tensor]:
        return log_law, self.log_transition(log_law)

    @override
    def _predict_branches(
        self, model: StateSpaceModel, belief: GaussianBelief
    ) -> tuple[Branches, Tensor, Tensor]:
        memory = belief.memory
        joint = memory["branch_log_weight"].unsqueeze(2) + memory["branch_log_next"]  # [R, i, j]
        log_prior = joint.logsumexp(1)
        weight = (joint - log_prior.unsqueeze(1)).exp().nan_to_num()
        used = (memory["branch_log_weight"] > -torch.inf)[..., None]
        offset = torch.where(used, memory[OFFSET], 0.0)
        mixed = weight.mT @ offset
        deviation = offset.unsqueeze(1) - mixed.unsqueeze(2)  # [R, j, i, d]
        covariance = torch.where(used[..., None], memory["branch_covariance"], 0.0).unsqueeze(1)
        parts = covariance + deviation.unsqueeze(-1) * deviation.unsqueeze(-2)
        covariance = (weight.mT[..., None, None] * parts).sum(2)
        number = torch.arange(weight.shape[1], device=weight.device)
        return (
            Branches(model.chart.add(belief.mean.unsqueeze(1), mixed), covariance),
            number,
            log_prior,
        )

    @override
    def _keep(
        self,
        log_w: Tensor,
        offset: Tensor,
        covariance: Tensor,
        number: Tensor,
        draws: RandomStream,
    ) -> dict[str, Tensor]:
        log_next = self.log_transition(log_w).expand(len(log_w), -1, -1)
        return branch_memory(offset, covariance, log_w, log_next)


@dataclass(frozen=True)
class GaussianSumFilter(HypothesisFilter):
    """Gaussian sum: each branch is continued with each hypothesis, and the heaviest are kept.

    With as many branches as sequences of hypotheses it is the exact mixture on a linear model. The
    evidence of a step is that of the branches that were kept, so discarding makes it no bound.

    Attributes:
        branches: Number K of branches that are kept.

    Raises:
        ValueError: If the number is below 1.
    """

    branches: int = 8

    def __post_init__(self) -> None:
        require_ranges("filter", self, branches="whole [1, inf) Use 8.")

    @override
    def _start(self, log_law: Tensor) -> tuple[Tensor, Tensor]:
        log_w = log_law.new_full((self.branches,), -torch.inf)
        log_w[0] = 0.0
        return log_w, log_law.expand(self.branches, -1)

    @override
    def _predict_branches(
        self, model: StateSpaceModel, belief: GaussianBelief
    ) -> tuple[Branches, Tensor, Tensor]:
        memory = belief.memory
        m = memory["branch_log_next"].shape[-1]
        log_prior = (memory["branch_log_weight"].unsqueeze(2) + memory["branch_log_next"]).flatten(
            1
        )
        offset = memory[OFFSET].repeat_interleave(m, 1)
        mean = model.chart.add(belief.mean.unsqueeze(1), offset)
        covariance = memory["branch_covariance"].repeat_interleave(m, 1)
        number = torch.arange(m, device=log_prior.device).repeat(self.branches)
        return Branches(mean, covariance), number, log_prior

    @override
    def _keep(
        self,
        log_w: Tensor,
        offset: Tensor,
        covariance: Tensor,
        number: Tensor,
        draws: RandomStream,
    ) -> dict[str, Tensor]:
        index, log_weight = self._select(log_w, draws)
        rows = index[..., None]
        log_next = self.log_transition(log_w)[number[index]]
        used = (log_weight > -torch.inf)[..., None]
        offset = torch.where(used, offset.gather(1, rows.expand(-1, -1, offset.shape[-1])), 0.0)
        covariance = covariance.gather(1, rows[..., None].expand(-1, -1, *covariance.shape[2:]))
        heaviest = covariance[:, :1].expand_as(covariance)  # of branches that are never used again
        return branch_memory(
            offset, torch.where(used[..., None], covariance, heaviest), log_weight, log_next
        )

    def _select(self, log_w: Tensor, draws: RandomStream) -> tuple[Tensor, Tensor]:
        """Return the indices of the kept branches [R, K], the heaviest first, and log weights."""
        heaviest = log_w.topk(self.branches, 1)
        return heaviest.indices, heaviest.values - heaviest.values.logsumexp(1, keepdim=True)


@dataclass(frozen=True)
class MixtureKalmanFilter(GaussianSumFilter):
    """Rao-Blackwellised particle filter with a discrete state, mixture Kalman filter.

    A particle is a sequence of hypotheses with its Gaussian filter [Chen and Liu 2000]. Each is
    continued with each hypothesis and weighed by its evidence, so that no hypothesis is drawn
    without the measurement. K of the K M continuations are drawn by the resampling of Fearnhead and
    Clifford (2003), which keeps the heavy ones. On a linear model the evidence is unbiased, which
    that of the heaviest sequences is not.
    """

    @override
    def _select(self, log_w: Tensor, draws: RandomStream) -> tuple[Tensor, Tensor]:
        return select_unbiased(log_w, self.branches, draws.uniform("branch", 1, 1)[..., 0])


def select_unbiased(log_w: Tensor, count: int, level: Tensor) -> tuple[Tensor, Tensor]:
    """Draw distinct weighted numbers such that expected weights are the weights.

    A weight above the threshold 1 / c is kept. The others are drawn with probability c w by
    systematic resampling, and receive the weight 1 / c. The expected squared error of the weights
    is the smallest one [Fearnhead and Clifford 2003].

    Returns indices [R, K], the heaviest first, and log weights [R, K]. Where fewer than K weights
    are positive, the last ones are -inf. Shapes: log_w [R, L], level [R, 1].
    """
    w, order = log_w.exp().sort(1, descending=True)
    rest = w.flip(1).cumsum(1).flip(1)[:, :count]  # sum of the weights from each one on
    slots = torch.arange(count, 0, -1, device=w.device).to(w)
    heavy_count = (w[:, :count] * slots <= rest).to(torch.int8).argmax(1, keepdim=True)
    threshold = rest.gather(1, heavy_count) / slots.to(w)[heavy_count]
    probability = torch.where(threshold > 0.0, w / threshold, (w > 0.0).to(w)).clamp(max=1.0)
    probability = torch.where(
        torch.arange(w.shape[1], device=w.device) < heavy_count, 1.0, probability
    )
    target = torch.arange(count, device=w.device) + level.to(w)
    index = torch.searchsorted(probability.cumsum(1), target, right=True)
    index = index.clamp(max=w.shape[1] - 1)
    weight = torch.where(
        torch.arange(count, device=w.device) < heavy_count,
        w.gather(1, index),
        threshold.expand_as(index),
    )
    return order.gather(1, index), weight.log()
