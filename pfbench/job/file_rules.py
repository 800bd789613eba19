"""Rules of what a file of a search path may set, for each file that Hydra loads at the place where Hydra puts it.

A scenario, an experiment or another file may belong to a stranger. It may describe a world, a filter or a
sweep. Folders, data of the user, the environment and Hydra's own settings are the user's.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from itertools import islice
from pathlib import Path
from typing import Any

from pfbench.files import limits
from pfbench.job.trust import UntrustedConfigError
from pfbench.results.paper_block import conf_dir

FOLDER_KEYS = ("results_dir", "reports_dir", "episode_cache_dir")
_WRITTEN = (*FOLDER_KEYS, "cache_dir", "checkpoint_path")

_READ = (
    "data",
    "root",
    "folder",
    "checkpoint",
)  # keys of the user's data: at any depth, but `data`

_SETTINGS = ("trust", "overwrite", "memory_limit_gib", "hydra")

# what a file may give such keys: nothing, or what the command line gives
_REFERENCES = {
    "cache_dir": ("${episode_cache_dir}",),
    "root": ("${data.root}",),
    "checkpoint": ("${checkpoint}",),
}

_IN_RESULTS = re.compile(r"\$\{results_dir\}(?:/(?!\.\.?(?:/|$))[\w.-]+)+")

_RESOLVERS = (
    "",
    "oc.select",
    "oc.dict.keys",
)  # "" for none; others read the environment, compute or list values

_PATH = re.compile(r"^[/~\\]|^[A-Za-z]:[/\\]|(^|[/\\])\.\.([/\\]|$)")

_PLAIN_KEY = re.compile(r"[\w.\[\]@-]+")


def check_content(file: Path, values: Mapping[str, Any], *, is_own: bool) -> None:
    """Check the content of a file, in the package that Hydra gives it."""
    for path, value in _walk(values):
        key = path[-1]
        if path[0] == "hydra":
            _check_hydra_value(file, path, value, is_own)
        elif path[0] == "data" or key in _WRITTEN or key in _SETTINGS or key in _READ[1:]:
            _check_protected(file, path, value, is_own)
        if isinstance(key, str) and "${" in key:
            _refuse(file, path, "be a plain name", key, "Write the name itself.")
        if isinstance(value, str) and not is_own and _PATH.search(value):
            _refuse(file, path, "not be a path", value, _own_remedy(file))
        if isinstance(value, str) and "${" in value and not _is_reference(path, value):
            _check_interpolation(file, path, value, is_own)
    params = _find(values, "hydra", "sweeper", "params")
    if params is not None:
        _check_sweep(file, params, is_own)


def check_defaults(file: Path, defaults: Sequence[Any], *, is_own: bool) -> None:
    """Check the defaults list of a file as Hydra parses it. Only a file of the user's own chooses a launcher, which starts processes."""
    for entry in defaults:
        group, value = getattr(entry, "group", None), getattr(entry, "value", None)
        names = [group, getattr(entry, "path", None), entry.package]
        names += value if isinstance(value, list) else [value]
        texts = [name for name in names if isinstance(name, str)]
        is_launcher = (
            is_own
            and group is not None
            and group.strip("/") == "hydra/launcher"
            and value in launchers()
            and entry.package is None
        )
        in_hydra = any(re.split(r"[/.]", text.lstrip("/"))[0] == "hydra" for text in texts)
        leaves = any(".." in text or "${" in text for text in texts)
        if leaves or (in_hydra and not is_launcher):
            choice = "@".join(filter(None, [group or texts[0], entry.package]))
            raise UntrustedConfigError(
                f"{file}: defaults must name files of a group directly and outside hydra, got {choice}: {value}. Choose it on "
                "the command line. In a folder of your own (own://) they may choose a launcher: "
                f"{', '.join(launchers())}."
            )


def check_place(config_path: str, package: str | None) -> None:
    """Check that no file is placed in the node `hydra` but those of Hydra's own groups."""
    in_hydra = (package or "").partition(".")[0].partition("[")[0] == "hydra"
    if in_hydra and not config_path.lstrip("/").startswith("hydra/"):
        raise UntrustedConfigError(
            f"{config_path} must not be placed in hydra, got the package {package}. Remove it from the "
            "header or from the defaults list."
        )


