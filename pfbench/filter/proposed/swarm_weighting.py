"""Weights of a particle swarm: as printed, or as a proposal with a known density.

As printed, particles are weighted as if they had not moved. The measurement then counts twice
and the prediction not at all, and the estimate becomes the measurement [Tian et al., "Improved
adaptive particle filter for integrated navigation system"].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.filter.particle.proposals import choose_defensive_particles
from pfbench.filter.particle.regularised_resampling import GaussianSmoothing
from pfbench.filter.proposed.swarm_coordinates import SwarmFrame, bounded_root
from pfbench.filter.whitening import compute_half_square, whiten
from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable

# distances per batch: on a CPU they stay in its cache, which is ten times as fast
_PAIRS, _PAIRS_CUDA = 2**17, 2**27


class SwarmWeighting(Protocol):
    """Weighting of the final swarm."""

    @property
    def is_exact(self) -> bool:
        """True if the weighted particles are asymptotically exact."""

    def __call__(
        self,
        frame: SwarmFrame,
        q: Tensor,
        log_w: Tensor,
        draws: RandomStream,
    ) -> tuple[Tensor, Tensor]:
        """Compute positions and density ratio of the particles.

        Args:
            frame: Coordinates of the swarm.
            q: Final positions, [R, N, k].
            log_w: Log weights before the measurement, [R, N].
            draws: Random stream of the step.

        Returns:
            Positions [R, N, k] and log p - log q [R, N].
        """


@dataclass(frozen=True)
class PrintedWeighting(SwarmWeighting):
    """Weights that ignore the move [Tian et al., eqs. 38 and 45].

    They do not converge to the posterior.
    """

    is_exact = False
    has_bounded_weights = True  # without a ratio

    @override
    def __call__(
        self,
        frame: SwarmFrame,
        q: Tensor,
        log_w: Tensor,
        draws: RandomStream,
    ) -> tuple[Tensor, Tensor]:
        return q, torch.zeros_like(log_w)


@dataclass(frozen=True)
class MixtureWeighting(SwarmWeighting):
    """Proposal centred on the final swarm, mixed with the predicted particles [ours].

    In whitened coordinates a, p = N(0, I) for the prediction, m_j for the swarm, and h the optimal
    Gaussian bandwidth of N points in k dimensions [Silverman 1986]:

        log ratio = log p(a) - log(c p(a) + (1 - c) sum_j w_j N(a; m_j, h^2 I)),

    with c the defensive fraction. The ratio of this deterministic mixture is at most -log c. The
    filter converges to the posterior if the predicted distribution is normal, as on linear-Gaussian
    models, and all unobserved components are regressed (`ObservedComponents`). Otherwise p is an
    approximation. The cost is N^2 k. In many dimensions (18, for example) few particles have
    weight.

    Attributes:
        defensive_fraction: Fraction of predicted particles that do not move, in (0, 1]. They are
            chosen at random in each step, since neighbours are siblings after resampling. 1 gives
            the bootstrap filter.

    Raises:
        ValueError: If the fraction is outside (0, 1].
    """

    defensive_fraction: float = 0.5

    def __post_init__(self) -> None:
        require_ranges(
            "proposal.weighting",
            self,
            defensive_fraction="(0, 1] Use 1 for the bootstrap proposal.",
        )

    @property
    @override
    def is_exact(self) -> bool:
        """True if the proposal is the bootstrap one."""
        return self.defensive_fraction == 1.0

    has_bounded_weights = True

    @override
    def __call__(
        self,
        frame: SwarmFrame,
        q: Tensor,
        log_w: Tensor,
        draws: RandomStream,
    ) -> tuple[Tensor, Tensor]:
        n, k = q.shape[1:]
        root = bounded_root(frame.covariance)
        predicted, centres = whiten(frame.q, root), whiten(q, root)
        active_mask = torch.isfinite(log_w)
        defensive = choose_defensive_particles(
            self.defensive_fraction, active_mask, draws, "swarm.keep"
        )
        count = active_mask.sum(1, keepdim=True).to(q.dtype)
        h = GaussianSmoothing().bandwidth(k, count)
        a = centres + h.unsqueeze(-1) * draws.normal("swarm.kernel", n, k)
        a = torch.where(defensive.mask.unsqueeze(-1), predicted, a)
        scaled, scaled_centres = a / h.unsqueeze(-1), centres / h.unsqueeze(-1)
        log_g = _mixture(scaled, scaled_centres, torch.log_softmax(log_w, 1)) - k * torch.log(h)
        log_p = -compute_half_square(a)
        log_ratio = log_p - defensive.log_mixture(log_p, log_g)
        return torch.where(defensive.mask.unsqueeze(-1), frame.q, a @ root.mT), log_ratio


def _log_sum_of_kernels(a: Tensor, centres: Tensor, log_w: Tensor) -> Tensor:
    """Compute log sum_j w_j exp(-|a - m_j|^2 / 2) [R, N], in batches of pairs."""
    rows = max(1, (_PAIRS_CUDA if a.is_cuda else _PAIRS) // (centres.shape[0] * centres.shape[1]))
    offset = (log_w - 0.5 * centres.square().sum(-1)).unsqueeze(1)
    batches = [
        torch.baddbmm(offset, rows_of_a, centres.mT).logsumexp(-1) for rows_of_a in a.split(rows, 1)
    ]
    return torch.cat(batches, 1) - 0.5 * a.square().sum(-1)


_mixture = compilable(_log_sum_of_kernels, operator=dispatch.log_mixture)
