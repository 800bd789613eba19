"""Jacobians that models state: finite differences, the extended Kalman filter, and classes that override a map."""

from typing import Any

import pytest
import torch
from config_cases import composed, world
from refusals import check_refused
from torch import Tensor

from pfbench import job
from pfbench.core.random_stream import PhiloxStream
from pfbench.filter import GaussianFilter, ParticleFilter, TaylorLinearisation
from pfbench.filter.linearisation import (
    find_observation_jacobian,
    find_propagation_jacobian,
    measurement_jacobian,
    transition_jacobian,
)
from pfbench.filter.loop import prepare_record, run_filter
from pfbench.model import Benes, Lorenz63, UnivariateGrowth
from pfbench.noise import NominalNoise
from pfbench.scenario import ModelSimulation
from pfbench.testing import check_jacobians

BOTH = {"propagation_jacobian", "observation_jacobian"}
STATED = {
    "growth": BOTH, "stochastic_volatility": {"propagation_jacobian"}, "pendulum": BOTH, "lorenz63": BOTH,
    "lorenz63_twin": BOTH, "lorenz96_twin": set(),
    "linear_walk": BOTH, "passive_1": {"propagation_jacobian"}, "flight_300s": BOTH,
    "anshun_short": {"propagation_jacobian"}, "azimuth": {"observation_jacobian"},
    "terrain": BOTH,
}  # fmt: skip

DRIVEN = [
    *(("flight_300s", name) for name in ("ins_gnss", "ins_gnss_inflated")),
    ("gps_ins_markov", "ins_gnss18"),
    *(("azimuth", name) for name in ("sins_gps_azimuth", "sins_gps_azimuth15", "azimuth_small")),
    *(("anshun_short", name) for name in ("sins_gnss_tight", "sins_gnss_tight_nl")),
]


@pytest.mark.parametrize(("scenario", "name"), DRIVEN)
def test_noise_enters_a_flight_where_its_gain_says(scenario: str, name: str) -> None:
    model: Any = job.instantiate(composed(f"scenario={scenario}", f"model={name}").model)
    u = model.prepare(world(scenario).record).at_step(2).u
    draws = PhiloxStream(1, torch.arange(len(u[0])))
    w, d = draws.normal("w", 4, model.noise_dim), draws.normal("x", 4, model.chart.dimension)
    x = model.chart.add(model.origin.expand(len(d), 4, -1), d * model.p0)
    moved, still = model.propagate(x, u, w), model.propagate(x, u, torch.zeros_like(w))
    expected = w @ model.noise_gain(u).mT
    torch.testing.assert_close(model.chart.subtract(moved, still), expected, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("name", STATED)
def test_stated_jacobians_are_difference_quotients(name: str) -> None:
    model: Any = job.instantiate(composed(f"scenario={name}").model)
    record = prepare_record(model, world(name).record).at_step(1)
    runs = len(record.y)
    noise = PhiloxStream(5, torch.arange(runs)).normal("states", 4, model.chart.dimension)
    x = model.chart.add(model.origin.expand(runs, 4, -1), 0.7 * model.initial(1).stddev * noise)
    assert check_jacobians(model, x, record.u).keys() == STATED[name] | {"noise_gain"}
    # the derivative by automatic differentiation, which shares nothing with the stated one
    h = find_observation_jacobian(model, x, record.u)
    f = find_propagation_jacobian(model, x, record.u)
    if f is not None:
        torch.testing.assert_close(transition_jacobian(model, x, record.u), f)
    if h is not None:
        missing = torch.isnan(record.y)[:, None, :, None]
        expected = torch.where(missing, 0.0, h)
        torch.testing.assert_close(measurement_jacobian(model, x, record), expected)


def test_the_jacobian_of_the_benes_step_is_the_difference_quotient_but_at_its_jump() -> None:
    x = torch.tensor([-2.0, -0.3, 0.4, 1.7], dtype=torch.float64).view(2, 2, 1)
    assert check_jacobians(Benes(), x, None).keys() == BOTH


class WrongGrowth(UnivariateGrowth):
    """A model that states a wrong derivative."""

    def observation_jacobian(self, x: Tensor, u: Any) -> Tensor:
        return 0.1001 * x.unsqueeze(-1)


class SlowLorenz(Lorenz63):
    """A model whose maps are overridden without their Jacobians: derivatives are automatic."""

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w)

    def observation(self, x: Tensor, u: Any) -> Any:
        return super().observation(x, u)


