"""Files in the forms that programs and receivers write: read as the same trajectory, or refused with a remedy."""

import re
from collections.abc import Callable
from pathlib import Path

import judge_cases as cases
import numpy as np
import pandas as pd
import pytest
from command_line import pfbench
from refusals import check_refused
from scipy.spatial.transform import Rotation

from pfbench.logs.judge.formats import read_trajectories
from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.trajectory_table import to_north_east_down

TRUTH = cases.drive(30.0)
POSITION = TRUTH[["pn", "pe", "pd"]].to_numpy()
QUATERNION = Rotation.from_euler("ZYX", TRUTH[["yaw", "pitch", "roll"]].to_numpy().copy()).as_quat()
TUM = np.column_stack([TRUTH.t, POSITION, QUATERNION])
NAMES = "timestamp tx ty tz qx qy qz qw"
W_FIRST = [0, 1, 2, 3, 7, 4, 5, 6]
EUROC = (
    "#timestamp, p_RS_R_x [m], p_RS_R_y [m], p_RS_R_z [m], q_RS_w [], q_RS_x [], q_RS_y [], q_RS_z [], "
    "v_RS_R_x [m s^-1], v_RS_R_y [m s^-1], v_RS_R_z [m s^-1]"
)
VELOCITY = TRUTH[["vn", "ve", "vd"]].to_numpy()
OPENVINS = f"# timestamp(s) tx ty tz qx qy qz qw {' '.join(f'P{k}' for k in range(12))}"


def read(path: Path, **options: object):
    (table,) = read_trajectories(path, SourceOptions(**options))
    return table


def text(numbers: np.ndarray, separator: str = " ", head: str = "") -> str:
    rows = "".join(separator.join(f"{x:.10f}" for x in row) + "\n" for row in numbers)
    return (head and head + "\n") + rows


POSES = {
    "comment": ("a.txt", text(TUM, head=f"# {NAMES}")),
    "no comment": ("a.log", text(TUM)),
    "names without #": ("a.dat", text(TUM, head=NAMES)),
    "BOM": ("a.txt", "\ufeff" + text(TUM, head=f"# {NAMES}")),
    "line ends": ("a.txt", text(TUM).replace("\n", "\r\n")),
    "tabs": ("a.txt", text(TUM, "\t")),
    "commas": ("a.csv", text(TUM, ",")),
    "semicolons": ("a.txt", text(TUM, "; ")),
    "names and commas": ("a.csv", text(TUM, ",", NAMES.replace(" ", ","))),
    "index": ("a.txt", text(np.column_stack([np.arange(len(TUM)), TUM]))),
    "w first": ("a.csv", text(TUM[:, W_FIRST], ",", "time,x,y,z,qw,qx,qy,qz")),
    "EuRoC": ("data.csv", text(np.column_stack([TUM[:, W_FIRST], VELOCITY]), ",", EUROC)),
    "OpenVINS": ("est.txt", text(np.column_stack([TUM, np.ones((len(TUM), 12))]), " ", OPENVINS)),
    "rostopic": ("o.csv", text(TUM, ",", "%time,pose.position.x,pose.position.y,pose.position.z,"
                 "pose.orientation.x,pose.orientation.y,pose.orientation.z,pose.orientation.w")),
}  # fmt: skip


@pytest.mark.parametrize("case", POSES)
def test_poses_are_found_by_content(tmp_path: Path, case: str) -> None:
    name, content = POSES[case]
    (tmp_path / name).write_text(content)
    table = read(tmp_path / name, frame="ned")
    assert np.allclose(table.time, TRUTH.t)
    assert np.allclose(table.select(("pn", "pe", "pd")), POSITION)
    angles = table.select(("roll", "pitch", "yaw"))
    assert np.allclose(angles, TRUTH[["roll", "pitch", "yaw"]], atol=1e-7)
    check_refused(
        [(rf"NAME.frame must be ned or enu for {name}", lambda: read(tmp_path / name))],
        remedy=False,
    )


OTHERS = {
    "KF-GINS deviations": (text(np.ones((20, 22))), "got 22 fields .* as NAME.sd"),
    "seven numbers": (text(TUM[:, :7]), "got 7 fields .* NAME.format=table, tum, kf_gins or nmea"),
    "eleven numbers": (text(np.column_stack([TUM[1:, :8], VELOCITY[1:]])), "got 11 fields"),
    "prose": ("a flight\nof a day\n", "must be a table with names of columns, a TUM file"),
    "empty": ("", "got 0 fields in the first row"),
    "ULog": ("ULog\x01\x12\x35\x00", "got ULog of PX4, by its first bytes. Convert it"),
    "blanks": (TRUTH.to_csv(index=False, sep=" "), r"got blanks as separators .* read_csv\('a.txt'"),
    "damaged": (text(TUM).replace("0.5000000000 ", "0.5x ", 1), "line 2 must have 8 numbers"),
}  # fmt: skip


