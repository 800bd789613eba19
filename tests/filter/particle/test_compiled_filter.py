"""A filter whose step is one compiled graph computes what it computes step by step."""

import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from command_line import pfbench
from compiled_cases import RUNS, STEPS, agree, compiler, record_of, run
from torch import Tensor
from torch.fx.experimental.proxy_tensor import make_fx

from pfbench.core import PhiloxStream, Record
from pfbench.core.density import independent_normal
from pfbench.core.linear_algebra import affine_map
from pfbench.filter import (
    CountLimits,
    EssResampler,
    EssStepCount,
    LookAheadWeights,
    ParticleFilter,
    PowerLikelihoodUpdate,
    Proposal,
    Stratified,
    Systematic,
    run_filter,
)
from pfbench.filter.belief import StepInfo
from pfbench.filter.particle import compiled_filter
from pfbench.filter.particle.compiled_filter import CompiledParticleFilter
from pfbench.job.scoring import LikelihoodCounter
from pfbench.kernels import cuda, dispatch, step_compiler
from pfbench.model import LinearGaussian, StateSpaceModel, UnivariateGrowth, linear_walk
from pfbench.results import store


class Failing(UnivariateGrowth):
    """Particles that run beyond 15 become no number."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        moved = super().propagate(x, u, w)
        return torch.where(moved > 15.0, torch.nan, moved)


@pytest.mark.slow
@compiler
@pytest.mark.filterwarnings("ignore")  # the compiler's own
def test_a_compiled_filter_draws_weighs_and_counts_as_it_does_step_by_step() -> None:
    """Also where particles fail in some steps, and measurements are missing."""
    model, method = Failing(), ParticleFilter(150)
    record = record_of(UnivariateGrowth())
    counts = []
    found = []
    for wrapped in (False, True):
        own = Failing()
        tally = LikelihoodCounter(own)
        step = CompiledParticleFilter(method, tally) if wrapped else method
        found.append(run(step, own, record))
        counts.append(tally.count)
    assert isinstance(step, CompiledParticleFilter)
    assert step.is_active
    (graph,) = step.graphs.values()
    assert graph is not None
    assert step.seconds > 0.0
    agree(*found)
    assert counts[0] == counts[1] == RUNS * 150 * STEPS
    failed = [
        bool(torch.isnan(model.propagate(x, u, w)).any()) for x, u, w in some_steps(model, record)
    ]
    assert any(failed)  # else nothing of it was tried


def some_steps(model: StateSpaceModel, record: Record) -> list[tuple[Tensor, Any, Tensor]]:
    prepared = model.prepare(record)
    x, draws = (
        10.0 * torch.ones(RUNS, 150, 1, dtype=torch.float64),
        PhiloxStream(1, torch.arange(RUNS)),
    )
    return [
        (x, prepared.at_step(t).u, draws.at_step(t + 1).normal("noise", 150, 1)) for t in range(3)
    ]


class Looking:
    """A proposal that looks at numbers, which nobody can record."""

    is_exact = True

    def __init__(self, inner: Proposal) -> None:
        self.inner = inner

    def __call__(self, model: Any, cloud: Any, seen: Any, draws: Any) -> Any:
        found = self.inner(model, cloud, seen, draws)
        return found if float(found.x.sum()) < 1e9 else self.inner(model, cloud, seen, draws)


def walk() -> LinearGaussian:
    return linear_walk(1.0, 0.3, 1.0)


@compiler
def test_a_step_that_cannot_be_recorded_goes_on_as_it_is_and_says_so(
    caplog: pytest.LogCaptureFixture,
) -> None:
    model = walk()
    method = ParticleFilter(50, proposal=Looking(ParticleFilter(50).proposal))
    record = record_of(model)
    step = CompiledParticleFilter(method)
    agree(run(step, model, record), run(method, model, record))
    assert list(step.graphs.values()) == [None]
    assert not step.is_active
    (said,) = [entry.getMessage() for entry in caplog.records if entry.name == "pfbench"]
    assert said.startswith("engine=compiled: this step cannot be compiled (RuntimeError: ")
    assert said.endswith("Using compiled kernels only")


def test_blocks_of_runs_share_a_graph_where_they_are_alike(monkeypatch: pytest.MonkeyPatch) -> None:
    """The recorded step itself, as a graph has it, without the compiler: the same numbers, one recording for a size."""
    recorded = []

    def as_it_is(step: Any, tensors: list[Tensor]) -> Any:
        recorded.append([tuple(a.shape) for a in tensors])
        return lambda given: step(*given)

    monkeypatch.setattr(compiled_filter, "compile_function", as_it_is)
    model = walk()
    method, record = ParticleFilter(50), record_of(model)
    step = CompiledParticleFilter(method)
    run(step, model, Record(record.y[:, :1]))
    assert not step.is_active  # a first step alone runs as it is
    agree(run(step, model, record, at_once=2), run(method, model, record))
    assert len(recorded) == 1
    agree(run(step, model, record, at_once=3), run(method, model, record))
    assert len(recorded) == 3  # of two, of three, of one


def test_batches_of_runs_take_their_steps_at_the_same_time(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two of them meet at each call of recorded steps, without gradients, with the same numbers and counts."""
    monkeypatch.setattr(
        compiled_filter,
        "compile_function",
        lambda step, example: lambda given: step(*given),
    )
    model, meeting = walk(), threading.Barrier(2, timeout=20)
    run_steps = compiled_filter.CompiledStep.run_steps

    def meet(self: Any, *args: Any) -> Any:
        meeting.wait()
        assert not torch.is_grad_enabled()
        return run_steps(self, *args)

    record, counts, found = record_of(model), [], []
    pairs = record.select_runs(slice(0, 4))
    for threads in (1, 2):
        counter = LikelihoodCounter(model)
        step = CompiledParticleFilter(ParticleFilter(50), counter)
        draws = PhiloxStream(1, torch.arange(4))
        if threads == 2:
            monkeypatch.setattr(compiled_filter.CompiledStep, "run_steps", meet)
        with torch.no_grad():
            found.append(run_filter(step, model, pairs, draws, run_batch=2, threads=threads))
        counts.append(counter.count)
        assert len(step.graphs) == 1
    assert counts[0] == counts[1] > 0
    torch.testing.assert_close(
        found[1]._asdict(), found[0]._asdict(), rtol=0, atol=0, equal_nan=True
    )


