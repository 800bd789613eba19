"""Reports of studies and datasheets of scenarios.

The public names of this folder are imported on first use.
"""

from pfbench.core.lazy_import import lazy_attributes

__getattr__, __dir__ = lazy_attributes(
    __name__,
    {
        "journal.headline": (
            "HEADLINE",
            "render_headline",
        ),
        "journal.page_format": ("find_page_format",),
        "journal.text_width": ("text_width",),
        "plots.figure_files": ("render_palette_png",),
        "plots.plotting": (
            "COLUMN",
            "RC",
            "add_legend",
            "compute_jitter",
            "line_styles",
        ),
        "stored_page": (
            "PAGE_DATA",
            "read_page_data",
            "write_page_data",
        ),
        "study_page": ("write_markdown",),
    },
)

__all__ = __dir__()
