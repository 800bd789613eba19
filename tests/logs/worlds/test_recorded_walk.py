"""The walk with raw measurements: exact on a synthetic sky, honest starts, regimes by satellite, the data sheet's figures."""

import math
import re
from dataclasses import dataclass, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import scipy
import torch
from recorded_data import believed, recorded
from refusals import check_refused
from synthetic_log import ORIGIN, drive, tables, write
from torch import Tensor

from pfbench import job
from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.record import Episode, MeasurementChannels, map_inputs, name_inputs
from pfbench.filter import GaussianFilter, TaylorLinearisation, run_filter
from pfbench.job.config import compose_tree
from pfbench.logs.sky.raw_gnss import RawGnss, RawGnssTuning
from pfbench.logs.worlds.raw_gnss import RawGnssReceiver, RecordedWalk
from pfbench.model import RangeErrorModel, StrapdownTight, TightTuning
from pfbench.nav import earth
from pfbench.nav.orbits import WalkerConstellation, azimuth_elevation, receive_signals
from pfbench.nav.ranging import ReceiverClock
from pfbench.noise import MeasurementOutage, NoiseRegime, NominalNoise

BIAS, DRIFT, OTHER = -4.6e5, -60.0, 12.0  # of the clock, and of the other system

MOTION = believed([1.0, 1.0, 1.0], None)
BELIEVED = TightTuning(
    MOTION,
    ReceiverClock(4.0, 0.5, 0.1, 0.05),
    RangeErrorModel(1.0),
    RangeErrorModel(0.1),
    inter_system_sd=2.0,
)


def sky(seconds: float = 20.0) -> pd.DataFrame:
    """Raw measurements of the synthetic drive at 5 Hz: a nominal constellation, the odd satellites being of another system."""
    t = np.arange(round(5 * seconds) + 1) / 5
    there = drive(t)
    origin = torch.tensor(
        [math.radians(ORIGIN[0]), math.radians(ORIGIN[1]), ORIGIN[2]], dtype=torch.float64
    )
    axes = earth.local_axes(origin)
    enu, velocity = (
        torch.from_numpy(np.stack([there[f"{k}e"], there[f"{k}n"], -there[f"{k}d"]], -1))
        for k in "pv"
    )
    receiver, motion = earth.ecef(origin) + enu @ axes, velocity @ axes
    signal = receive_signals(WalkerConstellation(), torch.from_numpy(t), receiver)
    azimuth, elevation = azimuth_elevation(earth.geodetic(receiver), signal.pos)
    line = (signal.pos - receiver[:, None]) / signal.range[..., None]
    rate = (line * (signal.vel - motion[:, None])).sum(-1) + DRIFT
    rows = []
    for s in torch.nonzero(elevation[0] > math.radians(3.0))[:, 0].tolist():
        clock, clock_drift, tropo, iono = 1e4 * (s - 10), 0.01 * s, 2.0 + 0.3 * s, 5.0 + 0.2 * s
        offset = BIAS + DRIFT * t + (OTHER if s % 2 else 0.0)
        rows.append(
            pd.DataFrame(
                {
                    "t": t, "sys": "GE"[s % 2], "svid": s + 1, "pr": signal.range[:, s].numpy() + offset - clock + tropo + iono,
                    "prr": rate[:, s].numpy() - clock_drift, "sd_pr": 0.1 + 0.01 * s, "sd_prr": 0.05, "sclk": clock,
                    "sclkd": clock_drift, "tropo": tropo, "iono": iono,
                    "el": np.degrees(elevation[:, s].numpy()), "az": np.degrees(azimuth[:, s].numpy()),
                    **{f"s{a}": signal.pos[:, s, i].numpy() for i, a in enumerate("xyz")},
                    **{f"sv{a}": signal.vel[:, s, i].numpy() for i, a in enumerate("xyz")},
                }
            )
        )  # fmt: skip
    return pd.concat(rows, ignore_index=True)


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("data")
    write(folder / "walk", {**tables(), "pseudorange": sky()})
    return folder


def walk(root: Path, **changes: object) -> RecordedWalk:
    receiver = RawGnssReceiver(fix_interval_s=1.0, range_sd=2.0, rate_sd=0.1)
    return replace(RecordedWalk(str(root), "walk", BELIEVED, receiver, origin=ORIGIN), **changes)


