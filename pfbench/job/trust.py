"""Trust: what a configuration may name, and which keys a file may not set.

A scenario or an experiment may come from a stranger. Before anything is built from a configuration,
all of it is checked: `_target_` may name public classes of pfbench and names of packages that the
user trusts, and folders and Hydra's own settings come from the command line or from pfbench.
"""

from __future__ import annotations

import importlib.util
import os
import re
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import cache
from importlib import import_module
from importlib.machinery import ModuleSpec, PathFinder
from typing import Any

from pfbench.files import limits
from pfbench.files.source_digest import BROAD, PACKAGE, find_module, hash_folder, hash_modules
from pfbench.results.paper_block import conf_dir, experiments_dir

ENVIRONMENT = "PFBENCH_TRUST"  # trusted packages, for the processes of a sweep
FOLDERS = ("nav", "model", "noise", "scenario", "filter", "learn")
# public functions that build an object; the other ones run filters, read logs or write files
BUILDERS = {
    "nav": ("accelerate", "climb", "cruise", "turn"),
    "model": ("linear_walk", "local_level"),
}
HARMLESS = ("pyro.distributions", "torch.distributions", "torch.nn")  # parts of them
HYDRA_KEYS = ("_target_", "_args_", "_partial_", "_convert_", "_recursive_")
NAME = re.compile(r"[A-Za-z]\w*(\.[A-Za-z]\w*)+")
STUDY = re.compile(r"[A-Za-z0-9_][\w.+-]{0,99}", re.ASCII)
WRITTEN = os.path.join(
    ".cache", "own"
)  # in the current folder: modules of classes of a script or a notebook
MODULE = re.compile(
    r"own_\w+_[0-9a-f]{10}"
)  # names of these modules, which end in a digest of the text
_local: set[str] = set()  # trusted packages, which may lie in the current folder


class UntrustedConfigError(ValueError):
    """A configuration names what it may not name, or sets what it may not set."""


def require_allowed(ok: object, key: object, must: str, got: object, remedy: str) -> None:
    """Raise UntrustedConfigError unless a requirement holds, in the form of `require`."""
    if not ok:
        raise UntrustedConfigError(f"{key} must {must}, got {got}. {remedy}")


def split_trust(words: Sequence[str]) -> tuple[list[str], tuple[str, ...]]:
    """Take the key `trust` out of overrides.

    Returns the other overrides, and the trusted packages with those of the environment variable.
    """
    is_trust = [word.lstrip("+").startswith("trust=") for word in words]
    others = [word for word, is_key in zip(words, is_trust, strict=True) if not is_key]
    texts = [word.partition("=")[2] for word, is_key in zip(words, is_trust, strict=True) if is_key]
    return others, _parse_packages([*texts, os.environ.get(ENVIRONMENT, "")])


