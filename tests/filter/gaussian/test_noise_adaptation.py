"""Cubature filters and what adapts them: Kalman's answer, an independent COFM in NumPy, closed forms, exact off switches."""

import dataclasses
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import oracles
import pytest
import torch
from filter_laws import check_lost_alone, check_own
from model_cases import BearingDistance
from scipy.optimize import minimize
from torch import Tensor
from torch.distributions import Distribution, Independent

from pfbench.core import PhiloxStream, Record, wrap_angle
from pfbench.core.density import independent_normal, normal_batch
from pfbench.filter import (
    AxisDegree3,
    AxisDegree5,
    FilterResult,
    GaussianBelief,
    GaussianFilter,
    LinearisationRule,
    RadialDegree3,
    RadialDegree5,
    SigmaPointLinearisation,
    SimplexDegree3,
    SimplexDegree5,
    SphericalRadialPoints,
    TaylorLinearisation,
    run_filter,
)
from pfbench.filter.gaussian.innovation import Innovation, principal_axes
from pfbench.filter.gaussian.noise_adaptation import (
    AdaptiveFactorGain,
    BoundedRatioGain,
    ConstrainedNoiseAdaptation,
    FadingMemory,
    MatrixNoiseAdaptation,
    ScalarNoiseAdaptation,
)
from pfbench.model import LinearGaussian, StateSpaceModel

MIXED = SigmaPointLinearisation(SphericalRadialPoints(SimplexDegree3(), RadialDegree5()))
RULES: dict[str, LinearisationRule] = {
    "ckf3": SigmaPointLinearisation(SphericalRadialPoints(AxisDegree3(), RadialDegree3())),
    "hckf5": SigmaPointLinearisation(SphericalRadialPoints(AxisDegree5(), RadialDegree5())),
    "ssr3": SigmaPointLinearisation(SphericalRadialPoints(SimplexDegree3(), RadialDegree3())),
    "ssr5": SigmaPointLinearisation(SphericalRadialPoints(SimplexDegree5(), RadialDegree5())),
    "mssr": MIXED,
    "ssr53": SigmaPointLinearisation(SphericalRadialPoints(SimplexDegree5(), RadialDegree3())),
    "mckf": SigmaPointLinearisation(SphericalRadialPoints(AxisDegree3(), RadialDegree5())),
}
every_rule = pytest.mark.parametrize("rule", RULES.values(), ids=RULES.keys())
FADING, CONSTRAINED = (FadingMemory(1.002),), (FadingMemory(1.002), ConstrainedNoiseAdaptation())
BOUNDED = (AdaptiveFactorGain(), BoundedRatioGain())
METHODS = {
    "plain": GaussianFilter(MIXED),
    "fading": GaussianFilter(MIXED, FADING),
    "fading, alpha": GaussianFilter(MIXED, FADING, BOUNDED[:1]),
    "cofm": GaussianFilter(MIXED, CONSTRAINED, BOUNDED),
    "trace": GaussianFilter(MIXED, (ScalarNoiseAdaptation(),)),
    "matrix": GaussianFilter(MIXED, (MatrixNoiseAdaptation(0.95),)),
}
every_method = pytest.mark.parametrize("method", METHODS.values(), ids=METHODS.keys())


def run(method: GaussianFilter, model: StateSpaceModel, y: Tensor, **parts: Any) -> FilterResult:
    """Runs a Gaussian filter; its whole covariance is watched as trace["covariance"]."""
    draws = PhiloxStream(0, torch.arange(y.shape[0]))
    return run_filter(
        method,
        model,
        Record(y, **parts),
        draws,
        watch=lambda t, info: {"covariance": info.covariance()},
    )


class Tight(LinearGaussian):
    """Four coupled states seen by two kinds of sensors, five of the one (sd 10) and six of the other (sd 0.1)."""

    def __init__(
        self,
        order: Sequence[int] = range(11),
        units: Sequence[float] = (1.0, 1.0),
        noisy: float = 0.02,
    ) -> None:
        rng = np.random.default_rng(7)
        f = 0.5 * rng.normal(size=(4, 4))
        f *= 0.97 / np.abs(np.linalg.eigvals(f)).max()
        sd = np.array([10.0] * 5 + [0.1] * 6)
        scale = np.array([units[0]] * 5 + [units[1]] * 6)
        h = rng.normal(size=(11, 2)) @ rng.normal(
            size=(2, 4)
        )  # a range of two dimensions: each kind has free axes
        h = h * sd[:, None]
        pick = list(order)
        super().__init__(
            f,
            noisy * np.eye(4),
            (scale[:, None] * h)[pick],
            (scale * sd)[pick],
            np.zeros(4),
            0.3 * np.ones(4),
        )


class Hidden(Tight):
    """The same, keeping its noise gain to itself: the noise goes through the rule, as an unknown beside the state."""

    def noise_gain(self, u: Any) -> None:
        return None


def simulate(
    model: LinearGaussian,
    runs: int,
    steps: int,
    burst: range = range(0),
    r: float = 1.0,
    q: float = 1.0,
    missing: float = 0.0,
) -> Tensor:
    """Measurements [R, T, Dy]; variances r and q times as large in the steps of the burst."""
    rng = np.random.default_rng(1)
    f, g, h, sd = (getattr(model, k).numpy() for k in ("f", "g", "h", "r"))
    x = model.m0.numpy() + rng.normal(size=(runs, len(f))) @ model.l0.numpy().T
    rows = []
    for t in range(steps):
        x = (
            x @ f.T
            + math.sqrt(q if t in burst else 1.0) * rng.normal(size=(runs, g.shape[1])) @ g.T
        )
        rows.append(
            x @ h.T + math.sqrt(r if t in burst else 1.0) * sd * rng.normal(size=(runs, len(h)))
        )
    y = np.stack(rows, 1)
    y[rng.random(y.shape) < missing] = np.nan
    return torch.tensor(y)


