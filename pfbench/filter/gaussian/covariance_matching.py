"""Noise adaptations by covariance matching: one factor on R, or full matrices."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.filter.belief import GaussianBelief
from pfbench.filter.gaussian.innovation import Innovation, NoiseAdaptation
from pfbench.filter.gaussian.kalman_update import kalman_gain_update
from pfbench.filter.gaussian.linearisation_rules import AffineApproximation
from pfbench.filter.gaussian.noise_adaptation import scale_columns
from pfbench.filter.gaussian.principal_axes import (
    check_weight,
    diagonal_axes,
    measurement_precision,
)


@dataclass(frozen=True)
class ScalarNoiseAdaptation(NoiseAdaptation):
    """One factor on R from the mean squared innovation, Q unchanged.

    Scalar form of [Mohamed and Schwarz 1999]: r = running mean of v' W v / k minus tr(W C_zz) / k,
    W = diag(R)^-1. All excess innovation is attributed to measurement noise.

    Attributes:
        forgetting_factor: Weight of the newest step.
        max_r_factor: Largest factor, at least 1.

    Raises:
        ValueError: If an argument is outside its range.
    """

    forgetting_factor: float = 0.2
    max_r_factor: float = 100.0

    def __post_init__(self) -> None:
        check_weight("ScalarNoiseAdaptation.forgetting_factor", self.forgetting_factor)
        if not self.max_r_factor >= 1.0:
            raise ValueError(
                "ScalarNoiseAdaptation.max_r_factor must be at least 1, "
                f"got {self.max_r_factor}. Use 1 for no adaptation."
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
        check_weight("MatrixNoiseAdaptation.forgetting_factor", self.forgetting_factor)

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
