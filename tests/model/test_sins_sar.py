"""SINS/SAR: the error model against the mechanisation and the linear equations, the instruments, the filter's consistency."""

import math
from dataclasses import replace
from typing import Any

import pytest
import torch
from config_cases import composed
from model_cases import filter_with_scores
from refusals import check_refused
from scipy import stats
from torch import Tensor

from pfbench import job
from pfbench.core import Episode, PhiloxStream, map_inputs, wrap_angle
from pfbench.core.density import ChartNormal
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    run_filter,
)
from pfbench.model.sins_sar import SarStep, SinsSar
from pfbench.nav import (
    CosineRamp,
    ImuErrors,
    RampTrajectory,
    TrajectoryStart,
    attitude,
    earth,
    error_dynamics,
)
from pfbench.nav.aiding import (
    ARCMIN,
    AlignmentErrors,
    ProcessNoiseInflation,
    SarSensor,
    compute_heading_difference,
)
from pfbench.nav.earth import convert_from_metres, convert_to_metres, earth_quantities
from pfbench.nav.strapdown import InsIntervals
from pfbench.noise import MeasurementOutage, NominalNoise
from pfbench.scenario.flights import SimulatedFlight

IMU = ImuErrors(
    gyro_bias_deg_h=0.1,
    gyro_random_walk_deg_sqrt_h=0.01,
    accelerometer_bias_ug=100.0,
    accelerometer_random_walk_ug_sqrt_hz=10.0,
)
SILENT = replace(IMU, gyro_random_walk_deg_sqrt_h=0.0, accelerometer_random_walk_ug_sqrt_hz=0.0)
INITIAL = AlignmentErrors((1.2, 1.2, 1.5), (0.8, 0.8, 0.8), (10.0, 10.0, 15.0))
# a minute with everything at once, heading through South, where the heading wraps
PATH = RampTrajectory(
    TrajectoryStart(lat_deg=34.2, lon_deg=108.9, height=2000.0, speed=100.0, heading_deg=150.0), 60.0, (CosineRamp(5.0, 25.0, 60.0),),
    (CosineRamp(10.0, 20.0, 8.0), CosineRamp(40.0, 50.0, -12.0)), (CosineRamp(20.0, 50.0, 50.0),),
)  # fmt: skip
FLIGHT = SimulatedFlight(PATH, IMU, SarSensor(), INITIAL, imu_rate_hz=20.0)
RUNS = torch.arange(3)
VARIANTS = {
    "G at the identity": SinsSar(IMU, SarSensor(), INITIAL),
    "G at q": SinsSar(IMU, SarSensor(), INITIAL, rotate_noise_by_error=True),
    "inflated": SinsSar(IMU, SarSensor(), INITIAL, inflation=ProcessNoiseInflation()),
}
MODEL = VARIANTS["G at the identity"]
every_variant = pytest.mark.parametrize("model", VARIANTS.values(), ids=list(VARIANTS))


@pytest.fixture(scope="module")
def flight() -> Episode:
    return FLIGHT.draw(NominalNoise(), RUNS, 5)


def states(particles: int, scale: float = 1.0, runs: Tensor = RUNS) -> Tensor:
    """States of the initial law with attitudes, velocities and positions `scale` times as wrong [R, N, 16]."""
    xi = PhiloxStream(7, runs).normal("x", particles, 15) * MODEL.p0
    return MODEL.chart.add(MODEL.origin, torch.cat([xi[..., :9] * scale, xi[..., 9:]], -1))


def dcm(x: Tensor) -> Tensor:
    return attitude.dcm_from_quaternion(x[..., :4])


# the dynamics


def followed(scene: SimulatedFlight, runs: Tensor) -> tuple[Tensor, Tensor]:
    """Largest error over the flight of the model started at the truth [15], and how large the true errors become [15]."""
    episode = scene.draw(NominalNoise(), runs, 3)
    truth, record = MODEL.assemble(episode.truth), MODEL.prepare(episode.record)
    x, missed = truth[:, :1], []
    for t in range(1, truth.shape[1]):
        x = MODEL.propagate(x, record.at_step(t).u, x.new_zeros(len(runs), 1, 6))
        missed.append(MODEL.error(x[:, 0], truth[:, t]))
    grown = MODEL.chart.subtract(truth, MODEL.origin)
    return torch.stack(missed, 1).abs().amax((0, 1)), grown.abs().amax((0, 1))