@pytest.mark.parametrize("case", OTHERS)
def test_other_texts_are_refused_with_the_candidates(tmp_path: Path, case: str) -> None:
    content, message = OTHERS[case]
    (tmp_path / "a.txt").write_text(content)
    check_refused(
        [(message, lambda: read(tmp_path / "a.txt", frame="ned" if case == "damaged" else ""))],
        remedy=False,
    )


def test_the_option_decides_on_the_format(tmp_path: Path) -> None:
    file = cases.write(TRUTH, tmp_path / "a.txt")
    assert np.allclose(read(file).values["pe"], TRUTH.pe)
    check_refused(
        [
            (
                r"line 2, columns qx ... qw must be a quaternion",
                lambda: read(file, format="tum", frame="ned"),
            )
        ],
        remedy=False,
    )


def test_a_table_of_another_suffix_is_named(tmp_path: Path) -> None:
    TRUTH.to_parquet(tmp_path / "a.parquet")
    (tmp_path / "a.csv").write_bytes((tmp_path / "a.parquet").read_bytes())
    check_refused(
        [(r"got a Parquet file. Rename it to a.parquet", lambda: read(tmp_path / "a.csv"))],
        remedy=False,
    )


COLUMNS = {
    "brackets": (["time [s]", "x [m]", "states[9]", "{z}"], "t:time [s],pn:x [m],pe:states[9],pd:{z}"),
    "whole list": (["time", "x", "y", "z"], "{t:time,pn:x, pe:y ,pd:z}"),
    "commas": (["time, s", 'x "N"', "y", "z"], 't:"time, s",pn:x "N",pe:y,pd:z'),
    "colons": (["gps:tow", "x", "y", "z"], "t:gps:tow,pn:x,pe:y,pd:z"),
}  # fmt: skip


@pytest.mark.parametrize("case", COLUMNS)
def test_names_of_columns_keep_their_characters(tmp_path: Path, case: str) -> None:
    names, option = COLUMNS[case]
    table = TRUTH[["t", "pn", "pe", "pd"]].set_axis(names, axis=1)
    file = cases.write(table, tmp_path / "a.csv")
    words = [f"reference={file}", f"a={file}", f"reference.columns={option}", f"a.columns={option}"]
    said = pfbench("judge", *words, f"reports_dir={tmp_path / 'r'}", home=tmp_path)
    assert said.code == 0, said.err


@pytest.mark.parametrize("option", ["t:time, s,pn:x", "t:", "time", 't:"time', "t:time,t:x", ":x"])
def test_names_of_columns_that_cannot_be_read_are_refused(tmp_path: Path, option: str) -> None:
    file = cases.write(TRUTH, tmp_path / "a.csv")
    said = pfbench("judge", f"reference={file}", f"a={file}", f"a.columns={option}", home=tmp_path)
    assert said.code == 2
    assert "a.columns must be NAME:NAME_IN_FILE" in said.err


def test_a_unit_in_the_name_of_a_column_needs_its_factor(tmp_path: Path) -> None:
    table = TRUTH.assign(t=1e9 * TRUTH.t, yaw=np.degrees(TRUTH.yaw))
    file = cases.write(
        table.rename(columns={"t": "time [ns]", "yaw": "yaw (deg)"}), tmp_path / "a.csv"
    )
    columns = {"t": "time [ns]", "yaw": "yaw (deg)"}
    with pytest.raises(ValueError, match=r"Set NAME.scale=t:1e-09,yaw:0.017453293\.") as error:
        read(file, columns=columns)
    pairs = re.findall(r"(\w+):([\d.e-]+\d)", str(error.value).split("scale=")[1])
    table = read(file, columns=columns, scale={name: float(factor) for name, factor in pairs})
    assert np.allclose(table.time, TRUTH.t)
    assert np.allclose(table.values["yaw"], TRUTH.yaw)


