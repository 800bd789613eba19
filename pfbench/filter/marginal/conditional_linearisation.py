"""Partition of the state, and linearisation of its conditionally normal part."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal

from pfbench.core.covariance import factor
from pfbench.core.record import Record
from pfbench.filter.linearisation import (
    derivative,
    is_normal,
    linearised_innovation,
    linearised_mean,
    mask_covariance,
    mean_noise,
    unwrap_independent,
)
from pfbench.filter.whitening import log_determinant
from pfbench.model.base import StateSpaceModel


class StatePartition(NamedTuple):
    """Partition of the components of a state difference, in the chart.

    Attributes:
        sampled_states: Components s.
        linear: Components l.
        is_common: All particles have the same covariance of l.
    """

    sampled_states: list[int]
    linear: list[int]
    is_common: bool


def partition_state(model: StateSpaceModel, sampled: Sequence[str] | None) -> StatePartition:
    """Return the partition by names, or by the model's declaration.

    Args:
        model: State-space model.
        sampled: Names of sampled groups or states, or None.

    Returns:
        The partition.

    Raises:
        ValueError: If a name is unknown, or no name is set and nothing is declared linear.
    """
    d = len(model.names)
    if sampled is None:
        linear = list(range(d)) if model.linear else sorted(model.linear_given)
        if not linear:
            raise ValueError(
                "filter.sampled_states must be names for a model with no component that is linear "
                f"given the rest, got null with {type(model).__name__}. Choose groups of "
                f"{sorted(model.groups)} (filter=sir samples all). The rest is linearised."
            )
        return StatePartition([i for i in range(d) if i not in linear], linear, model.linear)
    unknown = [name for name in sampled if name not in model.groups and name not in model.names]
    if unknown:
        raise ValueError(
            f"filter.sampled_states must be groups {sorted(model.groups)} or states "
            f"{list(model.names)} of {type(model).__name__}, got {unknown}. Correct the names."
        )
    selected: set[int] = set()
    for name in sampled:
        selected |= set(model.groups[name]) if name in model.groups else {model.names.index(name)}
    return StatePartition(
        sorted(selected), [i for i in range(d) if i not in selected], model.linear
    )


def predict_with_root(
    model: StateSpaceModel, x: Tensor, root: Tensor, u: Any, split: StatePartition
) -> tuple[Tensor, Tensor]:
    """Predict particles without noise and linearise about the prediction.

    Args:
        model: State-space model.
        x: Particles, [R, N, D].
        root: Root of the conditional covariance, [R, N or 1, l, l].
        u: Inputs of the step.
        split: Partition of the state.

    Returns:
        Prediction [R, N, D] and root A [R, N or 1, d, m] of the joint normal distribution.
    """
    chart, noise, gain = model.chart, model.noise, model.noise_gain(u)
    d, w = len(split.linear), 0 if gain is not None else model.noise_dim
    predicted = model.propagate(x, u, mean_noise(model, x))

    def propagate(at: Tensor, xi: Tensor) -> Tensor:
        driven = mean_noise(model, xi)
        if w:
            driven = driven + noise.stddev * xi[..., d:]
        start = chart.add(at, embed_components(xi[..., :d], split.linear, chart.dimension))
        return model.propagate(start, u, driven)

    centre = model.origin.expand(len(x), 1, -1) if split.is_common else x
    slopes = derivative(propagate, centre, d + w, chart.subtract)
    if gain is not None:
        scaled_gain = (gain * noise.stddev).unsqueeze(1)
        slopes = torch.cat([slopes, scaled_gain.expand(*slopes.shape[:2], -1, -1)], -1)
    state_root, noise_root = slopes[..., :d] @ root, slopes[..., d:]
    return predicted, torch.cat([state_root, noise_root.expand(*state_root.shape[:2], -1, -1)], -1)


def linearise_measurement(
    model: StateSpaceModel, x: Tensor, record: Record, split: StatePartition
) -> tuple[Tensor, Tensor, Tensor]:
    """Linearise the measurement in l, in units of the measurement noise.

    Args:
        model: State-space model.
        x: Particles, [R, N, D].
        record: Record of the step.
        split: Partition of the state.

    Returns:
        H [R, N or 1, k, l] and y - y_hat [R, N, k], 0 if unobserved, and log scale [R, N].
    """
    distribution: Any = model.observation(x, record.u)
    check_normal(model, "the measurement's noise", distribution)

    def predict(at: Tensor, xi: Tensor) -> Tensor:
        return linearised_mean(
            model.observation(
                model.chart.add(at, embed_components(xi, split.linear, model.chart.dimension)),
                record.u,
            )
        )

    centre = model.origin.expand(len(x), 1, -1) if split.is_common else x
    h = derivative(predict, centre, len(split.linear), model.residual)
    observed_mask = ~torch.isnan(record.y).unsqueeze(1)
    h = torch.where(observed_mask.unsqueeze(-1), h, 0.0)
    r = linearised_innovation(model, x, record)
    if not isinstance(distribution, MultivariateNormal):
        sd = torch.where(observed_mask, distribution.stddev, 1.0)
        return h / (sd[:, :1] if split.is_common else sd).unsqueeze(-1), r / sd, sd.log().sum(-1)
    covariance = (
        distribution.covariance_matrix[:, :1] if split.is_common else distribution.covariance_matrix
    )
    root, ok = factor(mask_covariance(covariance, observed_mask))
    log_sd = torch.where(ok, log_determinant(root), torch.nan)
    white = torch.linalg.solve_triangular(root, h, upper=False)
    return (
        white,
        torch.linalg.solve_triangular(root, r.unsqueeze(-1), upper=False).squeeze(-1),
        log_sd,
    )


def embed_components(values: Tensor, indices: list[int], d: int) -> Tensor:
    """Embed components in a state difference, with 0 for all others.

    Args:
        values: Components, [..., l], with or without tangents.
        indices: Indices of the components.
        d: Dimension of the difference.

    Returns:
        Difference, [..., d].
    """
    return values @ torch.eye(d, dtype=values.dtype, device=values.device)[indices]


def check_normal(model: StateSpaceModel, label: str, distribution: Distribution) -> None:
    """Check that a noise distribution is normal.

    Args:
        model: State-space model, for the message.
        label: Name of the noise, for the message.
        distribution: Distribution to check.

    Raises:
        ValueError: If it is not normal.
    """
    if not is_normal(distribution):
        raise ValueError(
            f"filter RaoBlackwellisedFilter must have a model where {label} is normal, got "
            f"{type(unwrap_independent(distribution)).__name__} in {type(model).__name__}. "
            "Sample all states (filter=sir), or choose normal noise."
        )