MISALIGNED = AlignmentErrors((120.0, 120.0, 150.0), INITIAL.velocity, INITIAL.position)


@pytest.mark.parametrize(
    ("initial", "metres"), [(INITIAL, 5e-3), (MISALIGNED, 0.1)], ids=["arc minutes", "degrees"]
)
def test_the_model_follows_the_mechanisation_through_every_manoeuvre(
    initial: AlignmentErrors, metres: float
) -> None:
    """Errors of constant biases and a wrong start, without white noise, to what two samples of 0.02 s leave of this path."""
    missed, grown = followed(
        SimulatedFlight(PATH, SILENT, SarSensor(), initial, imu_rate_hz=50.0), RUNS
    )
    assert missed[:3].max() < 1e-3 * ARCMIN
    assert missed[3:6].max() < 0.1 * metres
    assert missed[6:9].max() < metres
    assert (grown[6:8] > 30.0).all()  # there was something to follow


@pytest.mark.slow
def test_the_model_follows_the_mechanisation_for_five_hundred_seconds() -> None:
    """To 0.06 m of fifty kilometres, with misalignments of degrees, at steps of 0.04 s."""
    words = ("scenario=sar_flight", "scenario.trajectory.duration_s=500")
    path = job.instantiate(composed(*words).scenario).trajectory
    missed, grown = followed(
        SimulatedFlight(path, SILENT, SarSensor(), MISALIGNED, imu_rate_hz=50.0), torch.arange(4)
    )
    assert missed[:3].max() < 1e-4 * ARCMIN
    assert missed[3:6].max() < 1e-4
    assert missed[6:9].max() < 0.06
    assert grown[6:8].max() > 4e4


def test_an_ins_without_errors_stays_on_the_path() -> None:
    still = AlignmentErrors((1e-9,) * 3, (1e-9,) * 3, (1e-9,) * 3)
    scene = SimulatedFlight(PATH, ImuErrors(), SarSensor(), still, imu_rate_hz=50.0)
    truth = MODEL.chart.subtract(
        MODEL.assemble(scene.draw(NominalNoise(), RUNS, 1).truth), MODEL.origin
    )
    assert truth[..., :3].abs().max() < 1e-3 * ARCMIN
    assert truth[..., 3:6].abs().max() < 5e-4
    assert truth[..., 6:9].abs().max() < 5e-3


@pytest.mark.parametrize("size", [1.0, 200.0])
def test_a_step_agrees_with_the_equations_in_euler_angles(flight: Episode, size: float) -> None:
    """The same physics, written with other attitude errors, other metres and another integrator, at errors of any size."""
    u = flight.record.u
    t, x = 30, states(5, size)
    interval = InsIntervals(*(a[:, t].unsqueeze(1) for a in u))
    alpha = attitude.euler_from_dcm(dcm(x))
    before = convert_to_metres(
        convert_from_metres(x[..., 7:10].mT, interval.pos_start.mT), interval.pos_start.mT
    ).mT
    assert torch.allclose(before, x[..., 7:10], rtol=1e-9, atol=1e-9)  # one kind of metres and back
    raw = convert_from_metres(x[..., 7:10].mT, interval.pos_start.mT).mT * earth.metre_scale(
        interval.pos_start
    )  # the INS's metres
    made = error_dynamics.propagate_error(
        torch.cat([alpha, x[..., 4:7], raw], -1), interval, x[..., 10:13], x[..., 13:16], passes=4
    )
    ours = MODEL.propagate(x, MODEL.prepare(flight.record).at_step(t).u, x.new_zeros(3, 5, 6))
    turned = attitude.dcm_from_euler(made[..., :3]) @ dcm(ours).mT
    back = convert_from_metres(ours[..., 7:10].mT, interval.pos_end.mT).mT * earth.metre_scale(
        interval.pos_end
    )
    # the midpoint rule leaves w f T^3 / 6 with w = 1e-4, and twice that of the velocity error's own turn
    assert attitude.euler_from_dcm(turned).abs().max() < 1e-10 * size
    assert (ours[..., 4:7] - made[..., 3:6]).abs().max() < 2e-8 * size
    assert (back - made[..., 6:9]).abs().max() < 1e-5 * size
    assert torch.equal(ours[..., 10:], x[..., 10:])


