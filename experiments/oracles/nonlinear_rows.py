"""Recipes of nonlinear models: extended filters, particles, twisted particles and smoothers with printed values."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from typing import Any

import torch
from pfbench.experiments.oracles.book import Number, Source, recipe
from pfbench.experiments.oracles.r_numbers import RNumbers
from pfbench.experiments.oracles.runs import average, build_filter, read_data, run_many, spread
from torch import Tensor
from torch.distributions import Beta, Cauchy, Distribution, HalfCauchy, Independent, Poisson

from pfbench.core import PhiloxStream, Record
from pfbench.filter import (
    EssResampler,
    Filter,
    GaussianFilter,
    ParticleFilter,
    SoftResampler,
    Systematic,
    TwistedParticleFilter,
    sample_trajectories,
    smooth,
)
from pfbench.model import (
    StateSpaceModel,
    StochasticVolatility,
    independent_normal,
    local_level,
    normal_batch,
)
from pfbench.ppl import ParameterisedModel, simulate, smc2

BSSM = Source(
    "bssm, R package", "tests/testthat/test_ekpf.R", "GPL-2 or later (facts alone); data remade",
    "read in the test; data drawn again by R's generator in Python",
)  # fmt: skip
BSSM_TABLE = BSSM._replace(
    file="vignettes/psi_pf_experiments/table1.rds and gm_truth.rds; setting in vignettes/psi_pf.Rmd",
    origin="read in the stored tables, of 10000 runs each; data drawn again by R's generator in Python",
)
POMP_RICKER = Source("pomp, R package", "tests/ricker.Rout.save; R/ricker.R", "GPL-3 (facts alone)", "read in the printed output, counts in the model")  # fmt: skip
GYM = Source(
    "inference_gym, TensorFlow Probability", "inference_gym/targets/ground_truth/{}.py", "Apache 2.0",
    "read in the file: means and standard deviations of Stan with their errors",
)  # fmt: skip


class AdditiveModel(StateSpaceModel):
    """x' = move(x) + q w, y = see(x) + r v: the first measurement is of the initial state."""

    observes_initial = True
    q: Tensor
    r: Tensor
    m0: Tensor
    s0: Tensor

    def __init__(self, q: list[float], r: list[float], m0: list[float], s0: list[float]) -> None:
        super().__init__()
        for name, values in (("q", q), ("r", r), ("m0", m0), ("s0", s0)):
            self.register_buffer(name, torch.tensor(values, dtype=torch.float64))
        size = len(q)
        self.names, self.units = tuple(f"x{k}" for k in range(size)), ("",) * size
        self.groups, self.noise_dim = {"state": tuple(range(size))}, size

    @abstractmethod
    def move(self, x: Tensor) -> Tensor: ...

    @abstractmethod
    def see(self, x: Tensor) -> Tensor: ...

    def initial(self, runs: int) -> Distribution:
        return normal_batch(runs, self.s0, self.m0)

    def propagate(self, x: Tensor, u: Any, w: Tensor) -> Tensor:
        return self.move(x) + self.q * w

    def noise_gain(self, u: Any) -> Tensor:
        return torch.diag(self.q)[None]

    def transition(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(self.move(x), self.q)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return independent_normal(self.see(x), self.r)


class SineExponential(AdditiveModel):
    """x' = sin x + 0.1 w, y = exp x + 0.1 v."""

    def move(self, x: Tensor) -> Tensor:
        return torch.sin(x)

    def see(self, x: Tensor) -> Tensor:
        return torch.exp(x)


class LogisticGrowth(AdditiveModel):
    """Growth to a capacity of 500 with a rate that wanders: states are the logit of the rate and the size."""

    def move(self, x: Tensor) -> Tensor:
        factor = torch.exp(torch.sigmoid(x[..., :1]) * 0.1)
        size = x[..., 1:]
        return torch.cat([x[..., :1], 500 * size * factor / (500 + size * (factor - 1))], -1)

    def see(self, x: Tensor) -> Tensor:
        return x[..., 1:]


class LorenzBridge(AdditiveModel):
    """Euler steps of 0.02 of the Lorenz attractor, of which x is measured."""

    def move(self, x: Tensor) -> Tensor:
        a, b, c = x.unbind(-1)
        drift = torch.stack([10 * (b - a), a * (28 - c) - b, a * b - 8 / 3 * c], -1)
        return x + 0.02 * drift

    def see(self, x: Tensor) -> Tensor:
        return x[..., :1]


class Ricker(AdditiveModel):
    """Logarithm of a population with overcrowding, of which Poisson counts of ten times its size are measured."""

    has_counts = True

    def move(self, x: Tensor) -> Tensor:
        return 3.8 + x - torch.exp(x)

    def see(self, x: Tensor) -> Tensor:
        return 10.0 * torch.exp(x)

    def observation(self, x: Tensor, u: Any) -> Distribution:
        return Independent(Poisson(self.see(x), validate_args=False), 1)


def _gaussian(name: str, *words: str) -> GaussianFilter:
    method = build_filter(name, 500, *words)
    assert isinstance(method, GaussianFilter)
    return method


@recipe(3, BSSM)
def bssm_extended() -> Iterator[Number]:
    """Likelihoods of the extended and of the iterated filter, with two measurements missing, and smoothed means."""
    numbers, x = RNumbers(1), 0.0
    y = [numbers.normal(1.0, 0.1)]
    for _ in range(9):
        x = numbers.normal(math.sin(x), 0.1)
        y.append(numbers.normal(math.exp(x), 0.1))
    full = torch.tensor(y, dtype=torch.float64)[:, None]
    gaps = full.clone()
    gaps[1:3] = torch.nan
    model = SineExponential([0.1], [0.1], [0.0], [1.0])
    setting = "sine and exponential, ten measurements with two missing"
    for name, method, printed in (
        ("ekf", _gaussian("ekf"), 2.65163101109689),
        ("iekf", _gaussian("iekf", "filter.iterations=2"), 2.61650080342709),
    ):
        ours = float(run_many(method, model, gaps).log_evidence)
        yield Number(name, f"{setting}, log likelihood", printed, ours, 4e-8, filters=(name,))
    smoothed = smooth(_gaussian("ekf"), model, Record(gaps[None])).mean[0, :, 0]
    note = "The test allows ten per cent."
    yield Number("smoothed_9", f"{setting}, smoothed mean of step 9", 0.0333634309012196, float(smoothed[8]), 3.3e-3, filters=("ekf",), note=note)  # fmt: skip
    runs = torch.arange(4)
    record = Record(full.expand(4, -1, -1))
    paths = sample_trajectories(build_filter("sir", 2000), model, record, PhiloxStream(1, runs), 500)  # fmt: skip
    mean, error = average(paths[:, :, 9, 0].mean(1))
    yield Number("particles_10", "sine and exponential, ten measurements, mean of step 10 by particles", 0.0734903567971838, mean, 7.3e-3, our_error=error, filters=("sir",), note=note)  # fmt: skip


def _growth() -> tuple[LogisticGrowth, Tensor]:
    """Return the logistic growth of bssm and its data, [300, 1]."""
    numbers, steps = RNumbers(1), 300
    logits = [-1.5]
    for change in numbers.normals(steps - 1, 0.05):
        logits.append(logits[-1] + change)
    sizes = [50.0]
    for logit in logits[:-1]:
        factor = math.exp(0.1 / (1 + math.exp(-logit)))
        last = sizes[-1]
        sizes.append(numbers.normal(500 * last * factor / (500 + last * (factor - 1)), 1.0))
    y = [[size + numbers.normal()] for size in sizes]
    model = LogisticGrowth([0.05, 1.0], [1.0], [-1.5, 50.0], [1.0, 10.0])
    return model, torch.tensor(y, dtype=torch.float64)


_REPEATS = 10000  # runs of the printed averages


def _growth_rows(label: str, method: Filter, runs: int, mean: float, sd: float, filters: tuple[str, ...], note: str = "") -> Iterator[Number]:  # fmt: skip
    """Yield the mean and the standard deviation of log likelihoods over runs."""
    model, y = _growth()
    values = run_many(method, model, y, runs, seed=3).log_evidence
    setting = f"logistic growth, 300 steps, {label}, over {runs} runs"
    ours, error = average(values)
    yield Number("mean", f"{setting}: mean log likelihood", mean, ours, 5e-5, sd / _REPEATS**0.5, error, filters, note)  # fmt: skip
    ours, error = spread(values)
    yield Number("sd", f"{setting}: its standard deviation", sd, ours, 5e-5, error / runs**-0.5 / _REPEATS**0.5, error, filters, note)  # fmt: skip


@recipe(5, BSSM_TABLE)
def bssm_bootstrap_100() -> Iterator[Number]:
    """Bootstrap filter with 100 particles."""
    yield from _growth_rows("100 particles", build_filter("sir_printed", 100), 600, -611.0850, 3.7534, ("sir_printed",))  # fmt: skip


@recipe(6, BSSM_TABLE)
def bssm_bootstrap_1000() -> Iterator[Number]:
    """Bootstrap filter with 1000 particles."""
    yield from _growth_rows("1000 particles", build_filter("sir_printed", 1000), 200, -606.6395, 0.9176, ("sir_printed",))  # fmt: skip


@recipe(12, BSSM_TABLE)
def bssm_guided_100() -> Iterator[Number]:
    """Particles guided by the extended filter, 100 of them."""
    method = build_filter("ekf_pf", 100, "filter.resampler.ess_threshold=1.0")
    yield from _growth_rows("100 particles guided by the EKF", method, 200, -607.7500, 1.8476, ("ekf_pf",))  # fmt: skip


@recipe(30, BSSM_TABLE)
def bssm_guided_1000() -> Iterator[Number]:
    """Particles guided by the extended filter, 1000 of them."""
    method = build_filter("ekf_pf", 1000, "filter.resampler.ess_threshold=1.0")
    yield from _growth_rows("1000 particles guided by the EKF", method, 50, -606.3727, 0.5524, ("ekf_pf",))  # fmt: skip


@recipe(12, BSSM_TABLE)
def bssm_twisted_100() -> Iterator[Number]:
    """The psi-APF with 100 particles, and the likelihood by 100000 particles of the bootstrap filter."""
    rows = list(_growth_rows("100 particles twisted by the smoother", TwistedParticleFilter(100), 100, -606.2149, 0.0425, ()))  # fmt: skip
    yield from rows
    yield Number(
        "truth", "logistic growth, 300 steps, one draw of a bootstrap filter with 100000 particles, by ours as before", -606.162991217762,
        rows[0].ours, 0.0, 0.9176 / 10, rows[0].our_error,
    )  # fmt: skip


@recipe(2, POMP_RICKER)
def pomp_ricker() -> Iterator[Number]:
    """Log probability of the counts of the Ricker model."""
    model = Ricker([0.3], [1.0], [math.log(7.0)], [1e-9])
    values = run_many(build_filter("sir_printed", 1000), model, read_data("ricker.csv"), 40).log_evidence  # fmt: skip
    ours, error = average(values)
    yield Number("sir_printed", "log probability of the counts of the Ricker model, 51 counts, one draw with 1000 particles", -138.5, ours, 0.05, float(values.std()), error, ("sir_printed",))  # fmt: skip


# --------------------------------------------------------------------------------------------------
# inference_gym


def _at(name: str) -> Source:
    return GYM._replace(file=GYM.file.format(name))


@recipe(1, _at("brownian_motion_missing_middle_observations"))
def gym_brownian() -> Iterator[Number]:
    """Smoothed means and standard deviations of Brownian motion with a gap."""
    y, mean, error, sd = read_data("brownian.csv").unbind(1)
    model = local_level(0.1, 0.15, 0.0, 0.1, observes_initial=True)
    smoothed = smooth(_gaussian("ekf"), model, Record(y[None, :, None]))
    ours, ours_sd = smoothed.mean[0, :, 0], smoothed.covariance[0, :, 0, 0].sqrt()
    # standard error of a standard deviation of as many independent draws as the error of the mean implies
    for name, printed, values, errors in (
        ("mean", mean, ours, error),
        ("sd", sd, ours_sd, error / 2**0.5),
    ):
        z = (values - printed) / errors
        note = f"All 30: root mean square z {float(z.square().mean().sqrt()):.2f}, worst {float(z.abs().max()):.2f}."
        for step in (0, 14, 29):
            yield Number(f"{name}_{step + 1}", f"Brownian motion, ten of 30 measurements missing, smoothed {name} of step {step + 1}", float(printed[step]), float(values[step]), 1e-9, float(errors[step]), filters=("ekf",), note=note)  # fmt: skip


@recipe(60, _at("convection_lorenz_bridge"))
def gym_lorenz() -> Iterator[Number]:
    """Smoothed means and standard deviations of a Lorenz bridge by particles with backward sampling."""
    table, runs = read_data("lorenz_bridge.csv"), 10
    mean, error, sd = table[:, 1:4], table[:, 4:7], table[:, 7:10]
    noise = 0.1 * 0.02**0.5
    model = LorenzBridge([noise] * 3, [1.0], [0.0] * 3, [1.0] * 3)
    record = Record(table[None, :, :1].expand(runs, -1, -1))
    with torch.no_grad():
        paths = sample_trajectories(build_filter("sir", 5000), model, record, PhiloxStream(1, torch.arange(runs)), 200)  # fmt: skip
    each_mean, each_sd = paths.mean(1), paths.std(1)
    for name, printed, each, errors in (
        ("mean", mean, each_mean, error),
        ("sd", sd, each_sd, error / 2**0.5),
    ):
        ours, ours_error = each.mean(0), each.std(0) / runs**0.5
        z = (ours - printed) / torch.hypot(errors, ours_error)
        note = f"All 90: root mean square z {float(z.square().mean().sqrt()):.2f}, worst {float(z.abs().max()):.2f}."
        for step, k in ((0, 0), (14, 1), (29, 2)):
            at = (step, k)
            yield Number(f"{name}_{'xyz'[k]}_{step + 1}", f"Lorenz bridge, ten of 30 measurements of x missing, smoothed {name} of {'xyz'[k]} at step {step + 1}", float(printed[at]), float(ours[at]), 1e-9, float(errors[at]), float(ours_error[at]), ("sir",), note)  # fmt: skip


# Volatility of an index: data, prior and posterior (50000 draws of another program) of `stochastic_volatility_sp500_small`
# of Inference Gym 0.0.5. Closing prices of the S&P 500 to 24 June 2020; (rho + 1) / 2 has the law Beta(20, 1.5).
PRICES = """
3225.52 3248.92 3297.59 3334.69 3345.78 3327.71 3352.09 3357.75 3379.45 3373.94 3380.16 3370.29 3386.15
3373.23 3337.75 3225.89 3128.21 3116.39 2978.76 2954.22 3090.23 3003.37 3130.12 3023.94 2972.37 2746.56
2882.23 2741.38 2480.64 2711.02 2386.13 2529.19 2398.10 2409.39 2304.92 2237.40 2447.33 2475.56 2630.07
2541.47 2626.65 2584.59 2470.50 2526.90 2488.65 2663.68 2659.41 2749.98 2789.82 2761.63 2846.06 2783.36
2799.55 2874.56 2823.16 2736.56 2799.31 2797.80 2836.74 2878.48 2863.39 2939.51 2912.43 2830.71 2842.74
2868.44 2848.42 2881.19 2929.80 2930.19 2870.12 2820.00 2852.50 2863.70 2953.91 2922.94 2971.61 2948.51
2955.45 2991.77 3036.13 3029.73 3044.31 3055.73 3080.82 3122.87 3112.35 3193.93 3232.39 3207.18 3190.14
3002.10 3041.31 3066.59 3124.74 3113.49 3115.34 3097.74 3117.86 3131.29 3050.33
"""
PUBLISHED = {"rho": (0.92498, 0.04760), "mu": (7.91517, 1.04789), "sigma": (0.50045, 0.13948)}
_RETURNS = torch.tensor([float(v) for v in PRICES.split()], dtype=torch.float64).diff()
INDEX = Record((_RETURNS - _RETURNS.mean())[None, :, None])
# a prior on (-1, 1) as one on (0, 1)
_VOLATILITY = ParameterisedModel(
    lambda half, mu, sigma: StochasticVolatility(mu, 2.0 * half - 1.0, sigma),
    {"half": Beta(20.0, 1.5), "mu": Cauchy(0.0, 5.0), "sigma": HalfCauchy(2.0)},
)


@recipe(13, _at("stochastic_volatility_sp500_small"))
def gym_volatility() -> Iterator[Number]:
    """Posterior means of three numbers of a volatility model by SMC2."""
    repeats, values = 6, 200
    method = build_filter("sir", 100)
    fits = [smc2(_VOLATILITY, method, INDEX, values, seed=seed) for seed in range(1, repeats + 1)]
    setting = f"volatility of an index, 99 returns, {repeats} sets of {values} values with 100 particles each"
    for name, (mean, sd) in PUBLISHED.items():
        means = [2.0 * fit.mean["half"] - 1.0 if name == "rho" else fit.mean[name] for fit in fits]
        ours, error = average(torch.stack(means)[:, -1])
        yield Number(f"{name}_mean", f"{setting}: posterior mean of {name}", mean, ours, 5e-6, sd / 50000**0.5, error, ("sir",))  # fmt: skip


# --------------------------------------------------------------------------------------------------
# PyDPF

_PYDPF = Source(
    "PyDPF, Python package", "jss_examples/Stochastic Volatility/results/fully_specified_results.csv; settings in its notebook",
    "GPL-3 (facts alone); data drawn by pfbench",
    "read in the table: means over 500 records that its script draws at random; ours are over other records",
)  # fmt: skip
_PYDPF_RECORDS = 500  # of the printed averages


def _mean_row(name: str, setting: str, printed: float, values: Tensor, filters: tuple[str, ...]) -> Number:  # fmt: skip
    """Return the row of a mean over records, whose printed mean has the spread of ours."""
    ours, error = average(values)
    theirs = error * (len(values) / _PYDPF_RECORDS) ** 0.5
    return Number(name, setting, printed, ours, 5e-7, theirs, error, filters)


@recipe(30, _PYDPF)
def pydpf_volatility() -> Iterator[Number]:
    """Errors of 100 particles in stochastic volatility: to a filter with 10000 particles that are drawn independently."""
    records, steps = 16, 1001
    model = StochasticVolatility(2.0 * math.log(0.5), 0.91, 1.0)
    record, _ = simulate(model, Record(torch.zeros(records, steps, 1, dtype=torch.float64)), 5)
    many = build_filter("sir", 10000, "filter.resampler.ess_threshold=1.0", "filter.resampler.scheme._target_=pfbench.filter.Multinomial")  # fmt: skip
    soft = SoftResampler(0.7, EssResampler(Systematic(), 1.0))
    methods = {"sir_printed": build_filter("sir_printed", 100), "soft": ParticleFilter(100, resampler=soft)}  # fmt: skip
    printed = {"sir_printed": (0.0268989484, 0.0636953045), "soft": (0.0262295765, 0.0654205315)}
    reference = _step_estimates(many, model, record, 1)
    for label, method in methods.items():
        mean, factor = _step_estimates(method, model, record, 2)
        squares = (mean - reference[0]).square().mean(1)
        ratios = (1.0 - torch.exp(factor - reference[1])).abs().mean(1)
        filters = (label,) if label == "sir_printed" else ()
        setting = f"stochastic volatility, 1001 returns, 100 particles, {'soft resampling by 0.7' if label == 'soft' else 'systematic resampling'} in each step"
        yield _mean_row(f"{label}_state", f"{setting}: squared error of the mean of a step", printed[label][0], squares, filters)  # fmt: skip
        yield _mean_row(f"{label}_likelihood", f"{setting}: relative error of the likelihood of a step", printed[label][1], ratios, filters)  # fmt: skip


def _step_estimates(method: Filter, model: StateSpaceModel, record: Record, seed: int) -> tuple[Tensor, Tensor]:  # fmt: skip
    """Return the mean [R, T] and the log likelihood [R, T] of each step."""
    runs = torch.arange(len(record.y))
    draws = PhiloxStream(seed, runs)
    belief = method.init(model, len(runs), draws.at_step(0), record.start, record.spread)
    means, totals = [], [belief.log_evidence]
    with torch.no_grad():
        for t in range(record.y.shape[1]):
            belief, info = method.step(model, belief, record.at_step(t), draws.at_step(t + 1))
            means.append(info.mean)
            totals.append(belief.log_evidence)
    return torch.stack(means, 1), torch.stack(totals, 1).diff(dim=1)
