"""What a filter's beliefs are worth, measured against the truth, which only the judge sees.

Errors and normalised errors at every step; scores of the whole law at some instants, since they cost more than a filter's step:
continuous ranked probability and energy scores [Gneiting, Raftery 2007] and the probability integral transform, from which rank
histograms and the coverage of intervals come.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple, TypeAlias

import scoringrules
import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench import native
from pfbench.covariance import factor, squared_length
from pfbench.draws import MonteCarlo
from pfbench.filter.belief import Info, weights
from pfbench.fusion import fusible
from pfbench.model.base import StateSpaceModel

Groups: TypeAlias = Collection[tuple[int, ...]]

_POINTS = 64  # of a law whose energy score is taken: its bias, E|x - x'| / 128, is the same for all filters [ours]


class Scores(NamedTuple):
    """Of a law, against the truth; NaN where there is no truth.

    Attributes:
        crps: continuous ranked probability score of each component [R, d], in its unit.
        pit: probability that the law gives to values below the truth [R, d]; uniform for a filter that knows what it knows.
        energy: energy score of each group [R, G], the CRPS of vectors.
    """

    crps: Tensor
    pit: Tensor
    energy: Tensor


class Tally:
    """Counts how often a model's measurement law is evaluated, a state of a run at a time: what filters of one budget share.

    Args:
        model: whose method `observation` is watched from here on.
    """

    def __init__(self, model: StateSpaceModel) -> None:
        self.count = 0
        self._paused = False
        law = model.observation

        def counted(x: Tensor, u: Any) -> Distribution:
            self.count += 0 if self._paused else x.shape[0] * x.shape[1]
            return law(x, u)

        model.observation = counted  # type: ignore[method-assign]

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Within it nothing counts: what the judge asks is no cost of a filter."""
        self._paused = True
        try:
            yield
        finally:
            self._paused = False