def test_the_first_order_limit_is_the_small_angle_error_equation(flight: Episode) -> None:
    """F by central differences of a step of a millisecond; position in metres, attitude errors as phi."""
    u = map_inputs(lambda a: a[:, 30:31], flight.record.u)
    short = 1e-3
    u = u._replace(
        dcm_end=u.dcm, pos_start=u.pos, pos_end=u.pos, duration=torch.full_like(u.duration, short)
    )
    seen = map_inputs(lambda a: a[:, 0], MODEL.discretise(u))
    h = 1e-2 * MODEL.p0
    directions = torch.diag(h).expand(3, -1, -1)

    def step(d: Tensor) -> Tensor:
        x = MODEL.chart.add(MODEL.origin, d)
        moved = MODEL.propagate(x, seen, x.new_zeros(*x.shape[:2], 6))
        return MODEL.chart.subtract(
            moved, x
        )  # over 15 columns: what each direction has become, less itself

    f = ((step(directions) - step(-directions)) / (2 * h[:, None] * short)).mT
    wanted, scale = torch.zeros_like(f), torch.ones(3, 9, dtype=torch.float64)
    scale[:, 6:] = earth.metre_scale(u.pos[:, 0])
    linear = error_dynamics.small_angle_matrix(u.pos[:, 0], u.vel[:, 0], u.f[:, 0])
    wanted[:, :9, :9] = linear * scale.unsqueeze(-1) / scale.unsqueeze(-2)
    wanted[:, 0:3, 9:12], wanted[:, 3:6, 12:15] = -u.dcm[:, 0], u.dcm[:, 0]
    apart = (f - wanted).abs()
    # the blocks know gravity by its spring alone: 0.4 % of it, and the slope with latitude, 0.05 m/s^2 per rad, are missing
    assert (apart[:, 5, 8] < 0.005 * wanted[:, 5, 8]).all()
    assert (apart[:, 5, 6] < 0.052 / 6.3e6 + 1e-12).all()
    apart[:, 5, 8] = apart[:, 5, 6] = 0.0
    # and so is the growth of the radii with latitude, a hundredth of them per rad, beside the rates that they divide
    slow = 0.01 * u.vel[:, 0].norm(dim=-1, keepdim=True) / 6.3e6
    apart[:, 0:3, 6] -= slow / 6.3e6
    apart[:, 3:6, 6] -= slow**2
    apart[:, 6:8, 6] -= slow
    second = 0.5 * short * (wanted @ wanted).abs()  # of the exponential
    rounding = 1e-15 * MODEL.p0[:, None] / (h * short)
    assert (apart <= 1e-6 * wanted.abs() + 1.5 * second + rounding).all()


def test_surroundings_are_those_of_the_earth_model() -> None:
    pos = torch.tensor([[0.6, 1.9, 3000.0], [-1.1, 0.3, 100.0]], dtype=torch.float64)
    vel = torch.tensor([[120.0, -80.0, 9.0], [-30.0, 200.0, -4.0]], dtype=torch.float64)
    w_in, free, drift = (a[..., 0] for a in earth_quantities(pos.unsqueeze(-1), vel.unsqueeze(-1)))
    w_ie, w_en = earth.earth_rate(pos[:, 0]), earth.transport_rate(pos[:, 0], pos[:, 2], vel)
    down = torch.stack([torch.zeros(2), torch.zeros(2), -earth.gravity(pos[:, 0], pos[:, 2])], -1)
    assert torch.allclose(w_in, w_ie + w_en, rtol=1e-13, atol=0)
    assert torch.allclose(
        free, down - torch.linalg.cross(2 * w_ie + w_en, vel), rtol=1e-13, atol=1e-15
    )
    assert torch.allclose(drift, earth.position_rate(pos, vel), rtol=1e-13, atol=0)


