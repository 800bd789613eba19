"""Models: shapes, the laws they claim to follow, and that what was not seen weighs nothing."""

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
import torch
from pyro.distributions import Laplace, MultivariateNormal
from scipy import integrate, linalg, stats
from torch import Tensor
from torch.distributions import Distribution, Independent

from pfbench.core import PhiloxStream, Record, wrap_angle
from pfbench.core.density import dense_normal, independent_normal, normal_batch
from pfbench.core.linear_algebra import (
    distribution_covariance,
    gaussian_log_density,
    shared_distribution_covariance,
)
from pfbench.model import (
    Benes,
    ChaoticSystem,
    DoublePendulum,
    LinearGaussian,
    Lorenz63,
    Lorenz96,
    Pendulum,
    StateSpaceModel,
    StaticModel,
    StochasticVolatility,
    UnivariateGrowth,
    linear_walk,
    local_level,
)

MODELS: dict[str, Callable[[], StateSpaceModel]] = {
    "growth": UnivariateGrowth,
    "volatility": StochasticVolatility,
    "benes": Benes,
    "pendulum": Pendulum,
    "lorenz": Lorenz63,
    "without noise": lambda: Lorenz63(process_sd=0.0, substeps=2),
    "level": lambda: local_level(10.0, 20.0, 0.0, 30.0),
    "walk": lambda: linear_walk(0.5, 0.3, 1.0),
    "singular": lambda: LinearGaussian(
        np.diag([0.9, 0.5, 0.7]), np.ones((3, 1)), np.eye(2, 3), [1, 2], [0, 0, 0], [1, 1, 1]
    ),
}
every_model = pytest.mark.parametrize("name", MODELS)


def normal(runs: int, n: int, w: int, purpose: str = "x") -> Tensor:
    return PhiloxStream(11, torch.arange(runs)).normal(purpose, n, w)


def inputs(model: StateSpaceModel, runs: int = 3, steps: int = 4) -> Any:
    x = initial_states(model, runs, 1).to(model.anchor)
    y = x.new_zeros(runs, steps, model.observation(x, None).event_shape[0])
    return model.prepare(Record(y)).at_step(0).u


def initial_states(model: StateSpaceModel, runs: int, n: int) -> Tensor:
    law = model.initial(runs)
    spread = normal(runs, n, model.chart.dimension) * law.variance.sqrt().unsqueeze(1)
    return model.chart.add(model.origin, law.mean.unsqueeze(1) + spread)


@every_model
def test_shapes_and_words(name: str) -> None:
    model = MODELS[name]()
    d = model.chart.dimension
    assert len(model.names) == len(model.units) == d
    assert all(0 <= i < d for parts in model.groups.values() for i in parts)
    law = model.initial(3)
    assert (tuple(law.batch_shape), tuple(law.event_shape)) == ((3,), (d,))
    assert model.origin.shape == (model.chart.size,)
    assert tuple(model.noise.event_shape) == (model.noise_dim,)
    x, u = initial_states(model, 3, 5), inputs(model)
    moved = model.propagate(x, u, normal(3, 5, model.noise_dim, "w"))
    assert moved.shape == (3, 5, model.chart.size)
    seen = model.observation(moved, u)
    assert tuple(seen.batch_shape) == (3, 5)
    y = torch.ones(3, *seen.event_shape, dtype=torch.float64)
    assert model.log_likelihood(y, moved, u).shape == (3, 5)
    assert model.error(moved[:, 0], x[:, 0]).shape == (3, d)


@every_model
def test_propagation_is_deterministic_and_runs_do_not_mix(name: str) -> None:
    model = MODELS[name]()
    x, u, w = initial_states(model, 3, 5), inputs(model), normal(3, 5, model.noise_dim, "w")
    moved = model.propagate(x, u, w)
    assert torch.equal(moved, model.propagate(x, u, w))
    for r in range(3):
        for n in range(5):
            alone = model.propagate(x[r : r + 1, n : n + 1], u, w[r : r + 1, n : n + 1])
            assert torch.allclose(alone[0, 0], moved[r, n], rtol=1e-13, atol=1e-15)


