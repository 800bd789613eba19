"""Adaptations of Gaussian filters: fading memory, constrained and matched covariances, bounded gains."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.parameter_checks import require, require_ranges
from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import (
    GainAdaptation,
    Innovation,
    NoiseAdaptation,
    PrincipalAxes,
    axes_by_group,
    compute_group_root,
    diagonal_axes,
    measurement_precision,
    principal_axes,
    whitened_measurement,
)
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation

# The paper [COFM-AMSSRCPF 2024, Measurement and Control] describes its equations in prose only.
# Choices that it leaves open are marked [ours].


@dataclass(frozen=True)
class FadingMemory(NoiseAdaptation):
    """Fading memory: P- = S C_f + Q [Tarn and Zaborszky 1970].

    C_f is the propagated covariance. For a constant state this is weighted least squares with
    weights S^-(k - j), a memory of about 1 / ln S steps.

    Attributes:
        fading_factor: S. Some libraries call S^2 the factor.

    Raises:
        ValueError: If S is below 1.
    """

    fading_factor: float = 1.002
    has_evidence = True

    def __post_init__(self) -> None:
        require_ranges("FadingMemory", self, fading_factor="[1, inf] Use 1 for no fading.")

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        m = scale_columns(predicted.m, math.sqrt(self.fading_factor), 1.0)
        return predicted._replace(
            m=m,
            omega=predicted.omega
            + (self.fading_factor - 1.0) * (predicted.omega - predicted.noise),
        )

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        return innovation, {}


@dataclass(frozen=True)
class ConstrainedNoiseAdaptation(NoiseAdaptation):
    """Scale R by sensor group, and Q, until the innovations fit [ours].

    The paper updates Q, adjusts Q and R "dynamically", and bounds the ratio of error to noise.
    Here the ratios are the eigenvalues lambda of C_zz in units of the nominal R of a group. w is
    the innovation along their axes. E w^2 = r + lambda if the prediction is consistent.

    Axes with lambda < tau contain noise alone and determine r. The other axes show whether the
    prediction is overconfident, in which case q grows. A group without such noise axes keeps its
    r. This is a group with at most as many components as states that it observes.

    Attributes:
        forgetting_factor: Weight of the newest step in the running means.
        deadband: tau.
        max_r_factor: Largest factor on R, at least 1. 1 switches the adaptation of R off.
        max_q_factor: Largest factor on Q, at least 1. 1 switches the adaptation of Q off.
        gate_sigmas: Dead band of q in standard deviations of its running mean.
        decay: Factor on q while the prediction is not overconfident.
        groups: Group number of each component. Each group has one unknown r. None groups
            components of equal nominal variance [ours], which suits ranges and range rates.

    Raises:
        ValueError: If an argument is outside its range.
    """

    forgetting_factor: float = 0.2
    deadband: float = 1e-3
    max_r_factor: float = 100.0
    max_q_factor: float = 1e5
    gate_sigmas: float = 3.0
    decay: float = 0.8
    groups: Sequence[int] | None = None

    def __post_init__(self) -> None:
        require_ranges(
            "ConstrainedNoiseAdaptation",
            self,
            forgetting_factor="(0, 1]",
            decay="(0, 1]",
            max_r_factor="[1, inf] Use 1 for no adaptation.",
            max_q_factor="[1, inf] Use 1 for no adaptation.",
            deadband="[0, inf]",
            gate_sigmas="[0, inf]",
        )

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        if "q" not in belief.memory:  # before the first measurement
            return predicted
        q = belief.memory["q"][:, None, None]
        m, noise = scale_columns(predicted.m, 1.0, q.sqrt()), predicted.noise * q
        return predicted._replace(
            m=m, omega=predicted.omega + (noise - predicted.noise), noise=noise
        )

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        defaults = (
            torch.ones_like(innovation.r),
            torch.zeros_like(belief.mean[:, 0]),
            torch.ones_like(belief.mean[:, 0]),
        )
        r_mean, excess, q = (
            belief.memory.get(name, a)
            for name, a in zip(("r", "excess", "q"), defaults, strict=True)
        )
        axes = principal_axes(innovation, self.groups)
        noise_mask = axes.observed_mask & (axes.ratio < self.deadband)
        count = (axes.group_mask * noise_mask.unsqueeze(-2)).sum(-1)  # [R, k], equal within a group
        newest = (axes.group_mask * (noise_mask * axes.w.square()).unsqueeze(-2)).sum(
            -1
        ) / count.clamp(min=0.5)
        r_mean = torch.where(
            count > 0.5,
            (1.0 - self.forgetting_factor) * r_mean + self.forgetting_factor * newest,
            r_mean,
        )
        r = r_mean.clamp(1.0, self.max_r_factor)
        excess, q = self._process(
            axes, axes.observed_mask & ~noise_mask, axes.to_axes(r), excess, q
        )
        root = r.sqrt()
        # correlations between sensors do not change [ours]
        noise = innovation.noise * root.unsqueeze(-1) * root.unsqueeze(-2)
        return innovation.with_noise(noise), {"r": r_mean, "excess": excess, "q": q}

    def _process(
        self, axes: PrincipalAxes, state_mask: Tensor, r: Tensor, excess: Tensor, q: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Update the running excess of the innovations and the factor q on Q."""
        ratio = axes.ratio / r
        expected = (state_mask * ratio).sum(-1)
        measured = (state_mask * (axes.w.square() - r) / r).sum(-1)
        variance = (state_mask * 2.0 * (1.0 + ratio).square()).sum(-1)
        has_state_axis = state_mask.any(-1)
        excess = torch.where(
            has_state_axis,
            (1.0 - self.forgetting_factor) * excess
            + self.forgetting_factor * (measured - expected),
            excess,
        )
        above_band = excess - self.gate_sigmas * torch.sqrt(
            variance * self.forgetting_factor / (2.0 - self.forgetting_factor)
        )
        relative = torch.where(
            has_state_axis,
            above_band.clamp(min=0.0) / torch.where(has_state_axis, expected, 1.0),
            0.0,
        )
        return excess, torch.where(relative > 0.0, q * (1.0 + relative), q * self.decay).clamp(
            1.0, self.max_q_factor
        )


