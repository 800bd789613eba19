"""Check of what a filter receives: measurements, inputs and random numbers against the model."""

from __future__ import annotations

import weakref
from typing import Any, NamedTuple
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.distributions import Independent
from torch.distributions.constraints import Constraint, is_dependent

from pfbench.core.density import check_event_dimension
from pfbench.core.parameter_checks import require
from pfbench.core.random_stream import PhiloxStream, RandomStream
from pfbench.core.record import Record, check_inputs, name_inputs
from pfbench.core.simulate import check_state_shape, draw_initial_state
from pfbench.filter.health import check_measurement_resolution, uncounted_observation
from pfbench.filter.linearisation import check_noise_gain
from pfbench.model.base import ModelWrapper, StateSpaceModel, initial_law, named_inputs

_STATES = 4  # of each run that the model is tried with


def check_is_filter(method: object) -> None:
    """Check that an object is an instance with the calls of a filter."""
    calls = (getattr(method, name, None) for name in ("init", "step"))
    require(
        not isinstance(method, type) and all(map(callable, calls)),
        "method",
        "be a filter, with the calls init and step",
        f"the class {method.__name__}" if isinstance(method, type) else type(method).__name__,
        "Pass an instance, such as ParticleFilter(100).",
    )


def check_record(model: StateSpaceModel, record: Record, draws: RandomStream) -> None:
    """Check the shapes and types of a record.

    Shapes: record [R, T, Dy].
    """
    for name, item, kind in (("model", model, StateSpaceModel), ("record", record, Record)):
        require(
            isinstance(item, kind),
            name,
            f"be a {kind.__name__}",
            (item if isinstance(item, type) else type(item)).__name__,
            "Pass the arguments in the order method, model, record, draws.",
        )
    y = record.y
    require(
        y.dim() == 3 and y.is_floating_point(),
        "record.y",
        "be a tensor of real numbers with axes [R, T, Dy]",
        f"{str(y.dtype).removeprefix('torch.')} {list(y.shape)}",
        "Convert it, for instance by y.double().",
    )
    require(y.shape[1] != 0, "record.y", "have at least one time step", "0", "Add measurements.")
    require(
        not bool(torch.isinf(y).any()),
        "record.y",
        "be finite",
        "infinity",
        "Mark a missing component as NaN.",
    )
    runs = len(y)
    numbers: Any = getattr(draws, "runs", None)
    require(
        not isinstance(numbers, Tensor) or numbers.shape == (runs,),
        "draws",
        f"be of {runs} runs, as record.y is",
        len(numbers) if isinstance(numbers, Tensor) else 0,
        f"Use PhiloxStream(seed, torch.arange({runs})).",
    )
    require(
        isinstance(record.u, tuple),
        "record.u",
        "be a NamedTuple of tensors [R, T, ...]",
        type(record.u).__name__,
        "Define a NamedTuple with a field for each input.",
    )
    check_inputs(record)
    _check_initial("start", record.start, (runs, model.chart.size))
    size = len(model.names)
    _check_initial("spread", record.spread, (runs, size, size))


class _CheckedState(NamedTuple):
    """State in which a model was checked with a record.

    Attributes:
        identities: Name and identity of each attribute of the model, and identity of each tensor of
            model and record with the number of its changes.
        tensors: The tensors. After the end of one, another may have its identity.
    """

    identities: list[tuple[str | int, int]]
    tensors: list[weakref.ref[Tensor]]

    @staticmethod
    def of(model: StateSpaceModel, record: Record) -> _CheckedState:
        """Describe the present state, without a look at numbers."""
        modules = list(model.modules())
        identities: list[tuple[str | int, int]] = [
            (name, id(value)) for module in modules for name, value in vars(module).items()
        ]
        tensors = [
            a
            for module in modules
            for a in (*module._buffers.values(), *module._parameters.values())
        ]
        tensors += [record.y, record.start, record.spread]
        tensors += [value for _, value in name_inputs(record.u)]
        present = [a for a in tensors if a is not None]
        identities += [(id(a), a._version) for a in present]
        return _CheckedState(identities, list(map(weakref.ref, present)))


