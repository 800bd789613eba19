"""SINS/GPS with a large azimuth error: equations against the mechanisation and finite differences, filters against chi-square."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from config_cases import composed
from model_cases import filter_with_scores
from scipy import stats
from torch import Tensor

from pfbench import job
from pfbench.core import Episode, PhiloxStream, Record
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    UnscentedPoints,
    run_filter,
)
from pfbench.model.azimuth import (
    ErrorEquations,
    EulerDiscretisation,
    ExactErrorEquations,
    LinearisedRateEquations,
    PrintedErrorEquations,
    SinsGpsAzimuth,
    TrapezoidDiscretisation,
    compute_euler_rate,
    compute_level_coupling,
)
from pfbench.nav import (
    AlignmentErrors,
    GnssReceiver,
    ImuErrors,
    ManoeuvreTrajectory,
    TrajectoryStart,
    accelerate,
    attitude,
    climb,
    earth,
    error_dynamics,
    turn,
)
from pfbench.nav.strapdown import InsIntervals
from pfbench.noise.base import NominalNoise
from pfbench.scenario.flights import SimulatedFlight

ARCMIN = math.radians(1 / 60)
IMU = ImuErrors(
    gyro_bias_deg_h=1.0,
    gyro_random_walk_deg_sqrt_h=0.125,
    accelerometer_bias_ug=1000.0,
    accelerometer_random_walk_ug_sqrt_hz=33.67,
)
RECEIVER = GnssReceiver((10.0, 10.0, 10.0), (1.0, 1.0, 1.0))
INITIAL = AlignmentErrors((60.0, 60.0, 1200.0), (1.0, 1.0, 1.0), (10.0, 10.0, 10.0))
FORMS: list[ErrorEquations] = [
    PrintedErrorEquations(),
    LinearisedRateEquations(),
    ExactErrorEquations(),
]
every_form = pytest.mark.parametrize("form", FORMS, ids=lambda form: type(form).__name__)
every_step = pytest.mark.parametrize(
    "step", [EulerDiscretisation(), TrapezoidDiscretisation()], ids=lambda step: type(step).__name__
)
# the first minute of the paper's words: accelerate, climb, begin to turn
FLIGHT = SimulatedFlight(
    ManoeuvreTrajectory(
        (accelerate(10.0, 10.0), climb(10.0, 10.0, 20.0), turn(15.0, 10.0)),
        TrajectoryStart(34.0, 108.0, 400.0),
    ),
    IMU,
    RECEIVER,
    INITIAL,
    imu_rate_hz=20.0,
)


def model_of(
    form: ErrorEquations = PrintedErrorEquations(),  # noqa: B008
    step: Any = TrapezoidDiscretisation(),  # noqa: B008
    **words: Any,
) -> SinsGpsAzimuth:
    return SinsGpsAzimuth(IMU, RECEIVER, INITIAL, form, step, **words)


def flown(
    alpha_deg: tuple[float, float, float], imu: ImuErrors = IMU, seconds: int = 60
) -> tuple[Episode, Tensor]:
    """One run that starts with exactly these attitude errors, 1 m/s and 10 m; and its initial errors [9]."""
    sizes = tuple(max(60 * a, 1e-9) for a in alpha_deg)
    initial = AlignmentErrors(sizes, (1.0, 1.0, 1.0), (10.0, 10.0, 10.0), randomise=False)
    episode = replace(FLIGHT, imu=imu, initial_errors=initial).draw(
        NominalNoise(), torch.arange(1), 1
    )
    u = InsIntervals(*(a[:, :seconds] for a in episode.record.u))
    truth = {name: value[:, :seconds] for name, value in episode.truth.items()}
    return Episode(
        Record(episode.record.y[:, :seconds], u), episode.time[:seconds], truth
    ), initial.sd


@pytest.fixture(scope="module")
def large() -> tuple[Episode, Tensor]:
    """Sensors without errors, tilts of 0.1 degrees, an azimuth error of 20."""
    return flown((0.1, 0.1, 20.0), ImuErrors())


@pytest.fixture(scope="module")
def worlds() -> Episode:
    """Four runs with sensor errors and drawn initial errors."""
    return FLIGHT.draw(NominalNoise(), torch.arange(4), 3)


def states(model: SinsGpsAzimuth, n: int, runs: int = 4) -> Tensor:
    return PhiloxStream(2, torch.arange(runs)).normal("x", n, len(model.names)) * model.p0


# the equations


def test_the_coupling_at_zero_is_the_small_angle_model() -> None:
    """dG/dalpha at 0 is [-skew(w_in); skew(f)]."""
    w, f = (
        torch.tensor([[1e-5, 5e-5, -7e-5]], dtype=torch.float64),
        torch.tensor([[0.3, -2.0, 9.8]], dtype=torch.float64),
    )
    h = 1e-6
    steps = h * torch.eye(3, dtype=torch.float64).unsqueeze(0)
    slope = (compute_level_coupling(steps, w, f) - compute_level_coupling(-steps, w, f))[0] / (
        2 * h
    )
    assert torch.allclose(slope[:3], -attitude.skew(w[0]), rtol=0, atol=1e-13)
    assert torch.allclose(slope[3:], attitude.skew(f[0]), rtol=0, atol=1e-9)
    assert not compute_level_coupling(0 * steps, w, f).any()


@pytest.mark.parametrize("azimuth_deg", [0.0, 20.0, -75.0, 160.0])
def test_the_coupling_is_exact_in_azimuth_and_of_first_order_in_the_tilts(
    azimuth_deg: float,
) -> None:
    w, f = (
        torch.tensor([[2e-5, 5e-5, -7e-5]], dtype=torch.float64),
        torch.tensor([[0.3, -2.0, 9.8]], dtype=torch.float64),
    )

    def missed(tilt: float) -> float:
        alpha = torch.tensor([tilt, -0.7 * tilt, math.radians(azimuth_deg)], dtype=torch.float64)
        lost = torch.eye(3, dtype=torch.float64) - attitude.dcm_from_euler(alpha)
        exact = torch.cat([1e5 * lost.T @ w[0], lost @ f[0]])
        found = compute_level_coupling(alpha.reshape(1, 3, 1), w, f)[0, :, 0] * torch.tensor(
            [1e5] * 3 + [1.0] * 3
        )
        return float((found - exact).abs().max())

    assert missed(0.0) < 1e-14 * 1e5 * 10
    assert 3.7 < missed(0.02) / missed(0.01) < 4.3


def test_euler_rates_turn_the_error_matrix() -> None:
    """M' = M skew(w)."""
    alpha, w, dt = (
        torch.tensor([0.2, -0.1, 2.5], dtype=torch.float64),
        torch.tensor([0.3, -0.2, 0.5], dtype=torch.float64),
        1e-6,
    )
    m, rate = attitude.dcm_from_euler(alpha), compute_euler_rate(alpha, w)
    slope = (
        attitude.dcm_from_euler(alpha + dt * rate) - attitude.dcm_from_euler(alpha - dt * rate)
    ) / (2 * dt)
    assert torch.allclose(slope, m @ attitude.skew(w), atol=1e-9)


