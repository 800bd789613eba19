"""Paths between two states, given what was seen on the way: forward filtering, backward sampling."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.covariance import covariance_of, factor
from pfbench.draws import Draws
from pfbench.filter.blocks import Stretch
from pfbench.filter.linearisation import drift, innovation, quiet, sight, times, where_seen
from pfbench.filter.window import join, transition
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class Smoothed:
    """The block from the normal law p(block | kept, y) or, with `child`, p(block | kept, y, x_t): forward filtering, backward
    sampling about the path that the kept state would take without noise, so that both directions use one linearisation.

    Without the child, on a linear model, this is the local resampling of [Yan et al. 2016]; given the child it is a bridge
    [ours], and what raises acceptance. Its ratio is always taken, so that it is exact on nonlinear models too.

    Args:
        child: condition on the child.
    """

    child: bool = True
    exact = True

    def __call__(self, model: StateSpaceModel, old: Stretch, child: Tensor, draws: Draws) -> tuple[Tensor, Tensor | None]:
        length, ratio = len(old.seen) - 1, torch.zeros_like(child[..., 0])
        if length == 0:
            return old.states[:, :, :0], ratio
        chart, block = model.chart, old.states[:, :, 1:-1]
        links = _links(model, old)
        laws = _forward(links, old.states.shape)
        ahead_old, ahead_new = (chart.subtract(x, links[-1].x) for x in (old.states[:, :, -1], child))
        states: list[Tensor] = []
        for j in reversed(range(length)):
            m_old = m_new = laws[j][0]
            p, after = laws[j][1], links[j + 1]
            if self.child or j < length - 1:
                p, gain = _absorb(p, after.slope, after.spread)
                m_old = m_old + times(gain, ahead_old - times(after.slope, m_old))
                m_new = m_new + times(gain, ahead_new - times(after.slope, m_new))
            root, ok = factor(p)
            z = draws.normal(f"block_{j}", child.shape[1], chart.dimension)
            ahead_old, ahead_new = chart.subtract(block[:, :, j], links[j].x), m_new + times(root, z)
            z_old = _solved(root, ahead_old - m_old)
            ratio = ratio + torch.where(ok, 0.5 * (z * z - z_old * z_old).sum(-1), torch.nan)
            states.append(chart.add(links[j].x, ahead_new))
        return join([x.unsqueeze(2) for x in reversed(states)]), ratio


class Link(NamedTuple):
    """One step about a quiet path: where it leads x [R, N, D], slope F and spread Q of the step [R, 1 or N, d, d], and what was
    seen there: slope H [R, 1 or N, k, d], covariance [R, 1 or N, k, k] and residual [R, N, k]."""

    x: Tensor
    slope: Tensor
    spread: Tensor
    sight: Tensor
    noise: Tensor
    residual: Tensor


def _links(model: StateSpaceModel, old: Stretch) -> list[Link]:
    x, links = old.states[:, :, 0], []
    few = 1 if model.linear else x.shape[1]  # a linear model has the same slopes everywhere
    for seen in old.seen:
        here = x[:, :few]
        slope, law, x = drift(model, here, seen.u), transition(model, here, seen), model.propagate(x, seen.u, quiet(model, x))
        there, ahead = ~torch.isnan(seen.y).unsqueeze(1), x[:, :few]
        noise = where_seen(covariance_of(model.observation(ahead, seen.u)), there)
        links.append(Link(x, slope, covariance_of(law), sight(model, ahead, seen), noise, innovation(model, x, seen)))
    return links


def _forward(links: list[Link], shape: torch.Size) -> list[tuple[Tensor, Tensor]]:
    """Filtered mean and covariance of the deviations from the quiet path, at all but its end."""
    d = links[0].slope.shape[-1]
    m, p, laws = links[0].x.new_zeros(*shape[:2], d), links[0].slope.new_zeros(1, 1, d, d), []
    for link in links[:-1]:
        m, p = times(link.slope, m), link.slope @ p @ link.slope.mT + link.spread
        p, gain = _absorb(p, link.sight, link.noise)
        m = m + times(gain, link.residual - times(link.sight, m))
        laws.append((m, p))
    return laws


def _absorb(p: Tensor, h: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
    """Covariance after a measurement with slope h and covariance r, in Joseph's form, and the gain."""
    gain = torch.linalg.solve_ex(h @ p @ h.mT + r, h @ p)[0].mT
    left = torch.eye(p.shape[-1], dtype=p.dtype, device=p.device) - gain @ h
    return left @ p @ left.mT + gain @ r @ gain.mT, gain


def _solved(root: Tensor, x: Tensor) -> Tensor:
    """root^-1 x for lower triangular [R, 1 or N, d, d], vectors [R, N, d]."""
    if root.shape[1] == 1:
        return torch.linalg.solve_triangular(root[:, 0], x.mT, upper=False).mT
    return torch.linalg.solve_triangular(root, x.unsqueeze(-1), upper=False).squeeze(-1)
