"""Filters in invariant charts: the error does not hold the state, turns carry over, errors are as large as stated."""

import math
from dataclasses import replace

import heading_cases
import numpy as np
import pytest
import torch
from filter_cases import method_of
from refusals import check_refused
from scipy.spatial.transform import Rotation

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    InvariantFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    run_filter,
)
from pfbench.filter.belief import StepInfo
from pfbench.filter.gaussian.invariant import ChartModel
from pfbench.model import StrapdownTotal, linear_walk
from pfbench.nav.strapdown import PreintegratedImu

EKF = GaussianFilter(TaylorLinearisation())
CKF = GaussianFilter(SigmaPointLinearisation(CubaturePoints()))
LEFT = InvariantFilter(EKF, "left")


def skew(a: np.ndarray) -> np.ndarray:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


@pytest.mark.parametrize("side", ["left", "right"])
def test_a_step_is_linear_in_errors_of_any_size(side: str) -> None:
    """The differences after a step are a matrix without the state times those before [Barrau and Bonnabel 2017]."""
    model, u = StrapdownTotal(heading_cases.tuning(90.0)), heading_cases.weave(4.0)
    u = PreintegratedImu(*(a[:, 6] for a in u))
    rng, span = np.random.default_rng(1), float(u.duration[0])
    d = np.concatenate(
        [rng.normal(size=3), 9 * rng.normal(size=3), 35 * rng.normal(size=3), np.zeros(6)]
    )
    x = np.concatenate([rng.normal(size=4), 5 * rng.normal(size=6), np.zeros(6)])
    x[:4] /= np.linalg.norm(x[:4])
    chart, state = model.group_chart(side), torch.from_numpy(x)[None, None]
    moved = chart.add(state, torch.from_numpy(d))
    zero = torch.zeros(1, 1, 12, dtype=torch.float64)
    after = chart.subtract(model.propagate(moved, u, zero), model.propagate(state, u, zero))
    phi, nu, rho = d[:3], d[3:6], d[6:9] + span * d[3:6]
    turn = Rotation.from_quat(np.roll(u.rotation[0].numpy(), -1)).as_matrix().T
    push, shift = u.velocity_increment[0].numpy(), u.position_increment[0].numpy()
    if side == "left":
        expected = [
            turn @ phi,
            turn @ (nu - skew(push) @ phi),
            turn @ (rho - skew(shift) @ phi),
        ]
    else:
        fall = skew(np.array([0, 0, -9.8])) @ phi
        expected = [phi, nu + span * fall, rho + span**2 / 2 * fall]
    assert np.allclose(after[0, 0, :9].numpy(), np.concatenate(expected), rtol=0, atol=1e-11)


@pytest.mark.parametrize("is_invariant", [True, False])
def test_the_covariance_of_the_invariant_filter_does_not_depend_on_the_heading(
    is_invariant: bool,
) -> None:
    """Two starts of one record with headings 70 degrees apart have equal covariances in the left chart alone."""
    model, record, _ = heading_cases.draw(45.0, 1, 6.0, seed=3)
    other = torch.from_numpy(Rotation.from_euler("z", 70, degrees=True).as_quat()[[3, 0, 1, 2]])
    chart = model.group_chart("left")
    covariances = []
    for q in (model.origin[:4], other):

        def in_left_chart(t: int, info: StepInfo) -> dict[str, torch.Tensor]:
            slope = heading_cases.change(model, chart, info.mean)
            return {"covariance": (slope @ info.covariance() @ slope.mT)[:, :9, :9]}

        start = torch.cat([q, model.origin[4:]])[None]
        result = run_filter(
            LEFT if is_invariant else EKF,
            model,
            record._replace(start=start),
            PhiloxStream(1, torch.arange(1)),
            in_left_chart,
        )
        covariances.append(result.trace["covariance"][0])
    scale = covariances[0].diagonal(dim1=-2, dim2=-1).sqrt()
    scale = scale.unsqueeze(-1) * scale.unsqueeze(-2)
    gap = float(((covariances[0] - covariances[1]) / scale).abs().max())
    assert gap < 0.02 if is_invariant else gap > 0.2, gap


def test_at_ninety_degrees_the_invariant_filter_states_its_error() -> None:
    runs, seconds = 6, 30.0
    left, plain = (heading_cases.measure(m, 90.0, runs, seconds) for m in (LEFT, EKF))
    # a mean over time has at most the variance of one time, 2 / 15 for a chi-square of 15 over 15
    error = math.sqrt(2 / 15 / runs)
    assert abs(left["nees_10_30"] - 1.0) < 3 * error
    assert plain["nees_10_30"] > 3.0
    assert left["settled"] == runs > plain["settled"]


@pytest.mark.parametrize("method", [EKF, CKF, GaussianFilter(CKF.linearisation, iterations=3)])
@pytest.mark.parametrize("side", ["left", "right"])
def test_without_errors_of_attitude_all_charts_are_one(method: GaussianFilter, side: str) -> None:
    tuning = replace(
        heading_cases.tuning(1e-4), attitude_sd_deg=[1e-4] * 3, gyro_density=1e-8,
        gyro_bias_sd_deg_s=1e-6, gyro_bias_walk=1e-12,
    )  # fmt: skip
    _, record, _ = heading_cases.draw(1e-4, 2, 4.0, seed=3)
    model, draws = StrapdownTotal(tuning), PhiloxStream(1, torch.arange(2))
    plain = run_filter(method, model, record, draws)
    other = run_filter(InvariantFilter(method, side), model, record, draws)
    # errors of attitude of 2e-6 rad, at 10 m and 10 m/s
    assert torch.allclose(plain.mean, other.mean, rtol=0, atol=1e-3)
    assert torch.allclose(plain.variance.sqrt(), other.variance.sqrt(), rtol=1e-3, atol=1e-9)


def test_particles_are_the_same_in_any_chart() -> None:
    model, record, _ = heading_cases.draw(1.0, 2, 3.0, seed=3)
    draws, method = PhiloxStream(1, torch.arange(2)), ParticleFilter(300)
    plain, left = (
        run_filter(m, model, record, draws) for m in (method, InvariantFilter(method, "left"))
    )
    assert torch.equal(plain.log_evidence, left.log_evidence)
    # the mean on a group differs by half the variance of attitude, 1e-3, times 15 m/s or 20 m
    assert torch.allclose(plain.mean, left.mean, rtol=0, atol=0.01)
    assert torch.allclose(plain.variance, left.variance, rtol=0.1, atol=1e-9)


def test_the_configured_filter_is_the_left_invariant_one() -> None:
    assert method_of("invariant_ekf") == LEFT
    assert not LEFT.is_exact
    assert LEFT.has_evidence


@pytest.mark.parametrize(
    "message", ["filter.chart must be an invariant chart of the model, got left"]
)
def test_a_model_without_a_group_is_refused_at_the_start(message: str) -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    check_refused(
        [
            (
                message,
                lambda: run_filter(
                    LEFT, model, Record(torch.zeros(1, 2, 1)), PhiloxStream(1, torch.arange(1))
                ),
            ),
            (
                r"which has none\. Choose filter=ekf, or a scenario",
                lambda: ChartModel(model, "left"),
            ),
        ],
        remedy=False,
    )
