"""Board of a study: what a report shows, decided once."""

from pfbench.report.board.entries import ViewKey, build_run_table
from pfbench.report.board.pack import arrange_study, build_pack, read_study

__all__ = [
    "ViewKey",
    "arrange_study",
    "build_pack",
    "build_run_table",
    "read_study",
]
