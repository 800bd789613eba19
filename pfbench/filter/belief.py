"""Belief, which the next step needs, information of a step for reports, log weights and moments of particles."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple, Protocol, TypeVar, runtime_checkable

import torch
from torch import Tensor

from pfbench.core.chart import Chart
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.kernels import dispatch
from pfbench.kernels.dispatch import compilable
from pfbench.model.base import StateSpaceModel


class ParticleBelief(NamedTuple):
    """Weighted particles.

    Attributes:
        x: Particles, [R, N, D]; fastest component-major in memory, a permuted contiguous [D, R, N].
        log_w: Log weights, [R, N], logsumexp 0; -inf marks an inactive slot.
        log_evidence: Log evidence so far, [R]; -inf if the run is lost.
        window: Past of the particles for moves, [R, N, L, ...], gathered with them.
        memory: Memory of the proposal, [R, N or 1, ...], gathered with the particles.
        past: Records of the steps in the window, oldest first, as `Record.at` returns them.
        ancestors: Slot that each particle copies within a step, [R, N]; N or more if a move changed
            it. None if the particles are not copies.
        weights: Weights of earlier or present log weights, see `exponentiate`.
    """

    x: Tensor
    log_w: Tensor
    log_evidence: Tensor
    window: dict[str, Tensor] = {}  # noqa: RUF012
    memory: dict[str, Tensor] = {}  # noqa: RUF012
    past: tuple[Record, ...] = ()
    ancestors: Tensor | None = None
    weights: ComputedWeights | None = None


class GaussianBelief(NamedTuple):
    """Normal distribution in the chart about `mean`.

    Attributes:
        mean: [R, D].
        covariance: [R, d, d]; NaN if the filter states none.
        log_evidence: Log evidence so far, [R]; -inf if the run is lost.
        memory: Memory of the adaptations, [R, ...].
    """

    mean: Tensor
    covariance: Tensor
    log_evidence: Tensor
    memory: dict[str, Tensor] = {}  # noqa: RUF012


class StepInfo(NamedTuple):
    """Information of a step for the report.

    Attributes:
        mean: Estimate, [R, D].
        variance: [R, d]; NaN if the filter states no covariance.
        covariance: Computes the covariance in the chart, [R, d, d]. For particles it costs a tenth
            of a step.
        trace: Numbers per run, {name: [R]}, such as `ess` or `resampled`.
        cloud: Computes deviations of the particles from the mean [R, N, d] and log weights [R, N].
            None for a Gaussian filter. Of particles with a covariance, one draw of each.
        nis: Computes the normalised innovation squared under the predicted moments, and the number
            of observed components, [R] each. None if the filter does not support it.
        group_covariance: Computes covariances of groups of components [R, G, s, s] from indices
            [G, s], where that is cheaper than the full covariance.
        has_covariance: False if the filter states no covariance. Its moments are NaN.
        conditional: Computes standard deviations of particles that are normal distributions, [R, N or 1, d],
            and the deviations [R, N, d] of the draws in `cloud` from their means. None for points.
    """

    mean: Tensor
    variance: Tensor
    covariance: Callable[[], Tensor]
    trace: dict[str, Tensor]
    cloud: Callable[[], tuple[Tensor, Tensor]] | None = None
    nis: Callable[[], tuple[Tensor, Tensor]] | None = None
    group_covariance: Callable[[Tensor], Tensor] | None = None
    has_covariance: bool = True
    conditional: Callable[[], tuple[Tensor, Tensor]] | None = None

    def covariance_of(self, groups: Tensor) -> Tensor:
        """Return covariances [R, G, s, s] of groups of components, indices [G, s]."""
        if self.group_covariance is not None:
            return self.group_covariance(groups)
        return self.covariance()[:, groups.unsqueeze(-1), groups.unsqueeze(-2)]


class KeptSteps(NamedTuple):
    """Steps whose belief and information are read when several steps were taken together.

    Attributes:
        checked: Step numbers from 0. Their NIS is read, so it is computed together.
        all_steps: Whether those of all other steps are read, too.
    """

    checked: frozenset[int] = frozenset()
    all_steps: bool = True

    def select_rows(self, first: int, steps: int) -> list[int]:
        """Return the kept ones of some steps from `first` on, as indices from 0."""
        return [k for k in range(steps) if self.all_steps or first + k in self.checked]


class StepBlock(NamedTuple):
    """Consecutive steps of a filter.

    Attributes:
        first: Number of the first step, from 0.
        mean: [R, S, D].
        variance: [R, S, d].
        log_evidence: Log evidence so far, [R, S].
        trace: Numbers per run and step, {name: [R, S]}.
        beliefs: Belief of each batch of runs after the kept steps, by step number.
        infos: Information of the kept steps.
    """

    first: int
    mean: Tensor
    variance: Tensor
    log_evidence: Tensor
    trace: dict[str, Tensor]
    beliefs: dict[int, tuple[Any, ...]]
    infos: dict[int, StepInfo]

    @staticmethod
    def of_step(t: int, belief: Any, info: StepInfo) -> StepBlock:
        """Return the block of a single step."""
        return StepBlock.of_steps(
            t, [(*info[:2], belief.log_evidence, info.trace)], {t: (belief, info)}
        )

    @staticmethod
    def of_steps(
        first: int,
        steps: Sequence[tuple[Tensor, Tensor, Tensor, dict[str, Tensor]]],
        clouds: dict[int, tuple[Any, StepInfo]],
    ) -> StepBlock:
        """Return the block of mean, variance, log evidence and trace of each step, with belief and information of those that are read."""
        *numbers, traces = zip(*steps, strict=True)
        trace = {name: torch.stack([a[name] for a in traces], 1) for name in traces[0]}
        beliefs, infos = ({t: pair[k] for t, pair in clouds.items()} for k in (0, 1))
        mean, variance, log_evidence = (torch.stack(a, 1) for a in numbers)
        single = {t: (belief,) for t, belief in beliefs.items()}
        return StepBlock(first, mean, variance, log_evidence, trace, single, infos)

    @property
    def steps(self) -> range:
        """Numbers of the steps."""
        return range(self.first, self.first + self.mean.shape[1])

    def select(self, rows: slice) -> StepBlock:
        """Return some of the steps, as indices from 0."""
        steps, (mean, variance, log_evidence) = self.steps[rows], (a[:, rows] for a in self[1:4])
        trace = {name: a[:, rows] for name, a in self.trace.items()}
        beliefs = {t: belief for t, belief in self.beliefs.items() if t in steps}
        infos = {t: info for t, info in self.infos.items() if t in steps}
        return StepBlock(steps.start, mean, variance, log_evidence, trace, beliefs, infos)


@runtime_checkable
class Filter(Protocol):
    """Stateless filter: computes the next belief from a belief and a record."""

    @property
    def is_exact(self) -> bool:
        """True if the belief converges to p(x_t | y_1:t) as N grows."""

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief | GaussianBelief:
        """Return the initial belief.

        Args:
            model: State-space model.
            runs: Number of runs R.
            draws: Random stream of step 0.
            start: Centre, [R, D]. The model's `origin` by default.
            spread: Cholesky factor of a normal distribution, [R, d, d]. The model's initial
                distribution by default.

        Returns:
            Belief of R runs.
        """

    def step(
        self, model: StateSpaceModel, belief: Any, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief | GaussianBelief, StepInfo]:
        """Take a step.

        Args:
            model: State-space model of the step.
            belief: Belief before the step.
            record: Measurements and inputs of the step.
            draws: Random stream of the step.

        Returns:
            Belief after the step, and its information.
        """


def gather_ancestors(
    belief: ParticleBelief,
    ancestors: Tensor,
    log_w: Tensor | None = None,
    x: Tensor | None = None,
) -> ParticleBelief:
    """Copy particles by their ancestors, with weights, window and memory.

    Args:
        belief: Weighted particles.
        ancestors: Slots, [R, M].
        log_w: Log weights of the copies, [R, M]. Those of the ancestors by default.
        x: The copied states, [R, M, D], if they are known.

    Returns:
        Particles, [R, M, D].
    """
    return belief._replace(
        x=_gather_states(belief.x, ancestors) if x is None else x,
        log_w=belief.log_w.gather(1, ancestors) if log_w is None else log_w,
        window={k: _gather_rows(v, ancestors) for k, v in belief.window.items()},
        memory={k: _gather_rows(v, ancestors) for k, v in belief.memory.items()},
        ancestors=ancestors,
    )


def select_by_run(
    resampled_mask: Tensor, new: ParticleBelief, old: ParticleBelief
) -> ParticleBelief:
    """Return `new` for resampled runs and `old` for others; the evidence is of `new`.

    Shapes: resampled_mask [R].
    """

    def choose(a: Tensor, b: Tensor) -> Tensor:
        return torch.where(resampled_mask.reshape(-1, *[1] * (a.dim() - 1)), a, b)

    return ParticleBelief(
        x=torch.where(
            resampled_mask[:, None], new.x.permute(2, 0, 1), old.x.permute(2, 0, 1)
        ).permute(1, 2, 0),
        log_w=choose(new.log_w, old.log_w),
        log_evidence=new.log_evidence,
        window={k: choose(v, old.window[k]) for k, v in new.window.items()},
        memory={k: choose(v, old.memory[k]) for k, v in new.memory.items()},
        past=new.past,
        ancestors=None
        if new.ancestors is None
        else choose(new.ancestors, torch.arange(old.log_w.shape[1], device=resampled_mask.device)),
    )


def normalise_log_weights(log_w: Tensor) -> Tensor:
    """Return normalised weights [R, N] of log weights."""
    return torch.softmax(log_w, dim=-1)


def ess(log_w: Tensor) -> Tensor:
    """Return the effective sample size 1 / sum w^2, [R]."""
    return 1.0 / normalise_log_weights(log_w).square().sum(-1)


def weighted_mean_cov(chart: Chart, belief: ParticleBelief) -> tuple[Tensor, Tensor]:
    """Return the weighted mean and covariance of particles.

    Returns mean [R, D] and covariance in the chart about it, [R, d, d].
    """
    w = normalise_log_weights(belief.log_w)
    mean = chart.mean(belief.x, w)
    d = chart.subtract(belief.x, mean.unsqueeze(1))
    return mean, (w.unsqueeze(-1) * d).mT @ d


def _gather_states(x: Tensor, ancestors: Tensor) -> Tensor:
    """Gather [R, N, D] by ancestors [R, M], in the memory order of x."""
    return (
        _gather_components(x.permute(2, 0, 1), ancestors).permute(1, 2, 0)
        if x.permute(2, 0, 1).is_contiguous()
        else x.mT.gather(2, ancestors.unsqueeze(1).expand(-1, x.shape[2], -1)).mT
    )


def _select_components(first: Tensor, ancestors: Tensor) -> Tensor:
    """Gather [D, R, N] by ancestors [R, M]."""
    d, runs, n = first.shape
    # one flat index costs a fifth of an expanded one
    flat = ancestors + n * torch.arange(runs, device=first.device)[:, None]
    return first.reshape(d, runs * n).index_select(1, flat.flatten()).reshape(d, *ancestors.shape)


_gather_components = compilable(_select_components, operator=dispatch.gather_particles)


def _gather_rows(a: Tensor, ancestors: Tensor) -> Tensor:
    """Gather [R, N or 1, ...] by ancestors [R, M]."""
    if a.shape[1] == 1:  # shared by all particles of a run
        return a
    (runs, n, *rest), dims = a.shape, a.dim()
    first = a.permute(*range(2, dims), 0, 1)
    if rest and first.is_contiguous():  # keep particles last in memory
        copies = _gather_components(first.reshape(math.prod(rest), runs, n), ancestors)
        return copies.reshape(*rest, *ancestors.shape).permute(dims - 2, dims - 1, *range(dims - 2))
    return a.gather(1, ancestors.reshape(*ancestors.shape, *[1] * len(rest)).expand(-1, -1, *rest))


# --------------------------------------------------------------------------------------------------
# Log weights of particles: sums, normalisation, and the weights themselves.


class ComputedWeights(NamedTuple):
    """Weights that were computed with their logarithms.

    Attributes:
        log_w: Log weights, [R, N].
        w: Weights, [R, N].
    """

    log_w: Tensor
    w: Tensor


def exponentiate(log_w: Tensor, computed: ComputedWeights | None) -> Tensor:
    """Return e to the power of log weights.

    Returns weights, [R, N]. Shapes: log_w [R, N].
    """
    return computed.w if computed is not None and computed.log_w is log_w else torch.exp(log_w)


def is_resolved(maximum: Tensor) -> Tensor:
    """Return whether log weights differ by more than rounding, from their maximum.

    Below -1 / eps neighbouring numbers differ by 1 or more, so that the weights are noise: in double
    precision at 1e8 standard deviations from the measurement.
    """
    return maximum > -1.0 / torch.finfo(maximum.dtype).eps


def is_equal_for_all(a: Tensor) -> bool:
    """Return whether numbers [R, N] are stored once for all particles of a run."""
    return a.stride(1) == 0


def _narrow(a: Tensor) -> Tensor:
    """Return numbers [R, N] as [R, 1] if they are stored once for all particles of a run."""
    return a[:, :1] if is_equal_for_all(a) else a


def add_log_weights(log_likelihood: Tensor, log_w: Tensor, log_ratio: Tensor) -> Tensor:
    """Add the terms of log weights.

    Returns sum [R, N], -inf in place of NaN. Shapes: log_likelihood [R, N], log_w [R, N], log_ratio
    [R, N].
    """
    return _add_terms(log_likelihood, _narrow(log_w), _narrow(log_ratio))


def _separate_sum(log_likelihood: Tensor, log_w: Tensor, log_ratio: Tensor) -> Tensor:
    """Return the sum [R, N] of terms [R, N] or [R, 1], -inf in place of NaN."""
    value = log_likelihood + log_w + log_ratio
    return torch.where(value == value, value, -torch.inf)  # isnan does not compile


def _separate_normalise(log_w: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Normalise the log weights of a step.

    A run without a finite weight gets equal weights, as one whose log weights are not resolved.

    Returns normalised log weights [R, N], their logsumexp before [R] (-inf if none is finite),
    weights [R, N] and effective sample size [R]. Shapes: log_w [R, N].
    """
    # one exponential per particle, because exponentials dominate the cost of a small step
    maximum = log_w.detach().amax(1, keepdim=True)
    resolved = is_resolved(maximum)
    maximum = torch.where(torch.isfinite(maximum), maximum, 0.0)
    scaled_w = torch.exp(log_w - maximum)
    total, square_total = _totals(scaled_w)
    lost = ~(torch.isfinite(total) & (total > 0.0) & resolved)
    total, slots = torch.where(lost, 1.0, total), log_w.shape[1]
    log_total = maximum + torch.log(total)
    log_w = torch.where(lost, -math.log(slots), log_w - log_total)
    w = torch.where(lost, 1.0 / slots, scaled_w * (1.0 / total))
    ess = torch.where(lost, slots, total * total / square_total).squeeze(1)
    return log_w, torch.where(lost, -torch.inf, log_total).squeeze(1), w, ess


