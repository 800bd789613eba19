"""Inspection of a folder: clean logs stay quiet, suggested settings run as they are, and pages are the same for the same log."""

import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import yaml
from checkout import ROOT
from command_line import pfbench
from log_faults import ANGLES, FAULTS, FORCE, RATE, VELOCITY
from refusals import check_refused
from synthetic_log import drive, tables, write

import pfbench as package
from pfbench.logs.doctor import inspection
from pfbench.logs.doctor.finding import merge_settings, thin_curve
from pfbench.logs.judge.log_page import write_log_page
from pfbench.logs.worlds import log_reader, log_tables
from pfbench.logs.worlds.log_reader import read_log
from pfbench.logs.worlds.standing import allan_deviation
from pfbench.scenario import LogCorrections, LogDiagnosis, inspect_log

Log = dict[str, pd.DataFrame]
SECONDS = 60.0


def noisy() -> Log:
    """A drive with the errors of a MEMS IMU and of a receiver, without velocities of fixes."""
    log, rng = tables(SECONDS), np.random.default_rng(1)
    log["imu"][["wx", "wy", "wz"]] += 5e-3 * rng.normal(size=(len(log["imu"]), 3)) + 1e-3
    log["imu"][["fx", "fy", "fz"]] += 0.1 * rng.normal(size=(len(log["imu"]), 3))
    log["gnss"] = log["gnss"][["t", "pn", "pe", "pd"]]
    log["gnss"][["pn", "pe", "pd"]] += rng.normal(0.0, 0.5, (len(log["gnss"]), 3))
    return log


def spoilt(folder: Path, *faults: str) -> Path:
    """A folder with a log with faults."""
    log = noisy()
    for fault in faults:
        FAULTS[fault].plant(log)
    return write(folder / "own", log)


def test_a_clean_log_is_quiet_and_reads(tmp_path: Path) -> None:
    diagnosis = inspect_log(spoilt(tmp_path))
    assert [f.check for f in diagnosis.findings] == []
    assert diagnosis.settings == {}
    assert package.inspect_log is inspect_log
    assert diagnosis.facts["imu rate"] == pytest.approx(100.0)


CASES = {
    "gnss clock +18 s": {"corrections": {"shift_s": {"gnss": 18.0}}},
    "forward-left-up": {"corrections": {"mounting": {"imu": ["x", "-y", "-z"]}}},
    "reference and fixes ENU": {
        # a level drive does not show the sign of Down
        "corrections": {"level_axes": {"reference": ["e", "n", "d"], "gnss": ["e", "n", "d"]}}
    },
    "force sample 1.9e16": {"corrections": {"drop": ["spikes"]}},
    "imu duplicate rows": {"corrections": {"times": {"imu": "sort"}}},
    "imu gap 0.5 s": {"corrections": {"gaps": "longest"}},
    "yaw from East": {"corrections": {"attitude": "yaw_from_east"}},
    "NMEA fix codes": {"fix_codes": "nmea"},
    "force in g": {"corrections": {"scale": {"imu": dict.fromkeys(FORCE, 9.80665)}}},
    "attitude in 0.1 deg": {
        "corrections": {"scale": {"reference": dict.fromkeys(ANGLES, np.pi / 1800.0)}}
    },
    "gyro in deg/s": {"corrections": {"scale": {"imu": dict.fromkeys(RATE, np.pi / 180.0)}}},
    "reference velocity km/h": {
        "corrections": {"scale": {"reference": dict.fromkeys(VELOCITY, 1.0 / 3.6)}}
    },
}


def is_close(value: object, wanted: object) -> bool:
    """Whether settings are those that are wanted, numbers to 0.05."""
    if isinstance(wanted, dict):
        return isinstance(value, dict) and value.keys() == wanted.keys() and all(is_close(value[k], wanted[k]) for k in wanted)  # fmt: skip
    return value == wanted if not isinstance(wanted, float) else abs(float(value) - wanted) < 0.05  # type: ignore[arg-type]


@pytest.mark.parametrize("fault", CASES)
def test_the_settings_of_a_refused_log_let_it_read(tmp_path: Path, fault: str) -> None:
    folder = spoilt(tmp_path, fault)
    with pytest.raises(ValueError):  # noqa: PT011
        read_log(folder)
    diagnosis = inspect_log(folder)
    assert diagnosis.of("refuse") or fault == "NMEA fix codes"
    assert is_close(diagnosis.settings, CASES[fault])
    assert diagnosis.remaining == ()
    log = read_log(
        folder,
        fix_codes=diagnosis.settings.get("fix_codes"),
        corrections=LogCorrections(**diagnosis.settings.get("corrections", {})),
    )
    said = " ".join(log.notes)
    assert re.search(
        r"subtracted|are \[|replaced|left out|longest of|converted|codes of nmea|multiplied", said
    )


