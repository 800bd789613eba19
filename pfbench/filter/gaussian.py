"""The Gaussian filter: one prediction and one update for Kalman, extended, unscented and cubature filters."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench import native
from pfbench.covariance import common_covariance_of, covariance_of, factor, squared_length
from pfbench.draws import Draws
from pfbench.filter.belief import Gaussian, Info
from pfbench.filter.rules import Linearised, Rule, Space
from pfbench.filter.whitening import LOG_2PI
from pfbench.fusion import fusible
from pfbench.model.base import StateSpaceModel, initial_law
from pfbench.record import Record


class Innovation(NamedTuple):
    """What is seen, against what was expected of it, for an unknown xi ~ N(0, I): r = M xi + e, Cov e = Omega.

    Attributes:
        r: y - y_hat, 0 where unseen [R, k].
        seen: [R, k].
        m: [R, k, d].
        omega: without the state's own spread [R, k, k]: the measurement noise in use, and what M leaves of a curved map.
        noise: the measurement noise in use; the model's until an adaptation changes it [R, k, k], 1 where unseen.
        nominal: the model's, also of what is unseen [R, k, k].
        root: of the predicted covariance, which xi is whitened by [R, d, d].
    """

    r: Tensor
    seen: Tensor
    m: Tensor
    omega: Tensor
    noise: Tensor = torch.zeros(())
    nominal: Tensor = torch.zeros(())
    root: Tensor = torch.zeros(())

    @property
    def spread(self) -> Tensor:
        """Covariance of what is expected, for the state's spread alone [R, k, k]."""
        return self.m @ self.m.mT + (self.omega - self.noise)

    def nis(self) -> tuple[Tensor, Tensor]:
        """The normalised innovation squared and the number of components seen, each [R]."""
        return squared_length(self.r, self.m @ self.m.mT + self.omega), self.seen.sum(1)

    def with_noise(self, noise: Tensor) -> Innovation:
        """The same with another measurement noise [R, k, k]; what is unseen keeps its 1."""
        noise = torch.where(self.seen.unsqueeze(-1) & self.seen.unsqueeze(-2), noise, self.noise)
        return self._replace(omega=self.omega + (noise - self.noise), noise=noise)

    def widened(self, factor: Tensor) -> Innovation:
        """The same with the predicted covariance `factor` [R] times as large."""
        f = factor[:, None, None]
        omega = self.omega + (f - 1.0) * (self.omega - self.noise)
        return self._replace(m=self.m * f.sqrt(), omega=omega, root=self.root * f.sqrt())


class Adaptation(Protocol):
    """A change of the filter's noise, in the order in which a filter lists them. Both hooks may be the identity.

    predict_scale: the predicted state's linearisation; its Omega holds the model's own noise `noise`, and so does M in the
        columns beyond the state's where the noise went through the rule -> the same, scaled.
    noise_adapt: the innovation -> the same with another noise covariance, and what the next step must know {name: [R, ...]}.
    """

    def predict_scale(self, predicted: Linearised, belief: Gaussian) -> Linearised: ...

    def noise_adapt(self, innovation: Innovation, belief: Gaussian) -> tuple[Innovation, dict[str, Tensor]]: ...


class Gain(Protocol):
    """A change of the gain alone: the factor [R] so far on the predicted covariance -> the factor, once all noise is known."""

    def __call__(self, innovation: Innovation, factor: Tensor) -> Tensor: ...


class Advance(NamedTuple):
    """One step in full, for what builds on a Gaussian filter.

    Attributes:
        prior: predicted mean [R, D].
        prior_root: square root of the predicted covariance, as adapted [R, d, d].
        mean: updated mean [R, D].
        root: square root of the updated covariance [R, d, d], not triangular.
        innovation: as adapted; its `noise` is the measurement noise in use.
        log_like: log evidence of the step [R]; -inf where a covariance has no root.
        memory: what adaptations carry to the next step.
        trace: what the report may want {name: [R]}.
    """

    prior: Tensor
    prior_root: Tensor
    mean: Tensor
    root: Tensor
    innovation: Innovation
    log_like: Tensor
    memory: dict[str, Tensor]
    trace: dict[str, Tensor]


