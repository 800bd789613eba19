"""Made-up drives and the files of programs for the tests of judge."""

from functools import reduce
from operator import xor
from pathlib import Path

import numpy as np
import pandas as pd
from command_line import pfbench
from scipy.signal import lfilter

ORIGIN = (48.0, 11.0, 500.0)


def drive(seconds: float = 120.0, step: float = 0.5) -> pd.DataFrame:
    """A car that turns left and right at varying speed, in North, East, Down."""
    t = np.arange(0.0, seconds + step / 2, step)
    fine = np.linspace(0.0, t[-1], 20 * (len(t) - 1) + 1)
    yaw, speed = 0.5 + 1.2 * np.sin(0.05 * fine), 10.0 + 4.0 * np.sin(0.11 * fine)
    v = np.stack([speed * np.cos(yaw), speed * np.sin(yaw), 0.4 * np.sin(0.2 * fine)], -1)
    middle = (v[1:] + v[:-1]) / 2 * np.diff(fine)[:, None]
    p = np.concatenate([np.zeros((1, 3)), np.cumsum(middle, axis=0)])[::20]
    columns = dict(zip(("pn", "pe", "pd"), p.T, strict=True))
    columns |= dict(zip(("vn", "ve", "vd"), v[::20].T, strict=True))
    zero = np.zeros_like(t)
    pitch = 0.05 * np.sin(0.3 * t)
    return pd.DataFrame({"t": t, **columns, "roll": zero, "pitch": pitch, "yaw": yaw[::20]})


def estimate(truth: pd.DataFrame, sd: float, seed: int, correlation_s: float = 2.0) -> pd.DataFrame:
    """Positions with errors of first-order Markov type and the true SD."""
    step = truth.t[1] - truth.t[0]
    a = np.exp(-step / correlation_s)
    white = np.random.default_rng(seed).normal(size=(len(truth) + 200, 3))
    errors = sd * lfilter([np.sqrt(1 - a * a)], [1, -a], white, axis=0)[200:]
    table = truth[["t", "pn", "pe", "pd"]].copy()
    table[["pn", "pe", "pd"]] += errors
    table[["sd_pn", "sd_pe", "sd_pd"]] = sd
    return table


def write(table: pd.DataFrame, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    table.to_csv(path, index=False)
    return path


def geodetic(table: pd.DataFrame) -> np.ndarray:
    """Latitude, longitude, height by inversion of the local frame, from first-order steps."""
    from pfbench.logs.judge.trajectory_table import to_north_east_down

    target = table[["pn", "pe", "pd"]].to_numpy()
    guess = np.tile(np.array(ORIGIN), (len(target), 1))
    scale = np.array([1 / 111200.0, 1 / 74600.0, -1.0])
    for _ in range(30):
        guess += scale * (target - to_north_east_down(guess, np.array(ORIGIN)))
    return guess


def full(truth: pd.DataFrame) -> pd.DataFrame:
    """Position with errors and SD, velocity and attitude without."""
    rest = truth.drop(columns=["t", "pn", "pe", "pd"])
    return pd.concat([estimate(truth, 1.0, 1), rest], axis=1)


def judge(home: Path, *words: str):
    names = {"reference": "truth.csv", "mine": "mine.csv", "theirs": "theirs.csv"}
    given = {word.partition("=")[0] for word in words}
    files = [f"{name}={home / file}" for name, file in names.items() if name not in given]
    return pfbench("judge", *files, f"reports_dir={home / 'reports'}", *words, home=home)


def sentence(body: str) -> str:
    return f"${body}*{reduce(xor, body.encode(), 0):02X}"


def nmea(table: pd.DataFrame, start_s: float = 0.0) -> str:
    """GGA and RMC sentences of a track."""
    lines = []
    for (lat, lon, h), row in zip(geodetic(table), table.itertuples(), strict=True):
        seconds = (start_s + row.t) % 86400
        time = f"{int(seconds // 3600):02d}{int(seconds % 3600 // 60):02d}{seconds % 60:05.2f}"
        place = f"{int(lat):02d}{60 * (lat % 1):010.7f},N,{int(lon):03d}{60 * (lon % 1):010.7f},E"
        speed = np.hypot(row.vn, row.ve) * 3600 / 1852
        course = np.degrees(np.arctan2(row.ve, row.vn)) % 360
        lines.append(sentence(f"GPGGA,{time},{place},1,08,0.9,{h - 47.0:.4f},M,47.0,M,,"))
        lines.append(sentence(f"GPRMC,{time},A,{place},{speed:.6f},{course:.6f},080725,,"))
    return "\n".join(lines) + "\n"