def numbers(*runs: int) -> Tensor:
    return torch.tensor(runs)


def zeros_for_clocks(episode: Episode) -> dict[str, Tensor]:
    one = episode.truth["position"][..., :1]
    return {
        **episode.truth,
        **{name: 0 * one for name in ("clock_bias", "clock_drift", "inter_system_bias")},
    }


# an exact sky


def test_recorded_ranges_are_what_the_model_expects_at_the_truth(root: Path) -> None:
    """Frames, signs of all corrections, systems, and the clocks' nominal course: no error is left."""
    episode = walk(root, receiver=RawGnssReceiver(mask_deg=5.0)).draw(NominalNoise(), numbers(0), 1)
    model, y = StrapdownTight(BELIEVED), episode.record.y
    truth = model.assemble(zeros_for_clocks(episode))
    satellites = y.shape[-1] // 2
    assert satellites >= 7
    seen = 0
    for t in range(3, y.shape[1], 4):
        expected = model.observation(truth[:, t, None], episode.record.at_step(t).u).mean[:, 0]
        error = (y[:, t] - expected).abs()
        assert not torch.isnan(error).any()
        assert error[:, :satellites].max() < 1e-6
        assert error[:, satellites:].max() < 1e-6
        seen += 1
    assert seen == 20
    assert torch.isnan(y[:, [k for k in range(y.shape[1]) if k % 4 != 3]]).all()
    assert any(
        "-460000 m and -60.00 m/s subtracted, for other systems +12.0 m more" in note
        for note in episode.notes
    )


def test_low_and_missing_satellites_are_not_seen_and_harm_nothing(
    root: Path, tmp_path: Path
) -> None:
    whole = sky()
    name = whole[whole["el"] >= 30.0]["svid"].iloc[0]
    gone = (whole["svid"] == name) & (whole["t"] > 8.0) & (whole["t"] < 12.5)
    write(tmp_path / "walk", {**tables(), "pseudorange": whole[~gone]})
    episode = walk(tmp_path, receiver=RawGnssReceiver(mask_deg=20.0)).draw(
        NominalNoise(), numbers(0), 1
    )
    high = whole[whole["el"] >= 20.0]["svid"].nunique()
    satellites = episode.record.y.shape[-1] // 2
    assert satellites == high < whole["svid"].nunique()
    assert episode.datasheet["elevation"].shape == (80, satellites)
    spelled = ["".join(map(chr, row)) for row in episode.datasheet["satellites"].long().tolist()]
    assert len(set(spelled)) == satellites
    assert all(re.fullmatch(r"[GEW]\d\d", name) for name in spelled)
    assert float(torch.rad2deg(episode.datasheet["elevation"]).nan_to_num(90.0).min()) >= 20.0
    assert all(torch.isfinite(leaf).all() for _, leaf in name_inputs(episode.record.u))
    each = torch.isnan(episode.record.y[0, 3::4])
    assert torch.equal(each.any(-1).nonzero()[:, 0], torch.arange(8, 12))  # 9 s to 12 s
    assert torch.equal(each[:, :satellites], each[:, satellites:])
    model = StrapdownTight(BELIEVED)
    record = episode.record
    short = record._replace(
        y=record.y[:, 28:44], u=map_inputs(lambda leaf: leaf[:, 28:44], record.u)
    )
    estimate = run_filter(
        GaussianFilter(TaylorLinearisation()), model, short, PhiloxStream(1, numbers(0))
    )
    assert torch.isfinite(estimate.mean).all()


def test_the_filter_finds_place_and_clocks_on_an_exact_sky(root: Path) -> None:
    episode = walk(root).draw(NominalNoise(), torch.arange(4), 1)
    model = StrapdownTight(BELIEVED)
    estimate = run_filter(
        GaussianFilter(TaylorLinearisation()),
        model,
        episode.record,
        PhiloxStream(1, torch.arange(4)),
    )
    error = model.error(estimate.mean, model.assemble(zeros_for_clocks(episode)))[:, -1]
    # chi-square of 4 runs of 12 components, four standard errors
    parts = [*range(9), 15, 16, 17]
    nees = (error.square() / estimate.variance[:, -1])[:, parts].mean()
    assert abs(float(nees) - 1) < 4 * math.sqrt(2 / 48)
    assert (error[:, 15].abs() < 3.0).all()