OVER_TIME = (
    "fx jumps 2 m/s^2", "wz cut off", "fixes off 15 m for 10 s", "reference jumps 8 m", "gyro bias drifts 3 deg/s", "force late 0.2 s", "fy of zero",
)  # fmt: skip


@pytest.mark.parametrize("fault", OVER_TIME)
def test_what_changes_over_time_has_a_name_and_no_other_remedy(tmp_path: Path, fault: str) -> None:
    diagnosis = inspect_log(spoilt(tmp_path, fault))
    found = {finding.check for finding in diagnosis.findings}
    assert FAULTS[fault].named in found <= {FAULTS[fault].named, *FAULTS[fault].also}
    assert diagnosis.settings == {}


def test_no_remedy_is_printed_that_leaves_the_log_worse_than_a_clean_one(tmp_path: Path) -> None:
    """The clock has a remedy, and after it the fixes still drift away: all remedies of a log are tried together."""
    diagnosis = inspect_log(spoilt(tmp_path, "gnss clock +1 s", "fixes drift 20 m"))
    assert (len(diagnosis.findings) > 1, diagnosis.settings) == (True, {})
    assert all("Nothing that was tried" in f.remedy for f in diagnosis.findings)


def test_the_suggested_file_runs_as_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The command that the inspection prints runs, and its error is that of the fixes."""
    monkeypatch.chdir(tmp_path)
    folder = spoilt(tmp_path, "gyro in deg/s")
    first = pfbench("inspect", str(folder), home=tmp_path)
    assert first.code == 2
    assert "Multiply by 0.01745329252" in first.out
    words = re.search(r"Mended: pfbench run (.*)", first.out)[1].replace("'", "").split()  # type: ignore[index]
    run = pfbench("run", *words, "runs=1", "study=mended", home=tmp_path)
    assert run.code == 0, run.err
    assert "1 of 1 runs valid" in run.out


def write_page(diagnosis: LogDiagnosis, folder: Path, out: Path) -> Path:
    source = {"name": "own", "root": folder.parent, "folder": "own", "words": {}}
    return write_log_page(diagnosis, source, out)


def test_equal_logs_give_equal_pages_with_a_picture_for_each_finding(tmp_path: Path) -> None:
    folder = spoilt(tmp_path, "gnss clock +1 s", "gyro bias 4 deg/s", "one fix off 20 m")
    contents = []
    for _ in range(2):
        page = write_page(inspect_log(folder), folder, tmp_path / "reports")
        files = [f for f in page.parent.rglob("*") if f.is_file()]
        contents.append({f.name: f.read_bytes() for f in files})
    assert contents[0] == contents[1]
    findings = inspect_log(folder).findings
    assert {f.check for f in findings} == {"gnss clock", "gyro bias", "fix outliers"}
    text = page.read_text()
    assert text.count("<img") == len(findings) == len(list((page.parent / "figures").glob("*.png")))
    suggested = yaml.safe_load((page.parent / "scenario" / "suggested.yaml").read_text())
    assert suggested["defaults"] == ["user_log", "_self_"]
    assert suggested["corrections"]["drop"] == ["outliers"]


def test_exit_codes_tell_warnings_from_refusals(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    results = {
        fault: pfbench("inspect", str(spoilt(tmp_path / str(i), *fault)), home=tmp_path).code
        for i, fault in enumerate([(), ("gyro bias 4 deg/s",), ("imu one step back",)])
    }
    assert list(results.values()) == [0, 3, 2]


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "inspect must have one folder, got none"),
        (("nowhere",), "nowhere must be a folder with imu, gnss and, if there is one, reference"),
        ((".", "imus=a"), "key must be one of imu, gnss, reference"),
        ((".", "scenario.origin=a,b,c"), "origin must be"),  # as remedies for a run name the key
        ((".", "path=x"), "path must be a number, got x"),
        ((".",), "must contain imu.parquet or imu.csv"),
    ],
)
def test_what_cannot_be_inspected_is_told(
    tmp_path: Path, words: tuple[str, ...], said: str
) -> None:
    result = pfbench("inspect", *words, home=tmp_path)
    assert result.code == 2
    assert said in result.err
    assert not (tmp_path / "reports").exists()


BAD_CORRECTIONS: dict[str, tuple[dict[str, object], str]] = {
    "table": ({"scale": {"gps": {"pn": 2.0}}}, r"corrections\.scale must be of imu, gnss, reference, got 'gps'"),
    "order": ({"times": {"imu": "late"}}, r"corrections\.times must be of sort, even, got 'late'"),
    "axes": ({"mounting": {"imu": ["x", "x", "z"]}}, r"mounting\.imu must be three different axes"),
    "level": ({"level_axes": {"gnss": ["e", "n"]}}, r"level_axes\.gnss must be three different axes"),
    "attitude": ({"attitude": "yaw"}, r"corrections\.attitude must be of yaw_from_east"),
    "drop": ({"drop": ["fixes"]}, r"corrections\.drop must be of spikes"),
    "gaps": ({"gaps": "cut"}, r"corrections\.gaps must be of refuse, longest"),
    "arm": ({"lever_arm": [1.0]}, r"corrections\.lever_arm must be 3 finite numbers"),
    "number": ({"scale": 1.1}, r"corrections\.scale must be values by name, got 1\.1\. Set \{NAME: 1\.1\}"),
    "column": ({"bias": {"imu": 0.1}}, r"corrections\.bias\.imu must be values by column, got 0\.1"),
    "factor": ({"scale": {"imu": {"fx": 0.0}}}, r"corrections\.scale\.imu\.fx must be a finite number"),
    "shift": ({"shift_s": {"imu": [[1.0, 0.0], [0.0, 1.0]]}}, r"shift_s\.imu must have increasing times"),
    "nodes": ({"shift_s": {"imu": [[1.0]]}}, r"shift_s\.imu must be a number in s, or nodes"),
}  # fmt: skip


@pytest.mark.parametrize("case", BAD_CORRECTIONS)
def test_wrong_corrections_are_refused_in_words(case: str) -> None:
    settings, said = BAD_CORRECTIONS[case]
    with pytest.raises(ValueError, match=said):
        LogCorrections(**settings)  # type: ignore[arg-type]


def test_a_column_that_is_not_there_cannot_be_corrected(tmp_path: Path) -> None:
    folder = spoilt(tmp_path)
    check_refused(
        [
            (
                r"must name columns of imu\.csv, got ax",
                lambda: read_log(folder, corrections=LogCorrections(scale={"imu": {"ax": 2.0}})),
            )
        ],
        remedy=False,
    )


def test_a_lever_arm_moves_the_fixes_to_the_imu(tmp_path: Path) -> None:
    """What `lever_arm` takes away is what the fault adds: fixes differ by less than the interpolation of the attitude."""
    arm = read_log(spoilt(tmp_path / "a", "lever arm 1.6 m"), corrections=LogCorrections(lever_arm=[1.2, 0.5, -1.0]))  # fmt: skip
    plain = read_log(spoilt(tmp_path / "b"))
    np.testing.assert_allclose(arm.fixes.position, plain.fixes.position, atol=2e-3)
    assert any("with the attitude of the reference" in note for note in arm.notes)


# --------------------------------------------------------------------------------------------------
# Gaps of the IMU.


def without(log: Log, start: float, seconds: float) -> Log:
    t = log["imu"]["t"]
    return {**log, "imu": log["imu"][(t <= start) | (t >= start + seconds - 1e-6)]}


def test_a_short_gap_is_bridged_with_the_noise_of_the_log(tmp_path: Path) -> None:
    log = noisy()
    whole = read_log(write(tmp_path / "whole", log)).imu
    gaps = {**log}
    starts = np.arange(5.0, 55.0, 2.0)
    for start in starts:
        gaps = without(gaps, start, 0.19)
    read = read_log(write(tmp_path / "gaps", gaps))
    assert any("25 intervals are longer than 3 samples" in note for note in read.notes)
    np.testing.assert_allclose(read.imu.time, whole.time, atol=1e-9)
    inside = np.zeros(len(whole.time), bool)
    for start in starts:
        inside |= (whole.time > start + 1e-6) & (whole.time < start + 0.19 - 1e-6)
    count = int(inside.sum())
    assert count == 18 * len(starts)
    # wx has mean 0.001 and noise of 5e-3: relative standard error of a deviation 1 / sqrt(2 n); copies of 18 of 64 samples
    deviation = read.imu.rate[inside, 1].std()
    assert deviation == pytest.approx(5e-3, rel=5.0 / np.sqrt(2 * count))


def test_a_long_gap_is_refused_or_cut_by_the_key(tmp_path: Path) -> None:
    folder = write(tmp_path / "own", without(noisy(), 20.0, 0.25))
    check_refused(
        [
            (
                r"no sample for 0\.250 s after t = .*scenario\.corrections\.gaps=longest",
                lambda: read_log(folder),
            )
        ],
        remedy=False,
    )
    log = read_log(folder, corrections=LogCorrections(gaps="longest"))
    assert log.imu.time[0] == pytest.approx(20.25)
    assert any("the longest of 2 parts" in note for note in log.notes)


# --------------------------------------------------------------------------------------------------
# Parts.


def test_the_allan_deviation_of_white_noise_is_its_density() -> None:
    """Density 2e-3 at 100 Hz: standard error of the deviation over 400 means of 1 s, three axes."""
    samples = 2e-3 * 10.0 * np.random.default_rng(3).normal(size=(40000, 3))
    deviation = allan_deviation(samples, 100.0)
    np.testing.assert_allclose(deviation, 2e-3, rtol=5.0 * np.sqrt(3.0 / (4.0 * 399)))


def test_a_thinned_curve_keeps_its_extremes() -> None:
    y = np.random.default_rng(0).normal(size=100_000)
    y[[1234, 98765]] = 50.0, -60.0
    _, x, values = thin_curve("a", np.arange(len(y)), y)
    assert (len(x) <= 1200, values.max(), values.min()) == (True, 50.0, -60.0)
    assert (np.diff(x) > 0).all()


def test_settings_are_merged_and_the_first_value_stays() -> None:
    merged = merge_settings(
        [{"a": {"x": 1, "drop": ["spikes"]}}, {"a": {"x": 2, "y": 3, "drop": ["stuck", "spikes"]}}]
    )
    assert merged == {"a": {"x": 1, "y": 3, "drop": ["spikes", "stuck"]}}


class Calls:
    """Counts the calls of the checks and of the reader of files."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.counts = {"checks": 0, "files": 0}
        for module, name, kind in (
            (inspection, "run_checks", "checks"),
            (log_reader, "run_checks", "checks"),
            (log_tables, "read_table_file", "files"),
        ):
            monkeypatch.setattr(module, name, self._counted(getattr(module, name), kind))

    def _counted(self, function: Callable[..., Any], kind: str) -> Callable[..., Any]:
        def counted(*args: Any, **kwargs: Any) -> Any:
            self.counts[kind] += 1
            return function(*args, **kwargs)

        return counted


