"""Learned proposal: a network parametrises the noise distribution of a step.

The network is any nn.Module that maps features [R, N, F] to a distribution with batch [R, N]
and event [W]. The ratio p(w) / q(w) is computed here for any network output, so a learned
proposal does not change the target of the filter. Insufficient training only lowers the
effective sample size. `networks` contains networks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.parameter_checks import require_range
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.guided.noise_guide import GuidedNoiseProposal, NoisePosterior
from pfbench.filter.learned.differentiable_resampling import sample_from
from pfbench.filter.learned.features import Feature, FeatureStack, make_feature_context
from pfbench.filter.learned.networks import CheckpointSpec, build_networks
from pfbench.filter.particle.proposals import (
    choose_defensive_particles,
    draw_standardised_noise,
    log_noise_density,
    scale_noise,
)
from pfbench.filter.particle.stages import ProposalSample
from pfbench.model.base import StateSpaceModel, StaticModel

PAST = "learned.past"  # hidden state of a recurrent network in the belief's memory, [R, 1, H]

NetworkFactory = Callable[[int, int], nn.Module]
"""(number of features, dimension of the noise) -> network."""


class NoiseDistribution(NamedTuple):
    """Distribution of a step's noise: zeta ~ distribution, standardised noise xi = m + U zeta.

    Attributes:
        distribution: Distribution of zeta, batch [R, N], event [W].
        memory: Memory of the belief after this step.
    """

    distribution: Distribution
    memory: dict[str, Tensor]


class LearnedProposal(nn.Module):
    """Proposal whose network maps features to a noise distribution.

    After [Naesseth et al. 2018]. The network output refers to a frame: to the standard deviations
    of the noise or, with a `guide_filter`, to coordinates in which the guide's normal distribution
    is N(0, I). A network with output N(0, I) is therefore the bootstrap or the guided proposal, to
    the last digit, and training corrects it.

    Args:
        network: Makes the module from the number of features and the dimension of the noise.
        features: Input features, by default innovation, parent and spread of the particles.
        guide_filter: Guided proposal of each particle's noise that is corrected. None corrects the
            model's noise.
        defensive_fraction: Fraction of particles drawn from the model's noise instead, whatever the
            guide [Hesterberg 1995]. It limits each ratio to 1 / fraction. 0 draws none.
        memory: Hidden size of a recurrent network (GRU) over past records, one state per run. 0
            uses none.
        checkpoint: File of trained weights, or `untrained`. None raises on use.
        seed: Seed of an untrained network.

    Raises:
        ValueError: If `defensive_fraction` is not in [0, 1). On use, if no checkpoint is set, or if
            it belongs to another model or network.
    """

    is_exact = True
    checkpoint_key = "proposal"

    @property
    def has_bounded_weights(self) -> bool:
        """True if some particles are drawn from the model."""
        return self.defensive_fraction > 0.0

    def __init__(
        self,
        network: NetworkFactory,
        features: Sequence[Feature] | None = None,
        guide_filter: GuidedNoiseProposal | None = None,
        defensive_fraction: float = 0.05,
        memory: int = 0,
        checkpoint: str | None = "untrained",
        seed: int = 0,
    ) -> None:
        super().__init__()
        require_range("proposal.defensive_fraction", defensive_fraction, "[0, 1) Use 0 for none.")
        require_range("proposal.memory", memory, "[0, inf] Use 0 for none.")
        self.make, self.guide_filter = network, guide_filter
        self.defensive_fraction, self.hidden = defensive_fraction, memory
        self.features_of = FeatureStack() if features is None else FeatureStack(features)
        self.learnable = CheckpointSpec(
            self.checkpoint_key, checkpoint, seed, describe_frame(guide_filter)
        )
        self.network: nn.Module | None = None
        self.recurrent: nn.Module | None = None
        self.sizes = 0, 0, memory

    def build(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, fresh: bool = False
    ) -> None:
        """Build the networks and load the checkpoint, unless `fresh`.

        Args:
            model: State-space model.
            belief: Belief before the step, which determines the number of features.
            record: Record of the step.
            fresh: Start from untrained weights.

        Raises:
            ValueError: As for the class.
        """
        features = self.features_of(make_feature_context(model, belief, record)).shape[-1]
        noise = model.noise_dim

        def make() -> dict[str, nn.Module]:
            modules: dict[str, nn.Module] = {"network": self.make(features + self.hidden, noise)}
            if self.hidden:
                modules["recurrent"] = nn.GRUCell(features, self.hidden)
            return modules

        self.sizes = features, noise, self.hidden
        for name, module in build_networks(self.learnable, make, self.sizes, model, fresh).items():
            setattr(self, name, module)

    @override
    def forward(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        distribution, memory = self.compute_distribution(model, belief, record)
        # the label of the corrected proposal: an untrained network then gives the same particles
        n, is_free = belief.x.shape[1], self.guide_filter is None
        z = draws.normal("noise" if is_free else "guide", n, model.noise_dim)
        zeta = sample_from(distribution, z, draws)
        if isinstance(model, StaticModel):  # no transition in this step
            return ProposalSample(
                belief.x, torch.zeros_like(belief.log_w), memory, scale_noise(model, z)
            )
        frame = fit_frame(self.guide_filter, model, belief, record)
        xi = zeta if frame is None else frame.from_standard(zeta)
        selection = None
        if self.defensive_fraction:
            selection = choose_defensive_particles(
                self.defensive_fraction, belief.log_w > -torch.inf, draws, "learned.kept"
            )
            mask = selection.mask.unsqueeze(-1)
            prior_xi = draw_standardised_noise(model, z, draws)
            xi = torch.where(mask, prior_xi, xi)
            zeta = torch.where(
                mask, prior_xi if frame is None else frame.to_standard(prior_xi), zeta
            )
        w = scale_noise(model, xi)
        log_ratio = log_noise_density(model, w, xi) - distribution.log_prob(zeta)
        if frame is not None:
            log_ratio = log_ratio + frame.log_det
        if selection is not None:
            log_ratio = selection.bound_log_ratio(log_ratio)
        return ProposalSample(model.propagate(belief.x, record.u, w), log_ratio, memory, w)

    def compute_distribution(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record
    ) -> NoiseDistribution:
        """Compute the noise distribution of the next step.

        Args:
            model: State-space model.
            belief: Belief before the step.
            record: Record of the step.

        Returns:
            The distribution, and the memory of the belief after this step.
        """
        if self.network is None:
            self.build(model, belief, record)
        features, memory = self._features(model, belief, record)
        assert self.network is not None
        return NoiseDistribution(self.network(features), memory)

    def log_density(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        parent: Tensor,
        w: Tensor,
    ) -> Tensor:
        """Compute log q(w | parent), the objective of inference compilation.

        The density is that of the network, without the defensive fraction. The parent is appended to
        the particles with weight 0, which gives it the features of a particle.

        Args:
            model: State-space model.
            belief: Belief before the step.
            record: Record of the step.
            parent: Parents, [R, D].
            w: Noises, [R, W].

        Returns:
            Log density, [R].
        """
        xi = ((w - model.noise.mean) / model.noise.stddev).unsqueeze(1)
        joined = append_states(belief, parent.unsqueeze(1))
        if self.network is None:
            self.build(model, joined, record)
        features, _ = self._features(model, joined, record)
        assert self.network is not None
        zeta, log_det = xi, torch.zeros_like(xi[:, 0, :1])
        if self.guide_filter is not None:
            zeta, log_det = to_frame(self.guide_filter, model, belief, record, parent, xi)
        value: Tensor = self.network(features[:, -1:]).log_prob(zeta)
        return value.squeeze(1) - log_det.squeeze(1) - model.noise.stddev.log().sum()

    def _features(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record
    ) -> tuple[Tensor, dict[str, Tensor]]:
        """Compute the network input [R, N, F] and the memory after the step."""
        features = self.features_of(make_feature_context(model, belief, record))
        if self.recurrent is None:
            return features, belief.memory
        w = normalise_log_weights(belief.log_w).unsqueeze(-1)
        before = features.new_zeros(len(features), self.hidden)
        if PAST in belief.memory:
            before = belief.memory[PAST].squeeze(1)
        past: Tensor = self.recurrent((w * features).sum(1), before).unsqueeze(1)
        features = torch.cat([features, past.expand(-1, features.shape[1], -1)], -1)
        return features, belief.memory | {PAST: past}


# --------------------------------------------------------------------------------------------------
# Noise coordinates of a learned proposal: standardised noise, or those of a guide.
#
# The network's noise zeta maps to standardised noise xi = m + U zeta. Without a guide xi = zeta.


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
    """Return the map from noise of the network to standardised noise."""
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

    Returns zeta [R, 1, W] and log |det U| [R, 1]. Shapes: parent [R, D], xi [R, 1, W].
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

    Returns belief with N + M particles. Shapes: states [R, M, D].
    """
    log_w = torch.full_like(states[..., 0], -torch.inf)
    return belief._replace(
        x=torch.cat([belief.x, states], 1), log_w=torch.cat([belief.log_w, log_w], 1)
    )
