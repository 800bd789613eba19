"""Simulation-based calibration: does an algorithm find the posterior that it says it finds? All data sets are runs of one batch.

Numbers come from the prior, measurements from the model with them, draws from the algorithm under test. If all is right, the rank
of each number among its draws is uniform [Talts, Betancourt, Simpson, Vehtari and Gelman 2018, "Validating Bayesian inference
algorithms with simulation-based calibration"].
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

from pfbench.ppl.posterior import Posterior
from pfbench.ppl.program import Unknown, simulate
from pfbench.record import Record
from pfbench.report.canvas import COLUMN, RC

Infer = Callable[[Record], Posterior]


class Ranks(NamedTuple):
    """Of the true numbers among their draws.

    Attributes:
        ranks: {name: int64 [R]}, from 0 to `draws`.
        draws: L of each data set.
    """

    ranks: Mapping[str, Tensor]
    draws: int

    def p_value(self, name: str, bins: int = 10) -> float:
        """Of a chi-square test that the ranks are uniform.

        Raises:
            ValueError: bins into which draws + 1 ranks do not fit evenly.
        """
        return float(chisquare(self.counts(name, bins)).pvalue)

    def counts(self, name: str, bins: int) -> np.ndarray:
        """Data sets with a rank in each of equal bins [bins]. Raises as `p_value`."""
        if (self.draws + 1) % bins:
            raise ValueError(f"bins={bins}: {self.draws} draws have {self.draws + 1} ranks, which do not make {bins} equal bins")
        return torch.bincount(self.ranks[name] * bins // (self.draws + 1), minlength=bins).numpy()


def calibrate(unknown: Unknown, template: Record, infer: Infer, draws: int = 19, seed: int = 0) -> Ranks:
    """Ranks of as many data sets as `template` has runs.

    Args:
        unknown: prior and model of the worlds.
        template: shape, inputs and starts of the records; its measurements do not matter, but for their gaps.
        infer: the algorithm, on a record whose runs have numbers of their own; what it believes may be another model.
        draws: L, evenly spaced among those that it gives; far fewer than those, or their autocorrelation shows in the ranks.
        seed: of the worlds.
    """
    truth = unknown.draw(len(template.y), seed)
    record, _ = simulate(unknown.apiece(truth), template, seed)
    posterior = infer(record)
    found = {}
    for name, true in truth.items():
        every = posterior.draws[name].flatten(0, 1)
        some = every[torch.linspace(0, len(every) - 1, draws).round().long()]
        found[name] = (some < true).sum(0)
    return Ranks(found, draws)


def histograms(found: Mapping[str, Ranks], bins: int = 10) -> Figure:
    """Rank histograms by label, a row for each number, with the band that holds 95 % of the bins of uniform ranks."""
    labels, names = list(found), list(next(iter(found.values())).ranks)
    with matplotlib.rc_context(RC):
        figure = Figure(figsize=(max(1.0, 0.5 * len(labels)) * COLUMN, 0.6 + 1.2 * len(names)), layout="constrained")
        axes = figure.subplots(len(names), len(labels), squeeze=False, sharex=True)
        for i, (row, name) in enumerate(zip(axes, names, strict=True)):
            for axis, label in zip(row, labels, strict=True):
                counts = found[label].counts(name, bins)
                low, high = binom.ppf([0.025, 0.975], counts.sum(), 1.0 / bins)
                axis.axhspan(low, high, color="0.85", linewidth=0)
                axis.bar((np.arange(bins) + 0.5) / bins, counts, width=0.9 / bins, color="#0072B2")
                told = f"p = {found[label].p_value(name, bins):.2g}"
                axis.set_title(f"{label}\n{told}" if i == 0 else told)
                axis.set_ylim(0, None)
            row[0].set_ylabel(name.replace("_", " "))
        figure.supxlabel("rank of the truth among its draws", fontsize=RC["font.size"])
    return figure
