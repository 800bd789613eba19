"""Error of the simplest estimate from raw measurements alone, which the divergence threshold uses.

The estimate takes no dynamics noise and no prior. It is the weighted least-squares solution of a
window of measurements: the shortest one that is ten times better than dead reckoning. If there is
none, it is the best of the windows and dead reckoning. The solution is linearised about the truth,
so that it cannot converge to another solution. [ours]
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.linear_algebra import distribution_covariance, jacobian
from pfbench.core.record import Record, iterate_steps
from pfbench.filter.loop import prepare_record
from pfbench.model.base import StateSpaceModel, initial_law

FACTOR = 5.0  # divergence threshold over the error of the raw estimate

_WINDOWS = (1, 2, 5, 10, 20, 50)
_PLACES = 40  # windows per record
_WIDER = 10.0  # a direction is determined if the measurements know it better than 10 initial sd
_DETERMINED = 0.95  # share of the group's variance in determined directions


class RawEstimate(NamedTuple):
    """Error of the raw estimate of the main group.

    Attributes:
        rmse: Root mean square error over runs and windows, without the largest twentieth, in the
            unit of the group.
        steps: Steps of a window; 0 for dead reckoning.
        dead_reckoning: The same error of the initial state, propagated without measurements.
    """

    rmse: float
    steps: int
    dead_reckoning: float

    @property
    def threshold(self) -> float:
        """Divergence threshold: five times the error, at most half of that of dead reckoning.

        The second limit counts a filter that ignores the measurements as diverged. It applies where
        the measurements tell enough: the raw estimate is five times better than dead reckoning.
        """
        limit = FACTOR * self.rmse
        return min(limit, 0.5 * self.dead_reckoning) if limit <= self.dead_reckoning else limit


class _Problem(NamedTuple):
    """Data of the least-squares problems of a record.

    Attributes:
        model: State-space model.
        record: Prepared record.
        truth: True states [R, T, D]; the initial state where the truth is unknown.
        prior_sd: Standard deviations of the initial distribution, [R, d].
        group: Components whose error counts.
        is_unknown: Steps without truth of the group, [R, T].
    """

    model: StateSpaceModel
    record: Record
    truth: Tensor
    prior_sd: Tensor
    group: list[int]
    is_unknown: Tensor


class _Rows(NamedTuple):
    """Whitened equations of a window, and its end.

    Attributes:
        slopes: Derivatives of the measurements by the scaled start, [R, n, d].
        residuals: Measurements minus those of the state without noise, [R, n, 1].
        sensitivity: Derivative of the last state by the scaled start, [R, d, d].
        x: Last state without noise, [R, 1, D].
    """

    slopes: Tensor
    residuals: Tensor
    sensitivity: Tensor
    x: Tensor


@torch.no_grad()
def compute_raw_estimate(
    model: StateSpaceModel, truth: Tensor, record: Record, group: Sequence[int]
) -> RawEstimate:
    """Compute the error of the raw estimate of a group of components.

    Shapes: truth [R, T, D].
    """
    prepared = prepare_record(model, record)
    initial: Any = initial_law(model, len(truth), prepared.spread)
    start = model.origin.expand(len(truth), -1) if prepared.start is None else prepared.start
    is_unknown = torch.isnan(model.error(truth, truth)[..., list(group)]).any(-1)
    states = torch.where(torch.isnan(truth), start.unsqueeze(1), truth)
    problem = _Problem(model, prepared, states, initial.variance.sqrt(), list(group), is_unknown)
    dead_reckoning = _trimmed_rms(compute_dead_reckoning(model, truth, record)[..., problem.group])
    best = RawEstimate(dead_reckoning, 0, dead_reckoning)
    is_observed = (~torch.isnan(prepared.y)).any(2).any(0)
    observed = is_observed.nonzero().flatten()
    scored = (~is_unknown).any(0).nonzero().flatten()
    for size in (n for n in _WINDOWS if n <= len(observed)):
        windows = _place_windows(observed, scored, size)
        errors = [_window_error(problem, first, last) for first, last in windows]
        determined = [error for error in errors if error is not None]
        if determined and 2 * len(determined) >= len(errors):
            rmse = _trimmed_rms(torch.stack(determined))
            best = min(best, RawEstimate(rmse, size, dead_reckoning))
            if 2.0 * FACTOR * rmse <= dead_reckoning:
                break
    return best


def _place_windows(observed: Tensor, scored: Tensor, size: int) -> list[tuple[int, int]]:
    """Return first and last steps of windows of `size` observed steps that end at a scored step."""
    ends = scored[scored >= observed[size - 1]]
    if not len(ends):
        return []
    ends = ends[torch.linspace(0, len(ends) - 1, _PLACES).round().long().unique()]
    starts = observed[torch.searchsorted(observed, ends, right=True) - size]
    return list(zip(starts.tolist(), ends.tolist(), strict=True))


def _window_error(problem: _Problem, first: int, last: int) -> Tensor | None:
    """Return the error of least squares at the end of a window, [R, k]; None if undetermined."""
    model, group = problem.model, problem.group
    rows = _stack_rows(problem, first, last)
    u, s, v = torch.linalg.svd(rows.slopes, full_matrices=True)
    count = s.shape[-1]
    is_determined = s > 1.0
    to_group = (rows.sensitivity @ v.mT)[:, group]  # of the group at the end to directions
    square = to_group.square().sum(1)
    share = (square[:, :count] * is_determined).sum() / square.sum()
    if not bool(share >= _DETERMINED):
        return None
    inverse = torch.where(is_determined, 1.0 / s, 0.0).unsqueeze(-1)
    delta = to_group[..., :count] @ (inverse * (u[..., :count].mT @ rows.residuals))
    error: Tensor = model.error(rows.x[:, 0], problem.truth[:, last])[:, group] + delta.squeeze(-1)
    return torch.where(problem.is_unknown[:, last, None], torch.nan, error)


def _stack_rows(problem: _Problem, first: int, last: int) -> _Rows:
    """Stack the equations of a window, from the true state at its start on."""
    x = problem.truth[:, first].unsqueeze(1)
    sensitivity = torch.diag_embed(_WIDER * problem.prior_sd)
    slopes, residuals = [], []
    steps = range(first, last + 1)
    for t, model, step in iterate_steps(problem.model, problem.record, steps):
        if t > first:
            slope, x = _propagate(model, step, x)
            sensitivity = slope @ sensitivity
        slope, residual = _observe(model, step, x)
        slopes.append(slope @ sensitivity)
        residuals.append(residual)
    return _Rows(torch.cat(slopes, 1), torch.cat(residuals, 1), sensitivity, x)


def _propagate(model: StateSpaceModel, step: Record, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return the derivative [R, d, d] of a step without noise, and its result [R, 1, D]."""

    def move(dx: Tensor) -> Tensor:
        return model.propagate(model.chart.add(x, dx), step.u, _mean_noise(model, dx))

    result = model.propagate(x, step.u, _mean_noise(model, x))
    return jacobian(move, result, model.chart.dimension, model.chart.subtract), result


