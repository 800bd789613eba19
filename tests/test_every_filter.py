"""Every filter of conf/: on every world of conf/, with empty slots, with what is not seen, and as exact as it says."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from functools import cache
from typing import Any

import pytest
import torch
from hydra import compose, initialize_config_dir
from recorded_data import DATA
from test_configs import CONF, GROUPS, RECORDED, composed, truncated, world
from test_particle_filters import check_unbiased, kalman, run
from torch import Tensor

from pfbench import job
from pfbench.draws import MonteCarlo
from pfbench.filter.belief import Cloud, Info
from pfbench.filter.loop import run_filter
from pfbench.filter.particle import ParticleFilter
from pfbench.filter.sizes import Bounds, EssStep
from pfbench.filter.swarm import Swarm
from pfbench.model.base import StateSpaceModel
from pfbench.model.linear import LinearGaussian
from pfbench.record import Record

SLOTS, RUNS, STEPS = 30, torch.arange(2), 3
CHANGING = EssStep(6, 0.6, Bounds(12, SLOTS, 20))
TEXTS = {file.stem: file.read_text() for file in sorted((CONF / "filter").glob("*.yaml"))}
NAMES = [name for name in TEXTS if not name.startswith("neural_")]  # those want a trained network
BASED = ("cpso_escape_stopped", "cpso_pf", "dmc_density", "dmc_noise", "dmc_optimal", "fmcpf")  # on another of these
PARTICLES = [name for name in NAMES if "filter.particle.ParticleFilter" in TEXTS[name] or name in BASED]
EXACT = (
    *("sir", "apf", "sqmc", "rbpf"), *("ckf_pf", "ekf_pf", "ukf_pf"), *("mcmc_tail", "mcmc_bridge", "mcmc_rpf_printed"),
    *("dmc_density", "dmc_noise", "dmc_optimal"),
)  # fmt: skip


@cache
def method_of(name: str) -> Any:
    with initialize_config_dir(str(CONF), version_base="1.3"):  # the filter alone, which takes a third of the time
        return job.build(compose(f"filter/{name}", [f"+particles={SLOTS}", "+checkpoint=untrained"])["filter"])


# on every world


DENSE = ("mcmc_bridge", "mcmc_rpf_printed", "mcmc_tail")
REMEMBERING = ("cofm_amssrcpf", "cofm_amssrcpf_printed", "cpf", "fmcpf")


def refusal(name: str, model: StateSpaceModel, record: Record) -> str:
    """What a filter says, as a pattern, of a model or world that it cannot work with; nothing of all others."""
    x, first = model.origin.expand(2, 1, -1), model.prepare(record).at(0)
    if name in DENSE and model.transition(x, first.u) is None:
        return "density of x_t given x_t-1"
    if name == "dmc_density" and model.noise_gain(first.u) is None:
        return "not additive"
    if name == "rbpf" and not (model.linear or model.linear_given):
        return "no component that is linear given the rest"
    if record.loop is not None and (method_past(name) or name == "rbpf"):
        return "corrected INS"
    return ""


def method_past(name: str) -> bool:
    """Does it carry anything of its particles' past?"""
    return bool(getattr(method_of(name), "moves", ())) or name.startswith(("cpso", "pso")) or name in REMEMBERING


def three_steps(name: str, model: StateSpaceModel, record: Record) -> None:
    method = method_of(name)
    if isinstance(proposal := getattr(method, "proposal", None), Swarm):  # 30 iterations would take a third of the time
        method = replace(method, proposal=replace(proposal, iterations=4))
    groups = torch.tensor([[0, 1], [1, 0]]) if model.chart.dimension > 1 else torch.tensor([[0]])

    def cut(t: int, info: Info) -> dict[str, torch.Tensor]:
        wanted = info.covariance()[:, groups.unsqueeze(-1), groups.unsqueeze(-2)]
        scale = info.variance[:, :2].amax()
        assert ((info.covariance_of(groups) - wanted).abs() <= 1e-9 * scale).all(), name
        return {}

    with torch.no_grad():
        estimate = run_filter(method, model, record, MonteCarlo(1, RUNS), cut)
    assert not bool(estimate.lost.any()), name
    assert bool(torch.isfinite(estimate.mean).all()), name
    assert bool((estimate.variance >= 0).all()), name


@pytest.mark.slow
@pytest.mark.parametrize("scenario", GROUPS["scenario"])
def test_every_filter_runs_on_every_world_or_says_why_not(scenario: str) -> None:
    if scenario in RECORDED and DATA is None:
        pytest.skip("PFBENCH_DATA does not name the folder of the recorded data sets")
    if scenario == "own_log":
        pytest.skip("it is the user's log: scenario.folder says which")
    model, episode = job.build(composed(f"scenario={scenario}").model), world(scenario)
    record = truncated(episode, STEPS).record
    for name in NAMES:
        why = refusal(name, model, record)
        if not why:
            three_steps(name, model, record)
            continue
        with pytest.raises(ValueError, match=why) as told:
            three_steps(name, model, record)
        assert re.match(r"\w+[\w. =]*: ", str(told.value))  # the key first
        assert ";" in str(told.value)  # and then the remedy


