"""Readings of a barometer and a magnetometer beside recorded fixes: exact on a synthetic log, seen where fixes are withheld."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from recorded_data import believed, recorded
from refusals import check_refused
from scipy.spatial.transform import Rotation
from synthetic_log import tables, write

from pfbench import job
from pfbench.job.config import compose_tree
from pfbench.logs.worlds.drive import (
    BaroMagSensors,
    FixHoldout,
    RecordedAidedFlight,
    RecordedDrive,
    pressure_height,
)
from pfbench.logs.worlds.time_grid import FixReceiver
from pfbench.model import AidedTuning, StrapdownAided
from pfbench.noise import MeasurementOutage, NominalNoise, VarianceSurge
from pfbench.scenario.base import RecordingRegime
from pfbench.scenario.oracle_noise import OracleNoiseModel

FIELD, IRON = [0.17, 0.01, 0.52], [0.4, -0.2, 0.3]  # North, East, Down; forward, right, down
MOTION = believed([1.0, 1.0, 2.0], [0.1, 0.1, 0.1])
BELIEVED = AidedTuning(MOTION, 1.0, [0.01] * 3, FIELD, 3.0, 0.1, 0.02, 1e-4)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A data root with one flight of 20 s whose pressure rises by a pascal a second, in a uniform field."""
    folder, log = tmp_path_factory.mktemp("data"), tables()
    imu, yaw = (
        log["imu"],
        np.interp(log["imu"]["t"], log["reference"]["t"], log["reference"]["yaw"]),
    )
    imu["p_static_kpa"] = 98.0 + 0.001 * imu["t"]
    imu[["mx", "my", "mz"]] = Rotation.from_euler("Z", yaw[:, None]).inv().apply(FIELD) + IRON
    write(folder / "wing", log)
    return folder


def wing(root: Path, **changes: object) -> RecordedAidedFlight:
    flight = RecordedDrive(
        None, "wing", MOTION, FixReceiver(velocity_sd=[0.0] * 3), holdout=FixHoldout()
    )
    flight = replace(flight, receiver=replace(flight.receiver, position_sd=[0.0] * 3))
    return replace(
        RecordedAidedFlight(str(root), flight, BELIEVED, BaroMagSensors(IRON)), **changes
    )


def test_readings_are_those_of_the_log_at_every_fix_withheld_or_not(root: Path) -> None:
    episode = wing(root).draw(NominalNoise(), torch.arange(2), 1)
    y, time = episode.record.y, episode.time.numpy()
    assert y.shape == (2, 80, 10)
    at_fix = torch.arange(1, 81) % 4 == 0
    assert torch.equal(~torch.isnan(y[..., 6:]), at_fix[:, None].expand_as(y[..., 6:]))
    withheld = torch.isnan(y[..., 0]) & at_fix
    assert withheld.sum(1).tolist() == [10, 10]
    fall = pressure_height(98.0 + 0.001 * time) - pressure_height(np.array(98.0))
    assert np.allclose(y[0, at_fix, 6], fall[at_fix], atol=1e-9)
    model = StrapdownAided(BELIEVED)
    state = model.assemble(episode.truth).nan_to_num(0.0)
    seen = torch.stack(
        [
            model.observation(state[:, t : t + 1], episode.record.at_step(t).u).mean[:, 0]
            for t in range(80)
        ],
        1,
    )
    assert (y - seen)[:, at_fix][
        ..., 7:
    ].abs().max() < 2e-4  # the reference's heading between its samples


def test_pressure_height_is_the_standard_atmosphere() -> None:
    table = {101.325: 0.0, 95.4608: 500.0, 89.8746: 1000.0, 54.0199: 5000.0}  # ICAO Doc 7488
    assert pressure_height(np.array(list(table))) == pytest.approx(list(table.values()), abs=0.1)


