"""Figures have exact widths and TrueType fonts, tables fit by computed and by TeX's widths, the paper compiles."""

import re
import shutil
import subprocess
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure
from page_packs import build_pack
from refusals import check_refused
from synthetic_results import study

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import provenance
from pfbench.report.journal import paper_folder
from pfbench.report.journal.figure_style import (
    JOURNALS,
    SUPERSCRIPTS,
    FigureSetting,
    find_page_format,
)
from pfbench.report.journal.main_table import (
    format_entry,
    make_main_tables,
    make_planned_table,
)
from pfbench.report.journal.paper_folder import (
    draw_paper_figure,
    render_pdf,
    render_pgf,
    select_figures,
)
from pfbench.report.journal.table_layout import (
    Column,
    LatexTable,
    fit_table,
    format_table,
    measure_table,
    text_cell,
    text_width,
)
from pfbench.report.methods_text import collect_methods_facts
from pfbench.results.conditions import Condition, load_conditions
from pfbench.results.paper_block import list_named_parts, read_paper_block

HOSTILE = {0: r"A_b%$#&{}~^\x", 1: "Kürzel α [2]", 2: "$x^2$ <b>|"}
needs_tex = pytest.mark.skipif(
    shutil.which("pdflatex") is None or shutil.which("kpsewhich") is None,
    reason="TeX is not installed: texlive-latex-recommended, -science, -publishers",
)


@pytest.fixture(scope="module")
def conditions(tmp_path_factory: pytest.TempPathFactory) -> list[Condition]:
    folder = tmp_path_factory.mktemp("paper")
    study(folder / "invented", runs=4, steps=5)
    return load_conditions("invented", folder)


def fits_always(table: LatexTable) -> bool:
    """Accept a table of any width."""
    return True


def write(
    folder: Path, pack: dict[str, Any], conditions: list[Condition], journal: str, width: str = ""
) -> list[str]:
    page = find_page_format(journal, width)
    pack["methods"] = collect_methods_facts(conditions) | {"particles": {}}
    pack["bibtex"] = provenance.format_bibliography(pack, conditions)
    with RecordedFolder(folder) as target:
        return paper_folder.write_paper(pack, page, target)


@pytest.mark.parametrize(
    ("journal", "width", "points"),
    [
        ("ieee", "", (252.0, 516.0)),
        ("elsevier", "", (256.07, 540.6)),
        ("", "300pt", (300.0, 300.0)),
    ],
)
def test_pdf_has_the_exact_width_and_truetype_fonts(
    journal: str, width: str, points: tuple[float, float]
) -> None:
    page = find_page_format(journal, width)
    pack = build_pack(4, 2, 1, runs=5, instants=10, carried=0, names=HOSTILE)
    plots = select_figures(pack)
    for name, expected in (("leaderboard", points[0]), ("over_time", points[1])):
        figure = draw_paper_figure(plots[name], pack, FigureSetting(page))
        content = render_pdf(figure, page)
        box = re.search(rb"/MediaBox \[ 0 0 ([\d.]+) ", content)
        assert box
        assert float(box[1]) / 72 * 72.27 == pytest.approx(expected, abs=0.01)
        assert b"/Type3" not in content
        assert b"/CIDFontType2" in content
        again = draw_paper_figure(plots[name], pack, FigureSetting(page))
        assert content == render_pdf(again, page)


LONG = {k: f"EKF {k} (tuned on a world with other settings) [{k}]" for k in range(12)}


def test_long_names_leave_room_for_the_axes_and_captions_say_where_filters_were_tuned() -> None:
    page, setting = find_page_format("ieee"), FigureSetting(find_page_format("ieee"))
    pack = paper_folder.shorten_names(
        build_pack(12, 2, 1, runs=5, instants=10, carried=0, names=LONG)
    )
    assert pack["filters"][3]["name"] == "EKF 3 (tuned elsewhere) [3]"
    for name, plot in select_figures(pack).items():
        with warnings.catch_warnings():
            warnings.simplefilter("error")  # of axes without a size
            figure = draw_paper_figure(plot, pack, setting)
            with setting.applied():
                figure.draw_without_rendering()
        width = sum(axis.get_window_extent().width for axis in figure.axes[:2])
        assert width > 0.35 * figure.bbox.width, name
        caption = paper_folder.format_caption(name, pack)
        assert "Tuned elsewhere: on a world with other settings." in caption
    assert "Shown: 9 of 12 filters." in paper_folder.format_caption("over_time", pack)
    plain = build_pack(3, 2, 1, runs=5, instants=10, carried=0)
    text = paper_folder.format_caption("over_time", paper_folder.shorten_names(plain))
    assert "Shown" not in text
    assert "Tuned" not in text
    assert page.column == 252.0


