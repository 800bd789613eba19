"""GPS and Galileo satellites from their broadcast ephemerides."""

from __future__ import annotations

import contextlib
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.files.limits import find_input
from pfbench.files.reader_notes import announce_notes
from pfbench.logs.sky.ephemeris import (
    CLOCK,
    EPOCH,
    ORBIT,
    RinexFile,
    broadcast_elements,
    describe_unhealthy,
    mean_motion,
    parse_epochs,
    read_ephemeris,
)
from pfbench.logs.sky.ephemeris_checks import check_ephemerides
from pfbench.nav.orbits import LIGHT, TYPICAL_FLIGHT, Constellation, eccentric_anomaly, free_fall


class Transmission(NamedTuple):
    """Satellites when they sent what a receiver measures, in Earth-fixed axes of that time.

    Attributes:
        position: [T, S, 3], m.
        velocity: [T, S, 3], m/s.
        clock: Offset of the satellite's clock for a signal on 1575.42 MHz, with relativity and group delay, [T, S], m.
        clock_drift: [T, S], m/s.
    """

    position: Tensor
    velocity: Tensor
    clock: Tensor
    clock_drift: Tensor


def parse_gps_time(key: str, value: str | float) -> float:
    """Return a GPS time, in seconds since 1980-01-06, that is given as seconds or as an ISO date."""
    with contextlib.suppress(TypeError, ValueError):
        return float(value)
    try:
        return (datetime.fromisoformat(str(value)) - EPOCH).total_seconds()
    except (TypeError, ValueError):
        remedy = "Give a date and GPS time without a zone, like 2016-06-06T12:00:00."
        raise ValueError(
            f"{key} must be seconds of GPS time or an ISO date, got {value}. {remedy}"
        ) from None


