"""A page as a list of blocks, and its two forms: one renderer to HTML and one to Markdown. Each text is escaped once."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

from pfbench.files.escapes import escape_html as html, escape_markdown as plain
from pfbench.report.writers import format_html, format_markdown

Kind = Literal["title", "heading", "part", "text", "note", "list", "terms", "table", "figures", "code"]  # fmt: skip


class Block(NamedTuple):
    """Block of a page.

    Attributes:
        kind: Title of the page, heading, heading of a part, text, note, list of texts, terms with their values, data frame,
            figures of `writers.render_figures`, or code.
        content: Content of the kind.
        summary: Words that open a code.
    """

    kind: Kind
    content: Any
    summary: str = ""


_HTML: Mapping[Kind, Callable[[Block], str]] = {
    "title": lambda b: f"<h1>{html(b.content)}</h1>",
    "heading": lambda b: f"<h2>{html(b.content)}</h2>",
    "part": lambda b: f"<h3>{html(b.content)}</h3>",
    "text": lambda b: f"<p>{html(b.content)}</p>",
    "note": lambda b: f"<p><small>{html(b.content)}</small></p>",
    "list": lambda b: "\n".join(["<ul>", *(f"<li>{html(t)}</li>" for t in b.content), "</ul>"]),
    "terms": lambda b: "\n".join(
        ["<dl>", *(f"<dt>{html(k)}</dt><dd>{html(v)}</dd>" for k, v in b.content), "</dl>"]
    ),
    "table": lambda b: format_html(b.content),
    "figures": lambda b: "\n".join(
        ['<div class="figures">', *map(_format_figure, b.content), "</div>"]
    ),
    "code": lambda b: (
        f'<details><summary>{html(b.summary)}</summary>\n<pre class="wide">{html(b.content)}</pre>\n</details>'
    ),
}
_MARKDOWN: Mapping[Kind, Callable[[Block], str]] = {
    "title": lambda b: f"# {plain(b.content)}",
    "heading": lambda b: f"## {plain(b.content)}",
    "part": lambda b: f"### {plain(b.content)}",
    "text": lambda b: plain(b.content),
    "note": lambda b: plain(b.content),
    "list": lambda b: "\n".join(f"- {plain(text)}" for text in b.content),
    "terms": lambda b: "\n".join(f"- {plain(name)}: {plain(value)}" for name, value in b.content),
    "table": lambda b: format_markdown(b.content),
    "figures": lambda b: "\n\n".join(
        f"![{plain(f['name'])}]({f['file']})\n\n*{plain(f['caption'])}*" for f in b.content
    ),
}


def _format_figure(figure: Mapping[str, str]) -> str:
    """Format a figure with its caption."""
    alt, file, source = (html(figure[name]) for name in ("caption", "file", "source"))
    return f'<figure>\n<img alt="{alt}" title="{file}" src="{source}">\n<figcaption>{alt}</figcaption>\n</figure>'


def render_blocks(title: str, blocks: Sequence[Block]) -> dict[str, str]:
    """Render a page by file name: index.html, and report.md without code. Empty blocks are left out."""
    filled = [block for block in blocks if len(block.content)]
    style = (Path(__file__).parent / "style.css").read_text(encoding="utf-8")
    head = (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{html(title)}</title>\n<style>\n{style}\n</style>\n</head>\n<body>\n<main>\n"
    )
    page = "\n".join(_HTML[block.kind](block) for block in filled)
    texts = [_MARKDOWN[b.kind](b).rstrip() for b in filled if b.kind in _MARKDOWN]
    return {
        "index.html": f"{head}{page}\n</main>\n</body>\n</html>\n",
        "report.md": "\n\n".join(texts) + "\n",
    }


def with_heading(heading: Block, *blocks: Block) -> Iterable[Block]:
    """Return blocks with their heading; nothing if the first of them is empty."""
    return itertools.chain([heading], blocks) if len(blocks[0].content) else ()
