"""Smoothing of Gaussian filters by the recursion of Rauch, Tung and Striebel."""

from __future__ import annotations

from functools import reduce
from itertools import accumulate
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require, require_range
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record, iterate_steps
from pfbench.filter.belief import GaussianBelief, StepInfo
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.innovation import compute_innovation
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.loop import FilterResult, Watch, prepare_record, run_filter
from pfbench.model.base import StateSpaceModel


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


def smooth(
    method: GaussianFilter,
    model: StateSpaceModel,
    record: Record,
    watch: Watch | None = None,
    lag: int | None = None,
) -> SmoothedStates:
    """Compute smoothed means and covariances (Rauch-Tung-Striebel).

    The covariance between consecutive states comes from the filter's linearisation rule. The result
    is the extended, unscented or cubature smoother, and exact for linear Gaussian models. On a
    curved chart the next state is expressed in coordinates about its prediction [ours].

    Args:
        method: Gaussian filter without noise or gain adaptations.
        model: State-space model of the filter.
        record: Measurements [R, T, Dy] and inputs.
        watch: Function of each step of the filter, see `run_filter`.
        lag: Number of later measurements that a state may use, for estimates with a fixed delay. None uses all.

    Returns:
        Smoothed means and covariances, and the result of the filter.

    Raises:
        ValueError: If the filter adapts noise or gain, the record has feedback, or lag is negative.

    References:
        H. Rauch, F. Tung and C. Striebel (1965). S. Sarkka (2008), Unscented
        Rauch-Tung-Striebel smoother.
    """
    require(
        method.plain,
        "smooth: method",
        "use the model's noise and gain",
        "a filter that adapts them",
        "Choose a filter without adaptations.",
    )
    require_range("smooth: lag", lag, "null or whole [0, inf)")
    check_no_feedback(record)
    filtered_moments: list[tuple[Tensor, Tensor]] = []

    def store(t: int, info: StepInfo) -> dict[str, Tensor]:
        filtered_moments.append((info.mean, info.covariance()))
        return watch(t, info) if watch else {}

    runs = torch.arange(len(record.y))
    filtered = run_filter(method, model, record, PhiloxStream(0, runs), store)
    inputs, chart = prepare_record(model, record), model.chart
    last, gains = len(filtered_moments) - 1, []
    for t, (before, spread) in enumerate(filtered_moments[:-1]):
        belief = GaussianBelief(before, spread, torch.zeros_like(before[:, 0]))
        predicted, rooted = method.predict(model, belief, inputs.at_step(t + 1).u)
        gains.append((predicted.y, *_backward_gain(predicted, factor(spread)[0], rooted)))

    def step_back(later: tuple[Tensor, Tensor], t: int) -> tuple[Tensor, Tensor]:
        y, gain, remainder = gains[t]
        shift = (gain @ chart.subtract(later[0], y).unsqueeze(-1)).squeeze(-1)
        return chart.add(filtered_moments[t][0], shift), remainder + gain @ later[1] @ gain.mT

    laws = [*accumulate(reversed(range(last)), step_back, initial=filtered_moments[-1])][::-1]
    if lag is not None:
        ends = [min(t + lag, last) for t in range(last + 1)]
        laws = [
            reduce(step_back, reversed(range(t, end)), filtered_moments[end])
            for t, end in enumerate(ends)
        ]
    means, covariances = zip(*laws, strict=True)
    return SmoothedStates(torch.stack(means, 1), torch.stack(covariances, 1), filtered)


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


def check_no_feedback(record: Record) -> None:
    """Raise an error if the record has feedback."""
    require(
        record.feedback is None,
        "smoothing: record",
        "not depend on the filter",
        "one with feedback",
        "Set scenario.closed_loop=false.",
    )


# --------------------------------------------------------------------------------------------------
# Iterated smoothing: every pass linearises about the smoothed distributions of the pass before.


class IteratedSmoothing(NamedTuple):
    """Normal distribution of each state, given all measurements, in the chart.

    Attributes:
        mean: Smoothed means, [R, T, D]. NaN for a lost run.
        covariance: Smoothed covariances, [R, T, d, d].
        changes: Largest shift of a mean in each pass, in standard deviations, [R, passes]. A run
            whose last shift is not small has not converged.
        filtered: Result of the filter.
    """

    mean: Tensor
    covariance: Tensor
    changes: Tensor
    filtered: FilterResult


