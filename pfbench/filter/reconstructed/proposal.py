"""State reconstruction: shift of particles by Dynamic Matrix Control (DMC).

The states are outputs of a plant with inputs [particle filter with state reconstruction by Dynamic
Matrix Control, eqs 21 to 28]. The inputs are those of the state (`ReconstructedProposal`) or the
process noise (`ReconstructedNoiseProposal`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.covariance import factor
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.defensive_mixture import AffineMap, check_fraction
from pfbench.filter.exactness import has_bounded_weights, is_every_part_exact
from pfbench.filter.linearisation import (
    batch_product,
    derivative,
    linearised_innovation,
    linearised_mean,
    mask_covariance,
    mean_noise,
    measurement_jacobian,
)
from pfbench.filter.particle.proposals import BootstrapProposal, Proposal, ProposalSample
from pfbench.filter.reconstructed.defensive_shift import (
    keep_selected,
    predict_without_noise,
    replace_invalid,
    select_defensive,
)
from pfbench.filter.reconstructed.dmc_controller import DmcController
from pfbench.filter.reconstructed.weight_correction import MarginalRatioCorrection, WeightCorrection
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class ReconstructedProposal(Proposal):
    """Particles of `base`, shifted by a DMC controller.

    Attributes:
        base: Proposal of the particles.
        controller: Controller that determines the shift.
        weight_correction: Correction of the weights. Uncorrected is as printed.
    """

    base: Proposal = field(default_factory=BootstrapProposal)
    controller: DmcController = field(default_factory=DmcController)
    weight_correction: WeightCorrection = field(default_factory=MarginalRatioCorrection)

    @property
    @override
    def is_exact(self) -> bool:
        return is_every_part_exact(
            **{"proposal.base": self.base, "proposal.correction": self.weight_correction}
        )

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return all(map(has_bounded_weights, (self.base, self.weight_correction)))

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        sample = self.base(model, belief, record, draws)
        return self.weight_correction(model, belief, record, sample, self.controller, draws)


@dataclass(frozen=True)
class ReconstructedNoiseProposal(Proposal):
    """DMC with the process noise as input, which is a Kalman update of the noise w.

    B is the noise gain, and the weights are Q = R_v^-1 and R = 1. The transition may be singular,
    and the result is asymptotically exact for any model. The measurement is linearised at each
    parent's noise-free prediction, A = d y_hat / d w and P = (1 + A' R_v^-1 A)^-1. The ratio of
    w' = P A' R_v^-1 (y - y_hat) + S w is p(w') |S| / p(w).

    Deterministic, S = P: narrower than the posterior. If A A' exceeds R_v, the variance of the
    weights is infinite unless `defensive_fraction` is positive. Stochastic, S S' = P: the optimal
    proposal if the measurement is linear [Doucet et al. 2000]. If it is not, the weights have no
    bound without a defensive fraction, either.

    Attributes:
        base: Source of the noise.
        sample_noise: Draw from the posterior of the noise. False shifts deterministically.
        defensive_fraction: Fraction c that is not shifted, which bounds the ratio by 1 / c. With 0
            it is unbounded, and noise of bounded support is not covered.
        linearise_per_particle: Linearise at each parent's prediction. False linearises once, at
            their mean.

    Raises:
        ValueError: At the first step, if the base does not return its noise.
    """

    base: Proposal = field(default_factory=BootstrapProposal)
    sample_noise: bool = True
    defensive_fraction: float = 0.1
    linearise_per_particle: bool = True

    def __post_init__(self) -> None:
        check_fraction("proposal.defensive_fraction", self.defensive_fraction)

    @property
    @override
    def is_exact(self) -> bool:
        exact_base = is_every_part_exact(**{"proposal.base": self.base})
        return exact_base and self.defensive_fraction > 0.0

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return self.defensive_fraction > 0.0 and bool(has_bounded_weights(self.base))

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        sample, noise = self.base(model, belief, record, draws), model.noise
        if sample.w is None:
            raise ValueError(
                "proposal.base must return its noise, got "
                f"{type(self.base).__name__}. Choose BootstrapProposal."
            )
        log_w = belief.log_w + replace_invalid(sample, belief)[1]
        defensive = select_defensive(self.defensive_fraction, log_w, draws)

        def scale(xi: Tensor) -> Tensor:
            return noise.mean + noise.stddev * xi

        xi = (sample.w - noise.mean) / noise.stddev
        new, ratio = self._posterior(model, belief, record).apply(
            xi, defensive, lambda xi: noise.log_prob(scale(xi))
        )
        w = keep_selected(defensive, sample.w, scale(new))
        x = model.propagate(belief.x, record.u, w)
        return ProposalSample(x, sample.log_ratio + ratio, sample.memory, w)

    def _posterior(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record
    ) -> AffineMap:
        """Return the map from standardised noise to its posterior given the measurement."""
        chart, noise, gain = model.chart, model.noise, model.noise_gain(record.u)
        prediction, w = predict_without_noise(model, belief, record)
        if gain is not None:
            centre = prediction
            if not self.linearise_per_particle:
                centre = chart.mean(prediction, w).unsqueeze(1)
            a = measurement_jacobian(model, centre, record) @ (gain * noise.stddev).unsqueeze(1)
        else:
            parent = belief.x
            if not self.linearise_per_particle:
                parent = chart.mean(belief.x, w).unsqueeze(1)
            centre = model.propagate(parent, record.u, mean_noise(model, parent))
            a = _noise_jacobian(model, parent, record)
        a, r = _whiten_noise(
            model, centre, record, a, linearised_innovation(model, prediction, record)
        )
        eye = torch.eye(a.shape[-1], dtype=a.dtype, device=a.device)
        root = torch.linalg.cholesky_ex(a.mT @ a + eye)[0]
        covariance_root = torch.linalg.solve_triangular(
            root, eye, upper=False
        ).mT  # its square is P
        covariance = covariance_root @ covariance_root.mT
        offset = batch_product(covariance, batch_product(a.mT, r))
        return AffineMap(covariance_root if self.sample_noise else covariance, offset)


def _noise_jacobian(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Compute the measurement Jacobian for standardised noise [R, P, Dy, W]."""
    noise = model.noise

    def predict(at: Tensor, xi: Tensor) -> Tensor:
        x_next = model.propagate(at, record.u, noise.mean + noise.stddev * xi)
        return linearised_mean(model.observation(x_next, record.u))

    a = derivative(predict, x, model.noise_dim, model.residual)
    return torch.where(torch.isnan(record.y)[:, None, :, None], 0.0, a)


def _whiten_noise(
    model: StateSpaceModel, x: Tensor, record: Record, a: Tensor, r: Tensor
) -> tuple[Tensor, Tensor]:
    """Compute R_v^-1/2 A and R_v^-1/2 r at x. An infinite variance gives zeros."""
    distribution: Any = model.observation(x, record.u)
    if not isinstance(distribution, torch.distributions.MultivariateNormal):
        scale = distribution.variance.rsqrt()
        return scale.unsqueeze(-1) * a, scale * r
    observed_mask = ~torch.isnan(record.y).unsqueeze(1)
    root = factor(mask_covariance(distribution.covariance_matrix, observed_mask))[0]
    whitened_r = batch_product(torch.linalg.inv_ex(root)[0], r)
    return torch.linalg.solve_triangular(root, a, upper=False), whitened_r
