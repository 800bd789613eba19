"""Guided proposals: exact ratios, the Kalman filter where it applies, off switches, and the pitfalls that are known."""

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from filter_cases import EACH, method_of
from particle_cases import CASES, WALK, WALK_Y, Drifting, Spiky
from refusals import check_refused
from torch import Tensor
from torch.distributions import Independent, MultivariateNormal, Normal, StudentT

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    AdaptiveFactorGain,
    AdditiveTempering,
    AxisDegree3,
    BootstrapProposal,
    BoundedRatioGain,
    ConstrainedNoiseAdaptation,
    CountLimits,
    CubaturePoints,
    EssResampler,
    EssStepCount,
    FadingMemory,
    FilterResult,
    GaussianFilter,
    GuidedNoiseProposal,
    MarginalRatioCorrection,
    ParticleFilter,
    ParticleGuideProposal,
    PowerTempering,
    Proposal,
    RadialDegree3,
    RadialDegree5,
    ReconstructedProposal,
    SharedGuideProposal,
    SigmaPointLinearisation,
    SimplexDegree3,
    SobolPoints,
    SphericalRadialPoints,
    Systematic,
    TaylorLinearisation,
    TemperedPosterior,
    TemperedWeights,
    Tempering,
    UniformTempering,
    UnscentedPoints,
    run_filter,
)
from pfbench.filter.belief import ParticleBelief, ess, weighted_mean_cov
from pfbench.model import LinearGaussian, Lorenz63, Pendulum, StateSpaceModel, UnivariateGrowth
from pfbench.model.textbook import TimeIndexInputs
from pfbench.testing import check_evidence, check_independence, filter_record, reference_moments

EKF, UKF, CKF = (
    GaussianFilter(TaylorLinearisation()),
    GaussianFilter(SigmaPointLinearisation(UnscentedPoints())),
    GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
)
MSSR = SigmaPointLinearisation(SphericalRadialPoints(SimplexDegree3(), RadialDegree5()))
COFM = GaussianFilter(
    MSSR, (FadingMemory(), ConstrainedNoiseAdaptation()), (AdaptiveFactorGain(), BoundedRatioGain())
)
ALWAYS = EssResampler(Systematic(), 1.0)


def lg5() -> tuple[LinearGaussian, Tensor]:
    """Five states, two measurements, 20 steps: A of spectral radius 0.95, Q = 0.3 I, R = 0.5 I; and one record of it [20, 2]."""
    rng = np.random.default_rng(5)
    a = rng.normal(size=(5, 5))
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
    h = rng.normal(size=(2, 5))
    model = LinearGaussian(
        a, math.sqrt(0.3) * np.eye(5), h, [math.sqrt(0.5)] * 2, np.zeros(5), np.ones(5)
    )
    x, rows = rng.normal(size=5), []
    for _ in range(20):
        x = a @ x + math.sqrt(0.3) * rng.normal(size=5)
        rows.append(h @ x + math.sqrt(0.5) * rng.normal(size=2))
    return model, torch.tensor(np.array(rows))


def tracker(sensors: int = 4) -> tuple[LinearGaussian, Tensor]:
    """Two states seen by more sensors than there are states, so that R can be told: some steps, the last ones in large noise."""
    rng = np.random.default_rng(1)
    h = rng.normal(size=(sensors, 2))
    model = LinearGaussian(
        [[1.0, 1.0], [0.0, 1.0]],
        [[0.5, 0.0], [0.2, 0.3]],
        h,
        [1.0] * sensors,
        [0.0, 0.0],
        [2.0, 1.0],
    )
    x, rows = np.array([1.0, 0.5]), []
    for t in range(12):
        x = np.array([x[0] + x[1], x[1]]) + 0.3 * rng.normal(size=2)
        rows.append(h @ x + (4.0 if t > 5 else 1.0) * rng.normal(size=sensors))
    return model, torch.tensor(np.array(rows))


def cloud_of(
    method: ParticleFilter, model: StateSpaceModel, runs: int, seed: int = 1
) -> tuple[ParticleBelief, PhiloxStream]:
    draws = PhiloxStream(seed, torch.arange(runs))
    return method.init(model, runs, draws.at_step(0)), draws.at_step(1)


def same(a: FilterResult, b: FilterResult) -> bool:
    return (
        torch.equal(a.mean, b.mean)
        and torch.equal(a.variance, b.variance)
        and torch.equal(a.log_evidence, b.log_evidence)
    )


# noise given parent and measurement


