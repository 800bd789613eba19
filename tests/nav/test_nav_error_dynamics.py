"""Error dynamics against differences of mechanisations, and the linear blocks against derivatives of the exact ones."""

import math

import pytest
import torch
from nav_reference import ARCMIN, SHORT, T003, errors, vector
from torch import Tensor

from pfbench.core.record import map_inputs
from pfbench.nav import earth, error_dynamics
from pfbench.nav.error_dynamics import NominalState
from pfbench.nav.imu_errors import DEG_H, UG
from pfbench.nav.manoeuvres import generate_manoeuvres
from pfbench.nav.strapdown import InsIntervals, align, navigate
from pfbench.nav.trajectory import TrajectoryData

NONE = vector(0, 0, 0)
LARGE = torch.cat(
    [vector(*(math.radians(a) for a in (0.1, 0.1, 20))), vector(1, 1, 1), vector(10, 10, 10)], -1
)


def differenced(
    flight: TrajectoryData, dt: float, x: Tensor, gyro: Tensor, acc: Tensor, each: int
) -> tuple[Tensor, InsIntervals]:
    """True error at the end [1, 9] of a mechanisation that starts with error x and has constant sensor errors."""
    ins = align(flight.dcm[0], flight.vel[0], flight.pos[0], *x.split(3, -1))
    end, intervals = navigate(
        ins, flight.dtheta[None] + gyro * dt, flight.dv[None] + acc * dt, dt, each
    )
    return errors(end, flight), intervals


def integrated(x: Tensor, intervals: InsIntervals, gyro: Tensor, acc: Tensor) -> Tensor:
    for t in range(intervals.f.shape[1]):
        x = error_dynamics.propagate_error(
            x, map_inputs(lambda a, t=t: a[:, t], intervals), gyro, acc
        )
    return x


def transported(x: Tensor, u: InsIntervals, gyro: Tensor, acc: Tensor) -> Tensor:
    """The linear model with constant sensor errors, each interval by the matrix exponential."""
    dcm = (u.dcm + u.dcm_end) / 2
    driven = torch.zeros(*u.duration.shape, 10, 10, dtype=torch.float64)
    driven[..., :9, :9] = error_dynamics.small_angle_matrix(u.pos, u.vel, u.f)
    driven[..., :3, 9] = -(dcm @ gyro[..., None]).squeeze(-1)
    driven[..., 3:6, 9] = (dcm @ acc[..., None]).squeeze(-1)
    steps = error_dynamics.convert_transition_to_metres(
        torch.matrix_exp(driven * u.duration[..., None, None]), u.pos_start, u.pos_end
    )
    x = torch.cat([x, torch.ones(1, 1, dtype=torch.float64)], -1)
    for step in steps.unbind(1):
        x = (step @ x[..., None]).squeeze(-1)
    return x[:, :9]


@pytest.mark.slow
def test_exact_equations_over_the_reference_flight():
    flight = generate_manoeuvres(*T003, rate=100)
    true, intervals = differenced(flight, 0.01, LARGE, NONE, NONE, each=100)
    apart = (integrated(LARGE, intervals, NONE, NONE) - true).abs()
    assert true[0, 6:8].norm() > 1000  # nothing small about these errors
    assert apart[0, :3].max() < 0.0005 * ARCMIN
    assert apart[0, 3:6].max() < 0.0005
    assert apart[0, 6:].max() < 0.01


BIASED = (vector(100, -50, 80) * DEG_H, vector(3000, -2000, 1000) * UG)


@pytest.mark.parametrize(("gyro", "acc"), [(NONE, NONE), BIASED], ids=["ideal", "biased"])
def test_exact_equations_with_large_errors(gyro, acc):
    flight = generate_manoeuvres(*SHORT, rate=40)
    true, intervals = differenced(flight, 1 / 40, LARGE, gyro, acc, each=10)
    own, _ = differenced(
        flight, 1 / 40, 0 * LARGE, NONE, NONE, each=10
    )  # the mechanisation's, 0.07 m at this rate
    apart = (integrated(LARGE, intervals, gyro, acc) - (true - own)).abs()
    # what freezing the attitude of mid-interval does to a bias: 0.03 m/s^2 (turn of a quarter second)^2 / 24, in turns
    assert apart[0, :3].max() < 0.0005 * ARCMIN
    assert apart[0, 3:6].max() < 0.0005
    assert apart[0, 6:].max() < 0.01


def test_exact_equations_broadcast_over_particles():
    flight = generate_manoeuvres(*SHORT, rate=20)
    _, intervals = differenced(flight, 0.05, LARGE, NONE, NONE, each=20)
    scales = torch.tensor([0.0, 0.5, 1.0]).double()
    swarm = scales[:, None] * LARGE[:, None]
    together = error_dynamics.propagate_error(swarm, map_inputs(lambda a: a[:, 3, None], intervals))
    alone = error_dynamics.propagate_error(0.5 * LARGE, map_inputs(lambda a: a[:, 3], intervals))
    assert together.shape == (1, 3, 9)
    torch.testing.assert_close(together[:, 1], alone, rtol=1e-13, atol=1e-15)
    assert (together[:, 0].abs() < 1e-15).all()  # no error, no sensor error: none arises


