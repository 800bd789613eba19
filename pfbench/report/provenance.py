"""What made the results of a report: versions, seeds, jobs and what they took, training, readings chosen; and how to cite it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from pfbench.report.frame import Cell, natural

_SHARED = (
    ("pfbench", "versions.pfbench"),
    ("commit", "versions.commit"),
    ("python", "versions.python"),
    ("torch", "versions.torch"),
    ("numpy", "versions.numpy"),
    ("host", "host"),
    ("device", "device"),
    ("number type", "dtype"),
    ("threads", "threads"),
    ("seed", "seed"),
    ("first run", "first_run"),
    ("runs per filter", "runs"),
    ("steps per run", "steps"),
)

_TAKEN = {"filter": "filters", "scores": "scores", "world": "worlds", "bound": "bounds", "compile": "compilation"}


def shared(found: Sequence[Cell]) -> list[tuple[str, str]]:
    """What all jobs ran with; several values are listed, as they are in a mixed report."""
    rows = []
    for name, path in _SHARED:
        values = [_at(job.meta, path) for cell in found for job in cell.jobs]
        rows.append((name, ", ".join(distinct(str(value) for value in values if value is not None)) or "not stated"))
    return rows


def spent(found: Sequence[Cell], planned: int | None) -> list[tuple[str, str]]:
    """How many jobs there are, and what they took, from the drawing of worlds to the scores."""
    parts: Counter[str] = Counter()
    jobs = [job for cell in found for job in cell.jobs]
    for job in jobs:
        parts.update({name: job.meta["seconds"].get(name, 0.0) for name in _TAKEN})
    shares = ", ".join(f"{what} {100 * parts[name] / parts.total():.0f} %" for name, what in _TAKEN.items() if parts[name])
    of = f" of {planned} that the experiment asks for" if planned else ""
    took = f"{_duration(parts.total())} ({shares})" if shares else "not stated"
    return [("jobs", f"{len(jobs)}{of}"), ("time of all jobs", took)]


def trained(found: Sequence[Cell]) -> list[tuple[str, str]]:
    """What networks were trained on, and what that cost, filter by filter."""
    rows = []
    for job in (job for cell in found for job in cell.jobs if job.meta.get("trained")):
        split, cost = job.meta["trained"]["split"], job.meta["trained"]["cost"]
        worlds = f"{split['train']['runs']} worlds of {split['scenario']}, " if split else ""
        spent = f"{cost['updates']} updates, {cost['seconds']:.0f} s on {cost['device']} ({cost['threads']} threads)"
        rows.append((f"training of {job.label}", worlds + spent))
    return list(dict.fromkeys(rows))


def choices(found: Sequence[Cell]) -> list[tuple[str, str]]:
    """Each reading or choice that a job made, with the filters that made it."""
    made: dict[str, list[str]] = {}
    for cell in found:
        for job in cell.jobs:
            for text in job.meta.get("choices_made", ()):
                made.setdefault(text, []).append(job.label)
    everyone = {job.label for cell in found for job in cell.jobs}
    return [(text, "all" if set(who) == everyone else ", ".join(distinct(who))) for text, who in sorted(made.items())]


def bibtex(found: Sequence[Cell]) -> str:
    """An entry that a user can paste: the versions that made the results, and the year they were made in."""
    metas = [job.meta for cell in found for job in cell.jobs]
    version = ", ".join(distinct(str(_at(meta, "versions.pfbench")) for meta in metas))
    commit = ", ".join(distinct(str(_at(meta, "versions.commit")) for meta in metas if _at(meta, "versions.commit")))
    years = [str(meta["created"])[:4] for meta in metas if meta.get("created")]
    note = f"  note    = {{Commit {commit}}},\n" if commit else ""
    return (
        "@software{pfbench,\n"
        "  author  = {{The pfbench authors}},\n"
        "  title   = {{pfbench}: probabilistic programming and benchmarking of particle filters in integrated navigation},\n"
        f"  version = {{{version}}},\n{note}"
        + (f"  year    = {{{max(years)}}},\n" if years else "")
        + "}\n"
    )


def _duration(seconds: float) -> str:
    if seconds < 120:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.0f} min" if seconds < 7200 else f"{seconds / 3600:.1f} h"


def distinct(values: Iterable[str]) -> list[str]:
    """Each value once, in the order of names."""
    return sorted(set(values), key=natural)


def _at(meta: Any, path: str) -> Any:
    for name in path.split("."):
        meta = meta.get(name) if isinstance(meta, Mapping) else None
    return meta
