"""Coordinates in which a covariance is the unit matrix, and conditioning by square roots in them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

LOG_2PI = math.log(2.0 * math.pi)


def fill_missing(root: Tensor) -> Tensor:
    """Return a root [..., k, k] with 1 on the diagonal of components without variance.

    The whitened coordinate of such a component is 0, and its density is omitted.
    """
    return root + torch.diag_embed((root.diagonal(dim1=-2, dim2=-1) == 0.0).to(root))


def whiten(p: Tensor, root: Tensor) -> Tensor:
    """Compute root^-1 p.

    Returns whitened vectors, [R, N, k]. Shapes: p [R, N, k], root [R, k, k].
    """
    return torch.linalg.solve_triangular(fill_missing(root), p.mT, upper=False).mT


def log_determinant(root: Tensor) -> Tensor:
    """Compute log |det root| of a triangular root [..., k, k] -> [...]."""
    return root.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)


def compute_half_square(a: Tensor) -> Tensor:
    """Compute |a|^2 / 2 [...] of vectors a [..., k].

    It is the negative log density of N(0, I) up to a constant.
    """
    return 0.5 * (a * a).sum(-1)


def whitening_basis(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """Compute whitening and colouring matrices of a covariance S that may be singular.

    Returns w and C [R, k, k] with W S W' = 1 and C W = 1 on the range of S. Both are 0 off this
    range. Shapes: covariance [R, k, k].
    """
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    sd = torch.where(variance > 0.0, variance, 1.0).sqrt()
    correlation = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    values, vectors = torch.linalg.eigh(torch.nan_to_num(correlation, 0.0, 0.0, 0.0))
    range_mask = values > torch.finfo(values.dtype).eps ** (2 / 3)
    divisors = torch.where(range_mask, values, torch.inf).sqrt()
    root_values = torch.where(range_mask, values, 0.0).sqrt()
    whitening = (vectors / divisors.unsqueeze(-2)).mT / sd.unsqueeze(-2)
    return whitening, sd.unsqueeze(-1) * vectors * root_values.unsqueeze(-2)


# --------------------------------------------------------------------------------------------------
# Condition normal distributions by square roots of their covariances.


def condition_on(
    a: Tensor, first: Sequence[int], rest: Sequence[int]
) -> tuple[list[Tensor], Tensor]:
    """Condition the normal vector e = A xi, xi ~ N(0, I), on some of its components.

    Gram-Schmidt, component by component. A component of s without remaining variance does
    not remove variance from l. No covariance is formed.

    Returns columns L_j [..., d] with e = sum_j L_j z_j + remainder and independent z_j ~ N(0, 1). A
    lower triangular root of the remainder's covariance for l [..., l, l], of any sign. Shapes: a
    [..., d, m].
    """
    size = a.norm(dim=-1)
    tolerance = 1e3 * torch.finfo(a.dtype).eps
    columns = []
    for i in first:
        row = a[..., i, :]
        length = row.norm(dim=-1, keepdim=True)
        nonzero = length > tolerance * size[..., i : i + 1]
        axis = torch.where(nonzero, row / torch.where(nonzero, length, 1.0), 0.0)
        column = (a @ axis.unsqueeze(-1)).squeeze(-1)
        a = a - column.unsqueeze(-1) * axis.unsqueeze(-2)
        columns.append(column)
    return columns, torch.linalg.qr(a[..., rest, :].mT, mode="r")[1].mT


def split_root(a: Tensor, components: Sequence[int], sd: float) -> tuple[list[Tensor], Tensor]:
    """Split the normal vector e = A xi, xi ~ N(0, I), into offsets to be drawn and a remainder.

    e = sum_j c_j z_j + A' xi in distribution, with independent z_j ~ N(0, 1). In the remainder, the
    standard deviation of each of the components is at most `sd`, and unchanged where it was smaller.
    Each column c_j is a multiple of the regression of e on its component.

    Returns columns c_j, [..., d], and the root A' [..., d, m]. Shapes: a [..., d, m].
    """
    columns = []
    for i in components:
        row = a[..., i, :]
        length = row.norm(dim=-1, keepdim=True)
        axis = row / length.clamp(min=sd)  # of unit length wherever something is drawn
        share = (sd / length.clamp(min=sd)).square()
        column = (a @ axis.unsqueeze(-1)).squeeze(-1)
        columns.append(torch.sqrt(1.0 - share) * column)
        a = a - (1.0 - share.sqrt()).unsqueeze(-1) * column.unsqueeze(-1) * axis.unsqueeze(-2)
    return columns, a


def kalman_update_root(root: Tensor, h: Tensor, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Apply the Kalman update of N(0, root root') by r = H l + v, v ~ N(0, I).

    Measurement components are processed one after the other, on the root [Potter 1963].

    Returns mean [R, N, l], root [R, N or 1, l, l], and the log density of r without its term -k/2
    log 2 pi [R, N]. Shapes: root [R, N or 1, l, l], h [R, N or 1, k, l], r [R, N, k].

    References:
        Bierman 1977, Factorization Methods for Discrete Sequential Estimation.
    """
    shift, log_likelihood = r.new_zeros(*r.shape[:-1], root.shape[-1]), torch.zeros_like(r[..., 0])
    for j in range(r.shape[-1]):
        row = h[..., j, :]
        f = (root * row.unsqueeze(-1)).sum(-2)  # root' h
        q2 = 1.0 + f.square().sum(-1)
        cross_cov = (root * f.unsqueeze(-2)).sum(-1)
        e = r[..., j] - (row * shift).sum(-1)
        shift = shift + cross_cov * (e / q2).unsqueeze(-1)
        root = root - (cross_cov / (q2 + q2.sqrt()).unsqueeze(-1)).unsqueeze(-1) * f.unsqueeze(-2)
        log_likelihood = log_likelihood - 0.5 * (e * e / q2 + torch.log(q2))
    return shift, root, log_likelihood
