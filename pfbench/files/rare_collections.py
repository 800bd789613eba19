"""Fewer garbage collections while a command starts.

A command imports and composes before its work starts. Both make hundreds of thousands of objects, and most of them remain.
Collections that visit them again and again take a fifth of the start.
"""

from __future__ import annotations

import gc

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
