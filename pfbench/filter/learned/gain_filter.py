"""Filter with a learned gain: a state estimate without covariance and evidence."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from typing_extensions import override

from pfbench.core.parameter_checks import require_range
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief, StepInfo
from pfbench.filter.learned.networks import CheckpointSpec, build_networks
from pfbench.filter.linearisation import check_moments, mean_noise
from pfbench.filter.loop import LEARNED_GAIN_MEMORY
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


# --------------------------------------------------------------------------------------------------
# Network that computes the gain of a filter without a covariance.

NORMALISATIONS = ("length", "asinh")

_LIMIT = 10.0  # of an input, so that outlying values stay within the range of the training

HeadFactory = Callable[[int, int], nn.Module]
"""(number of inputs, number of outputs) -> network."""


class GainInputs(NamedTuple):
    """Quantities of a step from which a gain is computed.

    Attributes:
        innovation: y - y_hat, [R, k]; 0 for missing components.
        measurement_change: y minus the last measurement of each component, [R, k]; 0 where there is
            none.
        correction: Correction of the state in the last step, [R, d].
        evolution: Change of the state estimate in the last step, [R, d].
        observed_mask: Observed components, bool [R, k].
        measurement_sd: Standard deviations of the measurement noise, [R, k].
        state_sd: Standard deviations of the initial distribution, [R, d]; 1 where they are 0.
    """

    innovation: Tensor
    measurement_change: Tensor
    correction: Tensor
    evolution: Tensor
    observed_mask: Tensor
    measurement_sd: Tensor
    state_sd: Tensor


class LearnedGain(nn.Module):
    """Gain from a recurrent network, the first architecture of KalmanNet [Revach et al. 2022].

    A layer, a GRU and a second network map the inputs to the elements of the gain. Differences of
    states count in standard deviations of the initial distribution, differences of measurements in
    those of the measurement noise, and the output refers to both [ours]. The mask of observed
    components is a further input [ours]. The output of an untrained gain is 0.

    Args:
        network: Makes the network between the GRU and the gain.
        hidden: Hidden size of the GRU and size of the layer before it.
        normalisation: `length` scales each of the four differences to length 1, as the published
            code. `asinh` keeps their sizes [ours], so that the gain can depend on them.
        checkpoint: File of trained weights, or `untrained`. None raises on use.
        seed: Seed of an untrained network.

    Raises:
        ValueError: If `hidden` is below 1 or `normalisation` unknown. On use, if no checkpoint is
            set, or if it belongs to another model or network.
    """

    checkpoint_key = "gain"

    def __init__(
        self,
        network: HeadFactory,
        hidden: int = 32,
        normalisation: str = "length",
        checkpoint: str | None = "untrained",
        seed: int = 0,
    ) -> None:
        super().__init__()
        require_range("gain.hidden", hidden, "[1, inf] The default is 32.")
        if normalisation not in NORMALISATIONS:
            raise ValueError(
                f"gain.normalisation must be one of {', '.join(NORMALISATIONS)}, got "
                f"{normalisation}. Choose one of them."
            )
        self.make, self.hidden, self.normalisation = network, hidden, normalisation
        # the same weights give another gain with inputs of another normalisation
        frame = f"the gain of inputs with normalisation {normalisation}"
        self.learnable = CheckpointSpec(self.checkpoint_key, checkpoint, seed, frame)
        self.sizes = 0, 0, hidden
        self.layer: nn.Module | None = None
        self.recurrent: nn.Module | None = None
        self.network: nn.Module | None = None

    def build(self, model: StateSpaceModel, measurement_size: int, fresh: bool = False) -> None:
        """Build the networks and load the checkpoint, unless `fresh`.

        Args:
            model: State-space model.
            measurement_size: Number of measurement components k.
            fresh: Start from untrained weights.

        Raises:
            ValueError: As for the class.
        """
        features, outputs = _network_sizes(model.chart.dimension, measurement_size)
        self.sizes = features, outputs, self.hidden

        def make() -> dict[str, nn.Module]:
            return {
                "layer": nn.Sequential(nn.Linear(features, self.hidden), nn.ReLU()),
                "recurrent": nn.GRUCell(self.hidden, self.hidden),
                "network": self.make(self.hidden, outputs),
            }

        for name, module in build_networks(self.learnable, make, self.sizes, model, fresh).items():
            setattr(self, name, module)

    @override
    def forward(
        self, model: StateSpaceModel, inputs: GainInputs, past: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Compute the gain of a step.

        Args:
            model: State-space model of the step.
            inputs: Quantities of the step.
            past: Hidden state of the GRU, [R, H].

        Returns:
            Gain [R, d, k] in units of the state per unit of the measurement, and the hidden state
            after the step.
        """
        k, d = inputs.innovation.shape[-1], inputs.state_sd.shape[-1]
        if self.network is None or self.sizes[:2] != _network_sizes(d, k):
            self.build(model, k)
        assert self.layer is not None
        assert self.recurrent is not None
        assert self.network is not None
        past = self.recurrent(self.layer(self._features(inputs)), past)
        gain = self.network(past).unflatten(-1, (d, k))
        scale = inputs.state_sd.unsqueeze(-1) / inputs.measurement_sd.unsqueeze(-2)
        return gain * scale, past

    def _features(self, inputs: GainInputs) -> Tensor:
        """Return the network input [R, F]."""
        differences = [
            inputs.innovation / inputs.measurement_sd,
            inputs.measurement_change / inputs.measurement_sd,
            inputs.correction / inputs.state_sd,
            inputs.evolution / inputs.state_sd,
        ]
        if self.normalisation == "length":
            scaled = [nn.functional.normalize(a, dim=-1) for a in differences]
        else:
            scaled = [torch.asinh(a).clamp(-_LIMIT, _LIMIT) for a in differences]
        return torch.cat([*scaled, inputs.observed_mask.to(scaled[0])], -1)


def _network_sizes(d: int, k: int) -> tuple[int, int]:
    """Return the numbers of inputs and outputs for d state and k measurement components."""
    return 3 * k + 2 * d, d * k
