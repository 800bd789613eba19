"""Trajectories: kinematics that differentiate into each other, sensors that feel what they should."""

from collections.abc import Callable
from functools import partial

import hydra
import numpy as np
import pyproj
import pytest
import torch
from nav_reference import SHORT, T003, T004, errors, true_start
from torch import Tensor

from pfbench import job
from pfbench.job.config import compose_tree
from pfbench.nav import attitude, earth
from pfbench.nav.manoeuvres import (
    CosineRamp,
    CycloidRamp,
    ManoeuvreSegment,
    RampTrajectory,
    accelerate,
    climb,
    cruise,
    generate_manoeuvres,
    turn,
)
from pfbench.nav.strapdown import navigate
from pfbench.nav.trajectory import TrajectoryData, TrajectoryStart


@pytest.mark.parametrize(
    ("plan", "seconds", "speed", "height"), [(T003, 300, 100, 1442.46), (T004, 500, 120, 896.01)]
)
def test_reference_flights_end_where_they_should(plan, seconds, speed, height):
    made = generate_manoeuvres(*plan, rate=20)
    assert made.time[-1] == seconds
    assert made.vel[-1].norm() == pytest.approx(speed, rel=1e-12)
    assert made.pos[-1, 2] == pytest.approx(height, abs=0.005)


def test_velocity_is_the_derivative_of_position():
    made = generate_manoeuvres(*SHORT, rate=100)
    inner = slice(1, -1)
    difference = (made.pos[2:] - made.pos[:-2]) * 50
    apart = (
        difference - earth.position_rate(made.pos[inner], made.vel[inner])
    ) * earth.metre_scale(made.pos[inner])
    # central differences err by jerk d^2 / 6, with jerks below 10 m/s^3, and by d / 4 times a step of acceleration
    smooth = torch.ones(len(apart), dtype=torch.bool)
    smooth[[999, 4999, 5999, 6999]] = (
        False  # samples 1000, 5000, ..., where acceleration and braking begin and end
    )
    assert apart[smooth].abs().max() < 10 / 6 * 1e-4
    assert apart.abs().max() < 4 / 4 * 0.01 * 1.01


def test_northward_flight_covers_the_geodesic():
    made = generate_manoeuvres([cruise(300)], TrajectoryStart(50, 10, height=0, speed=100), rate=10)
    lat, lon = np.degrees(made.pos[:, 0].numpy()), np.degrees(made.pos[:, 1].numpy())
    _, _, distance = pyproj.Geod(ellps="WGS84").inv(lon[0], lat[0], lon[-1], lat[-1])
    assert distance == pytest.approx(30_000, abs=1e-6)
    assert lon[-1] == lon[0]


def test_eastward_flight_follows_the_parallel():
    made = generate_manoeuvres(
        [cruise(300)], TrajectoryStart(50, 10, height=2000, speed=100, heading_deg=90), rate=10
    )
    metres = (made.pos[-1] - made.pos[0]) * earth.metre_scale(made.pos[0])
    assert metres.tolist() == pytest.approx([0, 30_000, 0], abs=1e-6)


def test_a_turn_to_the_right_turns_the_nose_and_banks_to_the_right():
    made = generate_manoeuvres(
        [turn(90, 30), cruise(1)], TrajectoryStart(45, 0, 1000, speed=50), rate=10
    )
    pitch, roll, yaw = attitude.euler_from_dcm(made.dcm).unbind(-1)
    assert yaw[-1] == pytest.approx(-torch.pi / 2, abs=1e-12)
    assert made.vel[-1].tolist() == pytest.approx([50, 0, 0], abs=1e-12)
    assert roll[1:299].min() > 0
    assert pitch.abs().max() < 1e-15