# every rule is Kalman's on linear models


@every_rule
@pytest.mark.parametrize("kind", [Tight, Hidden])
def test_every_rule_is_kalman_on_a_linear_model(rule: LinearisationRule, kind: type[Tight]) -> None:
    model = kind()
    y = simulate(model, 3, 20, missing=0.2)
    estimate = run(GaussianFilter(rule), model, y)
    f, h = model.f.numpy(), model.h.numpy()
    q, r, p0 = (
        np.diag(np.diagonal(a) ** 2)
        for a in (model.g.numpy(), np.diag(model.r.numpy()), model.l0.numpy())
    )
    for i in range(3):
        truth = oracles.kalman(f, q, h, r, np.zeros(4), p0, y[i].numpy())
        sd = np.sqrt(np.diagonal(truth.covariance, axis1=1, axis2=2))
        assert np.abs((estimate.mean[i].numpy() - truth.mean) / sd).max() < 1e-10
        off = estimate.trace["covariance"][i].numpy() - truth.covariance
        assert np.abs(off / (sd[:, :, None] * sd[:, None, :])).max() < 1e-10
        assert float(estimate.log_evidence[i]) == pytest.approx(truth.log_evidence.sum(), rel=1e-10)


@every_rule
def test_iterations_change_nothing_on_a_linear_model(rule: LinearisationRule) -> None:
    model = Tight()
    y = simulate(model, 1, 6, missing=0.2)
    for each in (rule, TaylorLinearisation()):
        one, five = (
            run(GaussianFilter(each), model, y),
            run(GaussianFilter(each, iterations=5), model, y),
        )
        assert torch.allclose(one.mean, five.mean, rtol=1e-9, atol=1e-10)
        assert torch.allclose(one.variance, five.variance, rtol=1e-9)
        assert torch.allclose(one.log_evidence, five.log_evidence, rtol=1e-9)


@pytest.mark.parametrize(
    "rule", [*RULES.values(), "adapted", "iterated"], ids=[*RULES, "adapted", "iterated"]
)
def test_a_bearing_that_crosses_the_cut_changes_nothing(rule: LinearisationRule | str) -> None:
    """The scene turned by pi, so that bearings jump: the same estimates turned. A quarter turn swaps the axes of simplex rules,
    which are not alike, so pi, under which every rule is its own mirror image, is the turn to take."""
    methods = {
        "adapted": METHODS["cofm"],
        "iterated": GaussianFilter(TaylorLinearisation(), iterations=4),
    }
    method = (
        methods[rule] if isinstance(rule, str) else GaussianFilter(rule, repair_covariance=True)
    )
    y = torch.tensor([0.05, 0.1]) * torch.randn(
        2, 15, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    )
    y[..., 1] += 2.0
    turned = y.clone()
    turned[..., 0] = wrap_angle(y[..., 0] + math.pi)
    assert float((turned[..., 0] < 0).double().mean()) not in (0.0, 1.0)
    east, west = run(method, BearingDistance(), y), run(method, BearingDistance(math.pi), turned)
    assert not bool(east.lost.any())
    assert torch.allclose(west.mean, -east.mean, atol=1e-9)
    assert torch.allclose(west.log_evidence, east.log_evidence, rtol=1e-9)


def test_the_iterated_filter_finds_the_maximum_a_posteriori() -> None:
    """Bell and Cathey 1993: the iterated update is Gauss-Newton on |x - m|^2_P + |y - h(x)|^2_R; an optimiser that knows nothing
    of it finds the same point, and one iteration does not."""
    model = BearingDistance(sd=(0.3, 0.1))
    y = torch.tensor([[[0.8, 2.2]], [[-0.6, 1.7]]], dtype=torch.float64)
    p = 0.3**2 + 0.05**2

    def cost(x: np.ndarray, seen: np.ndarray) -> float:
        e = np.array([math.atan2(x[1], x[0]), math.hypot(*x)]) - seen
        return float((x[0] - 2.0) ** 2 / p + x[1] ** 2 / p + (e[0] / 0.3) ** 2 + (e[1] / 0.1) ** 2)

    best = np.array([minimize(cost, [2.0, 0.0], args=(row[0],), tol=1e-12).x for row in y.numpy()])
    iterated = (
        run(GaussianFilter(TaylorLinearisation(), iterations=30), model, y).mean[:, 0].numpy()
    )
    once = run(GaussianFilter(TaylorLinearisation()), model, y).mean[:, 0].numpy()
    assert np.allclose(iterated, best, atol=1e-6)
    assert np.abs(once - best).max() > 1e-2


# negative weights


class Steep(StateSpaceModel):
    """Six states that stand still, one seen by its sixth power, or moved by it: HCKF's points find a negative variance."""

    def __init__(self, moves: bool) -> None:
        super().__init__()
        self.register_buffer("s", torch.ones(6, dtype=torch.float64))
        self.names, self.units, self.noise_dim = tuple("abcdef"), ("",) * 6, 6
        self.groups, self.moves = {"state": tuple(range(6))}, moves

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.s)

    def noise_gain(self, u: Any) -> Tensor:
        return 0.1 * torch.eye(6, dtype=torch.float64).unsqueeze(0)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        steep = torch.cat([x[..., :1] ** 6, x[..., 1:]], -1)
        return (steep if self.moves else x) + 0.1 * w

    def observation(self, x: Tensor, u: Any) -> Independent:
        return independent_normal(
            x[..., :1] if self.moves else x[..., :1] ** 6 + x[..., :1], self.s[:1]
        )


