"""Simulation-based calibration of each method of inference on a local level, volatility and a short strapdown record.

    python experiments/analyses/calibration.py [data sets]

Parameters come from their prior, measurements from the model with them. The rank of a parameter among 19 draws of a method must be
uniform. Dear methods get 40 of 100 data sets. Draws of a chain depend on each other: where one chain in ten has fewer than 19
effective draws, ranks need not be uniform though the sampler is right, and the case is named. Two controls are of the local level. Draws
from a grid of the exact posterior must pass. Chains whose density lacks the Jacobian of the logarithm must fail.
Finished cases are kept in results/calibration.json. The script prints the table of the page on inference, and its cases are in the file
beside the script: with PFBENCH_RESULTS=experiments/analyses it goes on with those that are missing.
"""

from __future__ import annotations

import math
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from pfbench.experiments.study_parts import ResumableResults
from pyro.distributions import LogNormal, Normal, Uniform
from pyro.ops.stats import effective_sample_size
from scipy.stats import chisquare

from pfbench.core import Record
from pfbench.files import markdown_head, markdown_row
from pfbench.filter import (
    ConditionalSmcKernel,
    GaussianFilter,
    ParticleFilter,
    TaylorLinearisation,
    TwistedParticleFilter,
)
from pfbench.model import StochasticVolatility, StrapdownTotal, StrapdownTuning, local_level
from pfbench.ppl import (
    FilterLikelihood,
    GaussianHmmLikelihood,
    ParameterisedModel,
    ParameterPosterior,
    PmmhSettings,
    normal_guide,
    nuts,
    particle_gibbs,
    pmmh,
    program,
    simulation_based_calibration,
    smc2,
    svi,
)
from pfbench.results import holm

BINS, DRAWS, LEVEL = 5, 19, 0.05
PLANTED = "PMMH without the Jacobian (planted)"
EKF = GaussianFilter(TaylorLinearisation())
SEPARATE = PmmhSettings(separate_parameters=True)
Infer = Callable[[Record], ParameterPosterior]


def level(level_sd: Any, measurement_sd: Any) -> Any:
    return local_level(level_sd, measurement_sd, 0.0, 2.0)


def strapdown(gyro_density: Any, position_sd: Any) -> Any:
    one = torch.ones(3, dtype=torch.float64)
    return StrapdownTotal(
        StrapdownTuning(
            gyro_density=gyro_density, accelerometer_density=0.02, gyro_bias_walk=1e-6, accelerometer_bias_walk=1e-5,
            position_sd=position_sd * one, velocity_sd=None, attitude_sd_deg=[1.0, 1.0, 5.0], initial_velocity_sd=[0.1] * 3,
            initial_position_sd=[1.0] * 3, gyro_bias_sd_deg_s=0.1, accelerometer_bias_sd=0.05, gyro_bias_deg_s=[0.0] * 3,
            accelerometer_bias=[0.0] * 3,
        )
    )  # fmt: skip


LEVELS = ParameterisedModel(
    level, {"level_sd": LogNormal(0.0, 0.7), "measurement_sd": LogNormal(0.0, 0.7)}
)
VOLATILITY = ParameterisedModel(
    StochasticVolatility,
    {"mu": Normal(-1.0, 1.0), "rho": Uniform(0.5, 0.99), "sigma": LogNormal(-0.7, 0.5)},
)
INS = ParameterisedModel(
    strapdown, {"gyro_density": LogNormal(-4.6, 0.7), "position_sd": LogNormal(-1.2, 0.5)}
)


def turn(runs: int, seconds: int) -> Record:
    """A vehicle that accelerates for a second and then turns by 0.3 rad/s at 5 m/s, with a fix each second."""
    still = torch.zeros(seconds, 3, dtype=torch.float64)
    force = still + torch.tensor([-1.5, 0.0, 9.8]).double()
    force[0, 1] = 5.0
    half = still.new_tensor([math.cos(0.15), 0.0, 0.0, math.sin(0.15)]).expand(seconds, -1)
    eye, zero = torch.eye(3).double(), torch.zeros(3, 3).double()
    slope = torch.cat([torch.cat(row, 1) for row in ([-eye, zero], [zero, -eye], [zero, -eye / 2])])
    bias, one = torch.zeros(seconds, 6).double(), torch.ones(seconds).double()
    imu = (half, force, force / 2, slope.expand(seconds, -1, -1), bias, 9.8 * one, one)
    inputs: Any = StrapdownTotal.input_type
    y = torch.zeros(runs, seconds, 3, dtype=torch.float64)
    return Record(y, inputs(*(a.unsqueeze(0) for a in imu)))


