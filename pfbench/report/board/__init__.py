"""Board of a study: what a report shows, decided once."""

from pfbench.report.board.pack import build_pack
from pfbench.report.board.pack_entries import ViewKey
from pfbench.report.board.run_table import build_run_table
from pfbench.report.board.study_data import read_study

__all__ = [
    "ViewKey",
    "build_pack",
    "build_run_table",
    "read_study",
]
