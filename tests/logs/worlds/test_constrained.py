"""Recorded drives with constraints: standing found by the IMU alone, odometers, refusals in words, and what a car gains."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
import torch
from config_cases import composed
from recorded_data import DATA, believed, recorded
from refusals import check_refused
from synthetic_log import GRAVITY, write

from pfbench import job
from pfbench.core.random_stream import PhiloxStream
from pfbench.filter import GaussianFilter, TaylorLinearisation, run_filter
from pfbench.job.model_fit import check_fit
from pfbench.logs.worlds.constrained import ConstrainedDrive
from pfbench.logs.worlds.corrections import LogCorrections
from pfbench.logs.worlds.drive import RecordedDrive
from pfbench.logs.worlds.log_reader import read_log
from pfbench.logs.worlds.log_tables import LogFiles
from pfbench.logs.worlds.odometer import RecordedOdometer, SimulatedOdometer
from pfbench.logs.worlds.standing import detect_standing
from pfbench.logs.worlds.time_grid import FixReceiver
from pfbench.logs.worlds.user_log import UserLog
from pfbench.model import Constraints, StrapdownBlocks, StrapdownTuning
from pfbench.noise import MeasurementOutage, NominalNoise

TUNING = believed([1.0, 1.0, 2.0], None)
STOPS = ((0.0, 15.0), (35.0, 43.0))  # s, in a drive of a minute
RUNS = torch.arange(3)


def stop_and_go(vibration: float = 0.5, seconds: float = 60.0) -> dict[str, pd.DataFrame]:
    """A drive that bends and stops, and starts with a steady acceleration; the IMU shakes while it moves."""
    t = np.arange(0.0, seconds + 1e-9, 0.01)
    moves = np.interp(t, [15.0, 20.0, 30.0, 35.0, 43.0, 48.0], [0, 1, 1, 0, 0, 1])
    speed, turn = 6.0 * moves, 0.2 * np.sin(0.3 * t) * np.clip(2 * moves - 1, 0, 1)
    along = 1.2 * np.select(
        [(t >= 15) & (t < 20), (t >= 30) & (t < 35), (t >= 43) & (t < 48)], [1, -1, 1], 0
    )
    yaw, zero = 0.4 + np.cumsum(turn) * 0.01, np.zeros_like(t)
    rng = np.random.default_rng(0)
    fast = np.where(speed > 2.0, vibration, 0.0)[:, None]  # a start is as quiet as rest at first
    force, rate = rng.normal(size=(2, t.size, 3)) * np.stack([0.05 + fast, 0.002 + 0.02 * fast])
    vn, ve = speed * np.cos(yaw), speed * np.sin(yaw)
    motion = {
        "t": t, "pn": np.cumsum(vn) * 0.01, "pe": np.cumsum(ve) * 0.01, "pd": zero,
        "vn": vn, "ve": ve, "vd": zero, "roll": zero, "pitch": zero, "yaw": yaw,
    }  # fmt: skip
    sensed = np.stack([along, speed * turn, zero - GRAVITY], -1) + force
    turned = np.stack([zero + 0.002, zero - 0.001, turn + 0.003], -1) + rate
    imu = dict(
        zip(("fx", "fy", "fz", "wx", "wy", "wz"), np.hstack([sensed, turned]).T, strict=True)
    )
    reference = pd.DataFrame(motion)
    return {
        "imu": pd.DataFrame({"t": t, **imu}),
        "gnss": reference.loc[::100, ["t", "pn", "pe", "pd"]],
        "reference": reference.iloc[::5],
    }


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with a drive that stops twice."""
    folder = tmp_path_factory.mktemp("data")
    write(folder / "drive", stop_and_go())
    return folder


def constrained(root: Path, odometer: Any = None, **known: Any) -> ConstrainedDrive:
    return ConstrainedDrive(str(root), "drive", TUNING, filter_step_s=0.2, constraints=Constraints(**known), odometer=odometer)  # fmt: skip


def test_standing_is_found_and_a_steady_start_is_not_taken_for_it(root: Path) -> None:
    time = np.arange(0.2, 59.0, 0.2)
    standing, note = detect_standing(read_log(root / "drive"), time)
    is_stop = np.any([(time > a) & (time <= b) for a, b in STOPS], axis=0)
    assert not standing[~is_stop].any()
    well_inside = np.any([(time > a + 2.0) & (time <= b) for a, b in STOPS], axis=0)
    assert standing[well_inside].mean() > 0.7
    assert "0.00% of the moving ones" in note
    assert "from t = 0.0 to 15" in note


