"""Every filter of conf/: on every world of conf/, with empty slots, with what is not seen, and as exact as it says."""

import math
import re
from collections import Counter
from dataclasses import dataclass, field, is_dataclass, replace
from functools import cache
from typing import Any

import pytest
import torch
import yaml
from config_cases import GROUPS, RECORDED, composed, list_bases, truncated, world
from filter_cases import EACH, NAMES, ON_ANY_MODEL, SLOTS, TEXTS, method_of, refusal
from model_cases import tracker
from particle_cases import HARD
from recorded_data import DATA
from torch import Tensor

from pfbench import job
from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    CountLimits,
    EssStepCount,
    LookAheadWeights,
    ParticleFilter,
    SwarmProposal,
    loop,
)
from pfbench.filter.belief import ParticleBelief, StepInfo
from pfbench.filter.exactness import has_bounded_weights, has_covariance
from pfbench.filter.input_check import check_model
from pfbench.filter.loop import prepare_record, run_filter
from pfbench.job.scoring import ScoreRecorder
from pfbench.model import LinearGaussian, StateSpaceModel
from pfbench.noise.base import NominalNoise
from pfbench.results.paper_block import read_paper_block, read_part
from pfbench.scenario.simulated import ModelSimulation
from pfbench.testing import (
    check_bounded_weights,
    check_causality,
    check_evidence,
    check_independence,
    filter_record,
    reference_moments,
)

pytestmark = pytest.mark.filterwarnings("ignore:ParticleGuideProposal")  # it says that it is dear

RUNS, STEPS = torch.arange(2), 3
CHANGING = EssStepCount(6, 0.6, CountLimits(12, SLOTS, 20))


def is_particle_filter(name: str) -> bool:
    """Whether a filter, or the one that it changes, is composed of the stages of a particle filter."""
    entry = yaml.safe_load(TEXTS[name])
    bases = [base for base in entry.get("defaults", ()) if isinstance(base, str) and base in TEXTS]
    return entry.get("_target_", "") == "pfbench.filter.ParticleFilter" or any(map(is_particle_filter, bases))  # fmt: skip


PARTICLES = [name for name in NAMES if is_particle_filter(name)]
FIXED_NUMBER = ("sqmc", "guided_start")  # refuse a number that changes, or have points for one
EXACT_EACH = tuple(name for name in EACH if not name.endswith("_printed"))
SELDOM_RESAMPLED = (
    "pso_pf_literal",
    "cpso_escape_literal",
    "rpf_tuned",
)  # so that their number stays
MOVED = ("mcmc_tail", "mcmc_bridge", "mcmc_rpf_printed", "mcmc_rpf_literal")
EXACT = (
    *("sir", "sir_printed", "sir_literal", "apf", "sqmc", "rbpf"), *("ckf_pf", "ekf_pf", "ukf_pf"), *MOVED,
    *("dmc_density", "dmc_noise", "dmc_optimal"), "guided_start", *EXACT_EACH,
)  # fmt: skip


REFUSING = {
    "bounded errors": ("rbpf",),
    "bounded noise": ("rbpf", "dmc_density", *MOVED, *EXACT_EACH),
    "two modes": ("rbpf",),
}
UNBOUNDED = ("cofm_amssrcpf", "cofm_amssrcpf_printed", "cofm_amssrcpf_tuned", "cpf", "fmcpf", *EACH)


# on every world


def some_steps(name: str, model: StateSpaceModel, record: Record) -> None:
    method = method_of(name)
    if isinstance(
        proposal := getattr(method, "proposal", None), SwarmProposal
    ):  # 30 iterations would take a third of the time
        method = replace(method, proposal=replace(proposal, iterations=4))
    groups = torch.tensor([[0, 1], [1, 0]]) if model.chart.dimension > 1 else torch.tensor([[0]])

    def cut(t: int, info: StepInfo) -> dict[str, torch.Tensor]:
        if not info.has_covariance:
            return {}
        wanted = info.covariance()[:, groups.unsqueeze(-1), groups.unsqueeze(-2)]
        scale = info.variance[:, :2].amax()
        assert ((info.covariance_of(groups) - wanted).abs() <= 1e-9 * scale).all(), name
        return {}

    with torch.no_grad():
        estimate = run_filter(method, model, record, PhiloxStream(1, RUNS), cut)
    assert not bool(estimate.lost.any()), name
    assert bool(torch.isfinite(estimate.mean).all()), name
    assert bool((estimate.variance >= 0).all()) == has_covariance(method), name


