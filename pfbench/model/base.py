"""State-space models: propagation driven by noise, and a distribution of the measurement.

The file is long, since the wrappers are part of it: the first step of a model may be a `StaticModel`.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache
from typing import Any, Self

import torch
from torch import Tensor, nn
from torch.distributions import Distribution, Independent
from typing_extensions import override

from pfbench.core.chart import Chart, EuclideanBlock
from pfbench.core.density import StandardNormal, dense_normal, log_density, log_normal_density
from pfbench.core.linear_algebra import gaussian_log_density
from pfbench.core.parameter_checks import require
from pfbench.core.record import Record, check_inputs


@cache
def _euclidean_chart(size: int) -> Chart:
    """Return a chart of Euclidean components, the same one at each step."""
    return Chart((EuclideanBlock(size),))


@contextmanager
def named_inputs(model: StateSpaceModel) -> Iterator[None]:
    """Name the input that a model reads from u and that u does not have."""
    try:
        yield
    except AttributeError as error:
        if not isinstance(error.obj, tuple):
            raise
        fields = ", ".join(getattr(error.obj, "_fields", ())) or "no inputs"
        raise ValueError(
            f"record.u must have the input {error.name}, which {type(model).__name__} reads, got {fields}. "
            "Choose a scenario that provides it, or add the field to its inputs."
        ) from error


class StateSpaceModel(nn.Module, ABC):
    """A model x_t = propagate(x_{t-1}, u_t, w_t), y_t ~ observation(x_t, u_t).

    Axes: R runs, N particles (or sigma points, or tangents), D state. The first measurement is of
    the state after the first propagation, unless the model sets `observes_initial`, which changes
    the evidence.

    Attributes:
        names: Components of a difference of states, in which errors are reported.
        units: SI unit of each of these d components.
        groups: Components of a difference that a report shows together, by name.
        noise_dim: Dimension W of the driving noise.
        observes_initial: Whether the first measurement is of x_0, before any propagation.
        linear: Whether the map is linear and both distributions are normal. Every Gaussian filter
            is then the Kalman filter and exact.
        linear_given: Components of a difference in which, together with the noise, map and
            measurement are linear given all others, with normal distributions. A Kalman filter of
            each particle can estimate them. A linear model need not set it.
        has_counts: Whether a component of the measurement is discrete, such as a Poisson count. The
            evidence is then a probability, which is not compared with a density.
        choices: Modelling choices that a report must list.
        channel_names: Quantity, frame and unit of each component of y, as `position North [m]`. Empty if the
            model does not state them: a scenario is then compared by its number of components only.
        input_type: NamedTuple of the inputs u. None if the model reads none or does not state them.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    groups: dict[str, tuple[int, ...]]
    noise_dim: int
    observes_initial: bool = False
    linear: bool = False
    linear_given: tuple[int, ...] = ()
    has_counts: bool = False
    choices: tuple[str, ...] = ()
    channel_names: tuple[str, ...] = ()
    input_type: type | None = None
    _arguments: tuple[tuple[Any, ...], dict[str, Any]] = (), {}

    def __new__(cls, *args: Any, **options: Any) -> Self:
        """Make a model that keeps the arguments of its constructor, from which the Python door describes it."""
        model = super().__new__(cls)
        object.__setattr__(model, "_arguments", (args, options))
        return model

    @property
    def chart(self) -> Chart:
        """Addition, subtraction and mean of states; Euclidean by default."""
        return _euclidean_chart(len(self.names))

    @property
    def origin(self) -> Tensor:
        """State [D] about which `initial` is defined in the chart; that with components 0 by default, without a turn."""
        return self.anchor.new_tensor(self.chart.identity)

    @property
    def anchor(self) -> Tensor:
        """A tensor of the model that has its dtype and device."""
        return next(iter(self.buffers()))

    @property
    def noise(self) -> Distribution:
        """Distribution of w, event [W], independent components; standard normal by default."""
        zero = self.anchor.new_zeros(self.noise_dim)
        return StandardNormal(zero, torch.ones_like(zero), validate_args=False).to_event(1)

    @property
    def has_residual(self) -> bool:
        """True if the model defines a residual other than y - y_hat."""
        return type(self).residual is not StateSpaceModel.residual

    @property
    def has_noise_gain(self) -> bool:
        """True if the model defines `noise_gain`. None then means noise that is not additive."""
        return type(self).noise_gain is not StateSpaceModel.noise_gain

    @abstractmethod
    def initial(self, runs: int) -> Distribution:
        """Return the distribution of x_0 in the chart about `origin`: batch [R], event [d]."""

    @abstractmethod
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        """Propagate states by one step, a deterministic function of its arguments.

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.
            w: Driving noise, [R, N, W].

        Returns:
            States, [R, N, D].
        """

    @abstractmethod
    def observation(self, x: Tensor, u: Any) -> Distribution:
        """Return the distribution of the measurement given states.

        Any distribution with `log_prob` serves particle filters. Gaussian filters need a finite
        mean and variance. Missing components need Independent, MultivariateNormal or a
        MixtureSameFamily of them.

        Args:
            x: States, [R, N, D].
            u: Inputs of the step.

        Returns:
            Distribution with batch [R, N], event [Dy].
        """

    def transition(self, x: Tensor, u: Any) -> Distribution | None:
        """Return the distribution of x_t given x_{t-1}.

        Args:
            x: States x_{t-1}, [R, N, D].
            u: Inputs of the step.

        Returns:
            Distribution with batch [R, N], event [D]; None where it is singular.
        """
        return None

    def noise_gain(self, u: Any) -> Tensor | None:
        """Return L [R or 1, d, W] if the noise enters as x (+) L w in the chart, else None.

        A model without this method is probed by Gaussian filters at each step. They use the
        numerical L if the noise is additive. Define the method to avoid this cost.
        """
        return None

    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        """Compute y - y_hat; models wrap angles here.

        Args:
            y: Measurements, [..., Dy].
            y_hat: Predicted measurements, [..., Dy].

        Returns:
            Differences, [..., Dy].
        """
        return y - y_hat

    def prepare(self, record: Record) -> Record:
        """Return the record with inputs that are computed once for all steps.

        Raises:
            ValueError: If the inputs are not those of `input_type`, or lack the axes of runs and steps.
        """
        require(
            self.input_type is None or isinstance(record.u, self.input_type),
            "record.u",
            f"be {getattr(self.input_type, '__name__', '')} for {type(self).__name__}",
            type(record.u).__name__ if record.u else "no inputs",
            "Choose a scenario with these inputs: pfbench list scenario model=NAME",
        )
        check_inputs(record)
        return record

    def at_step(self, t: int) -> StateSpaceModel:
        """Return the model of step t, t = 0 being the first measurement.

        A model that observes its initial state does not move before its first measurement. This
        rule is defined only here.
        """
        return StaticModel(self) if t == 0 and self.observes_initial else self

    def assemble(self, truth: dict[str, Tensor]) -> Tensor:
        """Assemble true states from the groups of an episode.

        A model whose groups are not components of a difference, such as Euler angles of a quaternion, overrides this method.

        Args:
            truth: True values by group, [R, T, k]. They are components of the state. Those of a chart with a quaternion are components
                of its difference from `chart.identity`, in which a turn is a rotation vector.

        Returns:
            States, [R, T, D]; NaN where the truth of a group is unknown.

        Raises:
            ValueError: As `place_groups`.
        """
        placed = self.place_groups(truth)
        if self.chart.size == self.chart.dimension:
            return placed
        return self.chart.add(placed.new_tensor(self.chart.identity), placed)

    def place_groups(self, truth: dict[str, Tensor]) -> Tensor:
        """Place the true values of groups at their components.

        Args:
            truth: True values by group, [R, T, k].

        Returns:
            Values in double precision, [R, T, d]; NaN where the truth of a group is unknown.

        Raises:
            ValueError: If no group of this model has a truth, or a truth has other components.
        """
        available = [name for name in self.groups if name in truth]
        require(
            available,
            "truth",
            f"have at least one group of {list(self.groups)}",
            sorted(truth),
            "Choose a scenario that fits the model.",
        )
        check_truth_sizes(truth, {name: len(places) for name, places in self.groups.items()})
        first = truth[available[0]]
        shape = *first.shape[:-1], self.chart.dimension
        placed = torch.full(shape, torch.nan, dtype=torch.float64, device=first.device)
        for name in available:
            placed[..., list(self.groups[name])] = truth[name].double()
        return placed

    def error(self, mean: Tensor, truth: Tensor) -> Tensor:
        """Compute the error of an estimate in the chart.

        Args:
            mean: Estimates, [..., D].
            truth: True states, [..., D].

        Returns:
            Errors, [..., d].
        """
        return self.chart.subtract(mean, truth)

    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        """Compute log p(y | x) over the observed components.

        The observation distribution is evaluated at y. If the model defines `residual`, it is
        evaluated at its mean plus the residual of y to that mean, so that angles wrap.

        Args:
            y: Measurements, [R, Dy]; NaN marks a missing component.
            x: States, [R, N, D].
            u: Inputs of the step.

        Returns:
            Log likelihood, [R, N].

        Raises:
            TypeError: If the observation distribution has not one event dimension.
            ValueError: If a missing component cannot be integrated out, or a distribution
                without a mean meets a residual.
        """
        distribution: Any = self.observation(x, u)
        base = distribution.base_dist if isinstance(distribution, Independent) else None
        if isinstance(base, torch.distributions.Normal):
            sd = base.scale
            if sd.stride(1) == 0:  # torch has expanded one scale to all particles
                sd = sd[:, :1] if sd.stride(0) else sd[:1, :1]
            y_hat = base.loc
            if self.has_residual:  # the fused loop computes a plain difference itself
                y_hat = -self.residual(y.nan_to_num().unsqueeze(1), y_hat)
                y = torch.where(y == y, 0.0, y)
            return log_normal_density(y, y_hat, sd)
        observed_mask = ~torch.isnan(y).unsqueeze(1)  # [R, 1, Dy]
        name = f"{type(self).__name__}.observation"
        if not self.has_residual:
            return log_density(distribution, y.unsqueeze(1), observed_mask, name)
        y_hat = _mean_of(distribution, name)
        r = torch.where(observed_mask, self.residual(y.unsqueeze(1), y_hat), 0.0)
        if isinstance(distribution, torch.distributions.MultivariateNormal):
            return gaussian_log_density(r, distribution.covariance_matrix, observed_mask)
        return log_density(distribution, y_hat + r, observed_mask, name)


