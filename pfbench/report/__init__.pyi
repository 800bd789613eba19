"""Public names of `pfbench.report` and the modules that define them."""

from pfbench.report.board.decided_parts import (
    StudyFacts as StudyFacts,
    decide_parts as decide_parts,
)
from pfbench.report.board.pack_entries import cell_entries as cell_entries
from pfbench.report.board.robust_word import (
    compare_with_control as compare_with_control,
    find_robust_filters as find_robust_filters,
)
from pfbench.report.journal.headline import (
    is_equal_drawing as is_equal_drawing,
    write_headline as write_headline,
)
from pfbench.report.journal.page_format import find_page_format as find_page_format
from pfbench.report.journal.text_width import text_width as text_width
from pfbench.report.plots.figure_files import (
    FigureSpec as FigureSpec,
    render_palette_png as render_palette_png,
)
from pfbench.report.plots.paper.paper_specs import (
    PaperFigure as PaperFigure,
    PaperFigureInput as PaperFigureInput,
)
from pfbench.report.plots.plotting import (
    COLUMN as COLUMN,
    RC as RC,
    LineStyle as LineStyle,
    add_legend as add_legend,
    compute_jitter as compute_jitter,
    format_axis_label as format_axis_label,
    line_styles as line_styles,
    stacked_axes as stacked_axes,
)
from pfbench.report.stored_page import (
    PAGE_DATA as PAGE_DATA,
    read_page_data as read_page_data,
    rebuild_page as rebuild_page,
    write_page_data as write_page_data,
)
from pfbench.report.study_page import write_markdown as write_markdown
from pfbench.report.tuning_words import count_tuned as count_tuned
