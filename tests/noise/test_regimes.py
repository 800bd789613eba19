"""Noise regimes: what they promise about the errors of a receiver, and that a change of regime changes nothing else."""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
import torch
from refusals import check_refused
from scipy import stats

from pfbench.core import MeasurementChannels, PhiloxStream
from pfbench.noise import (
    BiasStep,
    ErrorReplay,
    GaussMarkovNoise,
    MeasurementOutage,
    NonLineOfSightNoise,
    RandomOutage,
    VarianceSurge,
)
from pfbench.noise.base import (
    AddedErrors,
    GlintNoise,
    LaplaceNoise,
    NoiseRegime,
    NominalNoise,
    OutlierNoise,
    StudentTNoise,
    check_unit_process,
    draw_added_errors,
    process_variance_factors,
)

SD = torch.tensor([2.0, 0.05, 30.0], dtype=torch.float64)
TIME = torch.arange(0.0, 300.0, dtype=torch.float64)
RUNS = 40
WINDOWS = ((50.0, 150.0), (200.0, 290.0))
SURGE = VarianceSurge(WINDOWS, (9.0, 4.0), (10.0, 100.0))
REGIMES: list[NoiseRegime] = [
    NominalNoise(),
    StudentTNoise(4),
    LaplaceNoise(),
    OutlierNoise(0.05, 10.0),
    OutlierNoise(0.05, 10.0, joint=False),
    GlintNoise(),
    SURGE,
    MeasurementOutage(((100.0, 130.0), (200.0, 201.0))),
    MeasurementOutage(((100.0, 130.0),), base_regime=StudentTNoise(4)),
    GaussMarkovNoise(2.0, 10.0),
    NonLineOfSightNoise(),
    NonLineOfSightNoise(mean_dwell_s=10.0),
    BiasStep(onset_s=150.0),
    RandomOutage(30.0, 2),
]
every_regime = pytest.mark.parametrize("regime", REGIMES, ids=lambda r: type(r).__name__)
# positions of one receiver, ranges of four satellites, and rates of two of them
MIXED = MeasurementChannels(
    torch.ones(9, dtype=torch.float64),
    ("position",) * 3 + ("range",) * 4 + ("rate",) * 2,
    (0, 0, 0, 3, 5, 7, 9, 3, 5),
)


def errors(regime: NoiseRegime, runs: torch.Tensor | None = None) -> torch.Tensor:
    return regime.draw_errors(
        PhiloxStream(2, torch.arange(RUNS) if runs is None else runs),
        MeasurementChannels.of_one_kind(SD),
        TIME,
    )


@every_regime
def test_shape_and_a_run_alone(regime: NoiseRegime) -> None:
    e = errors(regime)
    assert e.shape == (RUNS, len(TIME), len(SD))
    alone = errors(regime, torch.tensor([17]))
    assert torch.equal(torch.nan_to_num(alone[0]), torch.nan_to_num(e[17]))


@every_regime
def test_errors_scale_with_the_nominal_deviation(regime: NoiseRegime) -> None:
    z = errors(regime)
    doubled = regime.draw_errors(
        PhiloxStream(2, torch.arange(RUNS)), MeasurementChannels.of_one_kind(2 * SD), TIME
    )
    assert torch.allclose(doubled, 2 * z, equal_nan=True)


@pytest.mark.parametrize("component", range(3))
def test_nominal_errors_are_white_and_normal(component: int) -> None:
    z = (errors(NominalNoise()) / SD)[..., component].numpy()
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    lag = (z[:, 1:] * z[:, :-1]).mean()
    assert abs(lag) < 4 / math.sqrt(z.size)


@pytest.mark.parametrize("dof", [3, 4, 10])
def test_heavy_tails_are_student(dof: int) -> None:
    z = (errors(StudentTNoise(dof)) / SD).numpy()
    assert stats.kstest(z.ravel(), stats.t(dof).cdf).pvalue > 1e-3
    far = (np.abs(z) > 5).mean()  # the tail itself, which a Kolmogorov-Smirnov test hardly sees
    p = 2 * stats.t(dof).sf(5)
    assert abs(far - p) < 4 * math.sqrt(p * (1 - p) / z.size)


