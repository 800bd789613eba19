"""The answer for a log without a reference: what is held out, intervals against the truth, files, and the command."""

from pathlib import Path
from xml.etree import ElementTree as Tree

import numpy as np
import pandas as pd
import pytest
import synthetic_log
import torch

import pfbench
from pfbench.cli.main import main
from pfbench.job import TrackEstimate
from pfbench.logs.judge.track_page import describe_track, measure_held_out
from pfbench.nav import earth

PLACE = (40.0, -105.0, 1500.0)
STEPS = ("scenario.filter_step_s=0.5",)
GPX = "{http://www.topografix.com/GPX/1/1}"


def write_log(
    folder: Path, *, is_local: bool = False, seed: int = 8, lasts: float = 0.0
) -> pd.DataFrame:
    """Writes imu and gnss of a noisy drive of 60 s, with errors of the fixes that last, s; returns the exact motion."""
    tables, rng = synthetic_log.tables(60.0), np.random.default_rng(seed)
    imu, gnss = tables["imu"], tables["gnss"].iloc[::5][["t", "pn", "pe", "pd"]]
    imu[["fx", "fy", "fz"]] += 0.2 * rng.normal(size=(len(imu), 3))
    imu[["wx", "wy", "wz"]] += 0.02 * rng.normal(size=(len(imu), 3))
    gnss = gnss.reset_index(drop=True)
    errors, keep = rng.normal(size=(len(gnss), 3)), np.exp(-1.0 / lasts) if lasts else 0.0
    for k in range(1, len(errors)):
        errors[k] = keep * errors[k - 1] + np.sqrt(1.0 - keep**2) * errors[k]
    gnss[["pn", "pe", "pd"]] += errors * [1.5, 1.5, 3.0]
    if not is_local:
        enu = torch.from_numpy(gnss[["pe", "pn", "pd"]].to_numpy() * [1.0, 1.0, -1.0])
        scale = np.array([np.pi / 180, np.pi / 180, 1.0])
        at = earth.from_local_enu(enu, torch.from_numpy(np.array(PLACE) * scale)).numpy() / scale
        gnss = pd.DataFrame(np.column_stack([gnss.t, at]), columns=["t", "lat_deg", "lon_deg", "h_m"])  # fmt: skip
    synthetic_log.write(folder, {"imu": imu, "gnss": gnss})
    return tables["reference"]


@pytest.fixture(scope="module")
def local(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, pd.DataFrame, TrackEstimate]:
    folder = tmp_path_factory.mktemp("logs") / "drive"
    true = write_log(folder, is_local=True)
    return folder, true, pfbench.estimate_track(folder, ["ekf", "student"], STEPS)


def errors(estimate: TrackEstimate, true: pd.DataFrame, state: np.ndarray) -> np.ndarray:
    """East, North, Up errors of a track, [T, 3]."""
    exact = [sign * np.interp(estimate.time, true.t, true[c]) for c, sign in (("pe", 1), ("pn", 1), ("pd", -1))]  # fmt: skip
    return state[:, 7:] - np.stack(exact, -1)


def test_each_fix_behind_the_start_is_held_out_once(local: tuple) -> None:
    _, _, estimate = local
    fixes = estimate.fixes[estimate.fixes[:, 0] > estimate.time[0] - 0.5 + 1e-6, 0]
    np.testing.assert_allclose(
        np.sort(estimate.held_out_time), fixes[fixes <= estimate.time[-1] + 1e-6]
    )
    assert "1 of every 5, in 5 passes" in estimate.rule


def test_a_held_out_fix_does_not_reach_its_pass(local: tuple, tmp_path: Path) -> None:
    """A fix moved by 300 m: the distances to it grow by 300 m in the pass that did not get it."""
    folder, _, before = local
    moved = tmp_path / "drive"
    moved.mkdir()
    gnss = pd.read_csv(folder / "gnss.csv")
    row = len(gnss) - 1
    gnss.loc[row, "pe"] += 300.0
    gnss.to_csv(moved / "gnss.csv", index=False)
    (moved / "imu.csv").write_bytes((folder / "imu.csv").read_bytes())
    after = pfbench.estimate_track(moved, ["ekf"], STEPS)
    at = np.isclose(before.held_out_time, gnss.t[row])
    assert at.sum() == 1
    change = (after.answers[0].filtered.held_out - before.answers[0].filtered.held_out)[at]
    np.testing.assert_allclose(change, [[-300.0, 0.0, 0.0]], atol=1e-6)


def test_intervals_hold_and_smoothing_helps(local: tuple) -> None:
    _, true, estimate = local
    answer = estimate.answers[0]
    late = estimate.time > 15.0
    filtered, smoothed = (errors(estimate, true, m.state)[late] for m in (answer.filtered, answer.smoothed))  # fmt: skip
    assert np.square(smoothed).sum() < 0.6 * np.square(filtered).sum()
    # errors of one run are correlated: about ten independent ones of each axis
    for motion, error in ((answer.filtered, filtered), (answer.smoothed, smoothed)):
        assert np.square(error / motion.sd[late, 6:]).mean() < 3.0
        inside = np.abs(error) < 1.96 * motion.sd[late, 6:]
        assert inside.mean() > 0.75
    ratio = measure_held_out(answer.filtered).ratio
    assert abs(ratio - 1.0) < 5.0 * np.sqrt(2.0 / estimate.held_out_time.size / 3)
    dof = answer.dof.sum()
    assert dof == 3 * len(answer.nis)
    assert abs(answer.nis.sum() / dof - 1.0) < 5.0 * np.sqrt(2.0 / dof)
    assert not estimate.fix_errors.is_clear  # once in a hundred logs at most


