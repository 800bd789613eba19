"""Tables of the claims, and the jobs that decide them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import pandas as pd

from pfbench.claims.claim_tests import ClaimTestResult
from pfbench.claims.measurements import Side
from pfbench.claims.schema import PAPERS, Claim
from pfbench.claims.verdicts import VERDICTS, ClaimVerdict
from pfbench.report import cost
from pfbench.report.provenance import distinct_values
from pfbench.results.conditions import natural_sort_key

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
    """Describe runs and budget of a claim's jobs, and their commit if the page has several.

    Args:
        claim: Claim.
        jobs: Metadata of all jobs, from `claim_job_metadata`.
    """
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