def test_outliers_hit_whole_epochs_with_their_probability() -> None:
    nominal, e = errors(NominalNoise()), errors(OutlierNoise(0.2, 7.0))
    ratio = (e / nominal).numpy()
    assert np.allclose(ratio, ratio[..., :1])  # all components at once
    hit = np.isclose(ratio[..., 0], 7.0)
    assert np.all(
        hit | np.isclose(ratio[..., 0], 1.0)
    )  # otherwise the nominal error, number for number
    assert abs(hit.mean() - 0.2) < 4 * math.sqrt(0.16 / hit.size)


def test_an_outage_is_silent_from_and_not_at_its_end() -> None:
    e = errors(MeasurementOutage(((100.0, 130.0), (200.0, 201.0))))
    silent = torch.isnan(e)
    expected = ((TIME >= 100) & (TIME < 130)) | (TIME == 200)
    assert torch.equal(silent, expected[None, :, None].expand_as(silent))
    assert torch.equal(e[:, ~expected], errors(NominalNoise())[:, ~expected])


def test_laplace_errors_have_the_nominal_variance_and_order() -> None:
    z = (errors(LaplaceNoise()) / SD).numpy()
    assert stats.kstest(z.ravel(), stats.laplace(scale=1 / math.sqrt(2)).cdf).pvalue > 1e-3
    p = math.exp(-math.sqrt(2) * 4)
    assert abs((np.abs(z) > 4).mean() - p) < 4 * math.sqrt(p / z.size)
    nominal = (errors(NominalNoise()) / SD).numpy().ravel()
    assert (np.diff(z.ravel()[np.argsort(nominal)]) >= 0).all()


def test_outliers_of_components_are_independent() -> None:
    ratio = (errors(OutlierNoise(0.2, 7.0, joint=False)) / errors(NominalNoise())).numpy()
    hit = np.isclose(ratio, 7.0)
    assert np.all(hit | np.isclose(ratio, 1.0))
    for p, found in ((0.2, hit), (0.04, hit[..., 0] & hit[..., 1])):
        assert abs(found.mean() - p) < 4 * math.sqrt(p * (1 - p) / found.size)


@pytest.mark.parametrize("together", [True, False])
def test_glint_is_a_normal_with_laplace_spikes(together: bool) -> None:
    z, nominal = (
        (errors(regime) / SD).numpy() for regime in (GlintNoise(0.2, 8.0, together), NominalNoise())
    )
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
    assert torch.equal(z[:, calm], (errors(NominalNoise()) / SD)[:, calm])
    assert SURGE.process_factors(TIME).tolist() == [
        10.0 if a else 100.0 if b else 1.0 for a, b in zip(first, second, strict=True)
    ]


def test_a_surge_may_last_to_the_end_and_its_windows_stretch_with_the_record() -> None:
    step = VarianceSurge(
        ((500.0, 900.0), (900.0, None)), (4.0, 9.0), (1.0, 1.0), reference_duration_s=1400.0
    )
    k = torch.arange(1401)
    expected = torch.where(k < 500, 1.0, torch.where(k < 900, 2.0, 3.0)).double()
    for end in (1400.0, 100.0, 7.0):
        time, draws = end * k.double() / 1400.0, PhiloxStream(2, torch.arange(3))
        ratio = step.draw_errors(
            draws, MeasurementChannels.of_one_kind(SD), time
        ) / NominalNoise().draw_errors(draws, MeasurementChannels.of_one_kind(SD), time)
        exact = (
            torch.ones(1401, dtype=torch.bool) if end == 1400.0 else (k != 500) & (k != 900)
        )  # edges are rounded
        assert torch.allclose(ratio[:, exact], expected[exact, None].expand(3, -1, 3))


def test_surges_multiply() -> None:
    twice = VarianceSurge(((100.0, 200.0),), (4.0,), (3.0,), base_regime=SURGE)
    assert torch.allclose(
        twice.process_factors(TIME)[[60, 120, 170, 220]],
        torch.tensor([10.0, 30.0, 3.0, 100.0]).double(),
    )
    ratio = (errors(twice) / errors(NominalNoise()))[0, [60, 120, 170, 220], 0]
    assert torch.allclose(ratio, torch.tensor([3.0, 6.0, 2.0, 2.0]).double())


