"""Error messages of the command line: key, value and remedy."""

from __future__ import annotations

import difflib
import errno
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

from pfbench.cli.unknown_errors import describe_unknown, is_named
from pfbench.config.hydra_messages import format_choice_error, format_value_error

# extra of the package that installs a launcher
_EXTRAS = {"ray": "ray", "submitit": "slurm", "joblib": "launch"}
# errors of the file system: remedy
_STORAGE = {
    errno.ENOSPC: "Free space",
    errno.EDQUOT: "Free space of the quota",
    errno.EFBIG: "Raise the limit of the file size (ulimit -f)",
    errno.EROFS: "Make the folder writable or set another one",
    errno.EACCES: "Change its permissions or set another folder",
    errno.EPERM: "Change its permissions or set another folder",
    errno.ENOTDIR: "Set a folder instead of a file",
    errno.EISDIR: "Set a file instead of a folder",
    errno.EEXIST: "Set a folder instead of a file",
    errno.ENOENT: "Make it, or correct its name",
    errno.ENAMETOOLONG: "Use a shorter name",
}
_OTHER_STORAGE = "Check the file and its folder, or set another one"
_ALL_KEYS = " List all: pfbench run --cfg job"


def format_error(error: BaseException, words: Sequence[str] = ()) -> str:
    """Format an error for a user.

    Args:
        error: Error of a command, of Hydra or of a class that a configuration names.
        words: Overrides of the command.

    Returns:
        The key, the value given, and a remedy.
    """
    if type(error).__name__ == "InstantiationException" and error.__cause__ is not None:
        return _format_refusal(f"{error}", error.__cause__, words)
    if isinstance(error, OSError) and error.errno is not None:
        return _format_storage(error)
    if isinstance(error, MemoryError):
        return "memory must be enough for the command, got an array that is too large. Reduce runs, particles or steps."
    text = f"{error}".strip() or type(error).__name__
    if message := _format_hydra_error(text, words):
        return message
    if not is_named(error):
        text = describe_unknown(error)
    renamed = next((find_renamed(word) for word in words if find_renamed(word)), None)
    return f"{text} {renamed[0]}: renamed to {renamed[1]}" if renamed else text


def _format_hydra_error(text: str, words: Sequence[str]) -> str:
    """Format an error of Hydra; empty for other errors."""
    if match := re.search(r"Could not override '([^']*)'", text):
        return _format_override(match[1], words)
    launchers = "|".join(_EXTRAS)
    if match := re.search(rf"[Cc]ould not (?:find|load) 'hydra/launcher/({launchers})", text):
        launcher = next((word for word in words if word.startswith("hydra/launcher=")), "launcher")
        return f'{launcher} is not installed. Run pip install "pfbench[{_EXTRAS[match[1]]}]"'
    if message := format_choice_error(text, words):
        return message
    if match := re.search(r"Could not find '(.+)/([^/']*)'", text):
        return _format_unknown_choice(match[1], match[2], re.findall(r"^\t(\w+)$", text, re.M))
    return format_value_error(text)


def _format_override(key: str, words: Sequence[str]) -> str:
    """Format the error of a word whose key the configuration lacks."""
    if not key:
        return "each word must be key=value, got one without a key. Write the key before the equals sign."
    if key == "experiment":
        name = next((w.partition("=")[2] for w in words if w.startswith("experiment=")), "NAME")
        return f"experiment={name} must be added with a plus sign. Use +experiment={name}"
    return _format_unknown_key(key, words)


def _format_storage(error: OSError) -> str:
    """Format an error of the file system with its remedy."""
    name = error.filename or "files of the command"
    return (
        f"{name} must be accessible, got '{error.strerror}'. {_STORAGE.get(error.errno or 0, _OTHER_STORAGE)}, then "
        "repeat the command. Finished jobs are kept."
    )


def notes_of(error: BaseException) -> list[str]:
    """Return the remarks that a job has added to its error, such as the file of the traceback."""
    return list(getattr(error, "__notes__", []))


def suggest_similar(name: str, options: Sequence[str]) -> str:
    """Return a sentence with the options that are similar to a misspelt name.

    Args:
        name: Name or dotted key that does not exist.
        options: Existing names or dotted keys. Dotted keys are compared by their last part, too.

    Returns:
        ` Similar: a, b.`, or an empty text.
    """

    def similarity(a: str, b: str) -> float:
        return difflib.SequenceMatcher(None, a, b).ratio()

    def last_part(key: str) -> str:
        return key.rpartition(".")[2]

    scores = {
        option: similarity(option, name)
        for option in options
        if similarity(last_part(option), last_part(name)) >= 0.6
    }
    best = [option for option, score in scores.items() if score > max(scores.values()) - 0.1]
    return f" Similar: {', '.join(best[:3])}." if best else ""


def find_renamed(word: str) -> tuple[str, str] | None:
    """Find the new name of a renamed key or choice.

    Args:
        word: Override `key=value`, or a dotted key.

    Returns:
        The old and the new name, or None.
    """
    key, _, value = word.lstrip("+~").partition("=")
    table = _renamed_keys()
    if new := table["choices"].get(key, {}).get(value):
        return f"{key}={value}", f"{key}={new}"
    group, *parts = key.split(".")
    if not parts:
        return (key, table["config"][key]) if key in table["config"] else None
    new_parts = [
        _rename_last(table["keys"].get(group, {}), parts[: i + 1]) for i in range(len(parts))
    ]
    new_key = ".".join([group, *new_parts])
    return (key, new_key) if new_key != key else None


