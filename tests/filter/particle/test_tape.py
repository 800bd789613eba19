"""A filter whose model is a tape computes what the operators compute, and what a filter in numpy computes."""

from collections.abc import Callable
from itertools import product
from types import SimpleNamespace
from typing import Any, NamedTuple

import numpy as np
import pytest
import torch
from compiled_cases import agree, compiler
from config_cases import composed, world
from model_cases import RUNS, simulate_with_gaps, tracker
from torch import Tensor

from pfbench import job
from pfbench.core import PhiloxStream, Record
from pfbench.core.linear_algebra import affine_map
from pfbench.filter import (
    EssResampler,
    FilterResult,
    ParticleFilter,
    Stratified,
    Systematic,
    run_filter,
)
from pfbench.filter.belief import ParticleBelief, StepInfo
from pfbench.filter.particle import taped_filter
from pfbench.filter.particle.taken_steps import tensors_in
from pfbench.filter.particle.tape import NoTapeError, record_tape
from pfbench.filter.particle.taped_filter import TapedParticleFilter
from pfbench.job.scoring import LikelihoodCounter
from pfbench.kernels import dispatch
from pfbench.model import (
    Benes,
    LinearGaussian,
    Lorenz63,
    Pendulum,
    StateSpaceModel,
    StochasticVolatility,
    UnivariateGrowth,
    linear_walk,
)
from pfbench.model.ins_gnss import LooseStep

pytestmark = compiler
PARTICLES = 700  # blocks of 256 and a rest
CLOSE = 2e-12
ROTATION = torch.linalg.qr(torch.arange(25.0).reshape(5, 5).double().sin())[0]
# dense, with a few noises: the distribution of the next state is singular
MATRICES = 0.95 * ROTATION, ROTATION[:, :3], ROTATION[:2] + 0.1, [0.5, 0.7], [1.0] * 5, [2.0] * 5


def make_filter(threshold: float = 0.5, particles: int = PARTICLES) -> ParticleFilter:
    return ParticleFilter(particles, EssResampler(Systematic(), threshold))


def run(
    method: Any, model: StateSpaceModel, record: Record, watch: Any = None, **options: Any
) -> FilterResult:
    runs = RUNS[: len(record.y)]
    with dispatch.use_kernels(), torch.no_grad():
        return run_filter(method, model, record, PhiloxStream(3, runs), watch, **options)


def assert_close(one: FilterResult, other: FilterResult) -> None:
    """Every number of two estimates, to 2e-12 of the largest of its kind."""
    for name in ("mean", "variance", "log_evidence", "pareto_k"):
        a, b = getattr(one, name), getattr(other, name)
        size = float(b[torch.isfinite(b)].abs().max()) if bool(torch.isfinite(b).any()) else 0.0
        torch.testing.assert_close(a, b, rtol=CLOSE, atol=CLOSE * size, equal_nan=True, msg=name)
    assert one.trace.keys() == other.trace.keys()
    for name, value in other.trace.items():  # with the same ancestors
        assert one.trace[name].dtype == value.dtype
        torch.testing.assert_close(one.trace[name], value, rtol=1e-10, atol=1e-10)
    assert torch.equal(one.health, other.health)


def compare(model: StateSpaceModel, record: Record, threshold: float = 0.5) -> FilterResult:
    """Compare the two engines. Returns the result."""
    method = make_filter(threshold)
    taped = TapedParticleFilter(method)
    result = run(taped, model, record)
    assert taped.is_active
    assert_close(result, run(method, model, record))
    return result


MODELS: dict[str, Callable[[], StateSpaceModel]] = {
    "growth": UnivariateGrowth,
    "volatility": StochasticVolatility,
    "lorenz": Lorenz63,
    "benes": Benes,
    "tracker": tracker,
    "linear": lambda: LinearGaussian(*MATRICES),
}


