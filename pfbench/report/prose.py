"""Lines of Markdown, for studies that write their own page."""

from __future__ import annotations

import textwrap
from typing import Any

WIDTH = 130


def row(*cells: Any) -> str:
    """A row of a table."""
    return "| " + " | ".join(map(str, cells)) + " |"


def head(*cells: str) -> list[str]:
    """The first two lines of a table."""
    return [row(*cells), "|" + " --- |" * len(cells)]


def paragraph(text: str) -> list[str]:
    """A text of one line in lines that an editor shows whole, and an empty one."""
    return [*textwrap.wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False), ""]


def bullets(*texts: str) -> list[str]:
    """A list, an item a text."""
    lines = [textwrap.wrap(f"- {text}", WIDTH, subsequent_indent="  ", break_on_hyphens=False) for text in texts]
    return [*(line for item in lines for line in item), ""]