def _separate_totals(a: Tensor) -> tuple[Tensor, Tensor]:
    """Return sums of rows [R, N] and of their squares, [R, 1] each."""
    return a.sum(1, keepdim=True), a.square().sum(1, keepdim=True)


def has_long_rows(a: Tensor, *_: Tensor) -> bool:
    """Return whether the compiler cannot sum rows [R, N, ...] in registers."""
    return a.shape[1] > 4096


_add_terms = compilable(
    _separate_sum, operator=dispatch.sum_log_weights, keep_in_graph=False, use_torch_compiler=False
)


_totals = compilable(
    _separate_totals, operator=dispatch.sum_and_squares, keep_in_graph=has_long_rows
)


normalise_updated_weights = compilable(
    _separate_normalise,
    operator=dispatch.normalise_weights,
    keep_in_graph=False,
    use_torch_compiler=False,
)


# --------------------------------------------------------------------------------------------------
# Moments and diagnostics of weighted particles, for the information of a step.

T = TypeVar("T")


def compute_once(function: Callable[[], T]) -> Callable[[], T]:
    """Make a function that computes its value at the first call only.

    One is made at each step, and `functools.cache` takes 5 microseconds to make.
    """
    values: list[T] = []

    def call() -> T:
        if not values:
            values.append(function())
        return values[0]

    return call


