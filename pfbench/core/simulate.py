"""Simulation of state-space models by counter-based random streams.

Initial states, driving noise and measurements of every simulated episode are drawn here. Each
number is a function of seed, run, step, purpose and component. A run therefore has the same values
alone and in any batch, and no global random state is read or written.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple, Protocol, runtime_checkable

import torch
from pyro.distributions import Delta
from torch import Tensor
from torch.distributions import (
    Beta,
    Distribution,
    Gamma,
    Independent,
    LowRankMultivariateNormal,
    MixtureSameFamily,
    MultivariateNormal,
    Normal,
    StudentT,
    TransformedDistribution,
    biject_to,
)

from pfbench.core.chart import Chart
from pfbench.core.density import check_event_dimension
from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record, iterate_steps


class SimulatedModel(Protocol):
    """The part of a state-space model that a simulation uses."""

    @property
    def chart(self) -> Chart:
        """Addition, subtraction and mean of states."""

    @property
    def origin(self) -> Tensor:
        """State about which the initial distribution is defined, [D]."""

    @property
    def noise(self) -> Distribution:
        """Distribution of the driving noise, event [W]."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        """Propagate states by one step.

        Returns states, [R, N, D]. Shapes: x [R, N, D], w [R, N, W].
        """

    def observation(self, x: Tensor, u: Any) -> Distribution:
        """Return the distribution of the measurement.

        Returns distribution with batch [R, N], event [Dy]. Shapes: x [R, N, D].
        """

    def at_step(self, t: int) -> Any:
        """Return the model of step t."""


class SimulatedStep(NamedTuple):
    """One step of a simulated run.

    Attributes:
        t: Step number from 0.
        record: Inputs of the step.
        x: State, [R, 1, D].
        w: Noise that drove the step, [R, 1, W].
        distribution: Distribution of the measurement, batch [R, 1], event [Dy].
    """

    t: int
    record: Record
    x: Tensor
    w: Tensor
    distribution: Distribution


def draw_noise_values(
    distribution: Any, stream: RandomStream, purpose: str, n: int, scale: Tensor | None = None
) -> Tensor:
    """Draw driving noise whose deviation from its mean is multiplied by a factor.

    Returns noise, [R, n, W]. Shapes: distribution [W].
    """
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    if isinstance(base, Normal):
        sd = base.scale if scale is None else scale * base.scale
        return base.loc + sd * stream.normal(purpose, n, distribution.event_shape[0])
    values = draw_values(distribution, stream, purpose, n)
    if scale is None or float(scale) == 1.0:
        return values
    centre = distribution.mean
    if not bool(torch.isfinite(centre).all()):
        raise ValueError(
            f"noise must have a finite mean to be scaled by a noise regime, got "
            f"{type(base).__name__}. Choose a regime that leaves the process noise unchanged."
        )
    return centre + scale * (values - centre)


def draw_initial_state(
    model: SimulatedModel,
    distribution: Any,
    stream: RandomStream,
    purpose: str,
    n: int = 1,
    start: Tensor | None = None,
) -> Tensor:
    """Draw initial states.

    Returns states, [R, n, D]. Shapes: distribution [R], start [R, D].
    """
    check_event_dimension(distribution, f"{type(model).__name__}.initial", model.origin.shape[-1])
    origin = model.origin.expand(1, -1) if start is None else start
    shift = draw_values(distribution, stream, purpose, n)
    return model.chart.add(origin.unsqueeze(1), shift)


def check_state_shape(model: str, before: Tensor, after: Tensor, w: Tensor) -> None:
    """Check that a step of a model keeps the shape of the states."""
    require(
        after.shape == before.shape,
        f"{model}.propagate",
        f"return states {list(before.shape)} for noise {list(w.shape)}",
        list(after.shape),
        "Return one component for each of its names: x[..., 1:2] keeps the axis that x[..., 1] removes; noise_dim is the number of components of the noise.",
    )


def simulate_steps(
    model: SimulatedModel,
    record: Record,
    stream: RandomStream,
    x: Tensor,
    purpose: str,
    scale: Tensor | None = None,
) -> Iterator[SimulatedStep]:
    """Simulate a model step by step.

    Shapes: x [R, 1, D], scale [T].
    """
    name = type(model).__name__
    check_event_dimension(model.noise, f"{name}.noise")
    for t, step_model, step in iterate_steps(model, record):
        factor = None if scale is None else scale[t]
        w = draw_noise_values(model.noise, stream.at_step(t + 1), purpose, 1, factor)
        before, x = x, step_model.propagate(x, step.u, w)
        check_state_shape(name, before, x, w)
        distribution = model.observation(x, step.u)
        check_event_dimension(distribution, f"{name}.observation")
        yield SimulatedStep(t, step, x, w, distribution)


def draw_measurements(
    distributions: Sequence[Distribution],
    stream: RandomStream,
    purpose: str,
    errors: Tensor | None = None,
    first: int = 0,
) -> Tensor:
    """Draw the measurements of all steps, or of those from step `first` on.

    Independent normal measurements of all steps come from one array at stream step 0, the array
    of the noise regimes. Others are drawn at stream step t + 1.

    Returns measurements, [R, T, Dy]. Shapes: distributions [R, 1], errors [R, T, Dy].
    """
    if all(is_independent_normal(distribution) for distribution in distributions):
        mean, sd = (
            torch.stack([getattr(d, name)[:, 0] for d in distributions], 1)
            for name in ("mean", "stddev")
        )
        return mean + sd * (stream.normal(purpose, *mean.shape[1:]) if errors is None else errors)
    rows = [
        draw_values(d, stream.at_step(t), purpose, 1)
        for t, d in enumerate(distributions, first + 1)
    ]
    return torch.cat(rows, 1)


def is_independent_normal(distribution: Any) -> bool:
    """Return whether a distribution is normal with independent components."""
    return isinstance(distribution, Independent) and isinstance(distribution.base_dist, Normal)


# --------------------------------------------------------------------------------------------------
# Quantiles of univariate distributions, by numerical inversion where torch has none.

_CHUNK, _LARGEST_COUNT = 256, 1_000_000  # search range of unbounded discrete distributions


_BISECTIONS = 64  # halve the largest bracket in the unconstrained value, 1400, to below 1e-15

_LARGEST_LOG = 700.0  # exp(700) is finite in float64


def quantile(distribution: Any, u: Tensor) -> Tensor:
    """Compute quantiles of a univariate distribution."""
    try:
        values = (
            _invert_pmf(distribution, u)
            if distribution.support.is_discrete
            else _invert_continuous(distribution, u)
        )
    except NotImplementedError:  # a method that the distribution does not define
        values = None
    if values is None:
        name = type(distribution).__name__
        raise ValueError(
            f"model: a distribution must have icdf, cdf or draw_from to be simulated, got {name}. "
            "Add a method draw_from(source) to its class (see CounterBasedDistribution)."
        )
    return values


def _invert_continuous(distribution: Any, u: Tensor) -> Tensor:
    try:
        values: Tensor = distribution.icdf(u)
    except NotImplementedError:
        return invert_cdf(distribution, u)
    return values


def _invert_pmf(distribution: Any, u: Tensor) -> Tensor | None:
    """Return the smallest value whose cumulative probability reaches u, None for bounded supports."""
    if distribution.has_enumerate_support:
        values = distribution.enumerate_support(expand=False)
        values = values.reshape(-1, *[1] * u.dim())
        cdf = distribution.log_prob(values).exp().cumsum(0)
        smallest: Tensor = values.flatten()[(cdf < u).sum(0).clamp(max=len(values) - 1)]
        return smallest
    if getattr(distribution.support, "upper_bound", None) is not None:
        return None
    count, total = torch.zeros_like(u), torch.zeros_like(u)
    for first in range(0, _LARGEST_COUNT, _CHUNK):
        values = torch.arange(first, first + _CHUNK, dtype=u.dtype, device=u.device)
        values = values.reshape(-1, *[1] * u.dim())
        cdf = total + distribution.log_prob(values).exp().cumsum(0)
        count, total = count + (cdf < u).sum(0), cdf[-1]
        if bool((total >= u).all()):
            return count
    raise ValueError(
        f"model: counts must be below {_LARGEST_COUNT} to be simulated, got "
        f"{type(distribution).__name__} with larger ones. Use a normal approximation."
    )


def invert_cdf(distribution: Any, u: Tensor) -> Tensor:
    """Invert a continuous cdf by bisection on the unconstrained real line.

    Returns quantiles.
    """
    to_support = biject_to(distribution.support)
    sign = float(getattr(to_support, "sign", 1))

    def to_value(z: Tensor) -> Tensor:
        return to_support(sign * z)

    low, high = (_bracket(distribution.cdf, to_value, u, side) for side in (-1.0, 1.0))
    for _ in range(_BISECTIONS):
        middle = 0.5 * (low + high)
        below = distribution.cdf(to_value(middle)) < u
        low, high = torch.where(below, middle, low), torch.where(below, high, middle)
    return to_value(0.5 * (low + high))


def _bracket(cdf: Any, to_value: Callable[[Tensor], Tensor], u: Tensor, side: float) -> Tensor:
    """Return unconstrained values on one side of the quantiles at u."""
    bound = torch.full_like(u, side)
    while float(bound.abs().max()) < _LARGEST_LOG:
        inside_mask = side * (cdf(to_value(bound)) - u) < 0.0
        if not bool(inside_mask.any()):
            break
        bound = (bound * torch.where(inside_mask, 2.0, 1.0)).clamp(-_LARGEST_LOG, _LARGEST_LOG)
    return bound


# --------------------------------------------------------------------------------------------------
# Sampling of distributions by numbers of counter-based random streams.


@runtime_checkable
class CounterBasedDistribution(Protocol):
    """A distribution class that states how it is drawn from a number source.

    Define `draw_from` on a distribution without `icdf` and `cdf` to use it in a model. The result
    has the distribution's batch and event shape, broadcast against the numbers of the source.
    """

    def draw_from(self, source: NumberSource) -> Tensor:
        """Draw values by numbers of a source."""


@dataclass(frozen=True)
class NumberSource:
    """Normal and uniform numbers for one draw of a distribution.

    Arrays broadcast against the batch and event shape of the distribution. Each independent array
    needs a different label: `normal` and `uniform` of one label share their random words.

    Attributes:
        stream: Random stream of one time step.
        purpose: Name of the draw; labels are appended to it.
        n: Number of particles.
        width: Event dimension k.
        particles_first: Arrays are [n, R, k] instead of [R, n, k], for batch shape [R].
        component_axes: Positions at which axes of mixture components are inserted.
    """

    stream: RandomStream
    purpose: str
    n: int
    width: int
    particles_first: bool = False
    component_axes: tuple[int, ...] = ()

    def normal(self, label: str = "", width: int | None = None) -> Tensor:
        """Return standard normal numbers.

        Args:
            label: Label of this array.
            width: Replacement of the event dimension.
        """
        return self._arranged(self.stream.normal(self.purpose + label, self.n, width or self.width))

    def uniform(self, label: str = "", width: int | None = None) -> Tensor:
        """Return float64 numbers in the open interval (0, 1), arranged as in `normal`.

        Args:
            label: Label of this array.
            width: Replacement of the event dimension.
        """
        width = width or self.width
        return self._arranged(self.stream.uniform(self.purpose + label, self.n, width))

    def _arranged(self, values: Tensor) -> Tensor:
        """Order the axes and insert those of mixture components."""
        values = values.transpose(0, 1) if self.particles_first else values
        for axis in self.component_axes:
            values = values.unsqueeze(axis)
        return values


def draw_values(distribution: Any, stream: RandomStream, purpose: str, n: int) -> Tensor:
    """Draw a distribution from a counter-based stream.

    Normal distributions shift and scale normal numbers. Other distributions use, in this order:
    their method `draw_from`, the construction of mixtures, Student's t and transformed
    distributions, a search in discrete supports, `icdf`, and numerical inversion of `cdf`.

    Returns values, [R, n, k]. Shapes: distribution [R].
    """
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    per_run, width = len(distribution.batch_shape) == 1, distribution.event_shape[0]
    if isinstance(base, Normal):
        z = stream.normal(purpose, n, width)
        loc, scale = (a.unsqueeze(1) if per_run else a for a in (base.loc, base.scale))
        return loc + scale * z
    if isinstance(base, MultivariateNormal) and len(base.batch_shape) < 2:
        z = stream.normal(purpose, n, width)
        return (base.loc.unsqueeze(1) if per_run else base.loc) + z @ base.scale_tril.mT
    values = _draw(base, NumberSource(stream, purpose, n, width, per_run)).to(stream.dtype)
    return values.transpose(0, 1) if per_run else values


def _draw(distribution: Any, source: NumberSource) -> Tensor:
    """Draw a distribution whose batch and event shape the source's numbers broadcast against."""
    if isinstance(distribution, CounterBasedDistribution):
        return distribution.draw_from(source)
    for kind, draw in _DRAW.items():
        if isinstance(distribution, kind):
            return draw(distribution, source)
    return quantile(distribution, source.uniform())


