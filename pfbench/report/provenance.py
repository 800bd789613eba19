"""Provenance of a report: versions, seeds, times, choices, budget, citation and references."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np

from pfbench.report.journal.study_pack import Pack
from pfbench.results.conditions import Condition
from pfbench.results.store import BUDGETS, SAME_N, SAME_TIME
from pfbench.stats.study_runs import natural_sort_key

# --------------------------------------------------------------------------------------------------
# Provenance of a report: versions, seeds, time of the jobs, training, choices and citation.

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


def is_uncommitted(meta: Mapping[str, Any]) -> bool:
    """Return whether a job was computed in a checkout with changes that no commit has."""
    return str(_value_at(meta, "versions.commit") or "").endswith("-dirty")


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
    rows = []
    for name, path in _SHARED:
        values = [_value_at(job.meta, path) for cell in conditions for job in cell.jobs]
        rows.append(
            (
                name,
                ", ".join(distinct_values(str(value) for value in values if value is not None))
                or "not recorded",
            )
        )
    return rows


def compute_cost(conditions: Sequence[Condition], planned: int | None) -> list[tuple[str, str]]:
    """Count the jobs and sum their time by phase."""
    parts: Counter[str] = Counter()
    jobs = [job for cell in conditions for job in cell.jobs]
    for job in jobs:
        parts.update({name: job.meta["seconds"].get(name, 0.0) for name in _PHASES})
    shares = ", ".join(
        f"{phase} {100 * parts[name] / parts.total():.0f} %"
        for name, phase in _PHASES.items()
        if parts[name]
    )
    target = f" of {planned} in the experiment" if planned else ""
    elapsed = f"{_format_duration(parts.total())} ({shares})" if shares else "not recorded"
    return [("jobs", f"{len(jobs)}{target}"), ("time of all jobs", elapsed)]


def training_cost(conditions: Sequence[Condition]) -> list[tuple[str, str]]:
    """List the training data and the training cost of each learned filter."""
    rows = []
    for job in (job for cell in conditions for job in cell.jobs if job.meta.get("trained")):
        split, cost = job.meta["trained"]["split"], job.meta["trained"]["cost"]
        data = f"{split['train']['runs']} episodes of {split['scenario']}, " if split else ""
        effort = f"{cost['updates']} updates, {cost['seconds']:.0f} s on {cost['device']} ({cost['threads']} threads)"
        rows.append((f"training of {job.label}", data + effort))
    return list(dict.fromkeys(rows))


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


def find_entries(keys: Iterable[str]) -> str:
    """Return the BibTeX entries of keys; keys without an entry are left out."""
    entries = _entries()
    return "\n".join(entries[key] for key in dict.fromkeys(keys) if key in entries)


def format_bibliography(pack: Pack, conditions: Sequence[Condition]) -> str:
    """Format the BibTeX file of a study: pfbench itself, then the references of its filters."""
    return f"{format_bibtex(conditions)}\n{find_entries(list_cited_keys(pack))}"


def renew_bibliography(pack: Pack) -> str:
    """Format the BibTeX file of stored data: its entry of pfbench, then the present references of the filters."""
    entry, end, _ = str(pack["bibtex"]).partition("\n}\n")
    return f"{entry}{end}\n{find_entries(list_cited_keys(pack))}"


def cite(keys: Sequence[str]) -> str:
    """Return the citation of keys, empty without one."""
    known_keys = [key for key in keys if key == SELF or key in _entries()]
    return rf"~\cite{{{','.join(known_keys)}}}" if known_keys else ""


@cache
def _entries() -> dict[str, str]:
    """Read the entries by key."""
    text = Path(__file__).with_name("methods.bib").read_text(encoding="utf-8")
    entries = re.findall(r"^@\w+\{(\w+),\n.*?^\}\n", text, re.MULTILINE | re.DOTALL)
    blocks = re.findall(r"^@\w+\{\w+,\n.*?^\}\n", text, re.MULTILINE | re.DOTALL)
    return dict(zip(entries, blocks, strict=True))


# --------------------------------------------------------------------------------------------------
# Budget of compared filters.
#
# A comparison is made at an equal budget: number of particles, time per step, or likelihood evaluations.
# The job key `budget` states the intended budget. The report adds the measured values.

_NAMED = 4  # filters that are listed by name if their number of particles differs
_CLOSE = 1.25  # ratio of times per step below which budgets count as equal: times vary between jobs [ours]


def format_budget(metadata: Sequence[Mapping[str, Any]]) -> str:
    """Format the budget of compared jobs and its measured values as a table note."""
    kinds = list(dict.fromkeys(_budget_kind(meta) for meta in metadata))
    if len(kinds) > 1:
        return f"Budget: differs between jobs ({', '.join(kinds)})."
    (kind,) = kinds
    return f"Budget: {kind}{_format_measured(kind, metadata)}."


def _budget_kind(meta: Mapping[str, Any]) -> str:
    """Return the budget of a job."""
    config = meta.get("config")
    kind = str(
        meta.get("budget")
        or (config.get("budget") if isinstance(config, Mapping) else None)
        or SAME_N
    )
    if kind not in BUDGETS:
        options = ", ".join(BUDGETS)
        raise ValueError(
            f"budget must be one of {options}, got {kind} in job {meta.get('key')}. Repeat the job."
        )
    return kind


def _format_counts(metadata: Sequence[Mapping[str, Any]]) -> str:
    """Format the most frequent number of particles and the filters with other numbers."""
    by_label = [
        (int(meta["particles"]), str(meta.get("label", "")))
        for meta in metadata
        if meta.get("particles")
    ]
    count = Counter(number for number, _ in by_label)
    (most, _), *others = sorted(count.items(), key=lambda item: (-item[1], item[0]))
    texts = []
    for number, _ in sorted(others):
        labels = sorted({label for count_, label in by_label if count_ == number and label})
        texts.append(
            f"{number} of {', '.join(labels)}" if 0 < len(labels) <= _NAMED else str(number)
        )
    return f"N = {', '.join([str(most), *texts])}{_format_adaptive_counts(metadata)}"


def _format_adaptive_counts(metadata: Sequence[Mapping[str, Any]]) -> str:
    """Format the particle counts of filters that adapt them."""
    used: dict[str, list[Mapping[str, float]]] = {}
    for meta in metadata:
        if "particles_used" in meta:
            used.setdefault(str(meta.get("label", "")), []).append(meta["particles_used"])
    texts = [
        f"{label} used {min(row['least'] for row in rows)} to {max(row['most'] for row in rows)}, "
        f"{sum(row['mean'] for row in rows) / len(rows):.0f} on average"
        for label, rows in sorted(used.items())
    ]
    return "".join(f", {text}" for text in texts)


def _format_measured(kind: str, metadata: Sequence[Mapping[str, Any]]) -> str:
    """Format the measured budget of the particle filters."""
    jobs = [meta for meta in metadata if meta.get("particles")]
    if not jobs:
        return " (without particle filters)"
    if kind == SAME_N:
        numbers = sorted({int(meta["particles"]) for meta in jobs})
        return (
            f" (N = {numbers[0]} in each particle filter)"
            if len(numbers) == 1
            else f" not met ({_format_counts(metadata)})"
        )
    if kind == SAME_TIME:
        return _format_costs(
            [float(meta["seconds"]["per_step"]) for meta in jobs], 1e3, "ms per step", jobs
        )
    if any(meta.get("likelihoods_per_step") is None for meta in jobs):
        return " (as configured; the jobs do not count them)"
    return _format_costs(
        [float(meta["likelihoods_per_step"]) for meta in jobs], 1.0, "per step", jobs
    )


def _format_costs(
    costs: Sequence[float], scale: float, unit: str, metadata: Sequence[Mapping[str, Any]]
) -> str:
    """Format the cost of a step, and the filters that miss the target cost.

    The target is the price of the job, which differs between conditions, or else the median cost.
    """
    middle = float(np.median(costs))
    prices = [(meta.get("budget_allocation") or {}).get("price", middle) for meta in metadata]
    far: dict[str, list[float]] = {}
    for meta, cost, price in zip(metadata, costs, prices, strict=True):
        if not price / _CLOSE <= cost <= price * _CLOSE:
            far.setdefault(str(meta.get("label", "")), []).append(cost / price)
    text = f"{scale * min(costs):.3g} to {scale * max(costs):.3g} {unit}, particle filters only, {_format_counts(metadata)}"
    missed = [
        f"{label} ({_format_range(ratios)} times the target)" for label, ratios in far.items()
    ]
    return f" not met by {', '.join(missed)} ({text})" if missed else f" ({text})"


def _format_range(values: Sequence[float]) -> str:
    """Format the range of values."""
    low, high = (f"{value:.2g}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"
