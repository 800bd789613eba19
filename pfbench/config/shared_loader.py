"""Hydra's composition with files that are read once in a process.

Hydra reads and parses all files of a configuration for each composition. A command composes several times, and a sweep or
`pfbench check` hundreds of times. Here the loaded files are kept, and so is the merged start of all compositions: Hydra's
own settings and `conf/config.yaml`. All else is Hydra's. `tests/config/test_composition.py` compares the results.
"""

from __future__ import annotations

import copy
import os
import pickle
from collections.abc import Callable, Hashable, Sequence
from functools import cache
from typing import Any, TypeVar

from hydra._internal import defaults_list as hydra_defaults
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository, ConfigRepository
from hydra._internal.defaults_list import Overrides
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_store import ConfigStore
from hydra.core.default_element import InputDefault, ResultDefault
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.plugins.config_source import ConfigResult, ConfigSource
from omegaconf import DictConfig, OmegaConf, flag_override

_Object = TypeVar("_Object")

_OWN_PACKAGE = "pkg://hydra.conf"  # files of Hydra itself, which do not change in a process
# objects of Hydra by their name, with the version of their files. A composition changes its copy, and pickle copies fastest
_kept: dict[Hashable, tuple[Hashable, bytes]] = {}


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
    """Hydra's loader of configurations, which parses no file twice."""

    def _parse_overrides_and_create_caching_repo(
        self, config_name: str | None, overrides: list[str]
    ) -> tuple[list[Override], CachingConfigRepository]:
        """Parse the overrides, and make the repository of one composition."""
        parsed = OverridesParser.create().parse_overrides(overrides=overrides)
        repository = _SharedRepository(self.repository)
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
        load = super()._load_single_config
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
    """

    def __init__(self, delegate: Any) -> None:
        # Hydra copies all nodes of its store. A search path replaces the list of sources, and no source changes.
        self.delegate: ConfigRepository = copy.copy(delegate)
        self.cache = {}
        self.versions: dict[str, Hashable] = {}

    def load_config(self, config_path: str) -> ConfigResult | None:
        """Return a file, the same object for each call in a composition."""
        if config_path not in self.cache:
            self.cache[config_path] = self._load(config_path)
        return self.cache[config_path]

    def _load(self, config_path: str) -> ConfigResult | None:
        """Load a file, or copy it."""
        source = next((s for s in self.delegate.sources if _has_file(s, config_path)), None)
        schema = self.get_schema_source()
        version = _find_version(source, config_path, schema) if source else None
        if source is None or version is None:
            return self.delegate.load_config(config_path)
        self.versions[config_path] = version = source.full_path(), source.provider, version
        return _keep(config_path, version, lambda: self.delegate.load_config(config_path))


class _StoredNode:
    """A node of Hydra's store, which is equal to itself alone."""

    def __init__(self, node: Any) -> None:
        self._node = node

    def __eq__(self, value: object) -> bool:
        return isinstance(value, _StoredNode) and value._node is self._node

    def __hash__(self) -> int:
        return id(self._node)


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
    if source.scheme() == "file":
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
