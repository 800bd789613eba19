"""Paths that are sums of ramps: derivatives, closure of the mechanisation, and the two readings of the SINS/SAR flight."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from nav_reference import errors, true_start
from torch import Tensor

from pfbench import job
from pfbench.job.config import compose_tree
from pfbench.nav import attitude, earth
from pfbench.nav.manoeuvres import (
    CosineRamp,
    CycloidRamp,
    RampTrajectory,
    cruise,
    generate_manoeuvres,
)
from pfbench.nav.strapdown import navigate
from pfbench.nav.trajectory import TrajectoryData, TrajectoryStart

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


@every_path
def test_the_rate_changes_nothing_but_the_sampling_of_ramps(path: RampTrajectory) -> None:
    coarse, fine = path.generate(20.0), path.generate(100.0)
    metres = (coarse.pos - fine.pos[::5]) * earth.metre_scale(coarse.pos)
    assert (
        metres.abs().max() < 1e-6
    )  # Gauss with three nodes: the sixth derivative of a ramp of 6 s times 0.05^6
    assert (coarse.dcm - fine.dcm[::5]).abs().max() < 1e-12
    assert (coarse.dv - fine.dv.unflatten(0, (-1, 5)).sum(1)).abs().max() < 1e-8
    assert (coarse.dtheta - fine.dtheta.unflatten(0, (-1, 5)).sum(1)).abs().max() < 1e-8


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