class _Law(NamedTuple):
    """Normal distribution of a state: mean [R, D] and root [R, d, d] of the covariance."""

    mean: Tensor
    root: Tensor


class _LinearStep(NamedTuple):
    """A step in coordinates whitened by the present distributions of both states.

    z_t = slope z_{t-1} + offset + N(0, noise), r = m z_t + N(0, omega).
    """

    slope: Tensor
    offset: Tensor
    noise: Tensor
    r: Tensor
    m: Tensor
    omega: Tensor


def smooth_iteratively(
    method: GaussianFilter, model: StateSpaceModel, record: Record, passes: int = 4
) -> IteratedSmoothing:
    """Compute smoothed means and covariances by repeated linearisation.

    A pass linearises each step about the smoothed distribution of its first state, and each
    measurement about that of its state. It solves the linear problem by a Kalman filter and the
    recursion of Rauch, Tung and Striebel. With Taylor expansion a pass is a Gauss-Newton step on
    the posterior density of the path, with sigma points it is a posterior linearisation. It
    does not use a transition density: a model may have fewer noises than states. On a curved
    chart the result of a pass is exact to first order in the noise of a step [ours].

    Args:
        method: Gaussian filter without noise or gain adaptations.
        model: State-space model of the filter.
        record: Measurements [R, T, Dy] and inputs.
        passes: Number of passes after that of `smooth`.

    Returns:
        Smoothed means and covariances, the shifts of each pass, and the result of the filter.

    Raises:
        ValueError: If passes is below 1, the filter adapts noise or gain, or the record has
            feedback.

    References:
        B. Bell (1994), The iterated Kalman smoother as a Gauss-Newton method. A. Garcia-Fernandez,
        L. Svensson and S. Sarkka (2017), Iterated posterior linearization smoother.
    """
    require_range("smooth_iteratively: passes", passes, "[1, inf]")
    first = smooth(method, model, record)
    inputs = prepare_record(model, record)
    runs = len(record.y)
    draws = PhiloxStream(0, torch.arange(runs))
    prior = method.init(model, runs, draws, inputs.start, inputs.spread)
    start = _Law(prior.mean, factor(prior.covariance)[0])
    laws = [
        start,
        *(
            _Law(mean, factor(covariance)[0])
            for mean, covariance in zip(
                first.mean.unbind(1), first.covariance.unbind(1), strict=True
            )
        ),
    ]
    changes = []
    for _ in range(passes):
        steps = _linearise(method, model, inputs, laws)
        laws, change = _solve(model, start, laws, steps)
        changes.append(change)
    means, roots = zip(*laws[1:], strict=True)
    root = torch.stack(roots, 1)
    return IteratedSmoothing(
        torch.stack(means, 1), root @ root.mT, torch.stack(changes, 1), first.filtered
    )


def smooth_initial_state(
    method: GaussianFilter, model: StateSpaceModel, record: Record, passes: int = 3
) -> tuple[Tensor, Tensor]:
    """Compute the distribution of the initial state, given all measurements.

    Returns mean [R, D] and covariance in the chart, [R, d, d]. NaN where a covariance is not
    positive. Shapes: record [R, T, Dy].
    """
    draws = PhiloxStream(0, torch.arange(len(record.y)))
    belief = method.init(model, len(record.y), draws, record.start, record.spread)
    laws = [_Law(belief.mean, factor(belief.covariance)[0])]
    for _, step_model, step_record in iterate_steps(model, record):
        belief, _ = method.step(step_model, belief, step_record, draws)
        laws.append(_Law(belief.mean, factor(belief.covariance)[0]))
    start = laws[0]
    for _ in range(passes):
        laws, _ = _solve(model, start, laws, _linearise(method, model, record, laws))
    return laws[0].mean, laws[0].root @ laws[0].root.mT