@pytest.mark.parametrize(("far", "allowed"), [(2e3, 1e-9), (2e5, 2e-3)])
def test_metres_of_the_true_place_and_back(far: float, allowed: float) -> None:
    pos = torch.tensor([0.6, 1.9, 3000.0], dtype=torch.float64)[:, None]
    metres = (
        torch.tensor([[1.0, -1.0, 0.5], [1.0, 1.0, -0.5], [0.01, 0.01, 0.01]], dtype=torch.float64)
        * far
    )
    dp = convert_from_metres(metres, pos)
    assert (convert_to_metres(dp, pos) - metres).abs().max() < allowed
    wanted = dp.mT * earth.metre_scale((pos - dp).mT)
    assert torch.allclose(convert_to_metres(dp, pos).mT, wanted, rtol=1e-14, atol=0)


# the noise


@pytest.mark.parametrize("name", ["G at the identity", "inflated"])
def test_the_gain_is_what_propagate_does_with_noise(flight: Episode, name: str) -> None:
    model = VARIANTS[name]
    u = model.prepare(flight.record).at_step(20).u
    x = states(4)
    w = PhiloxStream(1, RUNS).normal("w", 4, model.noise_dim)
    gain = model.noise_gain(u)
    assert gain is not None
    moved, quiet = model.propagate(x, u, w), model.propagate(x, u, torch.zeros_like(w))
    apart = model.chart.subtract(moved, model.chart.add(quiet, w @ gain.mT))
    assert (apart / model.p0).abs().max() < 1e-9
    assert (model.chart.subtract(moved, quiet) / model.p0).abs().max() > 1e-5


def test_noise_is_that_of_the_sensors_turned_from_body_axes(flight: Episode) -> None:
    """A second of random walk: 0.01 deg/sqrt(h) and 10 ug/sqrt(Hz), gyros with -C into attitude, accelerometers with +C."""
    u = MODEL.prepare(flight.record).at_step(20).u
    gyro, accelerometer = math.radians(0.01) / 60.0, 1e-5 * 9.80665
    assert torch.allclose(u.gain[:, 0:3, 0:3], -u.dcm * gyro, rtol=1e-9)
    assert torch.allclose(u.gain[:, 3:6, 3:6], u.dcm * accelerometer, rtol=1e-9)
    assert (u.gain[:, 0:3, 3:6] == 0).all()
    assert (u.gain[:, 3:6, 0:3] == 0).all()
    assert (u.gain[:, 6:] == 0).all()
    assert torch.linalg.matrix_rank(u.gain).tolist() == [6, 6, 6]
    long = MODEL.discretise(
        flight.record.u._replace(duration=torch.full((1, 1), 4.0, dtype=torch.float64))
    )
    assert torch.allclose(
        long.gain[:, 20], 2.0 * u.gain, rtol=1e-12, atol=0
    )  # a random walk: as the root of time


def test_noise_at_q_has_the_same_law_turned_by_each_states_own_attitude(flight: Episode) -> None:
    model = VARIANTS["G at q"]
    u = model.prepare(flight.record).at_step(20).u
    x = states(4, 300.0)  # 6 degrees
    assert model.noise_gain(u) is None
    quiet = model.propagate(x, u, x.new_zeros(3, 4, 6))
    columns = []
    for k in range(6):
        w = torch.eye(6, dtype=torch.float64)[k].expand(3, 4, -1)
        columns.append(model.chart.subtract(model.propagate(x, u, w), quiet))
    gain = torch.stack(columns, -1)  # [R, N, 15, 6]
    at_q = dcm(quiet) @ u.gain[:, None, 3:6, 3:6]
    assert torch.allclose(gain[..., 3:6, 3:6], at_q, rtol=1e-9, atol=1e-13)
    assert torch.allclose(
        gain[..., 0:3, 0:3], u.gain[:, None, 0:3, 0:3].expand_as(at_q), rtol=1e-9, atol=1e-13
    )
    assert (gain[..., 3:6, 3:6] - u.gain[:, None, 3:6, 3:6]).norm(
        dim=(-2, -1)
    ).min() > 1e-2 * 1e-4  # it is another map
    same, at_identity = (a @ a.mT for a in (gain, u.gain[:, None]))
    size = torch.tensor(
        [math.radians(0.01) / 60.0] * 3 + [1e-4] * 3 + [1.0] * 9, dtype=torch.float64
    )
    # a mean of two attitudes that differ by the turn of a second, 0.04 rad, is orthonormal to a quarter of its square
    assert ((same - at_identity) / size / size[:, None]).abs().max() < 0.5 * 0.04**2


