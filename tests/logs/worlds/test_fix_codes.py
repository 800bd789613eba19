"""Codes of fixes: what each program calls usable, what is refused, and that the console says it once."""

import logging
import os
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from checkout import ROOT
from command_line import pfbench
from recorded_data import believed
from refusals import check_refused
from synthetic_log import tables, write

from pfbench.files import reader_notes
from pfbench.logs.worlds.drive import RecordedDrive
from pfbench.logs.worlds.fix_codes import PROGRAMS, check_fix_codes
from pfbench.logs.worlds.log_reader import read_log


def write_codes(folder: Path, codes: list[float]) -> Path:
    """A log whose fixes have these codes, repeated."""
    log = tables()
    log["gnss"]["fix"] = np.resize(codes, len(log["gnss"]))
    return write(folder, log)


# the codes of usable fixes, from the description of each format [NMEA 0183 GGA; RTKLIB manual 2.4.2, B.1; MAVLink GPS_FIX_TYPE; u-blox UBX-NAV-PVT]
USED = {
    "nmea": {1, 2, 3, 4, 5},
    "rtklib": {1, 2, 3, 4, 5, 6},
    "mavlink": {3, 4, 5, 6, 8},
    "ublox": {3, 4},
}


@pytest.mark.parametrize("program", PROGRAMS)
def test_the_fixes_of_a_program_are_used(tmp_path: Path, program: str) -> None:
    used, unused = PROGRAMS[program]
    assert set(used) == USED[program]
    codes = sorted({*used, *unused})
    log = read_log(write_codes(tmp_path, [float(code) for code in codes]), fix_codes=program)
    seen = np.resize(codes, len(log.fixes.time))
    expected = np.isin(seen, list(USED[program]))
    assert np.array_equal(np.isfinite(log.fixes.position[:, 0]), expected)
    assert f"{expected.sum()} of 101 fixes used; column fix as codes of {program}" in log.notes[0]
    for code in codes:
        assert (
            f"{code} ({ {**used, **unused}[code] }) in {(seen == code).sum()} rows" in log.notes[0]
        )


def test_0_and_1_need_no_program(tmp_path: Path) -> None:
    log = read_log(write_codes(tmp_path, [1, 1, 0]))
    assert np.flatnonzero(np.isnan(log.fixes.position[:, 0])).tolist() == list(range(2, 101, 3))
    assert "68 of 101 fixes used; column fix is 0 (not used) in 33 rows, 1 (used)" in log.notes[0]


@pytest.mark.parametrize(
    ("codes", "remedies"),
    [
        ([4.0], ["nmea", "rtklib", "mavlink", "ublox", [4]]),
        ([4.0, 0.0, 5.0], ["nmea", "rtklib", "mavlink", "ublox", [4, 5]]),
        ([6.0, 1.0], ["nmea", "rtklib", "mavlink", [1, 6]]),
        ([2.0, 1.0], ["nmea", "rtklib", [1, 2]]),
        ([9.0], [[9]]),
    ],
)
def test_other_codes_are_refused_and_each_named_key_reads_them(
    tmp_path: Path, codes: list[float], remedies: list[Any]
) -> None:
    folder = write_codes(tmp_path, codes)
    with pytest.raises(ValueError, match=r"column fix must be 0 or 1 .*scenario\.fix_codes=") as e:
        read_log(folder)
    named = str(e.value).partition("scenario.fix_codes=")[2]
    for program in PROGRAMS:
        assert (program in named) == (program in remedies)
    for remedy in remedies:
        text = remedy if isinstance(remedy, str) else f"[{','.join(map(str, remedy))}]"
        assert text in named
        assert np.isfinite(read_log(folder, fix_codes=remedy).fixes.position).any()


def test_a_code_that_the_program_does_not_have_is_refused(tmp_path: Path) -> None:
    check_refused(
        [
            (
                r"must be a code of ublox, got 9 in 33 of 101 rows",
                lambda: read_log(write_codes(tmp_path, [3, 3, 9]), fix_codes="ublox"),
            )
        ],
        remedy=False,
    )


