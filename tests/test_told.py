"""A filter that is told the noise regime knows the law of every step: closed forms, oracles, the regimes' own errors."""

from __future__ import annotations

import json
import math
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
from hydra import compose, initialize_config_dir
from pyro.distributions import MultivariateNormal
from scipy import stats
from torch.distributions import Independent
from torch.distributions import Laplace as LaplaceLaw

from pfbench import cli, job
from pfbench.draws import MonteCarlo
from pfbench.filter.gaussian import GaussianFilter
from pfbench.filter.loop import Estimate, run_filter
from pfbench.filter.rules import Cubature, Jacobian, Points
from pfbench.model.base import StateSpaceModel
from pfbench.model.linear import LinearGaussian, linear_walk, local_level
from pfbench.model.toys import Benes, Growth, Lorenz63, Pendulum, StochasticVolatility
from pfbench.noise.correlated import GaussMarkov, NonLineOfSight
from pfbench.noise.regimes import Glint, Laplace, Nominal, Outage, Outliers, Regime, StudentT
from pfbench.noise.replay import Replay
from pfbench.noise.surges import BiasStep, Surge
from pfbench.record import Channels, Record, map_inputs
from pfbench.scenario.model_world import ModelWorld
from pfbench.scenario.told import Told, Witness

CONF = cli.conf_dir()
KALMAN = GaussianFilter(Jacobian())
TIME = torch.arange(1.0, 61.0, dtype=torch.float64)
SURGE = Surge(((20.0, 30.0), (40.0, 50.0)), (9.5, 8.0), (100.0, 7.5))
THREE = Channels(torch.ones(3, dtype=torch.float64), ("range",) * 3, (0, 1, 2))
SD = (2.0, 0.5, 1.0)


def told(model: StateSpaceModel, regime: Regime, time: torch.Tensor = TIME, channels: Channels | None = None) -> Told:
    dy = model.observation(model.origin.expand(1, 1, -1), model.prepare(Record(TIME.new_zeros(1, 1, 1))).at(0).u).event_shape[0]
    return Told(model, regime, channels or Channels.alike(torch.ones(dy, dtype=torch.float64)), time)


def estimate(method: Any, model: StateSpaceModel, record: Record) -> Estimate:
    with torch.no_grad():
        return run_filter(method, model, record, MonteCarlo(1, torch.arange(record.y.shape[0])))


def step_inputs(model: StateSpaceModel, t: int, steps: int = len(TIME)) -> Any:
    return model.prepare(Record(torch.zeros(1, steps, 1, dtype=torch.float64))).at(t).u


def still(sd: tuple[float, ...] = SD) -> LinearGaussian:
    """A state of which each component is measured."""
    d = len(sd)
    return LinearGaussian(np.eye(d), np.eye(d), np.eye(d), list(sd), np.zeros(d), np.ones(d))


# the laws


def mixture(p: float, *parts: Any) -> Callable[[np.ndarray], np.ndarray]:
    return lambda y: np.log((1 - p) * parts[0].pdf(y) + p * parts[1].pdf(y))


def laplace(sd: float) -> Any:
    return stats.laplace(scale=sd / math.sqrt(2))


DENSITIES: list[tuple[Regime, Callable[[float], Callable[[np.ndarray], np.ndarray]]]] = [
    (StudentT(4), lambda s: stats.t(4, scale=s).logpdf),
    (Laplace(), lambda s: laplace(s).logpdf),
    (Outliers(0.2, 7.0, together=False), lambda s: mixture(0.2, stats.norm(scale=s), stats.norm(scale=7 * s))),
    (Glint(0.2, 7.0), lambda s: mixture(0.2, stats.norm(scale=s), laplace(7 * s))),
    (NonLineOfSight(0.3, 4.0), lambda s: mixture(0.3, stats.norm(scale=s), stats.exponnorm(4.0, scale=s))),
    (BiasStep(-3.0, 10.0), lambda s: stats.norm(-3 * s, s).logpdf),
    (BiasStep(-3.0, 10.0, of=StudentT(5)), lambda s: stats.t(5, -3 * s, s).logpdf),
    (Surge(((10.0, 80.0),), (9.0,), (1.0,), of=StudentT(4)), lambda s: stats.t(4, scale=3 * s).logpdf),
    (Surge(((10.0, 80.0),), (9.0,), (1.0,), of=NonLineOfSight(0.3, 4.0)),
     lambda s: mixture(0.3, stats.norm(scale=3 * s), stats.exponnorm(4.0, scale=3 * s))),
    (Outage(((20.0, 30.0),), of=Laplace()), lambda s: laplace(s).logpdf),
]  # fmt: skip


