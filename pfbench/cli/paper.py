"""Command `pfbench paper`: figures, tables and text of a study at the widths of a journal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from pfbench.cli.compose import compose_study
from pfbench.cli.report import check_has_results, find_page_data, make_report_options
from pfbench.job.config import JobConfig

if TYPE_CHECKING:
    from pfbench.files.recorded_folder import RecordedFolder
    from pfbench.report.journal.figure_style import PageFormat

HELP = """\
pfbench paper study=NAME journal=ieee|elsevier|springer [key=value ...]
pfbench paper study=NAME width=120mm [key=value ...]

Write the paper export of a study to REPORTS/STUDY/paper/: figures as PDF (and PGF if pdflatex is installed),
tables, methods paragraph, references, paper.tex, and the values of all runs. A table that does not fit the page
is refused. Without results, the paper is made of the stored data of the report (page.json.gz, verdicts.csv,
runs.parquet).

  pfbench paper study=quickstart journal=ieee
  pfbench paper study=mine width=345pt report.alpha=0.01

  journal, width             one of both; widths in mm, or in pt of TeX
  results_dir, reports_dir   folders"""


def write_study_paper(words: Sequence[str]) -> None:
    """Write the paper export of a study."""
    from pfbench.report.journal.figure_style import find_page_format

    values = {key: _value(words, key) for key in ("journal", "width")}
    page = find_page_format(values["journal"], values["width"])
    config = compose_study([word for word in words if word.partition("=")[0] not in values])
    from pfbench.files.recorded_folder import RecordedFolder
    from pfbench.report.journal.paper_folder import write_paper
    from pfbench.report.study_report import read_page_data

    study, reports = config.values["study"], Path(config.values["reports_dir"])
    stored = find_page_data(config, words)
    if stored is None:
        check_has_results(study, Path(config.values["results_dir"]))
    with RecordedFolder(reports / study / "paper") as folder:
        if stored is None:
            remarks = _write_of_results(config, page, folder)
        else:
            remarks = write_paper(read_page_data(stored.parent), page, folder)
            _copy_data(stored.parent, folder)
    if stored is not None:
        print(f"note: without results, the paper is made of {stored}")
    for remark in remarks:
        print(f"note: {remark}")
    print(f"paper: {(folder.path / 'paper.tex').resolve()}")


def _write_of_results(config: JobConfig, page: PageFormat, folder: RecordedFolder) -> list[str]:
    """Write the paper of the results of a study with the values of all views and runs; return remarks."""
    from pfbench.report.board import build_pack, read_study
    from pfbench.report.journal.paper_folder import write_paper
    from pfbench.report.study_report import write_verdict_files
    from pfbench.results.conditions import load_conditions

    study, results = config.values["study"], config.values["results_dir"]
    options = make_report_options(config)
    conditions = load_conditions(study, results, allow_mixed_versions=options.allow_mixed_versions)
    data = read_study(conditions, options)
    pack = build_pack(study, conditions, options, data)
    remarks = write_paper(pack, page, folder)
    write_verdict_files(pack, data.table, folder)
    return remarks


def _copy_data(report: Path, folder: RecordedFolder) -> None:
    """Copy the values of all views and runs that git stores with the data of a page."""
    for name in ("verdicts.csv", "runs.parquet"):
        if (report / name).is_file():
            folder.write(name, (report / name).read_bytes())


def _value(words: Sequence[str], key: str) -> str:
    """Return the value of a word `key=value`, empty without it."""
    return next((word.partition("=")[2] for word in words if word.startswith(f"{key}=")), "")
