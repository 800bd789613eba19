"""What becomes of a swarm's weights: the finished swarm as it is, or as the centres of a proposal with a known density.

As printed, particles are weighed as if they had not been moved: the measurement counts twice and the prediction not at all, and
the estimate becomes the measurement [Tian et al., "Improved adaptive particle filter for integrated navigation system"].
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.coordinates import Frame, rooted
from pfbench.filter.defensive import kept
from pfbench.filter.whitening import half_square, whiten

_PAIRS, _PAIRS_CUDA = 2**17, 2**27  # distances held at a time: those of a CPU stay in its cache, ten times faster


class Weights(Protocol):
    """Where the swarm ended, q [R, N, k] with log likelihood [R, N] -> where particles go and their log p - log q."""

    @property
    def exact(self) -> bool: ...

    def __call__(
        self, frame: Frame, q: Tensor, log_likelihood: Tensor, log_w: Tensor, draws: Draws
    ) -> tuple[Tensor, Tensor]: ...


@dataclass(frozen=True)
class Printed:
    """The move is ignored [Tian et al., eqs. 38 and 45]. Does not converge to the posterior."""

    exact = False

    def __call__(self, frame: Frame, q: Tensor, log_likelihood: Tensor, log_w: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
        return q, torch.zeros_like(log_w)


@dataclass(frozen=True)
class Equal:
    """Weights stay what they were: takes back the likelihood that `Bayes` will put on. Shows what the swarm alone does [ours]."""

    exact = False

    def __call__(self, frame: Frame, q: Tensor, log_likelihood: Tensor, log_w: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
        return q, torch.where(torch.isfinite(log_likelihood), -log_likelihood, 0.0)


@dataclass(frozen=True)
class Mixture:
    """The finished swarm is the centres of a proposal; a fraction of the predicted cloud is kept as it is [ours].

    In whitened coordinates a, p = N(0, I) for the prediction, m_j for the swarm, and h the optimal Gaussian bandwidth of N points
    in k dimensions [Silverman 1986]:

        log ratio = log p(a) - log(keep p(a) + (1 - keep) sum_j w_j N(a; m_j, h^2 I)),

    a deterministic mixture, at most -log keep. Converges to the posterior where the predicted cloud is normal, as on
    linear-Gaussian models, and all that the measurement does not see follows (`Observed`); elsewhere p is an approximation.
    Costs N^2 k. In many dimensions few particles carry all the weight: not for 18.

    Args:
        keep: fraction kept; who is, is drawn afresh in each step, since neighbours in a resampled cloud are siblings. 1 makes
            it the bootstrap filter.

    Raises:
        ValueError: a fraction that is not above 0 and at most 1.
    """

    keep: float = 0.5

    def __post_init__(self) -> None:
        if not 0.0 < self.keep <= 1.0:
            raise ValueError(f"weights.keep={self.keep}: give a fraction above 0, up to 1")

    @property
    def exact(self) -> bool:
        return self.keep == 1.0

    def __call__(self, frame: Frame, q: Tensor, log_likelihood: Tensor, log_w: Tensor, draws: Draws) -> tuple[Tensor, Tensor]:
        n, k = q.shape[1:]
        root = rooted(frame.covariance)
        before, centres = whiten(frame.q, root), whiten(q, root)
        live = torch.isfinite(log_w)
        stay = kept(self.keep, live, draws, "swarm.keep")
        h = (4.0 / (k + 2)) ** (1.0 / (k + 4)) * live.sum(1, keepdim=True).to(q.dtype) ** (-1.0 / (k + 4))  # [R, 1]
        a = centres + h.unsqueeze(-1) * draws.normal("swarm.kernel", n, k)
        a = torch.where(stay.who.unsqueeze(-1), before, a)
        log_g = _kernels(a / h.unsqueeze(-1), centres / h.unsqueeze(-1), torch.log_softmax(log_w, 1)) - k * torch.log(h)
        log_p = -half_square(a)
        log_ratio = log_p - stay.log_mixture(log_p, log_g)
        return torch.where(stay.who.unsqueeze(-1), frame.q, a @ root.mT), log_ratio


def _kernels(a: Tensor, centres: Tensor, log_w: Tensor) -> Tensor:
    """log sum_j w_j exp(-|a - m_j|^2 / 2): a [R, N, k], centres [R, M, k], log_w [R, M] -> [R, N]; N M numbers at a time."""
    rows = max(1, (_PAIRS_CUDA if a.is_cuda else _PAIRS) // (centres.shape[0] * centres.shape[1]))
    base = (log_w - 0.5 * centres.square().sum(-1)).unsqueeze(1)
    parts = [torch.baddbmm(base, part, centres.mT).logsumexp(-1) for part in a.split(rows, 1)]
    return torch.cat(parts, 1) - 0.5 * a.square().sum(-1)
