"""Health of each run, from what a filter itself can see: moments, weights and innovations.

The definitions need no truth:

- **lost**: the filter failed numerically. Its evidence is not finite.
- **collapsed**: the innovations are impossible, and the spread or the effective sample size is at
  its floor, so that the measurements cannot correct the estimate any more. A single step is enough
  in two cases. The spread is at its floor and the estimate is farther from the raw measurement than
  five of its standard deviations. Or no component has a variance (in float64: above rounding), and
  the initial state was uncertain. Moments that are not finite count as collapsed, too, and so does a
  spread that the number type does not resolve, see `pfbench.filter.health`.
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

import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from torch import Tensor

from pfbench.core.chi_square import chi_square_limit
from pfbench.core.density import has_finite_moments
from pfbench.core.record import Record
from pfbench.filter.belief import ParticleBelief, StepInfo, compute_once, join_runs
from pfbench.filter.linearisation import compute_nis
from pfbench.model.base import ModelWrapper, StateSpaceModel, initial_law

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

    Attributes:
        steps: Checked steps, at most ten of those with a measurement.
        visited: These steps, and perhaps that of the first measurement: others need no `check`.
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
            [torch.inf, *(chi_square_limit(k + 1, 0.001) for k in range(record.y.shape[2]))],
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
        # the prior is widest before the first measurement, so that this step is decisive, except in float64
        decisive = observed[:1] if record.y.dtype != torch.float64 else []
        self.visited = self.steps | frozenset(decisive)

    def check(
        self,
        model: StateSpaceModel,
        record: Record,
        beliefs: Mapping[int, Sequence[Any]],
        infos: Mapping[int, StepInfo],
    ) -> None:
        """Check the steps that are among `visited`, from the belief of each batch and the information by step."""
        steps = [t for t in infos if t in self.steps]
        if steps and beliefs and isinstance(beliefs[steps[0]][0], ParticleBelief):
            self._check_particles(model, record, [beliefs[t] for t in steps], steps)
        with uncounted_observation(model):
            for t in steps:
                info = infos[t]
                self._has_particles = info.cloud is not None
                self._has_covariance = info.has_covariance
                nis = info.nis()[0] if info.nis is not None else None
                self._nis[t] = torch.full_like(info.mean[:, 0], torch.nan) if nis is None else nis
        for info in (info for t, info in infos.items() if t in self.visited):
            if info.cloud is None and info.has_covariance and info.mean.dtype != torch.float64:
                self._collapsed |= is_ill_conditioned(info.covariance())

    def _check_particles(
        self,
        model: StateSpaceModel,
        record: Record,
        beliefs: Sequence[Sequence[ParticleBelief]],
        steps: list[int],
    ) -> None:
        """Try the likelihood of some particles after each step, and fit the tail of their weights."""
        spacing = max(1, beliefs[0][0].x.shape[1] // _TRIED)
        x = [join_runs([belief.x[:, ::spacing] for belief in batches]) for batches in beliefs]
        if may_join_steps(model, len(record.y), steps):
            self._undefined |= _is_undefined(model, torch.cat(x), record.steps_as_runs(steps)).any()
        else:
            for t, some in zip(steps, x, strict=True):
                self._undefined |= _is_undefined(model.at_step(t), some, record.at_step(t))
        if self._fits_tails:
            log_w = [join_runs([belief.log_w for belief in batches]) for batches in beliefs]
            self._tails += fit_pareto_k(torch.cat(log_w)).chunk(len(steps))

    def check_evidence(self, log_evidence: Tensor) -> Tensor:
        """Mark the runs that a measurement is far from in some step.

        Returns steps in which a run is not lost, [R, T]. Shapes: log_evidence [R, T].
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

        Shapes: mean [R, T, D], variance [R, T, d], ess [R, T].
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

        Returns index in `HEALTH`, int8 [R]. Shapes: lost [R].
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


