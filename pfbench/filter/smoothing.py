"""Smoothing: what the whole record says of every state. Backward passes over what a filter has left.

Gaussian filters are smoothed by the recursion of Rauch, Tung and Striebel, particle filters by sampling whole paths backwards.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.draws import MonteCarlo, Source
from pfbench.filter.belief import Filter, Gaussian, Info
from pfbench.filter.derived_draws import named
from pfbench.filter.gaussian import GaussianFilter
from pfbench.filter.loop import Estimate, run_filter
from pfbench.filter.rules import Linearised
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record

_PAIRS = 4_000_000  # numbers of particles beside paths that are weighed at a time


class Smoothed(NamedTuple):
    """A normal law of each state given the whole record, in the chart about `mean`.

    Attributes:
        mean: [R, T, D]; NaN at the instants of a lost run from which on it was lost, and before.
        covariance: [R, T, d, d].
        filtered: what the filter alone made of the record.
    """

    mean: Tensor
    covariance: Tensor
    filtered: Estimate


def smooth(method: GaussianFilter, model: StateSpaceModel, record: Record) -> Smoothed:
    """Means and covariances given the whole record [Rauch, Tung and Striebel 1965; Sarkka 2008 for points].

    The covariance between a state and the next is what the filter's own rule finds, so that the recursion is the extended, the
    unscented or the cubature smoother, as the filter is; it is exact on linear-Gaussian models. On a curved chart the law of
    the next state is taken in the coordinates about its prediction [ours].

    Args:
        method: a Gaussian filter without adaptations and gains, whose predictions are those of the model.
        model: what the filter believes.
        record: measurements [R, T, Dy] and inputs.

    Raises:
        ValueError: a filter that changes the model's noise; a record whose world the filter would change.
    """
    if not method.plain:
        raise ValueError("smooth: this filter adapts its noise or gain, and its past is no law of the model; choose a plain one")
    _check_open(record)
    laws: list[tuple[Tensor, Tensor]] = []

    def keep(t: int, info: Info) -> dict[str, Tensor]:
        laws.append((info.mean, info.covariance()))
        return {}

    runs = torch.arange(len(record.y))
    filtered = run_filter(method, model, record, MonteCarlo(0, runs), keep)
    inputs, chart = model.prepare(record.to(model.anchor)).to(model.anchor), model.chart
    mean, covariance = laws[-1]
    means, covariances = [mean], [covariance]
    for t in reversed(range(len(laws) - 1)):
        before, spread = laws[t]
        belief = Gaussian(before, spread, torch.zeros_like(before[:, 0]))
        predicted, rooted = method.predict(model, belief, inputs.at(t + 1).u)
        gain, left = _backwards(predicted, factor(spread)[0], rooted)
        shift = (gain @ chart.subtract(mean, predicted.y).unsqueeze(-1)).squeeze(-1)
        mean, covariance = chart.add(before, shift), left + gain @ covariance @ gain.mT
        means.append(mean)
        covariances.append(covariance)
    return Smoothed(torch.stack(means[::-1], 1), torch.stack(covariances[::-1], 1), filtered)


def _backwards(predicted: Linearised, root: Tensor, rooted: Tensor) -> tuple[Tensor, Tensor]:
    """The gain [R, d, d] on the next state's correction, and what it would leave of the covariance if that were known.

    In Joseph's form, which stays positive: of x = L xi, next = M xi + e, it is L ((I - K M) (I - K M)' + K Omega K') L'.
    """
    d = root.shape[-1]
    m, covariance = predicted.m[..., :d], predicted.m @ predicted.m.mT + predicted.omega
    ahead, positive = factor(covariance)
    half = torch.linalg.solve_triangular(ahead, m, upper=False)
    k = torch.linalg.solve_triangular(ahead.mT, half, upper=True).mT
    eye = torch.eye(d, dtype=m.dtype, device=m.device)
    driven = predicted.m[..., d:]  # columns of noise that went through the rule
    rest = driven @ driven.mT + predicted.omega
    left = (eye - k @ m) @ (eye - k @ m).mT + k @ rest @ k.mT
    sound = (rooted & positive)[:, None, None]
    return torch.where(sound, root @ k, torch.nan), torch.where(sound, root @ left @ root.mT, torch.nan)


def trajectories(method: Filter, model: StateSpaceModel, record: Record, draws: Source, paths: int) -> Tensor:
    """Whole paths from p(x_1:T | y_1:T), as a particle filter sees it: forward filtering, backward sampling.

    A path takes its last state by the last weights, then each earlier one from the cloud of its time, by the weights there times
    the density of the step to the state behind it [Godsill, Doucet and West 2004]. The states of a path come from clouds as they
    were before later resampling thinned them out, and the paths of a run are independent given its clouds.

    Args:
        method: a particle filter whose clouds are weighted particles of the model's states.
        model: with a transition that has a density.
        record: measurements [R, T, Dy] and inputs.
        draws: the filter's randomness, and that of the paths.
        paths: for each run.

    Returns:
        [R, paths, T, D]; NaN where a run is lost.

    Raises:
        ValueError: no paths; a Gaussian filter; a model without transition density; a record whose world the filter would
            change.
    """
    if paths < 1:
        raise ValueError(f"trajectories: paths={paths}; give at least 1")
    _check_open(record)
    clouds: list[tuple[Tensor, Tensor]] = []

    def keep(t: int, info: Info) -> dict[str, Tensor]:
        if info.cloud is None:
            raise ValueError(f"trajectories: {type(method).__name__} has no particles; smooth() gives its smoothed law")
        deviations, log_w = info.cloud()
        clouds.append((model.chart.add(info.mean.unsqueeze(1), deviations), log_w))
        return {}

    inputs = model.prepare(record.to(model.anchor)).to(model.anchor)
    _check_dense(model, inputs, record)
    estimate = run_filter(method, model, record, draws, keep)
    x, log_w = clouds[-1]
    path = [_chosen(x, log_w.unsqueeze(1).expand(-1, paths, -1), named(draws.at(len(clouds)), "path."))]
    for t in reversed(range(len(clouds) - 1)):
        x, log_w = clouds[t]
        log_a = log_w.unsqueeze(1) + _log_densities(model, x, path[-1], inputs.at(t + 1).u)
        path.append(_chosen(x, log_a, named(draws.at(t + 1), "path.")))
    whole = torch.stack(path[::-1], 2)
    return torch.where(estimate.lost[:, None, None, None], torch.nan, whole)


def _log_densities(model: StateSpaceModel, x: Tensor, ahead: Tensor, u: Any) -> Tensor:
    """log p(ahead | x) of each state ahead [R, M, D] from each particle x [R, N, D] -> [R, M, N], some of M at a time."""
    parts, n = [], x.shape[1]
    for some in ahead.split(max(1, _PAIRS // x.numel()), 1):
        law: Any = model.transition(x.repeat(1, some.shape[1], 1), u)
        parts.append(law.log_prob(some.repeat_interleave(n, 1)).unflatten(1, (-1, n)))
    return torch.cat(parts, 1)


def _chosen(x: Tensor, log_a: Tensor, draws: Any) -> Tensor:
    """For each path one of x [R, N, D], by log probabilities log_a [R, M, N] -> [R, M, D]."""
    heights = torch.softmax(log_a, -1).nan_to_num().cumsum(-1)
    at = draws.uniform("state", log_a.shape[1], 1).to(heights) * heights[..., -1:]
    which = torch.searchsorted(heights, at, right=True).clamp(max=x.shape[1] - 1)
    return x.gather(1, which.expand(-1, -1, x.shape[-1]))


def _check_open(record: Record) -> None:
    if record.loop is not None:
        raise ValueError("smoothing: what a filter estimates changes this world, and its past with it; set scenario.closed=false")


def _check_dense(model: StateSpaceModel, inputs: Record, record: Record) -> None:
    start = model.origin.expand(len(record.y), 1, -1) if inputs.start is None else inputs.start.unsqueeze(1)
    if model.transition(start.to(model.anchor), inputs.at(0).u) is None:
        raise ValueError(
            f"trajectories: {type(model).__name__} has no transition density (fewer noises than states): a state is reached from "
            "its own parent alone, and nothing can be sampled backwards; smooth() with a Gaussian filter needs none"
        )
