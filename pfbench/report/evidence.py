"""What the claims' comparisons measure, read from results: one tidy table of all runs of all studies."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from pfbench import metrics, store
from pfbench.report.claims import SCALED, Claim, Comparison
from pfbench.report.frame import Cell, Job, at_instants, blocks, cells, later, of_trace

Side = tuple[str, str, str]  # study, cell, label
_COLUMNS = ["study", "cell", "label", "measure", "seed", "run", "lost", "unit", "value"]


def gather(claims: Sequence[Claim], results: str | Path = "results", *, mixed: bool = False) -> pd.DataFrame:
    """All that the tests of the claims measure, of every run that there is.

    Args:
        claims: records.
        results: folder of all studies; studies, cells and filters that have no results are left out.
        mixed: as in `frame`.

    Returns:
        Columns study, cell, label, measure, seed, run, lost, unit, value; infinite or NaN where lost.

    Raises:
        ValueError: results that do not belong together, or have no such group or component.
    """
    wanted: dict[Side, dict[str, Comparison]] = {}
    for test in _tests(claims):
        for side in test.sides:
            wanted.setdefault(side, {})[test.measure] = test
    parts = []
    for side, job in _jobs(wanted, results, mixed):
        parts += list(_rows(job.load(), dict(zip(_COLUMNS, side, strict=False)), wanted[side]))
    return pd.concat(parts, ignore_index=True)[_COLUMNS] if parts else pd.DataFrame(columns=_COLUMNS)


def ran(claims: Sequence[Claim], results: str | Path = "results", *, mixed: bool = False) -> dict[Side, Mapping[str, Any]]:
    """The description of each job that the claims' comparisons use, by study, cell and label; arguments as `gather`."""
    sides = {side for test in _tests(claims) for side in test.sides}
    return {side: job.meta for side, job in _jobs(sides, results, mixed)}


def measured(result: store.Result, test: Comparison) -> np.ndarray:
    """What the metric of a test is on each run [R].

    Raises:
        ValueError: a group, component or time that the result does not have.
    """
    result = _until(later(result, test.start), test.end)
    arrays, lost = result.arrays, result.arrays["lost"]
    groups = result.meta["state"]["groups"]
    if test.metric in SCALED:
        return _of_errors(result, test)
    if test.metric == "nees":
        if test.group not in groups:
            raise ValueError(f"{result.meta['key']}: nees is of whole groups, and there is no {test.group!r} in {list(groups)}")
        return metrics.mean_per_run(arrays["nees"][..., list(groups).index(test.group)], lost)
    if test.metric in ("ess", "ancestors", "unique", "iterations"):
        return of_trace(result, test.metric)
    if test.metric in ("effective", "accepted"):
        return _of_traces(result, test.metric)
    if test.metric == "diverged":
        dofs = [len(parts) for parts in groups.values()]
        return (metrics.diverged(arrays["nees"], dofs, lost) | lost).astype(np.float64)
    return np.full(lost.size, result.meta["seconds"]["per_step"])


def _tests(claims: Sequence[Claim]) -> Iterator[Comparison]:
    return (test for claim in claims for tests in claim.tests.values() for test in tests)


def _jobs(wanted: Collection[Side], results: str | Path, mixed: bool) -> Iterator[tuple[Side, Job]]:
    """The job of each side that ran."""
    for study in sorted({side[0] for side in wanted}):
        if not any((Path(results) / study).glob("*.npz")):
            continue
        for cell in cells(study, results, mixed=mixed):
            name = f"{cell.scenario}/{cell.noise}/{cell.model}"
            for job in cell.jobs:
                for label in (label for *where, label in wanted if where == [study, name] and _is(job, cell, label)):
                    yield (study, name, label), job


def _is(job: Job, cell: Cell, label: str) -> bool:
    """Is the job the one of that label: of the filter, and of the settings in brackets, whatever else the cell holds?

    Raises:
        ValueError: another job of the cell has the label too.
    """

    def fits(one: Job) -> bool:
        name, _, told = label.rstrip("]").partition("[")
        pairs = (setting.partition("=")[::2] for setting in told.split(",") if setting)
        return one.meta["label"] == name and all(_value(one.meta["config"], key) == _plain(value) for key, value in pairs)

    if fits(job) and sum(map(fits, cell.jobs)) > 1:
        raise ValueError(f"{cell.name}: several jobs are {label}, as {job.path.name}; delete those that do not belong")
    return fits(job)


