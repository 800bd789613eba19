"""Filter with a learned gain: a state estimate without covariance and evidence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief, StepInfo
from pfbench.filter.feedback import LEARNED_GAIN_MEMORY
from pfbench.filter.learned.gain import GainInputs, LearnedGain
from pfbench.filter.linearisation import check_moments, mean_noise
from pfbench.model.base import StateSpaceModel, initial_law

_PAST = f"{LEARNED_GAIN_MEMORY}past"  # hidden state of the network, [R, H]
_LAST_Y = f"{LEARNED_GAIN_MEMORY}measurement"  # last measurement of each component, [R, k]
_CORRECTION = f"{LEARNED_GAIN_MEMORY}correction"  # [R, d]
_EVOLUTION = f"{LEARNED_GAIN_MEMORY}evolution"  # [R, d]
_STATE_SD = f"{LEARNED_GAIN_MEMORY}state_sd"  # [R, d]


@dataclass(frozen=True)
class LearnedGainFilter:
    """KalmanNet: the mean transition of the model, corrected by a learned gain times the innovation.

    After G. Revach et al. (2022), KalmanNet, IEEE Transactions on Signal Processing 70. The network
    replaces the covariances. The filter therefore states neither a covariance nor an evidence: both
    are NaN, except that the evidence of a valid run is 0 in the belief.

    Missing components of a measurement correct nothing [ours]. On a curved chart the correction
    applies in the chart about the prediction [ours].

    Attributes:
        gain: Network of the gain.

    Raises:
        ValueError: On use, if a mean or variance of the model is not finite, or as for
            `LearnedGain`.
    """

    gain: LearnedGain
    is_exact = False
    has_evidence = False
    has_covariance = False

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> GaussianBelief:
        """Compute the belief at step 0, the mean of the initial distribution.

        Args:
            model: State-space model.
            runs: Number of runs R.
            draws: Random stream, not used.
            start: States about which the initial distribution is placed, [R, D].
            spread: Cholesky factors of the initial covariances, [R, d, d]. They scale the inputs of
                the network.

        Returns:
            The belief, with a covariance of NaN.

        Raises:
            ValueError: If mean or variance of the initial or the noise distribution is not finite.
        """
        initial: Any = initial_law(model, runs, spread)
        for name, distribution in (("initial", initial), ("noise", model.noise)):
            check_moments(model, name, distribution)
        origin = model.origin.expand(runs, -1) if start is None else start
        mean = model.chart.add(origin, initial.mean)
        d, sd = model.chart.dimension, initial.stddev.expand(runs, -1)
        memory = {
            _PAST: mean.new_zeros(runs, self.gain.hidden),
            _CORRECTION: mean.new_zeros(runs, d),
            _EVOLUTION: mean.new_zeros(runs, d),
            _STATE_SD: torch.where(sd > 0.0, sd, 1.0).to(mean),
        }
        log_z = torch.zeros(runs, dtype=torch.float64, device=mean.device)
        return GaussianBelief(mean, mean.new_full((runs, d, d), torch.nan), log_z, memory)

    def step(
        self, model: StateSpaceModel, belief: GaussianBelief, record: Record, draws: RandomStream
    ) -> tuple[GaussianBelief, StepInfo]:
        """Compute the belief after a measurement.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            record: Measurement and inputs of step t.
            draws: Random stream, not used.

        Returns:
            Belief at t and its estimate, without covariance. A run whose estimate is not finite is
            lost.

        Raises:
            ValueError: As for the class.
        """
        chart, parent = model.chart, belief.mean.unsqueeze(1)
        prior = model.propagate(parent, record.u, mean_noise(model, parent))
        inputs, last_y = _compute_inputs(model, belief, record, prior)
        gain, past = self.gain(model, inputs, belief.memory[_PAST])
        correction = (gain @ inputs.innovation.unsqueeze(-1)).squeeze(-1)
        mean = chart.add(prior[:, 0], correction)
        memory = belief.memory | {
            _PAST: past,
            _LAST_Y: last_y,
            _CORRECTION: correction,
            _EVOLUTION: chart.subtract(mean, belief.mean),
        }
        is_finite = torch.isfinite(mean.detach()).all(-1)
        log_z = torch.where(is_finite, belief.log_evidence, -torch.inf)
        unknown = belief.covariance
        info = StepInfo(
            mean, unknown[..., 0], lambda: unknown, {}, has_covariance=self.has_covariance
        )
        return GaussianBelief(mean, unknown, log_z, memory), info


def _compute_inputs(
    model: StateSpaceModel, belief: GaussianBelief, record: Record, prior: Tensor
) -> tuple[GainInputs, Tensor]:
    """Return the inputs of the gain at predictions [R, 1, D], and the last measurements [R, k]."""
    distribution: Any = model.observation(prior, record.u)
    check_moments(model, "observation", distribution)
    observed_mask, y = ~torch.isnan(record.y), record.y.nan_to_num()
    r = torch.where(observed_mask, model.residual(y, distribution.mean[:, 0]), 0.0)
    last_y = belief.memory.get(_LAST_Y, record.y)
    change = model.residual(y, last_y.nan_to_num())
    has_change = observed_mask & ~torch.isnan(last_y)
    inputs = GainInputs(
        innovation=r,
        measurement_change=torch.where(has_change, change, 0.0),
        correction=belief.memory[_CORRECTION],
        evolution=belief.memory[_EVOLUTION],
        observed_mask=observed_mask,
        measurement_sd=distribution.stddev[:, 0].expand_as(r),
        state_sd=belief.memory[_STATE_SD],
    )
    return inputs, torch.where(observed_mask, record.y, last_y)
