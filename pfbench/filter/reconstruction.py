"""State reconstruction: particles are shifted towards what was seen by the control law of Dynamic Matrix Control (DMC).

The states are taken as outputs of a plant with inputs U, x = x~ + B dU, of which A tells the response of what is seen. The inputs
that trade the error of the outputs against their own size are dU = (A'QA + R)^-1 A'Q (y - y~) [particle filter with state
reconstruction by Dynamic Matrix Control, eqs 21 to 28; Cutler and Ramaker 1980]. As printed the weights do not know of the shift,
and the filter is exact for another model, in which the data count twice [Akyildiz and Miguez 2020]; the corrections are ours.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor
from torch.autograd import forward_ad

from pfbench.covariance import factor
from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, weights
from pfbench.filter.particle import bury
from pfbench.filter.proposals import Bootstrap, Proposal, Proposed
from pfbench.model.base import AtRest, StateSpaceModel
from pfbench.record import Record


class Response(Protocol):
    """How what is seen answers to the inputs: H [R, P, Dy, d] -> A [R, P, Dy, d] and what the inputs do to the state B [d]."""

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, h: Tensor) -> tuple[Tensor, Tensor]: ...


@dataclass(frozen=True)
class Static:
    """A = H B with B = I: the answer at once. A state that the measurement does not see is not shifted [ours].

    The paper's B leaves out the azimuth, which H does not see either: the shift is the same.
    """

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, h: Tensor) -> tuple[Tensor, Tensor]:
        return h, h.new_ones(h.shape[-1])


@dataclass(frozen=True)
class Step:
    """A = H Phi B, Phi the linearised transition of one interval: the answer after it, which reaches unseen states too [ours].

    Args:
        held: names of the states without an input of their own, such as the azimuth.
        units: one unit of each state's input in SI units, all 1 if None. They decide how far each state is shifted.

    Raises:
        ValueError: a name that is not a state's; as many units as there are not states.
    """

    held: Sequence[str] = ()
    units: Sequence[float] | None = None

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, h: Tensor) -> tuple[Tensor, Tensor]:
        chart, d = model.chart, model.chart.dimension
        if self.units is not None and len(self.units) != d:
            raise ValueError(f"response.units: {len(self.units)} of them, but this model has {d} states; give one for each")
        b = h.new_ones(d) if self.units is None else h.new_tensor(list(self.units))
        b[positions(model, "response.held", self.held)] = 0.0
        centre = chart.mean(cloud.x, weights(cloud.log_w)).unsqueeze(1)
        origin = centre.expand(-1, d, -1)
        quiet = model.noise.mean.expand(h.shape[0], d, model.noise_dim)
        end = model.propagate(origin, seen.u, quiet)
        phi = derivative(lambda xi: chart.subtract(model.propagate(chart.add(origin, xi), seen.u, quiet), end), centre, d)
        return h @ phi * b, b


@dataclass(frozen=True)
class Control:
    """The weights of the quadratic index, for all alike or one by one, and the response.

    Args:
        error_weight: diagonal of Q, [Dy] or one number; 1 [eq. 32].
        control_weight: diagonal of R, [d] or one number; 10 [eq. 33]. Only with both in the measurement's units do they mean
            something: R / Q = 10 is a gain of 1/11 on a state that is measured itself.
        response: A and B.

    Raises:
        ValueError: a weight that is not positive; at the first step, as many as there are not measurements or states.
    """

    error_weight: float | Sequence[float] = 1.0
    control_weight: float | Sequence[float] = 10.0
    response: Response = field(default_factory=Static)

    def __post_init__(self) -> None:
        for name, value in (("error_weight", self.error_weight), ("control_weight", self.control_weight)):
            if not bool((torch.as_tensor(value) > 0).all()):
                raise ValueError(f"control.{name}={value}: give positive weights")

    def gain(self, model: StateSpaceModel, cloud: Cloud, seen: Record, h: Tensor) -> Tensor:
        """K = B (A'QA + R)^-1 A'Q for H [R, P, Dy, d], its rows 0 where nothing was seen -> [R, P, d, Dy]."""
        a, b = self.response(model, cloud, seen, h)
        tolerance = 1.0 / _one_each("error_weight", self.error_weight, h, h.shape[-2])
        cheap = (a / _one_each("control_weight", self.control_weight, h, h.shape[-1])).mT  # R^-1 A'
        inner = torch.linalg.solve_ex(a @ cheap + torch.diag(tolerance), cheap.mT)[0]  # push-through: Dy equations, not d
        return b.unsqueeze(-1) * inner.mT


class Correction(Protocol):
    """What is moved how, and what becomes of the weights: the base's particles -> the reconstructed ones."""

    @property
    def exact(self) -> bool: ...

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, seen: Record, sent: Proposed, control: Control, draws: Draws
    ) -> Proposed: ...