def _draw_independent(distribution: Any, source: NumberSource) -> Tensor:
    return _draw(distribution.base_dist, source)


def _draw_normal(distribution: Normal, source: NumberSource) -> Tensor:
    return distribution.loc + distribution.scale * source.normal()


def _draw_multivariate_normal(distribution: MultivariateNormal, source: NumberSource) -> Tensor:
    return distribution.loc + _times(distribution.scale_tril, source.normal())


def _draw_low_rank_normal(distribution: LowRankMultivariateNormal, source: NumberSource) -> Tensor:
    low: Tensor = distribution.cov_factor
    shared = _times(low, source.normal(".factor", low.shape[-1]))
    return distribution.loc + distribution.cov_diag.sqrt() * source.normal() + shared


def _draw_transformed(distribution: TransformedDistribution, source: NumberSource) -> Tensor:
    values = _draw(distribution.base_dist, source)
    for transform in distribution.transforms:
        values = transform(values)
    return values


def _draw_beta(distribution: Beta, source: NumberSource) -> Tensor:
    a, b = distribution.concentration1, distribution.concentration0
    first = invert_cdf(Gamma(a, torch.ones_like(a)), source.uniform())
    second = invert_cdf(Gamma(b, torch.ones_like(b)), source.uniform(".second"))
    return first / (first + second)


