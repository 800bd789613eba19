"""Raw ranges of one's own: exact on a simulated sky, equal to a recorded set, refused in words, run as a new user does."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from checkout import ROOT
from command_line import block, pfbench
from recorded_data import DATA, recorded
from refusals import check_refused

from pfbench import job
from pfbench.core import Episode, PhiloxStream
from pfbench.filter import GaussianFilter, TaylorLinearisation, run_filter
from pfbench.job.config import compose_tree
from pfbench.logs.sky import raw_log
from pfbench.logs.sky.ephemeris import GM_GPS, read_rinex
from pfbench.logs.sky.rinex_observations import SIGNALS, read_observations
from pfbench.logs.units import WEEK
from pfbench.logs.worlds.log_frames import DEGREE
from pfbench.logs.worlds.log_tables import ReferenceLog
from pfbench.logs.worlds.raw_gnss import remove_clock_jumps
from pfbench.logs.worlds.rinex_source import RinexSource
from pfbench.logs.worlds.signal_weights import SignalWeights
from pfbench.nav import earth
from pfbench.nav.orbits import LIGHT, sagnac
from pfbench.noise.base import NominalNoise

RUNS = torch.arange(2)
RANGE, RATE = (
    0.005,
    0.001,
)  # m, m/s: files have millimetres, and the antenna moves 3 mm in the 0.3 ms of its clock


def scene(root: Path, name: str, *words: str) -> Any:
    cfg = compose_tree([f"scenario={name}", f"data.root={root}", "scenario.folder=drive", *words])
    return job.instantiate(cfg.scenario), job.instantiate(cfg.model)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("raw")
    raw_log.write_raw_log(folder / "drive", 30.0, 0.0)
    return folder


def errors(episode: Episode, model: Any) -> np.ndarray:
    """Measurements of run 0 less what the model expects at the truth, [T, 2 S], as a clock that is the nominal one has them."""
    still = 0.0 * episode.truth["position"][..., :1]
    clocks = dict.fromkeys(("clock_bias", "clock_drift", "inter_system_bias"), still)
    truth = model.assemble({**episode.truth, **clocks})
    rows = [
        episode.record.y[:1, t]
        - model.observation(truth[:1, t, None], episode.record.at_step(t).u).mean[:, 0]
        for t in range(episode.record.y.shape[1])
    ]
    return torch.cat(rows).numpy()


@pytest.mark.parametrize("name", ["user_raw_log", "user_ins_log"])
def test_ranges_of_a_simulated_sky_are_what_the_model_expects_at_the_truth(
    root: Path, name: str
) -> None:
    """Transmission, rotation of the Earth, relativity, group delay, troposphere, ionosphere and clock: no error is left."""
    scenario, model = scene(root, name, "scenario.receiver.mask_deg=5")
    off = errors(scenario.draw(NominalNoise(), RUNS, 1), model)
    seen = np.isfinite(off)
    satellites = off.shape[1] // 2
    assert satellites >= 8
    assert seen.any(1).sum() == 30
    assert np.nanmax(np.abs(off[:, :satellites])) < RANGE
    assert np.nanmax(np.abs(off[:, satellites:])) < RATE


def test_a_filter_is_consistent_on_ranges_with_the_stated_errors(tmp_path: Path) -> None:
    """Noise of 1 m and 0.1 m/s, weights of the same size, a steady clock: NIS per component is 1 within four standard errors.

    The level accelerations of the drive are not white; they are 2 of 18 directions.
    """
    raw_log.write_raw_log(tmp_path / "drive", 120.0, 1.0)
    scenario, model = scene(
        tmp_path, "user_raw_log", "scenario.receiver.weights.elevation_sd=0", "scenario.receiver.weights.cn0_sd=1.0e-3",
        "scenario.tuning.rate.floor_sd=0.1", "scenario.tuning.rate.stated_sd_factor=0",
        "scenario.tuning.clock.bias_walk=1.0e-3", "scenario.tuning.clock.drift_walk=1.0e-3",
        "scenario.tuning.acceleration_density=[0.8,0.8,0.001]",
    )  # fmt: skip
    episode = scenario.draw(NominalNoise(), RUNS, 1)
    nis: list[tuple[float, int]] = []

    def watch(t: int, info: Any) -> dict[str, torch.Tensor]:
        values, counts = info.nis()
        nis.append((float(values[0]), int(counts[0])))
        return {}

    result = run_filter(
        GaussianFilter(TaylorLinearisation()), model, episode.record, PhiloxStream(1, RUNS), watch
    )
    total, size = (float(a) for a in np.array(nis[20:]).sum(0))
    assert total / size == pytest.approx(1.0, abs=4.0 * (2.0 / size) ** 0.5)
    error = (result.mean[..., :2] - episode.truth["position"][..., :2])[:, 20:]
    assert float(error.square().sum(-1).mean().sqrt()) < 1.0


# a log that moves without a reference

NOISE = ("scenario.tuning.range.stated_sd_factor=0", "scenario.tuning.rate.stated_sd_factor=0", "scenario.tuning.rate.floor_sd=0.1")  # fmt: skip


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A drive of two minutes with ranges of 1 m, and no place in the header; its truth is beside the folder."""
    folder = tmp_path_factory.mktemp("alone")
    raw_log.write_raw_log(folder / "drive", 120.0, 1.0)
    (folder / "drive" / "reference.csv").rename(folder / "truth.csv")
    return folder


