"""Folder of a paper: figures as PDF and PGF, tables, methods paragraph, references and document."""

from __future__ import annotations

import io
import shutil
from collections.abc import Callable, Iterable, Mapping

from matplotlib.figure import Figure

from pfbench.files.escapes import escape_latex
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.journal.document import format_document, format_methods
from pfbench.report.journal.figure_style import FigureSetting
from pfbench.report.journal.main_table import make_main_tables, make_supplement
from pfbench.report.journal.methods_text import write_methods
from pfbench.report.journal.page_format import POINTS_PER_INCH, SUPERSCRIPTS, PageFormat
from pfbench.report.journal.pair_table import make_cost_table, make_planned_table
from pfbench.report.journal.ratio_figures import (
    plot_error_against_cost,
    plot_leaderboard,
    plot_planned,
)
from pfbench.report.journal.references import renew_bibliography
from pfbench.report.journal.study_pack import ALL, Pack, find_rows, is_number, list_pairs
from pfbench.report.journal.table_layout import (
    LINE,
    LatexTable,
    fit_table,
    format_table,
    measure_table,
)
from pfbench.report.journal.time_figures import plot_calibration, plot_over_time

_CAPTION_LINES = 8
_PDF_METADATA = {"CreationDate": None, "ModDate": None, "Producer": "pfbench", "Creator": "pfbench"}

Plot = Callable[[Pack, FigureSetting], Figure]


def select_figures(pack: Pack) -> dict[str, Plot]:
    """Select the figures for which a study has data.

    Args:
        pack: Data of the report.

    Returns:
        Functions that draw them, by file name.
    """
    rows = find_rows(pack).values()
    has_ratio = any(is_number(row["ratio"]) for row in rows)
    has_cost = any(is_number(row["ratio"]) and is_number(row["ms"]) for row in rows)
    regime = str(pack["regimes"][0]["key"]) if pack["regimes"] else ""
    plots: dict[str, tuple[Plot, bool]] = {
        "leaderboard": (plot_leaderboard, has_ratio),
        "over_time": (plot_over_time, any(key[1] == regime for key in pack["curves"])),
        "planned": (plot_planned, any(list_pairs(pack, has_won=won) for won in (False, True))),
        "cost": (plot_error_against_cost, has_cost),
        "calibration": (plot_calibration, bool(pack["calibration"].get((ALL, ALL)))),
    }
    return {name: plot for name, (plot, is_present) in plots.items() if is_present}


def write_paper(
    pack: Pack,
    page: PageFormat,
    folder: RecordedFolder,
) -> list[str]:
    """Write the files of a paper except its data.

    Args:
        pack: Data of the report.
        page: Page format.
        folder: Target folder.

    Returns:
        Remarks for the user: tables in a supplement, and figures without PGF.

    Raises:
        ValueError: If a table does not fit the page. Nothing is written then.
    """
    tables = _format_tables(pack, page)
    plots = select_figures(pack)
    remarks = _list_remarks(pack, tables, plots)
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
    for name, text in tables.items():
        folder.write(f"{name}.tex", text)
    folder.write("methods.tex", format_methods(write_methods(pack)))
    folder.write("pfbench.bib", renew_bibliography(pack))
    main = [name for name in tables if "supplement" not in name]
    main.sort(key=lambda name: "{table*}" in tables[name])  # wide floats hold up others
    folder.write("paper.tex", format_document(pack, page, widths, main))
    if len(main) < len(tables):
        supplement = [name for name in tables if "supplement" in name]
        folder.write("supplement.tex", format_document(pack, page, {}, supplement))
    return remarks


def _list_remarks(pack: Pack, tables: Iterable[str], plots: Iterable[str]) -> list[str]:
    """List the tables of the supplement, and what is left out."""
    remarks = [f"{name}.tex has the intervals" for name in tables if "supplement" in name]
    if pack["planned"] and "planned" not in plots:
        remarks.append(
            "no planned pair has an effect, so that planned.pdf and table_planned.tex are left out"
        )
    return remarks


def draw_paper_figure(plot: Plot, pack: Pack, setting: FigureSetting) -> Figure:
    """Draw a figure in the settings of a page.

    Args:
        plot: Function that draws it.
        pack: Data of the report.
        setting: Setting of the figures.
    """
    with setting.applied():
        return plot(pack, setting)


def render_pdf(figure: Figure, page: PageFormat) -> bytes:
    """Render a figure as PDF of its exact size, with fonts as TrueType. Equal figures give equal bytes.

    Args:
        figure: Figure.
        page: Page format.
    """
    buffer = io.BytesIO()
    with FigureSetting(page).applied():
        figure.savefig(buffer, format="pdf", metadata=_PDF_METADATA)
    return buffer.getvalue()


def render_pgf(plot: Plot, pack: Pack, page: PageFormat) -> str:
    """Render a figure as PGF, whose text has the fonts of the document. It needs pdflatex.

    Args:
        plot: Function that draws it.
        pack: Data of the report.
        page: Page format.
    """
    setting, buffer = FigureSetting(page, escape_latex), io.StringIO()
    with setting.applied():
        plot(pack, setting).savefig(buffer, format="pgf")
    return buffer.getvalue().translate(SUPERSCRIPTS)


def _format_tables(pack: Pack, page: PageFormat) -> dict[str, str]:
    """Format all tables by file name; refuse those that do not fit."""
    planned = make_planned_table(pack)

    def fits(table: LatexTable) -> bool:
        return _find_width(table, page) is not None

    tables = [
        *make_main_tables(pack, fits), *([planned] if planned else []),
        make_cost_table(pack, _list_particles(pack)), *make_supplement(pack, fits),
    ]  # fmt: skip
    return {f"table_{table.name}": _format_fitting(table, page) for table in tables}


def _find_width(table: LatexTable, page: PageFormat) -> tuple[float, bool] | None:
    """Return the separation of columns, and whether a table spans the text; None if it does not fit."""
    for width, is_wide in ((page.column, False), (page.text, page.has_columns)):
        separation = fit_table(table, width)
        if separation is not None:
            return separation, is_wide
    return None


def _format_fitting(table: LatexTable, page: PageFormat) -> str:
    """Format a table for one column, or for the width of the text."""
    most = int(page.height / LINE) - _CAPTION_LINES
    if table.rows > most:
        raise ValueError(
            f"table_{table.name} must have at most {most} rows, got {table.rows}. "
            "Run a study of fewer filters: filter=a,b,c."
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
