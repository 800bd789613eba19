"""The INS/GNSS model: matrices against exact ones, errors against simulated truth, filters against chi-square."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from model_cases import filter_with_scores
from recorded_data import believed
from refusals import check_refused
from scipy import stats
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation
from torch import Tensor

from pfbench import job
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, Record, iterate_steps
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    UnscentedPoints,
)
from pfbench.job.config import compose_tree
from pfbench.model import Constraints, FlatEarth, RotatingEarth, StrapdownBlocks
from pfbench.model.ins_gnss import InsGnss, LooseStep
from pfbench.nav import (
    AlignmentErrors,
    GnssReceiver,
    ImuErrors,
    ManoeuvreTrajectory,
    ProcessNoiseInflation,
    TrajectoryStart,
    accelerate,
    attitude,
    climb,
    cruise,
    earth,
    error_dynamics,
    turn,
)
from pfbench.nav.strapdown import InsIntervals, PreintegratedImu, preintegrate
from pfbench.noise.base import NominalNoise
from pfbench.scenario.flights import SimulatedFlight

IMU = ImuErrors(0.05, 0.05, 3600.0, 0.01, 100.0, 50.0, 1800.0, 5.0)
RECEIVER = GnssReceiver((6.87, 7.20, 4.83), (0.21, 0.20, 0.14))
INITIAL = AlignmentErrors((1.0, 1.0, 5.0), (0.2, 0.2, 0.2), (10.0, 10.0, 10.0))
MODELS: dict[str, Callable[[], InsGnss]] = {
    "15 states": lambda: InsGnss(IMU, RECEIVER, INITIAL),
    "18 states": lambda: InsGnss(IMU, RECEIVER, INITIAL, markov=True),
    "15 inflated": lambda: InsGnss(IMU, RECEIVER, INITIAL, inflation=ProcessNoiseInflation()),
    "18 inflated": lambda: InsGnss(
        IMU, RECEIVER, INITIAL, markov=True, inflation=ProcessNoiseInflation()
    ),
}
every_model = pytest.mark.parametrize("name", MODELS)
RUNS = torch.arange(3)
MANOEUVRES = (accelerate(5.0, 10.0), climb(8.0, 5.0, 5.0), turn(60.0, 15.0), cruise(10.0))


@pytest.fixture(scope="module")
def flight() -> Episode:
    """A minute with every manoeuvre: 3 runs, 50 intervals of 1 s."""
    start = TrajectoryStart(lat_deg=32.0, lon_deg=118.0, height=200.0, speed=50.0, heading_deg=45.0)
    return SimulatedFlight(
        ManoeuvreTrajectory(MANOEUVRES, start), IMU, RECEIVER, INITIAL, imu_rate_hz=20.0
    ).draw(NominalNoise(), RUNS, 5)


def composed(*words: str) -> Any:
    return compose_tree(list(words))


# the transition


def exact_parts(model: InsGnss, u: InsIntervals) -> tuple[Tensor, Tensor, Tensor]:
    """F, G and q written out again, 18 states whatever the model has; position in (rad, rad, m)."""
    f, g = u.f.new_zeros(*u.f.shape[:-1], 18, 18), u.f.new_zeros(*u.f.shape[:-1], 18, 12)
    f[..., :9, :9] = error_dynamics.small_angle_matrix(u.pos, u.vel, u.f)
    f[..., 0:3, 9:12] = f[..., 0:3, 12:15] = g[..., 0:3, 0:3] = -u.dcm
    f[..., 3:6, 15:18] = g[..., 3:6, 3:6] = u.dcm
    for k in range(3):
        f[..., 12 + k, 12 + k], f[..., 15 + k, 15 + k] = (
            -1 / IMU.gyro_markov_time_s,
            -1 / IMU.accelerometer_markov_time_s,
        )
        g[..., 12 + k, 6 + k] = g[..., 15 + k, 9 + k] = 1.0
    gyro = 2 * IMU.gyro_markov**2 / IMU.gyro_markov_time_s
    accelerometer = 2 * IMU.accelerometer_markov**2 / IMU.accelerometer_markov_time_s
    sizes = [IMU.gyro_random_walk**2, IMU.accelerometer_random_walk**2, gyro, accelerometer]
    return f, g, u.f.new_tensor([size for size in sizes for _ in range(3)])


def scales(u: InsIntervals) -> tuple[Tensor, Tensor]:
    """Diagonal matrices that turn (rad, rad, m) into metres at the start and at the end of intervals."""
    ones = u.f.new_ones(*u.f.shape[:-1], 18)
    before, after = ones.clone(), ones.clone()
    before[..., 6:9], after[..., 6:9] = earth.metre_scale(u.pos_start), earth.metre_scale(u.pos_end)
    return torch.diag_embed(before), torch.diag_embed(after)


def test_transition_is_the_matrix_exponential_to_order_four(flight: Episode) -> None:
    u = flight.record.u
    f, _, _ = exact_parts(MODELS["18 states"](), u)
    ft = f * u.duration[..., None, None]
    before, after = scales(u)
    exact = after @ torch.matrix_exp(ft) @ torch.linalg.inv(before)
    phi = MODELS["18 states"]().discretise(u).phi
    # what a fourth-order series leaves out is its fifth term, and next to nothing more
    fifth = after @ torch.linalg.matrix_power(ft, 5) @ torch.linalg.inv(before) / 120
    assert (phi - exact).abs().max() <= 1.01 * fifth.abs().max() + 1e-12
    assert (
        (phi - exact).abs().max() < 1e-6
    )  # metres per rad/s, after a second: w^2 g T^5 / 120, where the fourth term has 1e-4


def test_fifteen_states_are_eighteen_without_a_markov_part(flight: Episode) -> None:
    phi18, phi15 = (
        MODELS[name]().discretise(flight.record.u).phi for name in ("18 states", "15 states")
    )
    assert torch.allclose(phi15[..., :9, :12], phi18[..., :9, :12], rtol=1e-12, atol=0)
    eye = torch.eye(6, dtype=torch.float64).expand(*phi15.shape[:2], -1, -1)
    assert torch.equal(phi15[..., 9:, 9:15], eye)  # random walks


# Held constant over an interval T, a driver integrated k times gets the variance T^(2k+1) / (k+1)!^2 where white noise has
# T^(2k+1) / ((2k+1) k!^2): the ratio is (2k+1) / (k+1)^2.
CHAINS = {
    "gyro": (0, ((0, 0), (3, 1), (6, 2))),
    "accelerometer": (3, ((3, 0), (6, 1))),
    "gyro driver": (6, ((12, 0), (0, 1), (3, 2), (6, 3))),
    "accelerometer driver": (9, ((15, 0), (3, 1), (6, 2))),
}


@pytest.mark.parametrize("source", CHAINS)
def test_noise_over_an_interval_against_van_loan(flight: Episode, source: str) -> None:
    first, chain = CHAINS[source]
    model, u = MODELS["18 states"](), flight.record.u
    f, g, q = exact_parts(model, u)
    g = g * torch.isin(torch.arange(12), torch.arange(first, first + 3))
    span = u.duration[..., None, None]
    block = torch.cat(
        [torch.cat([-f, g * q @ g.mT], -1), torch.cat([torch.zeros_like(f), f.mT], -1)], -2
    )
    power = torch.matrix_exp(block * span)  # [Van Loan 1978]
    after = scales(u)[1]
    exact = after @ power[..., 18:, 18:].mT @ power[..., :18, 18:] @ after
    factor = model.discretise(u).gain[..., first : first + 3]
    ours = factor @ factor.mT
    for start, k in chain:
        axes = slice(
            start, start + 2
        )  # the vertical is driven by the horizontal specific force, which manoeuvres change
        ratio = (
            ours.diagonal(dim1=-2, dim2=-1)[..., axes] / exact.diagonal(dim1=-2, dim2=-1)[..., axes]
        )
        # in the air |F| is below 0.01 (rates) beside the chain itself, so a second is short
        assert torch.allclose(ratio, ratio.new_tensor((2 * k + 1) / (k + 1) ** 2), rtol=0.02)


def test_inflation_adds_its_variances_and_nothing_else(flight: Episode) -> None:
    plain, inflated = (
        MODELS[name]().discretise(flight.record.u) for name in ("18 states", "18 inflated")
    )
    noise, full = plain.gain, inflated.gain
    extra = full @ full.mT - noise @ noise.mT
    arcsec, size = math.radians(1 / 3600), ProcessNoiseInflation()
    gyro, accelerometer = (
        [size.gyro_deg_h * math.radians(1) / 3600] * 6,
        [size.accelerometer_ug * 9.80665e-6] * 3,
    )
    sd = [
        *(a * arcsec for a in size.attitude_arcsec),
        *size.velocity,
        *size.position,
        *gyro,
        *accelerometer,
    ]
    wanted = torch.diag(torch.tensor(sd, dtype=torch.float64).square())
    scale = torch.tensor(sd, dtype=torch.float64)
    assert torch.allclose(plain.phi, inflated.phi, rtol=1e-14, atol=0)
    assert torch.allclose(
        extra / scale / scale[:, None],
        (wanted / scale / scale[:, None]).expand_as(extra),
        atol=1e-9,
    )


@pytest.mark.parametrize("name", ["15 inflated", "18 inflated"])
def test_the_transition_law_is_the_law_of_propagate(flight: Episode, name: str) -> None:
    model = MODELS[name]()
    seen = model.prepare(flight.record).at_step(7)
    x = PhiloxStream(2, RUNS).normal("x", 5, len(model.names)) * model.p0
    w = PhiloxStream(2, RUNS).normal("w", 5, model.noise_dim)
    law = model.transition(x, seen.u)
    assert law is not None
    log_p = law.log_prob(model.propagate(x, seen.u, w))
    log_det = torch.linalg.slogdet(model.noise_gain(seen.u))[1].unsqueeze(-1)
    wanted = model.noise.log_prob(w) - log_det  # change of variables
    assert torch.allclose(log_p, wanted, rtol=1e-9, atol=1e-7)


@pytest.mark.parametrize("name", ["15 states", "18 states"])
def test_a_singular_transition_is_not_faked(flight: Episode, name: str) -> None:
    model = MODELS[name]()
    seen = model.prepare(flight.record).at_step(0)
    assert (
        model.transition(torch.zeros(3, 2, len(model.names), dtype=torch.float64), seen.u) is None
    )


# what is measured, and what is an error


def test_measurement_order_is_position_then_velocity() -> None:
    model = MODELS["18 states"]()
    x = torch.arange(18.0, dtype=torch.float64).reshape(1, 1, 18)
    law: Any = model.observation(x, LooseStep(x, x))
    assert law.mean[0, 0].tolist() == [6.0, 7.0, 8.0, 3.0, 4.0, 5.0]
    assert torch.allclose(
        law.stddev[0, 0], torch.tensor([6.87, 7.20, 4.83, 0.21, 0.20, 0.14], dtype=torch.float64)
    )


@every_model
def test_a_perfect_estimate_leaves_no_error(flight: Episode, name: str) -> None:
    model = MODELS[name]()
    truth = model.assemble(flight.truth)
    assert not torch.isnan(truth).any()
    assert (
        model.error(truth, truth) / model.p0
    ).abs().max() < 1e-9  # angles of 1e-3 rad go through a product of matrices
    nothing = model.error(torch.zeros_like(truth), truth)
    assert torch.allclose(
        nothing[..., :9], truth[..., :9], rtol=1e-9, atol=1e-12
    )  # the INS itself is in error by the truth
    assert torch.equal(nothing[..., 9:], -truth[..., 9:])  # and nothing was said of the sensors


def test_error_is_corrected_minus_true(flight: Episode) -> None:
    model = MODELS["15 states"]()
    u, truth = flight.record.u, model.assemble(flight.truth)
    guess = PhiloxStream(3, RUNS).normal("guess", truth.shape[1], 15) * model.p0
    error = model.error(guess, truth)
    true_pos = u.pos_end - truth[..., 6:9] / earth.metre_scale(u.pos_end)
    corrected = u.pos_end - guess[..., 6:9] / earth.metre_scale(u.pos_end)
    # a metre of latitude differs from one place to another 100 m away by 1e-5 at most
    assert torch.allclose(
        (corrected - true_pos) * earth.metre_scale(u.pos_end), error[..., 6:9], rtol=1e-6, atol=1e-4
    )
    assert torch.allclose(
        (u.vel_end - guess[..., 3:6]) - (u.vel_end - truth[..., 3:6]), error[..., 3:6], atol=1e-10
    )
    dcm = attitude.dcm_from_euler(guess[..., :3]) @ u.dcm_end  # corrected attitude
    true_dcm = attitude.dcm_from_euler(truth[..., :3]) @ u.dcm_end
    assert torch.allclose(attitude.attitude_error(true_dcm, dcm), error[..., :3], atol=1e-12)
    assert torch.allclose(error[..., 9:], guess[..., 9:] - truth[..., 9:])


RULES = {
    "ukf": SigmaPointLinearisation(UnscentedPoints()),
    "ckf": SigmaPointLinearisation(CubaturePoints()),
}


@pytest.mark.parametrize("rule", RULES)
@pytest.mark.parametrize("name", ["15 states", "18 inflated"])
def test_on_a_linear_model_all_gaussian_filters_are_one(
    flight: Episode, name: str, rule: str
) -> None:
    model = MODELS[name]()
    kalman, other = (
        filter_with_scores(GaussianFilter(TaylorLinearisation()), model, flight),
        filter_with_scores(GaussianFilter(RULES[rule]), model, flight),
    )
    sd = kalman.variance.sqrt()
    assert ((kalman.mean - other.mean) / sd).abs().max() < 1e-9
    assert torch.allclose(kalman.variance, other.variance, rtol=1e-9, atol=0)
    assert torch.allclose(kalman.log_evidence, other.log_evidence, rtol=1e-9)


def test_a_receiver_without_velocity_is_one_whose_velocity_is_never_seen(flight: Episode) -> None:
    blind = InsGnss(IMU, GnssReceiver(RECEIVER.position_sd), INITIAL)
    y = flight.record.y.clone()
    y[..., 3:] = torch.nan
    position_only = flight.record._replace(y=y[..., :3])
    a = filter_with_scores(
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
        blind,
        replace(flight, record=position_only),
    )
    b = filter_with_scores(
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
        MODELS["15 states"](),
        replace(flight, record=flight.record._replace(y=y)),
    )
    assert torch.allclose(a.mean, b.mean, rtol=1e-9, atol=1e-12)
    assert torch.allclose(a.log_evidence, b.log_evidence, rtol=1e-9)
    both = filter_with_scores(
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())), MODELS["15 states"](), flight
    )
    assert (both.variance[..., 3:6] < a.variance[..., 3:6]).all()  # seeing it would have helped


def test_improper_initial_laws_are_refused() -> None:
    driftless = ImuErrors(gyro_bias_deg_h=1.0, accelerometer_bias_ug=10.0)
    check_refused([
        (r"model\.imu.*positive gyro and accelerometer", lambda: InsGnss(ImuErrors(gyro_bias_deg_h=1.0), RECEIVER, INITIAL)),
        (r"Markov parts \(or markov=false\)", lambda: InsGnss(driftless, RECEIVER, INITIAL, markov=True)),
    ])  # fmt: skip


# against simulated flights


@pytest.mark.slow
def test_the_linear_transition_carries_errors_of_constant_biases_over_a_whole_flight() -> None:
    """500 s open loop against the mechanisation: 0.2-0.7 m of 110-400 m, 0.002 m/s, 0.01 arcsec; ten times that is allowed."""
    constant = ["scenario.imu.gyro_markov_deg_h=0", "scenario.imu.accelerometer_markov_ug=0"]
    flight = job.instantiate(
        composed(
            "scenario=flight_500s", "scenario.imu_rate_hz=20", "episode_cache_dir=null", *constant
        ).scenario
    )
    episode = flight.draw(NominalNoise(), torch.arange(10), 3)
    believed = ImuErrors(
        0.05, 0.05, 3600.0, accelerometer_bias_ug=100.0
    )  # no correlation time: the bias does not decay
    model = InsGnss(believed, RECEIVER, INITIAL, markov=True)
    constants = {
        "gyro_constant": episode.truth["gyro_bias"],
        "gyro_markov": 0 * episode.truth["gyro_bias"],
    }
    truth = model.assemble(episode.truth | constants)
    assert truth[..., :2].abs().max() < math.radians(0.2)  # the model is linear in the tilts
    record = model.prepare(episode.record)
    x = truth[:, :1]
    for t in range(1, truth.shape[1]):
        x = model.propagate(x, record.at_step(t).u, x.new_zeros(10, 1, 12))
    missed, grown = (
        (x[:, 0] - truth[:, -1]).square().mean(0).sqrt(),
        truth[:, -1].square().mean(0).sqrt(),
    )
    assert (grown[6:8] > 100.0).all()  # there was something to carry
    assert (missed[6:9] < 7.0).all()
    assert (missed[3:6] < 0.02).all()
    assert (missed[:3] < math.radians(0.1 / 3600)).all()


@pytest.mark.slow
def test_the_kalman_filter_is_consistent_on_flights_that_its_model_did_not_draw() -> None:
    """Normalised errors at the end, state by state, and NEES of groups; both chi-square where the model is right.

    Of 18 states; scenario/test_simulated_flight.py has the 15 of flight_300s, where the INS is corrected.
    """
    runs, level = 40, 1e-4  # of each of some twenty bands
    cfg = composed("scenario=flight_500s", "scenario.imu_rate_hz=10", "episode_cache_dir=null")
    model = job.instantiate(cfg.model)
    episode = job.instantiate(cfg.scenario).draw(NominalNoise(), torch.arange(runs), 12)
    estimate = filter_with_scores(
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())), model, episode
    )
    assert not estimate.lost.any()

    # 18 states: the accelerometer bias is one Markov process of 112 ug; its constant 100 ug should not decay but does in the
    # model, so that the model's spread without measurements falls short, at the end by this factor
    short = np.ones(len(model.groups))
    if model.markov:
        imu, end = model.imu, episode.time[-1].item()
        kept = math.exp(-2 * end / imu.accelerometer_markov_time_s)
        constant, walk = imu.accelerometer_bias**2, imu.accelerometer_markov**2
        short[-1] = math.sqrt((constant + walk) / (kept * constant + walk))
        assert 1.0 < short[-1] < 1.3

    z = (estimate.trace["error"][:, -1] / estimate.variance[:, -1].sqrt()).square().sum(0).numpy()
    low, high = stats.chi2.ppf([level, 1 - level], runs)
    assert (z > low).all()
    assert (z < high * np.repeat(short, 3) ** 2).all(), np.sqrt(z / runs)
    nees = estimate.trace["nees"][:, -1].sum(0).numpy()
    low, high = stats.chi2.ppf([level, 1 - level], 3 * runs)
    assert (nees > low).all()
    assert (nees < high * short**2).all(), nees / (3 * runs)


# WGS-84 [NIMA TR8350.2]
A, F, OMEGA, G_E, G_P = 6378137.0, 1 / 298.257223563, 7.292115e-5, 9.7803253359, 9.8321849378
B = A * (1 - F)
E2, M = F * (2 - F), OMEGA**2 * A**2 * B / 3.986004418e14
LATITUDE, HEIGHT, SECONDS, STEP = 48.0, 2000.0, 60.0, 0.25
FORCE, RATE = np.array([0.2, 0.3, 9.8]), np.array([0.002, -0.001, 0.03])  # right, forward, up
VELOCITY = np.array([150.0, -120.0, 10.0])  # East, North, Up


def axes(latitude: float, longitude: float) -> np.ndarray:
    """East, North and Up in Earth-fixed axes, rows."""
    (sp, cp), (sl, cl) = ((np.sin(a), np.cos(a)) for a in (latitude, longitude))
    return np.array([[-sl, cl, 0], [-sp * cl, -sp * sl, cp], [cp * cl, cp * sl, sp]])


def fixed_to_earth(latitude: float, height: float) -> np.ndarray:
    n = A / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
    return np.array([(n + height) * np.cos(latitude), 0, (n * (1 - E2) + height) * np.sin(latitude)])  # fmt: skip


def gravity(r: np.ndarray) -> np.ndarray:
    """Normal gravity in Earth-fixed axes; the latitude by fixed-point iteration."""
    flat, longitude = np.hypot(r[0], r[1]), np.arctan2(r[1], r[0])
    latitude = np.arctan2(r[2], flat * (1 - E2))
    for _ in range(6):
        n = A / np.sqrt(1 - E2 * np.sin(latitude) ** 2)
        latitude = np.arctan2(r[2] + E2 * n * np.sin(latitude), flat)
    height, s2 = flat / np.cos(latitude) - n, np.sin(latitude) ** 2
    size = (A * G_E * (1 - s2) + B * G_P * s2) / np.sqrt(A**2 * (1 - s2) + B**2 * s2)
    size *= 1 - 2 * height / A * (1 + F + M - 2 * F * s2) + 3 * (height / A) ** 2
    return -size * axes(latitude, longitude)[2]


def integrate() -> tuple[np.ndarray, np.ndarray, Rotation]:
    """Position, velocity and attitude at the end, in the East, North, Up of the start."""
    to_local, first = axes(np.radians(LATITUDE), 0.0), fixed_to_earth(np.radians(LATITUDE), HEIGHT)
    spin = np.array([0, 0, OMEGA])

    def slope(_: float, s: np.ndarray) -> np.ndarray:
        c, v = s[:9].reshape(3, 3), s[9:12]
        x, y, z = RATE - c.T @ spin
        turn = c @ np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        acceleration = c @ FORCE + gravity(s[12:]) - 2 * np.cross(spin, v)
        return np.concatenate([turn.ravel(), acceleration, v])

    start = np.concatenate([to_local.T.ravel(), to_local.T @ VELOCITY, first])
    end = solve_ivp(slope, (0, SECONDS), start, method="DOP853", rtol=1e-12, atol=1e-9).y[:, -1]
    attitude = Rotation.from_matrix(to_local @ end[:9].reshape(3, 3))
    return to_local @ (end[12:] - first), to_local @ end[9:12], attitude


def follow(model: StrapdownBlocks) -> np.ndarray:
    """State at the end of steps without noise, [16]."""
    count, pieces = round(SECONDS / STEP), 25
    spans = torch.full((1, count, pieces), STEP / pieces, dtype=torch.float64)
    force, rate = (torch.from_numpy(a).expand(1, count, pieces, 3) for a in (FORCE, RATE))
    bias = torch.zeros(1, count, 6, dtype=torch.float64)
    imu = preintegrate(force, rate, spans, bias)
    size = float(-gravity(fixed_to_earth(np.radians(LATITUDE), HEIGHT)) @ axes(np.radians(LATITUDE), 0)[2])  # fmt: skip
    u = PreintegratedImu(*imu, bias, torch.full((1, count), size).double(), spans.sum(-1))
    x = model.origin.reshape(1, 1, -1).clone()
    x[..., 4:7] = torch.from_numpy(VELOCITY)
    quiet = torch.zeros(1, 1, 12, dtype=torch.float64)
    for _, at, record in iterate_steps(model, Record(torch.zeros(1, count, 3), u)):
        x = at.propagate(x, record.u, quiet)
    return np.asarray(x[0, 0])


def test_a_minute_on_the_rotating_earth_is_that_of_earth_fixed_axes() -> None:
    position, velocity, attitude = integrate()
    off = {}
    for form in (FlatEarth(), RotatingEarth(LATITUDE, HEIGHT)):
        x = follow(StrapdownBlocks(believed([1.0, 1.0, 2.0], None), Constraints(), form))
        turn = (Rotation.from_quat(x[:4], scalar_first=True).inv() * attitude).magnitude()
        off[type(form)] = np.array([np.linalg.norm(x[7:10] - position), np.linalg.norm(x[4:7] - velocity), turn])  # fmt: skip
    assert (off[FlatEarth] > [30.0, 1.0, 2e-3]).all()  # m, m/s, rad
    assert (off[RotatingEarth] < 1e-3 * off[FlatEarth]).all()


def test_a_gyro_at_rest_measures_the_rate_of_the_earth() -> None:
    known = Constraints(zero_rate_sd=1e-5)
    model = StrapdownBlocks(believed([1.0, 1.0, 2.0], None), known, RotatingEarth(90.0))
    x = model.origin.reshape(1, 1, -1).clone()
    x[..., 10:13] = torch.tensor([1e-3, 2e-3, 3e-3])
    u = PreintegratedImu(*(torch.zeros(1, *shape).double() for shape in ((4,), (3,), (3,), (9, 6), (6,), (), ())))  # fmt: skip
    seen = model.observation(x, u).mean[0, 0, 3:]
    assert seen.tolist() == pytest.approx([1e-3, 2e-3, 3e-3 + OMEGA], abs=1e-9)
    assert model.choices[0].startswith("rotating WGS-84 Earth")
    with pytest.raises(ValueError, match=r"model\.earth\.latitude_deg must be in \[-90, 90\], got 91"):  # fmt: skip
        RotatingEarth(91.0)