def test_a_filter_that_diverges_leaves_the_axis_of_time_to_the_others() -> None:
    pack = build_pack(4, 1, 1, runs=5, instants=10, carried=0)
    curves = next(iter(pack["curves"].values()))["filters"]
    first, *others = curves
    curves[first]["median"] = [1e30] * len(curves[first]["median"])
    plot, setting = select_figures(pack)["over_time"], FigureSetting(find_page_format("ieee"))
    (axis,) = draw_paper_figure(plot, pack, setting).axes
    best = min(float(np.median(curves[key]["median"])) for key in others)
    assert axis.get_ylim()[1] <= 1.01e4 * best
    assert axis.get_ylim()[0] <= best


def test_the_figures_of_the_paper_are_in_the_export(
    conditions: list[Condition], tmp_path: Path
) -> None:
    pack = build_pack(3, 1, 1, runs=3, instants=4, carried=0)
    pack["methods"] = collect_methods_facts(conditions) | {"particles": {}}
    pack["bibtex"] = provenance.format_bibliography(pack, conditions)
    drawings = {
        "paper_1_a.pdf": ("Figure 1: 80 % of runs.", b"%PDF"), "paper_2.svg": ("Figure 2.", b"<svg/>"),
    }  # fmt: skip
    with RecordedFolder(tmp_path) as target:
        remarks = paper_folder.write_paper(pack, find_page_format("ieee"), target, drawings)
    text = (tmp_path / "paper.tex").read_text()
    assert r"\includegraphics[width=\columnwidth]{paper_1_a.pdf}" in text
    assert r"\caption{Figure 1: 80 \% of runs.}" in text
    assert r"\IfFileExists{paper_2.pdf}" in text
    assert text.index("leaderboard.pdf") < text.index("paper_1_a.pdf") < text.index("paper_2")
    assert (tmp_path / "paper_1_a.pdf").read_bytes() == b"%PDF"
    assert any("convert them to PDF" in remark for remark in remarks)


def test_millimetres_are_converted() -> None:
    assert find_page_format(width="254mm").column == pytest.approx(722.7)
    assert JOURNALS["springer"].text == pytest.approx(174 / 25.4 * 72.27)


@pytest.mark.parametrize(
    ("journal", "width", "advice"),
    [
        (
            "nature",
            "",
            "journal must be one of ieee, elsevier, springer, got nature. Use width=120mm",
        ),
        ("", "", "journal or width must be set, got none"),
        ("ieee", "90mm", "got journal=ieee and width=90mm"),
        ("", "120", "width must be 60mm to 400mm, in mm or pt, got 120"),
        ("", "5mm", "got 5mm"),
    ],
)
def test_advice_of_page_formats(journal: str, width: str, advice: str) -> None:
    check_refused([(re.escape(advice), lambda: find_page_format(journal, width))], remedy=False)


def test_each_noise_regime_has_a_table() -> None:
    def sizes(worlds: int, regimes: int) -> list[int]:
        pack = build_pack(3, worlds, regimes, runs=3, instants=4, carried=0)
        return [len(table.columns) for table in make_main_tables(pack, fits_always)]

    assert sizes(4, 1) == [9]
    assert sizes(5, 2) == [11, 11]


def test_a_table_that_does_not_fit_is_refused_with_advice(
    conditions: list[Condition], tmp_path: Path
) -> None:
    wide = build_pack(3, 1, 1, runs=3, instants=4, carried=0, names={0: "long name " * 9})
    check_refused(
        [
            (
                r"table_main must fit 252 pt, got \d+ pt. Use a wider",
                lambda: write(tmp_path / "paper", wide, conditions, "", "252pt"),
            )
        ],
        remedy=False,
    )
    assert not list(tmp_path.rglob("*.tex"))
    high = build_pack(70, 1, 1, runs=3, instants=4, carried=0)
    check_refused(
        [
            (
                r"at most 63 rows, got 72. Run a study of fewer filters",
                lambda: write(tmp_path / "paper", high, conditions, "ieee"),
            )
        ],
        remedy=False,
    )


