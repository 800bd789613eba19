"""Lie groups as chart blocks, against matrix exponentials of scipy, its rotations, and numbers of 40 digits."""

import math

import mpmath
import numpy as np
import pytest
import torch
from hypothesis import given, settings, strategies as st
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from pfbench.core.chart import (
    SIDES,
    Chart,
    EuclideanBlock,
    LieGroupBlock,
    QuaternionBlock,
    inverse_jacobian_coefficient,
    jacobian_coefficients,
)
from pfbench.core.linear_algebra import jacobian

SIZES = (4, 7, 10)


def skew(a: np.ndarray) -> np.ndarray:
    return np.array([[0, -a[2], a[1]], [a[2], 0, -a[0]], [-a[1], a[0], 0]])


def algebra(d: np.ndarray) -> np.ndarray:
    """Matrix of an element of the Lie algebra: [phi x, d_1, ..., d_k; 0 0]."""
    k = len(d) // 3 - 1
    matrix = np.zeros((3 + k, 3 + k))
    matrix[:3, :3] = skew(d[:3])
    matrix[:3, 3:] = d[3:].reshape(k, 3).T
    return matrix


def element(x: np.ndarray) -> np.ndarray:
    """Matrix of a state (quaternion, vectors)."""
    k = (len(x) - 4) // 3
    matrix = np.eye(3 + k)
    matrix[:3, :3] = Rotation.from_quat(np.roll(x[:4], -1)).as_matrix()
    matrix[:3, 3:] = x[4:].reshape(k, 3).T
    return matrix