def _observe(model: StateSpaceModel, step: Record, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return the whitened derivative [R, Dy, d] and residual [R, Dy, 1] of a measurement."""

    def predict(dx: Tensor) -> Tensor:
        distribution: Any = model.observation(model.chart.add(x, dx), step.u)
        mean: Tensor = distribution.mean
        return mean

    distribution: Any = model.observation(x, step.u)
    slope = jacobian(predict, distribution.mean, model.chart.dimension, model.residual)
    root = torch.linalg.cholesky(distribution_covariance(distribution)[:, 0])
    residual = model.residual(step.y.nan_to_num(), distribution.mean[:, 0]).unsqueeze(-1)
    both = torch.linalg.solve_triangular(root, torch.cat([slope, residual], -1), upper=False)
    both = torch.where(torch.isnan(step.y).unsqueeze(-1), 0.0, both)
    return both[..., :-1], both[..., -1:]


@torch.no_grad()
def compute_dead_reckoning(model: StateSpaceModel, truth: Tensor, record: Record) -> Tensor:
    """Compute the error of the initial state, propagated without noise and measurements.

    Returns errors, [R, T, d]. Shapes: truth [R, T, D].
    """
    prepared, errors = prepare_record(model, record), []
    start = model.origin.expand(len(truth), -1) if prepared.start is None else prepared.start
    x = start.unsqueeze(1)
    for t, step_model, step in iterate_steps(model, prepared):
        x = step_model.propagate(x, step.u, _mean_noise(step_model, x))
        errors.append(model.error(x[:, 0], truth[:, t]))
    return torch.stack(errors, 1)


def _mean_noise(model: StateSpaceModel, x: Tensor) -> Tensor:
    """Return the mean driving noise for states [R, N, D]."""
    return torch.nan_to_num(model.noise.mean).expand(*x.shape[:2], model.noise_dim)


def _trimmed_rms(error: Tensor) -> float:
    """Return the root mean square length of errors [..., k] without the largest twentieth."""
    square = error.square().sum(-1).flatten()
    square = square[torch.isfinite(square)].sort().values
    return float(square[: max(1, int(0.95 * len(square)))].mean().sqrt())