def by_pmmh(unknown: ParameterisedModel, method: Any, draws: int, warmup: int) -> Infer:
    return lambda record: pmmh(unknown, method, record, draws, warmup, 1, 3, SEPARATE)


def by_svi(unknown: ParameterisedModel, likelihood: Any, steps: int) -> Infer:
    model, guide = program(unknown, likelihood, True), normal_guide(unknown, True)
    return lambda record: svi(model, record, guide, steps, 100, rate=0.1, seed=3).posterior


def by_nuts(unknown: ParameterisedModel, likelihood: Any, draws: int, warmup: int) -> Infer:
    """All data sets in one chain, since their parameters are independent."""
    return lambda record: nuts(program(unknown, likelihood, True), record, draws, warmup, 1, 3)


def one_by_one(infer: Callable[[Record, int], dict[str, Any]]) -> Infer:
    """Infer each data set alone, by a method whose runs share their parameters; draws [S] by name."""

    def run(record: Record) -> ParameterPosterior:
        found = [infer(record.select_runs(slice(r, r + 1)), r) for r in range(len(record.y))]
        return ParameterPosterior({k: torch.stack([f[k] for f in found], -1)[None] for k in found[0]})  # fmt: skip

    return run


def by_smc2(unknown: ParameterisedModel, method: Any, values: int) -> Infer:
    def infer(record: Record, seed: int) -> dict[str, Any]:
        result = smc2(unknown, method, record, values, seed)
        chosen = torch.multinomial(result.weights, 100, True, generator=torch.Generator().manual_seed(seed))  # fmt: skip
        return {name: a[chosen] for name, a in result.values.items()}

    return one_by_one(infer)


def by_gibbs(unknown: ParameterisedModel, chains: int, draws: int, warmup: int) -> Infer:
    def infer(record: Record, seed: int) -> dict[str, Any]:
        kernel = ConditionalSmcKernel(8)
        found = particle_gibbs(unknown, record, draws, warmup, chains, seed, kernel).posterior
        return {name: found.pooled_draws(name) for name in unknown.prior}

    return one_by_one(infer)


def by_grid(record: Record) -> ParameterPosterior:
    """Draw from the exact posterior of the local level, on a grid of logarithms, by a Kalman filter of one number."""
    at = torch.linspace(-3.5, 3.5, 81, dtype=torch.float64)
    logs = torch.cartesian_prod(at, at)
    q, r = (2.0 * logs).exp().unbind(1)
    mean, p = torch.zeros(len(record.y), len(logs)).double(), torch.full_like(q, 4.0)
    log_p = -0.5 * (logs / 0.7).square().sum(1).expand_as(mean)
    for y in record.y.unbind(1):
        s = p + q + r
        log_p = log_p - 0.5 * ((y - mean).square() / s + s.log())
        mean, p = mean + (p + q) / s * (y - mean), (p + q) * r / s
    source = torch.Generator().manual_seed(3)
    chosen = logs[torch.multinomial(torch.softmax(log_p, 1), 100, True, generator=source)]
    drawn = chosen + (at[1] - at[0]) * (torch.rand(chosen.shape, generator=source) - 0.5)
    return ParameterPosterior({k: a.exp().T[None] for k, a in zip(LEVELS.names, drawn.unbind(2), strict=True)})  # fmt: skip


