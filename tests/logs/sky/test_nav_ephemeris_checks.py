"""Ephemerides: blank and impossible parameters, and records that their neighbours contradict."""

import math
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from ephemeris_cases import EPHEMERIDES, as_rinex, later_by_two_hours

from pfbench.logs.sky.broadcast_orbits import BroadcastConstellation
from pfbench.logs.sky.ephemeris import read_rinex
from pfbench.logs.sky.ephemeris_checks import POSITION_TOLERANCE, RANGES

NOON = "2016-06-06T12:00:00"
TIMES = torch.tensor([0.0, 3000.0, 9000.0], dtype=torch.float64)


def three() -> pd.DataFrame:
    """Three ephemerides of each of two satellites, two hours apart."""
    second = later_by_two_hours(EPHEMERIDES)
    return pd.concat([EPHEMERIDES, second, later_by_two_hours(second)], ignore_index=True)


def constellation(folder: Path, table: pd.DataFrame) -> BroadcastConstellation:
    table.to_parquet(folder / "eph.parquet")
    return BroadcastConstellation(str(folder), "eph.parquet", NOON)


def test_consistent_ephemerides_give_no_notes(tmp_path: Path) -> None:
    assert constellation(tmp_path, three()).notes == ()


@pytest.mark.parametrize(
    ("column", "change"),
    [("M0", 3e-6), ("Omega0", 4e-6), ("i0", 4e-6), ("sqrtA", 0.01), ("af0", 1.5e-7), ("tgd", 2e-8)],
)
def test_a_record_that_its_neighbours_contradict_is_ignored_and_named(
    tmp_path: Path, column: str, change: float
) -> None:
    table = three()
    table.loc[2, column] += change
    satellites = constellation(tmp_path, table)
    assert [note for note in satellites.notes if "its neighbours contradict it" in note] == list(
        satellites.notes
    )
    assert "an ephemeris of G07 at t = 7200 s" in satellites.notes[0]
    clean = constellation(tmp_path, three()).at(TIMES)[0]
    assert (satellites.at(TIMES)[0] - clean).norm(dim=-1).max() < POSITION_TOLERANCE


def test_a_satellite_whose_two_records_contradict_each_other_is_dropped(tmp_path: Path) -> None:
    table = three().iloc[:4].copy()
    table.loc[2, "M0"] += 1e-4
    satellites = constellation(tmp_path, table)
    assert satellites.names == ("E14",)
    assert [note[:40] for note in satellites.notes] == [
        "eph.parquet: an ephemeris of G07 at t = "
    ] * 2
    assert "its neighbours contradict it: positions 2" in satellites.notes[0]
    with pytest.raises(ValueError, match=r"must contain ephemerides that agree, got none of 2"):
        _ = constellation(tmp_path, table[table["sys"] == "G"]).names


def test_a_manoeuvre_between_confirmed_orbits_is_a_note(tmp_path: Path) -> None:
    table = pd.concat([three(), later_by_two_hours(three().iloc[4:])], ignore_index=True)
    table.loc[(table["sys"] == "G") & (table["toe"] > 140000.0), "M0"] += 1e-5
    notes = constellation(tmp_path, table).notes
    assert len(notes) == 1
    assert "G07 at t = 14400 s changes the orbit or clock" in notes[0]


def test_a_single_ephemeris_is_named_as_not_compared(tmp_path: Path) -> None:
    (note,) = constellation(tmp_path, EPHEMERIDES).notes
    assert note.endswith("without a neighbour to compare with: E14, G07")


@pytest.mark.parametrize("column", RANGES)
def test_a_parameter_out_of_range_is_ignored_and_named(tmp_path: Path, column: str) -> None:
    table = three().assign(health=0.0)
    low, high, _ = RANGES[column]
    if column == "toe":
        return  # reduced to the week when read
    table[column] = table[column].astype(float)
    table.loc[2, column] = high + 0.1 * (high - low)
    satellites = constellation(tmp_path, table)
    if column == "health":
        assert "marked unhealthy: G07" in satellites.notes[0]
    else:
        assert any("is ignored because its" in note for note in satellites.notes), satellites.notes


def test_another_unit_of_all_records_is_an_error(tmp_path: Path) -> None:
    degrees = three().assign(i0=lambda table: np.degrees(table["i0"]))
    with pytest.raises(ValueError, match=r"100% out of range.*i0 is 49.*Check the units"):
        _ = constellation(tmp_path, degrees).names


@pytest.mark.parametrize("factor", [math.pi / 180, 0.3048, 3.6, -1.0])
def test_clock_offsets_in_another_unit_do_not_follow_their_drifts(
    tmp_path: Path, factor: float
) -> None:
    scaled = three().assign(af0=lambda table: factor * table["af0"])
    (note,) = constellation(tmp_path, scaled).notes
    assert f"clock offsets change {factor:.3g} times as fast as their drifts state" in note


def test_noise_of_clocks_is_no_other_unit(tmp_path: Path) -> None:
    """Offsets off by 2 ns each, about what a day of GPS clocks leaves, and drifts as small as that."""
    first = EPHEMERIDES.assign(af1=0.1 * EPHEMERIDES["af1"])
    second = later_by_two_hours(first)
    table = pd.concat([first, second, later_by_two_hours(second)], ignore_index=True)
    for seed in range(5):
        noise = np.random.default_rng(seed).normal(0.0, 2e-9, len(table))
        assert constellation(tmp_path, table.assign(af0=table["af0"] + noise)).notes == ()


