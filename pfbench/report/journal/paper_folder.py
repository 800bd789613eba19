"""Folder of a paper: figures as PDF and PGF, tables, methods paragraph, references and document."""

from __future__ import annotations

import io
import re
import shutil
from collections.abc import Callable, Mapping, Sequence

from matplotlib.figure import Figure

from pfbench.core.parameter_checks import require
from pfbench.files.escapes import escape_latex
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.journal.figure_style import (
    POINTS_PER_INCH,
    SUPERSCRIPTS,
    FigureSetting,
    PageFormat,
)
from pfbench.report.journal.main_table import (
    make_cost_table,
    make_main_tables,
    make_planned_table,
)
from pfbench.report.journal.ratio_figures import (
    plot_error_against_cost,
    plot_leaderboard,
    plot_planned,
)
from pfbench.report.journal.study_pack import (
    ALL,
    Pack,
    filters_by_key,
    find_rows,
    is_number,
    list_pairs,
    name_baseline,
)
from pfbench.report.journal.table_layout import (
    LINE,
    LatexTable,
    fit_table,
    format_table,
    measure_table,
)
from pfbench.report.journal.time_figures import (
    plot_calibration,
    plot_over_time,
    select_curves,
    select_worlds,
)
from pfbench.report.methods_text import write_methods
from pfbench.report.provenance import SELF, cite, list_cited_keys, renew_bibliography

_CAPTION_LINES = 8
_TUNED_ON = re.compile(r"\(tuned on ([^)]*)\)")
_PDF_METADATA = {"CreationDate": None, "ModDate": None, "Producer": "pfbench", "Creator": "pfbench"}

Plot = Callable[[Pack, FigureSetting], Figure]


def select_figures(pack: Pack) -> dict[str, Plot]:
    """Select the figures for which a study has data.

    Returns functions that draw them, by file name.
    """
    rows = find_rows(pack).values()
    has_ratio = any(is_number(row["ratio"]) for row in rows)
    regime = str(pack["regimes"][0]["key"]) if pack["regimes"] else ""
    plots: dict[str, tuple[Plot, bool]] = {
        "leaderboard": (plot_leaderboard, has_ratio),
        "over_time": (plot_over_time, any(key[1] == regime for key in pack["curves"])),
        "planned": (plot_planned, bool(list_pairs(pack))),
        "cost": (
            plot_error_against_cost,
            any(is_number(row["ratio"]) and is_number(row["ms"]) for row in rows),
        ),
        "calibration": (plot_calibration, bool(pack["calibration"].get((ALL, ALL)))),
    }
    return {name: plot for name, (plot, is_present) in plots.items() if is_present}


def write_paper(
    pack: Pack,
    page: PageFormat,
    folder: RecordedFolder,
    drawings: Mapping[str, tuple[str, str | bytes]] | None = None,
) -> list[str]:
    """Write the files of a paper except its data.

    Args:
        pack: Data of the page.
        page: Format of the journal.
        folder: Folder of the paper.
        drawings: Caption and content by file name of the figures of the paper of the study, PDF or SVG.

    Returns remarks for the user: what is left out, and figures without PGF.
    """
    pack = shorten_names(pack)
    tables = _format_tables(pack, page)
    plots = select_figures(pack)
    remarks = []
    if pack["planned"] and "planned" not in plots:
        remarks.append(
            "no pair compared in advance has a ratio, so that planned.pdf and table_planned.tex are left out"
        )
    widths = _write_plots(plots, pack, page, folder, remarks)
    figures = drawings or {}
    if any(name.endswith(".svg") for name in figures):
        remarks.append(
            "the figures of the paper are SVG, since there are no results: convert them to PDF"
        )
    main = sorted(tables, key=lambda name: "{table*}" in tables[name])  # wide floats hold up others
    captions = {name: caption for name, (caption, _) in figures.items()}
    files = {
        **{f"{name}.tex": text for name, text in tables.items()},
        "methods.tex": format_methods(write_methods(pack)),
        "pfbench.bib": renew_bibliography(pack),
        **{name: content for name, (_, content) in figures.items()},
        "paper.tex": format_document(pack, page, widths, main, captions),
    }
    for name, content in files.items():
        folder.write(name, content)
    return remarks


