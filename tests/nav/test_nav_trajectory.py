"""Trajectories: kinematics that differentiate into each other, sensors that feel what they should."""

import hydra
import numpy as np
import pyproj
import pytest
import torch
from nav_reference import SHORT, T003, T004

from pfbench.nav import attitude, earth
from pfbench.nav.manoeuvres import (
    ManoeuvreSegment,
    accelerate,
    climb,
    cruise,
    generate_manoeuvres,
    turn,
)
from pfbench.nav.trajectory import TrajectoryStart


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


def test_the_rate_changes_nothing_but_the_sampling():
    coarse, fine = generate_manoeuvres(*SHORT, rate=20), generate_manoeuvres(*SHORT, rate=100)
    metres = (coarse.pos - fine.pos[::5]) * earth.metre_scale(coarse.pos)
    # three nodes of Gauss integrate to d^6; a quintic of 5 s in 0.05 s leaves 1e-9 of 100 m at the most
    assert metres.abs().max() < 1e-6
    assert (coarse.dcm - fine.dcm[::5]).abs().max() < 1e-12
    assert (coarse.dv - fine.dv.unflatten(0, (-1, 5)).sum(1)).abs().max() < 1e-9
    assert (coarse.dtheta - fine.dtheta.unflatten(0, (-1, 5)).sum(1)).abs().max() < 1e-9


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
