"""Simulation of state-space models by counter-based random streams.

Initial states, driving noise and measurements of every simulated episode are drawn here. Each
number is a function of seed, run, step, purpose and component. A run therefore has the same values
alone and in any batch, and no global random state is read or written.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from pfbench.core.chart import Chart
from pfbench.core.density import check_event_dimension
from pfbench.core.distribution_sampling import draw_values
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
        x = step_model.propagate(x, step.u, w)
        distribution = model.observation(x, step.u)
        check_event_dimension(distribution, f"{name}.observation")
        yield SimulatedStep(t, step, x, w, distribution)


def draw_measurements(
    distributions: Sequence[Distribution],
    stream: RandomStream,
    purpose: str,
    errors: Tensor | None = None,
) -> Tensor:
    """Draw the measurements of all steps.

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
    rows = [draw_values(d, stream.at_step(t + 1), purpose, 1) for t, d in enumerate(distributions)]
    return torch.cat(rows, 1)


def is_independent_normal(distribution: Any) -> bool:
    """Return whether a distribution is normal with independent components."""
    return isinstance(distribution, Independent) and isinstance(distribution.base_dist, Normal)