def test_inflation_adds_its_variances_to_the_sensors_and_nothing_else(flight: Episode) -> None:
    plain, full = (
        VARIANTS[name].prepare(flight.record).at_step(20).u.gain
        for name in ("G at the identity", "inflated")
    )
    size = ProcessNoiseInflation()
    sd = torch.cat([size.motion, size.gyro, size.accelerometer])
    extra = (full @ full.mT - plain @ plain.mT) / sd / sd[:, None]
    assert torch.allclose(extra, torch.eye(15, dtype=torch.float64).expand_as(extra), atol=1e-9)
    assert VARIANTS["inflated"].noise_dim == 15
    assert any("inflated" in choice for choice in VARIANTS["inflated"].choices)


@every_variant
def test_a_singular_transition_is_not_faked(flight: Episode, model: SinsSar) -> None:
    """With noise in all states it has a density, of differences in the chart: `test_moves` compares it with the noise."""
    distribution = model.transition(states(2), model.prepare(flight.record).at_step(0).u)
    assert (distribution is None) == (model.inflation is None)
    assert distribution is None or isinstance(distribution, ChartNormal)


# what is seen


def heading(c: Tensor) -> Tensor:
    return -attitude.euler_from_dcm(c)[..., 2]


@pytest.mark.parametrize("size", [1.0, 300.0])
def test_the_measurement_is_the_difference_of_headings_and_of_positions(
    flight: Episode, size: float
) -> None:
    u, x = flight.record.u, states(6, size)
    law: Any = MODEL.observation(x, MODEL.prepare(flight.record).at_step(40).u)
    corrected = dcm(x) @ u.dcm_end[:, 40].unsqueeze(1)
    turn = wrap_angle(heading(u.dcm_end[:, 40]).unsqueeze(1) - heading(corrected))
    assert torch.allclose(law.mean[..., 0], turn, rtol=1e-9, atol=1e-13)
    assert torch.equal(law.mean[..., 1:], x[..., 7:10])
    wanted = torch.tensor([math.radians(0.05), 20.0, 20.0, 10.0], dtype=torch.float64)
    assert torch.allclose(law.stddev, wanted.expand_as(law.stddev), rtol=1e-12)


def test_an_ins_that_points_too_far_right_has_a_positive_heading_error() -> None:
    right, north = (
        torch.tensor(v, dtype=torch.float64) for v in ([0.1, 1.0, 0.3], [0.0, 5.0, 0.0])
    )
    assert compute_heading_difference(right, north).item() == pytest.approx(
        math.atan(0.1), rel=1e-14
    )
    almost, beyond = (
        torch.tensor([math.sin(a), math.cos(a), 0.0], dtype=torch.float64) for a in (3.1, -3.1)
    )
    assert compute_heading_difference(almost, beyond).item() == pytest.approx(
        6.2 - 2 * math.pi, rel=1e-12
    )  # the short way round


def test_the_residual_of_the_heading_goes_the_short_way_round() -> None:
    y, y_hat = torch.tensor([[3.1, 0.0, 0.0, 0.0], [-3.1, 5.0, 6.0, 700.0]], dtype=torch.float64)
    assert MODEL.residual(y, y_hat).tolist() == pytest.approx(
        [6.2 - 2 * math.pi, -5.0, -6.0, -700.0], abs=1e-12
    )


def test_kinds_and_sources_of_what_is_seen() -> None:
    channels = SarSensor(0.1, (5.0, 6.0), 7.0).channels
    assert channels.kind == ("angle", "position", "position", "position")
    assert channels.source == (0, 0, 0, 1)
    assert channels.sd.tolist() == pytest.approx([math.radians(0.1), 5.0, 6.0, 7.0], rel=1e-14)


