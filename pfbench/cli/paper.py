"""Command `pfbench paper`: figures, tables and text of a study at the widths of a journal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pfbench.cli.compose import compose_study
from pfbench.cli.report import check_has_results, find_page_data, make_report_options
from pfbench.config.composition import JobConfig

if TYPE_CHECKING:
    from pfbench.files.recorded_folder import RecordedFolder

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
    """Write the paper export of a study.

    Args:
        words: Words `key=value`.

    Raises:
        ValueError: If the format is not valid, the study does not exist or a table does not fit.
    """
    from pfbench.report.journal.page_format import find_page_format

    values = {key: _value(words, key) for key in ("journal", "width")}
    page = find_page_format(values["journal"], values["width"])
    config = compose_study([word for word in words if word.partition("=")[0] not in values])
    from pfbench.files.recorded_folder import RecordedFolder
    from pfbench.report.journal.paper_folder import write_paper

    study, reports = config.values["study"], Path(config.values["reports_dir"])
    stored = find_page_data(config, words)
    if stored is None:
        check_has_results(study, Path(config.values["results_dir"]))
    with RecordedFolder(reports / study / "paper") as folder:
        pack = _decide_results(config, folder) if stored is None else _copy_data(stored, folder)
        remarks = write_paper(pack, page, folder)
    if stored is not None:
        print(f"note: without results, the paper is made of {stored}")
    for remark in remarks:
        print(f"note: {remark}")
    print(f"paper: {(folder.path / 'paper.tex').resolve()}")


def _decide_results(config: JobConfig, folder: RecordedFolder) -> dict[str, Any]:
    """Decide the results of a study, write the values of all views and runs, and return the data."""
    from pfbench.report.verdict_files import write_report_data
    from pfbench.results.conditions import load_conditions

    study, results = config.values["study"], config.values["results_dir"]
    options = make_report_options(config)
    conditions = load_conditions(study, results, allow_mixed_versions=options.allow_mixed_versions)
    return write_report_data(study, conditions, options, folder)


def _copy_data(stored: Path, folder: RecordedFolder) -> dict[str, Any]:
    """Copy the values of all views and runs that git stores with the data of a page, and return the data."""
    from pfbench.report.stored_page import read_page_data

    pack = read_page_data(stored.parent)
    for name in ("verdicts.csv", "runs.parquet"):
        if (stored.parent / name).is_file():
            folder.write(name, (stored.parent / name).read_bytes())
    return pack


def _value(words: Sequence[str], key: str) -> str:
    """Return the value of a word `key=value`, empty without it."""
    return next((word.partition("=")[2] for word in words if word.startswith(f"{key}=")), "")
