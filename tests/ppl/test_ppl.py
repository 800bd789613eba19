"""Models as programs: gradients against finite differences, one model for each run against each alone, factors and sites."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from pyro import poutine
from pyro.distributions import Beta, ImproperUniform, LogNormal, Normal
from refusals import Refusal, check_refused
from scipy.stats import f as f_law, kstest, multivariate_t
from torch import Tensor
from torch.distributions import Independent

from pfbench.core import PhiloxStream, Record
from pfbench.core.density import independent_normal
from pfbench.core.parameter_checks import check_positive
from pfbench.filter import (
    CubaturePoints,
    Filter,
    GaussianFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    UnscentedPoints,
    run_filter,
)
from pfbench.model import (
    LinearGaussian,
    ModelWrapper,
    NormalExponentialMixture,
    PassiveLocation,
    Pendulum,
    PlatformInputs,
    StateSpaceModel,
    StochasticVolatility,
    UnivariateGrowth,
    compute_level_attitude,
    linear_walk,
    local_level,
)
from pfbench.ppl import (
    FilterLikelihood,
    GaussianHmmLikelihood,
    ParameterisedModel,
    ParameterPosterior,
    nuts,
    plot_posterior,
    repeat_runs,
    simulation_based_calibration,
    smc2,
    svi,
)
from pfbench.ppl.model_batch import ModelBatch
from pfbench.ppl.particle_mcmc import ParameterWalk, PmmhSettings, pmmh
from pfbench.ppl.pyro_program import (
    compute_path,
    latent_program,
    program,
    simulate,
)

EKF, CKF, UKF = (
    GaussianFilter(TaylorLinearisation()),
    GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
    GaussianFilter(SigmaPointLinearisation(UnscentedPoints())),
)
STEPS = 5


def walk(noise: Any, measurement_sd: Any) -> LinearGaussian:
    return linear_walk(1.0, noise, measurement_sd)


def level(level_sd: Any, measurement_sd: Any) -> LinearGaussian:
    return local_level(level_sd, measurement_sd, 0.0, 2.0, observes_initial=True)


def located(angle_sd: Any, acceleration_sd: Any) -> PassiveLocation:
    sd = [angle_sd, angle_sd, 1e-4, 1e-4, 1.0]
    return PassiveLocation(
        10.0, acceleration_sd, sd, (160e3, 160e3, 0.0, 0.0), (5e3, 5e3, 9.0, 9.0)
    )


class Tailed(ModelWrapper):
    """A walk whose measurements may be delayed: a law that is not normal, with a number of it in a buffer."""

    tail: Tensor

    def __init__(self, noise: Any, tail: Any) -> None:
        super().__init__(linear_walk(1.0, noise, 0.7))
        self.register_buffer("tail", torch.as_tensor(tail, dtype=torch.float64))

    def observation(self, x: Tensor, u: Any) -> Any:
        return Independent(
            NormalExponentialMixture(x[..., :1], x.new_zeros(()), x.new_tensor(0.7), self.tail), 1
        )


class Plain(ModelWrapper):
    """Keeps a number outside its buffers."""

    def __init__(self, noise: Any, gain: Any) -> None:
        super().__init__(walk(noise, 1.0))
        self.gain = float(gain)

    def observation(self, x: Tensor, u: Any) -> Any:
        return independent_normal(self.gain * x[..., :1], torch.full_like(x[..., :1], 0.7))


MAKE: dict[str, Callable[..., StateSpaceModel]] = {
    "walk": walk,
    "at_rest": level,
    "growth": lambda a, b: UnivariateGrowth(a, b),
    "pendulum": lambda a, b: Pendulum(noise=a, measurement_sd=b),
    "volatility": lambda a, b: StochasticVolatility(mu=-a, sigma=b),
    "location": lambda a, b: located(3e-3 * a, 0.3 * b),
    "tailed": Tailed,
    "plain": Plain,
}


def record_for(model: StateSpaceModel, runs: int) -> Record:
    """Arbitrary measurements with a gap; for the location an aircraft's way, and a start for each run."""
    y = (
        torch.sin(torch.arange(float(runs * STEPS), dtype=torch.float64) * 1.7).view(runs, STEPS, 1)
        + 0.5
    )
    y[0, 2] = torch.nan
    if not isinstance(model, PassiveLocation):
        return Record(y)
    t = 10.0 * torch.arange(1, STEPS + 1, dtype=torch.float64)
    velocity = torch.tensor([200.0, 0.0, 0.0], dtype=torch.float64)
    place = torch.stack([200.0 * t, torch.zeros_like(t), 2000.0 + torch.zeros_like(t)], -1)
    u = PlatformInputs(
        place[None],
        velocity.expand(1, STEPS, 3),
        compute_level_attitude(velocity).expand(1, STEPS, 3, 3),
        1e10 + 0.0 * t[None],
    )
    start = (
        model.origin + 1e3 * torch.arange(float(4 * runs), dtype=torch.float64).view(runs, 4).sin()
    )
    record, _ = simulate(model, Record(y.expand(-1, -1, 5).clone(), u, start), 3)
    return record


