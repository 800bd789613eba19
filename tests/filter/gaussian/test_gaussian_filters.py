"""Gaussian filters: Kalman's answer on linear models, exact moments of the rules, and no failure that stays silent or spreads."""

import dataclasses
import math
from typing import Any, NamedTuple

import numpy as np
import oracles
import pytest
import torch
from checkout import ROOT
from filter_laws import check_own, check_wrapped
from model_cases import Bearing, Hidden, four_states, measurements
from pyro.distributions import GaussianHMM, MultivariateNormal
from refusals import check_refused
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from pfbench.core import PhiloxStream, Record, wrap_angle
from pfbench.core.linear_algebra import factor
from pfbench.filter import FilterResult, GaussianBelief, GaussianFilter, run_filter
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.gaussian.linearisation_rules import (
    AffineApproximation,
    CubaturePoints,
    DifferenceSpace,
    LinearisationRule,
    RadialDegree3,
    SigmaPointLinearisation,
    SimplexDegree3,
    SphericalRadialPoints,
    TaylorLinearisation,
    UnscentedPoints,
)  # fmt: skip
from pfbench.filter.linearisation import compute_additive_gain
from pfbench.model import (
    Benes,
    LinearGaussian,
    Lorenz63,
    Pendulum,
    StateSpaceModel,
    UnivariateGrowth,
    linear_walk,
    local_level,
)
from pfbench.noise.base import NominalNoise
from pfbench.ppl.model_batch import ModelBatch
from pfbench.scenario.simulated import ModelSimulation

RULES: dict[str, LinearisationRule] = {
    "jacobian": TaylorLinearisation(),
    "unscented": SigmaPointLinearisation(UnscentedPoints()),
    "unscented, wide": SigmaPointLinearisation(UnscentedPoints(0.7, 2.0, 1.5)),
    "cubature": SigmaPointLinearisation(CubaturePoints()),
}
every_rule = pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())
NILE = torch.tensor(np.loadtxt(ROOT / "experiments" / "oracles" / "nile.csv"))[None, :, None]


def run(
    rule: LinearisationRule,
    model: StateSpaceModel,
    y: Tensor,
    u: Any = (),
    start: Tensor | None = None,
    **options: Any,
) -> FilterResult:
    """Runs a Gaussian filter; its whole covariance is watched as trace["covariance"]."""
    draws = PhiloxStream(0, torch.arange(y.shape[0]))
    method = GaussianFilter(rule, **options)
    return run_filter(
        method,
        model,
        Record(y, u, start),
        draws,
        watch=lambda t, info: {"covariance": info.covariance()},
    )


# the oracles themselves, against one big normal law of all states and measurements


PARTS = ("f", "g", "h", "r", "m0", "l0")
LINEAR: dict[str, LinearGaussian] = {
    "level": local_level(38.0, 120.0, 1000.0, 300.0),
    "walk": linear_walk(0.5, 0.3, 1.0),
    "four": four_states(),
    "four, seen at once": LinearGaussian(
        *(getattr(four_states(), k) for k in PARTS), observes_initial=True
    ),
}
every_linear = pytest.mark.parametrize("model", LINEAR.values(), ids=LINEAR.keys())


def matrices(model: LinearGaussian) -> dict[str, np.ndarray]:
    f, g, h, r, m0, root = (getattr(model, k).numpy() for k in PARTS)
    return {"f": f, "q": g @ g.T, "h": h, "r": np.diag(r**2), "m0": m0, "p0": root @ root.T}