@pytest.mark.parametrize(
    ("case", "guide", "options"),
    [
        *((case, guide, {}) for case in CASES for guide in (EKF, UKF)),
        ("growth", CKF, {"shared_by_particles": True}),
        ("growth", CKF, {"covariance_factor": 1.6}),
        ("growth", CKF, {"shared_by_particles": True, "covariance_factor": 2.0}),
        ("growth", CKF, {"points": SobolPoints()}),
    ],
)
def test_guided_noise_is_unbiased(
    case: str, guide: GaussianFilter, options: dict[str, Any]
) -> None:
    model, y, exact = CASES[case]()
    proposal = GuidedNoiseProposal(guide, **options)
    method = ParticleFilter(40, EssResampler(Systematic(), 0.7), proposal=proposal)
    assert method.is_exact
    check_evidence(method, model, y, exact, runs=1000)


@pytest.mark.parametrize("kind", [Drifting, Spiky])
def test_the_ratio_of_any_law_of_noise_is_one_on_average(kind: type[LinearGaussian]) -> None:
    """E_q[p / q] = 1, and E_q[w p / q] is the mean of p. The wide proposal keeps the variance of p / q finite."""
    model = kind([[0.5]], [[1.0]], [[1.0]], [2.0], [0.0], [1.0])
    stage = GuidedNoiseProposal(EKF, covariance_factor=4.0)
    cloud, draws = cloud_of(ParticleFilter(100_000, proposal=stage), model, 2)
    _, log_ratio, _, w, _ = stage(
        model, cloud, Record(torch.full((2, 1), 1.5, dtype=torch.float64)), draws
    )
    assert w is not None
    for value, expected in ((log_ratio.exp(), 1.0), (log_ratio.exp() * w[..., 0], 0.4)):
        assert abs(value.mean() - expected) < 4.5 * value.std() / math.sqrt(value.numel())


@pytest.mark.parametrize("guide", [EKF, UKF, CKF], ids=["ekf", "ukf", "ckf"])
@pytest.mark.parametrize("shared", [False, True])
def test_guided_noise_is_optimal_on_linear_models(shared: bool, guide: GaussianFilter) -> None:
    """The weight is p(y | parent), whichever child was drawn."""
    model, _, _ = CASES["singular"]()
    assert isinstance(model, LinearGaussian)
    model.linear = shared
    stage = GuidedNoiseProposal(guide, defensive_fraction=0.0)
    cloud, draws = cloud_of(ParticleFilter(50, proposal=stage), model, 3)
    y = torch.tensor([[2.0, 1.0], [0.5, math.nan], [math.nan, math.nan]], dtype=torch.float64)
    x, log_ratio, _, w, _ = stage(model, cloud, Record(y), draws)
    total = log_ratio + model.log_likelihood(y, x, ())
    s = model.h @ model.g @ (model.h @ model.g).mT + torch.diag(model.r**2)
    y_hat = cloud.x @ (model.h @ model.f).mT
    both = MultivariateNormal(y_hat[0], s).log_prob(y[0])
    first = Normal(y_hat[1, :, 0], s[0, 0].sqrt()).log_prob(y[1, 0])
    torch.testing.assert_close(
        total, torch.stack([both, first, torch.zeros_like(first)]), rtol=0, atol=1e-10
    )
    assert w is not None
    torch.testing.assert_close(x, model.propagate(cloud.x, (), w))
    torch.testing.assert_close(
        w[2], draws.normal("guide", 50, 1)[2]
    )  # nothing seen: the model's own noise


@pytest.mark.parametrize(("noise", "gain"), [(0.01, 1.0), (1.0, 1.2), (6.0, 3.0)])
def test_guiding_the_noise_gains_what_the_noise_can_learn_and_no_more(
    noise: float, gain: float
) -> None:
    """ESS / N of a large normal cloud in closed form: E[w]^2 / E[w^2] of w = N(y; z, S), z ~ N(mu, B).

    Bootstrap weighs children, S = R and B = H P- H'; the optimal proposal weighs parents, S = R + H Q H' and B = H F P F' H'.
    Where one step's noise hardly moves what is seen the two are the same, whatever the proposal.
    """
    model = LinearGaussian(
        [[1.0, 1.0], [0.0, 1.0]],
        [[0.5 * noise], [noise]],
        [[1.0, 0.0]],
        [0.7],
        [0.0, 0.5],
        [1.0, 1.0],
    )
    y, n = 1.5, 20_000
    f, g, h = (getattr(model, k).numpy() for k in ("f", "g", "h"))
    moved, stirred, r = (h @ f @ f.T @ h.T).item(), (h @ g @ g.T @ h.T).item(), 0.7**2
    found = {}
    for proposal, s, b in (
        (BootstrapProposal(), r, moved + stirred),
        (GuidedNoiseProposal(EKF, defensive_fraction=0.0), r + stirred, moved),
    ):
        once = Normal(0.5, math.sqrt(s + b)).log_prob(torch.tensor(y)).item()
        twice = Normal(0.5, math.sqrt(s / 2 + b)).log_prob(torch.tensor(y)).item() - 0.5 * math.log(
            4 * math.pi * s
        )
        estimate = filter_record(
            ParticleFilter(n, proposal=proposal),
            model,
            torch.tensor([[y]], dtype=torch.float64),
            runs=4,
        )
        found[type(proposal)] = float(estimate.trace["ess"].mean()) / n
        assert found[type(proposal)] == pytest.approx(math.exp(2 * once - twice), rel=0.03)
    more = found[GuidedNoiseProposal] / found[BootstrapProposal]
    assert more > gain if gain > 1.0 else more == pytest.approx(1.0, abs=0.01)


