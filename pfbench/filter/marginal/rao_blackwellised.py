"""Rao-Blackwellised particle filter: particles and conditional Kalman filters.

The components of a state are sampled (s) or marginalised (l). Given the path of s, l is normal.
A particle contains the sampled s and the conditional mean of l. A root of the conditional
covariance is stored with it, one for all particles if the model is linear. A step uses the
joint normal distribution of (s', l') given a particle. It draws s' from its marginal and
conditions l' on s'. Then it conditions l' on the measurement, whose density given s' is the
weight.

References:
    Schon, Gustafsson and Nordlund 2005, Marginalized particle filters for mixed
    linear/nonlinear state-space models. Doucet, Godsill and Andrieu 2000.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple, cast

import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal
from typing_extensions import override

from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import (
    ParticleBelief,
    StepInfo,
    compute_once,
    normalise_log_weights,
)
from pfbench.filter.exactness import is_every_part_exact
from pfbench.filter.linearisation import (
    derivative,
    is_normal,
    linearised_innovation,
    linearised_mean,
    mask_covariance,
    mean_noise,
    unwrap_independent,
)
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.stages import (
    BootstrapProposal,
    EssResampler,
    Proposal,
    ProposalSample,
    Resampler,
    Systematic,
    WeightUpdate,
)
from pfbench.filter.whitening import LOG_2PI, condition_on, kalman_update_root, log_determinant
from pfbench.model.base import StateSpaceModel, initial_law


@dataclass(frozen=True)
class MarginalWeightUpdate(WeightUpdate):
    """Previous log weights plus log ratio, which contains the measurement density."""

    is_exact = True

    @override
    def __call__(
        self, model: StateSpaceModel, log_w: Tensor, x: Tensor, log_ratio: Tensor, record: Record
    ) -> Tensor:
        value = log_w + log_ratio
        return torch.where(torch.isnan(value), -torch.inf, value)


@dataclass(frozen=True)
class MarginalisedProposal(Proposal):
    """Draw the sampled part and condition the rest on it and on the measurement.

    The log ratio is the log density of the measurement given the sampled path, to be used with
    `MarginalWeightUpdate`. The states contain sampled values and conditional means. memory["root"] [R, N or 1, l, l]
    is a root of the conditional covariance.

    Attributes:
        split: Partition of the state.
    """

    split: StatePartition
    is_exact = True  # if l is linear and normal given s
    has_bounded_weights = True  # the particles are those of the model

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        if not self.split.linear:
            sample = BootstrapProposal()(model, belief, record, draws)
            return sample._replace(log_ratio=model.log_likelihood(record.y, sample.x, record.u))
        before = belief.memory["root"]
        predicted, noise = predict_with_root(model, belief.x, before, record.u, self.split)
        columns, root = condition_on(noise, self.split.sampled_states, self.split.linear)
        z = draws.normal("noise", belief.x.shape[1], len(columns)).to(belief.x)
        x = model.chart.add(predicted, _combined(columns, z, noise))
        h, r, log_sd = linearise_measurement(model, x, record, self.split)
        shift, root, log_likelihood = kalman_update_root(root, h, r)
        x = model.chart.add(x, embed_components(shift, self.split.linear, model.chart.dimension))
        observed_count = (~torch.isnan(record.y)).sum(-1, dtype=x.dtype).unsqueeze(-1)
        log_likelihood = log_likelihood - log_sd - 0.5 * LOG_2PI * observed_count
        valid_mask = torch.isfinite(root).all(-1).all(-1)  # else weight 0 and the previous root
        memory = {"root": torch.where(valid_mask[..., None, None], root, before)}
        return ProposalSample(x, torch.where(valid_mask, log_likelihood, -torch.inf), memory)


@dataclass(frozen=True)
class RaoBlackwellisedFilter:
    """Particle filter for part of the state, Kalman filters for the rest.

    Transition and measurement are linearised at each particle in l and in noise that is not
    additive. This is exact if the model is linear in them given s, otherwise an extended Kalman
    filter per particle. Process and measurement noise must be normal, and the measurement
    covariance must not depend on l. The reported mean, covariance and scores are those of the mixture,
    including the conditional distributions of l.

    Attributes:
        particles: N.
        sampled_states: Names of groups or states to be sampled. All others are marginalised. None
            samples all components that are not declared `linear_given` the rest. The filter is
            then asymptotically exact, and on a linear model it is the Kalman filter.
        resampler: As for a particle filter.

    Raises:
        ValueError: If there are fewer than two particles. On use, if the model does not have a
            name, declares nothing linear while no name is set, or has noise that is not normal.
    """

    particles: int
    sampled_states: Sequence[str] | None = None
    resampler: Resampler = field(default_factory=lambda: EssResampler(Systematic()))

    def __post_init__(self) -> None:
        require_ranges("filter", self, particles="[2, inf]")

    @property
    def is_exact(self) -> bool:
        """True if the particles target p(x_t | y_1:t) as N grows.

        This is not claimed for components that are selected by name.
        """
        return is_every_part_exact(self, resampler=self.resampler) and self.sampled_states is None

    @property
    def has_bounded_weights(self) -> bool:
        """True: the sampled part is drawn from the model."""
        return True

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief:
        """Draw the sampled part, with the rest at its conditional mean, equal weights.

        Args:
            model: State-space model.
            runs: Number of runs.
            draws: Random numbers of the initial step.
            start: States about which the distribution is centred, [R, D]. None takes the origin.
            spread: Cholesky factors of the initial covariance, [R, d, d]. None takes the model's.
        """
        split = partition_state(model, self.sampled_states)
        cloud = ParticleFilter(self.particles).init(model, runs, draws, start, spread)
        if not split.linear:
            return cloud
        check_normal(model, "the driving noise", model.noise)
        distribution: Any = initial_law(model, runs, spread)
        root = (
            distribution.scale_tril
            if isinstance(distribution, MultivariateNormal)
            else torch.diag_embed(distribution.stddev)
        )
        columns, root = condition_on(root.unsqueeze(1), split.sampled_states, split.linear)
        z = draws.normal("initial", self.particles, len(columns)).to(cloud.x)
        origin = model.origin.expand(runs, -1) if start is None else start
        shift = distribution.mean.unsqueeze(1) + _combined(
            columns, z, distribution.mean.unsqueeze(1).unsqueeze(-1)
        )
        x = model.chart.add(origin.unsqueeze(1), shift)
        roots = 1 if split.is_common else self.particles
        return cloud._replace(x=x, memory={"root": root.expand(-1, roots, -1, -1)})

    def step(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief, StepInfo]:
        """Advance the belief from t-1 to t.

        Args:
            model: State-space model.
            belief: Belief at t-1.
            record: Record of step t.
            draws: Random numbers of step t.
        """
        split = partition_state(model, self.sampled_states)
        inner = ParticleFilter(
            self.particles,
            self.resampler,
            proposal=MarginalisedProposal(split),
            weight_update=MarginalWeightUpdate(),
        )
        cloud, info = inner.step(model, belief, record, draws)
        info = info._replace(nis=None)  # the log ratio already contains the measurement
        return cloud, _with_conditional(info, cloud, split, draws) if split.linear else info


def _combined(columns: list[Tensor], z: Tensor, template: Tensor) -> Tensor:
    """Compute sum_j L_j z_j [R, N, d], zeros without columns."""
    shift = template.new_zeros(*z.shape[:2], template.shape[-2])
    for j, column in enumerate(columns):
        shift = shift + column * z[..., j : j + 1]
    return shift


def _with_conditional(
    info: StepInfo, belief: ParticleBelief, split: StatePartition, draws: RandomStream
) -> StepInfo:
    """Add the mean conditional covariance of l to the covariance of the particles, and a draw of l to each of them."""
    root, w = belief.memory["root"], normalise_log_weights(belief.log_w)
    conditional_variance = root.square().sum(-1)  # [R, N or 1, l]
    mean = (
        conditional_variance[:, 0]
        if conditional_variance.shape[1] == 1
        else (w.unsqueeze(-2) @ conditional_variance).squeeze(-2)
    )
    embed = partial(embed_components, indices=split.linear, d=info.variance.shape[-1])

    def covariance() -> Tensor:
        shared = root.shape[1] == 1
        p = root[:, 0] @ root[:, 0].mT if shared else (w[..., None, None] * (root @ root.mT)).sum(1)
        return info.covariance() + embed(embed(p.mT).mT)

    @compute_once
    def conditional() -> tuple[Tensor, Tensor]:
        z = draws.normal("conditional", w.shape[1], len(split.linear)).to(root)
        return embed(conditional_variance.sqrt()), embed((root @ z.unsqueeze(-1)).squeeze(-1))

    def cloud() -> tuple[Tensor, Tensor]:
        deviation, log_w = cast(Any, info.cloud)()
        return deviation + conditional()[1], log_w

    return info._replace(
        variance=info.variance + embed(mean),
        covariance=covariance,
        cloud=cloud,
        group_covariance=None,
        conditional=conditional,
    )


# --------------------------------------------------------------------------------------------------
# Partition of the state, and linearisation of its conditionally normal part.


class StatePartition(NamedTuple):
    """Partition of the components of a state difference, in the chart.

    Attributes:
        sampled_states: Components s.
        linear: Components l.
        is_common: All particles have the same covariance of l.
    """

    sampled_states: list[int]
    linear: list[int]
    is_common: bool


def partition_state(model: StateSpaceModel, sampled: Sequence[str] | None) -> StatePartition:
    """Return the partition by names, or by the model's declaration."""
    d = len(model.names)
    if sampled is None:
        linear = list(range(d)) if model.linear else sorted(model.linear_given)
        require(
            linear,
            "filter.sampled_states",
            "be names for a model with no component that is linear given the rest",
            f"null with {type(model).__name__}",
            f"Choose groups of {sorted(model.groups)} (filter=sir samples all). The rest is linearised.",
        )
        return StatePartition([i for i in range(d) if i not in linear], linear, model.linear)
    unknown = [name for name in sampled if name not in model.groups and name not in model.names]
    require(
        not unknown,
        "filter.sampled_states",
        f"be groups {sorted(model.groups)} or states {list(model.names)} of {type(model).__name__}",
        unknown,
        "Correct the names.",
    )
    selected: set[int] = set()
    for name in sampled:
        selected |= set(model.groups[name]) if name in model.groups else {model.names.index(name)}
    return StatePartition(
        sorted(selected), [i for i in range(d) if i not in selected], model.linear
    )


