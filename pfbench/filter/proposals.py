"""Where particles are sent. A proposal owns its density ratio: nobody else computes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud
from pfbench.model.base import Standard, StateSpaceModel
from pfbench.record import Record


class Proposed(NamedTuple):
    """Where particles were sent.

    Attributes:
        x: [R, N, D].
        log_ratio: [R, N] log p(w) - log q(w) of the noise that led there.
        memory: as in Cloud.
        w: that noise [R, N, W], for moves that need it; None from a proposal that does not go through the noise.
        trace: anything per run, for the report {name: [R]}.
    """

    x: Tensor
    log_ratio: Tensor
    memory: dict[str, Tensor]
    w: Tensor | None = None
    trace: dict[str, Tensor] = {}  # noqa: RUF012 (a NamedTuple default, never written to)


class Proposal(Protocol):
    @property
    def exact(self) -> bool: ...

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed: ...


@dataclass(frozen=True)
class Bootstrap:
    """The model's own noise: x = propagate(x, u, w), ratio 0 [Gordon, Salmond, Smith 1993]."""

    exact = True

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        w = draw_noise(model, cloud.x.shape[1], draws)
        return Proposed(model.propagate(cloud.x, seen.u, w), torch.zeros_like(cloud.log_w), cloud.memory, w)


def draw_noise(model: StateSpaceModel, n: int, draws: Draws) -> Tensor:
    """w [R, n, W] from the model's noise law: normals scaled and shifted, any other law by inversion.

    Raises:
        NotImplementedError: from torch, where the law has no inverse distribution function.
    """
    law = model.noise
    base = law.base_dist if isinstance(law, torch.distributions.Independent) else law
    if isinstance(base, Standard):
        return draws.normal("noise", n, model.noise_dim)
    if isinstance(base, torch.distributions.Normal):
        return base.loc + base.scale * draws.normal("noise", n, model.noise_dim)
    return base.icdf(draws.uniform("noise", n, model.noise_dim).to(model.anchor.dtype))