@dataclass(frozen=True)
class Uncorrected:
    """x~ + K (y - h(x~)), weights as if nothing had been moved: as printed. It does not converge to the posterior.

    Args:
        local: the measurement is linearised at each particle; else once at their mean, which costs less and is the same where
            the measurement is linear.
        regressed: names of states that follow the shift of all others by their regression in the cloud, which worsens the
            azimuth; none as printed [ours].
    """

    local: bool = True
    regressed: Sequence[str] = ()
    exact = False

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, seen: Record, sent: Proposed, control: Control, draws: Draws
    ) -> Proposed:
        x, log_ratio = _sound(sent, cloud)
        w = weights(cloud.log_w + log_ratio)
        centre = x if self.local else model.chart.mean(x, w).unsqueeze(1)
        gain = control.gain(model, cloud, seen, slope(model, centre, seen))
        shift = times(gain, innovation(model, x, seen))
        if self.regressed:
            shift = _followed(model, x, w, shift, positions(model, "correction.regressed", self.regressed))
        return Proposed(model.chart.add(x, shift), log_ratio, sent.memory)


@dataclass(frozen=True)
class Density:
    """The ratio of transition densities where the shift leads and where it came from. Needs additive noise [ours].

    The shift is that of x = f (+) xi, f the noise-free prediction of each particle's parent: xi -> xi + K (y - h(f) - H xi),
    affine, so that its Jacobian is known, also of a nonlinear measurement. A singular transition has a density on the span of
    its noise, and what of the shift leaves that span is not carried out. Exact, but useful only where the noise is wide: make
    the model's own noise wide, for all filters alike, rather than this filter's.

    Args:
        keep: fraction that is not shifted; weights are then at most 1/keep times the likelihood.
        local: as for Uncorrected, but at the noise-free predictions.

    Raises:
        ValueError: at the first step, a model whose noise is not additive.
    """

    keep: float = 0.0
    local: bool = True
    exact = True

    def __post_init__(self) -> None:
        _check_fraction("correction.keep", self.keep)

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, seen: Record, sent: Proposed, control: Control, draws: Draws
    ) -> Proposed:
        if isinstance(model, AtRest):  # there is no transition in this step
            return sent
        chart, factor_of_noise = model.chart, model.noise_gain(seen.u)
        if factor_of_noise is None:
            name = type(model).__name__
            raise ValueError(f"correction Density: the noise of {name} is not additive; choose Marginal or ReconstructedNoise")
        still, w = _quiet(model, cloud, seen)
        centre = still if self.local else chart.mean(still, w).unsqueeze(1)
        x, log_ratio = _sound(sent, cloud)
        sized = factor_of_noise * model.noise.stddev
        whiten, colour = _basis(sized @ sized.mT)
        h = slope(model, centre, seen)
        pull = whiten.unsqueeze(1) @ control.gain(model, cloud, seen, h)
        affine = Affine(_eye(colour) - pull @ h @ colour.unsqueeze(1), times(pull, innovation(model, still, seen)))
        xi = chart.subtract(x, still)
        a = xi @ whiten.mT
        kept, share = chosen(self.keep, a, draws)
        new, back = affine.moved(a, kept)
        moved = chart.add(still, xi + (new - a) @ colour.mT)
        ratio = mixed(_log_standard(new), _log_standard(back), affine.log_det, share)
        return Proposed(_unless(kept, x, moved), log_ratio + ratio, sent.memory)


