"""Moves: rejuvenation of refreshed runs by Markov kernels, and what particles carry of their past for them.

A kernel leaves the law of a particle's path given what was seen as it is, so a move spreads copies apart without changing
what the cloud stands for. A particle carries all that its kernel looks at; no kernel looks up a parent by itself.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import torch
from torch import Tensor
from torch.autograd import forward_ad

from pfbench.covariance import factor
from pfbench.draws import Draws, MonteCarlo
from pfbench.filter.belief import Cloud, moments, weights
from pfbench.model.base import AtRest, StateSpaceModel
from pfbench.record import Record, map_inputs


class Keeper(Protocol):
    """What particles carry for a kernel beside their state, in the cloud's window, and how it grows step by step."""

    def begin(self, model: StateSpaceModel, cloud: Cloud, mean: Tensor, covariance: Tensor) -> Cloud:
        """The first cloud with its window; mean [R, D] and covariance [R, d, d] are those of the initial law."""

    def follow(self, model: StateSpaceModel, before: Cloud, after: Cloud, w: Tensor | None, seen: Record) -> Cloud:
        """`after` with the window of `before`, its parents slot by slot, one step on; w [R, N, W] is the noise between."""

    def joined(self, other: Keeper) -> Keeper:
        """One keeper that serves two kernels.

        Raises:
            ValueError: kernels that cannot move the same cloud.
        """


class Move(Protocol):
    """A rejuvenation of the runs that were refreshed, from what the cloud carries; rate of acceptance [R], 0 where not hit."""

    @property
    def exact(self) -> bool: ...

    @property
    def keeps(self) -> Keeper | None:
        """What it needs the particles to carry."""

    def __call__(self, model: StateSpaceModel, cloud: Cloud, hit: Tensor, draws: Draws) -> tuple[Cloud, Tensor]: ...


class Kernel(Protocol):
    """Proposes a cloud with other pasts, and the log of the Metropolis-Hastings ratio [R, N]; NaN is never accepted."""

    @property
    def exact(self) -> bool:
        """Does it leave p(x_0:t | y_1:t) invariant?"""

    @property
    def keeps(self) -> Keeper: ...

    def propose(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]: ...


@dataclass(frozen=True)
class Metropolis:
    """Metropolis-Hastings steps, one chain per particle, all chains at once [Gilks and Berzuini 2001].

    Args:
        kernel: what is proposed.
        sweeps: steps at each refresh; 0 makes no move.

    Raises:
        ValueError: a negative number of sweeps.
    """

    kernel: Kernel
    sweeps: int = 1

    def __post_init__(self) -> None:
        if self.sweeps < 0:
            raise ValueError(f"move.sweeps={self.sweeps}: give the number of Metropolis-Hastings steps, 0 for none")

    @property
    def exact(self) -> bool:
        return self.kernel.exact or self.sweeps == 0

    @property
    def keeps(self) -> Keeper | None:
        return self.kernel.keeps if self.sweeps else None

    def __call__(self, model: StateSpaceModel, cloud: Cloud, hit: Tensor, draws: Draws) -> tuple[Cloud, Tensor]:
        rate = torch.zeros_like(cloud.log_w[:, 0])
        if self.sweeps == 0:
            return cloud, rate
        if cloud.x.is_cuda:  # there a mask is cheaper than waiting for the number of runs
            moved, accepted = self._sweep(model, cloud, draws)
            return _put(cloud, moved, None, hit), torch.where(hit, accepted, rate)
        rows = hit.nonzero().squeeze(1)
        if len(rows) == 0:
            return cloud, rate
        moved, accepted = self._sweep(model, _pick(cloud, rows), _of(draws, rows))
        return _put(cloud, moved, rows, hit), rate.index_copy(0, rows, accepted)

    def _sweep(self, model: StateSpaceModel, cloud: Cloud, draws: Draws) -> tuple[Cloud, Tensor]:
        living = torch.isfinite(cloud.log_w)
        accepted = torch.zeros_like(cloud.log_w)
        for sweep in range(self.sweeps):
            own = Named(draws, f"sweep_{sweep}.")
            proposed, log_alpha = self.kernel.propose(model, cloud, own)
            toss = torch.log(own.uniform("accept", living.shape[1], 1).squeeze(2))
            accept = toss < log_alpha  # never where it is NaN
            cloud = _choose(accept, proposed, cloud)
            accepted = accepted + (accept & living)
        return cloud, accepted.sum(1) / (self.sweeps * living.sum(1))


