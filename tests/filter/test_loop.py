"""The time loop: what it refuses, what it hands to watchers, and that watching changes nothing."""

import ast
import math
from collections.abc import Iterator

import pytest
import torch
from checkout import ROOT
from refusals import check_refused

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    ParticleFilter,
    SigmaPointLinearisation,
    TaylorLinearisation,
)
from pfbench.filter.belief import StepInfo
from pfbench.filter.loop import choose_run_batch, run_filter
from pfbench.model import UnivariateGrowth, linear_walk, local_level

MODEL = linear_walk(1.0, 0.5, 1.0)
METHODS = [
    ParticleFilter(30),
    GaussianFilter(TaylorLinearisation()),
    GaussianFilter(SigmaPointLinearisation(CubaturePoints())),
]
every_method = pytest.mark.parametrize("method", METHODS, ids=lambda m: type(m).__name__)


def draws(runs: int = 3) -> PhiloxStream:
    return PhiloxStream(1, torch.arange(runs))


def record(steps: int = 7, runs: int = 3) -> Record:
    return Record(PhiloxStream(2, torch.arange(runs)).normal("y", steps, 1))


def test_an_empty_record_is_refused() -> None:
    check_refused(
        [
            (
                "at least one time step",
                lambda: run_filter(METHODS[0], MODEL, Record(torch.zeros(3, 0, 1)), draws()),
            )
        ],
        remedy=False,
    )


@pytest.mark.parametrize("value", [math.inf, -math.inf])
def test_infinite_measurements_are_refused(value: float) -> None:
    seen = record()
    seen.y[1, 2] = value
    check_refused([("NaN", lambda: run_filter(METHODS[0], MODEL, seen, draws()))], remedy=False)


@every_method
def test_shapes(method: ParticleFilter | GaussianFilter) -> None:
    estimate = run_filter(method, MODEL, record(), draws())
    assert estimate.mean.shape == estimate.variance.shape == (3, 7, 2)
    assert estimate.log_evidence.shape == estimate.lost.shape == (3,)
    assert all(value.shape == (3, 7) for value in estimate.trace.values())
    assert estimate.lost.dtype == torch.bool


@every_method
def test_watch_and_tick_are_called_at_every_step_and_change_nothing(
    method: ParticleFilter | GaussianFilter,
) -> None:
    seen: list[int] = []
    ticks: list[None] = []

    def watch(t: int, info: StepInfo) -> dict[str, torch.Tensor]:
        seen.append(t)
        return {"corner": info.covariance()[:, 0, 1], "block": info.covariance()}

    plain = run_filter(method, MODEL, record(), draws())
    watched = run_filter(
        method, MODEL, record(), draws(), watch=watch, on_step=lambda: ticks.append(None)
    )
    assert seen == list(range(7))
    assert len(ticks) == 7
    assert torch.equal(plain.mean, watched.mean)
    assert torch.equal(plain.log_evidence, watched.log_evidence)
    assert set(watched.trace) == set(plain.trace) | {"corner", "block"}
    assert watched.trace["block"].shape == (3, 7, 2, 2)
    assert torch.equal(watched.trace["corner"], watched.trace["block"][..., 0, 1])
    assert torch.allclose(watched.trace["block"].diagonal(dim1=-2, dim2=-1), watched.variance)


@every_method
@pytest.mark.parametrize("at_once", [1, 2, 5, 9])
def test_runs_may_be_stepped_in_blocks(
    method: ParticleFilter | GaussianFilter, at_once: int
) -> None:
    """Starts, spreads and inputs are of each run, one run has no measurement and the worlds are watched: nothing may change."""
    runs = 5
    seen = record(7, runs)._replace(
        start=PhiloxStream(4, torch.arange(runs)).normal("start", 2, 1)[..., 0],
        spread=torch.eye(2, dtype=torch.float64)
        * torch.arange(1.0, 1.0 + runs, dtype=torch.float64)[:, None, None],
    )
    seen.y[3] = torch.nan

    def watch(t: int, info: StepInfo) -> dict[str, torch.Tensor]:
        return {"mean": info.mean, "covariance": info.covariance()}

    whole = run_filter(method, MODEL, seen, draws(runs), watch)
    blocked = run_filter(method, MODEL, seen, draws(runs), watch, run_batch=at_once)
    torch.testing.assert_close(
        blocked._asdict(), whole._asdict(), rtol=1e-12, atol=1e-12, equal_nan=True
    )


