"""Particle filters: unbiased where they say they are exact, at the rate 1/sqrt N, and every run on its own."""

import dataclasses
import math
from itertools import product
from typing import Any

import numpy as np
import oracles
import pytest
import torch
from checkout import ROOT
from filter_laws import check_lost_alone, check_own, check_wrapped
from model_cases import Fragile, measurements
from particle_cases import CASES, WALK, WALK_Y, Drifting, Spiky, belief, benes_case, singular_case
from pyro.distributions import Uniform
from scipy import stats
from torch import Tensor
from torch.distributions import Distribution, Independent

from pfbench.core import PhiloxStream, RandomStream, Record
from pfbench.filter import (
    BayesWeightUpdate,
    BootstrapProposal,
    EssResampler,
    GaussianPredictionProposal,
    GaussianResampler,
    LookAheadWeights,
    MetropolisHastings,
    Multinomial,
    NoiseFlowKernel,
    ParticleFilter,
    PosteriorWeights,
    PowerLikelihoodUpdate,
    ProposalSample,
    RegularisedResampler,
    ResamplingScheme,
    Residual,
    Stratified,
    Systematic,
    run_filter,
)
from pfbench.filter.belief import (
    ParticleBelief,
    count_distinct_ancestors,
    ess,
    normalise_log_weights,
)
from pfbench.filter.exactness import has_evidence
from pfbench.kernels import dispatch
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
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation
from pfbench.testing import check_convergence, check_evidence, filter_record, reference_moments

SCHEMES: list[ResamplingScheme] = [
    Systematic(),
    Stratified(),
    Multinomial(),
    Residual(),
]


PREFERENCES = {
    "weights": PosteriorWeights(),
    "look ahead": LookAheadWeights(),
    "look ahead, tempered": LookAheadWeights(0.5),
}


def test_the_benes_closed_form_agrees_with_a_grid() -> None:
    """The oracle against another one, made from the transition density alone."""
    _, y, exact = benes_case()
    grid = np.linspace(-14, 14, 2801)
    matrix = (
        oracles.normal_density(grid[:, None], grid[None], math.sqrt(0.8))
        * np.cosh(grid[:, None])
        / np.cosh(grid[None])
    )
    first = oracles.normal_density(grid, 0.0, math.sqrt(0.8)) * np.cosh(grid) * math.exp(-0.4)

    def transition(t: int) -> np.ndarray:
        return np.tile(first[:, None], (1, len(grid))) if t == 0 else matrix * math.exp(-0.4)

    mean, variance, log_z = oracles.grid_filter(
        grid,
        np.ones_like(grid),
        transition,
        lambda t: np.log(oracles.normal_density(y[t].item(), grid, 1.0)),
        len(y),
    )
    assert log_z == pytest.approx(exact.log_evidence, abs=1e-8)
    assert mean[-1] == pytest.approx(exact.mean[0], abs=1e-8)
    assert variance[-1] + mean[-1] ** 2 == pytest.approx(exact.square[0], rel=1e-8)


# unbiasedness


@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda s: type(s).__name__)
def test_every_scheme_is_unbiased(scheme: ResamplingScheme, threshold: float) -> None:
    method = ParticleFilter(25, EssResampler(scheme, threshold))
    assert method.is_exact
    check_evidence(method, WALK, WALK_Y, reference_moments(WALK, WALK_Y))


@pytest.mark.parametrize("threshold", [0.5, 1.0])
@pytest.mark.parametrize("preference", ["look ahead", "look ahead, tempered"])
def test_the_auxiliary_filter_is_unbiased(preference: str, threshold: float) -> None:
    method = ParticleFilter(
        25, EssResampler(Systematic(), threshold), auxiliary_weights=PREFERENCES[preference]
    )
    check_evidence(method, WALK, WALK_Y, reference_moments(WALK, WALK_Y))


