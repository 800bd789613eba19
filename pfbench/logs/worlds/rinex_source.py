"""Raw measurements of one's own: RINEX 3 observations and broadcast ephemerides as a table of satellites."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd
import torch

from pfbench.core.parameter_checks import require
from pfbench.files.limits import find_input
from pfbench.files.reader_notes import skip_notes
from pfbench.logs.sky.broadcast_orbits import BroadcastConstellation, Transmission, parse_gps_time
from pfbench.logs.sky.rinex_observations import (
    SIGNALS,
    RawEpochs,
    check_version,
    read_observations,
)
from pfbench.logs.units import WEEK
from pfbench.logs.worlds.log_frames import GEODETIC_COLUMNS, place_of
from pfbench.logs.worlds.log_tables import Array, LogTable, ReferenceLog
from pfbench.nav import earth
from pfbench.nav.atmosphere import Sight, delay_in_ionosphere, delay_in_troposphere
from pfbench.nav.orbits import LIGHT, azimuth_elevation, sagnac

WAVELENGTH = LIGHT / 1575.42e6  # m
_HEAD = 200  # bytes of a file that show its kind
_KINDS = {"observations": "O", "navigation": "N"}


@dataclass(frozen=True)
class RinexSource:
    """RINEX files in the folder of a log.

    Attributes:
        observations: Name of the RINEX 3 observation file. None for the only one in the folder.
        navigation: Name of the RINEX 2, 3 or 4 navigation file. None for the only one in the folder.
        gps_time: GPS time of t = 0 in the tables: an ISO date, or seconds since 1980-01-06. None if the tables count from
            the begin of the GPS week, as the time of week does.
        signals: Codes on 1575.42 MHz by system, in order of preference.

    Raises:
        ValueError: If `gps_time` is not a date, or a signal is on another frequency.
    """

    observations: str | None = None
    navigation: str | None = None
    gps_time: str | float | None = None
    signals: Mapping[str, Sequence[str]] = field(default_factory=lambda: SIGNALS)

    def __post_init__(self) -> None:
        if self.gps_time is not None:
            parse_gps_time("scenario.rinex.gps_time", self.gps_time)
        codes = [f"{system}: {code}" for system, names in self.signals.items() for code in names]
        wrong = [c for c in codes if c[0] not in SIGNALS or c[3:4] != "1"]
        require(
            codes and not wrong,
            "scenario.rinex.signals",
            "be codes of G and E on 1575.42 MHz, such as {G: [1C], E: [1C, 1X]}",
            ", ".join(wrong) or "none",
        )

    def list_files(self, root: str | None, name: str) -> list[Path]:
        """List the files of a data set that are read; those that are not in its folder are left out.

        Args:
            root: Folder of all data, None for no files.
            name: Name of the data set.
        """
        if root is None:
            return []
        folder = find_input(root, name, is_data_set=True)
        names = [self.observations, self.navigation]
        lists = [
            [find_input(folder, name)] if name else list_rinex(folder, kind)
            for name, kind in zip(names, _KINDS.values(), strict=True)
        ]
        return [files[0] for files in lists if len(files) == 1 and files[0].is_file()]

    def read_epochs(self, folder: Path) -> RawEpochs:
        """Read the observations."""
        file = self._find(folder, "observations")
        content = read_observations(file, self.signals)
        first = float(content.rows["time"].iloc[0])
        is_week = self.gps_time is None
        start = first - first % WEEK if is_week else parse_gps_time("", self.gps_time or 0.0)
        rows = content.rows.drop_duplicates(["time", "sys", "svid"]).reset_index(drop=True)
        notes = content.notes
        if len(rows) < len(content.rows):
            notes += (f"{file.name}: {len(content.rows) - len(rows)} repeated rows are left out",)
        rows["t"] = rows["time"] - start
        return content._replace(rows=rows, start=start, notes=notes)

    def compute_sky(
        self, folder: Path, epochs: RawEpochs, track: ReferenceLog, centre: Sequence[float]
    ) -> LogTable:
        """Compute the satellites, the delays and the clocks of all observations within a track.

        Directions and delays are those at the position of the track, which need be known to some hundred metres.

        Args:
            folder: Folder of the navigation file.
            epochs: Observations.
            track: Positions from `centre`, East, North, Up.
            centre: lat_deg, lon_deg, h_m.

        Returns:
            The table `pseudorange`, without standard deviations.
        """
        inside = (epochs.rows["t"] >= track.time[0]) & (epochs.rows["t"] <= track.time[-1])
        require(
            inside.any(),
            f"{epochs.name}: t",
            "be that of the tables",
            f"{epochs.time[0]:.3f} to {epochs.time[-1]:.3f} s, and the track {track.time[0]:.3f} to {track.time[-1]:.3f} s",
            "Set scenario.rinex.gps_time to the GPS time of t = 0.",
        )
        rows = epochs.rows[inside].reset_index(drop=True)
        file, first = self._find(folder, "navigation"), float(rows["time"].iloc[0])
        constellation = BroadcastConstellation(str(file.parent), file.name, first)
        rows["name"] = [f"{s}{int(n):02d}" for s, n in zip(rows["sys"], rows["svid"], strict=True)]
        names = set(rows["name"])
        rows = rows[rows["name"].isin(constellation.names)].reset_index(drop=True)
        time, step = np.unique(rows["time"].to_numpy(), return_inverse=True)
        index = step, np.searchsorted(constellation.names, rows["name"].to_numpy(str))
        ranges = np.full((len(time), len(constellation.names)), np.nan)
        ranges[index] = rows["pr"]
        satellites = constellation.transmit(
            torch.from_numpy(time - first), torch.from_numpy(ranges)
        )
        receiver = _place(track, time - epochs.start, centre)
        sky = _describe_sky(
            satellites, receiver, torch.from_numpy(time % WEEK), constellation.ionosphere
        )
        rows = rows.assign(**{name: values.numpy()[index] for name, values in sky.items()})
        rows["prr"] = -WAVELENGTH * rows["doppler"]
        rows = rows[rows["sx"].notna()].reset_index(drop=True)
        skip_notes(folder, constellation.notes)
        notes = (
            *epochs.notes,
            *_describe_missing(epochs.name, rows, names, constellation),
            *constellation.notes,
        )
        stated = {
            f"origin_{key}": str(value) for key, value in zip(GEODETIC_COLUMNS, centre, strict=True)
        }
        return LogTable(rows, epochs.name, False, stated, notes=notes)

    def _find(self, folder: Path, key: str) -> Path:
        """Return the file of a key."""
        name, kind = getattr(self, key), _KINDS[key]
        if name is not None:
            file = find_input(folder, name)
            require(file.is_file(), f"scenario.rinex.{key}", f"be a file in {folder}", name)
            return file
        files = list_rinex(folder, kind)
        if not files and kind == "O":
            for file in sorted(folder.iterdir()):  # says how to unpack it
                head = _read_head(file)
                if (
                    "CRINEX VERS" in head
                    or (
                        head.startswith("\x1f\x8b")  # compressed, with the name of observations
                        and any(
                            s.lower().endswith(("o", "obs", "rnx", "crx", "d"))
                            for s in file.suffixes[:-1]
                        )
                    )
                ):
                    check_version(file.name, head)
        label = {"O": "RINEX 3 observation", "N": "RINEX navigation"}[kind]
        require(
            len(files) == 1,
            f"the folder {folder}",
            f"contain one {label} file",
            ", ".join(file.name for file in files) or "none",
            f"Name it by scenario.rinex.{key}.",
        )
        return find_input(folder, files[0].name)


def list_rinex(folder: Path, kind: str) -> list[Path]:
    """Return the RINEX files of a type in a folder, by their first line."""
    files = sorted(folder.iterdir()) if folder.is_dir() else []
    heads = {file: _read_head(file) for file in files}
    return [
        f
        for f, head in heads.items()
        if "RINEX VERSION / TYPE" in head[:82] and head[20:21] == kind
    ]


def _read_head(file: Path) -> str:
    """Return the first bytes of a file, an empty text for another thing than a file."""
    if not file.is_file():
        return ""
    with file.open("rb") as stream:
        return stream.read(_HEAD).removeprefix(b"\xef\xbb\xbf").decode("latin-1")


def _describe_missing(
    name: str, rows: pd.DataFrame, names: set[str], constellation: BroadcastConstellation
) -> Iterator[str]:
    """Describe satellites without ephemeris, and observations and corrections that the files do not have."""
    without = sorted(names - set(rows["name"]))
    if without:
        yield f"{name}: no ephemeris in use for {', '.join(without)}, whose ranges are left out"
    if not constellation.ionosphere:
        text = "the ionosphere is not corrected: the navigation file has no coefficients of GPS"
        yield f"{name}: {text}"
    for column, kind in (("prr", "D (Doppler)"), ("cn0", "S (signal strength)")):
        share = float(rows[column].isna().mean())
        if share > 0.0:
            yield f"{name}: {share:.0%} of the rows have no observation {kind}"


def _place(track: ReferenceLog, time: Array, centre: Sequence[float]) -> torch.Tensor:
    """Return Earth-fixed positions of the track, m, [T, 3]."""
    origin = place_of(centre)
    enu = np.stack([np.interp(time, track.time, axis) for axis in track.position.T], -1)
    return earth.ecef(origin) + torch.from_numpy(enu) @ earth.local_axes(origin)


def _describe_sky(
    satellites: Transmission,
    receiver: torch.Tensor,
    time: torch.Tensor,
    ionosphere: Sequence[float],
) -> dict[str, torch.Tensor]:
    """Return the columns of the table that the satellites and the receiver decide, [T, S] each.

    Shapes: receiver [T, 3], m, time of the week [T], s.
    """
    flight = torch.linalg.vector_norm(satellites.position - receiver[:, None], dim=-1) / LIGHT
    position, velocity = sagnac(satellites.position, flight), sagnac(satellites.velocity, flight)
    antenna = earth.geodetic(receiver)
    azimuth, elevation = azimuth_elevation(antenna, position)
    sight = Sight(antenna, azimuth, elevation.clamp(min=0.0))
    delay = torch.zeros_like(flight)
    if ionosphere:
        delay = delay_in_ionosphere(sight, time, ionosphere)
    angles = {"az": torch.rad2deg(azimuth), "el": torch.rad2deg(elevation)}
    axes = zip("xyz", position.unbind(-1), velocity.unbind(-1), strict=True)
    vectors = {key: value for a, p, v in axes for key, value in ((f"s{a}", p), (f"sv{a}", v))}
    clocks = {"sclk": satellites.clock, "sclkd": satellites.clock_drift}
    return {**vectors, **clocks, **angles, "tropo": delay_in_troposphere(sight), "iono": delay}
