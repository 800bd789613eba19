"""Computation of a job from its plan: episodes, bound, filter pass and scores, in batches where memory needs it."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from torch import Tensor

from pfbench.core.record import Episode
from pfbench.files.command_start import start_work
from pfbench.job.budget import EpisodeSource, apply_budget, max_runs_in_memory
from pfbench.job.filter_pass import TimedFilterPass, describe_unmoved_copies, pass_filter
from pfbench.job.inputs import find_inputs, names_checkpoint
from pfbench.job.pcrb import compute_pcrb
from pfbench.job.plan import JobPlan, make_metadata
from pfbench.results.joined_runs import join_arrays, join_metadata


def compute_job(
    plan: JobPlan, label: str, episodes: EpisodeSource | None = None
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Compute a job without writing it.

    The episode is drawn once. Only if all runs do not fit into memory, they are computed in batches,
    with the same numbers.

    Args:
        plan: Plan of the job, see `build_plan`.
        label: Title of the progress bar.
        episodes: Episodes of the job, None to draw them.

    Returns:
        Metadata and arrays, see `store.JobResult`.

    Raises:
        ValueError: If a single run does not fit into memory, or if runs that are drawn in batches
            have different durations.
    """
    episodes = episodes or EpisodeSource(plan)
    start_work()
    total = len(plan.runs)
    trained = _describe_training(plan)
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
    meta, outputs = _join_batches(batch_metadata, batch_outputs)
    if pcrb:  # the batches share it
        outputs |= {"pcrb": batch_outputs[0]["pcrb"]} if "pcrb" in outputs else {}
        meta["seconds"]["pcrb"] = pcrb[2]
    meta["seconds"] = {"world": episodes.seconds, **meta["seconds"]}
    if allocation:
        meta["particles"] = allocation.particles
    bought = allocation.to_metadata() if allocation else None
    return {**meta, "budget_allocation": bought, "trained": trained}, outputs


def _describe_training(plan: JobPlan) -> dict[str, Any] | None:
    """Return what a report states about the trained weights of a filter, None if it has none."""
    values = plan.values
    if not names_checkpoint(values["filter"]):
        return None
    from pfbench.filter.learned.checkpoint import checkpoint_provenance

    scenario = plan.config.choices["scenario"]
    return checkpoint_provenance(values["filter"], scenario, values["seed"], plan.runs)


def _timed_pcrb(plan: JobPlan, episode: Episode, runs: Tensor) -> tuple[Tensor | None, str, float]:
    """Compute the bound, its description and the seconds."""
    start_time = time.perf_counter()
    inputs = find_inputs(plan.values, plan.config.trusted)
    sd, text = compute_pcrb(plan.values, plan.model, plan.recording_regime, episode, runs, inputs)
    return sd, text, time.perf_counter() - start_time


def _batch_metadata(
    plan: JobPlan, episode: Episode, result: TimedFilterPass, pcrb: tuple[Tensor | None, str, float]
) -> dict[str, Any]:
    """Collect the metadata of a batch."""
    runs, steps = episode.record.y.shape[:2]
    notes = (*episode.notes, *describe_unmoved_copies(plan, result.model, episode.record))
    meta = make_metadata(plan, result.model, steps, notes) | result.cost
    if episode.measured_truth is not None:
        meta["measured_truth"] = episode.measured_truth.name
    if (number := result.estimate.trace.get("particles")) is not None:
        extremes = {"least": int(number.min()), "most": int(number.max())}
        meta["particles_used"] = extremes | {"mean": float(number.mean())}
    return {**meta, "runs": runs, "pcrb": pcrb[1], "seconds": {"pcrb": pcrb[2], **result.seconds}}


def _join_batches(
    metadata: Sequence[dict[str, Any]], outputs: Sequence[dict[str, Any]]
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Join metadata and arrays of batches. ValueError if the runs of two have different durations."""
    if len(outputs) == 1:
        return metadata[0], outputs[0]
    if any(batch["time"].shape != outputs[0]["time"].shape for batch in outputs):
        size = metadata[0]["runs"]
        raise ValueError(
            "memory must be enough for all runs together, since they have different durations, got "
            f"enough for {size} runs. Split the job (runs={size}, first_run=...)."
        )
    return join_metadata(metadata), join_arrays(outputs, metadata)
