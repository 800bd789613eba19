"""Innovations along the principal axes of what is expected, in units of the measurement noise, group by group of sensors."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.filter.gaussian import Innovation


class Axes(NamedTuple):
    """Principal axes of what is expected, in units of the nominal noise, group by group of sensors.

    Attributes:
        ratio: eigenvalues lam of the expected spread [R, k].
        w: innovation along the axes [R, k].
        seen: axes of components that were seen [R, k].
        share: squares of the axes' components [R, k components, k axes]; an axis stays within its group.
        member: 1 where an axis is of a component's group, be the component seen or not [R, k components, k axes].
    """

    ratio: Tensor
    w: Tensor
    seen: Tensor
    share: Tensor
    member: Tensor

    def along(self, value: Tensor) -> Tensor:
        """What is one number for each group, of components [R, k] -> of axes [R, k]."""
        return (self.share.mT @ value.unsqueeze(-1)).squeeze(-1)


def principal(innovation: Innovation, groups: Sequence[int] | None = None) -> Axes:
    """Generalised eigenvalues of the expected spread against the nominal noise, of each group of sensors by itself.

    All groups are solved at once, as one block matrix whose blocks are set apart by multiples of more than its trace: no axis
    mixes two groups, even where both have the eigenvalue 0, and runs may differ in what they see.
    """
    alike, same = grouped(innovation, groups)
    root = group_root(innovation.nominal, same)
    white = whitened(root, innovation.spread, same)
    first = torch.where(innovation.seen, same.to(torch.int8).argmax(-1), same.shape[-1])  # component of its group
    apart = first * (1.0 + diagonal(white).abs().sum(-1, keepdim=True))
    _, axes = torch.linalg.eigh(white + torch.diag_embed(apart))
    share = axes.square()
    ratio = (axes * (white @ axes)).sum(-2).clamp(min=0.0)  # not the eigenvalues less what sets them apart, which would cancel
    w = (axes.mT @ torch.linalg.solve_triangular(root, innovation.r.unsqueeze(-1), upper=False)).squeeze(-1)
    seen = (innovation.seen.to(share).unsqueeze(-2) @ share).squeeze(-2) > 0.5
    return Axes(ratio, w, seen, share, alike.to(share) @ share)


def grouped(innovation: Innovation, groups: Sequence[int] | None) -> tuple[Tensor, Tensor]:
    """Components of one group, and those of them of which both are seen, both [R, k, k]."""
    seen = innovation.seen
    k = seen.shape[-1]
    if groups is None:
        size = diagonal(innovation.nominal)
        alike = (size.unsqueeze(-1) - size.unsqueeze(-2)).abs() <= 1e-6 * size.unsqueeze(-1)
    else:
        if len(groups) != k:
            raise ValueError(f"groups={list(groups)}: give the number of a group for each of the {k} components measured")
        number = torch.tensor(list(groups), device=seen.device)
        alike = (number[:, None] == number).expand(*seen.shape, k)
    return alike, alike & seen.unsqueeze(-1) & seen.unsqueeze(-2)


def group_root(noise: Tensor, same: Tensor) -> Tensor:
    """Lower triangular root of the noise, correlations between groups left out, 1 for what is unseen [R, k, k]."""
    return factor(torch.where(same, noise, torch.eye(same.shape[-1], dtype=noise.dtype, device=noise.device)))[0]


def whitened(root: Tensor, spread: Tensor, same: Tensor) -> Tensor:
    """R^-1/2 spread R^-1/2 within groups [R, k, k], 0 for what is unseen."""
    half = torch.linalg.solve_triangular(root, torch.where(same, spread, 0.0), upper=False)
    white = torch.linalg.solve_triangular(root, half.mT, upper=False)
    return _finite(0.5 * (white + white.mT))


def _finite(a: Tensor) -> Tensor:
    """0 for a run with anything that is no number: eigh raises for the whole batch, and such a run is lost anyway."""
    return torch.where(torch.isfinite(a).all(-1).all(-1)[:, None, None], a, 0.0)


def precision(innovation: Innovation) -> Tensor:
    """diag(R)^-1 of the model's noise [R, k], 0 where unseen."""
    return torch.where(innovation.seen, 1.0 / diagonal(innovation.nominal), 0.0)


def diagonal(a: Tensor) -> Tensor:
    return a.diagonal(dim1=-2, dim2=-1)


def check_share(name: str, value: float) -> None:
    if not 0.0 < value <= 1.0:
        raise ValueError(f"{name}={value}: give a number in (0, 1]")
