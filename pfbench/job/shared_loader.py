"""Hydra's composition with files that are read once in a process.

Hydra reads and parses all files of a configuration for each composition. A command composes several times, and a sweep or
`pfbench check` hundreds of times. Here the loaded files are kept, and so is the merged start of all compositions: Hydra's
own settings and `conf/config.yaml`. All else is Hydra's. `tests/config/test_shared_loader.py` compares the results.
"""

from __future__ import annotations

import copy
import os
import pickle
import re
import traceback
from collections.abc import Callable, Hashable, Iterator, Sequence
from typing import Any, TypeVar

from hydra._internal import defaults_list as hydra_defaults
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository
from hydra._internal.defaults_list import Overrides
from hydra.core.config_search_path import ConfigSearchPath
from hydra.core.config_store import ConfigStore
from hydra.core.default_element import InputDefault, ResultDefault
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import ConfigCompositionException
from hydra.plugins.config_source import ConfigResult, ConfigSource
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf, flag_override

from pfbench.files import limits
from pfbench.job.file_rules import (
    FOLDER_KEYS,
    check_content,
    check_defaults,
    check_group,
    check_place,
    launchers,
)
from pfbench.job.search_folders import ForeignFolder, open_folder
from pfbench.job.trust import UntrustedConfigError, check_study, require_allowed, trusted_packages

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
        except (
            AssertionError
        ) as error:  # Hydra cannot word this refusal where a list of files follows
            if "_update_overrides" not in [
                f.name for f in traceback.extract_tb(error.__traceback__)
            ]:
                raise
            raise UntrustedConfigError(
                "defaults must have each override after the files that it overrides, got one before a list of files. "
                "Put the overrides last."
            ) from error

        def compose_reference(words: list[str]) -> DictConfig:
            key = config_name, tuple(words), run_mode
            if key not in _references:
                _references[key] = super(SharedLoader, self).load_configuration(
                    config_name, words, run_mode, from_shell, validate_sweep_overrides
                )
            return _references[key]

        if "hydra_ray_launcher" in str(tree.hydra.launcher.get("_target_")):
            from ray.job_config import JobConfig

            # Ray puts the current folder before all libraries of a worker, unless there is a folder of its own
            setattr(JobConfig, "_runtime_env_has_working_dir", lambda self: True)  # noqa: B010
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
        main = repository.load_config(config_name) if config_name else None
        root = to_plain(main.config) if main is not None else {}
        for override in parsed if main is not None else ():
            key = override.key_or_group
            is_of_group = repository.group_exists(key) or repository.group_exists(key.split(".")[0])
            is_added = override.is_add() or override.is_force_add()
            # a key that nothing reads, such as +particle=50, would give another job with the same numbers
            if is_added and not is_of_group and not _has_key(root, key):
                raise ConfigCompositionException(f"{key} must be a key. Could not override '{key}'")
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
        folders: list[ForeignFolder] = []
        for entry in config_search_path.get_path():
            if str(entry.provider).startswith(_SEARCH_PATH):
                folders.append(open_folder(str(entry.provider), str(entry.path), self._trusted))
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
        require_allowed(
            not self.has_search_path or self._loaded <= limits.LOADED_FILES,
            "defaults lists",
            f"name at most {limits.LOADED_FILES} files in all, repetitions counted",
            f"more at {config_path}",
            "Shorten the lists of your files, which may name each other.",
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
            check_defaults(
                folder.file_of(config_path), result.defaults_list or (), is_own=folder.is_own
            )
        return result

    def _find_source(self, config_path: str) -> ConfigSource | None:
        """Return the source of a file, which must be the only one if it is in a search path."""
        if not self.has_search_path:
            return next((s for s in self.delegate.sources if s.is_config(config_path)), None)
        holders = [source for source in self.delegate.sources if source.is_config(config_path)]
        folder = next((source for source in holders if isinstance(source, ForeignFolder)), None)
        if folder is not None:
            self.folders[config_path] = folder
        if folder is not None and len(holders) > 1:
            second = next(source for source in holders if source is not folder)
            group, _, name = config_path.rpartition("/")
            second_file = f"pfbench's own {group or 'main file'} {name}"
            if isinstance(second, ForeignFolder):
                second_file = f"{second.file_of(config_path)}"
            raise UntrustedConfigError(
                f"{folder.file_of(config_path)} must have another name than {second_file}, got the same. Rename your file."
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
# Check of a composed configuration: what only the command line may set is as the command line sets it.
#
# `pfbench.job.file_rules` checks each file. Here the result is compared with a composition of the
# same words without any file of a search path, whatever way a file may have found.

_SETTINGS = (*FOLDER_KEYS, "trust", "overwrite", "memory_limit_gib")
_DATA = ("data", "checkpoint")  # a folder of the user's own may name them
# parts of the node `hydra` that differ between jobs and lead to nothing
_OF_A_JOB = ("overrides", "runtime", "searchpath")
_OF_A_NAME = ("name", "override_dirname", "config_name", "num", "id")


def check_composed(
    tree: Any, words: Sequence[str], compose_reference: Callable[[list[str]], Any] | None
) -> None:
    """Check a composed configuration."""
    check_study(tree._get_node("study")._value() if "study" in tree else None)  # not resolved
    require_allowed(
        not tree.hydra.job.chdir,
        "hydra.job.chdir",
        "be left out, since the folders of results and data are given from the folder of the command",
        tree.hydra.job.chdir,
        "Set results_dir=... and reports_dir=... for other folders.",
    )
    for group, name in tree.hydra.runtime.choices.items():
        is_path = isinstance(name, str) and (name.startswith("/") or ".." in name.split("/"))
        require_allowed(
            not is_path, group, "be the name of a file in its group", repr(name), "Use its name."
        )
    if compose_reference is None:
        return
    launcher = tree.hydra.runtime.choices.get("hydra/launcher")
    is_shipped = launcher in launchers()  # another one is of a folder of the user's own
    pattern = r"[+~]*hydra/launcher" if is_shipped else r"[+~]*hydra[/.]launcher"
    # the words that set what is compared, without the search path
    keys = rf"[+~]*({'|'.join((*_SETTINGS, *_DATA, 'hydra'))})\b"
    others = [
        word
        for word in words
        if re.match(keys, word) and not re.match(rf"[+~]*hydra\.searchpath\b|{pattern}", word)
    ]
    reference = compose_reference(
        [*others, f"hydra/launcher={launcher if is_shipped else 'basic'}"]
    )
    for (key, value), (_, expected) in zip(
        _list_settings(tree, words), _list_settings(reference, words), strict=True
    ):
        is_own_launcher = key == "hydra.launcher" and not is_shipped
        require_allowed(
            value == expected or is_own_launcher,
            key,
            "be set on the command line",
            f"{value!r:.200} from a file",
            f"Remove the key from the file, and add {key}=... to the command.",
        )


def _list_settings(tree: Any, words: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """Yield key and value of each setting that is compared."""
    values = to_plain(tree)
    is_own = any("own://" in word or "pkg://" in word for word in words)
    for key in (*_SETTINGS, *(() if is_own else _DATA)):
        yield key, values.get(key)
    hydra = {key: value for key, value in values["hydra"].items() if key not in _OF_A_JOB}
    hydra["job"] = {k: v for k, v in hydra["job"].items() if k not in _OF_A_NAME}
    hydra["sweeper"] = {k: v for k, v in (hydra["sweeper"] or {}).items() if k != "params"}
    for key, value in sorted(hydra.items()):
        yield f"hydra.{key}", value


def _has_key(values: Any, key: str) -> bool:
    """Return whether nested dictionaries have a key with points."""
    first, _, rest = key.partition(".")
    return (
        isinstance(values, dict) and first in values and (not rest or _has_key(values[first], rest))
    )


def to_plain(tree: Any) -> dict[str, Any]:
    """Return an unresolved configuration as plain dictionaries and lists."""
    content = OmegaConf.to_container(tree, resolve=False)
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}
