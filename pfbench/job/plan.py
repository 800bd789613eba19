"""Plan of a job: a checked configuration and its objects, each built once."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from pfbench.config.composition import JobConfig
from pfbench.config.instantiation import instantiate_parts
from pfbench.config.paper_block import PAPER, PARTS
from pfbench.core.record import Episode
from pfbench.filter.learned.checkpoint import replace_checkpoint_by_hash
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.run_batches import choose_run_batch
from pfbench.job.inputs import find_inputs
from pfbench.job.settings import apply_global_settings
from pfbench.model.base import StateSpaceModel
from pfbench.results import store
from pfbench.results.config_key import PLACE_SETTINGS, Inputs, compute_config_key, extend_key
from pfbench.scenario.base import Scenario
from pfbench.scenario.recording_regime import RecordingRegime

# paths of the configuration that do not enter the key of a job
IGNORED_IN_KEY = (
    *PLACE_SETTINGS,
    *(f"{group}.{PAPER}" for group in PARTS),  # names and limits for reports
    "particles",  # part of the key where a filter uses it, as filter.particles
)
# settings of a comparison that are part of the key only if they differ from the default
DEFAULTS_NOT_IN_KEY: Mapping[str, Any] = {"budget": store.SAME_N}


@dataclass(frozen=True, eq=False)
class JobPlan:
    """Objects of a job.

    Budget and memory limit are applied to them, never to the configuration.

    Attributes:
        config: Resolved configuration.
        model: Model of the filter, on the CPU in double precision.
        scenario: Source of episodes.
        recording_regime: Noise regime that records the measurement channels of the scenario.
        method: Filter.
        runs: Numbers of the Monte Carlo runs, [R].
    """

    config: JobConfig
    model: StateSpaceModel
    scenario: Scenario
    recording_regime: RecordingRegime
    method: Any
    runs: Tensor

    @property
    def values(self) -> dict[str, Any]:
        """Values of the configuration."""
        return self.config.values

    @property
    def dtype(self) -> torch.dtype:
        """Precision of the filter."""
        dtype: torch.dtype = getattr(torch, self.values["dtype"])
        return dtype

    def draw_episode(self, runs: Tensor) -> Episode:
        """Draw the episode of some runs. Each run depends on its number and the seed only.

        Args:
            runs: Numbers of the runs, [R].

        Returns:
            Their measurements, inputs and truth.
        """
        return self.scenario.draw(self.recording_regime, runs, self.values["seed"])

    def make_filter_model(self, episode: Episode) -> StateSpaceModel:
        """Copy the model to the device and precision of the job.

        Args:
            episode: Episode of the job, with whose noise regime an oracle model agrees.

        Returns:
            The model that the filter receives.
        """
        model = copy.deepcopy(self.model)
        if self.values["oracle_noise"]:
            model = self.recording_regime.to_oracle_model(model, episode.time)
        return model.to(self.values["device"], self.dtype)

    def choose_run_batch(self, method: Any, runs: int) -> int:
        """Choose how many runs are stepped together. On a GPU all runs are.

        Args:
            method: Filter.
            runs: Number of runs.
        """
        if self.values["device"] != "cpu" or not isinstance(method, ParticleFilter):
            return runs
        return choose_run_batch(runs, method.particles, self.model.chart.size)

    def choose_timer(self) -> Callable[[], float]:
        """Choose processor time for one CPU thread, which other programs do not affect.

        Processor time adds up over threads, so wall time is used otherwise.
        """
        is_single = self.values["device"] == "cpu" and self.values["threads"] == 1
        return time.process_time if is_single else time.perf_counter


def build_plan(config: JobConfig) -> JobPlan:
    """Check a configuration, apply its global settings and build its objects once.

    Args:
        config: Resolved configuration.

    Returns:
        The plan. Nothing is drawn yet.

    Raises:
        ValueError: If a value of the configuration is invalid, or the model does not fit the scenario.
    """
    values = config.values
    apply_global_settings(values)
    # The model first: a scenario may contain it, and an error then names the key of the model.
    model, scenario, noise, method = instantiate_parts(
        values, ("model", "scenario", "noise", "filter"), config.trusted
    )
    runs = torch.arange(values["first_run"], values["first_run"] + values["runs"])
    return JobPlan(config, model, scenario, RecordingRegime(noise), method, runs)


def job_key(values: Mapping[str, Any], inputs: Inputs | None = None) -> str:
    """Compute the key of a job from all that affects its results.

    That is its settings and the content of all files that it reads, a user's classes included. The source
    code of pfbench is not part of it: reports refuse results of several builds.

    Args:
        values: Resolved configuration.
        inputs: Inputs of the job, see `find_inputs`. None to find them.

    Returns:
        16 hexadecimal digits. The first half depends on the settings alone.
    """
    inputs = find_inputs(values) if inputs is None else inputs
    values = {**values, "filter": replace_checkpoint_by_hash(values.get("filter"))}
    defaults = (k for k, default in DEFAULTS_NOT_IN_KEY.items() if values.get(k) == default)
    return extend_key(compute_config_key(values, (*IGNORED_IN_KEY, *defaults)), inputs)