# one of each model, with and without feedback: test_configs runs the others with their default filter
WORLDS = (
    *("linear_walk", "local_level", "benes", "growth", "lorenz63", "pendulum"),
    *("lorenz63_twin", "lorenz96_twin", "double_pendulum_twin"),
    *("stochastic_volatility", "passive_1", "gps_ins", "flight_500s", "sar_flight", "anshun_fit"),
    *("anshun_nl", "azimuth", "azimuth_closed_loop", "azimuth_small", "flight_300s_closed_loop"),
    *(
        "recorded_berlin",
        "recorded_car_drive",
        "recorded_car_constrained",
        "recorded_fixed_wing_aided",
        "recorded_walk",
        "recorded_canyon",
        "gps_ins_inflated",
        "terrain",
        "user_raw_log",
    ),
)


def model_of(scenario: str) -> str:
    """Return the default model of a scenario, as its file or the one it extends names it."""
    text = read_part("scenario", scenario)
    if named := re.search(r"override /model@_global_\.model: (\w+)", text):
        return named[1]
    return model_of(*list_bases("scenario", scenario))


def test_the_worlds_have_every_default_model() -> None:
    assert {model_of(name) for name in WORLDS} == {model_of(name) for name in GROUPS["scenario"]}


@pytest.mark.slow
@pytest.mark.parametrize("part", range(6))
@pytest.mark.parametrize("scenario", WORLDS)
def test_every_filter_runs_on_every_world_or_says_why_not(
    scenario: str, part: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A sixth of the filters. A model of an INS takes two steps, the first and one after it, since each takes 10 to 50 ms."""
    if scenario in RECORDED and DATA is None:
        pytest.skip("PFBENCH_DATA does not name the folder of the recorded data sets")
    model, episode = job.instantiate(composed(f"scenario={scenario}").model), world(scenario)
    record = truncated(episode, STEPS if model.chart.dimension < 9 else 2).record
    # checked once, not at the start of each filter: a fifth of the time
    check_model(model, prepare_record(model, record))
    monkeypatch.setattr(loop, "check_model_once", lambda *_: None)
    for name in NAMES[part::6]:
        why = refusal(name, model, record)
        if not why:
            some_steps(name, model, record)
            continue
        with pytest.raises(ValueError, match=why) as told:
            some_steps(name, model, record)
        assert re.match(r"\w+[\w. =]*(: | must )", str(told.value))  # the key first
        assert re.search(r"; |\. [A-Z]", str(told.value))  # and then the remedy


# empty slots, changing numbers, missing measurements


Y = torch.tensor(
    [[0.8, -1.0], [1.9, math.nan], [math.nan, math.nan], [math.nan, 0.7], [1.6, 0.9]],
    dtype=torch.float64,
)


@pytest.mark.parametrize("name", ON_ANY_MODEL)
def test_missing_measurements_change_nothing_but_what_they_should(name: str) -> None:
    """A sensor that never speaks is as if it were not there."""
    if name in ("cpso_escape", "cpso_escape_tuned"):
        pytest.skip(
            "its swarm flies in all that a model's sensors can see, the same for all runs: other numbers, the same law"
        )
    if name == "raw_fix":
        pytest.skip("it refuses the one sensor, which does not determine two states")
    model, y = tracker(), Y.clone()
    y[:, 1] = torch.nan
    alone = LinearGaussian(model.f, model.g, model.h[:1], model.r[:1], model.m0, model.l0)
    silent, without = (
        filter_record(method_of(name), m, seen, runs=3)
        for m, seen in ((model, y), (alone, y[:, :1]))
    )
    assert not bool(silent.lost.any())
    torch.testing.assert_close(silent.mean, without.mean, rtol=1e-9, atol=1e-9)
    torch.testing.assert_close(silent.variance, without.variance, rtol=1e-7, atol=1e-9)
    torch.testing.assert_close(silent.log_evidence, without.log_evidence, rtol=1e-9, atol=1e-9)


STATED = "where nothing is measured"  # of a filter that does not keep its prediction there


@pytest.mark.parametrize("name", [name for name in ON_ANY_MODEL if name != "raw_fix"])
def test_a_filter_keeps_its_prediction_where_nothing_is_measured_or_says_why_not(name: str) -> None:
    """In two steps after the prior and two after a measured one, of a slow model, whose particles cannot come back.

    Mean and variance are those of the linear prediction within 4.5 standard errors over the runs, and 3 / N of a cloud.
    """
    h, f = [[1.0, 0.0], [0.3, 1.0]], [[1.0, 0.5], [0.0, 0.9]]
    slow = LinearGaussian(
        f, [[0.1, 0.0], [0.03, 0.08]], h, [1.0, 0.8], [0.3, -0.2], initial_sd=[1.5, 1.0]
    )
    y = torch.full((40, 6, 2), math.nan, dtype=torch.float64)
    y[:, 2] = 0.5 + PhiloxStream(8, torch.arange(40)).normal("y", 1, 2)[:, 0]
    method, kept = method_of(name), [(slow.m0, slow.l0 @ slow.l0.mT, None)]
    n = 60 if name == "cpso_escape" else 200  # its time grows by N^2
    if hasattr(method, "particles"):
        method = replace(method, particles=n)

    def watch(t: int, info: StepInfo) -> dict[str, Tensor]:
        kept.append((info.mean, info.covariance(), info.cloud))
        if (
            info.cloud
        ):  # it is scored in place of the covariance: 5 standard errors of draws of each particle
            deviation, log_w = info.cloud()
            spread = (log_w.softmax(1).unsqueeze(-1) * deviation.square()).sum(1).mean(0)
            torch.testing.assert_close(spread, info.variance.mean(0), rtol=0.08, atol=0.0)
        return {}

    filter_record(method, slow, y, watch=watch)
    keeps = []
    for t in (0, 1, 4, 5):  # step 3 resamples by the measurement
        (mean, before, _), (found, after, cloud) = kept[t], kept[t + 1]
        wanted = slow.f @ before @ slow.f.mT + slow.g @ slow.g.mT
        scale = wanted.diagonal(dim1=-2, dim2=-1).expand(40, -1).mean(0)
        wide, share = (after - wanted).diagonal(dim1=-2, dim2=-1) / scale, 0 if cloud is None else 3 / n  # fmt: skip
        for d, least in (((found - mean @ slow.f.mT) / scale.sqrt(), 0.0), (wide, share)):
            keeps.append(bool((d.mean(0).abs() <= 4.5 * d.std(0) / 40**0.5 + least + 1e-6).all()))
    completions = read_paper_block("filter", name).get("completions", ())
    assert all(keeps) == (STATED not in " ".join(entry["why"] for entry in completions)), keeps


@cache
def calibration(name: str) -> tuple[Tensor, Tensor]:
    """Shares of the truth in intervals of 90 % and CRPS of a filter on a linear model, [R] each."""
    model, method, runs = tracker(), method_of(name), torch.arange(150)
    if hasattr(method, "particles"):
        method = replace(method, particles=200)
    episode = ModelSimulation(model, 5).draw(NominalNoise(), runs, 3)
    recorder = ScoreRecorder(model, model.assemble(episode.truth), 5)
    run_filter(method, model, episode.record, PhiloxStream(4, runs), recorder)
    pit, crps = recorder.arrays()["pit"], recorder.arrays()["crps"]
    return ((pit - 0.5).abs() < 0.45).double().mean((1, 2)), crps.mean((1, 2))


@pytest.mark.parametrize("name", [*EXACT, "ukf", "ekf_bank", "ekf_bank_dense"])
def test_scores_of_an_exact_filter_are_those_of_the_kalman_filter(name: str) -> None:
    """On a linear model, within 4.5 standard errors over the runs, and 3 / N of a cloud."""
    for found, wanted in zip(calibration(name), calibration("ekf"), strict=True):
        apart = found - wanted
        assert apart.mean().abs() < 4.5 * apart.std() / 150**0.5 + 3 / 200


@dataclass(frozen=True, eq=False)
class CountingStream(PhiloxStream):
    """A stream that writes down the step and the purpose of all that is drawn."""

    counts: Counter[tuple[int, str]] = field(default_factory=Counter)

    def _counter(self, purpose: str, n: int, w: int) -> Any:
        self.counts[int(self.step), purpose] += 1
        return super()._counter(purpose, n, w)


@pytest.mark.parametrize("name", ON_ANY_MODEL)
def test_random_numbers_are_used_once(name: str) -> None:
    """No two draws of one step have the same purpose: they would be the same numbers."""
    draws, record = CountingStream(1, torch.arange(4)), Record(Y.expand(4, -1, -1))
    with torch.no_grad():
        run_filter(method_of(name), tracker(), record, draws)
    if (
        name == "rbpf"
    ):  # draws the sampled components instead of the whole state, by the same numbers
        assert draws.counts.pop((0, "initial")) == 2
    assert {key: n for key, n in draws.counts.items() if n > 1} == {}


@pytest.mark.parametrize(
    "name", [name for name in PARTICLES if name not in ("guided_start", *SELDOM_RESAMPLED)]
)
def test_nothing_is_known_of_what_lies_in_empty_slots(name: str) -> None:
    model, method = tracker(), replace(method_of(name), particle_count=CHANGING)
    draws, record = PhiloxStream(1, torch.arange(4)), Record(Y.expand(4, -1, -1))
    belief, numbers = method.init(model, 4, draws.at_step(0)), set()
    for t in range(len(Y)):
        numbers |= set((belief.log_w > -torch.inf).sum(1).tolist())
        other, told = method.step(model, rubbish(belief), record.at_step(t), draws.at_step(t + 1))
        belief, info = method.step(model, belief, record.at_step(t), draws.at_step(t + 1))
        for one, two in (
            (info.mean, told.mean),
            (info.variance, told.variance),
            (belief.log_evidence, other.log_evidence),
        ):
            assert bool(torch.isfinite(one).all())
            torch.testing.assert_close(one, two, rtol=1e-10, atol=1e-12)
    assert len(numbers) > 1
    assert min(numbers) >= 12


def rubbish(belief: ParticleBelief) -> ParticleBelief:
    """The same, with other numbers where there are no particles."""
    empty = belief.log_w == -torch.inf

    def soiled(a: Tensor) -> Tensor:
        if a.shape[1] != empty.shape[1] or not a.is_floating_point():
            return a
        return torch.where(empty.reshape(*empty.shape, *[1] * (a.dim() - 2)), 0.37, a)

    keep = {"swarm.chaos"}  # it belongs to slots, not to particles
    window = {key: soiled(a) for key, a in belief.window.items()}
    memory = {key: a if key in keep else soiled(a) for key, a in belief.memory.items()}
    return belief._replace(x=soiled(belief.x), window=window, memory=memory)


def test_the_default_of_the_class_is_sir() -> None:
    configured, default = method_of("sir"), ParticleFilter(100)
    assert configured.resampler.ess_threshold == default.resampler.ess_threshold
    for part in ("resampler", "proposal", "weight_update", "moves"):
        assert type(getattr(configured, part)) is type(getattr(default, part))
    assert type(configured.resampler.scheme) is type(default.resampler.scheme)


def test_which_filters_say_that_they_are_exact() -> None:
    """Particle methods whose cloud tends to the posterior on any model; a Gaussian filter is so on linear ones alone."""
    assert {name for name in NAMES if method_of(name).is_exact} == set(EXACT)
    assert {name for name in NAMES if isinstance(method_of(name), ParticleFilter)} == set(PARTICLES)


@pytest.mark.parametrize("name", EXACT)
def test_filters_that_say_so_are_unbiased_with_any_number_and_what_is_missing(name: str) -> None:
    method = method_of(name)
    if isinstance(method, ParticleFilter) and name not in FIXED_NUMBER:
        method = replace(method, particle_count=CHANGING)
    model = tracker()
    check_evidence(
        method, model, Y, reference_moments(model, Y), runs=400
    ) if name != "rbpf" else check_kalman(method, model)


@cache
def hard_case(case: str) -> Any:
    return HARD[case]()


@pytest.mark.parametrize("case", HARD)
@pytest.mark.parametrize("name", EXACT)
def test_filters_that_say_so_are_unbiased_where_support_or_modes_are_hard(
    name: str, case: str
) -> None:
    """Errors or noise of bounded support, and y = x^2 / 20, against a grid; or a refusal in words."""
    if name in EACH and case == "two modes":
        pytest.skip("weights without a bound: each guide finds one mode, few particles the other")
    model, y, exact = hard_case(case)
    method = method_of(name)
    if name in REFUSING[case]:
        with pytest.raises(ValueError, match=r" must .*\. [A-Z]"):
            filter_record(method, model, y)
        return
    check_evidence(replace(method, particles=200), model, y, exact, runs=400)


@pytest.mark.parametrize("name", PARTICLES)
def test_weights_are_bounded_where_a_filter_says_so(name: str) -> None:
    """Exactly where: an adversary finds a ratio of more than e^20 in each of the others."""
    method = method_of(name)
    assert has_bounded_weights(method) == (name not in UNBOUNDED)
    if name in UNBOUNDED:
        with pytest.raises(AssertionError, match=r"got e\^[1-9][0-9]"):
            check_bounded_weights(method)
    elif name != "cpso_escape":  # N^2 kernels: 5 s, for the mixture of `dmc_reconstructed`
        check_bounded_weights(method)


PUBLISHED = {
    "apf": lambda m: replace(m, auxiliary_weights=LookAheadWeights(defensive_fraction=0.0)),
    **{
        name: lambda m: replace(m, proposal=replace(m.proposal, defensive_fraction=0.0))
        for name in ("ekf_pf", "ukf_pf", "ckf_pf", "dmc_optimal", "dmc_noise")
    },
}


@pytest.mark.parametrize("name", PUBLISHED)
def test_a_published_form_without_a_share_of_the_model_states_no_bound(name: str) -> None:
    method = PUBLISHED[name](method_of(name))
    assert not has_bounded_weights(method)
    assert method.is_exact == name.endswith("_pf")  # normal noise of a guide is everywhere
    with pytest.raises(AssertionError, match=r"ratios are bounded: .* got e\^[1-9][0-9]"):
        check_bounded_weights(method)


def test_the_published_auxiliary_filter_converges_to_a_wrong_answer_with_bounded_errors() -> None:
    """What the default form is held to above fails for the published one, with any number."""
    model, y, exact = hard_case("bounded errors")
    method = replace(PUBLISHED["apf"](method_of("apf")), particles=2000)
    z = filter_record(method, model, y, runs=50).log_evidence - exact.log_evidence
    assert float(z.exp().mean()) < 0.95


@pytest.mark.parametrize("name", ON_ANY_MODEL)
def test_no_filter_uses_the_future_or_other_runs(name: str) -> None:
    y = Y[:4].nan_to_num(0.4) + PhiloxStream(8, torch.arange(3)).normal("y", 4, 2)
    y[:, 1:3, 1] = torch.nan
    check_causality(method_of(name), tracker(), y)
    check_independence(method_of(name), tracker(), y, tolerance=1e-8)


GUIDES = ("guide_filter", "perturbation")  # parts that a ratio corrects, whatever they do


def parts_of(node: Any, path: str = "filter") -> dict[str, Any]:
    """Every part of a filter's recipe that states whether it is exact, by its key."""
    parts = {path: node.is_exact} if isinstance(getattr(node, "is_exact", None), bool) else {}
    for key, value in vars(node).items() if is_dataclass(node) else ():
        for i, child in enumerate(value if isinstance(value, tuple | list) else [value]):
            if is_dataclass(child) and key not in GUIDES:
                parts |= parts_of(child, f"{path}.{key}[{i}]")
    return parts


@pytest.mark.parametrize("name", PARTICLES)
def test_a_filter_is_exact_if_all_its_parts_are(name: str) -> None:
    parts = parts_of(method_of(name))
    for key in (
        "resampler",
        "particle_count",
        "auxiliary_weights",
        "proposal",
        "weight_update",
        "points",
    ):
        assert f"filter.{key}[0]" in parts
    inner = {key: value for key, value in parts.items() if key != "filter"}
    assert parts["filter"] == all(inner.values()), inner


def check_kalman(method: Any, model: LinearGaussian) -> None:
    """On a linear model nothing is left to sample."""
    estimate, exact = filter_record(method, model, Y, runs=2), reference_moments(model, Y)
    torch.testing.assert_close(
        estimate.log_evidence, torch.full((2,), exact.log_evidence, dtype=torch.float64)
    )
    torch.testing.assert_close(estimate.mean[:, -1], torch.tensor(exact.mean).expand(2, -1))