@pytest.mark.parametrize("method", [EKF, CKF, ParticleFilter(30)], ids=["ekf", "ckf", "sir"])
@pytest.mark.parametrize("name", MAKE)
def test_models_of_one_batch_are_each_what_it_is_alone(name: str, method: Filter) -> None:
    make, sizes = (
        MAKE[name],
        torch.tensor([[0.6, 0.9], [1.3, 0.5], [0.8, 1.7]], dtype=torch.float64),
    )
    models = [make(*row) for row in sizes]
    record = record_for(models[0], 3)
    together = run_filter(method, ModelBatch(models), record, PhiloxStream(1, torch.arange(3)))
    for r, model in enumerate(models):
        alone = run_filter(
            method, model, record.select_runs(slice(r, r + 1)), PhiloxStream(1, torch.tensor([r]))
        )
        torch.testing.assert_close(
            together.log_evidence[r : r + 1], alone.log_evidence, rtol=1e-10, atol=1e-10
        )
        torch.testing.assert_close(
            together.mean[r : r + 1], alone.mean, rtol=1e-9, atol=1e-9, equal_nan=True
        )


def test_a_model_serves_consecutive_runs() -> None:
    models = [walk(0.5, 1.0), walk(1.5, 0.3)]
    record = repeat_runs(record_for(models[0], 2), 2)
    found = run_filter(
        EKF, ModelBatch(models, 2), record, PhiloxStream(0, torch.arange(4))
    ).log_evidence
    alone = [
        run_filter(
            EKF, model, record.select_runs(slice(0, 2)), PhiloxStream(0, torch.arange(2))
        ).log_evidence
        for model in models
    ]
    torch.testing.assert_close(found, torch.cat(alone))


ZEROS, FAR = torch.zeros(1, 3, 1, dtype=torch.float64), torch.tensor([[[0.5], [1e200]]]).double()
LOG = LogNormal(0.0, 1.0)


def emitter(east: float) -> PassiveLocation:
    return PassiveLocation(1.0, 0.1, [1.0] * 5, initial_mean=(east, 0.0, 0.0, 0.0))


def leaping(**settings: Any) -> Any:
    return pmmh(LEVELS, EKF, Record(ZEROS), 1, 1, settings=PmmhSettings(**settings))


