"""Run of a job: one filter in one condition with all its runs, from plan to file.

This module imports torch only for a job that is not finished, since torch takes most of the start.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from pfbench.core.parameter_checks import require
from pfbench.files.atomic_write import (
    set_aside,
)
from pfbench.job.config import CHOICES, JobConfig, resolve_config
from pfbench.job.inputs import check_unchanged, find_inputs
from pfbench.job.settings import check_settings, job_key
from pfbench.job.trust import list_user_packages, trusted_packages
from pfbench.results import store
from pfbench.results.conditions import DATASHEETS
from pfbench.results.inputs import list_changed
from pfbench.results.paper_block import describe_foreign
from pfbench.results.status import describe_runs, main_rmse
from pfbench.results.store import Inputs, list_same_configuration

if TYPE_CHECKING:
    from omegaconf import DictConfig


log = logging.getLogger("pfbench")

_RESERVED = (DATASHEETS, "claims")  # folders of reports that are not studies


class JobOutcome(NamedTuple):
    """Outcome of a job.

    Attributes:
        path: Result file, see `store.read_result`.
        status: `finished`, or `skipped` because the file exists.
        rmse: Median over runs of the RMS error of the main group (position if there is one), in its unit; infinite if
            half of the runs keep no track.
    """

    path: Path
    status: str
    rmse: float


def run(
    config: JobConfig | DictConfig | Mapping[str, Any],
    choices: Mapping[str, str] | None = None,
    counter: object = "",
    announce: Callable[[], None] | None = None,
) -> JobOutcome:
    """Run one job and write its result file, unless the file exists.

    Args:
        config: Configuration, for instance `job.compose(["scenario=flight_300s", "filter=sir"])`.
        choices: Names of scenario, noise, filter and model, if `config` does not contain them.
        counter: Start of the log line of a job in a sweep, for instance `"[3/40] "`; its text is taken when
            the line is written. Empty for a job alone.
        announce: Function that is called when the data of the job are valid, before it is computed.

    Returns:
        The outcome.

    Raises:
        Exception: If the configuration or the data are not valid. Nothing is written for a job alone.
        Exception: If the job fails. The traceback is written to `<key>.failed.json` in the folder
            of the results, which a note of the error names.
    """
    config = resolve_config(config, choices)
    values = config.values
    inputs = find_inputs(values, config.trusted)
    path = find_result_path(values, inputs)
    job_choices = {group: config.choices[group] for group in CHOICES}
    title = " / ".join(job_choices[group] for group in ("scenario", "noise", "filter"))
    name = title + describe_foreign(values)
    result = None if values["overwrite"] else _read_finished(path, values)
    if result is not None:
        check_settings(values)
        outcome = JobOutcome(path, "skipped", main_rmse(result.data, result.meta))
        stored = result.meta["choices"]["filter"]
        of = "" if stored == job_choices["filter"] else f" of {stored}, which has the same settings"
        log.info("%sskipped   %s   result exists%s: %s   (overwrite=true to repeat)", counter, name, of, path)  # fmt: skip
        return outcome
    if inputs and not path.exists():
        _announce_change(path, job_choices, inputs)
    meta, outputs = _compute_or_note(config, name, path, announce, is_alone=not counter)
    check_unchanged(inputs, values, config.trusted)
    head = {
        "key": path.stem,
        "study": values["study"],
        "choices": job_choices,
        "config": values,
        "inputs": inputs,
        "trusted": list_used_packages(config),
    }
    store.write_result(path, {**head, **meta}, outputs)
    outcome = JobOutcome(path, "finished", main_rmse(outputs, meta))
    seconds = meta["seconds"]
    log.info(
        "%sfinished  t=%.1f s  %s   %s   %.3g ms/step",
        counter,
        seconds["world"] + seconds["filter"],
        name,
        describe_runs(outputs, {**head, **meta}),
        1e3 * seconds["per_step"],
    )
    return outcome


def list_used_packages(config: JobConfig) -> list[str]:
    """List the packages of a user that define classes of a job; empty if all are of pfbench."""
    values = {name: config.values.get(name) for name in CHOICES}
    packages = list_user_packages(values, (*config.trusted, *trusted_packages()))
    return list(dict.fromkeys(packages))


def _compute_or_note(
    config: JobConfig,
    name: str,
    path: Path,
    announce: Callable[[], None] | None,
    *,
    is_alone: bool,
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Compute a job, and write a note if it fails.

    A job alone without a plan or data is refused and leaves no note, whatever the error. The report of a
    sweep states all jobs that it lacks.
    """
    from pfbench.job import computation
    from pfbench.job.budget import EpisodeSource
    from pfbench.job.plan import build_plan

    episodes = None
    try:
        plan = build_plan(config)
        episodes = EpisodeSource(plan)
        if announce is not None:
            announce()
        return computation.compute_job(plan, name, episodes)
    except Exception as error:
        if is_alone and episodes is None:
            raise
        choices = {group: config.choices[group] for group in CHOICES}
        note = store.write_failure(path, choices, error, config.words)
        error.add_note(f"traceback: {note}" if note else f"previous result kept: {path}")
        raise


def _read_finished(path: Path, values: Mapping[str, Any]) -> store.JobResult | None:
    """Read the result of a finished job. A damaged file is set aside, and the job runs again."""
    try:
        result = store.read_result(path)
    except FileNotFoundError:  # not finished, or renamed by another sweep
        return None
    except store.DamagedResultError as error:
        new_path = set_aside(path)
        log.warning("warning  %s   renamed to %s. Running the job", error, new_path.name)
        return None
    # a bound that is requested now and was not when the job ran
    strictness = {False: 0, "auto": 1, True: 2}
    before = strictness.get(result.meta["config"].get("pcrb"), 0)
    if "pcrb" not in result.data and strictness.get(values["pcrb"], 0) > before:
        log.info("pcrb=%s   %s has no bound. Running the job", values["pcrb"], path.name)
        return None
    return result


def _announce_change(path: Path, choices: Mapping[str, str], inputs: Inputs) -> None:
    """State which inputs have changed since the latest result of the same configuration."""
    others = map(_read_meta, list_same_configuration(path, ".npz"))
    earlier = [meta for meta in others if meta.get("choices") == choices]
    if not earlier:
        return
    latest = max(earlier, key=lambda meta: str(meta.get("created", "")))
    changed = list_changed(latest.get("inputs", {}), inputs)
    log.info(
        "%s %s changed since the result of %s: new job",
        " and ".join(changed),
        "has" if len(changed) == 1 else "have",
        str(latest.get("created", ""))[:19].replace("T", " "),
    )


def _read_meta(path: Path) -> dict[str, Any]:
    """Read the metadata of another result, empty if it is damaged or not one of this version."""
    try:
        return store.read_metadata(path)
    except (ValueError, OSError):
        return {}


def find_result_path(values: Mapping[str, Any], inputs: Inputs) -> Path:
    """Return the file of a job, whether it is finished or not."""
    study = values["study"]
    require(
        study not in _RESERVED,
        "study",
        f"not be {' or '.join(_RESERVED)}",
        study,
        "These folders hold other reports. Choose another name.",
    )
    return Path(values["results_dir"]) / study / f"{job_key(values, inputs)}.npz"