def test_point_solutions_have_the_stated_errors(alone: Path) -> None:
    """Mean squared errors over the stated variances are 1 within four standard errors, by component, also of the place."""
    scenario, _ = scene(alone, "user_raw_log", "scenario.reference=null", *NOISE)
    _, grid, _, points = scenario._read()
    _, centre = scenario._read_truth(alone / "drive", scenario.rinex.read_epochs(alone / "drive"))
    at = torch.tensor([centre[0] * DEGREE, centre[1] * DEGREE, centre[2]], dtype=torch.float64)
    truth = pd.read_csv(alone / "truth.csv")
    place = torch.from_numpy(truth[["lat_deg", "lon_deg", "h_m"]].to_numpy() * [DEGREE, DEGREE, 1.0])  # fmt: skip
    true = np.stack([np.interp(grid, truth["t"], p) for p in earth.local_enu(place, at).numpy().T], -1)  # fmt: skip
    assert np.linalg.norm(true[0]) < 15.0  # the origin is the first solution
    off = points.position - true
    square = (off - off.mean(0)) ** 2 / points.position_sd**2
    np.testing.assert_allclose(square.mean(0), 1.0, atol=4.0 * (2.0 / len(grid)) ** 0.5)
    speed = np.hypot(truth["vn"], truth["ve"])
    difference = np.hypot(*points.velocity[:, :2].T) - np.interp(grid, truth["t"], speed)
    assert np.sqrt((difference**2).mean()) < 0.3


def test_each_epoch_is_held_out_once_and_is_the_only_truth(alone: Path) -> None:
    scenario, _ = scene(alone, "user_raw_log", "scenario.reference=null")
    episode = scenario.draw(NominalNoise(), torch.arange(5), 1)
    held = torch.isfinite(episode.truth["position"]).all(-1)
    assert (held.sum(0) == 1).all()
    assert torch.isnan(episode.record.y[held]).all()
    assert torch.isfinite(episode.record.y[~held]).any(-1).all()
    assert set(episode.truth) == {"position"}
    assert episode.measured_truth is not None
    assert episode.measured_truth.name == "held-out point solutions"
    start = episode.record.start
    assert start is not None
    assert torch.equal(start, start[:1].expand_as(start))


