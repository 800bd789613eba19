"""Gaussian particle filter, whose belief is a normal distribution.

As stages: the resampler draws particles from the normal distribution with the old mean and
covariance, and the proposal propagates them. The belief stores two moments only, so moves, which
need the past of particles, are impossible. On linear-Gaussian models the filter converges to the
Kalman filter.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.chart import Chart
from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, weighted_mean_cov
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.particle.stages import (
    BootstrapProposal,
    IidPoints,
    PointSet,
    Proposal,
    ProposalSample,
    Resampler,
    deactivate_invalid_particles,
)
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class GaussianResampler(Resampler):
    """Equally weighted particles from N(mean, covariance) of the old ones.

    The distribution is normal in the chart. Low-discrepancy points give the quasi-Monte-Carlo Gaussian
    particle filter [Guo and Wang 2006]. Resampling probabilities are ignored. A covariance without
    Cholesky factor loses the run.

    Attributes:
        points: Point set of the d normal coordinates of each particle.

    References:
        Kotecha and Djuric 2003, "Gaussian particle filtering".
    """

    points: PointSet = field(default_factory=IidPoints)
    is_exact = False  # unless the posterior is normal

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        refuse_history(belief, "a Gaussian particle filter")
        x, ok = _draw_from_normal(model.chart, belief, self.points(draws), "gaussian")
        slots = torch.arange(belief.x.shape[1], device=x.device)
        log_w = torch.where((slots < n) & ok.unsqueeze(-1), -torch.log(n.to(x.dtype)), -torch.inf)
        return belief._replace(x=x, log_w=log_w), torch.ones_like(ok)


@dataclass(frozen=True)
class GaussianPredictionProposal(Proposal):
    """Noise of the model, and optionally particles from the predicted normal.

    With the second draw q = N(predicted mean, covariance), so the weight p(y | x) N(x; predicted) /
    q(x) is p(y | x). Without it the propagated particles are weighted. In both cases the ratio is
    0.

    Attributes:
        points: Point set of noise and second draw. The noise uses the axes after those of the
            resampler, so states and noises are points of one set.
        redraw_after_prediction: True draws again, as published.

    References:
        Kotecha and Djuric 2003. Pu and Qin, "Application of quasi Monte Carlo polymerization
        re-sampling particle filter algorithm in airborne passive location", eqs 14-16.
    """

    points: PointSet = field(default_factory=IidPoints)
    redraw_after_prediction: bool = True
    has_bounded_weights = True  # the ratio is 0

    @property
    @override
    def is_exact(self) -> bool:
        """True if the particles are those of the model."""
        return not self.redraw_after_prediction and is_every_part_exact(
            **{"proposal.points": self.points}
        )

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        first = BootstrapProposal()(
            model, belief, record, self.points(draws, model.chart.dimension)
        )
        if not self.redraw_after_prediction:
            return first
        # one NaN would spread to all particles
        x, log_w = deactivate_invalid_particles(first.x, belief.log_w, belief.x)
        predicted = belief._replace(x=x, log_w=log_w)
        x, ok = _draw_from_normal(model.chart, predicted, self.points(draws), "predicted")
        log_ratio = torch.where(ok.unsqueeze(-1), first.log_ratio, -torch.inf)
        return ProposalSample(x, log_ratio, belief.memory)


def _draw_from_normal(
    chart: Chart, belief: ParticleBelief, draws: RandomStream, purpose: str
) -> tuple[Tensor, Tensor]:
    """Draw particles from the normal distribution of a belief; mask valid runs [R]."""
    mean, covariance = weighted_mean_cov(chart, belief)
    root, ok = factor(covariance)
    z = draws.normal(purpose, belief.x.shape[1], covariance.shape[-1])
    return chart.add(mean.unsqueeze(1), z @ root.mT), ok


def refuse_history(belief: ParticleBelief, method_name: str) -> None:
    """Check that particles store no window and no memory of their own."""
    stored = [
        *belief.window,
        *(name for name, value in belief.memory.items() if value.shape[1] != 1),
    ]
    require(
        not stored,
        "filter.resampler",
        f"copy particles that store {', '.join(stored)}",
        f"{method_name}, which draws new ones without a past",
        "Choose a proposal without memory and no moves, or another resampler.",
    )