def test_worlds_that_do_not_fit_are_split_and_none_is_left_out() -> None:
    """Any law of widths: here at most three worlds in a table."""
    pack = build_pack(3, 8, 1, runs=3, instants=4, carried=0)
    whole = make_main_tables(pack, fits_always)
    parts = make_main_tables(pack, lambda table: len(table.columns) <= 1 + 2 * 3)
    assert [table.name for table in whole] == ["main"]
    assert [table.name for table in parts] == ["main_1", "main_2", "main_3"]
    heads = [cell.tex for table in parts for cell in table.head[-1][1:]]
    assert heads == [cell.tex for cell in whole[0].head[-1][1:]]
    for row, *others in zip(whole[0].groups[0], *(table.groups[0] for table in parts), strict=True):
        assert row[1:] == [cell for other in others for cell in other[1:]]


@pytest.mark.parametrize("kind", ["over_time", "cost"])
@pytest.mark.parametrize("journal", JOURNALS)
def test_a_legend_is_within_its_figure(journal: str, kind: str) -> None:
    names = {i: f"A method with a long name {i}" for i in range(9)}
    pack = build_pack(9, 1, 1, runs=5, instants=10, carried=0, names=names)
    figure = draw_paper_figure(
        select_figures(pack)[kind], pack, FigureSetting(find_page_format(journal))
    )
    figure.draw_without_rendering()
    box = figure.legends[0].get_window_extent()
    assert 0 <= box.x0 <= box.x1 <= figure.bbox.width
    assert 0 <= box.y0 <= box.y1 <= figure.bbox.height
    assert len(figure.legends[0].get_texts()) == 9


def test_a_ratio_that_differs_from_one_is_not_printed_as_one() -> None:
    pack = build_pack(3, 1, 1, runs=3, instants=4, carried=0)
    pair = pack["planned"][0] | {"estimate": 0.95, "low": 0.9, "high": 0.9989, "word": "better"}
    table = make_planned_table({**pack, "planned": [pair]})
    assert table is not None
    assert [cell.tex for cell in table.groups[0][1]][1:3] == [r"\textbf{0.95}", "{[}0.90, 0.999]"]


def test_bold_is_the_smallest_printed_number_and_worse_has_a_dagger() -> None:
    pack = build_pack(3, 1, 1, runs=3, instants=4, carried=0)
    rows = pack["views"]["rmse", "w0", "r0", "f0"]["rows"]
    values = [(1.2344, "better"), (1.2341, "not decided"), (9.0, "worse")]
    for row, (value, verdict) in zip(rows, values, strict=True):
        row |= {"value": value, "low": value / 2, "high": 2 * value, "verdict": verdict}
    rows[2]["lost"] = 4
    table = make_main_tables(pack, fits_always)[0]
    cells = {row[0].tex: row[1].tex for group in table.groups for row in group}
    assert sum(tex.startswith(r"\textbf{1.23}") for tex in cells.values()) == 2
    (worse,) = (tex for tex in cells.values() if "textdagger}}}" in tex and "black!62" in tex)
    assert r"\num{9.00}" in worse
    name = next(f["name"] for f in pack["filters"] if f["key"] == rows[2]["filter"])
    assert f"Lost runs, which are worse than all others: {name} 4." in table.caption


def test_lost_and_missing_entries_are_words() -> None:
    pack = build_pack(4, 2, 1, runs=3, instants=4, carried=0, lost=[3], missing=[(1, 0, 0)])
    for view in pack["views"].values():  # of worlds without a limit
        for row in view["rows"]:
            row["value"] = None if row["filter"] == "f3" else row["value"]
    text = format_table(make_main_tables(pack, fits_always)[0], 3.0, is_wide=True)
    assert "lost" in text
    assert "--" in text
    assert "nan" not in text
    assert "None" not in text


def test_errors_have_three_digits() -> None:
    values = [0.0123456, 1.0, 12.34, 99.96, 123.4, 123456.0, 2.5e7, None, float("inf")]
    printed = [format_entry(value) for value in values]
    assert printed == ["0.0123", "1.00", "12.3", "100", "123", "123000", "2.50e7", "--", "--"]


def test_a_spanning_head_widens_the_last_column() -> None:
    wide = text_cell("M" * 20, span=2)
    rows = [[[text_cell("a"), text_cell("b"), text_cell("c")]]]
    table = LatexTable("t", "", [Column("l")] * 3, [[text_cell(""), wide]], rows)
    separation = 4.0
    assert wide.width == pytest.approx(20 * 0.889 * 8, rel=1e-3)
    a = text_width("a", 8.0)
    assert measure_table(table, separation) == pytest.approx(a + 2 * separation + wide.width)
    assert fit_table(table, 20.0) is None