REFUSED: dict[str, list[Refusal]] = {
    "batches": [
        ("one origin", lambda: ModelBatch([emitter(1.0), emitter(2.0)])),
    ],
    "unknown numbers": [
        (r"names of path sites, got \['path'\]", lambda: latent_program(ParameterisedModel(lambda path: walk(path, 1.0), {"path": LOG}))),
        (r"prior\[c\] must change the model, got a LinearGaussian", lambda: ParameterisedModel(lambda a, c: walk(a, 1.0), {"a": LOG, "c": LOG})),
        ("scalar distribution", lambda: ParameterisedModel(lambda a: walk(a, 1.0), {"a": LogNormal(torch.zeros(2), 1.0)})),
        (r"pyro\.distributions", lambda: ParameterisedModel(lambda a: walk(a, 1.0), {"a": "log_normal"})),
        (r"be a proper continuous scalar distribution, got Improper", lambda: ParameterisedModel(lambda a: walk(a, 1.0), {"a": ImproperUniform(LOG.support, (), ())})),
        (r"continuous scalar distribution, got Poisson", lambda: ParameterisedModel(lambda a: walk(a, 1.0), {"a": torch.distributions.Poisson(3.0)})),
        (r"a must be .*positive", lambda: ParameterisedModel(lambda a: walk(check_positive("a", a), 1.0), {"a": Normal(-9.0, 1.0)})),
        ("at least one parameter", lambda: ParameterisedModel(lambda: walk(1.0, 1.0), {})),
    ],
    "pmmh": [
        (r"leaps must .* got -1", lambda: leaping(leaps=-1)),
        (r"a distribution for each of \['a', 'b'\], got \['a'\]", lambda: leaping(start={"a": LOG})),
        (r"draws must .* got 0", lambda: pmmh(LEVELS, EKF, Record(ZEROS), 0, 1)),
        ("lost at 20 draws", lambda: pmmh(LEVELS, ParticleFilter(5), Record(ZEROS + 1e200), 1, 1, chains=2)),
    ],
    "smc2": [
        ("one particle at step 1, got none", lambda: smc2(LEVELS, ParticleFilter(5), Record(FAR), 4)),
        (r"threshold must be in \[0, 1\], got 2", lambda: smc2(LEVELS, EKF, Record(FAR), 4, threshold=2.0)),
        (r"particles must .* got 1", lambda: smc2(LEVELS, EKF, Record(FAR), 1)),
    ],
}  # fmt: skip


@pytest.mark.parametrize("part", REFUSED)
def test_what_cannot_be_is_refused(part: str) -> None:
    check_refused(REFUSED[part], remedy=False)


SIZES = {
    "growth": (1.1, 0.9),
    "pendulum": (0.4, 0.6),
    "location": (1.2, 0.7),
    "at_rest": (0.7, 0.9),
}


@pytest.mark.parametrize(
    ("name", "method"), [*((n, EKF) for n in SIZES), ("growth", CKF), ("location", UKF)]
)
def test_gradients_of_the_evidence_are_its_finite_differences(name: str, method: Filter) -> None:
    """From one end of a Gaussian filter to the other, where a measurement is missing too; with a model for each run."""
    make, at = MAKE[name], torch.tensor(SIZES[name], dtype=torch.float64)
    record = record_for(make(*at), 2)

    def evidence(log_sizes: Tensor) -> Tensor:
        models = ModelBatch([make(*log_sizes.exp()) for _ in range(2)])
        return FilterLikelihood(method)(models, record).sum()

    log_at, h = at.log(), 1e-5
    with torch.no_grad():
        slopes = [
            (evidence(log_at + h * e) - evidence(log_at - h * e)) / (2 * h)
            for e in torch.eye(2, dtype=torch.float64)
        ]
    assert min(abs(float(slope)) for slope in slopes) > 5e-5  # the evidence depends on both
    z = log_at.clone().requires_grad_()
    torch.testing.assert_close(
        torch.autograd.grad(evidence(z), z)[0], torch.stack(slopes), rtol=2e-6, atol=1e-8
    )


LEVELS = ParameterisedModel(
    lambda a, b: walk(a, b), {"a": LogNormal(0.0, 0.5), "b": LogNormal(0.3, 0.4)}
)


