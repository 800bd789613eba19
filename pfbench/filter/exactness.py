"""Statements of a filter on its weights: asymptotically exact, bounded, and evidence that is a density.

Each part of a filter states it, and the filter states what all of its parts do.
"""

from __future__ import annotations

import warnings
from dataclasses import fields, is_dataclass

from pfbench.core.parameter_checks import require

_BEHAVIOUR = ("__call__", "__getattr__", "__getattribute__")  # other dunder names are data
_STATEMENTS = ("is_exact", "has_bounded_weights", "has_evidence", "has_covariance")
_OF_THE_TYPE_SYSTEM = ("_abc_impl", "_is_protocol", "_is_runtime_protocol")


def is_every_part_exact(method: object = None, /, **parts: object) -> bool:
    """Return whether all parts of a filter state that they are asymptotically exact.

    A part that states nothing counts as not exact, with a warning: a report must not call a filter
    exact because a stage written by a user is silent. A class that overrides behaviour of the class
    that states it is silent, too, unless it states `is_exact` in its own body.

    Args:
        method: Filter of these parts. Its class may be silent, too.
        **parts: Stages by their configuration key, each with `is_exact: bool`.

    Returns:
        True if `is_exact` is True for every part.
    """
    statements = [
        _is_stated_exact(key, stage) for key, stage in parts.items()
    ]  # each silent part warns
    if method is not None and _overrides_silently(method):
        _warn_silence("filter", method)
        return False
    return all(statements)


def _is_stated_exact(key: str, stage: object) -> bool:
    """Return `stage.is_exact`, or False with a warning."""
    value = getattr(stage, "is_exact", None)
    if value is False or (value is True and not _overrides_silently(stage)):
        return value
    _warn_silence(key, stage)
    return False


def _overrides_silently(stage: object, flag: str = "is_exact") -> bool:
    """Return whether a class overrides behaviour of the class whose statement it inherits."""
    classes = type(stage).__mro__
    home = next((i for i, cls in enumerate(classes) if flag in vars(cls)), 0)
    if flag in getattr(stage, "__dict__", {}):
        return False
    defaults = {field.name for field in fields(stage)} if is_dataclass(stage) else set()
    inherited = {name for cls in classes[home:-1] for name in vars(cls)} - defaults
    return any(
        name in inherited and _is_behaviour(name) for cls in classes[:home] for name in vars(cls)
    )


def _is_behaviour(name: str) -> bool:
    """Return whether a name of a class can change what it computes."""
    if name.startswith("__"):
        return name in _BEHAVIOUR
    return name not in (*_STATEMENTS, *_OF_THE_TYPE_SYSTEM)


def _warn_silence(key: str, stage: object) -> None:
    """Warn of a stage that does not state whether it is exact."""
    name = getattr(stage, "__name__", type(stage).__name__)
    warnings.warn(
        f"filter: {key} must state whether it is asymptotically exact, got {name} without "
        "`is_exact`. The filter counts as not exact. Add `is_exact = True` to it (or "
        "`is_exact = False`) and test it with pfbench.testing.",
        stacklevel=5,
    )


def has_bounded_weights(method: object) -> bool | None:
    """Return whether no particle can have a larger weight than a constant times its likelihood.

    Weights without a bound may have an infinite variance. Estimates then converge, but too slowly
    for any number of particles at hand, and a run does not see what it misses. A stage that is
    silent counts as unbounded, and so does one that overrides behaviour of the class that states it.
    """
    value = getattr(method, "has_bounded_weights", None)
    if value is None:
        return False if hasattr(method, "proposal") else None
    return bool(value) and not _overrides_silently(method, "has_bounded_weights")


def has_evidence(method: object) -> bool:
    """Return whether the log evidence of a filter is a log density of the measurements.

    It is not if a weight or a noise covariance of a step depends on the measurement of that step.
    """
    stages = (getattr(method, name, None) for name in ("proposal", "weight_update"))
    return all(getattr(stage, "has_evidence", True) for stage in (method, *stages))


def has_covariance(method: object) -> bool:
    """Return whether a filter states the covariance of its estimate."""
    return bool(getattr(method, "has_covariance", True))


def check_has_evidence(method: object, user: str) -> None:
    """Check that a filter may serve a parameter inference."""
    require(
        has_evidence(method),
        user,
        "have a filter whose evidence is a density of the measurements",
        f"{type(method).__name__} with weights or noise that depend on the measurement",
        "Remove its adaptation, or use a model with another noise distribution.",
    )
