"""Text of other people has no meaning in any format that a report writes."""

import csv
import io
import re
from collections.abc import Callable
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree as Tree

import numpy as np
import pandas as pd
import pytest

from pfbench.files.escapes import (
    escape_code_block,
    escape_csv,
    escape_html,
    escape_latex,
    escape_markdown,
)
from pfbench.files.table_file import read_table_file
from pfbench.files.track_files import format_gpx, format_kml
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


TRACKS = {
    "ekf <smoothed> & more": np.array([[52.123456789, 13.4, -3.5], [52.2, -179.999999999, 8848.0]]),
    "ukf": np.array([[-33.0, 151.0, 0.0]]),
}


def test_gpx_has_every_point_with_latitude_first() -> None:
    space = {"g": "http://www.topografix.com/GPX/1/1"}
    root = Tree.fromstring(format_gpx(TRACKS))
    assert root.tag == f"{{{space['g']}}}gpx"
    assert root.attrib["version"] == "1.1"
    for track, (name, points) in zip(root.findall("g:trk", space), TRACKS.items(), strict=True):
        assert track.findtext("g:name", namespaces=space) == name
        read = [
            (float(p.attrib["lat"]), float(p.attrib["lon"]), float(p.findtext("g:ele", "", space)))
            for p in track.findall("g:trkseg/g:trkpt", space)
        ]
        np.testing.assert_allclose(read, points, atol=1e-9)


def test_kml_has_every_point_with_longitude_first() -> None:
    space = {"k": "http://www.opengis.net/kml/2.2"}
    root = Tree.fromstring(format_kml(TRACKS, "my <log>"))
    assert root.findtext("k:Document/k:name", namespaces=space) == "my <log>"
    marks = root.findall("k:Document/k:Placemark", space)
    for mark, (name, points) in zip(marks, TRACKS.items(), strict=True):
        assert mark.findtext("k:name", namespaces=space) == name
        text = mark.findtext("k:LineString/k:coordinates", "", space)
        read = np.array([place.split(",") for place in text.split()], float)
        np.testing.assert_allclose(read, points[:, [1, 0, 2]], atol=1e-9)


NAMES, ROWS = "t,a,b", ["0.0,1.5,-2.5", "0.1,1.25,-2.75", "0.2,1.0,-3.0"]
TEXT = "\n".join([NAMES, *ROWS]) + "\n"


def by_pandas(file: Path, said: str) -> None:
    """Runs the call that the message names, in the folder of the file."""
    options, target = re.search(
        r"In pandas, read_csv\('table.csv'(.*?)\)\.to_csv\('(.*?)', index=False\)", said
    ).groups()  # type: ignore[union-attr]
    table = eval(f"pd.read_csv(file{options})", {"pd": pd, "file": file})
    table.to_csv(file.parent / target, index=False)


def edit(pattern: str, new: str, count: int = 0) -> Callable[[Path, str], None]:
    def apply(file: Path, _: str) -> None:
        file.write_text(re.sub(pattern, new, file.read_text(), count=count, flags=re.MULTILINE))

    return apply


CASES: dict[str, tuple[bytes, str, Callable[[Path, str], None]]] = {
    "semicolons": (TEXT.replace(",", ";").encode(), "semicolons as separators", by_pandas),
    "decimal commas": (TEXT.replace(",", ";").replace(".", ",").encode(), "semicolons", by_pandas),
    "tabs": (TEXT.replace(",", "\t").encode(), "tabs as separators", by_pandas),
    "blanks": (TEXT.replace(",", "  ").encode(), "blanks as separators", by_pandas),
    "latin-1": (TEXT.replace("b", "\xb0", 1).encode("latin-1"), "line 1 must be text", by_pandas),
    "utf-16": (TEXT.encode("utf-16"), "line 1 must be text", by_pandas),
    "old line ends": (TEXT.replace("\n", "\r").encode(), "writes line ends", by_pandas),
    "comment": (f"# by a logger\n{TEXT}".encode(), "Remove this line", edit("^#.*\n", "")),
    "comma at the end": (
        "\n".join([NAMES, *(f"{row}," for row in ROWS), ""]).encode(),
        "Remove the comma at the end",
        edit(",$", ""),
    ),
    "name too few": (
        TEXT.replace("t,a,b", "t,a").encode(),
        "All others have 3 fields: give line 1 as many names",
        edit("^t,a$", "t,a,b"),
    ),
    "one line": (TEXT.replace("0.1,1.25", "0.1,9,1.25").encode(), "Repair or remove this line", edit("9,", "")),
    "numbers alone": (TEXT.partition("\n")[2].encode(), "Insert a line with the names", edit("^", "t,a,b\n", 1)),
}  # fmt: skip


@pytest.mark.parametrize("name", CASES)
def test_a_table_of_another_program_reads_after_the_remedy(tmp_path: Path, name: str) -> None:
    content, message, repair = CASES[name]
    file = tmp_path / "table.csv"
    file.write_bytes(content)
    with pytest.raises(ValueError, match=message) as error:
        read_table_file(file)
    repair(file, str(error.value))
    rows = read_table_file(file).rows
    assert rows.to_numpy().tolist() == [[float(x) for x in row.split(",")] for row in ROWS]


def test_decimal_commas_between_commas_are_named(tmp_path: Path) -> None:
    (tmp_path / "table.csv").write_text("t,a\n" + "0,1,1,5\n" * 3)
    with pytest.raises(ValueError, match="decimal commas: write them with points"):
        read_table_file(tmp_path / "table.csv")
