"""The door of `run_filter`: what does not fit is refused at the start, with key, value and remedy."""

from collections.abc import Callable
from typing import Any, NamedTuple

import pytest
import torch
from pyro.distributions import Binomial, LogNormal, Normal, Poisson, Uniform
from refusals import check_refused
from torch import Tensor
from typing_extensions import override

from pfbench.core import PhiloxStream, Record
from pfbench.core.density import log_density
from pfbench.filter import (
    CubaturePoints,
    GaussianFilter,
    MetropolisHastings,
    NoiseFlowStatKernel,
    ParticleFilter,
    input_check,
    run_filter,
)
from pfbench.kernels import dispatch
from pfbench.model import LinearGaussian, ModelWrapper, linear_walk
from pfbench.noise import NominalNoise
from pfbench.ppl import simulate
from pfbench.scenario import ModelSimulation

MODEL = linear_walk(1.0, 0.3, 1.0)
RUNS, STEPS = 3, 4
Y = torch.zeros(RUNS, STEPS, 1, dtype=torch.float64)
DRAWS = PhiloxStream(1, torch.arange(RUNS))


class Inputs(NamedTuple):
    force: Tensor


class Broken(LinearGaussian):
    """A model whose first state is not a number."""

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w) + torch.nan


class Wide(LinearGaussian):
    """A model that returns a state of another size."""

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        moved = super().propagate(x, u, w)
        return torch.cat([moved, moved], -1)


class Law(LinearGaussian):
    """A model whose measurement and noise have distributions of the test."""

    law: Any = None
    noise_law: Any = None

    @property
    @override
    def noise(self) -> Any:
        return self.noise_law or super().noise

    @override
    def observation(self, x: Tensor, u: Any) -> Any:
        return self.law(x[..., :1]) if self.law else super().observation(x, u)


def law_model(law: Any = None, noise_law: Any = None) -> Law:
    model = Law(torch.eye(2), torch.eye(2), [[1.0, 0.0]], [1.0], [0.0, 0.0], [1.0, 1.0])
    model.law, model.noise_law = law, noise_law
    return model


class Mixing(LinearGaussian):
    """A model whose particles attract each other."""

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w) + 0.1 * x.mean(1, keepdim=True)


class MixingRuns(LinearGaussian):
    """A model that subtracts the mean over the runs."""

    @override
    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w) - x.mean(0, keepdim=True)


class OneParticle(LinearGaussian):
    """A model that observes the mean of the particles."""

    @override
    def observation(self, x: Tensor, u: Any) -> Any:
        return super().observation(x.mean(1, keepdim=True), u)


class OneRun(LinearGaussian):
    """A model that observes the first run."""

    @override
    def observation(self, x: Tensor, u: Any) -> Any:
        return super().observation(x[:1], u)


def parameters(model: LinearGaussian) -> tuple[Tensor, ...]:
    return model.f, model.g, model.h, model.r, model.m0, model.l0