@every_model
def test_noise_gain_is_how_the_noise_enters(name: str) -> None:
    model = MODELS[name]()
    x, u, w = initial_states(model, 3, 5), inputs(model), normal(3, 5, model.noise_dim, "w")
    gain = model.noise_gain(u)
    if gain is None:
        quiet = model.propagate(x, u, torch.zeros_like(w))
        assert not torch.allclose(quiet, model.propagate(x, u, w))
        return
    expected = model.chart.add(model.propagate(x, u, torch.zeros_like(w)), w @ gain.mT)
    assert torch.allclose(model.propagate(x, u, w), expected, atol=1e-12)


@every_model
def test_single_precision_goes_through(name: str) -> None:
    model = MODELS[name]().float()
    u = inputs(model)
    x, w = initial_states(model, 3, 5).float(), normal(3, 5, model.noise_dim, "w").float()
    moved = model.propagate(x, u, w)
    assert moved.dtype == torch.float32
    assert (
        model.log_likelihood(
            torch.ones(3, *model.observation(moved, u).event_shape), moved, u
        ).dtype
        == torch.float32
    )


def whitened(law: Distribution, x: Tensor) -> np.ndarray:
    """Standard normals, if x [R, N, D] follows the law."""
    if isinstance(law, torch.distributions.MultivariateNormal):
        return torch.linalg.solve_triangular(
            law.scale_tril, (x - law.mean).unsqueeze(-1), upper=False
        ).numpy()
    return ((x - law.mean) / law.stddev).numpy()


@every_model
def test_transition_law_is_that_of_the_propagation(name: str) -> None:
    model = MODELS[name]()
    u = inputs(model)
    law = model.transition(initial_states(model, 3, 1).expand(-1, 4000, -1), u)
    if law is None:
        assert name in ("benes", "pendulum", "singular", "without noise")
        return
    x = initial_states(model, 3, 1).expand(-1, 4000, -1)
    z = whitened(law, model.propagate(x, u, normal(3, 4000, model.noise_dim, "w")))
    assert stats.kstest(z.ravel(), "norm").pvalue > 1e-3
    z = z.reshape(-1, model.chart.dimension)
    correlations = (
        np.corrcoef(z.T)[np.triu_indices(z.shape[1], 1)] if z.shape[1] > 1 else np.zeros(1)
    )
    assert np.abs(correlations).max() < 4.5 / math.sqrt(len(z))


# what each model's formula says, written once more in NumPy


def test_growth_counts_its_steps_from_one() -> None:
    model = UnivariateGrowth()
    record = model.prepare(Record(torch.zeros(1, 3, 1, dtype=torch.float64)))
    x = np.array([-7.0, 0.3, 12.0])
    for t in range(3):
        moved = model.propagate(
            torch.tensor(x).reshape(1, 3, 1),
            record.at_step(t).u,
            torch.full((1, 3, 1), 0.5, dtype=torch.float64),
        )
        expected = x / 2 + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * (t + 1)) + math.sqrt(10.0) * 0.5
        assert np.allclose(moved.numpy().ravel(), expected, rtol=1e-14)
    y = model.log_likelihood(
        torch.tensor([[2.0]], dtype=torch.float64), torch.tensor(x).reshape(1, 3, 1), ()
    )
    assert np.allclose(y.numpy().ravel(), stats.norm.logpdf(2.0, x**2 / 20, 1.0))


