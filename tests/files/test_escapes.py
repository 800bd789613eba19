"""Text of other people has no meaning in any format that a report writes."""

from __future__ import annotations

import csv
import io
import re
from collections.abc import Callable
from html.parser import HTMLParser

import pandas as pd
import pytest

from pfbench.files.escapes import (
    escape_code_block,
    escape_csv,
    escape_html,
    escape_latex,
    escape_markdown,
)
from pfbench.report import writers

PLAIN = ("sir", "cofm_amssrcpf", "sir[ess_threshold=0.5]", "3-D position [m]", "a, b: 1.5", "−12 %")


def test_plain_names_are_unchanged() -> None:
    for text in (*PLAIN, "P(error a < error b)", "-24 %", "5 of 6 > 4", "a & b", "[1, 2]"):
        assert escape_markdown(text) == text
    for text in (*PLAIN, "-1.5", "+8 %", "-24.5 %", "1e-3", "-inf", "–", "a=b", "'"):
        assert escape_csv(text) == text
    assert escape_latex("sir 1 [m]") == "sir 1 [m]"
    assert escape_html("sir") == "sir"


@pytest.mark.parametrize(
    "text",
    ["=1+1", "+cmd", "-2+3", "@SUM(A1)", "\t=1", "\r=1", "\n=1", "=", "-", "\uff1d1", "+1+1", "-1;2"],
)  # fmt: skip
def test_no_text_of_a_csv_file_is_a_formula(text: str) -> None:
    escaped = "'" + text.replace("\r", " ").replace("\n", " ")
    assert escape_csv(text) == escaped
    assert escape_csv(f"a{text}").count("\r") == 0  # a line break in a text would start a row
    table = pd.DataFrame({text: [text, "a"], "number": [-1.5, 2.0]})
    rows = list(csv.reader(io.StringIO(writers.format_csv(table), newline="")))
    assert rows[:2] == [[escaped, "number"], [escaped, "-1.5"]]


@pytest.mark.parametrize(
    ("text", "escaped"),
    [
        ("<img src=x>", "&lt;img src=x>"),
        ("</td>", "&lt;/td>"),
        ("<!--", "&lt;!--"),
        ("<http://a.b>", "&lt;http://a.b>"),
        ("a|b", r"a\|b"),
        ("a\\|b", r"a\\\|b"),
        ("`code`", r"\`code\`"),
        ("**a**", r"\*\*a\*\*"),
        ("_a_ b_c", r"\_a\_ b_c"),
        ("[a](javascript:x)", r"[a]\(javascript:x)"),
        ("![a](http://a.b/c.png)", r"![a]\(http://a.b/c.png)"),
        ("[a]: http://a.b", r"\[a]: http://a.b"),
        ("[a][b]", r"[a]\[b]"),
        ("&lt;b>", "&amp;lt;b>"),
        ("$x$", r"\$x\$"),
        ("~~a~~", r"\~\~a\~\~"),
        ("# a", r"\# a"),
        ("> a", r"\> a"),
        ("- a", r"\- a"),
        ("1. a", r"1\. a"),
        ("---", r"\---"),
        ("a\n\n# b\u2028c", "a  # b c"),
        ("a\x00b\x1bc", "a\ufffdb\ufffdc"),
    ],
)
def test_markdown(text: str, escaped: str) -> None:
    assert escape_markdown(text) == escaped


def test_a_code_block_cannot_be_left() -> None:
    assert "```" not in escape_code_block("a```\n# b\n````")


@pytest.mark.parametrize(
    ("text", "escaped"),
    [
        (r"\input{x}", r"\textbackslash input\{x\}"),
        ("100 % & $x$ #1 a_b ~ ^", r"100 \% \& \$x\$ \#1 a\_b \textasciitilde  \textasciicircum "),
        ("[1ex] a", "{[}1ex] a"),
        ("* a", "{*} a"),
        ("a\n\nb\tc", "a  b c"),
        ("a\x00\x07b", "ab"),
        ("é α 中", r"\'{e} $\alpha$ (U+4E2D)"),
    ],
)
def test_latex(text: str, escaped: str) -> None:
    assert escape_latex(text) == escaped


@pytest.mark.parametrize(
    "text", ["<b>&'\"", "</script><script>alert(1)</script>", "\"' onerror=alert(1) x='"]
)
def test_html_gives_the_text_back_in_content_and_attributes(text: str) -> None:
    seen: list[object] = []

    class Reader(HTMLParser):
        handle_data = seen.append

        def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
            seen.append((tag, attrs))

    Reader().feed(f'<p title="{escape_html(text)}">{escape_html(text)}</p>')
    assert seen == [("p", [("title", text)]), text]


@pytest.mark.parametrize(
    ("write", "pattern"),
    [
        (writers.format_html, r"<b>"),
        (writers.format_markdown, r"<b>|(?<!\\)\|x"),
        (writers.format_latex, r"(?<!\\)[_&]x"),
    ],
)
def test_tables_escape_names_of_columns_and_cells(
    write: Callable[[pd.DataFrame], str], pattern: str
) -> None:
    text, plain = "<b>|x_x&x|x", "xxx"
    assert len(re.findall(pattern, text)) >= 1  # the pattern can fail
    assert not re.search(pattern, write(pd.DataFrame({text: [text]})))
    assert plain in write(pd.DataFrame({text: [plain]}))
