"""An example of an own raw log: a drive with an IMU, whose ranges to GPS satellites are written as RINEX files."""

from __future__ import annotations

import math
from collections.abc import Hashable, Mapping, Sequence
from datetime import timedelta
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from torch import Tensor

from pfbench.files import write_atomically
from pfbench.logs.sky.broadcast_orbits import BroadcastConstellation
from pfbench.logs.sky.ephemeris import EPOCH, LINES
from pfbench.logs.units import WEEK
from pfbench.nav import earth
from pfbench.nav.atmosphere import Sight, delay_in_ionosphere, delay_in_troposphere
from pfbench.nav.orbits import LIGHT, azimuth_elevation, receive_signals

START = 2381 * WEEK + 408600.0  # GPS time of t = 0, s: 2025-08-28T17:30:00
ORIGIN = (40.0, -105.0, 1500.0)  # lat_deg, lon_deg, h_m of the start
IONOSPHERE = (1.1e-8, 7.5e-9, -6e-8, -6e-8, 9e4, 0.0, -2e5, -6.6e4)
OFFSET_S, DRIFT = 3e-4, -2e-7  # s, s/s; of the receiver clock
_FREQUENCY = 1575.42e6  # Hz
_IMU_RATE, _GRAVITY = 100.0, 9.80665  # Hz, m/s^2


def write_raw_log(folder: str | Path, seconds: float = 60.0, range_sd: float = 1.0) -> Path:
    """Write a folder with `drive.obs`, `drive.nav`, `imu.csv` and `reference.csv`.

    Args:
        folder: Folder, which is made.
        seconds: Length of the drive.
        range_sd: Standard deviation of the ranges, m. That of range rates is a tenth per second.

    Returns:
        The folder.
    """
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    write_navigation(target / "drive.nav", make_ephemerides(), IONOSPHERE)
    epochs = np.arange(0.0, seconds + 0.5)
    rows = simulate_ranges(target / "drive.nav", epochs)
    noise = np.random.default_rng(1).normal(size=(2, len(rows)))
    rows["pr"] += range_sd * noise[0]
    rows["doppler"] += 0.1 * range_sd * noise[1] * _FREQUENCY / LIGHT
    write_observations(target / "drive.obs", rows)
    motion = drive(np.arange(0.0, seconds + 0.5 / _IMU_RATE, 1.0 / _IMU_RATE))
    imu = ["t", "fx", "fy", "fz", "wx", "wy", "wz"]
    motion[imu].round(6).to_csv(target / "imu.csv", index=False)
    truth = ["t", "lat_deg", "lon_deg", "h_m", "vn", "ve", "vd", "roll", "pitch", "yaw"]
    motion.loc[::10, truth].round(10).to_csv(target / "reference.csv", index=False)
    return target


def drive(time: np.ndarray) -> pd.DataFrame:
    """Return a level drive through bends: IMU and reference by column, without errors. Shapes: time [n], s."""
    fine = np.arange(0.0, time[-1] + 0.02, 0.01)
    yaw, speed = 0.5 + 0.6 * np.sin(0.2 * time), 10.0 + 2.0 * np.sin(0.3 * time)
    fast = (10.0 + 2.0 * np.sin(0.3 * fine)) * np.exp(1j * (0.5 + 0.6 * np.sin(0.2 * fine)))
    path = np.concatenate([[0.0], np.cumsum(0.5 * (fast[1:] + fast[:-1]) * 0.01)])
    zero, turn = np.zeros_like(time), 0.12 * np.cos(0.2 * time)
    pn, pe = np.interp(time, fine, path.real), np.interp(time, fine, path.imag)
    at = earth.from_local_enu(torch.from_numpy(np.stack([pe, pn, zero], -1)), _origin()).numpy()
    return pd.DataFrame({
        "t": time + START % WEEK, "fx": 0.6 * np.cos(0.3 * time), "fy": speed * turn, "fz": zero - _GRAVITY,
        "wx": zero, "wy": zero, "wz": turn, "lat_deg": np.degrees(at[:, 0]), "lon_deg": np.degrees(at[:, 1]),
        "h_m": at[:, 2], "vn": speed * np.cos(yaw), "ve": speed * np.sin(yaw), "vd": zero, "roll": zero, "pitch": zero,
        "yaw": yaw,
    })  # fmt: skip


