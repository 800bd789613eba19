"""Command `pfbench replay`: one stored run, computed again with all its traces."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pfbench.cli.compose import split_words
from pfbench.cli.report import check_has_results
from pfbench.core.parameter_checks import require
from pfbench.job.config import compose
from pfbench.job.file_rules import FOLDER_KEYS

HELP = """\
pfbench replay study=NAME run=NUMBER filter=NAME [scenario=NAME] [noise=NAME] [model=NAME] [key=value ...]

Compute one run of a stored job again, compare it with the stored numbers, print its status and metrics, and
write its traces (errors, standard deviations, NEES, ESS, NIS, track) as CSV and Parquet, and as
a figure.

  pfbench replay study=quickstart run=7 filter=sir
  pfbench replay study=mine run=3 filter=rpf scenario=flight_500s noise=outliers
  pfbench replay study=mine run=3 'filter=sir[particles=100]'     a label of the report

  scenario, noise, model     needed where the filter has results in several conditions
  device=cpu threads=1       where to compute; by default as stored
  trust=[mylab]              packages of a filter of your own, as in its run
  checkpoint=FILE            weights that are not in results_dir
  results_dir, reports_dir   folders; files go to REPORTS/STUDY/replay/"""

_CHOICES = ("scenario", "noise", "model")
_REQUIRED = ("study", "run", "filter")
_FOLDERS = ("results_dir", "reports_dir")
_PLACES = ("device", "threads", "checkpoint")


def replay_run(words: Sequence[str]) -> None:
    """Compute one stored run again, compare it and write its traces."""
    keys = (*_REQUIRED, *_CHOICES, *_FOLDERS, *_PLACES)
    usage = "study=NAME run=NUMBER filter=NAME"
    values = split_words(words, keys, _REQUIRED, f"pfbench replay {usage}")
    config = compose(
        [f"{key}={values[key]}" for key in ("study", *_FOLDERS, *_PLACES) if key in values]
    )
    study, results = config.values["study"], Path(config.values["results_dir"])
    check_has_results(study, results)
    from pfbench.job import replay
    from pfbench.job.replay import compare_runs, describe_agreement
    from pfbench.job.run_selection import find_run

    choices = {key: values[key] for key in _CHOICES if key in values}
    stored = find_run(study, results, _run_number(values["run"]), values["filter"], choices)
    changes: dict[str, Any] = {
        key: config.values[key]
        for key in ("data", *FOLDER_KEYS, *_PLACES)
        if key in values or key not in _PLACES
    }
    result = replay.recompute_run(stored, changes)
    comparable = replay.select_stored_scores(result, stored.result)
    meta = stored.result.meta
    print(f"run {stored.run} of {stored.condition.name} / {stored.job.label}, seed {meta['seed']}")
    print(f"status: {replay.describe_status(comparable)}")
    print(describe_agreement(compare_runs(stored.result, comparable)))
    _print_versions(meta["versions"], result.meta["versions"])
    if changed := replay.describe_changed_code(meta):
        print(changed)
    for name, old, new, unit in replay.tabulate_metrics(stored, comparable):
        print(f"  {name:28} {_format(new):>12} {unit:8} stored {_format(old)}")
    for path in replay.write_replay(stored, result, config.values["reports_dir"]):
        print(f"{path.suffix[1:]}: {path.resolve()}")


def _run_number(text: str) -> int:
    """Convert the number of a run."""
    require(text.isdecimal(), "run", "be a whole number of at least 0", text, "Set run=0.")
    return int(text)


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
