"""Inferred noise levels against a dense grid of Kalman likelihoods; calibration by ranks, which the wrong ones fail."""

import json
import math
import runpy
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from checkout import ROOT
from oracles import kalman
from pfbench.experiments.learn_noise_calibration import (
    LEVELS,
    SIGHTS,
    by_pmmh,
    by_svi,
    flight,
    level,
    location,
)
from pfbench.experiments.oracles.nonlinear_rows import INDEX, PUBLISHED
from pyro.distributions import Beta, LogNormal, Normal
from pyro.infer.autoguide import AutoMultivariateNormal
from scipy.stats import chisquare

from pfbench.cli.infer import _build as build
from pfbench.core import PhiloxStream, Record, map_inputs
from pfbench.files import has_valid_digest
from pfbench.filter import (
    ConditionalSmcKernel,
    GaussianFilter,
    ParticleFilter,
    TaylorLinearisation,
    run_filter,
)
from pfbench.job import compose
from pfbench.model import ModelWrapper, StochasticVolatility, local_level
from pfbench.ppl import (
    FilterLikelihood,
    GaussianHmmLikelihood,
    ParameterisedModel,
    ParameterPosterior,
    PmmhSettings,
    SbcRanks,
    latent_program,
    normal_guide,
    nuts,
    particle_gibbs,
    particle_mcmc,
    pmmh,
    program,
    repeat_runs,
    sbc_histograms,
    simulation_based_calibration,
    svi,
)
from pfbench.ppl.ibis_smc2 import Smc2Result, smc2
from pfbench.ppl.inference_job import draw_equally, list_numbers
from pfbench.ppl.model_batch import ModelBatch, list_differences
from pfbench.ppl.priors import prior_by_name

EKF, YEARS = GaussianFilter(TaylorLinearisation()), 12
NILE = ParameterisedModel(
    lambda level_sd, measurement_sd: local_level(level_sd, measurement_sd, 1000.0, 1000.0),
    {"level_sd": LogNormal(3.5, 1.0), "measurement_sd": LogNormal(4.8, 0.5)},
)
LEVEL = ParameterisedModel(
    lambda noise: local_level(noise, 0.7, 0.0, 1.0), {"noise": LogNormal(0.0, 1.0)}
)


@cache
def nile(years: int) -> Record:
    return Record(
        torch.tensor(np.loadtxt(ROOT / "experiments/oracles/nile.csv"))[None, :years, None]
    )


@cache
def grid(years: int) -> tuple[dict[str, tuple[float, float]], float]:
    """Posterior mean and sd of each number by name, log evidence: quadrature in logarithms over Kalman filters of plain NumPy."""
    at, y = [np.linspace(0.0, 7.0, 41), np.linspace(3.4, 6.4, 41)], nile(years).y[0].numpy()
    one, log_p = np.eye(1), np.zeros((41, 41))
    for i, a in enumerate(at[0]):
        for j, b in enumerate(at[1]):
            found = kalman(
                one, one * np.exp(2 * a), one, one * np.exp(2 * b), np.array([1000.0]), one * 1e6, y
            )
            log_p[i, j] = (
                found.log_evidence.sum()
                - 0.5 * ((a - 3.5) / 1.0) ** 2
                - 0.5 * ((b - 4.8) / 0.5) ** 2
            )
    log_p -= np.log(2 * np.pi * 1.0 * 0.5)
    p = np.exp(log_p - log_p.max())
    p /= p.sum()
    found = {}
    for name, values, own in (
        ("level_sd", np.exp(at[0]), p.sum(1)),
        ("measurement_sd", np.exp(at[1]), p.sum(0)),
    ):
        mean = float(own @ values)
        found[name] = mean, float(own @ (values - mean) ** 2) ** 0.5
    cell = (at[0][1] - at[0][0]) * (at[1][1] - at[1][0])
    return found, float(np.logaddexp.reduce(log_p.ravel()) + np.log(cell))


