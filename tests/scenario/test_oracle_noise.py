"""A filter that is told the noise regime knows the law of every step: closed forms, oracles, the regimes' own errors."""

import json
import math
import re
from collections.abc import Callable
from copy import deepcopy
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import oracles
import pytest
import torch
from command_line import pfbench
from pyro.distributions import MultivariateNormal
from refusals import check_refused
from scipy import stats
from torch.distributions import Independent, Laplace as LaplaceLaw

from pfbench import job
from pfbench.core import MeasurementChannels, PhiloxStream, Record, map_inputs
from pfbench.filter import (
    CubaturePoints,
    FilterResult,
    GaussianFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    run_filter,
)
from pfbench.job.config import compose_tree
from pfbench.model import (
    Benes,
    LinearGaussian,
    Lorenz63,
    Pendulum,
    StateSpaceModel,
    StochasticVolatility,
    UnivariateGrowth,
    linear_walk,
    local_level,
)
from pfbench.noise import (
    BiasStep,
    ErrorReplay,
    GaussMarkovNoise,
    GlintNoise,
    LaplaceNoise,
    MeasurementOutage,
    NoiseRegime,
    NominalNoise,
    NonLineOfSightNoise,
    OutlierNoise,
    StudentTNoise,
    VarianceSurge,
)
from pfbench.results.paper_block import list_named_parts
from pfbench.scenario import ModelSimulation, RecordingRegime
from pfbench.scenario.oracle_noise import OracleNoiseModel

KALMAN = GaussianFilter(TaylorLinearisation())
TIME = torch.arange(1.0, 61.0, dtype=torch.float64)
SURGE = VarianceSurge(((20.0, 30.0), (40.0, 50.0)), (9.5, 8.0), (100.0, 7.5))
THREE = MeasurementChannels(torch.ones(3, dtype=torch.float64), ("range",) * 3, (0, 1, 2))
SD = (2.0, 0.5, 1.0)


def told(
    model: StateSpaceModel,
    regime: NoiseRegime,
    time: torch.Tensor = TIME,
    channels: MeasurementChannels | None = None,
) -> OracleNoiseModel:
    dy = model.observation(
        model.origin.expand(1, 1, -1), model.prepare(Record(TIME.new_zeros(1, 1, 1))).at_step(0).u
    ).event_shape[0]
    return OracleNoiseModel(
        model,
        regime,
        channels or MeasurementChannels.of_one_kind(torch.ones(dy, dtype=torch.float64)),
        time,
    )


def estimate(method: Any, model: StateSpaceModel, record: Record) -> FilterResult:
    with torch.no_grad():
        return run_filter(method, model, record, PhiloxStream(1, torch.arange(record.y.shape[0])))


def step_inputs(model: StateSpaceModel, t: int, steps: int = len(TIME)) -> Any:
    return model.prepare(Record(torch.zeros(1, steps, 1, dtype=torch.float64))).at_step(t).u


def still(sd: tuple[float, ...] = SD) -> LinearGaussian:
    """A state of which each component is measured."""
    d = len(sd)
    return LinearGaussian(np.eye(d), np.eye(d), np.eye(d), list(sd), np.zeros(d), np.ones(d))


# the laws


def mixture(p: float, *parts: Any) -> Callable[[np.ndarray], np.ndarray]:
    return lambda y: np.log((1 - p) * parts[0].pdf(y) + p * parts[1].pdf(y))


def laplace(sd: float) -> Any:
    return stats.laplace(scale=sd / math.sqrt(2))