def scale_columns(m: Tensor, state_factor: float, noise_factor: Tensor | float) -> Tensor:
    """Scale the columns of the state and of the noise in M.

    Returns scaled slope [R, d, d + W]. Shapes: m [R, d, d + W].
    """
    d = m.shape[-2]
    return torch.cat([m[..., :d] * state_factor, m[..., d:] * noise_factor], -1)


# --------------------------------------------------------------------------------------------------
# Noise adaptations by covariance matching: one factor on R, or full matrices.


@dataclass(frozen=True)
class ScalarNoiseAdaptation(NoiseAdaptation):
    """One factor on R from the mean squared innovation, Q unchanged.

    Scalar form of [Mohamed and Schwarz 1999]: r = running mean of v' W v / k minus tr(W C_zz) / k,
    W = diag(R)^-1. All excess innovation is attributed to measurement noise.

    Attributes:
        forgetting_factor: Weight of the newest step.
        max_r_factor: Largest factor, at least 1.
    """

    forgetting_factor: float = 0.2
    max_r_factor: float = 100.0

    def __post_init__(self) -> None:
        require_ranges(
            "ScalarNoiseAdaptation",
            self,
            forgetting_factor="(0, 1]",
            max_r_factor="[1, inf] Use 1 for no adaptation.",
        )

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        return predicted

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        w = measurement_precision(innovation)
        k = innovation.observed_mask.sum(-1, dtype=innovation.r.dtype)
        mean_square = belief.memory.get("surprise", torch.ones_like(k))
        newest = (w * innovation.r.square()).sum(-1) / k.clamp(min=1.0)
        mean_square = torch.where(
            k > 0,
            (1.0 - self.forgetting_factor) * mean_square + self.forgetting_factor * newest,
            mean_square,
        )
        expected = (w * diagonal_axes(innovation.predicted_covariance)).sum(-1) / k.clamp(min=1.0)
        r = (mean_square - expected).clamp(1.0, self.max_r_factor)
        return innovation.with_noise(innovation.noise * r[:, None, None]), {
            "surprise": mean_square,
            "trace_r": r,
        }


@dataclass(frozen=True)
class MatrixNoiseAdaptation(NoiseAdaptation):
    """Full matrices R and Q from residuals [Akhlaghi, Zhou and Huang 2017].

    For comparison. R <- a R + (1 - a) (e e' + C+_zz), with residual e and covariance C+_zz after
    the update. The source uses the covariance before the update, but E e e' = R - H P+ H'.
    Q <- a Q + (1 - a) K v v' K', where each term has rank one. Residuals come from the statistical
    linearisation [ours]. R and Q start at the model's values, whose weight decays.

    Attributes:
        forgetting_factor: a in (0, 1]. 1 switches both adaptations off.

    Raises:
        ValueError: If a is outside (0, 1].
    """

    forgetting_factor: float = 0.99
    has_evidence = True  # R and Q of a step follow from the steps before it

    def __post_init__(self) -> None:
        require_ranges("MatrixNoiseAdaptation", self, forgetting_factor="(0, 1]")

    @override
    def predict_scale(
        self, predicted: AffineApproximation, belief: GaussianBelief
    ) -> AffineApproximation:
        if "process" not in belief.memory:  # before the first measurement
            return predicted
        model_weight = belief.memory["kept"][:, None, None]
        m, noise = (
            scale_columns(predicted.m, 1.0, model_weight.sqrt()),
            predicted.noise * model_weight + belief.memory["process"],
        )
        return predicted._replace(
            m=m, omega=predicted.omega + (noise - predicted.noise), noise=noise
        )

    @override
    def noise_adapt(
        self, innovation: Innovation, belief: GaussianBelief
    ) -> tuple[Innovation, dict[str, Tensor]]:
        a, nominal = self.forgetting_factor, innovation.nominal
        defaults = (
            torch.ones_like(nominal),
            torch.zeros_like(nominal),
            torch.zeros_like(innovation.root),
        )
        names = "kept_measurement", "measurement", "process"
        share, learned, process = (
            belief.memory.get(name, first) for name, first in zip(names, defaults, strict=True)
        )
        pair_mask = innovation.observed_mask.unsqueeze(-1) & innovation.observed_mask.unsqueeze(-2)
        adapted = innovation.with_noise(share * nominal + learned)
        shift, root, _ = kalman_gain_update(adapted)
        e = innovation.r - (innovation.m @ shift.unsqueeze(-1)).squeeze(-1)
        root_after = innovation.m @ root
        newest = _outer(e) + root_after @ root_after.mT + (adapted.omega - adapted.noise)
        model_weight = belief.memory.get("kept", torch.ones_like(e[:, 0])) * a
        return adapted, {
            "kept": model_weight,
            "kept_measurement": torch.where(pair_mask, a * share, share),
            "measurement": torch.where(pair_mask, a * learned + (1.0 - a) * newest, learned),
            "process": a * process
            + (1.0 - a) * _outer((innovation.root @ shift.unsqueeze(-1)).squeeze(-1)),
        }


