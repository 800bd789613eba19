"""State reconstruction: particles are shifted towards what was seen by the control law of Dynamic Matrix Control (DMC).

The states are taken as outputs of a plant with inputs [particle filter with state reconstruction by Dynamic Matrix Control, eqs
21 to 28]: the state's own (`Reconstructed`), or the driving noise (`ReconstructedNoise`).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud
from pfbench.filter.control import Control
from pfbench.filter.corrections import Correction, Marginal, kept_of, sound, undisturbed, unless
from pfbench.filter.defensive import Affine, check_fraction
from pfbench.filter.linearisation import derivative, innovation, mean, quiet, sight, times, where_seen
from pfbench.filter.proposals import Bootstrap, Proposal, Proposed
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


@dataclass(frozen=True)
class Reconstructed:
    """The particles of `base`, shifted by the control law.

    Args:
        base: where particles come from.
        control: how far they are shifted.
        correction: what becomes of their weights; Uncorrected is as printed.
    """

    base: Proposal = field(default_factory=Bootstrap)
    control: Control = field(default_factory=Control)
    correction: Correction = field(default_factory=Marginal)

    @property
    def exact(self) -> bool:
        return self.base.exact and self.correction.exact

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        sent = self.base(model, cloud, seen, draws)
        return self.correction(model, cloud, seen, sent, self.control, draws)


@dataclass(frozen=True)
class ReconstructedNoise:
    """The driving noise is the input: B its gain, Q = R_v^-1 and R = 1 the weights, so that the law is a Kalman update of w.

    Always valid, the transition may be singular, and exact for any model: the measurement is linearised at each parent's
    noise-free prediction, A = d y_hat / d w, P = (1 + A' R_v^-1 A)^-1, and w' = P A' R_v^-1 (y - y_hat) + S w has the ratio
    p(w') |S| / p(w). Deterministic, S = P, narrower than the posterior: where A A' exceeds R_v its weights have no variance
    unless a fraction is kept. Stochastic, S S' = P: the optimal proposal where the measurement is linear [Doucet et al. 2000].

    Args:
        base: gives the noise that is shifted.
        stochastic: draws from the posterior of the noise instead of shifting deterministically.
        keep: fraction that is not shifted.
        local: linearised at each parent's prediction; else once, at their mean.

    Raises:
        ValueError: at the first step, a base that does not tell its noise.
    """

    base: Proposal = field(default_factory=Bootstrap)
    stochastic: bool = True
    keep: float = 0.0
    local: bool = True

    def __post_init__(self) -> None:
        check_fraction("proposal.keep", self.keep)

    @property
    def exact(self) -> bool:
        return self.base.exact

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        sent, law = self.base(model, cloud, seen, draws), model.noise
        if sent.w is None:
            raise ValueError(f"proposal.base: {type(self.base).__name__} does not tell its noise; choose Bootstrap")
        staying = kept_of(self.keep, cloud.log_w + sound(sent, cloud)[1], draws)

        def sized(xi: Tensor) -> Tensor:
            return law.mean + law.stddev * xi

        before = (sent.w - law.mean) / law.stddev
        new, ratio = self._posterior(model, cloud, seen).sent(before, staying, lambda xi: law.log_prob(sized(xi)))
        w = unless(staying, sent.w, sized(new))
        return Proposed(model.propagate(cloud.x, seen.u, w), sent.log_ratio + ratio, sent.memory, w)

    def _posterior(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Affine:
        """Standardised noise to its posterior, given what is seen."""
        chart, law, gain = model.chart, model.noise, model.noise_gain(seen.u)
        still, w = undisturbed(model, cloud, seen)
        if gain is not None:
            centre = still if self.local else chart.mean(still, w).unsqueeze(1)
            a = sight(model, centre, seen) @ (gain * law.stddev).unsqueeze(1)
        else:
            parent = cloud.x if self.local else chart.mean(cloud.x, w).unsqueeze(1)
            centre = model.propagate(parent, seen.u, quiet(model, parent))
            a = _noise_sight(model, parent, seen)
        a, r = _whitened(model, centre, seen, a, innovation(model, still, seen))
        eye = torch.eye(a.shape[-1], dtype=a.dtype, device=a.device)
        root = torch.linalg.cholesky_ex(a.mT @ a + eye)[0]
        half = torch.linalg.solve_triangular(root, eye, upper=False).mT  # half half' = P
        covariance = half @ half.mT
        return Affine(half if self.stochastic else covariance, times(covariance, times(a.mT, r)))


def _noise_sight(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """Derivative of what is seen after x [R, P, D] with respect to the standardised noise, at its mean: [R, P, Dy, W]."""
    law = model.noise

    def ahead(at: Tensor, xi: Tensor) -> Tensor:
        return mean(model.observation(model.propagate(at, seen.u, law.mean + law.stddev * xi), seen.u))

    a = derivative(ahead, x, model.noise_dim, model.residual)
    return torch.where(torch.isnan(seen.y)[:, None, :, None], 0.0, a)


def _whitened(model: StateSpaceModel, x: Tensor, seen: Record, a: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
    """R_v^-1/2 A and R_v^-1/2 r for the measurement's covariance at x [R, P, D]; an infinite variance tells nothing."""
    law: Any = model.observation(x, seen.u)
    if not isinstance(law, torch.distributions.MultivariateNormal):
        scale = law.variance.rsqrt()
        return scale.unsqueeze(-1) * a, scale * r
    root = factor(where_seen(law.covariance_matrix, ~torch.isnan(seen.y).unsqueeze(1)))[0]
    return torch.linalg.solve_triangular(root, a, upper=False), times(torch.linalg.inv_ex(root)[0], r)