def test_names_in_a_comment(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_text("# " + TRUTH.to_csv(index=False))
    assert np.allclose(read(tmp_path / "a.csv").values["pe"], TRUTH.pe)


def kf_gins(path: Path, second: pd.Series, week: pd.Series) -> Path:
    rows = [
        week,
        second,
        cases.geodetic(TRUTH),
        VELOCITY,
        np.degrees(TRUTH[["roll", "pitch", "yaw"]]),
    ]
    path.write_text(text(np.column_stack(rows)))
    return path


def test_the_week_continues_the_second_of_kf_gins(tmp_path: Path) -> None:
    second = 604790.0 + TRUTH.t
    file = kf_gins(tmp_path / "a.txt", second % 604800, 2300 + second // 604800)
    assert np.allclose(read(file).time, second)
    deviations = np.column_stack([second % 604800, np.ones((len(second), 21))])
    (tmp_path / "std.txt").write_text(text(deviations))
    (table,) = read_trajectories(file, SourceOptions(sd=str(tmp_path / "std.txt")))
    assert table.values["sd_pn"][0] == 1
    file = kf_gins(tmp_path / "a.txt", second, 2300 + second // 604800)  # which needs no week
    assert np.allclose(read(file).time, second)
    file = kf_gins(tmp_path / "a.txt", second % 604800, 2300 + 0 * second)
    check_refused(
        [(r"line 21, .* add 604800 to t from line 21 on", lambda: read(file))], remedy=False
    )


SENTENCES = cases.nmea(TRUTH, start_s=36000.0).splitlines()
GGA = [line for line in SENTENCES if "GGA" in line]


def changed(change: Callable[[str], str], lines: list[str] = SENTENCES) -> list[str]:
    """Sentences with changed bodies and new checksums."""
    return [cases.sentence(change(line[1:-3])) for line in lines]


def among(*others: str) -> list[str]:
    return [line for sentence in SENTENCES for line in (sentence, *others)]


def to_gns(body: str) -> str:
    return (
        body.replace("GPGGA", "GNGNS")
        .replace(",1,08,", ",AAN,08,")
        .replace(",M,47.0,M,,", ",47.0,,")
    )


NO_FIX = cases.sentence("GPGGA,100500.00,,,,,0,00,99.99,,,,,,")
NMEA = {
    "no checksums": ([line[:-3] for line in SENTENCES], "no checksums"),
    "other talker": (changed(lambda b: b.replace("GP", "GN", 1)), ""),
    "GNS": (changed(to_gns), ""),
    "two talkers": ([x for line in SENTENCES for x in (line, *changed(lambda b: b.replace("GPG", "GNG"), [line]))],
                    "61 GGA sentences of another talker or twice"),
    "other sentences": (among(cases.sentence("GPGSV,3,1,11,03"), "!AIVDM,1,1,,A,14eG;o@034,0*63", cases.sentence("PGRMC,A,1,2"),
                        cases.sentence("PUBX,00,1")), "488 other sentences"),
    "other lines": (among("# a comment", "\xb5b\x01\x07"), "244 other lines"),
    "prefix": ([f"12:00:00.000 {line}" for line in SENTENCES], ""),
    "line ends": ([f"{line}\r" for line in SENTENCES], ""),
    "empty separation": (changed(lambda b: b.replace(",M,47.0,M,,", ",M,,M,,").replace(",452", ",499")), None),
    "separation of some": ([*changed(lambda b: b.replace(",M,47.0,M,,", ",M,,M,,"), SENTENCES[:60]), *SENTENCES[60:]],
                           "30 epochs have the geoid separation of the nearest one"),
    "no fix": ([*SENTENCES, NO_FIX], "1 GGA sentences without a fix or a value"),
    "lower case": ([line[:-2] + line[-2:].lower() for line in SENTENCES], ""),
    "cut": ([*SENTENCES, NO_FIX[:30]], "1 damaged sentences in the last line"),
    "empty course": (changed(lambda b: re.sub(r"(GPRMC.*?E,[\d.]+),[\d.]+", r"\1,", b)), "61 RMC sentences without"),
}  # fmt: skip


@pytest.mark.parametrize("case", NMEA)
def test_legal_sentences_are_read(tmp_path: Path, case: str) -> None:
    lines, note = NMEA[case]
    content = "\n".join(lines) + ("" if case == "cut" else "\n")
    (tmp_path / "a.log").write_bytes(content.encode("latin-1"))
    table = read(tmp_path / "a.log", shift=-36000.0)
    assert np.allclose(table.time, TRUTH.t)
    geodetic = table.select(("lat_deg", "lon_deg", "h_m"))
    if case == "empty separation":
        assert "no geoid separation" in table.notes[0]
        return
    local = to_north_east_down(geodetic, np.array(cases.ORIGIN))
    assert np.abs(local - POSITION).max() < 1e-2
    assert note in " ".join(table.notes)
    assert bool(note) == bool(table.notes)
    assert table.has(("vn", "ve")) == (case != "empty course")


WRONG = {
    "one checksum": ([SENTENCES[0].replace(",N,", ",S,"), *SENTENCES[1:]], r"line 1 .*\(1 of 122 .* Remove these lines"),
    "one without": ([SENTENCES[0][:-3], *SENTENCES[1:]], "line 1 .* got none .* Remove these lines, or all checksums"),
    "all checksums": ([line.replace(",", ", ", 1) for line in SENTENCES], r"\(122 of 122 .* remove all checksums with their \*"),
    "no sign": ([SENTENCES[0][1:], *SENTENCES[1:]], r"line 1 must start with \$"),
    "two in a line": ([SENTENCES[0][:40] + SENTENCES[1], *SENTENCES[2:]], "line 1 .* got none"),
    "RMC alone": ([line for line in SENTENCES if "RMC" in line], "must have GGA or GNS .* got 61 RMC sentences"),
    "all without a fix": (changed(lambda b: b.replace(",1,08,", ",0,08,"), GGA), "got 61 GGA sentences, 61 GGA sentences without a fix"),
    "no number": (changed(lambda b: b.replace("0.9", "0.9,x"), GGA), "line 1 must have the fields of NMEA 0183"),
}  # fmt: skip


@pytest.mark.parametrize("case", WRONG)
def test_wrong_sentences_are_refused(tmp_path: Path, case: str) -> None:
    lines, message = WRONG[case]
    (tmp_path / "a.nmea").write_text("\n".join(lines) + "\n")
    with pytest.raises(ValueError, match=message) as error:
        read(tmp_path / "a.nmea")
    if "Remove these lines" in str(error.value):
        (tmp_path / "a.nmea").write_text("\n".join(lines[1:]) + "\n")
        assert len(read(tmp_path / "a.nmea").time) >= 60
    if "all checksums" in str(error.value):
        bare = "\n".join(line.partition("*")[0] for line in SENTENCES)
        (tmp_path / "a.nmea").write_text(bare + "\n")
        assert len(read(tmp_path / "a.nmea").time) == 61


def test_each_day_of_a_log_has_its_own_velocity(tmp_path: Path) -> None:
    """Two days with the same seconds, and the RMC of midnight before the GGA of the epoch before it."""
    day = cases.nmea(TRUTH, 86385.0).splitlines()
    reversed_course = TRUTH.assign(vn=-TRUTH.vn, ve=-TRUTH.ve)
    lines = [
        *day,
        *cases.nmea(TRUTH, 43200.0).splitlines(),
        *cases.nmea(reversed_course, 86385.0).splitlines(),
    ]
    midnight = next(k for k, line in enumerate(lines) if "GPRMC,000000" in line)
    lines[midnight - 3 : midnight + 1] = [lines[midnight], *lines[midnight - 3 : midnight]]
    (tmp_path / "a.nmea").write_text("\n".join(lines) + "\n")
    table = read(tmp_path / "a.nmea", shift=-86385.0)
    count = len(TRUTH)
    assert np.allclose(table.time[:count], TRUTH.t)
    assert np.allclose(table.time[-count:], TRUTH.t + 86400)
    assert np.allclose(table.values["vn"][:count], TRUTH.vn, atol=1e-3)
    assert np.allclose(table.values["vn"][-count:], -TRUTH.vn, atol=1e-3)


def test_notes_of_readers_are_printed_once_before_the_result(tmp_path: Path) -> None:
    truth = cases.drive(60.0)
    cases.write(truth.assign(extra=1.0), tmp_path / "truth.csv")
    for run in (1, 2):
        table = cases.estimate(truth, 1.0, run).assign(other=1.0)
        cases.write(table, tmp_path / f"mine_{run}.csv")
    words = [f"reference={tmp_path / 'truth.csv'}", f"mine={tmp_path}/mine_{{run}}.csv"]
    said = pfbench("judge", *words, f"reports_dir={tmp_path / 'r'}", home=tmp_path)
    lines = said.out.splitlines()
    assert lines[1] == "- File of reference: columns not used: extra."
    assert lines[2] == "- File of mine: columns not used: other (2 files)."
    assert said.out.count("columns not used") == 2
    assert "columns not used: other (2 files)" in (tmp_path / "r/judge/report.md").read_text()
