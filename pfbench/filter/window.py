"""What particles carry of their past, in the cloud's window, and how it grows step by step.

A particle carries all that a kernel looks at; no kernel looks up a parent by itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from pfbench.covariance import covariance_of, factor
from pfbench.filter.belief import Cloud, moments, weights
from pfbench.filter.linearisation import derivative, drift, sight, where_seen
from pfbench.model.base import AtRest, StateSpaceModel
from pfbench.record import Record


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
        back = torch.linalg.inv_ex(drift(model, start, seen.u)[:, 0])[0]
        information = back.mT @ before.window["information"][:, 0] @ back + fisher(model, here, seen)
        information = 0.5 * (information + information.mT)
        score = before.window["score"] @ back + _pulls(model, after.x, seen)
        return after._replace(window={"score": score, "information": information.unsqueeze(1)})


def fisher(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """Information of a measurement about the state, at x [R, 1, D] -> [R, d, d]; of a law that is not normal, by its moments."""
    there, h = ~torch.isnan(seen.y), sight(model, x, seen)[:, 0]
    law: Any = model.observation(x, seen.u)
    told = h.mT @ torch.linalg.solve_ex(where_seen(covariance_of(law)[:, 0], there), h)[0]
    if isinstance(law, torch.distributions.MultivariateNormal):
        return told

    def log_sd(a: Tensor, xi: Tensor) -> Tensor:
        ahead: Any = model.observation(model.chart.add(a, xi), seen.u)
        return torch.log(ahead.stddev)

    width = torch.where(there.unsqueeze(-1), derivative(log_sd, x, model.chart.dimension)[:, 0], 0.0)
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


def join(parts: Sequence[Tensor]) -> Tensor:
    """Concatenates [R, N, L, ...] along L; in memory runs and particles come last, so that each instant lies in one piece."""
    dims = parts[0].dim()
    whole = torch.cat([a.permute(*range(2, dims), 0, 1) for a in parts])
    return whole.permute(dims - 2, dims - 1, *range(dims - 2))


def _unseen(seen: Record) -> Record:
    return seen._replace(y=torch.full_like(seen.y, torch.nan))
