"""The page of a report."""

from pfbench.report.study_page.page_writer import write_markdown, write_page

__all__ = ["write_markdown", "write_page"]
