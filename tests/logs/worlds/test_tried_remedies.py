"""A fault is planted, the reader says what to do, the test does it, and the log reads."""

import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from synthetic_log import tables, write

from pfbench.logs.sky.plausible_limits import PlausibleLimits
from pfbench.logs.worlds.corrections import LogCorrections
from pfbench.logs.worlds.log_reader import read_log

Log = dict[str, pd.DataFrame]


def message(folder: Path, log: Log) -> str:
    """What the reader says of a spoilt log."""
    with pytest.raises(ValueError) as error:  # noqa: PT011
        read_log(write(folder, log))
    return str(error.value)


def rows_of(text: str) -> list[int]:
    """Rows of a table (from 0) whose lines a text names."""
    return [int(line) - 2 for line in re.findall(r"line (\d+)", text)]


COUNTERS = {
    "week": (604800.0, 1.0),
    "day": (86400.0, 1.0),
    "hour": (3600.0, 1.0),
    "1024 weeks": (619315200.0, 1.0),
    "week in ms": (604800.0, 1e3),
    "32 bits of us": (2**32 * 1e-6, 1.0),
    "32 bits of ms": (2**32 * 1e-3, 1e3),
}


@pytest.mark.parametrize("name", ["imu", "gnss", "reference"])
@pytest.mark.parametrize("counter", COUNTERS)
def test_a_counter_that_starts_again_is_carried_on(tmp_path: Path, name: str, counter: str) -> None:
    period, unit = COUNTERS[counter]
    log = tables()
    shift = period - 10.004
    for other in log:
        log[other]["t"] = (log[other]["t"] + shift) * (unit if other == name else 1.0)
    log[name]["t"] = (log[name]["t"] % (period * unit)).round(6)
    said = message(tmp_path, log)
    assert f"{name}.csv: column t must increase" in said
    assert "The counter starts again there" in said
    added = float(re.search(r"add ([\d.e+]+) to t", said)[1])  # type: ignore[index]
    assert added == pytest.approx(period * unit)
    log[name].loc[rows_of(said)[-1] :, "t"] += added
    log[name]["t"] /= unit  # which the reader says next, for a table in ms
    read_log(write(tmp_path, log))


def swap_rows(log: Log) -> None:
    order = np.arange(len(log["gnss"]))
    order[[40, 41]] = order[[41, 40]]
    log["gnss"] = log["gnss"].iloc[order]


def swap_parts(log: Log) -> None:
    log["gnss"] = pd.concat([log["gnss"].iloc[50:], log["gnss"].iloc[:50]])


def append_copy(log: Log) -> None:
    log["gnss"] = pd.concat([log["gnss"], log["gnss"].iloc[60:70]])


@pytest.mark.parametrize("spoil", [swap_rows, swap_parts, append_copy])
def test_rows_in_another_order_are_sorted(tmp_path: Path, spoil: Callable[[Log], None]) -> None:
    log = tables()
    spoil(log)
    said = message(tmp_path, log)
    assert "Sort the rows by t" in said
    log["gnss"] = log["gnss"].sort_values("t")
    assert ("keep one row" in said) == log["gnss"]["t"].duplicated().any()
    read_log(write(tmp_path, {**log, "gnss": log["gnss"].drop_duplicates("t")}))


@pytest.mark.parametrize("value", [0.1, 13.0, -1e6])
def test_a_single_wrong_time_is_removed(tmp_path: Path, value: float) -> None:
    log = tables()
    log["imu"].loc[500, "t"] = value
    said = message(tmp_path, log)
    assert "Correct or remove line 502." in said
    log["imu"] = log["imu"].drop(index=rows_of(said)[-1])
    read_log(write(tmp_path, log))


def test_two_recordings_in_one_table_are_parted(tmp_path: Path) -> None:
    log = tables()
    second = log["imu"].iloc[:700].assign(t=lambda table: table["t"] + 0.003)
    log["imu"] = pd.concat([log["imu"], second], ignore_index=True)
    said = message(tmp_path, log)
    first, last = rows_of(said)[-2:]
    assert (first, last) == (0, 2000)
    read_log(write(tmp_path, {**log, "imu": log["imu"].iloc[first : last + 1]}))


def test_repeated_times_are_removed_unless_they_are_rounded(tmp_path: Path) -> None:
    log = tables()
    log["gnss"] = log["gnss"].loc[[0, 1, 1, *range(2, 101)]]
    assert message(tmp_path, log).endswith("Keep one row for each time.")
    read_log(write(tmp_path, {**log, "gnss": log["gnss"].drop_duplicates("t")}))
    rounded = tables()
    rounded["imu"]["t"] = rounded["imu"]["t"].round(1)
    assert "Write t with more digits" in message(tmp_path, rounded)