def test_the_process_factor_of_a_step_is_the_mean_over_its_interval() -> None:
    time = torch.arange(10.0, 310.0, 10.0, dtype=torch.float64)  # ends of intervals
    factors = process_variance_factors(VarianceSurge(((55.0, 80.0),), (1.0,), (5.0,)), time)
    assert factors[4:9].tolist() == pytest.approx([1.0, 3.0, 5.0, 5.0, 1.0])
    assert torch.equal(
        process_variance_factors(NominalNoise(), time[:1]), torch.ones(1, dtype=torch.float64)
    )
    stretched = VarianceSurge(((150.0, 300.0),), (1.0,), (7.0,), reference_duration_s=300.0)
    assert process_variance_factors(stretched, time).tolist() == pytest.approx(
        [1.0] * 15 + [7.0] * 15
    )
    assert process_variance_factors(VarianceSurge(((0.0, 10.0),), (1.0,), (5.0,)), time)[
        :2
    ].tolist() == pytest.approx([5.0, 1.0])


def test_recorded_sensors_cannot_be_swollen() -> None:
    check_unit_process(StudentTNoise(), TIME)
    check_unit_process(VarianceSurge(WINDOWS, (9.0, 4.0), (1.0, 1.0)), TIME)
    check_refused(
        [
            (
                r"must not change the process noise .*recorded.*process_variance_factors",
                lambda: check_unit_process(SURGE, TIME),
            )
        ],
        remedy=False,
    )


def test_an_outage_may_spare_sources() -> None:
    regime = MeasurementOutage(((100.0, 130.0),), visible_sources=3, base_regime=StudentTNoise(4))
    e = regime.draw_errors(PhiloxStream(2, torch.arange(3)), MIXED, TIME)
    silent = torch.isnan(e)
    deaf = torch.tensor(
        [source in (7, 9) for source in MIXED.source]
    )  # the sources are 0, 3, 5, 7, 9
    assert torch.equal(silent, (((TIME >= 100) & (TIME < 130))[:, None] & deaf).expand_as(silent))
    assert torch.equal(
        e[~silent],
        StudentTNoise(4).draw_errors(PhiloxStream(2, torch.arange(3)), MIXED, TIME)[~silent],
    )


def test_a_gauss_markov_process_is_stationary_and_forgets_exponentially() -> None:
    time = torch.cumsum(torch.tensor([1.0, 2.0, 1.0, 4.0] * 25, dtype=torch.float64), 0)  # uneven
    runs, part = torch.arange(2000), MeasurementChannels.of_one_kind(SD[:1])
    regime, draws = GaussMarkovNoise(2.0, 5.0), PhiloxStream(3, runs)
    x = (
        (regime.draw_errors(draws, part, time) - NominalNoise().draw_errors(draws, part, time))
        / SD[0]
    )[..., 0]
    for t in (0, 1, 50, 99):
        assert within_chi_square(x[:, t], 4.0)
        assert stats.kstest(x[:, t] / 2.0, "norm").pvalue > 1e-4
        for s in (0, 49, 96):
            rho = math.exp(-abs(float(time[t] - time[s])) / 5.0)
            error = 4 * math.sqrt((1 + rho**2) / len(runs))  # of a sample covariance
            assert abs((x[:, t] * x[:, s]).mean() - 4 * rho) < 4.5 * error
    white = (NominalNoise().draw_errors(draws, part, time) / SD[0])[..., 0]
    assert abs((x * white).mean() / 2) < 4.5 / math.sqrt(
        x.numel() / 20
    )  # the white part is another


def bias(
    regime: NonLineOfSightNoise, channels: MeasurementChannels = MIXED, runs: int = RUNS
) -> np.ndarray:
    draws = PhiloxStream(2, torch.arange(runs))
    found = regime.draw_errors(draws, channels, TIME) - NominalNoise().draw_errors(
        draws, channels, TIME
    )
    return torch.where(found.abs() < 1e-12, 0.0, found).numpy()


def test_reflected_ranges_are_too_long() -> None:
    b = bias(NonLineOfSightNoise(0.3, 5.0))
    assert (b >= 0).all()
    assert (b[..., :3] == 0).all()  # ranges alone
    assert (b[..., 7:] == 0).all()
    hit = b[..., 3:7] > 0
    assert abs(hit.mean() - 0.3) < 4 * math.sqrt(0.21 / hit.size)
    assert stats.kstest(b[..., 3:7][hit], stats.expon(scale=5.0).cdf).pvalue > 1e-3
    together = (hit[..., 0] & hit[..., 1]).mean()
    assert abs(together - 0.09) < 4 * math.sqrt(0.09 / (RUNS * 300))


