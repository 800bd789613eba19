"""Command `pfbench paper`: figures, tables and text of a study at the widths of a journal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from pfbench.cli.compose import compose_study
from pfbench.cli.report import check_study_exists, make_report_options

HELP = """\
pfbench paper study=NAME journal=ieee|elsevier|springer [key=value ...]
pfbench paper study=NAME width=120mm [key=value ...]

Write the paper export of a study to REPORTS/STUDY/paper/: figures as PDF (and PGF if pdflatex is installed),
tables, methods paragraph, references, paper.tex, and the values of all runs. A table that does not fit the page
is refused.

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
    study, results = config.values["study"], Path(config.values["results_dir"])
    check_study_exists(study, results)
    from pfbench.files.recorded_folder import RecordedFolder
    from pfbench.report.board import write_report_data
    from pfbench.report.journal.paper_folder import write_paper
    from pfbench.results.conditions import load_conditions

    options = make_report_options(config)
    conditions = load_conditions(study, results, allow_mixed_versions=options.allow_mixed_versions)
    with RecordedFolder(Path(config.values["reports_dir"]) / study / "paper") as folder:
        pack = write_report_data(study, conditions, options, folder)
        methods = pack["methods_paragraph"].split("\n\n")
        remarks = write_paper(pack, conditions, methods, page, folder)
    for remark in remarks:
        print(f"note: {remark}")
    print(f"paper: {(folder.path / 'paper.tex').resolve()}")


def _value(words: Sequence[str], key: str) -> str:
    """Return the value of a word `key=value`, empty without it."""
    return next((word.partition("=")[2] for word in words if word.startswith(f"{key}=")), "")
