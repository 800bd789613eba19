"""A folder with a manifest of the files that pfbench wrote to it, the only ones that it may remove."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from functools import cache
from pathlib import Path, PurePosixPath
from types import TracebackType
from typing import Any, Self

from pfbench.files.atomic_write import (
    DIGEST,
    has_valid_digest,
    hash_content,
    set_aside,
    write_atomically,
)
from pfbench.files.command_start import start_work

MANIFEST = "manifest.json"
_SHOWN = 3  # names in a warning at most

log = logging.getLogger("pfbench")


class RecordedFolder:
    """Folder whose files are written with a record, so that a later writer removes only these.

    Use it as a context. At the end, files of the previous manifest that were not written again are
    removed if their content is unchanged. After an error nothing is removed. A file that the manifest
    does not list, or that was changed since, is never removed: it stays, or is renamed to `NAME.kept`
    if its name is needed. A file whose content this project has published is replaced without a copy.

    Args:
        path: The folder. It is created with the first file.
        is_complete: Whether the writer makes all files of the folder. If not, old files stay, unless
            `remove` names them.
    """

    def __init__(self, path: str | Path, is_complete: bool = True) -> None:
        self.path = Path(path)
        if self.path.is_symlink():  # in a folder of another person it may lead to files of the user
            raise ValueError(
                f"{path} must be a folder, got a link. Remove the link, or choose another folder."
            )
        self._is_complete = is_complete
        self._previous = _read_manifest(self.path / MANIFEST)
        self._written: dict[str, str] = {}
        self._renamed: list[str] = []

    def __enter__(self) -> Self:
        """Return the folder."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Remove the old files and write the manifest."""
        if kind is None and self._is_complete:
            for name in sorted(self._previous.keys() - self._written.keys()):
                self.remove(name)
        elif not self._written:
            return
        files = {**self._previous, **self._written}
        write_manifest(self.path / MANIFEST, files)
        self._report_other_files()

    def write(self, name: str, content: str | bytes) -> Path:
        """Write a file and record it.

        Args:
            name: Path relative to the folder, with `/`.
            content: Content; text is encoded as UTF-8.

        Returns:
            Path of the file.

        Raises:
            ValueError: If the name leaves the folder, or a folder of the name is a link.
        """
        target = self.path / name
        if not _is_plain_name(name):
            raise ValueError(
                f"name must be a path within {self.path}, got {name!r}. Use a relative path."
            )
        if not _has_own_parents(self.path, name):
            raise ValueError(
                f"{target.parent} must be a folder, got a link. Remove the link, or choose another folder."
            )
        start_work()
        plain = content.encode() if isinstance(content, str) else content
        digest = hash_content(plain)
        expected = {digest, self._previous.get(name), self._written.get(name), *read_published()}
        if target.is_symlink() or (target.exists() and _hash_file(target) not in expected):
            self._renamed.append(set_aside(target, "kept").relative_to(self.path).as_posix())
        write_atomically(target, lambda file: file.write(plain))
        self._written[name] = digest
        return target

    def remove(self, name: str) -> None:
        """Remove a file of the previous manifest, if its content is unchanged.

        Args:
            name: Path relative to the folder, with `/`. A file that is not listed stays.
        """
        digest = self._previous.pop(name, None)
        file = self.path / name
        if digest is None or file.is_symlink() or not file.is_file():
            return
        if _has_own_parents(self.path, name) and _hash_file(file) == digest:
            file.unlink()

    def _report_other_files(self) -> None:
        """Warn about files of no manifest. Folders with a manifest are those of other commands."""
        if self._renamed:
            log.warning(
                "warning  %s: renamed before a new file of that name was written: %s",
                self.path,
                _list_names(self._renamed),
            )
        nested = [manifest.parent for manifest in self.path.rglob(f"*/{MANIFEST}")]
        others = sorted(
            name
            for file in self.path.rglob("*")
            if (file.is_symlink() or file.is_file())
            and not any(file.is_relative_to(folder) for folder in nested)
            and (name := file.relative_to(self.path).as_posix())
            not in (MANIFEST, *self._written, *self._previous)
            and name not in self._renamed
            and (file.is_symlink() or _hash_file(file) not in read_published())
        )
        if others and self._is_complete:
            log.warning(
                "warning  %s: not written by this command, so not removed: %s",
                self.path,
                _list_names(others),
            )


