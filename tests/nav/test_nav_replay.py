"""Replayed motions: close to what was recorded, and position, velocity, attitude and sensors agree with each other."""

import math
from dataclasses import replace

import pytest
import torch
from torch import Tensor

from pfbench.core import chart
from pfbench.nav import attitude, earth, strapdown
from pfbench.nav.manoeuvres import accelerate, climb, cruise, generate_manoeuvres, turn
from pfbench.nav.trajectory import MotionSpline, RecordedMotion, TrajectoryData, TrajectoryStart

PLAN = [
    cruise(4),
    accelerate(1.5, 10, True),
    turn(90, 10),
    climb(5, 5, 5),
    turn(-60, 8),
    accelerate(-1, 6, True),
    cruise(4),
]
START = TrajectoryStart(43.0, -79.0, 150.0, speed=8.0, heading_deg=30.0)


def flown(rate: float) -> TrajectoryData:
    return generate_manoeuvres(PLAN, START, rate)


def record(
    rate: float, position: float = 0.0, velocity: float = 0.0, angle: float = 0.0
) -> RecordedMotion:
    """The flight as a logger writes it down, with white errors of these sizes, m, m/s, rad."""
    made, generator = flown(rate), torch.Generator().manual_seed(5)

    def noise(sd: float) -> Tensor:
        return sd * torch.randn(len(made.time), 3, generator=generator, dtype=torch.float64)

    dcm = made.dcm @ attitude.dcm_from_rotation_vector(noise(angle))
    return RecordedMotion(
        made.time,
        made.pos + noise(position) / earth.metre_scale(made.pos),
        made.vel + noise(velocity),
        dcm,
    )


def apart(a: TrajectoryData, b: TrajectoryData) -> dict[str, Tensor]:
    """Differences of two flights at the same rate: m, m/s, rad, rad/s, m/s^2; each [n, 3]."""
    n, rate = min(len(a.dv), len(b.dv)), 1.0 / float(a.time[1])
    metres = (a.pos[: n + 1] - b.pos[: n + 1]) * earth.metre_scale(b.pos[: n + 1])
    turned = attitude.attitude_error(b.dcm[: n + 1], a.dcm[: n + 1])
    w, f = ((p[:n] - q[:n]) * rate for p, q in ((a.dtheta, b.dtheta), (a.dv, b.dv)))
    return {
        "position": metres,
        "velocity": a.vel[: n + 1] - b.vel[: n + 1],
        "attitude": turned,
        "rate": w,
        "force": f,
    }


def closure(flight: TrajectoryData, per_step: int = 2) -> tuple[Tensor, Tensor, Tensor]:
    """Largest errors of an exact start and the mechanisation: attitude rad, velocity m/s, position m."""
    rate, zero = round(1.0 / float(flight.time[1])), torch.zeros(1, 3, dtype=torch.float64)
    start = strapdown.InsState(flight.dcm[:1], flight.vel[:1], flight.pos[:1], zero)
    _, u = strapdown.navigate(
        start, flight.dtheta[None], flight.dv[None], 1.0 / rate, rate, per_step
    )
    true = slice(rate, None, rate)
    metres = (u.pos_end[0] - flight.pos[true]) * earth.metre_scale(flight.pos[true])
    turned = attitude.attitude_error(flight.dcm[true], u.dcm_end[0])
    return turned.abs().max(), (u.vel_end[0] - flight.vel[true]).abs().max(), metres.abs().max()


def test_a_denser_record_is_followed_more_closely() -> None:
    truth = flown(40.0)
    found = [
        apart(MotionSpline(record(rate), knot_interval_s=2.0 / rate).generate(40.0), truth)
        for rate in (10.0, 20.0, 40.0)
    ]
    # where segments meet, heading has two continuous derivatives and bank, which is its rate, one: the fourth derivative of
    # position jumps and the second of bank; a spline of enough degree then errs by that power of the distance of its knots
    orders = {"position": 4, "velocity": 3, "force": 2, "attitude": 2, "rate": 1}
    for name, order in orders.items():
        size = [float(errors[name].abs().max()) for errors in found]
        assert 2.0**order / 1.6 < size[0] / size[1] < 2.0**order * 1.6, name
        assert 2.0**order / 1.6 < size[1] / size[2] < 2.0**order * 1.6, name
    assert found[-1]["position"].abs().max() < 1e-6
    assert found[-1]["attitude"].abs().max() < 2e-5


@pytest.mark.parametrize("noise", [(0.0, 0.0, 0.0), (0.05, 0.05, 2e-3)])
def test_sensors_lead_along_the_smoothed_motion(noise: tuple[float, float, float]) -> None:
    """However bad the record is: what is replayed is one motion, and the mechanisation finds it again."""
    flight = MotionSpline(record(20.0, *noise)).generate(50.0)
    turned, velocity, position = closure(flight)
    assert turned < 1e-8
    assert velocity < 1e-5
    # velocity is joined by straight lines: T^2 / 12 of the change of acceleration, up to 10 m/s^2
    assert position < 1e-5 * flight.time[-1] + 0.04**2 / 12 * 10.0
    finer = closure(MotionSpline(record(20.0, *noise)).generate(100.0))
    # what is left falls with the square of the step at least, unless knots fall inside of samples
    assert all(float(a / b) > 3.5 for a, b in zip((turned, velocity, position), finer, strict=True))


def test_a_fast_flight_far_north_feels_the_level_frame_turn() -> None:
    made = generate_manoeuvres(
        [cruise(20)], TrajectoryStart(70.0, 20.0, 9000.0, speed=250.0, heading_deg=45.0), 20.0
    )
    error = apart(
        MotionSpline(RecordedMotion(made.time, made.pos, made.vel, made.dcm)).generate(20.0), made
    )
    # V^2 tan(latitude) / R = 0.027 m/s^2; rounding of positions, 1e-9 m, twice differentiated over knots of 0.4 s
    assert error["force"].abs().max() < 1e-6
    assert error["rate"].abs().max() < 1e-10