def predict_with_root(
    model: StateSpaceModel, x: Tensor, root: Tensor, u: Any, split: StatePartition
) -> tuple[Tensor, Tensor]:
    """Predict particles without noise and linearise about the prediction.

    Returns prediction [R, N, D] and root A [R, N or 1, d, m] of the joint normal distribution.
    Shapes: x [R, N, D], root [R, N or 1, l, l].
    """
    chart, noise, gain = model.chart, model.noise, model.noise_gain(u)
    d, w = len(split.linear), 0 if gain is not None else model.noise_dim
    predicted = model.propagate(x, u, mean_noise(model, x))

    def propagate(at: Tensor, xi: Tensor) -> Tensor:
        driven = mean_noise(model, xi)
        if w:
            driven = driven + noise.stddev * xi[..., d:]
        start = chart.add(at, embed_components(xi[..., :d], split.linear, chart.dimension))
        return model.propagate(start, u, driven)

    centre = model.origin.expand(len(x), 1, -1) if split.is_common else x
    slopes = derivative(propagate, centre, d + w, chart.subtract)
    if gain is not None:
        scaled_gain = (gain * noise.stddev).unsqueeze(1)
        slopes = torch.cat([slopes, scaled_gain.expand(*slopes.shape[:2], -1, -1)], -1)
    state_root, noise_root = slopes[..., :d] @ root, slopes[..., d:]
    return predicted, torch.cat([state_root, noise_root.expand(*state_root.shape[:2], -1, -1)], -1)


