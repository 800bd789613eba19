"""Observation distributions of particle and Gaussian filters: densities, missing components, existence of moments."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from pyro import distributions as dist
from refusals import check_refused
from scipy import stats
from scipy.spatial.transform import Rotation
from scipy.special import chdtri
from torch import Tensor
from torch.distributions import Distribution, Independent

from pfbench.core import (
    Chart,
    EuclideanBlock,
    PhiloxStream,
    QuaternionBlock,
    Record,
    linear_algebra as jacobian_module,
    wrap_angle,
)
from pfbench.core.chi_square import chi_square_limit
from pfbench.core.density import ChartNormal, has_finite_moments, normal_batch
from pfbench.core.linear_algebra import jacobian
from pfbench.filter import (
    CubaturePoints,
    EnsembleKalmanFilter,
    GaussianFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
    UnscentedPoints,
    run_filter,
)
from pfbench.filter.linearisation import compute_nis
from pfbench.model.base import StateSpaceModel, StaticModel
from pfbench.noise.base import NominalNoise
from pfbench.scenario.simulated import ModelSimulation


def f64(values: Any) -> Tensor:
    return torch.tensor(values, dtype=torch.float64)


class Walk(StateSpaceModel):
    """A random walk in two dimensions; subclasses state its observation distribution."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("sd", f64([0.5, 0.5]))
        self.names, self.units, self.groups, self.noise_dim = (
            ("a", "b"),
            ("", ""),
            {"state": (0, 1)},
            2,
        )

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.sd)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x + self.sd * w

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return LAWS["laplace"][0](x)


def normal_mixture(x: Tensor) -> Distribution:
    """Coordinates of one vector belong to one component."""
    parts = dist.Normal(x.unsqueeze(-2).expand(*x.shape[:-1], 2, 2), f64([[1.0], [5.0]])).to_event(
        1
    )
    return dist.MixtureSameFamily(dist.Categorical(f64([0.8, 0.2]).expand(*x.shape[:-1], 2)), parts)


def mixture_logpdf(y: np.ndarray, x: np.ndarray) -> np.ndarray:
    parts = [np.log(p) + stats.norm.logpdf(y, x, sd).sum(-1) for p, sd in ((0.8, 1.0), (0.2, 5.0))]
    return np.logaddexp(*parts)


def by_component(f: Any) -> Any:
    return lambda y, x: f(y, x).sum(-1)


LAWS: dict[str, tuple[Any, Any]] = {
    "laplace": (
        lambda x: dist.Laplace(x, torch.ones_like(x)).to_event(1),
        by_component(lambda y, x: stats.laplace.logpdf(y, x)),
    ),
    "cauchy": (
        lambda x: dist.Cauchy(x, torch.ones_like(x)).to_event(1),
        by_component(lambda y, x: stats.cauchy.logpdf(y, x)),
    ),
    "student 1": (
        lambda x: dist.StudentT(f64(1.0), x, torch.ones_like(x)).to_event(1),
        by_component(lambda y, x: stats.t.logpdf(y, 1.0, x)),
    ),
    "mixture": (normal_mixture, mixture_logpdf),
    "poisson": (
        lambda x: dist.Poisson(torch.exp(x)).to_event(1),
        by_component(lambda y, x: stats.poisson.logpmf(y, np.exp(x))),
    ),
    "negative binomial": (
        lambda x: dist.NegativeBinomial(3.0, logits=x).to_event(1),
        by_component(lambda y, x: stats.nbinom.logpmf(y, 3, 1 / (1 + np.exp(x)))),
    ),
    "exponential": (
        lambda x: dist.Exponential(torch.exp(x)).to_event(1),
        by_component(lambda y, x: stats.expon.logpdf(y, scale=np.exp(-x))),
    ),
}


def observed(name: str, kind: type[Walk] = Walk) -> Walk:
    class Observed(kind):  # type: ignore[misc, valid-type]
        has_counts = name in ("poisson", "negative binomial")

        def observation(self, x: Tensor, u: Any) -> Distribution:
            law: Distribution = LAWS[name][0](x)
            return law

    return Observed()


