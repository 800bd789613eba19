"""One pass of a filter over an episode: engine, scores, time and memory."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import cache
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, cast

import numpy as np
import torch
from torch import Tensor
from tqdm import tqdm

from pfbench.core.random_stream import PhiloxStream
from pfbench.core.record import Episode, Record, iterate_steps
from pfbench.filter.belief import StepInfo
from pfbench.filter.loop import FilterResult, prepare_record, run_filter
from pfbench.filter.particle.particle_filter import ParticleFilter
from pfbench.filter.particle.stages import EssResampler
from pfbench.filter.particle.taped_filter import TapedParticleFilter, find_obstacle
from pfbench.job.memory import MemoryTrimmer, first_steps, peak_above, start_peak_measurement
from pfbench.job.plan import JobPlan
from pfbench.job.scoring import LikelihoodCounter, ScoreRecorder
from pfbench.kernels import dispatch
from pfbench.kernels.cpp_library import is_library_loaded
from pfbench.model.base import StateSpaceModel
from pfbench.results import store
from pfbench.results.step_times import WARM_UP
from pfbench.stats.likelihood_floor import likelihood_floor

if TYPE_CHECKING:
    from pfbench.filter.particle.compiled_filter import CompiledParticleFilter

log = logging.getLogger("pfbench")

# normal numbers of a job: on a CUDA device compiling costs seconds and saves 15 ms per million [measured]
_CUDA_NUMBERS = 5e8
_COPIES = (
    "this world has no process noise: a resampled cloud collapses to copies of a few particles. Choose filter=rpf_copies, "
    "or give the filter moves or a resampler that moves copies"
)
_WARM_UP_STEPS = 2  # the second of a compiled filter is recorded


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

        Returns arrays by name, see `store.JobResult`. Shapes: pcrb [T, d].
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
            "pareto_k": estimate.pareto_k.float(),
            **{name: a if a.dtype == torch.bool else a.float() for name, a in trace.items()},
        }
        if episode.record.feedback is None and not self.model.has_counts:
            y = episode.record.y.double().cpu().numpy()
            outputs["evidence_floor"] = torch.from_numpy(likelihood_floor(y))
        scores = self.recorder.arrays()
        outputs |= {name: a.float() if a.is_floating_point() else a for name, a in scores.items()}
        optional = {"track": episode.track, "pcrb": pcrb, "range": episode.datasheet.get("range")}
        outputs |= {name: a.float() for name, a in optional.items() if a is not None}
        return {name: a.cpu().numpy() for name, a in outputs.items()}


def pass_filter(plan: JobPlan, episode: Episode, runs: Tensor, label: str) -> TimedFilterPass:
    """Run the filter of a plan over an episode and measure errors, time and memory.

    Returns the results. Shapes: runs [R].
    """
    values, method, clock = plan.values, plan.method, plan.choose_timer()
    device = values["device"]
    model, steps = plan.make_filter_model(episode), episode.record.y.shape[1]
    truth = model.assemble(episode.truth).to(device, plan.dtype)
    recorder = ScoreRecorder(model, truth, values["score_steps"], clock, episode.measured_truth)
    counter = LikelihoodCounter(model)

    def watch(t: int, info: StepInfo) -> dict[str, Tensor]:
        with counter.paused():
            return recorder(t, info)

    engine, compile_seconds = _time_choice(plan, model, len(runs), steps)
    draws = PhiloxStream(values["seed"], runs.to(device), plan.dtype)
    with _prepare_torch(plan, engine), _show_progress(steps, label) as tick:
        step = wrap_steps(engine, method, counter, clock)
        baseline = start_peak_measurement(device)
        start_time = clock()
        method, batch = _warm_up(plan, step, model, episode.record, draws)
        warm_up_seconds = clock() - start_time - (step.seconds if step else 0.0)
        counter.count = 0
        estimate = run_filter(
            method,
            model,
            episode.record,
            draws,
            watch,
            tick,
            batch,
            values["threads"] if device == "cpu" else 1,
        )
        wait_for(device)
    step_compile_seconds = step.seconds if step else 0.0
    filter_seconds = (
        clock() - start_time - warm_up_seconds - recorder.seconds - step_compile_seconds
    )
    seconds = {
        "scores": recorder.seconds,
        "compile": compile_seconds + step_compile_seconds,
        WARM_UP: warm_up_seconds,
        "filter": filter_seconds,
        "per_step": filter_seconds / steps,
    }
    cost = {
        "engine": engine if engine == "eager" or (step and step.is_active) else "kernels",
        "memory": peak_above(baseline, device),
        "likelihoods_per_step": counter.count / (len(runs) * steps),
    }
    return TimedFilterPass(model, estimate, recorder, seconds, cost)


def _time_choice(plan: JobPlan, model: StateSpaceModel, runs: int, steps: int) -> tuple[str, float]:
    """Choose the engine of a job. Returns it and the time of loading it, s."""
    engine, start = plan.values["engine"], time.perf_counter()
    if engine == "auto" and plan.values["budget"] != store.SAME_N:
        engine = "kernels"  # as the trials that gave the number of particles
    engine = choose_engine(engine, plan.method, model, runs, steps)
    return engine, time.perf_counter() - start


@contextmanager
def _prepare_torch(plan: JobPlan, engine: str) -> Iterator[None]:
    """Let torch take the operators of an engine and no gradients, and one thread for a particle filter by C++ operators.

    More threads of torch would wait for each other at every small operation. Batches of runs have the threads of the job.
    """
    threads = torch.get_num_threads()
    if (
        plan.values["device"] == "cpu"
        and engine != "eager"
        and isinstance(plan.method, ParticleFilter)
    ):
        torch.set_num_threads(1)
    try:
        with torch.no_grad(), dispatch.use_kernels(engine != "eager"):
            yield
    finally:
        torch.set_num_threads(threads)


def _warm_up(
    plan: JobPlan,
    step: TapedParticleFilter | CompiledParticleFilter | None,
    model: StateSpaceModel,
    record: Record,
    draws: PhiloxStream,
) -> tuple[Any, int]:
    """Take two steps of the first batch of runs, whose results are not used.

    What a process loads once is not in the time of its first job then, nor is the time of compiling.

    Returns the filter, with compiled steps if there are, and the runs of a batch.
    """
    method = step or plan.method
    batch = plan.choose_run_batch(plan.method, len(draws.runs), is_shared=step is not None)
    first = slice(0, batch)
    run_filter(
        method,
        model,
        first_steps(model, record.select_runs(first), _WARM_UP_STEPS),
        draws.select_runs(first),
    )
    wait_for(plan.values["device"])
    return method, batch


def wait_for(device: str) -> None:
    """Wait until a device has computed what was asked of it, so that a clock can be read."""
    if device != "cpu":
        torch.cuda.synchronize()


@contextmanager
def _show_progress(steps: int, label: str) -> Iterator[Callable[[], None]]:
    """Show a progress bar of the steps. Yields the function to call after each step, which also trims the memory."""
    trim = MemoryTrimmer()

    def tick() -> None:
        bar.update()
        trim()

    with tqdm(total=steps, desc=label, unit="step", delay=2, disable=None, leave=False) as bar:
        yield tick


def choose_engine(
    engine: str, method: Any, model: StateSpaceModel, runs: int, steps: int
) -> Literal["eager", "kernels", "tape", "compiled"]:
    """Choose how the steps of a job are executed, and load the C++ operators.

    On the CPU `auto` takes a tape for a bootstrap filter, and the operators for all others. On a CUDA device it takes kernels for
    large jobs. Numbers of all engines agree to rounding; a result states its engine.

    Returns the engine: `eager` if the operators cannot be loaded.
    """
    if engine == "eager":
        return "eager"
    if model.anchor.is_cuda:
        if engine == "auto":
            return (
                "kernels"
                if _count_numbers(method, model) * runs * steps >= _CUDA_NUMBERS
                else "eager"
            )
    elif not is_library_loaded():
        return "eager"
    if engine in ("kernels", "compiled"):
        return cast(Literal["kernels", "compiled"], engine)
    obstacle = "the device is a GPU" if model.anchor.is_cuda else find_obstacle(method, model)
    if obstacle and engine == "tape":  # what was asked for
        _say_once(f"engine=tape: C++ operators, step by step ({obstacle})")
    return "kernels" if obstacle else "tape"


def describe_unmoved_copies(
    plan: JobPlan, model: StateSpaceModel, record: Record
) -> tuple[str, ...]:
    """Say once, and return as a note, that nothing moves the copies of resampling apart: neither the filter nor the process."""
    method, choices = plan.method, plan.config.choices
    if (
        not isinstance(method, ParticleFilter)
        or type(method.resampler) is not EssResampler
        or method.moves
    ):
        return ()
    start = prepare_record(model, first_steps(model, record.select_runs(slice(0, 1)), 1))
    _, step_model, step = next(iter(iterate_steps(model, start)))
    x, w = model.origin.expand(1, 1, -1), model.origin.new_zeros(1, 1, model.noise_dim)
    with torch.no_grad():
        pushed, still = (step_model.propagate(x, step.u, noise) for noise in (w + 1.0, w))
    if not torch.equal(pushed, still):
        return ()
    _say_once(f"warning  {choices['scenario']} / {choices['filter']}   {_COPIES}")
    return (_COPIES,)


@cache
def _say_once(line: str) -> None:
    """Log a line, once in a process."""
    log.info(line)


def _count_numbers(method: Any, model: StateSpaceModel) -> int:
    """Return the normal numbers of a step of one run that cost as much as the step."""
    if isinstance(method, ParticleFilter):
        return method.particles * model.noise_dim
    from pfbench.filter.gaussian.gaussian_filter import GaussianFilter

    # linear algebra costs as much as eight normal numbers per entry of a covariance
    return 8 * model.chart.dimension**2 if isinstance(method, GaussianFilter) else 0


def wrap_steps(
    engine: str,
    method: Any,
    counter: LikelihoodCounter | None = None,
    clock: Callable[[], float] = time.perf_counter,
) -> TapedParticleFilter | CompiledParticleFilter | None:
    """Return the filter whose steps an engine takes as a whole; None where they are taken as they are."""
    if engine == "tape":
        return TapedParticleFilter(method, counter)
    if engine != "compiled":
        return None
    if not isinstance(method, ParticleFilter) or method.obstacle:
        is_other = not isinstance(method, ParticleFilter)
        reason = f"it is a {type(method).__name__}" if is_other else method.obstacle
        log.info("engine=compiled: only inner loops are compiled, not the step (%s)", reason)
        return None
    from pfbench.filter.particle.compiled_filter import CompiledParticleFilter

    return CompiledParticleFilter(method, counter, clock)
