"""Command `pfbench open`: show the report of a study in a browser, and write it if it is missing."""

from __future__ import annotations

import webbrowser
from collections.abc import Sequence
from pathlib import Path

from pfbench.cli.command import Command
from pfbench.cli.compose import compose_study
from pfbench.cli.report import report_study


def open_report(words: Sequence[str]) -> None:
    """Show the report of a study, and write it if results are newer."""
    values = compose_study(words).values
    page = Path(values["reports_dir"]) / values["study"] / "index.html"
    files = (Path(values["results_dir"]) / values["study"]).glob("*.npz")
    newest = max((file.stat().st_mtime for file in files), default=0.0)
    if not page.is_file() or page.stat().st_mtime < newest:
        report_study(words)
    print(f"page: {page.resolve()}")
    if not webbrowser.open(page.resolve().as_uri()):
        print("No browser was found. Open the page by its path.")


COMMAND = Command(
    open_report,
    """\
pfbench open study=NAME [results_dir=FOLDER] [reports_dir=FOLDER]

Show the report of a study in a browser. It is written first if it is missing or older than the newest result.

  pfbench open study=quickstart""",
    keys=("study", "results_dir", "reports_dir"),
    required=("study",),
)
