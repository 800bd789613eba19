"""Navigation satellites: nominal constellations, broadcast ephemerides, and what a receiver makes of where they are.

Positions and velocities are Earth-fixed [m, m/s], velocities as seen from the rotating Earth. Time is seconds from the
beginning of a scene.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import datetime
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple, Protocol

import pandas as pd
import torch
from torch import Tensor

from pfbench.nav import earth

LIGHT = 299792458.0  # m/s
GPS_OMEGA = 7.2921151467e-5  # rate of the Earth that ephemerides are made with [rad/s]
GM_GPS = 3.986005e14  # of GPS ephemerides [IS-GPS-200, table 20-IV]; Galileo's are made with earth.GM [Galileo OS SIS ICD]
WEEK = 604800.0  # s
_TYPICAL_FLIGHT = 0.075  # s
_EPOCH = datetime(1980, 1, 6)
_SHAPE = ("crs", "deltan", "M0", "cuc", "e", "cus", "sqrtA", "toe")
_ORBIT = (*_SHAPE, "cic", "Omega0", "cis", "i0", "crc", "omega", "Omegadot", "idot")
_CLOCK = ("toc", "af0", "af1", "af2")
_LINES = (*_CLOCK, "iode", *_ORBIT, "codes", "week", "l2p", "ura", "health", "tgd", "iodc", "ttx")  # a record in RINEX's order
_LEAP = 0.01  # relative change of a satellite's sqrtA that no manoeuvre makes


class Constellation(Protocol):
    """Satellites whose places are known."""

    @property
    def names(self) -> tuple[str, ...]:
        """Of the S satellites: G05, E31 ..."""

    def at(self, time: Tensor) -> tuple[Tensor, Tensor]:
        """Positions and velocities at times [T] s: [T, S, 3] m and m/s; NaN where a satellite's place is not known."""


class Elements(NamedTuple):
    """Where satellites are in their orbits, and the time derivatives of that, each [...].

    Attributes:
        radius, argument, inclination, node: m; argument of latitude, inclination and Earth-fixed longitude of the ascending
            node, rad.
        radius1, argument1, inclination1, node1: per second.
    """

    radius: Tensor
    argument: Tensor
    inclination: Tensor
    node: Tensor
    radius1: Tensor
    argument1: Tensor
    inclination1: Tensor
    node1: Tensor

    def earth_fixed(self) -> tuple[Tensor, Tensor]:
        """Position and velocity [..., 3]."""
        (su, cu), (si, ci), (so, co) = ((torch.sin(a), torch.cos(a)) for a in self[1:4])
        along, across = self.radius * cu, self.radius * su
        along1 = self.radius1 * cu - across * self.argument1
        across1 = self.radius1 * su + along * self.argument1
        level, level1 = across * ci, across1 * ci - across * si * self.inclination1
        x, y = along * co - level * so, along * so + level * co
        x1 = along1 * co - level1 * so - y * self.node1
        y1 = along1 * so + level1 * co + x * self.node1
        z1 = across1 * si + across * ci * self.inclination1
        return torch.stack([x, y, across * si], -1), torch.stack([x1, y1, z1], -1)


