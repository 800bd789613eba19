"""Noise regimes: what they promise about the errors of a receiver, and that a change of regime changes nothing else."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from scipy import stats

from pfbench.draws import MonteCarlo
from pfbench.noise.correlated import GaussMarkov, NonLineOfSight
from pfbench.noise.regimes import (
    Glint,
    Laplace,
    Nominal,
    Outage,
    Outliers,
    Regime,
    StudentT,
    step_process,
    untouched_process,
)
from pfbench.noise.replay import Replay
from pfbench.noise.surges import BiasStep, Surge
from pfbench.record import Channels

SD = torch.tensor([2.0, 0.05, 30.0], dtype=torch.float64)
TIME = torch.arange(0.0, 300.0, dtype=torch.float64)
RUNS = 40
WINDOWS = ((50.0, 150.0), (200.0, 290.0))
SURGE = Surge(WINDOWS, (9.0, 4.0), (10.0, 100.0))
REGIMES: list[Regime] = [
    Nominal(),
    StudentT(4),
    Laplace(),
    Outliers(0.05, 10.0),
    Outliers(0.05, 10.0, together=False),
    Glint(),
    SURGE,
    Outage(((100.0, 130.0), (200.0, 201.0))),
    Outage(((100.0, 130.0),), of=StudentT(4)),
    GaussMarkov(2.0, 10.0),
    NonLineOfSight(),
    NonLineOfSight(dwell=10.0),
    BiasStep(time=150.0),
]
every_regime = pytest.mark.parametrize("regime", REGIMES, ids=lambda r: type(r).__name__)
# positions of one receiver, ranges of four satellites, and rates of two of them
MIXED = Channels(
    torch.ones(9, dtype=torch.float64), ("position",) * 3 + ("range",) * 4 + ("rate",) * 2, (0, 0, 0, 3, 5, 7, 9, 3, 5)
)


def errors(regime: Regime, runs: torch.Tensor | None = None) -> torch.Tensor:
    return regime.errors(MonteCarlo(2, torch.arange(RUNS) if runs is None else runs), Channels.alike(SD), TIME)


@every_regime
def test_shape_and_a_run_alone(regime: Regime) -> None:
    e = errors(regime)
    assert e.shape == (RUNS, len(TIME), len(SD))
    alone = errors(regime, torch.tensor([17]))
    assert torch.equal(torch.nan_to_num(alone[0]), torch.nan_to_num(e[17]))


@every_regime
def test_errors_scale_with_the_nominal_deviation(regime: Regime) -> None:
    z = errors(regime)
    doubled = regime.errors(MonteCarlo(2, torch.arange(RUNS)), Channels.alike(2 * SD), TIME)
    assert torch.allclose(doubled, 2 * z, equal_nan=True)


@pytest.mark.parametrize("component", range(3))
def test_nominal_errors_are_white_and_normal(component: int) -> None:
    z = (errors(Nominal()) / SD)[..., component].numpy()
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    lag = (z[:, 1:] * z[:, :-1]).mean()
    assert abs(lag) < 4 / math.sqrt(z.size)


@pytest.mark.parametrize("dof", [3, 4, 10])
def test_heavy_tails_are_student(dof: int) -> None:
    z = (errors(StudentT(dof)) / SD).numpy()
    assert stats.kstest(z.ravel(), stats.t(dof).cdf).pvalue > 1e-3
    far = (np.abs(z) > 5).mean()  # the tail itself, which a Kolmogorov-Smirnov test hardly sees
    p = 2 * stats.t(dof).sf(5)
    assert abs(far - p) < 4 * math.sqrt(p * (1 - p) / z.size)


def test_outliers_hit_whole_epochs_with_their_probability() -> None:
    nominal, e = errors(Nominal()), errors(Outliers(0.2, 7.0))
    ratio = (e / nominal).numpy()
    assert np.allclose(ratio, ratio[..., :1])  # all components at once
    hit = np.isclose(ratio[..., 0], 7.0)
    assert np.all(hit | np.isclose(ratio[..., 0], 1.0))  # otherwise the nominal error, number for number
    assert abs(hit.mean() - 0.2) < 4 * math.sqrt(0.16 / hit.size)


def test_an_outage_is_silent_from_and_not_at_its_end() -> None:
    e = errors(Outage(((100.0, 130.0), (200.0, 201.0))))
    silent = torch.isnan(e)
    expected = ((TIME >= 100) & (TIME < 130)) | (TIME == 200)
    assert torch.equal(silent, expected[None, :, None].expand_as(silent))
    assert torch.equal(e[:, ~expected], errors(Nominal())[:, ~expected])


def test_laplace_errors_have_the_nominal_variance_and_order() -> None:
    z = (errors(Laplace()) / SD).numpy()
    assert stats.kstest(z.ravel(), stats.laplace(scale=1 / math.sqrt(2)).cdf).pvalue > 1e-3
    p = math.exp(-math.sqrt(2) * 4)
    assert abs((np.abs(z) > 4).mean() - p) < 4 * math.sqrt(p / z.size)
    nominal = (errors(Nominal()) / SD).numpy().ravel()
    assert (np.diff(z.ravel()[np.argsort(nominal)]) >= 0).all()


def test_outliers_of_components_are_independent() -> None:
    ratio = (errors(Outliers(0.2, 7.0, together=False)) / errors(Nominal())).numpy()
    hit = np.isclose(ratio, 7.0)
    assert np.all(hit | np.isclose(ratio, 1.0))
    for p, found in ((0.2, hit), (0.04, hit[..., 0] & hit[..., 1])):
        assert abs(found.mean() - p) < 4 * math.sqrt(p * (1 - p) / found.size)


@pytest.mark.parametrize("together", [True, False])
def test_glint_is_a_normal_with_laplace_spikes(together: bool) -> None:
    z, nominal = ((errors(regime) / SD).numpy() for regime in (Glint(0.2, 8.0, together), Nominal()))
    hit = z != nominal
    assert (hit == hit[..., :1]).all() == together
    assert abs(hit.mean() - 0.2) < 4 * math.sqrt(0.16 / (hit.size / (3 if together else 1)))
    assert stats.kstest(z[hit], stats.laplace(scale=8 / math.sqrt(2)).cdf).pvalue > 1e-3


def within_chi_square(z: torch.Tensor, variance: float) -> bool:
    """Are these independent centred numbers of this variance, at a risk of 1e-4?"""
    low, high = stats.chi2(z.numel()).ppf([5e-5, 1 - 5e-5])
    return bool(low < z.square().sum().item() / variance < high)


def test_a_surge_multiplies_the_variance_inside_its_windows_alone() -> None:
    z = errors(SURGE) / SD
    first, second = (TIME >= 50) & (TIME < 150), (TIME >= 200) & (TIME < 290)
    assert within_chi_square(z[:, first], 9.0)
    assert within_chi_square(z[:, second], 4.0)
    calm = ~(first | second)
    assert torch.equal(z[:, calm], (errors(Nominal()) / SD)[:, calm])
    assert SURGE.process(TIME).tolist() == [10.0 if a else 100.0 if b else 1.0 for a, b in zip(first, second, strict=True)]


def test_a_surge_may_last_to_the_end_and_its_windows_stretch_with_the_record() -> None:
    step = Surge(((500.0, 900.0), (900.0, None)), (4.0, 9.0), (1.0, 1.0), span=1400.0)
    k = torch.arange(1401)
    expected = torch.where(k < 500, 1.0, torch.where(k < 900, 2.0, 3.0)).double()
    for end in (1400.0, 100.0, 7.0):
        time, draws = end * k.double() / 1400.0, MonteCarlo(2, torch.arange(3))
        ratio = step.errors(draws, Channels.alike(SD), time) / Nominal().errors(draws, Channels.alike(SD), time)
        exact = torch.ones(1401, dtype=torch.bool) if end == 1400.0 else (k != 500) & (k != 900)  # edges are rounded
        assert torch.allclose(ratio[:, exact], expected[exact, None].expand(3, -1, 3))


def test_surges_multiply() -> None:
    twice = Surge(((100.0, 200.0),), (4.0,), (3.0,), of=SURGE)
    assert torch.allclose(twice.process(TIME)[[60, 120, 170, 220]], torch.tensor([10.0, 30.0, 3.0, 100.0]).double())
    ratio = (errors(twice) / errors(Nominal()))[0, [60, 120, 170, 220], 0]
    assert torch.allclose(ratio, torch.tensor([3.0, 6.0, 2.0, 2.0]).double())


def test_the_process_factor_of_a_step_is_the_mean_over_its_interval() -> None:
    time = torch.arange(10.0, 310.0, 10.0, dtype=torch.float64)  # ends of intervals
    factors = step_process(Surge(((55.0, 80.0),), (1.0,), (5.0,)), time)
    assert factors[4:9].tolist() == pytest.approx([1.0, 3.0, 5.0, 5.0, 1.0])
    assert torch.equal(step_process(Nominal(), time[:1]), torch.ones(1, dtype=torch.float64))
    stretched = Surge(((150.0, 300.0),), (1.0,), (7.0,), span=300.0)
    assert step_process(stretched, time).tolist() == pytest.approx([1.0] * 15 + [7.0] * 15)
    assert step_process(Surge(((0.0, 10.0),), (1.0,), (5.0,)), time)[:2].tolist() == pytest.approx([5.0, 1.0])


def test_recorded_sensors_cannot_be_swollen() -> None:
    untouched_process(StudentT(), TIME)
    untouched_process(Surge(WINDOWS, (9.0, 4.0), (1.0, 1.0)), TIME)
    with pytest.raises(ValueError, match=r"recorded, and a regime cannot swell.*q_factors"):
        untouched_process(SURGE, TIME)


def test_an_outage_may_spare_sources() -> None:
    regime = Outage(((100.0, 130.0),), keep=3, of=StudentT(4))
    e = regime.errors(MonteCarlo(2, torch.arange(3)), MIXED, TIME)
    silent = torch.isnan(e)
    deaf = torch.tensor([source in (7, 9) for source in MIXED.source])  # the sources are 0, 3, 5, 7, 9
    assert torch.equal(silent, (((TIME >= 100) & (TIME < 130))[:, None] & deaf).expand_as(silent))
    assert torch.equal(e[~silent], StudentT(4).errors(MonteCarlo(2, torch.arange(3)), MIXED, TIME)[~silent])


def test_a_gauss_markov_process_is_stationary_and_forgets_exponentially() -> None:
    time = torch.cumsum(torch.tensor([1.0, 2.0, 1.0, 4.0] * 25, dtype=torch.float64), 0)  # uneven
    runs, part = torch.arange(2000), Channels.alike(SD[:1])
    regime, draws = GaussMarkov(2.0, 5.0), MonteCarlo(3, runs)
    x = ((regime.errors(draws, part, time) - Nominal().errors(draws, part, time)) / SD[0])[..., 0]
    for t in (0, 1, 50, 99):
        assert within_chi_square(x[:, t], 4.0)
        assert stats.kstest(x[:, t] / 2.0, "norm").pvalue > 1e-4
        for s in (0, 49, 96):
            rho = math.exp(-abs(float(time[t] - time[s])) / 5.0)
            error = 4 * math.sqrt((1 + rho**2) / len(runs))  # of a sample covariance
            assert abs((x[:, t] * x[:, s]).mean() - 4 * rho) < 4.5 * error
    white = (Nominal().errors(draws, part, time) / SD[0])[..., 0]
    assert abs((x * white).mean() / 2) < 4.5 / math.sqrt(x.numel() / 20)  # the white part is another


def bias(regime: NonLineOfSight, channels: Channels = MIXED, runs: int = RUNS) -> np.ndarray:
    draws = MonteCarlo(2, torch.arange(runs))
    found = regime.errors(draws, channels, TIME) - Nominal().errors(draws, channels, TIME)
    return torch.where(found.abs() < 1e-12, 0.0, found).numpy()


def test_reflected_ranges_are_too_long() -> None:
    b = bias(NonLineOfSight(0.3, 5.0))
    assert (b >= 0).all()
    assert (b[..., :3] == 0).all()  # ranges alone
    assert (b[..., 7:] == 0).all()
    hit = b[..., 3:7] > 0
    assert abs(hit.mean() - 0.3) < 4 * math.sqrt(0.21 / hit.size)
    assert stats.kstest(b[..., 3:7][hit], stats.expon(scale=5.0).cdf).pvalue > 1e-3
    together = (hit[..., 0] & hit[..., 1]).mean()
    assert abs(together - 0.09) < 4 * math.sqrt(0.09 / (RUNS * 300))


def test_without_ranges_the_positions_of_one_receiver_are_reflected_together() -> None:
    b = bias(NonLineOfSight(0.3, 5.0), Channels(torch.ones(6).double(), ("position",) * 3 + ("velocity",) * 3, (0,) * 6))
    hit = b > 0
    assert (hit[..., 3:] == 0).all()
    assert (hit[..., :3] == hit[..., :1]).all()
    assert not np.isclose(b[..., 0][hit[..., 0]], b[..., 1][hit[..., 1]]).any()
    assert (bias(NonLineOfSight(1.0, 5.0), Channels.alike(SD)) > 0).all()  # kind `other`


def test_a_lasting_reflection_is_a_markov_chain_with_a_constant_bias() -> None:
    b = bias(NonLineOfSight(0.25, 5.0, dwell=8.0), runs=200)[..., 3:7]
    hidden = b > 0
    stay, enter = 0.25 + 0.75 * math.exp(-1 / 6.0), 0.25 - 0.25 * math.exp(-1 / 6.0)
    for t in (0, 150, 299):  # stationary
        assert abs(hidden[:, t].mean() - 0.25) < 4 * math.sqrt(0.1875 / 800)
    for p, before in ((stay, hidden[:, :-1]), (enter, ~hidden[:, :-1])):
        assert abs(hidden[:, 1:][before].mean() - p) < 4 * math.sqrt(p * (1 - p) / before.sum())
    lasting = hidden[:, 1:] & hidden[:, :-1]
    assert np.allclose(b[:, 1:][lasting], b[:, :-1][lasting])
    entered = hidden[:, 1:] & ~hidden[:, :-1]
    assert stats.kstest(b[:, 1:][entered], stats.expon(scale=5.0).cdf).pvalue > 1e-3


@pytest.mark.parametrize("component", [None, 1])
def test_a_bias_begins_at_its_time(component: int | None) -> None:
    step = (errors(BiasStep(-4.0, 150.0, component)) - errors(Nominal())) / SD
    wrong = torch.ones(3, dtype=torch.bool) if component is None else torch.arange(3) == component
    expected = torch.where((TIME >= 150)[:, None] & wrong, -4.0, 0.0).double()
    assert torch.allclose(step, expected.expand_as(step), atol=1e-9)


# the record of a real receiver


@pytest.fixture(scope="module")
def root(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A record of 400 s with gaps, whose errors tell their second: 1000 + s North, minus East, 0.1 times the second down."""
    folder = tmp_path_factory.mktemp("data") / "rx_error_record"
    folder.mkdir()
    second = np.array([s for s in range(400) if not (100 <= s < 105 or s == 230)], dtype=float)
    truth = np.random.default_rng(1).normal(size=(3, len(second)))
    error = [1000 + second, -second, 0.1 * second]
    columns = dict(zip(("pn", "pe", "pd", "rx_pn", "rx_pe", "rx_pd"), [*truth, *(truth + error)], strict=True))
    pd.DataFrame({"utc_s": 8057.0 + second, **columns}).to_parquet(folder / "f9k_vs_span.parquet")
    return folder.parent


