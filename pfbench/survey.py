"""The datasheet of a scene: its worlds as they are, before any filter has seen them, in one file that a report reads."""

from __future__ import annotations

import platform
import time
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from pfbench import job, store
from pfbench.model.base import StateSpaceModel
from pfbench.record import Episode
from pfbench.scenario.told import Witness

RUNS = 20  # where the command says nothing: spreads to a sixth, in seconds [ours]
_PARTS = ("scenario", "model", "noise", "seed", "first_run", "runs", "bound")


def survey(config: Mapping[str, Any], choices: Mapping[str, str], about: str = "") -> Path:
    """The file of this scene's datasheet; drawn and measured only where it is not there yet, or with `fresh`.

    Args:
        config: composed and resolved, as for a job.
        choices: names of the scenario, noise and model in it.
        about: what the scene is, in a line.

    Returns:
        `<results>/datasheets/<key>.npz`, see `measure` for what it holds beside the arrays of a job, of which
            `error` is the true state less its mean over runs, and sd, nees and log_evidence are unknown.

    Raises:
        ValueError: bad values in the configuration.
    """
    own = {part: config[part] for part in _PARTS}
    path = Path(config["results"]) / job.DATASHEETS / f"{store.key(own, job.PLACES)}.npz"
    if path.exists() and not config["fresh"]:
        return path
    meta, arrays = measure(config)
    named = {**{part: choices[part] for part in ("scenario", "noise", "model")}, "filter": "none"}
    head = {"key": path.stem, "study": job.DATASHEETS, "label": "datasheet", "choices": named, "config": own, "about": about}
    return store.save(path, {**head, **meta}, arrays)


def measure(config: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Draws the worlds and measures them: what `store.save` wants, but for the identity.

    Beside the arrays of a job: `seen` [T, Dy], the share of the runs in which a component was measured; `residual` [R, T, Dy],
    measurement less what the model expects at the truth, in its standard deviations, NaN where it hangs on states without a
    truth; and where there are such, `track` [R, T, 3], `force`, `rate` [T, 3], `azimuth`, `elevation` [T, S], `range` [T] of
    the sheet of an Episode, `bound` [T, d].

    Raises:
        ValueError: bad values in the configuration.
    """
    job.settings(config)
    model, scenario, noise = (job.build(config[part]) for part in ("model", "scenario", "noise"))
    runs = torch.arange(config["first_run"], config["first_run"] + config["runs"])
    started, witness = time.perf_counter(), Witness(noise)
    with torch.no_grad():
        episode: Episode = scenario.draw(witness, runs, config["seed"])
        drawn = time.perf_counter()
        least, said = job.lower_bound(config, model, witness, episode)
        truth = model.assemble(episode.truth)
        arrays = {
            "time": episode.time,
            **_unfiltered(model, deviations(model, truth)),
            "residual": residuals(model, truth, episode).float(),
            "seen": (~torch.isnan(episode.record.y)).double().mean(0).float(),
            **{name: value.float() for name, value in episode.sheet.items()},
        }
    for name, value in (("track", episode.track), ("bound", least)):
        if value is not None:
            arrays[name] = value.float()
    seconds = {"world": drawn - started, "measures": time.perf_counter() - drawn}
    meta = _described(config, model, episode, witness) | {"bound": said, "seconds": seconds}
    return meta, {name: value.cpu().numpy() for name, value in arrays.items()}


def deviations(model: StateSpaceModel, truth: Tensor) -> Tensor:
    """True states less their mean over the runs that have a truth: [R, T, D] -> [R, T, d], NaN where there is none."""
    known = ~torch.isnan(truth)
    first = known.int().argmax(0, keepdim=True)  # some state about which differences are small
    away = model.error(truth, truth.gather(0, first).expand_as(truth))
    return away - away.nanmean(0)


def residuals(model: StateSpaceModel, truth: Tensor, episode: Episode) -> Tensor:
    """Measurements less what the model expects at the truth [R, T, D], in the standard deviations of its law: [R, T, Dy].

    A component whose expectation changes with a state that has no truth is NaN.
    """
    record = model.prepare(episode.record)
    origin = model.origin.expand(len(truth), -1)
    apart = torch.linspace(0.5, 1.5, model.chart.dimension, dtype=truth.dtype)  # unequal: sums and differences change too
    other = model.chart.add(origin, apart.expand(len(truth), -1))
    found = []
    for t in range(truth.shape[1]):
        seen, unknown = record.at(t), torch.isnan(truth[:, t])
        law, moved = (model.observation(torch.where(unknown, fill, truth[:, t]).unsqueeze(1), seen.u) for fill in (origin, other))
        expected = law.mean[:, 0]
        hangs = (moved.mean[:, 0] != expected) & unknown.any(1, keepdim=True)
        z = model.residual(seen.y, expected) / law.variance[:, 0].sqrt()
        found.append(torch.where(hangs, torch.nan, z))
    return torch.stack(found, 1)


def _unfiltered(model: StateSpaceModel, away: Tensor) -> dict[str, Tensor]:
    """The arrays that every result has, of nobody who filters."""
    runs, steps = away.shape[:2]
    return {
        "error": away.float(),
        "sd": torch.full_like(away, torch.nan, dtype=torch.float32),
        "nees": torch.full((runs, steps, len(model.groups)), torch.nan),
        "log_evidence": torch.full((runs,), torch.nan),
        "lost": torch.zeros(runs, dtype=torch.bool),
    }


def _described(config: Mapping[str, Any], model: StateSpaceModel, episode: Episode, witness: Witness) -> dict[str, Any]:
    """What was drawn."""
    runs, steps, size = episode.record.y.shape
    told = witness.channels
    kinds = list(told.kind) if told is not None and len(told.kind) == size else ["measurement"] * size
    satellites = episode.sheet["elevation"].shape[1] if "elevation" in episode.sheet else 0
    receiver = config["scenario"].get("receiver")
    names = (receiver.get("satellites") if isinstance(receiver, Mapping) else None) or []
    return {
        "seed": config["seed"],
        "first_run": config["first_run"],
        "runs": runs,
        "steps": steps,
        "kinds": kinds,
        "satellites": list(names) if len(names) == satellites else [str(i + 1) for i in range(satellites)],
        "choices_made": [*model.choices, *episode.notes],
        "state": {
            "names": list(model.names),
            "units": list(model.units),
            "groups": {name: list(parts) for name, parts in model.groups.items()},
        },
        "versions": job.versions(),
        "host": platform.node(),
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }
