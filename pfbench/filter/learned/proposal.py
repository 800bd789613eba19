"""Learned proposal: a network parametrises the noise distribution of a step.

The network is any nn.Module that maps features [R, N, F] to a distribution with batch [R, N]
and event [W]. The ratio p(w) / q(w) is computed here for any network output, so a learned
proposal does not change the target of the filter. Insufficient training only lowers the
effective sample size. `networks` contains networks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

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
from pfbench.filter.learned.networks import CheckpointSpec, build_networks
from pfbench.filter.linearisation import mean_noise
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


# --------------------------------------------------------------------------------------------------
# Features of a learned proposal, scaled to about one by the model's own scales.
#
# All features are in standard deviations. States are scaled by the initial distribution or by
# the particles, measurements by their noise or by their predicted distribution. Networks
# therefore need no data statistics, and a network trained on wide beliefs also applies to
# narrow ones.

_LOG_SCALE = 4.0  # divides logarithms: a factor of 1e5 becomes about 3
_MIN_SD = 1e-6  # lower limit of the particles' standard deviation, in initial standard deviations


class FeatureContext(NamedTuple):
    """Quantities of a step before its noise is drawn, computed once for all features.

    Attributes:
        model: State-space model.
        belief: Belief at t-1.
        record: Record of step t.
        start: Centre of the initial distribution, [R or 1, 1, D].
        scale: Standard deviations of the initial distribution, [R or 1, 1, d].
        mean: Mean of the particles at t-1, [R, 1, D].
        sd: Standard deviations of the particles at t-1, [R, 1, d].
        r: y - y_hat of each particle's noise-free child, 0 where unobserved, [R, N, k].
        noise_sd: Measurement noise of that child, [R, N, k].
        expected_sd: Standard deviation of the predicted measurement, [R, 1, k].
        observed_mask: Mask of observed components, [R, 1, k].
    """

    model: StateSpaceModel
    belief: ParticleBelief
    record: Record
    start: Tensor
    scale: Tensor
    mean: Tensor
    sd: Tensor
    r: Tensor
    noise_sd: Tensor
    expected_sd: Tensor
    observed_mask: Tensor


def make_feature_context(
    model: StateSpaceModel, belief: ParticleBelief, record: Record
) -> FeatureContext:
    """Compute the quantities of the next step."""
    x, w = belief.x, normalise_log_weights(belief.log_w).unsqueeze(-1)
    start = (model.origin.expand(1, -1) if record.start is None else record.start).unsqueeze(1)
    if record.spread is None:
        initial: Any = model.initial(1)
        scale = initial.stddev.unsqueeze(1)
    else:
        scale = record.spread.norm(dim=-1).unsqueeze(1)
    mean = model.chart.mean(x, w.squeeze(-1)).unsqueeze(1)
    deviations = model.chart.subtract(x, mean)
    sd = torch.sqrt((w * deviations.square()).sum(1, keepdim=True) + (_MIN_SD * scale).square())
    distribution: Any = model.observation(
        model.propagate(x, record.u, mean_noise(model, x)), record.u
    )
    observed_mask = ~torch.isnan(record.y).unsqueeze(1)
    r = torch.where(
        observed_mask, model.residual(record.y.nan_to_num().unsqueeze(1), distribution.mean), 0.0
    )
    noise_sd = torch.nan_to_num(distribution.stddev, 1.0, 1e6).expand_as(r)
    centre = (w * r).sum(1, keepdim=True)
    mean_noise_variance = (w * noise_sd.square()).sum(1, keepdim=True)
    expected_sd = torch.sqrt((w * (r - centre).square()).sum(1, keepdim=True) + mean_noise_variance)
    return FeatureContext(
        model, belief, record, start, scale, mean, sd, r, noise_sd, expected_sd, observed_mask
    )


class Feature(Protocol):
    """Input of a network, scaled to about one."""

    def __call__(self, context: FeatureContext) -> Tensor:
        """Compute the numbers [R, N or 1, k] in the context of the step."""


@dataclass(frozen=True)
class InnovationFeature(Feature):
    """Innovation of each noise-free child, 4 k numbers.

    In noise standard deviations (asinh) and in predicted ones, the logarithm of their ratio, and
    the mask of observed components.
    """

    @override
    def __call__(self, context: FeatureContext) -> Tensor:
        in_noise_sd = torch.asinh(context.r / context.noise_sd)
        in_predicted_sd = context.r / context.expected_sd
        log_sd_ratio = torch.log(context.expected_sd / context.noise_sd) / _LOG_SCALE
        mask = context.observed_mask.to(in_noise_sd).expand_as(in_noise_sd)
        return torch.cat([in_noise_sd, in_predicted_sd, log_sd_ratio, mask], -1)


@dataclass(frozen=True)
class ParentFeature(Feature):
    """State of each particle, 2 d numbers.

    Relative to the mean in standard deviations of the particles, and (asinh) relative to the start
    in those of the initial distribution.
    """

    @override
    def __call__(self, context: FeatureContext) -> Tensor:
        chart, x = context.model.chart, context.belief.x
        from_mean = chart.subtract(x, context.mean) / context.sd
        from_start = chart.subtract(x, context.start) / context.scale
        return torch.cat([from_mean, torch.asinh(from_start)], -1)


@dataclass(frozen=True)
class SpreadFeature(Feature):
    """Log ratio of the particles' standard deviations to the initial ones, d numbers."""

    @override
    def __call__(self, context: FeatureContext) -> Tensor:
        return torch.log(context.sd / context.scale) / _LOG_SCALE


@dataclass(frozen=True)
class FeatureStack(Feature):
    """All features [R, N, F], limited to +-`feature_limit`, with 0 for non-finite values.

    Attributes:
        features: Features.
        feature_limit: Limit of each number, so that outlying particles stay within the training
            range.
    """

    features: Sequence[Feature] = field(
        default_factory=lambda: (InnovationFeature(), ParentFeature(), SpreadFeature())
    )
    feature_limit: float = 10.0

    @override
    def __call__(self, context: FeatureContext) -> Tensor:
        shape = context.belief.x.shape[:2]
        features = torch.cat([feature(context).expand(*shape, -1) for feature in self.features], -1)
        return torch.nan_to_num(features, 0.0, self.feature_limit, -self.feature_limit).clamp(
            -self.feature_limit, self.feature_limit
        )
