"""The mechanisation: it closes on the generator, stays put when still, and treats every run and every sample alike."""

import math
from functools import cache

import pytest
import torch
from nav_reference import SHORT, T003, T004, errors, true_start
from torch import Tensor

from pfbench.core.random_stream import PhiloxStream
from pfbench.nav import attitude, earth, strapdown
from pfbench.nav.imu_errors import ImuErrors, add_imu_errors
from pfbench.nav.manoeuvres import accelerate, cruise, generate_manoeuvres
from pfbench.nav.strapdown import InsState, navigate
from pfbench.nav.trajectory import TrajectoryData, TrajectoryStart


def closure(flight: TrajectoryData, rate: float, per_step: int = 2) -> Tensor:
    end, _ = navigate(
        true_start(flight), flight.dtheta[None], flight.dv[None], 1 / rate, per_step, per_step
    )
    return errors(end, flight)[0]


HOUR = ([cruise(3600)], TrajectoryStart(55, 37, 150, heading_deg=77))
LONG = {
    "T003 50": (T003, 50),
    "T003 100": (T003, 100),
    "T004 100": (T004, 100),
    "an hour": (HOUR, 10),
}


@cache
def long_closures() -> dict[str, Tensor]:
    """The errors of all long flights by one mechanisation, of which many runs cost little more than one.

    The shorter ones are filled up with samples of no duration, which do nothing.
    """
    flights = [generate_manoeuvres(*plan, rate) for plan, rate in LONG.values()]
    n = max(len(flight.dtheta) for flight in flights)

    def filled(rows: list[Tensor]) -> Tensor:
        return torch.stack([torch.cat([a, a.new_zeros(n - len(a), *a.shape[1:])]) for a in rows])

    starts = [true_start(flight) for flight in flights]
    start = InsState(*(torch.cat(parts) for parts in zip(*starts, strict=True)))
    spans = [
        f.dv.new_full((len(f.dv),), 1 / rate)
        for f, (_, rate) in zip(flights, LONG.values(), strict=True)
    ]
    end, _ = navigate(
        start,
        filled([f.dtheta for f in flights]),
        filled([f.dv for f in flights]),
        filled(spans),
        n,
    )
    ends = (InsState(*(a[k : k + 1] for a in end)) for k in range(len(LONG)))
    return {
        name: errors(own, flight)[0] for name, own, flight in zip(LONG, ends, flights, strict=True)
    }


@pytest.mark.slow
@pytest.mark.parametrize("flight", ["T003 100", "T004 100", "T003 20, one sample a step"])
def test_closes_on_the_generator(flight):
    error = (
        long_closures()[flight]
        if flight in LONG
        else closure(generate_manoeuvres(*T003, 20), 20, per_step=1)
    ).abs()
    assert error[:3].max() < 1e-8
    assert error[3:6].max() < 1e-4
    assert error[6:].max() < 0.02


@pytest.mark.parametrize("per_step", [1, 2])
def test_twice_the_rate_leaves_an_eighth_of_the_error_of_velocity(per_step):
    # of position a quarter, since velocity is joined by straight lines, once the eighths have become small
    coarse, fine = (closure(generate_manoeuvres(*SHORT, rate), rate, per_step) for rate in (20, 40))
    assert coarse[3:6].norm() / fine[3:6].norm() > 7
    assert 3.5 < coarse[6:].norm() / fine[6:].norm() < 8


@pytest.mark.parametrize("per_step", [1, 2])
def test_a_steady_force_in_a_body_that_turns_steadily(per_step):
    """Against the integral of the rotation in closed form, over a turn of 0.3 rad: to the fourth order of the series."""
    w, f, span = (
        torch.tensor([0.5, -0.7, 0.4]).double(),
        torch.tensor([3.0, 8.0, 9.0]).double(),
        0.316,
    )
    samples = torch.ones(1, 2, 3, dtype=torch.float64)
    spans = torch.full((1, 2), span, dtype=torch.float64)
    turn, push, _ = strapdown.correct_coning_sculling(
        samples * w * span, samples * f * span, spans, per_step, False
    )
    k, angle = attitude.skew(w), w.norm()
    whole = span * (2 if per_step == 2 else 1)
    s, c = torch.sin(angle * whole), torch.cos(angle * whole)
    swept = (
        whole * torch.eye(3).double()
        + (1 - c) / angle**2 * k
        + (angle * whole - s) / angle**3 * k @ k
    )
    assert torch.allclose(turn[0, -1], w * whole, rtol=0, atol=1e-12)
    assert (push[0, -1] - swept @ f).norm() < f.norm() * whole * (angle * whole) ** 3 / 24 * 1.01


