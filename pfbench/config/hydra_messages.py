"""Messages for errors of Hydra, which name neither key nor remedy."""

from __future__ import annotations

import re
from collections.abc import Sequence

# how Hydra's parser begins its errors
_GRAMMAR = (
    "mismatched input",
    "extraneous input",
    "no viable alternative",
    "token recognition error",
)


def format_value_error(text: str) -> str:
    """Format an error of Hydra about a single value.

    Args:
        text: Message of the error.

    Returns:
        The key, the value given, and a remedy. Empty for other errors.
    """
    if match := re.search(r"Ambiguous value for argument '([^']+)'", text):
        return f"{match[1]} must be one value, got several. Add -m to run all: pfbench run -m ..."
    if match := re.search(r"Interpolation key '([^']+)' not found\s+full_key: (\S+)", text):
        group, _, name = match[1].partition(".")
        return (
            f"{match[2]} must be set, since {match[1]} does not exist. "
            f"Set {match[2]}=... or choose a {group} that defines {name}."
        )
    if match := re.search(r"Missing mandatory value: (\S+)", text):
        return f"{match[1]} must be set. Set {match[1]}=..."
    if "LexerNoViableAlt" in text or text.startswith(_GRAMMAR):
        return (
            "each word must be key=value. Quote a value with spaces or signs; names consist of a-z, A-Z, "
            "0-9 and underscores."
        )
    if match := re.search(r"tried to allocate (\d+) bytes", text):
        size = int(match[1]) / 2**30
        return f"memory must hold an array of {size:.3g} GiB. Reduce runs, particles or steps."
    if match := re.search(r"Error parsing override '([^']*)'", text):
        return f"'{match[1]}' must be key=value. Quote it if the shell reads brackets or spaces."
    if match := re.search(r"Error merging override (\S+)=(\S*)", text):
        key = match[1].lstrip("+~")
        return f"{key} must have a value of its type, got {match[2]}. See its default: pfbench run --cfg all"
    if match := re.search(r"An item is already at '([^']+)'", text):
        return f"{match[1]} exists already. Leave out the plus sign: {match[1]}=VALUE"
    return ""


def format_flag(words: Sequence[str], flag: str, command: str) -> str:
    """Format an error about a flag that does not exist, such as `--scenario`.

    Args:
        words: Words of the command.
        flag: The flag, one of the words.
        command: Name of the command.

    Returns:
        The flag, and how the override is written.
    """
    key, _, value = flag.lstrip("-").partition("=")
    following = words[words.index(flag) + 1 :] if flag in words else []
    if not value and following and not re.match(r"-|.*=", following[0]):
        value = following[0]
    return (
        f"{flag} is not an option. Overrides have no dashes: write {key}={value or 'VALUE'} "
        f"(pfbench {command} --help)"
    )


def format_choice_error(text: str, words: Sequence[str]) -> str:
    """Format an error of Hydra about the choice of a file or the search path.

    Args:
        text: Message of the error.
        words: Overrides of the command.

    Returns:
        The key, the value given, and a remedy. Empty for other errors.
    """
    path = next((word for word in words if re.match(r"\+?\w+=\.{0,2}/", word)), "")
    if path and re.search(r"Could not (find|load)", text) and path.partition("=")[2] in text:
        group = path.lstrip("+").partition("=")[0]
        return (
            f"{path} must be a name, got a path. Add its folder with hydra.searchpath=[file://FOLDER], "
            f"or choose a name: pfbench list {group}"
        )
    if "Config group override must be a string or a list" in text:
        from pfbench.config.composition import list_groups

        is_number = re.compile(r"[+~]*(\w+)=(null|true|false|[-+.\d].*)", re.IGNORECASE)
        numbers = (
            word for word in words if (m := is_number.fullmatch(word)) and m[1] in list_groups()
        )
        if (word := next(numbers, None)) is None:
            return "each group must have the name of a file. List the groups: pfbench list"
        group = word.lstrip("+").partition("=")[0]
        return f"{word} must name a file of the group. Choose one: pfbench list {group}"
    return ""
