"""Derivatives of a model along its chart, and checks of Gaussian approximations."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor
from torch.autograd import forward_ad
from torch.distributions import Distribution, Independent, MultivariateNormal, Normal

from pfbench.core.density import has_finite_moments
from pfbench.core.linear_algebra import jacobian, shared_distribution_covariance, squared_length
from pfbench.core.parameter_checks import require
from pfbench.core.record import Record
from pfbench.filter.belief import (
    compute_spread,
    normalise_log_weights,
)
from pfbench.kernels.dispatch import is_capturing
from pfbench.model.base import StateSpaceModel

_POINTS = 200_000  # states differentiated at a time
_PROBES = 4  # states and noises at which additive noise is verified


def derivative(
    f: Callable[[Tensor, Tensor], Tensor],
    at: Tensor,
    d: int,
    subtract: Callable[[Tensor, Tensor], Tensor] = torch.subtract,
) -> Tensor:
    """Compute the derivative of a map of states and increments at increment zero.

    All directions are evaluated in one forward pass, as additional particles.

    Returns derivative, [R, N, k, d]. Shapes: f [R, P, D], at [R, N, D].
    """
    runs, n = at.shape[:2]
    parts = []
    eye = torch.eye(d, dtype=at.dtype, device=at.device)
    for directions in eye.split(max(1, _POINTS // (runs * n))):
        xi = directions.repeat(runs, n, 1)
        with forward_ad.dual_level():
            dual = forward_ad.make_dual(torch.zeros_like(xi), xi)
            value = f(at.repeat_interleave(len(directions), 1), dual)
            primal = forward_ad.unpack_dual(value)[0].detach()
            difference, tangent = forward_ad.unpack_dual(subtract(value, primal))
        if tangent is None:  # the map does not depend on xi
            tangent = torch.zeros_like(difference)
        parts.append(tangent.unflatten(1, (n, len(directions))))
    return torch.cat(parts, 2).mT


def compute_additive_gain(model: StateSpaceModel, x: Tensor, root: Tensor, u: Any) -> Tensor | None:
    """Return the gain of additive noise, stated by the model or verified numerically.

    If the model does not define `noise_gain`, its derivative in the noise is computed at the mean
    state. It is the gain if `propagate` agrees with x (+) L w at other states (several standard
    deviations and units away) and for large noises of both signs. Otherwise the noise is treated as
    not additive. This is always valid, because the noise then passes through the linearisation
    rule. Noise is also treated as not additive in single precision, which cannot verify the gain,
    and while a step is recorded for compilation.

    Returns gain, [R or 1, d, W]; None if the noise is not additive. Shapes: x [R, D], root
    [R, d, d].
    """
    if model.has_noise_gain or is_capturing() or x.dtype != torch.float64:
        return model.noise_gain(u)
    chart, d, distribution = model.chart, model.chart.dimension, model.noise
    centre, sd = distribution.mean, distribution.stddev
    at = x.unsqueeze(1)

    def propagate_noise(w: Tensor) -> Tensor:
        return model.propagate(at.expand(-1, w.shape[1], -1), u, centre + w)

    value = propagate_noise(centre.new_zeros(len(x), 1, len(centre)))
    gain = jacobian(propagate_noise, value, len(centre), chart.subtract)
    with torch.no_grad():
        count = _PROBES * (d + len(centre))
        angles = torch.arange(1.0, count + 1.0, dtype=x.dtype, device=x.device)
        waves = 3.0 * torch.sin(angles**2).view(_PROBES, -1)  # fixed and irregular
        spread = root.diagonal(dim1=-2, dim2=-1).unsqueeze(1)
        states = chart.add(at, waves[:, :d] @ root.mT + waves[:, :d] * (0.1 * spread + 0.01))
        w = (sd * waves[:, d:]).expand(len(x), -1, -1)
        additive = is_noise_gain(model, states, u, w, gain)
    return gain if additive else None


def check_moments(model: StateSpaceModel, name: str, distribution: Any) -> None:
    """Check that a Gaussian filter can approximate a distribution of a model.

    Normal distributions cost a type check only.
    """
    if not has_finite_moments(distribution):
        kind = type(unwrap_independent(distribution)).__name__
        choice = (
            "an EKF, UKF or CKF with measurement_update=StudentObservationUpdate(), or "
            if name == "observation"
            else ""
        )
        raise ValueError(
            f"{type(model).__name__}.{name} must have a finite mean and variance for a Gaussian "
            f"filter, got {kind}. Use {choice}a particle filter, for example filter=sir."
        )


def mean_noise(model: StateSpaceModel, x: Tensor) -> Tensor:
    """Return the mean noise of each state.

    Returns mean noise, [R, N, W]. Shapes: x [R, N, ...].
    """
    return model.noise.mean.expand(*x.shape[:2], -1)


def transition_jacobian(model: StateSpaceModel, x: Tensor, u: Any) -> Tensor:
    """Compute the Jacobian of the noise-free step.

    Returns Jacobian, [R, N, d, d]. Shapes: x [R, N, D].
    """
    stated = find_propagation_jacobian(model, x, u)
    if stated is not None:
        return stated
    chart = model.chart

    def propagate_increment(a: Tensor, xi: Tensor) -> Tensor:
        return model.propagate(chart.add(a, xi), u, mean_noise(model, xi))

    return derivative(propagate_increment, x, chart.dimension, chart.subtract)


def measurement_jacobian(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Compute the Jacobian of the measurement mean.

    Returns Jacobian, [R, N, k, d]; rows of missing components are 0. Shapes: x [R, N, D].
    """

    def observe_increment(a: Tensor, xi: Tensor) -> Tensor:
        return linearised_mean(model.observation(model.chart.add(a, xi), record.u))

    h = find_observation_jacobian(model, x, record.u)
    if h is None:
        h = derivative(observe_increment, x, model.chart.dimension, model.residual)
    return torch.where(torch.isnan(record.y)[:, None, :, None], 0.0, h)