def test_turns_are_coordinated():
    # a coordinated turn is felt straight down: sideways only Coriolis, 2 w_e V = 0.015 m/s^2, and gravity's departure
    # from 9.80665 times the sine of the bank
    made = generate_manoeuvres(*T003, rate=20)
    sideways, bank = made.dv[:, 0] * 20, attitude.euler_from_dcm(made.dcm)[:, 1]
    assert sideways.abs().max() < 0.015 + 0.02 * bank.abs().max().sin()


@pytest.mark.parametrize("heading", [0.0, 30.0, 200.0])
def test_a_vehicle_at_rest_feels_the_earth_turn_and_gravity(heading):
    made = generate_manoeuvres(
        [cruise(2)], TrajectoryStart(55, 37, 200, heading_deg=heading), rate=50
    )
    level = made.dcm[0].T
    g = earth.gravity(made.pos[0, 0], made.pos[0, 2]) * torch.tensor(
        [0.0, 0.0, 1.0], dtype=torch.float64
    )
    assert (made.dtheta * 50 - level @ earth.earth_rate(made.pos[0, 0])).abs().max() < 1e-18
    assert (made.dv * 50 - level @ g).abs().max() < 1e-14
    assert (made.pos == made.pos[0]).all()


def test_single_segments_and_manoeuvres_mix():
    whole = generate_manoeuvres(
        [cruise(2), climb(5, 2, 2)], TrajectoryStart(10, 10, 100, speed=30), rate=10
    )
    parts = generate_manoeuvres(
        [ManoeuvreSegment(2.0), *climb(5, 2, 2)], TrajectoryStart(10, 10, 100, speed=30), rate=10
    )
    assert torch.equal(whole.pos, parts.pos)


@pytest.mark.parametrize("convert", ["none", "all"])
def test_flights_can_be_written_in_yaml(convert):
    def call(name: str, **arguments: float) -> dict[str, object]:
        return {
            "_target_": f"pfbench.nav.{'trajectory' if name == 'TrajectoryStart' else 'manoeuvres'}.{name}",
            **arguments,
        }

    plan = [
        call("cruise", duration_s=5),
        call("climb", angle_deg=5, pitch_duration_s=2, hold_duration_s=3),
    ]
    start = call("TrajectoryStart", lat_deg=10, lon_deg=20, height=300, speed=25)
    made = hydra.utils.instantiate(
        call("generate_manoeuvres", segments=plan, start=start, rate=10) | {"_convert_": convert}
    )
    same = generate_manoeuvres(
        [cruise(5), climb(5, 2, 3)], TrajectoryStart(10, 20, 300, speed=25), rate=10
    )
    assert torch.equal(made.dv, same.dv)


def test_a_smooth_start_gains_the_same_speed_without_a_step_in_acceleration():
    start = TrajectoryStart(lat_deg=34.0, lon_deg=108.0, height=0.0)
    smooth, hard = (
        generate_manoeuvres([accelerate(2.0, 10.0, smooth), cruise(5.0)], start, rate=100.0)
        for smooth in (True, False)
    )
    assert smooth.vel[-1].norm() == pytest.approx(20.0, abs=1e-9)
    assert hard.vel[-1].norm() == pytest.approx(20.0, abs=1e-9)
    jump = [
        flight.dv[:, 1].diff().abs().max().item() * 100.0 for flight in (smooth, hard)
    ]  # m/s^2 from sample to sample
    # the quintic's jerk is at most 10 / sqrt(3) dV / T^2 = 1.155 m/s^3, so 0.0116 m/s^2 a sample; the hard start jumps by 2
    assert jump[0] < 0.0125
    assert jump[1] == pytest.approx(2.0, abs=0.05)