POSITION = Channels(torch.tensor([5.0, 5.0, 10.0, 1.0]).double(), ("position",) * 3 + ("velocity",), (0,) * 4)


@pytest.mark.parametrize("interval", [1.0, 0.5])
def test_a_replay_strings_together_whole_blocks_without_gaps(root: Path, interval: float) -> None:
    time = 7.0 + interval * torch.arange(240, dtype=torch.float64)
    draws = MonteCarlo(2, torch.arange(300))
    e = Replay(str(root), block=30.0, metres=True).errors(draws, POSITION, time).numpy()
    known = np.array([s for s in range(400) if not (100 <= s < 105 or s == 230)])
    second = e[..., 0] + known.mean()  # the mean is off
    assert np.allclose(-e[..., 1] + known.mean(), second)  # all axes of one place of the record
    assert np.allclose(10 * e[..., 2] + known.mean(), second)
    per = int(30 / interval)
    blocks = second.reshape(300, 240 // per, per)
    assert np.allclose(np.diff(blocks, axis=-1), interval)  # contiguous
    starts = np.rint(blocks[..., 0]).astype(int)
    assert np.allclose(starts, blocks[..., 0])
    valid = [s for s in range(370) if set(range(s, s + 31)) <= set(known)]
    assert set(starts.ravel()) <= set(valid)
    counts = np.bincount(starts.ravel(), minlength=400)[valid]
    assert stats.chisquare(counts).pvalue > 1e-4  # anywhere, equally
    velocity = Nominal().errors(draws, POSITION, time)[..., 3].numpy()
    assert np.array_equal(e[..., 3], velocity)


def test_a_replay_is_scaled_to_the_scene(root: Path) -> None:
    time = torch.arange(200.0, dtype=torch.float64)
    metres, scaled = (
        Replay(str(root), block=50.0, metres=own).errors(MonteCarlo(2, torch.arange(9)), POSITION, time)[..., :3]
        for own in (True, False)
    )
    sd = np.array([1.0, 1.0, 0.1]) * np.array([s for s in range(400) if not (100 <= s < 105 or s == 230)]).std()
    assert np.allclose(scaled / metres, [5.0, 5.0, 10.0] / sd)


def test_a_replay_takes_another_place_for_each_source_and_run(root: Path) -> None:
    time, channels = torch.arange(60.0, dtype=torch.float64), Channels(torch.ones(2).double(), ("range",) * 2, (4, 7))
    e = Replay(str(root), block=20.0).errors(MonteCarlo(2, torch.arange(50)), channels, time)
    alone = Replay(str(root), block=20.0).errors(MonteCarlo(2, torch.tensor([17])), channels, time)
    assert torch.equal(alone[0], e[17])
    assert len(torch.unique(e[:, 0])) > 60
    assert abs(np.corrcoef(e[:, 0].T.numpy())[0, 1]) < 4 / math.sqrt(50)


def test_a_replay_that_cannot_be_is_refused(root: Path) -> None:
    time, draws = TIME, MonteCarlo(2, torch.arange(2))
    bad = [
        (Replay(None), POSITION, r"data\.root is not set.*PFBENCH_DATA"),
        (Replay(str(root), file="other.parquet"), POSITION, r"no file .*other\.parquet"),
        (Replay(str(root), block=200.0), POSITION, r"noise\.block=200\.0: no 201 s"),
        (Replay(str(root), metres=True), Channels.alike(SD), r"noise\.metres=true: the scenario measures no positions"),
    ]
    for regime, channels, words in bad:
        with pytest.raises(ValueError, match=words):
            regime.errors(draws, channels, time)


def test_channels_and_records_that_a_regime_cannot_serve_are_refused() -> None:
    draws, short = MonteCarlo(2, torch.arange(2)), TIME[:100]
    bad: list[tuple[Regime, Channels, str]] = [
        (Outage(((10.0, 20.0),), keep=5), MIXED, r"noise\.keep=5: the scenario has 5 sources"),
        (Outage(((100.0, 130.0),)), MIXED, r"noise\.windows: \[100\.0, 130\.0\] begins after the record's end at 99 s"),
        (Surge(((10.0, 20.0), (500.0, 550.0)), (2.0, 2.0), (1.0, 1.0)), MIXED, r"\[500\.0, 550\.0\] begins after"),
        (BiasStep(time=700.0), MIXED, "begins after the record's end"),
        (BiasStep(time=50.0, component=9), MIXED, r"noise\.component=9: the scenario measures 9 components, 0 to 8"),
    ]
    for regime, channels, words in bad:
        with pytest.raises(ValueError, match=words):
            regime.errors(draws, channels, short)


BAD: list[tuple[Callable[[], Regime], str]] = [
    (lambda: StudentT(2), "dof=2"),
    (lambda: Outliers(probability=1.5), "probability=1.5"),
    (lambda: Outliers(probability=math.nan), "probability=nan"),
    (lambda: Outliers(size=0.5), "size=0.5"),
    (lambda: Outage(((5.0, 5.0),)), "5.0"),
    (lambda: Outage(((5.0,),)), "window"),
    (lambda: Outage(((None, 5.0),)), "window"),
    (lambda: Outage(((5.0, None), (8.0, 9.0))), "starts before the one above it ends"),
    (lambda: Outage(((5.0, 9.0), (8.0, 12.0))), "starts before the one above it ends"),
    (lambda: Outage(keep=-1), "keep=-1"),
    (lambda: Outage(span=0.0), "span=0.0"),
    (lambda: Outliers(0.1, math.nan, False), "size=nan"),
    (lambda: Glint(probability=-0.1), "probability=-0.1"),
    (lambda: Surge(WINDOWS, (1.0,), (1.0, 1.0)), "r_factors"),
    (lambda: Surge(WINDOWS, (1.0, 1.0), (1.0, 0.0)), "q_factors"),
    (lambda: GaussMarkov(ratio=-1.0), "ratio=-1.0"),
    (lambda: GaussMarkov(correlation_time=0.0), "correlation_time=0.0"),
    (lambda: NonLineOfSight(probability=1.0, dwell=5.0), "probability=1.0"),
    (lambda: NonLineOfSight(mean=0.0), "mean=0.0"),
    (lambda: NonLineOfSight(dwell=0.0), "dwell=0.0"),
    (lambda: Replay("", block=0.5), "block=0.5"),
]


@pytest.mark.parametrize(("build", "word"), BAD)
def test_impossible_regimes_are_refused_by_name(build: Callable[[], Regime], word: str) -> None:
    with pytest.raises(ValueError, match=word):
        build()
