"""The ensemble Kalman filter: a cloud of equal weights that is moved, not weighed, by the gain of its own sample moments.

It tends to the Kalman filter on linear-Gaussian models as N grows, at the rate 1/sqrt N. On any other it tends to a filter whose
update is linear in the measurement: it is not exact, and neither is its evidence. There is no localisation: it is for states of
tens of components, not of millions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.covariance import common_covariance_of, factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, Info
from pfbench.filter.gaussian import around_first
from pfbench.filter.linearisation import where_seen
from pfbench.filter.particle import ParticleFilter, bury, summarise
from pfbench.filter.proposals import Bootstrap
from pfbench.filter.whitening import LOG_2PI, log_det
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


class Forecast(NamedTuple):
    """The predicted ensemble against what was seen, in units of the measurement noise; 0 where unseen.

    Attributes:
        d: what each member differs by from their mean, in the chart [R, N, d].
        s: the same of what each member expects to be seen, over sqrt(N - 1): S'S is its sample covariance [R, N, k].
        r: what was seen, less what is expected on average [R, k].
        values, vectors: eigenvalues [R, k] and vectors [R, k, k] of S'S.
    """

    d: Tensor
    s: Tensor
    r: Tensor
    values: Tensor
    vectors: Tensor

    def gain(self) -> Tensor:
        """Transposed Kalman gain of the sample moments, on whitened measurements [R, k, d]."""
        inverse = self.vectors / (1.0 + self.values).unsqueeze(-2) @ self.vectors.mT
        return inverse @ (self.s.mT @ self.d) / math.sqrt(self.d.shape[1] - 1)


class Analysis(Protocol):
    """How members move: the forecast -> their differences from the predicted mean, once the measurement is known [R, N, d]."""

    def __call__(self, forecast: Forecast, draws: Draws) -> Tensor: ...


@dataclass(frozen=True)
class Perturbed:
    """Each member meets a measurement with errors of its own: x + K (y + e - h(x)), e ~ N(0, R)
    [Burgers, van Leeuwen and Evensen 1998, "Analysis scheme in the ensemble Kalman filter"].

    R is the model's, not the sample covariance of the errors drawn, and these are not centred. [ours]
    """

    def __call__(self, forecast: Forecast, draws: Draws) -> Tensor:
        n, k = forecast.s.shape[1:]
        e = draws.normal("perturbed", n, k).to(forecast.s)
        return forecast.d + (forecast.r.unsqueeze(1) + e - math.sqrt(n - 1) * forecast.s) @ forecast.gain()


@dataclass(frozen=True)
class SquareRoot:
    """The mean by the gain, the differences by T = (I + S S')^-1/2: no random numbers, and exactly the Kalman update of the
    ensemble's own mean and covariance [Bishop, Etherton and Majumdar 2001, "Adaptive sampling with the ensemble transform Kalman
    filter"].

    T is the symmetric root, since others shift the mean [Wang, Bishop and Julier 2004]; it is found from the k x k matrix S'S,
    not from N x N: with S'S = V diag(l) V', T = I - S V diag(1 / (q^2 + q)) V' S', q^2 = 1 + l. [ours]
    """

    def __call__(self, forecast: Forecast, draws: Draws) -> Tensor:
        d, s, r, values, vectors = forecast
        q2 = 1.0 + values
        shrink = vectors / (q2 + q2.sqrt()).unsqueeze(-2) @ vectors.mT
        return d - s @ (shrink @ (s.mT @ d)) + r.unsqueeze(1) @ forecast.gain()


@dataclass(frozen=True)
class EnsembleKalmanFilter:
    """Propagates members with the model's own noise, then moves them by the gain of their sample moments.

    The belief is a cloud of equal weights. The evidence is the normal density of each measurement under the predicted
    ensemble's mean and covariance. The measurement noise is the mean of the members' own, its law taken as normal; where only the
    noise tells of the state (stochastic volatility) the ensemble learns nothing. Covariances divide by N - 1. A member that is
    not finite goes on from where it was. [ours]

    Args:
        particles: N, the number of members.
        analysis: Perturbed, or SquareRoot.
        inflation: factor on the predicted differences from the mean, against a spread made too small by sampling
            [Anderson and Anderson 1999]; 1 leaves them.

    Raises:
        ValueError: fewer than two members, or an inflation that is not positive.
    """

    particles: int
    analysis: Analysis = field(default_factory=Perturbed)
    inflation: float = 1.0
    exact = False  # on nonlinear or non-Gaussian models; on linear-Gaussian ones it tends to the Kalman filter

    def __post_init__(self) -> None:
        if self.particles < 2:
            raise ValueError(f"filter.particles={self.particles}: give at least 2 members, or there is no covariance")
        if not 0.0 < self.inflation < math.inf:
            raise ValueError(f"filter.inflation={self.inflation}: give a positive factor; 1 leaves the spread as it is")

    def init(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None = None, spread: Tensor | None = None
    ) -> Cloud:
        """N members of the initial law: the same ones as a particle filter's."""
        return ParticleFilter(self.particles).init(model, runs, draws, start, spread)

    def step(self, model: StateSpaceModel, belief: Cloud, seen: Record, draws: Draws) -> tuple[Cloud, Info]:
        """The ensemble at t-1 and what is seen at t -> the ensemble at t, all members of one weight."""
        chart, n = model.chart, self.particles
        x, _ = bury(Bootstrap()(model, belief, seen, draws).x, belief.log_w, belief.x)
        mean = chart.mean(x, torch.full_like(belief.log_w, 1.0 / n)).unsqueeze(1)
        d = self.inflation * chart.subtract(x, mean)
        x = chart.add(mean, d) if self.inflation != 1.0 else x
        forecast, log_like = _look(model, x, d, seen)
        along = (forecast.r.unsqueeze(-2) @ forecast.vectors).squeeze(-2)
        moved = chart.add(mean, self.analysis(forecast, draws))
        sound = torch.isfinite(log_like) & torch.isfinite(moved).all(-1).all(-1)
        # a lost run stays lost (its evidence is -inf for good) but goes on from its prediction, so that nothing else breaks
        log_z = belief.log_z + torch.where(sound, log_like, -torch.inf)
        cloud = belief._replace(x=torch.where(sound[:, None, None], moved, x), log_z=log_z)
        info = summarise(model, cloud, {})
        wider = n / (n - 1)
        return cloud, info._replace(
            variance=wider * info.variance,
            covariance=lambda: wider * info.covariance(),
            some=lambda groups: wider * info.covariance_of(groups),
            nis=lambda: ((along.square() / (1.0 + forecast.values)).sum(-1), (~torch.isnan(seen.y)).sum(1)),
        )


def _look(model: StateSpaceModel, x: Tensor, d: Tensor, seen: Record) -> tuple[Forecast, Tensor]:
    """The forecast, and the log density [R] of what was seen under it; NaN where the measurement noise has no root."""
    law: Any = model.observation(x, seen.u)
    n = x.shape[1]
    even = d.new_full(d.shape[:2], 1.0 / n)
    y_hat = around_first(model.residual)(law.mean, even)
    there = ~torch.isnan(seen.y)
    r = torch.where(there, model.residual(seen.y.nan_to_num(), y_hat), 0.0)
    s = torch.where(there.unsqueeze(1), model.residual(law.mean, y_hat.unsqueeze(1)), 0.0)
    root, ok = factor(where_seen(common_covariance_of(law).mean(1), there))
    white = torch.linalg.solve_triangular(root, torch.cat([s.mT / math.sqrt(n - 1), r.unsqueeze(-1)], -1), upper=False)
    s, r = white[..., :-1].mT, white[..., -1]
    product = torch.where(torch.isfinite(s).all(1).all(-1)[:, None, None], s.mT @ s, torch.nan)
    # eigh raises for all runs where one has no numbers
    values, vectors = torch.linalg.eigh(torch.nan_to_num(product, 0.0, 0.0, 0.0))
    values = values.clamp(min=0.0)
    along = (r.unsqueeze(-2) @ vectors).squeeze(-2)
    scale = log_det(root) + 0.5 * values.log1p().sum(-1)
    known = there.sum(-1, dtype=r.dtype)
    log_like = -0.5 * (along.square() / (1.0 + values)).sum(-1) - scale - 0.5 * LOG_2PI * known
    ok = ok & torch.isfinite(product).all(-1).all(-1)
    return Forecast(d, s, r, values, vectors), torch.where(ok, log_like, torch.nan)
