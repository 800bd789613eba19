"""Loss functions for the learned parts of a filter.

Some losses depend on all earlier steps of the filter, and their gradient passes through it,
resampling included. Others depend on one step, and the filter runs without a gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.core.simulate import draw_initial_state, draw_values, simulate_steps
from pfbench.filter.belief import StepInfo
from pfbench.filter.learned.gain_filter import LearnedGain, LearnedGainFilter
from pfbench.filter.learned.proposal import LearnedProposal
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.model.base import StateSpaceModel, StaticModel, initial_law

TrainableFilter = ParticleFilter | LearnedGainFilter
LearnedPart = LearnedProposal | LearnedGain


class TrainingStep(NamedTuple):
    """One step of a filter with its truth, from which an objective computes a loss.

    Attributes:
        method: The filter.
        model: Model of this step.
        before: Belief before the step.
        after: Belief after the step.
        step_info: Estimate and diagnostics of the step.
        record: Measurements and inputs of the step.
        truth: True state, [R, D]. NaN where it is unknown.
        parent: True state before the step, [R, D]. None unless the data were simulated from the
            model.
        noise: Noise that drove the true state, [R, W]. None as `parent`.
        scale: Standard deviations of the initial distribution, [R or 1, d].
        draws: Random stream of the step.
    """

    method: Any
    model: StateSpaceModel
    before: Any
    after: Any
    step_info: StepInfo
    record: Record
    truth: Tensor
    parent: Tensor | None
    noise: Tensor | None
    scale: Tensor
    draws: RandomStream


class Objective(Protocol):
    """A loss of each run and step."""

    @property
    def needs_filter_gradient(self) -> bool:
        """True if the gradient passes through the filter."""

    @property
    def needs_simulated_data(self) -> bool:
        """True if the loss needs data simulated from the model, with known states and noise.

        Inputs and gaps are those of the training data.
        """

    @property
    def needs_particles(self) -> bool:
        """True if the loss is defined for particle filters only."""

    def __call__(self, step: TrainingStep) -> Tensor:
        """Compute the loss of a step, [R]."""


@dataclass(frozen=True)
class EvidenceLowerBound(Objective):
    """Negative log evidence of each step: E[log Z_hat] <= log p(y), tighter with more particles.

    The objective of variational SMC, FIVO and AESMC, which differ in when they resample. The loss
    of a lost run is 0.

    References:
        C. Naesseth et al. (2018), C. Maddison et al. (2017), T. A. Le et al. (2018).
    """

    needs_filter_gradient = True
    needs_simulated_data = False
    needs_particles = True

    @override
    def __call__(self, step: TrainingStep) -> Tensor:
        valid = torch.isfinite(step.after.log_evidence)
        log_z = torch.where(valid, step.after.log_evidence, 0.0)
        return torch.where(valid, step.before.log_evidence - log_z, 0.0)


@dataclass(frozen=True)
class StateErrorLoss(Objective):
    """Mean square error in standard deviations of the initial distribution [ours].

    It rewards a good mean, not good weights. It needs the truth and a resampler through which
    gradients pass. The weights of the filter remain corrected.

    References:
        R. Jonschkowski, D. Rastogi and O. Brock (2018). P. Karkus, D. Hsu and W. S. Lee (2018).
    """

    needs_filter_gradient = True
    needs_simulated_data = False
    needs_particles = False

    @override
    def __call__(self, step: TrainingStep) -> Tensor:
        error = step.model.error(step.step_info.mean, step.truth) / step.scale
        finite = torch.isfinite(error)
        return torch.where(finite, error, 0.0).square().sum(-1) / finite.sum(-1).clamp(min=1)


@dataclass(frozen=True)
class InferenceCompilation(Objective):
    """-log q(w | parent, y) of the noise of simulated data: forward KL, which covers all modes.

    The proposal is evaluated at the true parent. The filter runs without a gradient.

    References:
        T. A. Le, A. G. Baydin and F. Wood (2017).
    """

    needs_filter_gradient = False
    needs_simulated_data = True
    needs_particles = True

    @override
    def __call__(self, step: TrainingStep) -> Tensor:
        proposal = step.method.proposal
        if isinstance(step.model, StaticModel):
            return torch.zeros_like(step.after.log_w[:, 0])
        assert step.parent is not None
        assert step.noise is not None
        return -proposal.log_density(step.model, step.before, step.record, step.parent, step.noise)


def find_learned_parts(method: TrainableFilter) -> dict[str, LearnedPart]:
    """Return the trainable parts of a filter, by their name in a checkpoint."""
    stages = getattr(method, "gain", None), getattr(method, "proposal", None)
    parts = {
        stage.checkpoint_key: stage
        for stage in stages
        if isinstance(stage, LearnedProposal | LearnedGain)
    }
    require(
        parts, "filter", "have a network to train", "none", "Choose one such as filter=neural_sir."
    )
    return parts


def simulate_from_model(
    model: StateSpaceModel, record: Record, draws: RandomStream
) -> tuple[Record, Tensor, Tensor]:
    """Simulate a record from the model, with the inputs, initial states and gaps of a record.

    Returns the record with simulated measurements, the states from the initial one on
    [R, T + 1, D], and the noise [R, T, W].
    """
    initial = initial_law(model, len(record.y), record.spread)
    x = draw_initial_state(model, initial, draws.at_step(0), "imagined", start=record.start)
    states, noises, rows = [x], [], []
    for step in simulate_steps(model, record, draws, x, "noise"):
        y = draw_values(step.distribution, draws.at_step(step.t + 1), "imagined", 1)[:, 0]
        states.append(step.x)
        noises.append(step.w)
        rows.append(torch.where(torch.isnan(step.record.y), torch.nan, y))
    return record._replace(y=torch.stack(rows, 1)), torch.cat(states, 1), torch.cat(noises, 1)
