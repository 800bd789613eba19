"""The page of a report."""

from pfbench.report.study_page.page_writer import write_page

__all__ = ["write_page"]
