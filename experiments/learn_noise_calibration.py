"""Calibration of inferred noise levels: ranks of true parameters among posterior draws, for PMMH and SVI.

    python -m pfbench.experiments.learn_noise_calibration [data sets [effort [model]]]

The models are a local level and passive location. Each case is repeated with a wrong likelihood, which
assumes a larger measurement noise than the parameter. Effort multiplies draws and steps. The command
resumes from the cases in its folder and writes `report.md`. `model` is the first word of the cases that run.
"""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from pfbench.experiments.study_parts import ResumableResults
from pyro.distributions import LogNormal
from scipy.stats import chisquare

from pfbench.core import Record
from pfbench.files import markdown_head, markdown_paragraph, markdown_row
from pfbench.filter import GaussianFilter, ParticleFilter, TaylorLinearisation
from pfbench.model import (
    PassiveLocation,
    PlatformInputs,
    StateSpaceModel,
    compute_level_attitude,
    local_level,
)
from pfbench.ppl import (
    FilterLikelihood,
    GaussianHmmLikelihood,
    ParameterisedModel,
    ParameterPosterior,
    PmmhSettings,
    SbcRanks,
    normal_guide,
    pmmh,
    program,
    sbc_histograms,
    simulation_based_calibration,
    svi,
)
from pfbench.report import render_palette_png
from pfbench.results import holm

WRONG = 1.5  # factor on the measurement noise of the wrong likelihood
BINS, DRAWS = 10, 19
LEVEL = 0.05  # of the tests
LEVELS = {"level_sd": LogNormal(0.0, 0.7), "measurement_sd": LogNormal(0.0, 0.7)}
SIGHTS = {"angle_sd": LogNormal(math.log(3e-3), 0.5)}  # rad; of bearing and elevation
LABELS = {"toy": "local level, 8 measurements", "location": "passive location, 6 measurements"}

Infer = Callable[[Record], ParameterPosterior]
Case = tuple[ParameterisedModel, Record, Infer]


def level(level_sd: Any, measurement_sd: Any, wrong: float = 1.0) -> StateSpaceModel:
    return local_level(level_sd, wrong * measurement_sd, 0.0, 2.0)


def location(angle_sd: Any, wrong: float = 1.0) -> StateSpaceModel:
    """An emitter at 226 km, its position uncertain by 5 km per axis, measured every 10 s."""
    sd = [wrong * angle_sd, wrong * angle_sd, 1e-4, 1e-4, 1.0]
    return PassiveLocation(10.0, 0.1, sd, (160e3, 160e3, -15.0, 15.0), (5e3, 5e3, 10.0, 10.0))


def flight(runs: int, steps: int) -> Record:
    """An aircraft at 200 m/s in level flight."""
    t = 10.0 * torch.arange(1, steps + 1, dtype=torch.float64)
    velocity = torch.tensor([200.0, 0.0, 0.0], dtype=torch.float64)
    position = torch.tensor([0.0, 0.0, 2000.0], dtype=torch.float64) + t[:, None] * velocity
    attitude = compute_level_attitude(velocity).expand(1, steps, 3, 3)
    carrier = torch.full((1, steps), 1e10, dtype=torch.float64)
    platform = PlatformInputs(position[None], velocity.expand(1, steps, 3), attitude, carrier)
    return Record(torch.zeros(runs, steps, 5, dtype=torch.float64), platform)


def by_pmmh(parameterised: ParameterisedModel, particles: int, draws: int, warmup: int) -> Infer:
    return lambda record: pmmh(
        parameterised,
        ParticleFilter(particles),
        record,
        draws,
        warmup,
        chains=1,
        seed=3,
        settings=PmmhSettings(separate_parameters=True),
    )