@pytest.mark.parametrize("moves", [False, True])
def test_a_covariance_without_root_is_repaired_and_counted_or_the_run_is_lost(moves: bool) -> None:
    y = torch.zeros(3, 1, 1, dtype=torch.float64)
    y[2] = torch.nan
    spread = torch.stack(
        [s * torch.eye(6, dtype=torch.float64) for s in (1e-3, 1.0, 1e-3)]
    )  # only run 1 sees the curvature
    start = torch.zeros(3, 6, dtype=torch.float64)
    strict = run(GaussianFilter(RULES["hckf5"]), Steep(moves), y, start=start, spread=spread)
    lenient = run(
        GaussianFilter(RULES["hckf5"], repair_covariance=True),
        Steep(moves),
        y,
        start=start,
        spread=spread,
    )
    assert strict.lost.tolist() == [False, True, False]
    assert lenient.lost.tolist() == [False, False, False]
    assert lenient.trace["repairs"].flatten().tolist() == [0.0, 1.0, 0.0]
    assert torch.equal(lenient.mean[[0, 2]], strict.mean[[0, 2]])
    assert torch.equal(lenient.variance[[0, 2]], strict.variance[[0, 2]])
    assert bool((torch.linalg.eigvalsh(lenient.trace["covariance"]) > 0).all())
    if not moves:  # a curvature of one dimension that is negative: nothing of it is left
        belief = GaussianBelief(start, spread @ spread.mT, torch.zeros(3, dtype=torch.float64))
        used = (
            GaussianFilter(RULES["hckf5"], repair_covariance=True)
            .advance(Steep(False), belief, Record(y[:, 0]))
            .innovation
        )
        assert float(used.omega[1] - used.noise[1]) == pytest.approx(0.0, abs=1e-9)
    positive = run(
        GaussianFilter(RULES["mssr"], repair_covariance=True),
        Steep(moves),
        y,
        start=start,
        spread=spread,
    )
    assert not bool(positive.trace["repairs"].any())


# an independent COFM, one run at a time, groups and what was seen picked out


def cofm(
    model: Tight,
    y: np.ndarray,
    groups: list[list[int]],
    s: float,
    c0: float,
    least: float,
    highest: float,
) -> list[tuple]:
    """Textbook Kalman filter with the paper's hooks and our fit of r and q, as the specification prints them."""
    f, h = model.f.numpy(), model.h.numpy()
    q0, r0 = model.g.numpy() @ model.g.numpy().T, np.diag(model.r.numpy() ** 2)
    x, p, q, e, raw = (
        np.zeros(4),
        np.diag(model.l0.numpy().diagonal() ** 2),
        1.0,
        0.0,
        np.ones(len(groups)),
    )
    d, tau, r_max, q_max, k_sig, decay = 0.2, 1e-3, 100.0, 1e5, 3.0, 0.8
    rows = []
    for z in y:
        x, p = f @ x, s * f @ p @ f.T + q * q0
        c, v, r = h @ p @ h.T, z - h @ x, np.array(r0)
        num = den = var = rho = 0.0
        for g, members in enumerate(groups):
            at = [i for i in members if not np.isnan(z[i])]
            if not at:
                continue
            size = np.sqrt(r0[at, at])
            lam, u = np.linalg.eigh(c[np.ix_(at, at)] / np.outer(size, size))
            w = u.T @ (v[at] / size)
            free = lam < tau
            if free.any():
                raw[g] = (1 - d) * raw[g] + d * (w[free] ** 2).mean()
            rg = min(max(raw[g], 1.0), r_max)
            r[at, at] = rg * r0[at, at]
            lam, w = lam[~free], w[~free]
            num, den, var = (
                num + ((w**2 - rg) / rg).sum(),
                den + (lam / rg).sum(),
                var + (2 * (1 + lam / rg) ** 2).sum(),
            )
            rho = max([rho, *(lam / rg)])
        if den > 0:
            e = (1 - d) * e + d * (num - den)
            ex = max(e - k_sig * math.sqrt(var * d / (2 - d)), 0.0) / den
        else:
            ex = 0.0
        q = min(max(q * (1 + ex) if ex > 0 else q * decay, 1.0), q_max)
        at = ~np.isnan(z)
        hs, rs, v = h[at], r[np.ix_(at, at)], v[at]
        weight = 1 / np.diagonal(r0)[at]
        total = (weight * np.diagonal(hs @ p @ hs.T + rs)).sum()
        surprise = math.sqrt((weight * v**2).sum() / total) if at.any() else 0.0
        widening = 1.0 if surprise <= c0 else 1.0 / max(c0 / surprise, least)
        if widening * rho > highest:
            widening = max(1.0, highest / rho)
        p = widening * p
        gain = p @ hs.T @ np.linalg.inv(hs @ p @ hs.T + rs)
        total = hs @ p @ hs.T + rs
        log_z = -0.5 * (v @ np.linalg.solve(total, v) + np.linalg.slogdet(2 * np.pi * total)[1])
        x, p = x + gain @ v, p - gain @ total @ gain.T
        rows.append((x, p, q, widening, max(raw), log_z))
    return rows


KINDS = [list(range(5)), list(range(5, 11))]