RAMPS = [CosineRamp(2.0, 5.0, -4.0), CycloidRamp(2.0, 5.0, -4.0)]
either = pytest.mark.parametrize("ramp", RAMPS, ids=lambda ramp: type(ramp).__name__)
START = TrajectoryStart(lat_deg=-41.0, lon_deg=30.0, height=1500.0, speed=60.0, heading_deg=200.0)
# all at once, so that every product of derivatives counts
CLIMBING = RampTrajectory(
    START, 30.0, (CosineRamp(2.0, 12.0, 40.0), CycloidRamp(20.0, 28.0, -30.0)), (CycloidRamp(3.0, 9.0, 12.0), CosineRamp(15.0, 25.0, -20.0)),
    (CosineRamp(4.0, 24.0, 130.0), CycloidRamp(6.0, 16.0, -40.0)),
)  # fmt: skip
RISING = RampTrajectory(
    START,
    30.0,
    CLIMBING.speed,
    heading_deg=CLIMBING.heading_deg,
    climb_rate_changes=(CycloidRamp(3.0, 9.0, 12.0), CosineRamp(15.0, 25.0, -20.0)),
)
PATHS = {"climb angle": CLIMBING, "climb rate": RISING}
every_path = pytest.mark.parametrize("path", PATHS.values(), ids=list(PATHS))


def times(*values: float) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


# one ramp


@either
def test_a_ramp_changes_by_its_change_and_by_nothing_outside(
    ramp: CosineRamp | CycloidRamp,
) -> None:
    value, rate, second = ramp.evaluate(times(-3.0, 2.0, 3.5, 5.0, 80.0))
    assert value.tolist() == pytest.approx(
        [0.0, 0.0, -2.0, -4.0, -4.0], abs=1e-15
    )  # half way in the middle
    assert rate[[0, 1, 3, 4]].abs().max() < 1e-15
    assert second[[0, 4]].tolist() == pytest.approx([0.0, 0.0], abs=1e-14)
    # the rate is largest in the middle: pi / 2, and 2, times that of a straight line
    steepest = {CosineRamp: np.pi / 2, CycloidRamp: 2.0}[type(ramp)] * -4.0 / 3.0
    assert rate[2].item() == pytest.approx(steepest, rel=1e-12)


@either
def test_a_ramps_derivatives_are_those_of_its_values(ramp: CosineRamp | CycloidRamp) -> None:
    h = 1e-5
    t = torch.linspace(
        0.005, 7.005, 701, dtype=torch.float64
    )  # never at an end, where the cosine's second derivative jumps
    (value, rate, second), before, after = (
        ramp.evaluate(t),
        ramp.evaluate(t - h),
        ramp.evaluate(t + h),
    )
    # central differences err by h^2 / 6 times the next derivative, below 40 here, and by rounding, 1e-15 / h
    assert ((after[0] - before[0]) / (2 * h) - rate).abs().max() < 2e-9
    assert ((after[1] - before[1]) / (2 * h) - second).abs().max() < 2e-9
    assert value.diff().max() <= 0.0  # one way


def test_a_cycloid_has_a_continuous_second_derivative_where_a_cosine_jumps() -> None:
    cosine, cycloid = (
        ramp.evaluate(times(2.0 - 1e-9, 2.0 + 1e-9))[2].diff().abs().item() for ramp in RAMPS
    )
    assert cosine == pytest.approx(2.0 * (np.pi / 3.0) ** 2, rel=1e-9)
    assert cycloid < 1e-6


# a motion made of them


@every_path
def test_the_motion_is_its_own_derivative(path: RampTrajectory) -> None:
    h = 1e-5
    t = torch.linspace(0.005, 29.995, 3000, dtype=torch.float64)
    m, before, after = (
        path.compute_motion(t),
        path.compute_motion(t - h),
        path.compute_motion(t + h),
    )
    for name in ("speed", "climb", "heading"):
        slope = (getattr(after, name) - getattr(before, name)) / (2 * h)
        assert (slope - getattr(m, f"{name}1")).abs().max() < 1e-8, name
    assert ((after.heading1 - before.heading1) / (2 * h) - m.heading2).abs().max() < 1e-8