# what differs between runs


def test_added_errors_have_the_size_asked_for(root: Path) -> None:
    quiet = walk(root, receiver=RawGnssReceiver()).draw(NominalNoise(), numbers(0), 1).record.y
    loud = walk(root).draw(NominalNoise(), torch.arange(300), 1).record.y
    error = (loud - quiet)[:, 3::4]
    s = error.shape[-1] // 2
    sd = error.reshape(-1, 2 * s).std(0)
    # 6000 normals each: five standard errors
    assert torch.allclose(
        sd[:s] / 2.0, torch.ones(s, dtype=torch.float64), rtol=5 / math.sqrt(12000)
    )
    assert torch.allclose(
        sd[s:] / 0.1, torch.ones(s, dtype=torch.float64), rtol=5 / math.sqrt(12000)
    )


def test_channels_say_kind_and_satellite() -> None:
    channels = RawGnssReceiver(range_sd=2.0, rate_sd=0.1).channels(3)
    assert channels.kind == ("range",) * 3 + ("rate",) * 3
    assert channels.source == (0, 1, 2, 0, 1, 2)
    assert channels.sd.tolist() == [2.0] * 3 + [0.1] * 3


@dataclass(frozen=True)
class Shaded:
    """Satellite 1 is hidden; the ranges of satellite 2 are 30 m too long."""

    def draw_errors(
        self, draws: RandomStream, channels: MeasurementChannels, time: Tensor
    ) -> Tensor:
        errors = NominalNoise().draw_errors(draws, channels, time)
        errors[..., [source == 1 for source in channels.source]] = torch.nan
        pairs = zip(channels.source, channels.kind, strict=True)
        errors[..., [source == 2 and kind == "range" for source, kind in pairs]] += 30.0
        return errors

    def process_factors(self, time: Tensor) -> Tensor:
        return torch.ones_like(time)


def test_regimes_work_on_each_satellite_and_silence_all(root: Path) -> None:
    plain, shaded = (
        walk(root).draw(noise, numbers(0), 1).record.y[0, 3::4]
        for noise in (NominalNoise(), Shaded())
    )
    s = plain.shape[-1] // 2
    apart = shaded - plain
    assert torch.isnan(apart[:, [1, s + 1]]).all()
    assert torch.allclose(apart[:, 2], torch.tensor(30.0).double())
    assert (apart[:, [0, *range(3, s), s, *range(s + 2, 2 * s)]] == 0).all()
    episode = walk(root).draw(MeasurementOutage(windows_s=[[5.0, 10.0]]), numbers(0), 1)
    seen = episode.time[~torch.isnan(episode.record.y[0]).all(-1)]
    assert seen.tolist() == [1, 2, 3, 4, *range(10, 21)]


def test_a_run_is_the_same_in_any_batch_and_with_any_step(root: Path) -> None:
    whole, alone = (
        walk(root).draw(NominalNoise(), runs, 7).record for runs in (torch.arange(5), numbers(3))
    )
    assert torch.equal(whole.start[3:4], alone.start)
    assert torch.equal(whole.y[3:4].nan_to_num(0.0), alone.y.nan_to_num(0.0))
    assert not torch.equal(whole.y[0].nan_to_num(0.0), whole.y[1].nan_to_num(0.0))
    finer = walk(root, filter_step_s=0.1).draw(NominalNoise(), numbers(3), 7).record
    assert torch.allclose(finer.y[:, 9::10], alone.y[:, 3::4], atol=1e-9)
    assert not torch.equal(walk(root).draw(NominalNoise(), numbers(3), 8).record.start, alone.start)