def test_pendulum_formula_and_cut() -> None:
    model = Pendulum(step=0.05, noise=0.1)
    angle, rate = np.array([0.4, 3.13, -3.1]), np.array([-1.0, 2.0, -3.0])
    x = torch.tensor(np.stack([angle, rate], -1)[None])
    moved = model.propagate(x, (), torch.zeros(1, 3, 2, dtype=torch.float64)).numpy()[0]
    turned = angle + 0.05 * rate
    assert np.allclose(moved[:, 0], np.angle(np.exp(1j * turned)), atol=1e-14)
    assert np.allclose(moved[:, 1], rate - 9.81 * 0.05 * np.sin(angle), atol=1e-14)
    y = model.log_likelihood(torch.tensor([[0.2]], dtype=torch.float64), x, ())
    assert np.allclose(y.numpy()[0], stats.norm.logpdf(0.2, np.sin(angle), 0.3))


def white_acceleration(step: float, density: float) -> np.ndarray:
    """Discrete covariance of white acceleration by Van Loan's matrix exponential."""
    block = np.zeros((4, 4))
    block[:2, :2] = [[0, -1], [0, 0]]
    block[:2, 2:] = np.diag([0.0, density**2])
    block[2:, 2:] = [[0, 0], [1, 0]]
    e = linalg.expm(block * step)
    return e[2:, 2:].T @ e[:2, 2:]


def test_white_acceleration_is_integrated_exactly() -> None:
    expected = white_acceleration(0.7, 0.3)
    for factor in (linear_walk(0.7, 0.3, 1.0).g, Pendulum(0.7, 0.3).noise_root):
        assert np.allclose((factor @ factor.mT).numpy(), expected, rtol=1e-12)


def test_stationary_volatility_stays_stationary() -> None:
    model = StochasticVolatility(mu=-1.0, rho=0.95, sigma=0.3)
    law = model.initial(1)
    assert float(law.mean) == -1.0
    gain = (
        float(
            model.propagate(
                law.mean.unsqueeze(1) + 1.0, (), torch.zeros(1, 1, 1, dtype=torch.float64)
            )
        )
        + 1.0
    )
    assert gain**2 * float(law.variance) + 0.3**2 == pytest.approx(float(law.variance), rel=1e-12)
    x = torch.tensor([[[0.7]]], dtype=torch.float64)
    y = model.log_likelihood(torch.tensor([[1.3]], dtype=torch.float64), x, ())
    assert float(y) == pytest.approx(stats.norm.logpdf(1.3, 0.0, math.exp(0.35)))


@pytest.mark.parametrize("start", [-0.6, 0.0, 0.2, 2.0])
def test_benes_draws_its_exact_transition(start: float) -> None:
    """A large step, so that both modes and both drifts count."""
    step, n = 1.5, 200_000
    model = Benes(step=step)

    grid = np.linspace(start - 14, start + 14, 20_001)
    density = np.cosh(grid) / math.cosh(start) * math.exp(-step / 2)
    density *= stats.norm.pdf(grid, start, math.sqrt(step))
    moments = [integrate.simpson(grid**k * density, x=grid) for k in range(5)]
    assert moments[0] == pytest.approx(1.0, abs=1e-8)
    x = (
        model.propagate(torch.full((1, n, 1), start, dtype=torch.float64), (), normal(1, n, 2, "w"))
        .numpy()
        .ravel()
    )
    for k in (1, 2):
        assert abs((x**k).mean() - moments[k]) < 4 * math.sqrt(
            (moments[2 * k] - moments[k] ** 2) / n
        )
    cdf = integrate.cumulative_trapezoid(density, grid, initial=0.0)
    assert stats.kstest(x, lambda v: np.interp(v, grid, cdf)).pvalue > 1e-3


def lagrange(t: float, x: np.ndarray) -> np.ndarray:
    """Equations of a double pendulum as two forces on the ends of the rods, whose tensions are unknown."""
    a, v, b, w = x
    radial = np.array([[np.sin(a), -np.cos(a)], [np.sin(b), -np.cos(b)]])
    along = np.array([[np.cos(a), np.sin(a)], [np.cos(b), np.sin(b)]])
    # unknown are both angular accelerations and both tensions: m r'' = gravity + tensions
    upper = np.stack([along[0], 0 * along[0], radial[0], -radial[1]], 1)
    lower = np.stack([along[0], along[1], 0 * radial[0], radial[1]], 1)
    turn = np.array([0.0, -9.8]) + v**2 * radial[0]
    right = np.concatenate([turn, turn + w**2 * radial[1]])
    accelerations = np.linalg.solve(np.concatenate([upper, lower]), right)
    return np.array([v, accelerations[0], w, accelerations[1]])