def test_changes_add_up_and_angles_are_degrees_clockwise() -> None:
    made = CLIMBING.generate(10.0)
    east, north, up = made.vel[-1].tolist()
    assert made.vel[-1].norm().item() == pytest.approx(70.0, rel=1e-12)
    assert np.degrees(np.arctan2(east, north)) % 360 == pytest.approx(290.0, abs=1e-9)
    assert np.degrees(np.arcsin(up / 70.0)) == pytest.approx(-8.0, abs=1e-9)


def test_the_climb_rate_is_the_vertical_speed_and_speed_then_the_horizontal_one() -> None:
    made = RISING.generate(20.0)
    up = sum(
        (ramp.evaluate(made.time)[0] for ramp in RISING.climb_rate_changes),
        torch.zeros_like(made.time),
    )
    level = 60.0 + sum(
        (ramp.evaluate(made.time)[0] for ramp in RISING.speed), torch.zeros_like(made.time)
    )
    assert (made.vel[:, 2] - up).abs().max() < 1e-12
    assert (made.vel[:, :2].norm(dim=-1) - level).abs().max() < 1e-12
    # from 3 s to 9 s up to 12 m/s, on to 15 s, to 25 s down to -8 m/s: each ramp's mean is half its change
    assert made.pos[-1, 2].item() == pytest.approx(
        1500.0 + 6 * 6 + 12 * 6 + 2 * 10 - 8 * 5, abs=1e-6
    )


def test_a_vehicle_that_stands_still_has_no_rates() -> None:
    still = RampTrajectory(
        TrajectoryStart(10.0, 20.0, 300.0), 2.0, climb_rate_changes=(CycloidRamp(5.0, 6.0, 1.0),)
    ).generate(10.0)
    assert (still.vel == 0.0).all()
    assert (still.pos == still.pos[0]).all()
    assert torch.isfinite(still.dtheta).all()


def test_without_ramps_it_is_a_cruise() -> None:
    plain, same = (
        RampTrajectory(START, 4.0).generate(25.0),
        generate_manoeuvres([cruise(4.0)], START, 25.0),
    )
    for name in TrajectoryData._fields:
        assert torch.allclose(getattr(plain, name), getattr(same, name), rtol=1e-13, atol=1e-13), (
            name
        )


@every_path
def test_velocity_along_ramps_is_the_derivative_of_position(path: RampTrajectory) -> None:
    made = path.generate(100.0)
    inner = slice(1, -1)
    difference = (made.pos[2:] - made.pos[:-2]) * 50.0
    apart = (
        difference - earth.position_rate(made.pos[inner], made.vel[inner])
    ) * earth.metre_scale(made.pos[inner])
    assert apart.abs().max() < 30.0 / 6 * 1e-4  # jerks, with their jumps, are below 30 m/s^3


@pytest.mark.parametrize(
    ("generate", "bound"),
    [
        (partial(generate_manoeuvres, *SHORT), 1e-9),
        *((path.generate, 1e-8) for path in PATHS.values()),
    ],
)
def test_the_rate_changes_nothing_but_the_sampling(
    generate: Callable[[float], TrajectoryData], bound: float
) -> None:
    # three nodes of Gauss integrate to d^6: a quintic of 5 s, and a ramp of 6 s, leave 1e-9 of 100 m in 0.05 s at the most
    coarse, fine = generate(20.0), generate(100.0)
    metres = (coarse.pos - fine.pos[::5]) * earth.metre_scale(coarse.pos)
    assert metres.abs().max() < 1e-6
    assert (coarse.dcm - fine.dcm[::5]).abs().max() < 1e-12
    assert (coarse.dv - fine.dv.unflatten(0, (-1, 5)).sum(1)).abs().max() < bound
    assert (coarse.dtheta - fine.dtheta.unflatten(0, (-1, 5)).sum(1)).abs().max() < bound