def by_svi(parameterised: ParameterisedModel, likelihood: Any, steps: int) -> Infer:
    def infer(record: Record) -> ParameterPosterior:
        guide = normal_guide(parameterised, separate_parameters=True)
        return svi(
            program(parameterised, likelihood, separate_parameters=True),
            record,
            guide,
            steps,
            100,
            rate=0.1,
            seed=3,
        ).posterior

    return infer


def parameterise(
    make: Callable[..., StateSpaceModel], prior: Mapping[str, Any], wrong: float = 1.0
) -> ParameterisedModel:
    return ParameterisedModel(lambda **values: make(**values, wrong=wrong), prior)


def list_cases(runs: int, effort: int = 1) -> dict[str, Case]:
    """The eight cases by name `model, algorithm` or `model, algorithm, wrong`."""
    cases: dict[str, Case] = {}
    ekf = FilterLikelihood(GaussianFilter(TaylorLinearisation()))
    draws, warmup = 120 * effort, 60 * effort
    for suffix, wrong in (("", 1.0), (", wrong", WRONG)):
        truth, assumed = (parameterise(level, LEVELS, factor) for factor in (1.0, wrong))
        shape = Record(torch.zeros(runs, 8, 1, dtype=torch.float64))
        kalman = by_svi(assumed, GaussianHmmLikelihood(), 150 * effort)
        cases[f"toy, PMMH{suffix}"] = truth, shape, by_pmmh(assumed, 100, draws, warmup)
        cases[f"toy, SVI{suffix}"] = truth, shape, kalman
        truth, assumed = (parameterise(location, SIGHTS, factor) for factor in (1.0, wrong))
        shape = flight(runs, 6)
        cases[f"location, PMMH{suffix}"] = truth, shape, by_pmmh(assumed, 1000, draws, warmup)
        cases[f"location, SVI{suffix}"] = truth, shape, by_svi(assumed, ekf, 80 * effort)
    return cases


def compute_case(case: Case) -> dict[str, Any]:
    """Ranks and counts of ranks in bins, by parameter."""
    ranks = simulation_based_calibration(*case, draws=DRAWS, seed=7)
    counts = {name: ranks.counts(name, BINS).tolist() for name in case[0].names}
    return {"counts": counts, "ranks": {name: r.tolist() for name, r in ranks.ranks.items()}}


def read_ranks(result: Mapping[str, Any]) -> SbcRanks:
    return SbcRanks({name: torch.tensor(r) for name, r in result["ranks"].items()}, DRAWS)


