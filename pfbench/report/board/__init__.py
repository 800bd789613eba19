"""Board of a study: what a report shows, decided once."""

from pfbench.report.board.entries import ViewKey, build_run_table
from pfbench.report.board.pack import build_pack, open_court, read_study

__all__ = [
    "ViewKey",
    "build_pack",
    "build_run_table",
    "open_court",
    "read_study",
]
