"""Tightly coupled SINS/GNSS: transitions against the mechanisation, filters against a Kalman filter written out, flights."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from config_cases import composed
from recorded_data import recorded
from refusals import check_refused
from tight_cases import IMU, INITIAL, PATH, RECEIVER, RUNS, flight, kalman, linear
from torch import Tensor

from pfbench import job
from pfbench.core import Episode, PhiloxStream, Record, map_inputs
from pfbench.filter import (
    CubaturePoints,
    FilterResult,
    GaussianFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    run_filter,
)
from pfbench.model.tight_coupling import NAMES, SinsGnssTight, SinsGnssTightNl
from pfbench.nav import attitude, earth, strapdown
from pfbench.nav.aiding import AlignmentErrors, FlightSolution, GnssReceiver, ProcessNoiseInflation
from pfbench.nav.ranging import RangingInputs
from pfbench.nav.trajectory import TrajectoryData
from pfbench.noise.base import NominalNoise
from pfbench.scenario.flights import SimulatedFlight

__all__ = ["flight"]  # a fixture


def exact() -> SinsGnssTightNl:
    return SinsGnssTightNl(IMU, RECEIVER, INITIAL)


def ckf(model: Any, record: Record) -> FilterResult:
    with torch.no_grad():
        return run_filter(
            GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
            model,
            record,
            PhiloxStream(1, RUNS),
        )


# the transition


SIZES = torch.tensor(
    [1e-4] * 3 + [0.1] * 3 + [10.0] * 3 + [1e-6] * 3 + [1e-3] * 3, dtype=torch.float64
)


def mechanised(flown: TrajectoryData, begin: int, x: Tensor) -> Tensor:
    """Nine errors after a second of flight, for errors x [K, 15] at its start and sensors that are wrong by constants."""
    per, dt = 100, 0.01
    part = slice(begin * per, (begin + 1) * per)
    first, last = begin * per, (begin + 1) * per
    ins = strapdown.align(
        flown.dcm[first], flown.vel[first], flown.pos[first], x[:, :3], x[:, 3:6], x[:, 6:9]
    )
    dtheta, dv = flown.dtheta[part] + x[:, None, 9:12] * dt, flown.dv[part] + x[:, None, 12:15] * dt
    end, _ = strapdown.navigate(ins, dtheta, dv, dt, per)
    turned = attitude.attitude_error(flown.dcm[last], end.dcm)
    moved = (end.pos - flown.pos[last]) * earth.metre_scale(flown.pos[last])
    return torch.cat([turned, end.vel - flown.vel[last], moved], -1)


def interval(begin: int) -> tuple[TrajectoryData, RangingInputs]:
    """A second of ideal flight, and the inputs that an INS without errors makes of it."""
    flown = PATH.generate(100.0)
    first, zero = begin * 100, torch.zeros(1, 3, dtype=torch.float64)
    ins = strapdown.align(flown.dcm[first], flown.vel[first], flown.pos[first], zero, zero, zero)
    part = slice(first, first + 100)
    _, u = strapdown.navigate(ins, flown.dtheta[None, part], flown.dv[None, part], 0.01, 100)
    satellites = torch.zeros(1, 1, 1, 3, dtype=torch.float64)
    return flown, RangingInputs(*u, satellites, satellites)


@pytest.mark.parametrize("begin", [0, 15, 30, 40, 70])
def test_the_transition_is_the_derivative_of_the_mechanisation(begin: int) -> None:
    flown, u = interval(begin)
    steps = torch.diag(SIZES)
    wanted = (
        (mechanised(flown, begin, steps) - mechanised(flown, begin, -steps)) / 2
    ).mT  # [9, 15] by sizes
    phi, _ = linear().discretise(u)
    # row-relative: the dropped dR_M/dL makes 2e-5; forces and attitudes change by some per cent within the second, which
    # the mean of both ends meets to second order
    largest = wanted.abs().amax(-1, keepdim=True)
    small = 2e-3 * wanted.abs() * (wanted.abs() < 0.1 * largest)
    assert (
        (phi[0, 0] * SIZES - wanted).abs() <= 5e-5 * largest + small + 1e-9 * SIZES[:9, None]
    ).all()


def test_the_noise_is_of_rank_eleven_and_exact(flight: Episode) -> None:
    model, u = linear(), flight.record.u
    step = model.prepare(flight.record).at_step(20).u
    gain = model.noise_gain(step)
    assert gain.shape == (3, 17, 11)
    q = gain @ gain.mT
    scale = torch.sqrt(q.diagonal(dim1=-2, dim2=-1)).clamp(min=1e-30)
    q = q / scale.unsqueeze(-1) / scale.unsqueeze(-2)
    assert (torch.linalg.matrix_rank(q, rtol=1e-10) == 11).all()
    assert not gain[:, 9:15].any()  # the biases are constant
    # Van Loan's block exponential of the same F, G, q
    f, _, density = model.continuous(map_inputs(lambda a: a[:, 20], u))
    block = torch.cat(
        [torch.cat([-f, density.expand_as(f)], -1), torch.cat([torch.zeros_like(f), f.mT], -1)], -2
    )
    power = torch.matrix_exp(block)  # one second
    after = torch.cat(
        [torch.ones(3, 6, dtype=torch.float64), earth.metre_scale(u.pos_end[:, 20])], -1
    )
    wanted = power[:, 9:, 9:].mT @ power[:, :9, 9:] * after.unsqueeze(-1) * after.unsqueeze(-2)
    size = wanted.diagonal(dim1=-2, dim2=-1).sqrt()
    found = gain[:, :9, :9] @ gain[:, :9, :9].mT
    assert ((found - wanted) / size.unsqueeze(-1) / size.unsqueeze(-2)).abs().max() < 1e-7
    q_b, q_d = 0.3**2, 0.03**2
    clock = torch.tensor([[q_b + q_d / 3, q_d / 2], [q_d / 2, q_d]], dtype=torch.float64)
    assert torch.allclose(gain[:, 15:, 9:] @ gain[:, 15:, 9:].mT, clock)
    walks = torch.tensor([2.908882e-7] * 3 + [50 * 9.80665e-6] * 3, dtype=torch.float64)
    assert torch.allclose(density.diagonal()[:6].sqrt(), walks, rtol=1e-6)


def test_the_clock_goes_on_by_its_drift_and_the_biases_stay(flight: Episode) -> None:
    model = linear()
    step = model.prepare(flight.record).at_step(3).u
    phi = model.transition_matrix(step)
    wanted = torch.eye(17, dtype=torch.float64).expand(3, -1, -1).clone()
    wanted[:, :9, :15], wanted[:, 15, 16] = phi[:, :9, :15], step.duration
    assert torch.equal(phi, wanted)


def test_preparing_in_parts_changes_nothing(flight: Episode) -> None:
    whole = linear().discretise(flight.record.u)
    step = linear().prepare(flight.record).u
    assert step.phi.shape[1] == 80  # more than one part
    assert torch.allclose(step.phi, whole[0], rtol=1e-13, atol=0)
    assert torch.allclose(step.gain, whole[1], rtol=1e-11, atol=1e-18)


def test_the_transition_has_a_density_only_where_it_is_inflated(flight: Episode) -> None:
    x = torch.zeros(3, 2, 17, dtype=torch.float64)
    plain, inflated = linear(), linear(ProcessNoiseInflation())
    assert plain.transition(x, plain.prepare(flight.record).at_step(0).u) is None
    seen = inflated.prepare(flight.record).at_step(7)
    w = PhiloxStream(2, RUNS).normal("w", 2, 17)
    law = inflated.transition(x, seen.u)
    assert law is not None
    log_det = torch.linalg.slogdet(inflated.noise_gain(seen.u))[1].unsqueeze(-1)
    assert torch.allclose(
        law.log_prob(inflated.propagate(x, seen.u, w)),
        inflated.noise.log_prob(w) - log_det,
        atol=1e-6,
    )
    q = [m.noise_gain(m.prepare(flight.record).at_step(7).u) for m in (plain, inflated)]
    extra = (q[1] @ q[1].mT - q[0] @ q[0].mT).diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
    size = ProcessNoiseInflation()
    wanted = torch.cat(
        [size.motion, size.gyro, size.accelerometer, torch.zeros(2, dtype=torch.float64)]
    )
    assert torch.allclose(extra[:, :15], wanted[:15].expand(3, -1), rtol=1e-6)


# what is measured, and what is an error


@pytest.mark.parametrize(
    "rule", [TaylorLinearisation(), SigmaPointLinearisation(CubaturePoints())], ids=["ekf", "ckf"]
)
def test_on_this_model_filters_are_the_kalman_filter(flight: Episode, rule: Any) -> None:
    """Nearly: about an INS that is 10 m off, the measurement is linear to 1e-6 of its matrix."""
    model = linear()
    mean, variance, _ = kalman(model, model.prepare(flight.record))
    estimate = run_filter(GaussianFilter(rule), model, flight.record, PhiloxStream(1, RUNS))
    assert not estimate.lost.any()
    assert ((estimate.mean - mean) / variance.sqrt()).abs().max() < 1e-4
    assert torch.allclose(estimate.variance, variance, rtol=1e-4, atol=0)


def test_a_hidden_satellite_weighs_nothing(flight: Episode) -> None:
    model, y = linear(), flight.record.y.clone()
    y[..., [3, 11]] = torch.nan
    hidden = ckf(model, flight.record._replace(y=y))
    kept = [name for i, name in enumerate(RECEIVER.names) if i != 3]
    fewer = replace(RECEIVER, satellites=kept)
    keep = [i for i in range(16) if i % 8 != 3]
    parts = [i for i in range(8) if i != 3]
    u = flight.record.u
    u = u._replace(satellite=u.satellite[:, :, parts], satellite_vel=u.satellite_vel[:, :, parts])
    without = ckf(linear(receiver=fewer), Record(flight.record.y[..., keep], u))
    assert torch.allclose(hidden.mean, without.mean, rtol=1e-8, atol=1e-10)
    assert torch.allclose(hidden.log_evidence, without.log_evidence, rtol=1e-10)
    everyone = ckf(model, flight.record)
    assert (everyone.variance[:, -1, 6:9] < hidden.variance[:, -1, 6:9]).all()


def test_the_order_of_satellites_does_not_matter(flight: Episode) -> None:
    order = [5, 2, 7, 0, 1, 6, 4, 3]
    u = flight.record.u
    shuffled = Record(
        flight.record.y[..., order + [8 + i for i in order]],
        u._replace(satellite=u.satellite[:, :, order], satellite_vel=u.satellite_vel[:, :, order]),
    )
    a, b = ckf(linear(), flight.record), ckf(linear(), shuffled)
    assert torch.allclose(a.mean, b.mean, rtol=1e-8, atol=1e-10)
    assert torch.allclose(a.log_evidence, b.log_evidence, rtol=1e-10)


@pytest.mark.parametrize("model", [linear(), exact()], ids=["linear", "nonlinear"])
def test_a_perfect_estimate_leaves_no_error(flight: Episode, model: Any) -> None:
    truth = model.assemble(flight.truth)
    assert not torch.isnan(truth).any()
    assert (model.error(truth, truth) / model.p0).abs().max() < 1e-9
    nothing = model.error(model.origin.expand_as(truth), truth)
    groups = torch.cat([flight.truth[name] for name in model.groups], -1)
    # the INS itself is in error by the truth, and nothing was said of sensors and clock
    assert torch.allclose(nothing[..., 3:9], groups[..., 3:9], rtol=1e-9)
    assert torch.equal(nothing[..., 9:], -groups[..., 9:])
    assert torch.allclose(
        nothing[..., :3], groups[..., :3], rtol=0, atol=1e-5
    )  # Euler angles beside a rotation vector


@pytest.mark.parametrize("make", [linear, exact], ids=["linear", "nonlinear"])
def test_single_precision_weighs_particles_as_double_does(flight: Episode, make: Any) -> None:
    values = []
    for dtype in (torch.float64, torch.float32):
        model = make().to(dtype)
        seen = model.prepare(flight.record).to(model.anchor).at_step(60)
        truth = model.assemble(flight.truth)[:, 60]
        d = (PhiloxStream(1, RUNS).normal("d", 50, 17) * make().p0).to(dtype)
        x = model.chart.add(truth.unsqueeze(1).to(dtype), d)
        x = model.propagate(x, seen.u, d[..., :11] * 0)
        values.append(model.log_likelihood(seen.y, x, seen.u).double())
    spread = values[0] - values[0].mean(1, keepdim=True)
    assert (
        values[1] - values[0] - (values[1] - values[0]).mean()
    ).abs().max() < 1e-3 * spread.abs().max()
    assert spread.abs().max() > 1.0


# large heading errors


def test_for_small_errors_the_exact_model_is_the_linear_one(flight: Episode) -> None:
    model, tangent = exact(), linear()
    d = torch.diag(SIZES).expand(3, -1, -1)
    d = torch.cat([d, torch.zeros(3, 15, 2, dtype=torch.float64)], -1)
    nothing = torch.zeros(3, 15, 11, dtype=torch.float64)
    for t in (5, 40):
        u, step = (
            model.prepare(flight.record).at_step(t).u,
            tangent.prepare(flight.record).at_step(t).u,
        )
        flip = torch.tensor([-1.0] * 3 + [1.0] * 14, dtype=torch.float64)  # E turns by -phi
        ends = [
            model.propagate(
                model.chart.add(model.origin.expand(3, 15, -1), s * flip * d), u, nothing
            )
            for s in (1.0, -1.0)
        ]
        found = flip * model.chart.subtract(ends[0], ends[1]) / 2
        wanted = tangent.propagate(d, step, nothing)
        size = wanted.abs().amax(1, keepdim=True).clamp(min=1e-12)
        assert ((found - wanted).abs() / size).max() < 2e-4


def test_the_exact_model_carries_a_heading_error_of_tens_of_degrees() -> None:
    """Take-off with 45 degrees: the INS is wrong by 100 m/s and kilometres, what the model makes of it by next to nothing."""
    guessed = AlignmentErrors(
        (60.0, 60.0, 2700.0), (0.5, 0.5, 0.5), (10.0, 10.0, 10.0), randomise=False
    )
    quiet = replace(IMU, gyro_random_walk_deg_sqrt_h=0.0, accelerometer_random_walk_ug_sqrt_hz=0.0)
    episode = SimulatedFlight(PATH, quiet, RECEIVER, guessed, imu_rate_hz=50.0).draw(
        NominalNoise(), RUNS, 5
    )
    model = SinsGnssTightNl(IMU, RECEIVER, guessed)
    truth, record = model.assemble(episode.truth), model.prepare(episode.record)
    assert episode.truth["velocity"][:, -1].norm(dim=-1).min() > 100.0
    x = truth[:, :1]
    for t in range(1, truth.shape[1]):
        x = model.propagate(x, record.at_step(t).u, torch.zeros(3, 1, 11, dtype=torch.float64))
    error = model.error(x[:, 0], truth[:, -1]).abs()
    assert error[:, :3].max() < 0.1 * math.radians(1 / 3600)
    assert error[:, 3:6].max() < 1e-3
    assert error[:, 6:9].max() < 1.0  # what the force does within a second; pseudoranges have 10 m


def test_the_exact_models_noise_is_the_linear_ones(flight: Episode) -> None:
    q = []
    for model in (linear(), exact()):
        gain = model.noise_gain(model.prepare(flight.record).at_step(30).u)
        q.append((gain @ gain.mT).expand(3, -1, -1))
    size = q[0].diagonal(dim1=-2, dim2=-1).sqrt().clamp(min=1e-30)
    # left out: gyro noise within the interval, 1e-2 of the accelerometers'
    assert ((q[0] - q[1]) / size.unsqueeze(-1) / size.unsqueeze(-2))[:, 3:, 3:].abs().max() < 1e-3
    assert torch.allclose(q[0][:, :3, :3], q[1][:, :3, :3], rtol=1e-6, atol=1e-20)


# the door


def test_what_does_not_fit_is_refused(flight: Episode) -> None:
    loose = SimulatedFlight(PATH, IMU, GnssReceiver((10.0, 10.0, 10.0)), INITIAL, imu_rate_hz=20.0)
    for model in (linear(), exact()):
        with pytest.raises(
            ValueError, match=r"record\.u must be RangingInputs .*, got InsIntervals"
        ):
            model.prepare(loose.draw(NominalNoise(), RUNS[:1], 1).record)
        with pytest.raises(
            ValueError, match=r"measure the 16 components of model\.receiver, got 6"
        ):
            model.prepare(flight.record._replace(y=flight.record.y[..., :6]))
    check_refused(
        [
            (
                r"model\.imu must not have Markov parts, got 0\.1 deg/h.*Set gyro_markov_deg_h",
                lambda: SinsGnssTight(
                    replace(IMU, gyro_markov_deg_h=0.1, gyro_markov_time_s=300.0), RECEIVER, INITIAL
                ),
            ),
            (
                r"model\.imu must have positive gyro and accelerometer biases, got 0\.0 deg/h",
                lambda: SinsGnssTight(replace(IMU, gyro_bias_deg_h=0.0), RECEIVER, INITIAL),
            ),
        ],
        remedy=False,
    )
    assert len(NAMES) == 17


# the scenarios


def test_the_flight_ends_where_the_paper_says() -> None:
    path = job.instantiate(composed("scenario=anshun_fit").scenario.trajectory)
    flown = path.generate(10.0)
    start, end = flown.pos[0], flown.pos[-1]
    given = torch.tensor([math.radians(23.68), math.radians(108.63), 200.0], dtype=torch.float64)
    assert ((end - given) * earth.metre_scale(given)).abs().max() < 5.0
    assert torch.rad2deg(start[:2]).tolist() == pytest.approx([26.26, 105.89])
    assert float(flown.time[-1]) == 1400.0
    bank = torch.atan2(-flown.dcm[:, 2, 0], flown.dcm[:, 2, 2]).abs().max()
    assert 50.0 < math.degrees(float(bank)) < 55.0


def visible(scenario: str, *words: str) -> Tensor:
    """Satellites seen [T, S] once a second along the path, without an INS."""
    cfg = composed(f"scenario={scenario}", *words).scenario
    flown, receiver = job.instantiate(cfg.trajectory).generate(1.0), job.instantiate(cfg.receiver)
    time, pos, vel, dcm, *_ = (a[1:] for a in flown)
    fields = (dcm, dcm, pos, pos, pos, vel, vel, vel, vel, torch.ones_like(time))
    ins = strapdown.InsIntervals(*(a.unsqueeze(0) for a in fields))
    y = receiver.measure(
        FlightSolution(time, pos, vel, dcm, ins), PhiloxStream(1, RUNS[:1]), torch.ones_like(time)
    ).y[0]
    half = y.shape[1] // 2
    assert torch.equal(y[:, :half].isnan(), y[:, half:].isnan())
    return ~y[:, :half].isnan()


def test_satellites_of_the_scenarios() -> None:
    assert visible("anshun_fit").all()
    slow = visible("anshun_uav")
    assert set(slow.sum(1).tolist()) == {7, 8}
    assert int((slow[1:] != slow[:-1]).sum()) == 1


@recorded
def test_real_satellites_come_and_go() -> None:
    seen = visible("anshun_real_orbits")
    assert set(seen.sum(1).tolist()) == {9, 10, 11}
    assert int((seen[1:] != seen[:-1]).sum()) == 3
    everyone = visible(
        "anshun_real_orbits",
        "scenario.receiver.satellites=null",
        "scenario.trajectory.duration_s=1000",
    )
    assert torch.equal(everyone.sum(1), seen[:1000].sum(1))  # the list leaves nobody out


@pytest.mark.slow
def test_the_take_off_shows_the_heading() -> None:
    """From 45 degrees the cubature filter comes below 1 degree within 20 s (half the runs) and 60 s (nearly all)."""
    cfg = composed(
        "scenario=anshun_nl", "scenario.imu_rate_hz=20", "scenario.trajectory.duration_s=70"
    )
    model, runs = job.instantiate(cfg.model), torch.arange(40)
    episode = job.instantiate(cfg.scenario).draw(NominalNoise(), runs, 3)
    truth = model.assemble(episode.truth)
    with torch.no_grad():
        estimate = run_filter(
            GaussianFilter(SigmaPointLinearisation(CubaturePoints(), largest_angle=None)),
            model,
            episode.record,
            PhiloxStream(1, runs),
        )
    heading = torch.rad2deg(model.error(estimate.mean, truth)[..., 2].abs())
    assert not estimate.lost.any()
    assert episode.truth["attitude"][:, 0, 2].abs().median() > math.radians(20.0)
    assert heading[:, 20].median() < 1.0
    assert (heading[:, 60] < 1.0).double().mean() > 0.9
