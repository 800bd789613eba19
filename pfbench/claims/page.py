"""Page of all claims: statement, paper value, measured value and verdict of each."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from pfbench.claims import figures as claims_figures
from pfbench.claims.choices import list_choices
from pfbench.claims.claim_records import read_claims
from pfbench.claims.claim_tables import (
    Jobs,
    claims_table,
    count_verdicts,
    describe_jobs,
    jobs_table,
    list_commits,
)
from pfbench.claims.claim_tests import NOT_DECIDED, ClaimTestResult
from pfbench.claims.schema import PAPERS, Claim, ClaimTest
from pfbench.claims.stored_measurements import load_claim_data, write_claim_data
from pfbench.claims.stored_verdicts import check_stored_verdicts
from pfbench.claims.verdicts import VERDICTS, ClaimVerdict, decide_claims
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import table_formats, writers

CLAIMS_STUDY = "claims"  # folder of the page among the reports


def write_claims(
    results: str | Path = "results",
    out: str | Path = "reports",
    alpha: float = 0.05,
    conf: Path | None = None,
    experiments: Path | None = None,
    *,
    allow_mixed_versions: bool = False,
    formats: tuple[str, ...] = ("svg", "png"),
) -> Path:
    """Write `<out>/claims/`: index.html, report.md, verdicts.json, the measurements, figures/, tables/.

    Measurements of studies without results are read from the folder. Equal results give equal bytes.

    Args:
        results: Folder of all studies. Claims without results and without stored measurements are not run.
        out: Folder of all reports, which the page links to.
        alpha: Level after correction.
        conf: Folder of configurations, as in `read_claims`.
        experiments: Folder of experiments, as in `read_claims`.
        allow_mixed_versions: Accept several versions, and several seeds, runs or lengths within a condition.
        formats: File formats of the figures.

    Returns:
        Path of index.html.

    Raises:
        ValueError: if a record is wrong, results do not belong together, or those of stored verdicts are missing.
    """
    claims = read_claims(conf, experiments)
    stored = Path(out) / CLAIMS_STUDY
    data = load_claim_data(claims, results, stored, allow_mixed_versions=allow_mixed_versions)
    verdicts, jobs = decide_claims(claims, data.rows, alpha), data.jobs
    studies = {study for claim in claims for study in claim.studies}
    choices = {}
    if conf is not None and experiments is not None:
        choices = {claim.id: list_choices(claim, conf, experiments) for claim in claims}
    context: dict[str, Any] = {
        "papers": rows_by_paper(verdicts, report_anchors(studies, out), jobs, choices),
        "made": jobs_table(jobs),
        "commits": list_commits(jobs.values()),
        "verdicts": VERDICTS,
        "count": count_verdicts(verdicts),
        "alpha": alpha,
        "n": len(verdicts),
    }
    records = [{**_to_json(v), "choices": choices.get(v.claim.id, [])} for v in verdicts]
    check_stored_verdicts(stored / "verdicts.json", records)
    text = json.dumps(records, indent=1, allow_nan=False)
    with RecordedFolder(stored) as folder:
        write_claim_data(data, folder)
        writers.write_table(folder, CLAIMS_STUDY, claims_table(verdicts))
        folder.write("verdicts.json", text + "\n")
        if len(context["made"]):
            writers.write_table(folder, "studies", context["made"])
        drawings = claims_figures.claim_figures(verdicts)
        context["drawings"] = writers.render_figures(drawings, CLAIMS_STUDY, folder, formats)
        return writers.render_template("page", folder, context, Path(__file__).parent)


def report_anchors(studies: Iterable[str], out: str | Path) -> dict[str, set[str]]:
    """Read the anchors of the paper figures on the pages of studies that have a page.

    Args:
        studies: Names of the studies.
        out: Folder of all reports.
    """
    pages = {study: Path(out) / study / "index.html" for study in sorted(studies)}
    pattern = r'<figure id="([^"]+)"'
    return {
        study: set(re.findall(pattern, path.read_text(encoding="utf-8")))
        for study, path in pages.items()
        if path.is_file()
    }


def rows_by_paper(
    verdicts: Sequence[ClaimVerdict],
    reports: Mapping[str, Collection[str]] | None = None,
    jobs: Jobs | None = None,
    choices: Mapping[str, Sequence[str]] | None = None,
) -> list[dict[str, Any]]:
    """Collect the title of each paper and the rows of its claims for the templates.

    Args:
        verdicts: Verdicts from `decide_claims`.
        reports: Anchors of each study that has a page; None for no links.
        jobs: Metadata from `claim_job_metadata`; None to omit it.
        choices: Choices of this project by claim, from `list_choices`; None to omit them.

    Returns:
        One entry per paper.
    """
    rows = [
        (
            v.claim.paper,
            {
                **_claim_row(v, reports or {}, jobs or {}),
                "choices": (choices or {}).get(v.claim.id, []),
            },
        )
        for v in verdicts
    ]
    return [
        {"key": key, "title": title, "rows": [row for paper, row in rows if paper == key]}
        for key, title in PAPERS.items()
    ]


def format_result(result: ClaimTestResult) -> str:
    """Format the measured value with its interval, and the printed value."""
    if np.isnan(result.effect):
        return result.reason
    unit = f" {result.unit}" if result.unit else ""
    number, printed = table_formats.format_number, result.comparison.printed
    has_interval = not (np.isinf(result.low) and np.isinf(result.high))
    interval = f" [{number(result.low)}, {number(result.high)}]" if has_interval else ""
    paper = f", printed {number(printed)}" if np.isfinite(printed) else ""
    return f"{number(result.effect)}{interval}{unit}{paper}"


def format_required_runs(result: ClaimTestResult) -> str:
    """Format the runs required by a test with too few runs; empty for others."""
    if result.outcome != NOT_DECIDED or np.isnan(result.needed):
        return ""
    if np.isinf(result.needed):
        return "no number of runs decides an effect of this size"
    return f"{result.needed:.0f} runs per condition required for power 0.8 at this effect"


def _claim_row(
    verdict: ClaimVerdict, reports: Mapping[str, Collection[str]], jobs: Jobs
) -> dict[str, Any]:
    """Collect the row of a claim for the templates."""
    claim = verdict.claim
    results = [(form, r) for form, values in verdict.findings.items() for r in values]
    tests = [r.comparison for _, r in results]
    lines: dict[Any, dict[str, Any]] = {}
    for form, r in results:
        is_shared = tests.count(r.comparison) > 1  # asked of both forms, shown once
        line = _test_line(claim, "" if is_shared else form, r, reports)
        lines.setdefault(r.comparison, line)
    reason = f": {verdict.reason}" if verdict.reason else ""
    head = {"claim": claim, "verdict": verdict.verdict, "reason": reason, "note": verdict.note}
    return {**head, "lines": list(lines.values()), "ran": describe_jobs(claim, jobs)}


def _test_line(
    claim: Claim, form: str, result: ClaimTestResult, reports: Mapping[str, Collection[str]]
) -> dict[str, Any]:
    """Collect the line of a test for the templates."""
    test = result.comparison
    anchor = claims_figures.figure_anchor(claim, test, reports.get(test.study, ()))
    page = f"../{test.study}/index.html" if test.study in reports else ""
    lost = result.lost_a + result.lost_b
    details = (
        f"{result.pairs} runs" if result.pairs else "",
        f"adjusted p = {table_formats.format_number(result.p_holm)}"
        if np.isfinite(result.p_holm)
        else "",
        f"{lost} lost" if lost else "",
        format_required_runs(result),
    )
    return {
        "form": form,
        "sides": _format_sides(test),
        "measure": test.measure,
        "asked": test.statistic.replace("_", " "),
        "said": format_result(result),
        "more": ", ".join(text for text in details if text),
        "outcome": _format_outcome(result),
        "where": test.cell.replace("/", " / "),
        "study": test.study,
        "link": f"{page}#{anchor}" if anchor else page,
        "drawn": bool(anchor),
    }


def _format_outcome(result: ClaimTestResult) -> str:
    """Format the outcome of a test."""
    outcome = "measured" if result.comparison.statistic == "report" else result.outcome
    return outcome if result.comparison.decides else f"{outcome}, does not decide"


def _format_sides(test: ClaimTest) -> str:
    """Format the filters of a test."""
    if not test.b:
        return test.a
    elsewhere = f" in {test.b_cell.rsplit('/', 1)[0]}" if test.b_cell else ""
    return f"{test.a} {'minus' if test.statistic == 'close' else 'to'} {test.b}{elsewhere}"


def _to_json(verdict: ClaimVerdict) -> dict[str, Any]:
    """Convert a verdict to JSON types."""
    fields = ("id", "paper", "claim", "source", "printed")
    claim = {key: getattr(verdict.claim, key) for key in fields}
    results = {form: [asdict(r) for r in values] for form, values in verdict.findings.items()}
    decision = {"verdict": verdict.verdict, "reason": verdict.reason, "note": verdict.note}
    reading = {"reading": verdict.claim.note}
    return {**claim, **reading, **decision, "findings": writers.to_json_types(results)}