class _CurrentFolder:
    """Finder of trusted packages in the current folder and in `WRITTEN`, where nothing else is imported from."""

    @staticmethod
    def find_spec(name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        """Find a top-level package that the user trusts, or a module of a script that a trusted one imports."""
        folders = [os.getcwd(), os.path.abspath(WRITTEN)]
        if MODULE.fullmatch(name):
            return PathFinder.find_spec(name, folders[1:])
        is_trusted = path is None and name in {full.partition(".")[0] for full in _local}
        return PathFinder.find_spec(name, folders) if is_trusted else None


def trusted_packages() -> tuple[str, ...]:
    """Return the packages that the environment variable names."""
    return _parse_packages([os.environ.get(ENVIRONMENT, "")])


@contextmanager
def trusting(packages: Sequence[str]) -> Iterator[None]:
    """Trust packages besides those of the environment variable while stored jobs are computed."""
    before = os.environ.get(ENVIRONMENT)
    os.environ[ENVIRONMENT] = ",".join(filter(None, [before or "", *packages]))
    try:
        trusted_packages()
        yield
    finally:
        os.environ.pop(ENVIRONMENT)
        if before is not None:
            os.environ[ENVIRONMENT] = before


def _parse_packages(texts: Sequence[str]) -> tuple[str, ...]:
    """Parse lists of packages such as `[mylab,other.filters]`."""
    names = [name.strip(" '\"") for text in texts for name in text.strip(" []").split(",")]
    packages = tuple(dict.fromkeys(name for name in names if name))
    for name in packages:
        is_name = re.fullmatch(r"[A-Za-z_]\w*(\.[A-Za-z_]\w*)*", name)
        require_allowed(
            is_name, "trust", "be a list of package names", f"{name!r}", "Use trust=[mylab]."
        )
        is_broad = name.split(".")[0] in (*BROAD, "pfbench", *sys.stdlib_module_names)
        require_allowed(
            not is_broad or name in HARMLESS,
            "trust",
            "not be a general library",
            f"{name!r}",
            "It can run or delete files. Name the package that defines your classes.",
        )
    _local.update(packages)
    if packages and _CurrentFolder not in sys.meta_path:
        sys.meta_path.append(_CurrentFolder)
    return packages


def check_configuration(values: Any, trusted: Sequence[str] = (), path: str = "") -> None:
    """Check all names that instantiation would import, and that nothing is left to resolve."""
    for key, node in walk_nodes(values, path):
        if isinstance(node, str):
            is_resolved = "${" not in node
            require_allowed(
                is_resolved, key, "be resolved", repr(node), "Remove the escaped interpolation."
            )
        elif isinstance(node, Mapping):
            _check_node(key, node, trusted)


def check_study(name: Any) -> str:
    """Check the name of a study, which is also the name of its folder.

    Returns the name as a text.
    """
    name = str(name) if isinstance(name, int | float) else name
    require_allowed(
        isinstance(name, str) and STUDY.fullmatch(name) and set(name) != {"."},
        "study",
        "be a name of letters, digits, '_', '-', '+' and '.'",
        repr(name),
        "Use results_dir=... and reports_dir=... for other folders.",
    )
    return str(name)


def check_places(values: Mapping[str, Any]) -> None:
    """Check the folders of results and reports: Hydra makes them before a job begins."""
    for key in ("results_dir", "reports_dir"):
        value = values.get(key, key)
        require_allowed(
            isinstance(value, str) and value,
            key,
            "be a folder",
            repr(value),
            f"Set {key}={key.partition('_')[0]}, or {key}=./5 for a name that YAML reads as a number.",
        )


def walk_nodes(node: Any, path: str = "", depth: int = 0) -> Iterator[tuple[str, Any]]:
    """Yield all nodes of a configuration with their keys, each before those inside of it."""
    require_allowed(
        depth <= limits.CONFIG_DEPTH,
        path,
        f"have at most {limits.CONFIG_DEPTH} levels",
        "more",
        "Simplify the configuration.",
    )
    yield path, node
    if isinstance(node, Mapping):
        for key, value in node.items():
            yield from walk_nodes(value, f"{path}.{key}" if path else str(key), depth + 1)
    elif isinstance(node, list | tuple):
        for index, value in enumerate(node):
            yield from walk_nodes(value, f"{path}[{index}]", depth + 1)


def _check_node(key: str, node: Mapping[Any, Any], trusted: Sequence[str]) -> None:
    """Check one dictionary of a configuration."""
    special = (name for name in node if isinstance(name, str) and re.fullmatch(r"_.*_", name))
    unknown = [name for name in special if name not in HYDRA_KEYS]
    if unknown:
        raise UntrustedConfigError(
            f"{key} must not have the key {unknown[0]}. Keys of instantiation are "
            f"{', '.join(HYDRA_KEYS)}."
        )
    if "_target_" not in node:
        return
    target = node["_target_"]
    has_keys = "_args_" not in node or not str(target).startswith("pfbench.")
    require_allowed(
        has_keys, key, f"name the arguments of {target}", "_args_", "Write them as keys."
    )
    remedy = _find_remedy(target, trusted)
    require_allowed(
        not remedy, f"{key}._target_".lstrip("."), "be a public class of pfbench or of a trusted package", repr(target), remedy
    )  # fmt: skip


def _find_remedy(target: Any, trusted: Sequence[str]) -> str:
    """Return what to do about a name that instantiation must not import; empty for one that it may."""
    if not isinstance(target, str) or not NAME.fullmatch(target):
        return "Write it as pfbench.FOLDER.Class."
    if target.startswith("pfbench."):
        public = "See pfbench.FOLDER.__all__ for the names."
        return "" if _is_public(target) else _suggest_public(target) + public
    if any(target.startswith(f"{package}.") for package in trusted):
        return (
            ""
            if _is_defined_in(target, trusted)
            else "The package imports this name from elsewhere."
        )
    package = target.split(".")[0]
    if package in BROAD or package in sys.stdlib_module_names:
        return "Nothing was run. Remove this node."
    return f"Nothing was run. If you trust this package, add trust=[{package}] on the command line."


@cache
def _is_public(target: str) -> bool:
    """Return whether a name of pfbench is a class or a builder that a folder exports.

    Classes are recognised by their capital, since the check must not import torch.
    """
    parts = target.split(".")
    if len(parts) != 3 or parts[1] not in FOLDERS:
        return False
    folder, name = parts[1:]
    door = import_module(f"pfbench.{folder}")
    return name in door.__all__ and (name[0].isupper() or name in BUILDERS.get(folder, ()))


def _suggest_public(target: str) -> str:
    """Return a sentence with the public names that are similar to a name, or an empty text."""
    names = [
        f"pfbench.{folder}.{name}"
        for folder in FOLDERS
        for name in import_module(f"pfbench.{folder}").__all__
    ]
    similar = [name for name in get_close_matches(target, names, 1, 0.8) if _is_public(name)]
    return f"Similar: {', '.join(similar)}. " if similar else ""


def _is_defined_in(target: str, trusted: Sequence[str]) -> bool:
    """Return whether a name is defined by a trusted package, not imported there from another one."""
    parts = target.split(".")
    value: Any = None
    require_allowed(
        importlib.util.find_spec(parts[0]) is not None, target, "be importable", f"the package {parts[0]}, which is not installed",
        "Install it, or set PYTHONPATH to the folder that contains it.",
    )  # fmt: skip
    for count in range(len(parts) - 1, 0, -1):
        name = ".".join(parts[:count])
        if not any(name == package or name.startswith(f"{package}.") for package in trusted):
            return False
        try:
            value = import_module(name)
        except ModuleNotFoundError as error:
            if error.name is None or not (name == error.name or name.startswith(f"{error.name}.")):
                raise
            continue
        for attribute in parts[count:]:
            value = getattr(value, attribute)
        break
    module = str(getattr(value, "__module__", ""))
    return any(module == package or module.startswith(f"{package}.") for package in trusted)


# --------------------------------------------------------------------------------------------------
# Source code of a user's classes and of pfbench, as part of the key and of the record of a job.
#
# The code of pfbench is not part of a key: a report refuses results of several builds.


def hash_user_code(values: Any) -> dict[str, str]:
    """Compute digests of the source files that the classes of a configuration consist of.

    The files are those of the modules that `_target_` names, and of all modules that these import,
    directly or through others. Installed libraries and pfbench are left out.
    """
    return hash_modules(find_module(target) for target in sorted(set(list_user_targets(values))))


@cache
def hash_package() -> str:
    """Compute a digest of the sources of the installed pfbench.

    Configuration files do not count: what a job takes from them is part of its key.
    """
    return hash_folder(
        PACKAGE, {str(conf_dir()), str(experiments_dir())}
    )  # inside of it in a wheel


def list_user_packages(values: Any, trusted: Sequence[str]) -> list[str]:
    """List the trusted packages that define a class of a configuration."""
    targets = list(list_user_targets(values))
    return [name for name in trusted if any(t.startswith(f"{name}.") for t in targets)]


def list_user_targets(node: Any) -> Iterator[str]:
    """Yield the names of classes that are defined by neither pfbench nor a general library."""
    for _, value in walk_nodes(node):
        target = value.get("_target_") if isinstance(value, Mapping) else None
        if isinstance(target, str) and target.split(".")[0] not in ("pfbench", *BROAD):
            yield target