DENSITIES: list[tuple[NoiseRegime, Callable[[float], Callable[[np.ndarray], np.ndarray]]]] = [
    (StudentTNoise(4), lambda s: stats.t(4, scale=s).logpdf),
    (LaplaceNoise(), lambda s: laplace(s).logpdf),
    (OutlierNoise(0.2, 7.0, joint=False), lambda s: mixture(0.2, stats.norm(scale=s), stats.norm(scale=7 * s))),
    (GlintNoise(0.2, 7.0), lambda s: mixture(0.2, stats.norm(scale=s), laplace(7 * s))),
    (NonLineOfSightNoise(0.3, 4.0), lambda s: mixture(0.3, stats.norm(scale=s), stats.exponnorm(4.0, scale=s))),
    (BiasStep(-3.0, 10.0), lambda s: stats.norm(-3 * s, s).logpdf),
    (BiasStep(-3.0, 10.0, base_regime=StudentTNoise(5)), lambda s: stats.t(5, -3 * s, s).logpdf),
    (VarianceSurge(((10.0, 80.0),), (9.0,), (1.0,), base_regime=StudentTNoise(4)), lambda s: stats.t(4, scale=3 * s).logpdf),
    (VarianceSurge(((10.0, 80.0),), (9.0,), (1.0,), base_regime=NonLineOfSightNoise(0.3, 4.0)),
     lambda s: mixture(0.3, stats.norm(scale=3 * s), stats.exponnorm(4.0, scale=3 * s))),
    (MeasurementOutage(((20.0, 30.0),), base_regime=LaplaceNoise()), lambda s: laplace(s).logpdf),
]  # fmt: skip


@pytest.mark.parametrize(("regime", "density"), DENSITIES, ids=lambda value: type(value).__name__)
def test_a_told_likelihood_is_the_density_of_its_law(regime: NoiseRegime, density: Any) -> None:
    model = told(still(), regime, channels=THREE)
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(4, 50, 3)), 8 * rng.normal(size=(4, 3))
    y[1, 0], y[2] = math.nan, math.nan
    found = model.log_likelihood(torch.tensor(y), torch.tensor(x), step_inputs(model, 14))
    errors = y[:, None] - x
    expected = sum(
        np.where(np.isnan(errors[..., i]), 0.0, density(s)(np.nan_to_num(errors[..., i])))
        for i, s in enumerate(SD)
    )
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_components_that_are_hit_together_share_their_part() -> None:
    for regime, heavy in (
        (OutlierNoise(0.2, 7.0), stats.norm),
        (GlintNoise(0.2, 7.0, joint=True), laplace),
    ):
        model = told(still(), regime)
        y = np.array([[0.4, 3.0, -6.0], [9.0, math.nan, 2.0]])
        found = model.log_likelihood(
            torch.tensor(y), torch.zeros(2, 1, 3).double(), step_inputs(model, 3)
        )
        for row, value in zip(y, found[:, 0].tolist(), strict=True):
            seen = [i for i in range(3) if not math.isnan(row[i])]
            calm = math.prod(stats.norm(scale=SD[i]).pdf(row[i]) for i in seen)
            wild = [
                stats.norm(scale=7 * SD[i]) if heavy is stats.norm else laplace(7 * SD[i])
                for i in range(3)
            ]
            assert value == pytest.approx(
                math.log(0.8 * calm + 0.2 * math.prod(wild[i].pdf(row[i]) for i in seen)), abs=1e-9
            )


TELLABLE: list[NoiseRegime] = [regime for regime, _ in DENSITIES] + [
    NominalNoise(),
    SURGE,
    OutlierNoise(0.2, 7.0),
    GlintNoise(0.2, 7.0, True),
]


