"""Methods paragraph of a study, from its records: what was done, and what was not done."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from pfbench.report.changing_sentences import (
    describe_equal_particles,
    describe_particles,
    describe_units,
    join_texts,
)
from pfbench.report.looks import describe_tuning, study_looks, study_part_names
from pfbench.report.provenance import distinct_values
from pfbench.results import store
from pfbench.results.conditions import Condition
from pfbench.results.status import divergence_threshold, scenario_family
from pfbench.results.step_times import STEP_TIME

_FEW_RUNS, _FEW_WORLDS = 10, 6


def describe_methods(
    conditions: Sequence[Condition],
    *,
    alpha: float = 0.05,
    margin: float = 0.05,
    pairs: int = 0,
    won: int = 0,
    metric: str = "RMS error",
) -> list[str]:
    """Describe how the results of a study were made.

    Args:
        conditions: Conditions of the study.
        alpha: Level of the families of tests.
        margin: Relative margin of equivalence.
        pairs: Number of planned pairs.
        won: Number of these pairs that are decided by the shares of runs won.
        metric: Name of the metric that decides.

    Returns:
        Two paragraphs of plain text: what was done, and what was not done.
    """
    jobs = [job.meta for condition in conditions for job in condition.jobs]
    done = [
        *_describe_design(conditions, jobs),
        *_describe_particles(conditions, jobs),
        *_describe_decisions(alpha, margin, (pairs, won), metric),
        *_describe_times(jobs),
        *_describe_software(jobs),
    ]
    return [" ".join(done), " ".join(["Not done:", *list_limits(conditions)])]


def list_limits(conditions: Sequence[Condition]) -> list[str]:
    """List what a study did not do, as sentences.

    Args:
        conditions: Conditions of the study.
    """
    jobs = [job.meta for condition in conditions for job in condition.jobs]
    seeds, runs = {job["seed"] for job in jobs}, min(int(job["runs"]) for job in jobs)
    families = _families(conditions)
    limits = []
    if len(seeds) == 1:
        limits.append(
            f"one seed ({seeds.pop()}) was used, so that no result was repeated with another."
        )
    if not any(_is_recorded(job) for job in jobs):
        limits.append("All worlds are simulated, and no recorded data were used.")
    if len(families) < _FEW_WORLDS:
        text = "One world says" if len(families) == 1 else f"{len(families)} worlds say"
        limits.append(f"{text} little about another world.")
    if runs < _FEW_RUNS:
        limits.append(
            f"{runs} runs per condition are fewer than the {_FEW_RUNS} that tests require."
        )
    if {job["config"].get("budget", store.SAME_N) for job in jobs} == {store.SAME_N}:
        limits.append(describe_equal_particles(_count_particles(conditions)))
    if all(divergence_threshold(job) is None for job in jobs):
        limits.append("No divergence threshold is stated, so only numerical failures count.")
    labels = [{job.label for job in condition.jobs} for condition in conditions]
    if any(names != set.union(*labels) for names in labels):
        limits.append("Not every filter was run in every condition.")
    tuning = describe_tuning(study_looks(conditions))
    limits.append(
        f"{tuning} Parameters of the {'other ' if tuning else ''}filters were not tuned for this comparison unless the paper says so.".lstrip()
    )
    if not _count_rounds(jobs):
        limits.append("Times were measured once on a machine that may have been shared.")
    return limits


def _describe_design(
    conditions: Sequence[Condition], jobs: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Describe filters, worlds, runs, seed and pairing."""
    filters = len({job.label for condition in conditions for job in condition.jobs})
    scenarios, regimes = (
        [name.name for name in study_part_names(conditions, group).values()]
        for group in ("scenario", "noise")
    )
    runs = distinct_values(str(job["runs"]) for job in jobs)
    seeds = distinct_values(str(job["seed"]) for job in jobs)
    families = len(_families(conditions))
    steps = distinct_values(str(job["steps"]) for job in jobs)
    worlds = _count(families, "world")
    if len(scenarios) > families:
        worlds = f"{_count(len(scenarios), 'scenario')} of {worlds}"
    return [
        f"This study compares {_count(filters, 'filter')} with pfbench in {worlds} ({'; '.join(scenarios)}) under {_count(len(regimes), 'noise regime')} ({'; '.join(regimes)}), with "
        f"{join_texts(runs, 'and')} Monte Carlo runs of {join_texts(steps, 'and')} steps per condition.",
        "All filters of a condition receive the same truths, measurements and random numbers "
        f"(seed {', '.join(seeds)}), so that comparisons are paired by run.",
    ]