@dataclass(frozen=True)
class Marginal:
    """A defensive mixture: a fraction stays, the rest is shifted; ratio of the normal laws fitted to the cloud [ours].

    Seen from the predicted mean, o = H xi. The shift o -> o + H K (y - y_hat - o) takes the whole state along by its
    regression on o in the cloud, which leaves what o does not tell as it is; then log w = log p(y | x) + log p(o') -
    log(keep p(o') + (1 - keep) q(o')), p the normal law fitted to o and q the one of what is shifted. Right as far as the
    predicted cloud is normal, as it is on linear-Gaussian models; elsewhere an approximation. A shift to where the cloud has no
    spread weighs nothing, and no weight exceeds 1/keep times the likelihood.

    Args:
        keep: eps, the fraction that stays; who does is drawn afresh in each step, since neighbours in a resampled cloud are
            siblings. 1 makes it the base itself.
    """

    keep: float = 0.5
    exact = False

    def __post_init__(self) -> None:
        _check_fraction("correction.keep", self.keep)

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, seen: Record, sent: Proposed, control: Control, draws: Draws
    ) -> Proposed:
        x, log_ratio = _sound(sent, cloud)
        w = weights(cloud.log_w + log_ratio)
        middle = model.chart.mean(x, w).unsqueeze(1)
        xi, h = model.chart.subtract(x, middle), slope(model, middle, seen)
        o = times(h, xi)
        heavy = w.unsqueeze(-1) * o
        whiten, colour = _basis(heavy.mT @ o)
        pull = whiten @ h[:, 0] @ control.gain(model, cloud, seen, h)[:, 0]  # [R, Dy, Dy]
        affine = Affine((_eye(colour) - pull @ colour).unsqueeze(1), innovation(model, middle, seen) @ pull.mT)
        kept, share = chosen(self.keep, o, draws)
        a = o @ whiten.mT
        new, back = affine.moved(a, kept)
        shift = (new - a) @ (whiten @ heavy.mT @ xi)
        moved = _unless(kept, x, model.chart.add(x, shift))
        ratio = mixed(_log_standard(new), _log_standard(back), affine.log_det, share)
        return Proposed(moved, log_ratio + ratio, sent.memory)


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
        _check_fraction("proposal.keep", self.keep)

    @property
    def exact(self) -> bool:
        return self.base.exact

    def __call__(self, model: StateSpaceModel, cloud: Cloud, seen: Record, draws: Draws) -> Proposed:
        sent, law = self.base(model, cloud, seen, draws), model.noise
        if sent.w is None:
            raise ValueError(f"proposal.base: {type(self.base).__name__} does not tell its noise; choose Bootstrap")
        affine = self._posterior(model, cloud, seen)
        kept, share = chosen(self.keep, sent.w, draws)
        new, back = affine.moved((sent.w - law.mean) / law.stddev, kept)
        w = _unless(kept, sent.w, law.mean + law.stddev * new)
        ratio = mixed(law.log_prob(w), law.log_prob(law.mean + law.stddev * back), affine.log_det, share)
        return Proposed(model.propagate(cloud.x, seen.u, w), sent.log_ratio + ratio, sent.memory, w)

    def _posterior(self, model: StateSpaceModel, cloud: Cloud, seen: Record) -> Affine:
        """Standardised noise to its posterior, given what is seen."""
        chart, law = model.chart, model.noise
        still, w = _quiet(model, cloud, seen)
        gain = model.noise_gain(seen.u)
        if gain is not None:
            centre = still if self.local else chart.mean(still, w).unsqueeze(1)
            a = slope(model, centre, seen) @ (gain * law.stddev).unsqueeze(1)
        else:
            parent = cloud.x if self.local else chart.mean(cloud.x, w).unsqueeze(1)
            centre = model.propagate(parent, seen.u, law.mean.expand(*parent.shape[:2], -1))
            a = _noise_slope(model, parent, seen)
        a, r = _whitened(model, centre, seen, a, innovation(model, still, seen))
        precision = a.mT @ a + _eye(a)
        root = torch.linalg.cholesky_ex(precision)[0]
        half = torch.linalg.solve_triangular(root, _eye(a), upper=False).mT  # half half' = P
        covariance = half @ half.mT
        return Affine(half if self.stochastic else covariance, times(covariance, times(a.mT, r)))


