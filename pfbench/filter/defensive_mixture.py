"""Defensive mixtures: a fraction of the particles follows the model.

This bounds all weights [Hesterberg 1995].
"""

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
        """Compute the log density of the mixture, log(fraction p + (1 - fraction) q).

        Args:
            log_p: Log density p of the model, [R, N].
            log_q: Log density q of the other particles, [R, N].

        Returns:
            Log density, [R, N].
        """
        return torch.logaddexp(
            log_p + torch.log(self.fraction), log_q + torch.log1p(-self.fraction)
        )

    def bound_log_ratio(self, log_ratio: Tensor) -> Tensor:
        """Compute log p minus the log density of the mixture, which is at most -log fraction.

        Args:
            log_ratio: log p - log q, [R, N].

        Returns:
            Log ratio, [R, N].
        """
        return -torch.logaddexp(torch.log(self.fraction), torch.log1p(-self.fraction) - log_ratio)


def choose_defensive_particles(
    fraction: float, active_mask: Tensor, draws: RandomStream, purpose: str
) -> DefensiveSelection:
    """Choose a fraction of the active particles at random, and all inactive slots.

    The choice is random, because neighbours after resampling are copies of one particle.

    Args:
        fraction: Fraction of the active particles.
        active_mask: Active particles, [R, N].
        draws: Random stream.
        purpose: Label of the draw.

    Returns:
        Mask and fraction.
    """
    count = active_mask.sum(1, keepdim=True).clamp(min=1).to(draws.dtype)
    u = draws.uniform(purpose, active_mask.shape[1], 1).squeeze(-1)
    rank = torch.where(active_mask, u, torch.inf).argsort(1).argsort(1)
    # one particle at least, since the weights of a few would be unbounded otherwise
    target = torch.round(fraction * count).clamp(min=1.0 if fraction > 0.0 else 0.0)
    return DefensiveSelection((rank < target) | ~active_mask, target / count)


def check_fraction(name: str, value: float, below_one: bool = False) -> None:
    """Check that a value is a fraction.

    Args:
        name: Configuration key.
        value: Its value.
        below_one: Whether 1 is refused.

    Raises:
        ValueError: If it is outside [0, 1], or [0, 1).
    """
    if below_one and value == 1.0:
        raise ValueError(f"{name} must be below 1, got {value}. Use BootstrapProposal for 1.")
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name} must be from 0 to 1, got {value}. Choose a fraction.")


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
        """Map samples of density p, except the defensive ones, and compute the ratio.

        Args:
            e: Samples, [R, N, k].
            selection: Defensive selection, None for no particle.
            log_p: Log density, [R, N].

        Returns:
            New samples and log p - log q, where q is p under the map, mixed with p.
        """
        new = batch_product(self.matrix, e) + self.offset
        log_det = torch.linalg.slogdet(self.matrix)[1]
        if selection is None:
            return new, log_p(new) - log_p(e) + log_det
        mask = selection.mask.unsqueeze(-1)
        preimage_of_e = batch_product(torch.linalg.inv_ex(self.matrix)[0], e - self.offset)
        preimage = torch.where(mask, preimage_of_e, e)
        new = torch.where(mask, e, new)
        log_new = log_p(new)
        return new, log_new - selection.log_mixture(log_new, log_p(preimage) - log_det)