def agrees(table, years: int, ess: float = 0.0, sds: float = 4.5) -> None:
    """Means within Monte Carlo error by the effective number of draws, sds within 30 %; of few draws nothing could be said.

    Without years they are those of volatility. The sd of mu there is of tails that few draws reach.
    """
    for name, (mean, sd) in (grid(years)[0] if years else PUBLISHED).items():
        n = max(ess, float(table.ess[name]))
        assert n > 40, (name, n)
        assert abs(table["mean"][name] - mean) < sds * sd / n**0.5, (
            name,
            table["mean"][name],
            mean,
            sd,
            n,
        )
        assert name == "mu" or 0.7 < table.sd[name] / sd < 1.4, (name, table.sd[name], sd)


def test_what_disagrees_with_the_grid_is_seen() -> None:
    """Draws with the grid's moments pass; a mean that is off by half an sd, a wrong sd, or too few draws do not."""

    def told(shift: float = 0.0, scale: float = 1.0, draws: int = 200):
        z = torch.randn(4, draws, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
        z = (z - z.mean()) / z.std()
        moments = grid(YEARS)[0].items()
        return ParameterPosterior(
            {name: mean + sd * (shift + scale * z) for name, (mean, sd) in moments}, None, "made"
        ).table()

    agrees(told(), YEARS)
    for wrong in (
        {"shift": 0.5},
        {"shift": -0.5},
        {"scale": 0.6},
        {"scale": 1.5},
        {"draws": 5},
        {"shift": torch.nan},
    ):
        with pytest.raises(AssertionError):
            agrees(told(**wrong), YEARS)


@pytest.mark.slow
def test_particle_marginal_chains_find_the_grid_s_posterior() -> None:
    posterior = pmmh(NILE, ParticleFilter(60), nile(YEARS), draws=20, warmup=30, chains=48, seed=1)
    assert posterior.accepted is not None
    assert 0.1 < float(posterior.accepted.mean()) < 0.6
    agrees(posterior.table(), YEARS)


def test_interrupted_chains_go_on_to_the_same_draws(tmp_path: Path, monkeypatch: Any) -> None:
    """Stopped in the warm-up and among the draws; another call does not take the file."""
    monkeypatch.setattr(particle_mcmc, "_STORE_EVERY", 0.0)

    def run(stop: int | None, file: Path | None = None, draws: int = 8) -> ParameterPosterior:
        def tick(i: int, rate: float) -> None:
            assert 0.0 <= rate <= 1.0
            if i == stop:
                raise KeyboardInterrupt

        settings = PmmhSettings(leaps=1, thin=2, tick=tick, checkpoint=file)
        return pmmh(NILE, EKF, nile(3), draws, 6, chains=3, seed=1, settings=settings)

    for stop in (4, 13):
        with pytest.raises(KeyboardInterrupt):
            run(stop, tmp_path / "chains.pt")
    with pytest.raises(ValueError, match="checkpoint must be of the same call"):
        run(None, tmp_path / "chains.pt", draws=9)
    whole, again = run(None), run(None, tmp_path / "chains.pt")
    for one, other in (
        (whole.draws, again.draws),
        (whole.stats, again.stats),
        ({"": whole.accepted}, {"": again.accepted}),
    ):
        torch.testing.assert_close(dict(one), dict(other), rtol=0, atol=0)


@pytest.mark.slow
@pytest.mark.parametrize("leaps", [0, 3])
def test_metropolis_on_a_kalman_likelihood_finds_it_too(leaps: int) -> None:
    settings = PmmhSettings(leaps=leaps)
    posterior = pmmh(
        NILE, EKF, nile(YEARS), draws=20, warmup=30, chains=48, seed=2, settings=settings
    )
    agrees(posterior.table(), YEARS)
    assert posterior.accepted is not None
    assert 0.1 < float(posterior.accepted.mean()) < 0.9


@pytest.mark.slow
@pytest.mark.parametrize("wrap", [None, ModelWrapper], ids=["of_states", "of_noises"])
def test_chains_of_particle_gibbs_find_it_as_well(wrap: Any) -> None:
    """The wrapped model does not tell how its noise enters: then noises are kept, and ancestors see the whole future."""
    make: Any = (lambda **values: wrap(NILE.make(**values))) if wrap else NILE.make
    unknown, kernel = ParameterisedModel(make, NILE.prior), ConditionalSmcKernel(8)
    found = particle_gibbs(unknown, nile(YEARS), 20, 30, chains=48, seed=1, kernel=kernel)
    assert found.states.shape == (48, 20, 1, YEARS, 1)
    agrees(found.posterior.table(), YEARS, ess=48)


@pytest.mark.slow
def test_no_u_turns_and_variational_laws_find_it() -> None:
    """SVI's law is normal in logarithms, and the posterior nearly so: means to a third of an sd, and the narrower sd."""
    exact = program(NILE, GaussianHmmLikelihood())
    agrees(nuts(exact, nile(YEARS), draws=80, warmup=40, chains=1, seed=3).table(), YEARS)
    for guide in (normal_guide(NILE), AutoMultivariateNormal(exact)):
        found = svi(exact, nile(YEARS), guide, steps=200, draws=300, seed=4)
        assert np.mean(found.losses[-30:]) < np.mean(found.losses[:10])
        assert (
            abs(np.mean(found.losses[-60:]) + grid(YEARS)[1]) < 0.5
        )  # the bound is nearly the evidence
        for name, (mean, sd) in grid(YEARS)[0].items():
            assert abs(found.posterior.table()["mean"][name] - mean) < 0.35 * sd, name


@pytest.mark.slow
def test_no_u_turns_through_an_extended_kalman_filter_and_through_the_path() -> None:
    """One number of a level: the filter's likelihood and the program that samples the noise have one posterior.

    Few measurements and draws, since each gradient costs 20 ms; that both densities are right to the last digits is tested
    without a sampler (test_ppl).
    """
    record = Record(torch.tensor([0.3, 1.9, 3.2], dtype=torch.float64)[None, :, None])
    at = torch.linspace(-5.0, 4.0, 91, dtype=torch.float64)
    likelihood = FilterLikelihood(EKF)(
        LEVEL.models_per_run({"noise": at.exp()})[0], Record(record.y.expand(91, -1, -1))
    )
    p = torch.softmax(likelihood - 0.5 * at**2, 0)
    mean = float(p @ at)
    sd = float(p @ (at - mean) ** 2) ** 0.5
    assert sd < 0.6  # the prior's is 1: a sampler that sees no measurement is seen
    for posterior in (
        nuts(program(LEVEL, FilterLikelihood(EKF)), record, draws=40, warmup=30, chains=1, seed=1),
        nuts(latent_program(LEVEL), record, draws=60, warmup=30, chains=1, seed=1),
    ):
        log_noise = posterior.pooled_draws("noise").log()
        ess = min(float(posterior.table().ess["noise"]), log_noise.numel())
        assert abs(float(log_noise.mean()) - mean) < 4.5 * sd / ess**0.5
        assert 0.6 < float(log_noise.std()) / sd < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("method", "particles"), [(EKF, 400), (ParticleFilter(60), 200)], ids=["ibis", "smc2"]
)
def test_online_learning_ends_in_the_grid_s_posterior(method, particles) -> None:
    found = smc2(NILE, method, nile(YEARS), particles, seed=5)
    moments, evidence = grid(YEARS)
    for name, (mean, sd) in moments.items():
        assert abs(float(found.mean[name][-1]) - mean) < 4.5 * sd / (0.2 * particles) ** 0.5, (
            name
        )  # 1 in 5 counts, at least
        assert 0.6 < float(found.sd[name][-1]) / sd < 1.5
    assert abs(float(found.log_evidence[-1]) - evidence) < 4.5 / (0.2 * particles) ** 0.5
    assert float(found.ess.min()) < 0.5 * particles  # it was resampled
    assert float(found.acceptance[~found.acceptance.isnan()].mean()) > 0.1