class ModelWrapper(StateSpaceModel):
    """A model that delegates to another; subclasses override what they change.

    Attributes:
        model: The inner model. Its flags (`linear`, `observes_initial`, ...) are not copied.
    """

    def __init__(self, model: StateSpaceModel) -> None:
        super().__init__()
        self.model = model
        self.names, self.units = model.names, model.units
        self.groups, self.noise_dim = model.groups, model.noise_dim
        self.has_counts = model.has_counts

    @property
    @override
    def chart(self) -> Chart:
        return self.model.chart

    @property
    @override
    def origin(self) -> Tensor:
        return self.model.origin

    @property
    @override
    def anchor(self) -> Tensor:
        return self.model.anchor

    @property
    @override
    def noise(self) -> Distribution:
        return self.model.noise

    @property
    @override
    def has_residual(self) -> bool:
        return self.model.has_residual if type(self).residual is ModelWrapper.residual else True

    @override
    def initial(self, runs: int) -> Distribution:
        return self.model.initial(runs)

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.model.propagate(x, u, w)

    @override
    def observation(self, x: Tensor, u: Any) -> Distribution:
        return self.model.observation(x, u)

    @override
    def residual(self, y: Tensor, y_hat: Tensor) -> Tensor:
        return self.model.residual(y, y_hat)


