"""Belief (what the next step needs) and info (what the report wants). Both are flat NamedTuples of tensors."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, NamedTuple, Protocol

import torch
from torch import Tensor

from pfbench import native
from pfbench.chart import Chart
from pfbench.draws import Draws
from pfbench.fusion import fusible
from pfbench.model.base import StateSpaceModel
from pfbench.record import Record


class Cloud(NamedTuple):
    """Weighted particles.

    Attributes:
        x: particles [R, N, D]; best kept component-major in memory, as a permuted contiguous [D, R, N].
        log_w: log weights [R, N], logsumexp 0; -inf is an empty slot (adaptive particle number).
        log_z: log evidence so far [R]; -inf where the run is lost.
        window: what moves need of the past, [R, N, L, ...], gathered with the particles.
        memory: the proposal's own, [R, N or 1, ...], gathered with the particles.
        past: what was seen at the steps in the window, oldest first, each as Record.at gives it.
        copy_of: within a step, the slot that each particle copies since the refresh [R, N], N or more where a move made
            it another one; None where particles were drawn anew.
    """

    x: Tensor
    log_w: Tensor
    log_z: Tensor
    window: dict[str, Tensor] = {}  # noqa: RUF012 (a NamedTuple default, never written to)
    memory: dict[str, Tensor] = {}  # noqa: RUF012
    past: tuple[Record, ...] = ()
    copy_of: Tensor | None = None


class Gaussian(NamedTuple):
    """A normal law in the chart about `mean`.

    Attributes:
        mean: [R, D].
        covariance: [R, d, d].
        log_z: log evidence so far [R]; -inf where the run is lost.
        memory: what adaptations carry, [R, ...].
    """

    mean: Tensor
    covariance: Tensor
    log_z: Tensor
    memory: dict[str, Tensor] = {}  # noqa: RUF012


class Info(NamedTuple):
    """What a step tells the report.

    Attributes:
        mean: estimate [R, D].
        variance: [R, d].
        covariance: gives the whole covariance in the chart [R, d, d] to whoever asks; a cloud's costs a tenth of a step.
        trace: anything per run, {name: [R]}, such as `ess` or `resampled`.
        cloud: gives the particles' deviations from the mean [R, N, d] and their log weights [R, N] to whoever asks; None from a
            filter whose law is the normal one.
        nis: gives the normalised innovation squared [R] to whoever asks, that of what was seen under the mean and covariance that
            the filter predicted for it, and how many components were seen [R]. None from a filter that does not tell.
        some: gives the covariance of groups of components [R, G, s, s], the groups being [G, s] indices, where that is cheaper
            than the whole.
    """

    mean: Tensor
    variance: Tensor
    covariance: Callable[[], Tensor]
    trace: dict[str, Tensor]
    cloud: Callable[[], tuple[Tensor, Tensor]] | None = None
    nis: Callable[[], tuple[Tensor, Tensor]] | None = None
    some: Callable[[Tensor], Tensor] | None = None

    def covariance_of(self, groups: Tensor) -> Tensor:
        """Of groups of components, indices [G, s], in the chart [R, G, s, s]."""
        if self.some is not None:
            return self.some(groups)
        return self.covariance()[:, groups.unsqueeze(-1), groups.unsqueeze(-2)]


class Filter(Protocol):
    """A recipe that turns a belief and what was seen into the next belief. It holds no state."""

    @property
    def exact(self) -> bool:
        """Does the belief target p(x_t | y_1:t): as N grows, or, for a Gaussian filter, on linear-Gaussian models?"""

    def init(
        self, model: StateSpaceModel, runs: int, draws: Draws, start: Tensor | None = None, spread: Tensor | None = None
    ) -> Cloud | Gaussian:
        """The belief before anything is seen.

        About `start` [R, D] or, without one, about the model's `origin`; with the model's initial law or, where there is a
        `spread` [R, d, d], as a normal with this Cholesky factor.
        """

    def step(self, model: StateSpaceModel, belief: Any, seen: Record, draws: Draws) -> tuple[Cloud | Gaussian, Info]: ...


def gather(cloud: Cloud, ancestors: Tensor) -> Cloud:
    """The cloud of the given ancestors [R, N]; everything that belongs to a particle goes with it."""
    return cloud._replace(
        x=_gather_states(cloud.x, ancestors),
        log_w=cloud.log_w.gather(1, ancestors),
        window={k: _gather_rows(v, ancestors) for k, v in cloud.window.items()},
        memory={k: _gather_rows(v, ancestors) for k, v in cloud.memory.items()},
        copy_of=ancestors,
    )


def where(hit: Tensor, new: Cloud, old: Cloud) -> Cloud:
    """Run by run: `new` where hit [R], else `old`; the evidence is `new`'s."""

    def choose(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(hit.reshape(-1, *[1] * (a.dim() - 1)), a, b)

    return Cloud(
        x=torch.where(hit[:, None], new.x.permute(2, 0, 1), old.x.permute(2, 0, 1)).permute(1, 2, 0),
        log_w=choose(new.log_w, old.log_w),
        log_z=new.log_z,
        window={k: choose(v, old.window[k]) for k, v in new.window.items()},
        memory={k: choose(v, old.memory[k]) for k, v in new.memory.items()},
        past=new.past,
        copy_of=None if new.copy_of is None else choose(new.copy_of, torch.arange(old.log_w.shape[1], device=hit.device)),
    )


def weights(log_w: Tensor) -> Tensor:
    """Normalised weights [R, N] of log weights whose logsumexp need not be 0."""
    return torch.softmax(log_w, dim=-1)


def ess(log_w: Tensor) -> Tensor:
    """Effective sample size 1 / sum w^2 [R]."""
    return 1.0 / weights(log_w).square().sum(-1)


def moments(chart: Chart, cloud: Cloud) -> tuple[Tensor, Tensor]:
    """Weighted mean [R, D] and covariance [R, d, d] of a cloud, the latter in the chart about the mean."""
    w = weights(cloud.log_w)
    mean = chart.mean(cloud.x, w)
    d = chart.subtract(cloud.x, mean.unsqueeze(1))
    return mean, (w.unsqueeze(-1) * d).mT @ d


def _gather_states(x: Tensor, ancestors: Tensor) -> Tensor:
    """[R, N, D] by ancestors [R, M] -> [R, M, D], in the memory order of x."""
    first = x.permute(2, 0, 1)
    if first.is_contiguous():
        return _picked(first, ancestors).permute(1, 2, 0)
    return x.mT.gather(2, ancestors.unsqueeze(1).expand(-1, x.shape[2], -1)).mT


def _flat_select(first: Tensor, ancestors: Tensor) -> Tensor:
    """[D, R, N] by ancestors [R, M] -> [D, R, M]; one flat index costs a fifth of an expanded one."""
    d, runs, n = first.shape
    flat = ancestors + n * torch.arange(runs, device=first.device)[:, None]
    return first.reshape(d, runs * n).index_select(1, flat.flatten()).reshape(d, *ancestors.shape)


_picked = fusible(_flat_select, by_hand=native.copied)


def _gather_rows(a: Tensor, ancestors: Tensor) -> Tensor:
    if a.shape[1] == 1:  # shared by all particles of a run
        return a
    (runs, n, *rest), dims = a.shape, a.dim()
    first = a.permute(*range(2, dims), 0, 1)
    if rest and first.is_contiguous():  # a window whose particles come last in memory, and shall stay there
        picked = _picked(first.reshape(math.prod(rest), runs, n), ancestors)
        return picked.reshape(*rest, *ancestors.shape).permute(dims - 2, dims - 1, *range(dims - 2))
    return a.gather(1, ancestors.reshape(*ancestors.shape, *[1] * len(rest)).expand(-1, -1, *rest))