class StepSummary(NamedTuple):
    """Moments and diagnostics of one filter step.

    Attributes:
        mean: Mean of the particles, [R, D].
        variance: Variance in the chart, [R, d].
        predicted_log_w: Log weights before the measurement update, [R, N], not normalised.
        trace: Numbers per run, {name: [R]}.
    """

    mean: Tensor
    variance: Tensor
    predicted_log_w: Tensor
    trace: dict[str, Tensor]


def summarise(model: StateSpaceModel, belief: ParticleBelief, trace: dict[str, Tensor]) -> StepInfo:
    """Return mean and variance of particles for a report, without a copy of them.

    Shapes: trace [R].
    """
    return make_step_info(
        model,
        belief,
        *weighted_mean_variance(model, belief, normalise_log_weights(belief.log_w)),
        trace,
    )


def weighted_mean_variance(
    model: StateSpaceModel, belief: ParticleBelief, w: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the mean [R, D] and, in the chart about it, the variance [R, d].

    Shapes: w [R, N].
    """
    if model.chart.flat:
        mean, variance = _flat_moments(belief.x, w)
        return mean, variance
    mean = model.chart.mean(belief.x, w)
    return mean, (
        w.unsqueeze(-2) @ model.chart.subtract(belief.x, mean.unsqueeze(1)).square()
    ).squeeze(-2)


def make_step_info(
    model: StateSpaceModel,
    belief: ParticleBelief,
    mean: Tensor,
    variance: Tensor,
    trace: dict[str, Tensor],
    nis: Callable[[], tuple[Tensor, Tensor]] | None = None,
) -> StepInfo:
    """Make the information of a step from particles, their mean and their variance.

    Shapes: mean [R, D], variance [R, d], trace [R], nis [R].
    """

    def deviations() -> tuple[Tensor, Tensor]:
        return model.chart.subtract(belief.x, mean.unsqueeze(1)), belief.log_w

    def covariance() -> Tensor:
        d, log_w = deviations()
        return (normalise_log_weights(log_w).unsqueeze(-1) * d).mT @ d

    @compute_once
    def w() -> Tensor:  # once for all groups; the weights are normalised already
        return exponentiate(belief.log_w, belief.weights)

    def group_covariance(groups: Tensor) -> Tensor:
        if model.chart.flat:
            return compute_spread(belief.x, mean, w(), groups)
        return compute_spread(deviations()[0], torch.zeros_like(variance), w(), groups)

    return StepInfo(mean, variance, covariance, trace, deviations, nis, group_covariance)


def _count_distinct(copy_of: Tensor, log_w: Tensor) -> Tensor:
    """Count distinct values below 2 N in copy_of [R, N] at active slots, [R]."""
    marks = torch.zeros(len(copy_of), 2 * copy_of.shape[1], dtype=log_w.dtype, device=log_w.device)
    return (marks.scatter_add_(1, copy_of, (log_w > -torch.inf).to(log_w.dtype)) > 0.0).sum(1)


count_distinct_ancestors = compilable(_count_distinct, operator=dispatch.count_unique)


def _separate_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Return weighted mean and variance [R, D], by matrix products."""
    mean = w.unsqueeze(-2) @ x
    d = x - mean
    return mean.squeeze(-2), (w.unsqueeze(-2) @ (d * d)).squeeze(-2)


def _fused_moments(x: Tensor, w: Tensor) -> tuple[Tensor, Tensor]:
    """Return weighted mean and variance [R, D] of numbers [R, N, D] by weights [R, N]."""
    components = x.permute(2, 0, 1)
    mean = (w * components).sum(-1)
    d = components - mean.unsqueeze(-1)
    return mean.T, (w * d * d).sum(-1).T


def _separate_spread(x: Tensor, mean: Tensor, w: Tensor, groups: Tensor) -> Tensor:
    """Return covariances [R, G, s, s] of groups [G, s] of numbers [R, N, k]."""
    deviations = x.permute(0, 2, 1)[:, groups] - mean[:, groups].unsqueeze(-1)  # [R, G, s, N]
    return (w[:, None, None] * deviations) @ deviations.mT


compute_spread = compilable(
    _separate_spread, operator=dispatch.group_covariance, keep_in_graph=False
)


_flat_moments = compilable(
    _fused_moments,
    eager=_separate_moments,
    operator=dispatch.weighted_moments,
    keep_in_graph=has_long_rows,
)


def join_runs(batches: list[Tensor]) -> Tensor:
    """Concatenate batches of runs; return a single batch unchanged."""
    return batches[0] if len(batches) == 1 else torch.cat(batches)
