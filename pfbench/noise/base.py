"""Protocol of noise regimes, and the process noise of a step."""

from __future__ import annotations

from typing import Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels
from pfbench.noise.distributions import ErrorDistribution

_SAMPLES = 20  # samples of process noise within a step


class NoiseRegime(Protocol):
    """Deviations of a scenario from nominal noise."""

    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        """Draw the errors of the measurements.

        Args:
            draws: Random stream, which decides the runs.
            channels: Nominal noise, kind and source of each component.
            time: Times of the measurements, [T], s.

        Returns:
            Errors, [R, T, Dy]. NaN marks a missing component.
        """

    def process_factors(self, time: Tensor) -> Tensor:
        """Return factors on the process noise variance at times [T] s: [T].

        In a simulation the factor applies to the white noise of the inertial sensors.
        """

    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        """Return the distribution of the errors at times [T] s, for oracle noise.

        Args:
            channels: Nominal noise, kind and source of each component.
            time: Times of the measurements, [T], s.

        Returns:
            Family, shift and scale of the errors.

        Raises:
            ValueError: If the errors do not have a distribution per step.
        """


class LayeredRegime(NoiseRegime):
    """A regime that changes the errors of another regime, with the process noise of that one.

    Attributes:
        base_regime: The other regime.
    """

    base_regime: NoiseRegime

    @override
    def process_factors(self, time: Tensor) -> Tensor:
        return self.base_regime.process_factors(time)


def process_variance_factors(noise: NoiseRegime, time: Tensor) -> Tensor:
    """Compute factors on the process noise variance of each step.

    A factor is the mean over the interval that ends at the time of the step. The first interval is
    as long as the second.

    Args:
        noise: Noise regime.
        time: Times at the ends of the steps, [T], s.

    Returns:
        Factors, [T].
    """
    spans = torch.diff(time, prepend=2 * time[:1] - time[1:2]) if len(time) > 1 else time
    inside = 1.0 - (torch.arange(_SAMPLES, dtype=time.dtype) + 0.5) / _SAMPLES
    middles = (time[:, None] - spans[:, None] * inside).flatten()
    factors = noise.process_factors(torch.cat([middles, time[-1:]]))[
        :-1
    ]  # the last time defines the end of the record
    return factors.unflatten(0, (-1, _SAMPLES)).mean(1)


def check_unit_process(noise: NoiseRegime, time: Tensor) -> None:
    """Check that a regime does not change process noise, for recorded motion.

    Args:
        noise: Noise regime.
        time: Times, [T], s.

    Raises:
        ValueError: If the regime changes the process noise.
    """
    if bool((noise.process_factors(time) != 1.0).any()):
        raise ValueError(
            "noise must not change the process noise of a scenario with recorded sensors. "
            "Set noise.process_variance_factors=[1.0,1.0], or choose a simulated scenario."
        )


def make_no_distribution_error(noise: str, reason: str) -> ValueError:
    """Make the error of a regime without a distribution per step.

    Args:
        noise: Name of the regime.
        reason: Explanation.

    Returns:
        The error.
    """
    return ValueError(
        f"oracle_noise must be false for noise={noise}, got true. Its errors do not have a "
        f"distribution per step, because {reason}. Set oracle_noise=false."
    )