def test_without_noise_the_instruments_see_what_the_model_says_at_the_truth(
    flight: Episode,
) -> None:
    """By another way: heading and position of INS and path, each on its own."""
    u, truth = flight.record.u, MODEL.assemble(flight.truth)
    law: Any = MODEL.observation(
        truth.flatten(0, 1).unsqueeze(1), map_inputs(lambda a: a.flatten(0, 1), _expanded(flight))
    )
    flown = PATH.generate(20.0)
    pos, c = flown.pos[20::20], flown.dcm[20::20]
    turn = wrap_angle(heading(u.dcm_end) - heading(c))
    apart = (u.pos_end - pos) * earth.metre_scale(pos)
    said = law.mean.reshape(3, 60, 4)
    assert torch.allclose(said[..., 0], turn, rtol=1e-7, atol=1e-12)
    assert torch.allclose(said[..., 1:], apart, rtol=0, atol=1e-6)
    noise = NominalNoise().draw_errors(PhiloxStream(5, RUNS), SarSensor().channels, flight.time)
    assert torch.allclose(flight.record.y, said + noise, rtol=0, atol=1e-6)


def _expanded(episode: Episode) -> SarStep:
    u = MODEL.prepare(episode.record).u
    return SarStep(*(a.expand(len(RUNS), *a.shape[1:]) for a in u))


def test_residuals_at_the_truth_are_white_and_of_the_stated_size() -> None:
    runs = torch.arange(100)
    episode = FLIGHT.draw(NominalNoise(), runs, 9)
    truth, u = MODEL.assemble(episode.truth), MODEL.prepare(episode.record).u
    u = SarStep(*(a.expand(len(runs), *a.shape[1:]).flatten(0, 1) for a in u))
    law: Any = MODEL.observation(truth.flatten(0, 1).unsqueeze(1), u)
    z = MODEL.residual(episode.record.y, law.mean.reshape_as(episode.record.y)) / MODEL.r
    n = z[..., 0].numel()
    assert (z.mean((0, 1)).abs() < 4.5 / math.sqrt(n)).all()
    assert ((z.square().mean((0, 1)) - 1).abs() < 4.5 * math.sqrt(2 / n)).all()
    assert (
        (z[:, 1:] * z[:, :-1]).mean((0, 1)).abs() < 4.5 / math.sqrt(n)
    ).all()  # from one second to the next
    assert (
        (z[1:] * z[:-1]).mean((0, 1)).abs() < 4.5 / math.sqrt(n)
    ).all()  # from one run to the next
    between = torch.corrcoef(z.flatten(0, 1).T) - torch.eye(4, dtype=torch.float64)
    assert between.abs().max() < 4.5 / math.sqrt(n)


def test_an_outage_silences_the_instruments_in_its_window(flight: Episode) -> None:
    y = FLIGHT.draw(MeasurementOutage(((10.0, 20.0),)), RUNS, 5).record.y
    silent = (flight.time >= 10.0) & (flight.time < 20.0)
    assert torch.equal(torch.isnan(y), silent[:, None].expand_as(y))


# truth and error


def test_the_true_quaternion_turns_what_the_ins_believes_into_the_truth(flight: Episode) -> None:
    x, u = MODEL.assemble(flight.truth), flight.record.u
    true = PATH.generate(20.0).dcm[20::20]
    assert torch.allclose(dcm(x) @ u.dcm_end, true.expand(3, -1, -1, -1), rtol=0, atol=1e-12)
    assert torch.equal(x[..., 4:7], flight.truth["velocity"])
    assert torch.equal(x[..., 7:10], flight.truth["position"])
    assert torch.equal(x[..., 10:13], flight.truth["gyro_bias"])
    assert torch.equal(x[..., 13:], flight.truth["accelerometer_bias"])


def test_a_group_without_truth_is_unknown_and_a_truth_without_groups_refused(
    flight: Episode,
) -> None:
    x = MODEL.assemble({"velocity": flight.truth["velocity"]})
    assert torch.equal(
        x.isnan(), torch.tensor([1] * 4 + [0] * 3 + [1] * 9, dtype=torch.bool).expand_as(x)
    )
    check_refused(
        [("at least one group", lambda: MODEL.assemble({"clock": flight.truth["velocity"]}))],
        remedy=False,
    )