# rounds of checks: one without a remedy, two with one; the reading has none of its own
ROUNDS: dict[str, tuple[Callable[[Path], Path], int]] = {
    "clean": (spoilt, 1),
    "biased": (lambda folder: spoilt(folder, "gyro bias 4 deg/s"), 2),
    "bridged": (lambda folder: write(folder / "own", without(noisy(), 20.0, 0.19)), 1),
}


@pytest.mark.parametrize("case", ROUNDS)
def test_files_are_read_once_and_rows_are_checked_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, case: str
) -> None:
    prepare, rounds = ROUNDS[case]
    folder = prepare(tmp_path)
    calls = Calls(monkeypatch)
    inspect_log(folder)
    assert calls.counts == {"checks": rounds, "files": 3}


def test_an_inspection_tells_what_a_reading_tells(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = spoilt(tmp_path, "gyro bias 4 deg/s")
    inspect_log(folder)
    told = [record.getMessage() for record in caplog.records]
    assert all(any(note in line for line in told) for note in read_log(folder).notes)


@pytest.mark.slow
def test_an_hour_at_200_hz_needs_less_than_a_gibibyte(tmp_path: Path) -> None:
    """From files, with a clock and a gyro that are off: two rounds of all checks. Times are on the page of own logs."""
    code = f"""
import resource
from pfbench.scenario import inspect_log
checks = ",".join(sorted(f.check for f in inspect_log({str(write_hour(tmp_path))!r}).findings))
print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20, checks)
"""
    largest, checks = run_code(code)
    assert float(largest) < 1.0
    assert checks == "gyro bias,imu clock"


def write_hour(folder: Path) -> Path:
    """An hour of a drive: IMU at 200 Hz, 0.1 s late and with a gyro bias of 4 deg/s, fixes at 1 Hz, reference at 10 Hz."""
    t, rng = np.arange(3600 * 200) / 200, np.random.default_rng(0)
    whole = drive(t)
    imu = pd.DataFrame({c: whole[c] for c in ("t", "fx", "fy", "fz", "wx", "wy", "wz")})
    imu[["wx", "wy", "wz"]] += 5e-3 * rng.normal(size=(len(t), 3))
    imu[["fx", "fy", "fz"]] += 0.1 * rng.normal(size=(len(t), 3))
    imu["t"] += 0.1
    imu["wz"] += np.radians(4.0)
    names = ("t", "pn", "pe", "pd", "vn", "ve", "vd", "roll", "pitch", "yaw")
    reference = pd.DataFrame({c: whole[c][::20] for c in names})
    gnss = reference[["t", "pn", "pe", "pd"]][::10].reset_index(drop=True)
    gnss[["pn", "pe", "pd"]] += rng.normal(size=(len(gnss), 3))
    return write(folder / "hour", {"imu": imu, "gnss": gnss, "reference": reference})


def run_code(code: str) -> list[str]:
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert run.returncode == 0, run.stderr
    return run.stdout.strip().split(maxsplit=1)
