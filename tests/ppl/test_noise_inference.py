"""Noise numbers of a log: the batched filter against that of the product, and what its posterior must do."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from heading_cases import tuning, weave
from recorded_data import recorded
from torch import Tensor
from torch.distributions import biject_to

from pfbench.core import PhiloxStream, Record
from pfbench.core.chart import rotation_vector_from_quaternion
from pfbench.filter import GaussianFilter, TaylorLinearisation
from pfbench.job import compose, instantiate
from pfbench.model import Constraints, StrapdownBlocks, StrapdownTotal, StrapdownTuning
from pfbench.nav.strapdown import PreintegratedImu, rotate
from pfbench.ppl import FilterLikelihood
from pfbench.ppl.fix_filter import DENSITIES, LEVER, FixFilter
from pfbench.ppl.mixture_sampling import Mixture, NoiseTarget, WeightedDraws, sample_mixture
from pfbench.ppl.noise_posterior import (
    NoiseFit,
    choose_values,
    fit_noise,
    make_noise_priors,
    summarise_noise,
)
from pfbench.ppl.parameterised_model import draw_prior

EKF = FilterLikelihood(GaussianFilter(TaylorLinearisation()))
DELAY = 0.12
VALUES = {
    "gyro_density": [1e-3, 8e-3], "accelerometer_density": [0.02, 0.1], "gyro_bias_walk": [1e-4, 2e-3],
    "accelerometer_bias_walk": [1e-3, 1e-2], "position_horizontal": [1.0, 0.3], "position_vertical": [0.5, 2.0],
}  # fmt: skip
SPEEDS = {"velocity_horizontal": [0.2, 0.1], "velocity_vertical": [0.3, 0.5]}
PLACE = {"lever_right": [0.4, -1.0], "lever_forward": [-1.5, 2.0], "lever_up": [1.0, 0.7]}
NARROW = {  # of the prior of simulated records: medians and factors
    "gyro_density": (3e-3, 3.0), "accelerometer_density": (0.05, 3.0), "gyro_bias_walk": (2e-4, 5.0),
    "accelerometer_bias_walk": (2e-3, 5.0), "position_horizontal": (0.7, 2.0), "position_vertical": (1.0, 2.0),
}  # fmt: skip


def fly(numbers: Mapping[str, Any], runs: int, seconds: float, seed: int = 1) -> Record:
    """Draw weaving flights from the model of the product, each with its numbers, and position fixes each second.

    The antenna is at the lever arm, and the fixes are late: they are those of a moment before, along a straight line.
    """
    full = {key: torch.as_tensor(value).double().expand(runs) for key, value in numbers.items()}
    model, u = StrapdownTotal(tuning(5.0)), weave(seconds)
    model.density = torch.stack([full[key] for key in DENSITIES], -1).repeat_interleave(3, -1)
    draws = PhiloxStream(seed, torch.arange(runs))
    start = model.origin.expand(runs, -1)
    x = model.chart.add(start, draws.normal("start", 1, 15)[:, 0] * model.p0)[:, None]
    sd = torch.stack([full[f"position_{axis}"] for axis in ("horizontal", "horizontal", "vertical")], -1)  # fmt: skip
    lever = torch.stack([full.get(key, 0.0 * sd[:, 0]) for key in LEVER], -1)
    y = torch.full((runs, u.duration.shape[1], 3), torch.nan).double()
    noise, errors = (draws.normal(name, y.shape[1], n) for name, n in (("noise", 12), ("fix", 3)))
    for t in range(y.shape[1]):
        inputs = PreintegratedImu(*(a[:, t] for a in u))
        x = model.propagate(x, inputs, noise[:, t : t + 1])
        if t % 2:
            q, v, p = x[:, 0, :4], x[:, 0, 4:7], x[:, 0, 7:10]
            rate = rotation_vector_from_quaternion(inputs.rotation) / inputs.duration[:, None] - x[:, 0, 10:13]  # fmt: skip
            v = v + rotate(q, torch.linalg.cross(rate, lever))
            late = full.get("delay", torch.zeros(runs))[:, None]
            y[:, t] = p + rotate(q, lever) - late * v + sd * errors[:, t]
    return Record(y, PreintegratedImu(*(a.expand(runs, *a.shape[1:]) for a in u)), start)


def change(base: StrapdownTuning, numbers: Mapping[str, float]) -> StrapdownTuning:
    """Return a tuning with other numbers, by the names of the batched filter."""
    plain: dict[str, Any] = {key: value for key, value in numbers.items() if key in vars(base)}
    for kind in ("position", "velocity"):
        if f"{kind}_horizontal" in numbers:
            level = numbers[f"{kind}_horizontal"]
            plain[f"{kind}_sd"] = [level, level, numbers[f"{kind}_vertical"]]
    return replace(base, **plain)


def evidence_of_the_product(record: Record, base: StrapdownTuning, numbers: dict[str, float]) -> Tensor:  # fmt: skip
    """Log evidence by the Taylor linearisation of a model of the product with the same numbers, [G]."""
    changed, begin = change(base, numbers), record.start
    assert begin is not None
    if "lever_up" not in numbers:
        return EKF(StrapdownTotal(changed), record)
    lever = [numbers["lever_forward"], numbers["lever_right"], -numbers["lever_up"]]
    late = numbers.get("delay")
    constraints = Constraints(lever_arm=lever, delay_sd=None if late is None else 1e-9)
    tail = begin.new_full((len(begin), 0 if late is None else 1), late or 0.0)
    start = torch.cat([begin, tail], -1)
    return EKF(StrapdownBlocks(changed, constraints), record._replace(start=start))


@pytest.mark.parametrize(
    "values", [VALUES, VALUES | SPEEDS | PLACE, VALUES | PLACE | {"delay": [DELAY, -0.3]}]
)
def test_the_evidence_is_that_of_the_filter_of_the_product(values: dict[str, list[float]]) -> None:
    """For each value and record, with components that are missing: a relative difference of 1e-7, that of rounding in P."""
    base = change(tuning(5.0), {key: value[0] for key, value in values.items()})
    record = fly({key: value[1] for key, value in VALUES.items()}, 2, 16.0)
    if "velocity_vertical" in values:
        speed = torch.where(torch.isfinite(record.y), 3.0, torch.nan)
        record = record._replace(y=torch.cat([record.y, speed], -1))
    record.y[1, 5], record.y[0, 7, 1] = torch.nan, torch.nan
    batched = FixFilter(record, base)({k: torch.tensor(v) for k, v in values.items()})
    for i, terms in enumerate(batched.log_density.sum(-1)):
        expected = evidence_of_the_product(record, base, {k: v[i] for k, v in values.items()})
        torch.testing.assert_close(terms, expected, rtol=1e-7, atol=0.0)


@recorded
@pytest.mark.parametrize(("name", "step"), [("car_drive", 0.25), ("car_drive", 1.0), ("quad_flights", 1.0)])  # fmt: skip
def test_the_evidence_of_a_recorded_log_is_that_of_the_product(name: str, step: float) -> None:
    """The same of 60 s of the car, and of whole flights that end at different times."""
    words = [f"scenario=recorded_{name}", f"scenario.filter_step_s={step}"]
    values = compose([*words, *(["scenario.end_s=100"] if name == "car_drive" else [])]).values
    scenario = instantiate(values["scenario"])
    record = scenario.draw(instantiate(values["noise"]), torch.arange(2), 1).record
    own = FixFilter(record, scenario.tuning)
    terms = own({"gyro_density": torch.tensor([scenario.tuning.gyro_density])}).log_density
    expected = EKF(StrapdownTotal(scenario.tuning), record)
    torch.testing.assert_close(terms[0].sum(-1), expected, rtol=1e-6, atol=0.0)


def infer(record: Record, seed: int = 1) -> NoiseFit:
    """Posterior of all numbers of a record with the narrow prior."""
    passes = FixFilter(record, tuning(5.0))
    given = {k: {"log_normal": [float(np.log(m)), float(np.log(f))]} for k, (m, f) in NARROW.items()}  # fmt: skip
    priors = make_noise_priors(passes.numbers, {}, given)
    return fit_noise(passes, priors, PhiloxStream(seed, torch.arange(1)), 500, 6)


def test_intervals_cover_numbers_of_the_prior() -> None:
    """90 % intervals of 40 records: all numbers together within 3.3 standard errors, each within 3.3 of its own.

    Numbers of a record depend on each other, and 400 indicators count as 200.
    """
    runs = 40
    passes = FixFilter(fly({key: value[0] for key, value in VALUES.items()}, 1, 4.0), tuning(5.0))
    given = {k: {"log_normal": [float(np.log(m)), float(np.log(f))]} for k, (m, f) in NARROW.items()}  # fmt: skip
    stream = PhiloxStream(7, torch.arange(1))
    truth = {
        name: draw_prior(prior, stream, name, runs)[0]
        for name, prior in make_noise_priors(passes.numbers, {}, given).items()
    }
    records = fly(truth, runs, 60.0, seed=3)
    inside: dict[str, list[bool]] = {name: [] for name in truth}
    for r in range(runs):
        fit = infer(records.select_runs(slice(r, r + 1)), seed=r)
        for name, draws in truth.items():
            low, high = fit.quantiles(name, (0.05, 0.95))
            inside[name].append(low < float(draws[r]) < high)
        print(r, round(fit.draws.pareto_k, 2), round(fit.draws.ess), flush=True)
    shares = {name: float(np.mean(values)) for name, values in inside.items()}
    print(shares, np.mean(list(shares.values())))
    assert all(abs(share - 0.9) < 3.3 * (0.09 / runs) ** 0.5 for share in shares.values()), shares
    assert abs(np.mean(list(shares.values())) - 0.9) < 3.3 * (0.09 / 200) ** 0.5


def test_a_planted_antenna_delay_and_noise_of_fixes_are_found() -> None:
    """Of a weaving flight of a minute: within four posterior deviations, which are far below those of the prior."""
    planted = {"lever_right": 0.8, "lever_forward": -1.4, "lever_up": 0.6, "delay": 0.15}
    calm = {"gyro_density": 1e-3, "accelerometer_density": 0.02, "position_horizontal": 0.3}
    numbers = {key: median for key, (median, _) in NARROW.items()} | calm
    fit = infer(fly(numbers | planted, 1, 60.0))
    rows, mean = summarise_noise(fit), fit.draws.weights @ fit.draws.z
    sd = (fit.draws.weights @ (fit.draws.z - mean).square()).sqrt()
    z = {name: biject_to(prior.support).inv(torch.tensor({**numbers, **planted}[name]).double()) for name, prior in fit.target.prior.items()}  # fmt: skip
    for i, name in enumerate(fit.target.prior):
        assert abs(mean[i] - z[name]) < 4.0 * sd[i], name
    for name, most in {"lever_right": 0.7, "lever_forward": 0.7, "delay": 0.25, "position_horizontal": 0.2}.items():  # fmt: skip
        assert rows[name]["sd/prior"] < most
    assert rows["delay"]["value"] == pytest.approx(0.15, abs=0.05)


def test_numbers_that_a_log_does_not_show_keep_their_prior() -> None:
    """Bias walks in a flight of ten seconds: mean and deviation of the logarithm are those of the prior."""
    fit = infer(fly({key: median for key, (median, _) in NARROW.items()}, 1, 10.0))
    rows = summarise_noise(fit)
    for name in ("gyro_bias_walk", "accelerometer_bias_walk"):
        median, factor = NARROW[name]
        z, weights = fit.values[name].log(), fit.draws.weights
        mean = float(weights @ z)
        error = np.log(factor) / fit.draws.ess**0.5
        assert mean == pytest.approx(np.log(median), abs=4 * error + 0.15)
        assert float((weights @ (z - mean).square()).sqrt()) == pytest.approx(np.log(factor), rel=0.15)  # fmt: skip
        assert rows[name]["note"] == "not identified"


def test_weights_of_all_rounds_are_those_of_the_mixture_of_their_proposals() -> None:
    """A target of two normals, whose evidence and mean are known, from a proposal at one of them and one far away: four standard errors."""
    mass, place, sd = torch.tensor([0.7, 0.3]).double(), torch.tensor([0.0, 4.0]).double(), 0.6

    def target(z: Tensor) -> Tensor:
        parts = mass.log() - 0.5 * ((z[:, None] - place[:, None]) / sd).square().sum(-1)
        return parts.logsumexp(-1) - 2 * np.log(sd * (2 * np.pi) ** 0.5) + np.log(5.0)

    start = Mixture(
        torch.tensor([0.95, 0.05]).double(),
        torch.tensor([[1.0, 1.0], [60.0, 60.0]]).double(),
        torch.diag_embed(torch.tensor([[1.5, 1.5], [1e-4, 1e-4]]).double()),
    )
    found = [sample_mixture(target, start, PhiloxStream(s, torch.arange(1)), 400, 4) for s in range(20)]  # fmt: skip
    for values, exact in (([np.exp(f.log_evidence) / 5.0 for f in found], 1.0), ([float(f.weights @ f.z[:, 0]) for f in found], 1.2)):  # fmt: skip
        assert np.mean(values) == pytest.approx(exact, abs=4 * float(np.std(values, ddof=1)) / 20**0.5)  # fmt: skip
        assert np.std(values) < 0.1
    assert min(f.rounds for f in found) > 1
    assert float(start.adapt(found[0].z, found[0].weights).root.diagonal(dim1=1, dim2=2).min()) > 0.1  # fmt: skip


def test_a_filter_gets_the_root_of_the_mean_variance() -> None:
    """Of a log-normal posterior, sqrt(E v^2) = median exp(s^2): and a lever arm only where the log excludes zero."""
    passes = FixFilter(fly({key: value[0] for key, value in VALUES.items()}, 1, 4.0), tuning(5.0))
    priors = make_noise_priors(passes.numbers, {}, {})
    z = torch.randn(200_000, len(priors), generator=torch.Generator().manual_seed(1)).double()
    spread, names = 0.5, list(priors)
    z = z * spread
    z[:, names.index("lever_up")] += 3.0
    weights = torch.full((len(z),), 1.0 / len(z)).double()
    target = NoiseTarget(passes, priors, z.mean(0), z.std(0))
    chosen = choose_values(NoiseFit(target, WeightedDraws(z, weights, 0.0, 0.0, 1)))
    for name in DENSITIES:
        assert chosen[name] == pytest.approx(np.exp(spread**2), rel=0.02)
    assert chosen["lever_up"] == pytest.approx(3.0, abs=0.01)
    assert chosen["delay"] == 0.0
