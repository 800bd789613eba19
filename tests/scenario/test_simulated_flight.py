"""Simulated flights: a run's world is its own, whoever else flies, whatever the cache holds, whatever filters come after."""

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy import stats
from torch import Tensor

from pfbench import job
from pfbench.core import Episode, PhiloxStream
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    run_filter,
)
from pfbench.job.config import compose_tree
from pfbench.job.scoring import ScoreRecorder
from pfbench.model.ins_gnss import InsGnss
from pfbench.nav import (
    AlignmentErrors,
    GnssReceiver,
    ImuErrors,
    ManoeuvreTrajectory,
    accelerate,
    attitude,
    climb,
    cruise,
    earth,
    imu_errors,
    turn,
)
from pfbench.nav.trajectory import TrajectoryData, TrajectoryStart
from pfbench.noise import MeasurementOutage, NoiseRegime, NominalNoise, OutlierNoise, StudentTNoise
from pfbench.scenario.flights import SimulatedFlight

PATH = ManoeuvreTrajectory(
    segments=(accelerate(5.0, 4.0), climb(8.0, 2.0, 2.0), turn(20.0, 6.0), cruise(4.0)),
    start=TrajectoryStart(lat_deg=32.0, lon_deg=118.0, height=200.0, speed=50.0, heading_deg=45.0),
)
FLIGHT = SimulatedFlight(
    trajectory=PATH,
    imu=ImuErrors(0.5, 0.3, 300.0, 0.1, 500.0, 200.0, 200.0, 50.0),
    receiver=GnssReceiver((6.0, 7.0, 5.0), (0.3, 0.2, 0.1)),
    initial_errors=AlignmentErrors((10.0, 10.0, 60.0), (1.0, 1.0, 1.0), (10.0, 10.0, 10.0)),
    imu_rate_hz=50.0,
    filter_interval_s=0.2,
)
SEED = 6
REGIMES: list[NoiseRegime] = [
    NominalNoise(),
    StudentTNoise(4),
    OutlierNoise(0.2, 10.0),
    MeasurementOutage(((4.0, 8.0),)),
]


def world(
    runs: list[int],
    noise: NoiseRegime | None = None,
    seed: int = SEED,
    flight: SimulatedFlight = FLIGHT,
) -> Episode:
    return flight.draw(noise or NominalNoise(), torch.tensor(runs), seed)


def parts(episode: Episode) -> dict[str, Tensor]:
    assert episode.track is not None
    inputs = {f"u.{name}": value for name, value in episode.record.u._asdict().items()}
    return (
        inputs
        | episode.truth
        | {"y": episode.record.y, "time": episode.time, "track": episode.track}
    )


def same(a: Episode, b: Episode, but: tuple[str, ...] = ()) -> list[str]:
    """Names of what is not the same to the last bit."""
    left, right = parts(a), parts(b)
    assert left.keys() == right.keys()
    return [
        name
        for name in left
        if name not in but
        and not torch.equal(left[name].nan_to_num(9e9), right[name].nan_to_num(9e9))
    ]


# whose world it is


def test_the_same_seed_gives_the_same_world() -> None:
    assert same(world([0, 1]), world([0, 1])) == []


def test_another_seed_gives_another() -> None:
    a, b = world([0, 1]), world([0, 1], seed=SEED + 1)
    assert not (a.record.y == b.record.y).any()
    assert not (a.truth["position"] == b.truth["position"]).any()


def test_a_run_cannot_feel_the_batch() -> None:
    """Run 3 alone is run 3 of ten and run 3 of any other company, in any order."""
    ten, alone, company = world(list(range(10))), world([3]), world([7, 3, 100])
    for name, value in parts(ten).items():
        if name in ("time", "track", "u.duration"):
            continue
        # relative to the size of the quantity: products of matrices may be summed in another order in another batch
        size = value.abs().amax(dim=tuple(range(1, value.dim())), keepdim=True)[3]
        assert ((parts(alone)[name][0] - value[3]).abs() <= 1e-12 * size).all(), name
        assert ((parts(company)[name][1] - value[3]).abs() <= 1e-12 * size).all(), name