def _write_plots(
    plots: Mapping[str, Plot],
    pack: Pack,
    page: PageFormat,
    folder: RecordedFolder,
    remarks: list[str],
) -> dict[str, bool]:
    """Write the figures of a study, with PGF where pdflatex is there; return by name which need two columns."""
    has_latex = shutil.which("pdflatex") is not None
    widths = {}
    for name, plot in plots.items():
        figure = draw_paper_figure(plot, pack, FigureSetting(page))
        widths[name] = float(figure.get_size_inches()[0]) * POINTS_PER_INCH > page.column + 1
        folder.write(f"{name}.pdf", render_pdf(figure, page))
        if has_latex:
            folder.write(f"{name}.pgf", render_pgf(plot, pack, page))
    if not has_latex:
        remarks.append("figures are PDF only: PGF needs pdflatex")
    return widths


def shorten_names(pack: Pack) -> Pack:
    """Return the data of a study whose filters that were tuned on other data are named so; captions say on which."""
    data = dict.fromkeys(text for look in pack["filters"] for text in _TUNED_ON.findall(look["name"]))  # fmt: skip
    looks = [{**look, "name": _TUNED_ON.sub("(tuned elsewhere)", look["name"])} for look in pack["filters"]]  # fmt: skip
    return {**pack, "filters": looks, "tuned_elsewhere": list(data)}


def _describe_tuning(pack: Pack) -> str:
    """Say on which data filters were tuned that are named so; empty without any."""
    data = pack.get("tuned_elsewhere", ())
    return f" Tuned elsewhere: on {escape_latex(', '.join(data))}." if data else ""


def draw_paper_figure(plot: Plot, pack: Pack, setting: FigureSetting) -> Figure:
    """Draw a figure in the settings of a page."""
    with setting.applied():
        return plot(pack, setting)


def render_pdf(figure: Figure, page: PageFormat) -> bytes:
    """Render a figure as PDF of its exact size, with fonts as TrueType. Equal figures give equal bytes."""
    buffer = io.BytesIO()
    with FigureSetting(page).applied():
        figure.savefig(buffer, format="pdf", metadata=_PDF_METADATA)
    return buffer.getvalue()


def render_pgf(plot: Plot, pack: Pack, page: PageFormat) -> str:
    """Render a figure as PGF, whose text has the fonts of the document. It needs pdflatex."""
    setting, buffer = FigureSetting(page, escape_latex), io.StringIO()
    with setting.applied():
        plot(pack, setting).savefig(buffer, format="pgf")
    return buffer.getvalue().translate(SUPERSCRIPTS)


def _format_tables(pack: Pack, page: PageFormat) -> dict[str, str]:
    """Format all tables by file name; refuse those that do not fit."""
    planned = make_planned_table(pack)

    tables = [
        *make_main_tables(pack, lambda table: _find_width(table, page) is not None),
        *([planned] if planned else []),
        make_cost_table(pack, _list_particles(pack)),
    ]
    note = _describe_tuning(pack)
    return {
        f"table_{table.name}": _format_fitting(table._replace(caption=table.caption + note), page)
        for table in tables
    }


def _find_width(table: LatexTable, page: PageFormat) -> tuple[float, bool] | None:
    """Return the separation of columns, and whether a table spans the text; None if it does not fit."""
    widths = ((page.column, False), (page.text, page.has_columns))
    fitting = ((fit_table(table, width), is_wide) for width, is_wide in widths)
    return next(((gap, is_wide) for gap, is_wide in fitting if gap is not None), None)


def _format_fitting(table: LatexTable, page: PageFormat) -> str:
    """Format a table for one column, or for the width of the text."""
    most = int(page.height / LINE) - _CAPTION_LINES
    require(
        table.rows <= most,
        f"table_{table.name}",
        f"have at most {most} rows",
        table.rows,
        "Run a study of fewer filters: filter=a,b,c.",
    )
    width = _find_width(table, page)
    if width is None:
        raise ValueError(
            f"table_{table.name} must fit {page.text:.0f} pt, got {measure_table(table, 2.4):.0f} pt. "
            "Use a wider page (width=...)."
        )
    return format_table(table, width[0], is_wide=width[1])


