"""The Gaussian filter: one prediction and one update for Kalman, extended, unscented and cubature filters."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Gaussian, Info
from pfbench.filter.rules import Linearised, Rule, Space
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.record import Record

_LOG_2PI = math.log(2.0 * math.pi)


class Innovation(NamedTuple):
    """r [R, k] = y - y_hat, 0 where unseen; seen [R, k]; M [R, k, d]; Omega [R, k, k] without the state's own spread."""

    r: Tensor
    seen: Tensor
    m: Tensor
    omega: Tensor


class Adaptation(Protocol):
    """A change of the filter's noise or gain, in the order in which a filter lists them. All hooks may be the identity.

    predict_scale: the predicted state's linearisation, before its noise is added -> the same, scaled.
    noise_adapt: the innovation -> the same with another noise covariance.
    """

    def predict_scale(self, predicted: Linearised, belief: Gaussian) -> Linearised: ...

    def noise_adapt(self, innovation: Innovation, belief: Gaussian) -> tuple[Innovation, dict[str, Tensor]]: ...


@dataclass(frozen=True)
class GaussianFilter:
    """Kalman filtering by statistical linearisation.

    The update is P+ = L (I + M' Omega^-1 M)^-1 L', whose middle has eigenvalues of at least 1: it stays positive for any
    prior, however ill-conditioned. A covariance with no square root marks the run `lost`; nothing is repaired in silence.

    Args:
        rule: Jacobian (EKF), Points(Unscented) or Points(Cubature).
        adaptations: fading, constrained noise; none by default.
    """

    rule: Rule
    adaptations: tuple[Adaptation, ...] = ()
    exact = False  # on nonlinear or non-Gaussian models; on linear-Gaussian ones it is the Kalman filter

    def init(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None = None, spread: Tensor | None = None
    ) -> Gaussian:
        """The moments of the initial law."""
        law: Any = initial_law(model, runs, spread)
        dense = isinstance(law, torch.distributions.MultivariateNormal)
        covariance = law.covariance_matrix if dense else torch.diag_embed(law.variance)
        origin = model.origin.expand(runs, -1) if start is None else start
        mean = model.chart.add(origin, law.mean)
        return Gaussian(mean, covariance, torch.zeros(runs, dtype=torch.float64, device=mean.device))

    def step(self, model: StateSpaceModel, belief: Gaussian, seen: Record, draws: Draws) -> tuple[Gaussian, Info]:
        """The belief at t-1 and what is seen at t -> the belief at t."""
        memory: dict[str, Tensor] = {}
        predicted, rooted = self._predict(model, belief, seen.u)
        for adaptation in self.adaptations:
            predicted = adaptation.predict_scale(predicted, belief)
        root, positive = factor(predicted.m @ predicted.m.mT + predicted.omega)
        innovation = self._look(model, predicted.y, root, seen)
        for adaptation in self.adaptations:
            innovation, carried = adaptation.noise_adapt(innovation, belief)
            memory |= carried
        shift, updated, log_like = update(innovation)
        spread = root @ updated
        covariance = spread @ spread.mT
        mean = model.chart.add(predicted.y, (root @ shift.unsqueeze(-1)).squeeze(-1))
        log_z = belief.log_z + torch.where(rooted & positive & torch.isfinite(log_like), log_like, -torch.inf)
        info = Info(mean, covariance.diagonal(dim1=-2, dim2=-1), lambda: covariance, {})
        return Gaussian(mean, covariance, log_z, memory), info

    def _predict(self, model: StateSpaceModel, belief: Gaussian, u: Any) -> tuple[Linearised, Tensor]:
        chart, d = model.chart, model.chart.dimension
        root, ok = factor(belief.covariance)
        law = model.noise
        gain = model.noise_gain(u)
        inner = 0 if gain is not None else model.noise_dim

        def through(xi: Tensor) -> tuple[Tensor, Tensor]:
            x = chart.add(belief.mean.unsqueeze(1), xi[..., :d] @ root.mT)
            if gain is None:
                w = law.mean + law.stddev * xi[..., d:]
                return model.propagate(x, u, w), xi.new_zeros(1, 1, d, d)
            sized = gain * law.stddev
            return model.propagate(x, u, law.mean.expand(*x.shape[:2], -1)), (sized @ sized.mT).unsqueeze(1)

        return self.rule(through, belief.mean, d + inner, Space(chart.subtract, chart.mean)), ok

    def _look(self, model: StateSpaceModel, mean: Tensor, root: Tensor, seen: Record) -> Innovation:
        def through(xi: Tensor) -> tuple[Tensor, Tensor]:
            law: Any = model.observation(model.chart.add(mean.unsqueeze(1), xi @ root.mT), seen.u)
            dense = isinstance(law, torch.distributions.MultivariateNormal)
            return law.mean, law.covariance_matrix if dense else torch.diag_embed(law.variance)

        space = Space(model.residual, around_first(model.residual))
        y_hat, m, omega = self.rule(through, mean, root.shape[-1], space)
        there = ~torch.isnan(seen.y)
        r = torch.where(there, model.residual(seen.y, y_hat), 0.0)
        both = there.unsqueeze(-1) & there.unsqueeze(-2)
        eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
        return Innovation(r, there, torch.where(there.unsqueeze(-1), m, 0.0), torch.where(both, omega, eye))


def update(innovation: Innovation) -> tuple[Tensor, Tensor, Tensor]:
    """Whitened posterior: mean [R, d], square root [R, d, d] and log evidence of the step [R] (NaN where there is no root)."""
    r, seen, m, omega = innovation
    root, ok = factor(omega)
    white = torch.linalg.solve_triangular(root, torch.cat([m, r.unsqueeze(-1)], -1), upper=False)  # Omega^-1/2 [M r]
    d = m.shape[-1]
    eye = torch.eye(d, dtype=m.dtype, device=m.device).expand(m.shape[0], -1, -1)
    # least squares by QR: forming I + A' A would drown the 1 of a prior 1e8 times as wide as the measurement's noise
    stacked = torch.cat([white, torch.nn.functional.pad(eye, (0, 1))], -2)
    triangle = torch.linalg.qr(stacked, mode="r")[1]  # [[information root, score], [0, root of the distance]], of any sign
    information, score, distance = triangle[:, :d, :d], triangle[:, :d, d:], triangle[:, d, d].square()
    back = torch.linalg.solve_triangular(information, torch.cat([score, eye], -1), upper=True)
    log_det = root.diagonal(dim1=-2, dim2=-1).log().sum(-1) + information.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)
    log_like = -0.5 * distance - log_det - 0.5 * _LOG_2PI * seen.sum(-1, dtype=r.dtype)  # int64 times a float is float32
    return back[..., 0], back[..., 1:], torch.where(ok, log_like, torch.nan)


def around_first(residual: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    """Weighted mean of values that may wrap: average their residuals to the first one."""

    def mean(y: Tensor, w: Tensor) -> Tensor:
        return y[:, 0] + (w.unsqueeze(-1) * residual(y, y[:, :1])).sum(1)

    return mean
