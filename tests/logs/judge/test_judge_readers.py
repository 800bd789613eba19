"""One track written in each format is read as the same trajectory."""

from pathlib import Path

import judge_cases as cases
import numpy as np
from refusals import check_refused
from scipy.spatial.transform import Rotation

from pfbench.logs.judge.formats import list_trajectory_files, read_trajectories
from pfbench.logs.judge.judge_options import JudgeOptions, SourceOptions
from pfbench.logs.judge.reference_track import read_reference
from pfbench.logs.judge.trajectory_table import to_north_east_down
from pfbench.results.store import write_result

POSITION = ["pn", "pe", "pd"]


def read(path: Path, **options: object):
    (table,) = read_trajectories(path, SourceOptions(**options))
    return table


def rotations(truth):
    """Rotations from a body with forward, right, down to North, East, Down, by scipy."""
    return Rotation.from_euler("ZYX", truth[["yaw", "pitch", "roll"]].to_numpy().copy())


def test_tum_of_both_frames(tmp_path: Path) -> None:
    truth = cases.drive(30.0)
    to_ned = Rotation.from_matrix([[0, 1, 0], [1, 0, 0], [0, 0, -1]])
    body = Rotation.from_matrix(np.diag([1.0, -1.0, -1.0]))
    position = truth[POSITION].to_numpy().copy()
    for frame, p, q in (
        ("ned", position, rotations(truth)),
        ("enu", to_ned.inv().apply(position), to_ned.inv() * rotations(truth) * body.inv()),
    ):
        file = tmp_path / f"{frame}.tum"
        np.savetxt(file, np.column_stack([truth.t, p, q.as_quat()]), fmt="%.12f", header="t x y z")
        table = read(file, frame=frame)
        assert np.allclose(table.select(("pn", "pe", "pd")), position, atol=1e-9)
        angles = table.select(("roll", "pitch", "yaw"))
        assert np.allclose(angles, truth[["roll", "pitch", "yaw"]], atol=1e-9)


def test_kf_gins_with_deviations(tmp_path: Path) -> None:
    truth = cases.drive(30.0)
    angles = np.degrees(truth[["roll", "pitch", "yaw"]])
    rows = np.column_stack(
        [0 * truth.t, truth.t, cases.geodetic(truth), truth[["vn", "ve", "vd"]], angles]
    )
    np.savetxt(tmp_path / "result.nav", rows, fmt="%.12f")
    sd = np.column_stack(
        [
            truth.t,
            np.tile([1, 2, 3, 0.1, 0.2, 0.3, 1, 1, 2], (len(truth), 1)),
            np.ones((len(truth), 12)),
        ]
    )
    np.savetxt(tmp_path / "std.txt", sd)
    (table,) = read_trajectories(
        tmp_path / "result.nav", SourceOptions(sd=str(tmp_path / "std.txt"))
    )
    local = to_north_east_down(table.select(("lat_deg", "lon_deg", "h_m")), np.array(cases.ORIGIN))
    assert np.abs(local - truth[POSITION].to_numpy()).max() < 1e-4
    assert np.allclose(table.values["yaw"], truth.yaw)
    assert table.values["sd_pe"][3] == 2.0
    assert np.isclose(table.values["sd_yaw"][3], np.radians(2.0))
    np.savetxt(tmp_path / "late.txt", sd + np.eye(1, 22) * 0.5)
    check_refused(
        [
            (
                r"late.txt must have the times of result.nav",
                lambda: read_trajectories(
                    tmp_path / "result.nav", SourceOptions(sd=str(tmp_path / "late.txt"))
                ),
            )
        ],
        remedy=False,
    )


def test_nmea_through_midnight(tmp_path: Path) -> None:
    truth = cases.drive(30.0)
    (tmp_path / "log.nmea").write_text(cases.nmea(truth, start_s=86390.0))
    table = read(tmp_path / "log.nmea", shift=-86390.0)
    assert np.allclose(table.time, truth.t)
    local = to_north_east_down(table.select(("lat_deg", "lon_deg", "h_m")), np.array(cases.ORIGIN))
    assert np.abs(local - truth[POSITION].to_numpy()).max() < 1e-2
    assert np.abs(table.select(("vn", "ve")) - truth[["vn", "ve"]].to_numpy()).max() < 1e-3