def test_moments_of_online_learning_are_those_of_the_weighted_parameters() -> None:
    found = smc2(NILE, EKF, nile(3), 30, seed=5, threshold=0.0)  # never resampled: still its last
    w = found.weights.numpy()
    assert float(found.ess[-1]) == pytest.approx(1.0 / (w**2).sum())
    for name, values in found.values.items():
        mean = np.average(values, weights=w)
        assert float(found.mean[name][-1]) == pytest.approx(mean)
        variance = np.average((values.numpy() - mean) ** 2, weights=w)
        assert float(found.sd[name][-1]) == pytest.approx(variance**0.5)


RUNS, DRAWS = 40, 19


def uniform(ranks: SbcRanks, names: tuple[str, ...]) -> bool:
    """No departure at one in a thousand for each number."""
    return all(ranks.p_value(name, 5) > 1e-3 for name in names)


@pytest.mark.slow
def test_ranks_on_a_toy_are_uniform_and_a_wrong_likelihood_shows() -> None:
    shape, toy = (
        Record(torch.zeros(RUNS, 8, 1, dtype=torch.float64)),
        ParameterisedModel(level, LEVELS),
    )
    believed = ParameterisedModel(lambda **values: level(**values, wrong=2.0), LEVELS)
    right = {
        "PMMH": simulation_based_calibration(toy, shape, by_pmmh(toy, 40, 57, 30), DRAWS, seed=7),
        "SVI": simulation_based_calibration(
            toy, shape, by_svi(toy, GaussianHmmLikelihood(), 60), DRAWS, seed=7
        ),
    }
    wrong = simulation_based_calibration(toy, shape, by_pmmh(believed, 40, 57, 30), DRAWS, seed=7)
    for name, ranks in right.items():
        assert uniform(ranks, toy.names), (name, ranks)
    assert not uniform(wrong, toy.names), wrong  # by SVI on passive location
    assert len(sbc_histograms(right, 5).axes) == 4


