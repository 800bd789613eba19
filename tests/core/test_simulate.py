"""The simulator draws each distribution of a model, and run i never depends on the other runs."""

import ast
import math
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from pyro import distributions as dist, poutine
from refusals import check_refused
from scipy import stats
from torch import Tensor
from torch.distributions import Distribution, Independent

import pfbench
from pfbench.core import PhiloxStream, Record, require, require_range, require_ranges
from pfbench.core.density import normal_batch
from pfbench.core.simulate import NumberSource, draw_values
from pfbench.filter import ParticleFilter, run_filter
from pfbench.filter.learned.objectives import simulate_from_model
from pfbench.filter.particle.stages import draw_noise
from pfbench.model import Pendulum, StateSpaceModel, linear_walk
from pfbench.noise import MeasurementOutage, NominalNoise, OutlierNoise, VarianceSurge
from pfbench.ppl import ParameterisedModel, latent_program, simulate
from pfbench.ppl.model_batch import ModelBatch
from pfbench.scenario import ModelSimulation, RecordingRegime

RUNS = 20_000


def f64(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


def draw(distribution: Distribution, runs: int = RUNS) -> np.ndarray:
    """Values [R, 1, 2] of two independent components."""
    law = Independent(distribution.expand(torch.Size((2,))), 1)
    values = draw_values(law, PhiloxStream(3, torch.arange(runs)), "test", 1)
    assert values.shape == (runs, 1, 2)
    return values.numpy()


CONTINUOUS = [
    (dist.Normal(f64(1.0), f64(2.0)), stats.norm(1, 2)),
    (dist.Laplace(f64(1.0), f64(2.0)), stats.laplace(1, 2)),
    (dist.Cauchy(f64(0.0), f64(1.0)), stats.cauchy()),
    (dist.StudentT(f64(1.0), f64(0.5), f64(2.0)), stats.t(1, 0.5, 2)),
    (dist.StudentT(f64(4.5), f64(0.5), f64(2.0)), stats.t(4.5, 0.5, 2)),
    (dist.Gamma(f64(0.3), f64(2.0)), stats.gamma(0.3, scale=0.5)),
    (dist.InverseGamma(f64(3.0), f64(2.0)), stats.invgamma(3, scale=2)),
    (dist.Beta(f64(4.0), f64(2.0)), stats.beta(4, 2)),
    (dist.LogNormal(f64(0.3), f64(0.5)), stats.lognorm(0.5, scale=math.exp(0.3))),
    (dist.Uniform(f64(-1.0), f64(2.0)), stats.uniform(-1, 3)),
    (dist.HalfCauchy(f64(2.0)), stats.halfcauchy(scale=2)),
]
DISCRETE = [
    (dist.Poisson(f64(3.3)), stats.poisson(3.3)),
    (dist.Poisson(f64(3000.0)), stats.poisson(3000)),
    (dist.NegativeBinomial(f64(2.5), probs=f64(0.4)), stats.nbinom(2.5, 0.6)),
    (dist.Bernoulli(f64(0.3)), stats.bernoulli(0.3)),
    (dist.Binomial(7, f64(0.4)), stats.binom(7, 0.4)),
    (
        dist.Categorical(f64([0.2, 0.5, 0.3])),
        stats.rv_discrete(values=([0, 1, 2], [0.2, 0.5, 0.3])),
    ),
]


@pytest.mark.parametrize(("law", "expected"), CONTINUOUS, ids=lambda a: type(a).__name__)
def test_continuous_distributions_are_drawn(law: Distribution, expected: Any) -> None:
    values = draw(law)
    assert stats.kstest(values.ravel(), expected.cdf).pvalue > 1e-3
    ranks = stats.spearmanr(values[:, 0, 0], values[:, 0, 1]).statistic
    assert abs(ranks) < 4.5 / math.sqrt(RUNS)


@pytest.mark.parametrize(("law", "expected"), DISCRETE, ids=lambda a: type(a).__name__)
def test_discrete_distributions_are_drawn(law: Distribution, expected: Any) -> None:
    values = draw(law).ravel()
    assert np.array_equal(values, np.round(values))
    edges = np.unique(expected.ppf(np.linspace(0.02, 0.98, 12)))
    for edge in edges:
        p = float(expected.cdf(edge))
        assert abs((values <= edge).mean() - p) < 4.5 * math.sqrt(p * (1 - p) / values.size) + 1e-12


def mixture(joint: bool) -> Distribution:
    """Two normal components, of single coordinates or of pairs."""
    weights, mean, sd = f64([0.3, 0.7]), f64([-3.0, 2.0]), f64([0.5, 1.0])
    if joint:
        parts = Independent(dist.Normal(mean[:, None].expand(2, 2), sd[:, None].expand(2, 2)), 1)
        return dist.MixtureSameFamily(dist.Categorical(weights), parts)
    each = dist.MixtureSameFamily(
        dist.Categorical(weights.expand(2, 2)), dist.Normal(mean.expand(2, 2), sd.expand(2, 2))
    )
    return Independent(each, 1)


def mixture_cdf(v: np.ndarray) -> np.ndarray:
    return 0.3 * stats.norm.cdf(v, -3.0, 0.5) + 0.7 * stats.norm.cdf(v, 2.0, 1.0)


@pytest.mark.parametrize("joint", [True, False])
def test_a_mixture_chooses_one_component_for_a_vector_or_for_each_coordinate(joint: bool) -> None:
    values = draw_values(mixture(joint), PhiloxStream(3, torch.arange(RUNS)), "test", 1)[
        :, 0
    ].numpy()
    for k in range(2):
        assert stats.kstest(values[:, k], mixture_cdf).pvalue > 1e-3
    same = ((values[:, 0] < -0.5) == (values[:, 1] < -0.5)).mean()
    assert same > 0.98 if joint else abs(same - 0.58) < 4.5 * math.sqrt(0.25 / RUNS)


def test_dense_and_low_rank_normal_distributions_have_their_covariance() -> None:
    root = f64([[2.0, 0.0], [-1.5, 0.5]])
    low = dist.LowRankMultivariateNormal(f64([1.0, 2.0]), f64([[1.0], [0.5]]), f64([0.2, 0.3]))
    for law in (dist.MultivariateNormal(f64([1.0, 2.0]), scale_tril=root), low):
        for batch in ((), (RUNS,), (RUNS, 1)):
            expanded = law.expand(torch.Size(batch))
            values = draw_values(expanded, PhiloxStream(3, torch.arange(RUNS)), "test", 1)[
                :, 0
            ].numpy()
            p = law.covariance_matrix.numpy()
            error = np.sqrt((np.outer(np.diag(p), np.diag(p)) + p**2) / RUNS)
            assert (np.abs(np.cov(values.T) - p) < 4.5 * error).all()
            assert (
                np.abs(values.mean(0) - law.mean.numpy()) < 4.5 * np.sqrt(np.diag(p) / RUNS)
            ).all()


def test_a_batch_of_runs_has_the_parameters_of_each_run() -> None:
    scale = torch.linspace(1.0, 9.0, 2000, dtype=torch.float64)[:, None].expand(-1, 2)
    for kind in (dist.Laplace, dist.Normal):
        law = Independent(kind(torch.zeros_like(scale), scale), 1)
        values = draw_values(law, PhiloxStream(3, torch.arange(2000)), "test", 5)
        assert values.shape == (2000, 5, 2)
        unit = (values / scale.unsqueeze(1)).numpy().ravel()
        assert stats.kstest(unit, "laplace" if kind is dist.Laplace else "norm").pvalue > 1e-3


class Triangular(dist.TorchDistribution):
    """The sum of two uniform numbers: without icdf and cdf, but with draw_from."""

    arg_constraints = {}  # noqa: RUF012
    support = dist.constraints.real

    def __init__(self) -> None:
        super().__init__(torch.Size((2,)), validate_args=False)

    def draw_from(self, source: NumberSource) -> Tensor:
        return source.uniform() + source.uniform(".second")


def test_a_distribution_class_can_state_how_it_is_drawn_and_another_is_refused() -> None:
    values = draw_values(
        Independent(Triangular(), 1), PhiloxStream(3, torch.arange(RUNS)), "test", 1
    )
    assert stats.kstest(values.numpy().ravel(), stats.triang(0.5, 0, 2).cdf).pvalue > 1e-3
    circle = Independent(dist.VonMises(f64([0.0]), f64([1.0])), 1)
    with pytest.raises(ValueError, match=r"got VonMises.*draw_from"):
        draw_values(circle, PhiloxStream(3, torch.arange(2)), "test", 1)


# noise distributions of a model


class Driven(StateSpaceModel):
    """A sum of its noise, two components, observed in noise; the noise distribution is a parameter."""

    def __init__(self, law: Distribution, scale: Any = 1.0) -> None:
        super().__init__()
        self.register_buffer("scale", torch.as_tensor(scale, dtype=torch.float64))
        self.names, self.units, self.groups, self.noise_dim = (
            ("a", "b"),
            ("", ""),
            {"state": (0, 1)},
            2,
        )
        self._law = law

    @property
    def noise(self) -> Distribution:
        return self._law

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, f64([1.0, 1.0]))

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x + w

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return dist.Normal(x, self.scale.expand_as(x)).to_event(1)


