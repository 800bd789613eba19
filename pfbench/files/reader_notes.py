"""Notes of readers on the console: each once, before the first job that uses the file."""

from __future__ import annotations

import contextlib
import hashlib
import logging
import os
from collections.abc import Sequence
from pathlib import Path

SWEEP_LOG = "PFBENCH_SWEEP_LOG"  # environment variable: file to which all jobs of a sweep append
NOTE = "note"  # first word of a line of this file that is not an outcome of a job

_MOST = 12  # lines about one source

log = logging.getLogger("pfbench")

_announced: set[tuple[str, ...]] = set()  # sweep, source and note


def announce_notes(source: str | Path, notes: Sequence[str]) -> None:
    """Log notes on what was read, dropped or assumed.

    A note is logged once by a process, and once by all processes of a sweep.
    """
    sweep = os.environ.get(SWEEP_LOG, "")
    if len(notes) > _MOST:
        rest = f"{len(notes) - _MOST + 1} further notes, which the page of a study lists"
        notes = [*notes[: _MOST - 1], rest]
    for note in notes:
        entry = (sweep, str(source), note)
        if entry in _announced:
            continue
        _announced.add(entry)
        if _is_first(sweep, entry):
            log.warning("note      %s: %s", Path(source).name, note)


def skip_notes(source: str | Path, notes: Sequence[str]) -> None:
    """Do not log notes for a source, because another reader logs them."""
    sweep = os.environ.get(SWEEP_LOG, "")
    _announced.update((sweep, str(source), note) for note in notes)


def append_line(path: str | Path, line: str) -> None:
    """Append a line to the file of a sweep, whole among those of other processes."""
    os.makedirs(os.path.dirname(path), exist_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
    try:
        os.write(descriptor, f"{line}\n".encode())
    finally:
        os.close(descriptor)


def _is_first(sweep: str, entry: Sequence[str]) -> bool:
    """Return whether this process is the first of a sweep to tell a note, by the first line about it."""
    if not sweep:
        return True
    digest = hashlib.sha256("\n".join(entry[1:]).encode()).hexdigest()[:16]
    line = f"{NOTE} {digest} {os.getpid()}"
    with contextlib.suppress(OSError):  # of a full disk: the job reports it
        append_line(sweep, line)
        lines = Path(sweep).read_text().splitlines()
        return next((text for text in lines if f" {digest} " in text), line) == line
    return True
