"""Start of a command: when its work begins, and fewer garbage collections until then."""

from __future__ import annotations

import gc

# Work starts when the first run of a job is computed, when the first epoch of a training is, or when the first file is
# written. Until then nothing is stored. Words, configurations, input files, plans and the data of a job are checked before.

_state = {"has_started": False}


def reset_work() -> None:
    """Note that no work has started: a command begins."""
    _state["has_started"] = False
    collect_rarely()


def start_work() -> None:
    """Note that work has started."""
    _state["has_started"] = True
    collect_as_usual()


def has_work_started() -> bool:
    """Return whether work has started since the command began."""
    return _state["has_started"]


# --------------------------------------------------------------------------------------------------
# Fewer garbage collections while a command starts.
#
# A command imports and composes before its work starts. Both make hundreds of thousands of objects, and most of them remain.
# Collections that visit them again and again take a fifth of the start.

_YOUNG_OBJECTS = (
    500_000  # between two collections: more than a usual start makes, at most some 100 MB
)
_usual: list[tuple[int, int, int]] = []  # thresholds of the process, while others are set


def collect_rarely() -> None:
    """Collect garbage after many objects only, until `collect_as_usual`."""
    if not _usual:
        _usual.append(gc.get_threshold())
        gc.set_threshold(_YOUNG_OBJECTS, *_usual[0][1:])


def collect_as_usual() -> None:
    """Set the thresholds that the process had before `collect_rarely`.

    No later collection visits the objects of the start, unless the process has excluded others from collections before.
    """
    if not _usual:
        return
    if not gc.get_freeze_count():
        gc.freeze()
    gc.set_threshold(*_usual.pop())