def test_nothing_is_guided_where_nothing_moves() -> None:
    model, y, _ = CASES["level seen at once"]()
    guided = filter_record(
        ParticleFilter(30, proposal=GuidedNoiseProposal(EKF)), model, y[:1], runs=4
    )
    plain = filter_record(ParticleFilter(30), model, y[:1], runs=4)
    torch.testing.assert_close(guided.log_evidence, plain.log_evidence)


def test_a_guide_without_a_root_proposes_from_the_prior() -> None:
    """A measurement law so wrong that it has no covariance must not make a particle's ratio anything but p / q."""

    class Broken(UnivariateGrowth):
        def observation(self, x: Tensor, u: Any) -> Any:
            law: Any = super().observation(x, u)
            return Independent(
                Normal(law.mean, torch.where(law.mean > 1.0, torch.nan, 4.0), validate_args=False),
                1,
            )

    stage = GuidedNoiseProposal(EKF, defensive_fraction=0.0)
    cloud, draws = cloud_of(ParticleFilter(50, proposal=stage), Broken(), 2)
    sent = stage(
        Broken(),
        cloud,
        Record(torch.ones(2, 1, dtype=torch.float64), TimeIndexInputs(torch.ones(1))),
        draws,
    )
    assert sent.w is not None
    own = sent.w == draws.normal("guide", 50, 1)
    assert own.any()
    assert torch.isfinite(sent.log_ratio).all()
    assert (sent.log_ratio[own[..., 0]] == 0.0).all()


@pytest.mark.parametrize(
    "guide",
    [
        COFM,
        replace(EKF, iterations=2),
        GaussianFilter(MSSR, gain_adaptations=(AdaptiveFactorGain(),)),
    ],
)
def test_guided_noise_refuses_what_it_would_ignore(guide: GaussianFilter) -> None:
    check_refused(
        [("Remove adaptations, gains and iterations", lambda: GuidedNoiseProposal(guide))],
        remedy=False,
    )


# one guide for the cloud


def gaussian(
    method: GaussianFilter, model: StateSpaceModel, y: Tensor, runs: int = 3, **options: Any
) -> FilterResult:
    draws = PhiloxStream(1, torch.arange(runs))
    return run_filter(method, model, Record(y.expand(runs, -1, -1), *options.values()), draws)


@pytest.mark.parametrize("case", ["singular", "level seen at once"])
def test_guided_is_the_kalman_filter_on_linear_models(case: str) -> None:
    """All weights are equal, every step's evidence is exact, and matched draws have Kalman's mean and covariance."""
    model, y, exact = CASES[case]()
    estimate = filter_record(
        ParticleFilter(20, ALWAYS, proposal=SharedGuideProposal(CKF, match_moments=True)),
        model,
        y,
        runs=3,
    )
    variance = torch.tensor(exact.square - exact.mean**2)
    torch.testing.assert_close(
        estimate.mean[:, -1], torch.tensor(exact.mean).expand(3, -1), rtol=0, atol=1e-9
    )
    torch.testing.assert_close(estimate.variance[:, -1], variance.expand(3, -1), rtol=0, atol=1e-9)
    torch.testing.assert_close(
        estimate.log_evidence,
        torch.full((3,), exact.log_evidence, dtype=torch.float64),
        rtol=0,
        atol=1e-9,
    )
    assert (estimate.trace["ess"] - 20.0).abs().max() < 1e-8


