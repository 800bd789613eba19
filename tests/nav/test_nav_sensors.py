"""Sensor errors: sizes, laws in time, and independence of what else is switched on."""

import math

import pytest
import torch

from pfbench.core.random_stream import PhiloxStream
from pfbench.nav import imu_errors
from pfbench.nav.imu_errors import ImuErrors, add_imu_errors

N, DT = 300, 0.01
STILL = torch.zeros(N, 3, dtype=torch.float64)
TACTICAL = ImuErrors(1.0, 0.5, 300.0, 0.125, 1000.0, 200.0, 100.0, 50.0)


def draws(runs: int, seed: int = 1) -> PhiloxStream:
    return PhiloxStream(seed, torch.arange(runs))


def test_units():
    assert TACTICAL.gyro_bias == pytest.approx(4.84814e-6, rel=1e-6)
    assert TACTICAL.gyro_markov == pytest.approx(0.5 * 4.84814e-6, rel=1e-6)
    assert TACTICAL.gyro_random_walk == pytest.approx(0.125 * 2.908882e-4, rel=1e-6)
    assert TACTICAL.accelerometer_bias == pytest.approx(9.80665e-3)
    assert TACTICAL.accelerometer_markov == pytest.approx(200 * 9.80665e-6)
    assert TACTICAL.accelerometer_random_walk == pytest.approx(50 * 9.80665e-6)


def test_perfect_sensors_change_nothing():
    dtheta, dv = draws(2).normal("motion", N, 3), draws(2).normal("force", N, 3)
    made = add_imu_errors(dtheta, dv, DT, ImuErrors(), draws(2))
    assert torch.equal(made.dtheta, dtheta)
    assert torch.equal(made.dv, dv)
    assert made.gyro_markov.shape == (2, N, 3)


def test_increments_hold_exactly_the_errors_that_are_reported():
    made = add_imu_errors(
        STILL, STILL, DT, ImuErrors(1.0, 0.5, 300.0, 0.0, 1000.0, 200.0, 100.0, 0.0), draws(4)
    )
    gyro = (made.gyro_bias[:, None] + made.gyro_markov) * DT
    accelerometer = (made.accelerometer_bias[:, None] + made.accelerometer_markov) * DT
    assert torch.equal(made.dtheta, gyro)
    assert torch.equal(made.dv, accelerometer)


def test_biases_are_drawn_or_given():
    drawn = add_imu_errors(STILL[:1], STILL[:1], DT, TACTICAL, draws(4000))
    for bias, sigma in (
        (drawn.gyro_bias, TACTICAL.gyro_bias),
        (drawn.accelerometer_bias, TACTICAL.accelerometer_bias),
    ):
        # 12 000 normals: the standard error of the variance is sqrt(2 / 12000) = 1.3 %
        assert bias.square().mean() / sigma**2 == pytest.approx(1, abs=0.05)
        assert bias.mean() / sigma == pytest.approx(0, abs=0.04)
    fixed = add_imu_errors(
        STILL[:1], STILL[:1], DT, ImuErrors(gyro_bias_deg_h=2.0, randomise_biases=False), draws(3)
    )
    assert (fixed.gyro_bias == 2 * imu_errors.DEG_H).all()


def test_random_walks_grow_with_the_root_of_time():
    white = ImuErrors(gyro_random_walk_deg_sqrt_h=1.0, accelerometer_random_walk_ug_sqrt_hz=1.0)
    made = add_imu_errors(STILL, STILL, DT, white, draws(1500))
    for sums, density in (
        (made.dtheta.sum(1), imu_errors.DEG_SQRT_H),
        (made.dv.sum(1), imu_errors.UG),
    ):
        # 4500 sums: standard error of the variance 2.1 %
        assert sums.square().mean() / (density**2 * N * DT) == pytest.approx(1, abs=0.085)


