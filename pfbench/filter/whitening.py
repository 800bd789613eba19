"""Coordinates in which a covariance is the unit matrix."""

from __future__ import annotations

import math

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

    Args:
        p: Vectors, [R, N, k].
        root: Lower triangular root, [R, k, k].

    Returns:
        Whitened vectors, [R, N, k].
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

    Args:
        covariance: Covariance S, [R, k, k].

    Returns:
        W and C [R, k, k] with W S W' = 1 and C W = 1 on the range of S. Both are 0 off this range.
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
