"""What a learned proposal is told: numbers of about one, made with the model's own scales, whatever metres or radians they were.

Everything is measured in standard deviations: a state in those of the initial law or of the cloud, a measurement in those of its
noise or of what the cloud expected of it. Networks so need no statistics of a data set, and one that was trained where the cloud
is wide still knows what it sees where it is narrow.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.filter.belief import Cloud, weights
from pfbench.filter.linearisation import quiet
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record

_OCTAVES = 4.0  # logarithms are divided by it: a factor of a hundred thousand is then about 3
_LEAST = 1e-6  # a cloud is taken to be at least so wide, in standard deviations of the initial law


class Scene(NamedTuple):
    """One step before its noise is drawn; what several features need is computed once.

    Attributes:
        model, cloud, seen: of the step.
        start: the state about which the initial law is laid out [R or 1, 1, D].
        scale: standard deviations of the initial law [R or 1, 1, d].
        mean, sd: of the cloud at t-1 [R, 1, D], [R, 1, d].
        r: y - y_hat of each particle's child without noise, 0 where nothing was seen [R, N, k].
        noise_sd: of the measurement, as that child has it [R, N, k].
        expected_sd: of what the cloud expects of the measurement [R, 1, k].
        there: which components were seen [R, 1, k].
    """

    model: StateSpaceModel
    cloud: Cloud
    seen: Record
    start: Tensor
    scale: Tensor
    mean: Tensor
    sd: Tensor
    r: Tensor
    noise_sd: Tensor
    expected_sd: Tensor
    there: Tensor


def scene(model: StateSpaceModel, cloud: Cloud, seen: Record) -> Scene:
    """The step that this cloud is about to take."""
    x, share = cloud.x, weights(cloud.log_w).unsqueeze(-1)
    start = (model.origin.expand(1, -1) if seen.start is None else seen.start).unsqueeze(1)
    own: Any = model.initial(1) if seen.spread is None else None
    scale = (own.stddev if own is not None else seen.spread.norm(dim=-1)).unsqueeze(1)  # type: ignore[union-attr]
    mean = model.chart.mean(x, share.squeeze(-1)).unsqueeze(1)
    apart = model.chart.subtract(x, mean)
    sd = torch.sqrt((share * apart.square()).sum(1, keepdim=True) + (_LEAST * scale).square())
    law: Any = model.observation(model.propagate(x, seen.u, quiet(model, x)), seen.u)
    there = ~torch.isnan(seen.y).unsqueeze(1)
    r = torch.where(there, model.residual(seen.y.nan_to_num().unsqueeze(1), law.mean), 0.0)
    noise_sd = torch.nan_to_num(law.stddev, 1.0, 1e6).expand_as(r)
    centre = (share * r).sum(1, keepdim=True)
    own_noise = (share * noise_sd.square()).sum(1, keepdim=True)
    expected_sd = torch.sqrt((share * (r - centre).square()).sum(1, keepdim=True) + own_noise)
    return Scene(model, cloud, seen, start, scale, mean, sd, r, noise_sd, expected_sd, there)


class Feature(Protocol):
    """A scene -> numbers [R, N or 1, k] of about one."""

    def __call__(self, scene: Scene) -> Tensor: ...


@dataclass(frozen=True)
class Innovation:
    """What was seen against what a child without noise would show: in noise deviations (asinh) and in expected ones.

    Besides, how much wider than the noise the expectation is (its logarithm), and which components were seen: 4 k numbers.
    """

    def __call__(self, scene: Scene) -> Tensor:
        sharp, wide = torch.asinh(scene.r / scene.noise_sd), scene.r / scene.expected_sd
        told = torch.log(scene.expected_sd / scene.noise_sd) / _OCTAVES
        return torch.cat([sharp, wide, told, scene.there.to(sharp).expand_as(sharp)], -1)


@dataclass(frozen=True)
class Parent:
    """Where a particle stands: in the cloud, in its deviations, and (asinh) from the start, in the initial law's: 2 d numbers."""

    def __call__(self, scene: Scene) -> Tensor:
        chart, x = scene.model.chart, scene.cloud.x
        inside, away = chart.subtract(x, scene.mean) / scene.sd, chart.subtract(x, scene.start) / scene.scale
        return torch.cat([inside, torch.asinh(away)], -1)


@dataclass(frozen=True)
class Width:
    """How narrow the cloud has become: log of its deviations over the initial law's, d numbers for all particles of a run."""

    def __call__(self, scene: Scene) -> Tensor:
        return torch.log(scene.sd / scene.scale) / _OCTAVES


@dataclass(frozen=True)
class Inputs:
    """Inputs of the step by name, each divided by a scale of its own: what the model does not already make of them.

    Args:
        scales: {name of a tensor among the inputs: the size that counts as one}.

    Raises:
        ValueError: on use, a name that the inputs do not have.
    """

    scales: Mapping[str, float]

    def __call__(self, scene: Scene) -> Tensor:
        u, parts = scene.seen.u, []
        for name, size in self.scales.items():
            known = getattr(u, "_fields", ())
            if name not in known:
                raise ValueError(f"features.scales.{name}: the inputs have {', '.join(known) or 'nothing'}; name one of these")
            parts.append(getattr(u, name).flatten(1) / size if getattr(u, name).dim() > 1 else getattr(u, name)[:, None] / size)
        return torch.cat(parts, -1).unsqueeze(1)


@dataclass(frozen=True)
class Told:
    """All features side by side [R, N, F], cut off at +-`limit`; what is not finite is 0.

    Args:
        parts: the features.
        limit: of each number, so that a particle astray cannot ask a network for what it has never seen.
    """

    parts: Sequence[Feature] = field(default_factory=lambda: (Innovation(), Parent(), Width()))
    limit: float = 10.0

    def __call__(self, scene: Scene) -> Tensor:
        shape = scene.cloud.x.shape[:2]
        told = torch.cat([part(scene).expand(*shape, -1) for part in self.parts], -1)
        return torch.nan_to_num(told, 0.0, self.limit, -self.limit).clamp(-self.limit, self.limit)
