"""Proposals shaped by a Gaussian filter, the guide: one for the whole cloud, one for each particle, or one for its noise.

[COFM-AMSSRCPF 2024, Measurement and Control] has "mean and variance" of a cubature filter define the importance density and does
not say of which one; all three readings are here. All of them draw whitened coordinates xi = m + U z of a normal prior N(0, I),
z ~ N(0, I), so that the ratio log N(xi; 0, I) - log N(xi; m, U U') = (|z|^2 - |xi|^2) / 2 + log |det U| holds in any chart and
where covariances are singular.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass, field, replace
from typing import Any, Literal, NoReturn

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.chart import Chart
from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, Gaussian, moments, weights
from pfbench.filter.gaussian import Advance, GaussianFilter, Innovation, around_first, update
from pfbench.filter.points import Independent, Points
from pfbench.filter.proposals import Bootstrap, Proposed
from pfbench.filter.rules import Linearised, Space
from pfbench.model.base import AtRest, Standard, StateSpaceModel, dense_normal, independent_normal
from pfbench.record import Record

_LOG_2PI = math.log(2.0 * math.pi)
_MEAN, _COVARIANCE, _CARRIED = "guide.mean", "guide.covariance", "guide.carries."


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
        _check_widen(self.widen)

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        active = cloud.log_w > -torch.inf
        before = self._before(model, cloud)
        new = self.guide.advance(model, before, seen)
        shift, root, _ = update(new.innovation)
        z = self._normals(model, active, draws)
        xi = shift.unsqueeze(1) + math.sqrt(self.widen) * (z @ root.mT)
        log_ratio = _log_ratio(xi, z, _log_det(root).unsqueeze(-1), self.widen)
        x = model.chart.add(new.prior.unsqueeze(1), xi @ new.prior_root.mT)
        if self.target == "nominal":
            log_ratio = log_ratio + self._other_prior(model, before, new, xi, seen)
        elif self.guide.adaptations:
            log_ratio = log_ratio + _other_noise(model, new.innovation, x, seen)
        reset = torch.log(active.sum(1, keepdim=True, dtype=xi.dtype)) + torch.where(active, cloud.log_w, 0.0)
        log_ratio = torch.where(torch.isfinite(new.log_like).unsqueeze(-1), log_ratio - reset, -torch.inf)
        memory = cloud.memory | _remember(new, (len(x), 1)) | {_MEAN: new.mean.unsqueeze(1)}
        if self.track == "moments":  # from here on the particles know
            memory.pop(_MEAN)
        return Proposed(x, torch.where(active, log_ratio, -torch.inf), memory)

    def begin(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None, spread: Tensor | None
    ) -> dict[str, Tensor]:
        """Memory of a cloud that nothing has been seen of: the moments of the initial law, as the filter's `init` has it."""
        first = self.guide.init(model, runs, draws, start, spread)
        return {_MEAN: first.mean.unsqueeze(1), _COVARIANCE: first.covariance.unsqueeze(1)}

    def _before(self, model: StateSpaceModel, cloud: Cloud) -> Gaussian:
        """The guide's belief at t-1."""
        if _MEAN in cloud.memory:
            return _recall(cloud.memory, cloud.memory[_MEAN], cloud.memory[_COVARIANCE])
        if self.track == "gauss":
            _not_begun("Guided")
        mean, covariance = moments(model.chart, cloud)
        return _recall(cloud.memory, mean.unsqueeze(1), covariance.unsqueeze(1))

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
        root, _ = torch.linalg.cholesky_ex((share.unsqueeze(-1) * z).mT @ z)
        return torch.linalg.solve_triangular(root, z.mT, upper=False).mT

    def _other_prior(self, model: StateSpaceModel, before: Gaussian, new: Advance, xi: Tensor, seen: Record) -> Tensor:
        """log N(x; x-, P- as the model has it) - log N(x; x-, P- as adapted) [R, N]."""
        if not (self.guide.adaptations or self.guide.gains):
            return torch.zeros_like(xi[..., 0])
        plain = replace(self.guide, adaptations=(), gains=()).advance(model, before, seen)
        nominal, adapted = _filled(plain.prior_root), _filled(new.prior_root)
        white = torch.linalg.solve_triangular(nominal, new.prior_root @ xi.mT, upper=False).mT
        gain = (_log_det(adapted) - _log_det(nominal)).unsqueeze(-1)
        return gain + _half_square(xi) - _half_square(white)