WRONG: dict[str, tuple[Any, Record, PhiloxStream, str]] = {
    "three components for one": (
        MODEL,
        Record(Y.expand(-1, -1, 3)),
        DRAWS,
        r"record.y must have as many components as LinearGaussian observes, 1, got 3",
    ),
    "a class": (LinearGaussian, Record(Y), DRAWS, r"model must be a StateSpaceModel, got Linear"),
    "a tensor": (MODEL, Y, DRAWS, r"record must be a Record, got Tensor. Pass the arguments"),  # type: ignore[dict-item]
    "no axis of runs": (MODEL, Record(Y[0]), DRAWS, r"axes \[R, T, Dy\], got float64 \[4, 1\]"),
    "whole numbers": (MODEL, Record(Y.long()), DRAWS, r"real numbers .*, got int64"),
    "no steps": (MODEL, Record(Y[:, :0]), DRAWS, "at least one time step, got 0"),
    "infinity": (MODEL, Record(Y + torch.inf), DRAWS, "must be finite, got infinity"),
    "other runs": (
        MODEL,
        Record(Y),
        PhiloxStream(1, torch.arange(5)),
        r"draws must be of 3 runs.*got 5.*arange\(3\)",
    ),
    "short inputs": (
        MODEL,
        Record(Y, Inputs(torch.zeros(RUNS, STEPS - 1, 2))),
        DRAWS,
        r"record.u.force must have the axes \[3 or 1, 4, ...\].*got \[3, 3, 2\]",
    ),
    "inputs of other runs": (
        MODEL,
        Record(Y, Inputs(torch.zeros(2, STEPS, 2))),
        DRAWS,
        r"record.u.force .*got \[2, 4, 2\]",
    ),
    "start": (
        MODEL,
        Record(Y, (), torch.zeros(RUNS, 5)),
        DRAWS,
        r"record.start must have shape \[3, 2\], got \[3, 5\]",
    ),
    "spread": (
        MODEL,
        Record(Y, (), torch.zeros(RUNS, 2), torch.zeros(RUNS, 2)),
        DRAWS,
        r"record.spread must have shape \[3, 2, 2\], got \[3, 2\]",
    ),
    "inputs without a name": (
        MODEL,
        Record(Y, torch.zeros(RUNS, STEPS, 2)),  # type: ignore[arg-type]
        DRAWS,
        r"record.u must be a NamedTuple of tensors .*, got Tensor. Define",
    ),
    "inputs as a dictionary": (
        MODEL,
        Record(Y, {"force": torch.zeros(RUNS, STEPS, 2)}),  # type: ignore[arg-type]
        DRAWS,
        r"record.u must be a NamedTuple of tensors .*, got dict. Define",
    ),
    "inputs of numbers": (
        MODEL,
        Record(Y, Inputs(3.0)),  # type: ignore[arg-type]
        DRAWS,
        r"record.u.force must be a tensor or a NamedTuple of tensors, got float",
    ),
    "particles that are mixed": (
        Mixing(*parameters(MODEL)),
        Record(Y),
        DRAWS,
        r"Mixing.propagate must move each particle of each run by itself",
    ),
    "runs that are mixed": (
        MixingRuns(*parameters(MODEL)),
        Record(Y),
        DRAWS,
        r"MixingRuns.propagate must move each particle of each run by itself",
    ),
    "one observation for all particles": (
        OneParticle(*parameters(MODEL)),
        Record(Y),
        DRAWS,
        r"OneParticle.observation must .* \[3, 4\], got \[3, 1\]",
    ),
    "one observation for all runs": (
        OneRun(*parameters(MODEL)),
        Record(Y),
        DRAWS,
        r"OneRun.observation must .* \[3, 4\], got \[1, 4\]",
    ),
    "states that are not numbers": (
        Broken(*parameters(MODEL)),
        Record(Y),
        DRAWS,
        r"Broken.propagate must return finite states, got numbers that are not finite",
    ),
    "states of another size": (
        Wide(*parameters(MODEL)),
        Record(Y),
        DRAWS,
        r"Wide.propagate must return states \[3, 4, 2\] for noise \[3, 4, \d\], got \[3, 4, 4\]. Return one component",
    ),
}


@pytest.mark.parametrize("case", WRONG)
def test_what_does_not_fit_is_refused_in_every_engine(case: str) -> None:
    model, record, draws, message = WRONG[case]
    for method in (ParticleFilter(20), GaussianFilter(CubaturePoints())):
        for compiled in (False, True):
            with dispatch.use_kernels(compiled), pytest.raises(ValueError, match=message):
                run_filter(method, model, record, draws)


class Doubled(NamedTuple):
    inner: Inputs


class WrappedInputs(ModelWrapper):
    """A wrapper with inputs of its own, as a model with oracle noise has."""

    @override
    def propagate(self, x: Tensor, u: Doubled, w: Tensor) -> Tensor:
        return self.model.propagate(x, u.inner, w)

    @override
    def observation(self, x: Tensor, u: Doubled) -> Any:
        return self.model.observation(x, u.inner)


class Driven(LinearGaussian):
    """A model whose observation needs its inputs."""

    @override
    def observation(self, x: Tensor, u: Any) -> Any:
        return super().observation(x + 0.0 * u.force[..., None, :2], u)


def test_a_wrapper_gives_its_inputs_to_its_own_observation() -> None:
    inputs = Doubled(Inputs(torch.zeros(1, STEPS, 2, dtype=torch.float64)))
    model = WrappedInputs(Driven(*parameters(MODEL)))
    result = run_filter(ParticleFilter(20), model, Record(Y, inputs), DRAWS)
    assert not result.lost.any()


def test_weights_below_the_precision_of_their_logarithms_lose_the_run() -> None:
    """At 1e8 standard deviations log weights are noise; 1e5 are resolved."""
    y = Y.clone()
    y[0, 2], y[1, 2], y[2, 2] = 1e200, 1e9, 1e5
    result = run_filter(ParticleFilter(20), MODEL, Record(y), DRAWS)
    assert result.lost.tolist() == [True, True, False]
    assert torch.isneginf(result.log_evidence[:2]).all()


def test_statistics_of_the_path_need_a_proper_start() -> None:
    f, g, h, r, m0, l0 = parameters(MODEL)
    method = ParticleFilter(20, moves=[MetropolisHastings(NoiseFlowStatKernel(), 1)])
    check_refused(
        [
            (
                r"must be positive definite .* got variances \[0.0, 0.0\]",
                lambda: run_filter(
                    method, LinearGaussian(f, g, h, r, m0, 0.0 * l0), Record(Y), DRAWS
                ),
            )
        ],
        remedy=False,
    )


def test_what_fits_is_computed() -> None:
    inputs = Inputs(torch.zeros(1, STEPS, 2, dtype=torch.float64))
    for record in (Record(Y), Record(Y.float()), Record(Y, inputs), Record(Y * torch.nan)):
        result = run_filter(ParticleFilter(20), MODEL, record, DRAWS)
        assert not result.lost.any()