def _is_undefined(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Return the runs [R] with a finite state in x [R, N, D] whose log likelihood is NaN."""
    with uncounted_observation(model):
        log_likelihood = model.log_likelihood(record.y, x, record.u)
    return (torch.isnan(log_likelihood) & torch.isfinite(x).all(-1)).any(1)


def with_cached_nis(info: StepInfo) -> StepInfo:
    """Return an info whose NIS is computed once, for the health and for scores."""
    return info if info.nis is None else info._replace(nis=compute_once(info.nis))


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


@contextmanager
def uncounted_observation(model: StateSpaceModel) -> Iterator[None]:
    """Evaluate `observation` by the method of the class.

    A counter of likelihood evaluations replaces that of the object. Checks are not charged to the
    filter.
    """
    inner = model
    while isinstance(inner, ModelWrapper):
        inner = inner.model
    counted = inner.__dict__.pop("observation", None)
    try:
        yield
    finally:
        if counted is not None:
            inner.__dict__["observation"] = counted


def compute_misfit(model: StateSpaceModel, record: Record, mean: Tensor) -> tuple[Tensor, Tensor]:
    """Compute the NIS of estimates under the measurement noise alone.

    Returns NIS and the number of observed components, [R] each. Shapes: mean [R, D].
    """
    with uncounted_observation(model):
        return compute_nis(model, mean.unsqueeze(1), torch.zeros_like(mean[:, :1]), record)


def may_join_steps(model: StateSpaceModel, runs: int, steps: Sequence[int]) -> bool:
    """Return whether steps of a single run may be evaluated as runs: ten calls take a third of a small filter's time.

    A model may have parameters of each run, so that several runs are evaluated step by step.
    """
    return runs == 1 and all(model.at_step(t) is model for t in steps)


def compute_misfits(
    model: StateSpaceModel, record: Record, mean: Tensor, steps: list[int]
) -> tuple[Tensor, Tensor]:
    """Compute `compute_misfit` in several steps.

    Returns NIS and the number of observed components, [C, R] each. Shapes: mean [R, T, D].
    """
    if may_join_steps(model, len(mean), steps):
        misfit, observed = compute_misfit(model, record.steps_as_runs(steps), mean[0, steps])
        return misfit.unsqueeze(1), observed.unsqueeze(1)
    results = [compute_misfit(model.at_step(t), record.at_step(t), mean[:, t]) for t in steps]
    misfits, observed_counts = zip(*results, strict=True)
    return torch.stack(misfits), torch.stack(observed_counts)


# --------------------------------------------------------------------------------------------------
# Shape of the largest weights, the Pareto k-hat: how heavy their tail is.
#
# The largest weights of a step are fitted by a generalised Pareto distribution. Above k = 0.5 the
# variance of the weights is infinite, and above 0.7 the estimate is not reliable for any number of
# particles at hand. A tail that no particle has reached is not seen.
#
# References:
#     Zhang and Stephens 2009, "A new and efficient estimation method for the generalized Pareto
#         distribution".
#     Vehtari, Simpson, Gelman, Yao and Gabry 2024, "Pareto smoothed importance sampling".

RELIABLE_K = 0.7  # largest k-hat of a reliable estimate [Vehtari et al.]

_FEWEST = 5  # weights in a tail
_PRIOR_K, _PRIOR_COUNT = 0.5, 10.0  # k-hat is shrunk as by ten weights of this shape
_PRIOR_SCALE = 3.0  # of the grid of the profile likelihood


def fit_pareto_k(log_w: Tensor) -> Tensor:
    """Estimate the shape of the tail of weights.

    The tail is the largest min(N / 5, 3 sqrt(N)) weights, less the next one.

    Returns k-hat, float64 [R]. NaN if the tail has fewer than five weights, or a quarter of them
    are equal; infinite if a few weights are all there is. Shapes: log_w [R, N].
    """
    n = log_w.shape[1]
    size = math.ceil(min(0.2 * n, 3.0 * math.sqrt(n)))
    if size < _FEWEST:
        return torch.full_like(log_w[:, 0], torch.nan, dtype=torch.float64)
    largest = log_w.double().topk(size + 1, 1).values.flip(1)  # ascending
    largest = largest - largest[:, -1:]
    w = torch.exp(largest)
    k = _fit_shape(w[:, 1:] - w[:, :1])
    quartile = largest[:, _quartile(size) + 1]
    k = torch.where(quartile > largest[:, 0], k, torch.nan)  # NaN if all are inactive, too
    return torch.where(quartile < math.log(torch.finfo(w.dtype).tiny), torch.inf, k)


def _quartile(size: int) -> int:
    """Return the index of the lower quartile of ascending numbers."""
    return int(size / 4 + 0.5) - 1


def _fit_shape(excess: Tensor) -> Tensor:
    """Return the shape of a generalised Pareto distribution [R] of ascending numbers [R, M]."""
    size = excess.shape[1]
    count = 30 + math.isqrt(size)
    rank = torch.arange(1, count + 1, dtype=excess.dtype, device=excess.device)
    quartile = excess[:, _quartile(size), None]
    grid = 1.0 / excess[:, -1:] + (1.0 - torch.sqrt(count / (rank - 0.5))) / (
        _PRIOR_SCALE * quartile
    )
    k = torch.log(1.0 - grid.unsqueeze(-1) * excess.unsqueeze(1)).mean(-1)
    profile = size * (torch.log(-grid / k) - k - 1.0)
    b = (torch.softmax(profile, 1) * grid).sum(1, keepdim=True)
    shape = torch.log1p(-b * excess).mean(1)
    return (size * shape + _PRIOR_COUNT * _PRIOR_K) / (size + _PRIOR_COUNT)


# --------------------------------------------------------------------------------------------------
# Resolution of the number type: whether it represents the standard deviations of a problem.
#
# A number x of a type has a spacing of eps |x|. The estimate of a filter is off by about the largest of these ratios, in
# standard deviations (measured for EKF, CKF and UKF on linear models, see `tests/filter/test_resolution.py`):
#
# - the spacing of a measurement against its noise,
# - the spacing of a state against its standard deviation,
# - eps against the smallest share of variance that a component has, given those before it. It is the
#   reciprocal of the condition of the correlations.
#
# The limit is a tenth of a standard deviation [ours]. A component of zero variance is known exactly and is left out. Double
# precision always passes. Of particle filters only the measurements are checked: after resampling, constant components such as
# sensor biases may be equal in all particles, in any number type.

LIMIT = 0.1  # standard deviations

_LARGE = 0.9  # quantile of the measurements that decides, so that outliers do not
_STEPS = 10
_PIVOT_SCALE = 4.0  # the error of the narrowest direction is a quarter of eps / pivot


def is_coarse(value: Tensor, variance: Tensor) -> Tensor:
    """Return where the spacing of numbers exceeds the limit."""
    if value.dtype == torch.float64:
        return torch.zeros_like(value, dtype=torch.bool)
    spacing = torch.finfo(value.dtype).eps * value.abs()
    return (spacing > LIMIT * variance.sqrt()) & (variance > 0.0)


def is_ill_conditioned(covariance: Tensor) -> Tensor:
    """Return the runs whose correlations the number type does not resolve.

    Returns mask, [R]. False where the covariance is not finite, and for float64. Shapes: covariance
    [R, d, d].
    """
    if covariance.dtype == torch.float64:
        return torch.zeros(len(covariance), dtype=torch.bool, device=covariance.device)
    variance = covariance.diagonal(dim1=-2, dim2=-1)
    sd = torch.sqrt(torch.where(variance > 0.0, variance, 1.0))
    correlation = covariance / (sd.unsqueeze(-1) * sd.unsqueeze(-2))
    fixed = torch.diag_embed((variance <= 0.0).to(sd))  # known exactly: a one on the diagonal
    lower, info = torch.linalg.cholesky_ex(correlation + fixed)
    pivot = lower.diagonal(dim1=-2, dim2=-1).square().amin(-1)
    eps = torch.finfo(covariance.dtype).eps
    is_finite = torch.isfinite(covariance).flatten(1).all(1)
    return is_finite & ((info > 0) | (eps > _PIVOT_SCALE * LIMIT * pivot))


def starts_certain(model: StateSpaceModel, runs: int, spread: Tensor | None) -> Tensor:
    """Return the runs whose initial state is known exactly.

    Returns mask, [R]. False where the variance of the initial distribution does not exist. Shapes:
    spread [R, d, d].
    """
    initial = initial_law(model, runs, spread)
    if not has_finite_moments(initial):
        return torch.zeros(runs, dtype=torch.bool, device=model.anchor.device)
    return (initial.variance == 0.0).all(-1).expand(runs)


def check_measurement_resolution(distribution: Any, y: Tensor, model: str) -> None:
    """Check that a type other than float64 resolves the measurements.

    Shapes: distribution [R, N], y [R, T, Dy].
    """
    if y.dtype == torch.float64 or not has_finite_moments(distribution):
        return
    sd = distribution.stddev.flatten(0, 1).nanmedian(0).values
    some = y[:, :: max(1, y.shape[1] // _STEPS)].flatten(0, 1).abs()
    size = some.nanquantile(_LARGE, 0)
    coarse = is_coarse(size, sd.square()).nonzero().flatten().tolist()
    if coarse:
        k, name = coarse[0], str(y.dtype).removeprefix("torch.")
        spacing = torch.finfo(y.dtype).eps * float(size[k])
        raise ValueError(
            f"dtype must resolve a tenth of the measurement noise of {model}, got {name} with a "
            f"spacing of {spacing:.2g} for component {k} of standard deviation {float(sd[k]):.2g}. "
            "Set dtype=float64."
        )
