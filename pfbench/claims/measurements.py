"""Measurements for the claims' tests: from results, or from stored files that need no results."""

from __future__ import annotations

import io
import json
from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import pyarrow as pa

from pfbench.claims.claim_records import NOT_RUN, SCALED, Claim, ClaimTest
from pfbench.files.recorded_folder import RecordedFolder
from pfbench.files.table_file import check_parquet
from pfbench.results import metrics, metrics as metric_values, status, store
from pfbench.results.conditions import (
    ComponentGroup,
    Condition,
    JobFile,
    component_groups,
    load_conditions,
)
from pfbench.results.frame import drop_before, select_steps
from pfbench.stats.error_measures import convergence_time, mean_per_run, rmse_per_run

# --------------------------------------------------------------------------------------------------
# Measurements for the claims' tests, read from results: one long table of all runs.

Side = tuple[str, str, str]  # study, condition, label
MEASURED_COLUMNS = ["study", "cell", "label", "measure", "seed", "run", "lost", "unit", "value"]


def load_claim_measurements(
    claims: Sequence[Claim], results: str | Path = "results", *, allow_mixed_versions: bool = False
) -> pd.DataFrame:
    """Measure all tests of the claims in all available runs.

    Returns columns study, cell, label, measure, seed, run, lost, unit, value; infinite or NaN if
    lost.
    """
    tests_by_side: dict[Side, dict[str, ClaimTest]] = {}
    for test in list_tests(claims):
        for side in test.sides:
            tests_by_side.setdefault(side, {})[test.measure] = test
    rows: list[pd.DataFrame] = []
    for side, job in _find_jobs(tests_by_side, results, allow_mixed_versions):
        head = dict(zip(MEASURED_COLUMNS, side, strict=False))
        rows += _measure_job(job.load(), head, tests_by_side[side])
    return (
        pd.concat(rows, ignore_index=True)[MEASURED_COLUMNS]
        if rows
        else pd.DataFrame(columns=MEASURED_COLUMNS)
    )


def claim_job_metadata(
    claims: Sequence[Claim], results: str | Path = "results", *, mixed: bool = False
) -> dict[Side, Mapping[str, Any]]:
    """Read the metadata of the jobs that the claims' tests use."""
    sides = {side for test in list_tests(claims) for side in test.sides}
    return {side: job.meta for side, job in _find_jobs(sides, results, mixed)}


def measure_claim_test(result: store.JobResult, test: ClaimTest) -> np.ndarray:
    """Measure the metric of a test.

    Returns value of each run, [R].
    """
    result = _drop_after(drop_before(result, test.start), test.end)
    lost, groups = result.data["lost"], result.meta["state"]["groups"]
    if test.metric in SCALED:
        return _measure_errors(result, test)
    if test.metric == "effective":
        return mean_per_run(result.data.get("ess", np.full((lost.size, 1), np.nan)), lost)
    if test.metric == "severely_overconfident":
        dofs = [len(parts) for parts in groups.values()]
        severe = status.is_severely_overconfident(result.data["nees"], dofs, lost)
        return (severe | lost).astype(np.float64)
    data = metric_values.MetricInput(result)
    if test.metric == "nees":
        if test.group not in groups:
            key, options = result.meta["key"], ", ".join(groups)
            raise ValueError(
                f"{key}: group of nees must be one of {options}, got no group {test.group!r}."
            )
        data = data._replace(state_group=test.group)
    values = metrics.compute_metric(test.metric, data)
    return next(iter(values.values()), np.full(lost.size, np.nan))


def list_tests(claims: Sequence[Claim]) -> Iterator[ClaimTest]:
    """Yield the tests of all claims."""
    return (test for claim in claims for tests in claim.tests.values() for test in tests)


def _find_jobs(
    sides: Collection[Side], results: str | Path, mixed: bool
) -> Iterator[tuple[Side, JobFile]]:
    """Yield the job of each side that has results."""
    for study in sorted({side[0] for side in sides}):
        if not any((Path(results) / study).glob("*.npz")):
            continue
        for condition in load_conditions(
            study, results, allow_mixed_versions=mixed, same_data=False
        ):
            name = f"{condition.scenario}/{condition.noise}/{condition.model}"
            labels = [label for *where, label in sides if where == [study, name]]
            for job in condition.jobs:
                for label in labels:
                    if _has_label(job, condition, label):
                        yield (study, name, label), job


def _has_label(job: JobFile, condition: Condition, label: str) -> bool:
    """Check that a job is of the filter and settings of a label, and the only one."""

    def matches(candidate: JobFile) -> bool:
        name, _, settings = label.rstrip("]").partition("[")
        pairs = (setting.partition("=")[::2] for setting in settings.split(",") if setting)
        config = candidate.meta["config"]
        is_same = all(_setting(config, key) == _canonical(value) for key, value in pairs)
        return candidate.meta["label"] == name and is_same

    if matches(job) and sum(map(matches, condition.jobs)) > 1:
        fault = f"several jobs are {label}, as {job.path.name}"
        raise ValueError(f"{condition.name}: {fault}. Delete those that do not belong.")
    return matches(job)


