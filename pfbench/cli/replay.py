"""Commands that compute stored jobs again.

Command `pfbench replay`: compute one stored run again, with all its traces.
Command `pfbench cost`: measure the time per step of the filters of a study in turn.
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pfbench.cli.command import Command, Option, in_range
from pfbench.cli.compose import PLACES, choose_places
from pfbench.cli.report import check_has_results
from pfbench.core.parameter_checks import require
from pfbench.job.config import compose
from pfbench.results.step_times import (
    FEWEST_ROUNDS,
    measurement_key,
    read_commit,
    read_step_times,
    write_step_times,
)


def replay_run(words: Sequence[str], run: int, filter: str, **choices: str | None) -> None:  # noqa: A002
    """Compute one stored run again, compare it and write its traces."""
    config = compose(words).values
    study, results = config["study"], Path(config["results_dir"])
    check_has_results(study, results)
    from pfbench.job import replay

    stored = replay.find_run(study, results, run, filter, {k: v for k, v in choices.items() if v})
    changes = choose_places(config, words)
    result = replay.recompute_run(stored, changes)
    comparable = replay.select_stored_scores(result, stored.result)
    meta = stored.result.meta
    print(f"run {stored.run} of {stored.condition.name} / {stored.job.label}, seed {meta['seed']}")
    print(f"status: {replay.describe_status(comparable)}")
    print(replay.describe_agreement(replay.compare_runs(stored.result, comparable)))
    stored_versions, versions = meta["versions"], result.meta["versions"]
    changes_of_versions = [
        f"{name} {stored_versions.get(name) or 'unknown'} to {versions.get(name) or 'unknown'}"
        for name in versions
        if stored_versions.get(name) != versions.get(name)
    ]
    if changes_of_versions:
        print(f"versions that changed since: {', '.join(changes_of_versions)}")
    if changed := replay.describe_changed_code(meta):
        print(changed)
    for name, old, new, unit in replay.tabulate_metrics(stored, comparable):
        print(f"  {name:28} {_format(new):>12} {unit:8} stored {_format(old)}")
    for path in replay.write_replay(stored, result, config["reports_dir"]):
        print(f"{path.suffix[1:]}: {path.resolve()}")


def _format(value: float) -> str:
    """Format a metric with six digits."""
    return f"{value:.6g}" if math.isfinite(value) else ("none" if math.isnan(value) else "infinite")


_NEEDED = "needed where the filter has results in several conditions"
REPLAY_COMMAND = Command(
    replay_run,
    """\
pfbench replay study=NAME run=NUMBER filter=NAME [scenario=NAME] [noise=NAME] [model=NAME] [key=value ...]

