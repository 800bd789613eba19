"""Kernels of Markov chain Monte Carlo moves: what is proposed for a particle's past, and the log of the ratio to accept it.

Written t for the newest instant of the window, x_t the child and x_t-1 its parent. A child is sent off by a smoothing kernel
about itself, h A e in the chart, A from the cloud and not from the particle, so that the kernel is symmetric and cancels.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, moments
from pfbench.filter.moves import Information, Named, Path, join, quiet, slopes, spread, transition
from pfbench.filter.proposals import draw_noise
from pfbench.filter.resamplers import NormalKernel, Smoothing
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
class Tail:
    """Only x_t moves, its parent stays: beta = p(y_t | x') p(x' | x_t-1) / (p(y_t | x) p(x | x_t-1)).

    [Gilks and Berzuini 2001; Ristic, Arulampalam, Gordon 2004.] x_0 has no parent and stays.
    """

    walk: Walk = field(default_factory=Walk)
    exact = True
    keeps = Path(1, dense=True)

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        return Block(0, Simulated(), self.walk).propose(model, cloud, draws)


class Stretch(NamedTuple):
    """The end of a path: kept, re-drawn states, child [R, N, L+2, D]; what was seen at all but the first."""

    states: Tensor
    seen: tuple[Record, ...]


class Redraw(Protocol):
    """Other states between the kept one and the child, by a law g.

    Called with a stretch and the child that is proposed. Returns the states [R, N, L, D] and log g of the old ones given the
    old child, minus log g of the new ones given the new child [R, N]; None where g has no density and is passed off as
    p(block | kept, y).
    """

    @property
    def exact(self) -> bool: ...

    def __call__(self, model: StateSpaceModel, old: Stretch, child: Tensor, draws: Draws) -> tuple[Tensor, Tensor | None]: ...


@dataclass(frozen=True)
class Block:
    """The child moves and `length` states before it are locally resampled [Yan et al. 2016, eqs. 10-13].

    beta = prod_{j = t-length..t} p(y_j | x'_j) p(x'_j | x'_j-1) g(block) / (the same without primes, g(block')). With g exactly
    p(block | kept, y) this is the ratio of the child's terms alone, which is what the paper's lost eq. 13 must have been [ours].

    Args:
        length: states re-drawn; the paper's indices re-draw L of them, its words L - 1. Fewer near the start, x_0 is kept.
        redraw: g.
        walk: where the child goes.

    Raises:
        ValueError: a negative length; on use, a model whose transition has no density.
    """

    length: int
    redraw: Redraw
    walk: Walk = field(default_factory=Walk)

    def __post_init__(self) -> None:
        if self.length < 0:
            raise ValueError(f"kernel.length={self.length}: give the number of states to draw anew, 0 for none")

    @property
    def exact(self) -> bool:
        return self.redraw.exact

    @property
    def keeps(self) -> Path:
        return Path(self.length + 1, dense=True)

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        steps = len(cloud.past) - 1
        if steps < 1:
            return cloud, torch.full_like(cloud.log_w, -torch.inf)
        first = steps - min(self.length, steps - 1)
        window, old = cloud.window, Stretch(cloud.window["states"][:, :, first - 1 :], cloud.past[first:])
        child = model.chart.add(cloud.x, self.walk(model, cloud, cloud.x, draws))
        block, log_g = self.redraw(model, old, child, draws)
        new = Stretch(join([old.states[:, :, :1], block, child.unsqueeze(2)]), old.seen)
        log_like = sighted(model, new)
        gained = log_like + arrived(model, new) - window["log_like"][:, :, first:] - arrived(model, old)
        log_alpha = gained[..., -1] if log_g is None else gained.sum(-1) + log_g
        fresh = {"states": new.states[:, :, 1:], "log_like": log_like}
        if "noise" in window:
            fresh["noise"] = driven(model, new)
        ends = {name: join([window[name][:, :, : -a.shape[2]], a]) for name, a in fresh.items()}
        return cloud._replace(x=child, window=window | ends), log_alpha


def sighted(model: StateSpaceModel, path: Stretch) -> Tensor:
    """log p(y_j | x_j) [R, N, L+1]."""
    values = [model.log_likelihood(seen.y, path.states[:, :, j + 1], seen.u) for j, seen in enumerate(path.seen)]
    return join([a.unsqueeze(2) for a in values])


def arrived(model: StateSpaceModel, path: Stretch) -> Tensor:
    """log p(x_j | x_j-1) [R, N, L+1]."""
    x = path.states
    laws = [transition(model, x[:, :, j], seen) for j, seen in enumerate(path.seen)]
    return join([law.log_prob(x[:, :, j + 1]).unsqueeze(2) for j, law in enumerate(laws)])


def driven(model: StateSpaceModel, path: Stretch) -> Tensor:
    """The noises that lead from state to state [R, N, L+1, W].

    Raises:
        ValueError: a model in which they are not known from the states.
    """
    noises = []
    for j, seen in enumerate(path.seen):
        gain, x = model.noise_gain(seen.u), path.states[:, :, j]
        if gain is None or gain.shape[-2] != gain.shape[-1]:
            name = f"{type(model).__name__}'s noise"
            raise ValueError(f"filter.moves: {name} is not known from its states; do not mix this kernel with Flow")
        r = model.chart.subtract(path.states[:, :, j + 1], model.propagate(x, seen.u, quiet(model, x)))
        noises.append((model.noise.mean + torch.linalg.solve_ex(gain, r.mT)[0].mT).unsqueeze(2))
    return join(noises)


@dataclass(frozen=True)
class Simulated:
    """The block by the model's own dynamics from the kept state, blind to what was seen and to the child: rarely accepted."""

    exact = True

    def __call__(self, model: StateSpaceModel, old: Stretch, child: Tensor, draws: Draws) -> tuple[Tensor, Tensor | None]:
        states = [old.states[:, :, 0]]
        for j, seen in enumerate(old.seen[:-1]):
            w = draw_noise(model, child.shape[1], Named(draws, f"block_{j}."))
            states.append(model.propagate(states[-1], seen.u, w))
        if len(states) == 1:
            return old.states[:, :, :0], torch.zeros_like(child[..., 0])
        path = join([x.unsqueeze(2) for x in states])
        new, before = Stretch(path, old.seen[:-1]), Stretch(old.states[:, :, :-1], old.seen[:-1])
        return path[:, :, 1:], (arrived(model, before) - arrived(model, new)).sum(-1)


