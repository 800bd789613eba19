"""Commands: help, options with their checks, and the function that runs one.

A file of the command line whose docstring has a line "Command `pfbench NAME`: what it does." has a command `NAME_COMMAND`. A file of one
command may begin with this line and end in its `COMMAND`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import Any, NamedTuple

import pfbench
from pfbench.cli.messages import require_choice
from pfbench.core.parameter_checks import require, require_range

Reader = Callable[[str, str, str], Any]  # of key, text and remedy
_FOLDERS = ("cli", "logs/cli")  # of commands
_FIRST = ("run", "report")  # in the list of commands
_HEAD = re.compile(r'^(?:""")?Command `pfbench (\w+)`: (.+?)\.?(?:""")?$', re.MULTILINE)


def read_word(key: str, text: str, remedy: str) -> str:
    """Return the text of an option."""
    return text


def read_list(key: str, text: str, remedy: str) -> list[str]:
    """Split a list, which must have distinct entries."""
    entries = [entry.strip() for entry in text.split(",")]
    is_list = all(entries) and len(set(entries)) == len(entries)
    require(is_list, key, "be a list of distinct entries separated by commas", repr(text), remedy)
    return entries


def read_flag(key: str, text: str, remedy: str) -> bool:
    """Read true or false."""
    require(text in ("true", "false"), key, "be true or false", text, remedy)
    return text == "true"


def in_range(rule: str) -> Reader:
    """Make the reader of a number in a range, as of `require_range`."""

    def read(key: str, text: str, remedy: str) -> float:
        value: Any = text
        for kind in (float, int):
            with suppress(ValueError):
                value = kind(text)
        require_range(key, value, f"{rule} {remedy}")
        return float(value) if "whole" not in rule else int(value)

    return read


class Option(NamedTuple):
    """Option of a command: a word KEY=VALUE besides the keys of a job.

    Attributes:
        text: Text of the default, or the form of a value where the default is another.
        help: What the option is, for the help of the command.
        read: Function that checks a text and converts it.
        default: Value without the word; that of `text` if it is not set.
    """

    text: str
    help: str
    read: Reader = read_word
    default: Any = ...

    def take(self, key: str, text: str | None) -> Any:
        """Return the value of a text, and the default without one."""
        if text is None and self.default is not ...:
            return self.default
        verb = "Default:" if self.default is ... else "Use"
        return self.read(key, self.text if text is None else text, f"{verb} {key}={self.text}.")


@dataclass(frozen=True)
class Command:
    """A command.

    Attributes:
        run: Function that receives the other words, and the values of the options by name.
        text: Help: a line of use, what the command does, examples, and a line OPTIONS for those below.
        options: Options by key.
        keys: Keys of a job that the command takes, each once; None for all, which are checked when the job is composed.
        required: Keys without which it does not run.
        takes_names: Whether a command with a few keys also takes words without a key.
    """

    run: Callable[..., None]
    text: str
    options: Mapping[str, Option] = field(default_factory=dict)
    keys: Collection[str] | None = None
    required: Collection[str] = ()
    takes_names: bool = False

    def __call__(self, words: Sequence[str]) -> None:
        """Check words, and run the command."""
        if self.keys is not None:
            words = [word for word in words if not word.startswith("hydra.searchpath=")]  # of a run
            self._check_keys(words, [*self.options, *self.keys])
        pairs = [word.partition("=") for word in words]
        texts = {key: text for key, equals, text in pairs if equals}
        for key in self.required:
            if key not in texts:
                raise ValueError(f"{key} must be set. Use: {self.text.partition(chr(10))[0]}")
        others = [
            word for word, (key, *_) in zip(words, pairs, strict=True) if key not in self.options
        ]
        self.run(
            others, **{key: entry.take(key, texts.get(key)) for key, entry in self.options.items()}
        )

    def _check_keys(self, words: Sequence[str], keys: Sequence[str]) -> None:
        """Check that each word sets one of some keys, each once."""
        advice = f"See {' '.join(self.text.split()[:2])} --help."
        names: list[str] = []
        for key, equals, text in (word.partition("=") for word in words):
            if equals or not self.takes_names:
                word = f"{key}{equals}{text}"
                is_new = text and key not in names
                require(is_new, "words", "be key=value, each key once", word, advice)
                require_choice("key", key, keys, advice)
                names.append(key)

    def format_help(self) -> str:
        """Format the help, with a line for each option in place of the line OPTIONS."""
        gap = "\n" + 29 * " "
        lines = [
            f"  {f'{key}={option.text}':26} {option.help}".replace("\n", gap)
            for key, option in self.options.items()
        ]
        return self.text.replace("  OPTIONS", "\n".join(lines))


class CommandFile(NamedTuple):
    """File of a command: its module, the name of the command, and what it does."""

    module: str
    name: str
    summary: str

    def load(self) -> Command:
        """Import the command."""
        module: Any = import_module(self.module)
        return getattr(module, f"{self.name.upper()}_COMMAND", None) or module.COMMAND


@cache
def list_commands() -> dict[str, CommandFile]:
    """List the files of all commands by name."""
    package, commands = Path(pfbench.__file__).parent, {}
    for folder in _FOLDERS:
        for file in (package / folder).glob("*.py"):
            module = f"pfbench.{folder.replace('/', '.')}.{file.stem}"
            for name, summary in _HEAD.findall(file.read_text(encoding="utf-8")):
                commands[name] = CommandFile(module, name, summary)
    return {name: commands[name] for name in (*_FIRST, *sorted(commands.keys() - {*_FIRST}))}
