"""Paths under fixed noise by a tape are those of the model's own operations."""

import copy
from collections.abc import Callable
from typing import Any

import pytest
import torch
from compiled_cases import compiler
from model_cases import RUNS, simulate_with_gaps, tracker
from move_cases import moving

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    FilterResult,
    MetropolisHastings,
    NoiseFlowKernel,
    ParticleFilter,
    PowerLikelihoodUpdate,
    SwarmProposal,
    loop,
    run_filter,
)
from pfbench.filter.moves import path_kernels, taped_paths
from pfbench.job.scoring import LikelihoodCounter
from pfbench.kernels import dispatch
from pfbench.model import LinearGaussian, Lorenz63, Pendulum, StateSpaceModel, UnivariateGrowth

pytestmark = compiler
ONE = torch.ones(1)
MODELS: dict[str, Callable[[], StateSpaceModel]] = {
    "growth": UnivariateGrowth,  # with an input that runs share
    "lorenz": Lorenz63,
    "pendulum": Pendulum,  # states with an angle
    "tracker": tracker,
    "linear": lambda: LinearGaussian([[1.0, 0.1], [0.0, 0.9]], [[0.1], [0.3]], [[1.0, 0.0]], [0.4], [0.0] * 2, [1.0] * 2),
}  # fmt: skip


def make_filter(refresh: float = 0.1, threshold: float = 0.7, **stages: Any) -> ParticleFilter:
    """A filter whose particles move in runs with few effective ones alone."""
    flow = MetropolisHastings(NoiseFlowKernel(lag=4, noise_refresh=refresh), 2)
    filter_ = moving(flow, n=300, threshold=threshold)
    return copy.replace(filter_, **stages) if hasattr(copy, "replace") else type(filter_)(**{**vars(filter_), **stages})  # fmt: skip


def run(method: ParticleFilter, model: StateSpaceModel, record: Record) -> FilterResult:
    with dispatch.use_kernels(), torch.no_grad():
        return run_filter(method, model, record, PhiloxStream(3, RUNS))


def run_by_torch(method: ParticleFilter, model: StateSpaceModel, record: Record) -> FilterResult:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(path_kernels, "find_taped_paths", lambda *_: None)
        return run(method, model, record)


