"""Real motion for simulated sensors: axes and units from the file to the sensors, and the recorded drive itself."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from recorded_data import DATA, recorded
from synthetic_log import GRAVITY, ORIGIN, drive, write

from pfbench.core.random_stream import PhiloxStream
from pfbench.filter import GaussianFilter, TaylorLinearisation, run_filter
from pfbench.job import ScoreRecorder, instantiate
from pfbench.job.config import compose_tree
from pfbench.logs.worlds.trajectory_file import RecordedTrajectory, read_motion
from pfbench.nav import attitude, earth
from pfbench.noise.base import NominalNoise
from pfbench.scenario.flights import SimulatedFlight


@pytest.fixture(scope="module")
def table() -> pd.DataFrame:
    """30 s of a level drive through bends at 20 Hz, from t = 100 s on."""
    motion = drive(np.arange(601) / 20)
    columns = ["t", "pn", "pe", "pd", "vn", "ve", "vd", "roll", "pitch", "yaw"]
    return pd.DataFrame({c: motion[c] for c in columns}).assign(t=motion["t"] + 100.0)


@pytest.fixture(scope="module")
def path(table: pd.DataFrame, tmp_path_factory: pytest.TempPathFactory) -> RecordedTrajectory:
    root = tmp_path_factory.mktemp("data")
    write(root / "bends", {"trajectory": table})
    return RecordedTrajectory(str(root), "bends", ORIGIN)


def test_sensors_feel_what_the_drive_does(path: RecordedTrajectory) -> None:
    flight = path.generate(50.0)
    there = drive((np.arange(1500) + 0.5) / 50)
    force = np.stack([there["fy"], there["fx"], np.full(1500, GRAVITY)], -1)  # right, forward, up
    rate = np.stack([there["wx"], there["wx"], -there["wz"]], -1)
    # left out there: Coriolis 2 w V = 1.8e-3, gravity at 40 degrees and 1.5 km instead of 9.80665, the Earth's rate 7.3e-5
    assert np.abs(flight.dv[:, :2].numpy() * 50 - force[:, :2]).max() < 4e-3
    assert np.abs(flight.dv[:, 2].numpy() * 50 - force[:, 2]).max() < 1.5e-2
    inner = slice(100, -100)  # at its ends a spline of attitude has no angular acceleration
    assert np.abs(flight.dtheta.numpy() * 50 - rate)[inner].max() < 2e-4


def test_places_speeds_and_attitudes_are_those_of_the_file(path: RecordedTrajectory) -> None:
    flight = path.generate(20.0)
    there = drive(np.arange(601) / 20)
    centre = torch.tensor([np.radians(ORIGIN[0]), np.radians(ORIGIN[1]), ORIGIN[2]])
    enu = earth.local_enu(flight.pos, centre).numpy()
    assert (
        np.abs(enu[:, 0] - there["pe"]).max() < 5e-3
    )  # the tables' positions are sums of steps of 2 ms
    assert np.abs(enu[:, 1] - there["pn"]).max() < 5e-3
    assert (
        np.abs(flight.pos[:, 2].numpy() - (ORIGIN[2] - 3.0)).max() < 1e-6
    )  # pd = 3: below the origin
    assert (
        np.abs(flight.vel.numpy() - np.stack([there["ve"], there["vn"], 0 * there["vd"]], -1)).max()
        < 2e-3
    )
    pitch, roll, yaw = attitude.euler_from_dcm(flight.dcm).T.numpy()
    assert np.abs(yaw + there["yaw"])[40:-40].max() < 1e-5
    assert (
        np.abs(yaw + there["yaw"]).max() < 1e-3
    )  # at its ends a spline of attitude has no angular acceleration
    assert max(np.abs(pitch).max(), np.abs(roll).max()) < 1e-9


def test_tilts_have_the_signs_of_forward_right_down(table: pd.DataFrame, tmp_path: Path) -> None:
    write(
        tmp_path,
        {"trajectory": table.assign(roll=0.1, pitch=0.2, vd=-1.0, pd=-(table["t"] - 100.0))},
    )
    motion = read_motion(tmp_path, "trajectory", ORIGIN)
    # nose up, right wing down, climbing
    assert (motion.dcm[:, 2, 1] > 0.0).all()
    assert (motion.dcm[:, 2, 0] < 0.0).all()
    assert (motion.vel[:, 2] == 1.0).all()
    assert motion.pos[-1, 2] - motion.pos[0, 2] == pytest.approx(30.0)


def test_start_and_end_cut_the_path(path: RecordedTrajectory) -> None:
    part, whole = replace(path, start_s=104.0, end_s=117.3).generate(20.0), path.generate(20.0)
    assert part.time[-1] == 13.0
    assert torch.allclose(
        part.pos[20:-20] * 1e6, whole.pos[100:321] * 1e6, rtol=0.0, atol=1e-3
    )  # ends of splines differ: mm
    assert replace(path, use_full_log=4.0).generate(20.0).time[-1] == 28.0


def test_the_key_of_a_world_holds_the_file_and_the_options_but_not_the_place(
    path: RecordedTrajectory, table: pd.DataFrame, tmp_path: Path
) -> None:
    write(tmp_path / "bends", {"trajectory": table})
    assert repr(replace(path, root=str(tmp_path))) == repr(path)
    write(tmp_path / "bends", {"trajectory": table.assign(pd=table["pd"] + 1e-3)})
    others = [
        replace(path, root=str(tmp_path)),
        replace(path, knot_interval_s=0.5),
        replace(path, end_s=120.0),
        replace(path, use_full_log=2.0),
    ]
    assert (
        len({repr(other) for other in [path, *others, replace(path, origin=[0.0, 0.0, 0.0])]}) == 6
    )


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"root": None}, r"data\.root is not set.*PFBENCH_DATA.*bends/"),
        ({"folder": "elsewhere"}, r"data\.root must contain the folder elsewhere"),
        ({"file": "other"}, r"must contain other\.parquet or other\.csv"),
        (
            {"start_s": 120.0, "end_s": 110.0},
            r"end_s must be later than start_s = 120\.0, got 110\.0",
        ),
        (
            {"start_s": 200.0},
            r"got 200\.0 and None. The file covers t = 100\.000 to 130\.000",
        ),
        ({"origin": [95.0, 0.0, 0.0]}, r"origin must be .* got \[95\.0, 0\.0, 0\.0\]"),
        ({"knot_interval_s": 0.06}, r"must be at least twice .*0\.050 s after .* got 0\.06"),
    ],
)
def test_what_cannot_be_flown_is_refused(
    path: RecordedTrajectory, changes: dict[str, object], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        replace(path, **changes).generate(20.0)


def composed(*overrides: str) -> tuple[SimulatedFlight, object]:
    cfg = compose_tree(["scenario=recorded_boreas", "episode_cache_dir=null", *overrides])
    return tuple(instantiate(cfg[part]) for part in ("scenario", "model"))


@recorded
def test_the_recorded_drive_is_followed_within_its_own_errors() -> None:
    scenario, _ = composed("scenario.trajectory.end_s=120")
    flight, record = (
        scenario.trajectory.generate(20.0),
        read_motion(Path(DATA or "") / "boreas_truth", "trajectory", scenario.trajectory.origin),
    )
    t = record.time[record.time < flight.time[-1]].numpy()

    def errors(a: torch.Tensor, b: torch.Tensor) -> torch.Tensor:
        at = np.stack([np.interp(t, flight.time.numpy(), column) for column in a.numpy().T], -1)
        return torch.from_numpy(at) - b[: len(t)]

    metres = errors(flight.pos, record.pos) * earth.metre_scale(record.pos[0])
    assert (
        metres.square().mean(0).sqrt().max() < 0.02
    )  # "centimetre class"; joining by chords adds a d^2 / 8 = 1 mm
    # the sheet: velocity against differenced position 0.05, 0.06, 0.008 m/s; heave faster than the knots is smoothed away
    assert (
        errors(flight.vel, record.vel).square().mean(0).sqrt() < torch.tensor([0.08, 0.08, 0.04])
    ).all()
    assert (
        flight.dv[:, 2].mean() * 20 - earth.gravity(record.pos[0, 0], record.pos[0, 2])
    ).abs() < 0.02
    assert flight.time[-1] == 119.0  # the record's last instant before 120 s comes before it


@recorded
@pytest.mark.slow
def test_the_filter_is_consistent_on_the_recorded_drive() -> None:
    scenario, model = composed("scenario.trajectory.end_s=400", "scenario.imu_rate_hz=50")
    runs = torch.arange(40)
    episode = scenario.draw(NominalNoise(), runs, 1)
    watch = ScoreRecorder(model, model.assemble(episode.truth))
    nees = run_filter(
        GaussianFilter(TaylorLinearisation()), model, episode.record, PhiloxStream(1, runs), watch
    ).trace["nees"]
    assert nees.shape == (40, 399, 5)
    # time averages of 40 runs, each a chi-square of 3 or, since errors last, of less: four standard errors of single instants
    assert (nees.mean((0, 1)) - 3.0).abs().max() < 4 * np.sqrt(6 / 40)
    assert (
        nees[..., 1:3].mean((0, 1)) - 3.0
    ).abs().max() < 0.4  # velocity and position, whose errors last seconds