@every_form
@every_step
def test_for_small_errors_every_form_is_the_linear_error_model(
    worlds: Episode, form: ErrorEquations, step: Any
) -> None:
    """The derivative of a step at 0 is I + F T with the attitude's own columns, position rows by the discretisation."""
    model = model_of(form, step, biases=True)
    u = worlds.record.u
    seen = model.prepare(worlds.record).at_step(30)
    h = model.p0 * 1e-4
    zero = torch.zeros(4, 15, 12, dtype=torch.float64)
    moves = torch.diag(h).expand(4, -1, -1)
    slope = (
        (model.propagate(moves, seen.u, zero) - model.propagate(-moves, seen.u, zero))
        / (2 * h[:, None])
    ).mT
    f = torch.zeros(4, 15, 15, dtype=torch.float64)
    f[:, :9, :9] = error_dynamics.small_angle_matrix(u.pos[:, 30], u.vel[:, 30], u.f[:, 30])
    middle = (u.dcm[:, 30] + u.dcm_end[:, 30]) / 2
    f[:, 0:3, 9:12], f[:, 3:6, 12:15] = -middle, middle
    eye = torch.eye(15, dtype=torch.float64)
    wanted = eye + f  # T = 1 s
    if isinstance(step, TrapezoidDiscretisation):
        wanted[:, 6:9] = (
            eye[6:9] + f[:, 6:9, 6:9] @ eye[6:9] + f[:, 6:9, 3:6] @ (eye[3:6] + f[:, 3:6] / 2)
        )
    wanted = error_dynamics.convert_transition_to_metres(
        wanted, u.pos_start[:, 30], u.pos_end[:, 30]
    )
    scale = model.p0[:, None] / model.p0  # each entry in units of what it turns into what
    assert torch.allclose(slope / scale, wanted / scale, rtol=0, atol=2e-6)


