"""A model in another chart of its state: the same motion and measurements, other differences."""

from __future__ import annotations

from typing import Any

from torch import Tensor
from torch.distributions import Distribution
from typing_extensions import override

from pfbench.core.chart import Chart
from pfbench.core.jacobian import jacobian
from pfbench.model.base import ModelWrapper, StateSpaceModel


class ChartModel(ModelWrapper):
    """A model whose differences of states are those of an invariant chart.

    Propagation and measurement are of the inner model. The noise gain is that of the inner model in a
    left chart. In a right chart it depends on the state, so the noise passes through the linearisation
    rule.

    Args:
        model: Model with a method `group_chart`.
        side: `left` or `right`.

    Raises:
        ValueError: If the model does not define an invariant chart.
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
    """Return the invariant chart of a model.

    Args:
        model: State-space model.
        side: `left` or `right`.

    Returns:
        The chart.

    Raises:
        ValueError: If the model has none.
    """
    inner = model
    while isinstance(inner, ModelWrapper):
        inner = inner.model
    group_chart = getattr(inner, "group_chart", None)
    if group_chart is None:
        raise ValueError(
            f"filter.chart must be an invariant chart of the model, got {side} with "
            f"{type(inner).__name__}, which has none. Choose filter=ekf, or a scenario whose truth "
            "has an attitude, as scenario=recorded_quad_flights with model=strapdown_total."
        )
    chart: Chart = group_chart(side)
    return chart


def chart_derivative(old: Chart, new: Chart, mean: Tensor) -> Tensor:
    """Compute the derivative of a difference in a new chart in the difference in an old one.

    Args:
        old: Chart of the argument.
        new: Chart of the value.
        mean: State at which both differences are zero, [R, D].

    Returns:
        Derivative, [R, d, d].
    """
    centre = mean.unsqueeze(1)
    return jacobian(lambda d: old.add(centre, d), centre, old.dimension, new.subtract)


def change_covariance(old: Chart, new: Chart, mean: Tensor, covariance: Tensor) -> Tensor:
    """Return a covariance in a new chart, to first order.

    Args:
        old: Chart of the covariance.
        new: Chart of the result.
        mean: State about which both are defined, [R, D].
        covariance: [R, d, d].

    Returns:
        Covariance, [R, d, d].
    """
    slope = chart_derivative(old, new, mean)
    return slope @ covariance @ slope.mT