@pytest.mark.parametrize("highest", [math.inf, 3.0, 1.0])
@pytest.mark.parametrize("kind", [Tight, Hidden])
def test_constrained_optimised_fading_memory_against_numpy(
    kind: type[Tight], highest: float
) -> None:
    model = kind(noisy=0.1)
    y = simulate(model, 3, 60, range(20, 40), r=9.5, q=400.0, missing=0.1)
    y[1, 30], y[2, 25, :5] = torch.nan, torch.nan
    gains = (AdaptiveFactorGain(1.2, 0.2), BoundedRatioGain(highest))
    estimate = run(
        GaussianFilter(MIXED, (FadingMemory(1.01), ConstrainedNoiseAdaptation()), gains), model, y
    )
    widened = 0
    for i in range(3):
        rows = cofm(model, y[i].numpy(), KINDS, 1.01, 1.2, 0.2, highest)
        x, p, q, widening, r, log_z = (np.array(a) for a in zip(*rows, strict=True))
        sd = np.sqrt(np.diagonal(p, axis1=1, axis2=2))
        assert np.allclose(estimate.trace["q"][i].numpy(), q, rtol=1e-6)
        assert np.allclose(estimate.trace["r"][i].numpy(), r, rtol=1e-8)
        assert np.allclose(estimate.trace["widening"][i].numpy(), widening, rtol=1e-6)
        assert np.abs((estimate.mean[i].numpy() - x) / sd).max() < 1e-6
        assert (
            np.abs(
                (estimate.trace["covariance"][i].numpy() - p) / (sd[:, :, None] * sd[:, None, :])
            ).max()
            < 1e-6
        )
        assert float(estimate.log_evidence[i]) == pytest.approx(log_z.sum(), rel=1e-7)
        assert q.max() > 3.0
        widened += int((widening > 1.0).sum())
    assert widened > 0


# switches that switch off, exactly


OFF = {
    "fading": ((FadingMemory(1.0),), ()),
    "fading, no threshold": ((FadingMemory(1.0),), (AdaptiveFactorGain(math.inf),)),
    "constrained noise": (
        (ConstrainedNoiseAdaptation(max_r_factor=1.0, max_q_factor=1.0),),
        (BoundedRatioGain(math.inf),),
    ),
    "trace": ((ScalarNoiseAdaptation(max_r_factor=1.0),), ()),
    "matrix": ((MatrixNoiseAdaptation(1.0),), ()),
    "a bound below every ratio": ((), (AdaptiveFactorGain(0.5), BoundedRatioGain(0.0))),
}


@pytest.mark.parametrize("kind", [Tight, Hidden])
@pytest.mark.parametrize("off", OFF)
def test_what_is_switched_off_leaves_every_bit(off: str, kind: type[Tight]) -> None:
    model = kind()
    y = simulate(model, 2, 20, range(5, 10), r=9.0, missing=0.1)
    plain, other = run(METHODS["plain"], model, y), run(GaussianFilter(MIXED, *OFF[off]), model, y)
    assert torch.equal(plain.mean, other.mean)
    assert torch.equal(plain.variance, other.variance)
    assert torch.equal(plain.log_evidence, other.log_evidence)


def test_constrained_noise_switched_off_leaves_the_fading_filter() -> None:
    model = Tight()
    y = simulate(model, 2, 20, range(5, 10), r=9.0)
    off = (FadingMemory(1.01), ConstrainedNoiseAdaptation(max_r_factor=1.0, max_q_factor=1.0))
    one = run(GaussianFilter(MIXED, (FadingMemory(1.01),), (AdaptiveFactorGain(),)), model, y)
    other = run(
        GaussianFilter(MIXED, off, (AdaptiveFactorGain(), BoundedRatioGain(math.inf))), model, y
    )
    assert torch.equal(one.mean, other.mean)
    assert not torch.equal(one.mean, run(METHODS["plain"], model, y).mean)


# fading memory


@every_rule
def test_fading_is_least_squares_with_falling_weights(rule: LinearisationRule) -> None:
    """A state that stands still: information S^-k P0^-1 + sum_j S^-(k - j) H' R^-1 H."""
    s, steps = 1.05, 12
    h = np.random.default_rng(2).normal(size=(3, 2))
    model = LinearGaussian(np.eye(2), np.zeros((2, 1)), h, [0.5, 1.0, 2.0], [1.0, -1.0], [3.0, 2.0])
    y = simulate(model, 2, steps)
    estimate = run(GaussianFilter(rule, (FadingMemory(s),)), model, y)
    each = h.T @ np.diag(1 / np.array([0.5, 1.0, 2.0]) ** 2)
    prior = np.diag([1 / 9, 1 / 4]) * s**-steps
    for i in range(2):
        weight = s ** -(steps - 1.0 - np.arange(steps))
        information = prior + weight.sum() * each @ h
        mean = np.linalg.solve(information, prior @ [1.0, -1.0] + each @ (weight @ y[i].numpy()))
        assert np.allclose(estimate.mean[i, -1].numpy(), mean, rtol=1e-12)
        assert np.allclose(
            estimate.trace["covariance"][i, -1].numpy(), np.linalg.inv(information), rtol=1e-11
        )


@pytest.mark.parametrize("through_the_rule", [False, True])
def test_all_that_was_carried_over_fades_and_the_noise_does_not(through_the_rule: bool) -> None:
    """P- = S C_f + Q, where C_f of a curved map is more than its linearisation tells."""
    model, s = Steep(True), 1.3
    if through_the_rule:
        model.noise_gain = lambda u: None  # type: ignore[method-assign, assignment, return-value]
    mean, seen = (
        0.3 * torch.ones(2, 6, dtype=torch.float64),
        Record(torch.zeros(2, 1, dtype=torch.float64)),
    )
    belief = GaussianBelief(
        mean,
        0.2 * torch.eye(6, dtype=torch.float64).expand(2, 6, 6),
        torch.zeros(2, dtype=torch.float64),
    )
    plain, faded = (
        GaussianFilter(MIXED, a).advance(model, belief, seen).prior_root
        for a in ((), (FadingMemory(s),))
    )
    noise = 0.01 * torch.eye(6, dtype=torch.float64)
    assert torch.allclose(
        faded @ faded.mT - noise, s * (plain @ plain.mT - noise), rtol=1e-10, atol=1e-12
    )


