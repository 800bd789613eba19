"""Texts of another person, and the faults that they cause in a file of a report whose writer does not escape them."""

import csv
import re
from html.parser import HTMLParser
from pathlib import Path
from xml.etree import ElementTree

HOSTILE = r"=<img src=x onerror=evil()>|</script>&lt;$\evil{1}$ [a](javascript:evil) **b** `c`"
_TAG = re.compile(r"(?<!\\)<(img|/?script)", re.IGNORECASE)
_MARKDOWN = re.compile(
    r"(?<!\\)<img|</script|(?<!\\)\|&lt;|\]\(javascript|\*\*b\*\*|(?<!\\)`c|\s\$\\"
)
_FILES = (
    "verdicts.csv",
    "metrics.csv",
    "headline.svg",
    "runs.parquet",
    "decisions.csv",
    "consistency.csv",
    "pfbench.bib",
)
_LATEX = re.compile(r"(?<!\\)(\\evil|<img|\|<|&lt)")


class _Tags(HTMLParser):
    """Collects images and scripts that are not of the page, and attributes that run code."""

    def __init__(self) -> None:
        super().__init__()
        self.faults: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        for name, value in attrs:
            is_address = name in ("src", "href") and not (value or "").startswith(
                ("data:", "#", "../", *_FILES)
            )
            if name.startswith("on") or is_address:
                self.faults.append(f"{tag} {name}={value}")

    def handle_endtag(self, tag: str) -> None:
        self.faults += [f"/{tag}"] if tag == "img" else []


def find_faults(name: str, text: str) -> list[str]:
    """Return the places where a text of another person has a meaning in a file."""
    suffix = Path(name).suffix
    if suffix == ".html":
        reader = _Tags()
        reader.feed(text)
        scripts = text.count("</script>") - text.count("<script")
        return [*reader.faults, *["</script>"] * abs(scripts)]
    if suffix == ".csv":
        rows = csv.reader(text.splitlines())
        return [cell for row in rows for cell in row if cell.startswith(("=", "@"))]
    if suffix == ".svg":
        ElementTree.fromstring(text)
        return _TAG.findall(text)
    text = re.sub(r"^```bibtex$.*?^```$", "", text, flags=re.DOTALL | re.MULTILINE)
    patterns = {".md": _MARKDOWN, ".tex": _LATEX}
    return patterns[suffix].findall(text) if suffix in patterns else []


def faults_of_folder(folder: Path) -> dict[str, list[str]]:
    """Return the faults of all files of a report by name."""
    files = [
        file
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.suffix not in (".parquet", ".gz")
    ]
    found = {file.name: find_faults(file.name, file.read_text()) for file in files}
    return {name: faults for name, faults in found.items() if faults}
