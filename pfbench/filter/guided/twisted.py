"""Twisted particle filter: a normal approximation of the whole record guides resampling and proposal."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial
from typing import NamedTuple

import torch
from torch import Tensor
from typing_extensions import override

from pfbench.core.linear_algebra import factor, jacobian
from pfbench.core.parameter_checks import require_ranges
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, normalise_updated_weights
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.proposals import (
    choose_defensive_particles,
    log_standard_normal,
    scale_noise,
)
from pfbench.filter.particle.stages import AuxiliaryWeights, Proposal, ProposalSample
from pfbench.filter.smoothing.noise_space import NoiseSpace
from pfbench.filter.whitening import log_determinant
from pfbench.kernels.dispatch import use_kernels
from pfbench.model.base import StateSpaceModel

_TWIST = "twist_"  # start of the names in the memory of the particles: guides of the steps to come, [R, 1, T, ...]


_SMALLEST_GAIN = 1e-6  # of twice the log density of the path; the search ends below it


class NormalGuide(NamedTuple):
    """Normal approximation of a step and of all measurements from it on, about a path.

    Let e be the deviation of x_t-1 from the path. Then log p(y_t:T | x_t-1) is about -e' L e / 2 + l' e. The
    standardised noise of the step given y_t:T is about N(shift - gain e, root root').

    Attributes:
        centre: State of the path before the step, [R, D].
        information: L, [R, d, d].
        score: l, [R, d].
        shift: [R, W].
        gain: [R, W, d].
        root: Upper triangular, [R, W, W].
    """

    centre: Tensor
    information: Tensor
    score: Tensor
    shift: Tensor
    gain: Tensor
    root: Tensor

    def sample(self, e: Tensor, z: Tensor) -> Tensor:
        """Map standard normal numbers z [R, N, W] to noise [R, N, W], given deviations e [R, N, d]."""
        return self.shift.unsqueeze(1) - e @ self.gain.mT + z @ self.root.mT

    def standardise(self, e: Tensor, w: Tensor) -> Tensor:
        """Map noise [R, N, W] to the standard normal numbers [R, N, W] that give it."""
        deviation = w - self.shift.unsqueeze(1) + e @ self.gain.mT
        return torch.linalg.solve_triangular(self.root, deviation.mT, upper=True).mT


class _Step(NamedTuple):
    """Derivatives of a step about a path: of x_t in x_t-1 and in the noise w; of the log likelihood in x_t, with its information."""

    x: Tensor
    w: Tensor
    state: Tensor
    noise: Tensor
    score: Tensor
    information: Tensor


def fit_guides(model: StateSpaceModel, record: Record, passes: int) -> list[NormalGuide]:
    """Fit the guides of a record by Gauss-Newton steps to the mode of initial state and noise.

    A step of the search is halved up to three times, and left out if none of these steps increases the posterior density.

    Args:
        model: State-space model with normal initial state and noise.
        record: All steps of the record, prepared by the model.
        passes: Number of steps of the search.

    Returns:
        Guides. The first one is of the whitened initial state, whose noise it is, and the others are of the steps.

    Raises:
        ValueError: If initial state or noise is not normal, or the record has feedback.
    """
    space = NoiseSpace(model, record)
    theta = torch.zeros(space.runs, 1, space.size).to(model.anchor)
    for _ in range(passes):
        steps = _linearise(space, theta)
        e, parts = theta[..., :0], []
        for step, guide in zip(steps, _recurse(steps), strict=True):
            parts.append(guide.sample(e, torch.zeros_like(step.w)))
            e = e @ step.state.mT + (parts[-1] - step.w) @ step.noise.mT
        factors = theta.new_tensor([0.0, 1.0, 0.5, 0.25, 0.125])[:, None]
        candidates = theta + factors * (torch.cat(parts, -1) - theta)
        cost = candidates.square().sum(-1) - 2.0 * space.roll_out(candidates)[1]
        best = cost.nan_to_num(nan=math.inf).argmin(1)
        if not bool((cost[:, 0] - cost.amin(1) > _SMALLEST_GAIN).any()):
            break
        theta = candidates[torch.arange(space.runs, device=theta.device), best].unsqueeze(1)
    return _recurse(_linearise(space, theta))


def _linearise(space: NoiseSpace, theta: Tensor) -> list[_Step]:
    """Linearise start and steps about the path of a vector [R, 1, size]."""
    chart = space.model.chart
    d, xi = chart.dimension, theta[..., : chart.dimension]
    x = space.start(xi)
    slope = jacobian(lambda c: space.start(xi + c), x, d, chart.subtract)
    nothing = slope[..., :0]
    steps = [_Step(x, xi, nothing, slope, torch.zeros_like(xi[:, 0]), torch.zeros_like(slope))]
    for t, (model, record) in enumerate(space.steps):
        before, w = x, space.noise(theta, t)
        move = partial(_move, space, t, before, w)
        x = move(torch.zeros_like(torch.cat([xi, w], -1)))
        slope = jacobian(move, x, d + w.shape[-1], chart.subtract)
        steps.append(
            _Step(before, w, slope[..., :d], slope[..., d:], *_curvature(model, record, x))
        )
    return steps


def _move(space: NoiseSpace, t: int, x: Tensor, w: Tensor, c: Tensor) -> Tensor:
    """Take a step from x + c with the noise w + c, where c [R, k, d + W] are changes of both."""
    d = space.model.chart.dimension
    return space.advance(t, space.model.chart.add(x, c[..., :d]), w + c[..., d:])[0]


def _curvature(model: StateSpaceModel, record: Record, x: Tensor) -> tuple[Tensor, Tensor]:
    """Return gradient [R, d] and information [R, d, d] of the log likelihood at x [R, 1, D]: minus its Hessian, without negative eigenvalues."""
    with torch.enable_grad(), use_kernels(False):
        c = torch.zeros(len(x), 1, model.chart.dimension).to(x).requires_grad_()
        value = model.log_likelihood(record.y, model.chart.add(x, c), record.u).sum()
        (score,) = torch.autograd.grad(value, c, create_graph=True)
        hessian = torch.zeros_like(score).mT @ torch.zeros_like(score)
        if score.requires_grad:
            total, eye = score.sum((0, 1)), torch.eye(score.shape[-1]).to(score)
            (rows,) = torch.autograd.grad(total, c, eye, is_grads_batched=True)
            hessian = rows.squeeze(2).transpose(0, 1)
    score = score.detach().squeeze(1)
    values, vectors = torch.linalg.eigh(-hessian)
    return score, vectors @ (values.clamp(min=0.0).unsqueeze(-1) * vectors.mT)


def _recurse(steps: list[_Step]) -> list[NormalGuide]:
    """Integrate noise and later measurements out of the linearised steps, from the last one backwards."""
    information = torch.zeros_like(steps[-1].information)
    score, guides = torch.zeros_like(steps[-1].score), []
    for step in reversed(steps):
        information = step.information + information
        score = (step.score + score).unsqueeze(-1)
        by_noise = step.noise.mT @ information
        eye = torch.eye(step.noise.shape[-1]).to(step.noise)
        lower, _ = factor(eye + by_noise @ step.noise)
        root = torch.linalg.solve_triangular(lower.mT, eye.expand_as(lower), upper=True)
        w = step.w.mT
        shift = root @ (root.mT @ (step.noise.mT @ score - w))
        cross = by_noise @ step.state
        gain = root @ (root.mT @ cross)
        score = (step.state.mT @ score - cross.mT @ shift).squeeze(-1)
        information = step.state.mT @ information @ step.state - cross.mT @ gain
        guides.append(
            NormalGuide(step.x[:, 0], information, score, (w + shift).squeeze(-1), gain, root)
        )
    return guides[::-1]


def _read_guide(model: StateSpaceModel, belief: ParticleBelief) -> tuple[NormalGuide, Tensor]:
    """Return the guide of the coming step, and the deviations of the particles from its path, [R, N, d]."""
    tables = (belief.memory[_TWIST + name][:, 0, 0] for name in NormalGuide._fields)
    guide = NormalGuide(*tables)
    return guide, model.chart.subtract(belief.x, guide.centre.unsqueeze(1))


@dataclass(frozen=True)
class TwistedWeights(AuxiliaryWeights):
    """Resampling weights (1 - c) W psi + c W, where psi approximates the density of all later measurements.

    For a `TwistedParticleFilter`, which fits psi.

    Attributes:
        defensive_fraction: Fraction c of the probabilities that ignores later measurements, in [0, 1).

    Raises:
        ValueError: If the fraction is outside [0, 1).
    """

    defensive_fraction: float = 0.1
    is_exact = True

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return self.defensive_fraction > 0.0

    def __post_init__(self) -> None:
        require_ranges("auxiliary_weights", self, defensive_fraction="[0, 1)")

    @override
    def __call__(self, model: StateSpaceModel, belief: ParticleBelief, record: Record) -> Tensor:
        guide, e = _read_guide(model, belief)
        psi = e @ guide.score.unsqueeze(-1) - 0.5 * (e @ guide.information * e).sum(
            -1, keepdim=True
        )
        log_a = torch.log_softmax(belief.log_w + psi.squeeze(-1), -1)
        if self.defensive_fraction == 0.0:
            return log_a
        c = self.defensive_fraction
        return torch.logaddexp(log_a + math.log1p(-c), belief.log_w + math.log(c))


@dataclass(frozen=True)
class TwistedProposal(Proposal):
    """Draw the noise of each particle given all later measurements, by the guide of a `TwistedParticleFilter`.

    Attributes:
        defensive_fraction: Fraction c of the particles that are drawn from the model's noise, in [0, 1). A ratio is
            then at most 1 / c.

    Raises:
        ValueError: If the fraction is outside [0, 1).
    """

    defensive_fraction: float = 0.0
    is_exact = True

    @property
    @override
    def has_bounded_weights(self) -> bool:
        return self.defensive_fraction > 0.0

    def __post_init__(self) -> None:
        require_ranges("proposal", self, defensive_fraction="[0, 1)")

    @override
    def __call__(
        self, model: StateSpaceModel, belief: ParticleBelief, record: Record, draws: RandomStream
    ) -> ProposalSample:
        guide, e = _read_guide(model, belief)
        z = draws.normal("twisted", belief.x.shape[1], model.noise_dim).to(e)
        xi, log_ratio = _draw(
            guide, e, z, self.defensive_fraction, belief.log_w > -torch.inf, draws
        )
        w = scale_noise(model, xi)
        memory = {k: v[:, :, 1:] if k.startswith(_TWIST) else v for k, v in belief.memory.items()}
        return ProposalSample(model.propagate(belief.x, record.u, w), log_ratio, memory, w)


def _draw(guide: NormalGuide, e: Tensor, z: Tensor, fraction: float, active_mask: Tensor, draws: RandomStream) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Draw standardised noise by a guide, a fraction of it from the model, and the log ratio of the densities."""
    xi, selection = guide.sample(e, z), None
    if fraction > 0.0:
        selection = choose_defensive_particles(fraction, active_mask, draws, "twisted.kept")
        xi = torch.where(selection.mask.unsqueeze(-1), z, xi)
    log_q = log_standard_normal(guide.standardise(e, xi)) - log_determinant(guide.root).unsqueeze(
        -1
    )
    log_ratio = log_standard_normal(xi) - log_q
    return xi, log_ratio if selection is None else selection.bound_log_ratio(log_ratio)


@dataclass(frozen=True)
class TwistedParticleFilter(ParticleFilter):
    """Particle filter whose resampling and noise follow a normal approximation of the smoothed paths of the record.

    The approximation is that of Laplace about the most probable initial state and noise. Process noise may be singular.
    Weights correct it: the evidence is unbiased and the estimates converge to p(x_t | y_1:t) for any approximation. The
    particles of a step depend on later measurements, however. This is a method for evidence and parameters, not for online
    use. On linear-Gaussian models the evidence is exact with any number of particles if each step resamples.

    Attributes:
        passes: Number of Gauss-Newton steps of the fit.

    Raises:
        ValueError: If passes is not a count, or the stages do not fit.

    References:
        Guarniero, Johansen and Lee 2017, the iterated auxiliary particle filter. Vihola, Helske and Franks 2020 (psi-APF).
    """

    auxiliary_weights: AuxiliaryWeights = field(default_factory=TwistedWeights)
    proposal: Proposal = field(default_factory=TwistedProposal)
    passes: int = 10

    @property
    @override
    def is_exact(self) -> bool:
        return super().is_exact

    def __post_init__(self) -> None:
        super().__post_init__()
        require_ranges("filter", self, passes="whole [0, inf) Use 10.")

    @override
    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief:
        raise ValueError(
            "a twisted particle filter needs the record, got a start without it. Use run_filter or pmmh."
        )

    @override
    def init_from_record(
        self, model: StateSpaceModel, record: Record, draws: RandomStream
    ) -> ParticleBelief:
        with torch.no_grad():
            first, *guides = fit_guides(model, record, self.passes)
        z = draws.normal("initial", self.particles, first.shift.shape[-1]).to(first.root)
        fraction = getattr(self.proposal, "defensive_fraction", 0.0)
        xi, log_ratio = _draw(
            first, z[..., :0], z, fraction, torch.ones_like(z[..., 0], dtype=torch.bool), draws
        )
        log_w, total, *_ = normalise_updated_weights(log_ratio - math.log(self.particles))
        tables = {
            _TWIST + name: torch.stack([getattr(g, name) for g in guides], 1).unsqueeze(1)
            for name in NormalGuide._fields
        }
        return ParticleBelief(
            NoiseSpace(model, record).start(xi), log_w, total.double(), memory=tables
        )
