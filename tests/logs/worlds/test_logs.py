"""Reading logs: frames, layouts, and a plain word about everything that can be wrong with one."""

import re
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from checkout import ROOT
from command_line import block
from pymap3d import ned2geodetic
from refusals import check_refused
from scipy.spatial.transform import Rotation
from synthetic_log import GRAVITY, ORIGIN, drive, tables, write

from pfbench.logs.units import STANDARD_GRAVITY
from pfbench.logs.worlds.log_reader import read_log
from pfbench.logs.worlds.log_tables import LogFiles, swap_frd_rfu

Log = dict[str, pd.DataFrame]
TO_ENU = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_everything_becomes_right_forward_up_and_east_north_up(tmp_path: Path, suffix: str) -> None:
    log = read_log(write(tmp_path, tables(), suffix))
    there = drive(log.reference.time)
    assert np.allclose(
        log.reference.position, np.stack([there["pe"], there["pn"], -there["pd"]], -1)
    )
    assert np.allclose(
        log.reference.velocity, np.stack([there["ve"], there["vn"], -there["vd"]], -1)
    )
    assert np.allclose(log.imu.force[:, 2], GRAVITY)
    assert np.allclose(log.imu.force[:, 1], drive(log.imu.time)["fx"])
    assert np.allclose(log.imu.rate[:, 2], -drive(log.imu.time)["wz"])
    assert log.gravity == STANDARD_GRAVITY
    assert "does not contain its location" in log.notes[0]


def test_attitude_is_the_same_turn_in_other_axes(tmp_path: Path) -> None:
    log = tables()
    roll, pitch, yaw = 0.7, -1.1, 2.5
    log["reference"] = log["reference"].assign(roll=roll, pitch=pitch, yaw=yaw)
    log["imu"] = log["imu"].assign(wz=0.0)
    q = read_log(write(tmp_path, log)).reference.attitude[0]
    ned = Rotation.from_euler(
        "ZYX", [yaw, pitch, roll]
    ).as_matrix()  # body FRD to NED: yaw, then pitch, then roll
    assert np.allclose(
        Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), TO_ENU @ ned @ TO_ENU.T, atol=1e-12
    )


def test_the_change_of_axes_is_a_rotation_and_its_own_inverse() -> None:
    a, b = np.random.default_rng(1).normal(size=(2, 5, 3))
    assert np.array_equal(swap_frd_rfu(swap_frd_rfu(a)), a)
    assert np.allclose(swap_frd_rfu(a), a @ TO_ENU.T)
    assert np.allclose(swap_frd_rfu(np.cross(a, b)), np.cross(swap_frd_rfu(a), swap_frd_rfu(b)))


def geodetic(log: Log, names: tuple[str, ...]) -> Log:
    for name in names:
        t = log[name]
        t["lat_deg"], t["lon_deg"], t["h_m"] = ned2geodetic(
            t.pn.to_numpy(), t.pe.to_numpy(), t.pd.to_numpy(), *ORIGIN
        )
        log[name] = t.drop(columns=["pn", "pe", "pd"])
    return log


def test_latitudes_become_metres_about_the_origin(tmp_path: Path) -> None:
    plain = read_log(write(tmp_path / "plain", tables()))
    log = read_log(write(tmp_path / "both", geodetic(tables(), ("gnss",))), origin=ORIGIN)
    # coordinates in a CSV of full precision; the two mappings are exact
    assert np.allclose(log.fixes.position, plain.fixes.position, atol=1e-6)
    assert log.gravity == pytest.approx(
        9.7968, abs=1e-3
    )  # 40 degrees North, 1500 m: 9.8017 - 3.086e-6 * 1500
    own = read_log(write(tmp_path / "own", geodetic(tables(), ("gnss", "reference"))))
    assert np.allclose(own.reference.position[0], 0.0, atol=1e-9)
    moved, expected = (
        part.reference.position - part.reference.position[0] for part in (own, plain)
    )
    assert np.allclose(moved, expected, atol=0.02)  # the tangent plane is another one, 3 m higher


def test_an_origin_in_the_metadata_is_used(tmp_path: Path) -> None:
    import pyarrow as pa
    from pyarrow import parquet

    log = geodetic(tables(), ("gnss",))
    folder = write(tmp_path, log, ".parquet")
    stated = {
        f"origin_{key}": str(value)
        for key, value in zip(("lat_deg", "lon_deg", "h_m"), ORIGIN, strict=True)
    }
    parquet.write_table(
        pa.Table.from_pandas(log["reference"]).replace_schema_metadata(stated),
        folder / "reference.parquet",
    )
    read = read_log(folder)
    assert np.allclose(read.fixes.position[:, 1], tables()["gnss"].pn, atol=1e-6)
    assert read.notes == ()


