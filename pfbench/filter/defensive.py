"""Defensive mixtures: a fraction of the particles stays where the model sent it, and bounds every weight [Hesterberg 1995]."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.linearisation import times


class Kept(NamedTuple):
    """Who stays [R, N], and the fraction that this is of the living [R, 1]."""

    who: Tensor
    share: Tensor

    def log_mixture(self, log_p: Tensor, log_q: Tensor) -> Tensor:
        """log(share p + (1 - share) q) [R, N]."""
        return torch.logaddexp(log_p + torch.log(self.share), log_q + torch.log1p(-self.share))


def kept(share: float, live: Tensor, draws: Draws, purpose: str) -> Kept:
    """A share of the living slots [R, N], by a fresh random order: neighbours in a resampled cloud are siblings.

    Empty slots stay, too.
    """
    count = live.sum(1, keepdim=True).clamp(min=1).to(draws.dtype)
    lot = torch.where(live, draws.uniform(purpose, live.shape[1], 1).squeeze(-1), torch.inf)
    wanted = torch.round(share * count)
    return Kept((lot.argsort(1).argsort(1) < wanted) | ~live, wanted / count)


def check_fraction(name: str, value: float) -> None:
    """Raises a ValueError that names the key, unless the value is a fraction."""
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name}={value}: give a fraction from 0 to 1")


class Affine(NamedTuple):
    """e -> matrix e + offset: matrix [R, 1 or N, k, k], offset [R, 1 or N, k]."""

    matrix: Tensor
    offset: Tensor

    def sent(self, e: Tensor, kept: Kept | None, log_p: Callable[[Tensor], Tensor]) -> tuple[Tensor, Tensor]:
        """Where e [R, N, k] of density p goes, unless it is kept, and log p - log q there [R, N].

        q is p moved by the map, mixed with p itself as far as particles are kept.
        """
        new, log_det = times(self.matrix, e) + self.offset, torch.linalg.slogdet(self.matrix)[1]
        if kept is None:
            return new, log_p(new) - log_p(e) + log_det
        stays = kept.who.unsqueeze(-1)
        back = torch.where(stays, times(torch.linalg.inv_ex(self.matrix)[0], e - self.offset), e)  # what would lead to new
        new = torch.where(stays, e, new)
        log_new = log_p(new)
        return new, log_new - kept.log_mixture(log_new, log_p(back) - log_det)