# the adaptive factor and the bound


def scalar(p: float = 1.0, r: float = 1.0) -> LinearGaussian:
    return LinearGaussian([[1.0]], [[0.0]], [[1.0]], [math.sqrt(r)], [0.0], [math.sqrt(p)])


def test_the_adaptive_factor_by_hand() -> None:
    """P = 1, R = 1, v = 10, c0 = 1.5: dV = 7.0711, alpha = 0.21213, K = 4.7140 / 5.7140 = P+."""
    y = torch.full((1, 1, 1), 10.0, dtype=torch.float64)
    estimate = run(GaussianFilter(MIXED, (), (AdaptiveFactorGain(1.5),)), scalar(), y)
    alpha = 1.5 / math.sqrt(50.0)
    gain = (1 / alpha) / (1 / alpha + 1)
    assert 1 / float(estimate.trace["widening"]) == pytest.approx(alpha, rel=1e-12)
    assert alpha == pytest.approx(0.21213, abs=5e-6)
    assert float(estimate.mean) == pytest.approx(10.0 * gain, rel=1e-12)
    assert float(estimate.variance) == pytest.approx(gain, rel=1e-12)
    assert gain == pytest.approx(0.82499, abs=5e-6)
    floored = run(
        GaussianFilter(MIXED, (), (AdaptiveFactorGain(1.5, min_factor=0.5),)), scalar(), y
    )
    assert float(floored.trace["widening"]) == 2.0


@pytest.mark.parametrize(("p", "v", "highest", "lowest", "widening"), [
    (1.0, 10.0, 2.0, 0.0, 2.0),     # 4.714 P / R is cut to 2
    (1.0, 10.0, 0.5, 0.0, 1.0),     # P / R = 1 is above the bound: never narrowed
    (1.0, 10.0, 9.0, 0.0, 4.7140452),
    (0.1, 0.0, 9.0, 0.5, 5.0),      # P / R = 0.1 is raised to 0.5
])  # fmt: skip
def test_the_bound_by_hand(
    p: float, v: float, highest: float, lowest: float, widening: float
) -> None:
    y = torch.full((1, 1, 1), v, dtype=torch.float64)
    estimate = run(
        GaussianFilter(MIXED, (), (AdaptiveFactorGain(1.5), BoundedRatioGain(highest, lowest))),
        scalar(p),
        y,
    )
    assert float(estimate.trace["widening"]) == pytest.approx(widening, rel=1e-7)


def test_the_widened_ratio_stays_bounded() -> None:
    """f rho never above the larger of rho and the bound, rho being the largest eigenvalue of any group, by NumPy."""
    rng = np.random.default_rng(0)
    m, k = rng.normal(size=(50, 6, 3)) * rng.uniform(0.05, 3.0, size=(50, 1, 1)), 6
    noise = np.diag([1.0, 1.0, 1.0, 4.0, 4.0, 4.0])
    r = torch.tensor(5.0 * rng.normal(size=(50, k)))
    whole = torch.tensor(noise).expand(50, k, k)
    innovation = Innovation(
        r,
        torch.ones(50, k, dtype=torch.bool),
        torch.tensor(m),
        whole,
        whole,
        whole,
        torch.eye(3).double(),
    )
    wide = AdaptiveFactorGain()(innovation, torch.ones(50, dtype=torch.float64))
    f = BoundedRatioGain(1.0)(innovation, wide).numpy()
    c = m @ m.swapaxes(1, 2)
    rho = np.maximum(
        np.linalg.eigvalsh(c[:, :3, :3]).max(1), np.linalg.eigvalsh(c[:, 3:, 3:]).max(1) / 4.0
    )
    assert np.all(f * rho <= np.maximum(rho, 1.0) * (1 + 1e-12))
    assert np.allclose(
        f, np.where(wide.numpy() * rho > 1.0, np.maximum(1.0, 1.0 / rho), wide.numpy()), rtol=1e-12
    )
    assert (wide.numpy() > f).any()
    assert (f > 1).any()


def test_the_factor_widens_what_is_expected_of_a_curved_sight_as_a_whole() -> None:
    """P_zz = C_zz / alpha + R, P_xz = C_xz / alpha, P+ = P- / alpha - K P_zz K', in which C_zz holds the curvature."""
    model, y = (
        BearingDistance(sd=(0.05, 0.1)),
        torch.tensor([[0.9, 3.1], [-0.4, 1.2]], dtype=torch.float64),
    )
    belief = GaussianFilter(MIXED).init(model, 2, PhiloxStream(0, torch.arange(2)))
    whole = [
        GaussianFilter(MIXED, (), gains).advance(model, belief, Record(y))
        for gains in ((), (AdaptiveFactorGain(1.1),))
    ]
    (plain, seen), (wide, f) = (
        (whole[0], whole[0].innovation),
        (whole[1], whole[1].trace["widening"][:, None, None]),
    )
    assert float(f.min()) > 1.2
    left = seen.predicted_covariance - seen.m @ seen.m.mT
    assert (
        float(
            (
                left.diagonal(dim1=1, dim2=2) / seen.predicted_covariance.diagonal(dim1=1, dim2=2)
            ).max()
        )
        > 0.01
    )
    p = f * plain.prior_root @ plain.prior_root.mT
    cross, total = f * plain.prior_root @ seen.m.mT, f * seen.predicted_covariance + seen.nominal
    gain = torch.linalg.solve(total, cross.mT).mT
    mean = plain.prior + (gain @ seen.r.unsqueeze(-1)).squeeze(-1)
    assert torch.allclose(wide.mean, mean, rtol=1e-9, atol=1e-11)
    assert torch.allclose(
        wide.root @ wide.root.mT, p - gain @ total @ gain.mT, rtol=1e-8, atol=1e-11
    )
    expected = torch.distributions.MultivariateNormal(torch.zeros(2).double(), total).log_prob(
        seen.r
    )
    assert torch.allclose(wide.log_likelihood, expected, rtol=1e-9)