# empty slots, changing numbers, missing measurements


def tracker() -> LinearGaussian:
    """Two states, each driven, two sensors."""
    h = [[1.0, 0.0], [0.3, 1.0]]
    return LinearGaussian([[1.0, 0.5], [0.0, 0.9]], [[0.6, 0.0], [0.2, 0.5]], h, [1.0, 0.8], [0.3, -0.2], [1.5, 1.0])


Y = torch.tensor(
    [[0.8, -1.0], [1.9, math.nan], [math.nan, math.nan], [math.nan, 0.7], [1.6, 0.9]], dtype=torch.float64
)


@pytest.mark.parametrize("name", NAMES)
def test_missing_measurements_change_nothing_but_what_they_should(name: str) -> None:
    """A sensor that never speaks is as if it were not there."""
    if name == "cpso_escape":
        pytest.skip("its swarm flies in all that a model's sensors can see, the same for all runs: other numbers, the same law")
    model, y = tracker(), Y.clone()
    y[:, 1] = torch.nan
    alone = LinearGaussian(model.f, model.g, model.h[:1], model.r[:1], model.m0, model.l0)
    silent, without = (run(method_of(name), m, seen, runs=3) for m, seen in ((model, y), (alone, y[:, :1])))
    assert not bool(silent.lost.any())
    torch.testing.assert_close(silent.mean, without.mean, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(silent.variance, without.variance, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(silent.log_evidence, without.log_evidence, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("name", PARTICLES)
def test_nothing_is_known_of_what_lies_in_empty_slots(name: str) -> None:
    model, method = tracker(), replace(method_of(name), size=CHANGING)
    draws, record = MonteCarlo(1, torch.arange(4)), Record(Y.expand(4, -1, -1))
    belief, numbers = method.init(model, 4, draws.at(0)), set()
    for t in range(len(Y)):
        numbers |= set((belief.log_w > -torch.inf).sum(1).tolist())
        other, told = method.step(model, rubbish(belief), record.at(t), draws.at(t + 1))
        belief, info = method.step(model, belief, record.at(t), draws.at(t + 1))
        for one, two in ((info.mean, told.mean), (info.variance, told.variance), (belief.log_z, other.log_z)):
            assert bool(torch.isfinite(one).all())
            torch.testing.assert_close(one, two, rtol=1e-10, atol=1e-12)
    assert len(numbers) > 1
    assert min(numbers) >= 12


def rubbish(cloud: Cloud) -> Cloud:
    """The same, with other numbers where there are no particles."""
    empty = cloud.log_w == -torch.inf

    def soiled(a: Tensor) -> Tensor:
        if a.shape[1] != empty.shape[1] or not a.is_floating_point():
            return a
        return torch.where(empty.reshape(*empty.shape, *[1] * (a.dim() - 2)), 0.37, a)

    keep = {"swarm.chaos"}  # it belongs to slots, not to particles
    window = {key: soiled(a) for key, a in cloud.window.items()}
    memory = {key: a if key in keep else soiled(a) for key, a in cloud.memory.items()}
    return cloud._replace(x=soiled(cloud.x), window=window, memory=memory)


def test_which_filters_say_that_they_are_exact() -> None:
    """Particle methods whose cloud tends to the posterior on any model; a Gaussian filter is so on linear ones alone."""
    assert {name for name in NAMES if method_of(name).exact} == set(EXACT)
    assert {name for name in NAMES if isinstance(method_of(name), ParticleFilter)} == set(PARTICLES)


@pytest.mark.parametrize("name", EXACT)
def test_filters_that_say_so_are_unbiased_with_any_number_and_what_is_missing(name: str) -> None:
    method = method_of(name)
    if isinstance(method, ParticleFilter) and name != "sqmc":
        method = replace(method, size=CHANGING)
    model = tracker()
    check_unbiased(method, model, Y, kalman(model, Y), runs=400) if name != "rbpf" else check_kalman(method, model)


def check_kalman(method: Any, model: LinearGaussian) -> None:
    """On a linear model nothing is left to sample."""
    estimate, exact = run(method, model, Y, runs=2), kalman(model, Y)
    torch.testing.assert_close(estimate.log_evidence, torch.full((2,), exact.log_z, dtype=torch.float64))
    torch.testing.assert_close(estimate.mean[:, -1], torch.tensor(exact.mean).expand(2, -1))
