"""Kernels of Markov chain Monte Carlo moves that carry a whole path along: it flows from another start, under the same noises.

Written t for the newest instant of the window. A step of a walk is h A e in the chart, A from the cloud and not from the
particle, so that it is symmetric and cancels in the ratio.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, moments
from pfbench.filter.linearisation import base
from pfbench.filter.resamplers import NormalKernel, Smoothing
from pfbench.filter.whitening import half_square, whiten
from pfbench.filter.window import Information, Path, join
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


@dataclass(frozen=True)
class Walk:
    """A step h A e of a random walk: A A' the covariance of what moves, h the bandwidth of a smoothing kernel times `scale`.

    The Gaussian bandwidth is close to the best scale of a random walk in many dimensions, 2.38 / sqrt(d).
    """

    scale: float = 1.0
    smoothing: Smoothing = field(default_factory=NormalKernel)

    def __post_init__(self) -> None:
        if not self.scale > 0.0:
            raise ValueError(f"kernel.walk.scale={self.scale}: give a positive factor on the optimal bandwidth")

    def __call__(self, model: StateSpaceModel, cloud: Cloud, x: Tensor, draws: Draws) -> Tensor:
        """Steps [R, N, d] for x [R, N, D], whose weights are the cloud's."""
        covariance = moments(model.chart, cloud._replace(x=x))[1]
        root, ok = factor(covariance)
        lone = torch.diag_embed(covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt())
        living = torch.isfinite(cloud.log_w).sum(1, keepdim=True).to(x.dtype)
        h = self.scale * self.smoothing.bandwidth(covariance.shape[-1], living)
        e = self.smoothing.draw(draws, "walk", x.shape[1], covariance.shape[-1])
        return h.unsqueeze(-1) * (e @ torch.where(ok[:, None, None], root, lone).mT)


@dataclass(frozen=True)
class Flow:
    """The start of the window moves, the noises stay, and the path follows them [ours]: no transition density is needed.

    s = x_t-L, s' = s (+) h A e with A from the cloud of starts at t, path' = the model's flow from s' under the same noises;
    log beta = log p(s') - log p(s) + sum_j log p(y_j | x'_j) - log p(y_j | x_j). While t <= L the start is x_0 and its law
    exact; later it is the normal law with the filter's moments at t - L, and the target that of a fixed-lag smoother, which is
    why this kernel does not call itself exact. Costs L model steps.

    Args:
        depth: L; the window may be deeper for another kernel's sake, and the flow then starts where it does.
        walk: where the start goes. On a curved chart it goes there in the coordinates about the start's mean [ours], in which
            its law is normal, so that no volume element is missing.
        refresh: c, renews the noises by w' = sqrt(1 - c^2) w + c e, which leaves their normal law as it is.

    Raises:
        ValueError: depth below 1, refresh outside [0, 1); on use, a refresh of noise that is not normal.
    """

    depth: int = 20
    walk: Walk = field(default_factory=Walk)
    refresh: float = 0.0
    exact = False

    def __post_init__(self) -> None:
        if self.depth < 1:
            raise ValueError(f"kernel.depth={self.depth}: give the number of steps to flow through, at least 1")
        if not 0.0 <= self.refresh < 1.0:
            raise ValueError(f"kernel.refresh={self.refresh}: give a share of new noise in [0, 1)")

    @property
    def keeps(self) -> Path:
        return Path(self.depth, driven=True)

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        window, chart = cloud.window, model.chart
        start, centre = window["states"][:, :, 0], window["mean"][:, :, 0]
        step, xi = self.walk(model, cloud, start, draws), chart.subtract(start, centre)
        moved = start + step if chart.flat else chart.add(centre, xi + step)
        noise = self._renewed(model, window["noise"], draws)
        states, log_like = replay(model, moved, noise, cloud.past)
        root = factor(window["covariance"][:, 0, 0])[0]
        before, after = (half_square(whiten(a, root)) for a in (xi, xi + step))
        log_alpha = before - after + (log_like - window["log_like"]).sum(-1)
        fresh = {"states": states, "log_like": log_like, "noise": noise}
        return cloud._replace(x=states[:, :, -1], window=window | fresh), log_alpha

    def _renewed(self, model: StateSpaceModel, w: Tensor, draws: Draws) -> Tensor:
        if self.refresh == 0.0 or w.shape[2] == 0:
            return w
        law: Any = model.noise
        if not isinstance(base(law), torch.distributions.Normal):
            raise ValueError(f"kernel.refresh={self.refresh}: the noise of {type(model).__name__} is not normal; set it to 0")
        n, steps, width = w.shape[1:]
        e = draws.normal("refresh", n, steps * width).unflatten(2, (steps, width))
        return law.mean + (1.0 - self.refresh**2) ** 0.5 * (w - law.mean) + self.refresh * law.stddev * e


def replay(model: StateSpaceModel, start: Tensor, noise: Tensor, past: tuple[Record, ...]) -> tuple[Tensor, Tensor]:
    """The path from `start` [R, N, D] under noises [R, N, K, W]: states [R, N, K+1, D] and log p(y_j | x_j) [R, N, K+1]."""
    x, states = start, [start]
    values = [model.log_likelihood(seen.y, x, seen.u) for seen in past[:1]] or [torch.zeros_like(start[..., 0])]
    for j, seen in enumerate(past[1:]):
        x = model.propagate(x, seen.u, noise[:, :, j])
        states.append(x)
        values.append(model.log_likelihood(seen.y, x, seen.u))
    return join([a.unsqueeze(2) for a in states]), join([a.unsqueeze(2) for a in values])


@dataclass(frozen=True)
class FlowStat:
    """The whole path since t = 0 moves with its newest state, at a cost that does not grow with t [ours].

    Uses sufficient statistics [after Storvik 2002; Fearnhead 2002]: x' = x (+) delta, delta = h A e,
    log beta = b.delta - delta' Lambda delta / 2; where accepted, b <- b - Lambda delta. Exact on linear-Gaussian models, of first
    order elsewhere. See Information for b and Lambda.

    Args:
        walk: delta; half the optimal bandwidth by default.
    """

    walk: Walk = field(default_factory=lambda: Walk(0.5))
    exact = False
    keeps = Information()

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        b, delta = cloud.window["score"], self.walk(model, cloud, cloud.x, draws)
        pulled = delta @ cloud.window["information"][:, 0]
        log_alpha = (delta * (b - 0.5 * pulled)).sum(-1)
        window = cloud.window | {"score": b - pulled}
        return cloud._replace(x=model.chart.add(cloud.x, delta), window=window), log_alpha


@dataclass(frozen=True)
class FlowGibbs:
    """FlowStat with delta ~ N(Lambda^-1 b, Lambda^-1), the conditional law itself: always accepted, where Lambda has a root."""

    exact = False
    keeps = Information()

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        b, information = cloud.window["score"], cloud.window["information"][:, 0]
        root, ok = factor(information)
        white = torch.linalg.solve_triangular(root, b.mT, upper=False).mT
        e = draws.normal("gibbs", b.shape[1], b.shape[2])
        delta = torch.linalg.solve_triangular(root.mT, (white + e).mT, upper=True).mT
        log_alpha = torch.where(ok[:, None] & torch.isfinite(delta).all(-1), 0.0, -torch.inf)
        window = cloud.window | {"score": b - delta @ information}
        return cloud._replace(x=model.chart.add(cloud.x, delta), window=window), log_alpha