@pytest.mark.parametrize("threshold", [0.0, 0.5, 1.0])
@pytest.mark.parametrize("name", MODELS)
def test_a_tape_computes_what_the_operators_compute(name: str, threshold: float) -> None:
    """Also with measurements missing, in runs of any numbers, with a rest of a block, whether or not a step resamples."""
    model = MODELS[name]()
    result = compare(model, simulate_with_gaps(model), threshold)
    resampled = result.trace["resampled"]
    assert bool(resampled.all()) == (threshold == 1.0)
    assert bool(resampled.any()) == (threshold > 0.0)


@pytest.mark.parametrize("words", ["passive_1", "terrain", "flight_500s", "gps_ins_inflated"])
def test_a_tape_of_a_scenario_has_its_inputs_and_residual(words: str) -> None:
    record = world(words).record.select_steps(slice(0, 15))
    model = job.instantiate(composed(f"scenario={words}").model)
    moves = [a[:, 1:] != a[:, :-1] for a in tensors_in(model.prepare(record).u)]
    assert any(bool(a.any()) for a in moves)  # else a step may have those of another
    compare(model, record)


class Faults(NamedTuple):
    """Numbers of each run and step."""

    shift: Tensor
    breaks: Tensor


class Breaking(UnivariateGrowth):
    """Particles beyond 15 become no number, in a step that breaks all of them; others below -9 become infinite."""

    def prepare(self, record: Record) -> Record:
        return record

    def noise_gain(self, u: Any) -> Any:
        return None

    def propagate(self, x: Tensor, u: Faults, w: Tensor) -> Tensor:
        moved = 0.5 * x + 25.0 * x / (1.0 + x * x) + u.shift[:, None, None] + self.q * w
        fails = (moved > 15.0) | (u.breaks[:, None, None] > 0.0)
        return torch.where(fails, torch.nan, torch.where(moved < -9.0, torch.inf, moved))


class Turning(LinearGaussian):
    """Matrices of each run and step, and a gain that runs share."""

    prepare, noise_gain = Breaking.prepare, Breaking.noise_gain

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return affine_map(u.phi, x, u.gain, w)


@pytest.mark.parametrize("threshold", [0.5, 1.0])
def test_matrices_may_be_those_of_a_run_and_a_step(threshold: float) -> None:
    """With a third of zeros, at other places in each. Threads change no bit."""
    model, change = Turning(*MATRICES), PhiloxStream(4, RUNS).normal("matrices", 20, 40)
    change = torch.where(change.abs() < 0.4, 0.0, 0.3 * change).unflatten(2, (5, 8))
    inputs = LooseStep(change[..., :5], change[:1, :, :, 5:])
    record = simulate_with_gaps(LinearGaussian(*MATRICES))._replace(u=inputs)
    result, taped = compare(model, record, threshold), TapedParticleFilter(make_filter(threshold))
    assert torch.equal(run(taped, model, record, run_batch=1, threads=3).mean, result.mean)


def break_record() -> Record:
    """Run 0 measures what no particle fits at step 10, all particles of run 2 are no number at step 7."""
    record = simulate_with_gaps(UnivariateGrowth())
    steps = record.y.shape[1]
    shift = 8.0 * torch.cos(1.2 * torch.arange(steps, dtype=torch.float64)).expand(3, -1).clone()
    shift += 0.3 * torch.arange(3)[:, None]  # a run with the inputs of another would be seen
    breaks = torch.zeros_like(shift)
    breaks[2, 7] = 1.0
    record.y[0, 10] = 1e30
    return record._replace(u=Faults(shift, breaks))


@pytest.mark.parametrize("threshold", [0.5, 1.0])
def test_lost_runs_and_particles_that_are_no_number_are_treated_as_by_the_operators(
    threshold: float,
) -> None:
    model, record = Breaking(), break_record()
    result = compare(model, record, threshold)
    assert result.lost.tolist() == [True, False, True]
    assert bool(torch.isnan(result.mean[2, 7:]).all())
    assert bool(torch.isfinite(result.mean[1]).all())
    x = PhiloxStream(1, RUNS).normal("x", 300, 1) * 20.0
    moved = model.propagate(x, record.at_step(0).u, 0.0 * x)
    assert bool(torch.isnan(moved).any())  # else nothing of it was tried
    assert bool(torch.isinf(moved).any())


