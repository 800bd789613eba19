"""Noise coordinates of a learned proposal: standardised noise, or those of a guide.

The network's noise zeta maps to standardised noise xi = m + U zeta. Without a guide xi = zeta.
"""

from __future__ import annotations

import math
from typing import Any

import torch
from torch import Tensor

from pfbench.core.normal import StandardNormal
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.guided.noise_guide import GuidedNoiseProposal
from pfbench.filter.learned.networks import log_standard_normal
from pfbench.filter.linearisation import unwrap_independent
from pfbench.model.base import StateSpaceModel


def describe_frame(guide: GuidedNoiseProposal | None) -> str:
    """Describe the distribution that the network corrects, for the checkpoint."""
    if guide is None:
        return "the model's own noise"
    rule = guide.guide_filter.linearisation
    return f"what is guided by {type(getattr(rule, 'points', rule)).__name__}"


def from_frame(
    guide: GuidedNoiseProposal | None,
    model: StateSpaceModel,
    belief: ParticleBelief,
    record: Record,
    zeta: Tensor,
) -> tuple[Tensor, Tensor]:
    """Map noise of the network to standardised noise.

    Args:
        guide: Guided proposal, or None.
        model: State-space model.
        belief: Belief before the step.
        record: Record of the step.
        zeta: Noise of the network, [R, N, W].

    Returns:
        xi = m + U zeta [R, N, W] and log |det U| [R, N or 1].
    """
    if guide is None:
        return zeta, torch.zeros_like(zeta[..., 0])
    xi, log_det = guide.map_to_posterior(model, belief, record, zeta)
    return xi, log_det + 0.5 * zeta.shape[-1] * math.log(guide.covariance_factor)


def to_frame(
    guide: GuidedNoiseProposal | None,
    model: StateSpaceModel,
    belief: ParticleBelief,
    record: Record,
    parent: Tensor,
    xi: Tensor,
) -> tuple[Tensor, Tensor]:
    """Map standardised noise of given parents to noise of the network.

    The affine map is determined from its values at W + 1 points.

    Args:
        guide: Guided proposal, or None.
        model: State-space model.
        belief: Belief before the step.
        record: Record of the step.
        parent: Parents, [R, D].
        xi: Standardised noise, [R, 1, W].

    Returns:
        zeta [R, 1, W] and log |det U| [R, 1].
    """
    width = xi.shape[-1]
    probes = torch.cat([torch.zeros_like(xi), torch.eye(width).to(xi).expand(len(xi), -1, -1)], 1)
    joined = append_states(belief, parent.unsqueeze(1).expand(-1, width + 1, -1))
    padded = torch.cat([xi.new_zeros(len(xi), belief.x.shape[1], width), probes], 1)
    with torch.no_grad():  # the frame does not depend on the network
        mapped, log_det = from_frame(guide, model, joined, record, padded)
    m, columns = mapped[:, -width - 1], mapped[:, -width:]
    offset = (xi.squeeze(1) - m).unsqueeze(-1)
    zeta = torch.linalg.solve_ex((columns - m.unsqueeze(1)).mT, offset)[0]
    return zeta.mT, log_det[:, -1:]


def append_states(belief: ParticleBelief, states: Tensor) -> ParticleBelief:
    """Append states with weight 0 to the particles.

    Args:
        belief: Belief with N particles.
        states: States to append, [R, M, D].

    Returns:
        Belief with N + M particles.
    """
    log_w = torch.full_like(states[..., 0], -torch.inf)
    return belief._replace(
        x=torch.cat([belief.x, states], 1), log_w=torch.cat([belief.log_w, log_w], 1)
    )


def scale_noise(model: StateSpaceModel, xi: Tensor) -> Tensor:
    """Convert standardised noise to the noise of the model.

    Args:
        model: State-space model.
        xi: Standardised noise, [R, N, W].

    Returns:
        Noise, [R, N, W].
    """
    noise = model.noise
    if isinstance(unwrap_independent(noise), StandardNormal):
        return xi
    return noise.mean + noise.stddev * xi


def log_noise_density(model: StateSpaceModel, w: Tensor, xi: Tensor) -> Tensor:
    """Compute log p(w) as a density of the standardised noise.

    Args:
        model: State-space model.
        w: Noise, [R, N, W].
        xi: The same noise, standardised, [R, N, W].

    Returns:
        Log density, [R, N].
    """
    noise: Any = model.noise
    if isinstance(unwrap_independent(noise), StandardNormal):
        return log_standard_normal(xi)
    value: Tensor = noise.log_prob(w) + noise.stddev.log().sum()
    return value