@dataclass(frozen=True)
class GuidedParticles:
    """A guide for each particle, which carries a covariance of its own: unscented particle filter [van der Merwe et al. 2000].

    Each particle's P is predicted and updated, x ~ N(x+, P+), and the ratio is p(x | parent) / N(x; x+, P+). P is that of a
    Kalman filter that knows nothing of the other particles, so the proposal is much wider than p(x | parent, y), and in several
    dimensions few particles weigh anything: GuidedNoise is cheaper and better. It costs N steps of the guide.

    Args:
        guide: the Gaussian filter; adaptations are each particle's own and shape the proposal alone.
        widen: factor on the proposal's covariance.
        points: where the z come from.

    Raises:
        ValueError: a factor that is not positive; at the first step, a transition that has no density, or states whose
            differences are not laid out as they are (quaternions).
    """

    guide: GaussianFilter
    widen: float = 1.0
    points: Points = field(default_factory=Independent)
    exact = True

    def __post_init__(self) -> None:
        _check_widen(self.widen)

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        runs, n, _ = cloud.x.shape
        if _COVARIANCE not in cloud.memory:
            _not_begun("GuidedParticles")
        if isinstance(model, AtRest):  # nothing moves, so there is nothing to propose
            return Bootstrap()(model, cloud, seen, draws)
        covariance = cloud.memory[_COVARIANCE].expand(-1, n, -1, -1)  # one for all at first
        before = _recall(cloud.memory, cloud.x, covariance)
        new = self.guide.advance(_Each(model, runs, n), before, Record(seen.y.repeat_interleave(n, 0), seen.u))
        shift, root, _ = update(new.innovation)
        z = self.points(draws).normal("guide", n, model.chart.dimension)
        step = math.sqrt(self.widen) * (root @ z.reshape(runs * n, -1, 1)).squeeze(-1)
        xi = shift + step
        x = model.chart.add(new.prior, (new.prior_root @ xi.unsqueeze(-1)).squeeze(-1)).unflatten(0, (runs, n))
        xi, scale = xi.unflatten(0, (runs, n)), _log_det(new.prior_root).unflatten(0, (runs, n))
        log_q = -_log_ratio(xi, z, _log_det(root).unflatten(0, (runs, n)), self.widen) - _half_square(xi) - scale
        log_ratio = _log_transition(model, cloud.x, x, seen.u) - log_q
        sound = torch.isfinite(new.log_like).unflatten(0, (runs, n))
        return Proposed(x, torch.where(sound, log_ratio, -torch.inf), cloud.memory | _remember(new, (runs, n)))

    def begin(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None, spread: Tensor | None
    ) -> dict[str, Tensor]:
        """Memory of a cloud that nothing has been seen of: all particles have the initial law's covariance."""
        d = model.chart.dimension
        cost = f"at every step one update of {d} states for each particle of {runs} runs: N times the cost of Guided"
        warnings.warn(f"GuidedParticles: {cost}", stacklevel=2)
        return {_COVARIANCE: self.guide.init(model, runs, draws, start, spread).covariance.unsqueeze(1)}