@every_form
def test_derivatives_by_differentiation_are_those_by_differences(
    worlds: Episode, form: ErrorEquations
) -> None:
    """What the extended Kalman filter sees, far from zero."""
    model = model_of(form, biases=True)
    u = model.prepare(worlds.record).at_step(30).u
    x = states(model, 1)[:1] * torch.tensor([1.0, 1.0, 4.0] + [1.0] * 12, dtype=torch.float64)
    u = type(u)(*(a[:1] for a in u))
    zero = torch.zeros(1, 1, 12, dtype=torch.float64)
    slope = torch.func.jacfwd(lambda a: model.propagate(a.reshape(1, 1, -1), u, zero)[0, 0])(
        x[0, 0]
    )
    h = model.p0 * 1e-4
    moved = x + torch.diag(h), x - torch.diag(h)
    plus, minus = (model.propagate(a, u, zero.expand(1, 15, -1)) for a in moved)
    scale = model.p0[:, None] / model.p0
    assert torch.allclose(
        slope / scale, ((plus - minus)[0] / (2 * h[:, None])).mT / scale, rtol=0, atol=1e-6
    )


# against the mechanisation


def carried(model: SinsGpsAzimuth, episode: Episode, start: Tensor) -> Tensor:
    """Greatest of each group's difference between the model's errors and the true ones: arcmin, m/s, m."""
    record, x = model.prepare(episode.record), start.reshape(1, 1, -1)
    rows = []
    for t in range(episode.record.y.shape[1]):
        x = model.propagate(x, record.at_step(t).u, x.new_zeros(1, 1, model.noise_dim))
        rows.append(x[:, 0])
    truth = model.assemble(episode.truth)
    missed = model.error(torch.stack(rows, 1), truth)[0].abs().amax(0)
    return torch.stack([missed[:3].max() / ARCMIN, missed[3:6].max(), missed[6:9].max()])


@pytest.mark.parametrize(
    ("form", "allowed"),
    [
        (PrintedErrorEquations(), (0.5, 0.05, 1.0)),
        (LinearisedRateEquations(), (0.05, 0.02, 0.5)),
        (ExactErrorEquations(), (0.05, 0.02, 0.5)),
    ],
)
def test_a_minute_of_free_propagation_from_20_degrees(
    large: tuple[Episode, Tensor], form: ErrorEquations, allowed: tuple[float, float, float]
) -> None:
    episode, start = large
    assert episode.truth["velocity"].abs().max() > 30.0
    assert episode.truth["position"].abs().max() > 1000.0
    assert (carried(model_of(form), episode, start) < torch.tensor(allowed)).all()


def test_the_printed_discretisation_loses_metres(large: tuple[Episode, Tensor]) -> None:
    episode, start = large
    lost = carried(model_of(PrintedErrorEquations(), EulerDiscretisation()), episode, start)
    assert 15.0 < lost[2] < 18.0  # a g T^2 / 2 of ten steps at 3.4 m/s^2
    assert (lost[:2] < torch.tensor([0.5, 0.05])).all()


@pytest.mark.parametrize("azimuth_deg", [90.0, 179.0])
def test_the_exact_form_carries_any_azimuth(azimuth_deg: float) -> None:
    """Half a minute of a reversed compass: 200 m/s wrong, and still metres are kept."""
    episode, start = flown((0.1, 0.1, azimuth_deg), ImuErrors(), seconds=30)
    assert episode.truth["velocity"].abs().max() > 90.0
    assert (
        carried(model_of(ExactErrorEquations()), episode, start) < torch.tensor([0.5, 0.1, 2.0])
    ).all()