@dataclass(frozen=True)
class Cycle:
    """Moves in turn, `sweeps` times over; a cycle of kernels that leave a law invariant does so too."""

    moves: Sequence[Move]
    sweeps: int = 1

    @property
    def exact(self) -> bool:
        return all(move.exact for move in self.moves)

    @property
    def keeps(self) -> Keeper | None:
        return together(self.moves)

    def __call__(self, model: StateSpaceModel, cloud: Cloud, hit: Tensor, draws: Draws) -> tuple[Cloud, Tensor]:
        total = torch.zeros_like(cloud.log_w[:, 0])
        for turn in range(self.sweeps):
            for i, move in enumerate(self.moves):
                cloud, rate = move(model, cloud, hit, Named(draws, f"turn_{turn}.{i}."))
                total = total + rate
        return cloud, total / max(1, self.sweeps * len(self.moves))


def together(moves: Sequence[Move]) -> Keeper | None:
    """One keeper for all moves; None where none of them needs a past."""
    kept: Keeper | None = None
    for keeper in (move.keeps for move in moves):
        if keeper is not None:
            kept = keeper if kept is None else kept.joined(keeper)
    return kept


# what is carried


@dataclass(frozen=True)
class Path:
    """The last steps of each particle. The cloud's `past` then holds what was seen at each of its states.

    The window begins at x_s, s = max(0, t - depth): `states` [R, N, K+1, D] and `log_like` [R, N, K+1], K = t - s, of which the
    first is 0 unless x_0 itself was measured. Nothing counts twice: what was seen up to s > 0 lies in the law of x_s.

    Args:
        depth: K at most.
        driven: keep also the noises that led from state to state, `noise` [R, N, K, W], and the law of each state when it was
            filtered (of x_0 the model's), `mean` [R, 1, K+1, D] and `covariance` [R, 1, K+1, d, d].
        dense: the kernels need the density of the model's transition.
    """

    depth: int
    driven: bool = False
    dense: bool = False

    def joined(self, other: Keeper) -> Keeper:
        if not isinstance(other, Path):
            return other.joined(self)
        return Path(max(self.depth, other.depth), self.driven or other.driven, self.dense or other.dense)

    def begin(self, model: StateSpaceModel, cloud: Cloud, mean: Tensor, covariance: Tensor) -> Cloud:
        window = {"states": cloud.x.unsqueeze(2), "log_like": torch.zeros_like(cloud.log_w).unsqueeze(2)}
        if self.driven:
            window["noise"] = cloud.x.new_zeros(*cloud.x.shape[:2], 0, model.noise_dim)
            window |= {"mean": mean[:, None, None], "covariance": covariance[:, None, None]}
        return cloud._replace(window=window)

    def follow(self, model: StateSpaceModel, before: Cloud, after: Cloud, w: Tensor | None, seen: Record) -> Cloud:
        log_like = model.log_likelihood(seen.y, after.x, seen.u)
        if isinstance(model, AtRest):  # x_0 itself was measured
            window = before.window | {"states": after.x.unsqueeze(2), "log_like": log_like.unsqueeze(2)}
            return after._replace(window=window, past=(seen,))
        if self.dense and len(before.past) < 2:
            transition(model, after.x[:, :1], seen)
        past = (*(before.past or (_unseen(seen),)), seen)
        old = max(0, len(past) - 1 - self.depth)
        news = {"states": after.x, "log_like": log_like}
        if self.driven:
            if w is None:
                raise ValueError("filter.moves: they replay the noise, which this proposal does not tell; choose Bootstrap")
            mean, covariance = moments(model.chart, after)
            news |= {"noise": w, "mean": mean.unsqueeze(1), "covariance": covariance.unsqueeze(1)}
        window = {name: join([before.window[name][:, :, old:], new.unsqueeze(2)]) for name, new in news.items()}
        if old:
            past = (_unseen(past[old]), *past[old + 1 :])
            nothing = torch.zeros_like(window["log_like"][:, :, :1])
            window["log_like"] = join([nothing, window["log_like"][:, :, 1:]])
        return after._replace(window=window, past=past)