@dataclass(frozen=True)
class GuidedNoise:
    """The noise of each particle is drawn from its normal posterior given parent and measurement [Doucet, Godsill, Andrieu 2000].

    y = h(f(parent, w)) + v is linearised in w by the guide's rule; w ~ N(m, U U') and the ratio is p(w) / q(w), which exists
    where the transition has no density. On linear-Gaussian models it is the optimal proposal.

    Args:
        guide: the Gaussian filter whose rule linearises. It starts anew from each parent, so that it has nothing to adapt.
        shared: linearise once for each run, about the cloud's mean without noise, instead of once for each particle. That is as
            exact, since any proposal is corrected, and as good where the map is next to linear; models that are linear do so.
        widen: factor on the proposal's covariance; more than 1 guards against one that is too sure.
        points: where the z come from.

    Raises:
        ValueError: a guide with adaptations, gains or iterations; a factor that is not positive.
    """

    guide: GaussianFilter
    shared: bool = False
    widen: float = 1.0
    points: Points = field(default_factory=Independent)
    exact = True

    def __post_init__(self) -> None:
        _check_widen(self.widen)
        if self.guide.adaptations or self.guide.gains or self.guide.iterations > 1:
            raise ValueError("proposal.guide: GuidedNoise takes its rule alone; leave out adaptations, gains and iterations")

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        law = model.noise
        z = self.points(draws).normal("guide", cloud.x.shape[1], model.noise_dim)
        xi, log_det = self._posterior(model, cloud, seen, z)
        w, log_ratio = xi, _log_ratio(xi, z, log_det, self.widen)
        if not _standard(law):
            w = law.mean + law.stddev * xi
            log_ratio = log_ratio + law.log_prob(w) + _half_square(xi) + (law.stddev.log() + 0.5 * _LOG_2PI).sum()
        return Proposed(model.propagate(cloud.x, seen.u, w), log_ratio, cloud.memory, w)

    def _posterior(self, model: StateSpaceModel, cloud: Cloud, seen: Record, z: Tensor) -> tuple[Tensor, Tensor]:
        """xi = m + sqrt(widen) U z [R, N, W] and log |det U| [R, N or 1]."""
        shared = self.shared or model.linear
        x = model.chart.mean(cloud.x, weights(cloud.log_w)).unsqueeze(1) if shared else cloud.x
        y_hat, m, omega = (a.unflatten(0, x.shape[:2]) for a in self._linearised(model, x, seen.u)[:3])
        if shared:
            quiet = model.noise.mean.expand(*cloud.x.shape[:2], -1)
            y_hat = model.observation(model.propagate(cloud.x, seen.u, quiet), seen.u).mean
        there = ~torch.isnan(seen.y).unsqueeze(1)  # [R, 1, k]
        r = torch.where(there, model.residual(seen.y.unsqueeze(1), y_hat), 0.0)
        eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
        omega = torch.where(there.unsqueeze(-1) & there.unsqueeze(-2), omega, eye)
        half, ok = factor(omega)
        white = torch.linalg.solve_triangular(half, torch.where(there.unsqueeze(-1), m, 0.0), upper=False)
        # columns are all particles of a run where they share a linearisation, else each has a matrix of its own
        r, z = (a.mT.unsqueeze(1) if shared else a.unsqueeze(-1) for a in (r, z))
        score = white.mT @ torch.linalg.solve_triangular(half, r, upper=False)
        # by its information matrix, cheaper than update's QR: what it loses in digits, the ratio knows of
        eye = torch.eye(m.shape[-1], dtype=r.dtype, device=r.device)
        lower, info = torch.linalg.cholesky_ex(eye + white.mT @ white)
        ok = (ok & (info == 0) & torch.isfinite(score).all(-1).all(-1))[..., None, None]
        root = torch.linalg.solve_triangular(torch.where(ok, lower, eye).mT, eye.expand_as(lower), upper=True)
        xi = root @ (root.mT @ torch.where(ok, score, 0.0) + math.sqrt(self.widen) * z)  # not ok: the prior, which is as exact
        return xi.squeeze(1).mT if shared else xi.squeeze(-1), _log_det(root)

    def _linearised(self, model: StateSpaceModel, x: Tensor, u: Any) -> Linearised:
        """What is expected of a child of each x [R, M, D], as a map of its whitened noise; its axis of runs holds R M."""
        centre, scale = model.noise.mean, model.noise.stddev

        def through(xi: Tensor) -> tuple[Tensor, Tensor]:
            w = (centre + scale * xi).reshape(len(x), -1, xi.shape[-1])
            law = model.observation(model.propagate(x.repeat_interleave(xi.shape[1], 1), u, w), u)
            return law.mean.reshape(*xi.shape[:2], -1), _covariances(law, xi.shape)

        space = Space(model.residual, around_first(model.residual))
        return self.guide.rule(through, x.flatten(0, 1), model.noise_dim, space)


