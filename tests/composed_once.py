"""Compositions by Hydra, each made once in a process: tests compose the same words a dozen times, and each takes 0.1 s.

Files of conf/ do not change during a test, so each is read once. Words that choose the same files and differ in values alone
share all up to these values. Words that read more than these files, and those about Hydra itself, are composed each time, from
the same parts. Processes that a test starts compose as users do.
"""

from __future__ import annotations

import contextlib
import copy
import dataclasses
import itertools
import os
import pickle
import re
from collections.abc import Callable, Iterator
from typing import Any
from unittest import mock

import yaml
from hydra import version
from hydra._internal import config_loader_impl
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra._internal.config_repository import CachingConfigRepository
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.core.utils import JobRuntime
from hydra.plugins.config_source import ConfigResult
from hydra.types import RunMode
from omegaconf import _utils

from pfbench.config.folders import conf_dir

READS_MORE = re.compile(r"\$|hydra")

with mock.patch.object(yaml, "SafeLoader", getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    _Loader = _utils.get_yaml_loader()  # a subclass, here of the parser in C, which is faster
compose_by_hydra = ConfigLoaderImpl._load_configuration_impl
_list_defaults = config_loader_impl.create_defaults_list
_merge_files = ConfigLoaderImpl._compose_config_from_defaults_list
_store = ConfigStore.store
_OWN = [("pkg", "hydra.conf"), ("file", str(conf_dir())), ("structured", "")]
_composed: dict[
    Any, bytes
] = {}  # pickled: a copy by pickle takes a third of the time of copy.deepcopy
_files: dict[Any, bytes] = {}
_defaults: dict[Any, Any] = {}
_patches = contextlib.ExitStack()


def install() -> None:
    """Make Hydra return copies of what it has read and composed before."""
    ours: dict[Any, dict[str, Any]] = {
        ConfigLoaderImpl: {
            "_load_configuration_impl": compose_once,
            "_compose_config_from_defaults_list": merge_files_once,
        },
        config_loader_impl: {"create_defaults_list": list_defaults_once},
        CachingConfigRepository: {"__init__": share_sources},
        ConfigStore: {"store": store_node},
    }
    Plugins.instance()  # registers the sources
    for scheme in ("file", "pkg"):
        source = SourcesRegistry.instance().resolve(scheme)
        ours[source] = {"load_config": read_once(source.load_config)}
    for owner, functions in ours.items():
        _patches.enter_context(mock.patch.multiple(owner, **functions))


@contextlib.contextmanager
def uninstalled() -> Iterator[None]:
    """Compose as users do."""
    _patches.close()
    try:
        yield
    finally:
        install()


def share_sources(self: CachingConfigRepository, delegate: Any) -> None:
    """Copy the list of sources alone, which a search path replaces; Hydra copies all that they hold."""
    self.delegate = copy.copy(delegate)
    self.cache = {}


def read_once(load: Callable[..., Any]) -> Callable[..., Any]:
    """Read a file of conf/ or of Hydra once."""

    def load_config(self: Any, config_path: str) -> Any:
        if (self.scheme(), self.path) not in _OWN:
            return load(self, config_path)
        key = self.scheme(), self.path, self.provider, config_path
        if key not in _files:
            with mock.patch.object(_utils, "get_yaml_loader", return_value=_Loader):
                _files[key] = pickle.dumps(load(self, config_path))
        return pickle.loads(_files[key])

    return load_config


def is_own(repo: Any) -> bool:
    """Return whether a repository has no other sources than conf/ and Hydra."""
    return [(source.scheme(), source.path) for source in repo.get_sources()] == _OWN


def list_defaults_once(
    repo: Any, config_name: str | None, overrides_list: list[Any], **more: Any
) -> Any:
    """List the files that words choose. Words that set values alone do not change the list."""
    words = [word for word in overrides_list if not word.is_sweep_override()]
    values = [
        w for w in words if isinstance(w.value(), dict) or not repo.group_exists(w.key_or_group)
    ]
    choices = [word.input_line for word in words if word not in values]
    key = (config_name, *choices, str(sorted(more.items())))
    if not is_own(repo) or READS_MORE.search(" ".join(choices)):
        return _list_defaults(repo, config_name, overrides_list, **more)
    if key not in _defaults:
        _defaults[key] = _list_defaults(repo, config_name, overrides_list, **more)
    return dataclasses.replace(_defaults[key], config_overrides=values)


def merge_files_once(self: ConfigLoaderImpl, defaults: list[Any], repo: Any) -> Any:
    """Merge the files of a list."""
    if not is_own(repo):
        return _merge_files(self, defaults=defaults, repo=repo)
    key = name_files(defaults)
    if key not in _composed:
        _composed[key] = pickle.dumps(merge_after_hydra(self, defaults, repo))
    return pickle.loads(_composed[key])


def merge_after_hydra(self: ConfigLoaderImpl, defaults: list[Any], repo: Any) -> Any:
    """Merge the files of a list. Hydra's own come first, are mostly the same, and take half of the time."""
    hydra = list(itertools.takewhile(lambda file: file.config_path.startswith("hydra/"), defaults))
    key = name_files(hydra)
    if key not in _composed:
        _composed[key] = pickle.dumps(_merge_files(self, defaults=hydra, repo=repo))
    begun = ConfigResult("", "", pickle.loads(_composed[key]), {})
    first, load = object(), self._load_single_config

    def load_single(default: Any, repo: Any) -> Any:
        return begun if default is first else load(default=default, repo=repo)

    with mock.patch.object(self, "_load_single_config", load_single):
        return _merge_files(self, defaults=[first, *defaults[len(hydra) :]], repo=repo)


def name_files(defaults: list[Any]) -> tuple[str, ...]:
    """Return a name of the merged files of a list."""
    return ("files", *(repr(dataclasses.astuple(file)) for file in defaults))


def store_node(self: ConfigStore, *args: Any, **more: Any) -> None:
    """Store a node, such as an experiment. Compositions before it are not used any more."""
    _composed.clear()
    _defaults.clear()
    _store(self, *args, **more)


def compose_once(
    self: ConfigLoaderImpl, config_name: str | None, overrides: list[str], **more: Any
) -> Any:
    """Compose a configuration, or copy that of the same words, search path and working directory.

    `hydra.mode`, which Hydra adds to the words of a command, and the name of the application are written into the copy.
    `from_shell` changes messages of errors alone, which are not copied.
    """
    path = [entry.path for entry in self.config_search_path.get_path()]
    modes = [word for word in overrides if re.fullmatch(r"hydra\.mode=(RUN|MULTIRUN)", word)]
    words = [word for word in overrides if word not in modes]
    is_own = path == ["pkg://hydra.conf", str(conf_dir()), "structured://"]
    if not is_own or len(modes) > 1 or READS_MORE.search(" ".join(words)):
        return compose_by_hydra(self, config_name, overrides, **more)
    options = {name: value for name, value in more.items() if name != "from_shell"}
    key = (config_name, *words, str(sorted(options.items())), version.getbase(), os.getcwd())
    if key not in _composed:
        _composed[key] = pickle.dumps(compose_by_hydra(self, config_name, words, **more))
    copied = pickle.loads(_composed[key])
    if "hydra" in copied:
        copied.hydra.job.name = JobRuntime().get("name")
    if modes:
        copied.hydra.mode = RunMode[modes[0].partition("=")[2]]
        copied.hydra.overrides.hydra = modes
    return copied