def _read_manifest(path: Path) -> dict[str, str]:
    """Read the digests by name. A manifest that is damaged or names other folders is renamed."""
    if not path.is_symlink() and not path.is_file():  # a pipe would be waited for
        return {}
    reason = "it is a link"
    if not path.is_symlink():
        try:
            content = json.loads(path.read_text(encoding="utf-8"))
            reason = _find_fault(content)
        except (OSError, ValueError, RecursionError) as error:
            reason = f"it is damaged ({error})"
        if not reason:
            files: dict[str, str] = content["files"]
            return files
    log.warning(
        "warning  %s is not used, since %s. Renamed to %s, and no file is removed",
        path,
        reason,
        set_aside(path).name,
    )
    return {}


def _find_fault(content: Any) -> str:
    """Return why a manifest cannot be used, or an empty text."""
    files = content.get("files") if isinstance(content, dict) else None
    if not isinstance(files, dict) or not has_valid_digest(content):
        return "its digest is not that of its content"
    bad = [name for name in files if not _is_plain_name(name) or not isinstance(files[name], str)]
    return f"{bad[0]!r} is not a file of this folder" if bad else ""


def write_manifest(path: Path, files: dict[str, str]) -> None:
    """Write a manifest with its digest.

    Args:
        path: File of the manifest.
        files: Digest of each file by its name below the folder.
    """
    content: dict[str, Any] = {"files": dict(sorted(files.items()))}
    text = json.dumps({**content, DIGEST: hash_content(content)}, indent=1) + "\n"
    write_atomically(path, lambda file: file.write(text.encode()))


def _is_plain_name(name: str) -> bool:
    """Return whether a name is a relative path without `..`, and not the manifest."""
    parts = name.split("/")
    is_relative = not PurePosixPath(name).is_absolute() and "\\" not in name and "\0" not in name
    return is_relative and name != MANIFEST and not {"", ".", ".."} & set(parts)


def _has_own_parents(folder: Path, name: str) -> bool:
    """Return whether no folder between a folder and a file in it is a link."""
    return not any((folder / p).is_symlink() for p in PurePosixPath(name).parents if p.name)


def _hash_file(path: Path) -> str:
    """Compute the digest of a file; empty for a folder."""
    return hash_content(path.read_bytes()) if path.is_file() else ""


def _list_names(names: Sequence[str]) -> str:
    """Format the first names and the number of the others."""
    return ", ".join(names[:_SHOWN]) + (
        f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    )


# --------------------------------------------------------------------------------------------------
# Files that this project has published

_PLACES = (Path(__file__).parents[1] / "published", Path(__file__).parents[2] / "reports")
#: Published runs: package data of the wheel, and `reports/` of a checkout.
PUBLISHED_RUNS = next((folder for folder in _PLACES if folder.is_dir()), _PLACES[0])
#: Digests of published files, which a clone has without the manifests of their folders.
PUBLISHED_FILES = PUBLISHED_RUNS / "published.json"
_INSTALL = "pip install --force-reinstall --no-deps pfbench"


@cache
def read_published() -> frozenset[str]:
    """Read the digests of the published files; none where they are not installed."""
    return frozenset(_read_manifest(PUBLISHED_FILES).values())


def find_published_file(name: str) -> Path | None:
    """Find a published file by name and digest; None if none of that name is installed.

    Args:
        name: Study and file, such as `all_seven/runs.parquet`.

    Raises:
        ValueError: If its content is not what was published.
    """
    path, digest = PUBLISHED_RUNS / name, _read_manifest(PUBLISHED_FILES).get(name)
    if digest is None or not path.is_file():
        return None
    if _hash_file(path) != digest:
        raise ValueError(
            f"{path} must have the digest in {PUBLISHED_FILES.name}, got another. Install it again: {_INSTALL}"
        )
    return path


def list_published(file: str) -> list[str]:
    """List the published studies that have a file of this name.

    Args:
        file: Name of the file.
    """
    return [
        name.partition("/")[0]
        for name in _read_manifest(PUBLISHED_FILES)
        if name.endswith(f"/{file}")
    ]


def copy_published(folder: Path, needed: str) -> None:
    """Copy the published files of a study to a folder of reports that lacks one of them.

    Args:
        folder: Folder of the report, with the name of the study.
        needed: Name of the file without which a page is not written.
    """
    if (folder / needed).is_file() or not find_published_file(f"{folder.name}/{needed}"):
        return
    with RecordedFolder(folder, is_complete=False) as target:
        for name in _read_manifest(PUBLISHED_FILES):
            study, _, file = name.partition("/")
            if study == folder.name and (path := find_published_file(name)):
                target.write(file, path.read_bytes())


def describe_missing_runs() -> str:
    """Return what to install where the published runs are missing; empty where they are not."""
    is_there = PUBLISHED_FILES.is_file()
    return "" if is_there else f" Published runs are not installed. Install them: {_INSTALL}\n"
