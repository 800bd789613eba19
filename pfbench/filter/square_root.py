"""Normal laws by square roots of their covariances: conditioned on some components, or on what is seen."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def swept(a: Tensor, first: Sequence[int], rest: Sequence[int]) -> tuple[list[Tensor], Tensor]:
    """The normal law of e = A xi, xi ~ N(0, I): e_s is decided by as many independent numbers z, e_l then known up to a root.

    Gram-Schmidt, component by component, so that a component of s that has no spread of its own takes none of l's; a
    covariance is never formed.

    Args:
        a: [..., d, m], m at least the size of l.
        first, rest: components s and l.

    Returns:
        Columns L_j [..., d] with e = sum_j L_j z_j + what is left, and a lower triangular root of the covariance of what is left
        of l [..., l, l], of any sign.
    """
    size = a.norm(dim=-1)
    tolerance = 1e3 * torch.finfo(a.dtype).eps
    columns = []
    for i in first:
        row = a[..., i, :]
        length = row.norm(dim=-1, keepdim=True)
        real = length > tolerance * size[..., i : i + 1]
        axis = torch.where(real, row / torch.where(real, length, 1.0), 0.0)
        column = (a @ axis.unsqueeze(-1)).squeeze(-1)
        a = a - column.unsqueeze(-1) * axis.unsqueeze(-2)
        columns.append(column)
    return columns, torch.linalg.qr(a[..., rest, :].mT, mode="r")[1].mT


def absorbed(root: Tensor, h: Tensor, r: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The Kalman update of N(0, root root') by r = H l + v, v ~ N(0, I), one component after the other, on the root
    [Potter 1963; Bierman 1977].

    Args:
        root: [R, N or 1, l, l].
        h: [R, N or 1, k, l].
        r: [R, N, k].

    Returns:
        Mean [R, N, l], root [R, N or 1, l, l], and the log density of r but for k/2 log 2 pi [R, N].
    """
    shift, log_like = r.new_zeros(*r.shape[:-1], root.shape[-1]), torch.zeros_like(r[..., 0])
    for j in range(r.shape[-1]):
        row = h[..., j, :]
        f = (root * row.unsqueeze(-1)).sum(-2)  # root' h
        q2 = 1.0 + f.square().sum(-1)
        reach = (root * f.unsqueeze(-2)).sum(-1)
        e = r[..., j] - (row * shift).sum(-1)
        shift = shift + reach * (e / q2).unsqueeze(-1)
        root = root - (reach / (q2 + q2.sqrt()).unsqueeze(-1)).unsqueeze(-1) * f.unsqueeze(-2)
        log_like = log_like - 0.5 * (e * e / q2 + torch.log(q2))
    return shift, root, log_like