@pytest.mark.slow
def test_ranks_on_passive_location_are_uniform_and_a_wrong_likelihood_shows() -> None:
    far, shape = ParameterisedModel(location, SIGHTS), flight(RUNS, 5)
    believed = ParameterisedModel(lambda **values: location(**values, wrong=2.0), SIGHTS)
    assert uniform(
        simulation_based_calibration(far, shape, by_pmmh(far, 300, 38, 25), DRAWS, seed=8),
        far.names,
    )
    likelihood = FilterLikelihood(EKF)
    assert uniform(
        simulation_based_calibration(far, shape, by_svi(far, likelihood, 30), DRAWS, seed=8),
        far.names,
    )
    assert not uniform(
        simulation_based_calibration(far, shape, by_svi(believed, likelihood, 30), DRAWS, seed=8),
        far.names,
    )


def test_ranks_are_told_apart() -> None:
    ramp = torch.arange(100) % 20
    even, odd = SbcRanks({"a": ramp}, 19), SbcRanks({"a": ramp.clamp(max=9)}, 19)
    assert even.p_value("a", 10) == 1.0
    assert odd.p_value("a", 10) < 1e-6
    assert even.counts("a", 5).tolist() == [20] * 5
    with pytest.raises(ValueError, match="bins must divide 20"):
        even.counts("a", 7)


def test_the_page_has_the_table_of_the_stored_calibration() -> None:
    """Of the script that made it; draws of the exact posterior pass there, and the planted fault is seen at one in a hundred."""
    path = ROOT / "experiments" / "analyses" / "calibration.json"
    stored, script = json.loads(path.read_text()), runpy.run_path(str(path.with_suffix(".py")))
    assert has_valid_digest(stored)
    assert (
        script["write_table"](stored["done"])
        in (ROOT / "docs" / "parameter_inference.md").read_text()
    )
    exact, planted = (
        [chisquare(counts).pvalue for counts in stored["done"][case]["counts"].values()]
        for case in ("local level, exact grid", f"local level, {script['PLANTED']}")
    )
    assert min(exact) > 0.05 > 0.01 > max(planted)


