"""Public names of `pfbench.report` and the modules that define them."""

from pfbench.report.board.entries import cell_entries as cell_entries
from pfbench.report.board.pack import StudyFacts as StudyFacts, decide_parts as decide_parts
from pfbench.report.board.robust_word import (
    compare_with_control as compare_with_control,
    find_robust_filters as find_robust_filters,
)
from pfbench.report.journal.figure_style import find_page_format as find_page_format
from pfbench.report.journal.ratio_figures import (
    is_equal_drawing as is_equal_drawing,
    write_headline as write_headline,
)
from pfbench.report.journal.table_layout import text_width as text_width
from pfbench.report.options import ReportOptions as ReportOptions
from pfbench.report.overview.page import write_overview as write_overview
from pfbench.report.papers.specs import (
    PaperFigure as PaperFigure,
    PaperFigureInput as PaperFigureInput,
)
from pfbench.report.study_page import write_markdown as write_markdown
from pfbench.report.study_report import (
    PAGE_DATA as PAGE_DATA,
    find_overviews as find_overviews,
    read_page_data as read_page_data,
    rebuild_page as rebuild_page,
    write_page_data as write_page_data,
    write_report as write_report,
)
from pfbench.results.looks import count_tuned as count_tuned
from pfbench.results.plotting import (
    COLUMN as COLUMN,
    RC as RC,
    FigureSpec as FigureSpec,
    LineStyle as LineStyle,
    add_legend as add_legend,
    compute_jitter as compute_jitter,
    format_axis_label as format_axis_label,
    line_styles as line_styles,
    render_palette_png as render_palette_png,
    stacked_axes as stacked_axes,
)