def test_starts_have_the_believed_law_about_the_log(root: Path) -> None:
    episode = wing(root).draw(NominalNoise(), torch.arange(400), 1)
    start = episode.record.start
    assert start is not None
    z = start[:, 16:] / BELIEVED.bias_sd
    assert (z.mean(0).abs() < 4.5 / 20).all()
    assert ((z.std(0) - 1).abs() < 4.5 / 28).all()
    plain = replace(wing(root).flight, root=str(root)).draw(NominalNoise(), torch.arange(400), 1)
    assert torch.equal(start[:, :16], plain.record.start)  # the same flight as without instruments
    alone = wing(root).draw(NominalNoise(), torch.tensor([7]), 1)
    assert torch.equal(alone.record.start, start[7:8])
    assert torch.equal(alone.record.y.nan_to_num(-1.0), episode.record.y[7:8].nan_to_num(-1.0))


def test_a_regime_reaches_fixes_and_readings_at_once_and_can_be_told(root: Path) -> None:
    flight = wing(root).flight
    noisy = replace(flight, receiver=FixReceiver(position_sd=[3.0] * 3, velocity_sd=[0.5] * 3))
    scene = wing(
        root, flight=noisy, instruments=BaroMagSensors(IRON, height_sd=2.0, magnetic_sd=0.01)
    )
    witness = RecordingRegime(NominalNoise())
    episode = scene.draw(witness, torch.arange(300), 1)
    away = episode.record.y - wing(root).draw(NominalNoise(), torch.arange(300), 1).record.y
    sd = torch.stack([column[~torch.isnan(column)].std() for column in away.unbind(-1)])
    assert torch.allclose(
        sd, torch.tensor([3.0] * 3 + [0.5] * 3 + [2.0] + [0.01] * 3).double(), rtol=0.06
    )
    told = witness.to_oracle_model(StrapdownAided(BELIEVED), episode.time)
    assert isinstance(told, OracleNoiseModel)
    assert told.prepare(episode.record).u.shift.shape == (1, 80, 10)
    silent = scene.draw(MeasurementOutage(windows_s=[[5.0, 10.0]]), torch.arange(2), 1).record.y
    assert torch.isnan(silent[:, 19:39]).all()
    with pytest.raises(ValueError, match="must not change the process noise"):
        scene.draw(VarianceSurge(((5.0, 9.0),), (1.0,), (4.0,)), torch.arange(2), 1)


def test_what_cannot_be_read_is_refused(root: Path) -> None:
    check_refused([
        (r"instruments\.hard_iron must have 3 numbers, got \[1\.0\]", lambda: BaroMagSensors([1.0])),
        (r"instruments\.height_sd must be at least 0, got -1\.0", lambda: BaroMagSensors(height_sd=-1.0)),
        (r"data\.root is not set", lambda: replace(wing(root), root=None).draw(NominalNoise(), torch.arange(1), 1)),
    ])  # fmt: skip


@recorded
@pytest.mark.parametrize("run", [0, 1])
def test_the_barometer_is_believed_as_the_fixes_of_the_run_itself_say(run: int) -> None:
    """Pressure height less the fixes handed out to this run, on which it is not scored: mean squared change over some seconds.

    Errors of size s that are forgotten in some seconds and a walk of density w give 2 s^2 + w^2 t. Over 40 s the walk is well
    known, and 2 s^2 is what is left; s is believed to be twice that, since it is no white noise.
    """
    cfg = compose_tree(["scenario=recorded_fixed_wing_aided", "episode_cache_dir=null"])
    scene = job.instantiate(cfg.scenario)
    y = scene.draw(NominalNoise(), torch.arange(2), 1).record.y[run]
    off = (y[:, 6] - y[:, 2])[torch.isfinite(y[:, 2])].numpy()  # of every second second
    lags = np.array([6, 10, 20, 40])
    change = [np.mean((off[lag // 2 :] - off[: -lag // 2]) ** 2) for lag in lags]
    slope, level = np.polyfit(lags, change, 1)
    assert slope == pytest.approx(scene.tuning.height_bias_walk**2, rel=0.15)
    assert 2.0 * np.sqrt(level / 2.0) == pytest.approx(scene.tuning.height_sd, rel=0.15)