VOLATILITY = ParameterisedModel(
    StochasticVolatility,
    {
        "rho": prior_by_name("rho", {"beta": [20, 1.5], "on": [-1, 1]}),
        "mu": prior_by_name("mu", {"cauchy": [0, 5]}),
        "sigma": torch.distributions.HalfCauchy(torch.tensor(2.0, dtype=torch.float64)),
    },
)


def on_grid(model: Any, record: Record) -> torch.Tensor:
    """Log likelihood by sums over an even grid of the standardised log volatility. It has a gradient, that of an EKF none."""
    u = torch.linspace(-6.5, 6.5, 81, dtype=torch.float64)
    sd = (1.0 - model.rho.square()).sqrt()
    step = torch.softmax(-0.5 * ((u[:, None] - model.rho * u) / sd).square(), 0)
    x = model.mu + model.sigma / sd * u
    logs = -0.5 * (x + record.y[0].square() * torch.exp(-x) + math.log(2 * math.pi))
    tops = logs.amax(-1, keepdim=True).detach()
    p, totals = torch.softmax(-0.5 * u.square(), 0), []
    for likelihood in (logs - tops).exp().unbind(0):
        joint = p * likelihood
        totals.append(joint.sum())
        p = step @ (joint / totals[-1])
    return (torch.stack(totals).log().sum() + tops.sum())[None]


def _equal(result: Smc2Result) -> ParameterPosterior:
    return draw_equally(result.values, result.weights, "SMC2")


