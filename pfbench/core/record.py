"""Data of a batch of runs: `Record` (what a filter may read) and `Episode` (with its truth)."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice, zip_longest
from typing import Any, NamedTuple, Protocol, TypeVar

from torch import Tensor

from pfbench.core.parameter_checks import require

_Step = TypeVar("_Step")


class FeedbackRun(Protocol):
    """One pass of a filter through a process that its estimates correct, steps in order."""

    def at_step(self, t: int) -> Record:
        """Return step t after the corrections so far: y [R, 1, Dy], inputs [R or 1, 1, ...]."""

    def correct(self, mean: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """Correct the process by the estimate [R, D] of the latest step.

        Returns the estimate as it would read without any correction, [R, D], and a function that
        maps states [R, N, D] to their values after this correction.
        """


class FeedbackProcess(Protocol):
    """A process that a filter's estimates correct, such as a closed-loop INS."""

    def begin(self, record: Record, groups: dict[str, tuple[int, ...]]) -> FeedbackRun:
        """Start a pass.

        Returns the pass before its first step.
        """


class Record(NamedTuple):
    """Measurements and inputs: all that a filter may read.

    Attributes:
        y: Measurements, [R, T, Dy]. NaN marks a missing component.
        u: Inputs, a NamedTuple of tensors with leading axes [R, T], or [1, T] if shared by all
            runs. () for none.
        start: State about which the initial distribution of each run is defined, [R, D]. None if
            the model's `origin` applies to all runs.
        spread: Cholesky factor of each run's initial covariance about `start`, [R, d, d]. None if
            the model's `initial` distribution applies to all runs.
        feedback: Process that the filter's estimates correct. y and u are then its values without any
            correction. None for data that do not depend on the filter.
    """

    y: Tensor
    u: Any = ()
    start: Tensor | None = None
    spread: Tensor | None = None
    feedback: FeedbackProcess | None = None

    def at_step(self, t: int) -> Record:
        """Return step t: y [R, Dy], inputs [R or 1, ...]; start and spread are kept."""
        return Record(self.y[:, t], map_inputs(lambda a: a[:, t], self.u), self.start, self.spread)

    def select_steps(self, steps: slice) -> Record:
        """Return the record of some time steps, with the axis of time."""
        return self._replace(y=self.y[:, steps], u=map_inputs(lambda a: a[:, steps], self.u))

    def steps_as_runs(self, steps: list[int]) -> Record:
        """Return steps of the only run as if they were runs: y [S, Dy], inputs [S, ...]."""
        return Record(self.y[0, steps], map_inputs(lambda a: a[0, steps], self.u))

    def select_runs(self, runs: slice) -> Record:
        """Return the record of some runs."""

        def select(a: Tensor) -> Tensor:
            return a[runs] if len(a) > 1 else a

        start, spread = (None if a is None else a[runs] for a in (self.start, self.spread))
        return Record(self.y[runs], map_inputs(select, self.u), start, spread, self.feedback)

    def to(self, target: Tensor) -> Record:
        """Move to the device of a tensor, and floating-point numbers to its dtype."""

        def move(a: Tensor) -> Tensor:
            return a.to(target) if a.is_floating_point() else a.to(target.device)

        start, spread = (None if a is None else move(a) for a in (self.start, self.spread))
        return Record(move(self.y), map_inputs(move, self.u), start, spread, self.feedback)


class SteppedModel(Protocol):
    """A model that may differ from step to step."""

    def at_step(self, t: int) -> Any:
        """Return the model that describes step t."""


def iterate_steps(
    model: SteppedModel, record: Record, steps: range | None = None
) -> Iterator[tuple[int, Any, Record]]:
    """Iterate over the time steps of a record.

    All loops over a record use this function: filters, training, online inference, bounds and
    simulation.

    Shapes: record [R, T, Dy].
    """
    for t in range(record.y.shape[1]):
        if steps is None or t in steps:
            yield t, model.at_step(t), record.at_step(t)


def is_constant(model: SteppedModel, record: Record, first: int) -> bool:
    """Return whether a model is the same in all steps of a record from one on."""
    return all(model.at_step(t) is model for t in range(first, record.y.shape[1]))


_GROUP = 256  # steps


def take_groups(steps: Iterator[_Step]) -> Iterator[list[_Step]]:
    """Take steps in groups, which the caller joins.

    A step alone is some small tensors and objects of Python, which need 3 kB where its numbers need 100 bytes [measured].
    """
    return iter(lambda: list(islice(steps, _GROUP)), [])


def map_inputs(function: Any, u: Any) -> Any:
    """Apply a function to each tensor of the inputs, in nested NamedTuples too.

    Args:
        function: Function of a tensor.
        u: NamedTuple of inputs, or ().

    Returns:
        NamedTuple of the results.
    """
    if not u:
        return u
    values = (map_inputs(function, a) if isinstance(a, tuple) else function(a) for a in u)
    return type(u)(*values)


