"""Gains that doubt the prediction: adaptive factor, bounded ratio of error to noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.filter.gaussian import Innovation
from pfbench.filter.principal_axes import check_share, diagonal, group_root, grouped, precision, whitened


@dataclass(frozen=True)
class AdaptiveFactor:
    """Widens the prediction by 1 / alpha where the innovation is large: P- / alpha [Yang, He and Xu 2001].

    dV = sqrt(v' W v / tr(W (C_zz + R))); alpha = 1 while dV <= c0, then c0 / dV, and not below `least`. It cannot tell a wrong
    state from a noisy measurement: in a burst of the latter it widens all states, step after step. Bound it by RatioBound.

    Args:
        threshold: c0; infinity switches it off.
        least: smallest alpha.
        weighted: W = diag(R)^-1 of the model's noise [ours]; false is W = I, as the literature prints it, which adds squares of
            metres to squares of metres per second.

    Raises:
        ValueError: an argument outside its range.
    """

    threshold: float = 1.5
    least: float = 0.1
    weighted: bool = True

    def __post_init__(self) -> None:
        check_share("AdaptiveFactor.least", self.least)
        if not self.threshold > 0.0:
            raise ValueError(f"AdaptiveFactor.threshold={self.threshold}: give a positive number, or .inf for no factor")

    def __call__(self, innovation: Innovation, factor: Tensor) -> Tensor:
        w = precision(innovation) if self.weighted else innovation.seen.to(innovation.r.dtype)
        expected = (w * diagonal(innovation.spread + innovation.noise)).sum(-1)
        surprise = torch.sqrt((w * innovation.r.square()).sum(-1) / torch.where(expected > 0.0, expected, 1.0))
        return factor / torch.where(surprise > self.threshold, self.threshold / surprise, 1.0).clamp(min=self.least)


@dataclass(frozen=True)
class RatioBound:
    """Bounds the ratio rho of predicted error to measurement noise, and so the gain, rho / (1 + rho) [ours, after the paper].

    rho is the largest eigenvalue of C_zz in units of the R in use of a group of sensors. A widening f is cut so that f rho
    stays at `highest`, but never below 1: it does not narrow what the model predicts. Where f rho is below `lowest` it is raised.

    Args:
        highest: infinity switches the bound off.
        lowest: 0 switches it off.
        groups: as ConstrainedNoise.groups.

    Raises:
        ValueError: bounds that are negative or crossed.
    """

    highest: float = 1.0
    lowest: float = 0.0
    groups: Sequence[int] | None = None

    def __post_init__(self) -> None:
        if not 0.0 <= self.lowest <= self.highest:
            raise ValueError(f"RatioBound.lowest={self.lowest}, highest={self.highest}: give 0 <= lowest <= highest")

    def __call__(self, innovation: Innovation, factor: Tensor) -> Tensor:
        _, same = grouped(innovation, self.groups)
        white = whitened(group_root(innovation.noise, same), innovation.spread, same)
        rho = torch.linalg.eigvalsh(white).amax(-1).clamp(min=0.0)
        some = torch.where(rho > 0.0, rho, 1.0)
        factor = torch.where(factor * rho > self.highest, (self.highest / some).clamp(min=1.0), factor)
        return torch.where((factor * rho < self.lowest) & (rho > 0.0), self.lowest / some, factor)