WIDE = {"rho": Beta(18.0, 2.0), "mu": Normal(8.0, 1.5), "sigma": LogNormal(-0.7, 0.5)}
FITS: dict[str, Callable[[], ParameterPosterior]] = {
    "few": lambda: _equal(smc2(VOLATILITY, ParticleFilter(60), INDEX, 100, seed=1)),
    "smc2": lambda: _equal(smc2(VOLATILITY, ParticleFilter(100), INDEX, 400, seed=1)),
    "pmmh": lambda: pmmh(VOLATILITY, ParticleFilter(100), INDEX, 100, 60, 64, 1, PmmhSettings(start=WIDE)),
    "nuts": lambda: nuts(program(VOLATILITY, on_grid), INDEX, draws=300, warmup=120, chains=1, seed=1),
    "svi": lambda: svi(
        program(VOLATILITY, on_grid), INDEX, normal_guide(VOLATILITY), steps=800, draws=100, rate=0.15
    ).posterior,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("method", FITS)
def test_three_numbers_of_volatility_have_their_published_posterior(method: str) -> None:
    """One of them on (-1, 1), one of either sign; SVI's law of mu is narrower than its tails."""
    agrees(FITS[method]().table(), 0)


WORLDS = {  # of models whose name no scenario has
    "azimuth_small": "azimuth_small", "gps_ins": "gps_ins", "ins_gnss": "flight_300s", "ins_gnss18": "flight_500s",
    "ins_gnss_inflated": "flight_300s", "passive_location": "passive_1", "raw_gnss": "user_raw_log",
    "sins_gnss_tight": "anshun_uav", "sins_gnss_tight_nl": "anshun_nl", "sins_gps_azimuth": "azimuth",
    "sins_gps_azimuth15": "azimuth", "sins_sar": "sar_flight", "strapdown_aided": "recorded_fixed_wing_aided",
    "strapdown_blocks": "recorded_car_constrained", "strapdown_tight": "recorded_walk",
    "strapdown_total": "recorded_car_drive", "urban_gnss": "recorded_berlin", "urban_gnss_mixture": "recorded_berlin",
}  # fmt: skip
MODELS = sorted(path.stem for path in (ROOT / "conf" / "model").glob("*.yaml"))
SIMULATED = [n for n in MODELS if "recorded" not in WORLDS.get(n, "") and n != "raw_gnss"]
OF_THE_SCENARIO = ("gyro_bias_deg_s[", "accelerometer_bias[", "receiver.mask_deg")  # its inputs
NO_REAL_NUMBERS = ("terrain.waves", "terrain.seed")
STEPS = 4


def read_numbers(name: str) -> tuple[dict, dict[str, torch.Tensor]]:
    """Return the configuration of a model, and each number of it changed by 5 %."""
    values = compose([f"model={name}", f"scenario={WORLDS.get(name, name)}"]).values
    numbers = {
        key: torch.tensor(0.95 * value if value else 1e-3, dtype=torch.float64)
        for key, value in list_numbers(values["model"]).items()
        if key not in NO_REAL_NUMBERS
    }
    return values, numbers


def draw_steps(values: dict) -> Record:
    """Draw the first steps of a run of a simulated world."""
    episode = build(values["scenario"]).draw(build(values["noise"]), torch.arange(1), 1)
    return episode.record._replace(
        y=episode.record.y[:, :STEPS].double(), u=map_inputs(lambda a: a[:, :STEPS], episode.record.u)
    )  # fmt: skip


@pytest.mark.parametrize("name", MODELS)
def test_the_likelihood_moves_with_each_number(name: str) -> None:
    """Of a few steps by a particle filter, where the world is simulated; of recorded ones the model, for which data are needed."""
    values, numbers = read_numbers(name)
    models = {"": build(values["model"])}
    models |= {key: build(values["model"], **{key: number}) for key, number in numbers.items()}
    first = models[""]
    fixed = [key for key, model in models.items() if not list_differences(first, model)]
    assert [key for key in fixed[1:] if not any(part in key for part in OF_THE_SCENARIO)] == []
    kept = {key: model for key, model in models.items() if key not in fixed[1:]}
    assert len(kept) > 2
    if name not in SIMULATED:
        return
    record = draw_steps(values)
    stream = PhiloxStream(1, torch.zeros(len(kept), dtype=torch.long))
    batch, runs = ModelBatch(list(kept.values())), repeat_runs(record, len(kept))
    log_likelihood = run_filter(ParticleFilter(20), batch, runs, stream).log_evidence
    assert bool(torch.isfinite(log_likelihood).all())
    still = zip(kept, log_likelihood == log_likelihood[0], strict=True)
    assert [key for key, is_still in still if is_still] == [""]


PLAIN = {
    "lorenz63": ("step",),
    "pendulum": ("step",),
}  # of the design: compiled loops take them as plain numbers
FINE = (
    "terrain.shortest_m",
    "terrain.longest_m",
)  # larger steps of them turn far waves by many radians


@pytest.mark.parametrize("name", SIMULATED)
def test_the_gradient_of_the_likelihood_is_its_central_difference(name: str) -> None:
    """By the EKF, for each number of a model: to 1e-6, or to rounding. Attitude errors start at zero, and noise gains are singular."""
    values, numbers = read_numbers(name)
    record = draw_steps(values)

    def evidence(changed: dict[str, torch.Tensor]) -> torch.Tensor:
        return FilterLikelihood(EKF)(build(values["model"], **(numbers | changed)), record).sum()

    free = {
        key: number.clone().requires_grad_()
        for key, number in numbers.items()
        if key not in PLAIN.get(name, ())
    }
    found = torch.autograd.grad(evidence(free), list(free.values()), materialize_grads=True)
    for key, gradient in zip(free, found, strict=True):
        h = (1e-6 if key in FINE else 1e-4) * numbers[key].abs()
        a, b, c, d = (float(evidence({key: numbers[key] + k * h})) for k in (1, -1, 2, -2))
        slope = (8.0 * (a - b) - (c - d)) / (12.0 * float(h))
        assert float(gradient) == pytest.approx(slope, rel=1e-6, abs=2e-14 * abs(a) / float(h)), key
