"""Command `pfbench report`: write the report of a study: figures, tables and tests."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from pfbench import report
from pfbench.cli.command import Command
from pfbench.cli.compose import compose_study, count_planned_jobs, given_keys
from pfbench.cli.messages import format_error, suggest_similar
from pfbench.core.parameter_checks import require
from pfbench.files.command_start import start_work
from pfbench.files.recorded_folder import copy_published, describe_missing_runs, find_published_file
from pfbench.job.config import JobConfig, compose
from pfbench.results.conditions import DATASHEETS, list_stored_studies
from pfbench.results.paper_block import experiments_dir, name_run_command
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


COMMAND = Command(
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
