"""Health of each run, from what a filter itself can see: moments, weights and innovations.

The definitions need no truth:

- **lost**: the filter failed numerically. Its evidence is not finite.
- **collapsed**: the innovations are impossible, and the spread or the effective sample size is at
  its floor, so that the measurements cannot correct the estimate any more. A single step is enough
  in two cases. The spread is at its floor and the estimate is farther from the raw measurement than
  five of its standard deviations. Or no component has a variance (in float64: above rounding), and
  the initial state was uncertain. Moments that are not finite count as collapsed, too, and so does a
  spread that the number type does not resolve, see `pfbench.filter.resolution`.
- **diverged**: the estimate is farther from the raw measurements than five times their standard
  deviation, in more than half of the checked steps or in the last four.
- **overconfident**: the normalised innovation squared (NIS) exceeds the 0.999 quantile of its
  distribution in more than half of the checked steps.
- **heavy-tailed**: no stage bounds the weights (`has_bounded_weights`), and their Pareto k-hat
  exceeds 0.7 in two of the checked steps. k-hat of a run is the second largest of these steps. A
  filter that states a bound is not judged: its weights are few where measurements are sharp, which
  the effective sample size shows. Weights that no particle has reached are not seen.
- **implausible**: in some step even the best prediction is a thousand standard deviations from the
  measurement: the log evidence of the step is below -5e5.
- **undefined**: the log likelihood of the model is NaN for a valid state. It counts as 0 probability, and
  the estimate belongs to another model. Sixteen particles of each checked step are tried.

A filter without a covariance is judged by its estimates: lost, diverged, or collapsed if they are
not finite. Measurement outliers rarely reach these limits: with 10 % of outliers in 0.02 % of runs. They are ours. Where a
truth exists, `pfbench.results.status` decides by the error instead.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from scipy.special import chdtri
from torch import Tensor

from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, StepInfo
from pfbench.filter.misfit import compute_misfit, compute_misfits, uncounted_observation
from pfbench.filter.pareto_tail import RELIABLE_K, fit_pareto_k
from pfbench.filter.particle.particle_moments import compute_once
from pfbench.filter.resolution import is_coarse, is_ill_conditioned, starts_certain
from pfbench.filter.run_batches import join_runs
from pfbench.model.base import StateSpaceModel

HEALTH = (
    *("ok", "lost", "collapsed", "diverged", "overconfident"),
    *("heavy-tailed", "implausible", "undefined"),
)

_CHECKS = 10  # steps: the ones that `job` scores by default, so that nothing is computed twice
_MISFIT = 5.0  # standard deviations of the raw measurement, as in the divergence threshold
_LAST = 4  # checked steps that decide at the end
_MIN_ESS = 1.5
_IMPLAUSIBLE = -0.5 * 1000.0**2  # log evidence of a step: at a thousand standard deviations
_TAILS = 2  # checked steps with a heavy tail that mark a run
_TRIED = 16  # particles of a checked step whose likelihood is tried
_ROUNDING = 64.0  # of a weighted mean of equal particles, in units of the last place


class HealthCheck(NamedTuple):
    """Numbers of the checked steps, each [C, R].

    Attributes:
        nis: NIS under the predicted moments; NaN if the filter does not support it.
        misfit: NIS of the estimate itself, under the measurement noise alone.
        observed: Number of observed components.
        has_spread: Whether spread and effective sample size are above their floor.
        is_finite: Whether mean and variance are finite and no variance is negative.
        is_coarse: Whether the number type does not resolve a standard deviation of a Gaussian filter.
    """

    nis: Tensor
    misfit: Tensor
    observed: Tensor
    has_spread: Tensor
    is_finite: Tensor
    is_coarse: Tensor


class HealthMonitor:
    """Observer of a filter pass that classifies the runs.

    Args:
        record: Prepared record, which decides the checked steps.
        fits_tails: Whether the weights of particles are unbounded, so that their tails are fitted.

    Attributes:
        steps: Checked steps, at most ten of those with a measurement.
    """

    def __init__(self, record: Record, fits_tails: bool = False) -> None:
        observed = (~torch.isnan(record.y)).any(2).any(0).nonzero().flatten().tolist()
        count = len(observed)
        self.steps = frozenset(
            observed[(k + 1) * count // _CHECKS - 1]
            for k in range(_CHECKS)
            if (k + 1) * count >= _CHECKS
        )
        self._limits = torch.tensor(
            [torch.inf, *chdtri(range(1, record.y.shape[2] + 1), 0.001)],
            dtype=torch.float64,
            device=record.y.device,
        )
        self._nis: dict[int, Tensor] = {}
        self._has_particles, self._has_covariance = False, True
        self._checks: HealthCheck | None = None
        self._collapsed = torch.zeros(len(record.y), dtype=torch.bool, device=record.y.device)
        self._undefined = torch.zeros_like(self._collapsed)
        self._implausible = torch.zeros_like(self._collapsed)
        self._fits_tails, self._tails = fits_tails, list[Tensor]()
        self._first = observed[0] if observed else -1

    def check(
        self,
        t: int,
        model: StateSpaceModel,
        record: Record,
        info: StepInfo,
        beliefs: Sequence[Any] = (),
    ) -> None:
        """Check a step, if it is one of `steps`.

        Args:
            t: Step number from 0.
            model: State-space model; `at_step` gives the model of the step.
            record: Prepared record of all steps.
            info: Estimate of the step.
            beliefs: Beliefs after the step of all batches of runs.
        """
        if t in self.steps:
            if beliefs and isinstance(beliefs[0], ParticleBelief):
                self._check_particles(model.at_step(t), record.at_step(t), beliefs)
            self._has_particles, self._has_covariance = info.cloud is not None, info.has_covariance
            with uncounted_observation(model):
                nis = info.nis()[0] if info.nis is not None else None
            self._nis[t] = torch.full_like(info.mean[:, 0], torch.nan) if nis is None else nis
        # the prior is widest before the first measurement, so that this step is decisive
        is_judged = info.cloud is None and info.has_covariance and info.mean.dtype != torch.float64
        if is_judged and (t in self.steps or t == self._first):
            self._collapsed |= is_ill_conditioned(info.covariance())

    def _check_particles(
        self, model: StateSpaceModel, record: Record, beliefs: Sequence[ParticleBelief]
    ) -> None:
        """Try the likelihood of some particles, and fit the tail of their weights."""
        spacing = max(1, beliefs[0].x.shape[1] // _TRIED)
        x = join_runs([belief.x[:, ::spacing] for belief in beliefs])
        with uncounted_observation(model):
            log_likelihood = model.log_likelihood(record.y, x, record.u)
        is_undefined = torch.isnan(log_likelihood) & torch.isfinite(x).all(-1)
        self._undefined |= is_undefined.any(1)
        if self._fits_tails:
            self._tails.append(fit_pareto_k(join_runs([belief.log_w for belief in beliefs])))

    def check_evidence(self, log_evidence: Tensor) -> Tensor:
        """Mark the runs that a measurement is far from in some step.

        Args:
            log_evidence: Log evidence up to each step, [R, T].

        Returns:
            Steps in which a run is not lost, [R, T].
        """
        gain = torch.diff(log_evidence, prepend=torch.zeros_like(log_evidence[:, :1]))
        self._implausible = ((gain < _IMPLAUSIBLE) & torch.isfinite(gain)).any(1)
        return torch.isfinite(log_evidence)

    @property
    def pareto_k(self) -> Tensor:
        """k-hat of each run, float64 [R]; NaN where no tail was fitted."""
        if not self._tails:
            return torch.full(self._collapsed.shape, torch.nan, dtype=torch.float64).to(
                self._collapsed.device
            )
        k = torch.stack(self._tails).nan_to_num(nan=-torch.inf, posinf=torch.inf)
        k = k.topk(min(_TAILS, len(k)), 0).values[-1]
        return torch.where(k > -torch.inf, k, torch.nan)

    def check_moments(
        self,
        model: StateSpaceModel,
        record: Record,
        mean: Tensor,
        variance: Tensor,
        ess: Tensor | None = None,
    ) -> None:
        """Check the moments of the checked steps, and mark runs whose spread is at its floor.

        The floor is checked in all steps at once. The measurement is evaluated only where it decides.
        Without an impossible measurement it is a collapse unless the initial state was certain.

        Args:
            model: State-space model; `at_step` gives the model of a step.
            record: Prepared record of all steps.
            mean: Estimates, [R, T, D].
            variance: Variances, [R, T, d].
            ess: Effective sample sizes, [R, T]; None for a Gaussian filter.
        """
        if self._nis:
            self._checks = self._check(model, record, mean, variance, ess)
        at_floor = ~_has_spread(model, mean, variance) & self._has_covariance
        for t in (at_floor & torch.isfinite(mean).all(-1)).any(0).nonzero().flatten().tolist():
            misfit, observed = compute_misfit(model.at_step(t), record.at_step(t), mean[:, t])
            self._collapsed |= at_floor[:, t] & _is_far(misfit, observed)
        is_point = at_floor if variance.dtype == torch.float64 else (variance == 0.0).all(-1)
        is_point = (is_point & torch.isfinite(mean).all(-1)).any(-1)
        if bool(is_point.any()):
            self._collapsed |= is_point & ~starts_certain(model, len(mean), record.spread)

    def classify(self, lost: Tensor) -> Tensor:
        """Return the health of each run.

        Args:
            lost: Lost runs, [R].

        Returns:
            Index in `HEALTH`, int8 [R].
        """
        health = torch.zeros(lost.shape, dtype=torch.int8, device=lost.device)
        if self._checks is not None:
            nis, misfit, observed, has_spread, is_finite, coarse = self._checks
            limit = self._limits[observed]
            is_impossible = _in_majority(nis.double() > limit, ~torch.isnan(nis))
            is_far = _is_far(misfit, observed)
            valid = ~torch.isnan(misfit) & (observed > 0)
            diverged = _in_majority(is_far, valid) | (is_far | ~valid)[-_LAST:].all(0) & valid[-1]
            at_floor = ~has_spread & (observed > 0)
            collapsed = (is_impossible | diverged) & _in_majority(at_floor, observed > 0)
            collapsed |= ~is_finite.all(0) | _in_majority(coarse, is_finite)
            for name, mask in (
                ("heavy-tailed", self.pareto_k > RELIABLE_K),
                ("implausible", self._implausible),
                ("overconfident", is_impossible),
                ("diverged", diverged),
                ("collapsed", collapsed),
            ):
                health[mask] = HEALTH.index(name)
        health[self._collapsed] = HEALTH.index("collapsed")
        health[self._undefined] = HEALTH.index("undefined")
        health[lost] = HEALTH.index("lost")
        return health

    def _check(
        self,
        model: StateSpaceModel,
        record: Record,
        mean: Tensor,
        variance: Tensor,
        ess: Tensor | None,
    ) -> HealthCheck:
        """Compute the numbers of the checked steps from moments [R, T, ...] of all steps."""
        steps = list(self._nis)
        misfit, observed = compute_misfits(model, record, mean, steps)
        mean, variance = mean[:, steps].transpose(0, 1), variance[:, steps].transpose(0, 1)
        has_spread = _has_spread(model, mean, variance) | (not self._has_covariance)
        if ess is not None:
            has_spread = has_spread & (ess[:, steps].T >= _MIN_ESS)
        is_finite = torch.isfinite(mean).all(-1)
        if self._has_covariance:
            is_finite &= (variance >= 0.0).all(-1) & torch.isfinite(variance).all(-1)
        coarse = torch.zeros_like(is_finite)
        if not self._has_particles:
            coarse = is_coarse(_distance(model, mean), variance).any(-1)
        nis = torch.stack(list(self._nis.values()))
        return HealthCheck(nis, misfit, observed, has_spread, is_finite, coarse)


def with_cached_nis(info: StepInfo) -> StepInfo:
    """Return an info whose NIS is computed once, for the health and for scores."""
    return info if info.nis is None else info._replace(nis=compute_once(info.nis))


def count_health(health: Tensor) -> dict[str, int]:
    """Count the runs of each health.

    Args:
        health: Index in `HEALTH`, [R].

    Returns:
        Number of runs by name, zeros included.
    """
    counts = torch.bincount(health.long(), minlength=len(HEALTH)).tolist()
    return dict(zip(HEALTH, counts, strict=True))


def _in_majority(mask: Tensor, valid: Tensor) -> Tensor:
    """Return the runs [R] in which more than half of the valid steps [C, R] are marked."""
    return 2 * (mask & valid).sum(0) > valid.sum(0)


def _distance(model: StateSpaceModel, mean: Tensor) -> Tensor:
    """Return the absolute size of each component of states [..., D], [..., d]."""
    return model.error(mean, torch.zeros_like(mean)).abs()


def _has_spread(model: StateSpaceModel, mean: Tensor, variance: Tensor) -> Tensor:
    """Return where a component of estimates [..., D] has a variance [..., d] above rounding."""
    floor = _ROUNDING * torch.finfo(variance.dtype).eps * _distance(model, mean)
    return (variance > floor * floor).any(-1)


def _is_far(misfit: Tensor, observed: Tensor) -> Tensor:
    """Return where an estimate is farther from the raw measurement than the limit."""
    return misfit.double() > _MISFIT**2 * observed