@dataclass(frozen=True)
class Copied:
    """The block of another particle of the cloud, any one. It has no density, so the ratio is only approximate."""

    exact = False

    def __call__(self, model: StateSpaceModel, old: Stretch, child: Tensor, draws: Draws) -> tuple[Tensor, Tensor | None]:
        n = child.shape[1]
        other = (draws.uniform("other", n, 1).squeeze(2) * n).long().clamp(max=n - 1)
        return torch.take_along_dim(old.states[:, :, 1:-1], other[:, :, None, None], 1), None


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
                m_old = m_old + _times(gain, ahead_old - _times(after.slope, m_old))
                m_new = m_new + _times(gain, ahead_new - _times(after.slope, m_new))
            root, ok = factor(p)
            z = draws.normal(f"block_{j}", child.shape[1], chart.dimension)
            ahead_old, ahead_new = chart.subtract(block[:, :, j], links[j].x), m_new + _times(root, z)
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
        here, law = x[:, :few], transition(model, x[:, :few], seen)

        def moved(a: Tensor, seen: Record = seen) -> Tensor:
            return model.propagate(a, seen.u, quiet(model, a))

        def looked(a: Tensor, seen: Record = seen) -> Tensor:
            return model.observation(a, seen.u).mean

        slope, x = slopes(model, moved, here, model.chart.subtract), moved(x)
        there, sight = ~torch.isnan(seen.y), slopes(model, looked, x[:, :few], model.residual)
        residual = torch.where(there.unsqueeze(1), model.residual(seen.y.unsqueeze(1), looked(x)), 0.0)
        sight = torch.where(there[:, None, :, None], sight, 0.0)
        both = (there.unsqueeze(-1) & there.unsqueeze(-2)).unsqueeze(1)
        noise = spread(model.observation(x[:, :few], seen.u))
        noise = torch.where(both, noise, torch.eye(noise.shape[-1], dtype=noise.dtype, device=noise.device))
        links.append(Link(x, slope, spread(law), sight, noise, residual))
    return links


def _forward(links: list[Link], shape: torch.Size) -> list[tuple[Tensor, Tensor]]:
    """Filtered mean and covariance of the deviations from the quiet path, at all but its end."""
    d = links[0].slope.shape[-1]
    m, p, laws = links[0].x.new_zeros(*shape[:2], d), links[0].slope.new_zeros(1, 1, d, d), []
    for link in links[:-1]:
        m, p = _times(link.slope, m), link.slope @ p @ link.slope.mT + link.spread
        p, gain = _absorb(p, link.sight, link.noise)
        m = m + _times(gain, link.residual - _times(link.sight, m))
        laws.append((m, p))
    return laws


def _absorb(p: Tensor, h: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
    """Covariance after a measurement with slope h and covariance r, in Joseph's form, and the gain."""
    gain = torch.linalg.solve_ex(h @ p @ h.mT + r, h @ p)[0].mT
    left = torch.eye(p.shape[-1], dtype=p.dtype, device=p.device) - gain @ h
    return left @ p @ left.mT + gain @ r @ gain.mT, gain


def _times(a: Tensor, x: Tensor) -> Tensor:
    """Matrices [R, 1 or N, k, d] times vectors [R, N, d]."""
    return x @ a[:, 0].mT if a.shape[1] == 1 else (a @ x.unsqueeze(-1)).squeeze(-1)


def _solved(root: Tensor, x: Tensor) -> Tensor:
    """root^-1 x for lower triangular [R, 1 or N, d, d], vectors [R, N, d]."""
    if root.shape[1] == 1:
        return torch.linalg.solve_triangular(root[:, 0], x.mT, upper=False).mT
    return torch.linalg.solve_triangular(root, x.unsqueeze(-1), upper=False).squeeze(-1)


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
        root = root + torch.diag_embed((root.diagonal(dim1=-2, dim2=-1) == 0).to(root))  # along which nothing moves
        before, after = (_solved(root.unsqueeze(1), a).square().sum(-1) for a in (xi, xi + step))
        log_alpha = 0.5 * (before - after) + (log_like - window["log_like"]).sum(-1)
        fresh = {"states": states, "log_like": log_like, "noise": noise}
        return cloud._replace(x=states[:, :, -1], window=window | fresh), log_alpha

    def _renewed(self, model: StateSpaceModel, w: Tensor, draws: Draws) -> Tensor:
        if self.refresh == 0.0 or w.shape[2] == 0:
            return w
        law: Any = model.noise
        if not isinstance(law.base_dist, torch.distributions.Normal):
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