def test_the_truth_is_a_draw_of_the_initial_law_about_the_start(root: Path) -> None:
    episode = walk(root).draw(NominalNoise(), torch.arange(1500), 1)
    model = StrapdownTight(BELIEVED)
    heading = drive(np.zeros(2))
    half = -0.5 * float(heading["yaw"][0])
    moving = [heading["ve"][0], heading["vn"][0]]
    true = torch.tensor(
        [math.cos(half), 0, 0, math.sin(half), *moving, *[0.0] * 13], dtype=torch.float64
    )
    z = model.chart.subtract(true.expand(1500, -1), episode.record.start) / model.p0
    assert z.mean(0).abs().max() < 5 / math.sqrt(1500)
    assert (z.var(0) - 1).abs().max() < 5 * math.sqrt(2 / 1500)


# the door


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (
            lambda root: RawGnssReceiver(fix_interval_s=0.0),
            r"receiver\.fix_interval_s must be positive, got 0\.0",
        ),
        (
            lambda root: RawGnssReceiver(range_sd=-1.0),
            r"receiver\.range_sd must be at least 0, got -1\.0",
        ),
        (
            lambda root: RawGnssReceiver(rate_sd=-1.0),
            r"receiver\.rate_sd must be at least 0, got -1\.0",
        ),
        (
            lambda root: RawGnssReceiver(mask_deg=91.0),
            r"receiver\.mask_deg must be between -90 and 90, got 91\.0",
        ),
        (
            lambda root: walk(root, filter_step_s=0.0),
            r"scenario\.filter_step_s must be positive, got 0\.0",
        ),
        (
            lambda root: replace(walk(root), root=None).draw(NominalNoise(), numbers(0), 1),
            r"data\.root is not set.*PFBENCH_DATA",
        ),
        (
            lambda root: walk(root, origin=None).draw(NominalNoise(), numbers(0), 1),
            r"Set scenario\.origin=\[lat_deg",
        ),
        (
            lambda root: walk(root, receiver=RawGnssReceiver(mask_deg=89)).draw(
                NominalNoise(), numbers(0), 1
            ),
            "must contain a row above 89 degrees",
        ),
    ],
)
def test_impossible_settings_name_their_key(root: Path, make: object, message: str) -> None:
    check_refused([(message, lambda: make(root))], remedy=False)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda table: table.drop(columns=["iono"]), "must have a column iono"),
        (lambda table: pd.concat([table, table]), "must have one row for each satellite and epoch"),
        (
            lambda table: table[(table["sys"] == "E") | (table["t"] > 1.0)],
            "must have a GPS satellite, got none at t = 0.000",
        ),
        (lambda table: table.assign(t=table["t"] + 1000.0), "Use the same clock for t"),
    ],
)
def test_faulty_tables_are_refused(tmp_path: Path, spoil: object, message: str) -> None:
    write(tmp_path / "walk", {**tables(), "pseudorange": spoil(sky())})
    check_refused(
        [(message, lambda: walk(tmp_path).draw(NominalNoise(), numbers(0), 1))], remedy=False
    )


# the recorded walk


def configured(noise: NoiseRegime, runs: int, *overrides: str) -> tuple[Episode, StrapdownTight]:
    cfg = compose_tree(["scenario=recorded_walk", *overrides])
    scenario, model = (job.instantiate(cfg[part]) for part in ("scenario", "model"))
    return scenario.draw(noise, torch.arange(runs), 1), model


RAW = ("scenario.receiver.range_sd=0", "scenario.receiver.rate_sd=0")


def single_points(model: StrapdownTight, episode: Episode) -> tuple[Tensor, Tensor]:
    """Position and clocks of each epoch by least squares, weighted with the sine of the elevation; and the rates' residuals."""
    truth, record = model.assemble(zeros_for_clocks(episode)), episode.record
    satellites = record.y.shape[-1] // 2
    found, residuals = [], []
    for t in range(record.y.shape[1]):
        u, seen = record.at_step(t).u, torch.isfinite(record.y[0, t, :satellites])
        weight = torch.sin(episode.datasheet["elevation"][t, seen])[:, None]
        x, chosen = truth[:, t, None].clone(), seen.nonzero()[:, 0]
        x[..., 4:7], x[..., 7:10] = truth[0, t, 4:7], 0.0
        design = (
            torch.cat(
                [-u.line[0], torch.ones(satellites, 1).double(), u.other_system[0, :, None]], -1
            )[chosen]
            * weight
        )
        for _ in range(4):
            gap = (record.y[0, t] - model.observation(x, u).mean[0, 0])[chosen, None] * weight
            x[0, 0, [7, 8, 9, 16, 18]] += torch.linalg.lstsq(design, gap).solution[:, 0]
        found.append(x[0, 0, 7:10])
        rates = (record.y[0, t] - model.observation(x, u).mean[0, 0])[satellites:][seen]
        residuals.append(rates - rates.median())
    return torch.stack(found), torch.cat(residuals)


