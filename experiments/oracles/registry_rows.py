"""Filters of the registry on one printed number: the log likelihood of a local level of the Nile, which the exact ones reach."""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator

import torch
from pfbench.experiments.oracles.book import Number, recipe
from pfbench.experiments.oracles.linear_rows import MARSS, marss_level
from pfbench.experiments.oracles.runs import build_filter, run_many

# exact on a linear model without any draw
RULES = (
    "ekf",
    "ukf",
    "ckf",
    "hckf",
    "iekf",
    "iplf",
    "mckf",
    "mssrckf",
    "ssr53",
    "ssrckf",
    "ssrhckf5",
)
# their evidence is unbiased with any number of particles
UNBIASED = (
    "apf", "ckf_pf", "cpf_each", "dmc_density", "dmc_noise", "dmc_optimal", "ekf_pf", "mcmc_rpf", "mcmc_tail", "sir", "sir_literal",
    "sir_printed", "sqmc", "ukf_pf",
)  # fmt: skip
PRINTED, RUNS, PARTICLES = -637.7569, 30, 500


@recipe(40, MARSS)
def registry_nile() -> Iterator[Number]:
    """The evidence of each filter: the logarithm of its mean over runs."""
    model, y = marss_level()
    setting = "log likelihood of the Nile from 1111.791 in 1870"
    for name in RULES:
        ours = float(run_many(build_filter(name), model, y).log_evidence)
        yield Number(name, setting, PRINTED, ours, 5e-5, filters=(name,))
    for name in UNBIASED:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # a guide for each particle is said to be slow
            values = run_many(build_filter(name, PARTICLES), model, y, RUNS).log_evidence
        ours = float(torch.logsumexp(values, 0)) - math.log(RUNS)
        error = float((values - ours).exp().std()) / RUNS**0.5
        yield Number(name, f"{setting}, {PARTICLES} particles, {RUNS} runs", PRINTED, ours, 5e-5, our_error=error, filters=(name,))  # fmt: skip