_checked: WeakKeyDictionary[StateSpaceModel, _CheckedState] = WeakKeyDictionary()


def check_model_once(model: StateSpaceModel, record: Record, prepared: Record) -> None:
    """Check a model with a record, unless that was done before and neither has changed since.

    Shapes: record [R, T, Dy], and the same prepared by the model.
    """
    if any(a.is_inference() for a in (record.y, model.anchor)):  # their changes are not counted
        check_model(model, prepared)
        return
    state, before = _CheckedState.of(model, record), _checked.get(model)
    if (
        before
        and before.identities == state.identities
        and all(ref() is not None for ref in before.tensors)
    ):
        return
    _checked.pop(model, None)
    check_model(model, prepared)
    _checked[model] = state


def check_model(model: StateSpaceModel, record: Record) -> None:
    """Check what a model computes at the first step, for a few states of its initial distribution."""
    first, step_model = record.at_step(0), model.at_step(0)
    runs, width = first.y.shape
    name = type(model).__name__
    with torch.no_grad(), named_inputs(model):
        distribution: Any = initial_law(model, runs, record.spread)
        require(
            tuple(distribution.batch_shape) == (runs,),
            f"{name}.initial",
            f"return a distribution of batch shape [R] = {[runs]}",
            list(distribution.batch_shape),
            "Use normal_batch(runs, sd, mean).",
        )
        # a stream of its own, in the precision of the model
        stream = PhiloxStream(0, torch.arange(runs, device=model.anchor.device), model.anchor.dtype)
        x = draw_initial_state(model, distribution, stream, "input check", _STATES, record.start)
        x = x.to(model.anchor)
        check_event_dimension(step_model.noise, f"{name}.noise", step_model.noise_dim)
        w = torch.nan_to_num(step_model.noise.mean).expand(runs, _STATES, step_model.noise_dim)
        next_x = step_model.propagate(x, first.u, w)
        check_state_shape(name, x, next_x, w)
        require(
            bool(next_x.isfinite().all(-1).any()),
            f"{name}.propagate",
            "return finite states",
            "numbers that are not finite for the first step",
            "Check the inputs and the parameters of the model.",
        )
        _check_independence(step_model, x, first.u, w, next_x)
        moving = 1 if model.observes_initial and record.y.shape[1] > 1 else 0
        check_noise_gain(model.at_step(moving), x, record.at_step(moving).u)
        observed = _observe(step_model, next_x, first.u)
        check_event_dimension(observed, f"{name}.observation", width)
    shape = (*observed.batch_shape, *observed.event_shape)
    is_blank = bool(torch.isnan(record.y).all())  # a record without measurements may have any width
    require(
        tuple(observed.batch_shape) == (runs, _STATES),
        f"{name}.observation",
        f"return a distribution of batch shape [R, N] = {[runs, _STATES]}",
        list(observed.batch_shape),
        "Compute it from the states x, with their last axis (x[..., :1], not x[..., 0]), and expand what all particles share.",
    )
    require(
        shape[-1] == width or is_blank,
        "record.y",
        f"have as many components as {name} observes, {shape[-1]}",
        width,
        "Let both have the same components.",
    )
    _check_measurements(model, record, observed, next_x)


def _check_measurements(model: StateSpaceModel, record: Record, first: Any, x: Tensor) -> None:
    """Check the measurements against their distribution in the first step, at states after it."""
    check_measurement_resolution(first, record.y, type(model).__name__)
    base = first.base_dist if isinstance(first, Independent) else first
    support = getattr(base, "support", None)
    require(
        model.at_step(0).has_counts or not getattr(support, "is_discrete", False),
        f"{type(model.at_step(0)).__name__}.has_counts",
        "be True for discrete measurements",
        f"False with a support of {support}",
        "Set `has_counts = True` in the class: its evidence is a probability, which is not compared with densities.",
    )
    _check_likelihood(model.at_step(0), record.at_step(0), x)
    _check_support(model, record, first, x)


