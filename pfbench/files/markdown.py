"""Lines of Markdown, for studies that write their own page."""

from __future__ import annotations

import textwrap
from typing import Any

WIDTH = 130


def markdown_row(*cells: Any) -> str:
    """Format a row of a table."""
    return "| " + " | ".join(map(str, cells)) + " |"


def markdown_head(*cells: str) -> list[str]:
    """Format the first two lines of a table."""
    return [markdown_row(*cells), "|" + " --- |" * len(cells)]


def markdown_paragraph(text: str) -> list[str]:
    """Wrap a text and add an empty line."""
    return [*textwrap.wrap(text, WIDTH, break_long_words=False, break_on_hyphens=False), ""]


def markdown_bullets(*texts: str) -> list[str]:
    """Format a list with an item per text."""
    lines = [
        textwrap.wrap(f"- {text}", WIDTH, subsequent_indent="  ", break_on_hyphens=False)
        for text in texts
    ]
    return [*(line for item in lines for line in item), ""]