def test_runs_differ_in_everything_that_is_drawn() -> None:
    episode = world([0, 1])
    for name, value in {**episode.truth, "y": episode.record.y}.items():
        assert not (value[0] == value[1]).any(), name


@pytest.mark.parametrize("noise", REGIMES[1:], ids=lambda regime: type(regime).__name__)
def test_a_regime_changes_what_is_measured_and_nothing_else(noise: NoiseRegime) -> None:
    nominal, other = world([0, 1, 2]), world([0, 1, 2], noise)
    assert same(nominal, other, but=("y",)) == []
    assert not torch.equal(nominal.record.y, other.record.y)


def test_a_filter_leaves_the_world_as_it_was() -> None:
    episode = world([0, 1])
    model = InsGnss(FLIGHT.imu, FLIGHT.receiver, FLIGHT.initial_errors)
    for method in (GaussianFilter(SigmaPointLinearisation(CubaturePoints())), ParticleFilter(50)):
        estimate = run_filter(method, model, episode.record, PhiloxStream(SEED, torch.arange(2)))
        assert not torch.isnan(estimate.mean).any()
        assert same(episode, world([0, 1])) == []


# the cache


def test_a_cached_world_is_the_fresh_one(tmp_path: Path) -> None:
    kept = replace(FLIGHT, cache_dir=str(tmp_path))
    fresh = world([0, 1])
    first = world([0, 1], flight=kept)
    files = sorted(tmp_path.iterdir())
    stamps = [file.stat().st_mtime_ns for file in files]
    second = world([0, 1], flight=kept)
    assert same(fresh, first) == same(fresh, second) == []
    assert [file.suffix for file in files] == [
        ".npz"
    ] * 2  # the path and one world, and no half-written file
    assert sorted(tmp_path.iterdir()) == files
    assert [file.stat().st_mtime_ns for file in files] == stamps


def test_the_cache_holds_no_receiver_noise_and_tells_worlds_apart(tmp_path: Path) -> None:
    kept = replace(FLIGHT, cache_dir=str(tmp_path))
    for noise in REGIMES:
        assert same(world([0, 1], noise, flight=kept), world([0, 1], noise)) == []
    assert len(list(tmp_path.iterdir())) == 2  # all regimes share one path and one flown world
    others = [
        world([0, 2], flight=kept),
        world([0, 1], seed=SEED + 1, flight=kept),
        world([0, 1], flight=replace(kept, imu=replace(kept.imu, gyro_bias_deg_h=0.6))),
        world(
            [0, 1],
            flight=replace(
                kept,
                initial_errors=AlignmentErrors(
                    (10.0, 10.0, 60.0), (1.0, 1.0, 1.0), (10.0, 10.0, 11.0)
                ),
            ),
        ),
    ]
    assert len(list(tmp_path.iterdir())) == 2 + len(others)  # along the same path
    others += [
        world(
            [0, 1],
            flight=replace(kept, trajectory=replace(PATH, segments=(*PATH.segments, cruise(1.0)))),
        ),
        world([0, 1], flight=replace(kept, filter_interval_s=0.4)),
        world([0, 1], flight=replace(kept, imu_rate_hz=100.0)),
    ]
    assert len(list(tmp_path.iterdir())) == 2 + len(others) + 3
    world([0, 1], flight=replace(kept, receiver=GnssReceiver((1.0, 1.0, 1.0))))
    assert len(list(tmp_path.iterdir())) == 2 + len(others) + 3  # a receiver only measures


def test_a_path_that_is_costly_is_flown_once(tmp_path: Path) -> None:
    class Costly:
        """A path that remembers how often it was flown."""

        flown = 0

        def __repr__(self) -> str:
            return "costly"

        def generate(self, rate: float) -> TrajectoryData:
            Costly.flown += 1
            return PATH.generate(rate)

    kept = replace(FLIGHT, cache_dir=str(tmp_path), trajectory=Costly())
    for _ in range(3):
        assert same(world([0, 1], flight=kept), world([0, 1])) == []
    assert Costly.flown == 1
    world([2], StudentTNoise(4), flight=kept)  # other sensors along it
    assert Costly.flown == 2