@dataclass(frozen=True)
class Walker:
    """Circular orbits in evenly spaced planes, i: T/P/F [Walker 1984, "Satellite constellations"]; defaults near GPS [ours].

    Args:
        satellites, planes, phasing: T, P and F; satellites of neighbouring planes are F 360/T degrees apart.
        inclination_deg: of all planes.
        semi_major_axis: m.
        node_deg: the first plane's node lies so far West of Greenwich at t = 0.
        argument_deg: argument of latitude of the first satellite at t = 0.

    Raises:
        ValueError: satellites that do not fill the planes, or an orbit inside the Earth.
    """

    satellites: int = 24
    planes: int = 6
    phasing: int = 1
    inclination_deg: float = 55.0
    semi_major_axis: float = 26559710.0
    node_deg: float = 40.0
    argument_deg: float = 40.0

    def __post_init__(self) -> None:
        if min(self.satellites, self.planes) < 1 or self.satellites % self.planes:
            raise ValueError(f"satellites={self.satellites}, planes={self.planes}: give a whole number of satellites per plane")
        if not self.semi_major_axis > earth.A:
            raise ValueError(f"semi_major_axis={self.semi_major_axis}: give metres from the centre of the Earth")

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(f"W{i + 1:02d}" for i in range(self.satellites))

    @property
    def motion(self) -> float:
        """Mean motion, rad/s."""
        return math.sqrt(earth.GM / self.semi_major_axis**3)

    def at(self, time: Tensor) -> tuple[Tensor, Tensor]:
        t = time.to(torch.float64).unsqueeze(-1)
        number, slots = torch.arange(self.satellites, dtype=torch.float64, device=t.device), self.satellites // self.planes
        plane, slot = torch.div(number, slots, rounding_mode="floor"), number % slots
        ahead = 360.0 / slots * slot + 360.0 * self.phasing / self.satellites * plane + self.argument_deg
        argument = torch.deg2rad(ahead) + self.motion * t
        node = torch.deg2rad(360.0 / self.planes * plane - self.node_deg) - earth.OMEGA * t
        one, zero = torch.ones_like(argument), torch.zeros_like(argument)
        where = (one * self.semi_major_axis, argument, one * math.radians(self.inclination_deg), node)
        return Elements(*where, zero, one * self.motion, zero, -one * earth.OMEGA).earth_fixed()


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
            return (datetime.fromisoformat(str(self.begin)) - _EPOCH).total_seconds()
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
        wanted = ["toe", *sorted({*_CLOCK, *_ORBIT} - {"toe"}), "tgd", "sow", "gm"]
        parts = [torch.from_numpy(table.loc[table["name"] == name, wanted].to_numpy(float, copy=True)) for name in self.names]
        longest = max(len(part) for part in parts)
        filled = [torch.cat([part, part[-1:].expand(longest - len(part), -1)]) for part in parts]
        return torch.stack(filled), tuple(wanted)

    @cached_property
    def notes(self) -> tuple[str, ...]:
        """What was left out, for a report."""
        table = self._dated[~_plausible(self._dated)]
        rows = zip(table["name"], table["toe"], table["sqrtA"], strict=True)
        return tuple(
            f"{self.path}: an ephemeris of {name} at t = {toe:.0f} s left out: its semi-major axis is {root**2:.0f} m"
            for name, toe, root in rows
        )

    @cached_property
    def _table(self) -> pd.DataFrame:
        """The ephemerides in use, one row each."""
        table = self._dated[_plausible(self._dated)]
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
        remedy = f"set the environment variable PFBENCH_DATA, or data.root=..., to the folder that holds {self.path}"
        if self.root is None:
            raise ValueError(f"data.root is not set, and ephemerides are not part of the package: {remedy}")
        file = Path(self.root) / self.path
        if not file.is_file():
            raise ValueError(f"data.root={self.root}: no file {file}; {remedy}")
        return dated(pd.read_parquet(file) if file.suffix == ".parquet" else read_rinex(file), self.epoch)


def _plausible(table: pd.DataFrame) -> pd.Series:
    """Ephemerides near the usual size of their satellite's orbit: merged files hold records that were received wrongly. [ours]"""
    usual = table.groupby("name")["sqrtA"].transform("median")
    return (table["sqrtA"] / usual - 1.0).abs() < _LEAP