@pytest.mark.parametrize(("regime", "density"), DENSITIES, ids=lambda value: type(value).__name__)
def test_a_told_likelihood_is_the_density_of_its_law(regime: Regime, density: Any) -> None:
    model = told(still(), regime, channels=THREE)
    rng = np.random.default_rng(3)
    x, y = rng.normal(size=(4, 50, 3)), 8 * rng.normal(size=(4, 3))
    y[1, 0], y[2] = math.nan, math.nan
    found = model.log_likelihood(torch.tensor(y), torch.tensor(x), step_inputs(model, 14))
    errors = y[:, None] - x
    expected = sum(np.where(np.isnan(errors[..., i]), 0.0, density(s)(np.nan_to_num(errors[..., i]))) for i, s in enumerate(SD))
    assert np.allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_components_that_are_hit_together_share_their_part() -> None:
    for regime, heavy in ((Outliers(0.2, 7.0), stats.norm), (Glint(0.2, 7.0, together=True), laplace)):
        model = told(still(), regime)
        y = np.array([[0.4, 3.0, -6.0], [9.0, math.nan, 2.0]])
        found = model.log_likelihood(torch.tensor(y), torch.zeros(2, 1, 3).double(), step_inputs(model, 3))
        for row, value in zip(y, found[:, 0].tolist(), strict=True):
            seen = [i for i in range(3) if not math.isnan(row[i])]
            calm = math.prod(stats.norm(scale=SD[i]).pdf(row[i]) for i in seen)
            wild = [stats.norm(scale=7 * SD[i]) if heavy is stats.norm else laplace(7 * SD[i]) for i in range(3)]
            assert value == pytest.approx(math.log(0.8 * calm + 0.2 * math.prod(wild[i].pdf(row[i]) for i in seen)), abs=1e-9)


TELLABLE: list[Regime] = [regime for regime, _ in DENSITIES] + [Nominal(), SURGE, Outliers(0.2, 7.0), Glint(0.2, 7.0, True)]


@pytest.mark.parametrize("regime", TELLABLE, ids=repr)
def test_what_is_told_is_what_happens(regime: Regime) -> None:
    """The errors of the world have the told law at each step: its moments, and uniform ranks in its distribution function."""
    runs, one = torch.arange(3000), Channels(torch.ones(1).double(), ("range",), (0,))
    errors = regime.errors(MonteCarlo(5, runs), one, TIME)[..., 0].numpy()
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
        assert float(law.variance) == pytest.approx(variance, rel=2e-2 if "StudentT" in repr(regime) else 1e-3)  # its far tail
        seen = errors[:, t][~np.isnan(errors[:, t])]
        if len(seen):
            assert stats.kstest(np.interp(seen, grid.numpy(), mass), "uniform").pvalue > 1e-4


# the process


MODELS = [linear_walk(1.0, 0.3, 1.0), Lorenz63(), Growth(), Pendulum(), Benes()]


