"""Hydra's composition with files that are read once in a process.

Hydra reads and parses all files of a configuration for each composition. A command composes several times, and a sweep or
`pfbench check` hundreds of times. Here the loaded files are kept, and so is the merged start of all compositions: Hydra's
own settings and `conf/config.yaml`. All else is Hydra's. `tests/config/test_composition.py` compares the results.
"""

from __future__ import annotations

import copy
import io
import os
import pickle
import stat
from collections.abc import Callable, Hashable, Iterator, Sequence
from functools import cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any, TypeVar

import yaml
from hydra._internal import defaults_list as hydra_defaults
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository
from hydra._internal.core_plugins.file_config_source import FileConfigSource
from hydra._internal.defaults_list import Overrides
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.default_element import InputDefault, ResultDefault
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, flag_override

from pfbench.files import limits
from pfbench.job.file_rules import (
    check_composed,
    check_content,
    check_defaults,
    check_group,
    check_place,
    to_plain,
)
from pfbench.job.trust import UntrustedConfigError, trusted_packages

_Object = TypeVar("_Object")

_SEARCH_PATH = "hydra.searchpath"  # start of the name that Hydra gives such a source
_OWN_PACKAGE = "pkg://hydra.conf"  # files of Hydra itself, which do not change in a process
# objects of Hydra by their name, with the version of their files. A composition changes its copy, and pickle copies fastest
_kept: dict[Hashable, tuple[Hashable, bytes]] = {}
_references: dict[
    Hashable, DictConfig
] = {}  # compositions of settings alone, which no file changes


def _keep(key: Hashable, version: Hashable, make: Callable[[], _Object]) -> _Object:
    """Return a copy of an object that was made of the same files before, or make it."""
    kept_version, content = _kept.get(key, (None, b""))
    if kept_version != version:
        result = make()
        try:
            content = pickle.dumps(result, pickle.HIGHEST_PROTOCOL)
        except (
            pickle.PicklingError
        ):  # in a process of a launcher, which has other classes of the same names
            return result
        _kept[key] = version, content
    copied: _Object = pickle.loads(content)
    return copied