def test_a_model_is_checked_again_where_it_or_its_record_has_changed(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    checks: list[Any] = []
    monkeypatch.setattr(input_check, "check_model", lambda *given: checks.append(given))
    model, y = linear_walk(1.0, 0.3, 1.0), Y.clone()

    def count(record: Record) -> int:
        checks.clear()
        run_filter(ParticleFilter(20), model, record, DRAWS)
        run_filter(ParticleFilter(30), model, record, DRAWS)  # the filter does not count
        return len(checks)

    assert count(Record(y)) == 1
    assert count(Record(y)) == 0
    y[0, 0] = 1.0
    assert count(Record(y)) == 1  # the same tensor, with another number
    assert count(Record(y.clone())) == 1
    model.r.mul_(2.0)
    assert count(Record(y)) == 1
    model.choices = ("another attribute",)
    assert count(Record(y)) == 1
    assert count(Record(y, Inputs(torch.zeros(1, STEPS, 2, dtype=torch.float64)))) == 1
    for _ in range(20):  # memory of an earlier record may serve a later one
        assert count(Record(Y.clone())) == 1


LAWS = {
    "Law.observation": law_model(lambda x: Normal(x, 1.0)),
    "Law.noise": law_model(noise_law=Normal(torch.zeros(2, dtype=torch.float64), 1.0)),
}


@pytest.mark.parametrize("name", LAWS)
def test_a_law_without_an_event_is_refused_at_each_door(name: str) -> None:
    model, steps = LAWS[name], STEPS
    doors: dict[str, Callable[[], Any]] = {
        "filter": lambda: run_filter(ParticleFilter(8), model, Record(Y), DRAWS),
        "scenario": lambda: ModelSimulation(model, steps).draw(NominalNoise(), DRAWS.runs, 1),
        "program": lambda: simulate(model, Record(Y), 1),
    }
    for door in doors.values():
        with pytest.raises(TypeError, match=rf"{name} must .* got Normal .*\[\]\. .*to_event\(1\)"):
            door()


@pytest.mark.parametrize(
    ("law", "wrong"), [("Poisson", -1.0), ("Poisson", 1.5), ("LogNormal", -2.0)]
)
@pytest.mark.parametrize("validate", [False, True])
def test_a_measurement_outside_the_support_is_refused(
    law: str, wrong: float, validate: bool
) -> None:
    """A missing component is not checked, whether or not torch validates."""
    kinds: dict[str, Callable[[Tensor], Any]] = {
        "Poisson": lambda x: Poisson(x.exp(), validate_args=validate).to_event(1),
        "LogNormal": lambda x: LogNormal(x, 1.0, validate_args=validate).to_event(1),
    }
    model, y = law_model(kinds[law]), Y + 1.0
    y[2, 1] = torch.nan
    if law == "Poisson":
        check_refused(
            [
                (
                    r"Law\.has_counts must be True .* Set `has_counts = True`",
                    lambda: run_filter(ParticleFilter(8), model, Record(y), DRAWS),
                )
            ],
            remedy=False,
        )
        model.has_counts = True
    run_filter(ParticleFilter(8), model, Record(y), DRAWS)
    y[1, 3] = wrong
    message = rf"support of {law} \(.*Than.*\), got {wrong:g} at step 3 of run 1\. Mark "
    check_refused(
        [(message, lambda: run_filter(ParticleFilter(8), model, Record(y), DRAWS))], remedy=False
    )


@pytest.mark.parametrize("law", ["Uniform", "Binomial"])
def test_a_support_that_depends_on_the_state_is_named_with_a_remedy(law: str) -> None:
    def make(x: Tensor, validate: bool) -> Any:
        if law == "Uniform":
            return Uniform(x - 1.0, x + 1.0, validate_args=validate).to_event(1)
        count = torch.full_like(x, 3.0)
        return Binomial(count, logits=x, validate_args=validate).to_event(1)

    y = torch.zeros_like(Y)
    y[1, 3] = 50.0
    message = (
        rf"^\w+\.observation must return .* contains the measurement .*, got {law} for 50\. Mark "
        rf".* create {law} with validate_args=False"
    )
    check_refused(
        [
            (
                message,
                lambda: log_density(
                    make(Y[:, :1] * 0.0, True),
                    y[:, 3:4],
                    torch.ones(len(Y), 1, 1).bool(),
                    "A.observation",
                ),
            )
        ],
        remedy=False,
    )
    free = log_density(
        make(Y[:, :1] * 0.0, False), y[:, 3:4], torch.ones(len(Y), 1, 1).bool(), "A.observation"
    )
    assert free.flatten()[1] == -torch.inf
    assert torch.isfinite(free.flatten()[[0, *range(2, len(Y))]]).all()