@dataclass(frozen=True)
class GaussianFilter:
    """Kalman filtering by statistical linearisation.

    The update is P+ = L (I + M' Omega^-1 M)^-1 L', whose middle has eigenvalues of at least 1: it stays positive for any
    prior, however ill-conditioned. A covariance with no square root marks the run `lost`; nothing is repaired in silence.

    Args:
        rule: Jacobian (EKF), or Points (unscented and cubature filters).
        adaptations: fading, constrained noise; none by default.
        gains: adaptive factor, ratio bound; none by default. They come last, in this order.
        iterations: of the update. The measurement is linearised again about the updated law: with the Jacobian this is the
            iterated EKF, Gauss-Newton [Bell and Cathey 1993], with points iterated posterior linearisation [Garcia-Fernandez
            et al. 2015]. Their number is fixed, so that runs do not wait for each other [ours].
        repair: a rule of negative weights may leave a covariance that is not one. Then what the rule found of a map's
            curvature loses its negative eigenvalues [ours], and the trace counts such `repairs`; else the run is lost.

    Raises:
        ValueError: no iterations, or several with adaptations or gains, which judge a filter by its first innovation.
    """

    rule: Rule
    adaptations: Sequence[Adaptation] = ()
    gains: Sequence[Gain] = ()
    iterations: int = 1
    repair: bool = False
    exact = False  # on nonlinear or non-Gaussian models; on linear-Gaussian ones it is the Kalman filter

    @property
    def plain(self) -> bool:
        """Nothing changes its noise or its gain: on a linear-Gaussian model it is the Kalman filter."""
        return not self.adaptations and not self.gains

    def __post_init__(self) -> None:
        if self.iterations < 1:
            raise ValueError(f"filter.iterations={self.iterations}: give 1 (no iteration) or more")
        if self.iterations > 1 and (self.adaptations or self.gains):
            raise ValueError(f"filter.iterations={self.iterations}: with adaptations or gains give 1")

    def init(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None = None, spread: Tensor | None = None
    ) -> Gaussian:
        """The moments of the initial law."""
        law: Any = initial_law(model, runs, spread)
        origin = model.origin.expand(runs, -1) if start is None else start
        mean = model.chart.add(origin, law.mean)
        return Gaussian(mean, covariance_of(law), torch.zeros(runs, dtype=torch.float64, device=mean.device))

    def step(self, model: StateSpaceModel, belief: Gaussian, seen: Record, draws: Draws) -> tuple[Gaussian, Info]:
        """The belief at t-1 and what is seen at t -> the belief at t."""
        new = self.advance(model, belief, seen)
        covariance = new.root @ new.root.mT
        info = Info(new.mean, covariance.diagonal(dim1=-2, dim2=-1), lambda: covariance, new.trace, nis=new.innovation.nis)
        return Gaussian(new.mean, covariance, belief.log_z + new.log_like, new.memory), info

    def advance(self, model: StateSpaceModel, belief: Gaussian, seen: Record) -> Advance:
        """The same, with all that it took."""
        memory: dict[str, Tensor] = {}
        predicted, rooted = self.predict(model, belief, seen.u)
        for adaptation in self.adaptations:
            predicted = adaptation.predict_scale(predicted, belief)
        covariance = predicted.m @ predicted.m.mT
        omega, mended = self._mended(predicted.omega, predicted.noise, covariance)
        root, positive = factor(covariance + omega)
        innovation = self._look(model, lambda xi: model.chart.add(predicted.y.unsqueeze(1), xi @ root.mT), predicted.y, seen)
        innovation = innovation._replace(root=root)
        for adaptation in self.adaptations:
            innovation, carried = adaptation.noise_adapt(innovation, belief)
            memory |= carried
        trace = {name: value if value.dim() == 1 else value.amax(1) for name, value in memory.items() if value.dim() <= 2}
        if self.gains:
            widening = torch.ones_like(belief.mean[:, 0])
            for gain in self.gains:
                widening = gain(innovation, widening)
            innovation, trace["widening"] = innovation.widened(widening), widening
        shift, updated, log_like, mended_too, innovation = self._update(model, predicted.y, innovation, seen)
        if self.repair:
            trace["repairs"] = mended.to(root) + mended_too.to(root)
        mean = model.chart.add(predicted.y, (innovation.root @ shift.unsqueeze(-1)).squeeze(-1))
        log_like = torch.where(rooted & positive & torch.isfinite(log_like), log_like, -torch.inf)
        return Advance(predicted.y, innovation.root, mean, innovation.root @ updated, innovation, log_like, memory, trace)

    def predict(self, model: StateSpaceModel, belief: Gaussian, u: Any) -> tuple[Linearised, Tensor]:
        """The step as the rule sees it, in coordinates whitened by the belief's root, and whether there is a root [R]."""
        chart, d = model.chart, model.chart.dimension
        root, ok = factor(belief.covariance)
        law = model.noise
        gain = model.noise_gain(u)
        inner = 0 if gain is not None else model.noise_dim

        def through(xi: Tensor) -> tuple[Tensor, Tensor]:
            x = chart.add(belief.mean.unsqueeze(1), xi[..., :d] @ root.mT)
            if gain is None:
                w = law.mean + law.stddev * xi[..., d:]
                return model.propagate(x, u, w), xi.new_zeros(1, 1, d, d)
            sized = gain * law.stddev
            return model.propagate(x, u, law.mean.expand(*x.shape[:2], -1)), (sized @ sized.mT).unsqueeze(1)

        return self.rule(through, belief.mean, d + inner, Space(chart.subtract, chart.mean)), ok

    def _look(self, model: StateSpaceModel, place: Callable[[Tensor], Tensor], like: Tensor, seen: Record) -> Innovation:
        """The innovation for states place(xi), xi [R, P, d]."""

        def through(xi: Tensor) -> tuple[Tensor, Tensor]:
            law: Any = model.observation(place(xi), seen.u)
            return law.mean, common_covariance_of(law)

        space = Space(model.residual, around_first(model.residual))
        y_hat, m, omega, noise = self.rule(through, like, model.chart.dimension, space)
        there = ~torch.isnan(seen.y)
        r = torch.where(there, model.residual(seen.y, y_hat), 0.0)
        both = there.unsqueeze(-1) & there.unsqueeze(-2)
        eye = torch.eye(r.shape[-1], dtype=r.dtype, device=r.device)
        m, omega, used = torch.where(there.unsqueeze(-1), m, 0.0), torch.where(both, omega, eye), torch.where(both, noise, eye)
        return Innovation(r, there, m, omega, used, noise)

    def _update(
        self, model: StateSpaceModel, mean: Tensor, innovation: Innovation, seen: Record
    ) -> tuple[Tensor, Tensor, Tensor, Tensor, Innovation]:
        """As `update`, then which runs were mended [R], and the innovation used last."""
        innovation, mended = self._positive(innovation)
        shift, updated, log_like = update(innovation)
        for _ in range(self.iterations - 1):
            innovation, also = self._positive(self._look_again(model, mean, innovation.root, shift, updated, seen))
            shift, updated, log_like = update(innovation)
            mended = mended | also
        return shift, updated, log_like, mended, innovation

    def _look_again(
        self, model: StateSpaceModel, mean: Tensor, root: Tensor, shift: Tensor, updated: Tensor, seen: Record
    ) -> Innovation:
        """The innovation linearised about the updated law N(shift, updated updated') of xi, in the same coordinates."""

        def place(xi: Tensor) -> Tensor:
            return model.chart.add(mean.unsqueeze(1), (shift.unsqueeze(1) + xi @ updated.mT) @ root.mT)

        again = self._look(model, place, mean, seen)
        m = torch.linalg.solve_triangular(updated, again.m, upper=True, left=False)
        return again._replace(m=m, r=again.r + (m @ shift.unsqueeze(-1)).squeeze(-1), root=root)

    def _positive(self, innovation: Innovation) -> tuple[Innovation, Tensor]:
        # what M sees needs no root, but with it goes the whole law of state and measurement: Omega alone must be positive
        omega, mended = self._mended(innovation.omega, innovation.noise, torch.zeros_like(innovation.omega))
        return innovation._replace(omega=omega), mended

    def _mended(self, omega: Tensor, noise: Tensor, rest: Tensor) -> tuple[Tensor, Tensor]:
        """Omega such that Omega + rest has a square root, and which runs it had to be changed in [R]."""
        if not self.repair:
            return omega, omega.new_zeros(len(omega), dtype=torch.bool)
        bad = ~factor(rest + omega)[1]
        if not bad.is_cuda and not bool(bad.any()):  # looking costs next to nothing on the CPU
            return omega, bad
        size = torch.sqrt((omega.diagonal(dim1=-2, dim2=-1).abs() + rest.diagonal(dim1=-2, dim2=-1)).clamp(min=1e-300))
        scale = size.unsqueeze(-1) * size.unsqueeze(-2)
        left = (omega - noise) / scale
        whole = torch.isfinite(left).all(-1).all(-1)[:, None, None]  # eigh raises for all runs where one has no numbers
        values, vectors = torch.linalg.eigh(torch.where(whole, left, 0.0))
        left = (vectors * values.clamp(min=0.0).unsqueeze(-2)) @ vectors.mT
        return torch.where(bad[:, None, None] & whole, noise + left * scale, omega), bad


