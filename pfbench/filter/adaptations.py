"""Gaussian filters that doubt their noise: fading memory, noise constrained by what is seen.

The equations of the paper behind these [COFM-AMSSRCPF 2024, Measurement and Control] are known from its prose alone; what it
leaves open is marked.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from pfbench.filter.belief import Gaussian
from pfbench.filter.gaussian import Innovation, update
from pfbench.filter.principal_axes import Axes, check_share, diagonal, precision, principal
from pfbench.filter.rules import Linearised


@dataclass(frozen=True)
class Fading:
    """Fading memory: P- = S C_f + Q, C_f the spread carried over from the last step [Tarn and Zaborszky 1970].

    Of a state that does not move it makes weighted least squares with weights S^-(k - j), a memory of about 1 / ln S steps.

    Args:
        factor: S. Some libraries call S^2 what is S here.

    Raises:
        ValueError: S below 1, which would claim to know what it does not.
    """

    factor: float = 1.002

    def __post_init__(self) -> None:
        if not self.factor >= 1.0:
            raise ValueError(f"Fading.factor={self.factor}: give 1 (no fading) or more")

    def predict_scale(self, predicted: Linearised, belief: Gaussian) -> Linearised:
        m = _scaled(predicted.m, math.sqrt(self.factor), 1.0)
        return predicted._replace(m=m, omega=predicted.omega + (self.factor - 1.0) * (predicted.omega - predicted.noise))

    def noise_adapt(self, innovation: Innovation, belief: Gaussian) -> tuple[Innovation, dict[str, Tensor]]:
        return innovation, {}


@dataclass(frozen=True)
class ConstrainedNoise:
    """Scales R, sensor by sensor, and Q until the innovations are as large as they should be [ours].

    The paper updates Q, adjusts Q and R "dynamically", and bounds the ratio of error to noise. Here the ratios are the
    eigenvalues lam of C_zz in units of the nominal R of a group of sensors; w is the innovation along their axes, and E w^2 =
    r + lam where the prediction is right. Axes along which the state's error hardly shows (lam < tau) contain noise alone and
    tell r; the others then tell whether the prediction was too sure, and q grows. A group without such free axes, one of fewer
    components than there are states behind it, keeps the r that it has.

    Args:
        forget: d, weight of the newest step in the running means.
        free_below: tau.
        r_max, q_max: largest factors on R and on Q; 1 switches them off. Neither falls below 1.
        sigmas: dead band of q in standard deviations of its running mean.
        decay: factor on q where the prediction is not too sure.
        groups: number of the group of each component, a group having one unknown r; None takes those of equal nominal
            variance for one [ours], which suits a receiver of ranges and rates.

    Raises:
        ValueError: an argument outside its range.
    """

    forget: float = 0.2
    free_below: float = 1e-3
    r_max: float = 100.0
    q_max: float = 1e5
    sigmas: float = 3.0
    decay: float = 0.8
    groups: Sequence[int] | None = None

    def __post_init__(self) -> None:
        check_share("ConstrainedNoise.forget", self.forget)
        check_share("ConstrainedNoise.decay", self.decay)
        for name in ("r_max", "q_max"):
            if not getattr(self, name) >= 1.0:
                raise ValueError(f"ConstrainedNoise.{name}={getattr(self, name)}: give 1 (never changed) or more")
        if not (self.free_below >= 0.0 and self.sigmas >= 0.0):
            raise ValueError(f"ConstrainedNoise.free_below={self.free_below}, sigmas={self.sigmas}: give 0 or more")

    def predict_scale(self, predicted: Linearised, belief: Gaussian) -> Linearised:
        """P- = C_f + q Q."""
        if "q" not in belief.memory:  # nothing has been seen yet
            return predicted
        q = belief.memory["q"][:, None, None]
        m, noise = _scaled(predicted.m, 1.0, q.sqrt()), predicted.noise * q
        return predicted._replace(m=m, omega=predicted.omega + (noise - predicted.noise), noise=noise)

    def noise_adapt(self, innovation: Innovation, belief: Gaussian) -> tuple[Innovation, dict[str, Tensor]]:
        nothing = torch.ones_like(innovation.r), torch.zeros_like(belief.mean[:, 0]), torch.ones_like(belief.mean[:, 0])
        r_mean, excess, q = (belief.memory.get(name, a) for name, a in zip(("r", "excess", "q"), nothing, strict=True))
        axes = principal(innovation, self.groups)
        free = axes.seen & (axes.ratio < self.free_below)
        count = (axes.member * free.unsqueeze(-2)).sum(-1)  # [R, k], the same for all components of a group
        newest = (axes.member * (free * axes.w.square()).unsqueeze(-2)).sum(-1) / count.clamp(min=0.5)
        r_mean = torch.where(count > 0.5, (1.0 - self.forget) * r_mean + self.forget * newest, r_mean)
        r = r_mean.clamp(1.0, self.r_max)
        excess, q = self._process(axes, axes.seen & ~free, axes.along(r), excess, q)
        root = r.sqrt()
        noise = innovation.noise * root.unsqueeze(-1) * root.unsqueeze(-2)  # sensors' correlations stay [ours]
        return innovation.with_noise(noise), {"r": r_mean, "excess": excess, "q": q}

    def _process(self, axes: Axes, told: Tensor, r: Tensor, excess: Tensor, q: Tensor) -> tuple[Tensor, Tensor]:
        """The running excess of the innovations over their prediction, and the factor q on Q that it asks for."""
        ratio = axes.ratio / r
        expected = (told * ratio).sum(-1)
        found = (told * (axes.w.square() - r) / r).sum(-1)
        variance = (told * 2.0 * (1.0 + ratio).square()).sum(-1)
        any_told = told.any(-1)
        excess = torch.where(any_told, (1.0 - self.forget) * excess + self.forget * (found - expected), excess)
        beyond = excess - self.sigmas * torch.sqrt(variance * self.forget / (2.0 - self.forget))
        relative = torch.where(any_told, beyond.clamp(min=0.0) / torch.where(any_told, expected, 1.0), 0.0)
        return excess, torch.where(relative > 0.0, q * (1.0 + relative), q * self.decay).clamp(1.0, self.q_max)


@dataclass(frozen=True)
class TraceNoise:
    """One factor on R from the mean square of the innovations, Q left alone [Mohamed and Schwarz 1999, scalar form].

    r = running mean of v' W v / k less tr(W C_zz) / k, W = diag(R)^-1. It takes every surprise for measurement noise.

    Args:
        forget: weight of the newest step.
        r_max: largest factor; it does not fall below 1.

    Raises:
        ValueError: an argument outside its range.
    """

    forget: float = 0.2
    r_max: float = 100.0

    def __post_init__(self) -> None:
        check_share("TraceNoise.forget", self.forget)
        if not self.r_max >= 1.0:
            raise ValueError(f"TraceNoise.r_max={self.r_max}: give 1 (never changed) or more")

    def predict_scale(self, predicted: Linearised, belief: Gaussian) -> Linearised:
        return predicted

    def noise_adapt(self, innovation: Innovation, belief: Gaussian) -> tuple[Innovation, dict[str, Tensor]]:
        w, k = precision(innovation), innovation.seen.sum(-1, dtype=innovation.r.dtype)
        surprise = belief.memory.get("surprise", torch.ones_like(k))
        newest = (w * innovation.r.square()).sum(-1) / k.clamp(min=1.0)
        surprise = torch.where(k > 0, (1.0 - self.forget) * surprise + self.forget * newest, surprise)
        expected = (w * diagonal(innovation.spread)).sum(-1) / k.clamp(min=1.0)
        r = (surprise - expected).clamp(1.0, self.r_max)
        return innovation.with_noise(innovation.noise * r[:, None, None]), {"surprise": surprise, "trace_r": r}


@dataclass(frozen=True)
class MatrixNoise:
    """Whole matrices R and Q from residuals and corrections, for comparison [Akhlaghi, Zhou and Huang 2017].

    R <- a R + (1 - a) (e e' + C+_zz), e the residual after the update and C+_zz the spread left there, where the source has
    the one before it: E e e' = R - H P+ H'. Q <- a Q + (1 - a) K v v' K', of which each term has rank one. Residuals are those
    of the statistical linearisation [ours]. R and Q start where the model has them, and forget it.

    Args:
        keep: a in (0, 1]; 1 switches both off.

    Raises:
        ValueError: a outside (0, 1].
    """

    keep: float = 0.99

    def __post_init__(self) -> None:
        check_share("MatrixNoise.keep", self.keep)

    def predict_scale(self, predicted: Linearised, belief: Gaussian) -> Linearised:
        """P- = C_f + Q, Q = a^k of the model's and what has been learned."""
        if "process" not in belief.memory:  # nothing has been seen yet
            return predicted
        kept = belief.memory["kept"][:, None, None]
        m, noise = _scaled(predicted.m, 1.0, kept.sqrt()), predicted.noise * kept + belief.memory["process"]
        return predicted._replace(m=m, omega=predicted.omega + (noise - predicted.noise), noise=noise)

    def noise_adapt(self, innovation: Innovation, belief: Gaussian) -> tuple[Innovation, dict[str, Tensor]]:
        a, nominal = self.keep, innovation.nominal
        nothing = torch.ones_like(nominal), torch.zeros_like(nominal), torch.zeros_like(innovation.root)
        names = "kept_measurement", "measurement", "process"
        share, learned, process = (belief.memory.get(name, first) for name, first in zip(names, nothing, strict=True))
        both = innovation.seen.unsqueeze(-1) & innovation.seen.unsqueeze(-2)
        adapted = innovation.with_noise(share * nominal + learned)
        shift, root, _ = update(adapted)
        e = innovation.r - (innovation.m @ shift.unsqueeze(-1)).squeeze(-1)
        left = innovation.m @ root
        newest = _outer(e) + left @ left.mT + (adapted.omega - adapted.noise)
        kept = belief.memory.get("kept", torch.ones_like(e[:, 0])) * a
        return adapted, {
            "kept": kept,
            "kept_measurement": torch.where(both, a * share, share),
            "measurement": torch.where(both, a * learned + (1.0 - a) * newest, learned),
            "process": a * process + (1.0 - a) * _outer((innovation.root @ shift.unsqueeze(-1)).squeeze(-1)),
        }


def _scaled(m: Tensor, carried: float, driven: Tensor | float) -> Tensor:
    """M [R, d, d + W] with the columns of the state and those of the noise scaled."""
    d = m.shape[-2]
    return torch.cat([m[..., :d] * carried, m[..., d:] * driven], -1)


def _outer(a: Tensor) -> Tensor:
    return a.unsqueeze(-1) * a.unsqueeze(-2)