def pair(law: Distribution) -> Distribution:
    return Independent(law.expand(torch.Size((2,))), 1)


NOISES: dict[str, tuple[Distribution, Any]] = {
    "laplace": (pair(dist.Laplace(f64(0.0), f64(1.0))), "laplace"),
    "student": (pair(dist.StudentT(f64(3.0), f64(0.0), f64(1.0))), stats.t(3).cdf),
    "mixture": (mixture(False), mixture_cdf),
    "joint mixture": (mixture(True), mixture_cdf),
}
STEPS = 3


def steps_of(states: Tensor) -> np.ndarray:
    return torch.diff(states, dim=1).flatten(0, 1).numpy()


def in_filter(model: Driven) -> np.ndarray:
    return (
        draw_noise(model, 20, PhiloxStream(1, torch.arange(400)).at_step(1)).flatten(0, 1).numpy()
    )


def in_world(model: Driven) -> np.ndarray:
    return steps_of(
        ModelSimulation(model, STEPS).draw(NominalNoise(), torch.arange(4000), 5).truth["state"]
    )


def in_program(model: Driven) -> np.ndarray:
    record = Record(torch.zeros(4000, STEPS, 2, dtype=torch.float64))
    return steps_of(simulate(model, record, 5)[1])


def in_batch(model: Driven) -> np.ndarray:
    models = [Driven(model.noise, scale) for scale in (1.0, 2.0)]
    record = Record(torch.zeros(4000, STEPS, 2, dtype=torch.float64))
    return steps_of(simulate(ModelBatch(models, 2000), record, 5)[1])


