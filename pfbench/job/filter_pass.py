"""One pass of a filter over an episode: engine, scores, time and memory."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode
from pfbench.filter.belief import StepInfo
from pfbench.filter.gaussian.gaussian_filter import GaussianFilter
from pfbench.filter.loop import FilterResult, Watch, run_filter
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.job.plan import JobPlan
from pfbench.job.scoring import LikelihoodCounter, ScoreRecorder
from pfbench.job.system_memory import MemoryTrimmer, peak_above, start_peak_measurement
from pfbench.kernels import compilation
from pfbench.kernels.cpp_library import is_library_loaded
from pfbench.model.base import StateSpaceModel

log = logging.getLogger("pfbench")

# in normal numbers: compiling costs seconds and saves 15 ms per million [measured]
_COMPILE_FROM = 5e8


class TimedFilterPass(NamedTuple):
    """Results of one pass.

    Attributes:
        model: Model that the filter received.
        estimate: Output of the filter.
        recorder: Errors and scores.
        seconds: Time of scoring, compiling, filtering, and filtering per step.
        cost: Engine, peak memory and likelihood evaluations per step and run.
    """

    model: StateSpaceModel
    estimate: FilterResult
    recorder: ScoreRecorder
    seconds: dict[str, float]
    cost: dict[str, Any]

    def arrays(self, episode: Episode, pcrb: Tensor | None) -> dict[str, np.ndarray]:
        """Collect the arrays of a result.

        They are NaN from the step at which a run is lost.

        Args:
            episode: Episode of the runs.
            pcrb: Standard deviations of the PCRB, [T, d], or None.

        Returns:
            Arrays by name, see `store.Result`.
        """
        estimate, trace = self.estimate, dict(self.estimate.trace)
        is_lost = torch.isnan(estimate.mean).any(-1, keepdim=True)
        sd = estimate.variance.clamp(min=0).sqrt()
        outputs = {
            "time": episode.time,
            "error": torch.where(is_lost, torch.nan, trace.pop("error")).float(),
            "sd": torch.where(is_lost, torch.nan, sd).float(),
            "nees": torch.where(is_lost, torch.nan, trace.pop("nees")).float(),
            "log_evidence": estimate.log_evidence.double(),
            "lost": estimate.lost,
            "health": estimate.health,
            **{name: a if a.dtype == torch.bool else a.float() for name, a in trace.items()},
        }
        scores = self.recorder.arrays()
        outputs |= {name: a.float() if a.is_floating_point() else a for name, a in scores.items()}
        optional = {"track": episode.track, "pcrb": pcrb, "range": episode.datasheet.get("range")}
        outputs |= {name: a.float() for name, a in optional.items() if a is not None}
        return {name: a.cpu().numpy() for name, a in outputs.items()}


def pass_filter(plan: JobPlan, episode: Episode, runs: Tensor, label: str) -> TimedFilterPass:
    """Run the filter of a plan over an episode and measure errors, time and memory.

    Args:
        plan: Plan of the job.
        episode: Episode of the runs.
        runs: Numbers of the runs, [R].
        label: Title of the progress bar.

    Returns:
        The results.
    """
    values, method, clock = plan.values, plan.method, plan.choose_timer()
    device, engine = values["device"], values["engine"]
    model, steps = plan.make_filter_model(episode), episode.record.y.shape[1]
    truth = model.assemble(episode.truth).to(device, plan.dtype)
    recorder = ScoreRecorder(model, truth, values["score_steps"], clock)
    counter = LikelihoodCounter(model)

    def watch(t: int, info: StepInfo) -> dict[str, Tensor]:
        with counter.paused():
            return recorder(t, info)

    compile_start = time.perf_counter()
    uses_kernels = should_compile(engine, method, model, len(runs) * steps)
    compile_seconds = time.perf_counter() - compile_start
    step = _compile_step(engine, uses_kernels, method, counter, clock)
    baseline = start_peak_measurement(device)
    start_time = clock()
    with compilation.use_compiled(uses_kernels):
        estimate = _filter_episode(plan, step or method, model, episode, runs, watch, label)
    step_compile_seconds = step.seconds if step else 0.0
    filter_seconds = clock() - start_time - recorder.seconds - step_compile_seconds
    seconds = {
        "scores": recorder.seconds,
        "compile": compile_seconds + step_compile_seconds,
        "filter": filter_seconds,
        "per_step": filter_seconds / steps,
    }
    cost = {
        "engine": "compiled" if step and step.is_active else "kernels" if uses_kernels else "eager",
        "memory": peak_above(baseline, device),
        "likelihoods_per_step": counter.count / (len(runs) * steps),
    }
    return TimedFilterPass(model, estimate, recorder, seconds, cost)


def _filter_episode(
    plan: JobPlan,
    method: Any,
    model: StateSpaceModel,
    episode: Episode,
    runs: Tensor,
    watch: Watch,
    label: str,
) -> FilterResult:
    """Run a filter over an episode, with a progress bar."""
    device, trim = plan.values["device"], MemoryTrimmer()
    draws = PhiloxStream(plan.values["seed"], runs.to(device), plan.dtype)
    batch = plan.choose_run_batch(plan.method, len(runs))

    def tick() -> None:
        bar.update()
        trim()

    with (
        torch.no_grad(),
        tqdm(
            total=episode.record.y.shape[1], desc=label, unit="step", delay=2, disable=None,
            leave=False,
        ) as bar,
    ):  # fmt: skip
        estimate = run_filter(method, model, episode.record, draws, watch, tick, batch)
        if device != "cpu":
            torch.cuda.synchronize()
    return estimate


def should_compile(engine: str, method: Any, model: StateSpaceModel, run_steps: int) -> bool:
    """Decide whether the C++ operators are used, and load them.

    They are if the engine requires it, or if the job is large enough.

    Args:
        engine: Engine of the job.
        method: Filter.
        model: Model of the filter.
        run_steps: Number of runs times number of steps.

    Returns:
        Whether they are used. False if they cannot be loaded.
    """
    numbers = 0
    if isinstance(method, ParticleFilter):
        numbers = run_steps * method.particles * model.noise_dim
    elif isinstance(method, GaussianFilter):
        # linear algebra costs as much as eight normal numbers per entry of a covariance
        numbers = run_steps * 8 * model.chart.dimension**2
    if engine == "eager" or (engine == "auto" and numbers < _COMPILE_FROM):
        return False
    return model.anchor.is_cuda or is_library_loaded()


def _compile_step(
    engine: str,
    uses_kernels: bool,
    method: Any,
    counter: LikelihoodCounter,
    clock: Callable[[], float],
) -> CompiledParticleFilter | None:
    """Return the filter with its step compiled as a whole, if requested and possible."""
    if engine != "compiled" or not uses_kernels:
        return None
    if not isinstance(method, ParticleFilter) or method.history is not None:
        reason = f"it is a {type(method).__name__}"
        if isinstance(method, ParticleFilter):
            reason = "its moves use past states"
        log.info("engine=compiled: only inner loops are compiled, not the step (%s)", reason)
        return None
    return CompiledParticleFilter(method, counter, clock)
