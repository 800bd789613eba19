"""Start of the work of a command: an error before it refuses the input, an error after it is a failure.

Work starts when the first run of a job is computed, when the first epoch of a training is, or when the first file is
written. Until then nothing is stored. Words, configurations, input files, plans and the data of a job are checked before.
"""

from __future__ import annotations

from pfbench.files.rare_collections import collect_as_usual, collect_rarely

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
