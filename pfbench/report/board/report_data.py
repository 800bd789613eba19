"""All data of a report: the pack of the board, the methods paragraph, references and files."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report.board.pack import build_pack
from pfbench.report.board.run_table import build_run_table
from pfbench.report.board.verdict_files import write_verdict_files
from pfbench.report.journal.methods_text import describe_methods
from pfbench.report.journal.references import format_bibliography
from pfbench.report.options import ReportOptions
from pfbench.results.conditions import Condition

_SLASH = "\N{DIVISION SLASH}"


def write_report_data(
    study: str, conditions: Sequence[Condition], options: ReportOptions, folder: RecordedFolder
) -> dict[str, Any]:
    """Build the data of a report and write verdicts.csv, runs.parquet and pfbench.bib.

    Args:
        study: Name of the study.
        conditions: Conditions of the study.
        options: Options of the report.
        folder: Target folder.

    Returns:
        Data for `study_page.write_page` and `journal.write_paper`.
    """
    conditions = [_replace_separators(condition) for condition in conditions]
    table = build_run_table(conditions, options.start_time_s)
    pack = build_pack(study, conditions, options, table)
    paragraphs = describe_methods(
        conditions,
        alpha=options.alpha,
        margin=options.equivalence_margin,
        pairs=len(pack["planned"]),
    )
    pack["methods_paragraph"] = "\n\n".join(paragraphs)
    pack["bibtex"] = format_bibliography(pack, conditions)
    size = folder.write("pfbench.bib", pack["bibtex"]).stat().st_size
    pack["downloads"] = [
        *write_verdict_files(pack, table, folder),
        {"name": "References (BibTeX)", "href": "pfbench.bib", "bytes": size, "group": "LaTeX"},
    ]
    return pack | {"tracks": {}, "sweeps": []}


def _replace_separators(condition: Condition) -> Condition:
    """Replace the separator of the keys of views in the names of a condition by a similar character."""
    scenario, noise, model = (name.replace("/", _SLASH) for name in condition[:3])
    jobs = [
        job._replace(
            label=job.label.replace("/", _SLASH),
            meta={**job.meta, "choices": _replace_in(job.meta["choices"])},
        )
        for job in condition.jobs
    ]
    return Condition(scenario, noise, model, tuple(jobs))


def _replace_in(choices: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v.replace("/", _SLASH) if isinstance(v, str) else v for k, v in choices.items()}
