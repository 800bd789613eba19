"""Noise coordinates of a learned proposal: standardised noise, or those of a guide.

The network's noise zeta maps to standardised noise xi = m + U zeta. Without a guide xi = zeta.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.guided.noise_guide import GuidedNoiseProposal, NoisePosterior
from pfbench.model.base import StateSpaceModel


def describe_frame(guide: GuidedNoiseProposal | None) -> str:
    """Describe the distribution that the network corrects, for the checkpoint."""
    if guide is None:
        return "the model's own noise"
    rule = guide.guide_filter.linearisation
    return f"what is guided by {type(getattr(rule, 'points', rule)).__name__}"


def fit_frame(
    guide: GuidedNoiseProposal | None,
    model: StateSpaceModel,
    belief: ParticleBelief,
    record: Record,
) -> NoisePosterior | None:
    """Return the map from noise of the network to standardised noise.

    Args:
        guide: Guided proposal, or None.
        model: State-space model.
        belief: Belief before the step.
        record: Record of the step.

    Returns:
        The map, None for the identity.
    """
    return None if guide is None else guide.fit_posterior(model, belief, record)


def to_frame(
    guide: GuidedNoiseProposal | None,
    model: StateSpaceModel,
    belief: ParticleBelief,
    record: Record,
    parent: Tensor,
    xi: Tensor,
) -> tuple[Tensor, Tensor]:
    """Map standardised noise of given parents to noise of the network.

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
    joined = append_states(belief, parent.unsqueeze(1))
    with torch.no_grad():  # the frame does not depend on the network
        frame = fit_frame(guide, model, joined, record)
    if frame is None:
        return xi, torch.zeros_like(xi[..., 0])
    padding = xi.new_zeros(len(xi), belief.x.shape[1], xi.shape[-1])
    return frame.to_standard(torch.cat([padding, xi], 1))[:, -1:], frame.log_det[:, -1:]


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