def test_biases_are_carried_where_the_azimuth_is_wrong() -> None:
    """A bias in body axes pushes where the body really points: `Paper` turns it by the azimuth error, `Exact` does not."""
    sure = replace(
        IMU,
        gyro_random_walk_deg_sqrt_h=0.0,
        accelerometer_random_walk_ug_sqrt_hz=0.0,
        randomise_biases=False,
    )
    episode, start = flown((0.1, 0.1, 60.0), sure)
    biases = torch.tensor([IMU.gyro_bias] * 3 + [IMU.accelerometer_bias] * 3, dtype=torch.float64)
    start = torch.cat([start, biases])
    missed = carried(model_of(ExactErrorEquations(), biases=True), episode, start)
    assert (missed < torch.tensor([0.1, 0.03, 2.0])).all()  # of 4 km; of second order in T
    assert carried(model_of(LinearisedRateEquations(), biases=True), episode, start)[1] < 0.2
    assert (
        carried(model_of(PrintedErrorEquations(), biases=True), episode, start)[1] > 0.3
    )  # 2 sin(30 deg) 1 mg for a minute is 0.6 m/s


# noise


@pytest.mark.parametrize("kappa", [1.0, 5.0])
@every_step
def test_biases_count_as_white_noise(worlds: Episode, step: Any, kappa: float) -> None:
    """Variances kappa^2 (b^2 + N^2 / T) of the mean errors over an interval, the same in all level axes."""
    span = 0.25  # s
    u = worlds.record.u
    record = worlds.record._replace(u=u._replace(duration=torch.full_like(u.duration, span)))
    gain = model_of(step=step, process_noise_factor=kappa).prepare(record).u.gain
    q = gain @ gain.mT
    gyro, accelerometer = (
        (kappa * span) ** 2 * (bias**2 + walk**2 / span)
        for bias, walk in (
            (IMU.gyro_bias, IMU.gyro_random_walk),
            (IMU.accelerometer_bias, IMU.accelerometer_random_walk),
        )
    )
    eye = torch.eye(3, dtype=torch.float64).expand_as(q[..., :3, :3])
    assert torch.allclose(q[..., :3, :3] / gyro, eye, rtol=0, atol=1e-9)
    assert torch.allclose(q[..., 3:6, 3:6] / accelerometer, eye, rtol=0, atol=1e-9)
    across = q[..., 6:9, 3:6] / accelerometer
    swap = torch.tensor(
        [[0.0, 1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64
    )  # velocity E, N; position N, E
    share = 0.5 * span if isinstance(step, TrapezoidDiscretisation) else 0.0
    assert torch.allclose(across, share * swap.expand_as(across), rtol=0, atol=1e-4)
    assert not q[..., :3, 3:].any()


def test_residuals_at_the_truth_are_white_and_of_the_stated_size() -> None:
    """Of the measurements; and of the 15-state transition, whose noise is then the sensors' random walks alone."""
    runs = 60
    flight = replace(
        FLIGHT,
        trajectory=ManoeuvreTrajectory(
            (accelerate(5.0, 6.0),), TrajectoryStart(34.0, 108.0, 400.0)
        ),
        filter_interval_s=0.1,
    )
    episode = flight.draw(NominalNoise(), torch.arange(runs), 8)
    model = model_of(ExactErrorEquations(), biases=True)
    truth, record = model.assemble(episode.truth), model.prepare(episode.record)
    seen: list[Tensor] = []
    moved: list[Tensor] = []
    for t in range(1, truth.shape[1]):
        step = record.at_step(t)
        law: Any = model.observation(truth[:, t, None], step.u)
        seen.append((step.y - law.mean[:, 0]) / law.stddev[:, 0])
        still = model.propagate(
            truth[:, t - 1, None], step.u, torch.zeros(runs, 1, 12, dtype=torch.float64)
        )[:, 0]
        left = model.chart.subtract(truth[:, t], still)[:, :6, None]
        # over 0.1 s the gyro's noise adds 0.4 % to the variance of the velocity, which the model leaves out
        moved.append(torch.linalg.solve(step.u.gain[:, :6, :6], left)[..., 0])
    for z in (torch.stack(seen, 1), torch.stack(moved, 1)):
        n = z[..., 0].numel()
        assert (z.mean((0, 1)).abs() < 4.5 / math.sqrt(n) + 0.02).all()
        assert ((z.square().mean((0, 1)) - 1).abs() < 4.5 * math.sqrt(2 / n) + 0.01).all()
        assert ((z[:, 1:] * z[:, :-1]).mean((0, 1)).abs() < 4.5 / math.sqrt(n) + 0.01).all()


# states, measurements, errors


def test_names_groups_and_shapes(worlds: Episode) -> None:
    nine, fifteen = model_of(), model_of(biases=True)
    assert nine.names == fifteen.names[:9]
    assert [name.split("_")[-1] for name in nine.names] == [
        "E",
        "N",
        "U",
        "E",
        "N",
        "U",
        "N",
        "E",
        "U",
    ]
    assert list(nine.groups) == ["attitude", "velocity", "position"]
    assert list(fifteen.groups) == [*nine.groups, "gyro_bias", "accelerometer_bias"]
    for model, d in ((nine, 9), (fifteen, 15)):
        assert (
            len(model.names)
            == len(model.units)
            == len(model.p0)
            == model.chart.size
            == model.chart.dimension
            == d
        )
        seen = model.prepare(worlds.record).at_step(3)
        x = states(model, 5)
        assert model.propagate(
            x, seen.u, torch.zeros(4, 5, model.noise_dim, dtype=torch.float64)
        ).shape == (4, 5, d)
        assert model.observation(x, seen.u).batch_shape == (4, 5)
        assert model.noise_gain(seen.u).shape == (4, d, model.noise_dim)
        assert model.initial(4).batch_shape == (4,)
        assert model.assemble(worlds.truth).shape == (4, 60, d)
        prepared = model.prepare(worlds.record)
        assert model.prepare(prepared) is prepared
    assert nine.choices != fifteen.choices


def test_position_is_measured_before_velocity() -> None:
    model, x = model_of(), torch.arange(9.0, dtype=torch.float64).reshape(1, 1, 9)
    u: Any = None
    law: Any = model.observation(x, u)
    assert law.mean[0, 0].tolist() == [6.0, 7.0, 8.0, 3.0, 4.0, 5.0]
    assert law.stddev[0, 0].tolist() == [10.0, 10.0, 10.0, 1.0, 1.0, 1.0]
    blind = SinsGpsAzimuth(
        IMU,
        GnssReceiver((1.0, 2.0, 3.0)),
        INITIAL,
        PrintedErrorEquations(),
        TrapezoidDiscretisation(),
    )
    law = blind.observation(x, u)
    assert law.mean[0, 0].tolist() == [6.0, 7.0, 8.0]


@every_form
def test_azimuths_that_differ_by_a_turn_are_the_same(worlds: Episode, form: ErrorEquations) -> None:
    model = model_of(form)
    seen = model.prepare(worlds.record).at_step(20)
    x, w = states(model, 6), PhiloxStream(1, torch.arange(4)).normal("w", 6, 6)
    x[..., 2] += 2.5
    turned = x.clone()
    turned[..., 2] += 2 * torch.pi
    a, b = (model.propagate(value, seen.u, w) for value in (x, turned))
    assert torch.allclose(a, b, rtol=0, atol=1e-9)
    assert (a[..., 2].abs() <= torch.pi).all()


def test_a_cloud_about_south_averages_to_south() -> None:
    model = model_of()
    x = torch.zeros(1, 4, 9, dtype=torch.float64)
    x[0, :, 2] = torch.tensor([3.1, -3.1, 3.0, -3.0])
    mean = model.chart.mean(x, torch.full((1, 4), 0.25, dtype=torch.float64))
    assert abs(abs(mean[0, 2]) - torch.pi) < 1e-12


def test_error_is_corrected_minus_true(worlds: Episode) -> None:
    model = model_of(biases=True)
    u, truth = worlds.record.u, model.assemble(worlds.truth)
    assert (model.error(truth, truth) / model.p0).abs().max() < 1e-9
    guess = states(model, truth.shape[1])
    error = model.error(guess, truth)
    dcm = attitude.dcm_from_euler(guess[..., :3]) @ u.dcm_end
    true_dcm = attitude.dcm_from_euler(truth[..., :3]) @ u.dcm_end
    assert torch.allclose(attitude.attitude_error(true_dcm, dcm), error[..., :3], atol=1e-12)
    assert torch.allclose(
        (u.vel_end - guess[..., 3:6]) - (u.vel_end - truth[..., 3:6]), error[..., 3:6], atol=1e-10
    )
    true_pos = u.pos_end - truth[..., 6:9] / earth.metre_scale(u.pos_end)
    corrected = u.pos_end - guess[..., 6:9] / earth.metre_scale(u.pos_end)
    assert torch.allclose(
        (corrected - true_pos) * earth.metre_scale(u.pos_end), error[..., 6:9], rtol=1e-6, atol=1e-4
    )
    assert torch.equal(error[..., 9:], guess[..., 9:] - truth[..., 9:])


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: model_of(process_noise_factor=0.0),
            r"model\.process_noise_factor must be positive, got 0\.0",
        ),
        (
            lambda: SinsGpsAzimuth(
                ImuErrors(),
                RECEIVER,
                INITIAL,
                PrintedErrorEquations(),
                EulerDiscretisation(),
                biases=True,
            ),
            r"model\.imu must .*or set biases=false",
        ),
        (
            lambda: model_of().prepare(Record(torch.zeros(1, 1, 6))),
            r"record\.u must be InsIntervals .*got no inputs\. Choose a scenario",
        ),
    ],
)
def test_what_cannot_be(build: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        build()


# filters


CELLS = [
    (rule, form)
    for rule in (
        GaussianFilter(TaylorLinearisation()),
        GaussianFilter(SigmaPointLinearisation(UnscentedPoints())),
    )
    for form in FORMS
]


@pytest.mark.parametrize(
    ("method", "form"), [*CELLS, (ParticleFilter(500), PrintedErrorEquations())]
)
def test_every_kind_of_filter_runs_and_learns(
    worlds: Episode, form: ErrorEquations, method: Any
) -> None:
    """After twenty seconds of acceleration it knows more than the receiver, and more of the attitude than it was told."""
    estimate = filter_with_scores(method, model_of(form, process_noise_factor=30.0), worlds)
    assert not estimate.lost.any()
    late = estimate.trace["error"][:, 20:].square().mean((0, 1)).sqrt()
    told = torch.cat(
        [INITIAL.sd[:3] * torch.tensor([1.0, 1.0, 0.5]), RECEIVER.sd[3:], RECEIVER.sd[:3]]
    )
    assert (late < told).all()


def test_single_precision_is_enough_for_a_filter(worlds: Episode) -> None:
    model = model_of(ExactErrorEquations(), process_noise_factor=5.0)
    double = filter_with_scores(
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())), model, worlds
    )
    single = run_filter(
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
        model.float(),
        worlds.record,
        PhiloxStream(1, torch.arange(4)),
    )
    assert single.mean.dtype == torch.float32
    away = (single.mean.double() - double.mean).abs() / double.variance.sqrt()
    assert away.max() < 0.05