def cases(size: int, seed: int, angle: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """State and two differences; the rotation of the first has the angle."""
    rng = np.random.default_rng(seed)
    x = rng.normal(size=size) * 3
    x[:4] /= np.linalg.norm(x[:4])
    d, e = rng.normal(size=(2, size - 1))
    d[:3] *= angle / np.linalg.norm(d[:3])
    return x, d, e


@given(
    st.integers(0, 2**31),
    st.sampled_from(SIZES),
    st.sampled_from(SIDES),
    st.one_of(st.floats(0.0, math.pi - 1e-6), st.floats(1e-12, 1e-3)),
)
@settings(deadline=None, max_examples=150)
def test_differences_are_exponentials_of_matrices(
    seed: int, size: int, side: str, angle: float
) -> None:
    block = LieGroupBlock(size, side)
    x, d, e = cases(size, seed, angle)
    states = [torch.from_numpy(a) for a in (x, d, e)]
    left, factors = side == "left", (expm(algebra(d)), expm(algebra(e)))
    once, twice = block.add(states[0], states[1]), None
    expected = element(x) @ factors[0] if left else factors[0] @ element(x)
    assert np.allclose(element(once.numpy()), expected, rtol=0, atol=1e-12)
    twice = block.add(once, states[2])
    expected = expected @ factors[1] if left else factors[1] @ expected
    assert np.allclose(element(twice.numpy()), expected, rtol=0, atol=1e-11)
    # the logarithm loses digits in 1 / (pi - angle), through the quaternion's scalar part
    assert np.allclose(block.subtract(once, states[0]).numpy(), d, rtol=0, atol=1e-12)


@pytest.mark.parametrize("side", SIDES)
def test_differences_do_not_change_with_a_common_factor(side: str) -> None:
    block = LieGroupBlock(10, side)
    x, _, _ = cases(10, 1, 1.0)
    y, _, _ = cases(10, 2, 1.0)
    factor = expm(algebra(cases(10, 3, 2.0)[1]))

    def product(a: np.ndarray) -> torch.Tensor:
        matrix = factor @ element(a) if side == "left" else element(a) @ factor
        q = np.roll(Rotation.from_matrix(matrix[:3, :3]).as_quat(), 1)
        return torch.from_numpy(np.concatenate([q, matrix[:3, 3:].T.ravel()]))

    before = block.subtract(torch.from_numpy(y), torch.from_numpy(x))
    assert torch.allclose(block.subtract(product(y), product(x)), before, rtol=0, atol=1e-12)
    mirror = LieGroupBlock(10, "right" if side == "left" else "left")
    assert not torch.allclose(
        mirror.subtract(product(y), product(x)), mirror.subtract(torch.tensor(y), torch.tensor(x))
    )


@pytest.mark.parametrize(
    ("dtype", "limits"),
    [(torch.float64, (1e-14, 1e-14, 5e-14)), (torch.float32, (5e-7, 3e-6, 5e-6))],
)
def test_series_have_the_digits_of_their_type(
    dtype: torch.dtype, limits: tuple[float, float, float]
) -> None:
    mpmath.mp.dps = 40
    angles = [1e-8, 1e-4, 0.01, 0.1, 0.3, 0.4999, 0.5001, 0.7, 1.0, 2.0, 3.0, 3.1415]
    phi = torch.tensor([[a, 0.0, 0.0] for a in angles], dtype=dtype)
    values = (*jacobian_coefficients(phi), inverse_jacobian_coefficient(phi))
    for value, limit, formula in zip(
        values,
        limits,
        (
            lambda t: (1 - mpmath.cos(t)) / t**2,
            lambda t: (t - mpmath.sin(t)) / t**3,
            lambda t: (1 - t / 2 * mpmath.cot(t / 2)) / t**2,
        ),
        strict=True,
    ):
        exact = [float(formula(mpmath.mpf(float(a)))) for a in phi[:, 0]]
        assert np.allclose(value[:, 0].double().numpy(), exact, rtol=limit, atol=0)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("angle", [0.0, 1e-8, 1e-4, 1e-2, 0.49, 0.51, 2.0])
def test_single_precision_is_kept_from_angles_of_zero_on(side: str, angle: float) -> None:
    """States of about 3 m have seven digits, so their differences have an error of some 1e-6."""
    block = LieGroupBlock(10, side)
    x, d, _ = (torch.from_numpy(a).float() for a in cases(10, 5, angle))
    moved = block.add(x, d)
    exact = element(x.double().numpy())
    factor = expm(algebra(d.double().numpy()))
    exact = exact @ factor if side == "left" else factor @ exact
    assert np.allclose(element(moved.double().numpy()), exact, rtol=0, atol=4e-6)
    assert torch.allclose(block.subtract(moved, x), d, rtol=0, atol=4e-6)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("size", SIZES)
@pytest.mark.parametrize(("dtype", "limit"), [(torch.float64, 1e-13), (torch.float32, 2e-6)])
def test_derivative_at_zero_is_the_identity_in_both_modes(
    size: int, side: str, dtype: torch.dtype, limit: float
) -> None:
    block = LieGroupBlock(size, side)
    x = torch.from_numpy(np.stack([cases(size, i, 1.0)[0] for i in range(3)]))[:, None].to(dtype)
    eye = torch.eye(size - 1, dtype=dtype).expand(3, -1, -1)
    for mode in (torch.no_grad, torch.enable_grad):  # backward and forward
        with mode():
            slope = jacobian(lambda d: block.add(x, d), x, size - 1, block.subtract)
        assert torch.allclose(slope, eye, rtol=0, atol=limit)


@pytest.mark.parametrize("side", SIDES)
def test_derivative_of_the_exponential_is_the_series_of_brackets(side: str) -> None:
    block = LieGroupBlock(10, side)
    x, s, _ = cases(10, 7, 1.2)
    centre, shift = torch.from_numpy(x)[None, None], torch.from_numpy(s)
    mean = block.add(centre, shift)
    slope = jacobian(lambda e: block.add(centre, shift + e), mean, 9, block.subtract)[0]
    bracket = np.zeros((9, 9))  # [s, e] in coordinates: phi x e_phi, phi x e_i + s_i x e_phi
    for i in range(3):
        bracket[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] = skew(s[:3])
        bracket[3 * i : 3 * i + 3, :3] = skew(s[3 * i : 3 * i + 3])
    sign, term, expected = -1.0 if side == "left" else 1.0, np.eye(9), np.eye(9)
    for n in range(1, 40):
        term = term @ (sign * bracket) / (n + 1)
        expected = expected + term
    assert np.allclose(slope.numpy(), expected, rtol=0, atol=1e-11)


def test_rotations_alone_are_the_quaternion_block() -> None:
    x, y = (torch.from_numpy(cases(4, i, 1.0)[0]) for i in (1, 2))
    d = torch.from_numpy(cases(4, 3, 1.0)[1])
    left = LieGroupBlock(4, "left")
    assert torch.equal(left.add(x, d), QuaternionBlock().add(x, d))
    assert torch.equal(left.subtract(y, x), QuaternionBlock().subtract(y, x))


def test_composition_with_euclidean_components_and_a_mean() -> None:
    chart = Chart((LieGroupBlock(), EuclideanBlock(2)))
    assert (chart.size, chart.dimension, chart.flat) == (12, 11, False)
    x = torch.from_numpy(np.concatenate([cases(10, 1, 1.0)[0], [1.0, 2.0]]))
    d = 0.5 * torch.from_numpy(np.random.default_rng(4).normal(size=(40, 11)))
    d = d - d.mean(0)
    points = chart.add(x, d)
    w = torch.full((40,), 1 / 40, dtype=torch.float64)
    mean = chart.mean(points, w, passes=30)
    # the mean is where the weighted differences vanish
    assert float(chart.subtract(points, mean).mean(0).abs().max()) < 1e-10


@pytest.mark.parametrize(
    ("size", "side", "message"),
    [
        (5, "left", "LieGroupBlock.size must be 4, 7 or 10"),
        (10, "up", "side must be left or right"),
    ],
)
def test_other_groups_are_refused(size: int, side: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        LieGroupBlock(size, side)
