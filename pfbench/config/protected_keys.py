"""Keys that a file of a configuration may not set: folders that pfbench writes, and Hydra's own settings.

A scenario, an experiment or another file may belong to a stranger. Folders, launchers, logging and
callbacks are the user's: they have the values of `conf/config.yaml` unless the command line changes them.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from pfbench.config.folders import conf_dir
from pfbench.config.trust import UntrustedConfigError, check_study

# keys with the only values that files may give them
FOLDER_KEYS = ("results_dir", "reports_dir", "episode_cache_dir")
OTHER_KEYS: Mapping[str, tuple[Any, ...]] = {
    "scenario.cache_dir": (None, "${episode_cache_dir}"),
    "train.checkpoint_path": (None,),
    "trust": (None,),
    "overwrite": (None, False),
    "memory_limit_gib": (None,),
}
HYDRA_SECTIONS = (
    "run", "sweep", "launcher", "sweeper", "job_logging", "hydra_logging", "callbacks",
    "output_subdir", "searchpath", "job.chdir", "job.env_set", "job.env_copy",
)  # fmt: skip
PLUGINS = ("hydra._internal.core_plugins.", "hydra_plugins.")
LOGGING = (
    "logging.StreamHandler", "logging.FileHandler", "logging.NullHandler", "logging.Formatter",
    "colorlog.ColoredFormatter",
)  # fmt: skip


def check_protected_keys(
    composed: Any, words: Sequence[str], compose_reference: Callable[[list[str]], Any]
) -> None:
    """Check that no file set a protected key.

    Args:
        composed: Composed configuration with its node `hydra`, not resolved.
        words: Overrides of the command line. A protected key in them is the user's choice.
        compose_reference: Composes some overrides, for the settings that these alone give.

    Raises:
        UntrustedConfigError: If a file set a protected key, or the study has an invalid name.
    """
    given_keys = {word.lstrip("+~").partition("=")[0] for word in words}
    defaults = _default_folders()
    allowed = {key: (defaults[key],) for key in FOLDER_KEYS} | dict(OTHER_KEYS)
    values = to_plain(composed)
    for key, choices in allowed.items():
        value = _select(values, key)
        is_allowed = value in choices or (key == "train.checkpoint_path" and _is_in_results(value))
        if key not in given_keys and not is_allowed:
            raise UntrustedConfigError(
                f"{key} must be set on the command line, got {value!r} from a file. "
                f"Add {key}=... to the command, or remove the key from the file."
            )
    _check_swept_keys(values, given_keys, allowed)
    for key, value in _list_nested(values, "cache_dir"):
        if key not in given_keys and value not in OTHER_KEYS["scenario.cache_dir"]:
            raise UntrustedConfigError(
                f"{key} must be null or that of the command line, got {value!r} from a file. "
                f"Add {key}=... to the command, or remove the key from the file."
            )
    check_study(values.get("study"))  # not resolved: Hydra would resolve it to another text
    for group, name in (_select(values, "hydra.runtime.choices") or {}).items():
        if isinstance(name, str) and (name.startswith("/") or ".." in name.split("/")):
            raise UntrustedConfigError(
                f"{group} must be the name of a file in its group, got {name!r}. Use its name."
            )
    _check_hydra(values, words, compose_reference)


def _list_nested(node: Any, name: str, path: str = "") -> Iterator[tuple[str, Any]]:
    """Yield the values of a key at any depth, with their full keys."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            full_key = f"{path}.{key}" if path else str(key)
            if key == name:
                yield full_key, value
            yield from _list_nested(value, name, full_key)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from _list_nested(value, name, f"{path}[{index}]")


def _is_in_results(value: Any) -> bool:
    """Return whether a path is below the folder of results, whatever the value of that key."""
    path = re.fullmatch(r"\$\{results_dir\}/([\w./-]+)", str(value))
    return path is not None and ".." not in path[1].split("/")


def read_file(path: Path) -> dict[str, Any]:
    """Read a file of a configuration without resolving it."""
    from omegaconf import OmegaConf

    return to_plain(OmegaConf.load(path))


def to_plain(tree: Any) -> dict[str, Any]:
    """Return an unresolved configuration as plain dictionaries and lists."""
    from omegaconf import OmegaConf

    content = OmegaConf.to_container(tree, resolve=False)
    assert isinstance(content, dict)
    return {str(key): value for key, value in content.items()}


