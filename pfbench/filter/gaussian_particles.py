"""Gaussian particle filtering: what goes on from step to step is a normal law, and particles are only how it is integrated.

As stages of a particle filter: the refresh draws a new cloud from the normal law of the old one's mean and covariance, the
proposal carries it on. Of the cloud nothing but its two moments survives, so a law of another shape is lost, and particles have
no past. It is right where the posterior is normal: on linear-Gaussian models it tends to the Kalman filter.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from pfbench.chart import Chart
from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, moments
from pfbench.filter.particle import bury
from pfbench.filter.points import Independent, Points
from pfbench.filter.proposals import Bootstrap, Proposed
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


@dataclass(frozen=True)
class GaussianRefresh:
    """New particles of N(mean, covariance) of the weighted cloud, in the chart about the mean, all of one weight
    [Kotecha and Djuric 2003, "Gaussian particle filtering"].

    With points of low discrepancy it is the quasi-Monte-Carlo Gaussian particle filter's [Guo and Wang 2006]. It takes no notice
    of a preference: there are no particles to be preferred. A covariance without square root loses the run.

    Args:
        points: where the d normal coordinates of each particle come from.
    """

    points: Points = field(default_factory=Independent)
    exact = False  # on laws that are not normal

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        no_past(cloud, "a Gaussian particle filter")
        x, ok = _redrawn(model.chart, cloud, self.points(draws), "gaussian")
        slots = torch.arange(cloud.x.shape[1], device=x.device)
        log_w = torch.where((slots < n) & ok.unsqueeze(-1), -torch.log(n.to(x.dtype)), -torch.inf)
        return cloud._replace(x=x, log_w=log_w), torch.ones_like(ok)


@dataclass(frozen=True)
class GaussianPrediction:
    """The model's own noise, and then, if asked, once more new particles: of the normal law of those predicted.

    With the second draw particles come from q = N(predicted mean, covariance), and the weight p(y | x) N(x; predicted) / q(x)
    is p(y | x) [Kotecha and Djuric 2003; Pu and Qin, "Application of quasi Monte Carlo polymerization re-sampling particle filter
    algorithm in airborne passive location", eqs 14-16]. Without it the propagated particles themselves are weighed. Either way
    the ratio is 0.

    Args:
        points: where noise and second draw come from; the noise takes the axes behind those of the refresh, so that states and
            noises together are points of one set.
        second_draw: as published.
    """

    points: Points = field(default_factory=Independent)
    second_draw: bool = True

    @property
    def exact(self) -> bool:
        return not self.second_draw

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        first = Bootstrap()(model, cloud, seen, self.points(draws, model.chart.dimension))
        if not self.second_draw:
            return first
        x, log_w = bury(first.x, cloud.log_w, cloud.x)  # else one particle that is NaN would make all of them so
        x, ok = _redrawn(model.chart, cloud._replace(x=x, log_w=log_w), self.points(draws), "predicted")
        lost = torch.where(ok.unsqueeze(-1), first.log_ratio, -torch.inf)
        return Proposed(x, lost, cloud.memory)


def _redrawn(chart: Chart, cloud: Cloud, draws: Draws, purpose: str) -> tuple[Tensor, Tensor]:
    """As many particles as the cloud has slots, of its normal law, and whether its covariance has a square root [R]."""
    mean, covariance = moments(chart, cloud)
    root, ok = factor(covariance)
    z = draws.normal(purpose, cloud.x.shape[1], covariance.shape[-1])
    return chart.add(mean.unsqueeze(1), z @ root.mT), ok


def no_past(cloud: Cloud, who: str) -> None:
    """Refuses a cloud whose particles carry anything of their own.

    Raises:
        ValueError: it names what new particles could not carry on.
    """
    own = [*cloud.window, *(name for name, value in cloud.memory.items() if value.shape[1] != 1)]
    if own:
        raise ValueError(
            f"filter.resampler: the particles of {who} are new ones without a past, but this filter's carry {', '.join(own)}; "
            "choose a proposal without memory and leave out the moves, or another resampler"
        )
