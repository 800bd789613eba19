"""Noise regimes without memory: nominal, heavy-tailed, impulsive errors, outages.

A regime that changes the errors of another regime has it as `of`. For example, an outage of a
receiver with heavy tails is Outage(windows, of=StudentT(4)). The nominal part of each regime uses
the random numbers of the nominal regime, so filters are compared across regimes on common random
numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels
from pfbench.noise import distributions
from pfbench.noise.base import NoiseRegime
from pfbench.noise.distributions import ErrorDistribution
from pfbench.noise.time_windows import Windows, check_windows, window_index


class _UnitProcess(NoiseRegime):
    """A regime with nominal process noise."""

    @override
    def process_factors(self, time: Tensor) -> Tensor:
        return torch.ones_like(time)


def _same_at_all_steps(
    family: distributions.Family, channels: MeasurementChannels, time: Tensor
) -> ErrorDistribution:
    """Return the same distribution at all steps."""
    shape = len(time), len(channels.sd)
    return ErrorDistribution(family, time.new_zeros(shape), time.new_ones(shape))


@dataclass(frozen=True)
class NominalNoise(_UnitProcess):
    """White normal errors of nominal size."""

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        return channels.sd * draws.normal("world.receiver", len(time), len(channels.sd))

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        return _same_at_all_steps(distributions.make_normal, channels, time)


@dataclass(frozen=True)
class StudentTNoise(_UnitProcess):
    """Student's t errors with `dof` degrees of freedom and nominal scale.

    The scale, and not the variance, is nominal. Nominal variance would make most errors smaller
    than the filter assumes. [ours]

    Attributes:
        dof: Degrees of freedom.

    Raises:
        ValueError: If `dof` is below 3, where the variance is infinite.
    """

    dof: int = 4

    def __post_init__(self) -> None:
        if self.dof < 3:
            raise ValueError(
                f"noise.dof must be at least 3, got {self.dof}. Below 3 the variance is infinite."
            )

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        t, k = len(time), len(channels.sd)
        z = draws.normal("world.receiver", t, k)
        chi2 = (
            draws.normal("world.tails", t, k * self.dof)
            .square()
            .reshape(-1, t, k, self.dof)
            .sum(-1)
        )
        return channels.sd * z / torch.sqrt(chi2 / self.dof)

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        return _same_at_all_steps(distributions.make_student_t(self.dof), channels, time)


@dataclass(frozen=True)
class LaplaceNoise(_UnitProcess):
    """Laplace errors of nominal variance.

    Only the shape differs from the assumption of a Kalman filter. Larger nominal errors become
    larger errors (monotone transformation). [ours]
    """

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        return channels.sd * distributions.normal_to_laplace(
            draws.normal("world.receiver", len(time), len(channels.sd))
        )

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        return _same_at_all_steps(distributions.make_laplace, channels, time)


@dataclass(frozen=True)
class OutlierNoise(_UnitProcess):
    """Impulsive errors, a contaminated normal [Tukey 1960; Huber 1964].

    Attributes:
        probability: Probability of an outlier per epoch, or per component.
        size: Factor of an outlier on the nominal error.
        together: Whether all components of an epoch are outliers together, or each independently.

    Raises:
        ValueError: If `probability` is outside [0, 1], or `size` is below 1.
    """

    probability: float = 0.05
    sd_factor: float = 10.0
    joint: bool = True

    def __post_init__(self) -> None:
        _check_contamination(self.probability, self.sd_factor)

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        outlier = (
            draws.uniform("world.outliers", len(time), 1 if self.joint else len(channels.sd))
            < self.probability
        )
        return torch.where(outlier, self.sd_factor, 1.0).to(
            channels.sd
        ) * NominalNoise().draw_errors(draws, channels, time)

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        return _same_at_all_steps(
            distributions.contaminated_normal(
                self.probability, self.sd_factor, self.joint, distributions.make_normal
            ),
            channels,
            time,
        )


@dataclass(frozen=True)
class GlintNoise(_UnitProcess):
    """Radar glint: normal errors, with some probability Laplace errors.

    [Wu 1993, "Target tracking with glint noise"]. For glint with a wide normal use `OutlierNoise` with
    together=false.

    Attributes:
        probability: Probability of a glint per epoch, or per component.
        size: Standard deviation of a glint in nominal standard deviations.
        together: Whether all components of an epoch have glint together, or each independently.

    Raises:
        ValueError: If `probability` is outside [0, 1], or `size` is below 1.
    """

    probability: float = 0.1
    sd_factor: float = 10.0
    joint: bool = False

    def __post_init__(self) -> None:
        _check_contamination(self.probability, self.sd_factor)

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        outlier = (
            draws.uniform("world.outliers", len(time), 1 if self.joint else len(channels.sd))
            < self.probability
        )
        spike = self.sd_factor * LaplaceNoise().draw_errors(draws, channels, time)
        return torch.where(outlier, spike, NominalNoise().draw_errors(draws, channels, time))

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        return _same_at_all_steps(
            distributions.contaminated_normal(
                self.probability, self.sd_factor, self.joint, distributions.make_laplace
            ),
            channels,
            time,
        )


def _check_contamination(probability: float, size: float) -> None:
    if not 0.0 <= probability <= 1.0:
        raise ValueError(f"noise.probability must be between 0 and 1, got {probability}.")
    if not size >= 1.0:
        raise ValueError(
            f"noise.sd_factor must be at least 1, got {size}. "
            "Give a factor on the nominal standard deviation."
        )


@dataclass(frozen=True)
class MeasurementOutage(NoiseRegime):
    """Missing measurements of all or most sources in some time windows.

    Attributes:
        windows: Pairs of seconds (from, to), from inclusive, to exclusive, in order.
        keep: Number of visible sources. The sources with the lowest numbers stay visible, the same
            in all runs, so episodes stay paired. [ours]
        span: Duration in seconds for which the windows are written, to stretch them to the record.
            None uses them unchanged.
        of: Errors of the visible measurements.

    Raises:
        ValueError: If a window is invalid or begins after the end of the record, or `keep` is not
            below the number of sources.
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
    def process_factors(self, time: Tensor) -> Tensor:
        return self.base_regime.process_factors(time)

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        # NaN in the record shows the outage, so only visible components need a distribution
        return self.base_regime.error_distribution(channels, time)
