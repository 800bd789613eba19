"""Every yaml of conf/ and experiments/ says what it is, composes, lies where its class lies, and runs five steps."""

import math
import re
from collections.abc import Iterator
from functools import cache
from typing import Any

import pytest
import torch
from config_cases import (
    CONF,
    GROUPS,
    RECORDED,
    RUNS,
    SEED,
    STEPS,
    composed,
    world,
)
from filter_cases import NEEDS_ATTITUDE, UNPRINTED, method_of
from hydra.core.hydra_config import HydraConfig
from omegaconf import OmegaConf, open_dict
from recorded_data import DATA

from pfbench import job
from pfbench.cli.compose import read_description
from pfbench.core import Episode, MeasurementChannels, PhiloxStream
from pfbench.filter import FilterResult, GaussianFilter, run_filter
from pfbench.filter.exactness import has_covariance
from pfbench.job.config import compose_tree, expand_filter_names, list_groups
from pfbench.job.scoring import ScoreRecorder
from pfbench.job.tuned_knobs import select_knobs
from pfbench.model.base import StateSpaceModel
from pfbench.results.paper_block import read_part
from pfbench.results.store import compute_config_key

TEXTS = {
    f"{group}/{name}": read_part(group, name)
    for group, names in list_groups().items()
    for name in names
}
ALONE = [
    CONF / "config.yaml",
    *(CONF / "reading").glob("*.yaml"),
    *(CONF / "hydra").rglob("*.yaml"),
]
TEXTS |= {f"{file.relative_to(CONF)}": file.read_text() for file in ALONE}
EXPERIMENTS = list_groups()["experiment"]


def targets(node: Any) -> Iterator[str]:
    if isinstance(node, dict):
        yield from ([node["_target_"]] if "_target_" in node else [])
        node = list(node.values())
    if isinstance(node, list):
        for part in node:
            yield from targets(part)


def raw(text: str) -> dict[str, Any]:
    read = OmegaConf.to_container(OmegaConf.create(text), resolve=False)
    assert isinstance(read, dict)
    return {str(key): value for key, value in read.items()}


# what is written


def has_description(text: str) -> bool:
    """Return whether a text begins with a comment of one sentence, which `pfbench list` prints."""
    first, *rest = [line for line in text.splitlines() if not line.startswith("# @package")]
    is_sentence = first.rstrip()[-1] in ".]?)" or "pfbench run" in first
    is_listed = read_description(text) == first.removeprefix("# ").strip()
    return (
        first.startswith("# ")
        and 10 < len(first) <= 130
        and is_sentence
        and is_listed
        and bool(rest)
    )


def lies_in_the_folder_of_its_class(group: str, text: str) -> bool:
    content = raw(text)
    if "_target_" not in content:  # it builds on another yaml of its group
        based = [part for part in content["defaults"] if isinstance(part, str) and part != "_self_"]
        return len(based) == 1 and based[0] in GROUPS[group]
    folder = {"train": "learn"}.get(group, group)
    stages = targets(content) if folder == "filter" else [content["_target_"]]
    return all(target.startswith(f"pfbench.{folder}.") for target in stages)


def names_a_local_path(text: str) -> bool:
    text = re.sub(r"override /\S+", "", text)
    return re.search(r"(^|[\s'\"\[=])(~/|/[a-z]+/|[A-Z]:)", text, re.M) is not None


def test_yaml_files_follow_the_rules() -> None:
    assert len(TEXTS) > 300
    assert [name for name, text in TEXTS.items() if not has_description(text)] == []
    grouped = {name: name.partition("/")[0] for name in TEXTS}
    assert [
        n
        for n, g in grouped.items()
        if g in GROUPS and not lies_in_the_folder_of_its_class(g, TEXTS[n])
    ] == []
    assert [name for name, text in TEXTS.items() if names_a_local_path(text)] == []


def test_the_rules_for_yaml_files_find_faults() -> None:
    text = "_target_: pfbench.filter.Systematic\n"
    assert not has_description(text)
    assert not lies_in_the_folder_of_its_class("noise", text)
    assert all(map(names_a_local_path, ("root: /home/me/data", "root: ~/data", "root: 'C:/data'")))


# what runs


@cache
def five_steps(scenario: str, method: str = "", model: str = "") -> FilterResult:
    """Of a filter, which takes nothing from the scene but `particles`, by its default model or another."""
    chosen = composed(f"scenario={scenario}", *([f"model={model}"] if model else []))
    own = method_of(method) if method else job.instantiate(chosen["filter"])
    return five_steps_of(job.instantiate(chosen["model"]), own, world(scenario))


