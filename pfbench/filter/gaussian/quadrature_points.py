"""Points of Gauss-Hermite quadrature: the tensor product, and the sparse grid of Smolyak.

References:
    K. Ito, K. Xiong 2000, "Gaussian filters for nonlinear filtering problems".
    B. Jia, M. Xin, Y. Cheng 2012, "Sparse-grid quadrature nonlinear filtering".
"""

from __future__ import annotations

import math
from collections import defaultdict
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations, product

import numpy as np
import torch
from torch import Tensor

_MOST_POINTS = 20_000
_SIZES = (1, 3, 5)  # points of the univariate rules of a sparse grid
_LEVELS = (2, 3)


@dataclass(frozen=True)
class GaussHermitePoints:
    """Tensor product of Gauss-Hermite points, m^d points.

    Exact for polynomials of degree 2 m - 1 in each variable. All weights are positive.

    Attributes:
        order: Points m in each direction.

    Raises:
        ValueError: If the order is below 2, or on use if there are more than 20 000 points.
    """

    order: int = 3

    def __post_init__(self) -> None:
        if type(self.order) is not int or self.order < 2:
            raise ValueError(
                f"linearisation.points.order must be a whole number of at least 2, got {self.order}. "
                "Use 3."
            )

    def __call__(self, d: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return points [P, d], mean weights [P] and covariance weights [P]."""
        if self.order**d > _MOST_POINTS:
            raise ValueError(
                f"linearisation.points must have at most {_MOST_POINTS} points, got {self.order}^{d} "
                f"for {d} components. Use filter=sparse_grid."
            )
        return _tensor_product(self.order, d)


@dataclass(frozen=True)
class SparseGridPoints:
    """Sparse grid of Gauss-Hermite points by Smolyak's construction.

    Exact for polynomials of total degree 2 level - 1, with 2 d + 1 points at level 2 and
    2 d^2 + 4 d + 1 at level 3. Level 2 is the unscented transform with kappa = 3 - d. Some weights
    are negative, so a covariance may lose its root: see `GaussianFilter.repair_covariance`.

    Attributes:
        level: 2 or 3.

    Raises:
        ValueError: If the level is neither.
    """

    level: int = 3

    def __post_init__(self) -> None:
        if self.level not in _LEVELS:
            raise ValueError(f"linearisation.points.level must be 2 or 3, got {self.level}. Use 3.")

    def __call__(self, d: int) -> tuple[Tensor, Tensor, Tensor]:
        """Return points [P, d], mean weights [P] and covariance weights [P]."""
        return _smolyak(self.level, d)


def _univariate(order: int) -> tuple[list[float], list[float]]:
    """Return points and weights of N(0, 1); the middle of an odd rule is exactly 0."""
    x, w = np.polynomial.hermite_e.hermegauss(order)
    x, w = 0.5 * (x - x[::-1]), w / w.sum()
    return x.tolist(), w.tolist()


@lru_cache(maxsize=64)
def _tensor_product(order: int, d: int) -> tuple[Tensor, Tensor, Tensor]:
    """Build the tensor product."""
    x, w = (torch.tensor(a, dtype=torch.float64) for a in _univariate(order))
    index = torch.cartesian_prod(*[torch.arange(order)] * d).reshape(-1, d)
    weight = w[index].prod(-1)
    return x[index], weight, weight


@lru_cache(maxsize=64)
def _smolyak(level: int, d: int) -> tuple[Tensor, Tensor, Tensor]:
    """Combine tensor products of few axes and add the weights of equal points."""
    total: defaultdict[tuple[tuple[int, float], ...], float] = defaultdict(float)
    for s in range(max(0, level - d), level):
        factor = (-1.0) ** (level - 1 - s) * math.comb(d - 1, level - 1 - s)
        for axes, sizes in _finer_axes(s, d):
            rules = [list(zip(*_univariate(size), strict=True)) for size in sizes]
            for nodes in product(*rules):
                key = tuple((a, x) for a, (x, _) in zip(axes, nodes, strict=True) if x != 0.0)
                total[key] += factor * math.prod(weight for _, weight in nodes)
    points = torch.zeros(len(total), d, dtype=torch.float64)
    for row, key in zip(points, total, strict=True):
        for axis, x in key:
            row[axis] = x
    weight = torch.tensor(list(total.values()), dtype=torch.float64)
    return points, weight, weight


def _finer_axes(s: int, d: int) -> list[tuple[tuple[int, ...], tuple[int, ...]]]:
    """List the axes with more than one point, and their points, for an excess s of levels over 1."""
    if s == 0:
        return [((), ())]
    one_axis = [((axis,), (_SIZES[s],)) for axis in range(d)]
    pairs = [(pair, (_SIZES[1],) * 2) for pair in combinations(range(d), 2)] if s == 2 else []
    return [*one_axis, *pairs]
