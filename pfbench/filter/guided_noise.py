"""A proposal of each particle's noise, shaped by the rule of a Gaussian filter: the optimal one where the model is linear."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.covariance import covariance_of, factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, weights
from pfbench.filter.gaussian import GaussianFilter, around_first
from pfbench.filter.guides import check_widen, log_ratio_of, standard
from pfbench.filter.linearisation import base, quiet, where_seen
from pfbench.filter.points import Independent, Points
from pfbench.filter.proposals import Proposed
from pfbench.filter.rules import Linearised, Space
from pfbench.filter.whitening import LOG_2PI, half_square, log_det
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


@dataclass(frozen=True)
class GuidedNoise:
    """The noise of each particle is drawn from its normal posterior given parent and measurement [Doucet, Godsill, Andrieu 2000].

    y = h(f(parent, w)) + v is linearised in w by the guide's rule; w ~ N(m, U U') and the ratio is p(w) / q(w), which exists
    where the transition has no density. On linear-Gaussian models it is the optimal proposal.

    Args:
        guide: the Gaussian filter whose rule linearises. It starts anew from each parent, so that it has nothing to adapt.
        shared: linearise once for each run, about the cloud's mean without noise, instead of once for each particle. That is as
            exact, since any proposal is corrected, and as good where the map is next to linear; models that are linear do so.
        widen: factor on the proposal's covariance; more than 1 guards against one that is too sure.
        points: where the z come from.

    Raises:
        ValueError: a guide with adaptations, gains or iterations; a factor that is not positive.
    """

    guide: GaussianFilter
    shared: bool = False
    widen: float = 1.0
    points: Points = field(default_factory=Independent)
    exact = True

    def __post_init__(self) -> None:
        check_widen(self.widen)
        if self.guide.adaptations or self.guide.gains or self.guide.iterations > 1:
            raise ValueError("proposal.guide: GuidedNoise takes its rule alone; leave out adaptations, gains and iterations")

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        law = model.noise
        z = self.points(draws).normal("guide", cloud.x.shape[1], model.noise_dim)
        xi, log_det = self._posterior(model, cloud, seen, z)
        w, log_ratio = xi, log_ratio_of(xi, z, log_det, self.widen)
        if not standard(law):
            w = law.mean + law.stddev * xi
            log_ratio = log_ratio + law.log_prob(w) + half_square(xi) + (law.stddev.log() + 0.5 * LOG_2PI).sum()
        return Proposed(model.propagate(cloud.x, seen.u, w), log_ratio, cloud.memory, w)

    def _posterior(self, model: StateSpaceModel, cloud: Cloud, seen: Record, z: Tensor) -> tuple[Tensor, Tensor]:
        """xi = m + sqrt(widen) U z [R, N, W] and log |det U| [R, N or 1]."""
        shared = self.shared or model.linear
        x = model.chart.mean(cloud.x, weights(cloud.log_w)).unsqueeze(1) if shared else cloud.x
        y_hat, m, omega = (a.unflatten(0, x.shape[:2]) for a in self._linearised(model, x, seen.u)[:3])
        if shared:
            y_hat = model.observation(model.propagate(cloud.x, seen.u, quiet(model, cloud.x)), seen.u).mean
        there = ~torch.isnan(seen.y).unsqueeze(1)  # [R, 1, k]
        r = torch.where(there, model.residual(seen.y.unsqueeze(1), y_hat), 0.0)
        half, ok = factor(where_seen(omega.to(r), there))
        white = torch.linalg.solve_triangular(half, torch.where(there.unsqueeze(-1), m, 0.0), upper=False)
        # columns are all particles of a run where they share a linearisation, else each has a matrix of its own
        r, z = (a.mT.unsqueeze(1) if shared else a.unsqueeze(-1) for a in (r, z))
        score = white.mT @ torch.linalg.solve_triangular(half, r, upper=False)
        # by its information matrix, cheaper than update's QR: what it loses in digits, the ratio knows of
        eye = torch.eye(m.shape[-1], dtype=r.dtype, device=r.device)
        lower, info = torch.linalg.cholesky_ex(eye + white.mT @ white)
        ok = (ok & (info == 0) & torch.isfinite(score).all(-1).all(-1))[..., None, None]
        root = torch.linalg.solve_triangular(torch.where(ok, lower, eye).mT, eye.expand_as(lower), upper=True)
        xi = root @ (root.mT @ torch.where(ok, score, 0.0) + math.sqrt(self.widen) * z)  # not ok: the prior, which is as exact
        return xi.squeeze(1).mT if shared else xi.squeeze(-1), log_det(root)

    def _linearised(self, model: StateSpaceModel, x: Tensor, u: Any) -> Linearised:
        """What is expected of a child of each x [R, M, D], as a map of its whitened noise; its axis of runs holds R M."""
        centre, scale = model.noise.mean, model.noise.stddev

        def through(xi: Tensor) -> tuple[Tensor, Tensor]:
            w = (centre + scale * xi).reshape(len(x), -1, xi.shape[-1])
            law = model.observation(model.propagate(x.repeat_interleave(xi.shape[1], 1), u, w), u)
            return law.mean.reshape(*xi.shape[:2], -1), _covariances(law, xi.shape)

        space = Space(model.residual, around_first(model.residual))
        return self.guide.rule(through, x.flatten(0, 1), model.noise_dim, space)


def _covariances(law: Distribution, shape: torch.Size) -> Tensor:
    """Of a law of R M P particles, as a rule wants it for points of this shape [R M, P, ...]; one for all where all are alike."""
    each = base(law)
    if isinstance(each, torch.distributions.Normal) and each.scale.stride(0) == 0 and each.scale.stride(1) == 0:
        return torch.diag_embed(each.scale[:1, :1].square())  # torch has expanded it
    full = covariance_of(law)
    return full.reshape(*shape[:2], *full.shape[-2:])
