"""What a filter is given (Record) and the truth beside it (Episode)."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

from torch import Tensor


class Underway(Protocol):
    """One filter's way through a world that answers to it; steps are asked for in order."""

    def at(self, t: int) -> Record:
        """Step t as the corrections so far have made it, with its axis of time: y [R, 1, Dy], inputs [R or 1, 1, ...]."""

    def correct(self, mean: Tensor) -> tuple[Tensor, Callable[[Tensor], Tensor]]:
        """The world, corrected by the estimate [R, D] of the step just given.

        Returns:
            The estimate as it would read without any correction [R, D], and what takes states [R, N, D] to what they are after
            this one.
        """


class Loop(Protocol):
    """A world that a filter's estimates change: an INS that is corrected in flight."""

    def begin(self, record: Record, groups: dict[str, tuple[int, ...]]) -> Underway:
        """From the start, for a model with these groups of components.

        Raises:
            ValueError: a model whose states do not say how to correct this world.
        """


class Record(NamedTuple):
    """Measurements and inputs. All that a filter may look at.

    Attributes:
        y: measurements [R, T, Dy]; NaN is a component that was not seen.
        u: inputs, a NamedTuple of tensors with leading axes [R, T] or [1, T] (shared by all runs), or () for none.
        start: the state [R, D] about which each run's initial law is laid out, where runs start from different states; None
            where the model's `origin` serves all of them.
        spread: Cholesky factor [R, d, d] of each run's initial covariance about `start`, where runs differ in it (a filter that
            starts from its first measurement, say); None where the model's `initial` law serves all of them.
        loop: where the filter's estimates change the world, how it then goes on; y and u are what they are without any change.
            None where nothing that a filter does matters.
    """

    y: Tensor
    u: Any = ()
    start: Tensor | None = None
    spread: Tensor | None = None
    loop: Loop | None = None

    def at(self, t: int) -> Record:
        """Step t alone: y [R, Dy], inputs [R or 1, ...]; start and spread stay, for stages that begin at the first step."""
        return Record(self.y[:, t], map_inputs(lambda a: a[:, t], self.u), self.start, self.spread)

    def of(self, runs: slice) -> Record:
        """Some of the runs."""

        def some(a: Tensor) -> Tensor:
            return a[runs] if len(a) > 1 else a

        start, spread = (None if a is None else a[runs] for a in (self.start, self.spread))
        return Record(self.y[runs], map_inputs(some, self.u), start, spread, self.loop)

    def to(self, like: Tensor) -> Record:
        """On the device of `like`, floating-point numbers in its dtype."""

        def moved(a: Tensor) -> Tensor:
            return a.to(like) if a.is_floating_point() else a.to(like.device)

        start, spread = (None if a is None else moved(a) for a in (self.start, self.spread))
        return Record(moved(self.y), map_inputs(moved, self.u), start, spread, self.loop)


def map_inputs(f: Any, u: Any) -> Any:
    """The NamedTuple of inputs with `f` applied to each of its tensors, those of NamedTuples in it too."""
    return type(u)(*(map_inputs(f, part) if isinstance(part, tuple) else f(part) for part in u)) if u else u


@dataclass(frozen=True)
class Episode:
    """A world: one record per run, and what only the judge may see.

    Attributes:
        record: what the filters are given.
        time: seconds at each step [T].
        truth: true state by group of components, each [R, T, k]; a group that has no truth is left out, an instant without
            truth is NaN (after the end of a short flight, say).
        track: true position from the start: East, North, and height above the start's, m [R, T, 3]; None where there is no map.
        notes: readings and choices of this world that a report must mention.
        sheet: what a datasheet of the world draws besides, of run 0: `force` [T, 3] m/s^2 and `rate` [T, 3] rad/s in body axes,
            `azimuth` and `elevation` of the satellites [T, S] rad (NaN where below the horizon).
    """

    record: Record
    time: Tensor
    truth: dict[str, Tensor]
    track: Tensor | None = None
    notes: tuple[str, ...] = ()
    sheet: dict[str, Tensor] = field(default_factory=dict)


@dataclass(frozen=True, eq=False)
class Channels:
    """What a noise regime must know of a measurement.

    Attributes:
        sd: nominal standard deviations [Dy].
        kind: of each component: position, velocity, range, rate, angle, or other.
        source: number of the receiver or transmitter that a component comes from; those of one source vanish together.
    """

    sd: Tensor
    kind: tuple[str, ...]
    source: tuple[int, ...]

    @staticmethod
    def alike(sd: Tensor, kind: str = "other") -> Channels:
        """Components of one kind from one source."""
        return Channels(sd, (kind,) * len(sd), (0,) * len(sd))


def fixes(sd: Tensor) -> Channels:
    """Channels of a receiver that gives position [3] or position and velocity [6]."""
    kind = ("position",) * 3 + ("velocity",) * 3
    return Channels(sd, kind[: len(sd)], (0,) * len(sd))