def test_without_ranges_the_positions_of_one_receiver_are_reflected_together() -> None:
    b = bias(
        NonLineOfSightNoise(0.3, 5.0),
        MeasurementChannels(
            torch.ones(6).double(), ("position",) * 3 + ("velocity",) * 3, (0,) * 6
        ),
    )
    hit = b > 0
    assert (hit[..., 3:] == 0).all()
    assert (hit[..., :3] == hit[..., :1]).all()
    assert not np.isclose(b[..., 0][hit[..., 0]], b[..., 1][hit[..., 1]]).any()
    assert (
        bias(NonLineOfSightNoise(1.0, 5.0), MeasurementChannels.of_one_kind(SD)) > 0
    ).all()  # kind `other`


def test_a_lasting_reflection_is_a_markov_chain_with_a_constant_bias() -> None:
    b = bias(NonLineOfSightNoise(0.25, 5.0, mean_dwell_s=8.0), runs=200)[..., 3:7]
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
    step = (errors(BiasStep(-4.0, 150.0, component)) - errors(NominalNoise())) / SD
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
    columns = dict(
        zip(("pn", "pe", "pd", "rx_pn", "rx_pe", "rx_pd"), [*truth, *(truth + error)], strict=True)
    )
    pd.DataFrame({"utc_s": 8057.0 + second, **columns}).to_parquet(folder / "f9k_vs_span.parquet")
    return folder.parent


POSITION = MeasurementChannels(
    torch.tensor([5.0, 5.0, 10.0, 1.0]).double(), ("position",) * 3 + ("velocity",), (0,) * 4
)


@pytest.mark.parametrize("interval", [1.0, 0.5])
def test_a_replay_strings_together_whole_blocks_without_gaps(root: Path, interval: float) -> None:
    time = 7.0 + interval * torch.arange(240, dtype=torch.float64)
    draws = PhiloxStream(2, torch.arange(300))
    e = (
        ErrorReplay(str(root), block_length_s=30.0, absolute_metres=True)
        .draw_errors(draws, POSITION, time)
        .numpy()
    )
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
    velocity = NominalNoise().draw_errors(draws, POSITION, time)[..., 3].numpy()
    assert np.array_equal(e[..., 3], velocity)


def test_a_replay_is_scaled_to_the_scene(root: Path) -> None:
    time = torch.arange(200.0, dtype=torch.float64)
    metres, scaled = (
        ErrorReplay(str(root), block_length_s=50.0, absolute_metres=own).draw_errors(
            PhiloxStream(2, torch.arange(9)), POSITION, time
        )[..., :3]
        for own in (True, False)
    )
    sd = (
        np.array([1.0, 1.0, 0.1])
        * np.array([s for s in range(400) if not (100 <= s < 105 or s == 230)]).std()
    )
    assert np.allclose(scaled / metres, [5.0, 5.0, 10.0] / sd)


def test_a_replay_takes_another_place_for_each_source_and_run(root: Path) -> None:
    time, channels = (
        torch.arange(60.0, dtype=torch.float64),
        MeasurementChannels(torch.ones(2).double(), ("range",) * 2, (4, 7)),
    )
    e = ErrorReplay(str(root), block_length_s=20.0).draw_errors(
        PhiloxStream(2, torch.arange(50)), channels, time
    )
    alone = ErrorReplay(str(root), block_length_s=20.0).draw_errors(
        PhiloxStream(2, torch.tensor([17])), channels, time
    )
    assert torch.equal(alone[0], e[17])
    assert len(torch.unique(e[:, 0])) > 60
    assert abs(np.corrcoef(e[:, 0].T.numpy())[0, 1]) < 4 / math.sqrt(50)


def test_a_replay_that_cannot_be_is_refused(root: Path) -> None:
    time, draws = TIME, PhiloxStream(2, torch.arange(2))
    bad = [
        (ErrorReplay(None), POSITION, r"data\.root is not set.*PFBENCH_DATA"),
        (ErrorReplay(str(root), file="other.parquet"), POSITION, r"other\.parquet does not exist"),
        (
            ErrorReplay(str(root), block_length_s=200.0),
            POSITION,
            r"noise\.block_length_s must .*got 200\.0, which needs 201 s",
        ),
        (
            ErrorReplay(str(root), absolute_metres=True),
            MeasurementChannels.of_one_kind(SD),
            r"noise\.absolute_metres must be false in a scenario without positions",
        ),
    ]
    for regime, channels, words in bad:
        with pytest.raises(ValueError, match=words):
            regime.draw_errors(draws, channels, time)


