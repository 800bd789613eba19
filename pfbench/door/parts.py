"""Parts of a job: a shipped file with other values, or a class of the user. Both are words of the command line."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any

from pfbench.cli.list import describe_choices, describe_files
from pfbench.cli.messages import (
    format_error,
    format_unknown_choice,
    is_named,
    notes_of,
    require_choice,
)

PART_GROUPS = ("scenario", "noise", "filter", "model")
_PLAIN_TEXT = re.compile(r"[A-Za-z_][\w./-]*")
READ_OTHERWISE = ("null", "true", "false", "nan", "inf")  # by the parser of words


@contextmanager
def plain_errors(words: Sequence[str] = ()) -> Iterator[None]:
    """Raise an error with the sentence that the command line gives."""
    try:
        yield
    except Exception as error:
        message = format_error(error, words)
        if message == str(error) and is_named(error):
            raise
        translated = ValueError(message)
        for note in notes_of(error):
            translated.add_note(note)
        is_hydra = type(error).__module__.partition(".")[0] in ("hydra", "omegaconf")
        raise translated from None if is_hydra else error  # whose traceback is as long as a page


@dataclass(frozen=True)
class Part:
    """Part of a job: scenario, noise regime, filter or model.

    Attributes:
        group: Group of the configuration.
        name: Name of the file in the group.
        changes: Other values, as words of the command line.
        folders: Folders that hold the files of classes of the user.
        packages: Packages that define these classes.
    """

    group: str
    name: str
    changes: tuple[str, ...] = ()
    folders: tuple[str, ...] = ()
    packages: tuple[str, ...] = ()

    def words(self) -> list[str]:
        """Return the words of the command line that choose the part, without those of `place_words`."""
        return [f"{self.group}={self.name}", *self.changes]

    def __str__(self) -> str:
        return " ".join(self.words())


def place_words(parts: Sequence[Part]) -> list[str]:
    """Return the words that say where the files of parts are and which packages are trusted."""
    folders = dict.fromkeys(f"own://{folder}" for item in parts for folder in item.folders)
    packages = dict.fromkeys(package for item in parts for package in item.packages)
    words = [f"hydra.searchpath=[{','.join(folders)}]"] if folders else []
    return [*words, *([f"trust=[{','.join(packages)}]"] if packages else [])]


class NameList(dict[str, str]):
    """Names with their descriptions, printed as lines and shown as a table in a notebook."""

    def __repr__(self) -> str:
        return "\n".join(f"{name:24} {text}" for name, text in self.items())

    def _repr_html_(self) -> str:
        return format_html_table(("name", "description"), list(self.items()))


def format_html_table(heads: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    """Format a table as HTML."""
    head = "".join(f"<th style='text-align:left'>{html.escape(text)}</th>" for text in heads)
    body = "".join(
        "<tr>"
        + "".join(f"<td style='text-align:left'>{html.escape(str(v))}</td>" for v in row)
        + "</tr>"
        for row in rows
    )
    return f"<table><thead><tr>{head}</tr></thead><tbody>{body}</tbody></table>"


@plain_errors()
def list_names(group: str | None = None) -> NameList:
    """List what can be chosen, as `pfbench list` does.

    Args:
        group: Group such as `filter` or `scenario`. None for the groups.

    Returns:
        Descriptions by name. The files of the folder `conf` in the current folder are among them.

    Raises:
        ValueError: If the group does not exist.
    """
    return NameList(describe_choices(group))


def get_part(group: str, name: str, /, **changes: Any) -> Part:
    """Choose a file of a group by its name.

    Args:
        group: scenario, noise, filter or model.
        name: Name of the file, see `pfbench.names(group)`.
        **changes: Other values by key. Two underscores stand for a point: `resampler__ess_threshold=1.0`.

    Returns:
        The part.

    Raises:
        ValueError: If the group or the name does not exist.
    """
    require_choice("group", group, PART_GROUPS, "List the names: pfbench.names('filter').")
    if not isinstance(name, str):
        raise TypeError(
            f"{group} must be a name, got {describe_value(name)}. List the names: pfbench.names({group!r})."
        )
    names = list(describe_files(group))
    if name not in names:
        raise ValueError(format_unknown_choice(group, name, names))
    return Part(group, name, tuple(f"{group}.{word}" for word in format_words(changes)))


def add_changes(base: Part, changes: Sequence[str]) -> Part:
    """Return a part with more changes."""
    return replace(base, changes=(*base.changes, *changes))


def format_words(settings: Mapping[str, Any]) -> list[str]:
    """Format settings as words of the command line."""
    return [
        f"{key.replace('__', '.')}={format_value(key, value)}" for key, value in settings.items()
    ]


def format_value(key: str, value: Any) -> str:
    """Format a value as the command line reads it."""
    if hasattr(value, "item") and getattr(value, "shape", None) == ():  # a number of NumPy or torch
        value = value.item()
    if value is None or isinstance(value, bool):
        return {None: "null", True: "true", False: "false"}[value]
    if isinstance(value, int | float):
        return repr(value)
    if isinstance(value, str):
        if _PLAIN_TEXT.fullmatch(value) and value.lower() not in READ_OTHERWISE:
            return value
        from hydra.core.override_parser.types import Quote, QuotedString

        return QuotedString(text=value, quote=Quote.single).with_quotes()
    if isinstance(value, Mapping):
        pairs = ",".join(f"{name}:{format_value(key, entry)}" for name, entry in value.items())
        return f"{{{pairs}}}"
    if isinstance(value, list | tuple):
        return f"[{','.join(format_value(key, entry) for entry in value)}]"
    raise TypeError(
        f"{key} must be a number, a text, a list or a dictionary, got {describe_value(value)}. "
        "Pass a class or an object by pfbench.own(...)."
    )


def describe_value(value: object) -> str:
    """Describe a value for a message."""
    if isinstance(value, type):
        return f"the class {value.__name__}"
    is_short = isinstance(value, str | int | float | None)
    return repr(value) if is_short else f"{type(value).__name__}"
