"""Features of a learned proposal, scaled to about one by the model's own scales.

All features are in standard deviations. States are scaled by the initial distribution or by
the particles, measurements by their noise or by their predicted distribution. Networks
therefore need no data statistics, and a network trained on wide beliefs also applies to
narrow ones.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_log_weights
from pfbench.filter.linearisation import mean_noise
from pfbench.model.base import StateSpaceModel

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
class InputFeature(Feature):
    """Inputs of the step by name, each divided by its scale.

    Attributes:
        input_scales: {name of an input tensor: value that is scaled to 1}.
    """

    input_scales: Mapping[str, float]

    @override
    def __call__(self, context: FeatureContext) -> Tensor:
        u, values = context.record.u, []
        for name, scale in self.input_scales.items():
            names = getattr(u, "_fields", ())
            if name not in names:
                raise ValueError(
                    "features.input_scales must be names of inputs "
                    f"({', '.join(names) or 'this model has none'}), got {name}. Remove it."
                )
            value = getattr(u, name)
            values.append((value.flatten(1) if value.dim() > 1 else value[:, None]) / scale)
        return torch.cat(values, -1).unsqueeze(1)


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
