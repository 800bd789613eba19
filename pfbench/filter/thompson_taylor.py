"""The Thompson-Taylor generator: a new particle is a random combination of a particle's nearest neighbours."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, moments
from pfbench.filter.resamplers import Resample
from pfbench.filter.whitening import whiten
from pfbench.model.base import StateSpaceModel

_PAIRS = 20_000_000  # distances held at a time


@dataclass(frozen=True)
class ThompsonTaylor:
    """Copies by `inner`, then z = xbar + sum_l u_l (x_l - xbar) over the m nearest neighbours x_l of each copy, itself included,
    xbar their mean, u_l uniform with mean 1/m and variance (m - 1)/m^2 [Taylor and Thompson 1986].

    The covariance within a neighbourhood becomes (m - 1)/m of what it was, so mean and covariance of the sample are nearly kept,
    without any presumed shape. Neighbours are the nearest in standard deviations of the cloud, all directions whitened. [ours]
    Copies of one particle are each other's neighbours: m of them stay together, as the algorithm is written.

    Args:
        inner: the resampler that copies; the generator wants a sample of equal weights.
        neighbours: m.
        printed: z = xbar + u_k (x_k - xbar) of a single neighbour, chosen at random, as in the print [Pu and Qin, "Application of
            quasi Monte Carlo polymerization re-sampling particle filter algorithm in airborne passive location", eq. 12], which
            lost the sum: the covariance within a neighbourhood shrinks to 1/m of what it was.

    Raises:
        ValueError: fewer than two neighbours; on use, more than there are particles.
    """

    inner: Resample
    neighbours: int = 20
    printed: bool = False
    exact = False

    def __post_init__(self) -> None:
        if self.neighbours < 2:
            raise ValueError(f"resampler.neighbours={self.neighbours}: give at least 2, a particle itself being one of them")

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, log_a: Tensor, n: Tensor, draws: Draws
    ) -> tuple[Cloud, Tensor]:
        slots, m = cloud.x.shape[1], self.neighbours
        if m > slots:
            raise ValueError(f"resampler.neighbours={m}: the cloud has {slots} particles; give as many neighbours at most")
        mean, covariance = moments(model.chart, cloud)
        fresh, hit = self.inner(model, cloud, log_a, n, draws)
        d = model.chart.subtract(fresh.x, mean.unsqueeze(1))
        near = nearest(whiten(d, factor(covariance)[0]), fresh.log_w > -torch.inf, m)
        rows = d.gather(1, near.flatten(1).unsqueeze(-1).expand(-1, -1, d.shape[-1])).unflatten(1, (slots, m))
        centre = rows.mean(2)
        x = model.chart.add(mean.unsqueeze(1), centre + self._combined(rows - centre.unsqueeze(2), draws))
        return fresh._replace(x=torch.where(hit[:, None, None], x, fresh.x)), hit

    def _combined(self, r: Tensor, draws: Draws) -> Tensor:
        """Neighbours' differences from their mean r [R, N, m, d] -> [R, N, d]."""
        m = self.neighbours
        half = math.sqrt(3.0 * (m - 1.0)) / m
        u = draws.uniform("neighbours", r.shape[1], m).to(r)
        u = 1.0 / m + half * (2.0 * u - 1.0)
        if not self.printed:
            return (u.unsqueeze(-2) @ r).squeeze(-2)
        chosen = (m * draws.uniform("neighbour", r.shape[1], 1)).long().clamp(max=m - 1)
        one = r.gather(2, chosen.unsqueeze(-1).expand(-1, -1, 1, r.shape[-1])).squeeze(2)
        return u[..., :1] * one


def nearest(z: Tensor, alive: Tensor, m: int) -> Tensor:
    """The m nearest of the living points z [R, N, d], oneself included, for each point: [R, N, m]; block by block."""
    block = max(1, _PAIRS // max(1, z.shape[0] * z.shape[1]))
    far = torch.where(alive, 0.0, torch.inf).unsqueeze(1)
    return torch.cat([(torch.cdist(part, z) + far).topk(m, largest=False, sorted=False).indices for part in z.split(block, 1)], 1)
