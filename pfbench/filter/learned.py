"""A learned proposal: a network says from which law a step's noise is drawn, and the ratio says what that costs.

The network is any nn.Module that maps what it is told [R, N, F] to a distribution of batch [R, N] and event [W]. Whatever it
says, the ratio p(w) / q(w) is computed here, so that a learned proposal never changes what the filter targets: badly trained it
wastes particles, and no more. See learned_laws for networks that are shipped.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.distributions import Distribution

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, weights
from pfbench.filter.defensive import check_fraction, kept
from pfbench.filter.guided_noise import GuidedNoise
from pfbench.filter.learned_draws import drawn
from pfbench.filter.learned_inputs import Feature, Told, scene
from pfbench.filter.learned_laws import log_standard
from pfbench.filter.learned_weights import Learnable, made
from pfbench.filter.linearisation import base
from pfbench.filter.proposals import Proposed
from pfbench.model.base import AtRest, Standard, StateSpaceModel
from pfbench.record import Record

PAST = "learned.past"  # what a recurrent network remembers, in a cloud's memory [R, 1, H]

Make = Callable[[int, int], nn.Module]
"""Number of features, dimension of the noise -> the network."""


class Law(NamedTuple):
    """What a step's noise is drawn from: zeta ~ law, xi = m + U zeta in standard deviations of the noise; and the new memory."""

    law: Distribution
    memory: dict[str, Tensor]


