"""Cubature rules as sphere times radius: exact moments to the stated degree, closed forms beyond it, and signs of weights."""

import itertools
import math

import numpy as np
import pytest
import torch
from rule_cases import RULES
from torch import Tensor

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    AxisDegree3,
    AxisDegree5,
    CubaturePoints,
    GaussianFilter,
    RadialDegree5,
    SigmaPointLinearisation,
    SimplexDegree3,
    SimplexDegree5,
    SphericalRadialPoints,
    SphericalRule,
    UnscentedPoints,
    run_filter,
)
from pfbench.model import Lorenz63, StateSpaceModel

COUNTS = {
    "ckf3": lambda n: 2 * n,
    "hckf5": lambda n: 2 * n * n + 1,
    "ssr3": lambda n: 2 * n + 2,
    "ssr5": lambda n: n * n + 3 * n + 3,
    "mssr": lambda n: 2 * n + 3,
    "ssr53": lambda n: n * n + 3 * n + 2,
    "mckf": lambda n: 2 * n + 1,
}
SIZES = (1, 2, 3, 5, 7, 8, 17)
every_rule = pytest.mark.parametrize("name", RULES)
every_size = pytest.mark.parametrize("n", SIZES)


def points(name: str, n: int) -> tuple[np.ndarray, np.ndarray]:
    xi, w, w_cov = RULES[name](n)
    assert torch.equal(w, w_cov)
    return xi.numpy(), w.numpy()


def moment(xi: np.ndarray, w: np.ndarray, *components: int) -> float:
    return float((w * np.prod([xi[:, i] for i in components], axis=0)).sum())


def normal_moment(*components: int) -> float:
    """E prod x_i, the product over the components of (power - 1)!! for even powers."""
    counts = [components.count(i) for i in set(components)]
    return math.prod(0 if k % 2 else math.prod(range(1, k, 2)) for k in counts)


@every_rule
@every_size
def test_as_many_points_as_the_table_says(name: str, n: int) -> None:
    if (name, n) == ("ssr5", 1) or (name, n) == ("ssr53", 1):
        return  # one dimension has no edges but the one between the two corners, whose middle is the centre
    assert len(points(name, n)[1]) == (COUNTS[name](n) if (name, n) != ("hckf5", 1) else 3)


def test_the_mixed_rule_has_three_points_more_than_ckf_and_one_more_than_ssr() -> None:
    for n in range(1, 21):
        ckf, ssr, mixed = (len(points(name, n)[1]) for name in ("ckf3", "ssr3", "mssr"))
        assert mixed == ckf + 3 == ssr + 1


@every_rule
@every_size
def test_all_monomials_to_third_degree(name: str, n: int) -> None:
    xi, w = points(name, n)
    for degree in range(4):
        for components in itertools.combinations_with_replacement(range(n), degree):
            assert moment(xi, w, *components) == pytest.approx(
                normal_moment(*components), abs=1e-12
            ), components