def test_a_program_s_density_is_prior_times_evidence() -> None:
    record = Record(record_for(walk(1.0, 1.0), 2).y)
    values = {
        "a": torch.tensor(0.8, dtype=torch.float64),
        "b": torch.tensor(1.4, dtype=torch.float64),
    }
    traced = poutine.trace(
        poutine.condition(program(LEVELS, FilterLikelihood(EKF)), values)
    ).get_trace(record)
    prior = LEVELS.prior["a"].log_prob(values["a"]) + LEVELS.prior["b"].log_prob(values["b"])
    evidence = FilterLikelihood(EKF)(walk(0.8, 1.4), record)
    assert not traced.stochastic_nodes
    assert set(traced.observation_nodes) == {"a", "b", "evidence"}
    torch.testing.assert_close(traced.log_prob_sum(), prior + evidence.sum())
    apart = poutine.condition(
        program(LEVELS, FilterLikelihood(EKF), separate_parameters=True),
        {name: v.expand(2) for name, v in values.items()},
    )
    torch.testing.assert_close(
        poutine.trace(apart).get_trace(record).log_prob_sum(), 2 * prior + evidence.sum()
    )


def test_numbers_beyond_all_bounds_are_impossible_and_no_error() -> None:
    far = {"a": torch.tensor(torch.inf), "b": torch.tensor(1.0)}
    record = Record(torch.zeros(1, 3, 1, dtype=torch.float64))
    traced = poutine.trace(
        poutine.condition(program(LEVELS, FilterLikelihood(EKF)), far)
    ).get_trace(record)
    assert traced.nodes["evidence"]["fn"].log_factor == -torch.inf


@pytest.mark.parametrize("apart", [False, True])
def test_the_exact_likelihood_is_kalman_s(apart: bool) -> None:
    record = Record(record_for(walk(1.0, 1.0), 3).y.nan_to_num(0.3))
    sizes = torch.tensor([[0.6, 0.9], [1.3, 0.5], [0.8, 1.7]], dtype=torch.float64)
    model = ModelBatch([walk(*row) for row in sizes]) if apart else walk(*sizes[0])
    torch.testing.assert_close(
        GaussianHmmLikelihood()(model, record),
        FilterLikelihood(EKF)(model, record),
        rtol=0,
        atol=1e-7,
    )


def test_the_exact_likelihood_refuses_what_it_cannot_say() -> None:
    y = torch.zeros(1, 3, 1, dtype=torch.float64)
    singular = LinearGaussian(
        torch.eye(2), [[0.0], [1.0]], [[1.0, 0.0]], [1.0], [0.0] * 2, [1.0] * 2
    )
    for model in (UnivariateGrowth(), level(1.0, 1.0), singular):
        with pytest.raises(ValueError, match="must have a linear model with full noise"):
            GaussianHmmLikelihood()(model, Record(y))
    check_refused(
        [
            (
                "missing components",
                lambda: GaussianHmmLikelihood()(walk(1.0, 1.0), Record(y + torch.nan)),
            )
        ],
        remedy=False,
    )


@pytest.mark.parametrize("make", [walk, level])
def test_the_latent_program_integrates_to_the_evidence(make: Callable[..., LinearGaussian]) -> None:
    """In the noise of a linear model its density is normal: mode and curvature give the integral, which is Kalman's evidence."""
    prior = {"a": LogNormal(0.0, 0.5), "b": LogNormal(0.3, 0.4)}
    unknown = ParameterisedModel(lambda a, b: make(a, b), prior)
    record = Record(record_for(make(1.0, 1.0), 1).y)
    values = {
        "a": torch.tensor(0.8, dtype=torch.float64),
        "b": torch.tensor(1.4, dtype=torch.float64),
    }
    model = unknown.model(values)
    d, w = model.chart.dimension, model.noise_dim

    def log_joint(v: Tensor) -> Tensor:
        sites = {"initial_state": v[:d].view(1, d), "driving_noise": v[d:].view(1, STEPS, w)}
        traced = poutine.trace(
            poutine.condition(latent_program(unknown), values | sites)
        ).get_trace(record)
        return traced.log_prob_sum() - sum(
            law.log_prob(values[name]) for name, law in prior.items()
        )

    zero = torch.zeros(d + STEPS * w, dtype=torch.float64)
    slope = torch.func.grad(log_joint)(zero)
    bend = torch.stack(
        [torch.func.grad(log_joint)(e) - slope for e in torch.eye(len(zero), dtype=torch.float64)]
    )
    mode = -torch.linalg.solve(bend, slope)
    integral = log_joint(mode) + 0.5 * len(zero) * math.log(2 * math.pi) - 0.5 * torch.logdet(-bend)
    torch.testing.assert_close(integral, FilterLikelihood(EKF)(model, record)[0], rtol=0, atol=1e-8)