def five_steps_of(model: StateSpaceModel, method: Any, episode: Episode) -> FilterResult:
    """They run, and what the judge calls an error is what lies between estimate and truth."""
    truth = model.assemble(episode.truth)
    ticks: list[int] = []
    estimate = run_filter(
        method,
        model,
        episode.record,
        PhiloxStream(SEED, RUNS),
        ScoreRecorder(model, truth),
        lambda: ticks.append(1),
    )
    assert len(ticks) == STEPS
    assert estimate.mean.shape == (2, STEPS, model.chart.size)
    assert estimate.variance.shape == (2, STEPS, len(model.names))
    assert len(model.units) == len(model.names)
    assert not estimate.lost.any()
    assert torch.isfinite(estimate.mean).all()
    if has_covariance(method):  # 0 where a constant is left with one ancestor
        assert (estimate.variance >= 0).all()
    else:
        assert estimate.variance.isnan().all()
        assert estimate.trace["nees"].isnan().all()
    assert estimate.trace["error"].shape == estimate.variance.shape
    assert estimate.trace["nees"].shape == (2, STEPS, len(model.groups))
    seen = truth.isfinite().all((0, 1))
    assert seen.any()
    apart = torch.stack([model.error(estimate.mean[:, t], truth[:, t]) for t in range(STEPS)], 1)
    torch.testing.assert_close(estimate.trace["error"], apart, rtol=0, atol=0, equal_nan=True)
    return estimate


def test_recorded_scenarios_are_told_from_the_others() -> None:
    assert {"recorded_car_drive", "recorded_quad_flights", "user_log"} <= set(RECORDED)
    assert {"flight_300s", "flight_500s", "linear_walk"} <= set(GROUPS["scenario"]) - set(RECORDED)


@pytest.mark.parametrize("scenario", GROUPS["scenario"])
def test_every_scenario_runs_with_the_default_filter(scenario: str) -> None:
    if scenario in RECORDED and DATA is None:
        pytest.skip("PFBENCH_DATA does not name the folder of the recorded data sets")
    if scenario.startswith("user_"):
        pytest.skip("it is the user's log: scenario.folder says which")
    first, second = five_steps(scenario).mean
    assert not torch.equal(first, second)  # runs have their own errors and particles


@pytest.mark.filterwarnings("ignore:ParticleGuideProposal")
@pytest.mark.parametrize(
    "method", [m for m in GROUPS["filter"] if m not in (*NEEDS_ATTITUDE, *UNPRINTED)]
)
def test_every_filter_runs(method: str) -> None:
    """Gaussian filters that leave noise and gain alone are the Kalman filter on a linear model, whatever their rule.

    `tests/filter/test_every_filter.py` runs the filters in other worlds.
    """
    found, built = five_steps("linear_walk", method), method_of(method)
    if isinstance(built, GaussianFilter) and built.plain:
        kalman = five_steps("linear_walk", "ekf")
        for ours, theirs in ((found.mean, kalman.mean), (found.variance, kalman.variance)):
            torch.testing.assert_close(ours, theirs, rtol=1e-9, atol=1e-9)
        torch.testing.assert_close(found.log_evidence, kalman.log_evidence, rtol=1e-9, atol=1e-9)


HOMES = {
    "strapdown_total": ["recorded_car_drive"],
    "strapdown_blocks": ["recorded_car_constrained"],
    "strapdown_aided": ["recorded_fixed_wing_aided"],
    "strapdown_tight": ["recorded_walk"],
    "raw_gnss": ["user_raw_log"],
    "passive_location": ["passive_1"],
    "sins_gnss_tight": ["anshun_fit"],
    "sins_gnss_tight_nl": ["anshun_nl"],
    "sins_gps_azimuth": ["azimuth"],
    "sins_gps_azimuth15": ["azimuth"],
    "sins_sar": ["sar_flight"],
    "gps_ins": ["gps_ins"],
    "urban_gnss": ["recorded_berlin"],
    "urban_gnss_mixture": ["recorded_berlin"],
}


def homes(model: str) -> list[str]:
    """Scenarios that have what a model needs."""
    if model.startswith("ins_gnss"):
        return ["flight_300s", "flight_500s"]
    return HOMES.get(model, [model])


@pytest.mark.parametrize("model", GROUPS["model"])
def test_every_model_runs(model: str) -> None:
    for scenario in homes(model):
        if scenario in RECORDED and DATA is None:
            pytest.skip("PFBENCH_DATA does not name the folder of the recorded data sets")
        if (scenario, model) == ("flight_300s", "ins_gnss18"):
            continue  # its sensors have no Markov part
        estimate = five_steps(scenario, "ekf", model)
        assert torch.isfinite(estimate.log_evidence).all()
        is_constant = torch.equal(estimate.mean[:, 0], estimate.mean[:, -1])
        assert is_constant == (model == "stochastic_volatility")  # y is not linear in x