def test_error_is_corrected_minus_true_for_navigation_and_estimate_minus_true_for_sensors(
    flight: Episode,
) -> None:
    u, truth = flight.record.u, MODEL.assemble(flight.truth)
    guess = states(60)
    error = MODEL.error(guess, truth)
    assert MODEL.error(truth, truth).abs().max() < 1e-12
    corrected, true = dcm(guess) @ u.dcm_end, dcm(truth) @ u.dcm_end
    rest = attitude.attitude_error(true, corrected) - error[..., :3]
    assert (
        rest.norm(dim=-1) < 4 * truth.shape[-1] * 1e-3 * error[..., :3].norm(dim=-1)
    ).all()  # equal to first order
    assert torch.allclose(
        dcm(guess) @ attitude.dcm_from_rotation_vector(error[..., :3]), dcm(truth), atol=1e-12
    )
    assert torch.allclose(
        (u.vel_end - guess[..., 4:7]) - (u.vel_end - truth[..., 4:7]), error[..., 3:6], atol=1e-10
    )
    pos = u.pos_end.mT
    right = (pos - convert_from_metres(truth[..., 7:10].mT, pos)).mT
    ours = (pos - convert_from_metres(guess[..., 7:10].mT, pos)).mT
    # a metre of longitude differs from one place to another 100 m away by 1e-5
    assert torch.allclose(
        (ours - right) * earth.metre_scale(right), error[..., 6:9], rtol=1e-6, atol=2e-3
    )
    assert torch.allclose(error[..., 9:], guess[..., 10:] - truth[..., 10:])


def test_errors_are_laid_out_as_those_of_the_gnss_model() -> None:
    assert list(MODEL.groups) == [
        "attitude",
        "velocity",
        "position",
        "gyro_bias",
        "accelerometer_bias",
    ]
    order = {"attitude": "ENU", "velocity": "ENU", "position": "NEU"}
    assert MODEL.names[:9] == tuple(f"{g}_{a}" for g, axes in order.items() for a in axes)
    assert MODEL.units == ("rad",) * 3 + ("m/s",) * 3 + ("m",) * 3 + ("rad/s",) * 3 + ("m/s^2",) * 3
    assert MODEL.chart.size == 16
    assert MODEL.chart.dimension == 15
    law: Any = MODEL.initial(4)
    wanted = [1.2 * ARCMIN] * 2 + [1.5 * ARCMIN] + [0.8] * 3 + [10.0, 10.0, 15.0]
    wanted += [math.radians(0.1 / 3600)] * 3 + [9.80665e-4] * 3
    assert law.stddev[2].tolist() == pytest.approx(wanted, rel=1e-12)


# filters


def beginning(episode: Episode, steps: int) -> Episode:
    record = episode.record
    short = record._replace(y=record.y[:, :steps], u=map_inputs(lambda a: a[:, :steps], record.u))
    return replace(
        episode,
        record=short,
        time=episode.time[:steps],
        truth={k: v[:, :steps] for k, v in episode.truth.items()},
    )


def test_at_arc_minutes_all_gaussian_filters_are_nearly_one_wherever_the_noise_is_turned(
    flight: Episode,
) -> None:
    first = beginning(flight, 15)
    cells = [
        (TaylorLinearisation(), "G at q"),
        (TaylorLinearisation(), "G at the identity"),
        (SigmaPointLinearisation(CubaturePoints()), "G at q"),
    ]
    made = [filter_with_scores(GaussianFilter(rule), VARIANTS[name], first) for rule, name in cells]
    sd = made[0].variance.sqrt()
    assert not made[0].lost.any()
    for other, allowed in zip(
        made[1:], (1e-6, 0.02), strict=True
    ):  # cubature reaches out to 1e-3 rad
        assert (MODEL.chart.subtract(made[0].mean, other.mean) / sd).abs().max() < allowed
        assert torch.allclose(made[0].variance, other.variance, rtol=allowed)


@every_variant
def test_a_cloud_runs_and_stays_a_cloud_of_rotations(flight: Episode, model: SinsSar) -> None:
    estimate = run_filter(
        ParticleFilter(50), model, beginning(flight, 10).record, PhiloxStream(1, RUNS)
    )
    assert not estimate.lost.any()
    assert (estimate.mean[..., :4].norm(dim=-1) - 1).abs().max() < 1e-12


