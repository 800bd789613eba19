"""Extreme numbers: every filter on every case, by engine, and the class of each run.

A run ends with a clear error, is marked (lost, or a health other than ok), or has a finite estimate, a positive variance
and a possible log evidence. All else is bad: an unclear error, a crash, or an estimate that is false and not marked.

The evidence of a particle filter is random: it may exceed the bound by four of its standard errors. That of a filter that
fits R to its innovations is under the fitted R, and has no bound.
"""

import json
import logging
import math
import tempfile
from pathlib import Path
from typing import Any

import torch
from filter_cases import NAMES, method_of
from torch import Tensor

from faults.children import Ending, run_child
from faults.numeric_cases import CASES, RUNS, Extreme
from faults.sweeps import CLEAR
from faults.tally import FINE, Tally
from pfbench.core import PhiloxStream, Record
from pfbench.filter import FilterResult, ParticleFilter, run_filter
from pfbench.filter.exactness import has_covariance, has_evidence
from pfbench.filter.health import HEALTH
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter
from pfbench.kernels import dispatch
from pfbench.model.linear_gaussian import LinearGaussian

ENGINES = ("eager", "kernels", "compiled")
COMPILED = ("sir", "rpf", "apf", "ckf_pf")  # compiling one case takes seconds
MEMORY_GIB = 16.0  # of addresses; compilers are processes of their own
TIMEOUT = {"eager": 600.0, "kernels": 600.0, "compiled": 3600.0}  # s for all cases of a filter
SLACK = 1e-6  # of the bound on the evidence, relative
STANDARD_ERRORS = 4.0


def filters_of(engine: str) -> list[str]:
    return list(COMPILED if engine == "compiled" else NAMES)


def number_of_trials(engine: str) -> int:
    return len(filters_of(engine)) * len(CASES) * RUNS


BATCH = len(CASES) * RUNS  # one filter


def largest_evidence(model: LinearGaussian, y: Tensor) -> float:
    """Return the largest log evidence that is possible: that of residuals of zero."""
    peak = -(model.r.double().log() + 0.5 * math.log(2.0 * math.pi))
    return float((peak * torch.isfinite(y[0])).sum())


def evidence_errors(estimate: FilterResult, particles: int) -> Tensor:
    """Return the standard error of the log evidence of each run: that of the mean weight of each step."""
    if "ess" not in estimate.trace:
        return torch.zeros_like(estimate.log_evidence)
    variance = 1.0 / estimate.trace["ess"].double() - 1.0 / particles
    return variance.clamp(min=0.0).sum(1).sqrt()


def bounds_of(method: Any, model: LinearGaussian, y: Tensor, estimate: FilterResult) -> list[float]:
    """Return the largest log evidence that is possible in each run."""
    if getattr(method, "noise_adaptations", ()) or not has_evidence(method):
        return [math.inf] * RUNS
    errors = evidence_errors(estimate, getattr(method, "particles", 1))
    return (largest_evidence(model, y) + STANDARD_ERRORS * errors).tolist()


def marked_runs(estimate: FilterResult) -> list[bool]:
    """Return the runs that the result marks as bad: lost, or with a health other than ok."""
    ill = [HEALTH[value] != "ok" for value in estimate.health.tolist()]
    return [a or b for a, b in zip(ill, estimate.lost.tolist(), strict=True)]


def class_of(
    estimate: FilterResult, run: int, is_marked: bool, bound: float, case: Extreme
) -> tuple[str, str, str]:
    """Return outcome, remark and example of one run."""
    mean, variance = estimate.mean[run], estimate.variance[run]
    evidence = float(estimate.log_evidence[run])
    if is_marked:
        return FINE, "marked", ""
    if not bool(torch.isfinite(mean).all() & torch.isfinite(variance).all()):
        return "false", "not finite and not marked", f"evidence {evidence}"
    least = float(variance.min())
    if least < 0.0 or (least == 0.0 and not case.is_certain):
        return (
            "false",
            "variance of zero and not marked",
            f"variance {least}, mean {mean[-1].tolist()}",
        )
    if evidence > bound + SLACK * max(1.0, abs(bound)):
        return "false", "impossible evidence", f"{evidence} > {bound}"
    return FINE, "finite", ""


def classify_error(error: Exception) -> tuple[str, str, str]:
    """Return outcome, remark and example of an error."""
    text = f"{error}"
    if isinstance(error, ValueError) and CLEAR.search(text):
        return FINE, "clear error", ""
    return "unclear", type(error).__name__, text[:300]


def try_case(name: str, case: Extreme, engine: str) -> list[Any]:
    """Run one filter on one case and return outcome, remark and example of each run."""
    method = method_of(name)
    if engine == "compiled":
        if not isinstance(method, ParticleFilter) or method.history is not None:
            raise ValueError(f"{name} must be a particle filter without moves. Choose another one.")
        method = CompiledParticleFilter(method)
    context = dispatch.use_kernels(engine != "eager")
    try:
        with torch.no_grad(), context:
            model = case.build()
            draws = PhiloxStream(1, torch.arange(RUNS), model.anchor.dtype)
            estimate = run_filter(method, model, Record(case.y), draws)
    except Exception as error:
        return [classify_error(error)] * RUNS
    bounds, marks = bounds_of(method, model, case.y, estimate), marked_runs(estimate)
    if not has_covariance(method):  # it states none: the estimates alone are judged
        estimate = estimate._replace(variance=torch.ones_like(estimate.mean))
    return [class_of(estimate, run, marks[run], bounds[run], case) for run in range(RUNS)]


def try_filter(name: str, engine: str, cases: list[str], progress: Path) -> None:
    """Try cases in this process and write each outcome at once."""
    logging.disable(logging.CRITICAL)
    torch.set_num_threads(1)
    with progress.open("a") as file:
        for case in cases:
            file.write(json.dumps([case]) + "\n")
            file.flush()
            outcomes = try_case(name, CASES[case], engine)
            file.write(json.dumps([case, outcomes]) + "\n")
            file.flush()


def run_filter_cases(name: str, engine: str, tally: Tally) -> None:
    """Try all cases of a filter; after a crash the next child continues with the next case."""
    rest = list(CASES)
    while rest:
        with tempfile.TemporaryDirectory() as folder:
            progress = Path(folder) / "progress"
            task_cases = list(rest)
            ending = run_child(
                lambda: try_filter(name, engine, task_cases, progress),  # noqa: B023
                TIMEOUT[engine],
                MEMORY_GIB,
            )
            lines = [json.loads(line) for line in progress.read_text().splitlines()]
        done = {line[0]: line[1] for line in lines if len(line) == 2}
        for case, outcomes in done.items():
            for outcome, remark, example in outcomes:
                tally.add(outcome, remark, f"{name}, {engine}, {case}: {example}")
        rest = [case for case in rest if case not in done]
        if rest and ending.state == "done":
            raise RuntimeError(f"all cases of {name} must have an outcome, got none of {rest}")
        if rest:
            _count_crash(tally, f"{name}, {engine}, {rest[0]}", ending)
            rest = rest[1:]


def _count_crash(tally: Tally, where: str, ending: Ending) -> None:
    for _ in range(RUNS):
        tally.add("crash", ending.state, f"{where}: {str(ending.value)[-300:]}")


def run(engine: str, count: int, seed: int) -> Tally:
    """Try all cases of the filter of number `seed`; `count` is that of its runs."""
    tally = Tally(f"extreme numbers, {engine}")
    run_filter_cases(filters_of(engine)[seed], engine, tally)
    return tally
