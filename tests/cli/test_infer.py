"""`pfbench infer`: posteriors of a linear model against a grid of exact likelihoods, and sentences for what is not valid."""

import json
import re
import shlex
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import synthetic_log
import torch
import yaml
from checkout import ROOT
from command_line import pfbench as command
from scipy.stats import beta, halfcauchy

from pfbench.job import compose, instantiate
from pfbench.model.textbook import StochasticVolatility
from pfbench.ppl import ParameterisedModel, inference_job, nuts
from pfbench.ppl.inference_job import make_priors
from pfbench.ppl.priors import find_range

PARAMETERS = "parameters={level_sd:[10,100]}"
WORLD = ("model=local_level", PARAMETERS, "scenario.steps=25", "study=s")
SETTINGS = {
    "svi": ("infer.steps=200", "infer.draws=500"),
    "smc2": ("infer.values=150",),
    "pmmh": (
        "infer.draws=60",
        "infer.warmup=60",
        "infer.chains=6",
        "particles=5",
        "infer.look_ahead=1",
    ),
    "nuts": ("infer.draws=40", "infer.warmup=40", "infer.chains=2", "cores=2"),
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
    assert ("log evidence" in said.out) == (method == "smc2")


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


@pytest.mark.slow
def test_ranks_of_a_right_method_are_uniform_and_of_too_few_values_are_not(tmp_path: Path) -> None:
    """The first by chi-square at one in a thousand; with 2 values, 19 draws are 2 numbers and ranks are in few bins."""
    p = []
    for values in ("infer.values=150", "infer.values=2"):
        said = command(
            "infer", "model=local_level", "parameters={measurement_sd:[20,500]}", "scenario.steps=12", "method=smc2", "calibrate=60",
            values, home=tmp_path,
        )  # fmt: skip
        assert said.code == 0, said.err
        counts, last = re.findall(r"measurement_sd \| ([\d ]+) \| (\S+)", said.out)[0]
        assert sum(map(int, counts.split())) == 60
        p.append(float(last))
    assert p[0] > 1e-3 > 1e-6 > p[1]


def test_finished_chains_of_an_interrupted_inference_are_not_drawn_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The second of three chains is interrupted once; what it says of its progress is on standard error."""
    drawn: list[int] = []
    monkeypatch.setattr(inference_job, "_SILENCE", -1.0)

    def draw(*args: Any, first_chain: int, **settings: Any) -> Any:
        drawn.append(first_chain)
        if drawn == [0, 1]:
            raise OSError("killed")
        return nuts(*args, first_chain=first_chain, **settings)

    monkeypatch.setattr(inference_job, "nuts", draw)
    words = ("infer", *WORLD, "method=nuts", "infer.draws=4", "infer.warmup=2", "infer.chains=3")
    assert command(*words, home=tmp_path).code != 0
    said = command(*words, home=tmp_path)
    assert said.code == 0, said.err
    assert drawn == [0, 1, 1, 2]
    assert re.search(
        r"nuts, 1 chains from 3 on: 6 of 6 steps, \d+% accepted, 0.0 min left", said.err
    )
    (path,) = (tmp_path / "results" / "s" / "inference").iterdir()
    draws = np.array(json.loads(path.read_text())["posterior"]["draws"]["level_sd"])
    assert draws.shape == (3, 4)
    assert len(np.unique(draws[:, -1])) == 3


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        (("model=local_level", "method=nuts", PARAMETERS, "filter=sir"), "method=nuts must have a likelihood with a gradient, got a filter of particles, ParticleFilter"),
        (("model=local_level", "method=svi", PARAMETERS, "particles=50"), "particles must be left out for method=svi, a Kalman filter, got 50"),
        (("model=local_level", "method=pmmh", PARAMETERS, "infer.look_ahead=-1"), "infer.look_ahead must be"),
        (("model=local_level", "method=pmmh", PARAMETERS, "infer.draws=2.5"), "infer.draws must be a whole number of at least 1, got 2.5"),
        (("model=terrain", "method=pmmh", "parameters={terrain.seed:[1,3]}"), "parameters.terrain.seed must be a number that the model accepts near its value"),
        (("model=local_level", "method=nuts", PARAMETERS, "cores=0"), "cores must be a whole number of at least 1, got 0. Default: cores=1."),
        (("method=nuts", PARAMETERS), "model must be set. Use: pfbench infer model=NAME"),
        (("model=local_level", PARAMETERS), "method must be set"),
        (("model=local_level", "method=nut", PARAMETERS), "method must be one of noise, nuts, pmmh, smc2, svi, got nut. Similar: nuts."),
        (("model=local_level", "method=nuts"), "parameters must name at least one unknown key of the model, got none. Choose from level_sd"),
        (("model=local_level", "method=nuts", "parameters={levle_sd:[1,2]}"), "parameters must name numbers of the model, got levle_sd. Choose from level_sd"),
        (("model=local_level", "method=nuts", "parameters={level_sd:[5,2]}"), "parameters.level_sd must be two positive numbers"),
        (("model=ins_gnss", "method=nuts", PARAMETERS), "scenario must be set for model=ins_gnss, got none of its name. Add scenario=NAME, also for a scenario of your own"),
        (("model=local_level", "method=smc2", PARAMETERS, "calibrate=3"), "calibrate must be a whole number of at least 20, got 3. Use calibrate=100."),
        (("model=local_level", "method=smc2", PARAMETERS, "calibrate=x"), "calibrate must be a whole number of at least 20, got 'x'"),
        (("model=local_level", "method=smc2", PARAMETERS, "calibrate=40", "runs=2"), "runs must be 1 for calibrate"),
        (("scenario=local_level", "method=noise", PARAMETERS, "calibrate=40"), "calibrate must have a method with named parameters, got method=noise. Use one of nuts, svi, pmmh, smc2."),
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


def volatility(node: Any = None, /, **changed: Any) -> StochasticVolatility:
    return StochasticVolatility(**({"mu": -1.0, "rho": 0.95, "sigma": 0.3} | changed))


NODE = {"mu": -1.0, "rho": 0.95, "sigma": 0.3, "_target_": "here", "of": {"sd": [0.1, 2]}}
PRIORS: dict[str, tuple[str, Any, tuple[float, float]]] = {  # law of SciPy, and the ends of its quantiles
    "positive": ("sigma", [0.1, 1], (0.1, 1.0)),
    "bounded": ("rho", [0.5, 0.99], (0.5, 0.99)),
    "free": ("mu", [-3, 2], (-3.0, 2.0)),
    "beta": ("rho", {"beta": [20, 1.5], "on": [-1, 1]}, tuple(beta(20, 1.5, -1, 2).ppf([0.05, 0.95]))),
    "half Cauchy": ("sigma", {"half_cauchy": 2}, tuple(halfcauchy(0, 2).ppf([0.05, 0.95]))),
    "YAML": ("rho", {"uniform": [0, 1], True: [-1, 1]}, (-0.9, 0.9)),
}  # fmt: skip


@pytest.mark.parametrize("case", PRIORS)
def test_a_prior_has_the_stated_quantiles_and_ends(case: str) -> None:
    """Of its draws, and of its density over the whole line; SciPy has the quantiles of named ones."""
    name, words, ends = PRIORS[case]
    unknown = ParameterisedModel(volatility, make_priors({name: words}, NODE, volatility))
    draws = unknown.sample(1500, 1)[name].numpy()
    shares = [(draws < end).mean() for end in ends]
    assert shares == pytest.approx([0.05, 0.95], abs=4.5 * np.sqrt(0.05 * 0.95 / 1500))
    z = torch.linspace(-40.0, 40.0, 20001, dtype=torch.float64)[:, None]
    values, log_density = unknown.constrained(z)
    for end, share in zip(ends, (0.05, 0.95), strict=True):
        below = log_density.exp()[values[name] < end].sum() * float(z[1] - z[0])
        assert float(below) == pytest.approx(share, abs=1e-3)


@pytest.mark.parametrize(
    ("parameters", "sentence"),
    [
        ({"rho": [0.5, 1]}, r"rho must be two increasing numbers in \(-1, 1\), .* got \[0.5, 1\]. Set parameters.rho=\[0.45,0.975\]"),
        ({"mu": [2, 1]}, r"mu must be two increasing numbers, the"),
        ({"of.sd[2]": [1, 2]}, r"got of.sd\[2\]. Choose from mu, rho, sigma, of.sd\[0\], of.sd\[1\]"),
        ({"rho": {"bta": [1, 2]}}, r"rho must name one distribution of pyro.distributions, got \['bta'\]"),
        ({"rho": {"beta": [1, -2]}}, r"rho.beta must be a scalar distribution of Pyro with its numbers \(Expected parameter"),
        ({"rho": {"beta": 1}}, r"rho.beta must be .* missing 1 required"),
        ({"rho": {"normal": [0, 1], "on": [-1, 1]}}, r"rho.on must be two increasing numbers, for a distribution on \[0, 1\]"),
    ],
)  # fmt: skip
def test_a_wrong_prior_is_answered_by_a_sentence(parameters: Any, sentence: str) -> None:
    with pytest.raises(ValueError, match=sentence):
        make_priors(parameters, NODE, volatility)


def test_ends_of_numbers_are_those_that_models_check() -> None:
    """Of the constructors, by trial: nothing else states them."""
    for words, value, ends in (
        (lambda v: v > 0, 1e-6, (0.0, np.inf)),
        (lambda v: -90 <= v <= 90, 45.0, (-90.0, 90.0)),
        (lambda v: v > -1, 0.0, (-1.0, np.inf)),
        (lambda v: 0 < v < 1, 0.5, (0.0, 1.0)),
        (lambda v: 5 < v < 10, 7.0, (5.0, 10.0)),
        (lambda v: True, -3.0, (-np.inf, np.inf)),
    ):
        assert find_range(words, value) == ends


def test_the_page_shows_commands_that_run(tmp_path: Path) -> None:
    """The commands of the page, with fewer values; the table has only priors that are made."""
    page = (ROOT / "docs" / "parameter_inference.md").read_text()
    commands = re.findall(r"^pfbench infer (model=.*)$", page, re.MULTILINE)
    assert len(commands) == 2
    for words in commands:
        few = ("scenario.steps=10", "infer.values=8", "particles=20")
        said = command("infer", *shlex.split(words), *few, home=tmp_path)
        assert said.code == 0, said.err
    rows = re.findall(r"^\| `([\[{].*)` \|", page, re.MULTILINE)
    assert len(rows) == 5
    for name, row in zip(("sigma", "rho", "mu", "sigma", "rho"), rows, strict=True):
        make_priors({name: yaml.safe_load(row)}, NODE, volatility)


def test_draws_that_a_model_refuses_are_no_errors_and_a_blind_filter_is_refused(
    tmp_path: Path,
) -> None:
    """A third of the prior of rho is beyond 1; the likelihood of an EKF does not depend on rho."""
    words = ("infer", "model=stochastic_volatility", "scenario.steps=5", "study=s")
    prior = "parameters={rho:{normal:[0.9,0.25]}}"
    few = ("infer.draws=10", "infer.warmup=5", "infer.chains=8", "particles=20")
    said = command(*words, "method=pmmh", prior, *few, home=tmp_path)
    assert said.code == 0, said.err
    (path,) = (tmp_path / "results" / "s" / "inference").glob("*.json")
    draws = np.array(json.loads(path.read_text())["posterior"]["draws"]["rho"])
    assert np.abs(draws).max() < 1.0
    said = command(*words, "method=nuts", prior, *few[:2], "infer.chains=1", home=tmp_path)
    assert "whose rho has none with this filter" in said.err


FEW = ("infer.draws=200", "infer.rounds=2", "study=s")


def write_log(folder: Path, late: float = 0.0) -> str:
    """Write 60 s of a drive with a noisy IMU, fixes of 0.5 and 0.8 m each second that are late; return its words."""
    tables, rng = synthetic_log.tables(60.0), np.random.default_rng(3)
    imu, gnss = tables["imu"], tables["gnss"].iloc[::5].drop(columns=["vn", "ve", "vd"])
    imu[["wx", "wy", "wz"]] += 0.01 * rng.standard_normal((len(imu), 3))
    imu[["fx", "fy", "fz"]] += 0.2 * rng.standard_normal((len(imu), 3))
    gnss["t"] += late
    gnss[["pn", "pe", "pd"]] += rng.standard_normal((len(gnss), 3)) * [0.5, 0.5, 0.8]
    synthetic_log.write(folder / "drive", {**tables, "gnss": gnss})
    return f"scenario=user_log data.root={folder} scenario.folder=drive"


def test_numbers_of_a_log_become_a_scenario_of_other_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Fixes of 0.5 and 0.8 m that are 0.3 s late: the next run reads numbers and delay from the file, by its name."""
    monkeypatch.chdir(tmp_path)
    words = write_log(tmp_path, late=0.3)
    said = command("infer", *shlex.split(words), *FEW, "infer.rounds=6", "name=my_drive", home=tmp_path)  # fmt: skip
    assert said.code == 0, said.err
    (path,) = (tmp_path / "results" / "s" / "inference").glob("noise_*.json")
    assert path.with_suffix(".svg").is_file()
    content = json.loads(path.read_text())
    rows = content["rows"]
    assert rows["position_horizontal"]["low"] < 0.5 < rows["position_horizontal"]["high"] * 1.3
    assert rows["delay"]["value"] == pytest.approx(0.3, abs=0.1)
    assert all(word in said.out for word in ("not identified", "second half", "Pareto k", "NIS/dim"))  # fmt: skip
    assert content["scores"]["inferred"]["log score"] > content["scores"]["scenario"]["log score"]
    values = compose(["scenario=my_drive", "scenario.folder=drive", f"data.root={tmp_path}", "hydra.searchpath=[file://conf]"]).values  # fmt: skip
    tuning = values["scenario"]["tuning"]
    assert tuning["gyro_density"] == rows["gyro_density"]["value"] == values["model"]["tuning"]["gyro_density"]  # fmt: skip
    assert tuning["position_sd"] == [rows[f"position_{axis}"]["value"] for axis in ("horizontal", "horizontal", "vertical")]  # fmt: skip
    assert values["scenario"]["corrections"]["shift_s"] == {"gnss": rows["delay"]["value"]}
    place = (f"data.root={tmp_path}", "scenario.folder=drive")
    assert f"Use: pfbench run scenario=my_drive {' '.join(place)}" in said.out
    ran = command("run", "scenario=my_drive", *place, "filter=ekf", "runs=2", "study=s", home=tmp_path)  # fmt: skip
    assert ran.code == 0, ran.err
    again = command("infer", *shlex.split(words), *FEW, "infer.rounds=6", "name=my_drive", home=tmp_path)  # fmt: skip
    assert again.out == said.out


@pytest.mark.parametrize(
    ("words", "sentence"),
    [
        ("scenario.end_s=20", "the log must have at least 40 fixes, half of them to check the numbers, got 20"),
        ("particles=100", "particles must be left out for method=noise, a Kalman filter, got 100. Leave it out, or use method=pmmh."),
        ("filter=sir", "filter must be ekf for method=noise"),
        ("method=noise parameters={velocity_vertical:[1,2]}", "parameters must name noise numbers that change the fixes of this log, got velocity_vertical. Choose from gyro_density"),
        ("method=noise parameters={delay:[2,1]}", "parameters.delay must be two increasing numbers"),
        ("infer.sheet.gyro_deg_s=-1", "infer.sheet.gyro_deg_s must be"),
        ("infer.rounds=0", "infer.rounds must be"),
        ("runs=2", "runs must be 1 for a log, whose runs have the motion and the IMU in common, got 2"),
        ("model=strapdown_blocks", "model must be strapdown_total for method=noise, got strapdown_blocks"),
        ("name=user_log", "name must be that of a new file, or of one that this command wrote, got user_log"),
    ],
)  # fmt: skip
def test_what_is_not_valid_is_answered_by_a_sentence(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, words: str, sentence: str
) -> None:
    monkeypatch.chdir(tmp_path)
    said = command("infer", *shlex.split(write_log(tmp_path)), *FEW, *words.split(), home=tmp_path)
    assert said.code == 2
    assert sentence in said.err
    assert "Traceback" not in said.err
    assert not (tmp_path / "conf").exists()