def filter_in_numpy(model: UnivariateGrowth, record: Record, particles: int) -> dict[str, Any]:
    """A bootstrap filter of one run of the growth model, which resamples below half of the particles."""
    y, draws = record.y[0, :, 0].numpy(), PhiloxStream(3, RUNS[:1])
    q, r = float(model.q), float(model.r)
    x = float(model.p0) * draws.at_step(0).normal("initial", particles, 1)[0, :, 0].numpy()
    w, mean, variance, evidence = np.full(particles, 1.0 / particles), [], [], 0.0
    for t, measured in enumerate(y):
        step = draws.at_step(t + 1)
        if 1.0 / (w**2).sum() < 0.5 * particles:
            offset = float(step.uniform("resample", 1, 1))
            position = (np.arange(particles) + offset) / particles
            x, w = x[np.searchsorted(np.cumsum(w), position)], np.full(particles, 1.0 / particles)
        noise = step.normal("noise", particles, 1)[0, :, 0].numpy()
        x = x / 2 + 25 * x / (1 + x**2) + 8 * np.cos(1.2 * (t + 1)) + q * noise
        if not np.isnan(measured):
            density = np.exp(-0.5 * ((measured - x**2 / 20) / r) ** 2) / (r * np.sqrt(2 * np.pi))
            evidence += np.log((w * density).sum())
            w = w * density / (w * density).sum()
        mean.append((w * x).sum())
        variance.append((w * (x - mean[-1]) ** 2).sum())
    return {"mean": mean, "variance": variance, "log_evidence": evidence}


def test_a_tape_computes_what_a_filter_in_numpy_computes() -> None:
    """It shares the random numbers, as torch draws them, and no other code."""
    model = UnivariateGrowth()
    record = simulate_with_gaps(model).select_runs(slice(0, 1))
    record.y[0, 5] = torch.nan
    taped = TapedParticleFilter(make_filter(0.5, 500))
    result = run(taped, model, record)
    assert taped.is_active
    assert 0 < int(result.trace["resampled"].sum()) < record.y.shape[1]
    expected = filter_in_numpy(model, record, 500)
    for name, value in expected.items():
        found = getattr(result, name)[0].squeeze(-1).numpy()
        assert np.allclose(found, value, rtol=1e-9, atol=1e-9), name


def test_a_tape_has_the_constants_of_its_pass() -> None:
    """A buffer that changes, also in place, or a number of Python: the next pass of the same objects has the new one."""
    model, method = Lorenz63(), make_filter()
    record, taped = simulate_with_gaps(model), TapedParticleFilter(make_filter())
    found = []
    for change in (lambda: None, lambda: model.q.mul_(3.0), lambda: setattr(model, "step", 0.03)):
        change()
        found.append(run(taped, model, record))
        assert_close(found[-1], run(method, model, record))
    assert taped.is_active
    for one, other in zip(found[1:], found, strict=False):
        assert not torch.allclose(one.mean, other.mean)
    assert not taped._passes  # no tape lives longer than its pass