@dataclass(frozen=True)
class BroadcastConstellation(Constellation):
    """GPS and Galileo satellites, each by the ephemeris nearest in time of ephemeris.

    Attributes:
        root: Folder of all data sets (configuration key data.root).
        path: RINEX 2, 3 or 4 navigation file in `root`, or a Parquet file with the RINEX names of the
            parameters as columns, `prn` and optionally `sys` (G or E). Satellites that are marked
            unhealthy are ignored, and ephemerides that are implausible or contradict their
            neighbours; `notes` names them.
        start_s: GPS time of t = 0, in seconds since 1980-01-06 or as an ISO date such as
            2016-06-06T12:00:00.
        validity: Seconds before and after its time of ephemeris for which an ephemeris is used.

    Raises:
        ValueError: If `validity` is not positive or `start_s` is not a date. On use, if the file is
            missing or faulty, or contains no ephemeris for t = 0.
    """

    root: str | None
    path: str
    start_s: str | float
    validity: float = 7200.0

    def __post_init__(self) -> None:
        _ = self.epoch
        require_ranges("", self, validity="(0, inf]")

    def input_files(self) -> list[Path]:
        """List the file of the ephemerides."""
        return [] if self.root is None else [find_input(self.root, self.path, is_data_set=True)]

    @cached_property
    def epoch(self) -> float:
        """GPS time of t = 0, seconds since 1980-01-06."""
        return parse_gps_time("start_s", self.start_s)

    @cached_property
    @override
    def names(self) -> tuple[str, ...]:
        return tuple(sorted(set(self._table["name"])))

    @override
    def at(self, time: Tensor) -> tuple[Tensor, Tensor]:
        return broadcast_elements(self._select(time)).earth_fixed()

    def clock(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Return clock offset s and drift [T, S] by the polynomial, without relativity."""
        eph = self._select(time)
        t = eph["tk"] + eph["toe"] - eph["toc"]
        return eph["af0"] + (eph["af1"] + eph["af2"] * t) * t, eph["af1"] + 2 * eph["af2"] * t

    def relativity(self, time: Tensor) -> Tensor:
        """Return the relativistic term of the clock offset [T, S] s, to add to `clock`.

        [IS-GPS-200, 20.3.3.3.3.1]
        """
        eph = self._select(time)
        anomaly, _ = eccentric_anomaly(eph["M0"] + mean_motion(eph) * eph["tk"], eph["e"])
        return -2 * torch.sqrt(eph["gm"]) / LIGHT**2 * eph["e"] * eph["sqrtA"] * torch.sin(anomaly)

    def group_delay(self, time: Tensor) -> Tensor:
        """Return the group delay [T, S] s to subtract from the clock offset (L1 users)."""
        return self._select(time)["tgd"]

    def transmit(self, time: Tensor, pseudorange: Tensor) -> Transmission:
        """Compute the satellites at the transmission of signals.

        The satellite's clock shows the time of reception minus pseudorange / c, both by the receiver's clock, whose
        offset cancels [IS-GPS-200, 20.3.3.3.3]. From a typical time the satellite falls freely, see `receive_signals`.

        Args:
            time: Times of reception by the receiver's clock, [T], s.
            pseudorange: [T, S], m.

        Returns:
            Satellites, NaN without an ephemeris or a pseudorange.
        """
        t = time - TYPICAL_FLIGHT
        position, velocity = self.at(t)
        offset, drift = self.clock(t)
        before, after = self.relativity(t - 0.5), self.relativity(t + 0.5)
        drift = drift + (after - before)
        offset = offset + 0.5 * (before + after) - self.group_delay(t)
        later = TYPICAL_FLIGHT - pseudorange / LIGHT - offset
        move, acceleration = later.unsqueeze(-1), free_fall(position, velocity)
        return Transmission(
            position + (velocity + 0.5 * acceleration * move) * move,
            velocity + acceleration * move,
            LIGHT * (offset + drift * later),
            LIGHT * drift,
        )

    def _select(self, time: Tensor) -> dict[str, Tensor]:
        """Return the current parameters [T, S], with `tk`; NaN where none is valid."""
        columns, names = self._ephemerides
        t = time.to(torch.float64)
        toe = columns[..., 0]
        middle = 0.5 * (toe[:, 1:] + toe[:, :-1])
        index = torch.searchsorted(middle, t.expand(len(toe), -1).contiguous())
        values = columns.gather(1, index[..., None].expand(-1, -1, columns.shape[-1])).transpose(
            0, 1
        )
        eph = dict(zip(names, values.unbind(-1), strict=True))
        since = t[:, None] - eph["toe"]
        valid = since.abs() <= self.validity
        return {name: torch.where(valid, v, torch.nan) for name, v in {**eph, "tk": since}.items()}

    @cached_property
    def _ephemerides(self) -> tuple[Tensor, tuple[str, ...]]:
        """All parameters [S, E, P], sorted by time and padded, and their names."""
        table = self._table
        columns = ["toe", *sorted({*CLOCK, *ORBIT} - {"toe"}), "tgd", "sow", "gm"]
        blocks = [
            torch.from_numpy(table.loc[table["name"] == name, columns].to_numpy(float, copy=True))
            for name in self.names
        ]
        longest = max(len(block) for block in blocks)
        padded = [torch.cat([b, b[-1:].expand(longest - len(b), -1)]) for b in blocks]
        return torch.stack(padded), tuple(columns)

    @property
    def ionosphere(self) -> tuple[float, ...]:
        """Coefficients of the broadcast ionosphere of GPS, [8]. Empty if the file has none."""
        return self._file.ionosphere

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """Messages about ignored, changed and unconfirmed ephemerides, for a report."""
        unhealthy = describe_unhealthy(self._file.rows, self.path)
        return (*self._file.notes, *self._selection[1], *unhealthy)

    @cached_property
    def _table(self) -> pd.DataFrame:
        """The ephemerides in use, one row each. Of each `toe` the last transmission is used."""
        table = self._selection[0]
        require(
            not table.empty,
            self.path,
            "contain ephemerides that agree",
            f"none of {len(self._file.rows)}: {next(iter(self.notes), 'no healthy satellite')}",
            "Choose another file of this day.",
        )
        first, last = (self.epoch + table["toe"].agg(["min", "max"])).tolist()
        require(
            (table["toe"].abs() <= self.validity).any(),
            "start_s",
            f"be within {self.validity:.0f} s of the ephemerides in {self.path} (GPS time {first:.0f} to {last:.0f} s)",
            f"{self.start_s} (GPS time {self.epoch:.0f} s)",
            "Give a time near them.",
        )
        announce_notes(self.path, self.notes)
        return table.drop_duplicates(["name", "toe"], keep="last").reset_index(drop=True)

    @cached_property
    def _selection(self) -> tuple[pd.DataFrame, tuple[str, ...]]:
        """Plausible ephemerides, and notes."""
        return check_ephemerides(self._healthy, self.path)

    @cached_property
    def _healthy(self) -> pd.DataFrame:
        """Ephemerides of healthy satellites, times from t = 0."""
        return parse_epochs(self._file.rows, self.epoch)

    @cached_property
    def _file(self) -> RinexFile:
        return read_ephemeris(self.root, self.path)