def _rename_last(table: Mapping[str, str], path: Sequence[str]) -> str:
    """Rename the last key of a path by the longest entry that matches its end."""
    pattern = ["*" if name.isdigit() else name for name in path]
    ends = [".".join(["", *pattern]), *(".".join(pattern[i:]) for i in range(len(pattern)))]
    return next((table[end] for end in ends if end in table), path[-1])


@cache
def _renamed_keys() -> dict[str, Any]:
    """Read the table of renamed keys."""
    import yaml

    table: dict[str, Any] = yaml.safe_load(
        Path(__file__).with_name("renamed_keys.yaml").read_text()
    )
    return table


def _format_unknown_choice(group: str, name: str, options: Sequence[str]) -> str:
    """Format an error about a choice that does not exist."""
    if renamed := find_renamed(f"{group}={name}"):
        return f"{renamed[0]}: renamed to {renamed[1]}"
    if group != "experiment" and name.lower() in options:
        return f"{group}={name} does not exist. Names are in lower case: {group}={name.lower()}"
    is_listed = "/" not in group
    available = f"pfbench list {group}" if is_listed else ", ".join(options)
    return f"{group}={name} does not exist.{suggest_similar(name, options)} List all: {available}"


def _format_refusal(text: str, cause: BaseException, words: Sequence[str]) -> str:
    """Format an error of a class under the full key that the user gave."""
    location = re.search(r"full_key: (\S+)", text)
    # Hydra writes the place in a list without a point: filter.noise_adaptations0
    key = re.sub(r"(?<=[a-z_])(\d+)(?=\.|$)", r".\1", location[1]) if location else "configuration"
    message = " ".join(f"{cause}".split())
    if unknown := re.search(r"got an unexpected keyword argument '(\w+)'", message):
        return _format_unknown_key(f"{key}.{unknown[1]}", words)
    target = re.search(r"Error loading '([\w.]+)'", message)
    if target and (new := _renamed_keys()["targets"].get(target[1])):
        return f"{key}._target_={target[1]}: renamed to {new}"
    if target and (module := re.search(r"No module named '([\w.]+)'", message)):
        return (
            f"{key}._target_ must be importable, got {target[1]}: the module {module[1]} is not "
            "installed. Install it, or set PYTHONPATH to its parent folder."
        )
    if type(cause) is not ValueError:
        overrides = [word.lstrip("+") for word in words if word.lstrip("+").startswith(f"{key}.")]
        if len(overrides) == 1 and "not supported between instances of" in message:
            name, _, value = overrides[0].partition("=")
            return f"{name} must be a number, got {value}. Write it as 0.5 or 1e-3."
        source = " ".join(overrides) or "its YAML file"
        return f"{key}: a value is not valid ({type(cause).__name__}: {message}). Check {source}."
    match = re.match(r"(?:\w+\.)*(\w+)(?=[=:]| must | is not )", message)
    if match is None:
        return f"{key}: {message}"
    keys = (word.lstrip("+").partition("=")[0] for word in words)
    same_name = [name for name in keys if name.endswith(f".{match[1]}")]
    full = min(same_name, key=lambda name: not name.startswith(key), default=f"{key}.{match[1]}")
    return full + message[match.end() :]


def _format_unknown_key(name: str, words: Sequence[str]) -> str:
    """Format an error about a key that does not exist."""
    override = next((word for word in words if word.lstrip("+~").startswith(f"{name}=")), name)
    renamed, keys = find_renamed(name), _composed_keys(words, name)
    # a misspelt key may be an old key of another scenario: scenario.step for scenario.steps
    siblings = [key for key in keys if key.rpartition(".")[0] == name.rpartition(".")[0]]
    if renamed and (renamed[1] in keys or not suggest_similar(name, siblings)):
        return f"{renamed[0]}: renamed to {renamed[1]}"
    if name in keys and {"-m", "--multirun"} & set(words):
        return (
            f"{override}: not all jobs of this sweep have the key {name}. "
            "Run those without it in a separate sweep."
        )
    similar = suggest_similar(name, [key for key in keys if key != name])
    return f"{override}: key {name} does not exist.{similar or _ALL_KEYS}"


def _composed_keys(words: Sequence[str], excluded: str) -> list[str]:
    """List the dotted keys of the configuration of all other overrides."""
    from pfbench.config.composition import compose
    from pfbench.config.sweep_check import expand_sweep

    others = [word for word in words if "=" in word and excluded not in word]
    keys: dict[str, None] = {}
    try:
        alternatives = expand_sweep([word for word in others if not word.startswith("hydra")])
        first = [options[0] for options in alternatives]
        for i, options in enumerate(alternatives):
            for option in options[1:]:
                composed = compose([*first[:i], option, *first[i + 1 :]])
                keys |= dict.fromkeys(_dotted_keys(composed.values))
        keys |= dict.fromkeys(_dotted_keys(compose(first).values))
    except Exception:  # with a second mistake, a suggestion would only confuse
        return []
    return list(keys)


def _dotted_keys(node: Any, path: str = "") -> Iterator[str]:
    """Yield the dotted keys of a nested dictionary."""
    if path:
        yield path
    if isinstance(node, dict):
        for key, value in node.items():
            yield from _dotted_keys(value, f"{path}.{key}" if path else str(key))
