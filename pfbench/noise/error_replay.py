"""Noise regime that replays the errors of a real receiver in blocks."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import MeasurementChannels
from pfbench.files.limits import find_input
from pfbench.files.table_file import check_parquet
from pfbench.noise.base import (
    ErrorDistribution,
    NoiseRegime,
    NominalNoise,
    make_no_distribution_error,
)

_TRUTH = ["pn", "pe", "pd"]
_RECEIVER = ["rx_pn", "rx_pe", "rx_pd"]


@dataclass(frozen=True)
class ErrorReplay(NoiseRegime):
    """Position errors of a real receiver by the moving block bootstrap [Kunsch 1989].

    Each source concatenates blocks of the record that start anywhere and contain no gap. The mean
    of the record is removed, since part of it may be a lever arm [ours]. Errors are interpolated
    between two epochs of the record. The first, second and third position of a source replay North,
    East and down. Other components are nominal. In a scenario without positions all components are
    replayed in this way. [ours]

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        folder: Folder of the record in `root`.
        file: File at 1 Hz with `utc_s`, truth `pn`, `pe`, `pd`, receiver `rx_pn`, `rx_pe`, `rx_pd`.
        block_length_s: Length of each block, s.
        absolute_metres: Whether errors are in metres as recorded. Otherwise each axis is scaled to
            the nominal standard deviation of its component.

    Raises:
        ValueError: If `block_length_s` is below 1 s. On drawing, if `root` or the file is missing,
            no section without a gap is as long as a block, or `absolute_metres` is set in a
            scenario without positions.
    """

    root: str | None
    folder: str = "rx_error_record"
    file: str = "f9k_vs_span.parquet"
    block_length_s: float = 120.0
    absolute_metres: bool = False

    def __post_init__(self) -> None:
        require_ranges("noise", self, block_length_s="[1, inf] 1 s is the interval of the record.")

    def input_files(self) -> list[Path]:
        """List the file of the record."""
        return (
            []
            if self.root is None
            else [find_input(self.root, f"{self.folder}/{self.file}", is_data_set=True)]
        )

    @override
    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        axes, scale = self._replayed_axes(channels), channels.sd
        error = torch.from_numpy(self.read_record())
        starts = torch.from_numpy(self._starts(error.numpy()))
        error = error - error.nanmean(0)
        if self.absolute_metres:
            scale = torch.ones_like(scale)
        else:
            error = error / error.square().nanmean(0).sqrt()
        sources, of_source = torch.unique(torch.tensor(channels.source), return_inverse=True)
        since = time - time[0]
        number = torch.floor(since / self.block_length_s).long()
        u = draws.uniform("world.replay", int(number[-1]) + 1, len(sources))
        first = starts[(u * len(starts)).long()][:, number][..., of_source]  # [R, T, Dy]
        elapsed = (since - number * self.block_length_s).clamp(min=0.0)
        second = torch.floor(elapsed)
        row, fraction = first + second.long()[:, None], (elapsed - second)[:, None]
        axis = torch.tensor([-1 if k is None else k for k in axes])
        value = (1.0 - fraction) * error[row, axis] + fraction * error[row + 1, axis]
        return torch.where(
            axis >= 0, scale * value, NominalNoise().draw_errors(draws, channels, time)
        )

    @override
    def error_distribution(self, channels: MeasurementChannels, time: Tensor) -> ErrorDistribution:
        raise make_no_distribution_error(noise="replay", reason="its errors are correlated in time")

    def read_record(self) -> np.ndarray:
        """Read receiver minus truth at each second, North, East, down [n, 3] m.

        NaN marks a gap of the record.

        Raises:
            ValueError: If `root`, the file or a column is missing.
        """
        if self.root is None:
            raise ValueError(
                "data.root is not set. Recorded data are not part of the package. Set the "
                f"environment variable PFBENCH_DATA, or data.root=..., "
                f"to the folder that contains {self.folder}/."
            )
        path = self.input_files()[0]
        require(
            path.is_file(),
            "data.root",
            f"be the folder that contains {self.folder}/",
            self.root,
            f"The file {path} does not exist.",
        )
        check_parquet(path)
        table = pd.read_parquet(path)
        columns = ["utc_s", *_TRUTH, *_RECEIVER]
        missing = sorted(set(columns) - set(table.columns))
        if missing:
            raise ValueError(
                f"{path} must have the columns {', '.join(columns)}, got none named "
                f"{', '.join(missing)}. Add or rename columns."
            )
        second = np.rint(table["utc_s"].to_numpy() - table["utc_s"].iloc[0]).astype(int)
        out = np.full((second[-1] + 1, 3), np.nan)
        out[second] = table[_RECEIVER].to_numpy() - table[_TRUTH].to_numpy()
        return out

    def _starts(self, error: np.ndarray) -> np.ndarray:
        """Return the seconds at which a block without a gap can begin."""
        need = math.ceil(self.block_length_s) + 1
        gaps = np.concatenate([[0], np.cumsum(np.isnan(error).any(1))])
        starts = (
            np.flatnonzero(gaps[need:] == gaps[: len(gaps) - need])
            if len(error) >= need
            else np.array([], int)
        )
        require(
            len(starts) != 0,
            "noise.block_length_s",
            "be shorter than the longest section without a gap",
            f"{self.block_length_s}, which needs {need} s",
            "Give shorter blocks.",
        )
        return starts

    def _replayed_axes(self, channels: MeasurementChannels) -> Sequence[int | None]:
        """Return the axis of the record that each component replays, or None."""
        positions = "position" in channels.kind
        require(
            not self.absolute_metres or positions,
            "noise.absolute_metres",
            "be false in a scenario without positions",
            "true",
            "Then the errors are scaled.",
        )
        counts: dict[int, int] = {}
        axes: list[int | None] = []
        for kind, source in zip(channels.kind, channels.source, strict=True):
            is_replayed = kind == "position" or not positions
            axes.append(counts.get(source, 0) % 3 if is_replayed else None)
            counts[source] = counts.get(source, 0) + is_replayed
        return axes