Compute one run of a stored job again, compare it with the stored numbers, print its status and metrics, and
write its traces (errors, standard deviations, NEES, ESS, NIS, track) as CSV and Parquet, and as
a figure.

  pfbench replay study=quickstart run=7 filter=sir
  pfbench replay study=mine run=3 filter=rpf scenario=flight_500s noise=outliers
  pfbench replay study=mine run=3 'filter=sir[particles=100]'     a label of the report

  OPTIONS
  device=cpu threads=1       where to compute; by default as stored
  trust=[mylab]              packages of a filter of your own, as in its run
  checkpoint=FILE            weights that are not in results_dir
  results_dir, reports_dir   folders; files go to REPORTS/STUDY/replay/""",
    options={
        "run": Option("0", "number of the run", in_range("whole [0, inf)")),
        "filter": Option("NAME", "filter, or a label of the report such as sir[particles=100]"),
        **{key: Option("NAME", _NEEDED, default=None) for key in ("scenario", "noise", "model")},
    },
    keys=("study", "results_dir", "reports_dir", *PLACES),
    required=("study", "run", "filter"),
)


def measure_cost(words: Sequence[str], rounds: int, seconds: float) -> None:
    """Measure the time per step of all filters of a study."""
    config = compose(words).values
    is_flag = type(config["overwrite"]) is bool
    require(is_flag, "overwrite", "be true or false", config["overwrite"], "Set overwrite=true.")
    study, results = config["study"], Path(config["results_dir"])
    check_has_results(study, results)
    changes = choose_places(config, words)
    start_time = time.perf_counter()
    count = _time_study(results / study, changes, (rounds, seconds), config["overwrite"])
    elapsed = time.perf_counter() - start_time
    print(f"cost: {count} conditions in {elapsed:.0f} s.  Next: pfbench report study={study}")


def _time_study(
    folder: Path, changes: dict[str, Any], numbers: tuple[int, float], overwrite: bool
) -> int:
    """Time the conditions of a study that are not yet in its file, and return their number."""
    from pfbench.job.replay import describe_changed_code
    from pfbench.job.step_timing import estimate_time, time_condition
    from pfbench.results.conditions import load_conditions

    rounds, seconds = numbers
    conditions = load_conditions(folder.name, folder.parent, allow_mixed_versions=True)
    keys = [
        measurement_key([(job.path.stem, read_commit(job.meta)) for job in condition.jobs])
        for condition in conditions
    ]
    measured = {} if overwrite else read_step_times(folder)
    measured = {key: entry for key, entry in measured.items() if key in keys}
    open_conditions = [c for k, c in zip(keys, conditions, strict=True) if k not in measured]
    rest = sum(estimate_time(condition, rounds, seconds) for condition in open_conditions)
    print(f"{len(open_conditions)} of {len(conditions)} conditions to measure, about {rest:.0f} s at the speed of their jobs")  # fmt: skip
    for number, (key, condition) in enumerate(zip(keys, conditions, strict=True), start=1):
        state = "skipped " if key in measured else "measured"
        if key not in measured:
            rest -= estimate_time(condition, rounds, seconds)
            measured[key] = time_condition(condition, changes, rounds, seconds)
            changed = {describe_changed_code(job.meta) for job in condition.jobs} - {""}
            print(
                *(f"note: {text}" for text in sorted(changed)), sep="\n", end="\n" * bool(changed)
            )
            write_step_times(folder, measured)
        jobs, steps = measured[key]["jobs"], measured[key]["steps"]
        used = len(next(iter(jobs.values()))["cpu"])
        size = f"{len(jobs)} filters, {steps} steps, {used} rounds; about {rest:.0f} s left{_name_engines(jobs)}"
        print(f"[{number}/{len(conditions)}] {state}  {condition.name}   {size}", flush=True)
    return len(conditions)


def _name_engines(jobs: Mapping[str, Mapping[str, Any]]) -> str:
    """Name the engine of each filter if they differ: SIR by a tape is faster than a filter without one."""
    engines = {job["label"]: job["engine"] for job in jobs.values()}
    text = ", ".join(f"{label} by {engine}" for label, engine in engines.items())
    return f"; engines: {text}" if len(set(engines.values())) > 1 else ""


COST_COMMAND = Command(
    measure_cost,
    """\
pfbench cost study=NAME [rounds=7] [overwrite=true] [key=value ...]

Measure the time per step of the filters of a study with results. All filters of a condition are built
once and take turns over the first steps, after one run each that is not counted. The report then
states medians with quartiles, and the ratio to the baseline with its interval. Without this command it has
one timing per job. Finished conditions are skipped: repeat an interrupted command to resume.

  pfbench cost study=quickstart
  pfbench cost study=mine rounds=15

  OPTIONS
  overwrite=true             measure finished conditions again
  device=cpu threads=1       where to measure; by default as stored
  trust=[mylab]              packages of filters of your own, as in their runs
  checkpoint=FILE            weights that are not in results_dir
  results_dir=FOLDER         the file is RESULTS/STUDY/step_times.json

See also: pfbench report study=NAME""",
    options={
        "rounds": Option("7", "at least 5", in_range(f"whole [{FEWEST_ROUNDS}, 1000]")),
        "seconds": Option(
            "0.05", "mean time of a filter in a round, s; at least 20 steps are taken", in_range("[0.001, 3600]")
        ),
    },
    keys=("study", "overwrite", "results_dir", "episode_cache_dir", *PLACES),
    required=("study",),
)  # fmt: skip
