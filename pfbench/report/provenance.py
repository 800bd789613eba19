"""Provenance of a report: versions, seeds, times, choices, budget, citation and references."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.report.journal.study_pack import Pack
from pfbench.results.conditions import Condition
from pfbench.results.store import BUDGETS, SAME_LIKELIHOODS, SAME_N, SAME_TIME
from pfbench.stats.study_runs import natural_sort_key

_SHARED = (
    ("pfbench", "versions.pfbench"),
    ("commit", "versions.commit"),
    ("build", "versions.build"),
    ("python", "versions.python"),
    ("torch", "versions.torch"),
    ("numpy", "versions.numpy"),
    ("host", "host"),
    ("device", "device"),
    ("engine", "engine"),
    ("number type", "dtype"),
    ("threads", "threads"),
    ("seed", "seed"),
    ("first run", "first_run"),
    ("runs per filter", "runs"),
    ("steps per run", "steps"),
)

_PHASES = {
    "filter": "filters",
    "scores": "scores",
    "world": "data",
    "pcrb": "PCRB",
    "compile": "compilation",
}


def list_builds(metadata: Iterable[Mapping[str, Any]]) -> list[str]:
    """List the builds of jobs, for people: commits, or digests of the sources without git."""
    builds = (
        _value_at(meta, "versions.commit") or _value_at(meta, "versions.build") for meta in metadata
    )
    texts = (str(build).replace("-dirty", " with uncommitted changes") for build in builds if build)
    return distinct_values(texts)


def name_build(builds: str) -> str:
    """Write "commit" before builds of `list_builds` that begin with one."""
    return builds if builds.startswith("sources") else f"commit {builds}"


def list_shared_settings(conditions: Sequence[Condition]) -> list[tuple[str, str]]:
    """List the settings of all jobs; a mixed report has several values."""
    jobs = [job for cell in conditions for job in cell.jobs]
    values = {
        name: [str(value) for job in jobs if (value := _value_at(job.meta, path)) is not None]
        for name, path in _SHARED
    }
    return [(name, ", ".join(distinct_values(v)) or "not recorded") for name, v in values.items()]


def compute_cost(
    metadata: Sequence[Mapping[str, Any]], planned: int | None
) -> list[tuple[str, str]]:
    """Count the jobs and sum their time by phase."""
    times = {
        phase: sum(meta["seconds"].get(name, 0.0) for meta in metadata)
        for name, phase in _PHASES.items()
    }
    total = sum(times.values())
    shares = ", ".join(f"{phase} {100 * t / total:.0f} %" for phase, t in times.items() if t)
    target = f" of {planned} in the experiment" if planned else ""
    elapsed = f"{_format_duration(total)} ({shares})" if shares else "not recorded"
    return [("jobs", f"{len(metadata)}{target}"), ("time of all jobs", elapsed)]


def training_cost(conditions: Sequence[Condition]) -> list[tuple[str, str]]:
    """List the training data and the training cost of each learned filter."""
    rows: dict[tuple[str, str], None] = {}
    for job in (job for cell in conditions for job in cell.jobs if job.meta.get("trained")):
        split, cost = job.meta["trained"]["split"], job.meta["trained"]["cost"]
        data = f"{split['train']['runs']} episodes of {split['scenario']}, " if split else ""
        effort = f"{cost['updates']} updates, {cost['seconds']:.0f} s on {cost['device']} ({cost['threads']} threads)"
        rows[f"training of {job.label}", data + effort] = None
    return list(rows)


def format_bibtex(conditions: Sequence[Condition]) -> str:
    """Format a BibTeX entry, of a type that all styles know, with the versions and the year of the results."""
    metadata = [job.meta for cell in conditions for job in cell.jobs]
    version = ", ".join(
        distinct_values(str(_value_at(meta, "versions.pfbench")) for meta in metadata)
    )
    commit = ", ".join(list_builds(metadata))
    years = [str(meta["created"])[:4] for meta in metadata if meta.get("created")]
    build = name_build(commit)
    note = f"  note    = {{{build[0].upper()}{build[1:]}}},\n" if commit else ""
    return (
        "@misc{pfbench,\n"
        "  author  = {{The pfbench authors}},\n"
        "  title   = {{pfbench}: probabilistic programming and benchmarking of particle filters in integrated navigation},\n"
        f"  version = {{{version}}},\n{note}"
        + (f"  year    = {{{max(years)}}},\n" if years else "")
        + "}\n"
    )


def _format_duration(seconds: float) -> str:
    """Format a duration in s, min or h."""
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def distinct_values(values: Iterable[str]) -> list[str]:
    """Return the distinct values in natural order."""
    return sorted(set(values), key=natural_sort_key)


def _value_at(meta: Any, path: str) -> Any:
    """Return the value at a dotted path, or None."""
    for name in path.split("."):
        meta = meta.get(name) if isinstance(meta, Mapping) else None
    return meta


# --------------------------------------------------------------------------------------------------
# References of the methods, and their BibTeX entries.

SELF = "pfbench"


def list_cited_keys(pack: Pack) -> list[str]:
    """List the keys of the references of all filters, in their order."""
    keys = dict.fromkeys(str(look.get("cite") or "") for look in pack["filters"])
    return [key for key in keys if key in _entries()]


def format_bibliography(pack: Pack, conditions: Sequence[Condition]) -> str:
    """Format the BibTeX file of a study: pfbench itself, then the references of its filters."""
    return f"{format_bibtex(conditions)}\n{_find_entries(pack)}"


def renew_bibliography(pack: Pack) -> str:
    """Format the BibTeX file of stored data: its entry of pfbench, then the present references of the filters."""
    entry, end, _ = str(pack["bibtex"]).partition("\n}\n")
    return f"{entry}{end}\n{_find_entries(pack)}"


def _find_entries(pack: Pack) -> str:
    """Return the BibTeX entries of the references of all filters."""
    return "\n".join(_entries()[key] for key in list_cited_keys(pack))


def cite(keys: Sequence[str]) -> str:
    """Return the citation of keys, empty without one."""
    known_keys = [key for key in keys if key == SELF or key in _entries()]
    return rf"~\cite{{{','.join(known_keys)}}}" if known_keys else ""


@cache
def _entries() -> dict[str, str]:
    """Read the entries by key."""
    text = Path(__file__).with_name("methods.bib").read_text(encoding="utf-8")
    matches = re.finditer(r"^@\w+\{(\w+),\n.*?^\}\n", text, re.MULTILINE | re.DOTALL)
    return {entry[1]: entry[0] for entry in matches}


# --------------------------------------------------------------------------------------------------
# Budget of compared filters.
#
# A comparison is made at an equal budget: number of particles, time per step, or likelihood evaluations.
# The job key `budget` states the intended budget. The report adds the measured values.

_CLOSE = (
    1.25  # ratio to the target below which costs count as equal: times vary between jobs [ours]
)


def format_budget(metadata: Sequence[Mapping[str, Any]]) -> str:
    """Format the budget of compared jobs and its measured values as a table note.

    The target of a job is its price, which differs between conditions, or else the median of all jobs. Filters that miss it
    are named.
    """
    kind, *others = dict.fromkeys(map(_budget_kind, metadata))
    jobs = [meta for meta in metadata if meta.get("particles")]
    if others:
        return f"Budget: differs between jobs ({', '.join([kind, *others])})."
    if not jobs:
        return f"Budget: {kind} (without particle filters)."
    measure, scale, unit = _MEASURES[kind]
    measured = list(map(measure, jobs))
    if None in measured:
        return f"Budget: {kind} (as configured; the jobs do not count them)."
    costs = np.array(measured, dtype=np.float64)
    prices = [(meta.get("budget_allocation") or {}).get("price") for meta in jobs]
    ratios = costs / np.array([price or np.median(costs) for price in prices])
    close, missed = 1.0 if kind == SAME_N else _CLOSE, dict[str, list[float]]()
    for meta, ratio in zip(jobs, ratios, strict=True):
        if not 1 / close <= ratio <= close:
            missed.setdefault(str(meta.get("label", "")), []).append(ratio)
    far = ", ".join(f"{k} ({_format_range(v, 2)} times the target)" for k, v in missed.items())
    size = f"{_format_range(scale * costs, 3)} {unit} in each particle filter"
    return f"Budget: {kind}{f' not met by {far}' if far else ''} ({size})."


def _count_particles(meta: Mapping[str, Any]) -> float:
    """Return the number of particles, the mean of a filter that changes it."""
    return float(meta["particles_used"]["mean"] if "particles_used" in meta else meta["particles"])


_MEASURES: Mapping[str, tuple[Callable[[Mapping[str, Any]], float | None], float, str]] = {
    SAME_N: (_count_particles, 1.0, "particles"),
    SAME_TIME: (lambda meta: meta["seconds"]["per_step"], 1e3, "ms per step"),
    SAME_LIKELIHOODS: (lambda meta: meta.get("likelihoods_per_step"), 1.0, "likelihoods per step"),
}  # of a job by budget, with the scale and the unit that are shown


def _budget_kind(meta: Mapping[str, Any]) -> str:
    """Return the budget of a job."""
    kind = str(meta.get("budget") or _value_at(meta, "config.budget") or SAME_N)
    require(
        kind in BUDGETS,
        f"budget of job {meta.get('key')}",
        f"be one of {', '.join(BUDGETS)}",
        kind,
        "Repeat the job.",
    )
    return kind


def _format_range(values: Sequence[float] | np.ndarray, digits: int) -> str:
    """Format the range of values."""
    low, high = (f"{value:.{digits}g}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
