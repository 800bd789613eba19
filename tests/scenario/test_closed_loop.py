"""Closed loop: a corrected INS is the same flight seen from nearer the truth, and a filter that corrects it learns the same."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from refusals import check_refused
from torch import Tensor

from pfbench import job
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, FeedbackRun, MeasurementChannels, Record
from pfbench.filter import (
    GaussianFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    UnscentedPoints,
)
from pfbench.filter.belief import GaussianBelief, ParticleBelief, StepInfo
from pfbench.filter.loop import FilterResult, apply_feedback, run_filter
from pfbench.job.config import compose_tree
from pfbench.job.scoring import ScoreRecorder
from pfbench.model import (
    ExactErrorEquations,
    InsGnss,
    PrintedErrorEquations,
    SinsGpsAzimuth,
    StateSpaceModel,
    TrapezoidDiscretisation,
    linear_walk,
)
from pfbench.nav import (
    ImuErrors,
    ManoeuvreTrajectory,
    TrajectoryStart,
    accelerate,
    attitude,
    cruise,
    earth,
    strapdown,
    turn,
)
from pfbench.nav.aiding import AidingData, AlignmentErrors, FlightSolution, GnssReceiver
from pfbench.noise import MeasurementOutage, NoiseRegime, NominalNoise, VarianceSurge
from pfbench.scenario import RecordingRegime, SimulatedFlight

IMU = ImuErrors(
    gyro_bias_deg_h=1.0,
    gyro_random_walk_deg_sqrt_h=0.1,
    accelerometer_bias_ug=300.0,
    accelerometer_random_walk_ug_sqrt_hz=30.0,
)
RECEIVER = GnssReceiver((10.0, 10.0, 10.0), (1.0, 1.0, 1.0))
SMALL, LARGE = (
    AlignmentErrors(arcmin, (1.0, 1.0, 1.0), (10.0, 10.0, 10.0))
    for arcmin in ((2.0, 2.0, 10.0), (60.0, 60.0, 1200.0))
)
PATH = ManoeuvreTrajectory(
    (accelerate(10.0, 6.0), turn(20.0, 10.0), cruise(4.0)),
    TrajectoryStart(34.0, 108.0, 400.0, speed=20.0),
)
RUNS = torch.arange(3)
GROUPS = {"attitude": (0, 1, 2), "velocity": (3, 4, 5), "position": (6, 7, 8)}
UKF = GaussianFilter(SigmaPointLinearisation(UnscentedPoints()))


def flight(initial: AlignmentErrors, closed: bool, **changes: Any) -> SimulatedFlight:
    return replace(
        SimulatedFlight(PATH, IMU, RECEIVER, initial, imu_rate_hz=20.0, closed_loop=closed),
        **changes,
    )


def pair(
    initial: AlignmentErrors, runs: Tensor = RUNS, noise: NoiseRegime | None = None
) -> tuple[Episode, Episode]:
    """The same worlds, open and closed."""
    worlds = [
        flight(initial, closed).draw(noise or NominalNoise(), runs, 4) for closed in (False, True)
    ]
    return worlds[0], worlds[1]


def underway(episode: Episode) -> FeedbackRun:
    assert episode.record.feedback is not None
    return episode.record.feedback.begin(episode.record, GROUPS)


def filtered(
    method: Any, model: StateSpaceModel, episode: Episode, runs: Tensor = RUNS, **words: Any
) -> FilterResult:
    watch = ScoreRecorder(model, model.assemble(episode.truth).to(model.anchor))
    with torch.no_grad():
        return run_filter(method, model, episode.record, PhiloxStream(1, runs, **words), watch)


def fifteen() -> InsGnss:
    return InsGnss(IMU, RECEIVER, SMALL)


def azimuth(form: Any = PrintedErrorEquations(), biases: bool = False) -> SinsGpsAzimuth:  # noqa: B008
    return SinsGpsAzimuth(
        IMU, RECEIVER, LARGE, form, TrapezoidDiscretisation(), 1.0 if biases else 5.0, biases
    )


# the world


def test_an_ins_that_nobody_corrects_flies_as_in_open_loop() -> None:
    episode = pair(LARGE)[1]
    way, u = underway(episode), episode.record.u
    for t in range(len(episode.time)):
        seen = way.at_step(t)
        for name in ("dcm", "dcm_end", "pos_start", "pos_end", "vel_end", "f"):
            assert torch.allclose(
                getattr(seen.u, name)[:, 0], getattr(u, name)[:, t], rtol=1e-12, atol=1e-10
            ), name
        assert torch.allclose(seen.y[:, 0], episode.record.y[:, t], rtol=0, atol=1e-6)
        told, left = way.correct(torch.zeros(3, 9, dtype=torch.float64))
        assert told.abs().max() < 1e-6
        x = PhiloxStream(1, RUNS).normal("x", 4, 9)
        x[..., :3] *= 0.3
        assert torch.allclose(left(x), x, rtol=0, atol=1e-12)


def true_navigation(closed: SimulatedFlight, t: int) -> tuple[Tensor, Tensor, Tensor]:
    flown, every = (
        closed.trajectory.generate(closed.imu_rate_hz),
        round(closed.imu_rate_hz * closed.filter_interval_s),
    )
    k = every * (t + 1)
    return flown.dcm[k], flown.vel[k], flown.pos[k]


def test_a_true_estimate_makes_the_ins_true() -> None:
    """From then on it flies as an INS that had never been wrong, but for what the first second has lost."""
    none = AlignmentErrors((1e-9,) * 3, (1e-9,) * 3, (1e-9,) * 3)
    worlds = [
        flight(initial, True, imu=ImuErrors()).draw(NominalNoise(), RUNS, 4)
        for initial in (LARGE, none)
    ]
    way, never, model = underway(worlds[0]), worlds[1].record.u, azimuth()
    truth, receiver = model.assemble(worlds[0].truth), worlds[1].record.y
    way.at_step(0)
    told, left = way.correct(truth[:, 0])
    assert torch.allclose(
        told, truth[:, 0], rtol=0, atol=1e-4
    )  # metres of latitude differ by 1e-6 between there and here
    assert left(truth[:, :1]).abs().max() < 1e-9
    for t in range(1, len(worlds[0].time)):
        seen = way.at_step(t)
        assert attitude.attitude_error(never.dcm_end[:, t], seen.u.dcm_end[:, 0]).abs().max() < 1e-6
        assert (seen.u.vel_end[:, 0] - never.vel_end[:, t]).abs().max() < 1e-4
        scale = earth.metre_scale(never.pos_end[:, t])
        assert ((seen.u.pos_end[:, 0] - never.pos_end[:, t]) * scale).abs().max() < 1e-3
        assert torch.allclose(seen.y[:, 0], receiver[:, t], rtol=0, atol=0.01)
        way.correct(torch.zeros(3, 9, dtype=torch.float64))


def test_what_is_told_has_the_error_of_the_corrected_navigation() -> None:
    """Whatever estimates came before: model.error(told, open truth) is the corrected INS minus the truth."""
    closed, episode = flight(LARGE, True), pair(LARGE)[1]
    way, model = underway(episode), azimuth()
    truth = model.assemble(episode.truth)
    for t in range(6):
        seen = way.at_step(t)
        mean = model.p0 * PhiloxStream(7, RUNS, step=t).normal("guess", 1, 9)[:, 0]
        told, _ = way.correct(mean)
        dcm, vel, pos = true_navigation(closed, t)
        corrected = attitude.dcm_from_euler(mean[:, :3]) @ seen.u.dcm_end[:, 0]
        by_hand = [
            attitude.attitude_error(dcm, corrected),
            seen.u.vel_end[:, 0] - mean[:, 3:6] - vel,
            (seen.u.pos_end[:, 0] - pos) * earth.metre_scale(pos) - mean[:, 6:],
        ]
        assert torch.allclose(
            model.error(told, truth[:, t]), torch.cat(by_hand, -1), rtol=0, atol=1e-3
        )


def test_states_move_with_the_world() -> None:
    """C(alpha) C_ins, v_ins - dv and p_ins - dp are the same before and after a correction, for every particle."""
    episode = pair(LARGE)[1]
    way, model = underway(episode), azimuth(biases=True)
    draws = PhiloxStream(5, RUNS)
    x, mean = draws.normal("x", 6, 15) * model.p0, draws.normal("mean", 1, 15)[:, 0] * model.p0
    before = way.at_step(0).u
    _, left = way.correct(mean)
    after, moved = strapdown.InsState(*_corrected(before, mean)), left(x)
    turned = attitude.dcm_from_euler(moved[..., :3]) @ after.dcm.unsqueeze(1)
    assert torch.allclose(
        turned, attitude.dcm_from_euler(x[..., :3]) @ before.dcm_end, rtol=0, atol=1e-12
    )
    assert torch.allclose(
        after.vel.unsqueeze(1) - moved[..., 3:6], before.vel_end - x[..., 3:6], rtol=0, atol=1e-12
    )
    assert torch.allclose(moved[..., 6:9], x[..., 6:9] - mean[:, None, 6:9])
    assert torch.equal(moved[..., 9:], x[..., 9:])
    assert torch.allclose(
        way.at_step(1).u.dcm[:, 0], after.dcm, rtol=0, atol=1e-12
    )  # and it flies on from there


def _corrected(u: strapdown.InsIntervals, mean: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    pos = u.pos_end[:, 0] - mean[:, 6:9] / earth.metre_scale(u.pos_end[:, 0])
    dcm = attitude.dcm_from_euler(mean[:, :3]) @ u.dcm_end[:, 0]
    return dcm, u.vel_end[:, 0] - mean[:, 3:6], pos, torch.zeros(3, 3, dtype=torch.float64)


def test_silence_stays_silence() -> None:
    open_world, closed_world = pair(LARGE, noise=MeasurementOutage(((5.0, 9.0),)))
    way = underway(closed_world)
    for t in range(12):
        assert torch.equal(
            torch.isnan(way.at_step(t).y[:, 0]), torch.isnan(open_world.record.y[:, t])
        )


# beliefs


def test_the_spread_of_a_gaussian_turns_as_its_particles_would() -> None:
    """Against the moments of a cloud of that law, a tenth of a radian wide in one tilt, after a correction of half a radian."""
    model, way = azimuth(), underway(pair(LARGE)[1])
    way.at_step(0)
    mean = torch.tensor(
        [[0.02, -0.01, 0.5, 1.0, 2.0, 3.0, 10.0, 20.0, 30.0]], dtype=torch.float64
    ).expand(3, -1)
    sd = torch.tensor([0.03, 0.003, 0.03, 1.0, 2.0, 1.0, 10.0, 5.0, 10.0], dtype=torch.float64)
    root = torch.tril(0.3 * torch.ones(9, 9, dtype=torch.float64)).fill_diagonal_(1.0) * sd[:, None]
    covariance = (root @ root.T).expand(3, -1, -1)
    belief = GaussianBelief(mean, covariance, torch.zeros(3, dtype=torch.float64))
    info = StepInfo(mean, covariance.diagonal(dim1=-2, dim2=-1), lambda: covariance, {})
    moved, _ = apply_feedback(model, way, belief, info)
    assert isinstance(moved, GaussianBelief)
    x = mean.unsqueeze(1) + PhiloxStream(3, RUNS).normal("cloud", 10_000, 9) @ root.T
    second = underway(pair(LARGE)[1])
    second.at_step(0)
    _, left = second.correct(mean)
    y = left(x)
    sampled = torch.stack([torch.cov(cloud.T) for cloud in y])
    scale = moved.covariance.diagonal(dim1=-2, dim2=-1).sqrt()
    between = scale.unsqueeze(-1) * scale.unsqueeze(-2)
    assert (
        (sampled - moved.covariance) / between
    ).abs().max() < 0.06  # second-order terms, and 4.5 / sqrt(10 000)
    assert ((covariance - moved.covariance) / between).abs().max() > 0.3  # it did turn
    assert moved.mean.abs().max() < 1e-9


def test_a_lost_run_is_no_longer_corrected() -> None:
    model, way = azimuth(), underway(pair(LARGE)[1])
    way.at_step(0)
    mean = torch.full((3, 9), torch.nan, dtype=torch.float64)
    mean[0] = 0.1
    eye = torch.eye(9, dtype=torch.float64).expand(3, -1, -1)
    belief = GaussianBelief(
        mean, eye, torch.tensor([0.0, -torch.inf, -torch.inf], dtype=torch.float64)
    )
    info = StepInfo(mean, torch.ones_like(mean), lambda: eye, {})
    moved, told = apply_feedback(model, way, belief, info)
    assert torch.isnan(told.mean[1:]).all()
    assert torch.isfinite(told.mean[0]).all()
    assert (
        moved.x.isnan().any()
        if isinstance(moved, ParticleBelief)
        else moved.mean[0].abs().max() < 1e-9
    )
    assert torch.isfinite(way.at_step(1).u.vel_end).all()


# filters


@pytest.mark.parametrize(
    ("method", "steps", "apart"),
    [(GaussianFilter(TaylorLinearisation()), 20, 2e-3), (ParticleFilter(300), 9, 0.05)],
)
def test_on_the_linear_model_with_small_errors_both_loops_agree(
    method: Any, steps: int, apart: float
) -> None:
    """The same random numbers make the same particles, told from another INS; until one falls on the other side of a lot."""
    model = fifteen()
    one, other = (filtered(method, model, world) for world in pair(SMALL))
    away = (one.trace["error"] - other.trace["error"]).abs() / one.variance.sqrt()
    assert away[:, :steps].max() < apart
    assert torch.allclose(one.variance[:, :steps], other.variance[:, :steps], rtol=apart)
    assert torch.allclose(one.log_evidence, other.log_evidence, rtol=1e-3)
    assert not torch.equal(one.mean, other.mean)


@pytest.mark.parametrize("biases", [False, True])
def test_from_twenty_degrees_both_loops_learn_the_same(biases: bool) -> None:
    worlds, model = pair(LARGE), azimuth(ExactErrorEquations(), biases)
    apart, closed = (filtered(UKF, model, world) for world in worlds)
    rms = [
        estimate.trace["error"][:, 10:].square().mean((0, 1)).sqrt() for estimate in (apart, closed)
    ]
    assert torch.allclose(rms[0], rms[1], rtol=0.15)
    assert (rms[1][:2] < model.p0[:2] / 2).all()
    assert (rms[1][3:9] < torch.tensor([0.6] * 3 + [6.0] * 3)).all()


def test_a_run_is_its_own_whatever_the_batch() -> None:
    model = azimuth()
    for method in (UKF, ParticleFilter(50)):
        together = filtered(method, model, pair(LARGE)[1])
        alone = filtered(method, model, pair(LARGE, torch.tensor([2]))[1], torch.tensor([2]))
        assert torch.allclose(
            alone.trace["error"][0], together.trace["error"][2], rtol=1e-6, atol=1e-9
        )
        assert torch.allclose(alone.log_evidence[0], together.log_evidence[2], rtol=1e-9)


def test_a_filter_leaves_the_closed_world_as_it_was() -> None:
    episode, model = pair(LARGE)[1], azimuth()
    first = filtered(UKF, model, episode)
    filtered(ParticleFilter(50), model, episode)
    second = filtered(UKF, model, episode)
    assert torch.equal(first.mean, second.mean)
    assert torch.equal(first.log_evidence, second.log_evidence)


def test_the_closed_world_is_the_open_one_but_for_the_loop() -> None:
    apart, closed = pair(LARGE)
    assert torch.equal(apart.record.y, closed.record.y)
    assert all(torch.equal(apart.truth[name], closed.truth[name]) for name in apart.truth)
    assert apart.record.feedback is None
    assert not SimulatedFlight(PATH, IMU, RECEIVER, SMALL).closed_loop  # open unless asked for
    assert apart.notes == ()
    assert "correct the INS in flight" in closed.notes[0]


def test_a_filter_in_single_precision_corrects_an_ins_in_double() -> None:
    episode = pair(LARGE)[1]
    double = filtered(UKF, azimuth(), episode)
    single = filtered(UKF, azimuth().float(), episode, dtype=torch.float32)
    assert single.mean.dtype == torch.float32
    away = (single.trace["error"] - double.trace["error"]).abs() / double.variance.sqrt()
    assert away.max() < 0.05


# told


def test_a_told_filter_of_a_corrected_world_knows_each_step() -> None:
    """Of both loops it makes the same; and at each step it is the filter whose model has this step's noise."""
    swollen = VarianceSurge(((5.0, 9.0),), (4.0,), (9.0,))
    model, method = fifteen(), GaussianFilter(TaylorLinearisation())
    apart, closed = [], []
    for found, switch in ((apart, False), (closed, True)):
        witness = RecordingRegime(swollen)
        world = flight(SMALL, switch).draw(witness, RUNS, 4)
        told = witness.to_oracle_model(model, world.time)
        found += [filtered(method, told, world), filtered(method, model, world), told, world]
    away = (apart[0].trace["error"] - closed[0].trace["error"]).abs() / apart[0].variance.sqrt()
    assert away.max() < 2e-3
    assert torch.allclose(apart[0].log_evidence, closed[0].log_evidence, rtol=1e-3)
    before, within = slice(0, 4), slice(5, 8)
    assert torch.allclose(closed[0].variance[:, before], closed[1].variance[:, before])
    assert (closed[0].variance[:, within, 3:9] > 1.2 * closed[1].variance[:, within, 3:9]).all()
    told, world = closed[2:]
    way = underway(world)
    for t in range(9):
        seen = told.prepare(way.at_step(t)).u
        assert float(seen.root) == (3.0 if 5 <= t + 0.5 < 9 else 1.0)
        assert seen.scale.unique().tolist() == [2.0 if 5 <= t + 1 < 9 else 1.0]


