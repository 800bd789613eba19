"""Facts of a study from which its methods paragraph is written: numbers, words and lists, computed once.

They are stored with the data of the page. Pairs and names of filters are not among them, since a stored page decides
and names them again.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any

from pfbench.report.looks import study_looks, study_part_names
from pfbench.report.provenance import distinct_values, list_builds
from pfbench.report.tuning_words import count_tuned
from pfbench.results import store
from pfbench.results.conditions import Condition
from pfbench.results.status import divergence_threshold, scenario_family
from pfbench.results.step_times import STEP_TIME

_VERSIONS = ("pfbench", "commit", "python", "torch", "numpy")
_PLACES = ("dtype", "device", "threads")


@dataclass(frozen=True)
class MethodsFacts:
    """Facts of a methods paragraph.

    Attributes:
        filters: Number of filters.
        scenarios: Names of the scenarios.
        worlds: Number of worlds; scenarios of one trajectory are one world.
        regimes: Names of the noise regimes.
        runs: Numbers of runs of a job, ascending.
        steps: Numbers of steps of a run, ascending.
        seeds: Seeds, ascending.
        particles: Numbers of particles of each particle filter, by label.
        budgets: Budgets of the jobs, such as `store.SAME_N`.
        metric: Name of the metric that decides.
        alpha: Level of the families of tests.
        margin: Relative margin of equivalence.
        rounds: Fewest rounds in which the times of a job were measured; 0 if a job has none.
        software: Versions, commit, number type, device and threads; an empty list is unknown.
        is_recorded: Whether a scenario reads recorded data.
        has_threshold: Whether a scenario states a divergence threshold.
        is_complete: Whether each filter was run in each condition.
        tuned: Numbers of filters with tuned parameters, by the data on which they were tuned.
    """

    filters: int
    scenarios: Sequence[str]
    worlds: int
    regimes: Sequence[str]
    runs: Sequence[int]
    steps: Sequence[int]
    seeds: Sequence[int]
    particles: Mapping[str, Sequence[int]]
    budgets: Sequence[str]
    metric: str
    alpha: float
    margin: float
    rounds: int
    software: Mapping[str, Sequence[str]]
    is_recorded: bool
    has_threshold: bool
    is_complete: bool
    tuned: Mapping[str, int]

    def to_entries(self) -> dict[str, Any]:
        """Return plain values, from which `from_entries` restores the facts."""
        return asdict(self)

    @classmethod
    def from_entries(cls, entries: object, source: str = "methods") -> MethodsFacts:
        """Restore the facts of a page.

        Args:
            entries: Values of `to_entries`.
            source: Where they are stored, for the message of an error.

        Raises:
            ValueError: If a fact is missing.
        """
        stored = entries if isinstance(entries, Mapping) else {}
        names = [field.name for field in fields(cls)]
        if missing := [name for name in names if name not in stored]:
            raise ValueError(
                f"{source} must have all facts of the methods paragraph, got none for "
                f"{', '.join(missing)}. Run the study and write its report again."
            )
        return cls(**{name: stored[name] for name in names})


def collect_methods_facts(
    conditions: Sequence[Condition],
    *,
    alpha: float = 0.05,
    margin: float = 0.05,
    metric: str = "RMS error",
) -> MethodsFacts:
    """Collect the facts of a methods paragraph from the results of a study.

    Args:
        conditions: Conditions of the study.
        alpha: Level of the families of tests.
        margin: Relative margin of equivalence.
        metric: Name of the metric that decides.
    """
    jobs = [job.meta for condition in conditions for job in condition.jobs]
    labels = [{job.label for job in condition.jobs} for condition in conditions]
    scenarios, regimes = (
        [name.name for name in study_part_names(conditions, group).values()]
        for group in ("scenario", "noise")
    )
    return MethodsFacts(
        filters=len(set.union(*labels)),
        scenarios=scenarios,
        worlds=len({scenario_family(c.jobs[0].meta, c.scenario) for c in conditions}),
        regimes=regimes,
        runs=_list_numbers(job["runs"] for job in jobs),
        steps=_list_numbers(job["steps"] for job in jobs),
        seeds=_list_numbers(job["seed"] for job in jobs),
        particles=_list_particles(conditions),
        budgets=sorted({str(job["config"].get("budget", store.SAME_N)) for job in jobs}),
        metric=metric,
        alpha=alpha,
        margin=margin,
        rounds=min(len(job.get(STEP_TIME, {}).get("rounds", ())) for job in jobs),
        software=_list_software(jobs),
        is_recorded=any(_is_recorded(job) for job in jobs),
        has_threshold=any(divergence_threshold(job) is not None for job in jobs),
        is_complete=all(names == set.union(*labels) for names in labels),
        tuned=count_tuned(study_looks(conditions)),
    )


def _list_numbers(values: Iterable[Any]) -> list[int]:
    """List the distinct numbers."""
    return sorted(set(map(int, values)))


def _list_particles(conditions: Sequence[Condition]) -> dict[str, list[int]]:
    """List the numbers of particles of each particle filter by label."""
    numbers: dict[str, set[int]] = {}
    for job in (job for condition in conditions for job in condition.jobs):
        if job.meta.get("particles"):
            numbers.setdefault(job.label, set()).add(int(job.meta["particles"]))
    return {label: sorted(counts) for label, counts in sorted(numbers.items())}


def _list_software(jobs: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """List versions, commit, number type, device and threads of the jobs."""
    versions = [job.get("versions", {}) for job in jobs]
    software = {name: [node[name] for node in versions if node.get(name)] for name in _VERSIONS}
    software["commit"] = list_builds(jobs)
    software |= {name: [job[name] for job in jobs if name in job] for name in _PLACES}
    return {name: distinct_values(map(str, values)) for name, values in software.items()}


def _is_recorded(meta: Mapping[str, Any]) -> bool:
    """Return whether the scenario of a job reads recorded data."""
    node = meta["config"].get("scenario")
    return isinstance(node, Mapping) and "root" in node
