"""Posterior draws by importance sampling from a mixture at the modes that Fisher scoring finds, adapted in rounds."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.random_stream import RandomStream
from pfbench.filter.health import fit_pareto_k
from pfbench.ppl.fix_filter import DENSITIES, FixFilter, FixTerms
from pfbench.ppl.parameterised_model import constrain

_STEP = 1e-3  # of differences, in unconstrained numbers
_LONGEST = 1.5  # step of the search in an unconstrained number: a factor of 4.5
_DOF = 7  # of the t distributions
_LOOK, _ITERATIONS = 64, 25
_LEAST = 0.03  # weight of a component of the first mixture
_BATCH = 512  # filters of a pass
GOOD_K, GOOD_ESS = 0.5, 300.0  # Pareto k and effective draws at which no other round follows


class Slopes(NamedTuple):
    """Log posterior density at K points with its gradient and expected information: [K], [K, P], [K, P, P]."""

    z: Tensor
    value: Tensor
    gradient: Tensor
    information: Tensor


@dataclass(frozen=True)
class NoiseTarget:
    """Log posterior density of noise numbers in unconstrained space.

    Attributes:
        passes: Filter of the records.
        prior: Distribution of each number by name.
        centre: Mean of the prior of the unconstrained numbers, [P].
        scale: Its standard deviations, [P].
    """

    passes: FixFilter
    prior: Mapping[str, Any]
    centre: Tensor
    scale: Tensor

    def filter(self, z: Tensor) -> tuple[Tensor, FixTerms]:
        """Return the log posterior density [V] of numbers [V, P], and the terms of their pass."""
        values, log_prior = constrain(self.prior, z)
        terms = self.passes(values)
        log_density = terms.log_density.sum((1, 2)) + log_prior
        return log_density.nan_to_num(nan=-torch.inf), terms

    def __call__(self, z: Tensor) -> Tensor:
        """Return the log posterior density [V] of numbers [V, P]."""
        size = max(1, _BATCH // len(self.passes.record.y))
        return torch.cat([self.filter(points)[0] for points in z.split(size)])

    def differentiate(self, z: Tensor, free: Tensor) -> Slopes:
        """Return density, gradient and information of free numbers [K, P] at points [K, P], by central differences.

        The information of a number that is not free is that of the prior.
        """
        k, p = z.shape
        offsets = _STEP * torch.eye(p, dtype=z.dtype)
        nodes = torch.cat([z[:, None], z[:, None] + offsets, z[:, None] - offsets], 1)
        value, terms = self.filter(nodes.flatten(0, 1))
        value = value.unflatten(0, (k, -1))
        nu, s = (a.unflatten(0, (k, -1)).flatten(2, 3) for a in (terms.innovation, terms.covariance))  # fmt: skip
        up, down = slice(1, p + 1), slice(p + 1, None)
        slope_nu, slope_s, gradient = ((a[:, up] - a[:, down]) / (2 * _STEP) for a in (nu, s, value))  # fmt: skip
        inverse = torch.linalg.inv_ex(s[:, 0])[0]
        ratio = inverse[:, None] @ slope_s
        information = torch.einsum("kpfi,kfij,kqfj->kpq", slope_nu, inverse, slope_nu)
        information = information + 0.5 * torch.einsum("kpfij,kqfji->kpq", ratio, ratio)
        information = information * (free[:, None] * free[:, :, None])
        return Slopes(z, value[:, 0], gradient * free, information + torch.diag(self.scale**-2))


class Mixture(NamedTuple):
    """Mixture of t distributions with weights [K], locations [K, P] and roots of their scales [K, P, P]."""

    weight: Tensor
    loc: Tensor
    root: Tensor

    def draw(self, draws: RandomStream, use: str, n: int) -> Tensor:
        """Draw n points, each component in proportion to its weight, [n, P]."""
        p, components = self.loc.shape[1], pick_evenly(self.weight, n)
        e = draws.normal(use, n, p + _DOF)[0]
        tail = e[:, p:].square().mean(1, keepdim=True).rsqrt()
        return self.loc[components] + (
            self.root[components] @ (e[:, :p] * tail).unsqueeze(-1)
        ).squeeze(-1)

    def log_parts(self, z: Tensor) -> Tensor:
        """Return the log of weight times density of each component at points [n, P], [K, n]."""
        p = z.shape[1]
        e = torch.linalg.solve_triangular(self.root, (z - self.loc[:, None]).mT, upper=False)
        constant = math.lgamma((_DOF + p) / 2) - math.lgamma(_DOF / 2) - 0.5 * p * math.log(_DOF * math.pi)  # fmt: skip
        volume = self.weight.log() - self.root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
        return constant + volume[:, None] - 0.5 * (_DOF + p) * torch.log1p(e.square().sum(1) / _DOF)

    def adapt(self, z: Tensor, weights: Tensor) -> Mixture:
        """Move the components to weighted points: a step of expectation and maximisation [Cappé et al. 2008].

        A component with few effective points keeps much of its wider shape.
        """
        share = torch.softmax(self.log_parts(z), 0) * weights  # [K, n]
        mass = share.sum(1).clamp(min=1e-300)  # 1e-40 far from all points, which are as few for it as for others
        effective = mass**2 / share.square().sum(1).clamp(min=1e-300)
        trust = effective / (effective + 5.0 * z.shape[1])
        loc = torch.lerp(self.loc, share @ z / mass[:, None], trust[:, None])
        away = z - loc[:, None]
        covariance = torch.einsum("kn,kni,knj->kij", share / mass[:, None], away, away)
        wide = 1.5 * self.root @ self.root.mT
        both = torch.lerp(wide, covariance, trust[:, None, None])
        return Mixture((mass + 0.02) / (mass + 0.02).sum(), loc, torch.linalg.cholesky(both))


def pick_evenly(weights: Tensor, n: int) -> Tensor:
    """Pick n indices in proportion to normalised weights, at equal quantiles."""
    levels = (torch.arange(n, dtype=torch.float64) + 0.5) / n
    return torch.searchsorted(weights.cumsum(0), levels).clamp(max=len(weights) - 1)


class WeightedDraws(NamedTuple):
    """Draws [S, P] of unconstrained numbers with normalised weights [S]; Pareto k of these, log evidence and rounds."""

    z: Tensor
    weights: Tensor
    pareto_k: float
    log_evidence: float
    rounds: int

    @property
    def ess(self) -> float:
        """Effective number of draws."""
        return float(1.0 / self.weights.square().sum())


def find_modes(target: NoiseTarget, draws: RandomStream) -> Mixture:
    """Find the mode by damped Fisher scoring, and the modes without one kind of noise of the IMU each.

    A log that does not need a noise says only that it is small: a plateau that the curvature at a mode does not show. Such a
    component has this number at its prior, a deviation below its centre. Scales are inverse information.
    """
    z = target.centre + target.scale * draws.normal("look", _LOOK, len(target.centre))[0]
    z = torch.cat([target.centre[None], z])
    absent = torch.zeros(1 + len(DENSITIES), len(target.centre), dtype=torch.bool)
    for i, name in enumerate(DENSITIES, 1):
        absent[i, list(target.prior).index(name)] = True
    start = z[target(z).argmax()].expand_as(absent)
    best = _climb(target, torch.where(absent, target.centre - target.scale, start), (~absent).double())  # fmt: skip
    root = torch.linalg.cholesky(torch.linalg.inv(best.information))
    log_mass = best.value + root.diagonal(dim1=-2, dim2=-1).log().sum(-1)
    weight = torch.softmax(log_mass, 0) + _LEAST
    return Mixture(weight / weight.sum(), best.z, root)


def _climb(target: NoiseTarget, z: Tensor, free: Tensor) -> Slopes:
    """Climb from points [K, P] in their free numbers."""
    best, damping = target.differentiate(z, free), torch.full((len(z), 1, 1), 1e-2, dtype=z.dtype)
    for _ in range(_ITERATIONS):
        diagonal = torch.diag_embed(best.information.diagonal(dim1=-2, dim2=-1))
        step = torch.linalg.solve(best.information + damping * diagonal, best.gradient)
        step = step * (_LONGEST / step.abs().amax(1, keepdim=True).clamp(min=_LONGEST))
        trial = target.differentiate(best.z + step, free)
        better = trial.value > best.value
        gain = torch.where(better, trial.value - best.value, 0.0)
        best = Slopes(
            *(choose_rows(better, new, old) for new, old in zip(trial, best, strict=True))
        )
        damping = torch.where(better[:, None, None], 0.2 * damping, 8.0 * damping.clamp(min=1e-2))
        if bool(((gain < 0.01) & better | (damping[:, 0, 0] > 1e4)).all()):
            break
    return best


def choose_rows(mask: Tensor, new: Tensor, old: Tensor) -> Tensor:
    """Choose rows of the new values where a mask [K] holds, else those of the old."""
    return torch.where(mask.reshape(-1, *[1] * (new.dim() - 1)), new, old)


def sample_mixture(
    target: Callable[[Tensor], Tensor], start: Mixture, draws: RandomStream, n: int, rounds: int
) -> WeightedDraws:
    """Draw n points in each round, weigh those of all rounds by the mixture of their proposals, and adapt the proposal.

    The weights of a round alone would be biased towards its own proposal [Owen and Zhou 2000].
    """
    proposals, z, values = [start], start.loc[:0], start.weight[:0]
    for turn in range(rounds):
        fresh = proposals[-1].draw(draws, f"importance.{turn}", n)
        z, values = torch.cat([z, fresh]), torch.cat([values, target(fresh)])
        log_q = torch.cat([p.log_parts(z) for p in proposals]).logsumexp(0) - math.log(turn + 1)
        log_w = values - log_q
        weights, k = torch.softmax(log_w, 0), float(fit_pareto_k(log_w[None]))
        result = WeightedDraws(z, weights, k, float(log_w.logsumexp(0)) - math.log(len(z)), turn + 1)  # fmt: skip
        if k < GOOD_K and result.ess > GOOD_ESS:
            break
        proposals.append(proposals[-1].adapt(z, weights))
    return result
