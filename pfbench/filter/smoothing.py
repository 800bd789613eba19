"""Smoothing: distributions of states given all measurements, by a backward pass.

Gaussian filters use the recursion of Rauch, Tung and Striebel. Particle filters use
backward sampling of paths.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.covariance import factor
from pfbench.core.derived_stream import relabel
from pfbench.core.random_stream import BatchRandomStream, PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import Filter, GaussianBelief, StepInfo
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.loop import FilterResult, run_filter
from pfbench.model.base import StateSpaceModel

_PAIRS = 4_000_000  # numbers of pairs of particle and path that are weighted at a time


class SmoothedStates(NamedTuple):
    """Normal distribution of each state, given all measurements, in the chart.

    Attributes:
        mean: Smoothed means, [R, T, D]. NaN for a lost run.
        covariance: Smoothed covariances, [R, T, d, d].
        filtered: Result of the filter.
    """

    mean: Tensor
    covariance: Tensor
    filtered: FilterResult


def smooth(method: GaussianFilter, model: StateSpaceModel, record: Record) -> SmoothedStates:
    """Compute smoothed means and covariances (Rauch-Tung-Striebel).

    The covariance between consecutive states comes from the filter's linearisation rule. The result
    is the extended, unscented or cubature smoother, and exact for linear Gaussian models. On a
    curved chart the next state is expressed in coordinates about its prediction [ours].

    Args:
        method: Gaussian filter without noise or gain adaptations.
        model: State-space model of the filter.
        record: Measurements [R, T, Dy] and inputs.

    Returns:
        Smoothed means and covariances, and the result of the filter.

    Raises:
        ValueError: If the filter adapts noise or gain, or if the record has feedback.

    References:
        H. Rauch, F. Tung and C. Striebel (1965). S. Sarkka (2008), Unscented
        Rauch-Tung-Striebel smoother.
    """
    if not method.plain:
        raise ValueError(
            "smooth: method must use the model's noise and gain, got a filter that adapts them. "
            "Choose a filter without adaptations."
        )
    _check_open(record)
    filtered_moments: list[tuple[Tensor, Tensor]] = []

    def store(t: int, info: StepInfo) -> dict[str, Tensor]:
        filtered_moments.append((info.mean, info.covariance()))
        return {}

    runs = torch.arange(len(record.y))
    filtered = run_filter(method, model, record, PhiloxStream(0, runs), store)
    inputs, chart = model.prepare(record.to(model.anchor)).to(model.anchor), model.chart
    mean, covariance = filtered_moments[-1]
    means, covariances = [mean], [covariance]
    for t in reversed(range(len(filtered_moments) - 1)):
        before, spread = filtered_moments[t]
        belief = GaussianBelief(before, spread, torch.zeros_like(before[:, 0]))
        predicted, rooted = method.predict(model, belief, inputs.at_step(t + 1).u)
        gain, remainder = _backward_gain(predicted, factor(spread)[0], rooted)
        shift = (gain @ chart.subtract(mean, predicted.y).unsqueeze(-1)).squeeze(-1)
        mean, covariance = chart.add(before, shift), remainder + gain @ covariance @ gain.mT
        means.append(mean)
        covariances.append(covariance)
    return SmoothedStates(torch.stack(means[::-1], 1), torch.stack(covariances[::-1], 1), filtered)


def _backward_gain(
    predicted: AffineApproximation, root: Tensor, rooted: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the smoother gain [R, d, d] and the covariance given the next state.

    For x = L xi and next = M xi + e the covariance is L ((I - K M) (I - K M)' + K Omega K') L', in
    Joseph's form, which stays positive.
    """
    d = root.shape[-1]
    m, covariance = predicted.m[..., :d], predicted.m @ predicted.m.mT + predicted.omega
    predicted_root, positive = factor(covariance)
    half = torch.linalg.solve_triangular(predicted_root, m, upper=False)
    k = torch.linalg.solve_triangular(predicted_root.mT, half, upper=True).mT
    eye = torch.eye(d, dtype=m.dtype, device=m.device)
    noise_columns = predicted.m[..., d:]  # of noise inside the linearisation rule
    omega = noise_columns @ noise_columns.mT + predicted.omega
    conditional = (eye - k @ m) @ (eye - k @ m).mT + k @ omega @ k.mT
    valid = (rooted & positive)[:, None, None]
    return torch.where(valid, root @ k, torch.nan), torch.where(
        valid, root @ conditional @ root.mT, torch.nan
    )


