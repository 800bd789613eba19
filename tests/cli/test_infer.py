"""`pfbench infer`: posteriors of a linear model against a grid of exact likelihoods, and sentences for what is not valid."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
import torch
from checkout import ROOT
from command_line import pfbench as command
from pyro.distributions import LogNormal

from pfbench.job import compose, instantiate
from pfbench.ppl.inference_job import make_priors

PARAMETERS = "parameters={level_sd:[10,100]}"
WORLD = ("model=local_level", PARAMETERS, "scenario.steps=25", "study=s")
SETTINGS = {
    "svi": ("infer.steps=200", "infer.draws=500"),
    "smc2": ("infer.values=150",),
    "pmmh": ("infer.draws=60", "infer.warmup=60", "infer.chains=6", "particles=60"),
    "nuts": ("infer.draws=80", "infer.warmup=40", "infer.chains=1"),
}


def exact_posterior() -> tuple[float, float]:
    """Mean and standard deviation of log level_sd: a grid of exact likelihoods of a Kalman filter in plain NumPy."""
    words = ["scenario=local_level", "scenario.steps=25", "runs=1"]
    values = compose(words).values
    scenario, noise = instantiate(values["scenario"]), instantiate(values["noise"])
    y = scenario.draw(noise, torch.arange(1), values["seed"]).record.y[0].numpy()
    node = values["model"]
    grid = np.linspace(np.log(2.0), np.log(300.0), 300)
    loc, scale = (np.log(10) + np.log(100)) / 2, np.log(10) / (2 * 1.6448536)
    logs = np.array([
        log_evidence(y, np.exp(g), node) - 0.5 * ((g - loc) / scale) ** 2 for g in grid
    ])  # fmt: skip
    p = np.exp(logs - logs.max())
    p /= p.sum()
    mean = float((p * grid).sum())
    return mean, float(np.sqrt((p * (grid - mean) ** 2).sum()))


def log_evidence(y: np.ndarray, level_sd: float, node: dict) -> float:
    """Log likelihood of the local level model."""
    mean, variance, total = node["initial_mean"], node["initial_sd"] ** 2, 0.0
    for value in y[:, 0]:
        variance += level_sd**2
        s = variance + node["measurement_sd"] ** 2
        total += -0.5 * (np.log(2 * np.pi * s) + (value - mean) ** 2 / s)
        gain = variance / s
        mean, variance = mean + gain * (value - mean), (1 - gain) * variance
    return total


@pytest.mark.slow
@pytest.mark.parametrize("method", list(SETTINGS))
def test_the_posterior_is_that_of_a_grid_of_exact_likelihoods(tmp_path: Path, method: str) -> None:
    """Mean of log level_sd within four standard errors of the draws, a tenth of the deviation for the normal guide."""
    said = command("infer", *WORLD, f"method={method}", *SETTINGS[method], home=tmp_path)
    assert said.code == 0, said.err
    (path,) = (tmp_path / "results" / "s" / "inference").glob(f"{method}_*.json")
    content = json.loads(path.read_text())
    draws = np.log(np.array(content["posterior"]["draws"]["level_sd"])).ravel()
    mean, sd = exact_posterior()
    ess = min(content["table"]["level_sd"]["ess"], content.get("ess", np.inf), len(draws))
    assert abs(draws.mean() - mean) < 4 * sd / np.sqrt(ess) + 0.15 * sd * (method == "svi")
    assert draws.std() == pytest.approx(sd, rel=4 / np.sqrt(2 * ess) + 0.15 * (method == "svi"))
    assert content["truth"] == {"level_sd": 38.33}
    assert re.search(r"level_sd .* 38\.33", said.out)


@pytest.mark.slow
def test_a_finished_inference_is_not_computed_again_and_another_prior_is_another(
    tmp_path: Path,
) -> None:
    words = ("infer", "method=smc2", *WORLD[:1], *WORLD[2:], "infer.values=10")
    first = command(*words, PARAMETERS, home=tmp_path)
    assert first.code == 0, first.err
    folder = tmp_path / "results" / "s" / "inference"
    (path,) = folder.glob("*.json")
    changed = path.stat().st_mtime_ns
    assert command(*words, PARAMETERS, home=tmp_path).out == first.out
    assert path.stat().st_mtime_ns == changed
    assert command(*words, "parameters={level_sd:[20,100]}", home=tmp_path).code == 0
    assert len(list(folder.glob("*.json"))) == 2


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("method=nuts", PARAMETERS), "model must be set. Use: pfbench infer model=NAME"),
        (("model=local_level", PARAMETERS), "method must be set"),
        (("model=local_level", "method=nut", PARAMETERS), "method must be one of nuts, pmmh, smc2, svi, got nut. Similar: nuts."),
        (("model=local_level", "method=nuts"), "parameters must name at least one unknown key of the model, got none. Choose from level_sd"),
        (("model=local_level", "method=nuts", "parameters={levle_sd:[1,2]}"), "parameters must name numbers of the model, got levle_sd. Choose from level_sd"),
        (("model=local_level", "method=nuts", "parameters={level_sd:[5,2]}"), "parameters.level_sd must be two positive numbers"),
        (("model=ins_gnss", "method=nuts", PARAMETERS), "scenario must be set for model=ins_gnss"),
        (("-m", "model=local_level", "method=nuts", PARAMETERS), "must be run without -m"),
    ],
)  # fmt: skip
def test_bad_words_are_answered_by_a_sentence(
    tmp_path: Path, words: tuple[str, ...], sentence: str
) -> None:
    said = command("infer", *words, home=tmp_path)
    assert said.code == 2
    assert sentence in said.err
    assert "Traceback" not in said.err
    assert not (tmp_path / "results").exists()


def test_a_prior_has_the_stated_quantiles() -> None:
    prior = make_priors({"level_sd": [10, 100]}, {"level_sd": 38.0})["level_sd"]
    assert isinstance(prior, LogNormal)
    assert prior.cdf(prior.loc.new_tensor(10.0)) == pytest.approx(0.05, abs=1e-6)
    assert prior.cdf(prior.loc.new_tensor(100.0)) == pytest.approx(0.95, abs=1e-6)


def test_the_page_shows_a_command_that_runs(tmp_path: Path) -> None:
    """The first command of the page, with fewer values."""
    page = (ROOT / "docs" / "parameter_inference.md").read_text()
    words = re.search(r"^pfbench infer (model=local_level .*)$", page, re.MULTILINE)
    assert words is not None
    names = [word.strip("'") for word in words[1].split()]
    said = command("infer", *names, "scenario.steps=10", "infer.values=8", home=tmp_path)
    assert said.code == 0, said.err
