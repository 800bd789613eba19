"""Commands of pages: they read what is stored.

Command `pfbench report`: write the report of a study: figures, tables and tests.
Command `pfbench open`: show the report of a study in a browser, and write it if it is missing.
Command `pfbench status`: print what is finished, failed and running, and the time left.
Command `pfbench compare`: compare an own study with a published one in the same runs.
Command `pfbench paper`: write figures, tables and text of a study for a journal.
Command `pfbench datasheet`: write the datasheet of a scenario.
"""

from __future__ import annotations

import sys
import webbrowser
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from pfbench import report
from pfbench.cli.command import Command, Option
from pfbench.cli.compose import compose_study, count_planned_jobs, given_keys, read_description
from pfbench.cli.messages import format_error, suggest_similar
from pfbench.cli.progress import list_repeats, read_state
from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import write_atomically
from pfbench.files.command_start import start_work
from pfbench.files.recorded_folder import (
    RecordedFolder,
    copy_published,
    describe_missing_runs,
    find_published_file,
)
from pfbench.job.config import JobConfig, compose
from pfbench.results.conditions import (
    DATASHEETS,
    list_stored_studies,
    load_conditions,
    read_undamaged,
)
from pfbench.results.inputs import describe_libraries
from pfbench.results.paper_block import experiments_dir, name_run_command, read_part
from pfbench.results.store import list_failures

CLAIMS = "claims_2"  # folder of the claims among results and reports
# folders that hold no study, and the commands that write them
NOT_STUDIES = {DATASHEETS: "datasheet scenario=NAME", "claims": "claims", CLAIMS: "claims"}
_PAGES = ("report.md", "index.html")


def report_study(words: Sequence[str]) -> None:
    """Write the report of a study, or those of all studies."""
    if list(words[:1]) == ["all"]:
        _report_all(words[1:])
        return
    keys = given_keys(words)
    world = next((word for word in words if word.startswith("scenario=")), "")
    is_study = not world or keys & {"study", "experiment"}
    require(is_study, "study", "be set", world, f"For its datasheet use: pfbench datasheet {world}")
    config = compose_study(words)
    study = config.values["study"]
    remedy = f"Use: pfbench {NOT_STUDIES.get(study)}"
    require(study not in NOT_STUDIES, "study", "be a study", study, remedy)
    if not find_page_data(config, words):
        check_has_results(study, Path(config.values["results_dir"]))
    print(f"report: {_write_page(config).resolve()}")


def check_has_results(study: str, results: Path) -> None:
    """Check that a study has files of results."""
    if any((results / study).glob("*.npz")):
        return
    experiments = {path.stem for path in experiments_dir().glob("*.yaml")}
    available, failures, failed, similar = list_stored_studies(results), list_failures(results / study), "", ""  # fmt: skip
    if failures:
        failed = f" {len(failures)} of its jobs failed, the first with {failures[0]['message']}"
    elif study not in experiments:
        similar = suggest_similar(study, sorted({*available, *experiments}))
    raise ValueError(
        f"study must be a study with results, got {study}.{similar}{failed} "
        f"Studies with results in {results}: {', '.join(available) or 'none'}. "
        f"Run its jobs first: {name_run_command(study)}{describe_missing_runs().rstrip()}"
        f"{f'. Its published page: pfbench open study={study}' if find_published_file(f'{study}/{report.RUNS_FILE}') else ''}"
    )


def make_report_options(config: JobConfig) -> Any:
    """Build the options of a report from the group `report`.

    Returns the options.
    """
    values = config.values.get("report")
    stated = values if isinstance(values, Mapping) else {str(values): None}
    names = [field.name for field in fields(report.ReportOptions)]
    unknown = sorted({*stated} - {*names})
    similar = suggest_similar(unknown[0], names) if unknown else ""
    remedy = f"{similar} Choose a file: pfbench list report".strip()
    require(not unknown, "report", f"have keys of {', '.join(names)}", ", ".join(unknown), remedy)
    options: dict[str, Any] = {k: tuple(v) if isinstance(v, list) else v for k, v in stated.items()}
    return report.ReportOptions(**options, planned=count_planned_jobs(config.values["study"]))