@pytest.mark.parametrize("noise", GROUPS["noise"])
@pytest.mark.parametrize("scenario", ["linear_walk", "flight_300s"])
def test_every_regime_gives_errors(scenario: str, noise: str) -> None:
    if noise == "replay" and DATA is None:
        pytest.skip("PFBENCH_DATA does not name the folder of the recorded data sets")
    cfg = composed(f"scenario={scenario}", f"noise={noise}")
    regime, times = job.instantiate(cfg.noise), torch.arange(1.0, 201.0, dtype=torch.float64)
    errors = regime.draw_errors(
        PhiloxStream(SEED, RUNS),
        MeasurementChannels(torch.ones(3, dtype=torch.float64), ("position",) * 3, (0, 0, 0)),
        times,
    )
    assert errors.shape == (2, 200, 3)
    assert torch.isfinite(errors).any()


# what composes


@pytest.mark.parametrize("experiment", EXPERIMENTS)
def test_the_choices_of_every_experiment_compose(experiment: str) -> None:
    """All values are composed, but of filters and regimes, which test_every_filter composes, only the first and the last."""
    content = raw(TEXTS[f"experiment/{experiment}"])
    # `pfbench report` finds what +experiment=NAME made; NAME_5000 adds jobs to the study NAME
    study = content.get(
        "study", content["defaults"][0]
    )  # an experiment of a few changes has that of its base
    assert study in [name for name in EXPERIMENTS if experiment.startswith(name)]
    swept = {
        key: expand_filter_names(str(values)).split(",")
        for base in (raw(TEXTS[f"experiment/{study}"]), content)
        for key, values in base["hydra"]["sweeper"]["params"].items()
    }
    assert math.prod(map(len, swept.values())) > 1
    for key in swept.keys() & GROUPS.keys():
        assert set(swept[key]) <= set(GROUPS[key])
        assert len(set(swept[key])) == len(swept[key])
    number = max([1, *(len(swept[key]) for key in swept.keys() - {"filter", "noise"})])
    cells, names = {*range(number), max(map(len, swept.values())) - 1}, set()
    for k in cells:
        cell = [f"{key}={values[k % len(values)]}" for key, values in swept.items()]
        cfg = compose_tree([f"+experiment={experiment}", *cell, "data.root=somewhere"])
        HydraConfig.instance().set_config(cfg)  # an experiment may look up what was chosen
        select_knobs(cfg, cfg.hydra.runtime.choices, ())
        with open_dict(cfg):
            del cfg["hydra"]
        config: Any = OmegaConf.to_container(cfg, resolve=True)
        names.add(compute_config_key(config, job.IGNORED_IN_KEY))
        job.instantiate(cfg["filter"])
        job.instantiate(cfg.model)
    assert len(names) == len(cells)  # a choice that reached no job would make two cells one


def test_a_scenario_may_bring_its_noise_and_another_can_be_asked_for() -> None:
    """Whatever the order of the words; without a word for it all other scenarios have nominal noise."""
    home, bursts, outliers = "scenario=home_002_bursts", "noise=paper_bursts", "noise=outliers"
    assert composed(home).noise == composed(bursts).noise != composed().noise
    assert (
        composed(home, outliers).noise == composed(outliers, home).noise == composed(outliers).noise
    )
    homes = {name: composed(f"scenario={name}").noise for name in GROUPS["scenario"]}
    assert {n for n, noise in homes.items() if noise != composed().noise} == {
        "home_002_bursts", "home_004_outliers",
    }  # fmt: skip
    scenarios = [OmegaConf.to_container(composed(f"scenario={n}").scenario) for n in ("home_002_bursts", "anshun_short")]  # fmt: skip
    assert {**scenarios[0], "paper": ""} == {**scenarios[1], "paper": ""}  # type: ignore[dict-item]


def test_the_scenario_brings_its_model_and_another_can_be_asked_for() -> None:
    assert composed("scenario=flight_500s").model.markov is True
    assert composed("scenario=flight_300s").model.markov is False
    assert composed("scenario=linear_walk").model._target_.endswith("linear_walk")
    chosen = composed("model=ins_gnss_inflated", "scenario=flight_500s")
    assert chosen.model.inflation._target_.endswith("Inflation")
    assert (
        chosen.model.imu == chosen.scenario.imu
    )  # numbers of the scenario, whatever the order of the words
