"""Data of a scenario's datasheet: its episodes before any filter, in one file."""

from __future__ import annotations

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench.core.record import Episode, iterate_steps
from pfbench.job.config import JobConfig
from pfbench.job.inputs import find_inputs
from pfbench.job.model_fit import instantiate_parts
from pfbench.job.pcrb import compute_pcrb
from pfbench.job.plan import apply_global_settings, describe_state, make_provenance
from pfbench.job.raw_estimate import compute_raw_estimate
from pfbench.job.settings import IGNORED_IN_KEY
from pfbench.model.base import StateSpaceModel
from pfbench.results import store
from pfbench.results.conditions import DATASHEETS, main_component_group
from pfbench.results.store import compute_config_key, extend_key
from pfbench.scenario.base import RecordingRegime

RUNS = 20  # default: spreads to a sixth, in seconds [ours]
_CONFIG_KEYS = ("scenario", "model", "noise", "seed", "first_run", "runs", "pcrb")


def build_datasheet(config: JobConfig, about: str = "") -> Path:
    """Write the data of a scenario's datasheet, unless the file exists.

    The file has the arrays of a job and those of `compute_datasheet`. `error` is the true state
    minus its mean over runs. `sd`, `nees` and `log_evidence` are NaN.

    Args:
        config: Resolved configuration, as for a job.
        about: Description of the scenario, one line.

    Returns:
        `<results>/datasheets/<key>.npz`.

    Raises:
        ValueError: If a value of the configuration is invalid.
    """
    values, choices = config.values, config.choices
    selected = {name: values[name] for name in _CONFIG_KEYS}
    inputs = find_inputs(selected)
    key = extend_key(compute_config_key(selected, IGNORED_IN_KEY), inputs)
    path = Path(values["results_dir"]) / DATASHEETS / f"{key}.npz"
    if path.exists() and not values["overwrite"]:
        return path
    meta, outputs = compute_datasheet(values)
    names = {group: choices[group] for group in ("scenario", "noise", "model")} | {"filter": "none"}
    head = {
        "key": key,
        "study": DATASHEETS,
        "label": "datasheet",
        "choices": names,
        "inputs": inputs,
    }
    return store.write_result(path, {**head, "config": selected, "about": about, **meta}, outputs)


def compute_datasheet(
    values: Mapping[str, Any],
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Draw episodes and compute the data of the datasheet.

    These arrays are added to those of a job:

    - `seen` [T, Dy], share of runs in which a component is measured.
    - `residual` [R, T, Dy], see `compute_residuals`.
    - `track` [R, T, 3] in m, `force` [T, 3] in m/s^2 and `rate` [T, 3] in rad/s, if they exist.
    - `azimuth` and `elevation` [T, S] in rad, `range` [T] in m, and `pcrb` [T, d], if they exist.
    """
    apply_global_settings(values)
    model, scenario, noise = instantiate_parts(values, ("model", "scenario", "noise"))
    runs = torch.arange(values["first_run"], values["first_run"] + values["runs"])
    start_time, recording_regime = time.perf_counter(), RecordingRegime(noise)
    with torch.no_grad():
        episode: Episode = scenario.draw(recording_regime, runs, values["seed"])
        drawn_time = time.perf_counter()
        inputs = find_inputs(values)
        pcrb, pcrb_text = compute_pcrb(values, model, recording_regime, episode, runs, inputs)
        truth = model.assemble(episode.truth)
        group = main_component_group(describe_state(model))
        deviation = compute_deviations(model, truth).float()
        raw = compute_raw_estimate(model, truth, episode.record, group.places)
        outputs = {
            "time": episode.time,
            "error": deviation,
            "sd": torch.full_like(deviation, torch.nan),
            "nees": torch.full((*truth.shape[:2], len(model.groups)), torch.nan),
            "log_evidence": torch.full((len(truth),), torch.nan),
            "lost": torch.zeros(len(truth), dtype=torch.bool),
            "residual": compute_residuals(model, truth, episode).float(),
            "seen": (~torch.isnan(episode.record.y)).double().mean(0).float(),
            **{name: value.float() for name, value in episode.datasheet.items()},
        }
    for name, value in (("track", episode.track), ("pcrb", pcrb)):
        if value is not None:
            outputs[name] = value.float()
    seconds = {"world": drawn_time - start_time, "measures": time.perf_counter() - drawn_time}
    meta = _make_metadata(values, model, episode, recording_regime) | {
        "pcrb": pcrb_text,
        "raw_estimate": raw._asdict() | {"threshold": raw.threshold},
        "seconds": seconds,
    }
    return meta, {name: value.cpu().numpy() for name, value in outputs.items()}


def compute_deviations(model: StateSpaceModel, truth: Tensor) -> Tensor:
    """Compute true states minus their mean over the runs with known truth.

    Returns deviations, [R, T, d]. NaN where the truth is unknown. Shapes: truth [R, T, D].
    """
    has_truth = ~torch.isnan(truth)
    # the first run with truth: its state is near the others, so that differences are small
    first = truth.gather(0, has_truth.int().argmax(0, keepdim=True))
    deviation = model.error(truth, first.expand_as(truth))
    return deviation - deviation.nanmean(0)


def compute_residuals(model: StateSpaceModel, truth: Tensor, episode: Episode) -> Tensor:
    """Compute standardised measurement residuals at the true state.

    Returns measurement minus expectation in standard deviations, [R, T, Dy]. NaN where the
    expectation depends on a state with unknown truth. Shapes: truth [R, T, D].
    """
    record = model.prepare(episode.record)
    origin = model.origin.expand(len(truth), -1)
    # unequal shifts, so that sums and differences of states change, too
    shift = torch.linspace(0.5, 1.5, model.chart.dimension, dtype=truth.dtype)
    shifted = model.chart.add(origin, shift.expand(len(truth), -1))
    residuals = []
    for t, _, step in iterate_steps(model, record):
        is_unknown = torch.isnan(truth[:, t])
        states = (torch.where(is_unknown, fill, truth[:, t]) for fill in (origin, shifted))
        distribution, shifted_distribution = (
            model.observation(x.unsqueeze(1), step.u) for x in states
        )
        expected = distribution.mean[:, 0]
        is_dependent = (shifted_distribution.mean[:, 0] != expected) & is_unknown.any(
            1, keepdim=True
        )
        z = model.residual(step.y, expected) / distribution.variance[:, 0].sqrt()
        residuals.append(torch.where(is_dependent, torch.nan, z))
    return torch.stack(residuals, 1)


def _make_metadata(
    values: Mapping[str, Any],
    model: StateSpaceModel,
    episode: Episode,
    recording_regime: RecordingRegime,
) -> dict[str, Any]:
    """Collect the metadata of the episodes."""
    runs, steps, size = episode.record.y.shape
    channels = recording_regime.channels
    has_kinds = channels is not None and len(channels.kind) == size
    satellites = episode.datasheet["elevation"].shape[1] if "elevation" in episode.datasheet else 0
    receiver = values["scenario"].get("receiver")
    names = (receiver.get("satellites") if isinstance(receiver, Mapping) else None) or []
    numbers = [str(i + 1) for i in range(satellites)]
    return {
        "seed": values["seed"],
        "first_run": values["first_run"],
        "runs": runs,
        "steps": steps,
        "kinds": list(channels.kind) if channels and has_kinds else ["measurement"] * size,
        "satellites": list(names) if len(names) == satellites else numbers,
        "modelling_choices": [*model.choices, *episode.notes],
        "state": describe_state(model),
        **make_provenance(),
    }