class Judge:
    """Watches a filter on its way, as run_filter's `watch`.

    Args:
        model: what the filter believes.
        truth: the true state [R, T, D], NaN where there is none.
        instants: how many instants are scored, spread evenly, the last one among them; 0 scores nothing.
        clock: by which it is told how long that took.

    Attributes:
        at: the steps scored [S].
        scores: of those that have been passed.
        surprises: normalised innovation squared and components seen there, each [R]; of filters that tell.
        seconds: what scoring took.
    """

    def __init__(
        self, model: StateSpaceModel, truth: Tensor, instants: int = 0, clock: Callable[[], float] = time.perf_counter
    ) -> None:
        steps = truth.shape[1]
        self.model, self.truth, self.clock = model, truth, clock
        sizes = sorted({len(parts) for parts in model.groups.values()})
        alike = [[g for g, parts in enumerate(model.groups.values()) if len(parts) == size] for size in sizes]
        components = list(model.groups.values())
        self._alike = [
            tuple(torch.tensor(index, device=truth.device) for index in (each, [components[g] for g in each])) for each in alike
        ]
        self.at = sorted({(k + 1) * steps // instants - 1 for k in range(instants)} - {-1})
        self.scores: list[Scores] = []
        self.surprises: list[tuple[Tensor, Tensor]] = []
        self.seconds = 0.0

    def __call__(self, t: int, info: Info) -> dict[str, Tensor]:
        """Error [R, d] and normalised error squared of each group [R, G].

        A filter without a spread left (a cloud collapsed to one particle) has an infinite normalised error, not an unknown one.
        """
        error = self.model.error(info.mean, self.truth[:, t])
        nees = error.new_empty(len(error), len(self.model.groups))
        for place, parts in self._alike:
            e = error[:, parts]
            value = squared_length(e, info.covariance_of(parts))
            known = ~torch.isnan(e).any(-1)
            nees[:, place] = torch.where(known & ~(value >= 0.0), torch.inf, value)
        if t in self.at:
            begun = self.clock()
            self.scores.append(self._scored(t, error, info))
            if info.nis is not None:
                self.surprises.append(info.nis())
            self.seconds += self.clock() - begun
        return {"error": error, "nees": nees}

    def arrays(self) -> dict[str, Tensor]:
        """What was scored: steps [S], crps and pit [R, S, d], energy [R, S, G]; nothing where nothing was.

        With them `nis` and `nis_dof` [R, S], from a filter that tells.
        """
        if not self.scores:
            return {}
        parts = zip(Scores._fields, zip(*self.scores, strict=True), strict=True)
        found = {"scored": torch.tensor(self.at)} | {name: torch.stack(values, 1) for name, values in parts}
        if self.surprises:
            nis, dof = zip(*self.surprises, strict=True)
            found |= {"nis": torch.stack(nis, 1), "nis_dof": torch.stack(dof, 1)}
        return found

    def _scored(self, t: int, error: Tensor, info: Info) -> Scores:
        groups = self.model.groups.values()
        if info.cloud is not None:
            return of_cloud(error, *info.cloud(), groups)
        draws = MonteCarlo(0, torch.zeros(1, dtype=torch.int64, device=error.device), error.dtype, t)  # the same for all runs
        return of_normal(error, info.covariance(), draws.normal("energy score", _POINTS, error.shape[1]), groups)


def of_cloud(error: Tensor, deviation: Tensor, log_w: Tensor, groups: Groups) -> Scores:
    """Scores of weighted particles.

    Args:
        error: of the estimate [R, d].
        deviation: of the particles from the estimate [R, N, d].
        log_w: their log weights [R, N].
        groups: components whose energy score is wanted.
    """
    w = weights(log_w)
    crps, below = _marginal_scores(error, deviation, w)
    places = (torch.arange(_POINTS, device=w.device, dtype=w.dtype) + 0.5) / _POINTS
    picked = torch.searchsorted(w.cumsum(-1), places.expand(len(w), -1).contiguous()).clamp(max=w.shape[1] - 1)
    thinned = error.unsqueeze(1) + deviation.gather(1, picked.unsqueeze(-1).expand(-1, -1, error.shape[1]))
    return _whole(error, crps, below, thinned, groups)


def _separate_marginals(error: Tensor, deviation: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """CRPS and probability below 0 [R, d] of particles at error [R, d] + deviation [R, N, d] by weights [R, N]."""
    off = (error.unsqueeze(1) + deviation).permute(0, 2, 1)  # particles minus truth [R, d, N]
    shared = w.unsqueeze(1).expand_as(off)
    crps = scoringrules.crps_ensemble(torch.zeros_like(error), off, ens_w=shared, estimator="qd", backend="torch")
    return crps, (shared * (off < 0)).sum(-1) + 0.5 * (shared * (off == 0)).sum(-1)


def _separate_energy(points: Tensor) -> Tensor:
    """Energy score of points [R, n, s] against 0: [R]."""
    return scoringrules.es_ensemble(points.new_zeros(points[:, 0].shape), points, backend="torch")


# without them ten scored instants took half as long as 300 steps of a filter
_marginal_scores = fusible(_separate_marginals, by_hand=native.marginal_scores, whole=False, compiles=False)
_energy_score = fusible(_separate_energy, by_hand=native.energy_score, whole=False, compiles=False)


def of_normal(error: Tensor, covariance: Tensor, z: Tensor, groups: Groups) -> Scores:
    """Scores of normal laws: error [R, d], covariance [R, d, d]; normals [R or 1, n, d] stand for the law in energy scores."""
    sd = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
    spread = torch.where(sd > 0, sd, 1.0)
    crps = scoringrules.crps_normal(torch.zeros_like(error), error, spread, backend="torch")
    crps = torch.where(sd > 0, crps, error.abs())
    points = error.unsqueeze(1) + z @ factor(covariance)[0].mT
    return _whole(error, crps, torch.special.ndtr(-error / sd), points, groups)


def _whole(error: Tensor, crps: Tensor, pit: Tensor, points: Tensor, groups: Groups) -> Scores:
    """NaN where there is no truth; `points` minus truth are [R, n, d]."""
    known = ~torch.isnan(error)
    energy = [_energy_score(points[:, :, parts]) for parts in map(list, groups)]
    return Scores(torch.where(known, crps, torch.nan), torch.where(known, pit, torch.nan), torch.stack(energy, 1))