@pytest.mark.parametrize(
    ("n", "decay"), [(1, 0.1), (128, 0.1), (129, 1e-3), (40_000, 1e-4), (40_000, 3.0)]
)
def test_blocked_recursion_is_the_recursion(n, decay):
    noise = draws(1).normal("noise", n, 1)[0, :, 0]
    x, expected, factor = 0.0, [], math.exp(-decay)
    for value in noise.tolist():
        x = factor * x + value
        expected.append(x)
    apart = imu_errors._autoregression(noise[None], decay)[0] - torch.tensor(
        expected, dtype=torch.float64
    )
    assert apart.abs().max() < 1e-11  # sums of up to 1 / decay terms of size 1


def test_markov_process_is_stationary_with_the_right_memory():
    sigma, time, dt, runs = 2.0, 5.0, 1.0, 4000
    x = imu_errors.simulate_gauss_markov("m", 200, sigma, time, dt, draws(runs))
    # 12 000 independent values at each instant: standard error of the variance 1.3 %
    for k in (0, 1, 50, 127, 128, 199):
        assert x[:, k].var() / sigma**2 == pytest.approx(1, abs=0.05)
    for lag in (1, 3):
        together = (x[:, 128 - lag] * x[:, 128]).mean() / sigma**2
        assert together == pytest.approx(math.exp(-lag * dt / time), abs=0.05)
    assert (x[:, 100, 0] * x[:, 100, 1]).mean() / sigma**2 == pytest.approx(
        0, abs=4 / math.sqrt(runs)
    )


def test_switching_one_error_on_changes_no_other():
    alone = add_imu_errors(STILL, STILL, DT, ImuErrors(gyro_random_walk_deg_sqrt_h=0.125), draws(3))
    together = add_imu_errors(STILL, STILL, DT, TACTICAL, draws(3))
    rest = together.dtheta - (together.gyro_bias[:, None] + together.gyro_markov) * DT
    assert (rest - alone.dtheta).abs().max() < 1e-18


def test_a_run_does_not_feel_its_neighbours():
    batch = add_imu_errors(STILL, STILL, DT, TACTICAL, draws(5))
    alone = add_imu_errors(STILL, STILL, DT, TACTICAL, PhiloxStream(1, torch.tensor([3])))
    for together, single in zip(batch, alone, strict=True):
        torch.testing.assert_close(together[3], single[0], rtol=1e-12, atol=0)


def test_scale_factor_and_misalignment():
    skewed = ((1e-3, 2e-3, 0.0), (0.0, -1e-3, 0.0), (0.0, 0.0, 0.0))
    made = add_imu_errors(STILL + 1, STILL + 2, DT, ImuErrors(gyro_misalignment=skewed), draws(1))
    assert made.dtheta[0, 0].tolist() == pytest.approx([1.003, 0.999, 1.0], rel=1e-15)
    assert (made.dv == 2).all()


def test_a_surge_multiplies_the_variance_of_what_drives_the_errors_and_nothing_before_it():
    surge = torch.where(torch.arange(N) < N // 2, 1.0, 9.0).double()
    calm, wild = (
        add_imu_errors(STILL, STILL, DT, TACTICAL, draws(400), process) for process in (None, surge)
    )
    assert torch.equal(wild.dtheta[:, : N // 2], calm.dtheta[:, : N // 2])
    assert torch.equal(wild.gyro_bias, calm.gyro_bias)

    def driven(c: imu_errors.ImuMeasurements) -> list[torch.Tensor]:
        decay = math.exp(-DT / TACTICAL.gyro_markov_time_s)
        markov = c.gyro_markov[:, 1:] - decay * c.gyro_markov[:, :-1]
        white = c.dtheta - (c.gyro_bias[:, None] + c.gyro_markov) * DT
        return [markov[:, N // 2 :], white[:, N // 2 + 1 :]]

    for swollen, nominal in zip(driven(wild), driven(calm), strict=True):
        assert torch.allclose(
            swollen, 3.0 * nominal, rtol=1e-6, atol=1e-18
        )  # the same numbers, three times as large