class _Each(StateSpaceModel):
    """A model to which every particle is a run of its own: what is [R N, P, ...] here is [R, N P, ...] there."""

    def __init__(self, model: StateSpaceModel, runs: int, n: int) -> None:
        super().__init__()
        self.model, self.runs, self.n = model, runs, n
        self.names, self.units, self.groups, self.noise_dim = model.names, model.units, model.groups, model.noise_dim

    @property
    def chart(self) -> Chart:
        return self.model.chart

    @property
    def noise(self) -> Distribution:
        return self.model.noise

    def initial(self, runs: int) -> Distribution:
        return self.model.initial(runs)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        inside, points = self.model.propagate(self._joined(x), u, self._joined(w)), x.shape[1]
        return inside.reshape(self.runs * self.n, points, -1)

    def noise_gain(self, u: Any) -> Tensor | None:
        gain = self.model.noise_gain(u)
        return None if gain is None else gain.expand(self.runs, -1, -1).repeat_interleave(self.n, 0)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        law = self.model.observation(self._joined(x), u)
        mean = law.mean.reshape(*x.shape[:2], -1)
        if isinstance(law, torch.distributions.MultivariateNormal):
            return dense_normal(mean, law.scale_tril.reshape(*mean.shape, -1))
        return independent_normal(mean, law.stddev.reshape(mean.shape))

    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        return self.model.residual(y, y_hat)

    def _joined(self, a: Tensor) -> Tensor:
        return a.reshape(self.runs, -1, a.shape[-1])


def _remember(new: Advance, shape: tuple[int, int]) -> dict[str, Tensor]:
    """What the guide carries from step to step, as memory of a cloud; its axis of runs is unfolded to `shape`."""
    kept = {_COVARIANCE: new.root @ new.root.mT} | {_CARRIED + name: value for name, value in new.memory.items()}
    return {name: value.unflatten(0, shape) for name, value in kept.items()}


def _recall(memory: dict[str, Tensor], mean: Tensor, covariance: Tensor) -> Gaussian:
    """The same back, about means [R, N or 1, D]."""
    carried = {k.removeprefix(_CARRIED): v.flatten(0, 1) for k, v in memory.items() if k.startswith(_CARRIED)}
    flat = mean.flatten(0, 1)
    return Gaussian(flat, covariance.flatten(0, 1), flat.new_zeros(len(flat)), carried)


def _not_begun(name: str) -> NoReturn:
    raise ValueError(f"filter.proposal: {name} must be the particle filter's own proposal, not inside another, to know its start")


def _log_ratio(xi: Tensor, z: Tensor, log_det: Tensor, widen: float) -> Tensor:
    """log N(xi; 0, I) - log q(xi) [R, N] for xi = m + sqrt(widen) U z."""
    return _half_square(z) - _half_square(xi) + log_det + 0.5 * z.shape[-1] * math.log(widen)


def _half_square(a: Tensor) -> Tensor:
    return 0.5 * (a * a).sum(-1)


def _log_det(root: Tensor) -> Tensor:
    return root.diagonal(dim1=-2, dim2=-1).abs().log().sum(-1)


def _filled(root: Tensor) -> Tensor:
    """A root in which a component without spread, a row of zeros, has 1: its coordinate stays 0, its density is left out."""
    diagonal = root.diagonal(dim1=-2, dim2=-1)
    return root + torch.diag_embed((diagonal == 0.0).to(root))


