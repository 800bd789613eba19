"""Proposal from one Gaussian guide filter for all particles of a run.

[COFM-AMSSRCPF 2024, Measurement and Control] defines the importance density by "mean and
variance" of a cubature filter. It does not state whether the filter is one for the particle
set (here), one for each particle (guided_particles), or one for its noise (guided_noise).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import factor
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief, ParticleBelief, weighted_mean_cov
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.gaussian.innovation import Innovation
from pfbench.filter.gaussian.kalman_update import GaussianStep, kalman_gain_update
from pfbench.filter.guided.guide_memory import (
    COVARIANCE,
    MEAN,
    check_covariance_factor,
    check_normal_guide,
    compute_log_ratio,
    pack_guide_belief,
    unpack_guide_belief,
)
from pfbench.filter.linearisation import (
    is_normal,
    linearised_innovation as innovation_at,
    mask_covariance,
)
from pfbench.filter.particle.point_sets import IidPoints, PointSet
from pfbench.filter.particle.proposals import Proposal, ProposalSample
from pfbench.filter.whitening import compute_half_square, fill_missing, log_determinant, whiten
from pfbench.model.base import StateSpaceModel


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
            if value not in (first, second):
                raise ValueError(
                    f"proposal.{key} must be {first} or {second}, got {value}. Choose one."
                )
        check_covariance_factor(self.covariance_factor)
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
        if slots <= d:
            raise ValueError(
                f"proposal.match_moments must be false with {d} states and {slots} particles, got true. "
                f"Use more than {d} particles."
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
    if torch.equal(*noises) and torch.equal(*masks):
        return torch.zeros_like(x[..., 0])
    if not is_normal(model.observation(x, record.u)):
        raise ValueError(
            "proposal.weight_model must be nominal if the guide adapts R and the measurement "
            f"distribution is not normal, got adapted with {type(model).__name__}. "
            "Choose weight_model=nominal, or a guide that does not adapt R."
        )
    r, values = innovation_at(model, x, record), []
    for noise, mask in zip(noises, masks, strict=True):
        root, ok = factor(noise)
        value = -compute_half_square(whiten(r * mask.unsqueeze(1), root)) - log_determinant(
            root
        ).unsqueeze(-1)
        values.append(torch.where(ok.unsqueeze(-1), value, torch.nan))
    return values[0] - values[1]
