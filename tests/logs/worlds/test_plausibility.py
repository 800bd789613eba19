"""Limits of logs: impossible values are errors, outliers stay data, and damaged files never give wrong numbers silently."""

import math
import re
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT
from mutations import CLOSE, ERROR, EVERY_ROW, NOTED, READERS, run_mutations
from refusals import check_refused
from synthetic_log import tables, write

from pfbench.logs.sky.plausible_limits import LIMIT_COLUMNS, QUANTITIES, PlausibleLimits
from pfbench.logs.worlds import log_agreement
from pfbench.logs.worlds.log_reader import read_log
from pfbench.logs.worlds.log_tables import LogTable, parse_satellites
from pfbench.logs.worlds.trajectory_file import read_motion

PAGE = ROOT / "docs" / "use_your_data.md"


def limits_table() -> str:
    rows = [
        "| quantity | columns | range | largest change | source |",
        "| --- | --- | --- | --- | --- |",
    ]
    for name, q in QUANTITIES.items():
        columns = ", ".join(f"`{c}`" for c, quantity in LIMIT_COLUMNS.items() if quantity == name)
        change = f"{q.allowance:g} + {q.rate:g}/s" if math.isfinite(q.rate) else "-"
        rows.append(
            f"| {name} [{q.unit}] | {columns} | {q.least:g} to {q.largest:g} | {change} | {q.source} |"
        )
    return "\n".join(rows)


def agreements_table() -> str:
    rows = ["| difference between | note above | error above |", "| --- | --- | --- |"]
    for a in (
        log_agreement.MOTION,
        log_agreement.FIX_VELOCITY,
        log_agreement.WHEELS,
        log_agreement.YAW_RATE,
    ):
        largest = f"{a.largest:g} {a.unit}" if math.isfinite(a.largest) else "see below"
        rows.append(f"| {a.quantity} | {a.noted:g} {a.unit} | {largest} |")
    return "\n".join(rows)


@pytest.mark.parametrize(
    ("mark", "table"), [("limits", limits_table()), ("agreements", agreements_table())]
)
def test_the_page_shows_the_limits_of_the_code(mark: str, table: str) -> None:
    shown = re.search(
        rf"<!-- {mark}:begin -->\n(.*?)\n?<!-- {mark}:end -->", PAGE.read_text(), re.DOTALL
    )
    assert shown is not None
    assert shown[1].strip() == table, table


IMPOSSIBLE = [
    (
        "imu",
        "fx",
        1.9e16,
        r"column fx must be between -400 and 400 m/s\^2, got 1\.9e\+16 in line 102",
    ),
    ("imu", "fy", 350.0, r"column fy must change by at most 300 m/s\^2 in 0\.01 s"),
    ("imu", "wz", 1e308, r"column wz must be between -35 and 35 rad/s"),
    ("gnss", "pn", 1e308, r"column pn must be between"),
    ("gnss", "pe", 18600.0, r"fixes must be at most 1000 m from the reference .* in line 102"),
    (
        "gnss",
        "vn",
        1001.0,
        r"column vn must be between -1000 and 1000 m/s.*scenario\.limits\.speed_m_s",
    ),
    ("reference", "pn", 5000.0, r"position change and integrated velocity .* must agree to 200 m"),
    ("reference", "vn", 100.0, r"column vn must change by at most"),
    (
        "reference",
        "roll",
        3.0,
        r"the attitude jumps by 3 rad there and back in line 102",
    ),
]


@pytest.mark.parametrize(("table", "column", "value", "message"), IMPOSSIBLE)
def test_an_impossible_value_is_an_error(
    tmp_path: Path, table: str, column: str, value: float, message: str
) -> None:
    log = tables()
    log[table].loc[100, column] = value
    check_refused([(message, lambda: read_log(write(tmp_path, log)))], remedy=False)


def test_a_fix_100_m_off_stays_data_and_is_named(tmp_path: Path) -> None:
    log = tables()
    log["gnss"].loc[40, "pe"] += 100.0
    read = read_log(write(tmp_path, log))
    assert np.isclose(read.fixes.position[40, 0], log["gnss"]["pe"][40])
    assert any("there and back, the largest by 100 m in line 42" in note for note in read.notes)


@pytest.mark.parametrize("factor", [0.0, 0.001, math.pi / 180, 0.3048, 3.6, -1.0])
def test_a_heading_in_another_unit_is_told_from_rates_in_another_unit(
    tmp_path: Path, factor: float
) -> None:
    """Turns alone show a ratio; the force shows which of both is wrong."""
    log = tables()
    log["imu"]["wz"] += 0.05  # a bias
    read_log(write(tmp_path / "biased", log))
    log["reference"]["yaw"] *= factor
    said = {0.0: "do not turn, and wx, wy, wz do", -1.0: "yaw is counted anticlockwise"}
    with pytest.raises(
        ValueError, match=said.get(factor, rf"yaw turns {factor:.3g} times")
    ) as error:
        read_log(write(tmp_path / "scaled", log))
    if factor not in said:
        log["reference"]["yaw"] *= float(re.search(r"Multiply by ([\d.]+),", str(error.value))[1])  # type: ignore[index]
        read_log(write(tmp_path / "mended", log))


@pytest.mark.parametrize(("offset", "is_noted"), [(4.0, False), (-4.0, False), (6.0, True)])
def test_an_offset_of_all_fixes_is_named(tmp_path: Path, offset: float, is_noted: bool) -> None:
    log = tables()
    log["reference"]["pd"] += offset
    notes = "".join(read_log(write(tmp_path, log)).notes)
    assert ("the fixes are shifted by -6.0 m Down" in notes) is is_noted


