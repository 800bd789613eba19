"""Derivatives that a model states itself, in place of derivatives by automatic differentiation.

A model may define `propagation_jacobian(x, u)`, the derivative of the noise-free step in the chart, of shape
[R or 1, N or 1, d, d]. It may define `observation_jacobian(x, u)`, the derivative of the mean measurement,
[R or 1, N or 1, k, d]. Both are taken at states x [R, N, D]. `pfbench.testing.check_jacobians` compares them with
finite differences. A class that overrides `propagate` or `observation` alone hides the Jacobian of its base
class. `noise_gain(u)` is the derivative in the noise, if the noise is additive.
"""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from pfbench.core.density import has_finite_moments
from pfbench.model.base import StateSpaceModel

_ROUNDING = 1e3  # machine epsilons that `propagate` may be off


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


def is_noise_gain(model: StateSpaceModel, x: Tensor, u: Any, w: Tensor, gain: Tensor) -> bool:
    """Return whether noise enters as x (+) L w in the chart, to rounding.

    Args:
        model: State-space model.
        x: States at which it is verified, [R, N, D].
        u: Inputs of the step.
        w: Deviations of the noise from its mean, [R, N, W].
        gain: Gain L, [R or 1, d, W].

    Returns:
        False if a finite state contradicts it.
    """
    chart, centre = model.chart, torch.nan_to_num(model.noise.mean)
    quiet_x = model.propagate(x, u, centre + torch.zeros_like(w))
    shift = w @ gain.mT
    off = chart.subtract(model.propagate(x, u, centre + w), chart.add(quiet_x, shift)).abs()
    size = quiet_x.abs().nan_to_num().amax(1, keepdim=True)
    size = size if chart.flat else size.amax(-1, keepdim=True)
    tolerance = _ROUNDING * torch.finfo(x.dtype).eps * (size + shift.abs())
    return bool(((off <= tolerance) | ~off.isfinite()).all())


def probe_noise(model: StateSpaceModel, x: Tensor) -> Tensor:
    """Return deviations of the noise from its mean, of up to three standard deviations.

    Args:
        model: State-space model.
        x: States, [R, N, D].

    Returns:
        Fixed irregular numbers, [R, N, W].
    """
    noise: Any = model.noise
    shape = (x.shape[1], model.noise_dim)
    numbers = torch.arange(1.0, shape[0] * shape[1] + 1.0, dtype=x.dtype, device=x.device)
    sd = noise.stddev if has_finite_moments(noise) else torch.ones_like(noise.mean)
    w: Tensor = (3.0 * sd * torch.sin(numbers**2).view(shape)).expand(x.shape[0], -1, -1)
    return w


def check_noise_gain(model: StateSpaceModel, x: Tensor, u: Any) -> None:
    """Check the noise gain that a model states at some states.

    Args:
        model: State-space model.
        x: States, [R, N, D].
        u: Inputs of the step.

    Raises:
        ValueError: If the shape is wrong, or if `propagate` contradicts the gain.
    """
    gain, name = model.noise_gain(u), f"{type(model).__name__}.noise_gain"
    if gain is None:
        return
    shape = (model.chart.dimension, model.noise_dim)
    if gain.dim() != 3 or gain.shape[-2:] != shape or gain.shape[0] not in (1, x.shape[0]):
        raise ValueError(
            f"{name} must have shape [{x.shape[0]} or 1, {shape[0]}, {shape[1]}] of runs, state and "
            f"noise, got {list(gain.shape)}."
        )
    if not is_noise_gain(model, x, u, probe_noise(model, x), gain):
        raise ValueError(
            f"{name} must be the L of propagate(x, u, mean + w) = propagate(x, u, mean) (+) L w, got "
            "another matrix. Correct it, or return None if the noise is not additive. A class that "
            "overrides propagate must override noise_gain, too. pfbench.testing.check_jacobians "
            "shows the size of the error."
        )
