"""Densities of standardised noise, and mixtures of a proposal with the model."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pfbench.core.random_stream import RandomStream
from pfbench.filter.linearisation import batch_product
from pfbench.filter.particle.stages import (
    draw_noise,
    has_standard_noise,
)
from pfbench.model.base import StateSpaceModel


def draw_standardised_noise(model: StateSpaceModel, z: Tensor, draws: RandomStream) -> Tensor:
    """Draw standardised noise from the model's noise distribution.

    Returns noise minus its mean, divided by its standard deviation, [R, N, W]. Shapes: z [R, N, W].
    """
    if has_standard_noise(model):
        return z
    return (draw_noise(model, z.shape[1], draws) - model.noise.mean) / model.noise.stddev


def scale_noise(model: StateSpaceModel, xi: Tensor) -> Tensor:
    """Convert standardised noise to the noise of the model.

    Returns noise, [R, N, W]. Shapes: xi [R, N, W].
    """
    return xi if has_standard_noise(model) else model.noise.mean + model.noise.stddev * xi


def log_noise_density(model: StateSpaceModel, w: Tensor, xi: Tensor) -> Tensor:
    """Compute log p(w) as a density of the standardised noise.

    Returns log density, [R, N]. Shapes: w [R, N, W], xi [R, N, W].
    """
    if has_standard_noise(model):
        return log_standard_normal(xi)
    value: Tensor = model.noise.log_prob(w) + model.noise.stddev.log().sum()
    return value


def log_standard_normal(z: Tensor) -> Tensor:
    """Compute log N(z; 0, I) of z [..., W] as [...]."""
    return -0.5 * (z * z).sum(-1) - 0.5 * z.shape[-1] * math.log(2.0 * math.pi)


# --------------------------------------------------------------------------------------------------
# Defensive mixtures: a fraction of the particles follows the model.
#
# This bounds all weights [Hesterberg 1995].


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

        Returns log density, [R, N]. Shapes: log_p [R, N], log_q [R, N].
        """
        return torch.logaddexp(
            log_p + torch.log(self.fraction), log_q + torch.log1p(-self.fraction)
        )

    def bound_log_ratio(self, log_ratio: Tensor) -> Tensor:
        """Compute log p minus the log density of the mixture, which is at most -log fraction.

        Returns log ratio, [R, N]. Shapes: log_ratio [R, N].
        """
        return -torch.logaddexp(torch.log(self.fraction), torch.log1p(-self.fraction) - log_ratio)


def choose_defensive_particles(
    fraction: float, active_mask: Tensor, draws: RandomStream, purpose: str
) -> DefensiveSelection:
    """Choose a fraction of the active particles at random, and all inactive slots.

    The choice is random, because neighbours after resampling are copies of one particle.

    Returns mask and fraction. Shapes: active_mask [R, N].
    """
    count = active_mask.sum(1, keepdim=True).clamp(min=1).to(draws.dtype)
    u = draws.uniform(purpose, active_mask.shape[1], 1).squeeze(-1)
    rank = torch.where(active_mask, u, torch.inf).argsort(1).argsort(1)
    # one particle at least, since the weights of a few would be unbounded otherwise
    target = torch.round(fraction * count).clamp(min=1.0 if fraction > 0.0 else 0.0)
    return DefensiveSelection((rank < target) | ~active_mask, target / count)


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

        Returns new samples and log p - log q, where q is p under the map, mixed with p. Shapes: e
        [R, N, k], log_p [R, N].
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