def _describe_particles(
    conditions: Sequence[Condition], jobs: Sequence[Mapping[str, Any]]
) -> list[str]:
    """Describe the numbers of particles and the budget."""
    numbers = _count_particles(conditions)
    budgets = {str(job["config"].get("budget", store.SAME_N)) for job in jobs}
    if not numbers:
        return []
    names = {label: look.name for label, look in study_looks(conditions).items()}
    text = describe_particles({names[label]: counts for label, counts in numbers.items()})
    if budgets != {store.SAME_N}:
        return [f"{text}, chosen for equal cost ({', '.join(sorted(budgets - {store.SAME_N}))})."]
    return [f"{text}."]


def _count_particles(conditions: Sequence[Condition]) -> dict[str, list[int]]:
    """Return the numbers of particles of each particle filter by label."""
    numbers: dict[str, list[int]] = {}
    for job in (job for condition in conditions for job in condition.jobs):
        if job.meta.get("particles"):
            numbers.setdefault(job.label, []).append(int(job.meta["particles"]))
    return numbers


def _describe_decisions(
    alpha: float, margin: float, counts: tuple[int, int], metric: str
) -> list[str]:
    """Describe metric, intervals, tests and lost runs."""
    level, (pairs, won) = f"{100 * (1 - alpha):g} %", counts
    tests = (
        f"{_count(pairs, 'planned pair')} {'is' if pairs == 1 else 'are'} decided from {describe_units(pairs, won)}, paired by run, "
        "with runs as units and Holm's correction over all pairs, separately for track and error; "
        if pairs
        else "No pair was planned; "
    )
    return [
        f"The metric is the {metric} over the time of a run; a run that is lost or diverges counts as the largest.",
        f"Values are 20 % trimmed means over runs on the logarithmic scale, averaged over conditions; ratios to a baseline are paired by run, with {level} intervals.",
        f"{tests}intervals are simultaneous ({level}), and filters within {100 * margin:g} % are called equivalent.",
    ]


def _count_rounds(jobs: Sequence[Mapping[str, Any]]) -> int:
    """Count the rounds in which the times of all jobs were measured; 0 if a job has none."""
    return min(len(job.get(STEP_TIME, {}).get("rounds", ())) for job in jobs)


def _describe_times(jobs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Describe how times per step were measured in rounds; empty if they were not."""
    rounds = _count_rounds(jobs)
    text = f"Times per step are medians of {rounds} or more rounds in which the filters took turns."
    return [text] if rounds else []


def _describe_software(jobs: Sequence[Mapping[str, Any]]) -> list[str]:
    """Describe versions, commit, number type and device."""

    def values(name: str, group: str = "versions") -> str:
        nodes = (job.get(group, {}) for job in jobs)
        return (
            ", ".join(distinct_values(str(node[name]) for node in nodes if node.get(name)))
            or "unknown"
        )

    devices = ", ".join(distinct_values(str(job.get("device", "unknown")) for job in jobs))
    types = ", ".join(distinct_values(str(job.get("dtype", "unknown")) for job in jobs))
    threads = ", ".join(distinct_values(str(job.get("threads", "unknown")) for job in jobs))
    return [
        f"Software: pfbench {values('pfbench')} (commit {values('commit')}), Python {values('python')}, torch "
        f"{values('torch')}, numpy {values('numpy')}; {types} on {devices} ({_count_text(threads, 'thread')}).",
    ]


def _families(conditions: Sequence[Condition]) -> set[str]:
    """Return the families of the scenarios."""
    return {scenario_family(c.jobs[0].meta, c.scenario) for c in conditions}


def _is_recorded(meta: Mapping[str, Any]) -> bool:
    """Return whether the scenario of a job reads recorded data."""
    node = meta["config"].get("scenario")
    return isinstance(node, Mapping) and "root" in node


def _count(number: int, noun: str) -> str:
    """Format a count with its noun."""
    return f"{number} {noun}{'' if number == 1 else 's'}"


def _count_text(number: str, noun: str) -> str:
    """Format a count that is a text."""
    return f"{number} {noun}{'' if number == '1' else 's'}"