# Without tempering, the weights of the growth model have no bound: their standard error is no measure.
@pytest.mark.parametrize(
    ("case", "preference"),
    [pair for pair in product(CASES, PREFERENCES) if pair != ("growth", "look ahead")],
)
def test_unbiased_on_models_with_an_answer(case: str, preference: str) -> None:
    model, y, exact = CASES[case]()
    check_evidence(
        ParticleFilter(
            60, EssResampler(Systematic(), 0.7), auxiliary_weights=PREFERENCES[preference]
        ),
        model,
        y,
        exact,
    )


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_unbiased_with_narrow_error_bars(case: str) -> None:
    model, y, exact = CASES[case]()
    check_evidence(ParticleFilter(400, EssResampler(Residual(), 0.5)), model, y, exact, runs=4000)


@dataclasses.dataclass(frozen=True)
class Tilted:
    """A proposal that draws the noise from a wider and shifted normal law, and says so in its ratio, times `sign`."""

    sign: float = 1.0
    is_exact = True

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        z = draws.normal("noise", belief.x.shape[1], model.noise_dim)
        w = 0.3 + 1.3 * z
        log_ratio = (0.5 * z * z - 0.5 * w * w + math.log(1.3)).sum(-1)
        return ProposalSample(
            model.propagate(belief.x, record.u, w), self.sign * log_ratio, belief.memory
        )


def test_any_proposal_is_corrected_by_its_ratio() -> None:
    exact = reference_moments(WALK, WALK_Y)
    check_evidence(ParticleFilter(40, proposal=Tilted()), WALK, WALK_Y, exact)
    for sign in (-1.0, 0.0):
        with pytest.raises(AssertionError, match=r"\+-"):
            check_evidence(
                ParticleFilter(40, proposal=Tilted(sign)), WALK, WALK_Y, exact, runs=8000
            )


@pytest.mark.parametrize(
    ("kind", "law"), [(Drifting, stats.norm(0.4, 1.5)), (Spiky, stats.laplace(0.4, 1.5))]
)
def test_noise_follows_the_model_s_law(kind: type[LinearGaussian], law: Any) -> None:
    model = kind([[0.0]], [[1.0]], [[1.0]], [1.0], [0.0], [1.0])
    cloud = ParticleFilter(20_000).init(model, 2, PhiloxStream(1, torch.arange(2)))
    x = BootstrapProposal()(
        model, cloud, Record(torch.zeros(2, 1)), PhiloxStream(1, torch.arange(2)).at_step(1)
    ).x
    assert stats.kstest(x.numpy().ravel(), law.cdf).pvalue > 1e-3


def test_nile_evidence() -> None:
    y = torch.tensor(np.loadtxt(ROOT / "experiments" / "oracles" / "nile.csv", ndmin=2))
    model = local_level(math.sqrt(1470.0), math.sqrt(15100.0), 1000.0, math.sqrt(1000.0))
    estimate = filter_record(ParticleFilter(400), model, y, runs=200)
    ratio = torch.exp(estimate.log_evidence + 638.8133628).numpy()
    assert ratio.std() < 2.0
    assert abs(ratio.mean() - 1.0) < 4 * ratio.std() / math.sqrt(200)
    one = np.eye(1)
    exact = oracles.kalman(
        one, 1470.0 * one, one, 15100.0 * one, np.array([1000.0]), 1000.0 * one, y.numpy()
    )
    sd = np.sqrt(exact.covariance[:, 0, 0])
    z = (estimate.mean[..., 0].numpy().mean(0) - exact.mean[:, 0]) / sd
    # each run's mean is within a few 1/sqrt N of the exact one; the average of 200 within a few 1/sqrt(200 N)
    assert np.abs(z).max() < 10 / math.sqrt(200 * 400) + 10 / 400


# the tests above can fail


