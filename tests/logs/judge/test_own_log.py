"""Import of own logs: files of other programs, written by the test from one drive, become the same tables."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from command_line import pfbench
from refusals import check_refused
from scipy.spatial.transform import Rotation
from synthetic_log import drive

from pfbench.logs.judge.judge_options import SourceOptions
from pfbench.logs.judge.own_log import import_table

SECONDS, RATE = 40, 50
ORIGIN = (48.0, 11.0, 500.0)
ARC = (
    np.pi / 180 * 6.37e6
)  # m of a degree, for files whose positions are only compared with themselves


def motion(rate: int = RATE) -> dict[str, np.ndarray]:
    return drive(np.arange(SECONDS * rate + 1) / rate)


def table(names: list[str], rate: int = RATE) -> pd.DataFrame:
    return pd.DataFrame({name: motion(rate)[name] for name in names})


IMU = ["t", "fx", "fy", "fz", "wx", "wy", "wz"]
POSE = ["t", "pn", "pe", "pd", "vn", "ve", "vd", "roll", "pitch", "yaw"]


def geodetic(rate: int) -> np.ndarray:
    m = motion(rate)
    return np.stack(
        [
            ORIGIN[0] + m["pn"] / ARC,
            ORIGIN[1] + m["pe"] / (ARC * np.cos(np.radians(ORIGIN[0]))),
            ORIGIN[2] - m["pd"],
        ],
        -1,
    )


def save(path: Path, rows: np.ndarray, digits: str = "%.10f", head: str = "") -> Path:
    np.savetxt(path, rows, fmt=digits, header=head, comments="")
    return path


def write_named(folder: Path) -> tuple[str, Path, SourceOptions]:
    own = {"time": "t", "ax": "fx", "ay": "fy", "az": "fz", "gx": "wx", "gy": "wy", "gz": "wz"}
    rows = table(IMU).set_axis(list(own), axis=1)
    rows["time"] *= 1e3
    rows.to_csv(folder / "a.csv", index=False)
    columns = {new: old for old, new in own.items()}
    return "imu", folder / "a.csv", SourceOptions(time="ms", columns=columns)


def write_increments(folder: Path) -> tuple[str, Path, SourceOptions]:
    """Increments of KF-GINS end at their time: those of the mean of two samples."""
    m = table(IMU).to_numpy()
    middle = 0.5 * (m[1:] + m[:-1])
    rows = np.column_stack([m[1:, 0], middle[:, 4:7] / RATE, middle[:, 1:4] / RATE])
    return "imu", save(folder / "imu.txt", rows, "%.12f"), SourceOptions()


def write_euroc_imu(folder: Path) -> tuple[str, Path, SourceOptions]:
    m = table(IMU).to_numpy()
    rows = np.column_stack([np.rint(m[:, 0] * 1e9), m[:, 4:7], m[:, 1:4]])
    head = "#timestamp [ns],w_x,w_y,w_z,a_x,a_y,a_z"
    np.savetxt(folder / "data.csv", rows, fmt=["%d", *["%.12f"] * 6], delimiter=",", header=head, comments="")  # fmt: skip
    return "imu", folder / "data.csv", SourceOptions()


def enu_quaternion() -> np.ndarray:
    """Rotation from forward-left-up to East-North-Up, x, y, z, w."""
    m = motion()
    ned = Rotation.from_euler("ZYX", np.stack([m["yaw"], m["pitch"], m["roll"]], -1)).as_matrix()
    to_enu = np.array([[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    return Rotation.from_matrix(to_enu @ ned @ np.diag([1.0, -1.0, -1.0])).as_quat()


def write_tum(folder: Path) -> tuple[str, Path, SourceOptions]:
    """Under a suffix that says nothing."""
    m = motion()
    rows = np.column_stack([m["t"], m["pe"], m["pn"], -m["pd"], enu_quaternion()])
    return "reference", save(folder / "truth.log", rows), SourceOptions(frame="enu")


def write_kf_gins(folder: Path) -> tuple[str, Path, SourceOptions]:
    m = motion()
    rows = np.column_stack(
        [np.full(len(m["t"]), 2000), m["t"], geodetic(RATE), m["vn"], m["ve"], m["vd"],
         *(np.degrees(m[a]) for a in ("roll", "pitch", "yaw"))]
    )  # fmt: skip
    return "reference", save(folder / "truth.nav", rows), SourceOptions()


def write_fixes(folder: Path) -> tuple[str, Path, SourceOptions]:
    rows = np.column_stack([motion(1)["t"], geodetic(1), np.ones((SECONDS + 1, 3))])
    return "gnss", save(folder / "gnss.txt", rows), SourceOptions()


def write_rtklib(folder: Path) -> tuple[str, Path, SourceOptions]:
    start = pd.Timestamp("2024-01-07 00:00:00")  # first second of a GPS week
    lines = [
        "% program : RTKPOST",
        "%  GPST          latitude(deg) longitude(deg)  height(m)   Q  ns",
    ]
    for t, p in zip(motion(1)["t"], geodetic(1), strict=True):
        stamp = (start + pd.Timedelta(seconds=float(t))).strftime("%Y/%m/%d %H:%M:%S.000")
        lines.append(f"{stamp} {p[0]:.10f} {p[1]:.10f} {p[2]:.4f} 1 12")
    (folder / "rover.pos").write_text("\n".join(lines) + "\n")
    return "gnss", folder / "rover.pos", SourceOptions()


def write_kitti(folder: Path) -> Path:
    data = folder / "drive" / "oxts" / "data"
    data.mkdir(parents=True)
    m, place = motion(10), geodetic(10)
    start = pd.Timestamp("2011-09-26 13:02:25")
    stamps = [
        (start + pd.Timedelta(seconds=float(t))).strftime("%Y-%m-%d %H:%M:%S.%f") for t in m["t"]
    ]
    (data.parent / "timestamps.txt").write_text("\n".join(stamps) + "\n")
    for i in range(len(m["t"])):
        packet = np.zeros(30)
        packet[:3] = place[i]
        packet[3:6] = m["roll"][i], -m["pitch"][i], np.pi / 2 - m["yaw"][i]
        packet[6:8] = m["vn"][i], m["ve"][i]
        packet[11:14] = m["fx"][i], -m["fy"][i], -m["fz"][i]
        packet[17:20] = m["wx"][i], -m["wy"][i], -m["wz"][i]
        (data / f"{i:010d}.txt").write_text(" ".join(f"{v:.12f}" for v in packet))
    return folder / "drive"


WRITERS: dict[str, tuple[Callable[[Path], tuple[str, Path, SourceOptions]], float]] = {
    "names": (write_named, 1e-9),
    "increments": (
        write_increments,
        2e-3,
    ),  # chords of 20 ms of changes of 1 m/s^2 and 0.1 rad/s in a second
    "euroc": (write_euroc_imu, 1e-9),
    "tum": (write_tum, 1e-3),  # velocities by differences over 20 ms
    "kf_gins": (write_kf_gins, 1e-6),
    "fixes": (write_fixes, 1e-6),
    "rtklib": (write_rtklib, 1e-3),
}


@pytest.mark.parametrize("name", WRITERS)
def test_a_file_of_each_kind_is_the_drive(tmp_path: Path, name: str) -> None:
    write, tolerance = WRITERS[name]
    role, path, options = write(tmp_path)
    rows = import_table(role, path, options).rows
    m = motion(RATE if role != "gnss" else 1)
    t = rows["t"].to_numpy()
    truth = dict(m) | dict(zip(["lat_deg", "lon_deg", "h_m"], geodetic(RATE if role != "gnss" else 1).T, strict=True))  # fmt: skip
    assert len(rows) >= SECONDS
    wanted = {"imu": set(IMU), "gnss": {"t", "lat_deg", "lon_deg", "h_m"}, "reference": {"t", "vn", "yaw"}}  # fmt: skip
    assert wanted[role] <= set(rows)
    for column in rows.columns.drop("fix", errors="ignore"):
        expected = np.interp(t, m["t"], truth[column])
        inner = slice(1, -1)  # differences at the ends are of first order
        np.testing.assert_allclose(rows[column].to_numpy()[inner], expected[inner], atol=tolerance)


def test_a_folder_of_kitti_gives_all_three_tables(tmp_path: Path) -> None:
    folder, m = write_kitti(tmp_path), motion(10)
    for role in ("imu", "gnss", "reference"):
        rows = import_table(role, folder, SourceOptions()).rows
        for column in set(rows) & set(m):
            atol = 0.1 if column == "vd" else 1e-6
            np.testing.assert_allclose(rows[column], m[column], atol=atol)


def write_all(folder: Path) -> list[str]:
    """Files of a drive, and the words that import them."""
    write_named(folder)
    write_rtklib(folder)
    reference = table(POSE)
    reference[["lat_deg", "lon_deg", "h_m"]] = geodetic(RATE)
    reference.drop(columns=["pn", "pe", "pd"]).to_csv(folder / "truth.csv", index=False)
    return [
        f"imu={folder / 'a.csv'}", "imu.columns=t:time,fx:ax,fy:ay,fz:az,wx:gx,wy:gy,wz:gz", "imu.time=ms",
        f"gnss={folder / 'rover.pos'}", f"reference={folder / 'truth.csv'}", "fix_codes=rtklib",
    ]  # fmt: skip


def test_the_command_writes_the_log_and_inspects_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    said = pfbench("import", "my_log", *write_all(tmp_path), home=tmp_path)
    assert said.code == 0, said.out + said.err
    assert "codes of RTKLIB" in said.out
    assert sorted(f.name for f in (tmp_path / "my_log").iterdir()) == ["gnss.csv", "imu.csv", "reference.csv"]  # fmt: skip
    assert (tmp_path / "reports" / "inspect_my_log" / "index.html").is_file()
    again = pfbench("import", "my_log", *write_all(tmp_path), home=tmp_path)
    assert (again.code, "must be a new folder" in again.err) == (2, True)


BAD = {
    "file": (["imu=none.csv"], "imu must be a file, got none at none.csv"),
    "column": (
        ["imu.columns=t:clock"],
        "a.csv: columns must exist, got clock. Choose from time, ax",
    ),
    "unit": (["imu.time=min"], "imu.time must be s, ms, us, ns, minutes or hours, got min"),
    "kind": (["gnss.format=euroc"], "gnss must be of a format with such data, got euroc"),
    "word": (["imu.sd=1"], "words must be FOLDER, imu=, gnss=, reference="),
}


@pytest.mark.parametrize("case", BAD)
def test_what_cannot_be_imported_is_told_and_nothing_is_written(tmp_path: Path, case: str) -> None:
    words, said = BAD[case]
    keys = {word.partition("=")[0] for word in words}
    kept = [w for w in write_all(tmp_path) if w.partition("=")[0] not in keys]
    result = pfbench("import", tmp_path / "my_log", *kept, *words, home=tmp_path)
    assert result.code == 2
    assert said in result.err
    assert not list(tmp_path.glob("*my_log*"))


def test_repeated_times_are_refused_or_the_first_is_kept(tmp_path: Path) -> None:
    rows = table(IMU).iloc[[0, 1, 1, 2, 3]]
    rows.to_csv(tmp_path / "a.csv", index=False)
    check_refused(
        [
            (
                r"imu must have one row for each time, got 1 rows",
                lambda: import_table("imu", tmp_path / "a.csv", SourceOptions()),
            )
        ],
        remedy=False,
    )
    kept = import_table("imu", tmp_path / "a.csv", SourceOptions(repeats="first"))
    assert len(kept.rows) == 4
    assert "1 rows that repeat a time left out" in kept.notes
    options = SourceOptions(repeats="first", scale={"fz": -2.0})
    assert np.allclose(import_table("imu", tmp_path / "a.csv", options).rows["fz"], -2.0 * kept.rows["fz"])  # fmt: skip
    table(IMU).iloc[[0, 0, 0, 0, 1]].to_csv(tmp_path / "b.csv", index=False)
    check_refused(
        [("have lost digits", lambda: import_table("imu", tmp_path / "b.csv", options))],
        remedy=False,
    )