@needs_tex
def test_the_paper_compiles_without_overfull_boxes(
    conditions: list[Condition], tmp_path: Path
) -> None:
    """IEEE with hostile names, and TeX's width of the main table against the computed one."""
    pack = build_pack(6, 3, 2, runs=5, instants=10, carried=0, names=HOSTILE, lost=[5])
    for look, key in zip(pack["filters"], ("gordon1993", "cofm2024", "musso2001"), strict=False):
        look["cite"] = key
    write(tmp_path, pack, conditions, "ieee")
    table = (tmp_path / "table_main.tex").read_text()
    (computed,) = re.findall(r"rows, ([\d.]+) pt wide", table)
    tabular = re.search(r"(\\fontsize.*\\end\{tabular\})", table, re.DOTALL)
    assert tabular
    paper = (tmp_path / "paper.tex").read_text()
    measure = f"\\begin{{document}}\n\\sbox0{{{tabular[1]}}}\\typeout{{WIDTH \\the\\wd0}}\n"
    (tmp_path / "paper.tex").write_text(paper.replace("\\begin{document}", measure, 1))
    for program in ("pdflatex", "bibtex", "pdflatex", "pdflatex"):
        words = [program, "-interaction=nonstopmode"] if program != "bibtex" else [program]
        subprocess.run(
            [*words, "paper"], cwd=tmp_path, capture_output=True, check=False, timeout=60
        )
    log = (tmp_path / "paper.log").read_text(errors="replace")
    assert "Output written on paper.pdf" in log
    assert [line for line in log.splitlines() if line.startswith(("Overfull", "!"))] == []
    assert "Citation" not in log
    width = re.search(r"WIDTH ([\d.]+)pt", log)
    assert width
    assert float(width[1]) == pytest.approx(float(computed), rel=0.01)


@needs_tex
@pytest.mark.slow
@pytest.mark.parametrize(("journal", "width"), [("elsevier", ""), ("springer", ""), ("", "120mm")])
def test_other_formats_compile(
    conditions: list[Condition], tmp_path: Path, journal: str, width: str
) -> None:
    write(tmp_path, build_pack(9, 2, 2, runs=5, names=HOSTILE), conditions, journal, width)
    for _ in range(2):
        subprocess.run(
            ["pdflatex", "-interaction=nonstopmode", "paper"],
            cwd=tmp_path, capture_output=True, check=False, timeout=60,
        )  # fmt: skip
    log = (tmp_path / "paper.log").read_text(errors="replace")
    assert [line for line in log.splitlines() if line.startswith(("Overfull", "!"))] == []


def test_each_reference_of_a_filter_has_an_entry_and_each_entry_a_filter() -> None:
    blocks = [read_paper_block("filter", name) for name in list_named_parts("filter")]
    cited = {block["cite"] for block in blocks if block.get("cite")}
    bib = (Path(provenance.__file__).with_name("methods.bib")).read_text()
    assert set(re.findall(r"^@\w+\{(\w+),", bib, re.MULTILINE)) == cited
    assert bib.isascii()
    for entry in re.findall(r"^@.*?^\}", bib, re.MULTILINE | re.DOTALL):
        assert "title = {" in entry
        assert "year = {" in entry or "note = {" in entry


@pytest.mark.parametrize("journal", JOURNALS)
@pytest.mark.filterwarnings("error")
def test_powers_of_ten_have_all_glyphs(journal: str) -> None:
    def plot(_: Any, setting: FigureSetting) -> Figure:
        figure = setting.make_figure(1.0)
        figure.text(0.1, 0.5, f"10{''.join(map(chr, SUPERSCRIPTS))}")
        return figure

    page = JOURNALS[journal]
    figure = draw_paper_figure(plot, {}, FigureSetting(page))
    assert render_pdf(figure, page).startswith(b"%PDF")
    if shutil.which("pdflatex"):
        text = render_pgf(plot, {}, page)
        assert r"10\textsuperscript{-}\textsuperscript{0}" in text
        assert not set(map(chr, SUPERSCRIPTS)) & set(text)


@needs_tex
def test_the_width_of_a_percent_sign_is_that_of_tex(tmp_path: Path) -> None:
    lines = [r"\documentclass[journal]{IEEEtran}", r"\usepackage[T1]{fontenc}", r"\begin{document}",
             r"\fontsize{8}{9.6}\selectfont\setbox0\hbox{\%}\typeout{WIDTH \the\wd0}", r"\end{document}"]  # fmt: skip
    (tmp_path / "a.tex").write_text("\n".join(lines))
    words = ["pdflatex", "-interaction=nonstopmode", "a"]
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, check=False)
    (width,) = re.findall(r"^WIDTH ([\d.]+)pt", done.stdout, re.MULTILINE)
    assert text_width("%", 8.0) == pytest.approx(float(width), abs=0.01)