@pytest.mark.parametrize(
    "shift", [604800.0, -3 * 604800.0, 86400.0, -86400.0 * 4, 315964782.0, -315964782.0]
)
def test_tables_of_shifted_clocks_are_brought_together(tmp_path: Path, shift: float) -> None:
    log = tables()
    log["gnss"]["t"] += shift
    said = message(tmp_path, log)
    assert "must overlap in time" in said
    log["gnss"]["t"] += float(re.search(r"Add (\S+) to t of gnss", said)[1])  # type: ignore[index]
    assert read_log(write(tmp_path, log)).fixes.time[0] == pytest.approx(0.0, abs=1e-6)


def test_the_longest_part_between_gaps_is_kept(tmp_path: Path) -> None:
    log = tables()
    log["imu"] = log["imu"].drop(index=[*range(300, 340), *range(1500, 1540)])
    assert "set scenario.corrections.gaps=longest" in message(tmp_path, log)
    read = read_log(write(tmp_path, log), corrections=LogCorrections(gaps="longest"))
    assert (read.imu.time[0], read.imu.time[-1]) == (3.4, 14.99)


FORCE = ["fx", "fy", "fz"]


def said_or_none(folder: Path, log: Log) -> str | None:
    try:
        read_log(write(folder, log))
    except ValueError as error:
        return str(error)
    return None


def test_no_remedy_is_named_that_does_not_help(tmp_path: Path) -> None:
    """A force of 1 m/s^2 in all directions is in no unit; a median of 1 alone would say g."""
    log = tables()
    log["imu"][FORCE] = np.random.default_rng(1).normal(size=(len(log["imu"]), 3)) * 0.65
    said = message(tmp_path, log)
    assert "no other unit, sign or axes of fx, fy, fz agree with the reference" in said
    spike = tables()
    spike["imu"].loc[100, "wx"] = 100.0
    said = message(tmp_path, spike)
    assert "multiply" not in said
    assert said.endswith("Correct or remove this row.")


SPIKES = [
    ("imu", "fx", 500.0),
    ("imu", "fy", 350.0),
    ("imu", "wz", 40.0),
    ("reference", "vn", 120.0),
    ("gnss", "pn", 3e7),
]


@pytest.mark.parametrize(("name", "column", "value"), SPIKES)
def test_a_wrong_row_is_removed(tmp_path: Path, name: str, column: str, value: float) -> None:
    log = tables()
    log[name].loc[60, column] = value
    said = message(tmp_path, log)
    assert "Correct or remove this row" in said
    assert said_or_none(tmp_path, {**log, name: log[name].drop(index=rows_of(said)[0])}) is None


LIMITS = [
    ("gnss", "vn", 1300.0),
    ("gnss", "pe", 4000.0),
    ("reference", "vn", 35.0),
]


@pytest.mark.parametrize(("name", "column", "value"), LIMITS)
def test_a_named_limit_accepts_the_row(
    tmp_path: Path, name: str, column: str, value: float
) -> None:
    log = tables()
    log[name].loc[60, column] = value
    said = message(tmp_path, log)
    key, limit = re.search(r"set scenario\.limits\.(\w+)=([\d.e+]+\d)", said).groups()  # type: ignore[union-attr]
    if key == "drop_fixes":
        key, limit = re.search(r"set scenario\.limits\.(fix_error_m)=([\d.e+]+\d)", said).groups()  # type: ignore[union-attr]
    again = read_log(write(tmp_path, log), limits=PlausibleLimits(**{key: float(limit)}))
    assert len(again.imu.time) == len(log["imu"])


def test_a_lasting_jump_is_cut(tmp_path: Path) -> None:
    log = tables()
    log["imu"].loc[1500:, "fx"] += 350.0
    said = message(tmp_path, log)
    (row,) = rows_of(said)[-1:]
    assert "Keep the rows on one side of the jump before" in said
    assert row == 1500
    assert said_or_none(tmp_path, {**log, "imu": log["imu"].iloc[:row]}) is None


def test_wrong_fixes_are_dropped_only_if_others_remain(tmp_path: Path) -> None:
    log = tables()
    log["gnss"].loc[20:25, "pe"] += 5000.0
    assert "set scenario.limits.drop_fixes=true" in message(tmp_path, log)
    dropped = read_log(tmp_path, limits=PlausibleLimits(drop_fixes=True))
    assert np.isnan(dropped.fixes.position[:, 0]).sum() == 6
    log["gnss"]["pe"] += 5000.0
    assert "drop_fixes" not in message(tmp_path, log)
    with pytest.raises(ValueError, match="wrong in most rows"):
        read_log(tmp_path, limits=PlausibleLimits(drop_fixes=True))


def test_rows_without_data_are_removed_and_a_column_without_data_is_left_out(
    tmp_path: Path,
) -> None:
    log = tables()
    log["gnss"].loc[[5, 9], "vn"] = np.nan
    assert "Remove rows without data" in message(tmp_path, log)
    assert said_or_none(tmp_path, {**log, "gnss": log["gnss"].dropna()}) is None
    log["gnss"]["vn"] = np.nan
    assert "can be left out" in message(tmp_path, log)
    assert said_or_none(tmp_path, {**log, "gnss": log["gnss"].drop(columns=["vn"])}) is None