@pytest.mark.parametrize("model", MODELS, ids=lambda m: type(m).__name__)
def test_the_driving_noise_is_scaled_by_the_root_of_the_factor(model: StateSpaceModel) -> None:
    knows = told(model, SURGE)
    x = torch.randn(1, 5, model.chart.size, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    w = torch.randn(1, 5, model.noise_dim, dtype=torch.float64, generator=torch.Generator().manual_seed(2))
    for t, factor in ((5, 1.0), (25, 100.0), (45, 7.5)):
        inner, u = step_inputs(model, t), step_inputs(knows, t)
        assert torch.allclose(knows.propagate(x, u, w), model.propagate(x, inner, math.sqrt(factor) * w), rtol=1e-12)
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
            assert torch.allclose(law.variance, covariance.diagonal(dim1=-2, dim2=-1).expand_as(law.variance))


class Pushed(LinearGaussian):
    """Driven by a normal that is not standard."""

    @property
    def noise(self) -> Any:
        return Independent(torch.distributions.Normal(torch.tensor([2.0]).double(), torch.tensor([3.0]).double()), 1)


def pushed() -> Pushed:
    return Pushed([[1.0]], [[1.0]], [[1.0]], [0.5], [0.0], [1.0])


def test_noise_that_is_not_standard_swells_about_its_mean() -> None:
    episode = ModelWorld(pushed(), 60).draw(SURGE, torch.arange(4000), 3)
    step = torch.diff(episode.truth["state"][..., 0], dim=1)  # into steps 2, 3, ..., of times 2, 3, ...
    for t, sd in ((10, 3.0), (25, 30.0)):
        assert abs(step[:, t - 2].mean() - 2.0) < 4.5 * sd / math.sqrt(4000)
        assert abs(step[:, t - 2].std() / sd - 1.0) < 4.5 / math.sqrt(8000)
    knows = told(pushed(), SURGE)
    found = knows.propagate(torch.zeros(1, 1, 1).double(), step_inputs(knows, 25), torch.tensor([[[5.0]]]).double())
    assert float(found) == pytest.approx(2.0 + 10.0 * 3.0)


# a linear model: the Kalman filter with the true Q and R


def oracle(model: LinearGaussian, y: np.ndarray, regime: Regime) -> oracles.Filtered:
    """Kalman filter whose Q and R change with the step, one step of the textbook filter at a time."""
    f, g, h = model.f.numpy(), model.g.numpy(), model.h.numpy()
    m, p, rows = model.m0.numpy(), model.l0.numpy() @ model.l0.numpy().T, []
    for t, row in enumerate(y, 1):
        k = next((i for i, (a, b) in enumerate(SURGE.windows) if a <= t < b), None)
        before = next((i for i, (a, b) in enumerate(SURGE.windows) if a <= t - 0.5 < b), None)  # the interval that ends at t
        q = g @ g.T * (1.0 if before is None else SURGE.q_factors[before])
        r = np.diag(model.r.numpy() ** 2) * (1.0 if k is None else SURGE.r_factors[k])
        rows.append(oracles.kalman(f, q, h, r, m, p, row[None]))
        m, p = rows[-1].mean[0], rows[-1].covariance[0]
    return oracles.Filtered(*(np.concatenate(parts) for parts in zip(*rows, strict=True)))


@pytest.fixture(scope="module")
def surging() -> Any:
    model = linear_walk(1.0, 0.3, 1.0)
    episode = ModelWorld(model, 60).draw(SURGE, torch.arange(500), 4)
    return model, episode, estimate(KALMAN, told(model, SURGE), episode.record), estimate(KALMAN, model, episode.record)


def test_a_told_kalman_filter_is_that_of_the_true_q_and_r(surging: Any) -> None:
    model, episode, knows, _ = surging
    for run in range(3):
        exact = oracle(model, episode.record.y[run].numpy(), SURGE)
        assert np.allclose(knows.mean[run], exact.mean, rtol=1e-9, atol=1e-9)
        assert np.allclose(knows.variance[run], np.diagonal(exact.covariance, axis1=1, axis2=2), rtol=1e-9)
        assert knows.log_evidence[run] == pytest.approx(exact.log_evidence.sum(), rel=1e-9)


def test_told_is_consistent_and_untold_is_not(surging: Any) -> None:
    _, episode, knows, guesses = surging
    low, high = stats.chi2(500).ppf([1e-5, 1 - 1e-5])
    for part in range(2):
        nees = [((e.mean - episode.truth["state"])[..., part] ** 2 / e.variance[..., part]).sum(0) for e in (knows, guesses)]
        assert ((low < nees[0]) & (nees[0] < high)).all()
        assert ((nees[1] < low) | (nees[1] > high)).float().mean() > 0.3
        assert (nees[1][20:29] > high).all()


def test_told_has_the_higher_evidence(surging: Any) -> None:
    _, _, knows, guesses = surging
    gain = knows.log_evidence - guesses.log_evidence  # its mean is a Kullback-Leibler divergence
    assert gain.mean() > 4 * gain.std() / math.sqrt(len(gain))


HEAVY: list[Regime] = [StudentT(4), Laplace(), Outliers(0.1, 8.0), Glint(0.1, 8.0), NonLineOfSight(0.2, 5.0)]


@pytest.mark.slow
@pytest.mark.parametrize("regime", HEAVY, ids=repr)
def test_a_told_particle_filter_has_the_higher_evidence(regime: Regime) -> None:
    model, sir = linear_walk(1.0, 0.3, 1.0), job.build(composed("filter=sir", "particles=400")["filter"])
    episode = ModelWorld(model, 60).draw(regime, torch.arange(60), 4)
    knows, guesses = estimate(sir, told(model, regime), episode.record), estimate(sir, model, episode.record)
    gain = knows.log_evidence - guesses.log_evidence
    assert gain.mean() > 4 * gain.std() / math.sqrt(len(gain))


# transparent


CALM: list[Regime] = [Nominal(), Surge(((5.0, 9.0),), (1.0,), (1.0,)), Outage(((5.0, 9.0),))]
OBSERVED = [local_level(3.0, 1.0, 0.0, 2.0, observes_initial=True), StochasticVolatility()]


@pytest.mark.parametrize("model", [*MODELS, *OBSERVED], ids=lambda m: type(m).__name__)
@pytest.mark.parametrize("regime", CALM, ids=["nominal", "ones", "outage"])
def test_told_nothing_changes_nothing(model: StateSpaceModel, regime: Regime) -> None:
    episode = ModelWorld(model, 12).draw(regime, torch.arange(3), 4)
    knows = told(model, regime, episode.time)
    assert knows.linear == model.linear
    for method in (KALMAN, GaussianFilter(Points(Cubature())), job.build(composed("filter=apf", "particles=40")["filter"])):
        a, b = estimate(method, knows, episode.record), estimate(method, model, episode.record)
        assert torch.equal(a.mean, b.mean)
        assert torch.equal(a.variance, b.variance)
        assert torch.equal(a.log_evidence, b.log_evidence)


def test_told_is_the_model_inside_in_all_else() -> None:
    model = Pendulum()
    knows = told(model, StudentT(4))
    for name in ("names", "units", "groups", "noise_dim", "observes_initial"):
        assert getattr(knows, name) == getattr(model, name)
    assert knows.chart == model.chart
    assert torch.equal(knows.origin, model.origin)
    assert torch.equal(knows.initial(2).stddev, model.initial(2).stddev)
    assert knows.anchor is model.anchor
    truth = {"angle": torch.full((1, 1, 1), 3.1).double(), "rate": torch.ones(1, 1, 1).double()}
    assert torch.equal(knows.assemble(truth), model.assemble(truth))
    assert knows.error(torch.tensor([-3.1, 0.0]).double(), torch.tensor([3.1, 0.0]).double())[0].abs() < 0.1  # wraps
    assert not told(linear_walk(1.0, 0.3, 1.0), StudentT(4)).linear
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
    found = Record(torch.zeros(2, 3, 1), u).at(2).u
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
    for regime in (StudentT(4), Outliers(0.2, 5.0), SURGE):
        model = told(plain, regime)
        y = torch.tensor([[3.1]], dtype=torch.float64)
        x = torch.tensor([[[-3.1], [2 * math.pi - 3.1]]], dtype=torch.float64)
        found = model.log_likelihood(y, x, step_inputs(model, 3))[0]
        assert float(found[0]) == pytest.approx(float(found[1]), abs=1e-9)


def test_deviations_that_depend_on_the_state_pass_through() -> None:
    model, regime = StochasticVolatility(), StudentT(5)
    knows, x, y = told(model, regime), torch.tensor([[[-1.0], [2.0]]]).double(), torch.tensor([[0.7]]).double()
    found = knows.log_likelihood(y, x, step_inputs(knows, 2))[0]
    assert found.tolist() == pytest.approx([stats.t(5, scale=math.exp(s / 2)).logpdf(0.7) for s in (-1.0, 2.0)])
    episode = ModelWorld(model, 12).draw(regime, torch.arange(3), 4)
    for method in (KALMAN, GaussianFilter(Points(Cubature()))):
        assert torch.isfinite(estimate(method, told(model, regime, episode.time), episode.record).mean).all()


class Correlated(LinearGaussian):
    def observation(self, x: torch.Tensor, u: Any) -> MultivariateNormal:
        return MultivariateNormal(x, scale_tril=torch.tensor([[2.0, 0.0], [1.0, 0.5]]).double().expand(*x.shape[:2], 2, 2))


def test_correlated_measurements_surge_but_have_no_other_law() -> None:
    model = Correlated(np.eye(2), np.eye(2), np.eye(2), [1.0, 1.0], [0.0, 0.0], [1.0, 1.0])
    knows, x, y = told(model, SURGE), torch.zeros(1, 1, 2).double(), torch.tensor([[1.0, -2.0]]).double()
    covariance = 9.5 * np.array([[4.0, 2.0], [2.0, 1.25]])
    found = knows.log_likelihood(y, x, step_inputs(knows, 25))
    assert float(found) == pytest.approx(stats.multivariate_normal([0, 0], covariance).logpdf([1.0, -2.0]))
    with pytest.raises(ValueError, match=r"told=true: Correlated has no independent normal measurement noise; give told=false"):
        told(model, StudentT(4)).observation(x, step_inputs(told(model, StudentT(4)), 3))


def test_told_in_single_precision() -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    episode = ModelWorld(model, 60).draw(SURGE, torch.arange(3), 4)
    for regime in (SURGE, StudentT(4), Outliers(0.1, 5.0), NonLineOfSight()):
        double = estimate(KALMAN, told(model, regime), episode.record)
        single = estimate(KALMAN, told(model, regime).float(), episode.record)
        assert single.mean.dtype == torch.float32
        assert torch.allclose(single.mean.double(), double.mean, atol=1e-3)
        model.double()


# refusals


@pytest.mark.parametrize(
    ("regime", "channels", "words"),
    [
        (GaussMarkov(), THREE, r"noise=gauss_markov: a filter cannot be told of it .*told=false"),
        (Replay(None), THREE, r"noise=replay: a filter cannot be told of it"),
        (NonLineOfSight(dwell=9.0), THREE, r"noise=nlos: a filter cannot be told of it \(its biases last\)"),
        (NonLineOfSight(of=StudentT(4)), THREE, "are not nominal"),
        (NonLineOfSight(of=SURGE), THREE, "are not nominal"),
        (NonLineOfSight(), Channels.alike(torch.ones(3).double()), "several components of one source"),
        (Outage(((5.0, 9.0),), of=GaussMarkov()), THREE, "gauss_markov"),
        (Surge(((5.0, 9.0),), (2.0,), (1.0,), of=GaussMarkov()), THREE, "gauss_markov"),
        (BiasStep(time=5.0, of=GaussMarkov()), THREE, "gauss_markov"),
    ],
    ids=lambda value: type(value).__name__,
)
def test_regimes_without_a_law_of_each_step_refuse_by_name(regime: Regime, channels: Channels, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        Told(still(), regime, channels, TIME)


def test_a_record_of_another_length_and_a_silent_witness_are_refused() -> None:
    with pytest.raises(ValueError, match="the record has 9 steps, the filter was told of 60"):
        told(linear_walk(1.0, 0.3, 1.0), SURGE).prepare(Record(torch.zeros(1, 9, 1)))
    with pytest.raises(ValueError, match="told=true: the scenario drew no errors"):
        Witness(Nominal()).tell(linear_walk(1.0, 0.3, 1.0), TIME)

    class HeavyTailed(Pendulum):
        def observation(self, x: torch.Tensor, u: Any) -> Any:
            return Independent(LaplaceLaw(torch.sin(x[..., :1]), 0.3), 1)

    model = told(HeavyTailed(), SURGE)
    with pytest.raises(ValueError, match="HeavyTailed has no independent normal"):
        model.observation(torch.zeros(1, 1, 2).double(), step_inputs(model, 3))


# the switch


@cache
def composed(*words: str) -> Any:
    """For reading: the same words are composed once."""
    with initialize_config_dir(str(CONF), version_base="1.3"):
        return compose("config", [*words, "worlds=null"])


PRESETS = [file.stem for file in sorted((CONF / "noise").glob("*.yaml"))]
CANNOT = {"gauss_markov", "replay", "nlos_persistent"}


def cell(scenario: str, noise: str) -> None:
    """The cell runs, told and untold, and what is told matters; or it is refused by name.

    A regime takes nothing from the scene, and is composed beside it.
    """
    windows = ["noise.windows=[[6.0,9.0]]"] if noise.endswith("outage") else []
    short = ["scenario.steps=20"] if scenario != "t004" else []
    cfg = deepcopy(composed(f"scenario={scenario}", "particles=30", "data.root=null", *short))
    regime = composed(f"noise={noise}", "data.root=null", *windows).noise
    if scenario == "t004":
        cfg.scenario.path.segments = cfg.scenario.path.segments[:1]
        cfg.scenario.imu_rate = 20.0
    witness, model = Witness(job.build(regime)), job.build(cfg.model)
    if noise == "replay":
        with pytest.raises(ValueError, match=r"data\.root is not set"):
            job.build(cfg.scenario).draw(witness, torch.arange(2), 1)
        return
    episode = job.build(cfg.scenario).draw(witness, torch.arange(2), 1)
    models = [model]
    if noise in CANNOT or (noise, scenario) == ("nlos", "t004"):
        with pytest.raises(ValueError, match=r"a filter cannot be told of it .*; give told=false"):
            witness.tell(model, episode.time)
    else:
        models.append(witness.tell(model, episode.time))
    for method in (KALMAN, job.build(cfg["filter"])):
        found = [estimate(method, each, episode.record) for each in models]
        for each in found:
            assert torch.isfinite(each.mean).all()
            assert not each.lost.any()
    if len(found) > 1:  # particles, weighed by the law that was told: another one wherever the regime's is not the model's own
        assert torch.equal(found[0].mean, found[1].mean) == (noise in ("nominal", "outage"))


@pytest.mark.parametrize("noise", PRESETS)
@pytest.mark.parametrize("scenario", ["linear_walk", "growth", "t004"])
def test_every_regime_runs_told_and_untold_or_says_why_not(scenario: str, noise: str) -> None:
    cell(scenario, noise)


def test_the_switch_reaches_the_result(tmp_path: Path) -> None:
    words = ("run", "-m", "scenario=linear_walk", "noise=paper_step", "filter=ekf", "runs=4", "told=false,true")
    said = pfbench(*words, home=tmp_path)
    assert said.code == 0, said.err
    metas, arrays = [], []
    for file in (tmp_path / "results" / "adhoc").glob("*.npz"):
        with np.load(file, allow_pickle=False) as found:
            metas.append(json.loads(str(found["meta"])))
            arrays.append(found["log_evidence"])
    by = {meta["told"]: (meta, evidence) for meta, evidence in zip(metas, arrays, strict=True)}
    assert set(by) == {False, True}
    assert by[True][1].mean() > by[False][1].mean()
    assert any("told the noise regime" in text for text in by[True][0]["choices_made"])
    assert not any("told the noise regime" in text for text in by[False][0]["choices_made"])
    assert by[True][0]["exact"]
    report = pfbench("report", "study=adhoc", f"reports={tmp_path / 'reports'}", "report.formats=[svg]", home=tmp_path)
    assert report.code == 0, report.err
    page = (tmp_path / "reports" / "adhoc" / "report.md").read_text()
    assert "ekf[told=True]" in page
    assert "the filter's model is told the noise regime" in page


@pytest.mark.parametrize("words", [("noise=gauss_markov", "told=true"), ("told=perhaps",)])
def test_the_switch_refuses_by_name(tmp_path: Path, words: tuple[str, ...]) -> None:
    said = pfbench("run", "scenario=linear_walk", "scenario.steps=9", "filter=ekf", "runs=2", *words, home=tmp_path)
    assert said.code != 0
    assert ("told=false" if "told=true" in words else "told=perhaps: give true") in said.err + said.out
