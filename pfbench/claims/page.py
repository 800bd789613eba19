"""Page of all claims: tables, figures, statement, paper value, measured value and verdict of each."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from pfbench.claims.claim_records import (
    FAILS,
    HOLDS,
    PAPERS,
    Claim,
    ClaimTest,
    list_choices,
    read_claims,
)
from pfbench.claims.measurements import (
    Side,
    check_stored_verdicts,
    load_claim_data,
    write_claim_data,
)
from pfbench.claims.verdicts import (
    NOT_DECIDED,
    VERDICTS,
    ClaimTestResult,
    ClaimVerdict,
    decide_claims,
)
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.report import cost, writers, writers as table_formats
from pfbench.report.papers.figures import FIGURES
from pfbench.report.provenance import distinct_values
from pfbench.results.plotting import COLUMN, SMALL, FigureSpec, format_slug, set_plain_ticks
from pfbench.stats.study_runs import natural_sort_key

# --------------------------------------------------------------------------------------------------
# Page of all claims: statement, paper value, measured value and verdict of each.

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

    Returns path of index.html.
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
        drawings = claim_figures(verdicts)
        context["drawings"] = writers.write_figures(drawings, CLAIMS_STUDY, folder, formats)
        return writers.render_template("page", folder, context, Path(__file__).parent)


def report_anchors(studies: Iterable[str], out: str | Path) -> dict[str, set[str]]:
    """Read the anchors of the paper figures on the pages of studies that have a page."""
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

    Returns one entry per paper.
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
    anchor = figure_anchor(claim, test, reports.get(test.study, ()))
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


# --------------------------------------------------------------------------------------------------
# Tables of the claims, and the jobs that decide them.

Jobs = Mapping[Side, Mapping[str, Any]]
_TEXT_COLUMNS = ("form", "test", "a", "b", "measure", "condition", "unit", "outcome")


def jobs_table(jobs: Jobs) -> pd.DataFrame:
    """Tabulate runs, budget and commit of each study, of the jobs that claims use."""
    rows = []
    for study, jobs_metadata in _by_study(jobs).items():
        text = cost.format_budget(jobs_metadata).removeprefix("Budget: ").removesuffix(".")
        row = {
            "study": study,
            "jobs": len(jobs_metadata),
            "runs": _runs(jobs_metadata),
            "budget": text,
        }
        rows.append({**row, "commit": ", ".join(list_commits(jobs_metadata))})
    return pd.DataFrame(rows)


def list_commits(jobs_metadata: Iterable[Mapping[str, Any]]) -> list[str]:
    """List the distinct commits of jobs."""
    versions = (meta.get("versions", {}) for meta in jobs_metadata)
    return distinct_values(
        str(version.get("commit") or version.get("build") or "not stated") for version in versions
    )


def describe_jobs(claim: Claim, jobs: Jobs) -> list[str]:
    """Describe runs and budget of a claim's jobs, and their commit if the page has several."""
    sides = [side for tests in claim.tests.values() for test in tests for side in test.sides]
    used = {side: jobs[side] for side in sides if side in jobs}
    has_several = len(list_commits(jobs.values())) > 1
    lines = []
    for study, jobs_metadata in _by_study(used).items():
        commit = f" Commit {', '.join(list_commits(jobs_metadata))}." if has_several else ""
        lines.append(
            f"{study}: {_runs(jobs_metadata)} runs per filter. {cost.format_budget(jobs_metadata)}{commit}"
        )
    return lines


def count_verdicts(verdicts: Sequence[ClaimVerdict]) -> pd.DataFrame:
    """Count the claims of each paper by verdict."""
    rows = []
    for key, title in [*PAPERS.items(), ("", "all")]:
        count = Counter(v.verdict for v in verdicts if key in ("", v.claim.paper))
        by_verdict = {verdict: count[verdict] for verdict in VERDICTS}
        rows.append({"paper": title, **by_verdict, "claims": count.total()})
    return pd.DataFrame(rows)


def claims_table(verdicts: Sequence[ClaimVerdict]) -> pd.DataFrame:
    """Tabulate one row per test, and one per claim without tests."""
    rows: list[dict[str, Any]] = []
    for v in verdicts:
        head = {"claim": v.claim.id, "paper value": v.claim.printed}
        head |= {"verdict": v.verdict, "reason": v.reason}
        results = [(form, r) for form, values in v.findings.items() for r in values]
        rows += [{**head, **_test_row(form, r)} for form, r in results] or [head]
    table = pd.DataFrame(rows)
    return table.fillna({name: "" for name in _TEXT_COLUMNS if name in table})


def _by_study(jobs: Jobs) -> dict[str, list[Mapping[str, Any]]]:
    """Group metadata by study, each job once."""
    studies: dict[str, dict[str, Mapping[str, Any]]] = {}
    for (study, _, _), meta in sorted(
        jobs.items(), key=lambda item: natural_sort_key("/".join(item[0]))
    ):
        studies.setdefault(study, {})[meta["key"]] = meta
    return {study: list(jobs_metadata.values()) for study, jobs_metadata in studies.items()}


def _runs(jobs_metadata: Iterable[Mapping[str, Any]]) -> str:
    """Format the numbers of runs of jobs."""
    return " or ".join(distinct_values(str(meta["runs"]) for meta in jobs_metadata))