@pytest.mark.parametrize("seed", range(4))
def test_intervals_hold_for_errors_that_last(tmp_path: Path, seed: int) -> None:
    """Errors of 20 s in fixes: each coordinate of a track has about three independent ones, of which two in a thousand leave 4 sd."""
    true = write_log(tmp_path / "drive", is_local=True, seed=seed, lasts=20.0)
    estimate = pfbench.estimate_track(tmp_path / "drive", ["ekf"], STEPS)
    found, answer = estimate.fix_errors, estimate.answers[0]
    assert found.is_clear
    assert found.white < 0.3
    assert 5.0 < found.time_s < 80.0
    for motion in (answer.filtered, answer.smoothed):
        share = errors(estimate, true, motion.state) / motion.sd[:, 6:]
        assert np.abs(share).max() < 4.0
        assert np.square(share).mean() < 1.0 + 3.0 * np.sqrt(2.0 / 9.0)
    assert abs(measure_held_out(answer.filtered).ratio - 1.0) < 5.0 * np.sqrt(2.0 / estimate.held_out_time.size / 3)  # fmt: skip
    text = "\n".join(describe_track(estimate))
    assert "their errors last" in text
    assert "too large" not in text


def test_a_filter_without_a_smoother_says_so(local: tuple) -> None:
    _, _, estimate = local
    assert estimate.answers[1].smoothed is None
    assert set(estimate.tracks()) == {"ekf", "student", "ekf smoothed"}
    text = "\n".join(describe_track(estimate))
    for words in ("ekf and student:", "held-out fixes", "mean NIS per component"):  # fmt: skip
        assert words in text


def test_a_table_has_the_columns_of_a_reference(local: tuple, tmp_path: Path) -> None:
    """The smoothed track is a reference of an own log: `read_log` accepts it with the imu that it came from."""
    folder, true, estimate = local
    table = estimate.table(estimate.answers[0].best)
    yaw = np.interp(table.t, true.t, true.yaw)
    late = table.t > 15.0
    off = (table.yaw - yaw + np.pi) % (2 * np.pi) - np.pi
    assert (np.abs(off)[late] < 4.0 * table.sd_yaw[late]).all()
    for name in ("vn", "ve", "vd", "pn", "pe", "pd"):
        error = table[name] - np.interp(table.t, true.t, true[name])
        assert (np.abs(error)[late] < 5.0 * table[f"sd_{name}"][late]).all(), name
    copy = tmp_path / "judged"
    copy.mkdir()
    for name in ("imu", "gnss"):
        (copy / f"{name}.csv").write_bytes((folder / f"{name}.csv").read_bytes())
    table.to_csv(copy / "reference.csv", index=False)
    assert len(pfbench.scenario.read_log(copy).reference.time) == len(table)


def test_a_local_log_has_no_place_on_a_map(local: tuple) -> None:
    _, _, estimate = local
    with pytest.raises(
        ValueError, match=r"must contain its place for GPX and KML.*scenario\.origin=\["
    ):
        estimate.to_gpx()


def test_the_command_writes_page_tables_and_maps(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    write_log(tmp_path / "drive")
    main(["estimate", "drive", "filter=ekf", *STEPS])
    said = capsys.readouterr().out
    assert "horizontally from" in said
    home = tmp_path / "reports" / "estimate_drive"
    assert f"report: {home / 'index.html'}" in said
    table = pd.read_csv(home / "ekf_smoothed.csv")
    track = Tree.parse(home / "track.gpx").getroot().findall(f"{GPX}trk")[1]
    points = track.findall(f"{GPX}trkseg/{GPX}trkpt")
    read = np.array([[float(p.attrib[key]) for key in ("lat", "lon")] for p in points])
    np.testing.assert_allclose(read, table[["lat_deg", "lon_deg"]], atol=2e-8)
    assert abs(read[0, 0] - PLACE[0]) < 1e-2
    assert "clampToGround" in (home / "track.kml").read_text()
    first = {f.name: f.read_bytes() for f in home.iterdir() if f.is_file()}
    main(["estimate", "drive", "filter=ekf", *STEPS])
    assert {f.name: f.read_bytes() for f in home.iterdir() if f.is_file()} == first


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ((), "estimate must have one folder, got none"),
        (("none_here",), "the log must be a folder with imu and gnss, got /"),
        (
            (".", "filter="),
            "filter must be a list of distinct entries separated by commas, got ''. Default: filter=ekf,ukf",
        ),
        ((".", "scenario.holdout=null"), "must be an own log with held-out fixes"),
    ],
)
def test_wrong_words_are_refused(
    words: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    with pytest.raises(SystemExit) as error:
        main(["estimate", *words])
    assert error.value.code == 2
    assert message in capsys.readouterr().err
    assert not (tmp_path / "reports").exists()
