"""Simulation-based calibration of inference algorithms.

Parameters come from the prior, measurements from the model with these parameters, and draws from
the algorithm under test. All data sets are runs of one batch. If the algorithm is correct, the
rank of each parameter among its draws is uniform [Talts, Betancourt, Simpson, Vehtari and Gelman
2018, "Validating Bayesian inference algorithms with simulation-based calibration"].
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import NamedTuple

import matplotlib
import numpy as np
import torch
from matplotlib.figure import Figure
from scipy.stats import binom, chisquare
from torch import Tensor

from pfbench.core.record import Record
from pfbench.ppl.arguments import check_counts, check_kinds
from pfbench.ppl.parameter_posterior import ParameterPosterior
from pfbench.ppl.parameterised_model import ParameterisedModel
from pfbench.ppl.prior_predictive import simulate
from pfbench.report.plots.plotting import COLUMN, RC

Infer = Callable[[Record], ParameterPosterior]


class SbcRanks(NamedTuple):
    """Ranks of true parameters among their draws.

    Attributes:
        ranks: Ranks by parameter, int64 [R], from 0 to `draws`.
        draws: Draws L of each data set.
    """

    ranks: Mapping[str, Tensor]
    draws: int

    def p_value(self, name: str, bins: int = 10) -> float:
        """Compute the p-value of a chi-square test that the ranks are uniform.

        Args:
            name: Parameter.
            bins: Number of equal bins; it divides draws + 1.

        Returns:
            The p-value.

        Raises:
            ValueError: If the bins do not divide the ranks evenly.
        """
        return float(chisquare(self.counts(name, bins)).pvalue)

    def counts(self, name: str, bins: int) -> np.ndarray:
        """Count the data sets with a rank in each of equal bins [bins].

        Args:
            name: Parameter.
            bins: Number of equal bins; it divides draws + 1.

        Returns:
            Counts, [bins].

        Raises:
            ValueError: If the bins do not divide the ranks evenly.
        """
        ranks = self.draws + 1
        if ranks % bins:
            raise ValueError(
                f"bins must divide {ranks}, the number of ranks of {self.draws} draws, got {bins}. "
                "Change bins or draws."
            )
        return torch.bincount(self.ranks[name] * bins // ranks, minlength=bins).numpy()


def simulation_based_calibration(
    unknown: ParameterisedModel, template: Record, infer: Infer, draws: int = 19, seed: int = 0
) -> SbcRanks:
    """Compute ranks of simulated data sets, one for each run of the template.

    Args:
        unknown: Prior and model of the simulated data.
        template: Shape, inputs, starts and missing components of the records.
        infer: Algorithm under test, on a record whose runs have their own parameters. It may
            assume another model.
        draws: Draws L, evenly spaced among those of the algorithm. L must be much smaller than
            their number, or their autocorrelation changes the ranks.
        seed: Seed of the simulated data.

    Returns:
        Ranks of all parameters.

    Raises:
        ValueError: If a count is too small, or an argument is of another class.
    """
    kinds = {"unknown": (unknown, ParameterisedModel), "template": (template, Record)}
    check_kinds("simulation_based_calibration", {**kinds, "infer": (infer, Callable)})
    check_counts("simulation_based_calibration", {"draws": (draws, 1), "seed": (seed, 0)})
    truth = unknown.sample(len(template.y), seed)
    record, _ = simulate(unknown.models_per_run(truth), template, seed)
    posterior = infer(record)
    ranks = {}
    for name, value in truth.items():
        samples = posterior.draws[name].flatten(0, 1)
        index = torch.linspace(0, len(samples) - 1, draws).round().long()
        ranks[name] = (samples[index] < value).sum(0)
    return SbcRanks(ranks, draws)


def sbc_histograms(ranks: Mapping[str, SbcRanks], bins: int = 10) -> Figure:
    """Plot rank histograms, a row for each parameter and a column for each label.

    The band contains 95 % of the bins of uniform ranks.

    Args:
        ranks: Ranks by label.
        bins: Number of bins.

    Returns:
        Figure.
    """
    labels, names = list(ranks), list(next(iter(ranks.values())).ranks)
    width = max(1.0, 0.5 * len(labels)) * COLUMN
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(width, 0.6 + 1.2 * len(names)), layout="constrained")
        axes = figure.subplots(len(names), len(labels), squeeze=False, sharex=True)
        for i, (row, name) in enumerate(zip(axes, names, strict=True)):
            for axis, label in zip(row, labels, strict=True):
                counts = ranks[label].counts(name, bins)
                low, high = binom.ppf([0.025, 0.975], counts.sum(), 1.0 / bins)
                axis.axhspan(low, high, color="0.85", linewidth=0)
                axis.bar((np.arange(bins) + 0.5) / bins, counts, width=0.9 / bins, color="#0072B2")
                text = f"p = {ranks[label].p_value(name, bins):.2g}"
                axis.set_title(f"{label}\n{text}" if i == 0 else text)
                axis.set_ylim(0, None)
            row[0].set_ylabel(name.replace("_", " "))
        figure.supxlabel("rank of the true value among its draws", fontsize=RC["font.size"])
    return figure