def update(innovation: Innovation) -> tuple[Tensor, Tensor, Tensor]:
    """Whitened posterior: mean [R, d], square root [R, d, d] and log evidence of the step [R] (NaN where there is no root)."""
    r, seen, m, omega, *_ = innovation
    shift, root, distance, scales, ok = _updated(m, r, omega)
    # int64 times a float is float32
    log_like = -0.5 * distance - scales.abs().log().sum(-1) - 0.5 * LOG_2PI * seen.sum(-1, dtype=r.dtype)
    return shift, root, torch.where(ok, log_like, torch.nan)


def _separate_update(m: Tensor, r: Tensor, omega: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """As native.updated."""
    root, ok = factor(omega)
    white = torch.linalg.solve_triangular(root, torch.cat([m, r.unsqueeze(-1)], -1), upper=False)  # Omega^-1/2 [M r]
    d = m.shape[-1]
    eye = torch.eye(d, dtype=m.dtype, device=m.device).expand(m.shape[0], -1, -1)
    information, score, distance = _least_squares(white, eye)
    back = torch.linalg.solve_triangular(information, torch.cat([score, eye], -1), upper=True)
    scales = torch.cat([part.diagonal(dim1=-2, dim2=-1) for part in (root, information)], -1)
    return back[..., 0], back[..., 1:], distance, scales, ok


_updated = fusible(_separate_update, by_hand=native.updated, compiles=False)


def _least_squares(white: Tensor, eye: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Of |A x - b|^2 + |x|^2, [A b] = `white`: root R of I + A' A, R'^-1 A' b [R, d, 1], and the minimum [R].

    By QR: forming I + A' A would drown the 1 of a prior 1e8 times as wide as the measurement's noise.
    """
    d = eye.shape[-1]
    if not (white.requires_grad and torch.is_grad_enabled()):
        upper, least = _triangle(white)
        return upper[..., :d], upper[..., d:], least
    # a gradient needs Q, and a triangle without zeros on its diagonal, where what was seen may be just what was expected
    a, b = white[..., :d], white[..., d:]
    q, information = torch.linalg.qr(torch.cat([a, eye], -2))
    score = q[:, : a.shape[-2]].mT @ b
    sign = torch.where(information.diagonal(dim1=-2, dim2=-1) < 0, -1, 1).to(information).unsqueeze(-1)
    information, score = sign * information, sign * score
    best = torch.linalg.solve_triangular(information, score, upper=True)
    return information, score, (a @ best - b).square().sum((1, 2)) + best.square().sum((1, 2))


def _triangle(white: Tensor) -> tuple[Tensor, Tensor]:
    """[A b] [R, K, D + 1] on top of [I 0] as a triangle [R, D, D + 1] with a positive diagonal, and the square left of b [R]."""
    d = white.shape[-1] - 1
    below = torch.eye(d, d + 1, dtype=white.dtype, device=white.device).expand(white.shape[0], -1, -1)
    whole = torch.linalg.qr(torch.cat([white, below], -2), mode="r")[1]
    # QR leaves the signs of its rows to rounding; draws by such a root would depend on the batch that they are in
    sign = torch.where(whole.diagonal(dim1=-2, dim2=-1)[:, :d] < 0, -1, 1).to(whole).unsqueeze(-1)
    return sign * whole[:, :d], whole[:, d, d].square()


def around_first(residual: Callable[[Tensor, Tensor], Tensor]) -> Callable[[Tensor, Tensor], Tensor]:
    """Weighted mean of values that may wrap: average their residuals to the first one."""

    def mean(y: Tensor, w: Tensor) -> Tensor:
        return y[:, 0] + (w.unsqueeze(-1) * residual(y, y[:, :1])).sum(1)

    return mean