def _select(values: Mapping[str, Any], key: str) -> Any:
    """Return the value of a dotted key, or None."""
    node: Any = values
    for name in key.split("."):
        node = node.get(name) if isinstance(node, Mapping) else None
    return node


def _check_swept_keys(
    values: Mapping[str, Any], given_keys: set[str], protected: Mapping[str, Any]
) -> None:
    """Check that the sweep of an experiment does not set a protected key."""
    params = _select(values, "hydra.sweeper.params") or {}
    for name in params:
        key = str(name).lstrip("+~").partition("@")[0]
        is_protected = key in protected or key.split(".")[0].split("/")[0] == "hydra"
        if is_protected and key not in given_keys:
            raise UntrustedConfigError(
                f"hydra.sweeper.params must not set {key}, got {params[name]!r}. "
                f"Give {key} on the command line."
            )


def _check_hydra(
    values: Mapping[str, Any], words: Sequence[str], compose_reference: Callable[[list[str]], Any]
) -> None:
    """Check that Hydra's settings are those of pfbench and of the command line."""
    actual = _hydra_sections(values)
    hydra_words = [word for word in words if re.match(r"[+~]*hydra[/.@=]", word)]
    if actual == _default_sections() | _read_search_path(hydra_words):
        return
    expected = _hydra_sections(to_plain(compose_reference(hydra_words)))
    for name in HYDRA_SECTIONS:
        if actual[name] != expected[name]:
            raise UntrustedConfigError(
                f"hydra.{name} must be set on the command line, got {actual[name]!r} from a file. "
                "Remove it from the file."
            )
    for key, name in _list_factories(actual):
        if not (name in LOGGING or name.startswith(PLUGINS)):
            raise UntrustedConfigError(
                f"hydra.{key} must name a class of Hydra, of its plugins or of logging, "
                f"got {name!r}. Remove it."
            )


def _read_search_path(hydra_words: Sequence[str]) -> dict[str, Any]:
    """Return the search path that the command line sets; empty if it sets none."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    parsed = OverridesParser.create().parse_overrides(list(hydra_words))
    paths = [word.value() for word in parsed if word.key_or_group == "hydra.searchpath"]
    return {"searchpath": paths[0]} if paths else {}


def _hydra_sections(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the settings of Hydra that can run code or write files, without the swept values."""
    sections = {name: _select(values, f"hydra.{name}") for name in HYDRA_SECTIONS}
    sweeper = sections["sweeper"] or {}
    return sections | {"sweeper": {key: sweeper[key] for key in sweeper if key != "params"}}


@cache
def _default_folders() -> dict[str, Any]:
    """Return the folders that pfbench's own main file gives."""
    defaults = read_file(conf_dir() / "config.yaml")
    return {key: defaults.get(key) for key in FOLDER_KEYS}


@cache
def _default_sections() -> dict[str, Any]:
    """Return the settings of Hydra that pfbench's own files give."""
    hydra = read_file(conf_dir() / "config.yaml")["hydra"]
    logging = {
        group: read_file(conf_dir() / "hydra" / group / "pfbench.yaml")
        for group in ("job_logging", "hydra_logging")
    }
    basic = "hydra._internal.core_plugins.basic_"
    return {
        "run": hydra["run"],
        "sweep": hydra["sweep"],
        "output_subdir": hydra["output_subdir"],
        "launcher": {"_target_": f"{basic}launcher.BasicLauncher"},
        "sweeper": {"_target_": f"{basic}sweeper.BasicSweeper", "max_batch_size": None},
        **logging,
        "callbacks": {},
        "searchpath": [],
        "job.chdir": None,
        "job.env_set": {},
        "job.env_copy": [],
    }


def _list_factories(node: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Yield the names that Hydra or the logging module would import, with their keys."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            path_of_value = f"{path}.{key}" if path else str(key)
            if key in ("_target_", "class", "()") or (isinstance(value, str) and "cfg://" in value):
                yield path_of_value, str(value)
            elif isinstance(value, str) and value.startswith("ext://"):
                if value not in ("ext://sys.stdout", "ext://sys.stderr"):
                    yield path_of_value, value
            else:
                yield from _list_factories(value, path_of_value)
    elif isinstance(node, list):
        for index, value in enumerate(node):
            yield from _list_factories(value, f"{path}[{index}]")
