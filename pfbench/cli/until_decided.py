"""Sweep that adds runs until every planned pair of filters is decided: `runs=until-decided`."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from pfbench.cli.compose import UNTIL_DECIDED, StudyPlan
from pfbench.core.parameter_checks import require
from pfbench.job.config import JobConfig
from pfbench.job.inputs import find_inputs
from pfbench.job.settings import job_key
from pfbench.report.board.entries import build_run_table
from pfbench.results.conditions import load_conditions
from pfbench.results.metrics import check_page_metric
from pfbench.results.paper_block import plan_installed_pairs
from pfbench.stats.pair_states import (
    RECORD,
    LookRecord,
    LookSchedule,
    PairStates,
    decide_at_looks,
    describe_end,
    format_look,
)
from pfbench.stats.run_dependence import RUN, assess_runs, drop_runs
from pfbench.stats.study_runs import arrange_runs, share_conditions

_HOUR = 3600.0

# of the report: the decisions of a study follow from them, so they must not change between looks
_DECIDING_SETTINGS = ("metric", "alpha", "equivalence_margin", "start_time_s")


class LookResults(NamedTuple):
    """Results of a study until a look.

    Attributes:
        table: One row per filter, condition and run, without copies of runs.
        parts: Number of result files.
        seconds: Time that the simulation and the filters used, s.
        warning: Sentence on runs that are not independent; empty if none is shown.
    """

    table: pd.DataFrame
    parts: int
    seconds: float
    warning: str


@dataclass(frozen=True)
class GrowingSweep:
    """Sweep whose runs grow from look to look.

    Attributes:
        study: Name of the study.
        results: Folder of all studies.
        jobs: Configurations of all jobs, whose `runs` is `until-decided`.
        schedule: Looks.
        max_hours: Computing time of all jobs at most, h; None for no limit.
        repeats_jobs: Whether jobs run again although their results exist.
        report: Settings of the report, whose metric, level and margin decide.
    """

    study: str
    results: Path
    jobs: tuple[JobConfig, ...]
    schedule: LookSchedule
    max_hours: float | None
    repeats_jobs: bool
    report: Mapping[str, Any]

    @classmethod
    def from_plan(cls, plan: StudyPlan, *, is_sweep: bool) -> GrowingSweep:
        """Read the settings of a study."""
        require(
            is_sweep,
            f"runs={UNTIL_DECIDED}",
            "be a sweep over at least two filters",
            "one job",
            "Add -m and filter=NAME,NAME.",
        )
        values = plan.first.values
        settings = values["until_decided"]
        require(
            isinstance(settings, Mapping),
            "until_decided",
            "have the keys max_runs and max_hours",
            settings,
            "Leave it out.",
        )
        hours = settings["max_hours"]
        require(
            hours is None or (type(hours) in (int, float) and 0 < hours < math.inf),
            "until_decided.max_hours",
            "be positive or null",
            hours,
            "Use null for no limit.",
        )
        require(plan.has_one_study, "study", "be one name", "several", "Run each study by itself.")
        require(
            values["budget"] == "particles",
            "budget",
            "be particles with runs=until-decided, since a budget would set another number of particles at each look",
            values["budget"],
            "Use budget=particles.",
        )
        check_page_metric(values["report"]["metric"])
        schedule, jobs = LookSchedule(settings["max_runs"]), plan.compose_jobs()
        require(
            not all(config.values["filter"] == jobs[0].values["filter"] for config in jobs),
            "filter",
            "be at least two filters with runs=until-decided",
            "one per condition",
            "Add a filter (filter=ekf,sir), or set a number of runs.",
        )
        return cls(
            str(values["study"]), Path(values["results_dir"]), tuple(jobs),
            schedule, hours, values["overwrite"] or values["pcrb"] is True, values["report"],
        )  # fmt: skip

    def job_keys(self, number: int) -> set[str]:
        """Return the keys of all jobs until a look."""
        keys = set()
        for config in self.jobs:
            inputs = find_inputs(config.values, config.trusted)
            for first, runs in self.schedule.parts(number):
                numbers = {"first_run": config.values["first_run"] + first, "runs": runs}
                keys.add(job_key({**config.values, **numbers}, inputs))
        return keys

    def has_results(self, number: int) -> bool:
        """Return whether all jobs until a look have a file."""
        folder = self.results / self.study
        return all((folder / f"{key}.npz").exists() for key in self.job_keys(number))

    def read(self, number: int) -> LookResults:
        """Read the results until a look: one row per filter, condition and run, without copies of runs."""
        conditions = load_conditions(self.study, self.results, keys=self.job_keys(number))
        table = build_run_table(conditions, self.report["start_time_s"], self.report["metric"])
        copies, warning = assess_runs(table, "rmse", RUN)
        jobs = [job for condition in conditions for job in condition.jobs]
        seconds = sum(job.meta["seconds"]["world"] + job.meta["seconds"]["filter"] for job in jobs)
        parts = sum(len(job.parts) for job in jobs)
        return LookResults(drop_runs(table, copies, RUN), parts, float(seconds), warning)

    def run(self, run_part: Callable[[Sequence[str]], None]) -> None:
        """Run look after look until all pairs are decided or a cap is reached."""
        request = {  # settings that must not change between looks
            "until_decided.max_runs": self.schedule.max_runs,
            **{f"report.{name}": self.report[name] for name in _DECIDING_SETTINGS},
            "jobs": sorted(self.job_keys(1)),
        }
        record = LookRecord(self.results / self.study / RECORD, request)
        next_command = f"Next: pfbench report study={self.study}"
        if record.state and self.has_results(len(record.looks)) and not self.repeats_jobs:
            print(*record.looks, sep="\n")
            print(f"study {self.study} is finished: {record.state}\n{next_command}")
            return
        lines, seconds = list[str](), 0.0
        states: PairStates = []
        for number in range(1, len(self.schedule.runs) + 1):
            if number > 1 and (reason := self._exceeds_time(seconds, number)):
                record.write(lines)
                print(f"{reason}\n{next_command}")
                return
            data = self._compute_look(number, run_part)
            seconds = data.seconds
            earlier, states = states, self._decide(data)
            lines.append(format_look(number, self.schedule, states, earlier, data.warning))
            print(lines[-1], flush=True)
            state = describe_end(number, self.schedule, states)
            record.write(lines, state)
            if state:
                print(f"study {self.study} is finished: {state}\n{next_command}")
                return

    def _compute_look(self, number: int, run_part: Callable[[Sequence[str]], None]) -> LookResults:
        """Run the jobs of a look without a result, and read all runs so far."""
        start = self.jobs[0].values["first_run"]
        parts = [
            [f"runs={runs}", f"first_run={start + first}"]
            for first, runs in self.schedule.parts(number)
        ]
        if self.repeats_jobs or not self.has_results(number):
            run_part(parts[-1])
        try:
            data = self.read(number)
            is_complete = data.parts == len(self.job_keys(number))
        except ValueError:  # parts without their neighbours; another reason is raised again below
            is_complete = False
        if not is_complete:  # damaged files were set aside
            for words in parts:
                run_part(words)
            data = self.read(number)
        return data

    def _decide(self, data: LookResults) -> PairStates:
        """Decide the pairs that were fixed in advance with the runs so far."""
        count, required = len(data.table[["seed", "run"]].drop_duplicates()), self.schedule.runs[0]
        require(
            not count < required,
            "runs",
            f"be at least {required} independent ones",
            count,
            f"{data.warning} Use a scenario whose data differ from run to run, or set a number of runs.",
        )
        labels = sorted(data.table["filter"].unique())
        runs = arrange_runs(data.table, labels)
        pairs = [pair for pair in plan_installed_pairs(labels) if share_conditions(runs, *pair)]
        margin = math.log1p(self.report["equivalence_margin"])
        return decide_at_looks(
            runs, pairs, self.schedule, self.report["metric"], margin, self.report["alpha"]
        )

    def _exceeds_time(self, seconds: float, number: int) -> str:
        """Return why a look must not begin: its expected end exceeds the limit; empty if it may."""
        before, after = self.schedule.runs[number - 2 : number]
        expected = seconds * after / before / _HOUR
        if self.max_hours is None or expected <= self.max_hours:
            return ""
        return (
            f"stopped before look {number}: {after} runs would need {expected:.3g} h of computing "
            f"time, the limit until_decided.max_hours is {self.max_hours:g} h. Raise it and repeat "
            "the command to go on."
        )
