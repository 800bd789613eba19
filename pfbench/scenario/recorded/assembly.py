"""Assembly of episodes from resampled logs: measurements with added errors, starts, IMU inputs."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, MeasurementChannels, Record, fix_channels
from pfbench.model.strapdown.total import FIX_CHANNELS, StrapdownTotal
from pfbench.model.strapdown.tuning import StrapdownTuning
from pfbench.nav.preintegration import PreintegratedImu, preintegrate
from pfbench.noise.base import NoiseRegime, check_unit_process
from pfbench.scenario.base import check_duration
from pfbench.scenario.recorded.log_tables import Array
from pfbench.scenario.recorded.time_grid import ResampledLog


@dataclass(frozen=True)
class FixReceiver:
    """Conversion of recorded fixes to measurements.

    Attributes:
        fix_interval_s: Time between used fixes, s. A record with fewer fixes uses all of them.
        position_sd: Standard deviations of added position errors, East, North, Up, m, [3]. With
            zeros a noise regime can only remove fixes.
        velocity_sd: Standard deviations of added velocity errors, m/s, [3]. None if velocity is not
            measured.

    Raises:
        ValueError: If the interval is not positive, or the standard deviations are not three
            numbers of at least 0.
    """

    fix_interval_s: float = 1.0
    position_sd: Sequence[float] = (1.5, 1.5, 3.0)
    velocity_sd: Sequence[float] | None = None

    def __post_init__(self) -> None:
        check_duration("scenario.receiver.fix_interval_s", self.fix_interval_s)
        for name, sd in (("position_sd", self.position_sd), ("velocity_sd", self.velocity_sd)):
            if sd is not None and (len(sd) != 3 or min(sd) < 0.0):
                raise ValueError(
                    f"scenario.receiver.{name} must be 3 numbers of at least 0, got {list(sd)}. "
                    "Set East, North and Up, with 0 for no added errors."
                )

    @property
    def channel_names(self) -> tuple[str, ...]:
        """Names of the measured components, [3] or [6]."""
        return FIX_CHANNELS[: len(self.sd)]

    @property
    def channels(self) -> MeasurementChannels:
        """Channels of position, and of velocity if measured, from one source."""
        return fix_channels(self.sd)

    @property
    def sd(self) -> Tensor:
        """Standard deviations of the added errors, m and m/s, [3 or 6]."""
        return torch.tensor([*self.position_sd, *(self.velocity_sd or ())], dtype=torch.float64)


def encode_names(names: Sequence[str]) -> Tensor:
    """Encode names, such as G12, as character codes padded with spaces, [S, longest]."""
    longest = max(map(len, names), default=0)
    return torch.tensor(
        [[ord(letter) for letter in name.ljust(longest)] for name in names], dtype=torch.float64
    )


def assemble(
    legs: Sequence[ResampledLog],
    time: Array,
    log_index: Tensor,
    tuning: StrapdownTuning,
    receiver: FixReceiver,
    noise: NoiseRegime,
    draws: PhiloxStream,
) -> Episode:
    """Build the episode of runs over resampled logs.

    Args:
        legs: Resampled logs.
        time: Times of the steps of the longest log, s, [T].
        log_index: Index of each run's log, [R].
        tuning: Parameters that the filter assumes, for the initial errors.
        receiver: Standard deviations of added errors.
        noise: Noise regime.
        draws: Random stream of the runs.

    Returns:
        Episode with R runs.
    """
    t, longest = torch.from_numpy(time), max(legs, key=lambda leg: len(leg.time))
    fix_mask = torch.from_numpy(longest.fix_steps)
    truth = _pad([leg.truth for leg in legs], np.nan)[log_index]
    sd = receiver.sd
    y = _pad([leg.fixes for leg in legs], np.nan)[log_index][..., : len(sd)]
    # errors are drawn per fix, so that they do not depend on the filter step
    check_unit_process(noise, t)
    y[:, fix_mask] += noise.draw_errors(draws.at_step(0), receiver.channels, t[fix_mask])
    record = Record(
        y, _preintegrate_logs(legs, log_index, tuning), _draw_start(legs, log_index, tuning, draws)
    )
    groups = {"attitude": truth[..., :4], "velocity": truth[..., 4:7], "position": truth[..., 7:]}
    notes = tuple(dict.fromkeys(note for leg in legs for note in leg.notes))
    first = legs[int(log_index[0])] if len(log_index) else longest
    datasheet = {
        name: _pad([values, np.empty((len(t), 3))], np.nan)[0]
        for name, values in first.sensed().items()
    }
    return Episode(record, t, groups, truth[..., 7:], notes, datasheet)


def _draw_start(
    legs: Sequence[ResampledLog], log_index: Tensor, tuning: StrapdownTuning, draws: PhiloxStream
) -> Tensor:
    """Draw starts [R, 16], about which the true state has the assumed distribution."""
    recorded = torch.from_numpy(np.stack([leg.start for leg in legs]))[log_index]
    nominal = torch.cat([recorded, tuning.bias.expand(len(log_index), -1)], -1)
    error = (
        tuning.initial_sd * draws.at_step(0).normal("world.start", 1, len(tuning.initial_sd))[:, 0]
    )
    return StrapdownTotal(tuning).chart.add(nominal, -error)


def _preintegrate_logs(
    legs: Sequence[ResampledLog], log_index: Tensor, tuning: StrapdownTuning
) -> PreintegratedImu:
    """Preintegrate the IMU samples of each run's log."""
    force, rate, spans = (
        _pad(samples, 0.0)
        for samples in zip(*((leg.force, leg.rate, leg.spans) for leg in legs), strict=True)
    )
    bias = tuning.bias.expand(*spans.shape[:2], 6)
    gravity = torch.tensor([leg.gravity for leg in legs], dtype=torch.float64)[:, None].expand(
        spans.shape[:2]
    )
    u = (*preintegrate(force, rate, spans, bias), bias, gravity, spans.sum(-1))
    if len(legs) == 1:
        return PreintegratedImu(*u)  # leading axis 1: shared by all runs
    return PreintegratedImu(*(leaf[log_index] for leaf in u))


def _pad(values: Sequence[Array], fill: float) -> Tensor:
    """Stack K arrays, with each axis padded to the longest, [K, ...]."""
    out = np.full((len(values), *np.max([a.shape for a in values], axis=0)), fill)
    for row, a in zip(out, values, strict=True):
        row[tuple(slice(n) for n in a.shape)] = a
    return torch.from_numpy(out)