@pytest.mark.slow
def test_twice_the_rate_leaves_a_quarter_of_the_error_over_the_reference_flight():
    coarse, fine = (long_closures()[f"T003 {rate}"] for rate in (50, 100))
    assert coarse[3:6].norm() / fine[3:6].norm() > 3.5
    assert coarse[6:].norm() / fine[6:].norm() > 3.5


@pytest.mark.slow
def test_an_hour_at_rest():
    # Horizontally Schuler's pendulum bounds the error; vertically gravity's gradient multiplies it by 280 in an hour
    error = long_closures()["an hour"].abs()
    assert error[6:8].max() < 1e-3
    assert error[8] < 1e-2
    assert error[:3].max() < 1e-9


def test_five_minutes_at_rest():
    flight = generate_manoeuvres([cruise(300)], TrajectoryStart(-55, 37, 150, heading_deg=77), 10)
    error = closure(flight, 10).abs()
    assert error[6:].max() < 1e-4
    # third order of the Earth's turn in a step, (1.5e-5)^3 / 6, in each of 1500 steps: 8e-13, and as much of rounding
    assert error[:3].max() < 5e-12


def test_a_free_fall_is_gravity_and_coriolis():
    # no force, no rotation against the stars: to first order v = g t with the Coriolis turn of 2 w_ie
    start = InsState(
        *(
            t[None]
            for t in (
                torch.eye(3),
                torch.zeros(3),
                torch.tensor([0.7, 1.0, 1000.0]),
                torch.zeros(3),
            )
        )
    )
    start = InsState(*(t.double() for t in start))
    nothing = torch.zeros(1, 100, 3, dtype=torch.float64)
    end, _ = navigate(start, nothing, nothing, 0.01, 100)
    g = earth.gravity(start.pos[0, 0], start.pos[0, 2]).item()
    eastward = g * earth.OMEGA * math.cos(0.7)  # half of 2 w g t^2 cos L at t = 1
    assert end.vel[0].tolist() == pytest.approx([eastward, 0, -g], abs=2e-5)
    assert end.pos[0, 2] == pytest.approx(1000 - g / 2, abs=1e-5)


@pytest.mark.parametrize("spans", [[0.01, 0.01], [0.005, 0.015], [0.016, 0.004]])
def test_rates_and_forces_linear_in_time(spans):
    # Savage's premise: where both are linear over the two samples, coning and sculling are caught, equal samples or not
    a, b = torch.tensor([0.6, -0.8, 0.3]).double(), torch.tensor([20.0, 30.0, -40.0]).double()
    c, e = torch.tensor([5.0, 3.0, 9.8]).double(), torch.tensor([-300.0, 400.0, 200.0]).double()
    edges = torch.tensor([0.0, *spans], dtype=torch.float64).cumsum(0)
    dtheta = (a * edges[:, None] + b * edges[:, None] ** 2 / 2).diff(dim=0)
    dv = (c * edges[:, None] + e * edges[:, None] ** 2 / 2).diff(dim=0)
    turned, pushed = fine_integration(a, b, c, e, edges[-1].item())
    start = InsState(
        *(
            x[None].double()
            for x in (torch.eye(3), torch.zeros(3), torch.tensor([0.5, 0, 0]), torch.zeros(3))
        )
    )
    end, interval = navigate(start, dtheta[None], dv[None], edges.diff(), 2)
    w = interval.w_in[0, 0] * edges[-1]
    # what is left is of third order in rotations of 0.02; coning is 1.5e-5 here, sculling 5e-4
    level_turn = attitude.dcm_from_rotation_vector(-w)
    assert attitude.attitude_error(level_turn @ turned, end.dcm[0]).norm() < 1e-7
    force = interval.f[0, 0] * edges[-1]
    assert (force - attitude.dcm_from_rotation_vector(-w / 2) @ pushed).norm() < 3e-5