@pytest.mark.parametrize("name", LAWS)
def test_the_likelihood_is_the_density_of_the_observed_components(name: str) -> None:
    model, x = observed(name), PhiloxStream(1, torch.arange(3)).normal("x", 5, 2).requires_grad_()
    y = f64([[2.0, 1.0], [torch.nan, 3.0], [torch.nan, torch.nan]])
    value = model.log_likelihood(y, x, ())
    logpdf, states = LAWS[name][1], x.detach().numpy()
    assert np.allclose(value.detach()[0], logpdf(y[:1].numpy(), states[0]), rtol=1e-12)
    assert np.allclose(value.detach()[1], logpdf(y[1:2, 1:].numpy(), states[1][:, 1:]), rtol=1e-12)
    assert np.all(np.abs(value.detach()[2].numpy()) < 1e-12)
    (gradient,) = torch.autograd.grad(value.sum(), x)
    assert torch.isfinite(gradient).all()
    assert not gradient[2].any()


@pytest.mark.parametrize("name", LAWS)
def test_particle_filters_work_with_it(name: str) -> None:
    model = observed(name)
    episode = ModelSimulation(model, 8).draw(NominalNoise(), torch.arange(40), 2)
    y = episode.record.y.clone()
    y[0, 3, 0] = torch.nan
    estimate = run_filter(
        ParticleFilter(400), model, Record(y), PhiloxStream(1, torch.arange(40)),
        watch=lambda t, info: {"nis": info.nis()[0]} if info.nis else {},
    )  # fmt: skip
    assert torch.isfinite(estimate.log_evidence).all()
    error = estimate.mean - episode.truth["state"]
    z = (error.square() / estimate.variance).mean()
    assert 0.6 < float(z) < 1.6  # consistent: filter and episodes share the distribution
    assert torch.isfinite(estimate.trace["nis"]).all() == (name not in ("cauchy", "student 1"))


def test_the_innovation_of_a_distribution_without_moments_is_nan() -> None:
    model, x = observed("cauchy"), torch.zeros(2, 4, 2, dtype=torch.float64)
    record = Record(f64([[1.0, torch.nan], [2.0, 3.0]]))
    nis, count = compute_nis(
        model, x, torch.full((2, 4), -np.log(4.0), dtype=torch.float64), record
    )
    assert torch.isnan(nis).all()
    assert count.tolist() == [1, 2]


def test_a_joint_distribution_needs_complete_measurements() -> None:
    class Joint(Walk):
        def observation(self, x: Tensor, u: Any) -> Distribution:
            root = torch.eye(2, dtype=torch.float64).expand(*x.shape[:2], 2, 2)
            return dist.MultivariateStudentT(f64(4.0).expand(x.shape[:2]), x, root)

    model, x = Joint(), torch.zeros(2, 3, 2, dtype=torch.float64)
    value = model.log_likelihood(f64([[1.0, 2.0], [torch.nan, torch.nan]]), x, ())
    assert np.allclose(value[0], stats.multivariate_t.logpdf([1.0, 2.0], [0, 0], np.eye(2), 4))
    assert not value[1].any()
    check_refused(
        [
            (
                r"Joint\.observation must return Independent.*MultivariateStudentT",
                lambda: model.log_likelihood(f64([[1.0, torch.nan], [1.0, 2.0]]), x, ()),
            )
        ],
        remedy=False,
    )


class Angular(Walk):
    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        return wrap_angle(y - y_hat)


def test_a_residual_wraps_about_the_mean_and_needs_one() -> None:
    x, y = torch.zeros(1, 3, 2, dtype=torch.float64), f64([[0.3, -0.2]])
    model = observed("laplace", Angular)
    assert torch.allclose(
        model.log_likelihood(y, x, ()), model.log_likelihood(y + 2 * torch.pi, x, ())
    )
    for name in ("cauchy", "student 1"):
        with pytest.raises(
            ValueError, match=r"with a mean where the model defines residual, got (Cauchy|StudentT)"
        ):
            observed(name, Angular).log_likelihood(y, x, ())
    inner = observed("cauchy")  # a wrapper that passes a plain residual on defines none
    assert torch.equal(StaticModel(inner).log_likelihood(y, x, ()), inner.log_likelihood(y, x, ()))


GAUSSIAN = {
    "ekf": GaussianFilter(TaylorLinearisation()),
    "ukf": GaussianFilter(SigmaPointLinearisation(UnscentedPoints())),
    "ckf": GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
    "enkf": EnsembleKalmanFilter(20),
}