def test_nmea_with_a_wrong_checksum(tmp_path: Path) -> None:
    text = cases.nmea(cases.drive(10.0))
    (tmp_path / "log.nmea").write_text(text.replace(",N,", ",S,", 1))
    check_refused(
        [(r"log.nmea: line 1 must have the checksum", lambda: read(tmp_path / "log.nmea"))],
        remedy=False,
    )
    (tmp_path / "log.nmea").write_text("$GPGSV,1,1,01,09*00\r\n" + text)
    assert "1 damaged sentences of kinds that are not read" in read(tmp_path / "log.nmea").notes


def test_local_frame_is_that_of_the_ellipsoid() -> None:
    """One second of arc at 48 degrees north is 30.887 m north and 20.728 m east (tables of WGS-84)."""
    origin = np.array([48.0, 11.0, 0.0])
    second = 1 / 3600
    moved = to_north_east_down(
        origin + np.array([[second, 0, 0], [0, second, 0], [0, 0, 5.0]]), origin
    )
    assert np.allclose(moved, [[30.887, 0, 0], [0, 20.728, 0], [0, 0, -5.0]], atol=2e-3)


def test_results_of_pfbench(tmp_path: Path) -> None:
    truth = cases.drive(20.0)
    rng, steps = np.random.default_rng(0), len(truth)
    error = rng.normal(size=(2, steps, 3))
    track = np.stack([truth.pe, truth.pn, -truth.pd], -1)
    names = ["position_E", "position_N", "position_U"]
    state = {"names": names, "units": ["m"] * 3, "groups": {"position": [0, 1, 2]}}
    meta = {
        "key": "k",
        "study": "s",
        "choices": {},
        "config": {},
        "label": "l",
        "seed": 1,
        "runs": 2,
        "state": state,
    }
    data = {
        "time": truth.t.to_numpy(),
        "error": error,
        "sd": np.ones_like(error),
        "nees": np.ones((2, steps, 1)),
    }
    lost = np.zeros(2, dtype=bool)
    more = {"log_evidence": np.zeros(2), "lost": lost, "track": np.stack([track, track])}
    file = write_result(tmp_path / "k.npz", meta, {**data, **more})
    tables = read_trajectories(file, SourceOptions())
    assert [table.run for table in tables] == [0, 1]
    assert np.allclose(tables[1].values["pe"], truth.pe + error[1, :, 0])
    assert np.allclose(tables[1].values["pd"], truth.pd - error[1, :, 2])


def test_reference_is_interpolated_with_its_velocity(tmp_path: Path) -> None:
    truth = cases.drive(60.0, 0.1)
    coarse = cases.write(truth.iloc[::20], tmp_path / "truth.csv")
    reference = read_reference(coarse, JudgeOptions(largest_gap=3.0), SourceOptions())
    error = reference.interpolate_position(truth.t.to_numpy()) - truth[POSITION].to_numpy()
    linear = np.interp(truth.t, truth.t[::20], truth.pn[::20]) - truth.pn
    assert np.abs(error).max() < 0.02 < 0.3 < np.abs(linear).max()


def test_patterns_name_sequence_and_run(tmp_path: Path) -> None:
    for sequence in ("a", "b"):
        for run in (1, 2):
            cases.write(cases.drive(5.0), tmp_path / sequence / f"out_{run}.csv")
    files = list_trajectory_files(f"{tmp_path}/{{sequence}}/out_{{run}}.csv")
    assert [(f.sequence, f.run) for f in files] == [("a", "1"), ("a", "2"), ("b", "1"), ("b", "2")]
    check_refused(
        [
            (
                "must match a file, got none",
                lambda: list_trajectory_files(f"{tmp_path}/{{sequence}}/no_{{run}}.csv"),
            )
        ],
        remedy=False,
    )