def _setting(config: Any, key: str) -> str:
    """Return the value at a dotted path of a configuration or of its filter."""
    for path in (f"filter.{key}", key):
        node: Any = config
        for name in path.split("."):
            if isinstance(node, list) and name.isdigit() and int(name) < len(node):
                node = node[int(name)]
            else:
                node = node.get(name) if isinstance(node, Mapping) else None
        if node is not None:
            return _canonical(node)
    return ""


def _canonical(value: Any) -> str:
    """Write a value such that equal numbers have equal texts."""
    try:
        return repr(float(value))
    except (TypeError, ValueError):
        return str(value)


def _measure_errors(result: store.JobResult, test: ClaimTest) -> np.ndarray:
    """Measure a metric of the errors of a group or of one component."""
    group = _select_group(result, test)
    data = metric_values.MetricInput(result, group, group.state_group)
    error, lost, time = data.select("error"), result.data["lost"], result.data["time"]
    if test.metric == "settled":
        return convergence_time(time, error, lost, test.settled)
    if test.metric == "growth":
        return _log_growth(time, error, lost)
    if test.metric == "sd":
        return np.where(lost, np.nan, rmse_per_run(data.select("sd"), lost))
    if test.metric == "mean_abs":
        return np.where(lost, np.inf, mean_per_run(np.sqrt((error**2).sum(-1)), lost))
    values = metrics.compute_metric(test.metric, data)
    return list(values.values())[-1] if values else np.full(lost.size, np.nan)


def _select_group(result: store.JobResult, test: ClaimTest) -> ComponentGroup:
    """Return the group of a test, reduced to its component."""
    key = result.meta["key"]
    groups = {group.group: group for group in component_groups(result.meta["state"])}
    if test.group not in groups:
        options = ", ".join(groups)
        raise ValueError(f"{key}: group must be one of {options}, got no group {test.group!r}.")
    group = groups[test.group]
    if test.component == "norm":
        return group
    if test.component not in group.components:
        options = ", ".join(("norm", *group.components))
        raise ValueError(f"{key}: component must be one of {options}, got {test.component!r}.")
    index = group.components.index(test.component)
    return group._replace(places=[group.places[index]], components=[test.component])


def _log_growth(time: np.ndarray, error: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Compute the change of the log error from first to last step on the regression line [R]."""
    with np.errstate(divide="ignore"):
        log = np.log(np.sqrt((error**2).sum(-1)))
    centred = time - time.mean()
    slope = (log * centred).sum(1) / (centred**2).sum()
    return np.where(lost | ~np.isfinite(slope), np.nan, slope * (time[-1] - time[0]))


def _drop_after(result: store.JobResult, end: float) -> store.JobResult:
    """Remove the steps after a time in seconds."""
    mask = result.data["time"] <= end
    return select_steps(result, mask) if mask.any() else result


def _measure_job(
    result: store.JobResult, head: Mapping[str, str], tests: Mapping[str, ClaimTest]
) -> Iterator[pd.DataFrame]:
    """Yield the rows of each test of a job."""
    lost, first = result.data["lost"], result.meta.get("first_run", 0)
    runs = np.arange(first, first + lost.size)
    shared = {**head, "seed": result.meta["seed"], "run": runs, "lost": lost}
    for name, test in tests.items():
        values = {"unit": _unit(result, test), "value": measure_claim_test(result, test)}
        yield pd.DataFrame({**shared, "measure": name, **values})


def _unit(result: store.JobResult, test: ClaimTest) -> str:
    """Return the displayed unit of the metric of a test."""
    units = {metric.name: metric.unit for metric in metrics.METRICS}
    unit = {"settled": "s", "growth": "", **units}.get(test.metric, metrics.GROUP_UNIT)
    if unit != metrics.GROUP_UNIT or test.metric not in SCALED:
        return "" if unit == metrics.GROUP_UNIT else unit
    groups = component_groups(result.meta["state"])
    return next((group.unit for group in groups if group.group == test.group), "")


# --------------------------------------------------------------------------------------------------
# Measurements of the claims as files, from which verdicts are decided again where the results are missing.

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
    """Measure the claims' tests in the results, and read those of studies without results from files."""
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
    """Write measurements and jobs. Equal results give equal bytes."""
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


# --------------------------------------------------------------------------------------------------
# Protection of stored verdicts: a page without results must not replace one with results.


def check_stored_verdicts(path: Path, records: Sequence[dict[str, Any]]) -> None:
    """Check that no stored verdict is replaced by one with fewer results."""
    if not path.is_file():
        return
    stored = {
        record["id"]: _count_missing(record) for record in json.loads(path.read_text("utf-8"))
    }
    lost = [r["id"] for r in records if _count_missing(r) > stored.get(r["id"], float("inf"))]
    if lost:
        raise ValueError(
            f"results_dir must hold the results of the verdicts in {path}, got none for {len(lost)} of "
            f"{len(records)} claims, which would become '{NOT_RUN}'. Nothing was written. Run their "
            f"studies first, write the page elsewhere with reports_dir=DIR, or remove {path}."
        )


def _count_missing(record: dict[str, Any]) -> int:
    """Count the tests of a claim that were not run."""
    reasons = [test["reason"] for tests in record["findings"].values() for test in tests]
    return [record["reason"], *reasons].count(NOT_RUN)
