"""Run of a job: one filter in one condition with all its runs, from plan to file."""

from __future__ import annotations

import logging
import math
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from torch import Tensor

from pfbench.config.composition import CHOICES, JobConfig, resolve_config
from pfbench.core.record import Episode
from pfbench.files.atomic_write import set_aside
from pfbench.filter.learned.checkpoint import checkpoint_provenance
from pfbench.job.allocation import EpisodeSource, apply_budget, max_runs_in_memory
from pfbench.job.filter_pass import TimedFilterPass, pass_filter
from pfbench.job.metadata import make_metadata
from pfbench.job.pcrb_cache import compute_pcrb
from pfbench.job.plan import DATASHEETS, JobPlan, build_plan, job_key
from pfbench.job.settings import check_settings
from pfbench.results import store

if TYPE_CHECKING:
    from omegaconf import DictConfig

log = logging.getLogger("pfbench")

_SHARED = ("time", "pcrb", "range", "score_steps")  # arrays without an axis of runs
_RESERVED = (DATASHEETS, "claims")  # folders of reports that are not studies


class JobOutcome(NamedTuple):
    """Outcome of a job.

    Attributes:
        path: Result file, see `store.load`.
        status: `finished`, or `skipped` because the file exists.
        rmse: Root mean square error of the main group (position if there is one) over all valid
            runs, in its unit.
    """

    path: Path
    status: str
    rmse: float


def run(
    config: JobConfig | DictConfig | Mapping[str, Any],
    choices: Mapping[str, str] | None = None,
    counter: str = "",
) -> JobOutcome:
    """Run one job and write its result file, unless the file exists.

    Args:
        config: Configuration, for instance `job.compose(["scenario=flight_300s", "filter=sir"])`.
        choices: Names of scenario, noise, filter and model, if `config` does not contain them.
        counter: Start of the log line, for instance `"[3/40] "`.

    Returns:
        The outcome.

    Raises:
        ValueError: If a value of the configuration is invalid.
        Exception: If the job fails. The traceback is written to `<key>.failed.json` in the folder
            of the results.
    """
    config = resolve_config(config, choices)
    values = config.values
    path = _result_path(values)
    job_choices = {group: config.choices[group] for group in CHOICES}
    name = " / ".join(job_choices[group] for group in ("scenario", "noise", "filter"))
    result = None if values["overwrite"] else _read_finished(path)
    if result is not None:
        check_settings(values)
        outcome = JobOutcome(path, "skipped", _main_rmse(result.data, result.meta))
        repeat = "(overwrite=true to repeat)"
        log.info("%sskipped   %s   result exists: %s   %s", counter, name, path, repeat)
        return outcome
    try:
        meta, outputs = compute_job(config, name)
    except Exception as error:
        note = store.write_failure(path, job_choices, error)
        remark = f"traceback: {note}" if note else f"previous result kept: {path}"
        log.error(
            "%sfailed    %s   %s: %s   %s", counter, name, type(error).__name__, error, remark
        )
        raise
    head = {"key": path.stem, "study": values["study"], "choices": job_choices, "config": values}
    store.write_result(path, {**head, **meta}, outputs)
    outcome = JobOutcome(path, "finished", _main_rmse(outputs, meta))
    seconds = meta["seconds"]
    log.info(
        "%sfinished  t=%.1f s  %s   %s   lost %d/%d   %.3g ms/step",
        counter,
        seconds["world"] + seconds["filter"],
        name,
        _format_rmse(outcome.rmse, meta),
        int(outputs["lost"].sum()),
        meta["runs"],
        1e3 * seconds["per_step"],
    )
    return outcome


