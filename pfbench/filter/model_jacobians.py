"""Jacobians that a model states itself, in place of derivatives by automatic differentiation.

A model may define `propagation_jacobian(x, u)`, the derivative of the noise-free step in the chart, of shape
[R or 1, N or 1, d, d]. It may define `observation_jacobian(x, u)`, the derivative of the mean measurement,
[R or 1, N or 1, k, d]. Both are taken at states x [R, N, D]. `pfbench.testing.check_jacobians` compares them with
finite differences. A class that overrides `propagate` or `observation` alone hides the Jacobian of its base
class.
"""

from __future__ import annotations

from typing import Any

from torch import Tensor

from pfbench.model.base import StateSpaceModel


def find_propagation_jacobian(model: StateSpaceModel, x: Tensor, u: Any) -> Tensor | None:
    """Return the Jacobian of the noise-free step that a model states.

    Args:
        model: State-space model.
        x: States, [R, N, D].
        u: Inputs of the step.

    Returns:
        Jacobian, [R, N, d, d]; None if the model states none.
    """
    return _find(model, "propagation_jacobian", "propagate", x, u)


def find_observation_jacobian(model: StateSpaceModel, x: Tensor, u: Any) -> Tensor | None:
    """Return the Jacobian of the mean measurement that a model states.

    Args:
        model: State-space model.
        x: States, [R, N, D].
        u: Inputs of the step.

    Returns:
        Jacobian, [R, N, k, d]; None if the model states none.
    """
    return _find(model, "observation_jacobian", "observation", x, u)


def _find(model: StateSpaceModel, name: str, of: str, x: Tensor, u: Any) -> Tensor | None:
    """Return the result of the method `name`, if no class nearer to the model overrides `of` alone."""
    for kind in type(model).__mro__:
        if name in vars(kind):
            value: Tensor = getattr(model, name)(x, u)
            return value.expand(*x.shape[:2], *value.shape[-2:])
        if of in vars(kind):
            return None
    return None
