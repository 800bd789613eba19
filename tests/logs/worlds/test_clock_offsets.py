"""Offsets of clocks: found to hundredths of a second where the motion shows them, and never where there is none."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from recorded_data import DATA, recorded
from synthetic_log import tables, write

from pfbench.logs.worlds.clock_offsets import find_fix_offset, find_imu_offset
from pfbench.logs.worlds.log_reader import read_log
from pfbench.logs.worlds.log_tables import GnssLog, LogFiles, NavigationLog, ReferenceLog

Log = dict[str, pd.DataFrame]
LATE = re.compile(
    r"(\w+)\.csv: t is ([\d.]+) s (late|early) against reference.*?(Add|Subtract) ([\d.]+)"
)


def noisy(seconds: float = 60.0) -> Log:
    """A log with the errors of a MEMS IMU and of a receiver."""
    log, rng = tables(seconds), np.random.default_rng(1)
    log["imu"][["wx", "wy", "wz"]] += rng.normal(size=(len(log["imu"]), 3)) * 5e-3 + 1e-3
    log["imu"][["fx", "fy", "fz"]] += rng.normal(size=(len(log["imu"]), 3)) * 0.1
    log["gnss"][["pn", "pe", "pd"]] += rng.normal([2.0, -1.0, 3.0], 1.0, (len(log["gnss"]), 3))
    return log


def said_of(folder: Path, log: Log) -> str:
    """Notes of a log, or its error."""
    try:
        return "\n".join(read_log(write(folder, log)).notes)
    except ValueError as error:
        return str(error)


@pytest.mark.parametrize("late", [0.3, 1.0, 5.0, -18.0])
def test_late_fixes_are_named_and_the_named_change_removes_it(tmp_path: Path, late: float) -> None:
    log = noisy()
    log["gnss"]["t"] += late
    log["gnss"] = log["gnss"][log["gnss"]["t"] >= 0.0]
    name, size, side, change, amount = LATE.search(said_of(tmp_path, log)).groups()  # type: ignore[union-attr]
    assert (name, side) == ("gnss", "late" if late > 0.0 else "early")
    assert float(size) == pytest.approx(
        abs(late), abs=0.06
    )  # 5 standard errors: 1 m at 10 m/s, 200 fixes
    assert ("leap seconds" in said_of(tmp_path, log)) == (late == -18.0)
    log["gnss"]["t"] += float(amount) if change == "Add" else -float(amount)
    assert not LATE.search(said_of(tmp_path, log))


@pytest.mark.parametrize("late", [0.1, 0.5, -1.0, 5.0])
def test_a_late_imu_is_named_and_the_named_change_removes_it(tmp_path: Path, late: float) -> None:
    log = noisy()
    log["imu"]["t"] += late
    name, size, _, change, amount = LATE.search(said_of(tmp_path, log)).groups()  # type: ignore[union-attr]
    assert name == "imu"
    assert float(size) == pytest.approx(abs(late), abs=0.02)
    log["imu"]["t"] += float(amount) if change == "Add" else -float(amount)
    assert not LATE.search(said_of(tmp_path, log))


def test_no_offset_is_named_without_one(tmp_path: Path) -> None:
    assert not LATE.search(said_of(tmp_path, noisy()))


@pytest.mark.parametrize("late", [0.0, 2.0])
def test_a_straight_drive_at_constant_speed_shows_no_offset(late: float) -> None:
    """A delay of 2 s is 20 m along the track there, which a constant error of the fixes explains as well."""
    time, rng = np.arange(601) / 10, np.random.default_rng(2)
    position = np.outer(time, [10.0, 0.0, 0.0])
    level = np.tile([1.0, 0.0, 0.0, 0.0], (601, 1))
    reference = ReferenceLog(time, level, np.tile([10.0, 0.0, 0.0], (601, 1)), position)
    fixes = GnssLog(
        time[::10] + late, position[::10] + rng.normal(size=(61, 3)), position[::10] * np.nan
    )
    assert find_fix_offset(fixes, reference) is None


def shared_logs() -> list[tuple[str, LogFiles, int | None, list[int] | None]]:
    return [
        ("car_rtk_mems", LogFiles(gnss="gnss_rtk"), None, [1]),
        ("walk_tc_mems", LogFiles(gnss="gnss_rtk"), None, [1]),
        ("fixedwing_uav", LogFiles("imu_air", "gps", "reference_smoothed"), None, None),
        *[("quad_rtk_mimu", LogFiles(gnss="reference"), path, None) for path in (2, 13, 17)],
    ]


@recorded
@pytest.mark.parametrize("log", shared_logs(), ids=lambda log: f"{log[0]}_{log[2]}")
def test_clean_logs_show_none_and_delayed_ones_theirs(
    log: tuple[str, LogFiles, int | None, list[int] | None],
) -> None:
    folder, files, path, codes = log
    read = read_log(Path(str(DATA)) / folder, files, path, 1 if path else None, fix_codes=codes)
    assert not [note for note in read.notes if "t is " in note]
    assert offsets(read, 0.0, 0.0) == (None, None)
    assert offsets(read, 0.1, -18.0) == (
        pytest.approx(0.1, abs=0.03),
        pytest.approx(-18.0, abs=0.1),
    )
    assert offsets(read, -5.0, 1.0) == (pytest.approx(-5.0, abs=0.03), pytest.approx(1.0, abs=0.1))


def offsets(read: NavigationLog, imu: float, fixes: float) -> tuple[float | None, float | None]:
    """Offsets that are found after clocks were put off by `imu` and `fixes` seconds."""
    found = (
        find_imu_offset(read.imu._replace(time=read.imu.time + imu), read.reference),
        find_fix_offset(read.fixes._replace(time=read.fixes.time + fixes), read.reference),
    )
    return tuple(offset and offset.late_s for offset in found)  # type: ignore[return-value]


@pytest.mark.parametrize("arm", [0.0, 3.0])
def test_a_lever_arm_is_told_from_a_late_clock(arm: float) -> None:
    """An antenna ahead of the reference point is 0.3 s early at 10 m/s; turns and changes of speed tell them apart."""
    time, rng = np.arange(1801) / 10, np.random.default_rng(2)
    yaw, speed = 1.2 * np.sin(0.25 * time) + 0.6 * np.sin(0.11 * time), 10 + 5 * np.sin(0.4 * time)
    ahead = np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], -1)
    velocity = speed[:, None] * ahead
    position = np.r_[np.zeros((1, 3)), np.cumsum(0.05 * (velocity[1:] + velocity[:-1]), 0)]
    turned = np.stack([np.cos(yaw / 2), 0 * yaw, 0 * yaw, np.sin(yaw / 2)], -1)
    seen = position + arm * ahead + 0.3 * rng.normal(size=position.shape)
    fixes = GnssLog(time[::5] + 1.0, seen[::5], position[::5] * np.nan)
    found = find_fix_offset(fixes, ReferenceLog(time, turned, velocity, position))
    assert found is not None
    assert found.late_s == pytest.approx(1.0, abs=0.03)  # 361 fixes of 0.3 m at 10 m/s: 0.002 s
