"""Noise regimes with memory: Gauss-Markov noise and reflected signals."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels
from pfbench.noise.base import (
    ErrorDistribution,
    LayeredRegime,
    NoiseRegime,
    NominalNoise,
    make_no_distribution_error,
    make_normal,
    normal_plus_exponential,
)


@dataclass(frozen=True)
class GaussMarkovNoise(LayeredRegime):
    """First-order Gauss-Markov noise in addition to other errors.

    Exact at any spacing of the times.

    Attributes:
        sd_ratio: Stationary standard deviation in nominal standard deviations.
        correlation_time_s: Time at which the correlation is 1/e, s.
        base_regime: Errors to which it is added.

    Raises:
        ValueError: If `sd_ratio` is negative, `correlation_time_s` is not positive, or a filter
            requests the distribution.
    """

    sd_ratio: float = 1.0
    correlation_time_s: float = 30.0
    base_regime: NoiseRegime = field(default_factory=NominalNoise)

    def __post_init__(self) -> None:
        require_ranges(
            "noise",
            self,
            sd_ratio="[0, inf] Give a size in nominal standard deviations.",
            correlation_time_s="(0, inf]",
        )

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        driver = draws.normal("world.correlated", len(time), len(channels.sd))
        correlations = torch.exp(-torch.diff(time) / self.correlation_time_s).tolist()
        x = [driver[:, 0]]
        for t, rho in enumerate(correlations, 1):
            x.append(rho * x[-1] + math.sqrt(1.0 - rho * rho) * driver[:, t])
        return self.base_regime.draw_errors(
            draws, channels, time
        ) + self.sd_ratio * channels.sd * torch.stack(x, 1)

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        raise make_no_distribution_error(
            noise="gauss_markov", reason="its errors are correlated in time"
        )


@dataclass(frozen=True)
class NonLineOfSightNoise(LayeredRegime):
    """Reflected signals: measurements with an exponential bias at random times.

    The regime acts on ranges, in a scenario without ranges on positions, otherwise on all
    components. All components of a source are affected together, each with a different bias, which is
    added to the measurement. [ours]

    Attributes:
        probability: Probability of a missing line of sight, at any time.
        mean_delay_sd: Mean of the bias in nominal standard deviations of the component.
        mean_dwell_s: Mean duration without line of sight, s. None draws each epoch independently.
            Otherwise a stationary two-state Markov chain in continuous time, with a constant bias
            for the duration. [ours]
        base_regime: Errors to which the bias is added.

    Raises:
        ValueError: If `probability` is outside [0, 1] (or 1 with `mean_dwell_s`), a duration or
            mean is not positive, or a filter requests a distribution per step that does not exist.
    """

    probability: float = 0.2
    mean_delay_sd: float = 5.0
    mean_dwell_s: float | None = None
    base_regime: NoiseRegime = field(default_factory=NominalNoise)

    def __post_init__(self) -> None:
        end = "]" if self.mean_dwell_s is None else ") It is below 1 if noise.mean_dwell_s is set."
        require_ranges(
            "noise",
            self,
            probability=f"[0, 1{end}",
            mean_delay_sd="(0, inf)",
            mean_dwell_s="null or (0, inf)",
        )

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        sources, of_source = torch.unique(torch.tensor(channels.source), return_inverse=True)
        u = draws.uniform("world.sight", len(time), len(sources))[..., of_source]
        lag = -self.mean_delay_sd * torch.log(
            draws.uniform("world.reflection", len(time), len(channels.sd))
        )
        if self.mean_dwell_s is None:
            bias = torch.where(u < self.probability, lag, 0.0)
        else:
            bias = self._persistent_bias(u, lag, time, self.mean_dwell_s)
        affected = torch.tensor(_affected(channels)).to(bias)
        return self.base_regime.draw_errors(draws, channels, time) + bias * affected * channels.sd

    def _persistent_bias(self, u: Tensor, lag: Tensor, time: Tensor, dwell: float) -> Tensor:
        """Compute the bias [R, T, Dy] of a two-state Markov chain with mean stay `dwell`."""
        p = self.probability
        correlations = torch.exp(-torch.diff(time) / (dwell * (1.0 - p))).tolist()
        hidden = u[:, 0] < p
        bias = torch.where(hidden, lag[:, 0], 0.0)
        biases = [bias]
        for t, rho in enumerate(correlations, 1):
            previous, hidden = hidden, u[:, t] < p * (1.0 - rho) + rho * hidden
            bias = torch.where(hidden, torch.where(previous, bias, lag[:, t]), 0.0)
            biases.append(bias)
        return torch.stack(biases, 1)

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        family, shift, scale = self.base_regime.error_distribution(channels, time)
        affected = _affected(channels)
        sources = [source for source, a in zip(channels.source, affected, strict=True) if a]
        if self.mean_dwell_s is not None:
            raise make_no_distribution_error(noise="nlos", reason="its biases persist")
        if len(set(sources)) < len(sources):
            raise make_no_distribution_error(
                noise="nlos", reason="it affects several components of one source together"
            )
        if family is not make_normal or not bool((scale == 1.0).all()):
            raise make_no_distribution_error(
                noise="nlos", reason="the errors without bias are not nominal"
            )
        probability = self.probability * torch.tensor(affected).to(scale)
        return ErrorDistribution(
            normal_plus_exponential(probability, self.mean_delay_sd), shift, scale
        )


def _affected(channels: MeasurementChannels) -> list[bool]:
    """Select ranges, without ranges positions, without both all components."""
    for kind in ("range", "position"):
        if kind in channels.kind:
            return [kind == k for k in channels.kind]
    return [True] * len(channels.kind)