# configurations


def test_the_yamls_say_what_they_should() -> None:
    cfg = composed("scenario=azimuth")
    model = job.instantiate(cfg.model)
    assert (
        type(model.error_equations),
        type(model.discretisation),
        model.process_noise_factor,
        len(model.names),
    ) == (
        PrintedErrorEquations,
        TrapezoidDiscretisation,
        30.0,
        9,
    )
    fifteen = job.instantiate(composed("scenario=azimuth", "model=sins_gps_azimuth15").model)
    assert (type(fifteen.error_equations), fifteen.process_noise_factor, len(fifteen.names)) == (
        ExactErrorEquations,
        1.0,
        15,
    )
    believed = torch.tensor([1.0, 1.0, 20.0], dtype=torch.float64) * math.radians(1)
    for scene in ("azimuth", "azimuth_fast", "azimuth_constant_errors"):
        assert torch.allclose(job.instantiate(composed(f"scenario={scene}").model).p0[:3], believed)
    assert job.instantiate(composed("scenario=azimuth_fast").scenario).filter_interval_s == 0.1
    errors = job.instantiate(
        composed("scenario=azimuth_constant_errors").scenario
    ).initial_errors.draw_errors(PhiloxStream(1, torch.arange(3)))
    printed = torch.tensor(
        [0.0, 0.0, math.radians(20.0), 1.0, 1.0, 1.0, 10.0, 10.0, 10.0], dtype=torch.float64
    )
    assert torch.allclose(errors, printed.expand(3, -1), rtol=1e-12, atol=1e-9)
    drawn = (
        job.instantiate(cfg.scenario).initial_errors.draw_errors(PhiloxStream(1, torch.arange(400)))
        / model.p0
    )
    assert ((drawn.std(0) - 1).abs() < 4.5 / math.sqrt(800)).all()


