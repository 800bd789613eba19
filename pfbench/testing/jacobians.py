"""Test of the Jacobians that a model states: they equal finite differences."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor

from pfbench.filter.model_jacobians import find_observation_jacobian, find_propagation_jacobian
from pfbench.model.base import StateSpaceModel


def check_jacobians(
    model: StateSpaceModel, x: Tensor, u: Any, step: float = 1e-4, limit: float = 1e-5
) -> dict[str, float]:
    """Compare `propagation_jacobian` and `observation_jacobian` with central differences.

    Args:
        model: State-space model in double precision.
        x: States at which the derivatives are taken, [R, N, D].
        u: Inputs of a step.
        step: Half width of the difference in each component of the chart.
        limit: Largest error, relative to the largest entry of the Jacobian.

    Returns:
        Relative error of each Jacobian that the model states, by name.

    Raises:
        AssertionError: If the model states none, or an error exceeds the limit.
    """
    mean = model.noise.mean.expand(*x.shape[:2], -1)
    maps: dict[str, tuple[Any, Callable[[Tensor], Tensor], Any]] = {
        "propagation_jacobian": (
            find_propagation_jacobian(model, x, u),
            lambda at: model.propagate(at, u, mean),
            model.chart.subtract,
        ),
        "observation_jacobian": (
            find_observation_jacobian(model, x, u),
            lambda at: model.observation(at, u).mean,
            model.residual,
        ),
    }
    errors = {}
    for name, (value, f, subtract) in maps.items():
        if value is None:
            continue
        expected = _difference_quotients(model, x, f, subtract, step)
        scale = expected.abs().max().clamp(min=1e-300)
        errors[name] = float((value - expected).abs().max() / scale)
        assert errors[name] <= limit, (
            f"{type(model).__name__}.{name} must be the derivative, got a relative error of "
            f"{errors[name]:.2g}."
        )
    assert errors, f"{type(model).__name__} must state a Jacobian, got none."
    return errors


def _difference_quotients(
    model: StateSpaceModel,
    x: Tensor,
    f: Callable[[Tensor], Tensor],
    subtract: Callable[[Tensor, Tensor], Tensor],
    step: float,
) -> Tensor:
    """Return central difference quotients of f along the chart, [R, N, k, d]."""
    increments = step * torch.eye(model.chart.dimension, dtype=x.dtype)
    columns = [
        subtract(f(model.chart.add(x, e)), f(model.chart.add(x, -e))) / (2.0 * step)
        for e in (row.expand(*x.shape[:2], -1) for row in increments)
    ]
    return torch.stack(columns, -1)
