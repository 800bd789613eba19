"""Errors of a real receiver, block by block."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.noise.laws import Law
from pfbench.noise.regimes import Nominal, untold
from pfbench.record import Channels

_TRUTH = ["pn", "pe", "pd"]
_RECEIVER = ["rx_pn", "rx_pe", "rx_pd"]


@dataclass(frozen=True)
class Replay:
    """Position errors of a real receiver, block by block: the moving block bootstrap [Kunsch 1989].

    Each source strings together blocks of the record that start anywhere and hold no gap; the record's mean is taken off, since
    part of it may be a lever arm [ours]. Between two epochs of the record its errors are interpolated. The first, second and
    third position of a source replay North, East and down; other components are nominal. In a scenario without positions all
    components are replayed in this way. [ours]

    Args:
        root: the folder of all data sets (configuration key data.root).
        folder, file: of the record: `utc_s`, truth `pn`, `pe`, `pd` and receiver `rx_pn`, `rx_pe`, `rx_pd`, at 1 Hz.
        block: seconds of each block.
        metres: the record's own errors in metres; else each axis is scaled to the nominal standard deviation of its component.

    Raises:
        ValueError: a block that is not positive; on drawing, no root, no such file, no stretch as long as a block, metres in a
            scenario without positions; a filter that is to be told.
    """

    root: str | None
    folder: str = "rx_error_record"
    file: str = "f9k_vs_span.parquet"
    block: float = 120.0
    metres: bool = False

    def __post_init__(self) -> None:
        if not self.block >= 1.0:
            raise ValueError(f"noise.block={self.block}: give at least 1 second, the record's own interval")

    def errors(self, draws: Draws, channels: Channels, time: Tensor) -> Tensor:
        replayed, scale = self._replayed(channels), channels.sd
        error = torch.from_numpy(self.record())
        starts = torch.from_numpy(self._starts(error.numpy()))
        error = error - error.nanmean(0)
        if self.metres:
            scale = torch.ones_like(scale)
        else:
            error = error / error.square().nanmean(0).sqrt()
        sources, of_source = torch.unique(torch.tensor(channels.source), return_inverse=True)
        since = time - time[0]
        number = torch.floor(since / self.block).long()
        u = draws.uniform("world.replay", int(number[-1]) + 1, len(sources))
        first = starts[(u * len(starts)).long()][:, number][..., of_source]  # [R, T, Dy]
        within = (since - number * self.block).clamp(min=0.0)
        whole = torch.floor(within)
        at, part = first + whole.long()[:, None], (within - whole)[:, None]
        axis = torch.tensor([-1 if k is None else k for k in replayed])
        value = (1.0 - part) * error[at, axis] + part * error[at + 1, axis]
        return torch.where(axis >= 0, scale * value, Nominal().errors(draws, channels, time))

    def process(self, time: Tensor) -> Tensor:
        return torch.ones_like(time)

    def law(self, channels: Channels, time: Tensor) -> Law:
        raise untold("replay", "its errors remember those before")

    def record(self) -> np.ndarray:
        """Receiver minus truth at each second, North, East, down [n, 3] m; NaN where the record has a gap.

        Raises:
            ValueError: no root, no such file, or columns that are missing.
        """
        if self.root is None:
            raise ValueError(
                "data.root is not set, and recorded data are not part of the package: set the environment variable "
                f"PFBENCH_DATA, or data.root=..., to the folder that holds {self.folder}/"
            )
        path = Path(self.root) / self.folder / self.file
        if not path.is_file():
            raise ValueError(f"data.root={self.root}: no file {path}; set data.root to the folder that holds {self.folder}/")
        table = pd.read_parquet(path)
        wanted = ["utc_s", *_TRUTH, *_RECEIVER]
        missing = sorted(set(wanted) - set(table.columns))
        if missing:
            raise ValueError(f"{path}: no column {', '.join(missing)}; a record of errors has {', '.join(wanted)}")
        second = np.rint(table["utc_s"].to_numpy() - table["utc_s"].iloc[0]).astype(int)
        out = np.full((second[-1] + 1, 3), np.nan)
        out[second] = table[_RECEIVER].to_numpy() - table[_TRUTH].to_numpy()
        return out

    def _starts(self, error: np.ndarray) -> np.ndarray:
        """Seconds at which a whole block begins: it and the second after it have no gap."""
        need = math.ceil(self.block) + 1
        gaps = np.concatenate([[0], np.cumsum(np.isnan(error).any(1))])
        starts = np.flatnonzero(gaps[need:] == gaps[: len(gaps) - need]) if len(error) >= need else np.array([], int)
        if len(starts) == 0:
            raise ValueError(f"noise.block={self.block}: no {need} s of the record are without a gap; give shorter blocks")
        return starts

    def _replayed(self, channels: Channels) -> Sequence[int | None]:
        """Which axis of the record each component replays, None for none."""
        positions = "position" in channels.kind
        if self.metres and not positions:
            raise ValueError("noise.metres=true: the scenario measures no positions; give metres=false to scale the errors")
        place: dict[int, int] = {}
        axes: list[int | None] = []
        for kind, source in zip(channels.kind, channels.source, strict=True):
            wanted = kind == "position" or not positions
            axes.append(place.get(source, 0) % 3 if wanted else None)
            place[source] = place.get(source, 0) + wanted
        return axes
