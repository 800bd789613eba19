"""The page of all claims: what each paper says, what was measured, and whether it holds."""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pfbench.report import budget, claim_figures, files, tables
from pfbench.report.claims import PAPERS, Claim, load
from pfbench.report.evidence import Side, gather, ran
from pfbench.report.frame import natural
from pfbench.report.rulings import OPEN, VERDICTS, Finding, Ruling, decide

Jobs = Mapping[Side, Mapping[str, Any]]

STUDY = "claims"  # the folder of reports in which the page lies


def write(
    results: str | Path = "results",
    out: str | Path = "reports",
    alpha: float = 0.05,
    conf: Path | None = None,
    experiments: Path | None = None,
    *,
    mixed: bool = False,
    formats: tuple[str, ...] = ("svg", "png"),
) -> Path:
    """Writes `<out>/claims/`: index.html, report.md, verdicts.json, figures/, tables/. The same results give the same bytes.

    Args:
        results: folder of all studies; claims whose studies have no results are shown as not run.
        out: folder of all reports, which the page links to.
        alpha: level after correction.
        conf, experiments: as `claims.load`.
        mixed: as in `frame`.
        formats: of the figures.

    Returns:
        The page, index.html.

    Raises:
        ValueError: bad records, or results that do not belong together.
    """
    claims = load(conf, experiments)
    rulings = decide(claims, gather(claims, results, mixed=mixed), alpha)
    folder = Path(out) / STUDY
    files.clear(folder)
    files.save_table(folder, STUDY, table(rulings))
    plain = [_plain(ruling) for ruling in rulings]
    (folder / "verdicts.json").write_text(json.dumps(plain, indent=1, allow_nan=False) + "\n", encoding="utf-8")
    studies = {study for ruling in rulings for study in ruling.claim.studies}
    jobs = ran(claims, results, mixed=mixed)
    made = of_studies(jobs)
    if len(made):
        files.save_table(folder, "studies", made)
    context = {
        "papers": papers(rulings, anchors(studies, out), jobs),
        "made": made,
        "commits": commits(jobs.values()),
        "verdicts": VERDICTS,
        "count": count(rulings),
        "alpha": alpha,
        "n": len(rulings),
        "drawings": [files.drawn(drawing, STUDY, folder, formats) for drawing in claim_figures.drawings(rulings)],
    }
    return files.render(STUDY, folder, context)


def anchors(studies: Iterable[str], out: str | Path) -> dict[str, set[str]]:
    """Of the studies that have a page, all that its parts can be linked to by."""
    pages = {study: Path(out) / study / "index.html" for study in sorted(studies)}
    return {
        study: set(re.findall(r'<(?:section|figure|h3) id="([^"]+)"', path.read_text(encoding="utf-8")))
        for study, path in pages.items() if path.is_file()
    }  # fmt: skip


def papers(
    rulings: Sequence[Ruling], reports: Mapping[str, Collection[str]] | None = None, jobs: Jobs | None = None
) -> list[dict[str, Any]]:
    """What the templates show: for each paper its title and the rows of its claims.

    Args:
        rulings: from `decide`.
        reports: of each study that has a page, its anchors; None links to none.
        jobs: from `evidence.ran`; None says nothing of them.
    """
    return [
        {"key": key, "title": title, "rows": [_row(r, reports or {}, jobs or {}) for r in rulings if r.claim.paper == key]}
        for key, title in PAPERS.items()
    ]


def of_studies(jobs: Jobs) -> pd.DataFrame:
    """What each study ran with, one row each: of the jobs that claims use."""
    rows = []
    for study, metas in _by_study(jobs).items():
        runs = " or ".join(_distinct(str(meta["runs"]) for meta in metas))
        stated = budget.stated(metas).removeprefix("Budget: ").removesuffix(".")
        rows.append({"study": study, "jobs": len(metas), "runs": runs, "budget": stated, "commit": ", ".join(commits(metas))})
    return pd.DataFrame(rows)


def commits(metas: Iterable[Mapping[str, Any]]) -> list[str]:
    """At which jobs ran."""
    return _distinct(str(meta.get("versions", {}).get("commit") or "not stated") for meta in metas)


def with_what(claim: Claim, jobs: Jobs) -> list[str]:
    """Runs and budget of the jobs that a claim's comparisons use, study by study; and the commit where the page has several."""
    used = {side: jobs[side] for tests in claim.tests.values() for test in tests for side in test.sides if side in jobs}
    several = len(commits(jobs.values())) > 1
    lines = []
    for study, metas in _by_study(used).items():
        runs = " or ".join(_distinct(str(meta["runs"]) for meta in metas))
        at = f" Commit {', '.join(commits(metas))}." if several else ""
        lines.append(f"{study}: {runs} runs of each filter. {budget.stated(metas)}{at}")
    return lines


def of_study(rulings: Sequence[Ruling], study: str) -> list[Ruling]:
    """Those that a study has a part in."""
    return [ruling for ruling in rulings if study in ruling.claim.studies]


def count(rulings: Sequence[Ruling]) -> pd.DataFrame:
    """How many claims of each paper have each verdict."""
    rows = []
    for key, title in [*PAPERS.items(), ("", "all")]:
        found = Counter(r.verdict for r in rulings if key in ("", r.claim.paper))
        rows.append({"paper": title, **{verdict: found[verdict] for verdict in VERDICTS}, "claims": found.total()})
    return pd.DataFrame(rows)


