"""Robust updates: limits, weights and fixed points against NumPy, rejection as a missing value, counts, evidence."""

import math
from typing import Any

import numpy as np
import pytest
import torch
from filter_cases import method_of
from model_cases import Hidden
from refusals import check_refused
from scipy import optimize, stats
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CorrentropyUpdate,
    CubaturePoints,
    FilterResult,
    GaussianBelief,
    GaussianFilter,
    HuberUpdate,
    InnovationGate,
    ScaledNoise,
    SigmaPointLinearisation,
    StudentUpdate,
    TaylorLinearisation,
    WeightedLikelihoodUpdate,
    run_filter,
)
from pfbench.filter.exactness import check_has_evidence, has_evidence
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.robust.robust_update import (
    WeightFunction,
    cauchy_weight,
    compute_efficiency,
    huber_weight,
    threshold_for_efficiency,
    threshold_table,
    welsch_weight,
)
from pfbench.model.linear_gaussian import LinearGaussian
from pfbench.ppl.likelihood import FilterLikelihood

EKF = TaylorLinearisation()
UPDATES: dict[str, NoiseAdaptation] = {
    "gate": InnovationGate(),
    "huber": HuberUpdate(),
    "student": StudentUpdate(),
    "correntropy": CorrentropyUpdate(),
    "correntropy, prior": CorrentropyUpdate(weight_prior=True),
    "wolf": WeightedLikelihoodUpdate(),
}


def tracker(r: float = 1.0) -> LinearGaussian:
    """Two states and three sensors of unequal noise."""
    h = [[1.0, 0.0], [0.3, 1.0], [0.5, -0.5]]
    sd = [math.sqrt(r), 0.8 * math.sqrt(r), 0.8 * math.sqrt(r)]
    return LinearGaussian(
        [[1.0, 0.5], [0.0, 0.9]], [[0.6, 0.0], [0.2, 0.5]], h, sd, [0.0, 0.0], [1.5, 1.0]
    )


def measurements(
    runs: int = 5, steps: int = 30, outlier: float = 0.0, missing: float = 0.0
) -> Tensor:
    """Measurements [R, T, 3] of the tracker; every seventh step has an outlier in all components."""
    rng, model = np.random.default_rng(3), tracker()
    f, g, h, sd = (getattr(model, name).numpy() for name in ("f", "g", "h", "r"))
    x, rows = rng.normal(size=(runs, 2)), []
    for t in range(steps):
        x = x @ f.T + rng.normal(size=(runs, 2)) @ g.T
        rows.append(x @ h.T + sd * rng.normal(size=(runs, 3)) + outlier * (t % 7 == 6))
    y = np.stack(rows, 1)
    y[rng.random(y.shape) < missing] = np.nan
    return torch.tensor(y)


def run(method: GaussianFilter, y: Tensor, model: LinearGaussian | None = None) -> FilterResult:
    draws = PhiloxStream(0, torch.arange(len(y)))
    return run_filter(method, model or tracker(), Record(y), draws)


def filtered(update: NoiseAdaptation, y: Tensor) -> FilterResult:
    return run(GaussianFilter(EKF, (update,)), y)


def a_step(seed: int = 0, k: int = 4, d: int = 3) -> Innovation:
    """Random innovations of 6 runs with correlated noise, the last component of run 0 missing."""
    rng = np.random.default_rng(seed)
    m = torch.tensor(rng.normal(size=(6, k, d)))
    root = torch.tensor(0.3 * rng.normal(size=(6, k, k)) + np.eye(k))
    r, noise = torch.tensor(3.0 * rng.normal(size=(6, k))), root @ root.mT
    observed = torch.ones(6, k, dtype=torch.bool)
    eye = torch.eye(d, dtype=m.dtype).expand(6, d, d)
    step = Innovation(r, observed, m, noise, noise, noise, eye)
    mask = torch.zeros_like(observed)
    mask[0, -1] = True
    return step.reject(mask)


