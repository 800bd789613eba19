"""Proposals from Gaussian guide filters: one for all particles of a run, or one per particle."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import torch
from torch import Tensor
from torch.distributions import Distribution, MultivariateNormal, Normal
from typing_extensions import override

from pfbench.core.density import StandardNormal, dense_normal, independent_normal
from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require, require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief, ParticleBelief, weighted_mean_cov
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.kalman_update import GaussianStep, kalman_gain_update
from pfbench.filter.linearisation import (
    is_normal,
    linearised_innovation as innovation_at,
    mask_covariance,
    mean_noise,
    unwrap_independent,
)
from pfbench.filter.particle.stages import (
    BootstrapProposal,
    IidPoints,
    PointSet,
    Proposal,
    ProposalSample,
    is_measured,
)
from pfbench.filter.whitening import (
    LOG_2PI,
    compute_half_square,
    fill_missing,
    log_determinant,
    whiten,
)
from pfbench.kernels.dispatch import is_capturing
from pfbench.model.base import ModelWrapper, StateSpaceModel, StaticModel

# --------------------------------------------------------------------------------------------------
# Proposal from one Gaussian guide filter for all particles of a run.
#
# [COFM-AMSSRCPF 2024, Measurement and Control] defines the importance density by "mean and
# variance" of a cubature filter. It does not state whether the filter is one for the particle
# set (here), one for each particle (guided_particles), or one for its noise (guided_noise).


@dataclass(frozen=True)
class SharedGuideProposal(Proposal):
    """Draw all particles from N(x+, P+), the posterior of one guide filter per run.

    The weights are p(y | x) N(x; x-, P-) / N(x; x+, P+). Particles do not have parents, and its
    previous weight is replaced: the ratio includes -log N - log w. As in the Gaussian particle
    filter [Kotecha and Djuric 2003] the prior of each step is a normal distribution. On
    linear-Gaussian models all weights are equal. On other models the evidence is approximate. The
    cost is one guide step per run for any N.

    Attributes:
        guide_filter: Gaussian filter with its adaptations.
        weight_model: Model of the weights. `adapted`: P- and R after all adaptations, so that the
            evidence belongs to the adapted model. `nominal`: the model's R, and P- without
            fading, gain adaptation and adapted Q.
        guide_state: Belief from which the guide continues. `gauss`: its own x+, P+. `moments`: mean and
            covariance of the resampled particles [ours]. Without `match_moments` their covariance
            shrinks step after step if there are many dimensions.
        match_moments: Centre and whiten z of the active particles, so that their mean and covariance
            equal the proposal's exactly.
        covariance_factor: Factor on the proposal covariance.
        points: Source of z.

    Raises:
        ValueError: If `weight_model` or `guide_state` is unknown, or the factor is not positive. At the first
            step, if there are too few particles to match, or R is adapted although the
            measurement distribution is not normal.
    """

    guide_filter: GaussianFilter
    weight_model: Literal["adapted", "nominal"] = "adapted"
    guide_state: Literal["gauss", "moments"] = "gauss"
    match_moments: bool = False
    covariance_factor: float = 1.0
    points: PointSet = field(default_factory=IidPoints)
    is_exact = False

    @property
    def has_evidence(self) -> bool:
        """True unless the weights use an R or P- that depends on the measurement of the step."""
        return self.weight_model == "nominal" or self.guide_filter.has_evidence

    def __post_init__(self) -> None:
        options = {"weight_model": ("adapted", "nominal"), "guide_state": ("gauss", "moments")}
        for key, (first, second) in options.items():
            value = getattr(self, key)
            require(value in (first, second), f"proposal.{key}", f"be {first} or {second}", value)
        require_ranges("proposal", self, covariance_factor=FACTOR_RULE)
        check_normal_guide(self.guide_filter)

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        active = belief.log_w > -torch.inf
        before = self._before(model, belief, record, draws)
        new = self.guide_filter.advance(model, before, record)
        xi_mean, root, _ = kalman_gain_update(new.innovation)
        z = self._normals(model, active, draws)
        xi = xi_mean.unsqueeze(1) + math.sqrt(self.covariance_factor) * (z @ root.mT)
        log_ratio = compute_log_ratio(
            xi, z, log_determinant(root).unsqueeze(-1), self.covariance_factor
        )
        x = model.chart.add(new.prior.unsqueeze(1), xi @ new.prior_root.mT)
        if self.weight_model == "nominal":
            log_ratio = log_ratio + self._nominal_prior_ratio(model, before, new, xi, record)
        elif self.guide_filter.noise_adaptations:
            log_ratio = log_ratio + _adapted_noise_ratio(model, new.innovation, x, record)
        reset = torch.log(active.sum(1, keepdim=True, dtype=xi.dtype)) + torch.where(
            active, belief.log_w, 0.0
        )
        log_ratio = torch.where(
            torch.isfinite(new.log_likelihood).unsqueeze(-1), log_ratio - reset, -torch.inf
        )
        memory = belief.memory | pack_guide_belief(new, (len(x), 1)) | {MEAN: new.mean.unsqueeze(1)}
        if self.guide_state == "moments":  # the next mean comes from the particles
            memory.pop(MEAN)
        return ProposalSample(x, torch.where(active, log_ratio, -torch.inf), memory)

    def _before(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> GaussianBelief:
        """Return the guide belief at t-1, at the first step the initial distribution."""
        if MEAN in belief.memory:
            return unpack_guide_belief(
                belief.memory, belief.memory[MEAN], belief.memory[COVARIANCE]
            )
        if COVARIANCE not in belief.memory:
            return self.guide_filter.init(model, len(belief.x), draws, record.start, record.spread)
        mean, covariance = weighted_mean_cov(model.chart, belief)
        return unpack_guide_belief(belief.memory, mean.unsqueeze(1), covariance.unsqueeze(1))

    def _normals(self, model: StateSpaceModel, active: Tensor, draws: RandomStream) -> Tensor:
        """Draw standard normal numbers z [R, N, d]."""
        slots, d = active.shape[1], model.chart.dimension
        z = self.points(draws).normal("guide", slots, d)
        if not self.match_moments:
            return z
        require(
            not slots <= d,
            "proposal.match_moments",
            f"be false with {d} states and {slots} particles",
            "true",
            f"Use more than {d} particles.",
        )
        equal_weights = active.to(z.dtype) / active.sum(1, keepdim=True)
        z = z - (equal_weights.unsqueeze(-1) * z).sum(1, keepdim=True)
        return whiten(z, torch.linalg.cholesky_ex((equal_weights.unsqueeze(-1) * z).mT @ z)[0])

    def _nominal_prior_ratio(
        self,
        model: StateSpaceModel,
        before: GaussianBelief,
        new: GaussianStep,
        xi: Tensor,
        record: Record,
    ) -> Tensor:
        """Return log N(x; x-, nominal P-) - log N(x; x-, adapted P-) [R, N]."""
        if not (self.guide_filter.noise_adaptations or self.guide_filter.gain_adaptations):
            return torch.zeros_like(xi[..., 0])
        nominal = replace(self.guide_filter, noise_adaptations=(), gain_adaptations=()).advance(
            model, before, record
        )
        log_det_ratio = log_determinant(fill_missing(new.prior_root)) - log_determinant(
            fill_missing(nominal.prior_root)
        )
        return (
            log_det_ratio.unsqueeze(-1)
            + compute_half_square(xi)
            - compute_half_square(whiten(xi @ new.prior_root.mT, nominal.prior_root))
        )


def _adapted_noise_ratio(
    model: StateSpaceModel, innovation: Innovation, x: Tensor, record: Record
) -> Tensor:
    """Return log N(r; 0, adapted R) - log N(r; 0, nominal R), r = y - h(x), [R, N].

    The adapted density omits rejected components.
    """
    masks = innovation.observed_mask, ~torch.isnan(record.y)
    noises = [
        mask_covariance(noise, mask)
        for noise, mask in zip((innovation.noise, innovation.nominal), masks, strict=True)
    ]
    if not is_capturing() and torch.equal(*noises) and torch.equal(*masks):
        return torch.zeros_like(x[..., 0])
    require(
        is_normal(model.observation(x, record.u)),
        "proposal.weight_model",
        "be nominal if the guide adapts R and the measurement distribution is not normal",
        f"adapted with {type(model).__name__}",
        "Choose weight_model=nominal, or a guide that does not adapt R.",
    )
    r, values = innovation_at(model, x, record), []
    for noise, mask in zip(noises, masks, strict=True):
        root, ok = factor(noise)
        value = -compute_half_square(whiten(r * mask.unsqueeze(1), root)) - log_determinant(
            root
        ).unsqueeze(-1)
        values.append(torch.where(ok.unsqueeze(-1), value, torch.nan))
    is_nominal = (noises[0] == noises[1]).all(-1).all(-1) & (masks[0] == masks[1]).all(-1)
    return torch.where(is_nominal.unsqueeze(-1), 0.0, values[0] - values[1])


# --------------------------------------------------------------------------------------------------
# Proposal from one Gaussian filter per particle: the unscented particle filter.


@dataclass(frozen=True)
class ParticleGuideProposal(Proposal):
    """Draw each particle from the posterior of its own Gaussian guide filter.

    Unscented particle filter [van der Merwe et al. 2000]. The covariance P of each particle is
    predicted and updated, x ~ N(x+, P+), and the ratio is p(x | parent) / N(x; x+, P+). P does not
    use the other particles, so the proposal is much wider than p(x | parent, y). In several
    dimensions few particles have weight. `GuidedNoiseProposal` is cheaper and better. The cost is N guide
    steps per run. In a run without measurement particles follow the transition, since N(x+, P+) would leave
    weight to few of them.

    Attributes:
        guide_filter: Gaussian filter. Its adaptations act per particle and on the proposal only.
        covariance_factor: Factor on the proposal covariance.
        points: Source of z.

    Raises:
        ValueError: If the factor is not positive. At the first step, if the transition has no
            density or the chart changes volume (quaternions).
    """

    guide_filter: GaussianFilter
    covariance_factor: float = 1.0
    points: PointSet = field(default_factory=IidPoints)
    is_exact = True

    def __post_init__(self) -> None:
        require_ranges("proposal", self, covariance_factor=FACTOR_RULE)
        check_normal_guide(self.guide_filter)

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        runs, n, _ = belief.x.shape
        free = BootstrapProposal()(model, belief, record, draws)
        if isinstance(model, StaticModel):  # no transition in this step
            return free
        covariance = (
            belief.memory[COVARIANCE]
            if COVARIANCE in belief.memory
            else self._first(model, runs, record, draws)
        )
        before = unpack_guide_belief(belief.memory, belief.x, covariance.expand(-1, n, -1, -1))
        repeated = Record(record.y.repeat_interleave(n, 0), record.u)
        new = self.guide_filter.advance(_ParticlesAsRuns(model, runs, n), before, repeated)
        xi_mean, root, _ = kalman_gain_update(new.innovation)
        z = self.points(draws).normal("guide", n, model.chart.dimension)
        step = math.sqrt(self.covariance_factor) * (root @ z.reshape(runs * n, -1, 1)).squeeze(-1)
        xi = xi_mean + step
        x = model.chart.add(new.prior, (new.prior_root @ xi.unsqueeze(-1)).squeeze(-1)).unflatten(
            0, (runs, n)
        )
        xi, scale = (
            xi.unflatten(0, (runs, n)),
            log_determinant(new.prior_root).unflatten(0, (runs, n)),
        )
        log_q = (
            -compute_log_ratio(
                xi, z, log_determinant(root).unflatten(0, (runs, n)), self.covariance_factor
            )
            - compute_half_square(xi)
            - scale
        )
        log_ratio = _log_transition(model, belief.x, x, record.u) - log_q
        valid_mask = torch.isfinite(new.log_likelihood).unflatten(0, (runs, n))
        measured = is_measured(record).unsqueeze(1)
        return ProposalSample(
            torch.where(measured.unsqueeze(2), x, free.x),
            torch.where(measured, torch.where(valid_mask, log_ratio, -torch.inf), free.log_ratio),
            belief.memory | pack_guide_belief(new, (runs, n)),
        )

    def _first(
        self, model: StateSpaceModel, runs: int, record: Record, draws: RandomStream
    ) -> Tensor:
        """Return the covariance of the initial distribution, one per run [R, 1, d, d]."""
        d = model.chart.dimension
        cost = f"{runs} x N updates of {d} states in every step, N times the cost of SharedGuideProposal"
        warnings.warn(f"ParticleGuideProposal: {cost}", stacklevel=2)
        return self.guide_filter.init(
            model, runs, draws, record.start, record.spread
        ).covariance.unsqueeze(1)


class _ParticlesAsRuns(ModelWrapper):
    """Model view with one run per particle: [R N, P, ...] becomes [R, N P, ...]."""

    def __init__(self, model: StateSpaceModel, runs: int, n: int) -> None:
        super().__init__(model)
        self.runs, self.n = runs, n

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        propagated, points = self.model.propagate(self._joined(x), u, self._joined(w)), x.shape[1]
        return propagated.reshape(self.runs * self.n, points, -1)

    @override
    def noise_gain(self, u: Any) -> Tensor | None:
        gain = self.model.noise_gain(u)
        return None if gain is None else gain.expand(self.runs, -1, -1).repeat_interleave(self.n, 0)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        distribution = self.model.observation(self._joined(x), u)
        mean = distribution.mean.reshape(*x.shape[:2], -1)
        if isinstance(distribution, MultivariateNormal):
            return dense_normal(mean, self._separate(distribution.scale_tril, x.shape[1]))
        normal = unwrap_independent(distribution)
        sd = normal.scale if isinstance(normal, Normal) else distribution.stddev
        return independent_normal(mean, self._separate(sd, x.shape[1]))

    def _separate(self, scale: Tensor, points: int) -> Tensor:
        """Return scales [R, N P, ...] as [R N, P, ...]; one that a run shares is stored once."""
        if scale.stride(1) == 0:
            shape = (self.runs * self.n, points, *scale.shape[2:])
            return scale[:, :1].repeat_interleave(self.n, 0).expand(shape)
        return scale.reshape(self.runs * self.n, points, *scale.shape[2:])

    def _joined(self, a: Tensor) -> Tensor:
        return a.reshape(self.runs, -1, a.shape[-1])


def _log_transition(model: StateSpaceModel, parents: Tensor, x: Tensor, u: Any) -> Tensor:
    """Return log p(x | parent) + d / 2 log 2 pi [R, N]."""
    chart, gain = model.chart, model.noise_gain(u)
    if (
        chart.size == chart.dimension
        and gain is not None
        and gain.shape[-1] == chart.dimension
        and standardise_noise(model.noise)
    ):
        prediction = model.propagate(parents, u, mean_noise(model, parents))
        w = torch.linalg.solve_ex(gain, chart.subtract(x, prediction).mT)[0]
        return -0.5 * (w * w).sum(-2) - torch.linalg.slogdet(gain)[1].unsqueeze(-1)
    distribution = model.transition(parents, u) if chart.flat else None
    if distribution is None:
        raise ValueError(
            "proposal ParticleGuideProposal must have a model with a transition density in the chart, "
            f"got {type(model).__name__}. Choose GuidedNoiseProposal, which works on the noise, or SharedGuideProposal."
        )
    return distribution.log_prob(x) + 0.5 * x.shape[-1] * LOG_2PI


# --------------------------------------------------------------------------------------------------
# Functions shared by the proposals that use a Gaussian guide filter.
#
# These proposals draw whitened coordinates xi = m + U z of a normal prior N(0, I), z ~ N(0, I).
# The ratio log N(xi; 0, I) - log N(xi; m, U U') = (|z|^2 - |xi|^2) / 2 + log |det U| holds in
# any chart and for singular covariances.

MEAN, COVARIANCE, _CARRIED = "guide.mean", "guide.covariance", "guide.carries."


def pack_guide_belief(new: GaussianStep, shape: tuple[int, int]) -> dict[str, Tensor]:
    """Pack the state of the guide filter into the memory of a particle belief.

    Returns memory tensors, [*shape, ...].
    """
    memory = {COVARIANCE: new.root @ new.root.mT} | {
        _CARRIED + name: value for name, value in new.memory.items()
    }
    return {name: value.unflatten(0, shape) for name, value in memory.items()}


def unpack_guide_belief(
    memory: dict[str, Tensor], mean: Tensor, covariance: Tensor
) -> GaussianBelief:
    """Unpack the Gaussian belief of the guide filter from memory.

    Returns gaussian belief with R N or R runs. Shapes: mean [R, N or 1, D], covariance
    [R, N or 1, d, d].
    """
    carried = {
        k.removeprefix(_CARRIED): v.flatten(0, 1)
        for k, v in memory.items()
        if k.startswith(_CARRIED)
    }
    flat = mean.flatten(0, 1)
    return GaussianBelief(flat, covariance.flatten(0, 1), flat.new_zeros(len(flat)), carried)


def compute_log_ratio(xi: Tensor, z: Tensor, log_det: Tensor, widen: float) -> Tensor:
    """Compute log N(xi; 0, I) - log q(xi) for xi = m + sqrt(widen) U z.

    Returns log ratio, [R, N]. Shapes: xi [R, N, d], z [R, N, d], log_det [R, N or 1].
    """
    return (
        compute_half_square(z)
        - compute_half_square(xi)
        + log_det
        + 0.5 * z.shape[-1] * math.log(widen)
    )


def standardise_noise(distribution: Distribution) -> bool:
    """Return whether the distribution is the standard normal one."""
    return isinstance(unwrap_independent(distribution), StandardNormal)


FACTOR_RULE = "(0, inf] Use 1 for no change."
"""Rule of the factor on a guide's covariance."""


def check_normal_guide(guide_filter: object) -> None:
    """Check that a guide filter takes the measurement errors as normal."""
    update = getattr(guide_filter, "measurement_update", None)
    require(
        update is None,
        "proposal.guide_filter.measurement_update",
        "be null in a proposal",
        type(update).__name__,
        "Remove it: the weights contain the distribution.",
    )
