"""Noise regime of missing measurements.

A regime that changes the errors of another regime has it as `base_regime`. For example, an outage of
a receiver with heavy tails is MeasurementOutage(windows, base_regime=StudentTNoise(4)).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels
from pfbench.noise.base import LayeredRegime, NoiseRegime
from pfbench.noise.distributions import ErrorDistribution
from pfbench.noise.time_windows import Windows, check_windows, window_index
from pfbench.noise.white import NominalNoise


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
        if self.visible_sources < 0:
            raise ValueError(
                f"noise.visible_sources must be 0 or more, got {self.visible_sources}. "
                "Give the number of visible sources."
            )

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        sources: Sequence[int] = sorted(set(channels.source))
        if self.visible_sources >= len(sources):
            raise ValueError(
                f"noise.visible_sources must be less than the {len(sources)} sources of the scenario, "
                f"got {self.visible_sources}. Otherwise no source is missing."
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