# limits

LIMITS: dict[str, NoiseAdaptation] = {
    "gate": InnovationGate(1.0),
    "huber": HuberUpdate(1e9),
    "student": StudentUpdate(math.inf),
    "student, large": StudentUpdate(1e13),
    "correntropy": CorrentropyUpdate(1e7),
    "correntropy, prior": CorrentropyUpdate(1e7, weight_prior=True),
    "wolf": WeightedLikelihoodUpdate(threshold=1e7),
    "factors": ScaledNoise(),
}


@pytest.mark.parametrize("update", LIMITS.values(), ids=LIMITS.keys())
def test_the_limit_of_the_parameter_is_the_kalman_filter(update: NoiseAdaptation) -> None:
    y = measurements(outlier=20.0, missing=0.2)
    plain, robust = run(GaussianFilter(EKF), y), filtered(update, y)
    for name in ("mean", "variance", "log_evidence"):
        torch.testing.assert_close(
            getattr(robust, name), getattr(plain, name), rtol=1e-10, atol=1e-10
        )


def test_the_factor_on_r_is_the_model_with_that_noise() -> None:
    y = measurements()
    scaled, larger = filtered(ScaledNoise(4.0), y), run(GaussianFilter(EKF), y, tracker(4.0))
    torch.testing.assert_close(scaled.mean, larger.mean, rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(scaled.log_evidence, larger.log_evidence)


@pytest.mark.parametrize("rule", [EKF, SigmaPointLinearisation(CubaturePoints())])
def test_the_factor_on_q_is_the_model_with_that_noise(rule: Any) -> None:
    model, y = tracker(), measurements()
    parts = model.h, model.r, model.m0, model.l0
    for kind in (LinearGaussian, Hidden):
        wide = kind(model.f, 1.5 * model.g, *parts)
        scaled = run(
            GaussianFilter(rule, (ScaledNoise(1.0, 2.25),)), y, kind(model.f, model.g, *parts)
        )
        torch.testing.assert_close(scaled.mean, run(GaussianFilter(rule), y, wide).mean)


# weights

CONSTANTS = [  # Huber and Ronchetti 2009, Holland and Welsch 1977
    (huber_weight, 1.345),
    (cauchy_weight, 2.385),
    (welsch_weight, 2.985 / math.sqrt(2.0)),
]


@pytest.mark.parametrize(("weight", "constant"), CONSTANTS)
def test_thresholds_are_those_of_the_literature(weight: WeightFunction, constant: float) -> None:
    assert threshold_for_efficiency(weight, 0.95, 1) == pytest.approx(constant, abs=1.5e-3)


def test_the_efficiency_is_that_of_simulated_locations() -> None:
    """M-estimates of 3-component locations by SciPy have the variance that the threshold promises.

    The mean is efficient, so it is not correlated with its difference to another estimate.
    """
    rng, n, repeats = np.random.default_rng(1), 40, 150
    c = threshold_for_efficiency(huber_weight, 0.9, 3)
    excess = []
    for _ in range(repeats):
        e = rng.normal(size=(n, 3))

        def loss(x: Any, e: Any = e) -> float:
            d = np.linalg.norm(e - x, axis=1)
            return float(np.where(d < c, 0.5 * d * d, c * d - 0.5 * c * c).sum())

        difference = optimize.minimize(loss, e.mean(0)).x - e.mean(0)
        excess.append(np.square(difference).sum() * n / 3)
    assert abs(np.mean(excess) - (1 / 0.9 - 1)) < 4 * np.std(excess) / math.sqrt(repeats)


@pytest.mark.parametrize("k", [1, 2, 3, 9, 10, 16])
def test_an_efficiency_below_that_of_small_thresholds_has_no_threshold(k: int) -> None:
    """The least efficiency of Huber's weight is (E d)^2 / k of a chi-distributed d."""
    mean = math.sqrt(2.0) * math.exp(math.lgamma((k + 1) / 2) - math.lgamma(k / 2))
    least = mean**2 / k
    assert math.isnan(threshold_for_efficiency(huber_weight, least - 2e-3, k))
    c = threshold_for_efficiency(huber_weight, least + 2e-3, k)
    assert compute_efficiency(huber_weight, c, k) == pytest.approx(least + 2e-3, abs=1e-6)
    assert (least > 0.95) == (k >= 10)


def test_groups_without_a_threshold_are_refused_and_others_are_not() -> None:
    sixteen = torch.full((1, 16), 16.0)
    check_refused(
        [
            (
                r"at least 0\.97 for a group with k = 16 .*got 0\.95\. Inc",
                lambda: threshold_table(huber_weight, None, 0.95, sixteen),
            )
        ],
        remedy=False,
    )
    assert torch.equal(threshold_table(huber_weight, 2.0, 0.95, sixteen), 2.0 * sixteen / 16)
    single = threshold_table(huber_weight, None, 0.95, torch.ones(1, 16))
    assert torch.allclose(single, torch.full_like(single, 1.345), atol=1.5e-3)


def objective(step: Innovation, run_index: int, threshold: float) -> Any:
    """|xi|^2 / 2 + sum rho(d_i) over the components of a run, in NumPy."""
    mask = step.observed_mask[run_index].numpy()
    m, r = step.m[run_index].numpy()[mask], step.r[run_index].numpy()[mask]
    sd = np.sqrt(np.diag(step.noise[run_index].numpy())[mask])

    def value(xi: Any) -> float:
        d = np.abs(r - m @ xi) / sd
        rho = np.where(d < threshold, 0.5 * d * d, threshold * d - 0.5 * threshold**2)
        return float(0.5 * xi @ xi + rho.sum())

    return value


def diagonal(step: Innovation) -> Innovation:
    noise = torch.diag_embed(step.noise.diagonal(dim1=-2, dim2=-1))
    return step._replace(noise=noise, omega=noise)


def test_many_reweightings_minimise_the_objective_of_huber() -> None:
    step = diagonal(a_step())
    update = HuberUpdate(1.345, iterations=100)
    adapted, _ = update.noise_adapt(step, None)  # type: ignore[arg-type]
    shift, *_ = kalman_gain_update(adapted)
    for i in range(len(shift)):
        value = objective(step, i, 1.345)
        best = optimize.minimize(value, np.zeros(3), tol=1e-12)
        assert value(shift[i].numpy()) <= best.fun + 1e-7
        np.testing.assert_allclose(shift[i].numpy(), best.x, atol=1e-4)


def test_the_scale_of_student_is_the_fixed_point_of_its_equation() -> None:
    """One component, one state: lambda by bisection."""
    p, r, innovation, nu = 2.0, 0.5, 4.0, 3.0

    def excess(scale: float) -> float:
        gain = p / (p + r / scale)
        e2 = (innovation * (1.0 - gain)) ** 2 + (1.0 - gain) * p
        return (nu + 1.0) / (nu + e2 / r) - scale

    root = optimize.brentq(excess, 1e-6, 10.0, xtol=1e-14)
    noise = torch.full((1, 1, 1), r, dtype=torch.float64)
    m = torch.full((1, 1, 1), math.sqrt(p), dtype=torch.float64)
    observed = torch.ones(1, 1, dtype=torch.bool)
    step = Innovation(
        torch.full((1, 1), innovation, dtype=torch.float64), observed, m, noise, noise, noise
    )
    adapted, _ = StudentUpdate(nu, iterations=300).noise_adapt(step, None)  # type: ignore[arg-type]
    assert float(r / adapted.noise) == pytest.approx(root, rel=1e-9)


@pytest.mark.parametrize("weight_prior", [False, True])
def test_correntropy_satisfies_its_fixed_point_equation(weight_prior: bool) -> None:
    step, sigma = diagonal(a_step()), 2.5
    adapted, _ = CorrentropyUpdate(sigma, iterations=300, weight_prior=weight_prior).noise_adapt(
        step,
        None,  # type: ignore[arg-type]
    )
    for i in range(6):
        xi_weighted = kalman_gain_update(adapted)[0][i].numpy()
        xi = adapted.root[i].numpy() @ xi_weighted
        m, r = step.m[i].numpy(), step.r[i].numpy()
        noise = np.diag(step.noise[i].numpy())
        w = np.exp(-((r - m @ xi) ** 2) / noise / (2 * sigma**2))
        prior = np.exp(-(xi**2) / (2 * sigma**2)) if weight_prior else np.ones(3)
        information = np.diag(prior) + m.T @ np.diag(w / noise) @ m
        np.testing.assert_allclose(
            xi, np.linalg.solve(information, m.T @ (w / noise * r)), atol=1e-8
        )


def test_the_weighted_likelihood_is_its_information_form() -> None:
    step, c = a_step(), 2.0
    adapted, _ = WeightedLikelihoodUpdate(threshold=c).noise_adapt(step, None)  # type: ignore[arg-type]
    shift, root, _ = kalman_gain_update(adapted)
    for i in range(6):
        mask = step.observed_mask[i].numpy()
        m, r = step.m[i].numpy()[mask], step.r[i].numpy()[mask]
        precision = np.linalg.inv(step.noise[i].numpy()[np.ix_(mask, mask)])
        w2 = 1.0 / (1.0 + r @ precision @ r / c**2)
        covariance = np.linalg.inv(np.eye(3) + w2 * m.T @ precision @ m)
        np.testing.assert_allclose(
            shift[i].numpy(), w2 * covariance @ m.T @ precision @ r, atol=1e-10
        )
        np.testing.assert_allclose((root[i] @ root[i].T).numpy(), covariance, atol=1e-10)


def test_components_of_a_group_have_one_weight() -> None:
    step = a_step(k=4)
    parts = {"all": [0, 0, 0, 0], "satellite": [0, 1, 0, 1], "component": [0, 1, 2, 3]}
    for grouping, groups in parts.items():
        ratios = []
        for update in (
            HuberUpdate(0.8, grouping=grouping),
            HuberUpdate(0.8, groups=groups),
        ):
            adapted, _ = update.noise_adapt(step, None)  # type: ignore[arg-type]
            variances = [a.diagonal(dim1=-2, dim2=-1)[1:] for a in (adapted.noise, step.noise)]
            ratios.append(variances[0] / variances[1])
        torch.testing.assert_close(*ratios, rtol=0, atol=0)
        for i in range(4):
            torch.testing.assert_close(ratios[0][:, i], ratios[0][:, groups.index(groups[i])])
        distinct = {round(float(v), 9) for v in ratios[0][0]}
        assert len(distinct) == len(set(groups)) or 1.0 in distinct


# rejection


def test_a_rejected_component_is_as_if_it_were_missing() -> None:
    y = measurements(outlier=0.0)
    y[:, 9, 1] += 100.0
    silent = y.clone()
    silent[:, 9, 1] = torch.nan
    update = InnovationGate(1.0 - 1e-12, grouping="component")
    rejected, missing = filtered(update, y), filtered(update, silent)
    for name in ("mean", "variance", "log_evidence"):
        assert torch.equal(getattr(rejected, name), getattr(missing, name))
    assert rejected.trace["rejected"].sum() == len(y)
    assert (rejected.trace["rejected"][:, 9] == 1.0).all()


@pytest.mark.parametrize("grouping", ["all", "sensor", "component"])
def test_the_gate_accepts_nominal_measurements_with_its_probability(grouping: str) -> None:
    """A gate on innovations of the plain Kalman filter, whose distances are independent."""
    p, y = 0.95, measurements(runs=60, steps=60)
    gate, counts = InnovationGate(p, patience=0, grouping=grouping), []

    class Listening(InnovationGate):
        def noise_adapt(self, innovation: Innovation, belief: Any) -> Any:
            counts.append(gate.noise_adapt(innovation, belief)[1]["rejected"])
            return innovation, {}

    filtered(Listening(), y)
    groups = {"all": 1, "sensor": 2, "component": 3}[grouping]
    rejected = torch.stack(counts)
    share, sd = float(rejected.mean()) / groups, float(rejected.std()) / groups
    assert abs(share - (1 - p)) < 4 * sd / math.sqrt(rejected.numel())


def test_a_gate_that_rejects_for_long_opens_again() -> None:
    y = measurements(runs=2, steps=40)
    y[:, 10:] += 300.0  # the state jumps where the filter is sure
    for patience, opens in ((0, False), (5, True)):
        result = filtered(InnovationGate(patience=patience, grouping="all"), y)
        rejected = result.trace["rejected"][:, 10:]
        assert bool((rejected[:, :5] == 1.0).all())
        assert bool((rejected[:, 5:] == 0.0).any()) == opens
        if not opens:
            assert bool((rejected == 1.0).all())


def test_influence_of_an_outlier() -> None:
    """A shift t of one component moves the Kalman filter without limit, and robust updates no further than their bound."""
    shifts: dict[str, list[float]] = {}
    for name, update in {**UPDATES, "kalman": ScaledNoise()}.items():
        for t in (1e2, 1e4, 1e6):
            step = a_step()
            step = step._replace(r=step.r + t * torch.eye(4, dtype=torch.float64)[0])
            adapted, _ = update.noise_adapt(  # type: ignore[call-arg]
                step, GaussianBelief(step.r, step.noise, step.r[:, 0])
            )
            shift = adapted.root @ kalman_gain_update(adapted)[0].unsqueeze(-1)
            shifts.setdefault(name, []).append(float(shift.abs().max()))
    assert shifts["kalman"][2] > 1e3 * shifts["kalman"][0]
    for name in UPDATES:
        assert shifts[name][2] < 6.0, name
        assert abs(shifts[name][2] - shifts[name][1]) < 0.1, name


# one dimension against a grid

SCALE, DOF, Q = 1.0, 3.0, 0.25
GRID = np.arange(-25.0, 25.0, 0.05)


def level_series(series: int = 20, steps: int = 40) -> np.ndarray:
    rng = np.random.default_rng(11)
    x = rng.normal(size=series)[:, None] + np.cumsum(
        math.sqrt(Q) * rng.normal(size=(series, steps)), 1
    )
    return np.asarray(x + SCALE * rng.standard_t(DOF, size=x.shape))


def grid_moments(y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Mean and variance of the local level with Student errors, on a grid, by NumPy alone."""
    kernel = stats.norm.pdf(GRID[:, None] - GRID, scale=math.sqrt(Q))
    kernel = kernel / kernel.sum(1, keepdims=True)
    density = np.tile(stats.norm.pdf(GRID), (len(y), 1))
    means, variances = [], []
    for t in range(y.shape[1]):
        density = (density @ kernel) * stats.t.pdf((y[:, t, None] - GRID) / SCALE, DOF)
        density /= density.sum(1, keepdims=True)
        means.append(density @ GRID)
        variances.append(density @ GRID**2 - means[-1] ** 2)
    return np.stack(means, 1), np.stack(variances, 1)


# rms distance to the grid's mean and ratio of the variances: published bounds of the prototypes, with a margin for other series
AGAINST_THE_GRID = {
    "ekf": (ScaledNoise(), 0.30, 1.5, 0.70, 0.82),
    "student": (StudentUpdate(DOF), 0.03, 0.16, 0.68, 0.85),
    "huber": (HuberUpdate(), 0.05, 0.19, 0.70, 0.86),
    "correntropy": (CorrentropyUpdate(2.0), 0.05, 0.20, 0.76, 0.93),
    "wolf": (WeightedLikelihoodUpdate(threshold=2.0), 0.10, 0.27, 0.84, 1.0),
    "gate": (InnovationGate(), 0.12, 0.42, 0.68, 0.84),
}


def test_distance_to_the_posterior_of_student_errors() -> None:
    """The order and size of the errors of the approximations, by a grid that shares no code."""
    y = level_series()
    mean, variance = grid_moments(y)
    eye = [[1.0]]
    model = LinearGaussian(eye, [[math.sqrt(Q)]], eye, [SCALE], [0.0], [1.0])
    for name, (update, low, high, narrow, wide) in AGAINST_THE_GRID.items():
        result = run(GaussianFilter(EKF, (update,)), torch.tensor(y).unsqueeze(-1), model)
        rms = math.sqrt(np.square(result.mean[..., 0].numpy() - mean).mean())
        ratio = float((result.variance[..., 0].numpy() / variance).mean())
        assert low < rms < high, (name, rms)
        assert narrow < ratio < wide, (name, ratio)


# evidence and counts


def test_which_filters_have_an_evidence() -> None:
    names = "ekf", "ekf_scaled", "fading_kf", "sir", "enkf", "ckf_pf"
    assert all(has_evidence(method_of(name)) for name in names)
    names = "gate", "huber", "student", "correntropy", "wolf", "cofm_mssrckf", "cofm_amssrcpf"
    assert not any(has_evidence(method_of(name)) for name in names)


def test_parameter_inference_refuses_a_filter_without_evidence() -> None:
    check_has_evidence(method_of("ekf_scaled"), "pmmh")
    check_refused(
        [
            (
                r"pmmh must .*, got GaussianFilter .*\. Remove",
                lambda: check_has_evidence(method_of("huber"), "pmmh"),
            ),
            (r"FilterLikelihood must", lambda: FilterLikelihood(method_of("gate"))),
        ],
        remedy=False,
    )


def test_outliers_are_counted() -> None:
    y = measurements(runs=20, steps=35, outlier=40.0)
    for name, update in UPDATES.items():
        if name == "correntropy, prior":  # its prior gives way to an error of all components
            continue
        counts = filtered(update, y).trace["rejected" if name == "gate" else "downweighted"]
        bad = torch.arange(35) % 7 == 6
        groups = {"gate": 2.0, "wolf": 1.0}.get(name, 3.0)
        assert counts[:, bad].mean() > 0.9 * groups, name
        assert counts[:, ~bad].mean() < 0.4 * groups, name


# bad input


def test_the_plain_distance_weighs_in_the_unit_of_the_measurement() -> None:
    step = a_step()
    update = WeightedLikelihoodUpdate("plain", 3.0, grouping="component")
    adapted, _ = update.noise_adapt(step, None)  # type: ignore[arg-type]
    factor = (adapted.noise / step.noise).diagonal(dim1=-2, dim2=-1)[1:]
    torch.testing.assert_close(factor, 1.0 + step.r[1:].square() / 9.0)


@pytest.mark.parametrize(
    ("update", "message"),
    [
        (HuberUpdate(efficiency=0.5), "efficiency must be at least .* k = 1 .*, got 0.5"),
        (HuberUpdate(grouping="satellite"), "grouping must be component for a measurement .*satellite with 3"),
        (InnovationGate(groups=[0, 1]), r"groups must be one number for each of the 3 components .*got \[0, 1\]"),
    ],
)  # fmt: skip
def test_what_does_not_fit_the_measurement_is_refused(update: Any, message: str) -> None:
    check_refused(
        [(message + r".*\. [A-Z]", lambda: filtered(update, measurements(steps=1)))], remedy=False
    )