def circle(t: float, x: np.ndarray) -> list[float]:
    return [(x[(i + 1) % 40] - x[i - 2]) * x[i - 1] - x[i] + 8 for i in range(40)]


def attractor(t: float, x: np.ndarray) -> list[float]:
    return [10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]]


@pytest.mark.parametrize(
    ("kind", "rate", "start"),
    [
        (Lorenz63, attractor, [1.0, -2.0, 20.0]),
        (Lorenz96, circle, [8.0 + math.sin(3.0 * i) for i in range(40)]),
        (DoublePendulum, lagrange, [2.0, 0.5, -0.3, -1.0]),
    ],
)
def test_a_chaotic_system_is_integrated_to_fourth_order(
    kind: type[ChaoticSystem], rate: Any, start: list[float]
) -> None:
    end = 0.32
    flow = integrate.solve_ivp(rate, (0, end), start, rtol=1e-12, atol=1e-12, method="DOP853")
    errors = []
    for step in (0.02, 0.01, 0.005):
        model = kind(
            step=step, substeps=round(end / step), process_sd=0.0, measurement_sd=1.0,
            initial_sd=1.0, initial_mean=start,
        )  # fmt: skip
        x = model.propagate(
            model.m0.reshape(1, 1, -1), (), torch.zeros(1, 1, 1, dtype=torch.float64)
        )
        errors.append(np.linalg.norm(x.numpy().ravel() - flow.y[:, -1]))
    ratios = np.array(errors[:-1]) / errors[1:]
    # 2^4 with a term of the next order: third-order and fifth-order schemes give 8 and 32
    assert np.all((ratios > 12) & (ratios < 22)), ratios


# what was not seen


def test_unseen_components_weigh_nothing() -> None:
    model = Lorenz63()
    x, y = (
        initial_states(model, 2, 6),
        torch.tensor([[1.0, torch.nan, 20.0], [torch.nan] * 3], dtype=torch.float64),
    )
    value = model.log_likelihood(y, x, ()).numpy()
    expected = stats.norm.logpdf(1.0, x[0, :, 0]) + stats.norm.logpdf(20.0, x[0, :, 2])
    assert np.allclose(value[0], expected, rtol=1e-13)
    assert np.all(value[1] == 0.0)


def test_the_volatility_weighs_as_its_law_does() -> None:
    model = StochasticVolatility()
    x, y = 20.0 * normal(3, 50, 1), torch.tensor([[0.3], [-40.0], [torch.nan]], dtype=torch.float64)
    value = model.log_likelihood(y, x, ()).numpy()
    assert np.allclose(
        value[:2],
        stats.norm.logpdf(y[:2].numpy(), scale=np.exp(0.5 * x[:2, :, 0].numpy())),
        rtol=1e-12,
    )
    assert np.all(value[2] == 0.0)
    law = model.observation(x[:2], ())  # what is drawn has the density that weighs
    assert np.allclose(value[:2], law.log_prob(y[:2, None]).numpy(), rtol=1e-12)


def test_dropping_a_component_equals_a_model_without_it() -> None:
    f, g, h = (
        np.array([[0.9, 0.2], [0.0, 0.7]]),
        np.eye(2),
        np.array([[1.0, 0.5], [0.2, 1.0], [1.0, -1.0]]),
    )
    whole = LinearGaussian(f, g, h, [1.0, 2.0, 3.0], [0.0, 0.0], [1.0, 1.0])
    part = LinearGaussian(f, g, h[[0, 2]], [1.0, 3.0], [0.0, 0.0], [1.0, 1.0])
    x, y = normal(3, 7, 2), normal(3, 1, 3, "y")[:, 0]
    y[:, 1] = torch.nan
    assert torch.allclose(
        whole.log_likelihood(y, x, ()), part.log_likelihood(y[:, [0, 2]], x, ()), rtol=1e-14
    )


