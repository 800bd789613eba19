"""A page as a list of blocks, and its two forms: one renderer to HTML and one to Markdown. Each text is escaped once."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jinja2
from markupsafe import Markup

from pfbench.files.escapes import (
    escape_code_block,
    escape_html,
    escape_markdown,
    markdown_row,
)
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.provenance import name_build
from pfbench.report.writers import format_html, format_markdown

Kind = Literal["title", "heading", "part", "text", "alarm", "note", "list", "links", "terms", "table", "rows", "figures", "code", "folded"]  # fmt: skip
_HERE = Path(__file__).parent


class Block(NamedTuple):
    """Block of a page. A text that is `Markup` has the syntax of the form in which it is shown.

    Attributes:
        kind: Title of the page, heading, heading of a part, text, alarm, note, list of texts, list of files, or terms with their
            values. Further data frames, lines of a table in Markdown, figures of `writers.render_figures` and code. A folded
            code is in HTML alone.
        content: Content of the kind.
        summary: Words that open a folded code.
    """

    kind: Kind
    content: Any
    summary: str = ""


def html(text: Any) -> str:
    """Escape a text for HTML."""
    return str(text) if hasattr(text, "__html__") else escape_html(str(text))


def plain(text: Any) -> str:
    """Escape a text for Markdown."""
    return str(text) if hasattr(text, "__html__") else escape_markdown(str(text))


_HTML: Mapping[Kind, Callable[[Block], str]] = {
    "title": lambda b: f"<h1>{html(b.content)}</h1>",
    "heading": lambda b: f"<h2>{html(b.content)}</h2>",
    "part": lambda b: f"<h3>{html(b.content)}</h3>",
    "text": lambda b: f"<p>{html(b.content)}</p>",
    "alarm": lambda b: f'<p class="alarm">{html(b.content)}</p>',
    "note": lambda b: f"<p><small>{html(b.content)}</small></p>",
    "list": lambda b: "\n".join(["<ul>", *(f"<li>{html(t)}</li>" for t in b.content), "</ul>"]),
    "links": lambda b: "\n".join(
        [
            "<ul>",
            *(f'<li><a href="{html(name)}">{html(name)}</a></li>' for name in b.content),
            "</ul>",
        ]
    ),
    "terms": lambda b: "\n".join(
        ["<dl>", *(f"<dt>{html(k)}</dt><dd>{html(v)}</dd>" for k, v in b.content), "</dl>"]
    ),
    "table": lambda b: format_html(b.content),
    "figures": lambda b: "\n".join(
        ['<div class="figures">', *map(_format_figure, b.content), "</div>"]
    ),
    "code": lambda b: f"<pre>{html(b.content)}</pre>",
    "folded": lambda b: (
        f'<details><summary>{html(b.summary)}</summary>\n<pre class="wide">{html(b.content)}</pre>\n</details>'
    ),
}
_MARKDOWN: Mapping[Kind, Callable[[Block], str]] = {
    "title": lambda b: f"# {plain(b.content)}",
    "heading": lambda b: f"## {plain(b.content)}",
    "part": lambda b: f"### {plain(b.content)}",
    "text": lambda b: plain(b.content),
    "alarm": lambda b: f"**{plain(b.content)}**",
    "note": lambda b: plain(b.content),
    "list": lambda b: "\n".join(f"- {plain(text)}" for text in b.content),
    "links": lambda b: "\n".join(f"- [{plain(name)}]({name})" for name in b.content),
    "terms": lambda b: "\n".join(f"- {plain(name)}: {plain(value)}" for name, value in b.content),
    "table": lambda b: format_markdown(b.content),
    "rows": lambda b: "\n".join(b.content),
    "code": lambda b: f"```\n{escape_code_block(b.content.rstrip())}\n```",
    "figures": lambda b: "\n\n".join(
        f"![{plain(f['name'])}]({f['file']})\n\n*{plain(f['caption'])}*" for f in b.content
    ),
}


def _format_figure(figure: Mapping[str, str]) -> str:
    """Format a figure with its caption."""
    alt, file, source = (html(figure[name]) for name in ("caption", "file", "source"))
    return f'<figure>\n<img alt="{alt}" title="{file}" src="{source}">\n<figcaption>{alt}</figcaption>\n</figure>'


def render_template(home: Path, context: Mapping[str, Any], name: str = "page.html.jinja") -> str:
    """Render a page that extends base.html.jinja, with the style of all pages and page.css of its folder.

    Each value is escaped once.
    """
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader([home, _HERE]), autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True,
        lstrip_blocks=True, keep_trailing_newline=True,
    )  # fmt: skip
    environment.filters["name_build"] = name_build
    styles = (path for path in (_HERE / "style.css", home / "page.css") if path.is_file())
    css = Markup("\n".join(path.read_text(encoding="utf-8") for path in styles))
    return environment.get_template(name).render(css=css, **context)


def render_markdown(blocks: Iterable[Block]) -> str:
    """Render the Markdown of a page. Empty blocks are left out."""
    texts = [
        _MARKDOWN[b.kind](b).rstrip() for b in blocks if b.kind in _MARKDOWN and len(b.content)
    ]
    return "\n\n".join(texts) + "\n"


def render_blocks(title: str, blocks: Sequence[Block]) -> dict[str, str]:
    """Render a page by file name: index.html, and report.md. Empty blocks are left out."""
    body = Markup("\n".join(_HTML[block.kind](block) for block in blocks if len(block.content)))
    page = render_template(_HERE, {"title": title, "body": body}, "base.html.jinja")
    return {"index.html": page, "report.md": render_markdown(blocks)}


def write_page(folder: RecordedFolder, title: str, blocks: Sequence[Block]) -> Path:
    """Write a page of blocks in both forms; return the path of index.html."""
    for name, text in render_blocks(title, blocks).items():
        folder.write(name, text)
    return folder.path / "index.html"


def make_rows(heads: Sequence[str], rows: Sequence[Sequence[Any]], rule: str = " --- ") -> Block:
    """Return a table of texts in Markdown, which is empty without rows; `rule` is below each head."""
    line = f"|{'|'.join([rule] * len(heads))}|"
    lines = [markdown_row(*heads), line, *(markdown_row(*map(plain, row)) for row in rows)]
    return Block("rows", lines if rows else ())


def name_generator(pack: Mapping[str, Any]) -> str:
    """Name the version of the data of a page, and its commit."""
    origin = pack["generated"]
    return f"pfbench {origin['version']}" + (f", {name_build(origin['commit'])}" if origin["commit"] else "")  # fmt: skip


def with_heading(heading: Block, *blocks: Block) -> Iterable[Block]:
    """Return blocks with their heading; nothing if the first of them is empty."""
    return itertools.chain([heading], blocks) if len(blocks[0].content) else ()
