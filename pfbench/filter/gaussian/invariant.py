"""A filter in an invariant chart of the state, with its report in the chart of the model."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.chart import SIDES, Chart
from pfbench.core.linear_algebra import jacobian
from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import RandomStream
from pfbench.core.record import Record
from pfbench.filter.belief import GaussianBelief, ParticleBelief, StepInfo, normalise_log_weights
from pfbench.filter.exactness import has_bounded_weights, has_evidence
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.model.base import ModelWrapper, StateSpaceModel


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
        require(
            self.chart in SIDES,
            "filter.chart",
            "be left or right",
            self.chart,
            "Use left for position fixes.",
        )
        require(
            isinstance(self.filter, (GaussianFilter, ParticleFilter)),
            "filter.filter",
            "be GaussianFilter or ParticleFilter",
            self.filter if isinstance(self.filter, str) else type(self.filter).__name__,
            "Select it by name as filter@filter.filter=ukf.",
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
        conditional=None,
    )


# --------------------------------------------------------------------------------------------------
# A model in another chart of its state: the same motion and measurements, other differences.


class ChartModel(ModelWrapper):
    """A model whose differences of states are those of an invariant chart.

    Propagation and measurement are of the inner model. The noise gain is that of the inner model in a
    left chart. In a right chart it depends on the state, so the noise passes through the linearisation
    rule.
    """

    def __init__(self, model: StateSpaceModel, side: str) -> None:
        super().__init__(model)
        self.side, self._chart = side, find_group_chart(model, side)
        self.linear_given = ()

    @property
    @override
    def chart(self) -> Chart:
        return self._chart

    @override
    def noise_gain(self, u: Any) -> Tensor | None:
        return self.model.noise_gain(u) if self.side == "left" else None

    @override
    def transition(self, x: Tensor, u: Any) -> Distribution | None:
        return self.model.transition(x, u)

    @override
    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        return self.model.log_likelihood(y, x, u)


def find_group_chart(model: StateSpaceModel, side: str) -> Chart:
    """Return the invariant chart of a model."""
    inner = model
    while isinstance(inner, ModelWrapper):
        inner = inner.model
    group_chart: Any = getattr(inner, "group_chart", None)
    require(
        group_chart is not None,
        "filter.chart",
        "be an invariant chart of the model",
        f"{side} with {type(inner).__name__}, which has none",
        "Choose filter=ekf, or a scenario whose truth has an attitude, as scenario=recorded_quad_flights "
        "with model=strapdown_total.",
    )
    chart: Chart = group_chart(side)
    return chart


def chart_derivative(old: Chart, new: Chart, mean: Tensor) -> Tensor:
    """Compute the derivative of a difference in a new chart in the difference in an old one.

    Returns derivative, [R, d, d]. Shapes: mean [R, D].
    """
    centre = mean.unsqueeze(1)
    return jacobian(lambda d: old.add(centre, d), centre, old.dimension, new.subtract)


def change_covariance(old: Chart, new: Chart, mean: Tensor, covariance: Tensor) -> Tensor:
    """Return a covariance in a new chart, to first order.

    Returns covariance, [R, d, d]. Shapes: mean [R, D], covariance [R, d, d].
    """
    slope = chart_derivative(old, new, mean)
    return slope @ covariance @ slope.mT
