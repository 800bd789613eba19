"""Command `pfbench paper`: write figures, tables and text of a study for a journal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pfbench import report
from pfbench.cli.command import Command, Option
from pfbench.cli.compose import compose_study
from pfbench.cli.report import check_has_results, find_page_data, make_report_options
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.job.config import JobConfig


def write_study_paper(words: Sequence[str], journal: str, width: str) -> None:
    """Write the paper export of a study."""
    from pfbench.report.journal.paper_folder import write_paper
    from pfbench.report.study_report import format_verdicts

    page = report.find_page_format(journal, width)
    config = compose_study(words)
    study, reports = config.values["study"], Path(config.values["reports_dir"])
    RecordedFolder(reports / study, is_complete=False)  # refuses a link
    stored = find_page_data(config, words)
    if stored is None:
        check_has_results(study, Path(config.values["results_dir"]))
    pack, table, files = _read_study(config, stored)
    drawings = {
        Path(entry["file"]).name: (entry["caption"], files[entry["file"]])
        for entry in pack["paper_figures"]
    }
    with RecordedFolder(reports / study / "paper") as folder:
        remarks = write_paper(pack, page, folder, drawings)
        folder.write("verdicts.csv", format_verdicts(pack))
        folder.write(report.RUNS_FILE, report.format_runs(table, {**pack, "paper_figures": ()}))
    if stored is not None:
        print(f"note: without results, the paper is made of {stored}")
    for remark in remarks:
        print(f"note: {remark}")
    print(f"paper: {(folder.path / 'paper.tex').resolve()}")


def _read_study(
    config: JobConfig, stored: Path | None
) -> tuple[dict[str, Any], Any, dict[str, Any]]:
    """Read a study from its results, or from its stored runs: data of its page, runs, and figures of its paper."""
    from pfbench.report.study_report import read_results

    if stored is None:
        study, results = config.values["study"], config.values["results_dir"]
        pack, data, files = read_results(study, results, make_report_options(config), ("pdf",))
        return pack, data.table, files
    pack, table = report.read_stored_study(stored.parent)
    names = [entry["file"] for entry in pack["paper_figures"]]
    return pack, table, {name: (stored.parent / name).read_bytes() for name in names}


COMMAND = Command(
    write_study_paper,
    """\
pfbench paper study=NAME journal=ieee|elsevier|springer [key=value ...]
pfbench paper study=NAME width=120mm [key=value ...]

Write the paper export of a study to REPORTS/STUDY/paper/: figures as PDF (and PGF if pdflatex is installed),
tables, methods paragraph, references, paper.tex, and the values of all runs. A table that does not fit the page
is refused. Without results, the paper is made of the stored runs of the report (runs.parquet).

  pfbench paper study=quickstart journal=ieee
  pfbench paper study=mine width=345pt report.alpha=0.01

  OPTIONS
  results_dir, reports_dir   folders""",
    options={
        "journal": Option("NAME", "ieee, elsevier or springer, or else a width", default=""),
        "width": Option("120mm", "width of the text in mm, or in pt of TeX", default=""),
    },
)
