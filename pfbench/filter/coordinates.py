"""In which coordinates a swarm flies, and what it seeks there."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench.covariance import factor
from pfbench.filter.linearisation import derivative
from pfbench.filter.whitening import filled, half_square, whiten
from pfbench.model.base import StateSpaceModel


class Frame(NamedTuple):
    """The k coordinates in which a swarm flies, those of the chart about the predicted mean or linear in them.

    Attributes:
        q: of the predicted cloud [R, N, k].
        covariance: of the predicted cloud in them [R, k, k].
        components: of the chart, that they are or that they whiten [k].
        place: q [R, N, k] -> states [R, N, D].
    """

    q: Tensor
    covariance: Tensor
    components: Tensor
    place: Callable[[Tensor], Tensor]


class Coordinates(Protocol):
    """Predicted particles x [R, N, D] with weights w [R, N] -> in which coordinates they fly."""

    @property
    def white(self) -> bool: ...

    def __call__(self, model: StateSpaceModel, x: Tensor, w: Tensor, u: Any) -> Frame: ...


@dataclass(frozen=True)
class Everything:
    """All components of the chart, as the paper has it. Those that the measurement does not see are dragged along blindly."""

    white = False

    def __call__(self, model: StateSpaceModel, x: Tensor, w: Tensor, u: Any) -> Frame:
        chart = model.chart
        mean = chart.mean(x, w).unsqueeze(1)
        c = chart.subtract(x, mean)
        index = torch.arange(c.shape[-1], device=c.device)
        return Frame(c, (w.unsqueeze(-1) * c).mT @ c, index, lambda q: chart.add(mean, q))


@dataclass(frozen=True)
class Observed:
    """The components o that the measurement depends on; the others follow by their regression on o in the cloud [ours].

    Args:
        follow: the others move by S_uo S_oo^-1 (o' - o), so that what o does not tell of them is left as it is; else they stay.
        white: fly in a = L^-1 o, L L' = S_oo, in which the cloud is as wide in all directions.
    """

    follow: bool = True
    white: bool = False

    def __call__(self, model: StateSpaceModel, x: Tensor, w: Tensor, u: Any) -> Frame:
        chart = model.chart
        mean = chart.mean(x, w).unsqueeze(1)
        c = chart.subtract(x, mean)
        index = observed(model, mean, u)
        o = c[..., index]
        joint = (w.unsqueeze(-1) * o).mT @ c  # [R, k, d]
        covariance = joint[..., index]
        root = rooted(covariance)
        eye = torch.eye(len(index), dtype=c.dtype, device=c.device)
        along = torch.linalg.solve_triangular(root, joint, upper=False)  # d c / d a, transposed [R, k, d]
        if not self.follow:
            along = along.new_zeros(along.shape)
        along = along.index_copy(-1, index, (root * (o.square().sum(1) > 0.0).unsqueeze(-1)).mT)
        if self.white:
            o, covariance = whiten(o, root), eye.expand_as(covariance)
        else:
            along = torch.linalg.solve_triangular(root.mT, along, upper=True).index_copy(-1, index, eye.expand_as(covariance))
        return Frame(o, covariance, index, lambda q: chart.add(mean, c + (q - o) @ along))


class Fitness(Protocol):
    """A frame -> what is added to the log likelihood at q [R, N, k] -> [R, N]."""

    def __call__(self, frame: Frame) -> Callable[[Tensor], Tensor]: ...


@dataclass(frozen=True)
class Likelihood:
    """Nothing: ln Y = ln p(y | x), what eq. 37 means; its print is linear in the residual and has no maximum."""

    def __call__(self, frame: Frame) -> Callable[[Tensor], Tensor]:
        return lambda q: q.new_zeros(q.shape[:-1])


@dataclass(frozen=True)
class Posterior:
    """The log density of the normal law that has the predicted cloud's moments: the swarm seeks a posterior mode [ours].

    Args:
        shrink: of the covariance towards its diagonal, for clouds of few particles.
    """

    shrink: float = 0.05

    def __post_init__(self) -> None:
        if not 0.0 <= self.shrink <= 1.0:
            raise ValueError(f"fitness.shrink={self.shrink}: give a fraction from 0 to 1")

    def __call__(self, frame: Frame) -> Callable[[Tensor], Tensor]:
        s = frame.covariance
        root = rooted(s + self.shrink * (torch.diag_embed(s.diagonal(dim1=-2, dim2=-1)) - s))
        return lambda q: -half_square(whiten(q, root))


def observed(model: StateSpaceModel, mean: Tensor, u: Any) -> Tensor:
    """Components of the chart that the measurement's mean or variance depends on, by its derivative at mean [R, 1, D] -> [k]."""

    def law(at: Tensor, xi: Tensor) -> Tensor:
        seen: Any = model.observation(model.chart.add(at, xi), u)
        return torch.cat([seen.mean, seen.variance], -1)

    slope = derivative(law, mean, model.chart.dimension).nan_to_num()  # [R, 1, 2 Dy, d]
    return (slope != 0.0).flatten(0, 2).any(0).nonzero().squeeze(-1)


def rooted(covariance: Tensor) -> Tensor:
    """Cholesky factor [R, k, k] to solve with; NaN, which loses the run, if there is none."""
    root, ok = factor(covariance)
    return torch.where(ok[:, None, None], filled(root), torch.nan)
