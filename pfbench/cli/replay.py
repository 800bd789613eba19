"""Command `pfbench replay`: compute one stored run again, with all its traces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path

from pfbench.cli.command import Command, Option, in_range
from pfbench.cli.compose import PLACES, choose_places
from pfbench.cli.report import check_has_results
from pfbench.job.config import compose


def replay_run(words: Sequence[str], run: int, filter: str, **choices: str | None) -> None:  # noqa: A002
    """Compute one stored run again, compare it and write its traces."""
    config = compose(words).values
    study, results = config["study"], Path(config["results_dir"])
    check_has_results(study, results)
    from pfbench.job import replay
    from pfbench.job.run_selection import find_run

    stored = find_run(study, results, run, filter, {k: v for k, v in choices.items() if v})
    changes = choose_places(config, words)
    result = replay.recompute_run(stored, changes)
    comparable = replay.select_stored_scores(result, stored.result)
    meta = stored.result.meta
    print(f"run {stored.run} of {stored.condition.name} / {stored.job.label}, seed {meta['seed']}")
    print(f"status: {replay.describe_status(comparable)}")
    print(replay.describe_agreement(replay.compare_runs(stored.result, comparable)))
    _print_versions(meta["versions"], result.meta["versions"])
    if changed := replay.describe_changed_code(meta):
        print(changed)
    for name, old, new, unit in replay.tabulate_metrics(stored, comparable):
        print(f"  {name:28} {_format(new):>12} {unit:8} stored {_format(old)}")
    for path in replay.write_replay(stored, result, config["reports_dir"]):
        print(f"{path.suffix[1:]}: {path.resolve()}")


def _print_versions(stored: dict[str, str], current: dict[str, str]) -> None:
    """Print the versions that differ from those of the stored job."""
    changes = [
        f"{name} {stored.get(name) or 'unknown'} to {current.get(name) or 'unknown'}"
        for name in current
        if stored.get(name) != current.get(name)
    ]
    if changes:
        print(f"versions that changed since: {', '.join(changes)}")


def _format(value: float) -> str:
    """Format a metric with six digits."""
    return f"{value:.6g}" if math.isfinite(value) else ("none" if math.isnan(value) else "infinite")


_NEEDED = "needed where the filter has results in several conditions"
COMMAND = Command(
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