@pytest.mark.parametrize("method", GAUSSIAN.values(), ids=GAUSSIAN.keys())
@pytest.mark.parametrize("name", ["cauchy", "student 1", "laplace", "poisson"])
def test_gaussian_filters_need_a_mean_and_a_variance(method: Any, name: str) -> None:
    record, draws = (
        Record(torch.zeros(2, 3, 2, dtype=torch.float64)),
        PhiloxStream(1, torch.arange(2)),
    )
    if name in ("laplace", "poisson"):
        assert torch.isfinite(run_filter(method, observed(name), record, draws).mean).all()
        return
    check_refused(
        [
            (
                r"Observed\.observation must have a finite mean.*Use an EKF.* or a particle filter",
                lambda: run_filter(method, observed(name), record, draws),
            )
        ],
        remedy=False,
    )


def test_gaussian_filters_check_initial_and_noise_distributions_at_the_start() -> None:
    class Wild(Walk):
        @property
        def noise(self) -> Distribution:
            return dist.Cauchy(torch.zeros(2), torch.ones(2)).to_event(1)

    class Far(Walk):
        def initial(self, runs: int) -> Distribution:
            return dist.StudentT(2.0, torch.zeros(runs, 2), torch.ones(runs, 2)).to_event(1)

    for model, name in ((Wild(), "noise"), (Far(), "initial")):
        with pytest.raises(
            ValueError, match=rf"{type(model).__name__}\.{name} must have a finite mean"
        ):
            GaussianFilter(TaylorLinearisation()).init(model, 2, PhiloxStream(1, torch.arange(2)))


def test_moments_are_undefined_only_where_the_parameters_are_finite() -> None:
    """A lost run has NaN parameters; it must not be taken for a distribution without moments."""
    loc = f64([[0.0, torch.nan]])
    assert has_finite_moments(Independent(dist.Laplace(loc, f64(1.0), validate_args=False), 1))
    assert not has_finite_moments(Independent(dist.Cauchy(loc, f64(1.0), validate_args=False), 1))
    assert not has_finite_moments(
        Independent(dist.StudentT(f64(2.0), loc, f64(1.0), validate_args=False), 1)
    )
    assert has_finite_moments(normal_mixture(f64([[0.0, 1.0]])))


@pytest.mark.parametrize("sd", [0.2, 0.5])
def test_normal_densities_of_rotations_integrate_to_one(sd: float) -> None:
    """Over uniform rotations of scipy, about any mean; the volume of all rotations is 8 pi^2 in units of small vectors."""
    count = 200_000
    xyzw = Rotation.random(count, random_state=np.random.default_rng(1)).as_quat()
    q = f64(xyzw[:, [3, 0, 1, 2]])
    factor = torch.linalg.cholesky(sd**2 * (torch.eye(3) + 0.3).double())
    mean = f64([0.5, 0.5, -0.5, 0.5])
    density = ChartNormal(Chart((QuaternionBlock(),)), mean.expand(count, -1), factor)
    values = 8.0 * np.pi**2 * torch.exp(density.log_prob(q)).numpy()
    assert abs(values.mean() - 1.0) < 4.5 * values.std() / np.sqrt(count)
    assert values.std() / np.sqrt(count) < 0.03


def test_normal_density_in_a_flat_chart_is_that_of_scipy() -> None:
    factor = torch.tril(torch.arange(1.0, 10.0).reshape(3, 3).double())
    mean, x = f64([1.0, -2.0, 0.5]), f64([[0.3, 1.0, 2.0], [4.0, 0.0, -1.0]])
    density = ChartNormal(Chart((EuclideanBlock(3),)), mean.expand(2, -1), factor)
    expected = stats.multivariate_normal(mean.numpy(), (factor @ factor.mT).numpy()).logpdf(x)
    np.testing.assert_allclose(density.log_prob(x), expected, rtol=1e-12)


def test_draws_in_a_chart_have_its_mean_and_covariance() -> None:
    chart, count = Chart((EuclideanBlock(1), QuaternionBlock())), 100_000
    factor = 0.2 * torch.tril(torch.ones(4, 4)).double()
    density = ChartNormal(chart, f64([3.0, 0.6, 0.0, 0.8, 0.0]).expand(count, -1), factor)
    with torch.random.fork_rng():
        torch.manual_seed(1)
        d = chart.subtract(density.sample(), density.mean).numpy()
    covariance = density.covariance_matrix.numpy()
    assert (np.abs(d.mean(0)) < 4.5 * np.sqrt(np.diag(covariance) / count)).all()
    np.testing.assert_allclose(np.cov(d.T), covariance, atol=0.003)