def linearised_innovation(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Compute y - y_hat of states.

    Returns Innovation, [R, N, k]; 0 for missing components. Shapes: x [R, N, D].
    """
    y = record.y.unsqueeze(1)
    r = model.residual(y.nan_to_num(), linearised_mean(model.observation(x, record.u)))
    return torch.where(torch.isnan(y), 0.0, r)


def linearised_mean(distribution: Any) -> Tensor:
    """Return the mean of a distribution."""
    value: Tensor = distribution.mean
    return value


def unwrap_independent(distribution: Distribution) -> Distribution:
    """Return the univariate distribution of independent components, else the argument."""
    return distribution.base_dist if isinstance(distribution, Independent) else distribution


def is_normal(distribution: Distribution) -> bool:
    """Return whether a distribution is normal."""
    return isinstance(unwrap_independent(distribution), Normal | MultivariateNormal)


def mask_covariance(covariance: Tensor, observed_mask: Tensor) -> Tensor:
    """Replace rows and columns of missing components by those of the unit matrix.

    Returns covariance, [..., k, k]. Shapes: covariance [..., k, k], observed_mask [..., k].
    """
    both = observed_mask.unsqueeze(-1) & observed_mask.unsqueeze(-2)
    eye = torch.eye(observed_mask.shape[-1], dtype=covariance.dtype, device=covariance.device)
    return torch.where(both, covariance, eye)


def batch_product(m: Tensor, e: Tensor) -> Tensor:
    """Multiply each vector by its matrix.

    Returns products, [R, N, k]. Shapes: m [R, 1 or N, k, l], e [R, 1 or N, l].
    """
    return e @ m[:, 0].mT if m.shape[1] == 1 else (m @ e.unsqueeze(-1)).squeeze(-1)


# --------------------------------------------------------------------------------------------------
# Derivatives that a model states itself, in place of derivatives by automatic differentiation.
#
# A model may define `propagation_jacobian(x, u)`, the derivative of the noise-free step in the chart, of shape
# [R or 1, N or 1, d, d]. It may define `observation_jacobian(x, u)`, the derivative of the mean measurement,
# [R or 1, N or 1, k, d]. Both are taken at states x [R, N, D]. `pfbench.testing.check_jacobians` compares them with
# finite differences. A class that overrides `propagate` or `observation` alone hides the Jacobian of its base
# class. `noise_gain(u)` is the derivative in the noise, if the noise is additive.

_ROUNDING = 1e3  # machine epsilons that `propagate` may be off


def find_propagation_jacobian(model: StateSpaceModel, x: Tensor, u: Any) -> Tensor | None:
    """Return the Jacobian of the noise-free step that a model states.

    Returns Jacobian, [R, N, d, d]; None if the model states none. Shapes: x [R, N, D].
    """
    return _find(model, "propagation_jacobian", "propagate", x, u)


def find_observation_jacobian(model: StateSpaceModel, x: Tensor, u: Any) -> Tensor | None:
    """Return the Jacobian of the mean measurement that a model states.

    Returns Jacobian, [R, N, k, d]; None if the model states none. Shapes: x [R, N, D].
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

    Shapes: x [R, N, D], w [R, N, W], gain [R or 1, d, W].
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

    Returns fixed irregular numbers, [R, N, W]. Shapes: x [R, N, D].
    """
    noise: Any = model.noise
    shape = (x.shape[1], model.noise_dim)
    numbers = torch.arange(1.0, shape[0] * shape[1] + 1.0, dtype=x.dtype, device=x.device)
    sd = noise.stddev if has_finite_moments(noise) else torch.ones_like(noise.mean)
    w: Tensor = (3.0 * sd * torch.sin(numbers**2).view(shape)).expand(x.shape[0], -1, -1)
    return w


def check_noise_gain(model: StateSpaceModel, x: Tensor, u: Any) -> None:
    """Check the noise gain that a model states at some states.

    Shapes: x [R, N, D].
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
    require(
        is_noise_gain(model, x, u, probe_noise(model, x), gain),
        name,
        "be the L of propagate(x, u, mean + w) = propagate(x, u, mean) (+) L w",
        "another matrix",
        "Correct it, or return None if the noise is not additive. A class that overrides propagate must override noise_gain, too. pfbench.testing.check_jacobians shows the size of the error.",
    )


def around_first(
    residual: Callable[[Tensor, Tensor], Tensor],
) -> Callable[[Tensor, Tensor], Tensor]:
    """Make the weighted mean of values that may wrap: the mean of residuals to the first value."""

    def mean(y: Tensor, w: Tensor) -> Tensor:
        return y[:, 0] + (w.unsqueeze(-1) * residual(y, y[:, :1])).sum(1)

    return mean


# --------------------------------------------------------------------------------------------------
# Moments of a measurement that weighted particles predict.


def compute_nis(
    model: StateSpaceModel, x: Tensor, log_w: Tensor, record: Record
) -> tuple[Tensor, Tensor]:
    """Compute the normalised innovation squared (NIS) of predicted particles.

    Returns NIS [R] and the number of observed components [R], which is its expectation. The NIS is
    NaN where the mean or variance of the observation distribution is infinite. Shapes: x [R, N, D],
    log_w [R, N].
    """
    predicted_y: Any = model.observation(x, record.u)
    observed_mask = ~torch.isnan(record.y)
    if not has_finite_moments(predicted_y):
        return torch.full_like(log_w[:, 0], torch.nan), observed_mask.sum(1)
    y, covariance = predicted_y.mean, shared_distribution_covariance(predicted_y)
    if y.shape[1] == 1:  # no spread
        y_hat = y[:, 0] + model.residual(y[:, 0], y[:, 0])  # infinite becomes NaN
        covariance = covariance[:, 0]
    else:
        w = normalise_log_weights(log_w)
        y_hat, spread, noise = predict_moments(model, y, covariance, w)
        covariance = spread + noise
    r = torch.where(observed_mask, model.residual(record.y.nan_to_num(), y_hat), 0.0)
    return squared_length(r, mask_covariance(covariance, observed_mask)), observed_mask.sum(1)


def predict_moments(
    model: StateSpaceModel, y: Tensor, covariance: Tensor, w: Tensor
) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the moments of a measurement predicted by weighted particles.

    Returns mean [R, k], covariance due to the particles [R, k, k], and mean noise covariance
    [R or 1, k, k]. Shapes: y [R, N, k], covariance [R, N or 1, k, k], w [R, N].
    """
    y_hat = around_first(model.residual)(y, w)
    deviations = torch.where(w.unsqueeze(-1) > 0.0, model.residual(y, y_hat.unsqueeze(1)), 0.0)
    noise = (
        (w[..., None, None] * covariance).sum(1) if covariance.shape[1] > 1 else covariance[:, 0]
    )
    all_components = torch.arange(y.shape[-1], device=y.device).unsqueeze(0)
    spread = compute_spread(deviations, torch.zeros_like(y_hat), w, all_components).squeeze(1)
    return y_hat, spread, noise