def _write_page(config: JobConfig) -> Path:
    """Write the report of one study, or make its page of the stored data where the results are missing."""
    values = config.values
    if data := find_page_data(config):
        print(f"{values['study']}: without results, the page is made of {data}")
        return report.rebuild_page(data.parent)
    return report.write_report(
        values["study"], values["results_dir"], values["reports_dir"], make_report_options(config)
    )


def find_page_data(config: JobConfig, words: Sequence[str] = ()) -> Path | None:
    """Return the stored data of the page of a study without results, if it has any or is published: then with a copy."""
    study = config.values["study"]
    results = Path(config.values["results_dir"]) / study
    data = Path(config.values["reports_dir"]) / study / report.RUNS_FILE
    is_stored = data.is_file() or find_published_file(f"{study}/{report.RUNS_FILE}") is not None
    if any(results.glob("*.npz")) or not is_stored or data.parent.is_symlink():
        return None
    options = [word for word in words if word.lstrip("+").startswith(("report.", "report="))]
    require(
        not options,
        "options of the report",
        "have results",
        f"{', '.join(options)} and no results in {results}",
        f"Leave them out to use {data}, or run: {name_run_command(study)}",
    )
    copy_published(data.parent, report.RUNS_FILE)
    return data


def _report_all(words: Sequence[str]) -> None:
    """Write the reports of all studies with results or stored data, and of the claims."""
    values = compose(words).values
    results, reports = Path(values["results_dir"]), Path(values["reports_dir"])
    studies = {path.parent.name for path in results.glob("*/*.npz")} - NOT_STUDIES.keys()
    pages = [path for name in _PAGES for path in reports.glob(f"*/{name}")]
    published = {path.parent.name for path in pages} - NOT_STUDIES.keys()
    failed = []
    start_work()  # a report that is refused stops no other
    for study in sorted(studies):
        try:
            print(f"{study}: {_write_page(compose_study([f'study={study}', *words])).resolve()}")
        except Exception as error:
            failed.append(study)
            print(f"{study}: failed: {format_error(error, words)}", file=sys.stderr)
    for study in sorted(published - studies):
        print(_renew_published(study, reports / study, results))
    print(_write_claims(words))
    if failed:
        raise RuntimeError(
            f"all {len(studies)} reports must be written, got {len(failed)} failures: "
            f"{', '.join(failed)}. The messages above give the reasons."
        )


def _write_claims(words: Sequence[str]) -> str:
    """Write the page of the claims if there are runs of them, or a page that stores some; return a line for the user."""
    from pfbench.cli.claims import write_claims_page

    values = compose(words).values
    results = Path(values["results_dir"]) / CLAIMS
    if not any(results.glob("*.json")) and not (Path(values["reports_dir"]) / CLAIMS).is_dir():
        return (
            f"claims: the page is unchanged, since {values['results_dir']} holds no runs of claims. "
            "Next: pfbench claims run"
        )
    return f"claims: {write_claims_page(words).resolve()}"


def _renew_published(study: str, folder: Path, results: Path) -> str:
    """Make the page of a published study of its stored data; return a line for the user."""
    if (folder / report.RUNS_FILE).is_file():
        return f"{study}: {report.rebuild_page(folder).resolve()}, of the stored data"
    is_script = (experiments_dir() / f"{study}.py").is_file()
    command = f"python -m pfbench.experiments.{study}" if is_script else name_run_command(study)
    return (
        f"{study}: the published report is unchanged, since {results} holds no results. "
        f"Next: {command}"
    )


REPORT_COMMAND = Command(
    report_study,
    """\
pfbench report study=NAME [key=value ...]
pfbench report all [key=value ...]

Write the report of a study: figures, tables and statistical tests, as index.html and report.md.
`all` writes the reports of all studies with results, and the page of the claims.

  pfbench report study=quickstart
  pfbench report study=mine report.figure_formats=[pdf,png]
  pfbench list report        report configurations

See also: pfbench claims, pfbench datasheet scenario=NAME""",
)


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


OPEN_COMMAND = Command(
    open_report,
    """\
pfbench open study=NAME [results_dir=FOLDER] [reports_dir=FOLDER]

Show the report of a study in a browser. It is written first if it is missing or older than the newest result.

  pfbench open study=quickstart""",
    keys=("study", "results_dir", "reports_dir"),
    required=("study",),
)