def test_thresholds_that_no_data_confirm_are_refused(tmp_path: Path) -> None:
    glide = stop_and_go(vibration=0.0)  # in motion as quiet as at rest, and hardly a bend
    log = read_log(write(tmp_path / "glide", glide))
    straight = log.imu.rate * [1.0, 1.0, 0.0]
    quiet = replace(log, imu=log.imu._replace(rate=straight, force=0.1 * log.imu.force))
    check_refused(
        [
            (
                r"find standing in at most 5% of the steps above 0\.3 m/s, got [1-9]",
                lambda: detect_standing(quiet, np.arange(0.2, 59.0, 0.2)),
            )
        ],
        remedy=False,
    )
    moving = {name: table[table.t > 16.0] for name, table in stop_and_go(seconds=34.0).items()}
    short = read_log(write(tmp_path / "moving", moving))
    check_refused(
        [
            (
                r"the log must stand for 8 s, .* got no such part\. Set constraints\.",
                lambda: detect_standing(short, np.arange(17.0, 33.0, 0.2)),
            )
        ],
        remedy=False,
    )


def test_components_are_zero_or_the_recorded_rate_and_missing_where_nothing_is_known(
    root: Path,
) -> None:
    scene = constrained(root, non_holonomic_sd=0.3, zero_velocity_sd=0.05, zero_rate_sd=0.01)
    episode = scene.draw(NominalNoise(), RUNS, 1)
    plain = RecordedDrive(str(root), "drive", TUNING, filter_step_s=0.2).draw(
        NominalNoise(), RUNS, 1
    )
    y, time = episode.record.y, episode.time.numpy()
    assert torch.equal(y[..., :3].nan_to_num(-1.0), plain.record.y.nan_to_num(-1.0))
    assert torch.equal(episode.record.start, plain.record.start)
    assert bool((y[..., 3:5] == 0.0).all())
    standing, note = detect_standing(read_log(root / "drive"), time)
    assert episode.notes[-1] == note
    assert torch.equal(
        torch.isnan(y[0]).logical_not()[:, 5:], torch.from_numpy(standing)[:, None].expand(-1, 6)
    )
    assert bool((y[:, standing, 5:8] == 0.0).all())
    imu = pd.read_csv(root / "drive" / "imu.csv")
    step = int(np.flatnonzero(standing)[3])
    inside = (imu.t > time[step - 1] - 1e-6) & (imu.t < time[step] + 1e-6)
    part = imu[inside]
    mean = [np.trapezoid(part[a], part.t) / np.ptp(part.t) for a in ("wy", "wx", "wz")]
    assert np.allclose(y[1, step, 8:], mean * np.array([1, 1, -1]), rtol=0, atol=1e-9)
    outage = scene.draw(MeasurementOutage(((20.0, 30.0),)), RUNS, 1).record.y
    silent = (time >= 20.0) & (time < 30.0)
    assert bool(torch.isnan(outage[:, silent, :3]).all())
    assert torch.equal(outage[..., 3:].nan_to_num(-1.0), y[..., 3:].nan_to_num(-1.0))


def test_a_simulated_odometer_has_its_scale_and_noise(root: Path) -> None:
    odometer = SimulatedOdometer(scale_error=-0.1, sd=0.3)
    scene = constrained(root, odometer, odometer_sd=0.3, odometer_scale_sd=0.05)
    episode = scene.draw(NominalNoise(), torch.arange(40), 1)
    true = episode.truth["velocity"].norm(dim=-1)  # a level car that does not slip
    error = (episode.record.y[..., 3] - 0.9 * true)[..., :-1]
    assert float(error.std()) == pytest.approx(0.3, rel=4.5 / np.sqrt(2 * error.numel()))
    assert abs(float(error.mean())) < 4.5 * 0.3 / np.sqrt(error.numel()) + 2e-3
    assert bool((episode.truth["odometer_scale"] == -0.1).all())
    assert bool((episode.record.start[:, 16:] == 0.0).all())
    alone = scene.draw(NominalNoise(), torch.tensor([7]), 1).record.y
    assert torch.equal(alone.nan_to_num(-1.0), episode.record.y[7:8].nan_to_num(-1.0))


def test_a_recorded_odometer_is_read_at_the_steps_but_not_in_its_gaps(root: Path) -> None:
    t = np.arange(1.0, 50.0, 0.1)
    table = pd.DataFrame({"t": t, "v_fwd": 2.0 + 0.5 * t})
    table = table[(t < 20.05) | (t > 25.05)]
    table.to_csv(root / "drive" / "wheels.csv", index=False)
    scene = constrained(root, RecordedOdometer("wheels"), odometer_sd=0.3)
    episode = scene.draw(NominalNoise(), RUNS, 1)
    speed, time = episode.record.y[1, :, 3].numpy(), episode.time.numpy()
    known = (time >= 1.0) & (time <= 49.9) & ((time <= 20.0) | (time >= 25.1 - 1e-9))
    assert np.array_equal(np.isfinite(speed), known)
    assert np.allclose(speed[known], 2.0 + 0.5 * time[known])
    assert [path.name for path in scene.input_files()][-1] == "wheels.csv"
    check_refused(
        [
            (
                r"must contain tyres\.parquet or tyres\.csv",
                lambda: replace(scene, odometer=RecordedOdometer("tyres")).draw(
                    NominalNoise(), RUNS, 1
                ),
            ),
            (
                r"scenario\.odometer must be null without, and .* got None",
                lambda: constrained(root, odometer_sd=0.3),
            ),
        ],
        remedy=False,
    )