@pytest.fixture
def recorded(monkeypatch: pytest.MonkeyPatch) -> list[list[int]]:
    """The step recorded but not compiled; the numbers of the steps that it was asked for, of each recording."""
    asked: list[list[int]] = []

    def as_it_is(step: Any, example: list[Tensor]) -> Any:
        numbers: list[int] = []
        asked.append(numbers)
        graph = make_fx(step)(*example)

        def call(given: list[Tensor]) -> Any:
            numbers.append(int(next(a for a in given if a.dim() == 0)))
            return graph(*given)

        return call

    monkeypatch.setattr(compiled_filter, "compile_function", as_it_is)
    return asked


class Fragile(UnivariateGrowth):
    """All particles of run 2 become no number at step 7, those of run 0 fit nothing that is seen at step 10."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        broken = (u.t == 7.0).reshape(-1, 1, 1) & (torch.arange(len(x)) == 2).reshape(-1, 1, 1)
        return torch.where(broken, torch.nan, super().propagate(x, u, w))

    def log_likelihood(self, y: Tensor, x: Tensor, u: Any) -> Tensor:
        hopeless = (u.t == 10.0).reshape(-1, 1) & (torch.arange(len(x)) == 0).reshape(-1, 1)
        return torch.where(hopeless, -torch.inf, super().log_likelihood(y, x, u))


@compiler
def test_steps_taken_together_are_the_steps_taken_one_by_one(recorded: list[list[int]]) -> None:
    """With inputs and draws that change at each step, measurements missing, a NaN in the middle and a run lost there."""
    record = record_of(UnivariateGrowth())
    tally = LikelihoodCounter(model := Fragile())
    method, ticks = ParticleFilter(40), []
    step = CompiledParticleFilter(method, tally)

    def watch(t: int, info: StepInfo) -> dict[str, Tensor]:
        ticks.append(t)
        assert info.cloud is not None
        assert info.nis is not None
        with tally.paused():
            return {
                "nis": info.nis()[0],
                "covariance": info.covariance(),
                "farthest": info.cloud()[0].abs().amax((1, 2)),
            }

    draws = PhiloxStream(1, torch.arange(RUNS))
    with dispatch.use_kernels(), torch.no_grad():
        together, counted = run_filter(step, model, record, draws, watch), tally.count
        apart = run_filter(method, model, record, draws, watch)
    agree(together, apart)
    assert together.lost.tolist() == [True, False, True, False]
    assert bool(torch.isnan(together.mean[2, 6:]).all())
    assert ticks == [*range(STEPS), *range(STEPS)]
    assert counted == tally.count - counted == RUNS * 40 * STEPS
    # the recording; all, of which the seventh fails and is done again as it is; then one, two and the last two
    assert recorded == [[2, *range(2, STEPS + 1), *range(8, STEPS + 1)]]


def test_inputs_reach_their_steps_whatever_their_shape() -> None:
    """Of all runs or of each one, numbers, vectors and matrices: as a single step would have stored them."""
    for shape in ((3, 5), (1, 5), (3, 5, 2), (3, 5, 2, 4), (1, 5, 4, 4)):
        a = torch.randn(shape)
        for t, given in enumerate(step_compiler.steps_to_storage(a)):
            assert torch.equal(given, step_compiler.to_storage(a[:, t]))
            assert given.is_contiguous()


@compiler
def as_graph(model: StateSpaceModel, method: ParticleFilter) -> tuple[Any, list[Tensor]]:
    """A step's operations, not compiled, and what it is given."""
    kept: list[Any] = []

    def noted(step: Any, example: list[Tensor]) -> Any:
        kept[:] = [make_fx(step)(*example), example]
        raise RuntimeError("only noted")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiled_filter, "compile_function", noted)
        run(CompiledParticleFilter(method), model, record_of(model))
    return kept[0], kept[1]