def check_group(file: Path, config_path: str, *, is_own: bool) -> None:
    """Check that a file of a search path is none of Hydra's settings."""
    is_launcher = is_own and config_path.startswith("hydra/launcher/")
    if config_path.lstrip("./").startswith("hydra") and not is_launcher:
        raise UntrustedConfigError(
            f"{file} must not be a setting of hydra. Choose a launcher of pfbench on the command line "
            f"({', '.join(launchers())}), or write own:// before a folder of your own launchers."
        )


@cache
def launchers() -> tuple[str, ...]:
    """Return the names of the launchers of pfbench, and Hydra's own."""
    return "basic", *sorted(
        path.stem for path in (conf_dir() / "hydra" / "launcher").glob("*.yaml")
    )


def _walk(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[tuple[Any, ...], Any]]:
    """Yield all values below a node with their paths; a key with dots is a path, as where a reading sets it."""
    if isinstance(node, Mapping):
        entries: Iterator[tuple[Any, Any]] = iter(node.items())
    else:
        entries = enumerate(node) if isinstance(node, list) else iter(())
    for key, value in entries:
        is_path = isinstance(key, str) and "${" not in key
        below = (*path, *((is_path and re.findall(r"[^.\[\]]+", key)) or [key]))
        yield below, value
        yield from _walk(value, below)


def _find(node: Any, *path: str) -> Any:
    """Return the value of a path, None if there is none."""
    for key in path:
        node = node.get(key) if isinstance(node, Mapping) else None
    return node


def _check_hydra_value(file: Path, path: tuple[Any, ...], value: Any, is_own: bool) -> None:
    """Check that a value below `hydra` belongs to the values of a sweep."""
    allowed = [("hydra", "sweeper", "params")]
    if is_own:  # a launcher of the user, which the command line chooses
        allowed.append(("hydra", "launcher", *path[2:3]))
    is_between = isinstance(value, Mapping) and any(path == keys[: len(path)] for keys in allowed)
    if not is_between and path[:3] not in allowed:
        _refuse(
            file, path[:2], "not be set: hydra must have sweeper.params only", value,
            "Set the settings of hydra on the command line.",
        )  # fmt: skip


def _check_protected(file: Path, path: tuple[Any, ...], value: Any, is_own: bool) -> None:
    """Check a value of a key that only the command line may set."""
    key = path[-1]
    is_top = len(path) == 1
    if key in _SETTINGS and not is_top:
        return  # the same name elsewhere is none of them
    is_nothing = value is None or value == "???" or (key == "overwrite" and value is False)
    is_whole = isinstance(value, Mapping) and key in _READ  # its own keys are checked
    is_data = key in _READ or path[0] == "data"
    if is_nothing or is_whole or _is_reference(path, value) or (is_own and is_data):
        return
    remedy = _own_remedy(file) if is_data else ""
    name = _join(path)
    _refuse(
        file, path, "be set on the command line", value,
        f"Remove the key from the file, and add {name}=... to the command. {remedy}".rstrip(),
    )  # fmt: skip


def _is_reference(path: tuple[Any, ...], value: Any) -> bool:
    """Return whether a value refers to the same setting of the command line and to nothing else."""
    if path[-1] == "checkpoint_path":
        return bool(_IN_RESULTS.fullmatch(str(value)))
    return value in _REFERENCES.get(path[-1], ())