def _outer(a: Tensor) -> Tensor:
    """Return outer products a a' of vectors [R, k] as [R, k, k]."""
    return a.unsqueeze(-1) * a.unsqueeze(-2)


# --------------------------------------------------------------------------------------------------
# Gain adaptations: adaptive factor, and a bound on the ratio of error to noise.


@dataclass(frozen=True)
class AdaptiveFactorGain(GainAdaptation):
    """Scale the predicted covariance by 1 / alpha if the innovation is large.

    P- / alpha [Yang, He and Xu 2001] with dV = sqrt(v' W v / tr(W (C_zz + R))). The factor is
    alpha = 1 while dV <= c0, then c0 / dV, and at least `min_factor`. It cannot distinguish a wrong
    state from a noisy measurement. A noise burst therefore inflates all states, step after step.
    Combine it with BoundedRatioGain.

    Attributes:
        threshold: c0. Infinity switches the factor off.
        min_factor: Smallest alpha.
        weight_by_noise: W = diag(R)^-1 of the model's noise [ours]. False is W = I as printed in the
            literature, which adds m^2 to (m/s)^2.

    Raises:
        ValueError: If an argument is outside its range.
    """

    threshold: float = 1.5
    min_factor: float = 0.1
    weight_by_noise: bool = True

    def __post_init__(self) -> None:
        require_ranges(
            "AdaptiveFactorGain",
            self,
            min_factor="(0, 1]",
            threshold="(0, inf] Use .inf for no factor.",
        )

    @override
    def __call__(self, innovation: Innovation, factor: Tensor) -> Tensor:
        w = (
            measurement_precision(innovation)
            if self.weight_by_noise
            else innovation.observed_mask.to(innovation.r.dtype)
        )
        expected = (w * diagonal_axes(innovation.predicted_covariance + innovation.noise)).sum(-1)
        normalised_innovation = torch.sqrt(
            (w * innovation.r.square()).sum(-1) / torch.where(expected > 0.0, expected, 1.0)
        )
        return factor / torch.where(
            normalised_innovation > self.threshold, self.threshold / normalised_innovation, 1.0
        ).clamp(min=self.min_factor)


@dataclass(frozen=True)
class BoundedRatioGain(GainAdaptation):
    """Bound the ratio rho of predicted error to noise [ours, after the paper].

    The gain is rho / (1 + rho). rho is the largest eigenvalue of C_zz in units of the current R
    of a sensor group. A factor f above 1 is reduced until f rho is at most `max_ratio`, but not
    below 1, so the model's own prediction is never narrowed. If f rho is below `min_ratio`, f grows.

    Attributes:
        max_ratio: Upper bound. Infinity switches it off.
        min_ratio: Lower bound. 0 switches it off.
        groups: Group number of each component, as in ConstrainedNoiseAdaptation.

    Raises:
        ValueError: If a bound is negative or `min_ratio` exceeds `max_ratio`.
    """

    max_ratio: float = 1.0
    min_ratio: float = 0.0
    groups: Sequence[int] | None = None
    has_evidence = True

    def __post_init__(self) -> None:
        require(
            0.0 <= self.min_ratio <= self.max_ratio,
            "BoundedRatioGain.min_ratio",
            "be from 0 to max_ratio",
            f"min_ratio={self.min_ratio}, max_ratio={self.max_ratio}",
            "Choose 0 <= min_ratio <= max_ratio.",
        )

    @override
    def __call__(self, innovation: Innovation, factor: Tensor) -> Tensor:
        _, joint_mask = axes_by_group(innovation, self.groups)
        white = whitened_measurement(
            compute_group_root(innovation.noise, joint_mask),
            innovation.predicted_covariance,
            joint_mask,
        )
        rho = torch.linalg.eigvalsh(white).amax(-1).clamp(min=0.0)
        positive_rho = torch.where(rho > 0.0, rho, 1.0)
        factor = torch.where(
            factor * rho > self.max_ratio, (self.max_ratio / positive_rho).clamp(min=1.0), factor
        )
        return torch.where(
            (factor * rho < self.min_ratio) & (rho > 0.0), self.min_ratio / positive_rho, factor
        )