# the truth


def test_truth_is_what_the_ins_is_wrong_by() -> None:
    """INS minus errors is the flown path, seen again through the track."""
    episode = world([0, 1, 2])
    u, truth = episode.record.u, episode.truth
    flown = PATH.generate(FLIGHT.imu_rate_hz)
    every = round(FLIGHT.imu_rate_hz * FLIGHT.filter_interval_s)
    pos, vel, dcm = (a[every::every] for a in (flown.pos, flown.vel, flown.dcm))
    assert torch.equal(episode.time, flown.time[every::every])
    assert torch.allclose(
        u.pos_end - truth["position"] / earth.metre_scale(pos),
        pos.expand_as(u.pos_end),
        rtol=1e-14,
        atol=0,
    )
    assert torch.allclose(
        u.vel_end - truth["velocity"], vel.expand_as(u.vel_end), rtol=0, atol=1e-11
    )
    turned = attitude.dcm_from_euler(truth["attitude"]) @ u.dcm_end
    assert torch.allclose(turned, dcm.expand_as(turned), rtol=0, atol=1e-11)
    assert episode.track is not None
    plan, height = earth.local_enu(pos, flown.pos[0])[:, :2], pos[:, 2:] - flown.pos[0, 2]
    assert torch.allclose(episode.track, torch.cat([plan, height], -1).expand(3, -1, -1))


def test_sensor_truth_is_the_sum_of_its_parts_and_of_the_stated_size() -> None:
    episode = world(list(range(400)))
    truth, imu = episode.truth, FLIGHT.imu
    assert torch.allclose(
        truth["gyro_bias"], truth["gyro_constant"] + truth["gyro_markov"], rtol=1e-14, atol=0
    )
    assert (truth["gyro_constant"] == truth["gyro_constant"][:, :1]).all()
    n = 1200  # runs times axes
    accelerometer = math.hypot(imu.accelerometer_bias, imu.accelerometer_markov)
    for name, sd in (
        ("gyro_constant", imu.gyro_bias),
        ("gyro_markov", imu.gyro_markov),
        ("accelerometer_bias", accelerometer),
    ):
        for t in (0, -1):
            z = truth[name][:, t].flatten() / sd
            assert abs(z.mean()) < 4.5 / math.sqrt(n)
            assert abs(z.std() - 1) < 4.5 / math.sqrt(2 * n)


def test_sensor_truth_is_that_of_the_sample_that_ends_the_interval() -> None:
    episode, imu, every = (
        world([0, 1]),
        FLIGHT.imu,
        round(FLIGHT.imu_rate_hz * FLIGHT.filter_interval_s),
    )
    draws, n = PhiloxStream(SEED, torch.arange(2)), every * len(episode.time)

    def at_the_ends(kind: str, sigma: float, time: float) -> Tensor:
        return imu_errors.simulate_gauss_markov(
            f"world.imu.{kind}_markov", n, sigma, time, 1 / FLIGHT.imu_rate_hz, draws
        )[:, every - 1 :: every]

    assert torch.equal(
        episode.truth["gyro_markov"], at_the_ends("gyro", imu.gyro_markov, imu.gyro_markov_time_s)
    )
    constant = episode.truth["accelerometer_bias"] - at_the_ends(
        "accelerometer", imu.accelerometer_markov, imu.accelerometer_markov_time_s
    )
    assert torch.allclose(constant, constant[:, :1].expand_as(constant), rtol=1e-12, atol=0)


def test_errors_start_as_stated() -> None:
    runs = list(range(400))
    episode = world(runs)
    z = (
        torch.cat([episode.truth[name][:, 0] for name in ("attitude", "velocity", "position")], -1)
        / FLIGHT.initial_errors.sd
    )
    # after the first 0.2 s: sensors add less than 0.05 of the initial deviations, tilts turn 0.03 m/s of gravity, speed 0.2 m
    assert (z.mean(0).abs() < 4.5 / math.sqrt(len(runs)) + 0.02).all()
    assert ((z.std(0) - 1).abs() < 4.5 / math.sqrt(2 * len(runs)) + 0.02).all()
    correlation = torch.corrcoef(z.T) - torch.eye(9, dtype=torch.float64)
    assert correlation.abs().max() < 4.5 / math.sqrt(len(runs)) + 0.03


