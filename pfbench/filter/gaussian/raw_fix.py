"""Raw fix: the measurement of each step alone, solved for the state about the prediction."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pfbench.core.linear_algebra import distribution_covariance, factor
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record, iterate_steps
from pfbench.filter.belief import GaussianBelief, StepInfo
from pfbench.filter.linearisation import (
    check_moments,
    linearised_innovation,
    mask_covariance,
    mean_noise,
    measurement_jacobian,
)
from pfbench.model.base import StateSpaceModel, initial_law

_SCALE = "raw_fix_scale"  # _WIDER times the initial standard deviation, or 1 where it is 0, [R, d]
_WIDER = 100.0  # a direction is observed if its measured sd is below 100 initial sd
_DETERMINED = 0.95  # share of the variance of the main group that the measurements must see


@dataclass(frozen=True)
class RawFix:
    """The weighted least-squares solution of the measurement of a step, about the prediction.

    It is what the sensors say without a filter: no measurement is averaged with another step or with
    the prediction. Directions of the state that the measurement does not see keep the prediction, the
    noise-free step of the model from the last estimate. Where a measurement is missing the estimate is
    therefore dead reckoning from the last one. Of several solutions the nearest to the prediction is
    taken, in standard deviations of the initial distribution [ours]. A direction counts as measured if
    its standard deviation by the sensors of the step is below 100 of these [ours]. Otherwise noise alone would move a
    state that is known from the start, or one at the turning point of a curved measurement.

    The filter states neither a covariance nor an evidence: both are NaN, except that the evidence of a
    valid run is 0 in the belief.

    Raises:
        ValueError: On use, if the measurements of no step determine the main group, or if a mean or
            variance of the model is not finite.
    """

    is_exact = False
    has_evidence = False
    has_covariance = False

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> GaussianBelief:
        """Compute the belief at step 0, the mean of the initial distribution.

        Args:
            model: State-space model.
            runs: Number of runs R.
            draws: Random stream, not used.
            start: States about which the initial distribution is placed, [R, D].
            spread: Cholesky factors of the initial covariances, [R, d, d].

        Returns:
            The belief, with a covariance of NaN.

        Raises:
            ValueError: If mean or variance of the initial or the noise distribution is not finite.
        """
        initial: Any = initial_law(model, runs, spread)
        for name, distribution in (("initial", initial), ("noise", model.noise)):
            check_moments(model, name, distribution)
        origin = model.origin.expand(runs, -1) if start is None else start
        mean, d = model.chart.add(origin, initial.mean), model.chart.dimension
        log_z = torch.zeros(runs, dtype=torch.float64, device=mean.device)
        sd = initial.stddev.expand(runs, -1)
        memory = {_SCALE: _WIDER * torch.where(sd > 0.0, sd, 1.0)}
        return GaussianBelief(mean, mean.new_full((runs, d, d), torch.nan), log_z, memory)

    def init_from_record(
        self, model: StateSpaceModel, record: Record, draws: RandomStream
    ) -> GaussianBelief:
        """Compute the belief at step 0 and check that the record has fixes.

        Args:
            model: State-space model.
            record: Measurements [R, T, Dy] and inputs of all steps.
            draws: Random stream, not used.

        Returns:
            The belief, with a covariance of NaN.

        Raises:
            ValueError: As for the class.
        """
        belief = self.init(model, len(record.y), draws, record.start, record.spread)
        _check_determined(model, belief, record)
        return belief

    def step(
        self, model: StateSpaceModel, belief: GaussianBelief, record: Record, draws: RandomStream
    ) -> tuple[GaussianBelief, StepInfo]:
        """Compute the belief after a measurement.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            record: Measurement and inputs of step t.
            draws: Random stream, not used.

        Returns:
            Belief at t and its estimate, without covariance. A run whose estimate is not finite is
            lost.
        """
        prior, scale = _predict(model, belief.mean.unsqueeze(1), record), belief.memory[_SCALE]
        slope, residual = _whitened_measurement(model, prior, record, scale)
        inverse = torch.linalg.pinv(slope, atol=1.0, rtol=0.0)
        mean = model.chart.add(prior[:, 0], scale * (inverse @ residual).squeeze(-1))
        is_finite = torch.isfinite(mean).all(-1)
        log_z, unknown = torch.where(is_finite, belief.log_evidence, -torch.inf), belief.covariance
        info = StepInfo(mean, unknown[..., 0], lambda: unknown, {}, has_covariance=False)
        return belief._replace(mean=mean, log_evidence=log_z), info


def _predict(model: StateSpaceModel, x: Tensor, record: Record) -> Tensor:
    """Return the noise-free step [R, 1, D] from states [R, 1, D]."""
    return model.propagate(x, record.u, mean_noise(model, x))


def _whitened_measurement(
    model: StateSpaceModel, x: Tensor, record: Record, scale: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the whitened derivative [R, k, d] by the scaled state, and the innovation [R, k, 1].

    Both are 0 for missing components. Shapes: x [R, 1, D], scale [R, d].
    """
    distribution = model.observation(x, record.u)
    check_moments(model, "observation", distribution)
    noise = mask_covariance(distribution_covariance(distribution)[:, 0], ~torch.isnan(record.y))
    slope = measurement_jacobian(model, x, record)[:, 0] * scale.unsqueeze(1)
    r = linearised_innovation(model, x, record)[:, 0].unsqueeze(-1)
    both = torch.linalg.solve_triangular(factor(noise)[0], torch.cat([slope, r], -1), upper=False)
    both = both.nan_to_num(0.0, 0.0, 0.0)  # of lost runs: a decomposition would raise for all
    return both[..., :-1], both[..., -1:]


def _check_determined(model: StateSpaceModel, belief: GaussianBelief, record: Record) -> None:
    """Check that the measurements of some step determine the main group.

    The first step with each set of components is tried, at dead reckoning up to it. Shapes: record
    [R, T, Dy].
    """
    is_observed = (~torch.isnan(record.y)).any(0)
    first = {tuple(row): t for t, row in reversed(list(enumerate(is_observed.tolist())))}
    x, scale, group = belief.mean.unsqueeze(1), belief.memory[_SCALE], _find_main_group(model)
    variance, largest = scale[:, group].square(), 0.0
    for t, step_model, step in iterate_steps(model, record, range(max(first.values()) + 1)):
        x = _predict(step_model, x, step)
        if t not in first.values():
            continue
        y = torch.where(is_observed[t], step.y.nan_to_num(), torch.nan)
        slope, _ = _whitened_measurement(step_model, x, step._replace(y=y), scale)
        projection = torch.linalg.pinv(slope, atol=1.0, rtol=0.0) @ slope
        observed = projection.diagonal(dim1=-2, dim2=-1)[:, group] * variance
        share = float((observed.sum(-1) / variance.sum(-1)).amax())  # of the best run
        if share >= _DETERMINED:
            return
        largest = max(largest, share)
    names = ", ".join(model.names[i] for i in group)
    raise ValueError(
        f"filter=raw_fix must have measurements that determine {names}, got measurements of "
        f"{type(model).__name__} that see {100.0 * largest:.0f} % of their initial variance at most "
        "in one step. Choose filter=dead_reckoning or filter=ekf, or a scenario with fixes."
    )


def _find_main_group(model: StateSpaceModel) -> list[int]:
    """Return the components whose error decides: position, or those of the first group with one unit."""
    groups = model.groups
    group = groups["position"] if "position" in groups else next(iter(groups.values()))
    return [i for i in group if model.units[i] == model.units[group[0]]]