def compute_job(config: JobConfig, label: str) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Compute a job without writing it.

    The configuration is instantiated once and the episode drawn once. Only if all runs do not fit
    into memory, they are computed in batches, with the same numbers.

    Args:
        config: Resolved configuration.
        label: Title of the progress bar.

    Returns:
        Metadata and arrays, see `store.Result`.

    Raises:
        ValueError: If a value is invalid, if a single run does not fit into memory, or if runs that
            are drawn in batches have different durations.
    """
    plan = build_plan(config)
    values, total = config.values, len(plan.runs)
    trained = checkpoint_provenance(
        values["filter"], config.choices["scenario"], values["seed"], plan.runs
    )
    episodes = EpisodeSource(plan)
    plan, allocation = apply_budget(plan, episodes)
    size = max_runs_in_memory(plan, episodes)
    pcrb = _timed_pcrb(plan, episodes.joint, plan.runs) if episodes.joint else None
    batch_metadata, batch_outputs = [], []
    for first in range(0, total, size):
        runs, episode = plan.runs[first : first + size], episodes.batch(first, size)
        batch_pcrb = pcrb or _timed_pcrb(plan, episode, runs)
        title = label if size == total else f"{label}, runs from {int(runs[0])}"
        result = pass_filter(plan, episode, runs, title)
        batch_metadata.append(_batch_metadata(plan, episode, result, batch_pcrb))
        batch_outputs.append(result.arrays(episode, batch_pcrb[0]))
    meta, outputs = _join_batches(batch_metadata, batch_outputs, total)
    if pcrb:  # the batches share it
        outputs |= {"pcrb": batch_outputs[0]["pcrb"]} if "pcrb" in outputs else {}
        meta["seconds"]["pcrb"] = pcrb[2]
    meta["seconds"] = {"world": episodes.seconds, **meta["seconds"]}
    if allocation:
        meta["particles"] = allocation.particles
    bought = allocation.to_metadata() if allocation else None
    return {**meta, "budget_allocation": bought, "trained": trained}, outputs


def _read_finished(path: Path) -> store.JobResult | None:
    """Read the result of a finished job. A damaged file is set aside, and the job runs again."""
    if not path.exists():
        return None
    try:
        return store.read_result(path)
    except store.DamagedResultError as error:
        new_path = set_aside(path)
        log.warning("warning  %s   renamed to %s. Running the job", error, new_path.name)
        return None


def _result_path(values: Mapping[str, Any]) -> Path:
    """Return the file of a job."""
    study = values["study"]
    if study in _RESERVED:
        raise ValueError(
            f"study must not be {' or '.join(_RESERVED)}, got {study}. These folders hold other "
            "reports. Choose another name."
        )
    return Path(values["results_dir"]) / study / f"{job_key(values)}.npz"


def _timed_pcrb(plan: JobPlan, episode: Episode, runs: Tensor) -> tuple[Tensor | None, str, float]:
    """Compute the bound, its description and the seconds."""
    start_time = time.perf_counter()
    sd, text = compute_pcrb(plan.values, plan.model, plan.recording_regime, episode, runs)
    return sd, text, time.perf_counter() - start_time


def _batch_metadata(
    plan: JobPlan, episode: Episode, result: TimedFilterPass, pcrb: tuple[Tensor | None, str, float]
) -> dict[str, Any]:
    """Collect the metadata of a batch."""
    runs, steps = episode.record.y.shape[:2]
    meta = make_metadata(plan, result.model, steps, episode.notes) | result.cost
    if (number := result.estimate.trace.get("particles")) is not None:
        extremes = {"least": int(number.min()), "most": int(number.max())}
        meta["particles_used"] = extremes | {"mean": float(number.mean())}
    return {**meta, "runs": runs, "pcrb": pcrb[1], "seconds": {"pcrb": pcrb[2], **result.seconds}}


def _join_batches(
    metadata: Sequence[dict[str, Any]], outputs: Sequence[dict[str, np.ndarray]], total: int
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Join the batches of a job. A PCRB of the batches becomes its root mean square."""
    if len(outputs) == 1:
        return metadata[0], outputs[0]
    if any(batch["time"].shape != outputs[0]["time"].shape for batch in outputs):
        size = metadata[0]["runs"]
        raise ValueError(
            "memory must be enough for all runs together, since they have different durations, got "
            f"enough for {size} runs. Split the job (runs={size}, first_run=...)."
        )
    joint = {
        name: first if name in _SHARED else np.concatenate([batch[name] for batch in outputs])
        for name, first in outputs[0].items()
    }
    weights = np.array([meta["runs"] for meta in metadata]) / total
    if "pcrb" in joint:
        variances = (batch["pcrb"].astype(float) ** 2 for batch in outputs)
        mean = sum(weight * v for weight, v in zip(weights, variances, strict=True))
        joint["pcrb"] = np.sqrt(mean).astype(np.float32)
    memory = [meta["memory"] for meta in metadata]
    times = [meta["seconds"] for meta in metadata]
    meta = {
        **metadata[0],
        "runs": total,
        "parts": len(outputs),
        "seconds": {name: sum(batch[name] for batch in times) for name in times[0]},
        "memory": None if None in memory else max(memory),
        "likelihoods_per_step": float(
            weights @ [meta["likelihoods_per_step"] for meta in metadata]
        ),
    }
    return meta, joint


def _main_group(meta: Mapping[str, Any]) -> str:
    """Return the group of the headline: position if there is one, else the first."""
    groups = meta["state"]["groups"]
    return "position" if "position" in groups else next(iter(groups))


def _main_rmse(outputs: Mapping[str, np.ndarray], meta: Mapping[str, Any]) -> float:
    """Compute the RMSE of the main group over all valid runs."""
    components = meta["state"]["groups"][_main_group(meta)]
    errors = outputs["error"][..., components].astype(float)
    square = (errors**2).sum(-1)[~outputs["lost"]]
    return math.sqrt(np.nanmean(square)) if np.isfinite(square).any() else math.inf


def _format_rmse(rmse: float, meta: Mapping[str, Any]) -> str:
    """Format the headline error with its unit, if the components share one."""
    group = _main_group(meta)
    units = {meta["state"]["units"][i] for i in meta["state"]["groups"][group]}
    return f"{group} RMSE {rmse:.4g} {units.pop() if len(units) == 1 else ''}".rstrip()
