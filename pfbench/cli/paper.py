"""Command `pfbench paper`: figures, tables and text of a study at the widths of a journal."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from pfbench.cli.compose import compose_study
from pfbench.cli.report import check_has_results, find_page_data, make_report_options
from pfbench.job.config import JobConfig

if TYPE_CHECKING:
    import pandas as pd

Drawings = dict[str, tuple[str, bytes]]  # caption and content by file name

HELP = """\
pfbench paper study=NAME journal=ieee|elsevier|springer [key=value ...]
pfbench paper study=NAME width=120mm [key=value ...]

Write the paper export of a study to REPORTS/STUDY/paper/: figures as PDF (and PGF if pdflatex is installed),
tables, methods paragraph, references, paper.tex, and the values of all runs. A table that does not fit the page
is refused. Without results, the paper is made of the stored runs of the report (runs.parquet).

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
    from pfbench.report.stored_study import RUNS_FILE, format_runs
    from pfbench.report.study_report import format_verdicts

    study, reports = config.values["study"], Path(config.values["reports_dir"])
    RecordedFolder(reports / study, is_complete=False)  # refuses a link
    stored = find_page_data(config, words)
    if stored is None:
        check_has_results(study, Path(config.values["results_dir"]))
    pack, table, drawings = _read_results(config) if stored is None else _read_stored(stored)
    with RecordedFolder(reports / study / "paper") as folder:
        remarks = write_paper(pack, page, folder, drawings)
        folder.write("verdicts.csv", format_verdicts(pack))
        folder.write(RUNS_FILE, format_runs(table, pack))
    if stored is not None:
        print(f"note: without results, the paper is made of {stored}")
    for remark in remarks:
        print(f"note: {remark}")
    print(f"paper: {(folder.path / 'paper.tex').resolve()}")


def _read_results(config: JobConfig) -> tuple[dict[str, Any], pd.DataFrame, Drawings]:
    """Read and decide the results of a study: data of its page, values of all runs, and PDFs of its paper's figures."""
    from pfbench.report.board.pack import build_pack, read_study
    from pfbench.report.papers.figures import paper_figures
    from pfbench.report.stored_study import round_runs
    from pfbench.report.study_report import list_job_settings
    from pfbench.results.conditions import load_conditions
    from pfbench.results.plotting import draw_figure

    study, results = config.values["study"], config.values["results_dir"]
    options = make_report_options(config)
    conditions = load_conditions(study, results, allow_mixed_versions=options.allow_mixed_versions)
    data = read_study(conditions, options)
    data = data._replace(table=round_runs(data.table))
    pack = build_pack(study, conditions, options, data)
    pack["provenance"] += list_job_settings(conditions, options.planned)
    figures = paper_figures(study, conditions, options.paper_figures, options.start_time_s)
    drawings = {
        f"paper_{drawing.name}.pdf": (drawing.caption, draw_figure(drawing, ("pdf",))["pdf"])
        for _, drawing in figures
    }
    return pack, data.table, drawings


def _read_stored(stored: Path) -> tuple[dict[str, Any], pd.DataFrame, Drawings]:
    """Read a stored study: data of its page, values of all runs, and its paper's figures as they are stored."""
    from pfbench.report.stored_study import read_stored_study

    pack, table = read_stored_study(stored.parent)
    return (
        pack,
        table,
        {
            Path(entry["file"]).name: (
                entry["caption"],
                (stored.parent / entry["file"]).read_bytes(),
            )
            for entry in pack["paper_figures"]
        },
    )


def _value(words: Sequence[str], key: str) -> str:
    """Return the value of a word `key=value`, empty without it."""
    return next((word.partition("=")[2] for word in words if word.startswith(f"{key}=")), "")
