"""Noise regimes that change with time: surges, bias steps and outages, and the windows in which they act."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_range, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels
from pfbench.noise.base import ErrorDistribution, LayeredRegime, NoiseRegime, NominalNoise

Windows = Sequence[Sequence[float | None]]
"""Pairs (from, to) in s, from inclusive, to exclusive, in order. None is the end of the record."""


def check_windows(windows: Windows, span: float | None) -> None:
    """Check windows and their reference duration."""
    last = -math.inf
    for window in windows:
        start, stop = window_edges(window)
        require(
            start < stop,
            "noise.windows_s",
            "be windows [from, to] in seconds with from < to",
            list(window),
            "Exchange or change its times.",
        )
        require(
            not start < last,
            "noise.windows_s",
            "be in order without overlap",
            f"{list(window)}, which starts before the previous window ends",
            "Sort or join the windows.",
        )
        last = stop
    require_range(
        "noise.reference_duration_s",
        span,
        "null or (0, inf) Give the duration in seconds for which the windows are written, or null.",
    )


def window_index(windows: Windows, time: Tensor, span: float | None = None) -> Tensor:
    """Find the window of each time: int64 [T], -1 outside all windows.

    Returns index of the window, [T]. Shapes: time [T].
    """
    end = float(time[-1])
    stretch = end / span if span else 1.0
    index = torch.full_like(time, -1, dtype=torch.int64)
    for k, window in enumerate(windows):
        start, stop = window_edges(window)
        require(
            not start * stretch > end,
            "noise.windows_s",
            f"begin before the end of the record at {end:g} s",
            list(window),
            "Give an earlier window, or stretch the windows by noise.reference_duration_s, the duration for which they are written.",
        )
        index = torch.where((time >= start * stretch) & (time < stop * stretch), k, index)
    return index


def window_edges(window: Sequence[float | None]) -> tuple[float, float]:
    """Return start and end of a window, NaN if it is not a valid pair."""
    if len(window) != 2 or window[0] is None:
        return math.nan, math.nan
    return window[0], math.inf if window[1] is None else window[1]


@dataclass(frozen=True)
class VarianceSurge(NoiseRegime):
    """Variances of measurement and process noise multiplied in time windows.

    Errors outside the windows are identical to errors without a surge. Errors inside are scaled by
    the square root of the factor. Process noise is the noise of simulated sensors (see
    `NoiseRegime.process_factors`), or the driving noise of a simulated model.

    Attributes:
        windows_s: Pairs of seconds (from, to), from inclusive, to exclusive, in order. None as `to`
            is the end of the record.
        measurement_variance_factors: Factor on R in each window.
        process_variance_factors: Factor on Q in each window.
        reference_duration_s: Duration for which the windows are written, to stretch them to the
            record, s. None uses them unchanged.
        base_regime: Errors that are scaled.

    Raises:
        ValueError: If a window is invalid, the numbers of factors and windows differ, or a factor
            is not positive.
    """

    windows_s: Windows
    measurement_variance_factors: Sequence[float]
    process_variance_factors: Sequence[float]
    reference_duration_s: float | None = None
    base_regime: NoiseRegime = field(default_factory=NominalNoise)

    def __post_init__(self) -> None:
        check_windows(self.windows_s, self.reference_duration_s)
        for key, factors in (
            ("measurement_variance_factors", self.measurement_variance_factors),
            ("process_variance_factors", self.process_variance_factors),
        ):
            valid = all(0.0 < f < float("inf") for f in factors)
            require(
                len(factors) == len(self.windows_s) and valid,
                f"noise.{key}",
                f"be {len(self.windows_s)} positive factors on the variance",
                list(factors),
                "Give one per window.",
            )

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        return self._factors_at(self.measurement_variance_factors, time).sqrt()[
            :, None
        ] * self.base_regime.draw_errors(draws, channels, time)

    @override
    def process_factors(self, time: Tensor) -> Tensor:
        return self._factors_at(
            self.process_variance_factors, time
        ) * self.base_regime.process_factors(time)

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        family, shift, scale = self.base_regime.error_distribution(channels, time)
        root = self._factors_at(self.measurement_variance_factors, time).sqrt()[:, None]
        return ErrorDistribution(family, root * shift, root * scale)

    def _factors_at(self, factors: Sequence[float], time: Tensor) -> Tensor:
        """Return the factor at each time, [T]."""
        return time.new_tensor([*factors, 1.0])[
            window_index(self.windows_s, time, self.reference_duration_s)
        ]  # index -1 (outside) selects 1


@dataclass(frozen=True)
class BiasStep(LayeredRegime):
    """A constant bias of one or all components from some time on.

    Attributes:
        bias_sd: Bias in nominal standard deviations of each component, with sign.
        onset_s: Start time, s.
        component: Index of the measurement component, from 0. None means all components.
        reference_duration_s: Duration for which `onset_s` is written, to stretch it to the record,
            s. None uses it unchanged.
        base_regime: Errors to which the bias is added.

    Raises:
        ValueError: If the component does not exist, or the time is after the end of the record.
    """

    bias_sd: float = 5.0
    onset_s: float = 700.0
    component: int | None = None
    reference_duration_s: float | None = None
    base_regime: NoiseRegime = field(default_factory=NominalNoise)

    def __post_init__(self) -> None:
        check_windows(((self.onset_s, None),), self.reference_duration_s)

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        return (
            self.base_regime.draw_errors(draws, channels, time)
            + self._bias(channels, time) * channels.sd
        )

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        family, shift, scale = self.base_regime.error_distribution(channels, time)
        return ErrorDistribution(family, shift + self._bias(channels, time), scale)

    def _bias(self, channels: MeasurementChannels, time: Tensor) -> Tensor:
        """Return the bias in nominal standard deviations, [T, Dy]."""
        n = len(channels.sd)
        if self.component is not None and not 0 <= self.component < n:
            raise ValueError(
                f"noise.component must be between 0 and {n - 1}, got {self.component}. "
                f"The scenario measures {n} components."
            )
        biased = torch.tensor([self.component in (None, i) for i in range(n)])
        started = window_index(((self.onset_s, None),), time, self.reference_duration_s) == 0
        return torch.where(started[:, None] & biased, self.bias_sd, 0.0).to(time)


# --------------------------------------------------------------------------------------------------
# Noise regime of missing measurements.
#
# A regime that changes the errors of another regime has it as `base_regime`. For example, an outage of
# a receiver with heavy tails is MeasurementOutage(windows, base_regime=StudentTNoise(4)).


@dataclass(frozen=True)
class MeasurementOutage(LayeredRegime):
    """Missing measurements of all or most sources in some time windows.

    Attributes:
        windows_s: Pairs of seconds (from, to), from inclusive, to exclusive, in order.
        visible_sources: Number of visible sources. The sources with the lowest numbers stay
            visible, the same in all runs, so episodes stay paired. [ours]
        reference_duration_s: Duration for which the windows are written, to stretch them to the
            record, s. None uses them unchanged.
        base_regime: Errors of the visible measurements.

    Raises:
        ValueError: If a window is invalid or begins after the end of the record, or
            `visible_sources` is not below the number of sources.
    """

    windows_s: Windows = ((100.0, 130.0),)
    visible_sources: int = 0
    reference_duration_s: float | None = None
    base_regime: NoiseRegime = field(default_factory=NominalNoise)

    def __post_init__(self) -> None:
        check_windows(self.windows_s, self.reference_duration_s)
        require_ranges("noise", self, visible_sources="[0, inf]")

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        sources: Sequence[int] = sorted(set(channels.source))
        require(
            not self.visible_sources >= len(sources),
            "noise.visible_sources",
            f"be less than the {len(sources)} sources of the scenario",
            self.visible_sources,
            "Otherwise no source is missing.",
        )
        affected = torch.tensor(
            [source in sources[self.visible_sources :] for source in channels.source]
        )
        missing = (window_index(self.windows_s, time, self.reference_duration_s) >= 0)[
            :, None
        ] & affected
        return torch.where(missing, torch.nan, self.base_regime.draw_errors(draws, channels, time))

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        # NaN in the record shows the outage, so only visible components need a distribution
        return self.base_regime.error_distribution(channels, time)


@dataclass(frozen=True)
class RandomOutage(LayeredRegime):
    """Outages at random times: all measurements are missing, in each run at times of its own.

    One record then gives many runs. Outages of a run may overlap. [ours]

    Attributes:
        duration_s: Length of an outage, s.
        count: Number of outages of a run.
        base_regime: Errors of the other measurements.

    Raises:
        ValueError: If the length is not positive, or the number is 0. On drawing, if the record is not longer than all outages.
    """

    duration_s: float = 30.0
    count: int = 1
    base_regime: NoiseRegime = field(default_factory=NominalNoise)

    def __post_init__(self) -> None:
        require_ranges("noise", self, duration_s="(0, inf]", count="[1, inf]")

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        length = float(time[-1] - time[0])
        if not self.count * self.duration_s < length:
            raise ValueError(
                f"noise.count={self.count} outages must be shorter than the record of {length:g} s together, got "
                f"noise.duration_s={self.duration_s:g}. Give less than {length / self.count:g} s."
            )
        room = length - self.duration_s
        start = time[0] + room * draws.uniform("world.outage", 1, self.count).to(
            time
        )  # [R, 1, count]
        since = time[:, None] - start
        is_missing = ((since >= 0.0) & (since < self.duration_s)).any(-1, keepdim=True)
        return torch.where(
            is_missing, torch.nan, self.base_regime.draw_errors(draws, channels, time)
        )

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        return self.base_regime.error_distribution(channels, time)
