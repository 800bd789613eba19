"""Whether a filter is asymptotically exact: every part states it, and one that does not counts as inexact."""

from __future__ import annotations

import warnings


def is_every_part_exact(**parts: object) -> bool:
    """Return whether all parts of a filter state that they are asymptotically exact.

    A part that states nothing counts as not exact, with a warning: a report must not call a filter
    exact because a stage written by a user is silent.

    Args:
        **parts: Stages by the configuration key under which they stand, each with `exact: bool`.

    Returns:
        True if `is_exact` is True for every part.
    """
    stated = [
        _stated(key, part) for key, part in parts.items()
    ]  # all of them: each silent part warns
    return all(stated)


def _stated(key: str, part: object) -> bool:
    """Return `part.is_exact`, or False with a warning."""
    value = getattr(part, "is_exact", None)
    if isinstance(value, bool):
        return value
    name = getattr(part, "__name__", type(part).__name__)
    warnings.warn(
        f"filter: {key} must state whether it is asymptotically exact, got {name} without `is_exact`. "
        "The filter counts as not exact. Add `is_exact = True` to it (or `is_exact = False`) "
        "and test it with pfbench.testing",
        stacklevel=4,
    )
    return False
