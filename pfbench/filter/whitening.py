"""Coordinates in which a covariance is the unit matrix, by its lower triangular root."""

from __future__ import annotations

import math

import torch
from torch import Tensor

LOG_2PI = math.log(2.0 * math.pi)


def filled(root: Tensor) -> Tensor:
    """A root [..., k, k] to solve with: 1 where a component has no spread. Its coordinate stays 0, its density is left out."""
    return root + torch.diag_embed((root.diagonal(dim1=-2, dim2=-1) == 0.0).to(root))


def whiten(p: Tensor, root: Tensor) -> Tensor:
    """root^-1 p for p [R, N, k] and a lower triangular root [R, k, k]."""
    return torch.linalg.solve_triangular(filled(root), p.mT, upper=False).mT


def log_det(root: Tensor) -> Tensor:
    """log |det root| of a triangular root [..., k, k] -> [...]."""
    return root.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)


def half_square(a: Tensor) -> Tensor:
    """|a|^2 / 2: minus the log density of N(0, I) at a [..., k], but for its constant -> [...]."""
    return 0.5 * (a * a).sum(-1)
