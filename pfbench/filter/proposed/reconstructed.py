"""State reconstruction: shift of particles by Dynamic Matrix Control (DMC), and corrections of their weights."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import factor
from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.exactness import has_bounded_weights, is_every_part_exact
from pfbench.filter.linearisation import (
    batch_product,
    derivative,
    is_normal,
    linearised_innovation,
    linearised_mean,
    mask_covariance,
    mean_noise,
    measurement_jacobian,
)
from pfbench.filter.particle.proposals import AffineMap
from pfbench.filter.particle.stages import BootstrapProposal, Proposal, ProposalSample
from pfbench.filter.proposed.dmc_controller import (
    DmcController,
    keep_selected,
    predict_without_noise,
    replace_invalid,
    select_defensive,
    state_indices,
)
from pfbench.filter.whitening import compute_half_square, whitening_basis
from pfbench.model.base import StateSpaceModel, StaticModel

# As printed the weights do not include the shift. The filter is then exact for another model, in
# which the data count twice [particle filter with state reconstruction by Dynamic Matrix Control;
# Akyildiz and Miguez 2020]. The corrections are [ours].


class WeightCorrection(Protocol):
    """Shift of the particles of a base proposal, and correction of their weights."""

    @property
    def is_exact(self) -> bool:
        """True if the weighted particles are asymptotically exact."""

    @property
    def has_bounded_weights(self) -> bool:
        """True if the correction has a bound for any model. Silence counts as False."""
        return False

    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        sample: ProposalSample,
        control: DmcController,
        draws: RandomStream,
    ) -> ProposalSample:
        """Reconstruct particles.

        Args:
            model: State-space model of the step.
            belief: Belief before the step.
            record: Record of the step.
            sample: Sample of the base proposal.
            control: Controller that determines the shift.
            draws: Random stream of the step.

        Returns:
            Shifted particles and their density ratio.
        """


@dataclass(frozen=True)
class NoWeightCorrection(WeightCorrection):
    """x~ + K (y - h(x~)) without a change of weights, as printed.

    It does not converge to the posterior.

    Attributes:
        linearise_per_particle: Linearise the measurement at each particle. False linearises once at
            their mean, which costs less and is equal for linear measurements.
        regressed_states: Names of states that follow the shift of all others by regression [ours].
            None as printed. For the azimuth the regression increases the error.
    """

    linearise_per_particle: bool = True
    regressed_states: Sequence[str] = ()
    is_exact = False
    has_bounded_weights = True  # without a ratio

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        sample: ProposalSample,
        control: DmcController,
        draws: RandomStream,
    ) -> ProposalSample:
        x, log_ratio = replace_invalid(sample, belief)
        w = normalise_log_weights(belief.log_w + log_ratio)
        centre = x if self.linearise_per_particle else model.chart.mean(x, w).unsqueeze(1)
        h = measurement_jacobian(model, centre, record)
        gain = control.compute_gain(model, belief, record, h)
        shift = batch_product(gain, linearised_innovation(model, x, record))
        if self.regressed_states:
            key = "weight_correction.regressed_states"
            regressed = state_indices(model, key, self.regressed_states)
            shift = _regress_shift(model, x, w, shift, regressed)
        return ProposalSample(model.chart.add(x, shift), log_ratio, sample.memory)


@dataclass(frozen=True)
class TransitionRatioCorrection(WeightCorrection):
    """Ratio of transition densities after and before the shift [ours].

    For additive normal noise. The shift of x = f (+) xi, with f the noise-free prediction of each parent,
    is xi -> xi + K (y - h(f) - H xi). It is affine, so its Jacobian is known also for a nonlinear
    measurement. A singular transition has a density on the span of its noise, and the shift is
    projected on that span. Exact, but useful only with wide noise. Increase the model's noise for
    all filters of a comparison, rather than for this one.

    Attributes:
        defensive_fraction: Fraction c that is not shifted. Weights are then at most 1/c times the
            likelihood. With 0 they are unbounded, or a shift may leave out a part of the noise.
        linearise_per_particle: As for `NoWeightCorrection`, but at the noise-free predictions.

    Raises:
        ValueError: At the first step, if the model's noise is not additive or not normal.
    """

    defensive_fraction: float = 0.1
    linearise_per_particle: bool = True

    @property
    @override
    def is_exact(self) -> bool:
        return self.defensive_fraction > 0.0

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return self.defensive_fraction > 0.0

    def __post_init__(self) -> None:
        require_ranges("weight_correction", self, defensive_fraction="[0, 1]")

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        sample: ProposalSample,
        control: DmcController,
        draws: RandomStream,
    ) -> ProposalSample:
        if isinstance(model, StaticModel):  # no transition in this step
            return sample
        chart, noise_gain = model.chart, model.noise_gain(record.u)
        if noise_gain is None or not is_normal(model.noise):
            raise ValueError(
                "proposal.weight_correction TransitionRatioCorrection must have a model with "
                f"additive noise that is normal, got {type(model).__name__}. "
                "Choose MarginalRatioCorrection or ReconstructedNoiseProposal."
            )
        prediction, w = predict_without_noise(model, belief, record)
        centre = prediction
        if not self.linearise_per_particle:
            centre = chart.mean(prediction, w).unsqueeze(1)
        x, log_ratio = replace_invalid(sample, belief)
        scaled_gain = noise_gain * model.noise.stddev
        whiten, colour = whitening_basis(scaled_gain @ scaled_gain.mT)
        h = measurement_jacobian(model, centre, record)
        whitened_gain = whiten.unsqueeze(1) @ control.compute_gain(model, belief, record, h)
        affine = AffineMap(
            _identity_minus(whitened_gain @ h @ colour.unsqueeze(1)),
            batch_product(whitened_gain, linearised_innovation(model, prediction, record)),
        )
        xi = chart.subtract(x, prediction)
        a = xi @ whiten.mT
        defensive = select_defensive(self.defensive_fraction, belief.log_w + log_ratio, draws)
        new, ratio = affine.apply(a, defensive, lambda e: -compute_half_square(e))
        shifted = chart.add(prediction, xi + (new - a) @ colour.mT)
        x = keep_selected(defensive, x, shifted)
        return ProposalSample(x, log_ratio + ratio, sample.memory)


@dataclass(frozen=True)
class MarginalRatioCorrection(WeightCorrection):
    """Defensive mixture with the ratio of fitted normal distributions [ours].

    About the predicted mean, o = H xi. The shift o -> o + H K (y - y_hat - o) moves all components
    of the state by their regression on o, which leaves the residual unchanged. The log weights are

        log p(y | x) + log p(o') - log(c p(o') + (1 - c) q(o')),

    with c the defensive fraction, p the normal distribution fitted to o, and q that of the shifted
    particles. Correct if the predicted distribution is normal, as on linear-Gaussian models,
    otherwise approximate. A shift to a direction without variance has weight 0, and no weight
    exceeds 1/c times the likelihood.

    Attributes:
        defensive_fraction: Fraction that is not shifted. These particles are chosen at random in
            each step, since neighbours are siblings after resampling. 1 gives the base proposal.
    """

    defensive_fraction: float = 0.5
    is_exact = False

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return self.defensive_fraction > 0.0

    def __post_init__(self) -> None:
        require_ranges("weight_correction", self, defensive_fraction="[0, 1]")

    @override
    def __call__(
        self,
        model: StateSpaceModel,
        belief: ParticleBelief,
        record: Record,
        sample: ProposalSample,
        control: DmcController,
        draws: RandomStream,
    ) -> ProposalSample:
        x, log_ratio = replace_invalid(sample, belief)
        w = normalise_log_weights(belief.log_w + log_ratio)
        centre = model.chart.mean(x, w).unsqueeze(1)
        xi, h = model.chart.subtract(x, centre), measurement_jacobian(model, centre, record)
        deviation_y = batch_product(h, xi)  # o
        weighted_y = w.unsqueeze(-1) * deviation_y
        whiten, colour = whitening_basis(weighted_y.mT @ deviation_y)
        gain = control.compute_gain(model, belief, record, h)[:, 0]
        whitened_gain = whiten @ h[:, 0] @ gain  # [R, Dy, Dy]
        affine = AffineMap(
            _identity_minus(whitened_gain @ colour).unsqueeze(1),
            linearised_innovation(model, centre, record) @ whitened_gain.mT,
        )
        a = deviation_y @ whiten.mT
        defensive = select_defensive(self.defensive_fraction, belief.log_w + log_ratio, draws)
        new, ratio = affine.apply(a, defensive, lambda e: -compute_half_square(e))
        shift = (new - a) @ (whiten @ weighted_y.mT @ xi)
        x = keep_selected(defensive, x, model.chart.add(x, shift))
        return ProposalSample(x, log_ratio + ratio, sample.memory)


def _regress_shift(
    model: StateSpaceModel, x: Tensor, w: Tensor, shift: Tensor, regressed: list[int]
) -> Tensor:
    """Replace the shift [R, N, d] of some states by their regression on the others."""
    d = model.chart.subtract(x, model.chart.mean(x, w).unsqueeze(1))
    covariance = (w.unsqueeze(-1) * d).mT @ d
    others = [i for i in range(d.shape[-1]) if i not in regressed]
    whiten, _ = whitening_basis(covariance[:, others][:, :, others])
    regression = whiten.mT @ whiten @ covariance[:, others][:, :, regressed]
    predicted_shift = shift[..., others] @ regression
    return shift.index_copy(-1, torch.tensor(regressed, device=shift.device), predicted_shift)


def _identity_minus(a: Tensor) -> Tensor:
    """Return I - a."""
    return torch.eye(a.shape[-1], dtype=a.dtype, device=a.device) - a


# The states are outputs of a plant with inputs [particle filter with state reconstruction by Dynamic
# Matrix Control, eqs 21 to 28]. The inputs are those of the state (`ReconstructedProposal`) or the
# process noise (`ReconstructedNoiseProposal`).


_SHIFT = "reconstruction.shift"  # in the memory of particles: B dU of the step before, [R, N, d]


@dataclass(frozen=True)
class ReconstructedProposal(Proposal):
    """Particles of `base`, shifted by a DMC controller.

    Attributes:
        base: Proposal of the particles.
        controller: Controller that determines the shift.
        weight_correction: Correction of the weights. Uncorrected is as printed.
        repeats_shift: Add the shift of the step before to the prediction too, the "+ B U" of step V
            as printed. The shift then counts twice.
    """

    base: Proposal = field(default_factory=BootstrapProposal)
    controller: DmcController = field(default_factory=DmcController)
    weight_correction: WeightCorrection = field(default_factory=MarginalRatioCorrection)
    repeats_shift: bool = False

    @property
    @override
    def is_exact(self) -> bool:
        return not self.repeats_shift and is_every_part_exact(
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
        if not self.repeats_shift:
            return self.weight_correction(model, belief, record, sample, self.controller, draws)
        chart, shift = model.chart, belief.memory.get(_SHIFT)
        if shift is not None:
            sample = sample._replace(x=chart.add(sample.x, shift))
        shifted = self.weight_correction(model, belief, record, sample, self.controller, draws)
        new_shift = {_SHIFT: chart.subtract(shifted.x, sample.x).nan_to_num()}
        return shifted._replace(memory=shifted.memory | new_shift)


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
        require_ranges("proposal", self, defensive_fraction="[0, 1]")

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
