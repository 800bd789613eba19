"""Command `pfbench data`: list the recorded data sets, and check a folder of them."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from pfbench.cli.command import Command
from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import hash_file

_LIST = Path(__file__).parents[1] / "worlds" / "data_sets.yaml"


def read_data_sets() -> dict[str, dict[str, Any]]:
    """Read the list of data sets by name: about, source, commit, folder, licence, and files with bytes and SHA-256."""
    content: dict[str, dict[str, Any]] = yaml.safe_load(_LIST.read_text(encoding="utf-8"))
    return content


def check_data_set(
    name: str, files: Mapping[str, Mapping[str, Any]], root: Path
) -> tuple[str, list[str]]:
    """Return the state of a data set in a folder of them, in a word, and what is wrong with its files."""
    folder = root / name
    if not folder.is_dir():
        return "missing", []
    missing = [file for file in files if not (folder / file).is_file()]
    changed = [
        file
        for file, facts in files.items()
        if file not in missing and not facts["sha256"].startswith(hash_file(folder / file))
    ]
    word = "incomplete" if missing else "differs" if changed else "complete"
    return word, [
        f"{name}/{f} {'is missing' if f in missing else 'differs'}" for f in missing + changed
    ]


def list_data(words: Sequence[str]) -> None:
    """Print the data sets, and check a folder."""
    require(
        len(words) < 2 and "=" not in "".join(words),
        "pfbench data",
        "receive one folder",
        " ".join(words),
        "Use: pfbench data FOLDER",
    )
    folder = words[0] if words else os.environ.get("PFBENCH_DATA", "")
    root = Path(folder).expanduser()
    require(
        not folder or root.is_dir(),
        "FOLDER",
        "be a folder",
        folder,
        "Name the one that holds the data sets: pfbench data FOLDER",
    )
    sets = read_data_sets()
    states = {name: check_data_set(name, facts["files"], root) for name, facts in sets.items()} if folder else {}  # fmt: skip
    for name, facts in sets.items():
        size = sum(file["bytes"] for file in facts["files"].values()) / 1e6
        word = states[name][0] if folder else ""
        print(f"{name:16} {word:11}{size:5.1f} MB  {facts['licence']:18} {facts['about']}")
        print(f"{'':16} {'':11}{facts['source']} {facts['commit'][:10]}, {facts['folder']}")
    if not folder:
        print("\nCheck a folder: pfbench data FOLDER. Use it: export PFBENCH_DATA=FOLDER")
        return
    faults = [fault for _, of_set in states.values() for fault in of_set]
    require(
        not faults,
        "data sets",
        "have all their files unchanged",
        f"{folder} where {'; '.join(faults)}",
        "Copy these files again, or remove the folder of the data set.",
    )
    count = sum(word == "complete" for word, _ in states.values())
    print(f"\n{count} of {len(states)} data sets are complete in {folder}. Use them: export PFBENCH_DATA={folder}")  # fmt: skip


COMMAND = Command(
    list_data,
    """\
pfbench data [FOLDER]

List the recorded data sets with source, licence and size, and check a folder by the checksums of their files.
Without FOLDER that of the environment variable PFBENCH_DATA is checked, or none.

  pfbench data
  pfbench data ~/navigation_data

A whole data set may be missing: its scenarios are then refused. A file that is missing from a data set, or that
differs, is an error. Page: docs/data_sets.md""",
)