def _draw_point_mass(distribution: Delta, source: NumberSource) -> Tensor:
    values: Tensor = distribution.v + torch.zeros_like(source.uniform())
    return values


def _times(matrix: Tensor, vector: Tensor) -> Tensor:
    """Multiply matrices [..., k, l] by vectors [..., l]."""
    return (matrix @ vector.unsqueeze(-1)).squeeze(-1)


def _draw_mixture(distribution: MixtureSameFamily, source: NumberSource) -> Tensor:
    """Choose a component by one uniform number and draw it."""
    joint = len(distribution.event_shape)
    cdf = distribution.mixture_distribution.probs.cumsum(-1)
    u = source.uniform(".component", 1) if joint else source.uniform(".component").unsqueeze(-1)
    index = (u > cdf).sum(-1, keepdim=True).clamp(max=cdf.shape[-1] - 1)
    axis = -1 - joint
    inner = replace(
        source,
        purpose=source.purpose + ".of",
        component_axes=(*source.component_axes, axis),
    )
    values = _draw(distribution.component_distribution, inner)
    shape = torch.broadcast_shapes(values.shape, (*cdf.shape, *distribution.event_shape))
    index = index.unsqueeze(-1) if joint else index
    return torch.take_along_dim(values.expand(shape), index, axis).squeeze(axis)


def _draw_student_t(distribution: StudentT, source: NumberSource) -> Tensor:
    """Draw Student's t by the polar method, exact for every positive df [Bailey 1994]."""
    df, log_u = distribution.df, torch.log(source.uniform())
    radius = torch.sqrt(df * torch.expm1(-2.0 / df * log_u))
    angle = 2.0 * math.pi * source.uniform(".angle")
    return distribution.loc + distribution.scale * radius * torch.cos(angle)


_DRAW: dict[type, Callable[[Any, NumberSource], Tensor]] = {
    Independent: _draw_independent,
    Normal: _draw_normal,
    MultivariateNormal: _draw_multivariate_normal,
    LowRankMultivariateNormal: _draw_low_rank_normal,
    MixtureSameFamily: _draw_mixture,
    TransformedDistribution: _draw_transformed,
    StudentT: _draw_student_t,
    Beta: _draw_beta,
    Delta: _draw_point_mass,
}