class Correlated(StateSpaceModel):
    """A random walk seen through a dense normal law whose covariance depends on the state; its third component is an angle."""

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer(
            "c",
            torch.tensor(
                [[2.0, 0.8, 0.1], [0.8, 1.0, -0.3], [0.1, -0.3, 1.0]], dtype=torch.float64
            ),
        )
        self.names, self.units, self.groups, self.noise_dim = (
            ("a", "b", "c"),
            ("",) * 3,
            {"state": (0, 1, 2)},
            3,
        )

    @property
    def origin(self) -> Tensor:
        return self.c.new_tensor([1.0, 2.0, 3.0])

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.c.new_ones(3))

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x + w

    def covariance(self, x: Tensor) -> Tensor:
        return self.c * (1.0 + x[..., :1, None] ** 2)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return MultivariateNormal(x, self.covariance(x), validate_args=False)

    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        d = y - y_hat
        return torch.cat([d[..., :2], wrap_angle(d[..., 2:])], -1)


def test_unseen_components_of_a_dense_law_are_integrated_out() -> None:
    model, x = Correlated(), normal(1, 5, 3)
    for seen in ([0, 1, 2], [0, 2], [1], [0, 1]):
        y = torch.full((1, 3), torch.nan, dtype=torch.float64)
        y[0, seen] = torch.tensor([0.3, -0.4, 0.2], dtype=torch.float64)[seen]
        value = model.log_likelihood(y, x, ())[0]
        for n in range(5):
            c = model.covariance(x)[0, n].numpy()[np.ix_(seen, seen)]
            expected = stats.multivariate_normal.logpdf(
                y[0, seen].numpy(), x[0, n, seen].numpy(), c
            )
            assert float(value[n]) == pytest.approx(expected, rel=1e-12)
    assert torch.all(
        model.log_likelihood(torch.full((1, 3), torch.nan, dtype=torch.float64), x, ()) == 0.0
    )


def test_measured_angles_go_the_short_way_round() -> None:
    model, x = Correlated(), normal(1, 5, 3)
    y = torch.tensor([[0.1, 0.2, 3.0]], dtype=torch.float64)
    turned = y + torch.tensor([0.0, 0.0, 2 * math.pi], dtype=torch.float64)
    assert torch.allclose(
        model.log_likelihood(y, x, ()), model.log_likelihood(turned, x, ()), rtol=1e-12
    )


def test_a_dense_law_without_a_positive_covariance_has_no_likelihood() -> None:
    covariance = torch.tensor(
        [[[1.0, 2.0], [2.0, 1.0]], [[2.0, 1.0], [1.0, 2.0]]], dtype=torch.float64
    )
    value = gaussian_log_density(
        torch.zeros(2, 2, dtype=torch.float64), covariance, torch.ones(2, 2, dtype=torch.bool)
    )
    assert torch.isnan(value).tolist() == [True, False]
    assert float(value[1]) == pytest.approx(
        stats.multivariate_normal.logpdf([0, 0], [0, 0], covariance[1].numpy()), rel=1e-14
    )