def test_one_sample_form_learns_from_the_sample_before():
    a, b = torch.tensor([0.6, -0.8, 0.3]).double(), torch.tensor([20.0, 30.0, -40.0]).double()
    c, e = torch.tensor([5.0, 3.0, 9.8]).double(), torch.tensor([-300.0, 400.0, 200.0]).double()
    edges = torch.tensor([0.0, 0.006, 0.02], dtype=torch.float64)
    dtheta = (a * edges[:, None] + b * edges[:, None] ** 2 / 2).diff(dim=0)
    dv = (c * edges[:, None] + e * edges[:, None] ** 2 / 2).diff(dim=0)
    span = edges[2] - edges[1]
    turned, pushed = fine_integration(a + b * edges[1], b, c + e * edges[1], e, span.item())
    start = InsState(
        *(
            x[None].double()
            for x in (torch.eye(3), torch.zeros(3), torch.tensor([0.5, 0, 0]), torch.zeros(3))
        )
    )
    end, interval = navigate(start, dtheta[None], dv[None], edges.diff(), 1, 1)
    level_turn = attitude.dcm_from_rotation_vector(-interval.w_in[0, 1] * span)
    expected = level_turn @ interval.dcm[0, 1] @ turned
    assert attitude.attitude_error(expected, end.dcm[0]).norm() < 1e-7
    assert (interval.f[0, 1] * span - interval.dcm[0, 1] @ pushed).norm() < 3e-5


@pytest.mark.parametrize("per_step", [1, 2])
def test_preparing_steps_in_chunks_leaves_no_seam(monkeypatch, per_step):
    flight = generate_manoeuvres(*SHORT, rate=20)
    inputs = (flight.dtheta[None], flight.dv[None], 0.05, 20, per_step)
    whole, _ = navigate(true_start(flight), *inputs)
    monkeypatch.setattr(strapdown, "_CHUNK", 7)
    pieces, _ = navigate(true_start(flight), *inputs)
    for a, b in zip(whole, pieces, strict=True):
        torch.testing.assert_close(a, b, rtol=1e-14, atol=1e-14)


def test_coriolis_acts_at_the_velocity_of_mid_step():
    # lagging half a step would cost 2 w_e sin L (100 m/s) 0.05 s = 4e-4 m/s by the end
    flight = generate_manoeuvres(
        [accelerate(10, 10)], TrajectoryStart(34, 108, 400, heading_deg=40), rate=20
    )
    assert closure(flight, 20)[3:6].abs().max() < 4e-5