def test_the_guide_may_doubt_its_noise_and_the_weights_stay_equal() -> None:
    model, y = tracker()
    own = gaussian(COFM, model, y)
    guided = filter_record(
        ParticleFilter(40, ALWAYS, proposal=SharedGuideProposal(COFM, match_moments=True)),
        model,
        y,
        runs=3,
    )
    assert own.trace["r"].max() > 2.0  # or the test would be of nothing
    torch.testing.assert_close(guided.mean, own.mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(guided.log_evidence, own.log_evidence, rtol=0, atol=1e-8)
    assert (guided.trace["ess"] - 40.0).abs().max() < 1e-7
    doubted = filter_record(
        ParticleFilter(
            40, ALWAYS, proposal=SharedGuideProposal(COFM, "nominal", match_moments=True)
        ),
        model,
        y,
        runs=3,
    )
    assert doubted.trace["ess"].min() < 20.0


def test_the_nominal_target_has_the_model_s_evidence_at_the_first_step() -> None:
    """With a guide that doubts its noise, E[Z_hat] is p(y) of the model as it is, and not of the model as adapted."""
    model, y = tracker()
    y = 6.0 * y[:1]
    exact = reference_moments(model, y)
    estimate = filter_record(
        ParticleFilter(200, proposal=SharedGuideProposal(COFM, "nominal")), model, y, runs=1000
    )
    ratio = torch.exp(estimate.log_evidence - exact.log_evidence)
    assert abs(ratio.mean() - 1.0) < 4.5 * ratio.std() / math.sqrt(1000)
    adapted = filter_record(
        ParticleFilter(200, proposal=SharedGuideProposal(COFM)), model, y, runs=2
    )
    assert abs(adapted.log_evidence[0] - exact.log_evidence) > 0.5


@pytest.mark.parametrize("target", ["adapted", "nominal"])
@pytest.mark.parametrize("model", [Lorenz63(), Pendulum()], ids=["lorenz", "pendulum"])
def test_the_ratio_is_that_of_the_densities(model: StateSpaceModel, target: Any) -> None:
    """Against torch's densities, on a nonlinear model, after a step that has given the guide something to doubt."""
    dy = 3 if isinstance(model, Lorenz63) else 1
    doubts = FadingMemory(1.3), ConstrainedNoiseAdaptation(0.9, deadband=10.0)
    guide = replace(COFM, noise_adaptations=doubts, gain_adaptations=(AdaptiveFactorGain(0.5),))
    stage = SharedGuideProposal(guide, target, covariance_factor=1.7)
    method = ParticleFilter(30, ALWAYS, proposal=stage)
    cloud, draws = cloud_of(method, model, 2)
    seen = Record(torch.full((2, dy), 9.0 if dy == 3 else 1.4, dtype=torch.float64))
    cloud, _ = method.step(model, cloud, seen, draws)
    x, log_ratio, *_ = stage(model, cloud, seen, draws.at_step(2))
    before = stage._before(model, cloud, seen, draws)
    new, plain = (
        guide.advance(model, before, seen),
        GaussianFilter(guide.linearisation).advance(model, before, seen),
    )

    def density(centre: Tensor, root: Tensor, scale: float = 1.0) -> Tensor:
        difference = model.chart.subtract(x, centre.unsqueeze(1))
        law = MultivariateNormal(
            torch.zeros_like(centre).unsqueeze(1), scale * (root @ root.mT).unsqueeze(1)
        )
        return law.log_prob(difference)

    prior = density(new.prior, (new if target == "adapted" else plain).prior_root)
    likelihood = model.log_likelihood(seen.y, x, ())
    if target == "adapted":
        law: Any = model.observation(x, ())
        likelihood = MultivariateNormal(law.mean, new.innovation.noise.unsqueeze(1)).log_prob(
            seen.y.unsqueeze(1)
        )
        assert (new.innovation.noise > 1.2 * new.innovation.nominal).any()
    expected = prior + likelihood - density(new.mean, new.root, 1.7) - math.log(30)
    got = log_ratio + cloud.log_w + model.log_likelihood(seen.y, x, ())
    # a particle more than half a turn from x- or x+ has no one difference to them: what it was drawn with cannot be seen
    tangent = model.chart.subtract(x, new.prior.unsqueeze(1)) - model.chart.subtract(
        x, new.mean.unsqueeze(1)
    )
    one = (tangent - model.chart.subtract(new.mean, new.prior).unsqueeze(1)).abs().amax(-1) < 1.0
    assert one.sum() >= 58
    torch.testing.assert_close(got[one], expected[one], rtol=0, atol=1e-7)


def test_the_guide_starts_where_the_record_starts() -> None:
    model, y = WALK, WALK_Y
    start = torch.tensor([[5.0, 1.0], [-3.0, 2.0]], dtype=torch.float64)
    spread = torch.tensor([[[0.5, 0.0], [0.1, 0.2]], [[3.0, 0.0], [0.0, 1.0]]], dtype=torch.float64)
    record = Record(y.expand(2, -1, -1), (), start, spread)
    draws = PhiloxStream(1, torch.arange(2))
    own = run_filter(CKF, model, record, draws)
    guided = run_filter(
        ParticleFilter(10, ALWAYS, proposal=SharedGuideProposal(CKF, match_moments=True)),
        model,
        record,
        draws,
    )
    torch.testing.assert_close(guided.mean, own.mean, rtol=0, atol=1e-9)
    torch.testing.assert_close(guided.log_evidence, own.log_evidence, rtol=0, atol=1e-9)
    assert abs(own.mean[0] - own.mean[1]).max() > 0.1
    first = Record(y[0].expand(2, -1), (), start, spread)
    each = ParticleFilter(10, ALWAYS, proposal=ParticleGuideProposal(CKF))
    with pytest.warns(UserWarning, match="N times"):
        cloud, _ = each.step(
            model, each.init(model, 2, draws.at_step(0), start, spread), first, draws.at_step(1)
        )
    alone = CKF.step(
        model, CKF.init(model, 2, draws.at_step(0), start, spread), first, draws.at_step(1)
    )[0]
    torch.testing.assert_close(
        cloud.memory["guide.covariance"], alone.covariance[:, None].expand(-1, 10, -1, -1)
    )


def test_a_run_s_guide_does_not_know_of_the_others() -> None:
    model, y = tracker()
    stages = EssStepCount(5, 0.5, CountLimits(10, 30, 20)), TemperedWeights()
    guided = SharedGuideProposal(COFM, "nominal")
    many = torch.stack([y, y + 1.0, 2.0 * y])
    check_independence(ParticleFilter(30, ALWAYS, *stages, proposal=guided), model, many, 1e-6)


def test_a_run_whose_guide_fails_is_lost_and_counted() -> None:
    spread = torch.eye(2, dtype=torch.float64).repeat(3, 1, 1)
    spread[1] = torch.nan
    method = ParticleFilter(20, ALWAYS, proposal=SharedGuideProposal(COFM))
    record = Record(WALK_Y.expand(3, -1, -1), (), torch.zeros(3, 2, dtype=torch.float64), spread)
    estimate = run_filter(method, WALK, record, PhiloxStream(1, torch.arange(3)))
    assert estimate.lost.tolist() == [False, True, False]
    assert torch.isnan(estimate.mean[1]).all()
    assert torch.isfinite(estimate.mean[[0, 2]]).all()


def test_an_adapted_noise_needs_a_normal_law() -> None:
    class Heavy(LinearGaussian):
        def observation(self, x: Tensor, u: Any) -> Any:
            return Independent(StudentT(4.0, x @ self.h.mT, self.r.expand(*x.shape[:2], -1)), 1)

    linear, y = tracker()
    model = Heavy(linear.f, linear.g, linear.h, linear.r, linear.m0, [2.0, 1.0])
    check_refused(
        [
            (
                "Choose weight_model=nominal",
                lambda: filter_record(
                    ParticleFilter(20, proposal=SharedGuideProposal(COFM)), model, y, runs=2
                ),
            )
        ],
        remedy=False,
    )
    for stage in (
        SharedGuideProposal(COFM, "nominal"),
        SharedGuideProposal(replace(COFM, noise_adaptations=(FadingMemory(1.1),))),
    ):
        assert not filter_record(ParticleFilter(20, proposal=stage), model, y, runs=2).lost.any()


# off switches: the same random stream, the same numbers


def test_off_switches_are_exact() -> None:
    model, y = UnivariateGrowth(), CASES["growth"]()[1]
    clock = TimeIndexInputs(torch.arange(1.0, 7.0, dtype=torch.float64)[None])

    def estimate(guide: GaussianFilter, **stages: Any) -> FilterResult:
        return filter_record(
            ParticleFilter(60, ALWAYS, proposal=SharedGuideProposal(guide), **stages),
            model,
            y,
            runs=5,
            u=clock,
        )

    plain = estimate(GaussianFilter(MSSR))
    assert same(
        plain,
        estimate(
            GaussianFilter(MSSR),
            particle_count=EssStepCount(0, 0.5, CountLimits(10, 60, 60)),
            auxiliary_weights=TemperedWeights(PowerTempering(0.0)),
        ),
    )
    for form in (PowerTempering(0.0), AdditiveTempering(0.0), UniformTempering(0.0)):
        assert same(plain, estimate(GaussianFilter(MSSR), weight_update=TemperedPosterior(form)))
    off = (
        (FadingMemory(1.0), ConstrainedNoiseAdaptation(max_r_factor=1.0, max_q_factor=1.0)),
        (AdaptiveFactorGain(math.inf), BoundedRatioGain(math.inf)),
    )
    assert same(plain, estimate(GaussianFilter(MSSR, *off)))
    assert same(
        estimate(CKF),
        estimate(
            GaussianFilter(
                SigmaPointLinearisation(SphericalRadialPoints(AxisDegree3(), RadialDegree3()))
            )
        ),
    )
    assert not same(plain, estimate(CKF))
    assert not same(plain, estimate(COFM))


def test_entropy_does_nothing_where_draws_have_no_parents() -> None:
    """Honest weights, one guide for the cloud: what is resampled is forgotten. Flattened weights do change the estimate."""
    model, y = tracker()

    def estimate(**stages: Any) -> FilterResult:
        return filter_record(
            ParticleFilter(60, ALWAYS, proposal=SharedGuideProposal(COFM, "nominal"), **stages),
            model,
            y,
            runs=4,
        )

    plain, spared = estimate(), estimate(auxiliary_weights=TemperedWeights(PowerTempering(1.0)))
    torch.testing.assert_close(spared.mean, plain.mean, rtol=0, atol=1e-10)
    torch.testing.assert_close(spared.log_evidence, plain.log_evidence, rtol=0, atol=1e-10)
    assert (
        abs(estimate(weight_update=TemperedPosterior(PowerTempering(1.0))).mean - plain.mean).max()
        > 0.05
    )


def test_a_guide_starts_where_the_record_says_inside_another_proposal_too() -> None:
    """Of a linear-Gaussian model, matched particles have the guide's moments, and a correction that keeps all changes nothing."""
    start = torch.tensor([[1.0, -2.0], [4.0, 0.5]], dtype=torch.float64)
    spread = torch.tensor([[[0.5, 0.0], [0.2, 0.3]], [[2.0, 0.0], [0.0, 1.0]]], dtype=torch.float64)
    record, draws = (
        Record(WALK_Y.expand(2, -1, -1), start=start, spread=spread),
        PhiloxStream(1, torch.arange(2)),
    )
    own = run_filter(EKF, WALK, record, draws)
    guided = SharedGuideProposal(EKF, match_moments=True)
    for proposal in (
        guided,
        ReconstructedProposal(guided, weight_correction=MarginalRatioCorrection(1.0)),
    ):
        found = run_filter(ParticleFilter(50, ALWAYS, proposal=proposal), WALK, record, draws)
        torch.testing.assert_close(found.mean, own.mean, rtol=0, atol=1e-9)
        torch.testing.assert_close(found.log_evidence, own.log_evidence, rtol=0, atol=1e-9)


# evidence, honest and printed


LG5, LG5_Y = lg5()
FORMS = {"temper": PowerTempering(), "additive": AdditiveTempering(), "mix": UniformTempering()}


def evidence(method: ParticleFilter, runs: int, y: Tensor = LG5_Y) -> tuple[float, float]:
    """Mean of Z / Z_exact and its standard error."""
    ratio = torch.exp(
        filter_record(method, LG5, y, runs=runs).log_evidence
        - reference_moments(LG5, y).log_evidence
    )
    return float(ratio.mean()), float(ratio.std()) / math.sqrt(runs)


SCOPES: dict[str, Proposal] = {
    "bootstrap": BootstrapProposal(),
    "conditional": GuidedNoiseProposal(CKF),
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("scope", SCOPES)
def test_evidence_with_entropy_and_a_changing_number_is_unbiased(scope: str, form: str) -> None:
    method = ParticleFilter(
        80,
        ALWAYS,
        EssStepCount(10, 0.5, CountLimits(40, 80, 60)),
        TemperedWeights(FORMS[form]),
        proposal=SCOPES[scope],
    )
    assert method.is_exact
    mean, error = evidence(method, 1000, LG5_Y[:6])
    assert abs(mean - 1.0) < 4.0 * error
    assert error < 0.1


@pytest.mark.slow
@pytest.mark.parametrize("adaptive", [False, True])
@pytest.mark.parametrize("strength", [0.0, 0.5])
@pytest.mark.parametrize("scope", SCOPES)
def test_evidence_of_the_whole_record(scope: str, strength: float, adaptive: bool) -> None:
    method = ParticleFilter(
        75,
        ALWAYS,
        auxiliary_weights=TemperedWeights(PowerTempering(strength)),
        proposal=SCOPES[scope],
    )
    if adaptive:
        method = replace(
            method, particles=100, particle_count=EssStepCount(5, 0.5, CountLimits(50, 100, 75))
        )
    mean, error = evidence(method, 600)
    assert abs(mean - 1.0) < 4.0 * error


@pytest.mark.parametrize(
    ("form", "surprise"),
    [
        (PowerTempering(0.5), 1.0),
        *(
            pytest.param(*case, marks=pytest.mark.slow)
            for case in ((UniformTempering(0.5), 1.0), (AdditiveTempering(0.5), 0.0))
        ),
    ],
)
def test_flattened_weights_are_biased(form: Tempering, surprise: float) -> None:
    """A guard against mixing the two in silence: the same data, weights flattened for good. The sign depends on the record.

    Additive flattens least; where every measurement is what is expected, the evidence scatters least and shows it.
    """
    method = ParticleFilter(
        150, ALWAYS, weight_update=TemperedPosterior(form), proposal=GuidedNoiseProposal(CKF)
    )
    assert not method.is_exact
    mean, error = evidence(method, 600, surprise * LG5_Y)
    assert abs(mean - 1.0) > 5.0 * error


# a guide for each particle


@pytest.mark.filterwarnings("ignore:ParticleGuideProposal")
@pytest.mark.parametrize("guide", [EKF, CKF], ids=["ekf", "ckf"])
def test_guided_particles_are_unbiased(guide: GaussianFilter) -> None:
    method = ParticleFilter(
        30, EssResampler(Systematic(), 0.7), proposal=ParticleGuideProposal(guide)
    )
    assert method.is_exact
    check_evidence(method, WALK, WALK_Y[:4], reference_moments(WALK, WALK_Y[:4]), runs=300)
    model, y, exact = CASES["growth"]()
    method = replace(method, proposal=ParticleGuideProposal(guide, covariance_factor=1.5))
    check_evidence(method, model, y[:3], exact_growth(y[:3]), runs=500)
    del exact


def exact_growth(y: Tensor) -> Any:
    """The first steps of the growth case, by a bootstrap filter of so many particles that its error is nothing here."""
    estimate = filter_record(
        ParticleFilter(200_000), UnivariateGrowth(measurement_sd=4.0), y, runs=4
    )
    mean, variance = estimate.mean[:, -1].mean(0).numpy(), estimate.variance[:, -1].mean(0).numpy()
    return type(CASES["growth"]()[2])(mean, variance + mean**2, float(estimate.log_evidence.mean()))


@pytest.mark.filterwarnings("ignore:ParticleGuideProposal")
@pytest.mark.parametrize("name", [name for name in EACH if not name.endswith("_printed")])
def test_a_guide_for_each_particle_gives_the_kalman_filter_on_a_linear_model(name: str) -> None:
    """Within Monte Carlo error at every step, without a factor on the covariance: the ratio corrects the guide.

    With 200 particles 9 % of them have weight, and the means are off by 0.15 standard deviations.
    """
    method = method_of(name)
    assert isinstance(method.proposal, ParticleGuideProposal)
    assert method.proposal.covariance_factor == 1.0
    method = replace(method, particles=2000)
    if name == "cofm_amssrcpf_each":
        method = replace(
            method, particle_count=EssStepCount(10, 0.5, CountLimits(1000, 2000, 1500))
        )
    runs, kalman = 50, filter_record(EKF, WALK, WALK_Y, runs=1)
    found = filter_record(method, WALK, WALK_Y, runs=runs)
    error, sd = found.mean - kalman.mean, kalman.variance.sqrt()
    se = error.std(0) / math.sqrt(runs)
    assert (error.mean(0).abs() < 4.0 * se).all()
    assert (se < 0.05 * sd[0]).all()
    ratio = torch.exp(found.log_evidence - kalman.log_evidence)
    assert abs(float(ratio.mean()) - 1.0) < 4.0 * float(ratio.std()) / math.sqrt(runs)


class Receivers(LinearGaussian):
    """The walk, measured by a receiver of its own in each run: standard deviations [R, 1]."""

    def __init__(self, sd: Tensor, is_dense: bool) -> None:
        super().__init__([[1.0]], [[1.0]], [[1.0]], [1.0], [0.0], [1.0])
        self.sd, self.is_dense = sd, is_dense

    def observation(self, x: Tensor, u: Any) -> Any:
        mean = x @ self.h.mT
        sd = self.sd.unsqueeze(1)  # of all particles of a run
        if self.is_dense:
            return MultivariateNormal(mean, scale_tril=sd.unsqueeze(-1).expand(*mean.shape, 1))
        return Independent(Normal(mean, sd.expand_as(mean)), 1)


@pytest.mark.filterwarnings("ignore:ParticleGuideProposal")
@pytest.mark.parametrize("is_dense", [False, True])
def test_guides_of_the_particles_of_a_run_have_the_noise_of_that_run(is_dense: bool) -> None:
    """Runs with receivers of their own are those of each receiver alone."""
    method = ParticleFilter(20, proposal=ParticleGuideProposal(CKF))
    sd, y = torch.tensor([[0.3], [1.0], [4.0]], dtype=WALK_Y.dtype), WALK_Y[:6].expand(3, -1, -1)
    together = run_filter(
        method, Receivers(sd, is_dense), Record(y), PhiloxStream(1, torch.arange(3), y.dtype)
    )
    for k in range(3):
        stream = PhiloxStream(1, torch.tensor([k]), y.dtype)
        alone = run_filter(method, Receivers(sd[k : k + 1], is_dense), Record(y[:1]), stream)
        torch.testing.assert_close(together.mean[k], alone.mean[0], rtol=1e-10, atol=1e-12)
        assert float(together.variance[k, -1]) > 0.0
    assert not torch.allclose(together.mean[0], together.mean[2], rtol=0.1)


def test_a_guide_for_each_particle_is_told_to_be_dear() -> None:
    with pytest.warns(UserWarning, match="N times the cost of SharedGuideProposal"):
        filter_record(
            ParticleFilter(10, proposal=ParticleGuideProposal(EKF)), WALK, WALK_Y[:1], runs=2
        )


@pytest.mark.filterwarnings("ignore:ParticleGuideProposal")
def test_a_singular_transition_is_refused_and_noise_takes_it() -> None:
    model, y, exact = CASES["singular"]()
    check_refused(
        [
            (
                "Choose GuidedNoise",
                lambda: filter_record(
                    ParticleFilter(20, proposal=ParticleGuideProposal(EKF)), model, y, runs=2
                ),
            )
        ],
        remedy=False,
    )
    estimate = filter_record(
        ParticleFilter(3000, proposal=GuidedNoiseProposal(EKF)), model, y, runs=20
    )
    sd = np.sqrt(exact.square - exact.mean**2)
    assert np.abs(estimate.mean[:, -1].mean(0).numpy() - exact.mean).max() < 0.05 * sd.max()


# pitfalls


def test_static_states_keep_one_ancestor_unless_they_are_redrawn() -> None:
    """A constant that is never moved: even optimal proposals leave a few values of it; a guide for the cloud draws new ones."""
    model = LinearGaussian(
        [[1.0, 1.0], [0.0, 1.0]], [[0.3], [0.0]], [[1.0, 0.0]], [1.0], [0.0, 0.5], [1.0, 1.0]
    )
    y = 0.5 * torch.arange(1.0, 61.0, dtype=torch.float64)[:, None]

    def values(proposal: Proposal) -> int:
        method = ParticleFilter(100, ALWAYS, proposal=proposal)
        cloud, draws = cloud_of(method, model, 1)
        for t in range(60):
            cloud, _ = method.step(model, cloud, Record(y[t : t + 1]), draws.at_step(t + 1))
        return len(cloud.x[0, :, 1].unique())

    assert values(GuidedNoiseProposal(EKF)) < 10
    assert values(SharedGuideProposal(EKF)) == 100


def test_going_on_from_moments_needs_matched_draws() -> None:
    """Without them the spread of the particles shrinks at each step; with them nothing is lost on a linear model."""
    model = LinearGaussian(
        np.eye(8), 1e-3 * np.eye(8), np.eye(8), [30.0] * 8, np.zeros(8), np.ones(8)
    )
    y = torch.zeros(30, 8, dtype=torch.float64)

    def spread(**options: Any) -> Tensor:
        return (
            filter_record(
                ParticleFilter(20, proposal=SharedGuideProposal(EKF, **options)), model, y, runs=4
            )
            .variance[:, -1]
            .log()
            .mean()
        )

    own = gaussian(EKF, model, y).variance[:, -1].log().mean()
    torch.testing.assert_close(
        spread(guide_state="moments", match_moments=True), own, rtol=0, atol=1e-8
    )
    assert spread(guide_state="moments") < own - 2.0
    assert abs(spread() - own) < 0.3


def test_on_a_linear_model_the_number_comes_to_rest_at_its_least() -> None:
    model, y = tracker()
    method = ParticleFilter(
        200, ALWAYS, EssStepCount(), TemperedWeights(), proposal=SharedGuideProposal(COFM)
    )
    estimate = filter_record(method, model, y, runs=5)
    # the number is decided at the start of each step, the first one included
    assert estimate.trace["ess"][0, :6].tolist() == pytest.approx(
        [140.0, 130.0, 120.0, 110.0, 100.0, 100.0]
    )
    own = gaussian(COFM, model, y, runs=5)
    off = (estimate.mean - own.mean).square().mean((0, 1)) / own.variance.mean((0, 1))
    assert (off < 3.0 / 100).all()  # sigma^2 / N, and a factor for its scatter over 60 values
    torch.testing.assert_close(
        estimate.log_evidence, own.log_evidence, rtol=1e-9, atol=1e-9
    )  # however many particles


def test_matching_needs_more_particles_than_states() -> None:
    check_refused(
        [
            (
                "Use more than 2 particles",
                lambda: filter_record(
                    ParticleFilter(2, proposal=SharedGuideProposal(EKF, match_moments=True)),
                    WALK,
                    WALK_Y,
                    runs=1,
                ),
            )
        ],
        remedy=False,
    )


def test_moments_of_empty_slots_are_nothing() -> None:
    """Slots without a particle have no part in the matched draws, nor in the estimate, nor in the evidence."""
    stage = SharedGuideProposal(EKF, match_moments=True)
    method = ParticleFilter(
        50, ALWAYS, EssStepCount(0, 0.5, CountLimits(10, 50, 20)), proposal=stage
    )
    cloud, draws = cloud_of(method, WALK, 2)
    seen = Record(WALK_Y[:1].expand(2, -1))
    cloud, info = method.step(WALK, cloud, seen, draws)
    assert (cloud.log_w > -torch.inf).sum(1).tolist() == [20, 20]
    assert not torch.isnan(cloud.log_w).any()
    assert ess(cloud.log_w).tolist() == pytest.approx([20.0, 20.0])
    own, _ = EKF.step(WALK, EKF.init(WALK, 2, draws), seen, draws)
    mean, covariance = weighted_mean_cov(WALK.chart, cloud)
    torch.testing.assert_close(mean, own.mean, rtol=0, atol=1e-10)
    torch.testing.assert_close(info.covariance(), own.covariance, rtol=0, atol=1e-10)
    torch.testing.assert_close(covariance, own.covariance, rtol=0, atol=1e-10)
    torch.testing.assert_close(cloud.log_evidence, own.log_evidence, rtol=0, atol=1e-10)