def test_simulated_measurements_have_the_model_s_law_start_and_gaps() -> None:
    model, runs = walk(0.8, 0.6), 4000
    y = torch.zeros(runs, 3, 1, dtype=torch.float64)
    y[:, 1] = torch.nan
    start = torch.tensor([[5.0, 2.0]], dtype=torch.float64).expand(runs, -1)
    record, states = simulate(model, Record(y, start=start), 2)
    assert torch.isnan(record.y[:, 1]).all()
    assert record.start is start
    evidence = FilterLikelihood(EKF)(
        model, record
    )  # twice its mean is minus an entropy, of 2 normal numbers: variance 2/2
    f, q = model.f, model.g @ model.g.mT
    p1 = f @ torch.diag(torch.tensor([4.0, 1.0], dtype=torch.float64)) @ f.mT + q
    p3 = f @ f @ p1 @ f.mT @ f.mT + f @ q @ f.mT + q
    c = torch.stack(
        [
            torch.stack([p1[0, 0], (p1 @ f.mT @ f.mT)[0, 0]]),
            torch.stack([(p1 @ f.mT @ f.mT)[0, 0], p3[0, 0]]),
        ]
    )
    c = c + 0.36 * torch.eye(2, dtype=torch.float64)
    entropy = 1.0 + math.log(2 * math.pi) + 0.5 * torch.logdet(c)
    assert abs(float(evidence.mean() + entropy)) < 4.5 / runs**0.5
    assert abs(float(states[:, 0, 0].mean()) - 7.0) < 4.5 * float(p1[0, 0] / runs) ** 0.5
    errors = record.y[:, [0, 2], 0] - states[:, [0, 2], 0]
    assert abs(float(errors.std()) / 0.6 - 1.0) < 4.5 / (4 * runs) ** 0.5


def test_the_states_of_a_simulation_are_those_that_its_noise_makes() -> None:
    model = located(3e-3, 0.3)
    record = record_for(model, 2)
    z, w = torch.zeros(2, 4, dtype=torch.float64), torch.zeros(2, STEPS, 2, dtype=torch.float64)
    states, log_like = compute_path(model, record, z, w)
    assert record.start is not None
    torch.testing.assert_close(
        states[:, -1], record.start @ torch.linalg.matrix_power(model.phi, STEPS).mT
    )
    assert log_like.shape == (2, STEPS)


def test_the_density_on_the_whole_line_integrates_to_one() -> None:
    unknown = ParameterisedModel(
        lambda a, b: StochasticVolatility(rho=a, sigma=b),
        {"a": Beta(4.0, 2.0), "b": LogNormal(-1.0, 0.5)},
    )
    at = torch.linspace(-12.0, 12.0, 801, dtype=torch.float64)
    z = torch.cartesian_prod(at, at)
    values, log_prior = unknown.constrained(z)
    assert abs(float(log_prior.exp().sum()) * float(at[1] - at[0]) ** 2 - 1.0) < 1e-6
    back = unknown.unconstrained({name: v[:: 801 * 50 + 50] for name, v in values.items()})
    torch.testing.assert_close(back, z[:: 801 * 50 + 50])


