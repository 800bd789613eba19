"""Files whose content git stores, so that a new file of that name loses nothing."""

from __future__ import annotations

import subprocess
from pathlib import Path

_TIMEOUT = 10  # s


def list_unchanged_in_git(folder: Path) -> set[str]:
    """List the files of a folder whose content is that of the index of git.

    Args:
        folder: Folder.

    Returns:
        Names relative to the folder, with `/`. Empty outside a repository and without git.
    """
    try:
        stored, changed = (_list_files(folder, *option) for option in ((), ("--modified",)))
    except (OSError, subprocess.SubprocessError):
        return set()
    return stored - changed


def _list_files(folder: Path, *options: str) -> set[str]:
    """List the files of the index in a folder; with --modified those that differ from it."""
    command = ["git", "-C", str(folder), "ls-files", "-z", *options]
    done = subprocess.run(command, capture_output=True, check=True, timeout=_TIMEOUT)
    return set(filter(None, done.stdout.decode(errors="surrogateescape").split("\0")))