@dataclass(frozen=True)
class Information:
    """How the log density of a particle's whole path bends when the newest state moves by delta and the noises stay.

    log p(path') - log p(path) = b.delta - delta' Lambda delta / 2 to first order, exactly on linear-Gaussian models: `score` b
    [R, N, d] is each particle's own, `information` Lambda [R, 1, d, d] shared. With the slope Phi of a step at the cloud's mean,

        Lambda <- Phi^-T Lambda Phi^-1 + J,   b_i <- Phi^-T b_i + d log p(y | x_i) / dx,

    J the Fisher information of the measurement at the mean, and Lambda = P0^-1, b_i = -P0^-1 xi_i at first. The derivative is
    each particle's own [ours], so that measurements of a spread (stochastic volatility) inform too.
    """

    def joined(self, other: Keeper) -> Keeper:
        if isinstance(other, Information):
            return self
        raise ValueError("filter.moves: FlowStat and FlowGibbs move paths that are not kept; mix no other kernel with them")

    def begin(self, model: StateSpaceModel, cloud: Cloud, mean: Tensor, covariance: Tensor) -> Cloud:
        information = torch.cholesky_inverse(factor(covariance)[0])
        score = -model.chart.subtract(cloud.x, mean.unsqueeze(1)) @ information
        return cloud._replace(window={"score": score, "information": information.unsqueeze(1)})

    def follow(self, model: StateSpaceModel, before: Cloud, after: Cloud, w: Tensor | None, seen: Record) -> Cloud:
        chart = model.chart
        start, here = (chart.mean(cloud.x, weights(cloud.log_w)).unsqueeze(1) for cloud in (before, after))
        phi = slopes(model, lambda x: model.propagate(x, seen.u, quiet(model, x)), start, chart.subtract)[:, 0]
        back = torch.linalg.inv_ex(phi)[0]
        information = back.mT @ before.window["information"][:, 0] @ back + fisher(model, here, seen)
        information = 0.5 * (information + information.mT)
        score = before.window["score"] @ back + _pulls(model, after.x, seen)
        return after._replace(window={"score": score, "information": information.unsqueeze(1)})


