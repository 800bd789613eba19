"""The total-state model: preintegration against fine integration of the motion, its derivatives, its noise, its frames."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from refusals import check_refused
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from pfbench.core import PhiloxStream, Record, chart
from pfbench.filter import CubaturePoints, GaussianFilter, ParticleFilter, SigmaPointLinearisation
from pfbench.model import StrapdownTotal, StrapdownTuning
from pfbench.nav import attitude
from pfbench.nav.strapdown import PreintegratedImu, preintegrate, rotate

BELIEVED = StrapdownTuning(
    gyro_density=1e-2,
    accelerometer_density=0.1,
    gyro_bias_walk=1e-4,
    accelerometer_bias_walk=1e-3,
    position_sd=[1.0, 2.0, 3.0],
    velocity_sd=None,
    attitude_sd_deg=[1.0, 2.0, 3.0],
    initial_velocity_sd=[0.1, 0.2, 0.3],
    initial_position_sd=[1.0, 2.0, 3.0],
    gyro_bias_sd_deg_s=0.1,
    accelerometer_bias_sd=0.2,
    gyro_bias_deg_s=[0.3, -0.2, 0.1],
    accelerometer_bias=[0.05, -0.02, 0.3],
)
GRAVITY = 9.8


def force(t: np.ndarray | float) -> np.ndarray:
    return np.stack([2 * np.sin(3 * t), 1.5 * np.cos(2 * t) - 0.5, 9.8 + np.sin(5 * t)], -1)


def rate(t: np.ndarray | float) -> np.ndarray:
    return np.stack([0.8 * np.cos(4 * t), 0.5 * np.sin(3 * t) + 0.2, 1.2 * np.cos(2 * t)], -1)


def motion(
    duration: float, c0: np.ndarray, v0: np.ndarray, p0: np.ndarray, gravity: float
) -> tuple[np.ndarray, ...]:
    """C' = C [w x], v' = C f - g, p' = v by an adaptive integrator of order 8: attitude, velocity, position at the end."""

    def slope(t: float, s: np.ndarray) -> np.ndarray:
        c, (x, y, z) = s[:9].reshape(3, 3), rate(t)
        turn = c @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        return np.concatenate([turn.ravel(), c @ force(t) - [0, 0, gravity], s[9:12]])

    end = solve_ivp(
        slope,
        (0, duration),
        np.concatenate([c0.ravel(), v0, p0]),
        method="DOP853",
        rtol=1e-12,
        atol=1e-12,
    ).y[:, -1]
    return end[:9].reshape(3, 3), end[9:12], end[12:]