@pytest.mark.parametrize(("codes", "choice"), [([0.0], None), ([0, 6], "nmea"), ([4.0], [5])])
def test_a_table_without_a_usable_fix_is_refused(
    tmp_path: Path, codes: list[float], choice: Any
) -> None:
    folder = write_codes(tmp_path, codes)
    with pytest.raises(ValueError, match=r"must have a usable fix, got none of 101") as e:
        read_log(folder, fix_codes=choice)
    named = int(str(e.value).partition("scenario.fix_codes=[")[2].partition("]")[0])
    assert np.isfinite(read_log(folder, fix_codes=[named]).fixes.position).any()


@pytest.mark.parametrize("codes", ["novatel", [], [-1], [1.5], ["4"], [True]])
def test_other_values_of_the_key_are_refused(codes: Any) -> None:
    check_refused(
        [
            (
                r"scenario\.fix_codes must be nmea, rtklib, mavlink, ublox, null",
                lambda: check_fix_codes(codes),
            )
        ],
        remedy=False,
    )


KEYS = ("scenario=user_log", "scenario.folder=log", "runs=1", "scenario.fix_codes=rtklib")


def test_the_console_says_it_once_before_the_first_job_of_a_sweep(tmp_path: Path) -> None:
    write_codes(tmp_path / "log", [1, 2, 0])
    keys = (*KEYS, f"data.root={tmp_path}", "noise=nominal", "score_steps=0", "pcrb=false")
    said = pfbench("run", "-m", *keys, "filter=ekf,ckf", home=tmp_path)
    assert said.code == 0, said.err
    note = "note      log: gnss.csv: 68 of 101 fixes used; column fix as codes of rtklib"
    assert said.out.count(note) == 1
    assert said.out.index(note) < said.out.index("[1/2] finished")
    assert "sweep: 2 finished, 0 skipped, 0 failed" in said.out


def test_no_usable_fix_in_the_chosen_time_is_an_error(tmp_path: Path) -> None:
    write_codes(tmp_path / "log", [1.0] * 21 + [0.0] * 80)  # usable until t = 4 s
    drive = RecordedDrive(str(tmp_path), "log", believed([1.5, 1.5, 3.0], None), start_s=5.0)
    check_refused(
        [
            (
                r"must include a usable one, got none of 15.*\(t = 0\.000 to 4\.000\)",
                lambda: drive.read(),
            )
        ],
        remedy=False,
    )
    assert np.isfinite(replace(drive, start_s=0.0).read().fixes).any()


def test_a_note_of_another_process_of_the_sweep_is_not_repeated(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO, "pfbench")
    monkeypatch.setenv(reader_notes.SWEEP_LOG, str(tmp_path / "sweep"))
    monkeypatch.setattr(reader_notes, "_announced", set())
    reader_notes.announce_notes(tmp_path / "drive", ["dropped"])
    assert caplog.messages == ["note      drive: dropped"]
    monkeypatch.setattr(os, "getpid", lambda: -1)  # another process, which knows nothing of it
    monkeypatch.setattr(reader_notes, "_announced", set())
    reader_notes.announce_notes(tmp_path / "drive", ["dropped"])
    assert len(caplog.messages) == 1
    reader_notes.announce_notes(tmp_path / "walk", ["dropped"])
    assert caplog.messages[1:] == ["note      walk: dropped"]


def test_many_notes_are_counted(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(reader_notes, "_announced", set())
    reader_notes.announce_notes("drive", [f"row {i}" for i in range(40)])
    assert len(caplog.messages) == 12
    assert caplog.messages[-1].startswith("note      drive: 29 further notes")


def test_the_page_lists_the_codes() -> None:
    page = (ROOT / "docs" / "use_your_data.md").read_text()
    for program, codes in PROGRAMS.items():
        row = re.search(rf"^\| `{program}`.*$", page, re.MULTILINE)
        listed = [", ".join(f"{code} {name}" for code, name in part.items()) for part in codes]
        assert row
        assert row[0].split(" | ")[1:] == [listed[0], f"{listed[1]} |"]
