"""Feedback: the estimate of a step corrects the process that the filter estimates."""

from __future__ import annotations

import torch
from torch import Tensor

from pfbench.core.record import FeedbackRun
from pfbench.filter.belief import GaussianBelief, ParticleBelief, StepInfo
from pfbench.filter.gaussian.linearisation_rules import DifferenceSpace, TaylorLinearisation
from pfbench.filter.particle.weight_update import WEIGHT_UPDATE_MEMORY
from pfbench.model.base import StateSpaceModel

LEARNED_GAIN_MEMORY = "learned_gain_"  # start of the names in the memory of a learned gain


def apply_feedback(
    model: StateSpaceModel,
    feedback: FeedbackRun,
    belief: ParticleBelief | GaussianBelief,
    info: StepInfo,
) -> tuple[ParticleBelief | GaussianBelief, StepInfo]:
    """Correct the process by the estimate of valid runs, and the belief accordingly.

    The correction applies to particles or to the mean of a Gaussian belief. Its derivative
    transforms the covariance, because a correction of the attitude rotates the axes [ours].

    Args:
        model: State-space model.
        feedback: Process that the estimate corrects.
        belief: Belief after the step.
        info: Estimate of the step.

    Returns:
        Belief about the correct_increment process, and the info with the uncorrected estimate.

    Raises:
        ValueError: If particles or a learned gain carry a past, which refers to the uncorrected
            process, or if the filter has several hypotheses.
    """
    valid = torch.isfinite(belief.log_evidence).unsqueeze(-1)
    uncorrected, correct = feedback.correct(torch.where(valid, info.mean, 0.0))
    info = info._replace(mean=torch.where(valid, uncorrected.to(info.mean), info.mean))
    if isinstance(belief, ParticleBelief):
        # the memory of a weight update counts measurements of a run; it holds no states
        past = [name for name in belief.memory if not name.startswith(WEIGHT_UPDATE_MEMORY)]
        if belief.window or past:
            raise ValueError(
                "filter must not store a particle's past in a scenario with feedback, got one with "
                "moves, a guided start or a proposal's memory. Choose another filter, or set "
                "scenario.closed_loop=false."
            )
        return belief._replace(x=correct(belief.x)), info
    if any(name.startswith("branch_") for name in belief.memory):
        raise ValueError(
            "filter must not have several hypotheses in a scenario with feedback, which corrects one "
            "estimate. Choose another filter, or set scenario.closed_loop=false."
        )
    if any(name.startswith(LEARNED_GAIN_MEMORY) for name in belief.memory):
        raise ValueError(
            "filter must not have a learned gain in a scenario with feedback, got one: its memory "
            "refers to the uncorrected process. Choose another filter, or set "
            "scenario.closed_loop=false."
        )
    chart, centre = model.chart, belief.mean.unsqueeze(1)

    def correct_increment(xi: Tensor) -> tuple[Tensor, Tensor]:
        return correct(chart.add(centre, xi)), xi.new_zeros(1, 1, 1, 1)

    space = DifferenceSpace(chart.subtract, chart.mean)
    mean, slope, *_ = TaylorLinearisation()(correct_increment, belief.mean, chart.dimension, space)
    return belief._replace(mean=mean, covariance=slope @ belief.covariance @ slope.mT), info


def correctable_groups(model: StateSpaceModel) -> dict[str, tuple[int, ...]]:
    """Return the component groups of a model, none if its states are not differences."""
    return model.groups if model.chart.size == len(model.names) else {}