def _list_particles(pack: Pack) -> Mapping[str, str]:
    """Return the numbers of particles by filter; several numbers as a range."""
    texts = {str(note["filter"]): str(note["particles"]) for note in pack["filter_notes"]}
    numbers = {key: sorted(map(int, text.split(" or "))) for key, text in texts.items() if text}
    return {
        key: "--".join(map(str, dict.fromkeys((values[0], values[-1]))))
        for key, values in numbers.items()
    }


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
        "{metric} relative to {baseline} over paired runs, with simultaneous {level}\\,\\% intervals. "
        r"Filled: proposed methods. $^\dagger$: shown to be worse than {baseline}. Triangles lie beyond the axis."
    ),
    "over_time": "Median error over runs in time, {regime}. Filled and solid: proposed methods; hollow and dashed: others.",
    "planned": (
        "Pairs compared in advance. Diamonds: effect in these worlds with its simultaneous interval, filled if decided. {dots}"
        "Thin lines: a new world."
    ),
    "cost": (
        "{metric} relative to {baseline} against time per step. The grey line joins the filters that no filter surpasses in both. "
        "Triangles lie beyond the axis, with their value."
    ),
    "calibration": (
        r"Coverage of 50 and 90\,\% intervals over all conditions (left), and mean NEES divided by its expectation (right). "
        "Dashed: nominal values."
    ),
}


def format_methods(paragraphs: Sequence[str]) -> str:
    """Format the methods paragraph as LaTeX."""
    text = "\n\n".join(escape_latex(paragraph) for paragraph in paragraphs)
    text = text.replace(r" \%", r"\,\%")
    return text.replace("with pfbench in", f"with pfbench{cite([SELF])} in", 1) + "\n"


def format_caption(name: str, pack: Pack) -> str:
    """Format the caption of a figure."""
    baselines = [filters_by_key(pack)[str(key)] for key in pack["baselines"][:1]]
    text = CAPTIONS[name].format(
        dots="Dots: single worlds. " * bool(list_pairs(pack)),
        metric=escape_latex(str(pack["metrics"][0]["name"])),
        level=f"{100 * (1 - float(pack['alpha'])):g}",
        regime=escape_latex(str(pack["regimes"][0]["name"]).lower()),
        baseline=escape_latex(name_baseline(pack))
        + cite([str(look.get("cite") or "") for look in baselines]),
    )
    text += _describe_tuning(pack)
    if name == "over_time":
        selections = {"filters": select_curves(pack), "worlds": select_worlds(pack)}
        return text + "".join(
            f" Shown: {len(some)} of {len(pack[noun])} {noun}."
            for noun, some in selections.items()
            if len(some) < len(pack[noun])
        )
    rows = find_rows(pack).values()
    absent = sum(not is_number(row["ratio"]) for row in rows)
    if name in ("leaderboard", "cost") and absent:
        text += f" {absent} of {len(rows)} filters have no error to compare in all conditions."
    return text


def format_document(
    pack: Pack,
    page: PageFormat,
    figures: Mapping[str, bool],
    tables: Sequence[str],
    captions: Mapping[str, str] | None = None,
) -> str:
    """Format paper.tex; captions by file name of the figures of the paper of the study.

    Returns the document. It needs the other files of its folder.
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
        *(_format_drawing(name, caption) for name, caption in (captions or {}).items()),
        rf"\bibliographystyle{{{page.bibliography}}}", r"\bibliography{pfbench}", r"\end{document}", "",
    ])  # fmt: skip


def _format_drawing(name: str, caption: str) -> str:
    """Format a figure of the paper of the study in the width of a column."""
    stem, _, suffix = name.rpartition(".")
    drawing = rf"\includegraphics[width=\columnwidth]{{{stem}.pdf}}"
    if suffix != "pdf":  # the paper compiles before the drawing is converted
        drawing = rf"\IfFileExists{{{stem}.pdf}}{{{drawing}}}{{{escape_latex(f'Convert {name} to PDF.')}}}"
    return "\n".join([
        r"\begin{figure}[t]\centering", drawing,
        rf"\caption{{{_MINUS.sub('$-$', escape_latex(caption))}}}\label{{fig:{stem}}}", r"\end{figure}",
    ])  # fmt: skip


def _format_figure(name: str, pack: Pack, is_wide: bool) -> str:
    """Format a figure at its natural size, which is the exact width."""
    star = "*" if is_wide else ""
    return "\n".join([
        rf"\begin{{figure{star}}}[t]\centering", rf"\includegraphics{{{name}.pdf}}",
        rf"\caption{{{format_caption(name, pack)}}}\label{{fig:{name}}}", rf"\end{{figure{star}}}",
    ])  # fmt: skip
