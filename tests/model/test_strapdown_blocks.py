"""Constraints, odometer, lever arm and delay: plain geometry, closed-form derivatives, and worlds of the model's own law."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from recorded_data import believed
from refusals import check_refused
from scipy.spatial.transform import Rotation
from scipy.stats import chi2, norm
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Record, iterate_steps
from pfbench.core.simulate import draw_initial_state, simulate_steps
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    run_filter,
)
from pfbench.filter.linearisation import measurement_jacobian
from pfbench.model import Constraints, StrapdownBlocks, StrapdownTotal
from pfbench.nav.strapdown import PreintegratedImu, preintegrate

TUNING = believed([1.0, 2.0, 3.0], None)
WITH_VELOCITY = replace(TUNING, velocity_sd=[0.1, 0.2, 0.3])
ALL = Constraints(
    non_holonomic_sd=0.4, zero_velocity_sd=0.05, zero_rate_sd=0.01, odometer_sd=0.2, odometer_scale_sd=0.05,
    axle=[-1.5, 0.2, 0.4], lever_arm=[1.0, 0.5, -2.0], lever_arm_sd=[0.6, 0.4, 0.9], delay_sd=0.1,
)  # fmt: skip
BIAS = [0.01, -0.02, 0.03, 0.1, 0.2, -0.3]


def inputs(steps: int, turn: list[float], duration: float = 0.25, bias: Any = BIAS) -> PreintegratedImu:  # fmt: skip
    """A body that feels a constant rate and a force that varies from step to step."""
    spans = torch.full((1, steps, 5), duration / 5, dtype=torch.float64)
    rate = torch.tensor(turn, dtype=torch.float64).expand(1, steps, 5, 3)
    phase = torch.arange(steps, dtype=torch.float64)
    force = torch.stack([torch.sin(phase), 2 * torch.cos(0.7 * phase), 9.8 + 0 * phase], -1)
    nominal = torch.tensor(bias, dtype=torch.float64).expand(1, steps, 6)
    imu = preintegrate(force[None, :, None].expand(1, steps, 5, 3), rate, spans, nominal)
    gravity = torch.full((1, steps), 9.8, dtype=torch.float64)
    return PreintegratedImu(*imu, nominal, gravity, spans.sum(-1))


def states(model: StrapdownBlocks, particles: int = 6) -> Tensor:
    noise = PhiloxStream(3, torch.arange(2)).normal("states", particles, model.chart.dimension)
    sd = torch.cat([torch.full((3,), 0.8), torch.full((3,), 9.0), torch.full((3,), 5.0), torch.full((6,), 0.05)])  # fmt: skip
    spread = torch.cat([sd.double(), model.p0[15:]])
    return model.chart.add(model.origin.expand(2, particles, -1), spread * noise)


def seen_by_hand(x: np.ndarray, turn: np.ndarray) -> dict[str, np.ndarray]:
    """Components by rotation matrices; x has the states of ALL, turn is what the gyro reads."""
    c = Rotation.from_quat(x[:4], scalar_first=True).as_matrix()
    v, p, gyro, lever, scale, delay = x[4:7], x[7:10], x[10:13], x[16:19], x[19], x[20]
    body = c.T @ v + np.cross(turn - gyro, [0.2, -1.5, -0.4])  # right, forward, up
    antenna = v + c @ np.cross(turn - gyro, lever)
    return {
        "fix": p + c @ lever - delay * antenna, "axle": body[[0, 2]], "standing": v, "rate": gyro,
        "wheels": body[1:2] * (1 + scale),
    }  # fmt: skip


def test_each_component_is_its_plain_geometry() -> None:
    model, turn = StrapdownBlocks(TUNING, ALL), [0.3, -0.2, 0.9]
    u = PreintegratedImu(*(leaf[:, 1] for leaf in inputs(2, turn)))
    x = states(model)
    law = model.observation(x, u)
    for state, mean in zip(x.flatten(0, 1).numpy(), law.mean.flatten(0, 1).numpy(), strict=True):
        by_hand = np.concatenate(list(seen_by_hand(state, np.array(turn)).values()))
        assert np.allclose(mean, by_hand, rtol=0, atol=1e-10)
    sd = [1, 2, 3, 0.4, 0.4, *[0.05] * 3, *[0.01] * 3, 0.2]
    assert law.stddev[0, 0].tolist() == pytest.approx(sd)
    assert len(model.channel_names) == len(sd)
    assert model.channel_names[0] == "late position of the antenna East [m]"
    assert model.names[15:] == ("lever_arm_right", "lever_arm_forward", "lever_arm_up", "odometer_scale", "delay")  # fmt: skip
    assert model.initial(1).stddev[0, 15:].tolist() == pytest.approx([0.4, 0.6, 0.9, 0.05, 0.1])
    assert ALL.start.tolist() == [0.5, 1.0, 2.0, 0.0, 0.0]


def test_velocity_of_an_antenna_has_that_of_the_turn() -> None:
    model = StrapdownBlocks(WITH_VELOCITY, Constraints(lever_arm=[3.0, 0.0, 0.0]))
    x = model.origin.reshape(
        1, 1, -1
    ).clone()  # facing North, turning to the left, with 0.03 rad/s of bias
    x[..., 10:13] = torch.tensor(BIAS[:3])
    u = PreintegratedImu(*(leaf[:, 0] for leaf in inputs(1, [0.01, -0.02, 0.53])))
    assert model.observation(x, u).mean[0, 0].tolist() == pytest.approx(
        [0, 3, 0, -1.5, 0, 0], abs=1e-8
    )
    check_refused(
        [
            (
                r"constraints\.delay_sd must be null for fixes with velo",
                lambda: StrapdownBlocks(WITH_VELOCITY, Constraints(delay_sd=0.1)),
            )
        ],
        remedy=False,
    )


def skew(a: np.ndarray) -> np.ndarray:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def test_derivatives_are_those_of_the_error_equations() -> None:
    """Attitude errors on the right, C exp(d): C l moves by -C [l] d, and C^T v by [C^T v] d."""
    known = replace(ALL, axle=[0.0, 0.0, 0.0])
    model = StrapdownBlocks(TUNING, known)
    u = PreintegratedImu(*(leaf[:, 0] for leaf in inputs(1, [0.0, 0.0, 0.5])))
    x = states(model, 1)
    slopes = measurement_jacobian(model, x, Record(torch.zeros(2, 12, dtype=torch.float64), u))
    for state, slope in zip(x[:, 0].numpy(), slopes[:, 0].numpy(), strict=True):
        c = Rotation.from_quat(state[:4], scalar_first=True).as_matrix()
        v, lever, delay, body = state[4:7], state[16:19], state[20], c.T @ state[4:7]
        w = np.array([0.0, 0.0, 0.5]) - state[10:13]
        swept = np.cross(w, lever)
        assert np.allclose(slope[:3, :3], -c @ skew(lever) + delay * c @ skew(swept))
        assert np.allclose(slope[:3, 3:6], -delay * np.eye(3))
        assert np.allclose(slope[:3, 15:18], c - delay * c @ skew(w))
        assert np.allclose(slope[:3, 19], -(v + c @ swept))
        assert np.allclose(slope[3:5, :3], skew(body)[[0, 2]])
        assert np.allclose(slope[3:5, 3:6], c.T[[0, 2]])
        assert np.allclose(slope[11, :3], (1 + state[18 + 1]) * skew(body)[1])
        assert np.isclose(slope[11, 18], body[1])
        assert np.allclose(slope[8:11, 9:12], np.eye(3))


def test_missing_components_have_no_part_in_the_likelihood() -> None:
    model, turn = StrapdownBlocks(TUNING, ALL), [0.1, 0.2, 0.3]
    u, x = PreintegratedImu(*(leaf[:, 0] for leaf in inputs(1, turn))), states(model)
    y = torch.full((2, 12), torch.nan, dtype=torch.float64)
    y[0, 3:5], y[1, 11] = 0.0, 7.0  # a car between fixes; a wheel alone
    log_like = model.log_likelihood(y, x, u).numpy()
    for i, state in enumerate(x[0].numpy()):
        axle = seen_by_hand(state, np.array(turn))["axle"]
        assert np.isclose(log_like[0, i], norm.logpdf(axle, scale=0.4).sum())
    for i, state in enumerate(x[1].numpy()):
        wheels = seen_by_hand(state, np.array(turn))["wheels"]
        assert np.isclose(log_like[1, i], norm.logpdf(7.0, wheels, 0.2).sum())


@pytest.mark.parametrize("method", [GaussianFilter(TaylorLinearisation()), ParticleFilter(50)])
def test_without_constraints_it_is_the_model_of_the_motion(method: Any) -> None:
    u, runs = inputs(8, [0.0, 0.1, 0.4]), torch.arange(2)
    y = PhiloxStream(5, runs).normal("world", 8, 3)
    results = [
        run_filter(method, model, Record(y, u), PhiloxStream(1, runs))
        for model in (StrapdownTotal(TUNING), StrapdownBlocks(TUNING, Constraints()))
    ]
    assert torch.equal(results[0].mean, results[1].mean)


def drive(model: StrapdownBlocks, runs: int, steps: int) -> tuple[Tensor, Record]:
    """Worlds of the model's own law that circle and brake: truth [R, T, D] and record; constraints are measured as drawn."""
    u = inputs(steps, [0.05, 0.1, 0.5], 1.0, [0.0] * 6)
    stream = PhiloxStream(7, torch.arange(runs))
    start = draw_initial_state(model, model.initial(runs), stream, "world.state")
    blank = Record(torch.full((runs, steps, 1), torch.nan, dtype=torch.float64), u)
    walked = list(simulate_steps(model, blank, stream, start, "world.state"))
    means = torch.cat([step.distribution.mean for step in walked], 1)
    y = means + model.r * stream.normal("world.receiver", steps, len(model.r))
    return torch.cat([step.x for step in walked], 1), Record(y, u)


