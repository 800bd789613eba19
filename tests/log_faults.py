"""Faults of own logs, planted in tables: each with the checks that name it, and those that may follow from it."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from recorded_data import DATA
from scipy.spatial.transform import Rotation

from pfbench.logs.doctor.checks import run_checks
from pfbench.logs.doctor.finding import Finding
from pfbench.logs.worlds.log_reader import LogSource
from pfbench.logs.worlds.log_tables import LogTable

Tables = dict[str, pd.DataFrame]
FORCE, RATE = ["fx", "fy", "fz"], ["wx", "wy", "wz"]
POSITION, VELOCITY, ANGLES = ["pn", "pe", "pd"], ["vn", "ve", "vd"], ["roll", "pitch", "yaw"]
LEVER = (1.2, 0.5, -1.0)


class Fault(NamedTuple):
    """A planted fault, the checks that name it, and checks that may speak, too."""

    plant: Callable[[Tables], None]
    named: str
    also: tuple[str, ...] = ()


def changed(
    table: str, change: Callable[[pd.DataFrame, np.ndarray], pd.DataFrame]
) -> Callable[[Tables], None]:
    """Change a table by a function of its rows and their places in time, from 0 to 1."""

    def plant(log: Tables) -> None:
        t = log[table]["t"].to_numpy()
        log[table] = change(log[table].copy(), (t - t[0]) / np.ptp(t)).reset_index(drop=True)

    return plant


def law(
    table: str, column: str, size: Callable[[np.ndarray], np.ndarray]
) -> Callable[[Tables], None]:
    """Add a function of the place in time, from 0 to 1, to a column."""
    return changed(table, lambda rows, s: rows.assign(**{column: rows[column] + size(s)}))


def late(table: str, seconds: float) -> Callable[[Tables], None]:
    return law(table, "t", lambda _: np.asarray(seconds))


def scaled(table: str, columns: Sequence[str], factor: float) -> Callable[[Tables], None]:
    return changed(table, lambda rows, _: rows.assign(**(rows[list(columns)] * factor)))


def added(table: str, column: str, value: float, row: float | None = None) -> Callable[[Tables], None]:  # fmt: skip
    """Add a value to a column, or to one of its rows at a share of them."""

    def size(s: np.ndarray) -> np.ndarray:
        return value * (
            (np.arange(len(s)) == int(row * len(s))) if row is not None else np.ones(len(s))
        )

    return law(table, column, size)


def mixed(table: str, columns: Sequence[str], order: Sequence[str]) -> Callable[[Tables], None]:
    """Replace columns by other ones, with a sign."""

    def plant(log: Tables) -> None:
        values = [(-1.0 if c[0] == "-" else 1.0) * log[table][c.lstrip("-")] for c in order]
        for column, value in zip(columns, [v.copy() for v in values], strict=True):
            log[table][column] = value

    return plant


def both(*plants: Callable[[Tables], None]) -> Callable[[Tables], None]:
    def plant(log: Tables) -> None:
        for part in plants:
            part(log)

    return plant


def jump(seconds: float) -> Callable[[Tables], None]:
    return changed(
        "imu", lambda rows, _: rows.assign(t=rows.t + seconds * (rows.t > rows.t.median()))
    )


def gap(table: str, seconds: float) -> Callable[[Tables], None]:
    def change(rows: pd.DataFrame, _: np.ndarray) -> pd.DataFrame:
        width = min(seconds, 0.25 * (rows.t.iloc[-1] - rows.t.iloc[0]))
        return rows[(rows.t < rows.t.median()) | (rows.t > rows.t.median() + width)]

    return changed(table, change)


def step_back(log: Tables) -> None:
    t = log["imu"]["t"].to_numpy(copy=True)
    n = len(t) // 2
    t[[n, n + 1]] = t[[n + 1, n]]
    log["imu"]["t"] = t


def repeated(table: str, rows: int) -> Callable[[Tables], None]:
    def plant(log: Tables) -> None:
        n, t = len(log[table]) // 2, log[table]
        log[table] = pd.concat([t[:n], t[n - rows : n], t[n:]], ignore_index=True)

    return plant


def jitter(log: Tables) -> None:
    t = log["imu"]["t"].to_numpy()
    d = np.median(np.diff(t))
    noise = np.clip(0.7 * d * np.random.default_rng(0).normal(size=len(t)), -3 * d, 3 * d)
    log["imu"]["t"] = np.maximum.accumulate(t + noise) + 1e-7 * np.arange(len(t))


def stuck(log: Tables) -> None:
    first = int(0.6 * len(log["imu"]))
    rows = slice(first, first + int(0.3 / np.median(np.diff(log["imu"]["t"]))))
    for column in FORCE + RATE:
        log["imu"].loc[rows, column] = log["imu"].loc[first, column]


def frozen(log: Tables) -> None:
    fixes, truth = log["gnss"], log["reference"]
    speed = np.interp(fixes["t"], truth["t"], np.hypot(truth["vn"], truth["ve"]))
    usable = fixes["t"] < fixes["t"].iloc[-1] - 5.0
    first = int(np.argmax(np.convolve(speed, np.ones(5), "same") * usable))
    rows = (fixes["t"] >= fixes["t"][first]) & (fixes["t"] < fixes["t"][first] + 3.0)
    for column in POSITION:
        fixes.loc[rows, column] = fixes.loc[first, column]


def lever(arm: tuple[float, float, float]) -> Callable[[Tables], None]:
    def plant(log: Tables) -> None:
        truth = log["reference"]
        angles = truth[["yaw", "pitch", "roll"]].to_numpy()
        offset = Rotation.from_euler("ZYX", angles).apply(arm)
        for k, column in enumerate(POSITION):
            log["gnss"][column] += np.interp(log["gnss"]["t"], truth["t"], offset[:, k])

    return plant


def nmea_codes(log: Tables) -> None:
    log["gnss"]["fix"] = np.where(np.arange(len(log["gnss"])) % 7 == 0, 5, 4)


def slow(log: Tables) -> None:
    stride = round(0.2 / np.median(np.diff(log["imu"]["t"])))
    log["imu"] = log["imu"][::stride].reset_index(drop=True)


def body(*axes: str) -> Callable[[Tables], None]:
    """Body axes that are recorded under the names x, y, z."""
    return both(
        *(mixed("imu", [f"{s}{a}" for a in "xyz"], [f"{'-' * (a[0] == '-')}{s}{a[-1]}" for a in axes]) for s in "fw")
    )  # fmt: skip


def enu(table: str, *groups: Sequence[str]) -> Callable[[Tables], None]:
    return both(*(mixed(table, g, [g[1], g[0], f"-{g[2]}"]) for g in groups))


def turned(table: str, degrees: float, *groups: Sequence[str]) -> Callable[[Tables], None]:
    """Turn North and East of a frame about the vertical."""

    def plant(log: Tables) -> None:
        turn = np.exp(1j * np.radians(degrees))
        for north, east, _ in groups:
            z = turn * (log[table][north] + 1j * log[table][east]).to_numpy()
            log[table][north], log[table][east] = z.real, z.imag

    return plant


def mounted(*angles: float) -> Callable[[Tables], None]:
    """Turn the sensor by roll, pitch, yaw, deg."""

    def plant(log: Tables) -> None:
        matrix = Rotation.from_euler("ZYX", angles[::-1], degrees=True).as_matrix()
        for columns in (FORCE, RATE):
            log["imu"][columns] = log["imu"][columns].to_numpy() @ matrix

    return plant


def force_late(log: Tables) -> None:
    t = log["imu"]["t"]
    for column in FORCE:
        log["imu"][column] = np.interp(t - 0.2, t, log["imu"][column])


def shifted(table: str, column: str, metres: float, seconds: float) -> Callable[[Tables], None]:
    """Shift a column for some time from the middle of the log on."""
    return changed(table, lambda rows, _: rows.assign(**{
        column: rows[column] + metres * (rows.t - rows.t.median()).between(0.0, seconds, inclusive="left")
    }))  # fmt: skip


def without_gravity(log: Tables) -> None:
    truth, t = log["reference"], log["imu"]["t"]
    turns = Rotation.from_euler(
        "ZYX", np.stack([np.interp(t, truth["t"], np.unwrap(truth[c])) for c in ANGLES[::-1]], -1)
    )
    log["imu"][FORCE] += turns.apply([0.0, 0.0, 9.80665], inverse=True)


_LATE = ("imu clock drift", "imu clock")
FAULTS = {
    "gnss clock +18 s": Fault(late("gnss", 18.0), "gnss clock"),
    "gnss clock +1 s": Fault(late("gnss", 1.0), "gnss clock"),
    "gnss clock +0.2 s": Fault(late("gnss", 0.2), "gnss clock"),
    "imu clock +18 s": Fault(late("imu", 18.0), "imu clock"),
    "imu clock +0.1 s": Fault(late("imu", 0.1), "imu clock"),
    "imu clock +0.03 s": Fault(late("imu", 0.03), "imu clock"),
    "imu clock 1000 ppm fast": Fault(
        changed("imu", lambda rows, _: rows.assign(t=rows.t[0] + (rows.t - rows.t[0]) * 1.001)),
        "imu clock drift",
        ("imu clock",),
    ),
    "imu clock slip 0.09 s": Fault(jump(0.09), "imu clock drift", ("imu clock", "imu gap")),
    "imu clock jump 1 s": Fault(jump(1.0), "imu gap", _LATE),
    "imu gap 0.5 s": Fault(gap("imu", 0.5), "imu gap"),
    "imu one step back": Fault(step_back, "time order"),
    "imu duplicate rows": Fault(repeated("imu", 3), "repeated times"),
    "gnss duplicate row": Fault(repeated("gnss", 1), "repeated times"),
    "imu jitter": Fault(jitter, "imu jitter"),
    "body x/y exchanged": Fault(body("y", "x", "z"), "axes"),
    "body turned 90 deg": Fault(body("y", "-x", "z"), "axes"),
    "forward-left-up": Fault(body("x", "-y", "-z"), "axes"),
    "gyro alone left-up": Fault(scaled("imu", ["wy", "wz"], -1.0), "axes"),
    "gyro z sign": Fault(scaled("imu", ["wz"], -1.0), "axes"),
    "force x sign": Fault(scaled("imu", ["fx"], -1.0), "axes"),
    "reference ENU": Fault(enu("reference", POSITION, VELOCITY), "axes"),
    "reference and fixes ENU": Fault(
        both(enu("reference", POSITION, VELOCITY), enu("gnss", POSITION)), "axes", ("fix axes",)
    ),
    "yaw from East": Fault(
        both(scaled("reference", ["yaw"], -1.0), added("reference", "yaw", np.pi / 2)), "axes"
    ),
    "yaw + 90 deg": Fault(added("reference", "yaw", np.pi / 2), "axes"),
    "roll and pitch exchanged": Fault(
        mixed("reference", ["roll", "pitch"], ["pitch", "roll"]), "axes"
    ),
    "fixes North/East exchanged": Fault(mixed("gnss", ["pn", "pe"], ["pe", "pn"]), "fix axes"),
    "fixes Down negated": Fault(scaled("gnss", ["pd"], -1.0), "fix axes", ("fix shift",)),
    "force sample 1.9e16": Fault(added("imu", "fx", 1.9e16, 0.6), "absurd samples"),
    "force sample +150": Fault(added("imu", "fx", 150.0, 0.6), "spikes"),
    "force sample +30": Fault(added("imu", "fx", 30.0, 0.6), "spikes"),
    "gyro sample +10 rad/s": Fault(added("imu", "wy", 10.0, 0.6), "spikes"),
    "imu stuck 0.3 s": Fault(stuck, "stuck samples"),
    "one fix off 18.6 km": Fault(added("gnss", "pn", 18600.0, 0.6), "fix outliers"),
    "one fix off 20 m": Fault(added("gnss", "pe", 20.0, 0.6), "fix outliers"),
    "fixes frozen 3 s": Fault(frozen, "frozen fixes"),
    "heights above the geoid": Fault(added("gnss", "pd", 30.0), "fix shift"),
    "force in g": Fault(scaled("imu", FORCE, 1 / 9.80665), "unit of force"),
    "gyro in deg/s": Fault(scaled("imu", RATE, 180 / np.pi), "unit of rate"),
    "attitude in degrees": Fault(scaled("reference", ANGLES, 180 / np.pi), "unit of attitude"),
    "yaw alone in degrees": Fault(scaled("reference", ["yaw"], 180 / np.pi), "unit of attitude"),
    "accelerometer bias 1.2 m/s^2": Fault(added("imu", "fx", 1.2), "accelerometer bias"),
    "gyro bias 4 deg/s": Fault(added("imu", "wz", np.radians(4.0)), "gyro bias"),
    "gyro scale 8 %": Fault(scaled("imu", RATE, 1.08), "gyro scale"),
    "force scale 12 %": Fault(scaled("imu", FORCE, 1.12), "force scale"),
    "lever arm 1.6 m": Fault(lever(LEVER), "lever arm"),
    "lever arm 3.4 m": Fault(lever((3.0, 0.8, -1.5)), "lever arm"),
    "reference velocity sign": Fault(scaled("reference", VELOCITY, -1.0), "reference velocity"),
    "reference velocity km/h": Fault(scaled("reference", VELOCITY, 3.6), "reference velocity"),
    "NMEA fix codes": Fault(nmea_codes, "fix codes"),
    "gnss hole 30 s": Fault(gap("gnss", 30.0), "fix hole"),
    "imu at 5 Hz": Fault(slow, "imu rate", (*_LATE, "gyro scale")),
    "gravity removed": Fault(without_gravity, "unit of force"),
    "axes of ROS": Fault(
        both(
            body("x", "-y", "-z"),
            enu("reference", POSITION, VELOCITY),
            enu("gnss", POSITION),
            scaled("reference", ["pitch", "yaw"], -1.0),
            added("reference", "yaw", np.pi / 2),
        ),
        "axes",
        ("fix axes",),
    ),
    "fixes turned 12 deg": Fault(turned("gnss", 12.0, POSITION), "fix turn"),
    "fixes drift 20 m": Fault(
        law("gnss", "pe", lambda s: 20.0 * s), "slow errors", ("fix shift", "gnss clock")
    ),
    "fixes off 15 m for 10 s": Fault(shifted("gnss", "pn", 15.0, 10.0), "slow errors"),
    "reference jumps 8 m": Fault(
        shifted("reference", "pn", 8.0, np.inf), "slow errors", ("fix shift",)
    ),
    "gyro bias drifts 3 deg/s": Fault(
        law("imu", "wz", lambda s: np.radians(3.0) * (s - 0.5)), "gyro bias drift"
    ),
    "force late 0.2 s": Fault(force_late, "force clock"),
    "fy of zero": Fault(
        scaled("imu", ["fy"], 0.0),
        "dead axis",
        ("accelerometer bias", "accelerometer bias drift", "axes"),
    ),
    "fixes in feet": Fault(scaled("gnss", POSITION, 1 / 0.3048), "fix scale"),
    "reference turned 12 deg": Fault(
        both(
            turned("reference", 12.0, POSITION, VELOCITY),
            added("reference", "yaw", np.radians(12.0)),
        ),
        "fix turn",
    ),
    "sensor backwards": Fault(body("-x", "-y", "z"), "axes"),
    "sensor tilted 10 deg": Fault(mounted(0.0, 10.0, 0.0), "mounting"),
    "sensor turned 20 deg": Fault(mounted(0.0, 0.0, 20.0), "mounting"),
    "attitude in 0.1 deg": Fault(scaled("reference", ANGLES, 1800 / np.pi), "unit of attitude"),
    "fx jumps 2 m/s^2": Fault(
        law("imu", "fx", lambda s: 2.0 * (s > 0.4)), "accelerometer bias drift"
    ),
    "wz cut off": Fault(
        changed("imu", lambda rows, _: rows.assign(wz=rows.wz.clip(upper=0.6 * rows.wz.max()))),
        "saturated axis",
        ("gyro scale", "axes", "imu clock", "imu clock drift"),
    ),
}

# logs by the name of a fault test: folder, tables, flight, sensor
SHARED = {
    "car": ("car_rtk_mems", ("imu", "gnss_rtk", "reference"), None, None),
    "walk": ("walk_tc_mems", ("imu", "gnss_rtk", "reference"), None, None),
    "wing": ("fixedwing_uav", ("imu_air", "gps", "onboard_filter"), None, None),
    "quad 2": ("quad_rtk_mimu", ("imu", "reference", "reference"), 2, 1),
    "quad 13": ("quad_rtk_mimu", ("imu", "reference", "reference"), 13, 1),
    "quad 17": ("quad_rtk_mimu", ("imu", "reference", "reference"), 17, 1),
}
SEVERAL_SENSORS = (2, 4, 11, 13, 17)  # flights with four sensors
CLEAN = {
    **{name: SHARED[name] for name in ("car", "walk", "wing")},
    **{
        f"quad {path} imu {imu}": ("quad_rtk_mimu", ("imu", "reference", "reference"), path, imu)
        for path in range(1, 21)
        for imu in ((1, 2, 3, 4) if path in SEVERAL_SENSORS else (1,))
    },
}
# true on all flights (biases of 1.5 to 1.9 deg/s), and not confirmed (a reference that is an on-board filter)
LISTED = {
    "wing": {"gyro scale", "gnss clock"},
    **{f"quad {path} imu {imu}": {"gyro bias"} for path in SEVERAL_SENSORS for imu in (2, 3)},
}


def shared_tables(name: str) -> Tables:
    """Tables of a shared log with the columns of an own log, and no codes of fixes."""
    folder, files, path, imu = CLEAN.get(name) or SHARED[name]
    log = {}
    for key, file in zip(("imu", "gnss", "reference"), files, strict=True):
        table = pd.read_parquet(Path(str(DATA)) / folder / f"{file}.parquet")
        if path is not None:
            table = table[(table["path"] == path) & (table.get("imu", imu) == imu)]
        table = table.rename(columns=dict(zip(["vn_d", "ve_d", "vd_d"], VELOCITY, strict=True)))
        columns = {"imu": FORCE + RATE, "gnss": POSITION, "reference": POSITION + VELOCITY + ANGLES}
        log[key] = table[["t", *columns[key]]].astype(float).reset_index(drop=True)
    return log


def planted(log: Tables, *names: str) -> Tables:
    """A copy of the tables with faults."""
    copy = {key: table.copy() for key, table in log.items()}
    for name in names:
        FAULTS[name].plant(copy)
    return copy


def findings_of(log: Tables, settings: dict[str, object] | None = None) -> list[Finding]:
    """Findings of tables, read with the settings of a remedy."""
    source = LogSource(Path()).with_settings(settings or {})
    tables = tuple(LogTable(table, name, False, {}) for name, table in log.items())
    corrected, _ = source.mending.correct_tables(*tables)
    return run_checks(source.take(corrected))[0]


def checks_of(log: Tables, settings: dict[str, object] | None = None) -> set[str]:
    """Names of the checks that speak."""
    return {finding.check for finding in findings_of(log, settings)}
