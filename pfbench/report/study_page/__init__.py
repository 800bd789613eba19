"""The page of a report."""

from pfbench.report.study_page.page_writer import render_markdown, render_page

__all__ = ["render_markdown", "render_page"]