def sample_trajectories(
    method: Filter, model: StateSpaceModel, record: Record, draws: BatchRandomStream, paths: int
) -> Tensor:
    """Sample paths from p(x_1:T | y_1:T) by forward filtering and backward sampling.

    The last state of a path is sampled by the last weights. Each earlier state is sampled from the
    particles of its step, by their weights times the transition density to the next state. Later
    resampling does not reduce the diversity of earlier states. The paths of a run are independent
    given its particles.

    Args:
        method: Particle filter.
        model: State-space model with a transition density.
        record: Measurements [R, T, Dy] and inputs.
        draws: Random stream of filter and paths.
        paths: Number of paths of each run.

    Returns:
        Sampled paths, [R, paths, T, D]. NaN where a run is lost.

    Raises:
        ValueError: If paths is below 1, the filter is not a particle filter, the model lacks a
            transition density, or the record has feedback.

    References:
        S. Godsill, A. Doucet and M. West (2004), Monte Carlo smoothing for nonlinear time series.
    """
    if paths < 1:
        raise ValueError(f"trajectories: paths must be at least 1, got {paths}. Increase it.")
    _check_open(record)
    clouds: list[tuple[Tensor, Tensor]] = []

    def store(t: int, info: StepInfo) -> dict[str, Tensor]:
        if info.cloud is None:
            raise ValueError(
                f"trajectories: method must be a particle filter, got {type(method).__name__}. "
                "Use smooth() for a Gaussian filter."
            )
        deviations, log_w = info.cloud()
        clouds.append((model.chart.add(info.mean.unsqueeze(1), deviations), log_w))
        return {}

    inputs = model.prepare(record.to(model.anchor)).to(model.anchor)
    _check_dense(model, inputs, record)
    estimate = run_filter(method, model, record, draws, store)
    x, log_w = clouds[-1]
    path = [
        _sample_states(
            x,
            log_w.unsqueeze(1).expand(-1, paths, -1),
            relabel(draws.at_step(len(clouds)), "path."),
        )
    ]
    for t in reversed(range(len(clouds) - 1)):
        x, log_w = clouds[t]
        log_a = log_w.unsqueeze(1) + _log_densities(model, x, path[-1], inputs.at_step(t + 1).u)
        path.append(_sample_states(x, log_a, relabel(draws.at_step(t + 1), "path.")))
    samples = torch.stack(path[::-1], 2)
    return torch.where(estimate.lost[:, None, None, None], torch.nan, samples)


def _log_densities(model: StateSpaceModel, x: Tensor, next_x: Tensor, u: Any) -> Tensor:
    """Return log p(next | x) [R, M, N] of next states [R, M, D] and x [R, N, D]."""
    parts, n = [], x.shape[1]
    for block in next_x.split(max(1, _PAIRS // x.numel()), 1):
        distribution: Any = model.transition(x.repeat(1, block.shape[1], 1), u)
        parts.append(distribution.log_prob(block.repeat_interleave(n, 1)).unflatten(1, (-1, n)))
    return torch.cat(parts, 1)


def _sample_states(x: Tensor, log_a: Tensor, draws: Any) -> Tensor:
    """Sample a particle for each path [R, M, D], by log probabilities [R, M, N]."""
    cumulative = torch.softmax(log_a, -1).nan_to_num().cumsum(-1)
    level = draws.uniform("state", log_a.shape[1], 1).to(cumulative) * cumulative[..., -1:]
    index = torch.searchsorted(cumulative, level, right=True).clamp(max=x.shape[1] - 1)
    return x.gather(1, index.expand(-1, -1, x.shape[-1]))


def _check_open(record: Record) -> None:
    """Raise an error if the record has feedback."""
    if record.feedback is not None:
        raise ValueError(
            "smoothing: record must not depend on the filter, got one with feedback. "
            "Set scenario.closed_loop=false."
        )


def _check_dense(model: StateSpaceModel, inputs: Record, record: Record) -> None:
    """Raise an error if the model lacks a transition density."""
    start = (
        model.origin.expand(len(record.y), 1, -1)
        if inputs.start is None
        else inputs.start.unsqueeze(1)
    )
    if model.transition(start.to(model.anchor), inputs.at_step(0).u) is None:
        raise ValueError(
            "trajectories: model must have a transition density, got "
            f"{type(model).__name__} without one (fewer noise than state components). "
            "Use smooth() with a Gaussian filter."
        )