def test_linear_blocks_are_derivatives_of_the_exact_equations():
    # at 3 km/s the smallest terms kept (Coriolis with latitude, 7e-8 per metre) stand out from those left out
    pos, vel, f = vector(0.7, 0.3, 5000.0), vector(2000, -2500, 300), vector(3, -2, 9)
    nominal = NominalState(torch.eye(3).double()[None], vel, pos, f)
    exact = torch.autograd.functional.jacobian(
        lambda x: error_dynamics.error_rate(x, nominal)[0], torch.zeros(1, 9).double()
    )
    exact, linear = exact[:, 0], error_dynamics.small_angle_matrix(pos, vel, f)[0]
    first = slice(0, 6)
    torch.testing.assert_close(linear[first, first], exact[first, first], rtol=1e-12, atol=1e-18)
    torch.testing.assert_close(linear[6:, first], exact[6:, first], rtol=1e-12, atol=1e-18)
    metres = earth.metre_scale(pos)[0]
    difference = (linear - exact)[:, 6:] / metres
    # left out: change of the radii with latitude (3 e2 = 2 % of v / R^2 and v^2 / R^2); in the vertical channel also
    # that of gravity with latitude (0.05 m/s^2 per rad, 0.8e-8 per metre), and 0.5 % of its change with height
    assert difference[:3].abs().max() < 0.02 * 3200 / earth.A**2
    assert difference[3:5].abs().max() < 0.02 * 3200**2 / earth.A**2
    assert difference[5].abs().max() < 2.5e-8
    assert (difference[6:] * metres[:, None]).abs().max() < 0.02 * 3200 / earth.A


def test_coupling_matrix_is_the_rest_of_the_small_angle_matrix():
    pos, vel, f = vector(0.7, 0.3, 5000.0), vector(200, -250, 30), vector(3, -2, 9)
    rest, whole = (
        error_dynamics.coupling_matrix(pos, vel),
        error_dynamics.small_angle_matrix(pos, vel, f),
    )
    assert (rest[..., :3] == 0).all()
    assert torch.equal(rest[..., 3:], whole[..., 3:])


@pytest.mark.parametrize("tilt_deg", [0.0, 0.2])
def test_linear_model_with_constant_sensor_errors(tilt_deg):
    gyro, acc, tilt = (
        vector(0.5, -1.0, 0.8) * DEG_H,
        vector(100, -50, 80) * UG,
        math.radians(tilt_deg),
    )
    x = torch.cat([vector(tilt, -tilt, tilt), vector(0.2, 0.2, -0.1), vector(10, -5, 5)], -1)
    flight, seconds, dt = generate_manoeuvres(*SHORT, rate=40), 80, 1 / 40
    true, intervals = differenced(flight, dt, x, gyro, acc, each=40)
    ideal, _ = differenced(flight, dt, x * 0, NONE, NONE, each=40)
    apart = (transported(x, intervals, gyro, acc) - (true - ideal)).abs()
    # left out: |M - I - skew(alpha)| < 2 tilt^2 of 11 m/s^2, twice integrated, beside 0.5 % of the gravity gradient
    force = 11 * 2 * tilt**2
    assert apart[0, :3].max() < 2 * tilt**2 + 1e-7
    assert apart[0, 3:6].max() < force * seconds + 1e-3
    assert apart[0, 6:].max() < force * seconds**2 / 2 + 0.03
    if tilt:
        assert true[0, 6:].norm() > 20 * apart[0, 6:].norm()
    else:
        assert true[0, 6:].norm() > 100 * apart[0, 6:].norm()


def test_in_metres_scales_each_side_at_its_own_end():
    start, end = vector(0.5, 0, 0), vector(0.9, 0, 1e5)
    unit = torch.eye(12).double()[None]
    made = error_dynamics.convert_transition_to_metres(unit, start, end)
    ratio = earth.metre_scale(end) / earth.metre_scale(start)
    expected = torch.cat([torch.ones(1, 6).double(), ratio, vector(1, 1, 1)], -1)
    torch.testing.assert_close(made, torch.diag_embed(expected))
    full = torch.ones(1, 9, 9).double()
    assert (
        error_dynamics.convert_transition_to_metres(full, start, end)[0, 6, 0]
        == earth.metre_scale(end)[0, 0]
    )
    assert (
        error_dynamics.convert_transition_to_metres(full, start, end)[0, 0, 7]
        == 1 / earth.metre_scale(start)[0, 1]
    )
