"""Corrections of a reconstructed cloud: what is moved how, and what becomes of the weights.

As printed the weights do not know of the shift, and the filter is exact for another model, in which the data count twice
[particle filter with state reconstruction by Dynamic Matrix Control; Akyildiz and Miguez 2020]; the corrections are ours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from pfbench.draws import Draws
from pfbench.filter.belief import Cloud, weights
from pfbench.filter.control import Control, positions
from pfbench.filter.defensive import Affine, Kept, check_fraction, kept
from pfbench.filter.linearisation import innovation, quiet, sight, times
from pfbench.filter.particle import bury
from pfbench.filter.proposals import Proposed
from pfbench.filter.whitening import half_square
from pfbench.model.base import AtRest, StateSpaceModel
from pfbench.record import Record


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
        x, log_ratio = sound(sent, cloud)
        w = weights(cloud.log_w + log_ratio)
        centre = x if self.local else model.chart.mean(x, w).unsqueeze(1)
        gain = control.gain(model, cloud, seen, sight(model, centre, seen))
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
        check_fraction("correction.keep", self.keep)

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, seen: Record, sent: Proposed, control: Control, draws: Draws
    ) -> Proposed:
        if isinstance(model, AtRest):  # there is no transition in this step
            return sent
        chart, factor_of_noise = model.chart, model.noise_gain(seen.u)
        if factor_of_noise is None:
            name = type(model).__name__
            raise ValueError(f"correction Density: the noise of {name} is not additive; choose Marginal or ReconstructedNoise")
        still, w = undisturbed(model, cloud, seen)
        centre = still if self.local else chart.mean(still, w).unsqueeze(1)
        x, log_ratio = sound(sent, cloud)
        sized = factor_of_noise * model.noise.stddev
        whiten, colour = _basis(sized @ sized.mT)
        h = sight(model, centre, seen)
        pull = whiten.unsqueeze(1) @ control.gain(model, cloud, seen, h)
        affine = Affine(_less(pull @ h @ colour.unsqueeze(1)), times(pull, innovation(model, still, seen)))
        xi = chart.subtract(x, still)
        a = xi @ whiten.mT
        staying = kept_of(self.keep, cloud.log_w + log_ratio, draws)
        new, ratio = affine.sent(a, staying, lambda e: -half_square(e))
        moved = chart.add(still, xi + (new - a) @ colour.mT)
        return Proposed(unless(staying, x, moved), log_ratio + ratio, sent.memory)


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
        check_fraction("correction.keep", self.keep)

    def __call__(
        self, model: StateSpaceModel, cloud: Cloud, seen: Record, sent: Proposed, control: Control, draws: Draws
    ) -> Proposed:
        x, log_ratio = sound(sent, cloud)
        w = weights(cloud.log_w + log_ratio)
        middle = model.chart.mean(x, w).unsqueeze(1)
        xi, h = model.chart.subtract(x, middle), sight(model, middle, seen)
        o = times(h, xi)
        heavy = w.unsqueeze(-1) * o
        whiten, colour = _basis(heavy.mT @ o)
        pull = whiten @ h[:, 0] @ control.gain(model, cloud, seen, h)[:, 0]  # [R, Dy, Dy]
        affine = Affine(_less(pull @ colour).unsqueeze(1), innovation(model, middle, seen) @ pull.mT)
        staying, a = kept_of(self.keep, cloud.log_w + log_ratio, draws), o @ whiten.mT
        new, ratio = affine.sent(a, staying, lambda e: -half_square(e))
        shift = (new - a) @ (whiten @ heavy.mT @ xi)
        return Proposed(unless(staying, x, model.chart.add(x, shift)), log_ratio + ratio, sent.memory)


def kept_of(share: float, log_w: Tensor, draws: Draws) -> Kept | None:
    """Who of the particles with these weights [R, N] is not shifted; None where nobody is asked to stay."""
    return kept(share, torch.isfinite(log_w), draws, "reconstruction.keep") if share > 0.0 else None


def unless(staying: Kept | None, old: Tensor, new: Tensor) -> Tensor:
    """[R, N, ...]: old where kept."""
    return new if staying is None else torch.where(staying.who.unsqueeze(-1), old, new)


def undisturbed(model: StateSpaceModel, cloud: Cloud, seen: Record) -> tuple[Tensor, Tensor]:
    """The noise-free prediction of each particle [R, N, D], and weights [R, N]: 0 where it is not finite."""
    x, log_w = bury(model.propagate(cloud.x, seen.u, quiet(model, cloud.x)), cloud.log_w, cloud.x)
    return x, weights(log_w)


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


def sound(sent: Proposed, cloud: Cloud) -> tuple[Tensor, Tensor]:
    """Particles and ratio; one that is not finite stays where its parent was and weighs nothing, before it spoils a sum."""
    return bury(sent.x, sent.log_ratio, cloud.x)


def _less(a: Tensor) -> Tensor:
    """I - a"""
    return torch.eye(a.shape[-1], dtype=a.dtype, device=a.device) - a