def list_cases(runs: int) -> dict[str, tuple[ParameterisedModel, Record, Infer]]:
    """Cases by name `model, method`."""
    short = Record(torch.zeros(runs, 8, 1, dtype=torch.float64))
    returns, log = Record(torch.zeros(runs, 20, 1, dtype=torch.float64)), turn(runs, 15)
    few = [r._replace(y=r.y[: runs * 2 // 5]) for r in (short, returns, log)]  # for dear methods
    hmm, ahead = GaussianHmmLikelihood(), TwistedParticleFilter(20, passes=3)
    # of a log-normal law of x, the density of log x without the Jacobian x is that of this other law
    planted = ParameterisedModel(level, dict.fromkeys(LEVELS.names, LogNormal(-(0.7**2), 0.7)))
    return {
        "local level, exact grid": (LEVELS, short, by_grid),
        f"local level, {PLANTED}": (LEVELS, short, by_pmmh(planted, EKF, 600, 200)),
        "local level, PMMH": (LEVELS, short, by_pmmh(LEVELS, ParticleFilter(300), 800, 200)),
        "local level, SVI": (LEVELS, short, by_svi(LEVELS, hmm, 200)),
        "local level, SMC2": (LEVELS, short, by_smc2(LEVELS, EKF, 300)),
        "volatility, SMC2": (VOLATILITY, few[1], by_smc2(VOLATILITY, ParticleFilter(60), 300)),
        "INS, SVI by EKF": (INS, few[2], by_svi(INS, FilterLikelihood(EKF), 80)),
        "local level, NUTS": (LEVELS, few[0], by_nuts(LEVELS, hmm, 60, 50)),
        "volatility, PMMH": (VOLATILITY, few[1], by_pmmh(VOLATILITY, ParticleFilter(200), 800, 200)),
        "INS, PMMH by EKF": (INS, few[2], by_pmmh(INS, EKF, 500, 150)),
        "local level, particle Gibbs": (LEVELS, few[0], by_gibbs(LEVELS, 16, 10, 20)),
        "volatility, PMMH that looks ahead": (VOLATILITY, few[1], by_pmmh(VOLATILITY, ahead, 500, 150)),
    }  # fmt: skip


def compute_case(case: tuple[ParameterisedModel, Record, Infer]) -> dict[str, Any]:
    """Counts of ranks by parameter, effective draws that nine of ten chains reach, and the time."""
    start, kept = time.process_time(), []
    unknown, template, infer = case

    def infer_and_keep(record: Record) -> ParameterPosterior:
        kept.append(infer(record))
        return kept[0]

    ranks = simulation_based_calibration(unknown, template, infer_and_keep, draws=DRAWS, seed=7)
    counts = {name: ranks.counts(name, BINS).tolist() for name in unknown.names}
    result: dict[str, Any] = {"counts": counts, "seconds": time.process_time() - start}
    if kept[0].accepted is not None:
        for name, draws in kept[0].draws.items():
            ess = torch.stack([effective_sample_size(a, 0, 1) for a in draws.unbind(2)])
            # NaN of chains that never move
            result.setdefault("ess", {})[name] = float(ess.nan_to_num(nan=1.0).quantile(0.1))
    return result


def write_table(done: dict[str, Any]) -> str:
    """Return the table and what it says."""
    lines = markdown_head("model", "method", "parameter", "data sets in each fifth of the ranks", "p", "effective draws", "CPU [s]")  # fmt: skip
    p_values: dict[bool, dict[str, float]] = {False: {}, True: {}}
    short = []
    for case, result in done.items():
        model, method = case.split(", ")
        for name, counts in result["counts"].items():
            label = f"`{name}` by {method}"
            p_values[method == PLANTED][label] = p = float(chisquare(counts).pvalue)
            ess = result.get("ess", {}).get(name)
            short += [label] if ess is not None and ess < DRAWS else []
            counted, seconds = " ".join(map(str, counts)), f"{result['seconds']:.0f}"
            effective = "" if ess is None else f"{ess:.0f}"
            lines.append(markdown_row(model, method, f"`{name}`", counted, f"{p:.2g}", effective, seconds))  # fmt: skip
    words = []
    for is_planted, values in p_values.items():
        corrected = zip(values, holm(list(values.values())), strict=True)
        off = ", ".join(name for name, p in corrected if p < LEVEL) or "none"
        kind = "tests of the planted fault" if is_planted else "tests"
        words.append(f"{len(values)} {kind}, Holm's correction at {LEVEL:.0%}. Not uniform: {off}.")
    words.append(f"Chains with fewer than {DRAWS} effective draws in one of ten: {', '.join(short) or 'none'}.")  # fmt: skip
    minutes = sum(result["seconds"] for result in done.values()) / 60.0
    words.append(f"All together took {minutes:.0f} minutes of one core.")
    return "\n".join([*lines, "", *words])


def main(runs: int) -> None:
    torch.set_num_threads(1)
    folder = Path(os.environ.get("PFBENCH_RESULTS", "results"))
    results = ResumableResults(folder / "calibration.json", {"runs": runs})
    for name, case in list_cases(runs).items():
        results(name, lambda case=case: compute_case(case))
        print(name, flush=True)
    print(write_table(results.state["done"]))


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