class SharedLoader(ConfigLoaderImpl):
    """Hydra's loader of configurations, which parses no file twice and checks those of a search path.

    All compositions of pfbench are its own: of a single job, of each job of a sweep in any process, and those of Python.

    Attributes:
        trusted: Packages that may be in a search path.
    """

    def __init__(self, config_search_path: Any, trusted: Sequence[str] | None = None) -> None:
        super().__init__(config_search_path)
        self.trusted = tuple(trusted_packages() if trusted is None else trusted)

    def load_configuration(
        self,
        config_name: str | None,
        overrides: list[str],
        run_mode: RunMode,
        from_shell: bool = True,
        validate_sweep_overrides: bool = True,
    ) -> DictConfig:
        """Compose a configuration and check it.

        Returns the configuration, not resolved.
        """
        try:
            tree = super().load_configuration(
                config_name, overrides, run_mode, from_shell, validate_sweep_overrides
            )
        except RecursionError as error:
            raise UntrustedConfigError(
                "defaults must name files that do not name each other, got a circle. Remove one of the names."
            ) from error

        def compose_reference(words: list[str]) -> DictConfig:
            key = config_name, tuple(words), run_mode
            if key not in _references:
                _references[key] = super(SharedLoader, self).load_configuration(
                    config_name, words, run_mode, from_shell, validate_sweep_overrides
                )
            return _references[key]

        sources = tree.hydra.runtime.config_sources
        is_foreign = any(source.provider.startswith(_SEARCH_PATH) for source in sources)
        check_composed(tree, overrides, compose_reference if is_foreign else None)
        return tree

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], CachingConfigRepository]:
        """Parse the overrides, and make the repository of one composition."""
        parsed = OverridesParser.create().parse_overrides(overrides=overrides)
        repository = _SharedRepository(self.repository, self.trusted)
        self._process_config_searchpath(config_name, parsed, repository)
        return parsed, repository

    def _compose_config_from_defaults_list(
        self, defaults: list[ResultDefault], repo: Any
    ) -> DictConfig:
        """Merge files in the order of the defaults list."""
        count = 1 + next((i for i, default in enumerate(defaults) if default.primary), -1)
        start = self._merge_start(defaults[:count], repo)
        rest = defaults if start is None else [_MergedStart(start), *defaults[count:]]
        return super()._compose_config_from_defaults_list(rest, repo)

    def _merge_start(
        self, defaults: Sequence[ResultDefault], repo: _SharedRepository
    ) -> DictConfig | None:
        """Merge the first files, up to the main one; None if they cannot be kept."""

        def merge() -> DictConfig:
            merged = OmegaConf.create()
            with flag_override(merged, "no_deepcopy_set_nodes", True):
                for default in defaults:
                    merged.merge_with(self._load_single_config(default, repo).config)
            return merged

        version = tuple(repo.versions.get(f"{default.config_path}") for default in defaults)
        if not defaults or None in version:
            return None
        key = tuple((default.config_path, default.package) for default in defaults)
        return _keep(key, version, merge)

    def _load_single_config(self, default: ResultDefault, repo: Any) -> ConfigResult:
        """Load a file into its package."""
        if isinstance(default, _MergedStart):
            return ConfigResult("", "", default.config, {})

        def load(default: ResultDefault, repo: Any) -> ConfigResult:
            result = super(SharedLoader, self)._load_single_config(default, repo)
            folder = repo.folders.get(default.config_path)
            if folder is not None:
                check_content(
                    folder.file_of(default.config_path),
                    to_plain(result.config),
                    is_own=folder.is_own,
                )
            return result

        if repo.has_search_path:
            check_place(str(default.config_path), default.package)
        version = repo.versions.get(default.config_path)
        if version is None:
            return load(default, repo)
        key = default.config_path, default.package, default.primary
        return _keep(key, version, lambda: load(default, repo))


class _MergedStart(ResultDefault):
    """Entry of a defaults list with the merged result of its first entries."""

    def __init__(self, config: DictConfig) -> None:
        super().__init__()
        self.config = config


