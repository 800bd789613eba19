"""Errors that pfbench does not name: stage and file by the entry on the stack, and the file of the trace.

A sentence is written where an error is expected: pfbench raises it by a `raise` statement. All other errors are of Python or of
a library. They are reported with what was being done, their class and text, and a file with the whole trace.
"""

from __future__ import annotations

import dis
import tempfile
import traceback
from collections.abc import Sequence
from pathlib import Path
from types import FrameType

# what a folder of pfbench does; those without an entry serve the others
_STAGES = {
    "claims": "writing the page of the claims",
    "cli": "running the command",
    "config": "composing the configuration",
    "filter": "running the filter",
    "job": "running the job",
    "judge": "comparing the trajectories",
    "learn": "training the network",
    "model": "evaluating the model",
    "noise": "drawing the errors of the measurements",
    "replay": "computing the stored run again",
    "report": "writing the page",
    "results": "reading the results",
    "scenario": "drawing the data of the scenario",
}
_FILE_NAMES = ("path", "file")  # local variables of functions that read or write
_RAISE = dis.opmap["RAISE_VARARGS"]


def is_named(error: BaseException) -> bool:
    """Return whether pfbench raised an error itself, so that its text is a sentence for the user.

    Args:
        error: Error of a command. One without a trace comes from another process, where pfbench raised it.
    """
    if any(base.__module__.partition(".")[0] == "pfbench" for base in type(error).__mro__):
        return True
    entry = error.__traceback__
    while entry is not None and entry.tb_next is not None:
        entry = entry.tb_next
    if entry is None:
        return True
    is_raised = entry.tb_frame.f_code.co_code[entry.tb_lasti] == _RAISE
    return is_raised and _module(entry.tb_frame)[0] == "pfbench"


def describe_unknown(error: BaseException) -> str:
    """Describe an error that pfbench does not name.

    Args:
        error: Error of Python or of a library.

    Returns:
        Stage or file, class and text of the error, and a remedy.
    """
    frames = [frame for frame, _ in traceback.walk_tb(error.__traceback__)]
    package_frames = [frame for frame in reversed(frames) if _module(frame)[0] == "pfbench"]
    folders = [_module(frame)[1] for frame in package_frames]
    stage = next((_STAGES[name] for name in folders if name in _STAGES), "running the command")
    files = [frame.f_locals.get(name) for frame in package_frames[:3] for name in _FILE_NAMES]
    path = next((value for value in files if isinstance(value, Path)), None)
    name = f"{stage} ({path})" if path else stage
    reason = " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":")
    subject = str(path) if path else "the words of the command and the files that they name"
    return f"{name} must succeed, got {reason.rstrip('.')}. Check {subject}."


def keep_trace(error: BaseException, words: Sequence[str]) -> Path | None:
    """Write the trace of an error into a file of its own in the system's temporary folder.

    Args:
        error: Error.
        words: Words of the command.

    Returns:
        The file, or None if none can be written.
    """
    try:
        with tempfile.NamedTemporaryFile(
            "w", prefix="pfbench-", suffix=".txt", delete=False, encoding="utf-8", errors="backslashreplace"
        ) as file:  # fmt: skip
            file.write(f"{' '.join(['pfbench', *words])}\n\n")
            file.writelines(traceback.format_exception(error))
    except OSError:
        return None
    return Path(file.name)


def _module(frame: FrameType) -> list[str]:
    """Return the parts of the name of a frame's module, at least two."""
    return [*str(frame.f_globals.get("__name__", "")).split("."), ""]