@pytest.mark.parametrize(("runs", "blocks"), [(1, 1), (100, 1), (300, 4), (1000, 12)])
def test_blocks_of_runs_are_of_about_equal_size(runs: int, blocks: int) -> None:
    size = choose_run_batch(runs, 500, 15)
    assert -(-runs // size) == blocks
    assert size * blocks - runs < blocks


@pytest.mark.parametrize(
    ("runs", "threads", "size"), [(100, 2, 50), (300, 2, 75), (300, 3, 50), (1, 4, 1)]
)
def test_all_threads_have_batches_of_runs(runs: int, threads: int, size: int) -> None:
    """One thread takes 100 runs of 500 particles of 15 numbers at once, and 300 runs in four batches."""
    assert choose_run_batch(runs, 500, 15, threads=threads) == size


@every_method
def test_the_evidence_is_additive(method: ParticleFilter | GaussianFilter) -> None:
    """Unseen steps at the end add nothing to it."""
    seen = record()
    padded = Record(torch.cat([seen.y, torch.full((3, 4, 1), torch.nan, dtype=torch.float64)], 1))
    short, long = (run_filter(method, MODEL, r, draws()) for r in (seen, padded))
    assert torch.allclose(short.log_evidence, long.log_evidence, rtol=1e-12)
    assert torch.equal(short.mean, long.mean[:, :7])
    assert bool((long.variance[:, -1] > long.variance[:, 6]).all())


@every_method
def test_the_caller_s_record_is_left_alone(method: ParticleFilter | GaussianFilter) -> None:
    seen = record()
    before = seen.y.clone()
    run_filter(method, UnivariateGrowth(), seen, draws())
    assert torch.equal(seen.y, before)
    assert seen.u == ()


@every_method
def test_a_model_that_sees_its_initial_state(method: ParticleFilter | GaussianFilter) -> None:
    """With nothing seen, the first estimate is the initial law itself; the second has moved once."""
    still, moved = (
        local_level(3.0, 1.0, 5.0, 2.0, observes_initial=flag) for flag in (True, False)
    )
    nothing = Record(torch.full((3, 2, 1), torch.nan, dtype=torch.float64))
    method = ParticleFilter(20_000) if isinstance(method, ParticleFilter) else method
    a, b = (run_filter(method, m, nothing, draws()) for m in (still, moved))
    slack = 5 * math.sqrt(2 / 20_000) if isinstance(method, ParticleFilter) else 1e-12
    for estimate, expected in ((a, (4.0, 13.0)), (b, (13.0, 22.0))):
        assert torch.allclose(
            estimate.variance[..., 0],
            torch.tensor(expected, dtype=torch.float64).expand(3, -1),
            rtol=slack,
        )


@every_method
def test_the_model_s_precision_decides(method: ParticleFilter | GaussianFilter) -> None:
    model = linear_walk(1.0, 0.5, 1.0).float()
    estimate = run_filter(method, model, record(), PhiloxStream(1, torch.arange(3), torch.float32))
    assert estimate.mean.dtype == estimate.variance.dtype == torch.float32


# walks over records and the rule for a first measurement of the initial state, from syntax trees

PACKAGE = ROOT / "pfbench"


def is_walk(node: ast.AST) -> bool:
    """Whether a node loops over the time axis of measurements or of a truth."""
    if not isinstance(node, ast.For | ast.comprehension):
        return False
    call = node.iter
    if not (isinstance(call, ast.Call) and isinstance(call.func, ast.Name) and call.func.id == "range"):  # fmt: skip
        return False
    target, length = ast.unparse(node.target), ast.unparse(call)
    return target == "t" or "y.shape[1]" in length


def constructs(node: ast.AST, name: str) -> bool:
    return isinstance(node, ast.Call) and name in (
        getattr(node.func, "id", ""),
        getattr(node.func, "attr", ""),
    )


def places(source: str) -> Iterator[str]:
    """Kinds of forbidden code in a module: `walk` or `StaticModel`."""
    for node in ast.walk(ast.parse(source)):
        if is_walk(node):
            yield "walk"
        if constructs(node, "StaticModel"):
            yield "StaticModel"


def test_a_record_is_walked_and_a_model_is_held_still_in_one_place() -> None:
    found = {
        (file.relative_to(PACKAGE).as_posix(), kind)
        for file in PACKAGE.rglob("*.py")
        if "testing" not in file.parts
        for kind in places(file.read_text())
    }
    assert found == {("core/record.py", "walk"), ("model/base.py", "StaticModel")}


def test_a_second_walk_would_be_noticed() -> None:
    walks = [
        "for t in range(record.y.shape[1]): pass",
        "for s in range(y.shape[1]): pass",
        "a = [f(t) for t in range(n)]",
    ]
    assert [list(places(source)) for source in walks] == [["walk"]] * 3
    assert list(places("stage = base.StaticModel(model) if t == 0 else model")) == ["StaticModel"]
    assert (
        list(
            places(
                "for k in range(3): pass\nfor t, m, r in iterate_steps(model, record): isinstance(m, StaticModel)"
            )
        )
        == []
    )
