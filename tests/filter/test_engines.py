"""Every filter of conf/ computes the same in every engine and in any batch, in double precision."""

import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import torch
from config_cases import composed, truncated, world
from filter_cases import NAMES, ON_ANY_MODEL, TEXTS, method_of, refusal
from model_cases import tracker
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from pfbench import job
from pfbench.core import PhiloxStream, Record
from pfbench.filter import FilterResult, ParticleFilter, SwarmProposal, run_filter
from pfbench.filter.belief import StepInfo
from pfbench.filter.particle import compiled_filter
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter
from pfbench.kernels import dispatch

pytestmark = pytest.mark.filterwarnings("ignore:ParticleGuideProposal")  # it says that it is dear

RUNS, STEPS = 3, 4
PAGE = (Path(__file__).parents[2] / "docs" / "scaling.md").read_text()
Y = torch.tensor(
    [
        [[0.8, -1.0], [1.9, 0.4], [1.1, 0.3], [0.2, 0.7]],
        [[1.2, 0.1], [0.4, torch.nan], [0.5, -0.6], [0.9, 1.0]],
        [[-0.3, 0.5], [0.1, 1.4], [2.1, 0.0], [1.3, -0.2]],
    ],
    dtype=torch.float64,
)
compiler = pytest.mark.skipif(
    not any(map(shutil.which, ("c++", "g++", "clang++"))), reason="no C++ compiler"
)


def run(method: Any, compiled: bool, batch: int | None = None) -> FilterResult:
    """Return an estimate, with the place of the first particle and the spread of all in its trace."""

    def keep(t: int, info: StepInfo) -> dict[str, Tensor]:
        assert info.cloud is not None
        deviations = info.cloud()[0]
        return {"first": deviations[:, 0, 0], "spread": deviations.square().sum((1, 2))}

    draws = PhiloxStream(5, torch.arange(RUNS))
    with dispatch.use_kernels(compiled), torch.no_grad():
        return run_filter(method, tracker(), Record(Y), draws, keep, run_batch=batch)


@compiler
@pytest.mark.parametrize("name", ON_ANY_MODEL)
def test_engines_and_batches_agree_to_rounding(name: str) -> None:
    """With the same ancestors: another ancestor would move the first particle, or the spread."""
    method = method_of(name)
    if not isinstance(method, ParticleFilter):
        pytest.skip("not a particle filter")
    if isinstance(swarm := method.proposal, SwarmProposal):
        # each iteration of a swarm multiplies a rounding by up to 4: after 30 it is 1e-5
        method = replace(method, proposal=replace(swarm, iterations=4))
    eager = run(method, compiled=False)
    assert not bool(eager.lost.any())
    for other in (run(method, compiled=True), run(method, compiled=True, batch=1)):
        for field in ("mean", "variance", "log_evidence"):
            torch.testing.assert_close(
                getattr(other, field), getattr(eager, field), rtol=1e-9, atol=1e-12
            )
        for key, value in eager.trace.items():  # among them the counts of distinct ancestors
            torch.testing.assert_close(
                other.trace[key].double(), value.double(), rtol=1e-8, atol=1e-11
            )


# recorded steps


def small_method_of(name: str) -> Any:
    """Return a filter with few iterations of a swarm, which would take most of the time.

    A network takes its dimensions from the first model that it sees, so it is made anew.
    """
    method = method_of(name) if name in NAMES else method_of.__wrapped__(name)
    if isinstance(swarm := getattr(method, "proposal", None), SwarmProposal):
        return replace(method, proposal=replace(swarm, iterations=2))
    return method


def assert_results_agree(one: FilterResult, other: FilterResult) -> None:
    for field in ("mean", "variance", "log_evidence"):
        a, b = getattr(one, field), getattr(other, field)
        scale = 1.0 if one.mean.dtype == torch.float64 else 1e4
        torch.testing.assert_close(a, b, rtol=1e-7 * scale, atol=1e-9 * scale, equal_nan=True)


MODELS = {
    "growth": ("scenario=growth", "model=growth"),
    "ins": ("scenario=flight_500s", "model=ins_gnss_inflated"),
}