class _SharedRepository(CachingConfigRepository):
    """Files of one composition.

    Attributes:
        versions: Version of each file that can be kept, by its path.
        folders: Folder of each file of a search path, by its path.
        has_search_path: Whether there is a search path.
    """

    def __init__(self, delegate: Any, trusted: Sequence[str] = ()) -> None:
        # Hydra copies all nodes of its store. A search path replaces the list of sources, and no source changes.
        self.delegate: ConfigRepository = copy.copy(delegate)
        self.cache = {}
        self.versions: dict[str, Hashable] = {}
        self.folders: dict[str, ForeignFolder] = {}
        self.has_search_path = False
        self._trusted = trusted
        self._loaded = 0

    def initialize_sources(self, config_search_path: ConfigSearchPath) -> None:
        """Add the folders of a search path before the last source, the schemas."""
        folders = [
            open_folder(str(entry.provider), str(entry.path), self._trusted)
            for entry in config_search_path.get_path()
            if str(entry.provider).startswith(_SEARCH_PATH)
        ]
        *others, schema = self.delegate.sources
        self.delegate.sources = [*others, *folders, schema]
        self.has_search_path = bool(folders)
        for config_path in self.cache if folders else ():  # the main file, which Hydra loads before
            self._find_source(config_path)

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Return a file, the same object for each call in a composition."""
        if config_path not in self.cache:
            self.cache[config_path] = self._load(config_path)
        self._loaded += 1
        if self.has_search_path and self._loaded > limits.LOADED_FILES:
            raise UntrustedConfigError(
                f"defaults lists must name at most {limits.LOADED_FILES} files in all, repetitions counted, "
                f"got more at {config_path}. Shorten the lists of your files, which may name each other."
            )
        return self.cache[config_path]

    def _load(self, config_path: str) -> ConfigResult | None:
        """Load a file, or copy it."""
        source = self._find_source(config_path)
        schema = self.get_schema_source()
        version = _find_version(source, config_path, schema) if source else None
        if source is None or version is None:
            return self._load_and_check(config_path)
        self.versions[config_path] = version = source.full_path(), source.provider, version
        return _keep(config_path, version, lambda: self._load_and_check(config_path))

    def _load_and_check(self, config_path: str) -> ConfigResult | None:
        """Load a file, and check its defaults list if it is one of a search path."""
        folder = self.folders.get(config_path)
        if folder is not None:
            check_group(folder.file_of(config_path), config_path, is_own=folder.is_own)
        result = self.delegate.load_config(config_path)
        if folder is not None and result is not None:
            check_defaults(folder.file_of(config_path), result.defaults_list or ())
        return result

    def _find_source(self, config_path: str) -> ConfigSource | None:
        """Return the source of a file, which must be the only one if it is in a search path."""
        if not self.has_search_path:
            return next((s for s in self.delegate.sources if _has_file(s, config_path)), None)
        holders = [source for source in self.delegate.sources if _has_file(source, config_path)]
        folder = next((source for source in holders if isinstance(source, ForeignFolder)), None)
        if folder is not None:
            self.folders[config_path] = folder
        if folder is not None and len(holders) > 1:
            second = next(source for source in holders if source is not folder)
            raise UntrustedConfigError(
                f"{folder.file_of(config_path)} must have another name than "
                f"{_name_file(second, config_path)}, got the same. Rename your file."
            )
        return holders[0] if holders else None


class _StoredNode:
    """A node of Hydra's store, which is equal to itself alone."""

    def __init__(self, node: Any) -> None:
        self._node = node

    def __eq__(self, value: object) -> bool:
        return isinstance(value, _StoredNode) and value._node is self._node

    def __hash__(self) -> int:
        return id(self._node)


def _name_file(source: ConfigSource, config_path: str) -> str:
    """Return the place of a file, for messages."""
    group, _, name = config_path.rpartition("/")
    if isinstance(source, ForeignFolder):
        return f"{source.file_of(config_path)}"
    return f"pfbench's own {group or 'main file'} {name}"


def _has_file(source: ConfigSource, config_path: str) -> bool:
    """Return whether a source has a file."""
    is_own = source.full_path() == _OWN_PACKAGE
    return _has_own_file(config_path) if is_own else source.is_config(config_path)


@cache
def _has_own_file(config_path: str) -> bool:
    """Return whether Hydra's own package has a file."""
    source = SourcesRegistry.instance().resolve("pkg")("hydra", _OWN_PACKAGE)
    return source.is_config(config_path)


def _find_version(source: ConfigSource, config_path: str, schema: ConfigSource) -> Hashable | None:
    """Return a value that differs if a file has changed, None for a file that is not kept."""
    name = ConfigSource._normalize_file_name(config_path)
    if source.scheme() == "structured":  # not by class: Hydra executes modules of sources twice
        return _StoredNode(ConfigStore.instance()._load(name))
    if schema.is_config(config_path):  # Hydra merges the file with it
        return None
    if source.full_path() == _OWN_PACKAGE:
        return _OWN_PACKAGE
    if source.scheme() in ("file", "own"):
        status = os.stat(os.path.join(source.path, name))
        return status.st_mtime_ns, status.st_size, status.st_ino
    return None


def _collect_choices(
    overrides: Overrides, defaults_list: list[InputDefault], self_added: bool
) -> DictConfig:
    """Collect the choices for the interpolations in a defaults list; nothing for a list without any.

    Hydra collects them for each file, which takes a quarter of a composition.
    """
    if any(entry.is_interpolation() for entry in defaults_list):
        return collect_choices_by_hydra(overrides, defaults_list, self_added)
    return OmegaConf.create()