# what cannot be


def test_models_and_filters_that_cannot_close_the_loop_are_refused() -> None:
    episode = pair(LARGE)[1]
    check_refused(
        [
            (
                r"scenario\.closed_loop must be false.*Choose model=ins_gnss",
                lambda: run_filter(
                    UKF, linear_walk(1.0, 0.5, 1.0), episode.record, PhiloxStream(1, RUNS)
                ),
            )
        ],
        remedy=False,
    )
    way, model = underway(episode), azimuth()
    way.at_step(0)
    zero = torch.zeros(3, 2, 9, dtype=torch.float64)
    past = ParticleBelief(zero, zero[..., 0], zero[:, 0, 0], window={"parents": zero.unsqueeze(2)})
    info = StepInfo(zero[:, 0], zero[:, 0] + 1, lambda: zero, {})
    check_refused(
        [
            (
                r"must not store.*scenario\.closed_loop=false",
                lambda: apply_feedback(model, way, past, info),
            )
        ],
        remedy=False,
    )


class Odometer:
    """Not a receiver."""

    channels = MeasurementChannels.of_one_kind(torch.ones(1, dtype=torch.float64))

    def measure(self, flown: FlightSolution, draws: Any, process: Tensor) -> AidingData:
        return AidingData(flown.ins.vel_end[..., :1], flown.ins)