def sampled(duration: float, pieces: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Means of neighbouring samples, as the scenario makes them."""
    t = np.linspace(0.0, duration, pieces + 1)
    f, w = (torch.from_numpy(0.5 * (a[1:] + a[:-1])) for a in (force(t), rate(t)))
    return f, w, torch.full((pieces,), duration / pieces, dtype=torch.float64)


def increments(
    pieces: int = 400, duration: float = 1.0, bias: torch.Tensor | None = None
) -> PreintegratedImu:
    f, w, spans = (a[None, None] for a in sampled(duration, pieces))
    zero = torch.zeros(1, 1, 6, dtype=torch.float64) if bias is None else bias.reshape(1, 1, 6)
    u = preintegrate(f, w, spans, zero)
    return PreintegratedImu(
        *u, zero, torch.full((1, 1), GRAVITY, dtype=torch.float64), spans.sum(-1)
    )


def step(u: PreintegratedImu) -> PreintegratedImu:
    return PreintegratedImu(*(leaf[:, 0] for leaf in u))


def some_states(n: int = 7) -> torch.Tensor:
    generator = np.random.default_rng(3)
    q = generator.normal(size=(1, n, 4))
    rest = generator.normal(size=(1, n, 12)) * np.repeat([5.0, 50.0, 0.01, 0.1], 3)
    return torch.from_numpy(
        np.concatenate([q / np.linalg.norm(q, axis=-1, keepdims=True), rest], -1)
    )


def test_preintegration_is_the_motion_and_of_second_order() -> None:
    c, v, p = motion(1.0, np.eye(3), np.zeros(3), np.zeros(3), gravity=0.0)
    errors = []
    for pieces in (100, 200):
        turn, push, shift, _ = preintegrate(
            *sampled(1.0, pieces), torch.zeros(6, dtype=torch.float64)
        )
        apart = Rotation.from_matrix(attitude.dcm_from_quaternion(turn).numpy().T @ c).magnitude()
        errors.append([apart, np.linalg.norm(push.numpy() - v), np.linalg.norm(shift.numpy() - p)])
    # the trapezoidal mean misses dt^2 / 12 times the second derivative (up to 13 rad/s^3 and 25 m/s^4) over a second
    assert np.all(np.array(errors[0]) < np.array([13.0, 50.0, 50.0]) * 1e-4 / 12)
    assert np.allclose(np.array(errors[0]) / np.array(errors[1]), 4.0, atol=0.2)


def test_constant_force_without_turning_is_exact() -> None:
    f = torch.tensor([1.0, -2.0, 9.0], dtype=torch.float64)
    spans = torch.tensor([0.1, 0.25, 0.05], dtype=torch.float64)
    still = torch.zeros(3, 3, dtype=torch.float64)
    turn, push, shift, _ = preintegrate(
        f.expand(3, 3), still, spans, torch.zeros(6, dtype=torch.float64)
    )
    assert torch.allclose(turn, torch.tensor([1.0, 0, 0, 0], dtype=torch.float64), atol=1e-15)
    assert torch.allclose(push, 0.4 * f, atol=1e-14)
    assert torch.allclose(shift, 0.08 * f, atol=1e-14)


def test_pieces_of_no_duration_do_nothing() -> None:
    f, w, spans = sampled(0.5, 30)
    bias = torch.tensor([0.1, -0.2, 0.3, 0.5, -0.5, 0.2], dtype=torch.float64)
    plain = preintegrate(f, w, spans, bias)
    more = [
        torch.cat([a[:10], torch.zeros_like(a[:4]), a[10:], torch.zeros_like(a[:9])])
        for a in (f, w, spans)
    ]
    filled = preintegrate(*more, bias)
    assert all(torch.allclose(a, b, rtol=0, atol=1e-14) for a, b in zip(plain, filled, strict=True))


def test_bias_derivatives_against_finite_differences() -> None:
    arrays, bias, h = (
        sampled(1.0, 100),
        torch.tensor([0.02, -0.05, 0.03, 0.2, 0.1, -0.3], dtype=torch.float64),
        1e-5,
    )
    turn, _, _, jacobian = preintegrate(*arrays, bias)
    back = turn * turn.new_tensor([1.0, -1.0, -1.0, -1.0])
    columns = []
    for k in range(6):
        sides = []
        for sign in (1.0, -1.0):
            moved = bias.clone()
            moved[k] += sign * h
            q, v, p, _ = preintegrate(*arrays, moved)
            sides.append(
                torch.cat(
                    [
                        chart.rotation_vector_from_quaternion(chart.quaternion_multiply(back, q)),
                        v,
                        p,
                    ]
                )
            )
        columns.append((sides[0] - sides[1]) / (2 * h))
    # central differences: h^2 of truncation, 1e-15 / h of rounding; the series of the right Jacobian is cut at 1e-9
    assert torch.allclose(jacobian, torch.stack(columns, -1), rtol=0, atol=2e-9)
    assert jacobian[:3, 3:].abs().max() == 0.0


def test_a_step_is_the_strapdown_equations() -> None:
    x = some_states()
    x[..., 10:] = 0.0
    model, u = StrapdownTotal(BELIEVED), step(increments())
    moved = model.propagate(x, u, torch.zeros(1, x.shape[1], 12, dtype=torch.float64))
    for before, after in zip(x[0].numpy(), moved[0].numpy(), strict=True):
        c0 = Rotation.from_quat(before[[1, 2, 3, 0]]).as_matrix()
        c, v, p = motion(1.0, c0, before[4:7], before[7:10], GRAVITY)
        apart = (
            Rotation.from_quat(after[[1, 2, 3, 0]]).inv() * Rotation.from_matrix(c)
        ).magnitude()
        # second order in pieces of 2.5 ms, as above
        assert apart < 13.0 * 6.25e-6 / 12
        assert np.linalg.norm(after[4:7] - v) < 50.0 * 6.25e-6 / 12
        assert np.linalg.norm(after[7:10] - p) < 50.0 * 6.25e-6 / 12


def test_a_step_corrects_for_the_bias_to_first_order() -> None:
    bias = torch.tensor([0.01, -0.02, 0.015, 0.1, -0.05, 0.2], dtype=torch.float64)
    x = some_states()
    x[..., 10:] = bias
    w = torch.zeros(1, x.shape[1], 12, dtype=torch.float64)
    model = StrapdownTotal(BELIEVED)
    right = model.propagate(x, step(increments(bias=bias)), w)
    for factor, bound in (
        (1.0, 4e-3),
        (0.5, 1e-3),
    ):  # second order: g |bias w T| T, a quarter of it at half the distance
        near = model.propagate(x, step(increments(bias=(1.0 - factor) * bias)), w)
        assert model.chart.subtract(near, right).abs().max() < bound


def test_noise_enters_where_noise_gain_says() -> None:
    model, x, u = StrapdownTotal(BELIEVED), some_states(), step(increments())
    w = torch.from_numpy(np.random.default_rng(1).normal(size=(1, 7, 12)))
    quiet = model.propagate(x, u, torch.zeros_like(w))
    loud = model.propagate(x, u, w)
    assert torch.allclose(
        loud, model.chart.add(quiet, w @ model.noise_gain(u).mT), rtol=0, atol=1e-13
    )


def test_noise_of_an_interval_is_that_of_integrated_white_noise() -> None:
    model, u = StrapdownTotal(BELIEVED), step(increments(pieces=10, duration=0.4))
    gain = model.noise_gain(u)[0]
    q = gain @ gain.mT
    eye = torch.eye(3, dtype=torch.float64)
    # velocity and attitude q T, bias walks q T, velocity with position q T^2 / 2 (exact), position q T^3 / 4 of q T^3 / 3
    assert torch.allclose(q[0:3, 0:3], 1e-4 * 0.4 * eye)
    assert torch.allclose(q[3:6, 3:6], 1e-2 * 0.4 * eye)
    assert torch.allclose(q[3:6, 6:9], 1e-2 * 0.4**2 / 2 * eye)
    assert torch.allclose(q[6:9, 6:9], 1e-2 * 0.4**3 / 4 * eye)
    assert torch.allclose(q[9:12, 9:12], 1e-8 * 0.4 * eye)
    assert torch.allclose(q[12:, 12:], 1e-6 * 0.4 * eye)
    assert q[:3, 3:].abs().max() == 0.0


def test_nothing_happens_after_the_end_of_a_short_run() -> None:
    f = torch.zeros(1, 1, 3, 3, dtype=torch.float64)
    bias = torch.full((1, 1, 6), 0.1, dtype=torch.float64)
    spans = torch.zeros(1, 1, 3, dtype=torch.float64)
    u = PreintegratedImu(
        *preintegrate(f, f, spans, bias),
        bias,
        torch.full((1, 1), GRAVITY, dtype=torch.float64),
        spans.sum(-1),
    )
    x = some_states()
    after = StrapdownTotal(BELIEVED).propagate(
        x, step(u), torch.ones(1, 7, 12, dtype=torch.float64)
    )
    assert torch.allclose(after, x, rtol=0, atol=1e-14)


def test_quaternions_turn_vectors_as_their_matrices_do() -> None:
    x = some_states()
    q, a = x[..., :4], x[..., 4:7]
    assert torch.allclose(
        rotate(q, a), (attitude.dcm_from_quaternion(q) @ a.unsqueeze(-1)).squeeze(-1), atol=1e-13
    )
    assert rotate(q, a[:, :1]).shape == a.shape


def test_what_is_seen() -> None:
    x, u = some_states(), step(increments(pieces=4))
    position = StrapdownTotal(BELIEVED)
    both = StrapdownTotal(replace(BELIEVED, velocity_sd=[0.1, 0.2, 0.3]))
    assert torch.equal(position.observation(x, u).mean, x[..., 7:10])
    assert torch.equal(both.observation(x, u).mean, x[..., [7, 8, 9, 4, 5, 6]])
    y = torch.tensor([[1.0, 2.0, 3.0, torch.nan, torch.nan, torch.nan]], dtype=torch.float64)
    assert torch.allclose(both.log_likelihood(y, x, u), position.log_likelihood(y[:, :3], x, u))
    assert (both.log_likelihood(torch.full_like(y, torch.nan), x, u) == 0.0).all()


@pytest.mark.parametrize("axis", [0, 1, 2], ids=["pitch", "roll", "yaw"])
def test_attitude_errors_are_those_of_pitch_roll_and_yaw(axis: int) -> None:
    model = StrapdownTotal(BELIEVED)
    level = torch.tensor([0.0, 0.0, 2.0], dtype=torch.float64)
    off = level + 1e-5 * torch.eye(3, dtype=torch.float64)[axis]
    wrong, right = (
        attitude.quaternion_from_dcm(attitude.dcm_from_euler(euler)) for euler in (off, level)
    )
    truth = {
        "attitude": right.reshape(1, 1, 4),
        "position": torch.zeros(1, 1, 3, dtype=torch.float64),
    }
    state = model.assemble(truth)
    mean = state.clone().nan_to_num(7.0)
    mean[..., :4] = wrong
    error = model.error(mean, state)[0, 0]
    assert error.shape == (15,) == (len(model.names),)
    assert model.names[axis] == f"attitude_{('pitch', 'roll', 'yaw')[axis]}"
    assert error[axis] == pytest.approx(1e-5, rel=1e-4)
    assert error[:3].square().sum().sqrt() == pytest.approx(1e-5, rel=1e-4)
    assert torch.isnan(error[3:6]).all()  # no truth, no error
    assert torch.isnan(error[9:]).all()
    assert (error[6:9] == 0.0).all()


def test_truth_without_any_group_is_told() -> None:
    check_refused(
        [
            (
                "truth must contain a group of the model",
                lambda: StrapdownTotal(BELIEVED).assemble({"clock": torch.zeros(1, 1, 1)}),
            )
        ],
        remedy=False,
    )


def test_nominal_biases_are_turned_to_the_axes_of_the_model() -> None:
    degree = math.pi / 180
    expected = [-0.2 * degree, 0.3 * degree, -0.1 * degree, -0.02, 0.05, -0.3]  # right, forward, up
    assert torch.allclose(BELIEVED.bias, torch.tensor(expected, dtype=torch.float64))
    assert BELIEVED.initial_sd[:3].tolist() == pytest.approx([1 * degree, 2 * degree, 3 * degree])


def test_filters_start_where_the_record_says() -> None:
    model, start = StrapdownTotal(BELIEVED), some_states(2)[0]
    draws = PhiloxStream(1, torch.arange(2))
    gaussian = GaussianFilter(SigmaPointLinearisation(CubaturePoints())).init(
        model, 2, draws, start
    )
    assert torch.allclose(gaussian.mean, start)
    cloud = ParticleFilter(4000).init(model, 2, draws, start)
    d = model.chart.subtract(cloud.x, start.unsqueeze(1)) / model.p0
    # 2 x 15 means and variances of 4000 normals: five standard errors
    assert d.mean(1).abs().max() < 5 / math.sqrt(4000)
    assert (d.var(1) - 1).abs().max() < 5 * math.sqrt(2 / 4000)
    assert torch.equal(
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())).init(model, 2, draws).mean[0],
        model.origin,
    )


def test_a_record_of_another_kind_is_refused() -> None:
    y = torch.zeros(1, 1, 3, dtype=torch.float64)
    check_refused(
        [
            ("must be PreintegratedImu", lambda: StrapdownTotal(BELIEVED).prepare(Record(y))),
            (
                r"must measure the .*velocity_sd, got 6",
                lambda: StrapdownTotal(BELIEVED).prepare(
                    Record(torch.zeros(1, 1, 6), increments(4))
                ),
            ),
        ],
        remedy=False,
    )
    assert StrapdownTotal(BELIEVED).prepare(Record(y, increments(4))).y is y


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("gyro_density", 0.0),
        ("accelerometer_bias_walk", -1.0),
        ("position_sd", [1.0, 0.0, 1.0]),
        ("position_sd", [1.0, 1.0]),
        ("velocity_sd", [0.1, -0.1, 0.1]),
        ("attitude_sd_deg", [1.0, 1.0, 0.0]),
        ("gyro_bias_sd_deg_s", 0.0),
        ("accelerometer_bias_sd", float("nan")),
    ],
)
def test_impossible_beliefs_name_their_key(key: str, value: object) -> None:
    check_refused(
        [(rf"tuning\.{key}", lambda: StrapdownTotal(replace(BELIEVED, **{key: value})))],
        remedy=False,
    )