def table(rulings: Sequence[Ruling]) -> pd.DataFrame:
    """One row for each comparison, and one for each claim without any; numbers as they are."""
    rows = []
    for ruling in rulings:
        claim = ruling.claim
        head = {"id": claim.id, "printed": claim.printed, "verdict": ruling.verdict, "reason": ruling.reason}
        found = [(form, f) for form, findings in ruling.findings.items() for f in findings]
        rows += [{**head, **_numbers(form, f)} for form, f in found] or [head]
    texts = ["form", "asked", "a", "b", "measure", "cell", "unit", "outcome"]
    full = pd.DataFrame(rows)
    return full.fillna(dict.fromkeys((name for name in texts if name in full), "")) if rows else full


def said(found: Finding) -> str:
    """What was measured, with its interval, in words."""
    one = found.comparison
    if np.isnan(found.effect):
        return found.why
    unit = f" {found.unit}" if found.unit else ""
    known = not (np.isinf(found.low) and np.isinf(found.high))
    between = f" [{tables.number(found.low)}, {tables.number(found.high)}]" if known else ""
    printed = f", printed {tables.number(one.printed)}" if np.isfinite(one.printed) else ""
    return f"{tables.number(found.effect)}{between}{unit}{printed}"


def enough(found: Finding) -> str:
    """How many runs it would take, of what the runs were too few to tell; empty of the others."""
    if found.outcome != OPEN or np.isnan(found.needed):
        return ""
    if np.isinf(found.needed):
        return "no number of runs tells an effect of this size"
    return f"power 0.8 at this effect takes {found.needed:.0f} runs a cell"


def _by_study(jobs: Jobs) -> dict[str, list[Mapping[str, Any]]]:
    """Descriptions of the jobs of each study, each job once."""
    found: dict[str, dict[str, Mapping[str, Any]]] = {}
    for (study, _, _), meta in sorted(jobs.items(), key=lambda item: natural("/".join(item[0]))):
        found.setdefault(study, {})[meta["key"]] = meta
    return {study: list(metas.values()) for study, metas in found.items()}


def _distinct(values: Iterable[str]) -> list[str]:
    return sorted(set(values), key=natural)


def _row(ruling: Ruling, reports: Mapping[str, Collection[str]], jobs: Jobs) -> dict[str, Any]:
    claim = ruling.claim
    everywhere = [f.comparison for findings in ruling.findings.values() for f in findings]
    lines: dict[Any, dict[str, Any]] = {}
    for form, f in ((form, f) for form, findings in ruling.findings.items() for f in findings):
        shared = everywhere.count(f.comparison) > 1  # asked of both forms: shown once, of neither
        lines.setdefault(f.comparison, _line(claim, "" if shared else form, f, reports))
    reason = f": {ruling.reason}" if ruling.reason else ""
    told = {"claim": claim, "verdict": ruling.verdict, "reason": reason, "note": ruling.note}
    return {**told, "lines": list(lines.values()), "ran": with_what(claim, jobs)}


def _line(claim: Claim, form: str, found: Finding, reports: Mapping[str, Collection[str]]) -> dict[str, Any]:
    one = found.comparison
    sides = one.a
    if one.b:
        elsewhere = "" if not one.b_cell else f" in {one.b_cell.rsplit('/', 1)[0]}"
        sides += f" {'minus' if one.statistic == 'close' else 'to'} {one.b}{elsewhere}"
    place, drawn = claim_figures.anchor(claim, one, reports.get(one.study, ()))
    link = f"../{one.study}/index.html#{place}" if place else ""
    lost = f"{found.lost_a + found.lost_b} lost" if found.lost_a + found.lost_b else ""
    p = f"p Holm {tables.number(found.p_holm)}" if np.isfinite(found.p_holm) else ""
    more = ", ".join(text for text in (f"{found.pairs} runs" if found.pairs else "", p, lost, enough(found)) if text)
    asked = one.statistic.replace("_", " ")
    shown = "measured" if one.statistic == "report" else found.outcome
    where = one.cell.replace("/", " / ")
    words = {"form": form, "sides": sides, "measure": one.measure, "asked": asked, "said": said(found), "more": more}
    return {**words, "outcome": shown, "where": where, "study": one.study, "link": link, "drawn": drawn}


def _numbers(form: str, found: Finding) -> dict[str, Any]:
    one = found.comparison
    words = {"form": form, "asked": one.statistic, "a": one.a, "b": one.b, "measure": one.measure, "cell": one.cell}
    numbers = {"printed effect": one.printed, "effect": found.effect, "low": found.low, "high": found.high}
    tested = {"p": found.p, "p Holm": found.p_holm, "runs": found.pairs, "runs needed": found.needed}
    return {**words, "unit": found.unit, "outcome": found.outcome, **numbers, **tested}


def _plain(ruling: Ruling) -> dict[str, Any]:
    """For JSON, which has no infinity."""

    def number(value: Any) -> Any:
        if isinstance(value, Mapping):
            return {key: number(below) for key, below in value.items()}
        if isinstance(value, list | tuple):
            return [number(below) for below in value]
        return str(value) if isinstance(value, float) and not np.isfinite(value) else value

    claim = {key: getattr(ruling.claim, key) for key in ("id", "paper", "claim", "source", "printed", "note")}
    findings = {form: [asdict(f) for f in found] for form, found in ruling.findings.items()}
    read = {"reading": claim.pop("note"), "verdict": ruling.verdict, "reason": ruling.reason, "note": ruling.note}
    return {**claim, **read, "findings": number(findings)}