def make_ephemerides() -> pd.DataFrame:
    """Return ephemerides of 24 satellites in six planes, a row each, with the names of RINEX."""
    rows = []
    for i in range(24):
        plane, slot = divmod(i, 4)
        values = dict.fromkeys(LINES, 0.0) | {
            "sqrtA": 5153.6, "e": 0.005 + 0.0005 * slot, "i0": 0.96, "Omegadot": -8e-9, "deltan": 4e-9,
            "Omega0": -math.pi + plane * math.pi / 3.0, "omega": 0.3, "M0": -math.pi + slot * math.pi / 2.0 + 0.4 * plane,
            "af0": 1e-5 * (i - 12), "af1": 1e-12 * (i - 12), "tgd": 1e-9 * (i % 5), "crc": 250.0, "cus": 8e-6,
        }  # fmt: skip
        toe = START % WEEK - START % 7200.0
        week = {"toe": toe, "toc": toe, "ttx": toe, "week": START // WEEK}
        rows.append({**values, **week, "sys": "G", "prn": i + 1})
    return pd.DataFrame(rows)


def simulate_ranges(navigation: Path, epochs: np.ndarray) -> pd.DataFrame:
    """Return error-free observations of the drive above 5 degrees, a row per epoch and satellite.

    The receiver's clock is `OFFSET_S` + `DRIFT` t ahead, so it measures at other times than it states.

    Shapes: epochs [K], s after `START` by the receiver's clock.
    """
    constellation = BroadcastConstellation(str(navigation.parent), navigation.name, START)
    ahead = OFFSET_S + DRIFT * epochs
    time = torch.from_numpy(epochs - ahead)
    motion = drive(np.concatenate([[0.0], np.maximum(time.numpy(), 0.0)])).iloc[1:]
    antenna = torch.from_numpy(motion[["lat_deg", "lon_deg", "h_m"]].to_numpy().copy())
    antenna[:, :2] = torch.deg2rad(antenna[:, :2])
    moving = torch.from_numpy(motion[["ve", "vn"]].to_numpy().copy())
    velocity = (torch.cat([moving, torch.zeros(len(time), 1, dtype=torch.float64)], -1).unsqueeze(-2) @ earth.local_axes(_origin())).squeeze(-2)  # fmt: skip
    signal = receive_signals(constellation, time, earth.ecef(antenna))
    line = signal.pos - earth.ecef(antenna)[:, None]
    rate = (line / signal.range.unsqueeze(-1) * (signal.vel - velocity[:, None])).sum(-1)
    sight = Sight(antenna, *azimuth_elevation(antenna, signal.pos))
    delay = delay_in_troposphere(sight) + delay_in_ionosphere(
        sight, time + START % WEEK, IONOSPHERE
    )
    clock, clock_drift = _satellite_clock(constellation, time, signal.flight_time)
    ranges = signal.range + delay + LIGHT * (torch.from_numpy(ahead)[:, None] - clock)
    rates = rate + LIGHT * (DRIFT - clock_drift)
    is_up = sight.elevation > math.radians(5.0)
    step, place_of = torch.nonzero(is_up, as_tuple=True)
    names = [constellation.names[s] for s in place_of.tolist()]
    return pd.DataFrame({
        "time": START + epochs[step.numpy()], "sys": [name[0] for name in names], "svid": [int(name[1:]) for name in names],
        "pr": ranges[is_up].numpy(), "doppler": -rates[is_up].numpy() * _FREQUENCY / LIGHT,
        "cn0": 35.0 + 12.0 * np.sin(sight.elevation[is_up].numpy()),
    })  # fmt: skip


def _satellite_clock(
    constellation: BroadcastConstellation, time: Tensor, flight: Tensor
) -> tuple[Tensor, Tensor]:
    """Return clock offset s, with relativity and group delay, and drift of the satellites at transmission, [T, S]."""
    typical = time - flight.nanmean(-1)
    offset, drift = constellation.clock(typical)
    relativity = constellation.relativity(typical)
    rate = constellation.relativity(typical + 0.5) - constellation.relativity(typical - 0.5)
    later = time[:, None] - flight - typical[:, None]
    total = offset + relativity - constellation.group_delay(typical) + (drift + rate) * later
    return total, drift + rate


def write_observations(
    file: Path, rows: pd.DataFrame, position: Sequence[float] = (0.0, 0.0, 0.0)
) -> None:
    """Write a RINEX 3.04 observation file: C1C, D1C and S1C of GPS and Galileo, blank where they are NaN."""
    first = EPOCH + timedelta(seconds=float(rows["time"].min()))
    stamp = f"{first:%Y} {first.month:5d} {first.day:5d} {first.hour:5d} {first.minute:5d}"
    head = [
        f"{'     3.04           OBSERVATION DATA    M':60}RINEX VERSION / TYPE",
        f"{''.join(f'{a:14.4f}' for a in position):60}APPROX POSITION XYZ",
        *(f"{system + '    3 C1C D1C S1C':60}SYS / # / OBS TYPES" for system in sorted(set(rows["sys"]))),
        f"{f'  {stamp}   {first.second:10.7f}     GPS':60}TIME OF FIRST OBS",
        f"{'':60}END OF HEADER",
    ]  # fmt: skip
    lines = []
    numbers = rows[["time", "svid", "pr", "doppler", "cn0"]].to_numpy(float)
    systems = rows["sys"].tolist()
    for time in np.unique(numbers[:, 0]).tolist():
        second_of_start = math.floor(time)
        at = EPOCH + timedelta(seconds=second_of_start)
        places = np.flatnonzero(numbers[:, 0] == time).tolist()
        second = f"{at.second + (time - second_of_start):11.7f}"
        lines.append(f"> {at:%Y %m %d %H %M}{second}  0{len(places):3d}")
        for i in places:
            cells = [" " * 16 if math.isnan(a) else f"{a:14.3f}  " for a in numbers[i, 2:].tolist()]
            lines.append(f"{systems[i]}{int(numbers[i, 1]):02d}{''.join(cells)}".rstrip())
    text = "\n".join([*head, *lines]) + "\n"
    write_atomically(file, lambda stream: stream.write(text.encode()))


def write_navigation(file: Path, rows: pd.DataFrame, ionosphere: Sequence[float] = ()) -> None:
    """Write a RINEX 3.04 navigation file; `rows` have the names of RINEX, `sys` and `prn`."""
    head = [f"{'     3.04           N: GNSS NAV DATA    M: MIXED':60}RINEX VERSION / TYPE"]
    for name, values in zip("AB", (ionosphere[:4], ionosphere[4:]), strict=True):
        if len(values):
            head.append(
                f"{f'GPS{name} ' + ''.join(f'{a:12.4E}' for a in values):60}IONOSPHERIC CORR"
            )
    head.append(f"{'':60}END OF HEADER")
    records = [_format_record(row) for row in rows.to_dict("records")]
    text = "\n".join([*head, *records]) + "\n"
    write_atomically(file, lambda stream: stream.write(text.encode()))


def _format_record(row: Mapping[Hashable, Any]) -> str:
    """Format the eight lines of an ephemeris."""
    at = EPOCH + timedelta(seconds=float(row["week"]) * WEEK + float(row["toc"]))
    numbers = [f"{float(row[name]):19.12E}" for name in LINES[1:]]
    first = f"{row['sys']}{int(row['prn']):02d} {at:%Y %m %d %H %M %S}{''.join(numbers[:3])}"
    rest = ["    " + "".join(numbers[k : k + 4]) for k in range(3, len(numbers), 4)]
    return "\n".join([first, *rest])


def _origin() -> Tensor:
    """Return the start of the drive, rad and m, [3]."""
    lat, lon, height = ORIGIN
    return torch.tensor([math.radians(lat), math.radians(lon), height], dtype=torch.float64)
