"""The model with barometer and magnetometer: the model of the motion inside, plain geometry of the field, walking biases."""

import math
from dataclasses import replace

import pytest
import torch
from refusals import check_refused
from scipy.spatial.transform import Rotation
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import GaussianFilter, TaylorLinearisation, run_filter
from pfbench.model import AidedTuning, StrapdownAided, StrapdownTuning
from pfbench.nav.strapdown import PreintegratedImu, preintegrate

MOTION = StrapdownTuning(
    gyro_density=2e-3,
    accelerometer_density=2e-2,
    gyro_bias_walk=1e-4,
    accelerometer_bias_walk=1e-3,
    position_sd=[1.0, 1.0, 1.0],
    velocity_sd=[0.1, 0.2, 0.3],
    attitude_sd_deg=[1.0, 2.0, 8.0],
    initial_velocity_sd=[0.1, 0.2, 0.3],
    initial_position_sd=[1.0, 2.0, 3.0],
    gyro_bias_sd_deg_s=0.1,
    accelerometer_bias_sd=0.2,
)
BELIEVED = AidedTuning(
    MOTION,
    height_sd=1.5,
    magnetic_sd=[0.01, 0.02, 0.03],
    magnetic_field_gauss=[0.17, 0.01, 0.52],
    height_bias_sd=4.0,
    height_bias_walk=0.5,
    magnetic_bias_sd=0.02,
    magnetic_bias_walk=1e-3,
)
MODEL = StrapdownAided(BELIEVED)


def normal(seed: int, *shape: int) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def inputs(steps: int, duration: float = 0.25, rate: Tensor | None = None) -> PreintegratedImu:
    """Level flight at constant speed, turning at some rate."""
    spans = torch.full((1, steps, 5), duration / 5, dtype=torch.float64)
    force = torch.tensor([0.0, 0.0, 9.8], dtype=torch.float64).expand(1, steps, 5, 3)
    turn = torch.zeros(3, dtype=torch.float64) if rate is None else rate
    bias = torch.zeros(1, steps, 6, dtype=torch.float64)
    imu = preintegrate(force, turn.expand(1, steps, 5, 3), spans, bias)
    return PreintegratedImu(
        *imu, bias, torch.full((1, steps), 9.8, dtype=torch.float64), spans.sum(-1)
    )


def step(u: PreintegratedImu, t: int = 0) -> PreintegratedImu:
    return PreintegratedImu(*(leaf[:, t] for leaf in u))


def states(runs: int = 2, particles: int = 5) -> Tensor:
    return MODEL.chart.add(MODEL.origin.expand(runs, particles, -1), normal(1, runs, particles, 19))


def test_what_is_seen_is_the_fix_the_biased_height_and_the_field_in_body_axes() -> None:
    x, u = states(), step(inputs(1))
    law = MODEL.observation(x, u)
    assert torch.equal(law.mean[..., :6], MODEL.motion.observation(x[..., :16], u).mean)
    assert torch.allclose(law.mean[..., 6], x[..., 9] + x[..., 16])
    for state, seen in zip(x.flatten(0, 1), law.mean.flatten(0, 1), strict=True):
        to_level = Rotation.from_quat(state[:4].numpy(), scalar_first=True)
        field = to_level.inv().apply([0.01, 0.17, -0.52]) + state[17:].numpy()  # East, North, Up
        assert torch.allclose(seen[7:], torch.from_numpy(field), rtol=0, atol=1e-12)
    # right, forward, up of what the yaml says of forward, right, down
    assert law.stddev[0, 0].tolist() == pytest.approx(
        [1.0, 1.0, 1.0, 0.1, 0.2, 0.3, 1.5, 0.02, 0.01, 0.03]
    )


def test_a_compass_reads_north_ahead_and_down_below() -> None:
    """Level and heading North, the field is ahead and downwards; heading East, it is on the left."""
    model, turn = (
        StrapdownAided(replace(BELIEVED, magnetic_field_gauss=[0.17, 0.0, 0.52])),
        math.sqrt(0.5),
    )
    for q, expected in (
        ([1.0, 0.0, 0.0, 0.0], [0.0, 0.17, -0.52]),
        ([turn, 0.0, 0.0, -turn], [-0.17, 0.0, -0.52]),
    ):
        x = torch.tensor([*q, *[0.0] * 16], dtype=torch.float64).reshape(1, 1, -1)
        assert model.observation(x, step(inputs(1))).mean[0, 0, 7:].tolist() == pytest.approx(
            expected, abs=1e-12
        )


