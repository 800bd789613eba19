"""Scan of the user's configuration files for what only the command line may do.

Hydra composes a configuration for each job, and a file may choose other files by the values of
that job. A check of one composition therefore cannot speak for all. The files themselves can: none
may place anything in the node `hydra`, or choose a file by an interpolation.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.config.trust import UntrustedConfigError

_PACKAGE = re.compile(r"^#\s*@package\s+(\S+)", re.MULTILINE)
_INNERMOST = re.compile(r"\$\{([^{}]*)\}")
_OPENING = re.compile(r"\$\{\s*([^\s{}:]*)\s*:")
_RESOLVERS = (
    "oc.select",
    "oc.dict.keys",
    "oc.dict.values",
)  # others read the environment or compute
_MOST_NODES = 100_000  # of a file, with its aliases expanded
_SEARCH_PATH = re.compile(r"[+~]*hydra\.searchpath=\[?(.*?)\]?$")


def check_files(words: Sequence[str]) -> None:
    """Check all files in the folders that the command line adds to the search path.

    Args:
        words: Overrides. Files of installed packages (`pkg://`) are not checked.

    Raises:
        UntrustedConfigError: If a file sets a node of Hydra, a default has an interpolation, a value
            reads the environment, or aliases make the file huge.
        ValueError: If a folder does not exist, or a file that the words choose is not keys and
            values in UTF-8.
    """
    for word in words:
        match = _SEARCH_PATH.match(word)
        for entry in match[1].split(",") if match else ():
            folder = entry.strip(" '\"")
            if folder and "://" not in folder.removeprefix("file://"):  # Hydra takes a bare path
                _check_folder(Path(folder.removeprefix("file://")), words)


def _check_folder(folder: Path, words: Sequence[str]) -> None:
    """Check the files of a folder, which Hydra ignores if it does not exist."""
    if "${" not in f"{folder}" and not folder.is_dir():
        raise ValueError(
            f"hydra.searchpath must have existing folders, got {folder}. Use file:// and a full path."
        )
    for path in sorted(folder.rglob("*.yaml")):
        _check_file(path)
        if f"{path.parent.name}={path.stem}" in words:
            _check_form(path)


def _check_file(path: Path) -> None:
    """Check one file."""
    import yaml
    from omegaconf import OmegaConf

    text = path.read_text(errors="replace")
    package = _PACKAGE.search(text)
    is_hydra_group = path.parent.parent.name == "hydra"
    if package and ("hydra" in package[1] or is_hydra_group):
        raise UntrustedConfigError(
            f"{path}: the package of a file must not be in hydra, got {package[1]}. Remove the line."
        )
    _check_values(path, text)
    try:
        content = OmegaConf.to_container(OmegaConf.load(path), resolve=False)
    except (yaml.YAMLError, OSError, ValueError):  # Hydra reports it if the file is chosen
        return
    if not isinstance(content, Mapping):
        return
    for text_of_default in _list_texts(content.get("defaults")):
        is_placed = "@" in text_of_default and "hydra" in text_of_default.partition("@")[2]
        if is_placed or "${" in text_of_default or ".." in text_of_default:
            raise UntrustedConfigError(
                f"{path}: defaults must name files of a group directly and outside hydra, "
                f"got {text_of_default!r}. Choose the file on the command line."
            )
    _check_hydra_node(path, content.get("hydra"))


def _check_form(path: Path) -> None:
    """Check that a chosen file has keys and values, which Hydra only finds out by what is missing."""
    import yaml

    try:
        root = yaml.compose(path.read_text(encoding="utf-8"), Loader=yaml.SafeLoader)
    except UnicodeDecodeError as error:
        raise ValueError(
            f"{path} must be text in UTF-8, got the byte 0x{error.object[error.start]:02x}. Save it as UTF-8."
        ) from error
    except yaml.YAMLError:  # Hydra reports it with its line
        return
    if not isinstance(root, yaml.MappingNode):
        kind = "an empty file" if root is None else f"a {root.id}"
        raise ValueError(
            f"{path} must be keys and values, got {kind}. Write key: value on each line, or choose "
            f"another one: pfbench list {path.parent.name}"
        )


def _check_values(path: Path, text: str) -> None:
    """Check the texts of a file and its size, before it is loaded."""
    import yaml

    try:
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        nodes = list(_walk_nodes(root, {}, [0]))
    except (yaml.YAMLError, RecursionError):  # Hydra reports it if the file is chosen
        return
    except OverflowError as error:
        raise UntrustedConfigError(
            f"{path} must have at most {_MOST_NODES} values, got more by aliases. Write them out."
        ) from error
    for value in nodes:
        if resolver := _find_resolver(value):
            raise UntrustedConfigError(
                f"{path}: interpolations must name keys, got the resolver {resolver} in {value!r:.80}. "
                "Give the value on the command line."
            )


def _walk_nodes(node: Any, sizes: dict[int, int], total: list[int]) -> Iterator[str]:
    """Yield the texts of a node once; raise OverflowError if its aliases expand to too many nodes."""
    before = total[0]
    if id(node) in sizes:
        total[0] += sizes[id(node)]
    else:
        sizes[id(node)] = _MOST_NODES  # of an alias to a node that contains it
        total[0] += 1
        children = getattr(node, "value", None)
        if isinstance(children, str):
            yield children
        for child in children if isinstance(children, list) else ():
            for entry in child if isinstance(child, tuple) else (child,):
                yield from _walk_nodes(entry, sizes, total)
        sizes[id(node)] = total[0] - before
    if total[0] > _MOST_NODES:
        raise OverflowError


def _find_resolver(text: str) -> str:
    """Return a resolver of a text that a file may not use, or an empty text."""
    while match := _INNERMOST.search(text):
        name, colon, _ = match[1].partition(":")
        if colon and name.strip() not in _RESOLVERS:
            return name.strip()
        text = f"{text[: match.start()]}?{text[match.end() :]}"
    nested = _OPENING.search(text)  # with braces in its arguments
    return nested[1] if nested else ""


def _check_hydra_node(path: Path, node: Any) -> None:
    """Check that the node `hydra` of a file has the values of a sweep only."""
    if node is None:
        return
    sweeper = node.get("sweeper") if isinstance(node, Mapping) else None
    is_sweep = (
        isinstance(sweeper, Mapping) and set(node) == {"sweeper"} and set(sweeper) == {"params"}
    )
    if not is_sweep:
        raise UntrustedConfigError(
            f"{path}: hydra must have sweeper.params only, got {node!r}. Set the settings of hydra "
            "on the command line."
        )
    for name, value in ((sweeper or {}).get("params") or {}).items():
        if "@" in str(name) or "${" in str(value):
            raise UntrustedConfigError(
                f"{path}: hydra.sweeper.params must be plain keys and values, got {name}={value}. "
                "Give it on the command line."
            )


def _list_texts(node: Any) -> Iterator[str]:
    """Yield the keys and values of a defaults list."""
    if isinstance(node, Mapping):
        for key, value in node.items():
            yield str(key)
            yield from _list_texts(value)
    elif isinstance(node, list):
        for item in node:
            yield from _list_texts(item)
    elif node is not None:
        yield str(node)