# what innovations tell of R and Q


@pytest.mark.slow
def test_a_burst_of_measurement_noise_is_told_from_a_burst_of_process_noise() -> None:
    """E r = 9.5 - 8.5 0.8^k after k steps of the burst, whatever the state does; q stays where it is, since its dead band is of
    three standard deviations. With the other burst r stays 1 and q grows."""
    model, runs, burst = Tight(noisy=0.3), 100, range(40, 60)
    beliefs = carried(METHODS["cofm"], model, simulate(model, runs, 60, burst, r=9.5))
    for k in (5, 15, 20):
        r = beliefs[40 + k]["r"][:, [0, 5]]  # of the ranges, of the rates
        expected = 9.5 - 8.5 * 0.8**k
        assert bool(((r.mean(0) - expected).abs() < 4.5 * r.std(0) / math.sqrt(runs)).all())
    assert float(beliefs[55]["r"].mean()) == pytest.approx(9.5, rel=0.1)
    q = torch.stack([belief["q"] for belief in beliefs[1:]])
    assert float(q[40:].median()) == 1.0
    assert float(q[40:].mean()) < 3.0
    shaken = simulate(model, runs, 60, burst, q=1e4)
    r, q = (carried(METHODS["cofm"], model, shaken)[60][name] for name in ("r", "q"))
    assert bool(
        ((r[:, [0, 5]].mean(0) - 1.0).abs() < 4.5 * r[:, [0, 5]].std(0) / math.sqrt(runs)).all()
    )
    assert float(q.median()) > 100.0


def carried(method: GaussianFilter, model: StateSpaceModel, y: Tensor) -> list[dict[str, Tensor]]:
    """What adaptations remember after 0, 1, 2 ... steps."""
    draws = PhiloxStream(0, torch.arange(len(y)))
    belief = method.init(model, len(y), draws)
    found = [belief.memory]
    for t in range(y.shape[1]):
        belief, _ = method.step(model, belief, Record(y[:, t]), draws)
        found.append(belief.memory)
    return found


@pytest.mark.slow
def test_constrained_noise_costs_little_in_calm_and_helps_in_bursts() -> None:
    """The published comparison in miniature, all filters on the same worlds: rms errors, those of the plain filter being 1."""
    model, runs, burst = Tight(noisy=0.1), 60, range(40, 60)
    ratios = {}
    for name, r, q in (("calm", 1.0, 1.0), ("r", 9.5, 1.0), ("q", 1.0, 1e4)):
        y = simulate(model, runs, 60, burst, r, q)
        truth = states(model, runs, 60, burst, q)
        rms = [
            float((run(METHODS[m], model, y).mean - truth)[:, 40:].square().mean().sqrt())
            for m in ("plain", "cofm")
        ]
        ratios[name] = rms[1] / rms[0]
    assert ratios["calm"] < 1.05
    assert ratios["r"] < 1.0
    assert ratios["q"] < 0.7


def states(model: LinearGaussian, runs: int, steps: int, burst: range, q: float) -> Tensor:
    """The states behind `simulate`, from the same draws."""
    rng = np.random.default_rng(1)
    x = model.m0.numpy() + rng.normal(size=(runs, 4)) @ model.l0.numpy().T
    rows = []
    for t in range(steps):
        x = (
            x @ model.f.numpy().T
            + math.sqrt(q if t in burst else 1.0) * rng.normal(size=(runs, 4)) @ model.g.numpy().T
        )
        rows.append(x)
        rng.normal(size=(runs, 11))
    return torch.tensor(np.stack(rows, 1))


def test_without_free_axes_the_measurement_noise_is_left_alone() -> None:
    """Two components, two states behind them: what is noise and what is error cannot be told apart."""
    model = LinearGaussian(
        np.eye(2), 0.1 * np.eye(2), np.eye(2), [1.0, 1.0], [0.0, 0.0], [1.0, 1.0]
    )
    memory = carried(METHODS["cofm"], model, simulate(model, 5, 30, range(10, 30), r=50.0))[-1]
    assert torch.equal(memory["r"], torch.ones(5, 2, dtype=torch.float64))


# invariance


@pytest.mark.parametrize("units", [(1e-3, 3.6), (1e-6, 1e-5)], ids=["km, km/h", "small numbers"])
@pytest.mark.parametrize("name", ["cofm", "fading, alpha", "trace", "matrix"])
def test_units_and_order_of_measurements_change_nothing(
    name: str, units: tuple[float, float]
) -> None:
    order = np.random.default_rng(3).permutation(11)
    y = simulate(Tight(), 3, 40, range(15, 25), r=9.0, q=50.0, missing=0.1)
    scale = torch.tensor([units[0]] * 5 + [units[1]] * 6, dtype=torch.float64)
    one = run(METHODS[name], Tight(), y)
    other = run(METHODS[name], Tight(order, units), (y * scale)[..., order])
    assert torch.allclose(one.mean, other.mean, rtol=1e-6, atol=1e-8)
    assert torch.allclose(one.variance, other.variance, rtol=1e-6)


def test_the_printed_factor_depends_on_the_units() -> None:
    y = simulate(Tight(), 3, 40, range(15, 25), r=9.0)
    scale = torch.tensor([1e-3] * 5 + [1.0] * 6, dtype=torch.float64)
    printed = GaussianFilter(MIXED, FADING, (AdaptiveFactorGain(weight_by_noise=False),))
    one, other = run(printed, Tight(), y), run(printed, Tight(units=(1e-3, 1.0)), y * scale)
    assert not torch.allclose(one.mean, other.mean, rtol=1e-3, atol=1e-4)