class StaticModel(ModelWrapper):
    """A model whose state does not move: the first step if the initial state is observed."""

    def __init__(self, model: StateSpaceModel) -> None:
        super().__init__(model)
        self.linear, self.linear_given = model.linear, model.linear_given

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return x

    @override
    def noise_gain(self, u: Any) -> None:
        return None

    @override
    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        return self.model.log_likelihood(y, x, u)


def check_components(model: StateSpaceModel) -> None:
    """Check that each component of a model has a unit, and that each group has components."""
    name, size = type(model).__name__, len(model.names)
    must, remedy = (
        f"have one unit for each of {size} names",
        "Write '' for a number without a unit.",
    )
    require(len(model.units) == size, f"{name}.units", must, model.units, remedy)
    for group, places in model.groups.items():
        require(
            isinstance(places, Sequence) and set(places) <= set(range(size)),
            f"{name}.groups[{group!r}]",
            f"be a tuple of components from 0 to {size - 1}",
            places,
            "Write (0,) for the first one alone.",
        )


def check_truth_sizes(truth: Mapping[str, Tensor], sizes: Mapping[str, int]) -> None:
    """Check that true values have the components of their groups: one number would fill a vector.

    Shapes: truth [R, T, k].
    """
    for name in sizes.keys() & truth.keys():
        require(
            truth[name].shape[-1] == sizes[name],
            f"truth of {name}",
            f"have {sizes[name]} components, as the model",
            truth[name].shape[-1],
            "Choose a scenario that fits the model.",
        )


def _mean_of(distribution: Any, name: str) -> Tensor:
    """Return the mean, or raise if the distribution has none."""
    try:
        mean: Tensor = distribution.mean
    except NotImplementedError:
        mean = torch.full((1,), torch.nan)
    if bool(torch.isnan(mean).all()):
        raise ValueError(
            f"{name} must return a distribution with a mean where the model defines residual, got "
            f"{type(getattr(distribution, 'base_dist', distribution)).__name__}. "
            "Override log_likelihood as well."
        )
    return mean


def initial_law(model: StateSpaceModel, runs: int, spread: Tensor | None = None) -> Distribution:
    """Return the distribution of x_0 in the chart.

    Returns distribution with batch [R], event [d]. Shapes: spread [R, d, d].
    """
    if spread is None:
        return model.initial(runs)
    return dense_normal(spread.new_zeros(spread.shape[:-1]), spread)
