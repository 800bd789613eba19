"""A guide of a Pyro program as the proposal of a particle filter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, TypeAlias

import torch
from pyro.poutine.messenger import Messenger
from torch import Tensor
from typing_extensions import override

from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief
from pfbench.filter.particle.stages import Proposal, ProposalSample
from pfbench.model.base import StateSpaceModel
from pfbench.ppl.step_program import value_at

Guide: TypeAlias = Callable[[StateSpaceModel, Tensor, Record], Any]
SITE = "noise"


@dataclass(frozen=True)
class GuideProposal(Proposal):
    """Draw the noise of a step by a guide: a program with one sample site, `noise`, of independent components or normal.

    The weights are corrected by the ratio p(w) / q(w), so that any guide that covers the noise of the model is exact. Parameters of
    the guide (`pyro.param`) are those of Pyro's store when the filter runs.

    Attributes:
        guide: Function of the model, the parents [R, N, D] and the record of the step. It samples `noise`, batch [R, N] and
            event [W]. The distribution is normal, or has an inverse distribution function.
    """

    guide: Guide
    is_exact = True

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        with torch.no_grad(), _CountedSite(draws, belief.x.shape[:2], model.noise_dim) as site:
            self.guide(model, belief.x, record)
        w = site.value.to(belief.x.dtype)
        log_ratio = model.noise.log_prob(w) - site.log_density
        return ProposalSample(model.propagate(belief.x, record.u, w), log_ratio, belief.memory, w)


class _CountedSite(Messenger):
    """Handler that draws the site of a guide by counters, in place of the global random state of torch."""

    def __init__(self, draws: RandomStream, batch: torch.Size, width: int) -> None:
        super().__init__()
        self.draws, self.batch, self.width = draws, batch, width
        self._drawn: tuple[Tensor, Tensor] | None = None

    @property
    def value(self) -> Tensor:
        """The noise, [R, N, W]. Raises ValueError if the guide has not sampled it."""
        return self._find()[0]

    @property
    def log_density(self) -> Tensor:
        """Log density of the noise under the guide, [R, N]."""
        return self._find()[1]

    def _find(self) -> tuple[Tensor, Tensor]:
        if self._drawn is None:
            raise ValueError(
                f"proposal.guide must sample the site {SITE!r}, got none. Write pyro.sample({SITE!r}, ...)."
            )
        return self._drawn

    def _pyro_sample(self, message: Any) -> None:
        """Draw the site of a message."""
        name, distribution = message["name"], message["fn"]
        if name != SITE or self._drawn is not None or message["is_observed"]:
            raise ValueError(
                f"proposal.guide must sample the site {SITE!r} once, and no other one, got {name!r}. "
                "Its other sites would have to be integrated out: make them parameters (pyro.param)."
            )
        shape = (*self.batch, self.width)
        if tuple(distribution.event_shape) != (self.width,):
            raise ValueError(
                f"proposal.guide must have a site of {self.width} noises (event [{self.width}]), got "
                f"{list(distribution.event_shape)}. Use .to_event(1)."
            )
        expanded = distribution.expand(self.batch)
        z = self.draws.normal("guide", self.batch[1], self.width)
        value = value_at("proposal.guide", expanded, z).expand(shape)
        message["value"], message["done"] = value, True
        self._drawn = value, expanded.log_prob(value)