def test_channels_and_records_that_a_regime_cannot_serve_are_refused() -> None:
    draws, short = PhiloxStream(2, torch.arange(2)), TIME[:100]
    bad: list[tuple[NoiseRegime, MeasurementChannels, str]] = [
        (
            MeasurementOutage(((10.0, 20.0),), visible_sources=5),
            MIXED,
            r"noise\.visible_sources must be less than the 5 sources of the scenario, got 5",
        ),
        (
            MeasurementOutage(((100.0, 130.0),)),
            MIXED,
            r"noise\.windows_s must begin before the end of the record at 99 s, got \[100\.0, 130\.0\]",
        ),
        (
            VarianceSurge(((10.0, 20.0), (500.0, 550.0)), (2.0, 2.0), (1.0, 1.0)),
            MIXED,
            r"begin before .*got \[500\.0, 550\.0\]",
        ),
        (BiasStep(onset_s=700.0), MIXED, "begin before the end of the record"),
        (
            BiasStep(onset_s=50.0, component=9),
            MIXED,
            r"noise\.component must be between 0 and 8, got 9",
        ),
    ]
    for regime, channels, words in bad:
        with pytest.raises(ValueError, match=words):
            regime.draw_errors(draws, channels, short)


BAD: list[tuple[Callable[[], NoiseRegime], str]] = [
    (lambda: StudentTNoise(2), "noise.dof must .*got 2"),
    (lambda: OutlierNoise(probability=1.5), "noise.probability must .*got 1.5"),
    (lambda: OutlierNoise(probability=math.nan), "noise.probability must .*got nan"),
    (lambda: OutlierNoise(sd_factor=0.5), "noise.sd_factor must .*got 0.5"),
    (lambda: MeasurementOutage(((5.0, 5.0),)), "5.0"),
    (lambda: MeasurementOutage(((5.0,),)), "window"),
    (lambda: MeasurementOutage(((None, 5.0),)), "window"),
    (
        lambda: MeasurementOutage(((5.0, None), (8.0, 9.0))),
        "starts before the previous window ends",
    ),
    (
        lambda: MeasurementOutage(((5.0, 9.0), (8.0, 12.0))),
        "starts before the previous window ends",
    ),
    (lambda: MeasurementOutage(visible_sources=-1), "noise.visible_sources must .*got -1"),
    (
        lambda: MeasurementOutage(reference_duration_s=0.0),
        "noise.reference_duration_s must .*got 0.0",
    ),
    (lambda: OutlierNoise(0.1, math.nan, False), "noise.sd_factor must .*got nan"),
    (lambda: GlintNoise(probability=-0.1), "noise.probability must .*got -0.1"),
    (lambda: VarianceSurge(WINDOWS, (1.0,), (1.0, 1.0)), "measurement_variance_factors"),
    (lambda: VarianceSurge(WINDOWS, (1.0, 1.0), (1.0, 0.0)), "process_variance_factors"),
    (lambda: GaussMarkovNoise(sd_ratio=-1.0), "noise.sd_ratio must .*got -1.0"),
    (lambda: GaussMarkovNoise(correlation_time_s=0.0), "noise.correlation_time_s must .*got 0.0"),
    (
        lambda: NonLineOfSightNoise(probability=1.0, mean_dwell_s=5.0),
        "noise.probability must .*got 1.0",
    ),
    (lambda: NonLineOfSightNoise(mean_delay_sd=0.0), "noise.mean_delay_sd must .*got 0.0"),
    (lambda: NonLineOfSightNoise(mean_dwell_s=0.0), "noise.mean_dwell_s must .*got 0.0"),
    (lambda: ErrorReplay("", block_length_s=0.5), "noise.block_length_s must .*got 0.5"),
]


@pytest.mark.parametrize(("build", "word"), BAD)
def test_impossible_regimes_are_refused_by_name(
    build: Callable[[], NoiseRegime], word: str
) -> None:
    check_refused([(word, lambda: build())], remedy=False)


# --------------------------------------------------------------------------------------------------
# Regimes for recorded measurements.