@pytest.mark.parametrize("regime", TELLABLE, ids=repr)
def test_what_is_told_is_what_happens(regime: NoiseRegime) -> None:
    """The errors of the world have the told law at each step: its moments, and uniform ranks in its distribution function."""
    runs, one = torch.arange(3000), MeasurementChannels(torch.ones(1).double(), ("range",), (0,))
    errors = regime.draw_errors(PhiloxStream(5, runs), one, TIME)[..., 0].numpy()
    model = told(still((1.0,)), regime, channels=one)
    grid = torch.linspace(-150, 150, 60001, dtype=torch.float64)
    for t in (5, 22, 45):
        u = step_inputs(model, t)
        log_p = model.log_likelihood(torch.zeros(1, 1).double(), -grid.reshape(1, -1, 1), u)[0]
        density = log_p.exp().numpy()
        mass = np.concatenate([[0.0], np.cumsum(0.5 * (density[1:] + density[:-1]) * 0.005)])
        assert mass[-1] == pytest.approx(1.0, abs=2e-4)
        law = model.observation(torch.zeros(1, 1, 1).double(), u)
        mean = np.trapezoid(grid.numpy() * density, dx=0.005)
        variance = np.trapezoid(grid.numpy() ** 2 * density, dx=0.005) - mean**2
        assert float(law.mean) == pytest.approx(mean, abs=1e-3)
        assert float(law.variance) == pytest.approx(
            variance, rel=2e-2 if "StudentT" in repr(regime) else 1e-3
        )  # its far tail
        seen = errors[:, t][~np.isnan(errors[:, t])]
        if len(seen):
            assert stats.kstest(np.interp(seen, grid.numpy(), mass), "uniform").pvalue > 1e-4


# the process