class Correlated(Tight):
    """The same, sensors of a kind sharing a part of their noise."""

    def observation(self, x: Tensor, u: Any) -> Distribution:
        alike = (self.r.unsqueeze(-1) == self.r).to(self.r)
        covariance = (
            (0.6 * alike + 0.4 * torch.eye(len(self.r)).to(self.r)) * self.r.unsqueeze(-1) * self.r
        )
        return torch.distributions.MultivariateNormal(
            x @ self.h.mT, covariance.expand(*x.shape[:-1], -1, -1)
        )


@pytest.mark.parametrize(
    ("model", "missing"),
    [(Tight, [2, 5, 9]), (Correlated, [0, 3, 5, 8])],
    ids=["alone", "with noise that others share"],
)
@every_method
def test_a_component_that_is_never_seen_is_as_if_it_did_not_exist(
    method: GaussianFilter, model: type[Tight], missing: list[int]
) -> None:
    seen = [k for k in range(11) if k not in missing]
    y = simulate(Tight(), 3, 30, range(10, 20), r=9.0, q=50.0)
    y[..., missing] = torch.nan
    whole, part = run(method, model(), y), run(method, model(seen), y[..., seen])
    assert torch.allclose(whole.mean, part.mean, rtol=1e-7, atol=1e-9)
    assert torch.allclose(whole.log_evidence, part.log_evidence, rtol=1e-8)


def test_axes_are_in_units_of_the_model_s_noise_whatever_is_in_use() -> None:
    y, model = simulate(Tight(), 4, 1, missing=0.2)[:, 0], Tight()
    seen = (
        METHODS["plain"]
        .advance(
            model, METHODS["plain"].init(model, 4, PhiloxStream(0, torch.arange(4))), Record(y)
        )
        .innovation
    )
    for one, other in zip(
        principal_axes(seen), principal_axes(seen.with_noise(9.0 * seen.nominal)), strict=True
    ):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("kind", [Tight, Hidden])
def test_fading_and_doubt_of_the_noise_come_in_any_order(kind: type[Tight]) -> None:
    """P- = S C_f + q Q either way: the one leaves alone what the other scales."""
    y = simulate(Tight(), 3, 30, range(10, 20), q=400.0)
    for doubt in (ConstrainedNoiseAdaptation(), MatrixNoiseAdaptation(0.9)):
        one, other = (
            run(GaussianFilter(MIXED, order), kind(), y)
            for order in ((FadingMemory(1.2), doubt), (doubt, FadingMemory(1.2)))
        )
        assert torch.allclose(one.mean, other.mean, rtol=1e-9, atol=1e-10)
        assert torch.allclose(one.variance, other.variance, rtol=1e-9)


@every_method
def test_runs_do_not_feel_each_other(method: GaussianFilter) -> None:
    y = simulate(Tight(), 4, 30, range(10, 20), r=9.0, q=50.0, missing=0.2)
    y[0, 5:9] = torch.nan
    check_own(method, Tight(), y, 1e-8)
    check_lost_alone(method, Tight(), y)


@every_method
def test_noise_through_the_rule_equals_noise_by_its_gain(method: GaussianFilter) -> None:
    y = simulate(Tight(), 3, 30, range(10, 20), r=9.0, q=50.0, missing=0.1)
    one, other = run(method, Tight(), y), run(method, Hidden(), y)
    assert torch.allclose(one.mean, other.mean, rtol=1e-7, atol=1e-9)
    assert torch.allclose(one.variance, other.variance, rtol=1e-7)


@every_method
def test_a_filter_in_single_precision_stays_there(method: GaussianFilter) -> None:
    y = simulate(Tight(), 2, 20, range(10, 15), r=9.0)
    double, single = run(method, Tight(), y), run(method, Tight().float(), y)
    assert single.mean.dtype == torch.float32
    assert torch.allclose(
        single.mean.double(), double.mean, atol=0.02 * float(double.variance.sqrt().max())
    )


def test_groups_by_number_are_groups_by_variance() -> None:
    y = simulate(Tight(), 3, 30, range(10, 20), r=9.0, q=50.0, missing=0.2)
    numbers = [0] * 5 + [1] * 6
    told = GaussianFilter(
        MIXED,
        (FadingMemory(1.002), ConstrainedNoiseAdaptation(groups=numbers)),
        (AdaptiveFactorGain(), BoundedRatioGain(1.0, groups=numbers)),
    )
    one, other = run(told, Tight(), y), run(METHODS["cofm"], Tight(), y)
    assert torch.equal(one.mean, other.mean)
    joined = run(
        GaussianFilter(
            MIXED, (FadingMemory(1.002), ConstrainedNoiseAdaptation(groups=[0] * 11)), BOUNDED
        ),
        Tight(),
        y,
    )
    assert not torch.equal(joined.mean, one.mean)


# the other ways to learn noise


def test_residuals_and_corrections_tell_the_noise_on_average() -> None:
    """E (e e' + H P+ H') = R and E K v v' K' = K P_zz K' on a model that is right."""
    runs, model = 5_000, Tight()
    memory = carried(
        GaussianFilter(MIXED, (MatrixNoiseAdaptation(0.5),)), model, simulate(model, runs, 1)
    )[-1]
    h, sd = model.h.numpy(), model.r.numpy()
    p = 0.3**2 * model.f.numpy() @ model.f.numpy().T + model.g.numpy() @ model.g.numpy().T
    s = h @ p @ h.T + np.diag(sd**2)
    gain = p @ h.T @ np.linalg.inv(s)
    learned = memory["measurement"].mean(0).numpy() / 0.5
    left = s - h @ p @ h.T @ np.linalg.solve(
        s, h @ p @ h.T
    )  # any scale of the right size serves for the tolerance
    size = np.sqrt(np.outer(left.diagonal(), left.diagonal()))
    assert np.abs((learned - np.diag(sd**2)) / size).max() < 5.0 * math.sqrt(2.0 / runs)
    process = memory["process"].mean(0).numpy() / 0.5
    expected = gain @ s @ gain.T
    size = np.sqrt(np.outer(expected.diagonal(), expected.diagonal()))
    assert np.abs((process - expected) / size).max() < 5.0 * math.sqrt(2.0 / runs)


