"""What a filter is given (Record) and the truth beside it (Episode)."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, NamedTuple

from torch import Tensor


class Record(NamedTuple):
    """Measurements and inputs. All that a filter may look at.

    Attributes:
        y: measurements [R, T, Dy]; NaN is a component that was not seen.
        u: inputs, a NamedTuple of tensors with leading axes [R, T] or [1, T] (shared by all runs), or () for none.
    """

    y: Tensor
    u: Any = ()

    def at(self, t: int) -> Record:
        """Step t alone: y [R, Dy], inputs [R or 1, ...]."""
        return Record(self.y[:, t], map_inputs(lambda a: a[:, t], self.u))


def map_inputs(f: Any, u: Any) -> Any:
    """The NamedTuple of inputs with `f` applied to each of its tensors."""
    return type(u)(*map(f, u)) if u else u


@dataclass(frozen=True)
class Episode:
    """A world: one record per run, and what only the judge may see.

    Attributes:
        record: what the filters are given.
        time: seconds at each step [T].
        truth: true state by group of components, each [R, T, k]; a group that has no truth is left out, an instant without
            truth is NaN (after the end of a short flight, say).
        track: true position East, North, Up in metres from the start [R, T, 3], or None where there is no map.
        aids: names of instants or choices that a report should mention.
    """

    record: Record
    time: Tensor
    truth: dict[str, Tensor]
    track: Tensor | None = None
    notes: tuple[str, ...] = field(default=())
