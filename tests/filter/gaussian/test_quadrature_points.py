"""Gauss-Hermite rules and sparse grids: moments to their degree and not beyond, counts, weights, bad input."""

from __future__ import annotations

import math
from itertools import combinations_with_replacement

import numpy as np
import pytest
import torch

from pfbench.filter.gaussian.linearisation_rules import (
    GaussHermitePoints,
    SparseGridPoints,
    UnscentedPoints,
)


def normal_moment(powers: np.ndarray) -> float:
    """E prod x_i^a_i = prod (a_i - 1)!! for even powers, 0 if one is odd."""
    if (powers % 2).any():
        return 0.0
    return float(np.prod([math.prod(range(1, int(a), 2)) for a in powers]))


def worst_error(points: object, d: int, degree: int, largest_power: int = 99) -> float:
    """Largest relative error over all monomials of a total degree, with powers up to a limit."""
    xi, w, w_cov = points(d)  # type: ignore[operator]
    assert torch.equal(w, w_cov)
    worst = 0.0
    for axes in combinations_with_replacement(range(d), degree):
        powers = np.bincount(axes, minlength=d)
        if powers.max(initial=0) <= largest_power:
            got = float((w.numpy() * (xi.numpy() ** powers).prod(1)).sum())
            want = normal_moment(powers)
            worst = max(worst, abs(got - want) / max(1.0, want))
    return worst


@pytest.mark.parametrize(("order", "d"), [(2, 3), (3, 1), (3, 4), (5, 3)])
def test_tensor_products_are_exact_in_each_variable(order: int, d: int) -> None:
    points = GaussHermitePoints(order)
    for degree in range(2 * order):
        assert worst_error(points, d, degree) < 1e-12
    # of total degree 2 m and more, where no power exceeds 2 m - 1
    if d > 1:
        assert worst_error(points, d, 2 * order, 2 * order - 1) < 1e-12
    assert worst_error(points, d, 2 * order) > 0.1
    xi, w, _ = points(d)
    assert len(w) == order**d
    assert float(w.min()) > 0
    assert xi.unique(dim=0).shape == xi.shape


@pytest.mark.parametrize(("level", "d"), [(2, 1), (2, 5), (3, 1), (3, 2), (3, 5), (3, 8)])
def test_sparse_grids_are_exact_to_their_total_degree(level: int, d: int) -> None:
    points = SparseGridPoints(level)
    for degree in range(2 * level):
        assert worst_error(points, d, degree) < 1e-11
    assert worst_error(points, d, 2 * level) > 0.1 or d < level


@pytest.mark.parametrize(
    ("level", "d", "count", "negative", "absolute"),
    [(2, 3, 7, 0, 1.0), (2, 15, 31, 1, 9.0), (3, 3, 31, 7, 2.5), (3, 15, 511, 30, 48.0), (3, 18, 721, 36, 69.0)],
)  # fmt: skip
def test_sparse_grids_have_the_known_counts(
    level: int, d: int, count: int, negative: int, absolute: float
) -> None:
    _, w, _ = SparseGridPoints(level)(d)
    assert (len(w), int((w < -1e-12).sum())) == (count, negative)
    assert float(w.abs().sum()) == pytest.approx(absolute, abs=0.5)


@pytest.mark.parametrize("d", [1, 2, 3, 15])
def test_level_two_is_the_unscented_transform(d: int) -> None:
    ours = torch.cat([a.reshape(2 * d + 1, -1) for a in SparseGridPoints(2)(d)[:2]], 1)
    theirs = torch.cat(
        [a.reshape(2 * d + 1, -1) for a in UnscentedPoints(1.0, 0.0, 3.0 - d)(d)[:2]], 1
    )

    def ordered(a: torch.Tensor) -> np.ndarray:
        rows = np.round(a.numpy(), 9)
        return rows[np.lexsort(rows.T)]

    np.testing.assert_allclose(ordered(ours), ordered(theirs), atol=1e-9)
