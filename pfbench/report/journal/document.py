"""The paper: a document with all figures and tables that compiles."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from pfbench.files.escapes import escape_latex
from pfbench.report.journal.page_format import PageFormat
from pfbench.report.journal.references import SELF, cite, list_cited_keys
from pfbench.report.journal.study_pack import Pack, find_rows, is_number, list_pairs

_PACKAGES = (
    r"\usepackage[T1]{fontenc}",
    r"\usepackage[utf8]{inputenc}",
    r"\usepackage{graphicx,booktabs,siunitx,xcolor,textcomp,amsmath}",
    r"\sisetup{mode=text,input-symbols=<}",
    r"\emergencystretch=3em",
)
_MINUS = re.compile(r"(?<![\w-])-(?=\d)")  # a sign, not a hyphen
CAPTIONS = {
    "leaderboard": (
        "{metric} relative to {baseline}, mean over worlds and noise regimes on a log scale, with {level}\\,\\% intervals. "
        r"Filled: proposed methods. $^\dagger$: shown to be worse than the first. Triangles lie beyond the axis."
    ),
    "over_time": "Median error over runs in time, {regime}. Filled and solid: proposed methods; hollow and dashed: others.",
    "planned": (
        "Planned pairs{effects}. Diamonds: effect in these worlds with its simultaneous interval, filled if decided. {dots}"
        "Thin lines: a new world."
    ),
    "cost": (
        "{metric} relative to {baseline} against time per step. The grey line joins the filters that no filter surpasses in both. "
        "Triangles lie beyond the axis, with their value."
    ),
    "calibration": (
        r"Coverage of 50 and 90\,\% regions over all conditions (left), and mean NEES divided by its expectation (right). "
        "Dashed: nominal values."
    ),
}


def format_methods(paragraphs: Sequence[str]) -> str:
    """Format the methods paragraph as LaTeX.

    Args:
        paragraphs: Plain text.
    """
    text = "\n\n".join(escape_latex(paragraph) for paragraph in paragraphs)
    text = text.replace(r" \%", r"\,\%")
    return text.replace("with pfbench in", f"with pfbench{cite([SELF])} in", 1) + "\n"


def format_caption(name: str, pack: Pack) -> str:
    """Format the caption of a figure.

    Args:
        name: Name of the figure.
        pack: Data of the report.
    """
    looks = {str(look["key"]): look for look in pack["filters"]}
    baseline = looks.get(str(pack["baselines"][0])) if pack["baselines"] else None
    regime = str(pack["regimes"][0]["name"]).lower()
    has_ratio, has_won = (bool(list_pairs(pack, has_won=won)) for won in (False, True))
    words = {
        "{effects}": ", by the share of runs won in percentage points where tracks are not kept" * has_won,
        "{dots}": "Dots: single worlds. " * has_ratio,
        "{metric}": escape_latex(str(pack["metrics"][0]["name"])),
        "{level}": f"{100 * (1 - float(pack['alpha'])):g}",
        "{regime}": escape_latex(regime),
        "{baseline}": "the baseline" if baseline is None else escape_latex(str(baseline["name"]))
        + cite([str(baseline.get("cite") or "")]),
    }  # fmt: skip
    text = CAPTIONS[name]
    for word, value in words.items():
        text = text.replace(word, value)
    rows = find_rows(pack).values()
    absent = sum(not is_number(row["ratio"]) for row in rows)
    is_ratio = name in ("leaderboard", "cost")
    return text + (
        f" {absent} of {len(rows)} filters have no error to compare in all conditions."
        if is_ratio and absent
        else ""
    )


def format_document(
    pack: Pack, page: PageFormat, figures: Mapping[str, bool], tables: Sequence[str]
) -> str:
    """Format paper.tex.

    Args:
        pack: Data of the report.
        page: Page format.
        figures: Names of the figures, and whether each is as wide as the text.
        tables: Names of the files of tables without suffix.

    Returns:
        The document. It needs the other files of its folder.
    """
    title, is_elsevier = escape_latex(str(pack["title"])), page.name == "elsevier"
    heading = [rf"\title{{{title}}}", r"\author{Authors}"]
    start = (
        ["\\begin{frontmatter}", *heading, "\\end{frontmatter}", "\\thispagestyle{plain}"]
        if is_elsevier
        else [*heading, "\\maketitle"]
    )
    sentence = next((view["sentence"] for view in pack["views"].values()), "")
    plain = str(sentence).replace("[[", "").replace("]]", "")
    cited = list_cited_keys(pack)
    methods = f"The methods are those of{cite(cited)}." if cited else ""
    narrow_first = sorted(figures.items(), key=lambda item: item[1])  # wide floats hold up others
    floats = [_format_figure(name, pack, is_wide) for name, is_wide in narrow_first]
    return "\n".join([
        f"% Written by pfbench for {escape_latex(page.name)}: {page.column:.1f} pt columns, {page.text:.1f} pt text",
        page.head, *_PACKAGES, r"\begin{document}", *start,
        r"\section{Experiments}", r"\input{methods.tex}", methods, "", r"\section{Results}", _MINUS.sub("$-$", escape_latex(plain)), "",
        *floats, *(rf"\input{{{name}.tex}}" for name in tables),
        rf"\bibliographystyle{{{page.bibliography}}}", r"\bibliography{pfbench}", r"\end{document}", "",
    ])  # fmt: skip


def _format_figure(name: str, pack: Pack, is_wide: bool) -> str:
    """Format a figure at its natural size, which is the exact width."""
    star = "*" if is_wide else ""
    return "\n".join([
        rf"\begin{{figure{star}}}[t]\centering", rf"\includegraphics{{{name}.pdf}}",
        rf"\caption{{{format_caption(name, pack)}}}\label{{fig:{name}}}", rf"\end{{figure{star}}}",
    ])  # fmt: skip
