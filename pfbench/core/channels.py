"""Names of measured channels and types of inputs: what a scenario provides and a model reads.

Sensors, scenarios and models state them in the attributes `channel_names` (quantity, frame and unit of each
component of y, as `position North [m]`) and `input_type` (NamedTuple of the inputs u). One that states
nothing is compared with nothing.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import zip_longest
from typing import Any

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
