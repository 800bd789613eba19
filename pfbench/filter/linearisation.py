"""Models linearised at particles: where a step leads and what is seen there, by exact derivatives along the chart."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal

from pfbench.model.base import StateSpaceModel
from pfbench.record import Record

_POINTS = 200_000  # states differentiated at a time


def derivative(
    f: Callable[[Tensor, Tensor], Tensor],
    at: Tensor,
    d: int,
    subtract: Callable[[Tensor, Tensor], Tensor] = torch.subtract,
) -> Tensor:
    """Derivative in xi, at 0, of f: states [R, P, D], xi [R, P, d] -> [R, P, k]: [R, N, k, d] for states `at` [R, N, D].

    `subtract` says how values differ, where they may wrap. All directions go in one forward pass, as more particles.
    """
    runs, n = at.shape[:2]
    parts = []
    for directions in torch.eye(d, dtype=at.dtype, device=at.device).split(max(1, _POINTS // (runs * n))):
        xi = directions.repeat(runs, n, 1)
        with forward_ad.dual_level():
            value = f(at.repeat_interleave(len(directions), 1), forward_ad.make_dual(torch.zeros_like(xi), xi))
            still = forward_ad.unpack_dual(value)[0].detach()
            difference, slopes = forward_ad.unpack_dual(subtract(value, still))
        slopes = torch.zeros_like(difference) if slopes is None else slopes  # it does not depend on xi
        parts.append(slopes.unflatten(1, (n, len(directions))))
    return torch.cat(parts, 2).mT


def quiet(model: StateSpaceModel, x: Tensor) -> Tensor:
    """The mean noise for each of x [R, N, ...]: [R, N, W]."""
    return model.noise.mean.expand(*x.shape[:2], -1)


def drift(model: StateSpaceModel, x: Tensor, u: Any) -> Tensor:
    """Phi [R, N, d, d], slope of the step that x [R, N, D] would take without noise."""
    chart = model.chart

    def moved(a: Tensor, xi: Tensor) -> Tensor:
        return model.propagate(chart.add(a, xi), u, quiet(model, xi))

    return derivative(moved, x, chart.dimension, chart.subtract)


def sight(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """H [R, N, k, d], slope of what is expected to be seen of x [R, N, D]; rows 0 where nothing was seen."""

    def looked(a: Tensor, xi: Tensor) -> Tensor:
        return mean(model.observation(model.chart.add(a, xi), seen.u))

    h = derivative(looked, x, model.chart.dimension, model.residual)
    return torch.where(torch.isnan(seen.y)[:, None, :, None], 0.0, h)


def innovation(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """y - y_hat of x [R, N, D] -> [R, N, k]; 0 where nothing was seen."""
    y = seen.y.unsqueeze(1)
    return torch.where(torch.isnan(y), 0.0, model.residual(y.nan_to_num(), mean(model.observation(x, seen.u))))


def mean(law: Any) -> Tensor:
    value: Tensor = law.mean
    return value


def base(law: Distribution) -> Distribution:
    """Of a law with independent components, the law that holds them; any other itself."""
    return law.base_dist if isinstance(law, Independent) else law


def is_normal(law: Distribution) -> bool:
    return isinstance(base(law), Normal | MultivariateNormal)


def where_seen(covariance: Tensor, there: Tensor) -> Tensor:
    """A covariance [..., k, k] between the components that are there [..., k]; 1 and uncorrelated where they are not."""
    both = there.unsqueeze(-1) & there.unsqueeze(-2)
    return torch.where(both, covariance, torch.eye(there.shape[-1], dtype=covariance.dtype, device=covariance.device))


def times(m: Tensor, e: Tensor) -> Tensor:
    """Matrices [R, 1 or N, k, l] times vectors [R, 1 or N, l] -> [R, N, k]."""
    return e @ m[:, 0].mT if m.shape[1] == 1 else (m @ e.unsqueeze(-1)).squeeze(-1)