def _check_interpolation(file: Path, path: tuple[Any, ...], text: str, is_own: bool) -> None:
    """Check by OmegaConf's grammar that the interpolations of a text name keys."""
    from omegaconf import grammar_parser
    from omegaconf.errors import GrammarParseError

    if len(text) > limits.CONFIG_INTERPOLATED:
        _refuse(
            file, path, f"have at most {limits.CONFIG_INTERPOLATED} characters with an interpolation",
            len(text), "Give the value on the command line.",
        )  # fmt: skip
    try:
        tree = grammar_parser.parse(text)
    except GrammarParseError as error:
        _refuse(file, path, "be a valid interpolation", text, f"{error}".splitlines()[0])
    for resolver, key in _list_interpolations(tree):
        names_user = not is_own and {*_WRITTEN, *_READ, "hydra"} & set(re.findall(r"\w+", key))
        if resolver not in _RESOLVERS or not _PLAIN_KEY.fullmatch(key) or names_user:
            got = f"the resolver {resolver} in {text}" if resolver not in _RESOLVERS else text
            _refuse(
                file, path, "have interpolations of plain keys, and none of the user's folders",
                got, "Give the value on the command line.",
            )  # fmt: skip


def _list_interpolations(tree: Any) -> Iterator[tuple[str, str]]:
    """Yield resolver and key of each interpolation in a tree of OmegaConf's grammar.

    A nested one makes the key of the outer one no plain key, which is an error.
    """
    kind = type(tree).__name__
    if kind == "InterpolationResolverContext":
        arguments = tree.sequence()
        key = arguments.getText().split(",")[0] if arguments else ""
        yield tree.resolverName().getText(), key.strip()
    elif kind == "InterpolationNodeContext":
        yield "", tree.getText().removeprefix("${").removesuffix("}").strip()
    for child in getattr(tree, "children", None) or ():
        yield from _list_interpolations(child)


def _check_sweep(file: Path, params: Any, is_own: bool) -> None:
    """Check the sweep of an experiment as Hydra's parser of overrides reads it."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    if not isinstance(params, Mapping):
        return  # Hydra reports it
    jobs = 1
    for name, value in params.items():
        is_plain = isinstance(value, str | int | float | bool) or value is None
        if not is_plain or re.search(r"[@~]", str(name)) or "${" in f"{name}{value}":
            _refuse(
                file, ("hydra", "sweeper", "params"), "be plain keys and values",
                f"{name}={value}", "Give it on the command line.",
            )  # fmt: skip
        word = OverridesParser.create().parse_override(f"{name}={value}")
        values = list(islice(_list_swept(word.value()), limits.SWEPT_JOBS + 1))
        jobs *= max(1, len(values))
        if jobs > limits.SWEPT_JOBS:
            _refuse(
                file, ("hydra", "sweeper", "params"), f"have at most {limits.SWEPT_JOBS} jobs",
                "more", "Give the sweep on the command line.",
            )  # fmt: skip
        key = re.split(r"[./]", word.key_or_group)
        if key[0] == "hydra":
            _refuse(
                file, ("hydra", "sweeper", "params"), f"not set {word.key_or_group}", value,
                f"Give {word.key_or_group} on the command line.",
            )  # fmt: skip
        for single in values:
            nested: Any = _to_plain(single)
            for name_of_node in reversed(key):
                nested = {name_of_node: nested}
            check_content(file, nested, is_own=is_own)


def _list_swept(value: Any) -> Iterator[Any]:
    """Yield the values of an override; none for a pattern of names, which Hydra expands."""
    if hasattr(value, "range"):
        return iter(value.range())
    if hasattr(value, "filter"):
        return iter(())
    return iter(value.list if hasattr(value, "list") else [value])


def _to_plain(value: Any) -> Any:
    """Return a value of an override as plain dictionaries, lists and texts."""
    if isinstance(value, Mapping):
        return {str(key): _to_plain(entry) for key, entry in value.items()}
    if isinstance(value, list):
        return [_to_plain(entry) for entry in value]
    if value is None or isinstance(value, str | int | float | bool):
        return value
    return str(getattr(value, "text", value))  # of a quoted text


def _own_remedy(file: Path) -> str:
    return (
        f"If you wrote {file.name} yourself, write own:// in place of file:// in hydra.searchpath."
    )


def _join(path: Sequence[Any]) -> str:
    return ".".join(map(str, path))


def _refuse(file: Path, path: Sequence[Any], requirement: str, value: Any, remedy: str) -> Any:
    """Raise the error of a value of a file."""
    raise UntrustedConfigError(
        f"{file}: {_join(path)} must {requirement}, got {value!r:.80}. {remedy}"
    )