@pytest.mark.slow
def test_the_extended_kalman_filter_is_consistent_on_the_flight() -> None:
    """NEES of every group in its band through 400 s, and errors of the last half of the size of the filter's own sd.

    The errors of a run last for minutes: the RMS of 24 runs has a standard error of 14 %, and four of them are allowed.
    """
    runs, level = torch.arange(24), 1e-4
    cfg = composed(
        "scenario=sar_flight", "scenario.imu_rate_hz=20", "scenario.trajectory.duration_s=400"
    )
    model, episode = (
        job.instantiate(cfg.model),
        job.instantiate(cfg.scenario).draw(NominalNoise(), runs, 21),
    )
    estimate = filter_with_scores(GaussianFilter(TaylorLinearisation()), model, episode)
    assert not estimate.lost.any()
    low, high = stats.chi2.ppf([level, 1 - level], 3 * len(runs))
    nees = estimate.trace["nees"][:, 99::100].sum(0)  # [4, groups]
    assert (nees > low).all(), nees / (3 * len(runs))
    assert (nees < high).all(), nees / (3 * len(runs))
    rms = estimate.trace["error"][:, 200:].square().mean((0, 1)).sqrt()
    sd = [0.43 * ARCMIN, 0.43 * ARCMIN, 0.27 * ARCMIN, 0.072, 0.072, 0.029, 3.7, 3.7, 1.75]
    assert (rms[:9] < 1.56 * torch.tensor(sd, dtype=torch.float64)).all()


# what is refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((0.0, (20.0, 20.0), 10.0), r"receiver\.heading_sd_deg must be positive, got \[0\.0\]"),
        (
            (0.05, (20.0, -1.0), 10.0),
            r"receiver\.position_sd must be positive, got \[20\.0, -1\.0\]",
        ),
        (
            (0.05, (20.0, 20.0, 20.0), 10.0),
            r"receiver\.position_sd must be two standard deviations.*Give North and East",
        ),
        ((0.05, (20.0, 20.0), 0.0), r"receiver\.height_sd must be positive, got \[0\.0\]"),
    ],
)
def test_instruments_without_noise_are_refused(arguments: Any, message: str) -> None:
    check_refused([(message, lambda: SarSensor(*arguments))], remedy=False)


def test_beliefs_that_the_model_cannot_hold_are_refused() -> None:
    walking = replace(IMU, gyro_markov_deg_h=0.1, gyro_markov_time_s=100.0)
    turned = {"rotate_noise_by_error": True, "inflation": ProcessNoiseInflation()}
    check_refused([
        (r"model\.imu must have positive biases, got gyro_bias_deg_h=0\.0", lambda: SinsSar(replace(IMU, gyro_bias_deg_h=0.0), SarSensor(), INITIAL)),
        (r"model\.imu must have constant biases, got gyro_markov_deg_h=0\.1", lambda: SinsSar(walking, SarSensor(), INITIAL)),
        (r"model\.rotate_noise_by_error must be false with model\.inflation", lambda: SinsSar(IMU, SarSensor(), INITIAL, **turned)),
    ])  # fmt: skip


# the printed numbers as they stand


def test_the_fixed_flight_starts_every_run_alike() -> None:
    cfg = composed(
        "scenario=sar_flight_constant_errors",
        "scenario.imu_rate_hz=10",
        "scenario.trajectory.duration_s=2",
    )
    episode = job.instantiate(cfg.scenario).draw(NominalNoise(), RUNS, 1)
    model = job.instantiate(cfg.model)
    assert torch.equal(
        model.p0, job.instantiate(composed("scenario=sar_flight").model).p0
    )  # filters believe what they did
    first = model.chart.subtract(model.assemble(episode.truth)[:, 0], model.origin) / model.p0
    # a second after the start: tilts have turned gravity into 0.003 m/s, 0.8 m/s into as many metres
    assert torch.allclose(first, torch.ones_like(first), atol=0.1)
    assert not torch.equal(episode.record.y[0], episode.record.y[1])


def test_every_variant_of_the_flight_is_one_of_the_class() -> None:
    for scenario in ("sar_flight", "sar_flight_slow", "sar_flight_constant_errors"):
        cfg = composed(f"scenario={scenario}")
        scene = job.instantiate(cfg.scenario)
        assert isinstance(scene, SimulatedFlight)
        assert isinstance(scene.receiver, SarSensor)
        assert isinstance(job.instantiate(cfg.model), SinsSar)