# what is measured


def residuals(noise: NoiseRegime, runs: int = 200) -> Tensor:
    """(y - truth) / nominal deviation [R, T, 6]."""
    episode = world(list(range(runs)), noise)
    seen = torch.cat([episode.truth["position"], episode.truth["velocity"]], -1)
    return (episode.record.y - seen) / FLIGHT.receiver.sd


def test_nominal_measurements_are_white_normal_and_of_the_stated_size() -> None:
    z = residuals(NominalNoise())
    n = z[..., 0].numel()
    assert (z.mean((0, 1)).abs() < 4.5 / math.sqrt(n)).all()
    assert ((z.flatten(0, 1).std(0) - 1).abs() < 4.5 / math.sqrt(2 * n)).all()
    assert (
        (z[:, 1:] * z[:, :-1]).mean((0, 1)).abs() < 4.5 / math.sqrt(n)
    ).all()  # from one epoch to the next
    assert (
        (z[1:] * z[:-1]).mean((0, 1)).abs() < 4.5 / math.sqrt(n)
    ).all()  # from one run to the next
    between = torch.corrcoef(z.flatten(0, 1).T) - torch.eye(6, dtype=torch.float64)
    assert between.abs().max() < 4.5 / math.sqrt(n)
    assert ((z**4).mean((0, 1)) - 3).abs().max() < 4.5 * math.sqrt(96 / n)


def test_the_receiver_knows_nothing_of_how_the_ins_starts() -> None:
    runs = 400
    episode = world(list(range(runs)))
    start = torch.cat(
        [episode.truth[name][:, 0] for name in ("attitude", "velocity", "position", "gyro_bias")],
        -1,
    )
    first = residuals(NominalNoise(), runs)[:, 0]
    between = torch.corrcoef(torch.cat([start, first], -1).T)[: start.shape[-1], start.shape[-1] :]
    assert between.abs().max() < 4.5 / math.sqrt(runs)


def test_outliers_come_as_often_and_as_large_as_stated() -> None:
    z = residuals(OutlierNoise(0.2, 10.0))
    n = z[..., 0].numel()
    # the kurtosis of the mixture, 3 (0.8 + 0.2 10^4) / (0.8 + 0.2 10^2)^2 = 13.9, gives the standard error of the variance
    assert ((z**2).mean((0, 1)) / 20.8 - 1).abs().max() < 4.5 * math.sqrt((13.9 - 1) / n)
    assert (z.abs().amax(-1) > 8).double().mean() > 0.1  # all components of an epoch at once


def test_an_outage_is_silence_in_its_window_alone() -> None:
    episode = world([0, 1], MeasurementOutage(((4.0, 8.0),)))
    silent = torch.isnan(episode.record.y).all(-1)
    assert torch.equal(silent, torch.isnan(episode.record.y).any(-1))
    assert torch.equal(silent, ((episode.time >= 4.0) & (episode.time < 8.0)).expand(2, -1))


def test_a_receiver_without_velocity_measures_position_alone() -> None:
    both, position = (
        world([0, 1]),
        world([0, 1], flight=replace(FLIGHT, receiver=GnssReceiver(FLIGHT.receiver.position_sd))),
    )
    assert position.record.y.shape[-1] == 3
    # three components of the same stream
    assert torch.equal(position.record.y, both.record.y[..., :3])