def in_training(model: Driven) -> np.ndarray:
    record = Record(torch.zeros(4000, STEPS, 2, dtype=torch.float64))
    return steps_of(simulate_from_model(model, record, PhiloxStream(5, torch.arange(4000)))[1])


def in_latent_program(model: Driven) -> np.ndarray:
    unknown = ParameterisedModel(
        lambda scale: Driven(model.noise, scale), {"scale": dist.LogNormal(0.0, 1.0)}
    )
    record = Record(torch.zeros(4000, STEPS, 2, dtype=torch.float64))
    with torch.random.fork_rng():
        torch.manual_seed(1)
        trace = poutine.trace(latent_program(unknown)).get_trace(record)
    law, value = model.noise, trace.nodes["driving_noise"]["value"]
    trace.compute_log_prob()
    assert float(trace.nodes["driving_noise"]["log_prob"]) == pytest.approx(
        float(law.log_prob(value).sum())
    )
    return steps_of(trace.nodes["path"]["value"])


@pytest.mark.parametrize(
    "draws", [in_filter, in_world, in_program, in_batch, in_training, in_latent_program]
)
@pytest.mark.parametrize("name", NOISES)
def test_driving_noise_has_the_distribution_of_the_model_everywhere(
    name: str, draws: Callable[[Driven], np.ndarray]
) -> None:
    law, expected = NOISES[name]
    w = draws(Driven(law))
    for k in range(2):
        assert stats.kstest(w[:, k], expected).pvalue > 1e-3
    if name == "laplace":  # excess kurtosis 3; its error from 20 batches
        parts = stats.kurtosis(w[: len(w) // 20 * 20].reshape(20, -1), axis=1)
        assert abs(parts.mean() - 3.0) < 4.5 * parts.std() / math.sqrt(20)


def test_a_regime_scales_noise_about_its_mean_and_refuses_noise_without_one() -> None:
    surge = VarianceSurge(((0.0, 9.0),), (1.0,), (4.0,))
    law = pair(dist.Laplace(f64(0.5), f64(1.0)))
    w = steps_of(
        ModelSimulation(Driven(law), STEPS).draw(surge, torch.arange(4000), 5).truth["state"]
    )
    assert stats.kstest(w.ravel(), stats.laplace(0.5, 2.0).cdf).pvalue > 1e-3
    with pytest.raises(ValueError, match="finite mean"):  # noqa: PT012
        model = Driven(pair(dist.Cauchy(f64(0.0), f64(1.0))))
        ModelSimulation(model, STEPS).draw(surge, torch.arange(2), 5)


def test_initial_states_have_the_distribution_of_the_model_in_filter_and_world() -> None:
    class Start(Driven):
        def initial(self, runs: int) -> Distribution:
            return Independent(
                dist.Laplace(f64([1.0, -2.0]), f64([1.0, 3.0])).expand(torch.Size((runs, 2))), 1
            )

    model = Start(pair(dist.Normal(f64(0.0), f64(1e-9))))
    cloud = ParticleFilter(50).init(model, 200, PhiloxStream(1, torch.arange(200)))
    world = ModelSimulation(model, 1).draw(NominalNoise(), torch.arange(4000), 5).truth["state"]
    for x in (cloud.x.flatten(0, 1), world[:, 0]):
        assert stats.kstest(x[:, 0].numpy(), stats.laplace(1, 1).cdf).pvalue > 1e-3
        assert stats.kstest(x[:, 1].numpy(), stats.laplace(-2, 3).cdf).pvalue > 1e-3


# measurements


class Counts(Driven):
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return Independent(dist.Poisson(torch.exp(0.1 * x)), 1)


class HeavyTailed(Driven):
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return Independent(dist.Cauchy(x, torch.ones_like(x)), 1)


WHITE = pair(dist.Normal(f64(0.0), f64(1.0)))


def test_measurements_have_the_distribution_of_the_model_under_the_nominal_regime() -> None:
    model, runs = HeavyTailed(WHITE), torch.arange(4000)
    episode = ModelSimulation(model, STEPS).draw(NominalNoise(), runs, 5)
    errors = (episode.record.y - episode.truth["state"]).numpy()
    assert stats.kstest(errors.ravel(), "cauchy").pvalue > 1e-3
    counts = ModelSimulation(Counts(WHITE), STEPS).draw(NominalNoise(), runs, 5)
    rate = torch.exp(0.1 * counts.truth["state"])
    z = (counts.record.y - rate) / rate.sqrt()
    assert abs(float(z.mean())) < 4.5 / math.sqrt(z.numel())
    assert abs(float(z.var()) - 1.0) < 4.5 * math.sqrt(3.5 / z.numel())  # kurtosis 3 + 1/rate


def test_a_regime_that_changes_errors_needs_normal_ones_but_an_outage_does_not() -> None:
    world = ModelSimulation(HeavyTailed(WHITE), 5)
    outliers = OutlierNoise(0.5, 10.0)
    for noise in (outliers, RecordingRegime(outliers)):  # a job records the channels of its regime
        with pytest.raises(
            ValueError,
            match=r"noise must be nominal for HeavyTailed.*got OutlierNoise\. Choose noise=nominal",
        ):
            world.draw(noise, torch.arange(20), 1)
    nominal = world.draw(NominalNoise(), torch.arange(20), 1).record.y
    outage = world.draw(MeasurementOutage(((2.0, 4.0),)), torch.arange(20), 1).record.y
    assert torch.isnan(outage).any(2).tolist() == [[False, True, True, False, False]] * 20
    assert torch.equal(outage[:, [0, 3, 4]], nominal[:, [0, 3, 4]])


# counters


def episode_of(model: StateSpaceModel, runs: int) -> list[Tensor]:
    episode = ModelSimulation(model, 4).draw(NominalNoise(), torch.arange(runs), 7)
    return [episode.record.y, episode.truth[next(iter(model.groups))]]


def program_of(model: StateSpaceModel, runs: int) -> list[Tensor]:
    width = model.observation(model.origin.expand(1, 1, -1), ()).event_shape[0]
    record, states = simulate(model, Record(torch.zeros(runs, 4, width, dtype=torch.float64)), 7)
    return [record.y, states]


def training_of(model: StateSpaceModel, runs: int) -> list[Tensor]:
    width = model.observation(model.origin.expand(1, 1, -1), ()).event_shape[0]
    record = Record(torch.zeros(runs, 4, width, dtype=torch.float64))
    record, states, noises = simulate_from_model(model, record, PhiloxStream(7, torch.arange(runs)))
    return [record.y, states, noises]


MODELS = {
    "pendulum": Pendulum(),
    "counts": Counts(WHITE),
    "heavy": HeavyTailed(NOISES["student"][0]),
    "mixture": HeavyTailed(mixture(True)),
}


@pytest.mark.parametrize("simulator", [episode_of, program_of, training_of])
@pytest.mark.parametrize("name", MODELS)
def test_run_0_does_not_depend_on_the_number_of_runs(
    name: str, simulator: Callable[[StateSpaceModel, int], list[Tensor]]
) -> None:
    torch.manual_seed(1)
    one = simulator(MODELS[name], 1)
    torch.manual_seed(2)
    state = torch.random.get_rng_state()
    many = simulator(MODELS[name], 9)
    assert torch.equal(torch.random.get_rng_state(), state)
    for a, b in zip(one, many, strict=True):
        torch.testing.assert_close(a, b[:1], rtol=1e-13, atol=1e-13)
        assert not torch.equal(b[:1], b[1:2])


def test_scenario_and_program_simulate_the_same_episodes() -> None:
    for model in (linear_walk(0.5, 0.3, 1.0), *MODELS.values()):
        torch.testing.assert_close(episode_of(model, 5)[0], program_of(model, 5)[0], rtol=0, atol=0)


def test_parameters_of_a_prior_do_not_depend_on_their_number() -> None:
    prior = {"a": dist.LogNormal(0.3, 0.5), "b": dist.Gamma(2.0, 1.0), "c": dist.Beta(2.0, 3.0)}
    unknown = ParameterisedModel(lambda a, b, c: linear_walk(1.0, a * c, b), prior)
    few, many = unknown.sample(3, 4), unknown.sample(4000, 4)
    expected = (stats.lognorm(0.5, scale=math.exp(0.3)), stats.gamma(2), stats.beta(2, 3))
    for (name, values), law in zip(many.items(), expected, strict=True):
        assert torch.equal(few[name], values[:3])
        assert stats.kstest(values.numpy(), law.cdf).pvalue > 1e-3


def test_a_filter_with_other_noise_estimates_its_own_world() -> None:
    """The average log evidence is larger for the noise distribution that drew the episodes."""
    noises = [NOISES["joint mixture"][0], pair(dist.Normal(f64(0.5), f64(2.4)))]
    episode = ModelSimulation(Driven(noises[0], 0.2), 6).draw(NominalNoise(), torch.arange(60), 5)
    right, wrong = (
        run_filter(
            ParticleFilter(2000),
            Driven(noise, 0.2),
            episode.record,
            PhiloxStream(1, torch.arange(60)),
        ).log_evidence
        for noise in noises
    )
    gain = right - wrong
    assert float(gain.mean()) > 4.5 * float(gain.std()) / math.sqrt(60)


def test_global_seeds_are_set_only_where_pyro_needs_them() -> None:
    """`manual_seed` may stand only inside `fork_rng`, and never in a module that uses the simulator."""
    for file in Path(pfbench.__file__).parent.rglob("*.py"):
        text = file.read_text()
        if "manual_seed" not in text:
            continue
        tree = ast.parse(text)
        assert "simulate" not in text, file
        forks = [
            n
            for n in ast.walk(tree)
            if isinstance(n, ast.With) and "fork_rng" in ast.unparse(n.items[0])
        ]
        inside = sum(
            "manual_seed" in ast.unparse(n.func)
            for f in forks
            for n in ast.walk(f)
            if isinstance(n, ast.Call)
        )
        calls = sum(
            "manual_seed" in ast.unparse(n.func) for n in ast.walk(tree) if isinstance(n, ast.Call)
        )
        assert calls == inside, file


class Unprintable:
    """A value whose text costs."""

    def __str__(self) -> str:
        raise AssertionError("formatted without need")


def test_what_holds_formats_nothing() -> None:
    require(True, "key", "be so", Unprintable())
    with pytest.raises(AssertionError, match="without need"):
        require(False, "key", "be so", Unprintable())


def test_a_refusal_names_key_requirement_value_and_remedy() -> None:
    check_refused(
        [
            (
                r"^a\.b must be so, got 3\. Do this\.$",
                lambda: require([], "a.b", "be so", 3, "Do this."),
            ),
            (r"^a\.b must be so, got 3\. Change a\.b\.$", lambda: require(0, "a.b", "be so", 3)),
        ],
        remedy=False,
    )


RANGES: dict[str, tuple[list[Any], list[Any], str]] = {
    "(0, 1]": ([1e-300, 1, 1.0], [0, -1, 1.5, math.nan, math.inf, None, "0.5", [0.5]], r"in \(0, 1\]"),
    "[-1, 1) Use 0.": ([-1, 0.9], [1, -2], r"in \[-1, 1\), got .*\. Use 0\."),
    "[0, inf]": ([0, math.inf], [-1e-9, math.nan], "at least 0, got"),
    "(0, inf)": ([5e-324], [0, math.inf], "positive and finite, got"),
    "(2, inf]": ([2.1, math.inf], [2], "above 2, got"),
    "whole [2, inf) Use 3.": ([2, 10**9], [1, 2.0, True, None, "2"], r"a whole number of at least 2, got .* Use 3\."),
    "null or whole [1, inf)": ([None, 1], [0, 1.0, True], "a whole number of at least 1, got"),
    "null or [1e-6, 1e6]": ([None, 1e-6, 1e6], [1e-7, 2e6], r"in \[1e-6, 1e6\], got"),
}  # fmt: skip


@pytest.mark.parametrize("rule", RANGES)
def test_a_range_has_its_numbers_and_no_others(rule: str) -> None:
    inside, outside, words = RANGES[rule]
    for value in inside:
        require_range("key", value, rule)
        require_ranges("part", SimpleNamespace(key=value), key=rule)
    for value in outside:
        with pytest.raises(ValueError, match=rf"^key must be {words}"):
            require_range("key", value, rule)
        with pytest.raises(ValueError, match=rf"^part\.key must be {words}"):
            require_ranges("part", SimpleNamespace(key=value), key=rule)
        with pytest.raises(ValueError, match=rf"^key must be {words}"):
            require_ranges("", SimpleNamespace(key=value), key=rule)


def test_a_rule_that_is_no_interval_is_told_at_once() -> None:
    with pytest.raises(AssertionError, match="must be an interval"):
        require_range("key", 1, "positive")
