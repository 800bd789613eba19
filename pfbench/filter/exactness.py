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


def has_evidence(method: object) -> bool:
    """Return whether the log evidence of a filter is a log density of the measurements.

    It is not if a weight or a noise covariance of a step depends on the measurement of that step.

    Args:
        method: Filter. It or its stages may define `has_evidence: bool`; nothing means True.

    Returns:
        True if no part states the opposite.
    """
    stages = (getattr(method, name, None) for name in ("proposal", "weight_update"))
    return all(getattr(stage, "has_evidence", True) for stage in (method, *stages))


def check_has_evidence(method: object, user: str) -> None:
    """Check that a filter may serve a parameter inference.

    Args:
        method: Filter.
        user: Function or class that uses the evidence, for the message.

    Raises:
        ValueError: If its evidence is not a density of the measurements.
    """
    if not has_evidence(method):
        raise ValueError(
            f"{user} must have a filter whose evidence is a density of the measurements, got "
            f"{type(method).__name__} with weights or noise that depend on the measurement. "
            "Remove its adaptation, or use a model with another noise distribution."
        )