@compiler
@pytest.mark.parametrize("name", TEXTS)
@pytest.mark.parametrize("words", MODELS.values(), ids=MODELS)
def test_a_recorded_step_computes_what_the_step_as_it_is_computes(
    name: str, words: tuple[str, str]
) -> None:
    """Recording takes other branches: once, every Jacobian through an operator was zero there."""
    model = job.instantiate(composed(*words).model)
    record = truncated(world(words[0].removeprefix("scenario=")), 3).record
    if name in NAMES and refusal(name, model, record):
        pytest.skip("refuses this model")
    method, draws = small_method_of(name), PhiloxStream(5, torch.arange(len(record.y)))
    with dispatch.use_kernels(), torch.no_grad():
        expected = run_filter(method, model, record, draws)
        with dispatch.capture_graph():
            recorded = run_filter(method, model, record, draws)
    assert_results_agree(recorded, expected)


@pytest.mark.slow
@compiler
@pytest.mark.parametrize("name", TEXTS)
def test_a_filter_is_recorded_or_the_page_says_why_not(
    name: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Recorded as the compiler does it, which refuses a branch on the numbers of a tensor."""
    model = job.instantiate(composed(*MODELS["growth"]).model)
    record = truncated(world("growth"), 4).record
    method = small_method_of(name)
    if isinstance(method, ParticleFilter):
        (rows,) = re.findall(r"\d+ filters compile.*?\n\n(\|.*?)\n\n", PAGE, re.DOTALL)
        assert (f"`{name}`" in rows) == bool(method.obstacle)
    if not isinstance(method, ParticleFilter) or method.obstacle:
        pytest.skip("is not compiled")
    if name in NAMES and refusal(name, model, record):
        pytest.skip("refuses this model")
    monkeypatch.setattr(compiled_filter, "compile_function", record_only)
    step, draws = CompiledParticleFilter(method), PhiloxStream(5, torch.arange(len(record.y)))
    with dispatch.use_kernels(), torch.no_grad():
        compiled = run_filter(step, model, record, draws)
        assert_results_agree(compiled, run_filter(method, model, record, draws))
    assert step.is_active


def record_only(function: Any, example: list[Tensor]) -> Any:
    """Record a step as `compile_function` does, and run the recorded operations."""
    graph = make_fx(function)(*example)
    return lambda given: graph(*given)


def test_the_page_counts_the_filters_that_compile() -> None:
    methods = [small_method_of(name) for name in TEXTS]
    compiled = [a for a in methods if isinstance(a, ParticleFilter) and not a.obstacle]
    assert f"{len(compiled)} filters compile" in PAGE


@pytest.mark.slow
@compiler
@pytest.mark.filterwarnings("ignore")  # the compiler's own
@pytest.mark.parametrize("name", ["sir", "apf", "rpf", "gpf", "ekf_pf", "ckf_pf"])
def test_a_compiled_step_computes_what_the_step_as_it_is_computes(name: str) -> None:
    """By the real compiler, on an INS."""
    words = MODELS["ins"]
    model, record = (
        job.instantiate(composed(*words).model),
        truncated(world("flight_500s"), 4).record,
    )
    draws = PhiloxStream(5, torch.arange(len(record.y)))
    step = CompiledParticleFilter(method_of(name))
    with dispatch.use_kernels(), torch.no_grad():
        assert_results_agree(
            run_filter(step, model, record, draws), run_filter(step.method, model, record, draws)
        )
    assert step.is_active


@compiler
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("fault", ["particles", "weights", "none"])
def test_a_compiled_step_with_other_numbers_is_not_used(
    fault: str,
    dtype: torch.dtype,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
) -> None:
    """The first compiled step is compared with the step as it is. Here each particle moves by half an sd."""

    def compile_wrongly(step: Any, example: list[Tensor]) -> Any:
        def run_step(given: list[Tensor]) -> list[Tensor]:
            out = list(step(*given))
            if fault == "particles":
                out[0] = out[0] + 0.5 * out[0].std()
            elif fault == "weights":
                out[1] = 0.5 * out[1]
            return out

        return run_step

    monkeypatch.setattr(compiled_filter, "compile_function", compile_wrongly)
    model, step = tracker().to(dtype), CompiledParticleFilter(method_of("sir"))
    draws = PhiloxStream(5, torch.arange(RUNS), dtype)
    with dispatch.use_kernels(), torch.no_grad():
        result = run_filter(step, model, Record(Y.to(dtype)), draws)
        expected = run_filter(step.method, model, Record(Y.to(dtype)), draws)
    assert step.is_active == (fault == "none")
    assert ("its numbers must be those of the uncompiled step" in caplog.text) == (fault != "none")
    assert_results_agree(result, expected)
