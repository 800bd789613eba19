"""Jobs, worlds and pairs of a sweep, before it runs."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import product
from typing import Any

from pfbench.cli.compose import given_keys, read_sweep
from pfbench.config.composition import JobConfig, compose
from pfbench.config.paper_block import PAPER
from pfbench.config.sweep_check import expand_sweep

# keys that are equal in all jobs of a condition, and how several values are run
_EQUAL_KEYS = {
    "seed": "Use more runs of one seed (runs=200), or one study for each seed: study=mine_1 seed=1, then study=mine_2 seed=2.",
    "runs": "Use the largest number, or one study for each number.",
    "first_run": "Use first runs that continue each other, such as first_run=0,100 with runs=100.",
}


@dataclass(frozen=True)
class StudyPlan:
    """Jobs of a sweep.

    Attributes:
        alternatives: Alternatives of each key, each as an override.
        first: Configuration of the first job.
        experiments: Names of the experiments.
    """

    alternatives: tuple[tuple[str, ...], ...]
    first: JobConfig
    experiments: tuple[str, ...]

    @property
    def jobs(self) -> int:
        """Number of jobs."""
        jobs = 1
        for options in self.alternatives:
            jobs *= len(options)
        return jobs

    @property
    def has_one_study(self) -> bool:
        """Return whether all jobs belong to one study."""
        return "study" not in self._swept_options() and len(self.experiments) < 2

    def check_comparable(self) -> None:
        """Check that the report of the study can compare the jobs, which needs equal data in each condition.

        Raises:
            ValueError: If the jobs of a condition differ in their seed or their runs.
        """
        report = self.first.values.get("report")
        if isinstance(report, Mapping) and report.get("allow_mixed_versions"):
            return
        for key, remedy in _EQUAL_KEYS.items():
            values = [option.partition("=")[2] for option in self._swept_options().get(key, ())]
            if len(set(values)) > 1 and not (key == "first_run" and self._continue_runs(values)):
                raise ValueError(
                    f"{key} must be one value in a study, since its report compares filters on equal data, got "
                    f"{', '.join(values[:5])}. {remedy} To run them all the same, and to report them, add "
                    "report.allow_mixed_versions=true to both commands."
                )

    def _continue_runs(self, first_runs: Sequence[str]) -> bool:
        """Return whether jobs with these first runs continue each other, so that a report joins them."""
        runs = self.first.values["runs"]
        numbers = [int(text) for text in first_runs if text.isdecimal()]
        is_whole = type(runs) is int and len(numbers) == len(first_runs)
        return is_whole and sorted(numbers) == [
            min(numbers) + k * runs for k in range(len(numbers))
        ]

    def list_families(self) -> dict[str, str]:
        """Return the family of each scenario of the sweep."""
        families: dict[str, str] = {}
        for k, options in enumerate(self.alternatives):
            if len(options) > 1 and given_keys(options[:1]) == {"scenario"}:
                for option in options:
                    words = [values[0] for values in self.alternatives]
                    words[k] = option
                    families |= dict([_family(compose_words(words))])
        return families or dict([_family(self.first)])

    def count_pairs(self) -> int:
        """Count the planned pairs of filters; at least 1, since one filter is compared later."""
        from pfbench.config.paper_files import plan_installed_pairs

        swept = self._swept_options()
        names = [option.partition("=")[2] for option in swept.pop("filter", ("filter=one",))]
        settings = [len(swept[key]) for key in swept if re.match(r"filter\.|particles$", key)]
        variants = 1
        for count in settings:
            variants *= count
        labels = names if variants == 1 else [f"{n} {k}" for n in names for k in range(variants)]
        return max(1, len(plan_installed_pairs(labels)))

    def compose_jobs(self) -> list[JobConfig]:
        """Compose the configurations of all jobs."""
        return [compose_words(words) for words in product(*self.alternatives)]

    def describe_size(self) -> str:
        """Describe what the chosen runs and worlds can show; empty if the runs are not one number."""
        from pfbench.results.statistics.study_size_sentence import describe_study_size

        runs = self.first.values["runs"]
        if type(runs) is not int or runs < 1 or "runs" in self._swept_options():
            return ""
        worlds = len(set(self.list_families().values()))
        return f"plan: {describe_study_size(runs, worlds, self.count_pairs())}"

    def _swept_options(self) -> dict[str, tuple[str, ...]]:
        """Return the alternatives of each key that has several."""
        several = [options for options in self.alternatives if len(options) > 1]
        return {next(iter(given_keys(options[:1]))): options for options in several}


def plan_study(overrides: Sequence[str], first: JobConfig | None = None) -> StudyPlan:
    """Plan a sweep, or a single job.

    Args:
        overrides: Overrides, some with several values, without flags.
        first: Configuration of the first job; None composes it.

    Returns:
        The plan.

    Raises:
        Exception: If an override or the configuration of the first job is not valid.
    """
    names = [word.partition("=")[2] for word in overrides if word.startswith("+experiment=")]
    params = [word for name in names for word in read_sweep(name)]
    alternatives = tuple(tuple(options) for options in expand_sweep([*params, *overrides]))
    first = first or compose_words([options[0] for options in alternatives])
    return StudyPlan(alternatives, first, tuple(names))


def compose_words(words: Sequence[str]) -> JobConfig:
    """Compose a configuration without the overrides of Hydra itself, except its search path.

    Args:
        words: Overrides of one value.
    """
    return compose([word for word in words if not re.match(r"[+~]*hydra[/.](?!searchpath)", word)])


def _family(config: JobConfig) -> tuple[str, str]:
    """Return the scenario of a job and its family, itself if none is set."""
    name = config.choices["scenario"]
    scenario: Any = config.values.get("scenario")
    paper = scenario.get(PAPER) if isinstance(scenario, dict) else None
    return name, str((paper or {}).get("family") or name)