def test_a_model_without_the_constraints_is_refused_with_the_one_that_has_them() -> None:
    tree = composed(
        "scenario=user_log", "scenario.folder=drive", "scenario.constraints.lever_arm=[1,0,0]"
    )
    values = (job.instantiate(tree.model), job.instantiate(tree.scenario))
    check_refused(
        [
            (
                r"reads 'position East \[m\]' as channel 1, .*'position of the antenna East .* Models that fit: strapdown_blocks\.",
                lambda: check_fit(*values, tree, ()),
            )
        ],
        remedy=False,
    )


# --------------------------------------------------------------------------------------------------
# The recorded car: 340 s with three outages of 30 s, errors of the fixes 1.5, 1.5, 3 m.

OUTAGES = ((130.0, 160.0), (200.0, 230.0), (290.0, 320.0))


def car(fix_sd: list[float], known: Constraints, **changes: Any) -> UserLog:
    tuning = StrapdownTuning(
        gyro_density=2e-3, accelerometer_density=2e-2, gyro_bias_walk=1e-5, accelerometer_bias_walk=2e-4,
        position_sd=[max(a, 0.05) for a in fix_sd], velocity_sd=None, attitude_sd_deg=[1.0, 1.0, 5.0],
        initial_velocity_sd=[0.2] * 3, initial_position_sd=[1.5] * 3, gyro_bias_sd_deg_s=0.5, accelerometer_bias_sd=0.2,
    )  # fmt: skip
    return UserLog(
        DATA, "car_rtk_mems", tuning, FixReceiver(position_sd=fix_sd), 0.5, 40.0, 380.0,
        LogFiles(gnss="gnss_rtk"), fix_codes=[1], constraints=known, **changes,
    )  # fmt: skip


def follow(scene: UserLog, noise: Any) -> tuple[torch.Tensor, torch.Tensor]:
    """Horizontal error of an EKF after 100 s, m, [R], and the states behind the motion at the end, [R, k]."""
    runs = torch.arange(3)
    episode = scene.draw(noise, runs, 1)
    model = StrapdownBlocks(scene.tuning, scene.constraints)
    found = run_filter(GaussianFilter(TaylorLinearisation()), model, episode.record, PhiloxStream(1, runs)).mean  # fmt: skip
    error = model.error(found, model.assemble(episode.truth))[:, episode.time > 100.0, 6:8]
    return error.square().sum(-1).nanmean(1).sqrt(), found[:, -1, 16:]


@recorded
@pytest.mark.slow
def test_a_car_without_fixes_keeps_its_place_by_not_slipping_and_by_its_wheels() -> None:
    noise, fixes = MeasurementOutage(OUTAGES), [1.5, 1.5, 3.0]
    plain, _ = follow(car(fixes, Constraints()), noise)
    axle, _ = follow(car(fixes, Constraints(non_holonomic_sd=0.3)), noise)
    known = Constraints(non_holonomic_sd=0.3, odometer_sd=0.15, odometer_scale_sd=0.05)
    wheels, states = follow(car(fixes, known, odometer=SimulatedOdometer(-0.02, 0.1)), noise)
    rms = [float(a.square().mean().sqrt()) for a in (plain, axle, wheels)]
    assert rms[1] < 0.5 * rms[0]
    assert rms[2] < 3.0
    assert bool((states + 0.02).abs().max() < 0.005)


@recorded
@pytest.mark.slow
def test_rtk_shows_the_lever_arm_of_a_car_ahead_and_aside_but_not_upwards() -> None:
    moved = LogCorrections(
        lever_arm=[-3.0, -0.8, 1.5]
    )  # fixes of an antenna 3 m ahead, 0.8 m right, 1.5 m up
    scene = car([0.03, 0.03, 0.06], Constraints(lever_arm_sd=[2.0] * 3), corrections=moved)
    _, lever = follow(scene, NominalNoise())
    assert float((lever[:, 1] - 3.0).abs().max()) < 0.15
    assert float((lever[:, 0] - 0.8).abs().max()) < 0.1
    assert float((lever[:, 2] - 1.5).abs().max()) > 0.15