@pytest.fixture
def taken(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """The arguments of each call of C++."""
    calls: list[Any] = []
    call = dispatch.run_paths
    monkeypatch.setattr(dispatch, "run_paths", lambda given: calls.append(given) or call(given))
    return calls


def assert_close(one: FilterResult, other: FilterResult) -> None:
    for name in ("mean", "variance", "log_evidence"):
        torch.testing.assert_close(getattr(one, name), getattr(other, name), rtol=1e-9, atol=1e-9)
    assert torch.equal(one.trace.get("accepted_0", ONE), other.trace.get("accepted_0", ONE))


@pytest.mark.parametrize(
    "method",
    [make_filter(0.0), make_filter(), ParticleFilter(60, proposal=SwarmProposal(iterations=3))],
    ids=["flow", "refreshed", "swarm"],
)
@pytest.mark.parametrize("name", MODELS)
def test_a_tape_computes_what_the_model_does(
    name: str, method: ParticleFilter, taken: list[Any]
) -> None:
    """Moments, evidence, accepted moves and counts of evaluations, also where few runs move."""
    counts, results = [], []
    record = simulate_with_gaps(MODELS[name]())
    for call in (run, run_by_torch):
        model = MODELS[name]()
        counter = LikelihoodCounter(model)
        results.append(call(method, model, record))
        counts.append(counter.count)
    assert_close(*results)
    assert counts[0] == counts[1]
    assert len(taken) >= 10  # once to check the tape, and then each time
    moves = results[0].trace.get("accepted_0", torch.linspace(0, 0.9, 2))
    assert 0.0 < float(moves.mean()) < 1.0
    assert bool((moves == 0.0).any())  # not all runs move in each step


def test_a_linear_flow_has_the_slopes_of_its_own_model() -> None:
    """Two models of one pass at the same records: the second has what it has outside of a pass."""
    models = [
        LinearGaussian(
            [[1.0, slope], [0.0, 0.9]], [[0.1], [0.3]], [[1.0, 0.0]], [sd], [0.0] * 2, [1.0] * 2
        )
        for slope, sd in ((0.1, 0.4), (0.3, 0.7))
    ]
    past = tuple(map(simulate_with_gaps(models[0]).at_step, range(12)))
    states = PhiloxStream(3, RUNS).normal("states", 5, 24).unflatten(2, (12, 2))
    alone = path_kernels._measure_start(models[1], states, past)
    with loop._remember():
        within = [path_kernels._measure_start(model, states, past) for model in models]
    assert all(torch.equal(*pair) for pair in zip(within[1], alone, strict=True))


def test_tempered_likelihoods_have_a_tape_of_their_own(taken: list[Any]) -> None:
    model = UnivariateGrowth()
    record = simulate_with_gaps(model)
    results = []
    for factor in (1.0, 4.0):
        method = make_filter(weight_update=PowerLikelihoodUpdate(factor))
        results.append(run(method, model, record))
        assert_close(results[-1], run_by_torch(method, model, record))
    assert len(taken) > 20
    assert not torch.allclose(results[0].mean, results[1].mean)


def test_a_tape_has_the_constants_of_its_pass() -> None:
    """A buffer that changes in place, or a number of Python: the next pass of the same objects has the new one."""
    model, method = Lorenz63(), make_filter()
    record, found = simulate_with_gaps(model), []
    for change in (lambda: None, lambda: model.q.mul_(3.0), lambda: setattr(model, "step", 0.03)):
        change()
        found.append(run(method, model, record))
        assert_close(found[-1], run_by_torch(method, model, record))
    assert not torch.allclose(found[0].mean, found[1].mean)
    assert not torch.allclose(found[1].mean, found[2].mean)


class Branching(UnivariateGrowth):
    """Its measurement depends on a value that a tape cannot ask for."""

    def observation(self, x: torch.Tensor, u: Any) -> Any:
        return super().observation(x if bool((x > -1e9).all()) else -x, u)


def test_without_a_tape_and_outside_of_a_pass_the_model_is_asked(taken: list[Any]) -> None:
    model = Branching()
    record, method = simulate_with_gaps(model), make_filter()
    assert_close(run(method, model, record), run(method, UnivariateGrowth(), record))
    calls = len(taken)
    assert calls > 10  # of the second model
    assert taped_paths.find_taped_paths(UnivariateGrowth(), record.y) is None
    with torch.enable_grad():
        run_filter(method, UnivariateGrowth(), record, PhiloxStream(3, RUNS))
    assert len(taken) == calls  # a derivative needs the model


def test_a_tape_of_other_numbers_is_not_used(
    taken: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The first path of a pass is computed in both ways."""
    record_tape = taped_paths.record_tape

    def record_wrong(*given: Any) -> Any:
        tape, *rest = record_tape(*given)
        return tape._replace(constants=tape.constants * 1.001), *rest

    monkeypatch.setattr(taped_paths, "record_tape", record_wrong)
    model, method = UnivariateGrowth(), make_filter()
    record = simulate_with_gaps(model)
    assert_close(run(method, model, record), run_by_torch(method, model, record))
    assert len(taken) == 1


def test_wrong_instructions_are_refused(taken: list[Any]) -> None:
    """Nothing is read or written outside of the tape's own numbers."""
    model, call = UnivariateGrowth(), dispatch.run_paths
    run(make_filter(), model, simulate_with_gaps(model))
    given = taken[-1]
    wrong = [(1, given[1] + 1000), (3, given[3][:, 1:]), (4, given[4][0]), (5, given[5][:, :1])]
    wrong += [(6, given[6][1:]), (6, given[6].float()), (7, given[7] * 0), (7, given[7][:2])]
    for column, value in ((0, 31), (1, 0), (2, 10**6), (4, -(10**6))):
        wrong.append((0, given[0].clone()))
        wrong[-1][1][-1, column] = value
    for place, tensor in wrong:
        with pytest.raises(RuntimeError, match=r"run_paths|run_tape|different types"):
            call([*given[:place], tensor, *given[place + 1 :]])
