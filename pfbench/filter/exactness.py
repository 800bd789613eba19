"""Asymptotic exactness of a filter, which each of its parts states."""

from __future__ import annotations

import warnings


def is_every_part_exact(**parts: object) -> bool:
    """Return whether all parts of a filter state that they are asymptotically exact.

    A part that states nothing counts as not exact, with a warning: a report must not call a filter
    exact because a stage written by a user is silent.

    Args:
        **parts: Stages by their configuration key, each with `is_exact: bool`.

    Returns:
        True if `is_exact` is True for every part.
    """
    statements = [
        _is_stated_exact(key, stage) for key, stage in parts.items()
    ]  # each silent part warns
    return all(statements)


def _is_stated_exact(key: str, stage: object) -> bool:
    """Return `stage.is_exact`, or False with a warning."""
    value = getattr(stage, "is_exact", None)
    if isinstance(value, bool):
        return value
    name = getattr(stage, "__name__", type(stage).__name__)
    warnings.warn(
        f"filter: {key} must state whether it is asymptotically exact, got {name} without "
        "`is_exact`. The filter counts as not exact. Add `is_exact = True` to it (or "
        "`is_exact = False`) and test it with pfbench.testing.",
        stacklevel=4,
    )
    return False