def report_status(words: Sequence[str]) -> None:
    """Print the state of all studies, or of one."""
    values = compose(words).values
    results = Path(values["results_dir"])
    if "study" in given_keys(words):
        folder = results / str(values["study"])
        state = read_state(folder)
        if not (state.failures or state.running):
            check_has_results(folder.name, results)
        jobs = filter(None, map(read_undamaged, folder.glob("*.npz")))
        mixed = describe_libraries([meta for _, meta in jobs])
        print(state, *filter(None, [mixed]), *list_repeats(folder), sep="\n")
        return
    folders = [path for path in results.glob("*") if path.is_dir() and path.name not in NOT_STUDIES]
    for state in sorted(map(read_state, folders), key=lambda state: -state.changed):
        print(state)
    if not folders:
        print(f"No study has results in {results}. Next: pfbench run -m +experiment=quickstart")


STATUS_COMMAND = Command(
    report_status,
    """\
pfbench status [study=NAME] [results_dir=FOLDER]

Print the numbers of finished and failed jobs of each study, the sweeps that are at work with the time left, and
for one study the failed jobs with the words that repeat them.

  pfbench status
  pfbench status study=mine""",
    keys=("study", "results_dir"),
)


def compare_study(words: Sequence[str], published: str) -> None:
    """Compare a study with a published one, print the verdicts and write them."""
    from pfbench.report.overview.figures import to_svg
    from pfbench.report.published_study import compare_with_published, find_published

    config = compose_study(words)
    study, results = config.values["study"], Path(config.values["results_dir"])
    check_has_results(study, results)
    folder = find_published(published, Path(config.values["reports_dir"]))
    compared = compare_with_published(load_conditions(study, results), folder)
    print(compared)
    path = Path(config.values["reports_dir"]) / study / "published.csv"
    write_atomically(path, lambda file: file.write(compared.table().to_csv(index=False).encode()))
    print(f"verdicts: {path.resolve()}")
    if compared.cells:
        try:
            svg = to_svg(compared.plot()).encode()
        except ValueError as error:  # the verdicts above stand without it
            print(f"no heat map: {error}")
            return
        picture = path.with_name("published_heat_map.svg")
        write_atomically(picture, lambda file: file.write(svg))
        print(f"heat map: {picture.resolve()}")


COMPARE_COMMAND = Command(
    compare_study,
    """\
pfbench compare study=NAME published=all_seven [key=value ...]

Compare the filters of an own study with all filters of a published one, in the same worlds and runs. The
published filters do not run again: random numbers follow from seed and run. At least one filter of the
published study runs again in each world as a witness; its errors must agree, else the worlds differ.

  pfbench run -m +experiment=all_seven scenario=growth particles=100 study=mine filter=ukf,my_filter
  pfbench compare study=mine published=all_seven

  OPTIONS

The verdicts are written to REPORTS_DIR/NAME/published.csv, and published_heat_map.svg has the own filters
next to the seven methods. In Python: study.against("all_seven"), and .plot().""",
    options={"published": Option("NAME", "name of a report among reports_dir, or a folder with its runs.parquet")},
    required=("published",),
)  # fmt: skip


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


PAPER_COMMAND = Command(
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


def report_scenario(words: Sequence[str]) -> None:
    """Write the datasheet of a scenario."""
    from pfbench.job.datasheet_data import RUNS, build_datasheet
    from pfbench.report.datasheet import write_datasheet

    config = compose(words if "runs" in given_keys(words) else [*words, f"runs={RUNS}"])
    data = build_datasheet(
        config, read_description(read_part("scenario", config.choices["scenario"]))
    )
    page = write_datasheet(
        data, config.values["reports_dir"], tuple(config.values["report"]["figure_formats"])
    )
    print(f"datasheet: {page.resolve()}")


DATASHEET_COMMAND = Command(
    report_scenario,
    """\
pfbench datasheet scenario=NAME [noise=NAME] [runs=20] [key=value ...]

Write the datasheet of a scenario: trajectory, sensors, measurements and truth of its episodes.

  pfbench datasheet scenario=flight_300s
  pfbench datasheet scenario=flight_300s noise=outliers runs=50
  pfbench list scenario      scenarios""",
    required=("scenario",),
)
