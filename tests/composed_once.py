"""Compositions by Hydra, each made once in a process: tests compose the same words a dozen times, and each takes 0.1 s.

Files of YAML are read by the parser in C, which is six times as fast, and those that it refuses once more by that in Python,
whose messages users see. Files of conf/ do not change during a test. Words that read more than these files, and those about Hydra itself, are composed
each time, and processes that a test starts compose as users do.
"""

import contextlib
import io
import os
import pickle
import re
from typing import Any
from unittest import mock

import yaml
from hydra import version
from hydra._internal.config_loader_impl import ConfigLoaderImpl
from hydra.core.config_store import ConfigStore
from hydra.core.utils import JobRuntime
from hydra.types import RunMode
from omegaconf import _utils

from pfbench.job.config import register_experiments
from pfbench.results.paper_block import conf_dir

READS_MORE = re.compile(r"\$|hydra")

_SafeLoader = yaml.SafeLoader
_Loader = _utils.get_yaml_loader()  # a subclass of that in Python
with mock.patch.object(yaml, "SafeLoader", getattr(yaml, "CSafeLoader", yaml.SafeLoader)):
    _FastLoader = _utils.get_yaml_loader()  # and of that in C
compose_by_hydra = ConfigLoaderImpl._load_configuration_impl
_store = ConfigStore.store
_composed: dict[Any, bytes] = {}  # pickled: loading takes a quarter of the time of a deep copy


class TwoParsers:
    """A loader for `yaml.load`: the parser in C, and that in Python for what it refuses."""

    fast, slow = _FastLoader, _Loader

    def __init__(self, stream: Any) -> None:
        self.text = stream if isinstance(stream, str | bytes) else stream.read()
        self.name = getattr(stream, "name", None)

    def get_single_data(self) -> Any:
        """Return the content of the only document."""
        with contextlib.suppress(yaml.YAMLError):
            return self.fast(self.text).get_single_data()
        again: Any = self.text
        if self.name is not None:
            again = io.StringIO(self.text)
            again.name = self.name
        return self.slow(again).get_single_data()

    def dispose(self) -> None:
        """Nothing is open."""


class TwoSafeParsers(TwoParsers):
    """The same for `yaml.safe_load`."""

    fast, slow = getattr(yaml, "CSafeLoader", _SafeLoader), _SafeLoader


def install() -> None:
    """Make Hydra return copies of what it has composed before, and YAML be read by the parser in C."""
    register_experiments()
    _utils.get_yaml_loader = lambda: TwoParsers
    yaml.safe_load = lambda stream: yaml.load(stream, Loader=TwoSafeParsers)  # type: ignore[arg-type]
    ConfigLoaderImpl._load_configuration_impl = compose_once  # type: ignore[method-assign,assignment]
    ConfigStore.store = store_node  # type: ignore[method-assign]


def store_node(self: ConfigStore, *args: Any, **more: Any) -> None:
    """Store a node, such as an experiment. Compositions before it are not used any more."""
    _composed.clear()
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
        composed = compose_by_hydra(self, config_name, words, **more)
        _composed[key] = pickle.dumps(composed, pickle.HIGHEST_PROTOCOL)
    copied = pickle.loads(_composed[key])
    if "hydra" in copied:
        copied.hydra.job.name = JobRuntime().get("name")
    if modes:
        copied.hydra.mode = RunMode[modes[0].partition("=")[2]]
        copied.hydra.overrides.hydra = modes
    return copied