def name_inputs(u: Any, name: str = "") -> list[tuple[str, Tensor]]:
    """Return the input tensors with the names of their fields."""
    if isinstance(u, Tensor):
        return [(name, u)]
    require(
        isinstance(u, tuple),
        f"record.u{name}",
        "be a tensor or a NamedTuple of tensors",
        type(u).__name__,
        "Convert numbers by torch.as_tensor, and a dataclass to a NamedTuple.",
    )
    fields = getattr(u, "_fields", range(len(u)))
    return [
        pair
        for field, value in zip(fields, u, strict=True)
        for pair in name_inputs(value, f"{name}.{field}")
    ]


def check_inputs(record: Record) -> None:
    """Check that all inputs have the axes of runs and steps."""
    runs, steps = record.y.shape[:2]
    for name, value in name_inputs(record.u):
        require(
            value.dim() > 1 and len(value) in (1, runs) and value.shape[1] == steps,
            f"record.u{name}",
            f"have the axes [{runs} or 1, {steps}, ...] of runs and steps",
            list(value.shape),
            "Write values[None] for the values [T, ...] of all runs.",
        )


class MeasuredTruth(NamedTuple):
    """Truth that is itself measured, such as fixes that were withheld from the filter.

    Attributes:
        name: What the estimates are compared with, in the plural.
        sd: Standard deviations of its errors by component group, in the units of the truth, each [k].
    """

    name: str
    sd: dict[str, Tensor]


@dataclass(frozen=True)
class Episode:
    """Record of a batch of runs, with the truth for scoring.

    Attributes:
        record: Measurements and inputs.
        time: Time of each step, s, [T].
        truth: True state by component group, each [R, T, k]. Groups without truth are absent, steps
            without truth are NaN.
        track: True East, North and height relative to the start, m, [R, T, 3]. None if it cannot
            be drawn on a map.
        notes: Modelling choices of this episode that a report must mention.
        datasheet: Data of run 0 for the datasheet: `force` [T, 3] m/s^2 and `rate` [T, 3] rad/s in
            body axes, `azimuth` and `elevation` of the satellites [T, S] rad (NaN below the horizon).
        measured_truth: What the truth is, if it has errors of its own. None for a truth without errors.
    """

    record: Record
    time: Tensor
    truth: dict[str, Tensor]
    track: Tensor | None = None
    notes: tuple[str, ...] = ()
    datasheet: dict[str, Tensor] = field(default_factory=dict)
    measured_truth: MeasuredTruth | None = None


@dataclass(frozen=True, eq=False)
class MeasurementChannels:
    """Description of the measurement components for a noise regime.

    Attributes:
        sd: Nominal standard deviations, SI units, [Dy].
        kind: Kind of each component: position, velocity, range, rate, angle or other.
        source: Number of each component's receiver or transmitter. Components of one source are
            missing at the same time.
    """

    sd: Tensor
    kind: tuple[str, ...]
    source: tuple[int, ...]

    @staticmethod
    def of_one_kind(sd: Tensor, kind: str = "other") -> MeasurementChannels:
        """Return components of one kind from one source.

        Args:
            sd: Nominal standard deviations, [Dy].
            kind: Kind of all components.

        Returns:
            The description.
        """
        return MeasurementChannels(sd, (kind,) * len(sd), (0,) * len(sd))


def fix_channels(sd: Tensor) -> MeasurementChannels:
    """Return the channels of a receiver with position [3] or position and velocity [6]."""
    kind = ("position",) * 3 + ("velocity",) * 3
    return MeasurementChannels(sd, kind[: len(sd)], (0,) * len(sd))


# --------------------------------------------------------------------------------------------------
# Names of measured channels and types of inputs: what a scenario provides and a model reads.
#
# Sensors, scenarios and models state them in the attributes `channel_names` (quantity, frame and unit of each
# component of y, as `position North [m]`) and `input_type` (NamedTuple of the inputs u). One that states
# nothing is compared with nothing.

EACH_SATELLITE = (
    "of each satellite"  # a channel with this phrase is as many components as satellites
)


def name_channels(quantity: str, frame: Sequence[str], unit: str) -> tuple[str, ...]:
    """Name the channels of a vector.

    Returns a name per axis.
    """
    return tuple(f"{quantity} {axis} [{unit}]" for axis in frame)


def describe_misfit(model: Any, source: Any) -> str:
    """Describe the first difference between what a model reads and what a source provides.

    Returns a clause, or an empty text if both fit or one of them does not state what it needs.
    """
    reads, measures = (getattr(a, "channel_names", ()) for a in (model, source))
    names = type(model).__name__, type(source).__name__
    pairs = zip_longest(reads, measures, fillvalue="nothing")
    if reads and measures and tuple(reads) != tuple(measures):
        i, (read, measured) = next((i, pair) for i, pair in enumerate(pairs) if pair[0] != pair[1])
        return f"{names[0]} reads '{read}' as channel {i + 1}, and {names[1]} measures '{measured}' there"
    needed, provided = (getattr(a, "input_type", None) for a in (model, source))
    if needed is None or provided is None or issubclass(provided, needed):
        return ""
    return (
        f"{names[0]} reads the inputs {needed.__name__}, and {names[1]} provides "
        f"{'none' if provided is tuple else provided.__name__}"
    )
