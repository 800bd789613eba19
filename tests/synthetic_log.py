"""A level drive through bends with exact sensors, written as a log: forward-right-down axes, North-East-Down frame."""

from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd

GRAVITY = 9.80665
ORIGIN = (40.0, -105.0, 1500.0)


def drive(t: np.ndarray) -> dict[str, np.ndarray]:
    """Speed 10 + 2 sin(0.5 t) m/s, heading 0.6 sin(0.4 t) + 0.5 rad; position by the trapezoidal rule on steps of 2 ms."""

    def velocity(at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        return 10 + 2 * np.sin(0.5 * at), 0.5 + 0.6 * np.sin(0.4 * at)

    fine = np.arange(0.0, t[-1] + 0.002, 0.002)
    fast, where = velocity(fine)
    v = fast * np.stack([np.cos(where), np.sin(where)])
    p = np.concatenate(
        [np.zeros((2, 1)), np.cumsum(0.5 * (v[:, 1:] + v[:, :-1]) * 0.002, axis=1)], axis=1
    )
    (speed, heading), turn, zero = velocity(t), 0.24 * np.cos(0.4 * t), np.zeros_like(t)
    return {
        "t": t, "fx": np.cos(0.5 * t), "fy": speed * turn, "fz": zero - GRAVITY, "wx": zero, "wy": zero, "wz": turn,
        "pn": np.interp(t, fine, p[0]), "pe": np.interp(t, fine, p[1]), "pd": zero + 3.0,
        "vn": speed * np.cos(heading), "ve": speed * np.sin(heading), "vd": zero,
        "roll": zero, "pitch": zero, "yaw": heading,
    }  # fmt: skip


def tables(seconds: float = 20.0) -> dict[str, pd.DataFrame]:
    """imu at 100 Hz, gnss at 5 Hz, reference at 20 Hz; fresh copies."""
    return {name: table.copy() for name, table in _tables(seconds).items()}


@cache
def _tables(seconds: float) -> dict[str, pd.DataFrame]:
    columns = {
        "imu": ["t", "fx", "fy", "fz", "wx", "wy", "wz"],
        "gnss": ["t", "pn", "pe", "pd", "vn", "ve", "vd"],
        "reference": ["t", "pn", "pe", "pd", "vn", "ve", "vd", "roll", "pitch", "yaw"],
    }
    rates = {"imu": 100, "gnss": 5, "reference": 20}
    whole = {
        name: drive(np.arange(round(seconds * rate) + 1) / rate) for name, rate in rates.items()
    }
    return {
        name: pd.DataFrame({c: whole[name][c] for c in wanted}) for name, wanted in columns.items()
    }


def write(folder: Path, log: dict[str, pd.DataFrame], suffix: str = ".csv") -> Path:
    """Writes the tables; returns the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for name, table in log.items():
        file = folder / f"{name}{suffix}"
        if suffix == ".csv":
            table.to_csv(file, index=False)
        else:
            table.to_parquet(file, index=False)
    return folder