@dataclasses.dataclass(frozen=True)
class Careless:
    """A resampler with a planted mistake in the weights it hands on."""

    mistake: str
    is_exact = True

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        log_a: Tensor,
        n: Tensor,
        draws: RandomStream,
    ) -> tuple[ParticleBelief, Tensor]:
        fresh, hit = EssResampler(Systematic(), 0.8)(model, belief, log_a, n, draws)
        flat = torch.full_like(fresh.log_w, -math.log(fresh.log_w.shape[1]))
        if self.mistake == "preference not corrected":
            return fresh._replace(log_w=torch.where(hit[:, None], flat, fresh.log_w)), hit
        if self.mistake == "weights not reset":
            return fresh._replace(log_w=torch.where(hit[:, None], belief.log_w, fresh.log_w)), hit
        if self.mistake == "weights reset in every run":
            return fresh._replace(log_w=flat), hit
        return fresh._replace(x=torch.where(hit[:, None, None], fresh.x.flip(1), fresh.x)), hit


@pytest.mark.parametrize(
    "mistake", ["preference not corrected", "weights not reset", "weights reset in every run"]
)
def test_the_test_of_unbiasedness_sees_mistakes(mistake: str) -> None:
    method = ParticleFilter(25, Careless(mistake), auxiliary_weights=LookAheadWeights())
    with pytest.raises(AssertionError, match=r"\+-"):
        check_evidence(method, WALK, WALK_Y, reference_moments(WALK, WALK_Y))


def test_an_exchange_of_equal_particles_is_no_mistake() -> None:
    method = ParticleFilter(25, Careless("order"))
    check_evidence(method, WALK, WALK_Y, reference_moments(WALK, WALK_Y))


@pytest.mark.parametrize("shrink", [False, True])
def test_regularisation_says_that_it_is_not_exact_and_is_right(shrink: bool) -> None:
    # of so few particles that a shrunk kernel, which only its shape makes wrong, is seen too
    method = ParticleFilter(
        10, RegularisedResampler(EssResampler(Systematic(), 1.0), shrink_to_mean=shrink)
    )
    assert not method.is_exact
    with pytest.raises(AssertionError, match=r"\+-"):
        check_evidence(method, WALK, WALK_Y, reference_moments(WALK, WALK_Y), runs=20_000)


def test_regularisation_is_harmless_with_many_particles() -> None:
    """The kernel's h^2 is 0.01 at N = 2000, of which no more than a few sums up; the mean moves by far less than a spread."""
    exact = reference_moments(WALK, WALK_Y)
    estimate = filter_record(
        ParticleFilter(2000, RegularisedResampler(EssResampler(Systematic()))),
        WALK,
        WALK_Y,
        runs=50,
    )
    off = (estimate.mean[:, -1].numpy() - exact.mean) / np.sqrt(exact.square - exact.mean**2)
    assert np.abs(off.mean(0)).max() < 0.05


# the rate


@pytest.mark.slow
def test_errors_fall_with_the_root_of_the_number_of_particles() -> None:
    check = check_convergence(ParticleFilter(128), (128, 512, 2048, 8192), runs=150)
    assert check.standard_error < 0.02


@pytest.mark.slow
def test_same_error_law_as_pyro_s_filter() -> None:
    """Pyro resamples systematically below ESS = N/2 too, but at the end of a step: almost the same law of errors."""
    import pyro
    import pyro.distributions as dist
    from pyro.infer import SMCFilter

    n, runs = 300, 150
    y = WALK_Y.nan_to_num(2.0)

    class Walk:
        def init(self, state: dict, *args: Any) -> None:
            state["x"] = pyro.sample("x_init", dist.Normal(WALK.m0, WALK.l0.diagonal()).to_event(1))
            self.t = 0

        def step(self, state: dict, value: Tensor | None = None) -> None:
            self.t += 1
            law = dist.MultivariateNormal(state["x"] @ WALK.f.mT, scale_tril=WALK.g)
            state["x"] = pyro.sample(f"x_{self.t}", law)
            pyro.sample(f"y_{self.t}", dist.Normal(state["x"][..., 0], WALK.r[0]), obs=value)

    class Guide(Walk):
        def init(self, state: dict, *args: Any) -> None:
            pyro.sample("x_init", dist.Normal(WALK.m0, WALK.l0.diagonal()).to_event(1))
            self.t = 0

        def step(self, state: dict, value: Tensor | None = None) -> None:
            self.t += 1
            pyro.sample(
                f"x_{self.t}", dist.MultivariateNormal(state["x"] @ WALK.f.mT, scale_tril=WALK.g)
            )

    exact, theirs = reference_moments(WALK, y), []
    with torch.random.fork_rng():
        for seed in range(runs):
            pyro.set_rng_seed(seed)
            smc = SMCFilter(
                Walk(), Guide(), num_particles=n, max_plate_nesting=0, ess_threshold=0.5
            )
            smc.init()
            for value in y[:, 0]:
                smc.step(value)
            theirs.append(smc.get_empirical()["x"].mean.numpy() - exact.mean)
    ours = filter_record(ParticleFilter(n), WALK, y, runs=runs).mean[:, -1].numpy() - exact.mean
    for component in range(2):
        a, b = ours[:, component], np.array(theirs)[:, component]
        assert stats.ks_2samp(a, b).pvalue > 1e-3
        for errors in (a, b):
            assert abs(errors.mean()) < 4 * errors.std() / math.sqrt(runs) + 2 / n