class Moved(LinearGaussian):
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return affine_map(self.f[None], x, self.g[None], w)


class Weary(Moved):
    """Its parents are looked at twice."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w) - 0.1 * x


class Crossed(Moved):
    """Its noise comes in another order."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w.flip(-1))

    def noise_gain(self, u: Any) -> Tensor:
        return super().noise_gain(u).flip(-1)


@compiler
@pytest.mark.parametrize("particles", [60, 61])  # with and without draws that nobody wants
@pytest.mark.parametrize(("kind", "joined"), [(Moved, True), (Weary, True), (Crossed, False)])
def test_copies_noise_and_move_are_joined_where_nothing_comes_between(
    kind: Any, joined: bool, particles: int
) -> None:
    """As for a CUDA device; here `one_after_the_other` is what the operator stands for."""
    model = kind(
        [[1.0, 0.5], [0.0, 0.9]],
        [[0.6, 0.1], [0.2, 0.5]],
        [[1.0, 0.0]],
        [0.5],
        [0.3, -0.2],
        [1.5, 1.0],
    )
    graph, given = as_graph(model, ParticleFilter(particles))
    wanted = graph(*given)
    step_compiler._fuse_propagation(graph.graph)
    graph.recompile()
    assert ("pfbench.gather_propagate" in graph.code) == joined
    assert ("pfbench.philox_normals" in graph.code) == (not joined)

    def one_after_the_other(
        phi: Tensor, x: Tensor, ancestors: Tensor, gain: Tensor, *key: Any
    ) -> Tensor:
        quarters = -(-particles // 4)
        noise = dispatch.philox_normals_float64(*key, gain.shape[-1], quarters)
        parents = dispatch.gather_particles(x, ancestors).permute(1, 2, 0)
        w = noise[..., :particles].permute(1, 2, 0)
        return dispatch.propagate_affine(phi, parents, gain, w)

    with torch.library._scoped_library("pfbench", "IMPL") as library:
        library.impl("gather_propagate", one_after_the_other, "CPU")
        for one, other in zip(graph(*given), wanted, strict=True):
            assert torch.equal(one, other)


class Picked(Moved):
    """Some of its components are measured."""

    def __init__(self, indices: tuple[int, ...] = (1, 0)) -> None:
        rows = torch.eye(2, dtype=torch.float64)[list(indices)].tolist()
        super().__init__(
            [[1.0, 0.5], [0.0, 0.9]], [[0.6, 0.1], [0.2, 0.5]], rows, [0.5] * len(rows), [0.3, -0.2], [1.5, 1.0]
        )  # fmt: skip
        self.register_buffer("indices", torch.tensor(indices))
        self.register_buffer("scale", torch.linspace(0.4, 0.7, len(rows), dtype=torch.float64))

    def observation(self, x: Tensor, u: Any) -> Any:
        picked = x.permute(2, 0, 1).index_select(0, self.indices).permute(1, 2, 0)
        return independent_normal(picked, self.scale)


class Doubted(Picked):
    """Its errors are as large as the mean of its particles says."""

    def observation(self, x: Tensor, u: Any) -> Any:
        picked = super().observation(x, u)
        scale = 0.5 + x.mean(1, keepdim=True).abs()
        return independent_normal(picked.mean, scale.expand_as(picked.mean))


class Tilted(EssResampler):
    """Slots have different weights."""

    is_exact = False

    def __call__(self, *args: Any) -> Any:
        resampled, mask = super().__call__(*args)
        n = resampled.log_w.shape[1]
        log_w = torch.log_softmax(torch.linspace(0.0, 1.0, n, dtype=torch.float64), 0)
        return resampled._replace(log_w=log_w.expand_as(resampled.log_w).contiguous()), mask


ALWAYS = EssResampler(Systematic(), 1.0)


@compiler
@pytest.mark.parametrize(
    ("model", "stages", "taken"),
    [
        (Picked(), {}, True),
        (Picked((1,)), {}, True),
        (Picked((1, 1)), {}, False),
        (Doubted(), {}, False),
        (Picked(), {"resampler": EssResampler(Systematic(), 0.5)}, False),
        (Picked(), {"resampler": Tilted(Systematic(), 1.0)}, False),
        (Picked(), {"resampler": EssResampler(Stratified(), 1.0)}, False),
        (Picked(), {"auxiliary_weights": LookAheadWeights()}, False),
        (Picked(), {"weight_update": PowerLikelihoodUpdate(2.0)}, False),
        (Picked(), {"particle_count": EssStepCount(limits=CountLimits(4000, 4100, 4100))}, True),
    ],
)
def test_a_step_is_one_operator_where_nothing_comes_between(
    model: Any, stages: dict[str, Any], taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for a CUDA device; here `one_after_the_other` is what it stands for. Other steps are left as they are."""

    def one_after_the_other(
        a: Tensor, n: Tensor, u: Tensor, phi: Tensor, x: Tensor, gain: Tensor, seed: Tensor, purpose: int, step: Tensor,
        runs: Tensor, components: Tensor, *measured: Tensor
    ) -> tuple[Tensor, ...]:  # fmt: skip
        ancestors = dispatch.resample_systematic(a, n, u)
        noise = dispatch.philox_normals_float64(
            seed, purpose, step, runs, gain.shape[-1], -(-a.shape[1] // 4)
        )
        parents = dispatch.gather_particles(x, ancestors).permute(1, 2, 0)
        moved = dispatch.propagate_affine(
            phi, parents, gain, noise[..., : a.shape[1]].permute(1, 2, 0)
        )
        cloud, y = moved.permute(1, 2, 0), measured[0]
        prior = (
            torch.where(torch.arange(a.shape[1]) < n, -torch.log(n), -torch.inf)
            .expand_as(a)
            .contiguous()
        )
        likelihood = dispatch.log_normal(y, cloud[..., components], *measured[1:])
        weights = dispatch.normalise_weights(
            dispatch.sum_log_weights(likelihood, prior, torch.zeros_like(prior))
        )
        moments = dispatch.weighted_moments(cloud, weights[2])
        return moved, *weights, *moments, dispatch.count_unique(ancestors, prior)

    monkeypatch.setattr(cuda, "can_take_step", lambda *_: True)
    method = ParticleFilter(4100, **{"resampler": ALWAYS, **stages})
    with dispatch.mark_operators():
        graph, given = as_graph(model, method)
    wanted = graph(*given)
    step_compiler._fuse_propagation(graph.graph)
    assert step_compiler._fuse_steps(graph) == taken
    graph.recompile()
    assert ("pfbench.sir_step" in graph.code) == taken
    if not taken:
        return
    gone = (
        "normalise_weights",
        "weighted_moments",
        "count_unique",
        "gather_propagate",
        "resample_systematic",
    )
    assert not [name for name in gone if name in graph.code]
    with torch.library._scoped_library("pfbench", "IMPL") as library:
        library.impl("sir_step", one_after_the_other, "CPU")
        found = graph(*given)
    for one, other in zip(found, wanted, strict=True):
        torch.testing.assert_close(one, other, rtol=1e-12, atol=1e-12)


def test_large_steps_go_one_by_one(
    recorded: list[list[int]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What steps keep together stays small: nothing is computed of the next one before this one has been told."""
    monkeypatch.setattr(compiled_filter, "MAX_NUMBERS", 1)
    model, method, told = walk(), ParticleFilter(50), []

    def watch(t: int, info: StepInfo) -> dict[str, Tensor]:
        told.append((t + 1, recorded[0][-1] if recorded else 1))
        return {}

    run_filter(
        CompiledParticleFilter(method),
        model,
        record_of(model),
        PhiloxStream(1, torch.arange(RUNS)),
        watch,
    )
    assert told == [(t, t) for t in range(1, STEPS + 1)]


@pytest.mark.slow
@compiler
@pytest.mark.filterwarnings("ignore")
def test_a_job_says_that_its_step_was_compiled(tmp_path: Path) -> None:
    walk = (
        "run",
        "scenario=linear_walk",
        "scenario.steps=20",
        "runs=4",
        "particles=200",
        "overwrite=true",
    )
    found = {}
    for engine in ("kernels", "compiled"):
        said = pfbench(*walk, f"engine={engine}", home=tmp_path)
        assert said.code == 0, said.err
        (file,) = (tmp_path / "results" / "adhoc").glob(
            "*.npz"
        )  # one key: an engine changes no result
        found[engine] = store.read_result(file)
        assert found[engine].meta["engine"] == engine
    loops, whole = (found[engine] for engine in ("kernels", "compiled"))
    assert whole.meta["seconds"]["compile"] > 0.0
    assert whole.meta["likelihoods_per_step"] == loops.meta["likelihoods_per_step"] == 200.0
    for name in ("error", "sd", "log_evidence", "nees"):
        assert np.allclose(whole.data[name], loops.data[name], rtol=1e-5, atol=1e-6), name
    assert pfbench(*walk, "engine=compiled", "threads=2", home=tmp_path).code == 0
    assert torch.get_num_threads() == 2  # again; its pass had one
    torch.set_num_threads(1)
    (file,) = (tmp_path / "results" / "adhoc").glob("*.npz")
    assert store.read_result(file).meta["engine"] == "compiled"
    for name in ("error", "sd", "log_evidence", "nees"):
        shared = store.read_result(file).data[name]
        assert np.allclose(shared, whole.data[name], rtol=1e-12, atol=1e-12), name
