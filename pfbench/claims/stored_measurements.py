"""Measurements of the claims as files, from which verdicts are decided again where the results are missing."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd
import pyarrow as pa

from pfbench.claims.measurements import (
    MEASURED_COLUMNS,
    Side,
    claim_job_metadata,
    list_tests,
    load_claim_measurements,
)
from pfbench.claims.schema import Claim
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.files.table_file import check_parquet

MEASUREMENTS = "measurements.parquet"
JOBS = "jobs.json"
# What the page says of a job: `cost.format_budget` and `list_commits` read these values.
_JOB_KEYS = (
    *("key", "label", "runs", "particles", "particles_used"),
    *("budget", "budget_allocation", "likelihoods_per_step"),
)


class ClaimData(NamedTuple):
    """Measurements and jobs of all claims.

    Attributes:
        rows: Table as of `load_claim_measurements`.
        jobs: Metadata by study, condition and label.
    """

    rows: pd.DataFrame
    jobs: dict[Side, Mapping[str, Any]]


def load_claim_data(
    claims: Sequence[Claim], results: str | Path, folder: Path, *, allow_mixed_versions: bool
) -> ClaimData:
    """Measure the claims' tests in the results, and read those of studies without results from files.

    Args:
        claims: Records.
        results: Folder of all studies.
        folder: Folder of the page, which may hold the files of `write_claim_data`.
        allow_mixed_versions: As in `load_claim_measurements`.

    Raises:
        ValueError: If results do not belong together, or a file is damaged.
    """
    measured = ClaimData(
        load_claim_measurements(claims, results, allow_mixed_versions=allow_mixed_versions),
        claim_job_metadata(claims, results, mixed=allow_mixed_versions),
    )
    stored = _read_claim_data(folder)
    measured_studies = {side[0] for side in measured.jobs}
    tests = {(*side, test.measure) for test in list_tests(claims) for side in test.sides}
    sides = {tuple(test[:3]) for test in tests}
    keys = pd.MultiIndex.from_frame(stored.rows[MEASURED_COLUMNS[:4]])
    is_used = keys.isin(tests) & ~stored.rows["study"].isin(measured_studies).to_numpy()
    jobs = {
        side: job
        for side, job in stored.jobs.items()
        if side in sides and side[0] not in measured_studies
    }
    tables = [table for table in (measured.rows, stored.rows[is_used]) if len(table)]
    rows = pd.concat(tables, ignore_index=True) if tables else measured.rows
    return ClaimData(rows, {**measured.jobs, **jobs})


def write_claim_data(data: ClaimData, folder: RecordedFolder) -> None:
    """Write measurements and jobs. Equal results give equal bytes.

    Args:
        data: Measurements and jobs.
        folder: Folder of the page.
    """
    rows = data.rows.sort_values(MEASURED_COLUMNS[:6], ignore_index=True)
    texts = [name for name in MEASURED_COLUMNS if rows[name].dtype == object]
    buffer = io.BytesIO()
    rows.astype(dict.fromkeys(texts, "category")).to_parquet(buffer, index=False)
    folder.write(MEASUREMENTS, buffer.getvalue())
    jobs = [[*side, _shorten(data.jobs[side])] for side in sorted(data.jobs)]
    folder.write(JOBS, json.dumps(jobs, indent=0, sort_keys=True, allow_nan=False) + "\n")


def _read_claim_data(folder: Path) -> ClaimData:
    """Read the files of `write_claim_data`; no rows without them."""
    table, jobs = folder / MEASUREMENTS, folder / JOBS
    if not table.is_file():
        return ClaimData(pd.DataFrame(columns=MEASURED_COLUMNS), {})
    path = table
    try:
        check_parquet(table)
        rows = pd.read_parquet(table)[MEASURED_COLUMNS]
        rows = rows.astype({name: object for name in rows.select_dtypes("category")})
        path = jobs
        entries = json.loads(jobs.read_text("utf-8"))
        metadata = {(study, cell, label): meta for study, cell, label, meta in entries}
    except (OSError, KeyError, TypeError, ValueError, pa.ArrowException) as error:
        raise ValueError(
            f"{path} must be written by pfbench claims, got {error}. "
            "Remove it and run: make studies, then pfbench claims."
        ) from error
    return ClaimData(rows, metadata)


def _shorten(meta: Mapping[str, Any]) -> dict[str, Any]:
    """Select the values of a job that the page shows."""
    config = meta.get("config")
    budget = {"budget": config["budget"]} if config and "budget" in config else {}
    seconds, versions = meta.get("seconds", {}), meta.get("versions", {})
    return {
        **budget,
        **{name: meta[name] for name in _JOB_KEYS if meta.get(name) is not None},
        "seconds": {name: seconds[name] for name in ("per_step",) if name in seconds},
        "versions": {name: versions[name] for name in ("commit", "build") if name in versions},
    }