def test_a_covariance_that_all_particles_share_is_made_once() -> None:
    x, sd = normal(3, 4, 2), torch.tensor([0.5, 2.0], dtype=torch.float64)
    root = torch.tensor([[1.0, 0.0], [-3.0, 2.0]], dtype=torch.float64)
    for law, one in (
        (independent_normal(x, sd), np.diag([0.25, 4.0])),
        (dense_normal(x, root.expand(3, 4, 2, 2)), np.array([[1.0, -3.0], [-3.0, 13.0]])),
        (
            dense_normal(x, root.expand(3, 1, 2, 2).contiguous().expand(3, 4, 2, 2)),
            np.array([[1.0, -3.0], [-3.0, 13.0]]),
        ),
    ):
        assert np.allclose(
            distribution_covariance(law), np.broadcast_to(one, (3, 4, 2, 2)), rtol=1e-15
        )
        assert np.allclose(
            shared_distribution_covariance(law), np.broadcast_to(one, (3, 1, 2, 2)), rtol=1e-15
        )
        assert shared_distribution_covariance(law).shape == (3, 1, 2, 2)
    for law, variance in (
        (independent_normal(x, x.abs()), x.square()),
        (Independent(Laplace(x, sd.expand_as(x)), 1), (2.0 * sd.square()).expand_as(x)),
    ):
        assert torch.allclose(
            shared_distribution_covariance(law), torch.diag_embed(variance), rtol=1e-14
        )


def test_other_observation_laws() -> None:
    model, x = Lorenz63(), normal(1, 4, 3)
    model.observation = lambda x, u: Independent(Laplace(x, torch.ones_like(x)), 1)  # type: ignore[method-assign]
    y = torch.tensor([[1.0, torch.nan, 2.0]], dtype=torch.float64)
    expected = stats.laplace.logpdf(1.0, x[..., 0]) + stats.laplace.logpdf(2.0, x[..., 2])
    assert np.allclose(model.log_likelihood(y, x, ()).numpy(), expected)
    model.observation = lambda x, u: Laplace(x, torch.ones_like(x))  # type: ignore[method-assign]
    with pytest.raises(TypeError, match=r"of 3 components, got Laplace .*to_event\(1\)"):
        model.log_likelihood(y, x, ())


@every_model
def test_a_model_at_rest_only_looks(name: str) -> None:
    model = MODELS[name]()
    still = StaticModel(model)
    x, u = initial_states(model, 3, 5), inputs(model)
    assert torch.equal(still.propagate(x, u, normal(3, 5, model.noise_dim, "w")), x)
    y = torch.ones(3, *model.observation(x, u).event_shape, dtype=torch.float64)
    assert torch.equal(still.log_likelihood(y, x, u), model.log_likelihood(y, x, u))
    assert still.transition(x, u) is None
    assert still.chart == model.chart


def test_a_model_at_rest_keeps_its_origin() -> None:
    assert torch.equal(StaticModel(Correlated()).origin, Correlated().origin)


BAD = [
    (lambda: UnivariateGrowth(process_sd=0.0), "process_sd"),
    (lambda: UnivariateGrowth(measurement_sd=-1.0), "measurement_sd"),
    (lambda: UnivariateGrowth(initial_sd=math.nan), "initial_sd"),
    (lambda: Lorenz63(process_sd=math.inf), "process_sd"),
    (lambda: Lorenz63(substeps=0), "substeps"),
    (lambda: StochasticVolatility(rho=1.0), "rho"),
    (lambda: Benes(step=0.0), "step"),
    (lambda: Pendulum(noise=0.0), "noise"),
    (lambda: linear_walk(1.0, -0.1, 1.0), "noise"),
    (lambda: linear_walk(1.0, 0.1, 1.0, (0.0, 1.0)), "initial_sd"),
    (lambda: local_level(0.0, 1.0, 0.0, 1.0), "level_sd"),
    (lambda: LinearGaussian(np.eye(2), np.eye(2), np.ones((1, 3)), [1.0], [0, 0], [1, 1]), "shape"),
    (lambda: LinearGaussian(np.eye(2), np.eye(2), np.ones((1, 2)), [1.0], [0, 0, 0], [1, 1]), "m0"),
]


@pytest.mark.parametrize(("build", "word"), BAD)
def test_impossible_models_are_refused_by_name(
    build: Callable[[], StateSpaceModel], word: str
) -> None:
    with pytest.raises(ValueError, match=word):
        build()