@every_rule
@every_size
def test_odd_moments_of_fifth_degree_vanish(name: str, n: int) -> None:
    xi, w = points(name, n)
    for components in [
        (0,) * 5,
        (0, 0, 0, 0, n - 1),
        (0, 0, n // 2, n // 2, n - 1),
        (0, 0, 0, n // 2, n - 1),
    ]:
        assert moment(xi, w, *components) == pytest.approx(0.0, abs=1e-12 * (n + 2) ** 2.5)


@every_rule
@every_size
def test_fourth_degree_is_exact_for_the_rules_that_claim_it(name: str, n: int) -> None:
    xi, w = points(name, n)
    fourth = {c: moment(xi, w, *c) for c in itertools.combinations_with_replacement(range(n), 4)}
    off = max(abs(value - normal_moment(*c)) for c, value in fourth.items())
    fifth = name in ("hckf5", "ssr5") or (n <= 2 and name == "mssr") or (n == 1 and name == "mckf")
    assert (off < 1e-11) == fifth, off
    if name == "ssr53":  # right in every direction but for one factor
        for c, value in fourth.items():
            assert value == pytest.approx(n / (n + 2) * normal_moment(*c), abs=1e-11)


@every_rule
@every_size
def test_radial_moments(name: str, n: int) -> None:
    xi, w = points(name, n)
    square = (xi**2).sum(1)
    fifth = isinstance(RULES[name].radial_rule, RadialDegree5)
    assert w @ square == pytest.approx(n, rel=1e-12)
    assert w @ square**2 == pytest.approx(n * (n + 2) if fifth else n**2, rel=1e-12)
    if fifth:  # sixth degree is out of reach: the truth is n (n + 2) (n + 4)
        assert w @ square**3 == pytest.approx(n * (n + 2) ** 2, rel=1e-12)


@pytest.mark.parametrize("n", [3, 5, 7, 8, 17])
def test_kurtosis_of_the_mixed_rule_in_closed_form(n: int) -> None:
    xi, w = points("mssr", n)
    q = n - np.arange(n)  # n - i + 1 for i = 1 .. n
    expected = (n + 1) * (n + 2) / n * (q**2 - q + 1) / (q * (q + 1))
    assert np.allclose(w @ xi**4, expected, rtol=1e-12)
    if n == 17:
        assert expected[0] == pytest.approx(17.95, abs=0.005)
        assert expected[-1] == pytest.approx(10.06, abs=0.005)


@every_rule
@pytest.mark.parametrize("n", [2, 5, 17])
def test_fourth_moment_averaged_over_rotations(name: str, n: int) -> None:
    """E (u x)^4 for a random unit vector u is 3 E|x|^4 / (n (n + 2)): 3 for a fifth-degree radius, 3 n / (n + 2) for a third."""
    xi, w = points(name, n)
    u = np.random.default_rng(0).normal(size=(8_000, n))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    values = (u @ xi.T) ** 4 @ w
    expected = 3.0 if isinstance(RULES[name].radial_rule, RadialDegree5) else 3.0 * n / (n + 2)
    assert abs(values.mean() - expected) < 4.0 * values.std() / math.sqrt(len(u)) + 1e-11


@every_rule
@every_size
def test_signs_of_weights(name: str, n: int) -> None:
    w = points(name, n)[1]
    first_negative = {"hckf5": 5, "ssr5": 8, "ssr53": 8}.get(name, 10**9)
    assert bool((w < 0).any()) == (n >= first_negative)
    if n == 17:
        size = {"hckf5": 2.22, "ssr5": 1.89, "ssr53": 1.99}.get(name, 1.0)
        assert np.abs(w).sum() == pytest.approx(size, abs=0.006)


@pytest.mark.parametrize("n", [1, 2, 3, 5, 17])
def test_corners_of_the_simplex(n: int) -> None:
    u = SimplexDegree3()(n)[0][: n + 1].numpy()
    gram = u @ u.T
    assert np.allclose(gram, (1 + 1 / n) * np.eye(n + 1) - 1 / n, atol=1e-14)
    assert np.allclose(u.sum(0), 0.0, atol=1e-14)
    assert np.allclose(u.T @ u, (n + 1) / n * np.eye(n), atol=1e-13)


@pytest.mark.parametrize(
    "sphere",
    [AxisDegree3(), AxisDegree5(), SimplexDegree3(), SimplexDegree5()],
    ids=lambda s: type(s).__name__,
)
@every_size
def test_sphere_rules_average_over_the_unit_sphere(sphere: SphericalRule, n: int) -> None:
    """Unit vectors, weights of sum 1, E u_i u_j = delta_ij / n; of fifth degree also E u_i^4 = 3 / (n (n + 2))."""
    u, a = sphere(n)
    assert torch.allclose(u.norm(dim=1), torch.ones(len(u), dtype=torch.float64), atol=1e-14)
    assert float(a.sum()) == pytest.approx(1.0, abs=1e-13)
    assert torch.allclose(
        (a[:, None] * u).mT @ u, torch.eye(n, dtype=torch.float64) / n, atol=1e-13
    )
    if isinstance(sphere, AxisDegree5 | SimplexDegree5):
        assert torch.allclose(
            a @ u**4, torch.full((n,), 3.0 / (n * (n + 2)), dtype=torch.float64), atol=1e-13
        )


def test_in_one_dimension_the_mixed_rule_is_gauss_hermite() -> None:
    xi, w = points("mssr", 1)
    for at, weight in ((0.0, 2 / 3), (math.sqrt(3.0), 1 / 6), (-math.sqrt(3.0), 1 / 6)):
        assert w[np.abs(xi[:, 0] - at) < 1e-14].sum() == pytest.approx(weight, abs=1e-15)


@every_size
def test_rules_that_have_another_name(n: int) -> None:
    """CKF's points in the same order, and the UKF of kappa = 2 without an extra weight of the centre."""
    assert all(
        torch.equal(a, b) for a, b in zip(RULES["ckf3"](n), CubaturePoints()(n), strict=True)
    )
    xi, w, w_cov = UnscentedPoints(1.0, 0.0, 2.0)(n)
    for a, b in zip(RULES["mckf"](n), (xi, w, w_cov), strict=True):
        assert torch.allclose(a, b, atol=1e-15)


def test_the_unscented_filter_of_kappa_two_filters_alike() -> None:
    y = 10.0 * torch.randn(
        2, 12, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(3)
    )
    one, other = (
        mean(scheme, Lorenz63(), y) for scheme in (RULES["mckf"], UnscentedPoints(1.0, 0.0, 2.0))
    )
    assert torch.allclose(one, other, rtol=1e-9)


def mean(
    scheme: SphericalRadialPoints | UnscentedPoints, model: StateSpaceModel, y: Tensor
) -> Tensor:
    return run_filter(
        GaussianFilter(SigmaPointLinearisation(scheme)),
        model,
        Record(y),
        PhiloxStream(0, torch.arange(len(y))),
    ).mean


def test_points_are_built_once() -> None:
    one, other = (SphericalRadialPoints(SimplexDegree5(), RadialDegree5())(9) for _ in range(2))
    assert one[0] is other[0]