def test_the_motion_is_that_of_the_model_inside_and_biases_walk() -> None:
    x, u, w = states(), step(inputs(3), 1), normal(2, 2, 5, 16)
    moved = MODEL.propagate(x, u, w)
    assert torch.equal(moved[..., :16], MODEL.motion.propagate(x[..., :16], u, w[..., :12]))
    walk = torch.tensor([0.5, 1e-3, 1e-3, 1e-3], dtype=torch.float64) * math.sqrt(0.25)
    assert torch.allclose(moved[..., 16:], x[..., 16:] + walk * w[..., 12:])
    quiet = MODEL.propagate(x, u, torch.zeros_like(w))
    assert torch.allclose(
        MODEL.chart.add(quiet, w @ MODEL.noise_gain(u).mT), moved, rtol=0, atol=1e-12
    )
    assert torch.allclose(
        MODEL.initial(1).stddev[0, 15:], torch.tensor([4.0, 0.02, 0.02, 0.02], dtype=torch.float64)
    )


def flown(steps: int, rate: float) -> tuple[Tensor, PreintegratedImu, Tensor]:
    """Worlds of the model's own law for 40 runs that circle at a rate: truth [R, T, 20], inputs, measurements."""
    u = inputs(steps, 1.0, torch.tensor([0.0, 0.0, rate], dtype=torch.float64))
    draws = PhiloxStream(3, torch.arange(40))
    x = MODEL.chart.add(MODEL.origin.expand(40, 1, -1), (MODEL.p0 * draws.normal("start", 1, 19)))
    truth, seen = [], []
    for t in range(steps):
        x = MODEL.propagate(x, step(u, t), draws.at_step(t).normal("drive", 1, 16))
        truth.append(x[:, 0])
        seen.append(
            MODEL.observation(x, step(u, t)).mean[:, 0]
            + MODEL.r * draws.at_step(t).normal("see", 1, 10)[:, 0]
        )
    return torch.stack(truth, 1), u, torch.stack(seen, 1)


def test_turns_tell_the_hard_iron_and_the_filter_knows_how_well() -> None:
    """Only the magnetometer and fixes: circling, level biases are learnt; straight on, they stay with the heading."""
    sd = []
    for rate in (0.5, 0.0):
        truth, u, y = flown(14, rate)
        with torch.no_grad():
            found = run_filter(
                GaussianFilter(TaylorLinearisation()),
                MODEL,
                Record(y, u),
                PhiloxStream(1, torch.arange(40)),
            )
        z = MODEL.error(found.mean, truth)[:, -1].square() / found.variance[:, -1]
        assert (abs(z.mean(0) - 1.0) < 4.5 * math.sqrt(2 / 40) + 0.1).all()
        sd.append(found.variance[:, -1].sqrt().mean(0))
    assert (sd[0][16:18] < 0.4 * BELIEVED.magnetic_bias_sd).all()
    assert (
        sd[1][16] > 0.65 * BELIEVED.magnetic_bias_sd
    )  # to the right: turned about up, the field moves that way


def test_what_does_not_fit_is_refused() -> None:
    def believed(**changes: object) -> StrapdownAided:
        return StrapdownAided(replace(BELIEVED, **changes))

    check_refused([
        (r"must measure the 10 components of StrapdownAided .*got 6", lambda: MODEL.prepare(Record(torch.zeros(1, 2, 6), inputs(2)))),
        (r"record\.u must be PreintegratedImu for StrapdownAided, got no inputs", lambda: MODEL.prepare(Record(torch.zeros(1, 2, 10)))),
        (r"tuning\.magnetic_field_gauss must .*got \[0\.0, 0\.0, 0\.0\]", lambda: believed(magnetic_field_gauss=[0.0, 0.0, 0.0])),
        (r"tuning\.height_sd", lambda: believed(height_sd=0.0)),
        (r"tuning\.magnetic_sd must have 3 numbers, got \[0\.1\]", lambda: believed(magnetic_sd=[0.1])),
        (r"tuning\.magnetic_bias_walk", lambda: believed(magnetic_bias_walk=-1.0)),
    ], remedy=False)  # fmt: skip


def test_a_truth_without_biases_leaves_them_unknown() -> None:
    state = MODEL.assemble({"position": torch.ones(2, 3, 3).double()})
    assert state.shape == (2, 3, 20)
    assert torch.isnan(state[..., 10:]).all()
    known = MODEL.assemble(
        {
            "height_bias": torch.full((2, 3, 1), 7.0).double(),
            "position": torch.ones(2, 3, 3).double(),
        }
    )
    assert (known[..., 16] == 7.0).all()