@recorded
def test_single_points_are_as_good_as_the_data_sheet_says() -> None:
    rate = (
        "scenario.receiver.fix_interval_s=0.25",
        "scenario.receiver.mask_deg=0",
        "scenario.start_s=null",
    )
    episode, model = configured(NominalNoise(), 1, *RAW, *rate)
    found, residuals = single_points(model, episode)
    error = found - episode.truth["position"][0]
    # the sheet, to its last digit: 0.9, 0.8, 3.5 m East, North, Up, about a mean of less than its metre and its 2 to 3 m
    assert torch.allclose(
        error.std(0), torch.tensor([0.9, 0.8, 3.5], dtype=torch.float64), rtol=0, atol=0.05
    )
    assert (error.mean(0).abs() < torch.tensor([1.0, 1.0, 3.0])).all()
    assert (
        1.4826 * float(residuals.abs().median()) < 0.10
    )  # the sheet: 0.07 m/s, about its own solution


@recorded
@pytest.mark.slow
def test_the_filter_is_better_than_single_points() -> None:
    episode, model = configured(NominalNoise(), 3, *RAW)
    estimate = run_filter(
        GaussianFilter(TaylorLinearisation()),
        model,
        episode.record,
        PhiloxStream(1, torch.arange(3)),
    )
    error = model.error(estimate.mean, model.assemble(episode.truth))[:, episode.time > 30.0]
    assert not estimate.lost.any()
    east, north, up = error[..., 6:9].reshape(-1, 3).std(0).tolist()
    assert max(east, north) < 0.5  # single points: 0.9, 0.8, 3.5 m
    assert up < 1.5
    assert float(torch.rad2deg(error[..., 2].square().mean().sqrt())) < 3.0
    assert float(error[..., 3:6].square().mean((0, 1)).sqrt().max()) < 0.12
    nees = (error.square() / estimate.variance[:, episode.time > 30.0])[..., :8].mean((0, 1))
    # one walk of some ten independent stretches; height is left out: the reference's own level is 2 to 3 m off
    assert 0.4 < float(nees.min()) < float(nees.max()) < 2.0


@pytest.mark.parametrize("duration", [0.3, 2.0])
def test_the_noise_of_raw_gnss_is_that_of_its_continuous_model(duration: float) -> None:
    """Van Loan's matrix exponential by scipy, with another density for each axis: q T^3 / 3 of a position, 4 times q T^3 / 12."""
    tuning = RawGnssTuning(
        (0.7, 1.1, 2.0), (1.0,) * 3, (1.0,) * 3, ReceiverClock(bias_walk=0.4, drift_walk=0.2),
        RangeErrorModel(1.0), RangeErrorModel(0.1), inter_system_walk=0.05,
    )  # fmt: skip
    model, a = RawGnss(tuning), np.zeros((9, 9))
    a[[0, 1, 2, 6], [3, 4, 5, 7]] = 1.0
    q = np.diag([0.0, 0.0, 0.0, 0.7, 1.1, 2.0, 0.4, 0.2, 0.05]) ** 2
    block = scipy.linalg.expm(np.block([[-a, q], [np.zeros((9, 9)), a.T]]) * duration)
    inputs = SimpleNamespace(duration=torch.tensor([duration], dtype=torch.float64))
    gain = model.noise_gain(inputs)[0].numpy()  # type: ignore[arg-type]
    np.testing.assert_allclose(gain @ gain.T, block[9:, 9:].T @ block[:9, 9:], atol=1e-12)
    state = torch.arange(1.0, 10.0, dtype=torch.float64).reshape(1, 1, 9)
    still = model.propagate(state, inputs, torch.zeros(1, 1, 9).double())  # type: ignore[arg-type]
    np.testing.assert_allclose(still[0, 0].numpy(), block[9:, 9:].T @ state[0, 0].numpy())