def test_a_chain_alone_is_what_it_is_among_others() -> None:
    """Its batch of one model also passes the health check, which takes the steps of a run as runs."""
    record = Record(torch.linspace(0.0, 1.0, 40, dtype=torch.float64).view(1, 40, 1))
    alone, among = (pmmh(LEVELS, EKF, record, 3, 0, chains=chains) for chains in (1, 3))
    for name, draws in alone.draws.items():
        torch.testing.assert_close(draws, among.draws[name][:1])


def test_leaps_are_of_a_t_law_and_know_its_density() -> None:
    """Squared lengths under a law of t with 5 degrees of freedom are 3 F(3, 5) in three dimensions; SciPy has its density."""
    root = torch.tensor([[1.0, 0.0, 0.0], [0.4, 0.7, 0.0], [-0.3, 0.2, 2.0]], dtype=torch.float64)
    mean, covariance = torch.tensor([[1.0, -2.0, 0.5]], dtype=torch.float64), (root @ root.mT)[None]
    z = mean + 2.0 * torch.randn(
        2000, 1, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)
    )
    walk = ParameterWalk(mean, covariance, torch.zeros(1, dtype=torch.float64))
    new, log_back = walk.leap(z, PhiloxStream(1, torch.arange(2000)).at_step(1))
    law = multivariate_t(mean[0].numpy(), covariance[0].numpy() + 1e-6 * np.eye(3), df=5)
    np.testing.assert_allclose(
        log_back[:, 0], law.logpdf(z[:, 0].numpy()) - law.logpdf(new[:, 0].numpy()), atol=1e-9
    )
    length = (
        torch.linalg.solve_triangular(root, (new - mean).mT, upper=False).square().sum((1, 2)) / 3.0
    )
    assert kstest(length.numpy(), f_law(3, 5).cdf).pvalue > 1e-3


@pytest.mark.parametrize("leaps", [1, 10**6])
def test_chains_that_start_elsewhere_come_to_the_posterior_by_steps_and_by_leaps(
    leaps: int,
) -> None:
    """Nothing is measured, so that the posterior is the prior; in the second case they only leap."""
    start = {"a": LogNormal(0.6, 0.9), "b": LogNormal(-0.6, 0.9)}
    ticks: list[None] = []
    found = pmmh(
        LEVELS, EKF, Record(torch.full((1, 1, 1), torch.nan, dtype=torch.float64)), 5, 16, chains=120, seed=3,
        settings=PmmhSettings(start=start, leaps=leaps, thin=4, tick=lambda *_: ticks.append(None)),
    )  # fmt: skip
    assert len(ticks) == 36
    for name, law in LEVELS.prior.items():
        z = (found.pooled_draws(name).log() - law.loc) / law.scale
        assert abs(z.mean()) < 0.2
        assert 0.75 < z.square().mean() < 1.3


def test_a_table_tells_chains_that_have_not_met() -> None:
    torch.manual_seed(0)
    met = torch.randn(4, 500, dtype=torch.float64)
    posterior = ParameterPosterior(
        {"a": met, "b": met + 5.0 * torch.arange(4.0)[:, None]}, torch.full((4,), 0.3)
    )
    table = posterior.table()
    assert table.r_hat["a"] < 1.02 < 2.0 < table.r_hat["b"]
    assert not posterior.has_converged
    assert table.ess["a"] > 1500 > 50 > table.ess["b"]
    for column, truth in (
        ("mean", 0.0),
        ("median", 0.0),
        ("low", -1.645),
        ("high", 1.645),
        ("sd", 1.0),
    ):
        assert abs(table[column]["a"] - truth) < 0.2
    figure = plot_posterior(
        {"both": posterior}, {"a": Normal(0.0, 2.0), "b": LogNormal(1.0, 1.0)}, {"a": 0.0}
    )
    assert len(figure.axes) == 4
    named = plot_posterior(
        {"both": posterior}, {"a": Normal(0.0, 2.0), "b": LogNormal(1.0, 1.0)}, names={"b": "b, m"}
    )
    assert [axis.get_ylabel() for axis in named.axes[::2]] == ["a", "b, m"]
    apart = ParameterPosterior({"a": met.view(4, 100, 5)}, torch.full((4, 5), 0.3))
    assert apart.run(2).draws["a"].shape == (4, 100)
    check_refused([("run\\(r\\)", lambda: apart.table())], remedy=False)
    short = ParameterPosterior({"a": met[:, :3]}, torch.full((4,), 0.3))
    assert not short.has_converged
    assert math.isnan(short.table().r_hat["a"])


