"""Compositions by Hydra, each made once in a process: tests compose the same words a dozen times, and each takes 0.1 s.

Files of conf/ do not change during a test. Words that read more than these files and the stored nodes are composed each
time, and processes that a test starts compose as users do.
"""

from __future__ import annotations

import copy
import os
import re
from typing import Any
from unittest import mock

import yaml
from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_store import ConfigStore
from hydra.core.utils import JobRuntime
from omegaconf import _utils

from pfbench.config.folders import conf_dir

READS_MORE = re.compile(r"\$|searchpath|env_|config_dir")

with mock.patch.object(yaml, "SafeLoader", getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    _Loader = _utils.get_yaml_loader()  # a subclass, here of the parser in C, which is faster
_compose = ConfigLoaderImpl._load_configuration_impl
_store = ConfigStore.store
_composed: dict[Any, Any] = {}


def install() -> None:
    """Make Hydra return copies of what it has composed before."""
    ConfigLoaderImpl._load_configuration_impl = compose_once  # type: ignore[method-assign,assignment]
    ConfigStore.store = store_node  # type: ignore[method-assign]


def store_node(self: ConfigStore, *args: Any, **more: Any) -> None:
    """Store a node, such as an experiment. Compositions before it are not used any more."""
    _composed.clear()
    _store(self, *args, **more)


def compose_once(self: ConfigLoaderImpl, *args: Any, **more: Any) -> Any:
    """Compose a configuration, or copy the one of the same words, search path and working directory."""
    path = [entry.path for entry in self.config_search_path.get_path()]
    words = str((args, sorted(more.items())))
    if path != ["pkg://hydra.conf", str(conf_dir()), "structured://"] or READS_MORE.search(words):
        return _compose(self, *args, **more)
    key = (words, version.getbase(), JobRuntime().get("name"), os.getcwd())
    if key not in _composed:
        with mock.patch.object(_utils, "get_yaml_loader", return_value=_Loader):
            _composed[key] = _compose(self, *args, **more)
    return copy.deepcopy(_composed[key])