def test_what_is_left_of_a_curved_sight_holds_its_curvature() -> None:
    """e e' + C+_zz, where C+_zz is what the line through C_zz leaves after the update, and all that no line explains."""
    model, y = (
        BearingDistance(sd=(0.05, 0.1)),
        torch.tensor([[0.9, 3.1], [-0.4, 1.2]], dtype=torch.float64),
    )
    method = GaussianFilter(MIXED, (MatrixNoiseAdaptation(0.75),))
    new = method.advance(model, method.init(model, 2, PhiloxStream(0, torch.arange(2))), Record(y))
    seen = new.innovation
    line = seen.m @ seen.m.mT
    gain = torch.linalg.solve(seen.predicted_covariance + seen.nominal, line).mT
    e = seen.r.unsqueeze(-1) - gain @ seen.r.unsqueeze(-1)
    left = line - gain @ line + (seen.predicted_covariance - line)
    assert float((seen.predicted_covariance - line).abs().max()) > 0.1 * float(left.abs().max())
    assert torch.allclose(
        new.memory["measurement"], 0.25 * (e @ e.mT + left), rtol=1e-9, atol=1e-12
    )


def test_learned_matrices_are_used_and_forgotten_at_the_stated_rate() -> None:
    model = scalar(p=0.5)
    y = torch.tensor([[[1.0], [0.5], [2.0]]], dtype=torch.float64)
    estimate = run(GaussianFilter(MIXED, (MatrixNoiseAdaptation(0.8),)), model, y)
    x, p, q, r = 0.0, 0.5, 0.0, 1.0
    for t, z in enumerate([1.0, 0.5, 2.0]):
        prior = p + q
        gain = prior / (prior + r)
        v = z - x
        x, p = x + gain * v, (1 - gain) * prior
        r, q = 0.8 * r + 0.2 * ((z - x) ** 2 + p), 0.8 * q + 0.2 * (gain * v) ** 2
        assert float(estimate.mean[0, t]) == pytest.approx(x, rel=1e-10)
        assert float(estimate.variance[0, t]) == pytest.approx(p, rel=1e-10)


def test_one_factor_from_the_trace_by_hand() -> None:
    y = torch.tensor([[[3.0], [math.nan], [4.0]]], dtype=torch.float64)
    estimate = run(
        GaussianFilter(MIXED, (ScalarNoiseAdaptation(forgetting_factor=0.5),)), scalar(r=2.0), y
    )
    x, p, surprise = 0.0, 1.0, 1.0
    for t, z in enumerate([3.0, None, 4.0]):
        if z is not None:
            surprise = 0.5 * surprise + 0.5 * (z - x) ** 2 / 2.0
            r = max(surprise - p / 2.0, 1.0)
            gain = p / (p + 2.0 * r)
            x, p = x + gain * (z - x), (1 - gain) * p
        assert float(estimate.mean[0, t]) == pytest.approx(x, rel=1e-12)
        assert float(estimate.variance[0, t]) == pytest.approx(p, rel=1e-12)


# on the way


def test_a_step_in_full_says_what_the_step_says() -> None:
    model, method = Tight(), METHODS["cofm"]
    y = simulate(model, 3, 1)
    draws = PhiloxStream(0, torch.arange(3))
    belief = method.init(model, 3, draws)
    (after, info), whole = (
        method.step(model, belief, Record(y[:, 0]), draws),
        method.advance(model, belief, Record(y[:, 0])),
    )
    assert torch.equal(whole.mean, after.mean)
    assert torch.equal(whole.root @ whole.root.mT, after.covariance)
    assert torch.equal(whole.log_likelihood, after.log_evidence)
    h, p = model.h, whole.prior_root @ whole.prior_root.mT
    s = h @ p @ h.mT + whole.innovation.noise
    v = y[:, 0] - whole.prior @ h.mT
    mean = whole.prior + (p @ h.mT @ torch.linalg.solve(s, v.unsqueeze(-1))).squeeze(-1)
    assert torch.allclose(mean, whole.mean, rtol=1e-9, atol=1e-11)
    assert set(info.trace) == {"r", "excess", "q", "widening"}


@dataclasses.dataclass(frozen=True)
class Spy:
    """An adaptation that changes nothing and remembers how often it was asked."""

    def predict_scale(self, predicted: Any, belief: GaussianBelief) -> Any:
        return predicted

    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        return innovation, {
            "asked": belief.memory.get("asked", torch.zeros_like(innovation.r[:, 0])) + 1.0
        }


def test_what_an_adaptation_remembers_is_carried_and_traced() -> None:
    y = simulate(Tight(), 2, 4)
    assert (
        run(GaussianFilter(MIXED, (Spy(),)), Tight(), y).trace["asked"].tolist()
        == [[1.0, 2.0, 3.0, 4.0]] * 2
    )


def test_groups_are_one_number_for_each_component() -> None:
    method = GaussianFilter(MIXED, (ConstrainedNoiseAdaptation(groups=[0, 1]),))
    with pytest.raises(ValueError, match="groups must have 11 group numbers"):
        run(method, Tight(), simulate(Tight(), 1, 1))