@pytest.mark.parametrize("rule", [TaylorLinearisation(), SigmaPointLinearisation(CubaturePoints())])
def test_states_are_found_as_well_as_the_covariance_says(rule: Any) -> None:
    known = replace(ALL, zero_velocity_sd=None, non_holonomic_sd=None, lever_arm=[0.0, 0.0, 0.0])
    model = StrapdownBlocks(replace(TUNING, position_sd=[0.05] * 3), known)
    truth, record = drive(model, 60, 40)
    result = run_filter(GaussianFilter(rule), model, record, PhiloxStream(1, torch.arange(60)))
    error = model.error(result.mean, truth)[:, -1, 15:]
    z = (error.square() / result.variance[:, -1, 15:]).sum(0)
    low, high = chi2.ppf([2e-4, 1 - 2e-4], 60)  # of one of five components
    assert bool(((low < z) & (z < high)).all())
    gain = error.square().mean(0).sqrt() / model.p0[15:]
    assert bool((gain[[0, 1, 3, 4]] < 0.4).all())
    assert gain[2] > 0.6  # a body that hardly tilts does not show the height of its antenna


def test_constants_keep_their_values_and_the_noise_is_that_of_the_motion() -> None:
    model, u = StrapdownBlocks(TUNING, ALL), inputs(3, [0.1, 0.0, 0.2])
    x = states(model)
    for _, at, record in iterate_steps(model, Record(torch.zeros(2, 3, 12), u)):
        w = PhiloxStream(2, torch.arange(2)).normal("w", 6, 12)
        moved = at.propagate(x, record.u, w)
        assert torch.equal(moved[..., 16:], x[..., 16:])
        assert torch.equal(moved[..., :16], model.motion.propagate(x[..., :16], record.u, w))
        quiet = at.propagate(x, record.u, 0 * w)
        added = model.chart.add(quiet, w @ model.noise_gain(record.u).mT)
        assert torch.allclose(added, moved, rtol=0, atol=1e-12)
    truth = model.assemble({"position": torch.ones(2, 3, 3), "odometer_scale": torch.full((2, 3, 1), -0.02)})  # fmt: skip
    assert truth.shape == (2, 3, 21)
    assert bool((truth[..., 19] == -0.02).all())
    assert bool(torch.isnan(truth[..., 16:19]).all())


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"zero_velocity_sd": 0.0}, r"constraints\.zero_velocity_sd must be positive and finite, got 0\.0"),
        ({"odometer_scale_sd": 0.1}, r"odometer_scale_sd must be null without an odometer, got 0\.1"),
        ({"lever_arm": [1.0]}, r"constraints\.lever_arm must have 3 numbers, got \[1\.0\]"),
        ({"lever_arm_sd": [1.0, 0.0, 1.0]}, r"lever_arm_sd must be finite positive numbers"),
    ],
)  # fmt: skip
def test_settings_that_mean_nothing_are_refused(settings: Any, words: str) -> None:
    check_refused([(words, lambda: Constraints(**settings))], remedy=False)