def simulate(model: LinearGaussian, runs: int = 3, steps: int = 25, missing: float = 0.0) -> Tensor:
    rng = np.random.default_rng(1)
    f, g, h, r, m0, root = (getattr(model, k).numpy() for k in PARTS)
    x = m0 + rng.normal(size=(runs, len(m0))) @ root.T
    rows = []
    for t in range(steps):
        if t or not model.observes_initial:
            x = x @ f.T + rng.normal(size=(runs, g.shape[1])) @ g.T
        rows.append(x @ h.T + r * rng.normal(size=(runs, len(r))))
    y = np.stack(rows, 1)
    y[rng.random(y.shape) < missing] = np.nan
    if missing:
        y[:, steps // 3] = np.nan
    return torch.tensor(y)


@every_linear
def test_the_oracles_agree_with_one_big_normal(model: LinearGaussian) -> None:
    y = simulate(model, 1, 6, 0.3)[0].numpy()
    m = matrices(model)
    d, steps = len(m["m0"]), len(y)
    mean, covariance = m["m0"], m["p0"]
    means, blocks = [], np.zeros((steps, d, steps, d))
    for t in range(steps):
        if t or not model.observes_initial:
            mean, covariance = m["f"] @ mean, m["f"] @ covariance @ m["f"].T + m["q"]
        means.append(mean)
        cross = covariance
        for s in range(t, steps):
            cross = m["f"] @ cross if s > t else cross
            blocks[s, :, t], blocks[t, :, s] = cross, cross.T
    mu, big = np.concatenate(means), blocks.reshape(steps * d, steps * d)
    seen = ~np.isnan(y.ravel())
    h = np.kron(np.eye(steps), m["h"])[seen]
    s = h @ big @ h.T + np.kron(np.eye(steps), m["r"])[np.ix_(seen, seen)]
    e = y.ravel()[seen] - h @ mu
    smoothed = mu + big @ h.T @ np.linalg.solve(s, e)
    smoothed_covariance = big - big @ h.T @ np.linalg.solve(s, h @ big)
    filtered = oracles.kalman(**m, y=y, observes_initial=model.observes_initial)
    log_z = -0.5 * (e @ np.linalg.solve(s, e) + np.linalg.slogdet(2 * np.pi * s)[1])
    assert filtered.log_evidence.sum() == pytest.approx(log_z, rel=1e-9)
    assert np.allclose(filtered.mean[-1], smoothed[-d:], rtol=1e-7, atol=1e-9)
    if np.linalg.matrix_rank(filtered.predicted_covariance[1]) == d:
        x, p = oracles.rts_smoother(m["f"], filtered)
        assert np.allclose(x.ravel(), smoothed, rtol=1e-6, atol=1e-6 * np.abs(smoothed).max())
        assert np.allclose(
            p[0], smoothed_covariance[:d, :d], rtol=1e-6, atol=1e-6 * np.abs(p[0]).max()
        )


# Kalman


def assert_kalman(
    estimate: FilterResult, model: LinearGaussian, y: Tensor, tolerance: float = 1e-9
) -> None:
    for r in range(y.shape[0]):
        truth = oracles.kalman(
            **matrices(model), y=y[r].numpy(), observes_initial=model.observes_initial
        )
        sd = np.sqrt(np.diagonal(truth.covariance, axis1=1, axis2=2))
        assert np.abs((estimate.mean[r].numpy() - truth.mean) / sd).max() < tolerance
        off = estimate.trace["covariance"][r].numpy() - truth.covariance
        assert np.abs(off / (sd[:, :, None] * sd[:, None, :])).max() < tolerance
        assert np.allclose(estimate.variance[r].numpy(), sd**2, rtol=tolerance)
        off = float(estimate.log_evidence[r]) - truth.log_evidence.sum()
        assert abs(off) < tolerance * (1 + np.abs(truth.log_evidence).sum())


@every_rule
@every_linear
@pytest.mark.parametrize("missing", [0.0, 0.3])
def test_equal_to_kalman_on_linear_models(
    rule: LinearisationRule, model: LinearGaussian, missing: float
) -> None:
    y = simulate(model, missing=missing)
    estimate = run(rule, model, y)
    assert not bool(estimate.lost.any())
    assert_kalman(estimate, model, y)


@pytest.mark.parametrize("gradient", [False, True])
def test_draws_by_the_posterior_root_do_not_hang_on_rounding(gradient: bool) -> None:
    """Of noises that a measurement tells nothing of but for rounding, none may be drawn with the other sign."""
    generator = torch.Generator().manual_seed(3)
    m = torch.randn(1, 2, 4, generator=generator, dtype=torch.float64)
    m[..., 2:] = 0.0
    m = m + 1e-17 * torch.randn(64, 2, 4, generator=generator, dtype=torch.float64)
    one, seen = (
        torch.eye(2, dtype=torch.float64).expand(64, 2, 2),
        torch.ones(64, 2, dtype=torch.bool),
    )
    r = torch.ones(64, 2, dtype=torch.float64, requires_grad=gradient)
    _, root, _ = kalman_gain_update(
        Innovation(r, seen, m, one, one, one, torch.eye(4, dtype=torch.float64).expand(64, 4, 4))
    )
    assert bool((root.diagonal(dim1=-2, dim2=-1) > 0.0).all())
    torch.testing.assert_close(root, root[:1].expand_as(root), rtol=0, atol=1e-14)
    torch.testing.assert_close(
        root @ root.mT,
        torch.linalg.inv(torch.eye(4, dtype=torch.float64) + m.mT @ m),
        rtol=0,
        atol=1e-14,
    )


@every_rule
def test_noise_through_the_rule_equals_noise_by_its_gain(rule: LinearisationRule) -> None:
    plain = four_states()
    hidden = Hidden(*(getattr(plain, k) for k in PARTS))
    y = simulate(plain, missing=0.3)
    assert_kalman(run(rule, hidden, y), plain, y)


def without_gain(kind: type[StateSpaceModel]) -> type[Any]:
    """The class without its method noise_gain, as a user may write it."""
    return type(kind.__name__, (kind,), {"noise_gain": StateSpaceModel.noise_gain})


SIMPLEX = SigmaPointLinearisation(SphericalRadialPoints(SimplexDegree3(), RadialDegree3()))


@pytest.mark.parametrize("rule", [*RULES.values(), SIMPLEX], ids=[*RULES.keys(), "simplex"])
@pytest.mark.parametrize("kind", [UnivariateGrowth, Pendulum, Lorenz63, LinearGaussian])
def test_additive_noise_is_recognised_without_a_noise_gain(
    rule: LinearisationRule, kind: type[Any]
) -> None:
    """Otherwise the noise would pass through the rule: another filter with larger sigma points."""
    args = [getattr(four_states(), k) for k in PARTS] if kind is LinearGaussian else []
    stated, unstated = kind(*args), without_gain(kind)(*args)
    y = ModelSimulation(stated, 20).draw(NominalNoise(), torch.arange(3), 2).record.y
    a, b = run(rule, stated, y), run(rule, unstated, y)
    scale = a.variance.sqrt()
    assert float(((a.mean - b.mean) / scale).abs().max()) < 1e-8
    torch.testing.assert_close(a.variance, b.variance, rtol=1e-8, atol=0)
    through = type("Through", (kind,), {"noise_gain": lambda self, u: None})(
        *args
    )  # None as a statement
    c = run(rule, through, y)
    differs = float(((a.mean - c.mean) / scale).abs().max()) > 1e-6
    assert differs == (kind is not LinearGaussian and rule is not RULES["jacobian"])


class Multiplied(UnivariateGrowth):
    """The noise is multiplied by the state, slightly: without a spread only other states show it."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w * (1.0 + 1e-6 * x))


class Squared(UnivariateGrowth):
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w + 1e-6 * w * w)


@pytest.mark.parametrize("kind", [Multiplied, Squared, Benes])
def test_noise_that_is_not_additive_is_not_taken_for_it(kind: type[Any]) -> None:
    model = without_gain(kind)()
    u = model.prepare(Record(torch.zeros(1, 1, 1, dtype=torch.float64))).at_step(0).u
    for root in (0.0, 1.0):
        x = torch.zeros(1, 1, dtype=torch.float64)
        assert (
            compute_additive_gain(model, x, torch.full((1, 1, 1), root, dtype=torch.float64), u)
            is None
        )


def test_one_model_for_each_run_and_wrappers_recognise_additive_noise_too() -> None:
    record = Record(
        ModelSimulation(UnivariateGrowth(), 8).draw(NominalNoise(), torch.arange(2), 2).record.y
    )
    draws, method = (
        PhiloxStream(0, torch.arange(2)),
        GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
    )
    batches = [
        ModelBatch([kind(2.0), kind(3.0)])
        for kind in (UnivariateGrowth, without_gain(UnivariateGrowth))
    ]
    a, b = (run_filter(method, model, record, draws) for model in batches)
    torch.testing.assert_close(a.mean, b.mean, rtol=1e-9, atol=1e-9)


@every_rule
@pytest.mark.parametrize("kind", [LinearGaussian, Hidden])
def test_a_noise_law_that_is_not_standard(
    rule: LinearisationRule, kind: type[LinearGaussian]
) -> None:
    class Drifting(kind):  # type: ignore[misc, valid-type]
        @property
        def noise(self) -> Distribution:
            return Independent(Normal(self.m0.new_tensor([0.3]), self.m0.new_tensor([2.0])), 1)

    # the same law as a state of three: walk, walk, and a constant 1 that carries the drift
    g = np.array([[0.2], [0.5]])
    model = Drifting([[1.0, 1.0], [0.0, 0.9]], g, [[1.0, 0.0]], [0.7], [0.0, 0.0], [1.0, 1.0])
    y = simulate(model)
    estimate = run(rule, model, y)
    f = np.block([[model.f.numpy(), 0.3 * g], [np.zeros((1, 2)), np.ones((1, 1))]])
    q = np.zeros((3, 3))
    q[:2, :2] = 4.0 * g @ g.T
    for r in range(3):
        h, m0, p0 = np.array([[1.0, 0.0, 0.0]]), np.array([0.0, 0.0, 1.0]), np.diag([1.0, 1.0, 0.0])
        truth = oracles.kalman(f, q, h, np.array([[0.49]]), m0, p0, y[r].numpy())
        assert np.allclose(estimate.mean[r].numpy(), truth.mean[:, :2], rtol=1e-9, atol=1e-9)
        assert float(estimate.log_evidence[r]) == pytest.approx(truth.log_evidence.sum(), rel=1e-10)


@every_rule
def test_correlated_measurement_noise(rule: LinearisationRule) -> None:
    c = torch.tensor([[1.0, 0.8, 0.0], [0.8, 1.0, 0.3], [0.0, 0.3, 0.5]], dtype=torch.float64)

    class Correlated(LinearGaussian):
        def observation(self, x: Tensor, u: Any) -> Distribution:
            return MultivariateNormal(x @ self.h.mT, c.expand(*x.shape[:-1], 3, 3))

    model = Correlated(*(getattr(four_states(), k) for k in PARTS))
    y = simulate(model, missing=0.3)
    estimate = run(rule, model, y)
    for r in range(3):
        truth = oracles.kalman(**(matrices(model) | {"r": c.numpy()}), y=y[r].numpy())
        assert np.allclose(estimate.mean[r].numpy(), truth.mean, rtol=1e-8, atol=1e-9)
        assert float(estimate.log_evidence[r]) == pytest.approx(truth.log_evidence.sum(), rel=1e-9)


@every_rule
def test_evidence_equals_pyro_s(rule: LinearisationRule) -> None:
    model = linear_walk(0.5, 0.3, 1.0)
    y = simulate(model)
    q = model.g @ model.g.mT
    hmm = GaussianHMM(
        MultivariateNormal(model.m0, scale_tril=model.l0), model.f.mT, MultivariateNormal(torch.zeros(2).double(), q),
        model.h.mT, MultivariateNormal(torch.zeros(1).double(), torch.diag(model.r**2)), duration=y.shape[1],
    )  # fmt: skip
    assert torch.allclose(run(rule, model, y).log_evidence, hmm.log_prob(y), rtol=1e-9)


@every_rule
@pytest.mark.parametrize(
    ("variance", "expected"), [(1e6, -632.53770), (1e7, -632.54421), (1e12, -632.54563)]
)
def test_nile_with_a_wide_prior(rule: LinearisationRule, variance: float, expected: float) -> None:
    """Durbin and Koopman 2012, chapter 2: the evidence without its first term, which tends to the diffuse one; the last level."""
    model = local_level(
        math.sqrt(1469.1), math.sqrt(15099.0), 0.0, math.sqrt(variance), observes_initial=True
    )
    estimate = run(rule, model, NILE)
    first = math.log(
        oracles.normal_density(NILE[0, 0].numpy(), 0.0, math.sqrt(variance + 15099.0)).item()
    )
    assert float(estimate.log_evidence) - first == pytest.approx(expected, abs=6e-6)
    assert float(estimate.mean[0, -1]) == pytest.approx(798.37029, abs=6e-6)
    assert float(estimate.variance[0, -1]) == pytest.approx(4032.15794, abs=6e-6)


@every_rule
def test_nile_with_a_proper_prior(rule: LinearisationRule) -> None:
    model = local_level(math.sqrt(1470.0), math.sqrt(15100.0), 1000.0, math.sqrt(1000.0))
    assert float(run(rule, model, NILE).log_evidence) == pytest.approx(-638.8133628, abs=6e-8)


@every_rule
def test_a_start_for_each_run(rule: LinearisationRule) -> None:
    model = linear_walk(0.5, 0.3, 1.0)
    y = simulate(model)
    start = torch.tensor([[0.0, 0.0], [5.0, -1.0], [100.0, 3.0]], dtype=torch.float64)
    estimate = run(rule, model, y, start=start)
    for r in range(3):
        truth = oracles.kalman(**(matrices(model) | {"m0": start[r].numpy()}), y=y[r].numpy())
        assert np.allclose(estimate.mean[r].numpy(), truth.mean, rtol=1e-9, atol=1e-9)
    single = run(rule, linear_walk(0.5, 0.3, 1.0).float(), y, start=start)
    assert single.mean.dtype == torch.float32
    assert torch.allclose(single.mean.double(), estimate.mean, rtol=1e-4, atol=1e-3)


# bad conditions


SIGHTS = [
    [[1.0, 0.0]],
    [[0.0, 1.0]],
    [[1.0, 1.0]],
    [[1.0, -1.0], [1.0, 1.0]],
    [[1.0, 0.0], [1.0, 0.0]],
]


@every_rule
@pytest.mark.parametrize("h", SIGHTS, ids=str)
def test_a_prior_of_1e12_against_a_measurement_of_1e_10(
    rule: LinearisationRule, h: list[list[float]]
) -> None:
    """The first step in closed form: what is seen is known to 1e-10, what is not keeps 1e12; evidence without cancellation."""
    rows = len(h)
    model = LinearGaussian(np.eye(2), 1e-6 * np.eye(2), h, [1e-5] * rows, [0.0, 0.0], [1e6, 1e6])
    y = torch.full((1, 1, rows), 123.456, dtype=torch.float64)
    y[0, 0, 1:] += 1e-5
    estimate = run(rule, model, y)
    hs, r2, p = np.array(h), 1e-10, 1e12
    u, sv, vt = np.linalg.svd(hs)
    sv = np.pad(sv, (0, max(0, 2 - len(sv))))
    covariance = vt.T @ np.diag(p * r2 / (sv**2 * p + r2)) @ vt
    e = u.T @ y[0, 0].numpy()
    total = (sv**2 * p)[:rows] + r2
    log_z = -0.5 * (e**2 / total + np.log(2 * np.pi * total)).sum()
    assert not bool(estimate.lost.any())
    found = estimate.trace["covariance"][0, 0].numpy()
    assert np.array_equal(found, found.T)
    assert np.allclose(found, covariance, rtol=1e-6, atol=1e-15 * np.abs(covariance).max())
    assert float(estimate.log_evidence) == pytest.approx(log_z, abs=1e-6)


@every_rule
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_scales_of_1e_9_beside_1e6_stay_positive(
    rule: LinearisationRule, dtype: torch.dtype
) -> None:
    """Metres by the thousand kilometres, coupled to angles by the nanoradian; every correlation matrix keeps a square root."""
    f = np.array([[1.0, 1.0, 0.0], [0.0, 1.0, 9.8], [0.0, 0.0, 1.0]])
    model = LinearGaussian(
        f, np.diag([1e-3, 1e-4, 1e-11]), np.eye(1, 3), [0.1], [0.0] * 3, [1e6, 1.0, 1e-9]
    ).to(dtype)
    y = simulate(model.to(torch.float64), 2, 100)
    truth = [oracles.kalman(**matrices(model), y=y[r].numpy()) for r in range(2)]
    if dtype == torch.float32:  # numbers of 1e6 m are 0.06 m apart, the noise is 0.1 m
        check_refused(
            [
                (
                    "dtype must resolve a tenth of the measurement noise",
                    lambda: run(rule, model.to(dtype), y),
                )
            ],
            remedy=False,
        )
        return
    estimate = run(rule, model.to(dtype), y)
    assert not bool(estimate.lost.any())
    covariance = estimate.trace["covariance"].double().numpy()
    assert np.allclose(covariance, covariance.swapaxes(-1, -2), rtol=0, atol=0)
    sd = np.sqrt(np.diagonal(covariance, axis1=-2, axis2=-1))
    correlation = covariance / (sd[..., None] * sd[..., None, :])
    assert np.linalg.eigvalsh(correlation).min() > -10 * torch.finfo(dtype).eps
    for r in range(2):
        assert np.allclose(
            sd[r], np.sqrt(np.diagonal(truth[r].covariance, axis1=-2, axis2=-1)), rtol=1e-6
        )


@every_rule
@pytest.mark.parametrize("dtype", [torch.float64, torch.float32])
def test_a_component_known_exactly_stays_so(rule: LinearisationRule, dtype: torch.dtype) -> None:
    model = LinearGaussian(
        np.eye(2), [[1e-6], [0.0]], [[1.0, 1.0]], [1e-6], [0.0, 1.0], [[1e-6, 0.0], [0.0, 0.0]]
    ).to(dtype)
    y = 1.0 + 1e-6 * torch.randn(
        1, 10, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    if dtype == torch.float32:
        check_refused(
            [("dtype must resolve a tenth of the measurement noise", lambda: run(rule, model, y))],
            remedy=False,
        )
        return
    estimate = run(rule, model, y)
    assert torch.all(estimate.mean[..., 1] == 1.0)
    assert torch.all(estimate.variance[..., 1] == 0.0)
    truth = oracles.kalman(**matrices(model), y=y[0].numpy())
    assert np.allclose(estimate.variance[0, :, 0].numpy(), truth.covariance[:, 0, 0], rtol=1e-9)


def test_square_roots() -> None:
    scales = torch.tensor([1e6, 1.0, 1e-9], dtype=torch.float64)
    good = (
        torch.tensor([[1.0, 0.9, 0.1], [0.9, 1.0, 0.2], [0.1, 0.2, 1.0]], dtype=torch.float64)
        * scales[:, None]
        * scales
    )
    twin = (
        torch.ones(3, 3, dtype=torch.float64) * scales[:, None] * scales
    )  # rank one: rounding decides
    bad = good.clone()
    bad[0, 1] = bad[1, 0] = 1.5e6
    negative, missing = -good, good.clone()
    missing[1, 1] = torch.nan
    roots, ok = factor(torch.stack([good, twin, bad, negative, missing, torch.zeros_like(good)]))
    assert ok.tolist() == [True, True, False, False, False, True]
    for root, covariance in zip(
        roots[[0, 1, 5]], (good, twin, torch.zeros_like(good)), strict=True
    ):
        assert torch.allclose(root @ root.mT, covariance, rtol=1e-11, atol=0)
        assert torch.all(root.triu(1) == 0)


def test_update_is_invariant_to_the_order_and_units_of_what_is_seen() -> None:
    rng = torch.Generator().manual_seed(0)
    m, r = (torch.randn(5, 4, k, generator=rng, dtype=torch.float64) for k in (3, 1))
    omega = torch.randn(5, 4, 4, generator=rng, dtype=torch.float64)
    omega = omega @ omega.mT + torch.eye(4)
    seen = torch.ones(5, 4, dtype=torch.bool)
    a = torch.randn(4, 4, generator=rng, dtype=torch.float64)
    one = kalman_gain_update(Innovation(r[..., 0], seen, m, omega))
    other = kalman_gain_update(Innovation((a @ r)[..., 0], seen, a @ m, a @ omega @ a.mT))
    assert torch.allclose(one[0], other[0], rtol=1e-8)
    assert torch.allclose(one[1] @ one[1].mT, other[1] @ other[1].mT, rtol=1e-8)
    assert torch.allclose(one[2], other[2] + torch.linalg.slogdet(a)[1], rtol=1e-9)


# runs that fail


class Kick(NamedTuple):
    """An input that is added to the first state [R, T]."""

    kick: Tensor


class Kicked(LinearGaussian):
    def propagate(self, x: Tensor, u: Kick, w: Tensor) -> Tensor:
        return super().propagate(x, u, w) + u.kick[:, None, None]


@dataclasses.dataclass(frozen=True)
class Negative:
    """An adaptation gone wrong: in run 1, from a prediction on, the covariance is not positive."""

    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        size = torch.tensor([1.0, -1e3, 1.0], dtype=torch.float64).reshape(-1, 1, 1)
        return predicted._replace(omega=predicted.omega * size, m=predicted.m * size.clamp(min=0))

    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        return innovation, {}


@dataclasses.dataclass(frozen=True)
class NegativeNoise(Negative):
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        return predicted

    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        size = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64).reshape(-1, 1, 1)
        return innovation._replace(omega=innovation.omega * size), {}


@every_rule
@pytest.mark.parametrize("how", ["input", "measurement", "prediction", "noise"])
def test_a_failing_run_is_lost_alone(rule: LinearisationRule, how: str) -> None:
    plain = linear_walk(0.5, 0.3, 1.0)
    model = Kicked(*(getattr(plain, k) for k in PARTS))
    y, kick = simulate(plain), torch.zeros(3, 25, dtype=torch.float64)
    healthy = run(rule, model, y, Kick(kick))
    y_bad, kick_bad, adaptations = y.clone(), kick.clone(), ()
    if how == "input":
        kick_bad[1, 4] = torch.nan
    elif how == "measurement":
        y_bad[1, 4] = 1e200
    else:
        adaptations = (Negative() if how == "prediction" else NegativeNoise(),)
    estimate = run(rule, model, y_bad, Kick(kick_bad), noise_adaptations=adaptations)
    first = 4 if how in ("input", "measurement") else 0
    assert estimate.lost.tolist() == [False, True, False]
    assert float(estimate.log_evidence[1]) == -math.inf
    assert bool(torch.isnan(estimate.mean[1, first:]).all())
    assert torch.allclose(estimate.mean[1, :first], healthy.mean[1, :first], rtol=1e-12)
    for r in (0, 2):
        assert torch.allclose(estimate.mean[r], healthy.mean[r], rtol=1e-12, atol=1e-14)
        assert torch.allclose(estimate.variance[r], healthy.variance[r], rtol=1e-12, atol=1e-14)


# rules


PLAIN = DifferenceSpace(lambda y, y0: y - y0, lambda y, w: (w.unsqueeze(-1) * y).sum(1))
SCHEMES = [
    CubaturePoints(),
    UnscentedPoints(),
    UnscentedPoints(0.5, 2.0, 1.0),
    UnscentedPoints(1.0, 0.0, -0.5),
    UnscentedPoints(1e-3),
]


def gaussian_moment(powers: tuple[int, ...]) -> float:
    return math.prod(0 if k % 2 else math.prod(range(1, k, 2)) for k in powers)


@pytest.mark.parametrize("scheme", SCHEMES, ids=str)
@pytest.mark.parametrize("d", [1, 2, 3, 5])
def test_points_have_the_normal_law_s_moments_to_third_degree(scheme: Any, d: int) -> None:
    xi, w_mean, w_cov = scheme(d)
    size = float(w_mean.abs().sum())  # of the sums that cancel
    for powers in np.ndindex(*[4] * d):
        if sum(powers) <= 3:
            moment = float((w_mean * (xi ** torch.tensor(powers)).prod(-1)).sum())
            assert moment == pytest.approx(gaussian_moment(powers), abs=1e-14 * max(1.0, size)), (
                powers
            )
    assert torch.allclose(
        (w_cov[:, None] * xi).mT @ xi,
        torch.eye(d, dtype=torch.float64),
        atol=1e-14 * max(1.0, size),
    )


@pytest.mark.parametrize("d", [1, 2])
def test_the_unscented_kappa_of_three_less_d_matches_the_kurtosis(d: int) -> None:
    xi, w, _ = UnscentedPoints(1.0, 0.0, 3.0 - d)(d)
    assert torch.allclose((w[:, None] * xi**4).sum(0), torch.full((d,), 3.0, dtype=torch.float64))


@pytest.mark.parametrize("scheme", SCHEMES[:2], ids=str)
def test_the_mean_of_a_cubic_is_exact(scheme: Any) -> None:
    def cubic(x: Tensor) -> tuple[Tensor, Tensor]:
        a, b = x.unbind(-1)
        return torch.stack([a**2 * b + a * b + 3 * a, b**2 + a - 1], -1), torch.zeros(
            1, 1, 2, 2, dtype=torch.float64
        )

    got = SigmaPointLinearisation(scheme)(cubic, torch.zeros(4, 2, dtype=torch.float64), 2, PLAIN)
    assert torch.allclose(
        got.y, torch.tensor([[0.0, 0.0]], dtype=torch.float64).expand(4, -1), atol=1e-14
    )


def test_noise_that_depends_on_the_state_is_averaged() -> None:
    def law(x: Tensor) -> tuple[Tensor, Tensor]:
        return x, (1.0 + x**2).unsqueeze(-1)

    like = torch.zeros(2, 1, dtype=torch.float64)
    for scheme in SCHEMES[:4]:  # points of equal weights and of others
        assert torch.allclose(
            SigmaPointLinearisation(scheme)(law, like, 1, PLAIN).omega,
            torch.full((2, 1, 1), 2.0, dtype=torch.float64),
        ), scheme
    assert torch.allclose(
        TaylorLinearisation()(law, like, 1, PLAIN).omega,
        torch.full((2, 1, 1), 1.0, dtype=torch.float64),
    )


@every_rule
def test_affine_maps_are_linearised_without_error(rule: LinearisationRule) -> None:
    f = torch.tensor([[1.0, 2.0, -1.0], [0.5, 0.0, 3.0]], dtype=torch.float64)
    unit = torch.eye(2, dtype=torch.float64)
    got = rule(
        lambda x: (x @ f.mT + 7.0, unit.expand(1, 1, 2, 2)),
        torch.zeros(2, 3, dtype=torch.float64),
        3,
        PLAIN,
    )
    assert torch.allclose(got.y, torch.full((2, 2), 7.0, dtype=torch.float64))
    assert torch.allclose(got.m, f.expand(2, -1, -1), atol=1e-14)
    assert torch.allclose(got.omega, unit.expand(2, -1, -1), atol=1e-13)


def test_jacobians_are_the_analytic_ones() -> None:
    model, x = Pendulum(step=0.05), torch.tensor([[0.7, -2.0], [3.13, 1.0]], dtype=torch.float64)

    def through(xi: Tensor) -> tuple[Tensor, Tensor]:
        w = torch.zeros(*xi.shape[:2], 2, dtype=torch.float64)
        return model.propagate(model.chart.add(x.unsqueeze(1), xi), (), w), torch.zeros(
            1, 1, 2, 2
        ).double()

    def look(xi: Tensor) -> tuple[Tensor, Tensor]:
        law = model.observation(x.unsqueeze(1) + xi, ())
        return law.mean, torch.diag_embed(law.variance)

    moved = TaylorLinearisation()(
        through, x, 2, DifferenceSpace(model.chart.subtract, model.chart.mean)
    )
    seen = TaylorLinearisation()(look, x, 2, PLAIN)
    for r, (angle, _) in enumerate(x.tolist()):
        expected = torch.tensor(
            [[1.0, 0.05], [-9.81 * 0.05 * math.cos(angle), 1.0]], dtype=torch.float64
        )
        assert torch.allclose(moved.m[r], expected, rtol=1e-13)
        assert torch.allclose(
            seen.m[r], torch.tensor([[math.cos(angle), 0.0]], dtype=torch.float64), rtol=1e-13
        )
    assert torch.allclose(seen.omega, torch.full((2, 1, 1), 0.09, dtype=torch.float64))


# angles


@every_rule
def test_angles_that_cross_the_cut_change_nothing(rule: LinearisationRule) -> None:
    check_wrapped(GaussianFilter(rule), 40, 1e-8)


@every_rule
def test_measured_angles_that_cross_the_cut_change_nothing(rule: LinearisationRule) -> None:
    y = 0.05 * torch.randn(
        2, 15, 1, dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    )
    east = run(rule, Bearing(), y)
    west = run(rule, Bearing(math.pi), wrap_angle(y + math.pi))
    assert torch.allclose(west.mean, -east.mean, atol=1e-9)
    assert torch.allclose(west.log_evidence, east.log_evidence, rtol=1e-9)


# nonlinear models


@pytest.fixture(scope="module")
def pendulum() -> tuple[Tensor, np.ndarray, np.ndarray]:
    """Measurements [1, T, 1] of a swing of half a radian, and what a plain particle filter in NumPy makes of them [T, 2]."""
    rng = np.random.default_rng(5)
    x, rows = np.array([0.5, -0.3]), []
    for _ in range(60):
        x = np.array([x[0] + 0.05 * x[1], x[1] - 9.81 * 0.05 * np.sin(x[0]) + 0.02 * rng.normal()])
        rows.append(np.sin(x[0]) + 0.3 * rng.normal())
    n = 100_000
    cloud = 0.5 * rng.normal(size=(n, 2))
    root = 0.1 * np.linalg.cholesky([[0.05**3 / 3, 0.05**2 / 2], [0.05**2 / 2, 0.05]])
    means, spreads = [], []
    for value in rows:
        cloud = np.stack(
            [cloud[:, 0] + 0.05 * cloud[:, 1], cloud[:, 1] - 9.81 * 0.05 * np.sin(cloud[:, 0])], -1
        )
        cloud += rng.normal(size=(n, 2)) @ root.T
        w = np.exp(-0.5 * ((value - np.sin(cloud[:, 0])) / 0.3) ** 2)
        w /= w.sum()
        means.append(w @ cloud)
        spreads.append(np.sqrt(w @ (cloud - means[-1]) ** 2))
        cloud = cloud[
            np.searchsorted(np.cumsum(w), (np.arange(n) + rng.random()) / n).clip(max=n - 1)
        ]
    return torch.tensor(rows).reshape(1, -1, 1), np.array(means), np.array(spreads)


@every_rule
def test_pendulum_against_many_particles(
    rule: LinearisationRule, pendulum: tuple[Tensor, np.ndarray, np.ndarray]
) -> None:
    """Swings of half a radian: the neglected curvature sin'' P / 2 is below 0.5 * 0.5^2 / 2 = 0.06 rad, an eighth of the prior's
    spread; the filters must stay within twice that fraction of the posterior's spread, and agree on it to a sixth."""
    y, mean, sd = pendulum
    estimate = run(rule, Pendulum(), y)
    assert np.sqrt((((estimate.mean[0].numpy() - mean) / sd) ** 2).mean()) < 0.25
    assert np.abs(np.log(estimate.variance[0].numpy() / sd**2)).mean() < 2 / 6


@every_rule
@pytest.mark.parametrize(
    "model", [UnivariateGrowth(), Lorenz63(), Pendulum(), Bearing()], ids=lambda m: type(m).__name__
)
def test_nonlinear_models_run_and_the_future_is_not_used(
    rule: LinearisationRule, model: StateSpaceModel
) -> None:
    check_own(GaussianFilter(rule), model, measurements(model, 3, 12))