def test_a_key_drops_single_fixes_and_names_them(tmp_path: Path) -> None:
    log = tables()
    log["gnss"].loc[40, "pe"] += 18600.0
    read = read_log(write(tmp_path, log), limits=PlausibleLimits(drop_fixes=True))
    assert np.flatnonzero(np.isnan(read.fixes.position[:, 0])).tolist() == [40]
    assert "1 fixes dropped, the first off by 18600 m in line 42" in read.notes[1]


def test_a_key_widens_a_limit_and_cannot_switch_it_off(tmp_path: Path) -> None:
    log = tables()
    log["gnss"].loc[40, "pe"] += 1500.0
    read = read_log(write(tmp_path, log), limits=PlausibleLimits(fix_error_m=2000.0))
    assert np.isfinite(read.fixes.position).all()
    check_refused(
        [
            (
                r"scenario\.limits\.speed_m_s must be positive and finite",
                lambda: PlausibleLimits(speed_m_s=math.inf),
            )
        ],
        remedy=False,
    )


@pytest.mark.parametrize(("factor", "is_refused"), [(-1.0, True), (0.9, False)])
def test_a_single_velocity_of_a_trajectory_agrees_with_its_neighbours(
    tmp_path: Path, factor: float, is_refused: bool
) -> None:
    reference = tables()["reference"]
    reference.loc[48, "ve"] *= factor
    write(tmp_path, {"reference": reference})
    with (
        pytest.raises(ValueError, match=r"the velocity jumps by .* there and back in line 50")
        if is_refused
        else nullcontext()
    ):
        read_motion(tmp_path, "reference", [40.0, -105.0, 1500.0])


SPOILT_TEXT = {
    "field too many": (lambda s: s.replace("\n0.03,", "\n0.03,7,", 1), r"imu\.csv: line 5 must have 7 fields .*got 8"),
    "blank line": (lambda s: s.replace("\n0.03,", "\n\n0.03,", 1), r"imu\.csv: line 5 .*got 0"),
    "column twice": (lambda s: s.replace("fy", "fx", 1), r"imu\.csv: line 1 .*got fx twice"),
    "zero byte": (lambda s: s.replace("0.03", "0\x0003", 1), r"imu\.csv: line 5 .*control characters"),
    "empty": (lambda s: "", r"imu\.csv must have a line of column names"),
}  # fmt: skip


@pytest.mark.parametrize("name", SPOILT_TEXT)
def test_a_spoilt_text_is_an_error_with_its_line(tmp_path: Path, name: str) -> None:
    spoil, message = SPOILT_TEXT[name]
    file = write(tmp_path, tables()) / "imu.csv"
    file.write_text(spoil(file.read_text()))
    check_refused([(message, lambda: read_log(tmp_path))], remedy=False)


@pytest.mark.parametrize(("system", "number"), [("G", 120.0), ("E", 0.0), ("R", 2.5), ("X", 3.0)])
def test_a_satellite_that_no_system_has_is_an_error(system: str, number: float) -> None:
    table = LogTable(pd.DataFrame({"sys": ["S", system]}), "sky.csv", True, {})
    check_refused(
        [
            (
                r"sky\.csv: column (sys|svid) must be .* in line 3",
                lambda: parse_satellites(table, np.array([120.0, number])),
            )
        ],
        remedy=False,
    )
    table = LogTable(pd.DataFrame({"sys": ["S", "C"]}), "sky.csv", True, {})
    assert parse_satellites(table, np.array([120.0, 7.0])) == ["S120", "C07"]


def test_a_line_without_end_is_dropped_and_named(tmp_path: Path) -> None:
    file = write(tmp_path, tables()) / "imu.csv"
    file.write_text(file.read_text()[:-3])
    read = read_log(tmp_path)
    assert len(read.imu.time) == len(tables()["imu"]) - 1
    assert "imu.csv: line 2002 has no line end" in read.notes[0]


@pytest.mark.parametrize(
    "damage", [lambda b: b[: len(b) // 2], lambda b: b"", lambda b: b[:200] + bytes(400) + b[600:]]
)
def test_a_damaged_parquet_file_is_named(tmp_path: Path, damage: object) -> None:
    file = write(tmp_path, tables(), ".parquet") / "imu.parquet"
    file.write_bytes(damage(file.read_bytes()))  # type: ignore[operator]
    check_refused([(r"imu\.parquet", lambda: read_log(tmp_path))], remedy=False)


def check_outcomes(reader: str, count: int, seed: int) -> None:
    outcomes = run_mutations(reader, count, seed)
    assert sum(outcomes.values()) == count
    bad = {o: n for o, n in outcomes.items() if o not in (ERROR, CLOSE, NOTED)}
    every_row = {o: n for o, n in bad.items() if o.startswith(EVERY_ROW)}
    assert {o: n for o, n in bad.items() if o not in every_row} == {}
    assert sum(every_row.values()) < 0.03 * count
    assert outcomes[ERROR] + outcomes[NOTED] > 0.2 * count  # a satellite is dropped with a note


@pytest.mark.parametrize("reader", READERS)
def test_random_damage_never_gives_wrong_numbers_silently(reader: str) -> None:
    check_outcomes(reader, count=40, seed=0)


@pytest.mark.slow
@pytest.mark.parametrize("reader", READERS)
def test_more_random_damage_never_gives_wrong_numbers_silently(reader: str) -> None:
    """`make faults` counts the outcomes of 10 000 more of each reader."""
    check_outcomes(reader, count=50, seed=1)


def test_the_table_of_columns_names_quantities() -> None:
    assert set(LIMIT_COLUMNS.values()) == set(QUANTITIES)
