"""Folders of a search path as Hydra's sources, each file checked where it is read.

Hydra asks a source for each file that it loads: by a choice, a defaults list, a sweep. A source of this
module refuses links, pipes and devices, and measures a file before it builds anything from it.
"""

from __future__ import annotations

import io
import os
import stat
from collections.abc import Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

import yaml
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import OmegaConf

from pfbench.core.parameter_checks import require
from pfbench.files import limits
from pfbench.job.trust import UntrustedConfigError, require_allowed


class ForeignFolder(FileConfigSource):
    """Folder of files that another person may have written: `file://FOLDER`.

    Attributes:
        is_own: Whether the user says that the files are his own.
    """

    is_own = False

    def file_of(self, config_path: str) -> Path:
        """Return the path of a configuration."""
        return Path(self.path, self._normalize_file_name(config_path))

    def is_group(self, config_path: str) -> bool:
        """Return whether a folder exists."""
        return _is_kind(Path(self.path), config_path, stat.S_IFDIR)

    def is_config(self, config_path: str) -> bool:
        """Return whether a file exists."""
        return _is_kind(Path(self.path), self._normalize_file_name(config_path), stat.S_IFREG)

    def load_config(self, config_path: str) -> ConfigResult:
        """Read a file as Hydra does, after its measures."""
        file = self.file_of(config_path)
        text = _read(file)
        _check_measures(file, text)
        header = ConfigSource._get_header_dict(text[:512])  # as many as Hydra reads
        stream = io.StringIO(text)
        setattr(stream, "name", f"{file}")  # noqa: B010 - for the messages of the reader
        config = OmegaConf.load(stream)
        return ConfigResult(self.provider, self.full_path(), config, header)


class OwnFolder(ForeignFolder):
    """Folder whose files the user has written: `own://FOLDER`."""

    is_own = True

    @staticmethod
    def scheme() -> str:
        """Return the scheme of the path."""
        return "own"


def open_folder(provider: str, path: str, trusted: Sequence[str]) -> ForeignFolder:
    """Return the source of an entry of `hydra.searchpath`."""
    scheme, _, name = path.rpartition("://")
    if scheme == "pkg":
        folder, scheme = _find_package(name, trusted), "own"
    elif scheme in ("", "file", "own"):
        folder = name
    else:
        raise ValueError(
            f"hydra.searchpath must have folders (file://FOLDER, own://FOLDER for files of your own) or "
            f"packages (pkg://MODULE), got {path}. Copy the files into a folder."
        )
    require(
        os.path.isdir(folder),
        "hydra.searchpath",
        "have existing folders",
        folder,
        "Use file:// and a full path.",
    )
    kind = OwnFolder if scheme == "own" else ForeignFolder
    return kind(provider, f"{kind.scheme()}://{folder}")


def _find_package(name: str, trusted: Sequence[str]) -> str:
    """Return the folder of a trusted package."""
    require_allowed(
        any(name == package or name.startswith(f"{package}.") for package in trusted),
        "hydra.searchpath",
        "have packages that you trust",
        f"pkg://{name}",
        f"If you trust it, add trust=[{name.partition('.')[0]}] on the command line.",
    )
    try:
        spec = find_spec(name)
    except ModuleNotFoundError:
        spec = None
    folders = list(spec.submodule_search_locations or ()) if spec else []
    return folders[0] if folders else name


def _is_kind(root: Path, name: str, kind: int) -> bool:
    """Return whether a path in a folder is of a kind, and refuse what is neither file nor folder."""
    path = root / name
    if not os.path.lexists(path):
        return False
    mode = path.lstat().st_mode
    inside = os.path.normpath(os.path.realpath(root) + os.sep + name)
    is_inside = not stat.S_ISLNK(mode) and os.path.realpath(path) == inside
    require_allowed(
        is_inside, path, f"be a file or a folder below {root}", "a link or a path out of it", "Copy the file into the folder."
    )  # fmt: skip
    is_kind = stat.S_ISREG(mode) or stat.S_ISDIR(mode)
    require_allowed(is_kind, path, "be a file", "a pipe or a device", "Remove it.")
    return stat.S_IFMT(mode) == kind


def _read(file: Path) -> str:
    """Read the text of a file that may have become a link, a pipe or a large file since it was found."""
    with open(os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as stream:
        is_file = stat.S_ISREG(os.fstat(stream.fileno()).st_mode)
        content = stream.read(limits.CONFIG_BYTES + 1) if is_file else b""
    _require_size(len(content) <= limits.CONFIG_BYTES, file, f"{limits.CONFIG_BYTES} bytes")
    try:
        text = content.decode("utf-8")
    except UnicodeDecodeError as error:
        raise UntrustedConfigError(
            f"{file} must be text in UTF-8, got the byte 0x{content[error.start]:02x}. Save it as UTF-8."
        ) from error
    return text.replace("\r\n", "\n").replace("\r", "\n")  # as Python opens a text


def _check_measures(file: Path, text: str) -> None:
    """Check form, size and depth of a file, which is not built for it. Hydra reports an error of YAML."""
    root: yaml.Event | None = None
    try:
        for event, values, depth in _measure(text):
            root = root or (event if isinstance(event, yaml.NodeEvent) else None)
            expanded = f"{limits.CONFIG_VALUES} values with its aliases expanded"
            _require_size(values <= limits.CONFIG_VALUES, file, expanded)
            _require_size(depth <= limits.CONFIG_DEPTH, file, f"{limits.CONFIG_DEPTH} levels")
            is_short = len(getattr(event, "value", "")) <= limits.CONFIG_TEXT
            _require_size(is_short, file, f"{limits.CONFIG_TEXT} characters in a text")
    except yaml.YAMLError:
        return
    kinds = {yaml.ScalarEvent: "a scalar", yaml.SequenceStartEvent: "a sequence"}
    require_allowed(
        isinstance(root, yaml.MappingStartEvent),
        file,
        "be keys and values",
        kinds.get(type(root), "an empty file"),
        f"Write key: value on each line, or choose another one: pfbench list {file.parent.name}",
    )


def _measure(text: str) -> Iterator[tuple[yaml.Event, int, int]]:
    """Yield the events of the parser with the values so far, aliases expanded, and the depth."""
    values, starts = 0, list[tuple[str | None, int]]()
    sizes: dict[str | None, int] = {}
    for event in yaml.parse(text, yaml.SafeLoader):
        if isinstance(event, yaml.AliasEvent):  # one inside of its own node expands for ever
            values += sizes.get(event.anchor, limits.CONFIG_VALUES)
        elif isinstance(event, yaml.ScalarEvent):
            values, sizes[event.anchor] = values + 1, 1
        elif isinstance(event, yaml.CollectionStartEvent):
            starts.append((event.anchor, values))
            sizes.pop(event.anchor, None)
            values += 1
        elif isinstance(event, yaml.CollectionEndEvent):
            anchor, before = starts.pop()
            sizes[anchor] = values - before
        yield event, values, len(starts)


def _require_size(ok: bool, file: Path, limit: str) -> None:
    """Raise UntrustedConfigError unless a file is small enough."""
    remedy = "Write a shorter file, or put the numbers into a table that a class reads."
    require_allowed(ok, file, f"have at most {limit}", "more", remedy)