class Learned(nn.Module):
    """A proposal whose network maps (parent, cloud, measurement, inputs) to a law of the noise [after Naesseth et al. 2018].

    The network speaks of the noise in a frame: in the noise's own standard deviations, or, with a `guide`, in the coordinates
    in which the guide's normal law is N(0, I). A network that says N(0, I) so is the bootstrap proposal, or the guided one to the
    last digit, and training corrects that.

    Args:
        network: makes the module, called with the number of features and the dimension of the noise.
        features: what the network is told; innovation, parent and width of the cloud by default.
        guide: a guided proposal of each particle's noise, which is corrected; None for the model's own noise.
        share: of the particles that is drawn from the frame's own law instead, so that no weight is more than 1 / share times
            what it would be there [Hesterberg 1995]; 0 for none.
        memory: numbers in which a recurrent network (GRU) sums up what was seen before, one summary for each run; 0 for none.
        checkpoint: a file of trained weights, or `untrained`; null is refused on use.
        seed: of an untrained network.

    Raises:
        ValueError: a share that is no fraction, or 1; on use, no checkpoint, or one of another model or network.
    """

    exact = True
    part = "proposal"

    def __init__(
        self,
        network: Make,
        features: Sequence[Feature] | None = None,
        guide: GuidedNoise | None = None,
        share: float = 0.05,
        memory: int = 0,
        checkpoint: str | None = "untrained",
        seed: int = 0,
    ) -> None:
        super().__init__()
        check_fraction("proposal.share", share)
        if share == 1.0 or memory < 0:
            raise ValueError(f"proposal: share={share}, memory={memory}; give a share below 1 and 0 or more numbers to remember")
        self.make, self.guide, self.share, self.hidden = network, guide, share, memory
        self.told = Told() if features is None else Told(features)
        self.learnable = Learnable(self.part, checkpoint, seed, _frame(guide))
        self.network: nn.Module | None = None
        self.recurrent: nn.Module | None = None
        self.sizes = 0, 0, memory

    def begin(self, model: StateSpaceModel, cloud: Cloud, seen: Record, fresh: bool = False) -> None:
        """Makes the networks, whose sizes are known from here on, and fills them from the checkpoint, unless they start afresh.

        Raises:
            ValueError: as the class.
        """
        features, noise = self.told(scene(model, cloud, seen)).shape[-1], model.noise_dim

        def make() -> dict[str, nn.Module]:
            parts: dict[str, nn.Module] = {"network": self.make(features + self.hidden, noise)}
            return parts | ({"recurrent": nn.GRUCell(features, self.hidden)} if self.hidden else {})

        self.sizes = features, noise, self.hidden
        for name, module in made(self.learnable, make, self.sizes, model, fresh).items():
            setattr(self, name, module)

    def forward(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        law, memory = self.law(model, cloud, seen)
        # of the same name as the corrected proposal's: until it is trained, this one sends each particle where that one does
        z = draws.normal("noise" if self.guide is None else "guide", cloud.x.shape[1], model.noise_dim)
        zeta = drawn(law, z, draws)
        if isinstance(model, AtRest):  # nothing moves, so there is nothing to propose
            return Proposed(cloud.x, torch.zeros_like(cloud.log_w), memory, _sized(model, z))
        log_q = law.log_prob(zeta)
        if self.share:
            stay = kept(self.share, cloud.log_w > -torch.inf, draws, "learned.kept")
            zeta = torch.where(stay.who.unsqueeze(-1), z, zeta)
            log_q = stay.log_mixture(log_standard(zeta), law.log_prob(zeta))
        xi, log_det = self._framed(model, cloud, seen, zeta)
        w = _sized(model, xi)
        return Proposed(model.propagate(cloud.x, seen.u, w), _log_p(model, w, xi) - log_q + log_det, memory, w)

    def law(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Law:
        """What the network says of the step that this cloud is about to take."""
        if self.network is None:
            self.begin(model, cloud, seen)
        told, memory = self._told(model, cloud, seen)
        assert self.network is not None
        return Law(self.network(told), memory)

    def log_density(self, model: StateSpaceModel, cloud: Cloud, seen: Record, parent: Tensor, w: Tensor) -> Tensor:
        """log q(w | parent) [R] of noises w [R, W] of parents [R, D] beside this cloud: what inference compilation maximises.

        Of the network's own law, without the share that is kept. The parent joins the cloud with no weight, so that it is told
        what a particle at its place would be.
        """
        xi = ((w - model.noise.mean) / model.noise.stddev).unsqueeze(1)
        joined = _joined(cloud, parent.unsqueeze(1))
        if self.network is None:
            self.begin(model, joined, seen)
        told, _ = self._told(model, joined, seen)
        assert self.network is not None
        zeta, log_det = xi, torch.zeros_like(xi[:, 0, :1])
        if self.guide is not None:
            zeta, log_det = self._unframed(model, cloud, seen, parent, xi)
        value: Tensor = self.network(told[:, -1:]).log_prob(zeta)
        return value.squeeze(1) - log_det.squeeze(1) - model.noise.stddev.log().sum()

    def _told(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> tuple[Tensor, dict[str, Tensor]]:
        told = self.told(scene(model, cloud, seen))
        if self.recurrent is None:
            return told, cloud.memory
        share = weights(cloud.log_w).unsqueeze(-1)
        before = cloud.memory[PAST].squeeze(1) if PAST in cloud.memory else told.new_zeros(len(told), self.hidden)
        past: Tensor = self.recurrent((share * told).sum(1), before).unsqueeze(1)
        return torch.cat([told, past.expand(-1, told.shape[1], -1)], -1), cloud.memory | {PAST: past}

    def _framed(self, model: StateSpaceModel, cloud: Cloud, seen: Record, zeta: Tensor) -> tuple[Tensor, Tensor]:
        """xi = m + U zeta [R, N, W] and log |det U| [R, N or 1]."""
        if self.guide is None:
            return zeta, torch.zeros_like(zeta[..., 0])
        xi, log_det = self.guide._posterior(model, cloud, seen, zeta)
        return xi, log_det + 0.5 * zeta.shape[-1] * math.log(self.guide.widen)

    def _unframed(
        self, model: StateSpaceModel, cloud: Cloud, seen: Record, parent: Tensor, xi: Tensor
    ) -> tuple[Tensor, Tensor]:
        """zeta [R, 1, W] that leads from the parent [R, D] to xi, and log |det U| [R, 1]: the frame, read off at W + 1 places."""
        width = xi.shape[-1]
        probes = torch.cat([torch.zeros_like(xi), torch.eye(width).to(xi).expand(len(xi), -1, -1)], 1)
        joined = _joined(cloud, parent.unsqueeze(1).expand(-1, width + 1, -1))
        padded = torch.cat([xi.new_zeros(len(xi), cloud.x.shape[1], width), probes], 1)
        with torch.no_grad():  # it does not depend on what is learned
            sent, log_det = self._framed(model, joined, seen, padded)
        m, columns = sent[:, -width - 1], sent[:, -width:]
        zeta = torch.linalg.solve_ex((columns - m.unsqueeze(1)).mT, (xi.squeeze(1) - m).unsqueeze(-1))[0]
        return zeta.mT, log_det[:, -1:]


def _frame(guide: GuidedNoise | None) -> str:
    """What the network's law corrects, in words that a checkpoint keeps."""
    if guide is None:
        return "the model's own noise"
    rule = guide.guide.rule
    return f"what is guided by {type(getattr(rule, 'scheme', rule)).__name__}"


def _joined(cloud: Cloud, more: Tensor) -> Cloud:
    """The cloud with states [R, M, D] behind its own that weigh nothing."""
    nothing = torch.full_like(more[..., 0], -torch.inf)
    return cloud._replace(x=torch.cat([cloud.x, more], 1), log_w=torch.cat([cloud.log_w, nothing], 1))


def _sized(model: StateSpaceModel, xi: Tensor) -> Tensor:
    """Noise of the model's size from noise in standard deviations."""
    law = model.noise
    return xi if isinstance(base(law), Standard) else law.mean + law.stddev * xi


def _log_p(model: StateSpaceModel, w: Tensor, xi: Tensor) -> Tensor:
    """log p(w) as a density of xi [R, N]."""
    law: Any = model.noise
    if isinstance(base(law), Standard):
        return log_standard(xi)
    value: Tensor = law.log_prob(w) + law.stddev.log().sum()
    return value