# what a step does


def test_the_first_cloud_has_the_moments_of_the_initial_law() -> None:
    model, _, _ = singular_case()
    x = (
        ParticleFilter(50_000)
        .init(model, 2, PhiloxStream(5, torch.arange(2)))
        .x.numpy()
        .reshape(-1, 3)
    )
    covariance = (model.l0 @ model.l0.mT).numpy()
    sd = np.sqrt(np.diag(covariance))
    assert np.all(np.abs(x.mean(0) - model.m0.numpy()) < 4 * sd / math.sqrt(len(x)))
    error = np.sqrt((np.outer(sd, sd) ** 2 + covariance**2) / len(x))
    assert np.all(np.abs(np.cov(x.T) - covariance) < 4.5 * error)


def test_estimates_are_weighted_moments() -> None:
    method = ParticleFilter(40, EssResampler(Systematic(), 0.0))
    seen = Record(torch.full((3, 1), 0.3, dtype=torch.float64))
    cloud, info = method.step(WALK, belief(WALK), seen, PhiloxStream(1, torch.arange(3)))
    for r in range(3):
        x, w = cloud.x[r].numpy(), np.exp(cloud.log_w[r].numpy())
        assert w.sum() == pytest.approx(1.0)
        mean, covariance = w @ x, np.cov(x.T, aweights=w, ddof=0)
        assert np.allclose(info.mean[r], mean)
        assert np.allclose(info.variance[r], np.diag(covariance))
        assert np.allclose(info.covariance()[r], covariance)
        assert float(info.trace["ess"][r]) == pytest.approx(1 / (w**2).sum())


@pytest.mark.parametrize("preference", PREFERENCES)
def test_a_step_that_sees_nothing_changes_no_weight(preference: str) -> None:
    before = belief(WALK)
    method = ParticleFilter(
        40, EssResampler(Systematic(), 0.0), auxiliary_weights=PREFERENCES[preference]
    )
    seen = Record(torch.full((3, 1), torch.nan, dtype=torch.float64))
    after, info = method.step(WALK, before, seen, PhiloxStream(1, torch.arange(3)))
    assert torch.allclose(after.log_w, before.log_w, atol=1e-14)
    assert torch.allclose(after.log_evidence, before.log_evidence, atol=1e-14)
    assert torch.allclose(info.trace["ess"], ess(before.log_w))
    assert not torch.equal(after.x, before.x)  # but time goes on


def test_resampling_is_told() -> None:
    method = ParticleFilter(40, EssResampler(Systematic(), 0.6))
    estimate = filter_record(method, WALK, WALK_Y, runs=50)
    assert estimate.trace["resampled"].dtype == torch.bool
    before = torch.cat(
        [torch.full((50, 1), 40.0, dtype=torch.float64), estimate.trace["ess"][:, :-1]], 1
    )
    assert torch.equal(estimate.trace["resampled"], before < 0.6 * 40)
    assert 0 < int(estimate.trace["resampled"].sum()) < estimate.trace["resampled"].numel()


