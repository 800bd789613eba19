"""Defensive mixtures: a fraction of the particles follows the model, which bounds all weights [Hesterberg 1995]."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.core.random_stream import RandomStream
from pfbench.filter.linearisation import batch_product


class DefensiveSelection(NamedTuple):
    """Particles that follow the model.

    Attributes:
        mask: Mask, [R, N].
        fraction: Their fraction of the active particles, [R, 1].
    """

    mask: Tensor
    fraction: Tensor

    def log_mixture(self, log_p: Tensor, log_q: Tensor) -> Tensor:
        """Return log(share p + (1 - share) q), [R, N]."""
        return torch.logaddexp(
            log_p + torch.log(self.fraction), log_q + torch.log1p(-self.fraction)
        )


def choose_defensive_particles(
    share: float, live: Tensor, draws: RandomStream, purpose: str
) -> DefensiveSelection:
    """Choose a fraction of the active particles by a random order, and all inactive slots.

    The order is drawn at each step, because neighbours after resampling are copies of one particle.

    Args:
        share: Fraction.
        live: Active particles, [R, N].
        draws: Random stream.
        purpose: Label of the draw.

    Returns:
        Mask and fraction.
    """
    count = live.sum(1, keepdim=True).clamp(min=1).to(draws.dtype)
    lot = torch.where(live, draws.uniform(purpose, live.shape[1], 1).squeeze(-1), torch.inf)
    target = torch.round(share * count)
    return DefensiveSelection((lot.argsort(1).argsort(1) < target) | ~live, target / count)


def check_fraction(name: str, value: float) -> None:
    """Check that a value is a fraction.

    Args:
        name: Configuration key.
        value: Its value.

    Raises:
        ValueError: If it is outside [0, 1].
    """
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name} must be from 0 to 1, got {value}. Choose a fraction")


class AffineMap(NamedTuple):
    """Affine map e -> matrix e + offset.

    Attributes:
        matrix: [R, 1 or N, k, k].
        offset: [R, 1 or N, k].
    """

    matrix: Tensor
    offset: Tensor

    def apply(
        self, e: Tensor, selection: DefensiveSelection | None, log_p: Callable[[Tensor], Tensor]
    ) -> tuple[Tensor, Tensor]:
        """Map samples of density p, except the defensive ones, and return the density ratio.

        Args:
            e: Samples, [R, N, k].
            kept: Defensive selection, None for none.
            log_p: Log density, [R, N].

        Returns:
            New samples and log p - log q, where q is p under the map, mixed with p.
        """
        new, log_det = (
            batch_product(self.matrix, e) + self.offset,
            torch.linalg.slogdet(self.matrix)[1],
        )
        if selection is None:
            return new, log_p(new) - log_p(e) + log_det
        stays = selection.mask.unsqueeze(-1)
        back = torch.where(
            stays, batch_product(torch.linalg.inv_ex(self.matrix)[0], e - self.offset), e
        )  # the preimage of new
        new = torch.where(stays, e, new)
        log_new = log_p(new)
        return new, log_new - selection.log_mixture(log_new, log_p(back) - log_det)
