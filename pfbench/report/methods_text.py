"""Methods paragraph of a study: the facts, computed once, and the text written from them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import SimpleNamespace
from typing import Any

from pfbench.report.journal.study_pack import Pack
from pfbench.report.provenance import distinct_values, list_builds, name_build
from pfbench.results import store
from pfbench.results.conditions import Condition
from pfbench.results.looks import count_tuned, describe_tuning, study_looks, study_part_names
from pfbench.results.status import divergence_threshold, scenario_family
from pfbench.results.step_times import STEP_TIME
from pfbench.stats.sentences import format_count

# Facts are stored with the data of the page. Pairs and names of filters are not among them, since a stored page decides
# and names them again.

_VERSIONS = ("pfbench", "commit", "python", "torch", "numpy")
_PLACES = ("dtype", "device", "threads")


FACTS = {
    "filters": "number of filters",
    "scenarios": "names of the scenarios",
    "worlds": "number of worlds; scenarios of one trajectory are one world",
    "regimes": "names of the noise regimes",
    "runs": "numbers of runs of a job, ascending",
    "steps": "numbers of steps of a run, ascending",
    "seeds": "seeds, ascending",
    "particles": "numbers of particles of each particle filter, by label",
    "budgets": "budgets of the jobs, such as `store.SAME_N`",
    "metric": "name of the metric that decides",
    "alpha": "level of the families of tests",
    "margin": "relative margin of equivalence",
    "rounds": "fewest rounds in which the times of a job were measured; 0 if a job has none",
    "software": "versions, commit, number type, device and threads; an empty list is unknown",
    "is_recorded": "whether a scenario reads recorded data",
    "has_threshold": "whether a scenario states a divergence threshold",
    "is_complete": "whether each filter was run in each condition",
    "tuned": "numbers of filters with tuned parameters, by the data on which they were tuned",
}


def read_facts(entries: object, source: str = "methods") -> SimpleNamespace:
    """Read the facts of a page; one that lacks a fact is refused."""
    stored = entries if isinstance(entries, Mapping) else {}
    if missing := [name for name in FACTS if name not in stored]:
        raise ValueError(
            f"{source} must have all facts of the methods paragraph, got none for "
            f"{', '.join(missing)}. Run the study and write its report again."
        )
    return SimpleNamespace(**{name: stored[name] for name in FACTS})


def collect_methods_facts(
    conditions: Sequence[Condition],
    *,
    alpha: float = 0.05,
    margin: float = 0.05,
    metric: str = "RMS error",
) -> dict[str, Any]:
    """Collect the facts of a methods paragraph from the results of a study, see `FACTS`."""
    jobs = [job.meta for condition in conditions for job in condition.jobs]
    labels = [{job.label for job in condition.jobs} for condition in conditions]
    scenarios, regimes = (
        [name.name for name in study_part_names(conditions, group).values()]
        for group in ("scenario", "noise")
    )
    return {
        "filters": len(set.union(*labels)),
        "scenarios": scenarios,
        "worlds": len({scenario_family(c.jobs[0].meta, c.scenario) for c in conditions}),
        "regimes": regimes,
        "runs": _list_numbers(job["runs"] for job in jobs),
        "steps": _list_numbers(job["steps"] for job in jobs),
        "seeds": _list_numbers(job["seed"] for job in jobs),
        "particles": _list_particles(conditions),
        "budgets": sorted({str(job["config"].get("budget", store.SAME_N)) for job in jobs}),
        "metric": metric,
        "alpha": alpha,
        "margin": margin,
        "rounds": min(len(job.get(STEP_TIME, {}).get("rounds", ())) for job in jobs),
        "software": _list_software(jobs),
        "is_recorded": any(is_recorded(job) for job in jobs),
        "has_threshold": any(divergence_threshold(job) is not None for job in jobs),
        "is_complete": all(names == set.union(*labels) for names in labels),
        "tuned": count_tuned(study_looks(conditions)),
    }


def _list_numbers(values: Iterable[Any]) -> list[int]:
    """List the distinct numbers."""
    return sorted(set(map(int, values)))


def _list_particles(conditions: Sequence[Condition]) -> dict[str, list[int]]:
    """List the numbers of particles of each particle filter by label."""
    pairs = {
        (job.label, int(job.meta["particles"]))
        for condition in conditions for job in condition.jobs if job.meta.get("particles")
    }  # fmt: skip
    return {label: sorted(n for name, n in pairs if name == label) for label, _ in sorted(pairs)}


def _list_software(jobs: Sequence[Mapping[str, Any]]) -> dict[str, list[str]]:
    """List versions, commit, number type, device and threads of the jobs."""
    versions = [job.get("versions", {}) for job in jobs]
    software = {name: [node[name] for node in versions if node.get(name)] for name in _VERSIONS}
    software["commit"] = list_builds(jobs)
    software |= {name: [job[name] for job in jobs if name in job] for name in _PLACES}
    return {name: distinct_values(map(str, values)) for name, values in software.items()}


def is_recorded(meta: Mapping[str, Any]) -> bool:
    """Return whether the scenario of a job reads recorded data."""
    node = meta["config"].get("scenario")
    return isinstance(node, Mapping) and "root" in node


# --------------------------------------------------------------------------------------------------
# Methods paragraph of a study, written from its facts: what was done, and what was not done.

_FEW_RUNS, _FEW_WORLDS = 10, 6


def write_methods(pack: Pack) -> list[str]:
    """Write the methods paragraph of a study from the data of its page.

    Returns two paragraphs of plain text: what was done, and what was not done.
    """
    facts = read_facts(pack["methods"])
    names = {str(look["key"]): str(look["name"]) for look in pack["filters"]}
    rounds = f"Times per step are medians of {facts.rounds} or more rounds in which the filters took turns."
    done = [
        *_describe_design(facts),
        _describe_particles(facts, names),
        *_describe_decisions(facts, len(pack["planned"])),
        rounds * bool(facts.rounds),
        _describe_software(facts),
    ]
    return [" ".join(filter(None, done)), " ".join(["Not done:", *_list_limits(facts)])]


def _list_limits(facts: SimpleNamespace) -> list[str]:
    """List what a study did not do, as sentences."""
    worlds = "One world says" if facts.worlds == 1 else f"{facts.worlds} worlds say"
    tuning = describe_tuning(facts.tuned, facts.filters)
    are_equal = len(set(map(tuple, facts.particles.values()))) == 1
    kind = f": particle filters have {'equal' if are_equal else 'different'} numbers of particles"
    limits = (
        (len(facts.seeds) == 1, f"one seed ({facts.seeds[0]}) was used, so that no result was repeated with another."),
        (not facts.is_recorded, "All worlds are simulated, and no recorded data were used."),
        (facts.worlds < _FEW_WORLDS, f"{worlds} little about another world."),
        (min(facts.runs) < _FEW_RUNS, f"{min(facts.runs)} runs per condition are fewer than the {_FEW_RUNS} that tests require."),
        (set(facts.budgets) == {store.SAME_N}, f"The filters were not given equal time{kind * (len(facts.particles) > 1)}."),
        (not facts.has_threshold, "No divergence threshold is stated, so only numerical failures count."),
        (not facts.is_complete, "Not every filter was run in every condition."),
        (True, f"{tuning} Parameters of the {'other ' if tuning else ''}filters were not tuned for this comparison unless the paper says so.".lstrip()),
        (not facts.rounds, "Times were measured once on a machine that may have been shared."),
    )  # fmt: skip
    return [text for is_so, text in limits if is_so]


def _describe_design(facts: SimpleNamespace) -> list[str]:
    """Describe filters, worlds, runs, seed and pairing."""
    worlds = format_count(facts.worlds, "world")
    if len(facts.scenarios) > facts.worlds:
        worlds = f"{format_count(len(facts.scenarios), 'scenario')} of {worlds}"
    return [
        f"This study compares {format_count(facts.filters, 'filter')} with pfbench in {worlds} ({'; '.join(facts.scenarios)}) under {format_count(len(facts.regimes), 'noise regime')} ({'; '.join(facts.regimes)}), with "
        f"{_join(facts.runs, 'and')} Monte Carlo runs of {_join(facts.steps, 'and')} steps per condition.",
        "All filters of a condition receive the same truths, measurements and random numbers "
        f"(seed {', '.join(map(str, facts.seeds))}), so that comparisons are paired by run.",
    ]


def _describe_particles(facts: SimpleNamespace, names: Mapping[str, str]) -> str:
    """Describe the numbers of particles, with the names of filters that differ, and the budget; empty without any."""
    if not facts.particles:
        return ""
    filters: dict[tuple[int, ...], list[str]] = {}
    for label, numbers in facts.particles.items():
        filters.setdefault(tuple(numbers), []).append(names[label])
    usual = max(filters, key=lambda numbers: len(filters[numbers]))
    listed = {n: f"{_join(n, 'or')} ({', '.join(sorted(filters[n]))})" for n in sorted(filters)}
    others = "; ".join(text for numbers, text in listed.items() if numbers != usual)
    text = f"{_join(usual, 'or')} particles" + f", with these exceptions: {others}" * bool(others)
    if others and 2 * len(filters[usual]) <= len(facts.particles):
        text = f"{_join(list(listed.values()), 'and')} particles"
    budgets = ", ".join(budget for budget in facts.budgets if budget != store.SAME_N)
    return f"Particle filters used {text}" + f", chosen for equal cost ({budgets})" * bool(budgets) + "."  # fmt: skip


def _describe_decisions(facts: SimpleNamespace, pairs: int) -> list[str]:
    """Describe metric, lost runs, intervals, tests and families."""
    level = f"{100 * (1 - facts.alpha):g} %"
    planned = f"the {format_count(pairs, 'planned pair')} and " if pairs else ""
    return [
        f"The metric is the {facts.metric} over the time of a run; a run that is lost or diverges is worse than every other one, "
        "and two such runs tie.",
        "Ratios are those of Hodges and Lehmann over paired runs, from logarithms that are averaged over the conditions, "
        f"with simultaneous intervals ({level}).",
        "There is no ratio where more than a fifth of the pairs has a lost run.",
        "Better and worse: Wilcoxon's signed-rank test, the t test of the 20 % trimmed mean and the sign test reject, each after "
        "Holm's correction, and all agree in sign. Equal: the interval lies within "
        f"{100 * facts.margin:g} %, and fewer than 10 % of the runs are lost by one filter alone, by the bounds of Clopper "
        "and Pearson. Loses more: McNemar's exact test with Holm's correction.",
        f"Two families share the pairs of a table: {planned}the filters against the first baseline, and all other pairs.",
    ]


def _describe_software(facts: SimpleNamespace) -> str:
    """Describe versions, commit, number type and device."""
    value = {name: ", ".join(values) or "unknown" for name, values in facts.software.items()}
    threads = f"{value['threads']} thread{'' if value['threads'] == '1' else 's'}"
    return (
        f"Software: pfbench {value['pfbench']} ({name_build(value['commit'])}), Python {value['python']}, torch "
        f"{value['torch']}, numpy {value['numpy']}; {value['dtype']} on {value['device']} ({threads})."
    )


def _join(values: Sequence[object], word: str) -> str:
    """List values with a word before the last one."""
    texts = list(map(str, values))
    return f" {word} ".join(filter(None, [", ".join(texts[:-1]), texts[-1]]))
