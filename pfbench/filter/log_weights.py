"""Log weights of particles: sums, normalisation, and the weights themselves."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.kernels import cpp
from pfbench.kernels.compilation import compilable


class ComputedWeights(NamedTuple):
    """Weights that were computed with their logarithms.

    Attributes:
        log_w: Log weights, [R, N].
        w: Weights, [R, N].
    """

    log_w: Tensor
    w: Tensor


def exponentiate(log_w: Tensor, computed: ComputedWeights | None) -> Tensor:
    """Return e to the power of log weights.

    Args:
        log_w: Log weights, [R, N].
        computed: Weights at hand. They are used if they are of this tensor of log weights.

    Returns:
        Weights, [R, N].
    """
    return computed.w if computed is not None and computed.log_w is log_w else torch.exp(log_w)


def is_resolved(maximum: Tensor) -> Tensor:
    """Return whether log weights differ by more than rounding, from their maximum.

    Below -1 / eps neighbouring numbers differ by 1 or more, so that the weights are noise: in double
    precision at 1e8 standard deviations from the measurement.
    """
    return maximum > -1.0 / torch.finfo(maximum.dtype).eps


def is_equal_for_all(a: Tensor) -> bool:
    """Return whether numbers [R, N] are stored once for all particles of a run."""
    return a.stride(1) == 0


def _narrow(a: Tensor) -> Tensor:
    """Return numbers [R, N] as [R, 1] if they are stored once for all particles of a run."""
    return a[:, :1] if is_equal_for_all(a) else a


def add_log_weights(log_likelihood: Tensor, log_w: Tensor, log_ratio: Tensor) -> Tensor:
    """Add the terms of log weights.

    Args:
        log_likelihood: Log likelihoods, [R, N].
        log_w: Log weights before, [R, N].
        log_ratio: Log density ratios of the proposal, [R, N].

    Returns:
        Sum [R, N], -inf in place of NaN.
    """
    return _add_terms(log_likelihood, _narrow(log_w), _narrow(log_ratio))


def _separate_sum(log_likelihood: Tensor, log_w: Tensor, log_ratio: Tensor) -> Tensor:
    """Return the sum [R, N] of terms [R, N] or [R, 1], -inf in place of NaN."""
    value = log_likelihood + log_w + log_ratio
    return torch.where(value == value, value, -torch.inf)  # isnan does not compile


def _separate_normalise(log_w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normalise the log weights of a step.

    A run without a finite weight gets equal weights, as one whose log weights are not resolved.

    Args:
        log_w: Log weights, [R, N].

    Returns:
        Normalised log weights [R, N], their logsumexp before [R] (-inf if none is finite), weights
        [R, N] and effective sample size [R].
    """
    # one exponential per particle, because exponentials dominate the cost of a small step
    maximum = log_w.detach().amax(1, keepdim=True)
    resolved = is_resolved(maximum)
    maximum = torch.where(torch.isfinite(maximum), maximum, 0.0)
    scaled_w = torch.exp(log_w - maximum)
    total, square_total = _totals(scaled_w)
    lost = ~(torch.isfinite(total) & (total > 0.0) & resolved)
    total, slots = torch.where(lost, 1.0, total), log_w.shape[1]
    log_total = maximum + torch.log(total)
    log_w = torch.where(lost, -math.log(slots), log_w - log_total)
    w = torch.where(lost, 1.0 / slots, scaled_w * (1.0 / total))
    ess = torch.where(lost, slots, total * total / square_total).squeeze(1)
    return log_w, torch.where(lost, -torch.inf, log_total).squeeze(1), w, ess


def _separate_totals(a: Tensor) -> tuple[Tensor, Tensor]:
    """Return sums of rows [R, N] and of their squares, [R, 1] each."""
    return a.sum(1, keepdim=True), a.square().sum(1, keepdim=True)


def has_long_rows(a: Tensor, *_: Tensor) -> bool:
    """Return whether the compiler cannot sum rows [R, N, ...] in registers."""
    return a.shape[1] > 4096


_add_terms = compilable(
    _separate_sum, operator=cpp.sum_log_weights, keep_in_graph=False, use_torch_compiler=False
)
_totals = compilable(_separate_totals, operator=cpp.sum_and_squares, keep_in_graph=has_long_rows)
normalise_updated_weights = compilable(
    _separate_normalise,
    operator=cpp.normalise_weights,
    keep_in_graph=False,
    use_torch_compiler=False,
)
