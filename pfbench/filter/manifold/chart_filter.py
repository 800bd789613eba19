"""A filter in an invariant chart of the state, with its report in the chart of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor

from pfbench.core.chart import Chart
from pfbench.core.manifold.group_block import SIDES
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import (
    GaussianBelief,
    ParticleBelief,
    StepInfo,
    normalise_log_weights,
)
from pfbench.filter.exactness import has_bounded_weights, has_evidence
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.manifold.chart_model import ChartModel, change_covariance, find_group_chart
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.model.base import StateSpaceModel


@dataclass(frozen=True)
class InvariantFilter:
    """A filter whose differences of states are those of a Lie group.

    With TaylorLinearisation this is the invariant EKF [Barrau and Bonnabel 2017], with sigma points the
    UKF on manifolds [Brossard, Barrau and Bonnabel 2017]. Sensor biases are Euclidean components outside
    the group, the `imperfect` form. The initial distribution is that of the model. Mean and covariance
    of the report are in the chart of the model, in the same axes as those of other filters.

    Attributes:
        filter: Gaussian or particle filter.
        chart: `left` or `right`: differences that a multiplication of all states from this side does
            not change. Use `left` for position fixes, `right` for measurements in body axes.

    Raises:
        ValueError: If the chart or the filter is none of these. On use, if the model does not define the chart.
    """

    filter: GaussianFilter | ParticleFilter
    chart: str = "left"

    def __post_init__(self) -> None:
        if self.chart not in SIDES:
            raise ValueError(
                f"filter.chart must be left or right, got {self.chart}. Use left for position fixes."
            )
        if not isinstance(self.filter, (GaussianFilter, ParticleFilter)):
            raise ValueError(
                "filter.filter must be GaussianFilter or ParticleFilter, got "
                f"{self.filter if isinstance(self.filter, str) else type(self.filter).__name__}. "
                "Select it by name as filter@filter.filter=ukf."
            )

    @property
    def is_exact(self) -> bool:
        """True if the inner filter is exact: the chart does not change the model."""
        return self.filter.is_exact

    @property
    def has_bounded_weights(self) -> bool | None:
        """Statement of the inner filter on its weights."""
        return has_bounded_weights(self.filter)

    @property
    def has_evidence(self) -> bool:
        """True if the log evidence of the inner filter is a density of the measurements."""
        return has_evidence(self.filter)

    def init(
        self,
        model: StateSpaceModel,
        runs: int,
        draws: RandomStream,
        start: Tensor | None = None,
        spread: Tensor | None = None,
    ) -> ParticleBelief | GaussianBelief:
        """Compute the belief at step 0: the initial distribution of the model in the chart.

        Args:
            model: State-space model.
            runs: Number of runs R.
            draws: Random stream of step 0.
            start: States about which the initial distribution is placed, [R, D].
            spread: Cholesky factors of the initial covariances, [R, d, d].

        Returns:
            The belief.

        Raises:
            ValueError: If the model does not define an invariant chart.
        """
        chart = find_group_chart(model, self.chart)
        belief = self.filter.init(model, runs, draws, start, spread)
        if isinstance(belief, ParticleBelief):
            return belief
        covariance = change_covariance(model.chart, chart, belief.mean, belief.covariance)
        return belief._replace(covariance=covariance)

    def step(
        self, model: StateSpaceModel, belief: Any, record: Record, draws: RandomStream
    ) -> tuple[ParticleBelief | GaussianBelief, StepInfo]:
        """Compute the belief after a measurement.

        Args:
            model: State-space model of the step.
            belief: Belief at t-1.
            record: Measurement and inputs of step t.
            draws: Random stream of the step.

        Returns:
            Belief at t, and diagnostics in the chart of the model.
        """
        inner = ChartModel(model, self.chart)
        belief, info = self.filter.step(inner, belief, record, draws)
        return belief, _in_chart_of_model(model.chart, inner.chart, info)


def _in_chart_of_model(report_chart: Chart, chart: Chart, info: StepInfo) -> StepInfo:
    """Return the information of a step with covariances in another chart."""
    if info.cloud is None:
        covariance = change_covariance(chart, report_chart, info.mean, info.covariance())
        variance = covariance.diagonal(dim1=-2, dim2=-1)
        return info._replace(variance=variance, covariance=lambda: covariance)
    deviation, log_w = info.cloud()
    centre = info.mean.unsqueeze(1)
    deviation = report_chart.subtract(chart.add(centre, deviation), centre)
    weighted = normalise_log_weights(log_w).unsqueeze(-1) * deviation
    return info._replace(
        variance=(weighted * deviation).sum(1),
        covariance=lambda: weighted.mT @ deviation,
        cloud=lambda: (deviation, log_w),
        group_covariance=None,
    )
