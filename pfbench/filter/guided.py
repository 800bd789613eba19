"""A proposal shaped by one Gaussian filter, the guide, for the whole cloud.

[COFM-AMSSRCPF 2024, Measurement and Control] has "mean and variance" of a cubature filter define the importance density and does
not say of which one: of the cloud (here), of each particle (guided_particles), or of its noise (guided_noise).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Literal

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, Gaussian, moments
from pfbench.filter.gaussian import Advance, GaussianFilter, Innovation, update
from pfbench.filter.guides import COVARIANCE, MEAN, check_widen, log_ratio_of, recall, remember
from pfbench.filter.linearisation import innovation as innovation_at
from pfbench.filter.linearisation import is_normal, where_seen
from pfbench.filter.points import Independent, Points
from pfbench.filter.proposals import Proposed
from pfbench.filter.whitening import filled, half_square, log_det, whiten
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


@dataclass(frozen=True)
class Guided:
    """One guide for the cloud: all particles are drawn afresh from N(x+, P+) and weighed by p(y | x) N(x; x-, P-) / N(x; x+, P+).

    So a particle has no parent, and what it weighed before is forgotten: the ratio holds -log N - log w. As in the Gaussian
    particle filter [Kotecha and Djuric 2003] the prior is a normal law at each step; on linear-Gaussian models all weights are
    equal, on others the evidence is approximate. One step of the guide for each run, whatever N.

    Args:
        guide: the Gaussian filter, with its adaptations; it goes on from its own belief, not from the particles.
        target: what is weighed. `adapted`: the guide's last word on P- and R, so that the evidence is of the model as adapted.
            `nominal`: the model's own R, and P- without fading, widening and doubt of Q.
        track: what the guide goes on from. `gauss`: its own x+, P+. `moments`: mean and covariance of the particles after their
            refresh [ours]; without `matched` their spread shrinks step after step in many dimensions.
        matched: the active particles' z are centred and whitened, so that they have mean and covariance of the proposal exactly.
        widen: factor on the proposal's covariance.
        points: where the z come from.

    Raises:
        ValueError: an unknown target or track, a factor that is not positive; at the first step, too few particles to be
            matched, or an adapted R for a measurement whose law is not normal.
    """

    guide: GaussianFilter
    target: Literal["adapted", "nominal"] = "adapted"
    track: Literal["gauss", "moments"] = "gauss"
    matched: bool = False
    widen: float = 1.0
    points: Points = field(default_factory=Independent)
    exact = False

    def __post_init__(self) -> None:
        for key, value, known in (("target", self.target, ("adapted", "nominal")), ("track", self.track, ("gauss", "moments"))):
            if value not in known:
                raise ValueError(f"proposal.{key}={value}: give {known[0]} or {known[1]}")
        check_widen(self.widen)

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        active = cloud.log_w > -torch.inf
        before = self._before(model, cloud, seen, draws)
        new = self.guide.advance(model, before, seen)
        shift, root, _ = update(new.innovation)
        z = self._normals(model, active, draws)
        xi = shift.unsqueeze(1) + math.sqrt(self.widen) * (z @ root.mT)
        log_ratio = log_ratio_of(xi, z, log_det(root).unsqueeze(-1), self.widen)
        x = model.chart.add(new.prior.unsqueeze(1), xi @ new.prior_root.mT)
        if self.target == "nominal":
            log_ratio = log_ratio + self._other_prior(model, before, new, xi, seen)
        elif self.guide.adaptations:
            log_ratio = log_ratio + _other_noise(model, new.innovation, x, seen)
        reset = torch.log(active.sum(1, keepdim=True, dtype=xi.dtype)) + torch.where(active, cloud.log_w, 0.0)
        log_ratio = torch.where(torch.isfinite(new.log_like).unsqueeze(-1), log_ratio - reset, -torch.inf)
        memory = cloud.memory | remember(new, (len(x), 1)) | {MEAN: new.mean.unsqueeze(1)}
        if self.track == "moments":  # from here on the particles know
            memory.pop(MEAN)
        return Proposed(x, torch.where(active, log_ratio, -torch.inf), memory)

    def _before(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Gaussian:
        """The guide's belief at t-1; of a cloud that nothing has been seen of, the initial law, not particles of it."""
        if MEAN in cloud.memory:
            return recall(cloud.memory, cloud.memory[MEAN], cloud.memory[COVARIANCE])
        if COVARIANCE not in cloud.memory:
            return self.guide.init(model, len(cloud.x), draws, seen.start, seen.spread)
        mean, covariance = moments(model.chart, cloud)
        return recall(cloud.memory, mean.unsqueeze(1), covariance.unsqueeze(1))

    def _normals(self, model: StateSpaceModel, active: Tensor, draws: Draws) -> Tensor:
        """z [R, N, d]."""
        slots, d = active.shape[1], model.chart.dimension
        z = self.points(draws).normal("guide", slots, d)
        if not self.matched:
            return z
        if slots <= d:
            raise ValueError(f"proposal.matched=true: {slots} particles cannot match {d} states; give more than {d} particles")
        share = active.to(z.dtype) / active.sum(1, keepdim=True)
        z = z - (share.unsqueeze(-1) * z).sum(1, keepdim=True)
        return whiten(z, torch.linalg.cholesky_ex((share.unsqueeze(-1) * z).mT @ z)[0])

    def _other_prior(self, model: StateSpaceModel, before: Gaussian, new: Advance, xi: Tensor, seen: Record) -> Tensor:
        """log N(x; x-, P- as the model has it) - log N(x; x-, P- as adapted) [R, N]."""
        if not (self.guide.adaptations or self.guide.gains):
            return torch.zeros_like(xi[..., 0])
        plain = replace(self.guide, adaptations=(), gains=()).advance(model, before, seen)
        gain = log_det(filled(new.prior_root)) - log_det(filled(plain.prior_root))
        return gain.unsqueeze(-1) + half_square(xi) - half_square(whiten(xi @ new.prior_root.mT, plain.prior_root))


def _other_noise(model: StateSpaceModel, innovation: Innovation, x: Tensor, seen: Record) -> Tensor:
    """log N(r; 0, R as adapted) - log N(r; 0, R as the model has it), r = y - h(x) [R, N].

    Raises:
        ValueError: R was changed, and the law of what is seen is not normal.
    """
    noises = [where_seen(noise, innovation.seen) for noise in (innovation.noise, innovation.nominal)]
    if torch.equal(*noises):
        return torch.zeros_like(x[..., 0])
    if not is_normal(model.observation(x, seen.u)):
        raise ValueError(
            f"proposal.target=adapted: the guide adapts R, but {type(model).__name__} has a law of what is seen that is not "
            "normal; choose target=nominal, or a guide that leaves R alone"
        )
    r, values = innovation_at(model, x, seen), []
    for noise in noises:
        root, ok = factor(noise)
        value = -half_square(whiten(r, root)) - log_det(root).unsqueeze(-1)
        values.append(torch.where(ok.unsqueeze(-1), value, torch.nan))
    return values[0] - values[1]