def fisher(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """Information of a measurement about the state, at x [R, 1, D] -> [R, d, d]; of a law that is not normal, by its moments."""
    there = ~torch.isnan(seen.y)

    def slope(of: Callable[[Any], Tensor], subtract: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
        found = slopes(model, lambda a: of(model.observation(a, seen.u)), x, subtract)[:, 0]
        return torch.where(there.unsqueeze(-1), found, 0.0)

    law: Any = model.observation(x, seen.u)
    sight = slope(lambda law: law.mean, model.residual)
    both = there.unsqueeze(-1) & there.unsqueeze(-2)
    noise = spread(law)[:, 0]
    noise = torch.where(both, noise, torch.eye(noise.shape[-1], dtype=noise.dtype, device=noise.device))
    told = sight.mT @ torch.linalg.solve_ex(noise, sight)[0]
    if isinstance(law, torch.distributions.MultivariateNormal):
        return told
    width = slope(lambda law: torch.log(law.stddev), torch.subtract)
    return told + 2.0 * width.mT @ width


def _pulls(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """d log p(y | x) / dx along the chart, of each particle [R, N, d]."""
    with torch.enable_grad():
        xi = x.new_zeros(*x.shape[:2], model.chart.dimension, requires_grad=True)
        total = model.log_likelihood(seen.y, model.chart.add(x.detach(), xi), seen.u).sum()
        return torch.autograd.grad(total, xi, materialize_grads=True)[0] if total.requires_grad else torch.zeros_like(xi)


def transition(model: StateSpaceModel, x: Tensor, seen: Record) -> torch.distributions.Distribution:
    """Law of the next state.

    Raises:
        ValueError: a model in which it has no density.
    """
    law = model.transition(x, seen.u)
    if law is None:
        raise ValueError(
            f"filter.moves: this kernel needs the density of x_t given x_t-1, and {type(model).__name__} has none: where it is "
            "singular, nothing would ever be accepted; take kernels.Flow, which needs none, or a model with inflation"
        )
    return law


def quiet(model: StateSpaceModel, x: Tensor) -> Tensor:
    """The mean noise for each particle [R, N, W]."""
    return model.noise.mean.expand(*x.shape[:2], -1)


def spread(law: Any) -> Tensor:
    """Covariance [R, N, k, k] of a law with independent components or a multivariate normal one."""
    dense = isinstance(law, torch.distributions.MultivariateNormal)
    return law.covariance_matrix if dense else torch.diag_embed(law.variance)


def slopes(
    model: StateSpaceModel, f: Callable[[Tensor], Tensor], x: Tensor, subtract: Callable[[Tensor, Tensor], Tensor]
) -> Tensor:
    """Derivative of f at each x [R, n, D] along the chart -> [R, n, k, d]; exact, all directions in one forward pass."""
    (runs, n, _), d = x.shape, model.chart.dimension
    points = x.repeat_interleave(d, 1)
    xi = points.new_zeros(runs, n * d, d)
    directions = torch.eye(d, dtype=x.dtype, device=x.device).repeat(n, 1).expand(runs, -1, -1).contiguous()
    y = f(x).repeat_interleave(d, 1)
    with forward_ad.dual_level():
        value, slope = forward_ad.unpack_dual(subtract(f(model.chart.add(points, forward_ad.make_dual(xi, directions))), y))
    if slope is None:  # f does not depend on the state
        slope = torch.zeros_like(value)
    return slope.unflatten(1, (n, d)).mT


def join(parts: Sequence[Tensor]) -> Tensor:
    """Concatenates [R, N, L, ...] along L; in memory runs and particles come last, so that each instant lies in one piece."""
    dims = parts[0].dim()
    whole = torch.cat([a.permute(*range(2, dims), 0, 1) for a in parts])
    return whole.permute(dims - 2, dims - 1, *range(dims - 2))


def _unseen(seen: Record) -> Record:
    return seen._replace(y=torch.full_like(seen.y, torch.nan))


# runs and names


@dataclass(frozen=True, eq=False)
class Named:
    """Draws under a name of their own, so that the sweeps and kernels of a step do not share any."""

    draws: Draws
    name: str

    @property
    def dtype(self) -> torch.dtype:
        return self.draws.dtype

    def at(self, step: int) -> Draws:
        return replace(self, draws=self.draws.at(step))

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        return self.draws.normal(self.name + purpose, n, w)

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return self.draws.uniform(self.name + purpose, n, w)


@dataclass(frozen=True, eq=False)
class Some:
    """The draws of some runs."""

    draws: Draws
    rows: Tensor

    @property
    def dtype(self) -> torch.dtype:
        return self.draws.dtype

    def at(self, step: int) -> Draws:
        return replace(self, draws=self.draws.at(step))

    def normal(self, purpose: str, n: int, w: int) -> Tensor:
        return self.draws.normal(purpose, n, w)[self.rows]

    def uniform(self, purpose: str, n: int, w: int) -> Tensor:
        return self.draws.uniform(purpose, n, w)[self.rows]


def _of(draws: Draws, rows: Tensor) -> Draws:
    if isinstance(draws, Named):
        return Named(_of(draws.draws, rows), draws.name)
    if isinstance(draws, MonteCarlo):  # it need not draw the other runs' numbers at all
        return replace(draws, runs=draws.runs[rows])
    return Some(draws, rows)


def _pick(cloud: Cloud, rows: Tensor) -> Cloud:
    """Some runs of a cloud, without its memory."""
    runs = cloud.x.shape[0]
    if len(rows) == runs:
        return cloud

    def of(a: Tensor) -> Tensor:
        order = (*range(2, a.dim()), 0, 1)
        back = (a.dim() - 2, a.dim() - 1, *range(a.dim() - 2))
        return a.permute(order).index_select(a.dim() - 2, rows).permute(back)

    def some(a: Tensor) -> Tensor:
        return a[rows] if len(a) == runs else a

    return Cloud(
        x=of(cloud.x),
        log_w=cloud.log_w[rows],
        log_z=cloud.log_z[rows],
        window={name: of(a) for name, a in cloud.window.items()},
        past=tuple(Record(seen.y[rows], map_inputs(some, seen.u)) for seen in cloud.past),
    )


def _put(cloud: Cloud, moved: Cloud, rows: Tensor | None, hit: Tensor) -> Cloud:
    """The states and windows of the moved runs put back; what all particles share has not moved."""

    def back(old: Tensor, new: Tensor) -> Tensor:
        if old.shape[1] == 1 or old is new:
            return old
        if rows is None:
            return _where(hit.unsqueeze(1), new, old)
        return new if len(rows) == len(old) else old.index_copy(0, rows, new)

    window = {name: back(old, moved.window[name]) for name, old in cloud.window.items()}
    return cloud._replace(x=back(cloud.x, moved.x), window=window)


def _choose(accept: Tensor, new: Cloud, old: Cloud) -> Cloud:
    """Particle by particle: `new` where accepted [R, N]."""
    window = {name: a if new.window[name] is a else _where(accept, new.window[name], a) for name, a in old.window.items()}
    return old._replace(x=_where(accept, new.x, old.x), window=window)


def _where(chosen: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """[R, N or 1] chooses among [R, N, ...]."""
    return torch.where(chosen.reshape(*chosen.shape, *[1] * (old.dim() - 2)), new, old)