def test_instruments_without_fixes_are_refused() -> None:
    assert (
        flight(LARGE, False, receiver=Odometer()).draw(NominalNoise(), RUNS, 1).record.feedback
        is None
    )
    check_refused(
        [
            (
                r"scenario\.closed_loop must be false.*got true with Odometer",
                lambda: flight(LARGE, True, receiver=Odometer()),
            )
        ],
        remedy=False,
    )


def test_records_carry_the_loop_to_another_device_and_drop_it_at_a_step() -> None:
    record: Record = pair(LARGE)[1].record
    assert record.to(torch.zeros(1, dtype=torch.float32)).feedback is record.feedback
    assert record.at_step(0).feedback is None


# the published flight


@pytest.mark.slow
def test_on_the_published_flight_both_loops_are_equally_accurate() -> None:
    """20 runs, 300 s, from 20 degrees: per group of states within 3 per cent of each other."""
    cfg = compose_tree(
        [
            "episode_cache_dir=null",
            "scenario=azimuth_closed_loop",
            "model.process_noise_factor=5",
            "scenario.imu_rate_hz=20",
        ]
    )
    runs, model, scene = torch.arange(20), job.instantiate(cfg.model), job.instantiate(cfg.scenario)
    rms = []
    for closed in (False, True):
        estimate = filtered(
            UKF, model, replace(scene, closed_loop=closed).draw(NominalNoise(), runs, 1), runs
        )
        assert not estimate.lost.any()
        rms.append(estimate.trace["error"][:, 60:].square().mean((0, 1)).sqrt())
    assert torch.allclose(rms[0], rms[1], rtol=0.03)
    arcmin = torch.pi / 180 / 60
    assert 5 * arcmin < rms[1][2] < 15 * arcmin  # the prototype has 9.4 in both
    assert (rms[1][3:6] < 0.25).all()  # 0.190 and 0.191
    assert (rms[1][6:9] < 3.6).all()  # 3.1 and 3.1