def draw(regime: NoiseRegime, sd: float, channels: MeasurementChannels = MIXED, runs: int = 200) -> torch.Tensor:  # fmt: skip
    channels = replace(channels, sd=sd * torch.ones_like(channels.sd))
    return draw_added_errors(regime, PhiloxStream(2, torch.arange(runs)), channels, TIME)


def test_random_outages_have_their_length_at_uniform_times() -> None:
    silent = torch.isnan(errors(RandomOutage(30.0), torch.arange(2000)))
    assert (silent == silent[..., :1]).all()
    steps = silent[..., 0]
    assert (steps.sum(1) == 30).all()
    start = steps.int().argmax(1).double()
    assert all(steps[k, int(s) : int(s) + 30].all() for k, s in enumerate(start))
    # first steps from 0 s to 269 s: whole seconds after a uniform time
    assert stats.kstest(start.numpy() / 269.0, "uniform").pvalue > 1e-3


def test_added_errors_are_in_metres_of_positions_alone() -> None:
    z = draw(AddedErrors(sd_m=2.0), 0.0)
    assert (z[..., 3:] == 0.0).all()
    assert within_chi_square(z[..., :3], 4.0)
    hits = draw(AddedErrors(probability=0.1, outlier_sd_m=20.0), 0.0)[..., :3]
    hit = hits != 0.0
    assert (hit == hit[..., :1]).all()
    share = hit[..., 0].double().mean().item()
    assert abs(share - 0.1) < 4 * math.sqrt(0.09 / hit[..., 0].numel())
    assert within_chi_square(hits[hit], 400.0)


@pytest.mark.parametrize(("white", "share", "outlier"), [(2.0, 0.3, 5.0), (4.0, 0.6, 3.0)])
def test_white_errors_and_outliers_beside_each_other_are_independent(
    white: float, share: float, outlier: float
) -> None:
    """The variance of both is the sum, 2^2 + 5^2; with shared numbers it would be (2 + 5)^2."""
    hit = draw(AddedErrors(probability=share, outlier_sd_m=outlier), 0.0)[..., :3] != 0.0
    both = draw(AddedErrors(white, share, outlier), 0.0)[..., :3]
    assert within_chi_square(both[hit], white**2 + outlier**2)
    assert within_chi_square(both[~hit], white**2)


def test_added_errors_of_ranges_are_those_of_each_satellite() -> None:
    ranges = MeasurementChannels(torch.ones(4, dtype=torch.float64), ("range",) * 4, (0, 1, 2, 3))
    hit = draw(AddedErrors(probability=0.2, outlier_sd_m=20.0), 0.0, ranges) != 0.0
    both = (hit[..., 0] & hit[..., 1]).double().mean().item()
    assert abs(both - 0.04) < 4 * math.sqrt(0.04 * 0.96 / hit[..., 0].numel())


@pytest.mark.parametrize(
    "regime",
    [OutlierNoise(), StudentTNoise(4), MeasurementOutage(((-50.0, -10.0),)), GaussMarkovNoise()],
    ids=lambda r: type(r).__name__,
)
def test_a_regime_that_changes_nothing_of_a_record_is_refused(regime: NoiseRegime) -> None:
    with pytest.raises(ValueError, match=r"noise must change the measurements, got \w+ with errors of 0.*position_sd=\[1\.5"):  # fmt: skip
        draw(regime, 0.0)
    assert draw(regime, 1.5).shape[-1] == 9


def test_a_record_without_added_errors_stays_as_it_is() -> None:
    assert (draw(NominalNoise(), 0.0) == 0.0).all()
    assert torch.isnan(draw(RandomOutage(30.0), 0.0)).any()


@pytest.mark.parametrize(
    ("make", "said"),
    [
        (lambda: AddedErrors(), "noise must add errors"),
        (lambda: AddedErrors(sd_m=-1.0), "sd_m must be"),
        (lambda: AddedErrors(sd_m=math.nan), "sd_m must be"),
        (lambda: RandomOutage(0.0), "duration_s must be"),
        (lambda: errors(RandomOutage(400.0)), "shorter than the record of 299 s"),
        (lambda: errors(RandomOutage(100.0, 3)), r"count=3 outages .* Give less than 99\.6\d* s"),
        (lambda: errors(AddedErrors(sd_m=1.0)), "positions or ranges"),
    ],
)
def test_wrong_regimes_for_records_are_refused(make: Callable[[], object], said: str) -> None:
    check_refused([(said, lambda: make())], remedy=False)
