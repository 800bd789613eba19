"""Board of a study: what a report shows, decided once."""

from pfbench.report.board.pack import build_pack
from pfbench.report.board.report_data import write_report_data
from pfbench.report.board.run_table import build_run_table
from pfbench.report.board.verdict_files import write_verdict_files

__all__ = ["build_pack", "build_run_table", "write_report_data", "write_verdict_files"]
