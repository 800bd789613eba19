"""Noise adaptations of Gaussian filters: fading memory, and constrained R and Q.

The paper [COFM-AMSSRCPF 2024, Measurement and Control] describes its equations in prose only.
Choices that it leaves open are marked [ours].
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.gaussian.principal_axes import PrincipalAxes, check_weight, principal_axes


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
        if not self.fading_factor >= 1.0:
            raise ValueError(
                f"FadingMemory.fading_factor must be at least 1, got {self.fading_factor}. "
                "Use 1 for no fading."
            )

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
        check_weight("ConstrainedNoiseAdaptation.forgetting_factor", self.forgetting_factor)
        check_weight("ConstrainedNoiseAdaptation.decay", self.decay)
        for name in ("max_r_factor", "max_q_factor"):
            if not getattr(self, name) >= 1.0:
                raise ValueError(
                    f"ConstrainedNoiseAdaptation.{name} must be at least 1, got {getattr(self, name)}. "
                    "Use 1 for no adaptation."
                )
        if not (self.deadband >= 0.0 and self.gate_sigmas >= 0.0):
            raise ValueError(
                "ConstrainedNoiseAdaptation.deadband and gate_sigmas must be at least 0, got "
                f"deadband={self.deadband}, gate_sigmas={self.gate_sigmas}. Set 0 or more."
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

    Args:
        m: Slope [R, d, d + W].
        state_factor: Factor on the columns of the state.
        noise_factor: Factor on the columns of the noise.

    Returns:
        Scaled slope [R, d, d + W].
    """
    d = m.shape[-2]
    return torch.cat([m[..., :d] * state_factor, m[..., d:] * noise_factor], -1)