@pytest.mark.parametrize(
    ("row", "column", "value", "words"),
    [
        *((row, "e", e, "for its semi-major axis") for row, e in ((0, 0.05), (1, 0.05), (1, 1e-4))),
        (2, "sqrtA", 1e200, "its semi-major axis is inf m"),
    ],
)
def test_an_orbit_that_no_satellite_of_its_system_has_is_named(
    tmp_path: Path, row: int, column: str, value: float, words: str
) -> None:
    table = three()
    table.loc[row, column] = value
    notes = constellation(tmp_path, table).notes
    assert any(words in note for note in notes), notes


@pytest.mark.parametrize(("factor", "value"), [(0.3048, "4.26"), (3.0, "42")])
def test_a_satellite_number_that_no_system_has_is_an_error(
    tmp_path: Path, factor: float, value: str
) -> None:
    scaled = three().assign(prn=lambda table: factor * table["prn"])
    with pytest.raises(ValueError, match=rf"out of range, the first with prn is {value}"):
        _ = constellation(tmp_path, scaled).names


@pytest.mark.parametrize("column", ["af0", "e", "tgd", "prn"])
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_a_blank_or_infinite_parameter_is_an_error(
    tmp_path: Path, column: str, value: float
) -> None:
    table = three()
    table[column] = table[column].astype(float)
    table.loc[2, column] = value
    with pytest.raises(ValueError, match=rf"column {column} must have finite .* in row 2"):
        _ = constellation(tmp_path, table).names


LINES = as_rinex(3).splitlines()
SPOILT = {
    "blank field": (4, LINES[4][:23] + " " * 19 + LINES[4][42:], "blank fields e"),
    "missing exponent": (4, LINES[4].replace("D-02", "    ", 1), "expected a number like"),
    "date": (2, LINES[2].replace("2016", "2015"), "week and toe must be near the date"),
    "month": (2, LINES[2].replace("2016 06", "2016 16"), "month must be in"),
    "text after the numbers": (4, LINES[4] + "   1", "no text after the last number"),
    "missing line": (5, None, "must have 8 lines, got 7"),
    "repeated line": (5, LINES[5] + "\n" + LINES[5], "must have 8 lines, got 9"),
    "number of the satellite": (2, "G\xb2\xb2" + LINES[2][3:], "must begin with a satellite"),
}


def write_lines(folder: Path, number: int, line: str | None) -> Path:
    lines = list(LINES)
    lines[number : number + 1] = [] if line is None else [line]
    (folder / "nav.rnx").write_text("\n".join(lines) + "\n", encoding="latin-1")
    return folder / "nav.rnx"


@pytest.mark.parametrize("name", SPOILT)
def test_a_spoilt_rinex_record_is_dropped_and_named_with_its_line(
    tmp_path: Path, name: str
) -> None:
    number, line, message = SPOILT[name]
    read = read_rinex(write_lines(tmp_path, number, line))
    assert read.rows["sys"].tolist() == ["E"]
    (note,) = read.notes
    assert re.search(f"nav.rnx: the record in line 3, .* is dropped: .*{message}", note), note


HARMLESS = {
    "spare field": (9, LINES[9][:42] + "0.499063314480-269", ()),
    "field that nobody uses": (3, f"{LINES[3][:4]}{'unknown':>19}{LINES[3][23:]}", ()),
    "three digits of an exponent": (2, LINES[2][:61] + " 0.000000000000-269", ()),
    "other letter of the exponent": (4, LINES[4].replace("D", "e"), ()),
    "comment": (1, "M\xfcnchen" + " " * 53 + "COMMENT\n" + LINES[1], ()),
    "byte order mark": (0, "\xef\xbb\xbf" + LINES[0], ()),
    "carriage returns": (3, LINES[3] + "\r", ()),
    "new system": (
        2,
        "X" + LINES[2][1:],
        ("nav.rnx: not read: records 1 of the unknown system 'X'",),
    ),
    "other system": (2, "C" + LINES[2][1:], ("nav.rnx: not read: records 1 of BeiDou",)),
}


@pytest.mark.parametrize("name", HARMLESS)
def test_what_no_satellite_needs_does_not_decide(tmp_path: Path, name: str) -> None:
    number, line, notes = HARMLESS[name]
    clean = read_rinex(write_lines(tmp_path, 0, LINES[0])).rows
    read = read_rinex(write_lines(tmp_path, number, line))
    assert read.notes == notes
    expected = clean[clean["sys"] == "E"] if notes else clean
    names = ["toe", "e", "M0", "af0", "tgd", "ttx"]
    assert read.rows[names].to_numpy().tolist() == expected[names].to_numpy().tolist()


def test_most_records_that_cannot_be_read_refuse_a_file(tmp_path: Path) -> None:
    text = as_rinex(3, three()).replace("D-0", "X-0")
    (tmp_path / "nav.rnx").write_text(text)
    with pytest.raises(ValueError, match=r"line 3, .* expected a number .* and so 9 of 9 records"):
        read_rinex(tmp_path / "nav.rnx")
