"""Scores of a filter's estimates against the truth.

Errors and NEES are computed at every step. Scores of the whole distribution are computed at some
steps only, since they cost more than a filter step: CRPS and energy scores [Gneiting, Raftery 2007]
and the probability integral transform, from which rank histograms and interval coverage follow.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any, NamedTuple, TypeAlias, cast

import torch
from torch import Tensor
from torch.distributions import Distribution

from pfbench.core.linear_algebra import squared_length
from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import MeasuredTruth
from pfbench.filter.belief import StepInfo, normalise_log_weights
from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable
from pfbench.model.base import StateSpaceModel

Groups: TypeAlias = Collection[tuple[int, ...]]

_POINTS = 64  # particles between which the distances of an energy score are averaged [ours]
_STEP = 0.35  # in log s, of the integral of an energy score: a relative error of 1e-7


class ProperScores(NamedTuple):
    """Scores of a distribution against the truth. NaN where the truth is unknown.

    Attributes:
        crps: Continuous ranked probability score per component, [R, d], in its unit.
        pit: Probability of values below the truth, [R, d]. Uniform for a calibrated filter.
        energy_score: Energy score per group, [R, G], the multivariate CRPS.
    """

    crps: Tensor
    pit: Tensor
    energy_score: Tensor


class LikelihoodCounter:
    """Counter of evaluations of a model's measurement distribution, per state and run.

    Attributes:
        count: Evaluations so far.
    """

    def __init__(self, model: StateSpaceModel) -> None:
        self.count = 0
        self._is_paused = False
        model.__dict__["likelihood_counter"] = self  # for what evaluates the model without a call
        observation = model.observation
        # a function that can be pickled: another process may compile the step of the model
        model.observation = partial(self._observe, observation)  # type: ignore[method-assign]

    def _observe(self, observation: Callable[..., Distribution], x: Tensor, u: Any) -> Distribution:
        """Count the evaluations of a call, and return its distribution."""
        self.count += 0 if self._is_paused else x.shape[0] * x.shape[1]
        return observation(x, u)

    @contextmanager
    def paused(self) -> Iterator[None]:
        """Pause counting. Evaluations made for scoring are not charged to the filter."""
        self._is_paused = True
        try:
            yield
        finally:
            self._is_paused = False


class ScoreRecorder:
    """Recorder of errors and scores, passed to `run_filter` as its argument `watch`.

    Args:
        model: Model of the filter.
        truth: True state, [R, T, D]. NaN where it is unknown.
        score_steps: Number of scored steps, spread evenly up to the last step. 0 scores nothing.
        clock: Clock that measures the time of scoring, in seconds.
        measured: Errors of the truth itself, which are added to the distribution of the filter. None for none.

    Attributes:
        at_step: Indices of the scored steps.
        scores: Scores of the steps so far.
        innovations: NIS and number of observed components per scored step, each [R], for filters
            that provide them.
        seconds: Time of scoring.
    """

    def __init__(
        self,
        model: StateSpaceModel,
        truth: Tensor,
        score_steps: int = 0,
        clock: Callable[[], float] = time.perf_counter,
        measured: MeasuredTruth | None = None,
    ) -> None:
        steps = truth.shape[1]
        self.truth_sd = _place_sd(model, measured, truth)
        self.model, self.truth, self.clock = model, truth, clock
        groups = list(model.groups.values())
        sizes = sorted({len(components) for components in groups})
        by_size = [[g for g, parts in enumerate(groups) if len(parts) == size] for size in sizes]
        self._groups_by_size = [
            (
                torch.tensor(index, device=truth.device),
                torch.tensor([groups[g] for g in index], device=truth.device),
            )
            for index in by_size
        ]
        count = min(score_steps, steps)
        self.at_step = [(k + 1) * steps // count - 1 for k in range(count)]
        self.scores: list[ProperScores] = []
        self.innovations: list[tuple[Tensor, Tensor]] = []
        self.seconds = 0.0

    def __call__(self, t: int, info: StepInfo) -> dict[str, Tensor]:
        """Compute error and NEES of one step, and scores if the step is scored.

        A filter without spread (all particles equal) has an infinite NEES, not an unknown one. For a
        filter that states no covariance it is NaN, and nothing else is scored.

        Args:
            t: Time step.
            info: Moments and diagnostics of the step.

        Returns:
            `error` [R, d] and `nees` of each group [R, G].
        """
        error = self.model.error(info.mean, self.truth[:, t])
        nees = error.new_empty(len(error), len(self.model.groups))
        for index, components in self._groups_by_size:
            e = error[:, components]
            covariance = info.covariance_of(components)
            if self.truth_sd is not None:
                covariance = covariance + torch.diag_embed(self.truth_sd[components] ** 2)
            value = squared_length(e, covariance)
            has_truth = ~torch.isnan(e).any(-1) & info.has_covariance
            nees[:, index] = torch.where(has_truth & ~(value >= 0.0), torch.inf, value)
        if t in self.at_step and info.has_covariance:
            start_time = self.clock()
            self.scores.append(self._score(t, error, info))
            if info.nis is not None:
                self.innovations.append(info.nis())
            self.seconds += self.clock() - start_time
        return {"error": error, "nees": nees}

    def arrays(self) -> dict[str, Tensor]:
        """Return the scores: `score_steps` [S], `crps` and `pit` [R, S, d], `energy_score` [R, S, G].

        `nis` and `nis_dof` [R, S] follow if the filter provides them. Empty if no step is scored.
        """
        if not self.scores:
            return {}
        columns = zip(ProperScores._fields, zip(*self.scores, strict=True), strict=True)
        results = {"score_steps": torch.tensor(self.at_step)}
        results |= {name: torch.stack(values, 1) for name, values in columns}
        if self.innovations:
            nis, dof = zip(*self.innovations, strict=True)
            results |= {"nis": torch.stack(nis, 1), "nis_dof": torch.stack(dof, 1)}
        return results

    def _score(self, t: int, error: Tensor, info: StepInfo) -> ProperScores:
        """Compute the scores of one step."""
        groups, sd = self.model.groups.values(), self.truth_sd
        if info.cloud is not None:
            deviation, log_w = info.cloud()
            if sd is not None:  # particles of the measured truth, the same numbers for all runs
                draws = PhiloxStream(0, error.new_zeros(1, dtype=torch.int64), error.dtype, t)
                deviation = deviation + sd * draws.normal("measured truth", *deviation.shape[1:])
            scores = score_particles(error, deviation, log_w, groups)
            return scores if info.conditional is None else self._with_mixture(scores, error, info)
        covariance = info.covariance()
        if sd is not None:
            covariance = covariance + torch.diag(sd**2)
        return score_normal(error, covariance, groups)

    def _with_mixture(self, scores: ProperScores, error: Tensor, info: StepInfo) -> ProperScores:
        """Replace the probabilities below the truth by those of particles with a covariance, without the noise of few draws."""
        (deviation, log_w), (sd, shift) = cast(Any, info.cloud)(), cast(Any, info.conditional)()
        total = sd if self.truth_sd is None else torch.hypot(sd, self.truth_sd.expand_as(sd))
        below = torch.special.ndtr((shift - deviation - error.unsqueeze(1)) / total)
        pit = normalise_log_weights(log_w).unsqueeze(1) @ below
        return scores._replace(pit=torch.where((sd > 0.0).any(1), pit.squeeze(1), scores.pit))


def _place_sd(
    model: StateSpaceModel, measured: MeasuredTruth | None, truth: Tensor
) -> Tensor | None:
    """Return the standard deviations of the errors of the truth by component, [d]; 0 where it has none."""
    if measured is None:
        return None
    sd = truth.new_zeros(model.chart.dimension)
    for group, values in measured.sd.items():
        sd[list(model.groups[group])] = values.to(sd)
    return sd


def score_particles(
    error: Tensor, deviation: Tensor, log_w: Tensor, groups: Groups
) -> ProperScores:
    """Compute the scores of weighted particles, in their fair form.

    The distance between two particles is averaged over different ones, so that a sample of a distribution has its
    score on average [Ferro 2014]. Scores of a group are those of all particles; the distances between them are those
    of 64 that stand for them.

    Shapes: error [R, d], deviation [R, N, d], log_w [R, N].
    """
    w = normalise_log_weights(log_w)
    crps, below = _marginal_scores(error, deviation, w)
    off = error.nan_to_num().unsqueeze(1) + deviation
    crps = _make_fair(
        crps, (w.unsqueeze(1) @ off.abs()).squeeze(1), w.square().sum(-1, keepdim=True)
    )
    quantiles = (torch.arange(_POINTS, device=w.device, dtype=w.dtype) + 0.5) / _POINTS
    index = torch.searchsorted(w.cumsum(-1), quantiles.repeat(len(w), 1)).clamp(max=w.shape[1] - 1)
    points = error.unsqueeze(1) + deviation.gather(
        1, index.unsqueeze(-1).expand(-1, -1, error.shape[1])
    )
    share = (index.unsqueeze(1) == index.unsqueeze(2)).to(w).mean((1, 2))
    parts = off.new_tensor([[float(k in c) for c in groups] for k in range(off.shape[-1])])
    distance = (w.unsqueeze(1) @ (off.square() @ parts).sqrt()).squeeze(1)

    def score_group(g: int, components: list[int]) -> Tensor:
        selected = points[..., components]
        near = selected.norm(dim=-1).mean(1)
        return _make_fair(_energy_score(selected), near, share) + distance[:, g] - near

    return _make_scores(error, crps, below, groups, score_group)


def _make_fair(score: Tensor, distance: Tensor, share: Tensor) -> Tensor:
    """Average over pairs of different particles: score = distance - half the mean over all pairs.

    `share` is the part of a particle and itself among all pairs, the sum of the squared weights.
    """
    return torch.where(share < 1.0, distance - (distance - score) / (1.0 - share), distance)


def score_normal(error: Tensor, covariance: Tensor, groups: Groups) -> ProperScores:
    """Compute the scores of normal distributions, the energy score to 1e-7.

    Shapes: error [R, d], covariance [R, d, d].
    """
    import scoringrules  # on use, as below

    sd = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0.0).sqrt()
    spread = torch.where(sd > 0, sd, 1.0)
    crps = scoringrules.crps_normal(torch.zeros_like(error), error, spread, backend="torch")
    crps = torch.where(sd > 0, crps, error.abs())

    def score_group(_: int, components: list[int]) -> Tensor:
        block = covariance[:, components][:, :, components]
        value, axes = torch.linalg.eigh(block.nan_to_num())
        along = (error[:, None, components] @ axes).squeeze(1)
        distance = _mean_length(torch.zeros_like(along), 2.0 * value)
        return _mean_length(along, value) - 0.5 * distance + 0.0 * block.sum((1, 2))

    return _make_scores(error, crps, torch.special.ndtr(-error / sd), groups, score_group)


def _mean_length(mean: Tensor, variance: Tensor) -> Tensor:
    """Compute E |x| of independent normal components [R, k] as [R].

    E sqrt(q) = pi^(-1/2) int_0^inf (1 - E exp(-s^2 q)) s^(-2) ds for q = |x|^2, by the trapezoidal rule in log s, whose
    error falls exponentially with the step. Beyond its range the integrand is exponential, and the sum geometric.
    """
    variance = variance.clamp(min=0.0)
    scale = (mean.square() + variance).sum(-1, keepdim=True).sqrt()
    unit = torch.where(scale > 0, scale, 1.0)
    nodes = torch.arange(-6.0, 8.0 + _STEP, _STEP, device=mean.device, dtype=mean.dtype)
    square = torch.exp(2.0 * nodes).unsqueeze(-1) / unit.unsqueeze(-1).square()  # [R, nodes, 1]
    spread = 1.0 + 2.0 * square * variance.unsqueeze(1)
    log_mean = -(0.5 * spread.log() + square * mean.square().unsqueeze(1) / spread).sum(-1)
    height = -torch.expm1(log_mean) * torch.exp(-nodes)
    ends = (height[:, 0] + height[:, -1]) / math.expm1(_STEP)
    return scale.squeeze(-1) * (_STEP / math.sqrt(math.pi)) * (height.sum(-1) + ends)


def _separate_marginals(error: Tensor, deviation: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Compute CRPS and probability below the truth, [R, d], by library operations."""
    import scoringrules  # on use: it takes a tenth of the start of a job, and the kernels do not need it

    off = (error.unsqueeze(1) + deviation).permute(0, 2, 1)  # particles minus truth [R, d, N]
    shared = w.unsqueeze(1).expand_as(off)
    crps = scoringrules.crps_ensemble(
        torch.zeros_like(error), off, ens_w=shared, estimator="qd", backend="torch"
    )
    return crps, (shared * (off < 0)).sum(-1) + 0.5 * (shared * (off == 0)).sum(-1)


def _separate_energy(points: Tensor) -> Tensor:
    """Compute the energy score [R] of points [R, n, s] by library operations."""
    import scoringrules  # on use, as above

    return scoringrules.es_ensemble(points.new_zeros(points[:, 0].shape), points, backend="torch")


# Without these kernels ten scored steps took half as long as 300 steps of a filter [measured].
_marginal_scores = compilable(
    _separate_marginals,
    operator=dispatch.marginal_scores,
    keep_in_graph=False,
    use_torch_compiler=False,
)
_energy_score = compilable(
    _separate_energy, operator=dispatch.energy_score, keep_in_graph=False, use_torch_compiler=False
)


def _make_scores(
    error: Tensor,
    crps: Tensor,
    pit: Tensor,
    groups: Groups,
    score_group: Callable[[int, list[int]], Tensor],
) -> ProperScores:
    """Add the energy scores, that of one component its CRPS, and NaN of the truth."""
    has_truth = ~torch.isnan(error)
    energy = [
        crps[:, c[0]] if len(c) == 1 else score_group(g, c) for g, c in enumerate(map(list, groups))
    ]
    crps, pit = (torch.where(has_truth, values, torch.nan) for values in (crps, pit))
    return ProperScores(crps, pit, torch.stack(energy, 1))