def linearise_measurement(
    model: StateSpaceModel, x: Tensor, record: Record, split: StatePartition
) -> tuple[Tensor, Tensor, Tensor]:
    """Linearise the measurement in l, in units of the measurement noise.

    Returns h [R, N or 1, k, l] and y - y_hat [R, N, k], 0 if unobserved, and log scale [R, N].
    Shapes: x [R, N, D].
    """
    distribution: Any = model.observation(x, record.u)
    check_normal(model, "the measurement's noise", distribution)

    def predict(at: Tensor, xi: Tensor) -> Tensor:
        return linearised_mean(
            model.observation(
                model.chart.add(at, embed_components(xi, split.linear, model.chart.dimension)),
                record.u,
            )
        )

    centre = model.origin.expand(len(x), 1, -1) if split.is_common else x
    h = derivative(predict, centre, len(split.linear), model.residual)
    observed_mask = ~torch.isnan(record.y).unsqueeze(1)
    h = torch.where(observed_mask.unsqueeze(-1), h, 0.0)
    r = linearised_innovation(model, x, record)
    if not isinstance(distribution, MultivariateNormal):
        sd = torch.where(observed_mask, distribution.stddev, 1.0)
        return h / (sd[:, :1] if split.is_common else sd).unsqueeze(-1), r / sd, sd.log().sum(-1)
    covariance = (
        distribution.covariance_matrix[:, :1] if split.is_common else distribution.covariance_matrix
    )
    root, ok = factor(mask_covariance(covariance, observed_mask))
    log_sd = torch.where(ok, log_determinant(root), torch.nan)
    white = torch.linalg.solve_triangular(root, h, upper=False)
    return (
        white,
        torch.linalg.solve_triangular(root, r.unsqueeze(-1), upper=False).squeeze(-1),
        log_sd,
    )


def embed_components(values: Tensor, indices: list[int], d: int) -> Tensor:
    """Embed components in a state difference, with 0 for all others.

    Returns difference, [..., d]. Shapes: values [..., l].
    """
    return values @ torch.eye(d, dtype=values.dtype, device=values.device)[indices]


def check_normal(model: StateSpaceModel, label: str, distribution: Distribution) -> None:
    """Check that a noise distribution is normal."""
    require(
        is_normal(distribution),
        "filter RaoBlackwellisedFilter",
        f"have a model where {label} is normal",
        f"{type(unwrap_independent(distribution)).__name__} in {type(model).__name__}",
        "Sample all states (filter=sir), or choose normal noise.",
    )