@every_path
def test_the_mechanisation_closes_along_ramps(path: RampTrajectory) -> None:
    """Ideal sensors bring the INS back to the path but for errors of at least second order in the sampling, and nothing else."""
    left = []
    for rate in (50.0, 100.0):
        made = path.generate(rate)
        ins, _ = navigate(
            true_start(made), made.dtheta[None], made.dv[None], 1 / rate, len(made.dtheta)
        )
        left.append(errors(ins, made)[0])
    coarse, fine = left
    groups = (
        (slice(0, 3), 1e-7),
        (slice(3, 6), 1e-3),
        (slice(6, 9), 1e-2),
    )  # rad, m/s, m; turning at 10 deg/s
    for part, allowed in groups:
        assert fine[part].abs().max() < allowed
        assert (
            fine[part].norm() < coarse[part].norm() / 3.7 + 1e-10
        )  # 4, but for what higher orders take back


# what cannot be flown


def test_a_cosine_must_begin_and_end_at_samples_and_a_cycloid_need_not() -> None:
    with pytest.raises(
        ValueError, match=r"start_s of a CosineRamp must be a multiple of 0\.1 s .*got 2\.05"
    ):
        RampTrajectory(START, 10.0, heading_deg=(CosineRamp(2.05, 8.0, 30.0),)).generate(10.0)
    RampTrajectory(START, 10.0, heading_deg=(CycloidRamp(2.05, 8.0, 30.0),)).generate(10.0)
    RampTrajectory(START, 10.0, heading_deg=(CosineRamp(12.05, 18.0, 30.0),)).generate(
        10.0
    )  # never reached


# the printed flight


def printed(scenario: str) -> TrajectoryData:
    cfg = compose_tree([f"scenario={scenario}"])
    made: TrajectoryData = job.instantiate(cfg.scenario).trajectory.generate(10.0)
    return made


def roll_deg(flight: TrajectoryData) -> Tensor:
    return torch.rad2deg(attitude.euler_from_dcm(flight.dcm)[:, 1])


@pytest.mark.parametrize("scenario", ["sar_flight", "sar_flight_constant_errors"])
def test_the_sar_flight_goes_where_it_is_said_to_go(scenario: str) -> None:
    made = printed(scenario)
    assert torch.rad2deg(made.pos[0, :2]).tolist() == pytest.approx([34.2, 108.9], abs=1e-12)
    assert made.vel[0].tolist() == pytest.approx([0.0, 100.0, 0.0], abs=1e-12)
    assert torch.rad2deg(attitude.euler_from_dcm(made.dcm[0])).tolist() == pytest.approx(
        [0.0, 0.0, 0.0], abs=1e-12
    )
    assert torch.rad2deg(made.pos[-1, :2]).tolist() == pytest.approx(
        [34.8, 110.6], abs=1e-6
    )  # 0.1 m
    assert made.pos[-1, 2].item() == pytest.approx(2748.0, abs=0.05)
    assert made.pos[:, 2].max().item() == pytest.approx(5875.0, abs=0.05)
    assert made.vel.norm(dim=-1).max().item() == pytest.approx(190.0, rel=1e-12)
    assert made.time[-1] == 1000.0
    assert roll_deg(made).max().item() == pytest.approx(34.4, abs=0.05)


def test_the_slow_reading_keeps_speeds_distance_and_heights() -> None:
    made = printed("sar_flight_slow")
    speed = made.vel.norm(dim=-1)
    assert speed[0].item() * 3.6 == pytest.approx(100.0, rel=1e-12)
    assert speed.max().item() * 3.6 == pytest.approx(190.0, rel=1e-12)
    assert torch.trapezoid(speed, made.time).item() == pytest.approx(28_000.0, abs=0.1)
    assert made.pos[0, 2] == 2000.0
    assert made.pos[:, 2].max().item() == pytest.approx(5875.0, abs=0.05)
    assert made.pos[-1, 2].item() == pytest.approx(2748.0, abs=0.05)
    assert roll_deg(made).abs().max() < 12.0