def test_velocity_is_the_derivative_of_position_and_turns_are_those_of_the_attitude() -> None:
    flight = MotionSpline(record(20.0, 0.05, 0.05, 2e-3)).generate(200.0)
    inner = slice(1, -1)
    slope = (flight.pos[2:] - flight.pos[:-2]) * 100.0
    rate = earth.position_rate(flight.pos[inner], flight.vel[inner])
    jerk = flight.vel.diff(n=2, dim=0).abs().max() * 200.0**2
    assert (
        (slope - rate) * earth.metre_scale(flight.pos[inner])
    ).abs().max() < 1.5 * jerk / 6 / 200.0**2
    step = attitude.quaternion_from_dcm(flight.dcm[:-1].mT @ flight.dcm[1:])
    turned = chart.rotation_vector_from_quaternion(step)
    level = earth.earth_rate(flight.pos[:-1, 0]) + earth.transport_rate(
        flight.pos[:-1, 0], flight.pos[:-1, 2], flight.vel[:-1]
    )
    felt = flight.dtheta - (flight.dcm[:-1].mT @ level[..., None]).squeeze(-1) / 200.0
    # half of an angular rate's change over a step turns the axis, and the level frame turns with the body meanwhile
    assert (turned - felt).abs().max() < 0.5 * 0.5 * flight.dtheta.diff(dim=0).norm(
        dim=-1
    ).max() * 0.01 + 1e-8


def test_least_squares_keep_the_share_of_the_noise_that_there_are_knots_for() -> None:
    rate, sd, angle = 50.0, 0.1, 1e-3
    truth = flown(rate)
    # velocities count for nothing here: position alone is fitted, and errs by sd sqrt(coefficients / instants)
    error = apart(
        replace(MotionSpline(record(rate, sd, 0.0, angle)), velocity_sd=1e9).generate(rate), truth
    )
    n, knots = len(truth.time), int(float(truth.time[-1]) / 0.4) + 1
    for name, size, coefficients in (("position", sd, knots + 4), ("attitude", angle, knots + 2)):
        square = (error[name] / size).square().mean()
        # a chi-square of 3 coefficients degrees of freedom: four standard deviations
        assert abs(float(square) * n / coefficients - 1.0) < 4.0 * math.sqrt(
            2.0 / (3 * coefficients)
        ), name


def test_recorded_velocities_count() -> None:
    truth = flown(20.0)
    noisy = MotionSpline(record(20.0, 0.1), position_sd=0.1, velocity_sd=0.001)
    with_them, without = (
        apart(r.generate(20.0), truth)["position"].square().mean()
        for r in (noisy, replace(noisy, velocity_sd=1e9))
    )
    assert (
        with_them < 0.02 * without
    )  # what is left of white position errors is their mean over the record


@pytest.mark.parametrize(
    ("whole", "seconds"), [(1.0, 57.0), (2.0, 56.0), (10.0, 50.0), (0.5, 57.0)]
)
def test_a_flight_is_cut_to_whole_intervals(whole: float, seconds: float) -> None:
    flight = MotionSpline(record(20.0), use_full_log=whole).generate(50.0)
    assert flight.time[-1] == seconds
    assert flight.pos.shape == (round(seconds * 50) + 1, 3)
    assert flight.dv.shape == flight.dtheta.shape == (round(seconds * 50), 3)


def test_a_vehicle_at_rest_feels_gravity_and_the_turning_earth() -> None:
    made = generate_manoeuvres([cruise(5)], replace(START, speed=0.0), rate=10.0)
    flight = MotionSpline(RecordedMotion(made.time + 100.0, made.pos, made.vel, made.dcm)).generate(
        50.0
    )
    level = made.dcm[0].T
    up = torch.tensor([0.0, 0.0, 1.0], dtype=torch.float64)
    assert flight.time[0] == 0.0
    assert (flight.dtheta * 50 - level @ earth.earth_rate(made.pos[0, 0])).abs().max() < 1e-10
    assert (
        flight.dv * 50 - level @ up * earth.gravity(made.pos[0, 0], made.pos[0, 2])
    ).abs().max() < 1e-6


def without(r: RecordedMotion, rows: slice) -> RecordedMotion:
    keep = torch.ones(len(r.time), dtype=torch.bool)
    keep[rows] = False
    return RecordedMotion(*(part[keep] for part in r))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda r: MotionSpline(r, knot_interval_s=0.0),
            r"trajectory\.knot_interval_s must be positive, got 0\.0",
        ),
        (
            lambda r: MotionSpline(r, knot_interval_s=0.15),
            r"trajectory\.knot_interval_s must be at least twice .*0\.100 s after .* got 0\.15",
        ),
        (
            lambda r: MotionSpline(without(r, slice(50, 60))),
            r"trajectory\.knot_interval_s must .*1\.100 s after t = 4\.900, got 0\.4",
        ),
        (lambda r: MotionSpline(r._replace(time=r.time.flip(0))), "times must increase"),
        (
            lambda r: MotionSpline(r, use_full_log=100.0),
            r"trajectory\.use_full_log must be .*57\.000 s, got 100\.0",
        ),
        (
            lambda r: MotionSpline(r, use_full_log=0.25).generate(50.0),
            r"trajectory\.use_full_log must be .* at rate=50\.0, got 0\.25 \(12\.5 samples\)",
        ),
    ],
)
def test_records_that_cannot_be_replayed_are_refused(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make(record(10.0))
