"""A log without a reference: its start from level and course, its withheld fixes, and what is refused."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import synthetic_log
import torch
from refusals import check_refused

from pfbench.core import PhiloxStream, chart
from pfbench.filter import GaussianFilter, TaylorLinearisation, run_filter
from pfbench.logs.worlds.log_frames import quaternion_of_angles
from pfbench.logs.worlds.log_tables import GnssLog, ImuLog, NavigationLog, swap_frd_rfu
from pfbench.logs.worlds.user_log import find_start
from pfbench.model import Constraints, StrapdownBlocks, StrapdownTotal, StrapdownTuning
from pfbench.noise import NominalNoise
from pfbench.scenario import (
    AlignedLog,
    FixHoldout,
    FixReceiver,
    LogCorrections,
    LogFiles,
    StartAlignment,
)

TUNING = StrapdownTuning(
    gyro_density=2e-3, accelerometer_density=2e-2, gyro_bias_walk=1e-5, accelerometer_bias_walk=2e-4,
    position_sd=(1.5, 1.5, 3.0), velocity_sd=None, attitude_sd_deg=(1.0, 1.0, 5.0), initial_velocity_sd=(0.2,) * 3,
    initial_position_sd=(1.5, 1.5, 3.0), gyro_bias_sd_deg_s=0.5, accelerometer_bias_sd=0.2,
)  # fmt: skip
RATE = 100


def noisy_log(rng: np.random.Generator, seconds: int = 40) -> tuple[NavigationLog, dict]:
    """A log with the noise and the biases that the tuning believes, fixes once per second at a random phase."""
    true = synthetic_log.drive(np.arange(seconds * RATE + 1) / RATE)
    force, rate, position = (
        np.stack([true[name] for name in names], -1)
        for names in (("fx", "fy", "fz"), ("wx", "wy", "wz"), ("pn", "pe", "pd"))
    )
    force = force + 0.2 * rng.normal(size=3) + 0.2 * rng.normal(size=force.shape)
    rate = rate + np.deg2rad(0.5) * rng.normal(size=3) + 0.02 * rng.normal(size=rate.shape)
    at = slice(int(rng.integers(0, 15 * RATE)), None, RATE)
    fixes = position[at] + rng.normal(size=position[at].shape) * [1.5, 1.5, 3.0]
    log = NavigationLog(
        ImuLog(true["t"], swap_frd_rfu(force), swap_frd_rfu(rate)),
        GnssLog(true["t"][at], swap_frd_rfu(fixes), np.full_like(fixes, np.nan)),
        None,
        synthetic_log.GRAVITY,
    )
    return log, true


def start_error(state: np.ndarray, true: dict, i: int) -> np.ndarray:
    """Error of a start in its chart: attitude about right, forward, up, velocity, position, [9]."""
    q = quaternion_of_angles(true["roll"][[i]], true["pitch"][[i]], true["yaw"][[i]])[0]
    motion = [
        swap_frd_rfu(np.array([true[name][i] for name in names]))
        for names in (("vn", "ve", "vd"), ("pn", "pe", "pd"))
    ]
    inverse = torch.from_numpy(state[:4]) * torch.tensor([1.0, -1.0, -1.0, -1.0])
    turn = chart.rotation_vector_from_quaternion(
        chart.quaternion_multiply(inverse, torch.from_numpy(q))
    )
    return np.concatenate([turn.numpy(), *motion]) - np.r_[np.zeros(3), state[4:]]


def test_the_start_is_as_certain_as_it_says() -> None:
    rng, normalised = np.random.default_rng(5), []
    for _ in range(50):
        log, true = noisy_log(rng)
        start = StartAlignment().find(log, TUNING, None)
        assert start.sd[:3].max() <= np.deg2rad(10.0)
        normalised.append(start_error(start.state, true, round(start.time * RATE)) / start.sd)
    size = np.sqrt(np.square(normalised).mean(0))
    # 50 normal numbers have an RMS of 1 within 0.1; the straight line of the kernels costs a little, side slip is
    # allowed for and absent, so that the heading is better than stated
    assert (size < 1.4).all(), size
    assert (size > 0.4).all(), size
    assert np.abs(normalised).max() < 5.0


def test_a_stated_heading_needs_no_motion() -> None:
    log, true = noisy_log(np.random.default_rng(1))
    start = StartAlignment(
        heading_deg=np.rad2deg(true["yaw"][round(log.fixes.time[0] * RATE)]), heading_sd_deg=2.0
    )
    found = start.find(log, TUNING, None)
    error = start_error(found.state, true, round(found.time * RATE))
    assert abs(error[2]) < 4.0 * found.sd[2]
    stands = replace(log, fixes=log.fixes._replace(position=np.zeros_like(log.fixes.position)))
    check_refused(
        [
            (
                r"must show level and heading .* at best 90 deg of heading .* scenario\.alignment\.heading_deg",
                lambda: StartAlignment().find(stands, TUNING, None),
            )
        ],
        remedy=False,
    )


def test_a_late_start_is_not_before_its_key() -> None:
    log, _ = noisy_log(np.random.default_rng(2))
    assert StartAlignment().find(log, TUNING, 20.0).time >= 22.0


# --------------------------------------------------------------------------------------------------
# The scenario from its files.


def write_log(root: Path, seconds: int = 60, seed: int = 4) -> dict[str, pd.DataFrame]:
    """Writes imu and gnss of a noisy drive into root/log; returns the exact tables."""
    tables, rng = synthetic_log.tables(float(seconds)), np.random.default_rng(seed)
    noisy = {name: tables[name].copy() for name in ("imu", "gnss")}
    noisy["imu"][["fx", "fy", "fz"]] += 0.2 * rng.normal(size=(len(noisy["imu"]), 3))
    noisy["imu"][["wx", "wy", "wz"]] += 0.02 * rng.normal(size=(len(noisy["imu"]), 3))
    noisy["gnss"] = noisy["gnss"].iloc[::5][["t", "pn", "pe", "pd"]].reset_index(drop=True)
    noisy["gnss"][["pn", "pe", "pd"]] += rng.normal(size=(len(noisy["gnss"]), 3)) * [1.5, 1.5, 3.0]
    synthetic_log.write(root / "log", noisy)
    return tables


def scenario(root: Path, **changes: object) -> AlignedLog:
    receiver = FixReceiver(position_sd=(0.0, 0.0, 0.0))
    settings = {
        "files": LogFiles(reference=None),
        "holdout": FixHoldout(4, 1),
        "filter_step_s": 0.5,
    }
    return AlignedLog(str(root), "log", TUNING, receiver, **{**settings, **changes})


def test_a_withheld_fix_is_the_truth_and_never_a_measurement(tmp_path: Path) -> None:
    write_log(tmp_path)
    episode = scenario(tmp_path).draw(NominalNoise(), torch.arange(5), 1)
    is_scored = ~torch.isnan(episode.truth["position"][..., 0])
    is_given = ~torch.isnan(episode.record.y[..., 0])
    assert not (is_scored & is_given).any()
    fixes = is_scored | is_given
    assert torch.equal(fixes, fixes[:1].expand_as(fixes))
    assert torch.equal(
        is_scored.sum(0)[fixes[0]], torch.ones(int(fixes[0].sum()), dtype=torch.int64)
    )
    assert set(episode.truth) == {"position"}
    assert episode.measured_truth.name == "held-out fixes"
    assert torch.equal(
        episode.measured_truth.sd["position"], torch.tensor(TUNING.position_sd, dtype=torch.float64)
    )
    assert any("start at t =" in note for note in episode.notes)


def test_all_runs_start_at_the_estimate_with_its_spread(tmp_path: Path) -> None:
    write_log(tmp_path)
    log = scenario(tmp_path)
    record = log.draw(NominalNoise(), torch.arange(3), 1).record
    assert torch.equal(record.start, record.start[:1].expand(3, -1))
    estimate = log.alignment.find(log.read_checked(tmp_path / "log"), TUNING, None)
    expected = torch.cat([torch.from_numpy(estimate.sd), TUNING.initial_sd[9:]])
    assert torch.equal(record.spread, torch.diag(expected).expand(3, -1, -1))
    blocks = Constraints(
        lever_arm=(1.0, 0.0, -1.0), lever_arm_sd=(0.5, 0.6, 0.7), non_holonomic_sd=0.3
    )
    more = scenario(tmp_path, constraints=blocks).draw(NominalNoise(), torch.arange(3), 1)
    assert more.record.start.shape == (3, 19)
    diagonal = more.record.spread.diagonal(dim1=1, dim2=2)
    torch.testing.assert_close(
        diagonal[0], torch.cat([expected, expected.new_tensor([0.6, 0.5, 0.7])])
    )
    model = StrapdownBlocks(TUNING, blocks)
    result = run_filter(GaussianFilter(TaylorLinearisation()), model, more.record, PhiloxStream(1, torch.arange(3)))  # fmt: skip
    assert not result.lost.any()


def test_the_filter_finds_the_attitude_without_a_reference(tmp_path: Path) -> None:
    """Heading within four of the filter's standard deviations at the end, and the track nearer than the fixes."""
    tables = write_log(tmp_path)
    log = scenario(tmp_path)
    leg = log.read()
    record = log.draw(NominalNoise(), torch.arange(1), 1).record
    model = StrapdownTotal(TUNING)
    result = run_filter(GaussianFilter(TaylorLinearisation()), model, record, PhiloxStream(1, torch.arange(1)))  # fmt: skip
    reference = tables["reference"]
    yaw = np.interp(leg.time[-1], reference.t, reference.yaw)
    q = quaternion_of_angles(np.zeros(1), np.zeros(1), np.array([yaw]))
    truth = {"attitude": torch.from_numpy(q)[:, None]}
    error = model.error(result.mean[:, -1:], model.assemble(truth))[0, 0, :3]
    assert bool((error.abs() < 4.0 * result.variance[0, -1, :3].sqrt()).all())
    true = np.stack(
        [np.interp(leg.time, reference.t, reference[c]) for c in ("pe", "pn", "pd")], -1
    ) * [1, 1, -1]
    origin = find_start(log.read_checked(tmp_path / "log"), leg)
    start = log.alignment.find(log.read_checked(tmp_path / "log"), TUNING, None)
    assert not np.allclose(start.state[7:], origin)
    late = leg.time > 20.0
    estimated = result.mean[0, late, 7:10].numpy() + start.state[7:]
    rms = np.sqrt(np.square(estimated - true[late])[:, :2].sum(1).mean())
    assert rms < 1.5 * np.sqrt(2.0)  # a single fix