def _linearise(
    method: GaussianFilter, model: StateSpaceModel, record: Record, laws: list[_Law]
) -> list[_LinearStep]:
    """Linearise all steps about the present distributions of their states."""
    chart, d, steps = model.chart, model.chart.dimension, []
    for t, step_model, step_record in iterate_steps(model, record):
        before, state = laws[t], laws[t + 1]
        zero = torch.zeros_like(before.mean[:, 0])
        belief = GaussianBelief(before.mean, before.root @ before.root.mT, zero)
        predicted, _ = method.predict(step_model, belief, step_record.u)
        noise_columns = predicted.m[..., d:]  # of noise inside the linearisation rule
        offset = chart.subtract(predicted.y, state.mean).unsqueeze(-1)
        slope, noise = predicted.m[..., :d], noise_columns @ noise_columns.mT + predicted.omega
        whitened = torch.linalg.solve_triangular(
            state.root, torch.cat([slope, offset, noise], -1), upper=False
        )
        noise = torch.linalg.solve_triangular(state.root, whitened[..., d + 1 :].mT, upper=False)

        def state_at(xi: Tensor, state: _Law = state) -> Tensor:
            return chart.add(state.mean.unsqueeze(1), xi @ state.root.mT)

        innovation = compute_innovation(
            method.linearisation, step_model, state_at, state.mean, step_record, state.root
        )
        steps.append(
            _LinearStep(
                whitened[..., :d],
                whitened[..., d],
                0.5 * (noise + noise.mT),
                innovation.r,
                innovation.m,
                innovation.omega,
            )
        )
    return steps


def _solve(
    model: StateSpaceModel, start: _Law, laws: list[_Law], steps: list[_LinearStep]
) -> tuple[list[_Law], Tensor]:
    """Return the smoothed distributions of all states and the largest whitened shift [R]."""
    first = laws[0]
    columns = torch.cat(
        [start.root, model.chart.subtract(start.mean, first.mean).unsqueeze(-1)], -1
    )
    white = torch.linalg.solve_triangular(first.root, columns, upper=False)
    mean, root = white[..., -1], white[..., :-1]
    filtered, predicted = [(mean, root @ root.mT)], []
    for step in steps:
        mean, covariance = filtered[-1]
        mean = (step.slope @ mean.unsqueeze(-1)).squeeze(-1) + step.offset
        covariance = step.slope @ covariance @ step.slope.mT + step.noise
        predicted.append((mean, covariance))
        filtered.append(_update(mean, covariance, step))
    mean, covariance = filtered[-1]
    results = [(mean, covariance)]
    for t in reversed(range(len(steps))):
        gain = _solve_symmetric(predicted[t][1], steps[t].slope @ filtered[t][1]).mT
        shift = (gain @ (mean - predicted[t][0]).unsqueeze(-1)).squeeze(-1)
        eye = torch.eye(gain.shape[-1], dtype=gain.dtype, device=gain.device)
        rest = eye - gain @ steps[t].slope
        covariance = (
            rest @ filtered[t][1] @ rest.mT + gain @ (steps[t].noise + covariance) @ gain.mT
        )
        mean = filtered[t][0] + shift
        results.append((mean, covariance))
    new = [
        _Law(
            model.chart.add(state.mean, (state.root @ z.unsqueeze(-1)).squeeze(-1)),
            state.root @ factor(c)[0],
        )
        for state, (z, c) in zip(laws, results[::-1], strict=True)
    ]
    return new, torch.stack([z for z, _ in results], 1).abs().amax((1, 2))


def _update(mean: Tensor, covariance: Tensor, step: _LinearStep) -> tuple[Tensor, Tensor]:
    """Return mean [R, d] and covariance [R, d, d] after a measurement, in Joseph's form."""
    m, innovation = step.m, step.r - (step.m @ mean.unsqueeze(-1)).squeeze(-1)
    gain = _solve_symmetric(m @ covariance @ m.mT + step.omega, m @ covariance).mT
    eye = torch.eye(mean.shape[-1], dtype=mean.dtype, device=mean.device)
    rest = eye - gain @ m
    mean = mean + (gain @ innovation.unsqueeze(-1)).squeeze(-1)
    return mean, rest @ covariance @ rest.mT + gain @ step.omega @ gain.mT


def _solve_symmetric(a: Tensor, b: Tensor) -> Tensor:
    """Solve A X = B for a positive definite A [R, k, k]; NaN where it is not."""
    root, ok = factor(a)
    solution = torch.cholesky_solve(b, root)
    return torch.where(ok[:, None, None], solution, torch.nan)