# what cannot be flown


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"filter_interval_s": 0.06}, r"must be an even number of samples, got 0\.06 \(3 samples"),
        (
            {"filter_interval_s": 0.01},
            r"must be an even number of samples, got 0\.01 \(0\.5 samples",
        ),
        ({"imu_rate_hz": 33.3}, r"must be an even number of samples, got 0\.2 .*at 33\.3 Hz"),
    ],
)
def test_intervals_that_are_no_even_number_of_samples_are_refused(
    change: dict[str, float], message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        replace(FLIGHT, **change)  # type: ignore[arg-type]


def test_a_flight_that_is_no_whole_number_of_intervals_is_refused() -> None:
    with pytest.raises(
        ValueError, match=r"scenario\.filter_interval_s must divide the flight of 20 s, got 0\.6"
    ):
        world([0], flight=replace(FLIGHT, filter_interval_s=0.6))


def test_time_and_intervals_agree() -> None:
    episode = world([0])
    assert np.allclose(np.diff(episode.time.numpy()), FLIGHT.filter_interval_s)
    assert torch.allclose(
        episode.record.u.duration, torch.tensor(FLIGHT.filter_interval_s, dtype=torch.float64)
    )
    assert torch.equal(episode.record.u.pos_start[:, 1:], episode.record.u.pos_end[:, :-1])


RUNS = 100
FALSE_ALARM = 1e-2

# Words beside each scene. The IMU is read less often than in the scenes, which is cheap and changes no law.
CONSISTENT: dict[str, tuple[str, ...]] = {
    "flight_300s_closed_loop": ("scenario.imu_rate_hz=10",),
    "gps_ins_markov": ("scenario.imu_rate_hz=10",),
    "azimuth_small": ("scenario.imu_rate_hz=10",),
    "anshun_nl_small": ("scenario.imu_rate_hz=10", "scenario.trajectory.duration_s=100"),
    "passive_1_random": (),
    "passive_3_random": (),
}
TESTS = 2 * 6 * len(CONSISTENT)  # two statistics of at most six groups


class Consistency(NamedTuple):
    """Of one group: mean over runs of the normalised error squared over its degrees of freedom, 1 where all is well.

    Attributes:
        mean: over the run; se: its standard error.
        end: at the end.
        dof: degrees of freedom.
    """

    mean: float
    se: float
    end: float
    dof: int


def measured(scenario: str, *words: str, seed: int = 21) -> dict[str, Consistency]:
    """The scene's own model and the extended Kalman filter, which is the Kalman filter where all is linear."""
    cfg: Any = compose_tree(
        [f"scenario={scenario}", "filter=ekf", "episode_cache_dir=null", *words]
    )
    model, runs = job.instantiate(cfg.model), torch.arange(RUNS)
    with torch.no_grad():
        episode = job.instantiate(cfg.scenario).draw(NominalNoise(), runs, seed)
        watch = ScoreRecorder(model, model.assemble(episode.truth))
        estimate = run_filter(
            job.instantiate(cfg["filter"]), model, episode.record, PhiloxStream(seed, runs), watch
        )
    assert not estimate.lost.any()
    nees: NDArray[np.float64] = estimate.trace["nees"].numpy()
    found = {}
    for (name, parts), group in zip(model.groups.items(), np.moveaxis(nees, -1, 0), strict=True):
        each = group.mean(1) / len(parts)
        end = float(group[:, -1].mean() / len(parts))
        found[name] = Consistency(
            float(each.mean()), float(each.std(ddof=1) / RUNS**0.5), end, len(parts)
        )
    return found


def outside(found: dict[str, Consistency]) -> dict[str, str]:
    """Groups outside their bands."""
    level, told = FALSE_ALARM / TESTS / 2, {}
    for name, group in found.items():
        reach = float(stats.t.isf(level, RUNS - 1))
        low, high = stats.chi2.ppf([level, 1 - level], RUNS * group.dof) / (RUNS * group.dof)
        if abs(group.mean - 1.0) > reach * group.se:
            told[name] = f"{group.mean:.3f} +- {group.se:.3f} over the run"
        if not low < group.end < high:
            told[name] = f"{group.end:.3f} at the end, band {low:.3f} to {high:.3f}"
    return told


@pytest.mark.slow
@pytest.mark.parametrize("scenario", CONSISTENT)
def test_the_filter_is_consistent_over_a_hundred_runs(scenario: str) -> None:
    assert outside(measured(scenario, *CONSISTENT[scenario])) == {}