def _value(config: Any, key: str) -> str:
    """What stands at a dotted path of a configuration, or of its filter's; numbers in a list go by their place."""
    for path in (f"filter.{key}", key):
        node: Any = config
        for part in path.split("."):
            if isinstance(node, list) and part.isdigit() and int(part) < len(node):
                node = node[int(part)]
            else:
                node = node.get(part) if isinstance(node, Mapping) else None
        if node is not None:
            return _plain(node)
    return ""


def _plain(value: Any) -> str:
    try:
        return repr(float(value))
    except (TypeError, ValueError):
        return str(value)


def _of_traces(result: store.Result, metric: str) -> np.ndarray:
    """NaN where the filter leaves no such trace; moves are made, and accepted, only where a run was resampled."""
    arrays, lost = result.arrays, result.arrays["lost"]
    trace = arrays.get("accepted_0" if metric == "accepted" else "ess")
    if trace is None:
        return np.full(lost.size, np.nan)
    if metric == "accepted":
        trace = np.where(arrays["resampled"], trace, np.nan)
    return metrics.mean_per_run(trace, lost)


def _of_errors(result: store.Result, test: Comparison) -> np.ndarray:
    arrays, lost = result.arrays, result.arrays["lost"]
    there = {block.group: block for block in blocks(result.meta["state"])}
    if test.group not in there:
        raise ValueError(f"{result.meta['key']}: there is no group {test.group!r} in {', '.join(there)}")
    block = there[test.group]
    if test.component not in ("norm", *block.components):
        raise ValueError(f"{result.meta['key']}: {test.group} has no component {test.component!r}, but {block.components}")
    places = block.places if test.component == "norm" else [block.places[block.components.index(test.component)]]
    error = arrays["error"][..., places].astype(np.float64) * block.scale
    if test.metric == "settled":
        return metrics.convergence_time(arrays["time"], error, lost, test.settled)
    if test.metric == "growth":
        return _growth(arrays["time"], error, lost)
    if test.metric == "sd":
        spread = arrays["sd"][..., places].astype(np.float64) * block.scale
        return np.where(lost, np.nan, metrics.rmse_per_run(spread, lost))
    if test.metric == "mean_abs":
        return np.where(lost, np.inf, metrics.mean_per_run(np.sqrt((error**2).sum(-1)), lost))
    return (metrics.rmse_per_run if test.metric == "rmse" else metrics.max_error)(error, lost)


def _growth(time: np.ndarray, error: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Change of the logarithm of the error's norm from the first instant to the last, on the line of least squares [R]."""
    with np.errstate(divide="ignore"):
        log = np.log(np.sqrt((error**2).sum(-1)))
    centred = time - time.mean()
    slope = (log * centred).sum(1) / (centred**2).sum()
    return np.where(lost | ~np.isfinite(slope), np.nan, slope * (time[-1] - time[0]))


def _until(result: store.Result, end: float) -> store.Result:
    """Without the instants after `end`, seconds."""
    kept = result.arrays["time"] <= end
    return at_instants(result, kept) if kept.any() else result


def _rows(result: store.Result, head: Mapping[str, str], tests: Mapping[str, Comparison]) -> Iterator[pd.DataFrame]:
    lost, first = result.arrays["lost"], result.meta.get("first_run", 0)
    who = {"seed": result.meta["seed"], "run": np.arange(first, first + lost.size), "lost": lost}
    for name, test in tests.items():
        yield pd.DataFrame({**head, **who, "measure": name, "unit": _unit(result, test), "value": measured(result, test)})


def _unit(result: store.Result, test: Comparison) -> str:
    if test.metric in ("settled", "seconds_per_step"):
        return "s"
    if test.metric not in SCALED or test.metric == "growth":
        return ""
    return next((block.unit for block in blocks(result.meta["state"]) if block.group == test.group), "")