def fine_integration(
    a: Tensor, b: Tensor, c: Tensor, e: Tensor, span: float, n: int = 2000
) -> tuple[Tensor, Tensor]:
    """Attitude and velocity in axes that do not turn, by tiny steps at their middles."""
    h = span / n
    t = ((torch.arange(n, dtype=torch.float64) + 0.5) * h)[:, None]
    turns, forces = attitude.dcm_from_rotation_vector((a + b * t) * h), (c + e * t) * h
    halves = attitude.dcm_from_rotation_vector((a + b * t) * h / 2)
    attitude_now, velocity = torch.eye(3, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    for turn, half, force in zip(turns, halves, forces, strict=True):
        velocity = velocity + attitude_now @ half @ force
        attitude_now = attitude_now @ turn
    return attitude_now, velocity


def test_samples_at_uneven_times():
    # 80 Hz increments gathered by ones, twos and threes: a log of 40 Hz whose time stamps wander
    flight = generate_manoeuvres(*SHORT, rate=80)
    sizes = torch.tensor([1, 3, 2, 2, 3, 1, 2, 2]).repeat(len(flight.dtheta) // 16)
    group = torch.repeat_interleave(torch.arange(len(sizes)), sizes)
    empty = torch.zeros(len(sizes), 3, dtype=torch.float64)
    dtheta, dv = empty.index_add(0, group, flight.dtheta), empty.index_add(0, group, flight.dv)
    end, _ = navigate(true_start(flight), dtheta[None], dv[None], sizes / 80, 2)
    error = errors(end, flight)[0].abs()
    even = closure(generate_manoeuvres(*SHORT, rate=40), 40).abs()
    # two samples together last as long as two of 40 Hz, and the error is that of the step
    # what is quadratic in time is not symmetric about the middle of unequal samples: third order of 0.05 s, not fourth
    assert error[3:6].norm() < 4e-5
    assert error[6:].norm() < 1e-3 + 1.5 * even[6:].norm()


@pytest.mark.parametrize("per_step", [1, 2])
def test_samples_of_no_duration_do_nothing(per_step):
    flight = generate_manoeuvres(*SHORT, rate=20)
    dtheta, dv = flight.dtheta[:200], flight.dv[:200]
    filler = torch.zeros(20, 2, 3, dtype=torch.float64)
    padded = [
        torch.cat([x.unflatten(0, (20, 10)), filler], 1).reshape(1, -1, 3) for x in (dtheta, dv)
    ]
    spans = torch.tensor([0.05] * 10 + [0.0] * 2, dtype=torch.float64).repeat(20)
    plain, intervals = navigate(true_start(flight), dtheta[None], dv[None], 0.05, 10, per_step)
    filled, same = navigate(true_start(flight), *padded, spans, 12, per_step)
    # after a filler the velocity is not extrapolated, and the one-sample form has no sample before it: second order
    assert (filled.vel - plain.vel).abs().max() < 1e-3
    assert ((filled.pos - plain.pos) * earth.metre_scale(plain.pos)).abs().max() < 1e-2
    torch.testing.assert_close(same.duration, intervals.duration)
    assert torch.isfinite(same.f).all()


def test_runs_do_not_feel_each_other():
    flight = generate_manoeuvres(*SHORT, rate=20)
    draws = PhiloxStream(3, torch.arange(4))
    imu = add_imu_errors(flight.dtheta, flight.dv, 0.05, ImuErrors(10.0, 0, 0, 1.0, 1000.0), draws)
    together, _ = navigate(true_start(flight), imu.dtheta, imu.dv, 0.05, 20)
    alone, _ = navigate(true_start(flight), imu.dtheta[2:3], imu.dv[2:3], 0.05, 20)
    for a, b in zip(together, alone, strict=True):
        torch.testing.assert_close(a[2], b[0], rtol=1e-11, atol=1e-11)


def test_a_journey_in_two_halves_is_the_journey():
    flight = generate_manoeuvres(*SHORT, rate=20)
    half = len(flight.dv) // 2 // 20 * 20
    middle, first = navigate(
        true_start(flight), flight.dtheta[None, :half], flight.dv[None, :half], 0.05, 20
    )
    end, second = navigate(middle, flight.dtheta[None, half:], flight.dv[None, half:], 0.05, 20)
    whole, intervals = navigate(true_start(flight), flight.dtheta[None], flight.dv[None], 0.05, 20)
    torch.testing.assert_close(end.pos, whole.pos, rtol=1e-13, atol=0)
    torch.testing.assert_close(end.vel, whole.vel, rtol=1e-10, atol=1e-10)
    for a, b, c in zip(first, second, intervals, strict=True):
        torch.testing.assert_close(torch.cat([a, b], 1), c, rtol=1e-9, atol=1e-9)


def test_intervals_say_what_happened():
    flight = generate_manoeuvres(*SHORT, rate=40)
    end, u = navigate(true_start(flight), flight.dtheta[None], flight.dv[None], 1 / 40, 40)
    seconds = len(flight.dv) // 40
    assert u.duration.shape == (1, seconds)
    assert (u.duration - 1).abs().max() < 1e-12
    scale = earth.metre_scale(flight.pos[::40])
    # an interval too early or too late would be 60 m off; the mechanisation is 0.1 m off at this rate
    assert ((u.pos_start[0] - flight.pos[:-1:40]) * scale[:-1]).abs().max() < 1
    assert (u.vel_end[0] - flight.vel[40::40]).abs().max() < 1e-2
    assert attitude.attitude_error(flight.dcm[:-1:40], u.dcm[0]).abs().max() < 1e-6
    assert torch.equal(u.dcm[:, 1:], u.dcm_end[:, :-1])
    assert torch.equal(u.pos[0], (u.pos_start[0] + u.pos_end[0]) / 2)
    assert torch.equal(end.vel, u.vel_end[:, -1])
    # Newton: change of velocity = force + gravity - Coriolis; the last two are smooth enough for their mean of 1 s
    coriolis = torch.linalg.cross(u.w_in + earth.earth_rate(u.pos[..., 0]), u.vel)
    free = (
        torch.tensor([0.0, 0.0, -1.0]).double()
        * earth.gravity(u.pos[..., 0], u.pos[..., 2])[..., None]
        - coriolis
    )
    before = torch.cat([flight.vel[None, :1], u.vel_end[:, :-1]], 1)
    assert (u.vel_end - before - u.f - free).abs().max() < 1e-4
