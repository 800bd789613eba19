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
from pfbench.job.trust import require_allowed
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

_SWEEP = ("hydra", "sweeper", "params")

_PLAIN_KEY = re.compile(r"[\w.\[\]@-]+")


def check_content(file: Path, values: Mapping[str, Any], *, is_own: bool) -> None:
    """Check the content of a file, in the package that Hydra gives it."""
    for path, value in _walk(values):
        key = path[-1]
        if path[0] == "hydra":
            _check_hydra_value(file, path, value, is_own)
        elif path[0] == "data" or key in _WRITTEN or key in _SETTINGS or key in _READ[1:]:
            _check_protected(file, path, value, is_own)
        is_plain = not isinstance(key, str) or "${" not in key
        _require(is_plain, file, path, "be a plain name", key, "Write the name itself.")
        is_inside = is_own or not isinstance(value, str) or not _PATH.search(value)
        _require(is_inside, file, path, "not be a path", value, _own_remedy(file))
        if isinstance(value, str) and "${" in value and not _is_reference(path, value):
            _check_interpolation(file, path, value, is_own)
        if path == _SWEEP and isinstance(value, Mapping):  # Hydra reports another value
            _check_sweep(file, value, is_own)


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
        choice = "@".join(filter(None, [group or "".join(texts[:1]), entry.package]))
        require_allowed(
            not leaves and (is_launcher or not in_hydra),
            f"{file}: defaults",
            "name files of a group directly and outside hydra",
            f"{choice}: {value}",
            f"Choose it on the command line. In a folder of your own (own://) they may choose a launcher: {', '.join(launchers())}.",
        )


def check_place(config_path: str, package: str | None) -> None:
    """Check that no file is placed in the node `hydra` but those of Hydra's own groups."""
    in_hydra = (package or "").partition(".")[0].partition("[")[0] == "hydra"
    require_allowed(
        not in_hydra or config_path.lstrip("/").startswith("hydra/"),
        config_path,
        "not be placed in hydra",
        f"the package {package}",
        "Remove it from the header or from the defaults list.",
    )


def check_group(file: Path, config_path: str, *, is_own: bool) -> None:
    """Check that a file of a search path is none of Hydra's settings."""
    is_launcher = is_own and config_path.startswith("hydra/launcher/")
    require_allowed(
        is_launcher or not config_path.lstrip("./").startswith("hydra"),
        file,
        "not be a setting of hydra",
        config_path,
        f"Choose a launcher of pfbench on the command line ({', '.join(launchers())}), or write own:// before a folder of your own launchers.",
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


def _check_hydra_value(file: Path, path: tuple[Any, ...], value: Any, is_own: bool) -> None:
    """Check that a value below `hydra` belongs to the values of a sweep."""
    allowed = [_SWEEP]
    if is_own:  # a launcher of the user, which the command line chooses
        allowed.append(("hydra", "launcher", *path[2:3]))
    is_between = isinstance(value, Mapping) and any(path == keys[: len(path)] for keys in allowed)
    _require(
        is_between or path[:3] in allowed, file, path[:2], "not be set: hydra must have sweeper.params only", value,
        "Set the settings of hydra on the command line.",
    )  # fmt: skip


def _check_protected(file: Path, path: tuple[Any, ...], value: Any, is_own: bool) -> None:
    """Check a value of a key that only the command line may set."""
    key = path[-1]
    if key in _SETTINGS and len(path) > 1:
        return  # the same name elsewhere is none of them
    is_nothing = value is None or value == "???" or (key == "overwrite" and value is False)
    is_whole = isinstance(value, Mapping) and key in _READ  # its own keys are checked
    is_data = key in _READ or path[0] == "data"
    if is_nothing or is_whole or _is_reference(path, value) or (is_own and is_data):
        return
    remedy = f"Remove the key from the file, and add {_join(path)}=... to the command."
    _require(
        False,
        file,
        path,
        "be set on the command line",
        value,
        f"{remedy} {_own_remedy(file) if is_data else ''}".rstrip(),
    )


def _is_reference(path: tuple[Any, ...], value: Any) -> bool:
    """Return whether a value refers to the same setting of the command line and to nothing else."""
    if path[-1] == "checkpoint_path":
        return bool(_IN_RESULTS.fullmatch(str(value)))
    return value in _REFERENCES.get(path[-1], ())


def _check_interpolation(file: Path, path: tuple[Any, ...], text: str, is_own: bool) -> None:
    """Check by OmegaConf's grammar that the interpolations of a text name keys."""
    from omegaconf import grammar_parser
    from omegaconf.errors import GrammarParseError

    _require(
        len(text) <= limits.CONFIG_INTERPOLATED, file, path, f"have at most {limits.CONFIG_INTERPOLATED} characters with an interpolation",
        len(text), "Give the value on the command line.",
    )  # fmt: skip
    try:
        tree = grammar_parser.parse(text)
    except GrammarParseError as error:
        _require(False, file, path, "be a valid interpolation", text, f"{error}".splitlines()[0])
    for resolver, key in _list_interpolations(tree):
        names_user = not is_own and {*_WRITTEN, *_READ, "hydra"} & set(re.findall(r"\w+", key))
        is_known = resolver in _RESOLVERS
        _require(
            is_known and _PLAIN_KEY.fullmatch(key) and not names_user, file, path,
            "have interpolations of plain keys, and none of the user's folders",
            text if is_known else f"the resolver {resolver} in {text}", "Give the value on the command line.",
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


def _check_sweep(file: Path, params: Mapping[Any, Any], is_own: bool) -> None:
    """Check the sweep of an experiment as Hydra's parser of overrides reads it."""
    from hydra.core.override_parser.overrides_parser import OverridesParser

    jobs = 1
    for name, value in params.items():
        is_plain = isinstance(value, str | int | float | bool) or value is None
        is_plain = is_plain and not re.search(r"[@~]", str(name)) and "${" not in f"{name}{value}"
        _require(
            is_plain, file, _SWEEP, "be plain keys and values", f"{name}={value}", "Give it on the command line."
        )  # fmt: skip
        word = OverridesParser.create().parse_override(f"{name}={value}")
        values = list(islice(_list_swept(word.value()), limits.SWEPT_JOBS + 1))
        jobs *= max(1, len(values))
        most = f"have at most {limits.SWEPT_JOBS} jobs"
        _require(
            jobs <= limits.SWEPT_JOBS,
            file,
            _SWEEP,
            most,
            "more",
            "Give the sweep on the command line.",
        )
        key = re.split(r"[./]", word.key_or_group)
        _require(
            key[0] != "hydra", file, _SWEEP, f"not set {word.key_or_group}", value, f"Give {word.key_or_group} on the command line."
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


def _require(
    ok: object, file: Path, path: Sequence[Any], must: str, value: Any, remedy: str
) -> None:
    """Raise UntrustedConfigError unless a requirement on a value of a file holds."""
    if not ok:
        require_allowed(False, f"{file}: {_join(path)}", must, f"{value!r:.80}", remedy)