def test_a_wrong_jacobian_and_a_missing_one_are_reported() -> None:
    x = torch.linspace(-3.0, 3.0, 8, dtype=torch.float64).view(2, 4, 1)
    model = WrongGrowth(3.0, 1.0, 1.4)
    record = ModelSimulation(model, steps=2).draw(NominalNoise(), torch.arange(2), seed=1).record
    u = prepare_record(model, record).at_step(1).u
    with pytest.raises(AssertionError, match=r"WrongGrowth\.observation_jacobian must be"):
        check_jacobians(model, x, u)
    silent = SlowLorenz()
    silent.noise_gain = lambda u: None  # type: ignore[method-assign]
    with pytest.raises(AssertionError, match="SlowLorenz must state a Jacobian, got none"):
        check_jacobians(silent, x.expand(2, 4, 3), None)


class ScaledNoise(UnivariateGrowth):
    """A model whose noise gain is off by a factor, or whose noise is not additive."""

    def __init__(self, factor: float, square: float) -> None:
        super().__init__(3.0, 1.0, 1.4)
        self.factor, self.square = factor, square

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return super().propagate(x, u, w + self.square * w * w)

    def noise_gain(self, u: Any) -> Tensor:
        return self.factor * super().noise_gain(u)


@pytest.mark.parametrize(("factor", "square"), [(1.001, 0.0), (-1.0, 0.0), (1.0, 1e-3)])
def test_a_wrong_noise_gain_is_refused_by_the_check_and_by_every_filter(
    factor: float, square: float
) -> None:
    right = ScaledNoise(1.0, 0.0)
    draw = ModelSimulation(right, steps=2).draw
    record = draw(NominalNoise(), torch.arange(2), seed=1).record
    u = prepare_record(right, record).at_step(1).u
    x = torch.linspace(-3.0, 3.0, 8, dtype=torch.float64).view(2, 4, 1)
    assert check_jacobians(right, x, u)["noise_gain"] < 1e-12
    model, stream = ScaledNoise(factor, square), PhiloxStream(1, torch.arange(2))
    with pytest.raises(AssertionError, match=r"ScaledNoise\.noise_gain must be the derivative"):
        check_jacobians(model, x, u)
    for method in (ParticleFilter(10), GaussianFilter(TaylorLinearisation())):
        run_filter(method, right, record, stream)
        with pytest.raises(ValueError, match=r"ScaledNoise\.noise_gain must be the L of propagate"):
            run_filter(method, model, record, stream)
    right.noise_gain = lambda u: torch.ones(1, 2, 1)  # type: ignore[method-assign, assignment]
    check_refused(
        [
            (
                r"must have shape \[2 or 1, 1, 1\].*got \[1, 2, 1\]",
                lambda: run_filter(ParticleFilter(10), right, record, stream),
            )
        ],
        remedy=False,
    )


def test_the_noise_gain_of_a_model_that_observes_its_initial_state_is_checked_too() -> None:
    model = ScaledNoise(1.1, 0.0)
    model.observes_initial = True
    record = ModelSimulation(model, steps=2).draw(NominalNoise(), torch.arange(2), seed=1).record
    check_refused(
        [
            (
                "noise_gain must be the L",
                lambda: run_filter(
                    ParticleFilter(10), model, record, PhiloxStream(1, torch.arange(2))
                ),
            )
        ],
        remedy=False,
    )


@pytest.mark.parametrize("iterations", [1, 3])
def test_a_filter_gives_the_same_with_stated_and_automatic_derivatives(iterations: int) -> None:
    runs = torch.arange(3)
    method = GaussianFilter(TaylorLinearisation(), iterations=iterations)
    record = ModelSimulation(Lorenz63(), steps=20).draw(NominalNoise(), runs, seed=2).record
    stated, automatic = (
        run_filter(method, model, record, PhiloxStream(2, runs))
        for model in (Lorenz63(), SlowLorenz())
    )
    for name in ("mean", "variance", "log_evidence"):
        torch.testing.assert_close(
            getattr(stated, name), getattr(automatic, name), rtol=1e-9, atol=1e-9
        )
