"""The adaptations of a Gaussian filter, applied in order."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from pfbench.core.parameter_checks import check_whole_number
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import GainAdaptation, Innovation, NoiseAdaptation


def adapt_innovation(
    noise_adaptations: Sequence[NoiseAdaptation],
    gain_adaptations: Sequence[GainAdaptation],
    innovation: Innovation,
    belief: GaussianBelief,
) -> tuple[Innovation, dict[str, Tensor], dict[str, Tensor]]:
    """Apply all adaptations to an innovation.

    Args:
        noise_adaptations: Noise adaptations in order.
        gain_adaptations: Gain adaptations in order, applied last.
        innovation: Innovation of the step.
        belief: Belief at t-1.

    Returns:
        The innovation, the values for the next step, and the diagnostics [R] of this step.
    """
    memory: dict[str, Tensor] = {}
    for adaptation in noise_adaptations:
        innovation, carried = adaptation.noise_adapt(innovation, belief)
        memory |= carried
    trace = {
        name: value if value.dim() == 1 else value.amax(1)
        for name, value in memory.items()
        if value.dim() <= 2
    }
    if gain_adaptations:
        widening = torch.ones_like(belief.mean[:, 0])
        for gain in gain_adaptations:
            widening = gain(innovation, widening)
        innovation, trace["widening"] = innovation.inflate(widening), widening
    return innovation, memory, trace


def states_evidence(adaptation: object) -> bool:
    """Return whether an adaptation states that it does not use the measurement of the step."""
    return bool(getattr(adaptation, "has_evidence", False))


def check_adaptations(
    noise_adaptations: Sequence[NoiseAdaptation],
    gain_adaptations: Sequence[GainAdaptation],
    iterations: int,
) -> None:
    """Check that adaptations do not judge one innovation twice.

    Args:
        noise_adaptations: Noise adaptations of the filter.
        gain_adaptations: Gain adaptations of the filter.
        iterations: Number of updates.

    Raises:
        ValueError: If iterations is not a whole number from 1, or above 1 with an adaptation that uses the innovation, or
            if two noise adaptations use it.
    """
    check_whole_number("filter.iterations", iterations, 1, "Use 1 for a single update.")
    if iterations > 1 and (noise_adaptations or gain_adaptations):
        raise ValueError(
            "filter.iterations must be 1 with noise_adaptations or gain_adaptations, got "
            f"{iterations}. Set filter.iterations=1."
        )
    judges = [type(a).__name__ for a in noise_adaptations if not states_evidence(a)]
    if len(judges) > 1:
        raise ValueError(
            "filter.noise_adaptations must contain at most one that uses the measurement of the "
            f"step, got {' and '.join(judges)}. Remove all but one: the same innovation would count "
            "twice."
        )
