"""Inputs of a job: every file that its objects read, by a digest of its content.

A class that reads files has a method `input_files`, which returns their paths. It answers for all objects
inside of it. Files that a job reads and that no object names do not make a new job when they change.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from typing import Any

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import hash_file
from pfbench.files.source_digest import find_module, hash_reached
from pfbench.job.config import CHOICES
from pfbench.job.trust import (
    check_configuration,
    hash_user_code,
    list_user_targets,
    trusted_packages,
    walk_nodes,
)
from pfbench.results.inputs import list_changed
from pfbench.results.paper_block import remove_all_blocks
from pfbench.results.store import Inputs, remove_digests

# start of the names of source files of a user's classes, and of the values that the classes reach
CODE_OF = "code of ", "values of "
_MISSING = "missing"
# public classes of pfbench with a method `input_files`, so that no other class is imported to find them
READERS = {
    "nav": ("BroadcastConstellation",),
    "noise": ("ErrorReplay",),
    "scenario": (
        "AlignedLog", "ConstrainedDrive", "RecordedAidedFlight", "RecordedDrive", "RecordedFlights", "RecordedTrajectory",
        "RecordedWalk", "UrbanDrive", "UserInsLog", "UserLog", "UserRawLog",
    ),
}  # fmt: skip


def find_inputs(values: Mapping[str, Any], trusted: Sequence[str] = ()) -> Inputs:
    """Find all that a job reads besides its configuration and pfbench."""
    trusted = (*trusted, *trusted_packages())
    digests = {}
    for group in CHOICES:
        node = values.get(group)
        entries = _hash_files(_list_files(node, trusted), values.get("data", {}).get("root"))
        code = hash_user_code(node).items()
        entries |= {f"{CODE_OF[0]}{remove_digests(name)}": value for name, value in code}
        if code:  # with the values that the classes reach; packages without trust are not loaded
            entries |= {
                f"{CODE_OF[1]}{remove_digests(target)}": hash_reached(target, thing)
                for target in sorted(set(list_user_targets(node)))
                if (thing := _find_class(target, trusted)) is not None
            }
        if entries:
            digests[group] = entries
    return digests


def check_unchanged(before: Inputs, values: Mapping[str, Any], trusted: Sequence[str] = ()) -> None:
    """Raise ValueError if a file was written while a job read it."""
    after = find_inputs(values, trusted)
    if after == before:
        return
    changed = list_changed(before, after)
    files = [name for name in changed if not name.startswith(CODE_OF)]  # loaded before
    require(
        not files,
        " and ".join(files),
        "not change while a job reads it",
        "other content at its end",
        "Run the job again.",
    )


def names_checkpoint(node: Any) -> bool:
    """Return whether a filter names a checkpoint of trained weights."""
    return any(
        isinstance(value, Mapping) and isinstance(value.get("checkpoint"), str)
        for _, value in walk_nodes(node)
    )


def describe_unnamed_files(scenario: Any, trusted: Sequence[str] = ()) -> tuple[str, ...]:
    """Return a note if nothing in a user's scenario says which files it reads."""
    target = str(scenario.get("_target_", ""))
    trusted = (*trusted, *trusted_packages())
    if target.startswith("pfbench.") or any(True for _ in _list_readers(scenario, trusted)):
        return ()
    return (
        f"{target} has no method input_files, so a file that it reads can change without a new job",
    )


def _list_files(node: Any, trusted: Sequence[str]) -> Iterator[Path]:
    """Yield the files that the objects of a node read."""
    for reader in _list_readers(node, trusted):
        try:
            built = _build(json.dumps(reader, sort_keys=True, default=str), tuple(trusted))
        except Exception:  # the plan of the job builds it again, and raises with its full key
            continue
        for path in map(Path, built.input_files()):
            is_file = not path.exists() or path.is_file()
            require(
                is_file,
                f"input_files of {reader['_target_']}",
                "return files",
                path,
                "Return the path of each file that is read.",
            )
            yield path


@lru_cache(maxsize=64)
def _build(reader: str, trusted: tuple[str, ...]) -> Any:
    """Build the object of a node, written as JSON, once for the many jobs of a sweep."""
    import hydra

    node = json.loads(reader)
    check_configuration(node, trusted)
    return hydra.utils.instantiate(remove_all_blocks(node), _convert_="all")


def _list_readers(node: Any, trusted: Sequence[str]) -> Iterator[Mapping[str, Any]]:
    """Yield the outermost nodes of a configuration whose classes have a method `input_files`."""
    if isinstance(node, Mapping):
        if _names_reader(node.get("_target_"), trusted):
            yield node
            return
        node = list(node.values())
    if isinstance(node, list | tuple):
        for value in node:
            yield from _list_readers(value, trusted)


def _names_reader(target: Any, trusted: Sequence[str]) -> bool:
    """Return whether a name is that of a class with a method `input_files`."""
    package, _, name = str(target).partition(".")
    folder, _, public = name.partition(".")
    if package == "pfbench" and "." not in public:
        return public in READERS.get(folder, ())
    return hasattr(_find_class(target, trusted), "input_files")


def _find_class(target: Any, trusted: Sequence[str]) -> Any:
    """Return a class of pfbench or of a trusted package, or None. Nothing else is imported."""
    packages = [f"{package}." for package in ("pfbench", *trusted)]
    if not isinstance(target, str) or not target.startswith(tuple(packages)):
        return None
    module = find_module(target)
    try:
        return attrgetter(target.removeprefix(f"{module}."))(import_module(module))
    except (
        ImportError,
        AttributeError,
    ):  # the plan of the job imports it again, and raises with its key
        return None


def _hash_files(paths: Iterator[Path], root: str | None) -> dict[str, str]:
    """Return the digest of each file by a name that does not depend on where the data are."""
    digests: dict[str, str] = {}
    for path in dict.fromkeys(paths):
        is_at_root = root is not None and path.parent == Path(root)
        name = path.name if is_at_root else f"{path.parent.name}/{path.name}"
        while name in digests:  # folders of one name in two places
            name += "'"
        digests[name] = hash_file(path) if path.exists() else _MISSING
    return digests