R, D = 3, 4
AT = torch.linspace(0.3, 1.7, R * D, dtype=torch.float64).view(R, 1, D)


def bent(xi: Tensor) -> Tensor:
    """Two values of four numbers, a constant among what they are made of."""
    a = AT + xi
    return torch.stack([torch.sin(a[..., 0]) * a[..., 1] + 2.0, a[..., 2] / (1.0 + a[..., 3])], -1)


def written() -> Tensor:
    a, b, c, d = AT[:, 0].unbind(-1)
    zero = torch.zeros_like(a)
    numbers = [torch.cos(a) * b, torch.sin(a), zero, zero, zero, zero, 1.0 / (1.0 + d), -c / (1.0 + d) ** 2]  # fmt: skip
    return torch.stack(numbers, -1).unflatten(-1, (2, 4))


def at_zero(f: jacobian_module.Map) -> Tensor:
    return f(torch.zeros(R, 1, D, dtype=torch.float64))


def of_no_use(*_: object) -> Tensor:
    raise AssertionError("the other way was asked for")


def test_backward_and_forward_give_what_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    """Forward only where a gradient is required: it takes several times as long."""
    by = torch.ones((), dtype=torch.float64, requires_grad=True)
    for mode in (torch.no_grad, torch.enable_grad):
        with mode(), monkeypatch.context() as patched:
            patched.setattr(jacobian_module, "_forward", of_no_use)
            assert torch.allclose(jacobian(bent, at_zero(bent), D), written(), rtol=1e-14)
    monkeypatch.setattr(jacobian_module, "_backward", of_no_use)
    found = jacobian(lambda xi: by * bent(xi), by * at_zero(bent), D)
    assert found.requires_grad
    assert torch.allclose(found, written(), rtol=1e-14)


def test_a_gradient_goes_through() -> None:
    by = torch.tensor(0.7, dtype=torch.float64, requires_grad=True)
    (gradient,) = torch.autograd.grad(jacobian(lambda xi: by**2 * bent(xi), by**2 * at_zero(bent), D).sum(), by)  # fmt: skip
    assert torch.allclose(gradient, 2.0 * by * written().sum(), rtol=1e-13)


def test_a_branch_not_taken_spoils_nothing() -> None:
    """The length of a difference is 0 at 0, where its root has no derivative; runs that have no value stay out of it."""

    def guarded(xi: Tensor) -> Tensor:
        square = xi.square().sum(-1, keepdim=True)
        return torch.where(square > 0.0, torch.sqrt(square), 0.0) + bent(xi)

    with torch.no_grad():
        assert jacobian_module._backward(guarded, at_zero(guarded), D, torch.subtract) is None
        assert torch.allclose(jacobian(guarded, at_zero(guarded), D), written(), rtol=1e-14)

        def lost(xi: Tensor) -> Tensor:
            return bent(xi) * torch.tensor([1.0, torch.nan, 1.0], dtype=torch.float64).view(R, 1, 1)

        found = jacobian(lost, at_zero(lost), D)
    assert torch.allclose(found[[0, 2]], written()[[0, 2]], rtol=1e-14)
    assert not bool(torch.isfinite(found[1].sum()))


def test_values_that_wrap_and_values_that_stand_still() -> None:
    def turned(a: Tensor, b: Tensor) -> Tensor:
        return torch.remainder(a - b + torch.pi, 2.0 * torch.pi) - torch.pi

    def wrapped(xi: Tensor) -> Tensor:
        return turned(3.0 * (AT + xi)[..., :1], torch.zeros(1, dtype=torch.float64))

    for mode in (torch.no_grad, torch.enable_grad):
        with mode():
            assert torch.allclose(
                jacobian(wrapped, at_zero(wrapped), D, turned)[:, 0, 0], torch.tensor(3.0).double()
            )
            assert torch.equal(
                jacobian(lambda xi: AT[..., :2].expand(-1, xi.shape[1], -1), AT[..., :2], D),
                torch.zeros(R, 2, D).double(),
            )


@pytest.mark.parametrize("tail", [1e-12, 0.001, 0.3, 0.99])
def test_limits_of_chi_square_are_those_of_scipy(tail: float) -> None:
    limits = [chi_square_limit(dof, tail) for dof in range(1, 60)]
    assert limits == pytest.approx(chdtri(range(1, 60), tail), rel=1e-11)
    assert chi_square_limit(3, 0.0) == math.inf