def _check_likelihood(model: StateSpaceModel, record: Record, x: Tensor) -> None:
    """Check that some of the tried states have a log likelihood, unless a component is missing.

    A Gaussian filter takes laws without a density of some of their components.
    """
    if bool(torch.isnan(record.y).any()):
        return
    with torch.no_grad(), uncounted_observation(model):
        log_likelihood = model.log_likelihood(record.y, x, record.u)
    is_undefined = torch.isnan(log_likelihood) | torch.isposinf(log_likelihood)
    require(
        not bool(is_undefined.all()),
        f"{type(model).__name__}.log_likelihood",
        "be a number or -inf",
        "NaN or infinity for all states that were tried at the first step",
        "Check mean and spread of the measurement for NaN, and its noise: a component without noise, or two that are copies of each other, are without a density.",
    )


def _check_support(model: StateSpaceModel, record: Record, first: Any, x: Tensor) -> None:
    """Check the measurements of all steps against a support that is the same for all states."""
    support = _fixed_support(first)
    if support is None or model.has_residual:
        return
    is_wrong = ~(support.check(record.y) | torch.isnan(record.y))
    for run, t, k in torch.nonzero(is_wrong)[:1].tolist():
        later = _observe(model.at_step(t), x, record.at_step(t).u)
        if _fixed_support(later) is support:  # the distribution may change with the step
            kind = type(later.base_dist if isinstance(later, Independent) else later).__name__
            raise ValueError(
                f"record.y must be in the support of {kind} ({support}), got "
                f"{float(record.y[run, t, k]):g} at step {t} of run {run}. Mark a missing component as "
                f"NaN, or let {type(model).__name__}.observation return a distribution with this support."
            )


def _fixed_support(distribution: Any) -> Constraint | None:
    """Return the support of a component if no parameter changes it, else None."""
    base = distribution.base_dist if isinstance(distribution, Independent) else distribution
    support: Any = getattr(type(base), "support", None)
    if not isinstance(support, Constraint) or is_dependent(support) or support.event_dim:
        return None
    return support


def _check_independence(
    model: StateSpaceModel, x: Tensor, u: Any, w: Tensor, next_x: Tensor
) -> None:
    """Check that a particle moves by itself: one state is replaced, and all others must stay."""
    changed = x.clone()
    changed[0, 0] = x[0, 1]
    result, expected = model.propagate(changed, u, w), next_x.clone()
    expected[0, 0] = next_x[0, 1]
    scale = next_x.abs().nan_to_num(posinf=0.0).amax((0, 1))
    tolerance = 1e3 * torch.finfo(x.dtype).eps * (scale + 1.0)
    is_equal = ((result - expected).abs() <= tolerance) | (result == expected)
    is_equal |= result.isnan() & expected.isnan()
    if not bool(is_equal.all()):
        wrong = torch.nonzero(~is_equal)[0].tolist()
        raise ValueError(
            f"{type(model).__name__}.propagate must move each particle of each run by itself, got "
            f"another state at [run, particle, component] = {wrong} after the state of run 0, "
            "particle 0 was replaced. Do not sum over the axes of runs and particles."
        )


def _observe(model: StateSpaceModel, x: Tensor, u: Any) -> Any:
    """Return the distribution of the measurement, by the method of the class.

    A counter of likelihood evaluations replaces that of the object.
    """
    inner = model
    while isinstance(inner, ModelWrapper) and type(inner).observation is ModelWrapper.observation:
        inner = inner.model  # a wrapper with an observation of its own has inputs of its own
    try:
        return type(inner).observation(inner, x, u)
    except (ValueError, torch.linalg.LinAlgError) as error:  # type: ignore[attr-defined]
        if isinstance(error, ValueError) and "Expected parameter" not in str(error):
            raise
        raise ValueError(
            f"{type(inner).__name__}.observation must return a distribution whose spread is positive "
            "and whose covariance is positive definite, got parameters that torch refuses. Check "
            "mean and spread for NaN, and the noise: a component without noise, or two that are "
            "copies of each other, are without a density."
        ) from error


def _check_initial(name: str, value: Tensor | None, shape: tuple[int, ...]) -> None:
    """Check the shape of the initial states or covariances of the runs."""
    got = shape if value is None else value.shape
    require(tuple(got) == shape, f"record.{name}", f"have shape {list(shape)}", list(got))