@dataclasses.dataclass(frozen=True)
class Shift:
    """A move that shifts refreshed runs, to see where it stands in the step."""

    is_exact: bool = False
    required_history = None

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, hit: Tensor, draws: RandomStream
    ) -> tuple[ParticleBelief, Tensor]:
        return belief._replace(x=belief.x + 100.0 * hit[:, None, None]), 0.25 * hit.double()


def test_moves_come_after_the_refresh_and_before_the_proposal() -> None:
    seen, draws = (
        Record(torch.full((3, 1), torch.nan, dtype=torch.float64)),
        PhiloxStream(1, torch.arange(3)),
    )
    before = belief(WALK)
    before = before._replace(
        log_w=torch.cat([before.log_w[:2], torch.full((1, 40), -math.log(40)).double()])
    )
    plain = ParticleFilter(40, EssResampler(Systematic(), 0.9))
    still, _ = plain.step(WALK, before, seen, draws)
    moved, info = dataclasses.replace(plain, moves=(Shift(),)).step(WALK, before, seen, draws)
    assert info.trace["resampled"].tolist() == [True, True, False]
    shift = (torch.tensor([100.0, 100.0], dtype=torch.float64) @ WALK.f.mT).expand(40, -1)
    assert torch.allclose(moved.x[:2] - still.x[:2], shift)
    assert torch.equal(moved.x[2], still.x[2])
    assert info.trace["accepted_0"].tolist() == [0.25, 0.25, 0.0]
    assert not dataclasses.replace(plain, moves=(Shift(),)).is_exact
    assert dataclasses.replace(plain, moves=(Shift(is_exact=True),)).is_exact


def test_a_prediction_that_is_no_number_excludes_its_parent_alone() -> None:
    """As one that the measurement excludes; the other parents of the run keep their look-ahead."""
    before, seen = belief(WALK), Record(torch.full((3, 1), 0.3, dtype=torch.float64))
    failed, far = before.x.clone(), before.x.clone()
    failed[:, 0], far[:, 0] = torch.nan, 1e9
    log_a, expected = (LookAheadWeights()(WALK, before._replace(x=x), seen) for x in (failed, far))
    assert torch.equal(log_a, expected)
    assert not torch.allclose(log_a, before.log_w)


# one run, its neighbours, its past and its future

FILTERS: dict[str, ParticleFilter] = {
    **{type(s).__name__: ParticleFilter(50, EssResampler(s, 0.7)) for s in SCHEMES},
    "auxiliary": ParticleFilter(50, auxiliary_weights=LookAheadWeights()),
    "regularised": ParticleFilter(50, RegularisedResampler(EssResampler(Systematic()))),
    "shrunk": ParticleFilter(
        50, RegularisedResampler(EssResampler(Systematic(), 1.0), shrink_to_mean=True)
    ),
}
every_filter = pytest.mark.parametrize("method", FILTERS.values(), ids=FILTERS.keys())
every_toy = pytest.mark.parametrize(
    "model",
    [WALK, UnivariateGrowth(), StochasticVolatility(), Benes(), Pendulum(), Lorenz63()],
    ids=lambda m: type(m).__name__,
)


@every_filter
@every_toy
def test_a_run_cannot_feel_its_neighbours(method: ParticleFilter, model: StateSpaceModel) -> None:
    check_own(method, model, measurements(model), 1e-12)


@every_filter
def test_an_impossible_measurement_loses_its_run_alone(method: ParticleFilter) -> None:
    assert float(check_lost_alone(method, WALK, measurements(WALK)).log_evidence[1]) == -math.inf