@pytest.mark.parametrize(
    ("runs", "numbers"), [(3, 1), (3, 5_000), (3, 1 << 20), (1, 5_000), (1, 1 << 20)]
)
def test_steps_are_read_wherever_a_block_ends(
    runs: int, numbers: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Moments, particles, covariances and innovations of each step, batches of runs, threads, and counts of evaluations."""
    monkeypatch.setattr(taped_filter, "MAX_NUMBERS", numbers)
    record, results, counts = (
        simulate_with_gaps(UnivariateGrowth()).select_runs(slice(0, runs)),
        [],
        [],
    )

    def watch(t: int, info: StepInfo) -> dict[str, Tensor]:
        assert info.cloud is not None
        assert info.nis is not None
        with counter.paused():
            nis, covariance = info.nis()[0], info.covariance()[:, 0, 0]
        return {"nis": nis, "covariance": covariance, "far": info.cloud()[0].abs().amax((1, 2))}

    for wrap, options in ((True, {"run_batch": 2, "threads": 2}), (True, {}), (False, {})):
        counter = LikelihoodCounter(model := UnivariateGrowth())
        method: Any = TapedParticleFilter(make_filter(), counter) if wrap else make_filter()
        with monkeypatch.context() as patch:
            if wrap:  # a step by the operators would be seen
                patch.setattr(ParticleFilter, "compute_step", None)
            results.append(run(method, model, record, watch, **options))
        counts.append(counter.count)
    assert counts[0] == counts[1] == counts[2] > 0
    for result in results[:2]:
        assert_close(result, results[2])


def test_the_first_measurement_may_be_of_the_initial_state() -> None:
    model = linear_walk(1.0, 0.3, 1.0)
    model.observes_initial = True
    compare(model, simulate_with_gaps(model))


# --------------------------------------------------------------------------------------------------
# What a tape cannot be: the reason is logged, and the operators take the steps.


def make_map(change: Callable[..., Tensor]) -> Any:
    """The part of a model that is recorded: its first component becomes a function of all; nothing is measured."""

    def propagate(x: Tensor, u: Any, w: Tensor) -> Tensor:
        moved = change(*x.unbind(-1)).to(x)
        return torch.cat([moved.unsqueeze(-1), x[..., 1:]], -1)

    return SimpleNamespace(propagate=propagate, log_likelihood=lambda y, x, u: 0.0 * x[..., 0])


def fill_in_place(x: Tensor) -> Tensor:
    moved = x.clone()
    moved[0] = 0.5 * x[0]
    return moved


REFUSED: dict[str, tuple[str, Callable[[Tensor], Tensor]]] = {
    "branch": ("asks for values by bool", lambda x: x if x[0, 0] > 1e9 else 0.5 * x),
    "value": ("asks for values by float", lambda x: 0.0 * float(x[0, 0]) + x),
    "array": ("asks for values by", lambda x: x + float(x.numpy()[0, 0])),
    "draw": ("draws random numbers", lambda x: x + 1e-3 * torch.rand(1, dtype=x.dtype)),
    "mean": ("mixes particles or runs", lambda x: x - 0.1 * x.sum(1, keepdim=True)),
    "order": ("the place of a particle", lambda x: x + torch.arange(x.shape[1])),
    "flip": ("the place of a particle", lambda x: x.flip(1)),
    "runs": ("the place of a particle", lambda x: x.flip(0)),
    "sort": (r"needs torch.sort", lambda x: x.sort(-1)[0]),
    "in place": ("setitem", fill_in_place),
    "single": (r"needs torch.float .* torch.float32", lambda x: x.float().double()),
    "long": (
        "more than 2000 instructions",
        lambda x: (x[..., None, None] * torch.arange(2048.0).double().view(64, 32)).sum(-1).sum(-1),
    ),
}


@pytest.mark.parametrize("name", REFUSED)
def test_what_is_no_function_of_a_particle_alone_is_no_tape(name: str) -> None:
    reason, change = REFUSED[name]
    x = PhiloxStream(1, RUNS[:2]).normal("x", 2, 1)
    with pytest.raises(NoTapeError, match=reason):
        record_tape(make_map(change), x.clone(), x.clone(), Record(torch.zeros(2, 1).double()))


class Clamped(UnivariateGrowth):
    """Growth that fills a tensor in place."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w).clamp_(-50.0, 50.0)


OTHERS: dict[str, tuple[Any, StateSpaceModel, torch.dtype]] = {
    "needs torch.clamp_": (make_filter(), Clamped(), torch.float64),
    "Stratified in place of Systematic": (
        ParticleFilter(60, EssResampler(Stratified())), UnivariateGrowth(), torch.float64,
    ),
    "states have angles": (make_filter(), Pendulum(), torch.float64),
    "not those of a tape": (make_filter(), UnivariateGrowth().float(), torch.float32),
}  # fmt: skip


@pytest.mark.parametrize("reason", OTHERS)
def test_without_a_tape_the_operators_take_the_steps_and_one_line_says_so(
    reason: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level("INFO", "pfbench")
    method, model, dtype = OTHERS[reason]
    record, taped = (
        simulate_with_gaps(UnivariateGrowth()).to(model.anchor),
        TapedParticleFilter(method),
    )
    draws = PhiloxStream(3, RUNS, dtype)
    with dispatch.use_kernels(), torch.no_grad():
        results = [run_filter(a, model, record, draws) for a in (taped, taped, method)]
    for result in results[:2]:
        agree(result, results[2])
    (line,) = [entry.getMessage() for entry in caplog.records if "no tape" in entry.getMessage()]
    assert reason in line
    assert not taped.is_active


def test_a_tape_of_other_numbers_is_not_used(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """What a recording gave is compared with torch's numbers of the same particles."""
    caplog.set_level("INFO", "pfbench")

    def record_wrongly(*arguments: Any) -> Any:
        tape, *numbers = record_tape(*arguments)
        return tape._replace(constants=1.001 * tape.constants), *numbers

    monkeypatch.setattr(taped_filter, "record_tape", record_wrongly)
    taped = TapedParticleFilter(make_filter())
    model = UnivariateGrowth()
    assert_close(
        run(taped, model, simulate_with_gaps(model)),
        run(make_filter(), model, simulate_with_gaps(model)),
    )
    assert not taped.is_active
    assert "the tape does not compute the numbers of torch" in caplog.text


# --------------------------------------------------------------------------------------------------
# Each instruction is torch's operation.


FUNCTIONS: dict[str, Callable[..., Tensor]] = {
    "arithmetic": lambda a, b: (a + b) * (a - b) / (2.0 - b * b) - (-a) + (3.0 - b) + 2.0 / a,
    "alpha": lambda a, b: torch.add(a, b, alpha=-0.5) + torch.addcmul(a, a, b, value=3.0),
    "quotient": lambda a, b: torch.addcdiv(a, b, a, value=2.0) + torch.reciprocal(b),
    "roots": lambda a, b: torch.sqrt(a.abs()) + torch.rsqrt(b.abs()) + b.abs() ** 0.5 + a**3,
    "powers": lambda a, b: a.abs() ** b + 2.0**a + a**2 + torch.square(b),
    "exp": lambda a, b: torch.exp(a) - torch.expm1(0.1 * b),
    "log": lambda a, b: torch.log(a.abs()) + torch.log1p(b.abs()),
    "circular": lambda a, b: torch.sin(30.0 * a) + torch.cos(30.0 * b) + torch.tan(0.1 * a),
    "far circular": lambda a, b: torch.sin(1e8 * a) + torch.cos(-3e7 * b),
    "angles": lambda a, b: torch.atan2(a, b) + torch.atan(a) + torch.hypot(a, b),
    "inverse": lambda a, b: torch.atan(a / 9.0) + torch.tanh(b),
    "normal": lambda a, b: torch.special.ndtr(a) + torch.sigmoid(b),
    "rounding": lambda a, b: torch.round(a) + torch.floor(b) * torch.ceil(a) + torch.sign(b),
    "remainder": lambda a, b: torch.remainder(a, 1.3) + torch.remainder(b, -0.7) + a % 2.0,
    "limits": lambda a, b: torch.minimum(a, b) + 2.0 * torch.maximum(a, b) + a.clamp(-1.0, 0.5),
    "choice": lambda a, b: torch.where((a > b) & ~(a >= 1.0) | (b == 0.0), a, 2.0 * b),
    "order": lambda a, b: (a < b).double() + b * (a <= 0.5) + a * (b != a),
    "missing": lambda a, b: torch.where(a > 0.0, torch.nan, a).nan_to_num(3.0 * 0.0) + b,
    "masks": lambda a, b: a.masked_fill(b > 0.0, 4.0) * torch.isfinite(b) + torch.isnan(a),
    "matrices": lambda a, b: (torch.stack([a, b], -1) @ torch.tensor([[1.0, 2.0], [0.0, -3.0]]).double())[..., 1],
    "dense": lambda a, b: (torch.stack([a, b, a * b, a, b], -1) @ ROTATION.mT @ ROTATION[1:].mT)[..., 2] + b,
    "affine": lambda a, b: torch.nn.functional.linear(torch.stack([a, b, b.exp(), b, a], -1), ROTATION[:3], ROTATION[0, :3]).prod(-1),
    "zero": lambda a, b: (ROTATION[0, 0] * 0.0 + torch.isnan((torch.stack([1.0 / (a * 0.0), a, b, a], -1) @ torch.arange(4.0).double()[:, None])[..., 0])).double(),
    "sums": lambda a, b: torch.stack([a, b, a * b], -1).sum(-1) + ((a > 0.0)[..., None] & (b > 0.0)[..., None]).any(-1),
    "products": lambda a, b: torch.cat([a[..., None], b[..., None]], -1).prod(-1),
}  # fmt: skip


@pytest.mark.parametrize("name", FUNCTIONS)
def test_each_instruction_computes_what_torch_computes(name: str) -> None:
    """To 2e-12 of its terms, over particles of a few hundred values, zeros and whole numbers among them."""
    values = PhiloxStream(2, torch.arange(1)).normal("x", 300, 2)[0] * 2.0
    values[:25] = torch.cartesian_prod(*[torch.tensor([-2.0, -0.5, 0.5, 1.0, 3.0]).double()] * 2)
    x, model = values.clamp(-8.0, 8.0)[None], make_map(FUNCTIONS[name])
    record, w = Record(torch.zeros(1, 1, 1).double()), torch.zeros(1, 2, 1).double()
    tape, *_ = record_tape(model, x[:, :2].clone(), w, record.at_step(0))
    log_w = torch.full((1, 300), -np.log(300.0), dtype=torch.float64)
    belief = ParticleBelief(x, log_w, torch.zeros(1, dtype=torch.float64))
    draws = PhiloxStream(1, torch.arange(1), step=1)
    taken = taped_filter._run(tape, 0.0, belief, record, draws, [0])
    expected = model.propagate(x, (), w)
    assert bool(torch.isfinite(expected).all())
    torch.testing.assert_close(taken.last.x, expected, rtol=CLOSE, atol=CLOSE)


def test_wrong_instructions_are_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is read or written outside of the tape's own numbers."""
    model, run_tape, calls = UnivariateGrowth(), dispatch.run_tape, []
    monkeypatch.setattr(dispatch, "run_tape", lambda given: calls.append(given) or run_tape(given))
    run(TapedParticleFilter(make_filter()), model, simulate_with_gaps(model))
    given = calls[-1]
    wrong = [(1, given[1] + 1000), (5, given[5][0]), (6, given[6][:, :1]), (8, given[8].double())]
    wrong += [(9, torch.tensor([0])), (9, given[9] + 1), (9, given[9] - 100), (3, given[3][1:])]
    wrong += [(11, given[11] * torch.tensor([1, 0, 1, 1, 1, 1, 1])), (4, given[4].float())]
    changes = [(0, 30), (0, 31), (0, -1), (1, 0), (1, ~0), *product(range(1, 5), (10**6, -(10**6)))]
    for column, value in changes:
        wrong.append((0, given[0].clone()))
        wrong[-1][1][-1, column] = value
    for place, tensor in wrong:
        with pytest.raises(RuntimeError, match=r"run_tape|different types"):
            run_tape([*given[:place], tensor, *given[place + 1 :]])