def dated(table: pd.DataFrame, epoch: float) -> pd.DataFrame:
    """Healthy ephemerides with `toe` and `toc` in seconds from an epoch, in order; the last sent of each toe.

    Weeks, those of `toe`, count modulo 1024, as satellites send them; where none is told, it is the one nearest to the epoch.
    """
    table = table.copy()
    missing = [name for name in ("prn", *_CLOCK, *_ORBIT) if name not in table]
    if missing:
        raise ValueError(f"the ephemerides have no {', '.join(missing)}; name the columns as RINEX does: {', '.join(_LINES)}")
    unknown, optional = pd.Series(math.nan, table.index), ("week", "health", "tgd", "ttx")
    column = {name: table.get(name, unknown) for name in optional}
    system = table["sys"] if "sys" in table else pd.Series("G", table.index)
    table["name"] = [f"{s}{int(prn):02d}" for s, prn in zip(system, table["prn"], strict=True)]
    table["gm"] = system.map({"G": GM_GPS, "E": earth.GM})
    table["tgd"] = column["tgd"].fillna(0.0)
    table["ttx"] = column["ttx"].fillna(0.0)
    table["sow"] = table["toe"] % WEEK
    since = column["week"].fillna(0.0) * WEEK + table["toe"] - epoch
    cycle = (1024 * WEEK) * column["week"].notna() + WEEK * column["week"].isna()
    offset = table["toc"] - table["toe"]
    table["toe"] = since - cycle * (since / cycle).round()
    table["toc"] = table["toe"] + offset - WEEK * (offset / WEEK).round()
    healthy = table["gm"].notna() & (column["health"].fillna(0.0) == 0.0)
    ordered = table[healthy].sort_values(["name", "toe", "ttx"], kind="stable")
    return ordered.drop_duplicates(["name", "toe"], keep="last").reset_index(drop=True)


def read_rinex(file: Path) -> pd.DataFrame:
    """Ephemerides of GPS and Galileo (I/NAV) in a RINEX 2 or 3 navigation file, one row each; toc in seconds of the week.

    Raises:
        ValueError: not such a file, or a record that cannot be read; names the line.
    """
    lines = file.read_text(errors="replace").splitlines()
    version = lines[0][:9].strip() if lines and "RINEX VERSION" in lines[0] else ""
    if version[:1] not in ("2", "3") or lines[0][20:21] != "N":
        raise ValueError(f"{file.name}: no RINEX 2 or 3 navigation file; its first line says {lines[0][:60] if lines else ''!r}")
    body = next((i + 1 for i, line in enumerate(lines) if "END OF HEADER" in line), len(lines))
    table = pd.DataFrame(list(_records(lines, body, 3 if version[0] == "3" else 2, file.name)))
    if table.empty:
        raise ValueError(f"{file.name}: no ephemeris of GPS or Galileo in it")
    return table


def _records(lines: Sequence[str], body: int, version: int, name: str) -> Iterator[dict[str, float | str]]:
    """Records from line `body` on; numbers stand in columns of 19 after an indent of 3 (RINEX 2) or 4."""
    indent = version + 1
    starts = [i for i in range(body, len(lines)) if lines[i][:indent].strip()]
    for begin, end in pairwise([*starts, len(lines)]):
        system = lines[begin][0] if version == 3 else "G"
        if system not in "GE":
            continue
        where = f"{name}: line {begin + 1}, {lines[begin][:23]!r}"
        try:
            prn, *date = lines[begin][version - 2 : 19 + indent].split()
            number = [_number(lines[begin], 19 + indent + 19 * k) for k in range(3)]
            number += [_number(line, indent + 19 * k) for line in lines[begin + 1 : end] for k in range(4)]
            record = dict(zip(_LINES, [_seconds_of_week(date), *number], strict=False))
            complete = "toe" in record and "ttx" in record
        except ValueError as error:
            raise ValueError(f"{where}: {error}; repair or leave out the record") from None
        if not complete:
            raise ValueError(f"{where}: the record is cut short; leave it out")
        if system == "E" and not int(record["codes"]) & 0b101:  # F/NAV: clocks of another pair of frequencies
            continue
        if system == "E":
            record["tgd"] = record["iodc"]  # the group delay of E1 and E5b goes with I/NAV
        yield {**record, "sys": system, "prn": float(prn)}


def _number(line: str, place: int) -> float:
    text = line[place : place + 19].strip()
    return float(text.replace("D", "e").replace("d", "e")) if text else 0.0