def test_positions_of_a_reference_are_a_truth_without_attitude(tmp_path: Path) -> None:
    tables = write_log(tmp_path)
    tables["reference"][["t", "pn", "pe", "pd"]].to_csv(tmp_path / "log" / "rtk.csv", index=False)
    log = scenario(tmp_path, files=LogFiles(reference="rtk"), holdout=None)
    episode = log.draw(NominalNoise(), torch.arange(2), 1)
    assert set(episode.truth) == {"position", "velocity"}
    assert episode.measured_truth is None
    reference = tables["reference"]
    start = log.alignment.find(log.read_checked(tmp_path / "log"), TUNING, None).state[7:]
    east = np.interp(episode.time.numpy(), reference.t, reference.pe) - start[0]
    np.testing.assert_allclose(episode.truth["position"][0, :, 0].numpy(), east, atol=0.02)


def test_without_withheld_fixes_nothing_is_scored_and_said(tmp_path: Path) -> None:
    write_log(tmp_path)
    episode = scenario(tmp_path, holdout=None).draw(NominalNoise(), torch.arange(2), 1)
    assert torch.isnan(episode.truth["position"]).all()
    assert any(note.startswith("nothing is scored") for note in episode.notes)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"corrections": LogCorrections(attitude="yaw_from_east")}, r"not need a reference that the log lacks, got attitude"),
        ({"corrections": LogCorrections(lever_arm=[1.0, 0.0, 0.0])}, r"got lever_arm\. .* scenario\.constraints"),
        ({"corrections": LogCorrections(drop=["outliers"])}, r"got drop=outliers"),
        ({"corrections": LogCorrections(shift_s={"reference": 1.0})}, r"got shift_s\.reference"),
    ],
)  # fmt: skip
def test_what_needs_a_reference_is_refused(tmp_path: Path, changes: dict, message: str) -> None:
    check_refused([(message, lambda: scenario(tmp_path, **changes))], remedy=False)


def test_axes_forward_left_up_are_refused_with_the_key_that_mends_them(tmp_path: Path) -> None:
    write_log(tmp_path)
    file = tmp_path / "log" / "imu.csv"
    imu = pd.read_csv(file)
    imu[["fy", "fz", "wy", "wz"]] *= -1.0
    imu.to_csv(file, index=False)
    check_refused(
        [
            (
                r"-9\.8 on fz .* got a median of 9\.8.*mounting\.imu=\[x,-y,-z\]",
                lambda: scenario(tmp_path).draw(NominalNoise(), torch.arange(1), 1),
            )
        ],
        remedy=False,
    )
    mended = scenario(tmp_path, corrections=LogCorrections(mounting={"imu": ["x", "-y", "-z"]}))
    assert any(
        "forward, right, down" in note
        for note in mended.draw(NominalNoise(), torch.arange(1), 1).notes
    )