class Affine(NamedTuple):
    """e -> matrix e + offset: matrix [R, 1 or N, k, k], offset [R, 1 or N, k]."""

    matrix: Tensor
    offset: Tensor

    @property
    def log_det(self) -> Tensor:
        """log |det matrix| [R, 1 or N]."""
        return torch.linalg.slogdet(self.matrix)[1]

    def moved(self, e: Tensor, kept: Tensor | None) -> tuple[Tensor, Tensor]:
        """Where e [R, N, k] goes, unless kept [R, N, 1]; and what this map would have had to come from to get there."""
        new = times(self.matrix, e) + self.offset
        if kept is None:
            return new, e
        back = times(torch.linalg.inv_ex(self.matrix)[0], e - self.offset)
        return torch.where(kept, e, new), torch.where(kept, back, e)


def chosen(share: float, like: Tensor, draws: Draws) -> tuple[Tensor | None, float]:
    """Who is kept, bool [R, N, 1] or None for nobody, and the fraction that this is of N: exact, by a fresh random order."""
    n = like.shape[1]
    count = round(share * n)
    if count == 0:
        return None, 0.0
    order = draws.uniform("reconstruction.keep", n, 1).argsort(1)
    return order.argsort(1) < count, count / n


def mixed(log_new: Tensor, log_back: Tensor, log_det: Tensor, share: float) -> Tensor:
    """log p(new) - log q(new) [R, N] for q = share p + (1 - share) (p moved by the map), p(new) and p(back) being given."""
    stay, go = (math.log(part) if part > 0.0 else -math.inf for part in (share, 1.0 - share))
    return log_new - torch.logaddexp(log_new + stay, log_back - log_det + go)


def times(m: Tensor, e: Tensor) -> Tensor:
    """Matrices [R, 1 or N, k, l] times vectors [R, 1 or N, l] -> [R, N, k]."""
    return e @ m[:, 0].mT if m.shape[1] == 1 else (m @ e.unsqueeze(-1)).squeeze(-1)


def derivative(f: Callable[[Tensor], Tensor], like: Tensor, d: int) -> Tensor:
    """Derivative at 0 of f: xi [R, P d, d] -> [R, P d, m], point by point, for like [R, P, ...] -> [R, P, m, d]."""
    runs, points = like.shape[:2]
    directions = torch.eye(d, dtype=like.dtype, device=like.device).repeat(runs, points, 1)
    with forward_ad.dual_level():
        value, slopes = forward_ad.unpack_dual(f(forward_ad.make_dual(torch.zeros_like(directions), directions)))
    slopes = torch.zeros_like(value) if slopes is None else slopes  # it does not depend on xi
    return slopes.unflatten(1, (points, d)).mT


