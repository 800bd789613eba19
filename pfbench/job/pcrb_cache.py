"""PCRB of a job's episodes, stored with them and shared by all filters of a study."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Container, Mapping
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from pfbench.core.record import Episode
from pfbench.job.pcrb import compute_posterior_bound
from pfbench.model.base import StateSpaceModel
from pfbench.noise.white import NominalNoise
from pfbench.results.config_key import Inputs
from pfbench.scenario.episode_cache import load_or_build
from pfbench.scenario.recording_regime import RecordingRegime


def compute_pcrb(
    values: Mapping[str, Any],
    model: StateSpaceModel,
    recording_regime: RecordingRegime,
    episode: Episode,
    runs: Tensor,
    inputs: Inputs | None = None,
) -> tuple[Tensor | None, str]:
    """Compute the posterior Cramér-Rao bound on the error of all filters.

    The bound belongs to the simulated noise regime, so it is computed for the oracle noise model,
    whether or not the filters receive it. Runs share a recursion where one exists, otherwise each
    run has a recursion. If filters start from a measurement outside the record, the bound starts
    from the initial distribution of the model. The result is cached by all that decides it,
    including the source file of the model.

    Args:
        values: Resolved configuration of the job.
        model: Model of the filter, on the CPU in double precision, without oracle noise.
        recording_regime: Noise regime, after the episode was drawn.
        episode: Episode of the runs.
        runs: Numbers of the runs, [R].
        inputs: Inputs of the job, see `find_inputs`.

    Returns:
        Standard deviations [T, d], in the units of the state, and a description. Otherwise None
        and the reason.
    """
    reason = _missing_reason(values, episode)
    if reason:
        return None, reason
    is_nominal = isinstance(recording_regime.regime, NominalNoise)
    try:
        oracle = model if is_nominal else recording_regime.to_oracle_model(model, episode.time)
    except ValueError:
        return None, "no bound: the errors of this noise regime have no distribution per step"
    is_replaced = episode.record.spread is not None
    initial = torch.diag_embed(model.initial(1).variance[0]) if is_replaced else None

    def compute() -> dict[str, Tensor]:
        truth, is_separate = oracle.assemble(episode.truth), model.linear
        try:
            covariance = compute_posterior_bound(oracle, truth, episode.record, initial)
        except ValueError:  # without a shared recursion; the second call raises the other reasons
            is_separate = True
            covariance = compute_posterior_bound(
                oracle, truth, episode.record, initial, run_by_run=True
            )
        sd = covariance.diagonal(dim1=-2, dim2=-1).clamp(min=0).sqrt()
        return {"pcrb": sd.contiguous(), "is_separate": torch.tensor(is_separate)}

    try:
        result = load_or_build(
            values["episode_cache_dir"], _recipe(values, model, runs, inputs or {}), compute
        )
    except ValueError as error:
        wrapper = "" if is_nominal else f"{type(oracle).__name__}: "
        return None, "no bound: " + f"{error}".removeprefix(wrapper)
    oracle_text = "" if is_nominal else " with oracle noise"
    method = "mean over the runs" if bool(result["is_separate"]) else "one recursion for all runs"
    start = ", from the model's own initial distribution" if is_replaced else ""
    return result["pcrb"], f"posterior Cramer-Rao bound of the model{oracle_text}, {method}{start}"


def _recipe(
    values: Mapping[str, Any], model: StateSpaceModel, runs: Tensor, inputs: Inputs
) -> tuple[object, ...]:
    """Return all that decides the bound."""
    scenario = {**values["scenario"], "root": None, "cache_dir": None}
    source = Path(inspect.getfile(type(model))).read_bytes()
    source_hash = hashlib.sha256(source).hexdigest()
    episodes = values["noise"], values["seed"], int(runs[0]), len(runs)
    read = {group: inputs[group] for group in ("scenario", "noise", "model") if group in inputs}
    return ("bound 1", source_hash, values["model"], scenario, *episodes, *([read] if read else []))


def lacks_bound(values: Mapping[str, Any], meta: Mapping[str, Any], names: Container[str]) -> bool:
    """Return whether a finished job lacks a bound that is requested now and was not when it ran.

    Args:
        values: Resolved configuration of the job.
        meta: Metadata of its result.
        names: Names of the arrays of its result.
    """
    strictness = {False: 0, "auto": 1, True: 2}
    before = strictness.get(meta["config"].get("pcrb"), 0)
    return "pcrb" not in names and strictness.get(values["pcrb"], 0) > before


def _missing_reason(values: Mapping[str, Any], episode: Episode) -> str:
    """Return why the bound is not computed, or an empty text."""
    if values["pcrb"] is False:
        return "no bound: not requested (pcrb=false)"
    if values["pcrb"] is True:
        return ""
    if "root" in values["scenario"]:
        return "no bound: the distributions of recorded errors are unknown"
    if episode.record.feedback is not None:
        return "no bound: the filter's estimates change the INS output (closed loop)"
    for name, value in values["model"].items():
        if name in ("inflation", "process_noise_factor") and value not in (None, 1.0):
            return (
                "no bound: the process noise of the model is larger than the simulated one "
                f"(model.{name})"
            )
    return ""