def test_the_names_of_the_18_state_scene() -> None:
    for scene, sd in (
        ("gps_ins", [6.87, 7.20, 4.83, 0.21, 0.20, 0.14]),
        ("gps_ins_generic", [5.0, 5.0, 7.5, 0.15, 0.15, 0.225]),
    ):
        cfg = composed(f"scenario={scene}")
        model = job.instantiate(cfg.model)
        assert len(model.names) == 18
        assert torch.equal(model.r, torch.tensor(sd, dtype=torch.float64))
        assert torch.equal(job.instantiate(cfg.scenario).receiver.sd, model.r)
        assert cfg.scenario.trajectory == composed("scenario=flight_500s").scenario.trajectory


# against the measured prototype


@pytest.fixture(scope="module")
def fixed() -> Episode:
    return job.instantiate(
        composed("scenario=azimuth_constant_errors", "scenario.imu_rate_hz=20").scenario
    ).draw(NominalNoise(), torch.arange(40), 1)


# root mean square after 60 s of the prototype's 20 runs: tilts E, N and azimuth (arcmin), velocity E, N, U, position E, N, U
TABLE = {
    "15 states": [2.1, 2.6, 8.5, 0.16, 0.15, 0.08, 2.5, 2.6, 2.2],
    "kappa 1": [3.4, 3.5, 10.2, 0.25, 0.23, 0.28, 3.4, 3.4, 5.8],
    "kappa 5": [3.7, 3.7, 9.3, 0.20, 0.20, 0.15, 2.7, 2.8, 2.7],
    "kappa 30": [5.7, 5.6, 12.6, 0.40, 0.41, 0.37, 2.9, 3.0, 3.0],
}


@pytest.mark.slow
@pytest.mark.parametrize("row", TABLE)
def test_the_unscented_filter_gives_the_prototype_s_numbers(fixed: Episode, row: str) -> None:
    words = (
        ["model=sins_gps_azimuth15"]
        if row == "15 states"
        else [f"model.process_noise_factor={row.split()[1]}"]
    )
    model = job.instantiate(composed("scenario=azimuth_constant_errors", *words).model)
    estimate = filter_with_scores(
        GaussianFilter(SigmaPointLinearisation(UnscentedPoints())), model, fixed
    )
    square = (
        estimate.trace["error"][:, 60:].square().mean(1)[:, [0, 1, 2, 3, 4, 5, 7, 6, 8]]
    )  # position E, N, U
    ours = square.mean(0).sqrt()
    error = square.std(0) / (2 * ours * math.sqrt(40))
    unit = torch.tensor([ARCMIN] * 3 + [1.0] * 6, dtype=torch.float64)
    theirs = torch.tensor(TABLE[row], dtype=torch.float64) * unit
    # their 20 runs have sqrt(2) of our standard error, and two digits
    digits = torch.tensor([0.05] * 3 + [0.005] * 3 + [0.05] * 3, dtype=torch.float64) * unit
    assert ((ours - theirs).abs() < 3.5 * math.sqrt(3) * error + digits).all(), (
        ours / unit,
        theirs / unit,
    )


@pytest.mark.slow
def test_the_filter_that_models_the_biases_is_consistent_and_the_others_are_not() -> None:
    runs, level = 24, 1e-4
    flight = job.instantiate(composed("scenario=azimuth").scenario)
    episode = replace(flight, imu_rate_hz=20.0).draw(NominalNoise(), torch.arange(runs), 21)

    def nees(rule: Any, *words: str) -> np.ndarray:
        estimate = filter_with_scores(
            GaussianFilter(rule),
            job.instantiate(composed("scenario=azimuth", *words).model),
            episode,
        )
        assert not estimate.lost.any()
        return estimate.trace["nees"][:, -1].sum(0).numpy()

    low, high = stats.chi2.ppf([level, 1 - level], 3 * runs)
    unscented = SigmaPointLinearisation(UnscentedPoints())
    for rule in (unscented, TaylorLinearisation()):
        honest = nees(rule, "model=sins_gps_azimuth15")
        assert ((honest > low) & (honest < high)).all(), honest / (3 * runs)
    assert (
        nees(unscented, "model.process_noise_factor=1") > 3 * high
    ).all()  # a bias is no white noise
    assert nees(unscented, "model.process_noise_factor=30")[0] < low / 3
    turned = nees(
        unscented,
        "model=sins_gps_azimuth15",
        "model.error_equations._target_=pfbench.model.PrintedErrorEquations",
    )
    assert turned[-1] > 2 * high  # biases turned by the azimuth error