def test_flights_and_sensors_of_one_table_are_told_apart(tmp_path: Path) -> None:
    log = tables()
    second = {name: table.copy() for name, table in log.items()}
    second["reference"]["pd"] += 50.0
    parts = [(1, 1, log), (1, 2, log), (2, 1, second)]
    whole: Log = {
        "imu": pd.concat([part["imu"].assign(path=path, imu=imu) for path, imu, part in parts])
    }
    for name in ("gnss", "reference"):
        whole[name] = pd.concat([log[name].assign(path=1), second[name].assign(path=2)])
    folder = write(tmp_path, whole, ".parquet")
    first, other = read_log(folder, path=1, imu=2), read_log(folder, path=2, imu=1)
    assert len(first.imu.time) == len(other.imu.time) == len(log["imu"])
    assert np.allclose(first.reference.position[:, 2] - other.reference.position[:, 2], 50.0)
    check_refused(
        [
            (
                r"column path must have one value, got \[1, 2\]. Select one of them with path=",
                lambda: read_log(folder, imu=1),
            ),
            (r"must have rows with imu=2, got \[1\]", lambda: read_log(folder, path=2, imu=2)),
        ],
        remedy=False,
    )


def test_fixes_may_come_from_the_reference(tmp_path: Path) -> None:
    log = tables()
    del log["gnss"]
    read = read_log(write(tmp_path, log), LogFiles(gnss="reference"))
    assert np.array_equal(read.fixes.position, read.reference.position)
    assert np.array_equal(read.fixes.velocity, read.reference.velocity)


def test_a_slipped_time_tag_goes_back_and_is_told(tmp_path: Path) -> None:
    for slip in (0.01, -0.01):
        log = tables()
        log["imu"].loc[500, "t"] += slip
        read = read_log(write(tmp_path, log))
        assert np.allclose(np.diff(read.imu.time), 0.01)
        assert "repeats a time next to a double step" in read.notes[0]


def edit(name: str, column: str, change: Callable[[pd.Series], object]) -> Callable[[Log], None]:
    def apply(log: Log) -> None:
        log[name][column] = change(log[name][column])

    return apply


def scale(name: str, columns: str, factor: float) -> Callable[[Log], None]:
    def apply(log: Log) -> None:
        log[name][columns.split()] *= factor

    return apply


def put(name: str, row: int, column: str, value: object) -> Callable[[Log], None]:
    def apply(log: Log) -> None:
        log[name][column] = log[name][column].astype(object)
        log[name].loc[row, column] = value

    return apply


def drop(name: str, column: str) -> Callable[[Log], None]:
    def apply(log: Log) -> None:
        log[name] = log[name].drop(columns=column)

    return apply


def far_north(log: Log) -> None:
    geodetic(log, ("gnss", "reference"))["gnss"]["lat_deg"] = 140.0


def one_geodetic(log: Log) -> None:
    geodetic(log, ("gnss",))


def cut_out(log: Log) -> None:
    log["imu"] = log["imu"].drop(index=range(400, 440))


def no_rows(log: Log) -> None:
    log["gnss"] = log["gnss"].iloc[:1]


def left_up(log: Log) -> None:
    log["imu"][["fy", "fz", "wy", "wz"]] *= -1