@every_filter
def test_particles_that_have_become_nan_weigh_nothing(method: ParticleFilter) -> None:
    """One sick particle must not make the estimate of its run NaN: 0 * NaN is NaN."""
    model = Fragile(*(getattr(WALK, k) for k in ("f", "g", "h", "r", "m0", "l0")))
    estimate = filter_record(method, model, torch.zeros(6, 1, dtype=torch.float64), runs=40)
    assert not bool(estimate.lost.any())
    assert bool(torch.isfinite(estimate.mean).all())
    assert bool(torch.isfinite(estimate.variance).all())
    sick = filter_record(method, model, torch.full((6, 1), torch.nan, dtype=torch.float64), runs=40)
    assert bool(torch.isfinite(sick.mean[~sick.lost]).all())


class Boxed(LinearGaussian):
    """A walk that is seen within plus or minus a half: most of the particles are impossible."""

    def observation(self, x: Tensor, u: Any) -> Distribution:
        half = 0.5 * torch.ones_like(x[..., :1])
        return Independent(Uniform(x[..., :1] - half, x[..., :1] + half, validate_args=False), 1)


def test_a_look_ahead_that_finds_nothing_possible_falls_back_on_the_weights() -> None:
    """The quiet state of each particle may be impossible while its noisy children are not."""
    model = Boxed([[1.0]], [[2.0]], [[1.0]], [1.0], [0.0], [1e-3])
    y = torch.tensor([[3.0]], dtype=torch.float64)
    estimate = filter_record(
        ParticleFilter(200, EssResampler(Systematic(), 1.0), auxiliary_weights=LookAheadWeights()),
        model,
        y,
        runs=2000,
    )
    law = stats.norm(0.0, math.sqrt(4.0 + 1e-6))
    truth = law.cdf(3.5) - law.cdf(2.5)
    z = torch.exp(estimate.log_evidence).numpy()
    assert abs(z.mean() - truth) < 4 * z.std() / math.sqrt(len(z))