def test_a_log_without_a_reference_names_the_key_that_gives_an_answer(
    alone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(alone)
    words = ["run", f"data.root={alone}", "scenario=user_raw_log", "scenario.folder=drive", "filter=ekf", "runs=5", "study=alone"]  # fmt: skip
    refused = pfbench(*words, home=alone)
    assert refused.code == 2
    remedy = re.search(r"Without one set (scenario\.reference=null)", refused.err)
    assert remedy, refused.err
    answered = pfbench(*words, remedy[1], home=alone)
    assert answered.code == 0, answered.err
    assert "5 of 5 runs valid" in answered.out
    report = pfbench("report", "study=alone", home=alone)
    assert report.code == 0, report.err
    text = (alone / "reports" / "alone" / "report.md").read_text()
    assert (
        "Errors are distances to held-out point solutions, which have errors of their own." in text
    )


def test_a_log_with_too_few_satellites_is_refused(alone: Path) -> None:
    scenario, _ = scene(
        alone, "user_raw_log", "scenario.reference=null", "scenario.receiver.mask_deg=60"
    )
    check_refused(
        [
            (
                r"have 2 epochs whose satellites show a position, got \d+\. Use a longer log",
                lambda: scenario.draw(NominalNoise(), RUNS, 1),
            )
        ],
        remedy=False,
    )


# an existing data set, whose satellites another program computed


def walk_as_rinex(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Write the ranges of the walk as RINEX files; returns its rows, and those of the navigation file."""
    folder.mkdir(exist_ok=True)
    rows = pd.read_parquet(Path(DATA or "") / "walk_tc_mems" / "pseudorange.parquet")
    orbits = pd.read_parquet(Path(DATA or "") / "walk_tc_mems" / "ephemeris.parquet")
    galileo = orbits["sys"] == "E"
    orbits["week"], orbits["health"], orbits["ttx"] = 2381.0, 0.0, orbits["toe"]
    orbits["codes"] = np.where(galileo, 517.0, 1.0)
    orbits["iode"] = orbits["iode"].fillna(0.0)
    orbits["iodc"] = np.where(galileo, orbits["tgd"], orbits["iodc"])
    orbits = orbits.assign(l2p=0.0, ura=0.0)
    raw = rows.assign(time=2381 * WEEK + rows["tow"], doppler=-rows["prr"] * 1575.42e6 / LIGHT)
    raw_log.write_observations(folder / "walk.obs", raw)
    raw_log.write_navigation(folder / "walk.nav", orbits)
    return rows, orbits


@recorded
@pytest.mark.parametrize("is_of_the_source", [True, False])
def test_the_walk_written_as_rinex_has_the_satellites_of_its_table(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_of_the_source: bool
) -> None:
    """Clocks to 0.1 mm, troposphere to 1 cm, and positions to a millimetre where the table's own choices are taken.

    The table rotates by pseudorange / c, which contains the receiver's clock of 1.5 ms, and propagates Galileo with the
    constant of gravity of GPS: 3 m and 1 m. With pfbench's choices the satellites are that far away.
    """
    rows, _ = walk_as_rinex(tmp_path / "drive")
    if is_of_the_source:
        monkeypatch.setattr(earth, "GM", GM_GPS)
    source = RinexSource(gps_time=2381 * WEEK + float((rows["tow"] - rows["t"]).iloc[0]))
    epochs = source.read_epochs(tmp_path / "drive")
    assert np.abs(epochs.rows["t"].to_numpy() - rows["t"].to_numpy()).max() < 1e-6
    assert np.abs(epochs.rows["pr"].to_numpy() - rows["pr"].to_numpy()).max() < 6e-4
    centre = (40.0967388700055, -105.14708736222939, 1577.4480057330802)
    still = np.zeros((2, 3))
    track = ReferenceLog(rows["t"].iloc[[0, -1]].to_numpy(), np.full((2, 4), np.nan), still, still)
    table = source.compute_sky(tmp_path / "drive", epochs, track, centre).rows
    key = ["t", "sys", "svid"]
    both = table.assign(t=table["t"].round(3)).merge(
        rows.assign(t=rows["t"].round(3)), on=key, suffixes=("", "_2")
    )
    assert len(both) == len(rows)
    position = torch.from_numpy(both[["sx", "sy", "sz"]].to_numpy().copy())
    place = torch.tensor([centre[0] * DEGREE, centre[1] * DEGREE, centre[2]], dtype=torch.float64)
    flight = (position - earth.ecef(place)).norm(dim=-1) / LIGHT
    turned = sagnac(position, torch.from_numpy(both["pr"].to_numpy().copy()) / LIGHT - flight)
    off = (
        (turned - torch.from_numpy(both[["sx_2", "sy_2", "sz_2"]].to_numpy().copy()))
        .norm(dim=-1)
        .numpy()
    )
    gps = (both["sys"] == "G").to_numpy()
    assert off[gps].max() < 2e-3
    if is_of_the_source:
        assert off.max() < 0.02  # E14 falls 0.1 ms with another gravity
    else:
        assert 0.1 < off[~gps].max() < 1.5
    assert np.abs(both["sclk"] - both["sclk_2"]).max() < 1e-4
    assert np.abs(both["sclkd"] - both["sclkd_2"]).max() < 1e-6
    assert np.abs(both["prr"] - both["prr_2"]).max() < 1e-3
    assert np.abs(both["tropo"] - both["tropo_2"]).max() < 0.01
    if not is_of_the_source:
        apart = (
            position - torch.from_numpy(both[["sx_2", "sy_2", "sz_2"]].to_numpy().copy())
        ).norm(dim=-1)
        assert 2.0 < float(apart.max()) < 5.0


@recorded
def test_the_walk_written_as_rinex_runs_as_its_table_does(tmp_path: Path) -> None:
    """Same IMU, ranges and reference: positions of the EKF are those of `recorded_walk` but for a common shift."""
    walk_as_rinex(tmp_path / "drive")
    for table in ("imu", "reference"):
        rows = pd.read_parquet(Path(DATA or "") / "walk_tc_mems" / f"{table}.parquet")
        rows.to_csv(tmp_path / "drive" / f"{table}.csv", index=False)
    start = 2381 * WEEK + 408641.0
    words = ("scenario.start_s=15", "scenario.end_s=80", f"scenario.rinex.gps_time={start}")
    origin = "scenario.origin=[40.0967388700055,-105.14708736222939,1577.4480057330802]"
    scenario, model = scene(tmp_path, "user_ins_log", *words, origin)
    cfg = compose_tree(["scenario=recorded_walk", f"data.root={DATA}", "scenario.end_s=80", "scenario.receiver.range_sd=0", "scenario.receiver.rate_sd=0"])  # fmt: skip
    table_scene, table_model = job.instantiate(cfg.scenario), job.instantiate(cfg.model)
    scenario = replace(scenario, tuning=replace(scenario.tuning, motion=table_scene.tuning.motion))
    model = type(model)(scenario.tuning)
    horizontal = []
    for one, law in ((scenario, model), (table_scene, table_model)):
        episode = one.draw(NominalNoise(), RUNS, 1)
        result = run_filter(
            GaussianFilter(TaylorLinearisation()), law, episode.record, PhiloxStream(1, RUNS)
        )
        error = law.error(result.mean, law.assemble(episode.truth))[..., 6:8]
        horizontal.append(float(error.square().sum(-1).mean().sqrt()))
    assert horizontal[0] < 2.0
    assert abs(horizontal[0] - horizontal[1]) < 1.5


# files


def test_optional_observations_and_both_systems_are_read(tmp_path: Path) -> None:
    """Blank and zero values are missing; the first code that a system has is read; other systems are said."""
    rows = pd.DataFrame({
        "time": [2381 * WEEK + 10.0] * 3, "sys": ["G", "E", "R"], "svid": [3, 11, 5], "pr": [2.1e7, 2.4e7, 2e7],
        "doppler": [np.nan, -100.0, 5.0], "cn0": [40.0, np.nan, 30.0],
    })  # fmt: skip
    raw_log.write_observations(tmp_path / "a.obs", rows, (1e6, 2e6, 6e6))
    text = (tmp_path / "a.obs").read_text()
    (tmp_path / "a.obs").write_text(text.replace("E    3 C1C D1C S1C", "E    3 C1X D1X S1X"))
    content = read_observations(tmp_path / "a.obs", SIGNALS)
    assert content.rows["svid"].tolist() == [3, 11]
    assert content.rows["time"].tolist() == [2381 * WEEK + 10.0] * 2
    assert content.rows["pr"].tolist() == [2.1e7, 2.4e7]
    assert np.isnan(content.rows["doppler"][0])
    assert content.rows["doppler"][1] == -100.0
    assert np.isnan(content.rows["cn0"][1])
    assert content.position == (1e6, 2e6, 6e6)
    assert any("systems R are not read" in note for note in content.notes)
    assert any("C1X of E is read" in note for note in content.notes)


def spoilt(root: Path, tmp_path: Path, file: str, *changes: tuple[str, str]) -> Path:
    """Copy the drive with changes of one of its files."""
    for source in (root / "drive").iterdir():
        text = source.read_text()
        for old, new in changes if source.name == file else ():
            assert old in text
            text = text.replace(old, new, 1)
        (tmp_path / "drive").mkdir(exist_ok=True)
        (tmp_path / "drive" / source.name).write_text(text)
    return tmp_path


HATANAKA = "3.0                 COMPACT RINEX FORMAT                    CRINEX VERS   / TYPE\n"
FIRST = "     3.04           OBSERVATION DATA    M                   RINEX VERSION / TYPE"


@pytest.mark.parametrize(
    ("file", "change", "words"),
    [
        ("drive.obs", (FIRST, HATANAKA + FIRST), "crx2rnx drive.obs"),
        ("drive.obs", ("     3.04 ", "     2.11 "), "gfzrnx"),
        ("drive.obs", ("     GPS         TIME", "     GLO         TIME"), "GPS time"),
        ("drive.obs", ("C1C", "C5Q"), "scenario.rinex.signals"),
        ("drive.obs", ("END OF HEADER", "END OF HEATER"), "END OF HEADER"),
        ("drive.obs", ("> 2025 08 28 17 30  3.0", "> 2025 08 28 17 xx  3.0"), "first line of an epoch"),
        ("drive.obs", ("OBSERVATION DATA", "METEOROLOGICAL  "), "scenario.rinex.observations"),
        ("drive.nav", ("N: GNSS NAV DATA", "O: GNSS NAV DATA"), "scenario.rinex.observations"),
        ("reference.csv", ("t,", "time,"), "column t"),
    ],
)  # fmt: skip
def test_bad_files_are_refused_with_a_remedy(root: Path, tmp_path: Path, file: str, change: tuple[str, str], words: str) -> None:  # fmt: skip
    scenario, _ = scene(spoilt(root, tmp_path, file, change), "user_raw_log")
    check_refused(
        [(words.replace("(", r"\("), lambda: scenario.draw(NominalNoise(), RUNS, 1))], remedy=False
    )


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("scenario.rinex.gps_time=2025-08-28T17:30:41",), "scenario.rinex.gps_time"),
        (("scenario.rinex.gps_time=yesterday",), "ISO date"),
        (("scenario.rinex.signals={G: [5Q]}",), "1575.42"),
        (("scenario.standing=header",), "scenario.standing"),
        (("scenario.standing=roof",), "scenario.standing must be header"),
        (("scenario.receiver.weights=null",), "scenario.receiver.weights"),
        (("scenario.receiver.weights.cn0_sd=0", "scenario.receiver.weights.elevation_sd=0"), "elevation_sd or cn0_sd"),
        (("scenario.start_s=500000",), "earlier start"),
        (("scenario.rinex.observations=no.obs",), "scenario.rinex.observations"),
    ],
)  # fmt: skip
def test_bad_keys_are_refused_with_a_remedy(
    root: Path, words: tuple[str, ...], message: str
) -> None:
    with pytest.raises(Exception, match=message.replace(".", r"\.")):
        scene(root, "user_raw_log", *words)[0].draw(NominalNoise(), RUNS, 1)


def test_the_clock_of_the_tables_is_a_key(root: Path, tmp_path: Path) -> None:
    """Tables that count from the start, and the GPS time of their zero."""
    spoilt(root, tmp_path, "")
    table = pd.read_csv(tmp_path / "drive" / "reference.csv")
    table["t"] -= table["t"][0]
    table.to_csv(tmp_path / "drive" / "reference.csv", index=False)
    scenario, model = scene(tmp_path, "user_raw_log", "scenario.rinex.gps_time=2025-08-28T17:30:00")
    episode = scenario.draw(NominalNoise(), RUNS, 1)
    assert episode.time[0] == pytest.approx(1.0)
    assert np.nanmax(np.abs(errors(episode, model)[:, : episode.record.y.shape[-1] // 2])) < RANGE


def test_a_damaged_epoch_is_dropped_and_an_event_is_skipped(root: Path, tmp_path: Path) -> None:
    event = "> 2025 08 28 17 30  3.0000000  4  2\nsome\nthing\n> 2025 08 28 17 30  3.0"
    folder = spoilt(root, tmp_path, "drive.obs", ("> 2025 08 28 17 30  3.0", event)) / "drive"
    whole = read_observations(root / "drive" / "drive.obs", SIGNALS)
    content = read_observations(folder / "drive.obs", SIGNALS)
    assert content.rows.equals(whole.rows)
    assert any("1 records of events" in note for note in content.notes)
    text = (folder / "drive.obs").read_text().splitlines()
    (folder / "drive.obs").write_text("\n".join(text[:-2]) + "\n")
    cut = read_observations(folder / "drive.obs", SIGNALS)
    assert len(cut.rows) < len(whole.rows)
    assert any("is dropped" in note for note in cut.notes)


def test_rinex_4_is_rinex_3_in_blocks(root: Path, tmp_path: Path) -> None:
    """Records of LNAV are read, those of CNAV are said, and the ionosphere stands in a block."""
    lines = (root / "drive" / "drive.nav").read_text().splitlines()
    records = [lines[i : i + 8] for i in range(4, len(lines), 8)]
    blocks = [line for r in records for line in (f"> EPH {r[0][:3]} LNAV", *r)]
    cnav = [f"> EPH {records[0][0][:3]} CNAV", *records[0], "    1.0"]
    a, b = raw_log.IONOSPHERE[:4], raw_log.IONOSPHERE[4:]
    cells = [f"{value:19.12E}" for value in (*a, *b)]
    stamp = "    2025 08 28 17 30 00"
    ion = [
        "> ION G01 LNAV",
        stamp + "".join(cells[:3]),
        "    " + "".join(cells[3:7]),
        "    " + cells[7],
    ]
    head = [
        f"{'     4.02           NAVIGATION DATA     M':60}RINEX VERSION / TYPE",
        f"{'':60}END OF HEADER",
    ]
    (tmp_path / "four.nav").write_text("\n".join([*head, *cnav, *blocks, *ion]) + "\n")
    three, four = read_rinex(root / "drive" / "drive.nav"), read_rinex(tmp_path / "four.nav")
    assert four.rows.drop(columns="line").equals(three.rows.drop(columns="line"))
    assert four.ionosphere == pytest.approx(three.ionosphere)
    assert three.ionosphere == pytest.approx(raw_log.IONOSPHERE)
    assert any("messages CNAV" in note for note in four.notes)


def test_other_systems_and_satellites_without_ephemeris_are_said(
    root: Path, tmp_path: Path
) -> None:
    folder = spoilt(root, tmp_path, "drive.obs") / "drive"
    rows = read_observations(folder / "drive.obs", SIGNALS).rows
    more = rows[rows["svid"] == rows["svid"][0]].assign(svid=31)
    raw_log.write_observations(
        folder / "drive.obs", pd.concat([rows, more, more.assign(sys="C", svid=7)])
    )
    episode = scene(folder.parent, "user_raw_log")[0].draw(NominalNoise(), RUNS, 1)
    assert any("no ephemeris in use for G31" in note for note in episode.notes)
    assert any("systems C are not read" in note for note in episode.notes)


def test_an_antenna_that_stands_needs_no_table(root: Path, tmp_path: Path) -> None:
    """Ranges of one place, without Doppler and strength: the truth is the position in the header."""
    folder = spoilt(root, tmp_path, "drive.obs") / "drive"
    for table in ("imu.csv", "reference.csv"):
        (folder / table).unlink()
    rows = read_observations(folder / "drive.obs", SIGNALS).rows
    at = [v * DEGREE for v in raw_log.ORIGIN[:2]]
    place = earth.ecef(torch.tensor([*at, raw_log.ORIGIN[2]], dtype=torch.float64)).tolist()
    first = rows[rows["time"] <= rows["time"][0] + 3.0].assign(doppler=np.nan, cn0=np.nan)
    raw_log.write_observations(folder / "drive.obs", first, (place[0], place[1], place[2]))
    scenario, model = scene(tmp_path, "user_raw_log", "scenario.standing=header")
    episode = scenario.draw(NominalNoise(), RUNS, 1)
    satellites = episode.record.y.shape[-1] // 2
    assert torch.isnan(episode.record.y[..., satellites:]).all()
    assert any("no observation D" in note for note in episode.notes)
    assert (episode.truth["position"] == 0.0).all()
    off = errors(episode, model)[0, :satellites]
    assert np.nanmax(np.abs(off)) < 40.0  # the drive left the place by ten metres per second
    assert {f.name for f in scenario.input_files()} == {"drive.obs", "drive.nav"}


# the laws of the parts


def test_jumps_of_whole_milliseconds_leave_the_clock() -> None:
    time = np.arange(8.0)
    ranges = 100.0 * time[:, None] + np.arange(4) + np.random.default_rng(0).normal(size=(8, 4))
    spoilt_ranges = ranges.copy()
    spoilt_ranges[3:] += LIGHT * 1e-3
    spoilt_ranges[6:] -= LIGHT * 2e-3
    spoilt_ranges[4] = np.nan
    mended, notes = remove_clock_jumps(spoilt_ranges, time)
    assert np.nanmax(np.abs(mended - ranges)) < 1e-6
    assert "2 jumps" in notes[0]
    same, none = remove_clock_jumps(ranges, time)
    assert same is ranges
    assert none == ()


def test_weights_are_the_sum_of_elevation_and_strength() -> None:
    weights = SignalWeights(0.5, 0.3, 0.05, 0.02)
    elevation, strength = np.radians([90.0, 30.0, 30.0]), np.array([45.0, 45.0, 25.0])
    ranges, rates = weights.sd(elevation, strength)
    assert ranges**2 == pytest.approx([0.25 + 0.09, 1.0 + 0.09, 1.0 + 9.0])
    assert rates**2 == pytest.approx([25e-4 + 4e-4, 1e-2 + 4e-4, 1e-2 + 4e-2])
    assert weights.sd(elevation[:1], np.array([np.nan]))[0] == pytest.approx(ranges[:1])


def test_a_new_user_runs_and_reports_from_a_folder(root: Path, tmp_path: Path) -> None:
    """Two commands, from an empty folder beside the log."""
    words = ("scenario=user_raw_log", "scenario.folder=drive", "filter=ekf", "runs=2", "study=mine")
    done = pfbench("run", f"data.root={root}", *words, f"results_dir={tmp_path}", home=tmp_path)
    assert done.code == 0, done.err
    reports = f"reports_dir={tmp_path / 'reports'}"
    done = pfbench("report", "study=mine", f"results_dir={tmp_path}", reports, home=tmp_path)
    assert done.code == 0, done.err
    page = (tmp_path / "reports" / "mine" / "index.html").read_text()
    assert "drive.obs" in page


def test_the_page_raw_ranges_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    page = (ROOT / "docs" / "howto" / "raw_ranges.md").read_text()
    for language, code in re.findall(r"```(python|bash)\n(.*?)```", page, re.DOTALL):
        if language == "python":
            exec(compile(code, "raw_ranges.md", "exec"), {})
        else:
            block(code, tmp_path)
    assert len(list(tmp_path.glob("results/*/*.npz"))) == 4
    assert len(page.splitlines()) <= 60
