"""Satellites of GPS and Galileo where their own broadcast ephemerides say they are."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from functools import cached_property

import pandas as pd
import torch
from torch import Tensor

from pfbench.nav.ephemeris import CLOCK, EPOCH, ORBIT, dated, plausible, read
from pfbench.nav.orbits import GPS_OMEGA, LIGHT, Elements, eccentric_anomaly


@dataclass(frozen=True)
class Broadcast:
    """Satellites of GPS and Galileo by their broadcast ephemerides, each by the one with the nearest time of ephemeris.

    Args:
        root: the folder of all data sets (configuration key data.root).
        path: in it, a RINEX 2 or 3 navigation file, or a Parquet file with RINEX's names of the parameters as columns, and
            `prn` and perhaps `sys` (G or E). Satellites that call themselves unhealthy are left out.
        begin: GPS time of t = 0, in seconds since 1980-01-06 or as an ISO date, 2016-06-06T12:00:00.
        validity: seconds before and after its time of ephemeris for which an ephemeris is used.

    Raises:
        ValueError: a validity that is not positive, or a date that is none; on use, no such file, a faulty file, or no
            ephemeris at t = 0.
    """

    root: str | None
    path: str
    begin: str | float
    validity: float = 7200.0

    def __post_init__(self) -> None:
        _ = self.epoch
        if not self.validity > 0.0:
            raise ValueError(f"validity={self.validity}: give a positive number of seconds")

    @cached_property
    def epoch(self) -> float:
        """GPS time of t = 0, seconds since 1980-01-06."""
        try:
            return float(self.begin)
        except ValueError:
            pass
        try:
            return (datetime.fromisoformat(str(self.begin)) - EPOCH).total_seconds()
        except (TypeError, ValueError):
            raise ValueError(
                f"begin={self.begin}: give seconds of GPS time, or a date and GPS time without a zone like 2016-06-06T12:00:00"
            ) from None

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(sorted(set(self._table["name"])))

    def at(self, time: Tensor) -> tuple[Tensor, Tensor]:
        eph, known = self._chosen(time)
        place, velocity = self._elements(eph).earth_fixed()
        return tuple(torch.where(known[..., None], a, torch.nan) for a in (place, velocity))  # type: ignore[return-value]

    def clock(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Offset [T, S] s and drift [T, S] of the satellites' clocks by their polynomials, the relativistic term left out."""
        eph, known = self._chosen(time)
        t = eph["tk"] + eph["toe"] - eph["toc"]
        offset = eph["af0"] + (eph["af1"] + eph["af2"] * t) * t
        return torch.where(known, offset, torch.nan), torch.where(known, eph["af1"] + 2 * eph["af2"] * t, torch.nan)

    def relativity(self, time: Tensor) -> Tensor:
        """The relativistic term of the clocks' offset [T, S] s, to be added to `clock` [IS-GPS-200, 20.3.3.3.3.1]."""
        eph, known = self._chosen(time)
        anomaly, _ = eccentric_anomaly(eph["M0"] + self._motion(eph) * eph["tk"], eph["e"])
        term = -2 * torch.sqrt(eph["gm"]) / LIGHT**2 * eph["e"] * eph["sqrtA"] * torch.sin(anomaly)
        return torch.where(known, term, torch.nan)

    def group_delay(self, time: Tensor) -> Tensor:
        """Group delay [T, S] s that a user of the first frequency alone takes off the clock's offset."""
        eph, known = self._chosen(time)
        return torch.where(known, eph["tgd"], torch.nan)

    @staticmethod
    def _motion(eph: dict[str, Tensor]) -> Tensor:
        """Corrected mean motion, rad/s."""
        return torch.sqrt(eph["gm"]) / eph["sqrtA"] ** 3 + eph["deltan"]

    def _elements(self, eph: dict[str, Tensor]) -> Elements:
        """The user algorithm [IS-GPS-200, table 20-IV], and its time derivatives."""
        e, tk, n = eph["e"], eph["tk"], self._motion(eph)
        anomaly, near = eccentric_anomaly(eph["M0"] + n * tk, e)
        anomaly1, root = n / near, torch.sqrt(1 - e * e)
        turn = torch.atan2(root * torch.sin(anomaly), torch.cos(anomaly) - e) + eph["omega"]
        turn1 = root * anomaly1 / near
        s2, c2 = torch.sin(2 * turn), torch.cos(2 * turn)

        def harmonic(sine: str, cosine: str) -> tuple[Tensor, Tensor]:
            return eph[sine] * s2 + eph[cosine] * c2, 2 * turn1 * (eph[sine] * c2 - eph[cosine] * s2)

        du, du1 = harmonic("cus", "cuc")
        dr, dr1 = harmonic("crs", "crc")
        di, di1 = harmonic("cis", "cic")
        size, node1 = eph["sqrtA"] ** 2, eph["Omegadot"] - GPS_OMEGA
        node = eph["Omega0"] + node1 * tk - GPS_OMEGA * eph["sow"]
        where = (size * near + dr, turn + du, eph["i0"] + eph["idot"] * tk + di, node)
        return Elements(*where, size * e * torch.sin(anomaly) * anomaly1 + dr1, turn1 + du1, eph["idot"] + di1, node1)

    def _chosen(self, time: Tensor) -> tuple[dict[str, Tensor], Tensor]:
        """The parameters in force, [T, S] each, with the time `tk` from their time of ephemeris; and which are valid."""
        columns, names = self._ephemerides
        t = time.to(torch.float64)
        toe = columns[..., 0]
        middle = 0.5 * (toe[:, 1:] + toe[:, :-1])
        which = torch.searchsorted(middle, t.expand(len(toe), -1).contiguous())
        values = columns.gather(1, which[..., None].expand(-1, -1, columns.shape[-1])).transpose(0, 1)
        eph = dict(zip(names, values.unbind(-1), strict=True))
        eph["tk"] = t[:, None] - eph["toe"]
        return eph, eph["tk"].abs() <= self.validity

    @cached_property
    def _ephemerides(self) -> tuple[Tensor, tuple[str, ...]]:
        """All parameters [S, E, P], sorted by time of ephemeris from t = 0 and filled up with the last; and their names."""
        table = self._table
        wanted = ["toe", *sorted({*CLOCK, *ORBIT} - {"toe"}), "tgd", "sow", "gm"]
        parts = [torch.from_numpy(table.loc[table["name"] == name, wanted].to_numpy(float, copy=True)) for name in self.names]
        longest = max(len(part) for part in parts)
        filled = [torch.cat([part, part[-1:].expand(longest - len(part), -1)]) for part in parts]
        return torch.stack(filled), tuple(wanted)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """What was left out, for a report."""
        table = self._dated[~plausible(self._dated)]
        rows = zip(table["name"], table["toe"], table["sqrtA"], strict=True)
        return tuple(
            f"{self.path}: an ephemeris of {name} at t = {toe:.0f} s left out: its semi-major axis is {root**2:.0f} m"
            for name, toe, root in rows
        )

    @cached_property
    def _table(self) -> pd.DataFrame:
        """The ephemerides in use, one row each."""
        table = self._dated[plausible(self._dated)]
        if not (table["toe"].abs() <= self.validity).any():
            first, last = (self.epoch + table["toe"].agg(["min", "max"])).tolist()
            raise ValueError(
                f"begin={self.begin} is GPS time {self.epoch:.0f} s, and the ephemerides of {self.path} are for "
                f"{first:.0f} to {last:.0f} s, valid for {self.validity:.0f} s: give a begin near them"
            )
        return table

    @cached_property
    def _dated(self) -> pd.DataFrame:
        """Healthy satellites' ephemerides, times from t = 0."""
        return dated(read(self.root, self.path), self.epoch)
