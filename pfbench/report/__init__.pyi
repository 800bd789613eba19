"""Public names of `pfbench.report` and the modules that define them."""

from pfbench.report.board.entries import (
    StudyFacts as StudyFacts,
    cell_entries as cell_entries,
)
from pfbench.report.board.pack import decide_parts as decide_parts
from pfbench.report.journal.figure_style import find_page_format as find_page_format
from pfbench.report.journal.ratio_figures import (
    is_equal_drawing as is_equal_drawing,
    render_headline as render_headline,
)
from pfbench.report.journal.table_layout import text_width as text_width
from pfbench.report.options import ReportOptions as ReportOptions
from pfbench.report.overview.page import (
    count_better_worlds as count_better_worlds,
    render_overview as render_overview,
    tabulate_heat_map as tabulate_heat_map,
)
from pfbench.report.papers.plots import CurveLook as CurveLook
from pfbench.report.papers.specs import (
    PaperFigure as PaperFigure,
    PaperFigureInput as PaperFigureInput,
)
from pfbench.report.stored_study import (
    RUNS_FILE as RUNS_FILE,
    format_runs as format_runs,
    read_stored_study as read_stored_study,
)
from pfbench.report.study_page.page_writer import render_page as render_page
from pfbench.report.study_report import (
    find_overviews as find_overviews,
    rebuild_page as rebuild_page,
    render_study as render_study,
    write_report as write_report,
)
from pfbench.results.looks import count_tuned as count_tuned
from pfbench.results.plotting import (
    COLUMN as COLUMN,
    RC as RC,
    FigureSpec as FigureSpec,
    LineStyle as LineStyle,
    add_legend as add_legend,
    draw_figure as draw_figure,
    format_axis_label as format_axis_label,
    line_styles as line_styles,
    render_palette_png as render_palette_png,
    stacked_axes as stacked_axes,
)
from pfbench.stats.court import find_lost_conditions as find_lost_conditions