MODELS = [linear_walk(1.0, 0.3, 1.0), Lorenz63(), UnivariateGrowth(), Pendulum(), Benes()]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
def test_the_driving_noise_is_scaled_by_the_root_of_the_factor(model: StateSpaceModel) -> None:
    knows = told(model, SURGE)
    x = torch.randn(
        1, 5, model.chart.size, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    w = torch.randn(
        1, 5, model.noise_dim, dtype=torch.float64, generator=torch.Generator().manual_seed(2)
    )
    for t, factor in ((5, 1.0), (25, 100.0), (45, 7.5)):
        inner, u = step_inputs(model, t), step_inputs(knows, t)
        assert torch.allclose(
            knows.propagate(x, u, w), model.propagate(x, inner, math.sqrt(factor) * w), rtol=1e-12
        )
        gain, law = knows.noise_gain(u), knows.transition(x, u)
        assert (gain is None) == (model.noise_gain(inner) is None)
        if gain is None:
            continue
        quiet = knows.propagate(x, u, torch.zeros_like(w))
        moved = knows.chart.add(quiet, w @ gain.mT)
        assert torch.allclose(moved, knows.propagate(x, u, w))
        if law is not None:
            covariance = gain @ gain.mT
            assert torch.allclose(law.mean, quiet)
            assert torch.allclose(
                law.variance, covariance.diagonal(dim1=-2, dim2=-1).expand_as(law.variance)
            )


class Pushed(LinearGaussian):
    """Driven by a normal that is not standard."""

    @property
    def noise(self) -> Any:
        return Independent(
            torch.distributions.Normal(torch.tensor([2.0]).double(), torch.tensor([3.0]).double()),
            1,
        )


def pushed() -> Pushed:
    return Pushed([[1.0]], [[1.0]], [[1.0]], [0.5], [0.0], [1.0])


def test_noise_that_is_not_standard_swells_about_its_mean() -> None:
    episode = ModelSimulation(pushed(), 60).draw(SURGE, torch.arange(4000), 3)
    step = torch.diff(
        episode.truth["state"][..., 0], dim=1
    )  # into steps 2, 3, ..., of times 2, 3, ...
    for t, sd in ((10, 3.0), (25, 30.0)):
        assert abs(step[:, t - 2].mean() - 2.0) < 4.5 * sd / math.sqrt(4000)
        assert abs(step[:, t - 2].std() / sd - 1.0) < 4.5 / math.sqrt(8000)
    knows = told(pushed(), SURGE)
    found = knows.propagate(
        torch.zeros(1, 1, 1).double(), step_inputs(knows, 25), torch.tensor([[[5.0]]]).double()
    )
    assert float(found) == pytest.approx(2.0 + 10.0 * 3.0)


# a linear model: the Kalman filter with the true Q and R


def oracle(model: LinearGaussian, y: np.ndarray, regime: NoiseRegime) -> oracles.Filtered:
    """Kalman filter whose Q and R change with the step, one step of the textbook filter at a time."""
    f, g, h = model.f.numpy(), model.g.numpy(), model.h.numpy()
    m, p, rows = model.m0.numpy(), model.l0.numpy() @ model.l0.numpy().T, []
    for t, row in enumerate(y, 1):
        k = next((i for i, (a, b) in enumerate(SURGE.windows_s) if a <= t < b), None)
        before = next(
            (i for i, (a, b) in enumerate(SURGE.windows_s) if a <= t - 0.5 < b), None
        )  # the interval that ends at t
        q = g @ g.T * (1.0 if before is None else SURGE.process_variance_factors[before])
        r = np.diag(model.r.numpy() ** 2) * (
            1.0 if k is None else SURGE.measurement_variance_factors[k]
        )
        rows.append(oracles.kalman(f, q, h, r, m, p, row[None]))
        m, p = rows[-1].mean[0], rows[-1].covariance[0]
    return oracles.Filtered(*(np.concatenate(parts) for parts in zip(*rows, strict=True)))


@pytest.fixture(scope="module")
def surging() -> Any:
    model = linear_walk(1.0, 0.3, 1.0)
    episode = ModelSimulation(model, 60).draw(SURGE, torch.arange(500), 4)
    return (
        model,
        episode,
        estimate(KALMAN, told(model, SURGE), episode.record),
        estimate(KALMAN, model, episode.record),
    )


def test_a_told_kalman_filter_is_that_of_the_true_q_and_r(surging: Any) -> None:
    model, episode, knows, _ = surging
    for run in range(3):
        exact = oracle(model, episode.record.y[run].numpy(), SURGE)
        assert np.allclose(knows.mean[run], exact.mean, rtol=1e-9, atol=1e-9)
        assert np.allclose(
            knows.variance[run], np.diagonal(exact.covariance, axis1=1, axis2=2), rtol=1e-9
        )
        assert knows.log_evidence[run] == pytest.approx(exact.log_evidence.sum(), rel=1e-9)


def test_told_is_consistent_and_untold_is_not(surging: Any) -> None:
    _, episode, knows, guesses = surging
    low, high = stats.chi2(500).ppf([1e-5, 1 - 1e-5])
    for part in range(2):
        nees = [
            ((e.mean - episode.truth["state"])[..., part] ** 2 / e.variance[..., part]).sum(0)
            for e in (knows, guesses)
        ]
        assert ((low < nees[0]) & (nees[0] < high)).all()
        assert ((nees[1] < low) | (nees[1] > high)).float().mean() > 0.3
        assert (nees[1][20:29] > high).all()


def test_told_has_the_higher_evidence(surging: Any) -> None:
    _, _, knows, guesses = surging
    gain = knows.log_evidence - guesses.log_evidence  # its mean is a Kullback-Leibler divergence
    assert gain.mean() > 4 * gain.std() / math.sqrt(len(gain))


HEAVY: list[NoiseRegime] = [
    StudentTNoise(4),
    LaplaceNoise(),
    OutlierNoise(0.1, 8.0),
    GlintNoise(0.1, 8.0),
    NonLineOfSightNoise(0.2, 5.0),
]


@pytest.mark.slow
@pytest.mark.parametrize("regime", HEAVY, ids=repr)
def test_a_told_particle_filter_has_the_higher_evidence(regime: NoiseRegime) -> None:
    model, sir = (
        linear_walk(1.0, 0.3, 1.0),
        job.instantiate(composed("filter=sir", "particles=400")["filter"]),
    )
    episode = ModelSimulation(model, 60).draw(regime, torch.arange(60), 4)
    knows, guesses = (
        estimate(sir, told(model, regime), episode.record),
        estimate(sir, model, episode.record),
    )
    gain = knows.log_evidence - guesses.log_evidence
    assert gain.mean() > 4 * gain.std() / math.sqrt(len(gain))


# transparent


CALM: list[NoiseRegime] = [
    NominalNoise(),
    VarianceSurge(((5.0, 9.0),), (1.0,), (1.0,)),
    MeasurementOutage(((5.0, 9.0),)),
]
OBSERVED = [local_level(3.0, 1.0, 0.0, 2.0, observes_initial=True), StochasticVolatility()]


@pytest.mark.parametrize("model", [*MODELS, *OBSERVED], ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("regime", CALM, ids=["nominal", "ones", "outage"])
def test_told_nothing_changes_nothing(model: StateSpaceModel, regime: NoiseRegime) -> None:
    episode = ModelSimulation(model, 12).draw(regime, torch.arange(3), 4)
    knows = told(model, regime, episode.time)
    assert knows.linear == model.linear
    for method in (
        KALMAN,
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
        job.instantiate(composed("filter=apf", "particles=40")["filter"]),
    ):
        a, b = estimate(method, knows, episode.record), estimate(method, model, episode.record)
        for name in ("mean", "variance", "log_evidence"):
            # to rounding: the inner model states its Jacobians, the other is differentiated
            torch.testing.assert_close(getattr(a, name), getattr(b, name), rtol=1e-9, atol=1e-9)


def test_told_is_the_model_inside_in_all_else() -> None:
    model = Pendulum()
    knows = told(model, StudentTNoise(4))
    for name in ("names", "units", "groups", "noise_dim", "observes_initial"):
        assert getattr(knows, name) == getattr(model, name)
    assert knows.chart == model.chart
    assert torch.equal(knows.origin, model.origin)
    assert torch.equal(knows.initial(2).stddev, model.initial(2).stddev)
    assert knows.anchor is model.anchor
    truth = {"angle": torch.full((1, 1, 1), 3.1).double(), "rate": torch.ones(1, 1, 1).double()}
    assert torch.equal(knows.assemble(truth), model.assemble(truth))
    assert (
        knows.error(torch.tensor([-3.1, 0.0]).double(), torch.tensor([3.1, 0.0]).double())[0].abs()
        < 0.1
    )  # wraps
    assert not told(linear_walk(1.0, 0.3, 1.0), StudentTNoise(4)).linear
    assert told(linear_walk(1.0, 0.3, 1.0), SURGE).linear
    assert len(knows.choices) == len(model.choices) + 1
    record = knows.prepare(Record(torch.zeros(1, 60, 1).double()))
    assert knows.prepare(record) is record


def test_inputs_within_inputs_are_taken_apart_and_put_together() -> None:
    class Inner(NamedTuple):
        a: torch.Tensor
        b: torch.Tensor

    class Outer(NamedTuple):
        inner: Inner | tuple[()]
        c: torch.Tensor

    u = Outer(Inner(torch.ones(2, 3), torch.arange(3.0).expand(2, 3)), torch.zeros(2, 3))
    found = Record(torch.zeros(2, 3, 1), u).at_step(2).u
    assert type(found) is Outer
    assert type(found.inner) is Inner
    assert found.inner.b.tolist() == [2.0, 2.0]
    assert map_inputs(lambda a: a + 1.0, Outer((), torch.zeros(1))) == Outer((), torch.ones(1))
    assert map_inputs(lambda a: a, ()) == ()


class Wrapping(LinearGaussian):
    def residual(self, y: torch.Tensor, y_hat: torch.Tensor) -> torch.Tensor:
        return torch.remainder(y - y_hat + math.pi, 2 * math.pi) - math.pi


def test_told_angles_wrap() -> None:
    plain = Wrapping([[1.0]], [[1.0]], [[1.0]], [0.2], [0.0], [1.0])
    for regime in (StudentTNoise(4), OutlierNoise(0.2, 5.0), SURGE):
        model = told(plain, regime)
        y = torch.tensor([[3.1]], dtype=torch.float64)
        x = torch.tensor([[[-3.1], [2 * math.pi - 3.1]]], dtype=torch.float64)
        found = model.log_likelihood(y, x, step_inputs(model, 3))[0]
        assert float(found[0]) == pytest.approx(float(found[1]), abs=1e-9)


def test_deviations_that_depend_on_the_state_pass_through() -> None:
    model, regime = StochasticVolatility(), StudentTNoise(5)
    knows, x, y = (
        told(model, regime),
        torch.tensor([[[-1.0], [2.0]]]).double(),
        torch.tensor([[0.7]]).double(),
    )
    found = knows.log_likelihood(y, x, step_inputs(knows, 2))[0]
    assert found.tolist() == pytest.approx(
        [stats.t(5, scale=math.exp(s / 2)).logpdf(0.7) for s in (-1.0, 2.0)]
    )
    episode = ModelSimulation(model, 12).draw(regime, torch.arange(3), 4)
    for method in (KALMAN, GaussianFilter(SigmaPointLinearisation(CubaturePoints()))):
        assert torch.isfinite(
            estimate(method, told(model, regime, episode.time), episode.record).mean
        ).all()


class Correlated(LinearGaussian):
    def observation(self, x: torch.Tensor, u: Any) -> MultivariateNormal:
        return MultivariateNormal(
            x, scale_tril=torch.tensor([[2.0, 0.0], [1.0, 0.5]]).double().expand(*x.shape[:2], 2, 2)
        )


def test_correlated_measurements_surge_but_have_no_other_law() -> None:
    model = Correlated(np.eye(2), np.eye(2), np.eye(2), [1.0, 1.0], [0.0, 0.0], [1.0, 1.0])
    knows, x, y = (
        told(model, SURGE),
        torch.zeros(1, 1, 2).double(),
        torch.tensor([[1.0, -2.0]]).double(),
    )
    covariance = 9.5 * np.array([[4.0, 2.0], [2.0, 1.25]])
    found = knows.log_likelihood(y, x, step_inputs(knows, 25))
    assert float(found) == pytest.approx(
        stats.multivariate_normal([0, 0], covariance).logpdf([1.0, -2.0])
    )
    check_refused(
        [
            (
                r"without independent normal measurement noise, got true with Correlated",
                lambda: told(model, StudentTNoise(4)).observation(
                    x, step_inputs(told(model, StudentTNoise(4)), 3)
                ),
            )
        ],
        remedy=False,
    )


def test_told_in_single_precision() -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    episode = ModelSimulation(model, 60).draw(SURGE, torch.arange(3), 4)
    for regime in (SURGE, StudentTNoise(4), OutlierNoise(0.1, 5.0), NonLineOfSightNoise()):
        double = estimate(KALMAN, told(model, regime), episode.record)
        single = estimate(KALMAN, told(model, regime).float(), episode.record)
        assert single.mean.dtype == torch.float32
        assert torch.allclose(single.mean.double(), double.mean, atol=1e-3)
        model.double()


# refusals


@pytest.mark.parametrize(
    ("regime", "channels", "words"),
    [
        (
            GaussMarkovNoise(),
            THREE,
            r"oracle_noise must be false for noise=gauss_markov.*Set oracle_noise=false",
        ),
        (ErrorReplay(None), THREE, r"oracle_noise must be false for noise=replay.*"),
        (
            NonLineOfSightNoise(mean_dwell_s=9.0),
            THREE,
            r"oracle_noise must be false for noise=nlos.* because its biases persist",
        ),
        (NonLineOfSightNoise(base_regime=StudentTNoise(4)), THREE, "are not nominal"),
        (NonLineOfSightNoise(base_regime=SURGE), THREE, "are not nominal"),
        (
            NonLineOfSightNoise(),
            MeasurementChannels.of_one_kind(torch.ones(3).double()),
            "several components of one source",
        ),
        (MeasurementOutage(((5.0, 9.0),), base_regime=GaussMarkovNoise()), THREE, "gauss_markov"),
        (
            VarianceSurge(((5.0, 9.0),), (2.0,), (1.0,), base_regime=GaussMarkovNoise()),
            THREE,
            "gauss_markov",
        ),
        (BiasStep(onset_s=5.0, base_regime=GaussMarkovNoise()), THREE, "gauss_markov"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_regimes_without_a_law_of_each_step_refuse_by_name(
    regime: NoiseRegime, channels: MeasurementChannels, words: str
) -> None:
    check_refused(
        [(words, lambda: OracleNoiseModel(still(), regime, channels, TIME))], remedy=False
    )


def test_a_record_of_another_length_and_a_silent_witness_are_refused() -> None:
    check_refused(
        [
            (
                "must have 60 steps, as the oracle noise, got 9",
                lambda: told(linear_walk(1.0, 0.3, 1.0), SURGE).prepare(
                    Record(torch.zeros(1, 9, 1))
                ),
            ),
            (
                "oracle_noise must be false for a scenario without errors",
                lambda: RecordingRegime(NominalNoise()).to_oracle_model(
                    linear_walk(1.0, 0.3, 1.0), TIME
                ),
            ),
        ],
        remedy=False,
    )

    class HeavyTailed(Pendulum):
        def observation(self, x: torch.Tensor, u: Any) -> Any:
            return Independent(LaplaceLaw(torch.sin(x[..., :1]), 0.3), 1)

    model = told(HeavyTailed(), SURGE)
    check_refused(
        [
            (
                "without independent normal measurement noise, got true with HeavyTailed",
                lambda: model.observation(torch.zeros(1, 1, 2).double(), step_inputs(model, 3)),
            )
        ],
        remedy=False,
    )


# the switch


@cache
def composed(*words: str) -> Any:
    """For reading: the same words are composed once."""
    return compose_tree([*words, "episode_cache_dir=null"])


PRESETS = list_named_parts("noise")
CANNOT = {"gauss_markov", "replay", "nlos_persistent", "added_outliers", "added_white"}


def is_in_metres_of_nothing(scenario: str, noise: str) -> bool:
    return noise.startswith("added") and scenario != "flight_500s"


def run_condition(scenario: str, noise: str) -> list[FilterResult]:
    """Run a particle filter without and with oracle noise; conditions without oracle noise are refused by name.

    A regime takes nothing from the scene, and is composed beside it.
    """
    windows = ["noise.windows_s=[[6.0,9.0]]"] if noise.endswith("outage") else []
    windows = ["noise.duration_s=3.0"] if noise == "random_outage" else windows
    short = ["scenario.steps=20"] if scenario != "flight_500s" else []
    cfg = deepcopy(composed(f"scenario={scenario}", "particles=30", "data.root=null", *short))
    regime = composed(f"noise={noise}", "data.root=null", *windows).noise
    if scenario == "flight_500s":
        cfg.scenario.trajectory.segments = cfg.scenario.trajectory.segments[:1]
        cfg.scenario.imu_rate_hz = 20.0
    witness, model = RecordingRegime(job.instantiate(regime)), job.instantiate(cfg.model)
    if noise == "replay":
        check_refused(
            [
                (
                    r"data\.root is not set",
                    lambda: job.instantiate(cfg.scenario).draw(witness, torch.arange(2), 1),
                )
            ],
            remedy=False,
        )
        return []
    if is_in_metres_of_nothing(scenario, noise):
        check_refused(
            [
                (
                    "add metres to positions or ranges",
                    lambda: job.instantiate(cfg.scenario).draw(witness, torch.arange(2), 1),
                )
            ],
            remedy=False,
        )
        return []
    episode = job.instantiate(cfg.scenario).draw(witness, torch.arange(2), 1)
    models = [model]
    if noise in CANNOT or (noise, scenario) == ("nlos", "flight_500s"):
        check_refused(
            [
                (
                    r"oracle_noise must be false for noise=.*Set oracle_noise=false",
                    lambda: witness.to_oracle_model(model, episode.time),
                )
            ],
            remedy=False,
        )
    else:
        models.append(witness.to_oracle_model(model, episode.time))
    for method in (KALMAN, job.instantiate(cfg["filter"])):
        found = [estimate(method, each, episode.record) for each in models]
        for each in found:
            assert torch.isfinite(each.mean).all()
            assert not each.lost.any()
    return found


SCENES = ("linear_walk", "growth", "flight_500s")
# in an order in which each third is one scene of each regime
CONDITIONS = [(SCENES[(k + j) % 3], noise) for k, noise in enumerate(PRESETS) for j in range(3)]


@pytest.mark.parametrize(("scenario", "noise"), CONDITIONS)
def test_every_regime_runs_told_and_untold_or_says_why_not(scenario: str, noise: str) -> None:
    results = run_condition(scenario, noise)
    is_refused = noise in CANNOT or (noise, scenario) == ("nlos", "flight_500s")
    is_nothing = noise == "replay" or is_in_metres_of_nothing(scenario, noise)
    assert len(results) == (0 if is_nothing else 1 if is_refused else 2)
    if len(results) == 2:  # the weights differ unless the regime has the distribution of the model
        is_equal = torch.equal(results[0].mean, results[1].mean)
        assert is_equal == (noise in ("nominal", "outage", "random_outage"))


def test_the_switch_reaches_the_result(tmp_path: Path) -> None:
    words = (
        "run",
        "-m",
        "scenario=linear_walk",
        "noise=paper_step",
        "filter=ekf",
        "runs=4",
        "oracle_noise=false,true",
    )
    said = pfbench(*words, home=tmp_path)
    assert said.code == 0, said.err
    metas, arrays = [], []
    for file in (tmp_path / "results" / "adhoc").glob("*.npz"):
        with np.load(file, allow_pickle=False) as found:
            metas.append(json.loads(str(found["meta"])))
            arrays.append(found["log_evidence"])
    by = {
        meta["oracle_noise"]: (meta, evidence) for meta, evidence in zip(metas, arrays, strict=True)
    }
    assert set(by) == {False, True}
    assert by[True][1].mean() > by[False][1].mean()
    assert any("receives the true noise" in text for text in by[True][0]["modelling_choices"])
    assert not any("receives the true noise" in text for text in by[False][0]["modelling_choices"])
    assert by[True][0]["is_exact"]
    report = pfbench(
        "report",
        "study=adhoc",
        f"reports_dir={tmp_path / 'reports'}",
        "report.figure_formats=[svg]",
        home=tmp_path,
    )
    assert report.code == 0, report.err
    page = (tmp_path / "reports" / "adhoc" / "report.md").read_text()
    assert "EKF [oracle noise = True]" in page
    assert re.search(
        r"receives the true noise.*\(EKF \[oracle noise = True\]\)", page.replace("\\", "")
    )


@pytest.mark.parametrize(
    "words", [("noise=gauss_markov", "oracle_noise=true"), ("oracle_noise=perhaps",)]
)
def test_the_switch_refuses_by_name(tmp_path: Path, words: tuple[str, ...]) -> None:
    said = pfbench(
        "run",
        "scenario=linear_walk",
        "scenario.steps=9",
        "filter=ekf",
        "runs=2",
        *words,
        home=tmp_path,
    )
    assert said.code != 0
    assert (
        "Set oracle_noise=false."
        if "oracle_noise=true" in words
        else "oracle_noise must be true (the filter receives the true noise regime) or false, got 'perhaps'"
    ) in said.err + said.out
