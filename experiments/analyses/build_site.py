"""Build the site: `make site`. Sphinx reads a copy of all pages, with pages that are written from the code.

    python experiments/analyses/build_site.py                   build/site/index.html, warnings are errors
    python experiments/analyses/build_site.py --no-execute      without running the cells of the tutorials
    python experiments/analyses/build_site.py --to FOLDER       FOLDER/site/index.html

Pages of docs/ lie at the top of the site, those of reports/ and benchmarks/ in their folders. Links between pages are changed
accordingly. A file that a page links to, and that is not a page, is copied.
"""

from __future__ import annotations

import argparse
import ast
import os
import re
import shutil
from collections.abc import Iterator
from pathlib import Path

import site_pages

TOP = Path(__file__).resolve().parents[2]
LINK = re.compile(r"(\]\()((?!http|mailto|#)[^)#\s]+)")
_LISTED = re.compile(r"\]\((\w+)/report\.md\)")


def list_pages() -> list[Path]:
    """List the pages of the checkout that are part of the site."""
    reports = TOP / "reports"
    listed = dict.fromkeys(_LISTED.findall((reports / "README.md").read_text()))
    published = [reports / name / file for name in listed for file in ("report.md", "worlds.md")]
    others = [
        TOP / "CONTRIBUTING.md",
        TOP / "CHANGELOG.md",
        *sorted((TOP / "benchmarks").glob("*.md")),
    ]
    return [
        *sorted((TOP / "docs").rglob("*.md")),
        reports / "README.md",
        *filter(Path.is_file, published),
        *others,
    ]


COMPARISON = re.compile(
    r"\b(paid|pays?|better|worse|best|worst|smaller|larger|smallest|largest|equal|more|less|fewer|faster|slower|higher|lower|"
    r"wins?|loses?|beats?|half|twice|most|least|narrower|wider|longer|shorter|order|others|does(?: not)? reach|reaches|\d+ of \d+)\b"
)
# sentences about words and settings, not about results
DEFINITIONS = (
    "- Use one thread, `torch.set_num_threads(1)`: a step of one run is too short for more.",
    "`ratio` is its error divided by that of the baseline, with an interval, and the verdict is one of better, worse, equal and not decided.",
    "This one raises the likelihood to a power, so that an outlier has less weight.",
    "The laws that fit the class are tested: it uses no later measurement, runs do not influence each other, and more.",
    "Check these lines: a wrong axis is the most common error of a log.",
    "This is the mean effective sample size: more of it is a closer proposal, and not yet a smaller error.",
    "A fair rival has about the time of the network, so more particles:",
    "`pfbench datasheet scenario=NAME` writes more of a scenario: sensors, residuals at the truth, spread of the runs, and the bound of the error.",
)


def list_unchecked(text: str) -> list[str]:
    """List the comparisons of a notebook that no cell asserts: its cells have them as keys of `said`, with their truth.

    Args:
        text: Page of the notebook.
    """
    cells = re.findall(r"```\{code-cell\} ipython3\n(?::tags:[^\n]*\n)?(.*?)```", text, re.DOTALL)
    said = set(DEFINITIONS)
    for cell in cells:
        for node in ast.walk(ast.parse(re.sub(r"^%.*$", "", cell, flags=re.M))):
            if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "said":
                said |= {ast.literal_eval(key) for key in node.value.keys}
    prose = re.sub(r"\A---.*?\n---|```.*?```|^#[^\n]*$", "\n", text, flags=re.DOTALL | re.M)
    sentences = [" ".join(s.split()) for s in re.split(r"(?<=[.?!])\s|\n\n", prose)]
    return [s for s in sentences if COMPARISON.search(s) and s not in said]


def place(path: Path) -> Path:
    """Return the place of a file of the checkout in the site.

    Args:
        path: Path in the checkout.
    """
    if path == TOP / "README.md":
        return Path("index.md")
    name = path.relative_to(TOP / "docs" if path.is_relative_to(TOP / "docs") else TOP)
    return name.with_name("index.md") if name.name == "README.md" else name


def change_links(page: Path, text: str) -> tuple[str, set[Path]]:
    """Change the links of a page to the places of the site.

    Args:
        page: Path of the page in the checkout.
        text: Its text.

    Returns:
        The text, and the files of the checkout that it links to.
    """
    targets: set[Path] = set()

    def change(match: re.Match[str]) -> str:
        target = (page.parent / match[2]).resolve()
        if not target.is_file():
            return match[0]  # a word of code
        targets.add(target)
        return match[1] + os.path.relpath(place(target), place(page).parent)

    return LINK.sub(change, text), targets


def write_source(source: Path) -> None:
    """Write all pages of the site.

    Args:
        source: Folder of the pages, which is replaced.
    """
    shutil.rmtree(source, ignore_errors=True)
    pages = list_pages()
    files: set[Path] = {TOP / "docs" / "conf.py"}
    for page in pages:
        content = page.read_text(encoding="utf-8")
        if "{code-cell}" in content and (unchecked := list_unchecked(content)):
            raise ValueError(
                f"{page.name} must assert its comparisons in `said`, got {unchecked[0]!r}. Add it with its truth."
            )
        text, targets = change_links(page, content)
        files |= targets
        _write(source / place(page), text)
    for file in files - {*pages, TOP / "README.md"}:
        (source / place(file)).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, source / place(file))
    for name, text in site_pages.write_pages().items():
        _write(source / name, text)
    for folder in ("methods", "reports", "benchmarks"):
        _write_index(source / folder)


def _write_index(folder: Path) -> None:
    """Add the list of the pages of a folder to its first page, which is made if it is missing."""
    index = folder / "index.md"
    text = (
        index.read_text(encoding="utf-8") if index.exists() else f"# {folder.name.capitalize()}\n"
    )
    names = sorted(
        str(path.relative_to(folder).with_suffix(""))
        for path in folder.rglob("*.md")
        if path != index
    )
    hidden = [":hidden:"] if index.exists() else []
    _write(index, "\n".join([text, "```{toctree}", ":maxdepth: 1", *hidden, "", *names, "```", ""]))


def _write(path: Path, text: str) -> None:
    """Write a page."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text, encoding="utf-8")


def list_words(source: Path, target: Path, execute: bool) -> Iterator[str]:
    """Yield the words of the command of Sphinx.

    Args:
        source: Folder of the pages.
        target: Folder of the site.
        execute: Whether the cells of the tutorials run.
    """
    yield from ("-b", "html", "-q", "-W", "--keep-going", "-d", str(target.parent / "site_trees"))
    yield from ("-D", f"nb_execution_cache_path={target.parent / 'site_cells'}")
    yield from () if execute else ("-D", "nb_execution_mode=off")
    yield from (str(source), str(target))


def main() -> None:
    from sphinx.cmd.build import main as build

    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--no-execute", action="store_true")
    parser.add_argument("--to", type=Path, default=TOP / "build")
    given = parser.parse_args()
    source, target = given.to.resolve() / "site_source", given.to.resolve() / "site"
    write_source(source)
    code = build(list(list_words(source, target, not given.no_execute)))
    print(f"site: {target / 'index.html'}")
    raise SystemExit(code)


if __name__ == "__main__":
    main()
