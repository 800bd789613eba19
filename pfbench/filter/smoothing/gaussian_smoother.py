"""Smoothing of Gaussian filters by the recursion of Rauch, Tung and Striebel."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.core.covariance import factor
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief, StepInfo
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.loop import FilterResult, prepare_record, run_filter
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
    check_no_feedback(record)
    filtered_moments: list[tuple[Tensor, Tensor]] = []

    def store(t: int, info: StepInfo) -> dict[str, Tensor]:
        filtered_moments.append((info.mean, info.covariance()))
        return {}

    runs = torch.arange(len(record.y))
    filtered = run_filter(method, model, record, PhiloxStream(0, runs), store)
    inputs, chart = prepare_record(model, record), model.chart
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


def check_no_feedback(record: Record) -> None:
    """Raise an error if the record has feedback.

    Raises:
        ValueError: If it has.
    """
    if record.feedback is not None:
        raise ValueError(
            "smoothing: record must not depend on the filter, got one with feedback. "
            "Set scenario.closed_loop=false."
        )