def slope(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """H [R, P, Dy, d], derivative in the chart of what is seen of x [R, P, D]; rows 0 where nothing was seen."""
    d = model.chart.dimension
    repeated = x.repeat_interleave(d, 1)
    h = derivative(lambda xi: _mean(model.observation(model.chart.add(repeated, xi), seen.u)), x, d)
    return torch.where(torch.isnan(seen.y)[:, None, :, None], 0.0, h)


def innovation(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """y - y_hat of x [R, N, D] -> [R, N, Dy]; 0 where nothing was seen."""
    y = seen.y.unsqueeze(1)
    return torch.where(torch.isnan(y), 0.0, model.residual(y.nan_to_num(), _mean(model.observation(x, seen.u))))


def positions(model: StateSpaceModel, key: str, names: Sequence[str]) -> list[int]:
    """Of the states of these names.

    Raises:
        ValueError: a name that is not a state's.
    """
    unknown = [name for name in names if name not in model.names]
    if unknown:
        raise ValueError(f"{key}={list(names)}: {unknown} are not among the states {list(model.names)}")
    return [model.names.index(name) for name in names]


def _noise_slope(model: StateSpaceModel, x: Tensor, seen: Record) -> Tensor:
    """Derivative of what is seen after x [R, P, D] with respect to the standardised noise, at its mean: [R, P, Dy, W]."""
    law, repeated = model.noise, x.repeat_interleave(model.noise_dim, 1)

    def ahead(xi: Tensor) -> Tensor:
        return _mean(model.observation(model.propagate(repeated, seen.u, law.mean + law.stddev * xi), seen.u))

    a = derivative(ahead, x, model.noise_dim)
    return torch.where(torch.isnan(seen.y)[:, None, :, None], 0.0, a)


def _whitened(model: StateSpaceModel, x: Tensor, seen: Record, a: Tensor, r: Tensor) -> tuple[Tensor, Tensor]:
    """R_v^-1/2 A and R_v^-1/2 r for the measurement's covariance at x [R, P, D]; an infinite variance tells nothing."""
    law: Any = model.observation(x, seen.u)
    if not isinstance(law, torch.distributions.MultivariateNormal):
        scale = law.variance.rsqrt()
        return scale.unsqueeze(-1) * a, scale * r
    there = ~torch.isnan(seen.y).unsqueeze(1)
    both = there.unsqueeze(-1) & there.unsqueeze(-2)
    root = factor(torch.where(both, law.covariance_matrix, _eye(law.covariance_matrix)))[0]
    white = torch.linalg.solve_triangular(root, a, upper=False)
    return white, times(torch.linalg.inv_ex(root)[0], r)


def _basis(covariance: Tensor) -> tuple[Tensor, Tensor]:
    """W and C [R, k, k], W S W' = 1 and C W = 1 where S has a spread; where it has none, W's rows and C's columns are 0."""
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    sd = torch.where(variance > 0.0, variance, 1.0).sqrt()
    correlation = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    values, vectors = torch.linalg.eigh(torch.nan_to_num(correlation, 0.0, 0.0, 0.0))
    wide = values > torch.finfo(values.dtype).eps ** (2 / 3)
    root = torch.where(wide, values, torch.inf).sqrt()
    spread = torch.where(wide, values, 0.0).sqrt()
    return (vectors / root.unsqueeze(-2)).mT / sd.unsqueeze(-2), sd.unsqueeze(-1) * vectors * spread.unsqueeze(-2)


def _followed(model: StateSpaceModel, x: Tensor, w: Tensor, shift: Tensor, after: list[int]) -> Tensor:
    """The shift [R, N, d] of the states `after` replaced by their regression, in the weighted cloud, on that of all others."""
    d = model.chart.subtract(x, model.chart.mean(x, w).unsqueeze(1))
    covariance = (w.unsqueeze(-1) * d).mT @ d
    first = [i for i in range(d.shape[-1]) if i not in after]
    whiten, _ = _basis(covariance[:, first][:, :, first])
    follow = shift[..., first] @ (whiten.mT @ whiten @ covariance[:, first][:, :, after])
    return shift.index_copy(-1, torch.tensor(after, device=shift.device), follow)


def _sound(sent: Proposed, cloud: Cloud) -> tuple[Tensor, Tensor]:
    """Particles and ratio; one that is not finite stays where its parent was and weighs nothing, before it spoils a sum."""
    return bury(sent.x, sent.log_ratio, cloud.x)


def _unless(kept: Tensor | None, old: Tensor, new: Tensor) -> Tensor:
    return new if kept is None else torch.where(kept, old, new)


def _eye(like: Tensor) -> Tensor:
    return torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)


def _quiet(model: StateSpaceModel, cloud: Cloud, seen: Record) -> tuple[Tensor, Tensor]:
    """The noise-free prediction of each particle [R, N, D], and weights [R, N]: 0 where it is not finite."""
    still = model.propagate(cloud.x, seen.u, model.noise.mean.expand(*cloud.x.shape[:2], -1))
    still, log_w = bury(still, cloud.log_w, cloud.x)
    return still, weights(log_w)


def _mean(law: Any) -> Tensor:
    value: Tensor = law.mean
    return value


def _log_standard(e: Tensor) -> Tensor:
    """log N(e; 0, 1) but for a constant: [..., k] -> [...]."""
    return -0.5 * e.square().sum(-1)


def _one_each(name: str, value: float | Sequence[float], like: Tensor, n: int) -> Tensor:
    numbers = torch.as_tensor(value).to(like)
    if numbers.numel() not in (1, n):
        raise ValueError(f"control.{name}: {numbers.numel()} numbers, but {n} are needed here; give these or one for all")
    return numbers.expand(n)


def _check_fraction(name: str, value: float) -> None:
    if not 0.0 <= value <= 1.0:
        raise ValueError(f"{name}={value}: give a fraction from 0 to 1")