@pytest.mark.parametrize("moves", [(), (MetropolisHastings(NoiseFlowKernel(5), 3),)], ids=len)
def test_a_likelihood_to_a_power_is_that_of_larger_normal_errors(
    moves: tuple[MetropolisHastings, ...],
) -> None:
    """The oracle is the filter of a model whose covariance of the errors is multiplied: equal weights and moves."""
    steps = torch.randn(30, 1, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    y = steps.cumsum(0)
    power, plain = (
        filter_record(
            ParticleFilter(300, weight_update=update, moves=moves),
            linear_walk(1.0, 0.5, sd),
            y,
            runs=3,
        )
        for update, sd in ((PowerLikelihoodUpdate(4.0), 1.0), (BayesWeightUpdate(), 2.0))
    )
    torch.testing.assert_close(power.mean, plain.mean, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(power.trace["ess"], plain.trace["ess"], rtol=1e-9, atol=1e-9)
    assert PowerLikelihoodUpdate(1.0).is_exact
    assert not PowerLikelihoodUpdate(4.0).is_exact
    assert not has_evidence(ParticleFilter(9, weight_update=PowerLikelihoodUpdate(4.0)))
    with pytest.raises(ValueError, match=r"r_factor must be positive.*got 0"):
        PowerLikelihoodUpdate(0.0)


# angles, precision, start


def test_angles_that_cross_the_cut_change_nothing() -> None:
    check_wrapped(ParticleFilter(200))


@every_toy
def test_single_precision_is_close_to_double(model: StateSpaceModel) -> None:
    """Same draws; but a rounding may send a particle elsewhere at a resampling, so that runs agree in law only."""
    y, n, runs = measurements(model, 1)[0], 200, 300
    double = filter_record(ParticleFilter(n), model, y, runs=runs)
    single = filter_record(ParticleFilter(n), model.float(), y, runs=runs)
    model.double()
    assert single.mean.dtype == torch.float32
    assert single.log_evidence.dtype == torch.float64
    for a, b in (
        (single.mean[:, -1], double.mean[:, -1]),
        (single.log_evidence[:, None], double.log_evidence[:, None]),
    ):
        difference = (
            model.chart.subtract(a.double(), b)
            if a.shape[-1] == model.chart.size
            else a.double() - b
        )
        error = difference.std(0) / math.sqrt(runs)
        scale = b.std(0)
        assert torch.all(difference.mean(0).abs() < 4.5 * error + 1e-3 * scale)
        assert torch.all(difference.abs().median(0).values <= 2 * scale)


def test_a_start_for_each_filter_record() -> None:
    start = torch.tensor([[0.0, 0.0], [50.0, -1.0], [-7.0, 2.0]], dtype=torch.float64)
    y = torch.full((3, 5, 1), torch.nan, dtype=torch.float64)
    estimate = filter_record(ParticleFilter(4000), WALK, y, start=start)
    expected = start
    for t in range(5):
        expected = expected @ WALK.f.mT
        assert torch.all(
            (estimate.mean[:, t] - expected).abs() < 5 * (estimate.variance[:, t] / 4000).sqrt()
        )


def test_weights_of_particles_sum_to_one_in_both_precisions() -> None:
    log_w = 30 * PhiloxStream(1, torch.arange(4)).normal("w", 10_000, 1)[..., 0]
    for dtype in (torch.float32, torch.float64):
        assert torch.allclose(
            normalise_log_weights(log_w.to(dtype)).sum(-1).double(),
            torch.ones(4, dtype=torch.float64),
            atol=1e-5,
        )
    lonely = torch.full((1, 100), -torch.inf, dtype=torch.float64)
    lonely[0, 7] = 0.0
    assert float(ess(lonely)) == 1.0
    assert float(ess(torch.zeros(1, 100))) == pytest.approx(100.0)


@dataclasses.dataclass(frozen=True)
class Counting:
    """The model's own noise; it notes how many different particles it is sent on from, in each run."""

    different: list[list[int]]
    is_exact = True

    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        pairs = zip(belief.x, torch.isfinite(belief.log_w), strict=True)
        self.different.append([len(set(map(tuple, own[live].tolist()))) for own, live in pairs])
        return BootstrapProposal()(model, belief, record, draws)


@pytest.mark.parametrize("fused", [False, True])
@pytest.mark.parametrize("scheme", [Systematic(), Multinomial(), Stratified()])
@pytest.mark.parametrize("moving", [False, True])
def test_distinct_particles_are_counted(
    fused: bool, scheme: ResamplingScheme, moving: bool
) -> None:
    model = linear_walk(1.0, 0.3, 0.3)
    record = ModelSimulation(model, 8).draw(NominalNoise(), torch.arange(4), 5).record
    different: list[list[int]] = []
    moves = (MetropolisHastings(NoiseFlowKernel(), mcmc_steps=2),) if moving else ()
    method = ParticleFilter(40, EssResampler(scheme), moves=moves, proposal=Counting(different))
    with dispatch.use_kernels(fused):
        trace = run_filter(method, model, record, PhiloxStream(5, torch.arange(4))).trace
    assert bool(trace["resampled"].any())
    assert trace["unique" if moving else "ancestors"].T.tolist() == different
    assert ("unique" in trace) == moving
    if moving:
        assert bool((trace["unique"] >= trace["ancestors"]).all())
        assert bool((trace["unique"] > trace["ancestors"]).any())


def test_of_empty_slots_and_new_particles_no_ancestors_are_counted() -> None:
    copies = torch.tensor([[0, 0, 2, 3], [1, 1, 5, 1], [0, 2, 2, 3], [3, 2, 2, 3], [1, 1, 1, 1]])
    log_w = torch.zeros(5, 4, dtype=torch.float64)
    log_w[0, 2] = log_w[1, 3] = -torch.inf
    for count in (count_distinct_ancestors, dispatch.count_unique):
        assert count(copies, log_w).tolist() == [2, 2, 3, 2, 1]
    method = ParticleFilter(
        10, resampler=GaussianResampler(), proposal=GaussianPredictionProposal()
    )
    model = linear_walk(1.0, 0.3, 0.3)
    record = ModelSimulation(model, 2).draw(NominalNoise(), torch.arange(2), 5).record
    assert (
        "ancestors" not in run_filter(method, model, record, PhiloxStream(5, torch.arange(2))).trace
    )