def _test_row(form: str, result: ClaimTestResult) -> dict[str, Any]:
    """Collect the row of a test in the table of claims."""
    test = result.comparison
    return {
        "form": form,
        "test": test.statistic,
        "a": test.a,
        "b": test.b,
        "measure": test.measure,
        "condition": test.cell,
        "unit": result.unit,
        "outcome": result.outcome,
        "printed effect": test.printed,
        "our value": result.effect,
        "lower": result.low,
        "upper": result.high,
        "p": result.p,
        "adjusted p (Holm)": result.p_holm,
        "runs": result.pairs,
        "runs required": result.needed,
    }


# --------------------------------------------------------------------------------------------------
# Figures of the claims: printed against measured values, and links to figures of studies.

_COLOURS = {HOLDS: "#0072B2", FAILS: "#D55E00"}  # open results are grey


def figure_anchor(claim: Claim, test: ClaimTest, anchors: Collection[str]) -> str:
    """Find the anchor of the figure of the paper that shows a test."""
    condition = format_slug(test.cell.replace("/", "_"))
    for name, figure in FIGURES.items():
        if name.startswith(claim.paper) and figure_numbers(claim.source) & figure_numbers(
            figure.title
        ):
            start = format_slug(f"paper_{name}")
            starts = (f"{start}_{condition}", f"{start}_over_time")
            candidates = sorted(a for a in anchors if a == start or a.startswith(starts))
            any_group = not test.group or not figure.groups
            suffix = f"_{format_slug(test.group)}"
            if matches := [a for a in candidates if any_group or a.endswith(suffix)]:
                return matches[0]
    return ""


def figure_numbers(source: str) -> set[int]:
    """Extract figure numbers from texts such as "figures 2, 4 and 5" or "figures 12 to 14"."""
    numbers: set[int] = set()
    for text in re.findall(r"figures? (\d+(?:(?:, | and | to )\d+)*)", source):
        for low, high in re.findall(r"(\d+)(?: to (\d+))?", text):
            numbers |= set(range(int(low), int(high or low) + 1))
    return numbers


def claim_figures(verdicts: Sequence[ClaimVerdict]) -> list[FigureSpec]:
    """Specify the figures of printed against measured ratios, and of levels."""
    rows: dict[ClaimTest, tuple[str, ClaimTestResult]] = {}
    for verdict in verdicts:
        for result in (r for results in verdict.findings.values() for r in results):
            test = result.comparison
            if np.isfinite(test.printed) and np.isfinite(result.effect) and result.effect > 0:
                rows.setdefault(test, (verdict.claim.id, result))
    ratios = [row for test, row in rows.items() if test.b]
    levels = [row for test, row in rows.items() if not test.b]
    tail = " Filled blue: the test holds. Open orange: it fails. Grey: it is open."
    drawings = []
    if ratios:
        text = "Ratio of the first filter to the second: printed (cross), measured (dot, interval)."
        make = partial(plot_claims, ratios, relative=False)
        drawings.append(FigureSpec("printed_ratios", text + tail, make))
    if levels:
        text = "Measured level divided by the printed level, with its interval."
        make = partial(plot_claims, levels, relative=True)
        drawings.append(FigureSpec("printed_levels", text + tail, make))
    return drawings


def plot_claims(rows: Sequence[tuple[str, ClaimTestResult]], relative: bool) -> Figure:
    """Plot measured and printed values, one row per test.

    Returns the figure.
    """
    figure = Figure(figsize=(COLUMN, 0.7 + 0.17 * len(rows)), layout="constrained")
    axis = figure.subplots()
    axis.axvline(1, color="0.4", lw=0.8, zorder=1)
    values = [1.0]
    for index, (_, result) in enumerate(rows):
        printed = result.comparison.printed
        values += _plot_row(axis, index, result, printed if relative else 1.0)
        if not relative:
            axis.plot(printed, index, ls="none", marker="x", ms=5, mew=1.2, color="black", zorder=4)
            values.append(printed)
    labels = [_row_label(claim, result.comparison) for claim, result in rows]
    axis.set_yticks(range(len(rows)), labels, fontsize=SMALL)
    axis.set_ylim(len(rows) - 0.4, -0.6)
    positive = [value for value in values if np.isfinite(value) and value > 0]
    low, high = min(positive), max(positive)
    edge = (high / low) ** 0.06
    label = "measured / printed" if relative else "ratio"
    axis.set(xscale="log", xlim=(low / edge, high * edge), xlabel=label)
    set_plain_ticks(axis.xaxis, [low, high])
    axis.grid(False, axis="y")
    return figure


def _plot_row(axis: Axes, index: int, result: ClaimTestResult, scale: float) -> list[float]:
    """Plot the result of one test; return its values."""
    colour = _COLOURS.get(result.outcome, "0.5")
    low, middle, high = result.low / scale, result.effect / scale, result.high / scale
    if np.isfinite([low, high]).all() and low > 0:
        axis.plot([low, high], [index, index], color=colour, lw=1.1, zorder=2)
    fill = colour if result.outcome == HOLDS else "white"
    axis.plot(middle, index, "o", ls="none", ms=4, mec=colour, mfc=fill, mew=0.9, zorder=3)
    return [low, middle, high]


def _row_label(claim: str, test: ClaimTest) -> str:
    """Format the label of a row."""
    measure = test.group or test.metric.replace("_", " ")
    measure = test.component if test.component != "norm" else measure
    return f"{claim}: {test.a}{f' / {test.b}' if test.b else ''}, {measure}"