BAD: dict[str, tuple[Callable[[Log], None], str]] = {
    "missing column": (drop("imu", "fy"), r"imu\.csv must have a column fy, got t, fx, fz.*Rename"),
    "no position": (drop("gnss", "pe"), r"gnss\.csv must have a column pe"),
    "NaN": (
        put("imu", 7, "wz", np.nan),
        r"imu\.csv: column wz must have finite numbers, got nan in line 9 \(1 such rows\)",
    ),
    "text": (
        put("reference", 2, "roll", "n/a?"),
        r"reference\.csv: column roll .*got n/a\? in line 4",
    ),
    "infinite": (put("gnss", 0, "pn", np.inf), r"gnss\.csv: column pn .*got inf in line 2"),
    "duplicate": (
        put("gnss", 4, "t", 0.6),
        r"gnss\.csv: column t .*got 0\.6 after 0\.6 in line 6, which repeats the previous time",
    ),
    "backwards": (
        put("imu", 50, "t", 0.1),
        r"imu\.csv: column t .*got 0\.1 after 0\.49 in line 52.*goes back.*remove line 52",
    ),
    "imu in ms": (
        scale("imu", "t", 1e3),
        r"imu\.csv: column t .*got a median interval of 10.*in ms, multiply by 0\.001",
    ),
    "imu in us": (scale("imu", "t", 1e6), r"in us, multiply by 1e-06"),
    "imu in ns": (scale("imu", "t", 1e9), r"in ns, multiply by 1e-09"),
    "gnss in ms": (scale("gnss", "t", 1e3), r"gnss\.csv: column t.*in ms"),
    "in g": (
        scale("imu", "fx fy fz", 1 / GRAVITY),
        r"have a median norm of 1\.\d+, .*they are in g\. Multiply by 9\.80665",
    ),
    "odd force": (
        scale("imu", "fx fy fz", 100.0),
        r"column fz must be between -400 and 400 m/s\^2, got -980\.665 .*in cm/s\^2, multiply by 0\.01",
    ),
    "z up": (
        left_up,
        r"axes disagree.*forward, right, down are the axes \[x, -y, -z\]",
    ),
    "fast in deg/s": (
        scale("imu", "wx wy wz", 3e3),
        r"column wz must be .*got 720 in line 2.*in deg/s, multiply by 0\.01745",
    ),
    "slow in deg/s": (
        scale("imu", "wx wy wz", 180 / np.pi),
        r"wx, wy, wz are 57\.3 times the turns of the reference: they are in deg/s\. Multiply by 0\.0174",
    ),
    "other sense": (
        scale("imu", "wz", -1.0),
        r"imu\.csv and reference\.csv: axes disagree.*wx, wy, wz alone have other axes, \[x, y, -z\]",
    ),
    "yaw in degrees": (
        scale("reference", "yaw", 180 / np.pi),
        r"reference\.csv: .*in degrees.*Multiply by 0\.0174",
    ),
    "pitch in degrees": (
        edit("reference", "pitch", lambda p: p + 5.0),
        r"column pitch .*got 5 in line 2.*If in degrees, multiply",
    ),
    "no overlap": (
        edit("gnss", "t", lambda t: t + 1e6),
        r"imu\.csv and gnss\.csv must overlap.*t = 0\.000 to 20\.000 and t = 10.*clock",
    ),
    "reference elsewhere": (
        edit("reference", "t", lambda t: t - 100),
        r"imu\.csv and reference\.csv must overlap in time",
    ),
    "gap": (
        cut_out,
        r"imu\.csv: no sample for 0\.410 s after t = 3\.990.*Keep the longest part",
    ),
    "one row": (no_rows, r"gnss\.csv must have at least 2 rows, got 1"),
    "no origin": (
        one_geodetic,
        r"gnss\.csv and reference\.csv must both have .*lat_deg.*Set scenario\.origin=",
    ),
    "latitude": (far_north, r"column lat_deg .*got 140 in line 2"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_wrong_is_said_with_its_place_and_remedy(tmp_path: Path, name: str) -> None:
    spoil, message = BAD[name]
    log = tables()
    spoil(log)
    check_refused([(message, lambda: read_log(write(tmp_path, log)))], remedy=False)


def test_rows_of_parquet_are_counted_from_0(tmp_path: Path) -> None:
    log = tables()
    log["imu"].loc[7, "wz"] = np.nan
    check_refused(
        [
            (
                r"imu\.parquet: column wz .*got nan in row 7 \(from 0\)",
                lambda: read_log(write(tmp_path, log, ".parquet")),
            )
        ],
        remedy=False,
    )


def test_a_missing_or_doubled_table_is_named(tmp_path: Path) -> None:
    write(tmp_path, tables())
    check_refused(
        [
            (
                r"must contain gps\.parquet or gps\.csv.*as a folder",
                lambda: read_log(tmp_path, LogFiles(gnss="gps")),
            )
        ],
        remedy=False,
    )
    write(tmp_path, tables(), ".parquet")
    check_refused(
        [(r"both imu\.parquet and imu\.csv. Delete one", lambda: read_log(tmp_path))], remedy=False
    )


def test_parquet_without_pyarrow_says_what_to_install(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write(tmp_path, tables(), ".parquet")
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    check_refused(
        [
            (
                r"needs pyarrow. Run pip install 'pfbench\[data\]', or store the log as CSV",
                lambda: read_log(tmp_path),
            )
        ],
        remedy=False,
    )


@pytest.mark.parametrize("origin", [(40.0, 5.0), (140.0, 5.0, 0.0)])
def test_an_impossible_origin_is_refused(tmp_path: Path, origin: tuple[float, ...]) -> None:
    check_refused(
        [
            (
                r"origin must be lat_deg .*, lon_deg, h_m, got \[",
                lambda: read_log(write(tmp_path, tables()), origin=origin),
            )
        ],
        remedy=False,
    )


PAGE = ROOT / "docs" / "use_your_data.md"
BLOCK = re.compile(r"^```(python|bash)\n(.*?)^```", re.DOTALL | re.MULTILINE)


@pytest.mark.slow
def test_the_page_use_your_data_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    names: dict[str, object] = {}
    for language, code in BLOCK.findall(PAGE.read_text()):
        if language == "python":
            exec(compile(code, PAGE.name, "exec"), names)
        else:
            block(code, tmp_path)
    said = capsys.readouterr().out
    assert "3000 samples, 30 fixes" in said
    assert "wx, wy, wz are 57.3 times the turns of the reference" in said
    assert len(list(tmp_path.glob("results/*/*.npz"))) == 4
    assert (tmp_path / "track.gpx").read_text().count("<trk>") == 2
    assert "refuse axes" in said
    assert (tmp_path / "reports" / "inspect_my_log" / "scenario" / "suggested.yaml").is_file()
    # 1 Hz fixes of 1.5, 1.5 and 3 m: no worse than the fixes
    assert (
        0.0
        < float(re.search(r"position error ([\d.]+) m", said)[1])
        < np.sqrt(1.5**2 + 1.5**2 + 3.0**2)
    )