def _seconds_of_week(date: Sequence[str]) -> float:
    year, month, day, hour, minute = (int(part) for part in date[:5])
    if year < 100:
        year += 1900 if year >= 80 else 2000
    days = (datetime(year, month, day) - _EPOCH).days % 7
    return days * 86400.0 + hour * 3600.0 + minute * 60.0 + float(date[5])


def eccentric_anomaly(mean: Tensor, e: Tensor, passes: int = 8) -> tuple[Tensor, Tensor]:
    """E with E - e sin E = mean anomaly, and 1 - e cos E, [...] each; Newton's method, exact to rounding for e below 0.5."""
    anomaly = mean + e * torch.sin(mean)
    for _ in range(passes):
        anomaly = anomaly - (anomaly - e * torch.sin(anomaly) - mean) / (1 - e * torch.cos(anomaly))
    return anomaly, 1 - e * torch.cos(anomaly)


def sagnac(satellite: Tensor, flight_time: Tensor) -> Tensor:
    """Earth-fixed vectors of the instant of transmission [..., 3] in the Earth-fixed axes of reception.

    Args:
        satellite: positions or velocities [..., 3].
        flight_time: [...] s.
    """
    angle = GPS_OMEGA * flight_time
    s, c = torch.sin(angle), torch.cos(angle)
    x, y, z = satellite.unbind(-1)
    return torch.stack([c * x + s * y, c * y - s * x, z.expand_as(c * x)], -1)


class Signal(NamedTuple):
    """What arrives at a receiver, in the Earth-fixed axes of reception.

    Attributes:
        pos, vel: of the satellites at transmission [..., T, S, 3] m, m/s. The range's rate is
            u . (vel - velocity of the receiver), u from receiver to satellite, but for a millionth of itself.
        range: [..., T, S] m.
    """

    pos: Tensor
    vel: Tensor
    range: Tensor

    @property
    def flight_time(self) -> Tensor:
        """[..., T, S] s."""
        return self.range / LIGHT


def transmit(constellation: Constellation, time: Tensor, receiver: Tensor, passes: int = 4) -> Signal:
    """Signals that arrive at times [T] s at Earth-fixed places [..., T, 3] m.

    The satellites are asked once, a typical time of flight earlier, and fall freely over the remaining 0.02 s. [ours]
    """
    place, velocity = constellation.at(time - _TYPICAL_FLIGHT)
    acceleration = _fall(place, velocity)
    flight = torch.full((), _TYPICAL_FLIGHT, dtype=place.dtype, device=place.device)
    for _ in range(passes):
        later = (_TYPICAL_FLIGHT - flight).unsqueeze(-1)
        pos = sagnac(place + (velocity + 0.5 * acceleration * later) * later, flight)
        distance = torch.linalg.vector_norm(pos - receiver.unsqueeze(-2), dim=-1)
        flight = distance / LIGHT
    return Signal(pos, sagnac(velocity + acceleration * later, flight), distance)


def _fall(place: Tensor, velocity: Tensor) -> Tensor:
    """Acceleration in Earth-fixed axes [..., 3] m/s^2 of a satellite of a round Earth."""
    turn = torch.tensor([0.0, 0.0, earth.OMEGA], dtype=place.dtype, device=place.device).expand_as(place)
    pull = earth.GM * place / torch.linalg.vector_norm(place, dim=-1, keepdim=True) ** 3
    return -pull - torch.linalg.cross(turn, 2 * velocity + torch.linalg.cross(turn, place))


def azimuth_elevation(receiver: Tensor, satellite: Tensor) -> tuple[Tensor, Tensor]:
    """Azimuth, clockwise from North in [0, 2 pi), and elevation [..., S] in rad.

    Args:
        receiver: latitude, longitude, height [..., 3] rad, rad, m.
        satellite: Earth-fixed [..., S, 3] m.
    """
    sight = satellite - earth.ecef(receiver).unsqueeze(-2)
    east, north, up = (sight @ earth.local_axes(receiver).mT).unbind(-1)
    return torch.atan2(east, north) % (2 * torch.pi), torch.atan2(up, torch.hypot(east, north))