GOOD: dict[str, Any] = {"draws": 2, "warmup": 1, "chains": 1, "seed": 0}
WRONG_CALLS: dict[str, tuple[Callable[..., Any], dict[str, Any], str]] = {
    "no draws of nuts": (nuts, {"draws": 0}, r"nuts\.draws must be a whole number .* 1, got 0"),
    "part of a draw": (pmmh, {"draws": 2.5}, r"pmmh\.draws must be a whole number .* got 2\.5"),
    "text": (pmmh, {"chains": "4"}, r"pmmh\.chains must be a whole number .* got '4'"),
    "truth value": (nuts, {"warmup": True}, r"nuts\.warmup must be a whole number .* got True"),
    "negative seed": (pmmh, {"seed": -1}, r"pmmh\.seed must be a whole number of at least 0"),
    "a tensor": (pmmh, {"record": torch.zeros(1, 3, 1)}, r"record must be a Record, got Tensor"),
    "a class": (pmmh, {"method": ParticleFilter}, r"pmmh\.method must be a Filter, got Particle"),
    "a number": (nuts, {"program": 3}, r"nuts\.program must be a Callable, got int"),
}


@pytest.mark.parametrize("name", WRONG_CALLS)
def test_a_wrong_argument_of_an_algorithm_is_named(name: str) -> None:
    function, change, message = WRONG_CALLS[name]
    record = Record(torch.zeros(1, 3, 1, dtype=torch.float64))
    unknown = ParameterisedModel(
        lambda sd: local_level(1.0, sd, 0.0, 1.0), {"sd": LogNormal(0.0, 0.5)}
    )
    subject = {"program": program(unknown, FilterLikelihood(ParticleFilter(10)))}
    if function is pmmh:
        subject = {"unknown": unknown, "method": ParticleFilter(10)}
    with pytest.raises(ValueError, match=message) as caught:
        function(**{**subject, "record": record, **GOOD, **change})
    assert str(caught.value).endswith(".")


def test_wrong_arguments_of_svi_smc2_and_simulation_are_named() -> None:
    record = Record(torch.zeros(1, 3, 1, dtype=torch.float64))
    unknown = ParameterisedModel(
        lambda sd: local_level(1.0, sd, 0.0, 1.0), {"sd": LogNormal(0.0, 0.5)}
    )
    method = ParticleFilter(10)
    for change, message in (
        (
            {"steps": 0},
            r"svi\.steps must be a whole number of at least 1, got 0\. Change svi\.steps",
        ),
        ({"draws": 0}, r"svi\.draws must be"),
        ({"rate": math.nan}, r"svi\.rate must be positive and finite, got nan"),
        ({"guide": None}, r"svi\.guide must be a Callable, got NoneType"),
    ):
        words: dict[str, Any] = {"guide": print, "steps": 1, "draws": 1}
        with pytest.raises(ValueError, match=message):
            svi(print, record, **{**words, **change})
    for values, message in (
        ((unknown, method, record.y, 4), r"smc2\.record must be a Record, got Tensor"),
        ((method, method, record, 4), r"smc2\.unknown must be a ParameterisedModel, got Particle"),
        ((unknown, method, record, 1), r"smc2\.particles must be a whole number of at least 2"),
    ):
        with pytest.raises(ValueError, match=message):
            smc2(*values)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"simulate\.model must be a StateSpaceModel, got Param"):
        simulate(unknown, record, 0)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match=r"calibration\.draws must be a whole number"):
        simulation_based_calibration(unknown, record, print, draws=0)  # type: ignore[arg-type]