def list_tests(done: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One test of uniform ranks for each case and parameter, in the order of the table."""
    tests = []
    for name in sorted(done, key=lambda name: name.endswith("wrong")):
        model, algorithm, *wrong = name.split(", ")
        for parameter, counts in done[name]["counts"].items():
            row = {"model": model, "algorithm": algorithm, "is_wrong": bool(wrong)}
            p = float(chisquare(counts).pvalue)
            tests.append({**row, "parameter": parameter, "p": p, "counts": counts})
    return tests


def format_table(tests: list[dict[str, Any]]) -> list[str]:
    names = ("model", "algorithm", "likelihood", "parameter")
    lines = markdown_head(*names, "data sets in each tenth of the ranks", "p")
    for test in tests:
        counts = " ".join(map(str, test["counts"]))
        likelihood = "wrong" if test["is_wrong"] else "correct"
        label = LABELS[test["model"]]
        name = f"`{test['parameter']}`"
        lines.append(
            markdown_row(label, test["algorithm"], likelihood, name, counts, f"{test['p']:.2g}")
        )
    return lines


def describe_tests(tests: list[dict[str, Any]], is_wrong: bool) -> str:
    """Decisions of the tests of one likelihood, with Holm's correction over them."""
    selected = [test for test in tests if test["is_wrong"] == is_wrong]
    pairs = [*zip(selected, holm([test["p"] for test in selected]), strict=True)]

    def names(is_significant: bool) -> str:
        return ", ".join(
            f"`{test['parameter']}` by {test['algorithm']} (p {test['p']:.2g})"
            for test, p in pairs
            if (p < LEVEL) == is_significant
        )

    least = min(test["p"] for test in selected)
    chance = 1.0 - (1.0 - least) ** len(selected)
    text = (
        f"{'Wrong' if is_wrong else 'Correct'} likelihood, {len(selected)} tests, Holm's correction at {LEVEL:.0%}. "
        f"Significant: {names(True) or 'none'}. Not significant: {names(False) or 'none'}."
    )
    if is_wrong:
        return text
    return (
        f"{text} The smallest p-value is {least:.2g}. With independent uniform p-values, the probability of one as small is "
        f"{chance:.2g}."
    )


def compute_power(runs: int, share: float, samples: int = 20000) -> float:
    """Power of the chi-square test by simulation, if one bin has this share and the rest is uniform."""
    shares = np.full(BINS, (1.0 - share) / (BINS - 1))
    shares[0] = share
    counts = np.random.default_rng(0).multinomial(runs, shares, samples)
    return float((chisquare(counts, axis=1).pvalue < LEVEL).mean())


def write_page(request: Mapping[str, Any], done: Mapping[str, Any]) -> str:
    """The page of the study from its stored results."""
    runs, tests = request["runs"], list_tests(done)
    lines = ["# Calibration of inferred noise levels", ""]
    lines += markdown_paragraph(
        f"`python -m pfbench.experiments.learn_noise_calibration {runs} {request['effort']}` writes this page. It "
        "draws parameters from their prior and measurements from the model. PMMH and SVI infer the parameters. "
        f"The rank of the true parameter among {DRAWS} posterior draws must be uniform "
        f"[Talts et al. 2018]. Each case has {runs} data sets, the same for both algorithms. The p-values are of a chi-square "
        f"test of {BINS} bins."
    )
    lines += markdown_paragraph(
        f"Each case is repeated with a wrong likelihood. Its measurement noise is {WRONG:g} times the parameter."
    )
    lines += [*format_table(tests), ""]
    for is_wrong in sorted({test["is_wrong"] for test in tests}):
        lines += markdown_paragraph(describe_tests(tests, is_wrong))
    lines += markdown_paragraph(
        "The wrong likelihood does not change the noise of the level, so that ranks of `level_sd` need not fail."
    )
    lines += markdown_paragraph(
        f"Power of one test without correction: if one bin contains 17 % of the data sets, {compute_power(runs, 0.17):.2f}; "
        f"15 %, {compute_power(runs, 0.15):.2f}. Smaller departures are not excluded."
    )
    lines += ["![Ranks on passive location](calibration_location.png)", ""]
    lines += markdown_paragraph(
        "The grey band contains 95 % of the bins of uniform ranks. Panels have different scales."
    )
    return "\n".join(lines)


def main(folder: Path, runs: int = 200, effort: int = 2, only: str = "") -> None:
    torch.set_num_threads(1)
    request = {"runs": runs, "effort": effort}
    results = ResumableResults(folder / "learn_noise_calibration.json", request)
    for name, case in list_cases(runs, effort).items():
        if name.startswith(only):
            results(name, lambda case=case: compute_case(case))
            print(name, flush=True)
    done = results.state["done"]
    (folder / "report.md").write_text(write_page(request, done))
    for model in {name.split(", ")[0] for name in done}:
        ranks = {
            name.split(", ", 1)[1]: read_ranks(case)
            for name, case in done.items()
            if name.startswith(model)
        }
        picture = render_palette_png(sbc_histograms(ranks))
        (folder / f"calibration_{model}.png").write_bytes(picture)


if __name__ == "__main__":
    folder = Path(os.environ.get("PFBENCH_RESULTS", "results")) / "learn_noise_calibration"
    runs, effort, only = [*sys.argv[1:], *("200", "2", "")[len(sys.argv) - 1 :]]
    main(folder, int(runs), int(effort), only)