def _other_noise(model: StateSpaceModel, innovation: Innovation, x: Tensor, seen: Record) -> Tensor:
    """log N(r; 0, R as adapted) - log N(r; 0, R as the model has it), r = y - h(x) [R, N].

    Raises:
        ValueError: R was changed, and the law of what is seen is not normal.
    """
    there = innovation.seen
    both = there.unsqueeze(-1) & there.unsqueeze(-2)
    eye = torch.eye(there.shape[-1], dtype=x.dtype, device=x.device)
    noises = [torch.where(both, noise, eye) for noise in (innovation.noise, innovation.nominal)]
    if torch.equal(*noises):
        return torch.zeros_like(x[..., 0])
    law = model.observation(x, seen.u)
    normal = isinstance(law.base_dist if isinstance(law, torch.distributions.Independent) else law,
                        torch.distributions.Normal | torch.distributions.MultivariateNormal)  # fmt: skip
    if not normal:
        raise ValueError(
            f"proposal.target=adapted: the guide adapts R, but {type(model).__name__} has a law of what is seen that is not "
            "normal; choose target=nominal, or a guide that leaves R alone"
        )
    r = torch.where(there.unsqueeze(1), model.residual(seen.y.unsqueeze(1), law.mean), 0.0)
    values = []
    for noise in noises:
        root, ok = factor(noise)
        white = torch.linalg.solve_triangular(root, r.mT, upper=False)
        value = -0.5 * (white * white).sum(-2) - _log_det(root).unsqueeze(-1)
        values.append(torch.where(ok.unsqueeze(-1), value, torch.nan))
    return values[0] - values[1]


def _log_transition(model: StateSpaceModel, parents: Tensor, x: Tensor, u: Any) -> Tensor:
    """log p(x | parent) + d / 2 log 2 pi [R, N].

    Raises:
        ValueError: it does not exist, or its volume is not the chart's.
    """
    chart, gain = model.chart, model.noise_gain(u)
    if chart.size == chart.dimension and gain is not None and gain.shape[-1] == chart.dimension and _standard(model.noise):
        quiet = model.propagate(parents, u, parents.new_zeros(*parents.shape[:2], model.noise_dim))
        w = torch.linalg.solve_ex(gain, chart.subtract(x, quiet).mT)[0]
        return -0.5 * (w * w).sum(-2) - torch.linalg.slogdet(gain)[1].unsqueeze(-1)
    law = model.transition(parents, u) if chart.flat else None
    if law is None:
        raise ValueError(
            f"proposal: GuidedParticles needs the density of {type(model).__name__}'s transition, which is singular or not known "
            "in the chart; choose GuidedNoise, which works on the noise, or Guided"
        )
    return law.log_prob(x) + 0.5 * x.shape[-1] * _LOG_2PI


def _covariances(law: Distribution, shape: torch.Size) -> Tensor:
    """Of a law of R M P particles, as a rule wants it for points of this shape [R M, P, ...]; one for all where all are alike."""
    if isinstance(law, torch.distributions.MultivariateNormal):
        full = law.covariance_matrix
        return full.reshape(*shape[:2], *full.shape[-2:])
    base = law.base_dist if isinstance(law, torch.distributions.Independent) else law
    if isinstance(base, torch.distributions.Normal) and base.scale.stride(0) == 0 and base.scale.stride(1) == 0:
        return torch.diag_embed(base.scale[:1, :1].square())  # torch has expanded it
    return torch.diag_embed(law.variance.reshape(*shape[:2], -1))


def _standard(law: Distribution) -> bool:
    return isinstance(law.base_dist if isinstance(law, torch.distributions.Independent) else law, Standard)


def _check_widen(widen: float) -> None:
    if not widen > 0.0:
        raise ValueError(f"proposal.widen={widen}: give a positive factor on the covariance; 1 leaves it")
