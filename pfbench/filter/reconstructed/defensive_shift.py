"""Selection of shifted particles, and their noise-free predictions."""

from __future__ import annotations

import torch
from torch import Tensor

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.defensive_mixture import DefensiveSelection, choose_defensive_particles
from pfbench.filter.linearisation import mean_noise
from pfbench.filter.particle.proposals import ProposalSample
from pfbench.filter.particle.weight_update import deactivate_invalid_particles
from pfbench.model.base import StateSpaceModel


def select_defensive(
    fraction: float, log_w: Tensor, draws: RandomStream
) -> DefensiveSelection | None:
    """Draw the particles that are not shifted, or return None if there are none.

    Args:
        fraction: Fraction that is not shifted.
        log_w: Log weights, [R, N].
        draws: Random stream.

    Returns:
        Selection of these particles.
    """
    if fraction == 0.0:
        return None
    return choose_defensive_particles(fraction, torch.isfinite(log_w), draws, "reconstruction.keep")


def keep_selected(selection: DefensiveSelection | None, old: Tensor, new: Tensor) -> Tensor:
    """Return `old` for selected particles and `new` for the others.

    Args:
        selection: Selection, or None for no particle.
        old: Values of selected particles, [R, N, ...].
        new: Values of the others, [R, N, ...].

    Returns:
        Values, [R, N, ...].
    """
    return new if selection is None else torch.where(selection.mask.unsqueeze(-1), old, new)


def predict_without_noise(
    model: StateSpaceModel, belief: ParticleBelief, record: Record
) -> tuple[Tensor, Tensor]:
    """Compute noise-free predictions.

    Args:
        model: State-space model.
        belief: Belief before the step.
        record: Record of the step.

    Returns:
        Predictions [R, N, D] and weights [R, N], 0 where the prediction is not finite.
    """
    x = model.propagate(belief.x, record.u, mean_noise(model, belief.x))
    x, log_w = deactivate_invalid_particles(x, belief.log_w, belief.x)
    return x, normalise_log_weights(log_w)


def replace_invalid(sample: ProposalSample, belief: ParticleBelief) -> tuple[Tensor, Tensor]:
    """Restore the parents of non-finite particles, with weight 0.

    Args:
        sample: Sample of the proposal.
        belief: Belief before the step.

    Returns:
        Particles [R, N, D] and log ratio [R, N].
    """
    return deactivate_invalid_particles(sample.x, sample.log_ratio, belief.x)