collect_choices_by_hydra = hydra_defaults._create_interpolation_map
hydra_defaults._create_interpolation_map = _collect_choices


# --------------------------------------------------------------------------------------------------
# Folders of a search path as Hydra's sources, each file checked where it is read.
#
# Hydra asks a source for each file that it loads: by a choice, a defaults list, a sweep. A source of this
# module refuses links, pipes and devices, and measures a file before it builds anything from it.


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
        config = OmegaConf.load(_NamedText(text, file))
        return ConfigResult(self.provider, self.full_path(), config, header)


class OwnFolder(ForeignFolder):
    """Folder whose files the user has written: `own://FOLDER`."""

    is_own = True

    @staticmethod
    def scheme() -> str:
        """Return the scheme of the path."""
        return "own"


class _NamedText(io.StringIO):
    """Text with the name of its file, for the messages of the reader."""

    def __init__(self, text: str, file: Path) -> None:
        super().__init__(text)
        self.name = f"{file}"


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
    if not os.path.isdir(folder):
        raise ValueError(
            f"hydra.searchpath must have existing folders, got {folder}. Use file:// and a full path."
        )
    kind = OwnFolder if scheme == "own" else ForeignFolder
    return kind(provider, f"{kind.scheme()}://{folder}")


def _find_package(name: str, trusted: Sequence[str]) -> str:
    """Return the folder of a trusted package."""
    if not any(name == package or name.startswith(f"{package}.") for package in trusted):
        raise UntrustedConfigError(
            f"hydra.searchpath must have packages that you trust, got pkg://{name}. If you trust it, add "
            f"trust=[{name.partition('.')[0]}] on the command line."
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
    if stat.S_ISLNK(mode) or os.path.realpath(path) != inside:
        raise UntrustedConfigError(
            f"{path} must be a file or a folder below {root}, got a link or a path out of it. "
            "Copy the file into the folder."
        )
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise UntrustedConfigError(f"{path} must be a file, got a pipe or a device. Remove it.")
    return stat.S_IFMT(mode) == kind


def _read(file: Path) -> str:
    """Read the text of a file that may have become a link, a pipe or a large file since it was found."""
    with open(os.open(file, os.O_RDONLY | os.O_NOFOLLOW | os.O_NONBLOCK), "rb") as stream:
        is_file = stat.S_ISREG(os.fstat(stream.fileno()).st_mode)
        content = stream.read(limits.CONFIG_BYTES + 1) if is_file else b""
    if len(content) > limits.CONFIG_BYTES:
        _refuse(file, f"{limits.CONFIG_BYTES} bytes")
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
            if values > limits.CONFIG_VALUES:
                _refuse(file, f"{limits.CONFIG_VALUES} values with its aliases expanded")
            if depth > limits.CONFIG_DEPTH:
                _refuse(file, f"{limits.CONFIG_DEPTH} levels")
            if len(getattr(event, "value", "")) > limits.CONFIG_TEXT:
                _refuse(file, f"{limits.CONFIG_TEXT} characters in a text")
    except yaml.YAMLError:
        return
    if not isinstance(root, yaml.MappingStartEvent):
        kinds = {yaml.ScalarEvent: "a scalar", yaml.SequenceStartEvent: "a sequence"}
        kind = kinds.get(type(root), "an empty file")
        raise UntrustedConfigError(
            f"{file} must be keys and values, got {kind}. Write key: value on each line, or choose "
            f"another one: pfbench list {file.parent.name}"
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


def _refuse(file: Path, limit: str) -> None:
    """Raise the error of a file that is too large."""
    raise UntrustedConfigError(
        f"{file} must have at most {limit}, got more. Write a shorter file, or put the numbers into a "
        "table that a class reads."
    )
